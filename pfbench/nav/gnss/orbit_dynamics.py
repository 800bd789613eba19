"""Agreement of broadcast orbits with the gravity of the Earth.

A parameter that is in another unit in all records leaves neighbours in agreement. The orbit then
has an acceleration that gravity does not explain.
"""

from __future__ import annotations

import pandas as pd
import torch
from torch import Tensor

from pfbench.nav import earth
from pfbench.nav.gnss.broadcast_elements import broadcast_elements
from pfbench.nav.gnss.rinex import CLOCK, ORBIT

J2 = 1.08262982e-3  # oblateness of the Earth [WGS 84]
# m/s^2; Sun and Moon: 0.3e-5 to 0.6e-5. A day of 404 GPS records leaves at most 0.97e-5 [ours]
ACCELERATION_TOLERANCE = 2e-5
_AGES = (-3600.0, -1800.0, 0.0, 1800.0, 3600.0)  # s from toe, within the interval of the fit
_STEP = 30.0  # s of the second difference; its error is below 1e-6 m/s^2


def compute_gravity(position: Tensor) -> Tensor:
    """Compute the gravitation of the oblate Earth.

    Args:
        position: Position from the centre in axes that do not rotate, z to the North, m, [..., 3].

    Returns:
        Gravitation, m/s^2, [..., 3].
    """
    radius = position.norm(dim=-1, keepdim=True)
    polar = 5.0 * (position[..., 2:] / radius) ** 2
    oblateness = 1.5 * J2 * (earth.A / radius) ** 2
    terms = polar.new_tensor([1.0, 1.0, 3.0]) - polar
    return -earth.GM * position / radius**3 * (1.0 + oblateness * terms)


def compute_unexplained_acceleration(table: pd.DataFrame) -> Tensor:
    """Compute the acceleration of broadcast orbits that gravity does not explain.

    Args:
        table: Ephemerides with RINEX names, `sow` and `gm`, n rows.

    Returns:
        Largest difference within an hour of the time of ephemeris, m/s^2, [n].
    """
    columns = dict.fromkeys([*CLOCK, *ORBIT, "sow", "gm"])
    eph = {c: torch.from_numpy(table[c].to_numpy(float, copy=True))[:, None, None] for c in columns}
    age = torch.tensor(_AGES, dtype=torch.float64)[:, None]
    eph["tk"] = age + torch.tensor([-_STEP, 0.0, _STEP], dtype=torch.float64)
    fixed = broadcast_elements(eph).earth_fixed()[0]
    angle = earth.OMEGA * (eph["tk"] - age)
    c, s = torch.cos(angle), torch.sin(angle)
    x, y, z = fixed.unbind(-1)
    position = torch.stack([c * x - s * y, s * x + c * y, z], dim=-1)
    before, middle, after = position.unbind(-2)
    acceleration = (before - 2.0 * middle + after) / _STEP**2
    return (acceleration - compute_gravity(middle)).norm(dim=-1).amax(-1)


def describe_unexplained(table: pd.DataFrame, name: str) -> tuple[str, ...]:
    """Describe ephemerides whose orbit contradicts gravity.

    Args:
        table: Ephemerides with RINEX names, `name`, `sow` and `gm`.
        name: Name of the file.

    Returns:
        One note, or none.
    """
    acceleration = compute_unexplained_acceleration(table).numpy()
    count = int((~(acceleration <= ACCELERATION_TOLERANCE)).sum())
    if not count:
        return ()
    worst = int(acceleration.argmax())
    return (
        f"{name}: {count} of {len(table)} ephemerides contradict gravity by more than "
        f"{ACCELERATION_TOLERANCE:g} m/s^2, at most {acceleration[worst]:.2g} m/s^2 for "
        f"{table['name'].iloc[worst]}. Check the units of all columns",
    )
