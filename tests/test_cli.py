"""The command line speaks to people: what was given, what is wrong with it, what to give instead; and leaves nothing behind."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import torch
from command_line import pfbench

import pfbench as package
from pfbench import cli, job

WALK = ("scenario=linear_walk", "scenario.steps=5", "runs=2", "particles=20")
no_cuda = pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a CUDA device")

# words -> what the message must hold: the key with the value that was given, and the remedy
MISTAKES: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "unknown filter": (
        ("filter=sirr",),
        ("filter=sirr: there is no such filter", "did you mean sir?", "There are apf, ckf,"),
    ),
    "no filter like it": (("filter=zzz",), ("filter=zzz: there is no such filter. There are apf, ckf,",)),
    "unknown scenario": (("scenario=t0003",), ("scenario=t0003: there is no such scenario", "did you mean t003", "linear_walk")),
    "unknown noise": (("noise=outlier",), ("noise=outlier: there is no such noise", "did you mean outliers?")),
    "unknown study": (("+experiment=quikstart",), ("experiment=quikstart", "did you mean quickstart?")),
    "misspelt key": (
        ("filter.partcles=100",),
        ("filter.partcles=100: there is no key 'filter.partcles'; did you mean filter.particles?",),
    ),
    "misspelt deep key": (("filter.resampler.treshold=0.3",), ("did you mean filter.resampler.threshold?",)),
    "misspelt group": (("flter=sir",), ("flter=sir: there is no key 'flter'; did you mean filter?",)),
    "added key": (("+filter.partcles=100",), ("+filter.partcles=100: there is no key", "did you mean filter.particles?")),
    "nothing like it": (("zzz=1",), ("zzz=1: there is no key 'zzz'; `pfbench run --cfg job` prints all keys",)),
    "a key of another filter": (
        ("-m", "filter=ekf,sir", "filter.particles=20"),
        ("filter.particles=20: not every cell of this sweep has the key", "apart"),
    ),
    "no particles": (("filter.particles=0",), ("filter.particles=0: give at least 2 particles",)),
    "particles in words": (("filter.particles=many",), ("filter: its values do not fit", "check filter.particles=many")),
    "negative deviation": (("model.measurement_sd=-1",), ("model.measurement_sd=[-1]: give positive numbers",)),
    "negative receiver": (
        ("scenario=t003", "scenario.receiver.position_sd=[-1,1,1]"),
        ("scenario.receiver.position_sd=[-1, 1, 1]: give three positive standard deviations",),
    ),
    "negative alignment": (
        ("scenario=t003", "scenario.initial.velocity=[1,1]"),
        ("scenario.initial.velocity=[1, 1]: give three positive standard deviations",),
    ),
    "odd interval": (
        ("scenario=t003", "scenario.interval=0.03"),
        ("scenario.interval=0.03: at imu_rate=100.0 that is 3 samples; give an even number",),
    ),
    "no runs": (("runs=0",), ("runs=0: give a whole number, 1 or more",)),
    "runs in words": (("runs=few",), ("runs=few: give a whole number, 1 or more",)),
    "half a run": (("runs=2.5",), ("runs=2.5: give a whole number",)),
    "runs before the first": (("first_run=-1",), ("first_run=-1: give a whole number, 0 or more",)),
    "negative seed": (("seed=-1",), ("seed=-1: give a whole number, 0 or more",)),
    "huge seed": (("seed=4294967296",), ("seed=4294967296: give an integer from 0 to 2**32 - 1",)),
    "no threads": (("threads=0",), ("threads=0: give a whole number, 1 or more",)),
    "half precision": (("dtype=float16",), ("dtype=float16: give float64 (the default) or float32",)),
    "unknown engine": (("engine=steam",), ("engine=steam: give auto, eager, loops or compiled",)),
    "unknown device": (("device=gpu",), ("device=gpu: give cpu, cuda",)),
    "regime": (("noise=outliers", "noise.probability=2"), ("noise.probability=2: give a probability between 0 and 1",)),
    "no such class": (("noise._target_=pfbench.noise.regimes.Louder",), ("noise: its values do not fit", "Louder")),
    "a model without its scenario": (
        ("model=ins_gnss",),
        ("model.imu comes from scenario.imu, which is not there: give model.imu=..., or choose a scenario that has it",),
    ),
    "a key through another": (("scenario.model.measurement_sd=2",), ("did you mean model.measurement_sd?",)),
    "no equals sign": (("ekf",), ("'ekf' is not understood: give key=value",)),
    "own log without a folder": (
        ("scenario=own_log",),
        ("scenario.folder is not set: give scenario.folder=...",),
    ),
    "car without data": (("scenario=car_drive",), ("data.root is not set", "PFBENCH_DATA", "car_rtk_mems")),
    "quadrotor without data": (("scenario=quad_flights",), ("data.root is not set", "quad_rtk_mimu")),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_told_and_leaves_nothing_behind(tmp_path: Path, mistake: str) -> None:
    words, told = MISTAKES[mistake]
    said = pfbench("run", "scenario=linear_walk", "runs=2", "particles=20", *words, home=tmp_path)
    assert said.code == 1
    assert "pfbench run: " in said.err
    message = said.err[said.err.index("pfbench run: ") :]
    for part in told:
        assert part in message
    assert "Traceback" not in said.err + said.out
    assert not [file for file in tmp_path.rglob("*") if file.suffix in (".npz", ".tmp")]


@no_cuda
@pytest.mark.parametrize("device", ["cuda", "cuda:3"])
def test_a_device_that_is_not_there_is_told(tmp_path: Path, device: str) -> None:
    said = pfbench("run", *WALK, f"device={device}", home=tmp_path)
    assert said.code == 1
    assert f"device={device}: torch finds 0 CUDA devices here; give device=cpu" in said.err


def test_the_trace_is_there_for_who_asks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PFBENCH_TRACE", "1")
    with pytest.raises(ValueError, match="runs=0"):
        pfbench("run", *WALK, "runs=0", home=tmp_path)


def test_who_stops_a_sweep_is_told_that_it_goes_on(tmp_path: Path) -> None:
    with mock.patch.object(job, "compute", side_effect=KeyboardInterrupt):
        said = pfbench("run", *WALK, home=tmp_path)
    assert said.code == 130
    assert "finished cells are kept" in said.err
    assert not list(tmp_path.rglob("*.npz"))


@pytest.mark.parametrize("place", range(3))
def test_the_flag_of_a_sweep_may_stand_anywhere(tmp_path: Path, place: int) -> None:
    words = [*WALK, "filter=ekf,ckf"]
    words.insert(place * 2, "-m")
    said = pfbench("run", *words, home=tmp_path)
    assert said.code == 0
    assert len(list((tmp_path / "results" / "adhoc").glob("*.npz"))) == 2


# the other commands


@pytest.mark.parametrize("words", [(), ("-h",), ("--help",), ("help",)])
def test_usage(tmp_path: Path, words: tuple[str, ...]) -> None:
    said = pfbench(*words, home=tmp_path)
    assert said.code == 0
    assert package.__version__ in said.out
    assert all(f"pfbench {command}" in said.out for command in ("run", "report", "list", "check"))


def test_an_unknown_command(tmp_path: Path) -> None:
    said = pfbench("reprot", "study=x", home=tmp_path)
    assert said.code == 2
    assert "there is no command 'reprot'; did you mean report?" in said.err
    assert "pfbench run" in said.err


def test_list_names_every_yaml(tmp_path: Path) -> None:
    said = pfbench("list", home=tmp_path)
    assert said.code == 0
    lines = {line.split()[0]: line for line in said.out.splitlines() if line}
    for folder in ("filter", "model", "noise", "scenario", "report"):
        assert all(file.stem in lines[folder] for file in (cli.conf_dir() / folder).glob("*.yaml"))
    assert all(file.stem in lines["experiment"] for file in cli.experiments_dir().glob("*.yaml"))


def test_list_of_a_group_says_what_each_one_is(tmp_path: Path) -> None:
    said = pfbench("list", "filter", home=tmp_path)
    assert said.code == 0
    assert "sir                      SIR: bootstrap particle filter" in said.out
    assert len(said.out.splitlines()) == len(list((cli.conf_dir() / "filter").glob("*.yaml")))


def test_list_of_no_group(tmp_path: Path) -> None:
    said = pfbench("list", "filters", home=tmp_path)
    assert said.code == 1
    assert "pfbench list: there is no group 'filters'; did you mean filter? There are filter, model" in said.err


def test_report_of_a_study_that_does_not_exist(tmp_path: Path) -> None:
    said = pfbench("report", "study=nope", f"reports={tmp_path / 'reports'}", home=tmp_path)
    assert said.code == 1
    assert "pfbench report: no results in" in said.err
    assert "nope" in said.err
    assert "Make them with: pfbench run" in said.err
    assert not (tmp_path / "reports").exists()


def test_report_with_a_misspelt_key(tmp_path: Path) -> None:
    said = pfbench("report", "stdy=nope", home=tmp_path)
    assert said.code == 1
    assert "stdy=nope: there is no key 'stdy'; did you mean study?" in said.err


def test_check_finds_nothing_wrong(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It asks for every file. Here every tenth is composed: test_configs composes each."""
    compose, asked = cli._compose, []

    def tenth(words: list[str]) -> dict[str, Any]:
        asked.append(words[0] if words else "")
        return compose(words) if len(asked) % 10 == 1 or asked[-1].startswith(("report=", "train=")) else {}

    monkeypatch.setattr(cli, "_compose", tenth)
    said = pfbench("check", home=tmp_path)
    assert said.code == 0, said.err
    files = [*cli.conf_dir().glob("*/*.yaml"), *cli.experiments_dir().glob("*.yaml")]
    named = [("+experiment" if file.parent.name == "experiments" else file.parent.name, file.stem) for file in files]
    assert sorted(asked) == sorted(["", *(f"{group}={name}" for group, name in named)])
    assert f"composed   {len(files)} of {len(files)} configurations" in said.out
    for line in (f"pfbench    {package.__version__}", f"torch      {torch.__version__}", "data root  not set"):
        assert line in said.out


def test_check_names_what_does_not_compose(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(words: list[str]) -> dict[str, Any]:
        if "filter=ukf" in words:
            raise ValueError("kappa is not there")
        return {"data": {"root": None}}

    monkeypatch.setattr(cli, "_compose", broken)
    said = pfbench("check", home=tmp_path)
    assert said.code == 1
    assert "these do not compose:\n  filter=ukf: kappa is not there" in said.err
