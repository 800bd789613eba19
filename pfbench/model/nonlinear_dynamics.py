"""Pendulum and Lorenz attractor: dynamical systems with several states, for tests and tutorials."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from pfbench.core.channels import name_channels
from pfbench.core.chart import AngleBlock, Chart, EuclideanBlock
from pfbench.core.normal import independent_normal, normal_batch
from pfbench.core.parameter_checks import check_positive
from pfbench.model.base import StateSpaceModel


class Pendulum(StateSpaceModel):
    """Noisy pendulum with measured horizontal deflection [Sarkka 2013, ex. 3.7].

    y = sin(angle) + measurement_sd v. The dynamics use an Euler step.

    Args:
        step: Time step, s.
        noise: Root density of the white angular acceleration, rad/s^2/sqrt(Hz).
        measurement_sd: Standard deviation of the measurement noise.
        initial_sd: Standard deviations of angle and rate about 0, rad and rad/s, [2].

    Raises:
        ValueError: If an argument is not positive.
    """

    channel_names = ("horizontal deflection of the pendulum, by its length",)
    noise_root: Tensor
    r: Tensor
    p0: Tensor

    def __init__(
        self,
        step: float = 0.05,
        noise: float = 0.1,
        measurement_sd: float = 0.3,
        initial_sd: Sequence[float] = (0.5, 0.5),
    ) -> None:
        super().__init__()
        d = float(check_positive("model.step", step))
        q = check_positive("model.noise", noise) ** 2 * torch.tensor(
            [[d**3 / 3, d**2 / 2], [d**2 / 2, d]], dtype=torch.float64
        )
        self.register_buffer("noise_root", torch.linalg.cholesky(q))
        self.register_buffer("r", check_positive("model.measurement_sd", [measurement_sd]))
        self.register_buffer("p0", check_positive("model.initial_sd", list(initial_sd)))
        self.step, self.noise_dim = d, 2
        self.names, self.units, self.groups = (
            ("angle", "rate"),
            ("rad", "rad/s"),
            {"angle": (0,), "rate": (1,)},
        )
        self.linear_given = self.groups["rate"]

    @property
    @override
    def chart(self) -> Chart:
        return Chart((AngleBlock(1), EuclideanBlock(1)))

    @override
    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.p0)

    @override
    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        angle, rate = x[..., :1], x[..., 1:]
        predicted_mean = torch.cat(
            [angle + rate * self.step, rate - 9.81 * torch.sin(angle) * self.step], -1
        )
        return self.chart.add(predicted_mean, w @ self.noise_root.mT)

    def propagation_jacobian(self, x: Tensor, u: Any) -> Tensor:
        """Return the derivative of the Euler step, [R, N, 2, 2].

        Args:
            x: States, [R, N, D].
            u: Inputs of the step.
        """
        f = torch.eye(2, dtype=x.dtype, device=x.device).repeat(*x.shape[:2], 1, 1)
        f[..., 0, 1] = self.step
        f[..., 1, 0] = -9.81 * self.step * torch.cos(x[..., 0])
        return f

    def observation_jacobian(self, x: Tensor, u: Any) -> Tensor:
        """Return the derivative of sin(angle), [R, N, 1, 2].

        Args:
            x: States, [R, N, D].
            u: Inputs of the step.
        """
        slope = torch.cos(x[..., :1])
        return torch.cat([slope, torch.zeros_like(slope)], -1).unsqueeze(-2)

    @override
    def noise_gain(self, u: Any) -> Tensor:
        return self.noise_root.unsqueeze(0)

    @override
    def observation(self, x: Tensor, u: Any) -> Distribution:
        return independent_normal(torch.sin(x[..., :1]), self.r)


class Lorenz63(StateSpaceModel):
    """Lorenz attractor (10, 28, 8/3) with noisy measurements [Lorenz 1963].

    All three states are measured. Each step is one Runge-Kutta step of order 4.

    Args:
        step: Time step.
        process_sd: Standard deviation of the process noise of each state.
        measurement_sd: Standard deviation of the measurement noise of each state.
        initial_sd: Standard deviation of each state about (1, 1, 25).

    Raises:
        ValueError: If an argument is not positive.
    """

    channel_names = name_channels("state of the Lorenz attractor", ("x", "y", "z"), "1")
    q: Tensor
    r: Tensor
    p0: Tensor

    def __init__(
        self,
        step: float = 0.02,
        process_sd: float = 0.1,
        measurement_sd: float = 1.0,
        initial_sd: float = 5.0,
    ) -> None:
        super().__init__()
        self.register_buffer("q", check_positive("model.process_sd", [process_sd] * 3))
        self.register_buffer("r", check_positive("model.measurement_sd", [measurement_sd] * 3))
        self.register_buffer("p0", check_positive("model.initial_sd", [initial_sd] * 3))
        self.step, self.noise_dim = float(check_positive("model.step", step)), 3
        self.names, self.units, self.groups = ("x", "y", "z"), ("",) * 3, {"state": (0, 1, 2)}

    @override
    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.p0, self.p0.new_tensor([1.0, 1.0, 25.0]))

    def drift(self, x: Tensor) -> Tensor:
        """Compute the time derivative of states [..., 3]."""
        a, b, c = x.unbind(-1)
        return torch.stack([10.0 * (b - a), a * (28.0 - c) - b, a * b - 8.0 / 3.0 * c], -1)

    @override
    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        h = self.step
        k1 = self.drift(x)
        k2 = self.drift(x + 0.5 * h * k1)
        k3 = self.drift(x + 0.5 * h * k2)
        k4 = self.drift(x + h * k3)
        return x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4) + self.q * w

    def drift_jacobian(self, x: Tensor) -> Tensor:
        """Compute the derivative of `drift`, [..., 3, 3]."""
        a, b, c = x.unbind(-1)
        unit, zero = torch.ones_like(a), torch.zeros_like(a)
        rows = (-10.0 * unit, 10.0 * unit, zero, 28.0 - c, -unit, -a, b, a, -8.0 / 3.0 * unit)
        return torch.stack(rows, -1).unflatten(-1, (3, 3))

    def propagation_jacobian(self, x: Tensor, u: Any) -> Tensor:
        """Return the derivative of the Runge-Kutta step, [R, N, 3, 3].

        Args:
            x: States, [R, N, D].
            u: Inputs of the step.
        """
        eye, h = torch.eye(3, dtype=x.dtype, device=x.device), self.step
        total, slope, rate = torch.zeros_like(eye), torch.zeros_like(eye), torch.zeros_like(x)
        for weight, length in ((1.0, 0.0), (2.0, 0.5), (2.0, 0.5), (1.0, 1.0)):
            at = x + length * h * rate
            slope = self.drift_jacobian(at) @ (eye + length * h * slope)
            rate, total = self.drift(at), total + weight * slope
        return eye + h / 6.0 * total

    def observation_jacobian(self, x: Tensor, u: Any) -> Tensor:
        """Return the unit matrix, [1, 1, 3, 3].

        Args:
            x: States, [R, N, D].
            u: Inputs of the step.
        """
        return torch.eye(3, dtype=x.dtype, device=x.device)[None, None]

    @override
    def noise_gain(self, u: Any) -> Tensor:
        return torch.diag(self.q).unsqueeze(0)

    @override
    def observation(self, x: Tensor, u: Any) -> Distribution:
        return independent_normal(x, self.r)

    @override
    def transition(self, x: Tensor, u: Any) -> Distribution:
        return independent_normal(self.propagate(x, u, torch.zeros_like(x)), self.q)
