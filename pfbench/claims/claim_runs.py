"""Stored runs of claims: a file of values for each job, and the dots of a claim from these files."""

from __future__ import annotations

import gzip
import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, reduce
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pfbench.claims.claim_lines import (
    JOINT_SEED,
    MUCH,
    TIMING,
    WINDOW,
    ClaimPlan,
    ClaimPoint,
    LineComparison,
    list_kinds,
    list_points,
    make_cell,
    read_claim_data,
)
from pfbench.claims.measures import METRIC_WORDS, OFF_TRACK, Measure
from pfbench.claims.words import (
    CANNOT_RUN,
    FALSE,
    LOOKS,
    NOT_RUN,
    VACUOUS,
    ClaimDecision,
    ClaimSample,
    ReadingDot,
    WeighedSample,
    decide_claim,
    weigh,
)
from pfbench.files.atomic_write import write_atomically
from pfbench.job.readings import CENTRAL_READING
from pfbench.results.paper_block import read_paper_block
from pfbench.stats.error_measures import Array

CLAIMS_STUDY = "claims_2"  # folder of the jobs
SEEDS = (2001, 2002, 2003)  # of listed readings
VALUES_SUFFIX = ".values.json"
PUBLISHED_VALUES = "values.json.gz"  # of all runs, in the folder of the page
LISTED, FIRST, MORE = (
    "listed",
    "first",
    "more",
)  # runs of a listed reading, of a joint draw, and those that follow if it is open
_PROVED = {FALSE: WeighedSample(1.0, 0.0)}
Cell = tuple[str, ...]


class Batch(NamedTuple):
    """Runs of a cell in one job.

    Attributes:
        seed: Seed.
        first_run: Number of the first run.
        runs: Number of runs.
    """

    seed: int
    first_run: int
    runs: int


@dataclass(frozen=True)
class StoredValues:
    """Values of the runs of a job, or times of two jobs in turn.

    Attributes:
        cell: Words of the job without seed, runs and folder.
        seed: Seed.
        first_run: Number of the first run.
        runs: Number of runs.
        key: Key of the job; empty for one that failed.
        commit: Commit of the code, with "-dirty" if it was not committed.
        seconds: Processor time of the job, s.
        failed: Error of a job that cannot run; empty otherwise.
        lost: Lost runs, 0 or 1.
        values: Values of the runs by name of the quantity.
    """

    cell: Cell
    seed: int
    first_run: int
    runs: int
    key: str
    commit: str
    seconds: float
    failed: str
    lost: tuple[int, ...]
    values: Mapping[str, Sequence[float]]

    @property
    def batch(self) -> Batch:
        """Runs of the job."""
        return Batch(self.seed, self.first_run, self.runs)


Series = tuple[
    np.ndarray, Array, np.ndarray
]  # numbers of runs, ascending, their values, and which are lost, [n] each


class ClaimRuns:
    """Stored values by cell.

    Args:
        records: Values of all jobs.
    """

    def __init__(self, records: Sequence[StoredValues]) -> None:
        self.records = sorted(records, key=lambda r: (r.cell, r.batch))
        self._by_cell: dict[Cell, list[StoredValues]] = {}
        for record in self.records:
            self._by_cell.setdefault(record.cell, []).append(record)

    @classmethod
    def read(cls, results: Path, reports: Path) -> ClaimRuns:
        """Read the values of the results, and those of the page that the results do not have.

        A damaged file of the results counts as not run.
        """
        paths = sorted((results / CLAIMS_STUDY).glob(f"*{VALUES_SUFFIX}"))
        runs = cls([r for path in paths for r in _read_values(path)])
        published = reports / CLAIMS_STUDY / PUBLISHED_VALUES
        if not published.is_file():
            return runs
        records = map(_make_record, json.loads(gzip.decompress(published.read_bytes())))
        return cls([*runs.records, *(r for r in records if not runs.has(r.cell, r.batch))])

    def find(self, cell: Cell) -> list[StoredValues]:
        """Find the jobs of a cell."""
        return self._by_cell.get(cell, [])

    def has(self, cell: Cell, batch: Batch, names: Sequence[str] = ()) -> bool:
        """Return whether the runs of a job are stored with some quantities, or it cannot run."""
        return any(
            record.failed or (record.batch == batch and set(names) <= set(record.values))
            for record in self.find(cell)
        )

    def join(self, cell: Cell, name: str, of_draws: bool = False) -> Series | None:
        """Join the values of a quantity over the runs of joint draws, or of listed readings; None without runs."""
        records = [r for r in self.find(cell) if name in r.values and not r.failed and (r.seed == JOINT_SEED) == of_draws]  # fmt: skip
        if not records:
            return None
        runs = [r.seed * 2**32 + r.first_run + np.arange(len(r.lost)) for r in records]
        lost = np.concatenate([np.array(r.lost, bool) for r in records])
        values = np.concatenate([np.array(r.values[name], dtype=np.float64) for r in records])
        # Jobs of two stages overlap, and a run that counts twice would make its claim look surer than it is.
        numbers, places = np.unique(np.concatenate(runs), return_index=True)
        return numbers, values[places], lost[places]


def make_batch(paper: str, point: ClaimPoint, stage: str) -> Batch:
    """Make the runs of a reading at a stage: the first ones, or those that follow.

    All joint draws have the same runs, so that they share worlds, and jobs of filters that a level does not concern.
    """
    counts = read_claim_data()["papers"][paper]["runs"]
    if point.draw < 0:
        return Batch(SEEDS[0], 0, counts[LISTED])
    return Batch(JOINT_SEED, counts[FIRST] if stage == MORE else 0, counts[stage])


def find_file(folder: Path, cell: Cell, batch: Batch) -> Path:
    """Find the file of the values of a job; its name depends on words and runs alone."""
    text = json.dumps([cell, *batch])
    return folder / f"{hashlib.sha256(text.encode()).hexdigest()[:16]}{VALUES_SUFFIX}"


def write_values(folder: Path, record: StoredValues) -> None:
    """Write the values of a job. An interruption leaves the old or the new file."""
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(asdict(record)).encode()
    path = find_file(folder, record.cell, record.batch)
    write_atomically(path, lambda file: file.write(text))


def _read_values(path: Path) -> Iterator[StoredValues]:
    """Read a file of values, if it is whole."""
    try:
        yield _make_record(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError, KeyError):
        return


def _make_record(content: Mapping[str, Any]) -> StoredValues:
    """Make the values of a job from those of a file, to nine digits, so that published values are not longer."""
    values = {
        name: [float(f"{value:.9g}") for value in column]
        for name, column in content["values"].items()
    }
    changes = {"cell": tuple(content["cell"]), "lost": tuple(content["lost"]), "values": values}
    return StoredValues(**{**content, **changes})


def name_timing(a: Cell, b: Cell) -> Cell:
    """Name the cell of two filters that are timed in turn."""
    return ("time", *a, "against", *b)


def list_claim_cells(plan: ClaimPlan, points: Sequence[ClaimPoint] = ()) -> dict[Cell, dict[str, Measure]]:  # fmt: skip
    """List the cells of a claim in some readings, or in all, with the quantities that it compares by name."""
    cells: dict[Cell, dict[str, Measure]] = {}
    for point in points or list_points(plan):
        for cell, measure in list_point_cells(plan, point):
            cells.setdefault(cell, {})[measure.name] = measure
    return cells


def list_point_cells(plan: ClaimPlan, point: ClaimPoint) -> list[tuple[Cell, Measure]]:
    """List the cells and quantities of a reading; none if a proof decides it."""
    comparisons = [] if _find_state(plan, point) else [c for parts in plan.parts.values() for c in parts]  # fmt: skip
    return [pair for c in comparisons for pair in measure_sides(plan, point, c)]


def measure_sides(plan: ClaimPlan, point: ClaimPoint, c: LineComparison) -> list[tuple[Cell, Measure]]:  # fmt: skip
    """Return cell and quantity of the sides that are filters, in the window of a reading."""
    window = plan.windows.get(point.levels.get(WINDOW, ""), ())
    times: dict[str, Any] = dict(zip(("start", "end"), window, strict=False))
    return [(make_cell(plan, point, side), replace(side.measure, **times)) for side in (c.a, c.b) if side.filter]  # fmt: skip


def _find_state(plan: ClaimPlan, point: ClaimPoint) -> str:
    """Find the outcome that a proof gives in a reading; empty where runs decide."""
    is_scope = all(point.levels[factor] == CENTRAL_READING for factor in plan.but)
    return plan.proved if is_scope else ""


def select_points(plan: ClaimPlan, runs: ClaimRuns) -> list[ClaimPoint]:
    """Select the readings that decide: joint draws up to the first without runs, and the listed ones if those are few."""
    points = list_points(plan)
    listed = [point for point in points if point.draw < 0]
    joint = points[len(listed) :]
    run = list(takewhile(lambda point: _has_runs(plan, point, runs), joint))
    return [*(listed[:1] if len(run) >= LOOKS[0] else listed), *run]


def _has_runs(plan: ClaimPlan, point: ClaimPoint, runs: ClaimRuns) -> bool:
    """Return whether all cells of a joint draw have runs, or cannot run."""
    return all(
        any(r.failed or (r.seed == JOINT_SEED and measure.name in r.values) for r in runs.find(cell))
        for cell, measure in list_point_cells(plan, point)
    )  # fmt: skip


_Weighed = Mapping[str, Mapping[str, WeighedSample]]  # by kind and reading


def weigh_comparison(plan: ClaimPlan, points: Sequence[ClaimPoint], c: LineComparison, runs: ClaimRuns) -> _Weighed:  # fmt: skip
    """Weigh a comparison in some readings, as each of its kinds."""
    pairs = {p.name: _find_state(plan, p) or _join_pair(plan, p, c, runs) for p in points}
    return {
        kind: {
            name: _PROVED.get(pair, WeighedSample(state=pair)) if isinstance(pair, str) else weigh(pair._replace(kind=kind))
            for name, pair in pairs.items()
        }
        for kind in list_kinds(c)
    }  # fmt: skip


def make_dots(points: Sequence[ClaimPoint], weighed: Sequence[_Weighed], kind: str = "") -> dict[str, ReadingDot]:  # fmt: skip
    """Make the dots of a part of a claim, or of an atom with one kind, without "much" as a factor."""
    dots = {}
    for point in points:
        if not (kind and point.name.startswith(MUCH)):
            much = kind or point.levels.get(MUCH, "")
            parts = [column.get(much, next(iter(column.values())))[point.name] for column in weighed]  # fmt: skip
            levels = {f: level for f, level in point.levels.items() if f != MUCH or not kind}
            dots[point.name] = ReadingDot(levels, parts, point.draw)
    return dots


def _join_pair(plan: ClaimPlan, point: ClaimPoint, c: LineComparison, runs: ClaimRuns) -> ClaimSample | str:  # fmt: skip
    """Join the runs of both sides.

    `NOT_RUN` without runs, `CANNOT_RUN` if a job fails, `VACUOUS` if losses of track are compared and no run of either side has one.
    """
    measured = measure_sides(plan, point, c)
    if any(record.failed for cell, _ in measured for record in runs.find(cell)):
        return CANNOT_RUN
    if c.a.measure.metric == TIMING:
        return _join_times([cell for cell, _ in measured], c, runs)
    series = [runs.join(cell, measure.name, point.draw >= 0) for cell, measure in measured]
    present = [s for s in series if s is not None]
    if len(present) < len(series):
        return NOT_RUN
    common = reduce(np.intersect1d, (s[0] for s in present))
    matches = iter([_select(s, common) for s in present])
    n = len(common)
    a, b = (next(matches) if side.filter else (np.full(n, side.number), np.zeros(n, bool)) for side in (c.a, c.b))  # fmt: skip
    if c.a.measure.metric == OFF_TRACK and n and max(a[0].max(), b[0].max()) <= 1.0:
        return VACUOUS
    first = make_batch(plan.claim.paper, point, FIRST)
    early = common - first.seed * 2**32 < first.first_run + first.runs
    return ClaimSample(c.kind, a[0], b[0], a[1], b[1], early, c.printed, describe_sides(c))


def describe_sides(c: LineComparison) -> str:
    """Describe a comparison for a reader: what is divided by what, its components and its time."""
    filtered = [side for side in (c.a, c.b) if side.filter]
    quantities = [describe_quantity(side.measure) for side in filtered]
    is_common, texts = len(set(quantities)) == 1, read_claim_data()["settings"]
    names = [
        " ".join([_name_filter(side.filter), *(texts[word] for word in (*side.words, *side.world))])
        if side.filter
        else f"{side.number:g}"
        for side in (c.a, c.b)
    ]
    if not is_common:
        names = [f"{name} ({text})" for name, text in zip(names, quantities, strict=True)]
    metric = c.a.measure.metric
    words = [METRIC_WORDS.get(metric, metric.replace("_", " ")), *quantities[: int(is_common)]]
    return f"{' '.join(filter(None, words))}, {names[0]} / {names[1]}"


@cache
def _name_filter(key: str) -> str:
    """Name a filter as in the tables of reports."""
    return str(read_paper_block("filter", key)["name"])


def describe_quantity(measure: Measure) -> str:
    """Describe components and time of a quantity."""
    of = measure.component.replace("_", " ") if measure.component != "norm" else measure.group
    ends = [f"from {measure.start:g} s"] * (measure.start > 0)
    ends += [f"to {measure.end:g} s"] * math.isfinite(measure.end)
    bound = f"below {measure.settled:g}" if math.isfinite(measure.settled) else ""
    return " ".join(filter(None, [f"of {of}" if of else "", bound, *ends]))


def _select(series: Series, runs: np.ndarray) -> tuple[Array, np.ndarray]:
    """Select some runs of a series: values and lost runs, [n]."""
    places = np.searchsorted(series[0], runs)
    return series[1][places], series[2][places]


def _join_times(cells: Sequence[Cell], c: LineComparison, runs: ClaimRuns) -> ClaimSample | str:
    """Join times per step that were measured in turn; the first look has a third of the rounds."""
    records = runs.find(name_timing(cells[0], cells[-1]))
    if not records:
        return NOT_RUN
    record = records[0]
    n = len(record.lost)
    a, b = (
        np.array(record.values[str(k)]) if side.filter else np.full(n, side.number)
        for k, side in enumerate((c.a, c.b))
    )
    lost = np.zeros(n, bool)
    early = np.arange(n) < n // 3
    return ClaimSample(c.kind, a, b, lost, lost, early, c.printed, describe_sides(c))


Decisions = Mapping[tuple[str, str, str], ClaimDecision]


def decide_claims(plans: Sequence[ClaimPlan], runs: ClaimRuns) -> Decisions:
    """Decide all claims: decision by claim, column and part, and by the name of an atom."""
    decisions: dict[tuple[str, str, str], ClaimDecision] = {}
    for plan in plans:
        points = select_points(plan, runs)
        for (column, portion), comparisons in plan.parts.items():
            weighed = [weigh_comparison(plan, points, c, runs) for c in comparisons]
            dots = make_dots(points, weighed)
            decisions[plan.claim.id, column, portion] = decide_claim(dots)
            for name, kind, members in _list_atoms(comparisons):
                parts = [weighed[k] for k in members]
                decisions[plan.claim.id, column, f"{portion}, {name}"] = decide_claim(make_dots(points, parts, kind))  # fmt: skip
    return decisions


def _list_atoms(comparisons: Sequence[LineComparison]) -> Iterator[tuple[str, str, list[int]]]:
    """Yield name, kind and comparisons of the atoms of a part: what is compared with whom, and how much is asked.

    Worlds of one comparison are one atom.
    """
    atoms: dict[tuple[str, str], list[int]] = {}
    for k, c in enumerate(comparisons):
        text = describe_sides(c._replace(a=c.a._replace(world=()), b=c.b._replace(world=())))
        for kind in list_kinds(c):
            atoms.setdefault((text, kind), []).append(k)
    yield from ((f"{text}: {kind}", kind, members) for (text, kind), members in atoms.items())


def estimate_seconds(paper: str, cell: Cell, runs: ClaimRuns) -> float:
    """Estimate the time of one run of a cell: as measured for this cell or its filter, else as in the settings."""
    name = next(word.partition("=")[2] for word in cell if word.startswith("filter="))
    measured = [
        record.seconds / record.runs
        for record in runs.find(cell) or [r for r in runs.records if f"filter={name}" in r.cell and r.cell[0][:11] == cell[0][:11]]
        if not record.failed
    ]  # fmt: skip
    prices = read_claim_data()["papers"][paper]["seconds"]
    return float(np.median(measured)) if measured else float(prices.get(name, prices["_"]))
