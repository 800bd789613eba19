"""What the file of a datasheet holds, cut as figures and tables want it."""

from __future__ import annotations

from typing import Any

import numpy as np

from pfbench import store
from pfbench.report.frame import blocks


def satellites(sheet: store.Result) -> list[str]:
    """Names of the satellites on the sheet: those that the scene spells, else those of its receiver, else numbers."""
    if "satellites" in sheet.arrays:
        return ["".join(chr(int(letter)) for letter in row).strip() for row in sheet.arrays["satellites"]]
    return [str(name) for name in sheet.meta["satellites"]]


def visible(sheet: store.Result) -> np.ndarray:
    """Number of satellites on the sheet at each step [T]."""
    count: np.ndarray = (~np.isnan(sheet.arrays["elevation"])).sum(1)
    return count


def between_epochs(count: np.ndarray) -> bool:
    """Whether something is seen at some steps and nothing at others [T]: a line through such numbers would show only jumps."""
    return bool((count == 0).any() and (count > 0).any())


_ROUNDING = 1e-12  # in SI: quaternions of equal runs differ by so much


def spreads(sheet: store.Result) -> list[tuple[Any, np.ndarray, np.ndarray, np.ndarray | None]]:
    """Each block whose truth differs between runs: its instants with truth, the spread and the bound there, in the unit shown."""
    found = []
    for block in blocks(sheet.meta["state"]):
        value = deviation(sheet.arrays, block.places) * block.scale
        known = ~np.isnan(value)
        if known.any() and (value[known] > _ROUNDING * block.scale).any():
            bound = None
            if "bound" in sheet.arrays:
                bound = np.sqrt((sheet.arrays["bound"][known][:, block.places].astype(np.float64) ** 2).sum(-1)) * block.scale
            found.append((block, sheet.arrays["time"][known], value[known], bound))
    return found


def deviation(arrays: dict[str, np.ndarray], places: list[int]) -> np.ndarray:
    """Standard deviation over runs of the norm of some components [T]; NaN where fewer than two runs have a truth."""
    square = (arrays["error"][..., places].astype(np.float64) ** 2).sum(-1)
    count = (~np.isnan(square)).sum(0)
    return np.sqrt(np.where(count > 1, np.nansum(square, 0) / np.maximum(count - 1, 1), np.nan))


def by_kind(sheet: store.Result) -> dict[str, np.ndarray]:
    """Residuals [R or 1, T, k] of each kind of measurement, of the components that are known and the instants with any."""
    z = distinct(sheet.arrays["residual"].astype(np.float64))
    known = ~np.isnan(z).all((0, 1))
    kinds = np.array(sheet.meta["kinds"])
    each = {kind: z[..., (kinds == kind) & known] for kind in dict.fromkeys(sheet.meta["kinds"])}
    return {str(kind): part for kind, part in each.items() if part.shape[-1]}


def distinct(z: np.ndarray) -> np.ndarray:
    """One run where all have the same residuals: then they are no more numbers than that."""
    return z[:1] if np.allclose(z, z[:1], rtol=0, atol=1e-4, equal_nan=True) else z


def tracks(track: np.ndarray) -> np.ndarray:
    """The tracks [k, T, 3] that differ: one where all runs fly the same."""
    return track[:1] if np.array_equal(track, np.broadcast_to(track[:1], track.shape), equal_nan=True) else track
