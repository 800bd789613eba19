"""A notebook in this process: a main module whose cells are executed one after the other."""

import sys
import types
from typing import Any

import pytest


class Notebook:
    """Main module of a notebook: `In` has the cells that were executed."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.main = types.ModuleType("__main__")
        self.main.In = []
        monkeypatch.setitem(sys.modules, "__main__", self.main)

    def run(self, cell: str) -> None:
        """Execute a cell."""
        self.main.In.append(cell)
        code = "\n".join("" if line.startswith("%") else line for line in cell.splitlines())
        exec(compile(code, "<cell>", "exec"), vars(self.main))

    def __getitem__(self, name: str) -> Any:
        return vars(self.main)[name]


PROPOSAL = '''
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pfbench.filter import ProposalSample


def log_normal(w: Tensor) -> Tensor:
    return -0.5 * w.square().sum(-1)


@dataclass(frozen=True)
class Defensive:
    """Noise from a mixture of that of the model and one that is wider."""

    share: float = 0.2
    is_exact = True

    def __call__(self, model, belief, record, draws):
        n, d = belief.x.shape[1], model.noise_dim
        w = draws.normal("noise", n, d)
        w = torch.where(draws.uniform("wide", n, 1) < self.share, SCALE * w, w)
        log_p = log_normal(w)
        wide = log_p / SCALE**2 - d * math.log(SCALE) + math.log(self.share)
        log_q = torch.logaddexp(log_p + math.log(1 - self.share), wide)
        return ProposalSample(model.propagate(belief.x, record.u, w), log_p - log_q, belief.memory, w)
'''
MODEL = """
import torch

from pfbench.model import StateSpaceModel, independent_normal, normal_batch


class Room(StateSpaceModel):
    def __init__(self, cooling_rate: float = 0.1, measurement_sd: float = 0.5) -> None:
        super().__init__()
        self.register_buffer("sd", torch.tensor([measurement_sd], dtype=torch.float64))
        self.cooling_rate = cooling_rate
        self.names, self.units = ("temperature",), ("K",)
        self.groups, self.noise_dim = {"temperature": (0,)}, 1

    def initial(self, runs):
        return normal_batch(runs, torch.full_like(self.sd, 3.0), torch.full_like(self.sd, 18.0))

    def propagate(self, x, u, w):
        return x - self.cooling_rate * (x - 10.0) + torch.where(x < 20.0, 1.5, 0.0) + 0.2 * w

    def observation(self, x, u):
        return independent_normal(x, self.sd)
"""
WORLD = """
import torch
from dataclasses import dataclass
from typing import NamedTuple

from pfbench.core import Episode, MeasurementChannels, PhiloxStream, Record
from pfbench.model import StateSpaceModel, independent_normal, normal_batch
from pfbench.noise import NoiseRegime


class Ship(NamedTuple):
    speed: torch.Tensor


@dataclass(frozen=True)
class Drive:
    gain: float = 1.0

    def move(self, x, speed):
        return x + self.gain * speed


class Line(StateSpaceModel):
    input_type = Ship

    def __init__(self, drive=Drive()):
        super().__init__()
        self.register_buffer("sd", torch.tensor([SD], dtype=torch.float64))
        self.drive = drive
        self.names, self.units, self.groups, self.noise_dim = ("x",), ("m",), {"position": (0,)}, 1

    def initial(self, runs):
        return normal_batch(runs, self.sd, torch.zeros_like(self.sd))

    def propagate(self, x, u, w):
        return self.drive.move(x, u.speed[:, None, None]) + w

    def observation(self, x, u):
        return independent_normal(x, self.sd)


@dataclass(frozen=True)
class Sea:
    drive: Drive = Drive()
    input_type = Ship

    def draw(self, noise, runs, seed):
        stream = PhiloxStream(seed, runs)
        time = torch.arange(1, 9, dtype=torch.float64)
        x = self.drive.move(stream.normal("world.walk", 8, 1).cumsum(1), time[:, None])
        channels = MeasurementChannels.of_one_kind(torch.ones(1, dtype=torch.float64))
        y = x + noise.draw_errors(stream, channels, time)
        return Episode(Record(y, Ship(torch.ones(1, 8, dtype=torch.float64))), time, {"position": x})


@dataclass(frozen=True)
class Slips(NoiseRegime):
    factor: float = 3.0

    def draw_errors(self, draws, channels, time):
        z = draws.normal("world.receiver", len(time), len(channels.sd))
        return channels.sd * torch.where(time[:, None] > 4.0, self.factor, 1.0) * z


class Unrelated:
    is_exact = True

    def __call__(self, a, n, draws):
        return a
"""
