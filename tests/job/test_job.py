"""One job: a file that numpy alone reads, computed once, the same numbers however it is cut, and a note where it failed."""

import json
import math
import shutil
import subprocess
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from command_line import Said, pfbench, plant_programs, process, run_git as git
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import InstantiationException
from pfbench.experiments.study_parts import ResumableResults

from pfbench import job
from pfbench.core.record import Episode, Record
from pfbench.files.escapes import (
    WIDTH,
    markdown_bullets,
    markdown_head,
    markdown_paragraph,
    markdown_row,
)
from pfbench.filter.belief import StepInfo
from pfbench.job import trust
from pfbench.job.pcrb import _missing_reason
from pfbench.job.plan import describe_commit
from pfbench.job.scoring import ScoreRecorder
from pfbench.model.linear_gaussian import linear_walk
from pfbench.ppl.parameter_posterior import ParameterPosterior

WALK = ("scenario=linear_walk", "scenario.steps=25", "particles=100")
FIELDS = {"time", "error", "sd", "nees", "log_evidence", "lost", "meta"}


def stored(file: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Meta and arrays, as somebody without pfbench reads them."""
    with np.load(file, allow_pickle=False) as found:
        return json.loads(str(found["meta"])), {
            name: found[name] for name in found.files if name not in ("meta", "digest")
        }


def result(
    home: Path, *words: object, study: str = "adhoc"
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Runs one cell in a fresh study and reads its only file."""
    said = pfbench("run", *words, f"study={study}", home=home)
    assert said.code == 0, said.err
    (file,) = (home / "results" / study).glob("*.npz")
    return stored(file)


def identical(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> bool:
    return a.keys() == b.keys() and all(
        np.array_equal(a[name], b[name], equal_nan=a[name].dtype.kind == "f") for name in a
    )


# a real process, and then another one to find that it is done


@pytest.fixture(scope="module")
def twice(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Said, Said, list[int]]:
    home = tmp_path_factory.mktemp("twice")
    words = ("run", *WALK, "filter=sir", "runs=3", "seed=5")
    first = process(*words, home=home, cwd=home)
    files = list((home / "results" / "adhoc").iterdir())
    stamps = [file.stat().st_mtime_ns for file in files]
    second = pfbench(*words, home=home)
    stamps += [file.stat().st_mtime_ns for file in (home / "results" / "adhoc").iterdir()]
    return home, files[0], first, second, stamps


def test_a_job_leaves_one_file_that_numpy_reads(twice: Any) -> None:
    home, file, first, _, _ = twice
    assert first.code == 0, first.err
    assert [path.suffix for path in (home / "results" / "adhoc").iterdir()] == [".npz"]
    meta, arrays = stored(file)
    assert arrays.keys() | {"meta"} >= FIELDS | {"ess", "resampled"}
    assert arrays["time"].shape == (25,)
    assert arrays["error"].shape == arrays["sd"].shape == (3, 25, 2)
    assert arrays["nees"].shape == (3, 25, 1)
    assert arrays["log_evidence"].shape == arrays["lost"].shape == (3,)
    assert np.isfinite(arrays["error"]).all()
    assert arrays["evidence_floor"].shape == (3,)
    assert np.isfinite(arrays["evidence_floor"]).all()
    assert not arrays["lost"].any()
    assert meta["key"] == file.stem
    assert (meta["runs"], meta["first_run"], meta["seed"], meta["steps"], meta["particles"]) == (
        3,
        0,
        5,
        25,
        100,
    )
    assert meta["choices"] == {
        "scenario": "linear_walk",
        "noise": "nominal",
        "filter": "sir",
        "model": "linear_walk",
    }
    assert meta["config"]["filter"]["particles"] == 100
    assert meta["state"] == {
        "names": ["position", "velocity"],
        "units": ["m", "m/s"],
        "groups": {"state": [0, 1]},
    }
    assert meta["seconds"]["filter"] > 0
    assert {"pfbench", "commit", "build", "python", "torch", "numpy"} == meta["versions"].keys()
    assert meta["is_exact"] is True
    assert meta["has_evidence"] is True


def test_the_line_printed_is_the_error_stored(twice: Any) -> None:
    _, file, first, _, _ = twice
    error = stored(file)[1]["error"].astype(float)
    rmse = np.median(np.sqrt((error[..., 0] ** 2).mean(axis=1)))
    line = f"linear_walk / nominal / sir   state [m]: median RMS error {rmse:.4g} m; track kept in 3 of 3 runs"
    assert line in first.out


def test_a_finished_job_is_not_computed_again(twice: Any) -> None:
    _, file, _, second, stamps = twice
    assert second.code == 0
    assert f"skipped   linear_walk / nominal / sir   result exists: {file}" in second.out
    assert stamps[0] == stamps[1]
    assert len(stamps) == 2


def test_another_process_and_another_day_give_the_same_bits(twice: Any, tmp_path: Path) -> None:
    home, file, _, _, _ = twice
    before = file.stat().st_mtime_ns
    said = pfbench("run", *WALK, "filter=sir", "runs=3", "seed=5", "overwrite=true", home=home)
    assert said.code == 0
    assert "skipped   " not in said.out
    again, kept = stored(file)[1], stored(file)
    assert file.stat().st_mtime_ns > before
    elsewhere = result(tmp_path, *WALK, "filter=sir", "runs=3", "seed=5")
    assert identical(again, elsewhere[1])
    assert kept[0]["key"] == elsewhere[0]["key"]  # where results lie is no part of a job's name


# what a job's name is made of


def test_places_do_not_name_a_job_but_numbers_do(tmp_path: Path) -> None:
    def key(*words: object) -> str:
        study = (
            f"s{len(list((tmp_path / 'results').glob('*')))}"
            if (tmp_path / "results").exists()
            else "s"
        )
        return str(result(tmp_path, *WALK, "filter=ekf", "runs=1", *words, study=study)[0]["key"])

    one = key()
    assert (
        one
        == key("episode_cache_dir=null")
        == key("threads=2", "engine=eager")
        == key("overwrite=true")
        == key("report.alpha=0.01")
    )
    assert (
        len(
            {
                one,
                key("seed=2"),
                key("runs=2"),
                key("dtype=float32"),
                key("model.noise=0.4"),
                key("noise=student"),
            }
        )
        == 6
    )


# the same numbers however the work is cut


@pytest.mark.parametrize("method", ["ekf", "sir"])
def test_runs_in_two_jobs_are_the_runs_of_one(tmp_path: Path, method: str) -> None:
    words = (*WALK, f"filter={method}")
    whole = result(tmp_path, *words, "runs=5", study="whole")[1]
    head = result(tmp_path, *words, "runs=2", study="head")[1]
    tail = result(tmp_path, *words, "first_run=2", "runs=3", study="tail")[1]
    common = ("time", "pcrb", "score_steps")
    joined = {
        name: whole[name] if name in common else np.concatenate([head[name], tail[name]])
        for name in whole
    }
    assert identical(joined, whole)
    assert not np.array_equal(head["error"], tail["error"][:2])


@pytest.mark.parametrize("method", ["ekf", "sir"])
def test_single_precision_is_close_to_double(tmp_path: Path, method: str) -> None:
    words = (*WALK, f"filter={method}", "runs=20", "particles=500")
    double, single = (
        result(tmp_path, *words, f"dtype={dtype}", study=dtype)[1]
        for dtype in ("float64", "float32")
    )
    apart = np.abs(single["error"] - double["error"]) / double["sd"]
    if method == "ekf":
        assert (
            apart.max() < 1e-4
        )  # 25 steps, numbers of size 100 beside errors of size 1: 1e-7 grows to about 1e-5
        assert np.allclose(single["log_evidence"], double["log_evidence"], atol=1e-3)
    else:
        # A rounding may send a slot to the neighbouring ancestor; which slots do so hangs on the processor. From there on the run
        # is another one of the same law, so that it differs as two clouds of 500 do; few of the runs meet it.
        each = np.sqrt((apart**2).mean((1, 2)))
        evidence = np.abs(single["log_evidence"] - double["log_evidence"])
        assert (each < 1e-4).mean() >= 0.75
        assert (evidence < 1e-3).mean() >= 0.75
        assert each.max() < 4 / math.sqrt(500)
    assert single["error"].dtype == np.float32
    assert single["log_evidence"].dtype == np.float64


def test_the_worlds_of_a_study_are_flown_once_for_all_filters(tmp_path: Path) -> None:
    segments = "scenario.trajectory.segments=[{_target_:pfbench.nav.cruise,duration_s:10}]"
    said = pfbench(
        "run",
        "-m",
        "scenario=flight_500s",
        segments,
        "filter=ekf,sir",
        "noise=nominal,student",
        "runs=2",
        home=tmp_path,
    )
    assert said.code == 0, said.err
    assert (
        len(list((tmp_path / "worlds").iterdir())) == 3
    )  # the path, the flights, and the bound in the nominal one
    found = [stored(file) for file in (tmp_path / "results" / "adhoc").glob("*.npz")]
    assert len(found) == 4
    tracks = [arrays["track"] for _, arrays in found]
    assert all(np.array_equal(track, tracks[0]) for track in tracks)
    assert tracks[0].shape == (2, 10, 3)
    # 20 m/s to the North-East, level
    east = 20.0 * math.sqrt(0.5) * np.arange(1, 11)
    assert np.allclose(tracks[0][0, :, 0], east, rtol=1e-3)
    assert np.allclose(tracks[0][0, :, 1], east, rtol=1e-3)


# the bound beside the errors


@pytest.mark.parametrize(
    "words", [(), ("noise=outage", "noise.windows_s=[[5,9]]"), ("noise=variance_r",)]
)
def test_the_bound_of_a_linear_world_is_kalmans_deviation(
    tmp_path: Path, words: tuple[str, ...]
) -> None:
    """Of the filter that is told the regime, whether or not the one that ran was."""
    told = result(
        tmp_path, *WALK, *words, "filter=ekf", "runs=3", "oracle_noise=true", study="told"
    )
    plain = result(tmp_path, *WALK, *words, "filter=ekf", "runs=3", study="plain")
    assert told[1]["pcrb"].shape == (25, 2)
    assert np.allclose(told[1]["pcrb"], told[1]["sd"], rtol=1e-5)
    assert np.array_equal(told[1]["pcrb"], plain[1]["pcrb"])
    assert "posterior Cramer-Rao bound of the model" in plain[0]["pcrb"]


WHY = {
    "heavy tails": (("noise=student",), "measurement distribution must be normal"),
    "not asked for": (("pcrb=false",), "not requested"),
    "no additive noise": (("scenario=benes", "noise=outliers"), "needs Benes.noise_gain(u)"),
}


@pytest.mark.parametrize("case", WHY)
def test_where_there_is_no_bound_the_job_says_why(tmp_path: Path, case: str) -> None:
    words, reason = WHY[case]
    meta, arrays = result(tmp_path, *WALK[:1], "scenario.steps=4", *words, "filter=ekf", "runs=2")
    assert "pcrb" not in arrays
    assert meta["pcrb"].startswith("no bound: ")
    assert reason in meta["pcrb"]


def test_a_bound_that_is_requested_later_is_added(tmp_path: Path) -> None:
    """The job runs again once, under the same key, and never because a bound is not wanted."""
    words = (*WALK[:1], "scenario.steps=4", "filter=ekf", "runs=2")
    before, arrays = result(tmp_path, *words, "pcrb=false")
    assert "pcrb" not in arrays
    after, joined = result(tmp_path, *words)
    assert after["key"] == before["key"]
    assert "posterior Cramer-Rao bound" in after["pcrb"]
    assert np.isfinite(joined.pop("pcrb")).all()
    assert identical(joined, arrays)
    for word in ("pcrb=auto", "pcrb=false", "pcrb=true"):
        assert result(tmp_path, *words, word)[0] == after  # the same file: skipped


def test_a_bound_that_does_not_exist_is_tried_once(tmp_path: Path) -> None:
    words = ("scenario=benes", "scenario.steps=4", "filter=ekf", "runs=2")
    result(tmp_path, *words, "pcrb=false")
    (file,) = (tmp_path / "results" / "adhoc").glob("*.npz")
    stamps = []
    for _ in range(2):
        assert "no bound" in result(tmp_path, *words)[0]["pcrb"]
        stamps.append(file.stat().st_mtime_ns)
    assert stamps[0] == stamps[1]


def test_run_numbers_that_would_repeat_random_numbers_are_refused(tmp_path: Path) -> None:
    words = (*WALK[:1], "scenario.steps=4", "filter=ekf", "runs=2")
    last = result(tmp_path, *words, f"first_run={2**32 - 2}", study="last")
    assert not np.array_equal(last[1]["error"], result(tmp_path, *words, study="first")[1]["error"])
    said = pfbench("run", *words, f"first_run={2**32 - 1}", home=tmp_path)
    assert said.code != 0
    assert "first_run + runs must be at most 2**32" in said.err + said.out


def test_worlds_that_are_not_the_models_have_no_bound_unless_asked() -> None:
    episode = Episode(Record(torch.zeros(1, 2, 1)), torch.arange(2.0), {})
    config = {
        "pcrb": "auto",
        "scenario": {},
        "model": {"inflation": None, "process_noise_factor": 1.0},
    }
    assert _missing_reason(config, episode) == ""
    assert "recorded" in _missing_reason({**config, "scenario": {"root": "somewhere"}}, episode)
    assert "(model.inflation)" in _missing_reason(
        {**config, "model": {"inflation": {"velocity": [1.0]}}}, episode
    )
    assert "(model.process_noise_factor)" in _missing_reason(
        {**config, "model": {"process_noise_factor": 30.0}}, episode
    )
    looped = Episode(episode.record._replace(feedback=cast(Any, object())), episode.time, {})
    assert "closed loop" in _missing_reason(config, looped)
    assert (
        _missing_reason({**config, "pcrb": True, "scenario": {"root": "somewhere"}}, episode) == ""
    )


def test_a_location_brings_its_range_and_a_bound_from_the_models_own_prior(tmp_path: Path) -> None:
    meta, arrays = result(
        tmp_path, "scenario=passive_1", "scenario.steps=3", "filter=ekf", "runs=4"
    )
    # 226.3 km at first, closing by 200 m/s on the east axis while the emitter goes north-west
    t = np.arange(1, 4)
    assert np.allclose(arrays["range"], np.hypot(160e3 - 215.0 * t, 160e3 + 15.0 * t), rtol=1e-6)
    assert arrays["pcrb"].shape == (3, 4)
    assert "the model's own initial distribution" in meta["pcrb"]
    # the prior, 60 km per axis and 30 m/s, is more than the first look leaves of it
    assert (arrays["pcrb"][0, :2] < 60e3).all()
    assert np.allclose(arrays["pcrb"][0, 2:], 30.0, rtol=0.3)


def test_the_bound_is_kept_with_the_worlds_and_known_by_what_decides_it(tmp_path: Path) -> None:
    def kept() -> int:
        return len(list((tmp_path / "worlds").glob("*")))

    words = (*WALK, "runs=2", "overwrite=true")
    result(tmp_path, *words, "filter=ekf", study="a")
    assert kept() == 1
    result(tmp_path, *words, "filter=sir", "oracle_noise=true", study="b")
    assert kept() == 1
    for n, more in enumerate(
        ("seed=2", "runs=3", "model.noise=0.4", "scenario.steps=24", "noise=variance_r")
    ):
        result(tmp_path, *words, "filter=ekf", more, study=f"c{n}")
        assert kept() == n + 2


# from Python


def test_jobs_run_from_python_without_hydras_global_state(tmp_path: Path) -> None:
    """Any number in one process, equal to those of the command line; Hydra's state is untouched."""
    words = [*WALK, "runs=2", f"results_dir={tmp_path / 'here'}", "episode_cache_dir=null"]
    GlobalHydra.instance().clear()
    outcomes = [job.run(job.compose([*words, f"filter={name}"])) for name in ("ekf", "sir")]
    assert not GlobalHydra.instance().is_initialized()
    assert [outcome.status for outcome in outcomes] == ["finished", "finished"]
    for name, outcome in zip(("ekf", "sir"), outcomes, strict=True):
        meta, arrays = result(tmp_path, *WALK, "runs=2", f"filter={name}", study=name)
        assert identical(stored(outcome.path)[1], arrays)
        assert stored(outcome.path)[0]["choices"] == meta["choices"]
    config = job.compose([*words, "filter=sir"])
    again = job.run(config.values, config.choices)
    assert again == outcomes[1]._replace(status="skipped")
    with pytest.raises(
        ValueError, match=r"choices must name scenario, noise, filter, model, got \[\]"
    ):
        job.run(config.values)


def test_jobs_run_within_a_hydra_application(tmp_path: Path) -> None:
    words = [*WALK, "runs=2", "filter=ekf", f"results_dir={tmp_path}", "episode_cache_dir=null"]
    job.register_experiments()
    with initialize_config_dir(str(job.conf_dir()), version_base="1.3"):
        application = GlobalHydra.instance().hydra
        outcome = job.run(job.compose(words))
        assert GlobalHydra.instance().hydra is application
        cfg = compose("config", words)
    choices = {
        "scenario": "linear_walk",
        "noise": "nominal",
        "filter": "ekf",
        "model": "linear_walk",
    }
    assert job.run(cfg, choices) == outcome._replace(status="skipped")


# failures


def test_a_failed_job_leaves_a_note_and_its_success_takes_it_away(tmp_path: Path) -> None:
    words = ("run", *WALK, "filter=ekf", "runs=2")
    folder = tmp_path / "results" / "adhoc"
    failed = pfbench(*words, "memory_limit_gib=1e-6", home=tmp_path)
    assert failed.code == 1
    (note,) = folder.iterdir()
    assert note.name.endswith(".failed.json")
    said = json.loads(note.read_text())
    message = "memory must be at least 0.25 GiB for a single run, got 1e-06 GiB."
    assert said["message"].startswith(f"ValueError: {message}")
    assert said["choices"]["filter"] == "ekf"
    assert "Traceback" in said["traceback"]
    assert (failed.out + failed.err).count(message) == 1
    assert f"\ntraceback: {note}\n" in failed.err
    done = pfbench(*words, home=tmp_path)  # the limit is no part of the name
    assert done.code == 0
    (file,) = folder.iterdir()
    assert file.name == note.name.replace(".failed.json", ".npz")


REFUSED = {
    "dtype=double": "dtype must be float64 (default) or float32, got 'double'. Set dtype=float64.",
    "runs=ten": "runs must be a whole number of at least 1, got 'ten'. Set runs=100.",
    "runs=0": "runs must be a whole number of at least 1, got 0. Set runs=100.",
    "runs=1e9": "runs must be a whole number of at least 1, got 1000000000.0. Write it without exponent and "
    "without a decimal point: runs=1000000000.",
    "seed=99999999999": "seed must be from 0 to 2**32 - 1, got 99999999999. Set seed=1.",
    "seed=-1": "seed must be a whole number of at least 0, got -1. Set seed=1.",
    "filter.particles=0": "filter.particles must be a whole number of at least 2, got 0. Use 2 or more, without a point or exponent.",
    "particles=0": "particles must be a whole number of at least 2, got 0. Set particles=500.",
    "particles=many": "particles must be a whole number of at least 2, got 'many'. Set particles=500.",
    "scenario.steps=0": "scenario.steps must be a whole number of at least 1, got 0. Change",
}


@pytest.mark.parametrize("word", REFUSED)
def test_a_value_that_is_not_valid_is_refused_once_and_leaves_nothing(
    word: str, tmp_path: Path
) -> None:
    said = pfbench("run", *WALK, "filter=sir", "runs=2", word, home=tmp_path)
    assert said.code == 2
    assert f"\nerror run: {REFUSED[word]}" in said.err
    assert (said.out + said.err).count(REFUSED[word]) == 1
    assert "Error executing job" not in said.err
    assert list((tmp_path / "results").rglob("*.json")) == []
    with pytest.raises((ValueError, InstantiationException)) as caught:
        job.run(job.compose([*WALK, "filter=sir", "runs=2", word, f"results_dir={tmp_path}"]))
    assert REFUSED[word] in str(caught.value)
    assert list(tmp_path.rglob("*.json")) == []


def test_a_folder_of_data_that_is_missing_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    words = ("run", "scenario=recorded_quad_flights", "filter=ekf", "runs=1", "data.root=/nowhere")
    said = pfbench(*words, home=tmp_path)
    assert "data.root must contain the folder quad_rtk_mimu, got /nowhere" in said.err
    assert "traceback:" not in said.err
    assert list(tmp_path.rglob("*.json")) == []


def test_a_failure_does_not_touch_a_good_result(tmp_path: Path) -> None:
    words = ("run", *WALK, "filter=ekf", "runs=2")
    assert pfbench(*words, home=tmp_path).code == 0
    (file,) = (tmp_path / "results" / "adhoc").iterdir()
    before = file.read_bytes()
    assert pfbench(*words, "overwrite=true", "threads=0", home=tmp_path).code == 2
    failed = pfbench(*words, "overwrite=true", "memory_limit_gib=1e-6", home=tmp_path)
    assert failed.code == 1
    assert f"previous result kept: {file}" in failed.err
    assert list((tmp_path / "results" / "adhoc").iterdir()) == [file]
    assert file.read_bytes() == before


def test_a_sweep_goes_on_after_a_bad_cell_and_says_so(tmp_path: Path) -> None:
    said = pfbench(
        "run", "-m", *WALK, "filter=sir", "runs=2", "scenario.steps=0,50,-1,60", home=tmp_path
    )
    assert said.code == 1
    for number, steps in ((1, 0), (3, -1)):  # on the line of the job, and at the end
        message = f"scenario.steps must be a whole number of at least 1, got {steps}. Change scenario.steps."
        assert f"[{number}/4] failed    linear_walk / nominal / sir   {message}   trace" in said.out
        assert (said.out + said.err).count(message) == 2  # and with the words that repeat it
    assert "Error executing job" not in said.err
    assert "error run: all jobs of the sweep must finish, got failed jobs." in said.err
    assert "sweep: 2 finished, 0 skipped, 2 failed" in said.out
    folder = tmp_path / "results" / "adhoc"
    assert sorted(stored(file)[0]["steps"] for file in folder.glob("*.npz")) == [50, 60]
    notes = list(folder.glob("*.failed.json"))
    messages = [json.loads(note.read_text())["message"] for note in notes]
    assert len(notes) == 2
    assert all(
        any(
            f"scenario.steps must be a whole number of at least 1, got {n}" in message
            for message in messages
        )
        for n in (0, -1)
    )
    assert all(str(note) in said.out for note in notes)  # every one is named, not only the first


def test_a_damaged_file_is_told_and_not_taken_for_a_result(tmp_path: Path) -> None:
    words = ("run", *WALK, "filter=ekf", "runs=2")
    assert pfbench(*words, home=tmp_path).code == 0
    (file,) = (tmp_path / "results" / "adhoc").iterdir()
    file.write_bytes(file.read_bytes()[:500])
    said = pfbench(*words, home=tmp_path)
    assert said.code == 0
    assert f"{file} is damaged" in said.out
    assert "finished" in said.out
    assert stored(file)[0]["runs"] == 2
    assert file.with_name(f"{file.name}.damaged").exists()
    assert "skipped" in pfbench(*words, home=tmp_path).out


def test_a_collapsed_cloud_is_infinitely_wrong_and_no_truth_is_unknown() -> None:
    model = linear_walk(step=1.0, noise=1.0, measurement_sd=1.0)
    nan, eye = torch.nan, torch.eye(2, dtype=torch.float64)
    truth = torch.tensor([[0.0, 0.0], [0.0, 0.0], [nan, 0.0]], dtype=torch.float64).unsqueeze(1)
    covariance = torch.stack([4.0 * eye, 0.0 * eye, eye])
    info = StepInfo(
        torch.ones(3, 2, dtype=torch.float64),
        covariance.diagonal(dim1=-2, dim2=-1),
        lambda: covariance,
        {},
    )
    nees = ScoreRecorder(model, truth)(0, info)["nees"][:, 0].tolist()
    assert nees[:2] == [0.5, math.inf]
    assert math.isnan(nees[2])


def never() -> None:
    raise AssertionError("made twice")


def test_what_is_done_is_not_done_again(tmp_path: Path) -> None:
    path = tmp_path / "new" / "told.json"
    first = ResumableResults(path, {"draws": 3, "wide": (1.0, 2.0)})
    assert first("a", lambda: [0.1, 1e-300]) == [0.1, 1e-300]
    with pytest.raises(KeyboardInterrupt):
        first("b", lambda: (_ for _ in ()).throw(KeyboardInterrupt))
    again = ResumableResults(path, {"draws": 3, "wide": (1.0, 2.0)})
    assert again("a", never) == [0.1, 1e-300]
    assert again("b", lambda: 2) == 2
    assert [file.name for file in path.parent.iterdir()] == ["told.json"]


def test_another_call_and_half_a_file_begin_anew(tmp_path: Path) -> None:
    path = tmp_path / "told.json"
    ResumableResults(path, {"draws": 3})("a", lambda: 1)
    assert ResumableResults(path, {"draws": 4})("a", lambda: 2) == 2
    path.write_text(path.read_text()[:-3])
    assert ResumableResults(path, {"draws": 4})("a", lambda: 3) == 3


def test_a_posterior_is_heard_as_it_was_told(tmp_path: Path) -> None:
    draws = {
        "a": torch.randn(2, 5, dtype=torch.float64),
        "b": torch.rand(2, 5, dtype=torch.float64) / 3.0,
    }
    for accepted in (torch.tensor([0.1, 1 / 3], dtype=torch.float64), None):
        posterior = ParameterPosterior(draws, accepted, "made")
        pieces = ResumableResults(tmp_path / "told.json", {"accepted": accepted is not None})
        pieces("posterior", posterior.to_dict)
        heard = ParameterPosterior.from_dict(
            ResumableResults(pieces.path, pieces.state["request"])("posterior", never)
        )
        for name, a in draws.items():
            assert torch.equal(heard.draws[name], a)
        assert heard.method == "made"
        assert (heard.accepted is None) == (accepted is None)
        assert accepted is None or torch.equal(heard.accepted, accepted)


def test_prose_fits_an_editor_and_tables_have_a_head() -> None:
    text = "a word-with-hyphens " * 40
    lines = [*markdown_paragraph(text), *markdown_bullets(text, "short")]
    assert max(map(len, lines)) <= WIDTH
    assert " ".join(markdown_paragraph(text)).split() == text.split()
    assert lines[-2:] == ["- short", ""]
    assert [*markdown_head("a", "b"), markdown_row(1, math.pi)] == [
        "| a | b |",
        "| --- | --- |",
        f"| 1 | {math.pi} |",
    ]


needs_git = pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")


@needs_git
def test_only_files_that_decide_results_mark_a_commit(tmp_path: Path) -> None:
    decide = ("pfbench/a.py", "conf/b.yaml", "experiments/e.yaml", "setup.py")
    others = ("reports/x/report.md", "docs/c.md", "experiments/analyses/d.json")
    assert describe_commit(tmp_path) == ""
    for name in decide + others:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("old")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "first")
    commit = git(tmp_path, "rev-parse", "--short", "HEAD")
    (tmp_path / "pfbench" / "a.py").touch()
    for name in others:
        (tmp_path / name).write_text("new")
    assert describe_commit(tmp_path) == commit
    for name in decide:
        (tmp_path / name).write_text("new")
        assert describe_commit(tmp_path) == f"{commit}-dirty", name
        git(tmp_path, "add", name)
        assert describe_commit(tmp_path) == f"{commit}-dirty", name
        git(tmp_path, "reset", "-q", "--hard")


@needs_git
def test_the_repository_of_another_project_is_not_that_of_pfbench(tmp_path: Path) -> None:
    """As of an environment in the folder of a user's project."""
    inside = tmp_path / "env" / "site-packages"
    inside.mkdir(parents=True)
    (tmp_path / "a.txt").write_text("theirs")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "first")
    assert describe_commit(tmp_path) != ""
    assert describe_commit(inside) == ""
    ran = plant_programs(tmp_path)
    subprocess.run(["git", "-C", str(tmp_path), "diff", "HEAD"], capture_output=True)
    assert ran.exists()  # the programs do run
    ran.unlink()
    assert describe_commit(tmp_path) == git(tmp_path, "rev-parse", "--short", "HEAD")
    assert describe_commit(inside) == ""
    assert not ran.exists()


@pytest.mark.parametrize(
    ("name", "text", "is_same"),
    [
        ("a.py", "x = 1\n", True),  # written again
        ("__pycache__/a.pyc", "other", True),
        ("kernels/operators_avx2.so", "other", True),
        ("a.py", "x = 2\n", False),
        ("kernels/b.cpp", "int x;", False),
        ("conf/noise/n.yaml", "sd: 2", True),
        ("experiments/e.yaml", "runs: 2", True),
    ],
)
@needs_git
def test_two_wheels_of_other_sources_are_other_builds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, text: str, is_same: bool
) -> None:
    """Without git, whatever the times and the compiled files are."""
    files = {"a.py": "x = 1\n", "conf/noise/n.yaml": "sd: 1", "experiments/e.yaml": "runs: 1"}

    def build(folder: Path, files: dict[str, str]) -> str:
        for file, content in files.items():
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / file).write_text(content)
        monkeypatch.setattr(trust, "PACKAGE", folder)
        monkeypatch.setattr(trust, "conf_dir", lambda: folder / "conf")
        monkeypatch.setattr(trust, "experiments_dir", lambda: folder / "experiments")
        return trust.hash_package.__wrapped__()

    first = build(tmp_path / "one", files)
    assert (build(tmp_path / "two", {**files, name: text}) == first) == is_same
