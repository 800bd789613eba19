"""A second seed confirms or contradicts verdicts, and newer jobs enter a published study only on the same data."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from checkout import ROOT
from refusals import check_refused

from pfbench.report import RUNS_FILE, format_runs, read_stored_study

sys.path.insert(0, str(ROOT / "experiments" / "analyses"))  # scripts, not a package
import merge_study
import robustness
import second_seed
import tuned_worlds

BEST = ("gate", "best")


@pytest.mark.parametrize(
    ("first", "second", "outcome"),
    [
        ((BEST, ("ekf", "worse")), (BEST, ("ekf", "not decided")), second_seed.SAME),
        ((BEST, ("ekf", "not decided")), (("ekf", "best"), ("gate", "equal")), second_seed.OPEN),
        ((BEST, ("ekf", "not decided")), (("ekf", "best"), ("gate", "worse")), second_seed.CHANGED),
        ((BEST, ("ekf", "worse")), (("ekf", "best"), ("gate", "not decided")), second_seed.CHANGED),
    ],
)
def test_the_best_filter_changes_only_by_a_verdict(first: Any, second: Any, outcome: str) -> None:
    assert second_seed.compare_rankings(first, second).outcome == outcome


def test_the_rank_correlation_is_that_of_the_orders() -> None:
    """One swap of neighbours among n filters leaves all pairs but one: 1 - 2 / (n (n - 1) / 2)."""
    names = ["a", "b", "c", "d"]
    ranking = [(name, "not decided") for name in names]
    swapped = [ranking[k] for k in (0, 2, 1, 3)]
    assert second_seed.compare_rankings(ranking, ranking).agreement == pytest.approx(1.0)
    assert second_seed.compare_rankings(ranking, ranking[::-1]).agreement == pytest.approx(-1.0)
    assert second_seed.compare_rankings(ranking, swapped).agreement == pytest.approx(1 - 2 / 6)


@pytest.mark.parametrize("study", ["robust_quad", "robust_canyon"])
def test_rankings_follow_the_order_of_the_report(study: str) -> None:
    """The best filter has rank 1 on the page, and ranks do not fall along the ranking."""
    stored = robustness.read_study(study)
    rankings = second_seed.rank_filters(stored.runs, stored.facts)
    for (world, regime), ranking in rankings.items():
        ranks = {
            row["filter"]: row["rank"] for row in stored.list_rows(world) if row["regime"] == regime
        }
        order = [ranks[label] for label, _ in ranking if label in ranks]
        assert order == sorted(order)
        assert (order[0], ranking[0][1]) == (1, "best")
        assert {word for _, word in ranking[1:]} <= {
            "equal",
            "equal in kept runs",
            "worse",
            "not decided",
            "identical",
            "better",
        }
    assert len(rankings) == len(stored.runs[["scenario", "regime"]].drop_duplicates())


def test_verdicts_that_differ_are_counted() -> None:
    runs = pd.DataFrame(
        {"scenario": "w", "regime": "outliers", "filter": ["a", "b", "c", "control"]}
    )
    sets = iter([("a", "b"), ("b", "c")])
    text = second_seed.compare_better({"study": (runs, runs)}, lambda *_: next(sets), "outliers")
    assert "| `w` | `b` | `a` | `c` |" in text
    assert (
        "Of 3 pairs of a filter and a world, 1 are better than the control with both seeds" in text
    )
    assert "2 with one of them and 0 with none." in text
    text = second_seed.compare_better({"study": (runs, runs)}, lambda *_: next(sets), "nominal")
    assert "Of 0 pairs" in text  # no world has this regime


def test_a_study_without_a_new_report_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(second_seed, "RUNS", tmp_path / "runs.parquet")
    for study, values in (("a", [1.0]), ("b", [2.0]), ("b", [3.0])):
        folder = tmp_path / f"{study}{values[0]}" / study
        folder.mkdir(parents=True)
        pd.DataFrame({"rmse": values}).to_parquet(folder / "runs.parquet")
        second_seed.store_runs(folder.parent, ("a", "b"))
    stored = pd.read_parquet(second_seed.RUNS)
    assert dict(zip(stored["study"], stored["rmse"], strict=True)) == {"a": 1.0, "b": 3.0}


def test_both_seeds_are_decided_for_the_same_filters_and_conditions() -> None:
    studies = [study for study in robustness.STUDIES if len(second_seed.read_runs(study))]
    assert len(studies) >= 3
    for study in studies:
        first = robustness.read_study(study).runs
        pair = second_seed.select_common(first, second_seed.read_runs(study))
        keys = ["scenario", "regime", "filter", "run"]
        assert len(pair[0]) == len(pair[1]) == len(pair[0].merge(pair[1], on=keys)) > 0
        assert set(pair[0]["seed"]) == {1}
        assert set(pair[1]["seed"]) == {2}
        same = pair[0].merge(pair[1], on=keys)
        assert (same["rmse_x"] != same["rmse_y"]).mean() > 0.99  # other errors


def test_tier_b_of_each_world_is_tuned_on_it() -> None:
    text = tuned_worlds.tuned_table({
        world: robustness.read_study(study).facts.looks[robustness.CONTROL].tuning
        for study in robustness.STUDIES for world in robustness.read_study(study).facts.worlds
    })  # fmt: skip
    assert "not tuned here" not in text
    foreign = tuned_worlds.tuned_table({"passive_3": tuned_worlds.read_tuning("flight_500s", "flight_500s (model ins_gnss_inflated, seed 1001, 20 runs; noise: nominal, outliers, student)")[1]["data"]})  # fmt: skip
    assert "| `passive_3` | not tuned here: flight_500s (" in foreign
    check_refused(
        [
            (
                r"must have an entry of the tuning on moon, got none",
                lambda: tuned_worlds.read_tuning("moon", "moon"),
            )
        ],
        remedy=False,
    )


# newer cells of a published study


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """A published study without one filter, and a newer report with the runs of that filter and of the control."""
    for name in ("published", "newer"):
        (tmp_path / name / "robust_canyon").mkdir(parents=True)
    pack, runs = read_stored_study(ROOT / "reports" / "robust_canyon")
    labels = set(runs["filter"])
    write_part(tmp_path / "published", pack, runs, labels - {"gate_tuned"})
    write_part(tmp_path / "newer", pack, runs, {"ekf", "gate_tuned"})
    return tmp_path / "published", tmp_path / "newer"


def write_part(reports: Path, pack: Any, runs: pd.DataFrame, labels: set[str]) -> None:
    """Write the runs of some filters as a report."""
    rows = runs[runs["filter"].isin(labels)]
    facts = {
        **pack["facts"],
        "looks": [look for look in pack["facts"]["looks"] if look["key"] in labels],
    }
    curves = {
        key: {**curve, "filters": {k: v for k, v in curve["filters"].items() if k in labels}}
        for key, curve in pack["curves"].items()
    }
    notes = [note for note in pack["filter_notes"] if note["filter"] in labels]
    names = {look["name"] for look in facts["looks"]}
    choices = []
    for entry in pack["choices"]:
        listed = [name for name in entry["filters"].split(", ") if name in names]
        if entry["filters"] == "all filters" or listed:
            filters = "all filters" if entry["filters"] == "all filters" else ", ".join(listed)
            choices.append({**entry, "filters": filters})
    numbers = {k: v for k, v in pack["methods"]["particles"].items() if k in labels}
    part = {
        **pack, "facts": facts, "curves": curves, "filter_notes": notes, "choices": choices,
        "methods": {**pack["methods"], "particles": numbers},
    }  # fmt: skip
    (reports / "robust_canyon" / RUNS_FILE).write_bytes(format_runs(rows, part))


def test_added_cells_give_the_page_of_all_jobs(folders: tuple[Path, Path]) -> None:
    """A study of which one filter was left out, and came later, has the runs, looks, notes and words of the whole."""
    published, newer = folders
    added = merge_study.merge_study("robust_canyon", newer, published)
    assert {cell.partition(" / ")[2] for cell in added} == {"gate_tuned"}
    whole, expected = read_stored_study(ROOT / "reports" / "robust_canyon")
    pack, runs = read_stored_study(published / "robust_canyon")
    keys = ["scenario", "regime", "filter", "run"]
    pairs = expected.merge(runs, on=keys, suffixes=("", "_merged"))
    assert len(pairs) == len(expected) == len(runs)
    for name in ("rmse", "ms", "keeps_track"):
        np.testing.assert_array_equal(pairs[name], pairs[f"{name}_merged"])
    assert sorted(n["filter"] for n in pack["filter_notes"]) == sorted(
        n["filter"] for n in whole["filter_notes"]
    )
    by_name = {note["filter"]: note for note in whole["filter_notes"]}
    assert all(note == by_name[note["filter"]] for note in pack["filter_notes"])
    assert pack["methods"]["tuned"] == whole["methods"]["tuned"]
    assert {c["text"]: sorted(c["filters"].split(", ")) for c in pack["choices"]} == {
        c["text"]: sorted(c["filters"].split(", ")) for c in whole["choices"]
    }
    for key, curve in whole["curves"].items():
        assert pack["curves"][key]["filters"] == curve["filters"]
    for key, view in whole["views"].items():
        rows = {row["filter"]: row for row in pack["views"][key]["rows"]}
        assert [rows[row["filter"]] for row in view["rows"]] == view["rows"]


def test_other_data_are_refused(folders: tuple[Path, Path]) -> None:
    published, newer = folders
    pack, runs = read_stored_study(newer / "robust_canyon")

    def write(table: pd.DataFrame) -> None:
        write_part(newer, pack, table, set(table["filter"]))

    is_control = runs["filter"] == "ekf"
    write(runs.assign(rmse=np.where(is_control, 1.01, 1.0) * runs["rmse"]))
    check_refused(
        [
            (
                r"errors of ekf must be those of the published study",
                lambda: merge_study.merge_study("robust_canyon", newer, published),
            )
        ],
        remedy=False,
    )
    write(runs[~is_control])
    check_refused(
        [
            (
                r"got 0 other runs and \d+ conditions without one",
                lambda: merge_study.merge_study("robust_canyon", newer, published),
            )
        ],
        remedy=False,
    )
    write(runs[runs["run"] < 40])
    check_refused(
        [
            (
                r"the same runs, got \d+ other runs",
                lambda: merge_study.merge_study("robust_canyon", newer, published),
            )
        ],
        remedy=False,
    )


def test_a_filter_with_several_numbers_of_particles_has_them_in_its_name() -> None:
    """In one condition SIR ran with 100 particles, in another with both, at equal time with 63."""

    def table(rows: list[tuple[str, str, float]]) -> pd.DataFrame:
        return pd.DataFrame(rows, columns=["scenario", "filter", "particles"])

    first = table([
        ("a", "sir", 100), ("b", "sir[budget=particles,particles=100]", 100), ("a", "swarm", 20),
        ("b", "sir[budget=time,particles=1000]", 63), ("a", "ekf", np.nan), ("b", "gpf[k=2]", 100),
    ])  # fmt: skip
    second = table([("a", "sir", 1000), ("a", "ekf", np.nan)])
    old, new = merge_study.name_by_number([first, second])
    assert old == {
        "sir": "sir[particles=100]", "sir[budget=particles,particles=100]": "sir[particles=100]", "swarm": "swarm",
        "sir[budget=time,particles=1000]": "sir[budget=time,particles=1000]", "ekf": "ekf", "gpf[k=2]": "gpf[k=2]",
    }  # fmt: skip
    assert new == {"sir": "sir[particles=1000]", "ekf": "ekf"}
    mixed = table([("a", "sir", 1000), ("b", "sir", 5000)])
    check_refused(
        [
            (
                r"sir must have one number of particles in each report",
                lambda: merge_study.name_by_number([first, mixed]),
            )
        ],
        remedy=False,
    )


def test_notes_of_one_filter_add_up_and_none_counts_twice() -> None:
    counts = {"lost": 1, "diverged": None, "collapsed": 0, "severely_overconfident": 2}
    note = {
        "filter": "sir",
        "particles": "100",
        "is_exact": True,
        "has_bounded_weights": True,
        "runs": 20,
        **counts,
    }
    other = {**note, "particles": "1000", "has_bounded_weights": None, "diverged": 3}
    (added,) = merge_study.add_notes([note, other])
    assert added["particles"] == "100 or 1000"
    assert (added["runs"], added["lost"], added["diverged"]) == (40, 2, 3)
    assert added["has_bounded_weights"] is None
    cells = pd.DataFrame({"scenario": ["a", "b"], "regime": "nominal", "filter": "sir"})
    assert merge_study.select_added_notes([note], cells, cells) == []
    assert merge_study.select_added_notes([note], cells[:0], cells) == [note]
    check_refused(
        [
            (
                r"sir must be new in all conditions .*, got 1 of 2",
                lambda: merge_study.select_added_notes([note], cells[:1], cells),
            )
        ],
        remedy=False,
    )


def test_curves_of_a_finer_page_are_read_at_the_instants_of_the_published_one() -> None:
    curve = {"median": [1.0, 2.0, None, 8.0], "q10": [0.0, 1.0, 2.0, 3.0]}
    found = merge_study.interpolate_curve(curve, [0.0, 10.0, 20.0, 30.0], [0.0, 5.0, 15.0, 30.0])
    assert found == {"median": [1.0, 1.5, None, 8.0], "q10": [0.0, 0.5, 1.5, 3.0]}


def test_worlds_of_a_tuning_are_told_in_one_order() -> None:
    a, b = "a (model m, seed 1; noise: n, o)", "b (model m, seed 2; noise: n)"
    joined = [
        merge_study.join_tunings(texts)
        for texts in ([a, b], [b, a], [f"{b}, {a}", a], [f"{a}, {b}", ""])
    ]
    assert joined == [f"{a}, {b}"] * 4


def test_choices_name_filters_as_the_page_does() -> None:
    """A page writes present names: those that it stores with its looks may be of an earlier set of filters."""
    pack, _ = read_stored_study(ROOT / "reports" / "robust_canyon")
    labels = [look["key"] for look in pack["facts"]["looks"]]
    names = dict(zip(labels, labels, strict=True))
    earlier = [{**look, "name": "earlier"} for look in pack["facts"]["looks"]]
    stale = {**pack, "facts": {**pack["facts"], "looks": earlier}}
    expected = merge_study.rename_pack(pack, names)["choices"]
    assert merge_study.rename_pack(stale, names)["choices"] == expected
    assert any(expected.values())
