"""Stored runs of claims: a file of values for each job, and the dots of a claim from these files."""

from __future__ import annotations

import gzip
import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pfbench.claims.claim_lines import (
    TIMING,
    ClaimPlan,
    LineComparison,
    Side,
    apply_window,
    list_dots,
    make_cell,
    read_claim_data,
    read_readings,
)
from pfbench.claims.measures import METRIC_WORDS, OFF_TRACK, Measure
from pfbench.claims.words import (
    CANNOT_RUN,
    NOT_COUNTED,
    VACUOUS,
    ClaimDecision,
    ClaimSample,
    ReadingDot,
    decide_paper,
)
from pfbench.files.atomic_write import write_atomically
from pfbench.results.paper_block import read_paper_block
from pfbench.stats.error_measures import Array

CLAIMS_STUDY = "claims_2"  # folder of the jobs
SEEDS = (2001, 2002, 2003)
VALUES_SUFFIX = ".values.json"
PUBLISHED_VALUES = "values.json.gz"  # of all runs, in the folder of the page
SCREEN, CENTRE, MOVER = "screen", "centre", "mover"
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


class Series(NamedTuple):
    """Values of a cell over all of its jobs.

    Attributes:
        runs: Seed and number of each run as one number, [n], ascending.
        values: Values, [n].
        lost: Lost runs, [n].
    """

    runs: np.ndarray
    values: Array
    lost: np.ndarray


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

    def join(self, cell: Cell, name: str) -> Series | None:
        """Join the values of a quantity; None without runs."""
        records = [r for r in self.find(cell) if name in r.values and not r.failed]
        if not records:
            return None
        runs = [r.seed * 2**32 + r.first_run + np.arange(len(r.lost)) for r in records]
        lost = np.concatenate([np.array(r.lost, bool) for r in records])
        values = np.concatenate([np.array(r.values[name], dtype=np.float64) for r in records])
        # Jobs of two stages overlap, and a run that counts twice would make its claim look surer than it is.
        numbers, places = np.unique(np.concatenate(runs), return_index=True)
        return Series(numbers, values[places], lost[places])


def list_batches(paper: str, stage: str) -> list[Batch]:
    """List the runs of a cell at a stage: the first look, all seeds of a central reading, or of one that turns."""
    counts = read_claim_data()["papers"][paper]["runs"]
    first, number = counts[SCREEN], counts.get(stage, 0)
    screen = [Batch(SEEDS[0], 0, first)]
    if stage == SCREEN:
        return screen
    more = [Batch(SEEDS[0], first, number - first)] if stage == CENTRE else []
    return [*screen, *more, *(Batch(seed, 0, number) for seed in SEEDS[1:])]


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


def list_claim_cells(plan: ClaimPlan) -> dict[Cell, dict[str, Measure]]:
    """List the cells of a claim, with the quantities that it compares by name."""
    cells: dict[Cell, dict[str, Measure]] = {}
    for _, measured in list_dot_cells(plan):
        for cell, measure in measured:
            cells.setdefault(cell, {})[measure.name] = measure
    return cells


def list_dot_cells(plan: ClaimPlan) -> Iterator[tuple[str, list[tuple[Cell, Measure]]]]:
    """Yield the name of each reading that takes runs, with its cells and quantities."""
    for name, (reading, window) in list_dots(plan).items():
        if not _find_state(plan, reading):
            sides = [
                _measure_side(plan, reading, window, side)
                for comparisons in plan.parts.values()
                for c in comparisons
                for side in (c.a, c.b)
                if side.filter
            ]
            yield name, sides


def _measure_side(plan: ClaimPlan, reading: str, window: str, side: Side) -> tuple[Cell, Measure]:
    """Return the cell and the quantity of a side in a reading and window."""
    measure = apply_window(side.measure, plan.windows.get(window))
    return make_cell(plan, reading, side), measure


def _find_state(plan: ClaimPlan, reading: str) -> str:
    """Find the state of a reading that takes no runs: fitted, or decided by a proof; empty otherwise."""
    if plan.toy or reading not in read_readings(plan.claim.paper):
        return ""
    stated = read_readings(plan.claim.paper)[reading]
    if stated.grade == "fitted":
        return NOT_COUNTED
    return plan.proved if plan.proved and stated.factor not in plan.but else ""


def make_dots(
    plan: ClaimPlan, comparisons: Sequence[LineComparison], runs: ClaimRuns
) -> dict[str, ReadingDot]:
    """Make the dots of a part of a claim from the stored values."""
    dots = {}
    for name, (reading, window) in list_dots(plan).items():
        factor = _name_factor(plan, reading, window)
        state = _find_state(plan, reading)
        if state:
            dots[name] = ReadingDot(factor, state=state)
            continue
        pairs = [_join_pair(plan, reading, window, c, runs) for c in comparisons]
        if CANNOT_RUN in pairs:
            dots[name] = ReadingDot(factor, state=CANNOT_RUN)
        elif VACUOUS in pairs:
            dots[name] = ReadingDot(factor, state=VACUOUS)
        else:
            matches = [pair for pair in pairs if isinstance(pair, ClaimSample)]
            dots[name] = ReadingDot(factor, matches if len(matches) == len(pairs) else ())
    return dots


def _name_factor(plan: ClaimPlan, reading: str, window: str) -> str:
    """Name the factor of a dot."""
    if plan.toy:
        return "none"
    is_first = window == next(iter(plan.windows), "")
    return read_readings(plan.claim.paper)[reading].factor if is_first else "window"


def _join_pair(
    plan: ClaimPlan, reading: str, window: str, c: LineComparison, runs: ClaimRuns
) -> ClaimSample | str | None:
    """Join the runs of both sides, None without runs.

    `CANNOT_RUN` if a job fails, `VACUOUS` if losses of track are compared and no run of either side has one.
    """
    sides = [side for side in (c.a, c.b) if side.filter]
    measured = [_measure_side(plan, reading, window, side) for side in sides]
    if any(record.failed for cell, _ in measured for record in runs.find(cell)):
        return CANNOT_RUN
    if c.a.measure.metric == TIMING:
        return _join_times([cell for cell, _ in measured], c, runs)
    series = [runs.join(cell, measure.name) for cell, measure in measured]
    present = [s for s in series if s is not None]
    if len(present) < len(series):
        return None
    common = present[0].runs
    for s in present[1:]:
        common = np.intersect1d(common, s.runs)
    matches = iter([_select(s, common) for s in present])
    n = len(common)
    a, b = (next(matches) if side.filter else (np.full(n, side.number), np.zeros(n, bool)) for side in (c.a, c.b))  # fmt: skip
    if c.a.measure.metric == OFF_TRACK and n and max(a[0].max(), b[0].max()) <= 1.0:
        return VACUOUS
    first = read_claim_data()["papers"][plan.claim.paper]["runs"][SCREEN]
    early = common - SEEDS[0] * 2**32 < first
    return ClaimSample(c.kind, a[0], b[0], a[1], b[1], early, c.printed, describe_sides(c))


def describe_sides(c: LineComparison) -> str:
    """Describe a comparison for a reader: what is divided by what, its components and its time."""
    filtered = [side for side in (c.a, c.b) if side.filter]
    quantities = [describe_quantity(side.measure) for side in filtered]
    is_common, texts = len(set(quantities)) == 1, read_claim_data()["settings"]
    names = [
        " ".join([_name_filter(side.filter), *(texts[word] for word in side.words)])
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
    places = np.searchsorted(series.runs, runs)
    return series.values[places], series.lost[places]


def _join_times(cells: Sequence[Cell], c: LineComparison, runs: ClaimRuns) -> ClaimSample | None:
    """Join times per step that were measured in turn; the first look has a third of the rounds."""
    records = runs.find(name_timing(cells[0], cells[-1]))
    if not records:
        return None
    record = records[0]
    n = len(record.lost)
    a, b = (
        np.array(record.values[str(k)]) if side.filter else np.full(n, side.number)
        for k, side in enumerate((c.a, c.b))
    )
    lost = np.zeros(n, bool)
    early = np.arange(n) < n // 3
    return ClaimSample(c.kind, a, b, lost, lost, early, c.printed, describe_sides(c))


def decide_claims(
    plans: Sequence[ClaimPlan], runs: ClaimRuns
) -> dict[tuple[str, str, str], ClaimDecision]:
    """Decide all claims: decision by claim, column and part. A paper and column are one family."""
    families: dict[tuple[str, str], dict[tuple[str, str], dict[str, ReadingDot]]] = {}
    for plan in plans:
        for (column, portion), comparisons in plan.parts.items():
            family = families.setdefault((plan.claim.paper, column), {})
            family[plan.claim.id, portion] = make_dots(plan, comparisons, runs)
    return {
        (claim, column, portion): decision
        for (_, column), family in families.items()
        for (claim, portion), decision in _decide_family(family).items()
    }


def _decide_family(
    family: Mapping[tuple[str, str], Mapping[str, ReadingDot]],
) -> dict[tuple[str, str], ClaimDecision]:
    """Decide the parts of the claims of one paper and column."""
    matches = decide_paper({" ".join(key): dots for key, dots in family.items()})
    return {key: matches[" ".join(key)] for key in family}


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
