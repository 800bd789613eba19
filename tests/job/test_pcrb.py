"""The posterior bound: Kalman's covariance on linear models, the published recursion on others, and no filter below."""

import math
from typing import Any

import numpy as np
import oracles
import pytest
import torch
from refusals import check_refused
from torch import Tensor
from torch.distributions import Independent, MultivariateNormal, StudentT

from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    CubaturePoints,
    EssResampler,
    GaussianFilter,
    ParticleFilter,
    SigmaPointLinearisation,
    Systematic,
    TaylorLinearisation,
    run_filter,
)
from pfbench.job.pcrb import compute_posterior_bound
from pfbench.model import (
    Benes,
    InsGnss,
    LinearGaussian,
    PassiveLocation,
    Pendulum,
    PlatformInputs,
    StochasticVolatility,
    StrapdownTotal,
    StrapdownTuning,
    UnivariateGrowth,
    compute_level_attitude,
    linear_walk,
)
from pfbench.nav import (
    AlignmentErrors,
    GnssReceiver,
    ImuErrors,
    ManoeuvreTrajectory,
    ProcessNoiseInflation,
    TrajectoryStart,
    accelerate,
    climb,
    turn,
)
from pfbench.nav.strapdown import PreintegratedImu, preintegrate
from pfbench.noise import MeasurementOutage, NominalNoise
from pfbench.scenario import ModelSimulation, SimulatedFlight

WALK = linear_walk(0.5, 0.3, 2.0)


def doubles(values: Any) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def blank(runs: int, steps: int, size: int = 1) -> Record:
    return Record(torch.zeros(runs, steps, size, dtype=torch.float64))


# linear models: the bound is what the Kalman filter reaches


def test_constant_velocity_has_the_numbers_of_stone_soup() -> None:
    """q = 0.05, R = 5, prior diag(5, 10, 5, 10), T = 1: digits printed by another library's test of its own recursion."""
    f = np.kron(np.eye(2), [[1.0, 1.0], [0.0, 1.0]])
    q = np.kron(np.eye(2), 0.05 * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]]))
    h = np.kron(np.eye(2), [[1.0, 0.0]])
    sd = np.sqrt([5.0, 10.0, 5.0, 10.0])
    model = LinearGaussian(f, np.linalg.cholesky(q), h, [math.sqrt(5.0)] * 2, np.zeros(4), sd)
    p = compute_posterior_bound(model, torch.zeros(1, 20, 4, dtype=torch.float64), blank(1, 20, 2))
    position, velocity = (p[:, i, i] + p[:, i + 2, i + 2] for i in (0, 1))
    assert torch.allclose(
        position[[0, 1, 2, 19]].sqrt(),
        doubles([2.73899281, 2.70945734, 2.57092567, 1.89934607]),
        atol=6e-9,
    )
    assert torch.allclose(
        velocity[[0, 1, 19]].sqrt(), doubles([3.17148318, 2.02052469, 0.63338613]), atol=6e-9
    )


def test_on_a_linear_model_it_is_the_mean_of_the_kalman_covariances_whatever_is_missing() -> None:
    record = ModelSimulation(WALK, 30).draw(NominalNoise(), torch.arange(4), 1).record
    record.y[1, 5:12], record.y[2, ::3], record.y[3] = torch.nan, torch.nan, torch.nan
    f, g, h, r, p0 = (a.numpy() for a in (WALK.f, WALK.g, WALK.h, WALK.r, WALK.l0 @ WALK.l0.mT))
    each = [
        oracles.kalman(f, g @ g.T, h, np.diag(r**2), np.zeros(2), p0, y.numpy()).covariance
        for y in record.y
    ]
    unknown = torch.full(
        (4, 30, 2), torch.nan, dtype=torch.float64
    )  # a linear model has no use for the truth
    assert torch.allclose(
        compute_posterior_bound(WALK, unknown, record),
        torch.from_numpy(np.mean(each, 0)),
        rtol=1e-12,
        atol=0,
    )


def test_a_model_that_observes_its_initial_state_is_bounded_before_it_moves() -> None:
    model = LinearGaussian([[1.0]], [[3.0]], [[1.0]], [2.0], [0.0], [4.0], observes_initial=True)
    p = compute_posterior_bound(
        model, torch.zeros(1, 2, 1, dtype=torch.float64), blank(1, 2)
    ).flatten()
    first = 1 / (1 / 16 + 1 / 4)
    assert torch.allclose(p, doubles([first, 1 / (1 / (first + 9) + 1 / 4)]), rtol=1e-14)


def test_each_runs_own_initial_covariance_and_one_for_all() -> None:
    truth, spread = (
        torch.zeros(2, 1, 2, dtype=torch.float64),
        torch.diag_embed(doubles([[1.0, 2.0], [30.0, 4.0]])),
    )
    record = blank(2, 1)._replace(start=truth[:, 0], spread=spread)
    one = [compute_posterior_bound(WALK, truth[:1], blank(1, 1), s @ s.mT) for s in spread]
    assert torch.allclose(
        compute_posterior_bound(WALK, truth, record), (one[0] + one[1]) / 2, rtol=1e-12
    )  # those of the record
    given = doubles([[5.0, 1.0], [1.0, 3.0]])
    assert torch.allclose(
        compute_posterior_bound(WALK, truth, record, given),
        compute_posterior_bound(WALK, truth, blank(2, 1), given),
    )
    assert not torch.allclose(
        compute_posterior_bound(WALK, truth, record, given),
        compute_posterior_bound(WALK, truth, record),
    )


FLIGHT = SimulatedFlight(
    ManoeuvreTrajectory(
        (accelerate(5.0, 10.0), climb(8.0, 5.0, 5.0), turn(60.0, 10.0)),
        TrajectoryStart(32.0, 118.0, 200.0, 50.0, 45.0),
    ),
    ImuErrors(0.05, 0.05, 3600.0, 0.01, 100.0, 50.0, 1800.0, 5.0),
    GnssReceiver((6.87, 7.20, 4.83), (0.21, 0.20, 0.14)),
    AlignmentErrors((1.0, 1.0, 5.0), (0.2, 0.2, 0.2), (10.0, 10.0, 10.0)),
    imu_rate_hz=20.0,
)


@pytest.mark.parametrize(
    "inflation", [None, ProcessNoiseInflation()], ids=["rank 12 of 18", "full rank"]
)
def test_on_a_flight_it_is_the_covariance_of_the_kalman_filter(
    inflation: ProcessNoiseInflation | None,
) -> None:
    """Angles of 1e-4 rad beside metres and biases of 1e-7: correlations to nine digits."""
    episode = FLIGHT.draw(MeasurementOutage(((5.0, 9.0),)), torch.arange(3), 5)
    model = InsGnss(
        FLIGHT.imu, FLIGHT.receiver, FLIGHT.initial_errors, markov=True, inflation=inflation
    )

    def watch(t: int, info: Any) -> dict[str, Tensor]:
        return {"covariance": info.covariance()}

    with torch.no_grad():
        estimate = run_filter(
            GaussianFilter(TaylorLinearisation()),
            model,
            episode.record,
            PhiloxStream(1, torch.arange(3)),
            watch,
        )
    kalman = estimate.trace["covariance"].mean(0)
    p = compute_posterior_bound(model, model.assemble(episode.truth), episode.record)
    sd = kalman.diagonal(dim1=-2, dim2=-1).sqrt()
    assert ((p - kalman) / sd.unsqueeze(-1) / sd.unsqueeze(-2)).abs().max() < 1e-9


# nonlinear models: the published recursion, written out with inverses


def published(f: np.ndarray, q: np.ndarray, information: np.ndarray, j: np.ndarray) -> np.ndarray:
    """J' = D22 - D21 (J + D11)^-1 D12 from Jacobians of all runs f [T, R, d, d] [Tichavsky et al. 1998] -> J^-1."""
    out, inverse = [], np.linalg.inv(q)
    for slopes, told in zip(f, information, strict=True):
        d11 = np.mean([a.T @ inverse @ a for a in slopes], 0)
        d12 = -slopes.mean(0).T @ inverse
        j = inverse + told - d12.T @ np.linalg.solve(j + d11, d12)
        out.append(np.linalg.inv(j))
    return np.array(out)


def trajectories(model: Any, runs: int, steps: int) -> Tensor:
    """True states with the initial ones first [R, T + 1, D]: worlds of the model, continued from a state near its origin."""
    draws = PhiloxStream(3, torch.arange(runs))
    record = model.prepare(blank(runs, steps))
    x = [
        model.chart.add(
            model.origin + 0.3, model.p0 * draws.normal("world.start", 1, len(model.p0))
        )
    ]
    for t in range(steps):
        x.append(
            model.propagate(
                x[-1], record.at_step(t).u, draws.at_step(t).normal("world.w", 1, model.noise_dim)
            )
        )
    return torch.cat(x, 1)


def test_growth_follows_the_published_recursion() -> None:
    model, runs, steps = UnivariateGrowth(), 200, 12
    x = trajectories(model, runs, steps).numpy()
    before, after = x[:, :-1].transpose(1, 0, 2)[..., None], x[:, 1:]
    slopes = 0.5 + 25 * (1 - before**2) / (1 + before**2) ** 2
    information = (after / 10) ** 2
    y = torch.zeros(runs, steps, 1, dtype=torch.float64)
    y[:, 4], y[:50, 7] = torch.nan, torch.nan
    told = (information * ~torch.isnan(y).numpy()).mean(0)[..., None]
    expected = published(slopes, np.array([[10.0]]), told, np.array([[0.5]]))
    assert np.allclose(
        compute_posterior_bound(model, torch.from_numpy(x), Record(y)), expected, rtol=1e-10
    )
    # the Jacobians' scatter tells something: without it the bound would be another
    flat = published(
        np.broadcast_to(slopes.mean(1, keepdims=True), slopes.shape),
        np.array([[10.0]]),
        told,
        np.array([[0.5]]),
    )
    assert (flat > 1.02 * expected).any()


class Kicked(Pendulum):
    """A pendulum whose rate alone is driven: the noise has rank 1 of 2, and reaches all in which the Jacobians differ."""

    def __init__(self, unseen: float = 0.0) -> None:
        super().__init__(step=0.2)
        self.noise_root = doubles([[unseen, 0.0], [0.0, 0.1]])


def pendulum_slopes(x: np.ndarray) -> np.ndarray:
    f = np.zeros((*x.shape[:2], 2, 2))
    f[..., 0, 0], f[..., 0, 1], f[..., 1, 1] = 1.0, 0.2, 1.0
    f[..., 1, 0] = -9.81 * 0.2 * np.cos(x[..., 0])
    return f.transpose(1, 0, 2, 3)


def told_by_deflection(x: np.ndarray) -> np.ndarray:
    h = np.stack([np.cos(x[..., 0]), 0 * x[..., 0]], -1) / 0.3
    return (h[..., :, None] * h[..., None, :]).mean(0)


@pytest.mark.parametrize("unseen", [0.0, 0.02])
def test_a_pendulum_follows_the_published_recursion_or_its_limit(unseen: float) -> None:
    model, runs, steps = Kicked(unseen), 100, 15
    x = trajectories(model, runs, steps)
    p = compute_posterior_bound(model, x, blank(runs, steps)).numpy()
    little = max(unseen, 1e-6)
    f, told = pendulum_slopes(x[:, :-1].numpy()), told_by_deflection(x[:, 1:].numpy())
    expected = published(f, np.diag([little**2, 0.01]), told, np.diag([4.0, 4.0]))
    sd = np.sqrt(expected.diagonal(axis1=-2, axis2=-1))
    # inverses of noise 1e-6 beside 0.1 lose twelve of sixteen digits; and that noise adds its own 1e-12
    assert (np.abs(p - expected) / sd[..., None] / sd[:, None] < (1e-9 if unseen else 2e-3)).all()


class Loose(Kicked):
    """Driven in the angle alone, while the rate's Jacobian is what differs between runs."""

    def __init__(self) -> None:
        super().__init__()
        self.noise_root = doubles([[0.1, 0.0], [0.0, 0.0]])


def test_jacobians_that_differ_out_of_the_noises_reach_are_refused_and_the_remedy_works() -> None:
    model, runs = Loose(), 5
    x = trajectories(model, runs, 6)
    check_refused(
        [
            (
                r"Loose: Jacobians must differ .*run_by_run=True",
                lambda: compute_posterior_bound(model, x, blank(runs, 6)),
            )
        ],
        remedy=False,
    )
    each = [compute_posterior_bound(model, x[r : r + 1], blank(1, 6)) for r in range(runs)]
    assert torch.allclose(
        compute_posterior_bound(model, x, blank(runs, 6), run_by_run=True),
        torch.stack(each).mean(0),
        rtol=1e-12,
    )
    assert compute_posterior_bound(model, x[:1].expand(runs, -1, -1), blank(runs, 6)).allclose(
        each[0]
    )  # equal runs have one bound


def test_without_initial_states_the_first_jacobian_is_that_of_the_initial_laws_centre() -> None:
    model = Kicked(0.02)
    x = trajectories(model, 20, 5)
    centred = torch.cat([model.origin.expand(20, 1, 2), x[:, 1:]], 1)
    assert torch.equal(
        compute_posterior_bound(model, x[:, 1:], blank(20, 5)),
        compute_posterior_bound(model, centred, blank(20, 5)),
    )
    assert not torch.allclose(
        compute_posterior_bound(model, x, blank(20, 5)),
        compute_posterior_bound(model, centred, blank(20, 5)),
    )
    started = blank(20, 5)._replace(start=x[:, 0])
    assert torch.equal(
        compute_posterior_bound(model, x[:, 1:], started),
        compute_posterior_bound(model, x, blank(20, 5)),
    )


def test_differing_initial_laws_are_averaged_as_information() -> None:
    model, runs = Kicked(0.02), 3
    spread = torch.linalg.cholesky(
        doubles([[[1.0, 0.3], [0.3, 2.0]], [[1e-6, 0.0], [0.0, 9e6]], [[4.0, -1.0], [-1.0, 1.0]]])
    )
    still = torch.zeros(runs, 2, 2, dtype=torch.float64)
    record = Record(
        torch.full((runs, 1, 1), torch.nan, dtype=torch.float64), (), still[:, 0], spread
    )
    p0 = np.linalg.inv(np.mean([np.linalg.inv((s @ s.mT).numpy()) for s in spread], 0))
    f = pendulum_slopes(np.zeros((1, 1, 2)))[0, 0]
    expected = f @ p0 @ f.T + np.diag([0.02, 0.1]) ** 2
    assert np.allclose(
        compute_posterior_bound(model, still, record)[0], expected, rtol=1e-9, atol=0
    )


BELIEVED = StrapdownTuning(
    gyro_density=1e-2, accelerometer_density=0.1, gyro_bias_walk=1e-4, accelerometer_bias_walk=1e-3,
    position_sd=[1.0, 2.0, 3.0], velocity_sd=None, attitude_sd_deg=[1.0, 2.0, 3.0], initial_velocity_sd=[0.1, 0.2, 0.3],
    initial_position_sd=[1.0, 2.0, 3.0], gyro_bias_sd_deg_s=0.1, accelerometer_bias_sd=0.2,
)  # fmt: skip


def test_in_a_curved_chart_it_is_the_kalman_filter_linearised_along_the_truth() -> None:
    """A quaternion state, moving without noise; the filter's mean is put on the truth before each step."""
    model, steps, pieces = StrapdownTotal(BELIEVED), 8, 10
    draws = PhiloxStream(2, torch.arange(1))
    force = doubles([1.0, 2.0, 9.8]) + draws.normal("world.f", steps * pieces, 3).unflatten(
        1, (steps, pieces)
    )
    rate = draws.normal("world.w", steps * pieces, 3).unflatten(1, (steps, pieces))
    spans = torch.full((1, steps, pieces), 0.1, dtype=torch.float64)
    bias = torch.zeros(1, steps, 6, dtype=torch.float64)
    gravity = torch.full((1, steps), 9.8, dtype=torch.float64)
    u = PreintegratedImu(*preintegrate(force, rate, spans, bias), bias, gravity, spans.sum(-1))
    record = blank(1, steps, 3)._replace(u=u)
    x = [model.origin[None]]
    for t in range(steps):
        x.append(
            model.propagate(
                x[-1][:, None], record.at_step(t).u, torch.zeros(1, 1, 12, dtype=torch.float64)
            )[:, 0]
        )
    method, kalman = GaussianFilter(TaylorLinearisation()), []
    belief = method.init(model, 1, draws)
    with torch.no_grad():
        for t in range(steps):
            belief = method.step(model, belief._replace(mean=x[t]), record.at_step(t), draws)[0]
            kalman.append(belief.covariance[0])
    p, kalman = compute_posterior_bound(model, torch.stack(x, 1), record), torch.stack(kalman)
    sd = kalman.diagonal(dim1=-2, dim2=-1).sqrt()
    assert ((p - kalman) / sd.unsqueeze(-1) / sd.unsqueeze(-2)).abs().max() < 1e-9


# what a measurement tells


def test_a_variance_that_depends_on_the_state_tells_of_it() -> None:
    """y ~ N(0, e^x) tells 1/2 of x, whatever x is."""
    model = StochasticVolatility()
    p, expected = 0.3**2 / (1 - 0.95**2), []
    for _ in range(5):
        p = 1 / (1 / (0.95**2 * p + 0.09) + 0.5)
        expected.append(p)
    truth = PhiloxStream(1, torch.arange(7)).normal("world.x", 5, 1)
    assert torch.allclose(
        compute_posterior_bound(model, truth, blank(7, 5)).flatten(), doubles(expected), rtol=1e-12
    )


class Dense(Pendulum):
    """Two correlated measurements; mean and covariance depend on the state."""

    def observation(self, x: Tensor, u: Any) -> MultivariateNormal:
        a, b = x.unbind(-1)
        covariance = torch.stack([1 + a * a, 0.3 * a, 0.3 * a, torch.exp(b)], -1).unflatten(
            -1, (2, 2)
        )
        return MultivariateNormal(torch.stack([a * b, torch.sin(a)], -1), covariance)


def test_a_correlated_law_tells_what_its_scores_say() -> None:
    """E[s s'] by Gauss-Hermite quadrature over y, the scores by finite differences of the log density; then one part unseen."""
    model, x = Dense(), doubles([[0.7, -0.4]])
    nodes, weights = np.polynomial.hermite_e.hermegauss(12)
    grid = np.stack(np.meshgrid(nodes, nodes), -1).reshape(-1, 2)
    weight = np.outer(weights, weights).ravel() / (2 * math.pi)

    def moments(a: float, b: float) -> tuple[np.ndarray, np.ndarray]:
        return np.array([a * b, math.sin(a)]), np.array(
            [[1 + a * a, 0.3 * a], [0.3 * a, math.exp(b)]]
        )

    def log_density(y: np.ndarray, a: float, b: float, parts: list[int]) -> np.ndarray:
        mean, c = moments(a, b)
        e, c = (y - mean)[:, parts], c[np.ix_(parts, parts)]
        return -0.5 * ((e @ np.linalg.inv(c)) * e).sum(-1) - 0.5 * np.linalg.slogdet(c)[1]

    mean, c = moments(0.7, -0.4)
    y, step = mean + grid @ np.linalg.cholesky(c).T, 1e-5
    for parts in ([0, 1], [0], [1]):
        score = [
            (
                log_density(y, 0.7 + da, -0.4 + db, parts)
                - log_density(y, 0.7 - da, -0.4 - db, parts)
            )
            / (2 * step)
            for da, db in ((step, 0.0), (0.0, step))
        ]
        information = np.einsum("n,in,jn->ij", weight, score, score)
        seen = torch.full((1, 1, 2), torch.nan, dtype=torch.float64)
        seen[..., parts] = 0.0
        bound = compute_posterior_bound(
            model, x[:, None], Record(seen), torch.eye(2, dtype=torch.float64)
        )
        blind = compute_posterior_bound(
            model,
            x[:, None],
            Record(torch.full_like(seen, torch.nan)),
            torch.eye(2, dtype=torch.float64),
        )
        assert torch.allclose(
            torch.linalg.inv(bound[0]) - torch.linalg.inv(blind[0]),
            torch.from_numpy(information),
            atol=1e-7,
        )


# what has no bound here


class HeavyTailed(Pendulum):
    def observation(self, x: Tensor, u: Any) -> Independent:
        return Independent(StudentT(4.0, torch.sin(x[..., :1]), 0.3), 1)


@pytest.mark.parametrize(
    ("model", "truth", "initial", "message"),
    [
        (
            HeavyTailed(),
            torch.zeros(2, 3, 2),
            None,
            r"HeavyTailed: measurement distribution must be normal, got Independent \(heavy tails",
        ),
        (
            Benes(),
            torch.zeros(2, 3, 1),
            None,
            r"Benes: process noise .* The bound needs Benes\.noise_gain\(u\)",
        ),
        (
            Pendulum(),
            torch.full((2, 3, 2), torch.nan),
            None,
            r"truth must be known at all steps for Pendulum",
        ),
        (
            Pendulum(),
            torch.zeros(2, 5, 2),
            None,
            r"truth must have shape \[2, 3, 2\] .* Pendulum, .* got \[2, 5, 2\]",
        ),
        (Pendulum(), torch.zeros(1, 3, 2), None, r"truth must have shape .* got \[1, 3, 2\]"),
        (WALK, torch.zeros(2, 3, 2), -torch.eye(2), r"initial must be positive definite"),
        (
            WALK,
            torch.zeros(2, 3, 2),
            torch.diag(torch.tensor([1.0, 0.0])),
            r"initial must be positive definite",
        ),
    ],
)
def test_there_is_no_bound_and_the_reason_is_said(
    model: Any, truth: Tensor, initial: Tensor | None, message: str
) -> None:
    check_refused(
        [(message, lambda: compute_posterior_bound(model, truth.double(), blank(2, 3), initial))],
        remedy=False,
    )


# and nobody is below


@pytest.mark.slow
@pytest.mark.parametrize(
    "method",
    [
        ParticleFilter(2000, EssResampler(Systematic(), 0.5)),
        GaussianFilter(SigmaPointLinearisation(CubaturePoints())),
    ],
)
def test_no_filter_is_below_the_bound_and_a_good_one_is_near_it(method: Any) -> None:
    """Passive location from a prior of 500 m and 10 m/s that the true states are drawn from: the bound holds to the letter.

    From a wider prior it would be far below all filters: the mean of informations from many bearings knows the range too.
    """
    model = PassiveLocation(
        1.0,
        1.0,
        (1.64e-3, 1.64e-3, 1e-4, 1e-4, 1.0),
        (40e3, 60e3, 5.0, -5.0),
        (500.0, 500.0, 10.0, 10.0),
    )
    runs, steps = 150, 30
    draws = PhiloxStream(8, torch.arange(runs))
    velocity = doubles([200.0, 0.0, 0.0])
    place = doubles([0.0, 0.0, 2000.0]) + torch.arange(1, steps + 1)[:, None] * velocity
    attitude = compute_level_attitude(velocity).expand(1, steps, 3, 3)
    u = PlatformInputs(
        place[None], velocity.expand(1, steps, 3), attitude, doubles([[1e10] * steps])
    )
    record = blank(runs, steps, 5)._replace(u=u)
    x = [model.origin + model.p0 * draws.normal("world.start", 1, 4)]
    y = []
    for t in range(steps):
        x.append(
            model.propagate(x[-1], record.at_step(t).u, draws.at_step(t).normal("world.w", 1, 2))
        )
        y.append(
            model.observation(x[-1], record.at_step(t).u).mean
            + model.r * draws.at_step(t).normal("world.v", 1, 5)
        )
    truth = torch.cat(x, 1)
    record = record._replace(y=torch.cat(y, 1))
    p = compute_posterior_bound(model, truth, record)
    with torch.no_grad():
        estimate = run_filter(method, model, record, PhiloxStream(9, torch.arange(runs)))
    error = estimate.mean - truth[:, 1:]
    white = torch.linalg.solve_triangular(
        torch.linalg.cholesky(p), error.permute(1, 2, 0), upper=False
    )  # [T, d, R]
    ratio = white.square().mean(
        (0, 1)
    )  # of each run: mean over time and components, 1 at the bound
    mean, error_of_mean = ratio.mean(), ratio.std() / math.sqrt(runs)
    assert mean > 1.0 - 4.0 * error_of_mean
    assert mean < 1.15 + 4.0 * error_of_mean
