"""Configurations are composed from Python, in any thread, without a trace in Hydra's global state."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any, cast

import composed_once
import pytest
from hydra import initialize_config_dir
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.global_hydra import GlobalHydra
from hydra.types import RunMode
from omegaconf import OmegaConf

from pfbench import job


def test_threads_compose_at_the_same_time() -> None:
    def compose(seed: int) -> int:
        words = ["scenario=linear_walk", "filter=sir", f"seed={seed}"]
        return int(job.compose(words).values["seed"])

    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(compose, range(8))) == list(range(8))
    assert not GlobalHydra.instance().is_initialized()


WORDS = (
    ["scenario=linear_walk", "filter=rpf", "filter.particles=33"],
    ["scenario=linear_walk", "filter=rpf", "runs=7", "+note={a: 1}", "~seed"],  # the same files
    ["filter=sir", "scenario=linear_walk", "noise=outliers"],
    ["+experiment=quickstart", "runs=3,4"],
    ["scenario=linear_walk,growth", "filter=sir,rpf", "hydra/launcher=joblib"],
    ["scenario=azimuth", "model=sins_gps_azimuth15", "hydra.verbose=true"],
)


@pytest.mark.parametrize("words", WORDS)
@pytest.mark.parametrize(
    ("mode", "run_mode"),
    [
        ([], RunMode.RUN),
        ([], RunMode.MULTIRUN),
        (["hydra.mode=RUN"], RunMode.RUN),
        (["hydra.mode=MULTIRUN"], RunMode.MULTIRUN),
    ],
)
def test_a_copied_composition_of_these_tests_is_that_of_hydra(
    mode: list[str], run_mode: RunMode, words: list[str]
) -> None:
    """A change of a copy does not reach the next one."""

    def compose() -> Any:
        with initialize_config_dir(str(job.conf_dir()), version_base="1.3", job_name="one"):
            loader = cast(ConfigLoaderImpl, GlobalHydra.instance().config_loader())
            more = {"run_mode": run_mode, "validate_sweep_overrides": False}
            return loader._load_configuration_impl("config", [*words, *mode], **more)

    job.register_experiments()
    with composed_once.uninstalled():
        assert ConfigLoaderImpl._load_configuration_impl is composed_once.compose_by_hydra
        expected = compose()
    for _ in range(2):
        copied = compose()
        for tree in (copied, expected):
            assert OmegaConf.is_struct(tree)
        assert OmegaConf.to_yaml(copied) == OmegaConf.to_yaml(expected)
        assert copied.hydra.mode == expected.hydra.mode
        copied.filter.particles = 1
        copied.hydra.runtime.choices.filter = "other"
