"""Moves leave the law of the whole path as it is; broken ones are seen. What particles carry of their past agrees with it."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from filter_laws import check_lost_alone, check_own
from move_cases import Always, moving
from particle_cases import CASES
from refusals import check_refused
from scipy import stats
from torch import Tensor
from torch.distributions import Distribution, Independent, Laplace

from pfbench import job
from pfbench.core import Chart, PhiloxStream, QuaternionBlock, Record
from pfbench.core.density import ChartNormal, independent_normal, normal_batch
from pfbench.core.random_stream import relabel
from pfbench.filter import (
    BootstrapProposal,
    EpanechnikovSmoothing,
    EssResampler,
    GaussianSmoothing,
    ParticleBelief,
    ParticleFilter,
    ProposalSample,
    RegularisedResampler,
    Systematic,
    run_filter,
)
from pfbench.filter.linearisation import derivative
from pfbench.filter.moves.metropolis import (
    McmcKernel,
    MetropolisHastings,
    StateHistory,
)
from pfbench.filter.moves.path_kernels import (
    LastStateKernel,
    NoiseFlowKernel,
    NoiseFlowStatKernel,
    PathBlockKernel,
    RandomWalk,
    fisher_information,
    propagate_path,
)
from pfbench.filter.moves.path_proposals import (
    PathSegment,
    PriorSegment,
    SmoothedSegment,
    driving_noise,
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
    local_level,
)
from pfbench.noise.base import NominalNoise
from pfbench.testing import (
    PathPosterior,
    check_evidence,
    check_move,
    filter_record,
    kalman_filter,
    rts_smoother,
    run_kalman_filter,
    simulate_path_posterior,
)
from pfbench.testing.moves import STEPS

FULL = StateHistory(STEPS, store_noise=True, store_density=True)
ALL = torch.ones(1, dtype=torch.bool)
WALK = linear_walk(1.0, 0.5, 1.0)
WALK_Y = torch.tensor([[0.8], [2.9], [1.2], [math.nan], [3.0], [6.5]], dtype=torch.float64)


def one(seed: int = 1, runs: int = 1) -> PhiloxStream:
    return PhiloxStream(seed, torch.arange(runs))


@dataclasses.dataclass(frozen=True)
class Steady(RandomWalk):
    """Steps of a fixed covariance, `size` in each component: what a cloud decides cannot bias it."""

    size: float = 0.5
    is_exact = True

    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, x: Tensor, draws: Any
    ) -> Tensor:
        return self.size * draws.normal("walk", x.shape[1], model.chart.dimension)


STILL = Steady(size=0.0)


# the law of the path, whole


def as_of_500(m: int) -> RandomWalk:
    """The bandwidth of 500 particles, for m."""
    return RandomWalk((m / 500) ** (1 / 6))


def swept(case: PathPosterior, kernel: McmcKernel, sweeps: int) -> tuple[np.ndarray, float]:
    """Paths after moves, and the rate of acceptance."""
    after, rate = MetropolisHastings(kernel, sweeps)(case.model, case.belief(FULL), ALL, one())
    return case.paths_after(after), float(rate)


def flown(case: PathPosterior, x: np.ndarray) -> np.ndarray:
    """The paths that lead to x [M, 2] with the noises unchanged."""
    delta, back = x - case.paths[:, -2:], np.linalg.inv(case.model.f.numpy())
    shifts = [delta @ np.linalg.matrix_power(back, STEPS - j).T for j in range(STEPS + 1)]
    return case.paths + np.concatenate(shifts, 1)


KERNELS: dict[str, Callable[[RandomWalk], McmcKernel]] = {
    "tail": LastStateKernel,
    "block, simulated": lambda walk: PathBlockKernel(3, PriorSegment(), walk),
    "block, exact": lambda walk: PathBlockKernel(3, SmoothedSegment(False), walk),
    "bridge of 3": lambda walk: PathBlockKernel(3, SmoothedSegment(), walk),
    "bridge of 7": lambda walk: PathBlockKernel(7, SmoothedSegment(), walk),
    "flow": lambda walk: NoiseFlowKernel(STEPS, walk),
}
MORE = 8000, 16  # paths and sweeps: of ten measurements the prior of a flow is one more
RATES = {  # of a prototype, at q = 1, 0.1, 0.01
    "tail": (0.68, 0.17, 0.011),
    "block, simulated": (0.055, 0.047, 0.009),
    "block, exact": (0.20, 0.050, 0.009),
    "bridge of 3": (0.82, 0.72, 0.14),
    "bridge of 7": (0.83, 0.81, 0.39),
    "flow": (0.19, 0.67, 0.82),
}


def test_the_exact_paths_pass_their_own_test() -> None:
    case = simulate_path_posterior(0.1, 4000)
    assert case.moments_p_value(case.paths) > 1e-3
    f, q, h = (
        case.model.f.numpy(),
        0.01 * np.array([[1 / 3, 1 / 2], [1 / 2, 1]]),
        case.model.h.numpy(),
    )
    smooth, _ = rts_smoother(
        f, kalman_filter(f, q, h, np.eye(1), np.zeros(2), np.diag([4.0, 1.0]), case.y.numpy())
    )
    assert np.allclose(case.mean.reshape(-1, 2)[1:], smooth)


@pytest.mark.slow
@pytest.mark.parametrize("i", range(3))
@pytest.mark.parametrize("name", KERNELS)
def test_moves_leave_the_law_of_the_whole_path(name: str, i: int) -> None:
    rarely = RATES[name][i] < 0.06
    m, sweeps = MORE if name == "flow" else (1500, 8)
    check = check_move(
        KERNELS[name](as_of_500(m)),
        (1.0, 0.1, 0.01)[i],
        m,
        sweeps,
        min_moved_share=0.04 if rarely else 0.4,
    )
    rate = check.details["accepted"]
    alike = (
        0.5 if name == "block, simulated" else 0.25
    )  # which is blind to what was seen, and depends on it
    assert rate == pytest.approx(RATES[name][i], rel=alike, abs=0.005)


@pytest.mark.parametrize(("name", "q"), [("tail", 1.0), ("bridge of 3", 0.1), ("flow", 0.1)])
def test_moves_leave_the_law_of_the_path(name: str, q: float) -> None:
    check_move(KERNELS[name](as_of_500(1000)), q, 1000, min_moved_share=0.4)


@pytest.mark.parametrize("q", [1.0, 0.1])
def test_flow_that_renews_its_noises_leaves_it_too(q: float) -> None:
    check_move(
        NoiseFlowKernel(STEPS, as_of_500(2000), noise_refresh=0.3), q, 2000, min_moved_share=0.3
    )


@pytest.mark.parametrize("walk", [RandomWalk(), RandomWalk(smoothing=EpanechnikovSmoothing())])
def test_a_cycle_of_kernels_leaves_it_too(walk: RandomWalk) -> None:
    """The bridge must tell the flow the noises of the states that it has moved."""
    case = simulate_path_posterior(0.1, 1000)
    moves = (
        MetropolisHastings(NoiseFlowKernel(STEPS, walk)),
        MetropolisHastings(PathBlockKernel(3, SmoothedSegment(), walk)),
    )
    after = case.belief(FULL)
    for i, move in enumerate(5 * moves):
        after, _ = move(case.model, after, ALL, relabel(one(), f"{i}."))
    assert case.moments_p_value(case.paths_after(after)) > 1e-4
    states, log_like = propagate_path(
        case.model, after.window["states"][:, :, 0], after.window["noise"], after.past
    )
    assert torch.allclose(states, after.window["states"], atol=1e-9)
    assert torch.allclose(log_like, after.window["log_like"], atol=1e-9)


@pytest.mark.parametrize("q", [1.0, 0.1, 0.01])
def test_flow_by_statistics_leaves_it_too(q: float) -> None:
    case, kernel = simulate_path_posterior(q, 4000), NoiseFlowStatKernel(as_of_500(4000))
    cloud = case.belief(kernel.required_history)
    after, rate = MetropolisHastings(kernel, 20)(case.model, cloud, ALL, one())
    paths = flown(case, after.x[0].numpy())
    assert float(rate) > 0.04
    assert case.moments_p_value(paths) > 1e-4
    again = case._replace(paths=paths).belief(kernel.required_history).window["score"]
    assert torch.allclose(
        after.window["score"], again, atol=1e-9
    )  # what is carried is true of the moved path


@pytest.mark.parametrize("q", [1.0, 0.1, 0.01])
def test_the_rate_of_acceptance_is_that_of_a_random_walk_in_a_normal_law(q: float) -> None:
    """E[2 Phi(-|delta|/2)], the norm being that of the precision given all that stays: no simulation of the chain."""
    case, m = simulate_path_posterior(q, 4000), 4000
    law, rng = case.root @ case.root.T, np.random.default_rng(1)
    h = 500 ** (-1 / 6)
    f, g, p0 = case.model.f.numpy(), case.model.g.numpy(), np.diag([4.0, 1.0])
    rows = [np.linalg.matrix_power(f, j)[:1] for j in range(1, STEPS + 1)]
    given = {
        "flow": np.linalg.inv(p0) + sum(r.T @ r for r in rows),
        "tail": np.linalg.inv(g @ g.T) + np.diag([1.0, 0.0]),
    }
    covariance = {"flow": law[:2, :2], "tail": law[-2:, -2:]}
    for name in given:
        delta = h * rng.normal(size=(200_000, 2)) @ np.linalg.cholesky(covariance[name]).T
        expected = (
            2
            * stats.norm.cdf(
                -0.5 * np.sqrt(np.einsum("ni,ij,nj->n", delta, given[name], delta))
            ).mean()
        )
        rate = swept(case, KERNELS[name](as_of_500(m)), 4)[1]
        assert (
            abs(rate - expected) < 4.5 * math.sqrt(expected * (1 - expected) / m) + 0.02 * expected
        )


# and broken moves do not


class Terms(NamedTuple):
    """Of each path, by formulas of its own: log p(x_0) [R, N], log p(x_j | x_j-1) and log p(y_j | x_j) [R, N, k]."""

    start: Tensor
    moved: Tensor
    seen: Tensor


def terms(model: LinearGaussian, belief: ParticleBelief) -> Terms:
    x = belief.window["states"]
    y = torch.stack([record.y for record in belief.past[1:]], 1)[:, None]
    start = torch.distributions.MultivariateNormal(model.m0, scale_tril=model.l0).log_prob(
        x[:, :, 0]
    )
    w = torch.linalg.solve(model.g, (x[:, :, 1:] - x[:, :, :-1] @ model.f.mT).mT).mT
    return Terms(
        start,
        -0.5 * w.square().sum(-1),
        -0.5 * ((y - x[:, :, 1:] @ model.h.mT) / model.r).square().sum(-1),
    )


def no_transition(old: Terms, new: Terms) -> Tensor:
    return -(new.moved - old.moved).sum(-1)


def no_likelihood(old: Terms, new: Terms) -> Tensor:
    return -(new.seen - old.seen).sum(-1)


@dataclasses.dataclass(frozen=True)
class Broken(McmcKernel):
    """A kernel whose log ratio lacks something."""

    kernel: McmcKernel
    lacks: Callable[[Terms, Terms], Tensor]
    is_exact = False

    @property
    def required_history(self) -> Any:
        return self.kernel.required_history

    def propose(
        self, model: Any, belief: ParticleBelief, draws: Any
    ) -> tuple[ParticleBelief, Tensor]:
        proposed, log_alpha = self.kernel.propose(model, belief, draws)
        return proposed, log_alpha + self.lacks(terms(model, belief), terms(model, proposed))


@dataclasses.dataclass(frozen=True)
class OldParent(McmcKernel):
    """The child is weighed with the parent that it had before the block was drawn anew."""

    walk: RandomWalk
    is_exact = False
    required_history = StateHistory(4, store_density=True)

    def propose(
        self, model: Any, belief: ParticleBelief, draws: Any
    ) -> tuple[ParticleBelief, Tensor]:
        proposed, log_alpha = PathBlockKernel(3, SmoothedSegment(False), self.walk).propose(
            model, belief, draws
        )
        parent = belief.window["states"][:, :, -2]
        right, wrong = (
            model.transition(p, ()).log_prob(proposed.x)
            for p in (proposed.window["states"][:, :, -2], parent)
        )
        return proposed, log_alpha - right + wrong


@dataclasses.dataclass(frozen=True)
class NoRatio(McmcKernel):
    """Smoothed without its ratio."""

    child: bool
    is_exact = False

    def __call__(
        self, model: Any, old: PathSegment, child: Tensor, draws: Any
    ) -> tuple[Tensor, Tensor | None]:
        block, ratio = SmoothedSegment(self.child)(model, old, child, draws)
        assert ratio is not None
        return block, torch.zeros_like(ratio)


@dataclasses.dataclass(frozen=True)
class Drifting(NoiseFlowKernel):
    """Renews the noises by w + c e, which widens them."""

    def _refresh_noise(self, model: StateSpaceModel, w: Tensor, draws: Any) -> Tensor:
        return w + 0.3 * draws.normal("refresh", w.shape[1], w[0, 0].numel()).unflatten(
            2, w.shape[2:]
        )


@dataclasses.dataclass(frozen=True)
class Pulled(RandomWalk):
    """A walk that is not symmetric: it shrinks towards the mean."""

    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, x: Tensor, draws: Any
    ) -> Tensor:
        return super().__call__(model, belief, x, draws) - 0.1 * (x - x.mean(1, keepdim=True))


BROKEN: dict[str, tuple[float, Callable[[RandomWalk], Any]]] = {
    "tail without the transition ratio": (1.0, lambda w: Broken(LastStateKernel(w), no_transition)),
    "tail without the likelihood": (1.0, lambda w: Broken(LastStateKernel(w), no_likelihood)),
    "tail always accepted": (1.0, lambda w: Always(LastStateKernel(w))),
    "likelihood alone": (0.1, lambda w: Broken(LastStateKernel(w), no_transition)),
    "simulated block without its likelihood": (
        1.0, lambda w: Broken(PathBlockKernel(3, PriorSegment(), w), lambda a, b: -(b.seen - a.seen)[..., :-1].sum(-1))
    ),
    "old parent": (1.0, OldParent),
    "bridge without the ratio of g": (1.0, lambda w: PathBlockKernel(3, NoRatio(True), w)),
    "block without the ratio of g": (1.0, lambda w: PathBlockKernel(3, NoRatio(False), w)),
    "flow without the prior": (1.0, lambda w: Broken(NoiseFlowKernel(STEPS, w), lambda a, b: a.start - b.start)),
    "flow without the likelihood": (0.1, lambda w: Broken(NoiseFlowKernel(STEPS, w), no_likelihood)),
    "flow without the first likelihood": (0.1, lambda w: Broken(NoiseFlowKernel(STEPS, w), lambda a, b: (a.seen - b.seen)[..., 0])),
    "noises renewed without shrinking": (0.1, lambda w: Drifting(STEPS, w, 0.3)),
    "a walk with a pull": (0.1, lambda w: NoiseFlowKernel(STEPS, Pulled(w.scale))),
}  # fmt: skip


@pytest.mark.parametrize("mistake", BROKEN)
def test_the_test_of_invariance_sees_mistakes(mistake: str) -> None:
    q, make = BROKEN[mistake]
    m, sweeps = MORE if "prior" in mistake else (1500, 8)
    with pytest.raises(AssertionError, match="p = "):
        check_move(make(as_of_500(m)), q, m, sweeps)


@pytest.mark.parametrize("name", KERNELS)
def test_ratios_are_what_the_formulas_say(name: str) -> None:
    """Those of the child alone for the exact block, of the whole path for the flow."""
    case = simulate_path_posterior(0.3, 200)
    proposed, log_alpha = KERNELS[name](RandomWalk()).propose(case.model, case.belief(FULL), one())
    old, new = terms(case.model, case.belief(FULL)), terms(case.model, proposed)
    child = (new.moved + new.seen - old.moved - old.seen)[..., -1]
    block = (new.seen - old.seen)[..., -4:-1].sum(-1)
    whole = sum((b - a).sum(-1) if b.dim() == 3 else b - a for a, b in zip(old, new, strict=True))
    expected = {
        "tail": child,
        "block, exact": child,
        "block, simulated": child + block,
        "flow": whole,
    }
    if name in expected:
        assert torch.allclose(log_alpha, expected[name], rtol=1e-7, atol=1e-7)
    assert torch.equal(proposed.x, proposed.window["states"][:, :, -1])


# nonlinear models: successive-conditional simulation


def geweke(
    model: StateSpaceModel,
    kernel: McmcKernel,
    inputs: Any,
    chains: int,
    rounds: int,
    steps: int = 5,
) -> float:
    """Chains that alternate y ~ p(y | x) and a move of x must keep x in its prior law [Geweke 2004]; a p-value.

    A run is a chain: its first particle decides the measurements, the second is there since a cloud has two.
    """
    cloud = ParticleFilter(2).init(model, chains, one(3, chains))
    law: Any = model.initial(chains)
    keeper = kernel.required_history
    cloud = keeper.start(
        model, cloud, model.origin.expand(chains, -1), torch.diag_embed(law.variance)
    )
    w = (
        one(4, chains)
        .normal("w", 2, steps * model.noise_dim)
        .unflatten(2, (steps, model.noise_dim))
    )
    for j in range(steps):
        x = model.propagate(cloud.x, inputs(j), w[:, :, j])
        y = model.observation(x, inputs(j)).mean[:, 0]
        cloud = keeper.append(model, cloud, cloud._replace(x=x), w[:, :, j], Record(y, inputs(j)))
    for turn in range(rounds):
        draws, records = one(5, chains).at_step(turn), [cloud.past[0]]
        for j, seen in enumerate(cloud.past[1:]):
            sight: Any = model.observation(cloud.window["states"][:, :1, j + 1], seen.u)
            noise = sight.stddev[:, 0] * draws.normal(f"y_{j}", 1, seen.y.shape[1])[:, 0]
            records.append(Record(sight.mean[:, 0] + noise, seen.u))
        states, log_like = propagate_path(
            model, cloud.window["states"][:, :, 0], cloud.window["noise"], tuple(records)
        )
        window = cloud.window | {"states": states, "log_like": log_like}
        cloud, rate = MetropolisHastings(kernel, 3)(
            model,
            cloud._replace(window=window, past=tuple(records)),
            torch.ones(chains, dtype=torch.bool),
            draws,
        )
    assert 0.1 < float(rate.mean()) < 0.95
    xi = model.chart.subtract(cloud.window["states"][:, 0, 0], model.origin) / law.stddev
    z = torch.cat([xi, cloud.window["noise"][:, 0].flatten(1)], 1).numpy()
    m, d = z.shape
    mean, covariance = z.mean(0), np.cov(z.T, ddof=0)
    statistic = (
        m * (mean**2).sum()
        + m / 2 * ((np.diag(covariance) - 1) ** 2).sum()
        + m * (np.triu(covariance, 1) ** 2).sum()
    )
    return float(stats.chi2(2 * d + d * (d - 1) / 2).sf(statistic))


@dataclasses.dataclass(frozen=True)
class PriorSized(RandomWalk):
    """Steps of a size in proportion to the prior's."""

    is_exact = True

    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, x: Tensor, draws: Any
    ) -> Tensor:
        law: Any = model.initial(1)
        return self.scale * law.stddev * draws.normal("walk", x.shape[1], model.chart.dimension)


@dataclasses.dataclass(frozen=True)
class Whole(NoiseFlowKernel):
    """Computes the path of every proposal, also of a linear model."""

    def shorten(self, model: StateSpaceModel, belief: ParticleBelief) -> ParticleBelief:
        return belief


class Unprincipled(Whole):
    """Flow without the ratio of the priors."""

    def propose(
        self, model: StateSpaceModel, belief: ParticleBelief, draws: Any
    ) -> tuple[ParticleBelief, Tensor]:
        proposed, _ = super().propose(model, belief, draws)
        return proposed, (proposed.window["log_like"] - belief.window["log_like"]).sum(-1)


@pytest.mark.parametrize("refresh", [0.0, 0.4])
def test_flow_keeps_the_prior_of_a_pendulum(refresh: float) -> None:
    model = Pendulum(0.3, 1.0, 0.3, (1.0, 1.0))
    assert geweke(model, NoiseFlowKernel(5, PriorSized(0.7), refresh), lambda j: (), 600, 15) > 1e-4
    assert geweke(model, Unprincipled(5, PriorSized(0.7), refresh), lambda j: (), 600, 15) < 1e-4


class Rotating(StateSpaceModel):
    """A model whose states are rotations."""

    @property
    def chart(self) -> Chart:
        return Chart((QuaternionBlock(),))

    @property
    def origin(self) -> Tensor:
        return torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)


def test_flow_steps_in_the_coordinates_in_which_its_start_is_normal() -> None:
    """Attitudes of a radian: steps about each start instead would need the volume element of the chart."""

    class Turned(Rotating, LinearGaussian):
        def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
            return self.chart.add(x, 0.3 * w)

        def log_likelihood(self, y: Tensor, x: Tensor, u: Any) -> Tensor:
            return torch.zeros_like(x[..., 0])

    model = Turned(np.eye(3), 0.3 * np.eye(3), np.eye(3), np.ones(3), np.zeros(3), np.ones(3))
    kernel, draws = NoiseFlowKernel(2, Steady()), one()
    cloud = kernel.required_history.start(
        model,
        ParticleFilter(50).init(model, 1, draws),
        model.origin[None],
        torch.eye(3).double()[None],
    )
    proposed, log_alpha = kernel.propose(model, cloud, draws)
    before, after = (
        model.chart.subtract(c.window["states"][:, :, 0], model.origin) for c in (cloud, proposed)
    )
    step = Steady()(model, cloud, cloud.x, draws)
    inside = (before + step).norm(
        dim=-1
    ) < math.pi  # beyond half a turn the same attitude has another vector
    assert torch.allclose(after[inside], (before + step)[inside], atol=1e-9)
    assert torch.allclose(
        log_alpha, 0.5 * (before.square() - (before + step).square()).sum(-1), atol=1e-9
    )
    assert before.norm(dim=-1).mean() > 1.0


def compose_flight(word: str) -> Any:
    """Six seconds of SINS/SAR."""
    words = ["scenario=sar_flight", "episode_cache_dir=null", "scenario.trajectory.duration_s=6"]
    return compose_tree([*words, word])


@pytest.mark.slow
@pytest.mark.parametrize("larger", [1.0, 50.0])
def test_flow_keeps_the_prior_of_an_inertial_navigation(larger: float) -> None:
    """With quaternions, misalignments as printed and of a degree."""
    cfg = compose_flight("scenario.imu_rate_hz=20")
    cfg.scenario.initial_errors.attitude_arcmin = [larger * 1.2, larger * 1.2, larger * 1.5]
    episode, model = (
        job.instantiate(cfg.scenario).draw(NominalNoise(), torch.arange(1), 1),
        job.instantiate(cfg.model),
    )
    record = model.prepare(episode.record)
    walk = PriorSized(0.4 if larger == 1.0 else 0.1)  # a degree is many times the heading's error
    assert geweke(model, NoiseFlowKernel(3, walk), lambda j: record.at_step(j).u, 300, 8, 3) > 1e-4
    if larger == 1.0:  # the others' steps are too short to drift far
        assert geweke(model, Unprincipled(3, walk), lambda j: record.at_step(j).u, 300, 8, 3) < 1e-4


class Spin(Rotating):
    """A rotation that turns by 0.7 rad in each step; its measurements have no likelihood where they are missing."""

    names, units, groups = ("x", "y", "z"), ("rad",) * 3, {"attitude": (0, 1, 2)}
    noise_dim = 3

    def __init__(self, sd: float = 0.7) -> None:
        super().__init__()
        self.sd = sd
        self.register_buffer("axes", torch.eye(3, dtype=torch.float64))

    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, torch.full((3,), 0.3, dtype=torch.float64))

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return self.chart.add(x, self.sd * w)

    def transition(self, x: Tensor, u: Any) -> Distribution:
        return ChartNormal(self.chart, x, (self.sd * self.axes).expand(*x.shape[:2], 3, 3))

    def observation(self, x: Tensor, u: Any) -> Distribution:
        return independent_normal(x[..., :1], torch.ones(1, dtype=x.dtype))


@pytest.mark.parametrize("shares", [False, True])
@pytest.mark.parametrize("endpoint", [False, True])
def test_segments_of_rotations_have_the_density_of_the_path(endpoint: bool, shares: bool) -> None:
    """Without measurements one drawn state is exact: the ratio is that of the child given the fixed state.

    Given the child, the block has p(block) p(child | block) / p(child) of a normal chain, which rotations are to second
    order. So its acceptance is compared for small turns alone.
    """
    model, n = Spin(0.02 if endpoint else 0.7), 400
    kernel = PathBlockKernel(1, SmoothedSegment(endpoint, shares), Steady(size=model.sd))
    missing = Record(torch.full((1, 1), math.nan, dtype=torch.float64), ())
    cloud = ParticleFilter(n).init(model, 1, one())
    cloud = kernel.required_history.start(model, cloud, model.origin[None], torch.eye(3)[None])
    for j in range(2):
        w = one(2 + j).normal("w", n, 3)
        moved_cloud = cloud._replace(x=model.propagate(cloud.x, (), w))
        cloud = kernel.required_history.append(model, cloud, moved_cloud, w, missing)
    proposed, log_alpha = kernel.propose(model, cloud, one(9))
    old, new = (c.window["states"][0] for c in (cloud, proposed))
    if endpoint:
        variance = 2.0 * model.sd**2
        lengths = [model.chart.subtract(x[:, 2], x[:, 0]).square().sum(-1) for x in (old, new)]
        expected = (lengths[0] - lengths[1]) / (2.0 * variance)
        assert torch.allclose(log_alpha[0], expected, atol=0.02)
        return
    inside = [model.chart.subtract(x[:, 1], x[:, 0]).norm(dim=-1) for x in (old, new)]
    children = [model.transition(x[None, :, 1], ()).log_prob(x[None, :, 2])[0] for x in (old, new)]
    near = (inside[0] < 2.5) & (inside[1] < 2.5)  # beyond half a turn a drawn vector is another one
    assert torch.allclose(log_alpha[0][near], (children[1] - children[0])[near], atol=1e-9)
    turned = [model.chart.log_volume(model.chart.subtract(x[:, 1], x[:, 0])) for x in (old, new)]
    assert (turned[0] - turned[1])[near].abs().max() > 0.1  # what a flat density would lack


def test_an_inertial_model_with_noise_in_all_states_has_its_density() -> None:
    """log p(x'|x) of SINS/SAR is that of the noise that led there, less the volume of its quaternion."""
    cfg = compose_flight("reading/paper_000=noise_10")
    model = job.instantiate(cfg.model)
    episode = job.instantiate(cfg.scenario).draw(NominalNoise(), torch.arange(2), 1)
    record = model.prepare(episode.record).at_step(2)
    x = ParticleFilter(50).init(model, 2, one(1, 2)).x
    w = one(2, 2).normal("w", 50, model.noise_dim)
    after = model.propagate(x, record.u, w)
    root = model.noise_gain(record.u)
    step = (root.unsqueeze(1) @ w.unsqueeze(-1)).squeeze(-1)
    expected = (
        stats.norm.logpdf(w.numpy()).sum(-1)
        - np.linalg.slogdet(root.numpy())[1][:, None]
        - model.chart.log_volume(step).numpy()
    )
    found = model.transition(x, record.u).log_prob(after)
    np.testing.assert_allclose(found, expected, atol=1e-4)
    rate = moving(MetropolisHastings(PathBlockKernel(3, SmoothedSegment(), RandomWalk(0.5))), n=100)
    estimate = run_filter(rate, model, model.prepare(episode.record), one(3, 2))
    assert not bool(estimate.lost.any())
    assert float(estimate.trace["accepted_0"][:, 1:].mean()) > 0.02


# whole filters


EXACT: dict[str, McmcKernel] = {
    "tail": LastStateKernel(Steady()),
    "block": PathBlockKernel(2, SmoothedSegment(False), Steady()),
    "simulated block": PathBlockKernel(2, PriorSegment(), Steady()),
    "bridge": PathBlockKernel(3, SmoothedSegment(), Steady()),
    "flow from the start": NoiseFlowKernel(6, Steady()),
    "flow with new noises": NoiseFlowKernel(6, Steady(), 0.5),
}


@pytest.mark.parametrize("name", EXACT)
def test_filters_with_moves_are_unbiased(name: str) -> None:
    check_evidence(moving(MetropolisHastings(EXACT[name]), n=25), WALK, WALK_Y, runs=1000)


@pytest.mark.parametrize("name", ["growth", "volatility"])
def test_segments_with_shared_slopes_are_unbiased_on_nonlinear_models(name: str) -> None:
    """The slopes of the mean of the fixed states are a poor fit there, and the ratio must make up for it."""
    model, y, exact = CASES[name]()
    segment = SmoothedSegment(shares_slopes=True)
    move = MetropolisHastings(PathBlockKernel(2, segment, Steady()))
    check_evidence(moving(move, n=25), model, y, exact, runs=1000)


def test_so_they_are_where_the_start_is_measured() -> None:
    model = local_level(1.0, 1.5, 3.0, 2.0, observes_initial=True)
    y = torch.tensor([[4.0], [1.0], [2.5], [math.nan], [5.0]], dtype=torch.float64)
    for kernel in (
        LastStateKernel(Steady(size=1.0)),
        PathBlockKernel(2, SmoothedSegment(), Steady(size=1.0)),
        NoiseFlowKernel(6, Steady(size=1.0)),
    ):
        check_evidence(moving(MetropolisHastings(kernel), n=20), model, y, runs=1000)


@pytest.mark.parametrize(
    "kernel",
    [Unprincipled(6, Steady()), Always(LastStateKernel(Steady()))],
    ids=["no prior", "always"],
)
def test_the_test_of_bias_sees_mistakes(kernel: McmcKernel) -> None:
    with pytest.raises(AssertionError, match=r"\+-"):
        check_evidence(moving(MetropolisHastings(kernel), n=25), WALK, WALK_Y, runs=1000)


def test_every_stage_says_whether_it_is_exact() -> None:
    kernels = {
        "tail": LastStateKernel(),
        "block": PathBlockKernel(3, SmoothedSegment(False)),
        "bridge": PathBlockKernel(3, SmoothedSegment()),
        "sim": PathBlockKernel(3, PriorSegment()),
    }
    assert all(moving(MetropolisHastings(kernel)).is_exact for kernel in kernels.values())
    for kernel in (NoiseFlowKernel(), NoiseFlowStatKernel()):
        assert not moving(MetropolisHastings(kernel)).is_exact
        assert moving(MetropolisHastings(kernel, 0)).is_exact


def spread_ratio(
    method: ParticleFilter, q: float, runs: int, steps: int = 30
) -> tuple[float, float]:
    """Variance of the position over Kalman's, mean over steps and runs, and the error of that mean; a world for each run."""
    model, rng = linear_walk(1.0, q, 1.0), np.random.default_rng(5)
    x, y = rng.normal(size=(runs, 2)) @ model.l0.numpy().T, []
    for _ in range(steps):
        x = x @ model.f.numpy().T + rng.normal(size=(runs, 2)) @ model.g.numpy().T
        y.append(x[:, :1] + rng.normal(size=(runs, 1)))
    estimate = filter_record(method, model, torch.tensor(np.stack(y, 1)))
    exact = run_kalman_filter(model, torch.tensor(y[0][:1]).expand(steps, -1)).covariance[:, 0, 0]
    ratio = (estimate.variance[..., 0].numpy() / exact)[:, 5:].mean(1)
    return float(ratio.mean()), float(ratio.std() / math.sqrt(runs))


@pytest.mark.slow
@pytest.mark.parametrize("q", [1.0, 0.1])
def test_moves_do_not_widen_the_cloud_and_regularisation_does(q: float) -> None:
    """Kalman's spread within 4 percent; regularisation multiplies it by 1 + h^2 each time, h^2 = 0.17, and so does a Riccati."""
    for kernel in (
        LastStateKernel(),
        PathBlockKernel(3, SmoothedSegment()),
        NoiseFlowKernel(30),
    ):
        ratio, error = spread_ratio(moving(MetropolisHastings(kernel), n=200), q, 20)
        assert 0.96 - 3 * error < ratio < 1.01 + 3 * error, kernel
    ratio, error = spread_ratio(
        ParticleFilter(200, RegularisedResampler(EssResampler(Systematic(), 1.0))), q, 20
    )
    f, spread, look = (
        np.array([[1.0, 1.0], [0.0, 1.0]]),
        q**2 * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]]),
        np.array([[1.0, 0.0]]),
    )
    p = {1.0 + 200 ** (-1 / 3): np.diag([4.0, 1.0]), 1.0: np.diag([4.0, 1.0])}
    seen: dict[float, list[float]] = {wider: [] for wider in p}
    for _ in range(30):
        for wider in p:
            before = wider * f @ p[wider] @ f.T + spread
            p[wider] = before - before @ look.T @ look @ before / (before[0, 0] + 1.0)
            seen[wider].append(p[wider][0, 0])
    wide, exact = (np.array(values) for values in seen.values())
    assert ratio == pytest.approx((wide / exact)[5:].mean(), abs=4 * error + 0.04)
    assert ratio > 1.0 + 3 * error


# no move is no move


def test_no_sweeps_are_the_plain_filter_bit_for_bit() -> None:
    plain = filter_record(moving(), WALK, WALK_Y, runs=5)
    for kernel in (LastStateKernel(), NoiseFlowKernel(3), NoiseFlowStatKernel()):
        same = filter_record(moving(MetropolisHastings(kernel, 0)), WALK, WALK_Y, runs=5)
        assert torch.equal(plain.mean, same.mean)
        assert torch.equal(plain.log_evidence, same.log_evidence)
    cloud = moving(MetropolisHastings(NoiseFlowKernel(3), 0)).init(WALK, 2, one(runs=2))
    assert cloud.window == {}  # nor does it carry anything


@pytest.mark.parametrize(
    "kernel",
    [NoiseFlowKernel(4, STILL), NoiseFlowKernel(9, STILL), NoiseFlowStatKernel(STILL)],
    ids=["lag", "start", "statistics"],
)
@pytest.mark.parametrize(
    "model", [WALK, UnivariateGrowth(), Pendulum(), Lorenz63()], ids=lambda m: type(m).__name__
)
def test_a_step_of_nothing_is_always_accepted_and_changes_nothing(
    model: StateSpaceModel, kernel: McmcKernel
) -> None:
    y = measurements(model, 3, 8)
    plain, still = (
        filter_record(moving(), model, y),
        filter_record(moving(MetropolisHastings(kernel, 2)), model, y),
    )
    assert torch.allclose(plain.mean, still.mean, rtol=1e-7, atol=1e-9)
    assert torch.all(still.trace["accepted_0"][:, 1:] > 0.99)  # up to rounding


@dataclasses.dataclass(frozen=True)
class Same(McmcKernel):
    """Draws the same block again."""

    is_exact = True

    def __call__(
        self, model: Any, old: PathSegment, child: Tensor, draws: Any
    ) -> tuple[Tensor, Tensor | None]:
        return old.states[:, :, 1:-1], torch.zeros_like(child[..., 0])


def test_the_ratio_of_a_path_to_itself_is_one() -> None:
    case = simulate_path_posterior(0.1, 100)
    for kernel in (
        LastStateKernel(STILL),
        PathBlockKernel(3, Same(), STILL),
        NoiseFlowKernel(STEPS, STILL),
    ):
        proposed, log_alpha = kernel.propose(case.model, case.belief(FULL), one())
        assert torch.allclose(log_alpha, torch.zeros_like(log_alpha), atol=1e-10)
        assert torch.allclose(
            proposed.window["states"], case.belief(FULL).window["states"], atol=1e-12
        )


def test_same_seed_same_numbers_and_sweeps_draw_their_own() -> None:
    method = moving(
        MetropolisHastings(NoiseFlowKernel(3), 2), MetropolisHastings(NoiseFlowKernel(3), 2)
    )
    first, second, other = (filter_record(method, WALK, WALK_Y, seed, runs=3) for seed in (1, 1, 2))
    assert torch.equal(first.mean, second.mean)
    assert not torch.equal(first.mean, other.mean)
    asked: list[str] = []

    class Listening(PhiloxStream):
        def normal(self, purpose: str, n: int, w: int) -> Tensor:
            asked.append(purpose)
            return super().normal(purpose, n, w)

    run_filter(method, WALK, Record(WALK_Y[None, :1]), Listening(1, torch.arange(1)))
    assert (
        len(asked) == len(set(asked)) == 2 + 4
    )  # initial, noise, and a walk for each sweep of each move


# what is carried


def measurements(model: StateSpaceModel, runs: int, steps: int) -> Tensor:
    """Of the model's own world."""
    x, rows = model.initial(runs).sample(), []
    for t in range(steps):
        draws = one(8, runs).at_step(t)
        u = model.prepare(Record(torch.zeros(1, t + 1, 1, dtype=torch.float64))).at_step(t).u
        x = model.propagate(x.unsqueeze(1), u, draws.normal("w", 1, model.noise_dim))
        law: Any = model.observation(x, u)
        y = law.mean + law.stddev * draws.normal("y", 1, law.mean.shape[-1])
        x = x[:, 0]
        rows.append(y[:, 0])
    return torch.stack(rows, 1)


MODELS = [WALK, UnivariateGrowth(), StochasticVolatility(), Benes(), Pendulum(), Lorenz63()]
every_model = pytest.mark.parametrize("model", MODELS, ids=lambda m: type(m).__name__)
MIXED = 2 * (
    MetropolisHastings(NoiseFlowKernel(4)),
    MetropolisHastings(PathBlockKernel(2, SmoothedSegment())),
    MetropolisHastings(LastStateKernel()),
)


def history(method: ParticleFilter, model: StateSpaceModel, y: Tensor) -> list[ParticleBelief]:
    record, draws = model.prepare(Record(y)), one(1, y.shape[0])
    cloud, clouds = method.init(model, y.shape[0], draws), []
    for t in range(y.shape[1]):
        cloud, _ = method.step(model, cloud, record.at_step(t), draws.at_step(t + 1))
        clouds.append(cloud)
    return clouds


@every_model
def test_what_is_carried_agrees_with_itself(model: StateSpaceModel) -> None:
    """The noises lead from the first state to all others, and the likelihoods are theirs: after moves, copies and sliding."""
    dense = isinstance(model, LinearGaussian | UnivariateGrowth | StochasticVolatility | Lorenz63)
    method = moving(
        *(MIXED if dense else [MetropolisHastings(NoiseFlowKernel(4), 3)]), threshold=0.9
    )
    for t, cloud in enumerate(history(method, model, measurements(model, 3, 9))):
        window, k = cloud.window, min(t + 1, 4)
        assert len(cloud.past) == k + 1
        assert window["states"].shape[:3] == window["log_like"].shape == (3, 40, k + 1)
        assert window["noise"].shape[:3] == (3, 40, k)
        assert window["mean"].shape[:3] == window["covariance"].shape[:3] == (3, 1, k + 1)
        assert torch.equal(window["states"][:, :, -1], cloud.x)
        states, log_like = propagate_path(
            model, window["states"][:, :, 0], window["noise"], cloud.past
        )
        off = model.chart.subtract(states, window["states"])
        assert float(off.abs().max()) < 1e-6 * (1 + float(states.abs().max()))
        assert torch.allclose(log_like, window["log_like"], rtol=1e-4, atol=1e-4)
        assert torch.all(window["log_like"][:, :, 0] == 0)
        assert bool(torch.isnan(cloud.past[0].y).all())


TURNING = LinearGaussian(
    [[0.9, 0.3, 0.0], [-0.3, 0.9, 0.1], [0.0, 0.0, 0.95]], [[0.3, 0.0], [0.1, 0.2], [0.0, 0.4]],
    [[1.0, 0.0, 0.5], [0.0, 1.0, 0.0]], [0.7, 0.4], [0.0, 1.0, 0.0], [1.0, 2.0, 0.5],
)  # fmt: skip


def test_a_quadratic_likelihood_moves_as_whole_paths_do() -> None:
    """With missing measurements, a sliding window and runs that are not resampled."""
    y = measurements(TURNING, 5, 9)
    y[0, 2:5, 0], y[3, 4], y[1, 6, 1] = torch.nan, torch.nan, torch.nan
    clouds = [
        history(moving(MetropolisHastings(kernel(4), 3), n=60, threshold=0.8), TURNING, y)
        for kernel in (Whole, NoiseFlowKernel)
    ]
    for whole, short in zip(*clouds, strict=True):
        assert whole.window.keys() == short.window.keys()
        for name, a in whole.window.items():
            assert torch.allclose(a, short.window[name], rtol=1e-9, atol=1e-9), name
        assert torch.equal(short.window["states"][:, :, -1], short.x)
    still = history(moving(n=60, threshold=0.8), TURNING, y)[-1]
    assert not torch.allclose(still.x, clouds[1][-1].x)


def test_the_past_is_what_happened() -> None:
    """Without refreshing, states and moments are those of the earlier beliefs."""
    y = measurements(WALK, 2, 7)
    clouds = history(moving(MetropolisHastings(NoiseFlowKernel(3)), threshold=0.0), WALK, y)
    last = clouds[-1]
    for j in range(4):
        assert torch.equal(last.window["states"][:, :, j], clouds[3 + j].x)
        w = clouds[3 + j].log_w.exp()
        mean = (w.unsqueeze(-1) * clouds[3 + j].x).sum(1)
        assert torch.allclose(last.window["mean"][:, 0, j], mean)
        d = clouds[3 + j].x - mean.unsqueeze(1)
        assert torch.allclose(last.window["covariance"][:, 0, j], (w.unsqueeze(-1) * d).mT @ d)
        if j:
            assert torch.equal(last.past[j].y, y[:, 3 + j])
    first = clouds[0].window
    assert torch.equal(first["mean"][:, 0, 0], WALK.m0.expand(2, -1))
    assert torch.equal(first["covariance"][:, 0, 0], (WALK.l0 @ WALK.l0.mT).expand(2, -1, -1))


def test_copies_bring_the_past_of_their_ancestors() -> None:
    method = moving(MetropolisHastings(NoiseFlowKernel(3, STILL)), n=30)
    before = history(method, WALK, measurements(WALK, 3, 6))[-1]
    numbers = torch.arange(30, dtype=torch.float64).expand(3, -1)
    own = {k: v for k, v in before.window.items() if v.shape[1] > 1}
    tagged = {
        k: torch.zeros_like(v) + numbers.reshape(3, 30, *[1] * (v.dim() - 2))
        for k, v in own.items()
    }
    fresh, _ = method.resampler(
        WALK,
        before._replace(x=tagged["states"][:, :, -1], window=tagged),
        before.log_w,
        method.particle_count(before),
        one(runs=3),
    )
    for value in fresh.window.values():
        assert torch.equal(
            value,
            torch.zeros_like(value) + fresh.x[..., 0].reshape(3, 30, *[1] * (value.dim() - 2)),
        )
    assert len(torch.unique(fresh.x[0, :, 0])) < 30


def test_runs_that_are_not_hit_stay_as_they_are() -> None:
    clouds = history(
        moving(MetropolisHastings(NoiseFlowKernel(3)), threshold=0.0),
        WALK,
        measurements(WALK, 4, 5),
    )
    for move in (
        MetropolisHastings(NoiseFlowKernel(3), 3),
        MetropolisHastings(PathBlockKernel(2, SmoothedSegment()), 3),
    ):
        hit = torch.tensor([True, False, True, False])
        after, rate = move(WALK, clouds[-1], hit, one(runs=4))
        every, _ = move(WALK, clouds[-1], torch.ones(4, dtype=torch.bool), one(runs=4))
        pairs = [(clouds[-1].x, after.x, every.x)]
        pairs += [
            (clouds[-1].window[k], after.window[k], every.window[k])
            for k in after.window
            if after.window[k].shape[1] > 1
        ]
        for old, new, all_moved in pairs:
            assert torch.equal(new[[1, 3]], old[[1, 3]])
            assert torch.allclose(new[[0, 2]], all_moved[[0, 2]], rtol=1e-12, atol=1e-12)
        assert not torch.equal(after.x[[0, 2]], clouds[-1].x[[0, 2]])
        assert torch.all((rate > 0) == hit)
        still, none = move(WALK, clouds[-1], torch.zeros(4, dtype=torch.bool), one(runs=4))
        assert torch.equal(still.x, clouds[-1].x)
        assert torch.all(none == 0)


@pytest.mark.parametrize(
    "kernel",
    [
        NoiseFlowKernel(3),
        NoiseFlowStatKernel(),
        LastStateKernel(),
        PathBlockKernel(2, SmoothedSegment()),
    ],
    ids=lambda k: type(k).__name__,
)
def test_a_moving_run_cannot_feel_its_neighbours(kernel: McmcKernel) -> None:
    method, y = moving(MetropolisHastings(kernel, 2), threshold=0.7), measurements(WALK, 4, 7)
    check_own(method, WALK, y)
    check_lost_alone(method, WALK, y)


# sufficient statistics


@every_model
def test_statistics_say_how_the_path_s_density_bends(model: StateSpaceModel) -> None:
    """b.delta - delta' Lambda delta / 2 against the paths themselves: exactly where the model is linear, else to first order."""
    if isinstance(model, Benes):
        pytest.skip("its start is known to 1e-9: nothing of the first order is left to compare")
    y, small = measurements(model, 2, 4), 1e-5
    paths = history(moving(MetropolisHastings(NoiseFlowKernel(9)), threshold=0.0), model, y)[-1]
    told = history(moving(MetropolisHastings(NoiseFlowStatKernel()), threshold=0.0), model, y)[-1]
    assert torch.equal(paths.x, told.x)
    first = paths.window["states"][:, :, 0]
    shift = (1.0 if isinstance(model, LinearGaussian) else small) * one(9, 2).normal(
        "shift", 40, model.chart.dimension
    )
    moved = model.chart.add(first, shift)
    states, log_like = propagate_path(model, moved, paths.window["noise"], paths.past)
    law: Any = model.initial(2)
    prior = [
        law.log_prob(model.chart.subtract(x, model.origin).transpose(0, 1)).T
        for x in (first, moved)
    ]
    truth = prior[1] - prior[0] + (log_like - paths.window["log_like"]).sum(-1)
    delta = model.chart.subtract(states[:, :, -1], told.x)
    b, information = told.window["score"], told.window["information"][:, 0]
    said = (delta * (b - 0.5 * delta @ information)).sum(-1)
    if isinstance(model, LinearGaussian):
        assert torch.allclose(said, truth, rtol=1e-9, atol=1e-9)
    elif isinstance(model, StochasticVolatility):  # linear dynamics: the first order is exact
        assert torch.allclose(said, truth, rtol=1e-3, atol=1e-8)


def test_information_of_a_spread_and_of_what_is_missing() -> None:
    x, seen = (
        torch.zeros(2, 1, 1, dtype=torch.float64),
        Record(torch.tensor([[0.7], [math.nan]], dtype=torch.float64)),
    )
    for model, expected in ((StochasticVolatility(), 0.5), (local_level(1.0, 2.0, 0.0, 1.0), 0.25)):
        assert fisher_information(model, x, seen).flatten().tolist() == pytest.approx(
            [expected, 0.0]
        )


def test_slopes_are_finite_differences() -> None:
    model, x = Lorenz63(), 5.0 + one(2, 2).normal("x", 3, 3)
    w = torch.zeros(2, 3, 3, dtype=torch.float64)
    found = derivative(lambda at, xi: model.propagate(at + xi, (), torch.zeros_like(at)), x, 3)
    for i in range(3):
        e = 1e-6 * torch.eye(3, dtype=torch.float64)[i]
        difference = (model.propagate(x + e, (), w) - model.propagate(x - e, (), w)) / 2e-6
        assert torch.allclose(found[..., i], difference, atol=1e-7)


def test_noises_are_known_from_states() -> None:
    model, w = Lorenz63(), one(2, 2).normal("w", 5, 6).unflatten(2, (2, 3))
    x = one(3, 2).normal("x", 5, 3)
    past = tuple(Record(torch.zeros(2, 3, dtype=torch.float64)) for _ in range(3))
    states, _ = propagate_path(model, x, w, past)
    assert torch.allclose(driving_noise(model, PathSegment(states, past[1:])), w, atol=1e-9)


# smoothing kernels


@pytest.mark.parametrize(
    ("kernel", "h", "sd"),
    [(GaussianSmoothing(), 0.6682, 0.6682), (EpanechnikovSmoothing(), 2.684, 0.616)],
)
def test_bandwidths(kernel: Any, h: float, sd: float) -> None:
    """In 15 dimensions with 500 particles."""
    found = float(kernel.bandwidth(15, torch.tensor([[500.0]], dtype=torch.float64)))
    assert found == pytest.approx(h, abs=5e-4)
    assert found * math.sqrt(kernel.variance(15)) == pytest.approx(sd, abs=5e-4)


@pytest.mark.parametrize("d", [1, 2, 7])
def test_epanechnikov_s_law(d: int) -> None:
    e = EpanechnikovSmoothing().draw(one(runs=4), "e", 5000, d).reshape(-1, d).numpy()
    square = (e**2).sum(1)
    assert square.max() < 1.0
    assert stats.kstest(square, stats.beta(d / 2, 2).cdf).pvalue > 1e-4
    covariance, error = np.cov(e.T).reshape(d, d), 4.5 / (d + 4) * math.sqrt(2 / len(e))
    assert np.abs(covariance - np.eye(d) / (d + 4)).max() < error
    assert np.abs(e.mean(0)).max() < 4.5 / math.sqrt((d + 4) * len(e))


def test_shrinking_keeps_the_covariance_with_any_kernel() -> None:
    x = one(runs=300).normal("x", 100, 2) * torch.tensor([100.0, 1e-3])
    uneven = torch.linspace(0.0, 1e-3, 100, dtype=torch.float64).log_softmax(-1)  # equal ones stay
    before = ParticleBelief(x, uneven.expand(300, -1), torch.zeros(300))
    n = torch.full((300, 1), 100.0, dtype=torch.float64)
    for shrink, grown in (
        (True, 1.0),
        (False, 1.0 + float(EpanechnikovSmoothing().bandwidth(2, n)[0]) ** 2 / 6),
    ):
        method = RegularisedResampler(
            EssResampler(Systematic(), 1.0), 1.0, shrink, EpanechnikovSmoothing()
        )
        after, _ = method(WALK, before, before.log_w, n, one(runs=300))
        ratio = (after.x.var(1) / x.var(1)).numpy()
        assert np.all(np.abs(ratio.mean(0) - grown) < 4.5 * ratio.std(0) / math.sqrt(300) + 0.01)


# what cannot be done is said


@pytest.mark.parametrize(
    "kernel",
    [LastStateKernel(), PathBlockKernel(3, SmoothedSegment()), PathBlockKernel(2, PriorSegment())],
)
def test_a_singular_transition_is_refused_in_words(kernel: McmcKernel) -> None:
    singular = LinearGaussian(
        [[1.0, 1.0], [0.0, 1.0]], [[0.0], [1.0]], [[1.0, 0.0]], [1.0], [0.0, 0.0], [1.0, 1.0]
    )
    with pytest.raises(
        ValueError, match=r"density of x_t given x_t-1.*LinearGaussian.*NoiseFlowKernel"
    ):
        filter_record(
            moving(MetropolisHastings(kernel), threshold=0.0), singular, WALK_Y
        )  # at once, not at the first refresh
    assert not filter_record(
        moving(MetropolisHastings(NoiseFlowKernel(3))), singular, WALK_Y
    ).lost.any()


@dataclasses.dataclass(frozen=True)
class Silent(McmcKernel):
    """A proposal that does not tell its noise."""

    is_exact = True

    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: Any
    ) -> ProposalSample:
        return BootstrapProposal()(model, belief, record, draws)._replace(w=None)


class Spiky(LinearGaussian):
    @property
    def noise(self) -> Distribution:
        return Independent(Laplace(self.m0, torch.ones_like(self.m0)), 1)


def test_what_moves_cannot_do_without() -> None:
    check_refused(
        [
            (
                "must return its noise if moves use it again",
                lambda: filter_record(
                    dataclasses.replace(
                        moving(MetropolisHastings(NoiseFlowKernel(3))), proposal=Silent()
                    ),
                    WALK,
                    WALK_Y,
                ),
            )
        ],
        remedy=False,
    )
    assert not filter_record(
        dataclasses.replace(moving(MetropolisHastings(LastStateKernel())), proposal=Silent()),
        WALK,
        WALK_Y,
    ).lost.any()
    check_refused(
        [
            (
                "copy particles with their past",
                lambda: ParticleFilter(
                    40,
                    RegularisedResampler(EssResampler(Systematic())),
                    moves=(MetropolisHastings(LastStateKernel()),),
                ),
            ),
            (
                "Remove the other kernels",
                lambda: moving(
                    MetropolisHastings(NoiseFlowStatKernel()), MetropolisHastings(LastStateKernel())
                ),
            ),
            (
                "Remove the other kernels",
                lambda: moving(
                    MetropolisHastings(LastStateKernel()), MetropolisHastings(NoiseFlowStatKernel())
                ),
            ),
        ],
        remedy=False,
    )
    spiky = Spiky(*(getattr(WALK, k) for k in ("f", "g", "h", "r", "m0", "l0")))
    check_refused(
        [
            (
                "not normal",
                lambda: filter_record(
                    moving(MetropolisHastings(NoiseFlowKernel(3, noise_refresh=0.5))), spiky, WALK_Y
                ),
            )
        ],
        remedy=False,
    )
    assert not filter_record(
        moving(MetropolisHastings(NoiseFlowKernel(3))), spiky, WALK_Y
    ).lost.any()
    wide = LinearGaussian(WALK.f, torch.cat([WALK.g, WALK.g], 1), WALK.h, WALK.r, WALK.m0, WALK.l0)
    check_refused(
        [("do not determine its noise", lambda: filter_record(moving(*MIXED), wide, WALK_Y))],
        remedy=False,
    )


def test_keepers_join() -> None:
    deep = moving(
        MetropolisHastings(LastStateKernel()),
        MetropolisHastings(NoiseFlowKernel(7)),
        MetropolisHastings(PathBlockKernel(3, SmoothedSegment())),
    )
    assert deep.history == StateHistory(7, store_noise=True, store_density=True)
    assert moving().history is None
