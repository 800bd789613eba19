"""Command `pfbench claims`: write the page of the papers' claims and verdicts."""

from __future__ import annotations

import math
import secrets
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from pfbench import job
from pfbench.claims.claim_lines import ClaimPlan, read_plans
from pfbench.claims.claim_runs import (
    CLAIMS_STUDY,
    PUBLISHED_VALUES,
    VALUES_SUFFIX,
    ClaimRuns,
    Decisions,
    StoredValues,
    decide_claims,
)
from pfbench.claims.ledger import conclude
from pfbench.claims.run_claims import (
    WORKERS,
    ClaimPrice,
    Task,
    describe_words,
    draw_records,
    find_measures,
    may_refuse,
    merge_tasks,
    price_claims,
    read_words,
    run_tasks,
    verify_records,
)
from pfbench.cli.command import Command, Option, in_range, read_flag
from pfbench.cli.progress import format_duration
from pfbench.core.parameter_checks import require
from pfbench.files.recorded_folder import copy_published, describe_missing_runs
from pfbench.job.config import compose


def report_claims(words: Sequence[str]) -> None:
    """Write the page of the claims, run them, or verify them."""
    actions = {"run": _RUN, "verify": _VERIFY}
    if words and words[0] in actions:
        actions[words[0]](words[1:])
        return
    print(f"claims: {write_claims_page(words).resolve()}")


def write_claims_page(words: Sequence[str]) -> Path:
    """Write the page of the claims.

    Returns the page.
    """
    from pfbench.claims import write_claims

    values = compose(words).values
    _take_published(Path(values["results_dir"]), Path(values["reports_dir"]))
    print("claims: the stored runs decide all claims, which takes about a minute", flush=True)
    return write_claims(values["results_dir"], values["reports_dir"])


def _take_published(results: Path, reports: Path) -> None:
    """Copy the published values of the claims to the folder of the page, if there are none of the user's own."""
    if not any((results / CLAIMS_STUDY).glob(f"*{VALUES_SUFFIX}")):
        copy_published(reports / CLAIMS_STUDY, PUBLISHED_VALUES)
        print(describe_missing_runs(), end="")


class SelectedClaims(NamedTuple):
    """Claims, with the folders of their runs.

    Attributes:
        plans: Claims.
        results: Folder of the results.
        reports: Folder of the page, whose runs are not run again.
    """

    plans: Sequence[ClaimPlan]
    results: Path
    reports: Path

    @classmethod
    def from_words(cls, words: Sequence[str]) -> SelectedClaims:
        """Select claims by id or number of a paper, all without such a word, and read the folders."""
        names = [word for word in words if "=" not in word]
        values = compose([word for word in words if "=" in word]).values
        return cls(select_plans(names), Path(values["results_dir"]), Path(values["reports_dir"]))

    def decide(self) -> tuple[ClaimRuns, Decisions]:
        """Read the stored runs, and decide the claims."""
        runs = ClaimRuns.read(self.results, self.reports)
        return runs, decide_claims(self.plans, runs)

    def list_prices(self) -> list[ClaimPrice]:
        """List what the next looks of the claims lack."""
        return price_claims(self.plans, *self.decide())

    def print_words(self) -> None:
        """Print the word of each claim."""
        decisions = self.decide()[1]
        for line in (conclude(plan, decisions) for plan in self.plans):
            print(f"{line.plan.claim.id:8} {line.label}{f': {line.reason}' if line.reason else ''}")


def select_plans(ids: Sequence[str]) -> list[ClaimPlan]:
    """Select claims by id or number of a paper; all without a word."""
    plans = read_plans()
    names = {plan.claim.id for plan in plans} | {plan.claim.paper for plan in plans}
    wrong = [name for name in ids if name not in names]
    remedy = "List them: pfbench claims run dry=true"
    require(not wrong, "ID", "be a claim such as C001-7 or a paper such as 001", "".join(wrong[:1]), remedy)  # fmt: skip
    return [plan for plan in plans if not ids or {plan.claim.id, plan.claim.paper} & set(ids)]


def run_claims(
    words: Sequence[str], hours: float, workers: int, dry: bool, uncommitted: bool
) -> None:
    """Run the cheapest undecided claims first, look by look."""
    claims = SelectedClaims.from_words(words)
    end, faults = time.monotonic() + 3600 * hours, 0
    while prices := claims.list_prices():
        print_plan(prices)
        remaining = end - time.monotonic()
        if dry or remaining <= 0 or faults:
            break
        check_committed(uncommitted)
        stage = [p for p in prices if (p.draws, p.stage) == (prices[0].draws, prices[0].stage)]
        faults += run_stage(stage, claims.results, workers, remaining)
    if not dry:
        claims.print_words()
    if faults:
        raise RuntimeError(
            f"all jobs must run but those of forms that refuse, got {faults} errors. The lines above give the reasons. "
            "Correct them, and repeat the command."
        )


def run_stage(prices: Sequence[ClaimPrice], results: Path, workers: int, seconds: float) -> int:
    """Run the jobs of a stage and print each; returns the number of faults."""
    tasks = merge_tasks([t for price in prices for t in price.tasks], select_plans(()))
    faults = 0
    for count, (task, record) in enumerate(run_tasks(tasks, str(results), workers, seconds), 1):
        print(f"[{count}/{len(tasks)}] {_describe_task(task, record)}", flush=True)
        faults += bool(record.failed) and not may_refuse(task)
    return faults


def print_plan(prices: Sequence[ClaimPrice]) -> None:
    """Print what runs next and its price."""
    once: dict[tuple[object, ...], Task] = {}
    for price in prices:
        mine = [task for task in price.tasks if (task.cell, task.batch) not in once]
        once |= {(task.cell, task.batch): task for task in mine}
        extra = sum(task.seconds for task in mine)
        print(
            f"{price.plan.claim.id:8} {price.draws:3} draws, {price.stage:5} runs {len(price.tasks):4} jobs, {len(mine):4} of its own, "
            f"{format_duration(extra)} more"
        )
    total = sum(task.seconds for task in once.values())
    print(f"plan: {len(prices)} claims, {len(once)} jobs, about {format_duration(total)} of processor time", flush=True)  # fmt: skip


def check_committed(is_allowed: bool) -> None:
    """Refuse runs for the record from code that is not committed."""
    commit = job.read_versions()["commit"]
    require(
        not commit.endswith("-dirty") or is_allowed,
        "the code",
        "be committed before runs of the record",
        commit,
        "Commit it, or set uncommitted=true: each result then says so.",
    )


def _describe_task(task: Task, record: StoredValues) -> str:
    """Describe a job that has ended."""
    name = " ".join(task.cell)
    runs = f"seed {record.seed} runs {record.first_run} to {record.first_run + record.runs - 1}"
    if record.failed:
        return f"{'refuses' if may_refuse(task) else 'failed':>7}  {name}  {record.failed}"
    return f"{format_duration(record.seconds):>7}  {name}  {runs}  {sum(record.lost)} lost"


def verify_claims(words: Sequence[str], seed: int | None) -> None:
    """Compute 20 stored cells again, and all words from the stored runs."""
    claims = SelectedClaims.from_words(words)
    _take_published(claims.results, claims.reports)
    seed = secrets.randbelow(10**6) if seed is None else seed
    measures = find_measures(claims.plans)
    runs, decisions = claims.decide()
    records = draw_records(runs, seed, measures)
    print(f"verify: seed={seed}, {len(records)} of {len(runs.records)} stored jobs", flush=True)
    faults = 0
    for check in verify_records(records, measures, str(claims.results)):
        faults += bool(check.fault)
        word = "differs" if check.fault else "equal" if check.is_equal else "agrees"
        cell = " ".join(check.record.cell)
        print(f"{word:8} {check.runs:4} runs  {cell}  {check.fault}", flush=True)
    stated, again = read_words(claims.reports / CLAIMS_STUDY), describe_words(decisions)
    turned = [name for name, word in stated.items() if again.get(name) != word]
    print(f"words: {len(again)} decided again, {len(turned)} differ from the page")
    names = f": {', '.join(turned[:5])}" if turned else ""
    require(
        not (faults or turned),
        "stored runs",
        "be those of this code",
        f"{faults} cells and {len(turned)} words that differ{names}",
        "Check out the commit of the runs, or run them again.",
    )


_PLACES = ("results_dir", "reports_dir")
_RUN = Command(
    run_claims,
    "pfbench claims run [ID ...] [hours=H] [dry=true]\n\n  OPTIONS",
    options={
        "hours": Option("2", "starts no job after this time; repeat the command to resume", in_range("(0, inf]"), math.inf),
        "workers": Option("2", "processes, at most two", in_range(f"whole [1, {WORKERS}]")),
        "dry": Option("true", "prints the plan only", read_flag, default=False),
        "uncommitted": Option("true", "runs from code that is not committed, and says so in each result", read_flag, default=False),
    },
    keys=_PLACES,
    takes_names=True,
)  # fmt: skip
_VERIFY = Command(
    verify_claims,
    "pfbench claims verify [seed=N]\n\n  OPTIONS",
    options={"seed": Option("1", "of the cells that are drawn; printed", in_range("whole [0, inf)"), None)},
    keys=_PLACES,
)  # fmt: skip
COMMAND = Command(
    report_claims,
    f"""\
pfbench claims [key=value ...]
pfbench claims run [ID ...] [key=value ...]
pfbench claims verify [key=value ...]

Write the page of the 88 claims of the five papers, with a word on each over all plausible
readings of its paper, from the published runs. A claim without runs is open, with the price of its runs.

  pfbench claims
  pfbench claims run                     a plan with prices, then the cheapest undecided claims first
  pfbench claims run C001-7              one claim; 001 is all claims of a paper
  pfbench claims run 003 hours=2
  pfbench claims run dry=true            the plan only
  pfbench claims verify                  computes 20 stored cells again, and all words, in about five minutes.
                                         Runs must be equal; those of particles, which may amplify rounding,
                                         agree in the mean. Cells of more than 3 s a run are not drawn

  results_dir=FOLDER         the runs are in RESULTS/{CLAIMS_STUDY}
  reports_dir=FOLDER         the page is REPORTS/{CLAIMS_STUDY}/index.html; its runs are not run again

{_RUN.format_help()}

{_VERIFY.format_help()}""",
)
