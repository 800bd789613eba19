"""Figures of the flight of a paper: the true track from above, its height and its velocity."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from matplotlib.figure import Figure

from pfbench.report.plots.figure_files import FigureSpec
from pfbench.report.plots.paper.paper_specs import PaperFigureInput
from pfbench.report.plots.plotting import COLUMN, format_slug
from pfbench.results import store
from pfbench.results.frame import select_indices

_COLOUR = "#0b4f8a"
_AXES = ("East", "North", "Up")
_KILOMETRE = 1e3


def plot_flight(result: store.JobResult) -> Figure:
    """Plot the true track of the first run from above, and its height over time.

    Args:
        result: Result with the track of the truth.
    """
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
    """Plot the velocity of the first run, from differences of its true positions.

    Args:
        result: Result with the track of the truth.
    """
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
    """Return the figure of the flight of each scenario.

    Args:
        source: Figure and its data.
    """
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
    """Return the figure of the velocity of each scenario.

    Args:
        source: Figure and its data.
    """
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
