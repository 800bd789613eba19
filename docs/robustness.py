"""Errors of robust and adaptive filters in each world and noise regime: `python docs/robustness.py`.

It writes the blocks of docs/robustness.md from the published reports of the studies `robust_*` and from the stored
limits of docs/ceiling.json. A test fails if a block differs from them.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from pfbench.files import markdown_head, markdown_row
from pfbench.report import read_page_data
from pfbench.report.board.decided_parts import StudyFacts
from pfbench.report.board.robust_word import (
    CONTROL,
    compare_with_control,
    describe_robustness,
    find_robust_filters,
)
from pfbench.results.statistics.intervals import order_statistic_interval

TOP = Path(__file__).parents[1]
PAGE, LIMITS = TOP / "docs" / "robustness.md", TOP / "docs" / "ceiling.json"
STUDIES = ("robust_flight", "robust_simulated", "robust_quad", "robust_car", "robust_canyon")
RECORDED = STUDIES[2:]
CONTROLS = (CONTROL, "ekf_scaled", "ekf")
SAMPLED_HYPOTHESES = "rbpf_discrete"  # particles of noise hypotheses, a Kalman filter for each
KALMAN = "kalman"
LEVEL = 0.95
_BLOCK = re.compile(r"<!-- numbers:(\w+) -->\n.*?<!-- numbers:end -->", re.DOTALL)
_WORSE = ("worse", "not_kept")


class Study(NamedTuple):
    """Stored files of the report of a study.

    Attributes:
        runs: Values of all runs of the main group.
        rows: Rows of verdicts.csv of the RMSE of each scenario and regime, once per filter.
        facts: Names and options.
    """

    runs: pd.DataFrame
    rows: pd.DataFrame
    facts: StudyFacts


@cache
def read_study(name: str) -> Study:
    """Read the stored files of a study.

    Args:
        name: Name of the study.
    """
    folder = TOP / "reports" / name
    rows = pd.read_csv(folder / "verdicts.csv")
    rows = rows[(rows["metric"] == "rmse") & (rows["world"] != "all") & (rows["regime"] != "all")]
    rows = rows.drop_duplicates(["world", "regime", "filter"])
    facts = StudyFacts.from_pack(read_page_data(folder))
    return Study(pd.read_parquet(folder / "runs.parquet"), rows, facts)


def _digits(value: float) -> str:
    """Format a number with three significant digits and no exponent."""
    return f"{float(f'{value:.3g}'):.15g}" if np.isfinite(value) else "–"


def _join(names: Iterable[str], empty: str) -> str:
    """Join labels in code style."""
    return ", ".join(f"`{name}`" for name in names) or empty


def format_median(errors: np.ndarray) -> str:
    """Format the median of the errors of runs with its interval. A run without an error counts as the largest.

    Args:
        errors: Error of each run, NaN for a lost run, [R].
    """
    values = np.where(np.isnan(errors), np.inf, errors)
    interval = order_statistic_interval(values, LEVEL)
    ordered = np.sort(values)
    median = (ordered[(values.size - 1) // 2] + ordered[values.size // 2]) / 2
    return f"{_digits(median)} [{_digits(interval.low)}, {_digits(interval.high)}]"


def world_table(study: Study, world: str) -> str:
    """Table of one scenario: filters by regimes, with the limit of its nominal noise.

    Args:
        study: Files of a study.
        world: Scenario.
    """
    rows = study.rows[study.rows["world"] == world].set_index(["regime", "filter"])
    runs = study.runs[study.runs["scenario"] == world]
    regimes = [name for name in study.facts.regimes if name in set(rows.index.get_level_values(0))]
    unit = str(runs["unit"].iloc[0])
    lines = markdown_head("filter", *(f"{name} [{unit}]" for name in regimes), "ms/step")
    for label, look in study.facts.looks.items():
        cells = []
        for regime in regimes:
            selected = runs[(runs["regime"] == regime) & (runs["filter"] == label)]
            if not len(selected):
                cells.append("failed")
                continue
            row = rows.loc[regime, label]
            marks = f"{100 * row['track']:.0f} / {100 * row['coverage']:.0f} %"
            cells.append(f"{format_median(selected['rmse'].to_numpy())}, {marks}")
        tier = " (B)" if look.tuning else ""
        times = rows.xs(label, level="filter")["ms"]
        lines.append(markdown_row(f"`{label}`{tier}", *cells, _digits(times.median())))
    return "\n".join([*lines, "", describe_limit(world)])


def describe_limit(world: str) -> str:
    """State the limit of the error in a scenario in nominal noise, or why there is none.

    Args:
        world: Scenario.
    """
    stored: dict[str, Any] = json.loads(LIMITS.read_text())[world]
    smoother = _digits(float(np.sqrt(np.nanmean(stored["smoother"]))))
    reached = f"The iterated smoother with cubature points has {smoother} {stored['unit']} in nominal noise."
    if stored["bound"] is not None:
        bound = f"{_digits(stored['bound'])} {stored['unit']}"
        return f"Limit in nominal noise, the PCRB of the model of the data: {bound}. {reached}"
    return f"No limit holds: {stored['reason'].removeprefix('no bound: ').rstrip('.')}. {reached}"


def find_strictly_robust(study: Study, world: str) -> tuple[str, ...]:
    """Return the filters that fulfil the rule of the word "robust" against each of three controls.

    The level is divided by the number of controls.

    Args:
        study: Files of a study.
        world: Scenario with outliers and nominal noise.
    """
    table = study.runs[study.runs["scenario"] == world]
    labels = tuple(study.facts.looks)
    alpha = study.facts.options.alpha / len(CONTROLS)
    sets = []
    for control in CONTROLS:
        evidence = compare_with_control(table, labels, control=control)
        sets.append(find_robust_filters(evidence or {}, alpha))
    return tuple(name for name in labels if all(name in names for names in sets))


def describe_robust(name: str) -> str:
    """Describe the robust filters of each scenario of a study.

    Args:
        name: Name of the study.
    """
    study, lines = read_study(name), []
    for world in study.facts.worlds:
        table = study.runs[study.runs["scenario"] == world]
        if text := describe_robustness(table, study.facts.looks, study.facts.options):
            strict = _join(find_strictly_robust(study, world), "none")
            plain = text.replace("[[", "").replace("]]", "")
            lines.append(f"- `{world}`: {plain} Against all three controls: {strict}.")
    return "\n".join(lines)


def compare_sampled(study: Study, world: str, regime: str, candidates: Sequence[str]) -> str:
    """Compare filters with the best Kalman filter of a condition, by the verdicts against its best filter.

    Args:
        study: Files of a study.
        world: Scenario.
        regime: Noise regime.
        candidates: Labels of the filters that are compared with the Kalman filters.

    Returns:
        Words on the comparison.
    """
    rows = study.rows[(study.rows["world"] == world) & (study.rows["regime"] == regime)]
    rows = rows.sort_values("rank")
    is_kalman = rows["filter"].map(
        lambda label: study.facts.looks[label].family == KALMAN and label != SAMPLED_HYPOTHESES
    )
    kalman, sampled = rows[is_kalman].iloc[0], rows[rows["filter"].isin(candidates)]
    if not len(sampled):
        return "not in the study"
    first = sampled.iloc[0]
    if first["rank"] < kalman["rank"] and first["verdict"] == "best":
        word = "better than" if kalman["verdict"] in _WORSE else "not decided against"
    else:
        word = "not better than"
    return f"`{first['filter']}` {word} `{kalman['filter']}`"


def recorded() -> str:
    """Compare particle filters with the best Kalman filter in each condition of recorded data."""
    lines = markdown_head("world", "regime", "particles of the state", "particles of hypotheses")
    wins: list[list[str]] = [[], []]
    for name in RECORDED:
        study = read_study(name)
        families = {label: look.family for label, look in study.facts.looks.items()}
        groups = [label for label, family in families.items() if family != KALMAN], [SAMPLED_HYPOTHESES]  # fmt: skip
        for world, regime in study.rows[["world", "regime"]].drop_duplicates().to_numpy():
            words = [compare_sampled(study, world, regime, group) for group in groups]
            lines.append(markdown_row(f"`{world}`", regime, *words))
            for won, word in zip(wins, words, strict=True):
                won += [f"`{world}` with {regime}"] if " better than" in word and "not better" not in word else []  # fmt: skip
    kinds = ("particles of the state", "particles of hypotheses")
    ends = [
        f"A filter with {kind} is better than the best Kalman filter in: {'; '.join(won)}."
        if won
        else f"No filter with {kind} is shown to be better than the best Kalman filter in any recorded world."
        for kind, won in zip(kinds, wins, strict=True)
    ]
    return "\n".join([*lines, "", *ends])


def study_tables(name: str) -> str:
    """Tables of all scenarios of a study.

    Args:
        name: Name of the study.
    """
    study = read_study(name)
    return "\n\n".join(
        f"`{world}`: {look.words}.\n\n{world_table(study, world)}"
        for world, look in study.facts.worlds.items()
    )


def robust() -> str:
    """Describe the robust filters of all studies."""
    return "\n".join(filter(None, map(describe_robust, STUDIES)))


BLOCKS: dict[str, Callable[[], str]] = {"robust": robust, "recorded": recorded}


def fill_page(text: str) -> str:
    """Replace the content of all number blocks of a page.

    Args:
        text: Content of docs/robustness.md.
    """

    def replace(match: re.Match[str]) -> str:
        name = match[1]
        content = BLOCKS[name]() if name in BLOCKS else study_tables(name)
        return f"<!-- numbers:{name} -->\n{content}\n<!-- numbers:end -->"

    return _BLOCK.sub(replace, text)


if __name__ == "__main__":
    PAGE.write_text(fill_page(PAGE.read_text()))
