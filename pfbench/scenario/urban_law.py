"""What the range errors of a recorded drive through a city say of their own law.

`PFBENCH_DATA=... python -m pfbench.scenario.urban_law` prints the laws that the model yamls hold.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from pfbench.model.urban_gnss import CN0_REFERENCE, Normal, SightOrTail, TailedNormal
from pfbench.nav import earth
from pfbench.scenario.recorded import locate
from pfbench.scenario.recorded_urban import Drive, read_drive, stretch, turned
from pfbench.scenario.tables import Array


class Residuals(NamedTuple):
    """Pseudoranges less the range from the reference and a nominal clock, one for each satellite seen, n in all.

    Attributes:
        time: [n] s.
        value: [n] m; clock and inter-system bias are still in it.
        glonass: [n] 1 or 0.
        cn0: [n] dB-Hz.
        sd: as the receiver states it [n] m.
        elevation: [n] rad.
    """

    time: Tensor
    value: Tensor
    glonass: Tensor
    cn0: Tensor
    sd: Tensor
    elevation: Tensor


def residuals(drive: Drive, clock_drift: float = -49.7) -> Residuals:
    """Residuals of a stretch at its reference, measured from the level of the first epoch."""
    position = torch.from_numpy(drive.position)
    at = earth.ecef(position).numpy()[:, None]
    sight = turned(drive.place, at) - at
    reach = np.linalg.norm(sight, axis=-1)
    up = np.einsum("tsi,ti->ts", sight / reach[..., None], earth.local_axes(position)[:, 2].numpy())
    value = drive.range - reach - (clock_drift * (drive.time - drive.time[0]))[:, None]
    value -= np.nanquantile(value[0], 0.2)
    glonass = [float(name.startswith("R")) for name in drive.satellites]
    every = (drive.time[:, None], value, np.array(glonass), drive.cn0, drive.sd, np.arcsin(up))
    seen = ~np.isnan(value)
    return Residuals(*(torch.from_numpy(np.broadcast_to(a, seen.shape)[seen]) for a in every))


class Clock(NamedTuple):
    """Receiver clock as straight lines between knots, and the inter-system bias."""

    knots: Array
    level: Array
    inter_system: float


def fit(data: Residuals, log_density: Callable[[Tensor, Tensor], Tensor], begin: Array, knot: float) -> tuple[Array, Clock]:
    """Maximum likelihood of a law's parameters, with the clock and the inter-system bias as nuisance parameters.

    Args:
        data: residuals of one contiguous stretch.
        log_density: errors [n], parameters [k] on the whole real line -> log density [n].
        begin: where the search starts [k].
        knot: seconds between the knots of the clock.

    Raises:
        ValueError: the search does not end in an optimum.
    """
    t, n = data.time.numpy(), max(2, 1 + round(float(np.ptp(data.time.numpy())) / knot))
    knots = np.linspace(t.min(), t.max(), n)
    design = torch.from_numpy(np.stack([np.interp(t, knots, row) for row in np.eye(n)], -1))
    start = np.array([np.quantile(data.value.numpy()[np.abs(t - at) <= knot], 0.2) for at in knots])

    def objective(p: Array) -> tuple[float, Array]:
        parameters = torch.from_numpy(p).requires_grad_()
        error = data.value - design @ parameters[:n] - data.glonass * parameters[n]
        loss = -log_density(error, parameters[n + 1 :]).mean()
        (slope,) = torch.autograd.grad(loss, parameters)
        return float(loss.detach()), slope.numpy()

    found = minimize(objective, np.concatenate([start, [0.0], begin]), jac=True, method="BFGS", options={"gtol": 1e-5})
    if np.abs(found.jac).max() > 1e-4:
        raise ValueError(f"no maximum of the likelihood found ({found.message}); give a longer stretch or wider knots")
    return found.x[n + 1 :], Clock(knots, found.x[:n], float(found.x[n]))


def estimate_normal(data: Residuals, knot: float = 20.0) -> tuple[Normal, Clock]:
    """The factor of `Normal` that fits best. Raises as `fit`."""

    def log_density(e: Tensor, p: Tensor) -> Tensor:
        return torch.distributions.Normal(0.0, torch.exp(p[0]) * data.sd, validate_args=False).log_prob(e)

    p, clock = fit(data, log_density, np.zeros(1), knot)
    return Normal(float(np.exp(p[0]))), clock


def estimate_mixture(data: Residuals, knot: float = 20.0) -> tuple[SightOrTail, Clock]:
    """Share, sd, tail and slope of `SightOrTail` that fit best. Raises as `fit`."""

    def log_density(e: Tensor, p: Tensor) -> Tensor:
        odds, sd, tail = p[0] + p[3] * (data.cn0 - CN0_REFERENCE), torch.exp(p[1]), torch.exp(p[2])
        return TailedNormal(torch.zeros_like(e), odds, sd, tail).log_prob(e)

    p, clock = fit(data, log_density, np.array([0.0, np.log(5.0), np.log(40.0), 0.0]), knot)
    share, sd, tail = 1.0 / (1.0 + np.exp(-p[0])), np.exp(p[1]), np.exp(p[2])
    return SightOrTail(float(share), float(sd), float(tail), float(p[3])), clock


if __name__ == "__main__":
    training = residuals(stretch(read_drive(locate(os.environ.get("PFBENCH_DATA"), "berlin_urban_tc")), 0.0, 100.0))
    print(estimate_normal(training)[0], estimate_mixture(training)[0], sep="\n")
