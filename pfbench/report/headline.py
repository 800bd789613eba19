"""What a study of many worlds comes to: one quantity of each cell, and proposed methods beside what their papers compare with.

The main group of a cell is the position or, where a world has none, the first group of its state. Where worlds differ in it, the
main groups together are compared across cells like any other group: ranks have no unit. A proposed method is compared with the
baselines of its own paper, one pair at a time: Wilcoxon's test with cells as blocks and Holm's correction over these pairs alone,
for they follow from what the papers compare and not from results [ours]. The filters of a cell saw the same worlds; cells of one
world share its geometry and its draws, and are no independent blocks.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from pfbench.metrics import Array
from pfbench.report import power
from pfbench.report.across import Across, Blocks, worlds_of
from pfbench.report.frame import natural
from pfbench.report.significance import NO_DIFFERENCE, Verdict, holm, log_ratio, rank_biserial, wilcoxon

MAIN = "main group"
BASELINES: Mapping[str, tuple[str, ...]] = {
    "mcmc_rpf": ("sir", "rpf"),  # Yan et al. 2016
    "qmc_polymerised": ("sir", "gpf", "qmc_gpf"),  # Pu and Qin
    "fm_mssrckf": ("mssrckf",),  # COFM-AMSSRCPF 2024, as the next two
    "cofm_mssrckf": ("mssrckf", "fm_mssrckf"),
    "cofm_amssrcpf": ("cpf", "fmcpf"),
    "dmc_reconstructed": ("sir", "ukf"),  # The DMC particle filter
    "cpso_escape": ("sir", "pso_pf", "cpso_pf"),  # Tian et al.
}
CELLS = 5  # that a comparison across cells takes at least, as everywhere
CellName = tuple[str, str, str]


@dataclass(frozen=True)
class Planned:
    """A proposed method against one baseline of its own paper, across the cells that have both.

    Attributes:
        method, baseline: labels.
        cells: names, as `scenario / noise / model`.
        ratios: of their median errors in each cell, below 1 when the method has the smaller one; 0 or infinite where lost runs
            decide it.
        shown: what was decided within each cell: the method, the baseline or "no difference shown".
        ratio: median of the ratios.
        effect: rank-biserial correlation over cells, positive when the method is better.
        p: Wilcoxon's, of this pair alone.
        p_holm: corrected over `family` pairs.
        family: pairs.
        winner: method, baseline or "no difference shown".
        least: cells below which this family can show no difference whatever.
    """

    method: str
    baseline: str
    cells: tuple[str, ...]
    ratios: tuple[float, ...]
    shown: tuple[str, ...]
    ratio: float
    effect: float
    p: float
    p_holm: float
    family: int
    winner: str
    least: int = 0

    @property
    def possible(self) -> bool:
        """Are there cells enough to show any difference?"""
        return len(self.cells) >= self.least

    @property
    def decided(self) -> str:
        """The winner, or why there is none, in words."""
        return self.winner if self.possible else f"cannot be shown with {len(self.cells)} cells"

    @property
    def worlds(self) -> int:
        """Distinct worlds among the cells."""
        return len(worlds_of(self.cells))

    @property
    def better(self) -> int:
        """Cells in which the method is shown to be better."""
        return self.shown.count(self.method)

    @property
    def worse(self) -> int:
        """Cells in which it is shown to be worse."""
        return self.shown.count(self.baseline)


@dataclass(frozen=True)
class Summary:
    """What the page says first.

    Attributes:
        filters, cells, worlds, regimes, runs: how many; runs are all that were made, of all filters.
        incomplete: cells that lack filters which others have, and how many they lack.
        group: compared, with what it is in each world.
        ranked: filters and mean ranks, best first; empty where no test across cells was made.
        apart, pairs: pairs across cells of which a difference is shown, and all.
        unbeaten: filters that no other one is shown to beat across cells.
        often: filters, and the number of cells in which no other one is shown to beat them, most first.
        compared: cells that this number is of.
        lost: filters, lost runs and runs made, most lost first; those without a lost run are left out.
        diverged: the same of runs that went on far outside their covariance.
        planned: see `Planned`.
    """

    filters: int
    cells: int
    worlds: int
    regimes: int
    runs: int
    incomplete: tuple[tuple[str, int], ...]
    group: str
    ranked: tuple[tuple[str, float], ...]
    apart: int
    pairs: int
    unbeaten: tuple[str, ...]
    often: tuple[tuple[str, int], ...]
    compared: int
    lost: tuple[tuple[str, int, int], ...]
    diverged: tuple[tuple[str, int, int], ...]
    planned: tuple[Planned, ...]

    @property
    def foremost(self) -> tuple[tuple[str, int], ...]:
        """The first six of `often`, and all that tie with the sixth: names decide nothing."""
        least = self.often[:6][-1][1] if self.often else 0
        return tuple(item for item in self.often if item[1] >= least)


def main_group(known: Sequence[str]) -> str:
    """Of the groups of a cell that have a truth."""
    return "position" if "position" in known else known[0] if known else ""


def joined(
    table: pd.DataFrame, decided: Sequence[Verdict], mains: Mapping[CellName, str]
) -> tuple[pd.DataFrame, list[Verdict], str]:
    """Rows and verdicts of the main groups, under one name: that of the group where it is the same everywhere.

    Args:
        table: from `frame`.
        decided: all verdicts.
        mains: of each cell its main group.
    """
    names = {group for group in mains.values() if group}
    name = names.pop() if len(names) == 1 else MAIN
    own = pd.Series(list(zip(table.scenario, table.noise, table.model, strict=True)), index=table.index).map(mains)
    rows = table[(table.group == own) & (table.metric == "rmse") & (table.component == "norm")].assign(group=name)
    kept = [replace(v, group=name) for v in decided if v.group == mains.get((v.scenario, v.noise, v.model))]
    return rows, kept, name


def planned(source: Blocks, decided: Sequence[Verdict], alpha: float) -> list[Planned]:
    """All pairs of `BASELINES` that ran in five cells at least.

    Args:
        source: the main groups of all cells.
        decided: verdicts of the same group.
        alpha: level after Holm's correction.
    """
    winners = {(f"{v.scenario} / {v.noise} / {v.model}", frozenset((v.a, v.b))): v.winner for v in decided}
    found = []
    for method, baselines in BASELINES.items():
        for baseline in baselines:
            if method in source.filters and baseline in source.filters and len(source.cells) >= CELLS:
                a, b = (np.exp(source.values[:, source.filters.index(label)]) for label in (method, baseline))
                shown = tuple(winners.get((cell, frozenset((method, baseline))), NO_DIFFERENCE) for cell in source.cells)
                found.append(_compared(method, baseline, source.cells, a, b, shown))
    corrected = holm([one.p for one in found])
    return [_decided(one, float(p), len(found), alpha) for one, p in zip(found, corrected, strict=True)]


def summary(
    one: Across, decided: Sequence[Verdict], pairs: Sequence[Planned], table: pd.DataFrame, mains: Mapping[CellName, str],
    fates: Sequence[tuple[str, int, int, int]],
) -> Summary:
    """The first screen of a page.

    Args:
        one: the main groups across cells.
        decided: verdicts of the main groups.
        pairs: from `planned`.
        table: rows of the main groups.
        mains: of each cell its main group.
        fates: of each job the filter, its lost runs, its diverged runs and all its runs.
    """
    labels = {" / ".join(map(str, cell)): set(own.label) for cell, own in table.groupby(["scenario", "noise", "model"])}
    everyone = set().union(*labels.values()) if labels else set()
    lacking = [(cell, len(everyone - own)) for cell, own in sorted(labels.items(), key=lambda item: natural(item[0]))]
    often, compared = _unbeaten(decided)
    made: Counter[str] = Counter()
    gone: Counter[str] = Counter()
    off: Counter[str] = Counter()
    for label, lost, diverged, runs in fates:
        made[label] += runs
        gone[label] += lost
        off[label] += diverged
    return Summary(
        filters=len(everyone), cells=len(labels), worlds=len({name for name, _, _ in mains}),
        regimes=len({noise for _, noise, _ in mains}), runs=made.total(),
        incomplete=tuple(item for item in lacking if item[1]), group=_named(one.group, mains),
        ranked=tuple(sorted(zip(one.filters, one.ranks, strict=False), key=lambda item: (item[1], natural(item[0])))),
        apart=one.shown, pairs=len(one.pairs), unbeaten=tuple(one.unbeaten) if one.pairs else (), often=often,
        compared=compared, lost=_most(gone, made), diverged=_most(off, made), planned=tuple(pairs),
    )  # fmt: skip


def _compared(method: str, baseline: str, cells: tuple[str, ...], a: Array, b: Array, shown: tuple[str, ...]) -> Planned:
    d = log_ratio(a, b)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = np.where(np.isinf(a) & np.isinf(b), 1.0, a / b)
    return Planned(
        method, baseline, cells, tuple(map(float, ratios)), shown, float(np.median(ratios)), rank_biserial(d), wilcoxon(d)[1],
        math.nan, 0, NO_DIFFERENCE,
    )  # fmt: skip


def _decided(one: Planned, p: float, family: int, alpha: float) -> Planned:
    better = one.method if one.effect > 0 else one.baseline
    winner = better if p <= alpha and one.effect else NO_DIFFERENCE
    return replace(one, p_holm=p, family=family, winner=winner, least=power.least(alpha / family))


def _unbeaten(decided: Sequence[Verdict]) -> tuple[tuple[tuple[str, int], ...], int]:
    """In how many cells no other filter is shown to beat each one, most first; and of how many."""
    cells: dict[CellName, list[Verdict]] = {}
    for v in decided:
        cells.setdefault((v.scenario, v.noise, v.model), []).append(v)
    count: Counter[str] = Counter()
    for own in cells.values():
        beaten = {v.b if v.winner == v.a else v.a for v in own if v.winner != NO_DIFFERENCE}
        count.update({label for v in own for label in (v.a, v.b)} - beaten)
    return tuple(sorted(count.items(), key=lambda item: (-item[1], natural(item[0])))), len(cells)


def _most(count: Mapping[str, int], made: Mapping[str, int]) -> tuple[tuple[str, int, int], ...]:
    rows = [(label, n, made[label]) for label, n in count.items() if n]
    return tuple(sorted(rows, key=lambda row: (-row[1] / row[2], natural(row[0]))))


def _named(group: str, mains: Mapping[CellName, str]) -> str:
    """The group, and where there are several what it is in which world, the commonest first."""
    if group != MAIN:
        return group
    count = Counter(mains.values())
    (most, _), *others = count.most_common()
    said = []
    for name, _ in others:
        worlds = sorted({cell[0] for cell, own in mains.items() if own == name}, key=natural)
        said += [f"{name} of {', '.join(worlds)}"] if name else []
    return f"{most}, and {'; '.join(said)}"
