"""Budget of compared filters, and the Pareto front of accuracy and time.

A comparison is made at an equal budget: number of particles, time per step, or likelihood evaluations.
The job key `budget` states the intended budget. The report adds the measured values.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pfbench.results.store import BUDGETS, SAME_N, SAME_TIME

_NAMED = 4  # filters that are listed by name if their number of particles differs
_CLOSE = 1.25  # ratio of times per step below which budgets count as equal: times vary between jobs [ours]


def format_budget(metadata: Sequence[Mapping[str, Any]]) -> str:
    """Format the budget of compared jobs and its measured values as a table note."""
    kinds = list(dict.fromkeys(_budget_kind(meta) for meta in metadata))
    if len(kinds) > 1:
        return f"Budget: differs between jobs ({', '.join(kinds)})."
    (kind,) = kinds
    return f"Budget: {kind}{_format_measured(kind, metadata)}."


def _budget_kind(meta: Mapping[str, Any]) -> str:
    """Return the budget of a job."""
    config = meta.get("config")
    kind = str(
        meta.get("budget")
        or (config.get("budget") if isinstance(config, Mapping) else None)
        or SAME_N
    )
    if kind not in BUDGETS:
        options = ", ".join(BUDGETS)
        raise ValueError(
            f"budget must be one of {options}, got {kind} in job {meta.get('key')}. Repeat the job."
        )
    return kind


def _format_counts(metadata: Sequence[Mapping[str, Any]]) -> str:
    """Format the most frequent number of particles and the filters with other numbers."""
    by_label = [
        (int(meta["particles"]), str(meta.get("label", "")))
        for meta in metadata
        if meta.get("particles")
    ]
    count = Counter(number for number, _ in by_label)
    (most, _), *others = sorted(count.items(), key=lambda item: (-item[1], item[0]))
    texts = []
    for number, _ in sorted(others):
        labels = sorted({label for count_, label in by_label if count_ == number and label})
        texts.append(
            f"{number} of {', '.join(labels)}" if 0 < len(labels) <= _NAMED else str(number)
        )
    return f"N = {', '.join([str(most), *texts])}{_format_adaptive_counts(metadata)}"


def _format_adaptive_counts(metadata: Sequence[Mapping[str, Any]]) -> str:
    """Format the particle counts of filters that adapt them."""
    used: dict[str, list[Mapping[str, float]]] = {}
    for meta in metadata:
        if "particles_used" in meta:
            used.setdefault(str(meta.get("label", "")), []).append(meta["particles_used"])
    texts = [
        f"{label} used {min(row['least'] for row in rows)} to {max(row['most'] for row in rows)}, "
        f"{sum(row['mean'] for row in rows) / len(rows):.0f} on average"
        for label, rows in sorted(used.items())
    ]
    return "".join(f", {text}" for text in texts)


def _format_measured(kind: str, metadata: Sequence[Mapping[str, Any]]) -> str:
    """Format the measured budget of the particle filters."""
    jobs = [meta for meta in metadata if meta.get("particles")]
    if not jobs:
        return " (without particle filters)"
    if kind == SAME_N:
        numbers = sorted({int(meta["particles"]) for meta in jobs})
        return (
            f" (N = {numbers[0]} in each particle filter)"
            if len(numbers) == 1
            else f" not met ({_format_counts(metadata)})"
        )
    if kind == SAME_TIME:
        return _format_costs(
            [float(meta["seconds"]["per_step"]) for meta in jobs], 1e3, "ms per step", jobs
        )
    if any(meta.get("likelihoods_per_step") is None for meta in jobs):
        return " (as configured; the jobs do not count them)"
    return _format_costs(
        [float(meta["likelihoods_per_step"]) for meta in jobs], 1.0, "per step", jobs
    )


def _format_costs(
    costs: Sequence[float], scale: float, unit: str, metadata: Sequence[Mapping[str, Any]]
) -> str:
    """Format the cost of a step, and the filters that miss the target cost.

    The target is the price of the job, which differs between conditions, or else the median cost.
    """
    middle = float(np.median(costs))
    prices = [(meta.get("budget_allocation") or {}).get("price", middle) for meta in metadata]
    far: dict[str, list[float]] = {}
    for meta, cost, price in zip(metadata, costs, prices, strict=True):
        if not price / _CLOSE <= cost <= price * _CLOSE:
            far.setdefault(str(meta.get("label", "")), []).append(cost / price)
    text = f"{scale * min(costs):.3g} to {scale * max(costs):.3g} {unit}, particle filters only, {_format_counts(metadata)}"
    missed = [
        f"{label} ({_format_range(ratios)} times the target)" for label, ratios in far.items()
    ]
    return f" not met by {', '.join(missed)} ({text})" if missed else f" ({text})"


def _format_range(values: Sequence[float]) -> str:
    """Format the range of values."""
    low, high = (f"{value:.2g}" for value in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"
