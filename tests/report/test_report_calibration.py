"""Scores of the whole law in a report: in the right units, cut in time with the rest, honest about narrow and wide intervals."""

import math

import numpy as np
import pandas as pd
import pytest
import synthetic_results as synthetic
from refusals import check_refused
from scipy import stats

from pfbench.results import conditions, frame, metrics, status, store
from pfbench.results.conditions import component_groups
from pfbench.stats.consistency_bands import assess_consistency, compare_share

RNG = np.random.default_rng(3)

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
    of_runs = {name: whole.data["lost"] for name, axes in store._OPTIONAL.items() if axes == "R"}
    cut = frame.drop_before(store.JobResult(whole.meta, whole.data | of_runs), 15.0)
    assert all(cut.data[name] is column for name, column in of_runs.items())
    early = frame.select_steps(whole, whole.data["time"] < 10.0)
    assert not {"score_steps", "crps", "pit", "energy_score"} & early.data.keys()


def test_coverage_tells_narrow_from_honest_and_leaves_lost_runs_out(loaded):
    group = next(
        g for g in component_groups(loaded["honest"].meta["state"]) if g.group == "attitude"
    )
    table = {label: metrics.table_columns(result, group) for label, result in loaded.items()}
    arrays = loaded["lossy"].data
    kept = ~arrays["lost"]
    assert table["lossy"]["CRPS [arcmin]"] == pytest.approx(
        arrays["crps"][kept][..., :3].astype(float).mean() * ARCMIN
    )
    energy = arrays["energy_score"][kept][..., 0].astype(float).mean() * ARCMIN
    assert table["lossy"]["energy score [arcmin]"] == pytest.approx(energy)
    share = {label: row["coverage of the 90 % interval [%]"] for label, row in table.items()}
    assert share["narrow"] < 70 < share["honest"] < share["wide"]
    narrow = 100 * (2 * stats.norm.cdf(0.4 * 1.6449) - 1)
    assert share["narrow"] == pytest.approx(narrow, abs=6)
    own = status.coverage_per_run(arrays["pit"], arrays["lost"], 0.9)
    assert np.isnan(own).tolist() == arrays["lost"].tolist()


def test_scores_of_wrong_shape_are_refused(study, tmp_path):
    path = next((study / "demo").glob("*.npz"))
    meta, arrays = store.read_result(path)
    check_refused(
        [
            (
                r"pit must have shape \['R', 'S', 'D'\].* got \(60, 3, 9\)",
                lambda: store.write_result(
                    tmp_path / path.name, meta, {**arrays, "pit": arrays["pit"][:, :3]}
                ),
            ),
            (
                r"crps must have shape \['R', 'S', 'D'\] = \(60, 0, 9\)",
                lambda: store.write_result(
                    tmp_path / path.name,
                    meta,
                    {name: a for name, a in arrays.items() if name != "score_steps"},
                ),
            ),
        ],
        remedy=False,
    )


RUNS, DOF = 40, 60


def table(sizes: dict[str, float], seed: int, runs: int = RUNS) -> pd.DataFrame:
    """NEES over its expectation of each run and world, whose runs share random numbers; 1 is consistent."""
    rng = np.random.default_rng(seed)
    parts = []
    for label, size in sizes.items():
        run = rng.chisquare(DOF, runs) / DOF
        for world in ("w0", "w1"):
            parts.append(pd.DataFrame({
                "label": label, "metric": "nees_ratio", "group": "position", "noise": "nominal", "model": "m",
                "scenario": world, "family": world, "seed": 1, "run": np.arange(runs), "lost": False,
                "value": size * run * (1 + 0.01 * rng.standard_normal(runs)),
            }))  # fmt: skip
    return pd.concat(parts, ignore_index=True)


def test_consistent_filters_are_rarely_called_otherwise() -> None:
    """The level holds for all filters together, although the worlds of a run are not independent."""
    studies, wrong = 50, 0
    for seed in range(studies):
        bands = assess_consistency(table(dict.fromkeys("abcd", 1.0), seed))
        words = bands["word"] != "no deviation shown"
        assert (words == ((bands["low"] > 1) | (bands["high"] < 1))).all()
        wrong += bool(words.any())
    assert 0 < wrong / studies <= 0.05 + 2.5 * math.sqrt(0.05 * 0.95 / studies)


def test_a_word_comes_with_the_size_of_the_deviation() -> None:
    """Intervals of all filters together contain the sizes in nearly all studies."""
    sizes = {"a": 1.5, "b": 0.6, "c": 400.0, "d": 1.0}
    inside = 0
    for seed in range(30):
        bands = assess_consistency(table(sizes, seed)).set_index("filter")
        assert bands.loc[["a", "b", "c"], "word"].tolist() == ["overconfident", "underconfident", "overconfident"]  # fmt: skip
        true = pd.Series(sizes)
        assert np.abs(np.log(bands["ratio"] / true)).max() < 0.2
        inside += bool(((bands["low"] <= true) & (true <= bands["high"])).all())
    assert inside / 30 >= 0.95 - 2.5 * math.sqrt(0.05 * 0.95 / 30)


def test_lost_runs_are_left_out_and_counted_and_few_runs_decide_nothing() -> None:
    data = table({"a": 9.0}, 1)
    data.loc[(data["run"] < 5) & (data["scenario"] == "w0"), "value"] = np.nan
    (row,) = assess_consistency(data).to_dict("records")
    assert (row["runs"], row["lost"], row["word"]) == (35, 5, "overconfident")
    (row,) = assess_consistency(table({"a": 9.0}, 1, runs=9)).to_dict("records")
    assert (row["word"], row["reason"]) == ("no deviation shown", "9 valid runs, 10 are required")
    assert (row["low"], row["high"], row["p"]) == (0.0, math.inf, pytest.approx(1.0))


def shares(correlation: float, studies: int, runs: int, sd: float = 1.0) -> np.ndarray:
    """Share of 100 steps in which a normal error lies within its 90 % interval, [studies, runs]."""
    error, covered = RNG.standard_normal((studies, runs)), np.zeros((studies, runs))
    for _ in range(100):
        error = correlation * error + np.sqrt(1 - correlation**2) * RNG.standard_normal((studies, runs))  # fmt: skip
        covered += np.abs(sd * error) < stats.norm.isf(0.05)
    return covered / 100


@pytest.mark.parametrize("correlation", [0.5, 0.95, 0.995, 1.0])
def test_a_word_on_coverage_holds_its_level_for_slow_errors(correlation: float) -> None:
    """Level of both sides 0.05; Student's test, the row that must fail, exceeds it three times for constant errors."""
    x = shares(correlation, 300, 12)
    student = 2 * stats.t.sf(np.abs(x.mean(1) - 0.9) / (x.std(1, ddof=1) / np.sqrt(12) + 1e-9), 11)
    assert np.mean([compare_share(row, 0.9) < 0.05 for row in x]) <= 0.05 + 3 * math.sqrt(0.05 * 0.95 / 300)  # fmt: skip
    assert correlation < 1.0 or np.mean(student < 0.05) > 0.15


def test_a_coverage_that_is_too_low_is_shown() -> None:
    assert np.mean([compare_share(row, 0.9) < 0.05 for row in shares(0.95, 100, 30, sd=1.4)]) > 0.9


@pytest.mark.parametrize("k", range(13))
def test_shares_of_0_and_1_have_the_binomial_test(k: int) -> None:
    tails = stats.binom.sf(k - 1, 12, 0.9), stats.binom.cdf(k, 12, 0.9)
    assert compare_share(np.arange(12.0) < k, 0.9) == pytest.approx(min(1.0, 2 * min(tails)), abs=1e-12)  # fmt: skip
