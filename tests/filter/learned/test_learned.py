"""Learned proposals: any network leaves the target as it is; a wrong ratio is seen; checkpoints are refused in words."""

import math
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from network_cases import NETWORKS, shaken
from particle_cases import CASES, WALK, WALK_Y
from refusals import check_refused
from torch import Tensor, nn
from torch.distributions import (
    Beta,
    Distribution,
    Independent,
    Laplace,
    LowRankMultivariateNormal,
    MixtureSameFamily,
    MultivariateNormal,
    Normal,
    TransformedDistribution,
)

from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    BootstrapProposal,
    CubaturePoints,
    DiagonalNormalHead,
    EssResampler,
    GaussianFilter,
    GuidedNoiseProposal,
    ParticleBelief,
    ParticleFilter,
    ProposalSample,
    SigmaPointLinearisation,
    Systematic,
    TaylorLinearisation,
)
from pfbench.filter.learned import checkpoint
from pfbench.filter.learned.differentiable_resampling import sample_from
from pfbench.filter.learned.proposal import (
    PAST,
    InnovationFeature,
    LearnedProposal,
    ParentFeature,
    SpreadFeature,
    make_feature_context,
)
from pfbench.model import LinearGaussian, StateSpaceModel
from pfbench.testing import (
    check_evidence,
    check_independence,
    filter_record,
)

ALWAYS = EssResampler(Systematic(), 1.0)
EKF, CKF = (
    GaussianFilter(TaylorLinearisation()),
    GaussianFilter(SigmaPointLinearisation(CubaturePoints())),
)


def proposal(name: str, random: bool, **options: Any) -> LearnedProposal:
    return LearnedProposal(shaken(NETWORKS[name]) if random else NETWORKS[name], **options)


# the target stays


def ratio_errors(name: str, random: bool, guide: GuidedNoiseProposal | None) -> list[float]:
    """Means of p / q - 1 and of p / q w in standard errors, for each particle with its own parent."""
    model, n = WALK, 20_000
    method = proposal(name, random, guide_filter=guide)
    x = torch.tensor([[[0.4, -0.2], [2.0, 1.0]]], dtype=torch.float64).repeat_interleave(n // 2, 1)
    cloud = ParticleBelief(
        x,
        torch.full((1, n), -math.log(n), dtype=torch.float64),
        torch.zeros(1, dtype=torch.float64),
    )
    with torch.no_grad():
        told = method(
            model,
            cloud,
            Record(torch.tensor([[1.5]], dtype=torch.float64)),
            PhiloxStream(3, torch.arange(1)),
        )
    ratio = told.log_ratio.exp()[0]
    values = torch.stack([ratio - 1.0, *(ratio[:, None] * told.w[0]).T])
    assert values.std(1).max() < 12.0
    return (values.mean(1).abs() / (values.std(1) / math.sqrt(n) + 1e-9)).tolist()


@pytest.mark.parametrize("guide", [None, GuidedNoiseProposal(CKF)], ids=["prior", "guided"])
@pytest.mark.parametrize("random", [False, True], ids=["untrained", "random"])
@pytest.mark.parametrize("name", NETWORKS)
def test_the_ratio_is_one_on_average(
    name: str, random: bool, guide: GuidedNoiseProposal | None
) -> None:
    assert max(ratio_errors(name, random, guide)) < 4.5


@pytest.mark.slow
@pytest.mark.parametrize("case", ["growth", "level seen at once", "singular"])
@pytest.mark.parametrize("name", NETWORKS)
def test_filters_with_random_networks_are_unbiased(name: str, case: str) -> None:
    model, y, exact = CASES[case]()
    method = ParticleFilter(60, ALWAYS, proposal=proposal(name, True))
    assert method.is_exact
    with torch.no_grad():
        check_evidence(method, model, y, exact, runs=600)


@pytest.mark.parametrize(
    "options",
    [
        {"guide_filter": GuidedNoiseProposal(CKF)},
        {
            "guide_filter": GuidedNoiseProposal(
                EKF, shared_by_particles=True, covariance_factor=1.5
            ),
            "defensive_fraction": 0.3,
        },
        {"memory": 3},
        {"defensive_fraction": 0.0},
    ],
    ids=["corrects the CKF", "corrects a wide EKF", "remembers", "keeps none"],
)
def test_they_are_unbiased_whatever_their_options(options: dict[str, Any]) -> None:
    model, y, exact = CASES["growth"]()
    with torch.no_grad():
        check_evidence(
            ParticleFilter(60, ALWAYS, proposal=proposal("diagonal", True, **options)),
            model,
            y,
            exact,
            runs=500,
        )


class Wrong(nn.Module):
    """A learned proposal with a mistake in its ratio."""

    is_exact = True

    def __init__(self, inner: LearnedProposal, mistake: str) -> None:
        super().__init__()
        self.inner, self.mistake = inner, mistake

    def forward(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: PhiloxStream
    ) -> ProposalSample:
        right = self.inner(model, belief, record, draws)
        log_p = -0.5 * right.w.square().sum(-1)
        wrong = {
            "no ratio": torch.zeros_like(right.log_ratio),
            "p alone": log_p + 0.5 * right.w.shape[-1],
            "q / p": -right.log_ratio,
            "another particle's": right.log_ratio.roll(1, 1),
        }
        return right._replace(log_ratio=wrong[self.mistake])


@pytest.mark.parametrize("mistake", ["no ratio", "p alone", "q / p", "another particle's"])
def test_a_wrong_ratio_is_seen(mistake: str) -> None:
    model, y, exact = CASES["growth"]()
    method = ParticleFilter(
        60, ALWAYS, proposal=Wrong(proposal("diagonal", True, defensive_fraction=0.3), mistake)
    )  # type: ignore[arg-type]
    with torch.no_grad(), pytest.raises(AssertionError):
        check_evidence(method, model, y, exact, runs=500)


@pytest.mark.slow
@pytest.mark.parametrize("name", NETWORKS)
def test_with_an_untrained_network_the_filter_goes_to_kalman(name: str) -> None:
    """The error of the log evidence falls with the root of N, with a network of no sense as without."""
    model, y, exact = CASES["singular"]()
    errors = []
    for n in (50, 800):
        method = ParticleFilter(n, ALWAYS, proposal=proposal(name, True))
        with torch.no_grad():
            estimate = filter_record(method, model, y, runs=100)
        errors.append((estimate.log_evidence - exact.log_evidence).square().mean().sqrt().item())
    assert errors[1] < 0.35
    assert 2.0 < errors[0] / errors[1] < 8.0  # 4, give or take what 100 runs leave open


# where it starts

WITHOUT_PRIOR = [GuidedNoiseProposal(rule, defensive_fraction=0.0) for rule in (CKF, EKF)]


@pytest.mark.parametrize("case", ["growth", "singular", "level seen at once"])
def test_an_untrained_proposal_is_the_one_it_corrects(case: str) -> None:
    """To the last digit without a defensive fraction: same draws, same particles, same weights."""
    model, y, _ = CASES[case]()
    for guide, plain in (
        (None, BootstrapProposal()),
        *((guided, guided) for guided in WITHOUT_PRIOR),
    ):
        learned = LearnedProposal(DiagonalNormalHead, guide_filter=guide, defensive_fraction=0.0)
        ours = ParticleFilter(50, proposal=learned)
        one, other = (
            filter_record(method, model, y, runs=3)
            for method in (ours, ParticleFilter(50, proposal=plain))
        )
        torch.testing.assert_close(one.mean, other.mean, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(one.log_evidence, other.log_evidence, rtol=1e-9, atol=1e-9)


class Narrow(nn.Module):
    """A network that is far too sure."""

    def __init__(self, features: int, noise: int) -> None:
        super().__init__()
        self.sd = nn.Parameter(torch.full((noise,), 0.2))

    def forward(self, told: Tensor) -> Distribution:
        return Independent(
            Normal(torch.zeros_like(self.sd), self.sd).expand((*told.shape[:2], len(self.sd))), 1
        )


def test_the_kept_share_bounds_every_weight() -> None:
    """p / q <= 1 / share, whatever the network says; without it nothing does."""
    x = torch.zeros(1, 4000, 2, dtype=torch.float64)
    cloud = ParticleBelief(
        x,
        torch.full((1, 4000), -math.log(4000), dtype=torch.float64),
        torch.zeros(1, dtype=torch.float64),
    )
    seen, draws = (
        Record(torch.tensor([[9.0]], dtype=torch.float64)),
        PhiloxStream(1, torch.arange(1)),
    )
    largest = []
    for share in (0.0, 0.1):
        method = LearnedProposal(Narrow, defensive_fraction=share)
        with torch.no_grad():
            largest.append(method(WALK, cloud, seen, draws).log_ratio.max().item())
    assert largest[0] > math.log(10.0) + 1.0
    assert largest[1] <= math.log(10.0) + 1e-9


def weights_without_gradient(name: str) -> list[str]:
    method = ParticleFilter(20, ALWAYS, proposal=proposal(name, True, memory=2))
    filter_record(method, WALK, WALK_Y, runs=4).log_evidence.mean().backward()
    assert isinstance(method.proposal, LearnedProposal)
    weights = dict(method.proposal.named_parameters())
    assert len(weights) > 4
    return [
        key
        for key, weight in weights.items()
        if weight.grad is None or not 0.0 < weight.grad.abs().max() < math.inf
    ]


@pytest.mark.parametrize("name", NETWORKS)
def test_gradients_reach_every_weight(name: str) -> None:
    assert weights_without_gradient(name) == []


def test_a_run_cannot_feel_its_neighbours() -> None:
    """With networks that remember and mixtures that choose."""
    method = ParticleFilter(20, proposal=proposal("mixture", True, memory=2))
    with torch.no_grad():
        check_independence(method, WALK, torch.stack([WALK_Y + k for k in range(3)]), 1e-10)


def test_what_was_seen_before_is_remembered_once_for_each_run() -> None:
    method = ParticleFilter(20, ALWAYS, proposal=proposal("diagonal", True, memory=3))
    cloud, model, draws = (
        method.init(WALK, 2, PhiloxStream(1, torch.arange(2))),
        WALK,
        PhiloxStream(1, torch.arange(2)),
    )
    pasts = []
    with torch.no_grad():
        for t, y in enumerate(WALK_Y[:2]):
            cloud, _ = method.step(
                model, cloud, Record(torch.stack([y, y + 1.0])), draws.at_step(t + 1)
            )
            pasts.append(cloud.memory[PAST])
    assert pasts[0].shape == (2, 1, 3)
    assert (pasts[0] - pasts[1]).abs().max() > 1e-3
    assert (pasts[1][0] - pasts[1][1]).abs().max() > 1e-3


# what it is told


def test_a_unit_of_measure_changes_nothing() -> None:
    """Metres or kilometres: what the network is told is the same."""

    def told(unit: float) -> Tensor:
        f = torch.tensor([[1.0, 1.0], [0.0, 1.0]], dtype=torch.float64)
        g = unit * torch.diag(torch.tensor([0.3, 0.1]))
        model = LinearGaussian(f, g, [[1.0, 0.0]], [unit], [0.0, 0.0], [2.0 * unit, unit])
        x = unit * PhiloxStream(1, torch.arange(1)).normal("x", 30, 2)
        cloud = ParticleBelief(
            x,
            torch.full((1, 30), -math.log(30.0), dtype=torch.float64),
            torch.zeros(1, dtype=torch.float64),
        )
        step = make_feature_context(
            model, cloud, Record(unit * torch.tensor([[2.5]], dtype=torch.float64))
        )
        return torch.cat(
            [
                part(step).expand(1, 30, -1)
                for part in (InnovationFeature(), ParentFeature(), SpreadFeature())
            ],
            -1,
        )

    torch.testing.assert_close(told(1.0), told(1e-6))
    assert told(1.0).abs().max() < 5.0


# draws of any law


def laws() -> dict[str, Distribution]:
    mean, sd = (
        torch.tensor([0.5, -1.0], dtype=torch.float64),
        torch.tensor([0.3, 2.0], dtype=torch.float64),
    )
    root = torch.tensor([[1.0, 0.0], [-0.7, 0.5]], dtype=torch.float64)
    parts = Independent(Normal(torch.stack([mean, -3.0 * mean]), torch.stack([sd, 0.5 * sd])), 1)
    return {
        "normal": Independent(Normal(mean, sd), 1),
        "full": MultivariateNormal(mean, scale_tril=root),
        "low rank": LowRankMultivariateNormal(mean, root[:, :1], sd.square()),
        "mixture": MixtureSameFamily(
            torch.distributions.Categorical(torch.tensor([0.3, 0.7], dtype=torch.float64)), parts
        ),
        "laplace": Independent(Laplace(mean, sd), 1),
        "transformed": TransformedDistribution(
            Independent(Normal(mean, sd), 1),
            [torch.distributions.AffineTransform(mean, 2.0 * sd, event_dim=1)],
        ),
    }


@pytest.mark.parametrize("name", laws())
def test_draws_have_the_law_s_moments(name: str) -> None:
    law, n, draws = laws()[name], 100_000, PhiloxStream(1, torch.arange(1))
    if name == "transformed":  # x = m + 2 s (m + s z)
        m, s = torch.tensor([0.5, -1.0]), torch.tensor([0.3, 2.0])
        mean, sd = m + 2.0 * s * m, 2.0 * s * s
    else:
        mean, sd = law.mean, law.variance.sqrt()
    x = sample_from(law.expand((1, n)), draws.normal("z", n, 2), draws)[0]
    torch.testing.assert_close(
        x.mean(0), mean.to(x), rtol=0, atol=4.5 * float(sd.max()) / math.sqrt(n)
    )
    torch.testing.assert_close(x.std(0), sd.to(x), rtol=0.03, atol=0)


def test_gradients_of_a_mixture_s_draws_are_those_of_its_expectations() -> None:
    """d E[x_0^2 x_1] of a mixture by its weights, means and scales, in closed form, against draws."""
    logits = torch.tensor([0.2, -0.4], dtype=torch.float64, requires_grad=True)
    mean = torch.tensor([[0.5, -1.0], [-0.7, 0.4]], dtype=torch.float64, requires_grad=True)
    sd = torch.tensor([[0.6, 0.5], [0.9, 0.3]], dtype=torch.float64, requires_grad=True)
    share = torch.softmax(logits, -1)
    exact = torch.autograd.grad(
        (share * (mean[:, 0] ** 2 + sd[:, 0] ** 2) * mean[:, 1]).sum(), (logits, mean, sd)
    )
    n, draws, rows = 10_000, PhiloxStream(2, torch.arange(1)), []
    for k in range(12):
        parts = Independent(Normal(mean, sd), 1).expand((1, n, 2))
        law = MixtureSameFamily(
            torch.distributions.Categorical(logits=logits.expand(1, n, 2)), parts
        )
        x = sample_from(law, draws.at_step(k).normal("z", n, 2), draws.at_step(k))
        found = torch.autograd.grad((x[..., 0] ** 2 * x[..., 1]).mean(), (logits, mean, sd))
        rows.append(torch.cat([g.flatten() for g in found]))
    values, wanted = torch.stack(rows), torch.cat([g.flatten() for g in exact])
    error = values.std(0) / math.sqrt(len(rows))
    assert ((values.mean(0) - wanted).abs() < 5.0 * error).all()
    assert error.max() < 0.05


def test_a_law_that_cannot_be_drawn_is_named() -> None:
    one, draws = torch.ones(1, 5, 2, dtype=torch.float64), PhiloxStream(1, torch.arange(1))
    check_refused(
        [
            (
                "standard normals can sample, got Beta",
                lambda: sample_from(Independent(Beta(one, one), 1), one, draws),
            )
        ],
        remedy=False,
    )


class Heavy(nn.Module):
    """A network that returns a law of its own kind: what a user may write."""

    def __init__(self, features: int, noise: int) -> None:
        super().__init__()
        self.net = nn.Linear(features, noise)

    def forward(self, told: Tensor) -> Distribution:
        return Independent(Laplace(self.net(told), 1.5), 1)


def test_any_law_may_be_proposed_from() -> None:
    model, y, exact = CASES["growth"]()
    with torch.no_grad():
        check_evidence(
            ParticleFilter(60, ALWAYS, proposal=LearnedProposal(Heavy)), model, y, exact, runs=500
        )


# checkpoints are refused in words


@pytest.fixture
def kept(tmp_path: Any) -> Any:
    """A checkpoint of a diagonal network of 8 hidden units on the walk."""
    method = proposal("diagonal", True)
    cloud = ParticleFilter(5).init(WALK, 1, PhiloxStream(1, torch.arange(1)))
    method.build(WALK, cloud, Record(WALK_Y[:1]))
    content = {
        "networks": {"proposal": checkpoint.flatten_parameters(dict(method.named_children()))},
        "sizes": {"proposal": list(method.sizes)},
        "frames": {"proposal": method.learnable.frame},
        "model": {"class": "LinearGaussian", "names": list(WALK.names)},
        "choices": {"scenario": "linear_walk", "model": "linear_walk", "filter": "neural_sir"},
        "split": {
            "scenario": "linear_walk",
            "train": {"seed": 7, "runs": 10},
            "validation": {"seed": 8, "runs": 4},
        },
        "cost": {"seconds": 1.0},
    }
    checkpoint.write_checkpoint(tmp_path / "walk.pt", content)
    return tmp_path / "walk.pt", method, content


def used(path: Any, model: StateSpaceModel = WALK, y: Tensor = WALK_Y, **options: Any) -> Any:
    method = ParticleFilter(
        20,
        proposal=LearnedProposal(
            options.pop("network", NETWORKS["diagonal"]), checkpoint=path, **options
        ),
    )
    with torch.no_grad():
        return filter_record(method, model, y, runs=2)


def test_a_checkpoint_brings_the_weights_back(kept: Any) -> None:
    path, method, _ = kept
    with torch.no_grad():
        own = filter_record(ParticleFilter(20, proposal=method), WALK, WALK_Y, runs=2)
    torch.testing.assert_close(used(str(path)).mean, own.mean, rtol=0, atol=0)
    assert (used("untrained").mean - own.mean).abs().max() > 1e-3


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            {"model": CASES["singular"]()[0], "y": CASES["singular"]()[1]},
            "got 2 .position, velocity.*Train on this.* scenario=linear_walk model=linear_walk.$",
        ),
        (
            {"network": partial(DiagonalNormalHead, hidden=(9,))},
            r"hidden_layers.0.bias of shape \(9,\), got \(8,\)",
        ),
        ({"network": NETWORKS["mixture"]}, "proposal.network"),
        ({"memory": 4}, "memory=4 .* got 0 in .* Set the model"),
        ({"features": [InnovationFeature()]}, "features=4 .* got 10 in"),
        (
            {"guide_filter": GuidedNoiseProposal(CKF)},
            "correct what is guided by CubaturePoints, got the model's own noise .* Set filter=neural_sir",
        ),
        (
            {"path": None},
            "checkpoint must be a file or `untrained` .*got null.*pfbench train.*checkpoint=FILE",
        ),
        ({"path": "nowhere.pt"}, "checkpoint must be an existing file, got nowhere.pt"),
    ],
    ids=["model", "hidden", "network", "memory", "features", "guide", "none", "missing"],
)
def test_another_model_s_checkpoint_is_refused_in_words(
    kept: Any, options: dict[str, Any], said: str
) -> None:
    given = {"path": str(kept[0])} | options
    check_refused([(said, lambda: used(given.pop("path"), **given))], remedy=False)


def test_what_is_no_file_of_weights_is_never_run(tmp_path: Any) -> None:
    class Evil:
        def __reduce__(self) -> Any:
            return print, ("run!",)

    torch.save({"format": checkpoint.CHECKPOINT_FORMAT, "networks": Evil()}, tmp_path / "evil.pt")
    (tmp_path / "text.pt").write_text("weights?")
    torch.save({"networks": {}}, tmp_path / "old.pt")
    for name, said in (
        ("evil", "damaged or another file"),
        ("text", "must be a file of weights"),
        ("old", "got None"),
    ):
        with pytest.raises(ValueError, match=said):
            checkpoint.read_checkpoint(tmp_path / f"{name}.pt")


def test_a_key_depends_on_weights_not_on_paths(kept: Any, tmp_path: Any) -> None:
    path, _, content = kept
    (tmp_path / "elsewhere").mkdir()
    path.rename(tmp_path / "elsewhere" / "b.pt")
    checkpoint.write_checkpoint(path, content | {"cost": {"seconds": 2.0}})
    changed = {key: a + 1e-12 for key, a in content["networks"]["proposal"].items()}
    checkpoint.write_checkpoint(tmp_path / "c.pt", content | {"networks": {"proposal": changed}})
    one, two, three = (
        checkpoint.replace_checkpoint_by_hash(
            {"filter": {"moves": [{"checkpoint": str(name)}]}, "checkpoint": None}
        )
        for name in (path, tmp_path / "elsewhere" / "b.pt", tmp_path / "c.pt")
    )
    assert one == two != three
    assert checkpoint.replace_checkpoint_by_hash({"checkpoint": "untrained"}) == {
        "checkpoint": "untrained"
    }


def test_worlds_that_were_learned_from_are_not_for_judging(kept: Any) -> None:
    config = {"moves": [{"kernel": {"checkpoint": str(kept[0])}}]}
    check_refused(
        [
            (
                r"training seed .* got 7: runs 0 to 9 of linear_walk .* Set another seed",
                lambda: checkpoint.checkpoint_provenance(
                    config, "linear_walk", 7, torch.arange(5, 20)
                ),
            ),
            (
                "validation seed",
                lambda: checkpoint.checkpoint_provenance(config, "linear_walk", 8, torch.arange(1)),
            ),
        ],
        remedy=False,
    )
    jobs = ("linear_walk", 7, torch.arange(10, 20)), ("flight_300s", 7, torch.arange(3))
    told, other = (checkpoint.checkpoint_provenance(config, *job) for job in jobs)
    assert told is not None
    assert other is not None
    assert told["cost"] == {"seconds": 1.0}
    assert told["weights"] == other["weights"]
    assert (
        checkpoint.checkpoint_provenance(
            {"proposal": {"checkpoint": "untrained"}}, "linear_walk", 7, torch.arange(3)
        )
        is None
    )


def test_the_stages_of_a_recipe_may_be_replaced() -> None:
    method = ParticleFilter(20, proposal=LearnedProposal(DiagonalNormalHead))
    assert replace(method, particles=5).proposal is method.proposal
