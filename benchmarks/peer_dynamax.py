"""dynamax: its sigma-point filter with the cubature rule, jitted, all runs by vmap. Runs in an environment of its own.

    python peer_dynamax.py WORKLOAD

alpha = 1, beta = kappa = 0 give the middle point no weight: that is the cubature rule. Its first law is that of the first
measured state, hence the first prediction by hand. Double precision: the variances span ten decades.
"""

from __future__ import annotations

import os
from importlib.metadata import version
from typing import Any

os.environ.setdefault(
    "XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
)
os.environ["JAX_ENABLE_X64"] = "1"

import jax
import jax.numpy as jnp
import numpy as np
from dynamax.nonlinear_gaussian_ssm import ParamsNLGSSM, UKFHyperParams, unscented_kalman_filter
from worker import Filter, serve


def ckf(work: Any) -> Filter:
    d = len(work.p0)
    phi, gain = work.step[:, :, :d], work.step[:, :, d:]
    noise = gain @ gain.transpose(0, 2, 1)
    first = phi[0] @ np.diag(work.p0**2) @ phi[0].T + noise[0]
    ahead = jnp.asarray(
        np.concatenate([phi[1:], phi[-1:]]).reshape(len(phi), -1)
    )  # of the step after this one
    seen = jnp.asarray(work.seen)
    params = ParamsNLGSSM(
        initial_mean=jnp.zeros(d),
        initial_covariance=jnp.asarray(0.5 * (first + first.T)),
        dynamics_function=lambda x, u: u.reshape(d, d) @ x,
        dynamics_covariance=jnp.asarray(np.concatenate([noise[1:], noise[-1:]])),
        emission_function=lambda x, u: x[seen],
        emission_covariance=jnp.asarray(np.diag(work.r**2)),
    )
    rule = UKFHyperParams(alpha=1.0, beta=0.0, kappa=0.0)

    def one(y: Any) -> Any:
        found = unscented_kalman_filter(params, y, rule, inputs=ahead)
        return (
            found.marginal_loglik,
            found.filtered_means,
            jnp.diagonal(found.filtered_covariances, axis1=1, axis2=2),
        )

    every, y = jax.jit(jax.vmap(one)), jnp.asarray(work.y)

    def run(seed: int) -> tuple[np.ndarray, np.ndarray]:
        log_z, mean, _ = jax.block_until_ready(every(y))
        return np.asarray(log_z), np.asarray(mean)

    return run


def contestant(work: Any) -> tuple[Filter, dict[str, str]]:
    return ckf(work), {name: version(name) for name in ("dynamax", "jax")}


if __name__ == "__main__":
    serve(contestant)
