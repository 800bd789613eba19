"""Posterior Cramer-Rao bound (PCRB) of the mean square error of any filter.

The recursion uses square roots of covariances and does not invert the process noise covariance,
which may be singular:

    prediction  P = Q + F (J + C)^-1 F',  C = E[dF' Q^+ dF],  dF = F_run - F,  F = E[F_run]
    update      J = P^-1 + E[H' R^-1 H]

For a regular Q this is the published recursion, with D11 - D21 ... by the matrix inversion lemma.
For a singular Q it is its limit, which exists if dF = Q Q^+ dF: the noise reaches all directions in
which the Jacobians of the runs differ. [ours]

References:
    P. Tichavsky, C. Muravchik and A. Nehorai (1998), Posterior Cramer-Rao bounds for discrete-time
    nonlinear filtering.
"""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor
from torch.distributions import Independent, MultivariateNormal, Normal

from pfbench.core.linear_algebra import factor, jacobian
from pfbench.core.parameter_checks import require
from pfbench.core.record import Episode, Record, iterate_steps
from pfbench.model.base import ModelWrapper, StateSpaceModel, StaticModel, initial_law
from pfbench.noise.base import NominalNoise
from pfbench.results.store import Inputs
from pfbench.scenario.base import RecordingRegime
from pfbench.scenario.simulated import load_or_build

_TOLERANCE = 1e-9  # of differences between Jacobians, in predicted standard deviations


@torch.no_grad()
def compute_posterior_bound(
    model: StateSpaceModel,
    truth: Tensor,
    record: Record,
    initial: Tensor | None = None,
    run_by_run: bool = False,
) -> Tensor:
    """Compute the PCRB: a bound on the error covariance, in the chart at the truth.

    Expectations are means over the runs, with exact Jacobians along their true states. A component
    that is missing in some runs contributes its mean information. A state-dependent measurement
    covariance contributes information too. For a linear model each run has its own recursion, and
    the bound is the mean of the Kalman covariances.

    Returns lower bound of the error covariance at each step, [T, d, d]. Shapes: truth [R, T, D],
    initial [d, d].
    """
    converted = record.to(model.anchor)
    runs = len(record.y)
    x = _states(model, truth.to(model.anchor), converted)
    separate = model.linear or run_by_run
    root = _initial_root(_initial_covariance(model, converted, initial), runs, separate)
    record = model.prepare(record).to(model.anchor)
    bounds = root.new_empty(record.y.shape[1], *root.shape[1:])
    for t, step_model, step in iterate_steps(model, record):
        if not isinstance(step_model, StaticModel):
            root = _predict(model, root, x[:, t], step.u)
        root = _add_information(root, _pool(_information_rows(model, x[:, t + 1], step), separate))
        bounds[t] = (root @ root.mT).mean(0)
    return bounds


def _states(model: StateSpaceModel, truth: Tensor, record: Record) -> Tensor:
    """Return the true states [R, T + 1, D], with the initial states first."""
    runs, steps = record.y.shape[:2]
    start = model.origin.expand(runs, -1) if record.start is None else record.start
    require(
        truth.dim() == 3
        and truth.shape[1] in (steps, steps + 1)
        and (truth[:, 0].shape == start.shape),
        "truth",
        f"have shape {[runs, steps, model.chart.size]} for this record and {type(model).__name__}, or one more step with the initial states first",
        list(truth.shape),
        "Give the true states of the record.",
    )
    if model.linear:
        return start[:, None].expand(-1, steps + 1, -1)
    require(
        not bool(torch.isnan(truth).any()),
        "truth",
        f"be known at all steps for {type(model).__name__}, a nonlinear model",
        "NaN",
        "Leave the steps without truth out.",
    )
    return truth if truth.shape[1] > steps else torch.cat([start.unsqueeze(1), truth], 1)


def _initial_covariance(model: StateSpaceModel, record: Record, initial: Tensor | None) -> Tensor:
    """Return the initial covariance."""
    if initial is not None:
        return initial.to(model.anchor)
    distribution: Any = initial_law(model, record.y.shape[0], record.spread)
    if isinstance(distribution, MultivariateNormal):
        return distribution.covariance_matrix
    if isinstance(distribution, Independent) and isinstance(distribution.base_dist, Normal):
        return torch.diag_embed(distribution.variance)
    raise ValueError(
        f"{type(model).__name__}.initial must be a normal distribution, got "
        f"{type(distribution).__name__}. Give an initial covariance."
    )


def _initial_root(covariance: Tensor, runs: int, separate: bool) -> Tensor:
    """Return the root of the inverse mean information of the runs, [R or 1, d, d]."""
    root, valid = factor(covariance)
    require(
        bool((valid & (root.diagonal(dim1=-2, dim2=-1) > 0.0).all(-1)).all()),
        "initial",
        "be positive definite",
        "a covariance without square root",
        "Give another.",
    )
    if root.dim() == 2 or separate:
        return root.expand(runs if separate else 1, -1, -1)
    eye = torch.eye(root.shape[-1], dtype=root.dtype, device=root.device).expand_as(root)
    scale = root[:1].diagonal(dim1=-2, dim2=-1)  # removes the units of the states
    rows = torch.linalg.solve_triangular(root, eye, upper=False) * scale.unsqueeze(-2)
    triangle = torch.linalg.qr(_pool(rows, False), mode="r")[1]
    return scale.unsqueeze(-1) * torch.linalg.solve_triangular(triangle, eye[:1], upper=True)


def _predict(model: StateSpaceModel, root: Tensor, x: Tensor, u: Any) -> Tensor:
    """Return the root of the predicted bound [G, d, d], at states [R, D]."""
    chart, noise, gain = model.chart, cast(Any, model.noise), model.noise_gain(u)
    name = type(model.model if isinstance(model, ModelWrapper) else model).__name__
    require(
        gain is not None and isinstance(noise.base_dist, Normal),
        f"{name}: process noise",
        "be additive with a stated gain, and normal",
        "no gain" if gain is None else type(noise.base_dist).__name__,
        f"The bound needs {name}.noise_gain(u) and normal noise.",
    )
    gain = gain * noise.stddev

    def propagate(d: Tensor) -> Tensor:
        return model.propagate(chart.add(x.unsqueeze(1), d), u, noise.mean.expand(*d.shape[:2], -1))

    f = _jacobian(propagate, x, chart.dimension, chart.subtract)
    mean, mean_gain = (
        (f, gain) if len(root) == len(f) else (f.mean(0, keepdim=True), gain.mean(0, keepdim=True))
    )
    predicted = _root_of(torch.cat([mean @ root, mean_gain.expand(len(root), -1, -1)], -1))
    if len(root) == len(f):
        return predicted
    sd = predicted.norm(dim=-1, keepdim=True)
    deviation = (f - mean) @ root / sd  # [R, d, d] in predicted standard deviations
    inverse = torch.linalg.pinv(mean_gain / sd)
    unreached = deviation - (mean_gain / sd) @ (inverse @ deviation)
    require(
        not bool((unreached.abs() > _TOLERANCE).any())
        and (not bool((((gain - mean_gain) / sd).abs() > _TOLERANCE).any())),
        f"{type(model).__name__}: Jacobians",
        "differ between runs only where the noise reaches",
        "other differences",
        "Set run_by_run=True.",
    )
    if bool((deviation.abs() > _TOLERANCE).any()):
        root = _add_information(root, _pool(inverse @ ((f - mean) / sd), False))
        predicted = _root_of(torch.cat([mean @ root, mean_gain], -1))
    return predicted


def _information_rows(model: StateSpaceModel, x: Tensor, record: Record) -> Tensor:
    """Return rows A [R, k, d] with A' A the information of each run's measurement."""
    chart, residual = model.chart, model.residual

    def at(d: Tensor) -> Any:
        return model.observation(chart.add(x.unsqueeze(1), d), record.u)

    observed = ~torch.isnan(record.y)
    h = _jacobian(lambda d: at(d).mean, x, chart.dimension, residual)
    h = torch.where(observed.unsqueeze(-1), h, 0.0)
    distribution = at(x.new_zeros(len(x), 1, chart.dimension))
    if isinstance(distribution, Independent) and isinstance(distribution.base_dist, Normal):
        change = _jacobian(lambda d: at(d).base_dist.scale, x, chart.dimension, torch.sub)
        change = torch.where(observed.unsqueeze(-1), change, 0.0)
        scale = torch.cat([distribution.base_dist.scale] * 2, -1).mT
        return torch.cat([h, 2.0**0.5 * change], -2) / scale
    if isinstance(distribution, MultivariateNormal):
        change = _jacobian(
            lambda d: at(d).covariance_matrix.flatten(-2), x, chart.dimension, torch.sub
        )
        return _dense_information_rows(h, distribution.covariance_matrix[:, 0], change, observed)
    raise ValueError(
        f"{type(model).__name__}: measurement distribution must be normal, got "
        f"{type(distribution).__name__} (heavy tails, a mixture). The bound does not support this model."
    )


def _dense_information_rows(
    h: Tensor, covariance: Tensor, change: Tensor, observed: Tensor
) -> Tensor:
    """Return the information rows of a correlated distribution, from its Jacobians."""
    both = observed.unsqueeze(-1) & observed.unsqueeze(-2)
    eye = torch.eye(observed.shape[-1], dtype=h.dtype, device=h.device)
    root = torch.linalg.cholesky(torch.where(both, covariance, eye))
    white = torch.linalg.solve_triangular(root, h, upper=False)
    whitened = torch.where(
        both.unsqueeze(1), change.mT.unflatten(-1, eye.shape), 0.0
    )  # [R, d, k, k]
    for _ in range(2):  # L^-1 dR L^-T; half its square summed is 1/2 tr(R^-1 dR R^-1 dR)
        whitened = torch.linalg.solve_triangular(root.unsqueeze(1), whitened, upper=False).mT
    return torch.cat([white, whitened.flatten(-2).mT / 2.0**0.5], -2)


def _jacobian(
    f: Callable[[Tensor], Tensor],
    template: Tensor,
    d: int,
    subtract: Callable[[Tensor, Tensor], Tensor],
) -> Tensor:
    """Return the Jacobian [R, k, d] at 0 of a map of differences [R, P, d]."""
    return jacobian(f, f(template.new_zeros(len(template), 1, d)), d, subtract)


def _pool(rows: Tensor, separate: bool) -> Tensor:
    """Return rows [R, k, d] unchanged, or pooled as a mean, [1, R k, d]."""
    return rows if separate else rows.flatten(0, 1).unsqueeze(0) / len(rows) ** 0.5


def _add_information(root: Tensor, rows: Tensor) -> Tensor:
    """Return the root of (P^-1 + A' A)^-1 [G, d, d] from the root of P and rows A."""
    eye = torch.eye(root.shape[-1], dtype=root.dtype, device=root.device).expand_as(root)
    triangle = torch.linalg.qr(torch.cat([rows @ root, eye], -2), mode="r")[1]
    return torch.linalg.solve_triangular(triangle, root, upper=True, left=False)


def _root_of(wide: Tensor) -> Tensor:
    """Return a root A [G, d, d] with A A' = B B' of a wide matrix B [G, d, k]."""
    return torch.linalg.qr(wide.mT, mode="r")[1].mT


def compute_pcrb(
    values: Mapping[str, Any],
    model: StateSpaceModel,
    recording_regime: RecordingRegime,
    episode: Episode,
    runs: Tensor,
    inputs: Inputs | None = None,
) -> tuple[Tensor | None, str]:
    """Compute the posterior Cramér-Rao bound on the error of all filters.

    The bound belongs to the simulated noise regime, so it is computed for the oracle noise model,
    whether or not the filters receive it. Runs share a recursion where one exists, otherwise each
    run has a recursion. If filters start from a measurement outside the record, the bound starts
    from the initial distribution of the model. The result is cached by all that decides it,
    including the source file of the model.

    Args:
        values: Resolved configuration of the job.
        model: Model of the filter, on the CPU in double precision, without oracle noise.
        recording_regime: Noise regime, after the episode was drawn.
        episode: Episode of the runs.
        runs: Numbers of the runs, [R].
        inputs: Inputs of the job, see `find_inputs`.

    Returns:
        Standard deviations [T, d], in the units of the state, and a description. Otherwise None
        and the reason.
    """
    reason = _missing_reason(values, episode)
    if reason:
        return None, reason
    is_nominal = isinstance(recording_regime.regime, NominalNoise)
    try:
        oracle = model if is_nominal else recording_regime.to_oracle_model(model, episode.time)
    except ValueError:
        return None, "no bound: the errors of this noise regime have no distribution per step"
    is_replaced = episode.record.spread is not None
    initial = torch.diag_embed(model.initial(1).variance[0]) if is_replaced else None

    def compute() -> dict[str, Tensor]:
        truth, is_separate = oracle.assemble(episode.truth), model.linear
        try:
            covariance = compute_posterior_bound(oracle, truth, episode.record, initial)
        except ValueError:  # without a shared recursion; the second call raises the other reasons
            is_separate = True
            covariance = compute_posterior_bound(
                oracle, truth, episode.record, initial, run_by_run=True
            )
        sd = covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
        return {"pcrb": sd.contiguous(), "is_separate": torch.tensor(is_separate)}

    try:
        result = load_or_build(
            values["episode_cache_dir"], _recipe(values, model, runs, inputs or {}), compute
        )
    except ValueError as error:
        wrapper = "" if is_nominal else f"{type(oracle).__name__}: "
        return None, "no bound: " + f"{error}".removeprefix(wrapper)
    oracle_text = "" if is_nominal else " with oracle noise"
    method = "mean over the runs" if bool(result["is_separate"]) else "one recursion for all runs"
    start = ", from the model's own initial distribution" if is_replaced else ""
    return result["pcrb"], f"posterior Cramer-Rao bound of the model{oracle_text}, {method}{start}"


def _recipe(
    values: Mapping[str, Any], model: StateSpaceModel, runs: Tensor, inputs: Inputs
) -> tuple[object, ...]:
    """Return all that decides the bound."""
    scenario = {**values["scenario"], "root": None, "cache_dir": None}
    source = Path(inspect.getfile(type(model))).read_bytes()
    source_hash = hashlib.sha256(source).hexdigest()
    episodes = values["noise"], values["seed"], int(runs[0]), len(runs)
    read = {group: inputs[group] for group in ("scenario", "noise", "model") if group in inputs}
    return ("bound 1", source_hash, values["model"], scenario, *episodes, *([read] if read else []))


def _missing_reason(values: Mapping[str, Any], episode: Episode) -> str:
    """Return why the bound is not computed, or an empty text."""
    if values["pcrb"] is False:
        return "no bound: not requested (pcrb=false)"
    if values["pcrb"] is True:
        return ""
    if "root" in values["scenario"]:
        return "no bound: the distributions of recorded errors are unknown"
    if episode.record.feedback is not None:
        return "no bound: the filter's estimates change the INS output (closed loop)"
    for name, value in values["model"].items():
        if name in ("inflation", "process_noise_factor") and value not in (None, 1.0):
            return (
                "no bound: the process noise of the model is larger than the simulated one "
                f"(model.{name})"
            )
    return ""
