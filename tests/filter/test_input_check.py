"""The door of `run_filter`: what does not fit is refused at the start, with key, value and remedy."""

from __future__ import annotations

from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter
from pfbench.filter.gaussian.linearisation_rules import CubaturePoints
from pfbench.filter.loop import run_filter
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.kernels import compilation
from pfbench.model.linear_gaussian import LinearGaussian, linear_walk

MODEL = linear_walk(1.0, 0.3, 1.0)
RUNS, STEPS = 3, 4
Y = torch.zeros(RUNS, STEPS, 1, dtype=torch.float64)
DRAWS = PhiloxStream(1, torch.arange(RUNS))


class Inputs(NamedTuple):
    force: Tensor


class Broken(LinearGaussian):
    """A model whose first state is not a number."""

    @override
    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return super().propagate(x, u, w) + torch.nan


class Wide(LinearGaussian):
    """A model that returns a state of another size."""

    @override
    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        moved = super().propagate(x, u, w)
        return torch.cat([moved, moved], -1)


def parameters(model: LinearGaussian) -> tuple[Tensor, ...]:
    return model.f, model.g, model.h, model.r, model.m0, model.l0


WRONG: dict[str, tuple[Any, Record, PhiloxStream, str]] = {
    "three components for one": (
        MODEL,
        Record(Y.expand(-1, -1, 3)),
        DRAWS,
        r"record.y must have as many components as LinearGaussian observes, 1, got 3",
    ),
    "no axis of runs": (MODEL, Record(Y[0]), DRAWS, r"axes \[R, T, Dy\], got float64 \[4, 1\]"),
    "whole numbers": (MODEL, Record(Y.long()), DRAWS, r"real numbers .*, got int64"),
    "no steps": (MODEL, Record(Y[:, :0]), DRAWS, "at least one time step, got 0"),
    "infinity": (MODEL, Record(Y + torch.inf), DRAWS, "must be finite, got infinity"),
    "other runs": (
        MODEL,
        Record(Y),
        PhiloxStream(1, torch.arange(5)),
        r"draws must be of 3 runs.*got 5.*arange\(3\)",
    ),
    "short inputs": (
        MODEL,
        Record(Y, Inputs(torch.zeros(RUNS, STEPS - 1, 2))),
        DRAWS,
        r"record.u.force must have the axes \[3 or 1, 4, ...\].*got \[3, 3, 2\]",
    ),
    "inputs of other runs": (
        MODEL,
        Record(Y, Inputs(torch.zeros(2, STEPS, 2))),
        DRAWS,
        r"record.u.force .*got \[2, 4, 2\]",
    ),
    "start": (
        MODEL,
        Record(Y, (), torch.zeros(RUNS, 5)),
        DRAWS,
        r"record.start must have shape \[3, 2\], got \[3, 5\]",
    ),
    "spread": (
        MODEL,
        Record(Y, (), torch.zeros(RUNS, 2), torch.zeros(RUNS, 2)),
        DRAWS,
        r"record.spread must have shape \[3, 2, 2\], got \[3, 2\]",
    ),
    "states that are not numbers": (
        Broken(*parameters(MODEL)),
        Record(Y),
        DRAWS,
        r"Broken.propagate must return finite states \[3, 4, 2\], got numbers that are not finite",
    ),
    "states of another size": (
        Wide(*parameters(MODEL)),
        Record(Y),
        DRAWS,
        r"Wide.propagate must return finite states \[3, 4, 2\], got \[3, 4, 4\]",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_does_not_fit_is_refused_in_every_engine(case: str) -> None:
    model, record, draws, message = WRONG[case]
    for method in (ParticleFilter(20), GaussianFilter(CubaturePoints())):
        for compiled in (False, True):
            with compilation.use_compiled(compiled), pytest.raises(ValueError, match=message):
                run_filter(method, model, record, draws)


def test_what_fits_is_computed() -> None:
    inputs = Inputs(torch.zeros(1, STEPS, 2, dtype=torch.float64))
    for record in (Record(Y), Record(Y.float()), Record(Y, inputs), Record(Y * torch.nan)):
        result = run_filter(ParticleFilter(20), MODEL, record, DRAWS)
        assert not result.lost.any()
