"""What cannot be flown, sensed or integrated is refused by its key, with its value and a remedy."""

import math
from dataclasses import replace
from typing import Any

import pytest
from nav_reference import true_start
from refusals import Refusal, check_refused

from pfbench import nav
from pfbench.nav.manoeuvres import ManoeuvreSegment, generate_manoeuvres
from pfbench.nav.ranging import ReceiverClock
from pfbench.nav.strapdown import navigate

START = nav.TrajectoryStart(-41.0, 30.0, 1500.0, speed=60.0, heading_deg=200.0)
LEVEL = nav.TrajectoryStart(0, 0, 0)
RECEIVER = nav.RangingReceiver(nav.WalkerConstellation())
SINKING = (nav.CosineRamp(0.0, 10.0, -80.0),)
RAMP = (nav.CosineRamp(0.0, 1.0, 1.0),)


def orbits(start: Any = 0.0, **changes: Any) -> Any:
    return nav.BroadcastConstellation("x", "y", start, **changes)


def flown(rate: int, dropped: int, dt: float, *settings: int) -> Any:
    flight = generate_manoeuvres([nav.cruise(1)], LEVEL, rate=rate)
    dv = flight.dv[None, : rate - dropped]
    return navigate(true_start(flight), flight.dtheta[None], dv, dt, *settings)


REFUSED: dict[str, list[Refusal]] = {
    "manoeuvres": [
        (r"duration of segment 1 must be .*got 0\.125 s \(12\.5000 samples\)", lambda: generate_manoeuvres([nav.cruise(1), nav.cruise(0.125)], LEVEL, rate=100)),
        ("duration_s must be positive, got 0", lambda: ManoeuvreSegment(0)),
        ("Give at least one manoeuvre", lambda: generate_manoeuvres([], LEVEL, rate=10)),
        ("speed must not be negative, got -10", lambda: generate_manoeuvres([nav.accelerate(-1, 20)], nav.TrajectoryStart(0, 0, 0, speed=10), rate=10)),
        ("near a pole", lambda: nav.TrajectoryStart(90, 0, 0)),
    ],
    "ramps": [
        (r"end_s must be later than start_s = 5\.0, got 5\.0", lambda: nav.CosineRamp(5.0, 5.0, 1.0)),
        (r"end_s must be later than start_s = 5\.0, got 5\.0", lambda: nav.CycloidRamp(5.0, 5.0, 1.0)),
        (r"trajectory\.climb_deg and trajectory\.climb_rate_changes must not both", lambda: nav.RampTrajectory(START, 10.0, climb_deg=RAMP, climb_rate_changes=RAMP)),
        (r"trajectory\.duration_s must be a whole number of samples at rate=10\.0, got 10\.03", lambda: nav.RampTrajectory(START, 10.03).generate(10.0)),
        (r"speed must not be negative, got -20\.000 m/s", lambda: nav.RampTrajectory(START, 10.0, SINKING).generate(10.0)),
        (r"horizontal speed must not be negative, got -20\.000 m/s", lambda: nav.RampTrajectory(START, 10.0, SINKING, climb_rate_changes=(nav.CosineRamp(0.0, 10.0, 1.0),)).generate(10.0)),
    ],
    "sensors": [
        (r"gyro_bias_deg_h must be at least 0, got -1\.0", lambda: nav.ImuErrors(gyro_bias_deg_h=-1.0)),
        ("accelerometer_random_walk_ug_sqrt_hz must be at least 0, got nan", lambda: nav.ImuErrors(accelerometer_random_walk_ug_sqrt_hz=math.nan)),
        (r"gyro_markov_time_s must be positive, got 0\.0. .* correlation time", lambda: nav.ImuErrors(gyro_markov_deg_h=1.0)),
        (r"accelerometer_markov_time_s must be positive, got 0\.0", lambda: nav.ImuErrors(accelerometer_markov_ug=1.0)),
    ],
    "receivers": [
        (r"receiver\.pseudorange_sd must be positive, got 0\.0", lambda: replace(RECEIVER, pseudorange_sd=0.0)),
        (r"receiver\.rate_sd must be positive, got -1\.0", lambda: replace(RECEIVER, rate_sd=-1.0)),
        (r"receiver\.mask_deg must be in \[-90, 90\], got 91\.0", lambda: replace(RECEIVER, mask_deg=91.0)),
        (r"receiver\.satellites must .*got \['W01', 'W01'\]. Give each satellite once", lambda: replace(RECEIVER, satellites=["W01", "W01"])),
        (r"receiver\.satellites must .*got \[\]", lambda: replace(RECEIVER, satellites=[])),
        (r"clock\.drift_walk must be positive, got 0\.0", lambda: ReceiverClock(drift_walk=0.0)),
    ],
    "orbits": [
        ("validity must be positive, got 0", lambda: orbits(validity=0)),
        (r"start_s must be seconds of GPS time .*, got noon", lambda: orbits("noon")),
        ("start_s must .*without a zone", lambda: orbits("2016-06-06T12:00:00+01:00")),
        ("satellites must be a positive multiple of planes=6, got 25", lambda: nav.WalkerConstellation(satellites=25)),
        (r"semi_major_axis must .*, got 26559\.7. Give metres", lambda: nav.WalkerConstellation(semi_major_axis=26559.7)),
    ],
    "mechanisation": [
        ("samples_per_interval must .*, got 5. Choose an even number", lambda: flown(100, 0, 0.01, 5, 2)),
        ("must be a multiple of samples_per_interval=30, got 100. Give 90 or 120", lambda: flown(100, 0, 0.01, 30, 2)),
        ("samples_per_step must be 1 or 2, got 3", lambda: flown(100, 0, 0.01, 10, 3)),
        ("the same number of samples, got 10 and 8", lambda: flown(10, 2, 0.1, 2)),
    ],
}  # fmt: skip


@pytest.mark.parametrize("part", REFUSED)
def test_what_cannot_be_is_refused_with_a_remedy(part: str) -> None:
    check_refused(REFUSED[part])
