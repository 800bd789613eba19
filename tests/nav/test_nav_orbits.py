"""Satellites: mechanics, foreign libraries, and positions that an independent program computed from the same ephemerides."""

import math
from datetime import datetime
from pathlib import Path

import numpy as np
import pandas as pd
import pymap3d
import pytest
import torch
from ephemeris_cases import EPHEMERIDES, as_rinex, later_by_two_hours
from recorded_data import DATA, recorded
from refusals import check_refused
from torch import Tensor

from pfbench.logs.sky.broadcast_orbits import BroadcastConstellation
from pfbench.logs.sky.ephemeris import GM_GPS, read_rinex
from pfbench.logs.sky.ephemeris_checks import J2, compute_gravity
from pfbench.logs.units import WEEK
from pfbench.nav import earth
from pfbench.nav.orbits import (
    GPS_OMEGA,
    LIGHT,
    Constellation,
    WalkerConstellation,
    azimuth_elevation,
    eccentric_anomaly,
    receive_signals,
    sagnac,
)

TIMES = torch.arange(0.0, 7200.0, 240.0, dtype=torch.float64) + 13.0
NOON = (datetime(2016, 6, 6, 12) - datetime(1980, 1, 6)).total_seconds()

HARMONICS, DRIFTS = ("cuc", "cus", "crc", "crs", "cic", "cis"), ("deltan", "Omegadot", "idot")
KEPLER = EPHEMERIDES.assign(**dict.fromkeys(HARMONICS + DRIFTS, 0.0))


def exact(x: object) -> Tensor:
    return torch.tensor(x, dtype=torch.float64)


def written(
    folder: Path, table: pd.DataFrame = EPHEMERIDES, begin: str | float = "2016-06-06T12:00:00"
) -> BroadcastConstellation:
    table.to_parquet(folder / "eph.parquet")
    return BroadcastConstellation(str(folder), "eph.parquet", begin)


def inertial(constellation: Constellation, time: Tensor, rate: float) -> tuple[Tensor, Tensor]:
    """Positions and velocities in the frame that does not turn and coincides with the Earth's at t = 0."""
    place, velocity = constellation.at(time)
    turn = torch.tensor([0.0, 0.0, rate], dtype=torch.float64)
    velocity = velocity + torch.linalg.cross(turn.expand_as(place), place)
    s, c, o = torch.sin(rate * time), torch.cos(rate * time), torch.zeros_like(time)
    back = torch.stack([c, -s, o, s, c, o, o, o, o + 1], -1).reshape(-1, 1, 3, 3)
    return (back @ place[..., None])[..., 0], (back @ velocity[..., None])[..., 0]


def quotient(constellation: Constellation, time: Tensor, h: float = 0.5) -> Tensor:
    return (constellation.at(time + h)[0] - constellation.at(time - h)[0]) / (2 * h)


# nominal constellations


def test_a_nominal_constellation_obeys_kepler() -> None:
    w = WalkerConstellation()
    place, velocity = inertial(w, TIMES, earth.OMEGA)
    a = w.semi_major_axis
    assert torch.allclose(place.norm(dim=-1), exact(a), rtol=1e-14, atol=0)
    energy = 0.5 * velocity.square().sum(-1) - earth.GM / place.norm(dim=-1)
    assert torch.allclose(energy, exact(-earth.GM / (2 * a)), rtol=1e-12, atol=0)
    spin = torch.linalg.cross(place, velocity)
    assert torch.allclose(
        spin, spin[:1].expand_as(spin), rtol=0, atol=1e-12 * math.sqrt(earth.GM * a)
    )
    tilt = torch.rad2deg(torch.acos(spin[0, :, 2] / spin[0].norm(dim=-1)))
    assert torch.allclose(tilt, exact(55.0), atol=1e-9)
    period = 2 * math.pi / w.motion
    assert period == pytest.approx(43077.6, abs=1.0)  # half a sidereal day, less 5 s: a was rounded
    again, _ = inertial(w, torch.tensor([0.0, period], dtype=torch.float64), earth.OMEGA)
    assert (again[0] - again[1]).abs().max() < 1e-5


def test_a_nominal_constellation_is_spread_as_its_name_says() -> None:
    w = WalkerConstellation()
    place, velocity = (a[0] for a in inertial(w, torch.zeros(1, dtype=torch.float64), earth.OMEGA))
    spin = torch.linalg.cross(place, velocity)
    node = torch.rad2deg(torch.atan2(spin[:, 0], -spin[:, 1])).reshape(6, 4)
    planes = torch.arange(0.0, 360.0, 60.0, dtype=torch.float64)[:, None]
    assert ((node + 40.0 - planes + 180.0) % 360.0 - 180.0).abs().max() < 1e-9
    ascending = torch.stack([-spin[:, 1], spin[:, 0], 0 * spin[:, 0]], -1)
    along = (place * ascending).sum(-1) / ascending.norm(dim=-1)
    across = (place * torch.linalg.cross(spin, ascending)).sum(-1) / (
        spin.norm(dim=-1) * ascending.norm(dim=-1)
    )
    ahead = torch.rad2deg(torch.atan2(across, along)).reshape(6, 4)
    wanted = 40.0 + 90.0 * torch.arange(4) + 15.0 * torch.arange(6)[:, None]
    assert ((ahead - wanted + 180.0) % 360.0 - 180.0).abs().max() < 1e-9
    assert len(set(w.names)) == 24


def test_eight_satellites_of_the_nominal_constellation_stay_above_ten_degrees() -> None:
    # from 26.26 N 105.89 E to 23.68 N 108.63 E in 1400 s, evenly
    way = torch.tensor([[26.26, 105.89], [24.97, 107.26], [23.68, 108.63]], dtype=torch.float64)
    receiver = torch.cat([torch.deg2rad(way), torch.full((3, 1), 300.0)], -1)
    _, elevation = azimuth_elevation(
        receiver, WalkerConstellation().at(torch.tensor([0.0, 700.0, 1400.0]))[0]
    )
    assert int((torch.rad2deg(elevation) > 10.0).all(0).sum()) == 8


def test_velocities_are_the_derivatives_of_positions(tmp_path: Path) -> None:
    for constellation in (WalkerConstellation(), written(tmp_path)):
        _, velocity = constellation.at(TIMES)
        # h^2 / 6 of the third derivative, 1e-4 m/s^3, and rounding of 4e-9 m
        assert (velocity - quotient(constellation, TIMES)).abs().max() < 1e-4


# broadcast ephemerides


def test_keplers_equation_is_solved_to_rounding() -> None:
    mean = torch.linspace(-20.0, 20.0, 2001, dtype=torch.float64)
    for e in (0.0, 0.01, 0.17, 0.5):
        anomaly, near = eccentric_anomaly(mean, exact(e))
        assert (anomaly - e * torch.sin(anomaly) - mean).abs().max() < 1e-14
        assert torch.equal(near, 1 - e * torch.cos(anomaly))


def test_an_ephemeris_without_harmonics_is_an_ellipse(tmp_path: Path) -> None:
    """Two-body mechanics in the inertial frame, with the attraction that each system's ephemerides are made with."""
    plain = written(tmp_path, KEPLER)
    place, velocity = inertial(plain, TIMES, GPS_OMEGA)
    row = EPHEMERIDES.set_index("sys").loc[["E", "G"]]
    assert plain.names == ("E14", "G07")
    size, e = (torch.tensor(row[name].to_numpy()) for name in ("sqrtA", "e"))
    gm = torch.tensor([earth.GM, GM_GPS], dtype=torch.float64)
    radius = place.norm(dim=-1)
    energy = 0.5 * velocity.square().sum(-1) - gm / radius
    assert torch.allclose(energy, (-gm / (2 * size**2)).expand_as(energy), rtol=1e-11, atol=0)
    spin = torch.linalg.cross(place, velocity)
    assert torch.allclose(
        spin.norm(dim=-1),
        (torch.sqrt(gm * (1 - e**2)) * size).expand_as(radius),
        rtol=1e-11,
        atol=0,
    )
    towards = (
        torch.linalg.cross(velocity, spin) / gm[:, None] - place / radius[..., None]
    )  # to the perigee, length e
    assert torch.allclose(towards.norm(dim=-1), e.expand_as(radius), rtol=0, atol=1e-10)
    assert torch.allclose(towards, towards[:1].expand_as(towards), rtol=0, atol=1e-10)
    tilt = torch.acos(spin[..., 2] / spin.norm(dim=-1))
    assert torch.allclose(tilt, torch.tensor(row["i0"].to_numpy()).expand_as(tilt), atol=1e-9)


def test_at_its_time_of_ephemeris_an_orbit_is_where_its_angles_say(tmp_path: Path) -> None:
    plain = written(tmp_path, KEPLER.assign(M0=0.0))
    place = plain.at(torch.zeros(1, dtype=torch.float64))[0][
        0
    ]  # noon is the time of ephemeris: at perigee
    for i, name in enumerate(("E", "G")):
        row = EPHEMERIDES[EPHEMERIDES["sys"] == name].iloc[0]
        node = row.Omega0 - GPS_OMEGA * row.toe
        turn = [
            [math.cos(node), -math.sin(node), 0],
            [math.sin(node), math.cos(node), 0],
            [0, 0, 1],
        ]
        tilt = [
            [1, 0, 0],
            [0, math.cos(row.i0), -math.sin(row.i0)],
            [0, math.sin(row.i0), math.cos(row.i0)],
        ]
        in_plane = (
            row.sqrtA**2 * (1 - row.e) * np.array([math.cos(row.omega), math.sin(row.omega), 0.0])
        )
        assert np.allclose(
            place[i].numpy(), np.array(turn) @ np.array(tilt) @ in_plane, rtol=0, atol=1e-6
        )


def test_harmonic_corrections_move_along_across_and_out(tmp_path: Path) -> None:
    base = inertial(written(tmp_path, KEPLER), TIMES, GPS_OMEGA)
    radial = base[0] / base[0].norm(dim=-1, keepdim=True)
    spin = torch.linalg.cross(*base)
    normal = spin / spin.norm(dim=-1, keepdim=True)
    node = torch.stack([-spin[..., 1], spin[..., 0], 0 * spin[..., 0]], -1)
    node = node / node.norm(dim=-1, keepdim=True)
    u = torch.atan2((torch.linalg.cross(normal, node) * base[0]).sum(-1), (node * base[0]).sum(-1))
    size, along = base[0].norm(dim=-1), torch.linalg.cross(normal, radial)
    for name in HARMONICS:
        value = torch.tensor(EPHEMERIDES.set_index("sys").loc[["E", "G"], name].to_numpy())
        moved = (
            inertial(
                written(tmp_path, KEPLER.assign(**{name: EPHEMERIDES[name]})), TIMES, GPS_OMEGA
            )[0]
            - base[0]
        )
        wave = value * (torch.cos(2 * u) if name.endswith("c") else torch.sin(2 * u))
        direction = {
            "u": along * size[..., None],
            "r": radial,
            "i": normal * (size * torch.sin(u))[..., None],
        }[name[1]]
        # second order in the correction: 2.7e7 m times the square of 1e-5
        assert (moved - wave[..., None] * direction).norm(dim=-1).max() < 5e-3, name


def test_the_nearest_ephemeris_is_used_and_none_beyond_its_validity(tmp_path: Path) -> None:
    plain = EPHEMERIDES.assign(af0=0.0, af1=0.0, af2=0.0)
    later = later_by_two_hours(plain).assign(af0=5e-8)
    both = written(tmp_path, pd.concat([later, plain.iloc[[0]]]))
    assert both.names == ("E14", "G07")
    times = torch.tensor([-7201.0, -7199.0, 3599.0, 3601.0, 14399.0, 14401.0], dtype=torch.float64)
    offset, _ = both.clock(times)
    late = torch.tensor(
        [[False, False], [False, False], [True, False], [True, True], [True, True], [False, False]]
    )
    known = torch.tensor(
        [[False, False], [False, True], [True, True], [True, True], [True, True], [False, False]]
    )
    assert torch.equal(offset > 2e-8, late)
    assert torch.equal(~torch.isnan(offset), known)
    for field in (*both.at(times), both.relativity(times), both.group_delay(times)):
        assert torch.equal(~torch.isnan(field.reshape(6, 2, -1)[..., 0]), known)


def test_a_second_upload_replaces_the_first_and_the_unhealthy_are_left_out(tmp_path: Path) -> None:
    again = EPHEMERIDES.assign(ttx=EPHEMERIDES["ttx"] + 60.0, af0=EPHEMERIDES["af0"] + 5e-8)
    for order in ([EPHEMERIDES, again], [again, EPHEMERIDES]):
        offset, _ = written(tmp_path, pd.concat(order)).clock(torch.zeros(1, dtype=torch.float64))
        assert torch.allclose(offset, exact([[4.8e-4, 2.3e-5]]) + 5e-8, atol=1e-9)
    assert written(tmp_path, EPHEMERIDES.assign(health=[1.0, 0.0])).names == ("E14",)


def test_weeks_roll_over_and_may_be_unknown(tmp_path: Path) -> None:
    plain = written(tmp_path).at(TIMES)[0]
    for week in (1900.0 - 1024.0, math.nan, 1900.0 + 1024.0):
        other = written(tmp_path, EPHEMERIDES.assign(week=week)).at(TIMES)[0]
        assert torch.allclose(other, plain, rtol=0, atol=1e-6)
    assert written(tmp_path, begin=NOON).epoch == written(tmp_path).epoch == 1900 * WEEK + 129600.0
    saturday = EPHEMERIDES.assign(
        toe=WEEK - 3600.0, toc=WEEK - 3600.0
    )  # the week ends while the ephemeris is in force
    week_end = written(tmp_path, saturday, 1901 * WEEK - 60.0)
    step = (
        week_end.at(torch.tensor([59.5, 60.5]))[0].diff(dim=0)[0]
        - week_end.at(torch.tensor([60.0]))[1][0]
    ).abs()
    assert step.max() < 1e-3
    sunday = EPHEMERIDES.assign(
        toe=0.0, toc=WEEK - 16.0, week=1901
    )  # the clock's time lies in the week before
    offset, _ = written(tmp_path, sunday, 1901 * WEEK).clock(torch.zeros(1, dtype=torch.float64))
    assert torch.allclose(offset[0, 1], exact(2.3e-5 + 1.3e-12 * 16.0), rtol=0, atol=1e-15)


def test_clocks_follow_their_polynomial_and_relativity(tmp_path: Path) -> None:
    b = written(tmp_path)
    offset, drift = b.clock(TIMES)
    t = TIMES + 16.0  # the GPS clock refers to 16 s before
    assert torch.allclose(offset[:, 1], 2.3e-5 + 1.3e-12 * t + 1e-18 * t**2, rtol=0, atol=1e-16)
    assert torch.allclose(drift[:, 1], 1.3e-12 + 2e-18 * t, rtol=1e-9)
    assert torch.equal(
        b.group_delay(TIMES)[0], torch.tensor([-3.0e-9, 5.1e-9], dtype=torch.float64)
    )
    plain = written(tmp_path, KEPLER)
    place, velocity = plain.at(TIMES)
    term = (
        -2 * (place * velocity).sum(-1) / LIGHT**2
    )  # the same term by another way [IS-GPS-200, 20.3.3.3.3.1]
    assert (plain.relativity(TIMES) - term).abs().max() < 1e-15
    assert term.abs().max() > 1e-7


# geometry


def test_the_earth_turns_thirty_metres_while_a_signal_flies() -> None:
    at_horizon = torch.tensor([0.0, 26.56e6, 0.0], dtype=torch.float64)
    receiver = torch.tensor([earth.A, 0.0, 0.0], dtype=torch.float64)
    flight = (at_horizon - receiver).norm() / LIGHT
    turned = sagnac(at_horizon, flight)
    assert turned.norm() == pytest.approx(26.56e6, abs=1e-6)
    assert turned[0] == pytest.approx(
        26.56e6 * math.sin(GPS_OMEGA * flight), rel=1e-12
    )  # to the East of reception's axes
    # the well-known closed form: omega (x_r y_s - y_r x_s) / c is what the range grows by, up to 30 m at the equator
    change = (turned - receiver).norm() - (at_horizon - receiver).norm()
    assert -change == pytest.approx(GPS_OMEGA * earth.A * 26.56e6 / LIGHT, rel=0.01)
    assert 30.0 < -change < 45.0
    there_and_back = sagnac(sagnac(at_horizon, flight), -flight)
    assert torch.allclose(there_and_back, at_horizon, rtol=1e-15, atol=1e-8)


def test_azimuth_and_elevation_agree_with_pymap3d() -> None:
    places = torch.tensor(
        [[0.45, 1.85, 400.0], [-1.1, -2.9, 9000.0], [0.0, 0.0, 0.0]], dtype=torch.float64
    )
    satellites = WalkerConstellation().at(torch.zeros(3, dtype=torch.float64))[0]
    azimuth, elevation = azimuth_elevation(places, satellites)
    for i, (lat, lon, h) in enumerate(places.tolist()):
        az, el, _ = pymap3d.ecef2aer(
            *satellites[i].T.numpy(), math.degrees(lat), math.degrees(lon), h
        )
        assert np.allclose(np.degrees(azimuth[i].numpy()), az, rtol=0, atol=1e-8)
        assert np.allclose(np.degrees(elevation[i].numpy()), el, rtol=0, atol=1e-8)


def test_light_time_is_solved_in_the_frame_that_does_not_turn() -> None:
    """|satellite at transmission - receiver at reception|, both in inertial axes, is c times the time between them."""
    w, time = WalkerConstellation(), torch.tensor([100.0, 900.0], dtype=torch.float64)
    receivers = earth.ecef(
        torch.tensor([[0.45, 1.85, 400.0], [0.46, 1.86, 500.0]], dtype=torch.float64)
    )
    signal = receive_signals(w, time, receivers)
    assert signal.pos.shape == signal.vel.shape == (2, 24, 3)
    for t in range(2):
        angle = earth.OMEGA * time[t]
        s, c = math.sin(angle), math.cos(angle)
        here = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64) @ receivers[t]
        sent = time[t] - signal.flight_time[t]
        there = torch.stack([inertial(w, sent[i : i + 1], earth.OMEGA)[0][0, i] for i in range(24)])
        # 0.01 mm for the last digits of the Earth's rate, and rounding
        assert ((there - here).norm(dim=-1) - signal.range[t]).abs().max() < 2e-5
    batch = receive_signals(w, time, receivers.expand(3, 2, 3))
    assert torch.equal(batch.range[1], signal.range)


def test_the_range_changes_as_position_and_velocity_say() -> None:
    h, receiver = 0.5, earth.ecef(torch.tensor([0.45, 1.85, 400.0], dtype=torch.float64))
    times = torch.tensor([100.0 - h, 100.0, 100.0 + h], dtype=torch.float64)
    signal = receive_signals(WalkerConstellation(), times, receiver.expand(3, 3))
    sight = (signal.pos[1] - receiver) / signal.range[1, :, None]
    rate = (sight * signal.vel[1]).sum(-1)
    true = (signal.range[2] - signal.range[0]) / (2 * h)
    inertial_velocity = signal.vel[1] + torch.linalg.cross(
        exact([0.0, 0.0, earth.OMEGA]).expand(24, 3), signal.pos[1]
    )
    slower = 1 + (sight * inertial_velocity).sum(-1) / LIGHT
    assert (true - rate / slower).abs().max() < 1e-4
    assert (true - rate).abs().max() < 3e-3  # what the docstring calls a millionth


# files


def test_faulty_files_say_what_to_do(tmp_path: Path) -> None:
    without = EPHEMERIDES.drop(columns=["sqrtA", "cic"])
    check_refused([
        (r"data\.root is not set.*PFBENCH_DATA.*folder of a/b\.16n", lambda: BroadcastConstellation(None, "a/b.16n", 0.0).names),
        (r"without .*b\.16n. Set the environment variable", lambda: BroadcastConstellation(str(tmp_path), "b.16n", 0.0).names),
        (r"start_s must be within .*got 2020-01-01.*Give a time near them", lambda: written(tmp_path, begin="2020-01-01").names),
        (r"must include sqrtA, cic", lambda: written(tmp_path, without).names),
    ], remedy=False)  # fmt: skip


@pytest.mark.parametrize("version", [2, 3])
def test_rinex_files_are_read(tmp_path: Path, version: int) -> None:
    (tmp_path / "nav.rnx").write_text(as_rinex(version))
    read = BroadcastConstellation(str(tmp_path), "nav.rnx", NOON)
    plain = written(tmp_path)
    some = slice(0, 2) if version == 3 else slice(1, 2)
    assert read.names == plain.names[some]
    for ours, theirs in zip(
        (*read.at(TIMES), *read.clock(TIMES)), (*plain.at(TIMES), *plain.clock(TIMES)), strict=True
    ):
        assert torch.allclose(ours, theirs[:, some], rtol=1e-11, atol=1e-3)
    assert torch.allclose(read.group_delay(TIMES), plain.group_delay(TIMES)[:, some], rtol=1e-11)


def test_rinex_files_that_are_none_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "nav.rnx"
    for text, message in (
        ("", "must be a RINEX 2, 3 or 4"),
        (as_rinex(2).replace("N: GPS", "O: GPS"), r"got a observation file of RINEX 2\.00"),
        (as_rinex(2).replace("N: GPS", "G: GLO"), r"got a GLONASS navigation file of RINEX 2\.00"),
        (as_rinex(3).replace("3.00", "5.00", 1), r"got a GPS navigation file of RINEX 5\.00"),
        ("\x1f\x8b\x08", "got a compressed file. Unpack it with gunzip"),
        (
            as_rinex(2).replace("9.600000000000D-01", "9.6x000000000D-01"),
            r"line 3, .*expected a number like",
        ),
        ("\n".join(as_rinex(3).splitlines()[:8]), r"line 3, .*must have 8 lines, got 6"),
        ("\n".join(as_rinex(2).splitlines()[:2]), "must contain ephemerides of GPS or Galileo"),
    ):
        file.write_text(text)
        with pytest.raises(ValueError, match=message):
            read_rinex(file)


# recorded ephemerides


def day(name: str) -> BroadcastConstellation:
    return BroadcastConstellation(DATA, f"gnss_orbits/{name}", "2016-06-06T00:00:00")


@recorded
def test_the_two_files_of_one_day_are_one() -> None:
    times = torch.arange(0.0, 86400.0, 900.0, dtype=torch.float64)
    text, table = day("brdc1580.16n"), day("gps_broadcast_2016_158.parquet")
    assert text.names == table.names
    assert len(text.names) == 31
    assert torch.allclose(text.at(times)[0], table.at(times)[0], rtol=0, atol=1e-6)
    radius = text.at(times)[0].norm(dim=-1)
    assert 25.9e6 < float(radius.min()) < float(radius.max()) < 27.3e6  # NaN would fail
    assert [note[:45] for note in text.notes] == [
        "gnss_orbits/brdc1580.16n: an ephemeris of G14",  # 42 159 km, for two hours
        "gnss_orbits/brdc1580.16n: 14 ephemerides are ",  # unhealthy: G04
    ]


@recorded
def test_orbits_join_where_ephemerides_change() -> None:
    b = day("brdc1580.16n")
    table = read_rinex(Path(DATA or "") / "gnss_orbits" / "brdc1580.16n").rows
    toes = [np.unique(part) for name, part in table.groupby("prn")["toe"]]
    changes = exact(
        np.unique(np.concatenate([(part[1:] + part[:-1]) / 2 for part in toes])) - 86400.0
    )
    before, after = (b.at(changes + h)[0] for h in (-0.5, 0.5))
    jump = (after - before - b.at(changes + 0.5)[1] + 0.0).norm(dim=-1)
    real = jump > 0.5
    assert int(real.sum()) > 50
    assert float(jump.max()) < 6.0  # metres, the accuracy of broadcast orbits


@recorded
def test_satellites_and_clocks_agree_with_an_independent_program() -> None:
    """The walk's satellites as its own decoder computed them, turned by pr / c into the axes of reception."""
    table = pd.read_parquet(Path(DATA or "") / "walk_tc_mems" / "pseudorange.parquet")
    begin = 2381 * WEEK + 408641.0
    b = BroadcastConstellation(DATA, "walk_tc_mems/ephemeris.parquet", begin)
    row = torch.arange(len(table))
    which = torch.tensor(
        [b.names.index(f"{s}{n:02d}") for s, n in zip(table["sys"], table["svid"], strict=True)]
    )
    flight = torch.tensor(table["pr"].to_numpy()) / LIGHT
    sent = torch.tensor(table["tow"].to_numpy()) - 408641.0 - flight
    sent = sent - b.clock(sent)[0][row, which]
    place, velocity = (sagnac(a[row, which], flight).numpy() for a in b.at(sent))
    off = np.linalg.norm(place - table[["sx", "sy", "sz"]].to_numpy(), axis=1)
    gps = (table["sys"] == "G").to_numpy()
    assert off[gps].max() < 1e-3  # half a microsecond of rounding in tow
    assert off.max() < 1.1  # its Galileo satellites are late by 50 to 270 microseconds
    assert np.linalg.norm(velocity - table[["svx", "svy", "svz"]].to_numpy(), axis=1).max() < 1e-3
    clock = b.clock(sent)[0] + b.relativity(sent) - b.group_delay(sent)
    # theirs differs by a microsecond in the time of the eccentric satellite's relativistic term
    assert np.abs(LIGHT * clock[row, which].numpy() - table["sclk"].to_numpy()).max() < 1e-5
    receiver = torch.tensor(
        [math.radians(40.0967388700055), math.radians(-105.14708736222939), 1577.4],
        dtype=torch.float64,
    )
    azimuth, elevation = azimuth_elevation(receiver, torch.from_numpy(place))
    assert np.allclose(np.degrees(elevation.numpy()), table["el"], atol=0.01)
    assert np.allclose((np.degrees(azimuth.numpy()) - table["az"] + 180) % 360 - 180, 0, atol=0.01)


def three(first: pd.DataFrame = EPHEMERIDES) -> pd.DataFrame:
    """Ephemerides that agree with their neighbours, whatever the first ones are."""
    second = later_by_two_hours(first)
    return pd.concat([first, second, later_by_two_hours(second)], ignore_index=True)


def notes_of(folder: Path, table: pd.DataFrame) -> list[str]:
    table.to_parquet(folder / "eph.parquet")
    constellation = BroadcastConstellation(str(folder), "eph.parquet", "2016-06-06T12:00:00")
    return [note for note in constellation.notes if "contradict gravity" in note]


def test_gravity_is_the_gradient_of_its_potential() -> None:
    position = torch.tensor([[2.1e7, -9e6, 1.3e7], [1e6, 2e7, -1.9e7]], dtype=torch.float64)
    position.requires_grad_()
    radius = position.norm(dim=-1)
    legendre = 1.5 * (position[:, 2] / radius) ** 2 - 0.5
    potential = earth.GM / radius * (1.0 - J2 * (earth.A / radius) ** 2 * legendre)
    (gradient,) = torch.autograd.grad(potential.sum(), position)
    torch.testing.assert_close(compute_gravity(position), gradient, rtol=1e-12, atol=0.0)


@pytest.mark.parametrize(
    ("column", "factor"),
    [
        ("crc", -1.0),
        ("crc", 1 / 3.6),
        ("deltan", 1 / 3.6),
        ("Omegadot", math.pi / 180),
        ("i0", 1.2),
    ],
)
def test_a_factor_in_all_records_is_a_note(tmp_path: Path, column: str, factor: float) -> None:
    assert notes_of(tmp_path, three()) == []
    wrong = EPHEMERIDES.assign(**{column: EPHEMERIDES[column] * factor})
    (note,) = notes_of(tmp_path, three(wrong))
    assert "Check the units" in note


@pytest.mark.skipif(DATA is None, reason="the recorded ephemerides are not installed")
def test_a_day_of_recorded_ephemerides_follows_gravity() -> None:
    constellation = BroadcastConstellation(
        str(DATA), "gnss_orbits/brdc1580.16n", "2016-06-06T12:00:00"
    )
    assert len(constellation.names) > 25
    assert not [note for note in constellation.notes if "gravity" in note]
