"""One run computed again equals the run of the batch, a changed number is found, and mistakes have advice."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from command_line import Said, pfbench
from synthetic_results import list_results

from pfbench import job
from pfbench.job.replay import (
    StoredRun,
    compare_runs,
    describe_agreement,
    find_run,
    magnification,
    recompute_run,
    replay_config,
)
from pfbench.job.trust import UntrustedConfigError
from pfbench.results import store

WALK = ("scenario=linear_walk", "scenario.steps=8", "runs=4", "first_run=10", "score_steps=2")
STUDY = ("study=walks", "particles=30")


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study of two filters in two noise regimes, one of them with two numbers of particles."""
    folder = tmp_path_factory.mktemp("replay")
    jobs = [("ekf", "nominal"), ("ekf", "outliers"), ("sir", "nominal"), ("sir", "outliers")]
    for name, noise in jobs:
        run_job(folder, f"filter={name}", f"noise={noise}")
    run_job(folder, "filter=sir", "noise=outliers", "filter.particles=40")
    return folder


def run_job(folder: Path, *words: str) -> None:
    job.run(job.compose([*WALK, *STUDY, f"results_dir={folder}/results", *words]))


def replay(folder: Path, *words: str) -> Said:
    return pfbench("replay", "study=walks", f"reports_dir={folder}/reports", *words, home=folder)


@pytest.mark.parametrize(("name", "label"), [("ekf", "ekf"), ("sir", "sir[particles=30]")])
def test_a_run_alone_equals_the_run_of_the_batch(home: Path, name: str, label: str) -> None:
    """Its label is that of the report of the study."""
    said = replay(home, "run=12", f"filter={name}", "scenario=linear_walk", "noise=nominal")
    assert said.code == 0, said.err
    assert f"run 12 of linear_walk / nominal / linear_walk / {label}, seed" in said.out
    assert "equal in every digit" in said.out or "agree to" in said.out
    file = next((home / "reports/walks/replay").glob(f"*nominal*_{name}_*run_12/traces.csv"))
    table = pd.read_csv(file)
    (result,) = [
        r
        for r in list_results(home / "results/walks")
        if (r.meta["label"], r.meta["choices"]["noise"]) == (name, "nominal")
    ]
    component, unit = result.meta["state"]["names"][0], result.meta["state"]["units"][0]
    errors = table[f"error {component} [{unit}]"].to_numpy()
    np.testing.assert_allclose(errors, result.data["error"][2, :, 0], rtol=1e-5, atol=1e-6)
    assert table["nis"].notna().all()  # scored at all steps, the job at two of them
    assert ("ess" in table) == (name == "sir")
    assert file.with_name("traces.svg").read_text().startswith("<?xml")


def test_a_forged_number_of_steps_is_refused_at_once(home: Path, tmp_path: Path) -> None:
    result = next(iter(list_results(home / "results/walks")))
    config = result.meta["config"]
    forged = {**config, "scenario": {**config["scenario"], "steps": 10**7}}
    file = tmp_path / "results" / "walks" / f"{result.meta['key']}.npz"
    store.write_result(file, {**result.meta, "config": forged}, result.data)
    said = replay(tmp_path, "run=11", f"filter={result.meta['label']}")
    assert said.code != 0
    assert "must have its 8 steps, got 10000000. The file is damaged" in said.err


def test_a_changed_number_is_found_with_its_time(home: Path, tmp_path: Path) -> None:
    results = list(list_results(home / "results/walks"))
    (result,) = [
        r for r in results if (r.meta["label"], r.meta["choices"]["noise"]) == ("ekf", "nominal")
    ]
    error = result.data["error"].copy()
    error[1, 5] += 0.01
    folder = tmp_path / "results" / "walks"
    store.write_result(
        folder / f"{result.meta['key']}.npz", result.meta, {**result.data, "error": error}
    )
    said = replay(tmp_path, "run=11", "filter=ekf")
    assert said.code == 0, said.err
    assert "do not agree: error differ in the first 4 digits, from 6 s on" in said.out
    said = replay(tmp_path, "run=13", "filter=ekf")
    assert "do not agree" not in said.out


@pytest.mark.parametrize(
    ("words", "advice"),
    [
        (("study=wlaks", "run=12", "filter=ekf"), "got wlaks. Similar: walks."),
        (("study=walks", "run=14", "filter=ekf", "noise=nominal"), "10 to 13, got 14"),
        (
            ("study=walks", "run=x", "filter=ekf"),
            "run must be a whole number of at least 0, got 'x'",
        ),
        (("study=walks", "run=12", "filter=ukf"), "Choose from ekf, sir[particles=30], sir["),
        (
            ("study=walks", "run=12", "filter=ekf"),
            "noise must be set, since ekf has results in 2 conditions. Add noise",
        ),
        (("study=walks", "run=12", "filter=ekf", "noise=glint"), "Choose from nominal, outliers"),
        (("study=walks", "run=12", "filter=sir", "noise=outliers"), "got sir with 2 settings"),
        (("study=walks", "run=12", "filtre=sir"), "got filtre. Similar: filter."),
        (("study=walks", "filter=sir"), "run must be set"),
    ],
)
def test_advice_of_replay(home: Path, words: tuple[str, ...], advice: str) -> None:
    said = pfbench("replay", *words, home=home)
    assert said.code == 2
    assert advice in said.err


def make_result(error: np.ndarray) -> store.JobResult:
    return store.JobResult({}, {"time": np.arange(1.0, 6.0), "error": error, "lost": np.zeros(1)})


def test_digits_are_those_of_the_relative_difference() -> None:
    error = np.linspace(1.0, 5.0, 5)[None, :, None] * np.ones(2)
    same = compare_runs(make_result(error), make_result(error))
    assert describe_agreement(same) == "All 2 stored arrays are equal in every digit."
    close = error.copy()
    close[0, 3, 1] += 5.0 * 3e-6  # relative to the largest value 5 of the component
    worst = compare_runs(make_result(error), make_result(close))[0]
    assert (worst.name, worst.digits, worst.agrees) == ("error", 5.0, True)
    gone = error.copy()
    gone[0, 2:] = np.nan
    worst = compare_runs(make_result(error), make_result(gone))[0]
    assert (worst.digits, worst.time_s, worst.agrees) == (0.0, 3.0, False)
    both = compare_runs(make_result(gone), make_result(gone))[0]
    assert np.isinf(both.digits)


def test_magnification_is_a_power_of_ten_that_keeps_errors_below_the_track() -> None:
    track = np.array([[0.0, 0.0], [3600.0, 100.0]])
    assert magnification(track, np.full((2, 2), 2.0)) == 10
    assert magnification(track, np.full((2, 2), 50.0)) == 1
    assert magnification(track, np.full((2, 2), np.nan)) == 1


def test_results_of_other_programs_are_refused(home: Path, tmp_path: Path) -> None:
    result = next(iter(list_results(home / "results/walks")))
    meta = {**result.meta, "config": json.loads("{}")}
    store.write_result(tmp_path / "results/walks" / f"{meta['key']}.npz", meta, result.data)
    label = meta["label"]
    said = replay(tmp_path, "run=12", f"filter={label}")
    assert said.code == 2
    assert "study must have results of pfbench run" in said.err


def test_a_replay_writes_nowhere_else_whatever_a_result_says(home: Path) -> None:
    """Folders and study come from the command line, not from the file of another person."""
    choices = {"scenario": "linear_walk", "noise": "nominal"}
    stored = find_run("walks", home / "results", 12, "ekf", choices)
    meta = stored.result.meta
    folders = dict.fromkeys(("results_dir", "reports_dir", "episode_cache_dir"), "outside")
    changes = {"data": meta["config"]["data"], **dict.fromkeys(folders, "mine")}
    caches = {"cache_dir": "outside", "nested": [{"cache_dir": "outside"}]}

    def disguise(**more: object) -> StoredRun:
        config = {**meta["config"], **folders, "scenario": {**meta["config"]["scenario"], **more}}
        full = {**meta, "study": "../../outside", "config": config}
        return stored._replace(result=store.JobResult(full, stored.result.data))

    values = replay_config(disguise(**caches), changes).values
    assert "outside" not in json.dumps(values)
    assert values["scenario"]["cache_dir"] == values["scenario"]["nested"][0]["cache_dir"] == "mine"
    assert recompute_run(disguise(), changes).meta["study"] == "walks"
    forged = {"deep": [{"root": "/private"}], "checkpoint": "/private/weights.pt"}
    with pytest.raises(
        UntrustedConfigError, match=r"add checkpoint=/private/weights\.pt to the command"
    ):
        replay_config(disguise(**forged), changes)
    values = replay_config(disguise(**forged), {**changes, "checkpoint": "mine.pt"}).values
    assert "private" not in json.dumps(values)
    own = str(stored.job.path.parent / "checkpoints" / "weights.pt")
    values = replay_config(disguise(checkpoint=own), changes).values
    assert values["scenario"]["checkpoint"] == own


OWN = """
from pfbench.filter import GaussianFilter

class Mine(GaussianFilter):
    pass
"""


def test_a_filter_of_the_user_is_replayed_and_timed_with_the_trust_of_its_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The packages of a run must be trusted again: a result may be of another person."""
    (tmp_path / "replaylab").mkdir()
    (tmp_path / "replaylab" / "filters.py").write_text(OWN)
    monkeypatch.syspath_prepend(str(tmp_path))
    words = ("filter=ekf", "filter._target_=replaylab.filters.Mine", "trust=[replaylab]")
    assert pfbench("run", *WALK, "study=walks", *words, home=tmp_path).code == 0
    (result,) = list_results(tmp_path / "results/walks")
    assert result.meta["trusted"] == ["replaylab"]
    again = ("run=12", "filter=ekf")
    said = replay(tmp_path, *again)
    assert said.code == 2
    assert "trust must name the packages whose classes the run used, replaylab, got none of them" in said.err  # fmt: skip
    remedy = said.err.partition("add ")[2].split()[0]
    assert remedy == "trust=[replaylab]"
    said = replay(
        tmp_path, *again, remedy, "hydra.searchpath=[file://conf]"
    )  # the words of the run
    assert said.code == 0, said.err
    assert "equal in every digit" in said.out
    assert "has changed" not in said.out
    (tmp_path / "replaylab" / "filters.py").write_text(f"{OWN}\n# another\n")
    changed = "the code of replaylab.filters has changed since ekf was run: its numbers may differ"
    assert changed in replay(tmp_path, *again, remedy).out
    cost = ("cost", "study=walks", "rounds=5", "seconds=0.001")
    assert f"add {remedy} to the command" in pfbench(*cost, home=tmp_path).err
    said = pfbench(*cost, remedy, home=tmp_path)
    assert said.code == 0, said.err
    assert changed in said.out


def test_a_filter_of_pfbench_needs_no_trust(home: Path) -> None:
    assert all(r.meta["trusted"] == [] for r in list_results(home / "results/walks"))
