"""The control law of Dynamic Matrix Control: how far a state is shifted for an error of what is seen of it.

The inputs that trade the error of the outputs against their own size are dU = (A'QA + R)^-1 A'Q (y - y~), x = x~ + B dU
[particle filter with state reconstruction by Dynamic Matrix Control, eqs 21 to 28; Cutler and Ramaker 1980].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor

from pfbench.filter.belief import Cloud, weights
from pfbench.filter.linearisation import drift
from pfbench.model.base import StateSpaceModel
from pfbench.record import Record


class Response(Protocol):
    """How what is seen answers to the inputs: H [R, P, Dy, d] -> A [R, P, Dy, d] and what the inputs do to the state B [d]."""

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record, h: Tensor) -> tuple[Tensor, Tensor]: ...


@dataclass(frozen=True)
class Static:
    """A = H B with B = I: the answer at once. A state that the measurement does not see is not shifted [ours].

    The paper's B leaves out the azimuth, which H does not see either: the shift is the same.
    """

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record, h: Tensor) -> tuple[Tensor, Tensor]:
        return h, h.new_ones(h.shape[-1])


@dataclass(frozen=True)
class Step:
    """A = H Phi B, Phi the linearised transition of one interval: the answer after it, which reaches unseen states too [ours].

    Args:
        held: names of the states without an input of their own, such as the azimuth.
        units: one unit of each state's input in SI units, all 1 if None. They decide how far each state is shifted.

    Raises:
        ValueError: a name that is not a state's; as many units as there are not states.
    """

    held: Sequence[str] = ()
    units: Sequence[float] | None = None

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record, h: Tensor) -> tuple[Tensor, Tensor]:
        chart, d = model.chart, model.chart.dimension
        if self.units is not None and len(self.units) != d:
            raise ValueError(f"response.units: {len(self.units)} of them, but this model has {d} states; give one for each")
        b = h.new_ones(d) if self.units is None else h.new_tensor(list(self.units))
        b[positions(model, "response.held", self.held)] = 0.0
        centre = chart.mean(cloud.x, weights(cloud.log_w)).unsqueeze(1)
        return h @ drift(model, centre, seen.u) * b, b


@dataclass(frozen=True)
class Control:
    """The weights of the quadratic index, for all alike or one by one, and the response.

    Args:
        error_weight: diagonal of Q, [Dy] or one number; 1 [eq. 32].
        control_weight: diagonal of R, [d] or one number; 10 [eq. 33]. Only with both in the measurement's units do they mean
            something: R / Q = 10 is a gain of 1/11 on a state that is measured itself.
        response: A and B.

    Raises:
        ValueError: a weight that is not positive; at the first step, as many as there are not measurements or states.
    """

    error_weight: float | Sequence[float] = 1.0
    control_weight: float | Sequence[float] = 10.0
    response: Response = field(default_factory=Static)

    def __post_init__(self) -> None:
        for name, value in (("error_weight", self.error_weight), ("control_weight", self.control_weight)):
            if not bool((torch.as_tensor(value) > 0).all()):
                raise ValueError(f"control.{name}={value}: give positive weights")

    def gain(self, model: StateSpaceModel, cloud: Cloud, seen: Record, h: Tensor) -> Tensor:
        """K = B (A'QA + R)^-1 A'Q for H [R, P, Dy, d], its rows 0 where nothing was seen -> [R, P, d, Dy]."""
        a, b = self.response(model, cloud, seen, h)
        tolerance = 1.0 / _one_each("error_weight", self.error_weight, h, h.shape[-2])
        cheap = (a / _one_each("control_weight", self.control_weight, h, h.shape[-1])).mT  # R^-1 A'
        inner = torch.linalg.solve_ex(a @ cheap + torch.diag(tolerance), cheap.mT)[0]  # push-through: Dy equations, not d
        return b.unsqueeze(-1) * inner.mT


def positions(model: StateSpaceModel, key: str, names: Sequence[str]) -> list[int]:
    """Of the states of these names.

    Raises:
        ValueError: a name that is not a state's.
    """
    unknown = [name for name in names if name not in model.names]
    if unknown:
        raise ValueError(f"{key}={list(names)}: {unknown} are not among the states {list(model.names)}")
    return [model.names.index(name) for name in names]


def _one_each(name: str, value: float | Sequence[float], like: Tensor, n: int) -> Tensor:
    numbers = torch.as_tensor(value).to(like)
    if numbers.numel() not in (1, n):
        raise ValueError(f"control.{name}: {numbers.numel()} numbers, but {n} are needed here; give these or one for all")
    return numbers.expand(n)
