"""MCMC moves of particles after resampling.

A kernel leaves the distribution of a particle's path given the record invariant. A move makes
copies distinct and keeps the target.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require_ranges
from pfbench.core.random_stream import RandomStream, relabel, select_runs
from pfbench.core.record import Record, map_inputs
from pfbench.filter.belief import ParticleBelief, weighted_mean_cov
from pfbench.filter.exactness import is_every_part_exact
from pfbench.model.base import StateSpaceModel, StaticModel

# A particle stores everything that a kernel reads. Kernels do not look up parents.


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
            if w is None:
                raise ValueError(
                    "filter.proposal must return its noise if moves use it again, got None. "
                    "Choose BootstrapProposal."
                )
            mean, covariance = weighted_mean_cov(model.chart, after)
            additions |= {"noise": w, "mean": mean[:, None], "covariance": covariance[:, None]}
        window = {
            name: concatenate_histories([before.window[name][:, :, old:], new.unsqueeze(2)])
            for name, new in additions.items()
        }
        if old:
            past = (_unobserved(past[old]), *past[old + 1 :])
            window["log_like"][:, :, 0] = 0.0
        return after._replace(window=window, past=past)


def combine_histories(histories: Sequence[PathHistory | None]) -> PathHistory | None:
    """Merge the histories that several moves require.

    Returns the joint history, or None if all moves work without one.
    """
    joint: PathHistory | None = None
    for history in histories:
        if history is not None:
            joint = history if joint is None else joint.merge(history)
    return joint


def get_transition(
    model: StateSpaceModel, x: Tensor, record: Record
) -> torch.distributions.Distribution:
    """Return the distribution of the next state of a model with a transition density.

    Shapes: x [R, N, D].
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


class Move(Protocol):
    """MCMC move of the particles of resampled runs."""

    @property
    def is_exact(self) -> bool:
        """True if the move leaves p(x_0:t | y_1:t) invariant."""

    @property
    def required_history(self) -> PathHistory | None:
        """History that the particles must store."""

    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, resampled: Tensor, draws: RandomStream
    ) -> tuple[ParticleBelief, Tensor]:
        """Move the particles.

        Args:
            model: State-space model of the step.
            belief: Particles after resampling, with their history.
            resampled: Mask of the resampled runs, [R].
            draws: Random stream of the move.

        Returns:
            Moved particles and acceptance rate [R], 0 in other runs.
        """


class McmcKernel(Protocol):
    """Proposal of paths for Metropolis-Hastings steps."""

    @property
    def is_exact(self) -> bool:
        """True if Metropolis-Hastings steps with it leave p(x_0:t | y_1:t) invariant."""

    @property
    def required_history(self) -> PathHistory:
        """History that the particles must store."""

    def propose(
        self, model: StateSpaceModel, belief: ParticleBelief, draws: RandomStream
    ) -> tuple[ParticleBelief, Tensor]:
        """Propose paths.

        Args:
            model: State-space model of the step.
            belief: Particles with their history.
            draws: Random stream of the Metropolis-Hastings step.

        Returns:
            Proposed particles and log Metropolis-Hastings ratio [R, N]. NaN is never accepted.
        """

    def shorten(self, model: StateSpaceModel, belief: ParticleBelief) -> ParticleBelief:
        """Return the particles without the part of their history that follows from the rest.

        The steps of a sweep then neither propose nor select it, and `complete` restores it after the last one.

        Args:
            model: State-space model of the step.
            belief: Particles with their history.

        Returns:
            Particles that `propose` accepts.
        """
        return belief

    def complete(
        self,
        model: StateSpaceModel,
        short: ParticleBelief,
        before: ParticleBelief,
        accepted: Tensor,
    ) -> ParticleBelief:
        """Return moved particles with the whole history again.

        Args:
            model: State-space model of the step.
            short: Shortened particles after the last step.
            before: Whole particles before the first step.
            accepted: Mask of particles that moved, [R, N].

        Returns:
            Particles with the history that their steps would have had without `shorten`.
        """
        return short


@dataclass(frozen=True)
class MetropolisHastings(Move):
    """Metropolis-Hastings steps, one chain per particle [Gilks and Berzuini 2001].

    Attributes:
        kernel: Proposal of a step.
        mcmc_steps: Steps after each resampling. 0 makes no move.

    Raises:
        ValueError: If the number of steps is negative.
    """

    kernel: McmcKernel
    mcmc_steps: int = 1

    def __post_init__(self) -> None:
        require_ranges("move", self, mcmc_steps="[0, inf]")

    @property
    @override
    def is_exact(self) -> bool:
        return self.mcmc_steps == 0 or is_every_part_exact(**{"move.kernel": self.kernel})

    @property
    @override
    def required_history(self) -> PathHistory | None:
        return self.kernel.required_history if self.mcmc_steps else None

    @override
    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, resampled: Tensor, draws: RandomStream
    ) -> tuple[ParticleBelief, Tensor]:
        rate = torch.zeros_like(belief.log_w[:, 0])
        if self.mcmc_steps == 0:
            return belief, rate
        if belief.x.is_cuda:  # a mask is cheaper than waiting for the number of runs
            short = self.kernel.shorten(model, belief)
            swept, accepted = self._sweep(model, short, draws)
            rate = torch.where(resampled, self._rate(accepted, belief.log_w), rate)
            short = _replace_runs(short, swept, None, resampled)
            accepted = accepted * resampled.unsqueeze(1)
            return self.kernel.complete(model, short, belief, accepted > 0.0), rate
        rows = resampled.nonzero().squeeze(1)
        if len(rows) == 0:
            return belief, rate
        short = self.kernel.shorten(model, belief)
        selected = _select_runs(short, rows)
        swept, count = self._sweep(model, selected, select_runs(draws, rows))
        rate = rate.index_copy(0, rows, self._rate(count, swept.log_w))
        unchanged = {k for k, a in selected.window.items() if swept.window[k] is a}
        window = swept.window | {k: short.window[k] for k in unchanged}
        short = _replace_runs(short, swept._replace(window=window), rows, resampled)
        accepted = torch.zeros_like(belief.log_w).index_copy(0, rows, count)
        return self.kernel.complete(model, short, belief, accepted > 0.0), rate

    def _sweep(
        self, model: StateSpaceModel, belief: ParticleBelief, draws: RandomStream
    ) -> tuple[ParticleBelief, Tensor]:
        active_mask = torch.isfinite(belief.log_w)
        accepted = torch.zeros_like(belief.log_w)
        for sweep in range(self.mcmc_steps):
            step_draws = relabel(draws, f"sweep_{sweep}.")
            proposed, log_alpha = self.kernel.propose(model, belief, step_draws)
            log_u = torch.log(step_draws.uniform("accept", active_mask.shape[1], 1).squeeze(2))
            accept = log_u < log_alpha  # never where it is NaN
            window = {k: _where(accept, proposed.window[k], a) for k, a in belief.window.items()}
            belief = belief._replace(x=_where(accept, proposed.x, belief.x), window=window)
            accepted = accepted + (accept & active_mask)
        if belief.ancestors is not None:
            n = active_mask.shape[1]
            moved_slots = torch.arange(n, 2 * n, device=accepted.device)
            ancestors = torch.where(accepted > 0.0, moved_slots, belief.ancestors)
            belief = belief._replace(ancestors=ancestors)
        return belief, accepted

    def _rate(self, accepted: Tensor, log_w: Tensor) -> Tensor:
        return accepted.sum(1) / (self.mcmc_steps * torch.isfinite(log_w).sum(1))


def _select_runs(belief: ParticleBelief, rows: Tensor) -> ParticleBelief:
    """Return some runs of a belief, without its memory."""
    runs = belief.x.shape[0]
    if len(rows) == runs:
        return belief

    def select_rows(a: Tensor) -> Tensor:
        order = (*range(2, a.dim()), 0, 1)
        back = (a.dim() - 2, a.dim() - 1, *range(a.dim() - 2))
        return a.permute(order).index_select(a.dim() - 2, rows).permute(back)

    def select_input(a: Tensor) -> Tensor:
        return a[rows] if len(a) == runs else a

    return ParticleBelief(
        x=select_rows(belief.x),
        log_w=belief.log_w[rows],
        log_evidence=belief.log_evidence[rows],
        window={name: select_rows(a) for name, a in belief.window.items()},
        past=tuple(
            Record(record.y[rows], map_inputs(select_input, record.u)) for record in belief.past
        ),
        ancestors=None if belief.ancestors is None else belief.ancestors[rows],
    )


def _replace_runs(
    belief: ParticleBelief, moved_belief: ParticleBelief, rows: Tensor | None, resampled: Tensor
) -> ParticleBelief:
    """Return a belief with the states and windows of the moved runs.

    Tensors that all particles of a run share do not change.
    """

    def replace(old: Tensor, new: Tensor) -> Tensor:
        if old.shape[1] == 1 or old is new:
            return old
        if rows is None:
            return _where(resampled.unsqueeze(1), new, old)
        if len(rows) == len(old):
            return new
        last = (*range(2, old.dim()), 0, 1)  # order in memory
        back = (old.dim() - 2, old.dim() - 1, *range(old.dim() - 2))
        return old.permute(last).index_copy(old.dim() - 2, rows, new.permute(last)).permute(back)

    window = {name: replace(old, moved_belief.window[name]) for name, old in belief.window.items()}
    ancestors = None
    if belief.ancestors is not None and moved_belief.ancestors is not None:
        ancestors = replace(belief.ancestors, moved_belief.ancestors)
    return belief._replace(x=replace(belief.x, moved_belief.x), window=window, ancestors=ancestors)


def _where(mask: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """Select among [R, N, ...] by a mask [R, N or 1]; what is the same object remains it."""
    if new is old:
        return old
    return torch.where(mask.reshape(*mask.shape, *[1] * (old.dim() - 2)), new, old)
