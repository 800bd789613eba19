"""The studies of learned noise go on from where they stopped, and their pages say what was found."""

import math
import re
from collections.abc import Callable
from dataclasses import astuple
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pfbench.experiments import learn_canyon_noise, learn_quad_noise
from recorded_data import recorded

from pfbench.model.urban_gnss import LosNlosRangeError, NormalRangeError
from pfbench.ppl.parameter_posterior import ParameterPosterior

LAWS = {
    "first": LosNlosRangeError(0.32, 3.3, 39.0, 0.55),
    "second": LosNlosRangeError(0.46, 2.9, 42.0, 0.51),
}


def chains(middles: dict[str, float], apart: float = 0.0) -> ParameterPosterior:
    """Four chains of independent draws with an sd of a tenth around these numbers, `apart` of them between chains."""
    g = torch.Generator().manual_seed(0)
    noise = torch.randn(len(middles), 4, 200, dtype=torch.float64, generator=g)
    noise = noise + apart * torch.arange(4.0)[:, None]
    draws = {
        name: middle * (1.0 + 0.1 * z)
        for (name, middle), z in zip(middles.items(), noise, strict=True)
    }
    return ParameterPosterior(draws, torch.full((4,), 0.4, dtype=torch.float64), "PMMH")


def breaking(at: int, work: Callable[..., Any]) -> tuple[Callable[..., Any], list[tuple[Any, ...]]]:
    """The work, which is stopped once, at this call; and its calls."""
    calls: list[tuple[Any, ...]] = []

    def counted(*args: Any) -> Any:
        calls.append(args)
        if len(calls) == at:
            raise KeyboardInterrupt
        return work(*args)

    return counted, calls


def canyon(
    monkeypatch: pytest.MonkeyPatch, apart: float = 0.0, at: int = 0
) -> dict[str, list[tuple[Any, ...]]]:
    """The study without its data: the second stretch's share is 0.5, mixtures are ahead by 1 in evidence, elsewhere by 0.94."""

    def estimate(
        stretch: str, best: LosNlosRangeError, draws: int, warmup: int
    ) -> ParameterPosterior:
        odds = {"first": -0.8, "second": 1e-9}[stretch]
        return chains({"odds": odds, "sd": best.sd, "tail": best.tail, "slope": best.slope}, apart)

    def positions(law: Any, stretch: str) -> list[float]:
        return [(20.0 if isinstance(law, NormalRangeError) else 10.0) + k for k in range(8)]

    def evidence(law: Any, stretch: str) -> tuple[float, float]:
        if isinstance(law, NormalRangeError):
            return -4.8, 0.002
        here = (law.tail < 41.0) == (stretch == "first")
        return (-3.8 if here else -3.86), 0.002

    parts = {"estimate": estimate, "positions": positions, "evidence": evidence}
    found = {}
    for name, work in parts.items():
        counted, found[name] = breaking(at if name == "positions" else 0, work)
        monkeypatch.setattr(learn_canyon_noise, name, counted)
    monkeypatch.setattr(
        learn_canyon_noise,
        "estimate_maximum_likelihood",
        lambda stretch: {"normal": 3.35, "mixture": [*astuple(LAWS[stretch])]},
    )
    return found


def cells(page: str, start: str) -> list[str]:
    (line,) = (line for line in page.splitlines() if line.startswith(f"| {start}"))
    return line.strip("| ").split(" | ")


def test_a_study_of_the_canyon_goes_on_from_where_it_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = canyon(monkeypatch, at=4)
    with pytest.raises(KeyboardInterrupt):
        learn_canyon_noise.main(tmp_path, 200, 10)
    assert not (tmp_path / "report.md").exists()
    learn_canyon_noise.main(tmp_path, 200, 10)
    assert {name: len(each) for name, each in calls.items()} == {
        "estimate": 2,
        "evidence": 10,
        "positions": 7,
    }  # one normal law
    assert calls["positions"][3] == calls["positions"][4]
    page = (tmp_path / "report.md").read_text()
    learn_canyon_noise.main(tmp_path, 200, 10)
    assert len(calls["evidence"]) == 10
    assert (tmp_path / "report.md").read_text() == page
    learn_canyon_noise.main(tmp_path, 0)
    assert "Posterior" not in (tmp_path / "report.md").read_text()


def test_the_canyon_s_page_says_what_was_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    canyon(monkeypatch)
    learn_canyon_noise.main(tmp_path, 200, 10)
    page = (tmp_path / "report.md").read_text()
    assert "The chains have converged: " in " ".join(page.split())
    assert "/tmp/" not in page
    share = cells(page, "first | share")
    assert share[2] == "0.5 (0.036 to 0.96)"
    assert float(share[3].split()[0]) == pytest.approx(1 / (1 + math.exp(0.8)), abs=0.01)
    assert float(share[4]) < 1.05
    assert share[6] == "0.32"
    assert cells(page, "normal | ") == ["normal", *["-4.8000"] * 4]
    assert cells(page, "mixture | ") == ["mixture", *["-3.8600", "-3.8000"] * 2]
    assert page.replace("\n", " ").count("above the normal distribution by 0.940 and 0.940, ") == 2
    assert page.replace("\n", " ").count("below the same estimated there by 0.060 and 0.060") == 2
    row = cells(page, "first | mixture | ")
    assert row[2:6] == ["13.5 (10.0 to 17.0)", "23.5 (20.0 to 27.0)", "-10.0", "8 of 8 runs"]
    assert float(row[6]) == pytest.approx(0.0078)
    assert float(row[7]) == pytest.approx(4 * 0.0078, rel=0.01)
    apart = dict(re.findall(r"(logit of the share|slope) ([+-][\d.]+\d)", " ".join(page.split())))
    assert float(apart["logit of the share"]) == pytest.approx(-10.0, abs=1.0)  # (-0.8 - 0) / 0.08
    assert float(apart["slope"]) == pytest.approx(0.53, abs=0.15)
    for name in ("posterior.png", "scores.png"):
        assert (tmp_path / name).stat().st_size > 5000


def test_the_canyon_s_page_says_that_chains_have_not_met(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    canyon(monkeypatch, apart=3.0)
    learn_canyon_noise.main(tmp_path, 200, 10)
    page = (tmp_path / "report.md").read_text()
    assert "The chains have not converged" in " ".join(page.split())
    assert float(cells(page, "first | sd")[4]) > 1.5


MIDDLES = {
    "gyro_density": 3e-4,
    "accelerometer_density": 9e-3,
    "gyro_bias_walk": 3e-5,
    "accelerometer_bias_walk": 8e-4,
}


def quad(
    monkeypatch: pytest.MonkeyPatch, at: int = 0, equal: bool = False
) -> list[tuple[Any, ...]]:
    """The study without its data: errors are the gyro's density times a flight's number, evidence falls with it."""

    def evaluate(tuning: Any) -> dict[str, list[float]]:
        each = tuning.gyro_density * np.arange(1, 16)
        if equal and tuning.gyro_density < 1e-3:  # estimated or data sheet
            each = 3e-4 + 1e-5 * np.cos(
                np.arange(15) * (3.0 if tuning.gyro_density < 2e-4 else 5.0)
            )
        sign = {"evidence": -1.0}
        parts = learn_quad_noise.MEASURES
        return {
            f"{method} {part}": [*(sign.get(part, 1.0) * each)]
            for method in ("ekf", "ckf")
            for part in parts
        }

    counted, calls = breaking(at, evaluate)
    monkeypatch.setattr(learn_quad_noise, "evaluate", counted)
    monkeypatch.setattr(learn_quad_noise, "estimate", lambda draws, warmup, step: chains(MIDDLES))
    return calls


def test_a_study_of_the_quadrotor_goes_on_from_where_it_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = quad(monkeypatch, at=3)
    with pytest.raises(KeyboardInterrupt):
        learn_quad_noise.main(tmp_path, 200, 10)
    monkeypatch.setattr(learn_quad_noise, "estimate", None)  # stored, so not estimated again
    learn_quad_noise.main(tmp_path, 200, 10)
    assert len(calls) == 4
    assert calls[2] == calls[3]
    learn_quad_noise.main(tmp_path, 200, 10)
    assert len(calls) == 4


def test_the_quadrotor_s_page_says_what_was_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = quad(monkeypatch)
    learn_quad_noise.main(tmp_path, 200, 10)
    assert [tuning.gyro_density for (tuning,) in calls] == pytest.approx(
        [1.22e-4, 1e-2, 3e-4], rel=0.02
    )
    page = (tmp_path / "report.md").read_text()
    assert "The chains have converged: " in " ".join(page.split())
    assert "/tmp/" not in page
    gyro = cells(page, "gyro density")
    assert gyro[2] == "0.003 (0.00011 to 0.081)"
    assert float(gyro[3].split()[0]) == pytest.approx(3e-4, rel=0.03)
    assert gyro[4] == "2.9 and 0.1"
    assert gyro[7:] == ["0.01", "0.00012"]
    position, evidence = (
        [line for line in page.splitlines() if line.startswith(f"| {what}")]
        for what in ("position", "log ev")
    )
    assert len(position) == len(evidence) == 2  # of the EKF and the CKF
    row = position[0].strip("| ").split(" | ")
    assert float(row[1]) == pytest.approx(8 * 3e-4, rel=0.02)
    assert float(row[2]) == pytest.approx(8e-2)
    assert float(row[3].split()[0]) == pytest.approx(8 * (3e-4 - 1e-2), rel=0.02)
    assert row[4] == "6e-05, 0.0006"  # the least that fifteen flights give, ten tests
    assert evidence[0].split(" | ")[3].startswith("0.07")
    every = "position RMSE, roll and pitch RMSE, yaw RMSE, log evidence per fix, share of true values in 90 % intervals"
    flat = " ".join(page.split())
    for method in ("EKF", "CKF"):
        assert (
            f"{method}. Against the values set by hand, significant differences: {every} (smallest corrected p 0.0006). "
            in flat
        )
    for name in ("posterior.png", "flights.png"):
        assert (tmp_path / name).stat().st_size > 5000


def test_the_quadrotor_s_page_says_what_is_not_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    quad(monkeypatch, equal=True)
    learn_quad_noise.main(tmp_path, 200, 10)
    assert (tmp_path / "report.md").read_text().replace("\n", " ").count(
        "Against the data sheet, significant differences: none"
    ) == 2


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
