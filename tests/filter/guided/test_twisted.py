"""The twisted particle filter: exact on linear models, unbiased on others, and precise where a bootstrap filter is not."""

import math

import pytest
import torch
from refusals import check_refused

from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    EssResampler,
    FilterResult,
    GaussianFilter,
    ParticleFilter,
    Systematic,
    TaylorLinearisation,
    TwistedParticleFilter,
    TwistedProposal,
    TwistedWeights,
    run_filter,
)
from pfbench.model import LinearGaussian, StochasticVolatility
from pfbench.testing import check_evidence

WALK = LinearGaussian([[1.0, 1.0], [0.0, 1.0]], [[0.0], [0.3]], [[1.0, 0.0]], [0.5], [0.3, 0.1], [2.0, 1.0])  # fmt: skip
SINGULAR_FIXES = torch.randn(3, 40, 1, generator=torch.Generator().manual_seed(5), dtype=torch.float64).cumsum(1)  # fmt: skip
VOLATILITY = StochasticVolatility(-1.0, 0.95, 0.4)


def run_all(method: object, model: object, y: torch.Tensor, seed: int = 1) -> FilterResult:
    return run_filter(method, model, Record(y), PhiloxStream(seed, torch.arange(len(y))))  # type: ignore[arg-type]


def test_the_evidence_of_a_linear_model_is_that_of_the_kalman_filter_with_two_particles() -> None:
    """Its process noise is singular, and measurements are missing."""
    y = SINGULAR_FIXES.clone()
    y[1, 5:12] = torch.nan
    method = TwistedParticleFilter(2, EssResampler(Systematic(), 1.0), auxiliary_weights=TwistedWeights(0.0))  # fmt: skip
    exact = run_all(GaussianFilter(TaylorLinearisation()), WALK, y).log_evidence
    assert torch.allclose(run_all(method, WALK, y).log_evidence, exact, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("fraction", [0.0, 0.3])
def test_the_evidence_is_unbiased(fraction: float) -> None:
    check_evidence(TwistedParticleFilter(20, auxiliary_weights=TwistedWeights(fraction), proposal=TwistedProposal(fraction)))  # fmt: skip


def test_a_hundred_particles_are_as_precise_as_thousands_of_a_bootstrap_filter() -> None:
    """Stochastic volatility: the state is in the variance of the measurement."""
    x = torch.zeros(1, 1, 1, dtype=torch.float64)
    z = torch.randn(2, 150, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    y = []
    for w, v in z.T:
        x = VOLATILITY.propagate(x, None, w.view(1, 1, 1))
        y.append(torch.exp(0.5 * x[:, 0]) * v)
    record = torch.stack(y, 1).expand(60, -1, -1)
    twisted, few, many = (run_all(method, VOLATILITY, record, seed).log_evidence for seed, method in enumerate((TwistedParticleFilter(100), ParticleFilter(100), ParticleFilter(4000))))  # fmt: skip
    assert twisted.std() < 0.2 * few.std()
    error = torch.hypot(twisted.std(), many.std()) / math.sqrt(60)
    means = [a.logsumexp(0) - math.log(60) for a in (twisted, many)]
    assert abs(means[0] - means[1]) < 4.5 * error


def test_what_it_cannot_do_has_a_sentence() -> None:
    method = TwistedParticleFilter(10)
    check_refused(
        [
            ("passes must", lambda: TwistedParticleFilter(10, passes=-1)),
            ("defensive_fraction must", lambda: TwistedWeights(1.0)),
            ("defensive_fraction must", lambda: TwistedProposal(-0.1)),
            ("needs the record", lambda: method.init(WALK, 1, PhiloxStream(1, torch.arange(1)))),
        ],
        remedy=False,
    )
