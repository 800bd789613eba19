"""Options of the command `judge`: sources of the trajectories and rules of the comparison."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from pfbench.judge.trajectory_table import ALL_COLUMNS

FRAMES = ("", "ned", "enu")
FORMATS = ("", "table", "tum", "kf_gins", "nmea", "result")
ALIGNMENTS = ("none", "offset", "yaw")
_LARGEST_TIME = 1e10  # s, above the GPS and Unix times of this century
_ORIGIN_LIMITS = (90.0, 360.0, 1e5)  # deg, deg, m
HOLES = ("refuse", "skip")


@dataclass(frozen=True)
class SourceOptions:
    """Options of one program, `NAME.key=value` on the command line.

    Attributes:
        frame: Axes of a TUM file, "ned" or "enu".
        shift: Time added to the clock of the file, s.
        columns: Name in a CSV file by name of pfbench.
        scale: Factor by name of pfbench, for a column in another unit; before `shift`.
        format: One of `FORMATS`; empty to find it from the content.
        sd: Pattern of the KF-GINS file of standard deviations; empty for none.
    """

    frame: str = ""
    shift: float = 0.0
    columns: Mapping[str, str] = field(default_factory=dict)
    scale: Mapping[str, float] = field(default_factory=dict)
    format: str = ""
    sd: str = ""

    def __post_init__(self) -> None:
        _require(
            "NAME.shift",
            abs(self.shift) <= _LARGEST_TIME,
            f"at most {_LARGEST_TIME:g} s",
            self.shift,
        )
        _require("NAME.frame", self.frame in FRAMES, "ned or enu", self.frame)
        _require("NAME.format", self.format in FORMATS, ", ".join(FORMATS[1:]), self.format)
        for name, factor in self.scale.items():
            _require(
                "NAME.scale", math.isfinite(factor) and factor != 0, "finite and not 0", factor
            )
            _require("NAME.scale", name in ALL_COLUMNS, f"of {', '.join(ALL_COLUMNS)}", name)


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
        for name in ("every", "largest_gap", "limit", "block"):
            _require(name, getattr(self, name) >= 0, "at least 0", getattr(self, name))
        _require("tolerance", 0 < self.tolerance < math.inf, "positive", self.tolerance)
        _require("margin", 1e-6 <= self.margin <= 1e6, "from 1e-6 to 1e6", self.margin)
        _require("alpha", 1e-9 <= self.alpha < 1, "from 1e-9 to below 1", self.alpha)
        _require("coverage", 0 < self.coverage <= 1, "above 0 and at most 1", self.coverage)
        _require("from", self.start < self.end, "before to", f"{self.start} and {self.end}")
        _require("holes", self.holes in HOLES, " or ".join(HOLES), self.holes)
        _require("align", self.align in ALIGNMENTS, " or ".join(ALIGNMENTS), self.align)
        _require(
            "origin", len(self.origin) in (0, 3), "lat_deg,lon_deg,h_m", list(self.origin) or "none"
        )
        for value, limit in zip(self.origin, _ORIGIN_LIMITS, strict=False):
            _require("origin", abs(value) <= limit, f"within {limit:g}", value)


@contextmanager
def name_program(program: str) -> Iterator[None]:
    """Write the name of the program in the messages of readers, which call it NAME."""
    try:
        yield
    except ValueError as error:
        raise ValueError(str(error).replace("NAME.", f"{program}.")) from error


def _require(name: str, is_valid: bool, requirement: str, value: Any) -> None:
    if not is_valid:
        raise ValueError(f"{name} must be {requirement}, got {value}. Change {name}=...")
