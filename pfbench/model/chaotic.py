"""Chaotic systems of data assimilation: ordinary differential equations whose components are measured with normal errors."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from pfbench.core.density import independent_normal, normal_batch
from pfbench.core.parameter_checks import as_float64, check_positive, require_ranges
from pfbench.core.record import name_channels
from pfbench.model.base import StateSpaceModel

_GRAVITY = 9.8  # m/s^2


class ChaoticSystem(StateSpaceModel):
    """A system dx/dt = drift(x) with measured components: y = x[observed] + measurement_sd v.

    A step between measurements is `substeps` Runge-Kutta steps of order 4, then process_sd w. Without process noise the
    system is deterministic, and w has one component without effect.

    Args:
        step: Length of a Runge-Kutta step.
        substeps: Number of Runge-Kutta steps between measurements.
        process_sd: Standard deviation of the process noise of each state, 0 for none.
        measurement_sd: Standard deviation of the measurement noise of each measured state.
        initial_sd: Standard deviation of each initial state.
        initial_mean: Mean of the initial state, [D].

    Raises:
        ValueError: If an argument is out of its range.
    """

    observed = slice(None)
    q: Tensor
    r: Tensor
    p0: Tensor
    m0: Tensor

    def __init__(
        self,
        step: float,
        substeps: int,
        process_sd: float,
        measurement_sd: float,
        initial_sd: float,
        initial_mean: Sequence[float],
    ) -> None:
        super().__init__()
        size = len(initial_mean)
        self.step, self.substeps, self.process_sd = (
            float(check_positive("model.step", step)),
            substeps,
            process_sd,
        )
        require_ranges(
            "model", self, substeps="whole [1, inf)", process_sd="[0, inf) Use 0 for none."
        )
        self.register_buffer("q", as_float64([process_sd] * size))
        self.register_buffer("m0", as_float64(list(initial_mean)))
        self.register_buffer("p0", check_positive("model.initial_sd", [initial_sd] * size))
        sd = check_positive("model.measurement_sd", [measurement_sd] * size)
        self.register_buffer("r", sd[: len(self.m0[self.observed])])
        self.noise_dim = size if process_sd > 0 else 1

    @abstractmethod
    def drift(self, x: Tensor) -> Tensor:
        """Compute the time derivative of states [..., D]."""

    @override
    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.p0, self.m0)

    def advance(self, x: Tensor) -> Tensor:
        """Advance states [..., D] by one Runge-Kutta step."""
        h = self.step
        k1 = self.drift(x)
        k2 = self.drift(x + 0.5 * h * k1)
        k3 = self.drift(x + 0.5 * h * k2)
        k4 = self.drift(x + h * k3)
        return x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)

    @override
    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        for _ in range(self.substeps):
            x = self.advance(x)
        return x + self.q * w

    @override
    def noise_gain(self, u: Any) -> Tensor:
        return torch.diag(self.q)[:, : self.noise_dim].unsqueeze(0)

    @override
    def observation(self, x: Tensor, u: Any) -> Distribution:
        return independent_normal(x[..., self.observed], self.r)

    @override
    def transition(self, x: Tensor, u: Any) -> Distribution | None:
        if not self.process_sd:
            return None
        return independent_normal(self.propagate(x, u, torch.zeros_like(x)), self.q)


class Lorenz63(ChaoticSystem):
    """Lorenz attractor (10, 28, 8/3) with noisy measurements of all three states [Lorenz 1963].

    Args:
        step: Length of a Runge-Kutta step.
        process_sd: Standard deviation of the process noise of each state, 0 for none.
        measurement_sd: Standard deviation of the measurement noise of each state.
        initial_sd: Standard deviation of each initial state.
        substeps: Number of Runge-Kutta steps between measurements.
        initial_mean: Mean of the initial state, [3].

    Raises:
        ValueError: If an argument is out of its range.
    """

    channel_names = name_channels("state of the Lorenz attractor", ("x", "y", "z"), "1")
    names, units = ("x", "y", "z"), ("",) * 3
    groups = {"state": (0, 1, 2)}  # noqa: RUF012

    def __init__(
        self,
        step: float = 0.02,
        process_sd: float = 0.1,
        measurement_sd: float = 1.0,
        initial_sd: float = 5.0,
        substeps: int = 1,
        initial_mean: Sequence[float] = (1.0, 1.0, 25.0),
    ) -> None:
        super().__init__(step, substeps, process_sd, measurement_sd, initial_sd, initial_mean)

    @override
    def drift(self, x: Tensor) -> Tensor:
        a, b, c = x.unbind(-1)
        return torch.stack([10.0 * (b - a), a * (28.0 - c) - b, a * b - 8.0 / 3.0 * c], -1)

    def drift_jacobian(self, x: Tensor) -> Tensor:
        """Compute the derivative of `drift`, [..., 3, 3]."""
        a, b, c = x.unbind(-1)
        unit, zero = torch.ones_like(a), torch.zeros_like(a)
        rows = (-10.0 * unit, 10.0 * unit, zero, 28.0 - c, -unit, -a, b, a, -8.0 / 3.0 * unit)
        return torch.stack(rows, -1).unflatten(-1, (3, 3))

    def propagation_jacobian(self, x: Tensor, u: Any) -> Tensor:
        """Return the derivative of the Runge-Kutta steps, [R, N, 3, 3].

        Args:
            x: States, [R, N, D].
            u: Inputs of the step.
        """
        product = eye = torch.eye(3, dtype=x.dtype, device=x.device)
        for _ in range(self.substeps):
            total, slope, rate = torch.zeros_like(eye), torch.zeros_like(eye), torch.zeros_like(x)
            for weight, length in ((1.0, 0.0), (2.0, 0.5), (2.0, 0.5), (1.0, 1.0)):
                at = x + length * self.step * rate
                slope = self.drift_jacobian(at) @ (eye + length * self.step * slope)
                rate, total = self.drift(at), total + weight * slope
            product, x = (eye + self.step / 6.0 * total) @ product, self.advance(x)
        return product

    def observation_jacobian(self, x: Tensor, u: Any) -> Tensor:
        """Return the unit matrix, [1, 1, 3, 3].

        Args:
            x: States, [R, N, D].
            u: Inputs of the step.
        """
        return torch.eye(3, dtype=x.dtype, device=x.device)[None, None]


class Lorenz96(ChaoticSystem):
    """Forty variables on a circle, all measured: dx_i/dt = (x_(i+1) - x_(i-2)) x_(i-1) - x_i + 8 [Lorenz 1996].

    The arguments are those of `ChaoticSystem`.
    """

    names, units = tuple(f"x{i}" for i in range(1, 41)), ("",) * 40
    channel_names = name_channels("state of the Lorenz circle", names, "1")
    groups = {"state": tuple(range(40))}  # noqa: RUF012

    @override
    def drift(self, x: Tensor) -> Tensor:
        return (x.roll(-1, -1) - x.roll(2, -1)) * x.roll(1, -1) - x + 8.0


class DoublePendulum(ChaoticSystem):
    """Two rods of 1 m with 1 kg at their ends, without friction; both angles are measured, rates are not.

    The angles are those from the vertical and are not wrapped: a turn more is an error of 2 pi [ours: as the twin
    experiments of DAPPER]. The arguments are those of `ChaoticSystem`.
    """

    names, units = ("angle1", "rate1", "angle2", "rate2"), ("rad", "rad/s", "rad", "rad/s")
    channel_names = name_channels("angle of a double pendulum", ("upper", "lower"), "rad")
    groups = {"angle": (0, 2), "rate": (1, 3)}  # noqa: RUF012
    observed = slice(0, 3, 2)

    @override
    def drift(self, x: Tensor) -> Tensor:
        a, rate_a, b, rate_b = x.unbind(-1)
        sine, cosine = torch.sin(b - a), torch.cos(b - a)
        force_a = rate_b.square() * sine - 2.0 * _GRAVITY * torch.sin(a)
        force_b = -rate_a.square() * sine - _GRAVITY * torch.sin(b)
        # mass matrix [[2, cosine], [cosine, 1]] of the two equations of Lagrange
        determinant = 2.0 - cosine.square()
        acceleration_a = (force_a - cosine * force_b) / determinant
        acceleration_b = (2.0 * force_b - cosine * force_a) / determinant
        return torch.stack([rate_a, acceleration_a, rate_b, acceleration_b], -1)
