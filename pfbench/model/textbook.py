"""Nonlinear models from the literature, for tests and tutorials: scalar ones and the pendulum."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from pfbench.core.chart import AngleBlock, Chart, EuclideanBlock
from pfbench.core.density import independent_normal, normal_batch
from pfbench.core.parameter_checks import as_float64, check_positive, require_range
from pfbench.core.record import Record
from pfbench.model.base import StateSpaceModel

# Posteriors of scalar models can be computed in closed form or on a grid.

_HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)


class TimeIndexInputs(NamedTuple):
    """Inputs of `UnivariateGrowth`.

    Attributes:
        t: Time index of the step, 1, 2, ..., [1, T].
    """

    t: Tensor


class UnivariateGrowth(StateSpaceModel):
    """Univariate nonlinear growth model [Gordon, Salmond, Smith 1993].

    x' = x/2 + 25 x/(1 + x^2) + 8 cos(1.2 t) + process_sd w, y = x^2/20 + measurement_sd v.

    Args:
        process_sd: Standard deviation of the process noise.
        measurement_sd: Standard deviation of the measurement noise.
        initial_sd: Standard deviation of x_0 about 0.

    Raises:
        ValueError: If a standard deviation is not positive.
    """

    channel_names = ("square of the growth state, by 20",)
    q: Tensor
    r: Tensor
    p0: Tensor

    def __init__(
        self,
        process_sd: float = math.sqrt(10.0),
        measurement_sd: float = 1.0,
        initial_sd: float = math.sqrt(2.0),
    ) -> None:
        super().__init__()
        self.register_buffer("q", check_positive("model.process_sd", [process_sd]))
        self.register_buffer("r", check_positive("model.measurement_sd", [measurement_sd]))
        self.register_buffer("p0", check_positive("model.initial_sd", [initial_sd]))
        self.names, self.units, self.groups, self.noise_dim = ("x",), ("",), {"state": (0,)}, 1

    @override
    def prepare(self, record: Record) -> Record:
        steps = torch.arange(1, record.y.shape[1] + 1, dtype=record.y.dtype, device=record.y.device)
        return record._replace(u=TimeIndexInputs(steps.unsqueeze(0)))

    @override
    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.p0)

    @override
    def propagate(self, x: Tensor, u: TimeIndexInputs, w: Tensor) -> Tensor:
        shift = 8.0 * torch.cos(1.2 * u.t)[:, None, None]
        drift = torch.addcdiv(0.5 * x, x, torch.addcmul(torch.ones_like(shift), x, x), value=25.0)
        return drift + torch.addcmul(shift, self.q, w)  # few passes over the particles

    def propagation_jacobian(self, x: Tensor, u: TimeIndexInputs) -> Tensor:
        """Return the derivative of the mean, [R, N, 1, 1].

        Args:
            x: States, [R, N, D].
            u: Inputs of the step.
        """
        square = x * x
        return (0.5 + 25.0 * (1.0 - square) / (1.0 + square) ** 2).unsqueeze(-1)

    def observation_jacobian(self, x: Tensor, u: TimeIndexInputs) -> Tensor:
        """Return x / 10, [R, N, 1, 1].

        Args:
            x: States, [R, N, D].
            u: Inputs of the step.
        """
        return 0.1 * x.unsqueeze(-1)

    @override
    def noise_gain(self, u: TimeIndexInputs) -> Tensor:
        return self.q.reshape(1, 1, 1)

    @override
    def observation(self, x: Tensor, u: Any) -> Distribution:
        return independent_normal(x * x / 20.0, self.r)

    @override
    def transition(self, x: Tensor, u: TimeIndexInputs) -> Distribution:
        return independent_normal(self.propagate(x, u, torch.zeros_like(x)), self.q)


class StochasticVolatility(StateSpaceModel):
    """Stochastic volatility model [Taylor 1982; Kim, Shephard, Chib 1998].

    x' = mu + rho (x - mu) + sigma w, y ~ N(0, exp x). x_0 has the stationary distribution, so x_1
    has it too. Libraries that observe x_0 start from the same distribution.

    Args:
        mu: Mean of the log volatility.
        rho: Autocorrelation of the log volatility, |rho| < 1.
        sigma: Standard deviation of the process noise.

    Raises:
        ValueError: If |rho| is 1 or more, or sigma is not positive.
    """

    channel_names = ("return of a volatile price",)
    sigma: Tensor
    mu: Tensor
    rho: Tensor

    def __init__(self, mu: float = -1.0, rho: float = 0.95, sigma: float = 0.3) -> None:
        super().__init__()
        require_range("model.rho", rho, "(-1, 1) Choose a stationary log volatility.")
        self.register_buffer("sigma", check_positive("model.sigma", [sigma]))
        self.register_buffer("mu", as_float64([mu]))
        self.register_buffer("rho", as_float64([rho]))
        self.names, self.units, self.groups, self.noise_dim = (
            ("log_volatility",),
            ("",),
            {"state": (0,)},
            1,
        )

    @override
    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.sigma / torch.sqrt(1.0 - self.rho**2), self.mu)

    @override
    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        mean = torch.addcmul((1.0 - self.rho) * self.mu, self.rho, x)
        return torch.addcmul(mean, self.sigma, w)  # few passes over the particles

    def propagation_jacobian(self, x: Tensor, u: Any) -> Tensor:
        """Return rho, [1, 1, 1, 1].

        Args:
            x: States, [R, N, D].
            u: Inputs of the step.
        """
        return self.rho.reshape(1, 1, 1, 1)

    @override
    def noise_gain(self, u: Any) -> Tensor:
        return self.sigma.reshape(1, 1, 1)

    @override
    def observation(self, x: Tensor, u: Any) -> Distribution:
        return independent_normal(torch.zeros_like(x), torch.exp(0.5 * x))

    @override
    def log_likelihood(self, y: Tensor, x: Tensor, u: Any) -> Tensor:
        """Compute the log likelihood with one exponential per particle.

        The general formula also needs a quotient and a logarithm.

        Args:
            y: Measurement, [R, 1].
            x: Particles, [R, N, 1].
            u: Not used.

        Returns:
            Log likelihood, [R, N]. A missing measurement gives 0.
        """
        present = torch.where(torch.isnan(y), 0.0, 1.0).to(x)
        log_square = torch.log(y.nan_to_num().square())  # -inf for y = 0: no product of 0 and inf
        log_density = torch.addcmul(-_HALF_LOG_2PI * present, -0.5 * present, x[..., 0])
        return torch.add(log_density, torch.exp(log_square - x[..., 0]), alpha=-0.5)  # few passes

    @override
    def transition(self, x: Tensor, u: Any) -> Distribution:
        return independent_normal(self.mu + self.rho * (x - self.mu), self.sigma)


class Benes(StateSpaceModel):
    """Benes model: a nonlinear diffusion with a closed-form filter [Benes 1981].

    dx = tanh(x) dt + dW, sampled every `step`; y = x + measurement_sd v. The transition density
    cosh(x')/cosh(x) exp(-step/2) N(x'; x, step) is a mixture of N(x + step, step) and
    N(x - step, step) with odds exp(2 x). Two normal variables drive it. The first is the increment,
    the second selects the sign.

    Args:
        step: Sampling interval, s.
        measurement_sd: Standard deviation of the measurement noise.

    Raises:
        ValueError: If an argument is not positive.
    """

    channel_names = ("state of the Benes diffusion",)
    d: Tensor
    r: Tensor

    def __init__(self, step: float = 0.1, measurement_sd: float = 0.5) -> None:
        super().__init__()
        self.register_buffer("d", check_positive("model.step", step))
        self.register_buffer("r", check_positive("model.measurement_sd", [measurement_sd]))
        self.names, self.units, self.groups, self.noise_dim = ("x",), ("",), {"state": (0,)}, 2

    @override
    def initial(self, runs: int) -> Distribution:
        """Return a distribution at 0, with standard deviation 1e-9 to keep it proper."""
        return normal_batch(runs, torch.full_like(self.r, 1e-9))

    @override
    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        is_upward = torch.special.ndtr(w[..., 1:]) < torch.sigmoid(2.0 * x)
        return x + torch.where(is_upward, self.d, -self.d) + torch.sqrt(self.d) * w[..., :1]

    def propagation_jacobian(self, x: Tensor, u: Any) -> Tensor:
        """Return 1, the derivative of step (but at its jump, 0) and measurement, [1, 1, 1, 1].

        Args:
            x: States, [R, N, 1].
            u: Not used.
        """
        return x.new_ones(1, 1, 1, 1)

    observation_jacobian = propagation_jacobian

    @override
    def observation(self, x: Tensor, u: Any) -> Distribution:
        return independent_normal(x, self.r)


# --------------------------------------------------------------------------------------------------
# Pendulum: a dynamical system with two states.


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
