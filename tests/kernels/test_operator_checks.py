"""The door of the C++ operators: wrong calls raise, in Python and in C++ for the same reason, and nothing crashes."""

import random
import shutil
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import random_calls
import scipy
import torch
from torch import Tensor

from pfbench.core import density, linear_algebra, random_stream
from pfbench.filter import belief
from pfbench.filter.gaussian import kalman_update, linearisation_rules
from pfbench.filter.particle import stages
from pfbench.filter.proposed import swarm_weighting
from pfbench.job import scoring
from pfbench.kernels import (
    dispatch,
    manifest,
    operator_sources,
)
from pfbench.kernels.manifest import check_arguments

COMPILER = shutil.which("c++") or shutil.which("g++")
compiler = pytest.mark.skipif(COMPILER is None, reason="no C++ compiler")

X, W = torch.rand(2, 3, 4), torch.rand(3, 4)
ONE = torch.ones(3, 1)


def test_the_cpp_sources_are_those_of_the_manifest() -> None:
    for name, text in operator_sources.make_sources().items():
        assert (manifest.KERNELS_FOLDER / "src" / name).read_text() == text, name
    for name in manifest.read_operators():
        assert getattr(dispatch, name).__name__ == name


@compiler
def test_random_calls_are_computed_or_refused() -> None:
    """Half of the calls are wrong in a shape, a type, a device or a value."""
    counts = random_calls.run(1500, 1)
    assert counts["computed"] > 500
    assert counts["refused"] > 500
    assert counts["wrong but computed"] == counts["valid but refused"] == 0


WRONG = {
    "index above": lambda: dispatch.gather_particles(X, torch.full((3, 2), 4)),
    "index below": lambda: dispatch.gather_particles(X, torch.full((3, 2), -1)),
    "large index": lambda: dispatch.gather_particles(X, torch.full((3, 2), 2**62)),
    "more particles than slots": lambda: dispatch.resample_systematic(W, 8 * ONE, 0.5 * ONE),
    "count below 0": lambda: dispatch.resample_systematic(W, -ONE, 0.5 * ONE),
    "count not a number": lambda: dispatch.resample_systematic(W, torch.nan * ONE, 0.5 * ONE),
    "uniform below 0": lambda: dispatch.resample_systematic(W, 4 * ONE, -9.0 * ONE),
    "uniform above 1": lambda: dispatch.resample_systematic(W, 4 * ONE, 1e9 * ONE),
    "ancestor above": lambda: dispatch.count_unique(torch.tensor([[0, 4]]), torch.zeros(1, 2)),
    "ancestor below": lambda: dispatch.count_unique(torch.tensor([[0, -1]]), torch.zeros(1, 2)),
    "group above": lambda: dispatch.group_covariance(
        torch.rand(1, 3, 2), torch.rand(1, 2), torch.rand(1, 3), torch.tensor([[0, 2]])
    ),
    "group below": lambda: dispatch.group_covariance(
        torch.rand(1, 3, 2), torch.rand(1, 2), torch.rand(1, 3), torch.tensor([[-1, 0]])
    ),
    "too many numbers": lambda: dispatch.philox_normals(
        torch.tensor(1), 1, torch.tensor(1), torch.arange(4), 2**29, 2**29
    ),
    "no particles": lambda: dispatch.marginal_scores(
        torch.rand(1, 2), torch.rand(1, 0, 2), torch.rand(1, 0)
    ),
}


@compiler
def test_wrong_values_are_refused() -> None:
    for call in WRONG.values():
        with pytest.raises(
            (ValueError, RuntimeError), match=r"must be from 0|more than|at least 1"
        ):
            call()


class GivenUniform(random_stream.PhiloxStream):
    """A stream whose uniform numbers are given, as `seed`."""

    def __post_init__(self) -> None:
        """Take any seed."""

    def uniform(self, purpose: str, n: int, w: int) -> Tensor:
        return torch.as_tensor(self.seed).unsqueeze(1)


def resample_by_parts(*args: Any) -> Any:
    """The stage of the particle filter without operators."""
    check_arguments("resample_particles", args)
    x, log_w, w, n, u, threshold = args
    cloud = belief.ParticleBelief(
        x.permute(1, 2, 0), log_w, log_w[:, 0], weights=belief.ComputedWeights(log_w, w)
    )
    resampler = stages.EssResampler(stages.Systematic(), float(threshold))
    n, draws = n.to(w.dtype).expand(len(w), 1), GivenUniform(u, torch.arange(len(w)))
    with dispatch.use_kernels(False):
        new, mask = resampler(None, cloud, log_w, n, draws)  # type: ignore[arg-type]
    return new.x.permute(2, 0, 1), new.log_w, new.ancestors, mask


def weigh_by_parts(*args: Any) -> Any:
    """The two functions that one operator stands for."""
    check_arguments("weigh_particles", args)
    x, log_w = args
    weights = belief.normalise_updated_weights(log_w)
    return *weights, *belief._flat_moments(x, weights[2])


def eager_function(name: str) -> Callable[..., Any]:
    """The function that pfbench calls for an operator."""
    return {
        "philox_normals": random_stream.draw_normals,
        "philox_normals_float64": random_stream.draw_normals_float64,
        "philox_uniforms": random_stream.draw_uniforms,
        "resample_systematic": stages._systematic,
        "gather_particles": belief._gather_components,
        "resample_particles": resample_by_parts,
        "weigh_particles": weigh_by_parts,
        "log_normal": density._quadratic,
        "log_observed_normal": density._density,
        "propagate_affine": linear_algebra._affine,
        "count_unique": belief.count_distinct_ancestors,
        "sum_and_squares": belief._totals,
        "sum_log_weights": belief._add_terms,
        "normalise_weights": belief.normalise_updated_weights,
        "log_mixture": swarm_weighting._mixture,
        "weighted_moments": belief._flat_moments,
        "cholesky_factor": linear_algebra.factor,
        "kalman_update": kalman_update._updated,
        "fit_affine": linearisation_rules._fitted,
        "group_covariance": belief.compute_spread,
        "squared_mahalanobis": linear_algebra.squared_length,
        "marginal_scores": scoring._marginal_scores,
        "energy_score": scoring._energy_score,
    }[name]


def valid_numbers(name: str, rng: random.Random) -> list[Any]:
    """A call whose results are defined: covariances are positive, and weights are not negative."""
    sizes = {axis: rng.randint(2, 9) for axis in "BDRNMWEKPGS"}
    call = random_calls.make_call(name, rng, sizes)
    arguments = random_calls.OPERATORS[name]
    for place, argument in enumerate(arguments):
        value = call[place]
        if argument.kind in ("real", "number") and argument.limit is None:
            call[place] = value = value.nan_to_num(0.5, 0.5, 0.5).clamp(0.0, 1.0)
            if argument.name in ("covariance", "omega"):
                call[place] = value @ value.mT + 0.5 * torch.eye(value.shape[-1], dtype=value.dtype)
            if argument.name == "sd":
                call[place] = value + 0.5
            if name == "log_observed_normal" and argument.name == "y":
                call[place] = value.masked_fill(value > 0.5, torch.nan)
            if argument.name in ("w", "a") and value.dim() == 2:
                call[place] = torch.softmax(5.0 * value, 1)
    return call


@compiler
@pytest.mark.parametrize("name", random_calls.ON_CPU)
def test_an_operator_computes_what_its_torch_function_does(name: str) -> None:
    """Random sizes, layouts and both precisions."""
    rng = random.Random(name)
    torch.manual_seed(11)
    for _ in range(12):
        call = valid_numbers(name, rng)
        expected, result = eager_function(name)(*call), getattr(dispatch, name)(*call)
        is_single = any(isinstance(a, torch.Tensor) and a.dtype == torch.float32 for a in call)
        tolerance = 2e-4 if is_single else 1e-9
        torch.testing.assert_close(
            result, expected, rtol=tolerance, atol=tolerance, check_dtype=False
        )


@compiler
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_normalised_weights_at_their_limits(dtype: torch.dtype) -> None:
    """Weights beyond the smallest number, and runs without a resolved weight, get what torch gives."""
    rows = torch.randn(6, 300, dtype=dtype, generator=torch.Generator().manual_seed(3))
    rows = rows * torch.tensor([1.0, 10.0, 100.0, 1e3, 3e4, 1e6], dtype=dtype)[:, None] - 50.0
    rows[2, 5:200] = -torch.inf
    rows = torch.cat([rows, rows[:5]])
    rows[6, 7] = torch.nan
    rows[7] = -torch.inf
    rows[8, 0] = torch.inf
    rows[9] -= 2.0 / torch.finfo(dtype).eps
    rows[10] = -3.0
    expected, result = belief._separate_normalise(rows), dispatch.normalise_weights(rows)
    tolerance = 2e-6 if dtype == torch.float32 else 1e-13
    for a, b in zip(result, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=tolerance, atol=tolerance)
    # every weight to its last places, down to the smallest normal number
    x = -torch.linspace(0.0, 80.0 if dtype == torch.float32 else 700.0, 4001, dtype=dtype)
    w = dispatch.normalise_weights(x[None])[2][0].double()
    reference = torch.exp(x.double())
    ratio = w / (reference / reference.sum())
    assert float((ratio / ratio[0] - 1.0).abs().max()) < 8.0 * torch.finfo(dtype).eps


@compiler
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_sum_of_log_weights_has_no_nan(dtype: torch.dtype) -> None:
    """NaN, and infinity minus infinity, become weight 0; a column holds for all particles of a run."""
    values = torch.tensor([0.5, -torch.inf, torch.inf, torch.nan, -3.0], dtype=dtype)
    grid = torch.cartesian_prod(values, values, values)
    terms, log_w, log_ratio = (grid[:, k].repeat(3, 1) for k in range(3))
    total = terms + log_w + log_ratio
    expected = torch.where(torch.isnan(total), -torch.inf, total)
    assert torch.equal(dispatch.sum_log_weights(terms, log_w, log_ratio), expected)
    assert torch.equal(belief._separate_sum(terms, log_w, log_ratio), expected)
    column = torch.tensor([[0.25], [-torch.inf], [torch.nan]], dtype=dtype)
    for a, b in ((column, column), (log_w, column), (column, log_ratio)):
        full = dispatch.sum_log_weights(terms, a.expand_as(terms), b.expand_as(terms))
        assert torch.equal(dispatch.sum_log_weights(terms, a, b), full)
        assert torch.equal(belief._separate_sum(terms, a, b), full)


@compiler
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [(1, 1, 1, 1), (3, 7, 5, 2), (2, 9, 33, 6)])
def test_a_mixture_of_kernels_is_that_of_scipy(
    size: tuple[int, int, int, int], dtype: torch.dtype
) -> None:
    """Also with a kernel of no weight, far from all kernels, where each density is 0, and in any memory layout."""
    runs, points, kernels, width = size
    rng = np.random.default_rng(5)
    a, centres = rng.normal(size=(runs, points, width)), rng.normal(size=(runs, kernels, width))
    a[0, 0] += 300.0
    log_w = rng.normal(size=(runs, kernels))
    log_w[0, 1:2] = -np.inf
    square = ((a[:, :, None] - centres[:, None]) ** 2).sum(-1)
    expected = scipy.special.logsumexp(log_w[:, None] - 0.5 * square, -1)
    made = [torch.as_tensor(value, dtype=dtype) for value in (a, centres, log_w)]
    laid = [value.mT.contiguous().mT for value in made[:2]]
    accuracy = 3e-5 if dtype == torch.float32 else 1e-13
    for points_of, centres_of in (made[:2], laid):
        value = dispatch.log_mixture(points_of, centres_of, made[2]).double().numpy()
        assert np.allclose(value, expected, rtol=accuracy, atol=accuracy)
    made[1][0, 0, 0] = torch.nan
    assert torch.isnan(dispatch.log_mixture(*made)[0]).all()
    assert torch.isinf(
        dispatch.log_mixture(*made[:2], torch.full_like(made[2], -torch.inf))[1:]
    ).all()


def refusal(call: Callable[..., Any], arguments: list[Any]) -> str:
    """Type and message of the error of a call; an empty text if there is none."""
    try:
        call(*arguments)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return ""


@compiler
@pytest.mark.parametrize("name", random_calls.ON_CPU)
def test_a_wrong_call_has_one_message_in_eager_mode_and_in_cpp(name: str) -> None:
    """Each argument of each operator: another kind, type, shape and range; and one too few."""
    rng = random.Random(name)
    valid = random_calls.make_call(name, rng, dict.fromkeys("BDRNMWEKPGS", 3))
    function = eager_function(name)
    assert refusal(function, valid) == refusal(getattr(dispatch, name), valid) == ""
    calls = [valid[:-1]]
    for place, argument in enumerate(random_calls.OPERATORS[name]):
        for value in random_calls.wrong_values(argument, valid[place]):
            calls.append([*valid[:place], value, *valid[place + 1 :]])
    torch.set_num_threads(1)
    for call in calls:
        message = refusal(function, call)
        assert message.startswith(f"ValueError: {name}"), message
        assert " must " in message
        assert refusal(getattr(dispatch, name), call) == message
        with dispatch.use_kernels():
            assert refusal(function, call) == message


def test_the_python_check_names_the_argument() -> None:
    cases = {
        r"gather_particles must have 2 arguments, got 1": ("gather_particles", [X]),
        r"gather_particles: x must be a tensor, got int": ("gather_particles", [3, W]),
        r"ancestors must be int64, got torch.float32": ("gather_particles", [X, W]),
        r"ancestors must have shape \[R, M\], got \[2, 4\] with D = 2, R = 3, N = 4": (
            "gather_particles",
            [X, torch.zeros(2, 4, dtype=torch.int64)],
        ),
        r"n must have shape \[R or 1, 1\], got \[4\]": (
            "resample_systematic",
            [W, torch.ones(4), ONE],
        ),
        r"quarters must be a whole number from 0 to 2\^32 - 1, got -1": (
            "philox_normals",
            [torch.tensor(1), 1, torch.tensor(1), torch.arange(2), 1, -1],
        ),
        r"w must be float32, got torch.float64": (
            "weighted_moments",
            [X, torch.rand(2, 3).double()],
        ),
    }
    for message, (name, arguments) in cases.items():
        with pytest.raises(ValueError, match=message):
            check_arguments(name, arguments)
    check_arguments("gather_particles", [X, torch.zeros(3, 9, dtype=torch.int64)])
