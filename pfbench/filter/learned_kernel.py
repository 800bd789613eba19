"""A learned kernel of Metropolis-Hastings: a network says where to and how far the newest noises step, the ratio what counts."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.distributions import Distribution, Normal

from pfbench.draws import Draws
from pfbench.filter.belief import Cloud
from pfbench.filter.kernels import replay
from pfbench.filter.learned import Make
from pfbench.filter.learned_draws import drawn
from pfbench.filter.learned_laws import log_standard
from pfbench.filter.learned_weights import Learnable, made
from pfbench.filter.linearisation import base
from pfbench.filter.window import Path, join
from pfbench.model.base import StateSpaceModel

_LIMIT = 10.0


class LearnedWalk(nn.Module):
    """The last `depth` noises of each particle step by h delta, delta from a law that a network gives [after Song et al. 2017;
    Levy, Hoffman, Sohl-Dickstein 2018], and the path from the state before them follows.

    The target is p(w_t-L+1:t | x_t-L, y), which needs no density of the transition, and

        log beta = log p(w') - log p(w) + sum_j log p(y_j | x'_j) - log p(y_j | x_j)
                   + log q(-delta | path') - log q(delta | path).

    The network is told of the path itself alone, never of the cloud, so that each chain leaves its target as it is exactly. A law
    N(0, I), with which a network begins, makes it a random walk. No particle moves before the window holds `depth` noises. [ours]

    Args:
        network: makes the module, as of Learned; it is told 2 numbers for each measurement and 1 for each noise of the path.
        depth: L, at least 1; costs L model steps.
        scale: h times the root of the number of components that step; 2.38 is best for a random walk in a normal law.
        checkpoint, seed: as of Learned.

    Raises:
        ValueError: depth below 1, a scale that is not positive; on use as Learned, and noise that is not normal.
    """

    exact = True
    part = "kernel"

    def __init__(
        self, network: Make, depth: int = 1, scale: float = 2.38, checkpoint: str | None = "untrained", seed: int = 0
    ) -> None:
        super().__init__()
        if depth < 1 or not scale > 0.0:
            raise ValueError(f"kernel: depth={depth}, scale={scale}; give at least one noise that steps and a positive scale")
        self.make, self.depth, self.scale = network, depth, scale
        self.learnable = Learnable(self.part, checkpoint, seed)
        self.network: nn.Module | None = None
        self.sizes = 0, 0, 0

    @property
    def keeps(self) -> Path:
        return Path(self.depth, driven=True)

    def begin(self, model: StateSpaceModel, seen: int, fresh: bool = False) -> None:
        """Makes the network for measurements of `seen` components and fills it from the checkpoint, unless it starts afresh."""
        features, noise = self.depth * (2 * seen + model.noise_dim), self.depth * model.noise_dim
        self.sizes = features, noise, 0
        self.network = made(self.learnable, lambda: {"network": self.make(features, noise)}, self.sizes, model, fresh)["network"]

    def propose(self, model: StateSpaceModel, cloud: Cloud, draws: Draws) -> tuple[Cloud, Tensor]:
        moved, log_alpha, _ = self.step(model, cloud, draws)
        return moved, log_alpha

    def step(self, model: StateSpaceModel, cloud: Cloud, draws: Draws) -> tuple[Cloud, Tensor, Tensor]:
        """The proposed cloud, the log of the ratio [R, N], and the step h delta that was tried [R, N, L W]."""
        noise = cloud.window["noise"]
        if not isinstance(base(model.noise), Normal):
            raise ValueError(f"kernel: the noise of {type(model).__name__} is not normal; LearnedWalk steps in normal noise only")
        if noise.shape[2] < self.depth:
            return cloud, torch.zeros_like(cloud.log_w), cloud.x.new_zeros(*cloud.log_w.shape, self.depth * model.noise_dim)
        if self.network is None:
            self.begin(model, cloud.past[-1].y.shape[-1])
        law: Any = model.noise
        xi = ((noise[:, :, -self.depth :] - law.mean) / law.stddev).flatten(2)
        ahead = self._law(model, cloud, xi)
        delta = drawn(ahead, draws.normal("learned.walk", *xi.shape[1:]), draws, "learned.walk")
        h = self.scale * xi.shape[-1] ** -0.5
        new = xi + h * delta
        moved, gain = self._followed(model, cloud, law.mean + law.stddev * new.unflatten(2, (self.depth, -1)))
        back = self._law(model, moved, new)
        log_alpha = gain + log_standard(new) - log_standard(xi) + back.log_prob(-delta) - ahead.log_prob(delta)
        return moved, log_alpha, h * delta

    def _followed(self, model: StateSpaceModel, cloud: Cloud, noise: Tensor) -> tuple[Cloud, Tensor]:
        """The cloud whose paths follow from these newest noises, and the change of their log-likelihood [R, N]."""
        window, first = cloud.window, -self.depth - 1
        states, log_like = replay(model, window["states"][:, :, first], noise, cloud.past[first:])
        news = {"states": states[:, :, 1:], "log_like": log_like[:, :, 1:], "noise": noise}
        gain = (news["log_like"] - window["log_like"][:, :, -self.depth :]).sum(-1)
        kept = {name: join([window[name][:, :, : -self.depth], new]) for name, new in news.items()}
        return cloud._replace(x=states[:, :, -1], window=window | kept), gain

    def _law(self, model: StateSpaceModel, cloud: Cloud, xi: Tensor) -> Distribution:
        """The law of delta: the network is told each innovation of the path in noise deviations, what was seen, and noises."""
        parts = [torch.asinh(xi)]
        for j, seen in enumerate(cloud.past[-self.depth :]):
            law: Any = model.observation(cloud.window["states"][:, :, j - self.depth], seen.u)
            there = ~torch.isnan(seen.y).unsqueeze(1)
            r = torch.where(there, model.residual(seen.y.nan_to_num().unsqueeze(1), law.mean), 0.0)
            parts += [torch.asinh(r / law.stddev), there.to(r).expand_as(r)]
        told = torch.nan_to_num(torch.cat(parts, -1), 0.0, _LIMIT, -_LIMIT).clamp(-_LIMIT, _LIMIT)
        assert self.network is not None
        value: Distribution = self.network(told)
        return value
