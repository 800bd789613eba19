"""Recipes of the Earth, satellites, the atmosphere and the Allan deviation, which have no public name in pfbench."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import torch
from pfbench.experiments.oracles.book import Number, Source, recipe
from torch import Tensor

from pfbench.logs.sky.ephemeris import broadcast_elements
from pfbench.logs.worlds.standing import allan_deviation
from pfbench.nav import earth
from pfbench.nav.atmosphere import Sight, delay_in_ionosphere, delay_in_troposphere

_READ = "read in the file; the setting is in the test"
PYMAP3D = Source("pymap3d", "src/pymap3d/tests/test_{}.py", "BSD 2-Clause", _READ)
RTKLIB = Source("RTKLIB 2.4.2", "test/utest/{}.c", "BSD 2-Clause with two clauses", _READ)
ASTRONOMY = Source(
    "Astronomy Engine", "source/kotlin/src/test/.../Tests.kt, Gravity measured on Earth", "MIT", _READ
)  # fmt: skip
GEORINEX = Source("GeoRinex", "src/georinex/tests/test_kepler.py", "MIT", _READ)
NIST = Source(
    "NIST SP 1065, pages 107 and 108, in allantools", "tests/nbs14/test_nbs14_{}point.py",
    "public domain (NIST); facts of allantools (LGPL-3.0-or-later)", "read in the file; the 1000 data are remade by the printed generator",
)  # fmt: skip


def _at(source: Source, file: str) -> Source:
    return source._replace(file=source.file.format(file))


def _tensor(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def _position(lat: float, lon: float, h: float) -> Tensor:
    """Return a position of degrees and metres."""
    return _tensor(math.radians(lat), math.radians(lon), h)


@recipe(0.01, _at(PYMAP3D, "rcurve"))
def earth_radii() -> Iterator[Number]:
    """Radii of curvature of WGS-84, m."""
    meridian, transverse = earth.radii(torch.deg2rad(_tensor(0.0, 45.0, 90.0)))
    parallel = float(transverse[1] * torch.cos(_tensor(math.pi / 4)))
    for name, ours, printed, tolerance in (
        ("meridian_0", meridian[0], 6335439.327, 5e-4),
        ("meridian_45", meridian[1], 6367381.8156, 5e-5),
        ("transverse_90", transverse[2], 6399593.6258, 5e-5),
        ("parallel_45", parallel, 4517590.87884893, 1e-8),
    ):
        yield Number(name, "radius of curvature of WGS-84 at a latitude, m", printed, float(ours), tolerance)  # fmt: skip


@recipe(0.01, _at(PYMAP3D, "geodetic"))
def earth_fixed() -> Iterator[Number]:
    """Earth-fixed coordinates of 42 N 82 W 200 m, m."""
    ours = earth.ecef(_position(42.0, -82.0, 200.0)).tolist()
    printed = (660675.2518247, 5e-8), (-4700948.68316, 5e-6), (4245737.66222, 5e-6)
    for axis, value, (number, tolerance) in zip("xyz", ours, printed, strict=True):
        yield Number(axis, "Earth-fixed coordinate of 42 N 82 W, 200 m", number, value, tolerance)


@recipe(0.01, _at(PYMAP3D, "ellipsoid"))
def geodetic_position() -> Iterator[Number]:
    """Position of an Earth-fixed point, degrees and m."""
    lat, _, h = earth.geodetic(_tensor(660e3, -4700e3, 4247e3)).tolist()
    setting = "position of the Earth-fixed point 660, -4700, 4247 km"
    yield Number("latitude", f"{setting}, deg", 42.01467053507479, math.degrees(lat), 1e-13)
    yield Number("height", f"{setting}, m", 276.91369158042767, h, 1e-8)


@recipe(0.01, _at(RTKLIB, "t_coord"))
def rtklib_coordinates() -> Iterator[Number]:
    """Position of an Earth-fixed point, and a vector in local axes."""
    lat, lon, h = earth.geodetic(_tensor(-3.5173197701e6, 4.1316679161e6, 3.3412651227e6)).tolist()
    setting = "position of the Earth-fixed point -3517319.7701, 4131667.9161, 3341265.1227 m"
    yield Number("latitude", f"{setting}, deg", 3.1796021375e1, math.degrees(lat), 1e-7)
    yield Number("longitude", f"{setting}, deg", 1.3040799917e2, math.degrees(lon), 1e-7)
    yield Number("height", f"{setting}, m", 6.8863206206e1, h, 1e-4)
    axes = earth.local_axes(_position(35.0, 140.0, 0.0)) @ _tensor(0.3, 0.4, 0.5)
    for axis, ours, printed in zip(("east", "north", "up"), axes.tolist(), (-0.499254, 0.393916, 0.309152), strict=True):  # fmt: skip
        yield Number(
            axis, "the Earth-fixed vector 0.3, 0.4, 0.5 at 35 N 140 E", printed, ours, 1e-6
        )


@recipe(0.01, ASTRONOMY)
def normal_gravity() -> Iterator[Number]:
    """Normal gravity of WGS-84, m/s^2."""
    for lat, h, printed in (
        (0.0, 0.0, 9.7803253359), (10.0, 0.0, 9.781882400630266), (10.0, 1000.0, 9.778795562804849),
        (30.0, 100.0, 9.792938614507834), (45.0, 0.0, 9.80619776937321), (90.0, 0.0, 9.832184937858958),
    ):  # fmt: skip
        ours = float(earth.gravity(_tensor(math.radians(lat)), _tensor(h)))
        s2 = math.sin(math.radians(lat)) ** 2
        ground = float(earth.gravity(_tensor(math.radians(lat)), _tensor(0.0)))
        rounded = ground * (1.0 - (3.15704e-7 - 2.10269e-9 * s2) * h + 7.37452e-14 * h * h)
        note = "" if h == 0.0 else f"The formula is the same, but its factors of the height have six digits there. With these, ours differs by {abs(rounded - printed):.0e} m/s^2."  # fmt: skip
        yield Number(f"at_{lat:.0f}_{h:.0f}", f"normal gravity at {lat:.0f} degrees, {h:.0f} m, m/s^2", printed, ours, 1e-10, note=note)  # fmt: skip


_ALPHA_BETA = [0.2e-7, -0.8e-8, -0.5e-7, 0.1e-6, 0.2e6, 0.2e6, -0.1e6, -0.1e7]


@recipe(0.02, _at(RTKLIB, "t_atmos"))
def ionosphere() -> Iterator[Number]:
    """Delays of the broadcast ionosphere of GPS on L1, m."""
    positions = {"35N140E": (35.0, 140.0, 100.0), "80S170W": (-80.0, -170.0, 1000.0), "10N30E": (10.0, 30.0, 0.0)}  # fmt: skip
    for place, hour, azimuth, elevation, printed in (
        ("35N140E", 1, 60.0, 75.0, 6.73590532099438),
        ("80S170W", 1, 60.0, 75.0, 3.56895382197387),
        ("10N30E", 1, 60.0, 75.0, 3.80716435655161),
        ("35N140E", 13, 60.0, 75.0, 5.21796954585452),
        ("35N140E", 22, 60.0, 75.0, 5.90190539264777),
        ("35N140E", 1, 190.0, 3.0, 21.6345415123632),
        ("35N140E", 1, 350.0, 60.0, 7.33844278822561),
        ("35N140E", 1, 0.0, 90.0, 6.58339711400694),
    ):
        sight = Sight(
            _position(*positions[place]), torch.deg2rad(_tensor(azimuth)), torch.deg2rad(_tensor(elevation))
        )  # fmt: skip
        ours = float(delay_in_ionosphere(sight, torch.tensor(3600.0 * hour).double(), _ALPHA_BETA))
        yield Number(
            f"{place}_{hour}h_{elevation:.0f}deg", f"delay on L1 at {place}, {hour} h UTC, azimuth {azimuth:.0f}, elevation {elevation:.0f} deg, m", printed, ours, 1e-8
        )  # fmt: skip


@recipe(0.02, _at(RTKLIB, "t_atmos"))
def troposphere() -> Iterator[Number]:
    """Zenith delays of Saastamoinen's troposphere, m: the printed slant delays divided by their mapping 1 / sin(75 degrees)."""
    for name, position, printed in (
        ("at_100", (35.0, 140.0, 100.0), 2.44799870144088),
        ("at_1000", (-80.0, -170.0, 1000.0), 2.17295817298152),
    ):
        sight = Sight(_position(*position), _tensor(0.0), _tensor(math.pi / 2))
        zenith = printed * math.sin(math.radians(75.0))
        ours = float(delay_in_troposphere(sight))
        wet = _wet_delay(position[2], 273.16) - _wet_delay(position[2], 273.15)
        note = f"RTKLIB takes 0 degrees Celsius as 273.16 K, pfbench as 273.15 K. With 273.16 K ours differs by {abs(ours + wet - zenith):.0e} m."
        yield Number(name, f"zenith delay at {position[2]:.0f} m, humidity 50 %, m; printed slant delay times sin(75 deg)", zenith, ours, 1e-8, note=note)  # fmt: skip


def _wet_delay(height: float, zero: float) -> float:
    """Return the wet zenith delay of Saastamoinen with 0 degrees Celsius at a temperature, K."""
    t = zero + 15.0 - 6.5e-3 * height
    vapour = 6.108 * 0.5 * math.exp((17.15 * t - 4684.0) / (t - 38.45))
    return 0.002277 * (1255.0 / t + 0.05) * vapour


@recipe(0.02, GEORINEX)
def broadcast_orbit() -> Iterator[Number]:
    """Position of a GPS satellite by its broadcast elements, m."""
    values = {
        "e": 4.27323824e-3, "sqrtA": 5.15353571e3, "cic": 9.8720193e-8, "crc": 282.28125, "cis": -3.9115548e-8, "crs": -132.71875,
        "cuc": -6.60121440e-6, "cus": 5.31412661e-6, "deltan": 4.3123e-9, "Omega0": 2.29116688, "omega": -0.88396725, "i0": 0.97477102,
        "Omegadot": -8.025691e-9, "idot": -4.23946e-10, "M0": 2.24295542, "gm": 3.986005e14, "sow": 410400.0, "tk": 403272.930 - 410400.0,
    }  # fmt: skip
    elements = broadcast_elements({key: _tensor(value) for key, value in values.items()})
    printed = (-5.67841101e6, -2.49239629e7, 7.05651887e6)
    for axis, ours, number in zip(
        "xyz", elements.earth_fixed()[0][0].tolist(), printed, strict=True
    ):
        # the printed elements have nine digits
        yield Number(axis, "Earth-fixed position of a satellite 7127 s before its reference time, m", number, ours, 0.3)  # fmt: skip


@recipe(0.01, _at(NIST, "10"))
def allan_9() -> Iterator[Number]:
    """Allan deviations of nine frequencies."""
    y = np.array([892.0, 809.0, 823.0, 798.0, 671.0, 644.0, 883.0, 903.0, 677.0])[:, None]
    for tau, printed, tolerance in ((1, 91.22945, 5e-6), (2, 115.8082, 5e-5)):
        ours = float(allan_deviation(y, tau)[0])
        yield Number(f"adev_{tau}", f"Allan deviation of 9 frequencies at {tau}", printed, ours, tolerance)  # fmt: skip


@recipe(0.01, _at(NIST, "1000"))
def allan_1000() -> Iterator[Number]:
    """Allan deviations of a thousand numbers of a congruential generator."""
    states = [1234567890]
    while len(states) < 1000:
        states.append(16807 * states[-1] % 2147483647)
    y = np.array(states)[:, None] / 2147483647
    for tau, printed in ((1, 2.922319e-1), (10, 9.965736e-2), (100, 3.897804e-2)):
        ours = float(allan_deviation(y, tau)[0])
        yield Number(f"adev_{tau}", f"Allan deviation of 1000 frequencies at {tau}", printed, ours, 0.5 * 10 ** (math.floor(math.log10(printed)) - 6))  # fmt: skip
