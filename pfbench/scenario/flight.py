"""Simulated flights: manoeuvres, imperfect sensors, mechanisation at the sensors' rate, and a receiver."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from tqdm import tqdm

from pfbench.draws import MonteCarlo
from pfbench.nav import attitude, earth, sensors, strapdown, trajectory
from pfbench.nav.aiding import Alignment, Receiver
from pfbench.noise.regimes import Regime, fixes
from pfbench.record import Episode, Record
from pfbench.scenario.worlds import Arrays, cached


@dataclass(frozen=True)
class SimulatedFlight:
    """A flight whose INS is never corrected (open loop): its errors are the state that filters estimate.

    The inertial sensors are simulated at their own rate and run through the mechanisation, never from a filter's model. Each
    run draws its sensor errors, initial errors and receiver noise; the flown path is the same.

    Args:
        path: the motion that is flown.
        imu: sizes of the sensors' errors.
        receiver: nominal standard deviations of the fixes.
        initial: standard deviations of the initial errors.
        imu_rate: samples per second.
        interval: seconds between fixes; a whole, even number of samples.
        cache: folder for simulated flights, or None.

    Raises:
        ValueError: an interval that is not an even number of samples, a flight that is not a whole number of intervals.
    """

    path: trajectory.Path
    imu: sensors.ImuErrors
    receiver: Receiver
    initial: Alignment
    imu_rate: float = 100.0
    interval: float = 1.0
    cache: str | None = None

    def __post_init__(self) -> None:
        samples = self.imu_rate * self.interval
        if samples < 2 or abs(samples / 2 - round(samples / 2)) > 1e-9:
            raise ValueError(
                f"scenario.interval={self.interval}: at imu_rate={self.imu_rate} that is {samples:g} samples; give an even number"
            )

    def draw(self, noise: Regime, runs: Tensor, seed: int) -> Episode:
        """Worlds of these runs: position and velocity differences INS minus receiver, the intervals as inputs."""
        recipe = (
            "flight 3", self.path, self.imu, self.initial, self.imu_rate, self.interval, seed, runs.tolist()
        )  # fmt: skip
        world = cached(self.cache, recipe, lambda: self._simulate(MonteCarlo(seed, runs)))
        truth = {name[6:]: value for name, value in world.items() if name.startswith("truth.")}
        time = world["time"]
        intervals = strapdown.Intervals(*(world[name] for name in strapdown.Intervals._fields))
        seen = torch.cat([truth["position"], truth["velocity"]], -1)[..., : len(self.receiver.sd)]
        y = seen + noise.errors(MonteCarlo(seed, runs), fixes(self.receiver.sd), time)
        return Episode(Record(y, intervals), time, truth, world["track"].expand(len(runs), -1, -1))

    def _simulate(self, draws: MonteCarlo) -> Arrays:
        """Truth and nominal trajectory at the ends of the intervals."""
        flight = self.path.fly(self.imu_rate)
        per = round(self.imu_rate * self.interval)
        if len(flight.dtheta) % per:
            raise ValueError(
                f"scenario.interval={self.interval}: the flight's {flight.time[-1]:g} s are no whole number of intervals; "
                "give one that divides them, or make a segment longer"
            )
        imu = sensors.corrupt(flight.dtheta, flight.dv, 1.0 / self.imu_rate, self.imu, draws)
        errors = self.initial.sd * draws.normal("world.initial", 1, 9)[:, 0]
        ins = strapdown.align(flight.dcm[0], flight.vel[0], flight.pos[0], errors[:, :3], errors[:, 3:6], errors[:, 6:])
        total = imu.dtheta.shape[1] // per
        with tqdm(total=total, desc="simulating flights", unit="interval", delay=2, disable=None, leave=False) as bar:
            _, u = strapdown.navigate(ins, imu.dtheta, imu.dv, 1.0 / self.imu_rate, per, tick=bar.update)
        dcm, vel, pos = flight.dcm[per::per], flight.vel[per::per], flight.pos[per::per]
        gyro, accelerometer = imu.gyro_markov[:, per - 1 :: per], imu.accelerometer_markov[:, per - 1 :: per]
        constant = imu.gyro_bias.unsqueeze(1).expand_as(gyro)
        truth = {
            "attitude": attitude.attitude_error(dcm, u.dcm_end),
            "velocity": u.vel_end - vel,
            "position": (u.pos_end - pos) * earth.metre_scale(pos),
            "gyro_bias": constant + gyro,
            "gyro_constant": constant,
            "gyro_markov": gyro,
            "accelerometer_bias": imu.accelerometer_bias.unsqueeze(1) + accelerometer,
        }
        named = {f"truth.{name}": value.contiguous() for name, value in truth.items()}
        plan = earth.local_enu(pos, flight.pos[0])[:, :2]
        height = pos[:, 2:] - flight.pos[0, 2]  # above the ellipsoid: the tangent plane is 100 m up after 36 km
        track = torch.cat([plan, height], -1).unsqueeze(0)
        return {"time": flight.time[per::per], "track": track, **named, **{k: v.contiguous() for k, v in u._asdict().items()}}
