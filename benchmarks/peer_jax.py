"""What one writes in plain JAX: one jitted scan over the steps. Runs in an environment of its own.

    python peer_jax.py vmap|loop search|count float32|float64 WORKLOAD

`vmap` takes all runs at once, `loop` one after the other. `search` finds ancestors by binary search, `count` by a sum over
the numbers of descendants, without a search.
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


def by_search(place: Any, w: Any, n: int) -> Any:
    """Ancestors of systematic resampling by binary search."""
    positions = (jnp.arange(n) + place) / n
    return jnp.clip(jnp.searchsorted(jnp.cumsum(w), positions), 0, n - 1)


def by_count(place: Any, w: Any, n: int) -> Any:
    """The same by counting: each weight's last descendant, then a sum."""
    cdf = jnp.cumsum(w)
    last = jnp.clip(jnp.ceil(cdf / cdf[-1] * n - place), 0, n).astype(jnp.int32)
    count = jnp.zeros(n + 1, jnp.int32).at[last].add(1)
    return jnp.minimum(jnp.cumsum(count)[:-1], n - 1)


def sir(work: Any) -> Filter:
    dtype = getattr(jnp, sys.argv[3])
    n, problem = int(work.particles), Problem(work, jnp, lambda a: jnp.asarray(a, dtype))
    resample = {"search": by_search, "count": by_count}[sys.argv[2]]
    y = problem.y
    runs, steps, _ = y.shape

    def step(carry: Any, given: Any) -> Any:
        x, w, total = carry
        t, seen, key = given
        chance, place = jax.random.split(key)
        ancestors = resample(jax.random.uniform(place, dtype=dtype), w, n)
        x = problem.move(t, x[ancestors], jax.random.normal(chance, (n, problem.w), dtype))
        log_w = problem.log_like(seen, x)
        rise = jax.nn.logsumexp(log_w)
        w = jnp.exp(log_w - rise)
        mean = w @ x
        variance = w @ (x - mean) ** 2
        return (x, w, total + rise - jnp.log(n)), (mean, variance, 1.0 / (w @ w))

    def one(key: Any, seen: Any) -> Any:
        first, rest = jax.random.split(key)
        x = problem.initial(jax.random.normal(first, (n, problem.d), dtype))
        start = (x, jnp.full(n, 1.0 / n, dtype), jnp.zeros((), dtype))
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
    jax.config.update("jax_enable_x64", sys.argv[3] == "float64")
    serve(contestant)
