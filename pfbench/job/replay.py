"""Replay of one stored run with all its traces: selection, computation, agreement, figure and files."""

from __future__ import annotations

import copy
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pfbench.core.parameter_checks import require
from pfbench.files.escapes import escape_csv
from pfbench.files.recorded_folder import RecordedFolder
from pfbench.job.computation import compute_job
from pfbench.job.config import CHOICES, JobConfig
from pfbench.job.inputs import CODE_OF, find_inputs
from pfbench.job.plan import build_plan
from pfbench.job.trust import require_allowed, trusted_packages
from pfbench.results import store
from pfbench.results.conditions import (
    Condition,
    JobFile,
    load_conditions,
    main_component_group,
    parse_label,
)
from pfbench.results.frame import to_long_rows
from pfbench.results.inputs import list_changed
from pfbench.results.joined_runs import select_run
from pfbench.results.plotting import (
    FigureSpec,
    draw_figure,
    format_axis_label,
    format_slug,
    stacked_axes,
    use_log_if_wide,
)
from pfbench.results.status import count_statuses, divergence_threshold
from pfbench.results.store import Inputs
from pfbench.stats.study_runs import natural_sort_key

_SCORES = ("crps", "pit", "energy_score", "nis", "nis_dof")
_ENGINES = ("kernels", "tape", "compiled")  # engines that a job may have used; the others are eager


class StoredRun(NamedTuple):
    """A stored run.

    Attributes:
        condition: Condition of the job.
        job: Job of the run.
        run: Number of the run.
        result: Metadata of the job, and its arrays with this run alone.
    """

    condition: Condition
    job: JobFile
    run: int
    result: store.JobResult


def find_run(
    study: str, results: str | Path, run: int, label: str, choices: Mapping[str, str]
) -> StoredRun:
    """Find one run of a study by its number, its filter, and the names of scenario, noise and model, with or without their settings."""
    conditions: Sequence[Condition] = load_conditions(study, results, allow_mixed_versions=True)
    for group, value in choices.items():
        names = {str(getattr(condition, group)): condition for condition in conditions}
        conditions = [
            c for c in conditions if value in (getattr(c, group), parse_label(getattr(c, group))[0])
        ]
        require(
            conditions,
            group,
            f"be one of the study {study}",
            value,
            f"Choose from {_list_names(names)}.",
        )
    labels = {job.label for condition in conditions for job in condition.jobs}
    matches = [
        (condition, job)
        for condition in conditions
        for job in condition.jobs
        if label in (job.label, job.meta["choices"]["filter"])
    ]
    require(
        matches,
        "filter",
        f"be a filter of the study {study}",
        label,
        f"Choose from {_list_names(labels)}.",
    )
    _check_single(matches, label)
    condition, job = matches[0]
    result = job.load()
    first = int(result.meta.get("first_run", 0))
    numbers = np.asarray(result.data.get("run", first + np.arange(result.data["lost"].size)))
    require(
        run in numbers, "run", f"be a run of {job.label}, {numbers.min()} to {numbers.max()}", run, f"Set run={numbers.min()}."
    )  # fmt: skip
    return StoredRun(condition, job, run, select_run(result, int(np.argmax(numbers == run))))


def _check_single(matches: Sequence[tuple[Condition, JobFile]], label: str) -> None:
    """Raise ValueError if several jobs match."""
    labels = {job.label for _, job in matches}
    conditions = {condition.name: condition for condition, _ in matches}
    is_single = len(matches) == 1 or len(conditions) > 1
    require(
        is_single,
        "filter",
        "name one job",
        f"{label} with {len(labels)} settings",
        f"Choose from {_list_names(labels)}.",
    )
    names = {
        g: {str(getattr(c, g)) for c in conditions.values()} for g in ("scenario", "noise", "model")
    }
    several = {group: values for group, values in names.items() if len(values) > 1}
    if several:
        advice = ", ".join(
            f"{group}=... ({_list_names(values)})" for group, values in several.items()
        )
        raise ValueError(
            f"{' and '.join(several)} must be set, since {label} has results in {len(conditions)} conditions. Add {advice}."
        )


def _list_names(names: Iterable[str]) -> str:
    """Format names in natural order."""
    return ", ".join(sorted(names, key=natural_sort_key))


def replay_config(stored: StoredRun, changes: Mapping[str, Any]) -> JobConfig:
    """Return the configuration that computes one run of a stored job."""
    meta = stored.result.meta
    one_run = {"first_run": stored.run, "runs": 1, "score_steps": int(meta["steps"])}
    return stored_config(meta, stored.job.path, {**one_run, **changes})


def stored_config(meta: Mapping[str, Any], path: Path, changes: Mapping[str, Any]) -> JobConfig:
    """Return the configuration of a stored job.

    All settings that affect the numbers are those of the job. A number of particles that a budget chose is
    set as such, so that nothing is measured again.
    """
    parts = ("scenario", "noise", "filter", "model")
    values = copy.deepcopy(meta["config"])
    require(
        all(isinstance(values.get(name), Mapping) for name in parts),
        "study",
        "have results of pfbench run",
        f"results without {', '.join(parts)} in {path}",
        "Choose another study.",
    )
    values |= {
        "pcrb": False,
        "engine": meta["engine"] if meta.get("engine") in _ENGINES else "eager",
        "memory_limit_gib": None,
        "budget": store.SAME_N,
        **changes,
    }
    if meta.get("budget_allocation"):
        values["filter"]["particles"] = meta["particles"]
    places = {"root": values["data"]["root"], "cache_dir": values["episode_cache_dir"]}
    places |= {"checkpoint": changes["checkpoint"]} if "checkpoint" in changes else {}
    for name in parts:
        _replace_places(values[name], places, path.parents[1])
    trusted = trusted_packages()
    packages = meta.get("trusted", [])
    require_allowed(
        set(packages) <= set(trusted),
        "trust",
        f"name the packages whose classes the run used, {', '.join(packages)}",
        f"trust=[{','.join(trusted)}]" if trusted else "none of them",
        f"Nothing was run. If you still trust them, add trust=[{','.join(packages)}] to the command.",
    )
    return JobConfig(
        values, {group: str(meta["choices"][group]) for group in CHOICES}, trusted=trusted
    )


def describe_changed_code(meta: Mapping[str, Any]) -> str:
    """Describe a change of a user's classes since a stored job; empty without one."""
    if not meta.get("trusted"):
        return ""
    changed = _list_changed_inputs(meta, find_inputs(meta["config"], trusted_packages()))
    code = [name for name in changed if name.startswith(CODE_OF)]
    if not code:
        return ""
    return f"the {' and the '.join(code)} has changed since {meta['label']} was run: its numbers may differ"


def _list_changed_inputs(meta: Mapping[str, Any], present: Inputs) -> list[str]:
    """List the inputs of a job that have other content now, for people."""
    return list_changed(meta["inputs"], present) if present and "inputs" in meta else []


def _replace_places(node: Any, places: Mapping[str, str | None], results: Path) -> None:
    """Set the folders of a stored configuration, which may be of another person, and check its weights."""
    keys: Any = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()  # fmt: skip
    for key, value in keys:
        if key in places and isinstance(value, str):
            node[key] = places[key]
        elif key == "checkpoint" and isinstance(value, str):
            is_below = Path(value).resolve().is_relative_to(results.resolve())
            require_allowed(
                is_below or value == "untrained",
                "checkpoint",
                f"be a file below {results}, since a result names it",
                value,
                f"Nothing was opened. If it is yours, add checkpoint={value} to the command.",
            )
        else:
            _replace_places(value, places, results)


def recompute_run(stored: StoredRun, changes: Mapping[str, Any]) -> store.JobResult:
    """Compute one stored run again."""
    config = replay_config(stored, changes)
    present = find_inputs(config.values, config.trusted)
    changed = _list_changed_inputs(stored.result.meta, present)
    # another code of a user's classes is printed, since it may be a mended message
    files = [name for name in changed if not name.startswith(CODE_OF)]
    require(
        not files,
        " and ".join(files),
        "be as it was when the result was computed",
        "other content",
        "Run the job again, and replay the new result.",
    )
    choices = {group: config.choices[group] for group in CHOICES}
    title = " / ".join(choices[group] for group in ("scenario", "noise", "filter"))
    plan, size = build_plan(config), len(stored.result.data["time"])
    steps = round(getattr(plan.scenario, "steps", 0)) or size
    require(
        steps == size,
        "the scenario of a stored result",
        f"have its {size} steps",
        steps,
        "The file is damaged or made to take hours: run the job again.",
    )
    meta, outputs = compute_job(plan, f"{title}, run {stored.run}")
    head = {"key": stored.job.path.stem, "study": stored.job.path.parent.name}
    full = {**head, "choices": choices, "config": config.values, **meta}
    return store.JobResult(full, outputs)


def select_stored_scores(result: store.JobResult, stored: store.JobResult) -> store.JobResult:
    """Select the scores of a replay at the steps at which the stored run was scored.

    Returns the replay with the arrays of scores that the stored run has.
    """
    steps = stored.data.get("score_steps")
    data = {k: v for k, v in result.data.items() if k not in (*_SCORES, "score_steps")}
    if steps is not None:
        index = np.searchsorted(result.data["score_steps"], steps)
        data |= {k: result.data[k][:, index] for k in _SCORES if k in result.data}
        data["score_steps"] = np.asarray(steps)
    return store.JobResult(result.meta, data)


AGREEING_DIGITS = (
    4  # significant digits from which two runs are the same run with other rounding [ours]
)
_SHARED = ("time", "pcrb", "range", "score_steps")


class ArrayAgreement(NamedTuple):
    """Agreement of an array.

    Attributes:
        name: Name of the array.
        digits: Common significant digits, relative to the largest value of each component; infinite if
            all numbers are equal.
        time_s: Time of the first number that differs in the first four digits, NaN without one.
    """

    name: str
    digits: float
    time_s: float

    @property
    def agrees(self) -> bool:
        """Agreement of the first four digits."""
        return self.digits >= AGREEING_DIGITS


def compare_runs(stored: store.JobResult, replayed: store.JobResult) -> list[ArrayAgreement]:
    """Compare the arrays of two results of one run.

    Returns Agreement of each array that both have, those that differ most first.
    """
    rows = []
    for name in stored.data:
        if name in _SHARED or name not in replayed.data:
            continue
        a = np.asarray(stored.data[name][0], dtype=np.float64)
        b = np.asarray(replayed.data[name][0], dtype=np.float64)
        time = stored.data["time"]
        times = time[stored.data["score_steps"]] if name in _SCORES else time
        rows.append(_compare_array(name, a, b, times if a.ndim else None))
    return sorted(rows, key=lambda row: row.digits)


def describe_agreement(rows: list[ArrayAgreement]) -> str:
    """Describe the agreement of all arrays in one or two sentences."""
    worst = rows[0]
    if math.isinf(worst.digits):
        return f"All {len(rows)} stored arrays are equal in every digit."
    if worst.agrees:
        return (
            f"The stored numbers agree to {worst.digits:.0f} significant digits or more; least: "
            f"{worst.name}."
        )
    differing = [row for row in rows if not row.agrees]
    times = [row.time_s for row in differing if not math.isnan(row.time_s)]
    since = f", from {min(times):.6g} s on" if times else ""
    names = ", ".join(row.name for row in differing)
    return (
        f"The stored numbers do not agree: {names} differ in the first {AGREEING_DIGITS} digits{since}. "
        "Another version of pfbench or of a library, another processor or another engine can be the reason."
    )


def _compare_array(
    name: str, a: np.ndarray, b: np.ndarray, times: np.ndarray | None
) -> ArrayAgreement:
    """Compare two arrays [T, ...] or numbers."""
    if a.shape != b.shape:
        return ArrayAgreement(name, 0.0, math.nan)
    a, b = np.atleast_1d(a), np.atleast_1d(b)
    same = (a == b) | (np.isnan(a) & np.isnan(b))
    if same.all():
        return ArrayAgreement(name, math.inf, math.nan)
    finite = np.where(np.isfinite(a), np.abs(a), 0.0)
    scale = finite.max(axis=0, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        relative = np.where(same, 0.0, np.abs(a - b) / scale)
    relative = np.where(np.isnan(relative), np.inf, relative)  # only one of both is missing
    worst = float(relative.max())
    digits = math.floor(-math.log10(worst)) if 0.0 < worst < 1.0 else 0
    first = math.nan
    if times is not None:
        rows = (relative > 10.0**-AGREEING_DIGITS).reshape(len(relative), -1).any(axis=1)
        first = float(times[np.argmax(rows)]) if rows.any() else math.nan
    return ArrayAgreement(name, float(digits), first)


_NOT_TRACES = (
    "time",
    "error",
    "sd",
    "nees",
    "track",
    "pcrb",
    "range",
    "score_steps",
    "log_evidence",
)
_SCORED = ("nis", "nis_dof")
_COLOUR, _GREY = "#0072B2", "0.45"


def tabulate_traces(result: store.JobResult) -> pd.DataFrame:
    """Build the table of all traces of a run, a row per step.

    Returns time [s], error and sd of each component in its SI unit, and NEES of each group. The
    traces of the filter such as ess, the NIS and the true track [m] follow.
    """
    data, state = result.data, result.meta["state"]
    columns: dict[str, Any] = {"time [s]": data["time"]}
    for kind in ("error", "sd"):
        for i, (name, unit) in enumerate(zip(state["names"], state["units"], strict=True)):
            columns[format_axis_label(f"{kind} {name}", unit)] = data[kind][0, :, i]
    for i, group in enumerate(state["groups"]):
        columns[f"NEES {group}"] = data["nees"][0, :, i]
    shape = (1, data["time"].size)
    for name, values in data.items():
        if name not in (*_NOT_TRACES, *_SCORED) and values.shape == shape:
            columns[name] = values[0]
    for name in _SCORED:
        if name in data and "score_steps" in data:
            columns[name] = np.full(shape[1], np.nan)
            columns[name][data["score_steps"]] = data[name][0]
    if "track" in data:
        for i, axis in enumerate(("East", "North", "Up")):
            columns[f"track {axis} [m]"] = data["track"][0, :, i]
    return pd.DataFrame(columns)


def plot_traces(result: store.JobResult) -> Figure:
    """Plot a run: error of the main group with its bounds, NIS, effective sample size, and the track."""
    data = result.data
    has_ess = "ess" in data and data["ess"].shape == (1, data["time"].size)
    panels = ["error", *(["NIS"] if "nis" in data else []), *(["ESS"] if has_ess else [])]
    heights = len(panels) + ("track" in data)
    figure, axes = stacked_axes(heights, 1.45, sharex=False)
    drawing = {"error": _plot_error, "NIS": _plot_nis, "ESS": _plot_ess}
    for panel, axis in zip(panels, axes, strict=False):
        drawing[panel](axis, result)
        axis.set_xlim(*data["time"][[0, -1]])
    axes[len(panels) - 1].set_xlabel("time [s]")
    if "track" in data:
        _plot_track(axes[-1], result)
    return figure


def _plot_error(axis: Axes, result: store.JobResult) -> None:
    """Plot the norm of the error of the main group, and the norm of its standard deviations."""
    group, time = main_component_group(result.meta["state"]), result.data["time"]
    error = (
        np.linalg.norm(result.data["error"][0][:, group.places].astype(float), axis=-1)
        * group.scale
    )
    sd = np.linalg.norm(result.data["sd"][0][:, group.places].astype(float), axis=-1) * group.scale
    axis.plot(time, error, color=_COLOUR, label="error")
    axis.plot(time, sd, color=_GREY, ls="--", label="standard deviation of the filter")
    limit = divergence_threshold(result.meta)
    values = np.concatenate([error, sd])
    if limit is not None and np.nanmax(values) > 0.3 * limit * group.scale:
        axis.axhline(limit * group.scale, color=_GREY, lw=0.7, label="divergence threshold")
    use_log_if_wide(axis, axis.yaxis, [error, sd])
    axis.set_ylabel(format_axis_label(group.group, group.unit))
    axis.legend(loc="upper right", fontsize=6.5)


def _plot_nis(axis: Axes, result: store.JobResult) -> None:
    """Plot the NIS per observed component, whose expectation is 1."""
    nis, dof = (np.asarray(result.data[name][0], np.float64) for name in _SCORED)
    time = result.data["time"][result.data["score_steps"]]
    mean = np.divide(nis, dof, out=np.full_like(nis, np.nan), where=dof > 0)
    axis.plot(time, mean, ".", ms=2, color=_COLOUR)
    axis.axhline(1.0, color=_GREY, lw=0.7)
    use_log_if_wide(axis, axis.yaxis, [mean])
    axis.set_ylabel("NIS / components")


def _plot_ess(axis: Axes, result: store.JobResult) -> None:
    """Plot the effective sample size as a share of the particles."""
    ess = np.asarray(result.data["ess"][0], np.float64)
    axis.plot(result.data["time"], ess, color=_COLOUR, lw=0.8)
    axis.set_ylim(0.0, None)
    axis.set_ylabel("ESS")


def _plot_track(axis: Axes, result: store.JobResult) -> None:
    """Plot the true track on the plane and the estimate, with errors magnified where they are small."""
    track = np.asarray(result.data["track"][0], np.float64)[:, :2] / 1e3
    axis.plot(*track.T, color=_GREY, lw=0.9, label="truth")
    names = list(result.meta["state"]["names"])
    horizontal = ["position_E", "position_N"]
    if all(name in names for name in horizontal):
        error = result.data["error"][0][:, [names.index(name) for name in horizontal]] / 1e3
        factor = magnification(track, error)
        text = "estimate" if factor == 1 else f"estimate, errors magnified {factor} times"
        axis.plot(*(track + factor * error).T, color=_COLOUR, lw=0.8, label=text)
    axis.set_aspect("equal", adjustable="datalim")
    axis.set(xlabel="East [km]", ylabel="North [km]")
    axis.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, fontsize=6.5)


def magnification(track: np.ndarray, error: np.ndarray) -> int:
    """Return the power of ten that magnifies errors enough to be visible.

    Shapes: track [T, 2], error [T, 2].
    """
    extent = float(np.ptp(track, axis=0).max())
    size = float(np.nanmedian(np.linalg.norm(error, axis=-1))) if np.isfinite(error).any() else 0.0
    if not 0.0 < size < 0.005 * extent:
        return 1
    return int(10 ** np.floor(np.log10(0.05 * extent / size)))


def write_replay(stored: StoredRun, result: store.JobResult, reports: str | Path) -> list[Path]:
    """Write the files of a replay to `<reports>/<study>/replay/<condition>_<filter>_run_<number>/`.

    Returns traces.csv, traces.parquet if pyarrow is installed, and traces.svg.
    """
    condition = stored.condition
    names = (condition.scenario, condition.noise, condition.model, stored.job.label)
    name = format_slug(f"{'_'.join(names)}_run_{stored.run}")
    folder = Path(reports) / str(result.meta["study"]) / "replay" / name
    table = tabulate_traces(result)
    drawing = FigureSpec("traces", "", lambda: plot_traces(result))
    with RecordedFolder(folder) as target:
        paths = [target.write("traces.csv", table.rename(columns=escape_csv).to_csv(index=False))]
        if find_spec("pyarrow"):
            buffer = io.BytesIO()
            table.to_parquet(buffer, index=False)
            paths.append(target.write("traces.parquet", buffer.getvalue()))
        paths.append(target.write("traces.svg", draw_figure(drawing, ("svg",))["svg"]))
    return paths


def tabulate_metrics(
    stored: StoredRun, replayed: store.JobResult
) -> list[tuple[str, float, float, str]]:
    """List the metrics of a run, as stored and as computed again.

    Returns name, stored value, new value and unit: errors of each group, and metrics of the filter.
    """
    old, new = (
        to_long_rows(stored.condition, stored.job, result, 0.0, {})
        for result in (stored.result, replayed)
    )
    rows = []
    both = new.merge(old, on=["metric", "group", "component"], suffixes=("", "_stored"))
    for row in both.to_dict("records"):
        is_error = row["metric"] in ("rmse", "max_error") and row["component"] == "norm"
        if (is_error or not row["group"]) and row["metric"] != "seconds_per_step":
            name = f"{row['metric']} {row['group']}".strip()
            rows.append((name, float(row["value_stored"]), float(row["value"]), str(row["unit"])))
    return rows


def describe_status(result: store.JobResult) -> str:
    """Describe the status of a run, such as "track kept, overconfident"."""
    count = count_statuses(result.data, result.meta)
    words = {
        "lost": count.lost,
        "diverged": count.diverged or 0,
        "collapsed": count.collapsed,
        "severely overconfident": count.severely_overconfident,
        "overconfident": count.overconfident and not count.severely_overconfident,
        **count.marked,
    }
    present = [word for word, number in words.items() if number]
    if count.lost or count.diverged:
        return ", ".join(present)
    ending = "no divergence threshold" if count.diverged is None else "track kept"
    return ", ".join([ending, *present])
