"""Delays in the atmosphere against another program, and satellites at transmission against the light-time equation."""

from __future__ import annotations

import math

import pytest
import torch

from pfbench.nav.atmosphere import Sight, delay_in_ionosphere, delay_in_troposphere

COEFFICIENTS = (1.118e-08, 7.451e-09, -5.96e-08, -5.96e-08, 90110.0, 0.0, -196600.0, -65540.0)
# latitude, longitude deg, height m, azimuth, elevation deg, time of the week s, and the delays in ionosphere and troposphere m
# that RTKLIB 2.4.3 has (by pyrtklib 0.2.7); its mapping of the troposphere is 1 / sin(elevation)
OTHER = [
    (52.5, 13.4, 50.0, 210.0, 20.0, 126641.0, 7.090727, 6.947383),
    (40.1, -105.15, 1577.0, 65.0, 60.0, 408641.0, 2.930349, 2.255649),
    (-33.0, 151.0, 10.0, 0.0, 12.0, 20000.0, 9.751507, 11.507082),
    (1.0, 100.0, 0.0, 300.0, 85.0, 560000.0, 3.056614, 2.408344),
]


@pytest.mark.parametrize("row", OTHER)
def test_delays_are_those_of_another_program(row: tuple[float, ...]) -> None:
    lat, lon, h, azimuth, elevation, time, ionosphere, troposphere = row
    place = torch.tensor([math.radians(lat), math.radians(lon), h], dtype=torch.float64)
    angles = torch.tensor([[azimuth], [elevation]], dtype=torch.float64).deg2rad()
    sight = Sight(place, *angles)
    seconds = torch.tensor(time, dtype=torch.float64)
    assert float(delay_in_ionosphere(sight, seconds, COEFFICIENTS)) == pytest.approx(
        ionosphere, abs=1e-6
    )
    ratio = float(delay_in_troposphere(sight)) / troposphere
    # Black and Eisner's mapping is below 1 / sin(elevation): 0.1 % at 45 degrees, 2 % at 12
    sine = math.sin(math.radians(elevation))
    assert ratio == pytest.approx(1.001 * sine / math.sqrt(0.002001 + sine**2), abs=1e-4)
