"""The ensemble Kalman filter: the Kalman update of its own moments, and Kalman's answer as the ensemble grows."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import oracles
import pytest
import torch
from filter_laws import check_lost_alone, check_own, check_single, check_wrapped
from model_cases import Fragile, four_states, measurements
from pyro.distributions import MultivariateNormal
from torch import Tensor
from torch.distributions import Distribution

from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    BootstrapProposal,
    EnsembleKalmanFilter,
    EnsembleTransformUpdate,
    EnsembleUpdate,
    FilterResult,
    ParticleBelief,
    PerturbedObservationUpdate,
    run_filter,
)
from pfbench.model import (
    Benes,
    LinearGaussian,
    Lorenz63,
    Pendulum,
    StateSpaceModel,
    StochasticVolatility,
    UnivariateGrowth,
    linear_walk,
)

ANALYSES: dict[str, EnsembleUpdate] = {
    "perturbed": PerturbedObservationUpdate(),
    "square root": EnsembleTransformUpdate(),
    "centred": PerturbedObservationUpdate(centred=True),
    "rotated": EnsembleTransformUpdate(rotates=True),
}
every_analysis = pytest.mark.parametrize("analysis", ANALYSES.values(), ids=ANALYSES.keys())
without_rotation = pytest.mark.parametrize("analysis", list(ANALYSES.values())[:3])
WALK = linear_walk(1.0, 0.5, 1.0)
WALK_Y = torch.tensor([[0.8], [2.9], [1.2], [math.nan], [3.0], [6.5]], dtype=torch.float64)
MODERATE = (0.5, 2.0, 0.4)
PARTS = ("f", "g", "h", "r", "m0", "l0")
NOISE = torch.tensor([[1.0, 0.8, 0.0], [0.8, 1.0, 0.3], [0.0, 0.3, 0.5]], dtype=torch.float64)
Y = torch.tensor([0.7, -3.0, 1.1], dtype=torch.float64)


class Correlated(LinearGaussian):
    """Its measurement noise is correlated."""

    def observation(self, x: Tensor, u: Any) -> Distribution:
        return MultivariateNormal(x @ self.h.mT, NOISE.expand(*x.shape[:-1], 3, 3))


def run(
    method: EnsembleKalmanFilter, model: StateSpaceModel, y: Tensor, seed: int = 1, **options: Any
) -> FilterResult:
    draws = PhiloxStream(seed, torch.arange(y.shape[0]), model.anchor.dtype)
    record = Record(y, (), options.pop("start", None))
    return run_filter(
        method,
        model,
        record,
        draws,
        watch=lambda t, info: {"covariance": info.covariance()},
        **options,
    )


def kalman(model: LinearGaussian, y: Tensor) -> oracles.Filtered:
    f, g, h, r, m0, root = (getattr(model, k).numpy() for k in PARTS)
    return oracles.kalman(f, g @ g.T, h, np.diag(r**2), m0, root @ root.T, y.numpy())


def sample(x: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of an ensemble [N, d], which divides by N - 1."""
    return x.numpy().mean(0), np.cov(x.numpy().T, ddof=1)


def updated(model: LinearGaussian, x: Tensor, y: Tensor, noise: np.ndarray) -> oracles.Filtered:
    """Kalman's update of the moments of an ensemble [N, d] that is already predicted."""
    mean, covariance = sample(x)
    eye, zero = np.eye(len(mean)), np.zeros((len(mean),) * 2)
    return oracles.kalman(eye, zero, model.h.numpy(), noise, mean, covariance, y.numpy()[None])


# the analysis


@pytest.mark.parametrize("unseen", [(), (1,), (0, 2), (0, 1, 2)], ids=str)
@pytest.mark.parametrize("kind", [LinearGaussian, Correlated])
@pytest.mark.parametrize(("n", "rotates"), [(3, False), (40, False), (3, True), (40, True)])
def test_the_square_root_keeps_mean_and_covariance_exactly(
    n: int, rotates: bool, kind: type[LinearGaussian], unseen: tuple[int, ...]
) -> None:
    """Whatever the ensemble is, even with fewer members than states: no statistics here."""
    model, y = four_states(MODERATE, kind), Y.clone()
    y[list(unseen)] = torch.nan
    noise = NOISE.numpy() if kind is Correlated else np.diag(model.r.numpy() ** 2)
    method, draws = (
        EnsembleKalmanFilter(n, EnsembleTransformUpdate(rotates)),
        PhiloxStream(3, torch.arange(2)),
    )
    before, seen = method.init(model, 2, draws), Record(y.expand(2, -1))
    predicted = BootstrapProposal()(model, before, seen, draws.at_step(1)).x
    cloud, info = method.step(model, before, seen, draws.at_step(1))
    for r in range(2):
        truth = updated(model, predicted[r], y, noise)
        mean, covariance = sample(cloud.x[r])
        assert np.allclose(mean, truth.mean[0], rtol=1e-10, atol=1e-10)
        assert np.allclose(covariance, truth.covariance[0], rtol=1e-9, atol=1e-10)
        assert np.allclose(info.mean[r], mean)
        assert np.allclose(info.covariance()[r], covariance)
        assert np.allclose(info.variance[r], np.diag(covariance))
        assert float(cloud.log_evidence[r]) == pytest.approx(
            truth.log_evidence[0], rel=1e-10, abs=1e-12
        )
    assert torch.equal(cloud.log_w, before.log_w)


@dataclasses.dataclass(frozen=True)
class Same:
    """Draws in which the initial law and the noise are the same in all runs."""

    inner: PhiloxStream

    @property
    def dtype(self) -> torch.dtype:
        return self.inner.dtype

    def at_step(self, step: int) -> Same:
        return Same(self.inner.at_step(step))

    def normal(self, purpose: str, n: int, w: int) -> Tensor:
        z = self.inner.normal(purpose, n, w)
        return z[:1].expand(len(z), -1, -1) if purpose in ("initial", "noise") else z

    def uniform(self, purpose: str, n: int, w: int) -> Tensor:
        return self.inner.uniform(purpose, n, w)


@pytest.mark.parametrize("centred", [False, True])
@pytest.mark.parametrize("kind", [LinearGaussian, Correlated])
def test_perturbed_members_have_the_kalman_update_as_their_expectation(
    kind: type[LinearGaussian], centred: bool
) -> None:
    """Of one predicted ensemble, over the errors drawn: both moments are unbiased for any number of members."""
    model, runs, n = four_states(MODERATE, kind), 8000, 6
    noise = NOISE.numpy() if kind is Correlated else np.diag(model.r.numpy() ** 2)
    y = Y.clone()
    y[1] = torch.nan
    method, draws = (
        EnsembleKalmanFilter(n, PerturbedObservationUpdate(centred)),
        Same(PhiloxStream(3, torch.arange(runs))),
    )
    before, seen = method.init(model, runs, draws), Record(y.expand(runs, -1))
    truth = updated(
        model, BootstrapProposal()(model, before, seen, draws.at_step(1)).x[0], y, noise
    )
    cloud, info = method.step(model, before, seen, draws.at_step(1))
    mean, covariance = info.mean.numpy(), info.covariance().numpy()
    _, p = sample(BootstrapProposal()(model, before, seen, draws.at_step(1)).x[0])
    h, r = model.h.numpy()[[0, 2]], noise[np.ix_([0, 2], [0, 2])]
    gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
    errors = gain @ r @ gain.T
    slack = 4.5 * mean.std(0) / math.sqrt(runs) + 1e-10
    assert np.all(np.abs(mean.mean(0) - truth.mean[0]) < slack)
    # each centred error has the covariance R, so those about their mean have that by N / (N - 1)
    expected = truth.covariance[0] + (errors / (n - 1) if centred else 0.0)
    assert np.all(np.abs(covariance.mean(0) - expected) < 4.5 * covariance.std(0) / math.sqrt(runs))
    # the mean scatters by K R K' / N for the errors, unless the mean of them is taken off
    spread = np.diag(errors) / n
    if centred:
        assert np.all(mean.std(0) < 1e-12)
    else:
        assert np.all(np.abs(mean.var(0) / spread - 1.0) < 4.5 * math.sqrt(2.0 / runs))
    assert torch.allclose(
        cloud.log_evidence, torch.full_like(cloud.log_evidence, truth.log_evidence[0])
    )


@without_rotation
def test_what_is_not_seen_changes_nothing(analysis: EnsembleUpdate) -> None:
    method, draws = EnsembleKalmanFilter(20, analysis), PhiloxStream(1, torch.arange(3))
    before, seen = (
        method.init(WALK, 3, draws),
        Record(torch.full((3, 1), torch.nan, dtype=torch.float64)),
    )
    cloud, _ = method.step(WALK, before, seen, draws.at_step(1))
    assert torch.allclose(
        cloud.x, BootstrapProposal()(WALK, before, seen, draws.at_step(1)).x, atol=1e-13
    )
    assert torch.equal(cloud.log_evidence, before.log_evidence)


@without_rotation
def test_noise_that_tells_of_the_state_teaches_an_ensemble_nothing(
    analysis: EnsembleUpdate,
) -> None:
    """What is expected of the next return is 0 whatever the volatility; the evidence is that of the mean variance."""
    model, draws = StochasticVolatility(), PhiloxStream(1, torch.arange(3))
    method, seen = (
        EnsembleKalmanFilter(50, analysis),
        Record(torch.full((3, 1), 2.0, dtype=torch.float64)),
    )
    before = method.init(model, 3, draws)
    cloud, _ = method.step(model, before, seen, draws.at_step(1))
    predicted = BootstrapProposal()(model, before, seen, draws.at_step(1)).x
    assert torch.allclose(cloud.x, predicted, atol=1e-13)
    variance = predicted.exp().mean(1)[:, 0]
    assert torch.allclose(
        cloud.log_evidence, -2.0 / variance - 0.5 * torch.log(2 * math.pi * variance)
    )


@every_analysis
def test_inflation_widens_the_prediction_before_it_is_seen(analysis: EnsembleUpdate) -> None:
    draws, nothing = (
        PhiloxStream(1, torch.arange(3)),
        torch.full((3, 1), torch.nan, dtype=torch.float64),
    )
    plain, wide = (EnsembleKalmanFilter(20, analysis, inflation=a) for a in (1.0, 1.5))
    late = dataclasses.replace(wide, inflates_update=True)
    before = plain.init(WALK, 3, draws)
    (a, _), (b, _) = (
        m.step(WALK, before, Record(nothing), draws.at_step(1)) for m in (plain, wide)
    )
    for r in range(3):
        assert np.allclose(sample(b.x[r])[0], sample(a.x[r])[0], atol=1e-12)
        assert np.allclose(sample(b.x[r])[1], 2.25 * sample(a.x[r])[1], rtol=1e-10)
    method = dataclasses.replace(wide, update=EnsembleTransformUpdate())
    y = torch.tensor([0.4], dtype=torch.float64)
    cloud, _ = method.step(WALK, before, Record(y.expand(3, -1)), draws.at_step(1))
    truth = updated(WALK, b.x[1], y, np.eye(1))
    assert np.allclose(sample(cloud.x[1])[1], truth.covariance[0], rtol=1e-10)
    assert float(cloud.log_evidence[1]) == pytest.approx(truth.log_evidence[0])
    (a, _), (b, _) = (
        m.step(WALK, before, Record(y.expand(3, -1)), draws.at_step(1)) for m in (plain, late)
    )
    spread = a.x - a.x.mean(1, keepdim=True)
    assert torch.allclose(b.x, a.x.mean(1, keepdim=True) + 1.5 * spread, atol=1e-12)
    assert torch.equal(a.log_evidence, b.log_evidence)  # the prediction is not inflated


def test_rotations_are_uniform() -> None:
    """The updated differences have mean zero and equal squares over many rotations, whatever the members were."""
    n, runs = 5, 4000
    draws = PhiloxStream(3, torch.arange(runs))
    x = torch.tensor([4.0, -1.0, 0.5, -1.5, -2.0], dtype=torch.float64).view(1, n, 1)
    before = ParticleBelief(
        x.expand(runs, -1, 2), 0.0 * x[..., 0].expand(runs, -1), 0.0 * x[0, 0].expand(runs)
    )
    method = EnsembleKalmanFilter(n, EnsembleTransformUpdate(rotates=True))
    vague = Record(torch.zeros(runs, 1, dtype=torch.float64))
    still = linear_walk(1.0, 1e-9, 1e9)
    after, _ = method.step(still, before, vague, draws.at_step(1))
    moved = after.x[..., 1]
    assert torch.all(moved.mean(0).abs() < 4.5 * moved.std(0) / math.sqrt(runs))
    square = moved.square()
    expected = float(x.square().mean())
    assert torch.all((square.mean(0) - expected).abs() < 4.5 * square.std(0) / math.sqrt(runs))


# Kalman


def off(method: EnsembleKalmanFilter, runs: int) -> np.ndarray:
    """Squared errors against Kalman after the last step, per run: mean and covariance in its units, log evidence [R, 3]."""
    truth = kalman(WALK, WALK_Y)
    estimate = run(method, WALK, WALK_Y.expand(runs, -1, -1))
    sd = np.sqrt(np.diag(truth.covariance[-1]))
    mean = (((estimate.mean[:, -1].numpy() - truth.mean[-1]) / sd) ** 2).mean(1)
    left = (estimate.trace["covariance"][:, -1].numpy() - truth.covariance[-1]) / np.outer(sd, sd)
    evidence = (estimate.log_evidence.numpy() - truth.log_evidence.sum()) ** 2
    return np.stack([mean, (left**2).mean((1, 2)), evidence], 1)


@every_analysis
def test_a_large_ensemble_is_kalman(analysis: EnsembleUpdate) -> None:
    """Errors of a sample of N: a few 1/sqrt N in units of the posterior's spread."""
    n, runs = 4000, 30
    errors = np.sqrt(off(EnsembleKalmanFilter(n, analysis), runs).mean(0))
    assert np.all(errors < 5.0 / math.sqrt(n))
    assert np.all(errors > 0.1 / math.sqrt(n))


@pytest.mark.slow
@every_analysis
def test_errors_fall_with_the_root_of_the_number_of_members(analysis: EnsembleUpdate) -> None:
    sizes, runs = np.array([64, 256, 1024]), 400
    squares = [off(EnsembleKalmanFilter(int(n), analysis), runs) for n in sizes]
    x = np.log(sizes) - np.log(sizes).mean()
    for j, what in enumerate(["mean", "covariance", "evidence"]):
        logs = np.array([0.5 * math.log(s[:, j].mean()) for s in squares])
        errors = np.array([0.5 * s[:, j].std() / s[:, j].mean() / math.sqrt(runs) for s in squares])
        slope, error = x @ logs / (x @ x), math.sqrt((x**2) @ errors**2) / (x @ x)
        assert error < 0.05
        # corrections of order 1/N bend the line at 64 members by a per cent or two
        assert abs(slope + 0.5) < 4 * error + 0.02, f"{what}: {slope:.3f} +- {error:.3f}"


def test_the_evidence_is_not_that_of_a_model_that_is_not_linear() -> None:
    """As the filter says of itself: the growth model's posterior has two modes, and its normal likelihood is wrong by much more
    than the scatter."""
    assert not EnsembleKalmanFilter(10).is_exact
    grid = np.linspace(-45, 45, 1501)
    y = np.array([4.0, 0.5, 9.0])

    def transition(t: int) -> np.ndarray:
        centre = grid / 2 + 25 * grid / (1 + grid**2) + 8 * np.cos(1.2 * (t + 1))
        return oracles.normal_density(grid[:, None], centre[None], math.sqrt(10.0))

    prior = oracles.normal_density(grid, 0.0, math.sqrt(2.0))
    truth = oracles.grid_filter(
        grid,
        prior,
        transition,
        lambda t: np.log(oracles.normal_density(y[t], grid**2 / 20, 1.0) + 1e-300),
        3,
    )
    estimate = run(
        EnsembleKalmanFilter(4000, EnsembleTransformUpdate()),
        UnivariateGrowth(),
        torch.tensor(y).reshape(1, 3, 1).expand(20, -1, -1),
    )
    log_z = estimate.log_evidence.numpy()
    assert abs(log_z.mean() - truth[2]) > 10 * log_z.std() / math.sqrt(20)


# every model, one run and its neighbours

every_toy = pytest.mark.parametrize(
    "model",
    [WALK, UnivariateGrowth(), StochasticVolatility(), Benes(), Pendulum(), Lorenz63()],
    ids=lambda m: type(m).__name__,
)


@every_analysis
@every_toy
def test_neither_future_nor_neighbours_are_felt(
    analysis: EnsembleUpdate, model: StateSpaceModel
) -> None:
    check_own(EnsembleKalmanFilter(30, analysis), model, measurements(model))
    check_single(EnsembleKalmanFilter(30, analysis), model, measurements(model))


@every_analysis
def test_an_impossible_measurement_loses_its_run_alone(analysis: EnsembleUpdate) -> None:
    check_lost_alone(EnsembleKalmanFilter(30, analysis), WALK, measurements(WALK))


@every_analysis
def test_a_member_that_is_not_finite_goes_on_from_where_it_was(analysis: EnsembleUpdate) -> None:
    model = Fragile(*(getattr(WALK, k) for k in PARTS))
    estimate = run(
        EnsembleKalmanFilter(30, analysis), model, torch.zeros(40, 6, 1, dtype=torch.float64)
    )
    assert not bool(estimate.lost.any())
    assert bool(torch.isfinite(estimate.mean).all())


@every_analysis
def test_angles_that_cross_the_cut_change_nothing(analysis: EnsembleUpdate) -> None:
    check_wrapped(EnsembleKalmanFilter(100, analysis, inflation=1.02))


@every_analysis
def test_the_belief_is_a_cloud_of_equal_weights(analysis: EnsembleUpdate) -> None:
    method, draws = EnsembleKalmanFilter(25, analysis), PhiloxStream(1, torch.arange(3))
    belief = method.init(WALK, 3, draws)
    for t in range(len(WALK_Y)):
        belief, _ = method.step(WALK, belief, Record(WALK_Y[t].expand(3, -1)), draws.at_step(t + 1))
        assert isinstance(belief, ParticleBelief)
        assert torch.equal(belief.log_w, torch.full((3, 25), -math.log(25.0), dtype=torch.float64))
