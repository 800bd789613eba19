"""Test of proposals: their weighted averages equal averages over the model."""

from __future__ import annotations

import math

import torch

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief
from pfbench.filter.particle.proposals import Proposal
from pfbench.model.linear_gaussian import linear_walk
from pfbench.testing.results import LawCheck, check_means
from pfbench.testing.subjects import check_count, compute_twice, find_kind

_STATEMENT = "a proposal returns log p(w) - log q(w)"


def check_proposal(
    proposal: Proposal, particles: int = 20, runs: int = 4000, seed: int = 1, limit: float = 4.5
) -> LawCheck:
    """Check E_q[exp(log_ratio) f(x)] = E_p[f(x)] for f = 1, x and x^2.

    The model is a walk with constant velocity, whose predicted moments are known. Its measurement
    is weak, so that a proposal that uses it stays close to the model and the ratio has a variance.

    Args:
        proposal: Proposal to test.
        particles: Number of particles in a run.
        runs: Number of independent repetitions.
        seed: Seed of the random stream.
        limit: Largest number of standard errors.

    Returns:
        The average with the most standard errors.

    Raises:
        AssertionError: If the statement does not hold, or if the proposal is not repeatable.
        ValueError: If the proposal is not an instance that is called with these arguments.
    """
    kinds = {"proposal": ("model", "belief", "record", "draws")}
    find_kind("check_proposal", proposal, kinds, "BootstrapProposal()")
    check_count("check_proposal", particles=particles)
    check_count("check_proposal", 2, runs=runs)
    model = linear_walk(1.0, 0.5, 2.0)
    streams = PhiloxStream(seed, torch.arange(runs))
    flat = torch.full((runs, particles), -math.log(particles), dtype=torch.float64)
    belief = ParticleBelief(
        streams.normal("state", particles, 2), flat, torch.zeros(runs, dtype=torch.float64)
    )
    record = Record(torch.full((runs, 1), 0.7, dtype=torch.float64))
    proposed = compute_twice(
        "proposal",
        lambda: proposal(model, belief, record, streams.at_step(1)),
        lambda sample: {"states": sample.x, "ratio": sample.log_ratio},
    )
    ratio = torch.exp(proposed.log_ratio).unsqueeze(-1)
    parent = belief.x @ model.f.mT
    variance = (model.g @ model.g.mT).diagonal()
    z = (proposed.x - parent) / variance.sqrt()  # standard normal under the model
    averages = {
        "exp(log_ratio) - 1": ratio - 1.0,
        "exp(log_ratio) z": ratio * z,
        "exp(log_ratio) z^2 - 1": ratio * z * z - 1.0,
    }
    deviations = {
        f"{name}, component {i}": value.mean(1)[:, i].numpy()
        for name, value in averages.items()
        for i in range(value.shape[-1])
    }
    return check_means(_STATEMENT, deviations, limit)
