"""Blocks of time of long runs: losses of blocks, and the variance of their mean over two scales.

30 blocks are enough: more would shorten an interval by less than 5 %, and shorter blocks depend on each other.
Errors of white and slow noise look independent in short blocks. The variance of the mean of the blocks is
therefore estimated from blocks and from pairs of blocks, each with the correlation of neighbours. The larger one
counts. The differences of blocks are moved away from their location until independent differences
would have this variance. `effective` is the number of independent blocks with the same variance of the mean.

The mean error of a run and its drift are one draw of the run. No number of blocks shows how they vary, so that
errors are also compared without them.

References:
    M. G. Kendall (1954), Note on bias in the estimation of autocorrelation.
    L. W. Schruben (1983), Confidence interval estimation using standardized time series.
    R. Ibragimov and U. K. Mueller (2010), t-statistic based correlation and heterogeneity robust inference.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pfbench.core.parameter_checks import require
from pfbench.stats.comparison import (
    NO_DECISION,
    SAME_RUNS,
    Effect,
    Verdict,
    compare,
)
from pfbench.stats.error_measures import Array, Flags
from pfbench.stats.sentences import format_digits

BLOCKS = 30  # of all sequences together [ours]
MIN_EFFECTIVE = 7.0  # independent blocks that a decision needs [ours]
_JOINED = (1, 2)  # blocks of each scale
_LARGEST_CORRELATION = 0.95
_LEAST_ERROR = 1e-6  # m, smaller errors are rounding of the files


class BlockEffect(NamedTuple):
    """Effect on blocks of time.

    Attributes:
        effect: Effect of the first program, with the variance of dependent blocks.
        effective: Number of independent blocks with the same variance of the mean.
    """

    effect: Effect
    effective: float


def count_blocks(seconds: Sequence[float], block_s: float = 0.0) -> list[int]:
    """Return the number of blocks of each sequence, in proportion to its length, at least 1."""
    length = block_s or sum(seconds) / BLOCKS
    return [max(round(s / length), 1) for s in seconds]


def bound_losses(error: Array, keeps_track: Flags, cap: float) -> Array:
    """Return the logarithm of errors, at most that of the cap: of blocks of time, whose lost runs count apart.

    Args:
        error: Errors, [...], not negative. NaN and infinity count as the cap.
        keeps_track: Errors that count as they are, [...]. The others count as the cap.
        cap: Largest error that counts, positive, in the unit of the error.

    Raises:
        ValueError: If the cap is not a positive number.
    """
    require(
        cap > 0 and math.isfinite(cap),
        "cap",
        "be a positive number",
        cap,
        "State the divergence threshold of the world.",
    )
    counts = keeps_track & np.isfinite(error)
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(np.where(counts, np.minimum(error, cap), cap)))


def block_losses(error: Array, blocks: int, cap: float) -> Array:
    """Return the log root mean square error of the blocks of a sequence, over all runs, at most log cap.

    Shapes: error [..., R, T, K].
    """
    square = (error**2).sum(axis=-1).mean(axis=-2)
    steps = square.shape[-1]
    ends = np.linspace(0, steps, min(blocks, steps) + 1).astype(int)
    size = np.sqrt(np.add.reduceat(square, ends[:-1], axis=-1) / np.diff(ends))
    return bound_losses(np.maximum(size, _LEAST_ERROR), np.isfinite(size), cap)


def remove_drift(error: Array) -> Array:
    """Remove the mean and the linear drift of each run and component.

    Shapes: error [..., T, K].
    """
    steps = error.shape[-2]
    time = np.arange(steps) - (steps - 1) / 2
    basis = np.stack([np.ones_like(time), time], axis=-1)
    basis = basis[:, : min(steps, 2)] / np.linalg.norm(basis, axis=0)[: min(steps, 2)]
    return np.asarray(error - basis @ (basis.T @ error))


def compare_blocks(a: tuple[str, Array], b: tuple[str, Array]) -> BlockEffect:
    """Compare the losses of two programs in neighbouring blocks of time."""
    effect = compare(a, b, "block")
    d = effect.differences
    if not d.any():
        return BlockEffect(effect, float(len(d)))
    ratio, location = float(variance_ratio(d)), effect.location
    spread = location + math.sqrt(ratio) * (d - location)
    return BlockEffect(compare((a[0], b[1] + spread), b, "block"), len(d) / ratio)


def withhold(
    verdict: Verdict, steady: Verdict, effective: float, cause: str = "the mean error and the drift"
) -> Verdict:
    """Return the verdict on blocks, undecided where one record cannot carry its word.

    Args:
        verdict: Verdict on the errors.
        steady: Verdict without what is one draw of each run.
        effective: Number of independent blocks.
        cause: What that is.
    """
    reason = ""
    if verdict.word in (NO_DECISION, SAME_RUNS):
        return verdict
    if effective < min(MIN_EFFECTIVE, verdict.n):
        count = f"{verdict.n} blocks that count as {format_digits(effective, 2)} independent ones"
        reason = f"errors vary slowly: {count}, {MIN_EFFECTIVE:g} are required"
    elif steady.word != verdict.word:
        reason = (
            f"the difference rests on {cause} of the run, which one record cannot "
            "tell from those of another run"
        )
    return verdict._replace(word=NO_DECISION, reason=reason) if reason else verdict


def variance_ratio(d: Array) -> Array:
    """Return the variance of the mean of neighbouring values over that of independent ones, [...], at least 1.

    Shapes: d [..., n].
    """
    n, variance = d.shape[-1], d.var(axis=-1)
    ratio = np.ones(d.shape[:-1])
    for joined in _JOINED:
        if n // joined > 2:
            means = d[..., : n // joined * joined].reshape(*d.shape[:-1], -1, joined).mean(axis=-1)
            rho = _neighbour_correlation(means)
            bessel = (n - 1) / n * means.shape[-1] / (means.shape[-1] - 1)
            size = joined * bessel * means.var(axis=-1) / np.where(variance > 0, variance, np.inf)
            ratio = np.maximum(ratio, size * (1 + rho) / (1 - rho))
    return ratio


def _neighbour_correlation(x: Array) -> Array:
    """Return the correlation of neighbours without its bias, [...], from 0 to 0.95.

    Shapes: x [..., n].
    """
    deviation = x - x.mean(axis=-1, keepdims=True)
    total = (deviation**2).sum(axis=-1)
    product = (deviation[..., 1:] * deviation[..., :-1]).sum(axis=-1)
    rho = product / np.where(total > 0, total, np.inf)
    return np.asarray(np.clip(rho + (1 + 3 * rho) / x.shape[-1], 0.0, _LARGEST_CORRELATION))
