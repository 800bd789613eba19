"""Attitude: representations agree with each other, with the matrix exponential and with a foreign library."""

import ahrs
import numpy as np
import pytest
import torch
from torch import Tensor

from pfbench.core import chart
from pfbench.core.random_stream import PhiloxStream
from pfbench.nav import attitude as at


def uniform(n: int, low: float, high: float, width: int = 3, seed: int = 5) -> Tensor:
    return low + (high - low) * PhiloxStream(seed, torch.arange(1)).uniform("test", n, width)[0]


EULER = uniform(500, -1, 1) * torch.tensor([1.57, 3.14, 3.14])
NONE = torch.zeros(1, 3, dtype=torch.float64)
ROTATION = torch.cat(
    [uniform(200, -2.2, 2.2), uniform(50, -1e-5, 1e-5), uniform(50, -1e-10, 1e-10), NONE]
)
EYE = torch.eye(3, dtype=torch.float64)


def apart(a: Tensor, b: Tensor) -> float:
    return (a - b).abs().max().item()


def test_skew_is_the_cross_product():
    a, b = uniform(20, -1, 1), uniform(20, -1, 1, seed=6)
    assert apart((at.skew(a) @ b[..., None])[..., 0], torch.linalg.cross(a, b)) < 1e-15


def test_rotation_vector_is_the_matrix_exponential():
    assert apart(at.dcm_from_rotation_vector(ROTATION), torch.matrix_exp(at.skew(ROTATION))) < 1e-12


def test_euler_angles_are_three_elementary_rotations():
    pitch, roll, yaw = (
        at.dcm_from_rotation_vector(EULER[:, k, None] * EYE[axis])
        for k, axis in enumerate((0, 1, 2))
    )
    assert apart(at.dcm_from_euler(EULER), yaw @ pitch @ roll) < 1e-14


def test_signs_are_those_of_an_aircraft():
    angles = torch.tensor([0.1, 0.1, -np.pi / 2], dtype=torch.float64)
    nose_up, right_wing_down, to_the_east = at.dcm_from_euler(torch.diag(angles))
    assert nose_up[2, 1] > 0.09
    assert right_wing_down[2, 0] < -0.09
    assert apart(to_the_east @ EYE[1], EYE[0]) < 1e-15


def test_matrices_are_rotations():
    for c in (at.dcm_from_euler(EULER), at.dcm_from_rotation_vector(ROTATION)):
        assert apart(c @ c.transpose(-1, -2), EYE.expand_as(c)) < 1e-14
        assert apart(torch.linalg.det(c), torch.ones(len(c), dtype=torch.float64)) < 1e-14


def test_euler_round_trip():
    # roll and yaw are lost at a pitch of 90 degrees: their error grows like 1 / cos pitch, here up to 1000
    assert apart(at.euler_from_dcm(at.dcm_from_euler(EULER)), EULER) < 1e-12


def test_pitch_survives_ninety_degrees():
    steep = torch.tensor([[np.pi / 2 - 1e-9, 0.0, 0.3], [np.pi / 2, 0.0, 0.3]], dtype=torch.float64)
    c = at.dcm_from_euler(steep)
    c[..., 2, 1] = 1 + 1e-16
    back = at.euler_from_dcm(c)
    assert back.isfinite().all()
    assert apart(back[:, 0], steep[:, 0]) < 1e-15


def test_quaternion_round_trips():
    c = at.dcm_from_euler(EULER)
    q = at.quaternion_from_dcm(c)
    assert (q[:, 0] >= 0).all()
    assert apart(at.dcm_from_quaternion(q), c) < 1e-12
    q = chart.quaternion_from_rotation_vector(ROTATION)
    assert apart(at.dcm_from_quaternion(q), at.dcm_from_rotation_vector(ROTATION)) < 1e-12


def test_half_turns_are_found_from_the_matrix():
    # scalar part 0: the textbook formula divides by it
    half_turns = torch.cat([-EYE, EYE, uniform(20, -1, 1)])
    half_turns = half_turns / half_turns.norm(dim=-1, keepdim=True) * np.pi
    c = at.dcm_from_rotation_vector(half_turns)
    assert apart(at.dcm_from_quaternion(at.quaternion_from_dcm(c)), c) < 1e-12


def test_rotation_vector_round_trip_goes_the_short_way():
    q = chart.quaternion_from_rotation_vector(ROTATION)
    short = ROTATION.norm(dim=-1) < np.pi
    for signed in (q, -q):
        back = chart.rotation_vector_from_quaternion(signed)
        assert apart(back[short], ROTATION[short]) < 1e-12
        assert back.norm(dim=-1).max() <= np.pi
    assert (~short).any()


def test_quaternion_product_is_the_matrix_product():
    p, q = (
        chart.quaternion_from_rotation_vector(ROTATION),
        chart.quaternion_from_rotation_vector(ROTATION.flip(0)),
    )
    product = at.dcm_from_quaternion(chart.quaternion_multiply(p, q))
    assert apart(product, at.dcm_from_quaternion(p) @ at.dcm_from_quaternion(q)) < 1e-14


def test_quaternions_agree_with_ahrs():
    p, q = (
        chart.quaternion_from_rotation_vector(ROTATION),
        chart.quaternion_from_rotation_vector(ROTATION.flip(0)),
    )
    for a, b in zip(p[:40], q[:40], strict=True):
        theirs = ahrs.Quaternion(a.numpy())
        np.testing.assert_allclose(
            chart.quaternion_multiply(a, b).numpy(), theirs.product(b.numpy()), atol=1e-14
        )
        np.testing.assert_allclose(at.dcm_from_quaternion(a).numpy(), theirs.to_DCM(), atol=1e-14)


def test_gradients_are_finite_at_no_rotation():
    r = NONE.clone().requires_grad_()
    there_and_back = chart.rotation_vector_from_quaternion(chart.quaternion_from_rotation_vector(r))
    there_and_back.sum().backward()
    assert apart(r.grad, torch.ones(1, 3)) < 1e-15
    r.grad = None
    at.dcm_from_rotation_vector(r)[..., 2, 1].sum().backward()
    assert apart(r.grad, EYE[:1]) < 1e-15


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_kind_of_number_is_kept(dtype):
    r = ROTATION.to(dtype)
    q = chart.quaternion_from_rotation_vector(r)
    made = (
        q,
        at.dcm_from_quaternion(q),
        chart.rotation_vector_from_quaternion(q),
        at.dcm_from_rotation_vector(r),
    )
    assert {a.dtype for a in made} == {dtype}


def test_attitude_error_is_recovered_whatever_its_size():
    alpha = uniform(100, -1.5, 1.5)
    c_true = at.dcm_from_euler(EULER[:100])
    c_ins = at.dcm_from_euler(alpha).transpose(-1, -2) @ c_true
    assert apart(at.attitude_error(c_true, c_ins), alpha) < 1e-12


def test_small_attitude_error_is_a_rotation_vector():
    alpha = uniform(100, -1e-4, 1e-4)
    c_true = at.dcm_from_euler(EULER[:100])
    m = at.error_dcm(c_true, at.dcm_from_euler(alpha).transpose(-1, -2) @ c_true)
    assert apart(m, EYE + at.skew(alpha)) < 2e-8  # alpha^2


def test_residual_error_is_the_error_of_the_corrected_attitude():
    alpha, guess, c_true = (
        uniform(50, -0.5, 0.5),
        uniform(50, -0.5, 0.5, seed=8),
        at.dcm_from_euler(EULER[:50]),
    )
    corrected = at.dcm_from_euler(guess) @ at.dcm_from_euler(alpha).transpose(-1, -2) @ c_true
    assert apart(at.residual_error(alpha, guess), at.attitude_error(c_true, corrected)) < 1e-12
    assert apart(at.residual_error(alpha, alpha), torch.zeros(50, 3)) < 1e-15
