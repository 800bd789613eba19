"""Dynamic Matrix Control: shift of the state for an innovation.

The inputs minimise the weighted output error plus their own weighted size. The solution is
dU = (A'QA + R)^-1 A'Q (y - y~), x = x~ + B dU [particle filter with state reconstruction by
Dynamic Matrix Control, eqs 21 to 28]. See also [Cutler and Ramaker 1980].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief, normalise_log_weights
from pfbench.filter.linearisation import mean_noise, transition_jacobian
from pfbench.filter.particle.proposals import DefensiveSelection, choose_defensive_particles
from pfbench.filter.particle.stages import ProposalSample, deactivate_invalid_particles
from pfbench.model.base import StateSpaceModel


class DmcResponse(Protocol):
    """Response of measurement and state to the inputs of the controller."""

    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, h: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Compute the response.

        Args:
            model: State-space model of the step.
            belief: Belief before the step.
            record: Record of the step.
            h: Measurement Jacobian, [R, P, Dy, d].

        Returns:
            Effect A of the inputs on the measurement [R, P, Dy, d], and B on the state [d].
        """


@dataclass(frozen=True)
class StaticResponse(DmcResponse):
    """Immediate response A = H, B = I. Unobserved states are not shifted [ours].

    The paper's B omits the azimuth. H does not observe it, so the shift is equal.
    """

    @override
    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, h: Tensor
    ) -> tuple[Tensor, Tensor]:
        return h, h.new_ones(h.shape[-1])


@dataclass(frozen=True)
class OneStepResponse(DmcResponse):
    """Response after one interval, A = H Phi B, also of unobserved states [ours].

    Phi is the linearised transition of one interval.

    Attributes:
        uncontrolled_states: Names of the states without an input, such as the azimuth.
        units: Unit of each state's input in SI units, all 1 if None. They determine how far each
            state is shifted.
    """

    uncontrolled_states: Sequence[str] = ()
    units: Sequence[float] | None = None

    @override
    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, h: Tensor
    ) -> tuple[Tensor, Tensor]:
        chart, d = model.chart, model.chart.dimension
        count = d if self.units is None else len(self.units)
        require(count == d, "response.units", f"have {d} numbers", count, "Set one for each state.")
        b = h.new_ones(d) if self.units is None else h.new_tensor(list(self.units))
        b[state_indices(model, "response.uncontrolled_states", self.uncontrolled_states)] = 0.0
        centre = chart.mean(belief.x, normalise_log_weights(belief.log_w)).unsqueeze(1)
        return h @ transition_jacobian(model, centre, record.u) * b, b


@dataclass(frozen=True)
class DmcController:
    """Weights of the quadratic cost and response of a DMC controller.

    Attributes:
        error_weight: Diagonal of Q, [Dy] or one number, 1 in [eq. 32].
        control_weight: Diagonal of R, [d] or one number, 10 in [eq. 33]. They are meaningful only
            with both in the units of the measurement: R / Q = 10 is a gain of 1/11 on a directly
            measured state.
        response: A and B.

    Raises:
        ValueError: If a weight is not positive. At the first step, if their number does not fit.
    """

    error_weight: float | Sequence[float] = 1.0
    control_weight: float | Sequence[float] = 10.0
    response: DmcResponse = field(default_factory=StaticResponse)

    def __post_init__(self) -> None:
        for name, value in (
            ("error_weight", self.error_weight),
            ("control_weight", self.control_weight),
        ):
            require(
                bool((torch.as_tensor(value) > 0).all()), f"controller.{name}", "be positive", value
            )

    def compute_gain(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, h: Tensor
    ) -> Tensor:
        """Compute K = B (A'QA + R)^-1 A'Q.

        Args:
            model: State-space model.
            belief: Belief before the step.
            record: Record of the step.
            h: Measurement Jacobian [R, P, Dy, d], with rows 0 for unobserved components.

        Returns:
            Gain, [R, P, d, Dy].
        """
        a, b = self.response(model, belief, record, h)
        error_variance = 1.0 / _expand("error_weight", self.error_weight, h, h.shape[-2])
        # R^-1 A', then the push-through identity: Dy equations instead of d
        scaled = (a / _expand("control_weight", self.control_weight, h, h.shape[-1])).mT
        inner = torch.linalg.solve_ex(a @ scaled + torch.diag(error_variance), scaled.mT)[0]
        return b.unsqueeze(-1) * inner.mT


def state_indices(model: StateSpaceModel, key: str, names: Sequence[str]) -> list[int]:
    """Return the indices of states by name."""
    unknown = [name for name in names if name not in model.names]
    require(
        not unknown, key, f"be among the states {list(model.names)}", unknown, "Correct the names."
    )
    return [model.names.index(name) for name in names]


def _expand(name: str, value: float | Sequence[float], template: Tensor, n: int) -> Tensor:
    """Expand one number to n, or check the number of several."""
    numbers = torch.as_tensor(value).to(template)
    require(
        numbers.numel() in (1, n),
        f"controller.{name}",
        f"have 1 or {n} numbers",
        numbers.numel(),
        f"Set one or {n}.",
    )
    return numbers.expand(n)


# --------------------------------------------------------------------------------------------------
# Selection of shifted particles, and their noise-free predictions.


def select_defensive(
    fraction: float, log_w: Tensor, draws: RandomStream
) -> DefensiveSelection | None:
    """Draw the particles that are not shifted, or return None if there are none.

    Shapes: log_w [R, N].
    """
    if fraction == 0.0:
        return None
    return choose_defensive_particles(fraction, torch.isfinite(log_w), draws, "reconstruction.keep")


def keep_selected(selection: DefensiveSelection | None, old: Tensor, new: Tensor) -> Tensor:
    """Return `old` for selected particles and `new` for the others.

    Returns values, [R, N, ...]. Shapes: old [R, N, ...], new [R, N, ...].
    """
    return new if selection is None else torch.where(selection.mask.unsqueeze(-1), old, new)


def predict_without_noise(
    model: StateSpaceModel, belief: ParticleBelief, record: Record
) -> tuple[Tensor, Tensor]:
    """Compute noise-free predictions.

    Returns predictions [R, N, D] and weights [R, N], 0 where the prediction is not finite.
    """
    x = model.propagate(belief.x, record.u, mean_noise(model, belief.x))
    x, log_w = deactivate_invalid_particles(x, belief.log_w, belief.x)
    return x, normalise_log_weights(log_w)


def replace_invalid(sample: ProposalSample, belief: ParticleBelief) -> tuple[Tensor, Tensor]:
    """Restore the parents of non-finite particles, with weight 0.

    Returns particles [R, N, D] and log ratio [R, N].
    """
    return deactivate_invalid_particles(sample.x, sample.log_ratio, belief.x)
