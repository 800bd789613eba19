"""The loops of particles.cu against what they stand for: on a CUDA device, and, compiled as C++, anywhere."""

import ctypes
import random
import re
import shutil
import subprocess
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import random_calls
import torch
from torch import Tensor

from pfbench.core import density, linear_algebra, random_stream
from pfbench.core.random_stream import PhiloxStream
from pfbench.filter import belief
from pfbench.filter.particle import stages
from pfbench.kernels import cuda, cuda as cuda_launch, dispatch

COMPILER = next(
    (found for name in ("c++", "g++", "clang++") if (found := shutil.which(name))), None
)
CLOUDS = [(3, 30, 2), (7, 1001, 15), (5, 4096, 4), (3, 12_000, 3)]  # runs, particles, components
MOVES = [(30, 2, 1), (1001, 15, 15), (515, 4, 9), (4, 5, 3)]  # particles, components, noise
REAL = [torch.float32, torch.float64]
FINE = {torch.float32: 1e-5, torch.float64: 1e-12}

Loop = Callable[..., Any]


@pytest.fixture(scope="module")
def as_cpp(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., None]:
    """In place of `cuda.launch_kernel`: blocks one after the other, threads of a block in turns."""
    assert COMPILER is not None
    home, header = tmp_path_factory.mktemp("cuda"), Path(__file__).parent / "cuda_on_cpu.h"
    names = ["uniforms"]
    for real in ("float", "double"):
        names.append(f"normals<{real}>")
        names += [f"{loop}<{real}>" for loop in ("copied", "distinct")]
        names += [f"systematic<{real}, {index}>" for index in ("long long", "int")]
        names += [f"weighed<{real}, {d}, {w}>" for _, d, w in MOVES]
        names += [f"finished<{real}, {d}>" for _, d, _ in MOVES]
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
        f'extern "C" void entry_{k}(int x, int y, int size, void** given) {{ launch<{name}>(x, y, size, given); }}\n'
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
        getattr(library, f"entry_{names.index(name)}")(grid[0], grid[1], threads, places)

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
        monkeypatch.setattr(cuda, "_fills_device", lambda a, most: a.shape[1] <= most)

        def on_device(name: str, *args: Any) -> Any:
            there = [a.cuda() if isinstance(a, Tensor) and a.dim() else a for a in args]
            assert (
                name in ("gather_propagate", "sir_step")
                or cuda.find_kernel(name, tuple(there)) is not None
            )
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


class Step(NamedTuple):
    """Arguments of `sir_step`."""

    a: Tensor
    n: Tensor
    u: Tensor
    phi: Tensor
    x: Tensor
    gain: Tensor
    seed: Tensor
    purpose: int
    step: Tensor
    runs: Tensor
    components: Tensor
    y: Tensor
    scale: Tensor
    constant: Tensor


def make_step(n: int, d: int, width: int, own: tuple[int, int], dtype: torch.dtype) -> Step:
    """A step of three runs that measures every other component, and once not at all."""
    made, runs = PhiloxStream(4, torch.arange(3), dtype), 3
    components = torch.arange(0, d, 2).flip(0)
    phi, gain = made.normal("phi", d, d)[: own[0]], made.normal("gain", d, width)[: own[1]]
    y, scale = (
        made.normal("y", 1, len(components))[:, 0],
        3.0 * made.uniform("s", 1, len(components))[:, 0],
    )
    scale[-1, 0] = 0.0
    _, a = cloud_of(runs, n, d, dtype)
    return Step(
        a, torch.full((1, 1), n, dtype=dtype), PhiloxStream(3, torch.arange(3)).uniform("u", 1, 1)[:, 0],
        torch.where(phi.abs() < 0.7, 0.0, phi), made.normal("x", n, d).permute(2, 0, 1).contiguous(), gain,
        torch.tensor(4), 99, torch.tensor(3), torch.arange(3) + 5, components, y, scale[: own[1]].to(dtype),
        torch.tensor([0.3, -2.0, 1e3], dtype=dtype)[: own[0]],
    )  # fmt: skip


def one_after_the_other(step: Step) -> list[Tensor]:
    """What `sir_step` stands for; moments in double precision."""
    (_, runs, n), dtype = step.x.shape, step.x.dtype
    ancestors = stages._eager_systematic(step.a, step.n, step.u)
    draw = (
        random_stream.draw_normals if dtype == torch.float32 else random_stream.draw_normals_float64
    )
    noise = draw(*step[6:10], step.gain.shape[-1], -(-n // 4))[..., :n].permute(1, 2, 0)
    parents = belief._select_components(step.x, ancestors).permute(1, 2, 0)
    x = linear_algebra._dense_affine(step.phi, parents, step.gain, noise)
    prior = torch.where(torch.arange(n) < step.n, -torch.log(step.n), -torch.inf).expand(runs, n)
    mean = x.permute(1, 2, 0)[..., step.components]
    likelihood = density._run_quadratic(step.y, mean, step.scale, step.constant)
    weights = belief._separate_normalise(
        belief._separate_sum(likelihood, prior, torch.zeros(runs, 1))
    )
    moments = belief._separate_moments(x.permute(1, 2, 0).double(), weights[2].double())
    return [x, *weights, *moments, belief._count_distinct(ancestors, prior)]


def check_step(found: Any, step: Step, factor: float = 1.0) -> None:
    """Log weights agree by what rounding of squares is worth, moments by the spread of the particles."""
    fine, wanted = factor * FINE[step.x.dtype], one_after_the_other(step)
    close = partial(torch.testing.assert_close, check_dtype=False)
    close(found[0], wanted[0], rtol=fine, atol=10 * fine)
    largest = wanted[1][torch.isfinite(wanted[1])].abs().max()
    for k in (1, 2):
        close(found[k], wanted[k], rtol=10 * fine, atol=10 * fine * float(largest))
    for k in (3, 4):
        close(found[k], wanted[k], rtol=30 * fine * float(largest), atol=1e-30)
    deviation = wanted[6].sqrt()
    error = 30 * fine * largest * (deviation + wanted[5].abs() * factor**-1)
    assert ((found[5] - wanted[5]).abs() <= error + 1e-12).all()
    assert ((found[6] - wanted[6]).abs() <= 60 * fine * largest * wanted[6] + 1e-12).all()
    assert torch.equal(found[7], wanted[7])


@pytest.mark.parametrize("dtype", REAL)
@pytest.mark.parametrize("own", [(1, 1), (3, 3)])
@pytest.mark.parametrize(("n", "d", "width"), MOVES)
def test_a_step(
    loop: Loop,
    n: int,
    d: int,
    width: int,
    own: tuple[int, int],
    dtype: torch.dtype,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """All in one pass is what its parts are one after the other.

    Also with slots that are not in use, and where a block takes one run after the other.
    """
    step = make_step(n, d, width, own, dtype)
    check_step(loop("sir_step", *step), step)
    monkeypatch.setattr(cuda, "_BLOCKS", 1)
    fewer = step._replace(n=torch.tensor([[n], [n - n // 3], [1]], dtype=dtype))
    check_step(loop("sir_step", *fewer), fewer)


@pytest.mark.parametrize("dtype", REAL)
def test_a_step_far_from_the_origin_and_of_lost_runs(loop: Loop, dtype: torch.dtype) -> None:
    """A mean of many deviations costs the variance no digits but those of the states.

    A run whose particles all have weight 0, or weights that rounding has made, goes on with equal weights.
    """
    step = make_step(1001, 15, 15, (1, 1), dtype)
    far = step._replace(
        phi=torch.eye(15, dtype=dtype)[None], x=step.x + 1e3, y=step.y + 1e3, scale=0.1 * step.scale
    )
    found, wanted = loop("sir_step", *far), one_after_the_other(far)
    off = 1e3 * torch.finfo(dtype).eps
    torch.testing.assert_close(found[5].double(), wanted[5], rtol=0.0, atol=10 * off)
    torch.testing.assert_close(found[6].double(), wanted[6], rtol=50 * off, atol=0.0)
    y = step.y.clone()
    y[0], y[1] = 1e30 if dtype == torch.float32 else 1e200, 1e6 if dtype == torch.float32 else 1e11
    lost = step._replace(y=y)
    found, wanted = loop("sir_step", *lost), one_after_the_other(lost)
    assert (wanted[2] == -torch.inf).tolist() == [True, True, False]
    for k in (1, 2, 3, 4):
        torch.testing.assert_close(
            found[k], wanted[k], rtol=1e3 * FINE[dtype], atol=1e3 * FINE[dtype]
        )
    for k in (5, 6):
        torch.testing.assert_close(
            found[k].double(), wanted[k], rtol=1e3 * FINE[dtype], atol=1e2 * FINE[dtype]
        )


def test_a_nan_of_a_particle_reaches_the_mean_of_its_run_alone(loop: Loop) -> None:
    """The filter then repeats the step; its weight is 0."""
    step = make_step(515, 4, 9, (1, 1), torch.float64)
    x = step.x.clone()
    parent = int(stages._eager_systematic(step.a, step.n, step.u)[1, 300])
    x[0, 1, parent] = torch.nan
    found = loop("sir_step", *step._replace(x=x))
    assert torch.isnan(found[5][1]).any()
    assert torch.isfinite(found[5][[0, 2]]).all()
    assert (found[3][1] == 0.0).any()
    assert torch.isfinite(found[3]).all()


def test_what_no_kernel_takes_is_left_to_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    """More states than registers hold, other types, and kernels that do not compile."""

    def x(d: int, dtype: torch.dtype) -> Tensor:
        return torch.empty(100, 10, d, dtype=dtype)

    def taken(d: int, dtype: torch.dtype) -> bool:
        return cuda._ACCEPTS["propagate_affine"](torch.empty(1, d, d), x(d, dtype), None, None)

    def step_taken(d: int, dtype: torch.dtype, rows: int) -> bool:
        return cuda.can_take_step(torch.empty(d, 100, 10, dtype=dtype), torch.empty(1, rows, 2))

    monkeypatch.setattr(cuda, "_compiles", lambda name: True)
    assert [step_taken(d, torch.float32, d) for d in (31, 32)] == [True, False]
    assert [step_taken(d, torch.float64, d) for d in (20, 21)] == [True, False]
    assert not step_taken(4, torch.float32, 5)
    assert not step_taken(4, torch.float16, 4)
    monkeypatch.setattr(cuda, "_compiles", lambda name: "finished" not in name)
    assert not step_taken(4, torch.float32, 4)
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
        kernels = len(launched)
        assert kernels, name
        for place, argument in enumerate(random_calls.OPERATORS[name]):
            for value in random_calls.wrong_values(argument, valid[place]):
                call = [*valid[:place], value, *valid[place + 1 :]]
                with pytest.raises(ValueError, match=f"^{name}: \\w+ must "):
                    cuda.KERNELS[name](*call)
        assert len(launched) == kernels, name
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
    dispatch.prepare_compiler()
    step = make_step(8, 5, 2, (1, 3), torch.float32)
    with torch._subclasses.FakeTensorMode() as mode:
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
        fakes = [mode.from_tensor(a) if isinstance(a, Tensor) else a for a in step]
        shapes = [tuple(part.shape) for part in dispatch.sir_step(*fakes)]
        assert shapes == [(5, 3, 8), (3, 8), (3,), (3, 8), (3,), (3, 5), (3, 5), (3,)]
