"""Key of a job: a hash of its configuration and of the content of the files that it reads."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pfbench.kernels.generator_version import GENERATOR_VERSION

# digests by name, for the groups of a configuration, see `pfbench.job.inputs`
Inputs = dict[str, dict[str, str]]
_HALF = 8  # digits of a key that depend on the configuration alone
# folders of files whose content is part of the key, see `pfbench.job.inputs`
DATA_FOLDERS = (
    "scenario.root",
    "scenario.trajectory.root",
    "scenario.receiver.constellation.root",
    "model.receiver.constellation.root",
    "noise.root",
)
# paths of a configuration that decide where, when and how fast a job runs, not what it computes
PLACE_SETTINGS = (
    "results_dir",
    "reports_dir",
    "episode_cache_dir",
    "data",
    "study",
    "threads",
    "engine",  # only in double precision, see below
    "memory_limit_gib",
    "overwrite",
    "report",
    *DATA_FOLDERS,
    "scenario.cache_dir",
    "pcrb",  # does not change the filter's results; a job without the bound runs again where it is requested
    "runs_in",  # an experiment's table from which `runs` is taken
    "until_decided",  # caps of a study that adds runs
    "train",
    "checkpoint",  # the filter's weights are part of the key, by a hash of their content
)


def compute_config_key(config: Mapping[str, Any], ignore: tuple[str, ...] = ()) -> str:
    """Compute the key of a job: 16 hexadecimal digits of the SHA-256 of its configuration.

    The version of the random number generator is part of it. In single precision the engine is, too:
    sums that are rounded in another order may choose other ancestors. In double precision the
    results of all engines agree to rounding.

    Args:
        config: Plain nested dictionary with string keys.
        ignore: Dotted paths that change where a job runs but not what it computes, such as
            `results` or `data.root`. A path covers all keys below it and may be missing.

    Returns:
        The key.

    Raises:
        ValueError: If JSON cannot represent a value (NaN included).
    """
    if config.get("dtype") == "float32":
        ignore = tuple(path for path in ignore if path != "engine")
    relevant = _without(config, {tuple(path.split(".")) for path in ignore})
    for key, value in list_not_finite(relevant, ""):
        raise ValueError(f"{key} must be finite, got {value}. Set {key} to a number.")
    relevant = {"config": relevant, "generator": GENERATOR_VERSION}
    try:
        text = json.dumps(relevant, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"configuration must be numbers, texts, lists and dicts, got {error}."
        ) from error
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def extend_key(key: str, inputs: Inputs) -> str:
    """Return the key of a job with inputs. Its first half stays that of the configuration.

    Args:
        key: Key of the configuration.
        inputs: Inputs. Without any the key is unchanged.
    """
    if not inputs:
        return key
    text = json.dumps([key, inputs], sort_keys=True)
    return key[:_HALF] + hashlib.sha256(text.encode()).hexdigest()[: len(key) - _HALF]


def list_same_configuration(path: Path, suffix: str) -> list[Path]:
    """List the files of other inputs next to a result, whose keys have the same first half.

    Args:
        path: File of the result.
        suffix: End of their names.
    """
    return [f for f in path.parent.glob(f"{path.stem[:_HALF]}*{suffix}") if f != path]


def list_not_finite(node: Any, key: str) -> Iterator[tuple[str, float]]:
    """Yield the keys and values of all numbers that are infinite or NaN.

    Args:
        node: Resolved configuration or a part of it.
        key: Its key.
    """
    if isinstance(node, Mapping | list):
        pairs = node.items() if isinstance(node, Mapping) else enumerate(node)
        for name, value in pairs:
            yield from list_not_finite(value, f"{key}.{name}" if key else f"{name}")
    elif isinstance(node, float) and not math.isfinite(node):
        yield key, node


def _without(config: Any, paths: set[tuple[str, ...]]) -> Any:
    if not isinstance(config, Mapping):
        return config
    below = {name: {path[1:] for path in paths if path[0] == name} for name in config}
    return {
        name: _without(value, below[name])
        for name, value in config.items()
        if () not in below[name]
    }
