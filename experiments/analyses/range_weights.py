"""Gate and weights of raw ranges on the walk and in the urban canyon: the table of docs/howto/raw_ranges.md.

`PFBENCH_DATA=... python experiments/analyses/range_weights.py` prints it, in two minutes.

The same runs for all rows of a world. Weights of the walk are the defaults of `user_ins_log`. Those of the canyon, and the
factor on the standard deviations of the receiver, have the highest likelihood at the reference over the first 100 s,
which are not scored.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from pfbench.experiments.urban_error_fit import estimate_normal, range_residuals

from pfbench import job
from pfbench.core import PhiloxStream
from pfbench.files import markdown_head, markdown_row
from pfbench.filter import run_filter
from pfbench.scenario import (
    find_dataset,
    read_drive,
    select_stretch,
)

RUNS = 10
RATIOS = (0.5, 0.7, 0.9, 1.1, 1.4, 2.0)  # of the two standard deviations
SEED = 1
WEIGHTS = "+scenario.receiver.weights._target_=pfbench.scenario.SignalWeights"
# of a range and a range rate of a satellite together; the canyon lacks range rates
GATES = {"walk": "satellite", "canyon": "component"}
WALK = ("scenario=recorded_walk", "scenario.receiver.range_sd=0", "scenario.receiver.rate_sd=0")
WALK_WEIGHTS = (
    WEIGHTS,
    "scenario.tuning.range.floor_sd=1.0",
    "scenario.tuning.range.stated_sd_factor=2.0",
)
CANYON = ("scenario=recorded_canyon", "model=urban_gnss")


class Row(NamedTuple):
    """Result of a filter.

    Attributes:
        world: Name of the world.
        weights: Where the standard deviations come from.
        gate: Whether single satellites are rejected.
        rms: Root mean square of the horizontal error, mean over runs, m.
        worst: Largest horizontal error, mean over runs, m.
        height: Root mean square of the error in height, m.
    """

    world: str
    weights: str
    gate: str
    rms: float
    worst: float
    height: float


def fit_weights(root: str | None) -> tuple[float, float]:
    """Fit standard deviations by elevation and by strength to the first 100 s of the canyon, m.

    Args:
        root: Folder of the data sets.
    """
    data = range_residuals(
        select_stretch(read_drive(find_dataset(root, "berlin_urban_tc")), 0.0, 100.0)
    )
    growth = 1.0 / torch.sin(data.elevation).clamp(min=0.05)
    noise = 10.0 ** (-(data.cn0 - 45.0) / 20.0)
    fits = []
    for ratio in RATIOS:
        shape = torch.hypot(growth, ratio * noise)
        error_law, clock = estimate_normal(data._replace(sd=shape))
        level = torch.from_numpy(np.interp(data.time.numpy(), clock.knots, clock.level))
        e = data.value - level - clock.inter_system * data.glonass
        normal = torch.distributions.Normal(0.0, error_law.factor * shape)
        fits.append((float(normal.log_prob(e).mean()), error_law.factor, ratio * error_law.factor))
    return max(fits)[1:]


def measure(world: str, weights: str, gate: str, words: Sequence[str]) -> Row:
    """Run a filter and measure its errors.

    Args:
        world: Name of the world.
        weights: Where the standard deviations come from.
        gate: Whether single satellites are rejected.
        words: Settings of the command line.
    """
    method = "ekf" if gate == "no" else "gate"
    more = () if gate == "no" else (f"filter.noise_adaptations.0.grouping={GATES[world]}",)
    plan = job.build_plan(
        job.compose([*words, *more, f"filter={method}", f"runs={RUNS}", "episode_cache_dir=null"])
    )
    episode, runs = plan.draw_episode(plan.runs), plan.runs
    result = run_filter(plan.method, plan.model, episode.record, PhiloxStream(SEED, runs))
    error = plan.model.error(result.mean, plan.model.assemble(episode.truth))
    level = list(plan.model.groups["position"])
    places = [plan.model.names.index(f"position_{a}") for a in "EN"] if world == "walk" else level
    up = plan.model.names.index("position_U" if world == "walk" else "height")
    chart = plan.model.names
    offset = error.shape[-1] - len(chart)
    square = error[..., [p + offset for p in places]].square().sum(-1)
    rms = square.nanmean(1).sqrt()
    worst = square.nan_to_num().amax(1).sqrt()
    height = error[..., up + offset].square().nanmean(1).sqrt()
    return Row(
        world,
        weights,
        gate,
        float(rms.mean()),
        float(worst.mean()),
        float(height.mean()),
    )


def main() -> None:
    """Print the table."""
    root = os.environ.get("PFBENCH_DATA")
    a, b = fit_weights(root)
    print(f"canyon: {a:.1f} m / sin(el) and {b:.1f} m at 45 dB-Hz", file=sys.stderr)
    canyon_weights = (
        WEIGHTS, f"+scenario.receiver.weights.elevation_sd={a:.3f}", f"+scenario.receiver.weights.cn0_sd={b:.3f}",
        "model.range_error.factor=1",
    )  # fmt: skip
    rows = [
        measure(world, weights, gate, [*base, *words])
        for world, base, choices in (
            ("walk", WALK, {"receiver": (), "elevation, strength": WALK_WEIGHTS}),
            ("canyon", CANYON, {"receiver": (), "elevation, strength": canyon_weights}),
        )
        for weights, words in choices.items()
        for gate in ("no", "yes")
    ]
    lines = markdown_head(
        "world", "standard deviations", "gate", "horizontal RMS [m]", "largest [m]", "height [m]"
    )
    for k in range(0, len(rows), 2):  # without and with a gate
        pair = rows[k : k + 2]
        numbers = (
            ", ".join(f"{getattr(r, name):.{digits}f}" for r in pair)
            for name, digits in (
                ("rms", 2 if rows[k].world == "walk" else 1),
                ("worst", 1),
                ("height", 1),
            )
        )
        lines.append(markdown_row(rows[k].world, rows[k].weights, "no, yes", *numbers))
    print("\n".join(lines))


if __name__ == "__main__":
    main()
