"""Entries of the data of a page: filters, parts, metrics and planned pairs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import pandas as pd

from pfbench.report import provenance
from pfbench.report.board.run_table import LOG_SCORE, METRIC_NAMES
from pfbench.report.looks import MethodLook, PartName
from pfbench.results.conditions import Condition
from pfbench.results.store import SAME_LIKELIHOODS, SAME_N

_BUDGET_NAMES = {"particles": "Equal N", "time": "Equal time", "likelihoods": "Equal likelihoods"}


class ViewKey(NamedTuple):
    """Key of a view.

    Attributes:
        metric: Column of the error.
        world: Key of the scenario, or "all".
        regime: Key of the regime, or "all".
        baseline: Label of the baseline.
    """

    metric: str
    world: str
    regime: str
    baseline: str


class StudyNames(NamedTuple):
    """Names of the parts of a study.

    Attributes:
        looks: Looks by label.
        worlds: Names of the scenarios by key.
        regimes: Names of the noise regimes by key.
        baselines: Labels of the baselines.
    """

    looks: Mapping[str, MethodLook]
    worlds: Mapping[str, PartName]
    regimes: Mapping[str, PartName]
    baselines: Sequence[str]


def list_metrics(table: pd.DataFrame, main: str = "rmse") -> list[str]:
    """List the metrics of a board: that which decides first, then all that have values.

    Args:
        table: Table of `build_run_table`.
        main: Metric that decides the study.
    """
    names = [name for name in METRIC_NAMES if name in table]
    names.sort(key=lambda name: name != main)
    return [name for name in names if name in (main, "rmse") or table[name].notna().any()]


def format_interval_level(alpha: float) -> str:
    """Format the level of an interval in percent.

    Args:
        alpha: Probability outside the interval.
    """
    return f"{100 * (1 - alpha):g} %"


def round_values(values: Any) -> Any:
    """Round numbers to four digits; a number that is not finite becomes None."""
    if isinstance(values, dict):
        return {key: round_values(value) for key, value in values.items()}
    if isinstance(values, list):
        return [round_values(value) for value in values]
    if isinstance(values, float):
        return float(f"{values:.4g}") if math.isfinite(values) else None
    return None if values == "" else values


def describe_versions(conditions: Sequence[Condition]) -> dict[str, str]:
    """Return builds, date and version of the results. The build of uncommitted code is not its commit."""
    metadata = [job.meta for c in conditions for job in c.jobs]
    versions = metadata[0].get("versions", {})
    return {
        "commit": ", ".join(provenance.list_builds(metadata)),
        "date": max(str(meta.get("created", ""))[:10] for meta in metadata),
        "version": str(versions.get("pfbench", "")),
    }


def describe_uncommitted(conditions: Sequence[Condition]) -> str:
    """State how many jobs were computed by code that no commit has; empty if none was."""
    metadata = [job.meta for c in conditions for job in c.jobs]
    number = sum(provenance.is_uncommitted(meta) for meta in metadata)
    return f"{number} of {len(metadata)} jobs are of uncommitted code." if number else ""


def filter_entry(look: MethodLook) -> dict[str, Any]:
    """Return the entry of a filter."""
    return {
        "key": look.key, "name": look.name, "long": look.long_name, "family": look.family,
        "proposed": look.proposed, "colour": look.colour, "dark": look.dark_colour,
        "marker": look.marker, "cite": look.cite,
    }  # fmt: skip


def regime_entries(table: pd.DataFrame, regimes: Mapping[str, PartName]) -> list[dict[str, Any]]:
    """List the entries of the noise regimes.

    Args:
        table: Table of `build_run_table`.
        regimes: Names by key.
    """
    entries = []
    for key in table["regime"].unique():
        noise, _, model = key.partition(" + ")
        name = f"{regimes[noise].name} + {model}" if model else regimes[noise].name
        entries.append({"key": key, "name": name, "words": regimes[noise].words})
    return entries


def cell_entries(table: pd.DataFrame) -> list[dict[str, Any]]:
    """List the entries of the cells.

    Args:
        table: Table of `build_run_table`.
    """
    is_ambiguous = table.groupby("scenario")["model"].nunique().max() > 1
    cells = []
    for (world, regime), rows in table.groupby(["scenario", "regime"], sort=False):
        particles = rows["particles"].max()
        cells.append({
            "world": world, "regime": regime, "noise": str(regime).partition(" + ")[0],
            "model": rows["model"].iloc[0] if is_ambiguous else "",
            "runs": int(rows.groupby("filter").size().max()), "seed": int(rows["seed"].iloc[0]),
            "particles": None if math.isnan(particles) else int(particles),
        })  # fmt: skip
    return cells


def budget_entries(conditions: Sequence[Condition]) -> list[dict[str, Any]]:
    """List the entries of the budgets, each with the reason why the study lacks it.

    Args:
        conditions: Conditions of the study.
    """
    jobs = [job.meta for condition in conditions for job in condition.jobs]
    kinds = {str(meta["config"].get("budget", SAME_N)) for meta in jobs}
    return [
        {"key": key, "name": name,
         "reason_missing": None if key in kinds else f"The study has no jobs with budget={key}."}
        for key, name in _BUDGET_NAMES.items() if key in kinds or key != SAME_LIKELIHOODS
    ]  # fmt: skip


def metric_entries(table: pd.DataFrame, main: str) -> list[dict[str, Any]]:
    """List the entries of the metrics.

    Args:
        table: Table of `build_run_table`.
        main: Metric that decides the study.
    """
    units, groups = table["unit"].unique(), table["group"].unique()
    unit, group = units[0] if len(units) == 1 else "", groups[0] if len(groups) == 1 else "main"
    return [
        {"key": key, "name": METRIC_NAMES[key], "unit": "" if key == LOG_SCORE else unit, "direction": "lower",
         "caption": f"{METRIC_NAMES[key]} of the {'filter' if key == LOG_SCORE else f'group {group}'}."}
        for key in list_metrics(table, main)
    ]  # fmt: skip
