"""Training from Python: a network of your own, the command line's checkpoint, and its filter in a study."""

from pathlib import Path

import pytest
from command_line import pfbench as command
from notebook_cells import Notebook
from refusals import check_refused

import pfbench
from pfbench.results import store

NETWORK = """
from torch import nn
from torch.distributions import Independent, Normal


class NormalHead(nn.Module):
    def __init__(self, features, noise, hidden=4):
        super().__init__()
        self.net = nn.Sequential(nn.Linear(features, hidden), nn.Tanh(), nn.Linear(hidden, 2 * noise))

    def forward(self, features):
        mean, log_sd = self.net(features).chunk(2, -1)
        return Independent(Normal(mean, log_sd.exp()), 1)
"""
WORLD = pfbench.get("scenario", "stochastic_volatility", steps=5)
PLAN = {"objective": "compilation", "epochs": 2, "training_runs": 6, "validation_runs": 4}


@pytest.fixture
def notebook(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Notebook:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PFBENCH_TRUST", raising=False)
    monkeypatch.setenv("PFBENCH_RESULTS", str(tmp_path / "results"))
    monkeypatch.setenv("PFBENCH_EPISODES", str(tmp_path / "worlds"))
    made = Notebook(monkeypatch)
    made.run(NETWORK)
    return made


def test_an_own_network_is_trained_once_and_its_weights_are_in_the_job(
    notebook: Notebook, capsys: pytest.CaptureFixture[str]
) -> None:
    head = notebook["NormalHead"]
    first = pfbench.train(WORLD, head, **PLAN)
    assert capsys.readouterr().out.count("epoch ") == 2
    assert pfbench.train(WORLD, head, **PLAN) == first
    assert "skipped  checkpoint exists" in capsys.readouterr().out
    longer = pfbench.train(WORLD, head, **PLAN | {"epochs": 3}, progress=False)
    wider = pfbench.train(WORLD, pfbench.own(head, "Wider", hidden=5), **PLAN, progress=False)
    assert capsys.readouterr().out == ""
    study = pfbench.run(WORLD, ["sir", first, longer, wider], runs=4, particles=20, study="learned")
    results = [store.read_result(path) for path in Path("results", "learned").glob("*.npz")]
    assert len(results) == 4  # another checkpoint is another job
    labels = {result.meta["choices"]["filter"] for result in results}
    assert labels == {"sir", "normal_head", "wider"}
    proposals = [r.meta["config"]["filter"].get("proposal", {}) for r in results]
    assert {p["network"].get("hidden", 4) for p in proposals if p} == {4, 5}
    assert len(study.failed()) == 0


def test_the_checkpoint_is_that_of_the_command_line(notebook: Notebook, tmp_path: Path) -> None:
    part = pfbench.train(WORLD, "neural_sir", **PLAN, progress=False)
    words = [f"train.{key}={value}" for key, value in PLAN.items() if key != "objective"]
    said = command(
        "train", "scenario=stochastic_volatility", "scenario.steps=5", "filter=neural_sir",
        "train=compilation", *words, "study=notebook", home=tmp_path,
    )  # fmt: skip
    assert said.code == 0, said.err
    assert "skipped  checkpoint exists" in said.out
    assert part.changes[-1].startswith("checkpoint=")


def test_what_cannot_be_trained_is_refused(notebook: Notebook) -> None:
    check_refused(
        [
            (
                r"nothing to train|has no network|must have",
                lambda: pfbench.train(WORLD, "sir", progress=False),
            )
        ],
        remedy=False,
    )
    with pytest.raises(TypeError, match="NormalHead must be a class, got an object"):
        pfbench.train(WORLD, notebook["NormalHead"](3, 1), progress=False)
    check_refused(
        [("train", lambda: pfbench.train(WORLD, "neural_sir", objective="wish", progress=False))],
        remedy=False,
    )
    assert not Path("results").exists()


def test_several_filters_or_worlds_are_refused_before_anything_is_trained(
    notebook: Notebook,
) -> None:
    for scenario, method in ((["growth", WORLD], "neural_sir"), (WORLD, ["neural_sir", "neural_ckf"])):  # fmt: skip
        with pytest.raises(ValueError, match=r"must be one (scenario|filter), got 2"):
            pfbench.train(scenario, method, **PLAN)
    assert not Path("results").exists()
