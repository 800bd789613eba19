"""Tuning of the knobs of filters: candidates, joint regimes, seeds that no study scores, and the file."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import chain, product
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import torch
import yaml
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require
from pfbench.core.record import Episode, Record
from pfbench.files.command_start import start_work
from pfbench.filter.belief import GaussianBelief
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter
from pfbench.filter.gaussian.innovation import Innovation, NoiseAdaptation
from pfbench.filter.gaussian.linearisation_rules import AffineApproximation
from pfbench.filter.robust.robust_update import RobustUpdate
from pfbench.filter.robust.updates import ScaledNoise, scale_process_noise
from pfbench.job.config import JobConfig, compose
from pfbench.job.filter_pass import TimedFilterPass, pass_filter
from pfbench.job.plan import JobPlan, build_plan, describe_state
from pfbench.model.base import StateSpaceModel
from pfbench.results.conditions import main_component_group
from pfbench.results.paper_block import (
    PAPER,
    experiments_dir,
    list_named_parts,
    read_paper_block,
)
from pfbench.results.status import is_diverged
from pfbench.results.store import DamagedResultError, read_metadata
from pfbench.stats.error_measures import Array, Flags, mean_per_run, rmse_per_run

_RUNS_AT_ONCE = 400  # of all candidates and regimes in one pass, which bounds its memory
TIE = 0.01  # relative difference of two scores that calibration decides
OBJECTIVE = (
    "mean over regimes of log(median RMSE / median RMSE of the EKF), smallest; within 1 % the candidate whose "
    "NEES divided by its dimension is closest to 1"
)


class RegimeScore(NamedTuple):
    """Score of a filter in a noise regime.

    Attributes:
        error: Median over runs of the RMSE of the main group; a lost run counts as infinite.
        nees_ratio: Median over runs of the mean NEES of the main group, divided by its dimension.
    """

    error: float
    nees_ratio: float


@dataclass(frozen=True)
class Candidate:
    """A candidate with its scores.

    Attributes:
        values: Values by knob.
        log_ratio: Mean over regimes of log(error / error of the EKF in the regime).
        nees_ratio: Geometric mean over regimes of NEES divided by the dimension.
        errors: Error by regime.
    """

    values: dict[str, float]
    log_ratio: float
    nees_ratio: float
    errors: dict[str, float]


@dataclass(frozen=True)
class TuningResult:
    """Result of the search for one filter.

    Attributes:
        method: Name of the filter.
        choice: Candidate of the choice.
        untuned: The filter as its file states it, without a factor on R.
        candidates: All candidates.
        seconds: Computing time of all candidates.
        particles: Number of particles; None for other filters.
    """

    method: str
    choice: Candidate
    untuned: Candidate
    candidates: tuple[Candidate, ...]
    seconds: float
    particles: int | None = None


def choose_candidate(candidates: Sequence[Candidate]) -> Candidate:
    """Choose the candidate of the smallest error; within 1 % the best calibrated one."""
    least = min(c.log_ratio for c in candidates)
    require(
        math.isfinite(least),
        "the candidates",
        "keep half of their runs",
        "none that does",
        "Tune on another scenario or model.",
    )
    near = [c for c in candidates if c.log_ratio <= least + math.log1p(TIE)]
    return min(near, key=lambda c: abs(math.log(c.nees_ratio)))


class CandidateSearch:
    """Search on one world.

    Shapes: start_time_s [s].
    """

    def __init__(
        self,
        words: Sequence[str],
        regimes: Sequence[str],
        progress: Callable[[str], object] = lambda text: None,
        start_time_s: float = 0.0,
    ) -> None:
        self.words, self.regimes, self.progress = tuple(words), tuple(regimes), progress
        self.start_time_s, self.seconds = start_time_s, 0.0
        self.batches = draw_batches({r: self.compose("ekf", r) for r in self.regimes})
        end = float(self.batches[0].episode.time[-1])
        require(
            start_time_s <= end,
            "report.start_time_s",
            f"be at most {end:g} s, the end of the episode",
            f"{start_time_s:g} s",
            "Use a smaller value.",
        )
        start_work()
        (self.reference,) = self._score([self.compose("ekf", self.regimes[0])])

    def tune(self, method: str, grid: Sequence[dict[str, float]]) -> TuningResult:
        """Search the knobs of a filter.

        Returns the result.
        """
        candidates, self.seconds = [], 0.0
        config = self.compose(method, self.regimes[0])
        is_joint = len(config.values["filter"].get("noise_adaptations", ())) == 1  # one adaptation
        size = max(len(batch.runs) for batch in self.batches)
        at_once = max(1, _RUNS_AT_ONCE // size) if is_joint else 1
        for first in range(0, len(grid), at_once):
            some = grid[first : first + at_once]
            self.progress(f"{method}, candidates {first + 1} to {first + len(some)} of {len(grid)}")
            scores = self._score([with_candidate(config, values) for values in some])
            candidates += [self._rate(*pair) for pair in zip(some, scores, strict=True)]
        choice, seconds = choose_candidate(candidates), self.seconds
        untuned = self.score_method(method)
        particles = config.values["filter"].get("particles")
        return TuningResult(method, choice, untuned, tuple(candidates), seconds, particles)

    def _rate(self, values: dict[str, float], scores: Mapping[str, RegimeScore]) -> Candidate:
        """Rate a candidate by its scores in all regimes."""
        logs = [math.log(s.error / self.reference[r].error) for r, s in scores.items()]
        ratios = [math.log(s.nees_ratio) for s in scores.values()]
        return Candidate(
            values,
            float(np.mean(logs)),
            math.exp(float(np.mean(ratios))),
            {regime: s.error for regime, s in scores.items()},
        )

    def score_method(
        self, method: str, values: Mapping[str, float] = MappingProxyType({})
    ) -> Candidate:
        """Run a filter in all regimes, without knobs or with those of a candidate."""
        config = self.compose(method, self.regimes[0])
        return self._rate(dict(values), *self._score([with_candidate(config, values)]))

    def pass_alone(self, config: JobConfig, threshold: float = math.inf) -> Array:
        """Run a filter in one regime and return the RMSE of each run [R], infinite for a lost or diverged run."""
        (batch,) = draw_batches({config.choices["noise"]: config})
        result = batch.pass_filter(config)
        data = result.arrays(batch.episode, None)
        error, lost = select_errors(data, result.model, slice(None), self.start_time_s)
        return rmse_per_run(error, lost | is_diverged(error, lost, threshold))

    def compose(self, method: str, regime: str, words: Sequence[str] = ()) -> JobConfig:
        """Compose the configuration of a filter."""
        return compose([*self.words, f"filter={method}", f"noise={regime}", *words])

    def _score(self, configs: Sequence[JobConfig]) -> list[dict[str, RegimeScore]]:
        """Run filters in all regimes and compute the scores of each by regime."""
        scores: list[dict[str, RegimeScore]] = [{} for _ in configs]
        for batch in self.batches:
            is_alone = len(configs) == 1
            result = batch.pass_filter(configs[0]) if is_alone else batch.pass_candidates(configs)
            self.seconds += sum(result.seconds.get(name, 0.0) for name in ("scores", "filter"))
            data = result.arrays(batch.episode, None)
            for k, by_regime in enumerate(scores):
                for regime, runs in batch.list_runs():
                    start = k * len(batch.runs)
                    places = slice(start + runs.start, start + runs.stop)
                    by_regime[regime] = score_runs(data, result.model, places, self.start_time_s)
        return scores


def with_candidate(config: JobConfig, values: Mapping[str, float]) -> JobConfig:
    """Return a configuration with the knobs of a candidate."""
    if not values:
        return config
    changed = copy.deepcopy(config.values)
    changed["filter"] |= apply_candidate(changed["filter"], values)
    return JobConfig(changed, config.choices, config.uses_shared_particles, config.trusted)


def score_runs(
    data: Mapping[str, np.ndarray], model: StateSpaceModel, runs: slice, start_time_s: float = 0.0
) -> RegimeScore:
    """Compute the score of some runs.

    Shapes: start_time_s [s].
    """
    state = describe_state(model)
    group, steps = main_component_group(state), data["time"] >= start_time_s
    error, lost = select_errors(data, model, runs, start_time_s)
    number = list(state["groups"]).index(group.state_group)
    nees = mean_per_run(data["nees"][runs][:, steps, number].astype(float), lost)
    size = len(state["groups"][group.state_group])
    return RegimeScore(
        float(np.median(rmse_per_run(error, lost))), float(np.nanmedian(nees)) / size
    )


def select_errors(
    data: Mapping[str, np.ndarray], model: StateSpaceModel, runs: slice, start_time_s: float
) -> tuple[Array, Flags]:
    """Select the errors of the main group in displayed units [R, T, K], and the lost runs [R].

    Shapes: start_time_s [s].
    """
    group, steps = main_component_group(describe_state(model)), data["time"] >= start_time_s
    error = data["error"][runs][:, steps][..., group.places].astype(float) * group.scale
    return error, np.asarray(data["lost"][runs], dtype=bool)


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
        """Run a filter over all runs."""
        plan = replace(self.plan, config=config, method=build_plan(config).method)
        return pass_filter(plan, self.episode, self.runs, "candidate")

    def pass_candidates(self, configs: Sequence[JobConfig]) -> TimedFilterPass:
        """Run several candidates of a filter over all runs in one pass, one candidate behind another."""
        joined = join_candidates([build_plan(c).method for c in configs], len(self.runs))
        plan, count = replace(self.plan, config=configs[0], method=joined), len(configs)
        episode = join_episodes([self.episode] * count)
        return pass_filter(plan, episode, self.runs.repeat(count), "candidates")

    def list_runs(self) -> Iterator[tuple[str, slice]]:
        """Yield each regime with the places of its runs."""
        size = len(self.runs) // len(self.regimes)
        for k, regime in enumerate(self.regimes):
            yield regime, slice(k * size, (k + 1) * size)


def draw_batches(configs: Mapping[str, JobConfig]) -> list[RegimeBatch]:
    """Draw the episodes of several noise regimes and join them where one filter pass can have all.

    Runs are independent of each other, so that their numbers do not change. Regimes are not joined if
    the model of the filter or the process behind the data depends on the regime.
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
    """Join episodes of equal times along the axis of runs. Tracks and data sheets are left out."""
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


# --------------------------------------------------------------------------------------------------
# Candidates of one filter side by side: each has its own runs of one batch, which one pass filters.

_CHANGED = ("r", "observed_mask", "m", "omega", "noise")  # fields that an adaptation of R replaces


@dataclass(frozen=True, eq=False)
class JointAdaptation(NoiseAdaptation):
    """The noise adaptations of several candidates, each for its own runs.

    A linearisation costs the same for all of them, so that 16 candidates take the time of a few.

    Attributes:
        r_factor: Factor on R of each run, [R].
        q_factor: Factor on Q of each run, [R].
        updates: Distinct robust updates, each with the places of its runs.
    """

    r_factor: Tensor
    q_factor: Tensor
    updates: tuple[tuple[NoiseAdaptation, Tensor], ...]

    @override
    def predict_scale(
        self, predicted: AffineApproximation, belief: GaussianBelief
    ) -> AffineApproximation:
        scaled = scale_process_noise(predicted, self.q_factor.to(predicted.noise))
        if all(isinstance(update, RobustUpdate) for update, _ in self.updates):
            return scaled  # which they do not change
        parts = [
            update.predict_scale(_select(scaled, places), _select(belief, places))
            for update, places in self.updates
        ]
        return AffineApproximation(*(self._join(fields) for fields in zip(*parts, strict=True)))

    @override
    def noise_adapt(
        self, innovation: Innovation, belief: GaussianBelief
    ) -> tuple[Innovation, dict[str, Tensor]]:
        scaled = innovation.with_noise(
            innovation.noise * self.r_factor.to(innovation.noise)[:, None, None]
        )
        if not self.updates:
            return scaled, {}
        innovations, memories = zip(
            *(
                update.noise_adapt(_select(scaled, places), _select(belief, places))
                for update, places in self.updates
            ),
            strict=True,
        )
        r, observed_mask, m, omega, noise = (
            self._join([getattr(several, name) for several in innovations]) for name in _CHANGED
        )
        memory = {name: self._join([several[name] for several in memories]) for name in memories[0]}
        adapted = scaled._replace(r=r, observed_mask=observed_mask, m=m, omega=omega, noise=noise)
        return adapted, memory

    def _join(self, parts: Sequence[Tensor]) -> Tensor:
        """Join the values of the runs of all updates in the order of the runs."""
        return torch.cat(list(parts))[torch.cat([places for _, places in self.updates]).argsort()]


def join_candidates(filters: Sequence[GaussianFilter], runs: int) -> GaussianFilter:
    """Return the filter in which each candidate has its own runs."""
    chains = [list(method.noise_adaptations) for method in filters]
    factors = [[getattr(chain[0], name) for chain in chains] for name in ("r_factor", "q_factor")]
    assert all(isinstance(chain[0], ScaledNoise) for chain in chains)
    r_factor, q_factor = (
        torch.tensor(values, dtype=torch.float64).repeat_interleave(runs) for values in factors
    )
    places: dict[NoiseAdaptation, list[Tensor]] = {}
    for k, stages in enumerate(chains):
        for update in stages[1:]:
            places.setdefault(update, []).append(torch.arange(k * runs, (k + 1) * runs))
    updates = tuple((update, torch.cat(several)) for update, several in places.items())
    return replace(filters[0], noise_adaptations=(JointAdaptation(r_factor, q_factor, updates),))


def _select(parts: Any, places: Tensor) -> Any:
    """Return an innovation or a belief of some runs; values that all runs share stay."""
    runs = len(parts[0])

    def select(value: Any) -> Any:
        if isinstance(value, dict):
            return {name: select(entry) for name, entry in value.items()}
        if isinstance(value, tuple):
            return tuple(map(select, value))
        return value[places] if value.dim() and len(value) == runs else value

    return type(parts)(*map(select, parts))


R_FACTORS = (1.0, 2.0, 4.0, 8.0)
_SCALED, _POWER = "pfbench.filter.ScaledNoise", "pfbench.filter.PowerLikelihoodUpdate"


# Knob of a method, as its file states it: the key of the parameter in the settings of the filter, and the values to try.
# Each method has the same number of values, so that each has the same number of candidates.
KNOBS: Mapping[str, tuple[str, tuple[float, ...]]] = {
    method: (block["knob"]["key"], tuple(block["knob"]["values"]))
    for method in list_named_parts("filter")
    if "knob" in (block := read_paper_block("filter", method))
}


def list_candidates(method: str, r_factors: Sequence[float] = R_FACTORS) -> list[dict[str, float]]:
    """List the candidates of a method.

    Returns values by knob, `r_factor` first.
    """
    require(
        method in KNOBS,
        "filter",
        f"be of {', '.join(KNOBS)}",
        method,
        "Only these state a knob in their file.",
    )
    key, values = KNOBS[method]
    name = key.rpartition(".")[2]
    return [{"r_factor": r, name: v} for r, v in product(r_factors, values)]


def apply_candidate(node: Mapping[str, Any], values: Mapping[str, float]) -> dict[str, Any]:
    """Set the knobs in the settings of a filter.

    The factor on R is a scaled noise before the other adaptations of a Gaussian filter, or of the filter that guides
    particles. Other particle filters have a power of the likelihood.

    Returns the settings.
    """
    changed: Any = copy.deepcopy(dict(node))
    *path, name = changed[PAPER]["knob"]["key"].split(".")
    settings = reduce(lambda node, key: node[int(key) if key.isdigit() else key], path, changed)
    settings[name] = values[name]
    guided = changed.get("proposal", {}).get("guide_filter", changed)
    if "noise_adaptations" not in guided:
        return changed | {"weight_update": {"_target_": _POWER, "r_factor": values["r_factor"]}}
    guided["noise_adaptations"] = [
        {
            "_target_": _SCALED,
            "r_factor": values["r_factor"],
            "q_factor": values.get("q_factor", 1.0),
        },
        *(stage for stage in guided["noise_adaptations"] if stage["_target_"] != _SCALED),
    ]
    return changed


# --------------------------------------------------------------------------------------------------
# Check that no study scores the seed of a tuning: installed experiments, and stored results.

_TUNING = "tuning_"  # start of the names of folders with results of a tuning
_SCENARIO = "override /scenario"  # of the defaults of an experiment
_DEFAULT_SEED = 1


def check_seed(world: JobConfig, seed: int) -> None:
    """Check that no study scores a seed in the scenario of a tuning.

    Runs of another window of a recording have other data, so that settings of the scenario are compared
    where they are stored.
    """
    require(seed >= 0, "seed", "be at least -1000", seed - 1000, "Set seed to that of the study.")
    scenario = world.choices["scenario"]
    scored = (*_list_experiments(scenario, seed), *_list_results(world, seed))
    for study in scored:
        raise ValueError(
            f"seed + 1000 must be a seed that no study scores in {scenario}, got {seed}, which {study} scores. "
            "Set another seed."
        )


def _list_experiments(scenario: str, seed: int) -> Iterator[str]:
    """Yield the experiments with a scenario and a seed."""
    for path in sorted(experiments_dir().glob("*.yaml")):
        tree = yaml.safe_load(path.read_text(encoding="utf-8"))
        sweep = tree.get("hydra", {}).get("sweeper", {}).get("params", {})
        choices = [entry for entry in tree.get("defaults", ()) if isinstance(entry, Mapping)]
        single = ",".join(entry[_SCENARIO] for entry in choices if _SCENARIO in entry)
        scenarios = str(sweep.get("scenario", single)).split(",")
        seeds = str(sweep.get("seed", tree.get("seed", _DEFAULT_SEED))).split(",")
        if scenario in scenarios and str(seed) in seeds:
            yield path.stem


def _list_results(world: JobConfig, seed: int) -> Iterator[str]:
    """Yield the studies with a stored result of a scenario with its settings and a seed."""
    for path in sorted(Path(world.values["results_dir"]).glob("*/*.npz")):
        if path.parent.name.startswith(_TUNING):
            continue
        try:
            config = read_metadata(path)["config"]
        except (DamagedResultError, KeyError):
            continue
        if config.get("seed") == seed and config.get("scenario") == world.values["scenario"]:
            yield path.parent.name
