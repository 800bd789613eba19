"""Tables of a report as pandas data frames of plain numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from pfbench.report.table_formats import format_number
from pfbench.results import consistency, error_measures, metric_values, metrics, status, store
from pfbench.results.comparison.pairwise_results import INCONCLUSIVE, PairwiseTest
from pfbench.results.state_groups import ComponentGroup, component_groups

Results = Mapping[str, store.JobResult]


_OPTIONAL = (  # columns of the overview that some filters or older results do not have, besides those of metrics
    "likelihood evaluations per step", "peak memory above baseline [MiB]", "mean NIS per component (expected 1)",
    "NIS 95 % interval",
)  # fmt: skip


_LAST = 20  # final steps of the horizontal error [Pu and Qin, section 4]


def overview_table(results: Results, alpha: float = 0.05) -> pd.DataFrame:
    """Build the overview table, a row per filter, without empty columns.

    Args:
        results: Results by label, from the start time on.
        alpha: Probability outside the NIS interval.
    """
    rows = pd.DataFrame([_overview_row(label, result, alpha) for label, result in results.items()])
    heads = [
        metric.column_head() for metric in metrics.METRICS if metric.scope == "job" and metric.head
    ]
    optional = [*_OPTIONAL, *heads]
    return rows.drop(
        columns=[name for name in optional if (rows[name].isna() | (rows[name] == "")).all()]
    )


def accuracy_table(
    results: Results,
    group: str,
    verdicts: Sequence[PairwiseTest] = (),
    alpha: float = 0.05,
    bound: float | None = None,
    full_results: Results | None = None,
) -> pd.DataFrame:
    """Build the accuracy table of a component group, a row per filter.

    Args:
        results: Results by label, from the start time on.
        group: Name of the component group.
        verdicts: Pairwise tests of the group, which add the columns better than and worse than.
        alpha: Probability outside the NEES interval.
        bound: Error limit in the displayed unit, which adds the median convergence time.
        full_results: Results by label with all times, for the convergence time.
    """
    rows = []
    for label, result in results.items():
        for block in component_groups(result.meta["state"]):
            if block.group == group:
                row = {"filter": label, **_accuracy_row(result, block, alpha)}
                if bound is not None:
                    row |= _convergence_column((full_results or results)[label], block, bound)
                rows.append({**row, **_count_decisions(label, verdicts)} if verdicts else row)
    return pd.DataFrame(rows)


def short_accuracy_table(table: pd.DataFrame) -> pd.DataFrame:
    """Select the columns of `accuracy_table` that a brief report shows for groups except the main group."""
    heads = (
        "filter",
        "valid runs",
        "RMSE of the norm",
        "mean NEES",
        "coverage of the 90 %",
        "RMSE / PCRB",
        "better",
        "worse",
    )
    return table[[name for name in table if str(name).startswith(heads)]]


def _overview_row(label: str, result: store.JobResult, alpha: float) -> dict[str, Any]:
    meta, data = result.meta, result.data
    lost, particles = data["lost"], meta.get("particles")
    count = status.count_statuses(data, meta)
    nis, band = _mean_nis(result, alpha)
    return {
        "filter": label,
        "asymptotically exact": bool(meta.get("is_exact")),
        "oracle noise": bool(meta.get("oracle_noise")),
        "particles": str(particles or "–"),
        "runs": count.runs,
        "lost runs": count.lost,
        "lost runs [%]": 100 * float(status.lost_fraction(lost).value),
        "diverged runs": "–" if count.diverged is None else str(count.diverged),
        "overconfident runs": count.overconfident,
        "severely overconfident runs": count.severely_overconfident,
        "collapsed runs": count.collapsed,
        "time per step [ms]": 1e3 * meta["seconds"]["per_step"],
        "likelihood evaluations per step": meta.get("likelihoods_per_step", np.nan),
        "peak memory above baseline [MiB]": (meta.get("memory") or np.nan) / 2**20,
        **metrics.table_columns(result, "job"),
        "mean NIS per component (expected 1)": nis,
        "NIS 95 % interval": band,
        "log evidence": _mean(metric_values.run_log_evidence(result)),
    }


def _mean_nis(result: store.JobResult, alpha: float) -> tuple[float, str]:
    """Normalised innovation squared per component seen, over the runs that were not lost, and its band."""
    if "nis" not in result.data:
        return np.nan, ""
    valid = ~result.data["lost"]
    nis, dof = (
        np.asarray(result.data[name], dtype=np.float64)[valid] for name in ("nis", "nis_dof")
    )
    count = int(np.nansum(dof))
    if not count:
        return np.nan, ""
    low, high = consistency.nees_band(count, 1, alpha)
    return float(np.nansum(nis) / count), f"{float(low) / count:.3g} to {float(high) / count:.3g}"


def _convergence_column(
    result: store.JobResult, block: ComponentGroup, bound: float
) -> dict[str, Any]:
    error = result.data["error"][..., block.places].astype(np.float64) * block.scale
    when = error_measures.convergence_time(result.data["time"], error, result.data["lost"], bound)
    return {f"median time to {bound:g} {block.unit} [s]": float(np.median(when[~np.isnan(when)]))}


def _accuracy_row(result: store.JobResult, block: ComponentGroup, alpha: float) -> dict[str, Any]:
    data, lost, groups = result.data, result.data["lost"], result.meta["state"]["groups"]
    error = data["error"][..., block.places].astype(np.float64) * block.scale
    norm = error_measures.rmse_norm(error, lost)
    by_component = error_measures.rmse_component(error, lost).value
    largest = error_measures.max_error(error, lost)[~lost]
    dof = len(groups[block.state_group])
    nees = consistency.compute_consistency(
        data["nees"][..., list(groups).index(block.state_group)], lost, dof, alpha
    )
    low, high = consistency.nees_band(dof, nees.runs, alpha)
    unit = f" [{block.unit}]" if block.unit else ""
    row: dict[str, Any] = {
        "valid runs": norm.runs,
        f"RMSE of the norm{unit}": float(norm.value),
        f"mean run RMSE{unit}": float(error_measures.rmse_run_mean(error, lost).value),
        **{
            f"RMSE {name.removeprefix(f'{block.group}_')}{unit}": float(value)
            for name, value in zip(block.components, by_component, strict=True)
        },
        f"maximum error{unit}": float(np.max(largest[~np.isnan(largest)])) if norm.runs else np.nan,
        f"mean NEES (expected {dof})": nees.mean,
        "NEES consistency": status.classify_consistency(nees, dof, alpha),
        "95 % interval at one step": f"{format_number(float(low))} to {format_number(float(high))}",
        "steps inside the interval [%]": 100 * nees.inside,
    }
    row |= metrics.table_columns(result, "components", block)
    if "pcrb" in data:
        floor = data["pcrb"][:, block.places].astype(np.float64) * block.scale
        row["RMSE / PCRB"] = error_measures.rmse_to_pcrb(error, lost, floor)
    if "range" in data and block.state_group == "position":
        for name, last in (("", None), (f", last {_LAST} steps", _LAST)):
            share = error_measures.relative_error(
                error[..., :2] / block.scale, lost, data["range"], last
            )
            row[f"horizontal error [% of range]{name}"] = 100 * float(share.value)
    return row


def _count_decisions(label: str, verdicts: Sequence[PairwiseTest]) -> dict[str, Any]:
    """Count the filters that are worse and better than a filter."""
    met = [v for v in verdicts if label in (v.a, v.b)]
    beaten = sum(v.winner not in (label, INCONCLUSIVE) for v in met)
    return {
        "better than [filters]": sum(v.winner == label for v in met),
        "worse than [filters]": beaten,
    }


def _mean(values: np.ndarray) -> float:
    """Return the mean of the values that are not NaN, or NaN."""
    finite = values[~np.isnan(values)]
    return float(finite.mean()) if finite.size else np.nan
