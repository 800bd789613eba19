"""Maximum-likelihood fit of range error distributions to a recorded city drive.

`PFBENCH_DATA=... python -m pfbench.experiments.urban_error_fit` prints the distributions of
the model YAML files.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from pfbench.logs.worlds.log_tables import Array, find_dataset
from pfbench.logs.worlds.urban import UrbanLog, read_drive, rotate_heading, select_stretch
from pfbench.model.urban_gnss import LosNlosRangeError, NormalExponentialMixture, NormalRangeError
from pfbench.nav import earth


class RangeResiduals(NamedTuple):
    """Pseudorange residuals against the reference, n observations of all satellites.

    Attributes:
        time: Times, s, [n].
        value: Residuals, m, [n]. They include clock error and inter-system bias.
        glonass: 1 for GLONASS, else 0, [n].
        cn0: Carrier-to-noise density, dB-Hz, [n].
        sd: Standard deviation reported by the receiver, m, [n].
        elevation: Elevation, rad, [n].
    """

    time: Tensor
    value: Tensor
    glonass: Tensor
    cn0: Tensor
    sd: Tensor
    elevation: Tensor


def range_residuals(drive: UrbanLog, clock_drift: float = -49.7) -> RangeResiduals:
    """Compute residuals at the reference, relative to the level of the first epoch.

    Args:
        drive: Drive.
        clock_drift: Nominal drift of the receiver clock, m/s.

    Returns:
        Residuals of all observed satellites.
    """
    position = torch.from_numpy(drive.position)
    at = earth.ecef(position).numpy()[:, None]
    direction = rotate_heading(drive.satellite_position, at) - at
    reach = np.linalg.norm(direction, axis=-1)
    up = np.einsum(
        "tsi,ti->ts", direction / reach[..., None], earth.local_axes(position)[:, 2].numpy()
    )
    value = drive.range - reach - (clock_drift * (drive.time - drive.time[0]))[:, None]
    value -= np.nanquantile(value[0], 0.2)
    glonass = [float(name.startswith("R")) for name in drive.satellites]
    columns = (drive.time[:, None], value, np.array(glonass), drive.cn0, drive.sd, np.arcsin(up))
    observed_mask = ~np.isnan(value)
    return RangeResiduals(
        *(torch.from_numpy(np.broadcast_to(a, observed_mask.shape)[observed_mask]) for a in columns)
    )


class PiecewiseLinearClock(NamedTuple):
    """Receiver clock, linear between knots, and inter-system bias.

    Attributes:
        knots: Times of the knots, s.
        level: Clock bias at the knots, m.
        inter_system: Inter-system bias, m.
    """

    knots: Array
    level: Array
    inter_system: float


def fit_clock(
    data: RangeResiduals, log_density: Callable[[Tensor, Tensor], Tensor], begin: Array, knot: float
) -> tuple[Array, PiecewiseLinearClock]:
    """Fit the parameters of an error distribution by maximum likelihood.

    The clock and the inter-system bias are nuisance parameters.

    Returns parameters, [k], and the clock. Shapes: log_density [n], begin [k].
    """
    t, n = data.time.numpy(), max(2, 1 + round(float(np.ptp(data.time.numpy())) / knot))
    knots = np.linspace(t.min(), t.max(), n)
    design = torch.from_numpy(np.stack([np.interp(t, knots, row) for row in np.eye(n)], -1))
    start = np.array([np.quantile(data.value.numpy()[np.abs(t - at) <= knot], 0.2) for at in knots])

    def objective(p: Array) -> tuple[float, Array]:
        parameters = torch.from_numpy(p).requires_grad_()
        error = data.value - design @ parameters[:n] - data.glonass * parameters[n]
        loss = -log_density(error, parameters[n + 1 :]).mean()
        (gradient,) = torch.autograd.grad(loss, parameters)
        return float(loss.detach()), gradient.numpy()

    solution = minimize(
        objective,
        np.concatenate([start, [0.0], begin]),
        jac=True,
        method="BFGS",
        options={"gtol": 1e-5},
    )
    if np.abs(solution.jac).max() > 1e-4:
        raise ValueError(
            f"The maximum-likelihood search must converge, got {solution.message!r}. "
            "Use a longer part of the drive or a larger knot interval."
        )
    return solution.x[n + 1 :], PiecewiseLinearClock(knots, solution.x[:n], float(solution.x[n]))


def estimate_normal(
    data: RangeResiduals, knot: float = 20.0
) -> tuple[NormalRangeError, PiecewiseLinearClock]:
    """Fit the factor of `NormalRangeError`.

    Args:
        data: Residuals of a contiguous part of a drive.
        knot: Time between the knots of the clock, s.

    Returns:
        The distribution and the clock.

    Raises:
        ValueError: As `fit_clock`.
    """

    def log_density(e: Tensor, p: Tensor) -> Tensor:
        return torch.distributions.Normal(
            0.0, torch.exp(p[0]) * data.sd, validate_args=False
        ).log_prob(e)

    p, clock = fit_clock(data, log_density, np.zeros(1), knot)
    return NormalRangeError(float(np.exp(p[0]))), clock


def estimate_mixture(
    data: RangeResiduals, knot: float = 20.0
) -> tuple[LosNlosRangeError, PiecewiseLinearClock]:
    """Fit share, sd, tail and slope of `LosNlosRangeError`.

    Args:
        data: Residuals of a contiguous part of a drive.
        knot: Time between the knots of the clock, s.

    Returns:
        The distribution and the clock.

    Raises:
        ValueError: As `fit_clock`.
    """

    def log_density(e: Tensor, p: Tensor) -> Tensor:
        odds = p[0] + p[3] * (data.cn0 - LosNlosRangeError.cn0_reference)
        sd, tail = torch.exp(p[1]), torch.exp(p[2])
        return NormalExponentialMixture(torch.zeros_like(e), odds, sd, tail).log_prob(e)

    p, clock = fit_clock(data, log_density, np.array([0.0, np.log(5.0), np.log(40.0), 0.0]), knot)
    share, sd, tail = 1.0 / (1.0 + np.exp(-p[0])), np.exp(p[1]), np.exp(p[2])
    return LosNlosRangeError(float(share), float(sd), float(tail), float(p[3])), clock


if __name__ == "__main__":
    training = range_residuals(
        select_stretch(
            read_drive(find_dataset(os.environ.get("PFBENCH_DATA"), "berlin_urban_tc")), 0.0, 100.0
        )
    )
    print(estimate_normal(training)[0], estimate_mixture(training)[0], sep="\n")
