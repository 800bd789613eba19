"""Agreement of a replayed run with the stored one: common digits, and the first step that differs."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pfbench.results import store

AGREEING_DIGITS = (
    4  # significant digits from which two runs are the same run with other rounding [ours]
)
_SCORES = ("crps", "pit", "energy_score", "nis", "nis_dof")
_SHARED = ("time", "pcrb", "range", "score_steps")


class ArrayAgreement(NamedTuple):
    """Agreement of an array.

    Attributes:
        name: Name of the array.
        digits: Common significant digits, relative to the largest value of each component; infinite if
            all numbers are equal.
        time_s: Time of the first number that differs in the first four digits, NaN without one.
    """

    name: str
    digits: float
    time_s: float

    @property
    def agrees(self) -> bool:
        """Agreement of the first four digits."""
        return self.digits >= AGREEING_DIGITS


def compare_runs(stored: store.JobResult, replayed: store.JobResult) -> list[ArrayAgreement]:
    """Compare the arrays of two results of one run.

    Args:
        stored: Stored result with one run.
        replayed: Computed result with one run, scored at the same steps.

    Returns:
        Agreement of each array that both have, those that differ most first.
    """
    rows = []
    for name in stored.data:
        if name in _SHARED or name not in replayed.data:
            continue
        a = np.asarray(stored.data[name][0], dtype=np.float64)
        b = np.asarray(replayed.data[name][0], dtype=np.float64)
        times = _times(name, a, stored)
        rows.append(_compare_array(name, a, b, times))
    return sorted(rows, key=lambda row: row.digits)


def describe_agreement(rows: list[ArrayAgreement]) -> str:
    """Describe the agreement of all arrays in one or two sentences.

    Args:
        rows: Result of `compare_runs`.
    """
    worst = rows[0]
    if math.isinf(worst.digits):
        return f"All {len(rows)} stored arrays are equal in every digit."
    if worst.agrees:
        return (
            f"The stored numbers agree to {worst.digits:.0f} significant digits or more; least: "
            f"{worst.name}."
        )
    differing = [row for row in rows if not row.agrees]
    times = [row.time_s for row in differing if not math.isnan(row.time_s)]
    since = f", from {min(times):.6g} s on" if times else ""
    names = ", ".join(row.name for row in differing)
    return (
        f"The stored numbers do not agree: {names} differ in the first {AGREEING_DIGITS} digits{since}. "
        "Another version of pfbench or of a library, another processor or another engine can be the reason."
    )


def _times(name: str, values: np.ndarray, result: store.JobResult) -> np.ndarray | None:
    """Return the time of each row of an array, or None if it is without an axis of time."""
    if values.ndim == 0:
        return None
    time = result.data["time"]
    return time[result.data["score_steps"]] if name in _SCORES else time


def _compare_array(
    name: str, a: np.ndarray, b: np.ndarray, times: np.ndarray | None
) -> ArrayAgreement:
    """Compare two arrays [T, ...] or numbers."""
    if a.shape != b.shape:
        return ArrayAgreement(name, 0.0, math.nan)
    a, b = np.atleast_1d(a), np.atleast_1d(b)
    same = (a == b) | (np.isnan(a) & np.isnan(b))
    if same.all():
        return ArrayAgreement(name, math.inf, math.nan)
    finite = np.where(np.isfinite(a), np.abs(a), 0.0)
    scale = finite.max(axis=0, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        relative = np.where(same, 0.0, np.abs(a - b) / scale)
    relative = np.where(np.isnan(relative), np.inf, relative)  # only one of both is missing
    worst = float(relative.max())
    digits = math.floor(-math.log10(worst)) if 0.0 < worst < 1.0 else 0
    first = math.nan
    if times is not None:
        rows = (relative > 10.0**-AGREEING_DIGITS).reshape(len(relative), -1).any(axis=1)
        first = float(times[np.argmax(rows)]) if rows.any() else math.nan
    return ArrayAgreement(name, float(digits), first)
