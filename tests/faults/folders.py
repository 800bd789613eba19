"""Random folders of configuration files, composed by pfbench and, as the oracle, by Hydra without any check.

Each folder is of one kind. What pfbench accepts is composed by Hydra alone: each file that Hydra loads from the
folder must have been checked, and the result must be free of foreign settings, classes and secrets.
"""

import os
import random
import re
import signal
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import Any
from unittest import mock

from hydra import version
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import ConfigRepository
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from faults.tally import FINE, Tally
from pfbench import job
from pfbench.cli.compose import check_words, expand_sweep, replace_config_dir
from pfbench.job import shared_loader
from pfbench.job.config import compose_tree

SECRET = "x7secretx7"
PLACES = (f"/nowhere/{SECRET}", "results", "reports", "worlds", "untrained")
LIMIT_S = 10  # of a folder
ENVIRONMENT = {
    "FUZZ_SECRET": SECRET, "PFBENCH_DATA": f"/nowhere/{SECRET}", "PFBENCH_RESULTS": "results", "PFBENCH_EPISODES": "worlds",
}  # fmt: skip
USER_KEYS = ("results_dir", "reports_dir", "episode_cache_dir", "data", "checkpoint", "overwrite")
PATH_KEYS = ("root", "folder", "cache_dir", "checkpoint", "checkpoint_path")
WALK = ["scenario=linear_walk"]
NOISE = "_target_: pfbench.noise.NominalNoise\n"
GROUPS = ("noise", "filter", "scenario", "train", "report", "experiment")

Write = Callable[[str, str], None]


def harmful(rng: random.Random) -> str:
    """Return lines of a file that lead to code, a folder, a secret or data of the user, or to nothing."""
    return rng.choice([
        "hydra: {run: {dir: NEW}}", "hydra: {job: {env_set: {A: b}}}", "hydra: {callbacks: {a: {_target_: os.system}}}",
        "hydra: {sweep: {dir: NEW}}", "hydra: {launcher: {n_jobs: 3}}", "hydra: {mode: MULTIRUN}", "hydra: {verbose: true}",
        "run: {dir: NEW}", "dir: NEW", "job: {env_set: {A: b}}", "env_set: {A: b}", "callbacks: {a: {_target_: os.system}}",
        "results_dir: NEW", "reports_dir: NEW", "episode_cache_dir: NEW", "overwrite: true", "data: {root: NEW}",
        "a: ${oc.env:FUZZ_SECRET}", "a: ${data.root}", "a: ${.b}\nb: ${data.root}", "root: NEW", "folder: NEW", "cache_dir: NEW",
        "a: {_target_: pathlib.Path.touch, _args_: [NEW]}", "a: {_target_: os.system, command: touch NEW}",
        "checkpoint: NEW", "a: ../../b", "a: 1", "steps: 3", "a: [1, 2]", "paper: {name: A}",
    ])  # fmt: skip


def headed(rng: random.Random) -> str:
    """Return a header in one of many spellings."""
    package = rng.choice(
        [
            "hydra",
            "hydra.job",
            "hydra.run",
            "_global_",
            "_global_.hydra",
            "_group_",
            "noise",
            "hydra.launcher",
            "a",
        ]
    )
    blank, more = rng.choice(["", " ", "  ", "\t"]), rng.choice([" ", "  ", "   "])
    return f"{rng.choice(['', ' '])}#{blank}@package{more}{package}{rng.choice(['', ' ', '  '])}\n"


def write_headers(rng: random.Random, write: Write) -> list[str]:
    write("train/mine", headed(rng) + harmful(rng))
    return ["train=mine"]


def write_several_headers(rng: random.Random, write: Write) -> list[str]:
    write("train/mine", headed(rng) + headed(rng) + harmful(rng))
    return ["train=mine"]


def write_late_headers(rng: random.Random, write: Write) -> list[str]:
    start = rng.choice(
        [
            "\ufeff",
            "# a comment\n",
            "\n\n",
            "#\n",
            "%YAML 1.1\n---\n",
            "---\n",
            "\r\n",
            " " * 520 + "\n",
            "\x0c\n",
        ]
    )
    write("train/mine", start + headed(rng) + harmful(rng))
    return ["train=mine"]


def write_defaults(rng: random.Random, write: Write) -> list[str]:
    entries = [
        "/noise: outliers", "override /noise: outliers", "optional other: x", "other", "./other", "/noise/other", "../noise/other",
        "/noise@_global_.hydra.job: outliers", "/filter@hydra: other", "other@_global_", "other@_global_.hydra", "_self_",
        "override /hydra/launcher: cores", "override /hydra/launcher: slurm", "/hydra/launcher@hydra.sweeper: cores",
        "override /hydra/job_logging: none", "/hydra/callbacks: other", "/train: ${filter}", "/noise: [outliers, other]",
        "override /filter: other", "/scenario@a.b: growth", "/config", "/hydra/config", "/filter@hydra.job.env_set: sir",
    ]  # fmt: skip
    chosen = rng.sample(entries, rng.randint(1, 3))
    lines = "\n".join(f"  - {entry}" for entry in chosen)
    group = rng.choice(["train", "experiment"])
    write(
        f"{group}/mine",
        f"{rng.choice(['', '# @package _global_' + chr(10)])}defaults:\n{lines}\n{harmful(rng)}",
    )
    write(
        rng.choice([f"{group}/other", "noise/other", "hydra/callbacks/other"]),
        rng.choice(["", headed(rng)]) + harmful(rng),
    )
    return ["+experiment=mine"] if group == "experiment" else ["train=mine"]


def write_packages(rng: random.Random, write: Write) -> list[str]:
    package = rng.choice(
        ["hydra", "hydra.job", "_global_", "_global_.hydra.job", "hydra.job.env_set", "a", "_here_"]
    )
    name = rng.choice(["other", "/noise/outliers", "/train/vsmc"])
    write("train/mine", f"defaults:\n  - {name}@{package}\n  - _self_\na: 1\n")
    write("train/other", harmful(rng))
    return ["train=mine"]


def write_links(rng: random.Random, write: Write) -> list[str]:
    write("../outside/noise/far", NOISE)
    write("noise/near", NOISE)
    target, place = rng.choice([
        ("../../outside/noise/far.yaml", "noise/mine.yaml"), ("near.yaml", "noise/mine.yaml"),
        ("../outside/noise", "train"), ("/dev/zero", "noise/mine.yaml"), ("/etc/hostname", "noise/mine.yaml"),
        ("mine.yaml", "noise/mine.yaml"), ("nowhere", "noise/mine.yaml"),
    ])  # fmt: skip
    write(f"LINK {place}", target)
    return ["train=far"] if place == "train" else ["noise=mine"]


def write_interpolations(rng: random.Random, write: Write) -> list[str]:
    inner = rng.choice(["oc.env:FUZZ_SECRET", "data.root", "noise.b", ".b", "..data.root", "hydra:runtime.cwd", "oc.select:data.root",
                        "oc.select:'data.root'", "oc.dict.values:data", "oc.decode:a", "oc.create:'{a: 1}'", "results_dir", "data", "noise.c.root",
                        "oc.env:NOPE,${oc.env:FUZZ_SECRET}", "hydra.runtime.cwd", "oc.dict.keys:noise.c", "${noise.b}", "runs"])  # fmt: skip
    text = rng.choice(
        [
            "${%s}",
            "a ${%s} b",
            "\\${%s}",
            "\\\\${%s}",
            "${ %s }",
            "$${%s}",
            "${%s}${%s}",
            "${${%s}}",
        ]
    ).replace("%s", inner)
    content = f"{NOISE}a: {text!r}\nb: {rng.choice(['data.root', 'oc.env:FUZZ_SECRET', '${data.root}', '1'])}\nc: {{root: '${{data.root}}'}}\n"
    write("noise/mine", content)
    return ["noise=mine"]


def write_config_dir(rng: random.Random, write: Write) -> list[str]:
    group = rng.choice(["experiment", "train"])
    write(f"{group}/mine", rng.choice(["", headed(rng)]) + harmful(rng))
    flag = rng.choice(
        [["--config-dir=FOLDER"], ["--config-dir", "FOLDER"], ["-cd", "FOLDER"], ["-cd=FOLDER"]]
    )
    return [*flag, f"{'+' if group == 'experiment' else ''}{group}=mine"]


def write_search_path(rng: random.Random, write: Write) -> list[str]:
    header = rng.choice(["# @package _global_\n", headed(rng), ""])
    group = rng.choice(["experiment", "train"])
    key = rng.choice(
        ["hydra: {searchpath: [ENTRY]}", "hydra.searchpath: [ENTRY]", "searchpath: [ENTRY]"]
    )
    write(
        f"{group}/mine",
        header
        + key.replace("ENTRY", rng.choice(["file://OTHER", "pkg://os", "structured://os"]))
        + rng.choice(["", *3 * [f"\n{harmful(rng)}"]]),
    )
    write("../outside/report/far", harmful(rng))
    return [
        "+experiment=mine" if group == "experiment" else "train=mine",
        *rng.choice([[], [], ["report=far"]]),
    ]


def write_sweeps(rng: random.Random, write: Write) -> list[str]:
    entry = rng.choice([
        "runs: 2,3", "filter: ekf,sir", "hydra.run.dir: NEW", "results_dir: NEW", "+noise@hydra.job: outliers", "runs: ${q}",
        "scenario: '{folder: NEW}'", "+a: '{_target_: os.system}'", "+a._target_: os.system", "noise: nominal,bad", "+data.root: NEW",
        "++episode_cache_dir: NEW", "hydra/launcher: cores,slurm", "runs: range(1,1000000000)", "~hydra.run: null", "runs: glob(*)",
        "+a: '\"${oc.env:FUZZ_SECRET}\"'", "noise: ../noise/bad", "study: ../x,b", "++hydra: {a: 1}", "'+scenario.cache_dir': NEW,b",
        "runs: [2, 3]", "'data': '{root: NEW}'", "seed: 'choice(1,2)'", "overwrite: true,false", "noise: bad",
    ])  # fmt: skip
    write(
        "experiment/mine", f"# @package _global_\nhydra:\n  sweeper:\n    params:\n      {entry}\n"
    )
    write("noise/bad", rng.choice([headed(rng), "# @package _global_\n"]) + harmful(rng))
    return [*rng.choice([["-m"], []]), "+experiment=mine"]


def write_aliases(rng: random.Random, write: Write) -> list[str]:
    many = "".join(f"a{i + 1}: &a{i + 1} [*a{i}, *a{i}]\n" for i in range(rng.choice([3, 10, 40])))
    form = rng.choice([
        "x: &x {run: {dir: NEW}}\nhydra: *x\n", "x: &x {hydra: {mode: RUN}}\n<<: *x\n", f"a0: &a0 [x]\n{many}",
        "a: &a [*a]\n", "x: &x {data: {root: NEW}}\n<<: [*x, {a: 1}]\n", "a: &x ${oc.env:FUZZ_SECRET}\nb: *x\n",
        "? *x\n: 1\n", "a: &x 1\nb: &x 2\nc: *x\n", "a: &k _target_\nb: {*k : os.system}\n",
    ])  # fmt: skip
    write("train/mine", rng.choice(["# @package _global_\n", ""]) + form)
    return ["train=mine"]


def write_tags(rng: random.Random, write: Write) -> list[str]:
    tag = rng.choice(["!!python/object/apply:os.system ['touch NEW']", "!!python/name:os.system", "!!python/object/new:os.system [a]",
                      "!!python/object/apply:pathlib.Path [NEW]", "!!binary aGVsbG8=", "!!set {a, b}", "!!omap [a: 1]", "!x 1",
                      "!!timestamp 2020-01-01", "!!float 1", "!!str 1", "!!python/module:os"])  # fmt: skip
    write("noise/mine", f"{NOISE}a: {tag}\n")
    return ["noise=mine"]


def write_large(rng: random.Random, write: Write) -> list[str]:
    depth = rng.choice([20, 39, 45, 300])
    content = rng.choice([
        "a: " + "[" * depth + "]" * depth, "a: [" + "1," * rng.choice([100, 11_000]) + "]", "a: '" + "x" * 12_000 + "'",
        "b0: xxxxxxxx\n" + "".join(f"b{i + 1}: ${{noise.b{i}}}${{noise.b{i}}}\n" for i in range(rng.choice([3, 30]))),
        "b0: [1]\n" + "".join(f"b{i + 1}: ['${{noise.b{i}}}', '${{noise.b{i}}}']\n" for i in range(rng.choice([3, 30]))),
        "a: '" + "${" * 200 + "b" + "}" * 200 + "'", "a: " + "1:1" * 5000, "#" * 1_100_000, "defaults: [" + "mine," * 2 + "]",
        "defaults: [" + ",".join(f"{{/filter@a{i}: sir}}" for i in range(400)) + "]", "a: " + "{b: " * depth + "1" + "}" * depth,
    ])  # fmt: skip
    write("noise/mine", f"{NOISE}{content}\n")
    return ["noise=mine"]


def write_pipes(rng: random.Random, write: Write) -> list[str]:
    write(
        rng.choice(
            ["PIPE noise/mine.yaml", "PIPE noise", "PIPE config.yaml", "PIPE noise/other.yaml"]
        ),
        "",
    )
    return ["noise=mine"]


def write_names(rng: random.Random, write: Write) -> list[str]:
    name = rng.choice(
        ["a.b", "a.yaml", ".hidden", "a b", "ä", "..", "a..b", "-x", "config", "a.b.c", "x=1", "1"]
    )
    write(f"train/{name}", rng.choice(["", headed(rng)]) + harmful(rng))
    return [
        f"train={rng.choice([name, name + '.yaml', './' + name, '../train/' + name, '/train/' + name])}"
    ]


def write_experiments(rng: random.Random, write: Write) -> list[str]:
    text = rng.choice(["# @package _global_\n", headed(rng), ""]) + harmful(rng)
    write(
        "experiment/mine",
        text
        + f"\n{rng.choice(['study: mine', 'study: ../x', 'study: ${nope}', 'study: ${oc.env:HOME}', 'runs: 3'])}\n",
    )
    return [
        *rng.choice([["-m"], []]),
        "+experiment=mine",
        *rng.choice([[], ["hydra/launcher=cores"], ["noise=outliers"]]),
    ]


def write_groups_of_hydra(rng: random.Random, write: Write) -> list[str]:
    group = rng.choice(
        ["launcher", "sweeper", "job_logging", "callbacks", "output", "help", "env", "mine"]
    )
    name = rng.choice(["mine", "basic", "default", "cores"])
    write(f"hydra/{group}/{name}", rng.choice(["", headed(rng)]) + harmful(rng))
    write(rng.choice(["hydra/config", "config", "noise/x"]), harmful(rng))
    word = [f"+hydra/{group}=mine"] if group in ("callbacks", "mine") else [f"hydra/{group}={name}"]
    return rng.choice([word, []])


def write_same_names(rng: random.Random, write: Write) -> list[str]:
    place = rng.choice(
        [
            "noise/nominal",
            "experiment/quickstart",
            "filter/ekf",
            "config",
            "model/linear_walk",
            "hydra/launcher/cores",
        ]
    )
    write(place, NOISE)
    group, _, name = place.rpartition("/")
    return [f"{'+' if group == 'experiment' else ''}{group}={name}"] if group else []


def write_data(rng: random.Random, write: Write) -> list[str]:
    key = rng.choice(
        ["root", "folder", "cache_dir", "checkpoint", "checkpoint_path", "a: {b: [{root", "data"]
    )
    value = rng.choice(
        [
            "NEW",
            "/etc",
            "~",
            "${data.root}",
            "${episode_cache_dir}",
            "../x",
            "null",
            "[NEW]",
            "${data.root}/..",
            "${results_dir}/a/../b",
        ]
    )
    closing = "}]}" if "{" in key else ""
    header = rng.choice(["", "# @package scenario\n", headed(rng)])
    write("train/mine", f"{header}{key}: {value}{closing}\n")
    return ["train=mine"]


KINDS: dict[str, Callable[[random.Random, Write], list[str]]] = {
    name.removeprefix("write_"): function
    for name, function in globals().items()
    if name.startswith("write_")
}


class Folder:
    """A search path in a temporary folder.

    Attributes:
        path: The search path.
        home: Folder that holds it, and where the files to be found would appear.
    """

    def __init__(self, home: Path) -> None:
        self.home, self.path = home, home / "conf"
        self.path.mkdir()

    def write(self, place: str, text: str) -> None:
        """Write a file, `LINK PLACE` to a target, or a `PIPE PLACE`."""
        kind, _, name = (
            place.partition(" ") if place.startswith(("LINK ", "PIPE ")) else ("", "", place)
        )
        path = self.path / (name if kind else f"{name}.yaml")
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() or path.is_symlink():
            return
        if kind == "LINK":
            path.symlink_to(text)
        elif kind == "PIPE":
            os.mkfifo(path)
        else:
            text = text.replace("NEW", f"{self.home / 'new'}").replace(
                "OTHER", f"{self.home / 'outside'}"
            )
            path.write_bytes(text.encode("utf-8", "surrogatepass"))

    def list(self) -> list[Path]:
        return sorted(self.home.rglob("*"))


class HangError(Exception):
    """A folder took longer than the limit."""


@contextmanager
def limited() -> Iterator[None]:
    """Raise after 10 s of computing, or six times as long of waiting on a shared machine."""

    def stop(_: int, frame: FrameType | None) -> None:
        if frame is None or frame.f_code.co_name != "gc_callback":  # Python ignores what it raises
            raise HangError

    timers = (
        (signal.SIGPROF, signal.ITIMER_PROF, LIMIT_S),
        (signal.SIGALRM, signal.ITIMER_REAL, 6 * LIMIT_S),
    )
    old = [signal.signal(name, stop) for name, _, _ in timers]
    for _, timer, seconds in timers:
        signal.setitimer(timer, seconds, 0.1)
    try:
        yield
    finally:
        for (name, timer, _), handler in zip(timers, old, strict=True):
            signal.setitimer(timer, 0)
            signal.signal(name, handler)


def compose_alone(words: Sequence[str]) -> tuple[Any, set[str]]:
    """Compose by Hydra without checks; return the tree and the names of all files that it loaded."""
    loaded: set[str] = set()
    load = ConfigRepository.load_config

    def trace(self: ConfigRepository, config_path: str) -> Any:
        loaded.add(config_path)
        return load(self, config_path)

    version.setbase("1.3")
    job.register_experiments()
    with mock.patch.object(ConfigRepository, "load_config", trace):
        hydra = Hydra("app", ConfigLoaderImpl(create_config_search_path(str(job.conf_dir()))))
        return hydra.compose_config("config", list(words), RunMode.RUN, from_shell=False), loaded


def find_faults(words: Sequence[str], folder: Path, checked: set[Path]) -> str:
    """Return what is wrong with an accepted composition, by Hydra's own one; empty if nothing is."""
    tree, loaded = compose_alone(words)
    for name in loaded:
        file = folder / f"{name.removesuffix('.yaml')}.yaml"
        if file.is_symlink() or file.parent.is_symlink():
            return f"a link: {file}"
        if (
            file.exists() and file.resolve() not in checked
        ):  # ignored, since pfbench has one of this name, or not checked
            return f"unchecked file: {file}"
    values: Any = OmegaConf.to_container(tree, resolve=False)
    launcher = tree.hydra.runtime.choices["hydra/launcher"]
    settings = [word for word in words if word.startswith("hydra") and "searchpath" not in word]
    words = [*WALK, *settings, f"hydra/launcher={launcher}"]
    try:
        base: Any = OmegaConf.to_container(compose_alone(words)[0], resolve=False)
    except HydraException:
        return "a setting of hydra lies in the folder"
    for content in (values, base):
        for key in ("overrides", "runtime", "searchpath"):
            del content["hydra"][key]
        del content["hydra"]["job"]["override_dirname"]
        content["hydra"]["sweeper"].pop("params", None)
    changed = (key for key in ("hydra", *USER_KEYS) if values.get(key) != base.get(key))
    return next((f"{key} was set: {values.get(key)!r:.200}" for key in changed), "")


def find_leaks(node: Any, path: tuple[Any, ...] = ()) -> str:
    """Return a secret or a class that is not public in resolved values; empty if there is none."""
    if isinstance(node, dict):
        for key, value in node.items():
            if key == "_target_" and not _is_public(str(value)):
                return f"the class {value} at {path}"
            if found := find_leaks(value, (*path, key)):
                return found
    elif isinstance(node, list):
        return next(
            filter(None, (find_leaks(value, (*path, i)) for i, value in enumerate(node))), ""
        )
    elif isinstance(node, str) and {*path} & {*PATH_KEYS, *USER_KEYS}:
        if node not in PLACES and not re.fullmatch(r"results/[\w-]+(/[\w-]+)*\.pt", node):
            return f"a path at {path}: {node}"
    elif isinstance(node, str) and SECRET in node:
        return f"a secret at {path}"
    return ""


def _is_public(name: str) -> bool:
    parts = name.split(".")
    return (
        len(parts) == 3
        and parts[0] == "pfbench"
        and parts[2] in import_module(f"pfbench.{parts[1]}").__all__
    )


def accept(words: Sequence[str]) -> tuple[list[tuple[list[str], dict[str, Any]]], set[Path]]:
    """Return words and values of the jobs that pfbench accepts, and the files that it checked.

    Raises:
        Exception: If it accepts no job.
    """
    checked: set[Path] = set()
    check = shared_loader.check_content

    def trace(file: Path, *rest: Any, **options: Any) -> None:
        checked.add(file.resolve())
        check(file, *rest, **options)

    with mock.patch.object(shared_loader, "check_content", trace):
        given = sorted(
            replace_config_dir(words), key=lambda word: word != "-m"
        )  # as the command does
        check_words(given)
        overrides = [word for word in given if not word.startswith("-")]
        jobs = [overrides]
        if "-m" in given:
            params = compose_tree(overrides).hydra.sweeper.params or {}
            swept = expand_sweep([*(f"{k}={v}" for k, v in params.items()), *overrides])
            jobs = [
                [options[min(place, len(options) - 1)] for options in swept] for place in range(2)
            ]
        return [(some, job.compose(some).values) for some in jobs], checked


def attempt(kind: str, seed: int) -> list[str]:
    """Try one folder and return outcome, remark and example."""
    rng = random.Random(f"{kind} {seed}")
    with tempfile.TemporaryDirectory() as home, mock.patch.dict(os.environ, ENVIRONMENT):
        folder = Folder(Path(home).resolve())
        words = [
            word.replace("FOLDER", f"{folder.path}") for word in KINDS[kind](rng, folder.write)
        ]
        if not any("config-dir" in word or "-cd" in word for word in words):
            words.append(f"hydra.searchpath=[file://{folder.path}]")
        before = folder.list()
        try:
            with limited():
                try:
                    jobs, checked = accept([*WALK, *words])
                except HangError:
                    raise
                except Exception as error:
                    return _judge_error(error, folder.list() == before)
                faults = [
                    find_faults(some, folder.path, checked) or find_leaks(values)
                    for some, values in jobs
                ]
        except HangError:
            return ["crash", f"{kind}: hangs", f"{seed} {words}"]
        if folder.list() != before:
            return ["code run", f"{kind}: a file appeared", f"{seed}"]
        if any(faults):
            return ["false", kind, f"{seed} {words}: {max(faults)}"]
        return [FINE, f"{kind}: accepted", ""]


def _judge_error(error: Exception, is_unchanged: bool) -> list[str]:
    """Return the outcome of a refusal."""
    if not is_unchanged:
        return ["code run", "a file appeared", f"{error}"]
    if isinstance(error, HydraException | OmegaConfBaseException):
        return [FINE, "refused", ""]
    if isinstance(error, (OSError, RuntimeError, MemoryError, AssertionError, IndexError)):
        return ["crash", type(error).__name__, f"{error}"]
    return [FINE, "refused", ""]


def run(count: int, seed: int) -> Tally:
    """Try some folders of each kind in turn; `seed` is the number of the batch."""
    tally = Tally("hostile folders")
    names = list(KINDS)
    for number in range(count):
        kind = names[number % len(names)]
        tally.add(*attempt(kind, seed * 100_000 + number))
    return tally
