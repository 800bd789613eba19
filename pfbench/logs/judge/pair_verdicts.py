"""Verdicts on pairs of programs: the unit of each pair, its effect, and one family of tests of all pairs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal.windows import dpss

from pfbench.logs.judge.judge_options import JudgeOptions
from pfbench.logs.judge.sequence_results import SequenceResults
from pfbench.results.status import keeps_track
from pfbench.stats.comparison import (
    EQUALITY_MARGIN,
    MIN_RUNS,
    NO_DECISION,
    Effect,
    Unit,
    Verdict,
    compare,
    decide,
)
from pfbench.stats.error_measures import Array, Flags, rmse_per_run
from pfbench.stats.sentences import format_count
from pfbench.stats.time_blocks import (
    BLOCKS,
    block_losses,
    bound_losses,
    compare_blocks,
    count_blocks,
    withhold,
)

_ONE_DRAW = "offset, drift, slow oscillations, heading or scale"  # of a run
_LEAST_ROWS = 4  # epochs of each recentred component
_LEAST_CAP = 100.0  # m, error of a lost run where the reference does not move [ours]


class PairVerdict(NamedTuple):
    """Verdict on a pair of programs, and the sample that it rests on.

    Attributes:
        verdict: Verdict on the position errors; its reason says why nothing is decided.
        unit: "world" for a sequence, "run" or "block".
        sequences: Names of the sequences that both programs have.
        seconds: Scored time of these sequences, s.
        block_s: Mean length of a block, s; NaN for another unit.
        effective: Number of independent units with the same variance of the mean.
        rmse_ratio: Ratio of the root mean square errors of all blocks; NaN for another unit.
    """

    verdict: Verdict
    unit: Unit
    sequences: tuple[str, ...]
    seconds: float
    block_s: float
    effective: float
    rmse_ratio: float

    @property
    def seconds_needed(self) -> float:
        """Length of a record whose interval is as wide as the margin on each side, s; infinite if unknown."""
        v = self.verdict
        if (
            self.unit != "block"
            or v.n < MIN_RUNS
            or v.reason
            or not (v.low > 0 and v.high < math.inf)
        ):
            return math.inf
        return self.seconds * (math.log(v.high / v.low) / 2 / EQUALITY_MARGIN) ** 2


class _Common(NamedTuple):
    """A sequence that both programs have, with the runs of the same name."""

    sequence: SequenceResults
    runs: tuple[str, ...]
    cap: float


class _Sample(NamedTuple):
    """Effects of a pair: of the errors, and without what is one draw of each run."""

    effect: Effect
    steady: Effect
    effective: float
    block_s: float
    rmse_ratio: float
    common: list[_Common]
    reason: str = ""


def judge_pairs(
    sequences: Sequence[SequenceResults], pairs: Sequence[tuple[str, str]], options: JudgeOptions
) -> list[PairVerdict]:
    """Decide all pairs of programs in one family."""
    samples = [_draw_sample(sequences, a, b, options) for a, b in pairs]
    margin = math.log1p(options.margin)
    verdicts = decide([s.effect for s in samples], margin, options.alpha)
    steady = decide([s.steady for s in samples], margin, options.alpha)
    return [
        PairVerdict(
            _withhold(sample, *both),
            sample.effect.unit,
            tuple(c.sequence.name for c in sample.common),
            sum(_seconds(c.sequence) for c in sample.common),
            sample.block_s,
            sample.effective,
            sample.rmse_ratio,
        )
        for sample, *both in zip(samples, verdicts, steady, strict=True)
    ]


def cap_of(sequence: SequenceResults, options: JudgeOptions) -> float:
    """Return the error of a lost run, m: the limit, else the largest distance of the reference from its start."""
    if options.limit:
        return options.limit
    position = sequence.reference.position
    return max(float(np.linalg.norm(position - position[0], axis=-1).max()), _LEAST_CAP)


def _withhold(sample: _Sample, verdict: Verdict, steady: Verdict) -> Verdict:
    """Return the verdict, undecided where the sample cannot carry its word."""
    if sample.reason:
        return verdict._replace(word=NO_DECISION, reason=sample.reason)
    decided = withhold(verdict, steady, sample.effective, _ONE_DRAW)
    more = MIN_RUNS - len(sample.common)
    if decided.reason and sample.effect.unit == "block":
        return decided._replace(reason=f"{decided.reason}; {more} further sequences would decide")
    return decided


def _draw_sample(
    sequences: Sequence[SequenceResults], a: str, b: str, options: JudgeOptions
) -> _Sample:
    """Choose the unit of a pair and compare its losses."""
    both = [s for s in sequences if a in s.results and b in s.results]
    shared = [(s, tuple(r for r in s.run_names[a] if r in s.run_names[b])) for s in both]
    common = [_Common(s, runs, cap_of(s, options)) for s, runs in shared if runs]
    if not common:
        reason = _name_missing(both[0], a, b) if both else "no sequence has both"
        return _no_sample(a, b, common, reason)
    if len(common) >= MIN_RUNS:
        means = [np.array([_run_losses(c, p).mean() for c in common]) for p in (a, b)]
        return _of_units(compare((a, means[0]), (b, means[1]), "world"), common)
    if min(len(c.runs) for c in common) >= MIN_RUNS:
        losses = [np.concatenate([_run_losses(c, p) for c in common]) for p in (a, b)]
        return _of_units(compare((a, losses[0]), (b, losses[1]), "run"), common)
    lost = _count_lost(common, a, b)
    return _no_sample(a, b, common, lost) if lost else _of_blocks(common, a, b, options)


def _of_units(effect: Effect, common: list[_Common]) -> _Sample:
    return _Sample(effect, effect, float(len(effect.differences)), math.nan, math.nan, common)


def _no_sample(a: str, b: str, common: list[_Common], reason: str) -> _Sample:
    nothing = compare((a, np.empty(0)), (b, np.empty(0)), "block")
    return _Sample(nothing, nothing, 0.0, math.nan, math.nan, common, reason)


def _of_blocks(common: list[_Common], a: str, b: str, options: JudgeOptions) -> _Sample:
    """Compare blocks of time of all sequences."""
    seconds = [_seconds(c.sequence) for c in common]
    counts = count_blocks(seconds, options.block)

    def losses(program: str, change: Callable[[Array, Array], Array]) -> tuple[str, Array]:
        of_sequences = zip(common, counts, strict=True)
        parts = [block_losses(change(_errors(c, program), c.sequence.reference.interpolate_position(c.sequence.epochs.time)), n, c.cap) for c, n in of_sequences]  # fmt: skip
        return program, np.concatenate(parts)

    full, steady = (
        compare_blocks(losses(a, change), losses(b, change))
        for change in (lambda error, _: error, remove_nuisance)
    )
    length = sum(seconds) / len(full.effect.differences)
    effective = min(full.effective, steady.effective)
    squares = [sum(float((_errors(c, p) ** 2).sum()) for c in common) for p in (a, b)]
    rmse_ratio = math.sqrt(squares[0] / squares[1]) if squares[1] else math.nan
    return _Sample(full.effect, steady.effect, effective, length, rmse_ratio, common)


def _rows(common: _Common, program: str) -> list[int]:
    names = common.sequence.run_names[program]
    return [names.index(run) for run in common.runs]


def _errors(common: _Common, program: str) -> Array:
    """Return the position errors of the common runs of a program, [R, T, 3]."""
    result = common.sequence.results[program]
    places = list(result.meta["state"]["groups"]["position"])
    return np.asarray(result.data["error"][_rows(common, program)][..., places])


def _lost(common: _Common, program: str) -> Flags:
    return np.asarray(common.sequence.results[program].data["lost"][_rows(common, program)])


def _run_losses(common: _Common, program: str) -> Array:
    """Return the losses of the common runs of a program, [R]."""
    result = common.sequence.results[program]
    error = rmse_per_run(_errors(common, program), _lost(common, program))
    keeps = keeps_track(result.data, result.meta)[_rows(common, program)]
    return bound_losses(error, keeps, common.cap)


def _seconds(sequence: SequenceResults) -> float:
    return float(sequence.epochs.time[-1] - sequence.epochs.time[0])


def _name_missing(sequence: SequenceResults, a: str, b: str) -> str:
    """Name the runs of two programs without a common name."""
    names = sequence.run_names
    runs = [", ".join(run or "without a name" for run in names[name][:3]) for name in (a, b)]
    return f"no run has the same name ({a}: {runs[0]}; {b}: {runs[1]})"


def _count_lost(common: list[_Common], a: str, b: str) -> str:
    """Count the lost runs of two programs; empty without any. A lost run is one event, whatever its blocks."""
    total = sum(len(c.runs) for c in common)
    counts = [(name, sum(int(_lost(c, name).sum()) for c in common)) for name in (a, b)]
    lost = [f"{name} is lost in {n} of {format_count(total, 'run')}" for name, n in counts if n]
    return f"{' and '.join(lost)}, and {MIN_RUNS} are required to weigh that" if lost else ""


def remove_nuisance(error: Array, path: Array) -> Array:
    """Remove offset, drift, all that is slower than two blocks, and a turn and a scale of the path.

    Slepian sequences span what is slower, whatever its period and phase: Schuler oscillations of a record of less than
    21 h, too. A yaw error turns the path about the vertical, and the scale of an odometer stretches it.

    Shapes: error [..., T, 3], path [T, 3].
    """
    steps = error.shape[-2]
    cycles = min(BLOCKS / 2, steps / (2 * _LEAST_ROWS))
    slow = dpss(steps, cycles, max(int(2 * cycles) + 1, 1))
    lines = np.column_stack([np.ones(steps), np.linspace(-1.0, 1.0, steps), *slow])
    basis = np.linalg.qr(lines[:, : max(steps // _LEAST_ROWS, min(steps, 2))])[0]
    centred = path - path.mean(0)
    forms = np.stack([centred, centred[:, [1, 0, 2]] * [-1.0, 1.0, 0.0]])
    rest, forms = (a - basis @ (basis.T @ a) for a in (error, forms))
    forms = forms.reshape(2, -1)
    share = np.linalg.norm(forms, axis=1) / max(float(np.linalg.norm(centred)), 1e-300)
    forms = np.linalg.qr(forms[share > 1e-6].T)[0]  # less is rounding
    flat = rest.reshape(*rest.shape[:-2], -1)
    return np.asarray((flat - (flat @ forms) @ forms.T).reshape(rest.shape))
