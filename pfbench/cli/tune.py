"""Command `pfbench tune`: knobs of the baselines, chosen alike on seeds that no study scores."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pfbench.core.parameter_checks import require
from pfbench.job.config import TUNED_METHODS, JobConfig, compose
from pfbench.job.tuned_knobs import AUTO, NOMINAL, SEED_SHIFT

if TYPE_CHECKING:
    from pfbench.job.tuning import CandidateSearch, TuningResult

HELP = """\
pfbench tune scenario=NAME [model=NAME] [filter=NAME,NAME] [key=value ...]

Tune the filters of a world, a scenario with a model: a factor on R and one knob of the method, which
its file states, 16 candidates each, in three noise regimes, with the seed of the study plus 1000. Write the
chosen knobs and the record of all candidates into one file, FOLDER/tuned/NAME.yaml, which a study
finds by its scenario and model and gives to the filters that end in _tuned. The file states the best
of these filters, ekf and ukf (`best`), and whether Kalman filters fit the world (`kalman_fits`).

  pfbench tune scenario=benes folder=conf
  pfbench run -m 'hydra.searchpath=[file://conf]' scenario=benes filter=tuned_baselines

  filter=...         filters to tune, default ekf_scaled,gate,huber,student; others, such as rpf, are added
                     to a file of the same world
  runs=20 seed=1     runs of a candidate, and seed of the study
  noise=...          noise regimes, default nominal,outliers,student. noise=nominal for a study of
                     nominal noise alone, whose choice is tuned=nominal
  r_factors=1,2,4,8  factors on R of the candidates, for all filters alike
  fit_runs=RUNS      further runs, which decide on best, and by sir and rpf in the first noise regime on
                     kalman_fits
  fit_particles=10000     their particles
  report.start_time_s=0   time before which errors do not count, as in the report of the study
  name=...           name of the file, default SCENARIO, SCENARIO_with_MODEL, and _nominal behind it;
                     a file of this name is replaced if ekf_scaled is tuned
  folder=conf        folder of the file, default that of hydra.searchpath if there is one"""

_OPTIONS = {
    "filter": ",".join(TUNED_METHODS), "name": "", "folder": "", "noise": "nominal,outliers,student",
    "r_factors": "1,2,4,8", "fit_runs": "", "fit_particles": "10000",
}  # fmt: skip
_DEFAULTS = {"runs": "runs=20", "fit_runs": "fit_runs=RUNS", "fit_particles": "fit_particles=10000"}
CONTROL = "ekf_scaled"  # without which no filter is the best of a world
_FEWEST_RUNS = 2  # a median of one run is that run
_TAKEN = (AUTO, NOMINAL)  # choices that look for a file
_OWN = ("seed", "runs", "study", "results_dir", "report.start_time_s")  # not settings of the world


def tune_filters(words: Sequence[str]) -> None:
    """Tune filters, and write their knobs with the best filter of the world."""
    from pfbench.job.tuning import check_seed, list_candidates

    options = _OPTIONS | {k: v for k, _, v in (w.partition("=") for w in words) if k in _OPTIONS}
    lists = {key: _split_list(key, options[key]) for key in ("filter", "noise", "r_factors")}
    others = [word for word in words if word.partition("=")[0] not in _OPTIONS]
    grids = {method: list_candidates(method, _numbers(lists["r_factors"])) for method in lists["filter"]}  # fmt: skip
    study = _compose_world(others)
    if "scenario" not in {word.partition("=")[0] for word in others}:
        print(
            f"note: the world of the defaults is tuned: scenario={study.choices['scenario']}",
            file=sys.stderr,
        )
    name = options["name"] or _name_file(study.choices, lists["noise"], others)
    runs = study.values["runs"]
    _check_choices(name, runs)
    fit_runs = _count("fit_runs", options["fit_runs"] or str(runs))
    particles = _count("fit_particles", options["fit_particles"])
    check_seed(study, study.values["seed"] + SEED_SHIFT)
    settings = [word for word in others if word.partition("=")[0] not in _OWN]
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
        "regimes": lists["noise"],
    }
    folder = Path(options["folder"] or _own_folder(words))
    _check_new_name(name, folder)
    path = _search(settings, grids, world, fit_runs, particles, folder, name)
    print(f"tuned={name}: {path.resolve()}{_describe_use(folder, words)}")


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
    place = world["regimes"], print, world["start_time_s"]
    search = CandidateSearch([*fixed, f"runs={world['runs']}"], *place)
    results, unsupported = _tune_each(search, grids)
    if adds:
        add_to_tuned_file(results, present, unsupported)
        return present
    others = [f"runs={fit_runs}", f"first_run={world['runs']}"]  # that have chosen no knobs
    fit = measure_fit(CandidateSearch([*fixed, *others], *place), results, fit_particles)
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
        if stated.get(key) != world[key]:
            raise ValueError(
                f"{key} must be {stated.get(key)!r} as in {path}, to which filters are added, got {world[key]!r}. "
                f"Add filter={','.join(TUNED_METHODS)} to tune all again, or name=NAME for another file."
            )


def _name_file(choices: Mapping[str, str], regimes: Sequence[str], words: Sequence[str]) -> str:
    """Name the file by the scenario, by the model if it is not that of the scenario, and by nominal noise alone."""
    scenario, model = choices["scenario"], choices["model"]
    places = [word for word in words if re.match(r"[+]*(hydra\.searchpath|trust)=", word)]
    default = compose([f"scenario={scenario}", *places]).choices["model"]
    name = scenario if model == default else f"{scenario}_with_{model}"
    return f"{name}_{NOMINAL}" if list(regimes) == [NOMINAL] else name


def _own_folder(words: Sequence[str]) -> str:
    """Return the first folder of the search path, where the composition finds the file, else conf."""
    paths = (re.match(r"[+]*hydra\.searchpath=\[?file://([^],]+)", word) for word in words)
    return next((path[1] for path in paths if path), "conf")


def _describe_use(folder: Path, words: Sequence[str]) -> str:
    """Say how a study finds the file, if it does not by itself."""
    from pfbench.results.paper_block import conf_dir

    is_found = folder.resolve() == conf_dir() or any("hydra.searchpath" in word for word in words)
    return (
        "" if is_found else f"\nAdd to the words of a study: 'hydra.searchpath=[file://{folder}]'"
    )


def _check_new_name(name: str, folder: Path) -> None:
    """Check that the name of a file of a user's own folder differs from those of pfbench, since a run refuses it."""
    from pfbench.results.paper_block import read_families

    require(
        name not in read_families("tuned"),
        "name",
        f"differ from pfbench's own tuned={name}",
        f"the same for a file of {folder}",
        f"Add name=my_{name}, and tuned=my_{name} to the words of the run.",
    )


def _check_choices(name: str, runs: int) -> None:
    """Check the name of the file, and that there are runs for a median."""
    require(
        re.fullmatch("\\w+", name) and name not in _TAKEN,
        "name",
        f"consist of letters, digits and underscores and not be {' or '.join(_TAKEN)}",
        f"{name!r}",
        "It is a file of folder=.",
    )
    _count("runs", str(runs))


def _count(key: str, text: str) -> int:
    """Return a number of runs or particles, at least two."""
    require(
        text.isdecimal() and int(text) >= _FEWEST_RUNS,
        key,
        f"be at least {_FEWEST_RUNS} for a tuning",
        text,
        f"Default: {_DEFAULTS[key]}.",
    )
    return int(text)


def _compose_world(words: Sequence[str]) -> JobConfig:
    """Compose the world of a tuning, with 20 runs unless the words set them."""
    keys = {word.partition("=")[0] for word in words}
    return compose([*words, *([] if "runs" in keys else ["runs=20"])])


def _split_list(key: str, text: str) -> list[str]:
    """Split a list of the command line, which must have an entry."""
    entries = [entry.strip() for entry in text.split(",")]
    if not all(entries) or len(set(entries)) < len(entries):
        raise ValueError(
            f"{key} must be a list of distinct entries separated by commas, got {text!r}. "
            f"Default: {key}={_OPTIONS[key]}"
        )
    return entries


def _numbers(entries: Sequence[str]) -> tuple[float, ...]:
    """Return factors on R, which must be positive numbers."""
    try:
        values = tuple(map(float, entries))
    except ValueError:
        values = (0.0,)
    if not all(0.0 < value < float("inf") for value in values):
        raise ValueError(
            f"r_factors must be positive numbers, got {','.join(entries)}. Default: r_factors={_OPTIONS['r_factors']}"
        )
    return values
