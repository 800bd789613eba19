"""The figure of a training shows what the file of losses says."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pfbench.report.scenario_figures import plot_training, write_training_figure

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
