"""Settings of a job that do not belong to one of its objects, and the key of a job.

This module does not import torch, so that a finished job is found before it.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping
from typing import Any

from pfbench.core.parameter_checks import RUN_NUMBERS, require
from pfbench.job.inputs import find_inputs, names_checkpoint
from pfbench.job.trust import list_user_targets
from pfbench.results import store
from pfbench.results.paper_block import PAPER, PARTS
from pfbench.results.store import PLACE_SETTINGS, Inputs, compute_config_key, extend_key

#: paths of the configuration that do not enter the key of a job
IGNORED_IN_KEY = (
    *PLACE_SETTINGS,
    *(f"{group}.{PAPER}" for group in PARTS),  # names and limits for reports
    "particles",  # part of the key where a filter uses it, as filter.particles
)
# settings of a comparison that are part of the key only if they differ from the default
DEFAULTS_NOT_IN_KEY: Mapping[str, Any] = {"budget": store.SAME_N}


def job_key(values: Mapping[str, Any], inputs: Inputs | None = None) -> str:
    """Compute the key of a job from all that affects its results.

    That is its settings and the content of all files that it reads, a user's classes included. The source
    code of pfbench is not part of it: reports refuse results of several builds.

    Args:
        values: Resolved configuration.
        inputs: Inputs of the job, see `find_inputs`. None to find them.

    Returns:
        16 hexadecimal digits. The first half depends on the settings alone.
    """
    inputs = find_inputs(values) if inputs is None else inputs
    if names_checkpoint(values.get("filter")):
        from pfbench.filter.learned.checkpoint import replace_checkpoint_by_hash

        values = {**values, "filter": replace_checkpoint_by_hash(values["filter"])}
    node = values.get("filter") or {}
    classes = {target.rpartition(".")[2].lower() for target in list_user_targets(node)}
    name = str(node.get(PAPER, {}).get("name", ""))
    if classes and re.sub(r"[\W_]", "", name).lower() not in classes:
        inputs = inputs | {"name": {name: ""}}  # of a class of the user: a new name is a new row
    defaults = (k for k, default in DEFAULTS_NOT_IN_KEY.items() if values.get(k) == default)
    return extend_key(compute_config_key(values, (*IGNORED_IN_KEY, *defaults)), inputs)


def check_settings(values: Mapping[str, Any]) -> None:
    """Check the settings of a job that do not belong to one of its objects."""
    memory = values["memory_limit_gib"]
    valid = {
        **{
            key: type(values[key]) is int and least <= values[key] <= _MOST.get(key, math.inf)
            for key, (least, _) in _INTEGERS.items()
        },
        "overwrite": type(values.get("overwrite", False)) is bool,
        "oracle_noise": type(values["oracle_noise"]) is bool,
        "pcrb": values["pcrb"] in (True, False, "auto"),
        "memory_limit_gib": memory is None
        or (type(memory) in (int, float) and 0 < memory < math.inf),
        "dtype": values["dtype"] in ("float32", "float64"),
        "budget": values["budget"] in store.BUDGETS,
        "engine": values["engine"] in ("auto", "eager", "kernels", "tape", "compiled"),
        "device": re.fullmatch(r"cpu|cuda(:\d{1,3})?", str(values["device"])) is not None,
    }
    for key, (requirement, example) in _REQUIREMENTS.items():
        value = values.get(key)
        remedy = _advise_integer(key, value) or f"Set {key}={example}."
        # a text in quotes: "10" is none of the numbers
        require(valid[key], key, f"be {requirement}", repr(value), remedy)
    require(
        not values["first_run"] + values["runs"] > RUN_NUMBERS,
        "first_run + runs",
        f"be at most 2**32 = {RUN_NUMBERS}",
        f"{values['first_run']} + {values['runs']}",
        "Larger run numbers would repeat random numbers: use another seed.",
    )
    if (device := values["device"]) != "cpu":
        import torch

        count = torch.cuda.device_count()
        is_there = (torch.device(device).index or 0) < count
        require(
            is_there, "device", f"be cpu or one of {count} CUDA devices", device, "Use device=cpu."
        )


_LARGEST = 1_000_000_000  # a number that is advised
# whole numbers with minimum and example
_INTEGERS = {
    "runs": (1, 100),
    "particles": (2, 500),
    "first_run": (0, 0),
    "threads": (1, 1),
    "seed": (0, 1),
    "score_steps": (0, 10),
}
# threads beyond the cores only wait, and OpenMP ends the process with a fault if there are many
_MOST = {"threads": max(256, os.cpu_count() or 1)}
_REQUIREMENTS = {  # requirement and valid value by key
    **{
        key: (
            f"a whole number of at least {least}" + f", at most {_MOST.get(key)}" * (key in _MOST),
            str(example),
        )
        for key, (least, example) in _INTEGERS.items()
    },
    "oracle_noise": ("true (the filter receives the true noise regime) or false", "false"),
    "overwrite": ("true (repeat finished jobs) or false", "false"),
    "pcrb": ("auto (where the model's distributions are the simulated ones), true or false", "auto"),
    "memory_limit_gib": ("the GiB that the job may use, or null for most of the free memory", "null"),
    "dtype": ("float64 (default) or float32", "float64"),
    "budget": (f"one of {', '.join(store.BUDGETS)}", store.SAME_N),
    "engine": ("auto, eager, kernels, tape or compiled", "auto"),
    "device": ("cpu, cuda, or one of several GPUs such as cuda:1", "cpu"),
}  # fmt: skip


def _advise_integer(key: str, value: Any) -> str:
    """Return how a whole number is written that was given as 1e9 or 10.0; empty for other values."""
    if key not in _INTEGERS or not isinstance(value, float) or not value.is_integer():
        return ""
    if abs(value) > _LARGEST:
        return f"Choose at most {_LARGEST}."
    return f"Write it without exponent and without a decimal point: {key}={int(value)}."
