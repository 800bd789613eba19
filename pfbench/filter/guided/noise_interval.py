"""Steps between two measurements: particles at the first one, and noise and inputs since."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from pfbench.core.record import Record, map_inputs
from pfbench.filter.belief import ParticleBelief
from pfbench.model.base import StateSpaceModel

_PREFIX = "interval."
_START, _NOISE, _LENGTH, _INPUT = (
    _PREFIX + name for name in ("start", "noise", "length", "input.")
)


class NoiseInterval(NamedTuple):
    """Steps since the latest measurement of each run. The intervals of a batch end at the same step.

    Attributes:
        start: Particles at that measurement, [R, N, D].
        noise: Whitened noise of L steps, the latest last, [R, N, L, W].
        length: Number of steps of each run, at most L, [R].
        inputs: Inputs of the L steps.
    """

    start: Tensor
    noise: Tensor
    length: Tensor
    inputs: list[Any]

    def is_active(self, k: int) -> Tensor:
        """Return the runs whose interval contains step k of L, [R, 1, 1]."""
        return (k >= len(self.inputs) - self.length)[:, None, None]

    def propagate(
        self, model: StateSpaceModel, z: Tensor, steps: int | None = None
    ) -> list[Tensor]:
        """Propagate the particles from the start.

        Args:
            model: State-space model.
            z: Whitened noise, [R, N, L, W], or one step of it for all steps.
            steps: Number of steps. All by default.

        Returns:
            States at the start and after each step, [R, N, D]. Those of a shorter interval are its start
            until it begins.
        """
        noise, x = model.noise, self.start
        states = [x]
        for k, u in enumerate(self.inputs[:steps]):
            w = noise.mean + noise.stddev * z[:, :, min(k, z.shape[2] - 1)]
            w = w.expand(*x.shape[:2], model.noise_dim)
            x = torch.where(self.is_active(k), model.propagate(x, u, w), x)
            states.append(x)
        return states


def pack_interval(memory: dict[str, Tensor], interval: NoiseInterval) -> dict[str, Tensor]:
    """Store an interval in the memory of particles, as long as its longest run.

    Args:
        memory: Memory of the particles before the step.
        interval: Interval after the step.

    Returns:
        The memory. Without steps it holds the lengths alone.
    """
    rest = {name: a for name, a in memory.items() if not name.startswith(_PREFIX)}
    rest[_LENGTH] = interval.length.to(interval.start)[:, None]  # always: closed loops refuse it
    length = int(interval.length.max())
    if not length:
        return rest
    inputs: list[Tensor] = []
    for u in interval.inputs[-length:]:
        map_inputs(inputs.append, u)
    stored = {f"{_INPUT}{i}": a.unsqueeze(1) for i, a in enumerate(inputs)}
    stored[_START], stored[_NOISE] = interval.start, interval.noise[:, :, -length:]
    return rest | stored


def unpack_interval(belief: ParticleBelief, record: Record) -> NoiseInterval:
    """Return the interval in the memory of particles.

    Args:
        belief: Particles before the step.
        record: Record of the step, whose inputs have the structure of the stored ones.

    Returns:
        The interval, with length 0 and the particles as its start if there is none.
    """
    memory, x = belief.memory, belief.x
    if _START not in memory:
        length = torch.zeros(len(x), dtype=torch.long, device=x.device)
        return NoiseInterval(x, x.new_zeros(*x.shape[:2], 0, 1), length, [])
    noise, length = memory[_NOISE], memory[_LENGTH][:, 0].long()
    count = sum(name.startswith(_INPUT) for name in memory)
    rows = iter([memory[f"{_INPUT}{i}"][:, 0] for i in range(count)])
    inputs = [map_inputs(lambda _: next(rows), record.u) for _ in range(noise.shape[2])]
    return NoiseInterval(memory[_START], noise, length, inputs)
