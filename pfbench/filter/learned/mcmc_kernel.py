"""Learned Metropolis-Hastings kernel: a network proposes noise steps."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.distributions import Distribution, Normal

from pfbench.core.parameter_checks import require, require_range
from pfbench.core.random_stream import RandomStream
from pfbench.filter.belief import ParticleBelief
from pfbench.filter.learned.differentiable_resampling import sample_from
from pfbench.filter.learned.networks import CheckpointSpec, build_networks
from pfbench.filter.learned.proposal import NetworkFactory
from pfbench.filter.linearisation import unwrap_independent
from pfbench.filter.moves.metropolis import McmcKernel, StateHistory, concatenate_histories
from pfbench.filter.moves.path_kernels import propagate_path
from pfbench.filter.particle.proposals import log_standard_normal
from pfbench.model.base import StateSpaceModel

_LIMIT = 10.0


class LearnedRandomWalk(nn.Module, McmcKernel):
    """Random walk of the last `lag` noises with a learned distribution of the step.

    The noises move by h delta, and the path from the state before them follows [after Song et al.
    2017; Levy, Hoffman, Sohl-Dickstein 2018]. The target is p(w_t-L+1:t | x_t-L, y), which needs no
    transition density, and

        log beta = log p(w') - log p(w) + sum_j log p(y_j | x'_j) - log p(y_j | x_j)
                   + log q(-delta | path') - log q(delta | path).

    The network input is the path alone, never the other particles, so each chain leaves its target
    exactly invariant. With the initial output N(0, I) it is a random walk. Particles do not move
    before the window holds `lag` noises. [ours]

    Args:
        network: Makes the module, as for `LearnedProposal`. Its features are 2 numbers per measurement and
            1 per noise of the path.
        lag: L, at least 1. The cost is L model steps.
        scale: h times the root of the number of moved components. 2.38 is best for a random walk
            in a normal distribution.
        checkpoint: As for `LearnedProposal`.
        seed: As for `LearnedProposal`.

    Raises:
        ValueError: If `lag` is below 1 or the scale not positive. On use, as for
            `LearnedProposal`, and if the noise is not normal.
    """

    is_exact = True
    checkpoint_key = "kernel"

    def __init__(
        self,
        network: NetworkFactory,
        lag: int = 1,
        scale: float = 2.38,
        checkpoint: str | None = "untrained",
        seed: int = 0,
    ) -> None:
        super().__init__()
        require_range("kernel.lag", lag, "[1, inf]")
        require_range("kernel.scale", scale, "(0, inf] The default is 2.38.")
        self.make, self.lag, self.scale = network, lag, scale
        self.learnable = CheckpointSpec(self.checkpoint_key, checkpoint, seed)
        self.network: nn.Module | None = None
        self.sizes = 0, 0, 0

    @property
    def required_history(self) -> StateHistory:
        """History that the kernel needs."""
        return StateHistory(self.lag, store_noise=True)

    def build(self, model: StateSpaceModel, measurement_size: int, fresh: bool = False) -> None:
        """Build the network and load the checkpoint.

        Args:
            model: State-space model.
            measurement_size: Number of measurement components.
            fresh: Start from untrained weights.
        """
        features = self.lag * (2 * measurement_size + model.noise_dim)
        noise = self.lag * model.noise_dim
        self.sizes = features, noise, 0
        self.network = build_networks(
            self.learnable,
            lambda: {"network": self.make(features, noise)},
            self.sizes,
            model,
            fresh,
        )["network"]

    def propose(
        self, model: StateSpaceModel, belief: ParticleBelief, draws: RandomStream
    ) -> tuple[ParticleBelief, Tensor]:
        """Propose new noises.

        Args:
            model: State-space model.
            belief: Particles with a window of states and noises.
            draws: Random numbers.

        Returns:
            Proposed belief and log acceptance ratio, [R, N].
        """
        proposed, log_alpha, _ = self.propose_step(model, belief, draws)
        return proposed, log_alpha

    def propose_step(
        self, model: StateSpaceModel, belief: ParticleBelief, draws: RandomStream
    ) -> tuple[ParticleBelief, Tensor, Tensor]:
        """Propose new noises.

        Args:
            model: State-space model.
            belief: Particles with a window of states and noises.
            draws: Random numbers.

        Returns:
            Proposed belief, log acceptance ratio [R, N] and step h delta [R, N, L W].
        """
        noise = belief.window["noise"]
        require(
            isinstance(unwrap_independent(model.noise), Normal),
            "kernel LearnedRandomWalk",
            "have a model whose noise is normal",
            f"{type(model).__name__}, whose noise is not normal",
            "Choose another kernel.",
        )
        if noise.shape[2] < self.lag:
            return (
                belief,
                torch.zeros_like(belief.log_w),
                belief.x.new_zeros(*belief.log_w.shape, self.lag * model.noise_dim),
            )
        if self.network is None:
            self.build(model, belief.past[-1].y.shape[-1])
        noise_distribution: Any = model.noise
        xi = (
            (noise[:, :, -self.lag :] - noise_distribution.mean) / noise_distribution.stddev
        ).flatten(2)
        forward_step = self._step_distribution(model, belief, xi)
        delta = sample_from(
            forward_step, draws.normal("learned.walk", *xi.shape[1:]), draws, "learned.walk"
        )
        h = self.scale * xi.shape[-1] ** -0.5
        new = xi + h * delta
        new_noise = noise_distribution.mean + noise_distribution.stddev * new.unflatten(
            2, (self.lag, -1)
        )
        proposed, log_likelihood_change = self._propagated(model, belief, new_noise)
        reverse_step = self._step_distribution(model, proposed, new)
        log_alpha = (
            log_likelihood_change
            + log_standard_normal(new)
            - log_standard_normal(xi)
            + reverse_step.log_prob(-delta)
            - forward_step.log_prob(delta)
        )
        return proposed, log_alpha, h * delta

    def _propagated(
        self, model: StateSpaceModel, belief: ParticleBelief, noise: Tensor
    ) -> tuple[ParticleBelief, Tensor]:
        """Propagate the paths under new noises and return the change of log likelihood."""
        window, first = belief.window, -self.lag - 1
        states, log_like = propagate_path(
            model, window["states"][:, :, first], noise, belief.past[first:]
        )
        new_window = {"states": states[:, :, 1:], "log_like": log_like[:, :, 1:], "noise": noise}
        change = (new_window["log_like"] - window["log_like"][:, :, -self.lag :]).sum(-1)
        updated = {
            name: concatenate_histories([window[name][:, :, : -self.lag], new])
            for name, new in new_window.items()
        }
        return belief._replace(x=states[:, :, -1], window=window | updated), change

    def _step_distribution(
        self, model: StateSpaceModel, belief: ParticleBelief, xi: Tensor
    ) -> Distribution:
        """Return the step distribution given innovations, observed masks and noises."""
        inputs = [torch.asinh(xi)]
        for j, record in enumerate(belief.past[-self.lag :]):
            states = belief.window["states"][:, :, j - self.lag]
            distribution: Any = model.observation(states, record.u)
            observed_mask = ~torch.isnan(record.y).unsqueeze(1)
            y = record.y.nan_to_num().unsqueeze(1)
            r = torch.where(observed_mask, model.residual(y, distribution.mean), 0.0)
            inputs += [torch.asinh(r / distribution.stddev), observed_mask.to(r).expand_as(r)]
        features = torch.nan_to_num(torch.cat(inputs, -1), 0.0, _LIMIT, -_LIMIT)
        features = features.clamp(-_LIMIT, _LIMIT)
        assert self.network is not None
        value: Distribution = self.network(features)
        return value
