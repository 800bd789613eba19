"""The reference flights of the tests, and what they are measured with."""

import math

import torch
from torch import Tensor

from pfbench.nav import attitude, earth
from pfbench.nav.manoeuvres import ManoeuvreSegment, accelerate, climb, cruise, turn
from pfbench.nav.strapdown import InsState, align
from pfbench.nav.trajectory import TrajectoryData, TrajectoryStart

ARCMIN = math.radians(1 / 60)

_FIRST = [accelerate(10, 10), climb(10, 10, 20), turn(90, 60), cruise(40)]
T003 = ([*_FIRST, climb(10, 10, 20), turn(90, 60), cruise(50)], TrajectoryStart(34, 108, 400))

_OUT = [
    cruise(20),
    accelerate(2, 40),
    climb(8, 10, 40),
    cruise(60),
    turn(90, 60),
    cruise(80),
    turn(-90, 60),
]
T004 = (
    [*_OUT, accelerate(1, 20), cruise(100)],
    TrajectoryStart(32, 118, 200, speed=20, heading_deg=45),
)

# every kind of manoeuvre and a climbing turn in 80 s, for the fast tests
_SPIRAL = [
    ManoeuvreSegment(10, speed=-10, climb=0.2, heading=0.6),
    ManoeuvreSegment(10, climb=-0.2, heading=0.4),
]
_DOGLEG = [
    accelerate(4, 10),
    climb(15, 5, 5),
    turn(-90, 20),
    cruise(5),
    *_SPIRAL,
    accelerate(-1, 10),
]
SHORT = (_DOGLEG, TrajectoryStart(-41, 30, 1500, speed=60))


def vector(*values: float) -> Tensor:
    """One run [1, k]."""
    return torch.tensor([values], dtype=torch.float64)


def true_start(flight: TrajectoryData) -> InsState:
    """One run that starts without error."""
    return align(
        flight.dcm[0], flight.vel[0], flight.pos[0], *(torch.zeros(1, 3, dtype=torch.float64),) * 3
    )


def errors(ins: InsState, flight: TrajectoryData) -> Tensor:
    """INS minus truth at the end [R, 9]: rad, m/s, m."""
    alpha = attitude.attitude_error(flight.dcm[-1], ins.dcm)
    metres = (ins.pos - flight.pos[-1]) * earth.metre_scale(ins.pos)
    return torch.cat([alpha, ins.vel - flight.vel[-1], metres], dim=-1)
