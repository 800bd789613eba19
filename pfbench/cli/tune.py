"""Commands that prepare filters for a world.

Command `pfbench tune`: tune the baselines of a study of robustness alike.
Command `pfbench train`: train the network of a neural_* filter or of kalman_net.
"""

from __future__ import annotations

import math
import re
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pfbench.cli.command import Command, Option, in_range, read_list
from pfbench.cli.compose import given_keys
from pfbench.core.parameter_checks import require
from pfbench.job.config import TUNED_METHODS, compose
from pfbench.job.tuned_knobs import AUTO, NOMINAL, SEED_SHIFT
from pfbench.results.paper_block import conf_dir, read_families

if TYPE_CHECKING:
    from pfbench.job.tuning import CandidateSearch, TuningResult

CONTROL = "ekf_scaled"  # without which no filter is the best of a world
_RUNS = Option("20", "", in_range("whole [2, inf)"))  # a median of one run is that run
_TAKEN = (AUTO, NOMINAL)  # choices that look for a file
_OWN = ("seed", "runs", "study", "results_dir", "report.start_time_s")  # not settings of the world


def tune_filters(
    words: Sequence[str],
    filter: list[str],  # noqa: A002
    noise: list[str],
    r_factors: tuple[float, ...],
    fit_runs: int | None,
    fit_particles: int,
    name: str,
    folder: str,
) -> None:
    """Tune filters, and write their knobs with the best filter of the world."""
    from pfbench.job.tuning import check_seed, list_candidates

    grids = {method: list_candidates(method, r_factors) for method in filter}
    keys = given_keys(words)
    study = compose([*words, *([] if "runs" in keys else [f"runs={_RUNS.text}"])])
    if "scenario" not in keys:
        default = f"scenario={study.choices['scenario']}"
        print(f"note: the world of the defaults is tuned: {default}", file=sys.stderr)
    name = name or _name_file(study.choices, noise, words)
    runs = _RUNS.take("runs", str(study.values["runs"]))
    require(
        re.fullmatch("\\w+", name) and name not in _TAKEN,
        "name",
        f"consist of letters, digits and underscores and not be {' or '.join(_TAKEN)}",
        f"{name!r}",
        "It is a file of folder=.",
    )
    check_seed(study, study.values["seed"] + SEED_SHIFT)
    settings = [word for word in words if word.partition("=")[0] not in _OWN]
    world = {
        **{key: study.choices[key] for key in ("scenario", "model")},
        "settings": [
            word
            for word in settings
            if re.match(r"\+{0,2}(scenario\.|model\.|noise\.|experiment=)", word)
        ],
        "seed": study.values["seed"] + SEED_SHIFT,
        "runs": runs,
        "start_time_s": float(study.values["report"]["start_time_s"]),
        "regimes": noise,
    }
    paths = (re.match(r"[+]*hydra\.searchpath=\[?file://([^],]+)", word) for word in words)
    # that of the search path, where the composition finds the file
    target = Path(folder or next((path[1] for path in paths if path), "conf"))
    require(  # a run refuses it
        name not in read_families("tuned"),
        "name",
        f"differ from pfbench's own tuned={name}",
        f"the same for a file of {target}",
        f"Add name=my_{name}, and tuned=my_{name} to the words of the run.",
    )
    path = _search(settings, grids, world, fit_runs or runs, fit_particles, target, name)
    print(f"tuned={name}: {path.resolve()}")
    if target.resolve() != conf_dir() and not any("hydra.searchpath" in word for word in words):
        print(f"Add to the words of a study: 'hydra.searchpath=[file://{target}]'")


def _search(
    settings: Sequence[str],
    grids: Mapping[str, Sequence[dict[str, float]]],
    world: Mapping[str, Any],
    fit_runs: int,
    fit_particles: int,
    folder: Path,
    name: str,
) -> Path:
    """Search the knobs of all filters, judge the world, and write the file."""
    from pfbench.job.tuned_files import add_to_tuned_file, measure_fit, write_tuned_file
    from pfbench.job.tuning import CandidateSearch

    present = folder / "tuned" / f"{name}.yaml"
    adds = CONTROL not in grids and present.is_file()
    if adds:
        _check_same_world(present, world)
    fixed = [*settings, f"seed={world['seed']}", "pcrb=false", "score_steps=0"]
    fixed += ["budget=particles", "engine=kernels"]  # whatever an experiment sets
    searched = world["regimes"], print, world["start_time_s"]
    search = CandidateSearch([*fixed, f"runs={world['runs']}"], *searched)
    results, unsupported = _tune_each(search, grids)
    if adds:
        add_to_tuned_file(results, present, unsupported)
        return present
    others = [f"runs={fit_runs}", f"first_run={world['runs']}"]  # that have chosen no knobs
    fit = measure_fit(CandidateSearch([*fixed, *others], *searched), results, fit_particles)
    print(f"best: {fit.best}\nkalman_fits: {str(fit.kalman_fits).lower()}")
    return write_tuned_file(results, folder, name, world, fit, unsupported)


def _tune_each(
    search: CandidateSearch, grids: Mapping[str, Sequence[dict[str, float]]]
) -> tuple[list[TuningResult], dict[str, str]]:
    """Search the knobs of each filter. Returns the results, and why the others cannot run in this world."""
    results, unsupported = [], {}
    for method, grid in grids.items():
        try:
            results.append(search.tune(method, grid))
        except ValueError as error:
            unsupported[method] = f"{error}"
            print(f"{method} cannot be tuned: {error}")
    if not results:
        raise ValueError(next(iter(unsupported.values())))
    for result in results:
        values = ", ".join(f"{key}={value:g}" for key, value in result.choice.values.items())
        print(f"{result.method}: {values}")
    return results, unsupported


def _check_same_world(path: Path, world: Mapping[str, Any]) -> None:
    """Check that a file to which filters are added is of the same world, with the same runs."""
    import yaml

    stated = (yaml.safe_load(path.read_text(encoding="utf-8")) or {}).get("world", {})
    for key in world:
        require(
            stated.get(key) == world[key],
            key,
            f"be {stated.get(key)!r} as in {path}, to which filters are added",
            f"{world[key]!r}",
            f"Add filter={','.join(TUNED_METHODS)} to tune all again, or name=NAME for another file.",
        )


def _name_file(choices: Mapping[str, str], regimes: Sequence[str], words: Sequence[str]) -> str:
    """Name the file by the scenario, by the model if it is not that of the scenario, and by nominal noise alone."""
    scenario, model = choices["scenario"], choices["model"]
    places = [word for word in words if re.match(r"[+]*(hydra\.searchpath|trust)=", word)]
    default = compose([f"scenario={scenario}", *places]).choices["model"]
    name = scenario if model == default else f"{scenario}_with_{model}"
    return f"{name}_{NOMINAL}" if list(regimes) == [NOMINAL] else name


def _read_factors(key: str, text: str, remedy: str) -> tuple[float, ...]:
    """Read factors on R, which must be positive numbers."""
    entries = read_list(key, text, remedy)
    is_number = [re.fullmatch(r"[\d.]+(e[+-]?\d+)?", entry) for entry in entries]
    values = tuple(
        float(entry) if ok else 0.0 for entry, ok in zip(entries, is_number, strict=True)
    )
    require(all(0.0 < v < math.inf for v in values), key, "be positive numbers", text, remedy)
    return values


TUNE_COMMAND = Command(
    tune_filters,
    """\
pfbench tune scenario=NAME [model=NAME] [filter=NAME,NAME] [key=value ...]

Tune the filters of a world, a scenario with a model: a factor on R and one knob of the method, which
its file states, 16 candidates each, in three noise regimes, with the seed of the study plus 1000. Write the
chosen knobs and the record of all candidates into one file, FOLDER/tuned/NAME.yaml, which a study
finds by its scenario and model and gives to the filters that end in _tuned. The file states the best
of these filters, ekf and ukf (`best`), and whether Kalman filters fit the world (`kalman_fits`).

  pfbench tune scenario=benes folder=conf
  pfbench run -m 'hydra.searchpath=[file://conf]' scenario=benes filter=tuned_baselines

  runs=20 seed=1             runs of a candidate, and seed of the study
  report.start_time_s=0      time before which errors do not count, as in the report of the study
  OPTIONS""",
    options={
        "filter": Option(
            ",".join(TUNED_METHODS), "filters to tune; others, such as rpf, are added\nto a file of the same world", read_list
        ),
        "noise": Option(
            "nominal,outliers,student", "noise regimes. noise=nominal for a study of\nnominal noise alone, whose choice is tuned=nominal", read_list
        ),
        "r_factors": Option("1,2,4,8", "factors on R of the candidates, for all filters alike", _read_factors),
        "fit_runs": Option(
            "20", "further runs, by default as many as runs, which decide on best, and by sir\nand rpf in the first noise regime on kalman_fits",
            in_range("whole [2, inf)"), None
        ),
        "fit_particles": Option("10000", "their particles", in_range("whole [2, inf)")),
        "name": Option(
            "NAME", "name of the file, default SCENARIO, SCENARIO_with_MODEL, and _nominal behind\n"
            "it; a file of this name is replaced if ekf_scaled is tuned", default=""
        ),
        "folder": Option("conf", "folder of the file, default that of hydra.searchpath if there is one", default=""),
    },
)  # fmt: skip


_NOT_OF_A_JOB = ("train.", "train=", "overwrite=", "checkpoint=")


def train_network(words: Sequence[str]) -> None:
    """Train the network of a filter and print the command that uses it."""
    require(
        not {"-m", "--multirun"} & set(words),
        "pfbench train",
        "be run without -m",
        "a sweep: it trains one network",
        "Set train.noise_regimes=[a,b] to train on several noise regimes.",
    )
    from pfbench.filter.learned.checkpoint import read_checkpoint
    from pfbench.report.scenario_figures import write_training_figure

    path = fit_network(words, print)
    lines = read_checkpoint(path)["losses"]
    names = ("epoch", "loss", "validation", "ess")
    losses = {name: [line[name] for line in lines] for name in names}
    figure = write_training_figure(path.with_suffix(".svg"), losses)
    shared = [word for word in words if not word.startswith(_NOT_OF_A_JOB)]
    command = shlex.join(["pfbench", "run", *shared, f"checkpoint={path}"])  # brackets for zsh
    print(
        f"checkpoint: {path.resolve()}\nfigure of the losses: {figure.resolve()}\nNext: {command}"
    )


def fit_network(words: Sequence[str], tell: Callable[[str], object]) -> Path:
    """Train the network of the configuration of words, unless its checkpoint exists.

    Returns the path of the checkpoint.
    """
    from pfbench import job
    from pfbench.job.inputs import find_inputs
    from pfbench.learn.training_job import fit

    config = compose(words)
    values, choices = config.values, config.choices
    job.apply_global_settings(values)
    require(
        not values["oracle_noise"],
        "oracle_noise",
        "be false for training",
        "true",
        "Set oracle_noise=true when the filter runs.",
    )
    names = list(values["train"]["noise_regimes"]) or [choices["noise"]]
    regimes = {
        name: job.instantiate(compose([*words, f"noise={name}"]).values["noise"]) for name in names
    }
    about = {"versions": job.read_versions(), "inputs": find_inputs(values, config.trusted)}
    return fit(values, choices, regimes, job.instantiate, about, tell)


TRAIN_COMMAND = Command(
    train_network,
    """\
pfbench train key=value ...

Train the network of a neural_* filter or of kalman_net. The resulting file is the value of `checkpoint` of a job.
An interrupted training resumes when the command is repeated.

  pfbench train filter=neural_sir scenario=passive_1 train=vsmc train.epochs=20
  pfbench list train         training configurations""",
)
