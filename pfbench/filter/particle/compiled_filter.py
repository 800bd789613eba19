"""A particle filter whose steps run as compiled functions."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from torch import Tensor
from typing_extensions import override

from pfbench.core.random_stream import PhiloxStream, RandomStream
from pfbench.core.record import Record, map_inputs
from pfbench.filter.belief import Filter, GaussianBelief, ParticleBelief, StepInfo
from pfbench.filter.loop import MultiStepFilter
from pfbench.filter.particle.compiled_step import (
    CallCounter,
    CompiledStep,
    compile_step,
    tensors_in,
)
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.filter.particle.proposals import RecordStartedFilter
from pfbench.model.base import StateSpaceModel

log = logging.getLogger("pfbench")


@dataclass(eq=False)
class CompiledParticleFilter(Filter, MultiStepFilter, RecordStartedFilter):
    """Particle filter with compiled steps.

    Random numbers are the same, and results agree to rounding. The first step runs uncompiled,
    because a proposal may start its memory there. The second is recorded and compiled, and small
    steps are taken several at a time. A step with a NaN particle is repeated uncompiled. After it,
    steps are taken one, two, four and so on at a time. If a step cannot be compiled, the filter
    logs a warning and runs uncompiled. Stages must be pure functions, because a compiled step would
    not change a number that a stage stores between steps.

    Attributes:
        method: The filter. With moves, or a proposal that stores paths, it runs uncompiled.
        counter: Counter of likelihood evaluations, which compiled steps cannot increment.
        clock: Clock that measures the time of compilation, s.
        seconds: Time of compilation so far, s.
        graphs: Compiled step by kind of step; None if that kind runs uncompiled.
    """

    method: ParticleFilter
    counter: CallCounter | None = None
    clock: Callable[[], float] = time.perf_counter
    seconds: float = 0.0
    graphs: dict[Any, CompiledStep | None] = field(default_factory=dict)

    @property
    @override
    def is_exact(self) -> bool:
        return self.method.is_exact

    @property
    def has_bounded_weights(self) -> bool:
        """True if the filter states it."""
        return self.method.has_bounded_weights

    @property
    def is_active(self) -> bool:
        """True if a kind of step runs compiled."""
        return any(graph is not None for graph in self.graphs.values())

    @override
    def init(
        self,
        model: StateSpaceModel,
        runs: int,
        draws: RandomStream,
        start: Tensor | None = None,
        spread: Tensor | None = None,
    ) -> ParticleBelief | GaussianBelief:
        return self.method.init(model, runs, draws, start, spread)

    @override
    def init_from_record(
        self, model: StateSpaceModel, record: Record, draws: RandomStream
    ) -> ParticleBelief:
        return self.method.init_from_record(model, record, draws)

    @override
    def step(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> tuple[ParticleBelief, StepInfo]:
        u = map_inputs(lambda a: a.unsqueeze(1), record.u)
        with_time_axis = record._replace(y=record.y.unsqueeze(1), u=u)
        results, _ = self._take_steps(model, belief, with_time_axis, draws, 1)
        return results[0]

    @override
    def take_steps(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        record: Record,
        t: int,
        draws: RandomStream,
        limit: int,
    ) -> tuple[list[tuple[ParticleBelief, StepInfo]], int]:
        rest = record.select_steps(slice(t, None))
        return self._take_steps(model.at_step(t), belief, rest, draws.at_step(t + 1), limit)

    def _take_steps(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        record: Record,
        draws: RandomStream,
        limit: int,
    ) -> tuple[list[tuple[ParticleBelief, StepInfo]], int]:
        """Take several steps of a record. `draws` belongs to the first of them."""
        graph = self._graph(model, belief, record.at_step(0), draws)
        results: list[tuple[ParticleBelief, StepInfo]] = []
        if graph is not None and isinstance(draws, PhiloxStream):
            steps = min(limit, graph.max_steps, record.y.shape[1])
            for after, summary in graph.run_steps(belief, record.select_steps(slice(steps)), draws):
                step_record = partial(record.at_step, len(results))
                results.append((after, self.method.make_info(model, after, summary, step_record)))
            if self.counter:
                self.counter.count += len(results) * graph.evaluations
            if len(results) == steps:
                return results, 2 * steps
            if results:
                belief = results[-1][0]
            draws, limit = draws.at_step(int(draws.step) + len(results)), 1
        results.append(self.method.step(model, belief, record.at_step(len(results)), draws))
        return results, limit

    def _graph(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> CompiledStep | None:
        """Return the compiled step of this kind; None if the step must run uncompiled."""
        grows = self.method.history is not None or self.method.stores_path
        if not isinstance(draws, PhiloxStream) or grows:
            return None
        belief = belief._replace(weights=None)  # a compiled step computes them
        key = id(model), belief.x.shape, len(tensors_in((belief, record)))
        if key not in self.graphs:
            if int(draws.step) == 1:
                return None
            self.graphs[key] = self._compile(model, belief, record, draws)
        return self.graphs[key]

    def _compile(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: PhiloxStream
    ) -> CompiledStep | None:
        """Compile a step; log a warning and return None if that fails."""
        start_time = self.clock()
        try:
            graph = compile_step(self.method, model, belief, record, draws, self.counter)
        except Exception as error:  # torch raises many kinds
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
            log.warning(
                "engine=compiled: this step cannot be compiled (%s). Using compiled kernels only",
                reason,
            )
            log.debug("compilation failed", exc_info=True)
            return None
        elapsed = self.clock() - start_time
        self.seconds += elapsed
        log.info("engine=compiled: the step compiled in %.1f s", elapsed)
        return graph
