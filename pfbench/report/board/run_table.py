"""Table of a study with one row per filter, condition and run: all numbers behind its board."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import pandas as pd

from pfbench.results import metrics, status, store
from pfbench.results.conditions import Condition
from pfbench.results.frame import drop_before
from pfbench.results.metric_values import MetricInput
from pfbench.results.state_groups import ComponentGroup, main_component_group
from pfbench.results.step_times import STEP_TIME

# metrics of the main group that a board can show, each with the component of its value
SHOWN_METRICS: Mapping[str, str] = {"rmse": "norm", "max_error": "norm", "crps": "mean"}
# metrics that can decide a study, but are shown only if they do
LOG_SCORE = "log_score"  # of a filter, not of a group: a logarithm without unit
_MAIN_ONLY: Mapping[str, str] = {"energy": "norm", LOG_SCORE: ""}
METRIC_NAMES = {
    "rmse": "RMS error", "max_error": "largest error", "crps": "CRPS", "energy": "energy score",
    LOG_SCORE: "inverse predictive density per step",
}  # fmt: skip


def build_run_table(
    conditions: Sequence[Condition], start_time_s: float = 0.0, metric: str = "rmse"
) -> pd.DataFrame:
    """Build the table of a study.

    Args:
        conditions: Conditions of the study.
        start_time_s: Time before which steps are ignored, s.
        metric: Metric that decides the study, one of `main_metrics.MAIN_METRICS`.

    Returns:
        Columns filter, scenario, family, regime, model, particles, seed, run, lost, keeps_track,
        unit, group, the metrics of `SHOWN_METRICS`, coverage_50, coverage_90, nees_ratio and ms.
        A run without a value has NaN.

    Raises:
        ValueError: If a job lacks values of the metric that decides.
    """
    parts = [
        job_rows((condition, regime, job.label), drop_before(job.load(), start_time_s), metric)
        for condition, regime in zip(conditions, name_regimes(conditions), strict=True)
        for job in condition.jobs
    ]
    return join_rows(parts, metric)


def join_rows(parts: Sequence[pd.DataFrame], metric: str) -> pd.DataFrame:
    """Join the rows of all jobs.

    Args:
        parts: Rows of `job_rows`.
        metric: Metric that decides the study.

    Raises:
        ValueError: If a job lacks values of that metric.
    """
    for rows in parts:
        if (rows[metric].isna() & rows["keeps_track"]).all() and rows["keeps_track"].any():
            where = " / ".join(rows[["scenario", "regime", "filter"]].iloc[0])
            raise ValueError(
                f"report.metric must be a metric of all results, got {metric} without values of {where}. "
                "Choose report.metric=rmse, or run with score_steps above 0."
            )
    return pd.concat(parts, ignore_index=True)


def name_regimes(conditions: Sequence[Condition]) -> list[str]:
    """Name the regime of each condition: the noise, with the model if a scenario has several.

    Args:
        conditions: Conditions of the study.
    """
    models = Counter((c.scenario, c.noise) for c in conditions)
    return [
        c.noise if models[c.scenario, c.noise] == 1 else f"{c.noise} + {c.model}"
        for c in conditions
    ]


def job_rows(
    origin: tuple[Condition, str, str], result: store.JobResult, metric: str = "rmse"
) -> pd.DataFrame:
    """Build the rows of one job.

    Args:
        origin: Condition, name of its regime, and label of the filter.
        result: Result of the job.
        metric: Metric that decides the study.
    """
    condition, regime, label = origin
    meta, lost = result.meta, np.asarray(result.data["lost"], dtype=bool)
    group = main_component_group(meta["state"])
    particles = meta.get("particles")
    components = {**SHOWN_METRICS, **{k: v for k, v in _MAIN_ONLY.items() if k == metric}}
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
        **dict(_metric_columns(result, group, lost, components)),
        "ms": 1e3 * float(meta.get(STEP_TIME, {}).get("median", meta["seconds"]["per_step"])),
    }
    return pd.DataFrame(columns)


def _metric_columns(
    result: store.JobResult,
    group: ComponentGroup,
    lost: np.ndarray,
    components: Mapping[str, str],
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the values of the main group by metric."""
    data = MetricInput(result, group, group.state_group)
    missing = np.full(lost.size, np.nan)
    for name, component in components.items():
        values = metrics.compute_metric(name, data).get(component, missing)
        yield name, np.where(lost, np.nan, np.asarray(values, dtype=np.float64))
    for name in ("coverage_50", "coverage_90"):
        values = metrics.compute_metric(name, data).get("mean", missing)
        yield name, np.where(lost, np.nan, np.asarray(values, dtype=np.float64))
    dof = len(result.meta["state"]["groups"][group.state_group])
    nees = metrics.compute_metric("nees", data).get("norm", missing)
    yield "nees_ratio", np.where(lost, np.nan, np.asarray(nees, dtype=np.float64) / dof)
