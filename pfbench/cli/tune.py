"""Command `pfbench tune`: knobs of the baselines, chosen alike on seeds that no study scores."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from pfbench.config.composition import JobConfig, compose
from pfbench.config.named_sets import TUNED_METHODS

HELP = """\
pfbench tune scenario=NAME [model=NAME] [filter=NAME,NAME] [key=value ...]

Tune the baselines of a study of robustness: a factor on R and one knob of the method, 16 candidates
each, in three noise regimes, with the seed of the study plus 1000. Write the chosen knobs and the
record of all candidates into one file, FOLDER/tuned/NAME.yaml. In a study `tuned=NAME` gives the
knobs to the filters that end in _tuned.

  pfbench tune scenario=passive_1 folder=conf
  pfbench run -m 'hydra.searchpath=[file://conf]' scenario=passive_1 tuned=passive_1 filter=tuned_baselines

  filter=...         filters to tune, default ekf_scaled,gate,huber,student
  runs=20 seed=1     runs of a candidate, and seed of the study
  noise=...          noise regimes, default nominal,outliers,student
  r_factors=1,2,4,8  factors on R of the candidates, for all filters alike
  report.start_time_s=0   time before which errors do not count, as in the report of the study
  name=SCENARIO      name of the file; a file of this name is replaced
  folder=conf        folder of the file; use it with 'hydra.searchpath=[file://conf]'"""

_OPTIONS = {
    "filter": ",".join(TUNED_METHODS), "name": "", "folder": "conf", "noise": "nominal,outliers,student",
    "r_factors": "1,2,4,8",
}  # fmt: skip
_FEWEST_RUNS = 2  # a median of one run is that run
_OWN = ("seed", "runs", "study", "results_dir", "report.start_time_s")  # not settings of the world


def tune_filters(words: Sequence[str]) -> None:
    """Tune filters and write their knobs.

    Args:
        words: Words `key=value`.

    Raises:
        ValueError: If a filter is without a knob, a list is empty, a value is not valid, or a study scores
            the seed of the tuning.
    """
    from pfbench.job.tuning.candidate_search import SEED_SHIFT, CandidateSearch
    from pfbench.job.tuning.knobs import list_candidates
    from pfbench.job.tuning.scored_seeds import check_seed
    from pfbench.job.tuning.tuned_files import write_tuned_file

    options = _OPTIONS | {k: v for k, _, v in (w.partition("=") for w in words) if k in _OPTIONS}
    lists = {key: _split_list(key, options[key]) for key in ("filter", "noise", "r_factors")}
    others = [word for word in words if word.partition("=")[0] not in _OPTIONS]
    grids = {method: list_candidates(method, _numbers(lists["r_factors"])) for method in lists["filter"]}  # fmt: skip
    study = _compose_world(others)
    name = options["name"] or study.choices["scenario"]
    _check_choices(name, study.values["runs"])
    seed, start_time_s = (
        study.values["seed"] + SEED_SHIFT,
        float(study.values["report"]["start_time_s"]),
    )
    check_seed(study, seed)
    settings = [word for word in others if word.partition("=")[0] not in _OWN]
    fixed = [f"seed={seed}", f"runs={study.values['runs']}", "pcrb=false", "score_steps=0"]
    search = CandidateSearch([*settings, *fixed], lists["noise"], print, start_time_s)
    world = {
        **{key: study.choices[key] for key in ("scenario", "model")},
        "settings": [word for word in settings if re.match(r"(scenario|model|noise)\.", word)],
        **{"seed": seed, "runs": study.values["runs"], "start_time_s": start_time_s},
        "regimes": lists["noise"],
    }
    results = [search.tune(method, grid) for method, grid in grids.items()]
    for result in results:
        values = ", ".join(f"{key}={value:g}" for key, value in result.choice.values.items())
        print(f"{result.method}: {values}")
    path = write_tuned_file(results, Path(options["folder"]), name, world)
    print(f"tuned={name}: {path.resolve()}")


def _check_choices(name: str, runs: int) -> None:
    """Check the name of the file, and that there are runs for a median."""
    if not re.fullmatch(r"\w+", name):
        raise ValueError(
            f"name must consist of letters, digits and underscores, got {name!r}. It is a file of folder=."
        )
    if runs < _FEWEST_RUNS:
        raise ValueError(
            f"runs must be at least {_FEWEST_RUNS} for a tuning, got {runs}. Default: runs=20."
        )


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
