"""Scores of laws against the truth: closed forms, and calibration of an exact filter."""

from __future__ import annotations

import math
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from scipy import stats
from torch import Tensor

from pfbench.core.chart import Chart, EuclideanBlock, QuaternionBlock
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import MeasuredTruth
from pfbench.filter.belief import ParticleBelief, StepInfo, make_step_info, summarise
from pfbench.filter.gaussian.ensemble_kalman import EnsembleKalmanFilter
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter
from pfbench.filter.gaussian.linearisation_rules import TaylorLinearisation
from pfbench.filter.guided.noise_guide import GuidedNoiseProposal
from pfbench.filter.loop import run_filter
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.job.scoring import LikelihoodCounter, ScoreRecorder, score_normal, score_particles
from pfbench.kernels import dispatch
from pfbench.model.linear_gaussian import linear_walk
from pfbench.noise.base import NominalNoise
from pfbench.scenario.simulated import ModelSimulation

MODEL = linear_walk(1.0, 0.3, 1.0)
GROUPS = ((0,), (1,), (0, 1))


def law(runs: int = 3) -> tuple[Tensor, Tensor]:
    """Errors [R, 2] and covariance [R, 2, 2], correlated."""
    covariance = torch.tensor([[4.0, 1.5], [1.5, 1.0]], dtype=torch.float64).expand(runs, -1, -1)
    return torch.tensor([[0.0, 0.0], [1.0, -2.0], [6.0, 0.5]], dtype=torch.float64)[
        :runs
    ], covariance


@pytest.fixture(params=[False, True], ids=["eager", "fused"])
def both(request: pytest.FixtureRequest) -> Iterator[None]:
    """By the library, and by loops of the project's own."""
    with dispatch.use_kernels(request.param):
        yield


@pytest.mark.usefixtures("both")
def test_a_large_cloud_of_a_normal_law_scores_as_the_law() -> None:
    error, covariance = law()
    n, root = 40_000, torch.linalg.cholesky(covariance)
    z = PhiloxStream(1, torch.arange(3)).normal("z", n, 2)
    cloud = score_particles(error, z @ root.mT, torch.zeros(3, n, dtype=torch.float64), GROUPS)
    exact = score_normal(error, covariance, z[:, :2000], GROUPS)
    sd = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    assert ((cloud.crps - exact.crps).abs() < 6 * sd / math.sqrt(n)).all()
    assert ((cloud.pit - exact.pit).abs() < 6 * 0.5 / math.sqrt(n)).all()
    # 64 points stand for the cloud: the mean distance from the truth is off by a few standard errors of 64, and by the bias
    assert (
        (cloud.energy_score - exact.energy_score).abs() < 6 * sd.sum(-1, keepdim=True) / 8
    ).all()
    z = torch.tensor([0.5, -1.5], dtype=torch.float64)  # Gneiting and Raftery 2007, eq. 21
    expected = (
        z * (2 * torch.special.ndtr(z) - 1)
        + 2 * torch.exp(-z * z / 2) / math.sqrt(2 * math.pi)
        - 1 / math.sqrt(math.pi)
    )
    one = score_normal(
        z[:, None],
        torch.ones(2, 1, 1, dtype=torch.float64),
        torch.zeros(2, 4, 1, dtype=torch.float64),
        ((0,),),
    )
    torch.testing.assert_close(one.crps[:, 0], expected)


@pytest.mark.usefixtures("both")
def test_the_energy_score_of_one_component_is_its_crps() -> None:
    error, _ = law()
    deviation = PhiloxStream(2, torch.arange(3)).normal("z", 64, 2)
    scores = score_particles(error, deviation, torch.zeros(3, 64, dtype=torch.float64), GROUPS)
    torch.testing.assert_close(scores.energy_score[:, :2], scores.crps)


@pytest.mark.usefixtures("both")
def test_a_weighted_particle_is_as_many_particles() -> None:
    error, _ = law()
    deviation = PhiloxStream(2, torch.arange(3)).normal("z", 16, 2)
    repeated = deviation.repeat_interleave(torch.tensor([1, 3] * 8), dim=1)
    w = torch.tensor([1.0, 3.0] * 8, dtype=torch.float64).log().expand(3, -1)
    empty = torch.cat([w, torch.full((3, 1), -torch.inf, dtype=torch.float64)], 1)
    padded = torch.cat([deviation, torch.full((3, 1, 2), 1e6, dtype=torch.float64)], 1)
    one = score_particles(error, padded, empty, GROUPS)
    torch.testing.assert_close(
        one._asdict(),
        score_particles(error, repeated, torch.zeros(3, 32, dtype=w.dtype), GROUPS)._asdict(),
    )


@pytest.mark.usefixtures("both")
def test_the_points_that_stand_for_a_cloud_favour_no_side() -> None:
    """A mirrored cloud has the mirrored score, though three particles do not divide 64 points."""
    error = torch.tensor([[0.4, -0.3]], dtype=torch.float64)
    deviation = torch.tensor([[[-1.0, -2.0], [0.0, 0.0], [1.0, 2.0]]], dtype=torch.float64)
    even = torch.zeros(1, 3, dtype=torch.float64)
    one, mirrored = (score_particles(sign * error, deviation, even, GROUPS) for sign in (1, -1))
    torch.testing.assert_close(one.energy_score, mirrored.energy_score)


@pytest.mark.usefixtures("both")
def test_a_point_scores_its_distance() -> None:
    error, covariance = law()
    point = score_particles(
        error,
        torch.zeros(3, 5, 2, dtype=torch.float64),
        torch.zeros(3, 5, dtype=torch.float64),
        GROUPS,
    )
    flat = score_normal(error, 0 * covariance, torch.zeros(3, 8, 2, dtype=torch.float64), GROUPS)
    for scores in (point, flat):
        torch.testing.assert_close(scores.crps, error.abs())
        torch.testing.assert_close(scores.energy_score[:, 2], error.norm(dim=1))


@pytest.mark.usefixtures("both")
def test_without_a_truth_there_is_no_score() -> None:
    error = torch.tensor([[0.5, torch.nan]], dtype=torch.float64)
    scores = score_particles(
        error,
        torch.zeros(1, 4, 2, dtype=torch.float64),
        torch.zeros(1, 4, dtype=torch.float64),
        GROUPS,
    )
    assert torch.isnan(scores.crps).tolist() == torch.isnan(scores.pit).tolist() == [[False, True]]
    assert torch.isnan(scores.energy_score).tolist() == [[False, True, True]]


@pytest.mark.usefixtures("both")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_filter_without_spread_has_an_infinite_normalised_error(dtype: torch.dtype) -> None:
    """Without a truth it is unknown, whatever the spread; one run's says nothing of another's."""
    x = PhiloxStream(2, torch.arange(4)).normal("x", 20, 2).to(dtype)
    x[1], x[3, :, 1] = x[1, :1], x[3, :1, 1]
    truth = torch.zeros(4, 1, 2, dtype=dtype)
    truth[2] = torch.nan
    cloud = ParticleBelief(
        x, torch.full((4, 20), -math.log(20), dtype=dtype), torch.zeros(4, dtype=torch.float64)
    )
    info = summarise(MODEL, cloud, {})
    level = torch.where(
        torch.tensor([[False], [True], [False], [False]]), x[:, 0], info.mean
    )  # free of its rounding
    level[3, 1] = x[3, 0, 1]
    found = ScoreRecorder(MODEL, truth, 1)(
        0, make_step_info(MODEL, cloud, level, info.variance, {})
    )
    nees = found["nees"]
    assert torch.isinf(nees[1]).all()
    assert torch.isnan(nees[2]).all()
    assert torch.isfinite(nees[0]).all()
    assert torch.isinf(nees[3]).any()
    off, d = level[0].double(), x[0].double() - level[0].double()
    wanted = off @ torch.linalg.inv(d.mT @ d / 20) @ off
    assert float(nees[0, -1]) == pytest.approx(
        float(wanted), rel=1e-4 if dtype == torch.float32 else 1e-9
    )


@pytest.mark.parametrize(
    ("instants", "at"),
    [(0, []), (1, [9]), (3, [2, 5, 9]), (10, list(range(10))), (99, list(range(10)))],
)
def test_instants_are_spread_evenly_and_the_last_is_among_them(
    instants: int, at: list[int]
) -> None:
    assert ScoreRecorder(MODEL, torch.zeros(1, 10, 2), instants).at_step == at


@pytest.mark.parametrize(
    "method", [GaussianFilter(TaylorLinearisation()), ParticleFilter(400)], ids=["kalman", "sir"]
)
def test_an_honest_filter_is_calibrated_and_a_confident_one_is_not(
    method: GaussianFilter | ParticleFilter,
) -> None:
    runs = torch.arange(300)
    episode = ModelSimulation(MODEL, 20).draw(NominalNoise(), runs, 3)
    truth = MODEL.assemble(episode.truth)

    def confident(t: int, info: StepInfo) -> dict[str, Tensor]:
        d, log_w = info.cloud() if info.cloud else (None, None)
        cloud = None if d is None else (lambda: (0.6 * d, log_w))
        return proud(
            t,
            info._replace(
                covariance=lambda: 0.36 * info.covariance(), cloud=cloud, group_covariance=None
            ),
        )

    honest, proud = ScoreRecorder(MODEL, truth, 2), ScoreRecorder(MODEL, truth, 2)
    for judge, watch in ((honest, honest), (proud, confident)):
        run_filter(method, MODEL, episode.record, PhiloxStream(4, runs), watch)
        found = judge.arrays()
        assert found["score_steps"].tolist() == [9, 19]
        assert found["crps"].shape == found["pit"].shape == (300, 2, 2)
        assert found["energy_score"].shape == (300, 2, len(MODEL.groups))
    p = [
        stats.kstest(judge.arrays()["pit"][:, -1, 0], "uniform").pvalue for judge in (honest, proud)
    ]
    assert p[0] > 1e-3
    assert p[1] < 1e-4
    assert (honest.arrays()["crps"] - proud.arrays()["crps"]).mean() < 0
    assert honest.seconds > 0


@pytest.mark.parametrize(
    "parts", [[[0, 1, 2], [3, 1, 5], [4, 6, 2]], [[4], [0]], [[0, 5]], [[6, 0, 3, 2, 1]]], ids=len
)
@pytest.mark.parametrize("fused", [False, True])
@pytest.mark.parametrize(
    "chart",
    [Chart((EuclideanBlock(7),)), Chart((QuaternionBlock(), EuclideanBlock(4)))],
    ids=["flat", "quaternion"],
)
def test_a_group_of_a_covariance_is_cut_from_the_whole(
    chart: Chart, fused: bool, parts: list[list[int]]
) -> None:
    """Of clouds that lie in memory component by component and particle by particle."""
    draws = PhiloxStream(5, torch.arange(3))
    origin = torch.eye(chart.size, dtype=torch.float64)[:1].expand(3, 1, -1)
    x, log_w = (
        chart.add(origin, draws.normal("x", 43, chart.dimension)),
        draws.normal("w", 43, 1)[..., 0].log_softmax(1),
    )
    model: Any = SimpleNamespace(chart=chart)
    for laid in (x.contiguous(), x.permute(2, 0, 1).contiguous().permute(1, 2, 0)):
        with dispatch.use_kernels(fused):
            info = summarise(model, ParticleBelief(laid, log_w, torch.zeros(3, dtype=x.dtype)), {})
            found = info.covariance_of(torch.tensor(parts))
        whole = info.covariance()
        for g, own in enumerate(parts):
            torch.testing.assert_close(found[:, g], whole[:, own][:, :, own], rtol=1e-9, atol=1e-12)
        assert (found[:, 0].diagonal(dim1=-2, dim2=-1) > 0).all()


@pytest.mark.usefixtures("both")
@pytest.mark.parametrize("name", ["ekf", "sir", "enkf", "guided"])
def test_the_normalised_innovation_is_chi_square_for_a_filter_that_is_right(name: str) -> None:
    methods: dict[str, Any] = {
        "ekf": GaussianFilter(TaylorLinearisation()),
        "sir": ParticleFilter(2000),
        "guided": ParticleFilter(
            2000, proposal=GuidedNoiseProposal(GaussianFilter(TaylorLinearisation()))
        ),
        "enkf": EnsembleKalmanFilter(2000),
    }
    runs, steps = 200, 10
    episode = ModelSimulation(MODEL, steps).draw(NominalNoise(), torch.arange(runs), 3)
    y = episode.record.y.clone()
    y[: runs // 2, 4] = torch.nan  # nothing is seen there
    record = episode.record._replace(y=y)
    judge = ScoreRecorder(MODEL, MODEL.assemble(episode.truth), steps)
    run_filter(methods[name], MODEL, record, PhiloxStream(3, torch.arange(runs)), judge)
    found = judge.arrays()
    nis, dof = found["nis"], found["nis_dof"]
    assert torch.equal(dof, (~torch.isnan(y)).sum(-1))
    assert (nis[dof == 0] == 0).all()
    p = stats.kstest(
        nis[dof > 0].numpy(), stats.chi2(1).cdf
    ).pvalue  # innovations of a right filter are independent
    assert p > 1e-3, p
    assert (
        stats.kstest(1.2 * nis[dof > 0].numpy(), stats.chi2(1).cdf).pvalue < 1e-3
    )  # one that is too sure would be seen


def test_what_the_judge_asks_is_not_counted_as_the_filters_likelihoods() -> None:
    model = linear_walk(1.0, 0.3, 1.0)
    episode = ModelSimulation(model, 6).draw(NominalNoise(), torch.arange(3), 3)
    tally = LikelihoodCounter(model)
    judge = ScoreRecorder(model, model.assemble(episode.truth), 6)

    def watch(t: int, info: StepInfo) -> dict[str, Tensor]:
        with tally.paused():
            return judge(t, info)

    run_filter(ParticleFilter(50), model, episode.record, PhiloxStream(3, torch.arange(3)), watch)
    assert tally.count == 3 * 6 * 50


@pytest.mark.parametrize("is_cloud", [False, True], ids=["normal", "particles"])
def test_errors_of_a_measured_truth_are_part_of_all_scores(*, is_cloud: bool) -> None:
    """A truth of sd 2 about which the filter is sure: NEES, ranks and CRPS are those of the sum of both errors."""
    steps, runs, sd, own = 400, 2, 2.0, 0.5
    draws = PhiloxStream(3, torch.arange(runs))
    model = linear_walk(1.0, 0.3, 1.0)
    d = model.chart.dimension
    group = next(iter(model.groups))
    size = len(model.groups[group])
    errors = (sd**2 + own**2) ** 0.5 * draws.normal("truth", steps, d)
    truth = torch.zeros(runs, steps, d, dtype=torch.float64) - errors
    measured = MeasuredTruth("fixes", {group: torch.full((size,), sd, dtype=torch.float64)})
    recorder = ScoreRecorder(model, truth, steps, measured=measured)
    mean, covariance = (
        torch.zeros(runs, d, dtype=torch.float64),
        own**2 * torch.eye(d).double().expand(runs, -1, -1),
    )
    nees = []
    for t in range(steps):
        cloud = own * draws.at_step(t + 1).normal("cloud", 400, d)
        log_w = torch.full((runs, 400), -math.log(400), dtype=torch.float64)
        info = StepInfo(
            mean, covariance.diagonal(dim1=-2, dim2=-1), lambda: covariance, {},
            (lambda cloud=cloud, log_w=log_w: (cloud, log_w)) if is_cloud else None,
        )  # fmt: skip
        nees.append(recorder(t, info)["nees"])
    place = list(model.groups).index(group)
    count = runs * steps
    mean_nees = float(torch.stack(nees)[..., place].mean())
    assert abs(mean_nees - size) < 5 * math.sqrt(2 * size / count)
    scores = recorder.arrays()
    inside = (scores["pit"][..., list(model.groups[group])] - 0.5).abs() < 0.25
    assert abs(float(inside.double().mean()) - 0.5) < 5 * 0.5 / math.sqrt(count * size)
    total = (sd**2 + own**2) ** 0.5
    crps = scores["crps"][..., list(model.groups[group])]
    spread = float(crps.std())
    assert (
        abs(float(crps.mean()) - total / math.sqrt(math.pi))
        < 5 * spread / math.sqrt(count * size) + total / 400
    )
