"""A bootstrap filter whose steps are taken by C++, with the model as a tape."""

from __future__ import annotations

import logging
import math
import zlib
from dataclasses import dataclass, field
from typing import Any, cast
from weakref import WeakSet

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.random_stream import PhiloxStream, RandomStream
from pfbench.core.record import Record, is_constant
from pfbench.filter.belief import (
    ComputedWeights,
    KeptSteps,
    ParticleBelief,
    StepBlock,
    exponentiate,
)
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.filter.particle.stages import (
    BayesWeightUpdate,
    BootstrapProposal,
    EssResampler,
    FixedCount,
    PosteriorWeights,
    Systematic,
    has_standard_noise,
)
from pfbench.filter.particle.taken_steps import (
    MAX_NUMBERS,
    ONE_AT_A_TIME,
    TakenSteps,
    WholeStepFilter,
    keep_count,
)
from pfbench.filter.particle.tape import FEW, NoTapeError, Tape, list_inputs, record_tape
from pfbench.kernels import dispatch
from pfbench.kernels.step_compiler import to_storage
from pfbench.model.base import StateSpaceModel

log = logging.getLogger("pfbench")
_FEW = slice(0, FEW)
_PASSES = 64  # that are remembered; one that was not finished is forgotten after as many others
_MORE_UNKEPT = (
    8  # times as many steps where particles of few steps are returned: 0.1 s without a sign
)


def find_obstacle(method: Any, model: StateSpaceModel) -> str:
    """Return why C++ cannot take the steps of a filter with the model as a tape; empty if it may."""
    if type(method) is not ParticleFilter or method.moves:
        return "it is no filter of these stages"
    stages: dict[type, object] = {
        EssResampler: method.resampler,
        Systematic: getattr(method.resampler, "scheme", None),
        FixedCount: method.particle_count,
        PosteriorWeights: method.auxiliary_weights,
        BootstrapProposal: method.proposal,
        BayesWeightUpdate: method.weight_update,
        type(None): method.initial_proposal,
    }
    for kind, stage in stages.items():
        if type(stage) is not kind:
            return f"it has {type(stage).__name__} in place of {kind.__name__}"
    if not model.chart.flat or not has_standard_noise(model):
        return "states have angles or rotations, or noise is not standard normal"
    is_double = model.anchor.dtype == torch.float64 and not model.anchor.is_cuda
    return "" if is_double else "its numbers are not of double precision on the CPU"


@dataclass(eq=False)
class TapedParticleFilter(WholeStepFilter):
    """Bootstrap filter whose steps are taken by one C++ call, with the model as a tape.

    Random numbers, ancestors and the treatment of lost runs and NaN particles are those of the operators, and results agree to
    rounding. A tape is recorded at the start of each pass, and no longer used after it, so that it has the present constants of the
    model. Without one the filter takes its steps by the operators, and a line of the log says why.

    Attributes:
        is_active: Whether a pass had a tape.
        seconds: Time of compilation, s: none.
    """

    is_exact = WholeStepFilter.is_exact  # a class that changes steps states them itself
    has_bounded_weights = WholeStepFilter.has_bounded_weights
    is_active: bool = False
    seconds: float = 0.0
    # by model and record, which live as long: their tape, and evaluations of the measurement distribution per particle and step
    _passes: dict[tuple[int, int], tuple[Tape, int, Any]] = field(default_factory=dict)
    _refused: WeakSet[StateSpaceModel] = field(default_factory=WeakSet)

    @override
    def take_steps(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        record: Record,
        t: int,
        draws: RandomStream,
        limit: int,
        selection: KeptSteps,
    ) -> tuple[StepBlock, ParticleBelief, int]:
        stream, key, remaining = (
            draws.at_step(t + 1),
            (id(model), id(record)),
            record.y.shape[1] - t,
        )
        with ONE_AT_A_TIME:
            if t == 0 or key not in self._passes:
                self._record(model, belief, record, t, stream)
            current = self._passes.get(key)
            if current is None or model.at_step(t) is not model:
                belief, info = self.method.step(model.at_step(t), belief, record.at_step(t), stream)
                return StepBlock.of_step(t, belief, info), belief, limit
        most = (1 if selection.all_steps else _MORE_UNKEPT) * MAX_NUMBERS
        steps = min(max(1, most // (belief.x.numel() + 3 * belief.log_w.numel())), remaining)
        block_record = record.select_steps(slice(t, t + steps))
        (tape, evaluations, _), rows = current, selection.select_rows(t, steps)
        threshold = cast(EssResampler, self.method.resampler).ess_threshold
        block = _run(tape, threshold, belief, block_record, stream, rows)
        self.count(steps * evaluations * belief.log_w.numel())
        if steps == remaining:
            self._passes.pop(key)
        return block.make_block(self.method, model, block_record, t, selection), block.last, limit

    def _record(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, t: int, draws: Any
    ) -> None:
        """Record the model for a pass and compare what the tape computes with what torch computed; log once why there is none."""
        if model in self._refused:
            return
        try:
            if type(draws) is not PhiloxStream or draws.dtype != torch.float64 or belief.memory:
                raise NoTapeError("its random numbers or its particles are not those of a tape")
            reason = None if is_constant(model, record, t + 1) else "its model changes by step"
            if reason := reason or find_obstacle(self.method, model):
                raise NoTapeError(reason)
            stream, x = draws.select_runs(_FEW), to_storage(belief.x[_FEW, _FEW]).permute(1, 2, 0)
            short = record.select_runs(_FEW).select_steps(slice(t, t + 1))
            w = stream.normal("noise", FEW, model.noise_dim)
            with keep_count(self.counter) as evaluations:
                tape, *expected = record_tape(model, x.clone(), w, short.at_step(0))
                evaluations_each = evaluations() // (len(x) * FEW)
            _check_tape(tape, x, short, stream, *expected)
        except Exception as error:  # NoTapeError, or of a model that takes batches of one size only
            self._refused.add(model)
            kind = "" if isinstance(error, NoTapeError) else f"{type(error).__name__}: "
            log.info(
                "C++ operators, step by step: no tape of the model (%s)",
                f"{kind}{error}".splitlines()[0],
            )
            return
        while len(self._passes) >= _PASSES:
            self._passes.pop(next(iter(self._passes)))
        self.is_active = True
        self._passes[id(model), id(record)] = tape, evaluations_each, (model, record)


def _run(
    tape: Tape, threshold: float, belief: ParticleBelief, record: Record, draws: Any, rows: list[int]
) -> TakenSteps:  # fmt: skip
    """Take all steps of a record. `draws` belongs to the first of them, and `rows` are those whose particles are returned."""
    steps = record.y.shape[1]
    returned = rows if steps - 1 in rows else [*rows, steps - 1]
    *leaves, y = [
        a.transpose(0, 1).expand(steps, -1, *a.shape[2:]).reshape(steps, len(a), -1).double()
        for a in list_inputs(record)
    ]
    shared = [y[:, :1, :0], *(a for a in leaves if a.shape[1] == 1)]
    separate = [*(a for a in leaves if a.shape[1] > 1), y]
    sizes = [*tape[3:], int(draws.step), int(draws.seed), *map(zlib.crc32, (b"resample", b"noise"))]
    weights = belief.log_w, exponentiate(belief.log_w, belief.weights)
    cloud = to_storage(belief.x), *weights, draws.runs, torch.tensor(returned)
    limits = torch.tensor([threshold], dtype=torch.float64), torch.tensor(sizes)
    inputs = torch.cat(shared, -1), torch.cat(separate, -1)
    results = dispatch.run_tape([*tape[:3], *inputs, *cloud, *limits])
    mean, variance, total, ess, resampled, ancestors = (a.transpose(0, 1) for a in results[:6])
    log_evidence = belief.log_evidence.unsqueeze(1) + total.cumsum(1)
    clouds = {}
    for k, x, log_w, w, prior in zip(returned, *(a.unbind() for a in results[6:]), strict=True):
        after = ParticleBelief(x.permute(1, 2, 0), log_w, log_evidence[:, k])
        clouds[k] = after._replace(weights=ComputedWeights(log_w, w)), prior
    trace = {"resampled": resampled, "ancestors": ancestors, "ess": ess}
    selected, last = {k: clouds[k] for k in rows}, clouds[steps - 1][0]
    return TakenSteps(mean, variance, log_evidence, trace, selected, last)


def _check_tape(
    tape: Tape, x: Tensor, record: Record, draws: Any, states: Tensor, value: Tensor
) -> None:
    """Raise an error unless a tape computes the finite states and log likelihoods that torch computed, with the same noise.

    Shapes: x [R, N, D], record [R, 1, Dy], states [R, N, D], value [R, N].
    """
    log_w = torch.full_like(value, -math.log(FEW))
    before = ParticleBelief(x, log_w, value.new_zeros(len(x)))
    block = _run(tape, 0.0, before, record, draws, [0])  # a threshold of 0 keeps all particles
    finite = torch.isfinite(states).all(-1)
    updated = torch.where(finite & ~torch.isnan(value), value + log_w, -torch.inf)
    weighed = torch.isfinite(updated.logsumexp(1))
    computed = (
        block.last.x[finite].flatten(),
        (block.last.log_w + block.log_evidence)[weighed].flatten(),
    )
    expected = states[finite].flatten(), updated[weighed].flatten()
    if not torch.allclose(torch.cat(computed), torch.cat(expected), rtol=1e-9, atol=1e-12):
        raise NoTapeError("the tape does not compute the numbers of torch")
