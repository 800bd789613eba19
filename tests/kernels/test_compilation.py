"""Fusible functions: fused they compute what they compute eagerly."""

import shutil
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import pfbench
from torch import Tensor
from torch._subclasses import FakeTensorMode

from pfbench.core import PhiloxStream, Record, density, linear_algebra
from pfbench.filter import (
    CubaturePoints,
    FilterResult,
    ParticleBelief,
    ParticleFilter,
    RadialDegree5,
    SimplexDegree3,
    SphericalRadialPoints,
    UnscentedPoints,
    belief,
    gather_ancestors,
    run_filter,
)
from pfbench.filter.gaussian import gaussian_filter, kalman_update, linearisation_rules
from pfbench.filter.particle import stages
from pfbench.job import filter_pass, scoring
from pfbench.kernels import cpp_library, dispatch
from pfbench.model.linear_gaussian import linear_walk
from pfbench.noise.base import NominalNoise
from pfbench.results import store
from pfbench.scenario.simulated import ModelSimulation

RUNS, N, D = 3, 200, 5
DRAWS = PhiloxStream(3, torch.arange(RUNS)).at_step(1)
compiler = pytest.mark.skipif(
    not any(map(shutil.which, ("c++", "g++", "clang++"))),
    reason="no C++ compiler for torch.compile",
)


def test_what_is_not_fused_runs_the_eager_form() -> None:
    seen: list[str] = []
    half = dispatch.compilable(lambda: seen.append("fused"), eager=lambda: seen.append("eager"))
    half()
    with dispatch.use_kernels(False):
        half()
    assert seen == ["eager", "eager"]


def test_the_switch_is_put_back_after_an_error() -> None:
    with pytest.raises(RuntimeError), dispatch.use_kernels():
        raise RuntimeError
    assert not dispatch._fused.get()


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1), (0, 2, 1)])
def test_a_gather_keeps_memory_order_and_takes_the_right_particles(
    order: tuple[int, int, int],
) -> None:
    back = [order.index(k) for k in range(3)]
    x = DRAWS.normal("x", N, D).permute(order).contiguous().permute(back)
    ancestors = (DRAWS.uniform("a", N, 1)[..., 0] * N).long()
    cloud = gather_ancestors(ParticleBelief(x, x[..., 0], torch.zeros(RUNS)), ancestors)
    for r in range(RUNS):
        assert torch.equal(cloud.x[r], x[r][ancestors[r]])
        assert torch.equal(cloud.log_w[r], x[r, ancestors[r], 0])
    assert cloud.x.stride() == x.stride() or order == (0, 1, 2)


def results(x: Tensor, z: Tensor) -> list[Any]:
    dtype = x.dtype
    hidden = z.clone()
    hidden[0] = -torch.inf  # a run of which nothing is left
    y = 0.1 * x[:, 0]
    y[1, 2] = torch.nan
    a, n, u = (
        torch.softmax(3.0 * z, -1),
        torch.full((RUNS, 1), N),
        torch.tensor([[0.1], [0.5], [0.9]]),
    )
    return [
        belief._flat_moments(1e3 + x, torch.softmax(z, 1)),
        belief.normalise_updated_weights(hidden),
        density.log_normal_density(y, x, torch.full((1, 1, D), 0.7, dtype=dtype)),
        stages._systematic(a, n, u.double()),
    ]


@pytest.mark.slow
@compiler
@pytest.mark.filterwarnings("ignore")  # the compiler's own
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_fused_functions_agree_with_eager_ones(dtype: torch.dtype) -> None:
    x, z = DRAWS.normal("x", N, D).to(dtype), DRAWS.normal("w", N, 1)[..., 0].to(dtype)
    eager = results(x, z)
    with dispatch.use_kernels():
        fused = results(x, z)
    torch.testing.assert_close(fused, eager)


@pytest.mark.slow
@compiler
@pytest.mark.filterwarnings("ignore")
def test_a_filter_runs_alike_fused_and_eagerly() -> None:
    model = linear_walk(1.0, 0.3, 1.0)
    record = ModelSimulation(model, 30).draw(NominalNoise(), torch.arange(4), 1).record

    def run() -> FilterResult:
        return run_filter(ParticleFilter(300), model, record, PhiloxStream(1, torch.arange(4)))

    eager = run()
    with dispatch.use_kernels(), torch.no_grad():
        fused = run()
    assert torch.allclose(fused.log_evidence, eager.log_evidence, rtol=1e-9, atol=0.0)
    assert torch.allclose(fused.mean, eager.mean, rtol=1e-9, atol=1e-12)


@compiler
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_loop_by_hand_copies_evenly(dtype: torch.dtype) -> None:
    """Empty slots, fewer particles wanted than slots, all weight on one, and weights that nobody can use."""
    a = torch.softmax(2.0 * DRAWS.normal("w", N, 1)[..., 0].to(dtype), -1)
    a = torch.cat([a, torch.zeros(3, N, dtype=dtype)])
    a[0, N // 2 :] = 0.0
    a[3, 7] = a[4, -1] = 1.0
    a[5] = torch.nan
    n = torch.tensor([[N], [N // 3], [2], [N], [N], [N]], dtype=dtype)
    u = torch.linspace(1.0 - 1e-9, 1e-9, 6, dtype=torch.float64)[:, None]
    assert torch.equal(dispatch.resample_systematic(a, n, u), stages._eager_systematic(a, n, u))
    assert torch.equal(
        dispatch.resample_systematic(a[:1], n[:1], u[:1]),
        dispatch.resample_systematic(a, n[:1], u)[:1],
    )


@compiler
@pytest.mark.parametrize("d", [1, 4, 15])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_roots_by_hand_exist_where_roots_do(dtype: torch.dtype, d: int) -> None:
    """A A' = covariance, A lower triangular, for scales of 1e-4 to 1e4; what has no root does no harm to its neighbours."""
    runs, eps = 21, torch.finfo(dtype).eps
    half = (
        DRAWS.normal("half", runs * d * d, 1)[0].to(dtype).view(runs, d, d)
        * torch.logspace(-4, 4, d, dtype=dtype)[:, None]
    )
    whole = half @ half.mT
    whole[1] = torch.nan
    whole[2, 0, 0] *= -1.0
    whole[3, -1], whole[3, :, -1] = 0.0, 0.0  # no spread, and none in the root
    whole[4] = torch.outer(
        half[4, 0], half[4, 0]
    )  # of rank 1: rounding decides, and a little more on the diagonal heals it
    whole[5, 0, -1] = whole[5, -1, 0] = (
        whole[5].diagonal().max() * 1e3
    )  # correlated above 1, unless there is but one component
    for found, fine in (dispatch.cholesky_factor(whole), linear_algebra._factor(whole)):
        assert fine.tolist() == [k not in (1, 2, *([5] if d > 1 else [])) for k in range(runs)]
        sd = whole[fine].diagonal(dim1=-2, dim2=-1).sqrt().clamp(min=1e-15)
        off = (found[fine] @ found[fine].mT - whole[fine]) / (sd.unsqueeze(-1) * sd.unsqueeze(-2))
        jitter = 2e-6 if dtype == torch.float32 else 2e-12
        assert float(off.abs().max()) < max(jitter, 20.0 * d * eps)
        assert (
            float(off[[0, *range(4, len(off))]].abs().max()) < 20.0 * d * eps
        )  # without those that were healed
        assert torch.equal(found[fine].triu(1), torch.zeros_like(found[fine]))
        assert bool((found[3, -1] == 0.0).all())
        assert torch.isfinite(found[fine]).all()


@compiler
@pytest.mark.parametrize(("runs", "rows", "d"), [(3, 1, 1), (5, 20, 4), (19, 2, 9), (100, 6, 15)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_update_by_hand_solves_the_least_squares(
    dtype: torch.dtype, runs: int, rows: int, d: int
) -> None:
    """Root^-T root^-1 = I + M' Omega^-1 M, of nothing seen too, of priors 1e4 times as wide as noise; NaN stays alone."""
    m = DRAWS.normal("m", runs * rows * d, 1)[0].to(dtype).view(runs, rows, d) * torch.logspace(
        -4, 4, d, dtype=dtype
    )
    half = DRAWS.normal("noise", runs * rows * rows, 1)[0].to(dtype).view(runs, rows, rows)
    omega, r = (
        half @ half.mT + torch.eye(rows, dtype=dtype),
        DRAWS.normal("r", runs * rows, 1)[0].to(dtype).view(runs, rows),
    )
    m[0], m[1] = 0.0, torch.nan
    omega[2, 0, 0] = -1.0
    fine = torch.tensor([k != 1 for k in range(runs)])
    rooted = torch.tensor([k != 2 for k in range(runs)])
    own = fine & rooted
    exact_m, exact_r, noise = m[own].double(), r[own].double().unsqueeze(-1), omega[own].double()
    information = torch.eye(d).double() + exact_m.mT @ torch.linalg.solve(noise, exact_m)
    size = information.diagonal(dim1=-2, dim2=-1).sqrt()
    for shift, root, least, scales, ok in (
        dispatch.kalman_update(m, r, omega),
        kalman_update._separate_update(m, r, omega),
    ):
        assert torch.equal(ok, rooted)
        assert torch.equal(
            torch.isfinite(shift.sum(1) + root.sum((1, 2)) + least)[rooted], fine[rooted]
        )
        assert torch.equal(root[own].tril(-1), torch.zeros_like(root[own]))
        back, at = torch.linalg.inv(root[own].double()), shift[own].double().unsqueeze(-1)
        eps = 50.0 * (rows + d) * torch.finfo(dtype).eps * float(torch.linalg.cond(noise).max())
        off = (back.mT @ back - information) / (size.unsqueeze(-1) * size.unsqueeze(-2))
        assert float(off.abs().max()) < eps
        slope = (information @ at - exact_m.mT @ torch.linalg.solve(noise, exact_r)).squeeze(
            -1
        ) / size
        assert float(slope.abs().max()) < eps * (1.0 + float((size * at.squeeze(-1)).abs().max()))
        residual = exact_r - exact_m @ at
        distance = (residual.mT @ torch.linalg.solve(noise, residual) + at.mT @ at).flatten()
        assert torch.allclose(least[own].double(), distance, rtol=eps, atol=eps)
        logs = 0.5 * torch.linalg.slogdet(noise + exact_m @ exact_m.mT)[1]
        assert torch.allclose(
            scales[own].double().log().sum(1), logs, rtol=0, atol=max(eps, 1e-8)
        )  # the sum has rounded, too


@compiler
@pytest.mark.parametrize(
    "scheme",
    [
        CubaturePoints(),
        SphericalRadialPoints(SimplexDegree3(), RadialDegree5()),
        UnscentedPoints(kappa=1.0),
    ],
)
@pytest.mark.parametrize("k", [1, 3, 4, 6, 15])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_fit_by_hand_is_the_weighted_one(dtype: torch.dtype, k: int, scheme: Any) -> None:
    """Of curved values that lie in either order of memory; NaN stays in its run."""
    runs, d = 21, 5
    xi, _, w = (a.to(dtype) for a in scheme(d))
    bent = DRAWS.normal("bent", runs * len(xi) * k, 1)[0].to(dtype).view(runs, len(xi), k)
    slope = DRAWS.normal("slope", runs * k * d, 1)[0].to(dtype).view(runs, k, d)
    r = xi @ slope.mT + 0.1 * bent
    r[1] = torch.nan
    fine, off = torch.arange(runs) != 1, r.double()
    wanted = torch.einsum("p,rpk,pd->rkd", w.double(), off, xi.double())
    left = off - torch.einsum("rkd,pd->rpk", wanted, xi.double())
    both = torch.einsum("p,rpk,rpl->rkl", w.double(), left, left)
    for lie in (r, r.permute(2, 0, 1).contiguous().permute(1, 2, 0)):
        for m, omega in (
            dispatch.fit_affine(lie, xi, w),
            linearisation_rules._separate_fit(lie, xi, w),
        ):
            assert torch.equal(torch.isfinite(m.sum((1, 2)) + omega.sum((1, 2))), fine)
            eps = 100.0 * torch.finfo(dtype).eps
            assert torch.allclose(m[fine].double(), wanted[fine], rtol=eps, atol=eps * 10.0)
            assert torch.allclose(omega[fine].double(), both[fine], rtol=eps, atol=eps * 10.0)


@compiler
def test_a_loop_by_hand_gathers() -> None:
    x, ancestors = (
        DRAWS.normal("x", N, D).permute(2, 0, 1),
        (DRAWS.uniform("a", 3 * N, 1)[..., 0] * N).long(),
    )
    expected = x.gather(2, ancestors.expand(D, -1, -1))
    assert torch.equal(dispatch.gather_particles(x, ancestors), expected)
    assert torch.equal(
        dispatch.gather_particles(x.contiguous().float(), ancestors), expected.float()
    )


@compiler
@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1), (0, 2, 1)])
def test_a_loop_by_hand_weighs_and_averages_in_any_memory_order(
    order: tuple[int, int, int],
) -> None:
    back = [order.index(k) for k in range(3)]
    x, w = (
        DRAWS.normal("x", N, D).permute(order).contiguous().permute(back),
        torch.softmax(DRAWS.normal("w", N, 1)[..., 0], -1),
    )
    x[1, 5, 2], x[2, 4, 0] = torch.nan, torch.inf
    y, scale, constant = (
        x[:, 0],
        torch.rand(RUNS, D, dtype=torch.float64),
        torch.rand(RUNS, dtype=torch.float64),
    )
    scale[1, 1] = 0.0  # not seen
    torch.testing.assert_close(
        dispatch.log_normal(y, x, scale, constant),
        density._run_quadratic(y, x, scale, constant),
        equal_nan=True,
    )
    torch.testing.assert_close(
        dispatch.weighted_moments(x, w), belief._separate_moments(x, w), equal_nan=True
    )
    w[2, 3] = torch.nan
    torch.testing.assert_close(
        dispatch.sum_and_squares(w), belief._separate_totals(w), equal_nan=True
    )


@compiler
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [1, 2, 3, 4, 7, 9])
def test_a_loop_by_hand_spreads_about_the_mean_in_any_memory_order(
    dtype: torch.dtype, size: int
) -> None:
    """One particle, several chunks of them and a rest; a particle that is not finite stays in its run and groups."""
    groups = torch.stack([torch.arange(size), torch.arange(size).flip(0) + 2])
    for particles in (1, 50, 300, 1000):
        x, w = (
            DRAWS.normal("x", particles, 11).to(dtype),
            torch.softmax(DRAWS.normal("w", particles, 1)[..., 0].to(dtype), -1),
        )
        x[1, particles // 2, 0] = torch.nan
        mean = DRAWS.normal("mean", 1, 11)[:, 0].to(dtype)
        for laid in (x.contiguous(), x.permute(2, 0, 1).contiguous().permute(1, 2, 0)):
            found, wanted = (
                dispatch.group_covariance(laid, mean, w, groups),
                belief._separate_spread(x, mean, w, groups),
            )
            eps = torch.finfo(dtype).eps
            torch.testing.assert_close(found, wanted, equal_nan=True, rtol=1e3 * eps, atol=20 * eps)


@compiler
@pytest.mark.parametrize(("systems", "d"), [(1, 1), (3, 2), (5, 3), (100, 15)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_loop_by_hand_measures_by_a_covariance(dtype: torch.dtype, systems: int, d: int) -> None:
    """Metres beside radians, a rounding below zero, several groups of a run, one covariance for all; a NaN stays in its place."""
    root = DRAWS.normal("root", d * systems * (d + 2), 1)[0].to(dtype).view(systems, d, d + 2)
    e, unit = (
        DRAWS.normal("e", systems * d, 1)[0].to(dtype).view(systems, d),
        torch.logspace(-6, 6, d, dtype=dtype),
    )
    wide = root.double() @ root.double().mT
    wide[-1, -1, -1] *= -1.0
    given = ((unit[:, None] * unit).double() * wide).to(dtype)
    found, wanted = (
        dispatch.squared_mahalanobis(unit * e, given),
        linear_algebra._solved_length(e.double(), wide).to(dtype),
    )
    # by the inverse's elements, which two systems of 15 x 17 numbers have up to 1e3 of
    torch.testing.assert_close(found, wanted, rtol=1e5 * torch.finfo(dtype).eps, atol=0.0)
    grouped = dispatch.squared_mahalanobis(
        e.unsqueeze(1).expand(-1, 2, -1), wide.to(dtype).unsqueeze(1).expand(-1, 2, -1, -1)
    )
    torch.testing.assert_close(
        grouped, wanted.unsqueeze(1).expand(-1, 2), rtol=1e5 * torch.finfo(dtype).eps, atol=0.0
    )
    one = torch.linalg.inv(wide[:1]) * e.double().unsqueeze(1) * e.double().unsqueeze(2)
    torch.testing.assert_close(
        dispatch.squared_mahalanobis(e, wide[:1].to(dtype)).double(),
        one.sum((1, 2)),
        rtol=1e6 * torch.finfo(dtype).eps,
        atol=1e-6,
    )
    e[0], given[:, 0], given[:, :, 0] = torch.nan, 0.0, 0.0
    assert torch.isnan(dispatch.squared_mahalanobis(e, wide.to(dtype))).tolist() == [True] + [
        False
    ] * (systems - 1)
    for lost in (given, torch.zeros_like(given)):
        assert not torch.isfinite(dispatch.squared_mahalanobis(e, lost)).any()
        assert not torch.isfinite(linear_algebra._solved_length(e, lost)).any()


@compiler
@pytest.mark.parametrize("particles", [1, 2, 50, 700])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_loop_by_hand_scores_components(dtype: torch.dtype, particles: int) -> None:
    """Equal particles, those at the truth, empty slots, one far off, no spread, no truth, tiny numbers, an infinite one."""
    x = DRAWS.normal("x", particles, 9).to(dtype)
    x[..., 1] = (2.0 * x[..., 1]).round()  # so that many are equal, and some at the truth
    x[..., 2] = torch.exp(12.0 * x[..., 2])
    x[..., 3] = 0.25
    x[:, particles // 2, 4] = 1e30
    x[:, : particles // 2, 5] *= 1e-30
    x[..., 8] *= 1e-40 if dtype == torch.float32 else 1e-310
    x[:, 0, 7] = torch.inf
    error = DRAWS.normal("error", 1, 9)[:, 0].to(dtype)
    error[:, [1, 2, 8]], error[0, 3], error[1, 3] = 0.0, -0.25, -0.5
    error[2, 6] = x[0, particles // 2, 0] = torch.nan
    log_w = DRAWS.normal("w", particles, 1)[..., 0].to(dtype)
    log_w[1, 1 : particles // 3] = -torch.inf
    log_w[2] = 0.0
    w = torch.softmax(log_w, -1)
    crps, below = scoring._separate_marginals(error.double(), x.double(), w.double())
    eps, known, far = (
        torch.finfo(dtype).eps,
        ~torch.isnan(crps),
        (w.unsqueeze(-1) * (error.unsqueeze(1) + x).abs()).sum(1),
    )
    for laid in (x.contiguous(), x.permute(2, 0, 1).contiguous().permute(1, 2, 0)):
        found = dispatch.marginal_scores(error, laid, w)
        off = torch.where(
            torch.isinf(crps) & (found[0] == crps), 0.0, (found[0].double() - crps).abs()
        )
        # each of N terms below the smallest normal number may be off by the spacing there, eps * tiny
        spacing = max(20, particles) * eps * torch.finfo(dtype).tiny
        assert (off[known] <= 20 * eps * far[known] + spacing).all()
        torch.testing.assert_close(found[1].double(), below, rtol=0.0, atol=100 * eps)
        assert torch.isnan(found[0]).nonzero().tolist() == [[0, 0], [2, 6]]


@compiler
@pytest.mark.parametrize("points", [1, 7, 64])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_loop_by_hand_scores_vectors(dtype: torch.dtype, points: int) -> None:
    x = 3.0 + DRAWS.normal("x", points, 6).to(dtype)
    x[1, 0, 2] = torch.nan
    for parts in ([0], [3, 1, 5], [0, 1, 2, 3, 4, 5]):
        found, wanted = (
            dispatch.energy_score(x[:, :, parts]),
            scoring._separate_energy(x[:, :, parts]),
        )
        torch.testing.assert_close(
            found, wanted, rtol=1e2 * torch.finfo(dtype).eps, atol=0.0, equal_nan=True
        )


def test_without_a_library_operators_run_in_torch_and_one_line_says_so(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def load() -> None:
        raise OSError("a C++ compiler must be on the PATH")

    cpp_library.is_library_loaded.cache_clear()
    monkeypatch.setattr(cpp_library, "load_library", load)
    terms = torch.rand(3, 5)
    with dispatch.use_kernels():
        sums = [belief._totals(terms) for _ in range(2)]
    cpp_library.is_library_loaded.cache_clear()
    for total, square in sums:
        torch.testing.assert_close(total, terms.sum(1, keepdim=True))
        torch.testing.assert_close(square, terms.square().sum(1, keepdim=True))
    (line,) = (record.getMessage() for record in caplog.records)
    assert line.startswith("C++ operators: not available (a C++ compiler must be on the PATH)")
    assert "slower" in line


@compiler
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("particles", [1, 63, 64, 200])
def test_a_loop_by_hand_moves_by_the_coefficients_that_are_not_zero(
    dtype: torch.dtype, particles: int
) -> None:
    def some(purpose: str, n: int, w: int) -> Tensor:
        return DRAWS.normal(purpose, n, w).to(dtype)

    x, w = some("x", particles, D), some("w", particles, 2)
    phi, gain = some("phi", D, D), some("gain", D, 2)
    phi[:, :, 1], phi[:, 3], gain[1] = (
        0.0,
        0.0,
        0.0,
    )  # a state that nothing sees, one that is noise alone, a run without noise
    still, steady = (
        torch.zeros(2, dtype=dtype).expand_as(w),
        torch.tensor([0.0, 2.0], dtype=dtype).expand_as(w),
    )
    for (a, b), noise in product(
        ((phi, gain), (phi[:1], gain[:1]), (phi[:1], gain)), (w, still, steady)
    ):
        parts = ((a, x), (b, noise))
        moved = sum(torch.einsum("rij,rnj->irn", by.expand(RUNS, -1, -1), of) for by, of in parts)
        torch.testing.assert_close(dispatch.propagate_affine(a, x, b, noise), moved)
        torch.testing.assert_close(linear_algebra._dense_affine(a, x, b, noise), moved)


@compiler
def test_a_gradient_goes_round_the_loops_by_hand() -> None:
    x, w = (
        DRAWS.normal("x", N, D).requires_grad_(),
        torch.softmax(DRAWS.normal("w", N, 1)[..., 0], -1),
    )
    with dispatch.use_kernels():
        belief._flat_moments(x, w)[0].sum().backward()
    torch.testing.assert_close(x.grad, w.unsqueeze(-1).expand_as(x))


@compiler
def test_small_numbers_are_still_numbers_after_the_loops_are_loaded() -> None:
    dispatch.philox_normals(torch.tensor(1), 2, torch.tensor(0), torch.arange(2), 2, 2)
    assert (
        float(torch.tensor(1e-310, dtype=torch.float64) / 2) > 0.0
    )  # -ffast-math, when linked, would make it 0


WALK = (
    "run",
    "scenario=linear_walk",
    "scenario.steps=20",
    "runs=4",
    "particles=200",
    "overwrite=true",
)


@compiler
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_a_compiled_job_gives_the_numbers_of_an_eager_one(tmp_path: Path, dtype: str) -> None:
    found = {}
    for engine in ("eager", "kernels"):
        said = pfbench(*WALK, f"engine={engine}", f"dtype={dtype}", home=tmp_path)
        assert said.code == 0, said.err
        files = list((tmp_path / "results" / "adhoc").glob("*.npz"))
        for file in files:
            result = store.read_result(file)
            found[result.meta["engine"]] = result
        assert engine in found
    assert len(files) == (1 if dtype == "float64" else 2)  # keys: one, or one for each engine
    # stored in single precision; a particle in a few thousand falls to a neighbouring slot in float32
    tolerance = 1e-6 if dtype == "float64" else 2e-2
    eager, compiled = (found[engine].data for engine in ("eager", "kernels"))
    for name in ("error", "sd", "log_evidence"):
        assert np.allclose(compiled[name], eager[name], rtol=tolerance, atol=tolerance), name


@compiler
def test_auto_takes_a_tape_where_it_applies(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    model, plain = linear_walk(1.0, 0.3, 1.0), ParticleFilter(100)
    gaussian = gaussian_filter.GaussianFilter(
        linearisation_rules.SigmaPointLinearisation(CubaturePoints())
    )
    filter_pass._say_once.cache_clear()
    choose = filter_pass.choose_engine
    for engine in ("auto", "tape", "auto"):
        assert choose(engine, plain, model, 10, 400) == "tape"
        assert choose(engine, gaussian, model, 10, 400) == "kernels"
    assert choose("auto", plain, linear_walk(1.0, 0.3, 1.0).float(), 10, 400) == "kernels"
    said = [record.getMessage() for record in caplog.records]
    reason = "it is no filter of these stages"  # said once, to who asked for a tape
    assert said == [f"engine=tape: C++ operators, step by step ({reason})"]
    for engine in ("eager", "kernels", "compiled"):
        assert choose(engine, plain, model, 1, 10) == engine


def test_auto_runs_in_torch_operations_without_a_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(filter_pass, "is_library_loaded", lambda: False)
    model = linear_walk(1.0, 0.3, 1.0)
    for engine in ("auto", "kernels", "tape", "compiled"):
        assert filter_pass.choose_engine(engine, ParticleFilter(100), model, 10, 10) == "eager"


@compiler
@pytest.mark.filterwarnings("ignore")  # the compiler's own
def test_compiling_keeps_the_validation_of_distributions() -> None:
    """torch's compiler turns it off for the process: a negative count would then have a probability."""
    before = torch.distributions.Distribution._validate_args
    model = linear_walk(1.0, 0.3, 1.0)
    record = Record(torch.zeros(2, 3, 1, dtype=torch.float64))
    with dispatch.use_kernels():
        run_filter(ParticleFilter(20), model, record, PhiloxStream(1, torch.arange(2)))
    dispatch._compile_by_torch(lambda a: a + 1.0)(torch.ones(2))
    assert torch.distributions.Distribution._validate_args == before


def test_a_compiler_knows_the_results_of_operators() -> None:
    dispatch.prepare_compiler()
    with FakeTensorMode():
        x, ancestors = torch.empty(3, 2, 5), torch.empty(2, 4, dtype=torch.int64)
        assert torch.ops.pfbench.gather_particles(x, ancestors).shape == (3, 2, 4)
