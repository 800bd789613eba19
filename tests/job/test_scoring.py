"""Scores of laws against the truth: closed forms, and calibration of an exact filter."""

import math
import re
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
import scoringrules
import torch
from checkout import ROOT
from scipy import stats
from torch import Tensor

from pfbench import job
from pfbench.core import Chart, EuclideanBlock, PhiloxStream, QuaternionBlock
from pfbench.core.record import MeasuredTruth
from pfbench.filter import (
    EnsembleKalmanFilter,
    GaussianFilter,
    GuidedNoiseProposal,
    ParticleFilter,
    RaoBlackwellisedFilter,
    TaylorLinearisation,
    run_filter,
)
from pfbench.filter.belief import ParticleBelief, StepInfo, make_step_info, summarise
from pfbench.job.raw_estimate import RawEstimate, compute_raw_estimate
from pfbench.job.scoring import (
    LikelihoodCounter,
    ScoreRecorder,
    _mean_length,
    score_normal,
    score_particles,
)
from pfbench.kernels import dispatch
from pfbench.model.linear_gaussian import linear_walk
from pfbench.noise.base import NominalNoise
from pfbench.results.paper_block import read_paper_block
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
def test_a_cloud_of_a_normal_law_scores_as_the_law_on_average() -> None:
    """With 12 particles, whose distances to themselves would cost a twelfth of the spread.

    The energy score of the law itself is that of 1e5 points, far from the truth.
    """
    error, covariance = law()
    n, root = 12, torch.linalg.cholesky(covariance)
    exact = score_normal(error, covariance, GROUPS)
    for r in range(3):
        z = PhiloxStream(1, torch.arange(4000)).normal("z", n, 2)
        own = error[r].expand(4000, -1)
        cloud = score_particles(own, z @ root[r].mT, torch.zeros(4000, n).double(), GROUPS)
        for name in ("crps", "pit", "energy_score"):
            found, wanted = getattr(cloud, name), getattr(exact, name)[r]
            bound = 4.5 * found.std(0) / 4000**0.5
            assert ((found.mean(0) - wanted).abs() < bound).all(), name
    off = PhiloxStream(2, torch.arange(2)).normal("z", 100_000, 2) @ root[0].mT + error[2]
    sample = off[0].norm(dim=-1) - 0.5 * (off[0] - off[1]).norm(dim=-1)
    assert abs(sample.mean() - exact.energy_score[2, 2]) < 4.5 * sample.std() / 100_000**0.5


def test_the_mean_length_of_a_normal_law_is_that_of_rayleigh_rice_and_a_point() -> None:
    """sd sqrt(pi / 2) in the plane, 2 sd sqrt(2 / pi) in space, Rice's about a centre, |m| without spread."""
    mean = torch.tensor(
        [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [3.0, 4.0, 0.0], [3.0, 4.0, 0.0]]
    ).double()
    variance = torch.tensor(
        [[4.0, 4.0, 0.0], [4.0, 4.0, 4.0], [4.0, 4.0, 0.0], [0.0, 0.0, 0.0]]
    ).double()
    wanted = [
        2 * math.sqrt(math.pi / 2),
        4 * math.sqrt(2 / math.pi),
        stats.rice(2.5, scale=2).mean(),
        5.0,
    ]
    found = _mean_length(1e3 * mean, 1e6 * variance)
    torch.testing.assert_close(found, 1e3 * torch.tensor(wanted).double(), rtol=1e-6, atol=0.0)


@pytest.mark.usefixtures("both")
def test_scores_of_particles_are_the_fair_ones_of_scoringrules() -> None:
    """And the energy score of one component is its CRPS, by particles and by a normal law."""
    error, covariance = law()
    deviation = PhiloxStream(2, torch.arange(3)).normal("z", 64, 2)
    found = score_particles(error, deviation, torch.zeros(3, 64, dtype=torch.float64), GROUPS)
    off = (error.unsqueeze(1) + deviation).numpy()
    crps = scoringrules.crps_ensemble(0 * error.numpy(), off.swapaxes(1, 2), estimator="fair")
    energy = scoringrules.es_ensemble(0 * error.numpy(), off, estimator="fair")
    torch.testing.assert_close(found.crps, torch.tensor(crps))
    torch.testing.assert_close(found.energy_score[:, 2], torch.tensor(energy))
    for scores in (found, score_normal(error, covariance, GROUPS)):
        torch.testing.assert_close(scores.energy_score[:, :2], scores.crps)


@pytest.mark.usefixtures("both")
def test_distances_of_weighted_particles_are_averaged_over_different_ones() -> None:
    """E |x| - E |x - x'| / 2 over pairs of different particles by their weights; one without weight does not count."""
    w = torch.tensor([0.5, 0.25, 0.25, 0.0]).double()
    deviation = torch.tensor([[[-1.0], [0.5], [3.0], [1e6]]]).double().expand(1, 4, 2)
    found = score_particles(torch.ones(1, 2).double(), deviation, w.log()[None], ((0, 1),))
    x = deviation[0, :3, 0] + 1.0
    apart = w[:3, None] * w[:3] * (x[:, None] - x).abs()
    wanted = (w[:3] * x.abs()).sum() - 0.5 * apart.sum() / (1 - w.square().sum())
    assert found.crps[0].tolist() == pytest.approx([float(wanted)] * 2)
    assert float(found.energy_score) == pytest.approx(math.sqrt(2) * float(wanted))


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
    flat = score_normal(error, 0 * covariance, GROUPS)
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
    "method",
    [GaussianFilter(TaylorLinearisation()), ParticleFilter(400), RaoBlackwellisedFilter(50)],
    ids=["kalman", "sir", "rbpf"],
)
def test_an_honest_filter_is_calibrated_and_a_confident_one_is_not(
    method: GaussianFilter | ParticleFilter | RaoBlackwellisedFilter,
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
                covariance=lambda: 0.36 * info.covariance(),
                cloud=cloud,
                group_covariance=None,
                conditional=None,
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


def test_the_raw_error_of_a_measured_position_is_that_of_a_normal_variable() -> None:
    """The sd is 1. The largest twentieth of the squares is left out."""
    limit = stats.chi2.ppf(0.95, 1)
    square = (0.95 - 2.0 * limit**0.5 * stats.norm.pdf(limit**0.5)) / 0.95
    plan = job.build_plan(job.compose(["scenario=linear_walk", "runs=100", "pcrb=false"]))
    with torch.no_grad():
        episode = plan.draw_episode(plan.runs)
        truth = plan.model.assemble(episode.truth)
        raw = compute_raw_estimate(plan.model, truth, episode.record, (0,))
    se = 0.5 / 4000**0.5  # relative, of 40 windows in 100 runs; squares vary by 0.97 of their mean
    assert raw.steps == 1
    assert raw.rmse == pytest.approx(square**0.5, rel=4 * se)
    assert raw.threshold == 5.0 * raw.rmse
    assert RawEstimate(raw.rmse, 1, 6.0 * raw.rmse).threshold == pytest.approx(3.0 * raw.rmse)


def test_a_scenario_has_the_threshold_of_the_table_or_none() -> None:
    """None where it does not tell the better of two correct filters from the worse of two wrong ones."""
    text = (ROOT / "docs" / "scenarios.md").read_text()
    lines = re.findall(r"^\| (\w+ \| .*) \|$", text, re.MULTILINE)
    rows = [line.split(" | ") for line in lines if "raw estimate" not in line]
    assert len(rows) > 40
    for name, _, _, _, _, cell, _, _, *shares in rows:
        stored = read_paper_block("scenario", name).get("divergence_threshold")
        assert stored == (None if "none" in cell else float(cell)), name
        ekf, sir, *wrong = (float(share) if share != "–" else 100.0 for share in shares)
        assert ("none" in cell) == (min(ekf, sir) > 10.0 or max(wrong) < 50.0), name
