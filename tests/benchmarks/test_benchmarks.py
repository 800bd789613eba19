"""The speed comparison compares filters that compute the same thing. Speed itself is never tested."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from functools import cache
from types import ModuleType, SimpleNamespace as Work

import numpy as np
import oracles
import pytest
import torch
from checkout import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))  # scripts, not a package
import house
import naive
import workload


@cache
def tiny() -> Work:
    return Work(**workload.make(runs=4, steps=10, particles=200)._asdict())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("contestant", [house, naive], ids=lambda module: module.__name__)
def test_contestants_estimate_the_exact_evidence(
    contestant: ModuleType, dtype: torch.dtype
) -> None:
    """E[Z_hat] = Z and E[Z_hat m_hat] = Z m for any number of particles [Del Moral 2004]: no bias to allow for."""
    filtered: Callable[[int], tuple[torch.Tensor, torch.Tensor]] = contestant.sir(tiny(), dtype)
    answers = [filtered(seed) for seed in range(60)]
    ratio = np.exp(
        np.stack([log_z.numpy() for log_z, _ in answers]) - tiny().log_evidence
    )  # [seeds, R]
    off = (np.stack([mean[:, -1].numpy() for _, mean in answers]) - tiny().mean[:, -1]) / tiny().sd[
        -1
    ]
    values = [ratio - 1.0, *np.moveaxis(ratio[..., None] * off, -1, 0)]
    for value in values:
        error = value.std() / math.sqrt(value.size)
        assert error < 0.2, "too few seeds to tell anything"
        assert abs(value.mean()) < 4.5 * error, f"{value.mean():.3f} +- {error:.3f}"


def test_the_exact_answer_is_the_kalman_filters() -> None:
    work = tiny()
    d = len(work.p0)
    for run in range(len(work.y)):
        m, p, log_z = np.zeros(d), np.diag(work.p0**2), 0.0
        for t, y in enumerate(work.y[run]):
            phi, gain = work.step[t, :, :d], work.step[t, :, d:]
            one = oracles.kalman(
                phi, gain @ gain.T, np.eye(d)[work.seen], np.diag(work.r**2), m, p, y[None]
            )
            m, p, log_z = one.mean[0], one.covariance[0], log_z + one.log_evidence[0]
        np.testing.assert_allclose(work.log_evidence[run], log_z, rtol=1e-10)
        np.testing.assert_allclose(work.mean[run, -1] / work.sd[-1], m / work.sd[-1], atol=1e-8)


def test_a_dense_and_a_sparse_workload_have_their_zeros_and_their_exact_answer() -> None:
    shares, evidence = {}, {}
    for zeros in ("none", "model", "small"):
        work = workload.make(runs=2, steps=10, particles=200, zeros=zeros)
        shares[zeros] = float((work.step == 0.0).mean())
        evidence[zeros] = work.log_evidence
        again = workload.kalman(work.step, work.p0, work.r, work.seen, work.y)[0]
        assert np.allclose(again, work.log_evidence)
    assert shares["none"] == 0.0 < 0.55 < shares["model"] < 0.65 < 0.75 < shares["small"] < 0.85
    assert np.allclose(
        evidence["none"], evidence["model"], atol=1e-2
    )  # tiny coefficients change little


def test_longer_than_the_flight_is_refused() -> None:
    with pytest.raises(ValueError, match="steps=301"):
        workload.make(runs=1, steps=301, particles=2)
