"""Faults planted in recorded logs: each named and none misnamed, each remedy removes its finding and brings no new one."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from log_faults import (  # fmt: skip
    CLEAN,
    FAULTS,
    LISTED,
    SHARED,
    Tables,
    checks_of,
    findings_of,
    planted,
    shared_tables,
)
from recorded_data import recorded
from synthetic_log import write

from pfbench.core.random_stream import PhiloxStream
from pfbench.filter.loop import run_filter
from pfbench.job import build_plan, compose
from pfbench.scenario import LogCorrections, inspect_log

# what a short or noisy log does not show; 57 of 65 faults must be named on all six logs
HIDDEN = {
    "imu clock +0.03 s": {"wing"},  # whose own offset is -0.011 s
    "imu clock 1000 ppm fast": {"quad 2", "quad 17"},  # of 18 s
    "fixes turned 12 deg": {"walk"},  # of 15 m, on which it moves fixes by less than 3 m
    "axes of ROS": {"wing"},  # with an attitude of an on-board filter
    "force sample +150": {"quad 2"},  # vibration of 100 m/s^2
    "force sample +30": {"quad 2", "quad 13", "quad 17"},
    "force late 0.2 s": {
        "wing",
        "quad 2",
        "quad 13",
        "quad 17",
    },  # whose force does not show a delay
}
FEWEST_ON_ALL = 57
PAIRS = [
    ("car", "forward-left-up", "gnss clock +1 s"),
    ("car", "gyro in deg/s", "imu clock +0.1 s"),
    ("car", "gyro bias 4 deg/s", "lever arm 3.4 m"),
    ("walk", "gyro z sign", "heights above the geoid"),
    ("walk", "attitude in degrees", "gnss clock +18 s"),
    ("wing", "reference velocity km/h", "one fix off 18.6 km"),
    ("wing", "force in g", "gyro scale 8 %"),
    ("quad 13", "fixes North/East exchanged", "accelerometer bias 1.2 m/s^2"),
    ("quad 13", "imu clock +18 s", "yaw + 90 deg"),
    ("quad 17", "imu gap 0.5 s", "lever arm 1.6 m"),
]
LOGS = tuple(SHARED)
# What is said beside the fault that is named. After a jump of the clock, a log whose turns repeat agrees with the reference
# at the offset of another turn, too.
BESIDE = {
    ("quad 2", "imu clock jump 1 s"): {"gyro bias", "imu clock"},
    ("quad 17", "imu clock jump 1 s"): {"imu clock"},
    ("quad 17", "reference ENU"): {"fix axes"},
    ("wing", "fixes frozen 3 s"): {"fix outliers"},
    ("wing", "axes of ROS"): {"accelerometer bias"},
    ("walk", "reference jumps 8 m"): {"reference velocity"},
}
# Its remedy exchanges North and East and leaves the vertical, so that the fixes seem to be upside down: a fault of the check.
HALF_MENDED = {("quad 17", "reference ENU")}


@cache
def tables(name: str) -> Tables:
    return shared_tables(name)


def own(name: str) -> set[str]:
    """What is listed for a log without a planted fault."""
    return LISTED.get(name, set())


def check_named(log: str, fault: str) -> None:
    spoken = checks_of(planted(tables(log), fault))
    if log not in HIDDEN.get(fault, set()):
        assert FAULTS[fault].named in spoken
    beside = BESIDE.get((log, fault), set())
    assert spoken <= {FAULTS[fault].named, *FAULTS[fault].also, *own(log), *beside}


def check_remedies(log: str, fault: str) -> None:
    """Paste each remedy: its finding goes, and no new one comes."""
    spoilt = planted(tables(log), fault)
    before = findings_of(spoilt)
    for finding in before:
        beside = BESIDE.get((log, fault), set())
        if not finding.settings or finding.check in own(log) | beside:
            continue
        after = checks_of(spoilt, dict(finding.settings))
        assert finding.check not in after
        if finding.check == FAULTS[fault].named and (log, fault) not in HALF_MENDED:
            assert not after & beside
        assert after <= {other.check for other in before} | own(log)


ROTATED = [(LOGS[i % len(LOGS)], fault) for i, fault in enumerate(FAULTS)]
ALL = [(log, fault) for fault in FAULTS for log in LOGS]


@recorded
@pytest.mark.parametrize(("log", "fault"), ROTATED)
def test_a_planted_fault_is_named_and_its_remedies_mend_it(log: str, fault: str) -> None:
    check_named(log, fault)
    check_remedies(log, fault)


@recorded
@pytest.mark.slow
@pytest.mark.parametrize(("log", "fault"), ALL)
def test_each_fault_is_named_on_six_logs_and_mended(log: str, fault: str) -> None:
    check_named(log, fault)
    check_remedies(log, fault)


def test_enough_faults_are_named_on_all_logs_and_have_a_remedy() -> None:
    assert len(FAULTS) == 65
    assert sum(not hidden for hidden in HIDDEN.values()) + len(FAULTS) - len(HIDDEN) >= FEWEST_ON_ALL  # fmt: skip


@recorded
@pytest.mark.parametrize("log", CLEAN)
def test_a_clean_log_is_neither_refused_nor_warned_of(log: str) -> None:
    findings = findings_of(shared_tables(log))
    assert {f.check for f in findings if f.level in ("refuse", "warn")} == own(log)


@recorded
@pytest.mark.parametrize(("log", "first", "second"), PAIRS)
def test_two_faults_at_once_are_not_misnamed(log: str, first: str, second: str) -> None:
    spoken = checks_of(planted(tables(log), first, second))
    wanted = {FAULTS[first].named, FAULTS[second].named}
    assert spoken & wanted
    allowed = {check for fault in (first, second) for check in FAULTS[fault].also}
    assert spoken <= wanted | allowed | own(log)


@recorded
def test_offsets_and_lever_arms_are_measured() -> None:
    """Offsets to a hundredth of a second, a lever arm within 0.15 m; a car does not show the arm upwards."""
    log = tables("car")
    for fault, check, value in (
        ("imu clock +18 s", "imu clock", 18.0),
        ("imu clock +0.03 s", "imu clock", 0.03),
        ("gnss clock +18 s", "gnss clock", 18.0),
    ):
        found = next(f for f in findings_of(planted(log, fault)) if f.check == check)
        assert found.statistic == pytest.approx(value, abs=0.01)
    arm = next(f for f in findings_of(planted(log, "lever arm 3.4 m")) if f.check == "lever arm")
    forward, right, _ = arm.settings["corrections"]["lever_arm"]
    assert np.hypot(forward - 3.0, right - 0.8) < 0.15


def error_of(folder: Path, settings: dict[str, object]) -> float:
    """Root mean square of the position error of an EKF behind the first ten seconds, m."""
    words = [f"data.root={folder.parent}", f"scenario.folder={folder.name}"]
    plan = build_plan(compose(["scenario=user_log", "filter=ekf", *words]))
    keys = {**settings, "corrections": LogCorrections(**settings.get("corrections", {}))}  # type: ignore[arg-type]
    episode = replace(plan, scenario=replace(plan.scenario, **keys)).draw_episode(torch.arange(4))
    with torch.no_grad():
        draws = PhiloxStream(1, torch.arange(4))
        result = run_filter(plan.method, plan.model, episode.record, draws)
    error = result.mean[..., 7:10] - episode.truth["position"]
    late = episode.time > episode.time[0] + 10.0
    return float(error[:, late].square().sum(-1).nanmean().sqrt())


@recorded
@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("log", ["quad 13", "car"])
def test_printed_settings_leave_the_filter_as_good_as_on_the_clean_log(
    tmp_path: Path, log: str, fault: str
) -> None:
    """All settings of an inspection together; an inspection may withhold them, which says that nothing mends the log."""
    found = inspect_log(write(tmp_path / "spoilt", planted(tables(log), fault)))
    if found.settings:
        clean = error_of(write(tmp_path / "clean", tables(log)), {})
        assert error_of(tmp_path / "spoilt", dict(found.settings)) < 1.2 * clean
