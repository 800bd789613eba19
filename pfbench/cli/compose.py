"""Configurations of commands, and their check before Hydra acts on them."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice, product
from typing import Any, NoReturn

import yaml

from pfbench.cli.messages import format_flag
from pfbench.core.parameter_checks import require
from pfbench.job.config import CHOICES, JobConfig, compose, compose_tree, expand_filter_sets
from pfbench.job.file_rules import FOLDER_KEYS
from pfbench.job.settings import check_settings
from pfbench.job.trust import UntrustedConfigError, check_study, require_allowed
from pfbench.results.paper_block import (
    PAPER,
    experiments_dir,
    list_named_parts,
    plan_installed_pairs,
    read_part,
)


def compose_study(words: Sequence[str]) -> JobConfig:
    """Compose the configuration of a study, with its experiment if it exists.

    Returns the configuration.
    """
    config = compose(words)
    study = config.values["study"]
    has_experiment = (experiments_dir() / f"{study}.yaml").exists()
    if "experiment" in given_keys(words) or not has_experiment:
        return config
    return compose([f"+experiment={study}", *words])


def given_keys(words: Sequence[str]) -> set[str]:
    """Return the keys of overrides."""
    return {word.lstrip("+~").partition("=")[0] for word in words}


PLACES = ("device", "threads", "checkpoint")  # where a stored job is computed again


def choose_places(values: Mapping[str, Any], words: Sequence[str]) -> dict[str, Any]:
    """Return what replaces settings of a stored job: folders, data, and the places that words name."""
    keys = ("data", *FOLDER_KEYS, *(key for key in PLACES if key in given_keys(words)))
    return {key: values[key] for key in keys}


def count_planned_jobs(study: str) -> int | None:
    """Count the jobs of the sweeps of a study: its experiment, and those whose names start with its name.

    Returns the number, or None if the experiment does not exist or does not define a sweep.
    """
    parts = [path.stem for path in experiments_dir().glob(f"{study}_*.yaml")]
    parts = [name for name in parts if _load_experiment(name).get("study") == study]
    sweeps = map(read_sweep, (study, *parts)) if read_sweep(study) else ()
    return sum(math.prod(map(len, expand_sweep(sweep))) for sweep in sweeps) or None


def read_sweep(experiment: str) -> list[str]:
    """Read the sweep of an experiment as overrides. Empty if there is none."""
    params = _load_experiment(experiment).get("hydra", {}).get("sweeper", {}).get("params") or {}
    return expand_filter_sets([f"{name}={value}" for name, value in params.items()])


def _load_experiment(name: str) -> dict[str, Any]:
    """Load the file of an experiment, empty if there is none."""
    return yaml.safe_load(read_part("experiment", name)) or {}


def read_description(text: str) -> str:
    """Read the first comment of the text of a configuration file, its description."""
    first = next((line for line in text.splitlines() if not line.startswith("# @package")), "")
    return first.removeprefix("#").strip() if first.startswith("#") else ""


# --------------------------------------------------------------------------------------------------
# Check of a command before Hydra acts on it: Hydra makes folders and calls plugins before any job.

SWEEP_FLAGS = ("-m", "--multirun")
_MOST_VALUES = 100_000  # of one key of a sweep


def check_words(words: Sequence[str]) -> tuple[Any, StudyPlan | None]:
    """Check the words of `pfbench run`, those of all jobs of a sweep included.

    A job whose configuration is invalid for another reason fails by itself later, and the other jobs
    of the sweep run.

    Returns the flags with the overrides, and the plan of the jobs, None if the first one is not valid.
    """
    args = _parse_flags(sorted(words, key=lambda word: word not in SWEEP_FLAGS))
    args.overrides = overrides = expand_filter_sets(args.overrides)
    if args.multirun:
        args.overrides = overrides = delay_keys_of_swept_groups(overrides)
    try:
        alternatives = list_alternatives(overrides, is_sweep=args.multirun)
    except UntrustedConfigError:
        raise
    except Exception:  # Hydra reports an invalid override
        return args, None
    first = _check_composition(
        [options[0] for options in alternatives] if args.multirun else overrides
    )
    if args.multirun:
        _check_values(alternatives, first)
    return args, StudyPlan(alternatives, first) if first else None


def delay_keys_of_swept_groups(words: Sequence[str]) -> list[str]:
    """Write each key below a swept group as a sweep of one value, which Hydra applies to the jobs alone.

    Hydra applies other keys first to a configuration without the swept choices, where they may not
    exist: `scenario=linear_walk,growth scenario.steps=15`.

    Returns the words in the same order.
    """
    pairs = [word.partition("=") for word in words]
    groups = {key for key, _, value in pairs if "," in value and "." not in key}
    if any(key.startswith("reading/") and re.search(r",|glob", value) for key, _, value in pairs):
        groups |= {*CHOICES}  # a reading chooses the world
    return [
        f"{key}=choice({value})"
        if key.split(".")[0] in groups and "." in key and re.fullmatch(r"[\w.+-]+", value)
        else word
        for word, (key, _, value) in zip(words, pairs, strict=True)
    ]


def replace_config_dir(words: Sequence[str]) -> list[str]:
    """Replace the flag `--config-dir` of Hydra by the search path with this folder.

    Returns the words without the flag.
    """
    index = next((i for i, w in enumerate(words) if re.match(r"(--config-dir|-cd)(=|$)", w)), None)
    if index is None:
        return list(words)
    _, equals, folder = words[index].partition("=")
    after = index + 1 if equals else index + 2
    folder = folder or "".join(words[index + 1 : after])
    others = [*words[:index], *words[after:]]
    is_twice = any(re.match(r"[+~]*hydra\.searchpath\b|--config-dir\b|-cd\b", w) for w in others)
    require(
        folder and (not is_twice),
        "--config-dir",
        "be given once, with a folder and without hydra.searchpath",
        f"{folder!r}",
        "Write several folders as hydra.searchpath=[file://A,file://B].",
    )
    path = f"file://{folder}".replace("'", "\\'")
    return [*others, f"hydra.searchpath=['{path}']"]


def _parse_flags(words: list[str]) -> Any:
    """Split words into Hydra's flags and overrides."""
    from hydra._internal.utils import get_args_parser

    def refuse(message: str) -> NoReturn:
        raise ValueError(f"a flag is not valid: {message}. See pfbench run --help")

    parser: Any = get_args_parser()
    parser.error = refuse  # argparse would print its usage and end the process
    args, unknown = parser.parse_known_args(words)
    faults = {
        f"flags must stand before the first key=value, got {[*unknown, ''][0]} after it": unknown
        and not unknown[0].startswith("-"),
        "--hydra-help and --shell-completion are of Hydra's own program. The shell has pfbench completion": (
            args.hydra_help or args.shell_completion
        ),
        "--package and --resolve choose what --cfg prints, as in pfbench run --cfg job -p noise": (
            not args.cfg and (args.package or args.resolve)
        ),
        "--run, --multirun, --cfg and --info exclude each other. Leave out all but one": (
            args.run + args.multirun + bool(args.cfg or args.info) > 1
        ),
    }
    for message in (message for message, is_fault in faults.items() if is_fault):
        refuse(message)
    if unknown:
        raise ValueError(format_flag(words, unknown[0], "run"))
    of_hydra = args.config_path or args.config_name or args.config_dir or args.experimental_rerun
    flags = "--config-path, --config-name and --experimental-rerun"
    must = "not be used, since pfbench has its own main file"
    require_allowed(not of_hydra, flags, must, of_hydra, "Use --config-dir=FOLDER for more files.")
    return args


def parse_words(words: Sequence[str]) -> list[Any]:
    """Parse overrides as Hydra does."""
    from hydra.core.override_parser.overrides_parser import OverridesParser

    return list(OverridesParser.create().parse_overrides(list(words)))


def expand_sweep(overrides: Sequence[str]) -> list[list[str]]:
    """Expand overrides as Hydra's sweeper does. A later override replaces an earlier one.

    Returns for each key the alternatives, each as an override.
    """
    alternatives: dict[str, list[str]] = {}
    for override in parse_words(overrides):
        key = override.get_key_element()
        if override.is_sweep_override():
            texts = list(islice(override.sweep_string_iterator(), _MOST_VALUES + 1))
            got = f"{'more' if texts else 'none'} of {override.input_line}"
            is_few = 0 < len(texts) <= _MOST_VALUES
            require_allowed(
                is_few, key, f"have 1 to {_MOST_VALUES} values", got, f"Write them as {key}=A,B."
            )
            values = [f"{key}={value}" for value in texts]
        else:
            values = [override.input_line or f"{key}={override.get_value_element_as_str()}"]
        alternatives[key] = values
    return list(alternatives.values())


def _check_composition(words: list[str]) -> JobConfig | None:
    """Compose a configuration for its checks. Other errors are left to the job."""
    try:
        return compose(words)
    except UntrustedConfigError:
        raise
    except Exception:
        return None


def list_alternatives(overrides: Sequence[str], *, is_sweep: bool = True) -> list[list[str]]:
    """Expand overrides and the sweep of their experiment. Returns for each key the alternatives, each as an override."""
    if not is_sweep and "experiment" not in given_keys(overrides):
        return expand_sweep(overrides)
    tree = compose_tree([options[0] for options in expand_sweep(overrides)])
    params = tree.hydra.sweeper.params or {}
    return expand_sweep([*(f"{name}={value}" for name, value in params.items()), *overrides])


def _check_values(alternatives: Sequence[Sequence[str]], config: JobConfig | None) -> None:
    """Check all settings of a sweep, the values of keys of a filter or noise regime, and all values that can choose a file that is not pfbench's."""
    first = [options[0] for options in alternatives]
    values: Mapping[str, object] = config.values if config else {}
    for index, options in enumerate(alternatives):
        # the first job is checked already, without building its filter and noise regime
        is_built = len(options) == 1 and not options[0].startswith(("filter.", "noise."))
        for option in options[1:] if is_built or not values else options:
            key, _, value = option.lstrip("+").partition("=")
            if key == "study":
                check_study(value.strip("'\""))
            is_plain = key in values and not isinstance(values[key], Mapping)
            if is_plain and value != UNTIL_DECIDED:  # known before a job starts
                check_settings({**values, "runs": 1, key: parse_words([option])[0].value()})
            elif not is_plain and value not in list_named_parts(key):
                composed = _check_composition([*first[:index], option, *first[index + 1 :]])
                group = key.partition(".")[0]
                if composed and group in ("filter", "noise") and group != key:
                    from pfbench.job.model_fit import instantiate_parts  # which imports torch

                    instantiate_parts(composed.values, (group,), composed.trusted)


UNTIL_DECIDED = "until-decided"  # value of `runs`


def wants_until_decided(plan: StudyPlan) -> bool:
    """Return whether a study adds runs until it is decided."""
    return plan.first.values.get("runs") == UNTIL_DECIDED


# keys that are equal in all jobs of a condition, and how several values are run
_EQUAL_KEYS = {
    "seed": "Use more runs of one seed (runs=200), or one study for each seed: study=mine_1 seed=1, then study=mine_2 seed=2.",
    "runs": "Use the largest number, or one study for each number.",
    "first_run": "Use first runs that continue each other, such as first_run=0,100 with runs=100.",
}


@dataclass(frozen=True)
class StudyPlan:
    """Jobs of a sweep.

    Attributes:
        alternatives: Alternatives of each key, each as an override.
        first: Configuration of the first job.
    """

    alternatives: Sequence[Sequence[str]]
    first: JobConfig

    @property
    def jobs(self) -> int:
        """Number of jobs."""
        return math.prod(map(len, self.alternatives))

    @property
    def has_one_study(self) -> bool:
        """Return whether all jobs belong to one study."""
        return not {"study", "experiment"} & self._swept_options().keys()

    def check_comparable(self) -> None:
        """Check that the report of the study can compare the jobs, which needs equal data in each condition."""
        report = self.first.values.get("report")
        if isinstance(report, Mapping) and report.get("allow_mixed_versions"):
            return
        for key, remedy in _EQUAL_KEYS.items():
            values = [option.partition("=")[2] for option in self._swept_options().get(key, ())]
            require(
                len(set(values)) < 2 or (key == "first_run" and self._continue_runs(values)),
                key,
                "be one value in a study, since its report compares filters on equal data",
                ", ".join(values[:5]),
                f"{remedy} To run them all the same, and to report them, add "
                "report.allow_mixed_versions=true to both commands.",
            )

    def _continue_runs(self, first_runs: Sequence[str]) -> bool:
        """Return whether jobs with these first runs continue each other, so that a report joins them."""
        runs = self.first.values["runs"]
        numbers = [int(text) for text in first_runs if text.isdecimal()]
        is_whole = type(runs) is int and len(numbers) == len(first_runs)
        return is_whole and sorted(numbers) == [
            min(numbers) + k * runs for k in range(len(numbers))
        ]

    def list_families(self) -> dict[str, str]:
        """Return the family of each scenario of the sweep."""
        scenarios = self._swept_options().get("scenario", ())
        firsts = [options[0] for options in self.alternatives]
        others = [word for word in firsts if given_keys([word]) != {"scenario"}]
        worlds = [compose_words([*others, scenario]) for scenario in scenarios]
        families = {}
        for config in worlds or [self.first]:
            name, node = config.choices["scenario"], config.values.get("scenario")
            paper = node.get(PAPER) if isinstance(node, Mapping) else None
            families[name] = str((paper or {}).get("family") or name)
        return families

    def count_pairs(self) -> int:
        """Count the planned pairs of filters; at least 1, since one filter is compared later."""
        swept = self._swept_options()
        names = [option.partition("=")[2] for option in swept.pop("filter", ("filter=one",))]
        settings = (len(swept[key]) for key in swept if re.match(r"filter\.|particles$", key))
        variants = math.prod(settings)
        labels = names if variants == 1 else [f"{n} {k}" for n in names for k in range(variants)]
        return max(1, len(plan_installed_pairs(labels)))

    def compose_jobs(self) -> list[JobConfig]:
        """Compose the configurations of all jobs."""
        return [compose_words(words) for words in product(*self.alternatives)]

    def compose_parts(self) -> Iterator[JobConfig]:
        """Compose a job of each combination of parts with classes of the user; a job that does not compose says so itself."""
        several = [
            options
            if {key.split(".")[0] for key in given_keys(options[:1])} <= {*CHOICES}
            else options[:1]
            for options in self.alternatives
        ]
        runs = ("runs=2",) if wants_until_decided(self) else ()
        for words in product(*several):
            with suppress(Exception):
                yield compose_words([*words, *runs])

    def describe_size(self) -> str:
        """Describe what the chosen runs and worlds can show; empty if the runs are not one number."""
        from pfbench.stats.study_size import describe_study_size

        runs = self.first.values["runs"]
        if type(runs) is not int or runs < 1 or "runs" in self._swept_options():
            return ""
        worlds = len(set(self.list_families().values()))
        return f"plan: {describe_study_size(runs, worlds, self.count_pairs())}"

    def _swept_options(self) -> dict[str, Sequence[str]]:
        """Return the alternatives of each key that has several."""
        several = [options for options in self.alternatives if len(options) > 1]
        return {next(iter(given_keys(options[:1]))): options for options in several}


def plan_study(overrides: Sequence[str]) -> StudyPlan:
    """Plan a sweep."""
    alternatives = list_alternatives(overrides)
    return StudyPlan(alternatives, compose_words([options[0] for options in alternatives]))


def compose_words(words: Sequence[str]) -> JobConfig:
    """Compose a configuration without the overrides of Hydra itself, except its search path."""
    return compose([word for word in words if not re.match(r"[+~]*hydra[/.](?!searchpath)", word)])
