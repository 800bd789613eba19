"""Writer of the report page: index.html with all data as compressed text, and report.md of one screen."""

from __future__ import annotations

import base64
import gzip
import itertools
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from decimal import ROUND_HALF_UP, Decimal
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup, escape

from pfbench.report.board.recorded_units import describe_records, list_questions
from pfbench.report.journal.study_pack import filters_by_key, name_of
from pfbench.report.methods_text import write_methods
from pfbench.report.page_kit import (
    Block,
    make_rows,
    name_generator,
    plain,
    render_markdown,
    render_template,
    with_heading,
)
from pfbench.report.papers.figures import list_page_figures
from pfbench.report.writers import DASH, format_short
from pfbench.results.conditions import drop_settings
from pfbench.results.looks import describe_foreign_knobs, find_stored_world

PAGE_BYTES = 1_500_000
_HERE = Path(__file__).parent
_SCRIPTS = ("kit", "state", "board", "cost", "pairs", "worlds", "time", "runs", "main")
_OPTIONAL = (
    "paper_figures", "failures", "definitions", "filter_notes", "choices", "warnings", "world_orders", "world_pictures",
    "recorded",
)  # fmt: skip
_STATIC = (
    *_OPTIONAL,
    "facts",
    "decisions",
    "methods",
    "bibtex",
    "provenance",
    "downloads",
)  # not read by the script
_COLOUR = re.compile(r"#[0-9a-fA-F]{6}")
_SECTIONS = (
    ("paper_figures", "figures", "Figures of the paper"), ("planned", "planned", "Compared in advance"), ("recorded", "recorded", "Recorded data"), ("cells", "worlds", "Scenarios"), ("curves", "time", "Over time"),
    ("calibration", "calibration", "Calibration"), ("runs", "runs", "Single runs"), ("sweeps", "sweeps", "Dose and response"),
    ("cells", "table", "Table"), ("methods", "methods", "Methods"), ("downloads", "downloads", "Downloads"),
)  # fmt: skip


def render_page(pack: Mapping[str, Any], name: str = "index.html") -> dict[str, str]:
    """Render the page of a study and its Markdown by file name. Equal packs give equal texts.

    Args:
        pack: Data of the page.
        name: Name of the file of the page.
    """
    page = describe_page(pack)
    page["pack"] = pack = {**page["pack"], "budgets": offer_budgets(page["pack"])}
    names = {look["key"]: look["name"] for look in pack["filters"]}
    context = {
        **page,
        "title": f"{pack['title']} – pfbench",
        "methods": write_methods(pack),
        "notes": [{**note, "name": names[note["filter"]]} for note in pack["filter_notes"]],
        "files": _group_files(pack["downloads"]),
        "sections": [
            (anchor, title)
            for key, anchor, title in _SECTIONS
            if pack[key] and not (anchor == "worlds" and len(pack["cells"]) < 2)
        ],
        "colours": Markup(_format_colours(pack["filters"])),
        "script": Markup("\n".join(_read_script(script) for script in _SCRIPTS)),
        "data": "",
    }
    values = {key: value for key, value in pack.items() if key not in _STATIC}
    script_data = {**values, "opening": list(find_opening(pack))}
    data = encode_pack(script_data, PAGE_BYTES - len(render_template(_HERE, context).encode()))
    markdown = "report.md" if name == "index.html" else f"{Path(name).stem}.md"
    return {
        name: render_template(_HERE, {**context, "data": Markup(data)}),
        markdown: render_markdown(list_study_blocks(page)),
    }


def list_study_blocks(page: Mapping[str, Any]) -> list[Block]:
    """List the blocks of `describe_page` as Markdown, one screen."""
    pack, opening = page["pack"], page["opening"]
    heads = ["#", "filter", "ratio", "verdict", "track kept", "coverage of 90 % intervals"]
    heads += ["ms/step"] * opening["is_timed"] + ["ratio of ms/step"] * opening["has_costs"]
    of_pairs = ("pair", "ratio", f"simultaneous {page['level']} % interval", "verdict")
    pairs = [
        [pair[name] for name in ("pair", "effect", "interval", "word")] for pair in page["planned"]
    ]
    headline = pack.get("headline", "")
    picture = Markup(f"![{plain(headline)}](headline.svg)") if headline else ""
    return [
        Block("title", pack["title"]),
        *(Block("text", text) for text in opening["texts"]),
        *(Block("text", opening[name]) for name in ("warnings", "overconfidence", "foreign_knobs", "small_print")),
        Block("text", picture),
        *itertools.chain.from_iterable(
            (Block("text", table["caption"]), make_rows(heads, [_list_cells(row)[: len(heads)] for row in table["rows"]]))
            for table in opening["tables"]
        ),
        *_list_figures(page["figures"]),
        *with_heading(Block("text", "Compared in advance, each method with its own baselines:"), make_rows(of_pairs, pairs)),
        *_list_records(page),
        *with_heading(Block("text", "Failed jobs:"), Block("list", [
            f"{failure['key']}: {' / '.join(failure['choices'][name] for name in ('scenario', 'noise', 'filter'))}: {failure['message']}"
            for failure in pack["failures"]
        ])),
        *with_heading(Block("text", "Modelling choices:"), Block("list", [f"{choice['text']} ({choice['filters']})" for choice in page["choices"]])),
        Block("text", Markup(
            "Figures, single runs, methods, provenance and downloads: index.html, written by "
            f"`pfbench report study={plain(pack['study'])}`. {plain(name_generator(pack))}."
        )),
    ]  # fmt: skip


def _list_cells(row: Mapping[str, Any]) -> list[str]:
    """List the cells of a row in Markdown."""
    return [
        row["rank"], f"{row['name']}{' (proposed)' if row['proposed'] else ''}", f"{row['ratio']} {row['interval']}",
        row["words"], row["track"], row["calibration"], row["ms"], f"{row['cost']} {row['cost_interval']}",
    ]  # fmt: skip


def _list_figures(figures: Sequence[Mapping[str, Any]]) -> Iterable[Block]:
    """List the figures of the paper, or links to the studies that have them."""
    blocks = itertools.chain.from_iterable(
        [Block("text", Markup(f"{plain(f['title'])}: [{plain(f['study'])}](../{f['study']}/report.md)"))]
        if "study" in f
        else [Block("text", Markup(f"![{plain(f['alt'])}]({f['file']})")), Block("text", f["caption"])]
        for f in figures
    )  # fmt: skip
    end = Block("heading", "Comparisons and choices")
    return with_heading(Block("heading", "Figures of the paper"), *blocks, end) if figures else ()


def _list_records(page: Mapping[str, Any]) -> Iterable[Block]:
    """List what the study says of recordings."""
    heads = ("against {}", "starts and random numbers", "blocks of time", "drives")
    blocks = itertools.chain.from_iterable(
        (
            Block("text", Markup(f"{plain(record['title'])}. {plain(record['source'])}")),
            make_rows(
                [head.format(record["baseline"]) for head in heads],
                [[row[name] for name in ("name", "starts", "blocks", "drives")] for row in record["rows"]],
            ),
        )
        for record in page["records"]
    )  # fmt: skip
    return with_heading(
        Block("heading", "Recorded data"), Block("list", page["questions"]), *blocks
    )


def describe_page(pack: Mapping[str, Any]) -> dict[str, Any]:
    """Return what both forms of a page show."""
    pack = {**dict.fromkeys(_OPTIONAL, ()), **pack}
    return {
        "pack": pack,
        "opening": describe_opening(pack),
        "planned": describe_pairs(pack),
        "records": describe_records(pack),
        "questions": list_questions(pack),
        "level": f"{100 * (1 - pack['alpha']):g}",
        "choices": pack["choices"],
        "figures": list_page_figures(pack["study"], pack["paper_figures"]),
    }


def _read_script(name: str) -> str:
    """Return one file of the script without indents and lines of comments."""
    lines = (_HERE / f"{name}.js").read_text(encoding="utf-8").splitlines()
    stripped = [line.strip() for line in lines]
    return "\n".join(line for line in stripped if line and not line.startswith("//"))


def _format_colours(filters: Sequence[Mapping[str, Any]]) -> str:
    """Return the style rules of the colours of filters: on light, and on dark by system or by choice."""
    for look in filters:
        for colour in (look["colour"], look["dark"]):
            if not _COLOUR.fullmatch(colour):
                raise ValueError(
                    f"paper.colour of {look['key']} must have the form #rrggbb, got {colour}."
                )
    light = "".join(f".c{i}{{--c:{f['colour']}}}" for i, f in enumerate(filters))
    dark = [f"{{prefix}} .c{i}{{{{--c:{f['dark']}}}}}" for i, f in enumerate(filters)]
    system = "".join(rule.format(prefix=":root:not([data-theme=light])") for rule in dark)
    choice = "".join(rule.format(prefix=":root[data-theme=dark]") for rule in dark)
    return f"{light}\n@media (prefers-color-scheme:dark){{{system}}}\n{choice}"


def _group_files(downloads: Sequence[Mapping[str, Any]]) -> list[tuple[str, list[dict[str, str]]]]:
    """Return the downloads by group, with sizes as text."""
    sized = [
        {**file, "size": f"{max(1, round(file['bytes'] / 1000))} kB" if file.get("bytes") else ""}
        for file in downloads
    ]
    groups = dict.fromkeys(str(file["group"]) for file in sized)
    return [(group, [file for file in sized if file["group"] == group]) for group in groups]


# Sentence, table and decisions of a page before its script runs.

SIGNS = {
    "better": "▲", "equal": "≈", "equal in kept runs": "≈", "identical": "≈", "not decided": "?", "worse": "▼", "loses track": "✕",
    "missing": "–", "baseline": "",
}  # fmt: skip
_NAMED = 4  # filters with severely overconfident runs in the first lines; scenarios or regimes in a caption


def format_share(value: float | None) -> str:
    """Format a share as percent."""
    if value is None:
        return DASH
    return f"{Decimal(round(100 * value, 4)).quantize(Decimal(1), ROUND_HALF_UP)} %"  # of single precision or double


def format_interval(low: float | None, high: float | None) -> str:
    """Format an interval in brackets, or nothing where it is missing."""
    return "" if low is None or high is None else f"[{_format_end(low)}, {_format_end(high)}]"


def _format_end(value: float | None) -> str:
    """Format a ratio or an end of its interval: 1 is exactly 1, and a value near it has four digits."""
    text = format_short(value)
    return text if text != "1.00" else "1" if value == 1.0 else format_short(value, 4)


def format_sentence(text: str) -> Markup:
    """Escape a sentence and make [[names]] bold."""
    return Markup(re.sub(r"\[\[(.*?)\]\](?!\])", r"<b>\1</b>", str(escape(text))))


def find_opening(pack: Mapping[str, Any]) -> Any:
    """Find the view that opens a page: of all worlds, or of the first of a few that have orders of their own."""
    first, orders = next(iter(pack["views"])), pack.get("world_orders")
    return first._replace(world=orders[0]["world"]) if orders else first


def describe_opening(pack: Mapping[str, Any]) -> dict[str, Any]:
    """Return the sentence and the table of the opening view."""
    key = find_opening(pack)
    view, everywhere = pack["views"][key], next(iter(pack["views"].values()))
    metric, world, regime, baseline = key
    name, names = name_of(pack, "metrics", metric), filters_by_key(pack)
    ratio, orders = f"ratio to {names[baseline]['name']}.", pack.get("world_orders", ())
    scopes = _scope(pack, "worlds", world, "scenario"), _scope(pack, "regimes", regime, "noise regime")  # fmt: skip
    caption = "; ".join((name, *scopes, ratio))
    rows = {order["world"]: pack["views"][key._replace(world=order["world"])]["rows"] for order in orders}  # fmt: skip
    tables = [
        {
            "caption": "; ".join((name, name_of(pack, "worlds", key_of_world), ratio)),
            "rows": [_row(row, names[row["filter"]]) for row in some if row["rank"] is not None],
        }
        for key_of_world, some in rows.items()
    ]
    is_timed = any(row["ms"] is not None for row in view["rows"])
    texts = [source["sentence"].replace("[[", "").replace("]]", "") for source in orders or [view]]
    return {
        "sentence": format_sentence(view["sentence"]),
        "worlds": [format_sentence(order["sentence"]) for order in orders],
        "texts": texts,
        "text": "\n".join(texts),
        "small_print": everywhere["small_print"],
        "warnings": " ".join(pack.get("warnings", ())),
        "foreign_knobs": describe_page_knobs(pack),
        "overconfidence": describe_overconfidence(pack),
        "caption": caption,
        "heads": _heads(names[baseline]["name"])[: None if is_timed else -1],
        "rows": (opening := [_row(row, names[row["filter"]]) for row in view["rows"]]),
        "tables": tables or [{"caption": caption, "rows": opening}],
        "is_timed": is_timed,
        "has_costs": any(row.get("cost") is not None for row in view["rows"]),
    }


def describe_page_knobs(pack: Mapping[str, Any]) -> str:
    """Say which filters of a page were tuned on other worlds; empty for none, or for a page without the data."""
    looks = pack.get("facts", {}).get("looks", ())
    worlds = [world["key"] for world in pack["worlds"]]
    return describe_foreign_knobs([find_stored_world(look, worlds) for look in looks])


def describe_overconfidence(pack: Mapping[str, Any]) -> str:
    """Name the filters with severely overconfident runs, the largest share first; empty without any."""
    names = {look["key"]: look["name"] for look in pack["filters"]}
    notes = [note for note in pack.get("filter_notes", ()) if note["severely_overconfident"]]
    notes.sort(key=lambda note: -note["severely_overconfident"] / note["runs"])
    if not notes:
        return ""
    counts = [
        f"{names[note['filter']]} {note['severely_overconfident']} of {note['runs']}"
        for note in notes[:_NAMED]
    ]
    others = len(notes) - len(counts)
    end = f" and {others} other {'filter' if others == 1 else 'filters'}" if others else ""
    return f"Severely overconfident runs: {', '.join(counts)}{end}."


def _heads(baseline: str) -> list[dict[str, str]]:
    """Return the heads of the table."""
    heads = [
        ("#", "number", "", "ascending"), ("Filter", "", "", ""), ("Error", "desk", "median", ""),
        (f"÷ {baseline}", "number", "with interval", ""), ("Verdict", "", "jointly", ""),
        ("Track kept", "number", "", ""), ("Coverage", "desk", "90 % intervals", ""),
        ("ms/step", "number desk", "", ""),
    ]  # fmt: skip
    return [dict(zip(("text", "style", "small", "sort"), head, strict=True)) for head in heads]


def _row(row: Mapping[str, Any], look: Mapping[str, Any]) -> dict[str, Any]:
    """Return the texts of one row."""
    value = ""
    if row["value"] is not None:
        unit, interval = row["unit"] or "", format_interval(row["low"], row["high"])
        value = f"{format_short(row['value'])} {unit} {interval}"
    return {
        "rank": DASH if row["rank"] is None else str(row["rank"]),
        "name": look["name"],
        "proposed": look["proposed"],
        "value": value,
        "ratio": _format_end(row["ratio"]),
        "interval": format_interval(row["ratio_low"], row["ratio_high"]),
        "verdict": row["verdict"].replace(" ", "_"),
        "words": f"{SIGNS[row['verdict']]} {row['words']}".strip(),
        "track": format_share(row["track"]),
        "calibration": ", ".join(filter(None, (format_share(row["coverage"]), row["calibration"]))),
        "ms": f"{format_short(row['ms'])} {format_interval(row.get('ms_low'), row.get('ms_high'))}".rstrip(),
        "cost": format_short(row.get("cost")),
        "cost_interval": format_interval(row.get("cost_low"), row.get("cost_high")),
    }


def describe_pairs(pack: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return the pairs that were compared in advance as texts."""
    names = {f["key"]: f["name"] for f in pack["filters"]}
    return [
        {
            "pair": f"{names[pair['a']]} against {names[pair['b']]}",
            "effect": _format_end(pair["estimate"]),
            "interval": format_interval(pair["low"], pair["high"]) or pair["reason"] or "",
            "word": pair["word"],
            "words": pair["words"],
        }
        for pair in pack["planned"]
    ]


def _scope(pack: Mapping[str, Any], kind: str, key: str, noun: str) -> str:
    """Return the name of a key, the names of all of a few, or how many there are."""
    if key != "all":
        return name_of(pack, kind, key)
    names = ", ".join(str(item["name"]) for item in pack[kind])
    several = f"{names} together" if len(pack[kind]) <= _NAMED else f"all {len(pack[kind])} {noun}s"
    return several if len(pack[kind]) > 1 else names


# Choice of filters at equal time, from a study with several numbers of particles of the same filters.

_LEAST = 2  # filters with several numbers of particles


def offer_budgets(pack: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the budgets of the page; equal time with its filters if the study has the data.

    The limit is the time per step, over all conditions, of the filter that is the slowest with its
    fewest particles. Each filter is shown with the most particles that do not exceed the limit. A filter
    without particles is shown if it does not exceed the limit.
    """
    budgets = [dict(budget) for budget in pack["budgets"]]
    limit, filters = select_equal_time(pack)
    for budget in budgets:
        if budget["key"] == "time" and budget["reason_missing"] and filters:
            budget |= {
                "reason_missing": None, "filters": filters,
                "words": f"with the most particles up to {format_short(limit)} ms per step; "
                "ranks and decisions are those of all filters",
            }  # fmt: skip
    return budgets


def select_equal_time(pack: Mapping[str, Any]) -> tuple[float, list[str]]:
    """Select the filters of `offer_budgets`.

    Returns Limit in ms per step, and keys of filters. No keys if fewer than two filters have
    several numbers of particles with a time.
    """
    notes = {note["filter"]: str(note["particles"]) for note in pack["filter_notes"]}
    rows = next(iter(pack["views"].values()))["rows"]
    times = {row["filter"]: float(row["ms"]) for row in rows if row["ms"] is not None}
    variants: dict[str, list[tuple[int, str]]] = {}
    for key in times:
        number = int(notes[key]) if notes.get(key, "").isdigit() else 0
        variants.setdefault(drop_settings(key, "particles"), []).append((number, key))
    swept = [sorted(group) for group in variants.values() if len({n for n, _ in group}) > 1]
    if len(swept) < _LEAST:
        return 0.0, []
    limit = max(times[group[0][1]] for group in swept)
    fitting = ([v for v in group if times[v[1]] <= limit] for group in variants.values())
    return limit, [max(group)[1] for group in fitting if group]


# --------------------------------------------------------------------------------------------------
# Data of a page as text: JSON in gzip and base 64, which every browser reads.

_DIGITS = 3  # of the numbers of figures; tables round those of the pack


def encode_pack(pack: Mapping[str, Any], limit: int) -> str:
    """Encode the pack of a page.

    The tracks of single runs are the largest part. If the text exceeds the limit, the page carries fewer runs of each
    condition, in the order of the pack.
    """
    base = {
        **pack,
        "views": _encode_views(pack["views"]),
        "planned": _encode(pack["planned"]),
        "curves": _nest(pack["curves"]),
        "calibration": _nest(pack["calibration"]),
        "runs": _nest(pack["runs"]),
    }
    carried = max((len(cell["numbers"]) for cell in pack["tracks"].values()), default=0)
    while True:
        tracks = {key: _select_tracks(cell, carried) for key, cell in pack["tracks"].items()}
        text = compress_pack({**base, "tracks": _nest(tracks) if carried else {}})
        if len(text) <= limit or carried == 0:
            return text
        carried = carried - 1 if carried <= 4 else int(carried * max(0.5, limit / len(text)))


def compress_pack(pack: Mapping[str, Any]) -> str:
    """Compress a pack, with the same text for equal content."""
    text = json.dumps(pack, separators=(",", ":"), allow_nan=False, ensure_ascii=False)
    return base64.b64encode(gzip.compress(text.encode(), 9, mtime=0)).decode("ascii")


def _encode_views(views: Mapping[tuple[str, ...], Any]) -> dict[str, Any]:
    """Encode views: keys, texts, and rows as lists of values in the order of the columns."""
    rows = [row for view in views.values() for row in view["rows"]]
    columns = list(dict.fromkeys(name for row in rows for name in row))
    return {
        "keys": [list(key) for key in views],
        "columns": columns,
        "texts": [{k: v for k, v in view.items() if k != "rows"} for view in views.values()],
        "rows": [[_encode([row.get(name) for name in columns]) for row in view["rows"]] for view in views.values()],
    }  # fmt: skip


def _encode(value: Any) -> Any:
    """Return a value for JSON, which cannot hold infinity; the script of the page turns it back."""
    if isinstance(value, Mapping):
        return {key: _encode(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_encode(item) for item in value]
    return "∞" if value == math.inf else value


def _nest(values: Mapping[tuple[str, str], Any]) -> dict[str, Any]:
    """Nest values of cells by world and regime."""
    nested: dict[str, Any] = {}
    for (world, regime), value in values.items():
        nested.setdefault(world, {})[regime] = value
    return nested


def _select_tracks(cell: Mapping[str, Any], carried: int) -> dict[str, Any]:
    """Select the first runs of one condition: positions, errors and traces over time."""
    numbers = cell["numbers"][:carried]
    keys = [str(number) for number in numbers]

    def select(runs: Mapping[str, Any]) -> dict[str, list[float | None]]:
        """Return the numbers of each run with three digits in one list; None where they are not finite."""
        flat = {k: np.asarray(runs[k], dtype=np.float64).ravel().tolist() for k in keys if k in runs}  # fmt: skip
        return {
            key: [float(f"{v:.{_DIGITS}g}") if math.isfinite(v) else None for v in values]
            for key, values in flat.items()
        }

    selected = {**cell, "numbers": numbers}
    if "truth" in cell:
        selected["truth"] = {
            k: [[x, y] if np.isfinite(x + y) else None for x, y in np.round(track, 1).tolist()]
            for k, track in cell["truth"].items()
            if k in (*keys, "all")
        }
        selected["plane"] = {f: select(runs) for f, runs in cell["plane"].items()}
    selected["error"] = {f: select(runs) for f, runs in cell["error"].items()}
    selected["traces"] = [
        {**trace, "filters": {f: select(runs) for f, runs in trace["filters"].items()}}
        for trace in cell.get("traces", [])
    ]
    return selected
