"""Gradient-based inference of parameters with Pyro: NUTS and SVI.

Pyro's samplers use torch's global random state. It is seeded and restored here (`fork_rng`).
"""

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

from pfbench.core.parameter_checks import require_range
from pfbench.core.record import Record
from pfbench.ppl.parameter_posterior import ParameterPosterior
from pfbench.ppl.parameterised_model import ParameterisedModel, Values, check_inference_call

Program = Callable[[Record], Values]


class VariationalResult(NamedTuple):
    """The result of variational inference.

    Attributes:
        posterior: Draws from the variational guide.
        losses: Negative evidence lower bound after each step.
    """

    posterior: ParameterPosterior
    losses: list[float]


def nuts(
    program: Program,
    record: Record,
    draws: int,
    warmup: int,
    chains: int = 2,
    seed: int = 0,
    tick: Callable[[int, float], object] | None = None,
    first_chain: int = 0,
) -> ParameterPosterior:
    """Draw from a posterior with the no-U-turn sampler, chain after chain.

    Sites that are not scalar (the path of a latent program) are left out of the posterior.

    Args:
        program: Program with a differentiable likelihood.
        record: Measurements and inputs.
        draws: Draws of each chain.
        warmup: Warm-up steps of each chain.
        chains: Number of chains.
        seed: Seed of all random numbers.
        tick: Function that is called after each step of a chain with its number and the acceptance rate, for a progress bar.
        first_chain: Number of the first chain. With the seed it determines the random numbers of a chain.

    Returns:
        Draws and acceptance rates, and which draws end a divergent path.

    Raises:
        ValueError: If a count is too small, or an argument is of another class.
    """
    check_inference_call(
        "nuts", program=(program, Callable), record=(record, Record), draws=(draws, 1), warmup=(warmup, 0), chains=(chains, 1),
        seed=(seed, 0),
    )  # fmt: skip
    samples: list[dict[str, Tensor]] = []
    accepted, diverging = [], torch.zeros(chains, draws)

    def count(kernel: Any, _: Any, stage: str, i: int) -> None:
        if tick:
            done = i + 1 + (0 if stage.lower().startswith("warmup") else warmup)
            tick(done, float(kernel._mean_accept_prob))

    for row, chain in enumerate(range(first_chain, first_chain + chains)):
        with torch.random.fork_rng():
            torch.manual_seed(1000 * seed + chain)
            sampler = MCMC(
                NUTS(program),
                num_samples=draws,
                warmup_steps=warmup,
                disable_progbar=True,
                hook_fn=count,
            )
            sampler.run(record)
        samples.append({k: a for k, a in sampler.get_samples().items() if a.dim() <= 2})
        diagnostics = sampler.diagnostics()
        accepted.append(diagnostics["acceptance rate"]["chain 0"])
        diverging[row, diagnostics["divergences"]["chain 0"]] = 1.0
    stacked = {name: torch.stack([a[name] for a in samples]) for name in samples[0]}
    return ParameterPosterior(stacked, torch.tensor(accepted), "NUTS", {"diverging": diverging})


def svi(
    program: Program,
    record: Record,
    guide: Callable[[Record], Any],
    steps: int,
    draws: int,
    rate: float = 0.05,
    seed: int = 0,
    particles: int = 1,
) -> VariationalResult:
    """Run stochastic variational inference.

    Args:
        program: Program with a differentiable likelihood.
        record: Measurements and inputs.
        guide: Variational guide: one of Pyro's (`AutoMultivariateNormal(program)`) or
            `normal_guide`.
        steps: Steps of Adam; the learning rate falls to a tenth.
        draws: Draws from the guide at the end.
        rate: Initial learning rate.
        seed: Seed of all random numbers.
        particles: Draws for each gradient.

    Returns:
        Draws and losses.

    Raises:
        ValueError: If a value is out of range, or an argument is of another class.
    """
    check_inference_call(
        "svi", program=(program, Callable), record=(record, Record), guide=(guide, Callable), steps=(steps, 1), draws=(draws, 1),
        seed=(seed, 0), particles=(particles, 1),
    )  # fmt: skip
    require_range("svi.rate", rate, "(0, inf)")
    with torch.random.fork_rng(), pyro.get_param_store().scope():
        torch.manual_seed(seed)
        optimiser = ClippedAdam({"lr": rate, "lrd": 0.1 ** (1.0 / steps)})
        inference = SVI(program, guide, optimiser, Trace_ELBO(num_particles=particles))
        losses = [float(inference.step(record)) for _ in range(steps)]
        with torch.no_grad():
            samples = [guide(record) for _ in range(draws)]
    stacked = {name: torch.stack([a[name] for a in samples]).unsqueeze(0) for name in samples[0]}
    return VariationalResult(ParameterPosterior(stacked, method="SVI"), losses)


def normal_guide(
    unknown: ParameterisedModel, separate_parameters: bool = False, spread: float = 0.3
) -> Callable[[Record], Values]:
    """Build a variational guide: a normal distribution of unconstrained parameters.

    It has all covariances and starts at the medians of the prior.

    Args:
        unknown: Model and prior.
        separate_parameters: Whether each run has its own distribution, for programs whose runs have
            their own parameters. Pyro's guides offer one joint distribution, or independent
            parameters.
        spread: Initial standard deviation.

    Returns:
        Guide of a record.
    """
    p = len(unknown.prior)
    medians = unknown.unconstrained(unknown.draw(1001, 0)).median(0).values

    def sample_parameters(runs: torch.Size) -> Values:
        loc = pyro.param("loc", lambda: medians.expand(*runs, p).clone())
        eye = spread * torch.eye(p, dtype=torch.float64)
        lower = constraints.lower_cholesky
        root = pyro.param("root", lambda: eye.repeat(*runs, 1, 1), constraint=lower)
        normal = MultivariateNormal(loc, scale_tril=root)
        z = pyro.sample("_whole", normal, infer={"is_auxiliary": True})
        values = {}
        for (name, prior), column in zip(unknown.prior.items(), z.unbind(-1), strict=True):
            to_support = biject_to(prior.support)
            value = to_support(column)
            log_density = -to_support.log_abs_det_jacobian(column, value)
            values[name] = pyro.sample(name, Delta(value, log_density=log_density))
        return values

    def guide(record: Record) -> Values:
        if not separate_parameters:
            return sample_parameters(torch.Size())
        with pyro.plate("runs", len(record.y)):
            return sample_parameters(torch.Size([len(record.y)]))

    return guide
