"""Conditions of a study: the result files that were computed on the same data, and their labels."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pfbench.files.atomic_write import set_aside
from pfbench.results import store
from pfbench.results.inputs import (
    describe_libraries,
    describe_older,
    read_condition,
    select_newest_inputs,
)
from pfbench.results.joined_runs import find_consecutive_parts, join_metadata, read_joined
from pfbench.results.paper_block import parse_label as parse_label
from pfbench.results.step_times import STEP_TIME, add_step_times
from pfbench.results.store import DATA_FOLDERS
from pfbench.stats.study_runs import natural_sort_key

log = logging.getLogger("pfbench")

DATASHEETS = "datasheets"  # folder of the results that holds the scenarios' datasheets
_BUILD = ("versions.pfbench", "versions.commit", "versions.build")
_SHARED_SETTINGS = ("scenario", "noise", "dtype")  # settings that decide the data of a filter
_Described = tuple[Path, dict[str, Any]]


class JobFile(NamedTuple):
    """Result file of a job, or files of its consecutive runs; arrays are read on demand.

    Attributes:
        path: File.
        label: Name of the filter, with the settings that distinguish it within its condition.
        meta: Metadata, see `store.JobResult`.
        parts: Files of consecutive runs. `path` is the first of them. Empty for a single file.
    """

    path: Path
    label: str
    meta: dict[str, Any]
    parts: tuple[Path, ...] = ()

    def load(self) -> store.JobResult:
        """Read the arrays of all runs, and the metadata with the times that were measured in turn."""
        result = read_joined(self.parts or (self.path,))
        times = {k: v for k, v in self.meta.items() if k == STEP_TIME}
        return store.JobResult({**result.meta, **times}, result.data)


class Condition(NamedTuple):
    """Jobs of all filters on the same data.

    Attributes:
        scenario: Scenario.
        noise: Noise regime.
        model: Model.
        jobs: Result files.
        older: Sentences on the results of the study that are not compared, since their inputs have changed, and on those of
            several versions of a library.
    """

    scenario: str
    noise: str
    model: str
    jobs: tuple[JobFile, ...]
    older: str = ""

    @property
    def name(self) -> str:
        """Name as scenario / noise / model."""
        return f"{self.scenario} / {self.noise} / {self.model}"


def load_conditions(
    study: str,
    results: str | Path = "results",
    *,
    allow_mixed_versions: bool = False,
    keys: Collection[str] | None = None,
    same_data: bool = True,
) -> list[Condition]:
    """List the conditions of a study; arguments and errors as `load_frame`.

    Jobs that differ in their runs alone and continue each other are joined.

    Returns conditions sorted by scenario, noise and model.
    """
    files = sorted((Path(results) / study).glob("*.npz"))
    paths = [path for path in files if keys is None or path.stem in keys]
    items = [item for path in paths if (item := read_undamaged(path)) is not None]
    if not items:
        raise FileNotFoundError(_no_results_message(study, Path(results)))
    items, older = select_newest_inputs(items)
    sentences = describe_older(older), describe_libraries([meta for _, meta in items])
    if sentence := " ".join(filter(None, sentences)):
        log.warning("warning  study %s: %s", study, sentence)
    _check_distinct(items)
    if not allow_mixed_versions:
        _check_equal(items, _BUILD, "the study")
    groups = {group[0][0]: group for group in find_consecutive_parts(items)}
    items = [(path, join_metadata([meta for _, meta in group])) for path, group in groups.items()]
    items.sort(key=lambda item: (read_condition(item[1]), *(item[1][name] for name in ("label", "seed", "key"))))  # fmt: skip
    items = add_step_times(items, Path(results) / study)
    separated, settings = _separate_conditions(items, same_data, allow_mixed_versions)
    conditions = []
    for names, model, items_of_data in separated:
        jobs = [
            job._replace(parts=tuple(path for path, _ in groups[job.path]))
            for job in _label_jobs(items_of_data, settings)
        ]
        conditions.append(Condition(*names, model, tuple(jobs), sentence))
    return conditions


def _separate_conditions(
    items: Sequence[_Described], same_data: bool, allow_mixed_versions: bool
) -> tuple[list[tuple[tuple[str, str], str, list[_Described]]], dict[str, list[str]]]:
    """Group jobs by the names of scenario and noise and by model, and list the settings in the labels of each filter."""
    settings: dict[str, list[str]] = {}
    separated = []
    for key, group in groupby(items, key=lambda item: read_condition(item[1])):
        members = list(group)
        separate = list_data_settings([meta for _, meta in members]) if same_data else []
        if not allow_mixed_versions:
            _check_condition(members, separate)
        for names, items_of_data in _separate_data(members, separate):
            separated.append((names, key[2], items_of_data))
            for label, twins in _group_by_label(items_of_data).items():
                names_of_label = [*settings.get(label, ()), *find_label_settings(twins)]
                settings[label] = list(
                    dict.fromkeys(names_of_label)
                )  # its label has them in all conditions
    return separated, settings


def _check_condition(items: Sequence[_Described], separate: Sequence[str]) -> None:
    """Raise ValueError if jobs of a scenario, noise and model differ beyond the settings of their data."""
    where = f"the condition {' / '.join(read_condition(items[0][1]))}"
    _check_equal(items, ("seed", "first_run", "runs", "steps"), where)
    jobs = _label_jobs(items)
    hidden = {
        name
        for name in differing_settings(jobs)
        if not all(f"{name}=" in job.label for job in jobs)
    }
    _check_equal(items, [f"config.{name}" for name in sorted(hidden - set(separate))], where)


def _separate_data(
    items: Sequence[_Described], settings: Sequence[str]
) -> list[tuple[tuple[str, str], list[_Described]]]:
    """Group jobs by the settings of their data, with the names of scenario and noise."""
    parts: dict[tuple[str, str], list[_Described]] = {}
    for item in items:
        parts.setdefault(name_data(item[1], settings), []).append(item)
    order = sorted(parts, key=lambda names: [natural_sort_key(name) for name in names])
    return [(names, parts[names]) for names in order]


def list_stored_studies(results: Path) -> list[str]:
    """List the studies with results, without the folder of datasheets."""
    return sorted({path.parent.name for path in results.glob("*/*.npz")} - {DATASHEETS})


def read_undamaged(path: Path) -> tuple[Path, dict[str, Any]] | None:
    """Read the metadata of a result. A damaged file is set aside and left out, one that is not a result is left out."""
    try:
        return path, store.read_result(path).meta
    except store.DamagedResultError as error:
        log.warning("warning  %s   renamed to %s", error, set_aside(path).name)
    except (ValueError, OSError) as error:  # of another program or format, or not readable
        log.warning("warning  %s   left out: %s", path, error)
    return None


def differing_settings(jobs: Sequence[JobFile]) -> list[str]:
    """List settings of scenario, noise and number type in which jobs of a condition differ."""
    configs = [job.meta["config"] for job in jobs]
    flat = [flatten_settings({name: c.get(name) for name in _SHARED_SETTINGS}) for c in configs]
    return list_differing(flat)


def _group_by_label(items: Sequence[_Described]) -> dict[str, list[Mapping[str, Any]]]:
    """Group the metadata of jobs by their filter."""
    twins: dict[str, list[Mapping[str, Any]]] = {}
    for _, meta in items:
        twins.setdefault(str(meta["label"]), []).append(meta)
    return twins


def _label_jobs(
    items: Sequence[_Described], settings: Mapping[str, Sequence[str]] | None = None
) -> tuple[JobFile, ...]:
    """Give each job of a condition a label of its own, with the settings that its label has in others."""
    twins, settings = _group_by_label(items), settings or {}
    jobs = [
        JobFile(
            path,
            make_distinct_label(
                meta, twins[str(meta["label"])], settings.get(str(meta["label"]), ())
            ),
            meta,
        )
        for path, meta in items
    ]
    return tuple(sorted(jobs, key=lambda job: natural_sort_key(job.label)))


def _check_distinct(items: Sequence[_Described]) -> None:
    """Raise ValueError if two files hold the same runs of one job."""
    first: dict[str, Path] = {}
    for path, meta in items:
        runs = [meta["seed"], meta.get("first_run"), meta["runs"]]
        job = repr([meta["choices"], meta["label"], *runs, meta["config"]])
        if job in first:
            raise ValueError(
                f"{path.parent} must hold each job once, but {first[job].name} and {path.name} hold "
                f"the same runs of {meta['label']}. Delete the copy."
            )
        first[job] = path


def _check_equal(items: Sequence[_Described], names: Sequence[str], where: str) -> None:
    """Raise ValueError if jobs that are compared differ in one of `names`."""
    for name in names:
        by_value: dict[str, list[str]] = {}
        for path, meta in items:
            by_value.setdefault(str(flatten_settings(meta).get(name)), []).append(path.name)
        if len(by_value) > 1:
            listed = "; ".join(
                f"{value}: {_list_files(files)}" for value, files in sorted(by_value.items())
            )
            raise ValueError(
                f"{name} must be equal in {where}, but its results differ in {name} ({listed}). "
                "Delete the files that do not belong and repeat their jobs, or set report.allow_mixed_versions=true "
                "(from Python allow_mixed_versions=True)."
            )


def _list_files(files: Sequence[str]) -> str:
    """Format up to three names of files."""
    more = f" and {len(files) - 3} more" if len(files) > 3 else ""
    return f"{', '.join(files[:3])}{more}"


def _no_results_message(study: str, results: Path) -> str:
    """State which studies have results, and how the missing ones are made."""
    folder = results / study
    notes = store.list_failures(folder)
    failed = f" ({len(notes)} jobs failed, the first with {notes[0]['message']})" if notes else ""
    available = (
        f"Studies with results in {results}: {', '.join(list_stored_studies(results)) or 'none'}."
    )
    return f"{folder} must hold results, got none{failed}. {available} Run its jobs: pfbench run study={study} ..."


# --------------------------------------------------------------------------------------------------
# Labels of jobs: the name of a filter with the settings in which jobs of that filter differ.

_DATA_SETTINGS = ("scenario", "noise")  # settings that decide the data of a filter
_NOT_DATA = "scenario.paper."  # names and thresholds
_WORDS = "filter.paper."  # names of a filter, which differ with the world of its tuning
_LOCATION_SETTINGS = ("scenario.cache_dir", *DATA_FOLDERS)  # settings that do not


def drop_settings(label: str, *dropped: str) -> str:
    """Return a label without some of its settings."""
    name, settings = parse_label(label)
    others = [f"{key}={value}" for key, value in settings.items() if key not in dropped]
    return f"{name}[{','.join(others)}]" if others else name


def make_distinct_label(
    meta: Mapping[str, Any], twins: Sequence[Mapping[str, Any]], settings: Sequence[str] = ()
) -> str:
    """Extend a label by the settings in which jobs of that label differ.

    An equal number of particles is the usual budget, and is not named.

    Args:
        meta: Metadata of the job.
        twins: Metadata of all jobs of its label in the condition, with its own.
        settings: Settings that its label has in other conditions of the study.
    """
    names = list(dict.fromkeys([*find_label_settings(twins), *settings]))
    if not names:
        return str(meta["label"]) if len(twins) == 1 else f"{meta['label']}[{meta['key']}]"
    if meta["config"].get("budget", store.SAME_N) == store.SAME_N:
        names = [name for name in names if name != "budget"]
    text = _format_settings(meta, names, "filter.")
    return f"{meta['label']}[{text}]" if text else str(meta["label"])


def find_label_settings(twins: Sequence[Mapping[str, Any]]) -> list[str]:
    """List the settings in which jobs of a label differ, from their metadata.

    Settings of the filter alone are used if they suffice, and the budget: a job at equal time has another number of
    particles than its settings say.
    """
    flat = [flatten_settings(twin["config"]) for twin in twins]
    names = [name for name in list_differing(flat) if not name.startswith(_WORDS)]
    if "filter.particles" in names and "particles" in names:  # from which it is taken
        names.remove("particles")
    of_filter = [name for name in names if name.startswith("filter.")]
    if len({tuple(repr(config.get(name)) for name in of_filter) for config in flat}) == len(flat):
        names = [*(name for name in names if name == "budget"), *of_filter]
    return names


def list_data_settings(metadata: Sequence[Mapping[str, Any]]) -> list[str]:
    """List the settings of scenario and noise in which jobs of one filter differ."""
    by_label: dict[str, list[dict[str, Any]]] = {}
    for meta in metadata:
        config = {name: meta["config"].get(name) for name in _DATA_SETTINGS}
        by_label.setdefault(str(meta["label"]), []).append(flatten_settings(config))
    names = {name for twins in by_label.values() for name in list_differing(twins)}
    return sorted(name for name in names if not name.startswith(_NOT_DATA))


def name_data(meta: Mapping[str, Any], settings: Sequence[str]) -> tuple[str, str]:
    """Return the names of scenario and noise regime of a job, with settings of its data."""
    names = {group: str(meta["choices"][group]) for group in _DATA_SETTINGS}
    for group in names:
        of_group = [name for name in settings if name.partition(".")[0] == group]
        if text := _format_settings(meta, of_group, f"{group}."):
            names[group] += f"[{text}]"
    return names["scenario"], names["noise"]


def list_differing(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """List the settings in which flat configurations differ, without locations."""
    names = sorted(set().union(*configs) - set(_LOCATION_SETTINGS))
    return [name for name in names if len({repr(config.get(name)) for config in configs}) > 1]


def flatten_settings(config: Any, path: str = "") -> dict[str, Any]:
    """Flatten a configuration to dotted names; stages of a filter are numbered."""
    if isinstance(config, list) and any(isinstance(stage, Mapping) for stage in config):
        config = dict(enumerate(config))
    if not isinstance(config, Mapping):
        return {path: config}
    return {
        key: value
        for name, below in config.items()
        for key, value in flatten_settings(below, f"{path}.{name}" if path else str(name)).items()
    }


def _format_settings(meta: Mapping[str, Any], names: Sequence[str], prefix: str) -> str:
    """Format settings of a job; a class is written without its module."""
    config = flatten_settings(meta["config"]) if names else {}
    values = {name.removeprefix(prefix): str(config.get(name, "-")) for name in names}
    return ",".join(
        f"{key.removesuffix('._target_')}={value.rpartition('.')[2] if key.endswith('_target_') else value}"
        for key, value in values.items()
    )


# --------------------------------------------------------------------------------------------------
# Groups of state components that have a common unit, and the units shown to readers.

# The only conversion from SI to displayed units: displayed unit and factor.
_DISPLAY_UNITS = {
    "rad": ("arcmin", 60 * 180 / np.pi),
    "rad/s": ("deg/h", 3600 * 180 / np.pi),
    "m/s^2": ("mg", 1e3 / 9.80665),
    "1": ("", 1.0),
}


class ComponentGroup(NamedTuple):
    """Components of one unit, whose error has a norm.

    Attributes:
        group: Name. A group of mixed units is divided by unit, as "clock [m]" and "clock [m/s]".
        state_group: Group of the state that it is or belongs to; NEES refers to it.
        places: Indices of the components in the state.
        components: Names of the components.
        unit: Displayed unit.
        scale: Factor from SI to the displayed unit.
    """

    group: str
    state_group: str
    places: list[int]
    components: list[str]
    unit: str
    scale: float


def component_groups(state: Mapping[str, Any]) -> list[ComponentGroup]:
    """List the groups of a state, `meta["state"]`, in displayed units."""
    groups = []
    for group, index in state["groups"].items():
        units = [state["units"][i] for i in index]
        for unit in dict.fromkeys(units):
            indices = [i for i in index if state["units"][i] == unit]
            display, scale = _DISPLAY_UNITS.get(unit, (unit, 1.0))
            name = group if len(set(units)) == 1 else f"{group} [{display or '1'}]"
            names = [state["names"][i] for i in indices]
            groups.append(ComponentGroup(name, group, indices, names, display, scale))
    return groups


def select_main_group(groups: Sequence[str]) -> str:
    """Return the position, or the first group, or an empty name."""
    return "position" if "position" in groups else groups[0] if groups else ""


def main_component_group(state: Mapping[str, Any]) -> ComponentGroup:
    """Return the group of the headline: position if there is one, else the first of one unit."""
    groups = {group.group: group for group in component_groups(state)}
    return groups[select_main_group(list(groups))]
