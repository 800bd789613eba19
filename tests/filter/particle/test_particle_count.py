"""Adaptive particle numbers, and the entropy regularisation of resampling probabilities."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from particle_cases import WALK, WALK_Y
from scipy import optimize
from torch import Tensor

from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    AdditiveTempering,
    AuxiliaryWeights,
    CountLimits,
    EssResampler,
    EssStepCount,
    Multinomial,
    ParticleBelief,
    ParticleFilter,
    PosteriorWeights,
    PowerTempering,
    ResamplingScheme,
    Stratified,
    Systematic,
    TemperedPosterior,
    TemperedWeights,
    Tempering,
    UniformTempering,
    run_filter,
)
from pfbench.kernels import dispatch
from pfbench.model.linear_gaussian import linear_walk
from pfbench.testing import check_evidence, reference_moments

STRENGTHS = [0.1, 0.5, 1.0]
FORMS = [PowerTempering, AdditiveTempering, UniformTempering]
NOTHING = Record(torch.zeros(1, 1))


def log_weights(values: Any, slots: int | None = None) -> Tensor:
    """Normalised, with empty slots behind."""
    w = torch.as_tensor(values, dtype=torch.float64)
    log_w = torch.log(w / w.sum(-1, keepdim=True))
    return torch.nn.functional.pad(
        log_w, (0, (slots or w.shape[-1]) - w.shape[-1]), value=-torch.inf
    )


def cloud(log_w: Tensor) -> ParticleBelief:
    x = torch.arange(log_w.numel(), dtype=torch.float64).reshape(*log_w.shape, 1)
    return ParticleBelief(x, log_w, torch.zeros(len(log_w), dtype=torch.float64))


SOME = log_weights([[0.5, 0.2, 0.2, 0.06, 0.04], [0.9, 0.07, 0.01, 0.01, 0.01]])


# entropy


@pytest.mark.parametrize("strength", STRENGTHS)
def test_temper_solves_its_own_problem(strength: float) -> None:
    """min over a of KL(a || W) - strength H(a), by a general optimiser on the simplex."""
    w = np.exp(SOME[0].numpy())

    def cost(free: np.ndarray) -> float:
        a = np.exp(free - free.max())
        a /= a.sum()
        return float((a * np.log(a / w)).sum() + strength * (a * np.log(a)).sum())

    best = optimize.minimize(cost, np.zeros(5), tol=1e-14).x
    best = np.exp(best - best.max())
    np.testing.assert_allclose(
        torch.exp(PowerTempering(strength)(SOME))[0].numpy(), best / best.sum(), atol=2e-6
    )


@pytest.mark.parametrize("strength", STRENGTHS)
def test_forms_are_what_they_say(strength: float) -> None:
    w = torch.exp(SOME)
    additive = w * (1.0 - strength * torch.log(w))
    torch.testing.assert_close(
        torch.exp(AdditiveTempering(strength)(SOME)), additive / additive.sum(1, keepdim=True)
    )
    torch.testing.assert_close(
        torch.exp(UniformTempering(strength)(SOME)), (1.0 - strength) * w + strength / 5.0
    )


@pytest.mark.parametrize("form", FORMS)
def test_more_strength_is_more_entropy(form: type) -> None:
    forms: list[Tempering] = [form(strength) for strength in (0.0, *STRENGTHS)]
    log_a = torch.stack([each(SOME) for each in forms])
    entropy = -(torch.exp(log_a) * log_a).sum(-1)
    assert (entropy.diff(dim=0) > 0.0).all()
    assert forms[0](SOME) is SOME  # nothing to be corrected


@pytest.mark.parametrize("form", FORMS)
def test_empty_slots_stay_empty_and_count_for_nothing(form: type) -> None:
    padded = torch.nn.functional.pad(SOME, (0, 3), value=-torch.inf)
    log_a = form(0.5)(padded)
    assert (log_a[:, 5:] == -torch.inf).all()
    assert not torch.isnan(log_a).any()
    torch.testing.assert_close(log_a[:, :5], form(0.5)(SOME))
    torch.testing.assert_close(log_a.logsumexp(1), torch.zeros(2, dtype=torch.float64))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    "scheme", [Systematic(), Stratified(), Multinomial()], ids=lambda s: type(s).__name__
)
def test_entropy_is_corrected_by_the_weights(scheme: ResamplingScheme, form: type) -> None:
    """E[counts] = N' a, and what a particle carries in all its copies is its weight on average; N' is not N."""
    runs, n = 20_000, 7
    padded = torch.nn.functional.pad(SOME[:1], (0, 4), value=-torch.inf).expand(runs, -1)
    before = cloud(padded)
    log_a = TemperedWeights(form(0.5))(WALK, before, NOTHING)
    after, hit = EssResampler(scheme, 1.0)(
        WALK,
        before,
        log_a,
        torch.full((runs, 1), float(n), dtype=torch.float64),
        PhiloxStream(1, torch.arange(runs)),
    )
    assert hit.all()
    assert not torch.isnan(after.log_w).any()
    assert ((after.log_w > -torch.inf) == (torch.arange(9) < n)).all()
    from_which = (after.x[..., 0] % 9).long()
    used = (after.log_w > -torch.inf).double()
    counts = torch.zeros(runs, 9, dtype=torch.float64).scatter_add(1, from_which, used)
    carried = torch.zeros(runs, 9, dtype=torch.float64).scatter_add(
        1, from_which, torch.exp(after.log_w)
    )
    for value, expected in (
        (counts, n * torch.exp(log_a[0])),
        (carried, torch.exp(padded[0])),
        (carried.sum(1), torch.ones(())),
    ):
        error = value.std(0) / math.sqrt(runs) + 1e-9
        assert ((value.mean(0) - expected).abs() < 4.5 * error).all()


def test_flattened_weights_keep_their_sum_and_the_lost_runs() -> None:
    weigh = TemperedPosterior(
        PowerTempering(0.5),
        lambda *_: torch.cat([SOME - 3.0, torch.full((1, 5), -torch.inf, dtype=torch.float64)]),
    )  # type: ignore[arg-type]
    assert not weigh.is_exact
    log_w = weigh(WALK, SOME, SOME, SOME, NOTHING)
    torch.testing.assert_close(log_w[:2].logsumexp(1), torch.full((2,), -3.0, dtype=torch.float64))
    torch.testing.assert_close(torch.log_softmax(log_w[:2], 1), PowerTempering(0.5)(SOME))
    assert (log_w[2] == -torch.inf).all()


# sizes


def test_a_step_up_or_down() -> None:
    """Run by run, by the ESS of the weights; 45 of 100 is below half, 55 above; bounds hold."""
    size = EssStepCount(increment=10, ess_threshold=0.5, limits=CountLimits(95, 105, 100))

    def of(effective: int, n: int = 100) -> Tensor:
        """n particles, all but `effective` of them with weights that are next to nothing."""
        return log_weights([1.0] * effective + [1e-12] * (n - effective), 120)

    wanted = size(cloud(torch.stack([of(45), of(55)])))
    assert wanted.tolist() == [[105.0], [95.0]]
    free = EssStepCount(10, 0.5, CountLimits(10, 120, 100))
    assert free(cloud(torch.stack([of(45), of(55), of(45, 115), of(14, 15)]))).tolist() == [
        [110.0],
        [90.0],
        [120.0],
        [10.0],
    ]
    assert EssStepCount(0, 0.5, CountLimits(10, 120, 100))(
        cloud(torch.stack([of(45), of(20, 60)]))
    ).tolist() == [[100.0], [100.0]]
    assert EssStepCount(10, 0.3, CountLimits(10, 120, 100))(cloud(of(45)[None])).tolist() == [
        [90.0]
    ]


FEW = CountLimits(10, 40, 25)


@pytest.mark.parametrize("threshold", [0.5, 1.0])
def test_a_changing_number_leaves_everything_unbiased(threshold: float) -> None:
    size = EssStepCount(7, 0.6, FEW)
    method = ParticleFilter(40, EssResampler(Systematic(), threshold), size, TemperedWeights())
    assert method.is_exact
    check_evidence(method, WALK, WALK_Y, reference_moments(WALK, WALK_Y))


@pytest.mark.parametrize(
    "preference",
    [PosteriorWeights(), TemperedWeights(PowerTempering(1.0))],
    ids=["weights", "entropy"],
)
def test_the_number_changes_from_step_to_step_without_a_nan(preference: AuxiliaryWeights) -> None:
    """What is decided at t - 1 holds at t, by the weights and not by what a resampler prefers; slots beyond it are empty; a run
    does not follow its neighbours."""
    size = EssStepCount(7, 0.6, FEW)
    method = ParticleFilter(40, EssResampler(Systematic(), 1.0), size, preference)
    draws = PhiloxStream(1, torch.arange(30))
    belief, seen = method.init(WALK, 30, draws.at_step(0)), set()
    assert (belief.log_w > -torch.inf).sum(1).unique().tolist() == [25]
    for t in range(1, 15):
        wanted = size(belief).flatten()
        belief, info = method.step(
            WALK,
            belief,
            Record(torch.full((30, 1), 0.5 * t, dtype=torch.float64)),
            draws.at_step(t),
        )
        assert torch.equal(info.trace["particles"].double(), wanted)
        assert not torch.isnan(belief.log_w).any()
        assert torch.equal((belief.log_w > -torch.inf).sum(1).double(), wanted)
        assert ((belief.log_w > -torch.inf) == (torch.arange(40) < wanted[:, None])).all()
        seen |= set(wanted.tolist())
    assert len(seen) > 3


@dataclass(frozen=True)
class TooMany:
    """A user's stage that asks for more particles than there are slots."""

    is_exact = True
    factor: float = 2.0

    def initial_count(self, slots: int) -> int:
        return slots

    def __call__(self, belief: ParticleBelief) -> torch.Tensor:
        runs, slots = belief.log_w.shape
        return torch.full((runs, 1), self.factor * slots, dtype=torch.float64)


@pytest.mark.parametrize("compiled", [False, True])
def test_a_stage_that_asks_for_too_many_particles_is_refused(compiled: bool) -> None:
    record = Record(torch.zeros(2, 3, 1, dtype=torch.float64))
    draws = PhiloxStream(1, torch.arange(2))
    for factor in (2.0, 0.0, -1.0, torch.nan):
        method = ParticleFilter(20, particle_count=TooMany(factor))
        with (
            dispatch.use_kernels(compiled),
            pytest.raises(ValueError, match=r"from 1 to 20 slots"),
        ):
            run_filter(method, linear_walk(1.0, 0.3, 1.0), record, draws)
    run_filter(
        ParticleFilter(20, particle_count=TooMany(1.0)), linear_walk(1.0, 0.3, 1.0), record, draws
    )
