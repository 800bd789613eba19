"""Points: what a stage draws from. Plain Monte Carlo, or a low-discrepancy set under a fresh random shift at each draw.

A shifted point is uniform by itself, so that averages over points are unbiased and their spread over runs is an honest error;
only together are the points more even than chance. The base set is the same always, and cached; the shift comes from the
counter-based stream, so a run's points depend on (seed, run, step, purpose) alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Protocol

import numpy as np
import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from pfbench.draws import Draws, MonteCarlo
from pfbench.filter.derived_draws import Derived

_EDGE = 1e-9  # a shifted point may fall on 0, whose normal is infinite
_BITS = 30  # of a point of torch's Sobol engine


class Points(Protocol):
    """Draws -> the same draws, but n points in w dimensions at a time that are more even than chance."""

    def __call__(self, draws: Draws, first: int = 0) -> Draws:
        """Points that leave out the first axes of their set.

        Two stages that draw n points each, one from the axes up to `first` and one from those behind it, draw together the
        points of one set: both would otherwise take the same axes, and what they draw would be dependent.
        """


@dataclass(frozen=True)
class Independent:
    """Plain Monte Carlo."""

    def __call__(self, draws: Draws, first: int = 0) -> Draws:
        return draws


@dataclass(frozen=True)
class Halton:
    """Radical inverses in the first prime bases [Halton 1960], shifted modulo 1 [Cranley and Patterson 1976].

    Args:
        skip: points left out at the beginning.
        permuted: the digits of each base are permuted, once and for all [Owen 2017]; else neighbouring axes of large base rise
            and fall together: of 400 points in 21 axes some are correlated by 0.27 on average over shifts, by chance it would be
            0.05. With six axes it hardly matters. [ours]

    Raises:
        ValueError: a negative number of points to skip.
    """

    skip: int = 20
    permuted: bool = True

    def __post_init__(self) -> None:
        if self.skip < 0:
            raise ValueError(f"points.skip={self.skip}: give the number of points to leave out, 0 or more")

    def __call__(self, draws: Draws, first: int = 0) -> Draws:
        return _of_set(self, draws, first)

    def shifted(self, axes: range, n: int, shift: Tensor) -> Tensor:
        base = halton(self.skip, n, axes, self.permuted).to(shift.device)
        return ((base.unsqueeze(1) + shift) % 1.0).clamp(_EDGE, 1.0 - _EDGE)


@dataclass(frozen=True)
class Sobol:
    """Sobol's points with the direction numbers of Joe and Kuo, shifted digit by digit: still a net after the shift."""

    def __call__(self, draws: Draws, first: int = 0) -> Draws:
        return _of_set(self, draws, first)

    def shifted(self, axes: range, n: int, shift: Tensor) -> Tensor:
        digits = sobol_digits(n, axes).to(shift.device).unsqueeze(1)
        return ((digits ^ (shift * 2.0**_BITS).long()).double() + 0.5) * 2.0**-_BITS


class _Set(Protocol):
    def shifted(self, axes: range, n: int, shift: Tensor) -> Tensor:
        """Points 0..n-1 on these axes under a uniform shift [w, R, 1], each on the open interval (0, 1): [w, R, n]."""


def _of_set(points: _Set, draws: Draws, first: int) -> Draws:
    """Draws of a set's points: a new shift for each run, step, purpose and axis."""

    def uniforms(draws: Draws, purpose: str, n: int, w: int) -> Tensor:
        shift = draws.uniform(purpose, 1, w).permute(2, 0, 1)
        return points.shifted(range(first, first + w), n, shift).permute(1, 2, 0)

    return Derived(draws, uniforms)


@cache
def halton(skip: int, n: int, axes: range, permuted: bool = False) -> Tensor:
    """Halton's points number skip + 1 to skip + n, without shift [w, n]; the first in base 2 are 1/2, 1/4, 3/4, 1/8."""
    bases = primes(axes.stop)
    return torch.stack([_radical_inverse(skip + 1, n, bases[a], permuted) for a in axes])


def _radical_inverse(start: int, n: int, base: int, permuted: bool) -> Tensor:
    """Digits of the numbers start, start + 1, ... in a base, mirrored at the point [n]."""
    number = torch.arange(start, start + n)
    value, place, digit = torch.zeros(n, dtype=torch.float64), 1.0, 0
    while bool((number > 0).any()):
        digits, place = number % base, place / base
        if permuted:  # from a stream of its own: the same for all seeds, and on every machine
            order = MonteCarlo(0, torch.tensor([base])).at(digit).uniform("points.digits", base, 1)
            digits = order[0, :, 0].argsort()[digits]
        value, number, digit = value + place * digits.double(), number // base, digit + 1
    return value


@cache
def sobol_digits(n: int, axes: range) -> Tensor:
    """Sobol's points without shift, times 2^30: int64 [w, n]."""
    drawn = SobolEngine(axes.stop).draw(n, dtype=torch.float64)
    return (drawn * 2.0**_BITS).long().T[axes.start :].contiguous()


def primes(count: int) -> list[int]:
    """The first prime numbers."""
    limit = max(20, int(count * (np.log(count + 2) + np.log(np.log(count + 2) + 1) + 1)) + 10)
    candidates = range(2, limit)
    found = [p for p in candidates if all(p % q for q in range(2, int(p**0.5) + 1))]
    return found[:count]
