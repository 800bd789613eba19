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
    REPAIRED,
    ClaimPlan,
    read_claim_data,
    read_plans,
    read_proofs,
    read_readings,
)
from pfbench.claims.claim_runs import (
    CLAIMS_STUDY,
    PUBLISHED_VALUES,
    Cell,
    ClaimRuns,
    decide_claims,
)
from pfbench.claims.ledger import (
    ClaimWord,
    conclude,
    count_by_paper,
    describe_kind,
    describe_tip,
    describe_turns,
    list_choices,
)
from pfbench.claims.run_claims import Decisions, Task, describe_words, price_claims
from pfbench.claims.words import NOT_RUN, OPEN, WORDS, ClaimDecision
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

_RATES = Path(__file__).with_name("error_rates.yaml")
COMPARISON = "all_seven"  # study that compares the methods with the Kalman filters of each world
RULES = (
    "Confirmed or refuted: the same outcome in all readings that can run, at 2.5 % for all claims of a paper.",
    "Better is true below a ratio of 1, by however little. If that is not shown, it is false above 0.99.",
    "Much better: a ratio below 0.8. The same: from 1/1.1 to 1.1. A level: within 20 %. At most twice: below 2.",
    "A printed ratio has another line, its size: half to twice its logarithm.",
    "Of several comparisons all must hold. The ratio shown is the one that decides, or else the closest to a border.",
    "Depends: outcomes of both kinds, after correction over claims times readings.",
    "Untestable: circular, vacuous, lost, or no reading can run. Open: none of these.",
    "As published is the printed form. What is lost or cannot run is completed, by name, in the central reading.",
    "A fitted reading is shown and does not count. A repaired form must keep track in the paper's world.",
    "Two looks, at a half and two per cent on each side: the first runs of seed 2001, and all runs.",
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
        "jobs": len(runs.records),
        "hours": sum(record.seconds for record in runs.records) / 3600,
        "missing": sum(task.seconds for task in tasks.values()) / 3600,
        "prices": _list_spent(runs, list(tasks.values())),
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
    columns = ("name", "published", "repaired", "tuned", "is")
    return [
        Block("title", f"{page['n']} claims of five papers, over every plausible reading"),
        Block("text", f"{counts}.{unrun}"),
        Block("list", [Markup(f"**{plain(paper['name'])}.** {plain(paper['sentence'])}") for paper in page["papers"]]),
        make_rows(heads, [[row[name] for name in columns] for row in page["seven"]], rule="---"),
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
        Block("text", f"{page['jobs']} jobs, {page['hours']:.1f} hours of processor time spent, {page['missing']:.1f} hours of second looks missing."),
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
    """Say how often simulated papers, whose claims are at a border, have a false word."""
    stored = yaml.safe_load(_RATES.read_text(encoding="utf-8"))
    confirmed, refuted = (
        max(row[name] for row in stored["rates"]) for name in ("false_confirmed", "false_refuted")
    )
    return (
        f"In {stored['ledgers']} simulated papers with all claims at a border, at most {confirmed:.1%} have a false "
        f"confirmed, and {refuted:.1%} a false refuted."
    )


def _list_spent(runs: ClaimRuns, tasks: Sequence[Task]) -> list[dict[str, Any]]:
    """List jobs and hours spent and missing of each paper; worlds of this project are those of no paper."""

    def find_paper(cell: Cell) -> str:
        return next((word[8:11] for word in cell if word.startswith("reading/")), "others")

    papers = sorted({find_paper(record.cell) for record in runs.records} | {task.paper for task in tasks})  # fmt: skip
    return [
        {
            "paper": paper,
            "jobs": sum(find_paper(record.cell) == paper for record in runs.records),
            "spent": sum(r.seconds for r in runs.records if find_paper(r.cell) == paper) / 3600,
            "missing_jobs": sum(find_paper(task.cell) == paper for task in tasks),
            "missing": sum(t.seconds for t in tasks if find_paper(t.cell) == paper) / 3600,
        }
        for paper in papers
    ]


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
    measured = _format_measured(line, decision)
    repaired = decisions.get((claim.id, REPAIRED, "direction"))
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
        "repaired_measured": _format_measured(line, repaired),
        "size": line.size,
        "kind": describe_kind(line.plan),
        "figure": f"{claim.figure}: {claim.a}" + (f" and {', '.join(claim.b)}" if claim.b else ""),
        "printed": claim.printed,
        "measured": measured,
        "border": describe_tip(line),
        "dots": _make_dots(line),
        "turns": describe_turns(line),
        "proof": claim.proof,
        "mark": claim.mark,
        "objection": " ".join(row["what"] for row in read_claim_data()["disputed"] if claim.id in row["claims"]),
        "choices": list_choices(line.plan),
        "price": _format_price(price) if price else "",
        "has_runs": bool(line.plan.parts),
    }  # fmt: skip


def _format_measured(line: ClaimWord, decision: ClaimDecision | None) -> str:
    """Format the ratio of a decision with its interval, and name its reading if it is not the central one."""
    if decision is None or not decision.runs:
        return ""
    numbers = _format_ratio(decision.ratio, decision.low, decision.high)
    first = next(iter(decision.outcomes))
    where = "" if decision.reading == first else f" ({_name_dot(line, decision.reading)})"
    return f"{decision.sides} = {numbers}, {decision.runs} runs; smaller in {decision.order:.0%} of them{where}"


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
    """Make the dots of a claim: a reading each, with outcome and text."""
    if line.decision is None:
        return []
    return [
        {
            "outcome": outcome.replace(" ", "-"),
            "text": f"{_name_dot(line, name)}: {outcome}",
        }
        for name, outcome in line.decision.outcomes.items()
    ]


def _name_dot(line: ClaimWord, name: str) -> str:
    """Name a reading, a window of time or a world of this project."""
    if line.plan.toy:
        return f"World of this project, {' '.join(line.plan.toy)}"
    readings = read_readings(line.plan.claim.paper)
    return readings[name].text.rstrip(".") if name in readings else name


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
