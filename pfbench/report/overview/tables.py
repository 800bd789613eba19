"""Tables of the first page: worlds, cells, pairs and winners, selected from the court of the study."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import yaml

from pfbench.core.parameter_checks import require
from pfbench.files import limits
from pfbench.results.conditions import drop_settings, parse_label
from pfbench.results.looks import MethodLook, PartName, find_looks
from pfbench.results.paper_block import list_named_parts, read_paper_block, read_part
from pfbench.results.store import SAME_TIME
from pfbench.stats.comparison import (
    EQUAL_WORDS,
    FAR,
    MOST_LOST,
    Verdict,
    find_largest_p,
    subtract_losses,
)
from pfbench.stats.court import TRACK_SHARE, Court, Pair
from pfbench.stats.error_measures import Array, Flags
from pfbench.stats.rank_tests import holm
from pfbench.stats.study_size import count_needed_runs

FEWEST_METHODS, FEWEST_WORLDS = 3, 2  # from which a study has this page
CENTRAL = "nominal"  # regime of the page, if a world has several
SIR = "sir"
# that stand next to the methods
CONVENTIONAL = (SIR, "rpf", "rpf_tuned", "ekf_bank", "neural_mixture")
PLANNED_RATIO = 0.8  # for which the runs of a cell are counted
METRIC = "rmse"  # of all words of the page
DEAD_RECKONING, PLAIN = "dead_reckoning", "ukf"
TabKey = int | str  # a number of particles, 0 for a study of one number, or one of those below
EQUAL_TIME, PRINTED, WITH_KNOBS, AT_HOME = "equal time", "as printed", "tuned", "at home"
_TUNING_BYTES = 1_000_000
_FAMILIES = ("particle", "guided", "swarm", "gaussian", "learned", "kalman", "")


class WorldFacts(NamedTuple):
    """Facts of a world that the file of its tuning states, from another seed than that of a study.

    Attributes:
        reference: Best conventional filter.
        kalman_fits: Whether Kalman filters fit the world; None if it is not known.
        has_part: Whether the tuning had settings of the scenario of its own, such as a part of a recording.
        tuning: All that the file states, such as the computing time of each filter.
    """

    reference: str
    kalman_fits: bool | None
    has_part: bool = False
    tuning: Mapping[str, Any] = {}


class World(NamedTuple):
    """A world of the page, and where the court of the study has it.

    Attributes:
        key: Name of the scenario.
        court: Court of the study.
        mask: Condition of the world, [C].
        labels: Labels of the study, by the names of the filters in their table.
        reference: Name of the conventional filter with which all others are compared, fixed before the study.
        facts: Facts of the world, by a rule on another seed.
        part_name: Name of the world for a reader, with its unit and its limit.
    """

    key: str
    court: Court
    mask: Flags
    labels: Mapping[str, str]
    reference: str = ""
    facts: WorldFacts = WorldFacts("", None)
    part_name: PartName = PartName("", "", "")

    @property
    def runs(self) -> int:
        """Number of runs of the reference."""
        return self.losses(self.reference).shape[1]

    @property
    def level(self) -> float:
        """Error of the reference, median over runs; infinite if it loses half of them."""
        return float(np.exp(np.median(self.losses(self.reference))))

    def find(self, a: str, b: str) -> Verdict:
        """Return the verdict of the study on two filters of the table."""
        verdict = self.court.find(METRIC, self.mask, self.labels[a], self.labels[b])
        return verdict._replace(a=a, b=b)

    def losses(self, *names: str) -> Array:
        """Return the losses of some filters in the runs that all of them have, [F, n]; infinite for a lost run."""
        index = [self.court.runs.filters.index(self.labels[name]) for name in names]
        losses = self.court.losses(METRIC, self.mask)[index, 0]
        return np.asarray(losses[:, ~np.isnan(losses).any(axis=0)])

    def weigh(self, name: str) -> str:
        """Name the probabilities that a filter is better than the reference, equal and worse."""
        return self.court.weigh(METRIC, self.mask, self.labels[name], self.labels[self.reference])

    def share_track(self, name: str) -> float:
        """Return the share of runs in which a filter keeps track."""
        return float(np.isfinite(self.losses(name)).mean())


class WorldCell(NamedTuple):
    """A row of the frame of a page: a pair of filters in a world.

    Attributes:
        world: Name of the scenario.
        verdict: Verdict on the first filter: against the reference of the world, or against another method.
        track_share: Share of runs in which the first filter keeps track.
        loses_track: Whether it is shown that this share is below 0.8.
        p_every: Largest p-value against all baselines of the world, with Holm's correction; None if it is not asked.
        wins: Whether it is better than all of them; None if it is not asked.
        beats_kalman: Whether it is better than every single Kalman filter of the world.
    """

    world: str
    verdict: Verdict
    track_share: float = math.nan
    loses_track: bool = False
    p_every: float | None = None
    wins: bool | None = None
    beats_kalman: bool = False

    @property
    def filter(self) -> str:
        """Name of the first filter."""
        return self.verdict.a


class Overview(NamedTuple):
    """All that the first page shows.

    Attributes:
        worlds: Worlds, those that Kalman filters fit first.
        methods: Proposed methods, in the order of the page.
        conventional: Conventional filters that stand next to them.
        single: Single Kalman filters.
        names: Names of all filters.
        cells: Methods and conventional filters against the reference of each world.
        pairs: All pairs of methods in each world.
        times: Median time of a step [ms] by world and filter.
        left_out: Worlds that are not on the page, with the reason.
        numbers: Number of particles of the filters that have another one than the title of their table states.
    """

    worlds: Sequence[World]
    methods: Sequence[str]
    conventional: Sequence[str]
    single: Sequence[str]
    names: Mapping[str, str]
    cells: Sequence[WorldCell]
    pairs: Sequence[WorldCell]
    times: Mapping[tuple[str, str], float]
    left_out: Mapping[str, str]
    numbers: Mapping[str, float] = {}

    @property
    def columns(self) -> list[str]:
        """Methods and the conventional filters next to them."""
        return [*self.methods, *self.conventional]

    @property
    def world_names(self) -> dict[str, str]:
        """Names of the worlds for a reader, by key."""
        return {world.key: world.part_name.name for world in self.worlds}

    @property
    def of_methods(self) -> list[WorldCell]:
        """Methods against the reference of each world."""
        return [cell for cell in self.cells if cell.filter in self.methods]

    @property
    def has_times(self) -> bool:
        """True if all filters have times of a step."""
        return bool(self.times) and bool(np.isfinite(list(self.times.values())).all())

    def compare_times(self, label: str, base: str = "") -> dict[str, float]:
        """Return the time of a step relative to that of another filter, or of the reference, by the names of their worlds."""
        pairs = {
            w.part_name.name: ((w.key, label), (w.key, base or w.reference)) for w in self.worlds
        }
        return {
            name: self.times[first] / self.times[second]
            for name, (first, second) in pairs.items()
            if {first, second} <= self.times.keys()
        }

    def find(self, world: World, label: str) -> WorldCell | None:
        """Return a filter against the reference of a world; None where it did not run."""
        return next((c for c in self.cells if (c.world, c.filter) == (world.key, label)), None)


def read_world_facts(scenario: str, model: str) -> WorldFacts | None:
    """Read the facts of a world from the files of tunings, the nominal regime and the scenario without changes first; None without one.

    They are those of pfbench, and those that `pfbench tune` wrote into `conf` of the current folder.
    """
    stated = {"scenario": scenario, "model": model}
    tunings = [
        tuning for tuning in (*_read_shipped_tunings(), *_read_own_tunings())
        if tuning.get("best") and stated.items() <= (tuning.get("world") or {}).items()
    ]  # fmt: skip
    if not tunings:
        return None
    by_settings = sorted(tunings, key=lambda tuning: bool(tuning["world"].get("settings")))
    first = min(by_settings, key=lambda tuning: tuning["world"].get("regimes") != [CENTRAL])
    has_part = bool(first["world"].get("settings"))
    return WorldFacts(str(first["best"]), first.get("kalman_fits"), has_part, first)


@cache
def _read_shipped_tunings() -> list[Mapping[str, Any]]:
    """Read the tunings of pfbench."""
    return [yaml.safe_load(read_part("tuned", name)) for name in list_named_parts("tuned")]


def _read_own_tunings() -> Iterator[Mapping[str, Any]]:
    """Yield the tunings in `conf` of the current folder. A file that cannot be read is left out."""
    for path in sorted(Path("conf/tuned").glob("*.yaml")):
        limits.check_is_file(path, _TUNING_BYTES)
        with suppress(yaml.YAMLError, UnicodeDecodeError):  # a composition that uses it says so
            content = yaml.safe_load(path.read_text(encoding="utf-8"))
            yield from [content] if isinstance(content, dict) else []


def has_overview(table: pd.DataFrame, looks: Mapping[str, MethodLook]) -> bool:
    """Return whether a study has several proposed methods in several worlds."""
    methods = {parse_label(label)[0] for label in looks if is_method(looks[label])}
    return len(methods) >= FEWEST_METHODS and table["scenario"].nunique() >= FEWEST_WORLDS


def is_method(look: MethodLook) -> bool:
    """Return whether a filter is a proposed method, and not another form of one, such as that as printed."""
    return look.proposed and not read_paper_block("filter", parse_label(look.key)[0]).get("form_of")


def has_form(form: str, look: MethodLook) -> bool:
    """Return whether a filter is a proposed method as printed, with the completions that it names, or with knobs that a tuning chose."""
    return (
        look.proposed and read_paper_block("filter", parse_label(look.key)[0]).get("form") == form
    )


def plan_world_pairs(table: pd.DataFrame, looks: Mapping[str, MethodLook]) -> dict[str, list[Pair]]:
    """List the pairs that the first page of a study fixes in each world, before its results; nothing for other studies.

    They are all filters with the reference of the world and with the plain UKF, and all methods of one table.
    """
    if not has_overview(table, looks):
        return {}
    keys = {
        label: PRINTED if has_form("printed", look) else EQUAL_TIME if _has_equal_time(label) else _level(label)
        for label, look in looks.items() if is_method(look) or has_form("printed", look)
    }  # fmt: skip
    methods = [
        (a, b) for a, b in combinations(keys, 2)
        if keys[a] == keys[b] or (None in (keys[a], keys[b]) and PRINTED not in (keys[a], keys[b]))
    ]  # fmt: skip
    pairs = {}
    for name, rows in table.groupby("scenario", observed=True, sort=False):
        facts = read_world_facts(str(name), _name_model(central_rows(rows).iloc[0]))
        bases = {PLAIN, facts.reference if facts else PLAIN}
        references = [label for label in looks if parse_label(label)[0] in bases]
        pairs[str(name)] = [*methods, *((a, b) for b in references for a in looks if a != b)]
    return pairs


def decide_cells(worlds: Sequence[World], filters: Sequence[str]) -> list[WorldCell]:
    """Select the verdicts on filters against the reference of each world, without it and without absent filters."""
    cells = []
    for world in worlds:
        lost = world.court.find_lost(world.mask)
        cells += [
            WorldCell(world.key, world.find(name, world.reference), world.share_track(name), world.labels[name] in lost)
            for name in filters if name in world.labels and name != world.reference
        ]  # fmt: skip
    return cells


def find_winners(
    worlds: Sequence[World], methods: Sequence[str], baselines: Sequence[str]
) -> dict[tuple[str, str], tuple[float, bool]]:
    """Find methods that are better than every baseline of a world, with Holm's correction over worlds and methods.

    Returns the largest p-value of all baselines and tests, and whether a method is better than all, by world and method.
    """
    keys = [(w, m) for w in worlds for m in methods if m in w.labels]
    largest = [
        find_largest_p([(both[0], both[1]) for b in baselines if b in w.labels for both in [w.losses(m, b)]])
        for w, m in keys
    ]  # fmt: skip
    return {
        (w.key, m): (float(p), bool(p < w.court.alpha))
        for (w, m), p in zip(keys, holm(largest), strict=True)
    }


def count_wins(pairs: Sequence[WorldCell], worlds: Sequence[str]) -> Counter[Pair]:
    """Count the worlds in which the first method of a pair is better than the second."""
    verdicts = [pair.verdict for pair in pairs if pair.world in worlds]
    wins = [(v.a, v.b) for v in verdicts if v.word == "better"]
    return Counter([*wins, *((v.b, v.a) for v in verdicts if v.word == "worse")])


def find_outdone(world: World, single: Sequence[str]) -> Verdict | None:
    """Find the single Kalman filter than which the reference, chosen on another seed, is worst in these runs."""
    others = [name for name in single if name in world.labels and name != world.reference]
    verdicts = [world.find(world.reference, name) for name in others]
    worse = [verdict for verdict in verdicts if verdict.word == "worse"]
    return max(worse, key=lambda v: v.ratio if v.ratio > 0 else math.inf, default=None)


def count_runs_of_cells(overview: Overview) -> list[tuple[WorldCell, float]]:
    """Count the runs that show 0.8 of the error of the strongest conventional filter, for each cell of a method.

    The level is the first of Holm's correction over all these cells. A cell is left out if more than a fifth of its runs is lost.
    """
    worlds = {world.key: world for world in overview.worlds}
    counted = []
    for cell in overview.of_methods:
        world = worlds[cell.world]
        rivals = [v for v in (*overview.single, *overview.conventional) if v in world.labels]
        strongest = min(rivals, key=lambda name: float(np.median(world.losses(name))))
        d = subtract_losses(*world.losses(cell.filter, strongest))
        if np.isinf(d).mean() <= MOST_LOST and d.any():
            level = world.court.alpha / len(overview.of_methods)
            needed = count_needed_runs(np.clip(d, -FAR, FAR), PLANNED_RATIO, level)
            counted.append((cell, needed))
    return counted


def list_world_notes(world: World) -> list[str]:
    """List what must be known before a number of a world is quoted."""
    drives, share = (
        count_recorded_drives(parse_label(world.key)[0]),
        world.share_track(world.reference),
    )
    same = "it" if drives == 1 else f"the same {drives} recordings"
    is_part = bool(drives and world.facts.has_part)
    idle = [name for name in world.labels if parse_label(name)[0] == DEAD_RECKONING]
    notes = (
        (drives == 1, "one recording: words are about other starts and random numbers on it"),
        (is_part, "the best Kalman filter was tuned on a part of it"),
        (drives and not is_part, f"the best Kalman filter was tuned on {same}, with other random numbers"),
        (idle and world.find(world.reference, idle[0]).word != "better", "the best Kalman filter is not shown to be better than dead reckoning"),
        (share < TRACK_SHARE, f"the best Kalman filter keeps track in {100 * share:.0f} % of runs"),
    )  # fmt: skip
    return [text for is_so, text in notes if is_so]


def count_recorded_drives(scenario: str) -> int:
    """Count the recorded drives of a scenario by its file; 0 for simulated data or without a file."""
    node = _read_scenario(scenario)
    return len(node.get("flights") or (1,)) if "root" in node else 0


def _read_scenario(name: str) -> dict[str, Any]:
    """Read the file of a scenario, in pfbench or in `conf` of the current folder, with those on which it is based."""
    path = Path("conf", "scenario", f"{name}.yaml")
    text = read_part("scenario", name) or (path.read_text("utf-8") if path.is_file() else "")
    content = yaml.safe_load(text) or {}
    values: dict[str, Any] = {}
    for base in content.get("defaults", ()):
        if isinstance(base, str) and base != "_self_":
            values |= _read_scenario(base)
    return values | content


def build_overviews(
    table: pd.DataFrame,
    looks: Mapping[str, MethodLook],
    parts: Mapping[str, PartName],
    court: Court,
) -> dict[TabKey, Overview]:
    """Collect the tables of each number of particles, with the key 0 for a study of one number.

    A filter without a number of particles is in all of them. Filters at equal time, and methods as printed,
    have tables of their own. A table has the worlds in which it has other runs than the others.

    Args:
        table: Runs of a study, as `add_levels` returns them.
        looks: Looks by label.
        parts: Names of the scenarios by key.
        court: Court of these runs.
    """
    levels, timed = list_levels(looks), [label for label in looks if _has_equal_time(label)]
    rest = [label for label in looks if label not in timed]
    tabs: dict[TabKey, _Tab] = {
        key: _Tab([label for label in rest if _level(label) in (None, key)], key) for key in levels
    }
    tabs = tabs or {0: _Tab(rest)}
    if sum(is_method(looks[label]) for label in timed) >= FEWEST_METHODS:
        names = {name_without_level(label) for label in timed}
        fixed = [label for label in looks if _level(label) is None and label not in names]
        tabs[EQUAL_TIME] = _Tab([*timed, *fixed])
    for key, form in ((PRINTED, "printed"), (WITH_KNOBS, "tuned")):
        forms = [label for label, look in looks.items() if has_form(form, look)]
        if len(forms) >= FEWEST_METHODS:
            number = table.loc[table["filter"].isin(forms), "particles"].dropna().median()
            others = [v for v in rest if _level(v) in (None, number) and not is_method(looks[v])]
            tabs[key] = _Tab(others, 0, partial(has_form, form))
    by_world = table.groupby("scenario", observed=True, sort=False)
    central = {str(key): central_rows(rows).iloc[0] for key, rows in by_world}
    return {key: _build_tab(tab, central, looks, parts, court) for key, tab in tabs.items()}


class _Tab(NamedTuple):
    """Filters of a table, its number of particles if it is counted, and whether a filter is one of its methods."""

    labels: Sequence[str]
    level: int | None = None
    is_shown: Callable[[MethodLook], bool] = is_method


def add_levels(table: pd.DataFrame, looks: Mapping[str, MethodLook]) -> pd.DataFrame:
    """Name the filters of worlds with one number of particles as those of worlds with several."""
    swept = {
        (parse_label(label)[0], _level(label)): label
        for label in looks
        if _level(label) is not None and not _has_equal_time(label)
    }
    if not swept or "particles" not in table:
        return table
    plain, counts = table["filter"].astype(str), table["particles"]
    labels = [
        label if "[" in label or pd.isna(count) else swept.get((label, int(count)), label)
        for label, count in zip(plain, counts, strict=True)
    ]
    return table.assign(filter=labels)


def _build_tab(
    tab: _Tab,
    central: Mapping[str, pd.Series[Any]],
    looks: Mapping[str, MethodLook],
    parts: Mapping[str, PartName],
    court: Court,
) -> Overview:
    """Collect the tables of some filters, under names without their numbers of particles.

    A world without a stated reference, or without runs of it, is left out with the reason.
    """
    present, scenarios = np.any(court.runs.present, axis=2), court.runs.conditions["scenario"]
    where = {v: set(scenarios[present[court.runs.filters.index(v)]]) for v in tab.labels}
    swept = [v for v in tab.labels if tab.is_shown is not is_method or name_without_level(v) != v]
    swept = [v for v in swept if tab.is_shown(looks[v])] or list(tab.labels)
    keys = [key for key in central if any(key in where[v] for v in swept)]
    labels = {name_without_level(v): v for v in tab.labels if where[v] & set(keys)}
    plain = find_looks(list(labels))
    kinds = {k: plain[k] if plain[k].family else replace(looks[v], key=k) for k, v in labels.items()}  # fmt: skip
    worlds, left_out = [], {}
    for key in keys:
        try:
            facts = _read_facts(key, _name_model(central[key]))
            worlds.append(build_world(parts[key], facts, court, str(central[key]["regime"]), labels))  # fmt: skip
        except ValueError as error:
            left_out[parts[key].name] = str(error)
    worlds.sort(key=lambda world: world.facts.kalman_fits is False)
    overview = _decide_tab(worlds, kinds, tab.is_shown)
    return overview._replace(left_out=left_out, numbers=_count_particles(tab, labels, court))


def _decide_tab(
    worlds: Sequence[World], looks: Mapping[str, MethodLook], is_shown: Callable[[MethodLook], bool]
) -> Overview:
    """Select all rows of a table from the court of its worlds."""
    methods = [label for label, look in looks.items() if is_shown(look)]
    methods.sort(key=lambda label: _FAMILIES.index(looks[label].family))  # one Gaussian last
    by_name = {parse_label(label)[0]: label for label in looks}
    conventional = [by_name[name] for name in CONVENTIONAL if name in by_name and name not in methods]  # fmt: skip
    baselines = [label for label, look in looks.items() if not look.proposed]
    single = [v for v in baselines if looks[v].family == "kalman" and parse_label(v)[0] not in CONVENTIONAL]  # fmt: skip
    every, kalman = (find_winners(worlds, methods, some) for some in (baselines, single))
    cells = [
        c._replace(p_every=every[key][0], wins=every[key][1], beats_kalman=kalman[key][1])
        if (key := (c.world, c.filter)) in every
        else c
        for c in decide_cells(worlds, [*methods, *conventional])
    ]
    pairs = [
        WorldCell(w.key, w.find(a, b))
        for w in worlds for a, b in combinations(methods, 2) if {a, b} <= set(w.labels)
    ]  # fmt: skip
    times = {(w.key, name): _find_time(w, label) for w in worlds for name, label in w.labels.items()}  # fmt: skip
    names = {label: look.name for label, look in looks.items()}
    return Overview(worlds, methods, conventional, single, names, cells, pairs, times, {})


def _find_time(world: World, label: str) -> float:
    """Return the median time of a step of a filter in all regimes of a world [ms]."""
    runs = world.court.runs
    of_world = (runs.conditions["scenario"] == world.key).to_numpy()
    times = runs.values["ms"][runs.filters.index(label), of_world]
    return float(np.median(times[np.isfinite(times)])) if np.isfinite(times).any() else math.nan


def _count_particles(tab: _Tab, labels: Mapping[str, str], court: Court) -> dict[str, float]:
    """Count the particles of the filters of a table that have another number than its title."""
    if tab.level is None or "particles" not in court.runs.values:
        return {}
    counts = {
        name: court.runs.values["particles"][court.runs.filters.index(label)]
        for name, label in labels.items()
    }
    medians = {k: float(np.nanmedian(n)) for k, n in counts.items() if not np.isnan(n).all()}
    return {k: n for k, n in medians.items() if n != tab.level}


def list_levels(looks: Mapping[str, MethodLook]) -> list[int]:
    """List the numbers of particles of a study in which several proposed methods have several; else none."""
    labels = [label for label, look in looks.items() if is_method(look)]
    levels = Counter(_level(label) for label in labels if not _has_equal_time(label))
    several = sorted(n for n, count in levels.items() if n is not None and count >= FEWEST_METHODS)
    return several if len(several) > 1 else []


def name_without_level(label: str) -> str:
    """Return a label without its number of particles and the budget that determines it."""
    return drop_settings(label, "particles", "budget")


def _level(label: str) -> int | None:
    """Return the number of particles in a label; None without one."""
    number = parse_label(label)[1].get("particles", "")
    return int(number) if number.isdigit() else None


def _has_equal_time(label: str) -> bool:
    """Return whether the number of particles of a job follows from a time."""
    return parse_label(label)[1].get("budget") == SAME_TIME


def central_rows(rows: pd.DataFrame) -> pd.DataFrame:
    """Select the central noise regime of a world."""
    regimes: Collection[str] = rows["regime"].unique()
    return rows[rows["regime"] == (CENTRAL if CENTRAL in regimes else next(iter(regimes)))]


def _name_model(row: pd.Series[Any]) -> str:
    """Name the model of a run; empty if its table does not state it."""
    return str(row.get("model", ""))


def _read_facts(scenario: str, model: str) -> WorldFacts:
    """Read the facts that the tuning of a world states."""
    facts = read_world_facts(scenario, model)
    if facts is None:
        raise ValueError(
            f"{scenario} must have a tuning that states its best conventional filter, got none. "
            f"Run pfbench tune scenario={scenario} model={model}."
        )
    return facts


def build_world(
    part_name: PartName, facts: WorldFacts, court: Court, regime: str, labels: Mapping[str, str]
) -> World:
    """Build a world with the reference that its tuning states.

    Args:
        part_name: Name of the world.
        facts: Facts of the world.
        court: Court of the study.
        regime: Noise regime of the page.
        labels: Labels of the court, by the names of the filters.

    Raises:
        ValueError: If runs of the reference are missing.
    """
    runs, conditions = court.runs, court.runs.conditions
    mask = ((conditions["scenario"] == part_name.key) & (conditions["regime"] == regime)).to_numpy()
    present_labels = {k: v for k, v in labels.items() if runs.present[runs.filters.index(v), mask].any()}  # fmt: skip
    by_name = {parse_label(name)[0]: name for name in present_labels}
    require(
        facts.reference in by_name,
        part_name.key,
        f"have runs of its reference {facts.reference}",
        "none",
        f"Run filter={facts.reference} in this study.",
    )
    return World(
        part_name.key, court, mask, present_labels, by_name[facts.reference], facts, part_name
    )


def tell_story(overview: Overview, method: str, summary: str) -> dict[str, str]:
    """Return what a method is, where it wins and loses, and the time of its step, with numbers from the tables.

    A win that is not shown against every single Kalman filter has a dagger, one against every conventional filter a star.
    """
    cells = [cell for cell in overview.cells if cell.filter == method]
    cells.sort(key=_distance, reverse=True)

    def join(word: str, mark: str = "") -> str:
        """Join the worlds of a word, with the ratios of those that are not near 1."""
        return "; ".join(
            overview.world_names[cell.world]
            + f" ({name_size(cell)}{'☆' if cell.wins else mark * (not cell.beats_kalman)})" * (word in ("better", "worse"))
            for cell in cells if name_word(cell) == word
        )  # fmt: skip

    lost = join("loses track")
    return {
        "name": overview.names[method],
        "is": summary,
        "wins": join("better", "†") or "None shown.",
        "equal": join("equal") or "–",
        "open": join("not decided") or "–",
        "loses": ". ".join(filter(None, (join("worse"), f"Loses track: {lost}" * bool(lost)))) or "None shown.",
        "time": format_times(overview, method),
    }  # fmt: skip


def _distance(cell: WorldCell) -> float:
    """Return the distance of a ratio from 1; infinite where lost runs leave none."""
    return abs(math.log(cell.verdict.ratio)) if cell.verdict.ratio > 0 else math.inf


def name_size(cell: WorldCell) -> str:
    """Format the ratio of a cell; the share of runs that keep track where lost runs leave none."""
    if cell.verdict.ratio > 0:
        return f"{cell.verdict.ratio:.2f}"
    return f"{100 * cell.track_share:.0f} % keep track"


def pair_forms(overview: Overview, tuned: Overview) -> list[tuple[WorldCell, WorldCell]]:
    """Pair the cells of methods with those of their tuned forms."""
    cells = {
        (cell.world, f"{parse_label(cell.filter)[0]}_tuned"): cell for cell in overview.of_methods
    }
    keys = [((cell.world, parse_label(cell.filter)[0]), cell) for cell in tuned.of_methods]
    return [(cells[key], cell) for key, cell in keys if key in cells]


def name_word(cell: WorldCell) -> str:
    """Name the word of a cell for a reader."""
    plain = "equal" if cell.verdict.word in EQUAL_WORDS else cell.verdict.word
    return "loses track" if cell.loses_track else plain


def format_times(overview: Overview, method: str) -> str:
    """Return median and range over worlds of the time of a step, relative to that of the reference of the world.

    The median relative to SIR with as many particles follows, if SIR is in the study.
    """
    finite = [ratio for ratio in overview.compare_times(method).values() if np.isfinite(ratio)]
    if not finite:
        return "–"
    middle, low, high = (format_factor(f(finite)) for f in (np.median, min, max))
    text = middle if low == high else f"{middle} ({low} to {high})"
    sir = [ratio for ratio in overview.compare_times(method, SIR).values() if np.isfinite(ratio)]
    return f"{text}; {format_factor(float(np.median(sir)))} of SIR" if sir else text


def format_factor(value: float) -> str:
    """Format a factor with two digits."""
    return f"{value:.0f}" if value >= 9.95 else f"{value:.2g}"
