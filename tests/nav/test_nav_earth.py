"""The Earth model against closed forms and three foreign libraries."""

import ahrs
import numpy as np
import pymap3d
import pyproj
import pytest
import torch
from pymap3d import rcurve
from torch import Tensor

from pfbench.nav import attitude, earth

B = earth.A * (1 - earth.F_E)
LAT = torch.linspace(-1.5, 1.5, 13, dtype=torch.float64)
PLACES = torch.tensor(
    [[0.0, 0.0, 0.0], [0.6, 1.9, 400.0], [-1.2, -3.0, 9000.0], [1.5, 2.0, -50.0], [0.9, -0.1, 3e5]],
    dtype=torch.float64,
)


def degrees(pos: Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.degrees(pos[..., 0].numpy()), np.degrees(pos[..., 1].numpy()), pos[..., 2].numpy()


def test_radii_at_equator_and_pole():
    r_m, r_n = earth.radii(torch.tensor([0.0, torch.pi / 2], dtype=torch.float64))
    assert r_m.tolist() == pytest.approx([B**2 / earth.A, earth.A**2 / B], rel=1e-14)
    assert r_n.tolist() == pytest.approx([earth.A, earth.A**2 / B], rel=1e-14)


def test_radii_agree_with_pymap3d():
    lat = np.degrees(LAT.numpy())
    r_m, r_n = earth.radii(LAT)
    np.testing.assert_allclose(r_m.numpy(), rcurve.meridian(lat), rtol=1e-12)
    np.testing.assert_allclose(r_n.numpy(), rcurve.transverse(lat), rtol=1e-12)


def test_gravity_at_equator_and_pole():
    g = earth.gravity(
        torch.tensor([0.0, torch.pi / 2], dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    )
    assert g[0] == pytest.approx(9.7803253359, abs=1e-12)
    assert g[1] == pytest.approx(
        9.8321849379, abs=1e-9
    )  # the defining value, independent of Somigliana's constant


@pytest.mark.parametrize("h", [0.0, 1000.0, 12000.0])
def test_gravity_agrees_with_ahrs(h):
    wgs = ahrs.utils.WGS()
    theirs = [wgs.normal_gravity(float(lat), h) for lat in np.degrees(LAT.numpy())]
    # they use another value of the Earth's rate in m = w^2 a^2 b / GM, beyond the eighth digit
    np.testing.assert_allclose(
        earth.gravity(LAT, torch.full_like(LAT, h)).numpy(), theirs, rtol=1e-8
    )


def test_metre_scale_agrees_with_geodesics():
    geod, step = pyproj.Geod(ellps="WGS84"), 1e-6  # 6 m
    for lat in LAT[1:-1]:
        ns, ew, _ = (earth.metre_scale(torch.stack([lat, 0 * lat, 0 * lat])) * step).tolist()
        deg, d = np.degrees(lat.item()), np.degrees(step)
        assert ns == pytest.approx(geod.inv(0, deg - d / 2, 0, deg + d / 2)[2], abs=1e-7)
        assert ew == pytest.approx(geod.inv(0, deg, d, deg)[2], abs=1e-7)


def test_ecef_agrees_with_pymap3d_and_pyproj():
    ours = earth.ecef(PLACES).numpy()
    np.testing.assert_allclose(
        ours, np.stack(pymap3d.geodetic2ecef(*degrees(PLACES)), -1), atol=2e-9, rtol=0
    )
    lat, lon, h = degrees(PLACES)
    proj = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978")
    np.testing.assert_allclose(ours, np.stack(proj.transform(lat, lon, h), -1), atol=2e-9, rtol=0)


def test_geodetic_inverts_ecef():
    more = torch.tensor(
        [[torch.pi / 2, 0.0, 100.0], [-1e-9, 0.5, 1e6], [0.7, 1.0, -1e4]], dtype=torch.float64
    )
    pos = torch.cat([PLACES, more])
    metres = (earth.geodetic(earth.ecef(pos)) - pos) * torch.tensor([earth.A, earth.A, 1.0])
    metres[5, 1] = 0.0  # longitude has no meaning at a pole
    assert metres.abs().max() < 1e-8  # 10 units in the last place of an Earth-fixed coordinate


def test_local_enu_agrees_with_pymap3d_and_inverts():
    track = PLACES[1] + torch.tensor(
        [[0.0, 0.0, 0.0], [1e-3, 0.0, 0.0], [-2e-3, 3e-3, 500.0], [0.05, 0.1, 9000.0]]
    )
    ours = earth.local_enu(track, PLACES[1])
    theirs = np.stack(pymap3d.geodetic2enu(*degrees(track), *degrees(PLACES[1])), -1)
    np.testing.assert_allclose(ours.numpy(), theirs, atol=1e-8)
    back = (earth.from_local_enu(ours, PLACES[1]) - track) * earth.metre_scale(track)
    assert back.abs().max() < 1e-8


def test_earth_rate_is_the_polar_axis_seen_from_the_level_frame():
    axis = torch.tensor([0.0, 0.0, earth.OMEGA], dtype=torch.float64)
    torch.testing.assert_close(
        earth.earth_rate(PLACES[:, 0]), earth.local_axes(PLACES) @ axis, atol=1e-19, rtol=1e-14
    )


def test_transport_rate_is_how_the_level_axes_turn():
    # d/dt C_n^e = C_n^e skew(w_en): central differences over the motion of one second at 200 m/s or so
    v = torch.tensor([150.0, -120.0, 30.0], dtype=torch.float64)
    ahead = earth.position_rate(PLACES, v) / 2
    to_earth = [earth.local_axes(PLACES + s * ahead).transpose(-1, -2) for s in (-1, 0, 1)]
    turning = to_earth[1].transpose(-1, -2) @ (to_earth[2] - to_earth[0])
    w = earth.transport_rate(PLACES[:, 0], PLACES[:, 2], v.expand(5, 3))
    # differences cancel to 1e-16; third order is w^3 / 24 < 1e-11 except next to the pole (place 3)
    error = (turning - attitude.skew(w)).abs().amax((-1, -2))
    assert (error < 1e-5 * w.norm(dim=-1)).all()


def test_position_rate_is_the_velocity_in_metres():
    v = torch.tensor([150.0, -120.0, 30.0], dtype=torch.float64)
    step = 1e-2
    moved = earth.local_enu(PLACES + earth.position_rate(PLACES, v) * step, PLACES) / step
    # curvature bends the path by v^2 step / 2R; place 3 is 0.07 rad from a pole, where parallels are tight
    assert ((moved - v).norm(dim=-1) < torch.tensor([1e-4, 1e-4, 1e-4, 1e-3, 1e-4]) * 2).all()
