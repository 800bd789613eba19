"""Training of what is learned in a filter: one loop, whatever the network, the objective and the gradient of resampling.

Everything drawn comes from counters (seed, epoch, batch, world, step), so that a training that was stopped goes on as if it had
not been, to the last bit, and another batch size or machine sees the same worlds.
"""

from __future__ import annotations

import csv
import importlib.util
import json
import logging
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from tqdm import tqdm

from pfbench import store
from pfbench.draws import MonteCarlo
from pfbench.filter import learned_weights
from pfbench.filter.belief import Cloud
from pfbench.filter.derived_draws import named
from pfbench.filter.learned import Learned
from pfbench.filter.learned_objectives import Bound, Lesson, Objective, imagine, learned_parts
from pfbench.filter.learned_weights import flat
from pfbench.filter.particle import ParticleFilter
from pfbench.filter.resamplers import Resample, Resampler, Systematic
from pfbench.lessons import Worlds, draw_worlds
from pfbench.model.base import AtRest, StateSpaceModel, initial_law
from pfbench.noise.regimes import Regime

log = logging.getLogger("pfbench")


@dataclass(frozen=True)
class Training:
    """How a network is fitted.

    Args:
        objective: the loss.
        resampler: of the filter while it is trained, and so which gradient passes through resampling.
        particles: of the filter while it is trained.
        worlds, validation: numbers of worlds to learn from and to stop by; for each noise regime of a mixture.
        noises: names of noise regimes that are mixed; none for the one that is chosen.
        seed: of the worlds to learn from; those of the validation have the next one. Also of all else that is drawn.
        steps: of each record that are used; null for all.
        segment: steps through which a gradient passes before it is cut and an update made; null for all.
        epochs: rounds through all worlds, at most.
        batch: worlds of one update, drawn anew in each epoch from all regimes.
        learning_rate: of Adam [Kingma and Ba 2015].
        clip: largest norm of a gradient.
        patience: epochs without a better loss on the validation after which it stops.
        to: the checkpoint; null puts it beside the results.

    Raises:
        ValueError: names the key, the value and the remedy.
    """

    objective: Objective = field(default_factory=Bound)
    resampler: Resampler = field(default_factory=lambda: Resample(Systematic(), 1.0))
    particles: int = 32
    worlds: int = 64
    validation: int = 32
    noises: Sequence[str] = ()
    seed: int = 1001
    steps: int | None = None
    segment: int | None = 5
    epochs: int = 50
    batch: int = 16
    learning_rate: float = 1e-3
    clip: float = 10.0
    patience: int = 10
    to: str | None = None

    def __post_init__(self) -> None:
        whole = {"particles": 2, "worlds": 1, "validation": 1, "seed": 0, "epochs": 1, "batch": 1, "patience": 1}
        whole |= {name: 1 for name in ("steps", "segment") if getattr(self, name) is not None}
        for name, least in whole.items():
            value = getattr(self, name)
            if type(value) is not int or value < least:
                raise ValueError(f"train.{name}={value}: give a whole number, {least} or more")
        for name in ("learning_rate", "clip"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"train.{name}={getattr(self, name)}: give a positive number")


@dataclass
class Progress:
    """How far a training has come; with the networks and the optimiser it is all that going on needs."""

    epoch: int = 0
    best: float = float("inf")
    since: int = 0
    updates: int = 0
    seconds: float = 0.0
    losses: list[dict[str, float]] = field(default_factory=list)
    kept: dict[str, learned_weights.Weights] = field(default_factory=dict)


def train(
    training: Training,
    method: ParticleFilter,
    model: StateSpaceModel,
    worlds: Worlds,
    validation: Worlds,
    path: str | Path,
    about: Mapping[str, Any] | None = None,
    tell: Callable[[str], object] | None = None,
) -> Path:
    """Fits what is learned in a filter and writes the checkpoint of the best epoch by the validation's loss.

    After each epoch `<path>.part` holds all that going on needs; it is taken up where it is found, and removed at the end.
    `<path>` with the ending .csv has the losses; where tensorboard is installed, a folder beside has its log.

    Args:
        training: how.
        method: the filter; its resampler and number of particles are the training's while it learns.
        model: on its device and in its precision.
        worlds, validation: see draw_worlds.
        path: of the checkpoint.
        about: what else the checkpoint holds, in plain numbers, texts, lists and dicts: config, choices, split.
        tell: is told of each epoch in words, besides the bar.

    Raises:
        ValueError: nothing to train; an objective that does not fit the filter; another training was stopped at this path.
    """
    path = Path(path)
    pupil = Pupil(training, method, model, worlds)
    progress = pupil.restore(path.with_name(path.name + ".part"))
    board = _board(path)
    with tqdm(total=training.epochs, initial=progress.epoch, desc="training", unit="epoch", disable=None, leave=False) as bar:
        while progress.epoch < training.epochs and progress.since < training.patience:
            line = pupil.epoch(progress, worlds, validation)
            bar.set_postfix({name: f"{line[name]:.4g}" for name in ("loss", "validation")})
            bar.update()
            board(line)
            if tell:
                with tqdm.external_write_mode():
                    tell(" ".join(f"{name} {value:.5g}" for name, value in line.items()))
            pupil.save(path.with_name(path.name + ".part"), progress)
            _write_csv(path.with_suffix(".csv"), progress.losses)
    learned_weights.write(path, pupil.finished(progress, about or {}))
    path.with_name(path.name + ".part").unlink(missing_ok=True)
    return path


def fit(
    cfg: Mapping[str, Any], choices: Mapping[str, str], regimes: Mapping[str, Regime], build: Callable[[Any], Any],
    about: Mapping[str, Any], tell: Callable[[str], object],
) -> Path:  # fmt: skip
    """Trains what a configuration describes, unless that has been done; the checkpoint.

    Args:
        cfg: resolved, of the command line.
        choices: names of what was chosen in each group.
        regimes: of noise, by name: they are mixed.
        build: makes the object that a node of the configuration describes.
        about: what else the checkpoint is to hold.
        tell: is told of each epoch in words.

    Raises:
        ValueError: as `train`, and values that are of no use.
    """
    model, plan, method = (build(cfg[part]) for part in ("model", "train", "filter"))
    model, scenario = model.to(cfg["device"], getattr(torch, cfg["dtype"])), build(cfg["scenario"])
    path = Path(plan.to or Path(cfg["results"]) / cfg["study"] / "checkpoints" / f"{_name(cfg, choices, regimes)}.pt")
    if path.exists() and not cfg["fresh"]:
        tell(f"trained already: {path}  (fresh=true trains again)")
        return path
    if cfg["fresh"]:
        path.with_name(path.name + ".part").unlink(missing_ok=True)
    lots = {"train": (plan.worlds, plan.seed), "validation": (plan.validation, plan.seed + 1)}
    worlds, others = (draw_worlds(scenario, [*regimes.values()], model, *lot, plan.steps) for lot in lots.values())
    split = {part: {"seed": seed, "runs": runs * len(regimes)} for part, (runs, seed) in lots.items()}
    chosen = {group: choices[group] for group in ("scenario", "model", "filter", "train")} | {"noise": "+".join(regimes)}
    told = {"config": cfg, "choices": chosen, "split": {"scenario": choices["scenario"], **split}}
    return train(plan, method, model, worlds, others, path, {**told, **about}, tell)


def _name(cfg: Mapping[str, Any], choices: Mapping[str, str], regimes: Mapping[str, Regime]) -> str:
    """Of a checkpoint, by all that decides it."""
    kept = {part: cfg[part] for part in ("model", "scenario", "filter", "train", "noise", "dtype")} | {"noises": [*regimes]}
    key = store.key(learned_weights.by_content(kept), ("scenario.root", "scenario.cache", "train.to"))
    return f"{choices['filter']}_{choices['scenario']}_{key}"


class Pupil:
    """The networks of a filter, their optimiser, and one way through the worlds."""

    def __init__(self, training: Training, method: ParticleFilter, model: StateSpaceModel, worlds: Worlds) -> None:
        self.training, self.model = training, model
        self.method = replace(method, particles=training.particles, resampler=training.resampler)
        self.parts = learned_parts(self.method)
        some = worlds.of(torch.arange(1))
        cloud = self.method.init(model, 1, self._draws("sizes", torch.arange(1)), some.record.start, some.record.spread)
        for part in self.parts.values():
            fresh = part.learnable.checkpoint is None
            if isinstance(part, Learned):
                part.begin(model, cloud, some.record.at(0), fresh)
            else:
                part.begin(model, some.record.y.shape[-1], fresh)
        self.weights = [p for part in self.parts.values() for p in part.parameters()]
        self.optimiser = torch.optim.Adam(self.weights, training.learning_rate)
        law: Any = initial_law(model, 1, None if some.record.spread is None else some.record.spread)
        self.scale = law.stddev
        told = {"objective": type(training.objective).__name__, "resampler": type(training.resampler).__name__}
        told |= {name: getattr(training, name) for name in ("particles", "seed", "segment", "batch", "learning_rate", "clip")}
        self.same = told | {
            "proposal": ", ".join(f"{part.learnable.frame} {part.sizes}" for part in self.parts.values()),
            "worlds": learned_weights.digest({"worlds": {"y": worlds.record.y, "states": worlds.states}}),
        }

    def epoch(self, progress: Progress, worlds: Worlds, validation: Worlds) -> dict[str, float]:
        """One round through the worlds, then the validation; the line of the log."""
        began = time.perf_counter()
        lines = [self._batch(worlds.of(rows), rows, progress) for rows in self._batches(len(worlds.record.y), progress.epoch)]
        value, ess = self.validate(validation)
        progress.epoch += 1
        progress.since += 1
        if value < progress.best:
            progress.best, progress.since = value, 0
            progress.kept = {name: _copy(flat(_networks(part))) for name, part in self.parts.items()}
        progress.seconds += time.perf_counter() - began
        loss, gradient, skipped = (sum(line[k] for line in lines) for k in range(3))
        many = len(lines)
        line = {"epoch": float(progress.epoch), "loss": loss / many, "validation": value, "ess": ess, "gradient": gradient / many}
        line |= {"skipped": skipped, "seconds": progress.seconds}
        progress.losses.append(line)
        return line

    def validate(self, worlds: Worlds) -> tuple[float, float]:
        """Loss per step on worlds that are not learned from, always with the same draws, and mean ESS / N."""
        rows = torch.arange(len(worlds.record.y))
        with torch.no_grad():
            parts = list(self._walk(self._known(worlds, rows, "validation"), self._draws("validation", rows)))
        loss, ess = (torch.cat([part[k] for part in parts]).mean() for k in range(2))
        return float(loss), float(ess)

    def _batch(self, worlds: Worlds, rows: Tensor, progress: Progress) -> tuple[float, float, float]:
        """Mean loss, mean norm of the gradient, and updates that were skipped because it was not finite."""
        name, losses, norms, skipped = f"epoch {progress.epoch}", [], [], 0
        for loss, _ in self._walk(self._known(worlds, rows, name), self._draws(name, rows)):
            self.optimiser.zero_grad()
            if loss.requires_grad:
                loss.mean().backward()
            norm = nn.utils.clip_grad_norm_(self.weights, self.training.clip)
            if bool(torch.isfinite(norm)):
                self.optimiser.step()
                progress.updates += 1
                norms.append(float(norm))
            else:
                skipped += 1
            losses.append(loss.detach().mean())
        return float(torch.stack(losses).mean()), sum(norms) / max(1, len(norms)), float(skipped)

    def _walk(self, worlds: Worlds, draws: MonteCarlo) -> Iterator[tuple[Tensor, Tensor]]:
        """The filter's way through some worlds: losses and ESS / N of a segment's steps and runs [S, R], segment by segment."""
        record, objective, learning = worlds.record, self.training.objective, torch.is_grad_enabled()
        steps = record.y.shape[1]
        belief = self.method.init(self.model, len(record.y), draws.at(0), record.start, record.spread)
        for first in range(0, steps, self.training.segment or steps):
            losses, shares = [], []
            for t in range(first, min(first + (self.training.segment or steps), steps)):
                stage = AtRest(self.model) if t == 0 and self.model.observes_initial else self.model
                before, seen = belief, record.at(t)
                with torch.set_grad_enabled(learning and objective.through):
                    belief, info = self.method.step(stage, before, seen, draws.at(t + 1))
                parent, noise = (None if a is None else a[:, t] for a in (worlds.parents, worlds.noises))
                lesson = Lesson(
                    self.method, stage, before, belief, info, seen, worlds.states[:, t], parent, noise, self.scale,
                    named(draws.at(t + 1), "lesson."),
                )  # fmt: skip
                losses.append(objective(lesson))
                shares.append(info.trace["ess"].detach() / self.method.particles)
            yield torch.stack(losses), torch.stack(shares)
            belief = _detached(belief)

    def _known(self, worlds: Worlds, rows: Tensor, name: str) -> Worlds:
        """The worlds themselves, or imagined ones with their inputs where the objective asks for it."""
        if not self.training.objective.imagined:
            return worlds
        with torch.no_grad():
            draws = named(self._draws(name, rows), "imagined.")
            record, states, noises = imagine(self.model, worlds.record, draws)
        return Worlds(record, states[:, 1:], states[:, :-1], noises)

    def _draws(self, name: str, rows: Tensor) -> MonteCarlo:
        seed = zlib.crc32(f"training {self.training.seed} {name}".encode())
        return MonteCarlo(seed, rows.to(self.model.anchor.device), self.model.anchor.dtype)

    def _batches(self, worlds: int, epoch: int) -> Sequence[Tensor]:
        order = self._draws(f"order {epoch}", torch.arange(1)).uniform("order", worlds, 1)[0, :, 0].argsort()
        return order.split(self.training.batch)

    def save(self, path: Path, progress: Progress) -> None:
        networks = {name: flat(_networks(part)) for name, part in self.parts.items()}
        kept = {"networks": networks, "optimiser": self.optimiser.state_dict(), "progress": vars(progress), "same": self.same}
        learned_weights.write(path, kept)

    def restore(self, path: Path) -> Progress:
        """Where an earlier training stopped, or the beginning.

        Raises:
            ValueError: it was another training.
        """
        if not path.exists():
            return Progress()
        kept = learned_weights.read(path)
        for name, here in self.same.items():
            there = kept.get("same", {}).get(name)
            if there != here:
                raise ValueError(
                    f"{path}: a training was stopped here that had {name}={there}, and this one has {name}={here}; give the "
                    "words with which it was begun, another train.to, or fresh=true, which removes it"
                )
        for name, part in self.parts.items():
            learned_weights.fill(str(path), kept["networks"][name], _networks(part))
        self.optimiser.load_state_dict(kept["optimiser"])
        log.info("training goes on from epoch %d of %s", kept["progress"]["epoch"], path)
        return Progress(**kept["progress"])

    def finished(self, progress: Progress, about: Mapping[str, Any]) -> dict[str, Any]:
        """What a checkpoint holds."""
        cost = {
            "seconds": progress.seconds, "epochs": progress.epoch, "updates": progress.updates,
            "particles": self.training.particles, "device": str(self.model.anchor.device), "threads": torch.get_num_threads(),
        }  # fmt: skip
        sizes = {name: list(part.sizes) for name, part in self.parts.items()}
        frames = {name: part.learnable.frame for name, part in self.parts.items()}
        kept = {name: {key: a.cpu() for key, a in weights.items()} for name, weights in progress.kept.items()}
        told = {"class": type(self.model).__name__, "names": list(self.model.names)}
        return {
            "choices": {}, **json.loads(json.dumps(about)), "networks": kept, "sizes": sizes, "frames": frames, "model": told,
            "losses": progress.losses, "best": progress.best, "cost": cost,
        }  # fmt: skip


def _networks(part: nn.Module) -> dict[str, nn.Module]:
    return dict(part.named_children())


def _copy(weights: learned_weights.Weights) -> learned_weights.Weights:
    return {name: value.detach().clone() for name, value in weights.items()}


def _detached(cloud: Cloud) -> Cloud:
    """The same numbers, of which nothing remembers where they came from."""
    window, memory = ({k: v.detach() for k, v in kept.items()} for kept in (cloud.window, cloud.memory))
    return cloud._replace(
        x=cloud.x.detach(), log_w=cloud.log_w.detach(), log_z=cloud.log_z.detach(), window=window, memory=memory
    )


def _write_csv(path: Path, lines: list[dict[str, float]]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(lines[0]))
        writer.writeheader()
        writer.writerows(lines)


def _board(path: Path) -> Callable[[dict[str, float]], None]:
    """Writes lines for TensorBoard, where it is installed; nowhere else."""
    if importlib.util.find_spec("tensorboard") is None:
        return lambda line: None
    from torch.utils.tensorboard import SummaryWriter

    writer: Any = SummaryWriter(str(path.with_suffix("")))  # type: ignore[no-untyped-call]

    def write(line: dict[str, float]) -> None:
        for name, value in line.items():
            writer.add_scalar(name, value, int(line["epoch"]))
        writer.flush()

    return write
