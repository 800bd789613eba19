"""What is left of a measurement at the truth has the law that the model states, in every scene, discovered in conf/scenario.

Measurement less what the model expects at the true state, in the standard deviations of the model's own law: mean 0, variance 1,
no correlation from one instant to the next, and none between components of an instant. A few short runs of each scene, with draws
of its own; the bands hold for all numbers together.
"""

import zlib
from typing import Any

import pytest
import torch
from config_cases import GROUPS, RECORDED, list_bases
from omegaconf import DictConfig, open_dict
from recorded_data import DATA
from scipy import stats
from torch import Tensor

from pfbench import job
from pfbench.job import datasheet_data
from pfbench.job.config import compose_tree
from pfbench.noise.base import NominalNoise
from pfbench.results import status
from pfbench.results.paper_block import read_part

SCENES = GROUPS["scenario"]
RUNS = torch.arange(20)
FALSE_ALARM = 1e-3  # of all numbers of all scenes together
NUMBERS = (
    24 * (24 + 5) / 2 * len(SCENES)
)  # at most: a mean, a variance and a lag of 24 components, and their pairs
REACH = float(stats.norm.isf(FALSE_ALARM / NUMBERS / 2))  # standard errors

# Real instruments: a truth beside the measurements is not known, or their errors are not those of any law that a model states.
# `datasheet_data.compute_residuals` knows what hangs on a state without truth, and says NaN.
NO_LAW = {
    "recorded_fixed_wing": "the fixes that are handed out are the only truth there is, and it is withheld ones that are truth here",
    "recorded_fixed_wing_aided": "the same flight; barometer and magnetometer hang on biases that nobody knows",
    "recorded_walk": "ranges hang on the receiver's clock, which nobody knows; their errors are reflections, which last for seconds",
    "recorded_berlin": "ranges hang on the receiver's clock; many are reflections, hundreds of metres long and the same for seconds",
    "recorded_canyon": "the same drive",
    "user_log": "it is the user's",
    "user_log_aligned": "it is the user's",
    "user_raw_log": "it is the user's",
    "user_ins_log": "it is the user's",
}

FIXES_ALONE = {
    "recorded_car_constrained": 3
}  # constraints of a car are wider than their errors, which are correlated


def shortened(scene: DictConfig) -> DictConfig:
    """Two minutes of it with a turn where it is simulated; the IMU is read less often, which changes nothing at the truth."""
    path, drive = scene.get("trajectory", {}), scene.get("flight", scene)
    with open_dict(scene):
        if "start_s" in drive and "end_s" in drive:
            drive.end_s = drive.start_s + 60.0
        if "imu_rate_hz" in scene:
            scene.imu_rate_hz = max(10.0, 2.0 / scene.filter_interval_s)
        if "flights" in scene:
            scene.flights = scene.flights[:2]
        if "segments" in path:
            path.segments = path.segments[:3]
        elif "duration_s" in path:
            path.duration_s = 120.0
        elif "end_s" in path:
            path.end_s = (path.get("start_s") or 1.0) + 60.0
    return scene


def at_the_truth(scenario: str) -> Tensor:
    """Residuals [R, T, Dy] in the standard deviations that the model states."""
    cfg: Any = compose_tree([f"scenario={scenario}", "episode_cache_dir=null"])
    model, scene = job.instantiate(cfg.model), job.instantiate(shortened(cfg.scenario))
    with torch.no_grad():
        episode = scene.draw(
            NominalNoise(), RUNS, zlib.crc32(scenario.encode())
        )  # else all scenes would share their draws
        return datasheet_data.compute_residuals(model, model.assemble(episode.truth), episode)


def out_of_law(z: Tensor) -> list[str]:
    """What is not as it should be of components [R, T, K] taken together, NaN where nothing was measured."""
    law, wider = status.compute_whiteness(z.numpy()), REACH / float(stats.norm.isf(0.025))
    off = {
        "mean": (law.mean, law.mean_band),
        "variance": (law.variance - 1, law.variance_band),
        "lag": (law.lag, law.lag_band),
    }
    bands = {name: (value, wider * band) for name, (value, band) in off.items()}
    return [
        f"{name} off by {value:.3f}, band {band:.3f}"
        for name, (value, band) in bands.items()
        if not abs(value) < band
    ]


def entangled(z: Tensor) -> list[str]:
    """Components of z [R, T, K] that go together."""
    known = (~torch.isnan(z)).flatten(0, 1).double()
    z = z.nan_to_num(0.0).flatten(0, 1)
    apart = (z.mT @ z / (known.mT @ known).sqrt()).triu(
        1
    )  # standard errors, where both were measured
    pairs = (apart.abs() > REACH).nonzero().tolist()
    return [f"components {i} and {j}: {float(apart[i, j]):.1f} standard errors" for i, j in pairs]


def test_scenes_without_a_law_are_recorded_ones() -> None:
    for scenario in NO_LAW:
        assert scenario in RECORDED


@pytest.mark.parametrize(
    "scenario",
    [
        pytest.param(name, marks=[pytest.mark.slow] if list_bases("scenario", name) else [])
        for name in SCENES
        if not name.startswith("user_")
    ],
)
def test_residuals_at_the_truth_have_the_stated_law(scenario: str) -> None:
    text = read_part("scenario", scenario)
    if "${data.root}" in text and DATA is None:
        pytest.skip("PFBENCH_DATA does not name the folder of the recorded data sets")
    z = at_the_truth(scenario)[..., : FIXES_ALONE.get(scenario)]
    if scenario in NO_LAW:
        assert torch.isnan(z).all(), (
            "a truth is known after all: say here what law residuals should have"
        )
        return
    seen = [
        k for k in range(z.shape[-1]) if not torch.isnan(z[..., k]).all()
    ]  # a satellite may not rise in a minute
    assert len(seen) > z.shape[-1] / 2
    told = {f"component {k}": out_of_law(z[..., k : k + 1]) for k in seen} | {
        "all together": out_of_law(z)
    }
    assert not {name: found for name, found in told.items() if found}
    assert not entangled(z)
