"""Labels of jobs: the name of a filter with the settings in which jobs of that filter differ."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from pfbench.results.config_key import DATA_FOLDERS

_DATA_SETTINGS = ("scenario", "noise")  # settings that decide the data of a filter
_NOT_DATA = "scenario.paper."  # names and thresholds
_WORDS = "filter.paper."  # names of a filter, which differ with the world of its tuning
_LOCATION_SETTINGS = ("scenario.cache_dir", *DATA_FOLDERS)  # settings that do not


def parse_label(label: str) -> tuple[str, dict[str, str]]:
    """Split a label into its name and its settings.

    Args:
        label: Label such as "sir" or "sir[particles=100]", or the name of a scenario with settings.

    Returns:
        Name, and values as text by setting.
    """
    name, _, text = label.partition("[")
    pairs = re.split(r",(?=[\w.]+=)", text.removesuffix("]")) if text else []
    return name, {key: value for key, _, value in (pair.partition("=") for pair in pairs)}


def make_distinct_label(meta: Mapping[str, Any], twins: Sequence[Mapping[str, Any]]) -> str:
    """Extend a label by the settings in which jobs of that label differ.

    Settings of the filter alone are used if they suffice.

    Args:
        meta: Metadata of a job.
        twins: Metadata of all jobs of the same label in its condition.
    """
    if len(twins) == 1:
        return str(meta["label"])
    flat = [flatten_settings(twin["config"]) for twin in twins]
    names = [name for name in list_differing(flat) if not name.startswith(_WORDS)]
    of_filter = [name for name in names if name.startswith("filter.")]
    if len({tuple(repr(config.get(name)) for name in of_filter) for config in flat}) == len(flat):
        names = of_filter
    text = _format_settings(meta, names, "filter.")
    return f"{meta['label']}[{text or meta['key']}]"


def list_data_settings(metadata: Sequence[Mapping[str, Any]]) -> list[str]:
    """List the settings of scenario and noise in which jobs of one filter differ.

    Args:
        metadata: Metadata of the jobs of a scenario, noise regime and model.
    """
    by_label: dict[str, list[dict[str, Any]]] = {}
    for meta in metadata:
        config = {name: meta["config"].get(name) for name in _DATA_SETTINGS}
        by_label.setdefault(str(meta["label"]), []).append(flatten_settings(config))
    names = {name for twins in by_label.values() for name in list_differing(twins)}
    return sorted(name for name in names if not name.startswith(_NOT_DATA))


def name_data(meta: Mapping[str, Any], settings: Sequence[str]) -> tuple[str, str]:
    """Return the names of scenario and noise regime of a job, with settings of its data.

    Args:
        meta: Metadata of the job.
        settings: Names of `list_data_settings`.
    """
    names = []
    for group in _DATA_SETTINGS:
        of_group = [name for name in settings if name.partition(".")[0] == group]
        text = _format_settings(meta, of_group, f"{group}.")
        name = str(meta["choices"][group])
        names.append(f"{name}[{text}]" if text else name)
    return names[0], names[1]


def list_differing(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """List the settings in which flat configurations differ, without locations.

    Args:
        configs: Configurations of `flatten_settings`.
    """
    names = sorted(set().union(*configs) - set(_LOCATION_SETTINGS))
    return [name for name in names if len({repr(config.get(name)) for config in configs}) > 1]


def flatten_settings(config: Any, path: str = "") -> dict[str, Any]:
    """Flatten a configuration to dotted names; stages of a filter are numbered.

    Args:
        config: Node of a configuration.
        path: Name of the node, empty for the whole.
    """
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
    texts = []
    for name in names:
        value, key = config.get(name, "-"), name.removeprefix(prefix)
        if key.endswith("_target_"):
            key = key.removesuffix("._target_")
            value = str(value).rpartition(".")[2]
        texts.append(f"{key}={value}")
    return ",".join(texts)
