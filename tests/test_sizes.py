"""Adaptive particle numbers, and the entropy regularisation of resampling probabilities."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from scipy import optimize
from test_particle_filters import WALK, WALK_Y, check_unbiased, kalman
from torch import Tensor

from pfbench.draws import MonteCarlo
from pfbench.filter.belief import Cloud, ess
from pfbench.filter.particle import ParticleFilter
from pfbench.filter.preferences import Additive, Entropy, Flattened, Form, Mix, Preference, Temper, Weights
from pfbench.filter.resamplers import Multinomial, Resample, Scheme, Stratified, Systematic
from pfbench.filter.sizes import Bounds, EssStep, EssTarget, Size
from pfbench.record import Record

STRENGTHS = [0.1, 0.5, 1.0]
FORMS = [Temper, Additive, Mix]
NOTHING = Record(torch.zeros(1, 1))


def log_weights(values: Any, slots: int | None = None) -> Tensor:
    """Normalised, with empty slots behind."""
    w = torch.as_tensor(values, dtype=torch.float64)
    log_w = torch.log(w / w.sum(-1, keepdim=True))
    return torch.nn.functional.pad(log_w, (0, (slots or w.shape[-1]) - w.shape[-1]), value=-torch.inf)


def cloud(log_w: Tensor) -> Cloud:
    x = torch.arange(log_w.numel(), dtype=torch.float64).reshape(*log_w.shape, 1)
    return Cloud(x, log_w, torch.zeros(len(log_w), dtype=torch.float64))


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
    np.testing.assert_allclose(torch.exp(Temper(strength)(SOME))[0].numpy(), best / best.sum(), atol=2e-6)


@pytest.mark.parametrize("strength", STRENGTHS)
def test_forms_are_what_they_say(strength: float) -> None:
    w = torch.exp(SOME)
    additive = w * (1.0 - strength * torch.log(w))
    torch.testing.assert_close(torch.exp(Additive(strength)(SOME)), additive / additive.sum(1, keepdim=True))
    torch.testing.assert_close(torch.exp(Mix(strength)(SOME)), (1.0 - strength) * w + strength / 5.0)


@pytest.mark.parametrize("form", FORMS)
def test_more_strength_is_more_entropy(form: type) -> None:
    forms: list[Form] = [form(strength) for strength in (0.0, *STRENGTHS)]
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
@pytest.mark.parametrize("scheme", [Systematic(), Stratified(), Multinomial()], ids=lambda s: type(s).__name__)
def test_entropy_is_corrected_by_the_weights(scheme: Scheme, form: type) -> None:
    """E[counts] = N' a, and what a particle carries in all its copies is its weight on average; N' is not N."""
    runs, n = 20_000, 7
    padded = torch.nn.functional.pad(SOME[:1], (0, 4), value=-torch.inf).expand(runs, -1)
    before = cloud(padded)
    log_a = Entropy(form(0.5))(WALK, before, NOTHING)
    after, hit = Resample(scheme, 1.0)(
        WALK, before, log_a, torch.full((runs, 1), float(n), dtype=torch.float64), MonteCarlo(1, torch.arange(runs))
    )
    assert hit.all()
    assert not torch.isnan(after.log_w).any()
    assert ((after.log_w > -torch.inf) == (torch.arange(9) < n)).all()
    from_which = (after.x[..., 0] % 9).long()
    used = (after.log_w > -torch.inf).double()
    counts = torch.zeros(runs, 9, dtype=torch.float64).scatter_add(1, from_which, used)
    carried = torch.zeros(runs, 9, dtype=torch.float64).scatter_add(1, from_which, torch.exp(after.log_w))
    for value, expected in ((counts, n * torch.exp(log_a[0])), (carried, torch.exp(padded[0])), (carried.sum(1), torch.ones(()))):
        error = value.std(0) / math.sqrt(runs) + 1e-9
        assert ((value.mean(0) - expected).abs() < 4.5 * error).all()


def test_flattened_weights_keep_their_sum_and_the_lost_runs() -> None:
    weigh = Flattened(Temper(0.5), lambda *_: torch.cat([SOME - 3.0, torch.full((1, 5), -torch.inf, dtype=torch.float64)]))  # type: ignore[arg-type]
    assert not weigh.exact
    log_w = weigh(WALK, SOME, SOME, SOME, NOTHING)
    torch.testing.assert_close(log_w[:2].logsumexp(1), torch.full((2,), -3.0, dtype=torch.float64))
    torch.testing.assert_close(torch.log_softmax(log_w[:2], 1), Temper(0.5)(SOME))
    assert (log_w[2] == -torch.inf).all()


@pytest.mark.parametrize(("form", "strength"), [(Temper, -0.1), (Additive, -1.0), (Mix, 1.1), (Mix, math.nan)])
def test_a_strength_out_of_range_is_named(form: type, strength: float) -> None:
    with pytest.raises(ValueError, match=r"form\.strength="):
        form(strength)


# sizes


def test_a_step_up_or_down() -> None:
    """Run by run, by the ESS of the weights; 45 of 100 is below half, 55 above; bounds hold."""
    size = EssStep(step=10, threshold=0.5, bounds=Bounds(95, 105, 100))

    def of(effective: int, n: int = 100) -> Tensor:
        """n particles, all but `effective` of them with weights that are next to nothing."""
        return log_weights([1.0] * effective + [1e-12] * (n - effective), 120)

    wanted = size(cloud(torch.stack([of(45), of(55)])))
    assert wanted.tolist() == [[105.0], [95.0]]
    free = EssStep(10, 0.5, Bounds(10, 120, 100))
    assert free(cloud(torch.stack([of(45), of(55), of(45, 115), of(14, 15)]))).tolist() == [[110.0], [90.0], [120.0], [10.0]]
    assert EssStep(0, 0.5, Bounds(10, 120, 100))(cloud(torch.stack([of(45), of(20, 60)]))).tolist() == [[100.0], [100.0]]
    assert EssStep(10, 0.3, Bounds(10, 120, 100))(cloud(of(45)[None])).tolist() == [[90.0]]


def test_an_effective_size_is_aimed_at() -> None:
    size = EssTarget(40.0, Bounds(20, 100, 50))
    log_w = torch.stack([log_weights([1.0] * n + [1e-12] * (50 - n), 100) for n in (25, 50, 10)])
    torch.testing.assert_close(ess(log_w), torch.tensor([25.0, 50.0, 10.0], dtype=torch.float64))
    assert size(cloud(log_w)).tolist() == [[80.0], [40.0], [100.0]]


FEW = Bounds(10, 40, 25)


@pytest.mark.parametrize("size", [EssStep(7, 0.6, FEW), EssTarget(15.0, FEW)], ids=lambda s: type(s).__name__)
@pytest.mark.parametrize("threshold", [0.5, 1.0])
def test_a_changing_number_leaves_everything_unbiased(size: Size, threshold: float) -> None:
    method = ParticleFilter(40, Resample(Systematic(), threshold), size, Entropy())
    assert method.exact
    check_unbiased(method, WALK, WALK_Y, kalman(WALK, WALK_Y))


@pytest.mark.parametrize("preference", [Weights(), Entropy(Temper(1.0))], ids=["weights", "entropy"])
def test_the_number_changes_from_step_to_step_without_a_nan(preference: Preference) -> None:
    """What is decided at t - 1 holds at t, by the weights and not by what a resampler prefers; slots beyond it are empty; a run
    does not follow its neighbours."""
    size = EssStep(7, 0.6, FEW)
    method = ParticleFilter(40, Resample(Systematic(), 1.0), size, preference)
    draws = MonteCarlo(1, torch.arange(30))
    belief, seen = method.init(WALK, 30, draws.at(0)), set()
    assert (belief.log_w > -torch.inf).sum(1).unique().tolist() == [25]
    for t in range(1, 15):
        wanted = size(belief).flatten()
        belief, info = method.step(WALK, belief, Record(torch.full((30, 1), 0.5 * t, dtype=torch.float64)), draws.at(t))
        assert torch.equal(info.trace["particles"].double(), wanted)
        assert not torch.isnan(belief.log_w).any()
        assert torch.equal((belief.log_w > -torch.inf).sum(1).double(), wanted)
        assert ((belief.log_w > -torch.inf) == (torch.arange(40) < wanted[:, None])).all()
        seen |= set(wanted.tolist())
    assert len(seen) > 3


@pytest.mark.parametrize(
    ("make", "key"),
    [
        (lambda: Bounds(200, 300, 100), "least=200"),
        (lambda: EssStep(-1), "size.step=-1"),
        (lambda: EssStep(threshold=1.5), "threshold=1.5"),
        (lambda: EssTarget(0.0), "size.target=0.0"),
        (lambda: ParticleFilter(50, size=EssStep()).init(WALK, 2, MonteCarlo(1, torch.arange(2))), "size.bounds.most=200"),
        (lambda: ParticleFilter(50, size=EssTarget()).init(WALK, 2, MonteCarlo(1, torch.arange(2))), "size.bounds.most=1000"),
    ],
)
def test_bad_arguments_are_named(make: Any, key: str) -> None:
    with pytest.raises(ValueError, match=key):
        make()
