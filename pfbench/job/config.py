"""Configuration of a job, composed from conf/ and experiments/ with the readings of the papers, and resolved."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache, partial
from typing import TYPE_CHECKING, Any

from pfbench.core.parameter_checks import require
from pfbench.files import limits
from pfbench.job.readings import JOINER, make_reading, read_reading_table
from pfbench.job.trust import (
    UntrustedConfigError,
    check_configuration,
    check_places,
    check_study,
    require_allowed,
    split_trust,
)
from pfbench.job.tuned_knobs import TUNED, check_tuned_seed, mark_foreign, select_knobs
from pfbench.results.paper_block import (
    FAMILY_FOLDER,
    check_paper_blocks,
    conf_dir,
    list_named_parts,
    read_families,
    read_part,
    remove_nested_blocks,
)
from pfbench.results.store import list_not_finite

if TYPE_CHECKING:
    from omegaconf import DictConfig


# This module imports Hydra only on use and never imports torch, so that the command line starts fast.

CHOICES = ("scenario", "noise", "filter", "model")  # groups that name a job

_HYDRA_STATE = threading.RLock()  # Hydra has one state for all threads of a process


@dataclass(frozen=True)
class JobConfig:
    """Resolved configuration of one job.

    Attributes:
        values: Nested plain dictionary, lists and numbers.
        choices: Name of the file chosen in each group, for instance `{"filter": "sir", ...}`.
        uses_shared_particles: Whether `filter.particles` refers to the key `particles`. Only then
            may a budget replace the number.
        trusted: Packages that `_target_` may name besides pfbench.
        words: Overrides that compose it, those of trust and search path included; empty if unknown.

    Raises:
        ValueError: If a group is missing or names no class, one of its numbers is not finite, or a
            value names what is not trusted.
    """

    values: dict[str, Any]
    choices: dict[str, str]
    uses_shared_particles: bool = False
    trusted: tuple[str, ...] = ()
    words: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        missing = [group for group in CHOICES if group not in self.choices]
        require(
            not missing,
            "choices",
            f"name {', '.join(CHOICES)}",
            [name for name in sorted(self.choices) if name in CHOICES],
            f"Write {'=NAME, '.join(missing)}=NAME. Several names need -m and no brackets, as in filter=A,B.",
        )
        check_groups(self.values, CHOICES)
        check_configuration(self.values, self.trusted)
        check_simulated_model(self.values, self.choices)
        check_paper_blocks(self.values)
        check_places(self.values)
        if "study" in self.values:
            self.values["study"] = check_study(self.values["study"])


def compose(overrides: Sequence[str] = ()) -> JobConfig:
    """Compose a configuration from the files of conf/ and experiments/.

    Works within and without a Hydra application. Hydra's global state is the same afterwards.

    Args:
        overrides: Hydra overrides such as `"scenario=flight_300s"` or `"+experiment=quickstart"`,
            and `"trust=[mylab]"` for packages whose classes the configuration may name.

    Returns:
        The configuration of one job.

    Raises:
        ValueError: If a file sets a key that only the command line may set, or a value names what
            is not trusted.
    """
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import open_dict

    words, trusted = split_trust(overrides)
    with _preserved_hydra_state():
        composed = compose_tree(words, trusted)
        choices = {str(k): str(v) for k, v in composed.hydra.runtime.choices.items()}
        # where an experiment may look up the choices
        HydraConfig.instance().set_config(composed)
        with open_dict(composed):
            del composed["hydra"]
        return resolve_config(composed, choices, trusted, overrides)


def compose_tree(words: Sequence[str], trusted: Sequence[str] | None = None) -> DictConfig:
    """Compose a configuration with Hydra's own settings, checked by the loader.

    Returns the configuration, not resolved, with the node `hydra`.
    """
    from hydra import version
    from hydra._internal.hydra import Hydra
    from hydra._internal.utils import create_config_search_path
    from hydra.types import RunMode

    from pfbench.job.shared_loader import SharedLoader

    register_experiments()
    with _preserved_hydra_state():
        version.setbase("1.3")
        loader = SharedLoader(create_config_search_path(str(conf_dir())), trusted)
        return Hydra("app", loader).compose_config(
            "config", name_readings(words), RunMode.RUN, from_shell=False
        )


def resolve_config(
    config: JobConfig | DictConfig | Mapping[str, Any],
    choices: Mapping[str, str] | None = None,
    trusted: Sequence[str] = (),
    words: Sequence[str] = (),
) -> JobConfig:
    """Resolve all interpolations of a configuration.

    Args:
        config: Configuration of a job. One that is resolved already is returned unchanged.
        choices: Names of the chosen scenario, noise, filter and model. Default: `config.choices`.
        trusted: Packages that `_target_` may name besides pfbench and those of PFBENCH_TRUST.
        words: Overrides that compose the configuration, for the note of a job that fails.

    Returns:
        The resolved configuration.

    Raises:
        ValueError: If the choices do not name scenario, noise, filter and model, a group is not
            valid, a value refers to itself, or one names what is not trusted.
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import InterpolationKeyError

    if isinstance(config, JobConfig):
        return config
    tree = config if OmegaConf.is_config(config) else OmegaConf.create(dict(config))
    is_shared = "particles" in tree["filter"] and OmegaConf.is_interpolation(
        tree["filter"], "particles"
    )
    names = {
        str(group): str(name)
        for group, name in (choices or {}).items()
        if name not in (None, "None")
    }
    apply_readings(tree, names)
    _, packages = split_trust([f"trust=[{','.join(trusted)}]"])
    has_knobs = _take_knobs(tree, names, trusted)
    try:
        values = remove_nested_blocks(resolve_values(tree))
    except InterpolationKeyError as error:
        if not str(error.full_key).startswith("model."):
            raise
        from pfbench.job.model_fit import explain_error

        explained = explain_error(error, tree, trusted, names.get("scenario", ""))
        if explained is error:
            raise
        raise explained from error
    knobs = values.pop(TUNED, {})  # the filter has them
    values = {key: value for key, value in values.items() if not key.endswith(_TABLE)}
    if has_knobs:
        check_tuned_seed(values, names.get("scenario"), knobs)
        mark_foreign(values, names, knobs.get("world", {}), trusted)
    return JobConfig(values, names, is_shared, packages, tuple(words))


def _take_knobs(tree: Any, choices: Mapping[str, str], trusted: Sequence[str]) -> bool:
    """Replace the node `tuned` by the knobs of one world.

    Returns whether the filter has knobs or says on which data it was tuned. Most filters do neither.
    """
    from omegaconf import flag_override

    if re.search(r"\btun(ed|ing)\b", str(tree["filter"])):
        select_knobs(tree, choices, trusted)
        return True
    if TUNED in tree:
        with flag_override(tree, ["struct", "readonly"], [False, False]):
            tree[TUNED] = {}
    return False


def list_groups() -> dict[str, list[str]]:
    """List the names of each configuration group and of the group `experiment`."""
    groups = sorted(
        {p.parent.name for pattern in ("*/*.yaml", f"*/{FAMILY_FOLDER}") for p in conf_dir().glob(pattern)} - {READING}
    )  # fmt: skip
    return {group: list_named_parts(group) for group in [*groups, "experiment"]}


@dataclass(eq=False)
class _LazyGroup(dict[str, Any]):
    """Group in Hydra's store whose nodes are made when Hydra asks for one: all of them take as long as composing.

    Hydra copies the store for each composition and the chosen node once more.
    """

    list_names: Callable[[], list[str]]
    make: Callable[[str], Any]
    joiner: str | None = None  # of names that stand for several at once

    def __contains__(self, name: object) -> bool:
        names = str(name).removesuffix(".yaml").split(self.joiner)
        # None: `null` of a defaults list
        return name != "None.yaml" and {f"{level}.yaml" for level in names} <= {*self.list_names()}

    def keys(self) -> Any:
        return self.list_names()

    def __getitem__(self, name: str) -> Any:
        return self.make(name)

    def __deepcopy__(self, memo: dict[int, Any]) -> _LazyGroup:
        return self


def register_experiments() -> None:
    """Register with Hydra what no file of its own has: experiments, readings of the papers, and names in families."""
    from hydra.core.config_store import ConfigStore

    repo = ConfigStore.instance().repo
    repo[READING] = {
        path.stem: _LazyGroup(
            partial(_list_readings, path.stem), partial(_make_reading, path.stem), JOINER
        )
        for path in (conf_dir() / READING).glob("*.yaml")
    }
    for group in (
        "experiment",
        *(path.parent.name for path in conf_dir().glob(f"*/{FAMILY_FOLDER}")),
    ):
        repo[group] = _LazyGroup(partial(_list_stored, group), partial(_make_stored, group))


def _list_stored(group: str) -> list[str]:
    """List the files that all experiments, or the names in the families of a group, stand for."""
    names = list_named_parts(group) if group == "experiment" else read_families(group)
    return [f"{name}.yaml" for name in names]


def _make_stored(group: str, name: str) -> Any:
    """Make the node of an experiment or of a name in a family."""
    return _load_text(group, name, read_part(group, name.removesuffix(".yaml")))


def _list_readings(group: str) -> list[str]:
    """List the files that the readings of a paper stand for."""
    return [f"{name}.yaml" for name in read_reading_table(group[-3:])]


@cache
def _make_reading(group: str, name: str) -> Any:
    """Make the node of a reading from its row."""
    from hydra.core.config_store import ConfigNode
    from omegaconf import OmegaConf

    content = OmegaConf.create(make_reading(group[-3:], name.removesuffix(".yaml")))
    return ConfigNode(name, content, f"{READING}/{group}", "_global_", "pfbench.readings")


@cache
def _load_text(group: str, name: str, text: str) -> Any:
    """Make the node of a text, with the filters of named sets in the sweep of an experiment."""
    from hydra.core.config_store import ConfigNode
    from omegaconf import OmegaConf

    node: Any = OmegaConf.create(text)
    params = OmegaConf.select(node, "hydra.sweeper.params")
    if params is not None and "filter" in params:
        params["filter"] = expand_filter_names(str(params["filter"]))
    package = "_global_" if group == "experiment" else None
    return ConfigNode(name, node, group, package, f"pfbench.{group}")


@contextmanager
def _preserved_hydra_state() -> Iterator[None]:
    """Clear Hydra's global state for one composition and restore it afterwards, in one thread at a time."""
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.hydra_config import HydraConfig

    with _HYDRA_STATE:
        application, job = GlobalHydra.instance(), HydraConfig.instance()
        saved = application.hydra, job.cfg
        application.clear()
        try:
            yield
        finally:
            GlobalHydra.instance().hydra, HydraConfig.instance().cfg = saved


# --------------------------------------------------------------------------------------------------
# Checks of the groups of a configuration that hold for all classes: a class, finite numbers, no circles.

_resolved: ContextVar[list[int] | None] = ContextVar("resolved", default=None)
_CIRCLES = ("Recursive interpolation", "Interpolation to parent node")  # messages of OmegaConf


def resolve_values(tree: DictConfig | Mapping[str, Any]) -> dict[str, Any]:
    """Resolve all interpolations of a configuration.

    Returns nested plain dictionary.
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import InterpolationResolutionError

    _count_resolved_values()
    token = _resolved.set([0, 0, 0])
    try:
        values = OmegaConf.to_container(tree, resolve=True)
    except InterpolationResolutionError as error:
        cause: BaseException | None = error
        while cause is not None and not isinstance(cause, UntrustedConfigError):
            cause = cause.__cause__ or cause.__context__
        if cause is not None:
            raise cause from None
        text, key = str(error), error.full_key
        if not key or not text.startswith(_CIRCLES):
            raise
        parent: Any = OmegaConf.to_container(error.parent_node, resolve=False)
        value = parent[error.key]
        raise ValueError(
            f"{key} must not refer to itself, got {value}, which leads back to {key}. "
            f"Set {key} to a value."
        ) from error
    finally:
        _resolved.reset(token)
    assert isinstance(values, dict)
    return {str(key): value for key, value in values.items()}


@cache
def _count_resolved_values() -> None:
    """Let OmegaConf count the values and characters that it resolves, which are limited: it resolves a value again for each reference."""
    from omegaconf.base import Container

    by_omegaconf = Container.resolve_parse_tree

    def resolve(self: Container, *args: Any, **options: Any) -> Any:
        counts = _resolved.get()
        if counts is None:
            return by_omegaconf(self, *args, **options)
        counts[0] += 1
        value = by_omegaconf(self, *args, **options)
        _add_size(getattr(value, "_content", value), counts)
        return value

    Container.resolve_parse_tree = resolve  # type: ignore[method-assign]


def _add_size(value: Any, counts: list[int]) -> None:
    """Add the size of a value to the counts of references, values and characters."""
    counts[1] += 1
    counts[2] += len(value) if isinstance(value, str) else 0
    most = (limits.RESOLVED_REFERENCES, limits.RESOLVED_VALUES, limits.RESOLVED_TEXT)
    require_allowed(
        all(count <= limit for count, limit in zip(counts, most, strict=True)),
        "values that refer to others",
        "have at most {} references, {} values and {} characters in all".format(*most),
        "more",
        "Write fewer references.",
    )
    children = (
        value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    )
    for child in children:
        _add_size(getattr(child, "_content", None) or getattr(child, "_val", None), counts)


def check_groups(values: Mapping[str, Any], groups: Sequence[str]) -> None:
    """Check that each group names a class and has finite numbers only."""
    for group in groups:
        node = values.get(group, {"_target_": None})
        if not isinstance(node, Mapping) or "_target_" not in node:
            is_text = isinstance(node, Mapping) and all(
                value is None for value in node.values()
            )  # Hydra's reading
            content = ", ".join(map(str, node)) if is_text else repr(node)
            raise ValueError(
                f"{group} must be keys and values with the key _target_, got {content:.80}. Write "
                f"_target_: CLASS into its file, or choose another one: pfbench list {group}"
            )
        for key, value in list_not_finite(node, group):
            raise ValueError(f"{key} must be finite, got {value}. Set {key} to a number.")


def check_simulated_model(values: Mapping[str, Any], choices: Mapping[str, str]) -> None:
    """Check that a shipped world that is simulated from its model has this model, since it is named by it."""
    scenario, model = choices.get("scenario", ""), choices.get("model", "")
    require(
        not is_simulated_from(values.get("scenario"), scenario) or model == scenario,
        "model",
        f"be {scenario} for scenario={scenario}, which is simulated from it",
        model,
        f"Choose scenario={model} if it exists (pfbench list scenario), or write a scenario of your own with _target_: pfbench.scenario.ModelSimulation.",
    )


def is_simulated_from(scenario: Any, name: str) -> bool:
    """Return whether a scenario is a shipped one that is simulated from the model of the same name."""
    return (
        isinstance(scenario, Mapping)
        and scenario.get("_target_") == "pfbench.scenario.ModelSimulation"
        and name in list_named_parts("scenario")
    )


_TABLE = "_in"  # end of the names of tables from which an experiment takes `runs` or `seed`; no settings of a job
SUFFIX = "tuned"  # end of the names of the tuned filters
TUNED_METHODS = ("ekf_scaled", "gate", "huber", "student")
FILTER_SETS = {"tuned_baselines": tuple(f"{method}_{SUFFIX}" for method in TUNED_METHODS)}


def expand_filter_names(names: str) -> str:
    """Replace named sets in a list of filters.

    Returns names of filters, each once.
    """
    members = [FILTER_SETS.get(name.strip(), (name,)) for name in names.split(",")]
    return ",".join(dict.fromkeys(name for several in members for name in several))


def expand_filter_sets(words: Sequence[str]) -> list[str]:
    """Replace named sets in the overrides of a sweep, and numbers of papers by the groups of their readings.

    Returns the words, `filter=tuned_baselines` as the list of its filters.
    """
    return [
        f"filter={expand_filter_names(word.removeprefix('filter='))}"
        if re.match(r"filter=[\w,]+$", word) and set(word[7:].split(",")) & set(FILTER_SETS)
        else word
        for word in name_readings(words)
    ]


# --------------------------------------------------------------------------------------------------
# Readings of the papers: Hydra groups whose files set the world of a paper and, by name, its filters.
#
# A word `reading/001=NAME` chooses the row NAME of conf/reading/paper_001.yaml: a group of Hydra must not begin with a digit.

READING = "reading"
CLASSES = ("printed", "cited", "ours", "fitted")
_STATED = {"factor", "class", "why", "filters", "cites", "completions"}


def name_readings(words: Sequence[str]) -> list[str]:
    """Replace the number of a paper by its group: `reading/001=` by `reading/paper_001=`."""
    return [re.sub(r"^(\+*reading/)(\d{3}=)", r"\1paper_\2", word) for word in words]


def apply_readings(tree: Any, choices: Mapping[str, str]) -> None:
    """Apply the settings that the chosen readings have for the filter of a job, and remove their node."""
    from omegaconf import OmegaConf, flag_override

    if READING not in tree:
        return
    node: Any = tree[READING]
    require(
        OmegaConf.is_dict(node),
        READING,
        "be papers with their readings",
        f"{node!r:.80}",
        f"Choose one by {READING}/NUMBER=NAME: pfbench list {READING}",
    )
    node = OmegaConf.to_container(node, resolve=False)
    with flag_override(tree, ["struct", "readonly"], [False, False]):
        del tree[READING]
        for paper, stated in node.items():
            check_reading(paper, stated)
            settings = (stated.get("filters") or {}).get(choices.get("filter")) or {}
            for key, value in settings.items():
                OmegaConf.update(tree["filter"], key, value, merge=False, force_add=True)


def check_reading(paper: str, stated: Any) -> None:
    """Check what a reading states of itself."""
    key = f"{READING}.{paper}"
    require(
        isinstance(stated, Mapping) and {"factor", "class", "why"} <= set(stated) <= _STATED,
        key,
        "state factor, class and why, perhaps filters, cites and completions",
        f"{stated!r:.120}",
        "Correct the file.",
    )
    require(
        stated["class"] in CLASSES,
        f"{key}.class",
        f"be one of {', '.join(CLASSES)}",
        f"{stated['class']!r}",
        "Choose one.",
    )
    filters = stated.get("filters") or {}
    require(
        isinstance(filters, Mapping) and all(isinstance(v, Mapping) for v in filters.values()),
        f"{key}.filters",
        "give keys and values to names of filters",
        f"{filters!r:.80}",
        "Write sir: {resampler.ess_threshold: 0.5}.",
    )
