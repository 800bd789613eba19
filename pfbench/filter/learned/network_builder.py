"""Networks of a learned filter part, built untrained or from a checkpoint."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn

from pfbench.filter.learned.checkpoint import UNTRAINED, load_parameters, read_checkpoint
from pfbench.model.base import StateSpaceModel

SIZES = {
    "features": "number of features",
    "noise": "components of the noise or of the gain",
    "memory": "hidden size of the recurrent network",
}


@dataclass(frozen=True)
class CheckpointSpec:
    """Source of the weights of a learned part of a filter.

    Attributes:
        key: Name in the checkpoint: `proposal`, `kernel` or `gain`.
        checkpoint: File, `untrained`, or None, which raises on use.
        seed: Seed of untrained weights.
        frame: Description of the distribution that the network corrects. The same weights give
            another distribution in another frame.
    """

    key: str
    checkpoint: str | None
    seed: int
    frame: str = ""


def build_networks(
    learnable: CheckpointSpec,
    make: Callable[[], dict[str, nn.Module]],
    sizes: tuple[int, int, int],
    model: StateSpaceModel,
    fresh: bool,
) -> dict[str, nn.Module]:
    """Build networks in the model's precision and load the checkpoint, unless `fresh`.

    The global random state of torch does not change.

    Args:
        learnable: Source of the weights.
        make: Makes the modules by name.
        sizes: Numbers of features, noise components and hidden units.
        model: State-space model, which determines dtype and device.
        fresh: Start from untrained weights.

    Returns:
        The modules by name.

    Raises:
        ValueError: If no checkpoint is set, or it belongs to another model or network.
    """
    path = learnable.checkpoint
    if path is None and not fresh:
        raise ValueError(
            "checkpoint must be a file or `untrained` for a filter with a network, got null. "
            "Train it with `pfbench train` and the same options, then set checkpoint=FILE."
        )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(learnable.seed)
        modules = {name: module.to(model.anchor) for name, module in make().items()}
    if path not in (None, UNTRAINED) and not fresh:
        content = read_checkpoint(str(path))
        _check_sizes(str(path), content, learnable, sizes, model)
        load_parameters(str(path), content["networks"][learnable.key], modules)
    return modules


def _check_sizes(
    path: str,
    content: Mapping[str, Any],
    learnable: CheckpointSpec,
    sizes: tuple[int, int, int],
    model: StateSpaceModel,
) -> None:
    """Check that a checkpoint fits the filter and the model."""
    key, choices = learnable.key, content["choices"]
    if key not in content["networks"]:
        keys = ", ".join(content["networks"])
        raise ValueError(
            f"checkpoint must hold a learned {key}, got a learned {keys} in {path}. "
            "Train this filter."
        )
    trained = list(content["model"]["names"])
    if trained != list(model.names):
        options = [
            f"{group}={choices[group]}" for group in ("scenario", "model") if group in choices
        ]
        raise ValueError(
            f"checkpoint must be trained on a model with the {len(model.names)} states of "
            f"{type(model).__name__} ({', '.join(model.names)}), got {len(trained)} "
            f"({', '.join(trained)}) in {path}. Train on this model, or set "
            f"{' '.join(options) or 'the scenario and the model of the training'}."
        )
    frame = content.get("frames", {}).get(key, learnable.frame)  # missing in older files
    if frame != learnable.frame:
        raise ValueError(
            f"checkpoint must correct {learnable.frame}, got {frame} in {path}. Set "
            f"filter={choices.get('filter', 'NAME')} as in the training, or train this filter."
        )
    for (name, label), size, stored in zip(
        SIZES.items(), sizes, content["sizes"][key], strict=True
    ):
        if size != stored:
            raise ValueError(
                f"checkpoint must have {name}={size} ({label}), got {stored} in {path}. "
                "Set the model and filter options of the training, or train again."
            )
