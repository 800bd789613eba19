"""Figures of the papers: the curves match the results, and the captions state the runs."""

from __future__ import annotations

import io
from collections.abc import Iterator
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_results as synthetic
import yaml
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image

from pfbench import job
from pfbench.report import study_report
from pfbench.report.papers import figures, plots, specs
from pfbench.report.papers.figures import FIGURES
from pfbench.results import store
from pfbench.results.conditions import component_groups, load_conditions
from pfbench.results.plotting import format_ticks, line_styles, render_palette_png

SIR = synthetic.Method("sir", 1.3, 0.8, 200, 4.0, (7,))
SWARM = synthetic.Method("cpso_escape", 1.0, 1.0, 200, 9.0)


def rewrite(path: Path, **more: np.ndarray) -> None:
    meta, arrays = store.read_result(path)
    store.write_result(path, meta, {**arrays, **more})


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("results")
    others = (
        synthetic.Method("cpf", 1.0, particles=200),
        synthetic.Method("cofm_amssrcpf", 0.7, particles=200),
    )
    for method in (SIR, SWARM, *others):
        for noise in ("nominal", "paper_bursts"):
            path = synthetic.write(root / "paper_004", method, noise=noise, runs=20, steps=30)
            number = 100.0 + np.arange(20)[:, None] + np.arange(30)
            rewrite(path, iterations=number / 10, particles=number, range=np.full(30, 1000.0))
    return root


def drawn(results: Path, *wanted: str) -> dict[str, tuple[str, Figure]]:
    found = load_conditions("paper_004", results)
    style = line_styles(sorted({job.label for cell in found for job in cell.jobs}))
    made = figures.paper_figures("paper_004", found, style, wanted or None, start_time_s=10.0)
    return {drawing.name: (drawing.caption, drawing.make()) for drawing in made}


def loaded(results: Path, label: str, noise: str = "nominal") -> store.JobResult:
    every = store.list_results(results / "paper_004")
    return next(r for r in every if (r.meta["label"], r.meta["choices"]["noise"]) == (label, noise))


def line(figure: Figure, panel: int, label: str) -> tuple[np.ndarray, np.ndarray]:
    one = next(line for line in figure.axes[panel].lines if line.get_label() == label)
    return np.asarray(one.get_xdata()), np.asarray(one.get_ydata())


def test_every_figure_is_of_filters_and_studies_that_there_are() -> None:
    conf, studies = job.conf_dir(), job.experiments_dir()
    for name, figure in FIGURES.items():
        assert all(
            (conf / "filter" / f"{label.partition('[')[0]}.yaml").exists()
            for label in figure.filters
        ), name
        assert figure.noise == "" or (conf / "noise" / f"{figure.noise}.yaml").exists(), name
        ran = [yaml.safe_load(path.read_text()) for path in studies.glob(f"paper_{name[:3]}*.yaml")]
        swept = [set(_swept_labels(one)) for one in ran]
        assert any(set(figure.filters) & filters for filters in swept), name
        assert any(char.isdigit() for char in figure.title) or "section" in figure.title


def _swept_labels(experiment: dict[str, Any]) -> Iterator[str]:
    """Labels of an experiment: of its sweep of filters, or of one filter with a swept key."""
    params = experiment["hydra"]["sweeper"]["params"]
    yield from str(params.get("filter", "")).split(",")
    base = next(
        (d["override /filter"] for d in experiment["defaults"] if "override /filter" in d), ""
    )
    for key, values in params.items():
        if key.startswith("filter."):
            for value in str(values).split(","):
                yield f"{base}[{key.removeprefix('filter.')}={value}]"


def test_values_of_a_parameter_have_a_line_each(tmp_path: Path) -> None:
    """Two values of one method: other colours, the median of each, and what is missing in the caption."""
    name = "cofm_mssrckf[gain_adaptations.1.max_ratio={}]".format
    for value, size in (("1.0", 1.0), ("1000000000.0", 3.0)):
        synthetic.write(
            tmp_path / "paper_002_bound", synthetic.Method(name(value), size), runs=20, steps=30
        )
    found = load_conditions("paper_002_bound", tmp_path)
    style = line_styles([job.label for cell in found for job in cell.jobs])
    (drawing,) = figures.paper_figures("paper_002_bound", found, style, ["002-3-bound"])
    figure = drawing.make()
    lines = [line(figure, 0, f"ratio bound {value}") for value in ("1.0", "1000000000.0")]
    results = {r.meta["label"]: r for r in store.list_results(tmp_path / "paper_002_bound")}
    for (_, values), key in zip(lines, ("1.0", "1000000000.0"), strict=True):
        result = results[name(key)]
        groups = component_groups(result.meta["state"])
        block = next(block for block in groups if block.group == "position")
        error = result.data["error"][..., block.places[0]] * block.scale
        np.testing.assert_allclose(values, np.median(error, 0), rtol=1e-6)
    colours = {
        one.get_color() for one in figure.axes[0].lines if one.get_label().startswith("ratio")
    }
    assert len(colours) == 2
    assert "these values are ours" in drawing.caption
    assert "No study varies the forgetting factor" in drawing.caption


def test_a_study_shows_the_figures_of_its_own_paper(results: Path) -> None:
    found = drawn(results)
    assert {name.split("_")[0] for name in found} == {
        "004-3",
        "004-4",
        "004-5",
        "004-iterations",
    } - {"004-3"}
    assert set(drawn(results, "002-12")) == {"002-12_flight_paper_bursts_ins_gnss_position"}
    for caption, figure in found.values():
        assert caption.startswith("Tian et al., ")
        assert figure.get_figwidth() <= 3.5  # a column
        assert all(
            text.get_fontsize() >= 5.5
            for text in figure.findobj(lambda part: hasattr(part, "get_fontsize"))
        )


def test_bands_are_the_quantiles_of_the_runs_that_were_not_lost(results: Path) -> None:
    caption, figure = drawn(results)["004-4_flight_nominal_ins_gnss_position"]
    assert "of 20 runs (lost runs excluded: sir 1)" in caption
    for label, component in product(("sir", "cpso_escape"), range(3)):
        kept = loaded(results, label).data
        values = kept["error"][~kept["lost"]][..., 6 + component].astype(float)
        time, middle = line(figure, component, label)
        np.testing.assert_array_equal(time, kept["time"])
        np.testing.assert_allclose(middle, np.median(values, axis=0), rtol=1e-6)
        for q in (0.05, 0.95):
            edge = np.quantile(values, q, axis=0)
            assert any(
                np.allclose(one.get_ydata(), edge)
                for one in figure.axes[component].lines
                if len(one.get_ydata()) == 30
            )


def test_nothing_lies_beyond_the_axes(results: Path) -> None:
    result = loaded(results, "cpso_escape")
    wild = result.data["error"].copy()
    wild[..., 6] *= 1 + 1e4 * np.exp(-np.arange(30) / 2)
    block = next(b for b in component_groups(result.meta["state"]) if b.group == "position")
    own = {"cpso_escape": (store.JobResult(result.meta, {**result.data, "error": wild}), block)}
    panel = plots.plot_errors(own, line_styles(["cpso_escape"])).axes[0]
    assert panel.get_yscale() == "symlog"
    assert panel.get_ylim()[1] >= np.quantile(wild[:, 0, 6], 0.95)
    ticks = list(panel.get_yticks())
    assert 0.0 in ticks
    assert max(ticks) >= 100 * min(abs(tick) for tick in ticks if tick)
    assert [text.get_text() for text in panel.get_yticklabels()] == format_ticks(ticks)


@pytest.mark.parametrize("wild", [1e3, 1e7])
def test_a_bad_filter_does_not_flatten_the_good_ones(results: Path, wild: float) -> None:
    """The axis is linear for the good ones, in no small part of it, and its few ticks have one style."""
    block = next(
        b for b in component_groups(loaded(results, "sir").meta["state"]) if b.group == "attitude"
    )
    good = {label: loaded(results, label) for label in ("cpf", "cpso_escape")}
    bad = loaded(results, "cofm_amssrcpf")
    bad = store.JobResult(bad.meta, {**bad.data, "error": wild * bad.data["error"]})
    own = {label: (result, block) for label, result in (*good.items(), ("cofm_amssrcpf", bad))}
    figure = plots.plot_errors(own, line_styles(list(own)))
    figure.draw_without_rendering()
    for component, axis in enumerate(figure.axes):
        assert axis.get_yscale() == "symlog"
        late = [np.abs(line(figure, component, label)[1][10:]).max() for label in good]
        to = axis.transData.transform
        tall = axis.bbox.height
        level = axis.yaxis.get_transform().linthresh
        assert min(late) < 2 * level < 20 * max(late)
        assert to((0, level))[1] - to((0, -level))[1] > 0.25 * tall
        ticks = [text.get_text() for text in axis.get_yticklabels()]
        assert 3 <= len(ticks) <= 7
        assert not any("e" in text for text in ticks)
        assert axis.get_ylim()[1] >= np.quantile(
            block.scale * bad.data["error"][:, 0, component], 0.95
        )


def test_a_bias_stands_beside_itself_before_correction(results: Path) -> None:
    result = loaded(results, "cpso_escape")
    block = next(b for b in component_groups(result.meta["state"]) if b.group == "attitude")
    figure = plots.plot_errors(
        {"cpso_escape": (result, block)}, line_styles(["cpso_escape"]), before=True
    )
    first = np.quantile(block.scale * result.data["error"][:, 0, 0].astype(float), [0.05, 0.95])
    levels = [one.get_ydata()[0] for one in figure.axes[0].lines if len(one.get_xdata()) == 2]
    np.testing.assert_allclose(sorted(levels), first, rtol=1e-6)
    assert "before correction" in FIGURES["004-3"].draw.keywords or FIGURES[
        "004-3"
    ].draw.keywords == {"before": True}


def test_traces_are_drawn_with_what_is_printed_of_them(results: Path) -> None:
    found = drawn(results, "004-iterations", "002-number", "002-neff")
    caption, figure = found["004-iterations_flight_nominal_ins_gnss_iterations"]
    _, middle = line(figure, 0, "cpso_escape")
    np.testing.assert_allclose(middle, (109.5 + np.arange(30)) / 10)
    caption, figure = found["002-neff_flight_paper_bursts_ins_gnss_ess"]
    assert "Grey: 110 to 180, as printed" in caption
    (span,) = [patch for patch in figure.axes[0].patches if patch.get_extents().height > 0]
    assert span.get_y() == 110
    assert span.get_height() == 70
    assert "Grey" not in found["002-number_flight_paper_bursts_ins_gnss_particles"][0]


def test_err_is_the_horizontal_error_over_the_range(results: Path) -> None:
    for label in ("sir", "cpso_escape"):
        result = loaded(results, label)
        each = plots.mean_relative_error(result)
        assert each.size == (~result.data["lost"]).sum()
        error = result.data["error"][..., [6, 7]]
        valid = error[~result.data["lost"]].astype(float)
        share = np.linalg.norm(valid, axis=-1) / result.data["range"]
        np.testing.assert_allclose(each, 100 * share.mean(1), rtol=1e-5)
    values = {
        "first": {"sir": np.arange(101.0), "gpf": np.array([5.0])},
        "second": {"sir": np.full(3, 7.0)},
    }
    axis = plots.plot_against(values, line_styles(["gpf", "sir"]), "Err").axes[0]
    lines = [(np.asarray(one.get_xdata()), np.asarray(one.get_ydata())) for one in axis.lines]
    assert sorted((round(x[0]), y[0]) for x, y in lines if len(y) == 1) == [
        (0, 5.0),
        (0, 50.0),
        (1, 7.0),
    ]
    assert [tuple(y) for _, y in lines if len(y) == 2 and y[1] > y[0]] == [(5.0, 95.0)]
    wide = plots.plot_against(
        {"first": {"sir": np.array([0.1]), "gpf": np.array([90.0])}},
        line_styles(["gpf", "sir"]),
        "",
    ).axes[0]
    assert 0.02 < wide.get_ylim()[0] < 0.1  # on a logarithmic scale, all of it there


def test_the_escape_factor_is_that_of_the_settings_that_ran(results: Path, tmp_path: Path) -> None:
    for label, escape, most in (("cpso_escape", 0.12, 5), ("cpso_escape_printed", 0.3, 30)):
        method = synthetic.Method(label, 1.0, particles=100)
        settings = {"proposal": {"velocity": {"escape_coefficient": escape}, "iterations": most}}
        synthetic.write(
            tmp_path / "paper_004", method, noise="nominal", runs=6, steps=8, config=settings
        )
    silent = synthetic.Method("cpso_escape_stopped", 1.0, particles=9)
    synthetic.write(tmp_path / "paper_004", silent, noise="nominal", runs=6, steps=8)
    ((_, figure),) = drawn(tmp_path, "004-1").values()
    lines = {
        str(one.get_label()): one
        for one in figure.axes[0].lines
        if not str(one.get_label()).startswith("_")
    }
    assert set(lines) == {"cpso_escape", "cpso_escape_printed"}
    y = np.asarray(lines["cpso_escape_printed"].get_ydata())
    assert (y[0], y[15], y[30]) == pytest.approx((0.0, 0.3, 0.6))  # from none to twice its size
    assert np.asarray(lines["cpso_escape"].get_ydata()).max() == pytest.approx(0.24)
    with pytest.raises(ValueError, match="004-1"):
        drawn(results, "004-1")  # jobs that do not tell


def test_largest_errors_stand_beside_the_printed_ones(results: Path) -> None:
    caption, figure = drawn(results, "002-maxima")[
        "002-maxima_flight_paper_bursts_ins_gnss_position"
    ]
    assert "maximum error of position after 10 s" in caption
    assert "Crosses: maximum errors as printed." in caption
    axis = figure.axes[0]
    assert [text.get_text() for text in axis.get_xticklabels()] == [
        "position_N",
        "position_E",
        "position_U",
    ]
    crosses = [tuple(one.get_ydata()) for one in axis.lines if one.get_marker() == "x"]
    assert crosses == [(8.9, 7.4, 16.4), (4.02, 4.4, 5.2)]
    arrays = loaded(results, "cpf", "paper_bursts").data
    north = np.abs(arrays["error"][:, arrays["time"] >= 10, 7]).max(1)
    assert any(
        np.allclose(one.get_ydata(), [np.median(north)])
        for one in axis.lines
        if len(one.get_ydata()) == 1
    )


def test_the_flight_is_the_true_track_and_its_velocity(results: Path) -> None:
    caption, flight = drawn(results, "000-1")["000-1_flight"]
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
    [
        ("999-1", "got 999-1. Choose from 000-1"),
        ("001-3", None),
        ("003-5", "got 003-5 .* requires results of ukf"),
    ],
)
def test_a_figure_that_cannot_be_drawn_is_told(
    results: Path, wanted: str, message: str | None
) -> None:
    if message is None:
        assert drawn(results, wanted)
    else:
        with pytest.raises(ValueError, match=message):
            drawn(results, wanted)


def test_the_page_links_to_each_of_them(results: Path, tmp_path: Path) -> None:
    options = study_report.ReportOptions(figure_formats=("png",), paper_figures=("004-iterations",))
    made = study_report.write_report("paper_004", results, tmp_path, options)
    name = "004-iterations_flight_nominal_ins_gnss_iterations"
    text = made.read_text()
    assert '<figure id="paper_004_iterations_flight_nominal_ins_gnss_iterations"><img' in text
    assert '<a href="#figures">Figures of the paper</a>' in text
    assert (made.parent / "figures" / f"paper_{name}.png").exists()


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
