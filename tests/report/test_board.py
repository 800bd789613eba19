"""The board: verdicts, ratios and sentences of invented studies, recomputed without its code."""

from __future__ import annotations

import io
import math
import re
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from pfbench.files.recorded_folder import RecordedFolder
from pfbench.report.board.entries import StudyNames, metric_entries
from pfbench.report.board.levels import (
    StudyArrays,
    arrange_runs,
    average_levels,
    compare_track_shares,
    compute_condition_levels,
)
from pfbench.report.board.study_views import (
    build_views,
    decide_planned,
    planned_entries,
    round_ratio,
)
from pfbench.report.board.view import (
    BoardRow,
    Scope,
    ViewOptions,
    build_rows,
    describe_filters,
    describe_view,
)
from pfbench.report.options import ReportOptions
from pfbench.report.study_page.page_writer import describe_pairs, name_effects
from pfbench.report.study_report import write_verdict_files
from pfbench.results.looks import PartName, find_looks

ONE_CONDITION = pd.DataFrame({"family": ["w"], "scenario": ["w"], "regime": ["nominal"]})
EFFECTS = {"mcmc_rpf": -0.3, "sir": 0.0, "ukf": 0.5}


def table(
    effects: dict[str, float] | None = None, worlds: int = 2, runs: int = 30, seed: int = 1
) -> pd.DataFrame:
    """Errors of filters that share the difficulty of each run."""
    rng = np.random.default_rng(seed)
    rows = []
    for w in range(worlds):
        for noise in ("nominal", "outliers"):
            hard = rng.normal(0, 0.5, runs)
            for label, effect in (EFFECTS if effects is None else effects).items():
                error = np.exp(w + effect + hard + 0.1 * rng.standard_t(3, runs))
                rows.append(pd.DataFrame({
                    "filter": label, "scenario": f"w{w}", "family": f"w{w}", "regime": noise, "model": "m",
                    "particles": 100.0, "seed": 1, "run": np.arange(runs), "lost": False, "keeps_track": True,
                    "unit": "m", "group": "position", "rmse": error, "coverage_50": 0.5,
                    "coverage_90": rng.uniform(0.5, 0.9, runs), "nees_ratio": 1.5, "ms": 2.0,
                }))  # fmt: skip
    return pd.concat(rows, ignore_index=True)


def board(data: pd.DataFrame, baseline: str = "sir", **options: object) -> dict[str, BoardRow]:
    labels = tuple(sorted(data["filter"].unique()))
    runs = arrange_runs(data, labels)
    levels = average_levels(compute_condition_levels(runs, "rmse"), runs.conditions)
    scope = Scope(labels, levels, describe_filters(runs), "m", len(runs.conditions) == 1)
    rows = build_rows(scope, baseline, ViewOptions(**options))  # type: ignore[arg-type]
    return {row.filter: row for row in rows}


def trimmed_level(data: pd.DataFrame, label: str) -> float:
    """Mean over conditions of scipy's trimmed mean of the log error."""
    cells = data[data["filter"] == label].groupby(["scenario", "regime"])["rmse"]
    return float(np.mean([stats.trim_mean(np.log(values), 0.2) for _, values in cells]))


def test_ratios_are_those_of_scipy_and_transitive() -> None:
    data = table()
    by_baseline = {base: board(data, base) for base in EFFECTS}
    for base in EFFECTS:
        for label in EFFECTS:
            expected = math.exp(trimmed_level(data, label) - trimmed_level(data, base))
            assert by_baseline[base][label].ratio == pytest.approx(expected)
    chain = by_baseline["ukf"]["sir"].ratio * by_baseline["sir"]["mcmc_rpf"].ratio
    assert chain == pytest.approx(by_baseline["ukf"]["mcmc_rpf"].ratio)
    ranks = [{label: row.rank for label, row in rows.items()} for rows in by_baseline.values()]
    assert ranks[0] == ranks[1] == ranks[2] == {"mcmc_rpf": 1, "sir": 2, "ukf": 3}


def test_shared_runs_make_the_interval_of_a_difference_short() -> None:
    runs = arrange_runs(table(worlds=1), ("mcmc_rpf", "sir", "ukf"))
    levels = average_levels(compute_condition_levels(runs, "rmse"), runs.conditions)
    paired = float(levels.difference(0, 1).standard_error)
    alone = math.hypot(*(float(levels.single(k).standard_error) for k in (0, 1)))
    assert paired < 0.5 * alone


def test_intervals_cover_and_equal_filters_are_rarely_called_worse() -> None:
    """Size and coverage over 300 studies of three equal filters; 3.1 standard errors."""
    worse, outside, studies = 0, 0, 300
    for k in range(studies):
        rng = np.random.default_rng(k)
        error = np.exp(0.5 * rng.normal(size=(1, 1, 20)) + 0.1 * rng.standard_t(3, (3, 1, 20)))
        ones = np.ones(error.shape, dtype=bool)
        runs = StudyArrays(("a", "b", "c"), ONE_CONDITION, {"rmse": error}, ones, ones)
        levels = average_levels(compute_condition_levels(runs, "rmse"), ONE_CONDITION)
        low, high = levels.difference(0, 1).interval(0.05)
        outside += not low <= 0 <= high
        best = int(np.argmin(levels.level))
        lows = [levels.difference(i, best).interval(0.05 / 3)[0] for i in range(3) if i != best]
        worse += any(end > 0 for end in lows)
    limit = 0.05 + 3.1 * math.sqrt(0.05 * 0.95 / studies)
    assert worse / studies <= limit
    assert outside / studies <= limit


def test_verdicts() -> None:
    rows = board(table())
    assert [rows[k].verdict for k in ("mcmc_rpf", "sir", "ukf")] == ["best", "worse", "worse"]
    few = board(table(runs=4))
    assert few["sir"].verdict == "open"
    assert few["sir"].words == "4 runs"
    data = table()
    twin = data[data["filter"] == "mcmc_rpf"].assign(filter="ekf")
    same = board(pd.concat([data, twin]))
    assert {same[k].rank for k in ("ekf", "mcmc_rpf")} == {1}
    assert {same[k].words for k in ("ekf", "mcmc_rpf")} == {"smallest", "identical"}


def test_lost_runs_and_missing_conditions() -> None:
    data = table()
    off = (data["filter"] == "mcmc_rpf") & (data["run"] < 12)
    data.loc[off, "keeps_track"] = False
    rows = board(data)
    assert rows["mcmc_rpf"].verdict == "not_kept"
    assert rows["mcmc_rpf"].words == "track not kept, 4/4"
    assert rows["mcmc_rpf"].track == pytest.approx(0.6)
    assert rows["sir"].verdict == "best"
    off = data["filter"].eq("sir") & data["scenario"].eq("w0") & (data["run"] < 28)
    data.loc[off, "keeps_track"] = False
    rows = board(data)
    assert rows["sir"].words == "track not kept, 2/4"
    # fewer conditions first, although fewer runs of the other filter keep track there
    assert list(rows) == ["ukf", "sir", "mcmc_rpf"]
    few = table()
    few.loc[(few["filter"] == "mcmc_rpf") & (few["run"] < 5), "keeps_track"] = False
    assert board(few)["mcmc_rpf"].verdict == "best"  # fewer than the trimmed fifth
    part = table()
    part = part[(part["filter"] != "ukf") | (part["scenario"] == "w0")]
    assert board(part)["ukf"].verdict == "missing"
    assert board(part)["ukf"].rank is None


def test_filters_are_compared_where_all_of_them_were_run() -> None:
    data = table()
    part = data[data["filter"].eq("sir") | data["scenario"].eq("w0")]
    looks = find_looks(list(EFFECTS))
    worlds = {w: PartName(w, w, "", "m", None, w) for w in ("w0", "w1")}
    names = StudyNames(looks, worlds, {}, ["sir"])
    views = build_views(part, names, ReportOptions(), {("ukf", "mcmc_rpf"): "equivalent"})
    opening = next(iter(views.values()))
    common = board(data[data["scenario"] == "w0"])
    assert [row["filter"] for row in opening["rows"]] == list(common)
    for row in opening["rows"]:
        expected = common[row["filter"]]
        assert row["ratio"] == pytest.approx(expected.ratio, rel=1e-3)
        assert row["verdict"] == expected.verdict  # the planned word is of more conditions
    assert opening["sentence"].startswith(
        "2 of 4 conditions are compared: not all 3 filters were run in the others. [[MCMC-RPF]] has"
    )
    whole = next(iter(build_views(data, names, ReportOptions(), {}).values()))
    assert "compared:" not in whole["sentence"]
    apart = data[data["filter"].eq("sir") != data["scenario"].eq("w0")]
    split = next(
        iter(build_views(apart[apart["filter"] != "ukf"], names, ReportOptions(), {}).values())
    )
    assert "No filter has an error to compare" in split["sentence"]


def test_without_a_divergence_threshold_no_share_of_tracks_is_shown() -> None:
    """A run that is not lost may be anywhere: only lost runs are known."""
    data = table()
    data.loc[(data["filter"] == "mcmc_rpf") & (data["run"] < 12), "keeps_track"] = False
    for limit in (5.0, None):
        worlds = {w: PartName(w, w, "", "m", limit, w) for w in ("w0", "w1")}
        worlds["w0"] = PartName("w0", "w0", "", "m", 5.0, "w0")  # one world without it suffices
        names = StudyNames(find_looks(list(EFFECTS)), worlds, {}, ["mcmc_rpf"])
        views = build_views(data, names, ReportOptions(), {})
        opening = next(iter(views.values()))
        rows = {row["filter"]: row for row in opening["rows"]}
        text = " ".join(f"{view['sentence']} {view['small_print']}" for view in views.values())
        assert (rows["sir"]["track"] is None) == (limit is None)
        assert rows["mcmc_rpf"]["words"] == ("runs lost" if limit is None else "track not kept") + ", 4/4"  # fmt: skip
        assert ("[[MCMC-RPF]] is lost in 40 % of runs." in text) == (limit is None)
        alone = next(view for key, view in views.items() if key.world == "w0" and key.baseline == "mcmc_rpf")  # fmt: skip
        assert "does not keep track in 40 % of runs." in alone["sentence"]
        sentences = [view["sentence"] for key, view in views.items() if key.world == "w1"]
        assert any("Runs that are not lost: [[" in s for s in sentences) == (limit is None)
        assert any("Track is kept by" in s for s in sentences) == (limit is not None)


def test_the_log_score_orders_a_board() -> None:
    """A difference of 0.3 per step is a ratio of predictive densities."""
    data = table({"ekf": 0.0, "sir": 0.0}, worlds=1).drop(columns="rmse")
    score = np.random.default_rng(1).normal(-5.0, 1.0, len(data))
    order = data.groupby("filter").cumcount().to_numpy()
    data["log_score"] = score[order] + np.where(data["filter"] == "ekf", 0.3, 0.0)
    data["rmse"] = np.nan
    looks = find_looks(["ekf", "sir"])
    names = StudyNames(looks, {"w0": PartName("w0", "w0", "", "m", None, "w0")}, {}, ["sir"])
    views = build_views(data, names, ReportOptions(metric="log_score"), {})
    opening = next(iter(views.values()))
    first, second = opening["rows"]
    assert (first["filter"], first["unit"], second["filter"]) == ("ekf", None, "sir")
    assert first["ratio"] == pytest.approx(math.exp(-0.3), rel=1e-3)
    assert "has the smallest inverse predictive density per step" in opening["sentence"]
    (entry,) = metric_entries(data, "log_score")[:1]
    assert (entry["key"], entry["unit"]) == ("log_score", "")


def test_the_planned_word_decides() -> None:
    data = table({"mcmc_rpf": -0.02, "sir": 0.0, "ukf": 0.0}, worlds=1, runs=12)
    best = next(row.filter for row in board(data).values() if row.verdict == "best")
    rest = next(k for k in EFFECTS if k != best)
    assert board(data, planned={(rest, best): "worse"})[rest].verdict == "worse"
    data = table()
    assert board(data, planned={("sir", "mcmc_rpf"): "best"})["sir"].verdict == "open"


def test_a_pair_that_track_decides_has_the_difference_of_shares() -> None:
    """The interval is that of Agresti and Min for paired shares: half a run is added to each cell."""
    data = table({"mcmc_rpf": -0.3, "sir": 0.0}, worlds=1, runs=60)
    off = data["filter"].eq("sir") & (data["run"] < 36) | (data["run"] == 50)
    data.loc[off, "keeps_track"] = False
    looks = find_looks(["mcmc_rpf", "sir"])
    worlds = {"w0": PartName("w0", "World", "", "m", None, "w0")}
    options = ReportOptions()
    (entry,) = planned_entries(decide_planned(data, looks, options), data, looks, worlds, options)
    only, other, total = 36.5, 0.5, 62.0
    error = math.sqrt(only + other - (only - other) ** 2 / total) / total
    level = 1 - 0.05 / 2  # two tests of a pair, track and error
    low, high = 100 * np.array(stats.t.interval(level, 59, (only - other) / total, error))
    shares = (
        r"98\.3 and 38\.3 %(?: of runs, difference|,) 60 (?:percentage )?points \((\S+) to (\S+)\)"
    )
    for text in (entry["reason"], entry["sentence"]):
        shown = re.search(shares, text)
        assert shown is not None, text
        assert [float(end) for end in shown.groups()] == pytest.approx([low, high], rel=3e-3)
    won = re.match(
        r"runs won: ([\d.]+) points \(([\d.]+) to ([\d.]+)\); track kept: 98", entry["reason"]
    )
    assert won is not None
    shown = [entry["won"][name] for name in ("estimate", "low", "high")]
    assert shown == pytest.approx(list(map(float, won.groups())), rel=5e-3)
    assert entry["won"]["track"] == pytest.approx([59 / 60, 23 / 60], rel=1e-5)
    pack = {"planned": [entry], "filters": [{"key": k, "name": k} for k in looks]}
    assert name_effects(pack) == "Runs won"
    (text,) = describe_pairs(pack)
    assert text["effect"].endswith(" points")
    assert float(text["effect"].split()[0]) == pytest.approx(float(won[1]), rel=5e-3)
    assert (text["interval"][0], text["track"]) == ("[", "98.3 and 38.3 %")


@pytest.mark.parametrize("percent", [-0.0783, 0.0859, 9.87, -12.34, 250.6, 1e-6])
def test_a_ratio_near_one_keeps_the_digits_of_its_distance_from_one(percent: float) -> None:
    """Four digits of the ratio itself would show 0.0783 % as 0.08."""
    ratio = round_ratio(math.log1p(percent / 100))
    assert ratio is not None
    assert 100 * (ratio - 1) == pytest.approx(percent, rel=2e-3)
    assert len(repr(ratio)) <= 14
    assert round_ratio(math.nan) is None


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
    assert "nan" not in text
    assert "  " not in text
    assert "None" not in text
    assert ("No filter has an error to compare" in text) == is_lost
    if not is_lost and len(labels) > 1 and runs == 30:
        assert text.startswith("[[MCMC-RPF]] has the smallest position error in Flight: 2")


def sentence(data: pd.DataFrame, baseline: str) -> str:
    rows = list(board(data, baseline).values())
    return describe_view(rows, find_looks(data["filter"].unique()), baseline, "in Flight", "error")


def test_sentence_where_the_baseline_is_the_best_states_the_distance_of_the_next() -> None:
    data = table()
    assert data["filter"].nunique() == 3
    size = 100 * (math.exp(trimmed_level(data, "sir") - trimmed_level(data, "mcmc_rpf")) - 1)
    text = sentence(data, "mcmc_rpf")
    assert (
        f"[[MCMC-RPF]] has the smallest error in Flight. The next, [[SIR]], is {size:.0f} % above it (95"
        in text
    )


@pytest.mark.parametrize(
    ("lost", "baseline", "words", "pair"),
    [
        ({"sir": 36}, "sir", "because of tracks not kept. Track", (0, 36)),
        ({"sir": 36, "ukf": 48}, "mcmc_rpf", "No other filter has an error to compare. Track", (0, 36)),
        ({"sir": 36, "ukf": 48, "mcmc_rpf": 24}, "ukf", "to compare in Flight. Track", (24, 48)),
        ({"sir": 36}, "ukf", "", None),
    ],
)  # fmt: skip
def test_a_sentence_without_a_ratio_has_the_difference_of_shares(
    lost: dict[str, int], baseline: str, words: str, pair: tuple[int, int] | None
) -> None:
    """As the interval of Agresti and Min; lost runs of one filter are lost by those that lose more."""
    data = table(runs=60)
    for label, count in lost.items():
        data.loc[data["filter"].eq(label) & (data["run"] < count), "keeps_track"] = False
    labels = tuple(sorted(data["filter"].unique()))
    interval = partial(compare_track_shares, arrange_runs(data, labels))
    rows = list(board(data, baseline).values())
    arguments = (rows, find_looks(labels), baseline, "in Flight", "error", "95 %")
    text = describe_view(*arguments, interval)
    assert ("percentage points" in text) == (pair is not None)
    if pair is None:
        return
    only, other, total = pair[1] - pair[0] + 0.5, 0.5, 62.0
    error = math.sqrt(only + other - (only - other) ** 2 / total) / total
    ends = 100 * np.array(stats.t.interval(0.95, 59, (only - other) / total, error))
    kept = [100 * (1 - count / 60) for count in pair]
    shown = re.search(
        r"by \S+ in (\S+) % and by \S+ in (\S+) % of runs, difference (\S+) percentage points "
        r"\(95 % interval (\S+) to (\S+)\)", text,
    )  # fmt: skip
    assert words in text
    assert shown is not None
    expected = [*kept, kept[0] - kept[1], *(float(f"{end:.1e}") for end in ends)]
    assert [float(number) for number in shown.groups()] == pytest.approx(expected)


def test_intervals_of_a_sentence_have_two_significant_digits() -> None:
    data = table()
    for baseline, form in (("sir", lambda r: 1 - r), ("mcmc_rpf", lambda r: r - 1)):
        row = board(data, baseline)["mcmc_rpf" if baseline == "sir" else "sir"]
        shown = re.search(r"interval (\S+) to (\S+) %", sentence(data, baseline))
        assert shown is not None
        ends = sorted(100 * form(r) for r in (row.ratio_low, row.ratio_high))
        assert [float(text) for text in shown.groups()] == [float(f"{end:.1e}") for end in ends]


def test_sentence_on_the_baseline_follows_the_joint_verdict() -> None:
    data = table({"mcmc_rpf": -0.02, "sir": 0.0}, worlds=1, runs=100)
    assert board(data)["sir"].verdict == "equal"
    assert "below [[SIR]]" in (text := sentence(data, "sir"))
    assert "equal to it within 5.0 %" in text
    wide = table({"mcmc_rpf": -0.02, "sir": 0.0, "ukf": 0.01}, worlds=1, runs=12)
    best = next(row.filter for row in board(wide).values() if row.verdict == "best")
    other = next(row.filter for row in board(wide).values() if row.verdict == "open")
    text = sentence(wide, other)
    assert best != other
    assert "Jointly with all other pairs this is not decided: [[" in text
    assert "2 are not decided against the best" in text


def test_results_that_differ_by_rounding_are_identical_in_words() -> None:
    data = table({"sir": 0.0})
    noise = 1e-9 * np.random.default_rng(3).normal(size=len(data))
    twin = data.assign(filter="ukf", rmse=data["rmse"] * (1 + noise))
    assert sorted(row.words for row in board(pd.concat([data, twin])).values()) == [
        "identical",
        "smallest",
    ]
    text = sentence(pd.concat([data, twin]), "sir")
    assert text.endswith("have the smallest error in Flight (identical results).")
    apart = data.assign(filter="ukf", rmse=data["rmse"] * (1 + 1e6 * noise))
    assert "identical" not in sentence(pd.concat([data, apart]), "sir")


def test_files_hold_what_the_board_shows(tmp_path: Path) -> None:
    data = table()
    rows = [{"filter": k, "ratio": row.ratio} for k, row in board(data).items()]
    pack = {"views": {("rmse", "all", "all", "sir"): {"rows": rows}}, "bibtex": "@misc{a}"}
    with RecordedFolder(tmp_path / "report") as folder:
        downloads = write_verdict_files(pack, data, folder)
    stored = pd.read_parquet(io.BytesIO((tmp_path / "report" / "runs.parquet").read_bytes()))
    verdicts = pd.read_csv(tmp_path / "report" / "verdicts.csv").set_index("filter")
    for label in EFFECTS:
        expected = math.exp(trimmed_level(stored, label) - trimmed_level(stored, "sir"))
        assert verdicts.loc[label, "ratio"] == pytest.approx(expected)
    assert [entry["href"] for entry in downloads] == ["verdicts.csv", "runs.parquet", "pfbench.bib"]


def test_planned_pairs_have_the_estimate_of_the_board() -> None:
    data = table({"mcmc_rpf": -0.3, "sir": 0.0, "rpf": 0.1}).assign(regime="nominal")
    data["run"] += 100 * (data.groupby(["filter", "scenario", "run"]).cumcount())
    looks, options = find_looks(sorted(data["filter"].unique())), ReportOptions(alpha=0.1)
    worlds = {k: PartName(k, f"World {k}", "", "m", None, k) for k in ("w0", "w1")}
    entries = planned_entries(decide_planned(data, looks, options), data, looks, worlds, options)
    assert {entry["a"] for entry in entries} == {"mcmc_rpf"}
    for entry in entries:
        rows = board(data, entry["b"], alpha=0.1)
        assert entry["estimate"] == pytest.approx(rows["mcmc_rpf"].ratio, rel=1e-3)
        joint = board(data, entry["b"], alpha=0.1 / 2)[
            "mcmc_rpf"
        ]  # two of four tests have a p-value
        assert (entry["low"], entry["high"]) == pytest.approx(
            (joint.ratio_low, joint.ratio_high), rel=1e-3
        )
        assert "90 % simultaneous interval" in entry["sentence"]
        assert "[[MCMC-RPF]]" in entry["sentence"]
        for cell in entry["cells"]:
            single = board(data[data["scenario"] == cell["world"]], entry["b"], alpha=0.1)
            assert cell["estimate"] == pytest.approx(single["mcmc_rpf"].ratio, rel=1e-3)
            assert cell["low"] == pytest.approx(single["mcmc_rpf"].ratio_low, rel=1e-3)
            assert cell["name"] == f"World {cell['world']}"


def test_too_few_runs_say_why_a_planned_pair_has_no_interval() -> None:
    data = table(runs=4, worlds=1)
    looks, options = find_looks(sorted(data["filter"].unique())), ReportOptions()
    planned = decide_planned(data, looks, options)
    (entry, *_) = planned_entries(planned, data, looks, {}, options)
    assert (entry["low"], entry["high"]) == (None, None)
    pack = {"planned": [entry], "filters": [{"key": k, "name": k} for k in looks]}
    assert describe_pairs(pack)[0]["interval"] == "4 runs per condition, 10 are required"
