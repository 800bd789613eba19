"""Test of resamplers and schemes: expected counts, copies of whole particles."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from pfbench.core.random_stream import PhiloxStream
from pfbench.filter.belief import ParticleBelief
from pfbench.filter.particle.stages import EssResampler, Resampler, ResamplingScheme
from pfbench.model.linear_gaussian import local_level
from pfbench.testing.results import LawCheck, check_count, check_p_values, compute_twice, find_kind

_STATEMENT = "a resampler gives each particle its weight on average"
_KINDS = {
    "scheme": ("a", "n", "draws"),
    "resampler": ("model", "belief", "log_a", "n", "draws"),
}


def check_resampling(
    stage: Resampler | ResamplingScheme,
    particles: int = 24,
    slots: int | None = None,
    runs: int = 20_000,
    seed: int = 1,
) -> LawCheck:
    """Check that a resampler or a scheme is unbiased and copies whole particles.

    The weights are uneven with some of 0, equal, nearly equal, and almost 1 for one particle. The
    total weight of the copies of each particle must average to its weight, by Hotelling's test over
    runs. States, stored past, memory and ancestors of a slot must belong to one particle. A
    resampler is tested with the weights as resampling probabilities, and with others, for which its
    weights must correct. The copies of two steps must not be correlated.

    Args:
        stage: Resampler, or scheme to be used in every run.
        particles: Number of particles before resampling.
        slots: Number of particles after resampling. The same by default.
        runs: Number of independent repetitions. Fewer than 20 000 count as 20 000.
        seed: Seed of the random stream.

    Returns:
        The smaller of the p-values.

    Raises:
        AssertionError: If the statement does not hold, or if the stage is not repeatable.
        ValueError: If the stage is an instance of neither kind, or there are too few particles.
    """
    kind = find_kind("check_resampling", stage, _KINDS, "Systematic()")
    check_count("check_resampling", 4, particles=particles)
    count = particles if slots is None else slots
    check_count("check_resampling", slots=count, runs=runs)
    resampler: Any = EssResampler(stage, 1.0) if kind == "scheme" else stage  # type: ignore[arg-type]
    p_values, deviations = {}, {}
    for name, (a, log_a) in _weight_cases(particles).items():
        cases = max(runs, 20_000)  # a copy of a light particle is rare
        log_w = torch.log(torch.tensor(a))
        log_probabilities = log_w if log_a is None else log_a
        shares = _shares(resampler, log_w.expand(cases, -1), log_probabilities, count, seed)
        assert not shares[:, a == 0.0].any(), (
            f"{_STATEMENT}: with {name}, a particle of weight 0 was copied"
        )
        p_values[name], deviations[name] = _hotelling(count * (shares - a))
        if name == "the weights":
            few = min(cases, max(runs // 4, 4 * particles))
            later = _shares(
                resampler, log_w.expand(few, -1), log_probabilities, count, seed, step=4
            )
            p_values["two steps"] = _correlation(shares[:few], later)
            compute = partial(_shares, resampler, log_w.expand(64, -1), log_w, count, seed)
            compute_twice("resampler", compute, lambda array: {"copies": array})
    return check_p_values(
        _STATEMENT, p_values, 1e-4, largest_deviation_in_copies=max(deviations.values())
    )


def _uneven_weights(n: int, rng: np.random.Generator) -> np.ndarray:
    """Draw weights of all sizes [N], with zeros and an exact multiple of 1/N."""
    a = rng.gamma(0.5, size=n)
    a[[0, n // 2, 3, -1]] = 0.0
    a *= (1 - 2 / n) / a.sum()
    a[3] = 2 / n
    return a


def _weight_cases(n: int) -> dict[str, tuple[np.ndarray, Tensor | None]]:
    """Return weights [N] by name, with other resampling probabilities if any."""
    rng = np.random.default_rng(0)
    uneven = _uneven_weights(n, rng)
    near = 1.0 + 0.1 * rng.uniform(-1.0, 1.0, n)
    heavy = np.full(n, 0.02 / (n - 1))
    heavy[n // 2] = 0.98
    tilt = torch.linspace(-1.0, 1.0, n, dtype=torch.float64)
    tilted = torch.log_softmax(0.5 * torch.log(torch.tensor(uneven)) + tilt, -1)
    return {
        "the weights": (uneven, None),
        "other probabilities": (uneven, tilted),
        "equal weights": (np.full(n, 1.0 / n), None),
        "nearly equal weights": (near / near.sum(), None),
        "one weight of almost 1": (heavy, None),
    }


def _correlation(first: np.ndarray, second: np.ndarray) -> float:
    """Return the p-value of uncorrelated sums of two steps, weighted by fixed random numbers."""
    projection = np.random.default_rng(2).normal(size=first.shape[1])
    sums = first @ projection, second @ projection
    if min(float(np.std(sum_)) for sum_ in sums) < 1e-9:
        return 1.0  # all copies are certain
    return float(stats.pearsonr(*sums).pvalue)


def _shares(
    resampler: Any, log_w: Tensor, log_a: Tensor, count: int, seed: int, step: int = 3
) -> np.ndarray:
    """Resample numbered particles, and return the weight of their copies [runs, N]."""
    runs, n = log_w.shape
    number = torch.arange(n, dtype=torch.float64).expand(runs, -1)
    places = torch.tensor(
        np.random.default_rng(1).permutation(n)
    ).double()  # so that a sorting resampler moves them
    parts = {
        "state": places.expand(runs, -1).unsqueeze(2),
        "window": number[..., None, None],
        "memory": number.unsqueeze(2),
    }
    parts = {name: value.clone() for name, value in parts.items()}
    belief = ParticleBelief(
        parts["state"],
        log_w,
        torch.zeros(runs, dtype=torch.float64),
        {"w": parts["window"]},
        {"m": parts["memory"]},
    )
    same = torch.equal(log_a, log_w[0])  # by identity: nothing to correct
    slots = torch.full((runs, 1), float(count), dtype=torch.float64)
    draws = PhiloxStream(seed, torch.arange(runs)).at_step(step)
    after, _ = resampler(
        local_level(1.0, 1.0, 0.0, 1.0),
        belief,
        log_w if same else log_a.expand(runs, -1),
        slots,
        draws,
    )
    live = torch.isfinite(after.log_w)
    assert int(live.sum(1).max()) <= count, (
        f"{_STATEMENT}: at most {count} slots must be active, got {int(live.sum(1).max())}"
    )
    w, m = after.window["w"][..., 0, 0], after.memory["m"][..., 0]
    is_consistent = (after.x[..., 0] == places[w.long()]) & (w == m)
    if after.ancestors is not None:  # ancestors may be numbered in another order, but one to one
        first = torch.full((runs, n), -1.0, dtype=torch.float64).scatter(1, after.ancestors, w)
        back = torch.full((runs, n), -1, dtype=torch.long).scatter(1, w.long(), after.ancestors)
        is_consistent = (
            is_consistent
            & (first.gather(1, after.ancestors) == w)
            & (back.gather(1, w.long()) == after.ancestors)
        )
    assert bool(is_consistent[live].all()), (
        f"{_STATEMENT}: state, window, memory and ancestor of a slot must be of one particle"
    )
    weight = torch.where(live, after.log_w.exp(), 0.0)
    return torch.zeros(runs, n, dtype=torch.float64).scatter_add(1, w.long(), weight).numpy()


def _hotelling(deviations: np.ndarray) -> tuple[float, float]:
    """Return the p-value of a mean of 0, and the largest mean."""
    runs, mean = len(deviations), deviations.mean(0)
    spread, axes = np.linalg.eigh(np.cov(deviations.T))
    free = spread > 1e-9
    z = math.sqrt(runs) * (mean @ axes)
    largest = float(np.abs(mean).max())
    if np.abs(z[~free]).max(initial=0.0) > 1e-3:
        return 0.0, largest  # copies that are certain, and wrong
    return float(
        stats.chi2(free.sum()).sf((z[free] ** 2 / spread[free]).sum())
    ) if free.any() else 1.0, largest
