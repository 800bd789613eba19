"""Resamplers: every scheme gives particle i on average n a_i copies, never indexes out of range, and loses nothing on the way."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from model_cases import Turning
from scipy import stats
from torch import Tensor

from pfbench.core.random_stream import PhiloxStream, RandomStream
from pfbench.filter import (
    EssResampler,
    Multinomial,
    RegularisedResampler,
    ResamplingScheme,
    Residual,
    Stratified,
    Systematic,
)
from pfbench.filter.belief import (
    ComputedWeights,
    ParticleBelief,
    ess,
    exponentiate,
    weighted_mean_cov,
)
from pfbench.filter.particle import resampling
from pfbench.model.linear_gaussian import linear_walk
from pfbench.testing import check_resampling

SCHEMES: list[ResamplingScheme] = [
    Systematic(),
    *(
        scheme()
        for scheme in vars(resampling).values()
        if isinstance(scheme, type) and scheme.__module__ == resampling.__name__
    ),
]
every_scheme = pytest.mark.parametrize("scheme", SCHEMES, ids=lambda s: type(s).__name__)
MODEL = linear_walk(1.0, 0.3, 1.0)


def uneven(n: int) -> np.ndarray:
    """Probabilities of all sizes, with zeros at both ends and inside, and one exact multiple of 1/n."""
    a = np.random.default_rng(0).gamma(0.5, size=n)
    a[[0, n // 2, 3, -1]] = 0.0
    a *= (1 - 2 / n) / a.sum()
    a[3] = 2 / n
    return a


def copies(scheme: ResamplingScheme, a: np.ndarray, wanted: int, runs: int) -> np.ndarray:
    """Copies of each particle in each run [runs, N]."""
    batch = torch.tensor(a).expand(runs, -1)
    n = torch.full((runs, 1), float(wanted), dtype=torch.float64)
    ancestors = scheme(batch, n, PhiloxStream(1, torch.arange(runs)).at_step(3))[:, :wanted]
    assert ancestors.dtype == torch.long
    assert int(ancestors.min()) >= 0
    assert int(ancestors.max()) < len(a)
    return torch.zeros(runs, len(a)).scatter_add(1, ancestors, torch.ones(ancestors.shape)).numpy()


@every_scheme
def test_average_copies(scheme: ResamplingScheme) -> None:
    check_resampling(scheme)


@every_scheme
@pytest.mark.parametrize("wanted", [1, 2, 17])
def test_average_copies_of_a_smaller_cloud(scheme: ResamplingScheme, wanted: int) -> None:
    check_resampling(scheme, slots=wanted)


@every_scheme
@pytest.mark.parametrize("n", [6, 7, 33])
def test_average_copies_of_odd_sizes(scheme: ResamplingScheme, n: int) -> None:
    check_resampling(scheme, n, runs=5000)


@dataclasses.dataclass(frozen=True)
class Wrong:
    """A scheme with a planted mistake."""

    mistake: Callable[[Tensor, Tensor, RandomStream], Tensor]

    def __call__(self, a: Tensor, n: Tensor, draws: RandomStream) -> Tensor:
        return self.mistake(a, n, draws)


def no_uniform(a: Tensor, n: Tensor, draws: RandomStream) -> Tensor:
    class Half:
        def uniform(self, *args: Any) -> Tensor:
            return torch.full_like(draws.uniform("resample", 1, 1), 0.5)

    return Systematic()(a, n, Half())  # type: ignore[arg-type]


def normalised(a: Tensor) -> Tensor:
    return a / a.sum(1, keepdim=True)


MISTAKES = {
    "off by one": lambda a, n, d: (Systematic()(a, n, d) + 1).clamp(max=a.shape[1] - 1),
    "weights sorted, ancestors not": lambda a, n, d: Systematic()(a.sort(1).values, n, d),
    "always the same uniform": no_uniform,
    "residual without its residue": lambda a, n, d: Residual()(
        normalised(torch.floor(a * n)), n, d
    ),
    "weights above 0 taken as equal": lambda a, n, d: Multinomial()(
        normalised((a > 0).double()), n, d
    ),
    "no resampling of nearly equal weights": lambda a, n, d: torch.where(
        a.amax(1, keepdim=True) < 1.2 * a.mean(1, keepdim=True),
        torch.arange(a.shape[1]),
        Systematic()(a, n, d),
    ),
    "the most probable takes all": lambda a, n, d: torch.where(
        a.amax(1, keepdim=True) > 0.9, a.argmax(1, keepdim=True), Systematic()(a, n, d)
    ),
    "the same random numbers in each step": lambda a, n, d: Systematic()(a, n, d.at_step(0)),
    "tempered": lambda a, n, d: Multinomial()(normalised(a**0.95), n, d),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_the_test_of_average_copies_sees_mistakes(mistake: str) -> None:
    with pytest.raises(AssertionError):
        check_resampling(Wrong(MISTAKES[mistake]))


# what each scheme promises beyond the average


def test_systematic_copies_are_within_one() -> None:
    counts, expected = copies(Systematic(), uneven(24), 24, 2000), 24 * uneven(24)
    assert np.abs(counts - expected).max() < 1.0


def test_residual_copies_are_at_least_the_whole_part() -> None:
    counts, expected = copies(Residual(), uneven(24), 24, 2000), 24 * uneven(24)
    assert np.all(counts >= np.floor(expected + 1e-9))


def test_stratified_copies_are_within_two() -> None:
    counts, expected = copies(Stratified(), uneven(24), 24, 2000), 24 * uneven(24)
    assert np.abs(counts - expected).max() < 2.0


def test_multinomial_variance() -> None:
    a, runs = uneven(24), 20_000
    counts = copies(Multinomial(), a, 24, runs)
    p = a[a > 0]
    variance = 24 * p * (1 - p)
    fourth = stats.binom(24, p).stats(moments="k") + 3.0
    error = variance * np.sqrt((fourth - 1) / runs)
    assert np.all(np.abs(counts.var(0)[a > 0] - variance) < 4.5 * error)


def test_low_variance_schemes_vary_less_than_multinomial() -> None:
    a = uneven(24)
    multinomial = copies(Multinomial(), a, 24, 5000).var(0).sum()
    for scheme in (Systematic(), Stratified(), Residual()):
        assert copies(scheme, a, 24, 5000).var(0).sum() < multinomial, scheme


@pytest.mark.parametrize(
    "scheme",
    [Systematic(), Stratified(), Residual()],
    ids=lambda s: type(s).__name__,
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("n", [7, 49, 1000, 1 << 12])
def test_equal_weights_keep_every_particle(
    scheme: ResamplingScheme, dtype: torch.dtype, n: int
) -> None:
    """n (1/n) is 1 - eps for many n (49 is the first in double precision); that must not turn certain copies into lots."""
    a = torch.softmax(torch.zeros(5, n, dtype=dtype), -1)
    ancestors = scheme(
        a, torch.full((5, 1), float(n), dtype=dtype), PhiloxStream(1, torch.arange(5))
    )
    changed = (ancestors != torch.arange(n)).double().mean()
    assert float(changed) < 3 / n  # a uniform within rounding of a boundary may move a few


@every_scheme
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_million_particles(scheme: ResamplingScheme, dtype: torch.dtype) -> None:
    n = 1_000_000
    log_a = PhiloxStream(2, torch.arange(1)).normal("a", n, 1)[..., 0].to(dtype)
    log_a[0, :5] = log_a[0, -5:] = -torch.inf
    hot = torch.full((1, n), -torch.inf, dtype=dtype)
    hot[0, 123_456] = 0.0
    a = 1.000005 * torch.softmax(
        torch.cat([log_a, hot]), -1
    )  # in float32 such a sum is off by as much
    ancestors = scheme(
        a, torch.full((2, 1), float(n), dtype=dtype), PhiloxStream(1, torch.arange(2)).at_step(1)
    )
    assert ancestors.shape == (2, n)
    assert int(ancestors.min()) >= 0
    assert int(ancestors.max()) < n
    counts = torch.bincount(ancestors[0], minlength=n).double()
    assert float(counts[:5].sum() + counts[-5:].sum()) == 0
    assert torch.all(ancestors[1] == 123_456)
    exact = a[0].double()
    expected = n * exact / exact.sum()
    if isinstance(scheme, Systematic):
        assert float((counts - expected).abs().max()) < 1.0 + 1e-3
    # a block of a thousand neighbours has a thousandth of the mass, plus or minus at most multinomial noise
    block = (counts - expected).reshape(1000, 1000).sum(1) / expected.reshape(1000, 1000).sum(
        1
    ).sqrt()
    assert float(block.abs().max()) < 5.0


@every_scheme
@pytest.mark.parametrize("word", [0, 0xFFFFFFFF])
def test_extreme_uniforms_stay_in_range(scheme: ResamplingScheme, word: int) -> None:
    """In single precision the largest uniform rounds to 1, and a first weight of 0 must not end below slot 0."""

    class Extreme:
        def uniform(self, purpose: str, n: int, w: int) -> Tensor:
            return torch.full((2, n, w), (word + 0.5) * 2.0**-32, dtype=torch.float64)

    for dtype in (torch.float32, torch.float64):
        a = torch.tensor([[0.0, 0.0, 0.3, 0.7, 0.0], [0.0, 0.0, 0.0, 0.0, 1.0]], dtype=dtype)
        ancestors = scheme(a, torch.full((2, 1), 5.0, dtype=dtype), Extreme())  # type: ignore[arg-type]
        assert set(ancestors[0].tolist()) <= {2, 3}
        assert set(ancestors[1].tolist()) == {4}


# clouds


def normal(runs: int, n: int, w: int, purpose: str = "x") -> Tensor:
    return PhiloxStream(4, torch.arange(runs)).normal(purpose, n, w)


def cloud(runs: int = 6, n: int = 50, uneven_runs: int = 3) -> ParticleBelief:
    """The first runs have uneven weights, the others equal ones; everything that travels carries the particle's number."""
    log_w = 2.0 * normal(runs, n, 1, "w")[..., 0]
    log_w[uneven_runs:] = 0.0
    ids = torch.arange(n, dtype=torch.float64).expand(runs, -1)
    x = torch.stack([ids, 100.0 * torch.arange(runs, dtype=torch.float64)[:, None] + ids], -1)
    window = {
        "states": x.unsqueeze(2).expand(-1, -1, 3, -1).clone(),
        "log_like": ids.unsqueeze(2).expand(-1, -1, 3).clone(),
    }
    memory = {
        "mean": x.clone(),
        "shared": torch.arange(runs, dtype=torch.float64).reshape(-1, 1, 1),
    }
    return ParticleBelief(
        x, log_w.log_softmax(-1), torch.arange(runs, dtype=torch.float64), window, memory
    )


def refresh(
    resampler: EssResampler | RegularisedResampler,
    before: ParticleBelief,
    log_a: Tensor | None = None,
    n: float | None = None,
) -> tuple[ParticleBelief, Tensor]:
    wanted = torch.full((before.x.shape[0], 1), n or float(before.x.shape[1]), dtype=torch.float64)
    draws = PhiloxStream(1, torch.arange(before.x.shape[0])).at_step(2)
    return resampler(MODEL, before, before.log_w if log_a is None else log_a, wanted, draws)


@every_scheme
def test_everything_travels_with_its_particle(scheme: ResamplingScheme) -> None:
    before = cloud()
    after, hit = refresh(EssResampler(scheme, 1.0), before)
    assert bool(hit.all())
    assert torch.equal(after.window["states"], after.x.unsqueeze(2).expand(-1, -1, 3, -1))
    assert torch.equal(after.window["log_like"], after.x[..., :1].expand(-1, -1, 3))
    assert torch.equal(after.memory["mean"], after.x)
    assert torch.equal(after.memory["shared"], before.memory["shared"])
    assert torch.equal(
        after.x[..., 1] - after.x[..., 0], before.x[..., 1] - before.x[..., 0]
    )  # of its own run
    assert torch.allclose(after.log_w, torch.full_like(after.log_w, -math.log(50)), atol=1e-12)
    assert torch.equal(after.log_evidence, before.log_evidence)


@every_scheme
def test_runs_that_are_not_hit_stay_as_they_are(scheme: ResamplingScheme) -> None:
    before = cloud()
    after, hit = refresh(EssResampler(scheme, 0.9), before)
    assert hit.tolist() == [True] * 3 + [False] * 3
    olds = (before.x, before.log_w, *before.window.values(), *before.memory.values())
    news = (after.x, after.log_w, *after.window.values(), *after.memory.values())
    for old, new in zip(olds, news, strict=True):
        assert torch.equal(old[3:], new[3:])
    assert not torch.equal(before.x[:3], after.x[:3])


def test_threshold_is_a_ratio_of_the_effective_sample_size() -> None:
    before = cloud()
    ratio = float(ess(before.log_w)[0] / 50)
    for threshold, expected in (
        (0.0, False),
        (ratio - 1e-6, False),
        (ratio + 1e-6, True),
        (1.0, True),
    ):
        assert bool(refresh(EssResampler(Systematic(), threshold), before)[1][0]) is expected
    assert bool(refresh(EssResampler(Systematic(), 1.0), before)[1].all())  # equal weights too
    assert not bool(refresh(EssResampler(Systematic(), 0.0), before)[1].any())
    smaller, _ = refresh(
        EssResampler(Systematic(), 1.0), before, n=20
    )  # 20 equal ones in 50 slots: of the number that is wanted
    for wanted, expected in ((20, False), (22, False), (23, True), (50, True)):
        assert (
            refresh(EssResampler(Systematic(), 0.9), smaller, n=wanted)[1].tolist()
            == [expected] * 6
        )


@every_scheme
def test_empty_slots_of_a_smaller_cloud(scheme: ResamplingScheme) -> None:
    before = cloud(uneven_runs=6)
    after, _ = refresh(EssResampler(scheme, 1.0), before, n=20)
    assert torch.all(after.log_w[:, 20:] == -torch.inf)
    assert torch.allclose(
        after.log_w[:, :20], torch.full((6, 20), -math.log(20), dtype=torch.float64), atol=1e-12
    )
    assert bool(torch.isfinite(after.x).all())
    again, _ = refresh(
        EssResampler(scheme, 1.0), after, n=50
    )  # growing: empty slots have no children
    living = {tuple(row) for row in after.x[0, :20].tolist()}
    assert {tuple(row) for row in again.x[0].tolist()} <= living
    assert torch.allclose(again.log_w.logsumexp(1), torch.zeros(6, dtype=torch.float64), atol=1e-12)


@every_scheme
def test_any_preference_is_corrected_by_the_weights(scheme: ResamplingScheme) -> None:
    """E sum_j w'_j f(x'_j) = sum_i w_i f(x_i), whatever the resampling probabilities."""
    runs, n = 20_000, 12
    one = cloud(1, n, 1)
    before = ParticleBelief(
        one.x.expand(runs, -1, -1),
        one.log_w.expand(runs, -1),
        torch.zeros(runs, dtype=torch.float64),
    )
    log_a = (0.5 * before.log_w + 0.3 * normal(1, n, 1, "a")[..., 0]).log_softmax(-1)
    after, _ = refresh(EssResampler(scheme, 1.0), before, log_a)
    for f in (torch.ones_like, torch.sin, torch.square):
        value = (after.log_w.exp() * f(after.x[..., 0])).sum(1)
        truth = float((one.log_w.exp() * f(one.x[..., 0])).sum())
        assert abs(float(value.mean()) - truth) < 4.5 * float(value.std()) / math.sqrt(runs) + 1e-12


# regularisation


def gaussian_cloud(runs: int, n: int) -> ParticleBelief:
    """Correlated particles of different units, uneven weights."""
    z = normal(runs, n, 2)
    x = torch.stack([1e4 + 100.0 * z[..., 0], 1e-5 * (z[..., 1] + 0.5 * z[..., 0])], -1)
    log_w = 0.5 * normal(runs, n, 1, "w")[..., 0]
    return ParticleBelief(x, log_w.log_softmax(-1), torch.zeros(runs, dtype=torch.float64))


@pytest.mark.parametrize("shrink", [False, True])
@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_regularisation_adds_the_kernel_s_covariance_or_keeps_the_cloud_s(
    shrink: bool, scale: float
) -> None:
    runs, n, d = 400, 200, 2
    before = gaussian_cloud(runs, n)
    after, hit = refresh(
        RegularisedResampler(EssResampler(Systematic(), 1.0), scale, shrink), before
    )
    assert bool(hit.all())
    h = scale * (4 / (d + 2)) ** (1 / (d + 4)) * n ** (-1 / (d + 4))
    (mean_0, cov_0), (mean_1, cov_1) = (
        weighted_mean_cov(MODEL.chart, before),
        weighted_mean_cov(MODEL.chart, after),
    )
    unit = cov_0.diagonal(dim1=-2, dim2=-1).sqrt()
    off = (mean_1 - mean_0) / unit
    assert torch.all(off.mean(0).abs() < 4.5 * off.std(0) / math.sqrt(runs))
    ratio = (cov_1 - (1.0 if shrink else 1 + h * h) * cov_0) / (
        unit.unsqueeze(-1) * unit.unsqueeze(-2)
    )
    # the covariance about a mean that itself moves by h / sqrt n is smaller by that square
    slack = 4.5 * ratio.std(0) / math.sqrt(runs) + 2 * h * h / n
    assert torch.all(ratio.mean(0).abs() < slack), ratio.mean(0)


def test_regularisation_leaves_other_runs_alone() -> None:
    before = cloud()
    after, hit = refresh(RegularisedResampler(EssResampler(Systematic(), 0.9)), before)
    assert hit.tolist() == [True] * 3 + [False] * 3
    assert torch.equal(after.x[3:], before.x[3:])
    assert torch.unique(after.x[0, :, 0]).numel() == 50  # copies have parted


def test_regularisation_of_a_collapsed_cloud_moves_nothing_far() -> None:
    before = cloud(2, 50, 0)
    before = before._replace(x=before.x[:, :1].expand(-1, 50, -1))
    after, _ = refresh(RegularisedResampler(EssResampler(Systematic(), 1.0)), before)
    assert float((after.x - before.x).abs().max()) < 1e-12  # a component without spread gets none


@pytest.mark.parametrize("is_lone", [False, True])
def test_copies_alone_are_moved_by_the_unbiased_covariance(is_lone: bool) -> None:
    runs, n, d = 2000, 12, 2
    before = gaussian_cloud(1, n)
    log_w = before.log_w.clone()
    log_w[:, 3] += 60.0 if is_lone else 1.0
    before = ParticleBelief(
        before.x.expand(runs, -1, -1), log_w.log_softmax(-1).expand(runs, -1), torch.zeros(runs)
    )
    resampler = EssResampler(Systematic(), 1.0)
    after, _ = refresh(
        RegularisedResampler(resampler, is_unbiased=True, moves_unique=False), before
    )
    copies, _ = refresh(resampler, before)
    counts = (copies.x.unsqueeze(1) == copies.x.unsqueeze(2)).all(-1).sum(2)
    assert torch.equal(after.x[counts == 1], copies.x[counts == 1])
    step = (after.x - copies.x)[counts > 1].numpy()
    w = np.full(n, 1.0 / n) if is_lone else before.log_w[0].exp().numpy()
    covariance = np.cov(before.x[0].T.numpy(), aweights=w)  # numpy divides by 1 - sum w^2
    h = (4 / (d + 2)) ** (1 / (d + 4)) * n ** (-1 / (d + 4))
    z = np.linalg.solve(h * np.linalg.cholesky(covariance), step.T)
    deviation = z @ z.T / len(step) - np.eye(d)
    assert np.all(np.abs(deviation) < 4.5 * math.sqrt(2.0 / len(step)))
    assert np.all(np.abs(z.mean(1)) < 4.5 / math.sqrt(len(step)))


def test_regularisation_respects_the_chart() -> None:
    model = Turning(np.eye(2), np.eye(2), np.eye(2), [1.0, 1.0], [0.0, 0.0], [1.0, 1.0])
    z = normal(1, 500, 2)
    x = model.chart.add(torch.tensor([math.pi, 0.0], dtype=torch.float64), 0.1 * z)
    before = ParticleBelief(
        x,
        torch.full((1, 500), -math.log(500), dtype=torch.float64),
        torch.zeros(1, dtype=torch.float64),
    )
    n = torch.full((1, 1), 500.0, dtype=torch.float64)
    for shrink in (False, True):
        method = RegularisedResampler(EssResampler(Systematic(), 1.0), shrink_to_mean=shrink)
        after, _ = method(model, before, before.log_w, n, PhiloxStream(1, torch.arange(1)))
        away = model.chart.subtract(after.x, torch.tensor([math.pi, 0.0], dtype=torch.float64))
        assert float(after.x[..., 0].abs().max()) <= math.pi
        assert float(away[..., 0].abs().max()) < 0.8  # a spread across the cut is 0.1, not pi


def test_only_weights_of_the_same_log_weights_are_used() -> None:
    """Weights of an earlier step would resample by the wrong probabilities."""
    log_w = torch.log_softmax(torch.randn(3, 40, dtype=torch.float64), 1)
    earlier = ComputedWeights(log_w.flip(1), log_w.flip(1).exp())
    x, evidence = torch.randn(3, 40, 2, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    belief = ParticleBelief(x, log_w, evidence, weights=earlier)
    torch.testing.assert_close(exponentiate(log_w, belief.weights), log_w.exp())
    draws, n = PhiloxStream(2, torch.arange(3)), torch.full((3, 1), 40.0, dtype=torch.float64)
    resampler = EssResampler(Systematic(), ess_threshold=1.0)
    fresh, _ = resampler(MODEL, belief._replace(weights=None), log_w, n, draws)
    stale, _ = resampler(MODEL, belief, log_w, n, draws)
    at_hand = belief._replace(weights=ComputedWeights(log_w, log_w.exp()))
    own, _ = resampler(MODEL, at_hand, log_w, n, draws)
    assert fresh.ancestors is not None
    for other in (stale, own):
        assert other.ancestors is not None
        assert torch.equal(fresh.ancestors, other.ancestors)
    assert at_hand.weights is not None
    assert exponentiate(log_w, at_hand.weights) is at_hand.weights.w
