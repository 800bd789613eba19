"""Orders and signs of axes: 48 of a body, 16 of a level frame, and nine conventions of the attitude."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from pfbench.core.parameter_checks import require
from pfbench.files.table_file import Array

_BODY, _LEVEL = ("x", "y", "z"), ("n", "e", "d")
ENU_TO_NED: Array = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FLU_TO_FRD: Array = np.diag([1.0, -1.0, -1.0])  # a body with forward, left, up


# the signed permutations, those near the identity first
BODY_ORDERS: tuple[Array, ...] = tuple(sorted(
    (
        np.array([[sign[i] * (j == order[i]) for j in range(3)] for i in range(3)], float)
        for order in itertools.permutations(range(3))
        for sign in itertools.product((1, -1), repeat=3)
    ),
    key=lambda m: (-np.trace(m), np.abs(m - np.eye(3)).sum()),
))  # fmt: skip
LEVEL_ORDERS = tuple(m for m in BODY_ORDERS if abs(m[2, 2]) == 1.0)


def name_axes(matrix: Array, is_level: bool = False) -> list[str]:
    """Name the recorded axes that a signed permutation takes, such as [x, -y, -z]."""
    letters = _LEVEL if is_level else _BODY
    index = np.abs(matrix).argmax(1)
    return [
        f"{'-' if row[i] < 0.0 else ''}{letters[i]}" for row, i in zip(matrix, index, strict=True)
    ]


def axes_matrix(key: str, axes: Sequence[str | float], is_level: bool = False) -> Array:
    """Return the matrix from recorded to body or level axes, [3, 3].

    Args:
        key: Name of a sensor or a frame, for the message.
        axes: Recorded axes such as [x, -y, -z], three angles of a sensor, or one turn of a frame, deg.
        is_level: Whether these are axes of a frame.

    Raises:
        ValueError: If they are not three different axes, or angles.
    """
    if len(axes) == (1 if is_level else 3) and all(isinstance(a, int | float) for a in axes):
        angles = [-float(axes[0]), 0.0, 0.0] if is_level else [float(a) for a in axes[::-1]]
        return np.asarray(Rotation.from_euler("ZYX", angles, degrees=True).as_matrix())
    letters, matrix = _LEVEL if is_level else _BODY, np.zeros((3, 3))
    for row, name in zip(matrix, map(str, axes), strict=False):
        if name.removeprefix("-") in letters:
            row[letters.index(name.removeprefix("-"))] = -1.0 if name[0] == "-" else 1.0
    require(
        len(axes) == 3 and (np.abs(matrix).sum(0) == 1.0).all() and (np.abs(matrix).sum(1) == 1.0).all(),
        f"scenario.corrections.{'level_axes' if is_level else 'mounting'}.{key}",
        f"be three different axes such as {'[e, n, -d], or a turn in deg' if is_level else '[x, -y, -z], or roll, pitch, yaw in deg'}",
        list(axes),
        f"Name the recorded axes that are {'North, East, Down' if is_level else 'forward, right, down'}.",
    )  # fmt: skip
    return matrix


# name of the setting: what is wrong, and the angles (roll, pitch, yaw) that are right
CONVENTIONS: dict[str, tuple[str, Callable[[Array, Array, Array], tuple[Array, Array, Array]]]] = {
    "yaw_from_east": ("yaw is counted from East, anticlockwise", lambda r, p, y: (r, p, np.pi / 2 - y)),
    "yaw_anticlockwise": ("yaw is counted anticlockwise", lambda r, p, y: (r, p, -y)),
    "yaw_plus_90": ("yaw is 90 deg too large", lambda r, p, y: (r, p, y - np.pi / 2)),
    "yaw_minus_90": ("yaw is 90 deg too small", lambda r, p, y: (r, p, y + np.pi / 2)),
    "yaw_plus_180": ("yaw is turned by 180 deg", lambda r, p, y: (r, p, y + np.pi)),
    "roll_pitch_exchanged": ("roll and pitch are exchanged", lambda r, p, y: (p, r, y)),
    "pitch_negated": ("pitch has the other sign", lambda r, p, y: (r, -p, y)),
    "forward_left_up": ("roll, pitch, yaw are those of forward, left, up in East, North, Up", lambda r, p, y: (r, -p, np.pi / 2 - y)),
    "roll_negated": ("roll has the other sign", lambda r, p, y: (-r, p, y)),
}  # fmt: skip


def convert_angles(name: str, angles: Array) -> Array:
    """Return angles, rad, [k, 3], that were recorded in another convention."""
    roll, pitch, yaw = angles.T
    return np.stack(CONVENTIONS[name][1](roll, pitch, yaw), -1)
