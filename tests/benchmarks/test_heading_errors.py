"""The pages of wrong headings, simulated and recorded, and of the reach of sigma points state the stored results."""

from __future__ import annotations

import json
import sys

from checkout import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))  # scripts, not a package
import heading_errors
import numpy as np
import point_reach
import recorded_headings
import torch

from pfbench.filter.gaussian.linearisation_rules import CubaturePoints, SigmaPointLinearisation


def test_the_page_is_written_from_the_stored_results() -> None:
    stored = json.loads(heading_errors.STORE.read_text())
    assert (ROOT / "benchmarks" / "heading_errors.md").read_text() == heading_errors.page(stored)
    names = set(heading_errors.filters())
    assert {(r["angle"], r["filter"]) for r in stored["rows"]} == {
        (angle, name) for angle in heading_errors.ANGLES for name in names
    }


def test_settled_runs_have_intervals() -> None:
    """Wilson's interval of 19 of 20, and ranks 6 and 15 of 20 for the median; later ranks may never settle."""
    times = np.r_[np.arange(1.0, 15.0), np.full(6, np.inf)]
    row = heading_errors.describe_times(times) | {"settled": 19}
    assert row["settle_s"] == 10.5
    assert heading_errors.format_settled(row, 20) == "95 [76, 99] | 10.5 [6.0, never]"
    for heading in ("settled [%]", "95 % interval"):
        assert heading in heading_errors.page({"runs": 20, "rows": []})


def test_the_page_of_recorded_headings_is_written_from_the_stored_results() -> None:
    stored = json.loads(recorded_headings.STORE.read_text())
    text = (ROOT / "benchmarks" / "recorded_headings.md").read_text()
    assert text == recorded_headings.page(stored)
    assert {(r["scenario"], r["angle"], r["filter"]) for r in stored["rows"]} == {
        (scenario, angle, name)
        for scenario in recorded_headings.SCENARIOS
        for angle in heading_errors.ANGLES
        for name in heading_errors.filters()
    }


def test_a_run_settles_from_its_first_window_within_the_bound() -> None:
    """A window of 5 s that starts at 12 s, after a shorter one; steps without a reference are left out."""
    seconds = torch.arange(1.0, 41.0)
    error = torch.full((40,), 20.0)
    error[3:7], error[12:] = 1.0, 2.0
    position = torch.full((40,), 9.0)
    position[30:] = torch.nan
    at, final, ratio, distance = recorded_headings.settle(error, 0.5 * error, position, seconds)
    assert (at, final, ratio, distance) == (12.0, 2.0, 1.0, 3.0)
    never = recorded_headings.settle(error + 9.0, error, position, seconds)
    assert never[0] == float("inf")


def test_the_page_of_the_reach_is_written_from_the_stored_results() -> None:
    stored = json.loads(point_reach.STORE.read_text())
    assert (ROOT / "benchmarks" / "point_reach.md").read_text() == point_reach.page(stored)
    assert {(r["heading_sd"], r["reach"]) for r in stored["rows"]} == {
        (sd, reach) for sd in point_reach.HEADING_SDS for reach in point_reach.REACHES
    }


def test_the_limit_of_the_filters_is_the_largest_reach_that_settles() -> None:
    """At the limit all runs settle up to 60 degrees, at the next reach some runs do not."""
    stored = json.loads(point_reach.STORE.read_text())
    settled = {(r["heading_sd"], r["reach"]): r["settled"] / stored["runs"] for r in stored["rows"]}
    limit = SigmaPointLinearisation(CubaturePoints()).largest_angle
    beyond = min(reach for reach in point_reach.REACHES if reach > limit)
    for sd in (30, 45, 60):
        assert settled[sd, limit] == 1.0 > settled[sd, beyond]


def test_the_spread_decides_at_ninety_degrees() -> None:
    """Measured again with few runs: points at 2 rad settle, points at 6 rad do not."""
    near, far = (
        heading_errors.measure(heading_errors.unscented_filter(alpha), 90.0, 6)
        for alpha in (0.33, 1.0)
    )
    assert near["settled"] == 6
    assert far["settled"] == 0
