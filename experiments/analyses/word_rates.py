"""Error rates of the words of a report in simulated studies: the block `rates` of docs/statistics.md.

`python experiments/analyses/word_rates.py [STUDIES]` simulates studies of seven methods and three baselines in one world, many
at once; the first of each row are checked against the functions of a report. It stores the rates in word_rates.json, and writes the table. Filters share the difficulty of a run, and have
noise whose differences are skewed in most rows. A word has its own null: half of the runs smaller for better and worse and the
star; a Hodges-Lehmann ratio at the margin, and a gap of 10 % of lost runs, for equal; equal shares of lost runs for "loses
more"; a share of 80 % for "loses track". Controls must fail: each pair alone, the sign test without a correction, no sign test,
and the row whose null is the mean.
"""

from __future__ import annotations

import json
import math
import re
import sys
from functools import cache
from multiprocessing import Pool
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import special

from pfbench.files import markdown_head, markdown_row
from pfbench.results import LookSchedule, decide
from pfbench.stats.comparison import compare_all
from pfbench.stats.pair_states import look_levels
from pfbench.stats.rank_tests import wilcoxon_signed_rank_rows

PAGE = Path(__file__).parents[2] / "docs" / "statistics.md"
STORED = Path(__file__).with_suffix(".json")
METHODS, BASELINES, BATCH = 7, 3, 100
MARGIN, ALPHA, GAP = math.log(1.05), 0.05, 0.1
DIFFICULTY, OWN, CLOSE = 0.4, 0.28, 0.03  # SD of the log error of a run; of filters that are equal
COLUMNS = (
    "better or worse", "star", "until decided", "equal at the margin", "equal at a gap of 10 %", "loses more", "loses track",
    "each pair alone", "sign test uncorrected", "no sign test", "true effect", "true effect, sign test uncorrected",
)  # fmt: skip
_BLOCK = re.compile(r"<!-- numbers:rates -->\n.*?<!-- numbers:end -->", re.DOTALL)
_LAWS = {
    "normal": lambda g, n: g.standard_normal(n),
    "t3": lambda g, n: g.standard_t(3, n) / math.sqrt(3.0),
    "exponential": lambda g, n: g.exponential(size=n),
    "log-normal": lambda g, n: np.exp(g.standard_normal(n)),
    "slow": lambda g, n: np.log(np.abs(g.standard_normal(n))),  # the error of a run is one offset
    "none": lambda g, n: np.zeros(n),
}  # fmt: skip
_OWN_LAWS = (
    ("exponential", 1.0), ("exponential", -1.0), ("log-normal", 0.7), ("slow", 0.8), ("log-normal", -0.4), ("t3", 1.0), ("slow", -0.5),
    ("exponential", 0.5),
)  # fmt: skip


class Setting(NamedTuple):
    """Size and noise of simulated studies.

    Attributes:
        runs: Number of runs.
        noise: Law of all filters, of the methods alone if it is skewed; own of each filter, or unequal in its size.
        lost: Share of runs without track, of every filter.
        null: What is 0 of the log ratios: their median, or their mean.
    """

    runs: int = 30
    noise: str = "t3"
    lost: float = 0.0
    null: str = "half"


SETTINGS = (
    Setting(30), Setting(100, "normal"), Setting(30, "exponential"), Setting(100, "exponential"), Setting(200, "exponential"),
    Setting(200, "log-normal"), Setting(100, "slow"), Setting(100, "own"), Setting(200, "own"), Setting(200, "unequal"),
    Setting(100, lost=0.1), Setting(100, "own", 0.1), Setting(100, "exponential", null="mean"),
)  # fmt: skip


def list_laws(noise: str) -> list[tuple[str, float]]:
    """List law and size of the noise of each filter."""
    if noise == "own":
        return [*_OWN_LAWS, *_OWN_LAWS[-1:] * (BASELINES - 1)]
    if noise == "unequal":
        return [("exponential", 0.25 * 2 ** (k / 2)) for k in range(METHODS)] + [("exponential", 1.0)] * BASELINES  # fmt: skip
    others = noise if noise in ("normal", "t3") else "none"
    return [(noise, 1.0)] * METHODS + [(others, 1.0)] * BASELINES


@cache
def find_centres(noise: str, null: str) -> np.ndarray:
    """Find the noise of each method minus that of a baseline at which its null holds, [F]; 0 for the baselines.

    That of "ratio" is the median of the mean of two differences, which Hodges and Lehmann estimate.
    """
    rng, size = np.random.default_rng(0), 2_000_000
    laws = list_laws(noise)
    centres = np.zeros(len(laws))
    for k in range(METHODS):
        both = [scale * _LAWS[law](rng, size) for law, scale in (laws[k], laws[METHODS])]
        d = both[0] - both[1]
        means = {"mean": d.mean, "half": lambda d=d: np.median(d), "ratio": lambda d=d: np.median(d[::2] + d[1::2]) / 2}  # fmt: skip
        centres[k] = means[null]()
    return centres


def draw_losses(
    setting: Setting, rng: np.random.Generator, shift: np.ndarray, spread: float = OWN, gap: float = 0.0
) -> np.ndarray:  # fmt: skip
    """Draw the losses of studies whose filters have given log errors, [S, F, N]; methods lose a larger share by the gap."""
    shape = (BATCH, len(shift), setting.runs)
    own = np.stack([scale * _LAWS[law](rng, (BATCH, setting.runs)) for law, scale in list_laws(setting.noise)], 1)  # fmt: skip
    own = own - find_centres(setting.noise, setting.null)[:, None]
    loss = shift[:, None] + DIFFICULTY * rng.standard_normal((BATCH, 1, setting.runs)) + spread * own  # fmt: skip
    lost = np.where(np.arange(shape[1]) < METHODS, setting.lost + gap, setting.lost)
    return np.where(rng.random(shape) < lost[:, None], np.inf, loss)


class Tests(NamedTuple):
    """Tests of all methods against a baseline: log ratios [S, M, N]; the others [S, M], with p-values without a correction."""

    d: np.ndarray
    signed: np.ndarray
    trimmed: np.ndarray
    sign: np.ndarray
    side: np.ndarray


def run_tests(losses: np.ndarray, baseline: int = METHODS) -> Tests:
    """Run the tests of a verdict in all studies at once."""
    with np.errstate(invalid="ignore"):
        d = losses[:, :METHODS] - losses[:, baseline : baseline + 1]
    d = np.where(np.isnan(d), 0.0, d)
    size, n = d.shape[:2], d.shape[2]
    above, p = wilcoxon_signed_rank_rows(d.reshape(-1, n), "less")
    side = np.where(above < n * (n + 1) / 4, -1.0, 1.0).reshape(size)
    signed = np.minimum(1.0, 2 * np.minimum(p, 1 - p)).reshape(size)
    more, fewer = ((np.sign(d) == k).sum(-1) for k in (side[..., None], -side[..., None]))
    cut = int(0.2 * n + 1e-9)
    ordered, middle = np.sort(d, -1), n - 2 * cut
    with np.errstate(invalid="ignore"):  # a fifth of lost runs at one end, which is rare here
        mean = ordered[..., cut : n - cut].mean(-1)
        winsorised = np.clip(d, ordered[..., cut, None], ordered[..., n - cut - 1, None])
        error = winsorised.std(-1) * math.sqrt(n / (middle * (middle - 1)))
        trimmed = np.where(
            mean * side > 0, 2 * special.stdtr(middle - 1, -np.abs(mean / error)), 1.0
        )
    return Tests(d, signed, trimmed, special.bdtr(fewer, more + fewer, 0.5), side)


def holm_rows(p: np.ndarray) -> np.ndarray:
    """Correct the p-values of the family of each study, [S, M]."""
    order = np.argsort(p, -1)
    steps = np.take_along_axis(p, order, -1) * np.arange(p.shape[-1], 0, -1)
    corrected = np.empty_like(p)
    np.put_along_axis(corrected, order, np.minimum(np.maximum.accumulate(steps, -1), 1.0), -1)
    return corrected


def differ(tests: Tests, sign: np.ndarray | None = None, alpha: float = ALPHA) -> np.ndarray:
    """Return which pairs are better or worse, [S, M], with another corrected p-value of the sign test if given."""
    corrected = [holm_rows(p) < alpha for p in (tests.signed, tests.trimmed)]
    return corrected[0] & corrected[1] & ((holm_rows(tests.sign) if sign is None else sign) < alpha)


def are_equal(losses: np.ndarray) -> np.ndarray:
    """Return which pairs are equal, [S, M]: both ends of the simultaneous interval within the margin, by its test."""
    n = losses.shape[-1]
    tests = run_tests(losses)
    inside = [
        wilcoxon_signed_rank_rows((side * tests.d + MARGIN).reshape(-1, n), "greater")[1].reshape(tests.side.shape)
        < ALPHA / METHODS / 2 for side in (1, -1)
    ]  # fmt: skip
    counts = [np.isposinf(side * tests.d).sum(-1) for side in (1, -1)]
    bounds = [special.betaincinv(k + 1.0, n - k, 0.95) < 0.1 for k in counts]
    return np.logical_and.reduce([*inside, *bounds])


def have_star(losses: np.ndarray) -> np.ndarray:
    """Return which methods are called better than all baselines, [S, M], by the rule of the first page."""
    largest = np.zeros((*losses.shape[:1], METHODS))
    for baseline in range(METHODS, METHODS + BASELINES):
        tests = run_tests(losses, baseline)
        p = np.maximum(np.maximum(tests.signed, tests.trimmed) / 2, tests.sign)
        largest = np.maximum(largest, np.where(tests.side < 0, p, 1.0))
    return np.asarray(holm_rows(largest) < ALPHA)


def rate_words(setting: Setting, studies: int, seed: int) -> dict[str, float]:
    """Return the shares of studies with a false word of each kind, of the controls, and with true ones."""
    rng = np.random.default_rng([seed, setting.runs])
    equal = np.zeros(METHODS + BASELINES)
    at_margin, better = equal.copy(), equal.copy()
    at_margin[:METHODS], better[0] = MARGIN, -0.2
    of_ratio, found = setting._replace(null="ratio"), np.zeros(len(COLUMNS))
    looks = [n for n in LookSchedule(max(20, setting.runs)).runs if n <= setting.runs]
    levels = look_levels(looks, ALPHA / METHODS)
    for batch in range(studies // BATCH):
        losses = draw_losses(setting, rng, equal)
        tests, effect = run_tests(losses), run_tests(draw_losses(setting, rng, better))
        if batch == 0:
            check_words(losses, differ(tests))
        alone = [np.isposinf(side * tests.d).sum(-1) for side in (1, -1)]
        fewest = np.minimum(*alone)
        kept = np.isfinite(draw_losses(setting._replace(lost=0.2), rng, equal)).sum(-1)
        words = (
            differ(tests),
            have_star(losses),
            np.any([differ(run_tests(losses[..., :n]), alpha=METHODS * level) for n, level in zip(looks, levels, strict=True)], 0),
            are_equal(draw_losses(of_ratio, rng, at_margin, CLOSE)),
            are_equal(draw_losses(of_ratio, rng, equal, CLOSE, GAP))[:, :1],
            holm_rows(np.minimum(1.0, 2 * special.bdtr(fewest, np.add(*alone), 0.5))) < ALPHA,
            holm_rows(special.bdtr(kept, setting.runs, 0.8)) < ALPHA,
            np.max([tests.signed, tests.trimmed, tests.sign], 0) < ALPHA,
            differ(tests, 2 * tests.sign),
            differ(tests, 0.0 * tests.sign),
            differ(effect)[:, :1],
            differ(effect, 2 * effect.sign)[:, :1],
        )  # fmt: skip
        found += [np.any(some, -1).sum() for some in words]
    return dict(zip(COLUMNS, (float(n) for n in found / studies), strict=True))


def check_words(losses: np.ndarray, expected: np.ndarray, studies: int = 20) -> None:
    """Check that a report says the same of the first studies: the words here are computed for all studies at once."""
    for study, wanted in zip(losses[:studies], expected, strict=False):
        pairs = [((f"f{k}", study[k]), ("base", study[METHODS])) for k in range(METHODS)]
        words = [v.word in ("better", "worse") for v in decide(compare_all(pairs), MARGIN, ALPHA)]
        assert words == wanted.tolist(), (words, wanted)


def format_table(stored: dict[str, Any]) -> str:
    """Format the stored rates of all settings."""
    lines = markdown_head(*Setting._fields, *COLUMNS)
    for row in stored["rows"]:
        rates = (f"{row['rates'][name]:.3f}" for name in COLUMNS)
        lines.append(markdown_row(*map(str, row["setting"]), *rates))
    error = math.sqrt(0.05 * 0.95 / stored["studies"])
    note = (
        f"{stored['studies']} studies a row; the standard error of a rate of 0.050 is {error:.4f}."
    )
    return "\n".join([*lines, "", note])


def fill_page(text: str) -> str:
    """Return a page with the table of the stored rates."""
    block = f"<!-- numbers:rates -->\n{format_table(json.loads(STORED.read_text()))}\n<!-- numbers:end -->"
    return _BLOCK.sub(lambda match: block, text)


if __name__ == "__main__":
    number = int(sys.argv[1]) if len(sys.argv) > 1 else 2000
    with Pool(2) as pool:
        rates = pool.starmap(rate_words, [(s, number, k) for k, s in enumerate(SETTINGS)], chunksize=1)  # fmt: skip
    rows = [{"setting": s, "rates": r} for s, r in zip(SETTINGS, rates, strict=True)]
    STORED.write_text(json.dumps({"studies": number, "rows": rows}, indent=1) + "\n")
    PAGE.write_text(fill_page(PAGE.read_text()))
