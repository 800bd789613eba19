"""Figures and arrays of a study for Python, in the looks of the report."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pfbench.core.parameter_checks import require
from pfbench.results.conditions import Condition, main_component_group
from pfbench.results.frame import list_main_groups
from pfbench.results.looks import study_looks
from pfbench.results.plotting import (
    COLUMN,
    RC,
    LineStyle,
    compute_run_quantiles,
    format_axis_label,
    line_styles,
    use_log_if_wide,
)
from pfbench.results.step_times import STEP_TIME, WARM_UP

if TYPE_CHECKING:
    import pandas as pd

    from pfbench.door.study import Study

_NAMES = ("scenario", "noise", "model")


def draw_study(study: Study, kind: str, ax: Axes | None, choice: Mapping[str, Any]) -> Axes:
    """Draw a figure of one condition of a study."""
    drawings: dict[str, Callable[[Axes, _Scene], None]] = {
        "cost": _draw_cost,
        "time": _draw_time,
        "calibration": _draw_calibration,
        "run": _draw_run,
    }
    require(
        kind in drawings,
        "kind",
        f"be one of {', '.join(drawings)}",
        f"{kind!r}",
        "Choose one of them.",
    )
    scene = _Scene(study, select_condition(study.conditions(), choice), choice)
    with matplotlib.rc_context(RC):
        if ax is None:
            ax = Figure(figsize=(1.6 * COLUMN, 1.1 * COLUMN), layout="constrained").subplots()
        drawings[kind](ax, scene)
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


class _Scene:
    """Condition of a study that is drawn.

    Attributes:
        study: Study.
        condition: Condition.
        choice: Choices of the user.
    """

    def __init__(self, study: Study, condition: Condition, choice: Mapping[str, Any]) -> None:
        self.study, self.condition, self.choice = study, condition, choice
        self.group = main_component_group(condition.jobs[0].meta["state"])
        labels = [job.label for job in condition.jobs]
        self.styles: dict[str, LineStyle] = line_styles(labels, study_looks([condition]))
        self.looks = study_looks([condition])

    def rows(self, metric: str, component: str = "norm") -> pd.DataFrame:
        """Return the rows of a metric of the main group, of this condition."""
        frame = self.study.table(metric)
        for name in _NAMES:
            frame = frame[frame[name] == getattr(self.condition, name)]
        group = next(iter(list_main_groups([self.condition]).values()))
        return frame[(frame["group"] == group) & (frame["component"] == component)]

    def name(self, label: str) -> str:
        """Return the name of a filter for a reader."""
        return self.looks[label].name


def _draw_cost(ax: Axes, scene: _Scene) -> None:
    """Draw the error of each filter, geometric mean over runs that keep track with 95 % interval, against its cost."""
    rows = scene.rows("rmse")
    by_label = {job.label: job.meta for job in scene.condition.jobs}
    require(
        all({WARM_UP, STEP_TIME} & {*meta, *meta["seconds"]} for meta in by_label.values()),
        "a cost",
        "be a time after warm-up steps",
        "jobs of an earlier version without",
        f"Measure it: pfbench cost study={scene.study.name}",
    )
    costs = {
        label: 1e3 * float(meta.get(STEP_TIME, {}).get("median", meta["seconds"]["per_step"]))
        for label, meta in by_label.items()
    }
    for label, of_label in rows.groupby("label", observed=True, sort=False):
        values = of_label.loc[of_label["keeps_track"], "value"].to_numpy(dtype=float)
        logs = np.log(values[values > 0])
        if not logs.size:
            continue
        style, half = scene.styles[str(label)], 0.0
        if logs.size > 1:
            half = 1.96 * float(logs.std(ddof=1)) / np.sqrt(logs.size)
        mean = float(np.exp(logs.mean()))
        ends = [[mean - mean * np.exp(-half)], [mean * np.exp(half) - mean]]
        ax.errorbar(costs[str(label)], mean, ends, color=style.colour, capsize=2, **style.mark())
        ax.annotate(f"  {scene.name(str(label))}", (costs[str(label)], mean), fontsize=6.5)
    ax.set(xscale="log", xlabel="time per step [ms]", title=scene.condition.name)
    ax.set_ylabel(format_axis_label(f"RMSE {scene.group.group}", scene.group.unit))
    use_log_if_wide(ax, ax.yaxis, [rows["value"].to_numpy(dtype=float)])


def _draw_time(ax: Axes, scene: _Scene) -> None:
    """Draw the median error of each filter over time."""
    curves = []
    for job in scene.condition.jobs:
        data, style = job.load().data, scene.styles[job.label]
        norm = np.linalg.norm(data["error"][..., scene.group.places], axis=-1) * scene.group.scale
        curves.append(compute_run_quantiles(norm[~data["lost"].astype(bool)], [0.5])[0])
        ax.plot(data["time"], curves[-1], **style.line(scene.name(job.label)))
    ax.set(xlabel="time [s]", title=f"{scene.condition.name}, median over runs")
    ax.set_ylabel(format_axis_label(scene.group.group, scene.group.unit))
    use_log_if_wide(ax, ax.yaxis, curves)
    ax.legend(ncols=2)


def _draw_calibration(ax: Axes, scene: _Scene) -> None:
    """Draw the share of true values in the 90 % intervals of each filter."""
    rows = scene.rows("coverage_90", "mean")
    means = rows.groupby("label", observed=True, sort=False)["value"].mean()
    for k, (label, value) in enumerate(means.items()):
        style = scene.styles[str(label)]
        ax.plot(100 * value, k, ls="", **style.mark())
    ax.axvline(90, color="0.45", lw=0.7)
    ax.set_yticks(range(len(means)), [scene.name(str(label)) for label in means.index])
    ax.set(xlabel="true values in 90 % intervals [%]", title=scene.condition.name, xlim=(0, 100))


def _draw_run(ax: Axes, scene: _Scene) -> None:
    """Draw the error of one run of each filter, or of one filter, over time."""
    number = int(scene.choice.get("run", 0))
    selected_label = scene.choice.get("filter")
    for job in scene.condition.jobs:
        data, style = job.load().data, scene.styles[job.label]
        index = number - int(job.meta.get("first_run", 0))
        if not 0 <= index < len(data["lost"]):
            raise ValueError(
                f"run must be a run of {job.label}, got {number}. Set run={job.meta.get('first_run', 0)}."
            )
        if selected_label in (None, job.label):
            norm = np.linalg.norm(data["error"][index][:, scene.group.places], axis=-1)
            ax.plot(data["time"], norm * scene.group.scale, **style.line(scene.name(job.label)))
    ax.set(xlabel="time [s]", title=f"{scene.condition.name}, run {number}")
    ax.set_ylabel(format_axis_label(scene.group.group, scene.group.unit))
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
