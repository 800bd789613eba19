"""The posterior of few worlds against two-dimensional quadrature, and moderated variances."""

import numpy as np
import pytest
from scipy import integrate, stats
from scipy.special import digamma, polygamma

from pfbench.stats.effects import _inverse_trigamma, fit_world_posterior, moderated_p_values

CASES = [
    ([-0.3, -0.1, -0.5], [0.08, 0.05, 0.1], 0.5),
    ([0.2, 0.25], [0.05, 0.05], 0.5),
    ([0.1, -0.4, 0.3, 0.0, 0.6], [0.2, 0.1, 0.05, 0.1, 0.3], 1.0),
]


@pytest.mark.parametrize(("locations", "errors", "scale"), CASES)
def test_posterior_against_quadrature(locations, errors, scale):
    locations, errors = np.array(locations), np.array(errors)
    posterior = fit_world_posterior(locations, errors, scale)

    def mass_below(limit):
        """Integrate prior times likelihood over the SD between worlds and the mean up to a limit."""
        tau, mu = np.linspace(0.0, 6 * scale, 401), np.linspace(-8.0, limit, 2001)
        sd = np.sqrt(errors[:, None, None] ** 2 + tau[:, None] ** 2)
        likelihood = stats.norm.pdf(locations[:, None, None], mu, sd).prod(axis=0)
        density = np.exp(-0.5 * (tau[:, None] / scale) ** 2) * likelihood
        return integrate.simpson(integrate.simpson(density, x=mu), x=tau)

    for limit in (-0.1, 0.3):
        share = mass_below(limit) / mass_below(8.0)
        assert posterior.cdf(np.array(limit)) == pytest.approx(share, abs=3e-6)
    low, high = posterior.interval(0.1)
    assert [posterior.cdf(low), posterior.cdf(high)] == pytest.approx([0.05, 0.95], abs=1e-9)


def test_posterior_of_a_small_prior_is_the_fixed_effect():
    locations, errors = np.array([0.1, 0.3]), np.array([0.1, 0.2])
    posterior = fit_world_posterior(locations, errors, 1e-4)
    w = 1 / errors**2
    mean, sd = (w @ locations) / w.sum(), 1 / np.sqrt(w.sum())
    assert posterior.interval(0.05) == pytest.approx((mean - 1.96 * sd, mean + 1.96 * sd), abs=1e-4)
    with pytest.raises(ValueError, match="worlds and prior_sd must be"):
        fit_world_posterior(locations[:1], errors[:1])


def test_moderated_variances_lie_between_their_own_and_the_common_one():
    rng = np.random.default_rng(0)
    sds = 0.3 * np.sqrt(rng.chisquare(3, 40) / 3)
    means = np.full(40, 0.5)
    p = moderated_p_values(means, sds, 4)
    assert (np.argsort(p) == np.argsort(sds)).all()
    plain = 2 * stats.t.sf(means / (sds / 2), 3)
    large = sds > 0.45
    assert large.any()
    assert (p[large] < plain[large]).all()
    alike = moderated_p_values(means, np.full(40, 0.3), 4)
    # equal variances: the prior has W - 1 df and the mean of the scaled chi-square that gives them
    variance = 0.3**2 * (1 + 1.5 / np.exp(digamma(1.5))) / 2
    assert alike == pytest.approx(2 * stats.t.sf(0.5 / np.sqrt(variance / 4), 6), rel=1e-6)


def test_inverse_trigamma():
    y = np.array([0.01, 0.5, 3.0, 30.0])
    assert polygamma(1, _inverse_trigamma(y)) == pytest.approx(y, rel=1e-8)
