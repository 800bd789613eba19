"""Models that fit a scenario: what is measured is what is read, and anything else is refused in words before the first step."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from config_cases import GROUPS, RECORDED, composed, world
from hydra.errors import InstantiationException
from omegaconf import OmegaConf
from recorded_data import DATA
from refusals import check_refused
from torch import Tensor

from pfbench import job
from pfbench.cli.compose import expand_sweep, read_sweep
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Episode, Record, describe_misfit
from pfbench.filter import CubaturePoints, GaussianFilter, SigmaPointLinearisation, run_filter
from pfbench.job.config import compose_tree
from pfbench.job.model_fit import (
    explain_error,
    is_fitting,
    list_fitting_models,
    list_fitting_scenarios,
)
from pfbench.model import LinearGaussian, Pendulum
from pfbench.noise import NominalNoise
from pfbench.results.store import compute_config_key
from pfbench.scenario import ModelSimulation

LOOSE = {"azimuth_small", "ins_gnss", "ins_gnss_inflated", "sins_gps_azimuth", "sins_gps_azimuth15"}
MARKOV = {
    "gps_ins",
    "ins_gnss18",
}  # need Markov parts of the sensors, which constant biases do not have
TIGHT = {"sins_gnss_tight", "sins_gnss_tight_nl"}
SIMULATED = {
    "benes", "growth", "linear_walk", "local_level", "lorenz63", "pendulum", "stochastic_volatility",
    "lorenz63_twin", "lorenz96_twin", "double_pendulum_twin",
}  # fmt: skip
# one scenario of each kind: models that fit
KINDS = {
    "growth": SIMULATED,
    "flight_300s": LOOSE,
    "azimuth_closed_loop": LOOSE,
    "recorded_boreas": LOOSE,
    "flight_500s": LOOSE | MARKOV,
    "anshun_short": TIGHT,
    "anshun_real_orbits": TIGHT,
    "sar_flight_short": {"sins_sar"},
    "terrain": {"terrain"},
    "passive_1": {"passive_location"},
    "recorded_car_drive": {"strapdown_total"},
    "recorded_quad_flights": {"strapdown_total"},
    "recorded_car_constrained": {"strapdown_blocks"},
    "user_log": {"strapdown_total", "strapdown_blocks"},
    "user_log_aligned": {"strapdown_total", "strapdown_blocks"},
    "recorded_fixed_wing_aided": {"strapdown_aided"},
    "recorded_walk": {"strapdown_tight"},
    "user_raw_log": {"raw_gnss"},
    "user_ins_log": {"strapdown_tight"},
    "recorded_berlin": {"urban_gnss", "urban_gnss_mixture"},
}
# of a kind with another one of the list: among the slow tests
ALIKE = {
    "azimuth_closed_loop", "recorded_boreas", "flight_500s", "anshun_real_orbits", "recorded_quad_flights", "user_log_aligned",
    "user_ins_log",
}  # fmt: skip


def slow_if(is_slow: Callable[[str], bool], names: Iterable[str]) -> list[Any]:
    return [pytest.param(name, marks=[pytest.mark.slow] if is_slow(name) else []) for name in names]


UKF = GaussianFilter(SigmaPointLinearisation(CubaturePoints(), largest_angle=None))


@cache
def fitting(scenario: str) -> set[str]:
    # without a data root: what fits is known without data
    return set(list_fitting_models(compose_tree([f"scenario={scenario}", "data.root=null"])))


@pytest.mark.parametrize("scenario", slow_if(ALIKE.__contains__, KINDS))
def test_models_that_fit_each_kind_of_scenario(scenario: str) -> None:
    assert fitting(scenario) == KINDS[scenario]


@pytest.mark.parametrize(
    "scenario", slow_if(lambda name: name in ALIKE or name not in KINDS, GROUPS["scenario"])
)
def test_each_pair_that_fits_runs(scenario: str) -> None:
    if scenario.startswith("user_") or (scenario in RECORDED and DATA is None):
        pytest.skip("needs recorded data")
    names = fitting(scenario)
    assert names
    for name in names:
        cfg = composed(f"scenario={scenario}", f"model={name}")
        is_drawn_from_it = "model" in cfg.scenario and cfg.scenario.model == cfg.model
        model = job.instantiate(cfg.model)
        episode = short_simulation(cfg) if is_drawn_from_it else world(scenario)
        result = run_filter(UKF, model, episode.record, PhiloxStream(1, torch.arange(2)))
        assert not result.lost.any()
        model.assemble(episode.truth)


def short_simulation(cfg: Any) -> Any:
    values = OmegaConf.to_container(cfg.scenario, resolve=True)
    assert isinstance(values, dict)
    scenario = job.instantiate({**values, "steps": 5})
    return scenario.draw(NominalNoise(), torch.arange(2), 1)


@pytest.mark.slow
def test_scenarios_that_fit_a_model_are_those_it_fits() -> None:
    fits = set(list_fitting_scenarios(["model=sins_sar"]))
    assert fits == {name for name in GROUPS["scenario"] if name.startswith("sar_flight")}


def test_every_published_pair_fits() -> None:
    for file in sorted(job.experiments_dir().glob("*.yaml")):
        swept = expand_sweep(
            [word for word in read_sweep(file.stem) if word.startswith(("scenario=", "model="))]
        )
        for words in product(*swept):
            assert is_fitting(compose_tree([f"+experiment={file.stem}", *words])), words


# what is refused: words, what the message says

SAR = (
    r"InsGnss reads 'INS minus measured position North \[m\]' as channel 1, and SarSensor measures "
    r"'INS minus measured heading \[rad\]' there\. Models that fit: sins_sar\."
)
REFUSED = {
    "heading as North": (["scenario=sar_flight", "model=ins_gnss"], SAR),
    "the same receiver by hand": (
        [
            "scenario=sar_flight",
            "model=ins_gnss",
            "model.receiver={_target_: pfbench.nav.GnssReceiver, position_sd: [1.0, 1.0, 1.0]}",
        ],
        SAR.replace("SarSensor", "SimulatedFlight"),
    ),
    "no such key": (
        ["scenario=linear_walk", "model=ins_gnss"],
        r"model\.imu is read from scenario\.imu, which this scenario does not have\. Models that fit: linear_walk\.",
    ),
    "another tuning": (
        ["scenario=recorded_car_drive", "model=strapdown_tight"],
        r"model\.tuning must be a TightTuning, got StrapdownTuning\. Models that fit: strapdown_total\.",
    ),
    "ranges as positions": (
        ["scenario=anshun_short", "model=sins_gps_azimuth"],
        r"measures 'INS minus measured range of each satellite \[m\]' there\. .*: sins_gnss_tight, sins",
    ),
    "no velocity": (
        ["scenario=recorded_car_drive", "scenario.tuning.velocity_sd=[1,1,1]", "scenario.receiver.velocity_sd=null"],
        r"reads 'velocity East \[m/s\]' as channel 4, and RecordedDrive measures 'nothing' there\. No shipped model",
    ),
    "sensors of another model of the class": (
        ["scenario=flight_300s", "model=ins_gnss18"],
        r"model\.imu must have positive initial standard deviations.*Models that fit: .*ins_gnss, ",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_does_not_fit_is_refused_with_the_models_that_do(name: str) -> None:
    words, message = REFUSED[name]
    check_refused(
        [
            (
                rf"^model must fit the scenario: .*{message}",
                lambda: job.build_plan(job.compose([*words, "data.root=null", "filter=ekf"])),
            )
        ],
        remedy=False,
    )


def test_a_wrong_value_of_a_model_that_fits_keeps_its_own_message() -> None:
    with pytest.raises(InstantiationException) as error:  # not a refusal of the pair
        job.build_plan(job.compose(["scenario=terrain", "model.measurement_sd=-1"]))
    assert "must" in str(error.value.__cause__)


def test_a_datasheet_is_refused_as_a_job_is(tmp_path: Path) -> None:
    words = ["scenario=terrain", "model=pendulum", f"results_dir={tmp_path}", "runs=2"]
    check_refused(
        [
            (
                r"measures 'height of the terrain below \[m\]' there",
                lambda: job.build_datasheet(job.compose(words)),
            )
        ],
        remedy=False,
    )


# scenarios and models of users


class Room(LinearGaussian):
    """A thermometer in a room; nothing named."""


class Inputs(NamedTuple):
    heating: Tensor


class Wind(NamedTuple):
    speed: Tensor


@dataclass(frozen=True)
class Draft:
    """A scenario of a user, with a cold wind."""

    u: Any = ()
    width: int = 1

    def draw(self, noise: Any, runs: Tensor, seed: int) -> Episode:
        y = torch.zeros(len(runs), 4, self.width, dtype=torch.float64)
        return Episode(Record(y, self.u), torch.arange(4.0), {"state": y[..., :1]})


def room() -> Room:
    return Room([[1.0]], [[1.0]], [[1.0]], [1.0], [0.0], [1.0])


def test_what_names_nothing_is_not_refused() -> None:
    assert not describe_misfit(room(), Draft())
    assert not describe_misfit(Pendulum(), Draft())
    named = Draft()
    object.__setattr__(named, "channel_names", ("temperature [K]",))
    assert not describe_misfit(room(), named)
    assert "measures 'temperature [K]' there" in describe_misfit(Pendulum(), named)


def test_order_and_frame_count() -> None:
    model, source = room(), Draft()
    model.channel_names = ("position East [m]", "position North [m]")
    object.__setattr__(source, "channel_names", model.channel_names)
    assert not describe_misfit(model, source)
    object.__setattr__(source, "channel_names", model.channel_names[::-1])
    assert "'position East [m]' as channel 1" in describe_misfit(model, source)


def test_inputs_are_compared() -> None:
    """Channels that agree do not help: a scenario without inputs, or with others, cannot move the model."""
    model, source = room(), Draft()
    model.input_type = Inputs
    for kind, got in ((tuple, "none"), (Wind, "Wind")):
        object.__setattr__(source, "input_type", kind)
        assert (
            describe_misfit(model, source)
            == f"Room reads the inputs Inputs, and Draft provides {got}"
        )
    object.__setattr__(source, "input_type", Inputs)
    assert not describe_misfit(model, source)


def test_an_input_that_nothing_states_is_named_when_it_lacks() -> None:
    class Heated(Room):
        def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
            return super().propagate(x, u, w) + u.heating[:, None, None]

    model = Heated([[1.0]], [[1.0]], [[1.0]], [1.0], [0.0], [1.0])
    for u, got in (((), "no inputs"), (Wind(torch.zeros(1, 4)), "speed")):
        record = Draft(u).draw(None, torch.arange(2), 1).record
        message = f"^record.u must have the input heating, which Heated reads, got {got}. Choose"
        with pytest.raises(ValueError, match=message):
            run_filter(UKF, model, record, PhiloxStream(1, torch.arange(2)))
    check_refused(
        [
            (
                r"^record\.u must have the input heating",
                lambda: ModelSimulation(model, 4).draw(NominalNoise(), torch.arange(2), 1),
            )
        ],
        remedy=False,
    )
    record = Draft(Inputs(torch.zeros(1, 4).double())).draw(None, torch.arange(2), 1).record
    run_filter(UKF, model, record, PhiloxStream(1, torch.arange(2)))


def test_inputs_of_another_kind_are_refused_in_python_too() -> None:
    record = world("terrain").record
    for scenario in ("passive_1", "flight_300s", "sar_flight_short", "anshun_short"):
        model = job.instantiate(composed(f"scenario={scenario}").model)
        kind = model.input_type.__name__
        with pytest.raises(ValueError, match=f"^record.u must be {kind} .*, got TerrainInputs. "):
            run_filter(UKF, model, record, PhiloxStream(1, torch.arange(2)))


def test_a_truth_of_another_size_is_refused() -> None:
    check_refused(
        [
            (
                r"^truth of state must have 1 components, .* got 2",
                lambda: room().assemble({"state": torch.zeros(2, 4, 2)}),
            )
        ],
        remedy=False,
    )


def test_names_are_as_many_as_components() -> None:
    for scenario in ("passive_1", "terrain", "flight_300s", "sar_flight_short", "lorenz63"):
        names = job.instantiate(composed(f"scenario={scenario}").scenario).channel_names
        assert len(names) == world(scenario).record.y.shape[-1]


def test_a_shipped_model_of_flights_has_the_remedy_of_its_door() -> None:
    remedies = {"own_s.S": "Use pfbench.run(scenario", "mine.S": "Add model=NAME, or `override"}
    for target, remedy in remedies.items():
        tree = {"model": {"_target_": "pfbench.model.InsGnss"}, "scenario": {"_target_": target}}
        assert remedy in str(explain_error(ValueError(), tree, ()))


NOMINAL = "_target_: pfbench.noise.NominalNoise\n"
CLASS = "noise must be keys and values with the key _target_"
FORM = r"\S*/noise/mine\.yaml must be keys and values"
FILES = {
    "text": ("just a text", rf"{FORM}, got a scalar\. Write key: value .* pfbench list noise"),
    "list": ("[1, 2]", rf"{FORM}, got a sequence\. "),
    "empty": ("", rf"{FORM}, got an empty file\. "),
    "keys": ("sd: 1.0", rf"{CLASS}, got \{{'sd': 1\.0\}}\. "),
    "circle": (
        f"{NOMINAL}a: ${{noise.b}}\nb: ${{noise.a}}",
        r"noise\.a must not refer to itself, got \$\{noise\.b\}, .* Set noise\.a to a value",
    ),
    "parent": (
        f"{NOMINAL}a: [1, '${{noise.a}}']",
        r"noise\.a\[1\] must not refer to itself, got \$\{noise\.a\}",
    ),
    "nan": (f"{NOMINAL}steps: .nan", r"noise\.steps must be finite, got nan\. Set noise\.steps to"),
    "inf": (f"{NOMINAL}a: {{b: [0.0, -.inf]}}", r"noise\.a\.b\.1 must be finite, got -inf\. "),
}


@pytest.mark.parametrize("name", FILES)
def test_what_no_class_can_take_is_refused_by_its_key(tmp_path: Path, name: str) -> None:
    text, message = FILES[name]
    (tmp_path / "noise").mkdir()
    (tmp_path / "noise" / "mine.yaml").write_text(f"{text}\n")
    words = [f"hydra.searchpath=[file://{tmp_path}]", "scenario=linear_walk", "noise=mine"]
    check_refused([(f"^{message}", lambda: job.compose(words))], remedy=False)
    (tmp_path / "noise" / "mine.yaml").write_text(f"{NOMINAL}a: [1, 0.5, null]\nb: ${{noise.a}}\n")
    assert job.compose(words).values["noise"]["b"] == [1, 0.5, None]


def test_a_number_outside_the_groups_is_named_too() -> None:
    check_refused(
        [
            (
                r"^a\.1\.b must be finite, got nan\. Set a\.1\.b",
                lambda: compute_config_key({"a": [0.5, {"b": float("nan")}], "c": 1}),
            )
        ],
        remedy=False,
    )
