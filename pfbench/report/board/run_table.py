"""Table of a study with one row per filter, condition and run: all numbers behind its board."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from pfbench.results import metrics, status, store
from pfbench.results.conditions import Condition
from pfbench.results.frame import drop_before
from pfbench.results.metric_values import MetricInput
from pfbench.results.state_groups import ComponentGroup, main_component_group

# metrics of the main group that a board can show, each with the component of its value
SHOWN_METRICS: Mapping[str, str] = {"rmse": "norm", "max_error": "norm", "crps": "mean"}
METRIC_NAMES = {"rmse": "RMS error", "max_error": "largest error", "crps": "CRPS"}


def build_run_table(conditions: Sequence[Condition], start_time_s: float = 0.0) -> pd.DataFrame:
    """Build the table of a study.

    Args:
        conditions: Conditions of the study.
        start_time_s: Time before which steps are ignored, s.

    Returns:
        Columns filter, scenario, family, regime, model, particles, seed, run, lost, keeps_track,
        unit, group, the metrics of `SHOWN_METRICS`, coverage_50, coverage_90, nees_ratio and ms.
        A run without a value has NaN.
    """
    models: Counter[tuple[str, str]] = Counter((c.scenario, c.noise) for c in conditions)
    parts = [
        pd.DataFrame(
            _job_columns(condition, job.label, drop_before(job.load(), start_time_s), name)
        )
        for condition in conditions
        for name in [_regime(condition, models)]
        for job in condition.jobs
    ]
    return pd.concat(parts, ignore_index=True)


def _regime(condition: Condition, models: Mapping[tuple[str, str], int]) -> str:
    """Return the noise, with the model if a scenario has several."""
    if models[condition.scenario, condition.noise] == 1:
        return condition.noise
    return f"{condition.noise} + {condition.model}"


def _job_columns(
    condition: Condition, label: str, result: store.JobResult, regime: str
) -> dict[str, Any]:
    """Return the columns of one job."""
    meta, lost = result.meta, np.asarray(result.data["lost"], dtype=bool)
    group = main_component_group(meta["state"])
    particles = meta.get("particles")
    return {
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
        **dict(_metric_columns(result, group, lost)),
        "ms": 1e3 * float(meta["seconds"]["per_step"]),
    }


def _metric_columns(
    result: store.JobResult, group: ComponentGroup, lost: np.ndarray
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the values of the main group by metric."""
    data = MetricInput(result, group, group.state_group)
    missing = np.full(lost.size, np.nan)
    for name, component in SHOWN_METRICS.items():
        values = metrics.compute_metric(name, data).get(component, missing)
        yield name, np.where(lost, np.nan, np.asarray(values, dtype=np.float64))
    for name in ("coverage_50", "coverage_90"):
        values = metrics.compute_metric(name, data).get("mean", missing)
        yield name, np.where(lost, np.nan, np.asarray(values, dtype=np.float64))
    dof = len(result.meta["state"]["groups"][group.state_group])
    nees = metrics.compute_metric("nees", data).get("norm", missing)
    yield "nees_ratio", np.where(lost, np.nan, np.asarray(nees, dtype=np.float64) / dof)
