"""Broadcast orbits against gravity: units that are wrong in all records."""

from __future__ import annotations

import math
from pathlib import Path

import pandas as pd
import pytest
import torch
from ephemeris_cases import EPHEMERIDES, later_by_two_hours
from recorded_data import DATA

from pfbench.logs.sky.broadcast_orbits import BroadcastConstellation
from pfbench.logs.sky.ephemeris_checks import J2, compute_gravity
from pfbench.nav import earth


def three(first: pd.DataFrame = EPHEMERIDES) -> pd.DataFrame:
    """Ephemerides that agree with their neighbours, whatever the first ones are."""
    second = later_by_two_hours(first)
    return pd.concat([first, second, later_by_two_hours(second)], ignore_index=True)


def notes_of(folder: Path, table: pd.DataFrame) -> list[str]:
    table.to_parquet(folder / "eph.parquet")
    constellation = BroadcastConstellation(str(folder), "eph.parquet", "2016-06-06T12:00:00")
    return [note for note in constellation.notes if "contradict gravity" in note]


def test_gravity_is_the_gradient_of_its_potential() -> None:
    position = torch.tensor([[2.1e7, -9e6, 1.3e7], [1e6, 2e7, -1.9e7]], dtype=torch.float64)
    position.requires_grad_()
    radius = position.norm(dim=-1)
    legendre = 1.5 * (position[:, 2] / radius) ** 2 - 0.5
    potential = earth.GM / radius * (1.0 - J2 * (earth.A / radius) ** 2 * legendre)
    (gradient,) = torch.autograd.grad(potential.sum(), position)
    torch.testing.assert_close(compute_gravity(position), gradient, rtol=1e-12, atol=0.0)


@pytest.mark.parametrize(
    ("column", "factor"),
    [
        ("crc", -1.0),
        ("crc", 1 / 3.6),
        ("deltan", 1 / 3.6),
        ("Omegadot", math.pi / 180),
        ("i0", 1.2),
    ],
)
def test_a_factor_in_all_records_is_a_note(tmp_path: Path, column: str, factor: float) -> None:
    assert notes_of(tmp_path, three()) == []
    wrong = EPHEMERIDES.assign(**{column: EPHEMERIDES[column] * factor})
    (note,) = notes_of(tmp_path, three(wrong))
    assert "Check the units" in note


@pytest.mark.skipif(DATA is None, reason="the recorded ephemerides are not installed")
def test_a_day_of_recorded_ephemerides_follows_gravity() -> None:
    constellation = BroadcastConstellation(
        str(DATA), "gnss_orbits/brdc1580.16n", "2016-06-06T12:00:00"
    )
    assert len(constellation.names) > 25
    assert not [note for note in constellation.notes if "gravity" in note]
