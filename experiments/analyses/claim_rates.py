"""Error rates of the words on claims, for planted shares of readings in which a claim is true.

A reading has a clear effect, or one at the border: where true ends, or where false begins. Readings have runs of
their own, or all the same ones, as two ends of what the joint readings of a paper have. A word is false if the planted share
excludes it: confirmed below 95 %, refuted above 5 %, depends outside. 1000 claims for each setting take minutes, and are
written for the page of the claims:

    python experiments/analyses/claim_rates.py 1000
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import yaml

from pfbench.claims import KINDS, ClaimSample, ReadingDot, decide_claim, weigh

LEVEL = 0.025  # of each error
RATES = Path(__file__).resolve().parents[2] / "pfbench" / "claims" / "error_rates.yaml"
SHARES = (0.0, 0.01, 0.05, 0.5, 0.99, 1.0)
CLEAR = (0.6, 1.5)  # ratios of true and of false readings
BORDER = (KINDS["better"][1], KINDS["better"][0])
FIRST, ALL = 20, 80  # runs of a reading
LISTED = 12  # readings of a claim without joint draws
Pool = Mapping[float, Sequence[ReadingDot]]


def make_comparison(g: np.random.Generator, ratio: float, kind: str, n: int = 60, lost: float = 0.0) -> ClaimSample:  # fmt: skip
    """Draw runs of two filters with a median ratio, heavy tails, and a share of runs that either one loses."""
    b = np.exp(0.3 * g.standard_normal(n))
    a = b * np.exp(math.log(ratio) + 0.4 * g.standard_t(3, n))
    is_lost = g.random((2, n)) < lost
    return ClaimSample(kind, a, b, is_lost[0], is_lost[1], np.arange(n) < n // 3)


def draw_pool(g: np.random.Generator, size: int, lost: float = 0.0) -> Pool:
    """Draw runs, and weigh them for each effect: readings of equal place in the lists have the same runs."""
    pool: dict[float, list[ReadingDot]] = {ratio: [] for ratio in (*CLEAR, *BORDER)}
    for _ in range(size):
        c = make_comparison(g, 1.0, "better", ALL, lost)
        for ratio, dots in pool.items():
            shifted = c._replace(a=ratio * c.a, early=np.arange(ALL) < FIRST)
            dots.append(ReadingDot({}, [weigh(shifted)]))
    return pool


def decide_planted(g: np.random.Generator, pool: Pool, share: float, ratios: tuple[float, float], is_common: bool, is_drawn: bool) -> str:  # fmt: skip
    """Decide a claim that is true in a share of its readings, which have the same runs or their own."""
    size = len(pool[ratios[0]])
    n = 200 if is_drawn else LISTED
    is_true = g.random(n) < share
    places = np.full(n, g.integers(size)) if is_common else g.integers(size, size=n)
    dots = {
        str(k): pool[ratios[0 if is_true[k] else 1]][places[k]]._replace(
            levels={"factor": str(is_true[k])}, draw=k if is_drawn else -1
        )
        for k in range(n)
    }
    return decide_claim(dots).word


def measure_rates(claims: int, seed: int, lost: float = 0.0) -> list[dict[str, float | str]]:
    """Measure the share of claims with each word and with each false word, in all settings."""
    g = np.random.default_rng(seed)
    pool = draw_pool(g, claims, lost)
    settings = [
        (share, effect, runs, is_drawn)
        for share in SHARES
        for effect in ("clear", "border")
        for runs in ("own", "common")
        for is_drawn in ((True, False) if share in (0.0, 1.0) else (True,))
    ]
    return [_count_words(g, pool, claims, *setting) for setting in settings]


def _count_words(g: np.random.Generator, pool: Pool, claims: int, share: float, effect: str, runs: str, is_drawn: bool) -> dict[str, float | str]:  # fmt: skip
    """Count the words of a setting."""
    ratios = CLEAR if effect == "clear" else BORDER
    words = [decide_planted(g, pool, share, ratios, runs == "common", is_drawn) for _ in range(claims)]  # fmt: skip
    rates = {word: words.count(word) / claims for word in ("confirmed", "refuted", "depends", "open")}  # fmt: skip
    false = {
        "false_confirmed": rates["confirmed"] * (share < 0.95),
        "false_refuted": rates["refuted"] * (share > 0.05 - 1e-9),
        "false_depends": rates["depends"] * (not 0.05 < share < 0.95),
    }
    readings = "drawn" if is_drawn else "listed"
    return {"share": share, "effect": effect, "runs": runs, "readings": readings, **rates, **false}


def allow(claims: int) -> float:
    """Return the largest rate that agrees with the level: two standard errors above."""
    return LEVEL + 2 * math.sqrt(LEVEL * (1 - LEVEL) / claims)


def write_rates(claims: int) -> None:
    """Measure the rates with all of the settings, print them, and write them for the page of the claims."""
    rows = [{"lost": lost, **row} for lost in (0.0, 0.1) for row in measure_rates(claims, 1, lost)]
    for row in rows:
        print(row, flush=True)
    head = "# Written by experiments/analyses/claim_rates.py: shares of simulated claims with each word, and with a false one.\n"
    text = yaml.safe_dump({"claims": claims, "rates": rows}, sort_keys=False, default_flow_style=None, width=200)  # fmt: skip
    RATES.write_text(head + text, encoding="utf-8")


if __name__ == "__main__":
    write_rates(int(sys.argv[1]) if len(sys.argv) > 1 else 1000)
