"""A study as one tidy table: what ran, on which run of which world, how far off it was."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from pfbench import metrics, store

# The one door from SI to what people read.
_DISPLAY = {
    "rad": ("arcmin", 60 * 180 / np.pi),
    "rad/s": ("deg/h", 3600 * 180 / np.pi),
    "m/s^2": ("mg", 1e3 / 9.80665),
}

COVERAGES = (50, 90, 99)  # per cent of the central regions
_WORLD = ("scenario", "noise", "dtype")  # parts of a job's configuration that decide what a filter meets
_PLACES = ("scenario.cache", "scenario.root")  # and do not
_COUNTED = ("ess", "ancestors", "unique")  # of particles
_SCORES = ("crps", "pit", "energy", "nis", "nis_dof")


class Job(NamedTuple):
    """One file of a cell; its arrays are read when asked for.

    Attributes:
        path: the file.
        label: the filter's name, with what sets it apart where a cell holds the filter more than once.
        meta: see `store.Result`.
    """

    path: Path
    label: str
    meta: dict[str, Any]

    def load(self) -> store.Result:
        return store.load(self.path)


class Cell(NamedTuple):
    """All filters that saw the same worlds."""

    scenario: str
    noise: str
    model: str
    jobs: tuple[Job, ...]

    @property
    def name(self) -> str:
        return f"{self.scenario} / {self.noise} / {self.model}"


class Block(NamedTuple):
    """Components of one unit whose error has a norm.

    Attributes:
        group: name; a group of mixed units is cut by unit, as "clock [m]" and "clock [m/s]".
        whole: the group that it is or is cut from; NEES is of that.
        places: of the components in the state.
        components: names.
        unit: the unit shown.
        scale: from SI to the unit shown.
    """

    group: str
    whole: str
    places: list[int]
    components: list[str]
    unit: str
    scale: float


def frame(
    study: str,
    results: str | Path = "results",
    *,
    from_time: float = 0.0,
    mixed: bool = False,
    converged: Mapping[str, float] | None = None,
) -> pd.DataFrame:
    """Every figure of every run of a study, one per row.

    Args:
        study: name of the folder in `results`.
        results: folder of all studies.
        from_time: leave out what came before, seconds.
        mixed: accept files of several versions, and several seeds, runs or lengths within a cell.
        converged: bounds by group in the unit shown; adds the metric "converged", seconds.

    Returns:
        Columns study, key, scenario, noise, model, filter, label, particles, seed, run, lost, group, component, unit,
        metric, value. Metrics: rmse (each component, and "norm" of the group), max_error, nees; ess, ancestors and unique
        (shares of the particles: effective, copied at a refresh, different after it and its moves), iterations (of a swarm),
        log_evidence, seconds_per_step, converged; and of jobs that were scored nis (per component seen), crps (each component,
        and "mean" of the group), energy, and coverage_50, _90, _99, the share of truths in the central regions of these per
        cents. A lost run has infinite errors and scores, and NaN elsewhere.

    Raises:
        FileNotFoundError: the study has no result; the message says which studies have.
        ValueError: files that do not belong together; the message names them.
    """
    study_cells = cells(study, results, mixed=mixed)
    parts = [tidy(cell, job, job.load(), from_time, converged or {}) for cell in study_cells for job in cell.jobs]
    return pd.concat(parts, ignore_index=True)


def cells(study: str, results: str | Path = "results", *, mixed: bool = False) -> list[Cell]:
    """The cells of a study, by scenario, noise and model; arguments and errors as `frame`."""
    folder = Path(results) / study
    found = [(path, store.describe(path)) for path in sorted(folder.glob("*.npz"))]
    if not found:
        raise FileNotFoundError(_nothing(study, Path(results)))
    if not mixed:
        _one(found, ("versions.pfbench", "versions.commit"), "the study")
    found.sort(key=lambda item: (_cell(item[1]), item[1]["label"], item[1]["seed"], item[1]["key"]))
    together = [list(items) for _, items in groupby(found, key=lambda item: _cell(item[1]))]
    if not mixed:
        for items in together:
            where = f"the cell {' / '.join(_cell(items[0][1]))}"
            _one(items, ("seed", "first_run", "runs", "steps"), where)
            _one(items, [f"config.{name}" for name in untold(_labelled(items))], where)
    return [Cell(*_cell(items[0][1]), _labelled(items)) for items in together]


def differing(jobs: Sequence[Job]) -> list[str]:
    """Settings of scenario, noise regime and number type in which the jobs of a cell differ, though the names are the same."""
    flat = [_flat({name: job.meta["config"].get(name) for name in _WORLD}) for job in jobs]
    names = sorted(set().union(*flat) - set(_PLACES))
    return [name for name in names if len({repr(one.get(name)) for one in flat}) > 1]


def untold(jobs: Sequence[Job]) -> list[str]:
    """Those that not every label tells: filters that differ in them did not meet the same worlds, and nobody would see it."""
    return [name for name in differing(jobs) if not all(f"{name}=" in job.label for job in jobs)]


def blocks(state: Mapping[str, Any]) -> list[Block]:
    """The groups of a state, `meta["state"]`, in the units shown."""
    found = []
    for group, index in state["groups"].items():
        units = [state["units"][i] for i in index]
        for unit in dict.fromkeys(units):
            own = [i for i in index if state["units"][i] == unit]
            shown, scale = _DISPLAY.get(unit, (unit, 1.0))
            name = group if len(set(units)) == 1 else f"{group} [{shown or '1'}]"
            found.append(Block(name, group, own, [state["names"][i] for i in own], shown, scale))
    return found


def natural(text: str) -> list[tuple[int, int, str]]:
    """Sorting key by which 400 comes before 1600."""
    parts = re.split(r"(\d+)", text)
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts]


def later(result: store.Result, from_time: float) -> store.Result:
    """The same result without the instants before `from_time`, seconds.

    Raises:
        ValueError: nothing would be left.
    """
    time = result.arrays["time"]
    kept = time >= from_time
    if not kept.any():
        raise ValueError(f"from_time={from_time} s leaves nothing of {result.meta['key']}, which ends at {time[-1]} s")
    return at_instants(result, kept)


def at_instants(result: store.Result, kept: np.ndarray) -> store.Result:
    """The same result at some of its instants, flags [T]; what is scored at none of them is left out."""
    if kept.all():
        return result
    whole = ("log_evidence", "lost", "scored", *_SCORES)
    common = ("time", "bound", "range")
    cut = {name: a[kept] if name in common else a[:, kept] for name, a in result.arrays.items() if name not in whole}
    shared = {name: result.arrays[name] for name in ("log_evidence", "lost")}
    return store.Result(result.meta, {**cut, **shared, **_scores_at(result.arrays, kept)})


def _scores_at(arrays: Mapping[str, np.ndarray], kept: np.ndarray) -> dict[str, np.ndarray]:
    """Scores at the steps that are kept [T], and where these now stand; nothing where none is left."""
    if "scored" not in arrays or not (left := kept[arrays["scored"]]).any():
        return {}
    found = {name: arrays[name][:, left] for name in _SCORES if name in arrays}
    return {"scored": (np.cumsum(kept) - 1)[arrays["scored"][left]], **found}


def tidy(cell: Cell, job: Job, result: store.Result, from_time: float, converged: Mapping[str, float]) -> pd.DataFrame:
    """The rows of one job; see `frame`."""
    lost = result.arrays["lost"]
    rows = pd.concat([*_rows(later(result, from_time)), *_settled(result, converged)], ignore_index=True)
    first, runs = job.meta.get("first_run", 0), lost.size
    repeats = len(rows) // runs
    head = {
        "study": job.meta["study"],
        "key": job.meta["key"],
        "scenario": cell.scenario,
        "noise": cell.noise,
        "model": cell.model,
        "filter": job.meta["choices"]["filter"],
        "label": job.label,
        "particles": pd.array([job.meta.get("particles")] * len(rows), dtype="Int64"),
        "seed": job.meta["seed"],
        "run": np.tile(np.arange(first, first + runs), repeats),
        "lost": np.tile(lost, repeats),
    }
    return pd.concat([pd.DataFrame(head, index=rows.index), rows], axis=1)


def _settled(result: store.Result, converged: Mapping[str, float]) -> Iterator[pd.DataFrame]:
    """When each run converged, by group; nothing is left out at the start, or none would have converged before."""
    for block in blocks(result.meta["state"]):
        if block.group in converged:
            error = result.arrays["error"][..., block.places].astype(np.float64) * block.scale
            when = metrics.convergence_time(result.arrays["time"], error, result.arrays["lost"], converged[block.group])
            yield _column("converged", when, block.group, "norm", "s")


def _rows(result: store.Result) -> Iterator[pd.DataFrame]:
    """One small table of R rows for each metric."""
    arrays, lost, meta = result.arrays, result.arrays["lost"], result.meta
    for block in blocks(meta["state"]):
        error = arrays["error"][..., block.places].astype(np.float64) * block.scale
        for k, name in enumerate(block.components):
            yield _column("rmse", metrics.rmse_per_run(error[..., [k]], lost), block.group, name, block.unit)
        yield _column("rmse", metrics.rmse_per_run(error, lost), block.group, "norm", block.unit)
        yield _column("max_error", metrics.max_error(error, lost), block.group, "norm", block.unit)
        yield from _scored(arrays, lost, block, list(meta["state"]["groups"]))
    for g, group in enumerate(meta["state"]["groups"]):
        yield _column("nees", metrics.mean_per_run(arrays["nees"][..., g], lost), group, "norm")
    for name in (*_COUNTED, "iterations"):
        trace = of_trace(result, name)
        if not np.isnan(trace).all():
            yield _column(name, trace)
    if "nis" in arrays:
        nis, dof = (metrics.mean_per_run(arrays[name], lost) for name in ("nis", "nis_dof"))
        yield _column("nis", np.divide(nis, dof, out=np.full(lost.size, np.nan), where=dof > 0))
    yield _column("log_evidence", np.where(lost, np.nan, arrays["log_evidence"]))
    yield _column("seconds_per_step", np.full(lost.size, meta["seconds"]["per_step"]), unit="s")


def of_trace(result: store.Result, name: str) -> np.ndarray:
    """Mean over time of a trace, as a share of the particles where it counts them, on each run [R]; NaN where there is none.

    Ancestors, and particles that differ, are counted where a run was resampled; without moves these are as many as those.
    """
    arrays, lost, particles = result.arrays, result.arrays["lost"], result.meta.get("particles")
    trace = arrays.get("ancestors" if name == "unique" and "unique" not in arrays else name)
    if trace is None or (name in _COUNTED and not particles):
        return np.full(lost.size, np.nan)
    if name in ("ancestors", "unique") and "resampled" in arrays:
        trace = np.where(arrays["resampled"], trace, np.nan)
    return metrics.mean_per_run(trace / in_use(result) if name in _COUNTED else trace, lost)


def in_use(result: store.Result) -> np.ndarray | int:
    """The number of particles: [R, T] of a filter that changes it."""
    return result.arrays["particles"] if "particles" in result.arrays else int(result.meta["particles"])


def _scored(arrays: Mapping[str, np.ndarray], lost: np.ndarray, block: Block, groups: list[str]) -> Iterator[pd.DataFrame]:
    """Scores of the whole law, where the job has them. The energy score of a group of mixed units has no unit, and no row."""
    if "crps" in arrays:
        crps = arrays["crps"][..., block.places].astype(np.float64) * block.scale
        for k, name in enumerate(block.components):
            yield _column("crps", metrics.score_per_run(crps[..., k], lost), block.group, name, block.unit)
        yield _column("crps", metrics.score_per_run(crps, lost), block.group, "mean", block.unit)
    if "energy" in arrays and block.group == block.whole:
        energy = arrays["energy"][..., groups.index(block.whole)].astype(np.float64) * block.scale
        yield _column("energy", metrics.score_per_run(energy, lost), block.group, "norm", block.unit)
    if "pit" in arrays:
        for level in COVERAGES:
            share = metrics.coverage_per_run(arrays["pit"][..., block.places], lost, level / 100)
            yield _column(f"coverage_{level}", share, block.group, "mean")


def _column(metric: str, value: np.ndarray, group: str = "", component: str = "", unit: str = "") -> pd.DataFrame:
    return pd.DataFrame(
        {"group": group, "component": component, "unit": unit, "metric": metric, "value": value.astype(np.float64)}
    )


def _cell(meta: Mapping[str, Any]) -> tuple[str, str, str]:
    choices = meta["choices"]
    return str(choices["scenario"]), str(choices["noise"]), str(choices.get("model", ""))


def _labelled(items: Sequence[tuple[Path, dict[str, Any]]]) -> tuple[Job, ...]:
    names = [str(meta["label"]) for _, meta in items]
    jobs = []
    for (path, meta), name in zip(items, names, strict=True):
        twins = [other for (_, other), label in zip(items, names, strict=True) if label == name]
        jobs.append(Job(path, _told_apart(meta, twins), meta))
    return tuple(sorted(jobs, key=lambda job: natural(job.label)))


def _told_apart(meta: Mapping[str, Any], twins: Sequence[Mapping[str, Any]]) -> str:
    """The label, with the settings in which jobs of that label differ: those of the filter alone where they suffice."""
    if len(twins) == 1:
        return str(meta["label"])
    flat = [_flat(twin["config"]) for twin in twins]
    names = sorted(name for name in set().union(*flat) - set(_PLACES) if len({repr(one.get(name)) for one in flat}) > 1)
    of_filter = [name for name in names if name.startswith("filter.")]
    if len({tuple(repr(one.get(name)) for name in of_filter) for one in flat}) == len(flat):
        names = of_filter
    own = _flat(meta["config"])
    told = ",".join(_setting(name.removeprefix("filter."), own.get(name, "-")) for name in names)
    return f"{meta['label']}[{told or meta['key']}]"


def _setting(name: str, value: Any) -> str:
    """A setting as a label says it; a class goes by its own name, not by where it lies."""
    if name.endswith("._target_"):
        return f"{name.removesuffix('._target_')}={str(value).rpartition('.')[2]}"
    return f"{name}={value}"


def _flat(config: Any, path: str = "") -> dict[str, Any]:
    if isinstance(config, list) and any(isinstance(part, Mapping) for part in config):  # a filter's stages, by their place
        config = dict(enumerate(config))
    if not isinstance(config, Mapping):
        return {path: config}
    return {k: v for name, below in config.items() for k, v in _flat(below, f"{path}.{name}" if path else name).items()}


def _one(items: Sequence[tuple[Path, dict[str, Any]]], names: Sequence[str], where: str) -> None:
    """Raises ValueError where jobs that are to be compared differ in one of `names`."""
    for name in names:
        by_value: dict[str, list[str]] = {}
        for path, meta in items:
            by_value.setdefault(str(_flat(meta).get(name)), []).append(path.name)
        if len(by_value) > 1:
            listed = "; ".join(
                f"{value}: {', '.join(files[:3])}{f' and {len(files) - 3} more' if len(files) > 3 else ''}"
                for value, files in sorted(by_value.items())
            )
            raise ValueError(
                f"{where} holds results that differ in {name} ({listed}); delete the files that do not belong and run "
                f"them again, or pass mixed=True to put them side by side"
            )


def _nothing(study: str, results: Path) -> str:
    folder = results / study
    others = sorted({path.parent.name for path in results.glob("*/*.npz")})
    notes = store.failures(folder)
    failures = f" ({len(notes)} jobs failed, the first with {notes[0]['message']})" if notes else ""
    there = f"studies with results in {results}: {', '.join(others)}" if others else f"{results} has no results yet"
    return f"no results in {folder}{failures}; {there}. Make them with: pfbench run -m +experiment={study}"
