"""Sentences on the verdicts of a judgement, and on how far they reach."""

from __future__ import annotations

import math
from collections.abc import Iterator

from pfbench.logs.judge.judgement import Judgement
from pfbench.logs.judge.pair_verdicts import PairVerdict
from pfbench.stats.comparison import EQUAL_WORD, MIN_RUNS, NO_DECISION, SAME_RUNS
from pfbench.stats.sentences import format_count, format_digits

_TENFOLD = 10.0
_UNITS = {"world": "sequence", "run": "run", "block": "block"}


def describe_judgement(judgement: Judgement) -> Iterator[str]:
    """Describe the verdicts of a judgement.

    Args:
        judgement: Judgement of programs.

    Yields:
        One or two sentences on each pair, with the ratio, its interval and the size of the sample.
    """
    if not judgement.pairs:
        yield "One program: nothing is compared. The tables state its errors."
    for pair in judgement.pairs:
        yield _describe_pair(pair)


def describe_limits(judgement: Judgement) -> Iterator[str]:
    """Yield the reach of the verdicts."""
    units, count = {pair.unit for pair in judgement.pairs}, len(judgement.sequences)
    if "world" in units:
        yield f"The sample is a sequence: the verdicts hold for new sequences of the kind of these {count}."
    if "run" in units:
        yield "The sample is a run: the verdicts hold for other runs of these sequences."
    if "block" in units:
        yield (
            "The sample is a block of time, since a pair has fewer than "
            f"{MIN_RUNS} sequences and fewer than {MIN_RUNS} runs of each. The verdicts hold for these recordings. "
            "Neighbouring blocks depend on each other: the number of independent blocks with the same variance of "
            "the mean is stated, from blocks and from pairs of blocks."
        )
        yield (
            "One record cannot tell a bias of the whole run or a drift as long as the run from what another run "
            "would have. A pair is decided only if the verdict is the same without them."
        )
    yield (
        '"Better" means a smaller error in most units of the sample. All pairs form one family with Holm\'s '
        "correction, and their intervals hold together."
    )
    yield (
        "Position errors are estimate minus reference at the epochs of the programs. The reference is "
        "interpolated, the estimates are not. Errors of the reference count as errors of all programs."
    )
    yield (
        "RMSE: root mean square over the scored epochs. With several runs, RMSE, quantile and maximum are "
        "means over the valid runs. Epochs in holes are scored, so more epochs than rows can be scored."
    )


def format_size(ratio: float, low: float, high: float) -> str:
    """Format a ratio of errors and its interval as "26 % smaller (18 to 33 %)"."""
    if max(ratio, high) > _TENFOLD or ratio < 1 / _TENFOLD:
        return f"{format_digits(ratio)} times as large ({format_digits(low)} to {_format_end(high)} times)"
    sign = -1.0 if ratio < 1 else 1.0
    ends = sorted(100 * sign * (end - 1) for end in (low, high))
    size = f"{format_digits(100 * abs(ratio - 1))} % {'smaller' if ratio < 1 else 'larger'}"
    return f"{size} ({format_digits(ends[0])} to {format_digits(ends[1])} %)"


def _format_end(value: float) -> str:
    return format_digits(value) if math.isfinite(value) else "any number of"


def _describe_pair(pair: PairVerdict) -> str:
    """Describe the verdict on a pair."""
    v = pair.verdict
    head = f"{_describe_place(pair)}, " if pair.sequences else ""
    if v.word == SAME_RUNS:
        return f"{head}{v.a} and {v.b} give identical errors."
    if v.n == 0:
        return f"{head}{v.a} and {v.b} are not compared: {v.reason}."
    effect = (
        f"the position error of {v.a} is {_insert_name(format_size(v.ratio, v.low, v.high), v.b)}"
    )
    sample = f"{effect}; {_describe_sample(pair)}"
    if v.word == NO_DECISION:
        reason = f" ({v.reason})" if v.reason else ""
        return f"{head}{v.a} and {v.b} are not decided{reason}: {sample}.{_describe_need(pair)}{_describe_rmse(pair)}"
    if v.word == EQUAL_WORD:
        return f"{head}{v.a} and {v.b} are equal within the margin: {sample}.{_describe_rmse(pair)}"
    return f"{head}{v.a} is {v.word} than {v.b}: {sample}; adjusted p = {v.p:.2g}.{_describe_rmse(pair)}"


def _describe_place(pair: PairVerdict) -> str:
    """Describe the sequences and the time of a pair."""
    if len(pair.sequences) == 1:
        return f"Along {format_digits(pair.seconds)} s of {pair.sequences[0]}"
    return f"In {len(pair.sequences)} sequences of {format_digits(pair.seconds)} s"


def _insert_name(effect: str, name: str) -> str:
    """Return "26 % smaller than that of b (18 to 33 %)"."""
    size, bracket, rest = effect.partition(" (")
    than = " as that of " if size.endswith("as large") else " than that of "
    return f"{size}{than}{name}{bracket}{rest}"


def _describe_sample(pair: PairVerdict) -> str:
    """Describe the number of units, and how many independent ones they are."""
    count = format_count(pair.verdict.n, _UNITS[pair.unit])
    if pair.unit != "block":
        return count
    effective = format_digits(pair.effective, 2)
    return f"{count} of {format_digits(pair.block_s)} s that count as {effective} independent ones"


def _describe_need(pair: PairVerdict) -> str:
    """Describe how long a record would decide; empty if unknown."""
    need = pair.seconds_needed
    return (
        f" About {format_digits(need)} s would decide a difference of the margin."
        if math.isfinite(need)
        else ""
    )


def _describe_rmse(pair: PairVerdict) -> str:
    """Describe a ratio of root mean squares that lies outside of the interval; empty otherwise."""
    v, ratio = pair.verdict, pair.rmse_ratio
    if math.isnan(ratio) or v.low <= ratio <= v.high:
        return ""
    return f" Few blocks hold most of the squared error: the ratio of the RMSE is {format_digits(ratio)}."
