"""Figures and arrays of a study for Python: those of its page and its paper."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
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
from pfbench.results.conditions import Condition, JobFile
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
    listed = "; ".join(condition.name for condition in conditions)
    require(
        len(matches) == 1,
        "scenario, noise and model",
        "select one condition of the study",
        f"{len(matches)} of: {listed}",
        "Set scenario=..., noise=... or model=....",
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
    _label_time(ax, curves, f"{condition.name}, median over runs")


def _label_time(ax: Axes, curves: Mapping[str, Any], title: str) -> None:
    """Label a figure of errors over time."""
    ax.set(xlabel="time [s]", title=title)
    ax.set_ylabel(format_axis_label(curves["group"], curves["unit"]))
    ax.legend(ncols=2)


def _draw_run(ax: Axes, pack: Pack, condition: Condition, choice: Mapping[str, Any]) -> None:
    """Draw the error of one run of each filter, or of one filter, over time."""
    number, looks = int(choice.get("run", 0)), filters_by_key(pack)
    jobs = [job for job in condition.jobs if choice.get("filter") in (None, job.label)]
    results = {job.label: job.load() for job in jobs}
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
    _label_time(ax, curves, f"{condition.name}, run {number}")


def make_dataset(conditions: Sequence[Condition]) -> Any:
    """Return errors, variances and traces of all jobs as a data set of xarray, with the axes condition, filter, run, time, state."""
    is_installed = find_spec("xarray") is not None
    require(is_installed, "xarray", "be installed for to_xarray", "none", "Run pip install xarray")
    import xarray

    joined = [
        xarray.concat(map(_make_job_set, c.jobs), "filter", join="outer").expand_dims(condition=[c.name])
        for c in conditions
    ]  # fmt: skip
    first = conditions[0].jobs[0].meta
    attributes = {name: first[name] for name in ("study", "seed")}
    attributes["version"] = first["versions"]["pfbench"]
    return xarray.concat(joined, "condition", join="outer").assign_attrs(attributes)


def _make_job_set(job: JobFile) -> Any:
    """Return the arrays of a job as a data set of xarray."""
    import xarray

    result = job.load()
    data, state, axes = result.data, result.meta["state"], ("run", "time", "state")
    shape = data["error"].shape[:2]
    values = {
        "error": (axes, data["error"]),
        "variance": (axes, np.square(data["sd"])),
        "lost": (axes[:1], data["lost"]),
        **{name: (axes[:2], value) for name, value in data.items() if value.shape == shape},
    }
    coordinates = {
        "run": int(result.meta.get("first_run", 0)) + np.arange(len(data["lost"])),
        "time": data["time"],
        "state": list(state["names"]),
        "unit": ("state", list(state["units"])),
    }
    dataset = xarray.Dataset(values, coordinates).expand_dims(filter=[job.label])
    return dataset.assign_coords(key=("filter", [str(job.meta["key"])]))
