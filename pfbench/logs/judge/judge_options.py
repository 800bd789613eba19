"""Options of the command `judge`: sources of the trajectories and rules of the comparison."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

from pfbench.core.parameter_checks import require, require_range, require_ranges
from pfbench.logs.judge.trajectory_table import ROLES
from pfbench.logs.units import SECONDS

FORMATS = ("", "table", "tum", "kf_gins", "nmea", "rtklib", "euroc", "kitti", "result")
_LARGEST_TIME = 1e10  # s, above the GPS and Unix times of this century
_ORIGIN_LIMITS = (90.0, 360.0, 1e5)  # deg, deg, m


@dataclass(frozen=True)
class SourceOptions:
    """Options of a file, that of a program or a table of an own log, `NAME.key=value` on the command line.

    Attributes:
        frame: Axes of a TUM file, "ned" or "enu".
        shift: Time added to the clock of the file, s.
        columns: Name in a CSV file by name of pfbench.
        names: Names of pfbench by name in a table of an own log, which come before those that are understood.
        scale: Factor by name of pfbench, for a column in another unit; before `shift`.
        format: One of `FORMATS`; empty to find it from the content.
        sd: KF-GINS file of standard deviations, or its pattern; empty for none.
        time: Unit of the times: s, ms, us, ns, minutes or hours.
        repeats: "refuse", or "first": keep the first row of each time. For tables of an own log.
    """

    frame: str = ""
    shift: float = 0.0
    columns: Mapping[str, str] = field(default_factory=dict)
    names: Mapping[str, str] = field(default_factory=dict)
    scale: Mapping[str, float] = field(default_factory=dict)
    format: str = ""
    sd: str = ""
    time: str = "s"
    repeats: str = "refuse"

    def __post_init__(self) -> None:
        require_range("NAME.shift", self.shift, f"[-{_LARGEST_TIME:g}, {_LARGEST_TIME:g}]")
        choices = {
            "frame": ("", "ned", "enu"), "format": FORMATS, "time": tuple(SECONDS), "repeats": ("refuse", "first"),
        }  # fmt: skip
        for key, allowed in choices.items():
            require(
                getattr(self, key) in allowed,
                f"NAME.{key}",
                f"be {', '.join(filter(None, allowed[:-1]))} or {allowed[-1]}",
                getattr(self, key),
            )
        columns = dict.fromkeys(name for names in ROLES.values() for name in names)
        for name, factor in self.scale.items():
            require(
                math.isfinite(factor) and factor != 0, "NAME.scale", "be finite and not 0", factor
            )
            require(name in columns, "NAME.scale", f"be of {', '.join(columns)}", name)

    @property
    def factors(self) -> dict[str, float]:
        """Factors of the columns, with that of the unit of the times."""
        second = SECONDS[self.time]
        return (
            {**self.scale}
            if second == 1
            else {**self.scale, "t": self.scale.get("t", 1.0) * second}
        )


@dataclass(frozen=True)
class JudgeOptions:
    """Rules of the comparison.

    Attributes:
        start: First scored time on the clock of the reference, s. Key `from`.
        end: Last scored time, s. Key `to`.
        every: Least time between two scored epochs, s.
        tolerance: Largest difference of two epochs that count as common, s.
        largest_gap: Longest time between two rows of the reference, s; 0 for the larger of 1 s and
            2.5 steps.
        holes: "refuse" or "skip": epochs in longer gaps of the reference.
        coverage: Least share of the time that a run must cover, else it is lost.
        limit: Position error above which a run diverges and no error counts more, m; 0 for none.
        align: "none", "offset" or "yaw": motion that is removed from positions.
        origin: Latitude, longitude (deg) and height (m) of the local frame; empty for that of the
            reference.
        block: Length of the blocks of time, s; 0 for 30 blocks.
        baseline: Program that all others are compared with; empty for all pairs.
        alpha: Error of a family of tests.
        margin: Relative difference of errors within which programs are equal.
    """

    start: float = -math.inf
    end: float = math.inf
    every: float = 0.0
    tolerance: float = 0.01
    largest_gap: float = 0.0
    holes: str = "refuse"
    coverage: float = 0.9
    limit: float = 0.0
    align: str = "none"
    origin: Sequence[float] = ()
    block: float = 0.0
    baseline: str = ""
    alpha: float = 0.05
    margin: float = 0.05

    def __post_init__(self) -> None:
        least = ("every", "largest_gap", "limit", "block")
        rules = {**dict.fromkeys(least, "[0, inf]"), "tolerance": "(0, inf)", "coverage": "(0, 1]"}
        require_ranges("", self, **rules, margin="[1e-6, 1e6]", alpha="[1e-9, 1)")
        require(self.start < self.end, "from", "be before to", f"{self.start} and {self.end}")
        for key, allowed in (("holes", ("refuse", "skip")), ("align", ("none", "offset", "yaw"))):
            require(getattr(self, key) in allowed, key, f"be {' or '.join(allowed)}", getattr(self, key))  # fmt: skip
        require(len(self.origin) in (0, 3), "origin", "be lat_deg,lon_deg,h_m", list(self.origin))
        for value, limit in zip(self.origin, _ORIGIN_LIMITS, strict=False):
            require_range("origin", value, f"[-{limit:g}, {limit:g}]")


@contextmanager
def name_program(program: str) -> Iterator[None]:
    """Write the name of the program in the messages of readers, which call it NAME."""
    try:
        yield
    except ValueError as error:
        raise ValueError(str(error).replace("NAME.", f"{program}.")) from error
