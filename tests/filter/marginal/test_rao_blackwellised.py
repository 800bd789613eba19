"""The Rao-Blackwellised particle filter: Kalman where it may be, unbiased where it says so, better than sampling everything."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import oracles
import pytest
import torch
from filter_laws import check_lost_alone, check_own, check_single, check_wrapped
from model_cases import measurements
from pyro.distributions import Laplace, MultivariateNormal
from refusals import check_refused
from torch import Tensor
from torch.distributions import Distribution, Independent

from pfbench import job
from pfbench.core import Chart, Episode, PhiloxStream, Record, map_inputs
from pfbench.core.density import independent_normal, normal_batch
from pfbench.filter import (
    EssResampler,
    FilterResult,
    GaussianFilter,
    ParticleFilter,
    RegularisedResampler,
    Systematic,
    TaylorLinearisation,
    linearisation,
    normalise_log_weights,
    run_filter,
)
from pfbench.filter.marginal.rao_blackwellised import (
    MarginalisedProposal,
    RaoBlackwellisedFilter,
    StatePartition,
    partition_state,
)
from pfbench.filter.whitening import condition_on, kalman_update_root
from pfbench.job.config import compose_tree
from pfbench.model import (
    InsGnss,
    LinearGaussian,
    Lorenz63,
    Pendulum,
    StateSpaceModel,
    UnivariateGrowth,
    linear_walk,
)
from pfbench.model.azimuth import (
    ErrorEquations,
    ExactErrorEquations as ExactForm,
    LinearisedRateEquations,
    PrintedErrorEquations,
    SinsGpsAzimuth,
    TrapezoidDiscretisation,
)
from pfbench.nav import (
    AlignmentErrors,
    GnssReceiver,
    ImuErrors,
    ManoeuvreTrajectory,
    TrajectoryStart,
    accelerate,
    turn,
)
from pfbench.noise.base import NominalNoise
from pfbench.scenario.flights import SimulatedFlight

PARTS = ("f", "g", "h", "r", "m0", "l0")
WALK = linear_walk(1.0, 0.5, 1.0)
WALK_Y = torch.tensor([[0.8], [2.9], [1.2], [math.nan], [3.0], [6.5]], dtype=torch.float64)
NOISE = torch.tensor([[1.0, 0.8], [0.8, 4.0]], dtype=torch.float64)


class Exact(NamedTuple):
    """What a filter should find after the last measurement: mean, E x^2 (per component [D]) and log evidence."""

    mean: np.ndarray
    square: np.ndarray
    log_evidence: float


def run(
    method: Any, model: StateSpaceModel, y: Tensor, seed: int = 1, **options: Any
) -> FilterResult:
    """One record y [T, Dy] filtered in as many runs as `options["runs"]` says, or y [R, T, Dy] as it is."""
    if y.dim() == 2:
        y = y.expand(options.pop("runs"), -1, -1)
    draws = PhiloxStream(seed, torch.arange(y.shape[0]), model.anchor.dtype)
    return run_filter(
        method, model, Record(y, options.pop("u", ()), options.pop("start", None)), draws, **options
    )


def ratios(estimate: FilterResult, exact: Exact) -> list[np.ndarray]:
    """Z_hat f_hat / Z less f, for f = 1, x, x^2: each has the expectation 0."""
    ratio = torch.exp(estimate.log_evidence - exact.log_evidence).numpy()
    mean, variance = estimate.mean[:, -1].numpy(), estimate.variance[:, -1].numpy()
    values = [ratio - 1.0]
    values += list((ratio[:, None] * (mean - exact.mean) / np.sqrt(exact.square)).T)
    values += list((ratio[:, None] * ((variance + mean**2) / exact.square - 1.0)).T)
    return values


def check_unbiased(
    method: RaoBlackwellisedFilter,
    model: StateSpaceModel,
    y: Tensor,
    exact: Exact,
    runs: int = 2000,
) -> None:
    """E[Z_hat f_hat] = Z f for any number of particles [Del Moral 2004]: no bias to allow for."""
    for value in ratios(run(method, model, y, runs=runs), exact):
        error = value.std() / math.sqrt(runs)
        assert abs(value.mean()) < 4.5 * error + 1e-9, f"{value.mean():.4f} +- {error:.4f}"
        assert error < 0.2, "too few runs to tell anything"


class Correlated(LinearGaussian):
    """Its measurement noise is correlated, and it does not say that it is linear."""

    linear = False

    def observation(self, x: Tensor, u: Any) -> Distribution:
        return MultivariateNormal(x @ self.h.mT, NOISE.expand(*x.shape[:-1], 2, 2))


class Hidden(LinearGaussian):
    """It keeps to itself that it is linear, and its noise gain too."""

    linear = False

    def noise_gain(self, u: Any) -> None:
        return None


def singular(kind: type[LinearGaussian] = LinearGaussian) -> LinearGaussian:
    """Three states, one noise, a correlated initial law; the third state is a constant unless noise reaches it."""
    return kind(
        [[0.9, 0.5, 0.0], [0.0, 0.8, 0.3], [0.0, 0.0, 1.0]], [[0.0], [0.8], [0.0]],
        [[1.0, 0.0, 0.0], [1.0, 1.0, 0.0]], [1.0, 2.0],
        [1.0, 0.0, -1.0], [[1.0, 0.0, 0.0], [0.8, 0.5, 0.0], [0.3, -0.4, 0.7]],
    )  # fmt: skip


SINGULAR_Y = torch.tensor(
    [[2.0, 1.0], [math.nan, -1.0], [0.5, math.nan], [1.5, 1.0]], dtype=torch.float64
)


def oracle(model: LinearGaussian, y: Tensor) -> oracles.Filtered:
    f, g, h, r, m0, root = (getattr(model, k).numpy() for k in PARTS)
    noise = NOISE.numpy() if isinstance(model, Correlated) else np.diag(r**2)
    return oracles.kalman(f, g @ g.T, h, noise, m0, root @ root.T, y.numpy())


def kalman(model: LinearGaussian, y: Tensor) -> Exact:
    k = oracle(model, y)
    return Exact(
        k.mean[-1], np.diagonal(k.covariance[-1]) + k.mean[-1] ** 2, float(k.log_evidence.sum())
    )


# the two pieces of algebra


@pytest.mark.parametrize("sampled", [[], [0], [2], [1, 3], [3, 0, 2]], ids=str)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_sweeping_keeps_the_covariance_and_decides_what_is_sampled(
    sampled: list[int], dtype: torch.dtype
) -> None:
    a = PhiloxStream(1, torch.arange(6)).normal("a", 4, 7).reshape(2, 3, 4, 7)
    a[..., 1, :] *= 1e-8  # radians beside metres
    a[0, 0, 3] = 2.0 * a[0, 0, 0]  # no spread of its own
    a[1, 1, 0] = 0.0  # a constant
    a = a.to(dtype)
    split = StatePartition(sampled, [i for i in range(4) if i not in sampled], False)
    columns, root = condition_on(a, split.sampled_states, split.linear)
    known = sum(
        (c[..., :, None] * c[..., None, :] for c in columns), torch.zeros(4, 4, dtype=dtype)
    )
    rest = torch.zeros(2, 3, 4, 4, dtype=dtype)
    rest[..., torch.tensor(split.linear)[:, None], torch.tensor(split.linear)] = root @ root.mT
    size = a.norm(dim=-1) + 1e-15
    scale = size[..., :, None] * size[..., None, :]
    assert float(((known + rest - a @ a.mT) / scale).abs().max()) < 30 * torch.finfo(dtype).eps
    for i in sampled:
        assert (
            float(((known - a @ a.mT) / scale)[..., i, :].abs().max()) < 30 * torch.finfo(dtype).eps
        )
    if sampled == [0]:  # a constant tells nothing of the others: all of their spread is left
        assert torch.allclose(root[1, 1] @ root[1, 1].mT, (a @ a.mT)[1, 1, 1:, 1:], rtol=1e-4)


@pytest.mark.parametrize("each", [1, 5])
def test_absorbing_is_kalman_s_update(each: int) -> None:
    draws = PhiloxStream(1, torch.arange(2))
    root, h = (
        draws.normal("l", each, 9).reshape(2, each, 3, 3),
        draws.normal("h", each, 12).reshape(2, each, 4, 3),
    )
    root[..., 0, :] *= 1e6
    r = draws.normal("r", 5, 4)
    mean, after, log_like = kalman_update_root(root, h, r)
    for run_ in range(2):
        for i in range(5):
            j = min(i, each - 1)
            p = (root @ root.mT)[run_, j].numpy()
            zero, eye = np.zeros((3, 3)), np.eye(3)
            k = oracles.kalman(
                eye, zero, h[run_, j].numpy(), np.eye(4), np.zeros(3), p, r[run_, i].numpy()[None]
            )
            sd = np.sqrt(np.diag(k.covariance[0]))
            assert np.allclose(
                mean[run_, i].numpy() / sd, k.mean[0] / sd, rtol=1e-3, atol=1e-3
            )  # the oracle cancels 1e12
            found = (after @ after.mT)[run_, j].numpy()
            assert np.allclose(
                found / np.outer(sd, sd), k.covariance[0] / np.outer(sd, sd), atol=1e-3
            )
            assert float(log_like[run_, i]) - 2 * math.log(2 * math.pi) == pytest.approx(
                k.log_evidence[0], rel=1e-4
            )


def test_absorbing_a_prior_of_1e12_is_right_to_many_digits() -> None:
    """Closed form, one component: where a covariance would cancel, the root does not."""
    root, h = (
        1e6 * torch.eye(2, dtype=torch.float64)[None, None],
        torch.tensor([[[[1e5, 0.0]]]], dtype=torch.float64),
    )
    mean, after, log_like = kalman_update_root(
        root, h, torch.full((1, 1, 1), 3.0, dtype=torch.float64)
    )
    q2 = 1.0 + 1e22
    assert float(mean[0, 0, 0]) == pytest.approx(3.0 * 1e17 / q2, rel=1e-12)
    assert (after @ after.mT)[0, 0].diagonal().tolist() == pytest.approx(
        [1e12 / q2, 1e12], rel=1e-4
    )
    assert float(log_like) == pytest.approx(-4.5 / q2 - 0.5 * math.log(q2), rel=1e-12)


# Kalman


@pytest.mark.parametrize("model", [WALK, singular()], ids=["walk", "singular"])
def test_with_nothing_to_sample_it_is_the_kalman_filter(model: LinearGaussian) -> None:
    y = WALK_Y if model is WALK else SINGULAR_Y
    method = RaoBlackwellisedFilter(2)
    assert method.is_exact
    estimate = run_filter(
        method, model, Record(y.expand(3, -1, -1)), PhiloxStream(1, torch.arange(3)),
        watch=lambda t, info: {"covariance": info.covariance()},
    )  # fmt: skip
    truth = oracle(model, y)
    assert np.allclose(estimate.mean.numpy(), truth.mean, rtol=1e-9, atol=1e-9)
    assert np.allclose(estimate.trace["covariance"].numpy(), truth.covariance, rtol=1e-9, atol=1e-9)
    assert np.allclose(estimate.log_evidence.numpy(), truth.log_evidence.sum(), rtol=1e-10)


SPLITS = [["x0"], ["x1"], ["x2"], ["x0", "x2"], ["x1", "x2"], ["x2", "x0", "x1"], ["state"]]


@pytest.mark.parametrize("sampled", SPLITS, ids="+".join)
@pytest.mark.parametrize("kind", [LinearGaussian, Correlated, Hidden])
def test_any_split_of_a_linear_model_is_unbiased(
    kind: type[LinearGaussian], sampled: list[str]
) -> None:
    """A transition of rank one, a constant among the states, values that are missing, noise that is correlated."""
    model = singular(kind)
    check_unbiased(
        RaoBlackwellisedFilter(25, sampled), model, SINGULAR_Y, kalman(model, SINGULAR_Y), runs=600
    )


def check_scatters_less(ours: list[np.ndarray], theirs: list[np.ndarray]) -> None:
    """Variances of the evidence, and of mean and evidence together, are smaller by four standard errors."""
    for part in (slice(0, 1), slice(1, 1 + len(ours) // 2)):
        squares = [np.square(values[part]).sum(0) for values in (ours, theirs)]
        (a, ea), (b, eb) = ((q.mean(), q.std() / math.sqrt(len(q))) for q in squares)
        assert b - a > 4.0 * math.hypot(ea, eb), (
            f"{a:.4f} +- {ea:.4f}, sampling everything {b:.4f} +- {eb:.4f}"
        )


@pytest.mark.slow
@pytest.mark.parametrize("sampled", SPLITS[:5], ids="+".join)
def test_any_split_scatters_less_than_sampling_everything(sampled: list[str]) -> None:
    """Rao and Blackwell, for weights that are never resampled; at equal N."""
    model, runs, never = singular(), 6000, EssResampler(Systematic(), 0.0)
    exact = kalman(model, SINGULAR_Y)
    methods = RaoBlackwellisedFilter(25, sampled, never), ParticleFilter(25, never)
    ours, sir = (ratios(run(m, model, SINGULAR_Y, runs=runs), exact) for m in methods)
    check_scatters_less(ours, sir)


def test_the_covariance_is_one_for_all_where_the_model_is_linear_and_each_its_own_elsewhere() -> (
    None
):
    draws = PhiloxStream(1, torch.arange(2))
    for model, each in ((singular(), 1), (singular(Hidden), 25)):
        method = RaoBlackwellisedFilter(25, ["x0"])
        cloud = method.init(model, 2, draws)
        assert cloud.memory["root"].shape == (2, each, 2, 2)
        for t in range(3):
            cloud, _ = method.step(
                model, cloud, Record(SINGULAR_Y[t].expand(2, -1)), draws.at_step(t + 1)
            )
            assert cloud.memory["root"].shape == (2, each, 2, 2)


def test_shared_and_separate_covariances_are_the_same_filter() -> None:
    one, two = (
        run(RaoBlackwellisedFilter(25, ["x1"]), singular(kind), SINGULAR_Y, runs=4)
        for kind in (LinearGaussian, Hidden)
    )
    # a root is of any sign, and so is what comes of z: only a model without a gain may differ in it, and here does not
    assert torch.allclose(one.mean, two.mean, rtol=1e-9, atol=1e-9)
    assert torch.allclose(one.variance, two.variance, rtol=1e-9, atol=1e-9)
    assert torch.allclose(one.log_evidence, two.log_evidence, rtol=1e-9)


def test_derivatives_may_be_taken_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = run(RaoBlackwellisedFilter(25, ["x1"]), singular(Hidden), SINGULAR_Y, runs=4)
    monkeypatch.setattr(linearisation, "_POINTS", 1)
    assert torch.allclose(
        run(RaoBlackwellisedFilter(25, ["x1"]), singular(Hidden), SINGULAR_Y, runs=4).mean,
        whole.mean,
    )


def test_a_model_that_observes_its_initial_state() -> None:
    model = LinearGaussian(*(getattr(singular(), k) for k in PARTS), observes_initial=True)
    f, g, h, r, m0, root = (getattr(model, k).numpy() for k in PARTS)
    k = oracles.kalman(f, g @ g.T, h, np.diag(r**2), m0, root @ root.T, SINGULAR_Y.numpy(), True)
    exact = Exact(
        k.mean[-1], np.diagonal(k.covariance[-1]) + k.mean[-1] ** 2, float(k.log_evidence.sum())
    )
    check_unbiased(RaoBlackwellisedFilter(25, ["x1"]), model, SINGULAR_Y, exact, runs=1000)


# a model that is linear only given a part of it


class Mixed(StateSpaceModel):
    """s' = 0.6 s + sin s + 0.4 (1 + s^2/4)^-1 l + noise, l' = cos(s) l / 2 + 0.3 s + noise correlated with that of s;
    y = (s^2/4, (1 + s/2) l + s) + noise whose size depends on s. State (l, s), so that the order of parts is not theirs."""

    gain: Tensor
    linear_given = (0,)

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("gain", torch.tensor([[0.6, 0.0], [0.35, 0.5]], dtype=torch.float64))
        self.names, self.units, self.groups, self.noise_dim = (
            ("l", "s"),
            ("", ""),
            {"part": (0,), "rest": (1,)},
            2,
        )

    def initial(self, runs: int) -> Distribution:
        return normal_batch(
            runs, self.gain.new_tensor([0.8, 0.7]), self.gain.new_tensor([0.5, -0.2])
        )

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        l, s = x.unbind(-1)
        moved = torch.stack(
            [0.5 * torch.cos(s) * l + 0.3 * s, 0.6 * s + torch.sin(s) + 0.4 * l / (1 + s * s / 4)],
            -1,
        )
        return moved + w @ self.gain.mT

    def noise_gain(self, u: Any) -> Tensor | None:
        return self.gain.unsqueeze(0)

    def observation(self, x: Tensor, u: Any) -> Distribution:
        l, s = x.unbind(-1)
        sd = torch.stack([0.7 + 0 * s, 0.5 + 0.3 * torch.sigmoid(s)], -1)
        return independent_normal(torch.stack([s * s / 4, (1 + s / 2) * l + s], -1), sd)


class MixedTurned(Mixed):
    """The same law, its noise turned by an angle that depends on s, and so not of one gain."""

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        c, n = torch.cos(x[..., 1]), torch.sin(x[..., 1])
        a, b = w.unbind(-1)
        return super().propagate(x, u, torch.stack([c * a - n * b, n * a + c * b], -1))

    def noise_gain(self, u: Any) -> None:
        return None


MIXED_Y = torch.tensor(
    [[0.9, -1.0], [0.2, math.nan], [1.5, 2.0], [math.nan, 1.2]], dtype=torch.float64
)


def mixed_by_grid(points: int = 45) -> Exact:
    """Prediction and update on a grid of both states; sums over a smooth density converge faster than any power."""
    ls, ss = np.linspace(-4.2, 5.4, points), np.linspace(-5.6, 5.6, points)
    l, s = (a.ravel() for a in np.meshgrid(ls, ss, indexing="ij"))
    cell = (ls[1] - ls[0]) * (ss[1] - ss[0])
    mean_l = 0.5 * np.cos(s) * l + 0.3 * s
    mean_s = 0.6 * s + np.sin(s) + 0.4 * l / (1 + s**2 / 4)
    g = np.array([[0.6, 0.0], [0.35, 0.5]])
    first = (l[:, None] - mean_l[None]) / g[0, 0]
    transition = np.exp(-0.5 * first**2) / (np.sqrt(2 * np.pi) * g[0, 0])
    transition *= oracles.normal_density(s[:, None], mean_s[None] + g[1, 0] * first, g[1, 1])
    p = oracles.normal_density(l, 0.5, 0.8) * oracles.normal_density(s, -0.2, 0.7)
    log_z = 0.0
    for y in MIXED_Y.numpy():
        p = transition @ p * cell
        if not np.isnan(y[0]):
            p = p * oracles.normal_density(y[0], s**2 / 4, 0.7)
        if not np.isnan(y[1]):
            p = p * oracles.normal_density(y[1], (1 + s / 2) * l + s, 0.5 + 0.3 / (1 + np.exp(-s)))
        total = p.sum() * cell
        p, log_z = p / total, log_z + math.log(total)
    x = np.stack([l, s])
    return Exact((x * p).sum(1) * cell, (x**2 * p).sum(1) * cell, log_z)


@pytest.fixture(scope="module")
def mixed() -> Exact:
    return mixed_by_grid()


def test_the_grid_has_converged_and_agrees_with_sampling_everything(mixed: Exact) -> None:
    coarse = mixed_by_grid(39)
    assert coarse.log_evidence == pytest.approx(mixed.log_evidence, abs=2e-4)
    assert np.allclose(coarse.mean, mixed.mean, atol=2e-4)
    estimate = run(ParticleFilter(20_000), Mixed(), MIXED_Y, runs=10)
    for value in ratios(estimate, mixed):
        assert abs(value.mean()) < 4.5 * value.std() / math.sqrt(10) + 1e-3


@pytest.mark.parametrize("model", [Mixed(), MixedTurned()], ids=["one gain", "turned"])
def test_unbiased_where_the_model_is_linear_only_given_a_part(
    model: StateSpaceModel, mixed: Exact
) -> None:
    method = RaoBlackwellisedFilter(25)
    assert method.is_exact
    check_unbiased(method, model, MIXED_Y, mixed)


@pytest.mark.slow
@pytest.mark.parametrize("threshold", [0.0, 1.0])
def test_unbiased_with_narrow_error_bars(threshold: float, mixed: Exact) -> None:
    check_unbiased(
        RaoBlackwellisedFilter(100, None, EssResampler(Systematic(), threshold)),
        Mixed(),
        MIXED_Y,
        mixed,
        runs=1500,
    )


def test_the_wrong_part_cannot_be_left_to_a_kalman_filter(mixed: Exact) -> None:
    """Linearised in s the filter does not claim to be exact, and is not."""
    method = RaoBlackwellisedFilter(25, ["part"])
    assert not method.is_exact
    with pytest.raises(AssertionError, match=r"\+-"):
        check_unbiased(method, Mixed(), MIXED_Y, mixed)


def test_it_scatters_less_than_sampling_everything(mixed: Exact) -> None:
    ours, sir = (
        ratios(run(m, Mixed(), MIXED_Y, runs=4000), mixed)
        for m in (RaoBlackwellisedFilter(25), ParticleFilter(25))
    )
    check_scatters_less(ours, sir)


def test_what_is_told_is_of_the_whole_mixture() -> None:
    """Against draws of it: a particle by its weight, then l of its conditional law."""
    draws, model, n = PhiloxStream(1, torch.arange(2)), Mixed(), 30
    method = RaoBlackwellisedFilter(n)
    cloud = method.init(model, 2, draws)
    for t in range(2):
        cloud, info = method.step(
            model, cloud, Record(MIXED_Y[t].expand(2, -1)), draws.at_step(t + 1)
        )
    rng, m = np.random.default_rng(1), 400_000
    for r in range(2):
        i = rng.choice(n, m, p=normalise_log_weights(cloud.log_w)[r].numpy())
        x = cloud.x[r].numpy()[i]
        x[:, 0] += cloud.memory["root"][r, :, 0, 0].numpy()[i] * rng.normal(size=m)
        covariance = np.cov(x.T)
        sd = np.sqrt(np.diag(covariance))
        assert np.all(np.abs(info.mean[r].numpy() - x.mean(0)) < 5 * sd / math.sqrt(m))
        assert np.all(
            np.abs(info.covariance()[r].numpy() - covariance)
            < 5 * np.outer(sd, sd) * math.sqrt(3.0 / m)
        )
        assert np.allclose(info.variance[r], info.covariance()[r].diagonal())


# what models declare

IMU = ImuErrors(0.05, 0.05, 3600.0, 0.01, 100.0, 50.0, 1800.0, 5.0)
RECEIVER = GnssReceiver((6.87, 7.20, 4.83), (0.21, 0.20, 0.14))
INITIAL = AlignmentErrors((60.0, 60.0, 1200.0), (0.2, 0.2, 0.2), (10.0, 10.0, 10.0))
SMALL = AlignmentErrors((1.0, 1.0, 5.0), (0.2, 0.2, 0.2), (10.0, 10.0, 10.0))


@pytest.fixture(scope="module")
def flight() -> Episode:
    start = TrajectoryStart(lat_deg=32.0, lon_deg=118.0, height=200.0, speed=50.0, heading_deg=45.0)
    path = ManoeuvreTrajectory(
        (accelerate(2.0, 8.0), turn(60.0, 10.0), accelerate(-2.0, 8.0)), start
    )
    return SimulatedFlight(path, IMU, RECEIVER, SMALL, imu_rate_hz=20.0).draw(
        NominalNoise(), torch.arange(3), 5
    )


def azimuth(form: ErrorEquations, biases: bool) -> SinsGpsAzimuth:
    return SinsGpsAzimuth(IMU, RECEIVER, INITIAL, form, TrapezoidDiscretisation(), biases=biases)


DECLARED: dict[str, StateSpaceModel] = {
    "pendulum": Pendulum(),
    "mixed": Mixed(),
    "paper": azimuth(PrintedErrorEquations(), False),
    "paper, biases": azimuth(PrintedErrorEquations(), True),
    "full": azimuth(LinearisedRateEquations(), False),
    "full, biases": azimuth(LinearisedRateEquations(), True),
}


def curvature(model: StateSpaceModel, u: Any, linear: tuple[int, ...]) -> tuple[float, float]:
    """How far map and measurement are from f(x + a) + f(x + b) = f(x) + f(x + a + b), a and b in l and the noise, beside
    f(x + a) - f(x); and how far the measurement's deviations move with l."""
    draws, d = PhiloxStream(2, torch.arange(3)), len(model.names)
    size: Tensor = model.initial(1).stddev[0]
    mask = torch.zeros(d, dtype=torch.float64).index_fill(0, torch.tensor(linear), 1.0)
    x = model.chart.add(model.origin, draws.normal("x", 40, d) * size)
    steps = [
        (draws.normal(f"{p}x", 40, d) * size * mask, draws.normal(f"{p}w", 40, model.noise_dim))
        for p in "ab"
    ]
    (a, wa), (b, wb) = steps

    def both(shift: Tensor, w: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        moved = model.propagate(model.chart.add(x, shift), u, w)
        law: Any = model.observation(model.chart.add(x, shift), u)
        return moved, law.mean, law.stddev

    zero, none = torch.zeros_like(a), torch.zeros_like(wa)
    f, fa, fb, fab = both(zero, none), both(a, wa), both(b, wb), both(a + b, wa + wb)
    worst = 0.0
    for j, subtract in ((0, model.chart.subtract), (1, model.residual)):
        bent = subtract(fab[j], fa[j]) - subtract(fb[j], f[j])
        whole = subtract(fa[j], f[j]).abs().amax((0, 1)) + size.min() * 1e-9
        worst = max(worst, float((bent.abs().amax((0, 1)) / whole).max()))
    return worst, float((fa[2] - f[2]).abs().max())


@pytest.mark.parametrize("name", DECLARED)
def test_what_a_model_declares_linear_is(name: str, flight: Episode) -> None:
    model = DECLARED[name]
    u = model.prepare(flight.record).at_step(4).u if isinstance(model, SinsGpsAzimuth) else ()
    assert model.linear_given
    bent, noisy = curvature(model, u, model.linear_given)
    assert bent < 1e-7
    assert noisy == 0.0
    for other in set(range(len(model.names))) - set(
        model.linear_given
    ):  # and nothing could be added to it
        assert max(curvature(model, u, (*model.linear_given, other))) > 1e-4


def test_the_split_is_what_is_named_or_declared() -> None:
    ins = InsGnss(IMU, RECEIVER, SMALL)
    assert partition_state(ins, ["attitude"]) == StatePartition([0, 1, 2], list(range(3, 15)), True)
    assert partition_state(ins, ["attitude_U", "position"]) == StatePartition(
        [2, 6, 7, 8], [0, 1, 3, 4, 5, *range(9, 15)], True
    )
    assert partition_state(ins, None) == StatePartition([], list(range(15)), True)
    assert partition_state(azimuth(PrintedErrorEquations(), True), None) == StatePartition(
        [2], [0, 1, *range(3, 15)], False
    )
    assert partition_state(azimuth(LinearisedRateEquations(), True), None) == StatePartition(
        [0, 1, 2], list(range(3, 15)), False
    )


# navigation


def deviations(estimate: FilterResult, kf: FilterResult, chart: Chart) -> Tensor:
    """Distance of means to the Kalman filter's, in its standard deviations [R, T, d]."""
    return chart.subtract(estimate.mean, kf.mean) / kf.variance.sqrt()


def test_thirty_particles_of_an_ins_are_close_to_its_kalman_filter(flight: Episode) -> None:
    """Attitude sampled: the mean of 30 draws is off by 1/sqrt 30 = 0.18 spreads at best, a few times more after resampling."""
    model, runs = InsGnss(IMU, RECEIVER, SMALL), torch.arange(3)
    kf, ours, sir = (
        run_filter(m, model, flight.record, PhiloxStream(1, runs))
        for m in (
            GaussianFilter(TaylorLinearisation()),
            RaoBlackwellisedFilter(30, ["attitude"]),
            ParticleFilter(30),
        )
    )
    assert not bool(ours.lost.any())
    off, theirs = (deviations(e, kf, model.chart).square().mean().sqrt() for e in (ours, sir))
    assert off < 0.7
    assert off < 0.4 * theirs
    spread = (ours.variance / kf.variance)[:, :, 3:].mean()  # what is not sampled keeps its spread
    assert 0.7 < spread < 1.2
    assert (ours.log_evidence - kf.log_evidence).abs().max() < 0.2 * (
        sir.log_evidence - kf.log_evidence
    ).abs().min()


@pytest.mark.parametrize(
    "form",
    [PrintedErrorEquations(), LinearisedRateEquations(), ExactForm()],
    ids=lambda f: type(f).__name__,
)
def test_a_large_azimuth_error(form: ErrorEquations, flight: Episode) -> None:
    """Near the truth all forms are next to linear, and an extended Kalman filter is the answer."""
    model = SinsGpsAzimuth(IMU, RECEIVER, SMALL, form, TrapezoidDiscretisation())
    sampled = ["attitude_U"] if isinstance(form, ExactForm) else None
    record = model.prepare(flight.record)
    record = record._replace(y=record.y[:, :10], u=map_inputs(lambda a: a[:, :10], record.u))
    kf, ours = (
        run_filter(m, model, record, PhiloxStream(1, torch.arange(3)))
        for m in (GaussianFilter(TaylorLinearisation()), RaoBlackwellisedFilter(40, sampled))
    )
    assert deviations(ours, kf, model.chart).square().mean().sqrt() < 0.4
    assert (ours.log_evidence - kf.log_evidence).abs().max() < 2.0


def test_a_quaternion_may_be_sampled_and_so_may_all_but_it() -> None:
    """The chart's differences are sampled, three of them; close to the extended Kalman filter where errors are minutes of arc."""
    cfg = compose_tree(["scenario=sar_flight", "episode_cache_dir=null"])
    cfg.scenario.imu_rate_hz = 20.0
    cfg.scenario.trajectory.duration_s = 5.0
    model, episode = (
        job.instantiate(cfg.model),
        job.instantiate(cfg.scenario).draw(NominalNoise(), torch.arange(2), 3),
    )
    kf = run_filter(
        GaussianFilter(TaylorLinearisation()),
        model,
        episode.record,
        PhiloxStream(1, torch.arange(2)),
    )
    for sampled in (["attitude"], ["velocity"]):
        ours = run_filter(
            RaoBlackwellisedFilter(40, sampled),
            model,
            episode.record,
            PhiloxStream(1, torch.arange(2)),
        )
        assert deviations(ours, kf, model.chart).square().mean().sqrt() < 0.5
        assert torch.allclose(ours.mean[..., :4].norm(dim=-1), torch.ones(1, dtype=torch.float64))


@pytest.mark.parametrize("sampled", [None, ["rate"]], ids=str)
def test_angles_that_cross_the_cut_change_nothing(sampled: list[str] | None) -> None:
    check_wrapped(RaoBlackwellisedFilter(40, sampled))


# one run, its neighbours, its past and its future

CASES: dict[str, tuple[StateSpaceModel, list[str] | None]] = {
    "walk": (WALK, ["position"]),
    "walk, all Kalman": (WALK, None),
    "pendulum": (Pendulum(), None),
    "mixed": (Mixed(), None),
    "lorenz": (Lorenz63(), ["x"]),
    "growth, all sampled": (UnivariateGrowth(), ["state"]),
}


@pytest.mark.parametrize("case", CASES)
def test_neither_future_nor_neighbours_are_felt(case: str) -> None:
    model, sampled = CASES[case]
    check_own(RaoBlackwellisedFilter(30, sampled), model, measurements(model))
    check_single(RaoBlackwellisedFilter(30, sampled), model, measurements(model))


@pytest.mark.parametrize("case", ["walk", "walk, all Kalman", "mixed"])
def test_an_impossible_measurement_loses_its_run_alone(case: str) -> None:
    model, sampled = CASES[case]
    check_lost_alone(RaoBlackwellisedFilter(30, sampled), model, measurements(model))


class Fragile(Hidden):
    """A walk whose mechanisation fails far out: some particles become NaN, others infinite."""

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        moved = super().propagate(x, u, w)
        moved = torch.where(x[..., :1] > 2.5, torch.nan * moved, moved)
        return torch.where(x[..., :1] < -2.5, torch.inf * moved, moved)


def test_particles_that_are_not_finite_weigh_nothing() -> None:
    model = Fragile(*(getattr(WALK, k) for k in PARTS))
    for y in (
        torch.zeros(40, 6, 1, dtype=torch.float64),
        torch.full((40, 6, 1), torch.nan, dtype=torch.float64),
    ):
        estimate = run(RaoBlackwellisedFilter(30, ["x0"]), model, y)
        healthy = ~estimate.lost
        assert int(healthy.sum()) > 30
        assert bool(torch.isfinite(estimate.mean[healthy]).all())
        assert bool(torch.isfinite(estimate.variance[healthy]).all())


# what is refused


class Boxed(Mixed):
    def observation(self, x: Tensor, u: Any) -> Distribution:
        return Independent(Laplace(x, torch.ones_like(x)), 1)


class Spiky(LinearGaussian):
    @property
    def noise(self) -> Distribution:
        return Independent(Laplace(torch.zeros_like(self.r), torch.ones_like(self.r)), 1)


@dataclass(frozen=True)
class Refused:
    model: StateSpaceModel
    sampled: list[str] | None
    message: str


REFUSED = [
    Refused(
        WALK,
        ["attitude"],
        r"filter.sampled_states must be groups .* of LinearGaussian, got \['attitude'\]",
    ),
    Refused(
        UnivariateGrowth(),
        None,
        "no component that is linear given the rest, got null with UnivariateGrowth",
    ),
    Refused(Boxed(), None, "measurement's noise is normal, got Laplace in Boxed"),
    Refused(
        Spiky([[1.0]], [[1.0]], [[1.0]], [1.0], [0.0], [1.0]),
        None,
        "driving noise is normal, got Laplace in Spiky",
    ),
]


@pytest.mark.parametrize("case", REFUSED, ids=lambda c: c.message[:30])
def test_models_that_cannot_are_told_why(case: Refused) -> None:
    check_refused(
        [
            (
                case.message,
                lambda: run(
                    RaoBlackwellisedFilter(10, case.sampled), case.model, measurements(case.model)
                ),
            )
        ],
        remedy=False,
    )


def test_all_sampled_is_the_plain_filter_for_any_law() -> None:
    model = Spiky([[1.0]], [[1.0]], [[1.0]], [1.0], [0.0], [1.0])
    ours, sir = (
        run(m, model, measurements(model))
        for m in (RaoBlackwellisedFilter(30, ["state"]), ParticleFilter(30))
    )
    assert torch.allclose(ours.mean, sir.mean)
    assert torch.allclose(ours.log_evidence, sir.log_evidence)


def test_it_says_when_it_is_exact() -> None:
    assert RaoBlackwellisedFilter(10).is_exact
    assert not RaoBlackwellisedFilter(10, ["attitude"]).is_exact
    assert not RaoBlackwellisedFilter(
        10, None, RegularisedResampler(EssResampler(Systematic()))
    ).is_exact  # type: ignore[arg-type]
    assert MarginalisedProposal(StatePartition([0], [1], False)).is_exact
    check_refused(
        [(r"filter\.particles must be at least 2, got 1", lambda: RaoBlackwellisedFilter(1))],
        remedy=False,
    )
