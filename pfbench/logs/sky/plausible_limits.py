"""Plausible values of measured quantities: one table of ranges and changes for all readers."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import NamedTuple

from pfbench.core.parameter_checks import require_ranges
from pfbench.logs.units import UNIT_FACTORS


class Quantity(NamedTuple):
    """Range of a physical quantity and of its change between two rows.

    Attributes:
        unit: Unit.
        least: Smallest value.
        largest: Largest value.
        rate: Largest rate of change, unit/s. Infinite if the change is not limited.
        allowance: Change that is accepted in any time, for noise.
        source: Source of the numbers.
        dimension: Key of the other units of such columns in `UNIT_FACTORS`.
        key: Field of `PlausibleLimits` that replaces `largest`.
    """

    unit: str
    least: float
    largest: float
    rate: float = math.inf
    allowance: float = 0.0
    source: str = ""
    dimension: str = ""
    key: str = ""

    @property
    def units(self) -> dict[str, float]:
        """Other units of such columns, with the factors that convert them."""
        return UNIT_FACTORS.get(self.dimension, {})


_HALF_TURN, _QUARTER_TURN = 1.001 * math.pi, 1.001 * math.pi / 2

QUANTITIES = {
    "time": Quantity("s", -1e19, 1e19, source="nanoseconds since 1970 in a float64", dimension="time"),
    "specific force": Quantity(
        "m/s^2", -400.0, 400.0, 2e4, 100.0, "range of tactical accelerometers, 40 g",
        "force", "force_m_s2",
    ),
    "angular rate": Quantity(
        "rad/s", -35.0, 35.0, 2e3, 10.0, "range of common MEMS gyros, 2000 deg/s",
        "rate", "angular_rate_rad_s",
    ),
    "latitude": Quantity(
        "deg", -90.0, 90.0, source="definition", dimension="place"
    ),
    "longitude": Quantity(
        "deg", -180.0, 360.0, source="definition, both conventions", dimension="place"
    ),
    "height": Quantity(
        "m", -1000.0, 40000.0, source="Dead Sea with a margin; above all aircraft",
        dimension="length", key="height_m"
    ),
    "local position": Quantity("m", -2.1e7, 2.1e7, source="half the circumference of the Earth", dimension="length"),
    "geocentric position": Quantity("m", -6.5e6, 6.5e6, source="radius of the Earth and 120 km"),
    "velocity": Quantity(
        "m/s", -1000.0, 1000.0, 200.0, 10.0, "fastest aircraft 980 m/s; 20 g",
        "velocity", "speed_m_s"
    ),
    "roll": Quantity("rad", -_HALF_TURN, _HALF_TURN, source="definition", dimension="angle"),
    "pitch": Quantity("rad", -_QUARTER_TURN, _QUARTER_TURN, source="definition", dimension="angle"),
    "yaw": Quantity("rad", -1e4, 1e4, source="unwrapped, 1600 turns", dimension="angle"),
    "number": Quantity("1", 0.0, 1e9, source="counts and identifiers"),
    "static pressure": Quantity(
        "kPa", 0.2, 120.0, 20.0, 0.5, "standard atmosphere, 40 km to -1 km",
        "pressure",
    ),
    "magnetic field": Quantity(
        "gauss", -6.0, 6.0, 50.0, 1.0, "Earth 0.7 gauss and hard iron",
        "field",
    ),
    "speed of wheels": Quantity("m/s", -150.0, 150.0, 30.0, 5.0, "road vehicles; 3 g"),
    "yaw rate": Quantity(
        "rad/s", -10.0, 10.0, 50.0, 1.0, "road vehicles", "rate"
    ),
    "pseudorange": Quantity("m", 1.5e7, 6e7, source="height of GNSS orbits and 0.1 s of clock"),
    "range rate": Quantity("m/s", -3e3, 3e3, source="orbits 1 km/s, aircraft 1 km/s, clock 3 us/s"),
    "range sd": Quantity("m", 1e-3, 1e4, source="receivers"),
    "range variance": Quantity("m^2", 1e-6, 1e8, source="square of range sd"),
    "range rate sd": Quantity("m/s", 1e-4, 1e3, source="receivers"),
    "satellite clock": Quantity("m", -6e6, 6e6, source="20 ms; GPS limit 0.98 ms, E08 6 ms"),
    "satellite clock drift": Quantity("m/s", -2.0, 2.0, source="GPS limit 3.7e-9 s/s"),
    "troposphere": Quantity("m", 0.0, 150.0, source="2.5 m at the zenith, 1 degree elevation"),
    "ionosphere": Quantity("m", 0.0, 300.0, source="100 m at the zenith, low elevation"),
    "azimuth": Quantity("deg", -180.0, 360.0, source="definition"),
    "elevation": Quantity("deg", -90.0, 90.0, source="definition"),
    "carrier to noise": Quantity("dB-Hz", 0.0, 80.0, source="receivers"),
    "satellite position": Quantity("m", -4.6e7, 4.6e7, source="geostationary radius 42.2e6 m"),
    "satellite velocity": Quantity("m/s", -4500.0, 4500.0, source="speed of GNSS orbits"),
    "second of day": Quantity("s", 0.0, 1e6, source="a day, or several"),
}  # fmt: skip

LIMIT_COLUMNS = {
    "t": "time",
    **dict.fromkeys(("fx", "fy", "fz"), "specific force"),
    **dict.fromkeys(("wx", "wy", "wz"), "angular rate"),
    "lat_deg": "latitude",
    "lon_deg": "longitude",
    "h_m": "height",
    **dict.fromkeys(("pn", "pe", "pd", "rx_pn", "rx_pe", "rx_pd"), "local position"),
    **dict.fromkeys(("x", "y", "z"), "geocentric position"),
    **dict.fromkeys(("vn", "ve", "vd", "vn_d", "ve_d", "vd_d"), "velocity"),
    "roll": "roll",
    "pitch": "pitch",
    "yaw": "yaw",
    **dict.fromkeys(("fix", "path", "imu", "svid"), "number"),
    "p_static_kpa": "static pressure",
    **dict.fromkeys(("mx", "my", "mz"), "magnetic field"),
    "v_fwd": "speed of wheels",
    "yaw_rate_ned": "yaw rate",
    "pr": "pseudorange",
    "prr": "range rate",
    "sd_pr": "range sd",
    "pr_var": "range variance",
    "sd_prr": "range rate sd",
    "sclk": "satellite clock",
    "sclkd": "satellite clock drift",
    "tropo": "troposphere",
    "iono": "ionosphere",
    "az": "azimuth",
    "el": "elevation",
    "cn0": "carrier to noise",
    **dict.fromkeys(("sx", "sy", "sz"), "satellite position"),
    **dict.fromkeys(("svx", "svy", "svz"), "satellite velocity"),
    "utc_s": "second of day",
}


@dataclass(frozen=True)
class PlausibleLimits:
    """Limits of a platform, configuration key `scenario.limits`. They cannot be switched off.

    Attributes:
        force_m_s2: Largest specific force on an axis, m/s^2.
        angular_rate_rad_s: Largest angular rate on an axis, rad/s.
        speed_m_s: Largest velocity on an axis, m/s.
        acceleration_m_s2: Largest rate of change of a reference velocity, m/s^2.
        height_m: Largest height, m.
        fix_error_m: Largest distance of a fix or a pseudorange from the reference, m.
        drop_fixes: Whether fixes beyond `fix_error_m` or `speed_m_s` are dropped with a note. They
            are an error otherwise.

    Raises:
        ValueError: If a limit is not positive and finite.
    """

    force_m_s2: float = 400.0
    angular_rate_rad_s: float = 35.0
    speed_m_s: float = 1000.0
    acceleration_m_s2: float = 200.0
    height_m: float = 40000.0
    fix_error_m: float = 1000.0
    drop_fixes: bool = False

    def __post_init__(self) -> None:
        rule = "(0, inf) Set the largest value that the platform can reach."
        numbers = (field.name for field in fields(self) if field.name != "drop_fixes")
        require_ranges("scenario.limits", self, **dict.fromkeys(numbers, rule))

    def select(self, name: str) -> Quantity:
        """Return a quantity with the limits of the platform.

        Args:
            name: Name in `QUANTITIES`.

        Returns:
            The quantity.
        """
        quantity = QUANTITIES[name]
        if name == "velocity":
            quantity = quantity._replace(rate=self.acceleration_m_s2)
        if not quantity.key:
            return quantity
        largest = getattr(self, quantity.key)
        least = quantity.least if quantity.key == "height_m" else -largest
        return quantity._replace(least=least, largest=largest)
