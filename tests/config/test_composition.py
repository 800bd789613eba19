"""Configurations are composed from Python, in any thread, without a trace in Hydra's global state."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import cast

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


@pytest.mark.parametrize("mode", [[], ["hydra.mode=RUN"], ["hydra.mode=MULTIRUN"]])
@pytest.mark.parametrize("run_mode", [RunMode.RUN, RunMode.MULTIRUN])
def test_a_copied_composition_of_these_tests_is_that_of_hydra(
    mode: list[str], run_mode: RunMode
) -> None:
    """A change of a copy does not reach the next one."""
    words = ["scenario=linear_walk", "filter=rpf", "filter.particles=33", *mode]
    with initialize_config_dir(str(job.conf_dir()), version_base="1.3", job_name="one"):
        for _ in range(2):
            loader = cast(ConfigLoaderImpl, GlobalHydra.instance().config_loader())
            copied = composed_once.compose_once(loader, "config", words, run_mode=run_mode)
            expected = composed_once.compose_by_hydra(loader, "config", words, run_mode=run_mode)
            for tree in (copied, expected):
                assert OmegaConf.is_struct(tree)
            assert OmegaConf.to_yaml(copied) == OmegaConf.to_yaml(expected)
            assert copied.hydra.mode == expected.hydra.mode
            copied.filter.particles = 1
