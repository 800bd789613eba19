"""Faults planted in recorded logs: each named and none misnamed, each remedy removes its finding and brings no new one."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from drawn_faults import COUNT, SPOILT, Drawn, cut, draw_faults, draw_pairs, judge, ratio_of
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

from pfbench.scenario import inspect_log

# what a short or noisy log does not show; 62 of 68 faults are named on all six logs
HIDDEN = {
    "imu clock +0.03 s": {"wing"},  # whose own offset is -0.011 s
    "imu clock 1000 ppm fast": {"quad 2", "quad 17"},  # of 18 s
    "fixes turned 12 deg": {"walk"},  # of 15 m, on which it moves fixes by less than 3 m
    "force sample +150": {"quad 2"},  # vibration of 100 m/s^2
    "force sample +30": {"quad 2", "quad 13", "quad 17"},
    "force late 0.2 s": {
        "wing",
        "quad 2",
        "quad 13",
        "quad 17",
    },  # whose force does not show a delay
}
LOGS = tuple(SHARED)
# What is said beside the fault that is named. After a jump of the clock, a log whose turns repeat agrees with the reference
# at the offset of another turn, too.
BESIDE = {
    ("quad 2", "imu clock jump 1 s"): {"gyro bias", "imu clock"},
    ("quad 17", "imu clock jump 1 s"): {"imu clock"},
    ("quad 17", "reference ENU"): {"fix axes"},
    ("wing", "fixes frozen 3 s"): {"fix outliers"},
    ("wing", "sensor turned 20 deg"): {
        "spikes"
    },  # one recorded sample jumps by 7 m/s^2 there and back
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


@recorded
@pytest.mark.parametrize("log", CLEAN)
def test_a_clean_log_is_neither_refused_nor_warned_of(log: str) -> None:
    findings = findings_of(shared_tables(log))
    assert {f.check for f in findings if f.level in ("refuse", "warn")} == own(log)


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
    magnetic = {**log, "reference": log["reference"].assign(yaw=log["reference"]["yaw"] + 0.21)}
    assert next(f for f in findings_of(magnetic) if f.check == "heading").settings["corrections"]["bias"]["reference"]["yaw"] == pytest.approx(0.21, abs=0.02)  # fmt: skip
    arm = next(f for f in findings_of(planted(log, "lever arm 3.4 m")) if f.check == "lever arm")
    forward, right, _ = arm.settings["corrections"]["lever_arm"]
    assert np.hypot(forward - 3.0, right - 0.8) < 0.15


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
        fault_of = Drawn(fault, FAULTS[fault].plant, frozenset())
        assert ratio_of(tmp_path / "spoilt", dict(found.settings), tables(log), fault_of) < SPOILT


@recorded
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["single", "pair"])
def test_no_remedy_of_a_drawn_fault_spoils_the_log(tmp_path: Path, kind: str) -> None:
    """Nine of ten are named, and none has a remedy that leaves the filter worse than 1.2 times that of the clean log."""
    faults = draw_faults() if kind == "single" else list(draw_pairs())
    found = {}
    for k, drawn in enumerate(faults):
        log = LOGS[k % len(LOGS)]
        found[drawn.name] = judge(drawn, log, cut(log), tmp_path / f"log_{k}")
    spoilt = {
        name: out for name, out in found.items() if out.settings and not (out.ratio <= SPOILT)
    }
    assert not spoilt
    assert sum(out.word in ("right", "harmless", "mended") for out in found.values()) >= 0.9 * COUNT
