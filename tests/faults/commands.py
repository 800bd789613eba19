"""Whole commands in the folder of a stranger, each process of them under an audit hook.

Most commands run in a copy of this process, which has run each of them once and so has its libraries. Others are new processes.

The folder has programs where git, Python, matplotlib, Hydra and pytest look, and results, caches, links and configuration
files that lead to them or to a secret. Each program leaves a mark. The hook records what is opened, imported or started
undeclared (`watched/sitecustomize.py`), in the processes that a command starts too.
"""

import copy
import gc
import importlib
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import chdir
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from unittest import mock

import synthetic_log
from checkout import ROOT
from command_line import environment, pfbench
from judge_cases import drive, estimate, write

from faults.children import Ending, run_child
from faults.sweeps import CLEAR, new_home
from faults.tally import FINE, Tally
from pfbench import job
from pfbench.results import store

WATCHED = Path(__file__).with_name("watched")
LIMIT_S = 300.0  # of a command
STUDY = "walks"
WALK = "scenario=linear_walk scenario.steps=6 runs=2 score_steps=1"
PLACES = (
    "results",
    "reports",
    "worlds",
    "conf",
    "log",
    "truth.csv",
    "mine.csv",
    "multirun",
)  # declared
MODULES = (
    "json", "random", "numpy", "torch", "yaml", "sitecustomize", "usercustomize", "conftest", "pfbench", "matplotlib", "_pickle",
    "hydra_plugins/theirs", "zlib", "logging", "socket", "mylab", "pandas", "resource_tracker", "joblib",
)  # fmt: skip
RUN = f"run {WALK} filter=ekf study=new"
SWEEP = f"run -m {WALK} filter=ekf,ckf study=new"
COMMANDS: dict[str, str] = {
    "run": RUN,
    "run, own experiment": f"run {WALK} filter=ekf +experiment=mine",
    "run, serial": SWEEP,
    "run, cores": f"{SWEEP} hydra/launcher=cores hydra.launcher.n_jobs=2",
    "run, cores by a file": f"run -m {WALK} filter=ekf,ckf +experiment=cores",
    "report": f"report study={STUDY}",
    "replay": f"replay study={STUDY} run=1 filter=ekf",
    "judge": "judge reference=truth.csv mine=mine.csv",
    "paper": f"paper study={STUDY} width=120mm",
    "inspect": "inspect log",
    "open": f"open study={STUDY}",
    "status": f"status study={STUDY}",
    "list": "list noise",
    "data": "data log",
    "run, slurm": f"{SWEEP} hydra/launcher=slurm",
    **({"run, ray": f"{SWEEP} hydra/launcher=ray_local"} if find_spec("ray") else {}),
}
SHARES: dict[str, float] = {
    "run": 18, "run, own experiment": 20, "inspect": 15, "status": 10, "judge": 10, "report": 7, "replay": 7, "list": 5, "data": 4,
    "run, serial": 1, "open": 1, "run, slurm": 0.5, "paper": 0.5, "run, cores": 0.3, "run, cores by a file": 0.3, "run, ray": 0.1,
}  # fmt: skip
NEW_PROCESS = 80  # one in so many trials is a process of its own, which imports all its libraries


class Home:
    """Home of a user with the folder `place` of a stranger, a secret beside it and marks of what ran."""

    def __init__(self, path: Path) -> None:
        self.path, self.place, self.marks = path, path / "place", path / "marks"
        shutil.copytree(template(), self.place)
        for folder in (self.marks, path / "outside", path / "house"):
            folder.mkdir()
        (path / "outside" / "secret.csv").write_text("x7secretx7\n")

    def write(self, name: str, text: str) -> Path:
        """Write a file of the stranger's folder."""
        file = self.place / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
        return file

    def write_program(self, name: str) -> Path:
        """Write a program that leaves a mark."""
        file = self.write(name, f"#!/bin/sh\ntouch '{self.marks / Path(name).name}'\ncat\n")
        file.chmod(0o755)
        return file

    def watch(self) -> dict[str, str]:
        """Return the environment of a watched process."""
        declared = [str(self.place / name) for name in PLACES] + [str(self.path / "house")]
        settings = {"log": str(self.path / "log"), "home": str(self.path), "declared": [*declared, str(ROOT)]}  # fmt: skip
        return environment(self.place) | {
            "FAULTS_WATCH": json.dumps(settings), "PYTHONPATH": os.pathsep.join(filter(None, (str(WATCHED), os.environ.get("PYTHONPATH")))), "HOME": str(self.path / "house"), "BROWSER": "true",
        }  # fmt: skip

    def list_marks(self) -> list[str]:
        """List the marks of programs that ran, and what the hook recorded."""
        log = self.path / "log"
        lines = log.read_text().splitlines() if log.exists() else []
        return [f"mark {file.name}" for file in self.marks.iterdir()] + sorted({*lines})


@cache
def template() -> Path:
    """Return a folder with two results, the log of an instrument, two trajectories and a configuration."""
    folder = Path(tempfile.mkdtemp(prefix="pfbench-commands-"))
    for name in ("ekf", "ckf"):
        words = [*WALK.split(), f"filter={name}", f"study={STUDY}", f"results_dir={folder}/results"]
        job.run(job.compose(words))
    truth = drive(30.0)
    write(truth, folder / "truth.csv")
    write(estimate(truth, 1.0, 1), folder / "mine.csv")
    synthetic_log.write(folder / "log", synthetic_log.tables(5.0))
    for name in ("conf", "reports", "worlds"):
        (folder / name).mkdir()
    return folder


@cache
def load_libraries() -> None:
    """Run most commands once in this process, so that its copies import and compose little."""
    for command, words in COMMANDS.items():
        if SHARES[command] >= 1:
            with new_home() as path, chdir((home := Home(path)).place):
                pfbench(*words.split(), home=home.place)
    gc.freeze()


def plant_modules(home: Home, rng: random.Random) -> None:
    for name in rng.sample(MODULES, 12):
        mark = home.marks / name.replace("/", ".")
        home.write(f"{name}.py", f"open({str(mark)!r}, 'w').close()\n")


def plant_settings(home: Home, rng: random.Random) -> None:
    """Settings of libraries and tools."""
    home.write("matplotlibrc", "savefig.dpi: 10\nbackend: module://theirs\n")
    home.write(".env", "PFBENCH_TRUST=mylab\n")
    home.write("pytest.ini", "[pytest]\naddopts = -p conftest\n")
    home.write("pyproject.toml", "[tool.ruff]\n")
    home.write(".cache/own/json.py", f"open({str(home.marks / 'own')!r}, 'w').close()\n")


def plant_git(home: Home, rng: random.Random) -> None:
    """A repository around the folder and one of ordinary files within a report."""
    program = home.write_program("monitor")
    config = f'[core]\n\tfsmonitor = {program}\n\tbare = BARE\n\tworktree = .\n[filter "x"]\n\tclean = {program}\n[diff]\n\texternal = {program}\n'
    for folder, bare in ((".git", "false"), (f"reports/{rng.choice([STUDY, 'judge', 'inspect_log'])}", "false")):  # fmt: skip
        for name in ("objects/info/x", "refs/heads/x"):
            home.write(f"{folder}/{name}", "").unlink()
        home.write(f"{folder}/HEAD", "ref: refs/heads/main\n")
        home.write(f"{folder}/config", config.replace("BARE", bare))
    home.write(".gitattributes", "* filter=x diff=x\n")


def plant_results(home: Home, rng: random.Random) -> None:
    """A forged result whose digest is right, that leads to a class, a file or much time."""
    file = rng.choice(sorted((home.place / "results" / STUDY).glob("*.npz")))
    result = store.read_result(file)
    meta, secret = copy.deepcopy(result.meta), str(home.path / "outside" / "secret.csv")
    part = rng.choice(["scenario", "noise", "filter", "model"])
    values = rng.choice([
        {"_target_": "os.system", "command": f"touch {home.marks / 'target'}"}, {"_target_": "mylab.Mine"}, {"checkpoint": secret},
        {"_target_": "pfbench.noise.ErrorReplay", "file": secret}, {"folder": secret, "root": str(home.path / "outside")}, {"steps": 10**9},
        {"_target_": "pfbench.filter.ParticleFilter", "proposal": {"checkpoint": "../outside/secret.csv"}}, {"cache_dir": "/nowhere"},
        {"particles": 10**12}, {"paper": {"name": "\x1b[31m<script>"}},
    ])  # fmt: skip
    meta["config"][part] = {**meta["config"][part], **values}
    if rng.random() < 0.3:
        meta["trusted"], meta["steps"] = ["mylab"], 10**9
    store.write_result(file, meta, result.data)


def plant_caches(home: Home, rng: random.Random) -> None:
    """Damaged caches, links out of the folder, pipes and names of two lines."""
    for name in ("manifest.json", "figures/paper_1.png"):
        home.write(f"reports/{STUDY}/{name}", "").unlink()
        os.mkfifo(home.place / "reports" / STUDY / name)
    home.write("conf/noise/two\nlines.yaml", "_target_: mylab.Noise\n")
    home.write("worlds/0123456789abcdef.npz", "PK\x03\x04")
    home.write(f"results/{STUDY}/0123456789abcdef.failed.json", "{}")
    secret = home.path / "outside" / "secret.csv"
    place, name = rng.choice([
        (f"results/{STUDY}", "fedcba9876543210.npz"), ("conf/noise", "mine.yaml"), ("reports", STUDY), ("log", "imu.csv"), ("", "linked"),
    ])  # fmt: skip
    (home.place / place).mkdir(parents=True, exist_ok=True)
    if not (home.place / place / name).exists():
        (home.place / place / name).symlink_to(secret if name != STUDY else secret.parent)


def plant_configuration(home: Home, rng: random.Random) -> None:
    """Files of groups, of which the experiments choose a launcher."""
    key = rng.choice(
        ["", "filter: {", "noise: {", "scenario: {model: {", "hydra: {", "hydra: {launcher: {"]
    ) + rng.choice(["a", '"\\e[31m"', "trust", "'proposal.checkpoint'", "reading", "checkpoint"])
    value = rng.choice(["1", "'['", "../outside/secret.csv", "${oc.env:HOME}", "{_target_: os.system}"])  # fmt: skip
    home.write(
        "conf/experiment/mine.yaml",
        f"# @package _global_\nstudy: new\n{key}: {value}{'}' * key.count('{')}\n",
    )
    home.write("conf/experiment/cores.yaml", "# @package _global_\ndefaults:\n  - override /hydra/launcher: cores\nstudy: new\n")  # fmt: skip
    home.write("conf/noise/theirs.yaml", "_target_: mylab.Noise\n")


PLANTS: tuple[Callable[[Home, random.Random], None], ...] = (
    plant_modules, plant_settings, plant_git, plant_results, plant_caches, plant_configuration,
)  # fmt: skip


def prepare(command: str, home: Home, rng: random.Random) -> None:
    """Plant most of the files. Damage of results and links would end some commands early, so they are planted at times."""
    for plant in PLANTS:
        share = 0.5 if plant in (plant_results, plant_caches) else 0.9
        if command.endswith("by a file") or rng.random() < share:
            plant(home, rng)


def call(words: list[str], home: Home, in_process: bool) -> list[object]:
    """Run a command in the folder of the stranger. Returns exit code and what it said."""
    if not in_process:
        command = [sys.executable, "-P", "-m", "pfbench", *words]
        done = subprocess.run(
            command, cwd=home.place, env={**os.environ, **home.watch()}, capture_output=True, text=True, check=False
        )  # fmt: skip
        return [done.returncode, done.stdout + done.stderr]
    os.environ.update(home.watch())
    os.chdir(home.place)
    sys.path.insert(0, str(WATCHED))
    with mock.patch.object(sys, "path", [p for p in sys.path if p not in ("", str(home.place))]):
        importlib.import_module("sitecustomize" if "sitecustomize" not in sys.modules else "faults.watched.sitecustomize")  # fmt: skip
        said = pfbench(*words, home=home.place)
    return [said.code, said.out + said.err]


def judge(ending: Ending, found: list[str]) -> tuple[str, str]:
    """Return outcome and example of a command: what it opened or ran, and how it ended."""
    ran = [line for line in found if not line.strip("'\"").startswith("open ")]
    if found:
        return "code run" if ran else "false", f"{(ran or found)[:3]}"
    if ending.state != "done" or "Traceback (most" in str(ending.value[1]):
        return "crash", f"{ending}"
    code, text = ending.value
    if "\x1b" in text or "\nlines" in text or (code not in (0, 3) and not CLEAR.search(text)):
        return "unclear", f"{code} {text[-300:]!r}"
    return FINE, ""


def attempt(command: str, number: int, in_process: bool = True) -> list[str]:
    """Run a command in a folder and return outcome, remark and example."""
    with new_home() as path:
        home = Home(path)
        prepare(command, home, random.Random(f"{command} {number}"))
        words = COMMANDS[command].split()
        ending = run_child(lambda: call(words, home, in_process), timeout=LIMIT_S)
        outcome, example = judge(ending, home.list_marks())
    return [outcome, command, f"{number}: {example}"]


def run(count: int, seed: int) -> Tally:
    """Run commands, drawn by their shares, in folders of their own; `seed` is the number of the batch."""
    tally = Tally("hostile commands")
    load_libraries()
    for number in range(seed * 100_000, seed * 100_000 + count):
        command = random.Random(number).choices(
            list(COMMANDS), [SHARES[name] for name in COMMANDS]
        )[0]
        tally.add(*attempt(command, number, in_process=bool(number % NEW_PROCESS)))
    return tally
