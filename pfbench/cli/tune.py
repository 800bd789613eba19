"""Command `pfbench tune`: knobs of the baselines, chosen alike on seeds that no study scores."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pfbench.config.composition import compose
from pfbench.config.named_sets import SUFFIX, TUNED_METHODS

HELP = """\
pfbench tune scenario=NAME [model=NAME] [filter=NAME,NAME] [key=value ...]

Tune the baselines of a study of robustness: a factor on R and one knob of the method, 16 candidates
each, in three noise regimes, with the seed of the study plus 1000. Write a configuration file per
filter and the record of all candidates.

  pfbench tune scenario=flight_500s model=ins_gnss_inflated
  pfbench tune scenario=passive_1 filter=gate,huber runs=20 suffix=passive folder=conf

  filter=...         filters to tune, default ekf_scaled,gate,huber,student
  runs=20 seed=1     runs of a candidate, and seed of the study
  noise=...          noise regimes, default nominal,outliers,student
  suffix=tuned       end of the names of the tuned filters
  folder=conf        folder of the files; use it with 'hydra.searchpath=[file://conf]'"""

_OPTIONS = {"filter": ",".join(TUNED_METHODS), "suffix": SUFFIX, "folder": "conf", "noise": ""}


def tune_filters(words: Sequence[str]) -> None:
    """Tune filters and write their files.

    Args:
        words: Words `key=value`.

    Raises:
        ValueError: If a filter is without a knob, or a value is not valid.
    """
    from pfbench.job.tuning.candidate_search import REGIMES, SEED_SHIFT, CandidateSearch
    from pfbench.job.tuning.knobs import list_candidates
    from pfbench.job.tuning.tuned_files import write_filter_file, write_record

    options = _OPTIONS | {k: v for k, _, v in (w.partition("=") for w in words) if k in _OPTIONS}
    others = [word for word in words if word.partition("=")[0] not in _OPTIONS]
    methods, folder = options["filter"].split(","), Path(options["folder"])
    for method in methods:
        list_candidates(method)  # refuses a filter without a knob before any run
    regimes = tuple(options["noise"].split(",")) if options["noise"] else REGIMES
    keys = {word.partition("=")[0] for word in others}
    study = compose([*others, *([] if "runs" in keys else ["runs=20"])])
    seed, runs = study.values["seed"] + SEED_SHIFT, study.values["runs"]
    rest = [word for word in others if word.partition("=")[0] not in ("seed", "runs", "study")]
    name = f"tuning_{study.choices['scenario']}_{study.choices['model']}"
    fixed = [f"seed={seed}", f"runs={runs}", f"study={name}", "pcrb=false"]
    search = CandidateSearch([*rest, *fixed], regimes, print)
    world = {
        **{key: study.choices[key] for key in ("scenario", "model")},
        **{"seed": seed, "runs": runs, "regimes": list(regimes)},
    }
    results = [search.tune(method) for method in methods]
    for result in results:
        path = write_filter_file(result, folder, options["suffix"], world)
        values = ", ".join(f"{key}={value:g}" for key, value in result.choice.values.items())
        print(f"{result.method}: {values}. {path.resolve()}")
    record = write_record(results, folder, options["suffix"], world)
    print(f"record: {record.resolve()}")
