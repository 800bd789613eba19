"""Figures of innovations and of cost: what is drawn is what the runs that were not lost say."""

import numpy as np
import pandas as pd
import pytest
import synthetic_results as synthetic
from scipy import stats

from pfbench.report.plots import condition_figures, cost_plots, filter_plots
from pfbench.report.plots.plotting import line_styles
from pfbench.results import store


@pytest.fixture
def results(tmp_path):
    made = {}
    for k, method in enumerate(synthetic.METHODS[:2]):
        found = store.read_result(synthetic.write(tmp_path / "demo", method, runs=6, steps=20))
        rng = np.random.default_rng(k)
        lost = np.array([True, *[False] * 5])
        own = {
            "score_steps": np.array([4, 9, 19]),
            "nis": rng.chisquare(3, (6, 3)),
            "nis_dof": np.full((6, 3), 3),
            "lost": lost,
        }
        own["nis"][2, 0] = np.nan  # nothing was seen there
        own["nis"][0] = 1e9  # of the lost run
        made[method.name] = store.JobResult(
            {**found.meta, "memory": (k + 1) * 2**20}, {**found.data, **own}
        )
    return made


def test_nis_is_pooled_over_runs_with_the_band_of_as_many_components(results):
    axis = filter_plots.plot_nis(results, line_styles(list(results)), 0.05).axes[0]
    for label, line in zip(results, axis.lines, strict=False):
        arrays = results[label].data
        np.testing.assert_array_equal(line.get_xdata(), arrays["time"][[4, 9, 19]])
        kept = arrays["nis"][1:]
        np.testing.assert_allclose(
            line.get_ydata(), np.nansum(kept, 0) / (3 * (~np.isnan(kept)).sum(0))
        )
    low, high = (line.get_ydata() for line in axis.lines[-2:])
    n = np.array([12, 15, 15])
    np.testing.assert_allclose(low, stats.chi2.ppf(0.025, n) / n)
    np.testing.assert_allclose(high, stats.chi2.ppf(0.975, n) / n)


def test_cost_shows_time_and_memory_and_neither_where_it_is_not_known(results):
    labels = list(results)
    time, memory = cost_plots.plot_cost(results, line_styles(labels)).axes
    ends = [line.get_xdata()[0] for line in memory.lines[1::2]]
    assert ends == [1.0, 2.0]
    assert [line.get_xdata()[0] for line in time.lines[1::2]] == [
        1e3 * results[k].meta["seconds"]["per_step"] for k in labels
    ]
    assert [tick.get_text() for tick in time.get_yticklabels()] == labels
    bare = {k: store.JobResult({**r.meta, "memory": None}, r.data) for k, r in results.items()}
    assert len(cost_plots.plot_cost(bare, line_styles(labels)).axes) == 1


def test_a_large_page_has_neither(results):
    runs = pd.DataFrame({"metric": [], "component": [], "group": [], "label": [], "value": []})
    for brief, there in ((False, True), (True, False)):
        names = {
            d.name
            for d in condition_figures.condition_figures(
                results, runs, line_styles(list(results)), ["position"], brief=brief
            )
        }
        assert ({"nis", "cost"} <= names) is there
