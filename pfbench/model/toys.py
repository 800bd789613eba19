"""Small nonlinear models with exact or grid oracles: for tests, tutorials and a first look at a new filter."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution

from pfbench.chart import Angles, Chart, Euclidean
from pfbench.model.base import HALF_LOG_2PI, StateSpaceModel, independent_normal, normal_batch, numbers, positive
from pfbench.record import Record


class Clock(NamedTuple):
    """Time index of the step, t = 1, 2, ... [1, T]."""

    t: Tensor


class Growth(StateSpaceModel):
    """x' = x/2 + 25 x/(1 + x^2) + 8 cos(1.2 t) + process_sd w, y = x^2/20 + measurement_sd v [Gordon, Salmond, Smith 1993]."""

    q: Tensor
    r: Tensor
    p0: Tensor

    def __init__(
        self, process_sd: float = math.sqrt(10.0), measurement_sd: float = 1.0, initial_sd: float = math.sqrt(2.0)
    ) -> None:
        super().__init__()
        self.register_buffer("q", positive("process_sd", [process_sd]))
        self.register_buffer("r", positive("measurement_sd", [measurement_sd]))
        self.register_buffer("p0", positive("initial_sd", [initial_sd]))
        self.names, self.units, self.groups, self.noise_dim = ("x",), ("",), {"state": (0,)}, 1

    def prepare(self, record: Record) -> Record:
        steps = torch.arange(1, record.y.shape[1] + 1, dtype=record.y.dtype, device=record.y.device)
        return record._replace(u=Clock(steps.unsqueeze(0)))

    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.p0)

    def propagate(self, x: Tensor, u: Clock, w: Tensor) -> Tensor:
        return 0.5 * x + 25.0 * x / (1.0 + x * x) + 8.0 * torch.cos(1.2 * u.t)[:, None, None] + self.q * w

    def noise_gain(self, u: Clock) -> Tensor:
        return self.q.reshape(1, 1, 1)

    def observation(self, x: Tensor, u: Any) -> Distribution:
        return independent_normal(x * x / 20.0, self.r)

    def transition(self, x: Tensor, u: Clock) -> Distribution:
        return independent_normal(self.propagate(x, u, torch.zeros_like(x)), self.q)


class StochasticVolatility(StateSpaceModel):
    """x' = mu + rho (x - mu) + sigma w, y ~ N(0, exp x), x_0 from the stationary law [Taylor 1982; Kim, Shephard, Chib 1998].

    The first propagation of a stationary x_0 leaves it stationary, so x_1 has the law that other libraries give to x_0.
    """

    sigma: Tensor
    mu: Tensor
    rho: Tensor

    def __init__(self, mu: float = -1.0, rho: float = 0.95, sigma: float = 0.3) -> None:
        super().__init__()
        if not -1.0 < rho < 1.0:
            raise ValueError(f"rho={rho}: the log-volatility is stationary only for |rho| < 1")
        self.register_buffer("sigma", positive("sigma", [sigma]))
        self.register_buffer("mu", numbers([mu]))
        self.register_buffer("rho", numbers([rho]))
        self.names, self.units, self.groups, self.noise_dim = ("log_volatility",), ("",), {"state": (0,)}, 1

    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.sigma / torch.sqrt(1.0 - self.rho**2), self.mu)

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return self.mu + self.rho * (x - self.mu) + self.sigma * w

    def noise_gain(self, u: Any) -> Tensor:
        return self.sigma.reshape(1, 1, 1)

    def observation(self, x: Tensor, u: Any) -> Distribution:
        return independent_normal(torch.zeros_like(x), torch.exp(0.5 * x))

    def log_likelihood(self, y: Tensor, x: Tensor, u: Any) -> Tensor:
        """As the observation's law has it, by one exponential for each particle instead of one, a quotient and a logarithm."""
        square, log_variance = y.nan_to_num().square(), x[..., 0]
        return torch.where(torch.isnan(y), 0.0, -0.5 * (square * torch.exp(-log_variance) + log_variance) - HALF_LOG_2PI)

    def transition(self, x: Tensor, u: Any) -> Distribution:
        return independent_normal(self.mu + self.rho * (x - self.mu), self.sigma)


class Benes(StateSpaceModel):
    """dx = tanh(x) dt + dW sampled every `step`, y = x + measurement_sd v [Benes 1981]: nonlinear, with a closed-form filter.

    The transition density cosh(x')/cosh(x) exp(-step/2) N(x'; x, step) is a mixture of N(x + step, step) and N(x - step,
    step) with odds exp(2 x), so it can be driven by two normals: the increment, and one that decides the sign.
    """

    d: Tensor
    r: Tensor

    def __init__(self, step: float = 0.1, measurement_sd: float = 0.5) -> None:
        super().__init__()
        self.register_buffer("d", positive("step", step))
        self.register_buffer("r", positive("measurement_sd", [measurement_sd]))
        self.names, self.units, self.groups, self.noise_dim = ("x",), ("",), {"state": (0,)}, 2

    def initial(self, runs: int) -> Distribution:
        """The process starts at 0, up to a spread of 1e-9 that keeps the law proper."""
        return normal_batch(runs, torch.full_like(self.r, 1e-9))

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        up = torch.special.ndtr(w[..., 1:]) < torch.sigmoid(2.0 * x)
        return x + torch.where(up, self.d, -self.d) + torch.sqrt(self.d) * w[..., :1]

    def observation(self, x: Tensor, u: Any) -> Distribution:
        return independent_normal(x, self.r)


class Pendulum(StateSpaceModel):
    """A noisy pendulum of which the horizontal deflection is seen: y = sin(angle) + measurement_sd v [Sarkka 2013, ex. 3.7].

    Euler step; white angular acceleration of root density `noise`.
    """

    l: Tensor
    r: Tensor
    p0: Tensor

    def __init__(
        self, step: float = 0.05, noise: float = 0.1, measurement_sd: float = 0.3, initial_sd: Sequence[float] = (0.5, 0.5)
    ) -> None:
        super().__init__()
        d = float(positive("step", step))
        q = positive("noise", noise) ** 2 * torch.tensor([[d**3 / 3, d**2 / 2], [d**2 / 2, d]], dtype=torch.float64)
        self.register_buffer("l", torch.linalg.cholesky(q))
        self.register_buffer("r", positive("measurement_sd", [measurement_sd]))
        self.register_buffer("p0", positive("initial_sd", list(initial_sd)))
        self.step, self.noise_dim = d, 2
        self.names, self.units, self.groups = ("angle", "rate"), ("rad", "rad/s"), {"angle": (0,), "rate": (1,)}
        self.linear_given = self.groups["rate"]

    @property
    def chart(self) -> Chart:
        return Chart((Angles(1), Euclidean(1)))

    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.p0)

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        angle, rate = x[..., :1], x[..., 1:]
        moved = torch.cat([angle + rate * self.step, rate - 9.81 * torch.sin(angle) * self.step], -1)
        return self.chart.add(moved, w @ self.l.mT)

    def noise_gain(self, u: Any) -> Tensor:
        return self.l.unsqueeze(0)

    def observation(self, x: Tensor, u: Any) -> Distribution:
        return independent_normal(torch.sin(x[..., :1]), self.r)


class Lorenz63(StateSpaceModel):
    """The Lorenz attractor (10, 28, 8/3) by one Runge-Kutta step of order 4, all three states seen in noise [Lorenz 1963]."""

    q: Tensor
    r: Tensor
    p0: Tensor

    def __init__(self, step: float = 0.02, process_sd: float = 0.1, measurement_sd: float = 1.0, initial_sd: float = 5.0) -> None:
        super().__init__()
        self.register_buffer("q", positive("process_sd", [process_sd] * 3))
        self.register_buffer("r", positive("measurement_sd", [measurement_sd] * 3))
        self.register_buffer("p0", positive("initial_sd", [initial_sd] * 3))
        self.step, self.noise_dim = float(positive("step", step)), 3
        self.names, self.units, self.groups = ("x", "y", "z"), ("",) * 3, {"state": (0, 1, 2)}

    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.p0, self.p0.new_tensor([1.0, 1.0, 25.0]))

    def drift(self, x: Tensor) -> Tensor:
        """dx/dt [..., 3]."""
        a, b, c = x.unbind(-1)
        return torch.stack([10.0 * (b - a), a * (28.0 - c) - b, a * b - 8.0 / 3.0 * c], -1)

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        h = self.step
        k1 = self.drift(x)
        k2 = self.drift(x + 0.5 * h * k1)
        k3 = self.drift(x + 0.5 * h * k2)
        k4 = self.drift(x + h * k3)
        return x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4) + self.q * w

    def noise_gain(self, u: Any) -> Tensor:
        return torch.diag(self.q).unsqueeze(0)

    def observation(self, x: Tensor, u: Any) -> Distribution:
        return independent_normal(x, self.r)

    def transition(self, x: Tensor, u: Any) -> Distribution:
        return independent_normal(self.propagate(x, u, torch.zeros_like(x)), self.q)
