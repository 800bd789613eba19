"""First page of a study: index.html with its figures, report.md, and the tables as CSV."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from markupsafe import Markup

from pfbench.report.overview import figures
from pfbench.report.overview.tables import (
    AT_HOME,
    EQUAL_TIME,
    PLANNED_RATIO,
    PRINTED,
    SIR,
    WITH_KNOBS,
    Overview,
    TabKey,
    World,
    WorldCell,
    count_runs_of_cells,
    find_outdone,
    format_times,
    list_world_notes,
    name_size,
    name_word,
    pair_forms,
    tell_story,
)
from pfbench.report.page_kit import (
    Block,
    make_rows,
    name_generator,
    plain,
    render_markdown,
    render_template,
    with_heading,
)
from pfbench.report.papers.figures import list_paper_pages
from pfbench.report.study_page.page_writer import describe_page_knobs
from pfbench.report.writers import format_csv, format_data_address
from pfbench.results.conditions import parse_label
from pfbench.results.looks import find_looks
from pfbench.results.paper_block import read_paper_block
from pfbench.stats.comparison import NO_DECISION, TRIM_SHARE
from pfbench.stats.sentences import format_with_interval
from pfbench.stats.study_size import POWER

BOARD_PAGE = "worlds.html"  # the page of each world, which is the first page of other studies
_HERE = Path(__file__).parent
_MARKS = {"better": "**{}**", "worse": "{}"}  # of decided cells in a text
_NUMBERS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")


def render_overview(
    overviews: Mapping[TabKey, Overview], pack: Mapping[str, Any]
) -> dict[str, str]:
    """Render the first page of a study: index.html, report.md, figures and tables by file name.

    A study with several numbers of particles has the tables of each, and figures of error against number and time.

    Args:
        overviews: Tables of the page by number of particles, 0 for a study of one number, and at equal time
            and as printed.
        pack: Data of the page of each world.
    """
    level = choose_level(overviews)
    overview = overviews[level]
    timed = next(
        (key for key in (level, *_list_timed(overviews)) if overviews[key].has_times), level
    )
    pictures = draw_pictures(overviews)
    files = {f"{name}.svg": text for name, text in pictures.items() if not name.endswith("_390")}
    files |= {
        f"{name}.csv": format_csv(
            pd.concat([tables(item).assign(table=key or "") for key, item in overviews.items()])
        )
        for name, tables in (("cells", list_verdicts), ("pairs", list_comparisons))
    }
    context = {
        "pack": pack,
        "overview": overview,
        "levels": [key for key in overviews if key],
        "level": level,
        "doses": _choose_axes(overviews),
        "timed": f" with {timed} particles" * (timed != level),
        "others": [
            (_name_tab(key, item), _suffix(key))
            for key, item in overviews.items()
            if key not in (level, WITH_KNOBS, AT_HOME)
        ],
        "headline": word_headline(
            overview, *(overviews.get(key) for key in (EQUAL_TIME, WITH_KNOBS, AT_HOME))
        ),
        "setting": describe_setting(overview, level),
        "has_printed": PRINTED in overviews,
        "has_stars": any(cell.wins for item in overviews.values() for cell in item.cells),
        "failures": describe_failures(pack, overview),
        "notes": list_notes(overview),
        "power": describe_power(overview),
        "times_note": describe_times(overviews[EQUAL_TIME]) if EQUAL_TIME in overviews else "",
        "conventional": ", ".join(overview.names[label] for label in overview.conventional),
        "trim": f"{100 * TRIM_SHARE:.0f} %",
        "foreign_knobs": describe_page_knobs(pack) if "worlds" in pack else "",
        "ratios": list_ratios(overview),
        "format_error": figures.format_reference_error,
        "format_reference": figures.format_reference,
        "filters": [overview.names[label] for label in overview.columns],
        "stories": [
            tell_story(
                view,
                m,
                str(
                    read_paper_block("filter", parse_label(m)[0]).get("summary", "The same, tuned.")
                ),
            )
            | {"time": format_times(times, m)}
            for view, times in (
                (overview, overviews[timed]),
                *((v, v._replace(times={})) for v in [overviews.get(WITH_KNOBS)] if v),
            )
            for m in view.methods
        ],
        "tuned": describe_tuned(overview, overviews[WITH_KNOBS]) if WITH_KNOBS in overviews else "",
        "forms": list_forms(overview, overviews[WITH_KNOBS]) if WITH_KNOBS in overviews else [],
        "home": describe_home(overviews[AT_HOME]) if AT_HOME in overviews else [],
        "price": describe_price(overview) if WITH_KNOBS in overviews else "",
        "count": spell_number(len(overview.methods)),
        "pictures": {
            name: Markup(format_data_address("svg", text.encode()))
            for name, text in pictures.items()
        },
        "decided": sum(pair.verdict.word in ("better", "worse") for pair in overview.pairs),
        "papers": list_paper_pages(overview.methods),
        "board": BOARD_PAGE,
        "title": f"{pack['title']} – pfbench",
    }
    files["index.html"] = render_template(_HERE, context)
    files["report.md"] = render_markdown(list_overview_blocks(context))
    return files


def list_overview_blocks(page: Mapping[str, Any]) -> list[Block]:
    """List the blocks of report.md."""
    pack, overview = page["pack"], page["overview"]
    heads = (
        "method", "in one line", "better than the best Kalman filter", "equal to it", "not decided", "worse",
        f"time of a step{page['timed']} / that of the best Kalman filter, median over worlds (range); / that of SIR",
    )  # fmt: skip
    return [
        Block("title", pack["title"]),
        Block("text", page["headline"]),
        Block("text", page["setting"] + " The methods are repaired where a printed form fails; as printed they have a table in index.html." * page["has_printed"]),
        Block("text", page["foreign_knobs"]),
        Block("text", Markup("![Ratio of the error of each method to that of the best Kalman filter, in each world](heat_map.svg)")),
        Block("text", Markup("![Worlds in which each method is better and worse than each other](matrices.svg)")),
        Block("text", f"The {page['count']} tuned as the baselines are. {page['tuned']} {page['price']}" if page["tuned"] else ""),
        make_rows(["ratio, and that of the tuned form", *(overview.names[m] for m in overview.methods)], page["forms"]),
        *with_heading(
            Block("text", Markup("At home, all tuned: the worlds and the noise of the papers. ![Ratios at home](heat_map_at_home.svg)")),
            Block("list", [f"{name}: {text}." for name, text in page["home"]]),
        ),
        *with_heading(
            Block("text", "Before you quote a number of these worlds:"), Block("list", [f"{name}: {text}." for name, text in page["notes"]])
        ),
        make_rows(heads, [[story[name] for name in ("name", "is", "wins", "equal", "open", "loses", "time")] for story in page["stories"]]),
        Block("text", page["power"]),
        Block("text", "†: not shown to be better than every single Kalman filter of that world. ☆: better than every conventional filter."),
        *with_heading(
            Block("text", "The figures of the papers from our runs, with the numbers that the papers print as crosses:"),
            Block("list", [Markup(f"[{plain(p['paper'])}](../{p['study']}/report.md): {plain(p['figures'])}") for p in page["papers"]]),
        ),
        Block("text", (
            f"{page['decided']} of {len(overview.pairs)} comparisons of two methods in a world are decided. Wilcoxon's signed-rank test, "
            f"the t test of the mean without {page['trim']} at each end and the sign test reject and agree in sign, each with Holm's "
            "correction. Each world is a family (level 5 %), as on its page. It has all filters against the best Kalman filter, the UKF "
            "and the baseline. It also has methods with the baselines of their papers, and all pairs of methods. Ratios are those of "
            "Hodges and Lehmann. Equal: the simultaneous interval is between 1/1.05 and 1.05. Loses track: fewer than 80 % of runs keep "
            "it, by an exact binomial test with Holm's correction over the filters of a world. Better than every single Kalman filter: "
            "the largest p value of all three tests against each of them, with Holm's correction over all cells."
        )),
        *(Block("text", f"Not on this page: {name}, since {reason}") for name, reason in overview.left_out.items()),
        *(Block("text", f"Not on this page: {text}") for text in page["failures"]),
        Block("text", Markup(
            "All filters and noise regimes: [worlds.md](worlds.md). Numbers: cells.csv and pairs.csv, written by "
            f"`pfbench report study={plain(pack['study'])}`. {plain(name_generator(pack))}."
        )),
    ]  # fmt: skip


def choose_level(overviews: Mapping[TabKey, Overview]) -> TabKey:
    """Return the number of particles that opens the page: that with the most results of the methods, else the middle one."""
    cells = {key: len(overview.of_methods) for key, overview in _select_levels(overviews).items()}
    levels = [key for key, count in cells.items() if count == max(cells.values())]
    return levels[len(levels) // 2]


def _select_levels(overviews: Mapping[TabKey, Overview]) -> dict[int, Overview]:
    """Select the tables that belong to a number of particles."""
    return {key: overview for key, overview in overviews.items() if isinstance(key, int)}


def _list_timed(overviews: Mapping[TabKey, Overview]) -> list[int]:
    """List the numbers of particles with times of a step."""
    return [key for key, overview in _select_levels(overviews).items() if overview.has_times]


def _choose_axes(overviews: Mapping[TabKey, Overview]) -> dict[str, str]:
    """Return the titles of the figures of error by their axis: the time is one where several numbers of particles have times."""
    titles = {
        "particles": "How many particles are enough?",
        "time": "What does computing time bring?",
    }
    counts = len(_select_levels(overviews)), len(_list_timed(overviews))
    return {
        axis: title
        for (axis, title), count in zip(titles.items(), counts, strict=True)
        if count > 1
    }


def _name_tab(key: TabKey, overview: Overview) -> str:
    """Name tables below the first ones."""
    if key == EQUAL_TIME:
        return "All particle filters with about the time of a step of SIR with 1000 particles"
    if key != PRINTED:
        return f"{key} particles"
    numbers = {round(overview.numbers[m]) for m in overview.methods if m in overview.numbers}
    ends = " to ".join(map(str, sorted({min(numbers), max(numbers)}))) if numbers else ""
    return f"The methods as printed{f', {ends} particles' if ends else ''}"


def _suffix(key: TabKey) -> str:
    """Return the end of the names of the figures of tables."""
    return f"_{key}".replace(" ", "_")


def draw_pictures(overviews: Mapping[TabKey, Overview]) -> dict[str, str]:
    """Draw all figures of the page as SVG: those of the middle number of particles without a suffix of it."""
    first, levels, axes = (
        choose_level(overviews),
        _select_levels(overviews),
        _choose_axes(overviews),
    )
    pictures = {}
    for key, overview in overviews.items():
        suffix = "" if key == first else _suffix(key)
        for size in figures.HEAT_FORMATS:
            pictures[f"heat_map{suffix}{size.name}"] = figures.draw_heat_map(overview, size)
        for size in figures.MATRIX_FORMATS if key not in (WITH_KNOBS, AT_HOME) else ():
            pictures[f"matrices{suffix}{size.name}"] = figures.draw_matrices(overview, size)
    worlds = order_dose_worlds(overviews[first])
    for axis, size in itertools.product(axes, figures.DOSE_FORMATS):
        for suffix, some in (("", worlds[:2]), ("_others", worlds[2:])):
            if some:
                name = f"error_by_{axis}{suffix}{size.name}"
                pictures[name] = figures.draw_doses(levels, some, axis, size)
    return {name: figures.to_svg(figure) for name, figure in pictures.items()}


def order_dose_worlds(overview: Overview) -> list[World]:
    """Order the worlds that have a ratio by the methods that are better than the reference; those that it does not fit first."""
    wins = Counter(cell.world for cell in overview.cells if cell.verdict.word == "better")
    return sorted(
        (w for w in overview.worlds if any(c.verdict.ratio > 0 for c in overview.cells if c.world == w.key)),
        key=lambda w: (w.facts.kalman_fits is not False, -wins[w.key]),
    )  # fmt: skip


def describe_tuned(overview: Overview, tuned: Overview) -> str:
    """Say how the words of the methods change if they are tuned as the baselines are."""
    pairs = pair_forms(overview, tuned)
    changed = [(a, {name_word(a), name_word(b)}) for a, b in pairs if name_word(a) != name_word(b)]
    turned = "; ".join(
        f"{overview.names[a.filter]} in {tuned.world_names[a.world]}"
        for a, words in changed
        if words == {"better", "worse"}
    )
    counts = Counter(name_word(b) for _, b in pairs)
    return (
        f"Each has 16 candidates, and the runs and the seed of the baselines. Tuned, they are {', '.join(f'{word} in {n}' for word, n in sorted(counts.items()))} "
        f"of {len(pairs)} cells. {f'Blue turns orange or back: {turned}' if turned else 'None turns from blue to orange or back'}; "
        f"{len(changed)} have another word (‡)."
    )


def list_forms(overview: Overview, tuned: Overview) -> list[list[str]]:
    """List the ratios of the methods, and tuned ones behind them, by world."""
    cells = {
        (
            a.world,
            a.filter,
        ): f"{name_size(a)} → {name_size(b)}{'‡' * (name_word(a) != name_word(b))}"
        for a, b in pair_forms(overview, tuned)
    }
    return [
        [world.part_name.name, *(cells.get((world.key, m), "–") for m in overview.methods)]
        for world in tuned.worlds
    ]


def describe_home(home: Overview) -> list[tuple[str, str]]:
    """Say of each method where it wins in the worlds of the papers, all tuned, and what it does in the others."""
    stories = [tell_story(home, method, "") for method in home.methods]
    words = (("wins", "Better than the best Kalman filter"), ("equal", "Equal"), ("open", "Not decided"), ("loses", "Worse"))  # fmt: skip
    return [
        (
            story["name"],
            ". ".join(
                f"{word}: {story[key]}"
                for key, word in words
                if story[key] not in ("–", "None shown.")
            )
            or "Nothing shown",
        )
        for story in stories
    ]


def describe_price(overview: Overview) -> str:
    """Say what the tuning of the methods took, and what it would take where they are not tuned."""
    names = {parse_label(label)[0]: overview.names[label] for label in overview.methods}
    tunings = {w.part_name.name: w.facts.tuning for w in overview.worlds}
    texts = [
        f"{world} ({'all' if len(hours) == len(names) else ', '.join(names[n] for n in hours)}: {sum(hours.values()):.2g} CPU hours)"
        for world, tuning in tunings.items()
        if (hours := tuning.get("not_tuned_hours"))
    ]
    return (
        f"The tuning took {sum(t[n]['seconds'] for t in tunings.values() for n in names if n in t) / 60:.0f} CPU minutes."
        + f" Not tuned in this world: {'; '.join(texts)}. These are estimates." * bool(texts)
    )


def word_headline(
    overview: Overview,
    at_equal_time: Overview | None = None,
    tuned: Overview | None = None,
    home: Overview | None = None,
) -> str:
    """Word the two sentences that open the page, at most 55 words, and others if the methods are tuned too, or at home."""
    count, better = spell_number(len(overview.methods)), "better than every conventional filter"
    winners, timed, alike, at_home = (
        _name_winners(some) if some else "" for some in (overview, at_equal_time, tuned, home)
    )
    first = f"{better.capitalize()} with as many particles: {winners}."
    nor = (
        f", nor at equal time in {len(at_equal_time.worlds)}" if at_equal_time and not timed else ""
    )
    if not winners:
        first = f"None of the {count} is shown to be {better} in any of {len(overview.worlds)} worlds{nor}."
    if timed:
        first += f" {'Also at' if winners else 'At'} equal time: {timed}."
    elif winners and at_equal_time:
        first += " At equal time none is."
    words, single = Counter(map(name_word, overview.of_methods)), sum(c.beats_kalman for c in overview.of_methods)  # fmt: skip
    return (
        f"{first}{f' Tuned, these are: {alike}.' if alike else f' Nor is a tuned form, in {len(tuned.of_methods)} cells.' if tuned else ''}"
        f"{f' At home: {at_home}.' if at_home else f' At home none is, in {len(home.of_methods)} cells.' if home else ''} "
        f"Against each world's best Kalman filter: better in {words['better']} of {words.total()} cells"
        f"{f' (in {single} than all single ones)' if single else ''}, "
        f"equal in {words['equal']}, not decided in {words['not decided']}, worse in {words['worse']}."
        f"{' Lost in {}.'.format(words['loses track']) if words['loses track'] else ''}"
    )


def _name_winners(overview: Overview, most: int = 2) -> str:
    """Name the methods that are better than every conventional filter of a world; empty without one."""
    wins = [f"{overview.names[c.filter]} ({overview.world_names[c.world]})" for c in overview.cells if c.wins]  # fmt: skip
    more = f" and {len(wins) - most} more" if len(wins) > most else ""
    return f"{', '.join(wins[:most])}{more}"


def describe_setting(overview: Overview, level: TabKey = 0) -> str:
    """Describe worlds, runs, number of particles, reference and losses in a few sentences."""
    runs = sorted({world.runs for world in overview.worlds})
    counts = " to ".join(map(str, dict.fromkeys((runs[0], runs[-1]))))
    return (
        f"{len(overview.worlds)} worlds, {counts} paired runs each{f', {level} particles' if level else ''}{_name_numbers(overview)}.{_name_absent(overview)} "
        f"{_describe_reference(overview)} A run that loses track is worse than every other one."
    )


def _name_numbers(overview: Overview) -> str:
    """Name the methods that set their number of particles themselves."""
    some = [f"{overview.names[m]} {overview.numbers[m]:.0f}" for m in overview.methods if m in overview.numbers]  # fmt: skip
    return f" (its own number: {', '.join(some)})" if some else ""


def _name_absent(overview: Overview) -> str:
    """Name the methods that lack more than one world, with the number of those in which they ran."""
    counts, worlds = Counter(cell.filter for cell in overview.cells), len(overview.worlds)
    some = [f"{overview.names[m]} ran in {counts[m]} of them" for m in overview.methods if counts[m] < worlds - 1]  # fmt: skip
    return f" {'; '.join(some)}." if some else ""


def _describe_reference(overview: Overview) -> str:
    """Say how the best Kalman filter was chosen, and where it is not the best in these runs."""
    better = [
        f"{overview.names[v.b]} in {world.part_name.name} ("
        f"{f'the chosen one has {v.ratio:.2f} times its error' if v.ratio > 0 else v.reason})"
        for world in overview.worlds
        if (v := find_outdone(world, overview.single))
    ]
    return (
        "The best Kalman filter of a world was chosen on another seed, tuned ones among the candidates; the methods are not tuned."
        + f" In these runs another one is better: {', '.join(better)}." * bool(better)
    )


def describe_power(overview: Overview) -> str:
    """Say in how many cells the runs suffice for the question of the page, and name the others."""
    counted = count_runs_of_cells(overview)
    texts = [
        f"{overview.names[cell.filter]} in {overview.world_names[cell.world]} ({cell.verdict.n} runs, "
        f"{'more than 10 000' if math.isinf(needed) else f'{needed:.0f}'} needed)"
        for cell, needed in counted
        if needed > cell.verdict.n
    ]
    return (
        f"In {len(counted) - len(texts)} of {len(counted)} cells the runs suffice to show a method with {PLANNED_RATIO:g} of the error of the "
        f"strongest conventional filter, with power {POWER:g} by sign and signed-rank test and Holm's correction over all cells."
        + f" They are too few for {'; '.join(texts)}."
        * bool(texts)
    )


def list_notes(overview: Overview) -> list[tuple[str, str]]:
    """List the worlds with what must be known before their numbers are quoted."""
    return [
        (world.part_name.name, "; ".join(notes))
        for world in overview.worlds
        if (notes := list_world_notes(world))
    ]


def describe_times(overview: Overview, most: float = 1.5) -> str:
    """Say which filters take longer than SIR in a table of equal time: with few particles times are hard to meet."""
    slow = []
    for label in overview.columns:
        ratios = overview.compare_times(label, SIR)
        name, worst = max(ratios.items(), key=lambda item: item[1], default=("", 0.0))
        if worst > most:
            slow.append(f"{overview.names[label]} {worst:.1f} times ({name})")
    return f"More than {most:g} times the step of SIR: {', '.join(slow)}." if slow else ""


def spell_number(number: int) -> str:
    """Return a small number in letters."""
    return _NUMBERS[number] if number < len(_NUMBERS) else str(number)


def describe_failures(pack: Mapping[str, Any], overview: Overview) -> list[str]:
    """Describe the jobs that failed, those of a filter with one reason in a sentence."""
    places: dict[tuple[str, str], dict[str, None]] = {}
    for failure in pack.get("failures", ()):
        world, label = (str(failure["choices"][key]) for key in ("scenario", "filter"))
        reason = str(failure["message"]).partition(": ")[2].partition(", got ")[0]
        places.setdefault((label, reason), {})[overview.world_names.get(world, world)] = None
    looks = find_looks([label for label, _ in places])
    return [
        f"{looks[label].name} in {'; '.join(some)}{f', since {reason}' if reason else ''}"
        for (label, reason), some in places.items()
    ]


def list_ratios(overview: Overview) -> list[tuple[World, list[str]]]:
    """List the ratios of a world with their simultaneous intervals, in the order of the columns of the heat map."""
    return [
        (world, [_format_ratio(world, overview.find(world, label)) for label in overview.columns])
        for world in overview.worlds
    ]


def _format_ratio(world: World, cell: WorldCell | None) -> str:
    """Format the ratio of a cell with its interval, where it tends if nothing is decided, and the runs that keep track if some are lost."""
    if cell is None:
        return "–"
    has_ratio = cell.verdict.ratio > 0
    text = format_with_interval(*cell.verdict[3:6]) if has_ratio else "–"
    if has_ratio and cell.verdict.word == NO_DECISION:
        text += f" ({world.weigh(cell.filter)})"
    is_lost = cell.loses_track or not has_ratio
    return text + f"; {100 * cell.track_share:.0f} % keep track" * is_lost


def tabulate_heat_map(overviews: Mapping[TabKey, Overview]) -> tuple[list[str], list[list[str]]]:
    """Tabulate the heat map that opens the page, for a text: names of columns, and a row per world.

    Args:
        overviews: Tables of the page, as `find_overviews` returns them.

    Returns:
        Names of columns and rows. Shown to be better is bold, not decided in brackets.
    """
    overview = overviews[choose_level(overviews)]
    rows = [
        [world.part_name.name, figures.format_reference(overview, world)]
        + [_format_cell(overview, world, label) for label in overview.columns]
        for world in overview.worlds
    ]
    names = [overview.names[label] for label in overview.columns]
    return ["world", "best Kalman filter = 1", *names], rows


def count_better_worlds(overviews: Mapping[TabKey, Overview]) -> dict[str, tuple[int, int]]:
    """Count the worlds in which each proposed method is better than every single Kalman filter, in the first table.

    Args:
        overviews: Tables of the page, as `find_overviews` returns them.

    Returns:
        Number of these worlds, and of all worlds in which the method ran, by the key of the method.
    """
    overview = overviews[choose_level(overviews)]
    cells = overview.of_methods
    wins = {m: [cell.beats_kalman for cell in cells if cell.filter == m] for m in overview.methods}
    return {method: (sum(won), len(won)) for method, won in wins.items()}


def _format_cell(overview: Overview, world: World, label: str) -> str:
    """Format a cell of the heat map as text."""
    look, cell = figures.describe_cell(overview, world, label), overview.find(world, label)
    if cell is None or look.is_grey or look.text == "=":
        return look.text
    return _MARKS.get(cell.verdict.word, "({})").format(look.text)


def list_verdicts(overview: Overview) -> pd.DataFrame:
    """List the filters against the reference of each world."""
    worlds = {world.key: world for world in overview.worlds}
    return pd.DataFrame([
        {
            "world": cell.world, "filter": cell.filter, "reference": overview.names[worlds[cell.world].reference],
            "limit": worlds[cell.world].part_name.limit, **cell.verdict.to_row(),
            "track_share": cell.track_share, "loses_track": cell.loses_track,
            "p_every_baseline": cell.p_every, "is_winner": cell.wins, "ms_per_step": overview.times.get((cell.world, cell.filter), ""),
        }
        for cell in overview.cells
    ]).drop(columns=["a", "b"], errors="ignore")  # fmt: skip


def list_comparisons(overview: Overview) -> pd.DataFrame:
    """List all pairs of methods in each world."""
    return pd.DataFrame([{"world": p.world, **p.verdict.to_row()} for p in overview.pairs])
