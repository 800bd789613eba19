"""The report: whole, the same for the same results, and honest about what is missing."""

import base64
import json
import re
import shutil
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import synthetic_results as synthetic
from matplotlib.figure import Figure

from pfbench.report import page, table_formats
from pfbench.report.plots import error_plots
from pfbench.report.plots.axis_ticks import limit_to_late_values
from pfbench.report.plots.plotting import line_styles
from pfbench.results import store
from pfbench.results.conditions import load_conditions

QUICK = page.ReportOptions(figure_formats=("svg",), groups=("position",))


def everything(folder):
    return {
        path.relative_to(folder): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    root = tmp_path_factory.mktemp("results")
    synthetic.study(root / "demo", runs=12, steps=40)
    return root


@pytest.fixture(scope="module")
def report(results, tmp_path_factory):
    return page.write_report(
        "demo",
        results,
        tmp_path_factory.mktemp("reports"),
        page.ReportOptions(figure_formats=("svg", "png")),
    ).parent


def test_every_figure_and_table_is_there_and_on_the_page(report):
    html, text = (report / "details.html").read_text(), (report / "details.md").read_text()
    names = {path.stem for path in (report / "figures").iterdir()}
    kinds = {name.removeprefix("flight_surge_ins_gnss_") for name in names}
    assert kinds == {
        "track", "error_attitude", "error_velocity", "error_position", "rmse", "front", "nees", "cost", "ess", "calibration",
        "forest_attitude", "forest_velocity", "forest_position", "decisions_planned",
        "spread_ekf", "spread_ukf", "spread_sir", "spread_cofm_amssrcpf",
    }  # fmt: skip
    assert {path.suffix for path in (report / "figures").iterdir()} == {".svg", ".png"}
    bitmaps = [
        base64.b64decode(data) for data in re.findall(r'src="data:image/png;base64,([^"]+)"', html)
    ]
    vectors = [
        base64.b64decode(data)
        for data in re.findall(r'src="data:image/svg\+xml;base64,([^"]+)"', html)
    ]
    carried = [*bitmaps, *vectors]
    assert len(carried) == len(names)
    for path in (report / "figures").glob(
        "*.svg"
    ):  # each of the two files is whole, the page has the smaller, and the text one
        assert f"](figures/{path.name})" in text
        assert path.with_suffix(".png").read_bytes() in bitmaps or path.read_bytes() in vectors
    for path in (report / "tables").glob("*.csv"):
        table = pd.read_csv(path, keep_default_na=False)
        assert path.with_suffix(".tex").read_text().startswith(r"\begin{tabular}")
        assert f"| {table.columns[1]}" in text
    own = [
        path for path in (report / "tables").glob("*.csv") if not path.name.startswith("decisions_")
    ]
    assert len(own) == 10  # overview, and three for each of three groups


def test_the_page_needs_nothing_but_itself(report):
    html = (report / "details.html").read_text()
    assert not re.findall(r'(?:src|href)="(?!data:|#)', html)
    assert "http" not in re.sub(r'"data:[^"]+"', "", html)
    assert "prefers-color-scheme: dark" in html


@pytest.mark.parametrize("name", ["details.html", "details.md"])
def test_the_text_says_what_ran_what_failed_and_what_was_lost(report, name):
    text = (report / name).read_text()
    for said in (
        "0123abc",
        "sir lost 1 of 12 runs",
        "1 job failed",
        "00000000deadbeef",
        "covariance lost its positive eigenvalues",
        "initial heading error drawn from the filter",
        "adjusted p (Holm, 6 tests)",
        "18 comparisons",
    ):
        assert said in text, said


def test_text_tables_and_json_render_the_same_verdicts(report):
    decided = json.loads((report / "verdicts.json").read_text())
    assert len(decided) == 18
    printed = pd.read_csv(report / "tables" / "flight_surge_ins_gnss_position_pairs.csv")
    own = [v for v in decided if v["group"] == "position"]
    decisions = [f"{v['winner']} better" if v["winner"] in (v["a"], v["b"]) else None for v in own]
    assert [d if d.endswith("better") else None for d in printed["decision"]] == decisions
    np.testing.assert_allclose(printed["adjusted p (Holm, 6 tests)"], [v["p_holm"] for v in own])
    accuracy = pd.read_csv(report / "tables" / "flight_surge_ins_gnss_position.csv").set_index(
        "filter"
    )
    for label in accuracy.index:
        assert accuracy.loc[label, "better than [filters]"] == sum(
            v["winner"] == label for v in own
        )
    unbeaten = [
        label for label in accuracy.index if accuracy.loc[label, "worse than [filters]"] == 0
    ]
    lines = (report / "details.md").read_text().splitlines()
    line = next(
        row for row in lines if row.startswith("- Top group in") and "RMSE of position" in row
    )
    assert all(label in line for label in unbeaten)


def test_same_results_same_bytes_whatever_the_order_of_files(results, tmp_path, monkeypatch):
    first = page.write_report("demo", results, tmp_path / "one", QUICK).parent
    copy = tmp_path / "copy" / "demo"
    copy.mkdir(parents=True)
    for path in sorted((results / "demo").iterdir(), reverse=True):
        shutil.copy(path, copy)
    real = Path.glob
    monkeypatch.setattr(Path, "glob", lambda self, pattern: reversed(sorted(real(self, pattern))))
    second = page.write_report("demo", copy.parent, tmp_path / "two", QUICK).parent
    assert everything(first) == everything(second)


def test_a_new_report_removes_the_figures_of_the_old_one_alone(results, tmp_path, caplog):
    folder = tmp_path / "demo"
    both = replace(QUICK, groups=("position", "velocity"))
    page.write_report("demo", results, tmp_path, both)
    old = {path.name for path in (folder / "figures").iterdir()}
    mine = [folder / "figures" / "photo.png", folder / "tables" / "mine.csv", folder / "notes.txt"]
    for path in mine:
        path.write_text("mine")
    page.write_report("demo", results, tmp_path, QUICK)
    new = {path.name for path in (folder / "figures").iterdir()}
    assert {name for name in old - new if "velocity" in name}
    assert not {name for name in new if "velocity" in name}
    assert all(path.read_text() == "mine" for path in mine)
    assert "figures/photo.png, notes.txt, tables/mine.csv" in caplog.text
    assert {path.name for path in folder.rglob("*.kept")} == set()


def test_mixed_versions_are_refused_and_named_when_allowed(tmp_path):
    folder = tmp_path / "demo"
    synthetic.write(folder, synthetic.METHODS[0], runs=6, steps=20)
    synthetic.write(
        folder,
        synthetic.METHODS[1],
        runs=6,
        steps=20,
        versions={**synthetic.VERSIONS, "commit": "fff9999"},
    )
    with pytest.raises(ValueError, match=r"versions\.commit"):
        page.write_report("demo", tmp_path, tmp_path / "reports", QUICK)
    assert not (tmp_path / "reports").exists()
    mixed = page.ReportOptions(
        figure_formats=("svg",), groups=("position",), allow_mixed_versions=True
    )
    path = page.write_report("demo", tmp_path, tmp_path / "reports", mixed)
    assert "0123abc, fff9999" in path.read_text()


def test_a_toy_without_map_particles_or_rival(tmp_path):
    method = synthetic.Method("kalman", 1.0)
    path = synthetic.write(tmp_path / "demo", method, runs=5, steps=20)
    meta, arrays = store.read_result(path)
    state = {"names": ["x"], "units": [""], "groups": {"state": [0]}}
    toy = {name: arrays[name] for name in ("time", "log_evidence", "lost")}
    toy |= {name: arrays[name][..., :1] for name in ("error", "sd", "nees")}
    store.write_result(path, {**meta, "state": state}, toy)
    made = page.write_report(
        "demo", tmp_path, tmp_path / "reports", page.ReportOptions(figure_formats=("svg",))
    )
    kinds = {
        p.stem.removeprefix("flight_surge_ins_gnss_") for p in (made.parent / "figures").iterdir()
    }
    assert kinds == {"error_state", "rmse", "front", "nees", "spread_kalman"}
    assert (
        "has one filter. Required: 2; available: 1." in made.with_name("details.html").read_text()
    )
    assert json.loads((made.parent / "verdicts.json").read_text()) == []


def test_a_filter_that_lost_every_run_is_reported(tmp_path):
    folder = tmp_path / "demo"
    synthetic.write(folder, synthetic.METHODS[0], runs=8, steps=20)
    synthetic.write(folder, synthetic.Method("doomed", 1.0, lost=tuple(range(8))), runs=8, steps=20)
    made = page.write_report("demo", tmp_path, tmp_path / "reports", QUICK)
    (verdict,) = json.loads((made.parent / "verdicts.json").read_text())
    assert (verdict["winner"], verdict["lost_a"], verdict["ratio"]) == ("ekf", 8, "inf")
    assert "doomed lost 8 of 8 runs" in made.with_name("details.html").read_text()
    assert "loses the track in 100 % of runs" in (made.parent / "report.md").read_text()
    table = (made.parent / "details.md").read_text()
    assert re.search(r"\| doomed +\| +0 \| +– \|", table)


def test_the_page_says_what_its_jobs_took_and_how_many_were_asked_for(results, tmp_path):
    page.write_report("demo", results, tmp_path, replace(QUICK, planned=6))
    text = (tmp_path / "demo" / "details.md").read_text()
    seconds = sum(
        1.0 + 1e-3 * method.milliseconds * 40 for method in synthetic.METHODS
    )  # a world each, and 40 steps
    assert "jobs: 4 of 6 in the experiment" in text
    assert (
        f"time of all jobs: {seconds:.0f} s (filters {100 * (1 - 4 / seconds):.0f} %, data" in text
    )


def test_the_time_to_converge_is_a_column_of_groups_that_have_a_bound(results, tmp_path):
    page.write_report(
        "demo",
        results,
        tmp_path,
        replace(QUICK, convergence_threshold={"position": 1e9}, start_time_s=20.0),
    )
    text = (tmp_path / "demo" / "details.md").read_text()
    assert "median time to 1e+09 m [s]" in text
    with pytest.raises(
        ValueError,
        match=r"report\.convergence_threshold must name groups of the results, got height",
    ):
        page.write_report(
            "demo", results, tmp_path, replace(QUICK, convergence_threshold={"height": 1.0})
        )


def test_cells_whose_worlds_differ_by_name_say_so(tmp_path):
    for k, sd in enumerate((1.0, 10.0)):
        path = synthetic.write(
            tmp_path / "demo", synthetic.Method("ekf", 1.0, 1.0, 100 + k), runs=6, steps=20
        )
        meta, arrays = store.read_result(path)
        store.write_result(
            path,
            {**meta, "config": {"filter": {"name": "ekf"}, "scenario": {"gps_sd": sd}}},
            arrays,
        )
    page.write_report("demo", tmp_path, tmp_path / "reports", QUICK)
    text = (tmp_path / "reports" / "demo" / "details.md").read_text()
    assert (
        "Jobs of this condition differ in scenario.gps_sd: their runs share random numbers, but not the data."
        in text
    )


def test_options_are_checked():
    with pytest.raises(ValueError, match="alpha must be between 0 and 1, got 5"):
        page.ReportOptions(alpha=5)
    with pytest.raises(ValueError, match=r"formats must be a subset of svg, png, got .'gif'"):
        page.ReportOptions(figure_formats=("gif",))


def test_unknown_group_is_refused(results, tmp_path):
    message = (
        r"report\.groups must be groups .* got height\. Choose from attitude, velocity, position"
    )
    with pytest.raises(ValueError, match=message):
        page.write_report("demo", results, tmp_path, page.ReportOptions(groups=("height",)))


def test_text_of_a_stranger_is_not_markup(tmp_path):
    for size, name in enumerate(("<b>sir</b>|x", "<b>sir</b>|y", "<b>sir</b>|z"), 1):
        synthetic.write(tmp_path / "demo", synthetic.Method(name, float(size)), runs=20, steps=20)
    made = page.write_report("demo", tmp_path, tmp_path / "reports", QUICK)
    assert all("<b>sir" not in path.read_text() for path in made.parent.glob("*.html"))
    assert r"&lt;b>sir&lt;/b>\|x" in (made.parent / "details.md").read_text()


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"), (-0.0, "0"), (1.0, "1.00"), (9.996, "10.0"), (123.456, "123"), (99_949.0, "99949"), (0.00123, "0.00123"),
        (1.2e-7, "1.20e-07"), (3e8, "3.00e+08"), (-2.5, "-2.50"), (float("nan"), "–"), (float("inf"), "∞"),
        (7, "7"), (True, "yes"), ("a", "a"), (None, "–"), (np.float64(0.5), "0.500"), (np.int64(40), "40"),
    ],
)  # fmt: skip
def test_numbers_have_three_digits(value, text):
    assert table_formats.format_number(value) == text


def test_markdown_columns_line_up():
    text = table_formats.format_markdown(pd.DataFrame({"a|b": ["x", "yy"], "n": [1.0, 20.0]}))
    assert text.splitlines() == [
        "| a\\|b |    n |",
        "|------|-----:|",
        "| x    | 1.00 |",
        "| yy   | 20.0 |",
    ]


def test_estimated_track_is_truth_plus_error(results):
    (cell,) = load_conditions("demo", results)
    loaded = {job.label: job.load() for job in cell.jobs}
    style = line_styles(list(loaded))
    plan, height = error_plots.plot_track(loaded, 2, style).axes
    line = next(line for line in plan.lines if line.get_label() == "ekf")
    arrays = loaded["ekf"].data
    np.testing.assert_allclose(
        line.get_xdata(), arrays["track"][2, :, 0] + arrays["error"][2, :, 6], rtol=1e-5
    )
    np.testing.assert_allclose(
        line.get_ydata(), arrays["track"][2, :, 1] + arrays["error"][2, :, 7], rtol=1e-5
    )
    up = arrays["track"][2, :, 2] + arrays["error"][2, :, 8]
    assert any(np.allclose(line.get_ydata(), up, rtol=1e-5) for line in height.lines)


def test_a_late_divergence_is_never_cut_off():
    axis = Figure().subplots()
    curve = np.ones(100)
    curve[0], curve[-1] = 1000.0, 500.0
    axis.plot(curve)
    limit_to_late_values(axis, [curve])
    assert axis.get_ylim()[1] >= 500
    curve[-1] = 1.0
    limit_to_late_values(axis, [curve])
    assert axis.get_ylim()[1] < 10


def test_templates_are_packaged():
    here = Path(page.__file__).parent
    patterns = tomllib.loads((here.parents[1] / "pyproject.toml").read_text())["tool"][
        "setuptools"
    ]["package-data"]
    shipped = {path.name for pattern in patterns["pfbench.report"] for path in here.glob(pattern)}
    assert {"page.html.jinja", "page.md.jinja", "text.jinja", "style.css"} <= shipped
