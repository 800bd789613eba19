"""Command `pfbench new`: write a script of your own filter, proposal, model, scenario, noise regime or log."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Sequence
from pathlib import Path

from pfbench.cli.command import Command
from pfbench.cli.messages import require_choice
from pfbench.core.parameter_checks import require


def write_script(words: Sequence[str]) -> None:
    """Write the script of a part."""
    require(
        len(words) == 2,
        "new",
        "have a kind and a name",
        " ".join(words) or "none",
        "Use: pfbench new filter NAME",
    )
    kind, name = words
    require_choice("kind", kind, list(SCRIPTS))
    plain = re.sub(r"\W", "_", name.lower())
    require(
        name.isidentifier() and name.islower(),
        "name",
        "be of lower-case letters, digits and underscores",
        name,
        f"Use {plain if plain.isidentifier() else f'my_{kind}'}.",
    )
    path = Path(f"{name}.py")
    require(not path.exists(), path, "not exist", "a file", "Choose another name.")
    require(
        importlib.util.find_spec(name) is None and kind != name,
        "name",
        "not be that of an installed package or of its kind",
        name,
        f"Use my_{name}.",
    )
    title = "".join(word.capitalize() for word in name.split("_"))
    path.write_text(SCRIPTS[kind].replace("TITLE", title).replace("NAME", name), encoding="utf-8")
    print(f"script: {path.resolve()}\nNext: python {path}")


# NAME and TITLE are replaced by the name of the file and of the class.

_END = """

if __name__ == "__main__":
    print(pfbench.check(TITLE()))
    study = pfbench.run("growth", ["ekf", "sir", "rpf", TITLE()], runs=50, study="NAME")
    print(study.summary())
    print(study.compare("NAME", "sir"))
    print(study.report())
"""
_FILTER = '''"""TITLE: a particle filter with a weight update of its own."""

from dataclasses import dataclass

import pfbench


@dataclass(frozen=True)
class TITLE:
    """Bayes' rule with a power of the likelihood, for robustness against outliers."""

    power: float = 0.8
    is_exact = False  # the target is not the posterior

    def __call__(self, model, log_w, x, log_ratio, record):
        """Return log weights [R, N] of particles x [R, N, D]."""
        return log_w + self.power * model.log_likelihood(record.y, x, record.u) + log_ratio
'''
_PROPOSAL = '''"""TITLE: a proposal of a particle filter."""

import math
from dataclasses import dataclass

import torch

import pfbench
from pfbench.filter import ProposalSample


@dataclass(frozen=True)
class TITLE:
    """Noise from a mixture of the model's and one that is three times as wide."""

    share: float = 0.2
    is_exact = True

    def __call__(self, model, belief, record, draws):
        """Draw particles [R, N, D] with log p(w) - log q(w) of their noise."""
        n, d, scale = belief.x.shape[1], model.noise_dim, 3.0
        w = draws.normal("noise", n, d)
        w = torch.where(draws.uniform("wide", n, 1) < self.share, scale * w, w)
        log_p = -0.5 * w.square().sum(-1)
        wide = log_p / scale**2 - d * math.log(scale) + math.log(self.share)
        log_q = torch.logaddexp(log_p + math.log(1 - self.share), wide)
        return ProposalSample(model.propagate(belief.x, record.u, w), log_p - log_q, belief.memory, w)
'''
_MODEL = '''"""TITLE: a state-space model, simulated and filtered."""

import torch

import pfbench
from pfbench.model import StateSpaceModel, independent_normal, normal_batch


class TITLE(StateSpaceModel):
    """A room that cools towards 10 degrees Celsius and is heated below 20."""

    def __init__(self, cooling_rate: float = 0.1, measurement_sd: float = 0.5) -> None:
        super().__init__()
        self.register_buffer("sd", torch.tensor([measurement_sd], dtype=torch.float64))
        self.cooling_rate = cooling_rate
        self.names, self.units = ("temperature",), ("K",)
        self.groups, self.noise_dim = {"temperature": (0,)}, 1

    def initial(self, runs):
        """Distribution of the first state, batch [R]."""
        return normal_batch(runs, torch.full_like(self.sd, 3.0), torch.full_like(self.sd, 18.0))

    def propagate(self, x, u, w):
        """Next state [R, N, 1] for standard normal noise w [R, N, 1]."""
        heating = torch.where(x < 20.0, 1.5, 0.0)
        return x - self.cooling_rate * (x - 10.0) + heating + 0.2 * w

    def observation(self, x, u):
        """Distribution of the measurement given the state."""
        return independent_normal(x, self.sd)


if __name__ == "__main__":
    print(pfbench.check(TITLE))
    study = pfbench.run(TITLE(), ["ekf", "ukf", "sir"], runs=50, study="NAME")
    print(study.summary())
    print(study.report())
'''
_SCENARIO = '''"""TITLE: a scenario whose truth does not come from the model of the filters."""

from dataclasses import dataclass

import torch

import pfbench
from pfbench.core import Episode, MeasurementChannels, PhiloxStream, Record


@dataclass(frozen=True)
class TITLE:
    """A walk with constant velocity that turns round once."""

    steps: int = 60
    turn_s: float = 30.0
    channel_names = ("position on a line [m]",)  # what it measures, as the model linear_walk names it

    def draw(self, noise, runs, seed):
        """Draw truth and measurements of numbered runs [R]."""
        stream = PhiloxStream(seed, runs)
        time = torch.arange(1, self.steps + 1, dtype=torch.float64)
        start = stream.normal("world.start", 1, 2)[:, 0]
        velocity = start[:, 1:] + torch.where(time < self.turn_s, 0.5, -0.5)
        position = start[:, :1] + velocity.cumsum(1)
        channels = MeasurementChannels.of_one_kind(torch.ones(1, dtype=torch.float64))
        y = position.unsqueeze(-1) + noise.draw_errors(stream, channels, time)
        return Episode(Record(y), time, {"state": torch.stack([position, velocity], -1)})


if __name__ == "__main__":
    print(pfbench.check(TITLE()))
    study = pfbench.run(TITLE(), ["ekf", "sir", "rpf"], model="linear_walk", runs=50, study="NAME")
    print(study.summary())
    print(study.report())
'''
_NOISE = '''"""TITLE: a noise regime, beside the nominal one."""

from dataclasses import dataclass

import torch

import pfbench
from pfbench.noise import NoiseRegime


@dataclass(frozen=True)
class TITLE(NoiseRegime):
    """Errors that are larger for some time, at times that differ between runs."""

    share: float = 0.2
    factor: float = 5.0

    def draw_errors(self, draws, channels, time):
        """Draw errors [R, T, Dy] of measurements with standard deviations channels.sd [Dy]; NaN is a missing one."""
        z = draws.normal("world.receiver", len(time), len(channels.sd))
        phase = draws.uniform("world.bursts", 1, 1)
        is_burst = torch.remainder(time[:, None] / 20.0 + phase, 1.0) < self.share
        return channels.sd * torch.where(is_burst, self.factor, 1.0) * z


if __name__ == "__main__":
    print(pfbench.check(TITLE()))
    filters = ["ekf", "sir", "rpf"]
    study = pfbench.run("growth", filters, noise=["nominal", TITLE()], runs=50, study="NAME")
    print(study.summary())
    print(study.report())
'''
_LOG = '''"""TITLE: filters on a recorded log."""

import numpy as np
import pandas as pd

import pfbench

# Replace the three tables by your files, such as imu = "my_imu.csv". These are a drive of 30 s, simulated.
rng, t = np.random.default_rng(0), np.arange(0.0, 30.0, 0.01)
yaw, speed, zero = 0.5 + 0.6 * np.sin(0.4 * t), 10.0, np.zeros_like(t)
rate, vn, ve = 0.24 * np.cos(0.4 * t), speed * np.cos(yaw), speed * np.sin(yaw)
imu = pd.DataFrame({
    "timestamp": t,
    "accel_x": 0.05 + 0.2 * rng.normal(size=t.size),
    "accel_y": speed * rate - 0.03 + 0.2 * rng.normal(size=t.size),
    "accel_z": 0.1 - 9.80665 + 0.2 * rng.normal(size=t.size),
    "gyro_x": 0.001 + 0.01 * rng.normal(size=t.size),
    "gyro_y": -0.001 + 0.01 * rng.normal(size=t.size),
    "gyro_z": rate + 0.002 + 0.01 * rng.normal(size=t.size),
})  # fmt: skip
reference = pd.DataFrame({
    "time": t, "north": vn.cumsum() * 0.01, "east": ve.cumsum() * 0.01, "down": zero,
    "vn": vn, "ve": ve, "vd": zero, "roll": zero, "pitch": zero, "heading": yaw,
})  # fmt: skip
gnss = reference.loc[::100, ["time", "north", "east", "down"]].copy()
gnss[["north", "east", "down"]] += rng.normal(size=(len(gnss), 3)) * [1.5, 1.5, 3.0]

if __name__ == "__main__":
    drive = pfbench.log(imu, gnss, reference.iloc[::10], axes="frd", time="s")
    study = pfbench.run(drive, ["ekf", "ukf", "sir"], runs=10, study="NAME")
    print(study.summary())
    print(study.report())
'''
SCRIPTS = {
    "filter": _FILTER + _END,
    "proposal": _PROPOSAL + _END,
    "model": _MODEL,
    "scenario": _SCENARIO,
    "noise": _NOISE,
    "log": _LOG,
}


COMMAND = Command(
    write_script,
    """\
pfbench new filter|proposal|model|scenario|noise|log NAME

Write NAME.py into the current folder: a class of your own and a study of it beside filters of pfbench. It runs
without a change. Change the class.

  pfbench new filter careful
  python careful.py""",
)
