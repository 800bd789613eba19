"""Reports of judge: numbers of known errors, common epochs, several sequences, and the files."""

from __future__ import annotations

import json
from pathlib import Path

import judge_cases as cases
import numpy as np
import pytest
from command_line import pfbench

from pfbench.judge.judge_options import JudgeOptions
from pfbench.judge.judgement import judge_programs
from pfbench.judge.page import tabulate_accuracy


def test_rmse_and_nees_of_known_errors(tmp_path: Path) -> None:
    truth = cases.drive()
    reference = cases.write(truth, tmp_path / "truth.csv")
    shifted = truth.assign(pn=truth.pn + 3.0, pd=truth.pd - 4.0, yaw=truth.yaw + 2 * np.pi + 0.01)
    shifted[["sd_pn", "sd_pe", "sd_pd"]] = 2.0
    mine = cases.write(shifted, tmp_path / "mine.csv")
    judged = judge_programs(str(reference), {"mine": str(mine)})
    row = tabulate_accuracy(judged.sequences).iloc[0]
    assert row["position RMSE [m]"] == pytest.approx(5.0)
    assert row["horizontal RMSE [m]"] == pytest.approx(3.0)
    assert row["position maximum [m]"] == pytest.approx(5.0)
    assert row["position NEES (expected 3)"] == pytest.approx(25 / 4)
    assert row["yaw RMSE [deg]"] == pytest.approx(np.degrees(0.01))
    assert row["velocity RMSE [m/s]"] == pytest.approx(0.0, abs=1e-12)
    assert judged.decisions == ()


def test_correlated_covariance_enters_the_nees(tmp_path: Path) -> None:
    """The error (1, 1, 0) with correlation 0.5: e P^-1 e = 2 / 1.5; diagonal entries alone give 2."""
    truth = cases.drive()
    reference = cases.write(truth, tmp_path / "truth.csv")
    table = truth[["t", "pn", "pe", "pd"]].assign(pn=truth.pn + 1, pe=truth.pe + 1)
    table = table.assign(cov_nn=1.0, cov_ne=0.5, cov_nd=0.0, cov_ee=1.0, cov_ed=0.0, cov_dd=1.0)
    judged = judge_programs(
        str(reference), {"mine": str(cases.write(table, tmp_path / "mine.csv"))}
    )
    row = tabulate_accuracy(judged.sequences).iloc[0]
    assert row["position NEES (expected 3)"] == pytest.approx(2 / 1.5)


def test_only_common_epochs_are_scored_and_an_early_stop_is_lost(tmp_path: Path) -> None:
    truth = cases.drive()
    reference = cases.write(truth, tmp_path / "truth.csv")
    fast = cases.write(cases.estimate(truth, 1.0, 1), tmp_path / "fast.csv")
    slow = cases.write(cases.estimate(truth, 1.0, 2)[::4], tmp_path / "slow.csv")
    half = cases.write(cases.estimate(truth, 0.1, 3)[:120], tmp_path / "half.csv")
    files = {"fast": str(fast), "slow": str(slow), "half": str(half)}
    (sequence,) = judge_programs(str(reference), files).sequences
    assert np.allclose(sequence.epochs.time, truth.t[::4])
    assert sequence.results["half"].data["lost"].tolist() == [True]
    judged = judge_programs(str(reference), files)
    assert {
        d.decision.word for d in judged.along_runs if "half" in (d.decision.a, d.decision.b)
    } == {"not tested"}


def test_a_program_gains_nothing_by_leaving_out_its_bad_epochs(tmp_path: Path) -> None:
    """Equal programs; one leaves out its worst 8 % of epochs. On common epochs alone it would be better."""
    truth = cases.drive()
    reference = cases.write(truth, tmp_path / "truth.csv")
    full = cases.estimate(truth, 1.0, 1)
    places = ["pn", "pe", "pd"]
    norm = np.linalg.norm(full[places].to_numpy() - truth[places].to_numpy(), axis=1)
    is_kept = norm < np.quantile(norm, 0.92)
    is_kept[[0, -1]] = True
    other = cases.write(cases.estimate(truth, 1.0, 2), tmp_path / "other.csv")
    holes = cases.write(full[is_kept], tmp_path / "holes.csv")
    files = {"holes": str(holes), "other": str(other)}
    judged = judge_programs(str(reference), files)
    (sequence,) = judged.sequences
    assert np.array_equal(sequence.epochs.time, truth.t)  # no epoch of the other program is lost
    np.testing.assert_array_equal(sequence.epochs.holes[0], ~is_kept)
    assert not sequence.epochs.holes[1].any()
    errors = {name: r.data["error"][0][:, :3] for name, r in sequence.results.items()}
    norms = {name: np.linalg.norm(error, axis=1) for name, error in errors.items()}
    largest = max(norms["other"].max(), norm[is_kept].max())
    np.testing.assert_allclose(norms["holes"][~is_kept], largest)
    np.testing.assert_allclose(norms["holes"][is_kept], norm[is_kept], rtol=1e-6)
    assert np.mean(norms["holes"] ** 2) > np.mean(norm**2)
    assert judged.along_runs[0].decision.word != "better"


@pytest.mark.parametrize("options", [{}, {"start": 10.0, "end": 100.0}, {"every": 2.0}])
def test_times_that_are_rounded_make_no_holes(tmp_path: Path, options: dict[str, float]) -> None:
    """The first and the last epoch lie outside the scored time by the rounding of the clock."""
    truth = cases.drive()
    reference = cases.write(truth, tmp_path / "truth.csv")
    files = {}
    for name, shift in (("early", -1e-4), ("exact", 0.0), ("late", 1e-4)):
        table = cases.estimate(truth, 1.0, 1)
        table["t"] += shift
        files[name] = str(cases.write(table, tmp_path / f"{name}.csv"))
    (sequence,) = judge_programs(str(reference), files, JudgeOptions(**options)).sequences
    assert not np.any(sequence.epochs.holes)
    assert len(sequence.epochs.time) > 30


def test_removed_motion_is_stated(tmp_path: Path) -> None:
    truth = cases.drive()
    reference = cases.write(truth, tmp_path / "truth.csv")
    c, s = np.cos(0.3), np.sin(0.3)
    turned = truth[["t", "pn", "pe", "pd"]].assign(
        pn=c * truth.pn - s * truth.pe + 50, pe=s * truth.pn + c * truth.pe - 20
    )
    mine = cases.write(turned, tmp_path / "mine.csv")
    for align, largest in (("none", np.inf), ("yaw", 1e-9)):
        judged = judge_programs(str(reference), {"mine": str(mine)}, JudgeOptions(align=align))
        rmse = tabulate_accuracy(judged.sequences)["position RMSE [m]"][0]
        assert (rmse < largest) == (align == "yaw" or rmse > 10)
        assert rmse < 1e-9 or align == "none"
    words = [f"reference={reference}", f"mine={mine}", "align=yaw", f"reports_dir={tmp_path}"]
    assert pfbench("judge", *words, home=tmp_path).code == 0
    assert (
        "A shift and a turn about the vertical are removed"
        in (tmp_path / "judge/report.md").read_text()
    )


def write_study(home: Path, sequences: int, ratio: float) -> list[str]:
    for k in range(sequences):
        truth = cases.drive(60.0 + 5 * k)
        cases.write(truth, home / f"truth/s{k}.csv")
        cases.write(cases.estimate(truth, ratio, 2 * k), home / f"mine/s{k}.csv")
        cases.write(cases.estimate(truth, 1.0, 2 * k + 1), home / f"theirs/s{k}.csv")
    names = {"reference": "truth", "mine": "mine", "theirs": "theirs"}
    files = [f"{name}={home}/{folder}/{{sequence}}.csv" for name, folder in names.items()]
    return [*files, f"reports_dir={home / 'reports'}", "study=many"]


def test_several_sequences_decide_for_a_new_one(tmp_path: Path) -> None:
    words = write_study(tmp_path, 8, 0.6)
    said = pfbench("judge", *words, home=tmp_path)
    assert said.code == 0, said.err
    assert "In a new world of this kind, mine is better than theirs on average" in said.out
    folder = tmp_path / "reports/many"
    stored = json.loads((folder / "decisions.json").read_text())
    new = [
        d for d in stored["decisions"] if d["question"] == "b" and d["metric"] == "position RMSE"
    ]
    assert [(d["worlds"], d["word"]) for d in new] == [(8, "better")]
    assert len(stored["along_runs"]) == 8
    tested = [d for d in stored["along_runs"] if d["word"] != "not tested"]
    assert {d["family_size"] for d in tested} == {len(tested)}
    for name in ("index.html", "report.md"):
        assert "samples, one per sequence" in (folder / name).read_text()
    before = (folder / "index.html").read_bytes()
    assert pfbench("judge", *words, home=tmp_path).code == 0
    assert (folder / "index.html").read_bytes() == before


def test_equal_programs_are_not_decided_in_one_run(tmp_path: Path) -> None:
    truth = cases.drive(300.0)
    reference = cases.write(truth, tmp_path / "truth.csv")
    files = {
        n: str(cases.write(cases.estimate(truth, 1.0, k), tmp_path / f"{n}.csv"))
        for k, n in enumerate("ab")
    }
    (result,) = judge_programs(str(reference), files).along_runs
    assert result.decision.word == "inconclusive"
    assert result.decision.low < 0 < result.decision.high
    assert result.seconds_needed > result.seconds
    (same,) = judge_programs(str(reference), {"a": files["a"], "copy": files["a"]}).along_runs
    assert same.decision.word == "identical"
