"""Laws of an own part: the checks of `pfbench.testing` that fit it, as rows of a table."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from pfbench.cli.messages import format_error
from pfbench.door.own_parts import find_group
from pfbench.door.parts import Part, format_html_table, place_words, plain_errors
from pfbench.job.config import compose

if TYPE_CHECKING:
    import pandas as pd

    from pfbench.testing import LawCheck

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


def check_laws(thing: Any, runs: int = 200) -> LawTable:
    """Check the laws that fit a part. A law that does not hold is a row and no error.

    Args:
        thing: Part, object or class of your own: filter, stage, model, scenario or noise regime.
        runs: Number of runs of the statistical checks of a filter.

    Returns:
        The laws with their results.

    Raises:
        ValueError: If the object is none of these.
    """
    with plain_errors():
        subject, group, stage = _build(thing)
    checks: Mapping[str, Callable[[], Mapping[str, LawCheck]]] = {
        "model": lambda: _check_model(subject),
        "scenario": lambda: _check_scenario(subject),
        "noise": lambda: _check_noise(subject),
    }
    try:
        results = checks[group]() if group in checks else _check_filter(subject, stage, runs)
    except AssertionError as error:
        statement, _, message = f"{error}".partition(": ")
        return LawTable((LawRow(statement, False, message=message or statement),))
    except Exception as error:
        return LawTable((LawRow("the part runs", False, message=format_error(error)),))
    return LawTable(
        tuple(LawRow(c.statement, True, c.statistic, c.limit) for c in results.values())
    )


def _build(thing: Any) -> tuple[Any, str, str]:
    """Return the object of a part or a class, its group, and its stage."""
    if isinstance(thing, Part):
        from pfbench.job import instantiate

        config = compose([*thing.words(), *place_words([thing])])
        return instantiate(config.values[thing.group], config.trusted), thing.group, ""
    group, stage = find_group(thing)
    return thing() if isinstance(thing, type) else thing, group, stage


def _check_filter(subject: Any, stage: str, runs: int) -> Mapping[str, LawCheck]:
    """Check a filter, or a stage by its own law and as a part of a filter."""
    from dataclasses import replace

    from pfbench import testing
    from pfbench.filter import EssResampler, ParticleFilter

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


def _check_model(model: Any) -> Mapping[str, LawCheck]:
    """Check that a filter can follow data of a model, and the Jacobians that it states."""
    import torch

    from pfbench.core import PhiloxStream
    from pfbench.core.record import map_inputs
    from pfbench.filter import ParticleFilter, run_filter
    from pfbench.model import StateSpaceModel
    from pfbench.noise import NominalNoise
    from pfbench.scenario import ModelSimulation, RecordingRegime
    from pfbench.testing import LawCheck, check_jacobians

    numbers, regime = torch.arange(20), RecordingRegime(NominalNoise())
    episode = ModelSimulation(model, 10).draw(regime, numbers, 1)
    result = run_filter(ParticleFilter(200), model, episode.record, PhiloxStream(1, numbers))
    lost = float((~torch.isfinite(result.mean).all(-1).all(-1)).sum())
    statement = "a bootstrap filter follows data of the model"
    assert lost == 0, (
        f"{statement}: {lost:g} of 20 runs were lost. Check the scale of the noise and of the measurement"
    )
    results = {"data": LawCheck(statement, lost, 0.0)}
    names = ("propagation_jacobian", "observation_jacobian", "noise_gain")
    if any(getattr(type(model), n, None) is not getattr(StateSpaceModel, n, None) for n in names):
        x = result.mean[:, -1:, :]
        if x.shape[-1] == model.chart.size:
            errors = check_jacobians(model, x, map_inputs(lambda a: a[:, 0], episode.record.u))
            worst = max(errors, key=lambda name: errors[name])
            results["jacobians"] = LawCheck(
                f"stated derivatives are those of the maps, worst {worst}", errors[worst], 1e-5
            )
    return results


def _check_scenario(scenario: Any) -> Mapping[str, LawCheck]:
    """Check that a run is the same alone and among others."""
    from pfbench.noise import NominalNoise
    from pfbench.scenario import RecordingRegime

    def draw(numbers: Any) -> Any:
        return scenario.draw(RecordingRegime(NominalNoise()), numbers, 1).record.y

    return _check_alone("the data of a run do not depend on other runs", draw)


def _check_noise(noise: Any) -> Mapping[str, LawCheck]:
    """Check that the errors of a run are the same alone and among others."""
    import torch

    from pfbench.core import MeasurementChannels, PhiloxStream

    channels = MeasurementChannels.of_one_kind(torch.ones(2, dtype=torch.float64))
    time = torch.arange(1, 21, dtype=torch.float64)

    def draw(numbers: Any) -> Any:
        return noise.draw_errors(PhiloxStream(1, numbers), channels, time)

    return _check_alone("the errors of a run do not depend on other runs", draw)


def _check_alone(statement: str, draw: Callable[[Any], Any]) -> Mapping[str, LawCheck]:
    """Compare the draws of a run alone with those among others, and with a second draw."""
    import torch

    from pfbench.testing import LawCheck

    several, repeated, alone = draw(torch.arange(3)), draw(torch.arange(3)), draw(torch.tensor([2]))
    assert torch.equal(several.nan_to_num(), repeated.nan_to_num()), (
        f"{statement}: a second draw must be the same, got other numbers. Draw all random numbers from the stream"
    )
    difference = float((several[2] - alone[0]).abs().nan_to_num().max())
    assert difference <= 1e-12, (
        f"{statement}: run 2 alone must be as among others, got a difference of {difference:.3g}. "
        "Draw all random numbers from PhiloxStream(seed, runs)"
    )
    return {"alone": LawCheck(statement, difference, 1e-12)}
