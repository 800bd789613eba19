"""The first page of a study of methods in worlds: held against scipy, and against what it must not depend on."""

import io
import math
import re
import subprocess
import sys
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from checkout import ROOT
from scipy import stats

from pfbench.report import study_report
from pfbench.report.board.pack import open_court
from pfbench.report.options import ReportOptions
from pfbench.report.overview import figures
from pfbench.report.overview.page import (
    choose_level,
    count_better_worlds,
    describe_home,
    describe_price,
    describe_setting,
    describe_times,
    describe_tuned,
    list_forms,
    list_notes,
    list_verdicts,
    order_dose_worlds,
    render_overview,
    word_headline,
)
from pfbench.report.overview.tables import (
    AT_HOME,
    EQUAL_TIME,
    PRINTED,
    WITH_KNOBS,
    Overview,
    TabKey,
    World,
    WorldFacts,
    add_levels,
    build_overviews,
    build_world,
    central_rows,
    count_recorded_drives,
    decide_cells,
    find_outdone,
    find_winners,
    has_overview,
    list_levels,
    list_world_notes,
    name_without_level,
    name_word,
    pair_forms,
    read_world_facts,
    tell_story,
)
from pfbench.report.study_report import collect_home
from pfbench.results.conditions import make_distinct_label
from pfbench.results.looks import MethodLook, PartName, find_looks
from pfbench.stats.comparison import EQUAL_WORDS
from pfbench.stats.court import PAIR_FAMILIES, Court
from pfbench.stats.study_runs import StudyRuns, arrange_runs

RUNS, FAR = ROOT / "tests" / "all_seven_runs.parquet", 1e6
WORLDS = ("azimuth", "passive_1", "sar_flight_short")
MODELS = {
    "azimuth": "sins_gps_azimuth",
    "passive_1": "passive_location",
    "sar_flight_short": "sins_sar",
}


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    runs = pd.read_parquet(RUNS)
    runs = runs[runs["scenario"].isin(WORLDS) & (runs["regime"] == "nominal")]
    runs = runs.astype(dict.fromkeys(("scenario", "filter", "regime"), "str"))
    return runs.assign(model=runs["scenario"].map(MODELS))


@pytest.fixture(scope="module")
def looks(table: pd.DataFrame) -> dict[str, MethodLook]:
    return find_looks(sorted(table["filter"].unique()))


@pytest.fixture(scope="module")
def parts(table: pd.DataFrame) -> dict[str, PartName]:
    limits = table.groupby("scenario")["threshold"].first()
    return {key: PartName(key, key, key, "m", float(limits[key])) for key in WORLDS}


def build_tabs(
    table: pd.DataFrame, looks: dict[str, MethodLook], parts: dict[str, PartName]
) -> dict[TabKey, Overview]:
    table = add_levels(table, looks)
    return build_overviews(table, looks, parts, open_court(table, looks, ReportOptions()))


def build_overview(
    table: pd.DataFrame, looks: dict[str, MethodLook], parts: dict[str, PartName]
) -> Overview:
    return build_tabs(table, looks, parts)[0]


@pytest.fixture(scope="module")
def overview(
    table: pd.DataFrame, looks: dict[str, MethodLook], parts: dict[str, PartName]
) -> Overview:
    return build_overview(table, looks, parts)


def losses(table: pd.DataFrame, world: str, label: str) -> np.ndarray:
    """Return the log errors; a lost run is far above all others."""
    rows = table[(table["scenario"] == world) & (table["filter"] == label)].sort_values("run")
    kept = rows["keeps_track"].to_numpy(bool) & ~rows["lost"].to_numpy(bool)
    return np.where(kept, np.log(rows["rmse"].to_numpy(float)), FAR)


def adjust(p: list[float]) -> np.ndarray:
    order = np.argsort(p)
    steps = np.maximum.accumulate(np.array(p)[order] * np.arange(len(p), 0, -1))
    return np.minimum(steps, 1.0)[np.argsort(order)]


def test_pairs_of_methods_are_those_of_scipy(
    table: pd.DataFrame, looks: dict[str, MethodLook], overview: Overview
) -> None:
    """All pairs that a world fixes in advance are one family; the page shows those of methods and of the reference."""
    assert len(overview.methods) == 7
    assert len(overview.pairs) == len(WORLDS) * 21
    court, decided = open_court(table, looks, ReportOptions()), 0
    for world in WORLDS:
        mask = (court.runs.conditions["scenario"] == world).to_numpy()
        family = [v for name, v in court.list_verdicts("rmse", mask) if name == PAIR_FAMILIES[0]]
        p = [1.0] * len(family)
        for k, verdict in enumerate(family):
            both = [losses(table, world, label) for label in (verdict.a, verdict.b)]
            d = both[0] - both[1]
            d = np.where(np.abs(d) > FAR / 2, np.sign(d) * FAR, np.where(np.abs(d) <= 1e-6, 0.0, d))
            p[k] = float(stats.wilcoxon(d, zero_method="zsplit").pvalue) if d.any() else 1.0
            i, j = np.triu_indices(len(d))
            has_ratio = (np.maximum(*both) == FAR).mean() <= 0.2
            if has_ratio and d.any():
                assert verdict.ratio == pytest.approx(math.exp(np.median((d[i] + d[j]) / 2)))
        corrected = {frozenset((v.a, v.b)): q for v, q in zip(family, adjust(p), strict=True)}
        shown = [q.verdict for q in overview.pairs if q.world == world]
        shown += [c.verdict for c in overview.cells if c.world == world and c.filter in overview.methods]  # fmt: skip
        for verdict in shown:
            stated = corrected[frozenset((verdict.a, verdict.b))]
            assert math.isnan(verdict.p) or verdict.p == pytest.approx(stated, rel=1e-6, abs=1e-12)
            assert verdict.word not in ("better", "worse") or stated < 0.05
            decided += verdict.word in ("better", "worse")
    assert decided > 20


def test_another_filter_changes_no_number(
    table: pd.DataFrame,
    looks: dict[str, MethodLook],
    parts: dict[str, PartName],
    overview: Overview,
) -> None:
    fewer = table[table["filter"] != "gpf"]
    second = build_overview(fewer, {k: v for k, v in looks.items() if k != "gpf"}, parts)
    for pair, other in zip(overview.pairs, second.pairs, strict=True):
        np.testing.assert_equal(pair.verdict.ratio, other.verdict.ratio)
    ratios = {(c.world, c.filter): (c.verdict.ratio, c.track_share) for c in overview.cells}
    for c in second.cells:
        np.testing.assert_equal((c.verdict.ratio, c.track_share), ratios[c.world, c.filter])


def judge(rows: pd.DataFrame, fixed: list[tuple[str, str]] | None = None) -> list[World]:
    """Worlds of a table, whose reference is the EKF and whose pairs are all fixed in advance."""
    rows = rows.assign(family=rows["scenario"], regime="nominal")
    labels = {str(v): str(v) for v in rows["filter"].unique()}
    court = Court(arrange_runs(rows, tuple(labels)), fixed or combinations(labels, 2))
    facts, names = WorldFacts("ekf", None), dict.fromkeys(rows["scenario"])
    return [build_world(PartName(v, v, v), facts, court, "nominal", labels) for v in names]


def test_a_lost_run_is_worse_than_any_kept_one() -> None:
    rng = np.random.default_rng(1)
    rows = make_rows(rng, "w", {"m": 0.0, "ekf": 0.0})
    large, lost = rows.copy(), rows.copy()
    large.loc[3, "rmse"] = 1e7
    lost.loc[3, "keeps_track"] = False
    cells = [decide_cells(judge(table), ["m"])[0] for table in (large, lost)]
    assert cells[0].verdict[:7] == cells[1].verdict[:7]
    assert (cells[0].track_share, cells[1].track_share) == (1.0, 39 / 40)
    with pytest.raises(ValueError, match=r"w must have runs of its reference ekf, got none"):
        judge(rows[rows["filter"] == "m"], [("m", "ekf")])


def make_rows(rng: np.random.Generator, name: str, shifts: dict[str, float]) -> pd.DataFrame:
    base = rng.normal(size=40)
    parts = [
        pd.DataFrame({
            "scenario": name, "filter": k, "run": np.arange(40), "seed": 1, "keeps_track": True,
            "rmse": np.exp(base + v + rng.normal(0, 0.2, 40)),
        })
        for k, v in shifts.items()
    ]  # fmt: skip
    return pd.concat(parts, ignore_index=True)


def test_runs_are_paired_by_their_numbers() -> None:
    rows = make_rows(np.random.default_rng(6), "w", {"m": -0.3, "ekf": 0.0})
    fewer = rows[~((rows["filter"] == "m") & (rows["run"] == 0))]
    found = [decide_cells(judge(some), ["m"])[0].verdict for some in (rows, rows[::-1], fewer)]
    assert found[0][:8] == found[1][:8]
    assert [verdict.n for verdict in found] == [40, 40, 39]


def test_a_winner_is_better_than_every_baseline() -> None:
    rng = np.random.default_rng(2)
    clear = make_rows(rng, "clear", {"m": -0.8, "ekf": 0.0, "sir": 0.2})
    tied = make_rows(rng, "tied", {"m": -0.8, "ekf": 0.0, "sir": -0.8})
    found = find_winners(judge(pd.concat([clear, tied])), ["m"], ["ekf", "sir"])
    assert [wins for _, wins in found.values()] == [True, False]


def test_a_filter_loses_track_where_fewer_than_80_percent_of_runs_are_shown_to_keep_it() -> None:
    rng = np.random.default_rng(4)
    conditions = pd.DataFrame({"family": ["w"], "scenario": ["w"], "regime": ["nominal"]})
    said = []
    for share in (0.5, 0.8):
        words = 0
        for _ in range(200):
            keeps = np.stack([rng.uniform(size=(1, 40)) < share, np.ones((1, 40), dtype=bool)])
            runs = StudyRuns(("m", "ekf"), conditions, {}, keeps, np.ones((2, 1, 40), dtype=bool))
            words += bool(Court(runs, ()).find_lost(np.ones(1, dtype=bool)))
        said.append(words / 200)
    assert said[0] > 0.9
    assert said[1] <= 0.05 + 2.5 * math.sqrt(0.05 * 0.95 / 200)


def test_the_reference_is_that_of_the_tuning_and_not_of_the_runs(
    table: pd.DataFrame,
    looks: dict[str, MethodLook],
    parts: dict[str, PartName],
    overview: Overview,
) -> None:
    facts = read_world_facts("passive_1", "passive_location")
    assert facts is not None
    assert facts.reference in {world.reference for world in overview.worlds}
    better = table.copy()
    better.loc[better["filter"] == "ukf", "rmse"] *= 0.1
    changed = build_overview(better, looks, parts)
    assert [w.reference for w in changed.worlds] == [w.reference for w in overview.worlds]
    without = table[~((table["scenario"] == "passive_1") & (table["filter"] == facts.reference))]
    left = build_overview(without, looks, parts).left_out
    assert list(left) == ["passive_1"]
    assert f"must have runs of its reference {facts.reference}" in left["passive_1"]
    unknown = build_overview(table.assign(model="other"), looks, parts)
    assert unknown.worlds == []
    assert "Run pfbench tune scenario=azimuth model=other" in unknown.left_out["azimuth"]


def test_sentences_are_short_and_state_numbers_of_the_tables(overview: Overview) -> None:
    headline = word_headline(overview)
    assert len(headline.split()) <= 55
    assert not re.search(r"robust|points|planned|trade-off|consistent", headline)
    cells_of = [c for c in overview.cells if c.filter in overview.methods]
    words = ["lost" if c.loses_track else c.verdict.word for c in cells_of]
    single = sum(cell.beats_kalman for cell in overview.cells)
    assert f"better in {words.count('better')} of {len(words)} cells" in headline
    assert (f"(in {single} than all single ones)" in headline) == (single > 0)
    against_best = re.sub(r"\(.*?\)", "", headline.split("Kalman filter:", 1)[1])
    counts = re.findall(r"\bin (\d+)", against_best)
    assert sum(map(int, counts)) == len(words)
    cells = list_verdicts(overview).set_index(["world", "filter"])
    for method in overview.methods:
        story = tell_story(overview, method, "")
        for world, ratio in re.findall(
            r"(\w+) \((\d+\.\d+)\)", f"{story['wins']}; {story['loses']}"
        ):
            assert f"{cells.loc[(world, method), 'ratio']:.2f}" == ratio
        of_method = [c for c in overview.cells if c.filter == method]
        parts = [story[key] for key in ("wins", "equal", "open", "loses")]
        for world in overview.worlds:
            assert sum(world.part_name.name in text for text in parts) == sum(
                cell.world == world.key for cell in of_method
            )


def test_wins_over_some_kalman_filters_alone_have_a_dagger(overview: Overview) -> None:
    """A dagger is what separates the two counts of the headline."""
    winner = overview.of_methods[0]
    cells = [
        c._replace(verdict=c.verdict._replace(word="better"), loses_track=False, beats_kalman=c is winner)
        for c in overview.cells
    ]  # fmt: skip
    page = overview._replace(cells=cells)
    wins = [tell_story(page, method, "")["wins"] for method in page.methods]
    count = sum(cell.filter in page.methods for cell in cells)
    assert sum(text.count("†") for text in wins) == count - 1
    world = {w.key: w.part_name.name for w in page.worlds}[winner.world]
    of_winner = wins[page.methods.index(winner.filter)]
    assert re.search(rf"{re.escape(world)} \((\d+\.\d+|\d+ % keep track)\)", of_winner)


def test_a_win_against_kalman_filters_is_one_against_each_of_them(
    table: pd.DataFrame,
    looks: dict[str, MethodLook],
    parts: dict[str, PartName],
    overview: Overview,
) -> None:
    """By scipy's signed-rank test; and a world whose reference is outdone in its own runs says so."""
    strong = table.copy()
    strong.loc[strong["filter"] == "mcmc_rpf", "rmse"] *= 0.1
    one = strong["scenario"] == overview.worlds[0].key
    strong.loc[one & (strong["filter"] == "student_tuned"), "rmse"] *= 0.001
    first = build_overview(strong, looks, parts)
    counts = count_better_worlds({100: first, EQUAL_TIME: first._replace(cells=[])})
    single = [
        v for v, look in looks.items()
        if look.family == "kalman" and not look.proposed and v != "ekf_bank"
    ]  # fmt: skip
    assert {"ekf", "ukf"} < set(single)
    assert "student_tuned" in single
    won = [(cell.world, cell.filter) for cell in first.cells if cell.beats_kalman]
    assert overview.worlds[0].key not in [world for world, _ in won]  # one filter of many is better
    assert sum(better for better, _ in counts.values()) == len(won) > 0
    assert {count for _, count in counts.values()} == {len(overview.worlds)}
    for world, method in won:
        for other in single:
            d = losses(strong, world, method) - losses(strong, world, other)
            assert stats.binomtest(int((d < 0).sum()), len(d)).pvalue < 0.1
            assert stats.wilcoxon(d, alternative="less").pvalue < 0.05, (world, method, other)
    better = table.copy()
    better.loc[better["filter"] == "ukf", "rmse"] *= 0.001
    changed = build_overview(better, looks, parts)
    references = {world.key: world.reference for world in changed.worlds}
    found = {w.key: find_outdone(w, changed.single) for w in changed.worlds}
    outdone = {key: verdict.b for key, verdict in found.items() if verdict}
    assert outdone == {key: "ukf" for key, name in references.items() if name != "ukf"}
    assert "In these runs another one is better: UKF in" in describe_setting(changed)
    assert not any(won for won, _ in count_better_worlds({0: changed}).values())


def test_worlds_have_notes_on_what_their_numbers_mean(
    table: pd.DataFrame, looks: dict[str, MethodLook], parts: dict[str, PartName], overview: Overview
) -> None:  # fmt: skip
    """An idle reference, one that loses track, and recordings; no note where there is nothing to know."""
    assert not list_notes(overview)
    facts = read_world_facts("azimuth", MODELS["azimuth"])
    assert facts is not None
    of_reference = (table["scenario"] == "azimuth") & (table["filter"] == facts.reference)
    idle = table[of_reference].assign(filter="dead_reckoning")
    weak = pd.concat([table, idle])
    names = find_looks(sorted(weak["filter"].unique()))
    says_nothing = "the best Kalman filter is not shown to be better than dead reckoning"
    assert list_notes(build_overview(weak, names, parts)) == [("azimuth", says_nothing)]
    worse = np.random.default_rng(1).uniform(1.5, 3.0, len(weak))
    able = weak.assign(rmse=weak["rmse"] * np.where(weak["filter"] == "dead_reckoning", worse, 1.0))
    assert list_notes(build_overview(able, names, parts)) == []
    runs = table.loc[of_reference, "run"]
    few = runs[: int(0.4 * len(runs))]
    keeps = able["keeps_track"] & ~(
        (able["scenario"] == "azimuth")
        & (able["filter"] == facts.reference)
        & able["run"].isin(few)
    )
    ((_, text),) = list_notes(build_overview(able.assign(keeps_track=keeps), names, parts))
    assert f"keeps track in {100 * (1 - len(few) / len(runs)):.0f} % of runs" in text


def test_recordings_are_counted_by_the_files_of_their_scenarios(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counts = {
        "recorded_quad_flights": 20, "recorded_canyon": 1, "recorded_car_drive": 1, "pendulum": 0,
        "a_scenario_of_another_folder": 0,
    }  # fmt: skip
    assert {key: count_recorded_drives(key) for key in counts} == counts
    monkeypatch.chdir(tmp_path)
    (tmp_path / "conf" / "scenario").mkdir(parents=True)
    own = tmp_path / "conf" / "scenario" / "a_scenario_of_another_folder.yaml"
    own.write_text("defaults: [recorded_quad_flights, _self_]\nflights: [1, 2]\n")
    assert count_recorded_drives(own.stem) == 2
    frame = pd.DataFrame({"scenario": "recorded_quad_flights", "filter": "ekf", "run": range(9), "rmse": 1.0, "keeps_track": True, "seed": 1})  # fmt: skip
    (world,) = judge(frame, [("ekf", "m")])
    (same,) = list_world_notes(world)
    assert (
        same
        == "the best Kalman filter was tuned on the same 20 recordings, with other random numbers"
    )
    drive = world._replace(key="recorded_canyon", facts=WorldFacts("ekf", None, has_part=True))
    single, part = list_world_notes(drive)
    assert single.startswith("one recording: ")
    assert part == "the best Kalman filter was tuned on a part of it"


def test_a_method_with_another_number_of_particles_than_its_table_is_named(
    table: pd.DataFrame, looks: dict[str, MethodLook], parts: dict[str, PartName]
) -> None:
    """An adaptive method, whose number its file sets."""
    both = [
        table.assign(
            filter=[
                f"{v}[particles={n}]" if n and looks[str(v)].proposed else v
                for v in table["filter"]
            ],
            particles=[200.0 if v == "cofm_amssrcpf" else float(n) for v in table["filter"]],
        )
        for n in (100, 1000)
    ]
    joined = pd.concat([both[0], both[1][both[1]["filter"].astype(str).str.contains("particles=")]])
    overviews = build_tabs(joined, find_looks(sorted(set(joined["filter"]))), parts)
    assert overviews[1000].numbers["cofm_amssrcpf"] == 200.0
    assert "mcmc_rpf" not in overviews[1000].numbers
    name = overviews[1000].names["cofm_amssrcpf"]
    assert f"1000 particles (its own number: {name} 200)" in describe_setting(overviews[1000], 1000)


def test_a_method_that_ran_in_few_worlds_is_named(overview: Overview) -> None:
    """One missing world is a dash in the heat map; with more, the first lines say it."""
    assert " of them" not in describe_setting(overview)
    worlds = [world.key for world in overview.worlds]
    for number, said in ((len(worlds) - 1, False), (1, True)):
        lacking = worlds[number:]
        cells = [c for c in overview.cells if c.filter != "mcmc_rpf" or c.world not in lacking]
        text = describe_setting(overview._replace(cells=cells))
        assert (f"MCMC-RPF ran in {number} of them." in text) == said


def test_a_job_at_equal_time_has_its_budget_in_its_label() -> None:
    """Its number of particles follows from the time: 63 where its settings say 1000. Equal numbers are usual."""
    config = {
        "particles": {"budget": "particles", "particles": 100, "filter": {"particles": 100}},
        "time": {"budget": "time", "particles": 1000, "filter": {"particles": 1000}},
    }
    metas = [{"label": "cpso_escape", "key": k, "config": c} for k, c in config.items()]
    labels = [make_distinct_label(meta, metas) for meta in metas]
    assert labels == ["cpso_escape[particles=100]", "cpso_escape[budget=time,particles=1000]"]
    config["particles"]["particles"] = config["particles"]["filter"]["particles"] = 1000
    labels = [make_distinct_label(meta, metas) for meta in metas]
    assert labels == ["cpso_escape", "cpso_escape[budget=time]"]


@pytest.mark.parametrize("kind", ["heat map", "matrices"])
@pytest.mark.parametrize("key", [100, PRINTED])
def test_figures_are_small_readable_and_inside_their_paper(
    kind: str, key: TabKey, tabs: dict[TabKey, Overview]
) -> None:
    overview = tabs[key]
    formats = figures.HEAT_FORMATS if kind == "heat map" else figures.MATRIX_FORMATS
    draw = figures.draw_heat_map if kind == "heat map" else figures.draw_matrices
    for size in formats:
        figure = draw(overview, size)
        svg = figures.to_svg(figure)
        assert len(svg) < 60_000
        assert svg == figures.to_svg(draw(overview, size))
        box = figure.bbox
        texts = [t for axes in figure.axes for t in (*axes.texts, *axes.get_yticklabels())]
        for text in (*texts, *figure.texts):
            assert text.get_fontsize() >= 5.8
            extent = text.get_window_extent()
            assert -1 <= extent.x0 <= extent.x1 <= box.x1 + 1, text.get_text()
            assert -1 <= extent.y0 <= extent.y1 <= box.y1 + 1, text.get_text()


def test_a_tuning_of_the_current_folder_states_its_world(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the remedy of a world that is left out says."""
    monkeypatch.chdir(tmp_path)
    assert read_world_facts("mine", "own") is None
    file = tmp_path / "conf" / "tuned" / "mine.yaml"
    file.parent.mkdir(parents=True)
    file.write_text("world: [")
    assert read_world_facts("mine", "own") is None
    file.write_text(
        "world: {scenario: mine, model: own}\nbest: ukf\nkalman_fits: false\nfit: {cap: 7}"
    )
    assert (read_world_facts("mine", "own") or ())[:3] == ("ukf", False, False)
    part = file.read_text().replace("own}", "own, settings: [scenario.end_s=150]}")
    file.write_text(part + "\n")
    assert (read_world_facts("mine", "own") or ())[:3] == ("ukf", False, True)


def test_a_study_without_references_keeps_its_first_page(
    table: pd.DataFrame,
    looks: dict[str, MethodLook],
    parts: dict[str, PartName],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    facts = SimpleNamespace(looks=looks, worlds=parts, options=ReportOptions())
    monkeypatch.setattr(study_report.StudyFacts, "from_pack", lambda pack: facts)
    assert study_report.find_overviews({}, table) is not None
    assert study_report.find_overviews({}, table.assign(model="other")) is None


def test_ink_has_contrast_on_every_ground() -> None:
    def luminance(colour: tuple[float, ...]) -> float:
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in colour]
        return float(np.dot((0.2126, 0.7152, 0.0722), linear))

    for value in np.linspace(0, 1, 51):
        ground = figures.palette()(value)[:3]
        ink = figures.choose_ink(ground)
        rgb = (
            (1.0, 1.0, 1.0)
            if ink == "white"
            else tuple(int(ink[k : k + 2], 16) / 255 for k in (1, 3, 5))
        )
        low, high = sorted((luminance(ground), luminance(rgb)))
        assert (high + 0.05) / (low + 0.05) >= 4.5


def test_undecided_cells_have_no_colour_and_lost_tracks_are_grey(overview: Overview) -> None:
    words = {(c.world, c.filter): c for c in overview.cells}
    first = next(key for key, c in words.items() if c.verdict.word == "not decided")
    words[first] = words[first]._replace(verdict=words[first].verdict._replace(word="equal"))
    page = overview._replace(cells=list(words.values()))
    drawn = {
        key: figures.describe_cell(page, world, key[1])
        for key in words
        for world in overview.worlds
        if world.key == key[0]
    }
    assert {c.verdict.word for c in words.values()} >= {"not decided", "worse", "equal"}
    for key, cell in words.items():
        is_coloured = cell.verdict.word in ("better", "worse") and not cell.loses_track
        assert math.isnan(drawn[key].value) != is_coloured
        assert drawn[key].is_grey == cell.loses_track
        assert (drawn[key].text == "=") == (cell.verdict.word in EQUAL_WORDS)
        if is_coloured:  # without a ratio: the darkest colour of its side
            darkest = math.log(3) if cell.verdict.word == "worse" else -math.log(3)
            size = math.log(cell.verdict.ratio) if cell.verdict.ratio > 0 else darkest
            assert drawn[key].value == pytest.approx(size)


def test_the_cost_of_a_method_is_the_median_of_its_worlds_with_the_range(
    overview: Overview,
) -> None:
    method = overview.methods[0]
    costs = dict(zip((world.key for world in overview.worlds), (2.0, 9.0, 3.0), strict=True))
    times = {(world.key, world.reference): 4.0 for world in overview.worlds}
    times |= {(key, method): 4.0 * cost for key, cost in costs.items()}
    story = tell_story(overview._replace(times=times), method, "")
    assert story["time"] == "3 (2 to 9)"


def test_the_page_has_its_figures_tables_and_stories(overview: Overview) -> None:
    pack = {
        "study": "s",
        "title": "A title",
        "generated": {"version": "0", "commit": "abc", "date": ""},
    }
    files = render_overview({0: overview}, pack)
    page = files["index.html"]
    assert set(files) >= {
        "index.html", "report.md", "cells.csv", "pairs.csv", "heat_map.svg", "matrices_column.svg",
    }  # fmt: skip
    assert page.count("data:image/svg+xml;base64,") == 4
    assert "http://" not in page.replace("http://www.w3.org", "")
    text = files["report.md"]
    for method in overview.methods:
        assert overview.names[method] in page
        assert overview.names[method] in text
    assert "The seven against each other" in page
    assert word_headline(overview) in page.replace("&#39;", "'")
    left = overview._replace(cells=[cell for cell in overview.cells if cell.world != "azimuth"])
    assert [w.key for w in order_dose_worlds(left)] == [w.key for w in order_dose_worlds(overview) if w.key != "azimuth"]  # fmt: skip


@pytest.fixture(scope="module")
def levels(table: pd.DataFrame, parts: dict[str, PartName]) -> dict[TabKey, Overview]:
    """The same runs as of 100 particles, and with half of the error of particle filters as of 1000."""
    particle = ["mcmc_rpf", "qmc_polymerised", "cpso_escape", "dmc_reconstructed", "sir", "rpf"]
    swept = table[table["filter"].isin(particle)]
    few = swept.assign(filter=swept["filter"] + "[particles=100]")
    many = swept.assign(
        filter=swept["filter"] + "[particles=1000]", rmse=swept["rmse"] / 2, ms=swept["ms"] * 9
    )
    both = pd.concat([table[~table["filter"].isin(particle)], few, many])
    return build_tabs(both, find_looks(sorted(both["filter"].unique())), parts)


def test_each_number_of_particles_has_its_tables(
    overview: Overview, levels: dict[TabKey, Overview]
) -> None:
    assert list(levels) == [100, 1000]
    plain = {(c.world, c.filter): c.verdict.ratio for c in overview.cells}
    for cell in levels[100].cells:
        np.testing.assert_equal(cell.verdict.ratio, plain[cell.world, cell.filter])
    assert levels[1000].methods == levels[100].methods == overview.methods
    assert levels[1000].names["mcmc_rpf"] == overview.names["mcmc_rpf"]
    half = {(c.world, c.filter): c.verdict.ratio for c in levels[1000].cells}
    assert half["azimuth", "mcmc_rpf"] == pytest.approx(plain["azimuth", "mcmc_rpf"] / 2, rel=0.1)
    assert half["azimuth", "fm_mssrckf"] == plain["azimuth", "fm_mssrckf"]
    points, times = (figures.dose_points({k: levels[k] for k in (100, 1000)}, overview.worlds[0], "mcmc_rpf", axis) for axis in ("particles", "time"))  # fmt: skip
    assert [x for x, _ in points] == [100.0, 1000.0]
    assert times[1][0] == pytest.approx(9 * times[0][0])


def test_labels_without_their_number_of_particles() -> None:
    assert name_without_level("sir[particles=100]") == "sir"
    assert name_without_level("sir[particles=100,budget=time,scale=2]") == "sir[scale=2]"
    assert name_without_level("ekf") == "ekf"
    labels = ["mcmc_rpf", "qmc_polymerised", "cpso_escape"]
    assert list_levels(find_looks([f"{name}[particles=50]" for name in labels])) == []
    assert list_levels(find_looks([f"{k}[particles={n}]" for k in labels for n in (9, 50)])) == [
        9,
        50,
    ]


@pytest.fixture(scope="module")
def tabs(table: pd.DataFrame, parts: dict[str, PartName]) -> dict[TabKey, Overview]:
    """Two numbers of particles; at equal time with twice the errors of the larger one; three forms as printed."""
    particle = ["mcmc_rpf", "qmc_polymerised", "cpso_escape", "dmc_reconstructed", "sir", "rpf"]
    swept = table[table["filter"].isin(particle)]
    names = {"few": "[particles=100]", "many": "[particles=1000]"}
    kinds = [
        swept.assign(filter=swept["filter"] + names["few"], particles=100),
        swept.assign(filter=swept["filter"] + names["many"], particles=1000),
        swept.assign(
            filter=swept["filter"] + "[budget=time,particles=1000]",
            particles=700,
            rmse=2 * swept["rmse"],
        ),
    ]
    printed = swept[swept["filter"].isin(particle[1:4]) & (swept["scenario"] != "azimuth")]
    kinds.append(printed.assign(filter=printed["filter"] + "_printed", particles=100))
    factors = printed["filter"].map({"dmc_reconstructed": 1 / 9}).fillna(1.0) * printed["rmse"]
    kinds.append(printed.assign(filter=printed["filter"] + "_tuned", particles=1000, rmse=factors))
    both = pd.concat([table[~table["filter"].isin(particle)].assign(particles=np.nan), *kinds])
    return build_tabs(both, find_looks(sorted(both["filter"].unique())), parts)


def test_filters_at_equal_time_and_as_printed_have_tables_of_their_own(
    overview: Overview, tabs: dict[TabKey, Overview]
) -> None:
    """In each table all filters have one setting, so that none is compared with another setting of itself."""
    assert list(tabs) == [100, 1000, EQUAL_TIME, PRINTED, WITH_KNOBS]
    plain = {(c.world, c.filter): c.verdict.ratio for c in overview.cells}
    for key in (100, 1000):
        found = {(c.world, c.filter): c.verdict.ratio for c in tabs[key].cells}
        np.testing.assert_equal(found, plain)
    timed = {(c.world, c.filter): c.verdict.ratio for c in tabs[EQUAL_TIME].cells}
    assert timed["azimuth", "fm_mssrckf"] == plain["azimuth", "fm_mssrckf"]
    assert timed["azimuth", "mcmc_rpf"] == pytest.approx(2 * plain["azimuth", "mcmc_rpf"], rel=0.1)
    printed = tabs[PRINTED]
    assert set(printed.methods) == {
        f"{k}_printed" for k in ("qmc_polymerised", "cpso_escape", "dmc_reconstructed")
    }
    assert {w.key for w in printed.worlds} == {
        "passive_1",
        "sar_flight_short",
    }  # where they have runs
    ratios = {(c.world, c.filter): c.verdict.ratio for c in printed.cells}
    assert ratios["passive_1", "cpso_escape_printed"] == plain["passive_1", "cpso_escape"]
    assert ratios["passive_1", "sir"] == plain["passive_1", "sir"]


def test_a_word_that_tuning_turns_is_named_with_both_ratios(tabs: dict[TabKey, Overview]) -> None:
    """A ninth of the errors of one method turns its words; methods with the same errors keep theirs."""
    plain, tuned = tabs[1000], tabs[WITH_KNOBS]
    pairs = pair_forms(plain, tuned)
    assert {(a.world, f"{a.filter}_tuned") for a, _ in pairs} == {
        (b.world, b.filter) for _, b in pairs
    }
    turned = [a for a, b in pairs if {name_word(a), name_word(b)} == {"better", "worse"}]
    assert {a.filter for a in turned} == {"dmc_reconstructed"}
    text = describe_tuned(plain, tuned)
    names = {world.key: world.part_name.name for world in tuned.worlds}
    assert (
        f"Blue turns orange or back: {'; '.join(f'DMC-PF in {names[a.world]}' for a in turned)};"
        in text
    )
    rows = {row[0]: row[1:] for row in list_forms(plain, tuned)}
    for a, b in pairs:
        cell = rows[names[a.world]][plain.methods.index(a.filter)]
        assert cell.endswith("‡") == (name_word(a) != name_word(b))
    same = describe_tuned(
        plain,
        plain._replace(
            methods=[f"{m}_tuned" for m in plain.methods],
            cells=[
                c._replace(verdict=c.verdict._replace(a=f"{c.filter}_tuned")) for c in plain.cells
            ],
        ),
    )
    assert "None turns from blue to orange or back; 0 have another word (‡)." in same


def test_the_price_of_a_tuning_is_named_where_it_was_not_paid(tabs: dict[TabKey, Overview]) -> None:
    overview = tabs[1000]
    facts = [
        {"mcmc_rpf": {"seconds": 90.0}},
        {"not_tuned_hours": dict.fromkeys(("mcmc_rpf", "cpso_escape"), 1.25)},
    ]
    worlds = [
        w._replace(facts=w.facts._replace(tuning=t))
        for w, t in zip(overview.worlds, facts, strict=False)
    ]
    text = describe_price(overview._replace(worlds=worlds))
    assert text.startswith("The tuning took 2 CPU minutes. Not tuned in this world: ")
    assert f"{worlds[1].part_name.name} (MCMC-RPF, CPSO-Escape: 2.5 CPU hours)." in text


def test_filters_that_take_longer_than_the_equal_time_are_named(tabs: dict[TabKey, Overview]) -> None:  # fmt: skip
    """A filter cannot have less than its fewest particles."""
    tab = tabs[EQUAL_TIME]
    worlds = {world.key: world.part_name.name for world in tab.worlds}
    even = dict.fromkeys(tab.times, 2.0)
    assert describe_times(tab._replace(times=even)) == ""
    key = next(key for key in even if key[1] == "mcmc_rpf")
    text = describe_times(tab._replace(times={**even, key: 13.4}))
    assert text.endswith(f"{tab.names['mcmc_rpf']} 6.7 times ({worlds[key[0]]}).")


def test_a_method_that_sets_its_number_itself_is_once_in_the_table_of_equal_time(
    table: pd.DataFrame, parts: dict[str, PartName], overview: Overview
) -> None:
    """Its job without a budget has no number in its label, as a Kalman filter has none."""
    timed = ["mcmc_rpf", "qmc_polymerised", "dmc_reconstructed", "cofm_amssrcpf"]
    rows = table[table["filter"].isin(timed)]
    rows = rows.assign(
        filter=rows["filter"] + "[budget=time,particles=1000]", rmse=3 * rows["rmse"]
    )
    both = pd.concat([table[~table["filter"].isin(timed[:3])], rows])
    found = build_tabs(both, find_looks(sorted(both["filter"].unique())), parts)[EQUAL_TIME]
    ratios = {c.filter: c.verdict.ratio for c in found.cells if c.world == "azimuth"}
    plain = {c.filter: c.verdict.ratio for c in overview.cells if c.world == "azimuth"}
    assert ratios["cofm_amssrcpf"] == pytest.approx(3 * plain["cofm_amssrcpf"], rel=0.1)


def test_a_world_with_one_number_of_particles_stands_in_its_table(
    table: pd.DataFrame, parts: dict[str, PartName], tabs: dict[TabKey, Overview]
) -> None:
    """Labels have a number only where a filter has several; the column of the number decides for the others."""
    particle = ["mcmc_rpf", "qmc_polymerised", "cpso_escape", "dmc_reconstructed", "sir", "rpf"]
    swept = table[table["filter"].isin(particle)]
    alone = swept["scenario"] == "azimuth"
    kinds = [
        swept[alone].assign(particles=100),
        *(
            swept[~alone].assign(filter=swept["filter"] + f"[particles={n}]", particles=n)
            for n in (100, 1000)
        ),
    ]
    both = pd.concat([table[~table["filter"].isin(particle)].assign(particles=np.nan), *kinds])
    found = build_tabs(both, find_looks(sorted(both["filter"].unique())), parts)
    assert [len(found[n].worlds) for n in (100, 1000)] == [3, 2]
    ratios = {(c.world, c.filter): c.verdict.ratio for c in found[100].cells}
    np.testing.assert_equal(ratios, {(c.world, c.filter): c.verdict.ratio for c in tabs[100].cells})


def test_the_first_sentence_says_what_holds_at_equal_time(tabs: dict[TabKey, Overview]) -> None:
    first, timed = tabs[1000], tabs[EQUAL_TIME]

    def with_winner(page: Overview, *winner: str) -> Overview:
        cells = [c._replace(wins=(c.world, c.filter) == winner) for c in page.cells]
        return page._replace(cells=cells)

    stars = [
        [with_winner(page, "azimuth", "mcmc_rpf"), with_winner(page)] for page in (first, timed)
    ]
    said = [word_headline(a, b) for a in stars[0] for b in stars[1]]
    name = first.names["mcmc_rpf"]
    assert (
        f"with as many particles: {name} (azimuth). Also at equal time: {name} (azimuth)."
        in said[0]
    )
    assert f"with as many particles: {name} (azimuth). At equal time none is." in said[1]
    assert said[2].startswith("None of the seven is shown")
    assert f"At equal time: {name} (azimuth)." in said[2]
    assert "in any of 3 worlds, nor at equal time in 3." in said[3]
    assert choose_level(tabs) == 1000
    fewer = first._replace(cells=[c for c in first.cells if c.filter != "mcmc_rpf"])
    assert choose_level({**tabs, 1000: fewer}) == 100  # the number that most methods ran with
    assert all(len(text.split()) <= 55 for text in said)
    alike = [word_headline(first, None, page) for page in stars[0]]
    assert f"worlds. Tuned, these are: {name} (azimuth). Against" in alike[0]
    assert re.search(r"worlds\. Nor is a tuned form, in \d+ cells\. Against", alike[1])
    star = tell_story(stars[0][0]._replace(cells=[
        c._replace(wins=True, verdict=c.verdict._replace(word="better")) for c in first.cells
    ]), "mcmc_rpf", "")["wins"]  # fmt: skip
    assert star.count("☆") == len(first.worlds)
    assert "†" not in star


def test_the_page_shows_all_tables(tabs: dict[TabKey, Overview]) -> None:
    pack = {
        "study": "s", "title": "T", "generated": {"version": "0", "commit": "abc", "date": ""},
        "failures": [
            {"choices": {"scenario": world, "filter": "sir"}, "message": "ValueError: x must be 1, got 2. Set 1."}
            for world in ("azimuth", "elsewhere", "azimuth")
        ],
    }  # fmt: skip
    files = render_overview(tabs, pack)
    page = files["index.html"]
    assert "<li>SIR in azimuth; elsewhere, since x must be 1</li>" in page
    assert "Not on this page: SIR in azimuth; elsewhere, since x must be 1" in files["report.md"]
    has_star = any(cell.wins for tab in tabs.values() for cell in tab.cells)
    assert ("☆" in page) == has_star
    assert "How many particles are enough?" in page
    assert "paired runs each, 1000 particles" in page
    assert "<summary>100 particles</summary>" in page
    assert "<summary>The methods as printed, 100 particles</summary>" in page
    assert len(files["error_by_time.svg"]) < 60_000
    cells = pd.read_csv(io.StringIO(files["cells.csv"]))
    assert set(cells["table"]) == {"100", "1000", EQUAL_TIME, PRINTED, WITH_KNOBS}
    assert {"heat_map_equal_time.svg", "matrices_as_printed.svg"} <= set(files)


def test_the_page_shows_what_tuned_methods_do_at_home(overview: Overview) -> None:
    assert collect_home("unknown") == {}
    home = collect_home("seven_at_home")
    (at_home,) = home.values()
    assert at_home.methods
    assert all(label.endswith("_tuned") for label in at_home.methods)
    pack = {
        "study": "s", "title": "T", "generated": {"version": "0", "commit": "abc", "date": ""},
        "facts": {"options": {"home": "seven_at_home"}},
    }  # fmt: skip
    files = render_overview({0: overview, **home}, pack)
    assert f"At home none is, in {len(at_home.of_methods)} cells." in files["report.md"]
    cells = pd.read_csv(io.StringIO(files["cells.csv"]))
    assert len(cells[cells["table"] == AT_HOME]) == len(at_home.cells)
    for name, text in describe_home(at_home):
        assert f"{name}: {text}." in files["report.md"]
        for ratio in re.findall(r"[(](\d[.]\d\d)", text):
            verdicts = [c.verdict for c in at_home.cells if at_home.names[c.filter] == name]
            assert ratio in {f"{v.ratio:.2f}" for v in verdicts}


def test_which_studies_have_the_page(table: pd.DataFrame, looks: dict[str, MethodLook]) -> None:
    assert has_overview(table, looks)
    assert not has_overview(table[table["scenario"] == "azimuth"], looks)
    assert not has_overview(table, {k: v for k, v in looks.items() if not v.proposed})
    both = pd.DataFrame({"regime": ["outliers", "nominal"], "x": [1, 2]})
    assert list(central_rows(both)["x"]) == [2]
    assert list(central_rows(both[:1])["x"]) == [1]


def test_pictures_of_the_page_are_the_only_use_of_seaborn() -> None:
    code = "import sys, pfbench.report, pfbench.report.study_report, pfbench.cli.main; print('seaborn' in sys.modules)"
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert run.stdout.strip() == "False"


def test_pairs_of_methods_are_all_pairs(overview: Overview) -> None:
    expected = {frozenset(pair) for pair in combinations(overview.methods, 2)}
    for world in overview.worlds:
        found = [p.verdict for p in overview.pairs if p.world == world.key]
        assert {frozenset((v.a, v.b)) for v in found} == expected
