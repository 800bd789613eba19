"""Consistency of each filter: mean NEES and NIS over their expectation, with Holm's correction over all of them.

The unit is a run: the ratio is averaged over the time, regimes and worlds of a run, since these share random
numbers. The mean over runs has a Student interval, whose error follows from the spread over runs, so that no
independence over time is assumed [ours]. Lost runs are left out and counted.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd

from pfbench.stats.comparison import ALPHA, MIN_RUNS, EffectEstimate, estimate_mean
from pfbench.stats.error_measures import Array
from pfbench.stats.rank_tests import holm
from pfbench.stats.study_runs import CONDITION, weigh_conditions

INNOVATION = "innovation"  # group of the NIS
_LARGEST = 1e30  # in place of an infinite NEES, of a filter without spread
_QUANTITIES = {"nees_ratio": "NEES", "nis": "NIS"}
_NODES, _NODE_WEIGHTS = np.polynomial.legendre.leggauss(128)


def compare_share(shares: Array, expected: float) -> float:
    """Return the p-value, of both sides, that the mean of independent shares [n] in [0, 1] is the expected one.

    Few runs with slow errors have skewed shares, for which Student's test rejects up to all true hypotheses. Here the mean with
    weights from a uniform distribution on the simplex, one of them for the worst share, has to reach the expected one. For shares
    of 0 and 1 it is the exact binomial test of Clopper and Pearson; for others its level is shown by simulation [ours].

    References:
        N. Gaffke (2005), Three test statistics for a nonparametric one-sided hypothesis on the mean of a nonnegative variable.
        E. Learned-Miller and P. S. Thomas (2020), A new confidence interval for the mean of a bounded random variable.
    """
    angle, sides = np.pi / 4 * (_NODES + 1), []
    for worst, sign in ((0.0, 1.0), (1.0, -1.0)):
        distance = sign * (np.append(shares, worst) - expected)[:, None]
        # P(sum of distances with exponential weights <= 0) by inversion of its characteristic function [Gil-Pelaez 1951]
        z = distance * np.tan(angle) * np.sqrt(len(distance)) / np.abs(distance).sum()
        phase, size = np.arctan(z).sum(0), np.exp(-0.5 * np.log1p(z * z).sum(0))
        sides.append(0.5 - 0.5 * float(_NODE_WEIGHTS @ (size * np.sin(phase) / np.sin(2 * angle))))
    return min(1.0, 2.0 * max(0.0, min(sides)))


def assess_consistency(table: pd.DataFrame, alpha: float = ALPHA) -> pd.DataFrame:
    """Compare mean NEES and NIS of each filter and group with their expectation.

    Returns a row per filter, quantity and group: ratio with its simultaneous interval, corrected p-value, runs, lost
    runs, word and reason. The ratio has the size, so that "overconfident" is never alone.
    """
    rows: list[dict[str, Any]] = []
    estimates: list[EffectEstimate] = []
    for metric, quantity in _QUANTITIES.items():
        selected = table[table["metric"] == metric]
        groups = [INNOVATION] * len(selected) if metric == "nis" else selected["group"]
        selected = selected.assign(
            group=groups, regime=selected["noise"] + " / " + selected["model"]
        )
        for (label, group), values in selected.groupby(["label", "group"], sort=False):
            by_run, lost = average_runs(values)
            if len(by_run):
                estimates.append(estimate_ratio(by_run))
                rows.append({"filter": label, "quantity": quantity, "group": group, "runs": len(by_run), "lost": lost})  # fmt: skip
    return pd.DataFrame([
        {**row, **_decide(estimate, p, row["runs"], alpha, len(rows))}
        for row, estimate, p in zip(rows, estimates, holm([_p(e, r["runs"]) for e, r in zip(estimates, rows, strict=True)]), strict=True)
    ])  # fmt: skip


def average_runs(values: pd.DataFrame) -> tuple[Array, int]:
    """Average the ratio of each run over the conditions, of the runs that are valid in all of them; count the lost."""
    by_condition = values.groupby([*CONDITION, "seed", "run"], dropna=False, observed=True)["value"]
    wide = by_condition.mean().unstack(["seed", "run"]).dropna(how="all")
    ratios = np.minimum(wide.to_numpy(dtype=np.float64), _LARGEST)
    complete = ratios[:, ~np.isnan(ratios).any(axis=0)]
    conditions = wide.index.to_frame(index=False)
    return weigh_conditions(conditions) @ complete, int(values["value"].isna().sum())


def estimate_ratio(by_run: Array) -> EffectEstimate:
    """Estimate the logarithm of a mean ratio, whose error follows from the spread over runs; 0 if the ratio is 1."""
    mean = estimate_mean(by_run)
    level = max(float(mean.value), 1 / _LARGEST)
    error = np.asarray(mean.standard_error / level)
    return EffectEstimate(np.asarray(math.log(level)), error, mean.df)


def _p(estimate: EffectEstimate, runs: int) -> float:
    """Return the p-value of the ratio 1; 1 with too few runs or without variation over runs."""
    is_tested = runs >= MIN_RUNS and bool(estimate.standard_error > 0)
    return float(estimate.p) if is_tested else 1.0


def _decide(
    estimate: EffectEstimate, p: float, runs: int, alpha: float, size: int
) -> dict[str, Any]:
    """Return ratio, interval, corrected p-value, word and reason of one row."""
    low, high = (float(end) for end in estimate.interval(alpha / size))
    value = float(estimate.value)
    word, reason = "no deviation shown", ""
    if runs < MIN_RUNS or not estimate.standard_error > 0:
        reason = "no variation over runs"
        reason = f"{runs} valid runs, {MIN_RUNS} are required" if runs < MIN_RUNS else reason
        low, high = -math.inf, math.inf
    elif p < alpha:
        word = "overconfident" if value > 0 else "underconfident"
        low, high = (max(low, 0.0), high) if value > 0 else (low, min(high, 0.0))
    else:
        low, high = min(low, 0.0), max(high, 0.0)
    with np.errstate(over="ignore"):
        ratio, *ends = (float(end) for end in np.exp([value, low, high]))
    return {"ratio": ratio, "low": ends[0], "high": ends[1], "p": p, "word": word, "reason": reason}
