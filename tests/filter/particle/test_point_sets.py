"""Points: uniform one by one, more even than chance together, fresh at each draw, and addressed like all other draws."""

import math

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

from pfbench.core.random_stream import PhiloxStream
from pfbench.filter.particle.sqmc import (
    HaltonPoints,
    SobolPoints,
    first_primes,
    halton_points,
    sobol_digits,
)
from pfbench.filter.particle.stages import IidPoints, PointSet

SETS: dict[str, PointSet] = {
    "halton": HaltonPoints(),
    "halton as printed": HaltonPoints(permute_digits=False),
    "sobol": SobolPoints(),
}
every_set = pytest.mark.parametrize("points", SETS.values(), ids=SETS.keys())


def source(runs: int = 8, seed: int = 3, dtype: torch.dtype = torch.float64) -> PhiloxStream:
    return PhiloxStream(seed, torch.arange(runs), dtype).at_step(2)


# the sets


def test_halton_begins_as_the_radical_inverse_does() -> None:
    base = halton_points(0, 6, range(0, 3))
    assert base[0].tolist() == [1 / 2, 1 / 4, 3 / 4, 1 / 8, 5 / 8, 3 / 8]
    assert base[1].tolist() == pytest.approx([1 / 3, 2 / 3, 1 / 9, 4 / 9, 7 / 9, 2 / 9], abs=1e-15)
    assert base[2].tolist() == pytest.approx(
        [1 / 5, 2 / 5, 3 / 5, 4 / 5, 1 / 25, 6 / 25], abs=1e-15
    )
    assert torch.equal(
        halton_points(20, 30, range(0, 4)), halton_points(0, 50, range(0, 4))[:, 20:]
    )
    assert torch.equal(halton_points(20, 30, range(1, 4)), halton_points(20, 30, range(0, 4))[1:])


def test_primes() -> None:
    assert first_primes(6) == [2, 3, 5, 7, 11, 13]
    assert len(first_primes(200)) == 200
    assert first_primes(200)[-1] == 1223


@pytest.mark.parametrize("permuted", [False, True])
@pytest.mark.parametrize("axis", [0, 1, 2, 5])
def test_b_to_the_k_consecutive_points_fill_as_many_intervals(axis: int, permuted: bool) -> None:
    """Points number m b^k to (m + 1) b^k - 1 in base b: one in each interval of length b^-k, whatever the digits' order."""
    b = first_primes(6)[axis]
    size = b**2
    x = halton_points(3 * size - 1, size, range(axis, axis + 1), permuted)[0]
    assert torch.floor(x * size + 1e-9).long().sort().values.tolist() == list(range(size))


def test_sobol_points_are_a_net_before_and_after_the_shift() -> None:
    """16 points: one in each of the 16 boxes of every shape 2^-a by 2^(a - 4)."""
    plain = sobol_digits(16, range(0, 2)).T.double() * 2.0**-30
    shifted = SobolPoints()(source(20)).uniform("x", 16, 2)
    for x in (plain, *shifted):
        for a in range(5):
            box = (
                torch.floor(x[:, 0] * 2**a).long() * 2 ** (4 - a)
                + torch.floor(x[:, 1] * 2 ** (4 - a)).long()
            )
            assert box.sort().values.tolist() == list(range(16))


def test_permuted_digits_part_axes_of_large_base() -> None:
    """400 points in 21 axes; independent ones are correlated by 0.05."""

    def largest(points: PointSet) -> float:
        z = points(source(20)).normal("x", 400, 21)
        rows = [np.abs(np.corrcoef(run.T.numpy()) - np.eye(21)) for run in z]
        return float(np.mean(rows, 0).max())

    assert largest(HaltonPoints()) < 0.1
    assert largest(HaltonPoints(permute_digits=False)) > 0.2


# the law of one point, and of many


@every_set
def test_each_point_is_uniform_over_shifts(points: PointSet) -> None:
    u = points(source(4000)).uniform("x", 3, 6)
    assert u.shape == (4000, 3, 6)
    assert u.dtype == torch.float64
    assert bool(((u > 0.0) & (u < 1.0)).all())
    for column in u.flatten(1).T.numpy():
        assert stats.kstest(column, "uniform").pvalue > 1e-4


@every_set
def test_axes_are_shifted_on_their_own(points: PointSet) -> None:
    u = points(source(4000)).uniform("x", 1, 6)[:, 0].numpy()
    correlation = np.corrcoef(u.T) - np.eye(6)
    assert np.abs(correlation).max() < 4.5 / math.sqrt(4000)


@every_set
def test_moments_of_normals_are_far_better_than_by_chance(points: PointSet) -> None:
    """Of N(m, S) in 4 dimensions; prototypes found the mean square error of the mean 33 to 36 times below chance's."""
    root = torch.tensor(np.linalg.cholesky(np.cov(np.random.default_rng(0).normal(size=(4, 9)))))

    def errors(p: PointSet) -> tuple[float, float]:
        x = p(source(300)).normal("x", 400, 4) @ root.T
        variance = root.square().sum(1)
        mean = (x.mean(1).square() / variance).mean()
        return float(mean), float((x.var(1) / variance - 1.0).square().mean())

    (mean_0, spread_0), (mean, spread) = errors(IidPoints()), errors(points)
    assert mean_0 == pytest.approx(1 / 400, rel=0.3)
    assert mean < mean_0 / 10
    assert spread < spread_0 / 5


@every_set
def test_averages_are_unbiased(points: PointSet) -> None:
    z = points(source(4000)).normal("x", 7, 2)
    for value in (
        z[..., 0].mean(1),
        (z[..., 0] * z[..., 1]).mean(1),
        (z[..., 1] > 1.0).double().mean(1) - stats.norm.sf(1.0),
    ):
        assert abs(float(value.mean())) < 4.5 * float(value.std()) / math.sqrt(4000)


# addresses


@every_set
def test_stages_that_share_a_set_draw_its_points_together(points: PointSet) -> None:
    """Base points of two stages are those of one set; on the same axes they would be the same but for the shift."""
    draws = source(300)
    wanted = (("a", 0, 3), ("b", 3, 2), ("b", 0, 3))
    ahead, behind, again = (points(draws, first).normal(name, 400, w) for name, first, w in wanted)
    both = torch.cat([ahead, behind], -1)

    def off(z: Tensor) -> Tensor:
        c = z.mT @ z / 400
        return (c - torch.diag_embed(c.diagonal(dim1=1, dim2=2))).square().mean((1, 2)).mean()

    chance = off(source(300).normal("c", 400, 5))
    assert float(off(both)) < 0.5 * float(chance)
    assert float(off(torch.cat([ahead, again], -1))) > 4 * float(chance)


@every_set
def test_draws_are_fresh_for_each_run_step_purpose_and_seed(points: PointSet) -> None:
    p = points(source())
    x = p.uniform("a", 5, 2)
    others = [
        p.at_step(3).uniform("a", 5, 2),
        p.uniform("b", 5, 2),
        points(source(seed=4)).uniform("a", 5, 2),
        x.roll(1, 0),
    ]
    assert all(float((x - other).abs().min()) > 0.0 for other in others)
    assert torch.equal(p.at_step(2).uniform("a", 5, 2), x)


@every_set
def test_a_run_alone_draws_what_it_draws_in_a_batch(points: PointSet) -> None:
    many, one = points(source(50)), points(PhiloxStream(3, torch.tensor([31])).at_step(2))
    assert torch.equal(many.normal("x", 33, 5)[31:32], one.normal("x", 33, 5))
    before = torch.random.get_rng_state()
    points(source()).normal("x", 77, 3)
    assert torch.equal(before, torch.random.get_rng_state())


@every_set
def test_normals_come_in_the_precision_of_the_draws(points: PointSet) -> None:
    for dtype in (torch.float32, torch.float64):
        p = points(source(dtype=dtype))
        assert p.dtype == dtype
        assert p.normal("x", 9, 2).dtype == dtype
        assert bool(torch.isfinite(p.normal("x", 1000, 2)).all())


def test_independent_points_are_the_draws_themselves() -> None:
    draws = source()
    assert IidPoints()(draws, 3) is draws


def test_shifts_at_the_edge_stay_inside() -> None:
    for edge in (0.0, 1.0 - 2.0**-33):
        shift = torch.full((2, 1, 1), edge, dtype=torch.float64)
        for points in (HaltonPoints(0), SobolPoints()):
            u = points.shift_points(range(0, 2), 64, shift)
            assert bool(((u > 0.0) & (u < 1.0)).all())
