"""The command line speaks to people: what was given, what is wrong with it, what to give instead; and leaves nothing behind."""

import re
import time
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import torch
from command_line import pfbench
from refusals import check_refused

import pfbench as package
from pfbench import job
from pfbench.cli import check
from pfbench.job import computation
from pfbench.results.paper_block import list_named_parts

WALK = ("scenario=linear_walk", "scenario.steps=5", "runs=2", "particles=20")
no_cuda = pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a CUDA device")

NUMBER = "must be a whole number of at least"
# words -> what the message must hold: the key with the value that was given, and the remedy
MISTAKES: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "unknown filter": (
        ("filter=sirr",),
        ("filter=sirr does not exist. Similar: sir", "List all: pfbench list filter"),
    ),
    "no filter like it": (
        ("filter=zzz",),
        ("filter=zzz does not exist. List all: pfbench list filter",),
    ),
    "unknown scenario": (
        ("scenario=flight_30s",),
        ("scenario=flight_30s does not exist. Similar: flight_300s",),
    ),
    "unknown noise": (("noise=outlier",), ("noise=outlier does not exist. Similar: outliers.",)),
    "unknown study": (
        ("+experiment=quikstart",),
        ("experiment=quikstart does not exist. Similar: quickstart.",),
    ),
    "unknown launcher": (
        ("hydra/launcher=basik",),
        ("hydra/launcher=basik does not exist", "basic"),
    ),
    "misspelt key": (
        ("filter.partcles=100",),
        ("filter.partcles=100: key filter.partcles does not exist. Similar: filter.particles.",),
    ),
    "misspelt deep key": (
        ("filter.resampler.treshold=0.3",),
        ("Similar: filter.resampler.ess_threshold.",),
    ),
    "misspelt group": (("flter=sir",), ("flter=sir: key flter does not exist. Similar: filter.",)),
    "added key": (
        ("+filter.partcles=100",),
        ("+filter.partcles=100: key filter.partcles does not exist. Similar: filter.particles",),
    ),
    "nothing like it": (
        ("zzz=1",),
        ("zzz=1: key zzz does not exist. List all: pfbench run --cfg job",),
    ),
    "a key of another filter": (
        ("-m", "filter=ekf,sir", "filter.particles=20"),
        ("filter.particles=20: not all jobs of this sweep have the key", "separate sweep"),
    ),
    "no particles": (
        ("filter.particles=0",),
        ("filter.particles must be a whole number of at least 2, got 0",),
    ),
    "particles in words": (
        ("filter.particles=many",),
        (
            "filter.particles must be a whole number of at least 2, got 'many'",
            "Use 2 or more, without a point",
        ),
    ),
    "negative deviation": (
        ("model.measurement_sd=-1",),
        ("model.measurement_sd", "-1", "positive numbers"),
    ),
    "negative receiver": (
        ("scenario=flight_300s", "scenario.receiver.position_sd=[-1,1,1]"),
        (
            "scenario.receiver.position_sd must be three positive standard deviations, got [-1, 1, 1]",
        ),
    ),
    "negative alignment": (
        ("scenario=flight_300s", "scenario.initial_errors.velocity=[1,1]"),
        (
            "scenario.initial_errors.velocity must be three positive standard deviations, got [1, 1]",
        ),
    ),
    "odd interval": (
        ("scenario=flight_300s", "scenario.filter_interval_s=0.03"),
        ("scenario.filter_interval_s", "0.03", "100.0 Hz", "3 samples", "even number"),
    ),
    "no runs": (("runs=0",), (f"runs {NUMBER} 1, got 0",)),
    "runs in words": (("runs=few",), (f"runs {NUMBER} 1, got few",)),
    "half a run": (("runs=2.5",), (f"runs {NUMBER} 1, got 2.5",)),
    "runs before the first": (("first_run=-1",), (f"first_run {NUMBER} 0, got -1",)),
    "negative seed": (("seed=-1",), (f"seed {NUMBER} 0, got -1",)),
    "huge seed": (("seed=4294967296",), ("seed", "4294967296", "2**32 - 1")),
    "no threads": (("threads=0",), (f"threads {NUMBER} 1, at most ", "got 0")),
    "threads that end the process": (
        ("threads=100000",),
        ("at most ", "got 100000. Set threads=1."),
    ),
    "a repeat that is no truth": (
        ("overwrite=maybe",),
        ("overwrite must be true (repeat", "got maybe"),
    ),
    "a folder that is a number": (
        ("results_dir=5",),
        ("results_dir must be a folder, got 5. Set results_dir=results",),
    ),
    "no folder": (("results_dir=null",), ("results_dir must be a folder, got None",)),
    "endless memory": (("memory_limit_gib=inf",), ("memory_limit_gib must be the GiB", "got inf")),
    "a device beyond all": (
        ("device=cuda:99999999999999999999",),
        ("device must be cpu, cuda", "Set device=cpu"),
    ),
    "seeds of one study": (
        ("-m", "seed=1,2"),
        (
            "seed must be one value in a study, since its report compares filters on equal data, got 1, 2.",
            "study=mine_1 seed=1",
        ),
    ),
    "runs of one study": (("-m", "runs=2,3"), ("runs must be one value in a study",)),
    "runs that leave a gap": (
        ("-m", "runs=2", "first_run=0,5"),
        ("first_run must be one value in a study",),
    ),
    "a sweep without a job": (
        ("-m", "seed=range(1,1)"),
        ("seed must have 1 to 100000 values, got none of",),
    ),
    "an endless sweep": (
        ("-m", "seed=range(1,inf)"),
        ("seed must have 1 to 100000 values, got more of",),
    ),
    "help of Hydra": (("--hydra-help",), ("--hydra-help and", "See pfbench run --help")),
    "a package to print without --cfg": (
        ("-m", "-p", "noise", "filter=ekf,sir"),
        ("flags must stand before the first key=value, got filter=ekf,sir",),
    ),
    "a package alone": (("--package", "noise"), ("pfbench run --cfg job -p noise",)),
    "resolved values without --cfg": (("--resolve",), ("--package and --resolve choose",)),
    "one run and several": (("-r", "-m"), ("--run, --multirun, --cfg and --info exclude",)),
    "another folder for each job": (
        ("hydra.job.chdir=true",),
        ("hydra.job.chdir must be left out", "Set results_dir=..."),
    ),
    "an added key that nothing reads": (
        ("-m", "+particle=50,60"),
        ("+particle=50,60: key particle does not exist. Similar: particles.",),
    ),
    "an added key of a group that nothing reads": (
        ("++until_decided.max_run=3",),
        ("key until_decided.max_run does not exist. Similar: until_decided.max_runs",),
    ),
    "a word without a key": (("=x",), ("each word must be key=value, got one without a key",)),
    "a key that exists": (
        ("+seed=1",),
        ("seed exists already. Leave out the plus sign: seed=VALUE",),
    ),
    "a launcher of words": (
        ("-m", "hydra/launcher=joblib", "hydra.launcher.n_jobs=x"),
        ("hydra.launcher.n_jobs must have a value of its type, got x",),
    ),
    "no settings of looks": (
        ("-m", "runs=until-decided", "filter=ekf,ukf", "until_decided=null"),
        ("until_decided must have the keys max_runs and max_hours, got None. Leave it out.",),
    ),
    "hours that are no number": (
        ("-m", "runs=until-decided", "filter=ekf,ukf", "until_decided.max_hours=nan"),
        ("until_decided.max_hours must be positive or null, got nan",),
    ),
    "no scored steps": (("score_steps=-1",), (f"score_steps {NUMBER} 0, got -1",)),
    "half precision": (
        ("dtype=float16",),
        ("dtype must be float64 (default) or float32, got float16",),
    ),
    "unknown engine": (
        ("engine=steam",),
        ("engine must be auto, eager, kernels, tape or compiled, got steam",),
    ),
    "unknown device": (("device=gpu",), ("device must be cpu, cuda", "got gpu")),
    "told maybe": (("oracle_noise=maybe",), ("oracle_noise must be true", "or false, got maybe")),
    "study in a folder": (
        ("study=a/b",),
        ("study must be a name of letters", "got 'a/b'"),
    ),
    "study of claims": (("study=claims",), ("study must not be datasheets or claims, got claims",)),
    "regime": (
        ("noise=outliers", "noise.probability=2"),
        ("noise.probability must be in [0, 1], got 2",),
    ),
    "no such class": (
        ("noise._target_=pfbench.noise.base.Louder",),
        ("noise._target_ must be a public class of pfbench", "got 'pfbench.noise.base.Louder'"),
    ),
    "a model without its scenario": (
        ("model=ins_gnss",),
        (
            "model.imu is read from scenario.imu, which this scenario does not have",
            "Scenarios of a model: pfbench list scenario model=NAME",
        ),
    ),
    "a key through another": (
        ("scenario.model.measurement_sd=2",),
        ("Similar: model.measurement_sd.",),
    ),
    "a flag": (
        ("--filter", "ekf"),
        ("--filter is not an option. Overrides have no dashes: write filter=ekf",),
    ),
    "a flag with its value": (("--filter=ekf",), ("write filter=ekf",)),
    "a flag without a value": (("--overwrite", "runs=3"), ("write overwrite=VALUE",)),
    "a value of a flag": (("--cfg", "all_of_it"), ("invalid choice: 'all_of_it'", "run --help")),
    "a missing folder": (
        ("hydra.searchpath=[file:///no/such]",),
        ("hydra.searchpath must have existing folders, got /no/such. Use file://",),
    ),
    "no equals sign": (("ekf",), ("'ekf' must be key=value",)),
    "own log without a folder": (
        ("scenario=user_log",),
        ("scenario.folder must be set. Set scenario.folder=...",),
    ),
    "car without data": (
        ("scenario=recorded_car_drive",),
        ("data.root", "PFBENCH_DATA", "car_rtk_mems"),
    ),
    "quadrotor without data": (("scenario=recorded_quad_flights",), ("data.root", "quad_rtk_mimu")),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_reported_and_leaves_nothing_behind(tmp_path: Path, mistake: str) -> None:
    words, parts = MISTAKES[mistake]
    said = pfbench("run", "scenario=linear_walk", "runs=2", "particles=20", *words, home=tmp_path)
    assert said.code == 2
    assert "error run: " in said.err
    message = said.err[said.err.index("error run: ") :]
    for part in parts:
        assert part in message
    assert "Traceback" not in said.err + said.out
    assert all((said.err + said.out).count(part) == 1 for part in parts if len(part) > 40)
    assert not [file for file in tmp_path.rglob("*") if file.suffix in (".npz", ".tmp")]


MISSING = "hydra.searchpath=[file:///no/such]"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("run", "-m", *WALK, MISSING), "hydra.searchpath must have existing folders, got /no/such. U"),
        (("report", "study=x", MISSING), "hydra.searchpath must have existing folders, got /no/such. U"),
        (("train", *WALK, MISSING), "hydra.searchpath must have existing folders, got /no/such. Use"),
        (("run", "-m", "--filter", "ekf,sir"), "--filter is not an option. Overrides have no dashes: write filter=ekf,sir"),
        (("report", "--study", "x"), "write study=x (pfbench report --help)"),
        (("train", "--filter"), "write filter=VALUE (pfbench train --help)"),
        (("list", "filter", "scenario=growth"), "words must be pfbench list filter, got scenario=growth"),
        (("list", "filters"), "error list: group must be one of filter, infer, model"),
        (("list", "filters"), "got filters. Similar: filter."),
        (("report", "stdy=nope"), "stdy=nope: key stdy does not exist. Similar: study."),
    ],
)  # fmt: skip
def test_each_command_refuses_a_missing_folder_a_flag_and_a_wrong_word(
    words: tuple[str, ...], message: str, tmp_path: Path
) -> None:
    said = pfbench(*words, home=tmp_path)
    assert said.code == 2
    assert f"\nerror {words[0]}: " in said.err
    assert said.err.count(message) == 1
    assert "usage:" not in said.err
    assert "Traceback" not in said.err


@no_cuda
@pytest.mark.parametrize("device", ["cuda", "cuda:3"])
def test_a_device_that_does_not_exist_is_reported(tmp_path: Path, device: str) -> None:
    said = pfbench("run", *WALK, f"device={device}", home=tmp_path)
    assert said.code == 2
    assert f"device must be cpu or one of 0 CUDA devices, got {device}. Use device=cpu" in said.err


def test_the_traceback_is_printed_on_request(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    check_refused(
        [("runs must be", lambda: pfbench("run", *WALK, "runs=0", "--traceback", home=tmp_path))],
        remedy=False,
    )
    monkeypatch.setenv("PFBENCH_TRACEBACK", "1")
    check_refused(
        [("runs must be", lambda: pfbench("run", *WALK, "runs=0", home=tmp_path))], remedy=False
    )


def test_an_interrupted_sweep_reports_how_to_resume(tmp_path: Path) -> None:
    with mock.patch.object(computation, "compute_job", side_effect=KeyboardInterrupt):
        said = pfbench("run", *WALK, home=tmp_path)
    assert said.code == 130
    assert "Finished jobs are kept. Repeat the command to resume" in said.err
    assert not list(tmp_path.rglob("*.npz"))


def test_a_sweep_counts_its_jobs(tmp_path: Path) -> None:
    assert pfbench("run", *WALK, "filter=ekf", home=tmp_path).code == 0
    said = pfbench("run", "-m", *WALK, "filter=ekf,ckf", home=tmp_path)
    assert said.code == 0, said.err
    first, second, summary = [
        line for line in said.out.splitlines() if re.match(r"\[\d|sweep", line)
    ]
    assert first.startswith("[1/2] skipped   linear_walk / nominal / ekf   result exists: ")
    assert second.startswith("[2/2] finished  t=")
    assert summary.startswith("sweep: 1 finished, 1 skipped, 0 failed in ")
    assert summary.endswith("Next: pfbench report study=adhoc")


def test_a_sweep_counts_its_own_jobs_beside_another_one(tmp_path: Path) -> None:
    compute_job = computation.compute_job

    def compute_beside(*arguments: Any) -> Any:
        (tmp_path / "results" / "adhoc" / f"of_another_{time.time()}.npz").write_bytes(b"")
        return compute_job(*arguments)

    assert pfbench("run", *WALK, "filter=ekf", home=tmp_path).code == 0
    with mock.patch.object(computation, "compute_job", side_effect=compute_beside):
        said = pfbench("run", "-m", *WALK, "filter=ekf,ckf,ukf", home=tmp_path)
    assert "sweep: 2 finished, 1 skipped, 0 failed in " in said.out
    assert not list(tmp_path.rglob(".sweep-*"))


@pytest.mark.parametrize("place", range(3))
def test_the_flag_of_a_sweep_may_stand_anywhere(tmp_path: Path, place: int) -> None:
    words = [*WALK, "filter=ekf,ckf"]
    words.insert(place * 2, "-m")
    said = pfbench("run", *words, home=tmp_path)
    assert said.code == 0
    assert len(list((tmp_path / "results" / "adhoc").glob("*.npz"))) == 2


# the other commands


COMMANDS = ("run", "report", "claims", "datasheet", "judge", "train", "list", "check")


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_a_command(tmp_path: Path, command: str) -> None:
    said = pfbench(command, "--help", home=tmp_path)
    assert said.code == 0
    assert said.out.startswith(f"pfbench {command}")
    assert "\n\n" in said.out


def test_version(tmp_path: Path) -> None:
    assert pfbench("--version", home=tmp_path).out == f"pfbench {package.__version__}\n"


@pytest.mark.parametrize("words", [(), ("-h",), ("--help",), ("help",)])
def test_usage(tmp_path: Path, words: tuple[str, ...]) -> None:
    said = pfbench(*words, home=tmp_path)
    assert said.code == 0
    assert package.__version__ in said.out
    assert all(f"pfbench {command}" in said.out for command in COMMANDS)


def test_an_unknown_command(tmp_path: Path) -> None:
    said = pfbench("reprot", "study=x", home=tmp_path)
    assert said.code == 2
    assert "command 'reprot' does not exist. Similar: report." in said.err
    assert "pfbench run" in said.err


def test_list_names_every_yaml(tmp_path: Path) -> None:
    said = pfbench("list", home=tmp_path)
    assert said.code == 0
    lines = {line.split()[0]: line for line in said.out.splitlines() if line}
    for folder in ("filter", "model", "noise", "scenario", "report"):
        assert all(name in lines[folder] for name in list_named_parts(folder))
    assert all(file.stem in lines["experiment"] for file in job.experiments_dir().glob("*.yaml"))


def test_list_of_a_group_says_what_each_one_is(tmp_path: Path) -> None:
    said = pfbench("list", "filter", home=tmp_path)
    assert said.code == 0
    assert "sir                      SIR: bootstrap particle filter" in said.out
    assert len(said.out.splitlines()) == len(list_named_parts("filter"))


def test_a_link_of_a_stranger_s_folder_is_neither_listed_nor_written_through(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("conf/noise", "reports"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "conf" / "noise" / "theirs.yaml").symlink_to(__file__)
    (tmp_path / "reports" / "adhoc").symlink_to(tmp_path / "conf")
    monkeypatch.chdir(tmp_path)
    assert "theirs" not in pfbench("list", "noise", home=tmp_path).out
    assert (
        "adhoc must be a folder, got a link" in pfbench("paper", "width=120mm", home=tmp_path).err
    )


def test_list_of_the_models_that_fit_a_recorded_scenario(tmp_path: Path) -> None:
    said = pfbench("list", "model", "scenario=recorded_berlin", home=tmp_path)
    assert said.code == 0, said.err
    assert [line.split()[0] for line in said.out.splitlines()] == [
        "urban_gnss",
        "urban_gnss_mixture",
    ]


def test_report_of_a_study_that_does_not_exist(tmp_path: Path) -> None:
    said = pfbench("report", "study=nope", f"reports_dir={tmp_path / 'reports'}", home=tmp_path)
    assert said.code == 2
    assert "error report: " in said.err
    assert "nope" in said.err
    assert "pfbench run" in said.err
    assert not (tmp_path / "reports").exists()


def test_check_finds_nothing_wrong(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It asks for every file. Here every tenth and each tuned filter is composed: test_configs composes each."""
    compose, requested, empty = check.compose, [], job.compose([])

    def tenth(words: list[str]) -> Any:
        requested.append(words[0] if words else "")
        is_composed = len(requested) % 10 == 1 or requested[-1].endswith("_tuned")
        return compose(words) if is_composed else empty

    monkeypatch.setattr(check, "compose", tenth)
    said = pfbench("check", home=tmp_path)
    assert said.code == 0, said.err
    added = {"experiment": "+experiment", "infer": "+infer"}  # groups that no job has by default
    named = [
        (added.get(group, group), name)
        for group, names in job.list_groups().items()
        for name in names
    ]
    assert sorted(requested) == sorted(["", *(f"{group}={name}" for group, name in named)])
    rows = {line.split("  ")[0]: line.split() for line in said.out.splitlines()}
    assert rows["item"] == ["item", "value", "status"]
    assert rows["configurations"][1:] == [str(len(named)), "of", str(len(named)), "ok"]
    assert rows["pfbench"][1:] == [package.__version__, "ok"]
    assert rows["torch"][1:] == [torch.__version__, "ok"]
    assert rows["data root"][2:4] == ["not", "set"]


def test_check_names_what_does_not_compose(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    empty = job.compose([])

    def broken(words: list[str]) -> Any:
        if "filter=ukf" in words:
            raise ValueError("kappa is not there")
        return empty

    monkeypatch.setattr(check, "compose", broken)
    said = pfbench("check", home=tmp_path)
    assert said.code == 1
    assert "configurations must compose, got errors:\n  filter=ukf: " in said.err
    assert "kappa is not there" in said.err
