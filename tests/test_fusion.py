"""Fusible functions: fused they compute what they compute eagerly."""

from __future__ import annotations

import shutil
from typing import Any

import pytest
import torch

from pfbench import fusion
from pfbench.draws import MonteCarlo
from pfbench.filter import particle, resamplers
from pfbench.filter.belief import Cloud, gather
from pfbench.filter.loop import Estimate, run_filter
from pfbench.filter.particle import ParticleFilter
from pfbench.model import base
from pfbench.model.linear import linear_walk
from pfbench.noise.regimes import Nominal
from pfbench.scenario.model_world import ModelWorld

RUNS, N, D = 3, 200, 5
DRAWS = MonteCarlo(3, torch.arange(RUNS)).at(1)
compiler = pytest.mark.skipif(not any(map(shutil.which, ("c++", "g++", "clang++"))), reason="no C++ compiler for torch.compile")


def test_what_is_not_fused_runs_the_eager_form() -> None:
    seen: list[str] = []
    half = fusion.fusible(lambda: seen.append("fused"), eager=lambda: seen.append("eager"))
    half()
    with fusion.fused(False):
        half()
    assert seen == ["eager", "eager"]


def test_the_switch_is_put_back_after_an_error() -> None:
    with pytest.raises(RuntimeError), fusion.fused():
        raise RuntimeError
    assert not fusion._fused.get()


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1), (0, 2, 1)])
def test_a_gather_keeps_memory_order_and_takes_the_right_particles(order: tuple[int, int, int]) -> None:
    back = [order.index(k) for k in range(3)]
    x = DRAWS.normal("x", N, D).permute(order).contiguous().permute(back)
    ancestors = (DRAWS.uniform("a", N, 1)[..., 0] * N).long()
    cloud = gather(Cloud(x, x[..., 0], torch.zeros(RUNS)), ancestors)
    for r in range(RUNS):
        assert torch.equal(cloud.x[r], x[r][ancestors[r]])
        assert torch.equal(cloud.log_w[r], x[r, ancestors[r], 0])
    assert cloud.x.stride() == x.stride() or order == (0, 1, 2)


def results(x: Tensor, z: Tensor) -> list[Any]:
    dtype = x.dtype
    hidden = z.clone()
    hidden[0] = -torch.inf  # a run of which nothing is left
    seen = torch.ones(RUNS, 1, D, dtype=torch.bool)
    seen[1, 0, 2] = False
    a, n, u = torch.softmax(3.0 * z, -1), torch.full((RUNS, 1), N), torch.tensor([[0.1], [0.5], [0.9]])
    return [
        particle._flat_moments(1e3 + x, z),
        particle._normalise(hidden),
        base._log_normal(x, 0.1 * x, torch.full((1, 1, D), 0.7, dtype=dtype), seen),
        resamplers._evenly(a, n, u.double()),
    ]


@pytest.mark.slow
@compiler
@pytest.mark.filterwarnings("ignore")  # the compiler's own
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_fused_functions_agree_with_eager_ones(dtype: torch.dtype) -> None:
    # the draws are made once: fused and eager normals differ by roundings of float32 (test below)
    x, z = DRAWS.normal("x", N, D).to(dtype), DRAWS.normal("w", N, 1)[..., 0].to(dtype)
    eager = results(x, z)
    with fusion.fused():
        fused = results(x, z)
    torch.testing.assert_close(fused, eager)


@pytest.mark.slow
@compiler
@pytest.mark.filterwarnings("ignore")
def test_a_filter_runs_alike_fused_and_eagerly() -> None:
    model = linear_walk(1.0, 0.3, 1.0)
    record = ModelWorld(model, 30).draw(Nominal(), torch.arange(4), 1).record

    def run() -> Estimate:
        return run_filter(ParticleFilter(300), model, record, MonteCarlo(1, torch.arange(4)))

    eager = run()
    with fusion.fused(), torch.no_grad():
        fused = run()
    # normals agree to 1e-5 and a slot of a resampling may fall to a neighbour: far below the Monte Carlo error
    assert torch.allclose(fused.log_evidence, eager.log_evidence, rtol=0, atol=2e-2)
    assert torch.allclose(fused.mean, eager.mean, rtol=0, atol=2e-2)
