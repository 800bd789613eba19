"""Times per step: the file survives a round trip and shows damage, and intervals of ratios cover the truth."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from pfbench.results.step_times import (
    STEP_TIMES,
    StepTimes,
    describe_costs,
    estimate_cost_ratio,
    read_step_times,
    select_job_times,
    write_step_times,
)


def entry(**times: list[float]) -> dict[str, object]:
    jobs = {
        key: {"label": key, "commit": "c", "engine": "eager", "cpu": t, "wall": [2 * v for v in t]}
        for key, t in times.items()
    }
    return {"clock": "cpu", "steps": 20, "jobs": jobs}


def test_the_file_has_the_times_of_the_clock_that_decides(tmp_path: Path) -> None:
    times = [1e-3, 2e-3, 3e-3, 4e-3, 5e-3]
    write_step_times(tmp_path, {"cell": entry(a=times)})
    stored = read_step_times(tmp_path)
    job = select_job_times(stored)["a", "c"]
    np.testing.assert_array_equal(job.seconds, times)
    assert StepTimes.from_metadata({"step_time": job.to_metadata()}).group == "cell"  # type: ignore[union-attr]
    write_step_times(tmp_path, {"cell": {**entry(a=times), "clock": "wall"}})
    np.testing.assert_array_equal(
        select_job_times(read_step_times(tmp_path))["a", "c"].seconds, [2 * t for t in times]
    )
    assert read_step_times(tmp_path / "none") == {}


@pytest.mark.parametrize("fault", ["number", "text", "rounds", "negative", "format"])
def test_damage_is_refused_with_a_remedy(tmp_path: Path, fault: str) -> None:
    times = [1e-3] * (4 if fault == "rounds" else 5)
    write_step_times(tmp_path, {"cell": entry(a=[-t for t in times] if fault == "negative" else times)})  # fmt: skip
    path = tmp_path / STEP_TIMES
    content = json.loads(path.read_text())
    if fault == "number":
        content["conditions"]["cell"]["jobs"]["a"]["cpu"][0] = 1e-4
    if fault == "format":
        content["format"] = 99
    if fault in ("number", "format"):
        path.write_text(json.dumps(content))
    if fault == "text":
        path.write_text("{")
    with pytest.raises(ValueError, match=rf"{STEP_TIMES}.*Delete it and run: pfbench cost"):
        read_step_times(tmp_path)


def test_one_condition_has_the_paired_interval_of_students_t() -> None:
    rng = np.random.default_rng(1)
    a, b = np.exp(rng.normal(size=(2, 9)))
    low, high = estimate_cost_ratio([(a, b)]).interval(0.05)
    expected = stats.ttest_rel(np.log(a), np.log(b)).confidence_interval(0.95)
    np.testing.assert_allclose([low, high], [expected.low, expected.high], rtol=1e-12)


def test_intervals_over_conditions_cover_and_pairing_removes_the_rounds() -> None:
    """A slow round slows all filters: paired ratios are not affected, and 95 % of intervals cover."""
    rng = np.random.default_rng(2)
    studies, covered, wide = 2000, 0, 0
    for _ in range(studies):
        pairs = []
        for sd in (0.02, 0.05, 0.1):
            slow = rng.normal(0, 1.0, 6)
            x, y = np.exp(slow + sd * rng.normal(size=(2, 6)))
            pairs.append((2.0 * x, y))
        low, high = estimate_cost_ratio(pairs).interval(0.05)
        covered += bool(low < np.log(2.0) < high)
        wide += bool(high - low > 0.5)
    error = np.sqrt(0.95 * 0.05 / studies)
    assert covered / studies > 0.95 - 3 * error
    assert wide < 0.01 * studies  # without pairing nearly all are: the SD of a round is 1


def test_costs_need_all_conditions_and_the_same_rounds() -> None:
    def at(value: float, group: str = "g") -> StepTimes:
        return StepTimes(np.full(5, value), group)

    times = [{"a": at(2e-3), "b": at(1e-3)}, {"a": at(8e-3), "b": at(1e-3)}]
    costs = describe_costs(times, "a", "b", 0.05)
    assert costs == pytest.approx(
        {"ms": 4.0, "ms_low": 4.0, "ms_high": 4.0, "cost": 4.0, "cost_low": costs["cost_low"],
         "cost_high": costs["cost_high"]}
    )  # fmt: skip
    assert describe_costs([times[0], {"b": at(1e-3)}], "a", "b", 0.05) == {}
    assert "cost" not in describe_costs([{"a": at(2e-3), "b": at(1e-3, "other")}], "a", "b", 0.05)
    assert describe_costs([], "a", "b", 0.05) == {}
