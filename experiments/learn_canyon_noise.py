"""The law of pseudoranges in a Berlin canyon, learned on one stretch of the drive and scored on the other, both ways round.

    PFBENCH_DATA=... python -m pfbench.experiments.learn_canyon_noise [draws]

Learned is the mixture of `SightOrTail`: share of lines of sight at 40 dB-Hz, its slope, the error's sd, the detour's mean. It is
learned at the reference's positions, so that the state is the receiver's clock alone, which a particle filter carries along:
with the position unknown too, estimates of the log likelihood scatter by a hundred between draws of 2000 particles, and no
chain moves. One epoch in two seconds is taken for the posterior, since a reflection lasts. Beside it stands the law of highest
likelihood, with the clock as straight lines between knots (`pfbench.scenario.urban_law`); with 0 draws it stands alone. Scored
are the log evidence of a range on the other stretch, and the error of a particle filter that has no reference there.
"""

from __future__ import annotations

import json
import math
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra import compose, initialize_config_module
from pyro.distributions import Independent, LogNormal, Normal
from scipy.stats import wilcoxon
from torch import Tensor, nn

from pfbench.draws import MonteCarlo
from pfbench.filter.loop import run_filter
from pfbench.filter.particle import ParticleFilter
from pfbench.job import build
from pfbench.model.base import StateSpaceModel
from pfbench.model.urban_gnss import CN0_REFERENCE, RangeLaw, SightOrTail, Sky, TailedNormal, UrbanGnss, range_change
from pfbench.noise.regimes import Nominal
from pfbench.ppl.pmmh import pmmh, tiled
from pfbench.ppl.posterior import Posterior, picture
from pfbench.ppl.program import Unknown
from pfbench.record import Record
from pfbench.scenario.recorded import locate
from pfbench.scenario.recorded_urban import UrbanDrive, read_drive
from pfbench.scenario.recorded_urban import stretch as cut
from pfbench.scenario.urban_law import estimate_mixture, estimate_normal, residuals

STRETCHES = {"first": (0.0, 100.0), "second": (100.0, 283.0)}  # s
PRIOR = {
    "odds": Normal(0.0, 2.0),  # logit of the share
    "sd": LogNormal(math.log(4.0), 0.7),  # m
    "tail": LogNormal(math.log(30.0), 0.7),  # m
    "slope": Normal(0.0, 0.5),  # per dB-Hz
}
STILL = 1e-6  # of what the reference knows


class Learned(nn.Module):
    """`SightOrTail` with its numbers in buffers, so that every chain has its own."""

    odds: Tensor
    sd: Tensor
    tail: Tensor
    slope: Tensor

    def __init__(self, odds: Any, sd: Any, tail: Any, slope: Any) -> None:
        super().__init__()
        for name, value in (("odds", odds), ("sd", sd), ("tail", tail), ("slope", slope)):
            self.register_buffer(name, torch.as_tensor(value, dtype=torch.float64))

    def forward(self, mean: Tensor, u: Sky) -> Independent:
        odds = self.odds + self.slope * (u.cn0 - CN0_REFERENCE)
        return Independent(TailedNormal(mean, odds.unsqueeze(1), self.sd, self.tail), 1)


def drive(stretch: str, interval: float = 1.0) -> UrbanDrive:
    start, end = STRETCHES[stretch]
    places = [f"scenario.start={start}", f"scenario.end={end}", f"scenario.receiver.interval={interval}"]
    with initialize_config_module("pfbench.conf", version_base="1.3"):
        cfg = compose("config", ["scenario=berlin", *places])
    scenario: UrbanDrive = build(cfg.scenario)
    return scenario


def at_reference(scenario: UrbanDrive) -> tuple[Record, Any]:
    """The epochs with ranges, less what the way of the reference makes of them: a receiver that stands, and what is believed."""
    world = scenario.draw(Nominal(), torch.arange(1), 1)
    way = torch.cat([world.truth["position"], world.truth["height"]], -1)[0]
    u: Sky = world.record.u
    y = world.record.y[0] - range_change(way.unsqueeze(1), u.line[0], u.reach[0])[:, 0]
    seen = ~torch.isnan(y).all(-1)
    span = torch.diff(world.time[seen], prepend=world.time[seen][:1] - 1.0)
    parts = u._replace(duration=span[None], speed=0.0 * span[None], yaw_rate=0.0 * span[None])
    kept = (a if a.shape[1] == len(span) else a[:, seen] for a in parts)
    known = replace(
        scenario.believed, distance_density=STILL, heading_density=STILL, height_density=STILL, scale_density=STILL,
        yaw_bias_density=STILL, initial_position_sd=[STILL] * 3, initial_heading_sd_deg=STILL, initial_scale_sd=STILL,
        initial_yaw_bias_sd=STILL, initial_clock_sd=5.0,
    )  # fmt: skip
    return Record(y[seen].unsqueeze(0), Sky(*kept), torch.zeros(1, 9, dtype=torch.float64)), known


def learn(stretch: str, draws: int, warmup: int, chains: int = 8) -> Posterior:
    record, known = at_reference(drive(stretch, 2.0))

    def make(**values: Tensor) -> StateSpaceModel:
        return UrbanGnss(known, Learned(**values))

    return pmmh(Unknown(make, PRIOR), ParticleFilter(300), record, draws, warmup, chains=chains, seed=4)


def evidence(law: RangeLaw, stretch: str) -> tuple[float, float]:
    """log evidence for each range of a stretch, at the reference: mean and sd of 4 filters with 1500 particles."""
    record, known = at_reference(drive(stretch))
    again = tiled(record, 4)
    with torch.no_grad():
        estimate = run_filter(ParticleFilter(1500), UrbanGnss(known, law), again, MonteCarlo(6, torch.arange(4)))
    each = estimate.log_evidence / (~torch.isnan(record.y)).sum()
    return float(each.mean()), float(each.std())


def most_likely(stretch: str) -> tuple[RangeLaw, RangeLaw]:
    """The normal law and the mixture of highest likelihood at the reference, all epochs of a stretch."""
    scenario = drive(stretch)
    data = residuals(cut(read_drive(locate(scenario.root, scenario.folder)), *STRETCHES[stretch]))
    return estimate_normal(data)[0], estimate_mixture(data)[0]


def positions(law: RangeLaw, stretch: str, runs: int = 8, particles: int = 1500) -> np.ndarray:
    """Horizontal rms errors of a particle filter without reference, m [runs]; runs differ in start and draws."""
    scenario, numbers = drive(stretch), torch.arange(runs)
    world = scenario.draw(Nominal(), numbers, 3)
    with torch.no_grad():
        filtered = run_filter(ParticleFilter(particles), UrbanGnss(scenario.believed, law), world.record, MonteCarlo(8, numbers))
    error = filtered.mean[..., :2] - world.truth["position"]
    rms: np.ndarray = error.square().sum(-1).mean(1).sqrt().numpy()
    return rms


def law_of(posterior: Posterior) -> SightOrTail:
    mean = {name: float(posterior.flat(name).mean()) for name in PRIOR}
    return SightOrTail(1.0 / (1.0 + math.exp(-mean["odds"])), mean["sd"], mean["tail"], mean["slope"])


def main(folder: Path, draws: int = 100) -> None:
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    told: dict[str, Any] = {}
    posteriors: dict[str, Posterior] = {}
    laws: dict[str, RangeLaw] = {}
    for stretch in STRETCHES:
        laws[f"normal, {stretch}"], laws[f"mixture, {stretch}"] = most_likely(stretch)
        print(laws[f"normal, {stretch}"], laws[f"mixture, {stretch}"], flush=True)
        if not draws:
            continue
        posteriors[stretch] = learn(stretch, draws, max(100, draws))  # chains that are to meet need as long to get there
        told[f"posterior, {stretch}"] = posteriors[stretch].table().to_dict("index")
        print(stretch, posteriors[stretch].table().to_string(), posteriors[stretch].accepted, sep="\n", flush=True)
        laws[f"posterior, {stretch}"] = law_of(posteriors[stretch])
        (folder / "learn_canyon_noise.json").write_text(json.dumps(told, indent=1))
    if posteriors:
        picture(posteriors, PRIOR).savefig(folder / "learn_canyon_noise.svg")
    told["laws"] = {name: str(law) for name, law in laws.items()}
    for stretch in STRETCHES:
        for name, law in laws.items():
            told[f"evidence: {name}, on the {stretch}"] = mean, sd = evidence(law, stretch)
            print(name, "on", stretch, f"{mean:.4f} +- {sd:.4f} a range", flush=True)
        (folder / "learn_canyon_noise.json").write_text(json.dumps(told, indent=1))
    for stretch, other in zip(STRETCHES, reversed(STRETCHES), strict=True):
        found = {name: positions(law, stretch) for name, law in laws.items() if name.endswith(other)}
        usual = found.pop(f"normal, {other}")
        for name, rms in found.items():
            row = {
                "normal": float(np.median(usual)), "rms": float(np.median(rms)), "less": float(np.median(usual - rms)),
                "p": float(wilcoxon(usual - rms, zero_method="zsplit").pvalue),
            }  # fmt: skip
            told[f"position: {name}, on the {stretch}"] = row
            print(name, "on", stretch, {key: float(f"{value:.4g}") for key, value in row.items()}, flush=True)
        (folder / "learn_canyon_noise.json").write_text(json.dumps(told, indent=1))


if __name__ == "__main__":
    main(Path(os.environ.get("PFBENCH_RESULTS", "results")) / "learn_canyon_noise", *map(int, sys.argv[1:]))
