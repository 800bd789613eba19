"""Advice for mistakes that are easy to make on the command line."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from command_line import pfbench

from pfbench import job
from pfbench.cli import messages
from pfbench.job.config import compose
from pfbench.job.trust import split_trust
from pfbench.results import store

WALK = ("scenario=linear_walk", "scenario.steps=5", "runs=2", "particles=20")


@pytest.mark.parametrize(
    ("words", "advice"),
    [
        (("experiment=quickstart",), "Use +experiment=quickstart"),
        (("filter=SIR",), "filter=SIR does not exist. Names are in lower case: filter=sir"),
        (("filter=sir,ekf",), "filter=sir,ekf must be one value, got several. Add -m"),
        (("-m", "scenario=linear_walk,flight_300s", "scenario.step=5"), "Similar: scenario.steps"),
        (
            ("noise=null",),
            "noise=null must name a file of the group. Choose one: pfbench list noise",
        ),
        (
            ("filter=/etc/hostname",),
            "filter=/etc/hostname must be a name, got a path. Add its folder",
        ),
        (("+experiment=../mine",), "+experiment=../mine must be a name, got a path"),
        (("hydra.searchpath=[http://a.invalid/x]",), "hydra.searchpath must have folders (file://"),
        (("hydra.searchpath=[file:///no/folder]",), "must have existing folders, got /no/folder"),
    ],
)
def test_advice(tmp_path: Path, words: tuple[str, ...], advice: str) -> None:
    said = pfbench("run", "scenario=linear_walk", *words, home=tmp_path)
    assert said.code == 2
    assert advice in said.err
    assert not list(tmp_path.rglob("*.npz"))


FORMS = {
    "text": (b"hello world\n", "must be keys and values, got a scalar"),
    "list": (b"- a\n- b\n", "must be keys and values, got a sequence"),
    "number": (b"42\n", "must be keys and values, got a scalar"),
    "empty": (b"", "must be keys and values, got an empty file"),
    "bytes": (b"a: \x80\n", "must be text in UTF-8, got the byte 0x80"),
}


@pytest.mark.parametrize(
    ("group", "form"), [("filter", "number"), *(("scenario", form) for form in FORMS)]
)
def test_a_file_of_another_form_is_named(tmp_path: Path, group: str, form: str) -> None:
    content, message = FORMS[form]
    (tmp_path / "mine" / group).mkdir(parents=True)
    file = tmp_path / "mine" / group / "other.yaml"
    file.write_bytes(content)
    words = (f"hydra.searchpath=[file://{tmp_path / 'mine'}]", f"{group}=other")
    said = pfbench("run", *WALK, *words, home=tmp_path)
    assert said.code == 2
    assert f"{file} {message}" in said.err


def test_a_file_of_another_form_that_is_not_chosen_is_no_error(tmp_path: Path) -> None:
    (tmp_path / "mine" / "filter").mkdir(parents=True)
    (tmp_path / "mine" / "filter" / "draft.yaml").write_text("")
    path = f"hydra.searchpath=[file://{tmp_path / 'mine'}]"
    said = pfbench("run", *WALK, path, "filter=ekf", home=tmp_path)
    assert said.code == 0, said.err


@pytest.mark.parametrize(
    ("word", "advice"),
    [
        ("reports_dir=FILE", "FILE/judge must be accessible, got 'Not a directory'. Set a folder"),
        ("reference=FOLDER", "FOLDER must be a file, got none. Check the path"),
    ],
)
def test_a_file_in_place_of_a_folder_is_named(tmp_path: Path, word: str, advice: str) -> None:
    file = tmp_path / "a.csv"
    file.write_text("t,pn,pe,pd\n" + "".join(f"{0.1 * i},{i},0,0\n" for i in range(50)))
    words = {"reference": f"reference={file}", "a": f"a={file}", "b": f"b={file}"}
    word = word.replace("FILE", f"{file}").replace("FOLDER", f"{tmp_path}")
    words[word.partition("=")[0]] = word
    said = pfbench("judge", *words.values(), home=tmp_path)
    assert said.code == (1 if word.startswith("reports_dir") else 2)
    assert advice.replace("FILE", f"{file}").replace("FOLDER", f"{tmp_path}") in said.err


def test_a_key_of_swept_scenarios_is_set_in_all_jobs(tmp_path: Path) -> None:
    words = ("scenario=linear_walk,local_level", "scenario.steps=3", "filter=ekf", "runs=2")
    said = pfbench("run", "-m", *words, home=tmp_path)
    assert said.code == 0, said.err
    files = list((tmp_path / "results" / "adhoc").glob("*.npz"))
    assert [store.read_metadata(file)["steps"] for file in files] == [3, 3]


def test_a_sweep_that_did_not_start_skips_no_job(tmp_path: Path) -> None:
    said = pfbench("run", "-m", *WALK, "filter=ekf,ckff", home=tmp_path)
    assert said.code == 2
    assert "skipped" not in said.out + said.err


def test_a_misspelt_study_suggests_existing_ones(tmp_path: Path) -> None:
    said = pfbench("report", "study=quickstrat", home=tmp_path)
    assert said.code == 2
    assert "got quickstrat. Similar: quickstart." in said.err
    assert "+experiment=quickstrat" not in said.err


@pytest.mark.parametrize("command", ["report", "replay", "cost", "paper"])
def test_a_study_without_results_is_told_the_command_that_exists(
    command: str, tmp_path: Path
) -> None:
    more = {"replay": ["run=1", "filter=sir"], "paper": ["journal=ieee"]}.get(command, [])
    more += [f"reports_dir={tmp_path}"] * (command != "cost")
    said = pfbench(command, "study=quickstart", *more, home=tmp_path)
    assert "got quickstart." in said.err
    assert "Run its jobs first: pfbench run -m +experiment=quickstart\n" in said.err
    store.write_failure(
        tmp_path / "results" / "adhoc" / "0123456789abcdef.npz",
        {"scenario": "growth", "noise": "nominal", "filter": "sir", "model": "growth"},
        ValueError("bad"),
    )
    said = pfbench(command, "study=adhoc", *more, home=tmp_path)
    assert "1 of its jobs failed, the first with ValueError: bad" in said.err
    assert "pfbench run study=adhoc scenario=NAME noise=NAME filter=NAME" in said.err
    assert "+experiment=adhoc" not in said.err


def test_a_copied_result_is_refused(tmp_path: Path) -> None:
    assert pfbench("run", *WALK, "filter=ekf", home=tmp_path).code == 0
    (file,) = (tmp_path / "results" / "adhoc").glob("*.npz")
    copy = file.with_name("0123456789abcdef.npz")
    with np.load(file) as content:
        arrays = {name: content[name] for name in content.files if name not in ("meta", "digest")}
        meta = json.loads(str(content["meta"]))
    store.write_result(copy, {**meta, "key": copy.stem}, arrays)
    said = pfbench("report", "study=adhoc", home=tmp_path)
    assert said.code == 2
    assert f"{copy.name} and {file.name} hold the same runs of ekf" in said.err or (
        f"{file.name} and {copy.name} hold the same runs of ekf" in said.err
    )
    assert "Delete the copy" in said.err


def test_trust_with_a_plus_sign_is_the_same() -> None:
    assert split_trust(["+trust=[mylab]", "seed=1"]) == (["seed=1"], ("mylab",))
    assert split_trust(["++trust=[mylab]"]) == ([], ("mylab",))


def test_a_module_that_is_not_installed_is_named() -> None:
    class InstantiationException(Exception):  # noqa: N818
        """Error of Hydra's name."""

    cause = ImportError(
        "Error loading 'mylab.A':\nModuleNotFoundError(\"No module named 'mylib'\")"
    )
    error = InstantiationException("Error in call\nfull_key: filter")
    error.__cause__ = cause
    message = messages.format_error(error)
    assert "filter._target_ must be importable, got mylab.A: the module mylib is not" in message
    assert "PYTHONPATH" in message


def test_text_in_place_of_a_number_is_refused_by_its_setting() -> None:
    word = "filter.noise_adaptations.0.dof=four"
    config = compose(["scenario=linear_walk", "filter=student", word])
    with pytest.raises(Exception, match="dof must be positive, got 'four'") as caught:
        job.build_plan(config)
    message = messages.format_error(caught.value, ["filter=student", word])
    assert message.startswith(
        "filter.noise_adaptations.0.dof must be positive, got 'four'. Use 4 to 8."
    )


@pytest.mark.parametrize(
    ("scenario", "key"),
    [
        ("scenario=user_raw_log", "scenario.tuning.clock.drift_sd"),
        ("scenario=anshun_fit", "scenario.receiver.clock.drift_sd"),
    ],
)
def test_a_clock_is_refused_by_the_key_of_its_scenario(scenario: str, key: str) -> None:
    words = [scenario, f"{key}=-1"]
    own = ["scenario.folder=own", "data.root=."] if "user" in scenario else []
    with pytest.raises(Exception, match="drift_sd must be positive, got -1") as caught:
        job.build_plan(compose(["filter=ekf", *own, *words]))
    message = messages.format_error(caught.value, words)
    assert message == f"{key} must be positive, got -1. Change {key}."


@pytest.mark.parametrize(
    ("text", "advice"),
    [
        ("LexerNoViableAltException: study=é\n  ^\nSee https://hydra.cc", "must be key=value. Quote"),
        ("mismatched input '(' expecting <EOF>", "must be key=value. Quote"),
        ("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8589934592 bytes.",
         "an array of 8 GiB. Reduce runs"),
    ],
)  # fmt: skip
def test_messages_of_other_libraries_are_translated(text: str, advice: str) -> None:
    assert advice in messages.format_error(RuntimeError(text))


def test_a_closed_pipe_gives_no_traceback() -> None:
    code = "import sys; sys.argv = ['pfbench', '--help']; from pfbench import cli; cli.main()"
    run = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert run.stdout is not None
    assert run.stderr is not None
    run.stdout.close()
    assert run.stderr.read() == ""
    run.stderr.close()
    assert run.wait() == 0


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (("report", "--flag"), 2),
        (("replay", "study=quickstart"), 2),
        (("run", *WALK, "filter=none_of_these"), 2),
        (("run", *WALK, "filter=ekf", "runs=0"), 2),
        (("run", *WALK, "filter=ekf", "seed=99999999999"), 2),
        (("run", *WALK, "filter=ekf", "runs=2", "memory_limit_gib=1e-6"), 1),
    ],
)
def test_refused_input_exits_with_two_and_prints_no_plan(
    words: tuple[str, ...], code: int, tmp_path: Path
) -> None:
    said = pfbench(*words, home=tmp_path)
    assert said.code == code, said.err
    assert ("plan:" in said.out) == (code == 1)


def test_a_sweep_without_a_result_has_no_next_report(tmp_path: Path) -> None:
    words = ("run", "-m", *WALK, "filter=ekf", "study=mine")
    said = pfbench(*words, "memory_limit_gib=1e-6,1e-7", home=tmp_path)
    assert said.code == 1
    assert "2 failed" in said.out
    assert "Next:" not in said.out
    said = pfbench(*words, "memory_limit_gib=1e-6,null", home=tmp_path)
    assert "1 finished, 0 skipped, 1 failed" in said.out
    assert "Next: pfbench report study=mine" in said.out


@pytest.mark.parametrize(
    ("setting", "must"),
    [
        ("particles=10,abc", "be a whole number"),
        ("particles=abc,10", "be a whole number"),
        ("seed=1,1e3", "be a whole number"),
        ("threads=choice(1,0)", "be a whole number"),
        ("filter.resampler.ess_threshold=0.5,1.5", "be in [0, 1], got 1.5"),
    ],
)
def test_a_bad_value_of_a_sweep_is_told_before_a_job_starts(
    tmp_path: Path, setting: str, must: str
) -> None:
    said = pfbench("run", "-m", *WALK, "filter=sir,apf", setting, home=tmp_path)
    assert said.code == 2
    assert f"error run: {setting.partition('=')[0]} must {must}" in said.err
    assert not (tmp_path / "results").exists()
