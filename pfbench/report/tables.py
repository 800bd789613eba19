"""Tables of a report as pandas data frames of plain numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from pfbench.report.summary import BaselineComparison
from pfbench.report.table_formats import format_number
from pfbench.results import consistency, error_measures, metrics, status, store
from pfbench.results.comparison.lost_run_rules import LOST_RUN_RULES
from pfbench.results.comparison.lost_run_sensitivity import LostRunSensitivity
from pfbench.results.comparison.pairwise_results import INCONCLUSIVE, PairwiseTest
from pfbench.results.comparison.ranking_results import RankingResult
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
    rows = pd.DataFrame([_ran(label, result, alpha) for label, result in results.items()])
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
        whole: Results by label with all times, for the convergence time.
    """
    rows = []
    for label, result in results.items():
        for block in component_groups(result.meta["state"]):
            if block.group == group:
                row = {"filter": label, **_accuracy(result, block, alpha)}
                if bound is not None:
                    row |= _settled((full_results or results)[label], block, bound)
                rows.append({**row, **_standing(label, verdicts)} if verdicts else row)
    return pd.DataFrame(rows)


def short_accuracy_table(table: pd.DataFrame) -> pd.DataFrame:
    """Select the columns of `accuracy` that a brief report shows for groups except the main group."""
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


def decision_table(verdicts: Sequence[PairwiseTest]) -> pd.DataFrame:
    """Build the table of decisions, a row per pair of filters."""
    return pd.DataFrame(
        [
            {
                "a": v.a,
                "b": v.b,
                "pairs": v.pairs,
                "lost runs a": v.lost_a,
                "lost runs b": v.lost_b,
                "RMSE change a vs b [%]": 100 * (v.ratio - 1),
                "lower [%]": 100 * (v.low - 1),
                "upper [%]": 100 * (v.high - 1),
                "interval method": v.interval,
                "rank-biserial correlation": v.effect,
                "T": v.statistic,
                "p": v.p,
                f"adjusted p (Holm, {v.family} tests)": v.p_holm,
                "decision": _decision(v),
            }
            for v in verdicts
        ]
    )


def effect_table(verdicts: Sequence[PairwiseTest]) -> pd.DataFrame:
    """Build the table of effect sizes, equivalence and required runs, a row per pair."""
    return pd.DataFrame(
        [
            {
                "a": v.a,
                "b": v.b,
                "rank-biserial correlation": v.effect,
                "correlation lower": v.effect_low,
                "correlation upper": v.effect_high,
                "P(error a < error b)": v.better,
                "P lower": v.better_low,
                "P upper": v.better_high,
                f"adjusted equivalence p (±{100 * v.margin:g} %, {v.family} tests)": v.p_equivalent,
                "equivalent": v.equivalent,
                "SD of log RMSE ratio [%]": 100 * v.scatter,
                f"runs required for ±{100 * v.wanted:g} % (power 0.8)": _whole(v.needed),
                "smallest detectable change [%]": 100 * v.detectable,
            }
            for v in verdicts
        ]
    )


def all_comparisons_table(verdicts: Sequence[PairwiseTest]) -> pd.DataFrame:
    """Build the short table of all comparisons of the report."""
    return pd.DataFrame(
        [
            {
                "condition": f"{v.scenario} / {v.noise} / {v.model}",
                "group": v.group,
                "a": v.a,
                "b": v.b,
                "RMSE change a vs b [%]": 100 * (v.ratio - 1),
                "P(error a < error b)": v.better,
                "adjusted p (Holm, condition)": v.p_holm,
                f"adjusted p (Holm, {v.page} tests)": v.p_page,
                "decision": _decision(v),
            }
            for v in verdicts
        ]
    )


def rank_table(rankings: Sequence[RankingResult]) -> pd.DataFrame:
    """Build the table of mean ranks over conditions, a column per group."""
    made = [one for one in rankings if not one.refused]
    labels = list(dict.fromkeys(label for one in made for label in one.filters))
    by_group = {
        f"rank, {one.group}": dict(zip(one.filters, one.ranks, strict=True)) for one in made
    }
    return pd.DataFrame(
        [
            {"filter": label, **{k: own.get(label, np.nan) for k, own in by_group.items()}}
            for label in labels
        ]
    )


def ranking_pair_table(ranking: RankingResult) -> pd.DataFrame:
    """Build the table of pairs across conditions for a group."""
    return pd.DataFrame(
        [
            {
                "a": p.a,
                "b": p.b,
                "conditions won (a, b)": f"{p.wins}, {p.losses}",
                "RMSE change a vs b [%]": 100 * (p.ratio - 1),
                "rank-biserial correlation": p.effect,
                f"adjusted p (Nemenyi, {p.family} tests)": p.p_nemenyi,
                f"adjusted p (Conover, Holm, {p.family} tests)": p.p_conover,
                f"adjusted p (Wilcoxon, Holm, {p.family} tests)": p.p_wilcoxon,
                "P(a better), Bayesian signed rank": p.bayes_a,
                f"P(equivalent within ±{100 * ranking.margin:g} %)": p.bayes_equal,
                "P(b better)": p.bayes_b,
                "P(error a < error b)": p.better,
                "P lower": p.better_low,
                "P upper": p.better_high,
                "decision": f"{p.winner} better" if p.winner in (p.a, p.b) else "inconclusive",
            }
            for p in ranking.pairs
        ]
    )


def baseline_table(pairs: Sequence[BaselineComparison]) -> pd.DataFrame:
    """Build the table of proposed methods against baselines, a row per pair."""
    return pd.DataFrame(
        [
            {
                "method": pair.method,
                "baseline": pair.baseline,
                "conditions": len(pair.cells),
                "better": pair.better,
                "worse": pair.worse,
                "inconclusive": len(pair.cells) - pair.better - pair.worse,
                "RMSE change vs baseline [%]": 100 * (pair.ratio - 1),
                "rank-biserial correlation": pair.effect,
                "p": pair.p,
                f"adjusted p (Holm, {pair.family} tests)": pair.p_holm,
                "decision across conditions": pair.decided,
            }
            for pair in pairs
        ]
    )


def lost_rule_table(sensitivities: Sequence[LostRunSensitivity]) -> pd.DataFrame:
    """Build the table of decisions that depend on the lost-run rule."""
    rules = [rule.name for rule in LOST_RUN_RULES]
    return pd.DataFrame(
        [
            {
                "condition": s.cell,
                "group": s.group,
                "a": s.a,
                "b": s.b,
                **dict(zip(rules, s.winners, strict=True)),
            }
            for s in sensitivities
        ]
    )


def _ran(label: str, result: store.JobResult, alpha: float) -> dict[str, Any]:
    meta, arrays = result.meta, result.arrays
    lost, particles = arrays["lost"], meta.get("particles")
    count = status.count_statuses(result)
    nis, band = _nis(result, alpha)
    return {
        "filter": label,
        "asymptotically exact": bool(meta.get("exact")),
        "oracle noise": bool(meta.get("told")),
        "particles": str(particles or "–"),
        "runs": count.runs,
        "lost runs": count.lost,
        "lost runs [%]": 100 * float(status.lost_fraction(lost).value),
        "diverged runs": "–" if count.diverged is None else str(count.diverged),
        "severely overconfident runs": count.severely_overconfident,
        "time per step [ms]": 1e3 * meta["seconds"]["per_step"],
        "likelihood evaluations per step": meta.get("likelihoods_per_step", np.nan),
        "peak memory above baseline [MiB]": (meta.get("memory") or np.nan) / 2**20,
        **metrics.table_columns(result, "job"),
        "mean NIS per component (expected 1)": nis,
        "NIS 95 % interval": band,
        "log evidence": _mean(arrays["log_evidence"][~lost]),
    }


def _nis(result: store.JobResult, alpha: float) -> tuple[float, str]:
    """Normalised innovation squared per component seen, over the runs that were not lost, and its band."""
    if "nis" not in result.arrays:
        return np.nan, ""
    kept = ~result.arrays["lost"]
    nis, dof = (
        np.asarray(result.arrays[name], dtype=np.float64)[kept] for name in ("nis", "nis_dof")
    )
    count = int(np.nansum(dof))
    if not count:
        return np.nan, ""
    low, high = consistency.nees_band(count, 1, alpha)
    return float(np.nansum(nis) / count), f"{float(low) / count:.3g} to {float(high) / count:.3g}"


def _settled(result: store.JobResult, block: ComponentGroup, bound: float) -> dict[str, Any]:
    error = result.arrays["error"][..., block.places].astype(np.float64) * block.scale
    when = error_measures.convergence_time(
        result.arrays["time"], error, result.arrays["lost"], bound
    )
    return {f"median time to {bound:g} {block.unit} [s]": float(np.median(when[~np.isnan(when)]))}


def _accuracy(result: store.JobResult, block: ComponentGroup, alpha: float) -> dict[str, Any]:
    arrays, lost, groups = result.arrays, result.arrays["lost"], result.meta["state"]["groups"]
    error = arrays["error"][..., block.places].astype(np.float64) * block.scale
    norm, each = (
        error_measures.rmse_norm(error, lost),
        error_measures.rmse_component(error, lost).value,
    )
    largest = error_measures.max_error(error, lost)[~lost]
    dof = len(groups[block.whole])
    found = consistency.compute_consistency(
        arrays["nees"][..., list(groups).index(block.whole)], lost, dof, alpha
    )
    low, high = consistency.nees_band(dof, found.runs, alpha)
    unit = f" [{block.unit}]" if block.unit else ""
    row: dict[str, Any] = {
        "valid runs": norm.runs,
        f"RMSE of the norm{unit}": float(norm.value),
        f"mean run RMSE{unit}": float(error_measures.rmse_run_mean(error, lost).value),
        **{
            f"RMSE {name.removeprefix(f'{block.group}_')}{unit}": float(value)
            for name, value in zip(block.components, each, strict=True)
        },
        f"maximum error{unit}": float(np.max(largest[~np.isnan(largest)])) if norm.runs else np.nan,
        f"mean NEES (expected {dof})": found.mean,
        "NEES consistency": status.classify_consistency(found, dof, alpha),
        "95 % interval at one step": f"{format_number(float(low))} to {format_number(float(high))}",
        "steps inside the interval [%]": 100 * found.inside,
    }
    row |= metrics.table_columns(result, "components", block)
    if "bound" in arrays:
        floor = arrays["bound"][:, block.places].astype(np.float64) * block.scale
        row["RMSE / PCRB"] = error_measures.rmse_to_pcrb(error, lost, floor)
    if "range" in arrays and block.whole == "position":
        for name, last in (("", None), (f", last {_LAST} steps", _LAST)):
            share = error_measures.relative_error(
                error[..., :2] / block.scale, lost, arrays["range"], last
            )
            row[f"horizontal error [% of range]{name}"] = 100 * float(share.value)
    return row


def _standing(label: str, verdicts: Sequence[PairwiseTest]) -> dict[str, Any]:
    """Count the filters that are worse and better than a filter."""
    met = [v for v in verdicts if label in (v.a, v.b)]
    beaten = sum(v.winner not in (label, INCONCLUSIVE) for v in met)
    return {
        "better than [filters]": sum(v.winner == label for v in met),
        "worse than [filters]": beaten,
    }


def _decision(v: PairwiseTest) -> str:
    """Format the decision of a comparison."""
    if v.winner in (v.a, v.b):
        return f"{v.winner} better"
    return "equivalent" if v.equivalent else "inconclusive"


def _whole(value: float) -> str:
    """Format a count that may be infinite or NaN."""
    return f"{value:.0f}" if np.isfinite(value) else format_number(float(value))


def _mean(values: np.ndarray) -> float:
    """Return the mean of the values that are not NaN, or NaN."""
    finite = values[~np.isnan(values)]
    return float(finite.mean()) if finite.size else np.nan
