"""The command line: `pfbench run | train | report | list | check`."""

from __future__ import annotations

import difflib
import math
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pfbench

_EXTRAS = {"ray": "ray", "submitit": "slurm", "joblib": "launch"}  # of the package, by what stands in a launcher's name
_RETRIES = 3  # of a sweep that lost a process; Ray counts likewise

USAGE = """\
pfbench {version}: benchmarks of particle filters in integrated navigation

  pfbench run [-m] key=value ...     run one cell, or with -m a sweep over comma-separated values
      pfbench run scenario=t003 noise=nominal filter=sir runs=100 seed=1
      pfbench run -m scenario=t003 filter=ekf,sir noise=nominal,outliers study=mine
      pfbench run -m +experiment=quickstart
  pfbench train key=value ...        fits the network of a neural_* filter; the file it makes is `checkpoint=` of a run
      pfbench train filter=neural_sir scenario=passive_1 train=vsmc train.epochs=20
  pfbench report study=NAME          figures, tables and tests of a study, as a page
  pfbench report study=claims        every claim of the five papers, and what the studies say of it
  pfbench report all                 every study that has results, and the claims: what `make report` does
  pfbench report scenario=NAME       the datasheet of a scene, as a page; also: noise=NAME, runs=20
  pfbench list [group]               what can be composed
  pfbench check                      composes everything; versions, threads, device, data root
"""


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point. Exit code 0 if all went well, 1 if anything failed, 2 if the command was not understood."""
    words = list(sys.argv[1:] if argv is None else argv)
    commands: dict[str, Callable[[list[str]], None]] = {
        "run": _run, "train": _train, "report": _report, "list": _list, "check": _check
    }  # fmt: skip
    if not words or words[0] in ("-h", "--help", "help"):
        print(USAGE.format(version=pfbench.__version__))
        return
    if words[0] not in commands:
        print(f"pfbench: there is no command '{words[0]}'{_near(words[0], list(commands))}", file=sys.stderr)
        print(USAGE.format(version=pfbench.__version__), file=sys.stderr)
        raise SystemExit(2)
    try:
        commands[words[0]](words[1:])
    except KeyboardInterrupt:
        print("\npfbench: stopped; finished cells are kept, the same command goes on from here", file=sys.stderr)
        raise SystemExit(130) from None
    except BrokenPipeError:  # `pfbench list | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except Exception as error:
        if os.environ.get("PFBENCH_TRACE"):
            raise
        print(f"\npfbench {words[0]}: {explain(error, words[1:])}\n(PFBENCH_TRACE=1 shows the trace)", file=sys.stderr)
        raise SystemExit(1) from error


def conf_dir() -> Path:
    """The folder of configurations: installed as pfbench.conf, or at the top of the checkout."""
    return _folder("conf", "config.yaml")


def experiments_dir() -> Path:
    """The folder of studies: installed as pfbench.experiments, or at the top of the checkout."""
    return _folder("experiments", "quickstart.yaml")


def _folder(name: str, holds: str) -> Path:
    package = Path(pfbench.__file__).parent
    for folder in (package / name, package.parent / name):
        if (folder / holds).exists():
            return folder
    raise FileNotFoundError(f"no folder {name}/ with {holds} beside or inside {package}: reinstall pfbench")


def _run(words: list[str]) -> None:
    import hydra

    from pfbench import job

    _offer_experiments()
    os.environ["HYDRA_FULL_ERROR"] = "1"  # errors come to `main`, which explains them
    flags = [word for word in words if word in ("-m", "--multirun")]  # first, or argparse takes no key=value after them
    sys.argv = ["pfbench run", *flags, *(word for word in words if word not in flags)]
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    _again(hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name="config")(job.run))


def _again(sweep: Callable[[], Any]) -> None:
    """Runs a sweep; where joblib lost one of its processes, and with it the whole sweep, once more: what is done is done."""
    for left in reversed(range(_RETRIES + 1)):
        try:
            sweep()
            return
        except Exception as error:
            if type(error).__name__ != "TerminatedWorkerError":
                raise
            if not left:
                raise RuntimeError(
                    f"a process of the sweep was killed {_RETRIES + 1} times, as a rule for want of memory: finished cells are "
                    "kept; give fewer processes (hydra.launcher.n_jobs=2), or memory=... (GiB) for each cell"
                ) from error
            print("pfbench: a process of the sweep was killed; going on with the cells that are not done", file=sys.stderr)


def _train(words: list[str]) -> None:
    from pfbench import job, train

    if {"-m", "--multirun"} & set(words):
        raise ValueError("pfbench train fits one network at a time: leave out -m, and mix noise regimes by train.noises=[a,b]")
    cfg, choices = _composition(words)
    job.settings(cfg)
    if cfg["told"]:
        raise ValueError("told=true: a network is trained on the model itself; give told=false, and told=true when it is run")
    names = list(cfg["train"]["noises"]) or [choices["noise"]]
    regimes = {name: job.build(_compose([*words, f"noise={name}"])["noise"]) for name in names}
    path = train.fit(cfg, choices, regimes, job.build, {"versions": job.versions()}, print)
    usual = [word for word in words if not word.startswith(("train.", "train=", "fresh=", "checkpoint="))]
    print(f"checkpoint: {path.resolve()}\n  pfbench run {' '.join(usual)} checkpoint={path}")


def _report(words: list[str]) -> None:
    named = {word.lstrip("+").partition("=")[0] for word in words}
    if words[:1] == ["all"]:
        return _reports(words[1:])
    if "scenario" in named and not named & {"study", "experiment"}:
        return _datasheet(words)
    cfg = _compose(words)
    if "experiment" not in named and (experiments_dir() / f"{cfg['study']}.yaml").exists():
        cfg = _compose([f"+experiment={cfg['study']}", *words])  # a study is shown as its experiment says
    if cfg["study"] == "datasheets":
        raise ValueError("study=datasheets: there lie the datasheets of scenes; give scenario=NAME to see one, or another study")
    print(f"{'claims' if cfg['study'] == 'claims' else 'report'}: {_page(cfg).resolve()}")


def _page(cfg: dict[str, Any]) -> Path:
    """Writes the page of a study, or that of the claims."""
    from pfbench.report import ledger
    from pfbench.report.page import write
    from pfbench.report.view import Options

    chosen: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in cfg["report"].items()}
    options = Options(**chosen, planned=_planned(cfg["study"]))
    if cfg["study"] != "claims":
        return write(cfg["study"], cfg["results"], cfg["reports"], options)
    places = cfg["results"], cfg["reports"], options.alpha, conf_dir(), experiments_dir()
    return ledger.write(*places, mixed=options.mixed, formats=options.formats)


def _planned(study: str) -> int | None:
    """How many jobs the sweep of the experiment of that name has; None where there is no such experiment, or no sweep in it."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from omegaconf import OmegaConf

    path = experiments_dir() / f"{study}.yaml"
    if not path.exists():
        return None
    params = OmegaConf.select(OmegaConf.load(path), "hydra.sweeper.params")
    if params is None:
        return None
    swept = OverridesParser.create().parse_overrides([f"{name}={value}" for name, value in params.items()])
    return math.prod(len(list(one.sweep_string_iterator())) if one.is_sweep_override() else 1 for one in swept)


def _reports(words: list[str]) -> None:
    """Every study with results, as its experiment says, and the claims; what is published without results stays as it is."""
    cfg = _compose(words)
    there = {path.parent.name for path in Path(cfg["results"]).glob("*/*.npz")} - {"datasheets"}
    pages = {path.parent.name for name in ("report.md", "index.html") for path in Path(cfg["reports"]).glob(f"*/{name}")}
    published = pages - {"datasheets", "claims"}
    missing, failed = sorted(published - there), []
    for study in sorted(there):
        chosen = f"+experiment={study}" if (experiments_dir() / f"{study}.yaml").exists() else f"study={study}"
        try:
            print(f"{study}: {_page(_compose([chosen, *words])).resolve()}")
        except Exception as error:
            failed.append(study)
            print(f"{study}: failed: {explain(error, words)}", file=sys.stderr)
    for study in missing:
        print(
            f"{study}: its report is published and stays as it is, for {cfg['results']} has no results of it; make them with: "
            f"pfbench run -m +experiment={study}"
        )
    from pfbench.report import claims

    asked = {study for claim in claims.load() for study in claim.studies}
    if lacking := sorted((asked if "claims" in pages else asked & published) - there | asked & set(failed)):
        print(f"claims: the ledger stays as it is, for it needs the results of {', '.join(lacking)} too")
    else:
        print(f"claims: {_page(_compose(['study=claims', *words])).resolve()}")
    if failed:
        raise ValueError(f"{len(failed)} of {len(there)} reports failed: {', '.join(failed)}; what each said is above")


def _datasheet(words: list[str]) -> None:
    """The page of one scene, of `survey.RUNS` runs unless the words say how many."""
    from pfbench import survey
    from pfbench.report.datasheet import write

    few = [] if any(word.startswith("runs=") for word in words) else [f"runs={survey.RUNS}"]
    cfg, choices = _composition([*words, *few])
    own = conf_dir() / "scenario" / f"{choices['scenario']}.yaml"
    file = survey.survey(cfg, choices, _headline(own) if own.exists() else "")
    page = write(file, cfg["reports"], tuple(cfg["report"]["formats"]))
    print(f"datasheet: {page.resolve()}")


def _list(words: list[str]) -> None:
    groups = _groups()
    if not words:
        for group, files in groups.items():
            print(f"{group:12} {', '.join(sorted(path.stem for path in files))}")
        print("\n`pfbench list GROUP` says what each one is")
        return
    if words[0] not in groups:
        raise ValueError(f"there is no group '{words[0]}'{_near(words[0], list(groups), '.')} There are {', '.join(groups)}")
    for path in sorted(groups[words[0]]):
        print(f"{path.stem:24} {_headline(path)}")


def _check(words: list[str]) -> None:
    import torch

    from pfbench import job

    for name, value in job.versions().items():
        print(f"{name:10} {value}")
    print(f"threads    {torch.get_num_threads()} of {os.cpu_count()} cores")
    print(f"device     {torch.cuda.get_device_name() if torch.cuda.is_available() else 'cpu (no CUDA device)'}")
    root = _compose([])["data"]["root"]
    print(f"data root  {root or 'not set: recorded scenarios need PFBENCH_DATA or data.root=...'}")
    failed = [f"{what}: {error}" for what, error in _composed() if error]
    total = sum(len(files) for files in _groups().values())
    print(f"composed   {total - len(failed)} of {total} configurations")
    if failed:
        raise ValueError("these do not compose:\n  " + "\n  ".join(failed))


def _composed() -> Iterator[tuple[str, str]]:
    for group, files in _groups().items():
        for path in files:
            choice = f"+experiment={path.stem}" if group == "experiment" else f"{group}={path.stem}"
            try:
                _compose([choice, *_home(group, path.stem), "data.root=somewhere"])
                yield choice, ""
            except Exception as error:
                yield choice, explain(error, [choice])


def _home(group: str, name: str) -> list[str]:
    """The scenario that asks for this model, or for one whose name it extends; a model may take its numbers from there."""
    if group != "model":
        return []
    parts = name.split("_")
    for known in ("_".join(parts[:n]) for n in range(len(parts), 0, -1)):
        asks = f"/model@_global_.model: {known}\n"
        found = [f"scenario={path.stem}" for path in _groups()["scenario"] if asks in path.read_text()]
        if found:
            return found[:1]
    return []


def _compose(overrides: list[str]) -> dict[str, Any]:
    """The resolved configuration as plain dicts and lists."""
    return _composition(overrides)[0]


def _composition(overrides: list[str]) -> tuple[dict[str, Any], dict[str, str]]:
    """The same, and the names of what was chosen in each group."""
    from hydra import compose, initialize_config_dir
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import OmegaConf, open_dict

    _offer_experiments()
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        composed = compose("config", overrides, return_hydra_config=True)
    HydraConfig.instance().set_config(composed)  # an experiment may look up what was chosen
    choices = {str(group): str(name) for group, name in composed.hydra.runtime.choices.items()}
    with open_dict(composed):
        del composed["hydra"]
    cfg = OmegaConf.to_container(composed, resolve=True)
    assert isinstance(cfg, dict)
    return {str(key): value for key, value in cfg.items()}, choices


_offered: dict[str, tuple[Path, int]] = {}  # experiments that Hydra has been given, and when each was written


def _offer_experiments() -> None:
    """Makes experiments/NAME.yaml known to Hydra as the group `experiment`, which lies outside conf/.

    Reading them all takes as long as composing, so those that Hydra has are left.
    """
    from hydra.core.config_store import ConfigStore
    from omegaconf import OmegaConf

    known = ConfigStore.instance().repo.get("experiment", {})
    for path in experiments_dir().glob("*.yaml"):
        written = path, path.stat().st_mtime_ns
        if _offered.get(path.stem) != written or path.name not in known:
            ConfigStore.instance().store(
                group="experiment", name=path.stem, node=OmegaConf.load(path), package="_global_", provider="pfbench.experiments"
            )
            _offered[path.stem] = written


def _groups() -> dict[str, list[Path]]:
    conf = conf_dir()
    folders = [folder for folder in sorted(conf.iterdir()) if any(folder.glob("*.yaml"))]
    groups = {folder.name: sorted(folder.glob("*.yaml")) for folder in folders}
    return groups | {"experiment": sorted(experiments_dir().glob("*.yaml"))}


def _headline(path: Path) -> str:
    first = next((line for line in path.read_text().splitlines() if not line.startswith("# @package")), "")
    return first.removeprefix("#").strip() if first.startswith("#") else ""


def explain(error: BaseException, words: Sequence[str] = ()) -> str:
    """An error as a person wants to read it: the key and the value that were given, and what to give instead."""
    if type(error).__name__ == "InstantiationException" and error.__cause__ is not None:
        return _refused(f"{error}", error.__cause__, words)
    text = f"{error}".strip() or type(error).__name__
    if found := re.search(r"Could not override '([^']+)'", text):
        return _no_key(found[1], words)
    if found := re.search(r"[Cc]ould not (?:find|load) 'hydra/launcher/(ray|submitit|joblib)", text):
        chosen = next((word for word in words if word.startswith("hydra/launcher=")), "hydra/launcher")
        return f'{chosen}: its launcher is not installed; pip install "pfbench[{_EXTRAS[found[1]]}]"'
    if found := re.search(r"Could not find '(.+)/([^/']*)'", text):
        options = re.findall(r"^\t(\w+)$", text, re.M)
        return f"{found[1]}={found[2]}: there is no such {found[1]}{_near(found[2], options, '.')} There are {', '.join(options)}"
    if found := re.search(r"Interpolation key '([^']+)' not found\s+full_key: (\S+)", text):
        remedy = f"give {found[2]}=..., or choose a {found[1].partition('.')[0]} that has it"
        return f"{found[2]} comes from {found[1]}, which is not there: {remedy}"
    if found := re.search(r"Missing mandatory value: (\S+)", text):
        return f"{found[1]} is not set: give {found[1]}=..."
    if found := re.search(r"Error parsing override '([^']*)'", text):
        return f"'{found[1]}' is not understood: give key=value, in quotes where the shell would read brackets or spaces itself"
    return text


def _refused(text: str, cause: BaseException, words: Sequence[str]) -> str:
    """What a class of ours or of a library said to the values of its yaml, under the name of the key that was given."""
    place = re.search(r"full_key: (\S+)", text)
    key = place[1] if place else "configuration"
    said = " ".join(f"{cause}".split())
    if unknown := re.search(r"got an unexpected keyword argument '(\w+)'", said):
        return _no_key(f"{key}.{unknown[1]}", words)
    if type(cause) is not ValueError:
        below = [word for word in words if word.lstrip("+").startswith(f"{key}.")]
        return f"{key}: its values do not fit ({type(cause).__name__}: {said}); check {' '.join(below) or 'its yaml'}"
    named = re.match(r"(?:\w+\.)*(\w+)(?=[=:])", said)
    if named is None:
        return f"{key}: {said}"
    given = [name for name in (word.lstrip("+").partition("=")[0] for word in words) if name.endswith(f".{named[1]}")]
    full = min(given, key=lambda name: not name.startswith(key), default=f"{key}.{named[1]}")
    return full + said[named.end() :]


def _no_key(wrong: str, words: Sequence[str]) -> str:
    given = next((word for word in words if word.lstrip("+~").startswith(f"{wrong}=")), wrong)
    keys = _keys(words, wrong)
    if wrong in keys and {"-m", "--multirun"} & set(words):
        return f"{given}: not every cell of this sweep has the key '{wrong}'; sweep those that have it apart"
    others = [key for key in keys if key != wrong]
    return f"{given}: there is no key '{wrong}'" + _near(wrong, others, "; `pfbench run --cfg job` prints all keys")


def _near(wrong: str, options: Sequence[str], otherwise: str = "") -> str:
    """The options, keys with dots or names without, that are nearest to a misspelt one, as a question."""

    def alike(a: str, b: str) -> float:
        return difflib.SequenceMatcher(None, a, b).ratio()

    def last(key: str) -> str:
        return key.rpartition(".")[2]

    near = {option: alike(option, wrong) for option in options if alike(last(option), last(wrong)) >= 0.6}
    best = [option for option, likeness in near.items() if likeness > max(near.values()) - 0.1]
    return f"; did you mean {' or '.join(best[:3])}?" if best else otherwise


def _keys(words: Sequence[str], wrong: str) -> list[str]:
    """Dotted keys of the configuration that the other words compose."""
    others = [word for word in words if "=" in word and wrong not in word and "," not in word]
    try:
        return list(_dotted(_compose([word for word in others if not word.startswith("hydra")])))
    except Exception:  # a second mistake: no suggestion rather than a confusing one
        return []


def _dotted(node: Any, path: str = "") -> Iterator[str]:
    if path:
        yield path
    if isinstance(node, dict):
        for key, value in node.items():
            yield from _dotted(value, f"{path}.{key}" if path else str(key))
