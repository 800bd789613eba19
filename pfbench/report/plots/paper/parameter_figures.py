"""Figures of a paper that show the error for several values of one parameter."""

from __future__ import annotations

from functools import partial

from pfbench.report.plots.figure_files import FigureSpec
from pfbench.report.plots.paper import time_plots
from pfbench.report.plots.paper.paper_specs import PaperFigureInput, describe_band
from pfbench.report.plots.plotting import format_slug, line_styles


def make_parameter_figures(name: str, remark: str, source: PaperFigureInput) -> list[FigureSpec]:
    """Return figures of the error over time for each value of a parameter, one per condition.

    Args:
        name: Name of the parameter, as text.
        remark: What the figure of the paper leaves open.
        source: Figure and its data. Its filters are labels `filter[key=value]`.
    """
    figures = []
    for data, group, results in source.list_groups():
        if len(results) < 2:
            continue
        values = {
            f"{name} {label.rpartition('=')[2].rstrip(']')}": result
            for label, result in results.items()
        }
        style = line_styles(list(values), {})  # values of one method would have one colour
        text = (
            f"{source.format_head(data)}: error of {group} over time for values of the {name}, "
            f"{describe_band(data)}. {remark}{time_plots.SYMLOG}"
        )
        make = partial(time_plots.plot_errors, values, style)
        figures.append(FigureSpec(f"{data.prefix}_{format_slug(group)}", text, make))
    return figures
