"""Figure 1 of Tian et al. and their chaotic map, computed by pfbench: `python docs/methods/escape_factor.py`."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch

from pfbench.filter import InertiaVelocity
from pfbench.filter.proposed import swarm_motion

MOST = 150  # iterations, as in their figure
BLUE, ORANGE = "#0072B2", "#D55E00"


def main() -> None:
    """The escape factor over the iterations, two chaotic sequences, and the distribution of many."""
    figure, (factor, orbit, histogram) = plt.subplots(1, 3, figsize=(12, 3.4), layout="constrained")
    k = np.arange(MOST + 1)
    intended = [InertiaVelocity(escape_coefficient=0.12).compute_escape_factor(i / MOST) for i in k]
    factor.plot(
        k,
        0.12 - 0.12 * np.cos(k * np.pi) / MOST,
        color=ORANGE,
        ls="--",
        label="as printed [eq. 35]",
    )
    factor.plot(k, intended, color=BLUE, label="as intended: rises as in their figure")
    factor.set(title="escape factor c3 = c4", xlabel="iteration", ylabel="c3", ylim=(0, 0.26))
    factor.legend(fontsize=8, loc="upper left")

    z = torch.tensor([0.3, 0.3 + 1e-6], dtype=torch.float64)
    sequence = [z]
    for _ in range(40):
        sequence.append(swarm_motion.logistic_map(sequence[-1], z))
    both = torch.stack(sequence)
    orbit.plot(both[:, 0], color=BLUE, marker="o", ms=3, label="from 0.3")
    orbit.plot(both[:, 1], color=ORANGE, ls="--", marker="s", ms=3, label="from 0.3 + 1e-6")
    orbit.set(title="z' = 4 z (1 - z) [eq. 31]", xlabel="iteration", ylabel="z")
    orbit.legend(fontsize=8, loc="lower left")

    generator = torch.Generator().manual_seed(1)
    values = swarm_motion.iterate_logistic(
        torch.rand(200_000, dtype=torch.float64, generator=generator)
    )
    histogram.hist(
        values.numpy(), bins=50, range=(0, 1), density=True, color="0.75", label="200 000 sequences"
    )
    at = np.linspace(0.004, 0.996, 400)
    histogram.plot(
        at, 1 / (np.pi * np.sqrt(at * (1 - at))), color=BLUE, label="arcsine distribution"
    )
    histogram.set(title="distribution after 50 iterations", xlabel="z", ylabel="density")
    histogram.legend(fontsize=8, loc="upper center")
    figure.savefig(Path(__file__).with_name("escape_factor.png"), dpi=80)


if __name__ == "__main__":
    main()
