"""Page of the claims: a square for each, a sentence for each paper, the seven methods; all else is folded."""

from __future__ import annotations

import gzip
import itertools
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import yaml
from markupsafe import Markup

from pfbench.claims.claim_lines import (
    BESIDE_PART,
    MUCH_BETTER,
    REPAIRED,
    ClaimPlan,
    read_claim_data,
    read_plans,
    read_proofs,
)
from pfbench.claims.claim_runs import (
    CLAIMS_STUDY,
    PUBLISHED_VALUES,
    ClaimRuns,
    Decisions,
    decide_claims,
)
from pfbench.claims.curve import render_curve
from pfbench.claims.ledger import (
    ClaimWord,
    conclude,
    count_by_paper,
    describe_levels,
    describe_share,
    list_choices,
    name_reading,
)
from pfbench.claims.run_claims import describe_words, price_claims
from pfbench.claims.words import (
    LOOKS,
    NOT_RUN,
    OPEN,
    REFUTED,
    WORDS,
    ClaimDecision,
)
from pfbench.files.recorded_folder import RecordedFolder, find_published_file
from pfbench.report import RUNS_FILE, count_better_worlds, find_overviews, read_stored_study
from pfbench.report.page_kit import (
    Block,
    make_rows,
    plain,
    render_markdown,
    render_template,
    with_heading,
)
from pfbench.report.writers import format_data_address

_RATES = Path(__file__).with_name("error_rates.yaml")
_SEVEN = ("name", "published", "repaired", "tuned", "is")  # columns of the table of the seven
COMPARISON = "all_seven"  # study that compares the methods with the Kalman filters of each world
RULES = (
    "A reading is a level of each factor that the paper leaves open. Joint readings are drawn from the grid of all factors, with equal odds for each level, by a stored seed. All have the same runs.",
    "A claim is true or false in a reading if that is shown at 2 % on its side, at the first runs or at all. Otherwise it is undecided there, and counts as either.",
    f"Looks after {', '.join(map(str, LOOKS))} joint readings. Refuted: true in at most 2 %, and in at most 5 % by the interval of the share, 97.5 % on a side. Confirmed: false in as few. Depends: true and false in more than 5 % each, by the same interval.",
    "A claim that depends names the factor that explains most of the variance of true and false.",
    f"With fewer than {LOOKS[0]} joint readings, all readings with one level changed must agree, and the word says so. Such a word may turn where two levels change together.",
    "Worlds of this project and times have no joint readings.",
    "Better is true below a ratio of 1, by however little. If that is not shown, it is false above 0.99.",
    "Much is a factor: a fifth, a ratio below 0.8, or any amount. The same: from 1/1.1 to 1.1. A level: within 20 %. At most twice: below 2.",
    "A printed ratio has another line, its size: half to twice its logarithm.",
    "A claim is split into atoms: what, against whom, and how much. All must hold. What the paper does not plot is shown beside, and does not count.",
    "Untestable: circular, vacuous, lost, or no reading can run. Open: none of these.",
    "As published is the printed form. What is lost or cannot run is completed, by name, in the central reading.",
    "A fitted level is not drawn. A repaired form must keep track in the paper's world.",
)


def write_claims(results: str | Path = "results", out: str | Path = "reports") -> Path:
    """Write `<out>/claims_2/`: index.html, report.md, words.json and the values of all runs.

    Values that the results do not have are read from the folder of the page. Equal values give equal bytes.

    Args:
        results: Folder of the results.
        out: Folder of the reports.

    Returns:
        Path of index.html.
    """
    plans, target = read_plans(), Path(out) / CLAIMS_STUDY
    runs = ClaimRuns.read(Path(results), Path(out))
    decisions = decide_claims(plans, runs)
    context = make_context(plans, runs, decisions, _count_worlds(Path(out) / COMPARISON))
    with RecordedFolder(target) as folder:
        folder.write("words.json", json.dumps(describe_words(decisions), indent=1) + "\n")
        text = json.dumps([asdict(record) for record in runs.records], separators=(",", ":"))
        folder.write(PUBLISHED_VALUES, gzip.compress(text.encode(), mtime=0))
        folder.write("report.md", render_markdown(list_claim_blocks(context)))
        folder.write("index.html", render_template(Path(__file__).parent, context))
        return folder.path / "index.html"


def _count_worlds(study: Path) -> dict[str, tuple[int, int]]:
    """Count the worlds in which each method beats every single Kalman filter; empty without the stored runs of the study."""
    runs = study / RUNS_FILE
    path = runs if runs.is_file() else find_published_file(f"{study.name}/{RUNS_FILE}")
    if path is None:
        return {}
    overviews = find_overviews(*read_stored_study(path.parent, decides=False))
    return count_better_worlds(overviews) if overviews else {}


def make_context(
    plans: Sequence[ClaimPlan],
    runs: ClaimRuns,
    decisions: Decisions,
    worlds: Mapping[str, tuple[int, int]],
) -> dict[str, Any]:
    """Make the values of the templates; `worlds` are those won of those run, by method."""
    lines, data = [conclude(plan, decisions) for plan in plans], read_claim_data()
    missing = price_claims(plans, runs, decisions)
    prices = {price.plan.claim.id: price.seconds for price in missing}
    tasks = {(t.cell, t.batch): t for price in missing for t in price.tasks}
    rows = [make_row(line, decisions, prices) for line in lines]
    counts = count_by_paper(lines)
    papers = [
        {
            "key": paper,
            "name": settings["name"],
            "figures": settings["figures"],
            "sentence": _say_paper(settings["sentence"], counts[paper]),
            "rows": [row for row in rows if row["paper"] == paper],
            "proofs": re.findall(r"P\d+", settings["sentence"]),
        }
        for paper, settings in data["papers"].items()
    ]
    total = {state: sum(count[state] for count in counts.values()) for state in (*WORDS, NOT_RUN)}
    commits = sorted({record.commit or "not stored" for record in runs.records})
    return {
        "title": "Claims of five papers",
        "papers": papers,
        "first_commit": data["fixed_in"],
        "amendments": data["amended"],
        "objections": data["disputed"],
        "seven": make_seven(lines, worlds),
        "compared": bool(worlds),
        "total": total,
        "rules": (*RULES, _say_error_rates()),
        "proofs": read_proofs(),
        "n": len(lines),
        "drawn": sum(row["is_drawn"] for row in rows),
        "jobs": len(runs.records),
        "hours": sum(record.seconds for record in runs.records) / 3600,
        "missing": sum(task.seconds for task in tasks.values()) / 3600,
        "commits": commits,
        "dirty": sum(record.commit.endswith("-dirty") for record in runs.records),
    }


def list_claim_blocks(page: Mapping[str, Any]) -> list[Block]:
    """List the blocks of report.md."""
    counts = ", ".join(f"{count} {word}" for word, count in page["total"].items() if count)
    unrun = "" if page["jobs"] else " Nothing has run yet: words are those of proofs alone."
    heads = (
        "method", "beats its own baseline, as published", "our repair does",
        "our forms, in the study of all seven, beat every single Kalman filter", "as printed, it is",
    )  # fmt: skip
    return [
        Block("title", f"{page['n']} claims of five papers, over joint readings of each paper"),
        Block("text", f"{counts}.{unrun}"),
        Block("list", [Markup(f"**{plain(paper['name'])}.** {plain(paper['sentence'])}") for paper in page["papers"]]),
        make_rows(heads, [[row[name] for name in _SEVEN] for row in page["seven"]], rule="---"),
        *itertools.chain.from_iterable(
            with_heading(Block("heading", paper["name"]), Block("list", [_list_row(row) for row in paper["rows"]])) for paper in page["papers"]
        ),
        *with_heading(Block("heading", "Proofs"), Block("list", [f"{p.id}, {p.equation}: {p.shows}" for p in page["proofs"]])),
        *with_heading(
            Block("heading", "What an author may dispute"), Block("list", [f"{', '.join(row['claims'])}: {row['what']}" for row in page["objections"]])
        ),
        Block("heading", "Changed after the first runs"),
        Block("text", f"Claims, readings and rules were fixed in commit {page['first_commit']}, before the first run of seeds 2001 to 2003, except for these."),
        Block("list", [f"{', '.join(row['claims'])}: {row['what']} Before: {row['before']}." for row in page["amendments"]]),
        Block("heading", "Rules"),
        Block("list", page["rules"]),
        Block("text", f"{page['jobs']} jobs, {page['hours']:.1f} hours of processor time spent, {page['missing']:.1f} hours to the next looks missing."),
    ]  # fmt: skip


def _list_row(row: Mapping[str, Any]) -> str:
    """Word a claim in a line of report.md."""
    text = f'{row["id"]}, {row["said"]}: "{row["words"]}" ({row["section"]}). {row["measured"]}'
    if row["repaired"]:
        reason = row["repaired_reason"] and f", {row['repaired_reason']}"
        text += f" Our repair: {row['repaired']}{reason}."
    if row["mark"] and row["word"] != "untestable":
        text += f" One reading does not count, as {row['mark']}."
    return text


def _say_error_rates() -> str:
    """Say how often simulated claims at a border have a false word."""
    stored = yaml.safe_load(_RATES.read_text(encoding="utf-8"))
    confirmed, refuted, depends = (
        max(row[f"false_{word}"] for row in stored["rates"]) for word in ("confirmed", "refuted", "depends")
    )  # fmt: skip
    return (
        f"In {stored['claims']} simulated claims at each border, at most {confirmed:.1%} have a false confirmed, {refuted:.1%} a "
        f"false refuted, and {depends:.1%} a false depends."
    )


def _say_paper(sentence: str, counts: Mapping[str, int]) -> str:
    """Say what became of a paper: its proof, and the words of its claims."""
    numbers = ", ".join(f"{n} {word}" for word, n in counts.items() if n)
    return f"{sentence} Claims: {numbers}."


def make_row(line: ClaimWord, decisions: Decisions, prices: Mapping[str, float]) -> dict[str, Any]:
    """Make the row of a claim."""
    claim, decision = line.plan.claim, line.decision
    price = prices.get(claim.id, 0.0)
    reason = f"{line.reason}, price {_format_price(price)}" if price and line.state == NOT_RUN else line.reason  # fmt: skip
    statement = f"{line.label}: {reason}" if reason else line.label
    measured = _format_shown(line, decision)
    return {
        "id": claim.id,
        "paper": claim.paper,
        "words": claim.words,
        "section": claim.section,
        "word": line.word,
        "state": line.state,
        "said": statement,
        "tip": f"{claim.id}: {statement}. “{claim.words}” {measured}".strip(),
        "repaired": line.repaired,
        "repaired_reason": line.repaired_reason,
        "repaired_measured": _format_shown(line, decisions.get((claim.id, REPAIRED, "direction"))),
        "size": line.size,
        "figure": f"{claim.figure}: {claim.a}" + (f" and {', '.join(claim.b)}" if claim.b else ""),
        "printed": claim.printed,
        "measured": measured,
        "strongest": _format_shown(line, decision, is_best=True) if line.word == REFUTED else "",
        "atoms": _list_atoms(claim.id, decisions),
        "curve": Markup(format_data_address("svg", render_curve(line.plan, decision))) if decision and decision.is_drawn else "",
        "dots": _make_dots(line),
        "levels": describe_levels(line),
        "factor": decision.factor if decision else "",
        "explained": f"{decision.explained:.0%}" if decision else "",
        "is_drawn": bool(decision and decision.is_drawn),
        "proof": claim.proof,
        "mark": claim.mark,
        "objection": " ".join(row["what"] for row in read_claim_data()["disputed"] if claim.id in row["claims"]),
        "choices": list_choices(line.plan),
        "price": _format_price(price) if price else "",
        "has_runs": bool(line.plan.parts),
    }  # fmt: skip


def _format_shown(line: ClaimWord, decision: ClaimDecision | None, is_best: bool = False) -> str:
    """Format the ratio in the first reading that has one, or in the best one for the claim, and name it if others decide too."""
    if decision is None or not decision.ratios:
        return ""
    name, effect = decision.strongest if is_best else decision.first
    is_central = name == next(iter(decision.outcomes)) and not is_best
    where = "" if is_central else f" ({name_reading(line.plan, name, decision)})"
    numbers = _format_ratio(effect.ratio, effect.low, effect.high)
    return f"{effect.sides} = {numbers}, {effect.runs} runs; smaller in {effect.order:.0%} of them{where}"


def _list_atoms(claim: str, decisions: Decisions) -> list[dict[str, str]]:
    """List the atoms of a claim: what is compared with whom and how much is asked, with the word on it."""
    return [
        {
            "text": f"{portion.partition(', ')[2].replace(MUCH_BETTER, 'a fifth better')} ({column}{', beside the claim' * portion.startswith(BESIDE_PART)})",
            "word": decision.word,
            "share": describe_share(decision),
        }
        for (name, column, portion), decision in decisions.items()
        if name == claim and ", " in portion
    ]  # fmt: skip


def _format_ratio(value: float, low: float, high: float) -> str:
    """Format a ratio and its interval without an exponent, with the decimals that two digits of its width need."""
    width, least = min(high, 1e4) - low, min(max(low, 1e-3), 1e4)
    decimals = 1 - math.floor(math.log10(width)) if width > 0 else 2
    decimals = min(max(decimals, -math.floor(math.log10(least)), 0), 5)
    ratio, first, last = (
        "above 10 000" if x >= 1e4 else "below 0.001" if 0 < x < 1e-3 else f"{x:.{decimals}f}"
        for x in (value, low, high)
    )
    return f"{ratio} [{first}, {last}]"


def _format_price(seconds: float) -> str:
    """Format the price of runs."""
    if seconds < 90:
        return f"{max(seconds, 1):.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _make_dots(line: ClaimWord) -> list[dict[str, str]]:
    """Make the dots of a claim that listed readings decide: outcome and text of each."""
    decision = line.decision
    if decision is None or decision.is_drawn:
        return []
    return [
        {"outcome": outcome.replace(" ", "-"), "text": f"{name_reading(line.plan, name, decision)}: {outcome}"}
        for name, outcome in decision.outcomes.items()
    ]  # fmt: skip


def make_seven(
    lines: Sequence[ClaimWord], worlds: Mapping[str, tuple[int, int]]
) -> list[dict[str, str]]:
    """Make the table of the seven methods."""
    words = {line.plan.claim.id: line for line in lines}
    return [
        {
            "name": entry["name"],
            "claim": entry["claim"],
            "paper": words[entry["claim"]].plan.claim.paper,
            "published": f"{_say_fate(words[entry['claim']], words[entry['claim']].label)}, against {entry['against']}",
            "repaired": _say_fate(
                words[entry["claim"]], words[entry["claim"]].repaired or "no repair"
            ),
            "tuned": _say_worlds(*worlds.get(entry["filter"], (0, 0))),
            "is": entry["is"],
        }
        for entry in read_claim_data()["seven"]
    ]


def _say_fate(line: ClaimWord, word: str) -> str:
    """Say the word on a method, or that its claim has not run."""
    return NOT_RUN if word == OPEN and line.state == NOT_RUN else word


def _say_worlds(better: int, count: int) -> str:
    """Say in how many worlds a method beats every single Kalman filter."""
    return (
        (f"in {better} of {count} worlds" if better else f"in none of {count}")
        if count
        else NOT_RUN
    )
