"""Linear-Gaussian models, for which the Kalman filter is exact."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from pfbench.core.density import dense_normal, independent_normal
from pfbench.core.parameter_checks import as_float64, check_positive
from pfbench.model.base import StateSpaceModel


class LinearGaussian(StateSpaceModel):
    """The model x_t = F x_{t-1} + G w, y_t = H x_t + v, v ~ N(0, diag(r^2)), x_0 ~ N(m0, P0).

    Args:
        transition_matrix: F, [D, D].
        noise_factor: G, [D, W]; W < D makes the transition singular.
        measurement_matrix: H, [Dy, D].
        measurement_sd: r, [Dy].
        initial_mean: m0, [D].
        initial_sd: Standard deviations [D], or a Cholesky factor of P0 [D, D].
        names: Names of the states; None is x0, x1, ...
        units: Units of the states; None is dimensionless.
        observes_initial: Whether the first measurement is of x_0.

    Raises:
        ValueError: If shapes do not fit or a standard deviation is not positive.
    """

    linear = True
    f: Tensor
    g: Tensor
    h: Tensor
    r: Tensor
    m0: Tensor
    l0: Tensor

    def __init__(  # noqa: PLR0913 - the eight matrices of a linear model
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
        f = as_float64(transition_matrix)
        d = f.shape[0]
        factor = as_float64(initial_sd)
        if factor.dim() == 1:
            factor = torch.diag(check_positive("initial_sd", initial_sd))
        tensors = {
            "f": f,
            "g": as_float64(noise_factor),
            "h": as_float64(measurement_matrix),
            "r": check_positive("measurement_sd", measurement_sd),
            "m0": as_float64(initial_mean),
            "l0": factor,
        }
        dy = tensors["h"].shape[0]
        w = tensors["g"].shape[-1]
        shapes = {"f": (d, d), "g": (d, w), "h": (dy, d), "r": (dy,), "m0": (d,), "l0": (d, d)}
        for name, shape in shapes.items():
            if tuple(tensors[name].shape) != shape:
                raise ValueError(
                    f"LinearGaussian {name} must have shape {shape} for D={d}, Dy={dy}, got "
                    f"{tuple(tensors[name].shape)}. Check the sizes of the matrices."
                )
            self.register_buffer(name, tensors[name])
        self.names = tuple(names) if names else tuple(f"x{i}" for i in range(d))
        self.units = tuple(units) if units else ("",) * d
        self.groups = {"state": tuple(range(d))}
        self.noise_dim = tensors["g"].shape[1]
        self.observes_initial = observes_initial

    @override
    def initial(self, runs: int) -> Distribution:
        return dense_normal(self.m0.expand(runs, -1), self.l0.expand(runs, -1, -1))

    @override
    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return x @ self.f.mT + w @ self.g.mT

    @override
    def noise_gain(self, u: Any) -> Tensor:
        return self.g.unsqueeze(0)

    @override
    def observation(self, x: Tensor, u: Any) -> Distribution:
        return independent_normal(x @ self.h.mT, self.r)

    def propagation_jacobian(self, x: Tensor, u: Any) -> Tensor:
        """Return F, [1, 1, D, D].

        Args:
            x: States, [R, N, D].
            u: Inputs of the step.
        """
        return self.f[None, None]

    def observation_jacobian(self, x: Tensor, u: Any) -> Tensor:
        """Return H, [1, 1, k, D].

        Args:
            x: States, [R, N, D].
            u: Inputs of the step.
        """
        return self.h[None, None]

    @override
    def transition(self, x: Tensor, u: Any) -> Distribution | None:
        covariance = self.g @ self.g.mT
        factor, info = torch.linalg.cholesky_ex(covariance)
        if self.noise_dim < len(self.names) or int(info) != 0:
            return None
        return dense_normal(x @ self.f.mT, factor.expand(*x.shape[:-1], -1, -1))


def local_level(
    level_sd: float,
    measurement_sd: float,
    initial_mean: float,
    initial_sd: float,
    observes_initial: bool = False,
) -> LinearGaussian:
    """Build the local level model x' = x + level_sd w, y = x + measurement_sd v.

    Args:
        level_sd: Standard deviation of a step.
        measurement_sd: Standard deviation of the measurement error.
        initial_mean: Mean of x_0.
        initial_sd: Standard deviation of x_0.
        observes_initial: Whether the first measurement is of x_0.

    Returns:
        Model with one state.

    Raises:
        ValueError: If a standard deviation is not positive.

    References:
        Durbin and Koopman 2012, ch. 2 (Nile data).
    """
    check_positive("level_sd", level_sd)
    model = LinearGaussian(
        [[1.0]], [[level_sd]], [[1.0]], [measurement_sd], [initial_mean], [initial_sd],
        names=("level",), observes_initial=observes_initial,
    )  # fmt: skip
    model.channel_names = ("level",)
    return model


def linear_walk(
    step: float, noise: float, measurement_sd: float, initial_sd: Sequence[float] = (2.0, 1.0)
) -> LinearGaussian:
    """Build a constant-velocity model whose position is measured.

    Q = noise^2 [[step^3/3, step^2/2], [step^2/2, step]], entered by its Cholesky factor.

    Args:
        step: Time between measurements [s].
        noise: Root density of the white acceleration [m/s^1.5].
        measurement_sd: Standard deviation of the measured position [m].
        initial_sd: Standard deviations of position [m] and velocity [m/s].

    Returns:
        Model with position and velocity.

    Raises:
        ValueError: If an argument is not positive.
    """
    check_positive("noise", noise)
    check_positive("step", step)
    q = noise**2 * as_float64([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
    model = LinearGaussian(
        [[1.0, step], [0.0, 1.0]], torch.linalg.cholesky(q), [[1.0, 0.0]], [measurement_sd],
        [0.0, 0.0], list(initial_sd), names=("position", "velocity"), units=("m", "m/s"),
    )  # fmt: skip
    model.channel_names = ("position on a line [m]",)
    return model
