"""Figures of the papers from our results, with bands over runs.

Names contain the number of the paper and of the figure: "000-2" is figure 2 of paper 000. A study named after a paper shows
the figures of the paper for which data exist. `report.paper_figures` selects other figures, or none.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path

from pfbench.report.plots.figure_files import FigureSpec
from pfbench.report.plots.paper.paper_catalogue import FIGURES
from pfbench.report.plots.paper.paper_specs import PaperFigure, PaperFigureData, PaperFigureInput
from pfbench.report.plots.plotting import LineStyle
from pfbench.results import store
from pfbench.results.conditions import Condition


def paper_figures(
    study: str,
    conditions: Sequence[Condition],
    style: Mapping[str, LineStyle],
    selection: Sequence[str] | None = None,
    start_time_s: float = 0.0,
) -> list[FigureSpec]:
    """List the paper figures of a study.

    Args:
        study: Name of the study; "paper_000_linear" belongs to paper 000.
        conditions: Conditions of the study.
        style: Line styles by label.
        selection: Names of figures, None for the figures of the study's paper.
        start_time_s: Start time of measures, s. Curves over time show all times.

    Raises:
        ValueError: If a figure does not exist, or data for a requested figure are missing.
    """
    if unknown := sorted(set(selection or ()) - set(FIGURES)):
        raise ValueError(
            f"report.paper_figures must be paper figures, got {', '.join(unknown)}. "
            f"Choose from {', '.join(FIGURES)}."
        )
    paper = re.match(r"paper_(\d{3})", study)
    default = [name for name in FIGURES if paper and name.startswith(paper[1])]
    figures: list[FigureSpec] = []
    read = cache(store.read_result)
    for name in default if selection is None else selection:
        figure = FIGURES[name]
        data = list(_read_conditions(figure, conditions, read, start_time_s))
        drawings = figure.draw(PaperFigureInput(figure, data, style))
        if selection is not None and not drawings:
            noise = f" with noise={figure.noise}" if figure.noise else ""
            raise ValueError(
                f"report.paper_figures must have data, got {name} ({figure.title}). "
                f"It requires results of {', '.join(figure.filters)}{noise}."
            )
        figures += [d._replace(name=f"{name}_{d.name}".rstrip("_")) for d in drawings]
    return figures


def _read_conditions(
    figure: PaperFigure,
    conditions: Sequence[Condition],
    read: Callable[[Path], store.JobResult],
    start_time_s: float,
) -> Iterator[PaperFigureData]:
    """Read the results of a figure's filters that have valid runs, by condition."""
    for condition in conditions:
        if figure.noise in ("", condition.noise):
            paths = {job.label: job.path for job in condition.jobs}
            results = {label: read(paths[label]) for label in figure.filters if label in paths}
            valid = {label: r for label, r in results.items() if not r.data["lost"].all()}
            if valid:
                yield PaperFigureData(condition, valid, start_time_s)
