"""The rotating Earth of a strapdown model against an integration in Earth-fixed axes that shares no code."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from recorded_data import believed
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from pfbench.core.record import Record, iterate_steps
from pfbench.model.constraints import Constraints
from pfbench.model.earth_form import FlatEarth, RotatingEarth
from pfbench.model.strapdown_blocks import StrapdownBlocks
from pfbench.nav.strapdown import PreintegratedImu, preintegrate

# WGS-84 [NIMA TR8350.2]
A, F, OMEGA, G_E, G_P = 6378137.0, 1 / 298.257223563, 7.292115e-5, 9.7803253359, 9.8321849378
B = A * (1 - F)
E2, M = F * (2 - F), OMEGA**2 * A**2 * B / 3.986004418e14
LATITUDE, HEIGHT, SECONDS, STEP = 48.0, 2000.0, 60.0, 0.25
FORCE, RATE = np.array([0.2, 0.3, 9.8]), np.array([0.002, -0.001, 0.03])  # right, forward, up
VELOCITY = np.array([150.0, -120.0, 10.0])  # East, North, Up


def axes(latitude: float, longitude: float) -> np.ndarray:
    """East, North and Up in Earth-fixed axes, rows."""
    (sp, cp), (sl, cl) = ((np.sin(a), np.cos(a)) for a in (latitude, longitude))
    return np.array([[-sl, cl, 0], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]])


def fixed_to_earth(latitude: float, height: float) -> np.ndarray:
    n = A / np.sqrt(1 - E2 * np.sin(latitude) ** 2)
    return np.array([(n + height) * np.cos(latitude), 0, (n * (1 - E2) + height) * np.sin(latitude)])  # fmt: skip


def gravity(r: np.ndarray) -> np.ndarray:
    """Normal gravity in Earth-fixed axes; the latitude by fixed-point iteration."""
    flat, longitude = np.hypot(r[0], r[1]), np.arctan2(r[1], r[0])
    latitude = np.arctan2(r[2], flat * (1 - E2))
    for _ in range(6):
        n = A / np.sqrt(1 - E2 * np.sin(latitude) ** 2)
        latitude = np.arctan2(r[2] + E2 * n * np.sin(latitude), flat)
    height, s2 = flat / np.cos(latitude) - n, np.sin(latitude) ** 2
    size = (A * G_E * (1 - s2) + B * G_P * s2) / np.sqrt(A**2 * (1 - s2) + B**2 * s2)
    size *= 1 - 2 * height / A * (1 + F + M - 2 * F * s2) + 3 * (height / A) ** 2
    return -size * axes(latitude, longitude)[2]


def integrate() -> tuple[np.ndarray, np.ndarray, Rotation]:
    """Position, velocity and attitude at the end, in the East, North, Up of the start."""
    to_local, first = axes(np.radians(LATITUDE), 0.0), fixed_to_earth(np.radians(LATITUDE), HEIGHT)
    spin = np.array([0, 0, OMEGA])

    def slope(_: float, s: np.ndarray) -> np.ndarray:
        c, v = s[:9].reshape(3, 3), s[9:12]
        x, y, z = RATE - c.T @ spin
        turn = c @ np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        acceleration = c @ FORCE + gravity(s[12:]) - 2 * np.cross(spin, v)
        return np.concatenate([turn.ravel(), acceleration, v])

    start = np.concatenate([to_local.T.ravel(), to_local.T @ VELOCITY, first])
    end = solve_ivp(slope, (0, SECONDS), start, method="DOP853", rtol=1e-12, atol=1e-9).y[:, -1]
    attitude = Rotation.from_matrix(to_local @ end[:9].reshape(3, 3))
    return to_local @ (end[12:] - first), to_local @ end[9:12], attitude


def follow(model: StrapdownBlocks) -> np.ndarray:
    """State at the end of steps without noise, [16]."""
    count, pieces = round(SECONDS / STEP), 25
    spans = torch.full((1, count, pieces), STEP / pieces, dtype=torch.float64)
    force, rate = (torch.from_numpy(a).expand(1, count, pieces, 3) for a in (FORCE, RATE))
    bias = torch.zeros(1, count, 6, dtype=torch.float64)
    imu = preintegrate(force, rate, spans, bias)
    size = float(-gravity(fixed_to_earth(np.radians(LATITUDE), HEIGHT)) @ axes(np.radians(LATITUDE), 0)[2])  # fmt: skip
    u = PreintegratedImu(*imu, bias, torch.full((1, count), size).double(), spans.sum(-1))
    x = model.origin.reshape(1, 1, -1).clone()
    x[..., 4:7] = torch.from_numpy(VELOCITY)
    quiet = torch.zeros(1, 1, 12, dtype=torch.float64)
    for _, at, record in iterate_steps(model, Record(torch.zeros(1, count, 3), u)):
        x = at.propagate(x, record.u, quiet)
    return np.asarray(x[0, 0])


def test_a_minute_on_the_rotating_earth_is_that_of_earth_fixed_axes() -> None:
    position, velocity, attitude = integrate()
    off = {}
    for form in (FlatEarth(), RotatingEarth(LATITUDE, HEIGHT)):
        x = follow(StrapdownBlocks(believed([1.0, 1.0, 2.0], None), Constraints(), form))
        turn = (Rotation.from_quat(x[:4], scalar_first=True).inv() * attitude).magnitude()
        off[type(form)] = np.array([np.linalg.norm(x[7:10] - position), np.linalg.norm(x[4:7] - velocity), turn])  # fmt: skip
    assert (off[FlatEarth] > [30.0, 1.0, 2e-3]).all()  # m, m/s, rad
    assert (off[RotatingEarth] < 1e-3 * off[FlatEarth]).all()


def test_a_gyro_at_rest_measures_the_rate_of_the_earth() -> None:
    known = Constraints(zero_rate_sd=1e-5)
    model = StrapdownBlocks(believed([1.0, 1.0, 2.0], None), known, RotatingEarth(90.0))
    x = model.origin.reshape(1, 1, -1).clone()
    x[..., 10:13] = torch.tensor([1e-3, 2e-3, 3e-3])
    u = PreintegratedImu(*(torch.zeros(1, *shape).double() for shape in ((4,), (3,), (3,), (9, 6), (6,), (), ())))  # fmt: skip
    seen = model.observation(x, u).mean[0, 0, 3:]
    assert seen.tolist() == pytest.approx([1e-3, 2e-3, 3e-3 + OMEGA], abs=1e-9)
    assert model.choices[0].startswith("rotating WGS-84 Earth")
    with pytest.raises(ValueError, match=r"model\.earth\.latitude_deg must be in \[-90, 90\], got 91"):  # fmt: skip
        RotatingEarth(91.0)
