"""The numbers of a report page computed a second time from runs.parquet, without any code of pfbench.

It follows docs/statistics.md with pandas and scipy, and reads the planned words from decisions.json. Every
row of verdicts.csv is computed: the first screen of the page and all other views.

Run: python tests/board_oracle.py reports/STUDY
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy import stats
from scipy.stats import mstats

TRIM, MARGIN, FEW = 0.2, 0.05, 10
OPPOSITE = {"better": "worse", "worse": "better"}
NUMBERS = ("rank", "value", "low", "high", "ratio", "ratio_low", "ratio_high", "track", "lost", "coverage", "nees", "ms")  # fmt: skip


class Cell(NamedTuple):
    """Trimmed mean log error of a filter in one condition, with contributions of the runs.

    Attributes:
        location: Trimmed mean, NaN without a run.
        parts: Contribution of each run; empty if lost runs reach the trimmed middle.
        middle: Number of runs that the trimmed mean uses.
        runs: Number of runs.
    """

    location: float
    parts: pd.Series
    middle: int
    runs: int


Cells = dict[tuple[str, str, str], Cell]


def make_cells(table: pd.DataFrame, metric: str) -> Cells:
    """Cells of all filters and conditions."""
    cells = {}
    table = table[~(table["keeps_track"] & table[metric].isna())]
    for key, runs in table.groupby(["filter", "scenario", "regime"]):
        log_error = np.log(runs[metric]).where(runs["keeps_track"], np.inf).to_numpy()
        n, cut = len(log_error), int(TRIM * len(log_error) + 1e-9)
        location = float(stats.trim_mean(log_error, TRIM))
        parts = pd.Series(dtype=float)
        if np.isfinite(location):
            clipped = mstats.winsorize(np.ma.array(log_error), limits=(cut / n, cut / n))
            names = 10**6 * runs["seed"] + runs["run"]
            influence = (np.asarray(clipped, float) - clipped.mean()) / (n - 2 * cut)
            parts = pd.Series(influence, index=names.to_numpy())
        cells[key] = Cell(location, parts, n - 2 * cut, n)
    return cells


class Level:
    """Mean over conditions of the trimmed mean log error of a filter, with contributions of the runs."""

    def __init__(self, cells: list[tuple[float, Cell]]) -> None:
        self.value = sum(weight * cell.location for weight, cell in cells)
        self.middle = min(cell.middle for _, cell in cells)
        self.runs = min(cell.runs for _, cell in cells)
        parts = [weight * cell.parts for weight, cell in cells if len(cell.parts)]
        self.parts = pd.concat(parts).groupby(level=0).sum() if parts else pd.Series(dtype=float)


def interval(value: float, parts: pd.Series, middle: float, alpha: float) -> tuple[float, float]:
    """Student interval of a sum of contributions."""
    if middle < 2 or not np.isfinite(value):
        return -np.inf, np.inf
    error = np.sqrt(middle / (middle - 1) * (parts**2).sum())
    half = stats.t.ppf(1 - alpha / 2, middle - 1) * error
    return value - half, value + half


def difference(a: Level, b: Level, alpha: float) -> tuple[float, float, float]:
    """Difference of two levels and its interval over the runs that they share."""
    parts = a.parts.sub(b.parts, fill_value=0.0)
    with np.errstate(invalid="ignore"):
        value = a.value - b.value
    return value, *interval(value, parts, min(a.middle, b.middle), alpha)


def levels_of(conditions: pd.DataFrame, cells: Cells, filters: list[str]) -> dict[str, Level]:
    """Levels of all filters in the conditions of a view."""
    absent = Cell(np.nan, pd.Series(dtype=float), 0, 0)
    weights = []
    for _, row in conditions.iterrows():
        family = conditions[conditions["family"] == row["family"]]
        regimes = (family["scenario"] == row["scenario"]).sum()
        weights.append(1 / conditions["family"].nunique() / family["scenario"].nunique() / regimes)
    names = list(conditions[["scenario", "regime"]].itertuples(index=False, name=None))
    return {
        name: Level(
            [(w, cells.get((name, *c), absent)) for w, c in zip(weights, names, strict=True)]
        )
        for name in filters
    }


class Scope:
    """Levels and shares of all filters in the conditions of a view, before a baseline is chosen."""

    def __init__(self, rows: pd.DataFrame, cells: Cells, world: str, regime: str) -> None:
        filters, total = sorted(rows["filter"].unique()), len(rows)
        if world != "all":
            rows = rows[rows["scenario"] == world]
        if regime != "all":
            rows = rows[rows["regime"] == regime]
        conditions = rows[["family", "scenario", "regime"]].drop_duplicates()
        self.levels = levels_of(conditions, cells, filters)
        self.is_single = len(conditions) == 1
        self.has_all = len(rows) == total  # so that words of planned pairs decide
        parts = rows.groupby(["filter", "scenario", "regime"])
        names = {"keeps_track": "track", "coverage_90": "coverage", "nees_ratio": "nees"}
        shares = parts[list(names)].mean().groupby("filter").mean().rename(columns=names)
        shares["lost"] = rows.groupby("filter")["lost"].sum()
        shares["ms"] = parts["ms"].first().groupby("filter").agg(stats.gmean)
        self.shares = shares.reindex(filters)


def view_rows(scope: Scope, baseline: str, words: dict[Any, str]) -> list[Any]:
    """Rows of one view."""
    levels = scope.levels
    finite = {name: level.value for name, level in levels.items() if np.isfinite(level.value)}
    best = min(finite, key=lambda name: (finite[name], name)) if finite else None
    result = []
    for name, level in levels.items():
        row: dict[str, Any] = dict.fromkeys(NUMBERS, np.nan)
        row |= {"filter": name, **scope.shares.loc[name]}
        if name in finite:
            row["rank"] = 1 + sum(value < level.value - 1e-6 for value in finite.values())
            if scope.is_single:
                ends = interval(level.value, level.parts, level.middle, 0.05)
                values = np.exp([level.value, *ends])
                row |= dict(zip(("value", "low", "high"), values, strict=True))
            if baseline in finite:
                ends = difference(level, levels[baseline], 0.05)
                row |= dict(zip(("ratio", "ratio_low", "ratio_high"), np.exp(ends), strict=True))
        row["verdict"] = verdict_of(name, best, levels, words)
        result.append(row)
    return result


def verdict_of(name: str, best: str | None, levels: dict[str, Level], words: dict[Any, str]) -> str:
    """Verdict on a filter against the best; the words of planned pairs decide first."""
    level = levels[name]
    if np.isnan(level.value):
        return "missing"
    if best is None or not np.isfinite(level.value):
        return "not_kept"
    if name == best:
        return "best"
    pairs = len(levels) * (len(levels) - 1) / 2
    value, low, high = difference(level, levels[best], 0.05 / pairs)
    if abs(value) <= 1e-6 and low == high:
        return "equal"
    if min(level.runs, levels[best].runs) < FEW:
        return "open"
    word = words.get((name, best), "")
    if low > 0 or word == "worse":
        return "open" if word == "better" else "worse"
    return "equal" if high < np.log1p(MARGIN) or word == "equivalent" else "open"


def planned_words(decisions: Path) -> dict[Any, str]:
    """Words of planned pairs in both directions."""
    words = {}
    for d in json.loads(decisions.read_text()):
        is_planned = d["family"] == "planned pairs, track and error" and d["question"] == "a"
        if is_planned and d["metric"] != "keeps track":
            words[d["a"], d["b"]] = d["word"]
            words[d["b"], d["a"]] = OPPOSITE.get(d["word"], d["word"])
    return words


def find_differences(
    folder: Path, words: dict[Any, str] | None = None, tolerance: float = 6e-4
) -> list[str]:
    """Compare every row of verdicts.csv, which has four digits, with an independent computation.

    Without words of planned pairs, those of decisions.json are used.
    """
    runs = pd.read_parquet(folder / "runs.parquet")
    stored = pd.read_csv(folder / "verdicts.csv")
    words = planned_words(folder / "decisions.json") if words is None else words
    different = []
    cells = {metric: make_cells(runs, metric) for metric in stored["metric"].unique()}
    scopes: dict[Any, Scope] = {}
    for key, view in stored.groupby(["metric", "world", "regime", "baseline"], sort=False):
        place = metric, world, regime = key[:3]
        scope = scopes.setdefault(place, scopes.get(place) or Scope(runs, cells[metric], world, regime))  # fmt: skip
        is_opening = scope.has_all and metric == stored["metric"][0]
        rows = view_rows(scope, key[3], words if is_opening else {})
        own = pd.DataFrame(rows).set_index("filter")
        if view["track"].isna().all():  # a world without a divergence threshold
            own["track"] = np.nan
        for _, row in view.iterrows():
            expected = own.loc[row["filter"]]
            numbers = expected[list(NUMBERS)].to_numpy(float)
            numbers[~np.isfinite(numbers) | (numbers == 0)] = np.nan
            shown = row[list(NUMBERS)].to_numpy(float)
            shown[shown == 0] = np.nan
            if not np.allclose(numbers, shown, rtol=tolerance, atol=0, equal_nan=True):
                different.append(f"{key} {row['filter']}: {numbers} is not {shown}")
            if expected["verdict"] != row["verdict"]:
                different.append(
                    f"{key} {row['filter']}: {expected['verdict']} is not {row['verdict']}"
                )
    return [*different, *check_sentence(folder, stored)]


def check_sentence(folder: Path, stored: pd.DataFrame) -> list[str]:
    """Compare the numbers of the first sentence with the first rows of the table."""
    text = (folder / "report.md").read_text()
    first = stored[stored["metric"].eq(stored["metric"][0]) & stored["world"].eq("all")]
    best = first.iloc[0]
    match = re.search(r"([\d.e+-]+) % below .*?interval ([\d.e+-]+) to ([\d.e+-]+) %", text)
    if not match:
        return []
    expected = [100 * (1 - best[name]) for name in ("ratio", "ratio_high", "ratio_low")]
    shown = [float(number) for number in match.groups()]
    is_equal = np.allclose(expected, shown, rtol=0.06, atol=0.06)  # two digits of a rounded ratio
    return [] if is_equal else [f"sentence: {shown} is not {expected}"]


if __name__ == "__main__":
    problems = find_differences(Path(sys.argv[1]))
    print("\n".join(problems) or "all rows of verdicts.csv agree")
    sys.exit(len(problems) > 0)
