"""The page of a study of several cells: what it says across cells is what was decided, and every table names its budget."""

import gzip
import json
import re

import numpy as np
import pandas as pd
import pytest
import synthetic_results as synthetic
from matplotlib.figure import Figure

from pfbench.report import condition_section, cost, options, page, writers
from pfbench.report.plots import comparison_figures
from pfbench.report.plots.plotting import line_styles
from pfbench.results import frame, store
from pfbench.results.comparison import condition_blocks, pairwise_tests
from pfbench.results.decisions.comparisons import TRACK
from pfbench.results.decisions.filter_sets import FAMILY_ALL
from pfbench.results.decisions.planned_pairs import FAMILY_1

METHODS = (
    synthetic.Method("ekf", 2.0, 0.7, None, 0.4),
    synthetic.Method("sir", 1.5, 0.8, 200, 4.0, (1, 2, 3, 4)),
    synthetic.Method("apf", 1.0, 0.9, 200, 6.0),
)
NOISES = ("nominal", "surge", "heavy", "outage", "jam", "bursts")


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    root = tmp_path_factory.mktemp("results")
    for noise in NOISES:
        for method in METHODS:
            synthetic.write(root / "many", method, noise=noise, runs=15, steps=6)
    return root


@pytest.fixture(scope="module")
def report(results, tmp_path_factory):
    drawn = []

    def stub(drawing, prefix, folder, formats):
        drawn.append(f"{prefix}_{drawing.name}")
        return {
            "file": drawing.name,
            "caption": drawing.caption,
            "source": "data:,",
            "name": drawing.name,
            "broad": False,
            "anchor": drawing.name,
        }

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writers, "render_figure", stub)
        folder = page.write_report(
            "many",
            results,
            tmp_path_factory.mktemp("reports"),
            page.ReportOptions(groups=("position",)),
        ).parent
    (folder / "drawn.json").write_text(json.dumps(drawn))
    return folder


@pytest.mark.parametrize("name", ["details.html", "details.md"])
def test_the_text_is_that_of_the_verdicts(report, name):
    text = (report / name).read_text()
    records = json.loads((report / "decisions.json").read_text())
    planned = [r for r in records if r["family"] == FAMILY_1 and r["metric"] != TRACK]
    assert {(r["a"], r["b"]) for r in planned} == {("apf", "ekf"), ("apf", "sir"), ("ekf", "sir")}
    words = {q: [r["pair_word"] for r in planned if r["question"] == q] for q in "ab"}
    count = sum(word in ("better", "worse") for word in words["a"])
    assert count > 0
    assert f"3 planned pairs: {count} decided in these worlds, 0 in a new world." in text
    assert set(words["b"]) == {"not tested"}  # six regimes of one world are one world
    assert not [r for r in records if r["family"] == FAMILY_ALL]  # every pair is planned: one word
    worse = {r["b"] if r["pair_word"] == "better" else r["a"]
             for r in planned if r["question"] == "a" and r["pair_word"] in ("better", "worse")}  # fmt: skip
    top = [label for label in ("apf", "ekf", "sir") if label not in worse]
    assert f"Shown worse than no other in these worlds: {', '.join(top)}." in text
    decided = json.loads((report / "verdicts.json").read_text())
    assert {v["page"] for v in decided} == {18}
    many = sum(v["p_page"] <= 0.05 for v in decided)
    assert f"With correction over all 18 comparisons of the report, {many} are." in text
    assert "@software{pfbench," in text
    assert "year    = {2026}" in text
    runs = sorted(int(v["needed"]) for v in decided if v["noise"] == "surge")
    assert f"with power 0.8: {runs[0]} to {runs[-1]}, depending on the pair" in text


def test_every_table_names_its_budget(report):
    said = "Budget: particles (N = 200 in each particle filter)."
    for path in (report / "tables").glob("*.csv"):
        assert set(pd.read_csv(path).note) == {said}
        latex = path.with_suffix(".tex").read_text()
        assert said in latex
        assert latex.rstrip().endswith("\\end{tabular}")
    html = (report / "details.html").read_text()
    noted = re.findall(r"</table></div>(?:\n</div>)?\n<p class=\"note\">Budget: particles", html)
    assert html.count('<table class="plain">') == len(noted)


def test_the_page_carries_its_figures_and_its_filter(report):
    drawn = json.loads((report / "drawn.json").read_text())
    assert {
        "decisions_planned",
        "across_map_position",
        "across_matrix_position",
        "across_profile_position",
    } <= set(drawn)
    assert sum(name.endswith("_front") for name in drawn) == 6
    html = (report / "details.html").read_text()
    sift = html[html.index('<div class="sift">') :]
    assert sift[: sift.index("</table>")].count("<tr>") == 1 + 18
    assert html.count("<script>") == 1
    assert "<script src" not in html


def test_pictures_across_cells_show_what_was_decided(results):
    table = frame.load_frame("many", results)
    decided = pairwise_tests.compare_pairs(table[table.group == "position"])
    blocks = condition_blocks.ranking_blocks(table, "position")
    style = line_styles(sorted(set(table.label)))
    found = {d.name: d.make() for d in comparison_figures.study_figures(blocks, decided, style)}
    assert all(
        isinstance(figure, Figure) and figure.get_figwidth() <= 3.6 for figure in found.values()
    )
    axis = found["matrix_position"].axes[0]
    order = [tick.get_text() for tick in axis.get_yticklabels()]
    for text in axis.texts:
        x, y = text.get_position()
        row, column = order[round(y)], order[round(x)]
        won = sum(v.winner == row for v in decided if {v.a, v.b} == {row, column})
        assert text.get_text().startswith(f"{won}–")
    lines = {
        line.get_label(): line.get_ydata()[-1] for line in found["profile_position"].axes[0].lines
    }
    assert lines["sir"] == pytest.approx(
        100 * 11 / 15
    )  # four of fifteen runs are lost in each cell


def test_the_front_is_who_is_not_dominated():
    seconds = np.array([1.0, 2.0, 3.0, 3.0, 4.0, 0.5])
    loss = np.array([5.0, 3.0, 3.5, 2.0, np.inf, np.inf])
    assert cost.pareto_mask(seconds, loss).tolist() == [True, True, False, True, False, False]
    assert cost.pareto_mask(np.ones(3), np.ones(3)).all()
    rng = np.random.default_rng(1)
    seconds, loss = rng.random((2, 40))
    best = [not any(c <= x and l <= y and (c < x or l < y) for c, l in zip(seconds, loss, strict=True))
            for x, y in zip(seconds, loss, strict=True)]  # fmt: skip
    assert cost.pareto_mask(seconds, loss).tolist() == best


def test_a_budget_that_was_not_kept_is_not_claimed():
    def job(particles, per_step=1e-3, **config):
        return {
            "key": "k",
            "particles": particles,
            "seconds": {"per_step": per_step},
            "config": config,
        }

    assert (
        cost.format_budget([job(100), job(None)])
        == "Budget: particles (N = 100 in each particle filter)."
    )
    assert "not met (N = 100, 400)" in cost.format_budget([job(100), job(400)])
    used = [{"least": low, "mean": mean, "most": 200} for low, mean in ((100, 120.0), (110, 140.0))]
    changing = [{**job(200), "label": "grows", "particles_used": one} for one in used]
    said = cost.format_budget([job(100), job(100), *changing, job(100)])
    assert "N = 100, 200 of grows, grows used 100 to 200, 130 on average" in said
    kind = "time"
    alike = [job(100, budget=kind), job(100, 1.05e-3, budget=kind), job(9, 1.1e-3, budget=kind)]
    said = cost.format_budget(
        [*alike, job(None, 1e-5, budget=kind)]
    )  # a filter without particles has no number to keep it by
    assert said == f"Budget: {kind} (1 to 1.1 ms per step, particle filters only, N = 100, 9)."
    dear = job(9, 5e-3, budget=kind) | {"label": "dear"}
    assert f"{kind} not met by dear (4.7 times the target) (1 to 5 ms" in cost.format_budget(
        [*alike, dear]
    )
    priced = [{**one, "budget_allocation": {"price": 1e-3}} for one in alike]
    slow = [
        {**job(9, k * 1e-2, budget=kind), "budget_allocation": {"price": 1e-2}} for k in (1, 1.1)
    ]  # a cell where SIR takes longer
    assert "not met" not in cost.format_budget([*priced, *slow])
    twice = [{**dear, "budget_allocation": {"price": price}} for price in (1e-3, 2e-3)]
    assert "not met by dear (2.5 to 5 times the target)" in cost.format_budget([*priced, *twice])
    counted = [
        {**job(n, budget=store.BUDGETS[2]), "likelihoods_per_step": n * k}
        for n, k in ((100, 1.0), (10, 11.0))
    ]
    said = "(100 to 110 per step, particle filters only, N = 10, 100)."
    assert cost.format_budget(counted) == f"Budget: likelihoods {said}"
    assert "do not count them" in cost.format_budget([*counted, job(1, budget=store.BUDGETS[2])])
    assert "differs between jobs" in cost.format_budget([job(100), job(100, budget=kind)])
    with pytest.raises(ValueError, match=r"budget must be one of .* got fair"):
        cost.format_budget([job(1, budget="fair")])


def test_a_study_too_large_to_show_all_says_what_it_shows(results, tmp_path):
    """As one of 33 filters in 28 cells, at the size of this one: limits are lowered."""
    drawn = []

    def stub(drawing, prefix, folder, formats):
        drawn.append(f"{prefix}_{drawing.name}")
        return {
            "file": "",
            "caption": drawing.caption,
            "source": "data:,",
            "name": "",
            "broad": False,
            "anchor": "x",
        }

    with pytest.MonkeyPatch.context() as patch:
        for module, name, value in (
            (writers, "render_figure", stub), (condition_section, "PAIRS", 2),
            (page, "_ROWS", 30), (writers, "_MANY", 30), (options, "_NAMED", 1), (options, "_PLENTY", 17),
        ):  # fmt: skip
            patch.setattr(module, name, value)
        made = page.write_report("many", results, tmp_path)
    html = made.with_name("details.html").read_text()
    decided = json.loads(gzip.decompress((made.parent / "verdicts.json.gz").read_bytes()))
    assert len(decided) == 6 * 3 * 3
    assert not (made.parent / "verdicts.json").exists()
    assert "All 54 comparisons are in verdicts.json.gz" in html
    sift = html[html.index('<div class="sift">') :]
    rows = re.findall(r"<tr>" + 4 * r"<td class=t>(.*?)" + "<td>", sift[: sift.index("</table>")])
    assert len(rows) == 6 * 2
    assert {group for _, group, _, _ in rows} == {"position"}
    assert all("apf" in (a, b) for _, _, a, b in rows)  # the best
    assert f"The table contains {len(rows)} of the 54 comparisons" in html
    assert (
        "2 of 3 comparisons of position: those with apf, the filter with the smallest median RMSE"
        in html
    )
    pairs = pd.read_csv(made.parent / "tables" / "flight_surge_ins_gnss_position_pairs.csv")
    assert len(pairs) == 2
    assert not (made.parent / "tables" / "flight_surge_ins_gnss_velocity_pairs.csv").exists()
    assert (made.parent / "tables" / "flight_surge_ins_gnss_velocity.csv").exists()
    own = {
        name.removeprefix("flight_surge_ins_gnss_")
        for name in drawn
        if name.startswith("flight_surge")
    }
    assert own == {"error_position", "rmse", "nees", "calibration", "front", "forest_position"}
    captions = re.findall(r"<figcaption>(.*?)</figcaption>", html)
    assert sum("Coloured: the 1 filters with" in text for text in captions) >= 6 * 3
    assert "sir lost 4 of 15 runs" in html  # said in the section of each cell
    first = html.index("<h2>Summary</h2>")
    short = html[first : html.index('<section id="across">')]
    assert "Top group in" not in short
    assert "3 filters in 6 conditions (" in short
    assert "Lost runs: 24 of 270, by 1 of 3 filters. Most: sir (24 of 90)." in short
