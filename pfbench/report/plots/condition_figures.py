"""Figures of a condition: which figures the data allow, with their captions and file names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from pfbench.report.plots import cost_plots, error_plots, filter_plots
from pfbench.report.plots.curves import Results, east_north_up, pcrb_sd, sum_nis
from pfbench.report.plots.figure_files import FigureSpec
from pfbench.report.plots.filter_plots import MANY_FILTERS, TRACES
from pfbench.report.plots.plotting import LineStyle, format_slug
from pfbench.results.state_groups import ComponentGroup, component_groups

_SPREAD_FILTERS = (
    4  # with more filters, only those of `select_spread_filters` have a spread figure [ours]
)
_VALID = "valid runs"


def condition_figures(
    results: Results,
    runs: pd.DataFrame,
    style: Mapping[str, LineStyle],
    groups: Sequence[str],
    alpha: float = 0.05,
    *,
    brief: bool = False,
    note: str = "",
) -> list[FigureSpec]:
    """List all figures that the data of a condition allow.

    Args:
        results: Results by label, with all times.
        runs: Rows of `load_frame` of this condition.
        style: Line styles by label.
        groups: Names of the component groups.
        alpha: Probability outside the NEES and NIS intervals.
        brief: Whether to leave out the track, NIS, cost, the traces and the spread figures.
        note: Sentence about grey filters, for captions of figures with a line per filter.
    """
    blocks = [block for block in _all_blocks(results) if block.group in groups]
    if not blocks:
        return []
    figures = [] if brief else list(_track_figures(results, style, note))
    figures += _error_figures(results, runs, style, blocks, note)
    state_groups = list(dict.fromkeys(block.state_group for block in blocks))
    interval = f"two-sided {100 * (1 - alpha):g} % chi-square interval"
    text = f"NEES averaged over the {_VALID}, with its {interval}.{note}"
    figures.append(
        FigureSpec(
            "nees", text, partial(filter_plots.plot_nees, results, state_groups, style, alpha)
        )
    )
    if not brief and any(sum_nis(result) is not None for result in results.values()):
        text = (
            "Normalised innovation squared (NIS) per observed component over the "
            f"{_VALID} at the scored times, with its {interval}. Its expectation is 1.{note}"
        )
        make = partial(filter_plots.plot_nis, results, style, alpha)
        figures.append(FigureSpec("nis", text, make))
    if not brief:
        figures += _cost_and_trace_figures(results, style, note)
        figures += _spread_figures(results, runs, style, groups)
    return figures


def select_spread_filters(
    results: Results, runs: pd.DataFrame, groups: Sequence[str]
) -> dict[str, str]:
    """Select the filters that have a spread figure [ours].

    Up to four filters all have one. Of more filters, two have one. The first has the smallest
    median RMSE of the main group. The second has the largest ratio between median NEES and its
    degrees of freedom in any group.

    Args:
        results: Results by label.
        runs: Rows of `load_frame` of this condition.
        groups: Names of the component groups.

    Returns:
        Reason by label, as text for the caption.
    """
    drawable = {
        label: block
        for label, result in results.items()
        if not result.data["lost"].all()
        and (block := _main(result.meta["state"], groups)) is not None
    }
    if len(drawable) <= _SPREAD_FILTERS:
        return dict.fromkeys(drawable, "")
    rmse, nees = {}, {}
    for label, block in drawable.items():
        table = runs[runs.label == label]
        is_norm = (table.metric == "rmse") & (table.component == "norm")
        rmse[label] = _median(table[is_norm & (table.group == block.group)])
        state = results[label].meta["state"]
        nees[label] = _nees_distance(table[table.metric == "nees"], state, groups)
    selection: dict[str, str] = {}
    nees_reason = "the largest distance of NEES from its degrees of freedom in any group"
    for values, select, reason in (
        (rmse, min, "the smallest median RMSE of {}"),
        (nees, max, nees_reason),
    ):
        finite = {label: value for label, value in values.items() if not np.isnan(value)}
        if finite:
            label = select(finite, key=lambda name: finite[name])
            text = reason.format(drawable[label].group)
            first = f", of {len(drawable)} filters the one with {text}"
            selection[label] = f"{selection[label]} and {text}" if label in selection else first
    return selection


def _track_figures(
    results: Results, style: Mapping[str, LineStyle], note: str
) -> Iterator[FigureSpec]:
    """Yield the track of the first run that all filters completed."""
    row = _common_run(results)
    has_track = any(
        "track" in result.data and east_north_up(result.meta["state"])
        for result in results.values()
    )
    if row is not None and has_track:
        run = row + int(next(iter(results.values())).meta.get("first_run", 0))
        text = (
            f"True and estimated track of run {run}, the first run that no filter lost: plan view "
            f"and height.{note}"
        )
        yield FigureSpec("track", text, partial(error_plots.plot_track, results, row, style))


def _error_figures(
    results: Results,
    runs: pd.DataFrame,
    style: Mapping[str, LineStyle],
    blocks: Sequence[ComponentGroup],
    note: str,
) -> Iterator[FigureSpec]:
    """Yield the error over time of each group, and the RMSE of the runs."""
    has_pcrb = any(pcrb_sd(result) is not None for result in results.values())
    for block in blocks:
        text = f"Absolute error of {block.group} over time, median of the {_VALID}."
        if has_pcrb:
            text += (
                " Dashed black: median of a normal error with the standard deviation of the "
                "posterior Cramér-Rao bound (PCRB)."
            )
        make = partial(error_plots.plot_error, results, block, style)
        yield FigureSpec(f"error_{format_slug(block.group)}", text + note, make)
    if len(results) > MANY_FILTERS:
        text = (
            "RMSE of each run, filters ordered by their median: median (dot), quartiles and 5 to "
            f"95 % of the {_VALID}."
        )
    else:
        text = (
            "RMSE of each run: quartiles, whiskers to 1.5 quartile ranges, a point for each of the "
            f"{_VALID}."
        )
    groups = [block.group for block in blocks]
    yield FigureSpec("rmse", text, partial(filter_plots.plot_rmse, runs, groups, style))


def _cost_and_trace_figures(
    results: Results, style: Mapping[str, LineStyle], note: str
) -> Iterator[FigureSpec]:
    """Yield the cost of the filters and the traces that any filter stored."""
    if len(results) > 1:
        text = (
            "Cost of each filter: time per step of all runs together, and peak memory of the job "
            "above its baseline. Each value is one measurement on one machine, without an interval."
        )
        yield FigureSpec("cost", text, partial(cost_plots.plot_cost, results, style))
    for name, (quantity, _, _) in TRACES.items():
        if any(name in result.data for result in results.values()):
            title = f"{quantity[0].upper()}{quantity[1:]}"
            text = f"{title}, median and 5 to 95 % of the {_VALID}.{note}"
            yield FigureSpec(name, text, partial(filter_plots.plot_trace, results, name, style))


def _spread_figures(
    results: Results, runs: pd.DataFrame, style: Mapping[str, LineStyle], groups: Sequence[str]
) -> Iterator[FigureSpec]:
    """Yield the error and the estimated standard deviation of single filters."""
    for label, reason in select_spread_filters(results, runs, groups).items():
        result = results[label]
        text = (
            f"{label}{reason}: error over time, median and 5 to 95 % of the {_VALID} (shaded), and "
            "three times the filter's standard deviation, median over runs (dashed). The first "
            "fifth is cut if it is much larger than the rest."
        )
        if pcrb_sd(result) is not None:
            text += " Thin black: three times the PCRB."
        make = partial(error_plots.plot_spread, result, groups, style[label])
        yield FigureSpec(f"spread_{format_slug(label)}", text, make)


def _all_blocks(results: Results) -> list[ComponentGroup]:
    """Return the component groups of all results, each group once."""
    by_group: dict[str, ComponentGroup] = {}
    for result in results.values():
        for block in component_groups(result.meta["state"]):
            by_group.setdefault(block.group, block)
    return list(by_group.values())


def _main(state: Mapping[str, Any], groups: Sequence[str]) -> ComponentGroup | None:
    """Return the position if it is among the groups, else the first of them."""
    blocks = [block for block in component_groups(state) if block.group in groups]
    position = (block for block in blocks if block.group == "position")
    return next(position, blocks[0] if blocks else None)


def _nees_distance(nees: pd.DataFrame, state: Mapping[str, Any], groups: Sequence[str]) -> float:
    """Return the largest log ratio of median NEES to its degrees of freedom over groups."""
    state_groups = {block.state_group for block in component_groups(state) if block.group in groups}
    with np.errstate(divide="ignore"):
        distances = [
            abs(np.log(_median(nees[nees.group == group]) / len(state["groups"][group])))
            for group in sorted(state_groups)
        ]
    finite = [value for value in distances if not np.isnan(value)]
    return float(max(finite)) if finite else np.nan


def _median(rows: pd.DataFrame) -> float:
    """Return the median value, or NaN without values."""
    values = rows.value.dropna()
    return float(values.median()) if len(values) else np.nan


def _common_run(results: Results) -> int | None:
    """Return the row of the first run that no filter lost, or None."""
    lost = [result.data["lost"] for result in results.values()]
    if len({flags.size for flags in lost}) > 1 or np.any(lost, axis=0).all():
        return None
    return int(np.argmin(np.any(lost, axis=0)))
