"""Markov chains of whole paths in noise space, which leave p(path | y_1:T) invariant.

Neither kernel uses a transition density, so that both serve singular models.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.covariance import factor
from pfbench.core.derived_stream import relabel
from pfbench.core.jacobian import jacobian
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.smoothing.noise_space import NoiseSpace
from pfbench.model.base import StateSpaceModel


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
    if passes < 1:
        raise ValueError(f"passes must be at least 1, got {passes}. Increase it.")
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
        if not 0.0 <= self.rho < 1.0:
            raise ValueError(f"kernel.rho must be from 0 to below 1, got {self.rho}. Change it.")

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
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}. Increase it.")
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
