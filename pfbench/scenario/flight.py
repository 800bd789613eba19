"""Simulated flights: manoeuvres, imperfect sensors, mechanisation at the sensors' rate, and a receiver."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor
from tqdm import tqdm

from pfbench.draws import MonteCarlo
from pfbench.nav import attitude, earth, sensors, strapdown, trajectory
from pfbench.nav.aiding import Aiding, Alignment, Flown, Receiver
from pfbench.noise.regimes import Regime, step_process
from pfbench.record import Episode, Record
from pfbench.scenario.closed_loop import CorrectedIns
from pfbench.scenario.worlds import Arrays, cached


@dataclass(frozen=True)
class SimulatedFlight:
    """A flight with an INS whose errors are the state that filters estimate; it is not corrected, unless `closed`.

    The inertial sensors are simulated at their own rate and run through the mechanisation, never from a filter's model. Each
    run draws its sensor errors, initial errors and receiver noise; the flown path is the same.

    Args:
        path: the motion that is flown.
        imu: sizes of the sensors' errors.
        receiver: the instruments that aid the INS; a GNSS receiver that gives fixes, say.
        initial: standard deviations of the initial errors.
        imu_rate: samples per second.
        interval: seconds between fixes; a whole, even number of samples.
        cache: folder for simulated flights, or None.
        closed: after every interval the INS is corrected by what the filter thinks it is wrong by (closed loop). What is
            reported is the same: errors of the corrected navigation.

    Raises:
        ValueError: an interval that is not an even number of samples, a flight that is not a whole number of intervals;
            `closed` with instruments that give no fixes.
    """

    path: trajectory.Path
    imu: sensors.ImuErrors
    receiver: Aiding
    initial: Alignment
    imu_rate: float = 100.0
    interval: float = 1.0
    cache: str | None = None
    closed: bool = False

    def __post_init__(self) -> None:
        samples = self.imu_rate * self.interval
        if samples < 2 or abs(samples / 2 - round(samples / 2)) > 1e-9:
            raise ValueError(
                f"scenario.interval={self.interval}: at imu_rate={self.imu_rate} that is {samples:g} samples; give an even number"
            )
        if self.closed and not isinstance(self.receiver, Receiver):
            raise ValueError(
                f"scenario.closed=true: a corrected INS is aided by fixes of a Receiver, not by {type(self.receiver).__name__}; "
                "give closed=false"
            )

    def draw(self, noise: Regime, runs: Tensor, seed: int) -> Episode:
        """Worlds of these runs: what the receiver says of the INS, and its inputs."""
        draws = MonteCarlo(seed, runs)
        flown, truth, track, sheet = self.fly(noise, runs, seed)
        aided = self.receiver.aid(flown, draws, step_process(noise, flown.time))
        y = aided.y + noise.errors(draws, self.receiver.channels, flown.time)
        loop = self._loop(noise, draws) if self.closed else None
        notes = ("the INS is corrected in flight; errors are those of the corrected navigation",) if self.closed else ()
        tracks = track.expand(len(runs), -1, -1)
        return Episode(Record(y, aided.u, loop=loop), flown.time, truth | aided.truth, tracks, notes, sheet | aided.sheet)

    def _loop(self, noise: Regime, draws: MonteCarlo) -> CorrectedIns:
        """The same sensors and start, to be flown again by each filter."""
        flight = self.path.fly(self.imu_rate)
        ins, imu = self._aboard(flight, step_process(noise, flight.time[1:]), draws)
        return CorrectedIns(ins, imu.dtheta, imu.dv, 1.0 / self.imu_rate, round(self.imu_rate * self.interval))

    def _aboard(self, flight: trajectory.Flight, process: Tensor, draws: MonteCarlo) -> tuple[strapdown.Ins, sensors.Corrupted]:
        """The INS at the start, and what its sensors report."""
        imu = sensors.corrupt(flight.dtheta, flight.dv, 1.0 / self.imu_rate, self.imu, draws, process)
        errors = self.initial.errors(draws)
        start = flight.dcm[0], flight.vel[0], flight.pos[0]
        return strapdown.align(*start, errors[:, :3], errors[:, 3:6], errors[:, 6:]), imu

    def fly(self, noise: Regime, runs: Tensor, seed: int) -> tuple[Flown, Arrays, Tensor, Arrays]:
        """The flight of these runs, the INS's true errors by group, the track [1, T, 3], and what a datasheet draws of it."""
        per = round(self.imu_rate * self.interval)
        path = cache(lambda: self.path.fly(self.imu_rate))  # once, and only where something is not on disk: it may be costly
        course = cached(self.cache, ("course 1", self.path, self.imu_rate, self.interval), lambda: self._course(path(), per))
        process = step_process(noise, course["samples"][1:])
        swell = None if bool((process == 1.0).all()) else hashlib.sha256(process.numpy().tobytes()).hexdigest()
        recipe = ("flight 6", self.path, self.imu, self.initial, self.imu_rate, self.interval, seed, runs.tolist(), swell)
        world = cached(self.cache, recipe, lambda: self._simulate(path(), per, process, MonteCarlo(seed, runs)))
        truth = {name[6:]: value for name, value in world.items() if name.startswith("truth.")}
        intervals = strapdown.Intervals(*(world[name] for name in strapdown.Intervals._fields))
        flown = Flown(course["time"], course["pos"], course["vel"], course["dcm"], intervals)
        plan = earth.local_enu(flown.pos, course["origin"])[:, :2]
        height = flown.pos[:, 2:] - course["origin"][2]  # above the ellipsoid: the tangent plane is 100 m up after 36 km
        sheet = {name: course[name] for name in ("force", "rate")}
        return flown, truth, torch.cat([plan, height], -1).unsqueeze(0), sheet

    def _course(self, flight: trajectory.Flight, per: int) -> Arrays:
        """The path at the ends of the intervals, what ideal sensors mean over each, and the times of all samples."""
        if len(flight.dtheta) % per:
            raise ValueError(
                f"scenario.interval={self.interval}: the flight's {flight.time[-1]:g} s are no whole number of intervals; "
                "give one that divides them, or make a segment longer"
            )
        ends = {name: getattr(flight, name)[per::per].contiguous() for name in ("time", "pos", "vel", "dcm")}
        return ends | {
            "origin": flight.pos[0],
            "samples": flight.time,
            "force": flight.dv.unflatten(0, (-1, per)).mean(1) * self.imu_rate,
            "rate": flight.dtheta.unflatten(0, (-1, per)).mean(1) * self.imu_rate,
        }

    def _simulate(self, flight: trajectory.Flight, per: int, process: Tensor, draws: MonteCarlo) -> Arrays:
        """True errors and nominal trajectory at the ends of the intervals."""
        ins, imu = self._aboard(flight, process, draws)
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
        return {**named, **{k: v.contiguous() for k, v in u._asdict().items()}}
