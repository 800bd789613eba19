"""What any filter could reach: the limit is that of a Kalman filter on a linear model, and the page states the store."""

import json
import math
import sys
from typing import Any

import numpy as np
import pytest
from checkout import ROOT

from pfbench import job

sys.path.insert(0, str(ROOT / "experiments" / "analyses"))  # scripts, not a package
import ceiling

ROW: dict[str, Any] = {
    "recorded": False, "drawn_from_model": True, "linear": False, "smoother_nees": 1.0, "bound": 2.0,
    "filter": [9.0, 9.0], "smoother": [4.2, 4.2], "sampled": [4.4, 4.4],
}  # fmt: skip


def test_on_a_linear_model_the_kalman_filter_reaches_the_limit() -> None:
    """By the smaller limit of the smoother, or by one that is 20 % too small, it would not."""
    row = ceiling.measure("linear_walk", 40)
    limit = ceiling.largest_limit(row)
    assert limit == row["bound"]
    gain, error = ceiling.relative_gain(row["filter"], limit)
    assert abs(gain) < 4 * error < 0.15
    for wrong in (0.8 * row["bound"], row["smoother"]):
        gain, error = ceiling.relative_gain(row["filter"], wrong)
        assert gain > 4 * error
    assert abs(row["smoother_nees"] - 1.0) < 4 * math.sqrt(2.0 / 40)  # a run counts at least once
    assert row["last_change"] < 1e-9


def test_the_standard_error_of_a_gain_is_its_scatter() -> None:
    rng, gains, errors = np.random.default_rng(1), [], []
    for _ in range(2000):
        causal = rng.chisquare(8, 40)
        smoothed = 0.4 * causal + 0.2 * rng.chisquare(8, 40)
        gain, error = ceiling.relative_gain(list(causal), list(smoothed))
        gains.append(gain)
        errors.append(error)
    assert np.mean(gains) == pytest.approx(1 - math.sqrt(0.6), abs=0.005)
    # 2000 repeats have an error of 1.6 %, the rest is of second order
    assert np.std(gains) == pytest.approx(np.mean(errors), rel=0.08)


def test_a_gain_leaves_lost_runs_out_and_pairs_the_others() -> None:
    assert ceiling.relative_gain([4.0, 16.0, math.nan], [1.0, 4.0, 5.0]) == (0.5, 0.0)
    gain, error = ceiling.relative_gain([4.0, 4.0], 1.0)
    assert (gain, error) == (0.5, 0.0)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, [4.4, 4.4]),
        ({"bound": 2.5}, 2.5),
        ({"bound": None}, [4.4, 4.4]),
        ({"sampled": [10.0, 10.0]}, 2.0),  # worse than the filter: too few particles
        ({"sampled": None, "bound": None}, None),  # the iterated smoother is not exact here
        ({"sampled": None, "bound": None, "linear": True}, [4.2, 4.2]),
        ({"recorded": True, "drawn_from_model": False}, None),
        ({"drawn_from_model": False, "smoother_nees": 0.1}, None),  # inflated noise
        ({"drawn_from_model": False, "smoother_nees": 1.5}, [4.4, 4.4]),
    ],
)
def test_which_limit_holds(changes: dict[str, Any], expected: Any) -> None:
    assert ceiling.largest_limit({**ROW, **changes}) == expected


def test_the_page_states_the_stored_results_of_all_scenarios() -> None:
    stored = json.loads(ceiling.STORE.read_text())
    assert set(stored) == set(ceiling.CONDITIONS)
    assert ceiling.PAGE.read_text() == ceiling.page(stored)
    assert "feedback" in stored["azimuth_closed_loop"]["refused"]
    named = {name.split()[0] for name in stored} | set(" ".join(ceiling.LEFT_OUT).split("`"))
    assert {*job.list_groups()["scenario"]} <= named


def test_no_stored_limit_is_above_the_error_of_the_filter() -> None:
    stored = json.loads(ceiling.STORE.read_text())
    limits = {name: ceiling.largest_limit(r) for name, r in stored.items() if "refused" not in r}
    gains = {
        name: ceiling.relative_gain(stored[name]["filter"], limit)
        for name, limit in limits.items()
        if limit is not None
    }
    assert len(gains) > 10
    assert {name: gain for name, gain in gains.items() if gain[0] < -4 * gain[1]} == {}
