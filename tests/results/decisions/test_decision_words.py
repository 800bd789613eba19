"""The table of words, and sentences without forbidden words."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from decision_cases import make_study

from pfbench.stats import decision
from pfbench.stats.filter_sets import order_filters
from pfbench.stats.planned_pairs import decide_planned_pairs
from pfbench.stats.sentences import describe_pair, describe_ranking, describe_total

M = 0.05
PAIR_TABLE = [
    (-0.30, -0.10, True, "better", "by more than the margin"),
    (-0.30, -0.01, True, "better", "size inconclusive"),
    (-0.04, -0.01, True, "better", "by less than the margin"),
    (-0.10, 0.00, True, "better", "size inconclusive"),
    (0.06, 0.30, True, "worse", "by more than the margin"),
    (0.01, 0.30, True, "worse", "size inconclusive"),
    (-0.04, 0.04, False, "equivalent", "by less than the margin"),
    (-0.04, 0.30, False, "inconclusive", "not better by the margin"),
    (-0.30, 0.04, False, "inconclusive", "not worse by the margin"),
    (-0.30, 0.30, False, "inconclusive", ""),
    (0.0, 0.0, False, "equivalent", "by less than the margin"),
]
CLAIM_TABLE = [
    (-0.30, -0.10, True, "holds", "holds"),
    (-0.30, -0.01, True, "direction holds, size inconclusive", "holds"),
    (-0.04, -0.01, True, "fails", "holds"),
    (0.01, 0.30, True, "fails", "fails"),
    (-0.04, 0.04, False, "fails", "fails"),
    (-0.04, 0.30, False, "fails", "fails"),
    (-0.30, 0.30, False, "inconclusive", "inconclusive"),
    (-0.30, 0.04, False, "inconclusive", "inconclusive"),
]
FORBIDDEN = re.compile(
    r"\b(significant\w*|no difference|diverged|outperform\w*|wins|best)\b", re.IGNORECASE
)


@pytest.mark.parametrize(("low", "high", "decided", "word", "size"), PAIR_TABLE)
def test_words_of_pairs(low, high, decided, word, size):
    assert decision.pair_word(low, high, decided, M) == (word, size)


@pytest.mark.parametrize(("low", "high", "decided", "with_size", "direction"), CLAIM_TABLE)
def test_words_of_claims(low, high, decided, with_size, direction):
    assert decision.claim_word(low, high, decided, M) == with_size
    assert decision.claim_word(low, high, decided, M, states_size=False) == direction


def test_words_are_monotone():
    """A shift of the interval towards the second filter never turns worse into better."""
    order = {"better": 0, "equivalent": 1, "inconclusive": 1, "worse": 2}
    for width in (0.02, 0.12, 0.4):
        centres = np.linspace(-0.5, 0.5, 101)
        ends = [(c - width / 2, c + width / 2) for c in centres]
        ranks = [order[decision.pair_word(*e, e[0] > 0 or e[1] < 0, M)[0]] for e in ends]
        assert ranks == sorted(ranks)


def test_words_of_track_and_error():
    combine = decision.combine_words
    assert combine("better", "inconclusive", False) == "better"
    assert combine("better", "worse", False) == "trade-off"
    assert combine("better", "better", True) == "trade-off"
    assert combine("identical", "equivalent", False) == "equivalent"
    assert combine("inconclusive", "equivalent", False) == "inconclusive"
    assert combine("not tested", "not tested", False) == "not tested"


STUDIES = [
    ({"A": -0.4, "B": 0.0}, {}, "smaller than that of B"),
    ({"A": 0.4, "B": 0.0}, {}, "larger than that of B"),
    ({"A": 0.0, "B": 0.0}, {"runs": 20, "world_sd": 0.0}, "are not decided"),
    ({"A": 0.0, "B": 0.0}, {"runs": 600, "world_sd": 0.0}, "equivalent to within 5 %"),
    ({"A": 0.0, "B": -0.3}, {"lost": {"B": 0.15}, "runs": 60}, "Trade-off"),
    ({"A": 0.0, "B": 0.0}, {"lost": {"B": 0.6}}, "by the share of runs won"),
    ({"A": 0.0, "B": 0.0}, {"runs": 5}, "not tested: 5 runs per condition"),
    ({"A": -0.4, "B": 0.0}, {"worlds": 1}, "In this world"),
    ({"A": -0.4, "B": 0.0}, {"worlds": 8}, "smaller in 8 of 8 worlds"),
]


@pytest.mark.parametrize(("effects", "options", "text"), STUDIES)
def test_sentences(effects, options, text):
    track, error, new_track, new_error = decide_planned_pairs(
        make_study(effects, **options), [("A", "B")]
    )
    sentence = describe_pair(track, error)
    assert text in sentence
    for result in (sentence, describe_pair(new_track, new_error)):
        assert not FORBIDDEN.search(result)
        assert not re.search(r"\bnan\b|\binf\b|  ", result)
        assert result.endswith(".")
        assert result.count("(") == result.count(")")


def test_numbers_of_a_sentence_are_those_of_the_record():
    track, error, _, new = decide_planned_pairs(
        make_study({"A": -0.4, "B": 0.0}, worlds=8), [("A", "B")]
    )
    change = [100 * -math.expm1(v) for v in (error.estimate, error.high, error.low)]
    stated = [
        float(x) for x in re.findall(r"(-?[\d.]+)(?= %| to)", describe_pair(track, error))[:3]
    ]
    assert stated == pytest.approx(change, rel=5e-3)
    assert "95 % simultaneous interval" in describe_pair(track, error)
    text = describe_pair(replace(track, question="b"), new)
    assert text.startswith("In a new world of this kind, A is better than B on average: ")
    assert f"{new.worlds} worlds" in text
    with pytest.raises(ValueError, match="records must be of one pair"):
        describe_pair(track, new)


def test_few_worlds_and_totals():
    decisions = decide_planned_pairs(
        make_study({"A": -0.4, "B": 0.0}, world_sd=0.4, seed=3), [("A", "B")]
    )
    text = describe_pair(*decisions[2:])
    assert "is not decided" in text
    assert "With the prior that the SD between worlds is about 0.5" in text
    assert "worlds would decide an effect of twice the SD" in text
    one = decide_planned_pairs(make_study({"A": -0.4, "B": 0.0}, worlds=1), [("A", "B")])
    assert describe_pair(*one[2:]).startswith("One world:")
    total = describe_total(one)
    assert total.startswith("1 planned pair: 1 decided in these worlds, 0 in a new world.")
    assert "5 % for all pairs together" in total


def test_sentence_of_the_order():
    here, new = order_filters(make_study({"A": -1.0, "B": 0.0, "C": 0.0}))
    text = describe_ranking(here, new, "A")
    assert "in these worlds: A." in text
    assert "1 to 1 of 3" in text
    assert not FORBIDDEN.search(text)


def test_forbidden_words_are_found():
    assert FORBIDDEN.search("A is significantly better")
    assert FORBIDDEN.search("A outperforms B")
