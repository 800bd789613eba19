"""How often each word of a decision is wrong, on simulated studies. Writes decisions.json and a table of docs/statistics.md.

    nice python benchmarks/decisions.py [--studies 600] [--only TEXT] [--page]

Finished parts are kept in decisions.json, so that the same command resumes. `--page` only writes the table from it.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
import zlib
from collections import Counter
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from pfbench.files import write_atomically
from pfbench.results import DecisionOptions
from pfbench.stats import decision
from pfbench.stats.planned_pairs import decide_family, stack_questions
from pfbench.stats.simulated_studies import StudySetting, assess_pairs

HERE = Path(__file__).parent
STORE = HERE / "decisions.json"
PAGE = HERE.parent / "docs" / "statistics.md"
START, END = "<!-- numbers:decisions -->", "<!-- numbers:end -->"
CHUNK = 150
OPTIONS = DecisionOptions()
EFFECTS = {"none": 0.0, "margin": -OPTIONS.log_margin, "large": math.log(0.8)}
QUESTIONS = {"a": "same_worlds", "b": "new_world"}
BASE = StudySetting()
SETTINGS = [
    *(replace(BASE, worlds=w) for w in (1, 2, 3, 4, 6, 8, 12)),
    *(replace(BASE, regimes=r) for r in (1, 2)),
    *(replace(BASE, runs=n) for n in (20, 50, 100)),
    *(replace(BASE, worlds=6, noise=name) for name in ("normal", "exponential")),
    *(replace(BASE, lost_a=s, lost_b=s) for s in (0.1, 0.2, 0.4)),
    *(replace(BASE, worlds=6, lost_a=s, lost_b=s) for s in (0.1, 0.4)),
    replace(BASE, worlds=1, regimes=1, runs=50, lost_a=0.4, lost_b=0.4),
    *(replace(BASE, worlds=6, world_correlation=c) for c in (0.0, 0.3)),
    *(replace(BASE, worlds=6, world_sd=s) for s in (0.06, 0.6)),
    *(replace(BASE, mean_sd=s) for s in (0.1, 0.8)),
    *(replace(BASE, estimate="paired", noise=name) for name in ("t3", "exponential")),
]


def name_of(setting: StudySetting) -> str:
    """Names a setting by the values that differ from the base."""
    base, values = asdict(BASE), asdict(setting)
    parts = {"worlds", "regimes", "runs"} | {k for k in values if values[k] != base[k]}
    return " ".join(f"{k}={values[k]}" for k in values if k in parts)


def count_words(setting: StudySetting, question: str, effect: str, chunk: int) -> Counter[str]:
    """Counts the words of one chunk of studies."""
    name = name_of(setting)
    rng = np.random.default_rng([zlib.crc32(f"{name} {question} {effect}".encode()), chunk])
    pairs = setting.draw(rng, CHUNK, EFFECTS[effect], fixed_worlds=question == "a")
    track, error = assess_pairs(pairs, setting.weights, estimate=setting.estimate)
    members = [getattr(effects, QUESTIONS[question]) for effects in (track, error)]
    tests = decide_family(stack_questions(members), OPTIONS.alpha)
    counts: Counter[str] = Counter()
    for s in range(CHUNK):
        ends = [
            (float(tests.low[s, k]), float(tests.high[s, k]), bool(tests.is_decided[s, k]))
            for k in (0, 1)
        ]
        by_runs_won = bool(error.by_runs_won[s])
        margin = 0.0 if by_runs_won else OPTIONS.log_margin
        word, size = decision.pair_word(*ends[1], margin=margin)
        if not np.isfinite(tests.p_corrected[s, 1]):
            word, size = decision.NOT_TESTED, ""
        track_word = (
            decision.IDENTICAL
            if track.identical[s]
            else decision.pair_word(*ends[0], margin=OPTIONS.track_margin)[0]
        )
        counts[f"error {word}"] += 1
        counts[f"track {track_word}"] += 1
        counts["runs won"] += by_runs_won
        is_sized = size == decision.MORE and not by_runs_won
        counts["more than margin"] += is_sized and word == decision.BETTER
        if not by_runs_won and word != decision.NOT_TESTED:
            claim = decision.claim_word(*ends[1], margin=OPTIONS.log_margin, states_size=False)
            counts[f"claim {claim}"] += 1
        either = {word, track_word} & {decision.BETTER, decision.WORSE}
        counts["pair decided"] += bool(either)
    return counts


def run(studies: int, only: str) -> None:
    """Simulates what is missing, and stores every chunk."""
    store = json.loads(STORE.read_text()) if STORE.exists() else {}
    jobs = [
        (setting, question, effect)
        for setting in SETTINGS
        for question in QUESTIONS
        for effect in EFFECTS
        if only in name_of(setting) and not (question == "b" and setting.worlds == 1)
    ]
    begun = time.perf_counter()
    for k, (setting, question, effect) in enumerate(jobs):
        key = f"{name_of(setting)} | {question} | {effect}"
        entry = store.setdefault(key, {"studies": 0, "counts": {}})
        while entry["studies"] < studies:
            counts = Counter(entry["counts"])
            counts.update(count_words(setting, question, effect, entry["studies"] // CHUNK))
            entry["counts"] = dict(sorted(counts.items()))
            entry["studies"] += CHUNK
            text = json.dumps(store, indent=1, sort_keys=True) + "\n"
            write_atomically(STORE, lambda file, text=text: file.write(text.encode()))
        print(f"[{k + 1}/{len(jobs)}] {key}  {time.perf_counter() - begun:.0f} s", file=sys.stderr)


def rate(store: dict, key: str, *names: str) -> str:
    """Share of studies with one of the words, as text."""
    entry = store.get(key)
    if not entry or not entry["studies"]:
        return "-"
    share = sum(entry["counts"].get(name, 0) for name in names) / entry["studies"]
    return f"{share:.3f}"


def table(store: dict) -> str:
    """The table of the page."""
    heads = [
        "worlds, regimes, runs", "changed", "question", "studies", "error decided", "pair decided", "equivalent",
        "more than margin", "claim fails", "decided at 20 %", "by runs won",
    ]  # fmt: skip
    lines = [f"| {' | '.join(heads)} |", "|" + " --- |" * len(heads)]
    decided = ("error better", "error worse")
    for setting in SETTINGS:
        name = name_of(setting)
        changed = [v for v in name.split() if v.split("=")[0] not in ("worlds", "regimes", "runs")]
        for question in QUESTIONS:
            none, margin, large = (f"{name} | {question} | {effect}" for effect in EFFECTS)
            if none not in store:
                continue
            cells = [
                f"{setting.worlds}, {setting.regimes}, {setting.runs}",
                ", ".join(changed).replace("_", " ") or "-",
                f"({question})",
                str(store[none]["studies"]),
                rate(store, none, *decided),
                rate(store, none, "pair decided"),
                rate(store, margin, "error equivalent"),
                rate(store, margin, "more than margin"),
                rate(store, margin, "claim fails"),
                rate(store, large, *decided),
                rate(store, none, "runs won"),
            ]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def page(text: str, store: dict) -> str:
    """The page with the table of the stored counts."""
    head, rest = text.split(START)
    return f"{head}{START}\n{table(store)}\n{END}{rest.split(END, 1)[1]}"


def main() -> None:
    """Simulates and writes the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--studies", type=int, default=600)
    parser.add_argument("--only", default="")
    parser.add_argument("--page", action="store_true")
    options = parser.parse_args()
    if not options.page:
        run(options.studies, options.only)
    PAGE.write_text(page(PAGE.read_text(), json.loads(STORE.read_text())))


if __name__ == "__main__":
    main()
