"""Linear-Gaussian models: the ones that a Kalman filter solves exactly."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from pfbench.model.base import StateSpaceModel, dense_normal, independent_normal, numbers, positive


class LinearGaussian(StateSpaceModel):
    """x_t = F x_{t-1} + G w, y_t = H x_t + v, v ~ N(0, diag(r^2)), x_0 ~ N(m0, P0).

    Args:
        transition_matrix: F [D, D].
        noise_factor: G [D, W]; W < D makes the transition singular.
        measurement_matrix: H [Dy, D].
        measurement_sd: r [Dy].
        initial_mean: m0 [D].
        initial_sd: standard deviations [D], or a Cholesky factor of P0 [D, D].
        names, units: of the D states.
        observes_initial: see StateSpaceModel.

    Raises:
        ValueError: shapes that do not fit, standard deviations that are not positive.
    """

    linear = True
    f: Tensor
    g: Tensor
    h: Tensor
    r: Tensor
    m0: Tensor
    l0: Tensor

    def __init__(
        self,
        transition_matrix: Any,
        noise_factor: Any,
        measurement_matrix: Any,
        measurement_sd: Any,
        initial_mean: Any,
        initial_sd: Any,
        names: Sequence[str] | None = None,
        units: Sequence[str] | None = None,
        observes_initial: bool = False,
    ) -> None:
        super().__init__()
        f = numbers(transition_matrix)
        d = f.shape[0]
        factor = numbers(initial_sd)
        if factor.dim() == 1:
            factor = torch.diag(positive("initial_sd", initial_sd))
        tensors = {
            "f": f,
            "g": numbers(noise_factor),
            "h": numbers(measurement_matrix),
            "r": positive("measurement_sd", measurement_sd),
            "m0": numbers(initial_mean),
            "l0": factor,
        }
        dy = tensors["h"].shape[0]
        wanted = {"f": (d, d), "g": (d, tensors["g"].shape[-1]), "h": (dy, d), "r": (dy,), "m0": (d,), "l0": (d, d)}
        for name, shape in wanted.items():
            if tuple(tensors[name].shape) != shape:
                given = tuple(tensors[name].shape)
                raise ValueError(f"LinearGaussian {name}: shape {given}, but {shape} is needed for D={d}, Dy={dy}")
            self.register_buffer(name, tensors[name])
        self.names = tuple(names) if names else tuple(f"x{i}" for i in range(d))
        self.units = tuple(units) if units else ("",) * d
        self.groups = {"state": tuple(range(d))}
        self.noise_dim = tensors["g"].shape[1]
        self.observes_initial = observes_initial

    def initial(self, runs: int) -> Distribution:
        return dense_normal(self.m0.expand(runs, -1), self.l0.expand(runs, -1, -1))

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return x @ self.f.mT + w @ self.g.mT

    def noise_gain(self, u: Any) -> Tensor:
        return self.g.unsqueeze(0)

    def observation(self, x: Tensor, u: Any) -> Distribution:
        return independent_normal(x @ self.h.mT, self.r)

    def transition(self, x: Tensor, u: Any) -> Distribution | None:
        covariance = self.g @ self.g.mT
        factor, info = torch.linalg.cholesky_ex(covariance)
        if self.noise_dim < len(self.names) or int(info) != 0:
            return None
        return dense_normal(x @ self.f.mT, factor.expand(*x.shape[:-1], -1, -1))


def local_level(
    level_sd: float, measurement_sd: float, initial_mean: float, initial_sd: float, observes_initial: bool = False
) -> LinearGaussian:
    """The local level model of the Nile data [Durbin and Koopman 2012, ch. 2]: x' = x + level_sd w, y = x + measurement_sd v."""
    positive("level_sd", level_sd)
    return LinearGaussian(
        [[1.0]], [[level_sd]], [[1.0]], [measurement_sd], [initial_mean], [initial_sd],
        names=("level",), observes_initial=observes_initial,
    )


def linear_walk(step: float, noise: float, measurement_sd: float, initial_sd: Sequence[float] = (2.0, 1.0)) -> LinearGaussian:
    """Constant velocity: position and velocity, position measured; `noise` is the root density of the white acceleration.

    Q = noise^2 [[step^3/3, step^2/2], [step^2/2, step]], entered by its Cholesky factor.
    """
    positive("noise", noise)
    positive("step", step)
    q = noise**2 * torch.tensor([[step**3 / 3, step**2 / 2], [step**2 / 2, step]], dtype=torch.float64)
    return LinearGaussian(
        [[1.0, step], [0.0, 1.0]], torch.linalg.cholesky(q), [[1.0, 0.0]], [measurement_sd], [0.0, 0.0], list(initial_sd),
        names=("position", "velocity"), units=("m", "m/s"),
    )
