"""Exact filter of terrain navigation on the runs of the studies: `python experiments/analyses/terrain_limit.py`.

A point-mass filter has the density on a grid of position errors and drops cells of no weight. Its mean has the
smallest mean square error of all filters. It shares no code with the filters of pfbench and writes terrain_limit.json.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import yaml

from pfbench import job
from pfbench.model import TerrainAided, TerrainWaves

TOP = Path(__file__).parents[2]
STORE = Path(__file__).with_name("terrain_limit.json")
STUDIES = ("terrain_start", "terrain_rough", "terrain_recorded")
REACH = 4.5  # half width of the grid, initial standard deviations
CELLS_PER_NOISE = (
    0.5  # largest cell, in the measurement's standard deviation over the steepest slope
)
RUNS = 20  # the first runs of a study
LARGEST_GRID = 4e6  # cells at the start; a condition that needs more is left out
DROPPED = 1e-9  # weight of a cell that is dropped, relative to the largest


class PointMass(NamedTuple):
    """Settings of a point-mass filter.

    Attributes:
        waves: Wave vectors [K, 2], amplitudes [K] and phases [K] of the terrain.
        step_sd: Standard deviation of the random walk per step and axis, m.
        measurement_sd: Standard deviation of the measured height, m.
        initial_sd: Standard deviation of the initial error per axis, m.
        cell: Side of a cell, m.
    """

    waves: tuple[np.ndarray, np.ndarray, np.ndarray]
    step_sd: float
    measurement_sd: float
    initial_sd: float
    cell: float

    def run(self, position: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Compute the mean error given the measurements so far.

        Args:
            position: Position of the INS, [T, 2], m.
            y: Measured heights of the terrain, [T], m.

        Returns:
            Means, [T, 2], m.
        """
        half = int(np.ceil(REACH * self.initial_sd / self.cell))
        axis = self.cell * np.arange(-half, half + 1)
        density = np.exp(-0.5 * (axis / self.initial_sd) ** 2)
        weight, low = np.outer(density, density), np.array([-half, -half])
        means = []
        for place, height in zip(position, y, strict=True):
            weight, low = self._diffuse(*_crop(weight, low))
            rows, columns = np.nonzero(weight > DROPPED * weight.max())
            x = self.cell * (np.stack([rows, columns], -1) + low)
            misfit = (height - self._elevation(place - x)) / self.measurement_sd
            log_w = np.log(weight[rows, columns]) - 0.5 * misfit**2
            part = np.exp(log_w - log_w.max())
            weight = np.zeros_like(weight)
            weight[rows, columns] = part / part.sum()
            means.append(weight[rows, columns] @ x)
        return np.array(means)

    def _elevation(self, position: np.ndarray) -> np.ndarray:
        """Compute heights of the terrain [n] at positions [n, 2]."""
        vector, amplitude, phase = self.waves
        height = np.zeros(len(position))
        for k in range(len(amplitude)):
            height += amplitude[k] * np.sin(
                position[:, 0] * vector[k, 0] + position[:, 1] * vector[k, 1] + phase[k]
            )
        return height

    def _diffuse(self, weight: np.ndarray, low: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Add the random walk: steps to adjacent cells with its variance, as often as needed."""
        share = 0.5 * (self.step_sd / self.cell) ** 2
        repeats = max(1, int(np.ceil(share / 0.25)))
        share /= repeats
        for _ in range(repeats):
            for axis in (0, 1):
                padded = np.pad(weight, [(1, 1) if a == axis else (0, 0) for a in (0, 1)])
                weight = padded + share * (
                    np.roll(padded, 1, axis) + np.roll(padded, -1, axis) - 2.0 * padded
                )
        return weight, low - repeats


def _crop(weight: np.ndarray, low: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Remove outer rows and columns of no weight."""
    used = weight > DROPPED * weight.max()
    (top, bottom), (left, right) = (np.flatnonzero(used.any(a))[[0, -1]] for a in (1, 0))
    kept = np.where(used, weight, 0.0)[top : bottom + 1, left : right + 1]
    return kept, low + np.array([top, left])


def choose_cell(waves: TerrainWaves, measurement_sd: float) -> float:
    """Choose the side of a cell, m: a share of the position error of a measurement on a steep slope.

    Args:
        waves: Waves of the terrain.
        measurement_sd: Standard deviation of the measured height, m.
    """
    square = (waves.amplitude * waves.wave_vector.norm(dim=-1)).square().sum()
    steep = 2.0 * float((0.5 * square).sqrt())
    return CELLS_PER_NOISE * measurement_sd / steep


def measure(words: Sequence[str]) -> dict[str, Any]:
    """Return the root mean square errors of the exact mean in a condition, none if its grid is too large.

    Args:
        words: Overrides of the condition, runs and seed.
    """
    plan = job.build_plan(job.compose([*words, "filter=ekf", f"runs={RUNS}"]))
    episode, model = plan.draw_episode(plan.runs), plan.model
    scene = plan.values["scenario"]
    waves = cast(TerrainAided, model).waves
    cell = choose_cell(waves, scene["measurement_sd"])
    if (2.0 * REACH * scene["initial_sd"] / cell) ** 2 > LARGEST_GRID:
        return {"cell_m": cell, "rmse": [], "cpu_s": 0.0}
    step_sd = scene["drift"] * scene["interval_s"] ** 0.5
    arrays = (waves.wave_vector.numpy(), waves.amplitude.numpy(), waves.phase.numpy())
    method = PointMass(arrays, step_sd, scene["measurement_sd"], scene["initial_sd"], cell)
    start_time, errors = time.process_time(), []
    for r in range(len(plan.runs)):
        position, y = episode.record.u.position[r].numpy(), episode.record.y[r, :, 0].numpy()
        error = method.run(position, y) - episode.truth["position"][r].numpy()
        errors.append(float(f"{np.sqrt((error**2).sum(-1).mean()):.6g}"))
    return {"cell_m": cell, "rmse": errors, "cpu_s": time.process_time() - start_time}


def list_conditions() -> Mapping[str, list[str]]:
    """List the conditions of the studies: name in their reports, and overrides."""
    conditions = {}
    for study in STUDIES:
        content = yaml.safe_load((TOP / "experiments" / f"{study}.yaml").read_text())
        swept = content["hydra"]["sweeper"]["params"]
        (key,) = set(swept) - {"filter"}
        for value in str(swept[key]).split(","):
            name = f"{study} {key.rpartition('.')[2]}={value}"
            conditions[name] = [f"+experiment={study}", f"{key}={value}"]
    return conditions


def main() -> None:
    """Measure the conditions that are not stored."""
    job.register_experiments()
    stored: dict[str, Any] = json.loads(STORE.read_text()) if STORE.exists() else {}
    conditions = list_conditions()
    store = {name: row for name, row in stored.items() if name in conditions}
    for name, words in conditions.items():
        if name not in store:
            store[name] = measure(words)
            print(name, store[name], flush=True)
        STORE.write_text(json.dumps(store, indent=1) + "\n")


if __name__ == "__main__":
    main()
