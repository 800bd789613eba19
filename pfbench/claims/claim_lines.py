"""Data of the claims: lines that compare filters in the readings of a paper, and proofs without runs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from pfbench.claims.claim_list import PrintedClaim, read_printed_claims
from pfbench.claims.measures import Measure
from pfbench.job.readings import CENTRAL_READING, JOINER, read_reading_table

_DATA = Path(__file__).with_name("claim_lines.yaml")
PUBLISHED, REPAIRED = "published", "repaired"
COLUMNS = (PUBLISHED, REPAIRED)
DIRECTION_PART, SIZE_PART, BESIDE_PART = (
    "direction",
    "size",
    "beside",
)
MUCH, WINDOW = "much", "window"  # factors of a claim that take no runs of their own
MUCH_BETTER, BETTER = "much better", "better"
DRAWS, JOINT_SEED = 200, 3001  # joint readings of a claim, and the seed of their levels and runs
TIMING = "seconds_per_step"
METHOD = "method"
_SIDE_KEYS = {"metric": "metric", "group": "group", "component": "component", "from": "start", "to": "end", "settled": "settled"}  # fmt: skip
_LISTS = ("a", "b", "group", "component", "metric", "settled", "worlds")


class Side(NamedTuple):
    """Side of a comparison: a filter with settings and words of its own, or a number.

    Attributes:
        measure: Quantity.
        filter: Name of the filter; empty for a number.
        words: Words of its jobs beyond those of the reading.
        number: Value of a number.
        world: Words of one of several worlds in which the comparison must hold.
    """

    measure: Measure
    filter: str = ""
    words: tuple[str, ...] = ()
    number: float = math.nan
    world: tuple[str, ...] = ()


class LineComparison(NamedTuple):
    """Comparison of a claim in which a is the smaller side.

    Attributes:
        kind: Kind: better, much better, same, level, size or within.
        a: Smaller side.
        b: Larger side.
        printed: Printed ratio of the kind "size", or largest one of the kind "within".
    """

    kind: str
    a: Side
    b: Side
    printed: float = math.nan


class ClaimPoint(NamedTuple):
    """Reading of a claim: a level of each factor at once.

    Attributes:
        name: Name: that of the one level that is not central, or of a joint draw.
        levels: Level of each factor of the claim.
        draw: Number of the joint draw; -1 for a reading in a list, with one level changed.
    """

    name: str
    levels: Mapping[str, str]
    draw: int = -1


class ClaimPlan(NamedTuple):
    """Claim with the comparisons that decide it.

    Attributes:
        claim: Claim.
        parts: Comparisons by column and part, "direction" or "size".
        windows: First and last time by name; the first is central. Empty for the times of the measures.
        toy: Words of a world without readings; empty for the worlds of the paper.
        word: Word without runs; empty where runs decide.
        why: Reason of that word.
        proved: Outcome of a proof in all readings but those of `but`; empty without.
        but: Factors whose readings run although there is a proof.
        without: Levels in which a is b, which say nothing.
    """

    claim: PrintedClaim
    parts: Mapping[tuple[str, str], tuple[LineComparison, ...]]
    windows: Mapping[str, tuple[float, float]]
    toy: tuple[str, ...] = ()
    word: str = ""
    reason: str = ""
    proved: str = ""
    but: tuple[str, ...] = ()
    without: tuple[str, ...] = ()

    @property
    def is_drawn(self) -> bool:
        """Return whether joint readings are drawn: not in one world of this project, and not for times."""
        comparisons = [c for parts in self.parts.values() for c in parts]
        return not self.toy and all(c.a.measure.metric != TIMING for c in comparisons)


@cache
def read_claim_data() -> Mapping[str, Any]:
    """Read the file of the claims: settings of papers, lines of claims, texts of settings, the seven methods, corrections."""
    return yaml.safe_load(_DATA.read_text(encoding="utf-8"))


def read_plans() -> list[ClaimPlan]:
    """Read what decides each of the 88 claims, in their order."""
    lines = read_claim_data()["claims"]
    return [_parse_plan(claim, lines[claim.id]) for claim in read_printed_claims()]


def _parse_plan(claim: PrintedClaim, entry: Mapping[str, Any]) -> ClaimPlan:
    """Parse the entry of a claim."""
    rows = entry.get("compare", ())
    forms = entry.get("method", read_claim_data()["papers"][claim.paper]["method"])
    has_forms = METHOD in str(rows) or "form" in str(rows)
    parts: dict[tuple[str, str], tuple[LineComparison, ...]] = {}
    for column in forms if has_forms else (PUBLISHED,):
        entries_read = [
            item for row in rows if row.get("form", column) == column
            for item in _expand(claim, row, forms[column])
        ]  # fmt: skip
        for portion in (DIRECTION_PART, SIZE_PART, BESIDE_PART):
            members = tuple(item for name, item in entries_read if name == portion)
            parts |= {(column, portion): members} if members else {}
    windows = {name: (float(a), float(b)) for name, (a, b) in entry.get("windows", {}).items()}
    proved = entry.get("proved", {"outcome": "", "but": ()})
    texts = (tuple(entry.get("toy", ())), entry.get("word", ""), entry.get("why", ""))
    but, without = tuple(proved["but"]), tuple(entry.get("without", ()))
    return ClaimPlan(claim, parts, windows, *texts, proved["outcome"], but, without)


def _expand(
    claim: PrintedClaim, row: Mapping[str, Any], method: str
) -> Iterator[tuple[str, LineComparison]]:
    """Yield part and comparison of all values of an entry."""
    for more in row.get("rows", ({},)):
        merged = {**row, **more}
        pairs = merged.get("pairs", ((merged.get("a"), merged.get("b")),))
        for a, b in pairs:
            full = {**merged, "a": a, "b": b}
            lists = {key: full[key] for key in _LISTS if isinstance(full.get(key), list)}
            for values in product(*lists.values()):
                single = {**full, **dict(zip(lists, values, strict=True))}
                yield from _parse_comparison(claim, single, method)


def _parse_comparison(
    claim: PrintedClaim, row: Mapping[str, Any], method: str
) -> Iterator[tuple[str, LineComparison]]:
    """Yield the direction of an entry, and its size if a number is printed."""
    keys = {name: row[key] for key, name in _SIDE_KEYS.items() if key in row}
    of_b = {name: row[f"b_{key}"] for key, name in _SIDE_KEYS.items() if f"b_{key}" in row}
    world = (row["worlds"],) if "worlds" in row else ()
    a = _parse_side(row["a"], _make_measure(keys), method, world)
    b = _parse_side(row["b"], _make_measure({**keys, **of_b}), method, world)
    if row.get("beside"):
        yield BESIDE_PART, LineComparison(row.get("kind", claim.kind), a, b)
        return
    if row.get("level"):
        yield SIZE_PART, LineComparison("level", a, b)
        return
    if "within" in row:
        yield DIRECTION_PART, LineComparison("within", a, b, float(row["within"]))
        return
    kind = row.get("kind", "better" if claim.kind == "number" else claim.kind)
    yield DIRECTION_PART, LineComparison(kind, a, b)
    if "printed" in row:
        yield SIZE_PART, LineComparison("size", a, b, float(row["printed"]))


def _make_measure(keys: Mapping[str, Any]) -> Measure:
    """Make a measure with numbers as floats."""
    numbers: dict[str, Any] = {k: float(keys[k]) for k in ("start", "end", "settled") if k in keys}
    return Measure(**{**keys, **numbers})


def _parse_side(text: Any, measure: Measure, method: str, world: tuple[str, ...]) -> Side:
    """Parse a side: a number, or a filter with settings in brackets and words after @."""
    if not isinstance(text, str):
        return Side(measure, number=float(text))
    head, *words = text.split(" @")
    name, pairs = _split_settings(head)
    name = method if name == METHOD else name
    return Side(measure, name, (*pairs, *words), world=world)


def _split_settings(text: str) -> tuple[str, tuple[str, ...]]:
    """Split `name[key=value,+new=value]` into the name of a filter and words that set its keys."""
    name, _, settings = text.removesuffix("]").partition("[")
    words = [setting for setting in settings.split(",") if setting]
    return name, tuple(
        f"+filter.{word[1:]}" if word.startswith("+") else f"filter.{word}" for word in words
    )


def list_factor_levels(plan: ClaimPlan) -> dict[str, list[str]]:
    """List the levels of each factor of a claim, the central one first, without fitted ones.

    Factors without runs are the window, and how much better "much" is.
    """
    options: dict[str, list[str]] = {}
    for name, row in () if plan.toy else read_reading_table(plan.claim.paper).items():
        if row["factor"] in plan.claim.factors and row["class"] != "fitted" and name not in plan.without:  # fmt: skip
            options.setdefault(row["factor"], [CENTRAL_READING]).append(name)
    if plan.windows:
        options[WINDOW] = list(plan.windows)
    if any(c.kind == MUCH_BETTER for parts in plan.parts.values() for c in parts):
        options[MUCH] = [MUCH_BETTER, BETTER]
    return options


def list_main_parts(plan: ClaimPlan) -> list[tuple[str, str]]:
    """List column and part that give the words of a claim: its direction, or its size if it has none."""
    return [
        (column, DIRECTION_PART if (column, DIRECTION_PART) in plan.parts else SIZE_PART)
        for column in dict.fromkeys(column for column, _ in plan.parts)
    ]


def list_kinds(c: LineComparison) -> tuple[str, ...]:
    """List the kinds that a comparison is read as: "much" is a fifth, or any amount."""
    return (MUCH_BETTER, BETTER) if c.kind == MUCH_BETTER else (c.kind,)


def list_points(plan: ClaimPlan) -> list[ClaimPoint]:
    """List the readings of a claim: the central one, those with one level changed, and the joint draws in their order.

    The level of a factor in a draw is uniform, and the same for all claims of a paper that have the factor.
    """
    options = list_factor_levels(plan)
    centre = {factor: levels[0] for factor, levels in options.items()}
    changed = [
        ClaimPoint(_name_level(factor, level), {**centre, factor: level})
        for factor, levels in options.items()
        for level in levels[1:]
    ]
    draws = [
        {f: levels[int(_draw_factor(plan.claim.paper, f)[k] * len(levels))] for f, levels in options.items()}
        for k in range(DRAWS if plan.is_drawn and options else 0)
    ]  # fmt: skip
    joint = [ClaimPoint(f"draw {k + 1}", levels, k) for k, levels in enumerate(draws)]
    return [ClaimPoint(CENTRAL_READING, centre), *changed, *joint]


def _name_level(factor: str, level: str) -> str:
    """Name a reading with one level changed."""
    return f"{factor} {level}" if factor in (WINDOW, MUCH) else level


@cache
def _draw_factor(paper: str, factor: str) -> np.ndarray:
    """Draw the numbers in [0, 1) that choose the levels of a factor, [DRAWS]."""
    return np.random.default_rng([JOINT_SEED, int(paper), *factor.encode()]).random(DRAWS)


def make_cell(plan: ClaimPlan, point: ClaimPoint, side: Side) -> tuple[str, ...]:
    """Make the words of the jobs of a side in a reading, without seed, runs and folder.

    Levels that do not concern the filter are left out, so that claims share jobs.
    """
    paper = plan.claim.paper
    if plan.toy:
        return (*plan.toy, f"filter={side.filter}", *side.words, *side.world)
    settings, rows = read_claim_data()["papers"][paper], read_reading_table(paper)
    concerned = [
        name
        for name in sorted({*point.levels.values()} & rows.keys() - {CENTRAL_READING})
        if side.filter in settings.get("only", {}).get(name, rows[name]["filters"])
        or (name not in settings.get("only", {}) and rows[name].keys() & {"use", "set"})
    ]
    text = side.filter
    for name in concerned:
        text = settings.get("instead", {}).get(name, {}).get(side.filter, text)
    name, words = _split_settings(text)
    reading = JOINER.join(concerned) or CENTRAL_READING
    return (f"reading/{paper}={reading}", f"filter={name}", *words, *side.words, *side.world)


# --------------------------------------------------------------------------------------------------
# Proofs on the papers, read from proofs.yaml: statements without runs and margins, each with its premise.

_PROOFS = Path(__file__).with_name("proofs.yaml")


@dataclass(frozen=True)
class Proof:
    """Statement on a paper that a test shows in less than a second.

    Attributes:
        id: Identifier, as "P1".
        paper: Number of the paper.
        claims: Claims that it decides, alone or in one scope.
        equation: Equation or sentence of the paper.
        shows: Line for the page.
        test: Name of the test, in tests/claims/test_proofs.py.
    """

    id: str
    paper: str
    claims: Sequence[str]
    equation: str
    shows: str
    test: str


def read_proofs() -> list[Proof]:
    """Read the proofs.

    Returns:
        The proofs, in the order of the file.
    """
    return [Proof(**row) for row in yaml.safe_load(_PROOFS.read_text(encoding="utf-8"))]
