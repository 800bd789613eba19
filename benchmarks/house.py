"""pfbench itself: its SIR filter in its own time loop, with mean, variance and traces at every step.

    python house.py float32|float64 eager|compiled WORKLOAD
"""

from __future__ import annotations

import sys
from typing import Any

import torch
from worker import Filter, serve
from workload import ins_model

from pfbench import fusion, native
from pfbench.draws import MonteCarlo
from pfbench.filter.loop import run_filter, runs_at_once
from pfbench.filter.particle import ParticleFilter
from pfbench.filter.resamplers import Resample, Systematic
from pfbench.model.ins_gnss import Step
from pfbench.record import Record


def sir(work: Any, dtype: torch.dtype, compiled: bool = False) -> Filter:
    """The project's SIR filter, resampling at every step; `compiled` fuses the kernels."""
    model = ins_model().to(dtype)
    step, d = torch.from_numpy(work.step)[None], len(work.p0)
    inputs = Step(step[..., :d].contiguous(), step[..., d:].contiguous())
    record = Record(torch.from_numpy(work.y), inputs).to(model.anchor)
    method = ParticleFilter(int(work.particles), Resample(Systematic(), threshold=1.0))
    runs = torch.arange(len(work.y))
    block = runs_at_once(len(runs), method.particles, d)

    def run(seed: int) -> tuple[torch.Tensor, torch.Tensor]:
        with fusion.fused(compiled), torch.no_grad():
            estimate = run_filter(method, model, record, MonteCarlo(seed, runs, dtype), at_once=block)
        return estimate.log_evidence, estimate.mean

    return run


def contestant(work: Any) -> tuple[Filter, dict[str, str]]:
    torch.set_num_threads(1)
    native.keep_memory()  # as a job does
    run = sir(work, getattr(torch, sys.argv[1]), compiled=sys.argv[2] == "compiled")
    return run, {"torch": torch.__version__, "numpy": sys.modules["numpy"].__version__}


if __name__ == "__main__":
    serve(contestant)
