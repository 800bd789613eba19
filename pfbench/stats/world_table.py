"""Methods in worlds: each against the reference of its world, all pairs, and ranks over worlds.

A world has one reference, the conventional filter that is best on another seed, so that the choice does not
depend on the runs that are decided. Each table is one family of tests.

References:
    R. L. Iman and J. M. Davenport (1980), Approximations of the critical region of the Friedman statistic.
    J. Demsar (2006), Statistical comparisons of classifiers over multiple data sets.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
import pandas as pd
import scipy  # scipy.stats is imported at its first use

from pfbench.stats.comparison import (
    ALPHA,
    Effect,
    Verdict,
    compare,
    decide,
    find_largest_p,
)
from pfbench.stats.error_measures import Array
from pfbench.stats.rank_tests import holm
from pfbench.stats.study_runs import LEAST_ERROR

TRACK_SHARE = 0.8  # a filter that keeps track in a smaller share of runs loses track [ours]
SHARED_SEEDS = "runs of different worlds have the same random numbers"


class World(NamedTuple):
    """Losses of the filters of a world.

    Attributes:
        name: Name of the world.
        reference: Conventional filter with which all others are compared, fixed before the study.
        kalman_fits: Whether Kalman filters fit the world, by a rule on another seed; None if unknown.
        losses: Losses by run, of each filter; infinite for a lost run.
        keeps_track: Whether track is kept by run, of each filter.
        seed: Seed of the random numbers.
    """

    name: str
    reference: str
    kalman_fits: bool | None
    losses: Mapping[str, pd.Series]
    keeps_track: Mapping[str, pd.Series]
    seed: int


class WorldResult(NamedTuple):
    """A filter in a world.

    Attributes:
        world: Name of the world.
        filter: Label of the filter.
        verdict: Verdict on the filter against the reference of the world.
        track_share: Share of runs that keep track.
        loses_track: Whether it is shown that this share is below 0.8.
    """

    world: str
    filter: str
    verdict: Verdict
    track_share: float
    loses_track: bool


class WorldPair(NamedTuple):
    """A pair of methods in a world."""

    world: str
    verdict: Verdict


class Winner(NamedTuple):
    """Test of a method against all baselines of a world.

    Attributes:
        world: Name of the world.
        filter: Label of the method.
        p: Largest p-value of all baselines and both tests, with Holm's correction.
        wins: Whether it is better than all of them.
    """

    world: str
    filter: str
    p: float
    wins: bool


class MeanRanks(NamedTuple):
    """Mean ranks of methods over worlds, a description.

    Attributes:
        means: Mean rank of each method, 1 for the smallest median loss.
        p: p-value of Friedman's test in the form of Iman and Davenport.
        critical_difference: Difference of mean ranks that Nemenyi's test can show.
        reason: Why there are none; empty otherwise.
        worlds: Number of worlds that have all methods.
    """

    means: Mapping[str, float]
    p: float
    critical_difference: float
    reason: str = ""
    worlds: int = 0


def build_world(rows: pd.DataFrame, reference: str, kalman_fits: bool | None = None) -> World:
    """Build a world from a table.

    Args:
        rows: Columns scenario, filter, run, rmse, keeps_track, lost and seed, of one scenario.
        reference: Filter with which the others are compared.
        kalman_fits: Whether Kalman filters fit the world.

    Raises:
        ValueError: If runs of the reference are missing.
    """
    name, seed = str(rows["scenario"].iloc[0]), int(rows["seed"].iloc[0])
    if reference not in set(rows["filter"]):
        raise ValueError(
            f"{name} must have runs of its reference {reference}, got none. Run filter={reference} in this study."
        )
    losses, tracks = {}, {}
    for label, group in rows.groupby("filter", observed=True, sort=False):
        keeps = group["keeps_track"].to_numpy(dtype=bool) & ~group["lost"].to_numpy(dtype=bool)
        error = np.where(keeps, group["rmse"].to_numpy(dtype=float), np.inf)
        loss = np.log(np.maximum(np.where(np.isnan(error), np.inf, error), LEAST_ERROR))
        losses[str(label)] = pd.Series(loss, index=group["run"].to_numpy())
        tracks[str(label)] = pd.Series(keeps, index=group["run"].to_numpy())
    return World(name, reference, kalman_fits, losses, tracks, seed)


def decide_cells(
    worlds: Sequence[World], filters: Sequence[str], alpha: float = ALPHA
) -> list[WorldResult]:
    """Compare filters with the reference of each world, in one family, and their tracks in another.

    Args:
        worlds: Worlds.
        filters: Filters of the table. The reference and absent filters are left out.
        alpha: Error rate of each of the two families.
    """
    keys = [(w, f) for w in worlds for f in filters if f in w.losses and f != w.reference]
    if not keys:
        return []
    verdicts = decide([_compare(w, f, w.reference) for w, f in keys], alpha=alpha)
    p_track = holm([_track_p(w.keeps_track[f]) for w, f in keys])
    return [
        WorldResult(w.name, f, verdict, float(w.keeps_track[f].mean()), bool(p < alpha))
        for (w, f), verdict, p in zip(keys, verdicts, p_track, strict=True)
    ]


def compare_methods(
    worlds: Sequence[World], methods: Sequence[str], alpha: float = ALPHA
) -> list[WorldPair]:
    """Compare all pairs of methods in all worlds, in one family."""
    keys = [
        (w, a, b) for w in worlds for a, b in combinations(methods, 2) if {a, b} <= set(w.losses)
    ]
    verdicts = decide([_compare(*key) for key in keys], alpha=alpha)
    return [WorldPair(w.name, verdict) for (w, _, _), verdict in zip(keys, verdicts, strict=True)]


def compare_with_each(
    worlds: Sequence[tuple[World, Sequence[tuple[str, str]]]], alpha: float = ALPHA
) -> list[list[Verdict]]:
    """Compare some pairs of filters in each world, in one family.

    Returns the verdicts of each world.
    """
    keys = [(world, *pair) for world, pairs in worlds for pair in pairs]
    verdicts = iter(decide([_compare(*key) for key in keys], alpha=alpha))
    return [[next(verdicts) for _ in pairs] for _, pairs in worlds]


def find_winners(
    worlds: Sequence[World], methods: Sequence[str], baselines: Sequence[str], alpha: float = ALPHA
) -> list[Winner]:
    """Find methods that are better than every baseline of a world, with Holm's correction."""
    keys = [(w, m) for w in worlds for m in methods if m in w.losses]
    largest = [
        find_largest_p([_common(w, m, b) for b in baselines if b in w.losses]) for w, m in keys
    ]
    return [
        Winner(w.name, m, float(p), bool(p < alpha))
        for (w, m), p in zip(keys, holm(largest), strict=True)
    ]


def rank_methods(worlds: Sequence[World], methods: Sequence[str]) -> MeanRanks:
    """Rank methods over the worlds that have all of them; nothing is decided by ranks.

    Worlds that share random numbers are not ranked: Friedman's test then rejects nine of ten true hypotheses.
    """
    shared = [w for w in worlds if set(methods) <= set(w.losses)]
    if len({w.seed for w in shared}) < len(shared):
        return MeanRanks({}, math.nan, math.nan, SHARED_SEEDS)
    if len(shared) < 2 or len(methods) < 3:
        return MeanRanks({}, math.nan, math.nan, "ranks need two worlds and three methods")
    levels = np.array([[w.losses[m].median() for m in methods] for w in shared])
    count, k = levels.shape
    ranks = scipy.stats.rankdata(np.round(levels, 6), axis=1)
    statistic = float(scipy.stats.friedmanchisquare(*np.round(levels, 6).T).statistic)
    f = (count - 1) * statistic / max(count * (k - 1) - statistic, 1e-12)
    p = float(scipy.stats.f.sf(f, k - 1, (k - 1) * (count - 1)))
    studentized = float(scipy.stats.studentized_range.ppf(1 - ALPHA, k, np.inf))
    difference = studentized / math.sqrt(2) * math.sqrt(k * (k + 1) / (6 * count))
    means = dict(zip(methods, map(float, ranks.mean(axis=0)), strict=True))
    return MeanRanks(means, p, difference, worlds=count)


def count_wins(pairs: Sequence[WorldPair], worlds: Sequence[str]) -> Counter[tuple[str, str]]:
    """Count the worlds in which the first method of a pair is better than the second."""
    verdicts = [pair.verdict for pair in pairs if pair.world in worlds]
    return Counter(
        (v.a, v.b) if v.word == "better" else (v.b, v.a)
        for v in verdicts
        if v.word in ("better", "worse")
    )


def _compare(world: World, a: str, b: str) -> Effect:
    """Compare two filters of a world in their common runs."""
    first, second = _common(world, a, b)
    return compare((a, first), (b, second))


def _common(world: World, a: str, b: str) -> tuple[Array, Array]:
    """Return the losses of two filters in their common runs."""
    first, second = world.losses[a], world.losses[b]
    if first.index.is_monotonic_increasing and first.index.equals(second.index):
        return first.to_numpy(), second.to_numpy()  # as below, which takes ten times as long
    runs = first.index.intersection(second.index).sort_values()
    return first.loc[runs].to_numpy(), second.loc[runs].to_numpy()


def _track_p(keeps_track: pd.Series) -> float:
    """Return the p-value of the hypothesis that track is kept in at least 80 % of runs: exact binomial test."""
    return float(scipy.stats.binom.cdf(int(keeps_track.sum()), len(keeps_track), TRACK_SHARE))
