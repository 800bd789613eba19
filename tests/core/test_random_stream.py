"""Draws: the published generator, the right laws, and numbers that depend on nothing but their address."""

import numpy as np
import pytest
import torch
from scipy import stats

from pfbench.core.random_stream import PhiloxStream


def source(seed: int = 3, runs: int = 8, dtype: torch.dtype = torch.float64) -> PhiloxStream:
    return PhiloxStream(seed, torch.arange(runs), dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_normals_have_the_standard_normal_law(dtype: torch.dtype) -> None:
    z = source(dtype=dtype).at_step(5).normal("noise", 50_000, 1).numpy().astype(float)
    assert stats.kstest(z.ravel(), "norm").pvalue > 1e-3
    n = z.size
    # standard errors of the first four moments of a standard normal sample
    for power, expected, variance in ((1, 0.0, 1.0), (2, 1.0, 2.0), (3, 0.0, 15.0), (4, 3.0, 96.0)):
        assert abs((z**power).mean() - expected) < 4 * np.sqrt(variance / n), power
    for bound in (2.0, 3.0, 4.0):  # 18 000, 1080 and 25 numbers lie beyond
        beyond, expected = int((np.abs(z) > bound).sum()), n * 2 * stats.norm.sf(bound)
        assert abs(beyond - expected) < 4 * np.sqrt(expected), bound


def test_single_and_double_precision_are_the_same_numbers() -> None:
    """The words of single precision are the upper ones of double precision."""
    double = source().at_step(5).normal("noise", 50_000, 1)
    single = source(dtype=torch.float32).at_step(5).normal("noise", 50_000, 1)
    # a radius near 0 is the root of what 24 bits leave of 1 - u, which is off by 2^-25
    assert float((double - single).abs().max()) < (2.0 * 2.0**-25) ** 0.5
    assert float((double - single).abs().median()) < 1e-7


def test_uniforms_have_the_uniform_law() -> None:
    u = source().at_step(5).uniform("noise", 50_000, 1).numpy()
    assert stats.kstest(u.ravel(), "uniform").pvalue > 1e-3


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 7, 1001])
def test_shapes_for_any_number_of_particles(n: int) -> None:
    for dtype in (torch.float32, torch.float64):
        z = source(dtype=dtype).normal("noise", n, 3)
        assert z.shape == (8, n, 3)
        assert z.dtype == dtype
    u = source().uniform("noise", n, 3)
    assert u.shape == (8, n, 3)
    assert u.dtype == torch.float64
    assert (
        torch.unique(u).numel() == u.numel()
    )  # 2**-32 coincidences do not happen here: no number is used twice


def streams() -> dict[str, torch.Tensor]:
    s = source(runs=2)
    n = 40_000
    return {
        "itself": s.at_step(1).normal("a", n, 2)[0, :, 0],
        "run": s.at_step(1).normal("a", n, 2)[1, :, 0],
        "component": s.at_step(1).normal("a", n, 2)[0, :, 1],
        "purpose": s.at_step(1).normal("b", n, 2)[0, :, 0],
        "end of a purpose": s.at_step(1).normal("ab", n, 2)[0, :, 0],
        "step": s.at_step(2).normal("a", n, 2)[0, :, 0],
        "seed": source(4, 2).at_step(1).normal("a", n, 2)[0, :, 0],
        "lag": s.at_step(1).normal("a", n, 2)[0, :, 0].roll(1),
        "lag of a quarter": s.at_step(1)
        .normal("a", n, 2)[0, :, 0]
        .roll(n // 4),  # the four words of one counter
    }


def test_streams_are_independent() -> None:
    all_of_them = streams()
    z = all_of_them.pop("itself").numpy()
    for name, other in all_of_them.items():
        for a, b in (
            (z, other.numpy()),
            (z**2 - 1, other.numpy() ** 2 - 1),
        ):  # Box and Muller's pairs share a radius
            correlation = np.mean(a * b) / np.sqrt(np.mean(a**2) * np.mean(b**2))
            assert abs(correlation) < 4.5 / np.sqrt(len(z)), name


def test_a_run_alone_equals_itself_in_a_batch() -> None:
    many, one = (
        PhiloxStream(7, torch.arange(50)).at_step(9),
        PhiloxStream(7, torch.tensor([31])).at_step(9),
    )
    assert torch.equal(many.normal("x", 333, 5)[31:32], one.normal("x", 333, 5))
    assert torch.equal(many.uniform("x", 333, 5)[31:32], one.uniform("x", 333, 5))
    shuffled = PhiloxStream(7, torch.tensor([31, 2, 40])).at_step(9)
    assert torch.equal(shuffled.normal("x", 333, 5), many.normal("x", 333, 5)[[31, 2, 40]])


def test_drawing_leaves_the_global_generator_alone() -> None:
    before = torch.random.get_rng_state()
    source().normal("x", 10, 2)
    source().uniform("x", 10, 2)
    assert torch.equal(before, torch.random.get_rng_state())


@pytest.mark.parametrize("seed", [-1, 2**32])
def test_a_seed_out_of_range_is_refused(seed: int) -> None:
    with pytest.raises(ValueError, match=f"seed must be .*, got {seed}"):
        PhiloxStream(seed, torch.arange(2))
