"""Figures of the papers: the catalogue names filters that its studies run, and the drawings match the results."""

import io
import re
import shutil
from collections.abc import Iterator
from itertools import combinations, product
from pathlib import Path

import numpy as np
import pytest
import synthetic_results as synthetic
import yaml
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image
from synthetic_results import list_results

from pfbench.cli.compose import expand_sweep, read_sweep
from pfbench.job.config import compose
from pfbench.job.plan import build_plan, describe_state
from pfbench.report import study_report
from pfbench.report.papers import figures, plots, specs
from pfbench.report.papers.figures import FIGURES, list_page_figures, list_paper_pages
from pfbench.report.papers.plots import CurveLook
from pfbench.results import store
from pfbench.results.conditions import component_groups, load_conditions
from pfbench.results.paper_block import experiments_dir
from pfbench.results.plotting import (
    RC,
    draw_figure,
    line_styles,
    render_palette_png,
    slim_svg,
)
from pfbench.results.step_times import StepTimes

LOST = synthetic.Method("sir", 1.3, 0.8, 200, 4.0, (7,))
SWARM = synthetic.Method("cpso_escape", 1.0, 1.0, 200, 9.0)
PRINTED = synthetic.Method("cpso_escape_printed", 2.0, 1.0, 200, 9.0)
SCALE = 1e-3 * np.arange(1, 31)  # of the horizontal range, [T]


def rewrite(path: Path, **more: np.ndarray) -> None:
    meta, arrays = store.read_result(path)
    store.write_result(path, meta, {**arrays, **more})


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("results")
    others = [
        synthetic.Method(name, size, particles=200)
        for name, size in (("cpf", 1.0), ("cofm_amssrcpf_printed", 1.4), ("cofm_amssrcpf", 0.7))
    ]
    for method in (LOST, SWARM, PRINTED, *others):
        for noise in ("nominal", "paper_bursts"):
            path = synthetic.write(root / "paper_004", method, noise=noise, runs=20, steps=30)
            number = 100.0 + np.arange(20)[:, None] + np.arange(30)
            rewrite(path, iterations=number / 10, particles=number, range=1e6 * SCALE)
    return root


def drawn(results: Path, *wanted: str, study: str = "paper_004") -> dict[str, tuple[str, Figure]]:
    found = load_conditions(study, results)
    made = figures.paper_figures(study, found, wanted or None, start_time_s=10.0)
    return {drawing.name: (drawing.caption, drawing.make()) for _, drawing in made}


def loaded(results: Path, label: str, noise: str = "nominal") -> store.JobResult:
    every = list_results(results / "paper_004")
    return next(r for r in every if (r.meta["label"], r.meta["choices"]["noise"]) == (label, noise))


def line(axis: Axes, name: str) -> tuple[np.ndarray, np.ndarray]:
    one = next(line for line in axis.lines if line.get_label() == name and len(line.get_xdata()))
    return np.asarray(one.get_xdata()), np.asarray(one.get_ydata())


def crosses(axis: Axes) -> list[tuple[float, float]]:
    marks = [one for one in axis.lines if one.get_label() == "_printed"]
    return [(float(one.get_xdata()[0]), float(one.get_ydata()[0])) for one in marks]


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def errors(results: Path, label: str, place: int) -> np.ndarray:
    kept = loaded(results, label).data
    return np.abs(kept["error"][~kept["lost"]][..., place].astype(float))


# what the catalogue names


def jobs_of(study: str) -> Iterator[tuple[str, str]]:
    """Noise regime and label of each job of the experiment of a study."""
    text = yaml.safe_load((experiments_dir() / f"{study}.yaml").read_text())
    fixed = {
        key.removeprefix("override /"): value
        for default in text["defaults"]
        for key, value in default.items()
    }
    for words in product(*expand_sweep(read_sweep(study))):
        chosen = dict(word.split("=", 1) for word in words)
        settings = ",".join(
            f"{key.removeprefix('filter.')}={float(value)}"
            for key, value in chosen.items()
            if key not in ("filter", "scenario", "noise") and re.fullmatch(r"[\d.e]+", value)
        )
        label = chosen.get("filter", fixed.get("filter", ""))
        noise = chosen.get("noise", fixed["noise"])
        yield noise, f"{label}[{settings}]" if settings else label


OF_PAPERS = [name for name in FIGURES if re.match(r"\d{3}-", name)]  # others are of any study


@pytest.mark.parametrize("name", OF_PAPERS)
def test_a_study_runs_each_filter_that_a_figure_names(name: str) -> None:
    """SIR was missing in three figures, whose study runs `sir_printed`."""
    figure = FIGURES[name]
    main, *others = figure.studies
    assert main.startswith(f"paper_{name[:3]}")
    ran = {label for noise, label in jobs_of(main) if figure.noise in ("", noise)}
    assert set(figure.filters) <= ran
    for study in others:
        assert set(figure.filters) & {label for _, label in jobs_of(study)}, study


@pytest.mark.parametrize("name", [name for name in OF_PAPERS if FIGURES[name].groups])
def test_the_state_has_the_groups_that_a_figure_names(name: str) -> None:
    figure = FIGURES[name]
    words = [f"noise={figure.noise}"] if figure.noise else []
    method = figure.filters[0].partition("[")[0]
    config = compose([f"+experiment={figure.studies[0]}", f"filter={method}", "runs=1", *words])
    plan = build_plan(config)
    blocks = component_groups(describe_state(plan.model))
    components = {
        name for block in blocks if block.group in figure.groups for name in block.components
    }
    assert set(figure.groups) <= {block.group for block in blocks}
    assert {p.component for p in figure.printed if p.component} <= components


def test_a_panel_has_four_curves_at_most_and_each_printed_number_has_a_filter_and_a_source() -> (
    None
):
    assert {name[:3] for name in OF_PAPERS} == {"000", "001", "002", "003", "004"}
    for name, figure in FIGURES.items():
        assert all(1 <= len(column) <= 4 for column in figure.columns), name
        assert len(figure.titles) in (1, len(figure.columns)), name
        assert {p.filter for p in figure.printed} <= {*figure.filters, ""}, name
        assert bool(figure.printed) == bool(re.search(r"Cross(es)?: ", figure.source)), name
        is_placed = any(char.isdigit() for char in figure.title) or "section" in figure.title
        assert is_placed or name not in OF_PAPERS, name


def test_numbers_in_the_captions_are_those_of_the_crosses() -> None:
    """Where a caption quotes numbers with the place in the text, each cross has one of them."""
    quoting = ("002-10", "004-4", "004-5", "000-1", "003-3", "002-neff")
    for name in quoting:
        quoted = {float(text) for text in re.findall(r"\d+(?:\.\d+)?", FIGURES[name].source)}
        assert {p.value for p in FIGURES[name].printed} <= quoted, name


def test_the_page_of_a_paper_shows_each_of_its_figures_or_links_to_it() -> None:
    for paper in ("000", "001", "002", "003", "004"):
        own = [name for name, figure in FIGURES.items() if f"paper_{paper}" in figure.studies]
        entries = [{"entry": name, "caption": f"{name} et al. 3. End."} for name in reversed(own)]
        shown = list_page_figures(f"paper_{paper}", entries)
        whole = [figure.title for name, figure in FIGURES.items() if name.startswith(paper)]
        assert [
            FIGURES[item["entry"]].title if "entry" in item else item["title"] for item in shown
        ] == whole
        assert {item["alt"] for item in shown if "alt" in item} == {f"{n} et al. 3" for n in own}
        for item in shown:
            assert ("study" in item) != ("alt" in item)
            assert (experiments_dir() / f"{item.get('study', f'paper_{paper}')}.yaml").exists()
    assert list_page_figures("paper_002", ()) == []  # no page of links alone
    methods = (
        "mcmc_rpf[particles=100]",
        "cpso_escape",
        "dmc_reconstructed",
        "cofm_amssrcpf",
        "qmc_polymerised",
    )
    pages = list_paper_pages(methods)
    assert [page["study"] for page in pages] == [f"paper_00{k}" for k in range(5)]
    assert "figure 3" in pages[1]["figures"]
    assert [page["study"] for page in list_paper_pages(methods[1:2])] == ["paper_004"]


# what is drawn


def test_a_study_shows_the_figures_that_name_it(results: Path) -> None:
    found = load_conditions("paper_004", results)
    made = figures.paper_figures("paper_004", found)
    assert [name for name, _ in made] == ["004-4", "004-5", "004-iterations"]
    assert figures.paper_figures("paper_004_mine", found) == []
    for name, drawing in made:
        figure = drawing.make()
        assert drawing.name.startswith(name.replace("-", "_"))
        assert re.fullmatch(r"\w+", drawing.name)  # as the list of published files
        assert drawing.caption.startswith("Tian et al., ")
        assert figure.get_figwidth() <= 3.5  # a column
        texts = figure.findobj(lambda part: hasattr(part, "get_fontsize"))
        assert all(text.get_fontsize() >= 5.5 for text in texts)


def test_curves_are_medians_and_the_band_is_that_of_the_last_filter(results: Path) -> None:
    caption, figure = drawn(results)["004_4_flight_nominal_ins_gnss_position"]
    assert "band: 80 % of runs of CPSO-Escape." in caption
    assert "Medians of 20 runs" in caption
    assert "Without lost runs: SIR 1." in caption
    assert "No results of CPSO-PF." in caption  # a figure leaves nothing out silently
    names = {
        "sir": "SIR",
        "cpso_escape_printed": "CPSO-Escape (printed)",
        "cpso_escape": "CPSO-Escape",
    }
    assert legend(figure) == [*names.values(), plots.BAND, "printed"]
    for place, axis in zip((6, 7, 8), figure.axes[::2], strict=True):
        for label, name in names.items():
            time, middle = line(axis, name)
            np.testing.assert_array_equal(time, loaded(results, label).data["time"])
            np.testing.assert_allclose(
                middle, np.median(errors(results, label, place), 0), rtol=1e-6
            )
        (band,) = [part for part in axis.collections if part.get_paths()]  # not that of the legend
        edges = np.quantile(errors(results, "cpso_escape", place), (0.1, 0.9), axis=0)
        heights = band.get_paths()[0].vertices[:, 1]
        assert np.isin(np.round(edges, 9), np.round(heights, 9)).all()
        curves = [one for one in axis.lines if not str(one.get_label()).startswith("_")]
        assert len([one for one in curves if len(one.get_xdata())]) <= 4


def test_the_printed_form_is_dotted_and_has_the_colour_of_its_method(results: Path) -> None:
    _, figure = drawn(results, "002-12")["002_12_flight_paper_bursts_ins_gnss_position"]
    lines = {one.get_label(): one for one in figure.axes[0].lines if len(one.get_xdata()) > 1}
    printed, repaired = lines["COFM-AMSSRCPF (printed)"], lines["COFM-AMSSRCPF"]
    assert (
        printed.get_color()
        == repaired.get_color()
        == line_styles(["cofm_amssrcpf"])["cofm_amssrcpf"].colour
    )
    assert printed.get_linestyle() != repaired.get_linestyle() == "-"


def test_crosses_are_at_the_printed_numbers_beside_the_same_measure(results: Path) -> None:
    caption, figure = drawn(results)["004_4_flight_nominal_ins_gnss_position"]
    assert "and its RMSE and maximum after 10 s" in caption
    assert "section 6" in caption
    late = loaded(results, "cpso_escape_printed").data["time"] >= 10
    components = {"North": (7, 6.87), "East": (6, 7.2), "Up": (8, 4.83)}
    for axis, strip in zip(figure.axes[::2], figure.axes[1::2], strict=True):
        place, value = components[axis.get_title().split()[1]]
        (x, rmse), (_, largest) = crosses(strip)
        assert (rmse, largest) == (value, 34.0)
        own = np.sqrt((errors(results, "cpso_escape_printed", place)[:, late] ** 2).mean(1))
        _, middle = next(
            (one.get_xdata()[0], one.get_ydata()[0])
            for one in strip.lines
            if one.get_xdata()[0] == x and one.get_marker() not in ("x", "None")
        )
        assert middle == pytest.approx(np.median(own), rel=1e-6)
        low, high = strip.get_ylim()
        assert low <= rmse < largest <= high
        assert axis.get_ylim() == strip.get_ylim()


def test_crosses_at_a_time_are_drawn_there_in_the_colour_of_their_filter(results: Path) -> None:
    _, figure = drawn(results, "002-12")["002_12_flight_paper_bursts_ins_gnss_position"]
    expected = {
        "North": [(500, 8.6), (900, 8.9)], "East": [(500, 7.4), (900, 6.6)], "Up": [(500, 16.4), (900, 10.4)],
    }  # fmt: skip
    for axis in figure.axes:
        assert crosses(axis) == expected[axis.get_title().split()[1]]
        colours = {one.get_color() for one in axis.lines if one.get_label() == "_printed"}
        assert colours == {line_styles(["cpf"])["cpf"].colour}
    assert "printed" in legend(figure)


def test_largest_errors_stand_beside_the_printed_ones(results: Path) -> None:
    caption, figure = drawn(results, "002-maxima")[
        "002_maxima_flight_paper_bursts_ins_gnss_position"
    ]
    assert "RMSE and maximum of the position error after 10 s" in caption
    assert "Crosses: maximum errors as printed" in caption
    found = {axis.get_title(): [value for _, value in crosses(axis)] for axis in figure.axes}
    assert found == {"East": [7.4, 3.5, 4.4], "North": [8.9, 3.5, 4.02], "Up": [16.4, 5.2]}
    late = loaded(results, "cpf", "paper_bursts").data
    peak = np.abs(late["error"][:, late["time"] >= 10, 7]).max(1)
    north = next(axis for axis in figure.axes if axis.get_title() == "North")
    assert any(
        np.allclose(one.get_ydata(), [np.median(peak)])
        for one in north.lines
        if len(one.get_ydata()) == 1
    )
    assert [text.get_text() for text in north.get_xticklabels()] == ["RMSE", "max"]


@pytest.mark.parametrize("wild", [1e3, 1e7, 1e30])
def test_a_filter_that_diverges_hides_no_other_and_is_named_where_it_leaves_the_axis(
    results: Path, wild: float
) -> None:
    labels = ("cpf", "cpso_escape", "cofm_amssrcpf")
    jobs = {label: loaded(results, label) for label in labels}
    bad = jobs["cofm_amssrcpf"]
    jobs["cofm_amssrcpf"] = store.JobResult(
        bad.meta, {**bad.data, "error": wild * bad.data["error"].astype(float)}
    )
    block = next(b for b in component_groups(bad.meta["state"]) if b.group == "attitude")
    style = line_styles(list(labels))
    looks = {label: CurveLook(label, style[label]) for label in labels}
    figure = plots.plot_errors({"": {label: (jobs[label], block) for label in labels}}, looks)
    figure.draw_without_rendering()
    for axis in figure.axes:
        assert axis.get_yscale() == "log"
        low, high = axis.get_ylim()
        for label in labels[:2]:
            _, middle = line(axis, label)
            assert low < np.median(middle) < high
            heights = axis.transAxes.inverted().transform(
                axis.transData.transform(np.column_stack([np.zeros(30), middle]))
            )[:, 1]
            assert np.ptp(heights) > 0.1  # its change over time is seen
        _, beyond = line(axis, "cofm_amssrcpf")
        notes = [text.get_text() for text in axis.texts]
        assert notes == (["beyond the axis: cofm_amssrcpf"] if beyond.max() > high else [])
        ticks = [text.get_text() for text in axis.get_yticklabels() if text.get_text()]
        assert 1 <= len(ticks) <= 9
        assert high < 2e4 * np.median(middle)


def test_one_run_that_diverges_changes_no_axis(results: Path) -> None:
    own = {label: loaded(results, label) for label in ("cpf", "cpso_escape")}
    block = next(b for b in component_groups(own["cpf"].meta["state"]) if b.group == "position")
    looks = {label: CurveLook(label, line_styles([label])[label]) for label in own}

    def limits() -> list[tuple[float, float]]:
        figure = plots.plot_errors({"": {n: (result, block) for n, result in own.items()}}, looks)
        return [axis.get_ylim() for axis in figure.axes]

    before = limits()
    own["cpf"].data["error"][3] *= 1e12
    for (low, high), (least, most) in zip(before, limits(), strict=True):
        assert least == pytest.approx(low, rel=0.2)
        assert most == pytest.approx(high, rel=0.2)


def test_a_bias_stands_beside_itself_before_correction(results: Path) -> None:
    result = loaded(results, "cpso_escape")
    block = next(b for b in component_groups(result.meta["state"]) if b.group == "attitude")
    looks = {"cpso_escape": CurveLook("CPSO", line_styles(["cpso_escape"])["cpso_escape"])}
    figure = plots.plot_errors({"": {"cpso_escape": (result, block)}}, looks, before=True)
    first = np.quantile(
        block.scale * np.abs(result.data["error"][:, 0, 0].astype(float)), (0.1, 0.9)
    )
    lines = next(part for part in figure.axes[0].collections if hasattr(part, "get_segments"))
    np.testing.assert_allclose([part[0][1] for part in lines.get_segments()], first, rtol=1e-6)
    assert FIGURES["004-3"].draw.keywords == {"before": True}


def test_traces_are_drawn_with_what_is_printed_of_them(results: Path) -> None:
    found = drawn(results, "004-iterations", "002-number", "002-neff")
    _, figure = found["004_iterations_flight_nominal_ins_gnss_iterations"]
    _, middle = line(figure.axes[0], "CPSO-Escape (printed)")
    np.testing.assert_allclose(middle, (109.5 + np.arange(30)) / 10)
    caption, figure = found["002_neff_flight_paper_bursts_ins_gnss_ess"]
    assert "maintained between 110 and 180" in caption
    assert {value for _, value in crosses(figure.axes[0])} == {110.0, 180.0}
    assert "printed" not in legend(found["002_number_flight_paper_bursts_ins_gnss_particles"][1])


def passive(folder: Path) -> Path:
    """Results of the filters of paper 001 in two worlds, GPF and QMC-GPF with known errors."""
    for k, label in enumerate(FIGURES["001-2"].filters):
        for noise in ("nominal", "surge"):
            method = synthetic.Method(label, 1.0 + k, particles=400, milliseconds=1.0 + k)
            path = synthetic.write(folder / "paper_001", method, noise=noise, runs=10, steps=30)
            rewrite(path, range=1e6 * SCALE)
    return folder


def test_err_is_the_horizontal_error_over_the_range_in_two_panels_of_a_row(tmp_path: Path) -> None:
    made = drawn(passive(tmp_path), "001-2", study="paper_001")
    caption, figure = made["001_2"]
    assert "band" not in caption
    named = [axis.get_title() for axis in figure.axes]
    assert named == ["compared in section 4", "proposed"]
    assert figure.axes[0].get_ylim() == figure.axes[1].get_ylim()
    assert sorted(legend(figure)) == sorted(
        {"SIR (each step)", "GPF", "QMC-GPF", "QMC-PRPF", "QMC-PRPF (printed)"}
    )
    results = list_results(tmp_path / "paper_001")
    own = [r for r in results if r.meta["label"] == "gpf"]
    shares = [
        100
        * (
            np.linalg.norm(r.data["error"][..., [6, 7]].astype(float), axis=-1) / (1e6 * SCALE)
        ).mean(1)
        for r in own
    ]
    middles = {
        float(one.get_ydata()[0]) for one in figure.axes[0].lines if len(one.get_xdata()) == 1
    }
    for each in shares:
        assert any(value == pytest.approx(np.median(each), rel=1e-5) for value in middles)
    _, over_time = made["001_2_over_time"]
    assert [axis.get_ylabel() for axis in over_time.axes[::2]] == [
        "experiment 1\nErr [%]",
        "experiment 2\nErr [%]",
    ]
    assert legend(over_time)[-1] == plots.BAND


def test_times_per_step_are_the_rounds_in_turn_where_they_were_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def middles() -> list[float]:
        caption, figure = drawn(passive(tmp_path), "001-3", study="paper_001")["001_3"]
        assert "rounds" in caption
        ends = (one.get_ydata() for one in figure.axes[0].lines if len(one.get_xdata()) == 1)
        return sorted({round(float(y[0]), 6) for y in ends})

    assert middles() == [1.0, 2.0, 3.0]  # ms, one timing of each job
    times = StepTimes(np.array([0.004, 0.006, 0.009]), "group")
    monkeypatch.setattr(specs.StepTimes, "from_metadata", lambda meta: times)
    assert middles() == [6.0]


def test_the_escape_factor_is_that_of_the_settings_that_ran(results: Path, tmp_path: Path) -> None:
    for label, most in (("cpso_escape", 5), ("cpso_escape_printed", 30)):
        method = synthetic.Method(label, 1.0, particles=100)
        settings = {"proposal": {"velocity": {"escape_coefficient": 0.12}, "iterations": most}}
        synthetic.write(
            tmp_path / "paper_004", method, noise="nominal", runs=6, steps=8, config=settings
        )
    ((_, figure),) = drawn(tmp_path, "004-1").values()
    lines = {one.get_label(): np.asarray(one.get_ydata()) for one in figure.axes[0].lines}
    assert len(lines) == 4
    repaired = lines.pop("as repaired")
    assert (repaired[0], repaired[75], repaired[150]) == pytest.approx((0.0, 0.12, 0.24))
    for name, y in lines.items():  # as printed: 0.12 - 0.12 cos(k pi) / itermax
        most = int(re.findall(r"(\d+) iterations", name)[0])
        assert len(y) == most + 1
        np.testing.assert_allclose(np.abs(y - 0.12), 0.12 / most, rtol=1e-9)
        assert y[0] < 0.12 < y[1]
    with pytest.raises(ValueError, match="004-1"):
        drawn(results, "004-1")  # jobs that do not tell


def test_values_of_a_parameter_have_a_line_each(tmp_path: Path) -> None:
    """Two values of one method: other colours, the median of each, and what is missing in the caption."""
    name = "cofm_mssrckf[gain_adaptations.1.max_ratio={}]".format
    for value, size in (("1.0", 1.0), ("1000000000.0", 3.0)):
        method = synthetic.Method(name(value), size)
        synthetic.write(tmp_path / "paper_002_bound", method, runs=20, steps=30)
    ((caption, figure),) = drawn(tmp_path, "002-3-bound", study="paper_002_bound").values()
    results = {r.meta["label"]: r for r in list_results(tmp_path / "paper_002_bound")}
    for key, text in (("1.0", "ratio bound 1"), ("1000000000.0", "ratio bound 10⁹")):
        error = np.abs(results[name(key)].data["error"][..., 6].astype(float))
        np.testing.assert_allclose(line(figure.axes[0], text)[1], np.median(error, 0), rtol=1e-6)
    colours = {one.get_color() for one in figure.axes[0].lines}
    assert len(colours) == 2
    assert "these values are ours" in caption
    assert "No study varies the forgetting factor" in caption


def test_the_flight_is_the_true_track_and_its_velocity(results: Path) -> None:
    caption, flight = drawn(results, "000-1")["000_1_flight"]
    velocity = specs.plot_flight_velocity(loaded(results, "sir"))
    arrays = loaded(results, "sir").data
    plan, height = flight.axes
    track = arrays["track"][0].astype(float)
    np.testing.assert_allclose(plan.lines[0].get_xdata(), track[:, 0] / 1e3)
    np.testing.assert_allclose(plan.lines[0].get_ydata(), track[:, 1] / 1e3)
    np.testing.assert_allclose(height.lines[0].get_ydata(), track[:, 2])
    assert "true track of the first run" in caption
    steps = (track[2:] - track[:-2]) / 2  # a second each
    for axis, values in zip(velocity.axes, steps.T, strict=True):
        np.testing.assert_allclose(axis.lines[0].get_ydata()[1:-1], values, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("wanted", "message"),
    [("999-1", "got 999-1. Choose from 000-1"), ("003-5", "got 003-5 .* requires results of ukf")],
)
def test_a_figure_that_cannot_be_drawn_is_told(results: Path, wanted: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        drawn(results, wanted)


# where figures are shown


def test_the_page_shows_the_stored_figures_near_its_top_and_keeps_them_when_it_is_made_again(
    results: Path, tmp_path: Path
) -> None:
    made = study_report.write_report("paper_004", results, tmp_path)
    folder, page, text = made.parent, made.read_text(), (made.parent / "report.md").read_text()
    stored = sorted(path.name for path in (folder / "figures").glob("*.svg"))
    assert len(stored) == 3
    assert page.index('id="board"') < page.index('id="figures"') < page.index('id="worlds"')
    assert page.count('src="data:image/svg+xml') == 3
    assert '<a href="../paper_004_alone/index.html#figures">paper_004_alone</a>' in page
    assert "[paper_004_alone](../paper_004_alone/report.md)" in text
    assert sorted(re.findall(r"\]\(figures/(\w+\.svg)\)", text)) == stored
    assert len(page.encode()) < 1_500_000
    for path in folder.iterdir():  # as git stores a published study
        if path.name not in ("runs.parquet", "figures", "headline.svg"):
            path.unlink()
    for path in (folder / "figures").glob("*.png"):
        path.unlink()
    study_report.rebuild_page(folder)
    assert (folder / "report.md").read_text() == text
    again = made.read_text()
    assert [m for m in re.findall(r'<img alt="[^"]+" title="[^"]+"', again)] == re.findall(
        r'<img alt="[^"]+" title="[^"]+"', page
    )
    shutil.rmtree(folder / "figures")  # a clone without them: no figure, no link
    study_report.rebuild_page(folder)
    assert "Figures of the paper" not in (folder / "report.md").read_text()


def test_a_drawing_of_four_curves_and_measures_is_below_60_kb(tmp_path: Path) -> None:
    for k, label in enumerate(FIGURES["004-4"].filters):
        method = synthetic.Method(label, 1.0 + k, particles=100)
        synthetic.write(tmp_path / "paper_004", method, noise="nominal", runs=12, steps=500)
    found = load_conditions("paper_004", tmp_path)
    for _, drawing in figures.paper_figures("paper_004", found):
        assert len(draw_figure(drawing, ("svg",))["svg"]) < 60_000, drawing.name


def test_a_slim_drawing_has_the_same_lines_and_styles() -> None:
    import matplotlib

    generator = np.random.default_rng(5)
    with matplotlib.rc_context(RC):
        figure = Figure(figsize=(3, 2))
        axis = figure.subplots()
        axis.plot(generator.normal(size=400), "o--", mfc="white")
        axis.fill_between(np.arange(400), -1, generator.normal(size=400), alpha=0.2)
        axis.set_title("a\n b")
        buffer = io.BytesIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    whole, slim = buffer.getvalue().decode(), slim_svg(buffer.getvalue()).decode()
    assert len(slim) < 0.75 * len(whole)
    rules = dict(re.findall(r"\.(s\d+)\{([^}]*)\}", slim))
    styles = [rules[name] for name in re.findall(r'class="(s\d+)"', slim)]
    assert styles == re.findall(r'style="([^"]*)"', whole)
    assert 'style="' not in slim
    paths = [
        [
            [float(number) for number in re.findall(r"-?\d+(?:\.\d+)?(?:e-?\d+)?", path)]
            for path in re.findall(r' d="([^"]*)"', text)
        ]
        for text in (whole, slim)
    ]
    for before, after in zip(*paths, strict=True):
        np.testing.assert_allclose(after, before, atol=0.0051)
    commands = [
        re.sub(r"[^MLCQz]", "", "".join(re.findall(r' d="([^"]*)"', text)))
        for text in (whole, slim)
    ]
    assert commands[1].replace("L", "") == commands[0].replace("L", "")


# how all figures are drawn


def test_lines_are_told_apart_without_colour() -> None:
    style = list(line_styles([f"filter {k}" for k in range(40)]).values())
    assert len({(look.dash, look.marker) for look in style}) == 40
    for a, b in combinations(style[:8], 2):  # as many as a figure names
        grey = [
            0.2126 * r + 0.7152 * g + 0.0722 * b for r, g, b in map(to_rgb, (a.colour, b.colour))
        ]
        assert a.dash != b.dash or abs(grey[0] - grey[1]) > 0.1


def test_pictures_keep_the_colours_of_the_filters() -> None:
    style = line_styles([f"filter {k}" for k in range(7)])
    figure = Figure(figsize=(2, 2))
    axis = figure.subplots()
    for k, (label, look) in enumerate(style.items()):
        axis.axhspan(k, k + 0.9, color=look.colour, lw=0)
        axis.plot([0, 1], [k, k + 1], label=label)
    plain = io.BytesIO()
    figure.savefig(plain, format="png")
    small = render_palette_png(figure)
    assert len(small) < 0.6 * len(plain.getvalue())
    seen = {colour for _, colour in Image.open(io.BytesIO(small)).convert("RGB").getcolors(2**16)}
    assert {
        tuple(round(255 * part) for part in to_rgb(look.colour)) for look in style.values()
    } <= seen
    assert small == render_palette_png(figure)
