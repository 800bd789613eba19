"""Inference that follows gradients of the marginal likelihood: NUTS, and variational inference. All of it is Pyro's."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import pyro
import torch
from pyro.distributions import Delta, MultivariateNormal, constraints
from pyro.infer import MCMC, NUTS, SVI, Trace_ELBO
from pyro.optim import ClippedAdam
from torch import Tensor
from torch.distributions import biject_to

from pfbench.ppl.posterior import Posterior
from pfbench.ppl.program import Unknown, Values
from pfbench.record import Record

Program = Callable[[Record], Values]


class Variational(NamedTuple):
    """Draws from the guide, and the loss (minus the evidence lower bound) after each step."""

    posterior: Posterior
    losses: list[float]


def nuts(
    program: Program, record: Record, draws: int, warmup: int, chains: int = 2, seed: int = 0, progress: bool = False
) -> Posterior:
    """The no-U-turn sampler on a program whose likelihood is differentiable; chains one after the other.

    Sites that are no numbers (the path of a latent program) are left out of the posterior.
    """
    found: list[dict[str, Tensor]] = []
    accepted = []
    for chain in range(chains):
        with torch.random.fork_rng():
            torch.manual_seed(1000 * seed + chain)
            sampler = MCMC(NUTS(program), num_samples=draws, warmup_steps=warmup, disable_progbar=not progress)
            sampler.run(record)
        found.append({name: a for name, a in sampler.get_samples().items() if a.dim() == 1})
        accepted.append(sampler.diagnostics()["acceptance rate"]["chain 0"])
    return Posterior({name: torch.stack([a[name] for a in found]) for name in found[0]}, torch.tensor(accepted), "NUTS")


def variational(
    program: Program, record: Record, guide: Callable[[Record], Any], steps: int, draws: int, rate: float = 0.05, seed: int = 0,
    particles: int = 1,
) -> Variational:  # fmt: skip
    """Stochastic variational inference with a guide of Pyro's (`AutoMultivariateNormal(program)`) or `normal_guide`.

    Args:
        program: with a differentiable likelihood.
        record: what was measured.
        guide: a law of the same sites.
        steps: of Adam, whose rate falls to a tenth on the way.
        draws: from the guide at the end.
        rate: of learning at first.
        seed: of everything random.
        particles: draws for each gradient.
    """
    with torch.random.fork_rng(), pyro.get_param_store().scope():
        torch.manual_seed(seed)
        optimiser = ClippedAdam({"lr": rate, "lrd": 0.1 ** (1.0 / steps)})
        inference = SVI(program, guide, optimiser, Trace_ELBO(num_particles=particles))
        losses = [float(inference.step(record)) for _ in range(steps)]
        with torch.no_grad():
            found = [guide(record) for _ in range(draws)]
    drawn = {name: torch.stack([a[name] for a in found]).unsqueeze(0) for name in found[0]}
    return Variational(Posterior(drawn, how="SVI"), losses)


def normal_guide(unknown: Unknown, apart: bool = False, spread: float = 0.3) -> Callable[[Record], Values]:
    """A normal law of the numbers on the whole real line, with all covariances between them; begins at the prior's medians.

    Args:
        unknown: the model.
        apart: a law for every run of the record, for programs whose runs have numbers of their own; Pyro's own guides know one
            law of everything or none between numbers.
        spread: standard deviation at first.
    """
    p = len(unknown.prior)
    medians = unknown.unconstrained(unknown.draw(1001, 0)).median(0).values

    def numbers(runs: torch.Size) -> Values:
        loc = pyro.param("loc", lambda: medians.expand(*runs, p).clone())
        eye = spread * torch.eye(p, dtype=torch.float64)
        root = pyro.param("root", lambda: eye.repeat(*runs, 1, 1), constraint=constraints.lower_cholesky)
        z = pyro.sample("_whole", MultivariateNormal(loc, scale_tril=root), infer={"is_auxiliary": True})
        values = {}
        for (name, law), part in zip(unknown.prior.items(), z.unbind(-1), strict=True):
            to = biject_to(law.support)
            value = to(part)
            values[name] = pyro.sample(name, Delta(value, log_density=-to.log_abs_det_jacobian(part, value)))
        return values

    def guide(record: Record) -> Values:
        if not apart:
            return numbers(torch.Size())
        with pyro.plate("runs", len(record.y)):
            return numbers(torch.Size([len(record.y)]))

    return guide
