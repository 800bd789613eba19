"""Training of the networks in a filter, for any network and objective.

All random numbers come from counters (seed, epoch, batch, run, step). A resumed training therefore
gives the bits of an uninterrupted one, and batch size and machine do not change the training runs.
"""

from __future__ import annotations

import logging
import time
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from pfbench.core.parameter_checks import require, require_ranges
from pfbench.core.random_stream import PhiloxStream, RandomStream, relabel
from pfbench.core.record import Record
from pfbench.filter.belief import Filter, GaussianBelief, ParticleBelief, StepInfo
from pfbench.filter.learned import checkpoint
from pfbench.filter.learned.checkpoint import flatten_parameters
from pfbench.filter.learned.gain_filter import LearnedGainFilter
from pfbench.filter.learned.objectives import (
    EvidenceLowerBound,
    Objective,
    TrainableFilter,
    TrainingStep,
    find_learned_parts,
    simulate_from_model,
)
from pfbench.filter.learned.proposal import LearnedProposal
from pfbench.filter.loop import FilterPass
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.filter.particle.stages import EssResampler, Resampler, Systematic
from pfbench.learn.training_data import TrainingData
from pfbench.model.base import StateSpaceModel, initial_law

logger = logging.getLogger("pfbench")

# a resumed training must have the same values of these
_RESUMED_SETTINGS = (
    "particles",
    "seed",
    "gradient_steps",
    "batch_size",
    "learning_rate",
    "max_grad_norm",
)


class TrainingState:
    """The networks of a filter and their optimiser.

    Attributes:
        method: The filter, with resampler and number of particles of the training if it has particles.
        parts: Trained parts by name.
        weights: Trained parameters.
    """

    def __init__(
        self,
        training: Training,
        method: TrainableFilter,
        model: StateSpaceModel,
        data: TrainingData,
    ) -> None:
        self.training, self.model = training, model
        self.method = set_up_filter(training, method)
        self.parts = find_learned_parts(self.method)
        self._build_networks(data.select_runs(torch.arange(1)).record)
        self.weights = [p for module in self.parts.values() for p in module.parameters()]
        self._optimiser = torch.optim.Adam(self.weights, training.learning_rate)
        initial: Any = initial_law(model, 1, data.record.spread)
        self._scale = initial.stddev
        self._settings = self._describe(data)

    def run_epoch(
        self, progress: Progress, data: TrainingData, validation: TrainingData
    ) -> dict[str, float]:
        """Train one epoch, then compute the validation loss.

        Returns values of the log line of the epoch, by name.
        """
        start_time = time.perf_counter()
        batches = self._batches(len(data.record.y), progress.epoch)
        results = [self._batch(data.select_runs(rows), rows, progress) for rows in batches]
        value, ess = self.validate(validation)
        progress.epoch += 1
        progress.epochs_since_best += 1
        if value < progress.best:
            progress.best, progress.epochs_since_best = value, 0
            progress.best_weights = {
                name: {key: value.detach().clone() for key, value in weights.items()}
                for name, weights in self._network_weights().items()
            }
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

    def validate(self, data: TrainingData) -> tuple[float, float]:
        """Return the mean loss per step on validation data, and the mean ESS / N.

        The random numbers are the same in each call.
        """
        rows = torch.arange(len(data.record.y))
        data, draws = self._loss_data(data, rows, "validation"), self._draws("validation", rows)
        with torch.no_grad():
            segments = list(self._segments(data, draws))
        loss, ess = (torch.cat([segment[k] for segment in segments]).mean() for k in range(2))
        return float(loss), float(ess)

    def save(self, path: Path, progress: Progress) -> None:
        """Write all that resuming the training needs."""
        content = {
            "networks": self._network_weights(),
            "optimiser": self._optimiser.state_dict(),
            "progress": vars(progress),
            "settings": self._settings,
        }
        checkpoint.write_checkpoint(path, content)

    def restore(self, path: Path) -> Progress:
        """Resume a stopped training, or start a new one.

        Returns Progress of the stopped or new training.
        """
        if not path.exists():
            return Progress()
        content = checkpoint.read_checkpoint(path)
        for name, value in self._settings.items():
            stored = content.get("settings", {}).get(name)
            require(
                stored == value,
                name,
                f"be {stored} to resume the training stopped at {path}",
                value,
                "Use its settings, another train.checkpoint_path, or overwrite=true.",
            )
        for name, module in self.parts.items():
            networks = dict(module.named_children())
            checkpoint.load_parameters(str(path), content["networks"][name], networks)
        self._optimiser.load_state_dict(content["optimiser"])
        logger.info("training resumes from epoch %d of %s", content["progress"]["epoch"], path)
        return Progress(**content["progress"])

    def _build_networks(self, record: Record) -> None:
        """Build the networks for the sizes of a record of one run."""
        draws = self._draws("sizes", torch.arange(1))
        belief: Any = self.method.init(self.model, 1, draws, record.start, record.spread)
        for module in self.parts.values():
            is_new = module.learnable.checkpoint is None
            if isinstance(module, LearnedProposal):
                module.build(self.model, belief, record.at_step(0), is_new)
            else:
                module.build(self.model, record.y.shape[-1], is_new)

    def _network_weights(self) -> dict[str, checkpoint.Weights]:
        """Return the weights of the networks of each trained part."""
        return {
            name: flatten_parameters(dict(module.named_children()))
            for name, module in self.parts.items()
        }

    def _describe(self, data: TrainingData) -> dict[str, Any]:
        """Return the settings that a resumed training must share."""
        training = self.training
        parts = [f"{module.learnable.frame} {module.sizes}" for module in self.parts.values()]
        tensors = {"training_data": {"y": data.record.y, "states": data.states}}
        return {
            "objective": type(training.objective).__name__,
            "resampler": type(training.resampler).__name__,
            **{name: getattr(training, name) for name in _RESUMED_SETTINGS},
            "proposal": ", ".join(parts),
            "training_data": checkpoint.hash_weights(tensors),
        }

    def _batch(
        self, data: TrainingData, rows: Tensor, progress: Progress
    ) -> tuple[float, float, float]:
        """Return mean loss, mean gradient norm and the number of skipped updates."""
        name, losses, norms, skipped = f"epoch {progress.epoch}", [], [], 0
        data, draws = self._loss_data(data, rows, name), self._draws(name, rows)
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

    def _segments(self, data: TrainingData, draws: PhiloxStream) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield losses and ESS / N [S, R] of each segment."""
        objective, steps = self.training.objective, self.training.gradient_steps
        return iterate_segments(objective, steps, self.method, self.model, data, draws, self._scale)

    def _loss_data(self, data: TrainingData, rows: Tensor, name: str) -> TrainingData:
        """Return the data, or data simulated from the model if the objective requires it."""
        if not self.training.objective.needs_simulated_data:
            return data
        with torch.no_grad():
            draws = relabel(self._draws(name, rows), "imagined.")
            record, states, noises = simulate_from_model(self.model, data.record, draws)
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


# --------------------------------------------------------------------------------------------------
# Pass of a filter through training data, with gradients cut between segments.


def iterate_segments(
    objective: Objective,
    segment: int | None,
    method: TrainableFilter,
    model: StateSpaceModel,
    data: TrainingData,
    draws: RandomStream,
    scale: Tensor,
) -> Iterator[tuple[Tensor, Tensor]]:
    """Iterate over segments of steps of training data, without gradients between them.

    Shapes: scale [R or 1, d].
    """
    steps = data.record.y.shape[1]
    recording = torch.is_grad_enabled() and objective.needs_filter_gradient
    filter_pass = FilterPass(_GradientMode(method, recording), model, data.record, draws)
    losses, ess_fractions, before = [], [], filter_pass.belief
    for t, step_model, record, info, step_draws in filter_pass:
        parent, noise = (None if a is None else a[:, t] for a in (data.parents, data.noises))
        training_step = TrainingStep(
            method, step_model, before, filter_pass.belief, info, record,
            data.states[:, t], parent, noise, scale, relabel(step_draws, "lesson."),
        )  # fmt: skip
        losses.append(objective(training_step))
        ess_fractions.append(_ess_fraction(method, info))
        if t + 1 == steps or (segment is not None and (t + 1) % segment == 0):
            yield torch.stack(losses), torch.stack(ess_fractions)
            losses, ess_fractions = [], []
            filter_pass.belief = _detach(filter_pass.belief)
        before = filter_pass.belief


@dataclass(frozen=True)
class _GradientMode:
    """A filter whose steps record gradients if enabled."""

    method: Filter
    enabled: bool

    @property
    def is_exact(self) -> bool:
        return self.method.is_exact

    def init(self, *args: Any) -> Any:
        return self.method.init(*args)

    def step(
        self, model: StateSpaceModel, belief: Any, record: Record, draws: RandomStream
    ) -> tuple[Any, StepInfo]:
        with torch.set_grad_enabled(self.enabled):
            return self.method.step(model, belief, record, draws)


def _ess_fraction(method: TrainableFilter, info: StepInfo) -> Tensor:
    """Return ESS / N of a step, [R]; NaN for a filter without particles."""
    if isinstance(method, LearnedGainFilter):
        return torch.full_like(info.mean[:, 0], torch.nan).detach()
    return info.trace["ess"].detach() / method.particles


def _detach(value: Any) -> Any:
    """Return a belief, or a part of one, without gradient history."""
    if isinstance(value, Tensor):
        return value.detach()
    if isinstance(value, dict):
        return {name: _detach(a) for name, a in value.items()}
    if isinstance(value, ParticleBelief | GaussianBelief):
        return value._replace(**{name: _detach(a) for name, a in value._asdict().items()})
    return value


# --------------------------------------------------------------------------------------------------
# Settings and progress of a training.


@dataclass(frozen=True)
class Optimisation:
    """Settings of the updates of the weights of a training.

    Attributes:
        objective: Loss function.
        resampler: Resampler of the filter during training. It decides which gradient passes
            through resampling.
        particles: Number of particles during training.
        gradient_steps: Number of steps through which a gradient passes before it is cut and the
            weights are updated. None for all.
        epochs: Maximum number of epochs.
        batch_size: Number of runs per update, drawn again in each epoch from all regimes.
        learning_rate: Learning rate of Adam (Kingma and Ba 2015).
        max_grad_norm: Maximum norm of a gradient.
        patience_epochs: Number of epochs without a lower validation loss before training stops.
    """

    objective: Objective = field(default_factory=EvidenceLowerBound)
    resampler: Resampler = field(default_factory=lambda: EssResampler(Systematic(), 1.0))
    particles: int = 32
    gradient_steps: int | None = 5
    epochs: int = 50
    batch_size: int = 16
    learning_rate: float = 1e-3
    max_grad_norm: float = 10.0
    patience_epochs: int = 10


@dataclass(frozen=True)
class Training(Optimisation):
    """Settings of a training: its runs, and the updates of the weights.

    Attributes:
        training_runs: Number of training runs of each noise regime.
        validation_runs: Number of validation runs of each noise regime, used for early stopping.
        noise_regimes: Names of the noise regimes of a mixture. Empty for the chosen noise regime.
        seed: Seed of the training runs and of all other random numbers. The validation runs use
            the next one.
        max_steps: Number of steps of each record to use. None for all.
        checkpoint_path: Path of the checkpoint. None for the folder of the results.

    Raises:
        ValueError: If a value is out of range.
    """

    training_runs: int = 64
    validation_runs: int = 32
    noise_regimes: Sequence[str] = ()
    seed: int = 1001
    max_steps: int | None = None
    checkpoint_path: str | None = None

    def __post_init__(self) -> None:
        counts = ("training_runs", "validation_runs", "epochs", "batch_size", "patience_epochs")
        require_ranges(
            "train",
            self,
            particles="whole [2, inf)",
            seed="whole [0, inf)",
            **dict.fromkeys(counts, "whole [1, inf)"),
            **dict.fromkeys(("max_steps", "gradient_steps"), "null or whole [1, inf)"),
            **dict.fromkeys(("learning_rate", "max_grad_norm"), "(0, inf] Use 0.001."),
        )


@dataclass
class Progress:
    """Progress of a training.

    With networks and optimiser it is sufficient to resume the training.

    Attributes:
        epoch: Number of finished epochs.
        best: Lowest validation loss.
        epochs_since_best: Number of epochs since the lowest validation loss.
        updates: Number of weight updates.
        seconds: Training time, s.
        losses: Log line of each epoch.
        best_weights: Weights of the best epoch, by trained part.
    """

    epoch: int = 0
    best: float = float("inf")
    epochs_since_best: int = 0
    updates: int = 0
    seconds: float = 0.0
    losses: list[dict[str, float]] = field(default_factory=list)
    best_weights: dict[str, checkpoint.Weights] = field(default_factory=dict)


def set_up_filter(training: Training, method: TrainableFilter) -> TrainableFilter:
    """Return a filter with the resampler and the number of particles of a training."""
    if isinstance(method, ParticleFilter):
        return replace(method, particles=training.particles, resampler=training.resampler)
    require(
        not training.objective.needs_particles,
        "train.objective",
        "be defined without particles for a learned gain",
        type(training.objective).__name__,
        "Choose train=gain.",
    )
    return method
