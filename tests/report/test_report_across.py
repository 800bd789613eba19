"""Cells as blocks: against published numbers and other implementations, and by how often the tests are wrong."""

import baycomp
import numpy as np
import pandas as pd
import pytest
import scikit_posthocs as posthocs
from scipy import stats
from statsmodels.stats.multitest import multipletests

from pfbench.report import options, writers
from pfbench.results.comparison import condition_blocks, lost_run_rules, rankings
from pfbench.results.statistics import rank_tests, signed_rank

# Demsar 2006, table 6: AUC of C4.5, C4.5+m, C4.5+cf, C4.5+m+cf; the rounded tie of "voting" in its published order.
DEMSAR = np.array([
    [0.763, 0.768, 0.771, 0.798], [0.599, 0.591, 0.590, 0.569], [0.954, 0.971, 0.968, 0.967], [0.628, 0.661, 0.654, 0.657],
    [0.882, 0.888, 0.886, 0.898], [0.936, 0.931, 0.916, 0.931], [0.661, 0.668, 0.609, 0.685], [0.583, 0.583, 0.563, 0.625],
    [0.775, 0.838, 0.866, 0.875], [1.000, 1.000, 1.000, 1.000], [0.940, 0.962, 0.965, 0.962], [0.619, 0.666, 0.614, 0.669],
    [0.972, 0.981, 0.9751, 0.975], [0.957, 0.978, 0.946, 0.970],
])  # fmt: skip


def table(cells, group="position", model="m", first=0):
    """Rows as `frame` makes them, from losses {label: [runs]} of each cell."""
    parts = []
    for c, losses in enumerate(cells):
        for label, values in losses.items():
            values = np.asarray(values, dtype=float)
            rows = {
                "scenario": f"s{c // 2}",
                "noise": f"n{c % 2}",
                "model": model,
                "seed": 1,
                "group": group,
            }
            more = {
                "label": label,
                "run": np.arange(first, first + len(values)),
                "value": values,
                "lost": np.isinf(values),
            }
            parts.append(
                pd.DataFrame({**rows, **more, "component": "norm", "metric": "rmse", "unit": "m"})
            )
    return pd.concat(parts, ignore_index=True)


def world(rng, cells=8, runs=12, sizes=(1.0, 1.0, 1.0, 1.0), scatter=0.2):
    """Cells of filters whose errors are so large, each with a scatter of its own in each cell and run."""
    found = []
    for _ in range(cells):
        common = np.exp(rng.standard_normal() + 0.5 * rng.standard_normal(runs))
        sides = np.exp(scatter * rng.standard_normal(len(sizes)))
        found.append({
            "abcdefg"[k]: size * side * common * np.exp(0.1 * rng.standard_normal(runs))
            for k, (size, side) in enumerate(zip(sizes, sides, strict=True))
        })  # fmt: skip
    return found


def test_demsar_table_6():
    rank = rank_tests.rank_within_blocks(-DEMSAR)
    found = rank_tests.friedman(rank)
    assert np.round(found.ranks, 3).tolist() == [3.143, 2.0, 2.893, 1.964]
    assert round(found.plain, 3) == 9.279  # printed: 9.28
    f = 13 * found.plain / (14 * 3 - found.plain)
    assert round(f, 3) == 3.686  # printed: 3.69
    assert round(stats.f.sf(f, 3, 39), 4) == 0.0198
    assert round(stats.f.isf(0.05, 3, 39), 2) == 2.85
    # With the correction for ties, which scipy makes and the paper does not:
    assert (round(found.chi2, 3), round(found.p, 4)) == (10.228, 0.0167)
    assert round(found.critical, 3) == 1.254  # printed: 1.25
    assert round(rank_tests.friedman(rank, 0.10).critical, 3) == 1.118  # printed: 1.12
    error = rank_tests.rank_standard_error(14, 4)
    assert round(found.critical / error, 3) == 2.569
    dunn = stats.norm.isf(0.05 / 6)
    assert (round(dunn, 3), round(dunn * error, 3)) == (2.394, 1.168)
    z = (found.ranks[0] - found.ranks[[3, 1, 2]]) / error
    assert np.round(z, 3).tolist() == [2.415, 2.342, 0.512]
    p = 2 * stats.norm.sf(z)
    assert np.round(p, 3).tolist() == [0.016, 0.019, 0.608]
    for method in ("holm", "simes-hochberg", "hommel"):
        assert multipletests(p, method=method)[0].tolist() == [True, True, False]
    nemenyi = rank_tests.nemenyi(rank)
    assert np.round([nemenyi[0, 3], nemenyi[0, 1]], 4).tolist() == [0.0742, 0.0887]
    assert min(nemenyi[0, 2], nemenyi[1, 2], nemenyi[1, 3], nemenyi[2, 3]) > 0.22


def test_the_pairs_are_those_of_scikit_posthocs_and_scipy():
    cells = world(np.random.default_rng(1), 9, 11, (1.0, 1.1, 1.3, 1.6))
    found = rankings.rank_filters(table(cells), "position")
    values = np.array([[np.median(np.log(own[label])) for label in "abcd"] for own in cells])
    nemenyi = posthocs.posthoc_nemenyi_friedman(values).to_numpy()
    conover = posthocs.posthoc_conover_friedman(values, p_adjust="holm").to_numpy()
    apart = pd.DataFrame(values).melt(var_name="filter", value_name="value")
    wilcoxon = posthocs.posthoc_wilcoxon(
        apart, "value", "filter", zero_method="zsplit", p_adjust="holm"
    ).to_numpy()
    for pair in found.pairs:
        i, j = "abcd".index(pair.a), "abcd".index(pair.b)
        assert (pair.p_nemenyi, pair.p_conover, pair.p_wilcoxon) == pytest.approx(
            (nemenyi[i, j], conover[i, j], wilcoxon[i, j])
        )
        assert pair.ratio == pytest.approx(np.exp(np.median(values[:, i] - values[:, j])))
        assert (pair.wins, pair.losses) == (
            (values[:, i] < values[:, j]).sum(),
            (values[:, i] > values[:, j]).sum(),
        )
        assert pair.family == 6
    assert found.chi2 == pytest.approx(stats.friedmanchisquare(*values.T)[0])
    np.testing.assert_allclose(found.ranks, stats.rankdata(values, axis=1).mean(0))


@pytest.mark.parametrize("rope", [0.05, 0.4])
def test_the_bayesian_signed_rank_is_baycomps(rope):
    rng = np.random.default_rng(2)
    a, b = rng.standard_normal((2, 9))
    theirs = baycomp.SignedRankTest.probs(a, b + 0.3, rope, nsamples=4000, random_state=1)
    ours = signed_rank.bayesian_signed_rank(b + 0.3 - a, rope, seed=3)
    # both are shares of draws: of 4000 and of 20 000
    assert ours == pytest.approx(theirs, abs=4 * np.sqrt(0.25 / 4000 + 0.25 / 20_000))
    assert sum(ours) == pytest.approx(1)
    assert signed_rank.bayesian_signed_rank(np.full(8, -1.0), 0.05, 1)[0] > 0.99
    assert signed_rank.bayesian_signed_rank(np.zeros(8), 0.05, 1)[1] > 0.99


def test_the_better_filter_is_on_the_right_side_of_every_number():
    found = rankings.rank_filters(
        table(world(np.random.default_rng(3), 12, 15, (1.0, 1.5, 2.2), 0.02)), "position"
    )
    assert found.unbeaten == ["a"]
    assert found.p_f < 1e-6
    pair = next(p for p in found.pairs if (p.a, p.b) == ("a", "c"))
    assert (pair.winner, pair.wins, pair.losses, pair.effect) == ("a", 12, 0, 1.0)
    assert pair.ratio == pytest.approx(1 / 2.2, rel=0.05)
    assert pair.bayes_a > 0.99 > 0.01 > pair.bayes_b
    assert 0.5 < pair.better_low < pair.better < pair.better_high < 1
    assert max(pair.p_nemenyi, pair.p_conover) < 1e-4


def test_verdicts_do_not_feel_the_order_of_runs_rows_or_filters():
    rows = table(world(np.random.default_rng(4), 6, 9, (1.0, 1.2, 1.4)))
    first = rankings.rank_filters(rows, "position")
    assert rankings.rank_filters(rows.sample(frac=1, random_state=2), "position") == first
    turned = rows.assign(run=8 - rows.run)  # the same runs under other numbers
    assert rankings.rank_filters(turned, "position") == first


def test_seeds_of_a_cell_are_no_blocks():
    own = world(np.random.default_rng(5), 1, 500, (1.0, 1.5, 2.0))
    found = rankings.rank_filters(table(own), "position")
    assert found.pairs == ()
    assert "requires at least 5 conditions, and these 3 filters share 1 condition" in found.refused
    two = rankings.rank_filters(
        table(world(np.random.default_rng(5), 8, 5, (1.0, 2.0))), "position"
    )
    assert "requires at least 3 filters, and 2 filters ran" in two.refused
    # More runs in the same cells are no more blocks.
    few = world(np.random.default_rng(6), 5, 9, (1.0, 1.1, 1.2))
    many = [{label: np.tile(values, 20) for label, values in cell.items()} for cell in few]
    assert (
        rankings.rank_filters(table(many), "position").p
        == rankings.rank_filters(table(few), "position").p
    )


def test_incomplete_blocks_are_left_out_by_name():
    cells = world(np.random.default_rng(7), 8, 6, (1.0, 1.1, 1.2))
    del cells[2]["b"]
    cells[5]["c"][:] = np.nan  # no truth
    cells[0]["visitor"] = cells[0]["a"]
    found = rankings.rank_filters(table(cells), "position")
    assert found.filters == ("a", "b", "c")
    assert len(found.cells) == 6
    assert found.left_out == (
        "visitor (ran in 1 of 8 conditions)",
        "s1 / n0 / m (without b)",
        "s2 / n1 / m (without c)",
    )
    whole = [cell for i, cell in enumerate(cells) if i not in (2, 5)]
    assert (
        rankings.rank_filters(table(whole), "position").pairs == found.pairs or found.refused == ""
    )
    apart = pd.concat([table(cells[:7]), table(cells[7:], first=100).assign(scenario="s9")])
    stranger = table([{"b": cells[7]["b"]}], first=500).assign(scenario="s9", noise="n0")
    apart = pd.concat([apart[(apart.scenario != "s9") | (apart.label != "b")], stranger])
    assert any(
        "no run in common" in text for text in rankings.rank_filters(apart, "position").left_out
    )


def test_worlds_that_two_cells_share_are_counted():
    cells = world(np.random.default_rng(8), 4, 6, (1.0, 1.1, 1.2))
    both = pd.concat([table(cells), table(cells, model="other")])
    assert rankings.rank_filters(both, "position").shared == 4
    assert (
        rankings.rank_filters(
            table(world(np.random.default_rng(8), 6, 5, (1.0, 1.1, 1.2))), "position"
        ).shared
        == 0
    )


def said(found):
    """What a page says of it, without blank lines."""
    text = (
        writers._environment(False)
        .get_template("text.jinja")
        .make_module({"options": options.ReportOptions()})
    )
    return [
        line
        for line in text.over_cells({"one": found, "changed": []}, False).split("\n")
        if line.strip()
    ]


def spread_over(worlds, cells):
    """Rows of so many cells, of worlds by these names."""
    parts = [
        table([cell]).assign(scenario=name, noise=f"n{k}")
        for k, (name, cell) in enumerate(zip(worlds, cells, strict=True))
    ]
    return pd.concat(parts, ignore_index=True)


def test_regimes_of_one_world_are_one_block_of_a_second_test():
    cells = world(np.random.default_rng(13), 8, 9, (1.0, 1.1, 1.3), 0.1)
    found = rankings.rank_filters(table(cells), "position")  # two regimes of each of four worlds
    rank = stats.rankdata([[np.median(cell[label]) for label in "abc"] for cell in cells], axis=1)
    of_world = stats.rankdata(np.median(rank.reshape(4, 2, 3), axis=1), axis=1)
    assert (found.worlds, found.by_world.worlds) == (4, 4)
    assert found.by_world.p == pytest.approx(stats.friedmanchisquare(*of_world.T).pvalue)
    assert found.by_world.p > found.p  # half of the blocks
    text = said(found)
    dependent = (
        "position: the 8 conditions come from 4 scenarios. Conditions of a scenario share trajectories and random numbers, so "
        "the blocks are dependent and the p-values across conditions are too small."
    )
    assert any(line.startswith(dependent) for line in text)
    assert any(
        "with the 4 scenarios as blocks" in line
        and line.endswith("a has the best mean rank. The result over conditions is equal.")
        for line in text
    )
    order = rankings.rank_filters(table(cells).sample(frac=1, random_state=3), "position")
    assert order.by_world == found.by_world


def test_a_world_of_many_regimes_does_not_choose_the_best_filter_of_worlds():
    one, other = (
        {"a": np.full(9, 2.0), "b": np.ones(9), "c": np.full(9, 3.0)},
        {"a": [1.0], "b": [2.0], "c": [3.0]},
    )
    found = rankings.rank_filters(
        spread_over(["s0"] * 5 + ["s1", "s2"], [one] * 5 + [other] * 2), "position"
    )
    assert (found.best, found.by_world.best) == (("b",), ("a",))
    assert any(
        line.endswith("a has the best mean rank. Over conditions, b has the best mean rank.")
        for line in said(found)
    )
    tied = rankings.rank_filters(
        spread_over(["s0", "s0", "s1", "s2", "s2", "s3"], [one] * 3 + [other] * 3), "position"
    )
    assert tied.best == tied.by_world.best == ("a", "b")


def test_of_too_few_worlds_or_of_one_cell_each_nothing_is_tested_anew():
    cells = world(np.random.default_rng(12), 6, 9, (1.0, 1.1, 1.3))
    two = rankings.rank_filters(spread_over(["s0", "s1"] * 3, cells), "position")
    assert (two.worlds, two.by_world) == (2, None)
    assert any("the 6 conditions come from 2 scenarios" in line for line in said(two))
    assert any(
        "position with scenarios as blocks. Required: 3 scenarios; available: 2." in line
        for line in said(two)
    )
    own = rankings.rank_filters(spread_over([f"s{k}" for k in range(6)], cells), "position")
    assert (own.worlds, own.by_world) == (6, None)
    assert not any("scenarios" in line for line in said(own))


@pytest.mark.parametrize("filters", [3, 4, 7])
def test_of_fewer_cells_than_the_least_no_pair_can_be_shown_by_wilcoxon(filters):
    for n in range(5, 13):
        cells = [
            {"abcdefg"[k]: [1.0 + k + 0.01 * i * k] for k in range(filters)} for i in range(n)
        ]  # the same order everywhere
        found = rankings.rank_filters(spread_over([f"s{k}" for k in range(n)], cells), "position")
        assert (min(p.p_wilcoxon for p in found.pairs) <= found.alpha) == (n >= found.least), n
        (line,) = [line for line in said(found) if "requires" in line]
        assert (
            f"Holm's correction over {len(found.pairs)} pairs requires {found.least} conditions"
            in line
        )
        assert (f"With {n} conditions it is inconclusive for every pair" in line) == (
            n < found.least
        )


def test_a_filter_lost_in_most_runs_is_last_and_nothing_breaks():
    cells = world(np.random.default_rng(9), 7, 9, (1.0, 1.1, 0.5))
    for cell in cells:
        cell["c"][:5] = np.inf
    found = rankings.rank_filters(table(cells), "position")
    assert found.ranks[2] == 3.0
    assert next(p for p in found.pairs if (p.a, p.b) == ("a", "c")).ratio == 0.0
    for rule, rank in ((lost_run_rules.LEFT_OUT, 1.0), (lost_run_rules.LARGEST_ERROR, 3.0)):
        other = rankings.rank_filters(table(cells), "position", rule=rule)
        assert (other.ranks[2], other.rule) == (rank, rule.name)


def test_ties_and_rounding_share_a_rank():
    values = np.array([[0.0, 1e-9, 1.0, np.inf, np.inf], [3.0, 2.0, 1.0, 0.0, -1.0]])
    assert rank_tests.rank_within_blocks(values).tolist() == [
        [1.5, 1.5, 3.0, 4.5, 4.5],
        [5.0, 4.0, 3.0, 2.0, 1.0],
    ]
    same = {"a": np.ones(4), "b": np.ones(4), "c": np.ones(4)}
    found = rankings.rank_filters(table([same] * 6), "position")
    assert (found.p_f, found.shown, found.unbeaten) == (1.0, 0, ["a", "b", "c"])
    assert all(p.p_conover == 1 and p.better == 0.5 and p.bayes_equal > 0.9 for p in found.pairs)


def test_the_profile_counts_runs_within_a_factor_of_the_best():
    cells = [
        {"a": [1.0, 2.0], "b": [2.0, 1.0], "c": [np.inf, 4.0]},
        {"a": [1.0] * 4, "b": [3.0] * 4, "c": [1.5] * 4},
    ]
    found = condition_blocks.performance_profile(
        condition_blocks.ranking_blocks(table(cells), "position"),
        np.array([1.0, 1.5, 2.0, 3.0, 4.0, 1e9]),
    )
    # cells weigh the same although one has twice the runs
    assert found[0].tolist() == [0.75, 0.75, 1.0, 1.0, 1.0, 1.0]
    assert found[1].tolist() == [0.25, 0.25, 0.5, 1.0, 1.0, 1.0]
    assert found[2].tolist() == [0.0, 0.5, 0.5, 0.5, 0.75, 0.75]


@pytest.mark.slow
def test_false_winners_across_cells_are_as_rare_as_alpha(monkeypatch):
    """The same filter under four names, in many studies."""
    monkeypatch.setattr("gc.collect", lambda *_: 0)
    rng, n, alpha = np.random.default_rng(10), 600, 0.05
    omnibus = nemenyi = conover = signed = 0
    for _ in range(n):
        values = rng.standard_normal((12, 4))
        rank = rank_tests.rank_within_blocks(values)
        hit = rank_tests.friedman(rank).p_f <= alpha
        omnibus += hit
        nemenyi += hit and rank_tests.nemenyi(rank).min() <= alpha
        conover += hit and rank_tests.conover(rank).min() <= alpha
        signed += min(rank_tests.wilcoxon_pairs(values).values()) <= alpha
    error = 4 * np.sqrt(alpha * (1 - alpha) / n)
    # F is the law of a continuous statistic; with 12 blocks of 4 the discrete one is within half a per cent of it.
    assert omnibus / n == pytest.approx(alpha, abs=error + 0.005)
    assert alpha / 4 < nemenyi / n <= alpha + error
    assert alpha / 4 < conover / n <= alpha + error + 0.005
    assert signed / n <= alpha + error
