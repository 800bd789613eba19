"""Checkpoint files of trained weights: plain tensors, numbers and texts, no code.

A checkpoint holds the weights of each learned part of a filter and its training configuration,
data, losses and cost. A job key contains a hash of the weights, independent of the file path.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from pfbench.core.parameter_checks import require
from pfbench.files.atomic_write import DIGEST, has_valid_digest, hash_content, write_atomically
from pfbench.files.limits import TABLE_BYTES, check_is_file, check_zip

CHECKPOINT_FORMAT = "pfbench checkpoint 2"
UNTRAINED = "untrained"

Weights = dict[str, Tensor]


def flatten_parameters(modules: Mapping[str, nn.Module]) -> Weights:
    """Return the weights of several networks under names with the network as prefix."""
    return {
        f"{name}.{key}": value
        for name, module in modules.items()
        for key, value in module.state_dict().items()
    }


def write_checkpoint(path: str | Path, content: Mapping[str, Any]) -> None:
    """Write a checkpoint atomically."""
    full = {"format": CHECKPOINT_FORMAT, **content}
    full[DIGEST] = hash_content(full)
    write_atomically(Path(path), lambda file: torch.save(full, file))


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read a checkpoint: tensors, numbers, texts, lists and dicts, never code."""
    require(
        Path(path).is_file(),
        "checkpoint",
        "be an existing file",
        path,
        "Use the path that `pfbench train` prints (give it none), or checkpoint=untrained.",
    )
    check_is_file(Path(path), TABLE_BYTES)
    check_zip(Path(path))
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many kinds for damaged files
        raise ValueError(
            f"checkpoint must be a file of weights, got {path}, which is damaged or another file "
            f"({type(error).__name__}). Use a checkpoint that `pfbench train` wrote."
        ) from error
    if not isinstance(content, dict) or content.get("format") != CHECKPOINT_FORMAT:
        stored = content.get("format") if isinstance(content, dict) else type(content).__name__
        raise ValueError(
            f"checkpoint must have the format {CHECKPOINT_FORMAT!r}, got {stored!r} in {path}. Train again."
        )
    require(
        has_valid_digest(content),
        "checkpoint",
        "be undamaged",
        f"{path} with a digest that is not that of its content",
        "Train again.",
    )
    return content


def hash_weights(networks: Mapping[str, Weights]) -> str:
    """Return 16 hexadecimal digits of the SHA-256 of all weights, names and shapes."""
    sha256 = hashlib.sha256()
    for key in sorted(networks):
        for name in sorted(networks[key]):
            value = networks[key][name].detach().cpu().contiguous()
            sha256.update(repr((key, name, str(value.dtype), tuple(value.shape))).encode())
            sha256.update(value.numpy().tobytes())
    return sha256.hexdigest()[:16]


def replace_checkpoint_by_hash(config: Any) -> Any:
    """Replace each checkpoint path in a configuration by the hash of its weights."""
    if isinstance(config, Mapping):
        return {
            key: _hash_label(value)
            if key == "checkpoint" and isinstance(value, str)
            else replace_checkpoint_by_hash(value)
            for key, value in config.items()
        }
    if isinstance(config, list):
        return [replace_checkpoint_by_hash(value) for value in config]
    return config


def checkpoint_provenance(
    config: Any, scenario: str, seed: int, runs: Tensor
) -> dict[str, Any] | None:
    """Return hash, training data and cost of a filter's checkpoint, if it has one."""
    path = next(_checkpoints(config), None)
    if path is None:
        return None
    content = read_checkpoint(path)
    split = content.get("split", {})
    for name, use in (("train", "training"), ("validation", "validation")):
        data = split.get(name, {})
        if (
            split.get("scenario") == scenario
            and data.get("seed") == seed
            and int(runs.min()) < data["runs"]
        ):
            raise ValueError(
                f"seed must differ from the {use} seed of checkpoint={path}, got {seed}: runs 0 to "
                f"{data['runs'] - 1} of {scenario} are {use} data. Set another seed."
            )
    details: dict[str, Any] = {
        name: content[name] for name in ("choices", "cost", "best") if name in content
    }
    return {"weights": hash_weights(content["networks"]), "split": split, **details}


def _checkpoints(config: Any) -> Iterator[str]:
    """Iterate over the checkpoint files in a filter's configuration."""
    if isinstance(config, Mapping):
        checkpoint = config.get("checkpoint")
        yield from [checkpoint] if isinstance(checkpoint, str) and checkpoint != UNTRAINED else []
        config = list(config.values())
    if isinstance(config, list):
        for value in config:
            yield from _checkpoints(value)


def _hash_label(path: str) -> str:
    """Return the hash of a checkpoint as text."""
    if path == UNTRAINED:
        return path
    return f"weights {hash_weights(read_checkpoint(path)['networks'])}"


def load_parameters(path: str, weights: Weights, modules: Mapping[str, nn.Module]) -> None:
    """Load weights into modules."""
    expected = flatten_parameters(modules)
    for name in sorted(expected.keys() | weights.keys()):
        stored, shape = (tuple(a[name].shape) if name in a else None for a in (weights, expected))
        require(
            stored == shape,
            "checkpoint",
            f"have weight {name} of shape {shape}",
            f"{stored} in {path}",
            "Set the network of the training (proposal.network, hidden), or train again.",
        )
    for name, module in modules.items():
        module.load_state_dict(
            {
                key.removeprefix(f"{name}."): a
                for key, a in weights.items()
                if key.startswith(f"{name}.")
            }
        )
