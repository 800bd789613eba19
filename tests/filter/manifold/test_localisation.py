"""The localisation of a robot in the plane as published for UKF-M, within the chance of its 100 runs: see the recipe."""

import math
from functools import cache

import pytest
from pfbench.experiments.oracles.manifold_rows import (
    PUBLISHED_RUNS,
    RADIUS,
    RATE,
    RUNS,
    SECONDS,
    build,
    draw,
    measure,
)

PUBLISHED = {  # degrees, m
    "ekf": (12.00, 0.76),
    "invariant_ekf": (11.35, 0.45),
    "invariant_ukf": (11.35, 0.45),
}


@cache
def measured(name: str) -> dict[str, float]:
    return measure(build(name), RUNS, RATE)


@pytest.mark.parametrize("name", list(PUBLISHED))
def test_errors_are_those_published(name: str) -> None:
    row = measured(name)
    for key, published in zip(("heading", "position"), PUBLISHED[name], strict=True):
        error = row[f"{key}_sd"] * math.sqrt(1.0 / RUNS + 1.0 / PUBLISHED_RUNS)
        assert abs(row[key] - published) < 4 * error, (key, row)


def test_the_invariant_filters_are_one_and_better_than_the_ekf() -> None:
    """Published: the same curves, and 0.45 m in place of 0.76 m."""
    left, right, plain = (
        measured(name)["position"] for name in ("invariant_ekf", "invariant_ukf", "ekf")
    )
    assert left == pytest.approx(right, rel=0.01)
    assert 1.2 < plain / left < 4.0


def test_the_robot_drives_on_the_circle_in_the_plane() -> None:
    _, record, truth = draw(1, RATE, seed=1)
    centre = truth[0, :, 4:6].mean(0)
    radius = (truth[0, :, 4:6] - centre).norm(dim=-1)
    assert float(radius.min()) > 0.99 * RADIUS
    assert float(radius.max()) < 1.01 * RADIUS
    assert float(truth[..., [1, 2, 6]].abs().max()) == 0.0
    assert int((~record.y.isnan()).all(-1).sum()) == SECONDS
