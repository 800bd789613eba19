"""The published localisation of a robot in the plane, within the chance of its 100 runs."""

from __future__ import annotations

import json
import sys
from functools import cache
from typing import Any

import pytest
from checkout import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))  # scripts, not a package
import localisation

RUNS, RATE = 200, 2


@cache
def measured(name: str) -> dict[str, Any]:
    return localisation.measure(localisation.filters()[name], RUNS, RATE)


@pytest.mark.parametrize("name", ["EKF", "invariant EKF, left", "invariant UKF, right"])
def test_errors_are_those_published(name: str) -> None:
    row = measured(name)
    for key, published in zip(("heading", "position"), localisation.PUBLISHED[name], strict=True):
        assert abs(row[key] - published) < 4 * row[f"{key}_error"], (key, row)


def test_the_invariant_filters_are_one_and_better_than_the_ekf() -> None:
    """Published: the same curves, and 0.45 m in place of 0.76 m."""
    left, right, plain = (
        measured(name)["position"]
        for name in ("invariant EKF, left", "invariant UKF, right", "EKF")
    )
    assert left == pytest.approx(right, rel=0.01)
    assert 1.2 < plain / left < 4.0


def test_the_robot_drives_on_the_circle_in_the_plane() -> None:
    _, record, truth = localisation.draw(1, RATE, seed=1)
    centre = truth[0, :, 4:6].mean(0)
    radius = (truth[0, :, 4:6] - centre).norm(dim=-1)
    assert float(radius.min()) > 0.99 * localisation.RADIUS
    assert float(radius.max()) < 1.01 * localisation.RADIUS
    assert float(truth[..., [1, 2, 6]].abs().max()) == 0.0
    assert int((~record.y.isnan()).all(-1).sum()) == localisation.SECONDS


def test_the_page_states_the_stored_results_of_all_published_filters() -> None:
    stored = json.loads(localisation.STORE.read_text())
    assert localisation.PAGE.read_text() == localisation.page(stored)
    assert [row["filter"] for row in stored] == list(localisation.PUBLISHED)
    for row in stored:
        published = localisation.PUBLISHED[row["filter"]]
        for key, value in zip(("heading", "position"), published, strict=True):
            assert abs(row[key] - value) < 4 * row[f"{key}_error"], row
