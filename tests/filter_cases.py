"""The filters of conf/filter, and the models and records that some of them refuse."""

import math
from dataclasses import is_dataclass
from functools import cache
from typing import Any

import torch
from config_cases import CONF, GROUPS
from hydra import compose, initialize_config_dir

from pfbench import job
from pfbench.core.record import Record
from pfbench.filter import GuidedNoiseProposal, SigmaPointLinearisation
from pfbench.model.base import StateSpaceModel
from pfbench.results.paper_block import read_part

SLOTS = 30

TEXTS = {name: read_part("filter", name) for name in GROUPS["filter"]}

NEEDS_TRAINING = ("neural_", "kalman_net")  # starts of the names of filters with a network

NAMES = [name for name in TEXTS if not name.startswith(NEEDS_TRAINING)]

NEEDS_ATTITUDE = ("invariant_ekf", "rbpf_heading")  # refuse a model without one

# literal forms whose equations are lost in print: they refuse any model
UNPRINTED = ("fm_mssrckf_literal", "cofm_mssrckf_literal", "cofm_amssrcpf_literal")

ON_ANY_MODEL = [name for name in NAMES if name not in (*NEEDS_ATTITUDE, *UNPRINTED)]


@cache
def method_of(name: str) -> Any:
    """Return a filter, composed alone, which takes a third of the time of a job, unless it has tuned knobs."""
    if name.endswith("_tuned"):
        return job.instantiate(
            job.compose([f"filter={name}", "tuned=growth_nominal", f"particles={SLOTS}"]).values[
                "filter"
            ]
        )
    words = [f"+particles={SLOTS}", "+checkpoint=untrained"]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return job.instantiate(compose(f"filter/{name}", words)["filter"])


DENSE = ("mcmc_bridge", "mcmc_rpf_printed", "mcmc_rpf_literal", "mcmc_tail")

BRANCHING = ("gpb1", "imm", "gaussian_sum", "rbpf_discrete", "ekf_bank", "ekf_bank_dense")

EACH = (
    "cofm_amssrcpf_each",
    "cofm_amssrcpf_each_printed",
    "cpf_each",
    "fmcpf_each",
)  # a guide filter for each particle

REMEMBERING = (
    *(
        "cofm_amssrcpf",
        "cofm_amssrcpf_printed",
        "cofm_amssrcpf_tuned",
        "cpf",
        "fmcpf",
        "dmc_reconstructed_literal",
        *EACH,
    ),
)

# no step determines the state; that of Benes is known at the start
WITHOUT_FIXES = ("Benes", "StochasticVolatility", "TerrainAided")


ROBUST_WEIGHTS = ("correntropy_pf", "gate_pf", "huber_pf", "student_pf", "wolf_pf")


def refusal(name: str, model: StateSpaceModel, record: Record) -> str:
    """Return the pattern of the error of a filter that refuses a model or a record; else empty."""
    x, first = model.origin.expand(2, 1, -1), model.prepare(record).at_step(0)
    if name in UNPRINTED:
        return "must have equations to run"
    if name in DENSE and model.transition(x, first.u) is None:
        return "density of x_t given x_t-1"
    if name == "invariant_ekf" and not hasattr(model, "group_chart"):
        return "filter.chart must be an invariant chart of the model"
    if name == "rbpf_heading" and "attitude_yaw" not in model.names:
        return "filter.sampled_states must be groups"
    if name == "dmc_density" and model.noise_gain(first.u) is None:
        return "additive noise"
    if name == "rbpf" and not (model.linear or model.linear_given):
        return "no component that is linear given the rest"
    if _has_far_points(method_of(name), model, record):
        return "must lie within 115 degrees"
    if name in EACH and not _has_density_in_chart(model, x, first.u):
        return "transition density in the chart"
    if name in ROBUST_WEIGHTS and "Mixture" in repr(model.observation(x, first.u)):
        return "must be normal for a robust weight update"
    fixes = record.y[..., :3] if type(model).__name__ == "StrapdownBlocks" else record.y
    is_blank = bool(torch.isnan(fixes).all())  # the first steps of a recorded drive
    if name == "raw_fix" and (is_blank or type(model).__name__ in WITHOUT_FIXES):
        return "filter=raw_fix must have measurements that determine"
    is_single = not method_past(name) and not name.startswith("rbpf") and name not in BRANCHING
    if record.feedback is not None and not is_single:
        return "scenario with feedback"
    return ""


def _has_density_in_chart(model: StateSpaceModel, x: torch.Tensor, u: Any) -> bool:
    """Return whether additive noise of full rank or a transition gives the density of a step."""
    chart, gain = model.chart, model.noise_gain(u)
    is_square = gain is not None and gain.shape[-1] == chart.dimension == chart.size
    return is_square or (chart.flat and model.transition(x, u) is not None)


def _has_far_points(part: Any, model: StateSpaceModel, record: Record) -> bool:
    """Return whether a rule in a filter or its guide has an initial point beyond 2 rad in an angle."""
    if isinstance(part, SigmaPointLinearisation):
        if record.spread is not None:
            variance = record.spread.square().sum(-1).amax(0)
        else:
            variance = model.initial(1).variance[0]
        d = len(variance)
        xi = part.points(d)[0] * variance.sqrt()
        zero = model.origin.expand(1, -1)
        step = model.chart.add(zero, torch.full((d, d), 1e-3).double() * torch.eye(d))
        turned = model.chart.add(step, 2 * math.pi * torch.eye(d).double())
        is_angle = (model.chart.subtract(turned, step).norm(dim=-1) < 1e-6).double()
        return float((xi * is_angle).norm(dim=-1).amax()) > 2.0
    if isinstance(part, GuidedNoiseProposal):
        return False  # its points are about particles, not about the initial mean
    parts = vars(part).values() if is_dataclass(part) else ()
    return any(_has_far_points(value, model, record) for value in parts)


def method_past(name: str) -> bool:
    """Return whether a filter stores the past of its particles."""
    return (
        bool(getattr(method_of(name), "moves", ()))
        or name.startswith(("cpso", "pso"))
        or name in (*REMEMBERING, "guided_start")
    )
