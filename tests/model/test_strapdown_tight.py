"""The tightly coupled total-state model: plain geometry, its derivatives, its clock, and the loosely coupled model inside."""

import math
from dataclasses import replace

import pytest
import torch
from refusals import check_refused
from torch import Tensor

from pfbench.core import PhiloxStream, Record, map_inputs
from pfbench.filter import GaussianFilter, TaylorLinearisation, run_filter
from pfbench.model.strapdown import StrapdownTight, StrapdownTotal, TightMemsInputs
from pfbench.model.strapdown_tuning import RangeErrorModel, StrapdownTuning, TightTuning
from pfbench.nav.ranging import ReceiverClock
from pfbench.nav.strapdown import PreintegratedImu, preintegrate

MOTION = StrapdownTuning(
    gyro_density=2e-3,
    accelerometer_density=2e-2,
    gyro_bias_walk=1e-4,
    accelerometer_bias_walk=1e-3,
    position_sd=[1.0, 1.0, 1.0],
    velocity_sd=None,
    attitude_sd_deg=[1.0, 2.0, 3.0],
    initial_velocity_sd=[0.1, 0.2, 0.3],
    initial_position_sd=[1.0, 2.0, 3.0],
    gyro_bias_sd_deg_s=0.1,
    accelerometer_bias_sd=0.2,
)
CLOCK = ReceiverClock(bias_sd=4.0, drift_sd=0.5, bias_walk=0.3, drift_walk=0.2)
BELIEVED = TightTuning(
    MOTION,
    CLOCK,
    RangeErrorModel(1.0, 2.0),
    RangeErrorModel(0.05, 1.5, 0.1),
    inter_system_sd=2.0,
    inter_system_walk=0.04,
)
S = 6


def normal(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def sky(steps: int) -> tuple[Tensor, Tensor]:
    """Places and velocities of satellites above the horizon [1, T, S, 3]."""
    line = normal(1, 1, 1, S, 3)
    line[..., 2] = line[..., 2].abs() + 0.3
    line = line / line.norm(dim=-1, keepdim=True)
    velocity = 2000.0 * normal(2, 1, 1, S, 3)
    after = 0.25 * torch.arange(steps, dtype=torch.float64)[None, :, None, None]
    return 2.2e7 * line + velocity * after, velocity.expand(1, steps, S, 3)


def inputs(steps: int, duration: float = 0.25) -> TightMemsInputs:
    spans = torch.full((1, steps, 10), duration / 10, dtype=torch.float64)
    force = torch.tensor([0.0, 0.0, 9.8], dtype=torch.float64) + normal(3, 1, steps, 10, 3)
    bias = torch.zeros(1, steps, 6, dtype=torch.float64)
    imu = (*preintegrate(force, 0.5 * normal(4, 1, steps, 10, 3), spans, bias), bias)
    place, velocity = sky(steps)
    reach = place.norm(dim=-1)
    other = torch.tensor([0.0, 1.0] * (S // 2), dtype=torch.float64).expand(1, steps, S)
    stated = 0.2 + normal(5, 1, steps, S).abs()
    gravity = torch.full((1, steps), 9.8, dtype=torch.float64)
    return TightMemsInputs(
        PreintegratedImu(*imu, gravity, spans.sum(-1)),
        place / reach[..., None],
        reach,
        velocity,
        other,
        stated,
        0.1 * stated,
    )


def states(model: StrapdownTight, runs: int = 2, particles: int = 5) -> Tensor:
    """Spread states with the receiver some hundred metres from where the ranges refer to."""
    d = torch.cat(
        [
            normal(6, runs, particles, 6),
            200.0 * normal(7, runs, particles, 3),
            0.1 * normal(8, runs, particles, 9),
        ],
        -1,
    )
    return model.chart.add(model.origin.expand(runs, particles, -1), d)


def step(u: TightMemsInputs, t: int = 0) -> TightMemsInputs:
    return map_inputs(lambda leaf: leaf[:, t], u)


# what is seen


def test_ranges_and_rates_are_plain_geometry() -> None:
    model, u = StrapdownTight(BELIEVED), inputs(3)
    x = states(model)
    place, velocity = (part[:, 2:3] for part in sky(3))
    v, p, bias, drift, other = (
        x[..., 4:7],
        x[..., 7:10],
        x[..., 16:17],
        x[..., 17:18],
        x[..., 18:19],
    )
    sight = place - p.unsqueeze(-2)
    r = sight.norm(dim=-1)
    e = sight / r[..., None]
    zero = place.norm(dim=-1)
    ranges = r - zero + bias + other * torch.tensor([0.0, 1.0] * (S // 2))
    first = (place / zero[..., None] * velocity).sum(-1)
    rates = (e * (velocity - v.unsqueeze(-2))).sum(-1) - first + drift
    seen = model.observation(x, step(u, 2)).mean
    # the plain difference of ranges has 4e-9 m of rounding; of rates, 1e-12 of 4 km/s
    assert (seen[..., :S] - ranges).abs().max() < 5e-8
    assert (seen[..., S:] - rates).abs().max() < 1e-10
    assert seen.shape == (2, 5, 2 * S)


def test_single_precision_is_enough() -> None:
    model, u = StrapdownTight(BELIEVED), step(inputs(1))
    x = states(model)
    exact = model.observation(x, u).mean
    single = model.float().observation(x.float(), map_inputs(lambda leaf: leaf.float(), u)).mean
    assert single.dtype == torch.float32
    # 500 m and 2 km/s in 24 bits, some roundings each
    assert (single - exact).abs()[..., :S].max() < 1e-3
    assert (single - exact).abs()[..., S:].max() < 1e-3


def test_derivatives_of_what_is_seen_agree_with_differences() -> None:
    model, u, h = StrapdownTight(BELIEVED), step(inputs(1)), 1e-2
    x = states(model, 1, 1)

    def seen(d: Tensor) -> Tensor:
        return model.observation(model.chart.add(x, d), u).mean

    columns = torch.autograd.functional.jacobian(seen, torch.zeros(1, 1, 18, dtype=torch.float64))
    for i in range(18):
        d = torch.zeros(18, dtype=torch.float64)
        d[i] = h
        # rounding of 1e-9 m over 2 h
        assert ((seen(d) - seen(-d)) / (2 * h) - columns[..., 0, 0, i]).abs().max() < 1e-5
    assert torch.allclose(
        columns[0, 0, :S, 0, 0, 6:9], -u.line[0], atol=5e-5
    )  # 500 m from the place of the lines


def test_scatter_is_floor_and_statement_and_addition() -> None:
    model, u = StrapdownTight(BELIEVED), step(inputs(1))
    sd = model.observation(states(model), u).base_dist.scale[0, 0]
    assert torch.allclose(sd[:S].square(), 1.0 + 4.0 * u.range_sd[0].square())
    assert torch.allclose(sd[S:].square(), 0.05**2 + 0.1**2 + 2.25 * u.rate_sd[0].square())


def test_an_unseen_satellite_weighs_nothing() -> None:
    model, u = StrapdownTight(BELIEVED), step(inputs(1))
    x = states(model)
    y = model.observation(x, u).mean[:, 0] + normal(9, 2, 2 * S)
    y[:, [2, S + 2]] = torch.nan
    moved = u._replace(line=u.line.clone(), velocity=u.velocity.clone())
    moved.line[:, 2], moved.velocity[:, 2] = torch.tensor([0.0, 0.0, 1.0]).double(), 0.0
    assert torch.equal(model.log_likelihood(y, x, u), model.log_likelihood(y, x, moved))
    assert torch.isfinite(model.log_likelihood(y, x, u)).all()


# what moves


def test_the_motion_is_the_loosely_coupled_models() -> None:
    model, loose, u = StrapdownTight(BELIEVED), StrapdownTotal(MOTION), step(inputs(1))
    x, w = states(model), normal(10, 2, 5, 15)
    moved = model.propagate(x, u, w)
    assert torch.equal(moved[..., :16], loose.propagate(x[..., :16], u.increments, w[..., :12]))
    assert model.names[:15] == loose.names
    quiet = model.propagate(x, u, 0 * w)
    assert torch.allclose(quiet[..., 16], x[..., 16] + 0.25 * x[..., 17], atol=1e-14)
    assert torch.equal(quiet[..., 17:], x[..., 17:])
    again = model.chart.add(quiet, w @ model.noise_gain(u).mT)
    assert torch.allclose(again, moved, rtol=1e-12, atol=1e-12)
    still = model.propagate(x, step(inputs(1, 0.0)), w)
    assert torch.allclose(still[..., 4:], x[..., 4:], atol=1e-13)


@pytest.mark.parametrize("duration", [0.1, 1.0, 4.0])
def test_clock_noise_is_that_of_a_walking_bias_and_drift(duration: float) -> None:
    model = StrapdownTight(BELIEVED)

    def covariance(span: float) -> Tensor:
        gain = model.noise_gain(step(inputs(1, span)))[0, 15:]
        assert torch.equal(gain[:, :12], torch.zeros(3, 12, dtype=torch.float64))
        return gain @ gain.mT

    q_b, q_d = 0.3**2, 0.2**2
    cross = q_d * duration**2 / 2
    wanted = [
        [q_b * duration + q_d * duration**3 / 3, cross, 0],
        [cross, q_d * duration, 0],
        [0, 0, 0.04**2 * duration],
    ]
    assert torch.allclose(
        covariance(duration), torch.tensor(wanted, dtype=torch.float64), rtol=1e-9
    )
    half = covariance(duration / 2)
    f = torch.tensor([[1, duration / 2, 0], [0, 1, 0], [0, 0, 1]], dtype=torch.float64)
    assert torch.allclose(
        f @ half @ f.T + half, covariance(duration), rtol=1e-9
    )  # two steps make one


def test_the_filter_knows_its_errors_where_the_model_is_true() -> None:
    runs, steps = 40, 24
    model, u = StrapdownTight(BELIEVED), inputs(steps)
    x = model.chart.add(
        model.origin.expand(runs, 1, -1),
        model.initial(runs).base_dist.scale[:, None] * normal(11, runs, 1, 18),
    )
    truth, seen = [], []
    for t in range(steps):
        x = model.propagate(x, step(u, t), normal(100 + t, runs, 1, 15))
        law = model.observation(x, step(u, t)).base_dist
        truth.append(x[:, 0])
        seen.append((law.loc + law.scale * normal(200 + t, runs, 1, 2 * S))[:, 0])
    record = Record(torch.stack(seen, 1), u)
    estimate = run_filter(
        GaussianFilter(TaylorLinearisation()), model, record, PhiloxStream(1, torch.arange(runs))
    )
    error = model.error(estimate.mean, torch.stack(truth, 1))[:, -1]
    assert not estimate.lost.any()
    nees = (error.square() / estimate.variance[:, -1]).mean()
    # 40 runs of 18 components, correlated in pairs at worst: the mean of 360 chi-squares, four standard errors
    assert abs(float(nees) - 1) < 4 * math.sqrt(2 / 360)
    clock = error[:, 15:].square().mean(0).sqrt()
    assert (clock < 0.8 * model.p0[15:]).all()  # and it learns of each clock


# the door


def test_truth_is_laid_out_and_clocks_without_truth_are_nan() -> None:
    model = StrapdownTight(BELIEVED)
    full = model.assemble({"position": normal(1, 2, 3, 3), "clock_drift": normal(2, 2, 3, 1)})
    assert full.shape == (2, 3, 19)
    known = torch.isfinite(full[0, 0])
    assert known.nonzero()[:, 0].tolist() == [7, 8, 9, 17]
    assert sum(map(len, model.groups.values())) == len(model.names) == len(model.units) == 18


def test_records_of_another_kind_are_refused() -> None:
    model, u = StrapdownTight(BELIEVED), inputs(2)
    check_refused(
        [
            (
                r"record\.u must be TightMemsInputs for StrapdownTight, got PreintegratedImu",
                lambda: model.prepare(Record(torch.zeros(1, 2, 12), u.increments)),
            )
        ],
        remedy=False,
    )
    assert model.prepare(Record(torch.zeros(1, 2, 12), u)).u is u


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RangeErrorModel(0.0), r"tuning\.floor_sd"),
        (lambda: RangeErrorModel(1.0, -1.0), r"tuning\.stated_sd_factor .*got -1\.0 and 0\.0"),
        (lambda: RangeErrorModel(1.0, 1.0, -1.0), r"tuning\.added_sd .*got 1\.0 and -1\.0"),
        (
            lambda: StrapdownTight(replace(BELIEVED, inter_system_sd=0.0)),
            r"tuning\.inter_system_sd",
        ),
        (
            lambda: StrapdownTight(replace(BELIEVED, inter_system_walk=-1.0)),
            r"tuning\.inter_system_walk",
        ),
        (
            lambda: StrapdownTight(replace(BELIEVED, motion=replace(MOTION, gyro_density=0.0))),
            r"tuning\.gyro_density",
        ),
    ],
)
def test_impossible_beliefs_name_their_key(make: object, message: str) -> None:
    check_refused([(message, lambda: make())], remedy=False)
