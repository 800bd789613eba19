"""Clock of a GNSS receiver: bias and drift in metres."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from pfbench.core.random_stream import RandomStream


@dataclass(frozen=True)
class ReceiverClock:
    """A receiver clock in metres: b' = d + white noise, d' = white noise.

    Bias b and drift d [Brown and Hwang 2012, section 9.3].

    Attributes:
        bias_sd: Standard deviation of the initial bias, m.
        drift_sd: Standard deviation of the initial drift, m/s.
        bias_walk: Root density of the bias noise, m/sqrt(s).
        drift_walk: Root density of the drift noise, (m/s)/sqrt(s).

    Raises:
        ValueError: If a size is not positive.
    """

    bias_sd: float = 30.0
    drift_sd: float = 1.0
    bias_walk: float = 0.3
    drift_walk: float = 0.03

    def __post_init__(self) -> None:
        for name in (field.name for field in fields(self)):
            if not getattr(self, name) > 0.0:
                raise ValueError(
                    f"receiver.clock.{name} must be positive, got {getattr(self, name)}. Change it."
                )

    def noise_gain(self, duration: Tensor) -> Tensor:
        """Compute the noise root of (bias, drift) over durations [...] s: [..., 2, 2].

        The matrix is lower triangular.
        """
        q_b, q_d = self.bias_walk**2, self.drift_walk**2
        bias = torch.sqrt(q_b * duration + q_d * duration**3 / 3)
        cross = torch.where(
            bias > 0, 0.5 * q_d * duration**2 / torch.where(bias > 0, bias, 1.0), 0.0
        )
        drift = torch.sqrt((q_d * duration - cross**2).clamp(min=0))
        return torch.stack([bias, torch.zeros_like(bias), cross, drift], -1).unflatten(-1, (2, 2))

    def simulate(self, duration: Tensor, process: Tensor, draws: RandomStream) -> Tensor:
        """Simulate bias and drift at the ends of intervals, exact at any duration.

        Args:
            duration: Duration of the intervals, [T], s.
            process: Factor on the variance of the noise, [T].
            draws: Random stream, labels "world.clock*". It decides the runs.

        Returns:
            Bias and drift, [R, T, 2], m and m/s.
        """
        start = draws.normal("world.clock.start", 1, 2)
        noise = draws.normal("world.clock", len(duration), 2).unsqueeze(-1)
        noise = (self.noise_gain(duration) @ noise).squeeze(-1) * process.sqrt()[:, None]
        drift = self.drift_sd * start[..., 1] + torch.cumsum(noise[..., 1], -1)
        before = torch.cat([self.drift_sd * start[..., 1], drift[:, :-1]], -1)
        bias = self.bias_sd * start[..., 0] + torch.cumsum(before * duration + noise[..., 0], -1)
        return torch.stack([bias, drift], -1)
