"""Scores of the whole law in a report: in the right units, cut in time with the rest, honest about narrow and wide regions."""

import numpy as np
import pandas as pd
import pytest
import synthetic_results as synthetic
from scipy import stats

from pfbench.report import tables
from pfbench.report.plots import calibration_plots, condition_figures
from pfbench.report.plots.plotting import line_styles
from pfbench.results import conditions, consistency, coverage, frame, store
from pfbench.results.statistics import intervals

ARCMIN = 180 * 60 / np.pi
METHODS = (
    synthetic.Method("honest", 1.0),
    synthetic.Method("narrow", 1.0, 0.4),
    synthetic.Method("wide", 1.0, 2.0),
    synthetic.Method("lossy", 1.0, lost=(0, 1, 2)),
)


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    root = tmp_path_factory.mktemp("results")
    for method in METHODS:
        synthetic.write(root / "demo", method, runs=60, steps=40)
    return root


@pytest.fixture(scope="module")
def loaded(study):
    (cell,) = conditions.load_conditions("demo", study)
    return {job.label: job.load() for job in cell.jobs}


def test_scores_in_units_by_hand(study, loaded):
    rows = frame.load_frame("demo", study, start_time_s=15.0)
    own = rows[(rows.label == "lossy") & (rows.run == 5)].set_index(
        ["metric", "group", "component"]
    )
    arrays = loaded["lossy"].data
    kept = arrays["time"][arrays["score_steps"]] >= 15.0
    assert kept.tolist() == [False, True, True, True]
    crps = arrays["crps"][5, kept].astype(float)
    assert own.loc[("crps", "attitude", "attitude_N"), "value"] == pytest.approx(
        crps[:, 1].mean() * ARCMIN
    )
    assert own.loc[("crps", "attitude", "mean"), "value"] == pytest.approx(
        crps[:, :3].mean() * ARCMIN
    )
    assert own.loc[("crps", "attitude", "mean"), "unit"] == "arcmin"
    energy = arrays["energy_score"][5, kept, 2].astype(float)
    assert own.loc[("energy", "position", "norm"), "value"] == pytest.approx(energy.mean())
    pit = arrays["pit"][5, kept, 6:].astype(float)
    assert own.loc[("coverage_50", "position", "mean"), "value"] == pytest.approx(
        ((pit > 0.25) & (pit < 0.75)).mean()
    )
    lost = rows[(rows.label == "lossy") & rows.lost]
    assert np.isinf(lost.value[lost.metric.isin(["crps", "energy"])]).all()
    assert lost.value[lost.metric.str.startswith("coverage")].isna().all()


def test_scores_are_cut_with_the_instants(loaded):
    whole = loaded["honest"]
    late = frame.drop_before(whole, 15.0)
    np.testing.assert_array_equal(late.data["time"][late.data["score_steps"]], [20.0, 30.0, 40.0])
    np.testing.assert_array_equal(late.data["pit"], whole.data["pit"][:, 1:])
    assert frame.drop_before(whole, 40.0).data["score_steps"].tolist() == [0]
    early = frame.select_steps(whole, whole.data["time"] < 10.0)
    assert not {"score_steps", "crps", "pit", "energy_score"} & early.data.keys()
    assert (
        calibration_plots.calibration_figures(
            {"honest": early}, ["position"], line_styles(["honest"])
        )
        == []
    )


def test_narrow_and_wide_are_told_and_lost_runs_are_not_counted(study):
    rows = frame.load_frame("demo", study)
    found = coverage.compute_coverage(rows[rows.group == "position"])
    assert {one.label: one.decision for one in found} == {
        "honest": coverage.CONSISTENT, "lossy": coverage.CONSISTENT,
        "narrow": coverage.UNDER_COVERAGE, "wide": coverage.OVER_COVERAGE,
    }  # fmt: skip
    assert {one.label: one.runs for one in found}["lossy"] == 57
    text = coverage.format_coverage(found, "position")
    assert "under-coverage for narrow (" in text
    assert "over-coverage for wide (" in text
    assert text.endswith("consistent with 90 % for honest, lossy.")
    assert coverage.format_coverage(found, "velocity") == ""
    shares = {one.label: one.share for one in found}
    assert shares["narrow"] == pytest.approx(2 * stats.norm.cdf(0.4 * 1.6449) - 1, abs=0.06)


def test_a_calibrated_filter_is_rarely_called_otherwise():
    rng = np.random.default_rng(1)
    false, studies, runs = 0, 150, 40
    for _ in range(studies):  # six numbers of a run that hang together
        z = np.sqrt(0.5) * (rng.standard_normal((runs, 1, 1)) + rng.standard_normal((runs, 3, 2)))
        value = consistency.coverage_per_run(stats.norm.cdf(z), np.zeros(runs, bool), 0.9)
        false += (
            coverage._judge(("s", "n", "m", "g", "f"), value, 0.05, 1).decision
            != coverage.CONSISTENT
        )
    assert false <= stats.binom.ppf(0.999, studies, 0.08)


def test_rank_histograms_are_flat_for_a_uniform_law_and_weigh_runs_alike():
    rng = np.random.default_rng(2)
    pit, lost = rng.random((500, 4, 2)), np.zeros(500, bool)
    flat = consistency.rank_histogram(pit, lost)
    assert flat.value.sum() == pytest.approx(1)
    low, high = intervals.binomial_interval(0.1, 500, 0.001)
    assert ((flat.value > low) & (flat.value < high)).all()
    few = np.full((2, 3, 1), np.nan)
    few[0], few[1, 0] = 0.05, 0.95  # three numbers of one run, one of the other
    assert consistency.rank_histogram(few, lost[:2]).value[[0, 9]].tolist() == [0.5, 0.5]
    assert consistency.rank_histogram(few, np.array([True, False])).value[9] == 1
    assert consistency.rank_histogram(np.ones((1, 1, 1)), lost[:1]).value[9] == 1


def test_the_band_holds_for_numbers_that_hang_together():
    rng = np.random.default_rng(3)
    low, high = intervals.binomial_interval(0.1, 50, 0.05)
    out = [
        consistency.rank_histogram(
            np.repeat(rng.random((50, 1, 1)), 5, axis=1), np.zeros(50, bool)
        ).value
        for _ in range(200)
    ]
    assert ((np.array(out) < low) | (np.array(out) > high)).mean() < 0.06


def test_columns_and_lines(loaded):
    table = tables.accuracy_table(loaded, "attitude").set_index("filter")
    arrays = loaded["lossy"].data
    kept = ~arrays["lost"]
    assert table.loc["lossy", "CRPS [arcmin]"] == pytest.approx(
        arrays["crps"][kept][..., :3].astype(float).mean() * ARCMIN
    )
    energy = arrays["energy_score"][kept][..., 0].astype(float).mean() * ARCMIN
    assert table.loc["lossy", "energy score [arcmin]"] == pytest.approx(energy)
    coverage = table["coverage of the 90 % interval [%]"]
    assert coverage["narrow"] < 70 < coverage["honest"]
    figure = calibration_plots.plot_rank_histograms(loaded, ["position"], line_styles(list(loaded)))
    lines = {line.get_label(): np.asarray(line.get_ydata()) for line in figure.axes[0].lines}
    assert lines["narrow"][[0, -1]].min() > 15 > 7 > lines["wide"][[0, -1]].max()
    assert lines["honest"].sum() == pytest.approx(100)


def test_of_many_filters_the_best_and_the_least_believable_are_drawn(study, loaded):
    rows = frame.load_frame("demo", study)
    groups = ["velocity", "position"]
    assert list(condition_figures.select_spread_filters(loaded, rows, groups)) == list(loaded)
    more = {**loaded, "twin": loaded["honest"]}
    again = rows[rows.label == "honest"].assign(label="twin")
    again.loc[again.metric == "rmse", "value"] *= 0.5
    chosen = condition_figures.select_spread_filters(more, pd.concat([rows, again]), groups)
    assert set(chosen) == {"twin", "narrow"}
    assert "of 5 filters the one with the smallest median RMSE of position" in chosen["twin"]
    assert "largest distance of NEES" in chosen["narrow"]


def test_scores_of_wrong_shape_are_refused(study, tmp_path):
    path = next((study / "demo").glob("*.npz"))
    meta, arrays = store.read_result(path)
    with pytest.raises(
        ValueError, match=r"pit must have shape \['R', 'S', 'D'\].* got \(60, 3, 9\)"
    ):
        store.write_result(tmp_path / path.name, meta, {**arrays, "pit": arrays["pit"][:, :3]})
    with pytest.raises(ValueError, match=r"crps must have shape \['R', 'S', 'D'\] = \(60, 0, 9\)"):
        store.write_result(
            tmp_path / path.name,
            meta,
            {name: a for name, a in arrays.items() if name != "score_steps"},
        )
