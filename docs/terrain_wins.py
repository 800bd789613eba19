"""When a particle filter beats Kalman filters in terrain-referenced navigation: the blocks `terrain_*` of docs/robustness.md.

The particle filter `rpf` was chosen by a pilot with a seed that no study scores. It is compared on paired runs with
each Kalman filter in each condition, by Wilcoxon's signed-rank test of the logarithms of the ratios of errors, with
Holm's correction over all pairs of a study.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from pfbench.files import markdown_head, markdown_row
from pfbench.results import holm, order_statistic_interval, wilcoxon_signed_rank

LIMITS = Path(__file__).parents[1] / "docs" / "terrain_limit.json"
PARTICLES = "rpf"  # the particle filter that is compared
BANKS = ("ekf_bank", "ekf_bank_dense")
ALPHA = 0.05
STUDIES = {
    "terrain_start": "initial standard deviation per axis [m]",
    "terrain_rough": "shortest wavelength of the terrain [m]",
    "terrain_recorded": "initial standard deviation per axis [m]",
}


class Pair(NamedTuple):
    """Comparison of `PARTICLES` with a Kalman filter in a condition.

    Attributes:
        ratio: Median over runs of the error of `PARTICLES` divided by that of the Kalman filter.
        low: Lower end of its 95 % interval.
        high: Upper end.
        p: p-value of Wilcoxon's test after Holm's correction.
    """

    ratio: float
    low: float
    high: float
    p: float

    @property
    def word(self) -> str:
        """Decision: better, worse or open."""
        if self.p > ALPHA:
            return "open"
        return "better" if self.ratio < 1.0 else "worse"


def find_dose(scenario: str) -> float:
    """Return the swept value of a condition, from a name such as `terrain[initial_sd=50.0]`.

    Args:
        scenario: Name of the condition in the stored runs.

    Raises:
        ValueError: If the name has no value.
    """
    match = re.search(r"=([\d.]+)\]$", scenario)
    if match is None:
        raise ValueError(f"a scenario must end in [key=value], got {scenario}. Sweep one key.")
    return float(match[1])


def arrange_errors(runs: pd.DataFrame) -> dict[float, pd.DataFrame]:
    """Arrange the errors of a study: a table of runs by filters for each dose.

    Args:
        runs: Stored runs of the study.

    Returns:
        Errors by dose, in the order of the study; a lost run is infinite.
    """
    tables = {}
    for scenario in runs["scenario"].unique():
        rows = runs[runs["scenario"] == scenario]
        table = rows.pivot_table(index="run", columns="filter", values="rmse", dropna=False)
        tables[find_dose(scenario)] = table.fillna(np.inf)
    return tables


def compare_pairs(
    errors: Mapping[float, pd.DataFrame], kalman: Sequence[str]
) -> dict[float, dict[str, Pair]]:
    """Compare the particle filter with each Kalman filter at each dose.

    Args:
        errors: Errors by dose, see `arrange_errors`.
        kalman: Labels of the Kalman filters.
    """
    keys = [(dose, label) for dose in errors for label in kalman]
    logs = [
        np.nan_to_num(np.log(errors[dose][PARTICLES] / errors[dose][label]).to_numpy(), posinf=99.0)
        for dose, label in keys
    ]  # a run that both lose counts as equal
    adjusted = holm([wilcoxon_signed_rank(log).p for log in logs])
    pairs: dict[float, dict[str, Pair]] = {dose: {} for dose in errors}
    for (dose, label), log, p in zip(keys, logs, adjusted, strict=True):
        interval = order_statistic_interval(log, 1.0 - ALPHA)
        ends = (float(np.exp(value)) for value in (np.median(log), interval.low, interval.high))
        pairs[dose][label] = Pair(*ends, float(p))
    return pairs


def describe_wins(pairs: Mapping[float, Mapping[str, Pair]], labels: Sequence[str]) -> str:
    """State the doses at which the particle filter is better than all of several filters.

    Args:
        pairs: Comparisons by dose and filter.
        labels: Labels of the filters.
    """
    won = [
        f"{dose:g}" for dose, row in pairs.items() if all(row[a].word == "better" for a in labels)
    ]
    names = (
        " and ".join(f"`{label}`" for label in labels)
        if len(labels) < 3
        else "every single Kalman filter"
    )
    if not won:
        return f"`{PARTICLES}` is not shown to be better than {names} at any dose."
    return f"`{PARTICLES}` is better than {names} at {', '.join(won)} m."


def terrain_table(
    name: str, runs: pd.DataFrame, families: Mapping[str, str], format_median: Callable[..., str]
) -> str:
    """Table and sentences of a study.

    Args:
        name: Name of the study.
        runs: Its stored runs.
        families: Family by label of the filter.
        format_median: Function that formats the median of errors with its interval.
    """
    errors = arrange_errors(runs)
    kalman = [label for label, family in families.items() if family == "kalman"]
    pairs = compare_pairs(errors, kalman)
    kept = runs.groupby(["scenario", "filter"])["keeps_track"].mean()
    scenes = {find_dose(scenario): scenario for scenario in runs["scenario"].unique()}
    ranks = {
        label: np.mean([table.median().rank()[label] for table in errors.values()])
        for label in families
    }
    times = runs.groupby("filter")["ms"].median()
    lines = markdown_head("filter", *(f"{dose:g} m" for dose in errors), "ms/step")
    for label in sorted(ranks, key=lambda key: ranks[key]):
        cells = []
        for dose, table in errors.items():
            share = f"{100 * kept[scenes[dose], label]:.0f} %"
            mark = {"better": " ↑", "worse": " ↓"}.get(
                pairs[dose][label].word if label in kalman else "", ""
            )
            cells.append(f"{format_median(table[label].to_numpy())}, {share}{mark}")
        lines.append(markdown_row(f"`{label}`", *cells, f"{times[label]:.3g}"))
    limits = _read_limits(name)
    if limits:
        cells = [format_median(np.array(limits[dose])) if dose in limits else "" for dose in errors]
        lines.append(markdown_row("exact mean", *cells, ""))
    single = [label for label in kalman if label not in BANKS]
    ends = [describe_wins(pairs, single), *(describe_wins(pairs, [bank]) for bank in BANKS)]
    return "\n".join(
        [*lines, "", f"Dose: {STUDIES[name]}. " + " ".join(ends), *_list_ratios(pairs)]
    )


def _list_ratios(pairs: Mapping[float, Mapping[str, Pair]]) -> list[str]:
    """State the ratios to the best single Kalman filter and to both banks at each dose."""
    lines = [
        "",
        *markdown_head("dose [m]", "closest single Kalman filter", *(f"`{b}`" for b in BANKS)),
    ]
    for dose, row in pairs.items():
        closest = max((a for a in row if a not in BANKS), key=lambda a: row[a].ratio)
        words = [
            f"{row[a].ratio:.2f} [{row[a].low:.2f}, {row[a].high:.2f}], {row[a].word}"
            for a in (closest, *BANKS)
        ]
        lines.append(markdown_row(f"{dose:g}", f"`{closest}`: {words[0]}", *words[1:]))
    return lines


def _read_limits(name: str) -> dict[float, list[float]]:
    """Read the errors of the exact mean by dose."""
    stored: dict[str, Any] = json.loads(LIMITS.read_text()) if LIMITS.exists() else {}
    chosen = {key: row for key, row in stored.items() if key.split(" ")[0] == name}
    return {float(key.rpartition("=")[2]): row["rmse"] for key, row in chosen.items()}
