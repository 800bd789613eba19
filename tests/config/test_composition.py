"""Configurations are composed from Python, in any thread, without a trace in Hydra's global state."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

from hydra.core.global_hydra import GlobalHydra

from pfbench import job


def test_threads_compose_at_the_same_time() -> None:
    def compose(seed: int) -> int:
        words = ["scenario=linear_walk", "filter=sir", f"seed={seed}"]
        return int(job.compose(words).values["seed"])

    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(compose, range(8))) == list(range(8))
    assert not GlobalHydra.instance().is_initialized()
