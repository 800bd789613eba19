"""Charts: adding and subtracting undo each other, means are where their residuals vanish, plain numbers stay plain."""

import math
from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings, strategies as st

from pfbench.core.chart import (
    AngleBlock,
    Chart,
    ChartBlock,
    EuclideanBlock,
    LieGroupBlock,
    QuaternionBlock,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
    wrap_angle,
)
from pfbench.core.random_stream import PhiloxStream

MIXED = Chart((EuclideanBlock(2), QuaternionBlock(), AngleBlock(1), EuclideanBlock(1)))


def normal(*shape: int, purpose: str = "x") -> torch.Tensor:
    return PhiloxStream(5, torch.arange(shape[0])).normal(purpose, shape[1], shape[2])


def states(runs: int, n: int) -> torch.Tensor:
    """Random states of the mixed chart: unit quaternions and angles in range."""
    x = normal(runs, n, 8)
    q = x[..., 2:6]
    return torch.cat(
        [x[..., :2], q / q.norm(dim=-1, keepdim=True), wrap_angle(3 * x[..., 6:7]), x[..., 7:]], -1
    )


def test_sizes() -> None:
    assert (MIXED.size, MIXED.dimension, MIXED.flat) == (8, 7, False)
    assert Chart((EuclideanBlock(2), EuclideanBlock(3))).flat


def test_subtract_undoes_add() -> None:
    x, d = states(20, 50), 0.7 * normal(20, 50, 7, purpose="d")
    assert torch.allclose(MIXED.subtract(MIXED.add(x, d), x), d, atol=1e-12)


def test_add_undoes_subtract_up_to_the_sign_of_a_quaternion() -> None:
    x, y = states(20, 50), states(20, 50).flip(1)
    back = MIXED.add(x, MIXED.subtract(y, x))
    sign = torch.sign((back[..., 2:6] * y[..., 2:6]).sum(-1, keepdim=True))
    assert torch.allclose(back[..., 2:6] * sign, y[..., 2:6], atol=1e-12)
    assert torch.allclose(back[..., [0, 1, 7]], y[..., [0, 1, 7]], atol=1e-12)
    assert torch.allclose(
        wrap_angle(back[..., 6] - y[..., 6]), torch.zeros(20, 50, dtype=torch.float64), atol=1e-12
    )


def test_differences_take_the_short_way_round() -> None:
    d = MIXED.subtract(states(20, 50), states(20, 50).flip(1))
    assert float(d[..., 2:5].norm(dim=-1).max()) <= math.pi + 1e-12
    assert float(d[..., 5].abs().max()) <= math.pi


@given(st.floats(-1e3, 1e3))
@settings(deadline=None, max_examples=300)
def test_wrap_keeps_the_angle(angle: float) -> None:
    wrapped = float(wrap_angle(torch.tensor(angle, dtype=torch.float64)))
    assert -math.pi <= wrapped <= math.pi
    assert math.isclose(math.cos(wrapped), math.cos(angle), abs_tol=1e-12)
    assert math.isclose(math.sin(wrapped), math.sin(angle), abs_tol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_small_angles_keep_all_their_digits(dtype: torch.dtype) -> None:
    # arcseconds are 5e-6 rad; shifting by pi and back would leave them two digits in single precision
    angle = torch.tensor([5e-6, -3e-9, 1.0, 0.0], dtype=dtype)
    assert torch.equal(wrap_angle(angle), angle)


def test_angles_average_across_the_cut() -> None:
    x = torch.tensor([[[math.pi - 0.1], [-math.pi + 0.3]]], dtype=torch.float64)
    w = torch.tensor([[0.75, 0.25]], dtype=torch.float64)
    assert float(Chart((AngleBlock(1),)).mean(x, w).abs()) == pytest.approx(math.pi, abs=1e-12)


def test_a_pair_of_opposite_turns_averages_to_its_middle() -> None:
    chart = Chart((QuaternionBlock(),))
    q = states(1, 1)[..., 2:6]
    d = 0.8 * normal(1, 1, 3, purpose="d")
    pair = torch.cat([chart.add(q, d), -chart.add(q, -d)], 1)  # -q is the same attitude
    mean = chart.mean(pair, torch.full((1, 2), 0.5, dtype=torch.float64))
    assert float((mean * q[:, 0]).sum().abs()) == pytest.approx(1.0, abs=1e-12)


def test_residuals_about_the_mean_vanish() -> None:
    """The definition of a mean on a curved space. Each pass leaves a fraction of about spread^2 / 4 of the residual."""
    centre = states(6, 1)
    x = MIXED.add(centre.expand(-1, 40, -1), 0.4 * normal(6, 40, 7, purpose="d"))
    w = torch.softmax(normal(6, 40, 1, purpose="w")[..., 0], -1)
    for passes, slack in ((3, 1e-4), (30, 1e-14)):
        mean = MIXED.mean(x, w, passes)
        assert (
            float((w.unsqueeze(-1) * MIXED.subtract(x, mean.unsqueeze(1))).sum(1).abs().max())
            < slack
        )


def test_plain_numbers_take_the_plain_path() -> None:
    chart = Chart((EuclideanBlock(2), EuclideanBlock(3)))
    x, d = normal(4, 9, 5), normal(4, 9, 5, purpose="d")
    w = torch.softmax(normal(4, 9, 1, purpose="w")[..., 0], -1)
    assert torch.equal(chart.add(x, d), x + d)
    assert torch.equal(chart.subtract(x, d), x - d)
    assert torch.allclose(chart.mean(x, w), (w.unsqueeze(-1) * x).sum(1), rtol=1e-13)
    # a curved chart without curvature in its data averages like a plain one
    curved = Chart((EuclideanBlock(4), AngleBlock(1)))
    assert torch.allclose(curved.mean(0.1 * x, w), (w.unsqueeze(-1) * 0.1 * x).sum(1), atol=1e-14)


BLOCKS = [
    EuclideanBlock(2), AngleBlock(1), QuaternionBlock(),
    *(LieGroupBlock(size, side) for size in (4, 7, 10) for side in ("left", "right")),
]  # fmt: skip


@pytest.mark.parametrize("block", BLOCKS, ids=str)
def test_volumes_are_those_of_small_boxes_of_differences(block: ChartBlock) -> None:
    """By derivatives: a rotation moves by the vector of a small turn, all else by its numbers."""
    has_turn = block.size != block.dimension

    def move(d: torch.Tensor, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        after = block.add(x, d)
        if not has_turn:
            return after
        turn = QuaternionBlock().subtract(after[:4], y[:4])
        return torch.cat([turn, after[4:]])

    for k in range(3):
        x = normal(1, 3, block.size)[0, k]
        if has_turn:
            x = torch.cat([x[:4] / x[:4].norm(), x[4:]])
        d = 0.6 * normal(1, 3, block.dimension, purpose="d")[0, k]
        slopes = torch.func.jacfwd(move)(d, x, block.add(x, d))
        assert float(block.log_volume(d)) == pytest.approx(float(torch.linalg.slogdet(slopes)[1]), abs=1e-7)  # fmt: skip


@pytest.mark.parametrize("length", [0.0, 1e-7, 9e-5, 1.1e-4, 0.3])
@pytest.mark.parametrize(
    "f",
    [
        quaternion_from_rotation_vector,
        lambda r: rotation_vector_from_quaternion(torch.cat([1.0 - 2.0 * r.square().sum(-1, keepdim=True), r], -1)),
        lambda r: QuaternionBlock().log_volume(r)[..., None],
    ],
    ids=["to_quaternion", "from_quaternion", "volume"],
)  # fmt: skip
def test_slopes_and_bends_of_turns_are_finite_differences_at_no_turn_too(
    f: Callable[[torch.Tensor], torch.Tensor], length: float
) -> None:
    """The EKF differentiates a step and its likelihood again. Steps of 1e-4 span both branches; errors of differences are below 1e-8."""
    at = length * torch.tensor([0.6, -0.48, 0.64], dtype=torch.float64)
    h = 1e-4 * torch.eye(3, dtype=torch.float64)
    slope = torch.func.jacrev(f)
    torch.testing.assert_close(slope(at), ((f(at + h) - f(at - h)) / 2e-4).mT, rtol=0, atol=1e-6)
    bends = torch.stack([(slope(at + e) - slope(at - e)) / 2e-4 for e in h], -1)
    for bend in (torch.func.jacfwd(slope), torch.func.jacrev(torch.func.jacfwd(f))):
        torch.testing.assert_close(bend(at), bends, rtol=0, atol=1e-6)
