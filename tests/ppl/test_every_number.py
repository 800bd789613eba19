"""Every number of every shipped model is a parameter: models that differ in it share a batch, and its likelihood moves."""

import pytest
import torch
from checkout import ROOT

from pfbench.cli.infer import _build as build
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import map_inputs
from pfbench.filter.loop import run_filter
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.job import compose
from pfbench.model.base import StateSpaceModel
from pfbench.ppl.inference_job import list_numbers
from pfbench.ppl.likelihood import repeat_runs
from pfbench.ppl.model_batch import ModelBatch, list_non_buffers

WORLDS = {  # of models whose name no scenario has
    "azimuth_small": "azimuth_small", "gps_ins": "gps_ins", "ins_gnss": "flight_300s", "ins_gnss18": "flight_500s",
    "ins_gnss_inflated": "flight_300s", "passive_location": "passive_1", "raw_gnss": "user_raw_log",
    "sins_gnss_tight": "anshun_uav", "sins_gnss_tight_nl": "anshun_nl", "sins_gps_azimuth": "azimuth",
    "sins_gps_azimuth15": "azimuth", "sins_sar": "sar_flight", "strapdown_aided": "recorded_fixed_wing_aided",
    "strapdown_blocks": "recorded_car_constrained", "strapdown_tight": "recorded_walk",
    "strapdown_total": "recorded_car_drive", "urban_gnss": "recorded_berlin", "urban_gnss_mixture": "recorded_berlin",
}  # fmt: skip
MODELS = sorted(path.stem for path in (ROOT / "conf" / "model").glob("*.yaml"))
OF_THE_SCENARIO = ("gyro_bias_deg_s[", "accelerometer_bias[", "receiver.mask_deg")  # its inputs
NO_REAL_NUMBERS = ("terrain.waves", "terrain.seed")
STEPS = 4


def vary(name: str) -> tuple[dict, dict[str, StateSpaceModel]]:
    """Return the configuration of a model, and the model itself and with each number changed by 5 %."""
    values = compose([f"model={name}", f"scenario={WORLDS.get(name, name)}"]).values
    models = {"": build(values["model"])}
    for key, value in list_numbers(values["model"]).items():
        number = torch.tensor(0.95 * value if value else 1e-3, dtype=torch.float64)
        if key not in NO_REAL_NUMBERS:
            models[key] = build(values["model"], **{key: number})
    return values, models


@pytest.mark.parametrize("name", MODELS)
def test_the_likelihood_moves_with_each_number(name: str) -> None:
    """Of a few steps by a particle filter, where the world is simulated; of recorded ones the model, for which data are needed."""
    values, models = vary(name)
    first = models[""]
    fixed = [
        key
        for key, model in models.items()
        if all(map(torch.equal, first.buffers(), model.buffers()))
        and not list_non_buffers(first, model)
    ]
    assert [key for key in fixed[1:] if not any(part in key for part in OF_THE_SCENARIO)] == []
    kept = {key: model for key, model in models.items() if key not in fixed[1:]}
    assert len(kept) > 2
    if "recorded" in WORLDS.get(name, "") or name == "raw_gnss":
        return
    episode = build(values["scenario"]).draw(build(values["noise"]), torch.arange(1), 1)
    record = episode.record._replace(
        y=episode.record.y[:, :STEPS].double(), u=map_inputs(lambda a: a[:, :STEPS], episode.record.u)
    )  # fmt: skip
    stream = PhiloxStream(1, torch.zeros(len(kept), dtype=torch.long))
    batch, runs = ModelBatch(list(kept.values())), repeat_runs(record, len(kept))
    log_likelihood = run_filter(ParticleFilter(20), batch, runs, stream).log_evidence
    assert bool(torch.isfinite(log_likelihood).all())
    still = zip(kept, log_likelihood == log_likelihood[0], strict=True)
    assert [key for key, is_still in still if is_still] == [""]
