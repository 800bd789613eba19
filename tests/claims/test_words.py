"""The five words: planted effects with their power, error rates, order of readings, halves of the runs, lost runs."""

import importlib.util
import math
from types import ModuleType

import numpy as np
import pytest
import yaml
from checkout import ROOT

from pfbench.claims.page import _say_error_rates
from pfbench.claims.words import (
    CANNOT_RUN,
    CONFIRMED,
    DEPENDS,
    FALSE,
    NOT_COUNTED,
    NOT_RUN,
    OPEN,
    REFUTED,
    TRUE,
    UNTESTABLE,
    VACUOUS,
    ClaimDecision,
    ClaimSample,
    ReadingDot,
    decide_paper,
)
from pfbench.results import compare, decide


def load_rates() -> ModuleType:
    path = ROOT / "experiments" / "analyses" / "claim_rates.py"
    spec = importlib.util.spec_from_file_location("claim_rates", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


RATES = load_rates()


def draw(ratio: float, kind: str = "better", n: int = 90, seed: int = 1, lost: float = 0.0, printed: float = math.nan) -> ClaimSample:  # fmt: skip
    g = np.random.default_rng(seed)
    return RATES.make_comparison(g, ratio, kind, n, lost)._replace(printed=printed)  # type: ignore[no-any-return]


def decide_single(*comparisons: ClaimSample) -> ClaimDecision:
    return decide_paper({"claim": {"central": ReadingDot("none", comparisons)}})["claim"]


@pytest.mark.parametrize(
    ("kind", "ratio", "printed", "word"),
    [
        ("better", 0.7, math.nan, CONFIRMED),
        ("better", 1.3, math.nan, REFUTED),
        ("much better", 0.6, math.nan, CONFIRMED),
        ("much better", 1.0, math.nan, REFUTED),
        ("same", 1.5, math.nan, REFUTED),
        ("same", 0.6, math.nan, REFUTED),
        ("size", 0.5, 0.5, CONFIRMED),
        ("size", 0.95, 0.5, REFUTED),
        ("size", 0.1, 0.5, REFUTED),
        ("level", 1.6, math.nan, REFUTED),
        ("within", 1.5, 2.0, CONFIRMED),
        ("within", 2.5, 2.0, REFUTED),
    ],
)
def test_a_planted_effect_gives_its_word(
    kind: str, ratio: float, printed: float, word: str
) -> None:
    """With the runs that the sign test needs beside the ranks."""
    words = [decide_single(draw(ratio, kind, 200, seed, printed=printed)).word for seed in range(5)]
    assert words == [word] * 5


def test_better_by_less_than_a_percent_is_true() -> None:
    """Below 1, although above 0.99: true at each look, and not both."""
    pair = draw(1.0, n=300)
    near = 0.995 * np.exp(0.005 * np.random.default_rng(2).standard_normal(300))
    found = decide_single(pair._replace(a=near * pair.b))
    assert 0.99 < found.low < found.high < 1.0
    assert (found.word, found.outcomes) == (CONFIRMED, {"central": TRUE})


def test_the_comparison_that_decides_is_described() -> None:
    """A false one with a narrow interval, and not one with a larger ratio that decides nothing."""
    clear, wide = draw(1.5, n=400), draw(2.0, n=8, seed=3)
    found = decide_single(clear, wide)
    assert (found.word, found.runs) == (REFUTED, 400)


def test_equality_needs_runs_enough() -> None:
    assert decide_single(draw(1.0, "same", n=60)).word == OPEN
    assert decide_single(draw(1.0, "same", n=1500)).word == CONFIRMED


def test_a_claim_of_several_comparisons_is_true_if_all_are_and_false_if_some_is() -> None:
    assert decide_single(draw(0.6), draw(0.6, seed=2)).word == CONFIRMED
    assert decide_single(draw(0.6), draw(1.5, seed=2)).word == REFUTED
    words = [decide_single(draw(0.6), draw(1.0, seed=seed)).word for seed in range(2, 6)]
    assert words == [OPEN] * 4  # on both sides of 1


def test_a_word_needs_all_readings_and_depends_names_the_factor() -> None:
    better, worse = draw(0.6), draw(1.6, seed=2)
    dots = {
        "central": ReadingDot("none", [better]),
        "speed_200": ReadingDot("speed", [better]),
        "noise_5": ReadingDot("noise", [worse]),
    }
    found = decide_paper({"claim": dots})["claim"]
    assert (found.word, found.factors) == (DEPENDS, ("noise",))
    assert found.outcomes == {"central": TRUE, "speed_200": TRUE, "noise_5": FALSE}
    missing = decide_paper(
        {"claim": {"central": ReadingDot("none", [better]), "speed": ReadingDot("speed")}}
    )
    assert missing["claim"].word == OPEN
    assert missing["claim"].outcomes == {"central": TRUE, "speed": NOT_RUN}


def test_a_pair_of_levels_names_no_factor() -> None:
    """It shows whether both together turn the claim as each alone does."""
    dots = {
        "central": ReadingDot("none", (draw(1.5, n=300),)),
        "low": ReadingDot("limit", (draw(0.5, n=300),)),
        "low_and_fine": ReadingDot("pair", (draw(0.5, n=300),)),
    }
    found = decide_paper({"claim": dots})["claim"]
    assert (found.word, found.factors) == (DEPENDS, ("limit",))
    assert found.outcomes["low_and_fine"] == TRUE


def test_readings_without_information_do_not_count() -> None:
    better = draw(0.6)
    same = draw(1.0, "same", n=40)
    equal = same._replace(a=same.b)
    lost = better._replace(lost_a=np.ones(90, bool), lost_b=np.ones(90, bool))
    for empty, outcome in (
        (ReadingDot("x", state=CANNOT_RUN), CANNOT_RUN),
        (ReadingDot("x", state=NOT_COUNTED), NOT_COUNTED),
        (ReadingDot("x", [equal]), VACUOUS),
        (ReadingDot("x", [lost]), CANNOT_RUN),
    ):
        found = decide_paper({"claim": {"central": ReadingDot("none", [better]), "x": empty}})[
            "claim"
        ]
        assert (found.word, found.outcomes["x"]) == (CONFIRMED, outcome)
        assert decide_paper({"claim": {"x": empty}})["claim"].word == UNTESTABLE


def test_filters_that_are_equal_refute_a_direction_without_a_test() -> None:
    """As two cubature rules on a linear model: false by construction, with any number of claims in the family."""
    pair = draw(1.0, n=12)
    ledger = {
        f"claim {k}": {"central": ReadingDot("none", [pair._replace(a=pair.b)])} for k in range(40)
    }
    assert {found.word for found in decide_paper(ledger).values()} == {REFUTED}
    proof = decide_paper({"claim": {"central": ReadingDot("none", state=FALSE)}})
    assert proof["claim"].word == REFUTED


def test_a_lost_run_is_worse_than_every_kept_one() -> None:
    """A planted admission fault: a form that loses most runs is not better by the runs that it does not lose."""
    pair = draw(0.5)
    assert decide_single(pair).word == CONFIRMED
    many = np.arange(90) < 60
    assert decide_single(pair._replace(lost_a=many)).word == REFUTED
    assert decide_single(pair._replace(lost_b=many)).word == CONFIRMED
    assert decide_single(pair._replace(a=np.where(many, np.inf, pair.a))).word == REFUTED


def test_no_word_changes_with_the_order_of_readings_and_claims() -> None:
    g = np.random.default_rng(7)
    ledger = {
        f"claim {c}": {
            f"reading {r}": ReadingDot(f"factor {r}", [RATES.make_comparison(g, ratio, "better")])
            for r, ratio in enumerate(g.choice([0.6, 0.9, 1.4], 4))
        }
        for c in range(5)
    }
    found = decide_paper(ledger)
    turned = {
        name: dict(reversed(list(dots.items()))) for name, dots in reversed(list(ledger.items()))
    }
    again = decide_paper(turned)
    assert len({decision.word for decision in found.values()}) > 1
    for name, decision in found.items():
        assert again[name].word == decision.word
        assert dict(again[name].outcomes) == dict(decision.outcomes)


def test_looks_that_contradict_each_other_decide_nothing() -> None:
    """A planted contradiction: the first runs say true, all runs say false."""
    pair = draw(1.0, n=300)
    turned = pair._replace(a=pair.b * np.where(pair.early, 0.2, 4.0) * (pair.a / pair.b))
    assert decide_single(turned.select(turned.early)).word == CONFIRMED
    assert decide_single(turned._replace(early=np.zeros(300, bool))).word == REFUTED
    found = decide_single(turned)
    assert found.word == OPEN
    assert found.outcomes == {"central": OPEN}


def test_no_word_has_the_opposite_sign_of_the_verdict_of_a_study_page() -> None:
    """A page compares the same runs by `compare` and `decide`, with its own margin and level."""
    opposite, agreed = {CONFIRMED: "worse", REFUTED: "better"}, 0
    for seed, ratio in enumerate((0.6, 0.8, 0.95, 1.0, 1.05, 1.3, 1.8)):
        pair = draw(ratio, n=200, seed=seed)
        (verdict,) = decide([compare(("a", np.log(pair.a)), ("b", np.log(pair.b)))])
        word = decide_single(pair).word
        assert verdict.word != opposite.get(word)
        agreed += (word, verdict.word) in ((CONFIRMED, "better"), (REFUTED, "worse"))
    assert agreed >= 4


def test_halves_of_the_runs_give_no_opposite_words() -> None:
    """Beyond the level: of 40 claims at the border of true, both words at most once in all."""
    opposite, decided = 0, 0
    for seed in range(40):
        pair = draw((0.75, 1.0)[seed % 2], n=120, seed=seed)
        words = {decide_single(pair.select(np.arange(120) % 2 == half)).word for half in (0, 1)}
        opposite += {CONFIRMED, REFUTED} <= words
        decided += CONFIRMED in words
    assert opposite <= 1
    assert decided >= 15  # the planted effect is seen


def test_error_rates_of_the_words() -> None:
    """False words in 30 ledgers at the edges; the script measures 1000."""
    for rate in RATES.measure_rates(30, 11, claims=4):
        assert rate <= RATES.allow(30)


def test_the_rates_of_the_page_keep_the_level() -> None:
    stored = yaml.safe_load(RATES.RATES.read_text())
    assert stored["ledgers"] >= 1000
    for row in stored["rates"]:
        assert max(row["false_confirmed"], row["false_refuted"]) <= RATES.allow(stored["ledgers"])
    worst = max(row["false_refuted"] for row in stored["rates"])
    assert f"{worst:.1%} a false refuted" in _say_error_rates()


@pytest.mark.slow
def test_error_rates_with_lost_runs_and_readings() -> None:
    for settings in ({"lost": 0.1}, {"readings": 2}):
        for rate in RATES.measure_rates(200, 12, **settings):
            assert rate <= RATES.allow(200)


def test_ratio_interval_and_order_of_the_central_reading() -> None:
    found = decide_single(draw(0.7, n=400))
    assert found.low < 0.7 < found.high
    assert found.runs == 400
    assert 0.7 < found.order < 1.0
