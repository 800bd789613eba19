"""Entries of the data of a page, and the table of runs behind its board."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from pfbench.report.options import ReportOptions
from pfbench.results import status, store
from pfbench.results.conditions import Condition, main_component_group, parse_label
from pfbench.results.frame import drop_before
from pfbench.results.looks import MethodLook, PartName, add_tuning, find_looks
from pfbench.results.metrics import MetricInput, compute_metric, page_metrics
from pfbench.results.paper_block import list_named_parts
from pfbench.results.step_times import STEP_TIME, WARM_UP, StepTimes
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


_OPTIONS = ("alpha", "equivalence_margin", "metric", "baseline", "home")  # that decide
CellKey = tuple[str, str]  # world and regime


class StudyFacts(NamedTuple):
    """Inputs of decisions other than the runs.

    Attributes:
        looks: Looks by label.
        worlds: Names of the scenarios by key.
        regimes: Names of the noise regimes by key.
        options: Options of the report.
        times: Times in rounds by label, of each scenario and regime.
        failures: Jobs that failed.
        warning: Sentence on runs that are not independent; empty if none is shown.
        differing: Sentence on conditions whose jobs differ in their data; empty without any.
        records: Recorded conditions with the losses of their blocks of time.
    """

    looks: Mapping[str, MethodLook]
    worlds: Mapping[str, PartName]
    regimes: Mapping[str, PartName]
    options: ReportOptions
    times: Mapping[CellKey, Mapping[str, StepTimes]]
    failures: Sequence[Any] = ()
    warning: str = ""
    differing: str = ""
    records: Sequence[Mapping[str, Any]] = ()

    def to_entries(self) -> dict[str, Any]:
        """Return plain values, from which `from_pack` restores the facts."""
        return {
            "options": {name: getattr(self.options, name) for name in _OPTIONS},
            "looks": [asdict(look) for look in self.looks.values()],
            "regimes": [asdict(name) for name in self.regimes.values()],
            "times": [
                [*key, {label: times._replace(seconds=times.seconds.tolist())._asdict()
                        for label, times in by_label.items()}]
                for key, by_label in self.times.items() if by_label
            ],
            "warning": self.warning,
            "differing": self.differing,
            "records": list(self.records),
        }  # fmt: skip

    @classmethod
    def from_pack(cls, pack: Mapping[str, Any]) -> StudyFacts:
        """Restore the facts of a stored page. Installed methods have their present looks, and the stored data of their tuning.

        Args:
            pack: Data of a page.
        """
        facts = pack["facts"]
        stored = {v["key"]: MethodLook(**{**v, "baselines": tuple(v["baselines"])}) for v in facts["looks"]}  # fmt: skip
        methods = {parse_label(label)[0] for label in stored}
        is_installed = methods <= set(list_named_parts("filter"))
        present = find_looks(list(stored)) if is_installed else stored
        return cls(
            {
                key: add_tuning(look, stored[key].tuning, stored[key].tuned_on)
                for key, look in present.items()
            },
            {entry["key"]: PartName(**entry) for entry in pack["worlds"]},
            {entry["key"]: PartName(**entry) for entry in facts["regimes"]},
            ReportOptions(**facts["options"]),
            {
                (world, regime): {
                    label: StepTimes(np.array(times["seconds"]), times["group"])
                    for label, times in by_label.items()
                }
                for world, regime, by_label in facts["times"]
            },
            pack["failures"],
            facts["warning"],
            facts["differing"],
            tuple(facts.get("records", ())),
        )


def list_metrics(values: Mapping[str, Any] | pd.DataFrame, main: str = "rmse") -> list[str]:
    """List the metrics of a board: that which decides first, then all that have values."""
    names = [name for name in page_metrics() if name in values]
    names.sort(key=lambda name: name != main)
    return [n for n in names if n in (main, "rmse") or not np.isnan(np.asarray(values[n])).all()]


def format_interval_level(alpha: float) -> str:
    """Format the level of an interval in percent."""
    return f"{100 * (1 - alpha):g} %"


def round_values(values: Any, digits: int = 4) -> Any:
    """Round numbers to some digits, but none to 1 that is not 1; a number that is not finite becomes None."""
    if isinstance(values, dict):
        return {key: round_values(value, digits) for key, value in values.items()}
    if isinstance(values, list):
        return [round_values(value, digits) for value in values]
    if isinstance(values, float):
        digits = digits if abs(values - 1.0) > 1e-3 else 9
        return float(f"{values:.{digits}g}") if math.isfinite(values) else None
    return None if values == "" else values


def describe_uncommitted(metadata: Sequence[Mapping[str, Any]]) -> str:
    """State how many jobs were computed by code that no commit has; empty if none was."""
    commits = [str(meta.get("versions", {}).get("commit") or "") for meta in metadata]
    number = sum(commit.endswith("-dirty") for commit in commits)
    return f"{number} of {len(metadata)} jobs are of uncommitted code." if number else ""


def regime_entries(table: pd.DataFrame, regimes: Mapping[str, PartName]) -> list[dict[str, Any]]:
    """List the entries of the noise regimes."""
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


def budget_entries(metadata: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """List the entries of the budgets, each with the reason why the study lacks it."""
    kinds = {str(meta["config"].get("budget", SAME_N)) for meta in metadata}
    return [
        {"key": key, "name": name,
         "reason_missing": None if key in kinds else f"The study has no jobs with budget={key}."}
        for key, name in _BUDGET_NAMES.items() if key in kinds or key != SAME_LIKELIHOODS
    ]  # fmt: skip


def metric_entries(table: pd.DataFrame, main: str) -> list[dict[str, Any]]:
    """List the entries of the metrics."""
    units, groups = table["unit"].unique(), table["group"].unique()
    unit, group = units[0] if len(units) == 1 else "", groups[0] if len(groups) == 1 else "main"
    entries = {key: page_metrics()[key] for key in list_metrics(table, main)}
    return [
        {"key": key, "name": metric.page_name, "unit": unit if metric.is_of_group else "", "direction": "lower",
         "caption": f"{metric.page_name} of the {f'group {group}' if metric.is_of_group else 'filter'}."}
        for key, metric in entries.items()
    ]  # fmt: skip


# --------------------------------------------------------------------------------------------------
# Table of a study with one row per filter, condition and run: all numbers behind its board.


def build_run_table(
    conditions: Sequence[Condition], start_time_s: float = 0.0, metric: str = "rmse"
) -> pd.DataFrame:
    """Build the table of a study."""
    parts = [
        job_rows((condition, regime, job.label), drop_before(job.load(), start_time_s), metric)
        for condition, regime in zip(conditions, name_regimes(conditions), strict=True)
        for job in condition.jobs
    ]
    return join_rows(parts, metric)


def join_rows(parts: Sequence[pd.DataFrame], metric: str) -> pd.DataFrame:
    """Join the rows of all jobs."""
    for rows in parts:
        if (rows[metric].isna() & rows["keeps_track"]).all() and rows["keeps_track"].any():
            where = " / ".join(rows[["scenario", "regime", "filter"]].iloc[0])
            raise ValueError(
                f"report.metric must be a metric of all results, got {metric} without values of {where}. "
                "Choose report.metric=rmse, or run with score_steps above 0."
            )
    return pd.concat(parts, ignore_index=True)


def name_regimes(conditions: Sequence[Condition]) -> list[str]:
    """Name the regime of each condition: the noise, with the model if a scenario has several."""
    models = Counter((c.scenario, c.noise) for c in conditions)
    return [
        c.noise if models[c.scenario, c.noise] == 1 else f"{c.noise} + {c.model}"
        for c in conditions
    ]


def job_rows(
    origin: tuple[Condition, str, str], result: store.JobResult, metric: str = "rmse"
) -> pd.DataFrame:
    """Build the rows of one job."""
    condition, regime, label = origin
    meta, lost = result.meta, np.asarray(result.data["lost"], dtype=bool)
    group = main_component_group(meta["state"])
    particles, rounds, seconds = meta.get("particles"), meta.get(STEP_TIME), meta["seconds"]
    data, missing = MetricInput(result, group, group.state_group), np.full(lost.size, np.nan)
    components = {
        name: entry.component
        for name, entry in page_metrics().items()
        if name == metric or not entry.only_decides
    } | {"coverage_50": "mean", "coverage_90": "mean", "nees_ratio": "norm"}
    values = {name: compute_metric(name, data).get(k, missing) for name, k in components.items()}
    columns = {
        "filter": label,
        "scenario": condition.scenario,
        "family": status.scenario_family(meta, condition.scenario),
        "regime": regime,
        "model": condition.model,
        "particles": np.nan if particles is None else float(particles),
        "seed": int(meta["seed"]),
        "run": np.arange(lost.size) + int(meta.get("first_run", 0)),
        "lost": lost,
        "keeps_track": status.keeps_track(result.data, meta),
        "unit": group.unit,
        "group": group.group,
        **{name: np.where(lost, np.nan, np.asarray(v, dtype=np.float64)) for name, v in values.items()},
        # NaN for a time that holds the first steps of a process
        "ms": 1e3 * float(rounds["median"] if rounds else seconds["per_step"] if WARM_UP in seconds else math.nan),
    }  # fmt: skip
    return pd.DataFrame(columns)
