"""The filters of conf/filter, and the models and records that some of them refuse."""

from __future__ import annotations

from functools import cache
from typing import Any

import torch
from config_cases import CONF
from hydra import compose, initialize_config_dir

from pfbench import job
from pfbench.core.record import Record
from pfbench.filter.linearisation import compute_additive_gain
from pfbench.model.base import StateSpaceModel

SLOTS = 30

TEXTS = {file.stem: file.read_text() for file in sorted((CONF / "filter").glob("*.yaml"))}

NAMES = [name for name in TEXTS if not name.startswith("neural_")]  # these need a trained network

NEEDS_ATTITUDE = "invariant_ekf"  # refuses a model without one

ON_ANY_MODEL = [name for name in NAMES if name != NEEDS_ATTITUDE]


@cache
def method_of(name: str) -> Any:
    """Return a filter, composed alone, which takes a third of the time of a job."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return job.instantiate(
            compose(f"filter/{name}", [f"+particles={SLOTS}", "+checkpoint=untrained"])["filter"]
        )


DENSE = ("mcmc_bridge", "mcmc_rpf_printed", "mcmc_tail")

BRANCHING = ("gpb1", "imm", "gaussian_sum", "rbpf_discrete")

REMEMBERING = ("cofm_amssrcpf", "cofm_amssrcpf_printed", "cpf", "fmcpf")


def refusal(name: str, model: StateSpaceModel, record: Record) -> str:
    """Return the pattern of the error of a filter that refuses a model or a record; else empty."""
    x, first = model.origin.expand(2, 1, -1), model.prepare(record).at_step(0)
    if name in DENSE and model.transition(x, first.u) is None:
        return "density of x_t given x_t-1"
    if name.startswith("gauss_hermite") and _needs_many_points(name, model, first.u):
        return "at most 20000 points"
    if name == "invariant_ekf" and not hasattr(model, "group_chart"):
        return "filter.chart must be an invariant chart of the model"
    if name == "dmc_density" and model.noise_gain(first.u) is None:
        return "additive noise"
    if name == "rbpf" and not (model.linear or model.linear_given):
        return "no component that is linear given the rest"
    is_single = not method_past(name) and name != "rbpf" and name not in BRANCHING
    if record.feedback is not None and not is_single:
        return "scenario with feedback"
    return ""


def _needs_many_points(name: str, model: StateSpaceModel, u: Any) -> bool:
    """Return whether the tensor product of points is too large for a model."""
    d = model.chart.dimension
    root = torch.eye(d, dtype=model.origin.dtype)[None]
    if compute_additive_gain(model, model.origin.expand(1, -1), root, u) is None:
        d += model.noise_dim
    return int(name[-1]) ** d > 20_000


def method_past(name: str) -> bool:
    """Return whether a filter stores the past of its particles."""
    return (
        bool(getattr(method_of(name), "moves", ()))
        or name.startswith(("cpso", "pso"))
        or name in (*REMEMBERING, "guided_start")
    )
