"""MCMC kernels of paths: moves of the start, of the end, and by statistics of the noise."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.linear_algebra import distribution_covariance, factor
from pfbench.core.parameter_checks import require, require_ranges
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief, normalise_log_weights, weighted_mean_cov
from pfbench.filter.exactness import is_every_part_exact
from pfbench.filter.linearisation import (
    derivative,
    linearised_innovation,
    mask_covariance,
    measurement_jacobian,
    transition_jacobian,
    unwrap_independent,
)
from pfbench.filter.loop import MEMORY_OF_PASS
from pfbench.filter.moves.metropolis import (
    McmcKernel,
    PathHistory,
    StateHistory,
    concatenate_histories,
    stack_history,
)
from pfbench.filter.moves.path_proposals import (
    PathSegment,
    PriorSegment,
    SegmentProposal,
    driving_noise,
    measurement_log_density,
    transition_log_density,
)
from pfbench.filter.moves.taped_paths import find_taped_paths
from pfbench.filter.particle.regularised_resampling import GaussianSmoothing, SmoothingKernel
from pfbench.filter.whitening import compute_half_square, fill_missing, whiten
from pfbench.model.base import StateSpaceModel


@dataclass(frozen=True)
class PathStatistics(PathHistory):
    """Gradient and curvature of a particle's log path density under fixed noises.

    If the newest state moves by delta, the log density changes by b.delta - delta' Lambda delta / 2
    to first order, exactly on linear-Gaussian models. `score` b [R, N, d] belongs to each particle,
    `information` Lambda [R, 1, d, d] to the run. With the Jacobian Phi of a step at the mean,

        Lambda <- Phi^-T Lambda Phi^-1 + J,   b_i <- Phi^-T b_i + d log p(y | x_i) / dx.

    J is the Fisher information of the measurement at the mean. Initially Lambda = P0^-1 and
    b_i = -P0^-1 xi_i. The derivative at each particle [ours] also uses variance measurements.
    """

    @override
    def merge(self, history: PathHistory) -> PathHistory:
        require(
            isinstance(history, PathStatistics),
            "filter.moves",
            "not combine NoiseFlowStatKernel with other kernels",
            "both",
            "Remove the other kernels, because this one does not store paths.",
        )
        return self

    @override
    def start(
        self, model: StateSpaceModel, belief: ParticleBelief, mean: Tensor, covariance: Tensor
    ) -> ParticleBelief:
        """Start with the information and score of the initial distribution."""
        root, ok = factor(covariance)
        require(
            (ok & (root.diagonal(dim1=-2, dim2=-1) > 0.0).all(-1)).all(),
            "filter.moves: the initial covariance",
            "be positive definite for kernels that use statistics of the path",
            f"variances {covariance[0].diagonal().tolist()} of the particles",
            "Use NoiseFlowKernel, or a larger initial standard deviation or number of particles.",
        )
        information = torch.cholesky_inverse(root)
        score = -model.chart.subtract(belief.x, mean.unsqueeze(1)) @ information
        return belief._replace(window={"score": score, "information": information.unsqueeze(1)})

    @override
    def append(
        self,
        model: StateSpaceModel,
        before: ParticleBelief,
        after: ParticleBelief,
        w: Tensor | None,
        record: Record,
    ) -> ParticleBelief:
        """Propagate information and score, and add those of the measurement."""
        chart = model.chart
        start, end = (
            chart.mean(belief.x, normalise_log_weights(belief.log_w)).unsqueeze(1)
            for belief in (before, after)
        )
        inverse_step = torch.linalg.inv_ex(transition_jacobian(model, start, record.u)[:, 0])[0]
        past = inverse_step.mT @ before.window["information"][:, 0] @ inverse_step
        information = past + fisher_information(model, end, record)
        information = 0.5 * (information + information.mT)
        score = before.window["score"] @ inverse_step + _likelihood_gradient(model, after.x, record)
        return after._replace(window={"score": score, "information": information.unsqueeze(1)})


def fisher_information(model: StateSpaceModel, x: Tensor, record: Record) -> Tensor:
    """Compute the Fisher information of a measurement, by moments if not normal.

    Returns information matrix, [R, d, d]. Shapes: x [R, 1, D].
    """
    observed_mask, h = ~torch.isnan(record.y), measurement_jacobian(model, x, record)[:, 0]
    distribution: Any = model.observation(x, record.u)
    covariance = mask_covariance(distribution_covariance(distribution)[:, 0], observed_mask)
    information = h.mT @ torch.linalg.solve_ex(covariance, h)[0]
    if isinstance(distribution, torch.distributions.MultivariateNormal):
        return information

    def log_sd(a: Tensor, xi: Tensor) -> Tensor:
        shifted: Any = model.observation(model.chart.add(a, xi), record.u)
        return torch.log(shifted.stddev)

    log_sd_jacobian = torch.where(
        observed_mask.unsqueeze(-1), derivative(log_sd, x, model.chart.dimension)[:, 0], 0.0
    )
    return information + 2.0 * log_sd_jacobian.mT @ log_sd_jacobian


def _likelihood_gradient(model: StateSpaceModel, x: Tensor, record: Record) -> Tensor:
    """Compute d log p(y | x) / dx along the chart for each particle [R, N, d]."""
    with torch.enable_grad():
        xi = x.new_zeros(*x.shape[:2], model.chart.dimension, requires_grad=True)
        total = model.log_likelihood(record.y, model.chart.add(x.detach(), xi), record.u).sum()
        if not total.requires_grad:
            return torch.zeros_like(xi)
        return torch.autograd.grad(total, xi, materialize_grads=True)[0]


# --------------------------------------------------------------------------------------------------
# MCMC kernels that move the start of a path and keep its noise.
#
# t is the newest step of the window. A random-walk step is h A e in the chart. A comes from the
# particle set and not from the particle, so the step is symmetric and cancels in the ratio.


@dataclass(frozen=True)
class RandomWalk:
    """Step h A e of a random walk, with A A' the covariance of the moved quantity.

    h is the bandwidth of a smoothing kernel times `scale`. The Gaussian bandwidth is close to the
    best scale in many dimensions, 2.38 / sqrt(d).

    Attributes:
        scale: Factor on the bandwidth.
        smoothing: Smoothing kernel, which also gives the distribution of e.

    Raises:
        ValueError: If the scale is not positive.
    """

    scale: float = 1.0
    smoothing: SmoothingKernel = field(default_factory=GaussianSmoothing)
    is_exact = True  # symmetric: its density ratio is 1

    def __post_init__(self) -> None:
        require_ranges(
            "kernel.random_walk", self, scale="(0, inf] Set a factor on the optimal bandwidth."
        )

    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, x: Tensor, draws: RandomStream
    ) -> Tensor:
        """Draw steps.

        Args:
            model: State-space model.
            belief: Weighted particles.
            x: States that the steps will move, [R, N, D], with the weights of the belief.
            draws: Random stream.

        Returns:
            Steps in the chart, [R, N, d].
        """
        covariance = weighted_mean_cov(model.chart, belief._replace(x=x))[1]
        root, ok = factor(covariance)
        sd = covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0.0).sqrt()
        active_count = torch.isfinite(belief.log_w).sum(1, keepdim=True).to(x.dtype)
        h = self.scale * self.smoothing.bandwidth(covariance.shape[-1], active_count)
        e = self.smoothing.draw(draws, "walk", x.shape[1], covariance.shape[-1])
        return h.unsqueeze(-1) * (e @ torch.where(ok[:, None, None], root, torch.diag_embed(sd)).mT)


@dataclass(frozen=True)
class NoiseFlowKernel(McmcKernel):
    """Move the start of the window under fixed noises, without a density [ours].

    s = x_t-L and s' = s (+) h A e, with A from the starts at time t. The path follows from s' under
    the same noises:

    log beta = log p(s') - log p(s) + sum_j log p(y_j | x'_j) - log p(y_j | x_j).

    While t <= L the start is x_0 and its distribution is exact. Later it is the normal
    distribution with the filter's moments at t - L. The target is then that of a fixed-lag
    smoother, so `is_exact` is False. The cost is L model steps, of a linear model L for all steps of
    a sweep together.

    Attributes:
        lag: L. The window may be longer for another kernel. The flow then starts where the
            window does.
        random_walk: Step of the start. On a curved chart it is taken in the coordinates about the
            mean of the start [ours]. The distribution is normal there, so no volume element is
            missing.
        noise_refresh: c. Replaces the noises by w' = sqrt(1 - c^2) w + c e, which leaves their
            normal distribution invariant.

    Raises:
        ValueError: If the lag is below 1 or the refresh outside [0, 1). On use, if noise that is
            not normal is refreshed.
    """

    lag: int = 20
    random_walk: RandomWalk = field(default_factory=RandomWalk)
    noise_refresh: float = 0.0
    is_exact = False

    def __post_init__(self) -> None:
        require_ranges("kernel", self, lag="[1, inf]", noise_refresh="[0, 1) Use 0 for no refresh.")

    @property
    @override
    def required_history(self) -> StateHistory:
        return StateHistory(self.lag, store_noise=True)

    @override
    def propose(
        self, model: StateSpaceModel, belief: ParticleBelief, draws: RandomStream
    ) -> tuple[ParticleBelief, Tensor]:
        window, chart = belief.window, model.chart
        start = window["states"][:, :, 0]
        step = self.random_walk(model, belief, start, draws)
        if "score" in window:
            change = step @ window["information"][:, 0]
            white_step = step @ window["whitening"][:, 0].mT
            white = window["white"] + white_step
            gain, loss = window["score"] - 0.5 * change, white - 0.5 * white_step
            ends = {
                "states": (start + step).unsqueeze(2),
                "score": window["score"] - change,
                "white": white,
            }
            return belief._replace(window=window | ends), (step * gain - white_step * loss).sum(-1)
        centre = window["mean"][:, :, 0]
        xi = chart.subtract(start, centre)
        proposed_start = start + step if chart.flat else chart.add(centre, xi + step)
        root = factor(window["covariance"][:, 0, 0])[0]
        before, after = (compute_half_square(whiten(a, root)) for a in (xi, xi + step))
        noise = self._refresh_noise(model, window["noise"], draws)
        states, log_like = propagate_path(model, proposed_start, noise, belief.past)
        log_alpha = before - after + (log_like - window["log_like"]).sum(-1)
        new_window = {"states": states, "log_like": log_like, "noise": noise}
        return belief._replace(x=states[:, :, -1], window=window | new_window), log_alpha

    @override
    def shorten(self, model: StateSpaceModel, belief: ParticleBelief) -> ParticleBelief:
        """Return the particles of a linear model with the start and what its likelihood requires.

        Under fixed noises the log likelihood of the path is then quadratic in the start, with the gradient
        `score` [R, N, d] and the curvature `information` [R, 1, d, d]. The start has N(0, I) as its distribution
        after `whitening` [R, 1, d, d], which gives `white` [R, N, d]. A step of a sweep costs no model step.
        """
        is_quadratic = model.linear and model.chart.flat and self.noise_refresh == 0.0
        if not (is_quadratic and belief.past):
            return belief
        window, start = belief.window, belief.window["states"][:, :, :1]
        score, information = _measure_start(model, window["states"], belief.past)
        root = fill_missing(factor(window["covariance"][:, 0, 0])[0])
        whitening = torch.linalg.solve_triangular(
            root, torch.eye(root.shape[-1]).to(root), upper=False
        )
        short = {
            "states": start,
            "score": score,
            "white": (start - window["mean"][:, :, :1]).squeeze(2) @ whitening.mT,
            "information": information.unsqueeze(1),
            "whitening": whitening.unsqueeze(1),
        }
        return belief._replace(window=short, past=())

    @override
    def complete(
        self,
        model: StateSpaceModel,
        short: ParticleBelief,
        before: ParticleBelief,
        accepted: Tensor,
    ) -> ParticleBelief:
        """Return moved particles with the paths that follow from their starts."""
        if "score" not in short.window:
            return short
        window, start = before.window, short.window["states"][:, :, 0]
        states, values = propagate_path(model, start, window["noise"], before.past)
        additions = {
            "states": torch.where(accepted[..., None, None], states, window["states"]),
            "log_like": torch.where(accepted.unsqueeze(2), values, window["log_like"]),
        }
        return before._replace(
            x=additions["states"][:, :, -1], window=window | additions, ancestors=short.ancestors
        )

    def _refresh_noise(self, model: StateSpaceModel, w: Tensor, draws: RandomStream) -> Tensor:
        """Mix the noises [R, N, K, W] with new ones."""
        if self.noise_refresh == 0.0 or w.shape[2] == 0:
            return w
        noise: Any = model.noise
        require(
            isinstance(unwrap_independent(noise), torch.distributions.Normal),
            "kernel.noise_refresh",
            "be 0 for noise that is not normal",
            f"{self.noise_refresh} with {type(model).__name__}",
            "Set noise_refresh=0.",
        )
        n, steps, width = w.shape[1:]
        e = draws.normal("refresh", n, steps * width).unflatten(2, (steps, width))
        return (
            noise.mean
            + (1.0 - self.noise_refresh**2) ** 0.5 * (w - noise.mean)
            + self.noise_refresh * noise.stddev * e
        )


def propagate_path(
    model: StateSpaceModel, start: Tensor, noise: Tensor, past: tuple[Record, ...]
) -> tuple[Tensor, Tensor]:
    """Propagate a path from its start with fixed noises.

    Returns states [R, N, K+1, D] and log p(y_j | x_j) [R, N, K+1]. Shapes: start [R, N, D], noise
    [R, N, K, W].
    """
    paths = find_taped_paths(model, start) if len(past) > 1 else None
    first = [model.log_likelihood(record.y, start, record.u) for record in past[:1]] or [
        torch.zeros_like(start[..., 0])
    ]
    if paths and paths.tape:
        return paths.run(start, first[0], noise, past)
    x, states, values = start, [start], first
    for j, record in enumerate(past[1:]):
        x = model.propagate(x, record.u, noise[:, :, j])
        states.append(x)
        values.append(model.log_likelihood(record.y, x, record.u))
    results = stack_history(states), stack_history(values)
    if paths:
        paths.record(start, noise, past, *results)
    return results


def _linearise(
    model: StateSpaceModel, x: Tensor, record: Record
) -> tuple[Record, Tensor, Tensor, Tensor]:
    """Compute what no state changes in a step of a linear model, at any state of each run.

    Returns the record and the transition Jacobian [R or 1, d, d]. Then the measurement Jacobian H, and H divided by the
    covariance, [R, 2, k, d]. Last the measurement at state 0 minus its mean there, [R, k, 1]. Shapes: x [R, 1, D].
    """
    slope = measurement_jacobian(model, x, record)[:, 0]
    noise = distribution_covariance(model.observation(x, record.u))[:, 0]
    observed = mask_covariance(noise, ~torch.isnan(record.y))
    slopes = torch.stack([slope, torch.linalg.solve_ex(observed, slope)[0]], 1)
    offset = linearised_innovation(model, x, record).mT + slope @ x.mT
    return record, transition_jacobian(model, x, record.u)[:, 0], slopes, offset


def _measure_start(
    model: StateSpaceModel, states: Tensor, past: tuple[Record, ...]
) -> tuple[Tensor, Tensor]:
    """Compute gradient and curvature of the log likelihood of paths in their start, of a linear model.

    Returns gradient [R, N, d] and curvature [R, d, d]. Shapes: states [R, N, K+1, D].
    """
    memory = MEMORY_OF_PASS.get()
    owner, stored = (memory or {}).get(_linearise, (model, {}))
    stored = stored if owner is model else {}  # by the identity of a record, which lives as long
    stored = {
        id(record): stored.get(id(record)) or _linearise(model, states[:, :1, j], record)
        for j, record in enumerate(past)
    }
    if memory is not None:
        memory[_linearise] = model, stored
    _, transitions, slopes, offsets = zip(*stored.values(), strict=True)
    products = [torch.eye(states.shape[-1]).to(states).expand(len(states), -1, -1)]
    for transition in transitions[1:]:
        products.append(transition @ products[-1])
    along = torch.stack(products, 1).unsqueeze(1)
    plain, weighted = (torch.stack(slopes, 2) @ along).flatten(2, 3).unbind(1)
    residuals = [
        torch.baddbmm(offset, slope[:, 0], states[:, :, j].mT, alpha=-1.0)
        for j, (slope, offset) in enumerate(zip(slopes, offsets, strict=True))
    ]
    return (weighted.mT @ torch.cat(residuals, 1)).mT, plain.mT @ weighted


@dataclass(frozen=True)
class NoiseFlowStatKernel(McmcKernel):
    """Move the whole path since t = 0 with its newest state, at constant cost [ours].

    By sufficient statistics [after Storvik 2002; Fearnhead 2002]: x' = x (+) delta, delta = h A e,
    and log beta = b.delta - delta' Lambda delta / 2. After acceptance b <- b - Lambda delta. Exact
    on linear-Gaussian models, of first order on others. `PathStatistics` defines b and Lambda.

    Attributes:
        random_walk: delta, by default with half the optimal bandwidth.
    """

    random_walk: RandomWalk = field(default_factory=lambda: RandomWalk(0.5))
    is_exact = False
    required_history = PathStatistics()

    @override
    def propose(
        self, model: StateSpaceModel, belief: ParticleBelief, draws: RandomStream
    ) -> tuple[ParticleBelief, Tensor]:
        b, delta = belief.window["score"], self.random_walk(model, belief, belief.x, draws)
        information_shift = delta @ belief.window["information"][:, 0]
        log_alpha = (delta * (b - 0.5 * information_shift)).sum(-1)
        window = belief.window | {"score": b - information_shift}
        return belief._replace(x=model.chart.add(belief.x, delta), window=window), log_alpha


# --------------------------------------------------------------------------------------------------
# MCMC kernels that draw the end of a path: the child and previous states.
#
# t is the newest step of the window, x_t the child and x_t-1 its parent. A symmetric random walk
# proposes the child.


@dataclass(frozen=True)
class LastStateKernel(McmcKernel):
    """Move x_t only, with its parent fixed.

    The ratio is beta = p(y_t | x') p(x' | x_t-1) / (p(y_t | x) p(x | x_t-1)). x_0 does not move.
    See [Gilks and Berzuini 2001; Ristic, Arulampalam, Gordon 2004].

    Attributes:
        random_walk: Step of x_t.
    """

    random_walk: RandomWalk = field(default_factory=RandomWalk)
    required_history = StateHistory(1, store_density=True)

    @property
    @override
    def is_exact(self) -> bool:
        return is_every_part_exact(**{"kernel.walk": self.random_walk})

    @override
    def propose(
        self, model: StateSpaceModel, belief: ParticleBelief, draws: RandomStream
    ) -> tuple[ParticleBelief, Tensor]:
        return PathBlockKernel(0, PriorSegment(), self.random_walk).propose(model, belief, draws)


@dataclass(frozen=True)
class PathBlockKernel(McmcKernel):
    """Move the child and locally resample `block_length` states before it.

    [Yan et al. 2016, eqs. 10-13]: beta = prod_{j = t-length..t} p(y_j | x'_j) p(x'_j | x'_j-1)
    g(block) / (the same product without primes and with g(block')). If g is exactly
    p(block | fixed state, y), this is the ratio of the child's terms alone. The missing eq. 13 of
    the paper was probably this ratio [ours].

    Attributes:
        block_length: Number of re-drawn states. The paper's indices re-draw L of them, its text
            L - 1. Fewer are available near the start, and x_0 does not move.
        segment_proposal: g.
        random_walk: Step of the child.

    Raises:
        ValueError: If the length is negative. On use, if the transition density does not exist.
    """

    block_length: int
    segment_proposal: SegmentProposal
    random_walk: RandomWalk = field(default_factory=RandomWalk)

    def __post_init__(self) -> None:
        require_ranges("kernel", self, block_length="[0, inf] Use 0 to re-draw no state.")

    @property
    @override
    def is_exact(self) -> bool:
        return is_every_part_exact(
            **{"kernel.redraw": self.segment_proposal, "kernel.walk": self.random_walk}
        )

    @property
    @override
    def required_history(self) -> StateHistory:
        return StateHistory(self.block_length + 1, store_density=True)

    @override
    def propose(
        self, model: StateSpaceModel, belief: ParticleBelief, draws: RandomStream
    ) -> tuple[ParticleBelief, Tensor]:
        steps = len(belief.past) - 1
        if steps < 1:
            return belief, torch.full_like(belief.log_w, -torch.inf)
        first = steps - min(self.block_length, steps - 1)
        window = belief.window
        old = PathSegment(window["states"][:, :, first - 1 :], belief.past[first:])
        child = model.chart.add(belief.x, self.random_walk(model, belief, belief.x, draws))
        block, log_g = self.segment_proposal(model, old, child, draws)
        new = PathSegment(
            concatenate_histories([old.states[:, :, :1], block, child.unsqueeze(2)]), old.records
        )
        log_like = measurement_log_density(model, new)
        log_ratios = (
            log_like
            + transition_log_density(model, new)
            - window["log_like"][:, :, first:]
            - transition_log_density(model, old)
        )
        log_alpha = log_ratios.sum(-1) + log_g
        new_window = {"states": new.states[:, :, 1:], "log_like": log_like}
        if "noise" in window:
            new_window["noise"] = driving_noise(model, new)
        ends = {
            name: concatenate_histories([window[name][:, :, : -a.shape[2]], a])
            for name, a in new_window.items()
        }
        return belief._replace(x=child, window=window | ends), log_alpha


@dataclass(frozen=True)
class LikelihoodRatioKernel(McmcKernel):
    """Move x_t and accept by its likelihood alone, without the transition density.

    log beta = log p(y_t | x') - log p(y_t | x). A reading of the missing eqs. 13 to 15 of [Yan et al.
    2016]: the kernel is symmetric, "the proposed distribution ratio is reduced". It runs on any
    model, but the move forgets p(x_t | x_t-1). The target is not invariant: what is not measured
    spreads as under regularisation.

    Attributes:
        random_walk: Step of x_t.
    """

    random_walk: RandomWalk = field(default_factory=RandomWalk)
    is_exact = False
    required_history = StateHistory(1)

    @override
    def propose(
        self, model: StateSpaceModel, belief: ParticleBelief, draws: RandomStream
    ) -> tuple[ParticleBelief, Tensor]:
        if not belief.past:
            return belief, torch.full_like(belief.log_w, -torch.inf)
        record, window = belief.past[-1], belief.window
        child = model.chart.add(belief.x, self.random_walk(model, belief, belief.x, draws))
        log_like = model.log_likelihood(record.y, child, record.u)
        new = {"states": child.unsqueeze(2), "log_like": log_like.unsqueeze(2)}
        ends = {
            name: concatenate_histories([window[name][:, :, :-1], a]) for name, a in new.items()
        }
        log_alpha = log_like - window["log_like"][:, :, -1]
        return belief._replace(x=child, window=window | ends), log_alpha
