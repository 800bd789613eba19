"""Sentence, table and decisions of a page before its script runs."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from decimal import ROUND_HALF_UP, Context, Decimal
from typing import Any

from markupsafe import Markup, escape

from pfbench.report.looks import find_stored_world
from pfbench.report.tuning_words import describe_foreign_knobs

SIGNS = {
    "best": "★", "equal": "≈", "better": "▲", "open": "?", "worse": "▼", "not_kept": "✕", "missing": "–",
}  # fmt: skip
_DASH = "–"
_NAMED = 4  # filters with severely overconfident runs in the first lines


def format_short(value: float | None, digits: int = 3) -> str:
    """Format a number with significant digits, as the script of the page does.

    Args:
        value: Number, or None for a dash.
        digits: Number of significant digits.
    """
    if value is None:
        return _DASH
    rounded = Context(prec=digits, rounding=ROUND_HALF_UP).create_decimal(Decimal(value))
    if rounded == 0:
        return "0"
    exponent = rounded.adjusted()
    if not -4 <= exponent < 6:
        return f"{rounded:.{digits - 1}e}".replace("e+", "e")
    return f"{rounded:.{max(0, digits - 1 - exponent)}f}"


def format_share(value: float | None) -> str:
    """Format a share as percent.

    Args:
        value: Share, or None for a dash.
    """
    if value is None:
        return _DASH
    return f"{Decimal(100 * value).quantize(Decimal(1), ROUND_HALF_UP)} %"


def format_interval(low: float | None, high: float | None) -> str:
    """Format an interval in brackets, or nothing where it is missing.

    Args:
        low: Lower end.
        high: Upper end.
    """
    return "" if low is None or high is None else f"[{format_short(low)}, {format_short(high)}]"


def format_sentence(text: str) -> Markup:
    """Escape a sentence and make [[names]] bold.

    Args:
        text: Sentence of the board.
    """
    return Markup(re.sub(r"\[\[(.*?)\]\](?!\])", r"<b>\1</b>", str(escape(text))))


def describe_opening(pack: Mapping[str, Any]) -> dict[str, Any]:
    """Return the sentence and the table of the opening view.

    Args:
        pack: Data of the page.
    """
    key, view = next(iter(pack["views"].items()))
    metric, world, regime, baseline = key
    names = {f["key"]: f for f in pack["filters"]}
    robustness = pack.get("robustness") or ""
    parts = (
        _name(pack["metrics"], metric),
        _scope(pack["worlds"], world, "scenario"),
        _scope(pack["regimes"], regime, "noise regime"),
        f"ratio to {names[baseline]['name']}",
    )
    return {
        "sentence": format_sentence(view["sentence"]),
        "text": _remove_marks(view["sentence"]),
        "small_print": view["small_print"],
        "robustness": format_sentence(robustness),
        "robustness_text": _remove_marks(robustness),
        "foreign_knobs": describe_page_knobs(pack),
        "overconfidence": describe_overconfidence(pack),
        "caption": f"{'; '.join(parts)}.",
        "heads": _heads(names[baseline]["name"]),
        "rows": [_row(row, names[row["filter"]]) for row in view["rows"]],
        "has_costs": any(row.get("cost") is not None for row in view["rows"]),
    }


def describe_page_knobs(pack: Mapping[str, Any]) -> str:
    """Say which filters of a page were tuned on other worlds; empty for none, or for a page without the data.

    Args:
        pack: Data of the page.
    """
    looks = pack.get("facts", {}).get("looks", ())
    worlds = [world["key"] for world in pack["worlds"]]
    return describe_foreign_knobs([find_stored_world(look, worlds) for look in looks])


def describe_overconfidence(pack: Mapping[str, Any]) -> str:
    """Name the filters with severely overconfident runs, the largest share first; empty without any.

    Args:
        pack: Data of the page.
    """
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


def _remove_marks(text: str) -> str:
    """Return a sentence without the brackets of names."""
    return text.replace("[[", "").replace("]]", "")


def _heads(baseline: str) -> list[dict[str, str]]:
    """Return the heads of the table."""
    heads = [
        ("#", "number", "", "ascending"), ("Filter", "", "", ""), ("Error", "desk", "with interval", ""),
        (f"÷ {baseline}", "number", "with interval", ""), ("Against the best", "", "jointly", ""),
        ("Track kept", "number", "", ""), ("Coverage", "desk", "90 % regions", ""),
        ("ms/step", "number desk", "", ""),
    ]  # fmt: skip
    return [dict(zip(("text", "style", "small", "sort"), head, strict=True)) for head in heads]


def _row(row: Mapping[str, Any], look: Mapping[str, Any]) -> dict[str, Any]:
    """Return the texts of one row."""
    value = ""
    if row["value"] is not None:
        unit, interval = row["unit"] or "", format_interval(row["low"], row["high"])
        value = f"{format_short(row['value'])} {unit} {interval}"
    calibration = row["calibration"] or ""
    return {
        "rank": _DASH if row["rank"] is None else f"{'=' if row['tied'] else ''}{row['rank']}",
        "name": look["name"],
        "proposed": look["proposed"],
        "value": value,
        "ratio": format_short(row["ratio"]),
        "interval": format_interval(row["ratio_low"], row["ratio_high"]),
        "verdict": row["verdict"],
        "words": f"{SIGNS[row['verdict']]} {row['words']}",
        "track": format_share(row["track"]),
        "calibration": ", ".join(filter(None, (format_share(row["coverage"]), calibration))),
        "ms": f"{format_short(row['ms'])} {format_interval(row.get('ms_low'), row.get('ms_high'))}".rstrip(),
        "cost": format_short(row.get("cost")),
        "cost_interval": format_interval(row.get("cost_low"), row.get("cost_high")),
    }


def describe_pairs(pack: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return the planned comparisons as texts.

    Args:
        pack: Data of the page.
    """
    names = {f["key"]: f["name"] for f in pack["filters"]}
    return [
        {
            "pair": f"{names[pair['a']]} against {names[pair['b']]}",
            "question": pair["question"],
            **_describe_effect(pair),
            "word": pair["word"],
            "sentence": _remove_marks(pair["sentence"]),
        }
        for pair in pack["planned"]
    ]


def name_effects(pack: Mapping[str, Any]) -> str:
    """Name the effects of the planned pairs, as the head of a column: ratio, runs won, or both.

    Args:
        pack: Data of the page.
    """
    has_won = [bool(pair.get("won")) for pair in pack["planned"]]
    names = ("Ratio", *["runs won"] * any(has_won))
    return "Runs won" if has_won and all(has_won) else " or ".join(names)


def _describe_effect(pair: Mapping[str, Any]) -> dict[str, str]:
    """Return effect, interval and shares of tracks kept of a planned pair."""
    won = pair.get("won")
    if won is None:
        interval = format_interval(pair["low"], pair["high"]) or pair["reason"] or ""
        return {"effect": format_short(pair["estimate"]), "interval": interval, "track": ""}
    first, second = (format_short(100 * share) for share in won["track"])
    return {
        "effect": f"{format_short(won['estimate'])} points",
        "interval": format_interval(won["low"], won["high"]),
        "track": f"{first} and {second} %",
    }


def _name(items: Sequence[Mapping[str, Any]], key: str) -> str:
    """Return the name of a key."""
    return next((str(item["name"]) for item in items if item["key"] == key), key)


def _scope(items: Sequence[Mapping[str, Any]], key: str, noun: str) -> str:
    """Return the name of a key, or how many there are."""
    if key != "all":
        return _name(items, key)
    return str(items[0]["name"]) if len(items) == 1 else f"all {len(items)} {noun}s"
