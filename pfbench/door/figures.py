"""Figures and arrays of a study for Python: those of its page and its paper."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pfbench.cli.messages import require_choice
from pfbench.core.parameter_checks import require
from pfbench.report.board.curves import compute_error_norms
from pfbench.report.board.pack import build_pack
from pfbench.report.journal.figure_style import FigureSetting, find_page_format, line_style
from pfbench.report.journal.ratio_figures import draw_error_against_cost
from pfbench.report.journal.study_pack import Pack, filters_by_key
from pfbench.report.journal.time_figures import draw_coverage, draw_curves
from pfbench.report.options import ReportOptions
from pfbench.results.conditions import Condition
from pfbench.results.plotting import COLUMN, RC, format_axis_label

if TYPE_CHECKING:
    from pfbench.door.study import Study

_NAMES = ("scenario", "noise", "model")
_SETTING = FigureSetting(find_page_format(width="140mm"))


def draw_study(study: Study, kind: str, ax: Axes | None, choice: Mapping[str, Any]) -> Axes:
    """Draw a figure of one condition of a study."""
    drawings: dict[str, Callable[[Axes, Pack, Condition, Mapping[str, Any]], None]] = {
        "cost": _draw_cost,
        "time": _draw_time,
        "calibration": lambda axis, pack, *_: draw_coverage(axis, pack, _SETTING),
        "run": _draw_run,
    }
    require_choice("kind", kind, list(drawings))
    condition = select_condition(study.conditions(), choice)
    pack = build_pack(study.name, [condition], ReportOptions())
    with matplotlib.rc_context(RC):
        if ax is None:
            ax = Figure(figsize=(1.6 * COLUMN, 1.1 * COLUMN), layout="constrained").subplots()
        ax.set_title(condition.name)
        drawings[kind](ax, pack, condition, choice)
    return ax


def select_condition(conditions: Sequence[Condition], choice: Mapping[str, Any]) -> Condition:
    """Select the one condition that scenario, noise and model name."""
    chosen_names = {name: choice[name] for name in _NAMES if name in choice}
    matches = [c for c in conditions if all(getattr(c, n) == v for n, v in chosen_names.items())]
    if len(matches) != 1:
        listed = "; ".join(condition.name for condition in conditions)
        raise ValueError(
            f"scenario, noise and model must select one condition of the study, got {len(matches)} of: {listed}. "
            "Set scenario=..., noise=... or model=...."
        )
    return matches[0]


def _draw_cost(ax: Axes, pack: Pack, condition: Condition, choice: Mapping[str, Any]) -> None:
    """Draw the median error of each filter against its time per step."""
    require(
        any(row["ms"] for row in next(iter(pack["views"].values()))["rows"]),
        "a cost",
        "be a time after warm-up steps",
        "jobs of an earlier version without",
        f"Measure it: pfbench cost study={pack['study']}",
    )
    for name, style in draw_error_against_cost(ax, pack, _SETTING, "value"):
        ax.plot([], [], label=name, **style)
    ax.legend(ncols=2)


def _draw_time(ax: Axes, pack: Pack, condition: Condition, choice: Mapping[str, Any]) -> None:
    """Draw the median error of each filter over time."""
    looks, (curves,) = filters_by_key(pack), pack["curves"].values()
    for key in draw_curves(ax, curves, list(looks), looks):
        ax.plot([], [], label=looks[key]["name"], **line_style(looks[key]))
    ax.set(xlabel="time [s]", title=f"{condition.name}, median over runs")
    ax.set_ylabel(format_axis_label(curves["group"], curves["unit"]))
    ax.legend(ncols=2)


def _draw_run(ax: Axes, pack: Pack, condition: Condition, choice: Mapping[str, Any]) -> None:
    """Draw the error of one run of each filter, or of one filter, over time."""
    number, looks = int(choice.get("run", 0)), filters_by_key(pack)
    labels = [job.label for job in condition.jobs if choice.get("filter") in (None, job.label)]
    results = {job.label: job.load() for job in condition.jobs if job.label in labels}
    for label, norm in compute_error_norms(results).items():
        first = int(results[label].meta.get("first_run", 0))
        require(
            first <= number < first + len(norm),
            "run",
            f"be a run of {label}",
            number,
            f"Set run={first}.",
        )
        style = {**line_style(looks[label]), "marker": ""}
        ax.plot(
            results[label].data["time"], norm[number - first], label=looks[label]["name"], **style
        )
    (curves,) = pack["curves"].values()
    ax.set(xlabel="time [s]", title=f"{condition.name}, run {number}")
    ax.set_ylabel(format_axis_label(curves["group"], curves["unit"]))
    ax.legend(ncols=2)


def make_dataset(conditions: Sequence[Condition]) -> Any:
    """Return errors, variances and traces of all jobs as a data set of xarray, with the axes condition, filter, run, time, state."""
    try:
        import xarray
    except ModuleNotFoundError as error:
        raise ValueError(
            "xarray must be installed for to_xarray, got none. Run pip install xarray"
        ) from error
    joined = []
    for condition in conditions:
        sets = []
        for job in condition.jobs:
            result = job.load()
            data, state = result.data, result.meta["state"]
            runs = int(result.meta.get("first_run", 0)) + np.arange(len(data["lost"]))
            axes = ("run", "time", "state")
            values: dict[str, Any] = {
                "error": (axes, data["error"]),
                "variance": (axes, np.square(data["sd"])),
            }
            shape = data["error"].shape[:2]
            traces = {
                k: (axes[:2], v) for k, v in data.items() if v.shape == shape and k not in values
            }
            coordinates = {
                "run": runs, "time": data["time"], "state": list(state["names"]),
                "unit": ("state", list(state["units"])),
            }  # fmt: skip
            values |= {"lost": (("run",), data["lost"]), **traces}
            dataset = xarray.Dataset(values, coordinates).expand_dims(filter=[job.label])
            sets.append(dataset.assign_coords(key=("filter", [str(job.meta["key"])])))
        joined.append(
            xarray.concat(sets, "filter", join="outer").expand_dims(condition=[condition.name])
        )
    first = conditions[0].jobs[0].meta
    attributes = {
        "study": first["study"],
        "seed": first["seed"],
        "version": first["versions"]["pfbench"],
    }
    return xarray.concat(joined, "condition", join="outer").assign_attrs(attributes)
