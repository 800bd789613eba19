"""The five words: planted shares and effects with their power, error rates, order of readings, halves of the runs, lost runs."""

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
    NOT_RUN,
    OPEN,
    REFUTED,
    TRUE,
    UNTESTABLE,
    VACUOUS,
    ClaimDecision,
    ClaimSample,
    ReadingDot,
    WeighedSample,
    bound_share,
    decide_claim,
    weigh,
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


def dot(*comparisons: ClaimSample, draw: int = -1, **levels: str) -> ReadingDot:
    return ReadingDot(levels, [weigh(c) for c in comparisons], draw=draw)


def decide_single(*comparisons: ClaimSample) -> ClaimDecision:
    return decide_claim({"central": dot(*comparisons)})


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
    shown = found.first[1]
    assert 0.99 < shown.low < shown.high < 1.0
    assert (found.word, found.outcomes) == (CONFIRMED, {"central": TRUE})


def test_the_comparison_that_decides_is_described() -> None:
    """The false one, and not one near the border that decides nothing."""
    clear, near = draw(1.5, n=400), draw(1.01, n=90, seed=3)
    found = decide_single(clear, near)
    assert (found.word, found.first[1].runs) == (REFUTED, 400)


def test_equality_needs_runs_enough() -> None:
    assert decide_single(draw(1.0, "same", n=60)).word == OPEN
    assert decide_single(draw(1.0, "same", n=1500)).word == CONFIRMED


def test_a_claim_of_several_comparisons_is_true_if_all_are_and_false_if_some_is() -> None:
    assert decide_single(draw(0.6), draw(0.6, seed=2)).word == CONFIRMED
    assert decide_single(draw(0.6), draw(1.5, seed=2)).word == REFUTED
    words = [decide_single(draw(0.6), draw(1.0, seed=seed)).word for seed in range(2, 6)]
    assert words == [OPEN] * 4  # on both sides of 1


def test_a_word_of_listed_readings_needs_all_of_them_and_depends_names_the_factor() -> None:
    better, worse = draw(0.6), draw(1.6, seed=2)
    dots = {
        "central": dot(better, speed="20", noise="1"),
        "speed_200": dot(better, speed="200", noise="1"),
        "noise_5": dot(worse, speed="20", noise="5"),
    }
    found = decide_claim(dots)
    assert (found.word, found.factor, found.is_drawn) == (DEPENDS, "noise", False)
    assert found.outcomes == {"central": TRUE, "speed_200": TRUE, "noise_5": FALSE}
    missing = decide_claim({"central": dot(better, speed="20"), "speed": ReadingDot({"speed": "200"}, [WeighedSample(state=NOT_RUN)])})  # fmt: skip
    assert missing.word == OPEN
    assert missing.outcomes == {"central": TRUE, "speed": NOT_RUN}


def draw_readings(share: float, n: int, first: ReadingDot | None = None) -> dict[str, ReadingDot]:
    """Plant a share of true readings, spread over the draws; a factor tells them apart, another one does not."""
    true, false = weigh(draw(0.6)), weigh(draw(1.6))
    is_true = [math.floor(share * (k + 1) + 1e-9) > math.floor(share * k + 1e-9) for k in range(n)]
    drawn = {
        f"draw {k}": ReadingDot({"x": str(k % 3), "y": str(is_true[k])}, [true if is_true[k] else false], draw=k)
        for k in range(n)
    }  # fmt: skip
    return {"central": first or ReadingDot({"x": "0", "y": "True"}, [true]), **drawn}


@pytest.mark.parametrize(
    ("share", "n", "word", "counted"),
    [
        (0.0, 100, REFUTED, 100),
        (0.0, 99, OPEN, 50),  # 50 readings allow a share of more than 5 %
        (0.01, 200, REFUTED, 200),
        (0.05, 200, OPEN, 200),
        (0.5, 60, DEPENDS, 50),
        (0.1, 50, OPEN, 50),
        (0.2, 200, DEPENDS, 50),
        (0.95, 200, OPEN, 200),
        (0.99, 200, CONFIRMED, 200),
        (1.0, 100, CONFIRMED, 100),
    ],
)
def test_a_planted_share_of_joint_readings_gives_its_word(
    share: float, n: int, word: str, counted: int
) -> None:
    """At the first look that decides, else at the last; the central reading is none of the sample."""
    found = decide_claim(draw_readings(share, n))
    assert (found.word, found.share.counted, found.is_drawn) == (word, counted, True)
    assert found.share.low <= share <= found.share.high
    assert (found.factor, found.explained) == ("y", 1.0) if word == DEPENDS else not found.factor


def test_fewer_draws_than_a_look_are_readings_of_the_list() -> None:
    """A single joint reading turns a word on which all others agree."""
    assert decide_claim(draw_readings(1.0, 49)).word == CONFIRMED
    turned = {**draw_readings(1.0, 48), "draw 48": dot(draw(1.6), draw=48, x="0", y="False")}
    assert decide_claim(turned).word == DEPENDS


def test_an_undecided_reading_counts_as_true_and_as_false() -> None:
    border = dot(draw(1.0, n=40), x="0", y="True")
    assert border.outcome == OPEN
    dots = draw_readings(0.0, 100)
    for k in range(20):
        dots[f"draw {5 * k}"] = border._replace(draw=5 * k)
    share = decide_claim(dots).share
    assert (share.true, share.false, share.counted) == (0, 80, 100)
    assert share.low == 0.0
    assert share.high > 0.2


def test_the_bound_of_a_share_allows_for_false_outcomes_of_readings() -> None:
    """2 % of readings without an effect show one; a share of 95 % needs 95 readings of 95 at a look."""
    assert bound_share(0, 100) == bound_share(5, 200) == 0.0
    assert bound_share(94, 94) < 0.95 <= bound_share(96, 96)


def test_readings_without_information_do_not_count() -> None:
    better = draw(0.6)
    same = draw(1.0, "same", n=40)
    equal = same._replace(a=same.b)
    lost = better._replace(lost_a=np.ones(90, bool), lost_b=np.ones(90, bool))
    for empty, outcome in (
        (ReadingDot({}, [WeighedSample(state=CANNOT_RUN)]), CANNOT_RUN),
        (dot(equal), VACUOUS),
        (dot(lost), CANNOT_RUN),
    ):
        found = decide_claim({"central": dot(better), "x": empty})
        assert (found.word, found.outcomes["x"]) == (CONFIRMED, outcome)
        assert decide_claim({"x": empty}).word == UNTESTABLE
    drawn = draw_readings(0.0, 100)
    for k in range(7):
        drawn[f"draw {k}"] = ReadingDot(
            {"x": "0", "y": "0"}, [WeighedSample(state=CANNOT_RUN)], draw=k
        )
    found = decide_claim(drawn)
    assert (found.word, found.share.counted) == (OPEN, 93)  # too few for a bound of 5 %


def test_filters_that_are_equal_refute_a_direction_without_a_test() -> None:
    """As two cubature rules on a linear model: false by construction."""
    pair = draw(1.0, n=12)
    assert decide_single(pair._replace(a=pair.b)).word == REFUTED
    assert decide_claim({"central": ReadingDot({}, [WeighedSample(1.0, 0.0)])}).word == REFUTED


def test_a_lost_run_is_worse_than_every_kept_one() -> None:
    """A planted admission fault: a form that loses most runs is not better by the runs that it does not lose."""
    pair = draw(0.5)
    assert decide_single(pair).word == CONFIRMED
    many = np.arange(90) < 60
    assert decide_single(pair._replace(lost_a=many)).word == REFUTED
    assert decide_single(pair._replace(lost_b=many)).word == CONFIRMED
    assert decide_single(pair._replace(a=np.where(many, np.inf, pair.a))).word == REFUTED


def test_no_word_changes_with_the_order_of_listed_readings() -> None:
    g = np.random.default_rng(7)
    words = set()
    for _ in range(5):
        dots = {
            f"reading {r}": dot(RATES.make_comparison(g, ratio, "better"), factor=str(r))
            for r, ratio in enumerate(g.choice([0.6, 0.9, 1.4], 4))
        }
        found, again = decide_claim(dots), decide_claim(dict(reversed(list(dots.items()))))
        assert (again.word, dict(again.outcomes)) == (found.word, dict(found.outcomes))
        words.add(found.word)
    assert len(words) > 1


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


@pytest.mark.parametrize("lost", [0.0, pytest.param(0.1, marks=pytest.mark.slow)])
def test_error_rates_of_the_words(lost: float) -> None:
    """False words at planted shares of 0, 1, 5, 50, 99 and 100 %; the script has 1000 claims for each."""
    rows = RATES.measure_rates(40, 11, lost)
    for row in rows:
        assert max(row["false_confirmed"], row["false_refuted"], row["false_depends"]) <= RATES.allow(40), row  # fmt: skip
    words = {(row["share"], row["effect"], row["readings"]): row for row in rows}
    assert words[0.0, "clear", "drawn"]["refuted"] == words[1.0, "clear", "drawn"]["confirmed"] == 1
    assert words[0.5, "clear", "drawn"]["depends"] == 1


def test_the_rates_of_the_page_keep_the_level() -> None:
    stored = yaml.safe_load(RATES.RATES.read_text())
    assert stored["claims"] >= 1000
    assert {row["share"] for row in stored["rates"]} == set(RATES.SHARES)
    for row in stored["rates"]:
        for word in ("confirmed", "refuted", "depends"):
            assert row[f"false_{word}"] <= RATES.allow(stored["claims"])
    worst = max(row["false_refuted"] for row in stored["rates"])
    assert f"{worst:.1%} a false refuted" in _say_error_rates()


def test_ratio_interval_and_order_of_the_central_reading() -> None:
    shown = decide_single(draw(0.7, n=400)).first[1]
    assert shown.low < 0.7 < shown.high
    assert shown.runs == 400
    assert 0.7 < shown.order < 1.0
