"""Hostile configuration files, and a check that a command changes nothing because of them."""

from pathlib import Path
from typing import Any

import yaml
from command_line import pfbench

CANARY = "CANARY"  # replaced by the path of a file that must not change
NEW = "NEWFILE"  # replaced by the path of a file that must not appear


def call(target: str, *args: Any, **more: Any) -> dict[str, Any]:
    return {"_target_": target, **({"_args_": list(args)} if args else {}), **more}


NODES: dict[str, Any] = {  # nodes that ran code, wrote or deleted files, or would
    "path_write": call("pathlib.Path.write_text", call("pathlib.Path", NEW), "x"),
    "path_unlink": call("pathlib.Path.unlink", call("pathlib.Path", CANARY)),
    "os_system": call("os.system", f"touch {NEW}"),
    "posix_system": call("posix.system", f"touch {NEW}"),
    "os_remove": call("os.remove", CANARY),
    "popen": call("subprocess.Popen", ["touch", NEW]),
    "run": call("subprocess.run", ["touch", NEW]),
    "rmtree": call("shutil.rmtree", f"{CANARY}.folder"),
    "copy": call("shutil.copy", CANARY, NEW),
    "eval": call("builtins.eval", f"open({NEW!r}, 'w')"),
    "exec": call("builtins.exec", f"open({NEW!r}, 'w')"),
    "open": call("builtins.open", NEW, "w"),
    "import": call("importlib.import_module", "antigravity"),
    "sympify": call("sympy.sympify", f"open({NEW!r}, 'w')"),
    "sympy_parser": call("sympy.parsing.sympy_parser.parse_expr", f"open({NEW!r}, 'w')"),
    "read_pickle": call("pandas.read_pickle", CANARY),
    "pandas_eval": call("pandas.eval", f"@pd.io.common.os.system('touch {NEW}')"),
    "torch_load": call("torch.load", CANARY, weights_only=False),
    "numpy_load": call("numpy.load", CANARY, allow_pickle=True),
    "numpy_save": call("numpy.save", NEW, [1]),
    "load_library": call("torch.ops.load_library", CANARY),
    "torch_save": call("torch.save", [1], NEW),
    "cpp_extension": call("torch.utils.cpp_extension.load", "x", [CANARY]),
    "joblib_load": call("joblib.load", CANARY),
    "pickle_loads": call("pickle.loads", "x"),
    "yaml_load": call("yaml.unsafe_load", f"!!python/object/apply:os.system ['touch {NEW}']"),
    "hydra_call": call("hydra.utils.call", {"_target_": "os.system"}),
    "hydra_get": call("hydra.utils.get_method", path="os.system"),
    "partial": call("os.system", _partial_=True),
    "functools": call("functools.partial", call("os.system", f"touch {NEW}")),
    "exit": call("sys.exit", 0),
    "environment": call("os.putenv", "PFBENCH_TRUST", "os"),
    "atexit": call("atexit.register", call("os.system", f"touch {NEW}", _partial_=True)),
    "own_store": call("pfbench.results.store.write_result", NEW, {}, {}),
    "own_command": call("pfbench.cli.main.main", ["report", "study=adhoc"]),
    "own_job": call("pfbench.job.run", {}),
    "own_instantiate": call("pfbench.job.plan.hydra.utils.call", {}),
    "own_module": call("pfbench.job.plan.torch.load", CANARY),
    "own_train": call("pfbench.learn.train", NEW),
    "private": call("pfbench.filter.__getattr__", "ParticleFilter"),
    "attribute_of_class": call("pfbench.filter.ParticleFilter.__init__.__globals__.get", "os"),
    "spaces": call("os.system ", f"touch {NEW}"),
    "no_text": {"_target_": ["os.system"]},
    "unknown_key": {"_target_": "pfbench.noise.NominalNoise", "_call_": "os.system"},
    "escaped": "\\${oc.create:'{_target_: os.system, command: x}'}",
    "from_text": "${oc.create:'{_target_: os.system, command: touch " + NEW + "}'}",
}
FILES: dict[str, tuple[str, str]] = {  # group and text of whole files
    "results": ("noise", "# @package _global_\nresults_dir: NEWFILE\n"),
    "reports": ("noise", "# @package _global_\nreports_dir: NEWFILE\n"),
    "episodes": ("noise", "# @package _global_\nepisode_cache_dir: NEWFILE\n"),
    "study": ("noise", "# @package _global_\nstudy: ../../outside\n"),
    "absolute_study": ("noise", "# @package _global_\nstudy: NEWFILE\n"),
    "trust": ("noise", "# @package _global_\ntrust: [os]\n"),
    "checkpoint": ("train", "# @package _global_\ntrain:\n  checkpoint_path: NEWFILE\n"),
    "checkpoint_above": (
        "train",
        "# @package _global_\ntrain:\n  checkpoint_path: ${results_dir}/../../network.pt\n",
    ),
    "run_folder": ("noise", "# @package _global_\nhydra:\n  run:\n    dir: NEWFILE\n"),
    "sweep_folder": ("noise", "# @package _global_\nhydra:\n  sweep:\n    dir: NEWFILE\n"),
    "output": ("noise", "# @package _global_\nhydra:\n  output_subdir: NEWFILE\n"),
    "callbacks": (
        "noise",
        "# @package _global_\nhydra:\n  callbacks:\n    a: {_target_: os.system, command: touch NEWFILE}\n",
    ),
    "launcher": ("noise", "# @package _global_\nhydra:\n  launcher:\n    _target_: os.system\n"),
    "logging": (
        "noise",
        "# @package _global_\nhydra:\n  job_logging:\n    handlers:\n      console:\n"
        "        (): os.system\n        command: touch NEWFILE\n",
    ),
    "log_file": (
        "noise",
        "# @package _global_\nhydra:\n  job_logging:\n    handlers:\n      console:\n"
        "        class: logging.FileHandler\n        filename: NEWFILE\n",
    ),
    "env_set": (
        "noise",
        "# @package _global_\nhydra:\n  job:\n    env_set:\n      PFBENCH_TRUST: sympy.core\n",
    ),
    "study_of_hydra": (
        "experiment",
        "# @package _global_\nstudy: ${hydra:job.name}\nhydra:\n  callbacks:\n"
        "    a: {_target_: joblib.load, filename: CANARY}\n",
    ),
    "study_unknown": (
        "experiment",
        "# @package _global_\nstudy: ${nope}\nhydra:\n  job:\n    env_set: {PATH: NEWFILE}\n",
    ),
    "positional": (
        "scenario",
        "_target_: pfbench.scenario.SimulatedFlight\n"
        "_args_: [trajectory, imu, receiver, initial_errors, 100.0, 1.0, NEWFILE]\n",
    ),
    "nested_cache": (
        "scenario",
        "_target_: pfbench.scenario.ModelSimulation\nmodel: {a: {cache_dir: NEWFILE}}\n",
    ),
    "choice": (
        "experiment",
        "# @package _global_\ndefaults:\n  - override /noise: ../../../../../../../../../NEWFILE\n",
    ),
    "default_by_value": (
        "noise",
        "defaults:\n  - /filter@_global_.hydra.job: x_${filter}\n",
    ),
    "default_by_time": ("noise", "defaults:\n  - /train: t${now:%S}\n"),
    "swept_package": (
        "experiment",
        "# @package _global_\nhydra:\n  sweeper:\n    params:\n      +noise@hydra.job: outliers\n",
    ),
    "swept_value": (
        "experiment",
        "# @package _global_\nq: 1\nhydra:\n  sweeper:\n    params:\n      runs: ${q}\n",
    ),
    "launcher_file": (
        "hydra/launcher",
        "# @package _global_\nhydra:\n  job:\n    env_set: {PATH: NEWFILE}\n",
    ),
    "sweeper": (
        "experiment",
        "# @package _global_\nhydra:\n  sweeper:\n    params:\n      episode_cache_dir: NEWFILE\n",
    ),
    "swept_launcher": (
        "experiment",
        "# @package _global_\nhydra:\n  sweeper:\n    params:\n      hydra.run.dir: NEWFILE\n",
    ),
    "setup": (
        "experiment",
        "# @package _global_\ndefaults:\n  - override /hydra/launcher: slurm\n"
        "hydra:\n  launcher:\n    setup: [touch NEWFILE]\n",
    ),
}
GROUPS = ("noise", "scenario", "filter", "model", "train")
COMMANDS = ("run", "datasheet", "report", "train", "run -m", "claims")


def text_of(node: Any) -> str:
    """A file whose class is honest and whose parameter is the node."""
    return yaml.safe_dump({"_target_": "pfbench.noise.NominalNoise", "sd_factor": node})


def try_file(folder: Path, group: str, text: str, command: str) -> Any:
    """Run a command with a file; return what it said, after checking that nothing changed."""
    canary, new = folder / "canary.txt", folder / "new"
    canary.write_text("kept")
    (folder / "canary.txt.folder").mkdir()
    (folder / "conf" / group).mkdir(parents=True)
    text = text.replace(CANARY, str(canary)).replace(NEW, str(new))
    (folder / "conf" / group / "hostile.yaml").write_text(text)
    before = sorted(folder.rglob("*"))
    plus = "+" if group == "experiment" else ""
    said = pfbench(
        *command.split(), f"hydra.searchpath=[file://{folder / 'conf'}]", "scenario=linear_walk",
        *(["filter=neural_sir"] if command == "train" else []), f"{plus}{group}=hostile",
        *(["study=adhoc"] if command in ("report", "claims") else []),
        "runs=2", "results_dir=results", "reports_dir=reports",
        home=folder,
    )  # fmt: skip
    after = {path for path in folder.rglob("*") if path.relative_to(folder).parts[0] != "results"}
    assert after <= set(before)
    assert canary.read_text() == "kept"
    assert (folder / "canary.txt.folder").is_dir()
    return said
