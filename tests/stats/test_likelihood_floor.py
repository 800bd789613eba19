"""The floor of a log evidence against a numerical maximum of the same likelihoods, and where the measurements have gaps."""

import numpy as np
import pytest
from scipy import optimize, stats

from pfbench.cli.infer import format_evidence
from pfbench.stats.likelihood_floor import likelihood_floor


def autoregression(factor: float, steps: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    y = np.zeros(steps)
    for t in range(1, steps):
        y[t] = factor * y[t - 1] + rng.standard_normal()
    return 3.0 + 2.0 * y


def maximum(y: np.ndarray) -> float:
    """Largest likelihood about the mean, over the factor and the standard deviation, and of independent values."""
    d = y - y.mean()

    def loss(p: np.ndarray) -> float:
        return -stats.norm.logpdf(d[1:], np.tanh(p[0]) * d[:-1], np.exp(p[1])).sum()

    found = optimize.minimize(loss, [0.0, 0.0], method="Nelder-Mead", options={"maxiter": 4000, "xatol": 1e-9, "fatol": 1e-9})  # fmt: skip
    independent = stats.norm.logpdf(d, 0.0, d.std())
    return max(independent.sum(), independent[0] - found.fun)


@pytest.mark.parametrize("factor", [0.0, 0.9, -0.7])
def test_it_is_the_maximum_of_both_likelihoods(factor: float) -> None:
    y = np.stack([autoregression(factor, 60, seed) for seed in range(4)]).reshape(2, 2, 60)
    expected = [sum(maximum(component) for component in run) for run in y]
    assert likelihood_floor(y.transpose(0, 2, 1)) == pytest.approx(expected, abs=1e-6)


def test_a_gap_changes_nothing_and_no_values_give_none() -> None:
    y = autoregression(0.8, 40, 1)[None, :, None]
    gaps = np.insert(y, [0, 7, 7, 40], np.nan, axis=1)
    assert likelihood_floor(gaps) == pytest.approx(likelihood_floor(y), rel=1e-12)
    unseen = np.concatenate([gaps, np.full_like(gaps, np.nan)], -1)
    assert likelihood_floor(unseen) == pytest.approx(likelihood_floor(y), rel=1e-12)
    assert np.isnan(likelihood_floor(np.full((1, 9, 1), 2.0))).all()


def test_an_evidence_below_the_floor_is_said() -> None:
    assert "above" in format_evidence({"log_evidence": -5.0, "evidence_floor": -6.0})
    assert "worse than no model" in format_evidence({"log_evidence": -7.0, "evidence_floor": -6.0})
    assert format_evidence({"log_evidence": -7.0}) == "\nlog evidence -7.00"
    assert format_evidence({}) == ""
