"""Results of filters that were never run, with known truth about who is better, in the files that a job would write."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtr

from pfbench.results import store
from pfbench.results.store import compute_config_key

STATE: dict[str, Any] = {
    "names": [
        f"{group}_{axis}" for group in ("attitude", "velocity", "position") for axis in "ENU"
    ],
    "units": ["rad"] * 3 + ["m/s"] * 3 + ["m"] * 3,
    "groups": {"attitude": [0, 1, 2], "velocity": [3, 4, 5], "position": [6, 7, 8]},
}
_START = np.array([3e-3, 3e-3, 1e-2, 1.0, 1.0, 1.0, 15.0, 15.0, 20.0])
_FLOOR = np.array([1e-4, 1e-4, 5e-4, 0.05, 0.05, 0.06, 1.5, 1.5, 2.5])


class Method(NamedTuple):
    """A filter whose errors are Gaussian: `size` times the common ones, reported with `honesty` times their size."""

    name: str
    size: float
    honesty: float = 1.0
    particles: int | None = None
    milliseconds: float = 1.0
    lost: tuple[int, ...] = ()


METHODS = (
    Method("ekf", 1.6, 0.7, None, 0.4),
    Method("ukf", 1.15, 0.95, None, 1.7),
    Method("sir", 1.3, 0.8, 200, 4.0, (7,)),
    Method("cofm_amssrcpf", 1.0, 1.0, 200, 9.0),
)
VERSIONS = {
    "pfbench": "0.1.0",
    "commit": "0123abc",
    "python": "3.11.7",
    "torch": "2.13.0",
    "numpy": "2.4.6",
}


def study(
    folder: Path, *, runs: int = 40, steps: int = 120, methods: tuple[Method, ...] = METHODS
) -> Path:
    """Writes one cell with all `methods` and one failed job; returns the folder of the study."""
    for method in methods:
        write(folder, method, runs=runs, steps=steps)
    broken = {"scenario": "flight", "noise": "surge", "filter": "dmc_pf", "model": "ins_gnss"}
    store.write_failure(
        folder / "00000000deadbeef.npz",
        broken,
        FloatingPointError("covariance lost its positive eigenvalues"),
    )
    return folder


def write(
    folder: Path,
    method: Method,
    *,
    noise: str = "surge",
    runs: int = 40,
    steps: int = 120,
    seed: int = 5,
    versions: dict[str, str] = VERSIONS,
    config: dict[str, Any] | None = None,
) -> Path:
    """Writes the result of one filter; the worlds depend on noise and seed alone, so that runs are paired."""
    settings = {
        "filter": {"name": method.name, "particles": method.particles, **(config or {})},
        "noise": {"name": noise},
    }
    name = compute_config_key(
        {
            **settings,
            "noise": noise,
            "seed": seed,
            "runs": runs,
            "steps": steps,
            "versions": versions["commit"],
        }
    )
    arrays = _arrays(method, noise, runs, steps, seed, name)
    meta = {
        "key": name,
        "study": folder.name,
        "choices": {
            "scenario": "flight",
            "noise": noise,
            "filter": method.name,
            "model": "ins_gnss",
        },
        "config": settings,
        "label": method.name,
        "seed": seed,
        "first_run": 0,
        "runs": runs,
        "particles": method.particles,
        "steps": steps,
        "dtype": "float64",
        "device": "cpu",
        "threads": 1,
        "is_exact": method.particles is not None,
        "modelling_choices": ["initial heading error drawn from the filter's own prior"],
        "oracle_noise": False,
        "versions": versions,
        "host": "bench",
        "created": "2026-01-01T00:00:00+00:00",
        "seconds": {
            "world": 1.0,
            "filter": 1e-3 * method.milliseconds * steps,
            "per_step": 1e-3 * method.milliseconds,
            "warm_up": 1e-3,
        },
        "state": STATE,
    }
    return store.write_result(folder / f"{name}.npz", meta, arrays)


def _arrays(
    method: Method, noise: str, runs: int, steps: int, seed: int, name: str
) -> dict[str, np.ndarray]:
    world = np.random.default_rng([seed, *noise.encode()])
    own = np.random.default_rng(int(name, 16))
    time = np.arange(1.0, steps + 1.0)
    scale = _FLOOR + (_START - _FLOOR) * np.exp(-time / 15)[:, None]
    shared, alone = _smooth(world, runs, steps), _smooth(own, runs, steps)
    error = method.size * scale * (0.6 * shared + 0.8 * alone)
    sd = np.broadcast_to(method.honesty * method.size * scale, error.shape).copy()
    nees = np.stack(
        [np.sum((error / sd)[..., index] ** 2, axis=-1) for index in STATE["groups"].values()],
        axis=-1,
    )
    lost = np.isin(np.arange(runs), method.lost)
    for row in np.flatnonzero(lost):
        error[row, steps // 2 :] = sd[row, steps // 2 :] = nees[row, steps // 2 :] = np.nan
    arrays = {
        "time": time,
        "error": error.astype(np.float32),
        "sd": sd.astype(np.float32),
        "nees": nees.astype(np.float32),
        "log_evidence": -100.0 * method.size + own.standard_normal(runs),
        "lost": lost,
        "track": _track(time, runs).astype(np.float32),
    }
    arrays |= _scores(error, sd)
    if method.particles is not None:
        share = np.clip(
            0.45 / method.size + 0.25 * np.sin(time / 3) * own.random((runs, 1)), 0.02, 1
        )
        arrays["ess"] = (method.particles * share).astype(np.float32)
        arrays["resampled"] = share < 0.3
    return arrays


def _scores(error: np.ndarray, sd: np.ndarray, instants: int = 4) -> dict[str, np.ndarray]:
    """Of the normal law of that deviation, but for the energy score, which is that of a law without spread."""
    scored = (np.arange(1, instants + 1) * error.shape[1]) // instants - 1
    error, sd = error[:, scored], sd[:, scored]
    z = error / sd
    crps = sd * (
        z * (2 * ndtr(z) - 1) + 2 * np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi) - 1 / np.sqrt(np.pi)
    )
    energy = np.stack(
        [np.linalg.norm(error[..., index], axis=-1) for index in STATE["groups"].values()], axis=-1
    )
    found = {
        name: value.astype(np.float32)
        for name, value in (("crps", crps), ("pit", ndtr(-z)), ("energy_score", energy))
    }
    return {"score_steps": scored, **found}


def _smooth(rng: np.random.Generator, runs: int, steps: int) -> np.ndarray:
    """Standard normal at each instant, correlated over about five instants [R, T, 9]."""
    values = rng.standard_normal((runs, steps, 9))
    for t in range(1, steps):
        values[:, t] = 0.8 * values[:, t - 1] + 0.6 * values[:, t]
    return values


def _track(time: np.ndarray, runs: int) -> np.ndarray:
    east, north = 400 * np.sin(time / 25), 12 * time
    up = 50 + 40 * (1 - np.cos(time / 40))
    return np.broadcast_to(np.stack([east, north, up], axis=-1), (runs, time.size, 3))


def list_results(folder: str | Path) -> Iterator[store.JobResult]:
    """Read all finished jobs of a folder, sorted by scenario, noise, label, seed and key.

    Arrays are read one job at a time.
    """
    paths = sorted(Path(folder).glob("*.npz"), key=_rank)
    return map(store.read_result, paths)


def _rank(path: Path) -> tuple[str, str, str, int, str]:
    meta = store.read_metadata(path)
    choices = meta["choices"]
    names = str(choices["scenario"]), str(choices["noise"]), str(meta["label"])
    return *names, int(meta["seed"]), str(meta["key"])
