"""Every particle filter of conf/ computes the same in every engine and in any batch, in double precision."""

from __future__ import annotations

import shutil
from dataclasses import replace
from typing import Any

import pytest
import torch
from filter_cases import ON_ANY_MODEL, method_of
from torch import Tensor

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record
from pfbench.filter.belief import StepInfo
from pfbench.filter.loop import FilterResult, run_filter
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.filter.swarm.swarm_proposal import SwarmProposal
from pfbench.kernels import compilation
from pfbench.model.linear_gaussian import LinearGaussian

RUNS, STEPS = 3, 4
Y = torch.tensor(
    [
        [[0.8, -1.0], [1.9, 0.4], [1.1, 0.3], [0.2, 0.7]],
        [[1.2, 0.1], [0.4, torch.nan], [0.5, -0.6], [0.9, 1.0]],
        [[-0.3, 0.5], [0.1, 1.4], [2.1, 0.0], [1.3, -0.2]],
    ],
    dtype=torch.float64,
)
compiler = pytest.mark.skipif(
    not any(map(shutil.which, ("c++", "g++", "clang++"))), reason="no C++ compiler"
)


def tracker() -> LinearGaussian:
    """Two states, each driven, two sensors."""
    h = [[1.0, 0.0], [0.3, 1.0]]
    return LinearGaussian(
        [[1.0, 0.5], [0.0, 0.9]], [[0.6, 0.0], [0.2, 0.5]], h, [1.0, 0.8], [0.3, -0.2], [1.5, 1.0]
    )


def run(method: Any, compiled: bool, batch: int | None = None) -> FilterResult:
    """Return an estimate, with the place of the first particle and the spread of all in its trace."""

    def keep(t: int, info: StepInfo) -> dict[str, Tensor]:
        assert info.cloud is not None
        deviations = info.cloud()[0]
        return {"first": deviations[:, 0, 0], "spread": deviations.square().sum((1, 2))}

    draws = PhiloxStream(5, torch.arange(RUNS))
    with compilation.use_compiled(compiled), torch.no_grad():
        return run_filter(method, tracker(), Record(Y), draws, keep, run_batch=batch)


@compiler
@pytest.mark.parametrize("name", ON_ANY_MODEL)
def test_engines_and_batches_agree_to_rounding(name: str) -> None:
    """With the same ancestors: another ancestor would move the first particle, or the spread."""
    method = method_of(name)
    if not isinstance(method, ParticleFilter):
        pytest.skip("not a particle filter")
    if isinstance(swarm := method.proposal, SwarmProposal):
        # each iteration of a swarm multiplies a rounding by up to 4: after 30 it is 1e-5
        method = replace(method, proposal=replace(swarm, iterations=4))
    eager = run(method, compiled=False)
    assert not bool(eager.lost.any())
    for other in (run(method, compiled=True), run(method, compiled=True, batch=1)):
        for field in ("mean", "variance", "log_evidence"):
            torch.testing.assert_close(
                getattr(other, field), getattr(eager, field), rtol=1e-9, atol=1e-12
            )
        for key, value in eager.trace.items():  # among them the counts of distinct ancestors
            torch.testing.assert_close(
                other.trace[key].double(), value.double(), rtol=1e-8, atol=1e-11
            )
