"""The library `cuthbert` [JAX]. Runs in an environment of its own.

    python peer_cuthbert.py WORKLOAD

Its particle filter, jitted with the loop around it and all runs by vmap; it keeps the clouds of all steps, of which means and
variances are then taken. Its resampling acts before a step; log weights come unnormalised, as it leaves them.
"""

from __future__ import annotations

import os
from importlib.metadata import version
from typing import Any

os.environ.setdefault(
    "XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
)

import jax
import jax.numpy as jnp
import numpy as np
from cuthbert.filtering import filter as filtered
from cuthbert.smc.particle_filter import build_filter
from cuthbertlib.resampling import systematic
from problems import Problem
from worker import Filter, serve


def sir(work: Any) -> Filter:
    n, problem = int(work.particles), Problem(work, jnp, lambda a: jnp.asarray(a, jnp.float32))
    runs, steps, _ = problem.y.shape

    def first(key: Any) -> Any:
        return problem.initial(jax.random.normal(key, (problem.d,)))

    def move(key: Any, x: Any, given: Any) -> Any:
        return problem.move(given[0], x, jax.random.normal(key, (problem.w,)))

    def weigh(before: Any, x: Any, given: Any) -> Any:
        return problem.log_like(given[1], x)

    smc = build_filter(first, move, weigh, n, systematic.resampling)

    def one(key: Any, y: Any) -> Any:
        begun, rest = jax.random.split(key)
        states = filtered(smc, (jnp.arange(steps), y), smc.init_prepare(key=begun), key=rest)
        w, x = jax.nn.softmax(states.log_weights[1:], axis=-1), states.particles[1:]
        mean = jnp.einsum("tn,tnd->td", w, x)
        variance = jnp.einsum("tn,tnd->td", w, (x - mean[:, None]) ** 2)
        return states.log_normalizing_constant[-1], mean, variance, 1.0 / (w**2).sum(-1)

    every = jax.jit(lambda keys, ys: jax.lax.map(lambda a: one(*a), (keys, ys)))

    def run(seed: int) -> tuple[np.ndarray, np.ndarray]:
        total, mean, _, _ = jax.block_until_ready(
            every(jax.random.split(jax.random.key(seed), runs), problem.y)
        )
        return np.asarray(total), np.asarray(mean)

    return run


def contestant(work: Any) -> tuple[Filter, dict[str, str]]:
    return sir(work), {name: version(name) for name in ("cuthbert", "jax")}


if __name__ == "__main__":
    serve(contestant)
