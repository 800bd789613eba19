"""Histories that particles store for MCMC kernels, and how they grow step by step.

A particle stores everything that a kernel reads. Kernels do not look up parents.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief, weighted_mean_cov
from pfbench.model.base import StateSpaceModel, StaticModel


class PathHistory(Protocol):
    """History that particles store for a kernel in the window of the belief."""

    def start(
        self, model: StateSpaceModel, belief: ParticleBelief, mean: Tensor, covariance: Tensor
    ) -> ParticleBelief:
        """Add the window to the first belief.

        Args:
            model: State-space model.
            belief: Initial particles.
            mean: Mean of the initial distribution, [R, D].
            covariance: Covariance of the initial distribution, [R, d, d].

        Returns:
            Initial particles with a window.
        """

    def append(
        self,
        model: StateSpaceModel,
        before: ParticleBelief,
        after: ParticleBelief,
        w: Tensor | None,
        record: Record,
    ) -> ParticleBelief:
        """Extend the window of `before` by one step and attach it to `after`.

        Args:
            model: State-space model.
            before: Parents of the particles, slot by slot.
            after: Particles after the step.
            w: Noise of the step, [R, N, W], or None if the proposal does not return it.
            record: Record of the step.

        Returns:
            Particles after the step, with a window.
        """

    def merge(self, history: PathHistory) -> PathHistory:
        """Merge two histories into one for the kernels of both.

        Args:
            history: History that another kernel requires.

        Returns:
            Joint history.

        Raises:
            ValueError: If the kernels cannot move the same particles.
        """


@dataclass(frozen=True)
class StateHistory(PathHistory):
    """Last steps of each particle. `past` of the belief contains their records.

    The window begins at x_s, s = max(0, t - lag), with K = t - s: `states` [R, N, K+1, D] and
    `log_like` [R, N, K+1]. The first log likelihood is 0 unless x_0 itself was measured, since the
    distribution of x_s with s > 0 contains all measurements up to s.

    Attributes:
        lag: Maximum of K.
        store_noise: Also store the noises between the states, `noise` [R, N, K, W]. Store also the
            filtered distribution of each state (for x_0 the model's), `mean` [R, 1, K+1, D] and
            `covariance` [R, 1, K+1, d, d].
        store_density: The kernels need the transition density of the model. Nothing is stored for
            it: the first step checks that the density exists.
    """

    lag: int
    store_noise: bool = False
    store_density: bool = False

    @override
    def merge(self, history: PathHistory) -> PathHistory:
        if not isinstance(history, StateHistory):
            return history.merge(self)
        return StateHistory(
            max(self.lag, history.lag),
            self.store_noise or history.store_noise,
            self.store_density or history.store_density,
        )

    @override
    def start(
        self, model: StateSpaceModel, belief: ParticleBelief, mean: Tensor, covariance: Tensor
    ) -> ParticleBelief:
        window = {
            "states": belief.x.unsqueeze(2),
            "log_like": torch.zeros_like(belief.log_w).unsqueeze(2),
        }
        if self.store_noise:
            window["noise"] = belief.x.new_zeros(*belief.x.shape[:2], 0, model.noise_dim)
            window |= {"mean": mean[:, None, None], "covariance": covariance[:, None, None]}
        return belief._replace(window=window)

    @override
    def append(
        self,
        model: StateSpaceModel,
        before: ParticleBelief,
        after: ParticleBelief,
        w: Tensor | None,
        record: Record,
    ) -> ParticleBelief:
        """Append the newest state, and drop states beyond the lag."""
        log_like = model.log_likelihood(record.y, after.x, record.u)
        if isinstance(model, StaticModel):  # x_0 itself is measured
            window = before.window | {
                "states": after.x.unsqueeze(2),
                "log_like": log_like.unsqueeze(2),
            }
            return after._replace(window=window, past=(record,))
        if self.store_density and len(before.past) < 2:
            get_transition(model, after.x[:, :1], record)
        past = (*(before.past or (_unobserved(record),)), record)
        old = max(0, len(past) - 1 - self.lag)
        additions = {"states": after.x, "log_like": log_like}
        if self.store_noise:
            additions |= _noise_history(model, after, w)
        window = {
            name: concatenate_histories([before.window[name][:, :, old:], new.unsqueeze(2)])
            for name, new in additions.items()
        }
        if old:
            past = (_unobserved(past[old]), *past[old + 1 :])
            zeros = torch.zeros_like(window["log_like"][:, :, :1])
            window["log_like"] = concatenate_histories([zeros, window["log_like"][:, :, 1:]])
        return after._replace(window=window, past=past)


def combine_histories(histories: Sequence[PathHistory | None]) -> PathHistory | None:
    """Merge the histories that several moves require.

    Args:
        histories: History of each move, or None for a move without one.

    Returns:
        The joint history, or None if all moves work without one.
    """
    joint: PathHistory | None = None
    for history in histories:
        if history is not None:
            joint = history if joint is None else joint.merge(history)
    return joint


def _noise_history(
    model: StateSpaceModel, belief: ParticleBelief, w: Tensor | None
) -> dict[str, Tensor]:
    """Return the noise of a step and the filtered distribution after it."""
    if w is None:
        raise ValueError(
            "filter.proposal must return its noise if moves use it again, got None. "
            "Choose BootstrapProposal."
        )
    mean, covariance = weighted_mean_cov(model.chart, belief)
    return {"noise": w, "mean": mean.unsqueeze(1), "covariance": covariance.unsqueeze(1)}


def get_transition(
    model: StateSpaceModel, x: Tensor, record: Record
) -> torch.distributions.Distribution:
    """Return the distribution of the next state of a model with a transition density.

    Args:
        model: State-space model.
        x: States, [R, N, D].
        record: Record of the step.

    Raises:
        ValueError: If the transition density does not exist.
    """
    distribution = model.transition(x, record.u)
    if distribution is None:
        raise ValueError(
            "filter.moves must have a model with a density of x_t given x_t-1, got "
            f"{type(model).__name__}. Choose NoiseFlowKernel, which needs no density, "
            "or a model with process noise inflation."
        )
    return distribution


def concatenate_histories(histories: Sequence[Tensor]) -> Tensor:
    """Concatenate histories [R, N, L, ...] along L, with contiguous steps in memory."""
    dims = histories[0].dim()
    joined = torch.cat([a.permute(*range(2, dims), 0, 1) for a in histories])
    return joined.permute(dims - 2, dims - 1, *range(dims - 2))


def stack_history(steps: Sequence[Tensor]) -> Tensor:
    """Stack the values of steps [R, N, ...] to a history [R, N, L, ...]."""
    return concatenate_histories([a.unsqueeze(2) for a in steps])


def _unobserved(record: Record) -> Record:
    """Replace all measurements of a record by NaN."""
    return record._replace(y=torch.full_like(record.y, torch.nan))
