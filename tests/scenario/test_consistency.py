"""Over 100 runs, errors are as large as the filter of each simulated scene says, or a named variant shows what it takes.

Two statistics of every group of states: the normalised error squared at the end of the run, whose sum over runs is chi-square for
a consistent filter, and its mean over the run, whose spread over runs gives the standard error. Bands are Bonferroni's: together
they are left by chance once in a hundred times.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy import stats

from pfbench import job
from pfbench.core.random_stream import PhiloxStream
from pfbench.filter.loop import run_filter
from pfbench.job.config import compose_tree
from pfbench.job.scoring import ScoreRecorder
from pfbench.noise.base import NominalNoise

RUNS = 100
FALSE_ALARM = 1e-2

# Words beside each scene. The IMU is read less often than in the scenes, which is cheap and changes no law.
CONSISTENT: dict[str, tuple[str, ...]] = {
    "flight_300s_closed_loop": ("scenario.imu_rate_hz=10",),
    "gps_ins_markov": ("scenario.imu_rate_hz=10",),
    "azimuth_small": ("scenario.imu_rate_hz=10",),
    "anshun_nl_small": ("scenario.imu_rate_hz=10", "scenario.trajectory.duration_s=100"),
    "passive_1_random": (),
    "passive_3_random": (),
}
TESTS = 2 * 6 * len(CONSISTENT)  # two statistics of at most six groups


class Consistency(NamedTuple):
    """Of one group: mean over runs of the normalised error squared over its degrees of freedom, 1 where all is well.

    Attributes:
        mean: over the run; se: its standard error.
        end: at the end.
        dof: degrees of freedom.
    """

    mean: float
    se: float
    end: float
    dof: int


def measured(scenario: str, *words: str, seed: int = 21) -> dict[str, Consistency]:
    """The scene's own model and the extended Kalman filter, which is the Kalman filter where all is linear."""
    cfg: Any = compose_tree(
        [f"scenario={scenario}", "filter=ekf", "episode_cache_dir=null", *words]
    )
    model, runs = job.instantiate(cfg.model), torch.arange(RUNS)
    with torch.no_grad():
        episode = job.instantiate(cfg.scenario).draw(NominalNoise(), runs, seed)
        watch = ScoreRecorder(model, model.assemble(episode.truth))
        estimate = run_filter(
            job.instantiate(cfg["filter"]), model, episode.record, PhiloxStream(seed, runs), watch
        )
    assert not estimate.lost.any()
    nees: NDArray[np.float64] = estimate.trace["nees"].numpy()
    found = {}
    for (name, parts), group in zip(model.groups.items(), np.moveaxis(nees, -1, 0), strict=True):
        each = group.mean(1) / len(parts)
        end = float(group[:, -1].mean() / len(parts))
        found[name] = Consistency(
            float(each.mean()), float(each.std(ddof=1) / RUNS**0.5), end, len(parts)
        )
    return found


def outside(found: dict[str, Consistency]) -> dict[str, str]:
    """Groups outside their bands."""
    level, told = FALSE_ALARM / TESTS / 2, {}
    for name, group in found.items():
        reach = float(stats.t.isf(level, RUNS - 1))
        low, high = stats.chi2.ppf([level, 1 - level], RUNS * group.dof) / (RUNS * group.dof)
        if abs(group.mean - 1.0) > reach * group.se:
            told[name] = f"{group.mean:.3f} +- {group.se:.3f} over the run"
        if not low < group.end < high:
            told[name] = f"{group.end:.3f} at the end, band {low:.3f} to {high:.3f}"
    return told


@pytest.mark.slow
@pytest.mark.parametrize("scenario", CONSISTENT)
def test_the_filter_is_consistent_over_a_hundred_runs(scenario: str) -> None:
    assert outside(measured(scenario, *CONSISTENT[scenario])) == {}
