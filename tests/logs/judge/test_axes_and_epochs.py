"""Wrong axes are refused, true ones are not; holes have the weight of their time; results find their place."""

import re
from pathlib import Path

import judge_cases as cases
import numpy as np
import pandas as pd
import pytest
from refusals import check_refused
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from pfbench.logs.judge.alignment import is_in_hole
from pfbench.logs.judge.checks import check_axes
from pfbench.logs.judge.formats import read_trajectories
from pfbench.logs.judge.judge_options import JudgeOptions, SourceOptions
from pfbench.logs.judge.judgement import judge_programs
from pfbench.logs.judge.reference_track import read_reference
from pfbench.results.store import write_result
from pfbench.stats.comparison import decide
from pfbench.stats.time_blocks import block_losses, compare_blocks

WRONG = {
    "swapped positions": ({"pn": "pe", "pe": "pn"}, [], "column pn .* times those of pe"),
    "height for depth": ({}, ["pe"], "column pe .* times those of pe .* by -1"),
    "swapped velocities": ({"vn": "ve", "ve": "vn"}, [], "column vn .* times those of ve"),
    "upward velocity": ({}, ["vd"], "column vd .* by -1"),
    "velocities for positions": ({"pn": "vn"}, [], "column pn .* times those of vn"),
    "yaw from East": ({}, ["yaw"], "column yaw .* by -1"),
}


def drive_with_errors(seed: int, sd: float) -> tuple[pd.DataFrame, pd.DataFrame]:
    """A drive, and an estimate of all of its columns."""
    truth = cases.drive(300.0)
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(len(truth), 9)) * [sd, sd, sd, 0.1, 0.1, 0.1, 0.002, 0.002, 0.01]
    return truth, truth.assign(**(truth.iloc[:, 1:10] + noise))


@pytest.mark.parametrize("case", WRONG)
def test_wrong_axes_are_refused(tmp_path: Path, case: str) -> None:
    names, signs, message = WRONG[case]
    truth, table = drive_with_errors(0, 1.0)
    source = table.copy()
    for name, other in names.items():
        table[name] = source[other]
    for name in signs:
        table[name] = -table[name]
    reference = read_reference(
        cases.write(truth, tmp_path / "t.csv"), JudgeOptions(), SourceOptions()
    )
    (read,) = read_trajectories(cases.write(table, tmp_path / "m.csv"), SourceOptions())
    check_refused([(message, lambda: check_axes(read, reference))], remedy=False)


@pytest.mark.parametrize("sd", [0.1, 1.0, 30.0, 100.0])
def test_true_axes_are_accepted(tmp_path: Path, sd: float) -> None:
    """Also with errors far above the motion, 20 drives each."""
    for seed in range(20):
        truth, table = drive_with_errors(seed, sd)
        file = cases.write(truth, tmp_path / "t.csv")
        reference = read_reference(file, JudgeOptions(), SourceOptions())
        (read,) = read_trajectories(cases.write(table, tmp_path / "m.csv"), SourceOptions())
        check_axes(read, reference)


FRAMES = {
    "camera": "turned by a constant 120.0 deg .* forward, right, down of the reference are its [z, x, y]",
    "tilted": "turned by a constant 12.0 deg",
    "turned": "positions are turned by 8.0. deg .* set align=yaw",
    "scaled": "positions move 0.4.* times as far",
    "shifted": r"positions are shifted by +20.0 m Down .* check heights",
}


@pytest.mark.parametrize("case", FRAMES)
def test_another_frame_of_a_program_is_named_as_by_an_inspection(tmp_path: Path, case: str) -> None:
    """Body axes as of a camera, a tilt, a turned frame, a scale and a shift; the file without them has no note."""
    truth = cases.drive(300.0).assign(roll=lambda rows: 0.02 * np.cos(0.2 * rows.t))
    table, position = cases.full(truth), ["pn", "pe", "pd"]
    angles = ["yaw", "pitch", "roll"]
    body = {"camera": np.roll(np.eye(3), 1, axis=0), "tilted": Rotation.from_euler("y", 12.0, degrees=True).as_matrix()}.get(case, np.eye(3))  # fmt: skip
    table[angles] = (
        Rotation.from_euler("ZYX", truth[angles]) * Rotation.from_matrix(body)
    ).as_euler("ZYX")
    turn = Rotation.from_euler("z", 8.0 * (case == "turned"), degrees=True)
    table[position] = turn.apply(table[position]) * (0.4 if case == "scaled" else 1.0) + [0.0, 0.0, 20.0 * (case == "shifted")]  # fmt: skip
    files = {"mine": str(cases.write(table, tmp_path / "mine.csv")), "plain": str(cases.write(cases.full(truth), tmp_path / "plain.csv"))}  # fmt: skip
    judged = judge_programs(str(cases.write(truth, tmp_path / "truth.csv")), files)
    mine, plain = (run.table.notes for run in judged.sequences[0].runs)
    assert re.search(FRAMES[case].replace("[z", r"\[z").replace("+", r"\+"), " ".join(mine))
    assert plain == ()


def test_a_quaternion_with_the_real_part_first_is_refused_and_its_remedy_reads_it(
    tmp_path: Path,
) -> None:
    truth = cases.drive(120.0)
    q = Rotation.from_euler("ZYX", truth[["yaw", "pitch", "roll"]]).as_quat()[:, [3, 0, 1, 2]]
    rows = np.column_stack([truth[["t", "pn", "pe", "pd"]] + [0.0, 0.1, 0.0, 0.0], q])
    reference = str(cases.write(truth, tmp_path / "truth.csv"))
    source, file = {"mine": SourceOptions(frame="ned")}, tmp_path / "mine.tum"
    np.savetxt(file, rows)
    with pytest.raises(ValueError, match=r"with qw first\. Set the line of names") as error:
        judge_programs(reference, {"mine": str(file)}, sources=source)
    names = re.search(r"# (t x y z qw qx qy qz)", str(error.value))[1]  # type: ignore[index]
    np.savetxt(file, rows, header=names)
    judge_programs(reference, {"mine": str(file)}, sources=source)


def test_the_end_of_a_program_within_its_step_is_no_hole() -> None:
    time = np.arange(10.0)
    grid = np.array([-1.0, -0.7, 0.0, 4.4, 9.0, 9.7, 10.0])
    assert is_in_hole(time, grid).tolist() == [True, False, False, False, False, False, True]
    assert is_in_hole(np.delete(time, 4), grid)[3]


def test_holes_among_epochs_that_are_not_common_are_refused(tmp_path: Path) -> None:
    """The clocks beat: few epochs agree to 10 ms, and all epochs of the hole would count."""
    truth = cases.drive(120.0, 0.1)
    reference = cases.write(truth, tmp_path / "truth.csv")
    mine = cases.estimate(truth, 1.0, 1).assign(t=truth.t * 0.999 + 0.02)
    mine = mine[(mine.t < 50) | (mine.t > 60)]
    theirs = cases.write(cases.estimate(truth, 1.0, 2), tmp_path / "theirs.csv")
    files = {"mine": str(cases.write(mine, tmp_path / "mine.csv")), "theirs": str(theirs)}
    check_refused(
        [
            (
                r"90 % of the epochs outside of holes .* Set tolerance=0\.0",
                lambda: judge_programs(str(reference), files),
            )
        ],
        remedy=False,
    )
    (sequence,) = judge_programs(str(reference), files, JudgeOptions(tolerance=0.06)).sequences
    share = sequence.epochs.holes[0].mean()
    assert share == pytest.approx(10 / 120, abs=0.01)


def spiked(rng: np.random.Generator, steps: int, correlation: float = 100.0) -> np.ndarray:
    """Squared errors with a slow correlation, and 100 times the usual size at each eleventh epoch."""
    a = np.exp(-1 / correlation)
    white = rng.normal(size=(3, steps + 1000))
    slow = lfilter([np.sqrt(1 - a * a)], [1, -a], white, axis=1)[:, -steps:]
    return np.where(np.arange(steps) % 11 == 0, 100.0, 1.0) * (slow**2).sum(axis=0)


def test_a_cycle_of_measurements_hides_no_slow_correlation() -> None:
    """Equal programs: at most 5 % of 200 studies are decided, plus 3.1 standard errors."""
    rng = np.random.default_rng(4)
    found = []
    for _ in range(200):
        a, b = (block_losses(np.sqrt(spiked(rng, 6000))[None, :, None], 30, 1e9) for _ in "ab")
        found.append(compare_blocks(("a", a), ("b", b)))
    words = [decide([blocks.effect])[0].word for blocks in found]
    assert np.median([blocks.effective for blocks in found]) > 7
    assert words.count("better") + words.count("worse") <= 200 * (
        0.05 + 3.1 * np.sqrt(0.05 * 0.95 / 200)
    )


@pytest.mark.parametrize(("scale", "is_placed"), [(1.0, True), (1.2, False)])
def test_a_result_is_placed_at_its_truth(tmp_path: Path, scale: float, is_placed: bool) -> None:
    """The track of a recorded drive starts at 0. The truth of another drive is not moved."""
    truth = cases.drive(60.0)
    track = scale * np.stack([truth.pe, truth.pn, -truth.pd], -1)
    error = np.random.default_rng(0).normal(size=(1, len(truth), 3))
    names = ["position_E", "position_N", "position_U"]
    meta = {
        "key": "k", "study": "s", "choices": {}, "config": {}, "label": "l", "seed": 1, "runs": 1,
        "state": {"names": names, "units": ["m"] * 3, "groups": {"position": [0, 1, 2]}},
    }  # fmt: skip
    data = {
        "time": truth.t.to_numpy(), "error": error, "sd": np.ones_like(error),
        "nees": np.ones((1, len(truth), 1)), "log_evidence": np.zeros(1),
        "lost": np.zeros(1, dtype=bool), "track": track[None] - track[0],
    }  # fmt: skip
    file = write_result(tmp_path / "k.npz", meta, data)
    moved = truth.assign(pn=truth.pn + 12.0, pe=truth.pe - 5.0, pd=truth.pd + 1.0)
    reference = cases.write(moved, tmp_path / "truth.csv")
    (sequence,) = judge_programs(str(reference), {"mine": str(file)}).sequences
    errors = sequence.results["mine"].data["error"][0, :, :3]
    assert np.allclose(errors, error[0][:, [1, 0, 2]] * [1, 1, -1], atol=1e-4) == is_placed
    assert any("moved by" in note for note in sequence.runs[0].table.notes) == is_placed
