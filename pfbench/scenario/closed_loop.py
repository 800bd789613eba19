"""Closed loop: an INS that is corrected in flight, after every filter interval, by what the filter thinks it is wrong by."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pfbench.nav import attitude, earth, strapdown
from pfbench.record import Record, Underway

_LAYOUT = {"attitude": (0, 1, 2), "velocity": (3, 4, 5), "position": (6, 7, 8)}


@dataclass(frozen=True, eq=False)
class CorrectedIns:
    """What is needed to fly an INS again, interval by interval: a `Loop` of a record whose inputs are the uncorrected INS's.

    Args:
        ins: the INS at the start, R runs.
        dtheta: angle increments, body axes [R, n, 3] rad.
        dv: velocity increments [R, n, 3] m/s.
        dt: sampling interval, s.
        per: samples in a filter interval.
    """

    ins: strapdown.Ins
    dtheta: Tensor
    dv: Tensor
    dt: float
    per: int

    def begin(self, record: Record, groups: dict[str, tuple[int, ...]]) -> Underway:
        """A flight of its own; many may be under way at once.

        Raises:
            ValueError: states whose first nine are not errors of attitude, velocity and position.
        """
        if any(groups.get(name) != parts for name, parts in _LAYOUT.items()):
            raise ValueError(
                "scenario.closed=true: an INS is corrected by a model whose first nine states are its errors of attitude, "
                f"velocity and position, this one has {groups or 'states that are no differences'}; choose ins_gnss or "
                "sins_gps_azimuth, or give closed=false"
            )
        return CorrectedFlight(self, record)


class CorrectedFlight:
    """One filter's flight. Navigation stays in double precision, whatever the filter computes in.

    The records of its steps have it as their loop, being how they go on.

    Attributes:
        t: the step that was last asked for; -1 before the first.
    """

    def __init__(self, course: CorrectedIns, record: Record) -> None:
        self.course, self.record, self.ins, self.t = course, record, course.ins, -1

    def begin(self, record: Record, groups: dict[str, tuple[int, ...]]) -> Underway:
        """Goes on from where it is."""
        return self

    def at(self, t: int) -> Record:
        """The interval that the corrected INS flies, and what the same fixes say of it: y is INS minus fix."""
        c, samples = self.course, slice(t * self.course.per, (t + 1) * self.course.per)
        self.ins, u = strapdown.navigate(self.ins, c.dtheta[:, samples], c.dv[:, samples], c.dt, c.per)
        self.t = t
        position = (u.pos_end - self.record.u.pos_end[:, t : t + 1]) * earth.metre_scale(u.pos_end)
        velocity = u.vel_end - self.record.u.vel_end[:, t : t + 1]
        moved = torch.cat([position, velocity], -1)[..., : self.record.y.shape[-1]]
        return Record(self.record.y[:, t : t + 1] + moved, u, loop=self)

    def correct(self, mean: Tensor) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """Attitude C <- C(alpha) C, velocity and position subtract; biases stay states: nothing is taken off the sensors."""
        alpha, dv, dp = mean[:, :9].to(self.ins.vel).split(3, -1)
        dcm = attitude.dcm_from_euler(alpha) @ self.ins.dcm
        scale = earth.metre_scale(self.ins.pos)
        self.ins = strapdown.Ins(dcm, self.ins.vel - dv, self.ins.pos - dp / scale, self.ins.acc)
        u = self.record.u
        open_dcm, open_vel, open_pos = (a[:, self.t] for a in (u.dcm_end, u.vel_end, u.pos_end))
        errors = [attitude.attitude_error(dcm, open_dcm), open_vel - self.ins.vel, (open_pos - self.ins.pos) * scale]
        told = torch.cat([*errors, mean[:, 9:].to(dcm)], -1)

        def left(x: Tensor) -> Tensor:
            turned = attitude.residual_error(x[..., :3], mean[:, None, :3])
            return torch.cat([turned, x[..., 3:9] - mean[:, None, 3:9], x[..., 9:]], -1)

        return told, left
