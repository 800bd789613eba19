"""Figures of the papers with their captions, from the results of one or more conditions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from typing import Any, NamedTuple, TypeVar

import numpy as np
from matplotlib.figure import Figure

from pfbench.report.papers import plots
from pfbench.report.papers.plots import CurveLook, Looks, PrintedValue, ResultsWithGroup
from pfbench.results import store
from pfbench.results.conditions import Condition, component_groups
from pfbench.results.frame import select_indices
from pfbench.results.plotting import (
    COLUMN,
    FigureSpec,
    format_axis_label,
    format_slug,
    format_ticks,
    line_styles,
)
from pfbench.results.step_times import StepTimes
from pfbench.stats.error_measures import mean_per_run

_FIRST = (
    " Dashed black: 80 % of runs before correction, at the first step. "
    "The error there equals the bias, because the filter has processed no measurement."
)

_Values = TypeVar("_Values", bound=Mapping[str, Any])


class PaperFigureData(NamedTuple):
    """Data of a paper figure in one condition.

    Attributes:
        condition: Condition.
        results: Results by label, with all times.
        start_time_s: Start time of the measures, s.
        where: Names of the scenario and the noise regime.
    """

    condition: Condition
    results: dict[str, store.JobResult]
    start_time_s: float
    where: str

    @property
    def prefix(self) -> str:
        """Prefix of the file names."""
        scenario, noise, model = self.condition[:3]
        return format_slug(f"{scenario}_{noise}_{model}")

    @property
    def since(self) -> str:
        """Words on the start time of the measures; empty for that of the record."""
        return f" after {self.start_time_s:g} s" if self.start_time_s else ""

    def select_group(self, group: str, labels: Sequence[str] = ()) -> ResultsWithGroup:
        """Return the results of filters, of all by default, that have a component group, with the group, by label."""
        return {
            label: (self.results[label], block)
            for label in labels or self.results
            if label in self.results
            for block in component_groups(self.results[label].meta["state"])
            if block.group == group
        }


class PaperFigure(NamedTuple):
    """Figure of a paper.

    Attributes:
        title: Paper and figure, as text.
        columns: Labels of the filters of each column of panels, four at most; the band is that of the last.
        draw: Function that returns the figures of conditions, none without data.
        studies: Studies that show the figure, first the one whose experiment is that of the paper.
        noise: Noise regime of the conditions, empty for any.
        groups: Component groups, for figures of errors.
        printed: Numbers that the text of the paper prints.
        source: Where it prints them, and what else a reader must know.
        titles: Titles of the columns.
    """

    title: str
    columns: tuple[tuple[str, ...], ...]
    draw: Callable[[PaperFigureInput], Iterable[FigureSpec]]
    studies: tuple[str, ...] = ()
    noise: str = ""
    groups: tuple[str, ...] = ()
    printed: tuple[PrintedValue, ...] = ()
    source: str = ""
    titles: tuple[str, ...] = ("",)

    @property
    def filters(self) -> tuple[str, ...]:
        """Labels of all filters."""
        return tuple(dict.fromkeys(label for column in self.columns for label in column))


class PaperFigureInput(NamedTuple):
    """Input of the functions that make the figures of a paper.

    Attributes:
        figure: Figure of the paper.
        data: Data of each condition.
        looks: Names and line styles by label.
    """

    figure: PaperFigure
    data: Sequence[PaperFigureData]
    looks: Looks

    def list_groups(self) -> Iterator[tuple[PaperFigureData, str, ResultsWithGroup]]:
        """Yield the data, group and results of each condition and group with results."""
        for data, group in product(self.data, self.figure.groups):
            if results := data.select_group(group):
                yield data, group, results

    def arrange(self, select: Callable[[Sequence[str]], _Values]) -> dict[str, _Values]:
        """Return the values of the filters of each column by its title, without columns that have none."""
        columns = zip(self.figure.titles, map(select, self.figure.columns), strict=True)
        return {title: values for title, values in columns if values}

    def format_head(self, *data: PaperFigureData) -> str:
        """Format the start of a caption."""
        return f"{self.figure.title}, here {' and '.join(d.where for d in data)}"

    def describe_runs(self, *data: PaperFigureData, has_curves: bool = True) -> str:
        """Describe medians, bands, runs and absent filters, and the place of printed numbers, as the end of a caption."""
        results = [(label, r) for d in data for label, r in d.results.items()]
        runs, present = sorted({int(r.meta["runs"]) for _, r in results}), dict(results)
        last = ([n for n in column if n in present][-1:] for column in self.figure.columns)
        names = dict.fromkeys(self.looks[n].name for some in last for n in some)
        band = f"band: 80 % of runs of {' and of '.join(names)}" if has_curves else "bars: 80 % of runs"  # fmt: skip
        lost: Counter[str] = Counter()
        for label, result in results:
            lost[self.looks[label].name] += int(result.data["lost"].sum())
        counts = ", ".join(f"{name} {number}" for name, number in lost.items() if number)
        absent = dict.fromkeys(self.looks[n].name for n in self.figure.filters if n not in present)
        parts = (
            f"Medians of {' or '.join(map(str, runs))} runs; {band}.", self.figure.source,
            f"Without lost runs: {counts}." * bool(counts), f"No results of {', '.join(absent)}." * bool(absent),
        )  # fmt: skip
        return " ".join(filter(None, parts))


def make_error_figures(source: PaperFigureInput, before: bool = False) -> Iterator[FigureSpec]:
    """Yield figures of the size of the error over time, one per condition and group."""
    for data, group, results in source.list_groups():
        columns = source.arrange(partial(data.select_group, group))
        components = {name for _, block in results.values() for name in block.components}
        printed = [p for p in source.figure.printed if p.component in components]
        measures = dict.fromkeys(p.at for p in printed if isinstance(p.at, str))
        also = f", and its {' and '.join(measures)}{data.since}" if measures else ""
        text = f"{source.format_head(data)}: size of the {group.replace('_', ' ')} error over time{also}. "
        text += source.describe_runs(data) + _FIRST * before
        make = partial(plots.plot_errors, columns, source.looks, printed, data.start_time_s, before)
        yield FigureSpec(f"{data.prefix}_{format_slug(group)}", text, make)


def make_trace_figures(
    name: str, words: str, unit: str, source: PaperFigureInput
) -> Iterator[FigureSpec]:
    """Yield figures of a trace over time, one per condition."""
    for data in source.data:
        results = {label: r for label, r in data.results.items() if name in r.data}
        if results:
            time = next(iter(results.values())).data["time"]
            curves = {label: plots.select_valid(r, r.data[name]) for label, r in results.items()}
            rows = {"": source.arrange(partial(_select, curves))}
            printed = [p for p in source.figure.printed if p.filter in results]
            text = f"{source.format_head(data)}: {words} over time. {source.describe_runs(data)}"
            make = partial(plots.plot_curves, rows, time, unit, source.looks, printed)
            yield FigureSpec(f"{data.prefix}_{name}", text, make)


def make_escape_figure(source: PaperFigureInput) -> list[FigureSpec]:
    """Return the figure of the escape factor over the iterations of a step, by the equation as printed and as repaired."""
    ran: dict[int, float] = {}
    for result in (result for data in source.data for result in data.results.values()):
        proposal = result.meta["config"].get("filter", {}).get("proposal") or {}
        if escape := (proposal.get("velocity") or {}).get("escape_coefficient"):
            ran[int(proposal["iterations"])] = float(escape)
    if not ran:
        return []
    (size,) = set(ran.values())
    share = np.linspace(0.0, 1.0, _PRINTED_ITERATIONS + 1)
    curves = {"as repaired": size * (1 - np.cos(np.pi * share))} | {
        f"eq. 35 as printed, {most} iterations": size
        * (1 - np.cos(np.pi * np.arange(most + 1)) / most)
        for most in (_PRINTED_ITERATIONS, *sorted(ran, reverse=True))
    }
    text = (
        f"{source.figure.title}: escape factor c3 = c4 over the iterations of a step, for the {_PRINTED_ITERATIONS} "
        f"iterations that the paper draws and the {' and '.join(map(str, sorted(ran)))} of the filters. {source.figure.source}"
    )
    looks = _make_plain_looks({name: name for name in curves})
    return [FigureSpec("", text, partial(plots.plot_escape, curves, looks))]


def make_relative_error_figures(source: PaperFigureInput) -> list[FigureSpec]:
    """Return figures of Err by experiment: its mean, and over time."""
    with_range = all("range" in r.data for data in source.data for r in data.results.values())
    if not source.data or not with_range:
        return []
    errors = [
        {label: plots.select_valid(r, plots.relative_error_percent(r)) for label, r in data.results.items()}
        for data in source.data
    ]  # fmt: skip
    quantity = "Err, the horizontal error in % of the horizontal range (eq. 20 as repaired)"
    rows = {f"experiment {k}": source.arrange(partial(_select, v)) for k, v in enumerate(errors, 1)}
    time = next(iter(source.data[0].results.values())).data["time"]
    over_time = partial(plots.plot_curves, rows, time, "Err [%]", source.looks)
    text = f"{source.format_head(*source.data)}: {quantity}, over time. {source.describe_runs(*source.data)}"  # fmt: skip
    return [
        _make_experiment_figure(source, errors, "mean Err [%]", f"{quantity}, mean over time"),
        FigureSpec("over_time", text, over_time),
    ]


def make_ess_figure(source: PaperFigureInput) -> list[FigureSpec]:
    """Return the figure of the mean effective number of particles by experiment."""
    values = [
        {
            n: plots.select_valid(r, r.data["ess"])
            for n, r in data.results.items()
            if "ess" in r.data
        }
        for data in source.data
    ]
    if not any(values):
        return []
    quantity = "effective number of particles, mean over time (eq. 21)"
    return [_make_experiment_figure(source, values, "mean Neff", quantity)]


def make_time_figure(source: PaperFigureInput) -> list[FigureSpec]:
    """Return the figure of the time per step by experiment: of rounds in turn where they were measured."""
    if not source.data:
        return []
    values = []
    for data in source.data:
        rounds = {n: StepTimes.from_metadata(r.meta) for n, r in data.results.items()}
        values.append({
            n: 1e3 * (times.seconds if (times := rounds[n]) else np.array([r.meta["seconds"]["per_step"]]))
            for n, r in data.results.items()
        })  # fmt: skip
    runs = sorted({r.meta["runs"] for data in source.data for r in data.results.values()})
    text = (
        f"{source.format_head(*source.data)}: time per step of all {' or '.join(map(str, runs))} runs together. Filters "
        "took turns in rounds; bars: 80 % of rounds. Without a bar: one timing of the job."
    )
    return [_plot_experiments(source, values, "time per step [ms]", text)]


def make_maximum_figures(source: PaperFigureInput) -> Iterator[FigureSpec]:
    """Yield figures of RMSE and maximum error, a panel per component, with the values of the paper."""
    for data, group, results in source.list_groups():
        names = list(dict.fromkeys(n for _, block in results.values() for n in block.components))
        titles = {name: plots.name_component(name).rpartition(" ")[2] for name in names}
        columns = {
            titles[name]: {
                measure: {
                    label: plots.measure_error(measure, result, block, name, data.start_time_s)
                    for label, (result, block) in results.items()
                }
                for measure in ("RMSE", "maximum")
            }
            for name in names
        }
        printed = {
            titles[name]: [p for p in source.figure.printed if p.component == name]
            for name in names
        }
        text = f"{source.format_head(data)}: RMSE and maximum of the {group} error{data.since}. "
        text += source.describe_runs(data, has_curves=False)
        unit = format_axis_label("error", next(block.unit for _, block in results.values()))
        make = partial(plots.plot_points, columns, source.looks, unit, printed=printed)
        yield FigureSpec(f"{data.prefix}_{format_slug(group)}", text, make)


def make_parameter_figures(name: str, source: PaperFigureInput) -> Iterator[FigureSpec]:
    """Yield figures of the error over time for each value of a parameter, one per condition."""
    for data, group, results in source.list_groups():
        if len(results) < 2:
            continue
        values = {n: float(n.rpartition("=")[2].rstrip("]")) for n in source.figure.filters}
        names = {label: f"{name} {format_ticks([value])[0]}" for label, value in values.items()}
        plain = source._replace(looks=_make_plain_looks(names))
        text = f"{source.format_head(data)}: size of the {group} error over time for values of the {name}. "
        make = partial(plots.plot_errors, {"": results}, plain.looks)
        text += plain.describe_runs(data)
        yield FigureSpec(f"{data.prefix}_{format_slug(group)}", text, make)


_PRINTED_ITERATIONS = 150  # [Tian et al., section 5.3]


def _make_plain_looks(names: Mapping[str, str]) -> Looks:
    """Return looks for curves of one method, which would have one colour."""
    styles = line_styles(list(names), {})
    return {label: CurveLook(name, styles[label]) for label, name in names.items()}


def _select(values: Mapping[str, Any], labels: Sequence[str]) -> dict[str, Any]:
    """Return the values of filters that have some."""
    return {label: values[label] for label in labels if label in values}


def _plot_experiments(
    source: PaperFigureInput, values: Sequence[Mapping[str, np.ndarray]], label: str, text: str
) -> FigureSpec:
    """Return the figure of values by the title of the column, number of the experiment, and filter."""
    columns = source.arrange(
        lambda labels: {str(k): _select(v, labels) for k, v in enumerate(values, 1)}
    )
    make = partial(plots.plot_points, columns, source.looks, label, xlabel="experiment")
    return FigureSpec("", text, make)


def _make_experiment_figure(
    source: PaperFigureInput, values: Sequence[Mapping[str, np.ndarray]], label: str, quantity: str
) -> FigureSpec:
    """Return the figure of a mean over time of each run, by experiment."""
    means = [{n: mean_per_run(v, np.zeros(len(v), dtype=bool)) for n, v in runs.items()} for runs in values]  # fmt: skip
    words = source.describe_runs(*source.data, has_curves=False)
    text = f"{source.format_head(*source.data)}: {quantity}, by experiment. {words}"
    return _plot_experiments(source, means, label, text)


# --------------------------------------------------------------------------------------------------
# Figures of the flight of a paper: the true track from above, its height and its velocity.

_COLOUR = "#0b4f8a"
_AXES = ("East", "North", "Up")
_KILOMETRE = 1e3


def plot_flight(result: store.JobResult, printed: Sequence[PrintedValue] = ()) -> Figure:
    """Plot the true track of the first run from above, and its height over time with the printed heights."""
    steps = select_indices(len(result.data["time"]))
    track = result.data["track"][0, steps].astype(np.float64) / _KILOMETRE
    figure = Figure(figsize=(COLUMN, 3.6), layout="constrained")
    plan, height = figure.subplots(2, 1, height_ratios=(2.2, 1.0))
    plan.plot(track[:, 0], track[:, 1], color=_COLOUR)
    plan.plot(*track[0, :2], "o", color=_COLOUR, ms=4)
    plan.set(xlabel="East [km]", ylabel="North [km]")
    plan.set_aspect("equal", adjustable="datalim")
    height.plot(result.data["time"][steps], track[:, 2] * _KILOMETRE, color=_COLOUR)
    for k, p in enumerate(printed):
        height.plot(
            p.at, p.value, "x", color="black", ms=6.5, mew=1.5, clip_on=False,
            label="printed" if k == 0 else "",
        )  # fmt: skip
    if printed:
        height.legend(loc="best")
    height.set(xlabel="time [s]", ylabel="height [m]")
    return figure


def plot_flight_velocity(result: store.JobResult, _: Sequence[PrintedValue] = ()) -> Figure:
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


def make_flight_figures(
    text: str, plot: Callable[[store.JobResult, Sequence[PrintedValue]], Figure], source: PaperFigureInput
) -> list[FigureSpec]:  # fmt: skip
    """Return the figure of the first result of each scenario that has a track."""
    first: dict[str, tuple[str, store.JobResult]] = {}
    for data in source.data:
        flights = [r for r in data.results.values() if "track" in r.data]
        if flights:
            first.setdefault(data.condition.scenario, (source.format_head(data), flights[0]))
    figure = source.figure
    return [
        FigureSpec(
            format_slug(scenario),
            f"{head}: {text} {figure.source}".rstrip(),
            partial(plot, result, figure.printed),
        )
        for scenario, (head, result) in first.items()
    ]
