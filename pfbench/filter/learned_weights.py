"""Trained weights on disk: one file, read as plain tensors, numbers and texts and never as code.

A checkpoint holds the weights of each learned part of a filter and what they were made of: configuration, worlds, losses, cost.
Its name in a job's key is a digest of its weights, wherever the file lies.
"""

from __future__ import annotations

import hashlib
import os
import pickle
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4

import torch
from torch import Tensor, nn

from pfbench.model.base import StateSpaceModel

FORMAT = "pfbench checkpoint 1"
UNTRAINED = "untrained"
SIZES = {"features": "numbers that the network is told", "noise": "components of the noise", "memory": "numbers remembered"}

Weights = dict[str, Tensor]


@dataclass(frozen=True)
class Learnable:
    """Where a learned part of a filter takes its weights from.

    Attributes:
        part: its name in a checkpoint: `proposal` or `kernel`.
        checkpoint: a file, `untrained`, or None, which is refused on use.
        seed: of untrained weights.
        frame: in words, what the network's law corrects: the same numbers mean another law in another frame.
    """

    part: str
    checkpoint: str | None
    seed: int
    frame: str = ""


def made(
    learnable: Learnable,
    make: Callable[[], dict[str, nn.Module]],
    sizes: tuple[int, int, int],
    model: StateSpaceModel,
    fresh: bool,
) -> dict[str, nn.Module]:
    """Networks in the model's precision and on its device, filled from the checkpoint unless they start afresh.

    torch's stream of random numbers is as it was before.

    Raises:
        ValueError: there is no checkpoint, or it is another model's or network's; names key, value and remedy.
    """
    path = learnable.checkpoint
    if path is None and not fresh:
        raise ValueError(
            "checkpoint=null: this filter has a network and needs its weights; make them with `pfbench train` and the same words "
            "and give checkpoint=FILE, or run the network as it starts with checkpoint=untrained"
        )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(learnable.seed)
        modules = {name: module.to(model.anchor) for name, module in make().items()}
    if path not in (None, UNTRAINED) and not fresh:
        kept = read(str(path))
        _check_sizes(str(path), kept, learnable, sizes, model)
        fill(str(path), kept["networks"][learnable.part], modules)
    return modules


def flat(modules: Mapping[str, nn.Module]) -> Weights:
    """The weights of several networks under names of their own."""
    return {f"{name}.{key}": value for name, module in modules.items() for key, value in module.state_dict().items()}


def write(path: str | Path, content: Mapping[str, Any]) -> None:
    """Writes a checkpoint, all at once or not at all."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.name}.{uuid4().hex[:8]}.tmp")
    try:
        torch.save({"format": FORMAT, **content}, temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def read(path: str | Path) -> dict[str, Any]:
    """A checkpoint's content: tensors, numbers, texts, lists and dicts; nothing else is ever loaded.

    Raises:
        ValueError: there is no such file, it is damaged, holds something else, or is no checkpoint of this format.
    """
    if not Path(path).is_file():
        raise ValueError(
            f"checkpoint={path}: there is no such file; `pfbench train` says at its end where it put one, checkpoint=untrained "
            "runs the network as it starts"
        )
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError, KeyError) as error:
        raise ValueError(
            f"checkpoint={path}: not a file of weights, or a damaged one ({type(error).__name__}); nothing in it was run. Give a "
            "checkpoint that `pfbench train` made"
        ) from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        found = content.get("format") if isinstance(content, dict) else type(content).__name__
        raise ValueError(f"checkpoint={path}: its format is {found!r}, this pfbench reads {FORMAT!r}; train again")
    return content


def digest(networks: Mapping[str, Weights]) -> str:
    """16 hexadecimal digits of the SHA-256 of all weights, their names and shapes."""
    whole = hashlib.sha256()
    for part in sorted(networks):
        for name in sorted(networks[part]):
            value = networks[part][name].detach().cpu().contiguous()
            whole.update(repr((part, name, str(value.dtype), tuple(value.shape))).encode())
            whole.update(value.numpy().tobytes())
    return whole.hexdigest()[:16]


def by_content(config: Any) -> Any:
    """A configuration in which each checkpoint is named by its weights, so that a job's key is what it computes.

    Raises:
        ValueError: as `read`.
    """
    if isinstance(config, Mapping):
        return {
            key: _named(value) if key == "checkpoint" and isinstance(value, str) else by_content(value)
            for key, value in config.items()
        }
    return [by_content(value) for value in config] if isinstance(config, list) else config


def origin(config: Any, scenario: str, seed: int, runs: Tensor) -> dict[str, Any] | None:
    """What a job says of the checkpoint that its filter has: digest of the weights, what they were trained on, and the cost.

    Args:
        config: of the filter.
        scenario, seed, runs: of the job.

    Raises:
        ValueError: worlds of this job were learned from, or chose the weights; as `read`.
    """
    path = next(_checkpoints(config), None)
    if path is None:
        return None
    kept = read(path)
    split = kept.get("split", {})
    for name, use in (("train", "learned from"), ("validation", "used to stop by")):
        part = split.get(name, {})
        if split.get("scenario") == scenario and part.get("seed") == seed and int(runs.min()) < part["runs"]:
            raise ValueError(
                f"seed={seed}: runs 0 to {part['runs'] - 1} of {scenario} with this seed are what checkpoint={path} was {use}; "
                "give another seed, so that it is judged on worlds that it has not seen"
            )
    told: dict[str, Any] = {name: kept[name] for name in ("choices", "cost", "best") if name in kept}
    return {"weights": digest(kept["networks"]), "split": split, **told}


def _checkpoints(config: Any) -> Iterator[str]:
    """Files of weights that a filter's configuration names."""
    if isinstance(config, Mapping):
        own = config.get("checkpoint")
        yield from [own] if isinstance(own, str) and own != UNTRAINED else []
        config = list(config.values())
    if isinstance(config, list):
        for part in config:
            yield from _checkpoints(part)


def _named(path: str) -> str:
    return path if path == UNTRAINED else f"weights {digest(read(path)['networks'])}"


def _check_sizes(
    path: str, kept: Mapping[str, Any], learnable: Learnable, sizes: tuple[int, int, int], model: StateSpaceModel
) -> None:
    part, choices = learnable.part, kept["choices"]
    if part not in kept["networks"]:
        has = ", ".join(kept["networks"])
        raise ValueError(f"checkpoint={path}: it holds a learned {has}, this filter has a learned {part}; train this filter")
    trained = list(kept["model"]["names"])
    if trained != list(model.names):
        words = [f"{group}={choices[group]}" for group in ("scenario", "model") if group in choices]
        raise ValueError(
            f"checkpoint={path}: it was trained on a model with {len(trained)} states ({', '.join(trained)}), and "
            f"{type(model).__name__} has {len(model.names)} ({', '.join(model.names)}); train on this model, or give "
            f"{' '.join(words) or 'the scenario and the model it was trained on'}"
        )
    frame = kept.get("frames", {}).get(part, learnable.frame)  # those of before frames were kept are taken at their word
    if frame != learnable.frame:
        raise ValueError(
            f"checkpoint={path}: its network corrects {frame}, this filter's corrects {learnable.frame}; give "
            f"filter={choices.get('filter', 'the one')} with which it was trained, or train this one"
        )
    for (name, what), here, there in zip(SIZES.items(), sizes, kept["sizes"][part], strict=True):
        if here != there:
            raise ValueError(
                f"checkpoint={path}: trained with {name}={there} ({what}), and here it is {here}; give the model and the "
                "filter's options with which it was trained, or train again"
            )


def fill(path: str, weights: Weights, modules: Mapping[str, nn.Module]) -> None:
    """Puts weights where they belong.

    Raises:
        ValueError: names the first one that is missing, too many, or of another shape.
    """
    own = flat(modules)
    for name in sorted(own.keys() | weights.keys()):
        there, here = (tuple(a[name].shape) if name in a else None for a in (weights, own))
        if there != here:
            raise ValueError(
                f"checkpoint={path}: weight {name} has shape {there}, this filter's network has {here}; give the network "
                "(proposal.network and its hidden layers) with which it was trained, or train again"
            )
    for name, module in modules.items():
        module.load_state_dict({key.removeprefix(f"{name}."): a for key, a in weights.items() if key.startswith(f"{name}.")})
