"""Checks of the scored time and of the number of common epochs."""

from __future__ import annotations

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
