"""k-hat of weights: numbers of ArviZ, a loop in NumPy, and what is no tail."""

import math

import numpy as np
import pytest
import torch

from pfbench.filter.health import fit_pareto_k

# ArviZ 0.23.4, `arviz.stats.psislw`, of the weights u^-k, -log u and u with u = (i - 1/2) / n
ARVIZ = {
    (30, "0.2"): 0.3580254793, (30, "1.8"): 0.7904629099,
    (200, "0.2"): 0.2757741926, (200, "0.6"): 0.5683599981, (200, "1.0"): 0.8608407853,
    (1000, "0.6"): 0.5838651961, (1000, "1.8"): 1.625349802,
    (200, "exponential"): 0.1284932928, (1000, "exponential"): 0.0630300799,
    (30, "uniform"): 0.0275547960, (1000, "uniform"): -0.8192112494,
}  # fmt: skip


def log_weights(n: int, kind: str) -> np.ndarray:
    log_u = np.log((np.arange(n) + 0.5) / n)
    if kind in ("exponential", "uniform"):
        return np.log(-log_u) if kind == "exponential" else log_u
    return -float(kind) * log_u


def by_loops(log_w: np.ndarray) -> float:
    """Zhang and Stephens 2009 for the tail of PSIS, number by number."""
    n = len(log_w)
    size = math.ceil(min(0.2 * n, 3.0 * math.sqrt(n)))
    w = sorted(math.exp(a - max(log_w)) for a in log_w)
    x = [a - w[-size - 1] for a in w[-size:]]
    count, quartile = 30 + int(math.sqrt(size)), x[int(size / 4 + 0.5) - 1]
    rows = []
    for i in range(1, count + 1):
        b = 1.0 / x[-1] + (1.0 - math.sqrt(count / (i - 0.5))) / (3.0 * quartile)
        k = sum(math.log1p(-b * a) for a in x) / size
        rows.append((b, size * (math.log(-b / k) - k - 1.0)))
    top = max(value for _, value in rows)
    weights = [math.exp(value - top) for _, value in rows]
    b = sum(w * b for w, (b, _) in zip(weights, rows, strict=True)) / sum(weights)
    k = sum(math.log1p(-b * a) for a in x) / size
    return (size * k + 10.0 * 0.5) / (size + 10.0)


@pytest.mark.parametrize(("n", "kind"), ARVIZ)
def test_it_is_that_of_arviz(n: int, kind: str) -> None:
    log_w = torch.tensor(log_weights(n, kind))
    k = fit_pareto_k(torch.stack([log_w, log_w.flip(0) - 700.0]))
    np.testing.assert_allclose(k, ARVIZ[n, kind], rtol=0, atol=2e-9)


def test_it_is_that_of_loops_run_by_run() -> None:
    rng = np.random.default_rng(1)
    log_w = np.stack([s * rng.normal(size=150) for s in (0.3, 1.0, 3.0, 10.0)])
    expected = [by_loops(row) for row in log_w]
    np.testing.assert_allclose(fit_pareto_k(torch.tensor(log_w)), expected, rtol=1e-9)
    single = fit_pareto_k(torch.tensor(log_w, dtype=torch.float32))
    np.testing.assert_allclose(single, expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    ("log_w", "expected"),
    [
        (torch.zeros(100), math.nan),  # equal weights have no tail
        (torch.full((100,), -math.inf), math.nan),
        (torch.cat([torch.zeros(95), torch.arange(5.0)]), math.nan),  # most of the tail is equal
        (torch.randn(20, generator=torch.Generator().manual_seed(1)), math.nan),  # 4 weights
        (-2000.0 * torch.arange(100.0), math.inf),  # one weight is all there is
        (torch.cat([torch.zeros(1), torch.full((99,), -math.inf)]), math.inf),
    ],
)
def test_what_is_no_tail_has_no_shape(log_w: torch.Tensor, expected: float) -> None:
    np.testing.assert_equal(fit_pareto_k(log_w.double()[None]).numpy(), [expected])
