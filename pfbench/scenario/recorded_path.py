"""Real motion for simulated sensors: a recorded trajectory as the path of a simulated flight."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from pfbench.nav import attitude, earth
from pfbench.nav.replay import Recorded, Replay
from pfbench.nav.trajectory import Flight
from pfbench.scenario.logs import frd
from pfbench.scenario.recorded import locate
from pfbench.scenario.tables import numbers, read_table, times


@dataclass(frozen=True)
class RecordedPath:
    """A trajectory from a file (see `read_motion`), smoothed and sampled at any rate; a `Path` of `SimulatedFlight`.

    The file's checksum is a part of its `repr`, and so of what decides a world; where the file lies is not.

    Args:
        root: the folder of all data sets (configuration key data.root).
        folder: the trajectory's folder in it.
        origin: lat_deg, lon_deg, h_m where pn = pe = pd = 0.
        file: name of the table, without .parquet or .csv.
        start, end: seconds of the file; None for all of it.
        smoothing: seconds between the knots of the splines; see `Replay`.
        whole: the path is cut to a whole number of these seconds; a multiple of the scenario's interval.

    Raises:
        ValueError: a missing root, folder or file; an end before the start; on flying, a faulty table, or what `Replay` raises.
    """

    root: str | None = field(repr=False)
    folder: str
    origin: Sequence[float]
    file: str = "trajectory"
    start: float | None = None
    end: float | None = None
    smoothing: float = 0.4
    whole: float = 1.0
    checksum: str = field(init=False, default="")

    def __post_init__(self) -> None:
        if self.start is not None and self.end is not None and not self.start < self.end:
            raise ValueError(f"path.start={self.start}, path.end={self.end}: the path must end after it starts")
        content = read_table(locate(self.root, self.folder), self.file, {}).rows
        digest = hashlib.sha256(content.to_csv(index=False).encode()).hexdigest()
        object.__setattr__(self, "checksum", digest[:16])

    def fly(self, rate: float) -> Flight:
        """Truth and ideal sensors at `rate` samples per second."""
        recorded = read_motion(locate(self.root, self.folder), self.file, self.origin)
        low, high = (limit if given is None else given for given, limit in ((self.start, -math.inf), (self.end, math.inf)))
        chosen = (recorded.time >= low) & (recorded.time <= high)
        if int(chosen.sum()) < 2:
            first, last = float(recorded.time[0]), float(recorded.time[-1])
            raise ValueError(f"path.start={self.start}, path.end={self.end}: the file covers t = {first:.3f} to {last:.3f} s")
        return Replay(Recorded(*(part[chosen] for part in recorded)), self.smoothing, self.whole).fly(rate)


def read_motion(folder: str | Path, name: str, origin: Sequence[float]) -> Recorded:
    """A trajectory from a table with t [s], pn, pe, pd [m], vn, ve, vd [m/s], roll, pitch, yaw [rad], forward-right-down.

    North and East are taken as they are, whatever grid they come from: a map grid turned by its convergence moves the track a
    little on the globe, and a vehicle drives as well there. Heights are of the origin's kind, -pd above it, not above its
    tangent plane [ours].

    Raises:
        ValueError: a faulty table or origin; names file, column, row and remedy.
    """
    if len(origin) != 3 or not abs(origin[0]) <= 89.0:
        raise ValueError(f"path.origin={list(origin)}: give lat_deg (-89 to 89), lon_deg, h_m of the point pn = pe = pd = 0")
    table = read_table(Path(folder), name, {})
    time = torch.from_numpy(times(table, longest=1.0))
    enu, vel = (torch.from_numpy(frd(numbers(table, columns))) for columns in (("pn", "pe", "pd"), ("vn", "ve", "vd")))
    roll, pitch, yaw = numbers(table, ("roll", "pitch", "yaw")).T
    if np.abs(pitch).max() > 1.001 * math.pi / 2:
        raise ValueError(f"{table.name}: pitch reaches {np.abs(pitch).max():g} rad; if in degrees, multiply angles by pi / 180")
    dcm = attitude.dcm_from_euler(torch.from_numpy(np.stack([pitch, roll, -yaw], axis=-1)))
    centre = torch.tensor([math.radians(origin[0]), math.radians(origin[1]), origin[2]], dtype=torch.float64)
    plan = earth.from_local_enu(enu * enu.new_tensor([1.0, 1.0, 0.0]), centre)
    return Recorded(time, torch.cat([plan[:, :2], centre[2] + enu[:, 2:]], -1), vel, dcm)
