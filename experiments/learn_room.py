"""How much room is there for a learned proposal? Scene by scene, before anything is trained.

    PFBENCH_DATA=... python -m pfbench.experiments.learn_room [scene[,choice=...] ...]

A proposal of one step's noise decides where the children of a particle go, and not which particle has children. The best one
draws from p(w | parent, y): a child's weight then depends on its parent alone. So many children are put under the same parents,
by each proposal, and their weights v = p(w) p(y | child) / q(w) compared: with a_i the mean of v over the children of parent i
and s_i that of its square, sum a_i^2 / sum s_i is the ESS after this step over that of the best proposal. One means that nothing
is left to be won; how far below one the better of the hand-made ones stays is all that a network can win. What parents differ
in, the mean of a squared against the mean of a^2, no proposal of this step's noise can change: it stands under `parents`.

Beside it stand the nats that a measurement tells of the step's noise, log det (I + R^-1/2 H Q H' R^-1/2) / 2 by the extended
Kalman filter's rule at the predicted mean. Steps without a measurement do not count. A scene without its recorded data is left
out. What is done is kept in the folder, and the same command goes on from there.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_module
from torch import Tensor

from pfbench.core import PhiloxStream, Record, map_inputs
from pfbench.filter import (
    BootstrapProposal,
    CubaturePoints,
    GaussianFilter,
    GuidedNoiseProposal,
    ParticleBelief,
    ParticleFilter,
    Proposal,
    SigmaPointLinearisation,
    TaylorLinearisation,
    normalise_log_weights,
)
from pfbench.job import instantiate
from pfbench.model import StateSpaceModel, StaticModel
from pfbench.scenario import RecordingRegime

SCENES = (
    "growth", "stochastic_volatility", "pendulum", "lorenz63", "linear_walk",
    "passive_1", "passive_2", "passive_3", "azimuth", "azimuth_fast", "azimuth,model=sins_gps_azimuth15", "azimuth_small",
    "flight_300s", "flight_500s", "flight_500s,model=ins_gnss_inflated", "gps_ins", "recorded_boreas", "sar_flight_short", "anshun_short", "anshun_nl",
    "recorded_berlin", "berlin,model=urban_gnss_mixture", "walk", "recorded_car_drive", "recorded_quad_flights", "recorded_fixed_wing", "recorded_fixed_wing_aided",
)  # fmt: skip
TOLD = "noise=outliers,oracle_noise=true"  # the filter knows that one measurement in twenty is ten times as wrong: no normal law
SCENES += tuple(f"{scene},{TOLD}" for scene in ("azimuth", "anshun_short", "passive_1"))
RULES = {
    "own noise": None,
    "EKF": TaylorLinearisation(),
    "CKF": SigmaPointLinearisation(CubaturePoints()),
}
PARENTS, CHILDREN, RUNS, LOOKS = 40, 50, 4, 25


def proposals() -> dict[str, Proposal]:
    return {
        name: BootstrapProposal() if rule is None else GuidedNoiseProposal(GaussianFilter(rule))
        for name, rule in RULES.items()
    }


def world(words: str, runs: int, steps: int | None) -> tuple[StateSpaceModel, Record]:
    """The model that filters are given and the record, prepared; some runs of a scene, the first steps of it.

    Raises:
        ValueError: recorded data that is not there.
    """
    scene, *choices = words.split(",")
    with initialize_config_module("pfbench.conf", version_base="1.3"):
        cfg = compose("config", [f"scenario={scene}", *choices])
    model, witness = instantiate(cfg.model), RecordingRegime(instantiate(cfg.noise))
    episode = instantiate(cfg.scenario).draw(witness, torch.arange(runs), cfg.seed)
    model = witness.to_oracle_model(model, episode.time) if cfg.oracle_noise else model
    began = episode.record.to(model.anchor)
    record = model.prepare(episode.record).to(model.anchor)
    return model, Record(
        record.y[:, :steps], map_inputs(lambda a: a[:, :steps], record.u), began.start, began.spread
    )


def weighed(
    proposal: Proposal,
    model: StateSpaceModel,
    belief: ParticleBelief,
    record: Record,
    draws: PhiloxStream,
) -> Tensor:
    """log v [R, parents, children] of children of a cloud's particles, the same parents for every proposal."""
    who = torch.multinomial(
        normalise_log_weights(belief.log_w),
        PARENTS,
        True,
        generator=torch.Generator().manual_seed(0),
    )
    rows = who.repeat_interleave(CHILDREN, 1)
    x = belief.x.gather(1, rows.unsqueeze(-1).expand(-1, -1, belief.x.shape[-1]))
    log_w = torch.full_like(x[..., 0], -torch.tensor(float(x.shape[1])).log().item())
    sent = proposal(model, ParticleBelief(x, log_w, belief.log_evidence), record, draws)
    return (model.log_likelihood(record.y, sent.x, record.u) + sent.log_ratio).unflatten(
        1, (PARENTS, CHILDREN)
    )


def share(log_v: Tensor) -> Tensor:
    """ESS after the step over that of the best proposal [R]: sum a^2 / sum s, a^2 without the bias of its few children."""
    v = torch.exp(log_v - log_v.amax((1, 2), keepdim=True))
    total, square, m = v.sum(2), v.square().sum(2), v.shape[2]
    return ((total.square() - square) / (m - 1)).sum(1) / square.sum(1)


def nats(model: StateSpaceModel, belief: ParticleBelief, record: Record) -> Tensor:
    """What the measurement tells of the step's noise [R], by the linearisation at the cloud's mean."""
    mean = model.chart.mean(belief.x, normalise_log_weights(belief.log_w)).unsqueeze(1)
    z = torch.zeros(*mean.shape[:2], model.noise_dim).to(mean)
    guide = GuidedNoiseProposal(GaussianFilter(TaylorLinearisation()))
    told: Tensor = -guide.map_to_posterior(
        model, belief._replace(x=mean, log_w=mean.new_zeros(mean.shape[:2])), record, z
    )[1]
    return told[:, 0]


def looked_at(record: Record) -> set[int]:
    """Steps at which something is measured in all runs, evenly chosen; the first ones, when the cloud is widest, among them."""
    there = (~torch.isnan(record.y)).any(-1).all(0).nonzero()[:, 0]
    pick = torch.linspace(0, len(there) - 1, min(LOOKS, len(there))).round().long()
    return {int(t) for t in there[pick]}


def room(model: StateSpaceModel, record: Record) -> dict[str, Any]:
    """Means over looks and runs, and standard errors over runs where there are some; the filter on the way is guided by a CKF."""
    method = ParticleFilter(
        500, proposal=GuidedNoiseProposal(GaussianFilter(RULES["CKF"]), shared_by_particles=True)
    )
    runs, looks = torch.arange(len(record.y)), looked_at(record)
    draws, found = PhiloxStream(2, runs), {name: [] for name in ("nats", *RULES, "parents")}
    belief = method.init(model, len(runs), draws.at_step(0), record.start, record.spread)
    for t in range(max(looks) + 1):
        seen, own = record.at_step(t), draws.at_step(t + 1)
        still = t == 0 and model.observes_initial
        if t in looks and not still:
            found["nats"].append(nats(model, belief, seen))
            for name, proposal in proposals().items():
                log_v = weighed(proposal, model, belief, seen, PhiloxStream(3, runs).at_step(t + 1))
                found[name].append(share(log_v))
            a = torch.softmax(log_v.logsumexp(2), 1)
            found["parents"].append(1.0 / (PARENTS * a.square().sum(1)))
        belief, _ = method.step(StaticModel(model) if still else model, belief, seen, own)
    each = {name: torch.stack(values).mean(0) for name, values in found.items()}
    return {"noises": model.noise_dim, "looks": len(found["nats"])} | {
        name: (float(value.mean()), float(value.std() / len(runs) ** 0.5))
        for name, value in each.items()
    }


def table(told: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Lines of a table in Markdown."""
    names = [*RULES, "parents"]
    lines = [f"| scene | noises | nats | {' | '.join(names)} |", "|" + " --- |" * (3 + len(names))]
    for words, found in told.items():
        cells = [
            str(found["noises"]),
            f"{found['nats'][0]:.2g}",
            *(f"{found[name][0]:.3f}" for name in names),
        ]
        lines.append(f"| {words.replace(',', ', ')} | " + " | ".join(cells) + " |")
    return lines


def main(folder: Path, *scenes: str, steps: int = 400) -> None:
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "learn_room.json"
    told: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    for words in scenes or SCENES:
        if words in told:
            continue
        try:
            with torch.no_grad():
                told[words] = room(*world(words, RUNS, steps))
        except ValueError as error:
            print(f"{words}: left out, {error}", flush=True)
            continue
        print(table({words: told[words]})[-1], flush=True)
        path.write_text(json.dumps(told, indent=1))
    (folder / "table.md").write_text("\n".join(table(told)) + "\n")


if __name__ == "__main__":
    main(Path(os.environ.get("PFBENCH_RESULTS", "results")) / "learn_room", *sys.argv[1:])
