"""Arguments of the inference algorithms: a wrong one is named with what it must be, its value and a remedy."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from pyro.distributions import LogNormal

from pfbench.core.record import Record
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.model.linear_gaussian import local_level
from pfbench.ppl.ibis_smc2 import smc2
from pfbench.ppl.likelihood import FilterLikelihood
from pfbench.ppl.nuts_svi import nuts, svi
from pfbench.ppl.parameter_posterior import simulation_based_calibration
from pfbench.ppl.parameterised_model import ParameterisedModel
from pfbench.ppl.particle_mcmc import pmmh
from pfbench.ppl.pyro_program import program, simulate

GOOD: dict[str, Any] = {"draws": 2, "warmup": 1, "chains": 1, "seed": 0}
WRONG_CALLS: dict[str, tuple[Callable[..., Any], dict[str, Any], str]] = {
    "no draws of nuts": (nuts, {"draws": 0}, r"nuts\.draws must be a whole number .* 1, got 0"),
    "part of a draw": (pmmh, {"draws": 2.5}, r"pmmh\.draws must be a whole number .* got 2\.5"),
    "text": (pmmh, {"chains": "4"}, r"pmmh\.chains must be a whole number .* got '4'"),
    "truth value": (nuts, {"warmup": True}, r"nuts\.warmup must be a whole number .* got True"),
    "negative seed": (pmmh, {"seed": -1}, r"pmmh\.seed must be a whole number of at least 0"),
    "a tensor": (pmmh, {"record": torch.zeros(1, 3, 1)}, r"record must be a Record, got Tensor"),
    "a class": (pmmh, {"method": ParticleFilter}, r"pmmh\.method must be a Filter, got Particle"),
    "a number": (nuts, {"program": 3}, r"nuts\.program must be a Callable, got int"),
}


@pytest.mark.parametrize("name", WRONG_CALLS)
def test_a_wrong_argument_of_an_algorithm_is_named(name: str) -> None:
    function, change, message = WRONG_CALLS[name]
    record = Record(torch.zeros(1, 3, 1, dtype=torch.float64))
    unknown = ParameterisedModel(
        lambda sd: local_level(1.0, sd, 0.0, 1.0), {"sd": LogNormal(0.0, 0.5)}
    )
    subject = {"program": program(unknown, FilterLikelihood(ParticleFilter(10)))}
    if function is pmmh:
        subject = {"unknown": unknown, "method": ParticleFilter(10)}
    with pytest.raises(ValueError, match=message) as caught:
        function(**{**subject, "record": record, **GOOD, **change})
    assert str(caught.value).endswith(".")


def test_wrong_arguments_of_svi_smc2_and_simulation_are_named() -> None:
    record = Record(torch.zeros(1, 3, 1, dtype=torch.float64))
    unknown = ParameterisedModel(
        lambda sd: local_level(1.0, sd, 0.0, 1.0), {"sd": LogNormal(0.0, 0.5)}
    )
    method = ParticleFilter(10)
    for change, message in (
        (
            {"steps": 0},
            r"svi\.steps must be a whole number of at least 1, got 0\. Change svi\.steps",
        ),
        ({"draws": 0}, r"svi\.draws must be"),
        ({"rate": math.nan}, r"svi\.rate must be positive and finite, got nan"),
        ({"guide": None}, r"svi\.guide must be a Callable, got NoneType"),
    ):
        words: dict[str, Any] = {"guide": print, "steps": 1, "draws": 1}
        with pytest.raises(ValueError, match=message):
            svi(print, record, **{**words, **change})
    for values, message in (
        ((unknown, method, record.y, 4), r"smc2\.record must be a Record, got Tensor"),
        ((method, method, record, 4), r"smc2\.unknown must be a ParameterisedModel, got Particle"),
        ((unknown, method, record, 1), r"smc2\.particles must be a whole number of at least 2"),
    ):
        with pytest.raises(ValueError, match=message):
            smc2(*values)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"simulate\.model must be a StateSpaceModel, got Param"):
        simulate(unknown, record, 0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"calibration\.draws must be a whole number"):
        simulation_based_calibration(unknown, record, print, draws=0)  # type: ignore[arg-type]
