"""On a CUDA device, where there is one: every filter, engine, job and training gives what it gives on the CPU."""

import csv
import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from command_line import pfbench
from config_cases import composed, truncated, world
from filter_cases import NAMES, method_of, refusal
from model_cases import tracker
from torch import Tensor

from pfbench import job
from pfbench.core import Chart, PhiloxStream, Record
from pfbench.filter import (
    DiagonalNormalHead,
    EssResampler,
    EvidenceLowerBound,
    FilterResult,
    InferenceCompilation,
    LearnedProposal,
    ParticleFilter,
    SoftResampler,
    StateErrorLoss,
    SwarmProposal,
    Systematic,
    run_filter,
)
from pfbench.filter.particle.compiled_filter import CompiledParticleFilter
from pfbench.kernels import dispatch
from pfbench.learn import Training, draw_training_data, train
from pfbench.model import LinearGaussian, StateSpaceModel, local_level
from pfbench.noise.base import NominalNoise
from pfbench.results import store
from pfbench.scenario.simulated import ModelSimulation

pytestmark = [
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"),
    pytest.mark.filterwarnings("ignore"),  # of the compiler and of drivers
]

RUNS = torch.arange(2)
WORLDS = ("growth", "flight_500s", "sar_flight_short", "azimuth_small", "passive_1")
NEURAL = (
    "neural_ckf",
    "neural_mixture",
    "neural_sir",
)
OFF = 0.05  # standard deviations: normals differ by 1e-5, and a particle may fall to a neighbouring slot


@dataclass(frozen=True, eq=False)
class Shaken(PhiloxStream):
    """Normals that are off by as much as those of a device may be: some filters are that sensitive."""

    def normal(self, purpose: str, n: int, w: int) -> Tensor:
        return super().normal(purpose, n, w) + 3e-6 * super().normal(f"{purpose} shaken", n, w)


def on(
    device: str,
    method: Any,
    model: StateSpaceModel,
    record: Record,
    fused: bool = False,
    draws: type[PhiloxStream] = PhiloxStream,
) -> FilterResult:
    model = model.to(device)
    with torch.no_grad(), dispatch.use_kernels(fused):
        return run_filter(
            method,
            model,
            record,
            draws(1, torch.arange(len(record.y), device=device), model.anchor.dtype),
        )


def apart(chart: Chart, here: FilterResult, there: FilterResult) -> float:
    """Greatest difference of two estimates' means, in standard deviations of the first, and of their log evidence."""
    off = chart.subtract(there.mean.cpu(), here.mean).abs() / here.variance.sqrt().clamp(min=1e-12)
    return max(float(off.max()), float((there.log_evidence.cpu() - here.log_evidence).abs().max()))


@pytest.mark.parametrize("scenario", WORLDS)
@pytest.mark.parametrize("name", [*NAMES, *NEURAL])
def test_a_filter_does_there_what_it_does_here(name: str, scenario: str) -> None:
    record = truncated(world(scenario), 3).record

    def model() -> StateSpaceModel:
        found: StateSpaceModel = job.instantiate(composed(f"scenario={scenario}").model)
        return found

    if name in NAMES and refusal(name, model(), record):
        pytest.skip("it refuses this world")
    if name == "thompson_taylor":
        pytest.skip(
            "which of equally near neighbours comes first is the device's: other numbers, the same law"
        )

    def method() -> Any:
        found = (
            method_of.__wrapped__(name) if name in NEURAL else method_of(name)
        )  # a network is made for its first model
        if isinstance(proposal := getattr(found, "proposal", None), SwarmProposal):
            found = replace(found, proposal=replace(proposal, iterations=4))
        return found

    here, shaken = (
        on("cpu", method(), model(), record, draws=kind) for kind in (PhiloxStream, Shaken)
    )
    there = on("cuda", method(), model(), record)
    assert there.mean.is_cuda
    assert apart(model().chart, here, there) < max(OFF, 3.0 * apart(model().chart, here, shaken))


class Failing(LinearGaussian):
    """Particles that run beyond 4 become no number."""

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        moved = super().propagate(x, u, w)
        return torch.where(moved > 4.0, torch.nan, moved)


@pytest.mark.parametrize("particles", [30, 1001, 5000])
@pytest.mark.parametrize("threshold", [0.5, 1.0])
def test_engines_agree(particles: int, threshold: float) -> None:
    """In the first steps number by number; later particles fall to other slots, and estimates differ as two of one law."""
    plain = tracker()
    model = Failing(plain.f, plain.g, plain.h, plain.r, plain.m0, plain.l0)
    record = ModelSimulation(plain, 12).draw(NominalNoise(), torch.arange(5), 1).record
    record.y[1, 4] = record.y[3, 7:9] = math.nan
    method = ParticleFilter(particles, EssResampler(Systematic(), threshold))
    here = on("cpu", method, model, record)
    compiled = CompiledParticleFilter(method)
    for wrapped, fused in ((method, False), (method, True), (compiled, True)):
        there = on("cuda", wrapped, model, record, fused)
        off = (there.mean.cpu() - here.mean).abs() / here.variance.sqrt()
        assert off[:, :3].max() < OFF
        apart_by_chance = torch.sqrt(
            2.0 / torch.minimum(here.trace["ess"], there.trace["ess"].cpu())
        ).unsqueeze(-1)
        assert (off < 5.0 * apart_by_chance).all()
        assert (
            there.log_evidence.cpu() - here.log_evidence
        ).abs().max() < 5.0 * apart_by_chance.square().sum(1).sqrt().max()
    assert compiled.is_active
    model.to("cpu")


@pytest.mark.parametrize("engine", ["eager", "kernels", "compiled"])
def test_a_job_gives_the_same_numbers(engine: str, tmp_path: Path) -> None:
    arrays = {}
    for device in ("cpu", "cuda"):
        words = f"scenario=growth runs=20 particles=200 study={device} device={device}".split()
        said = pfbench(
            "run",
            *words,
            f"engine={'eager' if device == 'cpu' else engine}",
            home=tmp_path / device,
        )
        assert said.code == 0, said.err
        (path,) = (tmp_path / device / "results").rglob("*.npz")
        arrays[device] = store.read_result(path).data
        assert store.read_metadata(path)["engine"] == ("eager" if device == "cpu" else engine)
    here, there = (torch.as_tensor(arrays[device]["error"]).double() for device in ("cpu", "cuda"))
    assert (here - there)[:, :2].abs().max() < OFF * here.std()
    square = (here.square() - there.square()).mean(
        (1, 2)
    )  # later as two of their law: paired by world
    assert square.mean().abs() < 4.0 * square.std() / len(square) ** 0.5 + 1e-9


@pytest.mark.parametrize(
    "objective",
    [EvidenceLowerBound(), StateErrorLoss(), InferenceCompilation()],
    ids=lambda o: type(o).__name__,
)
def test_a_training_goes_the_same_way(objective: Any, tmp_path: Path) -> None:
    lines = {}
    for device in ("cpu", "cuda"):
        world = ModelSimulation(local_level(1.0, 0.3, 0.0, 1.0), 10)
        model = local_level(1.0, 0.3, 0.0, 1.0).to(device)
        worlds = [
            draw_training_data(world, [NominalNoise()], model, 16, seed, None) for seed in (1, 2)
        ]
        method = ParticleFilter(
            16, proposal=LearnedProposal(partial(DiagonalNormalHead, hidden=(8,)))
        )
        resampler = SoftResampler() if objective.through else EssResampler(Systematic(), 1.0)
        training = Training(
            objective,
            resampler,
            particles=16,
            training_runs=16,
            validation_runs=16,
            epochs=3,
            batch_size=8,
        )
        path = train(training, method, model, *worlds, tmp_path / f"{device}.pt")
        with path.with_suffix(".csv").open() as file:
            table = [*csv.DictReader(file)]
        lines[device] = [
            [float(line[name]) for name in ("loss", "validation", "ess")] for line in table
        ]
    torch.testing.assert_close(
        torch.tensor(lines["cuda"]), torch.tensor(lines["cpu"]), rtol=0.02, atol=0.02
    )
