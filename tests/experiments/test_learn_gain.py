"""The study of learned gains: the best rival at equal time is found, and the study goes on from where it stopped."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pfbench.experiments import learn_gain, learn_room

SCATTER = np.exp(0.1 * np.random.default_rng(1).normal(size=40))


def scores(error: float, seconds: float, **more: list[float]) -> dict[str, list[float]]:
    return {"error": [*(error * SCATTER)], "seconds": [seconds], **more}


def one_world(learned: float) -> dict[str, Any]:
    """Rivals of errors 2 and 1 within the time of a learned proposal, and one of 0.1 that takes longer."""
    world, training = learn_gain.OTHER_WORLDS[0], {"training": [1.0]}
    return {
        f"{world}; sir": scores(2.0, 0.1),
        f"{world}; ckf_pf": scores(1.0, 0.9),
        f"{world}; sir, 400 particles": scores(0.1, 1.2),
        f"{world}; neural_sir; 64; 1": scores(learned, 1.0, **training),
        f"{world}; neural_sir; 64; 2": scores(learned, 1.0, **training),
    }


@pytest.mark.parametrize(
    ("learned", "word"), [(0.5, "smaller"), (1.0, "inconclusive"), (1.5, "larger")]
)
def test_a_learned_proposal_is_compared_with_the_best_filter_of_its_time(
    learned: float, word: str
) -> None:
    (row,) = learn_gain.list_equal_time(one_world(learned))
    assert (row["rival"], row["rivals"], row["word"]) == ("ckf_pf", 2, word)
    assert row["mean"] == pytest.approx(np.log(learned), abs=1e-9)


def test_the_study_goes_on_from_where_it_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []

    def counted(world: str, name: str, count: int, seed: int, *rest: object) -> dict[str, Any]:
        calls.append(f"{world}; {name}; {count}; {seed}")
        if len(calls) == 5:
            raise KeyboardInterrupt
        return scores(1.2, 1.0, training=[2.0])

    monkeypatch.setattr(learn_gain, "compute_training", counted)
    monkeypatch.setattr(learn_gain, "evaluate", lambda *_: scores(1.0, 0.5))
    with pytest.raises(KeyboardInterrupt):
        learn_gain.main(tmp_path, 40, 2)
    learn_gain.main(tmp_path, 40, 2)
    assert calls[4] == calls[5]
    assert len(calls) == len(set(calls)) + 1
    page = (tmp_path / "report.md").read_text()
    assert "| linear_walk, outliers | kalman_net, 64 runs | 1.200 (1.200 to 1.200) |" in page
    assert page.count("| growth, nominal |") == len(learn_gain.PROPOSALS)
    assert (tmp_path / "ratios.png").stat().st_size > 5000


def test_the_page_of_possible_gains_names_the_scenarios_with_some() -> None:
    def columns(ckf: float) -> dict[str, Any]:
        shares = dict.fromkeys(("nats", "parents", *learn_room.RULES), (0.5, 0.1))
        return {"noises": 2, "steps": 9, **shares, "CKF": (ckf, 0.01)}

    done = {"a,noise=x": columns(0.7), "b": columns(0.995)}
    assert learn_room.list_rooms(done) == {"a,noise=x": 0.7, "b": 0.995}
    page = learn_room.write_page({"runs": 4, "steps": 400}, done)
    assert "ratio below 0.99: a, noise=x." in page


@pytest.mark.parametrize(
    ("mean", "half", "p", "word"),
    [
        (-0.2, 0.1, 0.01, "smaller"),
        (0.2, 0.1, 0.01, "larger"),
        (0.2, 0.3, 0.01, "inconclusive"),  # trainings differ
        (0.2, 0.1, 0.06, "inconclusive"),
    ],
)
def test_a_decision_holds_over_runs_and_over_trainings(
    mean: float, half: float, p: float, word: str
) -> None:
    assert learn_gain.decide(mean, half, p) == word
