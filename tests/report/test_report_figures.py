"""Figures as they are drawn: letters can be read, names are whole and do not cover each other, colours are kept."""

from __future__ import annotations

import io
from collections.abc import Callable
from itertools import combinations, pairwise, product
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
import pytest
import synthetic_results as synthetic
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image

from pfbench.config.paper_files import plan_installed_pairs
from pfbench.report import cost, summary
from pfbench.report.cost import ParetoFront
from pfbench.report.plots import (
    axis_ticks,
    comparison_plots,
    condition_figures,
    cost_plots,
    decision_plots,
    filter_plots,
    label_placement,
    plotting,
    summary_figures,
)
from pfbench.report.plots.figure_files import FigureSpec, render_palette_png, write_figure
from pfbench.results import store
from pfbench.results.comparison import condition_blocks
from pfbench.results.comparison.pairwise_tests import compare_pairs
from pfbench.results.conditions import load_conditions
from pfbench.results.decisions import planned_pairs, tidy_table
from pfbench.results.frame import to_long_rows

BASES = (
    "sir",
    "rpf",
    "mcmc_rpf",
    "gpf",
    "qmc_gpf",
    "qmc_polymerised",
    "mssrckf",
    "fm_mssrckf",
    "cofm_mssrckf",
)
OTHERS = (
    *(f"filter_{k}" for k in range(22)),
    "dmc_reconstructed_printed",
    "dmc_reconstructed[model.process_noise_factor=5.0]",
)


def drawn(make: Callable[[], Figure], tmp: Path) -> Figure:
    """The figure as it is saved, laid out."""
    kept: list[Figure] = []
    write_figure(FigureSpec("one", "", lambda: kept.append(make()) or kept[0]), tmp, ("png", "svg"))
    kept[0].draw_without_rendering()
    return kept[0]


def rows(worlds: int, labels: tuple[str, ...], runs: int = 8) -> pd.DataFrame:
    """RMSE of filters of which each is a little worse than the one before, in four regimes of so many worlds."""
    rng = np.random.default_rng(1)
    parts = []
    for world, noise in product(range(worlds), ("nominal", "outliers", "paper_bursts", "student")):
        for k, label in enumerate(labels):
            parts.append(pd.DataFrame({
                "scenario": f"passive_{world}", "noise": noise, "model": "m", "label": label, "group": "position",
                "component": "norm", "unit": "m", "metric": "rmse", "seed": 1, "run": np.arange(runs), "lost": False,
                "family": f"passive_{world}", "keeps_track": True,
                "value": 1.1**k * rng.lognormal(0, 0.1, runs),
            }))  # fmt: skip
    return pd.concat(parts, ignore_index=True)


def small(figure: Figure) -> list[tuple[str, float]]:
    """Texts of the figure below 6.5 points."""
    seen = [text for text in figure.findobj(Text) if text.get_visible() and text.get_text()]
    assert len(seen) > 10
    return [(text.get_text(), text.get_fontsize()) for text in seen if text.get_fontsize() < 6.5]


def cut(figure: Figure) -> list[str]:
    """Texts that are not whole in the figure, with two points to spare at its left edge."""
    edge, found = 2 * figure.dpi / 72, []
    for text in figure.findobj(Text):
        box = text.get_window_extent()
        whole = (
            box.x0 >= edge and box.x1 <= figure.bbox.x1 and box.y0 >= 0 and box.y1 <= figure.bbox.y1
        )
        if text.get_visible() and text.get_text() and box.width and not whole:
            found.append(text.get_text())
    return found


@pytest.mark.parametrize("worlds", [2, 7])
def test_letters_of_figures_of_many_filters_can_be_read_and_are_not_cut(
    worlds: int, tmp_path: Path
) -> None:
    table = rows(worlds, (*BASES, *OTHERS))
    of = {
        (f"passive_{k}", noise, "m"): "position"
        for k, noise in product(range(worlds), table.noise.unique())
    }
    some = table[table.label.isin([*BASES, "dmc_reconstructed_printed"])]
    _, decided, name = summary.select_main_rows(some, compare_pairs(some), of)
    source = condition_blocks.ranking_blocks(table, name)
    pairs = plan_installed_pairs(sorted(set(table.label)))
    assert len(pairs) > 4
    planned = planned_pairs.decide_planned_pairs(tidy_table.tidy_runs(table), pairs)
    errors = [d for d in planned if d.metric == "error"]
    made = {
        "map": lambda: summary_figures.plot_ratio_map(source),
        "planned": lambda: decision_plots.plot_planned_pairs(errors, 0.05),
        "matrix": lambda: comparison_plots.plot_matrix(decided),
        "forest": lambda: comparison_plots.plot_forest(
            [v for v in decided if v.noise == "student"][:12]
        ),
    }
    for kind, make in made.items():
        figure = drawn(make, tmp_path)
        assert figure.get_figwidth() <= 3.5, kind  # a column of print
        assert small(figure) == [], kind
        assert cut(figure) == [], kind


def test_the_longest_name_beside_a_trace_is_not_cut(tmp_path: Path) -> None:
    synthetic.study(tmp_path / "demo", runs=6, steps=12)
    (cell,) = load_conditions("demo", tmp_path)
    loaded = {job.label: job.load() for job in cell.jobs}
    swarms = {name: r for name, r in loaded.items() if "ess" in r.data}
    loaded = {
        name: r._replace(data={**r.data, "ancestors": r.data["ess"]}) for name, r in swarms.items()
    }
    style = plotting.line_styles(list(loaded))
    figure = drawn(lambda: filter_plots.plot_trace(loaded, "ancestors", style), tmp_path)
    name = figure.axes[0].get_ylabel()
    assert "ancestors" in name
    assert name not in cut(figure)


def test_a_track_is_shown_where_somebody_estimated_it(tmp_path: Path) -> None:
    synthetic.study(tmp_path / "demo", runs=6, steps=12)
    (cell,) = load_conditions("demo", tmp_path)
    loaded = {job.label: job.load() for job in cell.jobs}
    runs, look = (
        to_long_rows(cell, cell.jobs[0], next(iter(loaded.values())), 0.0, {}),
        plotting.line_styles(list(loaded)),
    )

    def drawings(results: dict[str, store.JobResult]) -> set[str]:
        return {
            one.name
            for one in condition_figures.condition_figures(results, runs, look, ["position"], 0.05)
        }

    assert "track" in drawings(loaded)
    plane = {}
    for label, r in loaded.items():  # as of an emitter in the plane: x and y, no height
        state = {
            **r.meta["state"],
            "names": [name.replace("position_", "place_") for name in r.meta["state"]["names"]],
        }
        plane[label] = r._replace(meta={**r.meta, "state": state})
    assert "track" not in drawings(plane)


def test_numbers_of_a_matrix_stay_in_their_squares(tmp_path: Path) -> None:
    table = rows(3, (*BASES, "dmc_reconstructed_printed"), runs=16)
    figure = drawn(
        lambda: comparison_plots.plot_matrix(compare_pairs(table)),
        tmp_path,
    )
    (axis,) = figure.axes
    width = axis.bbox.width / 10
    assert any("12" in text.get_text() for text in axis.texts)
    for text in axis.texts:
        assert text.get_window_extent().width <= width


def test_names_are_broken_where_they_may_be() -> None:
    label = "dmc_reconstructed_printed[model.process_noise_factor=5.0]"
    lines = label_placement.wrap_label(label).split("\n")
    assert "".join(lines) == label
    assert max(map(len, lines)) <= 18
    assert label_placement.wrap_label("qmc_polymerised") == "qmc_polymerised"
    assert "".join(label_placement.wrap_label("a[b[c.d_]]__x").split("\n")) == "a[b[c.d_]]__x"


def lightness(colour: str) -> float:
    """L* of CIELAB."""
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in to_rgb(colour)]
    return 116 * float(np.dot(linear, [0.2126, 0.7152, 0.0722])) ** (1 / 3) - 16


def test_shades_of_the_map_are_equal_steps_of_lightness() -> None:
    steps = [a - b for a, b in pairwise(map(lightness, plotting.SHADES))]
    assert len(steps) == 7
    assert min(steps) > 10  # what two neighbours differ in is seen
    assert max(steps) < 1.2 * min(steps)
    hue = [np.argsort(to_rgb(shade)).tolist() for shade in plotting.SHADES]
    assert hue == [[0, 1, 2]] * 8  # all blue: for any eye they differ in lightness alone


def pixels(colours: list[tuple[float, float, float]]) -> set[tuple[int, ...]]:
    """Colours that a small picture has of bands of those given."""
    figure = Figure(figsize=(1, 2), dpi=150)
    axis = figure.add_axes((0, 0, 1, 1))
    axis.imshow(np.array(colours)[:, None], aspect="auto", interpolation="nearest")
    axis.set_axis_off()
    found = Image.open(io.BytesIO(render_palette_png(figure))).convert("RGB").getcolors(2**16)
    return {colour for _, colour in found}


def test_pictures_keep_greys_grey_and_the_shades_of_the_map() -> None:
    greys = pixels([(k / 255,) * 3 for k in range(256)])
    assert all(len(set(colour)) == 1 for colour in greys)
    assert len(greys) > 25
    assert (255, 255, 255) in greys
    shades = {tuple(round(255 * part) for part in to_rgb(shade)) for shade in plotting.SHADES}
    assert shades <= pixels([to_rgb(shade) for shade in plotting.SHADES])


# ticks


@pytest.mark.parametrize(
    "ends", [(1e-7, 1e9), (0.5, 3e8), (1e-6, 10.0), (0.1, 5e4), (2e5, 9e5), (3.0, 40.0), (1e6, 4e7)]
)
def test_ticks_of_an_axis_have_one_style(ends: tuple[float, float]) -> None:
    with matplotlib.rc_context(plotting.RC):
        figure, (axis,) = plotting.stacked_axes(1, 1.4)
        axis.plot([0, 1], ends)
        axis.set_yscale("log")
        axis_ticks.set_plain_ticks(axis.yaxis, ends)
        figure.draw_without_rendering()
        said = [text.get_text() for text in axis.get_yticklabels() if text.get_text()]
    assert len(said) > 1
    assert not any("e" in text for text in said)
    assert len({"10" in text and text[-1] in "⁰¹²³⁴⁵⁶⁷⁸⁹" for text in said}) == 1
    assert all(len(text) <= 6 for text in said)


def test_long_numbers_that_lie_abreast_do_not_touch() -> None:
    with matplotlib.rc_context(plotting.RC):
        figure, (axis,) = plotting.stacked_axes(1, 1.4)
        axis.plot([1500.0, 6e4], [0.0, 1.0])
        axis.set_xscale("log")
        axis_ticks.set_plain_ticks(axis.xaxis, [1500.0, 6e4])
        axis.set_yticks([0, 1], ["dmc_reconstructed_printed", "sir"])
        figure.draw_without_rendering()
    assert min(gaps(axis)) > 6


def gaps(axis: Axes) -> list[float]:
    """Between the numbers below a panel."""
    boxes = sorted(
        (text.get_window_extent() for text in axis.get_xticklabels() if text.get_text()),
        key=lambda box: box.x0,
    )
    assert len(boxes) > 1
    return [b.x0 - a.x1 for a, b in pairwise(boxes)]


def test_numbers_of_costs_do_not_touch(tmp_path: Path) -> None:
    synthetic.study(tmp_path / "demo", runs=6, steps=12)
    (cell,) = load_conditions("demo", tmp_path)
    loaded = [job.load() for job in cell.jobs[:3]]
    times = dict(zip(("dmc_reconstructed_printed", "ekf", "sir"), (0.25, 0.05, 0.01), strict=True))
    dear = {
        name: result._replace(
            meta={**result.meta, "seconds": {"per_step": time}, "memory": 1e9 * time}
        )
        for (name, time), result in zip(times.items(), loaded, strict=True)
    }
    figure = drawn(lambda: cost_plots.plot_cost(dear, plotting.line_styles(list(dear))), tmp_path)
    assert all(min(gaps(axis)) > 4 for axis in figure.axes)


def test_powers_are_those_of_the_values() -> None:
    assert axis_ticks.format_ticks([1.0, 1e4, 1e8]) == ["10⁰", "10⁴", "10⁸"]
    assert axis_ticks.format_ticks([-2e6, 0.0, 5e-5]) == ["-2·10⁶", "0", "5·10⁻⁵"]
    assert axis_ticks.format_ticks([-1000.0, 0.0, 0.5]) == ["-1000", "0", "0.5"]


# the front of accuracy and time


def front(piled: int) -> tuple[ParetoFront, dict[str, plotting.LineStyle]]:
    """Of 30 filters so many at one spot, the best ones a chain, one lost, seven in colour."""
    rng = np.random.default_rng(2)
    labels = tuple(f"filter_no_{k}" for k in range(30))
    seconds, rmse = rng.uniform(3e-3, 6e-2, 30), rng.uniform(1.2, 3.0, 30)
    seconds[:piled], rmse[:piled] = 2e-3 * 1.02 ** np.arange(piled), 1.05 - 0.001 * np.arange(piled)
    rmse[-2:], seconds[-2] = (0.9, np.inf), 5e-3
    kept = tuple(bool(one) for one in cost.pareto_mask(seconds, rmse))
    made = ParetoFront("cell", "position", "m", labels, tuple(seconds), tuple(rmse), kept)
    return made, plotting.mute_others(plotting.line_styles(labels), [*labels[3:9], labels[20]])


def overlap(a: Text, b: Text) -> bool:
    p, q = Text.get_window_extent(a).extents, Text.get_window_extent(b).extents
    return bool((p[:2] < q[2:] - 0.5).all() and (q[:2] < p[2:] - 0.5).all())


@pytest.mark.parametrize("piled", [1, 6])
def test_points_on_the_front_and_those_in_colour_are_named(piled: int, tmp_path: Path) -> None:
    one, style = front(piled)
    figure = drawn(lambda: cost_plots.plot_pareto_fronts([one], style), tmp_path)
    (axis,) = figure.axes
    wanted = {
        label
        for label, kept in zip(one.filters, one.on_front, strict=True)
        if kept or not style[label].quiet
    }
    assert sum(one.on_front) == piled + 1
    names = {text.get_text(): text for text in axis.texts}
    assert set(names) == wanted
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["other filters"]
    assert [(a, b) for a, b in combinations(names, 2) if overlap(names[a], names[b])] == []
    panel = axis.get_window_extent()
    for label, text in names.items():
        box = Text.get_window_extent(text)  # of the words alone, without the line
        assert panel.x0 <= box.x0 < box.x1 <= panel.x1 + 2
        assert panel.y0 <= box.y0 < box.y1 <= panel.y1 + 2
        k = one.filters.index(label)
        at = axis.transData.transform((1e3 * one.seconds[k], one.rmse[k]))
        off = np.hypot(*(np.clip(at, box.min, box.max) - at)) * 72 / figure.dpi
        assert (
            text.arrow_patch is not None or off < 12
        )  # a name that is not beside its mark has a line to it
        for other, ring in zip(one.filters, one.on_front, strict=True):  # marks and rings stay free
            k = one.filters.index(other)
            if np.isfinite(one.rmse[k]):
                at = axis.transData.transform((1e3 * one.seconds[k], one.rmse[k]))
                off = np.hypot(*(np.clip(at, box.min, box.max) - at)) * 72 / figure.dpi
                assert off > (4 if ring else 1), (label, other)


def test_of_few_filters_all_are_named_and_none_is_another(tmp_path: Path) -> None:
    one = ParetoFront(
        "cell", "position", "m", ("ekf", "sir"), (1e-3, 4e-3), (2.0, 1.0), (True, True)
    )
    figure = drawn(
        lambda: cost_plots.plot_pareto_fronts([one], plotting.line_styles(one.filters)), tmp_path
    )
    assert [text.get_text() for text in figure.axes[0].texts] == ["ekf", "sir"]
    assert not figure.legends


def test_a_name_of_two_lines_takes_room_for_two():
    one, two = (
        label_placement._text_size(name) for name in ("sir[particles=100]", "sir\n[particles=100]")
    )
    assert two[1] == 2 * one[1]
    assert two[0] < one[0]
