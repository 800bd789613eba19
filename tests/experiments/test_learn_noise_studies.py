"""The studies of learned noise go on from where they stopped, and their pages say what was found."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pfbench.experiments import learn_canyon_noise, learn_quad_noise
from recorded_data import recorded

from pfbench.ppl.parameter_posterior import ParameterPosterior


def cells(page: str, start: str) -> list[str]:
    (line,) = (line for line in page.splitlines() if line.startswith(f"| {start}"))
    return line.strip("| ").split(" | ")


MIDDLES = {
    "gyro_density": 3e-4,
    "accelerometer_density": 9e-3,
    "gyro_bias_walk": 3e-5,
    "accelerometer_bias_walk": 8e-4,
}


def test_the_quadrotor_s_page_says_what_was_found_and_goes_on_from_where_it_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Errors are the gyro's density times a flight's number, evidence falls with it; the third call is stopped once."""
    g = torch.Generator().manual_seed(0)
    noise = 0.1 * torch.randn(len(MIDDLES), 4, 200, dtype=torch.float64, generator=g)
    draws = {name: m * (1.0 + z) for (name, m), z in zip(MIDDLES.items(), noise, strict=True)}
    posterior = ParameterPosterior(draws, torch.full((4,), 0.4, dtype=torch.float64), "PMMH")
    calls: list[float] = []

    def evaluate(tuning: Any) -> dict[str, list[float]]:
        calls.append(tuning.gyro_density)
        if len(calls) == 3:
            raise KeyboardInterrupt
        each = tuning.gyro_density * np.arange(1, 16)
        return {
            f"{method} {part}": [*(-each if part == "evidence" else each)]
            for method in ("ekf", "ckf")
            for part in learn_quad_noise.MEASURES
        }

    monkeypatch.setattr(learn_quad_noise, "evaluate", evaluate)
    monkeypatch.setattr(learn_quad_noise, "estimate", lambda draws, warmup, step: posterior)
    with pytest.raises(KeyboardInterrupt):
        learn_quad_noise.main(tmp_path, 200, 10)
    monkeypatch.setattr(learn_quad_noise, "estimate", None)  # stored, so not estimated again
    learn_quad_noise.main(tmp_path, 200, 10)
    assert calls == pytest.approx([1.22e-4, 1e-2, 3e-4, 3e-4], rel=0.02)
    page = (tmp_path / "report.md").read_text()
    assert "/tmp/" not in page
    gyro = cells(page, "gyro density")
    assert float(gyro[3].split()[0]) == pytest.approx(3e-4, rel=0.03)
    assert gyro[7:] == ["0.01", "0.00012"]
    row = next(line for line in page.splitlines() if line.startswith("| position")).split(" | ")
    assert float(row[1]) == pytest.approx(8 * 3e-4, rel=0.02)
    assert float(row[2]) == pytest.approx(8e-2)
    assert float(row[3].split()[0]) == pytest.approx(8 * (3e-4 - 1e-2), rel=0.02)
    assert row[4].rstrip(" |") == "6e-05, 0.0006"  # the least that fifteen flights give, ten tests
    assert "The chains have converged: " in " ".join(page.split())
    assert page.count("(smallest corrected p 0.0006)") == 4  # two filters against two tunings


@pytest.mark.slow
@recorded
def test_the_canyon_is_learned_and_scored_on_a_few_seconds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        learn_canyon_noise, "STRETCHES", {"first": (0.0, 10.0), "second": (10.0, 20.0)}
    )
    monkeypatch.setattr(learn_canyon_noise, "PARTICLES", 50)
    monkeypatch.setattr(learn_canyon_noise, "CHAINS", 4)
    monkeypatch.setattr(
        learn_canyon_noise,
        "positions",
        partial(learn_canyon_noise.positions, runs=2, particles=100),
    )
    learn_canyon_noise.main(tmp_path, 5, 3)
    page = (tmp_path / "report.md").read_text()
    normal, mixture = (
        [float(x) for x in cells(page, f"{name} | ")[1:]] for name in ("normal", "mixture")
    )
    assert all(a < b - 0.3 for a, b in zip(normal, mixture, strict=True))
