"""Episodes of several noise regimes as one batch: a filter passes over all of them in one call."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pfbench.config.composition import JobConfig
from pfbench.core.record import Episode, Record
from pfbench.job.filter_pass import TimedFilterPass, pass_filter
from pfbench.job.plan import JobPlan, build_plan
from pfbench.job.tuning.joint_candidates import join_candidates


class RegimeBatch(NamedTuple):
    """Runs of several noise regimes behind one another.

    Attributes:
        regimes: Noise regimes.
        plan: Plan of the first regime. Its filter does not depend on the regime.
        episode: Episode of all runs.
        runs: Numbers of the runs, [K R] for K regimes.
    """

    regimes: tuple[str, ...]
    plan: JobPlan
    episode: Episode
    runs: Tensor

    def pass_filter(self, config: JobConfig) -> TimedFilterPass:
        """Run a filter over all runs.

        Args:
            config: Configuration of the job with the filter.
        """
        plan = replace(self.plan, config=config, method=build_plan(config).method)
        return pass_filter(plan, self.episode, self.runs, "candidate")

    def pass_candidates(self, configs: Sequence[JobConfig]) -> TimedFilterPass:
        """Run several candidates of a filter over all runs in one pass, one candidate behind another.

        Args:
            configs: Configurations that differ in the knobs of the filter.
        """
        methods = [build_plan(config).method for config in configs]
        plan = replace(
            self.plan, config=configs[0], method=join_candidates(methods, len(self.runs))
        )
        return pass_filter(plan, *self.repeat(len(configs)), "candidates")

    def repeat(self, times: int) -> tuple[Episode, Tensor]:
        """Return the episode and the numbers of the runs several times behind one another.

        Args:
            times: Number of times.
        """
        return join_episodes([self.episode] * times), self.runs.repeat(times)

    def list_runs(self) -> Iterator[tuple[str, slice]]:
        """Yield each regime with the places of its runs."""
        size = len(self.runs) // len(self.regimes)
        for k, regime in enumerate(self.regimes):
            yield regime, slice(k * size, (k + 1) * size)


def draw_batches(configs: Mapping[str, JobConfig]) -> list[RegimeBatch]:
    """Draw the episodes of several noise regimes and join them where one filter pass can have all.

    Runs are independent of each other, so that their numbers do not change. Regimes are not joined if
    the model of the filter or the process behind the data depends on the regime.

    Args:
        configs: Configurations of jobs that differ in the noise regime, by regime.

    Returns:
        Batches in the order of the regimes.
    """
    plans = {regime: build_plan(config) for regime, config in configs.items()}
    episodes = {regime: plan.draw_episode(plan.runs) for regime, plan in plans.items()}
    is_own = any(
        plan.values["oracle_noise"] or episodes[regime].record.feedback is not None
        for regime, plan in plans.items()
    )
    groups = [(regime,) for regime in plans] if is_own else [tuple(plans)]
    return [
        RegimeBatch(
            group,
            plans[group[0]],
            join_episodes([episodes[regime] for regime in group]),
            torch.cat([plans[regime].runs for regime in group]),
        )
        for group in groups
    ]


def join_episodes(episodes: Sequence[Episode]) -> Episode:
    """Join episodes of equal times along the axis of runs. Tracks and data sheets are left out.

    Args:
        episodes: Episodes, each of R runs.
    """
    first, records = episodes[0], [episode.record for episode in episodes]
    starts, spreads = ([getattr(r, name) for r in records] for name in ("start", "spread"))
    record = Record(
        torch.cat([r.y for r in records]),
        _join_inputs([r.u for r in records], [len(r.y) for r in records]),
        None if starts[0] is None else torch.cat(starts),
        None if spreads[0] is None else torch.cat(spreads),
        first.record.feedback,
    )
    truth = {name: torch.cat([e.truth[name] for e in episodes]) for name in first.truth}
    notes = tuple(dict.fromkeys(chain.from_iterable(episode.notes for episode in episodes)))
    return Episode(record, first.time, truth, None, notes)


def _join_inputs(inputs: Sequence[Any], sizes: Sequence[int]) -> Any:
    """Join inputs in nested NamedTuples. Inputs that all runs of an episode share are repeated."""
    first = inputs[0]
    if isinstance(first, tuple):
        joined = (_join_inputs(values, sizes) for values in zip(*inputs, strict=True))
        return type(first)(*joined) if first else first
    return torch.cat([a.expand(n, *a.shape[1:]) for a, n in zip(inputs, sizes, strict=True)])
