"""Airborne passive location: what is measured against differences along the motion, its frames, its laws."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from refusals import check_refused
from torch import Tensor
from torch.autograd import forward_ad

from pfbench.core import PhiloxStream, Record
from pfbench.model.passive_location import (
    SPEED_OF_LIGHT,
    PassiveLocation,
    PlatformInputs,
    compute_level_attitude,
    predict_bearing,
    relative_motion,
)

SD = (1.64e-3, 1.64e-3, 1e-4, 1e-4, 1.0)
MODEL = PassiveLocation(2.0, 0.1, SD)
CARRIER = torch.tensor(10e9, dtype=torch.float64)


def doubles(values: Any) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def motions(n: int = 40) -> tuple[Tensor, Tensor, Tensor]:
    """Positions of some km all around, velocities of 100 m/s, accelerations of 5 m/s^2 [n, 3]."""
    z = PhiloxStream(5, torch.arange(3)).normal("world.motion", n, 3)
    return 5e3 * z[0], 100.0 * z[1], 5.0 * z[2]


def platform(
    runs: int = 1, velocity: Tensor | None = None, position: Tensor | None = None
) -> PlatformInputs:
    v = doubles([200.0, 0.0, 0.0]) if velocity is None else velocity
    p = doubles([0.0, 0.0, 2000.0]) if position is None else position
    return PlatformInputs(
        p.expand(runs, 3),
        v.expand(runs, 3),
        compute_level_attitude(v).expand(runs, 3, 3),
        CARRIER.expand(runs),
    )


def emitters(n: int = 30) -> Tensor:
    """All around the aircraft, tens of km away [1, n, 4]."""
    return PhiloxStream(6, torch.arange(1)).normal("world.emitters", n, 4) * doubles(
        [3e4, 3e4, 20.0, 20.0]
    )


# rates are derivatives


def central(f: Callable[[float], Tensor], h: float) -> Tensor:
    return (f(h) - f(-h)) / (2 * h)


def test_rates_of_the_angles_are_their_derivatives() -> None:
    p, v, _ = motions()
    rates = predict_bearing(p, v, CARRIER)[:, 2:4]
    coarse, fine = (
        central(lambda t: predict_bearing(p + t * v, v, CARRIER)[:, :2], h) for h in (1e-2, 5e-3)
    )
    numeric = (4 * fine - coarse) / 3  # without the error of second order
    size = rates.norm(dim=-1, keepdim=True)
    assert ((numeric - rates).abs() / size < 1e-6).all()


def doppler(p: Tensor, v: Tensor) -> Tensor:
    """-(f / c) r', by bearing and elevation as the paper has it."""
    bearing, elevation = predict_bearing(p, v, CARRIER)[:, :2].unbind(-1)
    along = v[:, 0] * torch.sin(bearing) * torch.cos(elevation) + v[:, 1] * torch.cos(
        bearing
    ) * torch.cos(elevation)
    return -CARRIER / SPEED_OF_LIGHT * (along + v[:, 2] * torch.sin(elevation))


def test_doppler_is_that_of_the_range_and_its_rate_without_acceleration_its_derivative() -> None:
    p, v, _ = motions()
    range_rate = central(lambda t: (p + t * v).norm(dim=-1), 1e-2)
    assert torch.allclose(doppler(p, v), -CARRIER / SPEED_OF_LIGHT * range_rate, rtol=1e-6)
    rate = predict_bearing(p, v, CARRIER)[:, 4]
    coarse, fine = (central(lambda t: doppler(p + t * v, v), h) for h in (1e-2, 5e-3))
    assert torch.allclose((4 * fine - coarse) / 3, rate, rtol=1e-6)
    assert (rate < 0.0).all()


def test_doppler_rate_with_acceleration_is_its_derivative_too() -> None:
    p, v, a = motions()
    rate = predict_bearing(p, v, CARRIER, a)
    coarse, fine = (
        central(lambda t: doppler(p + t * v + 0.5 * t * t * a, v + t * a), h) for h in (1e-2, 5e-3)
    )
    assert torch.allclose((4 * fine - coarse) / 3, rate[:, 4], rtol=1e-6)
    assert torch.equal(rate[:, :4], predict_bearing(p, v, CARRIER)[:, :4])


def test_doppler_rate_is_told_by_the_angular_rates() -> None:
    """-(f / c) r (beta'^2 cos^2 eps + eps'^2), as it is printed."""
    p, v, _ = motions()
    _, elevation, turning, rising, rate = predict_bearing(p, v, CARRIER).unbind(-1)
    stretch = p.norm(dim=-1) * ((turning * torch.cos(elevation)) ** 2 + rising**2)
    assert torch.allclose(rate, -CARRIER / SPEED_OF_LIGHT * stretch, rtol=1e-12)


# frames


@pytest.mark.parametrize(
    ("place", "bearing"),
    [
        ((5e3, 0.0), 0.0),
        ((0.0, -5e3), 90.0),
        ((0.0, 5e3), -90.0),
        ((3e3, -3e3), 45.0),
        ((-5e3, -1.0), 180.0),
    ],
)
def test_bearing_is_clockwise_from_the_nose_of_an_aircraft_that_flies_east(
    place: tuple[float, float], bearing: float
) -> None:
    seen = MODEL.observation(doubles([[[*place, 0.0, 0.0]]]), platform()).mean[0, 0]
    assert math.degrees(seen[0]) == pytest.approx(bearing, abs=0.02)
    assert seen[1] == pytest.approx(-math.atan2(2e3, math.hypot(*place)))  # below the aircraft


def test_body_axes_are_a_rotation_with_the_nose_along_the_course() -> None:
    east = compute_level_attitude(doubles([200.0, 0.0, 0.0]))
    assert torch.equal(east, doubles([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    for degrees in (0.0, 30.0, 200.0, -100.0):
        psi = math.radians(degrees)
        c, s = math.cos(psi), math.sin(psi)
        a = compute_level_attitude(doubles([70.0 * s, 70.0 * c, 0.0]))
        assert torch.allclose(a, doubles([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), atol=1e-15)
        assert torch.linalg.det(a) == pytest.approx(1.0)


def test_turning_ground_and_course_together_changes_nothing_that_is_seen() -> None:
    x, own = (
        emitters(),
        platform(position=doubles([4e3, -2e3, 1500.0]), velocity=doubles([150.0, 80.0, 0.0])),
    )
    c, s = math.cos(0.7), math.sin(0.7)
    turn = doubles([[c, -s], [s, c]])
    three = torch.block_diag(turn, torch.ones(1, 1, dtype=torch.float64))
    turned = platform(position=own.position[0] @ three.mT, velocity=own.velocity[0] @ three.mT)
    y, z = (
        MODEL.observation(x, own).mean,
        MODEL.observation(x @ torch.block_diag(turn, turn).mT, turned).mean,
    )
    assert torch.allclose(MODEL.residual(y, z), torch.zeros_like(y), atol=1e-11)
    assert not torch.allclose(MODEL.observation(x, turned).mean, y)


def test_relative_motion_is_the_emitters_less_the_aircrafts() -> None:
    """An aircraft that flies along with the emitter sees nothing turn; height counts in the range alone."""
    own = platform(velocity=doubles([12.0, -5.0, 0.0]))
    seen = MODEL.observation(doubles([[[3e4, 1e4, 12.0, -5.0]]]), own).mean[0, 0]
    assert (seen[2:].abs() < 1e-12).all()
    p, v = relative_motion(doubles([[[3e4, 1e4, 13.0, -3.0]]]), own)
    assert p.norm() == pytest.approx(math.sqrt(9e8 + 1e8 + 4e6))
    assert v.norm() == pytest.approx(math.sqrt(5.0))


# laws


def test_residuals_wrap_the_bearing_alone() -> None:
    y, y_hat = doubles([3.1, 1.5, 4.0, -4.0, 7.0]), doubles([-3.1, -1.6, 0.0, 0.0, -7.0])
    assert torch.allclose(
        MODEL.residual(y, y_hat), doubles([6.2 - 2 * math.pi, 3.1, 4.0, -4.0, 14.0])
    )


def test_the_emitter_moves_under_constant_acceleration() -> None:
    x = doubles([[[1.0, 2.0, 3.0, 4.0]]])
    w = doubles([[[10.0, -20.0]]])  # 1 and -2 m/s^2
    assert torch.allclose(
        MODEL.propagate(x, platform(), w),
        doubles([[[1 + 6 + 2, 2 + 8 - 4, 3 + 2, 4 - 4]]]).double(),
    )
    still = MODEL.propagate(x, platform(), torch.zeros_like(w))
    assert torch.allclose(
        MODEL.propagate(x, platform(), w) - still, w @ MODEL.noise_gain(platform()).mT
    )
    gain = MODEL.noise_gain(platform())[0]
    assert torch.linalg.matrix_rank(gain @ gain.mT) == 2
    assert MODEL.transition(x, platform()) is None


def test_no_acceleration_leaves_a_straight_line() -> None:
    model = PassiveLocation(1.0, 0.0, SD)
    x = emitters()
    assert torch.equal(
        model.propagate(x, platform(), torch.ones(1, 30, 2).double()), x @ model.phi.mT
    )


def test_the_likelihood_is_the_normal_one_over_what_is_seen() -> None:
    x, own = emitters(), platform()
    y_hat = MODEL.observation(x, own).mean
    y = (
        y_hat[:, 0]
        + doubles([2 * math.pi, 0.0, 0.0, 0.0, 0.0])
        + doubles(SD) * doubles([1.0, -2.0, 0.5, 1.5, -1.0])
    )
    y[0, 3] = torch.nan
    part = doubles([1.0, -2.0, 0.5, -1.0]).square().sum() + sum(
        math.log(2 * math.pi * SD[i] ** 2) for i in (0, 1, 2, 4)
    )
    assert MODEL.log_likelihood(y, x, own)[0, 0] == pytest.approx(-0.5 * float(part), rel=1e-9)


def test_derivatives_of_the_measurement_are_those_of_differences() -> None:
    x, own = emitters(), platform()
    for k, h in enumerate((1.0, 1.0, 1e-2, 1e-2)):
        direction = torch.zeros_like(x)
        direction[..., k] = 1.0
        with forward_ad.dual_level():
            slope = forward_ad.unpack_dual(
                MODEL.observation(forward_ad.make_dual(x, direction), own).mean
            ).tangent
        up, down = (MODEL.observation(x + s * h * direction, own).mean for s in (1.0, -1.0))
        difference = MODEL.residual(up, down) / (2 * h)
        assert torch.allclose(slope, difference, rtol=1e-4, atol=1e-7 * float(slope.abs().max()))


def test_inputs_are_each_runs_own_or_shared() -> None:
    x = emitters().expand(3, -1, -1)
    shared, own = platform(1), platform(3)
    other = own._replace(
        position=own.position + doubles([[0.0], [100.0], [0.0]]),
        carrier=own.carrier * doubles([1.0, 1.0, 2.0]),
    )
    y, z = MODEL.observation(x, shared).mean, MODEL.observation(x, other).mean
    assert torch.equal(y, MODEL.observation(x, own).mean)
    assert torch.equal(z[0], y[0])
    assert not torch.isclose(z[1, :, :4], y[1, :, :4], rtol=1e-9).any()
    assert torch.allclose(z[2], y[2] * doubles([1.0, 1.0, 1.0, 1.0, 2.0]))


def test_it_starts_about_its_origin_where_no_record_says_otherwise() -> None:
    model = PassiveLocation(1.0, 0.1, SD, (1e5, 2e5, 1.0, 2.0), (1e4, 2e4, 5.0, 6.0))
    law: Any = model.initial(4)
    assert model.origin.tolist() == [1e5, 2e5, 1.0, 2.0]
    assert law.mean.tolist() == [[0.0] * 4] * 4
    assert law.stddev[0].tolist() == [1e4, 2e4, 5.0, 6.0]
    truth = {"position": torch.ones(1, 2, 2), "velocity": 2 * torch.ones(1, 2, 2)}
    assert model.assemble(truth)[0, 0].tolist() == [1.0, 1.0, 2.0, 2.0]
    check_refused(
        [
            (
                r"record\.u must be PlatformInputs .*, got no inputs",
                lambda: model.prepare(Record(torch.zeros(1, 1, 5))),
            )
        ],
        remedy=False,
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"measurement_sd": (1e-3,) * 4}, r"model\.measurement_sd must be 5 numbers"),
        (
            {"measurement_sd": (1e-3, 1e-3, 1e-4, 0.0, 1.0)},
            r"model\.measurement_sd must be .*positive",
        ),
        (
            {"acceleration_sd": -0.1},
            r"model\.acceleration_sd must be at least 0 and finite, got -0\.1",
        ),
        ({"interval": 0.0}, r"model\.interval must be .*positive numbers, got 0\.0"),
        ({"initial_sd": (1.0,)}, r"model\.initial_sd must be 4 numbers, got \[1\.0\]"),
    ],
)
def test_bad_numbers_are_refused(change: dict[str, Any], message: str) -> None:
    check_refused(
        [
            (
                message,
                lambda: PassiveLocation(
                    **{"interval": 1.0, "acceleration_sd": 0.1, "measurement_sd": SD} | change
                ),
            )
        ],
        remedy=False,
    )
