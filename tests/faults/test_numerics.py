"""Runs that were false before their health was marked, and errors that were unclear."""

import pytest
import torch
from filter_cases import method_of

from faults.numeric_cases import CASES, RUNS
from faults.numerics import try_case
from faults.tally import FINE
from pfbench.core import PhiloxStream, Record
from pfbench.filter.loop import run_filter

POINTS = (("ekf_pf", "H of 1e100"), ("dmc_noise", "R of 1e-24"), ("dmc_optimal", "H of 1e100"))


@pytest.mark.parametrize(
    ("name", "case", "remark"),
    [
        *((name, case, "marked") for name, case in POINTS),
        ("mcmc_flow_stat", "zero Q and P0", "clear error"),
    ],
)
def test_an_extreme_case_is_marked_or_refused(name: str, case: str, remark: str) -> None:
    assert try_case(name, CASES[case], "eager") == [(FINE, remark, "")] * RUNS


def test_a_point_that_is_not_marked_is_counted_as_false(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "pfbench.filter.health.starts_certain", lambda *_: torch.ones(RUNS, dtype=torch.bool)
    )
    outcomes = [
        outcome for name, case in POINTS for outcome in try_case(name, CASES[case], "eager")
    ]
    assert any(outcome[0] == "false" for outcome in outcomes)


def test_a_dead_sensor_moves_no_filter_far() -> None:
    """The printed reconstruction went to 1e150; the measured state is within 2 of zero."""
    case = CASES["dead sensor"]
    draws = PhiloxStream(1, torch.arange(RUNS), torch.float64)
    record = Record(case.y.repeat(1, 10, 1))
    result = run_filter(method_of("dmc_reconstructed_printed"), case.build(), record, draws)
    assert float(result.mean.abs().max()) < 10.0
