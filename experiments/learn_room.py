"""Possible gain of a learned proposal by scenario, before anything is trained.

    PFBENCH_DATA=... python -m pfbench.experiments.learn_room [scenario[,choice=...] ...]

A proposal of the noise of one step determines the children of a particle, and not which particle has children. The best one is
p(w | parent, y): the weight of a child then depends on its parent only. Each proposal draws many children of the same parents
with weights v = p(w) p(y | child) / q(w). For parent i, a_i is the mean of v and s_i the mean of its square. The ESS of the step
relative to the best proposal is sum a_i^2 / sum s_i. A value of 1 means that no gain is possible. The column `parents` is the
ratio that remains because the parents differ, the squared mean of a over the mean of a^2.

The column `nats` is the information of a measurement about the noise of the step, by the rule of the extended Kalman filter at
the predicted mean. Its formula is `log det (I + R^-1/2 H Q H' R^-1/2) / 2`. Steps without a measurement do not count. A scenario without its
recorded data is omitted. The command resumes from the scenarios in its folder and writes `report.md`.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
import torch
from hydra import compose, initialize_config_module
from matplotlib.figure import Figure
from pfbench.experiments.study_parts import ResumableResults
from torch import Tensor

from pfbench.core import PhiloxStream, Record, map_inputs
from pfbench.files import markdown_paragraph
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
from pfbench.job import instantiate, register_experiments
from pfbench.model import StateSpaceModel, StaticModel
from pfbench.report import COLUMN, RC, add_legend, line_styles, render_palette_png
from pfbench.scenario import RecordingRegime

SCENARIOS: tuple[str, ...] = (
    "growth", "stochastic_volatility", "pendulum", "lorenz63", "linear_walk",
    "passive_1", "passive_2", "passive_3", "azimuth", "azimuth_fast", "azimuth,model=sins_gps_azimuth15", "azimuth_small",
    "flight_300s", "flight_500s", "flight_500s,model=ins_gnss_inflated", "gps_ins", "recorded_boreas", "sar_flight_short", "anshun_short", "anshun_nl",
    "recorded_berlin", "recorded_berlin,model=urban_gnss_mixture", "recorded_walk", "recorded_car_drive", "recorded_quad_flights", "recorded_fixed_wing", "recorded_fixed_wing_aided",
)  # fmt: skip
ORACLE = "noise=outliers,oracle_noise=true"  # the model of the filter has the outliers, so its errors are not normal
SCENARIOS += tuple(f"{scenario},{ORACLE}" for scenario in ("azimuth", "anshun_short", "passive_1"))
RULES = {
    "bootstrap": None,
    "EKF": TaylorLinearisation(),
    "CKF": SigmaPointLinearisation(CubaturePoints()),
}
PARENTS, CHILDREN, RUNS, LOOKS = 40, 50, 4, 25
OPEN = 0.99  # a best ratio below this leaves a network something to gain


def proposals() -> dict[str, Proposal]:
    return {
        name: BootstrapProposal() if rule is None else GuidedNoiseProposal(GaussianFilter(rule))
        for name, rule in RULES.items()
    }


def draw_record(words: str, runs: int, steps: int | None) -> tuple[StateSpaceModel, Record]:
    """The model of the filters and their record, prepared; the first runs and steps of a scenario.

    Raises:
        ValueError: If recorded data are missing.
    """
    scenario, *choices = words.split(",")
    register_experiments()
    with initialize_config_module("pfbench.conf", version_base="1.3"):
        cfg = compose("config", [f"scenario={scenario}", *choices])
    model, recorder = instantiate(cfg.model), RecordingRegime(instantiate(cfg.noise))
    episode = instantiate(cfg.scenario).draw(recorder, torch.arange(runs), cfg.seed)
    model = recorder.to_oracle_model(model, episode.time) if cfg.oracle_noise else model
    prepared = episode.record.to(model.anchor)
    record = model.prepare(episode.record).to(model.anchor)
    return model, Record(
        record.y[:, :steps],
        map_inputs(lambda a: a[:, :steps], record.u),
        prepared.start,
        prepared.spread,
    )


def weigh_children(
    proposal: Proposal,
    model: StateSpaceModel,
    belief: ParticleBelief,
    record: Record,
    draws: PhiloxStream,
) -> Tensor:
    """Logarithm of v, [R, parents, children]; the parents are the same for each proposal."""
    parents = torch.multinomial(
        normalise_log_weights(belief.log_w),
        PARENTS,
        True,
        generator=torch.Generator().manual_seed(0),
    )
    rows = parents.repeat_interleave(CHILDREN, 1)
    x = belief.x.gather(1, rows.unsqueeze(-1).expand(-1, -1, belief.x.shape[-1]))
    log_w = torch.full_like(x[..., 0], -torch.tensor(float(x.shape[1])).log().item())
    children = proposal(model, ParticleBelief(x, log_w, belief.log_evidence), record, draws)
    return (model.log_likelihood(record.y, children.x, record.u) + children.log_ratio).unflatten(
        1, (PARENTS, CHILDREN)
    )


def share(log_v: Tensor) -> Tensor:
    """ESS relative to the best proposal, [R]: sum a^2 / sum s, with an unbiased estimate of a^2."""
    v = torch.exp(log_v - log_v.amax((1, 2), keepdim=True))
    total, square, m = v.sum(2), v.square().sum(2), v.shape[2]
    return ((total.square() - square) / (m - 1)).sum(1) / square.sum(1)


def nats(model: StateSpaceModel, belief: ParticleBelief, record: Record) -> Tensor:
    """Information of the measurement about the noise of the step, [R], by linearisation at the mean of the particles."""
    mean = model.chart.mean(belief.x, normalise_log_weights(belief.log_w)).unsqueeze(1)
    guide = GuidedNoiseProposal(GaussianFilter(TaylorLinearisation()))
    information: Tensor = -guide.fit_posterior(
        model, belief._replace(x=mean, log_w=mean.new_zeros(mean.shape[:2])), record
    ).log_det
    return information[:, 0]


def select_steps(record: Record) -> set[int]:
    """Evenly spaced steps with a measurement in all runs, the first one included."""
    measured = (~torch.isnan(record.y)).any(-1).all(0).nonzero()[:, 0]
    pick = torch.linspace(0, len(measured) - 1, min(LOOKS, len(measured))).round().long()
    return {int(t) for t in measured[pick]}


def room(model: StateSpaceModel, record: Record) -> dict[str, Any]:
    """Means over steps and runs, and standard errors over runs. The filter is guided by a CKF."""
    method = ParticleFilter(
        500, proposal=GuidedNoiseProposal(GaussianFilter(RULES["CKF"]), shared_by_particles=True)
    )
    runs, looks = torch.arange(len(record.y)), select_steps(record)
    draws, columns = PhiloxStream(2, runs), {name: [] for name in ("nats", *RULES, "parents")}
    belief = method.init(model, len(runs), draws.at_step(0), record.start, record.spread)
    for t in range(max(looks) + 1):
        now, stream = record.at_step(t), draws.at_step(t + 1)
        still = t == 0 and model.observes_initial
        if t in looks and not still:
            columns["nats"].append(nats(model, belief, now))
            for name, proposal in proposals().items():
                log_v = weigh_children(
                    proposal, model, belief, now, PhiloxStream(3, runs).at_step(t + 1)
                )
                columns[name].append(share(log_v))
            a = torch.softmax(log_v.logsumexp(2), 1)
            columns["parents"].append(1.0 / (PARENTS * a.square().sum(1)))
        belief, _ = method.step(StaticModel(model) if still else model, belief, now, stream)
    means = {name: torch.stack(values).mean(0) for name, values in columns.items()}
    return {"noises": model.noise_dim, "steps": len(columns["nats"])} | {
        name: (float(value.mean()), float(value.std() / len(runs) ** 0.5))
        for name, value in means.items()
    }


def table(results: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Lines of a table in Markdown."""
    names = [*RULES, "parents"]
    lines = [
        f"| scenario | noises | nats | {' | '.join(names)} |",
        "|" + " --- |" * (3 + len(names)),
    ]
    for words, columns in results.items():
        cells = [
            str(columns["noises"]),
            f"{columns['nats'][0]:.2g}",
            *(f"{columns[name][0]:.3f}" for name in names),
        ]
        lines.append(f"| {words.replace(',', ', ')} | " + " | ".join(cells) + " |")
    return lines


def list_rooms(done: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Largest ratio of a proposal without a network in each scenario; 1 leaves nothing to a network."""
    return {words: max(columns[rule][0] for rule in RULES) for words, columns in done.items()}


def plot_rooms(done: Mapping[str, Mapping[str, Any]]) -> Figure:
    """A row for each scenario, a mark for each proposal."""
    style = line_styles(list(RULES))
    figure = Figure(figsize=(2 * COLUMN, 0.6 + 0.15 * len(done)), layout="constrained")
    axis = figure.subplots()
    for marker, rule in zip(("o", "x", "+"), RULES, strict=True):
        ratios = [columns[rule][0] for columns in done.values()]
        rows = range(len(ratios))
        axis.plot(ratios, rows, marker, ms=4, mfc="none", color=style[rule].colour, label=rule)
    axis.set_yticks(range(len(done)), [words.replace(",", ", ") for words in done], fontsize=6)
    axis.invert_yaxis()
    axis.set_xlabel("ESS relative to the best proposal of one step")
    add_legend(figure, axis, columns=3)
    return figure


def write_page(request: Mapping[str, Any], done: Mapping[str, Any]) -> str:
    """The page of the study from its stored results."""
    lines = ["# Possible gain of a learned proposal by scenario", ""]
    lines += markdown_paragraph(
        f"`python -m pfbench.experiments.learn_room` writes this page. Columns with the name of a proposal are its ESS relative to "
        "the best proposal of one step, p(w | parent, y). At 1 no network can improve the ESS. `nats` is the information of a "
        "measurement about the noise of its step, and `parents` the ratio that remains because the parents differ. Values are means "
        f"over {request['runs']} runs and at most {LOOKS} steps of the first {request['steps']}, with {PARENTS} parents and "
        f"{CHILDREN} children each. `oracle_noise` gives the filter the noise distribution of the data."
    )
    lines += [*table(done), ""]
    open_ones = [words for words, ratio in list_rooms(done).items() if ratio < OPEN]
    names = "; ".join(words.replace(",", ", ") for words in open_ones) or "none"
    lines += markdown_paragraph(
        f"Scenarios in which the best of these proposals has a ratio below {OPEN:g}: {names}."
    )
    lines += ["![ESS relative to the best proposal](rooms.png)", ""]
    return "\n".join(lines)


def main(folder: Path, *scenarios: str, steps: int = 400) -> None:
    torch.set_num_threads(1)
    request = {"runs": RUNS, "steps": steps}
    results = ResumableResults(folder / "learn_room.json", request)
    for words in scenarios or SCENARIOS:
        try:
            with torch.no_grad():
                found = results(words, lambda words=words: room(*draw_record(words, RUNS, steps)))
        except ValueError as error:
            print(f"{words}: omitted, {error}", flush=True)
            continue
        print(table({words: found})[-1], flush=True)
    done = results.state["done"]
    (folder / "report.md").write_text(write_page(request, done))
    with matplotlib.rc_context(RC):
        (folder / "rooms.png").write_bytes(render_palette_png(plot_rooms(done)))


if __name__ == "__main__":
    main(Path(os.environ.get("PFBENCH_RESULTS", "results")) / "learn_room", *sys.argv[1:])
