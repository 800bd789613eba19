"""Laws of every filter, stated once: no later measurement, no other run, lost runs, single precision, angles."""

import math
from typing import Any

import torch
from model_cases import Unrolled
from torch import Tensor

from pfbench.core import PhiloxStream, Record, wrap_angle
from pfbench.filter.loop import FilterResult, run_filter
from pfbench.model import Pendulum, StateSpaceModel
from pfbench.testing import filter_record


def check_own(method: Any, model: StateSpaceModel, y: Tensor, tolerance: float = 1e-9) -> None:
    """Neither measurements from step 5 on nor the other runs of y [R, T, Dy] change an estimate before."""
    other = y.clone()
    other[:, 5:] = other[:, 5:] + 0.7
    other[:, 6] = torch.nan
    whole, changed = (filter_record(method, model, each) for each in (y, other))
    draws = PhiloxStream(1, torch.tensor([2]), model.anchor.dtype)
    alone = run_filter(method, model, Record(y[2:3]), draws)
    assert bool(torch.isfinite(whole.mean).all())
    for name in ("mean", "variance"):
        assert torch.equal(getattr(whole, name)[:, :5], getattr(changed, name)[:, :5]), name
    for name in ("mean", "variance", "log_evidence"):
        one, two = getattr(alone, name)[0], getattr(whole, name)[2]
        torch.testing.assert_close(one, two, rtol=tolerance, atol=tolerance)


def check_lost_alone(method: Any, model: StateSpaceModel, y: Tensor) -> FilterResult:
    """A measurement that cannot be loses its run from then on, and changes no other; return the estimate."""
    healthy, y = filter_record(method, model, y), y.clone()
    y[1, 3] = 1e200
    estimate = filter_record(method, model, y)
    assert estimate.lost.tolist() == [run == 1 for run in range(len(y))]
    assert bool(torch.isnan(estimate.mean[1, 3:]).all())
    for one, two in (
        (estimate.mean[1, :3], healthy.mean[1, :3]),
        (estimate.mean[0], healthy.mean[0]),
        (estimate.mean[2:], healthy.mean[2:]),
    ):
        torch.testing.assert_close(one, two, rtol=1e-12, atol=1e-14)
    return estimate


def check_single(method: Any, model: StateSpaceModel, y: Tensor) -> None:
    """A model in single precision is filtered in it, and loses no run."""
    single = filter_record(method, model.float(), y)
    model.double()
    assert single.mean.dtype == torch.float32
    assert not bool(single.lost.any())


def check_wrapped(method: Any, steps: int = 25, tolerance: float = 1e-6) -> None:
    """A whirling pendulum: estimates on the circle are those on the line, wrapped, with the same variance and evidence."""
    y = torch.sin(torch.linspace(3.0, 12.0, steps, dtype=torch.float64)).reshape(1, steps, 1)
    start = torch.tensor([[3.0, 8.0], [-3.1, -9.0]], dtype=torch.float64)
    circle, line = (
        filter_record(method, model, y.expand(2, -1, -1), start=start)
        for model in (Pendulum(), Unrolled())
    )
    assert float(line.mean[..., 0].abs().max()) > 4.0
    assert float(circle.mean[..., 0].abs().max()) <= math.pi
    apart = circle.mean - line.mean
    apart[..., 0] = wrap_angle(apart[..., 0])
    torch.testing.assert_close(apart, torch.zeros_like(apart), rtol=0.0, atol=0.1 * tolerance)
    for name in ("variance", "log_evidence"):
        torch.testing.assert_close(
            getattr(circle, name), getattr(line, name), rtol=tolerance, atol=0.0
        )
