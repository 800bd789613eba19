"""What one writes in plain JAX: one jitted scan over the steps, in single precision. Runs in an environment of its own.

    python peer_jax.py vmap|loop WORKLOAD

`vmap` takes all runs at once, `loop` one after the other.
"""

from __future__ import annotations

import os
import sys
from typing import Any

os.environ.setdefault(
    "XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
)

import jax
import jax.numpy as jnp
import numpy as np
from problems import Problem
from worker import Filter, serve


def sir(work: Any) -> Filter:
    n, problem = int(work.particles), Problem(work, jnp, lambda a: jnp.asarray(a, jnp.float32))
    y = problem.y
    runs, steps, _ = y.shape

    def step(carry: Any, given: Any) -> Any:
        x, w, total = carry
        t, seen, key = given
        chance, place = jax.random.split(key)
        positions = (jnp.arange(n) + jax.random.uniform(place)) / n
        ancestors = jnp.clip(jnp.searchsorted(jnp.cumsum(w), positions), 0, n - 1)
        x = problem.move(t, x[ancestors], jax.random.normal(chance, (n, problem.w)))
        log_w = problem.log_like(seen, x)
        rise = jax.nn.logsumexp(log_w)
        w = jnp.exp(log_w - rise)
        mean = w @ x
        variance = w @ (x - mean) ** 2
        return (x, w, total + rise - jnp.log(n)), (mean, variance, 1.0 / (w @ w))

    def one(key: Any, seen: Any) -> Any:
        first, rest = jax.random.split(key)
        x = problem.initial(jax.random.normal(first, (n, problem.d)))
        start = (x, jnp.full(n, 1.0 / n), jnp.zeros(()))
        (_, _, total), told = jax.lax.scan(
            step, start, (jnp.arange(steps), seen, jax.random.split(rest, steps))
        )
        return total, told

    in_turn = jax.jit(lambda keys, ys: jax.lax.map(lambda a: one(*a), (keys, ys)))
    every = jax.jit(jax.vmap(one)) if sys.argv[1] == "vmap" else in_turn

    def run(seed: int) -> tuple[np.ndarray, np.ndarray]:
        total, (mean, _, _) = jax.block_until_ready(
            every(jax.random.split(jax.random.key(seed), runs), y)
        )
        return np.asarray(total), np.asarray(mean)

    return run


def contestant(work: Any) -> tuple[Filter, dict[str, str]]:
    return sir(work), {"jax": jax.__version__}


if __name__ == "__main__":
    serve(contestant)
