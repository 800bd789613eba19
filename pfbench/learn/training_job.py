"""Training of a filter, from objects or from a configuration."""

from __future__ import annotations

import csv
import importlib.util
import io
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from pfbench.files.atomic_write import set_aside, write_atomically
from pfbench.files.command_start import start_work
from pfbench.filter.learned import checkpoint
from pfbench.filter.learned.objectives import TrainableFilter
from pfbench.learn.trainer import Progress, Training, TrainingState
from pfbench.learn.training_data import TrainingData, draw_training_data
from pfbench.model.base import StateSpaceModel
from pfbench.noise.base import NoiseRegime
from pfbench.results.store import Inputs, compute_config_key, extend_key


def train(
    training: Training,
    method: TrainableFilter,
    model: StateSpaceModel,
    data: TrainingData,
    validation: TrainingData,
    path: str | Path,
    metadata: Mapping[str, Any] | None = None,
    tell: Callable[[str], object] | None = None,
) -> Path:
    """Train the networks of a filter and write the checkpoint of the best epoch.

    After each epoch `<path>.part` holds all that resuming needs. It is used if it exists, and
    removed at the end. The file `<path>` with the suffix .csv has the losses. If TensorBoard is
    installed, a folder of the same name has its log.

    Args:
        training: Settings.
        method: The filter. Resampler and number of particles, if it has any, are those of the settings.
        model: State-space model, on its device and in its precision.
        data: Training data (`draw_training_data`).
        validation: Validation data.
        path: Path of the checkpoint.
        metadata: Further content of the checkpoint: config, choices, split. Numbers, strings,
            lists and dicts.
        tell: Function that receives the log line of each epoch.

    Returns:
        Path of the checkpoint.

    Raises:
        ValueError: If the filter has nothing to train, the objective does not fit it, or a
            training with other settings was stopped at this path.
    """
    path = Path(path)
    resume_file = path.with_name(path.name + ".part")
    state = TrainingState(training, method, model, data)
    progress = state.restore(resume_file)
    start_work()
    write_board = open_tensorboard(path)
    with tqdm(
        total=training.epochs, initial=progress.epoch, desc="training", unit="epoch",
        disable=None, leave=False,
    ) as bar:  # fmt: skip
        while (
            progress.epoch < training.epochs
            and progress.epochs_since_best < training.patience_epochs
        ):
            line = state.run_epoch(progress, data, validation)
            bar.set_postfix({name: f"{line[name]:.4g}" for name in ("loss", "validation")})
            bar.update()
            write_board(line)
            if tell:
                with tqdm.external_write_mode():
                    tell(" ".join(f"{name} {value:.5g}" for name, value in line.items()))
            state.save(resume_file, progress)
            write_losses(path.with_suffix(".csv"), progress.losses)
    checkpoint.write_checkpoint(path, _checkpoint_content(state, progress, metadata or {}))
    resume_file.unlink(missing_ok=True)
    return path


def fit(
    cfg: Mapping[str, Any],
    choices: Mapping[str, str],
    regimes: Mapping[str, NoiseRegime],
    build: Callable[[Any], Any],
    metadata: Mapping[str, Any],
    tell: Callable[[str], object],
) -> Path:
    """Train the networks of a configuration, unless their checkpoint exists.

    Returns path of the checkpoint.
    """
    model, training, method = (build(cfg[group]) for group in ("model", "train", "filter"))
    model = model.to(cfg["device"], getattr(torch, cfg["dtype"]))
    scenario = build(cfg["scenario"])
    inputs = metadata.get("inputs", {})
    path = _checkpoint_path(cfg, choices, regimes, training.checkpoint_path, inputs)
    if path.exists() and not cfg["overwrite"]:
        tell(f"skipped  checkpoint exists: {path}   (overwrite=true to repeat)")
        return path
    if cfg["overwrite"]:
        path.with_name(path.name + ".part").unlink(missing_ok=True)
    runs = {"train": training.training_runs, "validation": training.validation_runs}
    seeds = {"train": training.seed, "validation": training.seed + 1}
    data, validation = (
        draw_training_data(
            scenario, [*regimes.values()], model, runs[name], seeds[name], training.max_steps
        )
        for name in runs
    )
    split: dict[str, Any] = {"scenario": choices["scenario"]}
    split |= {name: {"seed": seeds[name], "runs": runs[name] * len(regimes)} for name in runs}
    selection = {group: choices[group] for group in ("scenario", "model", "filter", "train")}
    selection["noise"] = "+".join(regimes)
    content = {"config": cfg, "choices": selection, "split": split, **metadata}
    return train(training, method, model, data, validation, path, content, tell)


def _checkpoint_path(
    cfg: Mapping[str, Any],
    choices: Mapping[str, str],
    regimes: Mapping[str, NoiseRegime],
    path: str | None,
    inputs: Inputs,
) -> Path:
    """Return the given path, or one that depends on all settings and inputs of the training."""
    if path:
        return Path(path)
    groups = ("model", "scenario", "filter", "train", "noise", "dtype")
    settings = {group: cfg[group] for group in groups} | {"noises": [*regimes]}
    ignored = ("scenario.root", "scenario.cache_dir", "train.checkpoint_path")
    key = compute_config_key(checkpoint.replace_checkpoint_by_hash(settings), ignored)
    key = extend_key(key, inputs)
    name = f"{choices['filter']}_{choices['scenario']}_{key}.pt"
    return Path(cfg["results_dir"]) / cfg["study"] / "checkpoints" / name


def _checkpoint_content(
    state: TrainingState, progress: Progress, metadata: Mapping[str, Any]
) -> dict[str, Any]:
    """Return weights of the best epoch, losses, cost and description."""
    cost = {
        "seconds": progress.seconds,
        "epochs": progress.epoch,
        "updates": progress.updates,
        "particles": getattr(state.method, "particles", None),
        "device": str(state.model.anchor.device),
        "threads": torch.get_num_threads(),
    }
    networks = {
        name: {key: a.cpu() for key, a in weights.items()}
        for name, weights in progress.best_weights.items()
    }
    return {
        "choices": {},
        **json.loads(json.dumps(metadata)),
        "networks": networks,
        "sizes": {name: list(module.sizes) for name, module in state.parts.items()},
        "frames": {name: module.learnable.frame for name, module in state.parts.items()},
        "model": {"class": type(state.model).__name__, "names": list(state.model.names)},
        "losses": progress.losses,
        "best": progress.best,
        "cost": cost,
    }


# --------------------------------------------------------------------------------------------------
# Log of a training: a CSV table, and TensorBoard if it is installed.


def write_losses(path: Path, lines: list[dict[str, float]]) -> None:
    """Write the log lines of all epochs to a CSV file.

    Another kind of file under this name is renamed to `NAME.kept`.
    """
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(lines[0]))
    writer.writeheader()
    writer.writerows(lines)
    head = ",".join(lines[0]).encode()
    if path.is_symlink() or (path.exists() and not path.read_bytes().startswith(head)):
        set_aside(path, "kept")
    write_atomically(path, lambda file: file.write(text.getvalue().encode()))


def open_tensorboard(path: Path) -> Callable[[dict[str, float]], None]:
    """Return a function that writes log lines for TensorBoard."""
    if importlib.util.find_spec("tensorboard") is None:
        return lambda line: None
    from torch.utils.tensorboard import SummaryWriter

    writer: Any = SummaryWriter(str(path.with_suffix("")))

    def write(line: dict[str, float]) -> None:
        for name, value in line.items():
            writer.add_scalar(name, value, int(line["epoch"]))
        writer.flush()

    return write
