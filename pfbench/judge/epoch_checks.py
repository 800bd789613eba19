"""Checks of the scored time and of the number of common epochs; epochs of equal weight in time."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter

from pfbench.judge.judge_options import JudgeOptions
from pfbench.judge.reference_track import ReferenceTrack
from pfbench.results.error_measures import Array

LEAST_EPOCHS = 10
LEAST_SHARE = 0.9  # share of the epochs outside of holes that must be common
_UNEQUAL = 0.02  # share of the weight that may lie at another epoch than by time
_SHORT_SHARE = 0.1  # share of the time that has shorter steps than the step of even epochs
_REACH_STEPS, _WINDOW = (
    0.75,
    9,
)  # steps, as before the first row of a program; steps around an epoch


def check_scored_time(reference: ReferenceTrack, options: JudgeOptions) -> None:
    """Check that the scored time is within the reference, and blocks are short enough for it.

    Args:
        reference: Reference.
        options: Options.

    Raises:
        ValueError: If not.
    """
    first, last = (float(t) for t in reference.table.time[[0, -1]])
    span = f"{first:.10g} to {last:.10g} s"
    for name, value, is_valid in (
        ("from", options.start, options.start < last),
        ("to", options.end, options.end > first),
    ):
        if not is_valid:
            raise ValueError(
                f"{name} must be within {reference.file} ({span}), got {value:.10g} s. Change {name}=..."
            )
    seconds = min(last, options.end) - max(first, options.start)
    if options.block > seconds / 2:
        raise ValueError(
            f"block must be at most half of the scored time, {seconds / 2:.10g} s, got {options.block:.10g} s. "
            "Set block=0 for the rule."
        )


def check_shared(
    counts: tuple[int, int], share: float, texts: tuple[str, str, str], tolerance: float
) -> None:
    """Check that enough epochs are shared, for scores and for the weight of holes.

    Args:
        counts: Scored epochs at which all trajectories have a row, and scored epochs in holes.
        share: Share of the epochs outside of holes that are shared.
        texts: Name of the reference, number of epochs of each trajectory, and option that helps.
        tolerance: Largest difference of common epochs, s.

    Raises:
        ValueError: If fewer than 10 epochs are shared, or holes exist and fewer than 90 % are shared.
    """
    (shared, in_holes), (file, sizes, remedy) = counts, texts
    if shared < LEAST_EPOCHS:
        raise ValueError(
            f"trajectories of {file} must share at least {LEAST_EPOCHS} epochs within {tolerance:g} s, "
            f"got {shared} of {sizes}. Set {remedy}, or let the programs write the same epochs."
        )
    if in_holes and share < LEAST_SHARE:
        raise ValueError(
            f"trajectories of {file} must share {100 * LEAST_SHARE:g} % of the epochs outside of holes "
            f"within {tolerance:g} s, got {100 * share:.3g} % of {sizes}. Set {remedy}."
        )


def space_evenly(time: Array) -> tuple[np.ndarray, Array]:
    """Choose epochs so that each one counts by the time around it.

    Equal steps are left as they are. Otherwise, instants of equal distance take the nearest epoch, so
    that a slow stretch repeats its epochs and a fast one leaves some out. A program that writes its good
    epochs several times gains nothing. An instant beyond 0.75 steps of the neighbourhood takes none.

    Args:
        time: Epochs, [K], s.

    Returns:
        Index of the epoch of each instant, [T], and the instants, [T], s.
    """
    steps = np.diff(time)
    if len(steps) < 2:
        return np.arange(len(time)), time
    sizes = np.sort(steps)
    short = float(sizes[np.searchsorted(sizes.cumsum(), _SHORT_SHARE * sizes.sum())])
    local = _REACH_STEPS * np.maximum(median_filter(steps, _WINDOW, mode="nearest"), short)
    half = np.minimum(steps / 2, local)
    weights = np.concatenate([half[:1], half]) + np.concatenate([half, half[-1:]])
    if 0.5 * np.abs(weights / weights.sum() - 1 / len(time)).sum() < _UNEQUAL:
        return np.arange(len(time)), time
    instants = time[0] + short * np.arange(int((time[-1] - time[0]) / short * (1 + 1e-9)) + 1)
    right = np.clip(np.searchsorted(time, instants), 1, len(time) - 1)
    is_left = instants - time[right - 1] <= time[right] - instants
    nearest = np.where(is_left, right - 1, right)
    is_near = np.abs(instants - time[nearest]) <= half[right - 1] * (1 + 1e-9)
    return nearest[is_near], instants[is_near]


def check_coverage(names: list[str], coverage: tuple[float, ...], least: float) -> None:
    """Check that one trajectory at least is not lost.

    Args:
        names: Names of the files.
        coverage: Share of the time that each one covers.
        least: Least share.

    Raises:
        ValueError: If all of them are lost.
    """
    if max(coverage, default=0.0) < least:
        shares = ", ".join(f"{100 * c:.3g} % ({n})" for n, c in zip(names, coverage, strict=True))
        raise ValueError(
            f"one trajectory must cover {100 * least:g} % of the time that any of them covers, got {shares}. "
            "Set from and to, or a smaller coverage."
        )
