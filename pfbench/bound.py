"""The posterior Cramer-Rao bound: no filter's mean square error can be smaller [Tichavsky, Muravchik, Nehorai 1998].

The recursion works on square roots of covariances and never inverts the process noise, which may be singular:

    before the measurement  P = Q + F (J + C)^-1 F',  C = E[dF' Q^+ dF],  dF = F_run - F,  F = E[F_run]
    after it                J = P^-1 + E[H' R^-1 H]

With a regular Q this is the published recursion, its D11 - D21 ... by the matrix inversion lemma; with a singular one it is its
limit, which exists where the noise reaches all that the Jacobians of the runs differ in (dF = Q Q^+ dF). [ours]
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import torch
from torch import Tensor
from torch.distributions import Independent, MultivariateNormal, Normal

from pfbench.covariance import factor
from pfbench.derivatives import slopes
from pfbench.model.base import StateSpaceModel, initial_law
from pfbench.record import Record

_SAME = 1e-9  # Jacobians that differ by less, in predicted standard deviations, are the same


@torch.no_grad()
def posterior_bound(
    model: StateSpaceModel, truth: Tensor, record: Record, initial: Tensor | None = None, run_by_run: bool = False
) -> Tensor:
    """The bound on the covariance of any filter's error, in the chart about the truth: [T, d, d].

    Expectations are means over the runs at hand, with exact Jacobians along their true states. What a
    measurement component that is missing (NaN) in some runs tells is the mean over the runs. A normal law whose covariance
    depends on the state informs by that too. On a linear model each run has its own recursion and the bound is the mean of the
    runs' Kalman covariances.

    Args:
        model: whose laws are those of the world. A world that is otherwise (heavy tails, a swollen process noise, a model that
            is mismatched on purpose) has another bound, or none that is known here: ask with the model that is told, if any.
        truth: true states [R, T, D]; or [R, T + 1, D] with the initial ones first, of use where the map is not linear, which
            else is first differentiated at the centre of the initial law. A linear model does not look at it.
        record: measurements, of which only the missing ones count, and inputs.
        initial: covariance of the initial law in the chart [d, d] or [R, d, d]; None is what filters are told (the record's
            spread, else the model's initial law).
        run_by_run: each run its own recursion, given its inputs and its truth, and the mean of the covariances: for models whose
            Jacobians differ between runs by more than the noise reaches. Exact where the runs differ in their known inputs alone
            and the model is linear in the state; otherwise the bound of a known trajectory [Taylor 1979], which may lie slightly
            above the posterior one.

    Raises:
        ValueError: laws that are not normal, noise that is not additive, a truth that is not known or does not fit, an initial
            covariance without square root, or Jacobians for which there is no common bound.
    """
    told = record.to(model.anchor)
    runs, steps = record.y.shape[:2]
    x = _states(model, truth.to(model.anchor), told)
    apart = model.linear or run_by_run
    root = _initial_root(_initial_covariance(model, told, initial), runs, apart)
    record = model.prepare(record).to(model.anchor)
    bounds = []
    for t in range(steps):
        seen = record.at(t)
        if t > 0 or not model.observes_initial:
            root = _predict(model, root, x[:, t], seen.u)
        root = _learn(root, _pooled(_looks(model, x[:, t + 1], seen), apart))
        bounds.append((root @ root.mT).mean(0))
    return torch.stack(bounds)


def _states(model: StateSpaceModel, truth: Tensor, record: Record) -> Tensor:
    """True states [R, T + 1, D], the initial ones first."""
    runs, steps = record.y.shape[:2]
    start = model.origin.expand(runs, -1) if record.start is None else record.start
    if truth.dim() != 3 or truth.shape[1] not in (steps, steps + 1) or truth[:, 0].shape != start.shape:
        raise ValueError(
            f"truth: shape {list(truth.shape)}; the record and {type(model).__name__} need {[runs, steps, model.chart.size]}, or "
            "one instant more with the initial states first"
        )
    if model.linear:
        return start[:, None].expand(-1, steps + 1, -1)
    if bool(torch.isnan(truth).any()):
        raise ValueError(f"truth: {type(model).__name__} is not linear, and some of its true states are not known: no bound")
    return truth if truth.shape[1] > steps else torch.cat([start.unsqueeze(1), truth], 1)


def _initial_covariance(model: StateSpaceModel, record: Record, initial: Tensor | None) -> Tensor:
    if initial is not None:
        return initial.to(model.anchor)
    law: Any = initial_law(model, record.y.shape[0], record.spread)
    if isinstance(law, MultivariateNormal):
        return law.covariance_matrix
    if isinstance(law, Independent) and isinstance(law.base_dist, Normal):
        return torch.diag_embed(law.variance)
    raise ValueError(f"{type(model).__name__}: its initial law is no normal one; give the bound an initial covariance")


def _initial_root(covariance: Tensor, runs: int, apart: bool) -> Tensor:
    """Root of the inverse of the mean information of the runs, [R or 1, d, d]."""
    root, ok = factor(covariance)
    if not bool((ok & (root.diagonal(dim1=-2, dim2=-1) > 0.0).all(-1)).all()):
        raise ValueError("initial: a covariance without square root; give a positive definite one")
    if root.dim() == 2 or apart:
        return root.expand(runs if apart else 1, -1, -1)
    eye = torch.eye(root.shape[-1], dtype=root.dtype, device=root.device).expand_as(root)
    scale = root[:1].diagonal(dim1=-2, dim2=-1)  # of the states' units, so that none drowns the others
    rows = torch.linalg.solve_triangular(root, eye, upper=False) * scale.unsqueeze(-2)
    triangle = torch.linalg.qr(_pooled(rows, False), mode="r")[1]
    return scale.unsqueeze(-1) * torch.linalg.solve_triangular(triangle, eye[:1], upper=True)


def _predict(model: StateSpaceModel, root: Tensor, x: Tensor, u: Any) -> Tensor:
    """Root of the bound before the next measurement [G, d, d], from that at the true states x [R, D]; G groups of runs."""
    chart, law = model.chart, cast(Any, model.noise)
    gain = model.noise_gain(u)
    if gain is None or not isinstance(law.base_dist, Normal):
        raise ValueError(f"{type(model).__name__}: its process noise is not additive and normal, and so there is no bound here")
    gain = gain * law.stddev

    def moved(d: Tensor) -> Tensor:
        return model.propagate(chart.add(x.unsqueeze(1), d), u, law.mean.expand(*d.shape[:2], -1))

    f = _slopes(moved, x, chart.dimension, chart.subtract)
    mean, noise = (f, gain) if len(root) == len(f) else (f.mean(0, keepdim=True), gain.mean(0, keepdim=True))
    grown = _root_of(torch.cat([mean @ root, noise.expand(len(root), -1, -1)], -1))
    if len(root) == len(f):
        return grown
    sd = grown.norm(dim=-1, keepdim=True)
    strange = (f - mean) @ root / sd  # [R, d, d] in predicted standard deviations
    inverse = torch.linalg.pinv(noise / sd)
    left = strange - (noise / sd) @ (inverse @ strange)
    if bool((left.abs() > _SAME).any()) or bool((((gain - noise) / sd).abs() > _SAME).any()):
        raise ValueError(
            f"{type(model).__name__}: its Jacobians differ between runs where the process noise does not reach, and so there is "
            "no common bound; ask for run_by_run=True"
        )
    if bool((strange.abs() > _SAME).any()):
        root = _learn(root, _pooled(inverse @ ((f - mean) / sd), False))
        grown = _root_of(torch.cat([mean @ root, noise], -1))
    return grown


def _looks(model: StateSpaceModel, x: Tensor, seen: Record) -> Tensor:
    """Rows A [R, k, d] with A' A what each run's measurement tells of its state: H' R^-1 H, and what R tells by itself."""
    chart, residual = model.chart, model.residual

    def at(d: Tensor) -> Any:
        return model.observation(chart.add(x.unsqueeze(1), d), seen.u)

    there = ~torch.isnan(seen.y)
    h = _slopes(lambda d: at(d).mean, x, chart.dimension, residual)
    h = torch.where(there.unsqueeze(-1), h, 0.0)
    law = at(x.new_zeros(len(x), 1, chart.dimension))
    if isinstance(law, Independent) and isinstance(law.base_dist, Normal):
        change = _slopes(lambda d: at(d).base_dist.scale, x, chart.dimension, torch.sub)
        change = torch.where(there.unsqueeze(-1), change, 0.0)
        return torch.cat([h, 2.0**0.5 * change], -2) / torch.cat([law.base_dist.scale] * 2, -1).mT
    if isinstance(law, MultivariateNormal):
        change = _slopes(lambda d: at(d).covariance_matrix.flatten(-2), x, chart.dimension, torch.sub)
        return _dense_looks(h, law.covariance_matrix[:, 0], change, there)
    raise ValueError(
        f"{type(model).__name__}: its measurement law is {type(law).__name__}, not normal (heavy tails, a mixture); what such a "
        "measurement tells is not defined here, and so there is no bound"
    )


def _dense_looks(h: Tensor, covariance: Tensor, change: Tensor, there: Tensor) -> Tensor:
    """The same for a correlated law, from slopes of its mean [R, k, d] and its covariance [R, k k, d]."""
    both = there.unsqueeze(-1) & there.unsqueeze(-2)
    eye = torch.eye(there.shape[-1], dtype=h.dtype, device=h.device)
    root = torch.linalg.cholesky(torch.where(both, covariance, eye))
    white = torch.linalg.solve_triangular(root, h, upper=False)
    turned = torch.where(both.unsqueeze(1), change.mT.unflatten(-1, eye.shape), 0.0)  # [R, d, k, k]
    for _ in range(2):  # L^-1 dR L^-T; half its square summed is 1/2 tr(R^-1 dR R^-1 dR)
        turned = torch.linalg.solve_triangular(root.unsqueeze(1), turned, upper=False).mT
    return torch.cat([white, turned.flatten(-2).mT / 2.0**0.5], -2)


def _slopes(f: Callable[[Tensor], Tensor], like: Tensor, d: int, subtract: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """Jacobian [R, k, d] at 0 of a map of differences [R, P, d], its values differing by `subtract`."""
    return slopes(f, f(like.new_zeros(len(like), 1, d)), d, subtract)


def _pooled(rows: Tensor, apart: bool) -> Tensor:
    """Rows of all runs [R, k, d] as those of one group [1, R k, d], with the weight of a mean; or as they are."""
    return rows if apart else rows.flatten(0, 1).unsqueeze(0) / len(rows) ** 0.5


def _learn(root: Tensor, rows: Tensor) -> Tensor:
    """Root of (P^-1 + A' A)^-1 from that of P [G, d, d] and the rows A [G, k, d]."""
    eye = torch.eye(root.shape[-1], dtype=root.dtype, device=root.device).expand_as(root)
    triangle = torch.linalg.qr(torch.cat([rows @ root, eye], -2), mode="r")[1]
    return torch.linalg.solve_triangular(triangle, root, upper=True, left=False)


def _root_of(wide: Tensor) -> Tensor:
    """Square root A with A A' = B B' of a wide B: [G, d, k] -> [G, d, d]."""
    return torch.linalg.qr(wide.mT, mode="r")[1].mT
