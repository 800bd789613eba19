"""Whole paths as vectors of standard normal numbers, Markov chains of them, and conditional SMC."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor
from torch.distributions import Independent, MultivariateNormal, Normal
from typing_extensions import override

from pfbench.core.linear_algebra import distribution_covariance, factor, jacobian
from pfbench.core.parameter_checks import require, require_range, require_ranges
from pfbench.core.random_stream import RandomStream, relabel
from pfbench.core.record import Record, iterate_steps
from pfbench.filter.loop import prepare_record
from pfbench.filter.smoothing.backward_sampling import draw_by_weight
from pfbench.filter.smoothing.gaussian_smoother import check_no_feedback
from pfbench.model.base import StateSpaceModel, initial_law

# A singular model does not have a transition density of its states. Its paths have a density in these
# numbers: a standard normal one times the likelihood of all measurements.


class NoiseSpace:
    """Map from standard normal numbers to paths of a model, for one record.

    A vector theta [d + T W] holds the whitened initial state and then the whitened noise of each
    step. M is the number of paths of a run.

    Args:
        model: State-space model with normal initial state and noise.
        record: Measurements [R, T, Dy] and inputs.

    Attributes:
        model: The model.
        steps: Model and record of each step.
        runs: Number of runs R.
        size: Size of a vector.

    Raises:
        ValueError: If the initial state or the noise is not normal, or the record has feedback.
    """

    def __init__(self, model: StateSpaceModel, record: Record) -> None:
        check_no_feedback(record)
        inputs = prepare_record(model, record)
        self.model, self.runs = model, len(record.y)
        self.steps = [(step_model, step) for _, step_model, step in iterate_steps(model, inputs)]
        initial: Any = initial_law(model, self.runs, inputs.spread)
        for name, distribution in (("initial", initial), ("noise", model.noise)):
            _check_normal(type(model).__name__, name, distribution)
        noise: Any = model.noise
        self._noise_mean, self._noise_sd = noise.mean, noise.stddev
        origin = model.origin.expand(self.runs, -1) if inputs.start is None else inputs.start
        self._origin = origin.unsqueeze(1)
        self._mean = initial.mean.expand(self.runs, -1).unsqueeze(1)
        root, _ = factor(distribution_covariance(initial).expand(self.runs, -1, -1))
        self._root = root
        self.size = model.chart.dimension + len(self.steps) * model.noise_dim

    def start(self, xi: Tensor) -> Tensor:
        """Return initial states [R, M, D] of whitened vectors [R, M, d]."""
        return self.model.chart.add(self._origin, self._mean + xi @ self._root.mT)

    def noise(self, theta: Tensor, t: int) -> Tensor:
        """Return the whitened noise of a step.

        Args:
            theta: Vectors, [R, M, size].
            t: Step from 0.

        Returns:
            Noise, [R, M, W].
        """
        begin = self.model.chart.dimension + t * self.model.noise_dim
        return theta[..., begin : begin + self.model.noise_dim]

    def advance(self, t: int, x: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
        """Take a step.

        Args:
            t: Step from 0.
            x: States before the step, [R, M, D].
            w: Whitened noise, [R, M, W].

        Returns:
            States after the step [R, M, D] and their log likelihoods [R, M].
        """
        model, record = self.steps[t]
        x = model.propagate(x, record.u, self._noise_mean + self._noise_sd * w)
        return x, model.log_likelihood(record.y, x, record.u)

    def find_noise(self, t: int, x: Tensor, later: Tensor) -> tuple[Tensor, Tensor] | None:
        """Find the noise of a step between given states.

        Args:
            t: Step from 0.
            x: States before the step, [R, M, D].
            later: States after the step, [R, M, D].

        Returns:
            Whitened noise [R, M, W], and log |det| of the noise in the state, [R or 1, 1]. None if the model does not add as
            many noises as there are states, on a flat chart.
        """
        model, record = self.steps[t]
        gain = model.noise_gain(record.u) if model.chart.flat else None
        if gain is None or gain.shape[-1] != gain.shape[-2]:
            return None
        still = model.propagate(x, record.u, x.new_zeros(*x.shape[:2], gain.shape[-1]))
        w = torch.linalg.solve(gain, (later - still).mT).mT
        log_det = torch.linalg.slogdet(gain).logabsdet + self._noise_sd.log().sum()
        return (w - self._noise_mean) / self._noise_sd, log_det.unsqueeze(-1)

    def roll_out(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """Return the paths of vectors and their log likelihoods.

        Args:
            theta: Vectors, [R, M, size].

        Returns:
            States x_1 to x_T, [R, M, T, D], and log p(y_1:T | path), [R, M].
        """
        x = self.start(theta[..., : self.model.chart.dimension])
        states, total = [], torch.zeros_like(x[..., 0])
        for t, _ in enumerate(self.steps):
            x, log_likelihood = self.advance(t, x, self.noise(theta, t))
            states.append(x)
            total = total + log_likelihood
        return torch.stack(states, 2), total

    def residuals(self, theta: Tensor) -> Tensor:
        """Return the whitened residuals of the measurements of paths.

        Args:
            theta: Vectors, [R, M, size].

        Returns:
            L^-1 (y - y_hat) with L L' the covariance of the measurement, [R, M, T Dy]; 0 for
            missing components.
        """
        states, _ = self.roll_out(theta)
        rows = []
        for t, (model, record) in enumerate(self.steps):
            distribution: Any = model.observation(states[:, :, t], record.u)
            y = record.y.unsqueeze(1)
            observed_mask = ~torch.isnan(y)
            r = torch.where(observed_mask, model.residual(y, distribution.mean), 0.0)
            covariance = distribution_covariance(distribution)
            pairs = observed_mask.unsqueeze(-1) & observed_mask.unsqueeze(-2)
            eye = torch.eye(r.shape[-1], dtype=r.dtype, device=r.device)
            root, _ = factor(torch.where(pairs, covariance, eye))
            row = torch.linalg.solve_triangular(root, r.unsqueeze(-1), upper=False)
            rows.append(row.squeeze(-1))
        return torch.cat(rows, -1)


def _check_normal(model: str, name: str, distribution: Any) -> None:
    """Raise an error if a distribution is not normal."""
    base = distribution.base_dist if isinstance(distribution, Independent) else distribution
    require(
        isinstance(base, Normal | MultivariateNormal),
        f"{model}.{name}",
        "be normal for smoothing in noise space",
        type(base).__name__,
        "Use sample_trajectories.",
    )


# --------------------------------------------------------------------------------------------------
# Markov chains of whole paths in noise space, which leave p(path | y_1:T) invariant.
#
# Neither kernel uses a transition density, so that both serve singular models.


class PathKernel(Protocol):
    """A transition of a Markov chain of paths."""

    def __call__(
        self, space: NoiseSpace, theta: Tensor, draws: RandomStream
    ) -> tuple[Tensor, Tensor]:
        """Take a step of M chains of each run.

        Args:
            space: Map from vectors to paths.
            theta: Vectors, [R, M, size].
            draws: Random stream.

        Returns:
            New vectors, [R, M, size], and whether each chain has changed, [R, M].
        """


class PathLaplace(NamedTuple):
    """Normal approximation of p(theta | y_1:T).

    Attributes:
        mode: Centre, [R, size].
        root: Root of the covariance, [R, size, size].
    """

    mode: Tensor
    root: Tensor


def fit_path_laplace(space: NoiseSpace, passes: int = 6) -> PathLaplace:
    """Fit a normal distribution at the mode of the vectors, by Gauss-Newton steps.

    The derivative is dense, so that size should be at most some hundreds. A step is halved up to
    three times, and left out if none of these steps increases the posterior density.

    Args:
        space: Map from vectors to paths.
        passes: Number of steps.

    Returns:
        Mode, and root of (I + J' J)^-1 with the derivative J of the whitened residuals.

    Raises:
        ValueError: If passes is below 1.
    """
    require_range("passes", passes, "[1, inf]")
    zero = space.start(
        torch.zeros(space.runs, 1, space.model.chart.dimension).to(space.model.anchor)
    )
    mode = zero.new_zeros(space.runs, space.size)
    for k in range(passes + 1):
        centre = mode.unsqueeze(1)
        r = space.residuals(centre)
        slope = jacobian(partial(_shifted_residuals, space, centre), r, space.size)
        information = slope.mT @ slope + torch.eye(space.size, dtype=r.dtype, device=r.device)
        root, _ = factor(information)
        if k == passes:
            break
        target = slope @ mode.unsqueeze(-1) - r.mT
        step = torch.cholesky_solve(slope.mT @ target, root).mT - centre
        factors = r.new_tensor([0.0, 1.0, 0.5, 0.25, 0.125])[:, None]
        candidates = centre + factors * step
        cost = candidates.square().sum(-1) + space.residuals(candidates).square().sum(-1)
        best = cost.nan_to_num(nan=math.inf).argmin(1)
        mode = candidates[torch.arange(space.runs, device=r.device), best]
    eye = torch.eye(space.size, dtype=root.dtype, device=root.device).expand_as(root)
    return PathLaplace(mode, torch.linalg.solve_triangular(root, eye, upper=False).mT)


def _shifted_residuals(space: NoiseSpace, centre: Tensor, d: Tensor) -> Tensor:
    """Return the whitened residuals of the vectors centre + d."""
    return space.residuals(centre + d)


@dataclass(frozen=True)
class CrankNicolsonKernel(PathKernel):
    """Preconditioned Crank-Nicolson step about a normal approximation of the paths.

    theta' = m + rho (theta - m) + sqrt(1 - rho^2) L z leaves N(m, L L') invariant, and is accepted
    with the ratio of p(theta | y) / N(theta; m, L L'). On a linear model each step is accepted, and
    with rho = 0 the paths are independent draws of the smoother.

    Attributes:
        laplace: Normal approximation of the paths, see `fit_path_laplace`.
        rho: Correlation of the proposed vector with the present one, from 0 to below 1.

    Raises:
        ValueError: If rho is outside [0, 1).

    References:
        S. Cotter, G. Roberts, A. Stuart and D. White (2013), MCMC methods for functions. D. Rudolf
        and B. Sprungk (2018), On a generalization of the preconditioned Crank-Nicolson algorithm.
    """

    laplace: PathLaplace
    rho: float = 0.0

    def __post_init__(self) -> None:
        require_ranges("kernel", self, rho="[0, 1)")

    @override
    def __call__(
        self, space: NoiseSpace, theta: Tensor, draws: RandomStream
    ) -> tuple[Tensor, Tensor]:
        mode, root = self.laplace.mode.unsqueeze(1), self.laplace.root
        z = draws.normal("path", theta.shape[1], space.size).to(theta)
        proposed = mode + self.rho * (theta - mode) + math.sqrt(1 - self.rho**2) * (z @ root.mT)
        log_ratio = self._log_weight(space, proposed) - self._log_weight(space, theta)
        u = draws.uniform("accept", theta.shape[1], 1).squeeze(-1)
        accepted = u.log().to(log_ratio) < log_ratio
        return torch.where(accepted.unsqueeze(-1), proposed, theta), accepted

    def _log_weight(self, space: NoiseSpace, theta: Tensor) -> Tensor:
        """Return log p(theta, y) - log N(theta; m, L L') up to a constant, [R, M]."""
        _, log_likelihood = space.roll_out(theta)
        deviation = (theta - self.laplace.mode.unsqueeze(1)).mT
        z = torch.linalg.solve_triangular(self.laplace.root, deviation, upper=True)
        return log_likelihood - 0.5 * theta.square().sum(-1) + 0.5 * z.square().sum(1)


class PathSample(NamedTuple):
    """Sampled paths.

    Attributes:
        states: Last states of the chains, [R, M, T, D].
        theta: Their vectors in noise space, [R, M, size].
        changed: Share of the steps in which a chain has changed, [R].
    """

    states: Tensor
    theta: Tensor
    changed: Tensor


def sample_smoothed_paths(
    model: StateSpaceModel,
    record: Record,
    draws: RandomStream,
    paths: int,
    mcmc_steps: int = 10,
    kernel: PathKernel | None = None,
) -> PathSample:
    """Sample paths from p(x_1:T | y_1:T) of a model, which may be singular, by independent chains.

    The chains start at draws of the normal approximation of `fit_path_laplace`.

    Args:
        model: State-space model with normal initial state and noise.
        record: Measurements [R, T, Dy] and inputs.
        draws: Random stream.
        paths: Number of chains M of each run.
        mcmc_steps: Number of steps of each chain.
        kernel: Step of a chain, `CrankNicolsonKernel` with rho = 0 by default.

    Returns:
        Paths at the end of the chains.

    Raises:
        ValueError: If paths or mcmc_steps is below 1. If a distribution is not normal, or the
            record has feedback.
    """
    for name, value in (("paths", paths), ("mcmc_steps", mcmc_steps)):
        require_range(name, value, "[1, inf]")
    space = NoiseSpace(model, record)
    laplace = fit_path_laplace(space)
    kernel = kernel or CrankNicolsonKernel(laplace)
    z = relabel(draws, "start.").normal("path", paths, space.size).to(laplace.mode)
    theta = laplace.mode.unsqueeze(1) + z @ laplace.root.mT
    shares = []
    for k in range(mcmc_steps):
        theta, changed = kernel(space, theta, relabel(draws, f"chain_{k}."))
        shares.append(changed.to(theta).mean(1))
    return PathSample(space.roll_out(theta)[0], theta, torch.stack(shares, 1).mean(1))


# --------------------------------------------------------------------------------------------------
# Conditional sequential Monte Carlo with ancestor sampling, in noise space.


@dataclass(frozen=True)
class ConditionalSmcKernel(PathKernel):
    """Conditional particle filter: the present path is one of its particles.

    With ancestor sampling the parent of the present path's future is drawn at each step. Where a model adds as many noises as
    it has states, the probability is the weight of the parent times the transition density to the next state of the path.
    Elsewhere it is the weight times the likelihood of all later measurements along the path that starts there with the noises of
    the future, whose densities cancel. A kernel then takes T^2 N / 2 propagations in place of T N.

    Attributes:
        particles: Number of particles N.
        sample_ancestors: Whether to sample the parents of the future of the present path.

    Raises:
        ValueError: If there are fewer than two particles.

    References:
        C. Andrieu, A. Doucet and R. Holenstein (2010), Particle Markov chain Monte Carlo methods.
        F. Lindsten, M. Jordan and T. Schon (2014), Particle Gibbs with ancestor sampling, section 4.
    """

    particles: int
    sample_ancestors: bool = True

    def __post_init__(self) -> None:
        require_ranges("kernel", self, particles="[2, inf]")

    @override
    def __call__(
        self, space: NoiseSpace, theta: Tensor, draws: RandomStream
    ) -> tuple[Tensor, Tensor]:
        d = space.model.chart.dimension
        noises = [self._draw(theta[..., :d], draws.at_step(0))]
        x = space.start(noises[0].flatten(1, 2))
        log_w, parents = torch.zeros_like(noises[0][..., 0]), []
        path, _ = space.roll_out(theta)
        for t, _ in enumerate(space.steps):
            stream = draws.at_step(t + 1)
            u = stream.uniform("parent", theta.shape[1], self.particles)
            slots = draw_by_weight(log_w.flatten(0, 1), u.flatten(0, 1)).view(log_w.shape)
            later = path[:, :, t].repeat_interleave(self.particles, 1)
            slots[..., -1], reference = self._draw_parent(space, theta, t, x, log_w, later, stream)
            parents.append(slots)
            noises.append(self._draw(reference, stream))
            x = _take(x.unflatten(1, log_w.shape[1:]), slots).flatten(1, 2)
            x, log_likelihood = space.advance(t, x, noises[-1].flatten(1, 2))
            log_w = log_likelihood.view(log_w.shape)
        slot = _draw_slot(log_w, draws.at_step(len(space.steps) + 1), "path").unsqueeze(-1)
        parts = []
        for noise, before in zip(noises[:0:-1], parents[::-1], strict=True):
            parts.append(_take(noise, slot))
            slot = before.gather(2, slot)
        parts.append(_take(noises[0], slot))
        new = torch.cat(parts[::-1], -1).squeeze(2)
        return new, (new != theta).any(-1)

    def _draw(self, reference: Tensor, draws: RandomStream) -> Tensor:
        """Draw [R, M, N, k] standard normal numbers, the last particle being the present path."""
        chains, k = reference.shape[1:]
        free = draws.normal("noise", chains, (self.particles - 1) * k).to(reference)
        return torch.cat([free.unflatten(-1, (-1, k)), reference.unsqueeze(2)], 2)

    def _draw_parent(
        self,
        space: NoiseSpace,
        theta: Tensor,
        t: int,
        x: Tensor,
        log_w: Tensor,
        later: Tensor,
        draws: RandomStream,
    ) -> tuple[Tensor, Tensor]:
        """Draw the slot [R, M] of the parent of the present path's future, and return the noise [R, M, W] that leads from there to `later`."""
        reference = space.noise(theta, t)
        if not self.sample_ancestors:
            slots = torch.full(log_w.shape[:2], self.particles - 1, device=log_w.device)
            return slots, reference
        solution = space.find_noise(t, x, later)
        if solution is not None:
            noise = solution[0].unflatten(1, log_w.shape[1:])
            slots = _draw_slot(log_w - 0.5 * noise.square().sum(-1), draws, "ancestor")
            return slots, _take(noise, slots.unsqueeze(-1)).squeeze(2)
        future = theta.repeat_interleave(self.particles, 1)
        for s in range(t, len(space.steps)):
            x, log_likelihood = space.advance(s, x, space.noise(future, s))
            log_w = log_w + log_likelihood.view(log_w.shape)
        return _draw_slot(log_w, draws, "ancestor"), reference


def _draw_slot(log_w: Tensor, draws: RandomStream, purpose: str) -> Tensor:
    """Draw a slot [R, M] of each chain by log weights [R, M, N]."""
    u = draws.uniform(purpose, log_w.shape[1], 1).flatten(0, 1)
    return draw_by_weight(log_w.flatten(0, 1), u).view(log_w.shape[:2])


def _take(values: Tensor, slots: Tensor) -> Tensor:
    """Gather [R, M, n, k] of values [R, M, N, k] by slots [R, M, n]."""
    return values.gather(2, slots.unsqueeze(-1).expand(*slots.shape, values.shape[-1]))
