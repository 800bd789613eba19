"""Laws of an own part: the checks of `pfbench.testing` that fit it, as rows of a table."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from types import FrameType
from typing import TYPE_CHECKING, Any, NamedTuple

import torch

from pfbench import testing
from pfbench.cli.messages import format_error
from pfbench.core import Episode, PhiloxStream
from pfbench.core.parameter_checks import require
from pfbench.core.record import map_inputs
from pfbench.door.own_parts import find_group
from pfbench.door.parts import Part, format_html_table, get_part, place_words, plain_errors
from pfbench.filter import EssResampler, ParticleFilter, run_filter
from pfbench.job import instantiate
from pfbench.job.config import compose
from pfbench.noise import NominalNoise
from pfbench.scenario import ModelSimulation
from pfbench.testing import LawCheck
from pfbench.testing.results import check_is_model

if TYPE_CHECKING:
    import pandas as pd

_HEADS = ("law", "holds", "statistic", "limit", "message")


class LawRow(NamedTuple):
    """One law: its statement, whether it holds, the statistic with its limit, and what to do if it does not hold."""

    statement: str
    holds: bool
    statistic: float | None = None
    limit: float | None = None
    message: str = ""


@dataclass(frozen=True, repr=False)
class LawTable:
    """Laws of a part.

    Attributes:
        rows: Laws, each with its result.
    """

    rows: tuple[LawRow, ...]

    @property
    def passed(self) -> bool:
        """True if all laws hold."""
        return all(row.holds for row in self.rows)

    def table(self) -> pd.DataFrame:
        """Return a table, a row per law."""
        import pandas as pd

        return pd.DataFrame(self.rows, columns=list(_HEADS))

    def __repr__(self) -> str:
        return "\n".join(
            f"{'holds ' if row.holds else 'FAILS '} {row.statement}{_numbers(row)}{f': {row.message}' if row.message else ''}"
            for row in self.rows
        )

    def _repr_html_(self) -> str:
        texts = [
            (r.statement, "yes" if r.holds else "no", _numbers(r).strip(), r.message)
            for r in self.rows
        ]
        return format_html_table(("law", "holds", "numbers", "message"), texts)


def _numbers(row: LawRow) -> str:
    """Format the statistic and its limit."""
    return "" if row.statistic is None else f" ({row.statistic:.3g}, limit {row.limit:.3g})"


def check_laws(thing: Any, runs: int = 200, inputs: Any = (), scenario: Any = None) -> LawTable:
    """Check the laws that fit a part. A law that does not hold is a row and no error.

    `pfbench.run` tries an own part by the same contract before any job starts, with two runs and without the statistical laws.

    Args:
        thing: Part, object or class of your own: filter, stage, model, scenario or noise regime.
        runs: Number of runs of the statistical checks of a filter.
        inputs: Inputs of a model that reads some: its NamedTuple of tensors with the axes [1, T, ...] of all runs and steps.
        scenario: Name, part or object of a scenario, with whose channels and times a noise regime is checked, too.

    Returns:
        The laws with their results.

    Raises:
        ValueError: If the object is none of these, or inputs are given to another part than a model.
    """
    with plain_errors():
        subject, group, stage = _build(thing)
        choice = get_part("scenario", scenario) if isinstance(scenario, str) else scenario
        world = None if choice is None else _build(choice)[0]
    for name, is_set, owner in (
        ("inputs", inputs != (), "model"),
        ("scenario", choice is not None, "noise"),
    ):
        require(
            not is_set or group == owner,
            name,
            f"be given for a {owner} only",
            f"some for a {group}",
            "Leave it out.",
        )
    checks: Mapping[str, Callable[[], Mapping[str, LawCheck]]] = {
        "model": lambda: _check_model(subject, inputs),
        "scenario": lambda: testing.check_scenario(subject),
        "noise": lambda: testing.check_regime(subject, scenario=world),
    }
    try:
        with _stated_files(subject):
            results = checks[group]() if group in checks else _check_filter(subject, stage, runs)
    except AssertionError as error:
        statement, _, message = f"{error}".partition(": ")
        return LawTable((LawRow(statement, False, message=message or statement),))
    except Exception as error:
        return LawTable((LawRow("the part runs", False, message=format_error(error)),))
    return LawTable(
        tuple(LawRow(c.statement, True, c.statistic, c.limit) for c in results.values())
    )


_LIBRARIES = (sys.prefix, sys.base_prefix)
_watched: list[
    tuple[str, set[str]]
] = []  # modules of parts that are checked, and files that their code opens


@cache
def _start_watching() -> None:
    """Note the files that the code of checked parts opens. Python keeps such a hook until its end."""

    def note(event: str, values: tuple[Any, ...]) -> None:
        if event != "open" or not _watched or not isinstance(values[0], str):
            return
        frame: FrameType | None = sys._getframe(1)
        # who asked the library; an import is frozen code, and an installed pfbench asks for itself
        while (
            frame is not None
            and frame.f_code.co_filename.startswith(_LIBRARIES)
            and not str(frame.f_globals.get("__name__")).startswith("pfbench.")
        ):
            frame = frame.f_back
        if frame is not None and frame.f_globals.get("__name__") == _watched[-1][0]:
            _watched[-1][1].add(os.path.realpath(values[0]))

    sys.addaudithook(note)


@contextmanager
def _stated_files(subject: Any) -> Iterator[None]:
    """Check that a part states the files that its module opens meanwhile, since a job is known by what it states."""
    _start_watching()
    _watched.append((type(subject).__module__, set()))
    try:
        yield
    finally:
        _, opened = _watched.pop()
    stated = subject.input_files() if hasattr(subject, "input_files") else ()
    hidden = sorted(opened - set(map(os.path.realpath, stated)))
    assert not hidden, (
        f"files that it reads are stated: {type(subject).__name__} opens {', '.join(hidden)}. Return their paths from a method "
        "input_files(self), so that a changed file is a new job"
    )


def _build(thing: Any) -> tuple[Any, str, str]:
    """Return the object of a part or a class, its group, and its stage."""
    if isinstance(thing, Part):
        config = compose([*thing.words(), *place_words([thing])])
        return instantiate(config.values[thing.group], config.trusted), thing.group, ""
    group, stage = find_group(thing)
    return thing() if isinstance(thing, type) else thing, group, stage


def _check_filter(subject: Any, stage: str, runs: int) -> Mapping[str, LawCheck]:
    """Check a filter, or a stage by its own law and as a part of a filter."""
    if not stage:
        return testing.check_filter(subject, runs)
    alone: Mapping[str, Callable[[Any], LawCheck]] = {
        "proposal": testing.check_proposal,
        "moves": testing.check_move,
        "resampler": testing.check_resampling,
        "scheme": testing.check_resampling,
    }
    results = {stage: alone[stage](subject)} if stage in alone else {}
    value = (subject,) if stage == "moves" else subject
    changes = {"resampler": EssResampler(subject)} if stage == "scheme" else {stage: value}
    method = replace(ParticleFilter(100), **changes)
    return {**results, **testing.check_filter(method, runs)}


@dataclass(frozen=True)
class _GivenInputs(ModelSimulation):
    """Simulation of a model with inputs that are given."""

    inputs: Any = ()

    def make_inputs(self, time: torch.Tensor) -> Any:
        """Return the inputs."""
        return self.inputs


def _find_turns(a: torch.Tensor) -> torch.Tensor:
    """Return where numbers [R, T, k] jump by a turn while their usual step is small, [R, T - 1, k]."""
    steps = a.diff(dim=1).abs()
    usual = steps.nanmedian(dim=1, keepdim=True).values
    return ((steps - math.tau).abs() < 3.0 * usual) & (usual < 0.5)


def _is_jump(model: Any, ends: torch.Tensor, u: Any, channel: int) -> torch.Tensor:
    """Return whether a channel jumps between two states [R, 2, D], [R]. In 4096 parts of the way a steep slope becomes flat."""
    share = torch.linspace(0.0, 1.0, 4097, dtype=ends.dtype)[:, None]
    way = model.chart.add(ends[:, :1], share * model.chart.subtract(ends[:, 1:], ends[:, :1]))
    y = model.observation(way, u).mean[..., channel]
    return (y.diff(dim=1).abs() > 0.5 * math.tau).any(1)


def _check_turns(model: Any, episode: Episode) -> Mapping[str, LawCheck]:
    """Check that measurements which jump by a turn, as measured angles do, have a residual that wraps them."""
    y, record = episode.record.y, model.prepare(episode.record)
    if model.has_residual or y.shape[1] < 3:
        return {}
    x, jumps = model.assemble(episode.truth), _find_turns(y)
    for t, k in {(t, k) for _, t, k in jumps.nonzero().tolist()}:
        jumps[:, t, k] &= (
            _is_jump(model, x[:, t : t + 2], record.at_step(t + 1).u, k)
            | _find_turns(x)[:, t].any(-1)  # a state that is an angle
        )
    places = ", ".join(str(i + 1) for i in jumps.any(0).any(0).nonzero().flatten().tolist())
    statement = "measurements that jump by a turn have a residual"
    assert not places, (
        f"{statement}: channel {places} of {type(model).__name__} jumps by 2 pi. Define residual(self, y, y_hat), which returns "
        "pfbench.core.wrap_angle(y - y_hat) for angles"
    )
    return {"turns": LawCheck(statement, 0.0, 0.0)}


def _check_model(model: Any, inputs: Any) -> Mapping[str, LawCheck]:
    """Check that a filter can follow data of a model, and the Jacobians that it states."""
    check_is_model("check", model)
    needed = model.input_type
    require(
        needed is None or isinstance(inputs, needed),
        "inputs",
        f"be {getattr(needed, '__name__', '')} for {type(model).__name__}",
        type(inputs).__name__ if inputs else "none",
        f"Use pfbench.check(model, inputs={getattr(needed, '__name__', '')}(...)) with tensors [1, T, ...].",
    )
    lengths = [10]
    map_inputs(lambda a: lengths.insert(0, a.shape[1]), inputs)
    numbers = torch.arange(20)
    episode = _GivenInputs(model, lengths[0], inputs=inputs).draw(NominalNoise(), numbers, 1)
    result = run_filter(ParticleFilter(200), model, episode.record, PhiloxStream(1, numbers))
    lost = float((~torch.isfinite(result.mean).all(-1).all(-1)).sum())
    statement = "a bootstrap filter follows data of the model"
    assert lost == 0, (
        f"{statement}: {lost:g} of 20 runs were lost. Check the scale of the noise and of the measurement"
    )
    results = {"data": LawCheck(statement, lost, 0.0), **_check_turns(model, episode)}
    if model.has_noise_gain or any(
        hasattr(model, f"{a}_jacobian") for a in ("propagation", "observation")
    ):
        x = result.mean[:, -1:, :]
        if x.shape[-1] == model.chart.size:
            errors = testing.check_jacobians(
                model, x, map_inputs(lambda a: a[:, 0], episode.record.u)
            )
            worst = max(errors, key=lambda name: errors[name])
            results["jacobians"] = LawCheck(
                f"stated derivatives are those of the maps, worst {worst}", errors[worst], 1e-5
            )
    return results
