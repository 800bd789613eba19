"""The board: ratios, verdicts and sentences of invented studies, held against scipy and against the laws of a table."""

import math
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import synthetic_results as synthetic
from checkout import ROOT
from scipy import stats

from pfbench.report import RUNS_FILE, provenance, read_stored_study
from pfbench.report.board.curves import select_telling_runs
from pfbench.report.board.entries import StudyFacts, describe_uncommitted, metric_entries
from pfbench.report.board.pack import (
    build_pack,
    join_notes,
    note_job,
    planned_entries,
    round_ratio,
    select_baselines,
)
from pfbench.report.board.view import (
    BoardRow,
    View,
    build_rows,
    build_views,
    describe_filters,
    describe_view,
    select_everywhere,
)
from pfbench.report.methods_text import write_methods
from pfbench.report.options import ReportOptions
from pfbench.report.study_page.page_writer import describe_pairs
from pfbench.results.conditions import load_conditions
from pfbench.results.looks import PartName, find_looks, plan_look_pairs
from pfbench.results.store import JobResult
from pfbench.stats.court import Court, fix_pairs
from pfbench.stats.study_runs import arrange_runs

EFFECTS = {"mcmc_rpf": -0.3, "sir": 0.0, "ukf": 0.5}
CAP = 1e4
MARGIN = math.log(1.05)


def table(
    effects: dict[str, float] | None = None, worlds: int = 2, runs: int = 30, seed: int = 1
) -> pd.DataFrame:
    """Errors of filters that share the difficulty of each run; those of a filter depend on its name alone."""
    rng = np.random.default_rng(seed)
    rows = []
    for w in range(worlds):
        for k, noise in enumerate(("nominal", "outliers")):
            hard = rng.normal(0, 0.5, runs)
            for label, effect in (EFFECTS if effects is None else effects).items():
                own = np.random.default_rng([seed, w, k, *label.encode()])
                error = np.exp(w + effect + hard + 0.1 * own.standard_t(3, runs))
                rows.append(pd.DataFrame({
                    "filter": label, "scenario": f"w{w}", "family": f"w{w}", "regime": noise, "model": "m",
                    "particles": 100.0, "seed": 1, "run": np.arange(runs), "lost": False, "keeps_track": True,
                    "unit": "m", "group": "position", "rmse": error, "coverage_50": 0.5,
                    "coverage_90": own.uniform(0.5, 0.9, runs), "nees_ratio": 1.5, "ms": 2.0,
                }))  # fmt: skip
    return pd.concat(rows, ignore_index=True)


def make_view(data: pd.DataFrame, has_limit: bool = True, alpha: float = 0.05, baseline: str = "sir") -> View:  # fmt: skip
    """View of all conditions."""
    labels = tuple(sorted(data["filter"].unique()))
    runs = arrange_runs(data, labels)
    described = describe_filters(runs, alpha)
    times: list[dict[str, Any]] = [{} for _ in range(len(runs.conditions))]
    court = Court(runs, fix_pairs(labels, [], baseline), MARGIN, alpha)
    return View(court, select_everywhere(runs), "rmse", "m", described, times, has_limit)


def board(data: pd.DataFrame, baseline: str = "sir") -> dict[str, BoardRow]:
    return {row["filter"]: row for row in build_rows(make_view(data, baseline=baseline), baseline)}


def lose(data: pd.DataFrame, label: str, runs: int, **where: str) -> pd.DataFrame:
    """The first runs of a filter lose track."""
    off = data["filter"].eq(label) & (data["run"] < runs)
    for column, value in where.items():
        off &= data[column].eq(value)
    return data.assign(keeps_track=data["keeps_track"] & ~off)


def differences(data: pd.DataFrame, a: str, b: str) -> np.ndarray:
    """Log ratios of each run, averaged over conditions of equal weight."""
    wide = data.assign(log=np.log(data["rmse"])).pivot_table("log", "run", "filter")
    return (wide[a] - wide[b]).to_numpy()


def test_the_interval_of_a_median_has_the_order_statistics_of_the_level() -> None:
    data = table(worlds=1)
    data = data[data["regime"] == "nominal"]
    for label, row in board(data).items():
        errors = np.sort(data.loc[data["filter"] == label, "rmse"])
        k = int(np.searchsorted(errors, row["low"] * (1 + 1e-9))) - 1
        assert (row["low"], row["high"]) == pytest.approx((errors[k], errors[-1 - k]))
        assert stats.binom.cdf(k, 30, 0.5) <= 0.025 < stats.binom.cdf(k + 1, 30, 0.5)


def test_another_filter_changes_no_row_but_the_size_of_the_family() -> None:
    few, many = (board(table({**EFFECTS, **more})) for more in ({}, {"gpf": -0.5, "qmc_gpf": 3.0}))
    for label in EFFECTS:
        first, second = few[label], many[label]
        changed = {key for key in first if first[key] != second[key] and first[key] == first[key]}
        assert changed <= {"rank", "ratio_low", "ratio_high", "p"}
        if label != "sir":
            assert (
                second["ratio_low"]
                <= first["ratio_low"]
                <= first["ratio_high"]
                <= second["ratio_high"]
            )
            assert (
                second["p"] == pytest.approx(2 * first["p"], rel=1e-9) or second["p"] >= first["p"]
            )
    assert many["ukf"]["rank"] == few["ukf"]["rank"] + 1  # gpf is better, qmc_gpf is worse


@pytest.mark.parametrize("lost", [0, 8])
def test_word_interval_and_p_of_a_row_agree(lost: int) -> None:
    """Over effects from none to clear, and with lost runs."""
    words: dict[str, int] = {}
    for seed in range(24):
        effect = 0.02 * (seed % 12 - 6)
        data = table({"sir": 0.0, "ukf": effect, "gpf": 0.2, "rpf": -effect / 2}, 1, 160, seed)
        for row in board(lose(data, "ukf", lost)).values():
            low, high, p = row["ratio_low"], row["ratio_high"], row["p"]
            words[row["verdict"]] = words.get(row["verdict"], 0) + 1
            if row["verdict"] in ("baseline", "loses track"):
                continue
            assert low <= row["ratio"] <= high
            assert (p < 0.05) == (high <= 1 or low >= 1)
            if row["verdict"] in ("better", "worse"):
                assert p < 0.05
                assert row["verdict"] == ("better" if row["ratio"] < 1 else "worse")
            elif row["verdict"] == "equal":
                assert 1 / 1.05 < low <= high < 1.05
            else:
                assert p >= 0.05 or "does not agree" in row["words"]
                assert low <= 1 / 1.05 or high >= 1.05
    assert set(words) >= {"better", "worse", "equal", "not decided"}


def test_verdicts_of_few_equal_and_missing_filters() -> None:
    rows = board(table())
    assert [rows[k]["verdict"] for k in ("mcmc_rpf", "sir", "ukf")] == [
        "better",
        "baseline",
        "worse",
    ]
    few = board(table(runs=4))["ukf"]
    assert (few["verdict"], few["words"]) == ("not decided", "not decided, 4 runs, 10 are required")
    assert (few["ratio_low"], few["ratio_high"]) == (0.0, math.inf)
    data = table({"sir": 0.0})
    noise = 1e-9 * np.random.default_rng(3).normal(size=len(data))
    for factor, word in ((1.0, "identical"), (1e6, "equal")):  # smaller ratios are rounding
        twin = data.assign(filter="ukf", rmse=data["rmse"] * (1 + factor * noise))
        assert board(pd.concat([data, twin]))["ukf"]["verdict"] == word
    part = table()
    part = part[(part["filter"] != "ukf") | (part["scenario"] == "w0")]
    row = board(part)["ukf"]
    assert (row["verdict"], row["rank"]) == ("missing", None)
    assert math.isnan(row["ratio"])
    skewed = table({"sir": 0.0}, worlds=1)
    jump = np.where(skewed["run"] % 3 == 0, 1.0, -0.004 - 1e-4 * skewed["run"])
    skewed = pd.concat([skewed, skewed.assign(filter="ukf", rmse=skewed["rmse"] * np.exp(jump))])
    assert board(skewed)["ukf"]["verdict"] not in ("better", "worse")


def test_a_filter_that_loses_track_keeps_its_place() -> None:
    """In a single condition the word is that of track; over several the conditions are counted beside the verdict."""
    data = lose(table(runs=60), "mcmc_rpf", 24)
    row = board(data)["mcmc_rpf"]
    assert row["verdict"] in ("worse", "not decided")
    assert row["words"].endswith("loses track in 4/4")
    assert row["track"] == pytest.approx(0.6)
    assert math.isnan(row["ratio"])  # 24 of 60 runs are lost
    assert "loses more runs (24 of 60, the baseline 0)" in row["words"]
    one = data[data["scenario"].eq("w0") & data["regime"].eq("nominal")]
    row = board(one)["mcmc_rpf"]
    assert (row["verdict"], row["words"]) == ("loses track", "loses track in 40 % of runs")
    assert row["loses"] == "loses more"
    base = board(one, "mcmc_rpf")["mcmc_rpf"]
    assert (base["verdict"], base["words"]) == ("baseline", "baseline, loses track in 40 % of runs")
    assert board(lose(table(), "mcmc_rpf", 3))["mcmc_rpf"]["verdict"] == "better"


def views_of(data: pd.DataFrame, limit: float | None = None, **options: Any) -> dict[Any, Any]:
    """Views of a page with the baselines SIR and UKF."""
    labels = sorted(data["filter"].unique())
    worlds = {w: PartName(w, w, "", "m", limit, w) for w in data["scenario"].unique()}
    baselines = [k for k in ("sir", "ukf") if k in labels]
    facts = StudyFacts(find_looks(labels), worlds, {}, ReportOptions(**options), {})
    runs = arrange_runs(data, labels)
    court = Court(runs, fix_pairs(labels, [], baselines[0]), MARGIN, 0.05)
    groups = data.groupby(["scenario", "regime"])[["unit", "group"]].first()
    return build_views(court, groups, facts, baselines)


def test_filters_are_compared_where_all_of_them_were_run() -> None:
    data = table()
    part = data[data["filter"].eq("sir") | data["scenario"].eq("w0")]
    opening = next(iter(views_of(part).values()))
    common = board(data[data["scenario"] == "w0"])
    assert [row["filter"] for row in opening["rows"]] == list(common)
    for row in opening["rows"]:
        assert row["ratio"] == pytest.approx(common[row["filter"]]["ratio"], rel=1e-3)
        assert row["verdict"] == common[row["filter"]]["verdict"]
    assert opening["small_print"].startswith(
        "2 of 4 conditions are compared: not all 3 filters were run in the others. "
    )
    whole = next(iter(views_of(data).values()))
    assert "compared:" not in whole["small_print"]


def test_without_a_divergence_threshold_no_share_of_tracks_is_shown() -> None:
    """A run that is not lost may be anywhere: only lost runs are known."""
    data = lose(table(), "mcmc_rpf", 20)
    for limit, words in ((CAP, "loses track in "), (None, "loses ")):
        views = views_of(data, limit)
        for key, view in views.items():
            rows = {row["filter"]: row for row in view["rows"]}
            assert (rows["sir"]["track"] is None) == (limit is None)
            is_all = (key.world, key.regime) == ("all", "all")
            assert words in rows["mcmc_rpf"]["words"]
            assert rows["mcmc_rpf"]["words"].endswith("4/4") == is_all


def test_runs_are_counted_by_condition() -> None:
    data = table({"sir": 0.0, "ukf": 0.3})
    is_first = data["scenario"].eq("w0") & data["regime"].eq("nominal")
    views = views_of(data[is_first | (data["run"] < 12)])
    small = {key[1:3]: view["small_print"] for key, view in views.items()}
    assert "30 paired runs per condition" in small["w0", "nominal"]
    assert "12 to 30 paired runs per condition" in small["all", "all"]
    data.loc[data["run"] < 10, "rmse"] = np.nan  # as in `compare` and `errors()`
    (small_print, *_) = (view["small_print"] for view in views_of(data).values())
    assert "20 paired runs per condition (40 of 120 runs have no truth)" in small_print


def test_the_log_score_orders_a_board() -> None:
    """A difference of 0.3 per step is a ratio of predictive densities."""
    data = table({"ekf": 0.0, "sir": 0.0}, worlds=1).drop(columns="rmse")
    score = np.random.default_rng(1).normal(-5.0, 1.0, len(data))
    order = data.groupby("filter").cumcount().to_numpy()
    data["log_score"] = score[order] + np.where(data["filter"] == "ekf", 0.3, 0.0)
    data["rmse"] = np.nan
    opening = next(iter(views_of(data, metric="log_score").values()))
    first, second = opening["rows"]
    assert (first["filter"], first["unit"], second["filter"]) == ("ekf", None, "sir")
    assert first["ratio"] == pytest.approx(math.exp(-0.3), rel=1e-3)
    (entry,) = metric_entries(data, "log_score")[:1]
    assert (entry["key"], entry["unit"]) == ("log_score", "")


# sentences


@pytest.mark.parametrize("runs", [1, 4, 30])
@pytest.mark.parametrize("labels", [["sir"], ["sir", "mcmc_rpf"], list(EFFECTS)])
@pytest.mark.parametrize("is_lost", [False, True])
def test_sentences_of_small_studies(runs: int, labels: list[str], is_lost: bool) -> None:
    data = table({k: EFFECTS[k] for k in labels}, worlds=1, runs=runs)
    if is_lost:
        data = data.assign(keeps_track=False, lost=True, rmse=np.nan)
    rows = list(board(data).values())
    text = describe_view(rows, find_looks(labels), "sir", "in Flight", "position error")
    assert text.endswith(".")
    assert not {"nan", "None", "inf"} & set(text.replace("[", " ").replace("]", " ").split())
    assert "  " not in text
    assert ("no other filter is compared" in text) == (len(labels) == 1)
    if not is_lost and len(labels) > 1 and runs == 30:
        first = "Of 1 filter, 1 is" if len(labels) == 2 else "Of 2 filters, 1 is"
        assert text.startswith(
            f"{first} better than [[SIR]] in Flight (first in the table: [[MCMC-RPF]], 0.7"
        )


def test_a_sentence_names_the_first_filter_of_its_table_even_if_it_is_not_better() -> None:
    rows = list(board(table({"sir": 0.0, "mcmc_rpf": -0.5, "ckf": -0.6}, worlds=1, runs=30)).values())  # fmt: skip
    rows.sort(key=lambda row: row["filter"] != "ckf")
    text = describe_view([{**rows[0], "verdict": "not decided"}, *rows[1:]], find_looks(["sir", "mcmc_rpf", "ckf"]), "sir", "", "error")  # fmt: skip
    assert "(the first of them: [[MCMC-RPF]]" in text
    assert "First in the table: [[CKF]], not decided." in text


def test_the_counts_of_a_sentence_are_those_of_its_rows() -> None:
    effects = {
        "sir": 0.0,
        "ukf": 0.5,
        "ekf": 0.4,
        "ckf": -0.4,
        "gpf": 0.004,
        "rpf": 0.06,
        "mcmc_rpf": 0.3,
    }
    data = lose(table(effects, worlds=1, runs=60), "ekf", 40)
    rows = build_rows(make_view(data[data["regime"] == "nominal"]), "sir")
    counts = {word: sum(row["verdict"] == word for row in rows) for word in ("better", "equal", "worse", "not decided", "loses track")}  # fmt: skip
    text = describe_view(rows, find_looks(list(effects)), "sir", "in Flight", "error")
    assert counts["better"] == counts["loses track"] == 1
    assert text.startswith(
        "Of 6 filters, 1 is better than [[SIR]] in Flight (first in the table: [[CKF]], 0.6"
    )
    for word, said in (("equal", "equal to it"), ("worse", "worse"), ("not decided", "not decided"), ("loses track", "without track")):  # fmt: skip
        number = counts[word]
        expected = f"{number} {'is' if number == 1 else 'are'} {said}"
        assert (expected in text) == (number > 0)
    assert "First proposed method: [[MCMC-RPF]], 1.3" in text


def check_sentences(views: dict[Any, Any]) -> int:
    """Check all sentences of a page; return the number of words of the longest."""
    longest = 0
    for view in views.values():
        text = view["sentence"]
        longest = max(longest, len(text.split()))
        assert text.endswith(".")
        assert "nan" not in text
        assert text.count("[[") == text.count("]]") >= 1
    return longest


def test_sentences_of_invented_studies_have_at_most_55_words() -> None:
    labels = [
        "sir",
        "ukf",
        "cofm_amssrcpf",
        "cpso_escape",
        "ekf_scaled_tuned",
        "student_tuned",
        "gate_tuned",
        "gpf",
    ]
    longest = 0
    for seed in range(3):
        rng = np.random.default_rng(seed)
        data = table(dict(zip(labels, rng.normal(0, 0.3, len(labels)), strict=True)), 3, 20, seed)
        longest = max(longest, check_sentences(views_of(lose(data, labels[seed], 15), CAP)))
    assert 30 < longest <= 55


@pytest.mark.slow
@pytest.mark.parametrize("study", ["robust_car", "paper_001", "all_seven"])
def test_sentences_of_published_studies_have_at_most_55_words(study: str) -> None:
    pack = read_stored_study(ROOT / "reports" / study).pack
    assert (ROOT / "reports" / study / RUNS_FILE).is_file()
    assert check_sentences(pack["views"]) <= 55


# pairs that are compared in advance


def test_the_interval_of_a_new_world_needs_ten_worlds() -> None:
    data = table({"mcmc_rpf": -0.3, "sir": 0.0}, worlds=11, runs=10)
    looks = find_looks(["mcmc_rpf", "sir"])
    worlds = {f"w{k}": PartName(f"w{k}", f"w{k}", "", "m", None, f"w{k}") for k in range(11)}
    court = Court(arrange_runs(data, looks), plan_look_pairs(looks))
    (entry,) = planned_entries(court, StudyFacts(looks, worlds, {}, ReportOptions(), {}))
    new = entry["new_world"]
    assert (new["worlds"], new["word"]) == (11, "better")
    assert new["low"] < entry["estimate"] < new["high"]


def test_too_few_runs_say_why_a_planned_pair_has_no_interval() -> None:
    data = table(runs=4, worlds=1)
    looks = find_looks(sorted(data["filter"].unique()))
    court = Court(arrange_runs(data, looks), plan_look_pairs(looks))
    (entry, *_) = planned_entries(court, StudyFacts(looks, {}, {}, ReportOptions(), {}))
    assert (entry["low"], entry["high"], entry["word"]) == (None, None, "not decided")
    assert entry["words"] == "not decided, 4 runs, 10 are required"
    pack = {"planned": [entry], "filters": [{"key": k, "name": k} for k in looks]}
    assert describe_pairs(pack)[0]["interval"] == "4 runs, 10 are required"


@pytest.mark.parametrize("percent", [-0.0783, 0.0859, 9.87, -12.34, 250.6, 1e-6])
def test_a_ratio_near_one_keeps_the_digits_of_its_distance_from_one(percent: float) -> None:
    """Digits of the ratio itself would show 0.0783 % as 0.08; those of a page are not rounded twice."""
    ratio = round_ratio(math.log1p(percent / 100))
    assert ratio is not None
    assert 100 * (ratio - 1) == pytest.approx(percent, rel=2e-3)
    assert len(repr(ratio)) <= 14
    assert round_ratio(math.nan) is None


def test_ratios_of_both_directions_are_inverse() -> None:
    data = table()
    for a, b in combinations(EFFECTS, 2):
        forward, back = board(data, b)[a], board(data, a)[b]
        assert forward["ratio"] * back["ratio"] == pytest.approx(1.0)
        assert {forward["verdict"], back["verdict"]} == {"better", "worse"}


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    synthetic.study(folder / "demo", runs=12, steps=50)
    return folder


def test_telling_runs_come_in_turn() -> None:
    level = np.array([3.0, 1.0, 2.0, 8.0, 2.5, 2.2, 2.4])
    errors = np.exp([level, level])
    errors[1, 5] *= 4  # the largest disagreement
    errors[0, 0] = np.nan  # the filter is lost
    runs = select_telling_runs(errors, 4)
    assert runs[1:] == [0, 1, 5]
    assert runs[0] in (2, 4, 6)
    assert sorted(select_telling_runs(errors, 50)) == list(range(7))
    assert select_telling_runs(np.full((2, 3), np.nan), 2) == [0, 1]


def test_tracks_are_those_of_the_results(results: Path) -> None:
    (first, *_) = conditions = load_conditions("demo", results)
    pack = build_pack("demo", conditions, ReportOptions())
    entry = pack["tracks"][first.scenario, first.noise]
    assert len(entry["t"]) == 40
    assert entry["note"] == "40 of 50 instants."
    assert sorted(entry["numbers"]) == list(range(12))
    for job in first.jobs:
        data, names = job.load().data, job.meta["state"]["names"]
        steps = [int(np.argmin(np.abs(data["time"] - t))) for t in entry["t"]]
        places = [names.index(f"position_{axis}") for axis in "ENU"]
        for run in (0, 5, 11):
            if data["lost"][run]:
                assert np.isnan(entry["error"][job.label][str(run)]).all()
                continue
            error = data["error"][run][steps][:, places].astype(float)
            norm = np.linalg.norm(error, axis=-1)
            np.testing.assert_allclose(entry["error"][job.label][str(run)], norm, rtol=1e-6)
            if "plane" in entry:
                np.testing.assert_allclose(entry["plane"][job.label][str(run)], error[:, :2])


def test_a_study_of_a_setting_has_a_sweep(tmp_path: Path) -> None:
    for particles in (50, 100, 200):
        method = synthetic.Method("sir", 1 + 50 / particles, 0.9, particles)
        synthetic.write(tmp_path / "dose", method, runs=12, steps=9)
    synthetic.write(tmp_path / "dose", synthetic.METHODS[0], runs=12, steps=9)
    pack = build_pack("dose", load_conditions("dose", tmp_path), ReportOptions())
    (sweep,) = pack["sweeps"]
    lines = {line["name"]: line["points"] for line in sweep["lines"]}
    assert [point["x"] for point in lines["SIR"]] == [50, 100, 200]
    assert [point["x"] for point in lines["EKF"]] == [50, 200]
    rows = next(view for key, view in pack["views"].items() if key[:3] == ("rmse", sweep["world"], sweep["regime"]))["rows"]  # fmt: skip
    values = {row["filter"]: row["value"] for row in rows}
    assert [point["value"] for point in lines["SIR"]] == [values[f"sir[particles={n}]"] for n in (50, 100, 200)]  # fmt: skip


def test_notes_state_exactness_failures_and_choices(results: Path) -> None:
    conditions = load_conditions("demo", results)
    pack = build_pack("demo", conditions, ReportOptions())
    notes = {note["filter"]: note for note in pack["filter_notes"]}
    for label, note in notes.items():
        jobs = [job for c in conditions for job in c.jobs if job.label == label]
        assert note["runs"] == sum(job.meta["runs"] for job in jobs)
        assert note["lost"] == sum(int(job.load().data["lost"].sum()) for job in jobs)
        assert note["particles"] in ("200", "")
        assert note["is_exact"] == all(bool(job.meta.get("is_exact")) for job in jobs)
        assert note["has_bounded_weights"] is None  # results that do not state it
    (choice,) = pack["choices"]
    assert choice["text"].startswith("initial heading error")
    assert choice["filters"] == "all filters"


def test_weights_are_bounded_if_every_job_states_it(results: Path) -> None:
    job = load_conditions("demo", results)[0].jobs[0].load()
    for stated, common in (((True, True), True), ((True, False), False), ((False, None), None)):
        metas = [{**job.meta, "has_bounded_weights": value} for value in stated]
        (note,) = join_notes([note_job("sir", JobResult(meta, job.data)) for meta in metas])
        assert note["has_bounded_weights"] is common


@pytest.mark.parametrize("alpha", [0.05, 0.2])
def test_the_level_of_a_report_is_that_of_its_option(results: Path, alpha: float) -> None:
    pack = build_pack("demo", load_conditions("demo", results), ReportOptions(alpha=alpha))
    level = f"{100 * (1 - alpha):g} %"
    for view in pack["views"].values():
        assert f"with simultaneous {level} intervals" in view["small_print"]
    assert level in write_methods(pack)[0]


def test_one_baseline_measures_all_filters(results: Path) -> None:
    conditions = load_conditions("demo", results)
    labels = ["sir", "ekf", "ckf", "ekf_scaled_tuned"]
    assert select_baselines(find_looks(labels))[:2] == ["ekf_scaled_tuned", "ekf"]
    assert select_baselines(find_looks(["sir", "ckf", "ekf"]))[0] == "ekf"
    assert select_baselines(find_looks(["sir", "ckf"]))[0] == "sir"
    for baseline in ("", "ukf"):
        pack = build_pack("demo", conditions, ReportOptions(baseline=baseline))
        view = next(iter(pack["views"]))
        assert view.baseline == (baseline or "ekf")
    with pytest.raises(
        ValueError, match=r"report\.baseline must be a filter of the study, got apf"
    ):
        build_pack("demo", conditions, ReportOptions(baseline="apf"))
    missing = {entry["key"]: entry["reason_missing"] for entry in pack["budgets"]}
    assert missing["particles"] is None
    assert missing["time"] == "The study has no jobs with budget=time."


def test_the_baseline_of_a_page_does_not_depend_on_its_results(tmp_path: Path) -> None:
    """It is that of the labels, also if it is the worst filter or lost all runs."""
    others = synthetic.METHODS[1:]
    first = synthetic.METHODS[0]
    doomed = (
        first._replace(size=0.01),
        first._replace(size=500.0),
        first._replace(lost=tuple(range(12))),
    )
    for k, ekf in enumerate(doomed):
        synthetic.study(tmp_path / f"study_{k}", runs=12, steps=10, methods=(ekf, *others))
        conditions = load_conditions(f"study_{k}", tmp_path)
        pack = build_pack(f"study_{k}", conditions, ReportOptions())
        assert pack["baselines"] == ["ekf", "sir", "ukf"]
        assert {key.baseline for key in pack["views"]} == {"ekf", "sir", "ukf"}
        assert next(iter(pack["views"])).baseline == "ekf"


def test_a_page_says_that_jobs_are_of_uncommitted_code() -> None:
    metadata = [{"versions": {"commit": commit}} for commit in ("0123abc", "0123abc-dirty", "")]
    metadata[2]["versions"]["build"] = "sources 89ef"
    builds = provenance.list_builds(metadata)
    assert builds == ["0123abc", "0123abc with uncommitted changes", "sources 89ef"]
    assert provenance.name_build(builds[0]) == "commit 0123abc"
    assert provenance.name_build(builds[2]) == "sources 89ef"
    assert describe_uncommitted(metadata) == "1 of 3 jobs are of uncommitted code."
    assert describe_uncommitted(metadata[:1]) == ""
