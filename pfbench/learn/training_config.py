"""Settings and progress of a training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from pfbench.filter.learned import checkpoint
from pfbench.filter.learned.objectives import EvidenceLowerBound, Objective, TrainableFilter
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.filter.particle.resampling import EssResampler, Resampler
from pfbench.filter.particle.resampling_schemes import Systematic


@dataclass(frozen=True)
class Training:
    """Settings of a training.

    Attributes:
        objective: Loss function.
        resampler: Resampler of the filter during training. It decides which gradient passes
            through resampling.
        particles: Number of particles during training.
        training_runs: Number of training runs of each noise regime.
        validation_runs: Number of validation runs of each noise regime, used for early stopping.
        noise_regimes: Names of the noise regimes of a mixture. Empty for the chosen noise regime.
        seed: Seed of the training runs and of all other random numbers. The validation runs use
            the next one.
        max_steps: Number of steps of each record to use. None for all.
        gradient_steps: Number of steps through which a gradient passes before it is cut and the
            weights are updated. None for all.
        epochs: Maximum number of epochs.
        batch_size: Number of runs per update, drawn again in each epoch from all regimes.
        learning_rate: Learning rate of Adam (Kingma and Ba 2015).
        max_grad_norm: Maximum norm of a gradient.
        patience_epochs: Number of epochs without a lower validation loss before training stops.
        checkpoint_path: Path of the checkpoint. None for the folder of the results.

    Raises:
        ValueError: If a value is out of range.
    """

    objective: Objective = field(default_factory=EvidenceLowerBound)
    resampler: Resampler = field(default_factory=lambda: EssResampler(Systematic(), 1.0))
    particles: int = 32
    training_runs: int = 64
    validation_runs: int = 32
    noise_regimes: Sequence[str] = ()
    seed: int = 1001
    max_steps: int | None = None
    gradient_steps: int | None = 5
    epochs: int = 50
    batch_size: int = 16
    learning_rate: float = 1e-3
    max_grad_norm: float = 10.0
    patience_epochs: int = 10
    checkpoint_path: str | None = None

    def __post_init__(self) -> None:
        minima = {"particles": 2, "training_runs": 1, "validation_runs": 1, "seed": 0, "epochs": 1}
        minima |= {"batch_size": 1, "patience_epochs": 1, "max_steps": 1, "gradient_steps": 1}
        for name, minimum in minima.items():
            value = getattr(self, name)
            if value is None and name in ("max_steps", "gradient_steps"):
                continue
            if type(value) is not int or value < minimum:
                raise ValueError(
                    f"train.{name} must be an integer of at least {minimum}, got {value}. "
                    f"Set train.{name}={minimum} or more."
                )
        for name in ("learning_rate", "max_grad_norm"):
            value = getattr(self, name)
            if not value > 0.0:
                raise ValueError(
                    f"train.{name} must be positive, got {value}. Set train.{name}=0.001."
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
    """Return a filter with the resampler and the number of particles of a training.

    Args:
        training: Settings.
        method: The filter. One without particles is returned unchanged.

    Raises:
        ValueError: If the objective needs particles and the filter has none.
    """
    if isinstance(method, ParticleFilter):
        return replace(method, particles=training.particles, resampler=training.resampler)
    if training.objective.needs_particles:
        raise ValueError(
            "train.objective must be defined without particles for a learned gain, got "
            f"{type(training.objective).__name__}. Choose train=gain."
        )
    return method
