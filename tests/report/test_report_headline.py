"""Summary of a study of many worlds: main groups, status of the runs, and figures."""

from itertools import product

import numpy as np
import pandas as pd

from pfbench.report import options, summary, writers
from pfbench.report.plots import comparison_figures, plotting, summary_figures
from pfbench.results import conditions
from pfbench.results.comparison import condition_blocks
from pfbench.results.comparison.pairwise_tests import compare_pairs
from pfbench.results.state_groups import select_main_group
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
                    "scenario": world, "family": world, "noise": noise, "model": "m", "label": label, "group": group, "component": "norm",
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
    return own, decided, name, condition_blocks.ranking_blocks(own, name)


def words():
    return (
        writers._environment(False)
        .get_template("text.jinja")
        .make_module({"options": options.ReportOptions()})
    )


def test_filters_that_tie_with_the_sixth_are_named_and_the_others_counted():
    own, decided, _, _ = found(rows())
    said = summary.summarise_study(decided, own, mains(), [])
    often = tuple((f"f{k}", 6 if k < 8 else 2) for k in range(11))
    tied = summary.replace(said, often=often)
    assert [label for label, _ in tied.foremost] == [f"f{k}" for k in range(8)]
    text = words().summary(tied)
    assert "f5 6, f6 6, f7 6. 3 other filters have fewer." in text
    assert "have fewer" not in words().summary(summary.replace(said, often=often[:8]))
    assert summary.replace(said, often=()).foremost == ()


def test_status_of_the_runs_comes_first():
    gone = [(world, noise, "sir") for world, noise in product(WORLDS, REGIMES)]
    own, decided, _, source = found(rows(lost=gone))
    fates = [
        (label, StatusCounts(16 * (label == "sir"), int(label == "rpf"), 2 * (label == "rpf"), 16,
                             collapsed=int(label == "mssrckf")))
        for label in SIZES for _ in range(6)
    ]  # fmt: skip
    said = summary.summarise_study(decided, own, mains(), fates)
    assert said.lost == (("sir", 96, 96),)
    assert said.diverged == (("rpf", 6, 96),)
    assert said.overconfident == (("rpf", 12, 96),)
    assert said.collapsed == (("mssrckf", 6, 96),)
    assert (said.runs, said.worlds, said.regimes) == (5 * 6 * 16, 3, 2)
    lines = [line for line in words().summary(said).split("\n") if line.strip()]
    starts = ("5 filters in 6 conditions (3 worlds, 2 noise regimes), 480 runs", "Lost runs: 96 of 480",
              "Diverged runs: 6 of 480", "Collapsed runs: 6", "Severely overconfident runs", "Exploratory")  # fmt: skip
    for line, start in zip(lines, starts, strict=True):
        assert line.startswith(start)
    for figure in summary_figures.summary_figures(source, said.group):
        assert figure.make().get_figwidth() <= 3.6


def test_scenarios_of_one_family_are_one_world_of_the_summary():
    own, decided, _, _ = found(rows())
    said = summary.summarise_study(decided, own.assign(family="one"), mains(), [])
    assert (said.worlds, said.cells) == (1, 6)


def test_worlds_without_a_position_are_compared_by_what_they_have():
    def group_of(world):
        return "state" if world == "lake" else "position"

    own, decided, name, source = found(rows(group_of), mains(group_of))
    assert name == summary.MAIN
    assert len(source.cells) == 6
    assert len(decided) == 6 * 10
    np.testing.assert_allclose(
        source.values, found(rows())[3].values
    )  # the same numbers under one name
    said = summary.summarise_study(decided, own, mains(group_of), [])
    assert said.group == "position, and state in lake"
    assert dict(said.often)["mcmc_rpf"] == said.compared == 6
    assert "sir" not in dict(said.often)
    assert said.incomplete == ()


def test_a_condition_that_lacks_filters_is_named():
    own, decided, _, source = found(
        rows(skipped=[("lake", "outliers", "sir"), ("lake", "outliers", "rpf")])
    )
    said = summary.summarise_study(decided, own, mains(), [])
    assert said.incomplete == (("lake / outliers / m", 2),)
    assert len(source.cells) == 5
    text = words().summary(said)
    assert "A planned pair is decided by the conditions that both filters have." in text


def test_the_main_group_is_the_position_or_the_first():
    assert select_main_group(["attitude", "position"]) == "position"
    assert select_main_group(["state [m]", "state [m/s]"]) == "state [m]"
    assert select_main_group([]) == ""


def test_many_filters_of_which_none_has_a_colour_have_no_legend_and_an_order():
    table = rows()
    few = table[table.scenario != "lake"]
    decided = [v for v in compare_pairs(few) if v.group == "position"]
    blocks = condition_blocks.ranking_blocks(few, "position")
    style = plotting.mute_others(plotting.line_styles(list(SIZES)), [])
    drawn = {d.name: d.make() for d in comparison_figures.study_figures(blocks, decided, style)}
    order = [tick.get_text() for tick in drawn["matrix_position"].axes[0].get_yticklabels()]
    assert order[-2:] == ["rpf", "sir"]
    assert not drawn["profile_position"].legends
    labels = [f"{k}" for k in range(12)]
    assert conditions.natural_sort_key("2") < conditions.natural_sort_key("10")
    assert (
        plotting.mute_others(plotting.line_styles(labels), ["3"])["4"].instants
        < plotting.line_styles(labels)["4"].instants
    )
