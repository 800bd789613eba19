"""Positions on the WGS-84 ellipsoid in a local frame, and Euler angles, with numpy alone."""

from __future__ import annotations

import numpy as np

from pfbench.results.error_measures import Array

SEMI_MAJOR = 6378137.0  # m
ECCENTRICITY_2 = (2 - 1 / 298.257223563) / 298.257223563


def to_north_east_down(geodetic: Array, origin: Array) -> Array:
    """Convert geodetic positions to the tangent frame of an origin.

    Args:
        geodetic: Latitude, longitude and height, [T, 3], deg, deg, m.
        origin: Latitude, longitude and height of the origin, [3].

    Returns:
        North, East, Down, [T, 3], m.
    """
    lat, lon = np.radians(origin[:2])
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    turn = np.array(
        [
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [-sin_lon, cos_lon, 0.0],
            [-cos_lat * cos_lon, -cos_lat * sin_lon, -sin_lat],
        ]
    )
    return (_earth_fixed(geodetic) - _earth_fixed(origin)) @ turn.T


def _earth_fixed(geodetic: Array) -> Array:
    """Convert latitude, longitude (deg) and height (m) to Earth-centred coordinates, m."""
    lat, lon = np.radians(geodetic[..., 0]), np.radians(geodetic[..., 1])
    h = geodetic[..., 2]
    normal = SEMI_MAJOR / np.sqrt(1 - ECCENTRICITY_2 * np.sin(lat) ** 2)
    x, y = (normal + h) * np.cos(lat) * np.cos(lon), (normal + h) * np.cos(lat) * np.sin(lon)
    return np.stack([x, y, (normal * (1 - ECCENTRICITY_2) + h) * np.sin(lat)], axis=-1)


def rotation_from_quaternion(q: Array) -> Array:
    """Return the rotation matrices [T, 3, 3] of unit quaternions (x, y, z, w), [T, 4]."""
    x, y, z, w = (q / np.linalg.norm(q, axis=-1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def euler_angles(rotation: Array) -> Array:
    """Return roll, pitch, yaw [T, 3] in rad of rotations [T, 3, 3] from body to North, East, Down."""
    roll = np.arctan2(rotation[:, 2, 1], rotation[:, 2, 2])
    pitch = -np.arcsin(np.clip(rotation[:, 2, 0], -1.0, 1.0))
    return np.stack([roll, pitch, np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])], axis=-1)


def wrap_to_half_turn(angle: Array) -> Array:
    """Return angles in rad within half a turn of 0."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
