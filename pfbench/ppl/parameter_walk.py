"""Proposals of particle marginal Metropolis-Hastings, adapted to the chains."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from pfbench.core.random_stream import RandomStream

_TARGET_ACCEPTANCE = 0.25  # near the optimum for few dimensions and a noisy likelihood
_DEGREES_OF_FREEDOM = 5  # of leaps; their tails must be heavier than the posterior's


class ParameterWalk(NamedTuple):
    """Moments of the proposals of each of Q posteriors.

    Attributes:
        mean: Mean of the unconstrained parameters, [Q, P].
        covariance: Covariance of the unconstrained parameters, [Q, P, P].
        log_size: Logarithm of the step size of the random walk, [Q].
    """

    mean: Tensor
    covariance: Tensor
    log_size: Tensor

    def step(self, z: Tensor, stream: RandomStream) -> tuple[Tensor, Tensor]:
        """Propose a step of the random walk.

        Args:
            z: Unconstrained parameters of the chains, [C, Q, P].
            stream: Random stream of the chains.

        Returns:
            Proposals [C, Q, P], and log q(z | new) - log q(new | z), [C, Q].
        """
        e = stream.normal("pmmh.walk", 1, z.shape[-1]).view_as(z)
        root = torch.exp(self.log_size)[:, None, None] * self._root()
        return z + (root @ e.unsqueeze(-1)).squeeze(-1), torch.zeros_like(z[..., 0])

    def leap(self, z: Tensor, stream: RandomStream) -> tuple[Tensor, Tensor]:
        """Propose from a t distribution with the learned moments, independently of z.

        Args:
            z: Unconstrained parameters of the chains, [C, Q, P].
            stream: Random stream of the chains.

        Returns:
            Proposals [C, Q, P], and log q(z) - log q(new), [C, Q].
        """
        e, root = stream.normal("pmmh.leap", 1, z.shape[-1]).view_as(z), self._root()
        chi2 = stream.normal("pmmh.tail", 1, _DEGREES_OF_FREEDOM).square().mean(-1)
        scale = chi2.view_as(z[..., 0]).rsqrt().unsqueeze(-1)
        deviation = (z - self.mean).unsqueeze(-1)
        whitened = torch.linalg.solve_triangular(root, deviation, upper=False).squeeze(-1)
        proposed_z = self.mean + scale * (root @ e.unsqueeze(-1)).squeeze(-1)
        return proposed_z, _log_t_density(whitened) - _log_t_density(scale * e)

    def adapt(self, z: Tensor, acceptance: Tensor | None, rate: float) -> ParameterWalk:
        """Update the moments by stochastic approximation.

        Args:
            z: Unconstrained parameters of the chains, [C, Q, P].
            acceptance: Mean probability of acceptance of the step, [Q]. None after a leap.
            rate: Weight of the update.

        Returns:
            The updated walk.
        """
        d = z - self.mean
        spread = (d.unsqueeze(-1) * d.unsqueeze(-2)).mean(0)
        log_size = self.log_size
        if acceptance is not None:
            log_size = log_size + rate * (acceptance - _TARGET_ACCEPTANCE)
        covariance = self.covariance + rate * (spread - self.covariance)
        return ParameterWalk(self.mean + rate * d.mean(0), covariance, log_size)

    def _root(self) -> Tensor:
        eye = torch.eye(self.mean.shape[-1], dtype=self.mean.dtype)
        return torch.linalg.cholesky(self.covariance + 1e-6 * eye)


def _log_t_density(a: Tensor) -> Tensor:
    """Return the log density of a whitened t distribution, up to a constant."""
    exponent = -0.5 * (_DEGREES_OF_FREEDOM + a.shape[-1])
    return exponent * torch.log1p(a.square().sum(-1) / _DEGREES_OF_FREEDOM)
