"""Means, covariances and their square roots."""

from __future__ import annotations

import torch
from torch import Tensor

from pfbench.chart import Chart
from pfbench.filter.belief import Cloud, weights


def moments(chart: Chart, cloud: Cloud) -> tuple[Tensor, Tensor]:
    """Weighted mean [R, D] and covariance [R, d, d] of a cloud, the latter in the chart about the mean."""
    w = weights(cloud.log_w)
    mean = chart.mean(cloud.x, w)
    d = chart.subtract(cloud.x, mean.unsqueeze(1))
    return mean, (w.unsqueeze(-1) * d).mT @ d


def factor(covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Lower triangular A with A A' = covariance, and whether it exists: [..., d, d] -> [..., d, d], bool [...].

    Works on the correlation matrix, so that metres beside radians do no harm. Where rounding has left it slightly
    indefinite, or a component has no spread at all, a relative 1e-12 (1e-6 in float32) is added to the diagonal; a
    covariance that this does not heal is reported, never repaired in silence.
    """
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    sd = torch.sqrt(torch.where(variance > 0, variance, 1.0))
    correlation = covariance / (sd.unsqueeze(-1) * sd.unsqueeze(-2))
    jitter = 1e-6 if covariance.dtype == torch.float32 else 1e-12
    eye = torch.eye(covariance.shape[-1], dtype=covariance.dtype, device=covariance.device)
    plain, info = torch.linalg.cholesky_ex(correlation)
    healed, still = torch.linalg.cholesky_ex(correlation + jitter * eye)
    lower = torch.where((info == 0)[..., None, None], plain, healed)
    ok = ((info == 0) | (still == 0)) & (variance >= 0).all(-1)
    return sd.unsqueeze(-1) * lower, ok
