"""Headline of a job: error of the main group and status of its runs, in one line."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from pfbench.results import status
from pfbench.results.conditions import main_component_group
from pfbench.stats.error_measures import Array


def main_rmse(outputs: Mapping[str, Array], meta: Mapping[str, Any]) -> float:
    """Compute the RMSE of the main group over all valid runs."""
    group = main_component_group(meta["state"])
    errors = group.scale * outputs["error"][..., group.places].astype(float)
    square = (errors**2).sum(-1)[~np.asarray(outputs["lost"], dtype=bool)]
    return math.sqrt(np.nanmean(square)) if np.isfinite(square).any() else math.inf


HINTS = {
    "heavy-tailed": "Unbounded weights: k-hat {k}, at most 0.7 is reliable. Set a defensive_fraction "
    "above 0 in the proposal or the auxiliary weights, or compare with filter=sir",
    "implausible": "A measurement is more than 1000 standard deviations from every prediction. "
    "Check its unit and the noise of the model, or choose a filter that rejects outliers, such as gate",
    "undefined": "The log likelihood of the model is NaN for valid states, which count as impossible. "
    "Return -inf where a state is impossible",
}


def describe_runs(outputs: Mapping[str, Array], meta: Mapping[str, Any]) -> str:
    """Describe error and status of the runs, such as "position RMSE 833 m; 100 of 100 runs diverged".

    Returns magnitude with unit, counts of `status.count_statuses`, and the threshold.
    """
    group = main_component_group(meta["state"])
    count = status.count_statuses(outputs, meta)
    threshold = status.divergence_threshold(meta)
    kinds = {
        "lost": count.lost,
        "diverged": count.diverged,
        "collapsed": count.collapsed,
        "overconfident": count.overconfident,
        **count.marked,
    }
    present = {name: number for name, number in kinds.items() if number}
    value = main_rmse(outputs, meta)
    rmse = f"{group.group} RMSE {value:.4g} {group.unit}".rstrip()
    if not math.isfinite(value):
        rmse = f"no finite {group.group} error"
    if not present:
        ending = (
            "track kept in {0} of {0} runs" if threshold is not None else "{0} of {0} runs valid"
        )
        return f"{rmse}; {ending.format(count.runs)}"
    if len(present) == 1:
        (name,) = present
        text = f"{present[name]} of {count.runs} runs {name}"
    else:
        text = ", ".join(f"{number} {name}" for name, number in present.items())
        text += f" of {count.runs} runs"
    if count.diverged and threshold is not None:
        limit = f"{threshold * group.scale:.3g} {group.unit}".rstrip()
        text += f" (diverged: error above {limit}, five times that of raw measurements)"
    k = _largest_k(outputs)
    hints = [HINTS[name].format(k=k) for name in count.marked if name in present]
    return ". ".join([f"{rmse}; {text}", *hints])


def _largest_k(outputs: Mapping[str, Array]) -> str:
    """Return the largest Pareto k-hat of the runs, as text."""
    k = np.asarray(outputs.get("pareto_k", np.nan), dtype=float)
    return f"{np.nanmax(k):.2g}" if np.isfinite(k).any() else "unknown"
