"""Training: what each objective is worth where the answer is known, the loop's promises, and the command line."""

import csv
import json
import math
import re
import runpy
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
import torch
from checkout import ROOT
from command_line import pfbench
from network_cases import NETWORKS, shaken
from particle_cases import CASES
from refusals import check_refused
from synthetic_results import list_results
from torch import Tensor, nn
from torch.distributions import Distribution, Independent, Normal

from pfbench.core import PhiloxStream, Record
from pfbench.core.density import independent_normal, normal_batch
from pfbench.files import has_valid_digest
from pfbench.filter import (
    BootstrapProposal,
    DiagonalNormalHead,
    EssResampler,
    GaussianFilter,
    GuidedNoiseProposal,
    LearnedProposal,
    Multinomial,
    ParticleBelief,
    ParticleFilter,
    Proposal,
    Resampler,
    SoftResampler,
    StopGradientResampler,
    Systematic,
    TaylorLinearisation,
    run_filter,
)
from pfbench.filter.learned import checkpoint
from pfbench.filter.learned.objectives import (
    EvidenceLowerBound,
    InferenceCompilation,
    StateErrorLoss,
    simulate_from_model,
)
from pfbench.learn.trainer import Progress, Training, TrainingState
from pfbench.learn.training_data import TrainingData, draw_training_data
from pfbench.learn.training_job import train, write_losses
from pfbench.model.base import StateSpaceModel
from pfbench.model.linear_gaussian import local_level
from pfbench.noise.base import NoiseRegime, NominalNoise
from pfbench.scenario.simulated import ModelSimulation
from pfbench.testing import check_evidence, filter_record

LEVEL = local_level(1.0, 0.3, 0.0, 1.0)  # what is seen is three times as sure as what is predicted
SMALL = partial(DiagonalNormalHead, hidden=(8,))


def lessons(
    runs: int, seed: int, steps: int = 10, regimes: Sequence[NoiseRegime] = (NominalNoise(),)
) -> TrainingData:
    return draw_training_data(ModelSimulation(LEVEL, steps), regimes, LEVEL, runs, seed, None)


def trained(
    tmp_path: Path, training: Training, method: ParticleFilter, name: str = "one"
) -> tuple[Path, dict[str, Any]]:
    path = train(
        training, method, LEVEL, lessons(training.training_runs, training.seed), lessons(training.validation_runs, training.seed + 1),
        tmp_path / f"{name}.pt",
    )  # fmt: skip
    return path, checkpoint.read_checkpoint(path)


def fresh(make: Callable[[int, int], nn.Module] = SMALL, **options: Any) -> ParticleFilter:
    return ParticleFilter(20, proposal=LearnedProposal(make, checkpoint=None, **options))


QUICK = Training(
    training_runs=16,
    validation_runs=8,
    epochs=5,
    batch_size=8,
    gradient_steps=5,
    particles=10,
    learning_rate=0.02,
)


# what the objectives are


class Fixed(nn.Module):
    """N(m, s^2), whatever it is told."""

    def __init__(self, features: int, noise: int) -> None:
        super().__init__()
        self.m, self.log_s = nn.Parameter(torch.tensor([0.3])), nn.Parameter(torch.tensor([-0.4]))

    def forward(self, told: Tensor) -> Distribution:
        shape = (*told.shape[:2], 1)
        return Independent(Normal(self.m.expand(shape), self.log_s.exp().expand(shape)), 1)


def test_the_gradient_of_the_bound_is_that_of_its_closed_form() -> None:
    """One particle, one step: E[log Z_hat] = E_q[log p(y | x) p(w) / q(w)], of which all is known."""
    runs, y = 20_000, 0.9
    proposal = LearnedProposal(Fixed, defensive_fraction=0.0)
    method = ParticleFilter(2, proposal=proposal)
    first = method.init(LEVEL, 1, PhiloxStream(1, torch.arange(1)))
    proposal.build(LEVEL, first, Record(torch.tensor([[y]], dtype=torch.float64)), True)
    found = []
    for k in range(16):
        draws = PhiloxStream(2 + k, torch.arange(runs // 16))
        cloud = method.init(LEVEL, runs // 16, draws.at_step(0))
        one = cloud._replace(x=cloud.x[:, :1], log_w=torch.zeros_like(cloud.log_w[:, :1]))
        record = Record(torch.full((runs // 16, 1), y, dtype=torch.float64))
        sent = proposal(LEVEL, one, record, draws.at_step(1))
        value = (LEVEL.log_likelihood(record.y, sent.x, ()) + sent.log_ratio).mean()
        found.append(torch.stack(torch.autograd.grad(value, list(proposal.parameters()))).flatten())
    m, s = 0.3, math.exp(-0.4)
    wanted = torch.tensor([(y - m) / 0.09 - m, -(s**2) / 0.09 - s**2 + 1.0], dtype=torch.float64)
    values = torch.stack(found).double()
    error = values.std(0) / 4.0
    assert ((values.mean(0) - wanted).abs() < 4.5 * error).all()
    assert (error < 0.05 * wanted.abs()).all()


def test_the_bound_of_a_record_is_what_the_filter_says_of_it() -> None:
    """Segment by segment, the losses of all steps sum to minus the log evidence that this filter finds with these draws."""
    worlds = lessons(4, 5)
    pupil = TrainingState(QUICK, fresh(), LEVEL, worlds)
    with torch.no_grad():
        losses = torch.cat(
            [loss for loss, _ in pupil._segments(worlds, PhiloxStream(3, torch.arange(4)))]
        )
        estimate = run_filter(pupil.method, LEVEL, worlds.record, PhiloxStream(3, torch.arange(4)))
    assert losses.shape == (10, 4)
    torch.testing.assert_close(losses.sum(0), -estimate.log_evidence)


def test_the_error_is_in_deviations_of_the_initial_law_and_what_is_not_known_does_not_count() -> (
    None
):
    worlds = lessons(4, 5)
    worlds = worlds._replace(states=worlds.states.index_fill(1, torch.tensor([3]), math.nan))
    pupil = TrainingState(
        replace(QUICK, objective=StateErrorLoss(), gradient_steps=None), fresh(), LEVEL, worlds
    )
    with torch.no_grad():
        (losses,) = [loss for loss, _ in pupil._segments(worlds, PhiloxStream(3, torch.arange(4)))]
        estimate = run_filter(pupil.method, LEVEL, worlds.record, PhiloxStream(3, torch.arange(4)))
    wanted = (
        (estimate.mean - worlds.states).square()[..., 0].nan_to_num(0.0)
    )  # the level starts with deviation 1
    torch.testing.assert_close(losses, wanted.T)


def optimal(x: Tensor, y: Tensor) -> tuple[Tensor, float]:
    """Mean and deviation of the level's noise given parent and measurement."""
    gain = 1.0 / (1.0 + 0.09)
    return gain * (y - x), math.sqrt(1.0 - gain)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("objective", "way"),
    [(InferenceCompilation(), 0.75), (EvidenceLowerBound(), 0.4)],
    ids=["compilation", "bound"],
)
def test_a_network_finds_the_optimal_proposal(objective: Any, way: float, tmp_path: Path) -> None:
    """On a linear model the noise's posterior is normal: most of the way from the prior to it is gone in twelve epochs."""
    plan = replace(
        QUICK,
        objective=objective,
        training_runs=48,
        epochs=12,
        patience_epochs=12,
        learning_rate=0.03,
    )
    method = fresh()
    path, _ = trained(tmp_path, plan, method)
    test = lessons(20, 77)
    shares = {}
    kinds: dict[str, Proposal] = {
        "learned": LearnedProposal(SMALL, checkpoint=str(path)), "prior": BootstrapProposal(),
        "optimal": GuidedNoiseProposal(GaussianFilter(TaylorLinearisation())),
    }  # fmt: skip
    with torch.no_grad():
        for name, proposal in kinds.items():
            estimate = run_filter(
                ParticleFilter(200, proposal=proposal),
                LEVEL,
                test.record,
                PhiloxStream(1, torch.arange(20)),
            )
            shares[name] = estimate.trace["ess"].mean().item() / 200
    assert shares["learned"] > shares["prior"] + way * (shares["optimal"] - shares["prior"]), shares


def test_inference_compilation_measures_the_cross_entropy() -> None:
    """At the optimal law the mean of -log q is the posterior's entropy; the guide with an untrained network is that law."""
    proposal = LearnedProposal(
        DiagonalNormalHead, guide_filter=GuidedNoiseProposal(GaussianFilter(TaylorLinearisation()))
    )
    worlds = lessons(2000, 3, 2)
    record, states, noises = simulate_from_model(
        LEVEL, worlds.record, PhiloxStream(3, torch.arange(2000))
    )
    cloud = ParticleFilter(5).init(LEVEL, 2000, PhiloxStream(1, torch.arange(2000)))
    with torch.no_grad():
        loss = -proposal.log_density(LEVEL, cloud, record.at_step(0), states[:, 0], noises[:, 0])
    _, sd = optimal(states[:, 0], record.y[:, 0])
    entropy = 0.5 * math.log(2 * math.pi * math.e * sd**2)
    assert abs(loss.mean() - entropy) < 4.5 * loss.std() / math.sqrt(2000)
    prior = LearnedProposal(DiagonalNormalHead)
    with torch.no_grad():
        plain = -prior.log_density(LEVEL, cloud, record.at_step(0), states[:, 0], noises[:, 0])
    torch.testing.assert_close(plain, 0.5 * noises[:, 0, 0] ** 2 + 0.5 * math.log(2 * math.pi))


def test_imagined_worlds_have_the_model_s_law() -> None:
    """And the gaps, inputs and starts of the record that they are like."""
    record = Record(
        torch.zeros(4000, 3, 1, dtype=torch.float64).index_fill(1, torch.tensor([1]), math.nan)
    )
    imagined, states, noises = simulate_from_model(
        LEVEL, record, PhiloxStream(1, torch.arange(4000))
    )
    assert torch.isnan(imagined.y[:, 1]).all()
    torch.testing.assert_close(states[:, 1:] - states[:, :-1], noises)
    apart = (imagined.y - states[:, 1:])[:, [0, 2], 0]
    assert abs(apart.std() - 0.3) < 0.3 * 4.0 / math.sqrt(16_000)
    assert abs(noises.std() - 1.0) < 4.0 / math.sqrt(24_000)
    assert abs(torch.corrcoef(torch.stack([apart[:, 0], noises[:, 0, 0]]))[0, 1]) < 4.0 / math.sqrt(
        4000
    )


# what training does


@pytest.mark.parametrize(
    ("objective", "resampler"),
    [
        (EvidenceLowerBound(), EssResampler(Systematic(), 1.0)),
        pytest.param(EvidenceLowerBound(), SoftResampler(0.5), marks=pytest.mark.slow),
        pytest.param(EvidenceLowerBound(), StopGradientResampler(), marks=pytest.mark.slow),
        pytest.param(StateErrorLoss(), SoftResampler(0.5), marks=pytest.mark.slow),
        pytest.param(
            InferenceCompilation(), EssResampler(Systematic(), 0.5), marks=pytest.mark.slow
        ),
    ],
    ids=["bound", "soft", "score", "state error", "compilation"],
)
def test_each_objective_falls_on_worlds_not_learned_from(
    objective: Any, resampler: Any, tmp_path: Path
) -> None:
    epochs = 4
    plan = replace(QUICK, objective=objective, resampler=resampler, epochs=epochs)
    _, kept = trained(tmp_path, plan, fresh())
    first = TrainingState(plan, fresh(), LEVEL, lessons(1, 1)).validate(lessons(8, 1002))[0]
    assert kept["best"] < first - 0.003
    assert len(kept["losses"]) == epochs
    assert kept["cost"]["updates"] == epochs * 2 * 2  # two batches, two segments


class Stop(Exception):  # noqa: N818
    pass


def test_a_training_that_was_stopped_goes_on_as_if_it_had_not_been(tmp_path: Path) -> None:
    """To the last bit: weights, losses and the epoch that was best."""
    plan = replace(QUICK, epochs=3)
    whole, one = trained(tmp_path, plan, fresh(memory=2))

    def stop(line: str) -> None:
        if line.startswith("epoch 2 "):
            raise Stop

    worlds, others = (
        lessons(plan.training_runs, plan.seed),
        lessons(plan.validation_runs, plan.seed + 1),
    )
    with pytest.raises(Stop):
        train(plan, fresh(memory=2), LEVEL, worlds, others, tmp_path / "two.pt", tell=stop)
    assert (tmp_path / "two.pt.part").exists()
    assert not (tmp_path / "two.pt").exists()
    two = checkpoint.read_checkpoint(
        train(plan, fresh(memory=2), LEVEL, worlds, others, tmp_path / "two.pt")
    )
    assert checkpoint.hash_weights(one["networks"]) == checkpoint.hash_weights(two["networks"])
    for a, b in zip(one["losses"], two["losses"], strict=True):
        assert {k: v for k, v in a.items() if k != "seconds"} == {
            k: v for k, v in b.items() if k != "seconds"
        }
    assert not (tmp_path / "two.pt.part").exists()
    lines = list(csv.DictReader(whole.with_suffix(".csv").read_text().splitlines()))
    assert [float(line["loss"]) for line in lines] == [line["loss"] for line in one["losses"]]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"learning_rate": 0.5}, "learning_rate must be 0.02 .* got 0.5"),
        (
            {"objective": InferenceCompilation()},
            "objective must be EvidenceLowerBound .* got InferenceCompilation",
        ),
        ({"training_runs": 17}, "training_data must be"),
        ({"memory": 2}, "proposal must be"),
        (
            {"guide_filter": GuidedNoiseProposal(GaussianFilter(TaylorLinearisation()))},
            "own noise .* got what is guided by TaylorLinearisation",
        ),
    ],
    ids=["rate", "objective", "worlds", "memory", "guide"],
)
def test_another_training_does_not_go_on_from_there(
    change: dict[str, Any], said: str, tmp_path: Path
) -> None:
    """Adam would take the stopped one's rate along, and weights of one filter would be finished as another's."""

    def run(plan: Training, tell: Callable[[str], object] | None = None, **options: Any) -> None:
        worlds = lessons(plan.training_runs, plan.seed)
        train(plan, fresh(**options), LEVEL, worlds, worlds, tmp_path / "one.pt", tell=tell)

    def stop(line: str) -> None:
        if line.startswith("epoch 2 "):  # the first one is kept
            raise Stop

    plan = replace(QUICK, epochs=2)
    with pytest.raises(Stop):
        run(plan, stop)
    options = {name: value for name, value in change.items() if name in ("memory", "guide_filter")}
    check_refused(
        [
            (
                said,
                lambda: run(
                    replace(
                        plan,
                        **{name: value for name, value in change.items() if name not in options},
                    ),
                    **options,
                ),
            )
        ],
        remedy=False,
    )
    run(replace(plan, epochs=3, patience_epochs=5))  # more of the same is the same training
    assert len(checkpoint.read_checkpoint(tmp_path / "one.pt")["losses"]) == 3


def test_where_tensorboard_is_installed_it_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[tuple[str, str, int]] = []

    class Writer:
        def __init__(self, folder: str) -> None:
            self.folder = folder

        def add_scalar(self, name: str, value: float, step: int) -> None:
            told.append((Path(self.folder).name, name, step))

        def flush(self) -> None: ...

    monkeypatch.setattr("importlib.util.find_spec", lambda name: name)
    monkeypatch.setitem(
        sys.modules, "torch.utils.tensorboard", SimpleNamespace(SummaryWriter=Writer)
    )
    trained(tmp_path, replace(QUICK, epochs=1, training_runs=4), fresh())
    assert ("one", "validation", 1) in told


def test_another_seed_is_another_training_and_torch_s_stream_is_left_alone(tmp_path: Path) -> None:
    state = torch.random.get_rng_state()
    digests = set()
    for seed in (1, 2):
        method = fresh()
        _, kept = trained(tmp_path, replace(QUICK, epochs=1, seed=seed), method, f"seed{seed}")
        digests.add(checkpoint.hash_weights(kept["networks"]))
    assert len(digests) == 2
    assert torch.equal(state, torch.random.get_rng_state())


def test_it_stops_early_and_keeps_the_best(tmp_path: Path) -> None:
    """With a learning rate that ruins everything, the first epochs are the best ones, and what is kept is theirs."""
    plan = replace(QUICK, epochs=30, patience_epochs=2, learning_rate=3.0)
    path, kept = trained(tmp_path, plan, fresh())
    values = [line["validation"] for line in kept["losses"]]
    best = values.index(min(values))
    assert len(values) == best + 1 + 2 < 30
    method = ParticleFilter(20, proposal=LearnedProposal(SMALL, checkpoint=str(path)))
    pupil = TrainingState(plan, method, LEVEL, lessons(1, 1))
    assert pupil.validate(lessons(plan.validation_runs, plan.seed + 1))[0] == pytest.approx(
        min(values), abs=1e-12
    )


def test_gradients_are_clipped(tmp_path: Path) -> None:
    """Adam forgets the scale of a gradient, but not of one among others: clipped to nothing, nothing is learned in one update."""
    worlds = lessons(8, 1)
    pupil = TrainingState(replace(QUICK, max_grad_norm=1e-12), fresh(), LEVEL, worlds)
    with torch.enable_grad():
        pupil._batch(worlds, torch.arange(8), Progress())
    norm = math.sqrt(sum(float(p.grad.square().sum()) for p in pupil.weights if p.grad is not None))
    assert 0.0 < norm <= 1.001e-12


def test_a_gradient_that_is_not_finite_is_skipped_and_counted() -> None:
    worlds = lessons(8, 1)
    broken = worlds._replace(
        record=worlds.record._replace(y=worlds.record.y.index_fill(1, torch.tensor([2]), 1e200))
    )
    pupil = TrainingState(QUICK, fresh(), LEVEL, worlds)
    progress = Progress()
    line = pupil.run_epoch(progress, broken, worlds)
    assert all(torch.isfinite(p).all() for p in pupil.weights)
    assert math.isfinite(line["validation"])


def test_a_batch_mixes_regimes() -> None:
    """Worlds of two regimes are drawn with run numbers of their own, and an epoch's batches hold both."""

    class Loud(NominalNoise):
        def draw_errors(self, draws: Any, channels: Any, time: Tensor) -> Tensor:
            return 50.0 + super().draw_errors(draws, channels, time)

    worlds = lessons(20, 1, regimes=(NominalNoise(), Loud()))
    assert worlds.record.y.shape == (40, 10, 1)
    loud = worlds.record.y.mean((1, 2)) > 10.0
    assert loud.tolist() == [False] * 20 + [True] * 20
    assert (worlds.states[:20] - worlds.states[20:]).abs().min() > 1e-6
    batches = TrainingState(QUICK, fresh(), LEVEL, worlds)._batches(40, 0)
    assert [len(rows) for rows in batches] == [8] * 5
    assert sum(bool(loud[rows].any() and not loud[rows].all()) for rows in batches) >= 4
    assert sorted(torch.cat(list(batches)).tolist()) == list(range(40))


@pytest.mark.slow
def test_every_network_can_be_trained(tmp_path: Path) -> None:
    for name, make in NETWORKS.items():
        _, kept = trained(
            tmp_path, replace(QUICK, epochs=1, training_runs=8), fresh(shaken(make)), name
        )
        assert math.isfinite(kept["best"])


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("epochs", 0),
        ("batch_size", 2.5),
        ("particles", 1),
        ("gradient_steps", 0),
        ("learning_rate", 0.0),
        ("max_grad_norm", -1.0),
        ("seed", -1),
    ],
)
def test_training_refuses_values_of_no_use(key: str, value: Any) -> None:
    check_refused(
        [(f"train.{key} must be .*, got {value}", lambda: Training(**{key: value}))], remedy=False
    )


def test_training_refuses_what_it_cannot_do(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="must have a network to train"):
        trained(tmp_path, replace(QUICK, objective=EvidenceLowerBound()), ParticleFilter(5))


# the command line

CHEAP = (
    "scenario=local_level",
    "scenario.steps=6",
    "particles=20",
    "filter=neural_sir",
    "filter.proposal.network.hidden=[4]",
)
SHORT = (
    "train.epochs=2",
    "train.training_runs=6",
    "train.validation_runs=4",
    "train.batch_size=3",
    "train.particles=5",
)


def test_train_and_run_at_the_command_line(tmp_path: Path) -> None:
    words = [*CHEAP, f"results_dir={tmp_path / 'results'}", "study=mine"]
    said = pfbench("train", *words, *SHORT, "train.noise_regimes=[nominal,outliers]", home=tmp_path)
    assert said.code == 0, said.err
    assert "epoch 2 loss" in said.out
    (path,) = (tmp_path / "results" / "mine" / "checkpoints").glob("*.pt")
    kept = checkpoint.read_checkpoint(path)
    assert kept["choices"]["noise"] == "nominal+outliers"
    assert kept["config"]["train"]["epochs"] == 2
    assert kept["split"]["train"] == {"seed": 1001, "runs": 12}
    assert kept["split"]["validation"] == {"seed": 1002, "runs": 8}
    assert kept["cost"]["seconds"] > 0.0
    assert path.with_suffix(".svg").read_bytes().startswith(b"<?xml")
    path.with_suffix(".csv").unlink()  # the figure is drawn again from the checkpoint alone
    assert (
        "checkpoint exists"
        in pfbench(
            "train", *words, *SHORT, "train.noise_regimes=[nominal,outliers]", home=tmp_path
        ).out
    )

    part = path.with_name(path.name + ".part")
    part.write_text("of something else")
    again = pfbench(
        "train",
        *words,
        *SHORT,
        "train.noise_regimes=[nominal,outliers]",
        "overwrite=true",
        home=tmp_path,
    )
    assert again.code == 0, again.err  # from the beginning: it does not go on from there
    assert not part.exists()
    assert checkpoint.hash_weights(
        checkpoint.read_checkpoint(path)["networks"]
    ) == checkpoint.hash_weights(kept["networks"])

    run = [*words, "runs=3", f"checkpoint={path}"]
    said = pfbench("run", *run, home=tmp_path)
    assert said.code == 0, said.err
    (result,) = list_results(tmp_path / "results" / "mine")
    assert result.meta["is_exact"]
    assert result.meta["trained"]["cost"] == checkpoint.read_checkpoint(path)["cost"]
    assert result.meta["trained"]["weights"] == checkpoint.hash_weights(kept["networks"])
    moved = tmp_path / "moved.pt"
    moved.write_bytes(path.read_bytes())
    assert pfbench("run", *words, "runs=3", f"checkpoint={moved}", home=tmp_path).code == 0
    assert (
        len(list(list_results(tmp_path / "results" / "mine"))) == 1
    )  # the same weights, the same job


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("run", "runs=2"), "checkpoint must be a file .*got null.*`pfbench train`"),
        (("train", "-m"), "must be run without -m, got a sweep: it trains one network"),
        (("train", "train.epoch=3"), "Similar: train.epochs"),
        (("train", "oracle_noise=true"), "oracle_noise must be false for training, got true"),
        (
            ("train", "train.noise_regimes=[nomnal]"),
            "noise=nomnal does not exist. Similar: nominal",
        ),
    ],
    ids=lambda value: "" if isinstance(value, str) else " ".join(value),
)
def test_mistakes_are_told_in_words(words: tuple[str, ...], said: str, tmp_path: Path) -> None:
    answer = pfbench(words[0], *CHEAP, *words[1:], f"results_dir={tmp_path}", home=tmp_path)
    assert answer.code == (1 if "traceback:" in answer.err else 2)  # a job failed, or was refused
    assert re.search(said, answer.err), answer.err


# the table of losses of a training


def test_a_table_of_the_user_is_kept_and_an_old_log_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "data.csv"
    path.write_text("mine\n")
    for loss in (2.0, 1.0):
        write_losses(path, [{"epoch": 1, "loss": loss}])
    assert (tmp_path / "data.csv.kept").read_text() == "mine\n"
    assert path.read_bytes() == b"epoch,loss\r\n1,1.0\r\n"
    assert sorted(file.name for file in tmp_path.iterdir()) == ["data.csv", "data.csv.kept"]


# gradients of the evidence through each kind of resampling, against Kalman's by automatic differentiation

Y = torch.tensor([[0.8], [1.9], [-0.4], [2.5], [1.0], [-1.5]], dtype=torch.float64)
THETA = torch.tensor([0.8, math.log(0.9)], dtype=torch.float64)  # a, log q


class Walker(StateSpaceModel):
    """x' = a x + q w, y = x + v, with a and log q of each run its own, so that one backward pass gives each run's gradient."""

    linear = True

    def __init__(self, theta: Tensor) -> None:
        super().__init__()
        self.register_buffer("one", torch.ones(1, dtype=torch.float64))
        self.theta = theta  # [R, 2]
        self.names, self.units, self.groups, self.noise_dim = ("x",), ("",), {"state": (0,)}, 1

    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.one)

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return self.theta[:, :1, None] * x + self.theta[:, 1:, None].exp() * w

    def observation(self, x: Tensor, u: Any) -> Distribution:
        return independent_normal(x, 0.7 * self.one)


def kalman(theta: Tensor) -> Tensor:
    """log p(y) of this model, by the textbook."""
    a, q2 = theta[0], (2.0 * theta[1]).exp()
    m, p, total = torch.zeros(()).double(), torch.ones(()).double(), torch.zeros(()).double()
    for y in Y[:, 0]:
        m, p = a * m, a * a * p + q2
        s = p + 0.49
        total = total - 0.5 * ((y - m) ** 2 / s + torch.log(2.0 * math.pi * s))
        m, p = m + p / s * (y - m), p - p * p / s
    return total


def exact() -> Tensor:
    theta = THETA.clone().requires_grad_()
    return torch.autograd.grad(kalman(theta), theta)[0]


class Found(NamedTuple):
    """Mean of weight times gradient of log Z_hat over runs, less Kalman's, and standard errors, by parameter [2]."""

    bias: Tensor
    error: Tensor


def bias(resampler: Resampler, particles: int, runs: int, of_z: bool) -> Found:
    """Of grad Z_hat / Z (`of_z`), or of grad log Z_hat."""
    theta = THETA.expand(runs, -1).clone().requires_grad_()
    method = ParticleFilter(particles, resampler)
    estimate = run_filter(
        method, Walker(theta), Record(Y.expand(runs, -1, -1)), PhiloxStream(4, torch.arange(runs))
    )
    gradient = torch.autograd.grad(estimate.log_evidence.sum(), theta)[0]
    if of_z:
        gradient = gradient * (estimate.log_evidence.detach() - kalman(THETA)).exp()[:, None]
    return Found(gradient.mean(0) - exact(), gradient.std(0) / math.sqrt(runs))


DROPPED = EssResampler(Systematic(), 1.0)
UNBIASED: dict[str, Resampler] = {
    "score": StopGradientResampler(),
    "score, multinomial": StopGradientResampler(EssResampler(Multinomial(), 1.0)),
    "score, adaptive": StopGradientResampler(EssResampler(Systematic(), 0.6)),
    "score, soft": SoftResampler(0.5, StopGradientResampler()),
}


@pytest.mark.parametrize("name", UNBIASED)
def test_with_the_score_the_gradient_of_the_evidence_is_unbiased(name: str) -> None:
    """E[grad Z_hat] = grad Z with six particles, as exactly as E[Z_hat] = Z."""
    found = bias(UNBIASED[name], 6, 6000, of_z=True)
    assert (found.bias.abs() < 4.5 * found.error).all(), found
    assert (found.error < 0.2 * exact().abs()).all(), "too few runs to tell anything"


@dataclass(frozen=True)
class Slotted:
    """Soft or score weights with the mistake that is often made: of the slot, not of the ancestor."""

    soft: bool
    is_exact = True

    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, log_a: Tensor, n: Tensor, draws: Any
    ) -> tuple[ParticleBelief, Tensor]:
        wanted = torch.logaddexp(
            log_a + math.log(0.5), torch.full_like(log_a, math.log(0.5 / log_a.shape[1]))
        )
        used = wanted if self.soft else log_a
        fresh, hit = DROPPED(model, belief._replace(log_w=used), used, n, draws)
        correction = log_a - wanted if self.soft else log_a - log_a.detach()
        return fresh._replace(log_w=fresh.log_w + correction), hit


@pytest.mark.parametrize(
    "resampler",
    [DROPPED, SoftResampler(0.5), Slotted(False)],
    ids=["dropped", "soft", "wrong score"],
)
def test_without_it_there_is_a_bias_and_the_test_sees_it(resampler: Resampler) -> None:
    found = bias(resampler, 6, 6000, of_z=True)
    assert (found.bias.abs() > 6.0 * found.error).any(), found


@pytest.mark.slow
def test_the_bias_that_many_particles_leave() -> None:
    """Of grad log Z_hat: the score's goes, the dropped one stays, and soft weights mend part of it."""
    cases: dict[str, tuple[Resampler, int]] = {
        "dropped": (DROPPED, 400), "soft": (SoftResampler(0.3), 400), "score": (StopGradientResampler(), 2000)
    }  # fmt: skip
    found = {
        name: bias(resampler, 100, runs, of_z=False) for name, (resampler, runs) in cases.items()
    }
    share = {
        name: (value.bias / exact()).norm().item() for name, value in found.items()
    }  # of the gradient itself
    noise = {name: (value.error / exact()).norm().item() for name, value in found.items()}
    assert max(noise.values()) < 0.07
    assert share["dropped"] > 0.5
    assert 0.2 < share["soft"] < 0.9 * share["dropped"]
    assert share["score"] < 0.1


def test_the_score_changes_no_number() -> None:
    model, y, _ = CASES["growth"]()
    one, other = (
        filter_record(ParticleFilter(30, resampler), model, y, runs=3)
        for resampler in (DROPPED, StopGradientResampler())
    )
    assert torch.equal(one.mean, other.mean)
    assert torch.equal(one.log_evidence, other.log_evidence)


@pytest.mark.parametrize("alpha", [0.2, 0.7, 1.0])
def test_soft_resampling_targets_what_it_should(alpha: float) -> None:
    model, y, answer = CASES["growth"]()
    method = ParticleFilter(60, SoftResampler(alpha))
    assert method.is_exact
    check_evidence(method, model, y, answer, runs=700)


def test_soft_weights_of_the_slot_are_seen() -> None:
    model, y, answer = CASES["growth"]()
    with pytest.raises(AssertionError):
        check_evidence(ParticleFilter(60, Slotted(True)), model, y, answer, runs=700)


# transport


def cloud_of(n: int, d: int, runs: int = 3) -> ParticleBelief:
    draws = PhiloxStream(7, torch.arange(runs))
    log_w = torch.log_softmax(1.5 * draws.normal("w", n, 1)[..., 0], 1)
    return ParticleBelief(draws.normal("x", n, d), log_w, torch.zeros(runs, dtype=torch.float64))


def test_resampling_with_gradients_refuses_what_it_cannot_do() -> None:
    for alpha in (0.0, 1.5):
        with pytest.raises(ValueError, match=r"resampler\.\w+ must be"):
            SoftResampler(alpha)


def test_the_page_has_the_stored_table_of_two_worlds() -> None:
    """Its first sentence holds: no network pays in equal time, and one pays where a value of the likelihood is dear."""
    path = ROOT / "experiments" / "analyses" / "learned_worlds.json"
    stored, script = json.loads(path.read_text()), runpy.run_path(str(path.with_suffix(".py")))
    assert has_valid_digest(stored)
    page = (ROOT / "docs" / "train_a_proposal.md").read_text()
    assert script["write_table"](stored["done"]) in page
    rows = [script["list_rows"](stored["done"], price) for price in (None, 0.0, 10.0)]
    assert [sum(row["word"] == "smaller" for row in some) for some in rows] == [1, 0, 1]
