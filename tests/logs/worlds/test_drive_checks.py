"""Tables of a drive: signs of wheels, and the scale of slow axes."""

import math
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from refusals import check_refused
from synthetic_log import tables, write

from pfbench.logs.worlds.log_agreement import (
    check_wheel_direction,
    describe_missing_times,
)
from pfbench.logs.worlds.log_tables import LogTable
from pfbench.logs.worlds.trajectory_file import read_motion

TIME = np.arange(0.0, 12.0, 0.3)


def wheels(speed: np.ndarray, time: np.ndarray = TIME) -> tuple[str, ...]:
    table = LogTable(pd.DataFrame({"t": time, "v_fwd": speed}), "odometry.csv", True, {})
    return check_wheel_direction(table, time, speed)


@pytest.mark.parametrize("row", [0, 17, len(TIME) - 1])
def test_one_wheel_speed_with_the_wrong_sign_is_an_error(row: int) -> None:
    speed = np.full(len(TIME), 5.0)
    speed[row] *= -1.0
    check_refused(
        [(rf"change its sign near zero, got .* in line {max(row, 1) + 2}", lambda: wheels(speed))],
        remedy=False,
    )


def test_a_car_that_brakes_and_reverses_is_accepted() -> None:
    speed = np.clip(8.0 - 6.0 * TIME, -3.0, None)  # 0.6 g
    speed[TIME > 6.0] = 5.0
    speed[(TIME > 5.0) & (TIME <= 6.0)] = 0.0
    assert wheels(speed) == ()


def test_a_drive_that_is_backwards_throughout_is_noted() -> None:
    (note,) = wheels(np.full(len(TIME), -5.0))
    assert "the wheels turn backwards in 40 of 40 moving rows" in note
    assert wheels(np.zeros(len(TIME))) == ()


@pytest.mark.parametrize("factor", [1.0, 0.3048, 3.6, -1.0, math.pi / 180])
def test_a_slow_climb_shows_another_unit_of_the_height(tmp_path: Path, factor: float) -> None:
    """A climb of 0.1 m/s, far below the speed at which single rows show a scale."""
    table = tables(8.0)["reference"]
    table["pd"] = (3.0 + 0.2 * np.cos(0.5 * table["t"])) * factor
    table["vd"] = -0.1 * np.sin(0.5 * table["t"])
    write(tmp_path, {"reference": table})
    context = nullcontext() if factor == 1.0 else pytest.raises(ValueError, match=r"velocities say, by factors of \[1\.0, 1\.0, ")  # fmt: skip
    with context:
        read_motion(tmp_path, "reference", [40.0, -105.0, 1500.0])


def test_noise_of_the_velocity_is_no_other_unit(tmp_path: Path) -> None:
    """Noise reduces the slope of the height, here to half, but also the correlation."""
    table = tables(8.0)["reference"]
    noise = np.random.default_rng(1).normal(0.0, 0.2, len(table))
    table["pd"] = 3.0 + 0.2 * np.cos(0.5 * table["t"])
    table["vd"] = -0.1 * np.sin(0.5 * table["t"]) + np.repeat(noise[::20], 20)[: len(noise)]
    write(tmp_path, {"reference": table})
    motion = read_motion(tmp_path, "reference", [40.0, -105.0, 1500.0])
    np.testing.assert_allclose(motion.pos[:, 2].numpy(), 1500.0 - table["pd"], atol=1e-9)
    np.testing.assert_allclose(motion.vel[:, 2].numpy(), -table["vd"], atol=1e-9)


@pytest.mark.parametrize(
    ("shift", "is_noted"), [(0.5, False), (-0.5, False), (-5.0, True), (5.0, True)]
)
def test_a_table_that_does_not_cover_the_steps_is_named(shift: float, is_noted: bool) -> None:
    """The clock of one table is off: the rows agree with each other."""
    steps = np.arange(0.0, 8.0, 0.25)
    notes = describe_missing_times("pseudorange.csv", np.arange(0.0, 8.1, 0.5) + shift, steps)
    assert any("Check the clock of t" in note for note in notes) is is_noted


@pytest.mark.parametrize(("jump", "is_noted"), [(0.0, False), (0.5, False), (5.0, True)])
def test_a_clock_that_jumps_leaves_a_hole(jump: float, is_noted: bool) -> None:
    time = np.arange(0.0, 20.1, 0.5)
    time[15:] += jump
    notes = describe_missing_times("pseudorange.csv", time, np.arange(0.0, 20.0, 0.25))
    assert (
        any("1 hole of" in note and "t = 7.000 to 12.500 s" in note for note in notes) is is_noted
    )
    later = describe_missing_times("pseudorange.csv", time, np.arange(0.0, 6.0, 0.25))
    assert later == ()  # the hole is after the steps
