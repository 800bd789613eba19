"""Figures as they are drawn: letters can be read, names are whole and do not cover each other, colours are kept."""

import io
from itertools import pairwise
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from pfbench.report.scenario_figures import plot_training, write_training_figure
from pfbench.results import plotting
from pfbench.results.plotting import render_palette_png


def pixels(colours: list[tuple[float, float, float]]) -> set[tuple[int, ...]]:
    """Colours that a small picture has of bands of those given."""
    figure = Figure(figsize=(1, 2), dpi=150)
    axis = figure.add_axes((0, 0, 1, 1))
    axis.imshow(np.array(colours)[:, None], aspect="auto", interpolation="nearest")
    axis.set_axis_off()
    found = Image.open(io.BytesIO(render_palette_png(figure))).convert("RGB").getcolors(2**16)
    return {colour for _, colour in found}


def test_pictures_keep_greys_grey() -> None:
    greys = pixels([(k / 255,) * 3 for k in range(256)])
    assert all(len(set(colour)) == 1 for colour in greys)
    assert len(greys) > 25
    assert (255, 255, 255) in greys


# ticks


@pytest.mark.parametrize(
    "ends", [(1e-7, 1e9), (0.5, 3e8), (1e-6, 10.0), (0.1, 5e4), (2e5, 9e5), (3.0, 40.0), (1e6, 4e7)]
)
def test_ticks_of_an_axis_have_one_style(ends: tuple[float, float]) -> None:
    with matplotlib.rc_context(plotting.RC):
        figure, (axis,) = plotting.stacked_axes(1, 1.4)
        axis.plot([0, 1], ends)
        axis.set_yscale("log")
        plotting.set_plain_ticks(axis.yaxis, ends)
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
        plotting.set_plain_ticks(axis.xaxis, [1500.0, 6e4])
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


def test_powers_are_those_of_the_values() -> None:
    assert plotting.format_ticks([1.0, 1e4, 1e8]) == ["10⁰", "10⁴", "10⁸"]
    assert plotting.format_ticks([-2e6, 0.0, 5e-5]) == ["-2·10⁶", "0", "5·10⁻⁵"]
    assert plotting.format_ticks([-1000.0, 0.0, 0.5]) == ["-1000", "0", "0.5"]


# the figure of a training shows what the file of losses says

LOSSES = {
    "epoch": [1.0, 2.0, 3.0, 4.0],
    "loss": [3.0, 2.0, 1.5, 1.0],
    "validation": [3.1, 2.2, np.nan, 2.4],
    "ess": [0.2, 0.4, 0.5, 0.5],
}


def test_lines_are_the_losses_and_the_mark_is_the_epoch_whose_weights_are_kept() -> None:
    top, bottom = plot_training(LOSSES).axes
    lines = {str(line.get_label()): line.get_xydata() for line in top.lines}
    for label, name in (("training runs", "loss"), ("validation runs", "validation")):
        np.testing.assert_array_equal(lines[label], np.stack([LOSSES["epoch"], LOSSES[name]], -1))
    np.testing.assert_array_equal(lines["kept weights"], [[2.0, 2.2]])
    np.testing.assert_array_equal(bottom.lines[0].get_ydata(), LOSSES["ess"])
    assert bottom.get_ylim() == (0.0, 1.0)


def test_without_a_finite_validation_loss_no_weights_are_marked() -> None:
    top, _ = plot_training(LOSSES | {"validation": [np.nan] * 4}).axes
    assert "kept weights" not in {line.get_label() for line in top.lines}


def test_equal_losses_give_equal_files(tmp_path: Path) -> None:
    first, second = (write_training_figure(tmp_path / name / "a.svg", LOSSES) for name in "ab")
    assert first.read_bytes() == second.read_bytes()
