"""Data of a datasheet file in the form of its figures and tables."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pfbench.results import store
from pfbench.results.state_groups import component_groups, main_component_group
from pfbench.results.status import divergence_threshold


def list_satellites(sheet: store.JobResult) -> list[str]:
    """Return the names of the satellites, from the scenario, its receiver, or as numbers."""
    if "satellites" in sheet.data:
        return [
            "".join(chr(int(letter)) for letter in row).strip() for row in sheet.data["satellites"]
        ]
    return [str(name) for name in sheet.meta["satellites"]]


def visible_satellites(sheet: store.JobResult) -> np.ndarray:
    """Count the visible satellites at each step [T]."""
    count: np.ndarray = (~np.isnan(sheet.data["elevation"])).sum(1)
    return count


def has_sparse_counts(count: np.ndarray) -> bool:
    """Return whether some counts [T] are zero and others positive, where a line shows only jumps."""
    return bool((count == 0).any() and (count > 0).any())


_ROUNDING = 1e-12  # SI units: difference of quaternions between equal runs


def compute_spreads(
    sheet: store.JobResult,
) -> list[tuple[Any, np.ndarray, np.ndarray, np.ndarray | None]]:
    """List the groups with a spread over runs: group, times with truth, spread and PCRB.

    Spread and PCRB are in the displayed unit.
    """
    rows = []
    for block in component_groups(sheet.meta["state"]):
        value = compute_deviation(sheet.data, block.places) * block.scale
        finite_mask = ~np.isnan(value)
        if finite_mask.any() and (value[finite_mask] > _ROUNDING * block.scale).any():
            bound = None
            if "pcrb" in sheet.data:
                variance = sheet.data["pcrb"][finite_mask][:, block.places].astype(np.float64) ** 2
                bound = np.sqrt(variance.sum(-1)) * block.scale
            rows.append((block, sheet.data["time"][finite_mask], value[finite_mask], bound))
    return rows


def compute_deviation(data: dict[str, np.ndarray], indices: list[int]) -> np.ndarray:
    """Compute the standard deviation over runs of the norm of components.

    Args:
        data: Arrays of the datasheet.
        indices: Indices of the components.

    Returns:
        Standard deviation, [T]. NaN where fewer than two runs have a truth.
    """
    square = (data["error"][..., indices].astype(np.float64) ** 2).sum(-1)
    count = (~np.isnan(square)).sum(0)
    return np.sqrt(np.where(count > 1, np.nansum(square, 0) / np.maximum(count - 1, 1), np.nan))


def group_residuals(sheet: store.JobResult) -> dict[str, np.ndarray]:
    """Group the residuals [R or 1, T, k] by kind of measurement, without missing components."""
    z = drop_equal_runs(sheet.data["residual"].astype(np.float64))
    finite_mask = ~np.isnan(z).all((0, 1))
    kinds = np.array(sheet.meta["kinds"])
    groups = {
        kind: z[..., (kinds == kind) & finite_mask] for kind in dict.fromkeys(sheet.meta["kinds"])
    }
    return {str(kind): values for kind, values in groups.items() if values.shape[-1]}


def drop_equal_runs(z: np.ndarray) -> np.ndarray:
    """Return a single run if all runs have equal residuals, else all runs."""
    return z[:1] if np.allclose(z, z[:1], rtol=0, atol=1e-4, equal_nan=True) else z


def select_tracks(track: np.ndarray) -> np.ndarray:
    """Return a single track [1, T, 3] if all runs have equal tracks, else all tracks."""
    return (
        track[:1]
        if np.array_equal(track, np.broadcast_to(track[:1], track.shape), equal_nan=True)
        else track
    )


def describe_raw_estimate(meta: Mapping[str, Any]) -> str:
    """Describe the error of the simplest estimate from raw measurements, and the threshold.

    Args:
        meta: Metadata of a datasheet.

    Returns:
        Sentences with the error, five times the error, and the divergence threshold in use.
    """
    raw, group = meta["raw_estimate"], main_component_group(meta["state"])
    method = {0: "dead reckoning", 1: "least squares of one step"}.get(
        raw["steps"], f"least squares of {raw['steps']} steps"
    )
    stated = divergence_threshold(meta)

    def show(value: float | None) -> str:
        return "none" if value is None else f"{value * group.scale:.3g} {group.unit}".rstrip()

    return (
        f"Estimate from raw measurements alone ({method}): {group.group} RMSE {show(raw['rmse'])}; "
        f"dead reckoning: {show(raw['dead_reckoning'])}. Computed divergence threshold: "
        f"{show(raw['threshold'])}. Threshold of the scenario: {show(stated)}."
    )
