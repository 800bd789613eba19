"""Tables of the first page: worlds, cells, pairs, winners and ranks, decided once from the table of runs."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import yaml

from pfbench.files import limits
from pfbench.report.overview.world_notes import find_plain_losses, list_world_notes
from pfbench.results.conditions import parse_label
from pfbench.results.looks import MethodLook, PartName, find_looks
from pfbench.results.paper_block import conf_dir, read_paper_block
from pfbench.results.store import SAME_TIME
from pfbench.stats.comparison import EQUAL_WORDS, Verdict
from pfbench.stats.world_table import (
    MeanRanks,
    Winner,
    World,
    WorldPair,
    WorldResult,
    build_world,
    compare_methods,
    compare_with_each,
    decide_cells,
    find_winners,
    rank_methods,
)

FEWEST_METHODS, FEWEST_WORLDS = 3, 2  # from which a study has this page
CENTRAL = "nominal"  # regime of the page, if a world has several
SIR = "sir"
CONVENTIONAL = (SIR, "rpf", "rpf_tuned", "ekf_bank")  # that stand next to the methods
TabKey = int | str  # a number of particles, 0 for a study of one number, or one of the two below
EQUAL_TIME, PRINTED = "equal time", "as printed"
_TUNING_BYTES = 1_000_000
_WORDS = ("better", "worse", *EQUAL_WORDS, "not decided")
_FAMILIES = ("particle", "guided", "swarm", "gaussian", "learned", "kalman", "")


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
        ranks: Mean ranks over the worlds.
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
    ranks: MeanRanks
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


def build_overview(
    table: pd.DataFrame,
    looks: Mapping[str, MethodLook],
    parts: Mapping[str, PartName],
    is_shown: Callable[[MethodLook], bool] = is_method,
) -> Overview:
    """Decide all that the first page shows.

    Returns tables of one study. A world without a stated reference, or without runs of it, is left out with the
    reason.
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
            world = _build_world(central_rows(group), facts, by_name)
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
    worse = {
        world.name: [
            c.filter for c in cells if c.world == world.name and c.filter in methods and is_worse(c)
        ]
        for world in worlds
    }
    outdone, notes = _find_outdone(worlds, single), list_world_notes(worlds, has_part)
    plain_losses = find_plain_losses(worlds, worse)
    rows = [
        row._replace(
            outdone=outdone.get(row.key),
            notes=notes[row.key],
            plain_losses=plain_losses.get(row.key),
        )
        for row in rows
    ]
    return Overview(
        tuple(rows), methods, conventional, {label: look.name for label, look in looks.items()},
        cells, compare_methods(worlds, methods), find_winners(worlds, methods, baselines), rank_methods(worlds, methods),
        _list_times(table, [row.key for row in rows]), left_out, find_winners(worlds, methods, single),
    )  # fmt: skip


def is_worse(cell: WorldResult) -> bool:
    """Return whether a filter is worse than the reference of its world, and does not lose track."""
    return cell.verdict.word == "worse" and not cell.loses_track


def _find_outdone(worlds: Sequence[World], single: Sequence[str]) -> dict[str, Verdict]:
    """Find worlds whose reference, chosen on another seed, is worse than another single Kalman filter in these runs."""
    pairs = [
        [(w.reference, v) for v in single if v in w.losses and v != w.reference] for w in worlds
    ]
    verdicts = compare_with_each(list(zip(worlds, pairs, strict=True)))
    worse = {
        world.name: [verdict for verdict in some if verdict.word == "worse"]
        for world, some in zip(worlds, verdicts, strict=True)
    }
    return {
        name: max(some, key=lambda v: v.ratio if v.ratio > 0 else math.inf)
        for name, some in worse.items()
        if some
    }


def build_overviews(
    table: pd.DataFrame, looks: Mapping[str, MethodLook], parts: Mapping[str, PartName]
) -> dict[TabKey, Overview]:
    """Decide the tables of each number of particles, with the key 0 for a study of one number.

    A filter without a number of particles is in all of them. Filters at equal time, and methods as printed,
    have tables of their own. A table has the worlds in which it has other runs than the others.
    """
    table = _add_levels(table, looks)
    levels: list[TabKey] = [*list_levels(looks)]
    timed = [label for label in looks if _has_equal_time(label)]
    printed = [label for label, look in looks.items() if is_printed(look)]
    overviews = {}
    for key in levels or [0]:
        labels = [label for label in looks if label not in timed and _level(label) in (None, key)]
        alone = labels if levels else [label for label in looks if label not in timed]
        tab = _build_tab(table, looks, parts, alone)
        overviews[key] = _count_particles(tab, table, labels, int(key)) if key else tab
    if sum(is_method(looks[label]) for label in timed) >= FEWEST_METHODS:
        names = {name_without_level(label) for label in timed}
        fixed = [label for label in looks if _level(label) is None and label not in names]
        overviews[EQUAL_TIME] = _build_tab(table, looks, parts, [*timed, *fixed])
    if len(printed) >= FEWEST_METHODS:
        number = table.loc[table["filter"].isin(printed), "particles"].dropna().median()
        same = [label for label in looks if label not in timed and _level(label) in (None, number)]
        others = [label for label in same if not is_method(looks[label])]
        tab = _build_tab(table, looks, parts, others, is_printed)
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


def _add_levels(table: pd.DataFrame, looks: Mapping[str, MethodLook]) -> pd.DataFrame:
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
    is_shown: Callable[[MethodLook], bool] = is_method,
) -> Overview:
    """Decide the tables of some filters, present_looks without their numbers of particles."""
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
    return build_overview(rows, present_looks, parts, is_shown)


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
    models = rows["model"].unique() if "model" in rows else [""]
    facts = read_world_facts(name.key, str(models[0]))
    if facts is None:
        raise ValueError(
            f"{name.key} must have a tuning that states its best conventional filter, got none. "
            f"Run pfbench tune scenario={name.key} model={models[0]}."
        )
    return facts


def _build_world(rows: pd.DataFrame, facts: WorldFacts, labels: Mapping[str, str]) -> World:
    """Build a world with the reference that its tuning states."""
    return build_world(rows, labels.get(facts.reference, facts.reference), facts.kalman_fits)


def _describe_world(world: World, name: PartName, looks: Mapping[str, MethodLook]) -> WorldRow:
    """Return the row of a world."""
    losses = world.losses[world.reference]
    return WorldRow(
        world.name, name.name, looks[world.reference].name, float(np.exp(losses.median())), name.unit,
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
