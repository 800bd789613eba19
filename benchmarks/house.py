"""pfbench itself: its SIR filter in its own time loop, with mean, variance and traces at every step.

W1 to W3 are single runs, W4 a batch. Of W3 the package has no model; `Radar` is one as a user would write it.

    python house.py float32|float64 auto|eager|kernels|compiled [sir|ckf] WORKLOAD

`auto` is the engine that a job of this size takes by default.
"""

from __future__ import annotations

import sys
from functools import partial
from typing import Any

import torch
from hydra import compose, initialize_config_module
from problems import GROWTH, RADAR, RADAR_SPREAD, RADAR_START, VOLATILITY
from torch import Tensor
from torch.distributions import Distribution
from worker import Filter, serve
from workload import ins_model

from pfbench import job
from pfbench.core import PhiloxStream, Record
from pfbench.core.density import independent_normal, normal_batch
from pfbench.core.linear_algebra import affine_map
from pfbench.filter import EssResampler, ParticleFilter, Systematic, run_filter
from pfbench.filter.loop import choose_run_batch
from pfbench.job import memory as process_memory
from pfbench.job.filter_pass import choose_engine, wrap_steps
from pfbench.kernels import dispatch
from pfbench.model import StateSpaceModel, StochasticVolatility, UnivariateGrowth
from pfbench.model.ins_gnss import LooseStep


class Radar(StateSpaceModel):
    """Constant velocity in the plane, seen by bearing from north and range: east, its rate, north, its rate."""

    def __init__(self) -> None:
        super().__init__()
        dt, q = RADAR["interval"], RADAR["acceleration_sd"]
        eye = torch.eye(2, dtype=torch.float64)
        self.register_buffer(
            "phi", torch.kron(eye, torch.tensor([[1.0, dt], [0.0, 1.0]], dtype=torch.float64))
        )
        self.register_buffer(
            "gain", torch.kron(eye, q * torch.tensor([[0.5 * dt**2], [dt]], dtype=torch.float64))
        )
        self.register_buffer(
            "sd", torch.tensor([RADAR["bearing_sd"], RADAR["range_sd"]], dtype=torch.float64)
        )
        self.register_buffer("start", torch.tensor(RADAR_START, dtype=torch.float64))
        self.register_buffer("spread", torch.tensor(RADAR_SPREAD, dtype=torch.float64))
        self.names, self.units, self.noise_dim = (
            ("east", "east rate", "north", "north rate"),
            ("m", "m/s") * 2,
            2,
        )
        self.groups = {"position": (0, 2), "velocity": (1, 3)}

    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.spread, self.start)

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return affine_map(self.phi[None], x, self.gain[None], w)

    def noise_gain(self, u: Any) -> Tensor:
        return self.gain.unsqueeze(0)

    def observation(self, x: Tensor, u: Any) -> Distribution:
        east, north = x[..., 0], x[..., 2]
        return independent_normal(
            torch.stack([torch.atan2(east, north), torch.sqrt(east * east + north * north)], -1),
            self.sd,
        )


MODELS = {
    "growth": partial(UnivariateGrowth, **GROWTH),
    "volatility": partial(StochasticVolatility, **VOLATILITY),
    "radar": Radar,
}


def model_and_record(work: Any, dtype: torch.dtype) -> tuple[StateSpaceModel, Record]:
    """What the filter believes and is given."""
    if str(getattr(work, "kind", "ins")) != "ins":
        model = MODELS[str(work.kind)]().to(dtype)
        return model, Record(torch.from_numpy(work.y)).to(model.anchor)
    model = ins_model().to(dtype)
    step, d = torch.from_numpy(work.step)[None], len(work.p0)
    inputs = LooseStep(step[..., :d].contiguous(), step[..., d:].contiguous())
    return model, Record(torch.from_numpy(work.y), inputs).to(model.anchor)


def sir(work: Any, dtype: torch.dtype, engine: str = "eager") -> Filter:
    """The project's SIR filter, resampling at every step; `engine` as in a job."""
    method = ParticleFilter(int(work.particles), EssResampler(Systematic(), ess_threshold=1.0))
    return of(method, method.particles, work, dtype, engine)


def ckf(work: Any, dtype: torch.dtype, engine: str = "eager") -> Filter:
    """The project's cubature filter, as it is configured."""
    job.register_experiments()
    with initialize_config_module("pfbench.conf", version_base="1.3"):
        method = job.instantiate(compose("config", ["filter=ckf"])["filter"])
    return of(method, 1, work, dtype, engine)


def of(method: Any, particles: int, work: Any, dtype: torch.dtype, engine: str) -> Filter:
    """A filter in the project's time loop, in blocks of runs as a job makes them."""
    model, record = model_and_record(work, dtype)
    if engine in ("auto", "tape"):
        engine = choose_engine(engine, method, model, *work.y.shape[:2])
    method = wrap_steps(engine, method) or method
    runs = torch.arange(len(work.y))
    block = choose_run_batch(len(runs), particles, model.chart.size)

    def run(seed: int) -> tuple[torch.Tensor, torch.Tensor]:
        with dispatch.use_kernels(engine != "eager"), torch.no_grad():
            estimate = run_filter(
                method, model, record, PhiloxStream(seed, runs, dtype), run_batch=block
            )
        return estimate.log_evidence, estimate.mean

    return run


def contestant(work: Any) -> tuple[Filter, dict[str, str]]:
    torch.set_num_threads(1)
    process_memory.keep_freed_memory()  # as a job does
    filtered = ckf if "ckf" in sys.argv[3:-1] else sir
    run = filtered(work, getattr(torch, sys.argv[1]), sys.argv[2])
    return run, {"torch": torch.__version__, "numpy": sys.modules["numpy"].__version__}


if __name__ == "__main__":
    serve(contestant)
