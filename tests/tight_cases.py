"""A flight of tightly coupled SINS/GNSS, its model, and a Kalman filter written out."""

from typing import Any

import pytest
import torch
from torch import Tensor

from pfbench.core.record import Episode, Record
from pfbench.model.tight_coupling import SinsGnssTight, TightStep
from pfbench.nav import (
    AlignmentErrors,
    CycloidRamp,
    ImuErrors,
    ProcessNoiseInflation,
    RampTrajectory,
    RangingReceiver,
    TrajectoryStart,
    WalkerConstellation,
    earth,
)
from pfbench.noise.base import NominalNoise
from pfbench.scenario.flights import SimulatedFlight

IMU = ImuErrors(0.03, 0.0, 0.0, 0.001, 50.0, 0.0, 0.0, 50.0)

RECEIVER = RangingReceiver(
    WalkerConstellation(), satellites=["W02", "W05", "W06", "W09", "W12", "W16", "W21", "W22"]
)

INITIAL = AlignmentErrors((1.2, 1.2, 6.0), (0.1, 0.1, 0.1), (10.0, 10.0, 10.0))

PATH = RampTrajectory(
    TrajectoryStart(26.26, 105.89, 320.0, 100.0, 225.0),
    80.0,
    speed=(CycloidRamp(0.0, 30.0, 100.0),),
    heading_deg=(CycloidRamp(20.0, 60.0, 60.0),),
    climb_rate_changes=(CycloidRamp(30.0, 50.0, 10.0),),
)

RUNS = torch.arange(3)


def world(receiver: Any = RECEIVER, runs: Tensor = RUNS) -> Episode:
    return SimulatedFlight(PATH, IMU, receiver, INITIAL, imu_rate_hz=20.0).draw(
        NominalNoise(), runs, 5
    )


@pytest.fixture(scope="module")
def flight() -> Episode:
    """Return 3 runs of 80 s with a take-off run, a turn and a climb."""
    return world()


def linear(
    inflation: ProcessNoiseInflation | None = None, receiver: RangingReceiver = RECEIVER
) -> SinsGnssTight:
    return SinsGnssTight(IMU, receiver, INITIAL, inflation)


def kalman(model: SinsGnssTight, record: Record) -> tuple[Tensor, Tensor, Tensor]:
    """The textbook's filter with the linear form of the ranges: means, variances [R, T, 17], NIS [R, T]."""
    runs, count = record.y.shape[0], len(model.r) // 2
    mean, p = (
        torch.zeros(runs, 17, dtype=torch.float64),
        torch.diag_embed(model.p0.square().expand(runs, -1)),
    )
    eye, means, variances, distances = torch.eye(17, dtype=torch.float64), [], [], []
    for t in range(record.y.shape[1]):
        seen = record.at_step(t)
        u: TightStep = seen.u
        phi, gain = model.transition_matrix(u), model.noise_gain(u)
        mean, p = (phi @ mean.unsqueeze(-1)).squeeze(-1), phi @ p @ phi.mT + gain @ gain.mT
        sight = u.sight
        s, c, o = sight.sine, sight.cosine, torch.zeros_like(sight.sine)
        east, north, up = (torch.stack(axis, -1) for axis in ((o, o + 1, o), (-s, o, c), (c, o, s)))
        h = torch.zeros(runs, 2 * count, 17, dtype=torch.float64)
        h[:, :count, 6:9] = sight.line @ torch.stack([north, east, up], -1)
        h[:, count:, 3:6] = sight.line @ torch.stack([east, north, up], -1)
        # the line turns with the place, (w - e (e.w)) / r, and so do the level axes of the velocity
        turn = (
            sight.closing - sight.line * (sight.line * sight.closing).sum(-1, keepdim=True)
        ) / sight.distance.unsqueeze(-1)
        h[:, count:, 6:9] = turn @ torch.stack([north, east, up], -1)
        r_m, r_n = earth.radii(torch.asin(s))
        for axis, tilt in (
            (6, (-1 / (r_m + sight.height), o, o)),
            (7, (o, 1 / (r_n + sight.height), s / c / (r_n + sight.height))),
        ):
            level = torch.linalg.cross(torch.stack(tilt, -1), sight.vel)
            h[:, count:, axis] += (h[:, count:, 3:6] @ level.unsqueeze(-1)).squeeze(-1)
        h[:, :count, 15] = h[:, count:, 16] = -1.0
        there = ~seen.y.isnan()
        r = torch.where(there, seen.y - model.observation(mean.unsqueeze(1), u).mean[:, 0], 0.0)
        h = torch.where(there.unsqueeze(-1), h, 0.0)
        spread = h @ p @ h.mT + torch.diag(model.r.square())
        k = torch.linalg.solve(spread, h @ p).mT
        distances.append((r * torch.linalg.solve(spread, r.unsqueeze(-1)).squeeze(-1)).sum(-1))
        mean, p = mean + (k @ r.unsqueeze(-1)).squeeze(-1), (eye - k @ h) @ p
        means.append(mean)
        variances.append(p.diagonal(dim1=-2, dim2=-1))
    return torch.stack(means, 1), torch.stack(variances, 1), torch.stack(distances, 1)
