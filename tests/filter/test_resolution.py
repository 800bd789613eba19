"""Resolution of the number type: single precision is refused or marked where it does not suffice."""

from typing import Any

import pytest
import torch
from torch import Tensor

from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    CubaturePoints,
    GaussianFilter,
    SigmaPointLinearisation,
    TaylorLinearisation,
    health,
    health as module,
    input_check,
)
from pfbench.filter.health import HEALTH
from pfbench.filter.loop import FilterResult, run_filter
from pfbench.model import LinearGaussian
from pfbench.ppl.pyro_program import simulate

RUNS, STEPS = 4, 30
FILTERS = {
    "ekf": GaussianFilter(TaylorLinearisation()),
    "ckf": GaussianFilter(SigmaPointLinearisation(CubaturePoints())),
}
LARGE = {
    "offset": 1e5,
    "small R": 1e4,
    "similar sensors": 1e4,
    "wide prior": 1e5,
    "sum measured": 1e4,
}
TOLERANCE = 0.3  # standard deviations; the criterion bounds the spacing of one rounding by 0.1
SUM_ONLY = {
    "measurement_matrix": [[1.0, 1.0], [0.0, 0.0]],
    "noise_factor": [[1e-3, 0.0], [0.0, 1e-3]],
}
SCALES: dict[str, Any] = {
    "offset": lambda a: {"initial_mean": [a, 0.0]},
    "small R": lambda a: {"measurement_sd": [1.0 / a, 1.0 / a]},
    "similar sensors": lambda a: {
        "measurement_matrix": [[1.0, 1.0], [1.0, 0.99]],
        "measurement_sd": [1.0 / a, 1.0 / a],
    },
    "wide prior": lambda a: {"initial_sd": [a, a]},
    "sum measured": lambda a: {"initial_sd": [a, a], **SUM_ONLY},
}


def model(**matrices: Any) -> LinearGaussian:
    return LinearGaussian(
        **{
            "transition_matrix": [[1.0, 0.5], [0.0, 0.9]],
            "noise_factor": [[0.6, 0.0], [0.2, 0.5]],
            "measurement_matrix": [[1.0, 0.0], [0.3, 1.0]],
            "measurement_sd": [1.0, 0.8],
            "initial_mean": [0.3, -0.2],
            "initial_sd": [1.5, 1.0],
        }
        | matrices
    )


def draw_measurements(matrices: dict[str, Any]) -> Tensor:
    return simulate(model(**matrices), Record(torch.zeros(RUNS, STEPS, 2, dtype=torch.float64)), 3)[
        0
    ].y


def filtered(name: str, matrices: dict[str, Any], y: Tensor, dtype: torch.dtype) -> FilterResult:
    draws = PhiloxStream(1, torch.arange(RUNS), dtype)
    return run_filter(FILTERS[name], model(**matrices).to(dtype), Record(y.to(dtype)), draws)


def largest_offset(name: str, matrices: dict[str, Any]) -> float:
    """Return the largest difference of single and double precision in unmarked runs, in sd."""
    y = draw_measurements(matrices)
    exact = filtered(name, matrices, y, torch.float64)
    assert set(exact.health.tolist()) == {HEALTH.index("ok")}
    single = filtered(name, matrices, y, torch.float32)
    off = ((single.mean.double() - exact.mean) / exact.variance.sqrt()).abs().amax((1, 2))
    return float(torch.where(single.health == HEALTH.index("ok"), off, -1.0).amax())


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("kind", SCALES)
def test_single_precision_is_exact_to_a_fraction_of_the_spread_or_refused_or_marked(
    name: str, kind: str
) -> None:
    assert 0.0 <= largest_offset(name, SCALES[kind](100.0)) < TOLERANCE  # no false alarm
    assert largest_offset(name, SCALES[kind](LARGE[kind])) < TOLERANCE
    with pytest.raises(ValueError, match=r"dtype must .*got float32 .* Set dtype=float64"):
        largest_offset(name, SCALES[kind](1e8))


def test_the_offsets_without_the_criteria_are_large(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(input_check, "check_measurement_resolution", lambda *_: None)
    monkeypatch.setattr(health, "is_ill_conditioned", lambda a: torch.zeros(len(a)).bool())
    monkeypatch.setattr(health, "is_coarse", lambda a, _: torch.zeros_like(a).bool())
    assert largest_offset("ckf", SCALES["small R"](1e6)) > TOLERANCE
    assert largest_offset("ckf", SCALES["sum measured"](1e4)) > TOLERANCE


def test_outliers_are_no_reason_to_refuse_a_type() -> None:
    y = draw_measurements({})
    y[:, 7] = 1e9
    assert not bool(filtered("ekf", {}, y, torch.float32).lost.any())


def test_a_component_without_variance_is_known_exactly() -> None:
    value, variance = torch.tensor([1e9, 1e9, 1.0]), torch.tensor([0.0, 1.0, 1.0])
    assert module.is_coarse(value, variance).tolist() == [False, True, False]
    covariance = torch.diag(torch.tensor([1e12, 0.0, 1e-12])).expand(2, 3, 3).clone()
    assert not module.is_ill_conditioned(covariance).any()
    covariance[1, 0, 2] = covariance[1, 2, 0] = 1.0 - 1e-7
    assert module.is_ill_conditioned(covariance).tolist() == [False, True]
