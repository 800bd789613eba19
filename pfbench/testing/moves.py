"""Test of moves: they leave the distribution of the path invariant."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record
from pfbench.files.table_file import Array
from pfbench.filter.belief import ParticleBelief
from pfbench.filter.moves.metropolis import McmcKernel, MetropolisHastings, Move, PathHistory
from pfbench.model.linear_gaussian import LinearGaussian, linear_walk
from pfbench.testing.results import (
    LawCheck,
    check_count,
    check_p_values,
    compute_twice,
    describe_subject,
    find_kind,
)

STEPS = 10  # so 11 states of 2 components
PATH_SIZE = 2 * (STEPS + 1)


class PathPosterior(NamedTuple):
    """Exact draws of x_0:k given y_1:k, with their mean and covariance factor.

    Attributes:
        model: Walk with constant velocity.
        y: Measurements, [k, 1].
        paths: Draws, [M, PATH_SIZE].
        mean: Mean of the paths, [PATH_SIZE].
        root: Factor of the covariance of the paths, [PATH_SIZE, PATH_SIZE].
    """

    model: LinearGaussian
    y: Tensor
    paths: Array
    mean: Array
    root: Array

    def belief(self, history: PathHistory | None) -> ParticleBelief:
        """Return the paths as particles of one run, with the stored past states.

        Args:
            history: Attribute `required_history` of the move. None stores nothing.

        Returns:
            Particles x_k [1, M, 2] of equal weight.
        """
        x = torch.tensor(self.paths).reshape(1, len(self.paths), STEPS + 1, 2)
        w = (x[:, :, 1:] - x[:, :, :-1] @ self.model.f.mT) @ torch.linalg.inv(self.model.g).mT
        flat = torch.full((1, len(self.paths)), -math.log(len(self.paths)), dtype=torch.float64)
        belief = ParticleBelief(x[:, :, 0], flat, torch.zeros(1, dtype=torch.float64))
        if history is None:
            return belief._replace(x=x[:, :, -1])
        covariance = self.model.l0 @ self.model.l0.mT
        belief = history.start(self.model, belief, self.model.m0[None], covariance[None])
        for j, row in enumerate(self.y):
            after = belief._replace(x=x[:, :, j + 1])
            belief = history.append(self.model, belief, after, w[:, :, j], Record(row[None]))
        return belief

    def paths_after(self, belief: ParticleBelief) -> Array:
        """Return the paths of moved particles, [M, PATH_SIZE]; states that are not stored stay."""
        stored = belief.window.get("states", belief.x.unsqueeze(2))
        count = 2 * stored.shape[2]
        paths = self.paths.copy()
        paths[:, PATH_SIZE - count :] = stored.reshape(len(paths), count).numpy()
        return paths

    def moments_p_value(self, paths: Array, components: slice = slice(None)) -> float:
        """Return the p-value of all moments of the whitened components.

        Args:
            paths: Paths, [M, PATH_SIZE].
            components: Components of the path. All by default.

        Returns:
            p-value of a chi-square test.
        """
        covariance = (self.root @ self.root.T)[components, components]
        z = np.linalg.solve(np.linalg.cholesky(covariance), (paths - self.mean)[:, components].T)
        (d, m), spread = z.shape, np.cov(z, ddof=0)
        statistic = m * (z.mean(1) ** 2).sum() + m / 2 * ((np.diag(spread) - 1) ** 2).sum()
        statistic += m * (np.triu(spread, 1) ** 2).sum()
        return float(stats.chi2(2 * d + d * (d - 1) / 2).sf(statistic))

    def log_density_p_value(self, paths: Array) -> float:
        """Return the p-value of the mean changes of the log densities.

        Paths before and after are paired, so that paths that did not move add no noise. The power
        is many times that of `moments_p_value`.
        """
        change = self.log_densities(paths) - self.log_densities(self.paths)
        change = change[:, change.std(0) > 1e-9]
        (m, k), mean = change.shape, change.mean(0)
        if k == 0:
            return 1.0
        t2 = m * mean @ np.linalg.lstsq(np.cov(change.T).reshape(k, k), mean, rcond=None)[0]
        return float(stats.f(k, m - k).sf(t2 * (m - k) / (k * (m - 1))))

    def log_densities(self, paths: Array) -> Array:
        """Return the log densities of a path's factors, [M, 2 STEPS + 1].

        These are log p(x_0), log p(x_j | x_j-1) and log p(y_j | x_j) without constants.
        """
        x, (f, g, h, l0) = (
            paths.reshape(-1, STEPS + 1, 2),
            (getattr(self.model, k).numpy() for k in ("f", "g", "h", "l0")),
        )
        z = np.linalg.solve(l0, (x[:, 0] - self.model.m0.numpy()).T).T
        w = np.linalg.solve(g, (x[:, 1:] - x[:, :-1] @ f.T)[..., None])[..., 0]
        r = (self.y.numpy() - x[:, 1:] @ h.T)[..., 0]
        return np.concatenate(
            [-0.5 * (z**2).sum(-1, keepdims=True), -0.5 * (w**2).sum(-1), -0.5 * r**2], 1
        )


def simulate_path_posterior(noise_sd: float, paths: int) -> PathPosterior:
    """Draw paths of a linear-Gaussian model given simulated measurements.

    Args:
        noise_sd: Standard deviation of the process noise of a walk with constant velocity.
        paths: Number of draws.

    Returns:
        The draws and their distribution.
    """
    model, rng = linear_walk(1.0, noise_sd, 1.0), np.random.default_rng(0)
    f, g, h, l0 = (getattr(model, k).numpy() for k in ("f", "g", "h", "l0"))
    a = np.zeros((PATH_SIZE, PATH_SIZE))  # path = a z, z standard normal: x_0, then the noises
    a[:2, :2] = l0
    for j in range(2, PATH_SIZE, 2):
        a[j : j + 2] = f @ a[j - 2 : j]
        a[j : j + 2, j : j + 2] = g
    look = np.kron(np.eye(STEPS + 1)[1:], h) @ a
    y = look @ rng.normal(size=PATH_SIZE) + rng.normal(size=STEPS)
    precision = np.eye(PATH_SIZE) + look.T @ look
    mean, root = (
        a @ np.linalg.solve(precision, look.T @ y),
        a @ np.linalg.inv(np.linalg.cholesky(precision)).T,
    )
    return PathPosterior(
        model,
        torch.tensor(y)[:, None],
        mean + rng.normal(size=(paths, PATH_SIZE)) @ root.T,
        mean,
        root,
    )


def check_move(
    move: Move | McmcKernel,
    noise_sd: float = 1.0,
    paths: int = 1500,
    mcmc_steps: int = 8,
    min_moved_share: float = 0.05,
    limit: float = 1e-4,
) -> LawCheck:
    """Check that a move leaves p(x_0:k | y_1:k) of a linear-Gaussian model invariant.

    Particles are exact draws of that distribution. After the move the means, variances and
    covariances of the whole path must agree with it, and the mean of each log density must not
    change. A move that stores no states is tested by the newest state alone.

    Args:
        move: Move, or kernel to be used in Metropolis-Hastings steps.
        noise_sd: Standard deviation of the process noise.
        paths: Number of particles.
        mcmc_steps: Metropolis-Hastings steps of a kernel.
        min_moved_share: Share of the particles that must move, for the test to have power.
        limit: Smallest p-value.

    Returns:
        The smaller p-value, with the acceptance rate and the fraction moved as details.

    Raises:
        AssertionError: If the statement does not hold, if too few particles moved, or if the move
            is not repeatable.
        ValueError: If the move is an instance of neither kind.
    """
    check_count("check_move", mcmc_steps=mcmc_steps)
    check_count("check_move", PATH_SIZE, paths=paths)
    chain = _as_move(move, mcmc_steps)
    case = simulate_path_posterior(noise_sd, paths)
    statement = "a move leaves the distribution of the path invariant"
    moved_runs = torch.ones(1, dtype=torch.bool)
    before, stream = case.belief(chain.required_history), PhiloxStream(1, torch.arange(1))
    after, rate = compute_twice(
        "move",
        lambda: chain(case.model, before, moved_runs, stream),
        lambda pair: {"states": pair[0].x},
    )
    result = case.paths_after(after)
    share = float((result != case.paths).any(1).mean())
    assert share >= min_moved_share, (
        f"{statement}: at least {min_moved_share:.0%} of the particles must move to decide, "
        f"got {share:.1%}. Use more steps"
    )
    details = {"accepted": float(rate), "moved": share}
    if "states" not in after.window:
        newest = {
            "moments of the newest state": case.moments_p_value(
                result, slice(PATH_SIZE - 2, PATH_SIZE)
            )
        }
        return check_p_values(statement, newest, limit, **details)
    p_values = {
        "moments of the path": case.moments_p_value(result),
        "mean log densities": case.log_density_p_value(result),
    }
    return check_p_values(statement, p_values, limit, **details)


def _as_move(stage: Any, mcmc_steps: int) -> Any:
    """Return a move, or Metropolis-Hastings steps of a kernel."""
    if isinstance(stage, type) or not hasattr(stage, "required_history"):
        raise ValueError(
            "check_move: stage must be a move or a kernel, with the attribute required_history, got "
            f"{describe_subject(stage, 'MetropolisHastings(LastStateKernel())')}"
        )
    if hasattr(stage, "propose"):
        return MetropolisHastings(stage, mcmc_steps)
    kinds = {"move": ("model", "belief", "resampled", "draws")}
    find_kind("check_move", stage, kinds, "MetropolisHastings(LastStateKernel())")
    return stage
