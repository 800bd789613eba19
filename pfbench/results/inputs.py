"""Inputs of results: which results of a condition were computed from other content than the newest one.

The metadata of a job has `inputs`: digests by name for scenario, noise, filter and model, see
`pfbench.job.inputs`. Results of other data are never compared: those of the newest content are, and
the others are named.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pfbench.results.store import PLACE_SETTINGS, Inputs, compute_config_key

Item = tuple[Path, dict[str, Any]]  # file and metadata of a job
_OF_DATA = ("scenario", "noise", "model")  # groups whose inputs all filters of a condition share


class OlderResult(NamedTuple):
    """Result that is not compared.

    Attributes:
        label: Name of the filter.
        changed: Inputs that have other content now, for people.
    """

    label: str
    changed: tuple[str, ...]


def list_changed(before: Inputs, after: Inputs, groups: Sequence[str] = ()) -> list[str]:
    """List the inputs of two jobs whose content differs, or that one of them lacks, for people."""
    groups = groups or tuple({**before, **after})
    old, new = _flatten(before, groups), _flatten(after, groups)
    differing = [key for key in {**old, **new} if old.get(key) != new.get(key)]
    return list(dict.fromkeys(_format_name(name) for _, name in differing))


def select_newest_inputs(items: Sequence[Item]) -> tuple[list[Item], list[OlderResult]]:
    """Separate the results of the newest inputs of each condition from the others.

    For each name the digest of the result that was computed last counts. Of two results of one job
    with other inputs of the filter, such as its code, the later one counts.

    Returns the results that are compared, and the others of jobs that were not run again since.
    """
    if not any(meta.get("inputs") for _, meta in items):
        return list(items), []
    ordered = sorted(items, key=_computed_at)
    newest: dict[tuple[str, ...], dict[tuple[str, str], str]] = {}
    last: dict[str, Inputs] = {}
    for _, meta in ordered:
        inputs = meta.get("inputs", {})
        newest.setdefault(read_condition(meta), {}).update(_flatten(inputs, _OF_DATA))
        last[_describe_data(meta)] = last[_describe_job(meta)] = inputs
    compared: list[Item] = []
    older: list[tuple[str, OlderResult]] = []
    for path, meta in ordered:
        inputs, of_condition = meta.get("inputs", {}), newest[read_condition(meta)]
        of_data = _flatten(inputs, _OF_DATA)
        changed = [_format_name(key[1]) for key in of_data if of_data[key] != of_condition[key]]
        # files that came or went with equal settings of the data, or another code of the same filter
        changed += list_changed(inputs, last[_describe_data(meta)], _OF_DATA[:2])
        changed += list_changed(inputs, last[_describe_job(meta)])
        if changed:
            names = tuple(dict.fromkeys(changed))
            older.append((_describe_job(meta), OlderResult(str(meta["label"]), names)))
        else:
            compared.append((path, meta))
    replaced = {_describe_job(meta) for _, meta in compared}
    return compared, [result for job, result in older if job not in replaced]


def describe_older(older: Sequence[OlderResult]) -> str:
    """State in one line which results are not compared, and why; empty if there are none."""
    if not older:
        return ""
    changed = list(dict.fromkeys(name for result in older for name in result.changed))
    labels = ", ".join(dict.fromkeys(result.label for result in older))
    return (
        f"{len(older)} {'result is' if len(older) == 1 else 'results are'} not compared, since "
        f"{' and '.join(changed)} {'has' if len(changed) == 1 else 'have'} changed: {labels}. "
        "Run the jobs again, with overwrite=true if they are skipped."
    )


def describe_libraries(metadata: Sequence[Mapping[str, Any]]) -> str:
    """State which versions of torch and numpy computed the results of a study, if there are several; else empty."""
    versions = {
        k: {str(m.get("versions", {}).get(k)) for m in metadata} for k in ("torch", "numpy")
    }
    mixed = [
        f"{k} {' and '.join(sorted(names))}" for k, names in versions.items() if len(names) > 1
    ]
    return (
        f"Results of {' and of '.join(mixed)} are mixed. Run the jobs again with one, by overwrite=true."
        if mixed
        else ""
    )


def _flatten(inputs: Inputs, groups: Sequence[str]) -> dict[tuple[str, str], str]:
    """Return digests by group and name."""
    return {
        (group, name): digest for group in groups for name, digest in inputs.get(group, {}).items()
    }


def _format_name(name: str) -> str:
    """Write "my_log/imu.csv" as "imu.csv of my_log"."""
    folder, slash, file = name.rpartition("/")
    return f"{file} of {folder}" if slash else name


def _computed_at(item: Item) -> tuple[str, int]:
    """Return the time of a result. Within a second that of its file decides."""
    path, meta = item
    return str(meta.get("created", "")), path.stat().st_mtime_ns if path.exists() else 0


def read_condition(meta: Mapping[str, Any]) -> tuple[str, str, str]:
    """Return scenario, noise and model of a result."""
    scenario, noise, model = (str(meta["choices"].get(group, "")) for group in _OF_DATA)
    return scenario, noise, model


def _describe_data(meta: Mapping[str, Any]) -> str:
    """Return a key of the settings that decide the data of a result, whatever the inputs are."""
    settings = {group: meta["config"].get(group) for group in _OF_DATA[:2]}
    return repr([*read_condition(meta)[:2], compute_config_key(settings, PLACE_SETTINGS)])


def _describe_job(meta: Mapping[str, Any]) -> str:
    """Return a key of the job and the runs of a result, whatever the inputs are."""
    runs = [meta["seed"], meta.get("first_run"), meta["runs"]]
    config = compute_config_key(meta["config"], PLACE_SETTINGS)
    return repr([meta["choices"], meta["label"], *runs, config])
