"""The car in a city: arcs, clocks, ranges without cancellation, and the law of a range that may be reflected."""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from refusals import check_refused
from scipy import integrate, stats
from torch import Tensor
from torch.autograd import forward_ad

from pfbench.core.record import Record
from pfbench.model.urban_gnss import (
    LosNlosRangeError,
    NormalExponentialMixture,
    NormalRangeError,
    PseudorangeError,
    UrbanGnss,
    UrbanInputs,
    UrbanTuning,
    range_change,
)
from pfbench.testing import check_jacobians

BELIEVED = UrbanTuning(
    distance_density=0.2,
    heading_density=0.01,
    height_density=0.1,
    clock_density=0.3,
    drift_density=0.04,
    inter_system_density=0.05,
    scale_density=1e-3,
    yaw_bias_density=1e-4,
    initial_position_sd=[15.0, 16.0, 10.0],
    initial_heading_sd_deg=10.0,
    initial_clock_sd=14.0,
    initial_drift_sd=0.5,
    initial_inter_system_sd=5.0,
    initial_scale_sd=0.01,
    initial_yaw_bias_sd=0.002,
)
MIXED = LosNlosRangeError(share=0.4, sd=3.0, tail=40.0, slope=0.5)
STATE = torch.tensor([40.0, -70.0, 3.0, 2.9, 12.0, -0.4, -5.0, -0.007, 0.001], dtype=torch.float64)
LAWS = [(-1.0, 3.0, 40.0), (0.5, 6.0, 45.0), (2.0, 5.0, 1.0), (-8.0, 0.5, 100.0)]  # odds, sd, tail


def sky(duration: float = 0.2, speed: float = 8.0, yaw_rate: float = 0.3) -> UrbanInputs:
    """One step's inputs, without the time axis: three satellites, the last one of GLONASS."""
    line = torch.tensor(
        [[0.6, 0.0, 0.8], [-0.48, 0.6, 0.64], [0.0, -0.96, 0.28]], dtype=torch.float64
    )
    reach = torch.tensor([2.02e7, 2.1e7, 2.3e7], dtype=torch.float64)
    row = [torch.tensor([value], dtype=torch.float64) for value in (duration, speed, yaw_rate)]
    sky_rows = [
        line,
        reach,
        reach.new_tensor([0, 0, 1]),
        reach.new_tensor([50, 40, 30]),
        reach.new_tensor([5, 8, 11]),
    ]
    return UrbanInputs(*row, *(part.unsqueeze(0) for part in sky_rows))


def model(law: PseudorangeError = MIXED, **changes: float) -> UrbanGnss:
    return UrbanGnss(replace(BELIEVED, **changes), law)


def moved(x: Tensor, u: UrbanInputs, w: Tensor | None = None) -> Tensor:
    """One step of a single state."""
    noise = torch.zeros(1, 1, 8, dtype=x.dtype) if w is None else w.reshape(1, 1, 8)
    return model().to(x.dtype).propagate(x.reshape(1, 1, 9), u, noise)[0, 0]


def tailed(odds: float, sd: float, tail: float, loc: float = 0.0) -> NormalExponentialMixture:
    return NormalExponentialMixture(
        *(torch.tensor(a, dtype=torch.float64) for a in (loc, odds, sd, tail))
    )


# motion


@pytest.mark.parametrize("yaw_rate", [0.0, 0.3, -0.6, 2.0])
def test_a_steady_turn_is_a_circle(yaw_rate: float) -> None:
    duration, v, x = 1.5, 8.0, STATE.clone()
    end = moved(x, sky(duration, v, yaw_rate))
    rate, speed, h = yaw_rate - x[8], v * (1 + x[7]), x[3]
    east = x[0] + speed / rate * (
        torch.cos(h) - torch.cos(h + rate * duration)
    )  # integral of speed sin(heading)
    north = x[1] + speed / rate * (torch.sin(h + rate * duration) - torch.sin(h))
    assert torch.allclose(end[:2], torch.stack([east, north]), rtol=0, atol=1e-9)
    turn = end[3] - h - rate * duration
    assert float(torch.remainder(turn + math.pi, 2 * math.pi) - math.pi) == pytest.approx(
        0.0, abs=1e-12
    )
    assert abs(float(end[3])) <= math.pi


def test_a_car_drives_where_it_points_and_turns_clockwise() -> None:
    east = torch.tensor([0.0, 0, 0, math.pi / 2, 0, 0, 0, 0, 0], dtype=torch.float64)
    assert torch.allclose(
        moved(east, sky(1.0, 8.0, 0.0))[:2], east.new_tensor([8.0, 0.0]), rtol=0, atol=1e-12
    )
    end = moved(torch.zeros_like(east), sky(1.0, 8.0, 0.1))
    assert end[0] > 0  # from North to the East
    assert end[3] == pytest.approx(0.1)


def test_two_half_steps_are_a_step() -> None:
    whole, half = sky(0.4), sky(0.2)
    assert torch.allclose(moved(moved(STATE, half), half), moved(STATE, whole), rtol=0, atol=1e-12)


def test_the_clock_runs_on_its_drift() -> None:
    end = moved(STATE, sky(0.25))
    assert torch.allclose(
        end[4:], STATE[4:] + STATE.new_tensor([0.25 * -0.4, 0, 0, 0, 0]), rtol=0, atol=1e-12
    )
    assert end[2] == STATE[2]


def test_the_step_has_the_derivatives_of_finite_differences() -> None:
    """By state and noise, also where nothing turns and nothing moves."""
    for u in (sky(), sky(yaw_rate=0.0), sky(speed=0.0, yaw_rate=0.001)):
        at = torch.cat([STATE, 0.1 * torch.arange(8, dtype=torch.float64)])
        if float(u.yaw_rate) == 0.0:
            at[8:] = 0.0
        for k in range(17):
            tangent = torch.zeros(17, dtype=torch.float64)
            tangent[k] = 1.0
            with forward_ad.dual_level():
                dual = forward_ad.make_dual(at, tangent)
                slope = forward_ad.unpack_dual(moved(dual[:9], u, dual[9:])).tangent
            h = 1e-5
            up, down = (moved((at + s * tangent)[:9], u, (at + s * tangent)[9:]) for s in (h, -h))
            # central differences: h^2/6 times third derivatives of at most 100 m, and rounding of 1e-14/h
            assert torch.allclose(slope, (up - down) / (2 * h), rtol=0, atol=2e-8)


def test_the_noise_has_the_densities_it_is_given() -> None:
    """Over one step from a state that faces North, at first order."""
    u, x = sky(0.25, 8.0, 0.0), torch.zeros(9, dtype=torch.float64)
    columns = torch.stack(
        [
            (moved(x, u, e) - moved(x, u, -e)) / 2e-4
            for e in 1e-4 * torch.eye(8, dtype=torch.float64)
        ],
        -1,
    )
    root = 0.5
    expected = torch.zeros(9, 8, dtype=torch.float64)
    expected[1, 0] = 0.2 * root
    expected[0, 1], expected[3, 1] = 8.0 * 0.25 / 2 * 0.01 * root, 0.01 * root
    expected[2, 2], expected[4, 3], expected[5, 4], expected[6, 5] = (
        0.1 * root,
        0.3 * root,
        0.04 * root,
        0.05 * root,
    )
    expected[4, 4] = 0.04 * root * 0.25 / 2
    expected[7, 6], expected[8, 7] = 1e-3 * root, 1e-4 * root
    assert torch.allclose(columns, expected, rtol=0, atol=1e-9)


# ranges


def test_a_change_of_range_is_the_difference_of_ranges() -> None:
    u = sky()
    position = 600.0 * torch.randn(
        1, 200, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    place = u.line * u.reach.unsqueeze(-1)
    exact = (place.unsqueeze(1) - position.unsqueeze(2)).norm(dim=-1) - place.norm(dim=-1)
    found = range_change(position, u.line, u.reach)
    assert torch.allclose(
        found, exact, rtol=0, atol=3e-8
    )  # what the difference of ranges of 2e7 m leaves of its digits
    single = range_change(position.float(), u.line.float(), u.reach.float())
    assert (single.double() - exact).abs().max() < 1e-3  # 2400 m times some half units of 6e-8
    toward = range_change(10.0 * u.line[:, :1], u.line, u.reach)
    assert float(toward[0, 0, 0]) == pytest.approx(-10.0, abs=1e-9)


def test_what_is_seen_is_range_and_clock_and_for_one_system_its_bias() -> None:
    u, x = sky(), STATE.reshape(1, 1, 9)
    mean = model(NormalRangeError()).observation(x, u).mean
    straight = range_change(x[..., :3], u.line, u.reach)
    assert torch.allclose(
        mean - straight, x.new_tensor([12.0, 12.0, 12.0 - 5.0]), rtol=0, atol=1e-12
    )
    assert torch.allclose(
        model(NormalRangeError(2.0)).observation(x, u).stddev,
        2.0 * u.sd.unsqueeze(1),
        rtol=0,
        atol=1e-12,
    )


def test_a_satellite_that_was_not_seen_weighs_nothing() -> None:
    u, x = sky(), STATE.repeat(1, 4, 1) + 30.0 * torch.arange(4.0).reshape(1, 4, 1)
    y = torch.tensor([[20.0, torch.nan, 44.0]], dtype=torch.float64)
    for law in (NormalRangeError(3.0), MIXED):
        whole = model(law)
        seen = UrbanInputs(*u[:3], *(leaf[:, [0, 2]] for leaf in u[3:]))
        assert torch.allclose(
            whole.log_likelihood(y, x, u),
            whole.log_likelihood(y[:, [0, 2]], x, seen),
            rtol=1e-12,
            atol=0,
        )
        single = whole.float().log_likelihood(
            y.float(), x.float(), UrbanInputs(*(leaf.float() for leaf in u))
        )
        assert torch.allclose(
            single.double(), whole.double().log_likelihood(y, x, u), rtol=1e-4, atol=0
        )


def test_every_satellite_has_its_own_share_by_its_strength() -> None:
    law = MIXED(torch.zeros(1, 1, 3, dtype=torch.float64), sky()).base_dist
    logit = math.log(0.4 / 0.6)
    assert torch.allclose(
        law.odds[0, 0], law.odds.new_tensor([logit + 5.0, logit, logit - 5.0]), rtol=0, atol=1e-12
    )
    flat = replace(MIXED, slope=0.0)(torch.zeros(1, 1, 3, dtype=torch.float64), sky()).base_dist
    assert torch.allclose(
        torch.sigmoid(flat.odds), torch.full_like(flat.odds, 0.4), rtol=0, atol=1e-12
    )


# the law of a range that may be reflected


def mixture(f: str, value: np.ndarray, odds: float, sd: float, tail: float) -> np.ndarray:
    """The same by scipy: a method of its normal and exponentially modified normal laws."""
    p = 1.0 / (1.0 + math.exp(-odds))
    parts = [stats.norm(scale=sd), stats.exponnorm(tail / sd, scale=sd)]
    return p * getattr(parts[0], f)(value) + (1.0 - p) * getattr(parts[1], f)(value)


@pytest.mark.parametrize(("odds", "sd", "tail"), LAWS)
def test_the_density_is_that_of_scipy_and_integrates_to_one(
    odds: float, sd: float, tail: float
) -> None:
    law = tailed(odds, sd, tail, loc=7.0)
    value = np.concatenate([np.linspace(-6 * sd, 6 * sd, 101), np.linspace(0.1, 12, 50) * tail])
    density = law.log_prob(torch.from_numpy(7.0 + value)).exp().numpy()
    assert np.allclose(density, mixture("pdf", value, odds, sd, tail), rtol=1e-9, atol=1e-18)

    def moment(k: int) -> float:
        def integrand(v: float) -> float:
            return (v - 7.0) ** k * math.exp(
                float(law.log_prob(torch.tensor(v, dtype=torch.float64)))
            )

        cuts = [7.0 - 10 * sd, 7.0, 7.0 + 6 * sd, 7.0 + 8 * sd + 45 * tail]
        return sum(
            integrate.quad(integrand, a, b, epsabs=1e-11, epsrel=1e-10)[0]
            for a, b in pairwise(cuts)
        )

    assert moment(0) == pytest.approx(1.0, abs=1e-8)
    mean = moment(1)
    assert float(law.mean) == pytest.approx(7.0 + mean, abs=1e-6)
    assert float(law.variance) == pytest.approx(moment(2) - mean**2, rel=1e-7)


def test_draws_have_the_law() -> None:
    torch.manual_seed(1)
    odds, sd, tail = LAWS[0]
    drawn = tailed(odds, sd, tail).sample((4000,)).numpy()
    assert stats.kstest(drawn, lambda v: mixture("cdf", v, odds, sd, tail)).pvalue > 1e-3


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_far_values_have_finite_densities_and_slopes(dtype: torch.dtype) -> None:
    value = torch.tensor(
        [-2e4, -300.0, -1.0, 0.0, 1.0, 300.0, 2e4], dtype=dtype, requires_grad=True
    )
    parts = [torch.tensor(a, dtype=dtype, requires_grad=True) for a in (0.0, 0.5, 3.0, 40.0)]
    density = NormalExponentialMixture(*parts).log_prob(value)
    slopes = torch.autograd.grad(density.sum(), [value, *parts])
    assert torch.isfinite(density).all()
    assert all(torch.isfinite(slope).all() for slope in slopes)
    # far above, the exponential rules; far below, the normal law, whichever part it comes from
    assert float(slopes[0][-1]) == pytest.approx(-1 / 40.0, rel=1e-4)
    assert float(slopes[0][0]) == pytest.approx(2e4 / 9.0, rel=1e-3)


def test_slopes_are_those_of_finite_differences() -> None:
    def log_density(*parts: Tensor) -> Tensor:
        value, *rest = parts
        return NormalExponentialMixture(*rest).log_prob(value)

    value = torch.tensor([-20.0, -3.0, 0.5, 9.0, 150.0], dtype=torch.float64)
    parts = [
        a.expand(5).clone().requires_grad_()
        for a in torch.tensor([1.0, 0.3, 3.0, 40.0], dtype=torch.float64)
    ]
    assert torch.autograd.gradcheck(log_density, (value.requires_grad_(), *parts))


def test_the_law_broadcasts_expands_and_sums_over_satellites() -> None:
    law = MIXED(torch.zeros(2, 5, 3, dtype=torch.float64), sky())
    assert law.batch_shape == (2, 5)
    assert law.event_shape == (3,)
    wide = law.expand((7, 2, 5))
    assert wide.sample().shape == (7, 2, 5, 3)
    one = torch.ones(3, dtype=torch.float64)
    assert torch.equal(wide.log_prob(one)[3], law.log_prob(one.expand(2, 5, 3)))


# at the door


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: LosNlosRangeError(1.0, 3.0, 40.0),
            r"range_error\.share must be in \(0, 1\), got 1\.0",
        ),
        (lambda: LosNlosRangeError(0.5, 0.0, 40.0), r"range_error\.sd must be .*got 0\.0"),
        (lambda: LosNlosRangeError(0.5, 3.0, -1.0), r"range_error\.tail must be .*got -1\.0"),
        (
            lambda: LosNlosRangeError(0.5, 3.0, 40.0, math.inf),
            r"range_error\.slope must be finite, got inf",
        ),
        (lambda: NormalRangeError(0.0), r"range_error\.factor must be .*got 0\.0"),
        (lambda: model(drift_density=0.0), r"tuning\.drift_density must be .*got \[0\.0\]"),
        (lambda: model(initial_heading_sd_deg=-1.0), r"tuning\.initial_heading_sd_deg"),
        (
            lambda: UrbanGnss(replace(BELIEVED, initial_position_sd=[1.0]), MIXED),
            r"initial_position_sd must have 3 numbers, got \[1\.0\]",
        ),
    ],
)
def test_impossible_settings_name_their_key(make: Callable[[], object], message: str) -> None:
    check_refused([(message, lambda: make())], remedy=False)


def test_inputs_of_another_scenario_are_refused() -> None:
    check_refused(
        [
            (
                r"must be UrbanInputs for UrbanGnss, got no inputs\. Choose a scenario",
                lambda: model().prepare(Record(torch.zeros(1, 1, 3))),
            )
        ],
        remedy=False,
    )


def test_the_initial_law_has_the_spreads_in_their_places() -> None:
    sd = model().initial(2).stddev[0]
    expected = [15.0, 16.0, 10.0, math.radians(10.0), 14.0, 0.5, 5.0, 0.01, 0.002]
    assert torch.allclose(sd, sd.new_tensor(expected), rtol=1e-12, atol=0)
    assert len(model().names) == len(model().units) == model().chart.dimension == 9


@pytest.mark.parametrize("law", [MIXED, NormalRangeError()])
def test_the_jacobian_of_ranges_is_the_difference_quotient(law: PseudorangeError) -> None:
    x = STATE.expand(2, 3, 9) * torch.tensor([1.0, 30.0, -300.0], dtype=torch.float64).view(3, 1)
    assert check_jacobians(model(law), x, sky(), step=1e-2).keys() == {"observation_jacobian"}
