"""Epochs count by their time; what is missing, lost or doubtful stands above the decisions."""

from pathlib import Path

import judge_cases as cases
import numpy as np
import pandas as pd
import pytest
from command_line import pfbench

from pfbench.logs.judge.judge_options import JudgeOptions, SourceOptions
from pfbench.logs.judge.judgement import Judgement, judge_programs
from pfbench.logs.judge.page import describe_notes, tabulate_accuracy
from pfbench.logs.judge.pair_sentences import describe_judgement
from pfbench.logs.judge.reference_track import read_reference, space_evenly

POSITION = ["pn", "pe", "pd"]


def judge_tables(home: Path, truth: pd.DataFrame, **tables: pd.DataFrame) -> Judgement:
    reference = cases.write(truth, home / "truth.csv")
    files = {name: str(cases.write(t, home / f"{name}.csv")) for name, t in tables.items()}
    return judge_programs(str(reference), files)


def notes(judgement: Judgement) -> str:
    return "\n".join(describe_notes(judgement, JudgeOptions()))


def norms(truth: pd.DataFrame, table: pd.DataFrame) -> np.ndarray:
    return np.linalg.norm(table[POSITION].to_numpy() - truth[POSITION].to_numpy(), axis=1)


def test_equal_steps_keep_their_epochs() -> None:
    rng = np.random.default_rng(0)
    even = np.arange(0.0, 300.0, 0.5)
    jitter = even + rng.uniform(-0.005, 0.005, even.size)
    outage = even[(even < 100) | (even > 120)]
    for time in (even, jitter, outage, even[:2]):
        chosen, instants = space_evenly(time)
        np.testing.assert_array_equal(chosen, np.arange(len(time)))
        np.testing.assert_array_equal(instants, time)


def test_epochs_count_by_their_time() -> None:
    """100 s at 0.5 Hz, then 100 s at 10 Hz without 10 s: the shares are those of the time, within a step."""
    time = np.concatenate([np.arange(0.0, 100.0, 2.0), np.arange(100.0, 200.0, 0.1)])
    time = time[(time < 150.0) | (time > 160.0)]
    chosen, instants = space_evenly(time)
    assert (time[chosen] < 99.0).sum() / len(chosen) == pytest.approx(100 / 190, abs=0.01)
    assert np.abs(time[chosen] - instants).max() <= 1.0 + 1e-9
    assert not ((instants > 150.2) & (instants < 159.8)).any()


def test_a_program_gains_nothing_by_repeating_its_good_epochs(tmp_path: Path) -> None:
    """Each good epoch is written 20 times within 2 ms. Scored by epochs, the program is 20 % better."""
    truth = cases.drive(300.0)
    mine = cases.estimate(truth, 1.6, 1)
    error = norms(truth, mine)
    good = np.flatnonzero(error < 1.0)
    copies = [mine.iloc[good].assign(t=mine.t.iloc[good] + 1e-4 * k) for k in range(1, 20)]
    repeated = pd.concat([mine, *copies]).sort_values("t")
    judged = judge_tables(tmp_path, truth, mine=repeated, theirs=cases.estimate(truth, 1.6, 2))
    by_time = np.sqrt((error**2).mean())
    weight = np.where(error < 1.0, 20, 1)
    by_epoch = np.sqrt((weight * error**2).sum() / weight.sum())
    rmse = tabulate_accuracy(judged.sequences)["position RMSE [m]"][0]
    assert by_epoch < 0.85 * by_time
    assert rmse == pytest.approx(by_time, rel=0.01)
    assert judged.pairs[0].verdict.word == "not decided"
    assert "Steps: the steps of the epochs in recording differ" in notes(judged)
    (sequence,) = judged.sequences
    assert sequence.epochs.unused[0] == len(repeated) - len(mine)


def test_a_fast_stretch_has_the_weight_of_its_time(tmp_path: Path) -> None:
    """Equal programs, one good in each half; the second half is written at 20 times the rate."""
    truth = cases.drive(300.0, 0.1)
    kept = (truth.t >= 150) | (np.arange(len(truth)) % 20 == 0)
    slow = (truth.t < 150).to_numpy()[:, None]
    tables = {}
    for seed, (name, factors) in enumerate({"mine": (3.0, 1.0), "theirs": (1.0, 3.0)}.items()):
        table = cases.estimate(truth, 1.0, seed)
        table[POSITION] = truth[POSITION] + np.where(slow, *factors) * (table - truth)[POSITION]
        tables[name] = table[kept]
    judged = judge_tables(tmp_path, truth, **tables)
    rmse = tabulate_accuracy(judged.sequences)["position RMSE [m]"]
    assert rmse[0] / rmse[1] == pytest.approx(1.0, abs=0.25)
    assert judged.pairs[0].verdict.word == "not decided"


@pytest.mark.parametrize(
    ("step", "with_velocity", "outcome"),
    [(2, False, "exact"), (10, False, "noted"), (40, False, "refused"), (300, False, "refused"), (20, True, "exact")],
)  # fmt: skip
def test_steps_of_the_reference_that_hide_the_motion(
    tmp_path: Path, step: int, with_velocity: bool, outcome: str
) -> None:
    truth = cases.drive(300.0)
    columns = ["t", *POSITION, *(["vn", "ve", "vd"] if with_velocity else [])]
    tables = {n: cases.estimate(truth, s, k) for k, (n, s) in enumerate((("a", 3.0), ("b", 3.0)))}
    coarse = truth[columns][::step]
    if outcome == "refused":
        with pytest.raises(
            ValueError, match=r"truth.csv: column t must have steps .* shorter steps"
        ):
            judge_tables(tmp_path, coarse, **tables)
        return
    text = notes(judge_tables(tmp_path, coarse, **tables))
    assert ("Reference: interpolation" in text) == (outcome == "noted")


def test_the_error_of_interpolation_is_near_the_true_one(tmp_path: Path) -> None:
    truth = cases.drive(300.0)
    for columns, step in ((["t", *POSITION], 20), (["t", *POSITION, "vn", "ve", "vd"], 40)):
        file = cases.write(truth[columns][::step], tmp_path / "t.csv")
        reference = read_reference(file, JudgeOptions(), SourceOptions())
        time = truth.t.to_numpy()[: (len(truth) - 1) // step * step]
        true = truth[POSITION].to_numpy()[: len(time)] - reference.interpolate_position(time)
        size = np.sqrt((reference.interpolation_error(time) ** 2).mean())
        assert 0.5 < size / np.sqrt((true**2).sum(axis=1).mean()) < 2.0
        np.testing.assert_allclose(reference.interpolation_error(time[::step]), 0.0, atol=1e-9)


def write_runs(home: Path, lost: int = 0, missing: tuple[str, ...] = ()) -> list[str]:
    """Write 12 runs of two programs; the first runs of `mine` stop halfway."""
    truth = cases.drive(120.0)
    cases.write(truth, home / "truth.csv")
    for k in range(12):
        for seed, name in enumerate(("mine", "theirs")):
            table = cases.estimate(truth, 1.0, 2 * k + seed)
            table = table[:120] if name == "mine" and k < lost else table
            if f"{name}{k:02d}" not in missing:
                cases.write(table, home / f"{name}/r{k:02d}.csv")
    files = [f"{name}={home}/{name}/{{run}}.csv" for name in ("mine", "theirs")]
    return [f"reference={home}/truth.csv", *files, f"reports_dir={home}/reports"]


def test_missing_runs_and_lost_runs_stand_on_the_console_and_on_the_page(tmp_path: Path) -> None:
    said = pfbench("judge", *write_runs(tmp_path, 2, ("mine05", "theirs07")), home=tmp_path)
    assert said.code == 0, said.err
    page = (tmp_path / "reports/judge/report.md").read_text()
    for text in (
        "Missing: mine in recording lacks r05, which another program has.",
        "Missing: theirs in recording lacks r07, which another program has.",
        "Lost: mine r00 in recording covers",
    ):
        assert text in said.out
        assert text in page
    assert "; 10 runs" in said.out
    assert "% are required. Among runs or sequences it counts as an error of" in page
    assert "mathdefault" not in (tmp_path / "reports/judge/figures/judge_error_0.svg").read_text()


def test_runs_without_a_common_name_are_named(tmp_path: Path) -> None:
    write_runs(tmp_path)
    files = {"mine": f"{tmp_path}/mine/{{run}}.csv", "theirs": f"{tmp_path}/theirs/r00.csv"}
    judged = judge_programs(f"{tmp_path}/truth.csv", files)
    reason = judged.pairs[0].verdict.reason
    assert reason == "no run has the same name (mine: r00, r01, r02; theirs: without a name)"


def test_a_program_that_does_not_move_shows_no_clock(tmp_path: Path) -> None:
    truth = cases.drive(300.0)
    still = truth[["t", *POSITION]].assign(pn=100.0, pe=100.0, pd=0.0)
    judged = judge_tables(tmp_path, truth, mine=still, theirs=cases.estimate(truth, 1.0, 2))
    assert "Clock: mine" not in notes(judged)


def test_all_figures_of_programs_without_errors_are_drawn(tmp_path: Path) -> None:
    truth = cases.write(cases.drive(), tmp_path / "truth.csv")
    words = [f"reference={truth}", f"mine={truth}", f"reports_dir={tmp_path}/reports"]
    said = pfbench("judge", *words, home=tmp_path)
    assert (said.code, said.err) == (0, "")


def test_a_burst_decides_nothing_and_is_told_by_the_ratio_of_the_rmse(tmp_path: Path) -> None:
    """One burst of 5 s holds nearly all of the squared error of a program that is as good otherwise."""
    truth = cases.drive(300.0)
    mine = cases.estimate(truth, 1.0, 1)
    burst = ((truth.t > 100) & (truth.t < 105)).to_numpy()
    mine.loc[burst, POSITION] += 60.0
    judged = judge_tables(tmp_path, truth, mine=mine, theirs=cases.estimate(truth, 1.0, 2))
    (pair,) = judged.pairs
    assert pair.verdict.word == "not decided"
    rmse = tabulate_accuracy(judged.sequences)["position RMSE [m]"]
    assert pair.rmse_ratio == pytest.approx(rmse[0] / rmse[1])
    assert pair.rmse_ratio > 5
    (text,) = describe_judgement(judged)
    assert "Few blocks hold most of the squared error: the ratio of the RMSE is" in text


def test_a_lost_run_is_one_event_whatever_its_blocks(tmp_path: Path) -> None:
    """3 runs of each: one of them lost decides nothing, and 12 runs weigh it with the cap."""
    truth = cases.drive(120.0)
    reference = str(cases.write(truth, tmp_path / "truth.csv"))
    for k in range(12):
        mine, theirs = cases.estimate(truth, 0.3, 2 * k), cases.estimate(truth, 1.0, 2 * k + 1)
        for name, table in (("mine", mine[:100] if k == 1 else mine), ("theirs", theirs)):
            cases.write(table, tmp_path / f"{name}/r{k:02d}.csv")
            if k < 3:
                cases.write(table, tmp_path / f"few/{name}{k}.csv")
    few = {name: f"{tmp_path}/few/{name}{{run}}.csv" for name in ("mine", "theirs")}
    (pair,) = judge_programs(reference, few).pairs
    assert (pair.verdict.word, pair.verdict.n) == ("not decided", 0)
    assert pair.verdict.reason == "mine is lost in 1 of 3 runs, and 10 are required to weigh that"
    many = {name: f"{tmp_path}/{name}/{{run}}.csv" for name in ("mine", "theirs")}
    (pair,) = judge_programs(reference, many).pairs
    assert (pair.verdict.word, pair.unit, pair.verdict.n) == ("better", "run", 12)
