"""Runs of claims: the cheapest undecided claim first, in jobs that `pfbench run` would write under the same keys."""

from __future__ import annotations

import json
import math
import multiprocessing
import random
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import replace
from itertools import product, repeat
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pfbench.claims.claim_lines import (
    TIMING,
    ClaimPlan,
    ClaimPoint,
    list_main_parts,
    list_points,
    read_claim_data,
)
from pfbench.claims.claim_runs import (
    CLAIMS_STUDY,
    FIRST,
    MORE,
    Batch,
    Cell,
    ClaimRuns,
    Decisions,
    StoredValues,
    estimate_seconds,
    list_claim_cells,
    make_batch,
    measure_sides,
    name_timing,
    write_values,
)
from pfbench.claims.measures import MOVED, Measure, measure_runs
from pfbench.claims.words import LOOKS, OPEN, UNDECIDED
from pfbench.job.config import compose
from pfbench.results import store

WORKERS = 2
_ROUNDS = 20  # of times that are measured in turn
_ROUND_S = 0.05
_TIMING_S = 300.0  # of a timing; a filter that costs more is timed in fewer runs [ours]
_FEWEST_TIMED = 3
_VERIFIED = 20
_VERIFIED_IN_PAPER = 3
_VERIFY_S = 120.0  # of recomputed runs in all, s
_LONGEST_S = 15.0  # of the fewest runs of a particle filter that are computed again
_TOLERANCE = 1e-6  # relative; the stored values are the same numbers in other batches
_PARTICLE_RUNS = 5  # that are compared in the mean
_LARGEST_ERROR = 4.5  # standard errors


class Task(NamedTuple):
    """A job to run, or two filters to time in turn.

    Attributes:
        paper: Number of the paper.
        cell: Words of the job, or the name of a timing.
        batch: Runs.
        measures: Quantities of its runs by name.
        timed: Cells that are timed in turn; empty for a job.
        seconds: Estimate of its time, s.
    """

    paper: str
    cell: Cell
    batch: Batch
    measures: Mapping[str, Measure]
    timed: tuple[Cell, ...] = ()
    seconds: float = 0.0


class ClaimPrice(NamedTuple):
    """Price of the next look of a claim.

    Attributes:
        plan: Claim.
        draws: Joint draws of the look; 0 for a claim without draws.
        stage: Runs of each draw: first, or more where it is open.
        tasks: Jobs that are missing.
    """

    plan: ClaimPlan
    draws: int
    stage: str
    tasks: tuple[Task, ...]

    @property
    def seconds(self) -> float:
        """Time of the missing jobs, s."""
        return sum(task.seconds for task in self.tasks)


def price_claims(
    plans: Sequence[ClaimPlan], runs: ClaimRuns, decisions: Decisions
) -> list[ClaimPrice]:
    """Price the next look of each claim whose word does not stand, the cheapest first.

    Draws run in their order: those of the cheapest readings alone would be no sample of the grid. Jobs that may refuse
    are the first of a claim: they take seconds, and one that refuses in all readings decides it.
    """
    prices = filter(None, (_price_look(plan, runs, decisions) for plan in plans))
    return sorted(prices, key=lambda price: (price.seconds, price.plan.claim.id))


def _price_look(plan: ClaimPlan, runs: ClaimRuns, decisions: Decisions) -> ClaimPrice | None:
    """Price the next look of a claim; None if its word is decided or all draws are complete."""
    mine = [decisions[plan.claim.id, column, portion] for column, portion in list_main_parts(plan)]
    points = list_points(plan)
    for look in LOOKS if plan.is_drawn else (0,):
        selected = [p for p in points if p.draw < look and (p.draw >= 0) == plan.is_drawn]
        first = _list_missing(plan, FIRST, selected, runs)
        if first or not plan.is_drawn:
            return ClaimPrice(plan, look, FIRST, first) if first else None
        if all(d.word != OPEN and d.is_drawn for d in mine):
            return None
        undecided = [p for p in selected if any(d.outcomes[p.name] == UNDECIDED for d in mine if d.word == OPEN)]  # fmt: skip
        # so few readings as those of the first look cannot confirm or refute: more of them serve better than more runs
        more = _list_missing(plan, MORE, undecided if look > LOOKS[0] else (), runs)
        if more:
            return ClaimPrice(plan, look, MORE, more)
    return None


def _list_missing(plan: ClaimPlan, stage: str, points: Sequence[ClaimPoint], runs: ClaimRuns) -> tuple[Task, ...]:  # fmt: skip
    """List the missing jobs of a claim in some readings, those that may refuse first."""
    paper, tasks = plan.claim.paper, list[Task]()
    for point in points:
        batch = make_batch(paper, point, stage)
        for cell, measures in list_claim_cells(plan, [point]).items():
            if not runs.has(cell, batch, [n for n, m in measures.items() if m.metric != TIMING]):
                price = estimate_seconds(paper, cell, runs) * batch.runs
                tasks.append(Task(paper, cell, batch, measures, seconds=price))
    tasks += _list_timings(plan, points, runs)
    return tuple(sorted(tasks, key=lambda task: not may_refuse(task)))


def _list_timings(plan: ClaimPlan, points: Sequence[ClaimPoint], runs: ClaimRuns) -> Iterator[Task]:  # fmt: skip
    """Yield the timings of a claim that are missing: of the runs of a reading, or as many as take five minutes.

    A filter that takes hours has thousands of updates in each step of three runs.
    """
    comparisons = [c for parts in plan.parts.values() for c in parts if c.a.measure.metric == TIMING]  # fmt: skip
    for point, c in product(points, comparisons):
        cells = [cell for cell, _ in measure_sides(plan, point, c)]
        name, batch = name_timing(cells[0], cells[-1]), make_batch(plan.claim.paper, point, FIRST)
        if not runs.find(name):
            # 20 rounds of at least 20 steps take about as long as the job itself
            rounds = _ROUNDS * _ROUND_S * len(cells) * 3
            run_s = 2.0 * sum(estimate_seconds(plan.claim.paper, cell, runs) for cell in {*cells})
            count = min(batch.runs, max(_FEWEST_TIMED, int((_TIMING_S - rounds) / run_s)))
            yield Task(
                plan.claim.paper, name, batch._replace(runs=count), {}, tuple(cells), rounds + count * run_s
            )  # fmt: skip


def run_claim_task(task: Task, results: str) -> StoredValues:
    """Run a job, or read it if it exists, and write its values."""
    record = (_time_in_turn if task.timed else _run_job)(task, results)
    if not record.failed or may_refuse(task):
        write_values(Path(results) / CLAIMS_STUDY, record)
    return record


def may_refuse(task: Task) -> bool:
    """Return whether the error of a job is an outcome: that of a form that refuses to run, by a proof."""
    forms = read_claim_data()["papers"][task.paper].get("refuses", ())
    return any(f"filter={name}" in task.cell for name in forms)


def list_words(cell: Cell, batch: Batch, results: str) -> list[str]:
    """List the words of a job, as for `pfbench run`."""
    runs_words = (f"seed={batch.seed}", f"first_run={batch.first_run}", f"runs={batch.runs}")
    return [*cell, *runs_words, f"study={CLAIMS_STUDY}", f"results_dir={results}"]


def _run_job(task: Task, results: str) -> StoredValues:
    """Run a job; an error is stated in the result."""
    from pfbench.job.plan import read_versions
    from pfbench.job.run_job import run

    commit = read_versions()["commit"]
    empty = StoredValues(task.cell, *task.batch, "", commit, 0.0, "", (), {})
    words = list_words(task.cell, task.batch, results)
    begin = time.process_time()
    try:
        outcome = run(compose(words))
    except Exception as error:
        text = f"{type(error).__name__}: {error}"
        return replace(empty, failed=text[:300], seconds=time.process_time() - begin)
    result = store.read_result(outcome.path)
    seconds = result.meta["seconds"]
    values = {
        name: [float(value) for value in _measure(result, measure, words)]
        for name, measure in task.measures.items()
        if measure.metric != TIMING
    }
    return replace(
        empty,
        key=outcome.path.stem,
        commit=result.meta["versions"]["commit"],
        seconds=float(seconds["world"] + seconds["filter"]),
        lost=tuple(int(value) for value in result.data["lost"]),
        values=values,
    )


def _measure(result: store.JobResult, measure: Measure, words: Sequence[str]) -> np.ndarray:
    """Measure a quantity of a job, [R]: from its result, or from its particles, for which the filter runs again."""
    if measure.metric != MOVED:
        return measure_runs(result, measure)
    from pfbench.job.moved_clouds import measure_moved_clouds

    return measure_moved_clouds(words)


def _time_in_turn(task: Task, results: str) -> StoredValues:
    """Time the filters of stored jobs in turn, 20 rounds."""
    from pfbench.job.plan import read_versions
    from pfbench.job.run_job import run
    from pfbench.job.step_timing import time_condition
    from pfbench.results.conditions import Condition, JobFile

    paths = {cell: run(compose(list_words(cell, task.batch, results))).path for cell in task.timed}
    jobs = [
        JobFile(path, " ".join(cell), store.read_metadata(path)) for cell, path in paths.items()
    ]
    choices = jobs[0].meta["choices"]
    begin = time.process_time()
    measured = time_condition(
        Condition(choices["scenario"], choices["noise"], choices["model"], tuple(jobs)),
        {},
        _ROUNDS,
        _ROUND_S,
    )
    times = {str(k): measured["jobs"][job.path.stem]["cpu"] for k, job in enumerate(jobs)}
    commit, spent = read_versions()["commit"], time.process_time() - begin
    return StoredValues(
        task.cell, *task.batch, "", commit, spent, "", (0,) * _ROUNDS, times if len(times) > 1 else {**times, "1": times["0"]},
    )  # fmt: skip


def run_tasks(
    tasks: Sequence[Task], results: str, workers: int, seconds: float
) -> Iterator[tuple[Task, StoredValues]]:
    """Run jobs in at most two processes until the time is over, and yield each as it ends."""
    end, waiting = time.monotonic() + seconds, list(reversed(tasks))
    context = multiprocessing.get_context("spawn")
    running: dict[Future[StoredValues], Task] = {}
    with ProcessPoolExecutor(min(workers, WORKERS), mp_context=context) as pool:
        while running or (waiting and time.monotonic() < end):
            while waiting and len(running) < workers and time.monotonic() < end:
                task = waiting.pop()
                running[pool.submit(run_claim_task, task, results)] = task
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                yield running.pop(future), future.result()


# --------------------------------------------------------------------------------------------------
# Verification: stored cells again, and words from the stored values.


class Check(NamedTuple):
    """A stored job that was computed again.

    Attributes:
        record: Stored values.
        runs: Runs that were computed.
        fault: What differs; empty if nothing does.
        is_equal: Whether values of runs are equal, and not only their means within the standard error.
    """

    record: StoredValues
    runs: int
    fault: str
    is_equal: bool = True


def draw_records(
    runs: ClaimRuns, seed: int, measures: Mapping[Cell, Mapping[str, Measure]]
) -> list[StoredValues]:
    """Draw 20 stored jobs, at least three of each paper that has them.

    They are those that a claim uses and whose runs are not too long.
    """
    draws = random.Random(seed)
    longest = _LONGEST_S / _PARTICLE_RUNS
    jobs = [
        r for r in runs.records
        if r.key and r.seconds / r.runs <= longest and r.values.keys() & measures.get(r.cell, {}).keys()
    ]  # fmt: skip
    papers: dict[str, list[StoredValues]] = {}
    for record in jobs:
        papers.setdefault(record.cell[0].partition("=")[0], []).append(record)
    drawn_records = [r for group in papers.values() for r in draws.sample(group, min(_VERIFIED_IN_PAPER, len(group)))]  # fmt: skip
    rest = [r for r in jobs if r not in drawn_records]
    return drawn_records + draws.sample(
        rest, min(max(_VERIFIED - len(drawn_records), 0), len(rest))
    )


def verify_records(
    drawn_records: Sequence[StoredValues],
    measures: Mapping[Cell, Mapping[str, Measure]],
    results: str,
) -> Iterator[Check]:
    """Verify stored jobs in two processes, and yield each in their order."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(WORKERS, mp_context=context) as pool:
        of_cells = [measures.get(record.cell, {}) for record in drawn_records]
        yield from pool.map(verify_record, drawn_records, of_cells, repeat(results))


def verify_record(record: StoredValues, measures: Mapping[str, Measure], results: str, seconds: float = _VERIFY_S / _VERIFIED) -> Check:  # fmt: skip
    """Compute the first runs of a stored job again, as many as the time allows, and compare key and values.

    A swarm, and particles without track, amplify a rounding, which differs between processors and batches. Runs of a
    particle filter may therefore differ. Their mean must not. Values that no claim uses any more are left out.
    """
    from pfbench.job.computation import compute_job
    from pfbench.job.inputs import find_inputs
    from pfbench.job.plan import build_plan
    from pfbench.job.settings import job_key

    config = compose(list_words(record.cell, record.batch, results))
    key = job_key(config.values, find_inputs(config.values, config.trusted))
    if key != record.key:
        return Check(
            record, 0, f"the key is {key}, stored {record.key}: the configuration has changed"
        )
    has_particles = "particles" in config.values["filter"]
    price, least = record.seconds / record.runs, _PARTICLE_RUNS if has_particles else 1
    count = min(record.runs, max(least, int(seconds / price) if price else record.runs))
    words = list_words(record.cell, record.batch._replace(runs=count), results)
    small = compose(words)
    meta, data = compute_job(build_plan(small), "verify")
    result = store.JobResult({"key": key, "config": small.values, **meta}, data)
    is_equal = True
    for name in record.values.keys() & measures.keys():
        again, stored = (
            _measure(result, measures[name], words),
            np.array(record.values[name][:count]),
        )
        equal = np.isclose(again, stored, rtol=_TOLERANCE, atol=0.0, equal_nan=True)
        is_equal &= bool(equal.all())
        if not equal.all() and not (has_particles and _has_equal_mean(again, stored)):
            k = int(np.argmin(equal))
            return Check(record, count, f"run {record.first_run + k} has {name} {again[k]:.8g}, stored {stored[k]:.8g}", False)  # fmt: skip
    return Check(record, count, "", is_equal)


def _has_equal_mean(again: np.ndarray, stored: np.ndarray) -> bool:
    """Return whether the mean difference of runs, relative to the sum of both, is zero within its standard error."""
    if not np.array_equal(np.isfinite(again), np.isfinite(stored)):
        return False
    size = np.maximum(
        np.abs(again) + np.abs(stored), 1e-300
    )  # few large errors would hide all others
    off = ((again - stored) / size)[np.isfinite(stored)]
    return bool(abs(off.mean()) <= _LARGEST_ERROR * off.std(ddof=1) / math.sqrt(len(off)))


def find_measures(plans: Sequence[ClaimPlan]) -> dict[Cell, dict[str, Measure]]:
    """Find the quantities of each cell over all claims."""
    decided: dict[Cell, dict[str, Measure]] = {}
    for plan in plans:
        for cell, measures in list_claim_cells(plan).items():
            decided.setdefault(cell, {}).update(measures)
    return decided


def merge_tasks(tasks: Sequence[Task], plans: Sequence[ClaimPlan]) -> list[Task]:
    """List each job once, with the quantities of all claims that use it, in their order; timings follow."""
    measures = find_measures(plans)
    once = {(task.cell, task.batch): task for task in tasks}
    merged = [t._replace(measures=measures.get(t.cell, {})) for t in once.values()]
    return sorted(merged, key=lambda task: bool(task.timed))


def describe_words(decisions: Decisions) -> dict[str, str]:
    """Return the word of each claim, column and part as text."""
    return {" ".join(key): decided.word for key, decided in decisions.items()}


def read_words(folder: Path) -> dict[str, str]:
    """Read the words that the page states; empty without a page."""
    path = folder / "words.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
