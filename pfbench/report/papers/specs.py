"""Figures of the papers with their captions, from the results of one or more conditions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from pfbench.report.papers import plots
from pfbench.report.papers.plots import ResultsWithGroup
from pfbench.results import store
from pfbench.results.conditions import ComponentGroup, Condition, component_groups
from pfbench.results.frame import select_indices
from pfbench.results.plotting import COLUMN, FigureSpec, LineStyle, format_slug, line_styles

_BAND = "median and 5 to 95 %"
_FIRST = (
    " Dashed black: 5 to 95 % before correction, at the first step. "
    "The error there equals the bias, because the filter has processed no measurement."
)


class PaperFigureData(NamedTuple):
    """Data of a paper figure in one condition.

    Attributes:
        condition: Condition.
        results: Results by label, with all times.
        start_time_s: Start time of the measures, s.
    """

    condition: Condition
    results: dict[str, store.JobResult]
    start_time_s: float

    @property
    def prefix(self) -> str:
        """Prefix of the file names."""
        scenario, noise, model = self.condition[:3]
        return format_slug(f"{scenario}_{noise}_{model}")

    def select_group(self, group: str) -> dict[str, tuple[store.JobResult, ComponentGroup]]:
        """Return the results that have a component group, with the group, by label."""
        return {
            label: (result, block)
            for label, result in self.results.items()
            for block in component_groups(result.meta["state"])
            if block.group == group
        }


class PaperFigure(NamedTuple):
    """Figure of a paper.

    Attributes:
        title: Paper and figure, as text.
        filters: Labels of the filters; those without results are left out.
        draw: Function that returns the figures of conditions, none without data.
        noise: Noise regime of the conditions, empty for any.
        groups: Component groups, for figures of errors.
        printed: Values of the paper by label, in the displayed unit.
    """

    title: str
    filters: tuple[str, ...]
    draw: Callable[[PaperFigureInput], list[FigureSpec]]
    noise: str = ""
    groups: tuple[str, ...] = ()
    printed: Mapping[str, tuple[float, ...]] = {}


class PaperFigureInput(NamedTuple):
    """Input of the functions that make the figures of a paper.

    Attributes:
        figure: Figure of the paper.
        data: Data of each condition.
        style: Line styles by label.
    """

    figure: PaperFigure
    data: Sequence[PaperFigureData]
    style: Mapping[str, LineStyle]

    def list_groups(self) -> Iterator[tuple[PaperFigureData, str, ResultsWithGroup]]:
        """Yield the data, group and results of each condition and group with results."""
        for data, group in product(self.data, self.figure.groups):
            if results := data.select_group(group):
                yield data, group, results

    def format_head(self, data: PaperFigureData) -> str:
        """Format the start of a caption."""
        return f"{self.figure.title}, here {data.condition.scenario} / {data.condition.noise}"


def make_error_figures(source: PaperFigureInput, before: bool = False) -> list[FigureSpec]:
    """Return figures of the error over time, one per condition and group."""
    figures = []
    for data, group, results in source.list_groups():
        text = f"{source.format_head(data)}: error of {group} over time, {describe_band(data)}."
        text += (_FIRST if before else "") + plots.SYMLOG
        make = partial(plots.plot_errors, results, source.style, before)
        figures.append(FigureSpec(f"{data.prefix}_{format_slug(group)}", text, make))
    return figures


def make_trace_figures(
    name: str, words: str, unit: str, source: PaperFigureInput
) -> list[FigureSpec]:
    """Return figures of a trace over time, one per condition."""
    figures = []
    low, high = source.figure.printed.get("", (np.nan, np.nan))
    for data in source.data:
        results = {label: r for label, r in data.results.items() if name in r.data}
        if results:
            text = f"{source.format_head(data)}: {words} over time, {describe_band(data)}."
            text += f" Grey: {low:g} to {high:g}, as printed." if np.isfinite(low) else ""
            make = partial(plots.plot_paper_trace, results, name, unit, source.style, (low, high))
            figures.append(FigureSpec(f"{data.prefix}_{name}", text, make))
    return figures


def make_escape_figure(source: PaperFigureInput) -> list[FigureSpec]:
    """Return the figure of the escape factor over the iterations of a step."""
    factors: dict[str, tuple[float, int]] = {}
    for label, result in (item for data in source.data for item in data.results.items()):
        proposal = result.meta["config"].get("filter", {}).get("proposal") or {}
        if escape := (proposal.get("velocity") or {}).get("escape_coefficient"):
            factors[label] = float(escape), int(proposal["iterations"])
    if not factors:
        return []
    text = (
        f"{source.figure.title}: escape factor c3 = c4 over the iterations of a step, as repaired "
        "and as used by the filters. Dotted: eq. 35 as printed."
    )
    return [FigureSpec("", text, partial(plots.plot_escape, factors, source.style))]


def make_relative_error_figures(source: PaperFigureInput) -> list[FigureSpec]:
    """Return figures of Err by experiment, over time and its mean."""
    experiments = {
        data.condition.scenario: data.results
        for data in source.data
        if all("range" in r.data for r in data.results.values())
    }
    if not experiments:
        return []
    quantity = "Err, the horizontal error in % of the horizontal range [eq. 20 as repaired]"
    head, runs = f"{source.figure.title}: {quantity}", describe_band(*source.data)
    values = {
        name: {label: plots.mean_relative_error(r) for label, r in results.items()}
        for name, results in experiments.items()
    }
    return [
        FigureSpec(
            "",
            f"{head}, mean over time, by experiment: {runs}.",
            partial(plots.plot_against, values, source.style, "mean Err [%]"),
        ),
        FigureSpec(
            "over_time",
            f"{head}, over time in each experiment, {runs}.",
            partial(plots.plot_relative_errors, experiments, source.style),
        ),
    ]


def make_ess_figure(source: PaperFigureInput) -> list[FigureSpec]:
    """Return the figure of the mean effective number of particles by experiment."""
    values = {
        data.condition.scenario: {
            label: plots.mean_trace_per_run(r, "ess")
            for label, r in data.results.items()
            if "ess" in r.data
        }
        for data in source.data
    }
    values = {name: by_label for name, by_label in values.items() if by_label}
    if not values:
        return []
    text = (
        f"{source.figure.title}: effective number of particles, mean over time [eq. 21], "
        f"{describe_band(*source.data)}."
    )
    make = partial(plots.plot_against, values, source.style, "mean Neff")
    return [FigureSpec("", text, make)]


def make_time_figure(source: PaperFigureInput) -> list[FigureSpec]:
    """Return the figure of the time per step by experiment."""
    values = {
        data.condition.scenario: {
            label: 1e3 * np.array([r.meta["seconds"]["per_step"]])
            for label, r in data.results.items()
        }
        for data in source.data
    }
    if not values:
        return []
    runs = sorted({r.meta["runs"] for data in source.data for r in data.results.values()})
    text = (
        f"{source.figure.title}: time per step of all {' or '.join(map(str, runs))} runs together. "
        "Each value is one measurement on one machine, without an interval."
    )
    make = partial(plots.plot_against, values, source.style, "time per step [ms]")
    return [FigureSpec("", text, make)]


def make_maximum_figures(source: PaperFigureInput) -> list[FigureSpec]:
    """Return figures of maximum error and RMSE, with the values of the paper."""
    figures, printed = [], source.figure.printed
    for data, group, results in source.list_groups():
        start = data.start_time_s
        since = f" after {start:g} s" if start else ""
        quantity = f"maximum error of {group}{since} (filled) and RMSE (open)"
        text = f"{source.format_head(data)}: {quantity}, {describe_band(data)}."
        text += " Crosses: maximum errors as printed." if set(printed) & set(results) else ""
        make = partial(plots.plot_maxima, results, source.style, start, printed)
        figures.append(FigureSpec(f"{data.prefix}_{format_slug(group)}", text, make))
    return figures


def describe_band(*conditions: PaperFigureData) -> str:
    """Format the band, the number of runs and of lost runs for a caption."""
    results = [(data, label, r) for data in conditions for label, r in data.results.items()]
    runs = sorted({int(r.meta["runs"]) for _, _, r in results})
    lost = [
        f"{label} {n}{f' in {data.condition.scenario}' if len(conditions) > 1 else ''}"
        for data, label, r in results if (n := int(r.data["lost"].sum()))
    ]  # fmt: skip
    note = f" (lost runs excluded: {', '.join(lost)})" if lost else ""
    return f"{_BAND} of {' or '.join(map(str, runs))} runs{note}"


# --------------------------------------------------------------------------------------------------
# Figures of a paper that show the error for several values of one parameter.


def make_parameter_figures(name: str, remark: str, source: PaperFigureInput) -> list[FigureSpec]:
    """Return figures of the error over time for each value of a parameter, one per condition."""
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
            f"{describe_band(data)}. {remark}{plots.SYMLOG}"
        )
        make = partial(plots.plot_errors, values, style)
        figures.append(FigureSpec(f"{data.prefix}_{format_slug(group)}", text, make))
    return figures


# --------------------------------------------------------------------------------------------------
# Figures of the flight of a paper: the true track from above, its height and its velocity.

_COLOUR = "#0b4f8a"
_AXES = ("East", "North", "Up")
_KILOMETRE = 1e3


def plot_flight(result: store.JobResult) -> Figure:
    """Plot the true track of the first run from above, and its height over time."""
    steps = select_indices(len(result.data["time"]))
    track = result.data["track"][0, steps].astype(np.float64) / _KILOMETRE
    figure = Figure(figsize=(COLUMN, 3.6), layout="constrained")
    plan, height = figure.subplots(2, 1, height_ratios=(2.2, 1.0))
    plan.plot(track[:, 0], track[:, 1], color=_COLOUR)
    plan.plot(*track[0, :2], "o", color=_COLOUR, ms=4)
    plan.set(xlabel="East [km]", ylabel="North [km]")
    plan.set_aspect("equal", adjustable="datalim")
    height.plot(result.data["time"][steps], track[:, 2] * _KILOMETRE, color=_COLOUR)
    height.set(xlabel="time [s]", ylabel="Up [m]")
    return figure


def plot_flight_velocity(result: store.JobResult) -> Figure:
    """Plot the velocity of the first run, from differences of its true positions."""
    time = result.data["time"]
    velocity = np.gradient(result.data["track"][0].astype(np.float64), time, axis=0)
    steps = select_indices(len(time))
    figure = Figure(figsize=(COLUMN, 3.2), layout="constrained")
    for axis, name, values in zip(
        figure.subplots(3, 1, sharex=True), _AXES, velocity.T, strict=True
    ):
        axis.plot(time[steps], values[steps], color=_COLOUR)
        axis.set_ylabel(f"{name} [m/s]")
    figure.axes[-1].set_xlabel("time [s]")
    return figure


def make_flight_figures(source: PaperFigureInput) -> list[FigureSpec]:
    """Return the figure of the flight of each scenario."""
    return [
        FigureSpec(
            format_slug(scenario),
            f"{source.figure.title}, here {scenario}: true track of the first run from above, and its "
            "height. The dot is the start.",
            partial(plot_flight, result),
        )
        for scenario, result in _list_flights(source)
    ]


def make_flight_velocity_figures(source: PaperFigureInput) -> list[FigureSpec]:
    """Return the figure of the velocity of each scenario."""
    return [
        FigureSpec(
            format_slug(scenario),
            f"{source.figure.title}, here {scenario}: velocity of the first run, from differences of "
            "its true positions.",
            partial(plot_flight_velocity, result),
        )
        for scenario, result in _list_flights(source)
    ]


def _list_flights(source: PaperFigureInput) -> Iterator[tuple[str, store.JobResult]]:
    """Yield each scenario with a result that has a track."""
    scenarios: set[str] = set()
    for data in source.data:
        result = next((r for r in data.results.values() if "track" in r.data), None)
        if result is not None and data.condition.scenario not in scenarios:
            scenarios.add(data.condition.scenario)
            yield data.condition.scenario, result
