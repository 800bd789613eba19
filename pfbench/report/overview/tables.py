"""Tables of the first page: worlds, cells, pairs and winners, selected from the court of the study."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import combinations
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import yaml

from pfbench.files import limits
from pfbench.results.conditions import parse_label
from pfbench.results.looks import MethodLook, PartName, find_looks
from pfbench.results.paper_block import conf_dir, read_paper_block
from pfbench.results.store import SAME_TIME
from pfbench.stats.comparison import EQUAL_WORDS, Verdict, find_largest_p
from pfbench.stats.court import TRACK_SHARE, Court, Pair
from pfbench.stats.error_measures import Array, Flags
from pfbench.stats.rank_tests import holm

FEWEST_METHODS, FEWEST_WORLDS = 3, 2  # from which a study has this page
CENTRAL = "nominal"  # regime of the page, if a world has several
SIR = "sir"
CONVENTIONAL = (SIR, "rpf", "rpf_tuned", "ekf_bank")  # that stand next to the methods
METRIC = "rmse"  # of all words of the page
DEAD_RECKONING, PLAIN = "dead_reckoning", "ukf"  # the second is as little tuned as the methods
TabKey = int | str  # a number of particles, 0 for a study of one number, or one of the two below
EQUAL_TIME, PRINTED = "equal time", "as printed"
_TUNING_BYTES = 1_000_000
_WORDS = ("better", "worse", *EQUAL_WORDS, "not decided")
_FAMILIES = ("particle", "guided", "swarm", "gaussian", "learned", "kalman", "")


class World(NamedTuple):
    """A world of the page, and where the court of the study has it.

    Attributes:
        name: Name of the scenario.
        reference: Conventional filter with which all others are compared, fixed before the study.
        kalman_fits: Whether Kalman filters fit the world, by a rule on another seed; None if unknown.
        court: Court of the study.
        mask: Condition of the world, [C].
        labels: Labels of the study, by the names of the filters in their table.
    """

    name: str
    reference: str
    kalman_fits: bool | None
    court: Court
    mask: Flags
    labels: Mapping[str, str]

    def find(self, a: str, b: str) -> Verdict:
        """Return the verdict of the study on two filters of the table."""
        verdict = self.court.find(METRIC, self.mask, self.labels[a], self.labels[b])
        return verdict._replace(a=a, b=b)

    def losses(self, *names: str) -> Array:
        """Return the losses of some filters in the runs that all of them have, [F, n]; infinite for a lost run."""
        index = [self.court.runs.filters.index(self.labels[name]) for name in names]
        losses = self.court.losses(METRIC, self.mask)[index, 0]
        return np.asarray(losses[:, ~np.isnan(losses).any(axis=0)])

    def share_track(self, name: str) -> float:
        """Return the share of runs in which a filter keeps track."""
        return float(np.isfinite(self.losses(name)).mean())


class WorldResult(NamedTuple):
    """A filter in a world.

    Attributes:
        world: Name of the world.
        filter: Label of the filter.
        verdict: Verdict on the filter against the reference of the world.
        track_share: Share of runs that keep track.
        loses_track: Whether it is shown that this share is below 0.8.
    """

    world: str
    filter: str
    verdict: Verdict
    track_share: float
    loses_track: bool


class WorldPair(NamedTuple):
    """A pair of methods in a world."""

    world: str
    verdict: Verdict


class Winner(NamedTuple):
    """Test of a method against all baselines of a world.

    Attributes:
        world: Name of the world.
        filter: Label of the method.
        p: Largest p-value of all baselines and tests, with Holm's correction.
        wins: Whether it is better than all of them.
    """

    world: str
    filter: str
    p: float
    wins: bool


class WorldRow(NamedTuple):
    """A world of the page.

    Attributes:
        key: Name of the scenario, with its model if the study has several.
        name: Name for a reader.
        reference: Name of the conventional filter that is best on the seed of the tuning.
        level: Error of the reference, median over runs; infinite if it loses half of them.
        unit: Unit of the error.
        runs: Number of runs.
        kalman_fits: Whether Kalman filters fit the world; None without a tuning.
        words: What the world is, in a line.
        limit: Error above which a run has lost the track; NaN without one.
        outdone: Verdict on the reference against the best other single Kalman filter, if that is better in these runs.
        notes: What must be known before a number of the world is quoted.
        plain_losses: Methods that are worse than the reference and than the UKF, which is not tuned; None without a UKF.
    """

    key: str
    name: str
    reference: str
    level: float
    unit: str
    runs: int
    kalman_fits: bool | None
    words: str = ""
    limit: float = math.nan
    outdone: Verdict | None = None
    notes: tuple[str, ...] = ()
    plain_losses: tuple[str, ...] | None = None


class Overview(NamedTuple):
    """All that the first page shows.

    Attributes:
        worlds: Worlds, those that Kalman filters fit first.
        methods: Proposed methods, in the order of the page.
        conventional: Conventional filters that stand next to them.
        names: Names of all filters.
        cells: Methods and conventional filters against the reference of each world.
        pairs: All pairs of methods in each world.
        winners: Methods that are better than every conventional filter of a world.
        times: Median time of a step [ms] by world and filter.
        left_out: Worlds that are not on the page, with the reason.
        kalman_winners: Methods that are better than each single Kalman filter of a world.
        numbers: Number of particles of the filters that have another one than the title of their table states.
    """

    worlds: tuple[WorldRow, ...]
    methods: tuple[str, ...]
    conventional: tuple[str, ...]
    names: Mapping[str, str]
    cells: Sequence[WorldResult]
    pairs: Sequence[WorldPair]
    winners: Sequence[Winner]
    times: Mapping[tuple[str, str], float]
    left_out: Mapping[str, str]
    kalman_winners: Sequence[Winner]
    numbers: Mapping[str, float] = MappingProxyType({})


class WorldFacts(NamedTuple):
    """Facts of a world that the file of its tuning states, from another seed than that of a study.

    Attributes:
        reference: Best conventional filter.
        kalman_fits: Whether Kalman filters fit the world; None if it is not known.
        has_part: Whether the tuning had settings of the scenario of its own, such as a part of a recording.
    """

    reference: str
    kalman_fits: bool | None
    has_part: bool = False


def read_world_facts(scenario: str, model: str) -> WorldFacts | None:
    """Read the facts of a world from the files of tunings, the nominal regime first; None without one.

    They are those of pfbench, and those that `pfbench tune` wrote into `conf` of the current folder.
    """
    candidates: list[tuple[bool, WorldFacts]] = []
    for folder in dict.fromkeys((conf_dir().resolve(), Path("conf").resolve())):
        for path in sorted((folder / "tuned").glob("*.yaml")):
            content = _read_tuning(path, path.stat().st_mtime_ns)
            world = content.get("world") or {}
            if (world.get("scenario"), world.get("model")) != (scenario, model):
                continue
            if content.get("best"):
                facts = WorldFacts(
                    str(content["best"]),
                    content.get("kalman_fits"),
                    bool(world.get("settings")),
                )
                candidates.append((world.get("regimes") != [CENTRAL], facts))
    return min(candidates, key=lambda item: item[0])[1] if candidates else None


@cache
def _read_tuning(path: Path, changed: int) -> Mapping[str, Any]:
    """Read a file of a tuning, again if it changed; nothing from a file that is none."""
    limits.check_is_file(path, _TUNING_BYTES)
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError):
        return {}  # a composition that uses it says so
    return content if isinstance(content, dict) else {}


def has_overview(table: pd.DataFrame, looks: Mapping[str, MethodLook]) -> bool:
    """Return whether a study has several proposed methods in several worlds."""
    methods = {parse_label(label)[0] for label in looks if is_method(looks[label])}
    return len(methods) >= FEWEST_METHODS and table["scenario"].nunique() >= FEWEST_WORLDS


def is_method(look: MethodLook) -> bool:
    """Return whether a filter is a proposed method, and not another form of one, such as that as printed."""
    return look.proposed and not _read_form(look).get("form_of")


def is_printed(look: MethodLook) -> bool:
    """Return whether a filter is a proposed method as printed, with the completions that it names."""
    return look.proposed and _read_form(look).get("form") == "printed"


def _read_form(look: MethodLook) -> Mapping[str, Any]:
    """Return the statements of the file of a filter on its form."""
    return read_paper_block("filter", parse_label(look.key)[0])


def plan_world_pairs(table: pd.DataFrame, looks: Mapping[str, MethodLook]) -> dict[str, list[Pair]]:
    """List the pairs that the first page of a study fixes in each world, before its results; nothing for other studies.

    They are all filters with the reference of the world and with the plain UKF, and all methods of one table.
    """
    if not has_overview(table, looks):
        return {}
    keys = {
        label: PRINTED if is_printed(look) else EQUAL_TIME if _has_equal_time(label) else _level(label)
        for label, look in looks.items() if is_method(look) or is_printed(look)
    }  # fmt: skip
    methods = [
        (a, b) for a, b in combinations(keys, 2)
        if keys[a] == keys[b] or (None in (keys[a], keys[b]) and PRINTED not in (keys[a], keys[b]))
    ]  # fmt: skip
    pairs = {}
    for name, rows in table.groupby("scenario", observed=True, sort=False):
        facts = _find_facts(central_rows(rows), str(name))
        bases = {PLAIN, facts.reference if facts else PLAIN}
        references = [label for label in looks if parse_label(label)[0] in bases]
        pairs[str(name)] = [*methods, *((a, b) for b in references for a in looks if a != b)]
    return pairs


def build_overview(
    table: pd.DataFrame,
    looks: Mapping[str, MethodLook],
    parts: Mapping[str, PartName],
    judged: tuple[Court, Mapping[str, str]],
    is_shown: Callable[[MethodLook], bool] = is_method,
) -> Overview:
    """Collect all that the first page shows.

    Args:
        table: Runs of the filters of the page.
        looks: Looks of the filters, by their names in the table.
        parts: Names of the scenarios by key.
        judged: Court of the study, and the labels that it has for the names of the table.
        is_shown: Whether a filter is one of the methods of the page.

    Returns:
        Tables of one study. A world without a stated reference, or without runs of it, is left out with the reason.
    """
    methods = order_methods([label for label in looks if is_shown(looks[label])], looks)
    by_name = {parse_label(label)[0]: label for label in looks}
    conventional = tuple(
        by_name[name] for name in CONVENTIONAL if name in by_name and name not in methods
    )
    worlds, rows, left_out, has_part = [], [], {}, {}
    for key, group in table.groupby("scenario", observed=True, sort=False):
        try:
            facts = _read_facts(central_rows(group), parts[str(key)])
            world = build_world(central_rows(group), facts, judged)
        except ValueError as error:
            left_out[parts[str(key)].name] = str(error)
            continue
        worlds.append(world)
        has_part[world.name] = facts.has_part
        rows.append(_describe_world(world, parts[str(key)], looks))
    order = sorted(range(len(worlds)), key=lambda k: worlds[k].kalman_fits is False)
    worlds, rows = [worlds[k] for k in order], [rows[k] for k in order]
    baselines = [label for label, look in looks.items() if not look.proposed]
    single = [
        v
        for v in baselines
        if looks[v].family == "kalman" and parse_label(v)[0] not in CONVENTIONAL
    ]
    cells = decide_cells(worlds, [*methods, *conventional])
    rows = [
        row._replace(
            outdone=find_outdone(world, single),
            notes=list_world_notes(world, has_part[world.name]),
            plain_losses=_find_plain_losses(world, [c.filter for c in cells if c.world == world.name and c.filter in methods and is_worse(c)]),
        )
        for row, world in zip(rows, worlds, strict=True)
    ]  # fmt: skip
    return Overview(
        tuple(rows), methods, conventional, {label: look.name for label, look in looks.items()},
        cells, compare_methods(worlds, methods), find_winners(worlds, methods, baselines),
        _list_times(table, [row.key for row in rows]), left_out, find_winners(worlds, methods, single),
    )  # fmt: skip


def is_worse(cell: WorldResult) -> bool:
    """Return whether a filter is worse than the reference of its world, and does not lose track."""
    return cell.verdict.word == "worse" and not cell.loses_track


def decide_cells(worlds: Sequence[World], filters: Sequence[str]) -> list[WorldResult]:
    """Select the verdicts on filters against the reference of each world, without it and without absent filters."""
    cells = []
    for world in worlds:
        lost = world.court.find_lost(world.mask)
        cells += [
            WorldResult(world.name, name, world.find(name, world.reference), world.share_track(name), world.labels[name] in lost)
            for name in filters if name in world.labels and name != world.reference
        ]  # fmt: skip
    return cells


def compare_methods(worlds: Sequence[World], methods: Sequence[str]) -> list[WorldPair]:
    """Select the verdicts on all pairs of methods in all worlds."""
    return [
        WorldPair(world.name, world.find(a, b))
        for world in worlds for a, b in combinations(methods, 2) if {a, b} <= set(world.labels)
    ]  # fmt: skip


def find_winners(
    worlds: Sequence[World], methods: Sequence[str], baselines: Sequence[str]
) -> list[Winner]:
    """Find methods that are better than every baseline of a world, with Holm's correction over worlds and methods."""
    keys = [(w, m) for w in worlds for m in methods if m in w.labels]
    largest = [
        find_largest_p([(both[0], both[1]) for b in baselines if b in w.labels for both in [w.losses(m, b)]])
        for w, m in keys
    ]  # fmt: skip
    return [
        Winner(w.name, m, float(p), bool(p < w.court.alpha))
        for (w, m), p in zip(keys, holm(largest), strict=True)
    ]


def count_wins(pairs: Sequence[WorldPair], worlds: Sequence[str]) -> Counter[Pair]:
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


def _find_plain_losses(world: World, worse: Sequence[str]) -> tuple[str, ...] | None:
    """Find those of the worse methods that are worse than the plain UKF too; None without a UKF."""
    if PLAIN not in world.labels:
        return None
    is_same = world.reference == PLAIN
    return tuple(name for name in worse if is_same or world.find(name, PLAIN).word == "worse")


def list_world_notes(world: World, has_part: bool) -> tuple[str, ...]:
    """List what must be known before a number of a world is quoted.

    Args:
        world: World of the page.
        has_part: Whether its tuning had a part of its recording.
    """
    texts, drives = [], count_recorded_drives(parse_label(world.name)[0])
    if drives == 1:
        texts.append("one recording: words are about other starts and random numbers on it")
    if drives and has_part:
        texts.append("the best Kalman filter was tuned on a part of it")
    elif drives:
        same = "it" if drives == 1 else f"the same {drives} recordings"
        texts.append(f"the best Kalman filter was tuned on {same}, with other random numbers")
    idle = [name for name in world.labels if parse_label(name)[0] == DEAD_RECKONING]
    if idle and world.find(world.reference, idle[0]).word != "better":
        texts.append("the best Kalman filter is not shown to be better than dead reckoning")
    if (share := world.share_track(world.reference)) < TRACK_SHARE:
        texts.append(f"the best Kalman filter keeps track in {100 * share:.0f} % of runs")
    return tuple(texts)


def count_recorded_drives(scenario: str) -> int:
    """Count the recorded drives of a scenario by its file; 0 for simulated data or without a file."""
    node = _read_scenario(scenario)
    return len(node.get("flights") or (1,)) if "root" in node else 0


def _read_scenario(name: str) -> dict[str, Any]:
    """Read the file of a scenario, in pfbench or in `conf` of the current folder, with those on which it is based."""
    for folder in (conf_dir(), Path("conf")):
        path = folder / "scenario" / f"{name}.yaml"
        if path.is_file():
            content = yaml.safe_load(path.read_text(encoding="utf-8"))
            bases = [base for base in content.get("defaults", ()) if isinstance(base, str)]
            values: dict[str, Any] = {}
            for base in bases:
                values |= {} if base == "_self_" else _read_scenario(base)
            return values | content
    return {}


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
    levels: list[TabKey] = [*list_levels(looks)]
    timed = [label for label in looks if _has_equal_time(label)]
    printed = [label for label, look in looks.items() if is_printed(look)]
    overviews = {}
    for key in levels or [0]:
        labels = [label for label in looks if label not in timed and _level(label) in (None, key)]
        alone = labels if levels else [label for label in looks if label not in timed]
        tab = _build_tab(table, looks, parts, alone, court)
        overviews[key] = _count_particles(tab, table, labels, int(key)) if key else tab
    if sum(is_method(looks[label]) for label in timed) >= FEWEST_METHODS:
        names = {name_without_level(label) for label in timed}
        fixed = [label for label in looks if _level(label) is None and label not in names]
        overviews[EQUAL_TIME] = _build_tab(table, looks, parts, [*timed, *fixed], court)
    if len(printed) >= FEWEST_METHODS:
        number = table.loc[table["filter"].isin(printed), "particles"].dropna().median()
        same = [label for label in looks if label not in timed and _level(label) in (None, number)]
        others = [label for label in same if not is_method(looks[label])]
        tab = _build_tab(table, looks, parts, others, court, is_printed)
        overviews[PRINTED] = _count_particles(tab, table, others)
    return overviews


def _count_particles(
    tab: Overview, table: pd.DataFrame, labels: Sequence[str], level: int = 0
) -> Overview:
    """Count the particles of the filters of a tab that have another number than `level`."""
    rows = table[table["filter"].isin(labels)]
    if "particles" not in rows:
        return tab
    names = rows["filter"].astype(str).map(name_without_level)
    counts = rows.groupby(names)["particles"].median().dropna()
    others = {str(k): n for k, n in counts.items() if k in tab.names and n != level}
    return tab._replace(numbers=others)


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
    table: pd.DataFrame,
    looks: Mapping[str, MethodLook],
    parts: Mapping[str, PartName],
    labels: Sequence[str],
    court: Court,
    is_shown: Callable[[MethodLook], bool] = is_method,
) -> Overview:
    """Collect the tables of some filters under names without their numbers of particles."""
    names = {label: name_without_level(label) for label in labels}
    rows = table[table["filter"].isin(labels)]
    swept = [
        label for label in labels if is_shown is is_printed or name_without_level(label) != label
    ]
    methods = [label for label in swept if is_shown(looks[label])]
    if methods:
        worlds = rows.loc[rows["filter"].isin(methods), "scenario"].unique()
        rows = rows[rows["scenario"].isin(worlds)]
    rows = rows.assign(filter=rows["filter"].map(names))
    present = [name for name in dict.fromkeys(names.values()) if name in set(rows["filter"])]
    plain = find_looks(present)
    kinds = {names[label]: looks[label] for label in labels}
    present_looks = {k: plain[k] if plain[k].family else replace(kinds[k], key=k) for k in present}
    judged = court, {name: label for label, name in names.items()}
    return build_overview(rows, present_looks, parts, judged, is_shown)


def list_levels(looks: Mapping[str, MethodLook]) -> list[int]:
    """List the numbers of particles of a study in which several proposed methods have several; else none."""
    labels = [label for label, look in looks.items() if is_method(look)]
    levels = Counter(_level(label) for label in labels if not _has_equal_time(label))
    several = sorted(n for n, count in levels.items() if n is not None and count >= FEWEST_METHODS)
    return several if len(several) > 1 else []


def name_without_level(label: str) -> str:
    """Return a label without its number of particles and the budget that determines it."""
    name, settings = parse_label(label)
    others = [
        f"{key}={value}" for key, value in settings.items() if key not in ("particles", "budget")
    ]
    return f"{name}[{','.join(others)}]" if others else name


def _level(label: str) -> int | None:
    """Return the number of particles in a label; None without one."""
    number = parse_label(label)[1].get("particles", "")
    return int(number) if number.isdigit() else None


def _has_equal_time(label: str) -> bool:
    """Return whether the number of particles of a job follows from a time."""
    return parse_label(label)[1].get("budget") == SAME_TIME


def order_methods(labels: Sequence[str], looks: Mapping[str, MethodLook]) -> tuple[str, ...]:
    """Order methods: those of particles first, those of one Gaussian last."""
    return tuple(sorted(labels, key=lambda label: _FAMILIES.index(looks[label].family)))


def central_rows(rows: pd.DataFrame) -> pd.DataFrame:
    """Select the central noise regime of a world."""
    regimes: Collection[str] = rows["regime"].unique()
    return rows[rows["regime"] == (CENTRAL if CENTRAL in regimes else next(iter(regimes)))]


def _read_facts(rows: pd.DataFrame, name: PartName) -> WorldFacts:
    """Read the facts that the tuning of a world states."""
    facts = _find_facts(rows, name.key)
    if facts is None:
        raise ValueError(
            f"{name.key} must have a tuning that states its best conventional filter, got none. "
            f"Run pfbench tune scenario={name.key} model={_find_model(rows)}."
        )
    return facts


def _find_facts(rows: pd.DataFrame, scenario: str) -> WorldFacts | None:
    """Find the facts that the tuning of a world states; None without one."""
    return read_world_facts(scenario, _find_model(rows))


def _find_model(rows: pd.DataFrame) -> str:
    """Return the model of a world, empty if the table has none."""
    return str(rows["model"].iloc[0]) if "model" in rows else ""


def build_world(
    rows: pd.DataFrame, facts: WorldFacts, judged: tuple[Court, Mapping[str, str]]
) -> World:
    """Build a world with the reference that its tuning states.

    Args:
        rows: Runs of one condition.
        facts: Facts of the world.
        judged: Court of the study, and the labels that it has for the names of the table.

    Raises:
        ValueError: If runs of the reference are missing.
    """
    (court, labels), present = judged, set(rows["filter"])
    name, regime = str(rows["scenario"].iloc[0]), rows["regime"].iloc[0]
    by_name = {parse_label(label)[0]: label for label in labels if label in present}
    if facts.reference not in by_name:
        raise ValueError(
            f"{name} must have runs of its reference {facts.reference}, got none. Run filter={facts.reference} in this study."
        )
    conditions = court.runs.conditions
    mask = ((conditions["scenario"] == name) & (conditions["regime"] == regime)).to_numpy()
    present_labels = {key: label for key, label in labels.items() if key in present}
    return World(name, by_name[facts.reference], facts.kalman_fits, court, mask, present_labels)


def _describe_world(world: World, name: PartName, looks: Mapping[str, MethodLook]) -> WorldRow:
    """Return the row of a world."""
    losses = world.losses(world.reference)[0]
    return WorldRow(
        world.name, name.name, looks[world.reference].name, float(np.exp(np.median(losses))), name.unit,
        len(losses), world.kalman_fits, name.words, math.nan if name.limit is None else name.limit,
    )  # fmt: skip


def _list_times(table: pd.DataFrame, worlds: Sequence[str]) -> dict[tuple[str, str], float]:
    """List the times of a step by world and filter."""
    selected = table[table["scenario"].isin(list(worlds))]
    groups = selected.groupby(["scenario", "filter"], observed=True)
    return {(str(key[0]), str(key[1])): float(rows["ms"].median()) for key, rows in groups}


def tell_story(overview: Overview, method: str, summary: str) -> dict[str, str]:
    """Return what a method is, where it wins and loses, and the time of its step, with numbers from the tables.

    A win that is not shown against every single Kalman filter has a dagger.
    """
    cells = [cell for cell in overview.cells if cell.filter == method]
    names = {world.key: world.name for world in overview.worlds}
    over_all = {w.world for w in overview.kalman_winners if w.wins and w.filter == method}
    by_word: dict[str, list[WorldResult]] = {word: [] for word in (*_WORDS, "lost")}
    for cell in sorted(cells, key=_distance, reverse=True):
        by_word["lost" if cell.loses_track else cell.verdict.word].append(cell)

    def join(*words: str, dagger: Collection[str] = ()) -> str:
        """Join the worlds of some words, with the ratios of those that are not near 1."""
        return "; ".join(
            names[cell.world]
            + (
                f" ({_size(cell)}{'†' if cell.world in dagger else ''})"
                * (word in ("better", "worse"))
            )
            for word in words
            for cell in by_word[word]
        )

    losses = [join("worse"), f"Loses track: {join('lost')}" if by_word["lost"] else ""]
    return {
        "name": overview.names[method],
        "is": summary,
        "wins": join("better", dagger=names.keys() - over_all) or "None shown.",
        "equal": join(*EQUAL_WORDS) or "–",
        "open": join("not decided") or "–",
        "loses": ". ".join(filter(None, losses)) or "None shown.",
        "time": format_times(overview, method),
    }


def _distance(cell: WorldResult) -> float:
    """Return the distance of a ratio from 1; infinite where lost runs leave none."""
    return abs(math.log(cell.verdict.ratio)) if cell.verdict.ratio > 0 else math.inf


def _size(cell: WorldResult) -> str:
    """Format the ratio of a cell; the share of runs that keep track where lost runs leave none."""
    if cell.verdict.ratio > 0:
        return f"{cell.verdict.ratio:.2f}"
    return f"{100 * cell.track_share:.0f} % keep track"


def list_rivals(overview: Overview) -> list[tuple[str, str, str, str]]:
    """List each pair of methods with the worlds in which the first is better, and those in which the second is."""
    names = {world.key: world.name for world in overview.worlds}
    rows: dict[tuple[str, str], dict[str, list[str]]] = {}
    for pair in overview.pairs:
        worlds = rows.setdefault((pair.verdict.a, pair.verdict.b), {"better": [], "worse": []})
        if pair.verdict.word in worlds:
            worlds[pair.verdict.word].append(names[pair.world])
    return [
        (overview.names[a], overview.names[b], "; ".join(w["better"]), "; ".join(w["worse"]))
        for (a, b), w in rows.items()
    ]


def format_times(overview: Overview, method: str) -> str:
    """Return median and range over worlds of the time of a step, relative to that of the reference of the world.

    The median relative to SIR with as many particles follows, if SIR is in the study.
    """
    labels = {name: label for label, name in overview.names.items()}
    ratios = [
        overview.times[world.key, method] / overview.times[world.key, labels[world.reference]]
        for world in overview.worlds
        if (world.key, method) in overview.times
    ]
    finite = [ratio for ratio in ratios if np.isfinite(ratio)]
    if not finite:
        return "–"
    middle, low, high = (format_factor(f(finite)) for f in (np.median, min, max))
    text = middle if low == high else f"{middle} ({low} to {high})"
    against_sir = [
        overview.times[world.key, method] / overview.times[world.key, SIR]
        for world in overview.worlds
        if {(world.key, method), (world.key, SIR)} <= overview.times.keys()
    ]
    return f"{text}; {format_factor(float(np.median(against_sir)))} of SIR" if against_sir else text


def format_factor(value: float) -> str:
    """Format a factor with two digits."""
    return f"{value:.0f}" if value >= 9.95 else f"{value:.2g}"
