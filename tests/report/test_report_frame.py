"""The tidy table: right numbers in right units, right labels, and no mixing of what does not belong together."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_results as synthetic
from refusals import check_refused
from synthetic_results import list_results

from pfbench.job.replay import find_run
from pfbench.results import conditions, conditions as state_groups, frame, store
from pfbench.results.looks import study_part_names

SMALL = {"runs": 6, "steps": 20}


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    root = tmp_path_factory.mktemp("results")
    synthetic.study(root / "demo", runs=10, steps=30)
    return root


def test_one_row_per_run_and_figure(results):
    table = frame.load_frame("demo", results)
    assert list(table.columns) == [
        "study", "key", "scenario", "family", "noise", "model", "filter", "label", "particles", "seed", "run", "lost",
        "keeps_track", "group", "component", "unit", "metric", "value",
    ]  # fmt: skip
    assert not table.duplicated(["key", "run", "group", "component", "metric"]).any()
    assert (table.groupby(["label", "group", "component", "metric"]).size() == 10).all()
    assert set(table.label) == {method.name for method in synthetic.METHODS}
    assert set(table[table.metric == "ess"].label) == {"sir", "cofm_amssrcpf"}
    assert table[table.metric == "ess"].value.dropna().between(0, 1).all()


def test_numbers_and_units_by_hand(results):
    table = frame.load_frame("demo", results, start_time_s=10.0)
    (raw,) = [r for r in list_results(results / "demo") if r.meta["label"] == "ekf"]
    late = raw.data["time"] >= 10.0
    error = raw.data["error"][3, late].astype(float)
    rows = table[(table.label == "ekf") & (table.run == 3)].set_index(
        ["metric", "group", "component"]
    )
    # One radian is 180 * 60 / pi minutes of arc.
    expected = np.sqrt(np.mean(np.sum(error[:, :3] ** 2, axis=1))) * 180 * 60 / np.pi
    assert rows.loc[("rmse", "attitude", "norm"), "value"] == pytest.approx(expected)
    assert rows.loc[("rmse", "attitude", "norm"), "unit"] == "arcmin"
    assert rows.loc[("rmse", "position", "position_U"), "value"] == pytest.approx(
        np.sqrt(np.mean(error[:, 8] ** 2))
    )
    assert rows.loc[("rmse", "position", "position_U"), "unit"] == "m"
    assert rows.loc[("max_error", "velocity", "norm"), "value"] == pytest.approx(
        np.linalg.norm(error[:, 3:6], axis=1).max()
    )
    assert rows.loc[("nees", "position", "norm"), "value"] == pytest.approx(
        raw.data["nees"][3, late, 2].mean(), rel=1e-5
    )
    assert rows.loc[("seconds_per_step", "", ""), "value"] == pytest.approx(0.4e-3)


def test_a_lost_run_stays_with_an_infinite_error(results):
    table = frame.load_frame("demo", results)
    lost = table[table.lost]
    assert set(zip(lost.label, lost.run, strict=True)) == {("sir", 7)}
    assert np.isinf(lost.value[lost.metric.isin(["rmse", "max_error"])]).all()
    assert lost.value[lost.metric.isin(["nees", "ess", "log_evidence"])].isna().all()
    assert np.isfinite(table.value[~table.lost]).all()


def test_units_shown():
    state = {
        "names": ["b_g", "b_a", "attitude_E", "clock", "clock_rate", "scale"],
        "units": ["rad/s", "m/s^2", "rad", "m", "m/s", ""],
        "groups": {
            "gyro": [0],
            "accelerometer": [1],
            "attitude": [2],
            "clock": [3, 4],
            "scale": [5],
        },
    }
    shown = {
        block.group: (block.unit, block.scale, block.state_group)
        for block in state_groups.component_groups(state)
    }
    assert shown["gyro"] == ("deg/h", pytest.approx(206264.806), "gyro")
    assert shown["accelerometer"] == ("mg", pytest.approx(101.9716), "accelerometer")
    assert shown["attitude"] == ("arcmin", pytest.approx(3437.7468), "attitude")
    # Metres and metres per second have no common norm.
    assert shown["clock [m]"] == ("m", 1.0, "clock")
    assert shown["clock [m/s]"] == ("m/s", 1.0, "clock")
    assert shown["scale"] == ("", 1.0, "scale")


def test_convergence_by_bound(results):
    table = frame.load_frame("demo", results, convergence_threshold={"attitude": 1e6})
    found = table[table.metric == "converged"]
    assert set(found.group) == {"attitude"}
    assert (
        found.value[~found.lost] == 1.0
    ).all()  # under so wide a bound from the first instant on
    assert np.isinf(found.value[found.lost]).all()


def test_labels_tell_configurations_of_one_filter_apart(tmp_path):
    for particles in (400, 100, 1600):
        synthetic.write(tmp_path / "demo", synthetic.Method("sir", 1.0, 1.0, particles), **SMALL)
    synthetic.write(tmp_path / "demo", synthetic.Method("ekf", 1.0), **SMALL)
    (cell,) = conditions.load_conditions("demo", tmp_path)
    assert [job.label for job in cell.jobs] == [
        "ekf", "sir[particles=100]", "sir[particles=400]", "sir[particles=1600]",
    ]  # fmt: skip


def test_labels_name_only_what_differs(tmp_path):
    method = synthetic.Method("sir", 1.0, 1.0, 100)
    for threshold in (0.5, 1.0):
        config = {"resampler": {"threshold": threshold, "kind": "systematic"}}
        synthetic.write(tmp_path / "demo", method, config=config, **SMALL)
    (cell,) = conditions.load_conditions("demo", tmp_path)
    assert [job.label for job in cell.jobs] == [
        "sir[resampler.threshold=0.5]",
        "sir[resampler.threshold=1.0]",
    ]


def test_a_filter_has_the_same_name_in_all_conditions(tmp_path):
    """One noise regime has SIR with two numbers of particles, the other with one of them."""
    for noise, numbers in (("surge", (100, 400)), ("nominal", (100,))):
        for particles in numbers:
            method = synthetic.Method("sir", 1.0, 1.0, particles)
            synthetic.write(tmp_path / "demo", method, noise=noise, **SMALL)
        synthetic.write(tmp_path / "demo", synthetic.Method("ekf", 1.0), noise=noise, **SMALL)
    found = conditions.load_conditions("demo", tmp_path)
    assert {cell.noise: [job.label for job in cell.jobs] for cell in found} == {
        "nominal": ["ekf", "sir[particles=100]"],
        "surge": ["ekf", "sir[particles=100]", "sir[particles=400]"],
    }


def test_noise_regimes_are_cells(tmp_path):
    for noise in ("surge", "nominal"):
        synthetic.write(tmp_path / "demo", synthetic.Method("ekf", 1.0), noise=noise, **SMALL)
    found = conditions.load_conditions("demo", tmp_path)
    assert [(cell.noise, [job.label for job in cell.jobs]) for cell in found] == [
        ("nominal", ["ekf"]),
        ("surge", ["ekf"]),
    ]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"versions": {**synthetic.VERSIONS, "commit": "fff9999"}}, "versions.commit"),
        ({"versions": {**synthetic.VERSIONS, "pfbench": "0.2.0"}}, "versions.pfbench"),
        ({"seed": 6}, "seed"),
        ({"runs": 7}, "runs"),
        ({"steps": 21}, "steps"),
    ],
)
def test_what_does_not_belong_together_is_refused_by_name(tmp_path, change, named):
    synthetic.write(tmp_path / "demo", synthetic.Method("ekf", 1.0), **SMALL)
    odd = synthetic.write(tmp_path / "demo", synthetic.Method("ukf", 1.0), **{**SMALL, **change})
    with pytest.raises(
        ValueError, match=rf"differ in {named} .*allow_mixed_versions=true"
    ) as refusal:
        frame.load_frame("demo", tmp_path)
    assert odd.name in str(refusal.value)
    assert set(frame.load_frame("demo", tmp_path, allow_mixed_versions=True).label) == {
        "ekf",
        "ukf",
    }


def other_world(path: Path, **settings: Any) -> None:
    meta, arrays = store.read_result(path)
    store.write_result(path, {**meta, "config": {**meta["config"], **settings}}, arrays)


@pytest.mark.parametrize(
    ("first", "second", "named"),
    [
        ({"scenario": {"gps_sd": 1.0}}, {"scenario": {"gps_sd": 10.0}}, "config.scenario.gps_sd"),
        ({"noise": {"scale": 2.0}}, {"noise": {"scale": 3.0}}, "config.noise.scale"),
        ({"dtype": "float64"}, {"dtype": "float32"}, "config.dtype"),
    ],
)
def test_filters_of_one_cell_met_the_same_worlds(tmp_path, first, second, named):
    for name, settings in (("ekf", first), ("ukf", second)):
        other_world(
            synthetic.write(tmp_path / "demo", synthetic.Method(name, 1.0), **SMALL), **settings
        )
    check_refused(
        [(rf"differ in {named} ", lambda: conditions.load_conditions("demo", tmp_path))],
        remedy=False,
    )
    assert len(conditions.load_conditions("demo", tmp_path, allow_mixed_versions=True)) == 1


def write_two_worlds(folder):
    for k, sd in enumerate((10.0, 2.0)):
        for name in ("ekf", "ukf"):
            path = synthetic.write(
                folder / "demo", synthetic.Method(name, 1.0, 1.0, 100 + k), **SMALL
            )
            meta, arrays = store.read_result(path)
            settings = {
                "filter": {"name": name},
                "scenario": {"gps_sd": sd, "cache_dir": f"place{k}", "paper": {"unit": "m"}},
                "noise": {"scale": sd / 2},
            }
            store.write_result(path, {**meta, "config": settings}, arrays)


def test_jobs_with_other_data_are_other_conditions(tmp_path):
    write_two_worlds(tmp_path)
    first, second = conditions.load_conditions("demo", tmp_path)
    assert [(c.scenario, c.noise) for c in (first, second)] == [
        ("flight[gps_sd=2.0]", "surge[scale=1.0]"), ("flight[gps_sd=10.0]", "surge[scale=5.0]"),
    ]  # fmt: skip
    for condition in (first, second):
        assert [job.label for job in condition.jobs] == ["ekf", "ukf"]
        assert conditions.differing_settings(condition.jobs) == []
    table = frame.load_frame("demo", tmp_path)
    assert set(table.family) == {"flight"}
    assert set(table.scenario) == {"flight[gps_sd=2.0]", "flight[gps_sd=10.0]"}
    names = study_part_names([first, second], "scenario")
    assert [name.name for name in names.values()] == ["flight [2]", "flight [10]"]
    assert {name.family for name in names.values()} == {"flight"}
    (cell,) = conditions.load_conditions("demo", tmp_path, same_data=False)
    settings = [f"noise.scale={sd / 2},scenario.gps_sd={sd}" for sd in (2.0, 10.0)]
    assert [job.label for job in cell.jobs] == [f"{name}[{text}]" for name in ("ekf", "ukf") for text in settings]  # fmt: skip
    assert conditions.differing_settings(cell.jobs) == ["noise.scale", "scenario.gps_sd"]


def test_a_run_is_found_by_the_settings_of_its_data(tmp_path):
    write_two_worlds(tmp_path)
    found = find_run("demo", tmp_path, 0, "ekf", {"scenario": "flight[gps_sd=2.0]"})
    assert found.result.meta["config"]["scenario"]["gps_sd"] == 2.0
    check_refused(
        [
            (
                r"scenario must be one of the study demo, got flight\[gps_sd=3\]",
                lambda: find_run("demo", tmp_path, 0, "ekf", {"scenario": "flight[gps_sd=3]"}),
            ),
            (
                r"Add scenario=.*flight\[gps_sd=10.0\]",
                lambda: find_run("demo", tmp_path, 0, "ekf", {}),
            ),
        ],
        remedy=False,
    )


def test_shares_are_of_the_particles_in_use(tmp_path):
    """A filter that uses half of its slots and weighs them alike has an effective size of all, not of half."""
    path = synthetic.write(
        tmp_path / "demo", synthetic.Method("cofm_amssrcpf", 1.0, 1.0, 200), **SMALL
    )
    meta, arrays = store.read_result(path)
    number = np.full_like(arrays["ess"], 100.0)
    store.write_result(path, meta, {**arrays, "particles": number, "ess": number})
    table = frame.load_frame("demo", tmp_path)
    assert (table[table.metric == "ess"].value.dropna() == 1.0).all()


def test_a_run_may_converge_before_the_time_from_which_errors_count(results):
    table = frame.load_frame(
        "demo", results, convergence_threshold={"attitude": 1e6}, start_time_s=10.0
    )
    found = table[(table.metric == "converged") & ~table.lost]
    assert (found.value == 1.0).all()


def test_an_empty_study_says_where_to_go(results):
    with pytest.raises(FileNotFoundError) as refusal:
        frame.load_frame("nothing", results)
    message = str(refusal.value)
    assert str(results / "nothing") in message
    assert "demo" in message
    assert "pfbench run study=nothing" in message


def test_data_of_datasheets_are_no_study(tmp_path):
    for study in ("demo", "datasheets"):
        synthetic.write(tmp_path / study, synthetic.Method("ekf", 1.0), **SMALL)
    with pytest.raises(FileNotFoundError, match=r": demo\. Run"):
        frame.load_frame("nothing", tmp_path)


def test_a_study_that_only_failed_says_so(tmp_path):
    store.write_failure(
        tmp_path / "bad" / "00.npz", {"filter": "sir"}, RuntimeError("no particles left")
    )
    with pytest.raises(
        FileNotFoundError, match="1 jobs failed, the first with RuntimeError: no particles left"
    ):
        frame.load_frame("bad", tmp_path)


def test_nothing_left_after_start_time_is_an_error(results):
    check_refused(
        [
            (
                r"report\.start_time_s must be at most .*, got 1000\.0 s",
                lambda: frame.load_frame("demo", results, start_time_s=1000.0),
            )
        ],
        remedy=False,
    )
