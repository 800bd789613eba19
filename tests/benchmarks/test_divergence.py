"""Thresholds of the scenarios: those of the table, and the raw error of a model that has a closed form."""

from __future__ import annotations

import json
import sys

import pytest
import yaml
from checkout import ROOT
from scipy import stats

sys.path.insert(0, str(ROOT / "benchmarks"))  # scripts, not a package
import divergence

ROWS = json.loads(divergence.STORE.read_text())


def test_a_scenario_has_the_threshold_of_the_table_or_none() -> None:
    differing = {}
    for name, row in ROWS.items():
        content = yaml.safe_load((ROOT / "conf" / "scenario" / f"{name}.yaml").read_text())
        expected = divergence.round_up(row["threshold"])
        if not divergence.separates(row["diverged"]):
            expected = None
        stored = content.get("paper", {}).get("divergence_threshold")
        if stored != expected:
            differing[name] = (stored, expected)
    assert differing == {}


def test_the_raw_error_of_a_measured_position_is_that_of_a_normal_variable() -> None:
    """The sd is 1. The largest twentieth of the squares is left out."""
    limit = stats.chi2.ppf(0.95, 1)
    square = (0.95 - 2.0 * limit**0.5 * stats.norm.pdf(limit**0.5)) / 0.95
    raw = divergence.measure("linear_walk", 100)
    se = 0.5 / 4000**0.5  # relative, of 40 windows in 100 runs; squares vary by 0.97 of their mean
    assert raw["steps"] == 1
    assert raw["rmse"] == pytest.approx(square**0.5, rel=4 * se)


@pytest.mark.parametrize(
    ("ekf", "sir", "swapped", "reckoning", "expected"),
    [
        (0.0, None, 1.0, 0.2, True),
        (0.2, 0.0, 0.0, 0.7, True),
        (0.2, 0.2, 1.0, 1.0, False),
        (0.2, None, 1.0, 1.0, False),
        (0.0, None, 0.0, 0.2, False),
    ],
)
def test_a_threshold_separates_correct_from_wrong_filters(
    ekf: float, sir: float | None, swapped: float, reckoning: float, expected: bool
) -> None:
    shares = {"ekf": ekf, "swapped": swapped, "dead_reckoning": reckoning}
    if sir is not None:
        shares["sir"] = sir
    assert divergence.separates(shares) == expected
