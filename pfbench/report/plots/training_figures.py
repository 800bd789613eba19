"""Figure of a training: loss on the training and the validation runs, and effective sample size, by epoch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from pfbench.files.atomic_write import write_atomically
from pfbench.report.plots.figure_files import FigureSpec, draw_figure
from pfbench.report.plots.plotting import PLAIN_COLOURS, add_legend, stacked_axes

Losses = Mapping[str, Sequence[float]]


def write_training_figure(path: Path, losses: Losses) -> Path:
    """Write the figure of a training as SVG. Equal losses give equal bytes.

    Args:
        path: File, replaced if it exists.
        losses: Values of each epoch by name: epoch, loss, validation, ess.

    Returns:
        The path.
    """
    spec = FigureSpec(path.stem, "", lambda: plot_training(losses))
    content = draw_figure(spec, ("svg",))["svg"]
    write_atomically(path, lambda file: file.write(content))
    return path


def plot_training(losses: Losses) -> Figure:
    """Plot the losses and the effective sample size over the epochs, without the latter if it is NaN.

    Args:
        losses: Values as in `write_training_figure`.
    """
    has_particles = np.isfinite(losses["ess"]).any()
    figure, (top, *others) = stacked_axes(2 if has_particles else 1, 1.5)
    epoch, validation = np.asarray(losses["epoch"]), np.asarray(losses["validation"])
    top.plot(epoch, losses["loss"], color=PLAIN_COLOURS[5], lw=1.0, label="training runs")
    top.plot(epoch, validation, color=PLAIN_COLOURS[0], lw=1.3, label="validation runs")
    if np.isfinite(validation).any():
        best = np.where(np.isfinite(validation), validation, np.inf).argmin()
        top.plot(
            epoch[best], validation[best], "o", ls="none", ms=5, mfc="white", mec=PLAIN_COLOURS[0],
            label="kept weights",
        )  # fmt: skip
    top.set_ylabel("loss")
    for bottom in others:
        bottom.plot(epoch, losses["ess"], color=PLAIN_COLOURS[0], lw=1.3)
        bottom.set(ylabel="ESS / N", ylim=(0, 1))
    last = [top, *others][-1]
    last.set_xlabel("epoch")
    last.xaxis.set_major_locator(MaxNLocator(integer=True))
    add_legend(figure, top, columns=3)
    return figure
