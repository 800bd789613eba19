"""Reports of judge: numbers of known errors, common epochs, several sequences, and the files."""

import json
from pathlib import Path

import judge_cases as cases
import numpy as np
import pytest
from command_line import pfbench

from pfbench.logs.judge.judge_options import JudgeOptions
from pfbench.logs.judge.judgement import judge_programs
from pfbench.logs.judge.page import tabulate_accuracy


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
    assert judged.pairs == ()


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
    halves = [p.verdict for p in judged.pairs if "half" in (p.verdict.a, p.verdict.b)]
    assert {v.word for v in halves} == {"not decided"}
    assert all("half is lost in 1 of 1 run" in v.reason for v in halves)


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
    assert judged.pairs[0].verdict.word != "better"


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


@pytest.mark.parametrize(("sequences", "unit"), [(12, "world"), (4, "block")])
def test_the_unit_is_a_sequence_where_there_are_enough(
    tmp_path: Path, sequences: int, unit: str
) -> None:
    words = write_study(tmp_path, sequences, 0.6)
    said = pfbench("judge", *words, home=tmp_path)
    assert said.code == 0, said.err
    assert "mine is better than theirs: the position error of mine is" in said.out
    folder = tmp_path / "reports/many"
    (verdict,) = json.loads((folder / "decisions.json").read_text())["verdicts"]
    assert (verdict["word"], verdict["unit"]) == ("better", unit)
    if unit == "world":
        assert (verdict["n"], verdict["effective"], verdict["block_s"]) == (12, 12.0, "nan")
        text, reach = "; 12 sequences; adjusted p", "The sample is a sequence"
    else:
        assert verdict["n"] * verdict["block_s"] == pytest.approx(verdict["seconds"])
        assert 7 <= verdict["effective"] <= verdict["n"]
        text, reach = (
            f" s that count as {verdict['effective']:.2g} independent ones",
            "The sample is a block of time",
        )
    assert text in said.out
    for name in ("index.html", "report.md"):
        page = (folder / name).read_text()
        assert text in page
        assert reach in page
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
    (pair,) = judge_programs(str(reference), files).pairs
    assert (pair.verdict.word, pair.verdict.n) == ("not decided", 30)
    assert pair.verdict.low < 1 < pair.verdict.high
    assert pair.seconds_needed > pair.seconds
    (same,) = judge_programs(str(reference), {"a": files["a"], "copy": files["a"]}).pairs
    assert same.verdict.word == "identical"


def test_all_pairs_form_one_family(tmp_path: Path) -> None:
    truth = cases.drive(300.0)
    reference = str(cases.write(truth, tmp_path / "truth.csv"))
    files = {
        n: str(cases.write(cases.estimate(truth, sd, k), tmp_path / f"{n}.csv"))
        for k, (n, sd) in enumerate({"a": 1.0, "b": 1.05, "c": 2.0, "d": 2.1}.items())
    }
    pairs = judge_programs(reference, files).pairs
    alone = judge_programs(reference, {n: files[n] for n in "ac"}).pairs[0].verdict
    together = next(p.verdict for p in pairs if (p.verdict.a, p.verdict.b) == ("a", "c"))
    assert len(pairs) == 6
    assert together.ratio == alone.ratio
    assert together.low < alone.low < alone.high < together.high
    assert together.p > alone.p
    baseline = judge_programs(reference, files, JudgeOptions(baseline="c")).pairs
    assert [p.verdict.b for p in baseline] == ["c"] * 3
