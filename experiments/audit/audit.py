"""Public comparative claims about navigation programs, decided by the rules of a study: docs/audit.md and docs/audit.svg.

claims.toml has the words, the tables and their sources. A drive is one recording; the loss of a drive is the mean of the logarithms
of its errors, as in `pfbench judge`. Each pair of programs that a claim names is a family of its own, so a claim holds where all its pairs do.

Run: python experiments/audit/audit.py; --frames FOLDER measures the trajectories of a spike test before.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pfbench.files import markdown_head, markdown_row
from pfbench.report import FigureSpec, draw_figure, line_styles
from pfbench.results import (
    MIN_RUNS,
    Verdict,
    compare,
    count_needed_runs,
    decide,
    format_with_interval,
)

FOLDER = Path(__file__).parent
CLAIMS, FRAMES = FOLDER / "claims.toml", FOLDER / "frames.json"
PAGE = FOLDER.parents[1] / "docs" / "audit.md"
PICTURE = PAGE.with_suffix(".svg")
FAILED, ABSENT, MEAN = "x", "-", "mean"
PLANNED_RATIO, LEVEL, MARGIN = 0.8, 0.05, math.log(1.05)
Row = tuple[str, dict[str, float]]
STATES = ("holds", "holds in part", "not decided", "too few drives", "contradicted")
BLUE, ORANGE, GREEN = (style.colour for style in line_styles("abc").values())  # of no method
COLOURS = dict(zip(STATES, (GREEN, BLUE, "#777777", "#999999", ORANGE), strict=True))
TITLES = {
    "holds": "Claims that hold",
    "holds in part": "Claims that hold in part",
    "not decided": "Claims that their tables do not decide",
    "too few drives": "Claims with fewer than ten drives",
    "contradicted": "Claims that their tables contradict",
}
RANGE = (0.04, 4.0)  # of the axis of the picture
FAR = 1e4  # log ratio of a failed drive where a finite one is required
MOST_DRIVES = 10_000


class Pair(NamedTuple):
    """Verdict on a pair of programs of a claim.

    Attributes:
        verdict: Verdict of the pair alone.
        differences: Log ratios of the drives, [n].
        smaller: Number of drives in which the first program has the smaller error.
        groups: Number of groups of drives in which its median ratio is below 1, and of all groups; 0 without groups.
        agrees: Whether the verdict has the word of the claim.
    """

    verdict: Verdict
    differences: np.ndarray
    smaller: int
    groups: tuple[int, int]
    agrees: bool


class Audited(NamedTuple):
    """A claim with its verdicts.

    Attributes:
        claim: Entry of claims.toml.
        pairs: Verdicts of its pairs.
        state: One of `STATES`.
    """

    claim: dict[str, Any]
    pairs: list[Pair]
    state: str

    @property
    def weakest(self) -> Pair:
        """Pair with an interval that agrees least with the words."""
        is_equal = self.claim["says"] == "equal"
        v = {id(p): p.verdict for p in self.pairs}

        def rank(pair: Pair) -> tuple[bool, bool, float]:
            low, high = v[id(pair)].low, v[id(pair)].high
            end = max(high, 1 / low if low else math.inf) if is_equal else high
            return bool(math.isfinite(end)), not pair.agrees, end if math.isfinite(end) else 0.0

        return max(self.pairs, key=rank)


def split_rows(entry: Mapping[str, Any]) -> list[list[str]]:
    return [[cell.strip() for cell in row.split("|")] for row in entry["rows"].strip().splitlines()]


def read_number(text: str) -> float:
    return {FAILED: math.inf, ABSENT: math.nan}.get(text) or float(text)


def read_rows(entry: Mapping[str, Any]) -> list[Row]:
    """Read the rows of a table: the drive, and the errors by program, infinite if it failed and NaN if it was not run."""
    head, *rows = split_rows(entry)
    first = 1 + ("phone" in head)  # names before the errors are the drive, and a phone in it
    return [
        (row[0], dict(zip(head[first:], map(read_number, row[first:]), strict=True)))
        for row in rows
        if row[0] != MEAN
    ]


def list_losses(rows: Sequence[Row], a: str, b: str) -> tuple[list[str], np.ndarray]:
    """List the drives that both programs ran, and their losses [n, 2]: the mean of the logarithms of their errors."""
    groups: dict[str, list[list[float]]] = {}
    for drive, errors in rows:
        both = [errors[a], errors[b]]
        if not np.isnan(both).any():
            groups.setdefault(drive, []).append([math.log(value) for value in both])
    return list(groups), np.array([np.mean(values, axis=0) for values in groups.values()])


def list_pairs(claim: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [(a, b) for a, b in claim.get("pairs", ())] or [(claim["a"], b) for b in claim["b"]]


def decide_pair(claim: Mapping[str, Any], rows: Sequence[Row], a: str, b: str) -> Pair:
    """Decide a pair of programs alone, by the drives that both ran."""
    drives, losses = list_losses(rows, a, b)
    effect = compare((a, losses[:, 0]), (b, losses[:, 1]), "drive")
    (verdict,), d = decide([effect], MARGIN, LEVEL), effect.differences
    groups: dict[str, list[float]] = {}
    for drive, value in zip(drives, d, strict=True) if claim["groups"] else ():
        match = re.match(claim["groups"], drive)
        groups.setdefault(match[0] if match else drive, []).append(value)
    below = sum(float(np.median(values)) < 0 for values in groups.values())
    agrees = verdict.word in (("equal", "identical") if claim["says"] == "equal" else ("better",))
    return Pair(verdict, d, int((d < 0).sum()), (below, len(groups)), agrees)


def audit(claim: dict[str, Any], rows: Sequence[Row]) -> Audited:
    """Decide a claim: it holds if all its pairs do, in part if some do and none has the contrary word."""
    pairs = [decide_pair(claim, rows, a, b) for a, b in list_pairs(claim)]
    count = sum(pair.agrees for pair in pairs)
    if any(not p.agrees and p.verdict.word != "not decided" for p in pairs):
        return Audited(claim, pairs, "contradicted")
    if max(p.verdict.n for p in pairs) < MIN_RUNS:
        return Audited(claim, pairs, "too few drives")
    state = "holds" if count == len(pairs) else "holds in part" if count else "not decided"
    return Audited(claim, pairs, state)


def read_audit() -> tuple[dict[str, Any], list[Audited]]:
    """Read claims.toml and decide its claims, in the order of `STATES`."""
    entries = tomllib.loads(CLAIMS.read_text())
    tables = {key: read_rows(entry) for key, entry in entries["tables"].items()}
    audited = [audit(claim, tables[claim["table"]]) for claim in entries["claims"]]
    return entries, sorted(audited, key=lambda one: STATES.index(one.state))


def count_survivors(audited: Sequence[Audited]) -> tuple[int, int, int]:
    """Count the pairs that agree with their claim, those that do in one family of all pairs, and all."""
    pairs = [pair for one in audited for pair in one.pairs]
    zeros = [np.zeros(len(pair.differences)) for pair in pairs]
    verdicts = decide([compare((p.verdict.a, p.differences), (p.verdict.b, z), "drive") for p, z in zip(pairs, zeros, strict=True)], MARGIN, LEVEL)  # fmt: skip
    kept = sum(v.word == p.verdict.word for v, p in zip(verdicts, pairs, strict=True) if p.agrees)
    return sum(pair.agrees for pair in pairs), kept, len(pairs)


# --------------------------------------------------------------------------------------------------
# What would decide a pair.


def name_number(count: float) -> str:
    """Name a number of drives: no verdict has fewer than `MIN_RUNS`."""
    return "more than 10 000" if count > MOST_DRIVES else f"{max(math.ceil(count), MIN_RUNS)}"


def describe_needs(pair: Pair, says: str) -> str:
    """Say with how many drives of the same spread a pair would be decided."""
    v, name = pair.verdict, f"{pair.verdict.a} and {pair.verdict.b}"
    if v.n < MIN_RUNS:
        more = MIN_RUNS - v.n
        return f"{name}: {more} further drive{'s' if more > 1 else ''} at least."
    if says == "equal":
        width, count = max(v.high, 1 / v.low), v.n * (math.log(v.high / v.low) / 2 / MARGIN) ** 2  # fmt: skip
        size = f"{100 * (width - 1):.0f} %" if width < 2 else f"a factor of {width:.0f}"
        return f"{name}: equal within {size} by this table; equal within 5 % with {name_number(count)} drives."
    d = np.clip(pair.differences, -FAR, FAR)
    if math.isnan(v.ratio):
        return f"{name}: the drives that one program loses decide more than their errors."
    planned = f"a ratio of {PLANNED_RATIO:g} would be shown with {name_number(count_needed_runs(d, PLANNED_RATIO, LEVEL / 2))} drives"
    if v.ratio >= 1:
        return f"{name}: the ratio is not below 1; {planned}."
    needed = count_needed_runs(d, v.ratio, LEVEL / 2)
    if needed <= v.n:
        cut = v.n // 5  # drives that the trimmed mean leaves out at each end
        low, high = (f"{math.exp(end):.2g}" for end in np.sort(d)[[cut, v.n - cut - 1]])
        return f"{name}: for ranks and signs the drives suffice; the trimmed mean needs ratios of less spread, those of its middle drives reach from {low} to {high}."
    return f"{name}: the ratio of the table would be shown with {name_number(needed)} drives, {v.n} were run; {planned}."


# --------------------------------------------------------------------------------------------------
# Frames of the spike test.


def measure_turn(track: np.ndarray, reference: np.ndarray) -> tuple[float, float, float]:
    """Measure the turn about the vertical that fits a track best to a reference.

    Returns the angle in degrees, and the horizontal RMS before and after turn and shift, m.
    Shapes: [T, 3] and [R, 3], each of time, x and y.
    """
    k = np.searchsorted(reference[:, 0], track[:, 0])
    inside = (k > 0) & (k < len(reference))
    near = np.zeros(len(track), dtype=bool)
    near[inside] = reference[k[inside], 0] - reference[k[inside] - 1, 0] < 1.0  # s
    mine = track[near, 1:]
    theirs = np.stack([np.interp(track[near, 0], reference[:, 0], reference[:, i]) for i in (1, 2)], 1)  # fmt: skip
    p, q = (values - values.mean(axis=0) for values in (mine, theirs))
    angle = math.atan2(float((p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum()), float((p * q).sum()))
    c, s = math.cos(angle), math.sin(angle)
    rest = p @ np.array([[c, s], [-s, c]]) - q
    before, after = (math.sqrt(float((e**2).sum(axis=1).mean())) for e in (mine - theirs, rest))
    return math.degrees(angle), before, after


def measure_frames(folder: Path) -> dict[str, Any]:
    """Measure the turns of the two stored trajectories of the spike test, with the digests of the files."""
    names = ("ground_truth", "fusioncore_spike", "rl_ekf_spike")
    files = {name: (folder / f"{name}.tum").read_bytes() for name in names}
    tracks = {n: np.array([r.split()[:3] for r in text.decode().splitlines() if r], float) for n, text in files.items()}  # fmt: skip
    turns = {n: measure_turn(tracks[n], tracks[names[0]]) for n in names[1:]}
    return {
        "sha256": {name: hashlib.sha256(text).hexdigest() for name, text in files.items()},
        "turns": {name: [round(value, 2) for value in values] for name, values in turns.items()},
    }


def describe_frames(frames: Mapping[str, Any]) -> str:
    (_, own_before, own_after), (turn, before, after) = frames["turns"].values()
    return (
        f"The project also says that a wrong fix moves robot_localization by 93 m and FusionCore by 1 m "
        f"([page](https://github.com/manankharwar/fusioncore/blob/0ff2e26d0f12517feadeb68fc9c780a8665a27b2/benchmarks/nclt/2012-01-08/results/SPIKE_TEST.md)). "
        f"The stored trajectory of robot_localization is turned by {turn:.0f}° against the reference, and the test does not align it: its error is 105 m before the spike. "
        f"Its RMS is {before:.0f} m before turn and shift, and {after:.1f} m after. That of FusionCore is {own_before:.1f} m and {own_after:.1f} m. "
        f"A position error of a turned frame grows with the distance from the start, also without a spike. "
        "Measured with `python experiments/audit/audit.py --frames FOLDER`; frames.json has the digests of the files."
    )


# --------------------------------------------------------------------------------------------------
# Picture and page.


def draw_row(axes: Axes, y: float, one: Audited) -> None:
    """Draw the weakest pair of a claim: name, interval and ratio."""
    v, colour = one.weakest.verdict, COLOURS[one.state]
    shown = v.ratio if math.isfinite(v.ratio) else 1.0
    if v.n >= MIN_RUNS and math.isfinite(v.high):
        low, high = max(v.low, RANGE[0]), min(v.high, RANGE[1])
        axes.plot([low, high], [y, y], color=colour, lw=2.2, solid_capstyle="butt")
    axes.plot([min(max(shown, RANGE[0]), RANGE[1])], [y], "o", ms=4.8, color=colour, mec="white", mew=0.6)  # fmt: skip
    mark = "= " if one.claim["says"] == "equal" else ""
    rivals = {pair.verdict.b for pair in one.pairs}
    rival = "" if len(one.pairs) == 1 else f": {v.b if len(rivals) > 1 else v.a}"
    text = f"{v.n} drives" if v.n < MIN_RUNS else format_ratio(v)
    axes.text(RANGE[0], y - 0.42, f"{mark}{one.claim['title']}{rival}", fontsize=6.5, va="center")
    axes.text(RANGE[1], y - 0.42, text, fontsize=6.5, va="center", ha="right", color="#444444")


def draw(audited: Sequence[Audited]) -> Figure:
    """Draw ratio and interval of the weakest pair of each claim, coloured by what the table decides."""
    import seaborn  # takes a second

    figure = Figure(figsize=(3.9, 0.3 * len(audited) + 1.3), layout="constrained")
    axes = figure.subplots()
    margin = math.exp(MARGIN)
    axes.axvspan(1 / margin, margin, color="#eeeeee", lw=0)
    axes.axvline(1.0, color="#999999", lw=0.6)
    y = 0.0
    for state in filter({one.state for one in audited}.__contains__, STATES):
        members = [one for one in audited if one.state == state]
        axes.text(RANGE[0], y, f"{state}: {len(members)}", fontsize=7.5, weight="bold", va="center", color=COLOURS[state])  # fmt: skip
        for k, one in enumerate(members):
            draw_row(axes, y + 1.05 + k, one)
        y += len(members) + 1.0
    axes.set(xscale="log", xlim=RANGE, ylim=(y - 0.4, -0.6), yticks=[])
    axes.set_xticks([0.05, 0.1, 0.2, 0.5, 1, 2], ["0.05", "0.1", "0.2", "0.5", "1", "2"])
    axes.minorticks_off()
    axes.set_xlabel("error of the first program / error of the second")
    seaborn.despine(figure, left=True)
    return figure


def format_claim(one: Audited, entries: Mapping[str, Any]) -> list[str]:
    """Format the section of a claim: words, source, verdicts, what would decide, notes."""
    claim, entry = one.claim, entries["tables"][one.claim["table"]]
    source = entries["sources"][entry["source"]]
    lines = [
        f"### {claim['title']}",
        "",
        f"> {claim['words']}",
        "",
        f"[{source['name']}]({source['address']}), {source['version']}, {entry['where']} ([below](#{claim['table'].replace('_', '-')})). "
        f"{entry['metric'][0].upper()}{entry['metric'][1:]}. {claim['kind'][0].upper()}{claim['kind'][1:]}.",
        "",
        *markdown_head("pair", "word", "ratio", "smaller in", "groups", "p: ranks, trimmed mean, signs"),
        *map(format_pair, one.pairs),
        "",
    ]  # fmt: skip
    needs = [describe_needs(pair, claim["says"]) for pair in one.pairs if not pair.agrees]
    lines += ["What would decide it:", "", *(f"- {text}" for text in needs), ""] if needs else []
    lines += [f"{claim['note']}", ""] if "note" in claim else []
    for key, title in (("objection", "An author may object"), ("answer", "Answer")):
        lines += [f"**{title}.** {claim[key]}", ""] if key in claim else []
    return lines


def format_ratio(v: Verdict) -> str:
    """Format a ratio with its interval; without one below ten drives, and none where too many drives are lost."""
    if math.isnan(v.ratio):
        return "none"
    if v.n < MIN_RUNS:
        return f"{v.ratio:.2g}"
    if v.ratio < 0.1:
        return f"{v.ratio:.2g} [{v.low:.2g}, {v.high:.2g}]"
    return format_with_interval(v.ratio, v.low, v.high)


def format_pair(pair: Pair) -> str:
    """Format a verdict as a row: numbers of drives and places, ratio, the p-values of the three tests, word and reason."""
    v = pair.verdict
    tests = ", ".join("< 0.001" if p < 0.001 else f"{p:.2g}" for p in (v.p, v.evidence.p_trimmed, v.evidence.p_sign))  # fmt: skip
    reason = f"; {v.reason}" if v.reason else ""
    groups = f"{pair.groups[0]} of {pair.groups[1]}" if pair.groups[1] else "-"
    return markdown_row(
        f"{v.a} / {v.b}", f"**{v.word}**", format_ratio(v), f"{pair.smaller} of {v.n}", groups,
        ("none" if v.n < MIN_RUNS else tests) + reason,
    )  # fmt: skip


def format_table(key: str, entry: Mapping[str, Any], source: Mapping[str, str]) -> list[str]:
    """Format a table as printed, with its source; a long one is in claims.toml only."""
    head, *rows = split_rows(entry)
    shown = [*markdown_head(*head), *(markdown_row(*r) for r in rows)]
    if len(rows) > 40:
        shown = [f"{len(rows)} rows: `experiments/audit/claims.toml`, table `{key}`."]
    return [
        f"### {key.replace('_', ' ')}",
        "",
        f"[{source['name']}]({source['address']}), {source['version']}; {entry['where']}; {entry['metric']}; {source['licence']}.",
        "",
        *shown,
        "",
    ]


INTRODUCTION = """# Public claims and what their tables show

Programs for navigation are compared in public, with words such as "outperforms" and with tables of errors by drive. This page asks of {count}
such claims whether their own tables show them. They were chosen by the rule below. {dropped} entries were
read and left out, each with its reason.

**{holds} hold, {part} hold in part, {open} are not decided by their tables, {few} have too few drives,
and {contrary} shown to be the reverse.**

![Ratio of the errors and its interval for the weakest pair of each claim, coloured by what the table decides](audit.svg)

A row is a claim; after a colon, the rival with an interval that agrees least with its words, if there are several. Left of 1 the first program has the smaller errors. The bar is
the 95 % interval, cut at the ends of the axis. The grey band is 5 %. `=` marks claims that two programs are on a par. A claim holds if it does
against all rivals.

"Not decided" does not mean wrong. The printed counts, such as 10 of 12, are right unless a note says otherwise.
The question here is another one: does the table show a smaller error in most other drives of this kind?

## How the claims were chosen

The rule was written before the verdicts. One claim, of FusionCore, came with the task of this page, with its verdict known. Rule, list and verdicts
entered the history of the repository in one commit, so the history does not prove their order.

- Searched: {searched}. Data sets: {data_sets}.
- A claim needs printed words that compare named programs, a table of errors by drive of these programs, both read, and a public address.
- Ten drives or more. Two claims with fewer are kept, since no other ones were read for RTK and for particle filters against an EKF.
- At most three claims from one source, near its main tables; which of them is our choice. A variant of a program by the same authors is compared
  only where the words name it.

[Left out](#left-out) has the others. A source without a table by drive is not here, so this is a sample of the sources that print most.

## How a table is read

- **Unit.** A drive: one recording, a flight or a walk. Several phones in one drive are one drive, by the mean of the logarithms of their errors.
- **Verdict.** The rules of [Decisions of a study](statistics.md), as in `pfbench judge`: ratio of Hodges and Lehmann with its interval, and three
  tests that agree. A failed drive is worse than every other one. Below {least} drives nothing is decided.
- **Family.** Each pair is decided alone at 5 %, and a claim needs all its pairs, so no correction is due within a claim. {agree} of {pairs} pairs have
  the word of their claim. With Holm's correction over all pairs of the page {kept} keep it.
- **Places.** Drives of one data set share places, a vehicle and a season. The verdict reaches to other drives there, and to no other place. The
  column *groups* counts the groups of drives, of one place or one kind, whose median ratio is below 1; - without groups.
- **What would decide.** Drives with the spread of the table and the power of all plans of pfbench, 0.8, at the ratio of the table and at {planned:g}.
  They are for ranks and signs, and coarse: the share of eleven drives that is below 1 moves them by steps.

The same for your own table, here with the one of FusionCore:

```python
import numpy as np

from pfbench.results import compare, decide

first = np.log([{first}])
second = np.log([{second}])
effect = compare(("FusionCore", first), ("robot_localization", second), "drive")
(verdict,) = decide([effect])
print(verdict.word, [round(x, 3) for x in (verdict.ratio, verdict.low, verdict.high, verdict.p)])
assert verdict.word == "not decided"
```

"""

LIMITS = """## What this page cannot see

- Errors are used as printed: rounded, after alignment, medians or single runs. Ties of rounded numbers count as ties.
- Numbers of other programs often come from other papers, with other settings and computers. A table does not show who was tuned on its drives.
- Tables of papers were copied from their text. The test of this page holds the copied rows against the printed means, where there are any.
- Speed, memory and failures at the start are not part of the verdicts, though many of the claims are about them too.
- A claim may hold by other tables of the same source. Only the named table is read.

To make the page: `python experiments/audit/audit.py`. Words and tables: `experiments/audit/claims.toml`.
"""


def page() -> str:
    """Return the page of the stored claims."""
    entries, audited = read_audit()
    counts = [sum(one.state == state for one in audited) for state in STATES]
    agree, kept, pairs = count_survivors(audited)
    first, second = (", ".join(cells) for cells in list(zip(*split_rows(entries["tables"]["nclt"])[1:], strict=True))[1:])  # fmt: skip
    lines = INTRODUCTION.format(
        count=len(audited), dropped=len(entries["dropped"]), holds=counts[0], part=counts[1], open=counts[2], few=counts[3],
        contrary=f"{counts[4]} are" if counts[4] else "none is",
        least=MIN_RUNS, agree=agree, pairs=pairs, kept=kept, planned=PLANNED_RATIO, first=first, second=second, **entries["rule"],
    ).splitlines()  # fmt: skip
    for state in filter({one.state for one in audited}.__contains__, STATES):
        lines += ["", f"## {TITLES[state]}", ""]
        for one in audited:
            lines += format_claim(one, entries) if one.state == state else []
    lines += [
        "## Frames of a spike test",
        "",
        describe_frames(json.loads(FRAMES.read_text())),
        "",
        "## Left out",
        "",
    ]
    lines += [*markdown_head("claim", "reason"), *(markdown_row(d["claim"], d["reason"]) for d in entries["dropped"])]  # fmt: skip
    lines += ["", *LIMITS.splitlines(), "", "## Tables", "", "x: failed. -: not run or not printed.", ""]  # fmt: skip
    for key, entry in entries["tables"].items():
        lines += format_table(key, entry, entries["sources"][entry["source"]])
    return "\n".join(lines).replace("\n\n\n", "\n\n").rstrip() + "\n"


def picture() -> bytes:
    """Return the picture of the page."""
    _, audited = read_audit()
    return draw_figure(FigureSpec("audit", "", lambda: draw(audited)), ("svg",))["svg"]


def main() -> None:
    """Write page and picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--frames", type=Path, help="folder with the trajectories of the spike test"
    )
    folder = parser.parse_args().frames
    if folder:
        FRAMES.write_text(json.dumps(measure_frames(folder), indent=1) + "\n")
    PAGE.write_text(page())
    PICTURE.write_bytes(picture())


if __name__ == "__main__":
    main()
