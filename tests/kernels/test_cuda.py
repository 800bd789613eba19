"""The loops of particles.cu against what they stand for: on a CUDA device, and, compiled as C++ of one thread, anywhere."""

from __future__ import annotations

import ctypes
import random
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import random_calls
import torch
from torch import Tensor

from pfbench.core import linear_algebra, random_stream
from pfbench.core.random_stream import PhiloxStream
from pfbench.filter import belief
from pfbench.filter.particle import stages
from pfbench.kernels import cuda, cuda as cuda_launch, dispatch

COMPILER = next(
    (found for name in ("c++", "g++", "clang++") if (found := shutil.which(name))), None
)
CLOUDS = [(3, 30, 2), (70, 1001, 15), (5, 4096, 4), (65, 12_000, 3)]  # runs, particles, components
MOVES = [(30, 2, 1), (1001, 15, 15), (515, 4, 9), (4, 5, 3)]  # particles, components, noise
REAL = [torch.float32, torch.float64]
FINE = {torch.float32: 1e-5, torch.float64: 1e-12}

Loop = Callable[..., Any]


@pytest.fixture(scope="module")
def as_cpp(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., None]:
    """In place of `cuda.launch_kernel`: blocks one after the other, each of one thread."""
    assert COMPILER is not None
    home, header = tmp_path_factory.mktemp("cuda"), Path(__file__).parent / "cuda_on_cpu.h"
    names = ["uniforms"]
    for real in ("float", "double"):
        names.append(f"normals<{real}>")
        names += [f"{loop}<{real}>" for loop in ("copied", "systematic", "distinct")]
        names += [f"moments<{real}, {d}>" for *_, d in CLOUDS]
        names += [
            f"affine<{real}, {d}, {w}, {way}, {way}>"
            for _, d, w in MOVES
            for way in ("true", "false")
        ]
    # what a block shares is the same for all threads: of one block, plain memory
    source = re.sub(
        r"extern __shared__ (.+?) (\w+)\[\];",
        r"\1* \2 = (\1*)own_memory;",
        cuda_launch.read_source(),
    )
    entries = "".join(
        f'extern "C" void entry_{k}(int x, int y, void** given) {{ launch({name}, x, y, given); }}\n'
        for k, name in enumerate(names)
    )
    (home / "loops.cpp").write_text(f'#include "{header}"\n{source}\n{entries}')
    command = [
        COMPILER,
        "-std=c++17",
        "-O1",
        "-fno-strict-aliasing",
        "-ffp-contract=off",
        "-shared",
        "-fPIC",
        "-w",
        "-o",
        "loops.so",
        "loops.cpp",
    ]
    subprocess.run(command, check=True, cwd=home)
    library = ctypes.CDLL(str(home / "loops.so"))

    def launch(
        name: str, grid: tuple[int, int, int], threads: int, *given: Tensor | int, shared: int = 0
    ) -> None:
        assert shared <= 48 * 1024
        values = [
            ctypes.c_void_p(a.data_ptr()) if isinstance(a, Tensor) else ctypes.c_int(a)
            for a in given
        ]
        places = (ctypes.c_void_p * len(values))(*map(ctypes.addressof, values))
        own = name.split("<")[0] in (
            "systematic",
            "distinct",
            "moments",
        )  # a block has a run, whatever its threads
        getattr(library, f"entry_{names.index(name)}")(
            grid[0] * (1 if own else threads), grid[1], places
        )

    return launch


@pytest.fixture(
    params=[
        pytest.param(
            "cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
        ),
        pytest.param("c++", marks=pytest.mark.skipif(COMPILER is None, reason="no C++ compiler")),
    ]
)
def loop(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Loop:
    """(name, arguments) -> what the loop of this name makes of them, on the CPU."""
    if request.param == "cuda":

        def on_device(name: str, *args: Any) -> Any:
            there = [a.cuda() if isinstance(a, Tensor) and a.dim() else a for a in args]
            assert name == "gather_propagate" or cuda.find_kernel(name, tuple(there)) is not None
            found = getattr(torch.ops.pfbench, name).default(*there)
            return found.cpu() if isinstance(found, Tensor) else [part.cpu() for part in found]

        return on_device
    monkeypatch.setattr(cuda, "launch_kernel", request.getfixturevalue("as_cpp"))
    return lambda name, *args: cuda.KERNELS[name](*args)


def cloud_of(runs: int, n: int, d: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Particles and their weights, a tenth of which are 0."""
    made = PhiloxStream(2, torch.arange(runs), dtype)
    w = torch.softmax(3.0 * made.normal("w", n, 1)[..., 0], 1)
    w = torch.where(made.uniform("empty", n, 1)[..., 0] < 0.1, 0.0, w)
    return made.normal("x", n, d), w / w.sum(1, keepdim=True)


@pytest.mark.parametrize(("runs", "n", "d"), CLOUDS)
def test_draws(loop: Loop, runs: int, n: int, d: int) -> None:
    key = (
        torch.tensor(2**32 - 1),
        4255749673,
        torch.tensor(7),
        5 + torch.arange(runs),
        d,
        -(-n // 4),
    )
    assert torch.equal(loop("philox_normals", *key), random_stream._normals(*key))
    assert torch.equal(loop("philox_normals_float64", *key), random_stream._normals_float64(*key))
    assert torch.equal(loop("philox_uniforms", *key), random_stream._uniforms(*key))


def test_nothing_is_drawn_where_nothing_is_wanted(loop: Loop) -> None:
    assert loop(
        "philox_normals", torch.tensor(1), 2, torch.tensor(3), torch.arange(4), 0, 5
    ).shape == (
        0,
        4,
        20,
    )


@pytest.mark.parametrize("dtype", REAL)
@pytest.mark.parametrize(("runs", "n", "d"), CLOUDS)
def test_resampling(loop: Loop, runs: int, n: int, d: int, dtype: torch.dtype) -> None:
    """Counts are within 1 of n w, ancestors rise, and nobody follows a particle of weight 0."""
    _, w = cloud_of(runs, n, d, dtype)
    u = PhiloxStream(3, torch.arange(runs)).uniform("u", 1, 1).squeeze(2)
    for wanted in (n, n - n // 3):
        number = torch.full((1, 1), wanted)
        found = loop("resample_systematic", w, number, u)
        assert ((found >= 0) & (found < n)).all()
        found = found[:, :wanted]
        assert (found.diff(dim=1) >= 0).all()
        assert (w.gather(1, found) > 0).all()
        counts = torch.zeros(runs, n).scatter_add(1, found, torch.ones(found.shape))
        assert ((counts - wanted * w).abs() < 1.0 + 1e-6 * wanted).all()
        wanted_ones = stages._eager_systematic(w, number, u)[:, :wanted]
        assert torch.equal(found, wanted_ones)


def test_resampling_with_numbers_of_their_own(loop: Loop) -> None:
    _, w = cloud_of(3, 30, 2, torch.float64)
    u, number = (
        torch.tensor([[0.2], [0.9], [1.0 - 1e-9]], dtype=torch.float64),
        torch.tensor([[30], [7], [1]]),
    )
    found, wanted = (
        loop("resample_systematic", w, number, u),
        stages._eager_systematic(w, number, u),
    )
    for r, n in enumerate((30, 7, 1)):
        assert torch.equal(found[r, :n], wanted[r, :n])


@pytest.mark.parametrize("dtype", REAL)
@pytest.mark.parametrize(("runs", "n", "d"), CLOUDS)
def test_clouds(loop: Loop, runs: int, n: int, d: int, dtype: torch.dtype) -> None:
    x, w = cloud_of(runs, n, d, dtype)
    ancestors = (PhiloxStream(3, torch.arange(runs)).uniform("a", n, 1)[..., 0] * n).long()
    first = x.permute(2, 0, 1).contiguous()
    assert torch.equal(
        loop("gather_particles", first, ancestors), belief._select_components(first, ancestors)
    )
    copy_of = 2 * ancestors % (2 * n - 1)
    assert torch.equal(
        loop("count_unique", copy_of, w.log()), belief._count_distinct(copy_of, w.log())
    )
    x = x + 1e4 * torch.arange(1, d + 1)
    x[:, 0], w[:, 0] = 1e9, 0.0  # an outlier without weight spoils nothing
    w = w / w.sum(1, keepdim=True)
    mean, variance = loop("weighted_moments", x, w)
    exact = belief._separate_moments(x.double(), w.double() / w.double().sum(1, keepdim=True))
    deviation = exact[1].sqrt().max()
    written = torch.finfo(dtype).eps * 1e4 * d  # by which a mean of this size can be off at all
    assert (mean - exact[0]).abs().max() < 20 * FINE[dtype] * deviation + 50 * written
    torch.testing.assert_close(variance.double(), exact[1], rtol=100 * FINE[dtype], atol=0.0)


@pytest.mark.parametrize("dtype", REAL)
@pytest.mark.parametrize("own", [(1, 1), (3, 1), (1, 3), (3, 3)])
@pytest.mark.parametrize(("n", "d", "width"), MOVES)
def test_moving(
    loop: Loop, n: int, d: int, width: int, own: tuple[int, int], dtype: torch.dtype
) -> None:
    """Products; and drawn in one pass with copies and noise, what the three do one after the other."""
    made = PhiloxStream(4, torch.arange(3), dtype)
    x, w = made.normal("x", n, d), made.normal("w", n, width)
    phi, gain = made.normal("phi", d, d)[: own[0]], made.normal("gain", d, width)[: own[1]]
    phi = torch.where(phi.abs() < 0.7, 0.0, phi)
    product = loop("propagate_affine", phi, x, gain, w)
    torch.testing.assert_close(
        product,
        linear_algebra._dense_affine(phi, x, gain, w),
        rtol=FINE[dtype],
        atol=10 * FINE[dtype],
    )
    ancestors = (made.uniform("a", n, 1)[..., 0] * n).long()
    key = torch.tensor(4), 99, torch.tensor(3), torch.arange(3)
    first = x.permute(2, 0, 1).contiguous()
    draw = (
        random_stream.draw_normals if dtype == torch.float32 else random_stream.draw_normals_float64
    )
    noise = draw(*key, width, -(-n // 4))[..., :n].permute(1, 2, 0)
    wanted = linear_algebra._dense_affine(
        phi, belief._select_components(first, ancestors).permute(1, 2, 0), gain, noise
    )
    torch.testing.assert_close(
        loop("gather_propagate", phi, first, ancestors, gain, *key),
        wanted,
        rtol=FINE[dtype],
        atol=10 * FINE[dtype],
    )


def test_more_states_than_registers_hold_are_left_to_torch() -> None:
    def x(d: int, dtype: torch.dtype) -> Tensor:
        return torch.empty(100, 10, d, dtype=dtype)

    def taken(d: int, dtype: torch.dtype) -> bool:
        return cuda._ACCEPTS["propagate_affine"](torch.empty(1, d, d), x(d, dtype), None, None)

    assert [taken(d, torch.float32) for d in (32, 33)] == [True, False]
    assert [taken(d, torch.float64) for d in (20, 21)] == [True, False]
    assert not taken(2, torch.float16)


def test_the_door_on_a_device_checks_types_and_shapes_before_anything_is_launched(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Every kernel refuses each spoiled argument as the manifest does, and launches a valid call."""
    launched = []
    monkeypatch.setattr(cuda, "launch_kernel", lambda name, *_, **__: launched.append(name))
    rng = random.Random(5)
    for name in cuda.KERNELS:
        valid = random_calls.make_call(name, rng, {axis: 3 for axis in "DRNMWE"})
        cuda.KERNELS[name](*valid)
        assert len(launched) == 1, name
        for place, argument in enumerate(random_calls.OPERATORS[name]):
            for value in random_calls.wrong_values(argument, valid[place]):
                call = [*valid[:place], value, *valid[place + 1 :]]
                with pytest.raises(ValueError, match=f"^{name}: \\w+ must "):
                    cuda.KERNELS[name](*call)
        assert len(launched) == 1, name
        launched.clear()


def test_a_transition_between_states_of_two_sizes_is_left_to_torch() -> None:
    """The kernel would read beyond the end of its matrices."""
    phi, x, gain, w = (torch.rand(shape) for shape in ((1, 2, 3), (5, 7, 3), (1, 2, 1), (5, 7, 1)))
    assert not cuda._ACCEPTS["propagate_affine"](phi, x, gain, w)
    with pytest.raises(ValueError, match="propagate_affine: phi must be square on CUDA"):
        cuda.KERNELS["propagate_affine"](phi, x, gain, w)


def test_run_numbers_with_gaps_in_memory(loop: Loop) -> None:
    key = torch.tensor(3), 99, torch.tensor(7)
    strided = torch.arange(12)[::3]
    assert torch.equal(
        loop("philox_uniforms", *key, strided, 2, 3),
        random_stream._uniforms(*key, strided.contiguous(), 2, 3),
    )


def test_operators_know_the_shape_of_what_they_make() -> None:
    with torch._subclasses.FakeTensorMode():
        first, ancestors = torch.zeros(5, 3, 8), torch.zeros(3, 6, dtype=torch.int64)
        args = (
            torch.zeros(1, 5, 5),
            first,
            ancestors,
            torch.zeros(1, 5, 2),
            torch.tensor(1),
            2,
            torch.tensor(3),
            torch.arange(3),
        )
        assert dispatch.gather_propagate(*args).shape == (5, 3, 6)
