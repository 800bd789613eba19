"""Error rates of the words on claims, over ledgers in which every claim is at the edge of true or of false.

A ledger has claims of one paper, each with readings whose runs share a world. At the edge of true the median ratio
is that at which the claim ceases to be true, so that each "confirmed" is an error; at the edge of false so is each
"refuted". 1000 ledgers take some minutes, and are written for the page of the claims:

    python experiments/analyses/claim_rates.py 1000
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import yaml

from pfbench.claims import KINDS, ClaimDecision, ClaimSample, ReadingDot, decide_paper

LEVEL = 0.025  # of each error
RATES = Path(__file__).resolve().parents[2] / "pfbench" / "claims" / "error_rates.yaml"
KINDS_IN_TURN = ("better", "much better")


def make_comparison(
    g: np.random.Generator, ratio: float, kind: str, n: int = 60, lost: float = 0.0
) -> ClaimSample:
    """Draw runs of two filters with a median ratio, heavy tails, and a share of runs that either one loses."""
    b = np.exp(0.3 * g.standard_normal(n))
    a = b * np.exp(math.log(ratio) + 0.4 * g.standard_t(3, n))
    is_lost = g.random((2, n)) < lost
    return ClaimSample(kind, a, b, is_lost[0], is_lost[1], np.arange(n) < n // 3)


def decide_edge(
    g: np.random.Generator, edge: int, claims: int = 5, readings: int = 1, lost: float = 0.0
) -> dict[str, ClaimDecision]:
    """Decide a ledger whose claims are at the edge of true (0) or of false (1) in all readings."""
    ledger = {}
    for k in range(claims):
        kind = KINDS_IN_TURN[k % len(KINDS_IN_TURN)]
        dots = {
            f"reading {r}": ReadingDot(
                "none" if r == 0 else f"factor {r}",
                [make_comparison(g, KINDS[kind][edge], kind, lost=lost)],
            )
            for r in range(readings)
        }
        ledger[f"claim {k}"] = dots
    return decide_paper(ledger)


def measure_rates(ledgers: int, seed: int, **settings: float) -> tuple[float, float]:
    """Measure the share of ledgers with a false "confirmed", and of those with a false "refuted"."""
    g = np.random.default_rng(seed)
    counts = [0, 0]
    for edge, word in enumerate(("confirmed", "refuted")):
        for _ in range(ledgers):
            decisions = decide_edge(g, edge, **settings)  # type: ignore[arg-type]
            counts[edge] += any(decision.word == word for decision in decisions.values())
    return counts[0] / ledgers, counts[1] / ledgers


def allow(ledgers: int) -> float:
    """Return the largest rate that agrees with the level: two standard errors above."""
    return LEVEL + 2 * math.sqrt(LEVEL * (1 - LEVEL) / ledgers)


def write_rates(ledgers: int) -> None:
    """Measure the rates with all of the settings, print them, and write them for the page of the claims."""
    rows = []
    for readings, lost in ((1, 0.0), (1, 0.1), (2, 0.0)):
        confirmed, refuted = measure_rates(ledgers, 1, readings=readings, lost=lost)
        rows.append({"readings": readings, "lost": lost, "false_confirmed": confirmed, "false_refuted": refuted})  # fmt: skip
        print(f"{ledgers} ledgers, {rows[-1]}, at most {allow(ledgers):.3f}", flush=True)
    head = "# Written by experiments/analyses/claim_rates.py: shares of simulated papers with a false word.\n"
    text = yaml.safe_dump({"ledgers": ledgers, "rates": rows}, sort_keys=False)
    RATES.write_text(head + text, encoding="utf-8")


if __name__ == "__main__":
    write_rates(int(sys.argv[1]) if len(sys.argv) > 1 else 1000)
