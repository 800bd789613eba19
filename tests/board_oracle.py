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
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats
from scipy.stats import mstats

TRIM, MARGIN, FEW = 0.2, 0.05, 10
OPPOSITE = {"better": "worse", "worse": "better"}
NUMBERS = ("rank", "value", "low", "high", "ratio", "ratio_low", "ratio_high", "track", "lost", "coverage", "nees", "ms")  # fmt: skip


class Level:
    """Mean over conditions of the trimmed mean log error of a filter, with contributions of the runs."""

    def __init__(self, conditions: list[tuple[float, pd.Series]]) -> None:
        self.value, self.middle, self.runs = 0.0, np.inf, np.inf
        parts = []
        for weight, log_error in conditions:
            n = len(log_error)
            cut = int(TRIM * n + 1e-9)
            location = float(stats.trim_mean(log_error.to_numpy(), TRIM)) if n else np.nan
            self.value += weight * location
            self.middle, self.runs = min(self.middle, n - 2 * cut), min(self.runs, n)
            if np.isfinite(location):
                ordered = np.ma.array(log_error.to_numpy())
                clipped = np.asarray(mstats.winsorize(ordered, limits=(cut / n, cut / n)), float)
                influence = (clipped - clipped.mean()) / (n - 2 * cut)
                parts.append(pd.Series(weight * influence, index=log_error.index))
        if parts:
            self.parts = pd.concat(parts).groupby(["seed", "run"]).sum()


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


def levels_of(rows: pd.DataFrame, metric: str, filters: list[str]) -> dict[str, Level]:
    """Levels of all filters in the conditions of a view."""
    conditions = rows[["family", "scenario", "regime"]].drop_duplicates()
    levels = {}
    for name in filters:
        parts = []
        for _, row in conditions.iterrows():
            family = conditions[conditions["family"] == row["family"]]
            scenario = family[family["scenario"] == row["scenario"]]
            weight = (
                1 / conditions["family"].nunique() / family["scenario"].nunique() / len(scenario)
            )
            runs = rows[(rows["filter"] == name) & (rows["scenario"] == row["scenario"]) & (rows["regime"] == row["regime"])]  # fmt: skip
            runs = runs[~(runs["keeps_track"] & runs[metric].isna())].set_index(["seed", "run"])
            parts.append((weight, np.log(runs[metric]).where(runs["keeps_track"], np.inf)))
        levels[name] = Level(parts)
    return levels


def view_rows(
    rows: pd.DataFrame, key: tuple[str, str, str, str], words: dict[Any, str]
) -> list[Any]:
    """Rows of one view."""
    metric, world, regime, baseline = key
    filters = sorted(rows["filter"].unique())
    selected = rows[((world == "all") | (rows["scenario"] == world)) & ((regime == "all") | (rows["regime"] == regime))]  # fmt: skip
    levels = levels_of(selected, metric, filters)
    finite = {name: level.value for name, level in levels.items() if np.isfinite(level.value)}
    best = min(finite, key=lambda name: (finite[name], name)) if finite else None
    is_single = len(selected[["scenario", "regime"]].drop_duplicates()) == 1
    result = []
    for name, level in levels.items():
        runs = selected[selected["filter"] == name]
        cells = runs.groupby(["scenario", "regime"])
        row: dict[str, Any] = dict.fromkeys(NUMBERS, np.nan)
        row |= {"filter": name, "track": cells["keeps_track"].mean().mean(), "lost": runs["lost"].sum(),
                "coverage": cells["coverage_90"].mean().mean(), "nees": cells["nees_ratio"].mean().mean(),
                "ms": stats.gmean(cells["ms"].first())}  # fmt: skip
        if name in finite:
            row["rank"] = 1 + sum(value < level.value - 1e-6 for value in finite.values())
            if is_single:
                ends = interval(level.value, level.parts, level.middle, 0.05)
                row |= dict(
                    zip(("value", "low", "high"), np.exp([level.value, *ends]), strict=True)
                )
            if baseline in finite:
                ends = difference(level, levels[baseline], 0.05)
                row |= dict(zip(("ratio", "ratio_low", "ratio_high"), np.exp(ends), strict=True))
        row["verdict"] = verdict_of(
            name, best, levels, words if key[:3] == ("rmse", "all", "all") else {}
        )
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


def find_differences(folder: Path, tolerance: float = 6e-4) -> list[str]:
    """Compare every row of verdicts.csv, which has four digits, with an independent computation."""
    runs = pd.read_parquet(folder / "runs.parquet")
    stored = pd.read_csv(folder / "verdicts.csv")
    words = planned_words(folder / "decisions.json")
    different = []
    for key, view in stored.groupby(["metric", "world", "regime", "baseline"], sort=False):
        own = pd.DataFrame(view_rows(runs, key, words)).set_index("filter")
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
