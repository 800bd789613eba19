"""Training of the networks in a filter, for any network, objective and gradient of resampling.

All random numbers come from counters (seed, epoch, batch, run, step). A resumed training therefore
gives the bits of an uninterrupted one, and batch size and machine do not change the training runs.
"""

from __future__ import annotations

import logging
import time
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from pfbench.core.derived_stream import relabel
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record
from pfbench.filter.learned import checkpoint
from pfbench.filter.learned.checkpoint import flatten_parameters
from pfbench.filter.learned.objectives import find_learned_parts, simulate_from_model
from pfbench.filter.learned.proposal import LearnedProposal
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.learn.gradient_segments import iterate_segments
from pfbench.learn.training_config import Progress, Training
from pfbench.learn.training_data import TrainingData
from pfbench.model.base import StateSpaceModel, initial_law

logger = logging.getLogger("pfbench")


class TrainingState:
    """The networks of a filter and their optimiser.

    Args:
        training: Settings.
        method: The filter.
        model: State-space model.
        worlds: Training data. The first run gives the sizes of the networks.

    Attributes:
        method: The filter with resampler and number of particles of the training.
        parts: Trained parts by name.
        weights: Trained parameters.
    """

    def __init__(
        self,
        training: Training,
        method: ParticleFilter,
        model: StateSpaceModel,
        worlds: TrainingData,
    ) -> None:
        self.training, self.model = training, model
        self.method = replace(method, particles=training.particles, resampler=training.resampler)
        self.parts = find_learned_parts(self.method)
        self._build_networks(worlds.select_runs(torch.arange(1)).record)
        self.weights = [p for part in self.parts.values() for p in part.parameters()]
        self._optimiser = torch.optim.Adam(self.weights, training.learning_rate)
        initial: Any = initial_law(model, 1, worlds.record.spread)
        self._scale = initial.stddev
        self._settings = self._describe(worlds)

    def run_epoch(
        self, progress: Progress, worlds: TrainingData, validation: TrainingData
    ) -> dict[str, float]:
        """Train one epoch, then compute the validation loss.

        Args:
            progress: Progress of the training. It is updated.
            worlds: Training data.
            validation: Validation data.

        Returns:
            Log line of the epoch.
        """
        start_time = time.perf_counter()
        batches = self._batches(len(worlds.record.y), progress.epoch)
        results = [self._batch(worlds.select_runs(rows), rows, progress) for rows in batches]
        value, ess = self.validate(validation)
        progress.epoch += 1
        progress.epochs_since_best += 1
        if value < progress.best:
            progress.best, progress.epochs_since_best = value, 0
            networks = {
                name: flatten_parameters(_networks(part)) for name, part in self.parts.items()
            }
            progress.best_weights = {name: _copy(weights) for name, weights in networks.items()}
        progress.seconds += time.perf_counter() - start_time
        loss, gradient, skipped = (sum(result[k] for result in results) for k in range(3))
        line = {
            "epoch": float(progress.epoch),
            "loss": loss / len(results),
            "validation": value,
            "ess": ess,
            "gradient": gradient / len(results),
            "skipped": skipped,
            "seconds": progress.seconds,
        }
        progress.losses.append(line)
        return line

    def validate(self, worlds: TrainingData) -> tuple[float, float]:
        """Return the mean loss per step on validation data, and the mean ESS / N.

        The random numbers are the same in each call.
        """
        rows = torch.arange(len(worlds.record.y))
        data, draws = self._data(worlds, rows, "validation"), self._draws("validation", rows)
        with torch.no_grad():
            segments = list(self._segments(data, draws))
        loss, ess = (torch.cat([segment[k] for segment in segments]).mean() for k in range(2))
        return float(loss), float(ess)

    def save(self, path: Path, progress: Progress) -> None:
        """Write all that resuming the training needs.

        Args:
            path: The file.
            progress: Progress of the training.
        """
        content = {
            "networks": {
                name: flatten_parameters(_networks(part)) for name, part in self.parts.items()
            },
            "optimiser": self._optimiser.state_dict(),
            "progress": vars(progress),
            "settings": self._settings,
        }
        checkpoint.write_checkpoint(path, content)

    def restore(self, path: Path) -> Progress:
        """Resume a stopped training, or start a new one.

        Args:
            path: File that `save` wrote. It need not exist.

        Returns:
            Progress of the stopped or new training.

        Raises:
            ValueError: If the stopped training had other settings.
        """
        if not path.exists():
            return Progress()
        content = checkpoint.read_checkpoint(path)
        for name, value in self._settings.items():
            stored = content.get("settings", {}).get(name)
            if stored != value:
                raise ValueError(
                    f"{name} must be {stored} to resume the training stopped at {path}, got "
                    f"{value}. Use its settings, another train.checkpoint_path, or overwrite=true to remove it."
                )
        for name, part in self.parts.items():
            checkpoint.load_parameters(str(path), content["networks"][name], _networks(part))
        self._optimiser.load_state_dict(content["optimiser"])
        logger.info("training resumes from epoch %d of %s", content["progress"]["epoch"], path)
        return Progress(**content["progress"])

    def _build_networks(self, record: Record) -> None:
        """Build the networks for the sizes of a record of one run."""
        draws = self._draws("sizes", torch.arange(1))
        cloud = self.method.init(self.model, 1, draws, record.start, record.spread)
        for part in self.parts.values():
            is_new = part.learnable.checkpoint is None
            if isinstance(part, LearnedProposal):
                part.build(self.model, cloud, record.at_step(0), is_new)
            else:
                part.build(self.model, record.y.shape[-1], is_new)

    def _describe(self, worlds: TrainingData) -> dict[str, Any]:
        """Return the settings that a resumed training must share."""
        training = self.training
        names = (
            "particles",
            "seed",
            "gradient_steps",
            "batch_size",
            "learning_rate",
            "max_grad_norm",
        )
        parts = [f"{part.learnable.frame} {part.sizes}" for part in self.parts.values()]
        data = {"worlds": {"y": worlds.record.y, "states": worlds.states}}
        return {
            "objective": type(training.objective).__name__,
            "resampler": type(training.resampler).__name__,
            **{name: getattr(training, name) for name in names},
            "proposal": ", ".join(parts),
            "worlds": checkpoint.hash_weights(data),
        }

    def _batch(
        self, worlds: TrainingData, rows: Tensor, progress: Progress
    ) -> tuple[float, float, float]:
        """Return mean loss, mean norm of the gradient and number of updates skipped as not finite."""
        name, losses, norms, skipped = f"epoch {progress.epoch}", [], [], 0
        data, draws = self._data(worlds, rows, name), self._draws(name, rows)
        for loss, _ in self._segments(data, draws):
            self._optimiser.zero_grad()
            if loss.requires_grad:
                loss.mean().backward()
            norm = nn.utils.clip_grad_norm_(self.weights, self.training.max_grad_norm)
            if bool(torch.isfinite(norm)):
                self._optimiser.step()
                progress.updates += 1
                norms.append(float(norm))
            else:
                skipped += 1
            losses.append(loss.detach().mean())
        mean_norm = sum(norms) / max(1, len(norms))
        return float(torch.stack(losses).mean()), mean_norm, float(skipped)

    def _segments(
        self, worlds: TrainingData, draws: PhiloxStream
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield losses and ESS / N [S, R] of each segment."""
        training = self.training
        return iterate_segments(
            training.objective,
            training.gradient_steps,
            self.method,
            self.model,
            worlds,
            draws,
            self._scale,
        )

    def _data(self, worlds: TrainingData, rows: Tensor, name: str) -> TrainingData:
        """Return the data, or data simulated from the model if the objective requires it."""
        if not self.training.objective.needs_simulated_data:
            return worlds
        with torch.no_grad():
            draws = relabel(self._draws(name, rows), "imagined.")
            record, states, noises = simulate_from_model(self.model, worlds.record, draws)
        return TrainingData(record, states[:, 1:], states[:, :-1], noises)

    def _draws(self, name: str, rows: Tensor) -> PhiloxStream:
        """Return the random stream of these runs under a name."""
        seed = zlib.crc32(f"training {self.training.seed} {name}".encode())
        return PhiloxStream(seed, rows.to(self.model.anchor.device), self.model.anchor.dtype)

    def _batches(self, runs: int, epoch: int) -> Sequence[Tensor]:
        """Return the run indices of each batch, in a random order."""
        draws = self._draws(f"order {epoch}", torch.arange(1))
        order = draws.uniform("order", runs, 1)[0, :, 0].argsort()
        return order.split(self.training.batch_size)


def _networks(part: nn.Module) -> dict[str, nn.Module]:
    """Return the networks of a trained part by name."""
    return dict(part.named_children())


def _copy(weights: checkpoint.Weights) -> checkpoint.Weights:
    """Copy weights."""
    return {name: value.detach().clone() for name, value in weights.items()}
