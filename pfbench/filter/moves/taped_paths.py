"""Paths under fixed noise by one C++ call, with the model as a tape that is recorded once in a pass over a record."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import torch
from torch import Tensor

from pfbench.core.record import Record, map_inputs
from pfbench.filter.loop import MEMORY_OF_PASS
from pfbench.filter.particle.taken_steps import keep_count, tensors_in
from pfbench.filter.particle.tape import FEW, NoTapeError, Tape, record_tape
from pfbench.kernels import dispatch
from pfbench.kernels.step_compiler import to_storage
from pfbench.model.base import StateSpaceModel

log = logging.getLogger("pfbench")
_FEW = slice(0, FEW)
_MOST_MODELS = 4  # of a pass: more are one model that changes by step
Past = tuple[Record, ...]


@dataclass(eq=False)
class TapedPaths:
    """Paths of a model in one pass over a record, during which its constants do not change.

    Attributes:
        model: The model, which lives as long.
        tape: Its tape; None before it is recorded.
        refused: Whether it cannot be one.
    """

    model: StateSpaceModel
    tape: Tape | None = None
    refused: bool = False
    _evaluations: int = 0  # of the measurement distribution, per particle and step
    _inputs: tuple[Past, Tensor] | None = None  # of the records that were asked for last

    def record(
        self, start: Tensor, noise: Tensor, past: Past, states: Tensor, values: Tensor
    ) -> None:
        """Record the model, and compare what the tape computes with what torch computed.

        Shapes: start [R, N, D], noise [R, N, K, W], states [R, N, K + 1, D], values [R, N, K + 1].
        """
        try:
            first, few = past[1], min(FEW, len(start))
            u = map_inputs(lambda a: a[_FEW].expand(few, *a.shape[1:]), first.u)
            x = to_storage(start[_FEW, _FEW]).permute(1, 2, 0)
            # what is computed twice counts once
            with keep_count(getattr(self.model, "likelihood_counter", None)) as evaluations:
                self.tape, *_ = record_tape(
                    self.model, x.clone(), noise[_FEW, _FEW, 0], Record(first.y[_FEW], u)
                )
                self._evaluations = evaluations() // (few * FEW)
                computed = self.run(start, values[..., 0], noise[:, :, :1], past[:2])
            pairs = zip(computed, (states[:, :, :2], values[..., :2]), strict=True)
            if not all(torch.allclose(*a, rtol=1e-9, atol=1e-12, equal_nan=True) for a in pairs):
                raise NoTapeError("the tape does not compute the numbers of torch")
        except Exception as error:  # NoTapeError, or of a model that takes batches of one size only
            self.refused = True
            log.debug(
                "paths step by step: no tape of the model (%s)", str(error).partition("\n")[0]
            )

    def run(self, start: Tensor, value: Tensor, noise: Tensor, past: Past) -> tuple[Tensor, Tensor]:
        """Return the states [R, N, K + 1, D] of paths, and their log likelihoods [R, N, K + 1].

        Shapes: start [R, N, D], its log likelihood [R, N], noise [R, N, K, W].
        """
        assert self.tape is not None
        runs, n, steps, width = noise.shape
        if self._inputs is None or self._inputs[0] is not past:
            rows = [[*tensors_in(record.u), record.y] for record in past[1:]]
            flat = [
                torch.cat([a.reshape(len(a), -1).expand(runs, -1).double() for a in row], 1)
                for row in rows
            ]
            self._inputs = past, torch.stack(flat)
        draws = noise.permute(2, 3, 0, 1).reshape(steps * width, runs, n)
        arguments = [self._inputs[1], to_storage(start), value, draws, torch.tensor(self.tape[3:])]
        states, values = dispatch.run_paths([*self.tape[:3], *arguments])
        if counter := getattr(self.model, "likelihood_counter", None):
            counter.count += steps * runs * n * self._evaluations
        return states.permute(2, 3, 0, 1), values.permute(1, 2, 0)


def find_taped_paths(model: StateSpaceModel, x: Tensor) -> TapedPaths | None:
    """Return the paths of a model by a tape; None where they are taken step by step."""
    memory = MEMORY_OF_PASS.get()
    if memory is None or torch.is_grad_enabled() or x.dtype != torch.float64 or not dispatch.runs_operators(x):  # fmt: skip
        return None
    key = getattr(model, "tape_key", id(model))
    if key not in memory and len(memory) < _MOST_MODELS:
        memory[key] = TapedPaths(model)
    paths = memory.get(key)
    return None if paths is None or paths.refused else paths
