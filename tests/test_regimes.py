"""Noise regimes: what they promise about the errors of a receiver, and that a change of regime changes nothing else."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy import stats

from pfbench.draws import MonteCarlo
from pfbench.noise.regimes import Nominal, Outage, Outliers, Regime, StudentT
from pfbench.record import Channels

SD = torch.tensor([2.0, 0.05, 30.0], dtype=torch.float64)
TIME = torch.arange(0.0, 300.0, dtype=torch.float64)
RUNS = 40
REGIMES = [Nominal(), StudentT(4), Outliers(0.05, 10.0), Outage(((100.0, 130.0), (200.0, 201.0)))]
every_regime = pytest.mark.parametrize("regime", REGIMES, ids=lambda r: type(r).__name__)


def errors(regime: Regime, runs: torch.Tensor | None = None) -> torch.Tensor:
    return regime.errors(MonteCarlo(2, torch.arange(RUNS) if runs is None else runs), Channels.alike(SD), TIME)


@every_regime
def test_shape_and_a_run_alone(regime: Regime) -> None:
    e = errors(regime)
    assert e.shape == (RUNS, len(TIME), len(SD))
    alone = errors(regime, torch.tensor([17]))
    assert torch.equal(torch.nan_to_num(alone[0]), torch.nan_to_num(e[17]))


@every_regime
def test_errors_scale_with_the_nominal_deviation(regime: Regime) -> None:
    z = errors(regime)
    doubled = regime.errors(MonteCarlo(2, torch.arange(RUNS)), Channels.alike(2 * SD), TIME)
    assert torch.allclose(doubled, 2 * z, equal_nan=True)


@pytest.mark.parametrize("component", range(3))
def test_nominal_errors_are_white_and_normal(component: int) -> None:
    z = (errors(Nominal()) / SD)[..., component].numpy()
    assert stats.kstest(z.ravel(), "norm").pvalue > 1e-3
    lag = (z[:, 1:] * z[:, :-1]).mean()
    assert abs(lag) < 4 / math.sqrt(z.size)


@pytest.mark.parametrize("dof", [3, 4, 10])
def test_heavy_tails_are_student(dof: int) -> None:
    z = (errors(StudentT(dof)) / SD).numpy()
    assert stats.kstest(z.ravel(), stats.t(dof).cdf).pvalue > 1e-3
    far = (np.abs(z) > 5).mean()  # the tail itself, which a Kolmogorov-Smirnov test hardly sees
    p = 2 * stats.t(dof).sf(5)
    assert abs(far - p) < 4 * math.sqrt(p * (1 - p) / z.size)


def test_outliers_hit_whole_epochs_with_their_probability() -> None:
    nominal, e = errors(Nominal()), errors(Outliers(0.2, 7.0))
    ratio = (e / nominal).numpy()
    assert np.allclose(ratio, ratio[..., :1])  # all components at once
    hit = np.isclose(ratio[..., 0], 7.0)
    assert np.all(hit | np.isclose(ratio[..., 0], 1.0))  # otherwise the nominal error, number for number
    assert abs(hit.mean() - 0.2) < 4 * math.sqrt(0.16 / hit.size)


def test_an_outage_is_silent_from_and_not_at_its_end() -> None:
    e = errors(Outage(((100.0, 130.0), (200.0, 201.0))))
    silent = torch.isnan(e)
    expected = ((TIME >= 100) & (TIME < 130)) | (TIME == 200)
    assert torch.equal(silent, expected[None, :, None].expand_as(silent))
    assert torch.equal(e[:, ~expected], errors(Nominal())[:, ~expected])


BAD: list[tuple[Callable[[], Regime], str]] = [
    (lambda: StudentT(2), "dof=2"),
    (lambda: Outliers(probability=1.5), "probability=1.5"),
    (lambda: Outliers(probability=math.nan), "probability=nan"),
    (lambda: Outliers(size=0.5), "size=0.5"),
    (lambda: Outage(((5.0, 5.0),)), "5.0"),
    (lambda: Outage(((5.0,),)), "window"),
]


@pytest.mark.parametrize(("build", "word"), BAD)
def test_impossible_regimes_are_refused_by_name(build: Callable[[], Regime], word: str) -> None:
    with pytest.raises(ValueError, match=word):
        build()
