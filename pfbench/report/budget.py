"""What filters of a cell were given alike, and who is best at what he costs.

A comparison is of equal budgets: the same number of particles, the same time per step, or the same number of evaluations of the
likelihood. Which one was kept is said by the experiment (key `budget` of the job); what the jobs measured is said beside it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from pfbench.metrics import Array
from pfbench.store import BUDGETS, SAME_N, SAME_TIME

_NAMED = 4  # filters whose other number of particles is said by name
_CLOSE = 1.25  # times per step that differ by less are called the same: they scatter from job to job [ours]


@dataclass(frozen=True)
class Front:
    """Accuracy against time, one group of one cell.

    Attributes:
        cell, group, unit: what is shown.
        filters: labels, by time.
        seconds: per step.
        rmse: median over runs of the RMSE, a lost run being worse than any other; infinite where half were lost.
        kept: is there no filter that is as fast and as accurate, and better in one of the two?
    """

    cell: str
    group: str
    unit: str
    filters: tuple[str, ...]
    seconds: tuple[float, ...]
    rmse: tuple[float, ...]
    kept: tuple[bool, ...]


def stated(metas: Sequence[Mapping[str, Any]]) -> str:
    """The budget of jobs that are compared, and what they measured of it, in words for a table.

    Args:
        metas: descriptions of the jobs.

    Raises:
        ValueError: a job names a budget that is not one of `store.BUDGETS`.
    """
    kinds = list(dict.fromkeys(_kind(meta) for meta in metas))
    if len(kinds) > 1:
        return f"Budget: not the same for all ({', '.join(kinds)})."
    (kind,) = kinds
    return f"Budget: {kind}{_measured(kind, metas)}."


def front(cell: str, rows: pd.DataFrame, group: str) -> Front:
    """Who is best at what he costs.

    Args:
        cell: name.
        rows: of one cell, from `frame`.
        group: of the state.
    """
    own = rows[(rows.metric == "rmse") & (rows.component == "norm") & (rows.group == group)]
    error = own.groupby("label").value.median()
    time = rows[rows.metric == "seconds_per_step"].groupby("label").value.median().reindex(error.index)
    order = sorted(error.index, key=lambda label: (time[label], error[label], label))
    seconds, rmse = time[order].to_numpy(dtype=np.float64), error[order].to_numpy(dtype=np.float64)
    unit = str(own.unit.iloc[0]) if len(own) else ""
    kept = tuple(map(bool, undominated(seconds, rmse)))
    return Front(cell, group, unit, tuple(map(str, order)), tuple(map(float, seconds)), tuple(map(float, rmse)), kept)


def undominated(cost: Array, loss: Array) -> np.ndarray:
    """Which of n points no other one dominates: no larger in both and smaller in one; an infinite or unknown loss is none."""
    cost, loss = np.asarray(cost, dtype=np.float64), np.asarray(loss, dtype=np.float64)
    no_worse = (cost[:, None] <= cost) & (loss[:, None] <= loss)
    less = (cost[:, None] < cost) | (loss[:, None] < loss)
    return ~(no_worse & less).any(axis=0) & np.isfinite(loss)


def _kind(meta: Mapping[str, Any]) -> str:
    config = meta.get("config")
    kind = str(meta.get("budget") or (config.get("budget") if isinstance(config, Mapping) else None) or SAME_N)
    if kind not in BUDGETS:
        raise ValueError(f"budget={kind} of job {meta.get('key')} is none that a report knows; give one of {', '.join(BUDGETS)}")
    return kind


def _numbers(metas: Sequence[Mapping[str, Any]]) -> str:
    """The commonest number of particles, and which filters have others."""
    by_label = [(int(meta["particles"]), str(meta.get("label", ""))) for meta in metas if meta.get("particles")]
    count = Counter(number for number, _ in by_label)
    (most, _), *others = sorted(count.items(), key=lambda item: (-item[1], item[0]))
    told = []
    for number, _ in sorted(others):
        labels = sorted({label for own, label in by_label if own == number and label})
        told.append(f"{number} of {', '.join(labels)}" if 0 < len(labels) <= _NAMED else str(number))
    return f"N = {', '.join([str(most), *told])}{_changing(metas)}"


def _changing(metas: Sequence[Mapping[str, Any]]) -> str:
    """Of filters that change their number within so many, how many they had."""
    used: dict[str, list[Mapping[str, float]]] = {}
    for meta in metas:
        if "particles_used" in meta:
            used.setdefault(str(meta.get("label", "")), []).append(meta["particles_used"])
    said = [
        f"{label} had {min(one['least'] for one in own)} to {max(one['most'] for one in own)}, "
        f"{sum(one['mean'] for one in own) / len(own):.0f} on average"
        for label, own in sorted(used.items())
    ]
    return "".join(f"; {text}" for text in said)


def _measured(kind: str, metas: Sequence[Mapping[str, Any]]) -> str:
    swarms = [meta for meta in metas if meta.get("particles")]
    if not swarms:
        return " (no particle filter here)"
    if kind == SAME_N:
        numbers = sorted({int(meta["particles"]) for meta in swarms})
        return f" (N = {numbers[0]} of each particle filter)" if len(numbers) == 1 else f" was not kept ({_numbers(metas)})"
    if kind == SAME_TIME:
        return _kept([float(meta["seconds"]["per_step"]) for meta in swarms], 1e3, "ms per step", swarms)
    if any(meta.get("likelihoods_per_step") is None for meta in swarms):
        return " (as the experiment states; the jobs do not count them)"
    return _kept([float(meta["likelihoods_per_step"]) for meta in swarms], 1.0, "per step", swarms)


def _kept(costs: Sequence[float], scale: float, unit: str, metas: Sequence[Mapping[str, Any]]) -> str:
    """What steps cost, in words; by name the filters that are far from the price.

    The price is the job's own, which is another one in each cell; where none was set, the middle of what jobs cost.
    """
    middle = float(np.median(costs))
    prices = [(meta.get("bought") or {}).get("price", middle) for meta in metas]
    far: dict[str, list[float]] = {}
    for meta, cost, price in zip(metas, costs, prices, strict=True):
        if not price / _CLOSE <= cost <= price * _CLOSE:
            far.setdefault(str(meta.get("label", "")), []).append(cost / price)
    said = f"{scale * min(costs):.3g} to {scale * max(costs):.3g} {unit}, particle filters alone; {_numbers(metas)}"
    missed = [f"{label} ({_range(ratios)} of the price)" for label, ratios in far.items()]
    return f" was not kept by {', '.join(missed)} ({said})" if missed else f" ({said})"


def _range(values: Sequence[float]) -> str:
    low, high = (f"{value:.2g}" for value in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"
