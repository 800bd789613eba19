"""Draws: the published generator, the right laws, and numbers that depend on nothing but their address."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import torch
from scipy import stats

from pfbench.core import random_stream as module
from pfbench.core.random_stream import PhiloxStream, philox
from pfbench.kernels import compilation

# Random123 known-answer vectors of philox4x32 with 10 rounds: counter, key -> words
KNOWN = [
    (
        "00000000 00000000 00000000 00000000",
        "00000000 00000000",
        "6627e8d5 e169c58d bc57ac4c 9b00dbd8",
    ),
    (
        "ffffffff ffffffff ffffffff ffffffff",
        "ffffffff ffffffff",
        "408f276d 41c83b0e a20bc7c6 6d5451fd",
    ),
    (
        "243f6a88 85a308d3 13198a2e 03707344",
        "a4093822 299f31d0",
        "d16cfe09 94fdcceb 5001e420 24126ea1",
    ),
]


def hexadecimal(text: str) -> list[torch.Tensor]:
    return [torch.tensor([int(word, 16)]) for word in text.split()]


@pytest.mark.parametrize(("counter", "key", "expected"), KNOWN)
def test_philox_known_answers(counter: str, key: str, expected: str) -> None:
    words = philox(tuple(hexadecimal(counter)), tuple(hexadecimal(key)))
    assert [int(word) for word in words] == [int(word, 16) for word in expected.split()]


def source(seed: int = 3, runs: int = 8, dtype: torch.dtype = torch.float64) -> PhiloxStream:
    return PhiloxStream(seed, torch.arange(runs), dtype)


def test_normals_have_the_standard_normal_law() -> None:
    z = source().at_step(5).normal("noise", 50_000, 1).numpy()
    assert stats.kstest(z.ravel(), "norm").pvalue > 1e-3
    n = z.size
    # standard errors of the first four moments of a standard normal sample
    for power, expected, variance in ((1, 0.0, 1.0), (2, 1.0, 2.0), (3, 0.0, 15.0), (4, 3.0, 96.0)):
        assert abs((z**power).mean() - expected) < 4 * np.sqrt(variance / n), power


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


def test_blocks_give_the_same_numbers() -> None:
    draws = PhiloxStream(1, torch.arange(3))
    whole = module._normals(*draws._counter("x", 9000, 7)).permute(1, 2, 0)
    assert torch.equal(whole.double(), draws.normal("x", 9000, 7))


def test_drawing_leaves_the_global_generator_alone() -> None:
    before = torch.random.get_rng_state()
    source().normal("x", 10, 2)
    source().uniform("x", 10, 2)
    assert torch.equal(before, torch.random.get_rng_state())


@pytest.mark.parametrize("word", [0, 0xFFFFFFFF, 0x80000000, 0x7FFFFFFF])
def test_extreme_words(monkeypatch: pytest.MonkeyPatch, word: int) -> None:
    def constant(
        key: object, step: torch.Tensor, runs: torch.Tensor, component: torch.Tensor, quarters: int
    ):
        return (torch.full((len(runs), len(component), quarters), word),) * 4

    monkeypatch.setattr(module, "_words", constant)
    u, z = source().uniform("x", 8, 1), source().normal("x", 8, 1)
    assert bool(((u > 0.0) & (u < 1.0)).all())
    assert bool(torch.isfinite(z).all())
    assert float(z.abs().max()) < 6.8


@pytest.mark.parametrize("seed", [-1, 2**32])
def test_a_seed_out_of_range_is_refused(seed: int) -> None:
    with pytest.raises(ValueError, match=f"seed must be .*, got {seed}"):
        PhiloxStream(seed, torch.arange(2))


@pytest.mark.slow
@pytest.mark.skipif(
    not any(map(shutil.which, ("c++", "g++", "clang++"))),
    reason="no C++ compiler for torch.compile",
)
@pytest.mark.filterwarnings("ignore")  # the compiler's own
def test_compiled_normals_agree_with_eager_ones() -> None:
    runs = torch.arange(3)
    for step, n, w in (
        (1, 1000, 3),
        (2, 77, 1),
    ):  # the second call must not be read off the first shape
        eager = PhiloxStream(1, runs).at_step(step).normal("x", n, w)
        uniform = PhiloxStream(1, runs).at_step(step).uniform("x", n, w)
        with compilation.use_compiled():
            assert torch.allclose(
                eager, PhiloxStream(1, runs).at_step(step).normal("x", n, w), rtol=0, atol=1e-5
            )
            assert torch.equal(uniform, PhiloxStream(1, runs).at_step(step).uniform("x", n, w))
