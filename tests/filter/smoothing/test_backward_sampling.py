"""Backward sampling against one dense solve of the joint normal law, within its Monte Carlo error."""

from typing import Any

import numpy as np
import pytest
import torch
from move_cases import moving
from refusals import check_refused
from scipy import stats
from smoothing_cases import SINGULAR, dense, record_of
from torch import Tensor

from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    EssResampler,
    GaussianFilter,
    MetropolisHastings,
    NoiseFlowKernel,
    ParticleFilter,
    RegularisedResampler,
    Systematic,
    TaylorLinearisation,
)
from pfbench.filter.smoothing.backward_sampling import (
    BackwardSampler,
    BackwardStep,
    ExactBackwardSampler,
    MetropolisBackwardSampler,
    RejectionBackwardSampler,
    sample_trajectories,
    smooth_particles,
)
from pfbench.model import UnivariateGrowth, linear_walk
from pfbench.noise.base import NominalNoise
from pfbench.scenario.simulated import ModelSimulation

SAMPLERS: dict[str, BackwardSampler] = {
    "exact": ExactBackwardSampler(),
    "rejection": RejectionBackwardSampler(),
    "metropolis": MetropolisBackwardSampler(2),
}
POSITIONS = [-2.0, -1.4, -0.9, -0.3, 0.1, 0.6, 1.1, 1.9, 2.4, 9.0]


def step_of(n: int, paths: int, runs: int = 1, parents: Tensor | None = None) -> BackwardStep:
    """Particles with unequal weights, and later states that only some of them can reach."""
    x = torch.tensor(POSITIONS, dtype=torch.float64).repeat(n // len(POSITIONS) + 1)[:n]
    log_w = torch.linspace(0.0, -2.0, n, dtype=torch.float64).log_softmax(0)
    later = torch.linspace(-1.5, 3.0, 3, dtype=torch.float64).repeat_interleave(paths // 3)
    return BackwardStep(
        x.expand(runs, n).unsqueeze(-1),
        log_w.expand(runs, n),
        lambda x: torch.distributions.Independent(torch.distributions.Normal(0.9 * x, 0.7), 1),
        later.expand(runs, -1).unsqueeze(-1),
        torch.zeros(runs, len(later), dtype=torch.long) if parents is None else parents,
    )


def probabilities(step: BackwardStep, later: float) -> np.ndarray:
    x, log_w = step.x[0, :, 0].numpy(), step.log_w[0].numpy()
    a = np.exp(log_w) * stats.norm.pdf(later, 0.9 * x, 0.7)
    return a / a.sum()


@pytest.mark.parametrize("name", SAMPLERS)
def test_slots_have_the_probabilities_of_weight_times_density(name: str) -> None:
    """Ten particles are fewer than the candidates that rejection may need, so it also draws exactly.

    The chain starts at exact draws, which it must leave exact; from a fixed slot two steps would not reach them.
    """
    paths, step = 30_000, step_of(10, 30_000)
    rng = np.random.default_rng(1)
    exact = [probabilities(step, later) for later in np.linspace(-1.5, 3.0, 3)]
    start = torch.from_numpy(np.concatenate([rng.choice(10, paths // 3, p=p) for p in exact]))
    draws = PhiloxStream(1, torch.arange(1))
    slots = SAMPLERS[name](step._replace(parents=start.unsqueeze(0)), draws)[0].numpy()
    assert (slots != start.numpy()).mean() > 0.3
    for p, group in zip(exact, slots.reshape(3, -1), strict=True):
        counts, expected = np.bincount(group, minlength=10), p * len(group)
        rare = expected < 5.0
        seen = np.append(counts[~rare], counts[rare].sum())
        wanted = np.append(expected[~rare], expected[rare].sum())
        assert stats.chisquare(seen[wanted > 0], wanted[wanted > 0]).pvalue > 1e-4


@pytest.mark.parametrize("name", SAMPLERS)
def test_a_run_has_the_same_slots_alone_and_in_a_batch(name: str) -> None:
    many = SAMPLERS[name](step_of(40, 60, runs=3), PhiloxStream(1, torch.arange(3)))
    alone = SAMPLERS[name](step_of(40, 60), PhiloxStream(1, torch.tensor([2])))
    torch.testing.assert_close(many[2:], alone)


@pytest.mark.parametrize("name", SAMPLERS)
def test_the_densities_per_path_do_not_grow_with_the_number_of_particles(name: str) -> None:
    """As many paths as particles: exact draws take N^2 densities, the others N times a logarithm at most."""

    def count(n: int) -> float:
        total, step = 0, step_of(n, n)

        def transition(x: Tensor) -> Any:
            nonlocal total
            total += x.shape[1]
            return step.transition(x)

        SAMPLERS[name](step._replace(transition=transition), PhiloxStream(1, torch.arange(1)))
        return total / n

    few, many = count(150), count(2400)
    if name == "exact":
        assert (few, many) == (150, 2400)
    else:
        assert many < 1.7 * few < 60.0, (few, many)


@pytest.mark.parametrize("name", SAMPLERS)
def test_backward_sampling_agrees_with_the_smoother(name: str) -> None:
    """Means and variances over paths at every instant, and the covariance of neighbours, that single states do not show."""
    model, steps, clouds, paths = linear_walk(1.0, 0.5, 0.8), 8, 40, 25
    record = record_of(model, 1, steps)
    many = record._replace(
        y=record.y.expand(clouds, -1, -1)
    )  # as many clouds as runs: their scatter is the standard error
    x = sample_trajectories(
        ParticleFilter(150),
        model,
        many,
        PhiloxStream(1, torch.arange(clouds)),
        paths,
        SAMPLERS[name],
    )
    assert x.shape == (clouds, paths, steps, 2)
    mean, covariance = dense(model, record.y[0].numpy())
    inside = torch.from_numpy(np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)))
    z = (x - torch.from_numpy(mean)) / inside
    for moment, truth in ((z, 0.0), (z.square(), 1.0)):
        means = moment.mean(1)
        off = (means.mean(0) - truth) / (means.std(0) / clouds**0.5)
        assert off.abs().max() < 4.5, off  # of 16 numbers
    steps_of = (
        x[:, :, 1:, 0] - x[:, :, :-1, 0] - x[:, :, :-1, 1]
    )  # position's own noise: variance q/3 a priori
    assert (
        steps_of.std() < 0.5 / 3**0.5 * 1.3
    )  # paths of unrelated states would scatter by the posterior spread, 0.6 and more


def test_particles_with_a_lag_have_the_moments_of_the_dense_law_of_so_many_measurements() -> None:
    """Of a singular model, whose paths cannot be sampled backwards; as many clouds as runs, whose scatter is the standard error."""
    steps, clouds, lag = 8, 60, 2
    record = record_of(SINGULAR, 1, steps)
    many = record._replace(y=record.y.expand(clouds, -1, -1))
    draws = PhiloxStream(1, torch.arange(clouds))
    found = smooth_particles(ParticleFilter(800), SINGULAR, many, draws, lag)
    for t in range(steps):
        mean, covariance = dense(SINGULAR, record.y[0, : t + lag + 1].numpy())
        for value, truth in ((found.mean[:, t], mean[t]), (found.covariance[:, t], covariance[t])):
            off = (value.mean(0) - torch.from_numpy(truth)) / (value.std(0) / clouds**0.5)
            assert off.abs().max() < 4.5, (t, off)


@pytest.mark.parametrize("name", SAMPLERS)
def test_paths_of_a_bent_model_have_the_law_that_a_grid_gives(name: str) -> None:
    """The first of three states of the growth model given all three measurements, by quadrature."""
    model = UnivariateGrowth(process_sd=4.0, measurement_sd=1.0, initial_sd=3.0)
    y = np.array([4.0, 5.0, 1.0])
    grid = np.linspace(-45.0, 45.0, 901)
    dx = grid[1] - grid[0]

    def step(t: int) -> np.ndarray:
        mean = 0.5 * grid + 25.0 * grid / (1.0 + grid**2) + 8.0 * np.cos(1.2 * t)
        return np.exp(-0.5 * ((grid[:, None] - mean) / 4.0) ** 2) * dx

    seen = [np.exp(-0.5 * (value - grid**2 / 20.0) ** 2) for value in y]
    ahead = step(1) @ np.exp(-0.5 * (grid / 3.0) ** 2) * seen[0]
    behind = step(2).T @ (seen[1] * (step(3).T @ seen[2]))
    law = ahead * behind / (ahead * behind).sum()
    exact = np.array([(law * (grid > 0)).sum(), (law * grid).sum()])
    clouds = 60
    record = Record(torch.from_numpy(y)[None, :, None].expand(clouds, -1, -1))
    x = sample_trajectories(
        ParticleFilter(400),
        model,
        record,
        PhiloxStream(2, torch.arange(clouds)),
        20,
        SAMPLERS[name],
    )[:, :, 0, 0]
    shares = torch.stack([(x > 0).double().mean(1), x.mean(1)], 1)
    off = (shares.mean(0) - torch.from_numpy(exact)) / (shares.std(0) / clouds**0.5)
    assert off.abs().max() < 4.0, (off, exact)
    assert (
        exact[0] > 0.75 > 0.45 > ahead[grid > 0].sum() / ahead.sum()
    )  # what came later told the sign


def test_paths_do_not_depend_on_how_many_are_weighed_at_a_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = UnivariateGrowth()
    record = ModelSimulation(model, 4).draw(NominalNoise(), torch.arange(2), 0).record
    draws = PhiloxStream(1, torch.arange(2))
    whole = sample_trajectories(ParticleFilter(20), model, record, draws, 7)
    monkeypatch.setattr("pfbench.filter.smoothing.backward_sampling._PAIRS", 50)
    torch.testing.assert_close(
        sample_trajectories(ParticleFilter(20), model, record, draws, 7), whole
    )


def test_what_cannot_be_smoothed_says_why() -> None:
    model = linear_walk(1.0, 0.5, 0.8)
    record, draws = record_of(model, 1, 4), PhiloxStream(0, torch.arange(1))
    check_refused(
        [
            (
                "must have a transition density",
                lambda: sample_trajectories(ParticleFilter(20), SINGULAR, record, draws, 2),
            ),
            (
                "must be a particle filter",
                lambda: sample_trajectories(
                    GaussianFilter(TaylorLinearisation()), model, record, draws, 2
                ),
            ),
            (
                "at least 1",
                lambda: sample_trajectories(ParticleFilter(20), model, record, draws, 0),
            ),
        ],
        remedy=False,
    )
    regularised = ParticleFilter(20, RegularisedResampler(EssResampler(Systematic())))
    for method in (regularised, moving(MetropolisHastings(NoiseFlowKernel(3)))):
        with pytest.raises(ValueError, match="must get the parents of particles"):
            sample_trajectories(method, model, record, draws, 2, MetropolisBackwardSampler())
    check_refused(
        [("mcmc_steps must be at least 1", lambda: MetropolisBackwardSampler(0))], remedy=False
    )


def test_a_lost_run_has_no_paths_and_no_smoothed_law_and_spoils_no_other() -> None:
    model = UnivariateGrowth(measurement_sd=1e-3)
    record = Record(torch.tensor([[[1.0], [2.0]], [[1.0], [1e200]]], dtype=torch.float64))
    paths = sample_trajectories(
        ParticleFilter(50), model, record, PhiloxStream(0, torch.arange(2)), 3
    )
    assert torch.isfinite(paths[0]).all()
    assert torch.isnan(paths[1]).all()
