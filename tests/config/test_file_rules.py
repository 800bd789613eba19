"""What a file of a search path may do: laws of the loader, each with a file that keeps it and one that does not."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from command_line import environment, pfbench

from pfbench import job
from pfbench.cli.compose import replace_config_dir
from pfbench.job.trust import UntrustedConfigError

NOISE = "_target_: pfbench.noise.NominalNoise\n"
SWEEP = "# @package _global_\nhydra:\n  sweeper:\n    params:\n      "


def compose(
    folder: Path, place: str, text: str, *words: str, scheme: str = "file"
) -> job.JobConfig:
    file = folder / f"{place}.yaml"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)
    group, name = place.split("/", 1)
    plus = "+" if group == "experiment" else ""
    path = f"hydra.searchpath=[{scheme}://{folder}]"
    return job.compose([path, "scenario=linear_walk", f"{plus}{group}={name}", *words])


REFUSED: dict[str, tuple[str, str, str]] = {  # place, text, message
    "header with blanks": ("train/a", "#  @package   hydra\nrun: {dir: x}\n", "must not be placed in hydra"),
    "second header": ("train/a", "# @package a\n# @package hydra.job\nb: 1\n", "must not be placed in hydra"),
    "below a global one": ("train/a", "# @package _global_\nhydra: {verbose: true}\n", "sweeper.params only"),
    "placed by a list": ("train/a", "defaults: [/noise@hydra.job: outliers]\n", "outside hydra"),
    "settings of hydra": ("train/a", "# @package _global_\ndefaults: [override /hydra/sweeper: basic]\n", "outside hydra"),
    "launcher by a package": ("train/a", "defaults: [/hydra/launcher@b: cores]\n", "outside hydra"),
    "data of the user": ("train/a", "b: [{root: /home/a}]\n", r"train\.b\.0\.root must be set on the command line.*own://"),
    "path of the user": ("train/a", "file: ../../a\n", r"train\.file must not be a path.*own://"),
    "folder by the sweep": ("experiment/a", SWEEP + "scenario: '{folder: a}'\n", r"scenario\.folder must be set"),
    "endless sweep": ("experiment/a", SWEEP + "runs: range(1,1000000000000)\n", "at most 100000 jobs"),
    "data of another key": ("train/a", "b: ${.root}\nroot: ${data.root}\n", "none of the user's folders"),
    "data by a reading": (
        "experiment/a",
        "# @package _global_\nreading: {a: {factor: f, class: ours, why: w, filters: {sir: {'proposal.checkpoint': w.pt}}}}\n",
        r"proposal\.checkpoint must be set on the command line",
    ),
    "cache by a reading": (
        "experiment/a", "# @package _global_\nreading: {a: {filters: {sir: {'proposal[cache_dir]': w}}}}\n", "must be set"
    ),
    "nested key": ("train/a", "c: data\nb: ${${train.c}.root}\n", "plain keys"),
    "quoted key": ("train/a", "b: ${oc.select:'data.root'}\n", "plain keys"),
    "circle": ("train/a", "defaults: [a]\n", "at most 300 files"),
    "override before a list": (
        "train/a", "defaults: [{override /noise: outliers}, {/noise: [outliers, student]}]\n", "Put the overrides last"
    ),
    "many files": ("train/a", f"defaults: [{','.join(f'/filter@a{i}: sir' for i in range(400))}]\n", "at most 300 files"),
    "bomb of texts": (
        "noise/a", NOISE + "b0: xxxxxxxx\n" + "".join(f"b{i + 1}: ${{noise.b{i}}}${{noise.b{i}}}\n" for i in range(40)),
        "at most 1000 references",
    ),
    "values": ("train/a", f"b: [{'1,' * 10_001}]\n", "at most 10000 values"),
    "depth": ("train/a", f"b: {'[' * 60}{']' * 60}\n", "at most 40 levels"),
    "bytes": ("train/a", "#" * 1_000_001, "at most 1000000 bytes"),
    "text": ("train/a", f"b: {'1:' * 6000}\n", "at most 10000 characters"),
    "name of a shipped file": ("train/vsmc", "a: 1\n", r"vsmc\.yaml must have another name.*Rename"),
    "name of a shipped experiment": ("experiment/quickstart", "a: 1\n", "must have another name"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_a_file_that_breaks_a_rule_is_refused(tmp_path: Path, name: str) -> None:
    place, text, message = REFUSED[name]
    with pytest.raises(UntrustedConfigError, match=message):
        compose(tmp_path, place, text)


ACCEPTED: dict[str, tuple[str, str]] = {
    "package": ("train/a", "#  @package   b\nc: 1\n"),
    "sweep": ("experiment/a", SWEEP + "filter: ekf,sir\n"),
    "what the user gives": ("train/a", "root: ${data.root}\ncheckpoint_path: ${results_dir}/a/b.pt\n"),
    "a file that builds on another": ("noise/a", "defaults: [outliers, _self_]\nb: ${.probability}\nprobability: 0.1\n"),
}  # fmt: skip


@pytest.mark.parametrize("name", ACCEPTED)
def test_a_file_that_keeps_the_rules_is_read(tmp_path: Path, name: str) -> None:
    assert compose(tmp_path, *ACCEPTED[name]).values["study"] == "adhoc"


def test_only_files_of_the_user_s_own_folder_name_data(tmp_path: Path) -> None:
    text = f"{NOISE}root: /home/a\nb: ../c\n"
    assert compose(tmp_path, "noise/a", text, scheme="own").values["noise"]["root"] == "/home/a"
    for line in ("cache_dir: /home/a", "d: ${oc.env:HOME}"):
        with pytest.raises(UntrustedConfigError, match="must"):
            compose(tmp_path, "noise/a", f"{text}{line}\n", scheme="own")
    (tmp_path / "hydra" / "launcher").mkdir(parents=True)
    (tmp_path / "hydra" / "launcher" / "mine.yaml").write_text("defaults: [joblib]\nn_jobs: 3\n")
    assert compose(tmp_path, "noise/a", text, "hydra/launcher=mine", scheme="own").values
    choice = "# @package _global_\ndefaults: [override /hydra/launcher: cores]\n"
    assert compose(tmp_path, "experiment/a", choice, scheme="own").values
    with pytest.raises(UntrustedConfigError, match="may choose a launcher: basic, cores"):
        compose(tmp_path, "experiment/b", choice)
    with pytest.raises(UntrustedConfigError, match="must not be a setting of hydra"):
        compose(tmp_path, "noise/a", NOISE, "hydra/launcher=mine")


@pytest.mark.parametrize(
    "kind", ["link", "folder that is a link", "pipe", "two folders", "main file"]
)
def test_a_folder_has_plain_files_with_names_of_their_own(tmp_path: Path, kind: str) -> None:
    conf, far = tmp_path / "conf", tmp_path / "far"
    for folder in (conf, far):
        folder.mkdir()
    (far / "train").mkdir()
    (far / "train" / "a.yaml").write_text("a: 1\n")
    if kind == "folder that is a link":
        (conf / "train").symlink_to(far / "train")
    else:
        (conf / "train").mkdir()
        file = conf / "train" / "a.yaml"
        {
            "link": lambda: file.symlink_to(far / "train" / "a.yaml"),
            "pipe": lambda: os.mkfifo(file),
        }.get(kind, lambda: file.write_text("a: 1\n"))()
    if kind == "main file":
        (conf / "config.yaml").write_text("a: 1\n")
    others = [f"own://{far}"] if kind == "two folders" else []
    path = f"hydra.searchpath=[{','.join([f'file://{conf}', *others])}]"
    with pytest.raises(UntrustedConfigError, match=r"must (be a file|have another name)"):
        job.compose([path, "scenario=linear_walk", "train=a"])


def test_a_package_in_the_search_path_must_be_trusted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "searchlab" / "conf" / "train").mkdir(parents=True)
    (tmp_path / "searchlab" / "__init__.py").write_text(
        f"import pathlib; pathlib.Path({str(tmp_path / 'ran')!r}).touch()"
    )
    (tmp_path / "searchlab" / "conf" / "train" / "a.yaml").write_text("a: 1\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    words = ["hydra.searchpath=[pkg://searchlab.conf]", "train=a"]
    with pytest.raises(UntrustedConfigError, match=r"trust=\[searchlab\]"):
        job.compose(words)
    assert not (tmp_path / "ran").exists()
    assert job.compose([*words, "trust=[searchlab]"]).values["train"] == {"a": 1}
    with pytest.raises(ValueError, match=r"must have folders .*got structured://os"):
        job.compose(["hydra.searchpath=[structured://os]"])


def test_the_flag_of_a_folder_is_a_search_path(tmp_path: Path) -> None:
    for words in (["--config-dir=a b"], ["-cd", "a b"], ["-cd=a b"]):
        assert replace_config_dir(["x=1", *words, "y=2"]) == [
            "x=1", "y=2", "hydra.searchpath=['file://a b']",
        ]  # fmt: skip
    for words in (["-cd"], ["-cd=a", "--config-dir=b"], ["-cd=a", "hydra.searchpath=[b]"]):
        with pytest.raises(ValueError, match="--config-dir must be given once"):
            replace_config_dir(words)
    (tmp_path / "train").mkdir()
    (tmp_path / "train" / "a.yaml").write_text("# @package _global_\nresults_dir: x\n")
    said = pfbench("run", "--cfg", "job", "train=a", f"--config-dir={tmp_path}", home=tmp_path)
    assert said.code != 0
    assert "results_dir must be set on the command line" in said.err


def test_nothing_in_the_current_folder_runs(tmp_path: Path) -> None:
    """Neither plugins of Hydra nor a module named like a library."""
    for name in (
        "hydra_plugins/__init__",
        "hydra_plugins/a",
        "yaml",
        "omegaconf",
        "hydra",
        "numpy",
    ):
        file = tmp_path / f"{name}.py"
        file.parent.mkdir(exist_ok=True)
        file.write_text(f"import pathlib; pathlib.Path({str(tmp_path / 'ran')!r}).touch()\n")
    (tmp_path / "folderlab.py").write_text(
        "from pfbench.noise import NominalNoise\nclass Q(NominalNoise): pass\n"
    )
    words = [
        "run",
        "scenario=linear_walk",
        "scenario.steps=3",
        "runs=2",
        "filter=ekf",
        "++noise={_target_: folderlab.Q}",
    ]
    env: dict[str, Any] = os.environ | environment(tmp_path)
    env.pop("PYTHONPATH", None)

    def run(*more: str) -> int:
        command = [sys.executable, "-m", "pfbench", *words, *more]
        return subprocess.run(
            command, cwd=tmp_path, env=env, capture_output=True, check=False
        ).returncode

    assert run("trust=[folderlab]") == 0
    assert not (tmp_path / "ran").exists()
