"""Particle swarms: chaos is chaotic, limits hold, the mixture converges to the Kalman filter, the printed weights to the fix."""

import dataclasses
import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import oracles
import pytest
import torch
from filter_laws import check_own
from pyro.distributions import Independent, Normal
from refusals import check_refused
from scipy import stats
from torch import Tensor
from torch.distributions import Distribution

from pfbench import job
from pfbench.core import (
    Chart,
    Episode,
    EuclideanBlock,
    PhiloxStream,
    RandomStream,
    Record,
    map_inputs,
)
from pfbench.filter import (
    ChiSquareStopping,
    EssResampler,
    FilterResult,
    MixtureWeighting,
    ParticleBelief,
    ParticleFilter,
    PrintedWeighting,
    SwarmLimits,
    SwarmProposal,
    Systematic,
    run_filter,
)
from pfbench.filter.proposed.swarm_coordinates import (
    AllComponents,
    LikelihoodFitness,
    ObservedComponents,
    PosteriorFitness,
    SwarmFrame,
    observed_components,
)
from pfbench.filter.proposed.swarm_motion import (
    ChaoticPerturbation,
    ChaoticPoints,
    GaussianVelocity,
    InertiaVelocity,
    IntervalStart,
    PriorStart,
    SwarmState,
    arcsine_cdf,
    iterate_logistic,
    logistic_map,
    safe_seeds,
)
from pfbench.job.config import compose_tree
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
from pfbench.noise.base import NominalNoise

ALWAYS = EssResampler(Systematic(), 1.0)
ESCAPE = InertiaVelocity(escape_coefficient=0.12)
PRINTED = SwarmProposal(
    ESCAPE,
    ChaoticPerturbation(),
    LikelihoodFitness(),
    AllComponents(),
    SwarmLimits(True, 0.5, None),
    None,
    30,
    IntervalStart(),
    PrintedWeighting(),
)
CORRECTED = SwarmProposal()
PSO = dataclasses.replace(
    PRINTED, velocity=GaussianVelocity(), perturbation=None, swarm_start=PriorStart()
)


def draws(runs: int, seed: int = 1, step: int = 1) -> PhiloxStream:
    return PhiloxStream(seed, torch.arange(runs), step=step)


def cloud_of(x: Tensor, **parts: Any) -> ParticleBelief:
    flat = torch.full(x.shape[:2], -math.log(x.shape[1]), dtype=x.dtype)
    return ParticleBelief(
        x, parts.pop("log_w", flat), torch.zeros(len(x), dtype=torch.float64), **parts
    )


def chain() -> LinearGaussian:
    """Two coordinates seen, a third that is tied to them and a fourth that is not; noise in all of them."""
    return LinearGaussian(
        [[1.0, 0.0, 0.5, 0.0], [0.0, 0.9, 0.3, 0.1], [0.0, 0.0, 0.95, 0.0], [0.0, 0.0, 0.0, 0.9]],
        torch.diag(torch.tensor([0.6, 0.5, 0.3, 0.4])),
        [[1.0, 0.0, 0.0, 0.0], [0.5, 1.0, 0.0, 0.0]], [1.0, 0.7], [0.0] * 4, [1.5, 1.0, 1.0, 0.8],
    )  # fmt: skip


def measured(model: LinearGaussian, runs: int, steps: int) -> Tensor:
    """Worlds of the model's own: y [R, T, Dy]."""
    source = draws(runs, seed=11)
    x = model.m0 + source.at_step(0).normal("world.initial", 1, model.f.shape[0]) @ model.l0.mT
    rows = []
    for t in range(1, steps + 1):
        x = model.propagate(x, (), source.at_step(t).normal("world.noise", 1, model.noise_dim))
        rows.append(
            x @ model.h.mT + model.r * source.at_step(t).normal("world.seen", 1, len(model.r))
        )
    return torch.cat(rows, 1)


def kalman(model: LinearGaussian, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Means [R, T, D], variances [T, D] and log evidence [R]."""
    f, g, h, r, m0, root = (getattr(model, k).numpy() for k in ("f", "g", "h", "r", "m0", "l0"))
    exact = [
        oracles.kalman(f, g @ g.T, h, np.diag(r**2), m0, root @ root.T, one.numpy()) for one in y
    ]
    mean = torch.tensor(np.array([k.mean for k in exact]))
    variance = torch.tensor(np.diagonal(exact[0].covariance, axis1=1, axis2=2).copy())
    return mean, variance, torch.tensor(np.array([k.log_evidence.sum() for k in exact]))


def run(
    proposal: SwarmProposal, model: StateSpaceModel, y: Tensor, n: int, seed: int = 5, **parts: Any
) -> FilterResult:
    return run_filter(
        ParticleFilter(n, ALWAYS, proposal=proposal, **parts), model, Record(y), draws(len(y), seed)
    )


# chaos


def test_seeds_that_die_are_not_drawn() -> None:
    """0, 1/4, 1/2, 3/4, 1 and some of their preimages end at a fixed point of the map."""

    def ends(z: float, steps: int) -> float:
        for _ in range(steps):
            z = 4.0 * z * (1.0 - z)
        return z

    assert [ends(z, 3) for z in (0.0, 0.25, 0.5, 0.75, 1.0)] == [0.0, 0.75, 0.0, 0.75, 0.0]
    for z, limit in (
        (0.5 - math.sqrt(0.125), 0.0),
        (0.5 + math.sqrt(0.125), 0.0),
        (0.5 - math.sqrt(0.1875), 0.75),
    ):
        assert ends(z, 4) == pytest.approx(limit, abs=1e-6)
    u = torch.linspace(0.0, 1.0, 100_001, dtype=torch.float64)
    z = safe_seeds(u)
    dead = torch.tensor([0.0, 0.25, 0.5, 0.75, 1.0], dtype=torch.float64)
    assert (z[:, None] - dead).abs().min() >= 1e-3 - 1e-12
    inside = z[(z > 0.001) & (z < 0.249)]  # uniform on what is left
    assert stats.kstest(inside.numpy(), stats.uniform(0.001, 0.248).cdf).statistic < 1e-3


def test_the_map_keeps_the_arcsine_law_and_its_sequences_are_independent() -> None:
    """Mean 1/2 and variance 1/8; the error of a time average over L steps of M sequences is about 0.35 / sqrt(L M)."""
    spare = safe_seeds(draws(1).uniform("spare", 2000, 2))
    z, values = iterate_logistic(draws(1).uniform("chaos", 2000, 2)), []
    for _ in range(50):
        z = logistic_map(z, spare)
        values.append(z)
    all_ = torch.stack(values)
    assert all_.dtype == torch.float64
    assert all_.mean().item() == pytest.approx(0.5, abs=0.005)
    assert all_.var().item() == pytest.approx(0.125, abs=0.002)
    assert stats.kstest(arcsine_cdf(z).flatten().numpy(), stats.uniform.cdf).pvalue > 1e-3
    assert abs(np.corrcoef(z[0, :, 0].numpy(), z[0, :, 1].numpy())[0, 1]) < 4.5 / math.sqrt(2000)
    assert torch.equal(values[1], 4 * values[0] * (1 - values[0]))  # chaos, not a new draw


def test_a_sequence_at_a_fixed_point_goes_on_from_its_spare_seed() -> None:
    spare = torch.tensor([0.3, 0.4, 0.6, 0.7], dtype=torch.float64)
    z = logistic_map(torch.tensor([0.5, 0.75, 1e-14, 0.3], dtype=torch.float64), spare)
    assert torch.allclose(
        z, torch.tensor([0.3, 0.4, 0.6, 0.84], dtype=torch.float64), rtol=0, atol=1e-15
    )
    extremes = arcsine_cdf(
        logistic_map(torch.tensor([0.5, 0.5 + 1e-9, 1e-13], dtype=torch.float64), spare[:3])
    )
    assert torch.isfinite(torch.special.ndtri(extremes)).all()


@pytest.mark.parametrize("dimension", [1, 2])
def test_chaotic_points_have_the_initial_law(dimension: int) -> None:
    """Kolmogorov test of each component, and no correlation between components beyond the law's own."""
    sd = [[2.0]] if dimension == 1 else [[2.0, 0.0], [-1.0, 0.5]]
    eye = torch.eye(dimension)
    model = LinearGaussian(eye, eye, eye, [1.0] * dimension, [3.0, -1.0][:dimension], sd)
    x = ParticleFilter(4000, points=ChaoticPoints()).init(model, 2, draws(2)).x
    z = torch.linalg.solve_triangular(model.l0, (x - model.m0).mT, upper=False)
    for component in z.unbind(1):
        assert stats.kstest(component.flatten().numpy(), stats.norm.cdf).pvalue > 1e-3
    if dimension == 2:
        assert abs(np.corrcoef(z[0].numpy())[0, 1]) < 4.5 / math.sqrt(4000)
    assert not torch.equal(x, ParticleFilter(4000).init(model, 2, draws(2)).x)


# flight


def test_the_escape_factor_rises_from_0_to_twice_its_amplitude() -> None:
    values = [ESCAPE.compute_escape_factor(i / 150) for i in range(151)]
    assert values[0] == 0.0
    assert values[75] == pytest.approx(0.12)
    assert values[-1] == pytest.approx(0.24)
    assert (np.diff(values) > 0).all()
    linear = dataclasses.replace(ESCAPE, escape_schedule="linear")
    assert [linear.compute_escape_factor(i / 4) for i in range(5)] == pytest.approx(
        [0.0, 0.06, 0.12, 0.18, 0.24]
    )


def still(flock_q: Tensor, **parts: Tensor) -> SwarmState:
    zero = torch.zeros(flock_q.shape[:2], dtype=flock_q.dtype)
    base = SwarmState(
        flock_q, torch.zeros_like(flock_q), zero, flock_q, zero, flock_q, zero, flock_q
    )
    return base._replace(**parts)


class Spy:
    """Looks at each iteration's swarm before it flies on."""

    def __init__(self, inner: Any) -> None:
        self.inner, self.flocks = inner, list[SwarmState]()

    def __call__(
        self, flock: SwarmState, live: Tensor, phase: float, source: RandomStream, purpose: str
    ) -> Tensor:
        self.flocks.append(flock)
        v: Tensor = self.inner(flock, live, phase, source, purpose)
        return v


@pytest.mark.parametrize("velocity", [ESCAPE, GaussianVelocity()], ids=["escape", "gaussian"])
@pytest.mark.parametrize(
    "coordinates",
    [AllComponents(), ObservedComponents(), ObservedComponents(whiten=True)],
    ids=["all", "observed", "white"],
)
def test_limits_hold_and_the_best_only_improves(velocity: Any, coordinates: Any) -> None:
    model, spy = chain(), Spy(velocity)
    x = torch.randn(3, 60, 4, dtype=torch.float64, generator=torch.manual_seed(3)) * torch.tensor(
        [2.0, 1.0, 1.0, 0.5]
    )
    w = torch.full((3, 60), 1 / 60, dtype=torch.float64)
    frame = coordinates(model, x, w, ())
    swarm = SwarmProposal(
        spy,
        ChaoticPerturbation(0.1),
        LikelihoodFitness(),
        coordinates,
        SwarmLimits(False, 0.05, 2.5),
        None,
        12,
    )
    seen = Record(
        torch.full((3, 2), 9.0, dtype=torch.float64)
    )  # far away: they would like to leave the box
    memory = {"swarm.chaos": iterate_logistic(draws(3).uniform("chaos", 60, 4)).unsqueeze(1)}
    final, flown = swarm.optimise(model, frame, w > 0, memory, seen, draws(3))
    flocks = [*spy.flocks, final]
    sd = frame.covariance.diagonal(dim1=1, dim2=2).sqrt().unsqueeze(1)
    assert len(flocks) == 13
    assert (flown == 12).all()
    for before, after in pairwise(flocks):
        assert (after.v.abs() <= 6 * 0.05 * sd * (1 + 1e-12)).all()
        assert (after.q.abs() <= 2.5 * sd * (1 + 1e-12)).all()
        reach = 6 * (0.05 + 0.1) * sd * (1 + 1e-9)
        assert (
            (after.q - before.q).abs() <= torch.maximum(reach, before.q.abs() - 2.5 * sd + reach)
        ).all()
        assert (after.best_fitness >= before.best_fitness).all()
        assert (after.worst_fitness <= before.worst_fitness).all()
        fitness = model.log_likelihood(seen.y, frame.to_states(after.best), ())
        assert torch.allclose(fitness, after.best_fitness, rtol=0, atol=1e-9)
        assert torch.allclose(
            model.log_likelihood(seen.y, frame.to_states(after.q), ()),
            after.fitness,
            rtol=0,
            atol=1e-9,
        )
        assert torch.allclose(
            model.log_likelihood(seen.y, frame.to_states(after.worst), ()),
            after.worst_fitness,
            rtol=0,
            atol=1e-9,
        )
    assert (final.best_fitness.amax(1) > flocks[0].best_fitness.amax(1)).all()
    assert (flocks[3].v.abs() == 6 * 0.05 * sd).any()  # the limits were met
    assert (final.q.abs() == 2.5 * sd).any()


def test_a_run_stops_where_its_best_particle_is_close_enough() -> None:
    """Median of chi-square with as many degrees of freedom as components were seen; no run feels another."""
    model = chain()
    y = torch.tensor(
        [[0.0, 0.0], [7.0, -5.0], [50.0, 50.0], [math.nan, 9.0], [math.nan, math.nan]],
        dtype=torch.float64,
    )
    swarm = SwarmProposal(
        ESCAPE,
        ChaoticPerturbation(),
        LikelihoodFitness(),
        ObservedComponents(),
        SwarmLimits(False, 0.05, None),
        ChiSquareStopping(),
        40,
    )
    x = torch.randn(5, 30, 4, dtype=torch.float64, generator=torch.manual_seed(5))
    w = torch.full((5, 30), 1 / 30, dtype=torch.float64)
    frame = swarm.coordinates(model, x, w, ())
    memory = {"swarm.chaos": iterate_logistic(draws(5).uniform("chaos", 30, 4)).unsqueeze(1)}
    flock, flown = swarm.optimise(model, frame, w > 0, memory, Record(y), draws(5))
    assert flown[0] == 1
    assert 1 < flown[1] < 40
    assert flown[3] > 1
    assert flown[4] == 0
    best = frame.to_states(flock.best_position().expand(-1, 30, -1))[:, 0] @ model.h.mT
    distance = ((torch.where(torch.isnan(y), best, y) - best) / model.r).square().sum(-1)
    limits = [stats.chi2.ppf(0.5, k) for k in (2, 2, 2, 1)]
    assert all(d <= c for d, c, n in zip(distance, limits, flown, strict=False) if n < 40)
    assert flown[2] == 40 or distance[2] <= limits[2]
    for r in range(5):
        only = slice(r, r + 1)
        alone = PhiloxStream(1, torch.tensor([r]), step=1)
        own = swarm.coordinates(model, x[only], w[only], ())
        mine = {k: v[only] for k, v in memory.items()}
        single, count = swarm.optimise(model, own, w[only] > 0, mine, Record(y[only]), alone)
        assert count == flown[r]
        assert torch.allclose(single.q, flock.q[only], rtol=0, atol=1e-12)
        assert torch.equal(single.chaos, flock.chaos[only])  # a stopped run's sequences wait too


def test_the_normal_constant_of_a_spread_that_depends_on_the_state_does_not_stop_a_run() -> None:
    """-2 ln p(y | x) alone would count ln sd: for a volatility of exp(-8 / 2) any measurement would seem near."""
    x = torch.tensor([[[-8.0]], [[2.0]]], dtype=torch.float64)
    seen = Record(torch.tensor([[1.0], [1.0]], dtype=torch.float64))
    assert ChiSquareStopping()(StochasticVolatility(), x, seen).tolist() == [False, True]


# coordinates


class Tied(StateSpaceModel):
    """Sees the product of the first two of four states with a spread that depends on the third."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("one", torch.ones(4, dtype=torch.float64))
        self.names, self.units, self.groups, self.noise_dim = (
            tuple("abcd"),
            ("",) * 4,
            {"state": (0, 1, 2, 3)},
            4,
        )

    def initial(self, runs: int) -> Distribution:
        return Normal(torch.zeros(runs, 4), self.one.expand(runs, -1)).to_event(1)

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return x + w

    def observation(self, x: Tensor, u: Any) -> Distribution:
        return Independent(Normal(x[..., :1] * x[..., 1:2], torch.exp(x[..., 2:3])), 1)


@pytest.mark.parametrize(
    ("model", "parts"),
    [
        (chain(), [0, 1]), (linear_walk(1.0, 1.0, 1.0), [0]), (UnivariateGrowth(), [0]), (StochasticVolatility(), [0]), (Benes(), [0]),
        (Pendulum(), [0]), (Lorenz63(), [0, 1, 2]), (Tied(), [0, 1, 2]),
    ],
    ids=lambda v: type(v).__name__,
)  # fmt: skip
def test_what_the_measurement_depends_on_is_found(model: StateSpaceModel, parts: list[int]) -> None:
    mean = torch.full((2, 1, model.chart.size), 0.7, dtype=torch.float64)
    assert observed_components(model, mean, ()).tolist() == parts


@pytest.mark.parametrize(
    "coordinates", [AllComponents(), ObservedComponents(), ObservedComponents(whiten=True), ObservedComponents(regress_unobserved=False), ObservedComponents(False, True)],
    ids=["all", "regressed", "white", "left", "left, white"],
)  # fmt: skip
def test_frames_place_the_cloud_where_it_is_and_move_what_they_should(coordinates: Any) -> None:
    model = chain()
    mix = torch.randn(4, 4, dtype=torch.float64, generator=torch.manual_seed(1))
    x = torch.randn(2, 500, 4, dtype=torch.float64, generator=torch.manual_seed(2)) @ mix + 3.0
    log_w = torch.log_softmax(
        torch.randn(2, 500, dtype=torch.float64, generator=torch.manual_seed(6)), 1
    )
    w = log_w.exp()
    frame: SwarmFrame = coordinates(model, x, w, ())
    assert torch.allclose(frame.to_states(frame.q), x, rtol=0, atol=1e-12)
    assert torch.allclose(
        (w.unsqueeze(-1) * frame.q).mT @ frame.q, frame.covariance, rtol=0, atol=1e-10
    )
    if coordinates.whiten:
        assert torch.allclose(
            frame.covariance,
            torch.eye(2, dtype=torch.float64).expand(2, -1, -1),
            rtol=0,
            atol=1e-12,
        )
    if isinstance(coordinates, AllComponents):
        return
    k = len(frame.components)
    moved = frame.to_states(frame.q + torch.tensor([0.5, -1.0], dtype=torch.float64)) - x
    assert torch.allclose(moved, moved[:, :1].expand_as(moved), rtol=0, atol=1e-12)
    if not coordinates.whiten:
        assert torch.allclose(
            moved[..., :k], torch.tensor([0.5, -1.0], dtype=torch.float64), rtol=0, atol=1e-12
        )
    if not coordinates.regress_unobserved:
        assert torch.allclose(moved[..., k:], torch.zeros(1).double(), rtol=0, atol=1e-12)
        return
    mean = (w.unsqueeze(-1) * x).sum(1, keepdim=True)
    for r in range(2):  # the regression by weighted least squares
        c, root = (x[r] - mean[r]).numpy(), np.sqrt(w[r].numpy())[:, None]
        slope = np.linalg.lstsq(root * c[:, :k], root * c[:, k:], rcond=None)[0]
        assert moved[r, 0, k:].numpy() == pytest.approx(moved[r, 0, :k].numpy() @ slope, abs=1e-9)


def test_the_posterior_fitness_is_highest_at_the_kalman_mean() -> None:
    """Gradient and curvature are those of the log posterior of the cloud's normal law."""
    model = chain()
    x = torch.randn(1, 400, 4, dtype=torch.float64, generator=torch.manual_seed(2))
    w = torch.full((1, 400), 1 / 400, dtype=torch.float64)
    frame = AllComponents()(model, x, w, ())
    y = torch.tensor([[1.5, -2.0]], dtype=torch.float64)
    s, h, r = frame.covariance[0], model.h, torch.diag(model.r**2)
    gain = s @ h.mT @ torch.linalg.inv(h @ s @ h.mT + r)
    mode = (gain @ (y[0] - h @ x.mean(1)[0]))[None, None]
    w = PosteriorFitness(covariance_shrinkage=0.0)(frame)

    value = lambda q: (  # noqa: E731
        model.log_likelihood(y, frame.origin + q, ()) - 0.5 * (q @ w.mT).square().sum(-1)
    )
    steps = 0.1 * torch.eye(4, dtype=torch.float64)
    up, down = (value(mode + sign * steps) for sign in (1, -1))
    assert torch.allclose(up, down, rtol=0, atol=1e-9)
    assert (up < value(mode)).all()


# weights


def mixed(
    runs: int, n: int, shift: float, centres: Callable[[Tensor], Tensor]
) -> list[tuple[Tensor, float]]:
    """sum w f and E_p f for f = 1, a, a^2, u a: p = N(0, 1) in a, with u tied to it, all drawn `shift` lower and weighed back."""
    source, live = draws(runs), torch.arange(n) < n - 3
    a = source.normal("a", n, 2) - torch.tensor([shift, 0.0], dtype=torch.float64)
    u = 2.0 * a[..., :1] + source.normal("u", n, 1)
    log_w = torch.where(live, shift * a[..., 0], -torch.inf).log_softmax(1)
    eye = torch.eye(2, dtype=torch.float64).expand(runs, -1, -1)
    frame = SwarmFrame(a, eye, torch.arange(2), Chart((EuclideanBlock(2),)), 0.0 * a[:, :1], a, eye)
    q, log_ratio = MixtureWeighting(0.4)(frame, centres(a), log_w, source)
    u = u + 2.0 * (q - a)[..., :1]
    assert (log_ratio[:, live] <= -math.log(round(0.4 * (n - 3)) / (n - 3)) + 1e-12).all()
    w = torch.exp(torch.where(live, log_w + log_ratio, -torch.inf))
    functions = (
        (torch.ones_like(w), 1.0),
        (q[..., 0], 0.0),
        (q[..., 1] ** 2, 1.0),
        (u[..., 0] * q[..., 0], 2.0),
    )
    return [((w * f).sum(1), expected) for f, expected in functions]


def test_the_mixture_is_unbiased_about_centres_of_any_kind() -> None:
    fixed = torch.tensor([[1.0, -0.5], [-2.0, 0.3]], dtype=torch.float64).repeat(10, 1)
    for values, expected in mixed(6000, 20, 0.0, lambda a: fixed.expand_as(a)):
        assert abs(values.mean() - expected) < 4.5 * values.std() / math.sqrt(6000), (
            f"{values.mean()} for {expected}"
        )


@pytest.mark.parametrize("shift", [0.0, 0.6])
def test_the_mixture_converges_for_a_swarm_and_for_uneven_weights(shift: float) -> None:
    """Centres that follow from the particles make a bias of 1 / N; weights that differ belong to both parts."""
    for values, expected in mixed(
        60, 800, shift, lambda a: 0.5 * a + torch.tensor([1.0, -0.5], dtype=torch.float64)
    ):
        assert abs(values.mean() - expected) < 4.5 * values.std() / math.sqrt(60) + 0.01, (
            f"{values.mean()} for {expected}"
        )


def test_who_is_kept_is_drawn_afresh() -> None:
    """A fixed subset of a resampled cloud is a sorted one: neighbours are siblings."""
    n, runs = 10, 2000
    zero = torch.zeros(runs, n, 1, dtype=torch.float64)
    one = torch.ones(runs, 1, 1, dtype=torch.float64)
    frame = SwarmFrame(
        zero, one, torch.zeros(1).long(), Chart((EuclideanBlock(1),)), 0.0 * one, zero, one
    )
    flat = torch.full((runs, n), -math.log(n), dtype=torch.float64)
    kept = []
    for step in (1, 2):
        q, _ = MixtureWeighting(0.3)(frame, frame.q + 50.0, flat, draws(runs, step=step))
        kept.append(q[..., 0].abs() < 1e-9)
        assert (kept[-1].sum(1) == 3).all()
        shares = kept[-1].double().mean(0)
        assert ((shares - 0.3).abs() < 4.5 * math.sqrt(0.21 / runs)).all()
    assert 0.02 < (kept[0] == kept[1]).all(1).double().mean() * 10 < 0.2  # 1 in 120 pairs


def test_kernels_in_blocks_are_the_sum_over_all_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    from pfbench.filter.proposed import swarm_weighting

    a, m = (
        torch.randn(3, 23, 2, dtype=torch.float64, generator=torch.manual_seed(i)) for i in (1, 2)
    )
    log_w = torch.log_softmax(
        torch.randn(3, 23, dtype=torch.float64, generator=torch.manual_seed(3)), 1
    )
    log_w[:, 5] = -torch.inf
    direct = (
        log_w.unsqueeze(1) - 0.5 * (a.unsqueeze(2) - m.unsqueeze(1)).square().sum(-1)
    ).logsumexp(-1)
    for pairs in (2**17, 3 * 23 * 4):
        monkeypatch.setattr(swarm_weighting, "_PAIRS", pairs)
        assert torch.allclose(
            swarm_weighting._log_sum_of_kernels(a, m, log_w), direct, rtol=0, atol=1e-12
        )


def test_keeping_all_is_the_bootstrap_filter() -> None:
    model = chain()
    y = measured(model, 3, 8)
    swarm = dataclasses.replace(CORRECTED, weighting=MixtureWeighting(1.0))
    assert swarm.is_exact
    assert not CORRECTED.is_exact
    plain = run_filter(ParticleFilter(50, ALWAYS), model, Record(y), draws(3, 5))
    same = run(swarm, model, y, 50)
    assert torch.allclose(same.mean, plain.mean, rtol=0, atol=1e-10)
    assert torch.allclose(same.log_evidence, plain.log_evidence, rtol=0, atol=1e-10)


# against the Kalman filter


def distances(swarm: SwarmProposal, sizes: tuple[int, ...], runs: int = 50) -> list[float]:
    """Root mean square distance to the Kalman mean, in posterior standard deviations, for numbers of particles."""
    model = chain()
    y = measured(model, runs, 10)
    mean, variance, _ = kalman(model, y)
    found = [run(swarm, model, y, n, points=ChaoticPoints()).mean for n in sizes]
    return [float(((x - mean)[:, 4:] / variance[4:].sqrt()).square().mean().sqrt()) for x in found]


@pytest.mark.slow
@pytest.mark.parametrize("velocity", [ESCAPE, GaussianVelocity()], ids=["escape", "gaussian"])
def test_the_corrected_swarm_converges_at_the_monte_carlo_rate(velocity: Any) -> None:
    """Four times the particles halve the distance to the Kalman filter."""
    few, many = distances(dataclasses.replace(CORRECTED, velocity=velocity), (60, 240))
    assert 1.6 < few / many < 2.4


def test_the_corrected_evidence_converges() -> None:
    model = chain()
    y = measured(model, 40, 10)
    estimate, exact = run(CORRECTED, model, y, 400), kalman(model, y)
    error = estimate.log_evidence - exact[2]
    assert (
        abs(error.mean()) < 4.5 * error.std() / math.sqrt(40) + 0.02
    )  # the logarithm is biased by half the variance
    assert error.std() < 0.5
    assert (estimate.variance.mean(0) / exact[1]).numpy() == pytest.approx(1.0, abs=0.12)


# anything goes


SWARMS = {
    "printed": PRINTED,
    "stopped": dataclasses.replace(PRINTED, stopping=ChiSquareStopping()),
    "corrected": CORRECTED,
    "pso": PSO,
}


@pytest.mark.parametrize("name", SWARMS)
def test_a_run_does_not_feel_its_neighbours(name: str) -> None:
    y = measured(chain(), 4, 8)
    y[1, 2:4, 0] = math.nan
    check_own(ParticleFilter(25, ALWAYS, proposal=SWARMS[name]), chain(), y, 1e-7)


class Fragile(Tied):
    """Breaks particles whose first state is above 100."""

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return torch.where(x[..., :1] > 100.0, torch.inf, x + w)


@pytest.mark.parametrize("name", SWARMS)
def test_empty_slots_and_broken_particles_harm_nobody(name: str) -> None:
    """An empty slot stays empty; a particle that is not finite weighs nothing and stays where its parent was."""
    swarm = dataclasses.replace(SWARMS[name], swarm_start=PriorStart())
    x = torch.randn(2, 40, 4, dtype=torch.float64, generator=torch.manual_seed(8))
    x[:, 12, 0], x[:, 35] = 101.0, 1e6
    log_w = torch.where(torch.arange(40) < 30, -math.log(30), -torch.inf).double().expand(2, -1)
    sent = swarm(Fragile(), cloud_of(x, log_w=log_w), Record(torch.zeros(2, 1).double()), draws(2))
    assert torch.isfinite(sent.x).all()
    assert (sent.log_ratio[:, 30:] == -torch.inf).all()
    assert (sent.log_ratio[:, 12] == -torch.inf).all()
    alive = [i for i in range(30) if i != 12]
    assert torch.isfinite(sent.log_ratio[:, alive]).all()
    assert sent.x[:, alive].abs().max() < (
        1e4 if swarm.limits.scale_by_prior else 12.0
    )  # the first cloud's scale counts who then broke


TOYS = [UnivariateGrowth(), StochasticVolatility(), Benes(), Pendulum(), Lorenz63()]


@pytest.mark.parametrize("model", TOYS, ids=lambda v: type(v).__name__)
@pytest.mark.parametrize("name", ["printed", "corrected"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_swarms_run_on_models_of_all_kinds(
    model: StateSpaceModel, name: str, dtype: torch.dtype
) -> None:
    y = torch.full((3, 3, 3 if isinstance(model, Lorenz63) else 1), 0.6, dtype=dtype)
    source = PhiloxStream(1, torch.arange(3), dtype)
    estimate = run_filter(
        ParticleFilter(40, ALWAYS, proposal=SWARMS[name]), model.to(dtype), Record(y), source
    )
    model.to(torch.float64)
    assert estimate.mean.dtype == dtype
    assert not estimate.lost.any()
    assert torch.isfinite(estimate.mean).all()


def test_bad_choices_are_told() -> None:
    check_refused(
        [
            ("iterations", lambda: SwarmProposal(iterations=0)),
            (
                "limits.scale_by_prior",
                lambda: SwarmProposal(limits=SwarmLimits(scale_by_prior=True)),
            ),
            ("weighting.defensive_fraction", lambda: MixtureWeighting(0.0)),
            ("quantile", lambda: ChiSquareStopping(1.0)),
            ("inertia_weight", lambda: InertiaVelocity(inertia_weight=1.0)),
            ("escape_coefficient", lambda: InertiaVelocity(escape_coefficient=-0.1)),
            (
                "printed_iterations must be at least 1.* Use null",
                lambda: InertiaVelocity(printed_iterations=0),
            ),
            ("escape_schedule", lambda: InertiaVelocity(escape_schedule="square")),
            ("beta", lambda: ChaoticPerturbation(0.0)),
            ("max_velocity_sd", lambda: SwarmLimits(max_velocity_sd=0.0)),
            ("max_distance_sd", lambda: SwarmLimits(max_distance_sd=-1.0)),
            ("covariance_shrinkage", lambda: PosteriorFitness(2.0)),
        ]
    )


# in flight


PRESETS = ("pso_pf", "cpso_pf", "cpso_escape", "cpso_escape_printed", "cpso_escape_stopped")


def composed(scenario: str, *words: str) -> Any:
    return compose_tree([f"scenario={scenario}", "episode_cache_dir=null", "particles=100", *words])


def flown(runs: int, steps: int, model: str) -> tuple[Any, Episode]:
    """The first 80 s of the paper's flight."""
    cfg = composed("flight_500s", f"model={model}", "model.markov=true")
    cfg.scenario.trajectory.segments = (
        cfg.scenario.trajectory.segments[:2] + cfg.scenario.trajectory.segments[3:4]
    )
    cfg.scenario.trajectory.segments[2].duration_s = 20.0
    cfg.scenario.imu_rate_hz = 20.0
    episode: Episode = job.instantiate(cfg.scenario).draw(NominalNoise(), torch.arange(runs), 1)
    record = episode.record
    return cfg, dataclasses.replace(
        episode, record=Record(record.y[:, :steps], map_inputs(lambda a: a[:, :steps], record.u))
    )


@pytest.mark.slow
def test_in_flight_the_corrected_swarm_converges_and_the_printed_one_returns_the_fix() -> None:
    """Distances in position from 20 s on: to the Kalman filter of the same inflated model, and to the raw fix."""
    cfg, episode = flown(8, 50, "ins_gnss_inflated")
    model = job.instantiate(cfg.model)

    def estimated(name: str, n: int = 100) -> Tensor:
        words = composed("flight_500s", f"filter={name}", f"particles={n}")["filter"]
        return run_filter(job.instantiate(words), model, episode.record, draws(8, 9)).mean[
            :, 20:, 6:9
        ]

    def rms(d: Tensor) -> float:
        return float(d.square().mean().sqrt())

    kf, fix = estimated("ekf"), episode.record.y[:, 20:, :3]
    few, many = (rms(estimated("cpso_escape", n) - kf) for n in (100, 400))
    assert 1.6 < few / many < 2.4
    assert rms(estimated("pso_pf", 60) - fix) < 1.0
    assert rms(kf - fix) > 4.0
    assert rms(estimated("cpso_escape_stopped") - kf) > 2.0 * few


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["sar_flight", "anshun_fit", "passive_1", "flight_300s"])
def test_swarms_fly_with_quaternions_missing_satellites_and_bearings(scenario: str) -> None:
    cfg = composed(scenario)
    if "trajectory" in cfg.scenario and "segments" in cfg.scenario.trajectory:
        cfg.scenario.trajectory.segments = cfg.scenario.trajectory.segments[:1]
    if "trajectory" in cfg.scenario and "duration_s" in cfg.scenario.trajectory:
        cfg.scenario.trajectory.duration_s = 20.0
    if "imu_rate_hz" in cfg.scenario:
        cfg.scenario.imu_rate_hz = 20.0
    model = job.instantiate(cfg.model)
    record = job.instantiate(cfg.scenario).draw(NominalNoise(), torch.arange(2), 1).record
    record = record._replace(y=record.y[:, :8], u=map_inputs(lambda a: a[:, :8], record.u))
    for name in ("cpso_escape", "cpso_escape_printed"):
        estimate = run_filter(
            job.instantiate(composed(scenario, f"filter={name}")["filter"]), model, record, draws(2)
        )
        assert not estimate.lost.any()
        assert torch.isfinite(estimate.mean).all()
