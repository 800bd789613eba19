"""Noise of a quadrotor's IMU, learned on five flights through the EKF's likelihood, and tried on the fifteen others.

    PFBENCH_DATA=... python -m pfbench.experiments.learn_quad_noise

The receiver's errors are known (they are added to the record); what is unknown is what the IMU's errors amount to under the
vibration of the rotors: root densities of gyro and accelerometer and the walks of their biases. Three sets of numbers are
compared on flights from which nothing was learned: the data sheet's, those of the scene's yaml, which were set by hand, and the
posterior's medians. Learning takes steps of 1 s, whose evidence is that of 0.2 s to 0.03 in 985; trying takes 0.2 s.
"""

from __future__ import annotations

import json
import math
import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from hydra import compose, initialize_config_module
from pyro.distributions import LogNormal
from scipy.stats import bootstrap, wilcoxon

from pfbench.draws import MonteCarlo
from pfbench.filter.gaussian import GaussianFilter
from pfbench.filter.loop import run_filter
from pfbench.filter.rules import Cubature, Jacobian, Points
from pfbench.job import build
from pfbench.model.strapdown_total import Believed, StrapdownTotal
from pfbench.noise.regimes import Nominal
from pfbench.ppl.pmmh import pmmh
from pfbench.ppl.posterior import picture
from pfbench.ppl.program import Unknown
from pfbench.scenario.recorded import RecordedFlights

LEARNED_ON, TRIED_ON = (1, 2, 3, 4, 5), tuple(range(6, 21))
# of the maker's chip in this class (MTi-1): 0.007 deg/s/sqrt(Hz), 120 ug/sqrt(Hz); of bias walks it says nothing
SHEET = {
    "gyro_density": math.radians(0.007),
    "accelerometer_density": 120e-6 * 9.81,
}
PRIOR = {  # two orders of magnitude either way
    "gyro_density": LogNormal(math.log(3e-3), 2.0),
    "accelerometer_density": LogNormal(math.log(3e-2), 2.0),
    "gyro_bias_walk": LogNormal(math.log(1e-4), 1.5),
    "accelerometer_bias_walk": LogNormal(math.log(1e-3), 1.5),
}
AGAIN = 3  # times that each flight is flown with new errors of receiver and start


def scene(flights: tuple[int, ...], step: float) -> RecordedFlights:
    with initialize_config_module("pfbench.conf", version_base="1.3"):
        cfg = compose("config", ["scenario=quad_flights", f"scenario.step={step}", f"scenario.paths={list(flights)}"])
    scenario: RecordedFlights = build(cfg.scenario)
    return scenario


def learned(draws: int, warmup: int, step: float):
    """The posterior, by Metropolis-Hastings on the likelihood of an EKF."""
    flights = scene(LEARNED_ON, step)
    record = flights.draw(Nominal(), torch.arange(len(LEARNED_ON)), 1).record
    unknown = Unknown(lambda **values: StrapdownTotal(replace(flights.believed, **values)), PRIOR)
    return pmmh(unknown, GaussianFilter(Jacobian()), record, draws, warmup, chains=10, seed=2)


def tried(believed: Believed) -> dict[str, np.ndarray]:
    """Per flight: rms errors, log evidence for each fix and share of positions in their 90 % intervals, by filter."""
    flights, runs = scene(TRIED_ON, 0.2), torch.arange(AGAIN * len(TRIED_ON))
    world, model = flights.draw(Nominal(), runs, 11), StrapdownTotal(believed)
    methods = {"ekf": GaussianFilter(Jacobian()), "ckf": GaussianFilter(Points(Cubature()))}
    fixes = (~torch.isnan(world.record.y[..., 0])).sum(1)
    found = {}
    for name, method in methods.items():
        with torch.no_grad():
            estimate = run_filter(method, model, world.record, MonteCarlo(5, runs))
        error = model.error(estimate.mean, model.assemble(world.truth))
        inside = (error[..., 6:9].abs() < 1.645 * estimate.variance[..., 6:9].sqrt()).double()
        known = ~torch.isnan(error[..., 6])
        parts = {
            "position": _rms(error[..., 6:9], known), "tilt": _rms(error[..., :2], known), "yaw": _rms(error[..., 2:3], known),
            "evidence": estimate.log_evidence / fixes, "inside": (inside.mean(-1) * known).sum(1) / known.sum(1),
        }  # fmt: skip
        # runs of one flight are no independent cases: a flight counts once
        found |= {f"{name} {part}": value.view(AGAIN, -1).mean(0).numpy() for part, value in parts.items()}
    return found


def _rms(error: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
    return torch.sqrt((error.square().sum(-1).nan_to_num() * known).sum(1) / known.sum(1))


def compared(a: np.ndarray, b: np.ndarray) -> dict[str, float]:
    """Medians over flights of a and b, the interval of the median of their difference, and Wilcoxon's p."""
    d = a - b
    interval = bootstrap((d,), np.median, rng=np.random.default_rng(0), n_resamples=4000, method="percentile").confidence_interval
    return {
        "a": float(np.median(a)), "b": float(np.median(b)), "difference": float(np.median(d)),
        "low": float(interval.low), "high": float(interval.high), "p": float(wilcoxon(d, zero_method="zsplit").pvalue),
    }  # fmt: skip


def main(folder: Path, draws: int = 150, warmup: int = 100, step: float = 1.0) -> None:
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    posterior = learned(draws, warmup, step)
    table = posterior.table()
    print(table.to_string(), flush=True)
    picture({"EKF likelihood": posterior}, PRIOR).savefig(folder / "learn_quad_noise.svg")
    middle = {name: float(posterior.flat(name).median()) for name in PRIOR}
    told = {"posterior": table.to_dict("index"), "accepted": posterior.accepted.tolist(), "verdicts": tell(middle)}
    (folder / "learn_quad_noise.json").write_text(json.dumps(told, indent=1))


def tell(values: dict[str, float]) -> dict[str, dict[str, float]]:
    """What filters make of the flights that nothing was learned on, with these numbers and with the others'."""
    by_hand = scene(TRIED_ON, 0.2).believed
    sets = {"sheet": replace(by_hand, **SHEET), "hand": by_hand, "learned": replace(by_hand, **values)}
    found = {}
    for name, believed in sets.items():
        found[name] = tried(believed)
        print(name, {part: round(float(np.median(value)), 4) for part, value in found[name].items()}, flush=True)
    verdicts = {
        f"{part}: learned - {other}": compared(found["learned"][part], found[other][part])
        for part in found["learned"] for other in ("sheet", "hand")
    }  # fmt: skip
    for name, verdict in verdicts.items():
        print(name, {key: float(f"{value:.3g}") for key, value in verdict.items()}, flush=True)
    return verdicts


if __name__ == "__main__":
    main(Path(os.environ.get("PFBENCH_RESULTS", "results")) / "learn_quad_noise", *map(int, sys.argv[1:]))
