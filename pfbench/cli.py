"""The command line: `pfbench run | report | list | check`."""

from __future__ import annotations

import difflib
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pfbench

USAGE = """\
pfbench {version}: benchmarks of particle filters in integrated navigation

  pfbench run [-m] key=value ...     run one cell, or with -m a sweep over comma-separated values
      pfbench run scenario=t003 noise=nominal filter=sir runs=100 seed=1
      pfbench run -m scenario=t003 filter=ekf,sir noise=nominal,outliers study=mine
      pfbench run -m +experiment=quickstart
  pfbench report study=NAME          figures, tables and tests of a study, as a page
  pfbench list [group]               what can be composed
  pfbench check                      composes everything; versions, threads, device, data root
"""


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point. Exit code 0 if all went well, 1 if anything failed, 2 if the command was not understood."""
    words = list(sys.argv[1:] if argv is None else argv)
    commands: dict[str, Callable[[list[str]], None]] = {"run": _run, "report": _report, "list": _list, "check": _check}
    if not words or words[0] in ("-h", "--help", "help"):
        print(USAGE.format(version=pfbench.__version__))
        return
    if words[0] not in commands:
        near = difflib.get_close_matches(words[0], commands, 1)
        print(f"pfbench: no command '{words[0]}'" + (f"; did you mean '{near[0]}'?" if near else ""), file=sys.stderr)
        print(USAGE.format(version=pfbench.__version__), file=sys.stderr)
        raise SystemExit(2)
    try:
        commands[words[0]](words[1:])
    except KeyboardInterrupt:
        print("\npfbench: stopped; finished cells are kept, the same command goes on from here", file=sys.stderr)
        raise SystemExit(130) from None
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
    sys.argv = ["pfbench run", *words]
    hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name="config")(job.run)()


def _report(words: list[str]) -> None:
    from pfbench.report.page import Options, write

    cfg = _compose(words)
    chosen = {key: tuple(value) if isinstance(value, list) else value for key, value in cfg["report"].items()}
    page = write(cfg["study"], cfg["results"], cfg["reports"], Options(**chosen))
    print(f"report: {page.resolve()}")


def _list(words: list[str]) -> None:
    groups = _groups()
    if not words:
        for group, files in groups.items():
            print(f"{group:12} {', '.join(sorted(path.stem for path in files))}")
        print("\n`pfbench list GROUP` says what each one is")
        return
    if words[0] not in groups:
        raise ValueError(f"no group '{words[0]}': there are {', '.join(groups)}")
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
                _compose([choice, "data.root=somewhere"])
                yield choice, ""
            except Exception as error:
                yield choice, explain(error, [choice])


def _compose(overrides: list[str]) -> dict[str, Any]:
    """The resolved configuration as plain dicts and lists."""
    from hydra import compose, initialize_config_dir
    from omegaconf import OmegaConf

    _offer_experiments()
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        cfg = OmegaConf.to_container(compose("config", overrides), resolve=True)
    assert isinstance(cfg, dict)
    return {str(key): value for key, value in cfg.items()}


def _offer_experiments() -> None:
    """Makes experiments/NAME.yaml known to Hydra as the group `experiment`, which lies outside conf/."""
    from hydra.core.config_store import ConfigStore
    from omegaconf import OmegaConf

    for path in experiments_dir().glob("*.yaml"):
        ConfigStore.instance().store(
            group="experiment", name=path.stem, node=OmegaConf.load(path), package="_global_", provider="pfbench.experiments"
        )


def _groups() -> dict[str, list[Path]]:
    conf = conf_dir()
    groups = {
        folder.name: sorted(folder.glob("*.yaml")) for folder in sorted(conf.iterdir()) if folder.is_dir() and any(folder.glob("*.yaml"))
    }
    return groups | {"experiment": sorted(experiments_dir().glob("*.yaml"))}


def _headline(path: Path) -> str:
    first = next((line for line in path.read_text().splitlines() if not line.startswith("# @package")), "")
    return first.removeprefix("#").strip() if first.startswith("#") else ""


def explain(error: BaseException, words: Sequence[str] = ()) -> str:
    """An error as a person wants to read it: the cause that names key and value, and the nearest key that exists."""
    cause = error
    while cause.__cause__ is not None and type(cause).__name__ in ("InstantiationException", "ConfigCompositionException"):
        cause = cause.__cause__
    text = f"{cause}".strip() or type(cause).__name__
    if cause is not error and "Could not override" in str(error):
        text = f"{error}".strip()
    missing = re.search(r"Could not override '([^']+)'", text)
    if missing:
        near = difflib.get_close_matches(missing[1], _keys(words, missing[1]), 3, 0.6)
        value = next((word.partition("=")[2] for word in words if word.lstrip("+~").startswith(missing[1] + "=")), "")
        text = f"there is no key '{missing[1]}' (given as {missing[1]}={value})"
        text += f"; did you mean {' or '.join(near)}?" if near else "; `pfbench run --cfg job` prints all keys"
    return text


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
