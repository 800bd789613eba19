"""When a particle filter beats Kalman filters in terrain-referenced navigation: the blocks `terrain_*` of docs/robustness.md.

The particle filter `rpf` was chosen by a pilot with a seed that no study scores. It is compared on paired runs with
each Kalman filter in each condition, by Wilcoxon's signed-rank test of the logarithms of the ratios of errors, with
Holm's correction over all pairs of a study.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import pandas as pd
from paired_errors import ALPHA, LOST, compare_with_all, describe_comparison, signed_rank_interval
from second_seed import read_runs

from pfbench.files import markdown_head, markdown_row
from pfbench.report import read_stored_study
from pfbench.results import (
    arrange_runs,
    compare_filters,
    compute_losses,
    decide,
    holm,
    wilcoxon_signed_rank,
)

LIMITS = Path(__file__).with_name("terrain_limit.json")
REPORTS = Path(__file__).parents[2] / "reports"
PARTICLES = "rpf"  # the particle filter that is compared
BANKS = ("ekf_bank", "ekf_bank_dense")
STUDIES = {
    "terrain_start": "initial standard deviation per axis [m]",
    "terrain_rough": "shortest wavelength of the terrain [m]",
    "terrain_recorded": "initial standard deviation per axis [m]",
}

Key = TypeVar("Key", bound=Hashable)


class Pair(NamedTuple):
    """Comparison of `PARTICLES` with a Kalman filter in a condition.

    Attributes:
        ratio: Centre over runs of the error of `PARTICLES` divided by that of the Kalman filter.
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
        Errors by dose, in the order of the study; NaN for a lost run.
    """
    tables = {}
    for scenario in runs["scenario"].unique():
        rows = runs[runs["scenario"] == scenario]
        table = rows.pivot_table(index="run", columns="filter", values="rmse", dropna=False)
        tables[find_dose(scenario)] = table
    return tables


def compare_pairs(
    errors: Mapping[Key, pd.DataFrame], kalman: Sequence[str]
) -> dict[Key, dict[str, Pair]]:
    """Compare the particle filter with each Kalman filter at each dose.

    Args:
        errors: Errors by dose, or by study and dose, see `arrange_errors`.
        kalman: Labels of the Kalman filters.
    """
    keys = [(dose, label) for dose in errors for label in kalman]
    filled = {dose: np.log(table.fillna(LOST)) for dose, table in errors.items()}
    logs = [(filled[dose][PARTICLES] - filled[dose][label]).to_numpy() for dose, label in keys]
    adjusted = holm([wilcoxon_signed_rank(log)[1] for log in logs])
    pairs: dict[Key, dict[str, Pair]] = {dose: {} for dose in errors}
    for (dose, label), log, p in zip(keys, logs, adjusted, strict=True):
        centre, low, high = (float(np.exp(value)) for value in signed_rank_interval(log))
        pairs[dose][label] = Pair(centre, low, high, float(p))
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
        else "every filter with one normal distribution"
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
        label: np.mean([table.fillna(LOST).median().rank()[label] for table in errors.values()])
        for label in families
    }
    lines = markdown_head("filter", *(f"{dose:g} m" for dose in errors))
    for label in sorted(ranks, key=lambda key: ranks[key]):
        cells = []
        for dose, table in errors.items():
            share = f"{100 * kept[scenes[dose], label]:.0f} %"
            mark = {"better": " ↑", "worse": " ↓"}.get(
                pairs[dose][label].word if label in kalman else "", ""
            )
            cells.append(f"{format_median(table[label].to_numpy())}, {share}{mark}")
        lines.append(markdown_row(f"`{label}`", *cells))
    single = [label for label in kalman if label not in BANKS]
    ends = [describe_wins(pairs, single), *(describe_wins(pairs, [bank]) for bank in BANKS)]
    return "\n".join(
        [
            *lines,
            "",
            f"Dose: {STUDIES[name]}. " + " ".join(ends),
            *_list_ratios(pairs, {a: compare_exact(name, errors, a) for a in (PARTICLES, *BANKS)}),
        ]
    )


def describe_answer(runs: Mapping[str, pd.DataFrame], families: Mapping[str, str]) -> str:
    """State which observation makes a particle filter better than Kalman filters, from all studies.

    Args:
        runs: Stored runs by study.
        families: Family by label of the filter.
    """
    kalman = [label for label, family in families.items() if family == "kalman"]
    single = [label for label in kalman if label not in BANKS]
    lines = markdown_head(
        "study", "dose", "all with one normal distribution", *(f"`{b}`" for b in BANKS)
    )
    all_won = []
    for name, table in runs.items():
        pairs = compare_pairs(arrange_errors(table), kalman)
        cells = [find_won(pairs, labels) for labels in (single, *([bank] for bank in BANKS))]
        kept = table.groupby(["scenario", "filter"])["keeps_track"].mean()
        scenes = {f"{find_dose(scenario):g}": scenario for scenario in table["scenario"].unique()}
        for dose in find_won(pairs, kalman):
            shares = (f"`{a}` in {100 * kept[scenes[dose], a]:.0f} %" for a in (PARTICLES, *BANKS))
            all_won.append(
                f"`{PARTICLES}` is better than every Kalman filter, both banks included, in `{name}` at {dose} m. "
                f"Track is kept there by {', '.join(shares)} of runs. {describe_joint(name, scenes[dose])} "
                f"{describe_all_studies(runs, kalman, name, dose)} {describe_second_seed(name, scenes[dose], kalman)}"
            )
        words = (", ".join(doses) + " m" if doses else "none" for doses in cells)
        lines.append(markdown_row(f"`{name}`", STUDIES[name], *words))
    none = f"`{PARTICLES}` is in no condition better than every Kalman filter, both banks included."
    return "\n".join([*lines, "", *(all_won or [none])])


def describe_joint(name: str, scenario: str) -> str:
    """State the verdicts of the report on both banks against the particle filter, which hold for all filters together.

    Args:
        name: Name of the study.
        scenario: Name of the condition in the stored files.
    """
    table = read_stored_study(REPORTS / name).table
    runs = table[table["scenario"] == scenario]
    labels = sorted(set(runs["filter"]))
    arranged = arrange_runs(runs, labels)
    pairs = [(label, PARTICLES) for label in labels if label != PARTICLES]
    verdicts = decide(compare_filters(arranged, compute_losses(arranged, "rmse"), pairs))
    told = (
        f"`{v.a}` {v.ratio:.2f} [{v.low:.2f}, {v.high:.2f}], {v.word}"
        for v in verdicts
        if v.a in BANKS
    )
    return f"All filters together against `{PARTICLES}`: {'; '.join(told)}."


def describe_all_studies(
    runs: Mapping[str, pd.DataFrame], kalman: Sequence[str], name: str, dose: str
) -> str:
    """State the largest p-value of a condition if the pairs of all studies are counted together.

    Args:
        runs: Stored runs by study.
        kalman: Labels of the Kalman filters.
        name: Name of the study.
        dose: Dose of the condition.
    """
    errors = {
        (study, f"{value:g}"): errors
        for study, table in runs.items()
        for value, errors in arrange_errors(table).items()
    }
    largest = max(pair.p for pair in compare_pairs(errors, kalman)[name, dose].values())
    return f"With the pairs of all {len(runs)} studies counted together, its largest p-value is {largest:.2g}."


def describe_second_seed(name: str, scenario: str, kalman: Sequence[str]) -> str:
    """State what the runs of a second seed say on one condition, in the median run and in root mean square.

    Args:
        name: Name of the study.
        scenario: Name of the condition in the stored files.
        kalman: Labels of the Kalman filters.
    """
    runs = read_runs(name)
    if runs.empty:
        return "The condition was not repeated with a second seed."
    errors = arrange_errors(runs)[find_dose(scenario)]
    found = compare_with_all(errors, PARTICLES, kalman)
    here = runs[runs["scenario"] == scenario]
    kept = 100 * here.groupby("filter")["keeps_track"].mean()
    shown = "shown" if found.p <= ALPHA else "not shown"
    ratio = root_mean_ratio(errors[PARTICLES].to_numpy(), errors[found.closest].to_numpy())
    return (
        f"With a second seed and {len(errors)} runs, which decide this one statement, it is {shown} to be better "
        f"than every Kalman filter (p = {found.p:.2g}): {describe_comparison(PARTICLES, found)}. In root mean square over "
        f"runs its error is {ratio:.2f} times as large; it keeps track in {kept[PARTICLES]:.1f} %, "
        f"`{found.closest}` in {kept[found.closest]:.1f} % of these runs."
    )


def find_won(pairs: Mapping[float, Mapping[str, Pair]], labels: Sequence[str]) -> list[str]:
    """Return the doses at which the particle filter is better than all of several filters.

    Args:
        pairs: Comparisons by dose and filter.
        labels: Labels of the filters.
    """
    return [
        f"{dose:g}" for dose, row in pairs.items() if all(row[a].word == "better" for a in labels)
    ]


def compare_exact(name: str, errors: Mapping[float, pd.DataFrame], label: str) -> dict[float, str]:
    """Compare a filter with the exact mean on the runs of the point-mass filter, at each dose.

    Args:
        name: Name of the study.
        errors: Errors by dose, see `arrange_errors`.
        label: Filter.

    Returns:
        Root of the ratio of mean squares by dose, where the exact mean is stored.
    """
    words = {}
    for dose, exact in _read_limits(name).items():
        runs = errors[dose][label].reindex(range(len(exact))).to_numpy()
        words[dose] = f"{root_mean_ratio(runs, np.array(exact)):.2f}"
    return words


def root_mean_ratio(a: np.ndarray, b: np.ndarray) -> float:
    """Return the root mean square of errors divided by that of others.

    Args:
        a: Errors, [R].
        b: Other errors, [R].
    """
    return float(np.sqrt(np.square(a).mean() / np.square(b).mean()))


def _list_ratios(
    pairs: Mapping[float, Mapping[str, Pair]], exact: Mapping[str, Mapping[float, str]]
) -> list[str]:
    """State the ratios to the closest filter with one normal distribution, banks and the exact mean."""
    heads = ("dose [m]", "closest with one normal distribution", *(f"`{b}`" for b in BANKS))
    lines = ["", *markdown_head(*heads, *(f"`{label}` to exact mean" for label in exact))]
    for dose, row in pairs.items():
        closest = max((a for a in row if a not in BANKS), key=lambda a: row[a].ratio)
        words = [
            f"{row[a].ratio:.2f} [{row[a].low:.2f}, {row[a].high:.2f}], {row[a].word}"
            for a in (closest, *BANKS)
        ]
        last = [found.get(dose, "–") for found in exact.values()]
        lines.append(markdown_row(f"{dose:g}", f"`{closest}`: {words[0]}", *words[1:], *last))
    return lines


def _read_limits(name: str) -> dict[float, list[float]]:
    """Read the errors of the exact mean by dose."""
    stored: dict[str, Any] = json.loads(LIMITS.read_text()) if LIMITS.exists() else {}
    chosen = {key: row for key, row in stored.items() if key.split(" ")[0] == name}
    return {
        float(key.rpartition("=")[2]): row["rmse"] for key, row in chosen.items() if row["rmse"]
    }
