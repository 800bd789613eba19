"""Conditional sequential Monte Carlo with ancestor sampling, in noise space."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.random_stream import RandomStream
from pfbench.filter.smoothing.backward_samplers import draw_by_weight
from pfbench.filter.smoothing.noise_space import NoiseSpace
from pfbench.filter.smoothing.path_kernels import PathKernel


@dataclass(frozen=True)
class ConditionalSmcKernel(PathKernel):
    """Conditional particle filter: the present path is one of its particles.

    With ancestor sampling the parent of the present path's future is drawn at each step. Its
    probability is the weight of the parent times the likelihood of all later measurements
    along the path that starts there with the noises of the future. The densities of these noises
    cancel. A kernel then takes T^2 N / 2 propagations, and T N without ancestor sampling.

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
        if self.particles < 2:
            raise ValueError(
                f"kernel.particles must be at least 2, got {self.particles}. Increase it."
            )

    @override
    def __call__(
        self, space: NoiseSpace, theta: Tensor, draws: RandomStream
    ) -> tuple[Tensor, Tensor]:
        d = space.model.chart.dimension
        noises = [self._draw(theta[..., :d], draws.at_step(0))]
        x = space.start(noises[0].flatten(1, 2))
        log_w, parents = torch.zeros_like(noises[0][..., 0]), []
        for t, _ in enumerate(space.steps):
            stream = draws.at_step(t + 1)
            u = stream.uniform("parent", theta.shape[1], self.particles)
            slots = draw_by_weight(log_w.flatten(0, 1), u.flatten(0, 1)).view(log_w.shape)
            slots[..., -1] = self._draw_parent(space, theta, t, x, log_w, stream)
            parents.append(slots)
            noises.append(self._draw(space.noise(theta, t), stream))
            x = _take(x.unflatten(1, log_w.shape[1:]), slots).flatten(1, 2)
            x, log_likelihood = space.advance(t, x, noises[-1].flatten(1, 2))
            log_w = log_likelihood.view(log_w.shape)
        u = draws.at_step(len(space.steps) + 1).uniform("path", theta.shape[1], 1)
        slot = draw_by_weight(log_w.flatten(0, 1), u.flatten(0, 1)).view(*log_w.shape[:2], 1)
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
        draws: RandomStream,
    ) -> Tensor:
        """Draw the slot [R, M] of the parent of the present path's future."""
        if not self.sample_ancestors:
            return torch.full(log_w.shape[:2], self.particles - 1, device=log_w.device)
        future = theta.repeat_interleave(self.particles, 1)
        for s in range(t, len(space.steps)):
            x, log_likelihood = space.advance(s, x, space.noise(future, s))
            log_w = log_w + log_likelihood.view(log_w.shape)
        u = draws.uniform("ancestor", log_w.shape[1], 1).flatten(0, 1)
        return draw_by_weight(log_w.flatten(0, 1), u).view(log_w.shape[:2])


def _take(values: Tensor, slots: Tensor) -> Tensor:
    """Gather [R, M, n, k] of values [R, M, N, k] by slots [R, M, n]."""
    return values.gather(2, slots.unsqueeze(-1).expand(*slots.shape, values.shape[-1]))
