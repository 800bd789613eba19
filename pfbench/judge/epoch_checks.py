"""Checks of the scored time and of the number of common epochs."""

from __future__ import annotations

import numpy as np

from pfbench.judge.judge_options import JudgeOptions
from pfbench.judge.reference_track import ReferenceTrack

LEAST_EPOCHS = 10
LEAST_SHARE = 0.9  # share of the epochs outside of holes that must be common


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
    file: str, shared: np.ndarray, is_hole: np.ndarray, share: float, text: str
) -> None:
    """Check that enough epochs are shared, for scores and for the weight of holes.

    Args:
        file: Name of the reference.
        shared: Scored epochs at which all trajectories have a row, [T].
        is_hole: Scored epochs in holes, [T].
        share: Share of the epochs outside of holes that are shared.
        text: Rest of the message, with braces for the number.

    Raises:
        ValueError: If fewer than 10 epochs are shared, or holes exist and fewer than 90 % are shared.
    """
    head = f"trajectories of {file} must share"
    if (count := int(shared.sum())) < LEAST_EPOCHS:
        raise ValueError(
            f"{head} at least {LEAST_EPOCHS} epochs {text.format(count)}, or let the programs write the "
            "same epochs."
        )
    if is_hole.any() and share < LEAST_SHARE:
        percent = f"{100 * share:.3g} %"
        raise ValueError(
            f"{head} {100 * LEAST_SHARE:g} % of the epochs outside of holes {text.format(percent)}."
        )
