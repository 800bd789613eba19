"""Shares of verdicts of judge on simulated programs: the table of docs/judge.md.

`PYTHONPATH=.:tests python tests/judge_rates.py [STUDIES]` prints it. Errors of both programs are drawn from the same
law in three axes. A rate of false verdicts counts "better" and "worse" of two such programs, and "equal" where one has
errors that are larger by the margin.
"""

import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter
from scipy.special import bdtr, stdtr

from pfbench.logs.judge.judge_options import JudgeOptions
from pfbench.logs.judge.pair_verdicts import PairVerdict, judge_pairs, remove_nuisance
from pfbench.results.store import JobResult
from pfbench.stats.comparison import EQUALITY_MARGIN, LOG_TOLERANCE, MIN_RUNS
from pfbench.stats.rank_tests import rank_sum_cdf, wilcoxon_signed_rank_rows
from pfbench.stats.time_blocks import (
    BLOCKS,
    MIN_EFFECTIVE,
    block_losses,
    variance_ratio,
)

STEPS = 600
CAP = 100.0
CHUNK = 100  # studies at once
RESIDUALS = Path(__file__).parent / "logs/judge/car_drive/residuals.csv"
Draw = Callable[[np.random.Generator, tuple[int, int]], np.ndarray]  # [P, K] to [P, K, STEPS]

# --------------------------------------------------------------------------------------------------
# Laws of errors. Programs 2 k and 2 k + 1 are compared; times are shares of the record.


def white(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    return rng.normal(size=(*shape, STEPS))


def slow(time: float) -> Draw:
    """A Markov process with a correlation time."""
    a = math.exp(-1 / (time * STEPS))

    def draw(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
        noise = white(rng, shape)
        noise[..., 1:] *= math.sqrt(1 - a * a)
        return np.asarray(lfilter([1.0], [1.0, -a], noise, axis=-1))

    return draw


def add(*parts: tuple[float, Draw]) -> Draw:
    """A sum of independent parts with these variances."""
    return lambda rng, shape: np.sum([math.sqrt(v) * draw(rng, shape) for v, draw in parts], axis=0)


def walk(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    return np.cumsum(white(rng, shape), axis=-1) / math.sqrt(STEPS)


def drift(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    return rng.normal(size=(*shape, 1)) * np.linspace(0.0, 1.0, STEPS)


def bias(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    return np.repeat(rng.normal(size=(*shape, 1)), STEPS, axis=-1)


def heavy(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    return rng.standard_t(2, size=(*shape, STEPS))


def outages(is_shared: bool) -> Draw:
    """About four outages of 3 % of the record, in which errors grow tenfold."""

    def draw(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
        error = slow(0.005)(rng, shape)
        place = np.arange(STEPS)
        for program in range(shape[0]):
            if program % 2 == 0 or not is_shared:
                begin = rng.integers(0, STEPS, max(rng.poisson(4), 1))
                length = np.ceil(rng.exponential(0.03 * STEPS, begin.size))
            for start, steps in zip(begin, length, strict=True):
                is_out = (place >= start) & (place < start + steps)
                growth = 10.0 * rng.normal(size=(shape[1], 1)) * (place - start) / steps
                error[program] += np.where(is_out, growth, 0.0)
        return error

    return draw


def sized(*parts: tuple[float, float]) -> Draw:
    """Errors whose size varies: its logarithm is a sum of Markov processes with these times and SDs."""

    def draw(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
        size = np.sum([sd * slow(time)(rng, (shape[0], 1)) for time, sd in parts], axis=0)
        return slow(0.005)(rng, shape) * np.exp(size)

    return draw


def recorded(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """Half of a record with the spectra of the position errors of a filter on a recorded car drive."""
    size = np.abs(np.fft.rfft(np.loadtxt(RESIDUALS, delimiter=","), axis=0)).T  # [K, F]
    real, imaginary = rng.normal(size=(2, *shape, size.shape[1]))
    drawn = size * (real + 1j * imaginary) / math.sqrt(2)
    drawn[..., 0] = size[:, 0] * real[..., 0]
    return np.fft.irfft(drawn, 2 * STEPS)[..., :STEPS]


def sine(periods: float) -> Draw:
    """An oscillation of one amplitude and phase a run, as Schuler's, with some noise."""

    def draw(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
        size, phase = rng.normal(size=(*shape, 1)), rng.uniform(0.0, 2 * np.pi, (*shape, 1))
        turn = 2 * np.pi * periods * np.arange(STEPS) / STEPS
        return size * np.sin(turn + phase) + math.sqrt(0.1) * slow(0.005)(rng, shape)

    return draw


def _drive() -> np.ndarray:
    """A path with bends at 10 m/s, m, [STEPS, 3]."""
    share = np.arange(STEPS) / STEPS
    yaw = 0.5 + 1.2 * np.sin(6 * np.pi * share) + 4.0 * share
    return np.cumsum(5.0 * np.stack([np.cos(yaw), np.sin(yaw), np.zeros(STEPS)], -1), axis=0)


PATH = _drive()


def formed(matrix: list[list[float]]) -> Draw:
    """An error in the form of the path from its start, of one size a run, with some noise."""
    form = (PATH - PATH[0]) @ np.array(matrix).T

    def draw(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
        return 0.01 * rng.normal(size=(shape[0], 1, 1)) * form.T + slow(0.005)(rng, shape)

    return draw


LAWS: dict[str, Draw] = {
    "white": white,
    **{f"correlation time {100 * t:g} %": slow(t) for t in (0.01, 0.02, 0.05, 0.1, 0.2)},
    **{
        f"white plus {100 * v:g} % slow, {100 * t:g} %": add((1 - v, white), (v, slow(t)))
        for v, t in ((0.1, 0.05), (0.1, 0.2), (0.25, 0.05), (0.25, 0.1), (0.25, 0.2), (0.5, 0.1), (0.5, 0.2))
    },
    "random walk": walk,
    "white plus random walk": add((0.1, white), (1.0, walk)),
    "white plus drift": add((0.1, white), (1.0, drift)),
    "bias of the run": add((1.0, slow(0.005)), (1.0, bias)),
    "outages at the same times": outages(True),
    "outages at other times": outages(False),
    "heavy tails": heavy,
    "recorded residuals": recorded,
    "size varies in 2 %": sized((0.02, 1.0)),
    "size varies in 5 %": sized((0.05, 1.0)),
    "size varies in 10 %": sized((0.1, 1.0)),
    "size varies in 0.5 and 10 %": sized((0.005, 0.7), (0.1, 0.5)),
    **{f"sine of T / {n:g}": sine(n) for n in (3.0, 7.5, 8.0)},
    "yaw of 0.01 rad": formed([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]),
    "scale of 1 %": formed([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]),
}  # fmt: skip


NOT_HELD = "size varies in 0.5 and 10 %"  # the level is exceeded: a limit that docs/judge.md states


class Row(NamedTuple):
    """A row of the table: a law of errors, the number of sequences, and the share of lost runs."""

    law: str
    sequences: int = 1
    lost: float = 0.0


_SEVERAL = (
    "white", "correlation time 5 %", "white plus 25 % slow, 10 %", "white plus 25 % slow, 20 %", "random walk",
    "white plus drift", "bias of the run", "outages at other times", "heavy tails",
)  # fmt: skip
ROWS = (
    *map(Row, LAWS),
    *(Row(law, n) for n in (3, 10) for law in _SEVERAL),
    *(Row("correlation time 2 %", n, lost) for n in (1, 3, 10) for lost in (0.1, 0.4)),
)


def draw_studies(row: Row, studies: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield errors [S, sequences, 2, STEPS, 3] and lost runs [S, sequences, 2] in chunks."""
    rng = np.random.default_rng([list(LAWS).index(row.law), row.sequences, round(10 * row.lost)])
    for first in range(0, studies, CHUNK):
        shape = (min(CHUNK, studies - first), row.sequences, 2)
        error = LAWS[row.law](rng, (math.prod(shape), 3))
        yield error.reshape(*shape, 3, STEPS).swapaxes(-1, -2), rng.uniform(size=shape) < row.lost


def scale_first(error: np.ndarray, ratio: float) -> np.ndarray:
    """Multiply the errors of the first program of each pair."""
    return error * np.array([ratio, 1.0])[:, None, None]


# --------------------------------------------------------------------------------------------------
# Verdicts of judge: one study by the product, and many studies at once with the same words.

META = {"state": {"names": list("NED"), "units": ["m"] * 3, "groups": {"position": (0, 1, 2)}}, "config": {"scenario": {}}}  # fmt: skip


def judge_study(error: np.ndarray, lost: np.ndarray) -> PairVerdict:
    """Judge one study, [sequences, 2, STEPS, 3] and [sequences, 2]."""
    epochs = SimpleNamespace(time=np.arange(STEPS) * 0.5)
    study = [
        SimpleNamespace(
            name=f"s{k}",
            epochs=epochs,
            reference=SimpleNamespace(interpolate_position=lambda _: PATH),
            run_names={"a": ("",), "b": ("",)},
            results={
                name: JobResult(META, {"error": e[None], "lost": np.array([gone])})
                for name, e, gone in zip("ab", error[k], lost[k], strict=True)
            },
        )
        for k in range(len(error))
    ]
    return judge_pairs(study, [("a", "b")], JudgeOptions(limit=CAP))[0]


class Words(NamedTuple):
    """Words of many studies.

    Attributes:
        sign: -1 for better, 1 for worse, 0 otherwise, [S].
        equal: Whether the word is equal, [S].
        effective: Number of independent units, [S].
    """

    sign: np.ndarray
    equal: np.ndarray
    effective: np.ndarray


def judge_studies(error: np.ndarray, lost: np.ndarray) -> Words:
    """Judge many studies of one pair at once, [S, sequences, 2, STEPS, 3] and [S, sequences, 2]."""
    sequences = error.shape[1]
    if sequences >= MIN_RUNS:
        rmse = np.sqrt((error**2).sum(-1).mean(-1))
        loss = np.log(np.minimum(np.where(lost, CAP, rmse), CAP))
        return _words(loss[..., 0] - loss[..., 1], np.ones(len(error)))
    parts = []
    for change in (lambda error, _: error, remove_nuisance):
        loss = block_losses(change(error, PATH)[..., None, :, :], BLOCKS // sequences, CAP)
        d = (loss[:, :, 0] - loss[:, :, 1]).reshape(len(error), -1)
        parts.append(_words(d, variance_ratio(d)))
    whole, steady = parts
    effective = np.minimum(whole.effective, steady.effective)
    counts = (effective >= MIN_EFFECTIVE) & ~lost.any(axis=(1, 2))
    sign = np.where(counts & (whole.sign == steady.sign), whole.sign, 0)
    return Words(sign, counts & whole.equal & steady.equal, effective)


def _words(d: np.ndarray, ratio: np.ndarray, margin: float = EQUALITY_MARGIN) -> Words:
    """Decide one pair of each study alone, from differences [S, n]."""
    n = d.shape[1]
    i, j = np.triu_indices(n)
    location = np.median((d[:, i] + d[:, j]) / 2, axis=1, keepdims=True)
    d = location + np.sqrt(ratio)[:, None] * (d - location)
    k = int(np.searchsorted(rank_sum_cdf(n), 0.025, side="right"))
    means = np.sort((d[:, i] + d[:, j]) / 2, axis=1)
    low, high = means[:, k - 1], means[:, -k]
    p = wilcoxon_signed_rank_rows(d)[1]
    cut = int(0.2 * n + 1e-9)
    h, ordered = n - 2 * cut, np.sort(d, axis=1)
    trimmed = ordered[:, cut : n - cut].mean(axis=1)
    winsorised = np.clip(d, ordered[:, [cut]], ordered[:, [n - cut - 1]])
    error = np.sqrt(n * winsorised.var(axis=1) / (h * (h - 1)))
    with np.errstate(divide="ignore", invalid="ignore"):  # equal differences, as of lost epochs
        t = np.where((error == 0.0) & (trimmed == 0.0), 0.0, trimmed / error)
    equal = (np.minimum(low, np.where(p < 0.05, low, 0)) > -margin) & (np.maximum(high, np.where(p < 0.05, high, 0)) < margin)  # fmt: skip
    more, fewer = (d > LOG_TOLERANCE).sum(axis=1), (d < -LOG_TOLERANCE).sum(axis=1)
    against = np.where(location[:, 0] < 0, more, fewer)
    agree = (
        (p < 0.05)
        & (2 * stdtr(h - 1, -np.abs(t)) < 0.05)
        & (bdtr(against, more + fewer, 0.5) < 0.05)
    )
    sign = np.where(agree & ~equal & (trimmed * location[:, 0] > 0), np.sign(location[:, 0]), 0)
    return Words(sign, equal, n / ratio)


def naive_alarms(row: Row, studies: int) -> float:
    """Return the share of equal programs called different by blocks that count as independent.

    Lost runs have the cap in all of their blocks.
    """
    count = 0
    for error, lost in draw_studies(row, studies):
        size = np.where(lost[..., None, None], CAP, error)[..., None, :, :]
        loss = block_losses(size, BLOCKS // row.sequences, CAP)
        d = (loss[:, :, 0] - loss[:, :, 1]).reshape(len(error), -1)
        count += int((_words(d, np.ones(len(d)), 0.0).sign != 0).sum())
    return count / studies


class Rates(NamedTuple):
    """Shares of words of a row.

    Attributes:
        different: Share of better and worse of equal programs.
        equal: Share of equal where the errors differ by the margin.
        decided: Share of better where the errors are 30 % smaller.
        effective: Median number of independent units of equal programs.
    """

    different: float
    equal: float
    decided: float
    effective: float


def rates(row: Row, studies: int) -> Rates:
    """Return the rates of a row."""
    found = []
    for error, lost in draw_studies(row, studies):
        words = [judge_studies(scale_first(error, r), lost) for r in (1.0, math.exp(EQUALITY_MARGIN), 0.7)]  # fmt: skip
        found.append((words[0].sign != 0, words[1].equal, words[2].sign < 0, words[0].effective))
    same, margin, smaller, effective = (np.concatenate(x) for x in zip(*found, strict=True))
    return Rates(float(same.mean()), float(margin.mean()), float(smaller.mean()), float(np.median(effective)))  # fmt: skip


def main(studies: int) -> None:
    """Print the table."""
    head = ("errors", "sequences", "lost [%]", "independent units", "called different", "called equal at 5 %", "decided at 30 %")  # fmt: skip
    print(f"| {' | '.join(head)} |\n|{' --- |' * len(head)}")
    for row in ROWS:
        rate = rates(row, studies)
        cells = [row.law, row.sequences, f"{100 * row.lost:g}", f"{rate.effective:.0f}"]
        print(f"| {' | '.join(map(str, [*cells, *(f'{x:.3f}' for x in rate[:3])]))} |", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 2000)
