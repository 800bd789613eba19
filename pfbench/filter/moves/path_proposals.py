"""Path proposals between two states by forward filtering and backward sampling."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.linear_algebra import distribution_covariance, factor
from pfbench.core.parameter_checks import require
from pfbench.core.random_stream import RandomStream, relabel
from pfbench.core.record import Record
from pfbench.filter.linearisation import (
    batch_product,
    linearised_innovation,
    mask_covariance,
    mean_noise,
    measurement_jacobian,
    transition_jacobian,
)
from pfbench.filter.moves.metropolis import get_transition, stack_history
from pfbench.filter.particle.stages import draw_noise
from pfbench.model.base import StateSpaceModel


class PathSegment(NamedTuple):
    """End of a path.

    Attributes:
        states: Fixed state, re-drawn states and child, [R, N, L+2, D].
        records: Records of all but the first state.
    """

    states: Tensor
    records: tuple[Record, ...]


class SegmentProposal(Protocol):
    """Distribution g of the states between the fixed one and the child."""

    @property
    def is_exact(self) -> bool:
        """True if the returned ratio belongs to g."""

    def __call__(
        self, model: StateSpaceModel, old: PathSegment, child: Tensor, draws: RandomStream
    ) -> tuple[Tensor, Tensor]:
        """Draw the states between the fixed one and the child.

        Args:
            model: State-space model.
            old: Present end of the path.
            child: Proposed child, [R, N, D].
            draws: Random stream.

        Returns:
            States [R, N, L, D], and a log ratio [R, N]: log g of the old states given the old
            child, minus log g of the new ones. The ratio is None if g without a density replaces
            p(block | fixed state, y).
        """


def measurement_log_density(model: StateSpaceModel, path: PathSegment) -> Tensor:
    """Compute log p(y_j | x_j) along the end of a path.

    Returns log densities, [R, N, L+1].
    """
    return stack_history(
        [
            model.log_likelihood(record.y, path.states[:, :, j + 1], record.u)
            for j, record in enumerate(path.records)
        ]
    )


def transition_log_density(model: StateSpaceModel, path: PathSegment) -> Tensor:
    """Compute log p(x_j | x_j-1) along the end of a path.

    Returns log densities, [R, N, L+1].
    """
    x = path.states
    return stack_history(
        [
            get_transition(model, x[:, :, j], record).log_prob(x[:, :, j + 1])
            for j, record in enumerate(path.records)
        ]
    )


def driving_noise(model: StateSpaceModel, path: PathSegment) -> Tensor:
    """Compute the noises that lead from state to state.

    Returns noises, [R, N, L+1, W].
    """
    noises = []
    for j, record in enumerate(path.records):
        gain, x = model.noise_gain(record.u), path.states[:, :, j]
        require(
            gain is not None and gain.shape[-2] == gain.shape[-1],
            "filter.moves",
            "not combine this kernel with NoiseFlowKernel for a model whose states do not determine its noise",
            type(model).__name__,
            "Remove one of the kernels.",
        )
        prediction = model.propagate(x, record.u, mean_noise(model, x))
        r = model.chart.subtract(path.states[:, :, j + 1], prediction)
        noises.append(model.noise.mean + torch.linalg.solve_ex(gain, r.mT)[0].mT)
    return stack_history(noises)


@dataclass(frozen=True)
class PriorSegment(SegmentProposal):
    """Block from the model's dynamics, which is rarely accepted.

    The block depends neither on the measurements nor on the child.
    """

    is_exact = True

    @override
    def __call__(
        self, model: StateSpaceModel, old: PathSegment, child: Tensor, draws: RandomStream
    ) -> tuple[Tensor, Tensor]:
        states = [old.states[:, :, 0]]
        for j, record in enumerate(old.records[:-1]):
            w = draw_noise(model, child.shape[1], relabel(draws, f"block_{j}."))
            states.append(model.propagate(states[-1], record.u, w))
        if len(states) == 1:
            return old.states[:, :, :0], torch.zeros_like(child[..., 0])
        path = stack_history(states)
        log_new = transition_log_density(model, PathSegment(path, old.records[:-1]))
        before = PathSegment(old.states[:, :, :-1], old.records[:-1])
        return path[:, :, 1:], (transition_log_density(model, before) - log_new).sum(-1)


@dataclass(frozen=True)
class SmoothedSegment(SegmentProposal):
    """Block from p(block | fixed state, y), optionally also given x_t.

    Forward filtering, backward sampling. The linearisation is about the noise-free path from the
    fixed state, so both directions use the same one. On a linear model without the child this is
    the local resampling of [Yan et al. 2016]. Given the child it is a bridge [ours], which raises
    the acceptance rate. The ratio is always included, so nonlinear models are exact too. Rotations are, as long
    as no draw turns by more than half a turn from the noise-free path, where two vectors are one rotation.

    Attributes:
        condition_on_endpoint: Condition also on the child x_t.
        shares_slopes: Use the slopes at the mean of the fixed states for all particles of a run, which need be
            computed once. The move does not change the fixed states, so the ratio remains exact. A strongly
            nonlinear model accepts fewer proposals.
    """

    condition_on_endpoint: bool = True
    shares_slopes: bool = False
    is_exact = True

    @override
    def __call__(
        self, model: StateSpaceModel, old: PathSegment, child: Tensor, draws: RandomStream
    ) -> tuple[Tensor, Tensor]:
        length, ratio = len(old.records) - 1, torch.zeros_like(child[..., 0])
        if length == 0:
            return old.states[:, :, :0], ratio
        chart, block = model.chart, old.states[:, :, 1:-1]
        steps = _linearise_path(model, old, self.shares_slopes)
        filtered = _filter_path(steps, old.states.shape)
        next_old, next_new = (chart.subtract(x, steps[-1].x) for x in (old.states[:, :, -1], child))
        states: list[Tensor] = []
        for j in reversed(range(length)):
            m_old = m_new = filtered[j][0]
            p, next_step = filtered[j][1], steps[j + 1]
            if self.condition_on_endpoint or j < length - 1:
                f = next_step.transition_jacobian
                p, gain = _update_covariance(p, f, next_step.process_covariance)
                m_old = m_old + batch_product(gain, next_old - batch_product(f, m_old))
                m_new = m_new + batch_product(gain, next_new - batch_product(f, m_new))
            root, ok = factor(p)
            z = draws.normal(f"block_{j}", child.shape[1], chart.dimension)
            next_old = chart.subtract(block[:, :, j], steps[j].x)
            next_new = m_new + batch_product(root, z)
            z_old = _whiten(root, next_old - m_old)
            normal = torch.where(ok, 0.5 * (z * z - z_old * z_old).sum(-1), torch.nan)
            ratio = ratio + normal + chart.log_volume(next_new) - chart.log_volume(next_old)
            states.append(chart.add(steps[j].x, next_new))
        return stack_history(states[::-1]), ratio


class LinearisedStep(NamedTuple):
    """One linearised step of a noise-free path.

    Attributes:
        x: State after the step, [R, N, D].
        transition_jacobian: Transition Jacobian F, [R, 1 or N, d, d].
        process_covariance: Process noise covariance Q, [R, 1 or N, d, d].
        measurement_jacobian: Measurement Jacobian H, [R, 1 or N, k, d].
        noise: Measurement covariance, [R, 1 or N, k, k].
        residual: Measurement residual, [R, N, k].
    """

    x: Tensor
    transition_jacobian: Tensor
    process_covariance: Tensor
    measurement_jacobian: Tensor
    noise: Tensor
    residual: Tensor


def _linearise_path(
    model: StateSpaceModel, old: PathSegment, shares_slopes: bool
) -> list[LinearisedStep]:
    """Linearise the steps of the noise-free path; with shared slopes about that of the mean fixed state."""
    x, steps = old.states[:, :, 0], []
    jacobians = 1 if model.linear else x.shape[1]  # a linear model has one for all particles
    has_mean = shares_slopes and not model.linear
    equal = torch.full_like(x[..., 0], 1.0 / x.shape[1])
    before = model.chart.mean(x, equal).unsqueeze(1) if has_mean else x[:, :jacobians]
    for record in old.records:
        transition = transition_jacobian(model, before, record.u)
        process_covariance = distribution_covariance(get_transition(model, before, record))
        x = model.propagate(x, record.u, mean_noise(model, x))
        mean = model.propagate(before, record.u, mean_noise(model, before)) if has_mean else x
        before = mean[:, :jacobians]
        observed_mask = ~torch.isnan(record.y).unsqueeze(1)
        noise = distribution_covariance(model.observation(before, record.u))
        steps.append(
            LinearisedStep(
                x,
                transition,
                process_covariance,
                measurement_jacobian(model, before, record),
                mask_covariance(noise, observed_mask),
                linearised_innovation(model, x, record),
            )
        )
    return steps


def _filter_path(steps: list[LinearisedStep], shape: torch.Size) -> list[tuple[Tensor, Tensor]]:
    """Filter the deviations from the noise-free path, except at the last step."""
    d = steps[0].transition_jacobian.shape[-1]
    m = steps[0].x.new_zeros(*shape[:2], d)
    p = steps[0].transition_jacobian.new_zeros(1, 1, d, d)
    filtered = []
    for step in steps[:-1]:
        f, h = step.transition_jacobian, step.measurement_jacobian
        m, p = batch_product(f, m), f @ p @ f.mT + step.process_covariance
        p, gain = _update_covariance(p, h, step.noise)
        m = m + batch_product(gain, step.residual - batch_product(h, m))
        filtered.append((m, p))
    return filtered


def _update_covariance(p: Tensor, h: Tensor, r: Tensor) -> tuple[Tensor, Tensor]:
    """Update a covariance by slope h and noise r in Joseph's form; return the gain."""
    gain = torch.linalg.solve_ex(h @ p @ h.mT + r, h @ p)[0].mT
    remainder = torch.eye(p.shape[-1], dtype=p.dtype, device=p.device) - gain @ h
    return remainder @ p @ remainder.mT + gain @ r @ gain.mT, gain


def _whiten(root: Tensor, x: Tensor) -> Tensor:
    """Compute root^-1 x for lower triangular [R, 1 or N, d, d], vectors [R, N, d]."""
    if root.shape[1] == 1:
        return torch.linalg.solve_triangular(root[:, 0], x.mT, upper=False).mT
    return torch.linalg.solve_triangular(root, x.unsqueeze(-1), upper=False).squeeze(-1)
