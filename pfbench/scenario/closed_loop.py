"""Closed-loop INS: the estimated errors correct the INS after every filter interval."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pfbench.core.record import FeedbackRun, Record
from pfbench.nav import attitude, earth, strapdown

_LAYOUT = {"attitude": (0, 1, 2), "velocity": (3, 4, 5), "position": (6, 7, 8)}


@dataclass(frozen=True, eq=False)
class ClosedLoopIns:
    """A `FeedbackProcess` that repeats the INS navigation interval by interval.

    The record of a run has the inputs of the uncorrected INS.

    Attributes:
        ins: INS states at the start, R runs.
        dtheta: Angle increments in body axes, rad, [R, n, 3].
        dv: Velocity increments in body axes, m/s, [R, n, 3].
        dt: Sampling interval, s.
        per: Samples per filter interval.
    """

    ins: strapdown.InsState
    dtheta: Tensor
    dv: Tensor
    dt: float
    per: int

    def begin(self, record: Record, groups: dict[str, tuple[int, ...]]) -> FeedbackRun:
        """Start a pass that does not affect any other pass.

        Returns the pass before its first step.
        """
        if any(groups.get(name) != indices for name, indices in _LAYOUT.items()):
            raise ValueError(
                "scenario.closed_loop must be false for a model whose first nine states are not errors of "
                f"attitude, velocity and position, got groups {groups or 'without error states'}. "
                "Choose model=ins_gnss or model=sins_gps_azimuth."
            )
        return ClosedLoopRun(self, record)


class ClosedLoopRun:
    """One pass of a filter through a closed-loop flight.

    Navigation has double precision for every precision of the filter. The record of each step has
    this pass as its `feedback`.

    Attributes:
        t: Latest step. -1 before the first.
    """

    def __init__(self, course: ClosedLoopIns, record: Record) -> None:
        self.course, self.record, self.ins, self.t = course, record, course.ins, -1

    def begin(self, record: Record, groups: dict[str, tuple[int, ...]]) -> FeedbackRun:
        """Continue this pass from its current step.

        Returns this pass.
        """
        return self

    def at_step(self, t: int) -> Record:
        """Navigate over step t and return its record, with measurements INS minus fix."""
        course = self.course
        samples = slice(t * course.per, (t + 1) * course.per)
        self.ins, u = strapdown.navigate(
            self.ins, course.dtheta[:, samples], course.dv[:, samples], course.dt, course.per
        )
        self.t = t
        position = (u.pos_end - self.record.u.pos_end[:, t : t + 1]) * earth.metre_scale(u.pos_end)
        velocity = u.vel_end - self.record.u.vel_end[:, t : t + 1]
        correction = torch.cat([position, velocity], -1)[..., : self.record.y.shape[-1]]
        return Record(self.record.y[:, t : t + 1] + correction, u, feedback=self)

    def correct(self, mean: Tensor) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """Correct attitude, velocity and position by the estimated errors.

        The attitude becomes C(alpha) C. Sensor biases remain states and do not correct the sensors.

        Returns the estimate relative to the uncorrected INS, [R, D], and a function that maps
        states [R, N, D] to their values after the correction. Shapes: mean [R, D].
        """
        alpha, dv, dp = mean[:, :9].to(self.ins.vel).split(3, -1)
        dcm = attitude.dcm_from_euler(alpha) @ self.ins.dcm
        scale = earth.metre_scale(self.ins.pos)
        self.ins = strapdown.InsState(
            dcm, self.ins.vel - dv, self.ins.pos - dp / scale, self.ins.acc
        )
        u = self.record.u
        open_dcm, open_vel, open_pos = (a[:, self.t] for a in (u.dcm_end, u.vel_end, u.pos_end))
        errors = [
            attitude.attitude_error(dcm, open_dcm),
            open_vel - self.ins.vel,
            (open_pos - self.ins.pos) * scale,
        ]
        total = torch.cat([*errors, mean[:, 9:].to(dcm)], -1)

        def subtract_correction(x: Tensor) -> Tensor:
            rotation = attitude.residual_error(x[..., :3], mean[:, None, :3])
            return torch.cat([rotation, x[..., 3:9] - mean[:, None, 3:9], x[..., 9:]], -1)

        return total, subtract_correction
