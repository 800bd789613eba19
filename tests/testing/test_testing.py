"""pfbench.testing: what is right passes, planted faults fail with numbers, and a silent stage is never called exact."""

import ast
import dataclasses
import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from move_cases import Always
from refusals import check_refused
from torch import Tensor
from typing_extensions import override

import pfbench.testing
from pfbench.core import RandomStream, Record
from pfbench.filter import (
    BayesWeightUpdate,
    BootstrapProposal,
    EssResampler,
    FilterResult,
    GaussianFilter,
    GuidedNoiseProposal,
    HilbertSortedResampler,
    LastStateKernel,
    LookAheadWeights,
    MetropolisHastings,
    Multinomial,
    NoiseFlowKernel,
    NoiseFlowStatKernel,
    ParticleBelief,
    ParticleFilter,
    PathBlockKernel,
    ProposalSample,
    RegularisedResampler,
    Residual,
    SmoothedSegment,
    SoftResampler,
    SqmcProposal,
    SqmcScheme,
    StopGradientResampler,
    Systematic,
    TaylorLinearisation,
    TemperedPosterior,
    TemperedWeights,
)
from pfbench.filter.exactness import has_bounded_weights
from pfbench.model import StateSpaceModel, linear_walk
from pfbench.testing import (
    check_causality,
    check_convergence,
    check_evidence,
    check_filter,
    check_independence,
    check_jacobians,
    check_move,
    check_proposal,
    check_resampling,
    filter_record,
)

EKF = GaussianFilter(TaylorLinearisation())


@dataclasses.dataclass(frozen=True)
class HalfToFirst:
    """A scheme that gives half of the slots to particle 0."""

    def __call__(self, a: Tensor, n: Tensor, draws: RandomStream) -> Tensor:
        ancestors = Systematic()(a, n, draws)
        slots = torch.arange(a.shape[1])
        return torch.where(2 * slots < n, 0, ancestors)


@dataclasses.dataclass(frozen=True)
class StatesOnly:
    """A resampler that forgets to copy what belongs to the particles."""

    is_exact = True

    def __call__(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        log_a: Tensor,
        n: Tensor,
        draws: RandomStream,
    ) -> tuple[ParticleBelief, Tensor]:
        after, touched = EssResampler(Systematic(), 1.0)(model, belief, log_a, n, draws)
        return after._replace(window=belief.window), touched


@dataclasses.dataclass(frozen=True)
class Wide:
    """A proposal of twice the noise, with a ratio for noise of another size."""

    claimed: float
    is_exact = True

    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> ProposalSample:
        z = draws.normal("noise", belief.x.shape[1], model.noise_dim)
        w = 2.0 * z
        z = w / self.claimed
        log_ratio = (0.5 * z * z - 0.5 * w * w + math.log(self.claimed)).sum(-1)
        return ProposalSample(model.propagate(belief.x, record.u, w), log_ratio, belief.memory, w)


@dataclasses.dataclass(frozen=True)
class Scaled(BayesWeightUpdate):
    """Weights times a factor: the estimate stays right, the evidence does not."""

    factor: float = 1.05
    is_exact = True  # a false statement

    def __call__(
        self, model: StateSpaceModel, log_w: Tensor, x: Tensor, log_ratio: Tensor, record: Record
    ) -> Tensor:
        return super().__call__(model, log_w, x, log_ratio, record) + math.log(self.factor)


@dataclasses.dataclass(frozen=True)
class Mixing(BootstrapProposal):
    """Noise that depends on the other runs of the batch."""

    is_exact = True  # a false statement

    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> ProposalSample:
        sent = super().__call__(model, belief, record, draws)
        return sent._replace(x=sent.x + 1e-6 * sent.x.mean(0, keepdim=True))


@dataclasses.dataclass(frozen=True)
class GlobalNoise(BootstrapProposal):
    """A proposal that draws from the generator of torch."""

    is_exact = True

    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> ProposalSample:
        w = torch.randn(*belief.x.shape[:2], model.noise_dim, dtype=belief.x.dtype)
        x = model.propagate(belief.x, record.u, w)
        return ProposalSample(x, torch.zeros_like(belief.log_w), belief.memory, w)


@dataclasses.dataclass(frozen=True)
class GlobalScheme:
    """Multinomial resampling with the generator of torch."""

    is_exact = True

    def __call__(self, a: Tensor, n: Tensor, draws: RandomStream) -> Tensor:
        return torch.multinomial(a, a.shape[1], replacement=True)


@dataclasses.dataclass(frozen=True)
class GlobalKernel(LastStateKernel):
    """A kernel with steps of the generator of torch."""

    def propose(
        self, model: StateSpaceModel, belief: ParticleBelief, draws: RandomStream
    ) -> tuple[ParticleBelief, Tensor]:
        x = belief.x + 1e-3 * torch.randn_like(belief.x)
        return belief._replace(x=x), torch.zeros_like(belief.log_w)


def peek(method: Any, model: StateSpaceModel, y: Tensor) -> FilterResult:
    """Filters records that come one step early."""
    return filter_record(method, model, torch.cat([y[:, 1:], y[:, -1:]], 1))


# what is right passes


@pytest.mark.parametrize(
    "stage",
    [
        Systematic(), Residual(), EssResampler(Residual(), 0.5), EssResampler(Multinomial(), 0.0), SoftResampler(0.5), StopGradientResampler(),
        HilbertSortedResampler(EssResampler(SqmcScheme(), 1.0)),
    ],
    ids=lambda s: type(s).__name__,
)  # fmt: skip
def test_resamplers_pass(stage: Any) -> None:
    assert check_resampling(stage).statistic > 1e-4


def test_moves_pass_as_kernels_and_as_moves() -> None:
    for move in (
        PathBlockKernel(3, SmoothedSegment()),
        NoiseFlowStatKernel(),
        MetropolisHastings(NoiseFlowKernel(10), 6),
    ):
        assert check_move(move, paths=500).details["moved"] > 0.5


def test_proposals_pass() -> None:
    for proposal in (BootstrapProposal(), SqmcProposal(), Wide(2.0)):
        assert check_proposal(proposal).statistic < 4.5


def test_a_filter_is_checked_in_one_line() -> None:
    assert set(check_filter(ParticleFilter(50), runs=400)) == {
        "causality",
        "independence",
        "evidence",
        "convergence",
        "bounded errors",
        "bounded weights",
    }
    inexact = ParticleFilter(50, RegularisedResampler(EssResampler(Systematic())))
    assert set(check_filter(inexact)) == {"causality", "independence", "bounded weights"}
    guided = ParticleFilter(50, proposal=GuidedNoiseProposal(EKF, defensive_fraction=0.0))
    assert "bounded weights" not in check_filter(guided, runs=400)


class Excluding(LookAheadWeights):
    """The published look-ahead, which states more than it holds."""

    is_exact = True
    has_bounded_weights = True


class Unbounded(GuidedNoiseProposal):
    """A guide without a share of the model that states a bound."""

    has_bounded_weights = True


FALSE_STATEMENTS = {
    "the evidence is unbiased": ParticleFilter(
        200, auxiliary_weights=Excluding(defensive_fraction=0.0)
    ),
    "density ratios are bounded": ParticleFilter(
        100, proposal=Unbounded(EKF, defensive_fraction=0.0)
    ),
}


@pytest.mark.parametrize("statement", FALSE_STATEMENTS)
def test_false_statements_on_support_and_weights_fail(statement: str) -> None:
    with pytest.raises(AssertionError, match=statement):
        check_filter(FALSE_STATEMENTS[statement], runs=400)


def test_a_silent_part_has_no_bound_and_an_override_is_silent() -> None:
    """Without a warning: silence is an answer. A filter without particles has no weights."""

    class Own(BootstrapProposal):
        def __call__(self, *inputs: Any) -> Any:
            return super().__call__(*inputs)

        is_exact = True

    class Stated(Own):
        has_bounded_weights = True

    assert has_bounded_weights(ParticleFilter(10))
    assert has_bounded_weights(ParticleFilter(10, proposal=Own())) is False
    assert has_bounded_weights(ParticleFilter(10, proposal=Stated()))
    assert ParticleFilter(10, proposal=Stated()).is_exact
    assert has_bounded_weights(EKF) is None


# planted faults fail

FAULTS: dict[str, tuple[Callable[[], Any], str]] = {
    "a scheme that prefers a particle": (lambda: check_resampling(HalfToFirst()), "weight 0 was copied"),
    "a resampler that is not unbiased": (lambda: check_resampling(EssResampler(HalfToFirst(), 1.0)), "weight 0"),
    "a window that does not go with its particle": (lambda: check_resampling(StatesOnly()), "of one particle"),
    "particles that are moved, not copied": (lambda: check_resampling(RegularisedResampler(EssResampler(Systematic(), 1.0))), "of one"),
    "a move that accepts everything": (lambda: check_move(Always(LastStateKernel())), "p = "),
    "a move that does nothing": (lambda: check_move(MetropolisHastings(LastStateKernel(), 0)), "must move to decide"),
    "a ratio of another proposal": (lambda: check_proposal(Wide(1.8)), r"\+-"),
    "no ratio": (lambda: check_proposal(Wide(1.0)), r"\+-"),
    "an evidence off by 5 percent a step": (lambda: check_evidence(ParticleFilter(100, weight_update=Scaled())), r"Z_hat / Z.* \+-"),
    "flattened weights": (lambda: check_evidence(ParticleFilter(100, weight_update=TemperedPosterior())), r"\+-"),
    "weights for good, with many particles": (
        lambda: check_convergence(ParticleFilter(100, weight_update=TemperedPosterior()), runs=40, faster=True), "slope must be -0.5"
    ),
    "a filter that peeks": (lambda: check_causality(ParticleFilter(50), run=peek), "must not change, got"),
    "runs that mix": (lambda: check_independence(ParticleFilter(50, proposal=Mixing())), "differs by"),
    "a proposal with other random numbers": (lambda: check_proposal(GlobalNoise()), "not repeatable.*from `draws`"),
    "a scheme with other random numbers": (lambda: check_resampling(GlobalScheme()), "not repeatable.*from `draws`"),
    "a kernel with other random numbers": (lambda: check_move(GlobalKernel()), "not repeatable.*from `draws`"),
    "a filter with other random numbers": (lambda: check_filter(ParticleFilter(50, proposal=GlobalNoise())), "a filter.* not repeatable.*from `draws`"),
    "runs with other random numbers": (lambda: check_independence(ParticleFilter(50, proposal=GlobalNoise())), "a filter.* not repeatable"),
    "too few runs": (lambda: check_evidence(ParticleFilter(3), runs=20), "too uncertain"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_planted_faults_fail_with_numbers(fault: str) -> None:
    check, message = FAULTS[fault]
    with pytest.raises(AssertionError, match=message):
        check()


def test_a_model_without_its_record_is_refused() -> None:
    check_refused(
        [
            (
                "model and y must be given together",
                lambda: check_evidence(ParticleFilter(10), y=torch.zeros(1, 1)),
            )
        ],
        remedy=False,
    )


class NoStage:
    """An object that is no stage."""


NOT_TESTED = {
    "5": ("5", 5),
    "a class": ("the class NoStage", NoStage),
    "a class of a stage": ("the class Systematic", Systematic),
    "an object": ("NoStage", NoStage()),
}


@pytest.mark.parametrize("name", NOT_TESTED)
def test_what_is_no_stage_is_refused_with_a_remedy(name: str) -> None:
    text, item = NOT_TESTED[name]
    for check in (check_resampling, check_move, check_proposal, check_convergence):
        with pytest.raises(ValueError, match=f"{check.__name__}: .* must be .*got {text}. Pass an"):
            check(item)
    kind = "int" if name == "5" else text
    for tester in (check_filter, check_evidence, check_causality, check_independence):
        with pytest.raises(ValueError, match=f"method must be a filter.*got {kind}. Pass an inst"):
            tester(item)  # type: ignore[operator]


def test_a_filter_in_place_of_a_stage_is_refused_with_a_remedy() -> None:
    for check in (check_resampling, check_move, check_proposal):
        with pytest.raises(ValueError, match=r"got the filter ParticleFilter\. .*by check_filter"):
            check(ParticleFilter(10))  # type: ignore[arg-type]


NOT_TESTABLE: dict[str, tuple[Callable[[], Any], str]] = {
    "a model of another type": (lambda: check_evidence(ParticleFilter(10), 5, torch.zeros(3, 1)), "model must be a StateSpaceModel, got 5"),  # type: ignore[arg-type]
    "a list": (lambda: check_causality(ParticleFilter(10), linear_walk(1.0, 1.0, 1.0), [0.0]), r"y must be a tensor \[R, T, Dy\], got list"),  # type: ignore[arg-type]
    "another shape": (lambda: check_evidence(ParticleFilter(10), linear_walk(1.0, 1.0, 1.0), torch.zeros(3)), r"y must be a tensor \[T, Dy\], got shape \[3\]"),
    "no model": (lambda: filter_record(ParticleFilter(10), None, torch.zeros(3, 1)), "filter_record: model must be"),  # type: ignore[arg-type]
    "one run": (lambda: check_filter(ParticleFilter(10), runs=1), "runs must be a whole number of at least 2, got 1"),
    "two particles": (lambda: check_resampling(Systematic(), particles=2), "particles must be a whole number of at least 4, got 2"),
    "half a path": (lambda: check_move(MetropolisHastings(LastStateKernel()), paths=0.5), "paths must be .*got 0.5"),  # type: ignore[arg-type]
    "states of another size": (lambda: check_jacobians(linear_walk(1.0, 1.0, 1.0), torch.zeros(3, 1), ()), r"x must have shape \[R, N, 2\], got \[3, 1\]"),
}  # fmt: skip


@pytest.mark.parametrize("name", NOT_TESTABLE)
def test_wrong_arguments_are_refused_with_key_value_and_remedy(name: str) -> None:
    check, message = NOT_TESTABLE[name]
    check_refused([(message, lambda: check())], remedy=False)


# exactness is asked of every part


class Silent:
    """Any stage; it does not state whether it is exact."""

    required_history = None

    def __call__(self, *args: Any) -> Any:
        raise NotImplementedError


SILENT = {
    "scheme": lambda s: ParticleFilter(10, EssResampler(s)),
    "scheme under a sorting": lambda s: ParticleFilter(10, HilbertSortedResampler(EssResampler(s))),
    "scheme under a soft resampler": lambda s: ParticleFilter(
        10, SoftResampler(0.5, EssResampler(s))
    ),
    "resampler": lambda s: ParticleFilter(10, s),
    "size": lambda s: ParticleFilter(10, particle_count=s),
    "preference": lambda s: ParticleFilter(10, auxiliary_weights=s),
    "form": lambda s: ParticleFilter(10, auxiliary_weights=TemperedWeights(s)),
    "move": lambda s: ParticleFilter(10, moves=(s,)),
    "proposal": lambda s: ParticleFilter(10, proposal=s),
    "points": lambda s: ParticleFilter(10, points=s),
    "points of a proposal": lambda s: ParticleFilter(10, proposal=SqmcProposal(s)),
    "weigh": lambda s: ParticleFilter(10, weight_update=s),
}


@pytest.mark.parametrize("stage", SILENT)
def test_a_silent_stage_is_not_exact_and_the_warning_says_what_to_state(stage: str) -> None:
    with pytest.warns(UserWarning, match=r"got Silent without `is_exact`.*Add `is_exact = True`"):
        method = SILENT[stage](Silent())
    with pytest.warns(UserWarning, match="counts as not exact"):
        assert method.is_exact is False


@pytest.mark.parametrize("stage", SILENT)
@pytest.mark.parametrize("exact", [True, False])
def test_a_stage_decides_by_what_it_states(stage: str, exact: bool) -> None:
    part = Silent()
    part.is_exact = exact  # type: ignore[attr-defined]
    assert SILENT[stage](part).is_exact is exact


class FirstHalf(Systematic):
    """Inherits the statement of a scheme that it breaks."""

    @override
    def __call__(self, a: Tensor, n: Tensor, draws: RandomStream) -> Tensor:
        return HalfToFirst()(a, n, draws)


class Blind(BootstrapProposal):
    """Inherits the statement of a proposal."""

    __call__ = Silent.__call__


class Lazy(EssResampler):
    """Inherits the statement of a resampler."""

    __call__ = Silent.__call__


class Skipping(ParticleFilter):
    """Inherits the statement of a filter."""

    step = Silent.__call__


SILENT_CLASSES: dict[str, Callable[[], ParticleFilter]] = {
    "FirstHalf": lambda: ParticleFilter(10, EssResampler(FirstHalf())),
    "Blind": lambda: ParticleFilter(10, proposal=Blind()),
    "Lazy": lambda: ParticleFilter(10, Lazy(Systematic())),
    "Skipping": lambda: Skipping(10),
}


@pytest.mark.parametrize("name", SILENT_CLASSES)
def test_a_class_that_overrides_an_exact_one_must_state_it_again(name: str) -> None:
    with pytest.warns(UserWarning, match=f"got {name} without `is_exact`"):
        method = SILENT_CLASSES[name]()
    with pytest.warns(UserWarning, match="counts as not exact"):
        assert method.is_exact is False


def test_a_class_that_overrides_no_behaviour_inherits_the_statement() -> None:
    class Eager(EssResampler):
        """Another default."""

        ess_threshold = 0.9

    class Stated(FirstHalf):
        """A statement of its own."""

        is_exact = True

    class Named(Stated):
        """Nothing new."""

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert ParticleFilter(10, Eager(Named())).is_exact


def test_a_kernel_decides_unless_it_makes_no_step() -> None:
    kernel = Always(LastStateKernel())
    assert not ParticleFilter(10, moves=(MetropolisHastings(kernel),)).is_exact
    assert ParticleFilter(10, moves=(MetropolisHastings(kernel, 0),)).is_exact


def test_the_checks_do_not_need_pytest() -> None:
    files = (Path(pfbench.testing.__file__).parent).glob("*.py")
    nodes = [node for file in files for node in ast.walk(ast.parse(file.read_text()))]
    names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    names |= {str(node.module) for node in nodes if isinstance(node, ast.ImportFrom)}
    assert "numpy" in names
    assert "pytest" not in names
