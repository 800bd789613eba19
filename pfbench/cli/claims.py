"""Command `pfbench claims`: the page of the papers' claims, their runs, and their verification."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from pfbench.core.parameter_checks import require
from pfbench.files.recorded_folder import copy_published, describe_missing_runs
from pfbench.job.config import compose

if TYPE_CHECKING:
    from pfbench.claims.claim_lines import ClaimPlan
    from pfbench.claims.claim_runs import ClaimRuns, StoredValues
    from pfbench.claims.run_claims import ClaimPrice, Decisions, Task

HELP = """\
pfbench claims [key=value ...]
pfbench claims run [ID ...] [hours=H] [readings=NAME,...] [dry=true]
pfbench claims verify [seed=N]

Write the page of the 88 claims of the five papers, with a word on each over all plausible
readings of its paper, from the published runs. A claim without runs is open, with the price of its runs.

  pfbench claims
  pfbench claims run                     a plan with prices, then the cheapest undecided claims first
  pfbench claims run C001-7              one claim; 001 is all claims of a paper
  pfbench claims run 002 readings=each hours=2
  pfbench claims run dry=true            the plan only
  pfbench claims verify                  computes 20 stored cells again, and all words, in about five minutes.
                                         Runs must be equal; those of particles, which may amplify rounding,
                                         agree in the mean. Cells of more than 3 s a run are not drawn

  hours=H                    starts no job after this time; repeat the command to resume
  workers=2                  processes, at most two
  readings=NAME,...          readings to run, as in pfbench list reading
  uncommitted=true           runs from code that is not committed, and says so in each result
  seed=N                     of the cells that verify draws; printed
  results_dir=FOLDER         the runs are in RESULTS/claims_2
  reports_dir=FOLDER         the page is REPORTS/claims_2/index.html; its runs are not run again"""

_PLACES = ("results_dir", "reports_dir")


def report_claims(words: Sequence[str]) -> None:
    """Write the page of the claims, run them, or verify them."""
    actions = {"run": run_claims, "verify": verify_claims}
    if words and words[0] in actions:
        actions[words[0]](words[1:])
        return
    print(f"claims: {write_claims_page(words).resolve()}")


def write_claims_page(words: Sequence[str]) -> Path:
    """Write the page of the claims.

    Returns the page.
    """
    from pfbench.claims.page import write_claims

    values = compose(words).values
    _take_published(values)
    return write_claims(values["results_dir"], values["reports_dir"])


def _take_published(places: Mapping[str, str]) -> None:
    """Copy the published values of the claims to the folder of the page, if there are none of the user's own."""
    from pfbench.claims.claim_runs import CLAIMS_STUDY, PUBLISHED_VALUES, VALUES_SUFFIX

    results = (Path(places["results_dir"]) / CLAIMS_STUDY).glob(f"*{VALUES_SUFFIX}")
    if not any(results):
        copy_published(Path(places["reports_dir"]) / CLAIMS_STUDY, PUBLISHED_VALUES)
        print(describe_missing_runs(), end="")


class RunRequest(NamedTuple):
    """Request of runs.

    Attributes:
        plans: Claims to run.
        results: Folder of the results.
        reports: Folder of the page, whose runs are not run again.
        seconds: Time after which no job starts, s.
        workers: Processes.
        readings: Names of the readings to run; empty for all.
        is_dry: Whether the plan is printed only.
        is_uncommitted: Whether code that is not committed may run.
    """

    plans: Sequence[ClaimPlan]
    results: str
    reports: str
    seconds: float
    workers: int
    readings: str
    is_dry: bool
    is_uncommitted: bool


def run_claims(words: Sequence[str]) -> None:
    """Run the cheapest undecided claims first, stage by stage."""
    request = read_request(words)
    begin, faults = time.monotonic(), 0
    while prices := list_prices(request):
        print_plan(prices)
        remaining = request.seconds - (time.monotonic() - begin)
        if request.is_dry or remaining <= 0 or faults:
            break
        check_committed(request.is_uncommitted)
        faults += run_stage([p for p in prices if p.stage == prices[0].stage], request, remaining)
    if not request.is_dry:
        print_words(request)
    if faults:
        raise RuntimeError(
            f"all jobs must run but those of forms that refuse, got {faults} errors. The lines above give the reasons. "
            "Correct them, and repeat the command."
        )


def read_request(words: Sequence[str]) -> RunRequest:
    """Read the words of a command."""
    from pfbench.claims.run_claims import WORKERS
    from pfbench.cli.compose import split_words

    keys = ("hours", "workers", "readings", "dry", "uncommitted", *_PLACES)
    values = split_words([w for w in words if "=" in w], keys, (), "pfbench claims run")
    workers = int(_read_number(values, "workers", WORKERS))
    require(1 <= workers <= WORKERS, "workers", "be 1 or 2", workers, f"Set workers={WORKERS}.")
    places = _read_places(values)
    return RunRequest(
        select_plans([word for word in words if "=" not in word]),
        places["results_dir"],
        places["reports_dir"],
        3600 * _read_number(values, "hours", math.inf),
        workers,
        values.get("readings", ""),
        values.get("dry") == "true",
        values.get("uncommitted") == "true",
    )


def decide_request(request: RunRequest) -> tuple[ClaimRuns, Decisions]:
    """Read the stored runs, and decide all claims of the papers of a request: those of a paper are one family."""
    from pfbench.claims.claim_runs import ClaimRuns, decide_claims

    runs = ClaimRuns.read(Path(request.results), Path(request.reports))
    return runs, decide_claims(select_plans([plan.claim.paper for plan in request.plans]), runs)


def list_prices(request: RunRequest) -> list[ClaimPrice]:
    """List what the claims of a request lack."""
    from pfbench.claims.run_claims import price_claims

    runs, decisions = decide_request(request)
    return _restrict(price_claims(request.plans, runs, decisions), request.readings)


def run_stage(prices: Sequence[ClaimPrice], request: RunRequest, seconds: float) -> int:
    """Run the jobs of a stage and print each; returns the number of faults."""
    from pfbench.claims.run_claims import may_refuse, merge_tasks, run_tasks

    tasks = merge_tasks([t for price in prices for t in price.tasks], select_plans(()))
    faults = 0
    ended = run_tasks(tasks, request.results, request.workers, seconds)
    for count, (task, record) in enumerate(ended, 1):
        print(f"[{count}/{len(tasks)}] {_describe_task(task, record)}", flush=True)
        faults += bool(record.failed) and not may_refuse(task)
    return faults


def select_plans(ids: Sequence[str]) -> list[ClaimPlan]:
    """Select claims by id or number of a paper; all without a word."""
    from pfbench.claims.claim_lines import read_plans

    plans = read_plans()
    names = {plan.claim.id for plan in plans} | {plan.claim.paper for plan in plans}
    if wrong := [name for name in ids if name not in names]:
        raise ValueError(
            f"ID must be a claim such as C001-7 or a paper such as 001, got {wrong[0]}. List them: pfbench claims run dry=true"
        )
    return [plan for plan in plans if not ids or {plan.claim.id, plan.claim.paper} & set(ids)]


def _read_places(values: Mapping[str, str]) -> Mapping[str, str]:
    """Read the folders of results and reports."""
    composed = compose([f"{key}={values[key]}" for key in _PLACES if key in values]).values
    return {key: str(composed[key]) for key in _PLACES}


def _read_number(values: Mapping[str, str], key: str, default: float) -> float:
    """Read a positive number."""
    try:
        number = float(values.get(key, default))
    except ValueError:
        number = math.nan
    if not number > 0:
        raise ValueError(f"{key} must be a positive number, got {values[key]}. Set {key}=2.")
    return number


def _restrict(prices: Sequence[ClaimPrice], readings: str) -> list[ClaimPrice]:
    """Select the jobs of some readings; all if none is named."""
    if not readings:
        return list(prices)
    endings = tuple(f"={name}" for name in readings.split(","))
    restricted = [
        price._replace(tasks=tuple(t for t in price.tasks if t.cell[0].endswith(endings)))
        for price in prices
    ]
    return sorted((price for price in restricted if price.tasks), key=lambda price: price.seconds)


def print_plan(prices: Sequence[ClaimPrice]) -> None:
    """Print what runs next and its price."""
    from pfbench.cli.progress import format_duration

    once: dict[tuple[object, ...], Task] = {}
    for price in prices:
        mine = [task for task in price.tasks if (task.cell, task.batch) not in once]
        once |= {(task.cell, task.batch): task for task in mine}
        extra = sum(task.seconds for task in mine)
        print(
            f"{price.plan.claim.id:8} {price.stage:7} {len(price.tasks):4} jobs, {len(mine):4} of its own, "
            f"{format_duration(extra)} more"
        )
    total = sum(task.seconds for task in once.values())
    print(f"plan: {len(prices)} claims, {len(once)} jobs, about {format_duration(total)} of processor time", flush=True)  # fmt: skip


def check_committed(is_allowed: bool) -> None:
    """Refuse runs for the record from code that is not committed."""
    from pfbench.job.plan import read_versions

    commit = read_versions()["commit"]
    require(
        not commit.endswith("-dirty") or is_allowed,
        "the code",
        "be committed before runs of the record",
        commit,
        "Commit it, or set uncommitted=true: each result then says so.",
    )


def _describe_task(task: Task, record: StoredValues) -> str:
    """Describe a job that has ended."""
    from pfbench.claims.run_claims import may_refuse
    from pfbench.cli.progress import format_duration

    name = " ".join(task.cell)
    runs = f"seed {record.seed} runs {record.first_run} to {record.first_run + record.runs - 1}"
    if record.failed:
        return f"{'refuses' if may_refuse(task) else 'failed':>7}  {name}  {record.failed}"
    return f"{format_duration(record.seconds):>7}  {name}  {runs}  {sum(record.lost)} lost"


def print_words(request: RunRequest) -> None:
    """Print the word of each claim of a request."""
    from pfbench.claims.ledger import conclude

    decisions = decide_request(request)[1]
    for line in (conclude(plan, decisions) for plan in request.plans):
        print(f"{line.plan.claim.id:8} {line.label}{f': {line.reason}' if line.reason else ''}")


def verify_claims(words: Sequence[str]) -> None:
    """Compute 20 stored cells again, and all words from the stored runs."""
    import secrets

    from pfbench.claims.claim_runs import CLAIMS_STUDY, ClaimRuns, decide_claims
    from pfbench.claims.run_claims import (
        describe_words,
        draw_records,
        find_measures,
        read_words,
        verify_records,
    )
    from pfbench.cli.compose import split_words

    values = split_words(words, ("seed", *_PLACES), (), "pfbench claims verify")
    places, plans = _read_places(values), select_plans(())
    _take_published(places)
    seed = int(values.get("seed", secrets.randbelow(10**6)))
    runs, measures = (
        ClaimRuns.read(Path(places["results_dir"]), Path(places["reports_dir"])),
        find_measures(plans),
    )
    drawn_records = draw_records(runs, seed, measures)
    print(
        f"verify: seed={seed}, {len(drawn_records)} of {len(runs.records)} stored jobs", flush=True
    )
    faults = 0
    for check in verify_records(drawn_records, measures, places["results_dir"]):
        faults += bool(check.fault)
        word = "differs" if check.fault else "equal" if check.is_equal else "agrees"
        print(
            f"{word:8} {check.runs:4} runs  {' '.join(check.record.cell)}  {check.fault}",
            flush=True,
        )
    stated = read_words(Path(places["reports_dir"]) / CLAIMS_STUDY)
    again = describe_words(decide_claims(plans, runs))
    turned = [name for name, word in stated.items() if again.get(name) != word]
    print(f"words: {len(again)} decided again, {len(turned)} differ from the page")
    if faults or turned:
        names = f": {', '.join(turned[:5])}" if turned else ""
        raise ValueError(
            f"stored runs must be those of this code, got {faults} cells and {len(turned)} words that differ{names}. "
            "Check out the commit of the runs, or run them again."
        )
