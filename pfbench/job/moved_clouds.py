"""Likelihood of the particles before and after the resampler of a filter moves them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from pfbench.core.random_stream import PhiloxStream
from pfbench.filter.belief import ParticleBelief, normalise_log_weights
from pfbench.filter.loop import FilterPass, PassStep, prepare_record
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.job.budget import EpisodeSource
from pfbench.job.config import compose
from pfbench.job.plan import build_plan


def measure_moved_clouds(words: Sequence[str]) -> np.ndarray:
    """Run the particle filter of a job again, and compare each cloud with the one that its resampler makes of it.

    The numbers drawn are those with which the filter resamples at the next step.

    Args:
        words: Words of the job.

    Returns:
        Geometric mean over time of the likelihood before a move over that after it, [R]. Above 1 the likelihood falls.
    """
    plan = build_plan(compose(words))
    method: ParticleFilter = plan.method
    episode = EpisodeSource(plan).batch(0, len(plan.runs))
    model = plan.make_filter_model(episode)
    draws = PhiloxStream(plan.values["seed"], plan.runs, plan.dtype)
    falls = []
    with torch.no_grad():
        steps = FilterPass(method, model, prepare_record(model, episode.record), draws)
        for step in steps:
            cloud: ParticleBelief = steps.belief
            number = torch.full_like(cloud.log_w[:, :1], float(method.particles))
            after, _ = method.resampler(step.model, cloud, cloud.log_w, number, draws.at_step(step.t + 2))  # fmt: skip
            falls.append(_mean_log_likelihood(step, cloud) - _mean_log_likelihood(step, after))
    return np.asarray(torch.stack(falls).mean(0).exp().cpu().double())


def _mean_log_likelihood(step: PassStep, cloud: ParticleBelief) -> Tensor:
    """Return the weighted mean over particles of log p(y | x), [R]; without those of weight 0, where it is infinite."""
    w = normalise_log_weights(cloud.log_w)
    log_likelihood = step.model.log_likelihood(step.record.y, cloud.x, step.record.u)
    return torch.where(w > 0.0, w.double() * log_likelihood, 0.0).sum(1)
