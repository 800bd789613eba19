"""Are inferred noise levels calibrated? Ranks of true ones among their draws, for PMMH and SVI on a toy and on passive location.

    python -m pfbench.experiments.learn_noise_calibration [data sets [effort [world]]]

Each algorithm is tried a second time with a likelihood that is wrong on purpose, which the ranks must show: a measurement noise
that is half as large again as the numbers say. Effort multiplies draws and steps. What is done is kept in the folder, and the
same command goes on from there; `world` is the beginning of the names of the cases, `toy` or `location`.
"""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from pyro.distributions import LogNormal

from pfbench.core import Record
from pfbench.filter import GaussianFilter, ParticleFilter, TaylorLinearisation
from pfbench.model import (
    PassiveLocation,
    PlatformInputs,
    StateSpaceModel,
    compute_level_attitude,
    local_level,
)
from pfbench.ppl import (
    FilterLikelihood,
    GaussianHmmLikelihood,
    ParameterisedModel,
    ParameterPosterior,
    PmmhSettings,
    SbcRanks,
    normal_guide,
    pmmh,
    program,
    sbc_histograms,
    simulation_based_calibration,
    svi,
)
from pfbench.report import render_palette_png

WRONG = 1.5
BINS = 10
LEVELS = {"level_sd": LogNormal(0.0, 0.7), "measurement_sd": LogNormal(0.0, 0.7)}
SIGHTS = {"angle_sd": LogNormal(math.log(3e-3), 0.5)}  # rad; of bearing and elevation


def level(level_sd: Any, measurement_sd: Any, wrong: float = 1.0) -> StateSpaceModel:
    return local_level(level_sd, wrong * measurement_sd, 0.0, 2.0)


def location(angle_sd: Any, wrong: float = 1.0) -> StateSpaceModel:
    """An emitter 226 km away, known to 5 km per axis, heard every 10 s."""
    sd = [wrong * angle_sd, wrong * angle_sd, 1e-4, 1e-4, 1.0]
    return PassiveLocation(10.0, 0.1, sd, (160e3, 160e3, -15.0, 15.0), (5e3, 5e3, 10.0, 10.0))


def flight(runs: int, steps: int) -> Record:
    """An aircraft at 200 m/s in level flight."""
    t = 10.0 * torch.arange(1, steps + 1, dtype=torch.float64)
    velocity = torch.tensor([200.0, 0.0, 0.0], dtype=torch.float64)
    place = torch.tensor([0.0, 0.0, 2000.0], dtype=torch.float64) + t[:, None] * velocity
    attitude = compute_level_attitude(velocity).expand(1, steps, 3, 3)
    carrier = torch.full((1, steps), 1e10, dtype=torch.float64)
    platform = PlatformInputs(place[None], velocity.expand(1, steps, 3), attitude, carrier)
    return Record(torch.zeros(runs, steps, 5, dtype=torch.float64), platform)


def by_pmmh(
    unknown: ParameterisedModel, particles: int, draws: int, warmup: int
) -> Callable[[Record], ParameterPosterior]:
    return lambda record: pmmh(
        unknown,
        ParticleFilter(particles),
        record,
        draws,
        warmup,
        chains=1,
        seed=3,
        settings=PmmhSettings(separate_parameters=True),
    )


def by_svi(
    unknown: ParameterisedModel, likelihood: Any, steps: int
) -> Callable[[Record], ParameterPosterior]:
    def infer(record: Record) -> ParameterPosterior:
        guide = normal_guide(unknown, separate_parameters=True)
        return svi(
            program(unknown, likelihood, separate_parameters=True),
            record,
            guide,
            steps,
            100,
            rate=0.1,
            seed=3,
        ).posterior

    return infer


def studies(
    runs: int, effort: int = 1
) -> dict[str, tuple[ParameterisedModel, Record, Callable[[Record], ParameterPosterior]]]:
    """The eight cases: world, shape of its records, algorithm."""
    found = {}
    for name, wrong in (("", 1.0), (", wrong", WRONG)):
        toy, believed = (
            ParameterisedModel(level, LEVELS),
            ParameterisedModel(lambda wrong=wrong, **values: level(**values, wrong=wrong), LEVELS),
        )
        shape = Record(torch.zeros(runs, 8, 1, dtype=torch.float64))
        found[f"toy, PMMH{name}"] = toy, shape, by_pmmh(believed, 100, 120 * effort, 60 * effort)
        found[f"toy, SVI{name}"] = (
            toy,
            shape,
            by_svi(believed, GaussianHmmLikelihood(), 150 * effort),
        )
        far, believed = (
            ParameterisedModel(location, SIGHTS),
            ParameterisedModel(
                lambda wrong=wrong, **values: location(**values, wrong=wrong), SIGHTS
            ),
        )
        shape = flight(runs, 6)
        found[f"location, PMMH{name}"] = (
            far,
            shape,
            by_pmmh(believed, 1000, 120 * effort, 60 * effort),
        )
        found[f"location, SVI{name}"] = (
            far,
            shape,
            by_svi(believed, FilterLikelihood(GaussianFilter(TaylorLinearisation())), 80 * effort),
        )
    return found


def main(folder: Path, runs: int = 200, effort: int = 2, only: str = "") -> None:
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    path, asked = folder / "learn_noise_calibration.json", {"runs": runs, "effort": effort}
    told: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    if {name: told.get(name) for name in asked} != asked:  # of another call: from the beginning
        told = dict(asked)
    drawn: dict[str, dict[str, SbcRanks]] = {}
    for name, (unknown, shape, infer) in studies(runs, effort).items():
        if not name.startswith(only):
            continue
        if name not in told:
            began = time.process_time()
            found = simulation_based_calibration(unknown, shape, infer, draws=19, seed=7)
            told[name] = {part: told_of(found, part) for part in unknown.names} | {
                "seconds": time.process_time() - began
            }
            path.write_text(json.dumps(told))
        parts = {part: told[name][part] for part in unknown.names}
        world, label = name.split(", ", 1)
        drawn.setdefault(world, {})[label] = SbcRanks(
            {part: torch.tensor(kept["ranks"]) for part, kept in parts.items()}, 19
        )
        values = {part: (f"{kept['p']:.2g}", kept["counts"]) for part, kept in parts.items()}
        print(name, values, f"{told[name]['seconds']:.0f} s", flush=True)
    (folder / "table.md").write_text("\n".join(table(told)) + "\n")
    for world, ranks in drawn.items():
        (folder / f"calibration_{world}.png").write_bytes(render_palette_png(sbc_histograms(ranks)))


def table(told: Mapping[str, Any]) -> list[str]:
    """Lines of a table in Markdown: a row for each case that is done and each of its numbers."""
    lines = [
        "| case | number | data sets in each tenth of the ranks | p | s of the processor |",
        "|" + " --- |" * 5,
    ]
    for name, case in told.items():
        parts = (
            {part: kept for part, kept in case.items() if part != "seconds"}
            if isinstance(case, dict)
            else {}
        )
        for part, kept in parts.items():
            counts = " ".join(map(str, kept["counts"]))
            lines.append(
                f"| {name} | {part} | {counts} | {kept['p']:.2g} | {case['seconds']:.0f} |"
            )
    return lines


def told_of(ranks: SbcRanks, part: str) -> dict[str, Any]:
    return {
        "p": ranks.p_value(part, BINS), "counts": ranks.counts(part, BINS).tolist(), "ranks": ranks.ranks[part].tolist()
    }  # fmt: skip


if __name__ == "__main__":
    folder = Path(os.environ.get("PFBENCH_RESULTS", "results")) / "learn_noise_calibration"
    main(folder, *map(int, sys.argv[1:3]), *sys.argv[3:])
