"""What a study of many worlds comes to: planned pairs, the main group, and the first screen."""

from itertools import product

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from pfbench.report import baselines, options, summary, writers
from pfbench.report.plots import comparison_figures, plotting, summary_figures
from pfbench.results import conditions
from pfbench.results.comparison import condition_blocks, rankings
from pfbench.results.comparison.pairwise_results import INCONCLUSIVE
from pfbench.results.comparison.pairwise_tests import compare_pairs
from pfbench.results.statistics.signed_rank import holm
from pfbench.results.status import StatusCounts

WORLDS, REGIMES = ("plain", "hill", "lake"), ("nominal", "outliers")
SIZES = {"sir": 1.5, "rpf": 1.2, "mcmc_rpf": 1.0, "mssrckf": 1.0, "fm_mssrckf": 1.1}


def rows(group_of=lambda world: "position", runs=16, seed=0, lost=(), skipped=()):
    """RMSE of the norm of two groups; filters differ by known factors, runs by a common one."""
    rng = np.random.default_rng(seed)
    parts = []
    for world, noise in product(WORLDS, REGIMES):
        common = rng.lognormal(0, 0.5, runs)
        for label, size in SIZES.items():
            if (world, noise, label) in skipped:
                continue
            value = size * common * rng.lognormal(0, 0.05, runs)
            gone = np.full(runs, (world, noise, label) in lost)
            for group in (group_of(world), "velocity"):
                parts.append(pd.DataFrame({
                    "scenario": world, "noise": noise, "model": "m", "label": label, "group": group, "component": "norm",
                    "unit": "m", "metric": "rmse", "seed": 1, "run": np.arange(runs), "lost": gone,
                    "value": np.where(gone, np.inf, value),
                }))  # fmt: skip
    return pd.concat(parts, ignore_index=True)


def mains(group_of=lambda world: "position"):
    return {(world, noise, "m"): group_of(world) for world, noise in product(WORLDS, REGIMES)}


def found(table, of=None):
    own, decided, name = summary.select_main_rows(
        table, compare_pairs(table[table.group != "velocity"]), of or mains()
    )
    source = condition_blocks.ranking_blocks(own, name)
    return own, decided, name, source, baselines.compare_with_baselines(source, decided, 0.05)


def test_planned_pairs_are_tested_as_scipy_does_and_corrected_over_themselves():
    _, decided, _, source, pairs = found(rows())
    assert [(p.method, p.baseline) for p in pairs] == [
        ("mcmc_rpf", "sir"),
        ("mcmc_rpf", "rpf"),
        ("fm_mssrckf", "mssrckf"),
    ]
    p = []
    for pair in pairs:
        a, b = (
            source.values[:, source.filters.index(label)] for label in (pair.method, pair.baseline)
        )
        assert pair.p == pytest.approx(stats.wilcoxon(a - b).pvalue)
        assert pair.ratio == pytest.approx(np.median(np.exp(a - b)))
        own = [v.winner for v in decided if {v.a, v.b} == {pair.method, pair.baseline}]
        assert (pair.better, pair.worse) == (own.count(pair.method), own.count(pair.baseline))
        p.append(pair.p)
    np.testing.assert_allclose([pair.p_holm for pair in pairs], holm(p))
    assert {pair.family for pair in pairs} == {3}
    assert pairs[0].ratio < 0.75 < pairs[1].ratio < 0.9 < 1.05 < pairs[2].ratio
    assert [pair.better for pair in pairs[:2]] == [6, 6]
    assert pairs[2].worse == 6


def test_a_winner_needs_the_corrected_p_and_is_the_one_whose_errors_are_smaller():
    table = rows()
    _, _, _, _, pairs = found(table)
    assert [pair.winner for pair in pairs] == [
        INCONCLUSIVE
    ] * 3  # six cells give p = 2 / 2^6 at best, three times that here
    more = pd.concat([table, rows(seed=1).assign(model="n")], ignore_index=True)
    of = mains() | {(world, noise, "n"): group for (world, noise, _), group in mains().items()}
    assert [pair.winner for pair in found(more, of)[4]] == ["mcmc_rpf", "mcmc_rpf", "mssrckf"]


def words():
    return (
        writers._environment(False)
        .get_template("text.jinja")
        .make_module({"options": options.ReportOptions()})
    )


def test_what_cannot_be_shown_is_not_called_no_difference():
    table = rows()
    pairs = found(table)[4]
    assert min(pair.p for pair in pairs) == 2 / 2**6  # all signs alike
    assert {(pair.least, pair.possible, pair.decided) for pair in pairs} == {
        (7, False, "inconclusive: 6 conditions are too few")
    }
    text = words().baselines(pairs)
    assert (
        "over 6 conditions of 3 scenarios (dependent blocks): inconclusive: 6 conditions are too few"
        in text
    )
    assert "requires 7 conditions" in text
    assert "inconclusive in" not in text
    more = pd.concat([table, rows(seed=1).assign(model="n")], ignore_index=True)
    of = mains() | {(world, noise, "n"): group for (world, noise, _), group in mains().items()}
    pairs = found(more, of)[4]
    assert (
        [pair.decided for pair in pairs]
        == [pair.winner for pair in pairs]
        == ["mcmc_rpf", "mcmc_rpf", "mssrckf"]
    )
    assert "better in 2 (mcmc_rpf / sir, mcmc_rpf / rpf), worse in 1" in words().baselines(pairs)


def test_filters_that_tie_with_the_sixth_are_named_and_the_others_counted():
    table = rows()
    own, decided, _, _, pairs = found(table)
    one = rankings.rank_filters(own, "position")
    said = summary.summarise_study(one, decided, pairs, own, mains(), [])
    often = tuple((f"f{k}", 6 if k < 8 else 2) for k in range(11))
    tied = summary.replace(said, often=often)
    assert [label for label, _ in tied.foremost] == [f"f{k}" for k in range(8)]
    text = words().summary(tied, one)
    assert "f5 6, f6 6, f7 6. 3 other filters have fewer." in text
    assert "have fewer" not in words().summary(summary.replace(said, often=often[:8]), one)
    assert summary.replace(said, often=()).foremost == ()


def test_what_runs_are_lost_decides_and_is_said():
    gone = [(world, noise, "sir") for world, noise in product(WORLDS, REGIMES)]
    own, decided, _, source, pairs = found(rows(lost=gone))
    assert pairs[0].ratios == (0.0,) * 6
    assert pairs[0].better == 6
    one = rankings.rank_filters(own, "position")
    fates = [
        (label, StatusCounts(16 * (label == "sir"), int(label == "rpf"), 2 * (label == "rpf"), 16))
        for label in SIZES for _ in range(6)
    ]  # fmt: skip
    said = summary.summarise_study(one, decided, pairs, own, mains(), fates)
    assert said.lost == (("sir", 96, 96),)
    assert said.diverged == (("rpf", 6, 96),)
    assert said.overconfident == (("rpf", 12, 96),)
    assert said.runs == 5 * 6 * 16
    for figure in summary_figures.summary_figures(one, source, pairs, 0.05, said.group):
        assert figure.make().get_figwidth() <= 3.6


def test_worlds_without_a_position_are_ranked_by_what_they_have():
    def group_of(world):
        return "state" if world == "lake" else "position"

    table = rows(group_of)
    own, decided, name, source, _ = found(table, mains(group_of))
    assert name == summary.MAIN
    assert len(source.cells) == 6
    assert len(decided) == 6 * 10
    np.testing.assert_allclose(
        source.values, found(rows())[3].values
    )  # the same numbers under one name
    one = rankings.rank_filters(own, name)
    assert one.ranks[one.filters.index("sir")] == 5
    said = summary.summarise_study(one, decided, [], own, mains(group_of), [])
    assert said.group == "position, and state in lake"
    assert [label for label, _ in said.ranked[-2:]] == ["rpf", "sir"]
    assert dict(said.often)["mcmc_rpf"] == said.compared == 6
    assert "sir" not in dict(said.often)
    assert said.incomplete == ()


def test_a_cell_that_lacks_filters_is_named():
    table = rows(skipped=[("lake", "outliers", "sir"), ("lake", "outliers", "rpf")])
    own, decided, name, source, pairs = found(table)
    said = summary.summarise_study(
        rankings.rank_filters(own, name), decided, pairs, own, mains(), []
    )
    assert said.incomplete == (("lake / outliers / m", 2),)
    assert len(source.cells) == 5
    assert len(pairs) == 3


def test_the_order_of_rows_is_of_no_importance():
    table = rows()
    shuffled = table.sample(frac=1, random_state=1)
    assert sorted(map(str, found(table)[4])) == sorted(map(str, found(shuffled)[4]))


def test_the_main_group_is_the_position_or_the_first():
    assert summary.select_main_group(["attitude", "position"]) == "position"
    assert summary.select_main_group(["state [m]", "state [m/s]"]) == "state [m]"
    assert summary.select_main_group([]) == ""


def test_many_filters_of_which_none_has_a_colour_have_no_legend_and_an_order():
    table = rows()
    few = table[table.scenario != "lake"]
    decided = [v for v in compare_pairs(few) if v.group == "position"]
    one, source = (
        rankings.rank_filters(few, "position"),
        condition_blocks.ranking_blocks(few, "position"),
    )
    assert one.refused
    assert not one.ranks
    style = plotting.mute_others(plotting.line_styles(list(SIZES)), [])
    drawn = {
        d.name: d.make() for d in comparison_figures.study_figures([(one, source)], decided, style)
    }
    order = [tick.get_text() for tick in drawn["matrix_position"].axes[0].get_yticklabels()]
    assert order[-2:] == ["rpf", "sir"]
    assert not drawn["profile_position"].legends
    labels = [f"{k}" for k in range(12)]
    assert conditions.natural_sort_key("2") < conditions.natural_sort_key("10")
    assert (
        plotting.mute_others(plotting.line_styles(labels), ["3"])["4"].instants
        < plotting.line_styles(labels)["4"].instants
    )
