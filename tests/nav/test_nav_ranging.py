"""Ranges: expansions against plain geometry by pymap3d, clocks against their covariance, satellites that come and go."""

import math
from dataclasses import dataclass

import numpy as np
import pymap3d
import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad

from pfbench.core.random_stream import PhiloxStream
from pfbench.nav import ImuErrors, ManoeuvreTrajectory, TrajectoryStart, cruise, earth, turn
from pfbench.nav.aiding import AidingData, AlignmentErrors, FlightSolution
from pfbench.nav.atmosphere import Sight, delay_in_ionosphere, delay_in_troposphere
from pfbench.nav.orbits import LIGHT, SatelliteGeometry, WalkerConstellation, predict_ranges
from pfbench.nav.ranging import RangingInputs, RangingReceiver, ReceiverClock
from pfbench.noise.base import NominalNoise
from pfbench.scenario.flights import SimulatedFlight

DEG, SATELLITES = math.pi / 180, 6


@dataclass(frozen=True)
class Scene:
    """INS, truth and satellites of some runs; errors are those of the truth, [R, 1, 3]."""

    ins_pos: Tensor
    ins_vel: Tensor
    pos: Tensor
    vel: Tensor
    satellite: Tensor
    satellite_vel: Tensor

    @property
    def errors(self) -> tuple[Tensor, Tensor]:
        dp = (self.ins_pos - self.pos) * earth.metre_scale(self.pos)
        return dp.unsqueeze(1), (self.ins_vel - self.vel).unsqueeze(1)

    @property
    def sight(self) -> SatelliteGeometry:
        return predict_ranges(self.ins_pos, self.ins_vel, self.satellite, self.satellite_vel)


def scene(size: float, speed: float, runs: int = 40) -> Scene:
    draws = PhiloxStream(3, torch.arange(runs))
    a, b = draws.uniform("place", 1, 3)[:, 0], draws.normal("sky", SATELLITES, 6)
    pos = torch.stack([(140 * a[:, 0] - 70) * DEG, (360 * a[:, 1] - 180) * DEG, 5000 * a[:, 2]], -1)
    vel = 200 * draws.normal("vel", 1, 3)[:, 0]
    dp, dv = size * draws.normal("dp", 1, 3)[:, 0], speed * draws.normal("dv", 1, 3)[:, 0]
    up = b[..., :3] + 2 * earth.ecef(pos).unsqueeze(1) / earth.A
    place = 2.6e7 * up / up.norm(dim=-1, keepdim=True)
    return Scene(pos + dp / earth.metre_scale(pos), vel + dv, pos, vel, place, 3000 * b[..., 3:])


def geocentric(pos: Tensor) -> np.ndarray:
    lat, lon, h = pos.numpy().T
    return np.stack(pymap3d.geodetic2ecef(lat, lon, h, deg=False), -1)


def distances(pos: Tensor, vel: Tensor, at: Scene, t: float) -> np.ndarray:
    """Ranges [R, S] after t seconds of uniform motion."""
    u, v, w = pymap3d.enu2uvw(*vel.numpy().T, *pos.numpy().T[:2], deg=False)
    place = geocentric(pos) + t * np.stack([u, v, w], -1)
    return np.linalg.norm(
        place[:, None] - at.satellite.numpy() - t * at.satellite_vel.numpy(), axis=-1
    )


# what the INS expects


@pytest.mark.parametrize(("size", "speed"), [(10.0, 0.1), (5e3, 10.0), (2e5, 300.0)])
def test_differences_are_those_of_plain_geometry(size: float, speed: float) -> None:
    at = scene(size, speed)
    ranges, rates = at.sight.range_differences(*at.errors)
    wanted = distances(at.ins_pos, at.ins_vel, at, 0.0) - distances(at.pos, at.vel, at, 0.0)
    # 2e7 m hold 4e-9 m each; the meridian's radius changes by 1 % per radian at most, and the truth's is found in two passes
    far = 4 * size
    np.testing.assert_allclose(
        ranges[:, 0].numpy(), wanted, rtol=0, atol=1e-7 + far * (0.01 * far / 6.4e6) ** 2
    )
    dt = 1.0
    later, sooner = (
        distances(at.ins_pos, at.ins_vel, at, t) - distances(at.pos, at.vel, at, t)
        for t in (dt, -dt)
    )
    # the quotient's own error is the third derivative's, (4e3 m/s)^2 / (2e7 m)^2 of the rate
    bound = 1e-7 + 1e-6 * speed + 1e-12 * size
    np.testing.assert_allclose(rates[:, 0].numpy(), (later - sooner) / (2 * dt), rtol=0, atol=bound)


@pytest.mark.parametrize("size", [10.0, 1e3, 1e5])
def test_single_precision_loses_single_precision_of_the_errors_not_of_the_ranges(
    size: float,
) -> None:
    at = scene(size, 0.01 * size)
    exact = at.sight.range_differences(*at.errors)
    rough = SatelliteGeometry(*(a.float() for a in at.sight)).range_differences(
        *(a.float() for a in at.errors)
    )
    for a, b, scale in zip(exact, rough, (size, 0.01 * size + 3e3 * size / 2e7), strict=True):
        assert b.dtype == torch.float32
        assert (a - b).abs().max() < 2e-6 * 3 * scale  # a range of 2e7 m would be known to 1 m


@pytest.mark.parametrize("axis", range(3))
def test_the_linear_form_is_good_to_a_tenth_of_a_millimetre_at_ten_metres(axis: int) -> None:
    at = scene(0.0, 0.0)
    dp, dv = (torch.zeros(len(at.pos), 1, 3, dtype=torch.float64) for _ in range(2))
    dp[..., axis], dv[..., axis] = 10.0, 1.0
    ranges, rates = at.sight.range_differences(dp, dv)
    towards = earth.ecef(at.pos).unsqueeze(1) - at.satellite
    line = (
        towards / towards.norm(dim=-1, keepdim=True) @ earth.local_axes(at.pos).mT
    )  # East, North, Up
    assert torch.allclose(ranges[:, 0], 10.0 * line[..., [1, 0, 2]][..., axis], rtol=0, atol=1e-4)
    assert torch.allclose(
        rates[:, 0], line[..., axis], rtol=0, atol=1e-2
    )  # turning with the place: 3 km/s, 10 m of 2e7 m


def test_forward_differentiation_agrees_with_differences() -> None:
    at = scene(1e3, 5.0, runs=5)
    dp, dv = at.errors
    ways = PhiloxStream(4, torch.arange(5)).normal("way", 1, 6)
    with forward_ad.dual_level():
        moved = (
            forward_ad.make_dual(a, way) for a, way in zip((dp, dv), ways.split(3, -1), strict=True)
        )
        slopes = [forward_ad.unpack_dual(a).tangent for a in at.sight.range_differences(*moved)]
    plus, minus = (
        at.sight.range_differences(dp + s * ways[..., :3], dv + s * ways[..., 3:])
        for s in (1.0, -1.0)
    )
    for slope, a, b in zip(slopes, plus, minus, strict=True):
        assert torch.allclose(slope, (a - b) / 2, rtol=1e-6, atol=1e-8)


# the clock


def test_a_clock_over_two_intervals_is_the_clock_over_their_sum() -> None:
    clock = ReceiverClock(bias_walk=0.3, drift_walk=0.2)
    gain = clock.noise_gain(torch.tensor([2.0, 3.0, 5.0], dtype=torch.float64))
    q = gain @ gain.mT
    drifting = torch.tensor([[1.0, 3.0], [0.0, 1.0]], dtype=torch.float64)
    assert torch.allclose(drifting @ q[0] @ drifting.T + q[1], q[2], rtol=1e-12)
    assert not gain[:, 0, 1].any()
    assert not clock.noise_gain(torch.zeros(1)).any()


def test_clocks_spread_as_their_covariance_says() -> None:
    """P(t) = Phi P0 Phi' + Q(t) after 20 s in unequal intervals; the noise's variance doubled by the process."""
    runs, clock = 20000, ReceiverClock(2.0, 0.3, 0.5, 0.1)
    durations = torch.tensor([5.0, 1.0, 4.0, 10.0], dtype=torch.float64)
    x = clock.simulate(
        durations, torch.full((4,), 2.0, dtype=torch.float64), PhiloxStream(1, torch.arange(runs))
    )
    assert x.shape == (runs, 4, 2)
    t = 20.0
    bias = 2.0**2 + t**2 * 0.3**2 + 2 * (0.5**2 * t + 0.1**2 * t**3 / 3)
    drift, both = 0.3**2 + 2 * 0.1**2 * t, t * 0.3**2 + 2 * 0.1**2 * t**2 / 2
    wanted = torch.tensor([[bias, both], [both, drift]], dtype=torch.float64)
    found = x[:, -1].T @ x[:, -1] / runs
    spread = torch.sqrt((wanted**2 + wanted.diagonal()[:, None] * wanted.diagonal()) / runs)
    assert ((found - wanted).abs() < 4 * spread).all()
    assert (x.mean(0).abs() < 4 * x.std(0) / math.sqrt(runs)).all()


# the receiver

FLIGHT = SimulatedFlight(
    trajectory=ManoeuvreTrajectory(
        (cruise(20.0), turn(60.0, 40.0)), TrajectoryStart(26.26, 105.89, 320.0, 250.0, 225.0)
    ),
    imu=ImuErrors(3.0, 0.0, 0.0, 0.1, 500.0, 0.0, 0.0, 50.0),
    receiver=RangingReceiver(WalkerConstellation(), clock=ReceiverClock(30.0, 1.0)),
    initial_errors=AlignmentErrors((1.2, 1.2, 6.0), (5.0, 5.0, 5.0), (100.0, 100.0, 100.0)),
    imu_rate_hz=20.0,
)
RUNS = torch.arange(3)


@pytest.fixture(scope="module")
def flown() -> FlightSolution:
    return FLIGHT.fly(NominalNoise(), RUNS, 1)[0]


def aided(receiver: RangingReceiver, flown: FlightSolution) -> AidingData:
    return receiver.measure(
        flown, PhiloxStream(1, RUNS), torch.ones(len(flown.time), dtype=torch.float64)
    )


def above(flown: FlightSolution) -> np.ndarray:
    """Elevation of all satellites, degrees [T, S]."""
    places, _ = WalkerConstellation().at(flown.time)
    lat, lon, h = (flown.pos.numpy() * [1 / DEG, 1 / DEG, 1]).T[..., None]
    return pymap3d.ecef2aer(*places.numpy().transpose(2, 0, 1), lat, lon, h)[1]


def test_satellites_below_the_mask_are_not_seen(flown: FlightSolution) -> None:
    elevation = above(flown)
    mask = float(np.median(elevation[:, elevation[0] > 0]))  # one that satellites cross
    seen = ~aided(RangingReceiver(WalkerConstellation(), mask_deg=mask), flown).y.isnan().numpy()
    assert (seen == np.tile(elevation >= mask, (1, 2))).all()
    assert 0 < seen[0].any(0).sum() < 48
    # its own sky shows all above the horizon
    sky = aided(RangingReceiver(WalkerConstellation()), flown).sheet
    assert (~sky["elevation"].isnan().numpy() == (elevation >= 0)).all()
    np.testing.assert_allclose(
        np.nan_to_num(sky["elevation"].numpy() / DEG), np.maximum(elevation, 0), atol=1e-9
    )
    assert (sky["azimuth"].isnan() == sky["elevation"].isnan()).all()


def test_a_satellite_sets_during_a_flight(flown: FlightSolution) -> None:
    elevation = above(flown)
    mask = float(elevation[30, 1])  # W02, at mid-flight
    seen = (
        ~aided(RangingReceiver(WalkerConstellation(), mask_deg=mask, satellites=["W02"]), flown)
        .y[0, :, 0]
        .isnan()
    )
    assert 25 <= int(seen.sum()) <= 35
    assert int((seen[1:] != seen[:-1]).sum()) == 1


@pytest.mark.parametrize("sagnac", [False, True])
def test_without_noise_the_measurement_is_what_is_expected_at_the_truth(
    flown: FlightSolution, sagnac: bool
) -> None:
    told = aided(RangingReceiver(WalkerConstellation(), mask_deg=-90.0, sagnac=sagnac), flown)
    assert isinstance(told.u, RangingInputs)
    dp = (flown.ins.pos_end - flown.pos) * earth.metre_scale(flown.pos)
    dv = flown.ins.vel_end - flown.vel
    sight = told.u.sight
    for t in (0, 59):
        at = SatelliteGeometry(*(a[:, t] for a in sight))
        ranges, rates = at.range_differences(dp[:, t, None], dv[:, t, None])
        clock = told.truth["clock"][:, t]
        assert torch.allclose(told.y[:, t, :24], ranges[:, 0] - clock[:, :1], rtol=0, atol=1e-6)
        assert torch.allclose(told.y[:, t, 24:], rates[:, 0] - clock[:, 1:], rtol=0, atol=1e-9)
        assert (dp[:, t].abs().amax(-1) > 20.0).all()


def test_signals_take_their_time(flown: FlightSolution) -> None:
    """Light time and the Earth's turn meanwhile, by the usual correction of the range [Ashby 2003, eq. 26]."""
    told = aided(RangingReceiver(WalkerConstellation(), mask_deg=-90.0, sagnac=True), flown).u
    place = earth.ecef(flown.pos).unsqueeze(1)
    seen = (told.satellite[0] - place).norm(dim=-1)
    for satellite in (4, 11, 21):
        flight = seen[:, satellite] / LIGHT
        sent = torch.stack(
            [WalkerConstellation().at(t[None])[0][0, satellite] for t in flown.time - flight]
        )
        turned = earth.OMEGA / LIGHT * (sent[:, 0] * place[:, 0, 1] - sent[:, 1] * place[:, 0, 0])
        assert turned.abs().max() > 1.0
        # second order in the Earth's turn of 5e-6 rad: 2e7 m times its square
        assert torch.allclose(
            seen[:, satellite], (sent - place[:, 0]).norm(dim=-1) + turned, rtol=0, atol=2e-3
        )


def test_the_order_of_satellites_orders_the_measurements_and_nothing_else(
    flown: FlightSolution,
) -> None:
    names = ["W09", "W02", "W05"]
    some, other = (
        RangingReceiver(WalkerConstellation(), satellites=names),
        RangingReceiver(WalkerConstellation(), satellites=names[::-1]),
    )
    a, b = aided(some, flown), aided(other, flown)
    assert torch.equal(a.y, b.y[..., [2, 1, 0, 5, 4, 3]])
    assert torch.equal(a.truth["clock"], b.truth["clock"])
    everyone = aided(RangingReceiver(WalkerConstellation()), flown).y
    assert torch.equal(a.y, everyone[..., [8, 1, 4, 32, 25, 28]])
    channels = some.channels
    assert channels.kind == ("range",) * 3 + ("rate",) * 3
    assert channels.source == (0, 1, 2, 0, 1, 2)
    assert channels.sd.tolist() == [10.0, 10.0, 10.0, 0.1, 0.1, 0.1]


def test_a_regime_that_swells_the_process_swells_the_clock(flown: FlightSolution) -> None:
    receiver, draws = RangingReceiver(WalkerConstellation()), PhiloxStream(1, RUNS)
    calm, swollen = (
        receiver.measure(flown, draws, torch.full((60,), f, dtype=torch.float64)).truth["clock"]
        for f in (1.0, 4.0)
    )
    free = receiver.measure(flown, draws, torch.zeros(60, dtype=torch.float64)).truth["clock"]
    assert torch.allclose(swollen - free, 2 * (calm - free), atol=1e-9)
    assert torch.allclose(free[..., 1], free[:, :1, 1])  # without noise the drift stays


def test_an_unknown_satellite_is_named(flown: FlightSolution) -> None:
    with pytest.raises(ValueError, match=r"receiver\.satellites must .*got G05. Choose from W01, "):
        aided(RangingReceiver(WalkerConstellation(), satellites=["W01", "G05"]), flown)


COEFFICIENTS = (1.118e-08, 7.451e-09, -5.96e-08, -5.96e-08, 90110.0, 0.0, -196600.0, -65540.0)
# latitude, longitude deg, height m, azimuth, elevation deg, time of the week s, and the delays in ionosphere and troposphere m
# that RTKLIB 2.4.3 has (by pyrtklib 0.2.7); its mapping of the troposphere is 1 / sin(elevation)
OTHER = [
    (52.5, 13.4, 50.0, 210.0, 20.0, 126641.0, 7.090727, 6.947383),
    (40.1, -105.15, 1577.0, 65.0, 60.0, 408641.0, 2.930349, 2.255649),
    (-33.0, 151.0, 10.0, 0.0, 12.0, 20000.0, 9.751507, 11.507082),
    (1.0, 100.0, 0.0, 300.0, 85.0, 560000.0, 3.056614, 2.408344),
]


@pytest.mark.parametrize("row", OTHER)
def test_delays_are_those_of_another_program(row: tuple[float, ...]) -> None:
    lat, lon, h, azimuth, elevation, time, ionosphere, troposphere = row
    place = torch.tensor([math.radians(lat), math.radians(lon), h], dtype=torch.float64)
    angles = torch.tensor([[azimuth], [elevation]], dtype=torch.float64).deg2rad()
    sight = Sight(place, *angles)
    seconds = torch.tensor(time, dtype=torch.float64)
    assert float(delay_in_ionosphere(sight, seconds, COEFFICIENTS)) == pytest.approx(
        ionosphere, abs=1e-6
    )
    ratio = float(delay_in_troposphere(sight)) / troposphere
    # Black and Eisner's mapping is below 1 / sin(elevation): 0.1 % at 45 degrees, 2 % at 12
    sine = math.sin(math.radians(elevation))
    assert ratio == pytest.approx(1.001 * sine / math.sqrt(0.002001 + sine**2), abs=1e-4)
