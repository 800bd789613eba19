"""The studies of learned proposals: what they measure has a closed form, and they go on from where they stopped."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from checkout import ROOT
from matplotlib.figure import Figure
from pfbench.experiments import learn_data_efficiency, learn_noise_calibration, learn_room
from pfbench.experiments.learn_data_efficiency import Case, against, volatility
from scipy.stats import chi2, ncx2

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter
from pfbench.filter.gaussian.linearisation_rules import TaylorLinearisation
from pfbench.filter.guided.noise_guide import GuidedNoiseProposal
from pfbench.filter.particle.stages import BootstrapProposal
from pfbench.model.linear_gaussian import local_level
from pfbench.results import crossed_mean_interval


def normal(r: torch.Tensor, variance: float) -> torch.Tensor:
    return torch.exp(-0.5 * r**2 / variance) / math.sqrt(2 * math.pi * variance)


def test_the_room_that_is_left_is_that_of_closed_forms(monkeypatch: pytest.MonkeyPatch) -> None:
    """y = x + b w + s e: sum (E v)^2 / sum E v^2 for v = p(y | x, w), one for the optimal law, and its nats."""
    monkeypatch.setattr(learn_room, "CHILDREN", 1000)
    b, s, y = 0.8, 0.6, 1.1
    model, parents = (
        local_level(b, s, 0.0, 1.0),
        torch.tensor([-0.5, 0.4, 1.5], dtype=torch.float64),
    )
    cloud = ParticleBelief(
        parents[None, :, None],
        torch.full((1, 3), -math.log(3.0), dtype=torch.float64),
        torch.zeros(1),
    )
    seen, draws = Record(torch.tensor([[y]], dtype=torch.float64)), PhiloxStream(1, torch.arange(1))
    chosen = torch.multinomial(
        torch.full((3,), 1.0), learn_room.PARENTS, True, generator=torch.Generator().manual_seed(0)
    )
    r = y - parents[chosen]
    best = normal(r, b * b + s * s).square().sum()
    wanted = {
        "own": best / (normal(r, b * b + 0.5 * s * s) / (2 * s * math.sqrt(math.pi))).sum(),
        "optimal": torch.tensor(1.0, dtype=torch.float64),
    }
    for name, proposal in (
        ("own", BootstrapProposal()),
        (
            "optimal",
            GuidedNoiseProposal(GaussianFilter(TaylorLinearisation()), defensive_fraction=0.0),
        ),
    ):
        found = learn_room.share(learn_room.weigh_children(proposal, model, cloud, seen, draws))
        torch.testing.assert_close(
            found[0], wanted[name], rtol=0.03 if name == "own" else 1e-3, atol=0.0
        )
    torch.testing.assert_close(
        learn_room.nats(model, cloud, seen)[0].item(), 0.5 * math.log1p((b / s) ** 2)
    )


def test_the_scenarios_and_models_of_the_study_of_gains_exist() -> None:
    for words in learn_room.SCENARIOS:
        scenario, *choices = words.split(",")
        groups = {"scenario": scenario} | dict(choice.split("=") for choice in choices)
        groups.pop("oracle_noise", None)
        for group, name in groups.items():
            assert (ROOT / "conf" / group / f"{name}.yaml").is_file(), words


def test_steps_without_a_measurement_are_not_selected() -> None:
    y = torch.full((2, 9, 1), torch.nan)
    y[:, 2::3] = 0.0
    y[0, 5] = torch.nan
    assert learn_room.select_steps(Record(y)) == {2, 8}


def test_an_interval_holds_what_differs_between_worlds_and_between_trainings() -> None:
    worlds = np.random.default_rng(0).normal(size=400)
    assert crossed_mean_interval(worlds[None])[1] == pytest.approx(1.96 / math.sqrt(400), rel=0.1)
    same = np.stack([worlds] * 3)
    apart = same + np.array([-1.0, 0.0, 1.0])[:, None]
    assert crossed_mean_interval(same)[1] == pytest.approx(1.966 / math.sqrt(400), rel=0.1)
    assert crossed_mean_interval(apart)[1] == pytest.approx(
        4.303 * math.sqrt(1 / 3 + 1 / 400), rel=0.1
    )


def test_scores_are_told_against_the_own_noise_s() -> None:
    own, other = (
        {"ess": [0.4], "evidence": [e], "error": [x]} for e, x in ((-2.0, 4.0), (-1.5, 2.0))
    )
    assert [float(against(other, own, name)[0]) for name in ("ess", "evidence", "error")] == [
        0.4,
        0.5,
        math.log(0.5),
    ]


def test_verdicts_name_the_better_one_and_tables_count_what_a_step_costs() -> None:
    """Errors a quarter of own noise's in each world, and twice those of the dearer one; no difference is none."""
    scatter = np.exp(0.1 * np.random.default_rng(1).normal(size=40))

    def scores(error: float, evidence: float, **more: list[float]) -> dict[str, list[float]]:
        found = {
            "ess": [0.25] * 40,
            "evidence": [*(evidence + scatter)],
            "error": [*(error * scatter)],
            "seconds": [0.8],
        }
        return found | more

    each = {"1": scores(1.0, 2.0, training=[3.0]), "2": scores(1.0, 2.0, training=[5.0])}
    by_hand = {learn_data_efficiency.BOOTSTRAP: scores(4.0, 1.0), "as good": scores(1.0, 2.0)}
    told = {
        "by hand": by_hand,
        "dearer": {"as good": scores(0.5, 2.5, particles=[80])},
        "inference compilation": {"1": each},
    }
    told["lower bound"] = {
        "1": {name: scores(1.1, 2.0, training=[1.0]) for name in each},
        "3": each,
    }
    rows = [row.strip("| ").split(" | ") for row in learn_data_efficiency.verdicts(told)[2:]]
    others = ("bootstrap", "as good", "as good, 80 particles", "lower bound, 1 run")
    assert [row[:2] for row in rows[4:]] == [["lower bound, 3 runs", name] for name in others]
    own, same, dear = rows[:3]
    assert own[2].startswith("0.250 (0.250 to 0.250)")
    assert dear[2].startswith("2.000 (2.000 to 2.000)")
    assert [float(x) for x in (own[4], same[4], dear[4])] == pytest.approx([1.0, 0.0, -0.5])
    assert max(float(row[k]) for row in (own, dear) for k in (3, 5)) < 1e-6
    assert float(same[3]) == float(same[5]) == 1.0
    assert rows[-1][2].startswith("0.909 (0.909 to 0.909)")

    world = Case(volatility, "state", 10, 0.01, (1,), (1, 2), 40, particles=20)
    table = {
        row.split(" | ")[0]: row.strip("| ").split(" | ")
        for row in learn_data_efficiency.table(told, world)
    }
    assert table["| as good, 80 particles"][-2:] == [
        "80.0",
        "0.2",
    ]  # 0.8 s in 10 steps, a quarter of 80 particles
    assert table["| lower bound, 3 runs"][-3:] == ["80.0", "0.1", "4"]


def test_few_worlds_come_again_and_no_others_are_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = {}
    monkeypatch.setattr(
        learn_data_efficiency,
        "train",
        lambda plan, method, model, own, few, path: seen.update(own=own, few=few),
    )
    world = Case(volatility, "state", 6, 0.01, (2, 40), (1,), 8)
    learn_data_efficiency.train_proposal(
        world, 2, 1, learn_data_efficiency.EvidenceLowerBound(), tmp_path / "none.pt"
    )
    assert len(seen["own"].record.y) == 40
    few = seen["own"].record.y[:2]
    for worlds in seen.values():
        torch.testing.assert_close(
            worlds.record.y, few.repeat(len(worlds.record.y) // 2 + 1, 1, 1)[: len(worlds.record.y)]
        )
    learn_data_efficiency.train_proposal(
        world, 40, 1, learn_data_efficiency.EvidenceLowerBound(), tmp_path / "none.pt"
    )
    torch.testing.assert_close(seen["own"].record.y[:2], few)
    assert len(seen["own"].record.y.unique(dim=0)) == 40


def test_a_study_of_calibration_resumes_and_its_page_states_the_decisions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ranks of wrong likelihoods all in the last bin: these tests fail, the uniform ones pass."""
    requests = []

    def compute(case: learn_noise_calibration.Case) -> dict[str, Any]:
        parameterised, record, _ = case
        requests.append(len(record.y))
        uniform = (torch.arange(len(record.y)) % 20).tolist()
        is_wrong = (len(requests) - 1) % 8 >= 4
        ranks = [19] * len(uniform) if is_wrong else uniform
        counts = np.bincount(np.array(ranks) // 2, minlength=10).tolist()
        names = parameterised.names
        return {"ranks": dict.fromkeys(names, ranks), "counts": dict.fromkeys(names, counts)}

    monkeypatch.setattr(learn_noise_calibration, "compute_case", compute)
    monkeypatch.setattr(learn_noise_calibration, "sbc_histograms", lambda ranks: Figure())
    learn_noise_calibration.main(tmp_path, 40, 1)
    learn_noise_calibration.main(tmp_path, 40, 1)
    assert requests == [40] * 8
    page = (tmp_path / "report.md").read_text()
    text = " ".join(page.split())
    assert "Correct likelihood, 6 tests, Holm's correction at 5%. Significant: none." in text
    assert "Correct likelihood, 6 tests, Holm's correction at 5%. Significant: none." in text
    least = f"{chi2.sf(9 * 4.0 + 36.0**2 / 4.0, 9):.2g}"  # nine empty bins, one with 40 of 40
    assert f"`angle_sd` by SVI (p {least}). Not significant: none." in text
    rows = [row.split(" | ") for row in page.splitlines() if row.startswith("| ")][2:]
    assert [row[2] for row in rows] == ["correct"] * 6 + ["wrong"] * 6
    assert [row[4] for row in rows] == [" ".join("4" * 10)] * 6 + [" ".join("0" * 9) + " 40"] * 6
    assert (tmp_path / "calibration_location.png").exists()
    learn_noise_calibration.main(tmp_path, 41, 1, "location, SVI")  # another request
    assert requests[8:] == [41, 41]


def test_the_power_of_a_rank_test_is_about_that_of_the_noncentral_distribution() -> None:
    """Its level without a departure is 5 %; with 20 data sets a bin the chi-square limit is rough."""
    assert learn_noise_calibration.compute_power(200, 0.1) == pytest.approx(0.05, abs=0.01)
    shares = np.full(10, 0.83 / 9)
    shares[0] = 0.17
    limit = ncx2.sf(chi2.isf(0.05, 9), 9, 200 * ((shares - 0.1) ** 2 / 0.1).sum())
    assert learn_noise_calibration.compute_power(200, 0.17) == pytest.approx(limit, abs=0.07)
