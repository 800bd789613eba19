"""What one writes in an hour: the same filter in plain eager torch.

python naive.py float32|float64 WORKLOAD
"""

from __future__ import annotations

import math
import sys
from typing import Any

import torch
from worker import Filter, serve


def sir(work: Any, dtype: torch.dtype) -> Filter:
    """Bootstrap filter, systematic resampling by search at every step, mean, variance and effective sample size at every step."""
    step, p0, r, y = (torch.from_numpy(a).to(dtype) for a in (work.step, work.p0, work.r, work.y))
    seen = torch.from_numpy(work.seen)
    (runs, steps, _), n, d = y.shape, int(work.particles), len(p0)
    each_run = torch.arange(runs)[:, None]

    def run(seed: int) -> tuple[torch.Tensor, torch.Tensor]:
        chance = torch.Generator().manual_seed(seed)
        x = p0 * torch.randn(runs, n, d, dtype=dtype, generator=chance)
        w = torch.full((runs, n), 1.0 / n, dtype=dtype)
        log_z = torch.zeros(runs, dtype=torch.float64)
        means, variances, sizes = [], [], []
        for t in range(steps):
            u = (torch.arange(n) + torch.rand(runs, 1, dtype=dtype, generator=chance)) / n
            ancestors = torch.searchsorted(w.cumsum(1), u).clamp(max=n - 1)
            x = x[each_run, ancestors]
            noise = torch.randn(runs, n, d, dtype=dtype, generator=chance)
            x = x @ step[t, :, :d].T + noise @ step[t, :, d:].T
            log_w = torch.distributions.Normal(x[..., seen], r).log_prob(y[:, t, None]).sum(-1)
            log_z += log_w.logsumexp(1) - math.log(n)
            w = log_w.softmax(1)
            mean = (w[..., None] * x).sum(1)
            means.append(mean)
            sizes.append(1.0 / (w**2).sum(1))
            variances.append((w[..., None] * (x - mean[:, None]) ** 2).sum(1))
        return log_z, torch.stack(means, 1)

    return run


def contestant(work: Any) -> tuple[Filter, dict[str, str]]:
    torch.set_num_threads(1)
    return sir(work, getattr(torch, sys.argv[1])), {"torch": torch.__version__}


if __name__ == "__main__":
    serve(contestant)
