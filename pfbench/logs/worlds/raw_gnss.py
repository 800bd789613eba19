"""Raw pseudoranges and Doppler of a log, relative to nominal ranges and a nominal clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Episode, MeasurementChannels, Record
from pfbench.files.reader_notes import announce_notes
from pfbench.logs.sky.plausible_limits import PlausibleLimits
from pfbench.logs.worlds.drive import RecordedScenario
from pfbench.logs.worlds.log_agreement import (
    check_orbits,
    compare_directions,
    compare_ranges,
    compare_rates,
    describe_missing_times,
)
from pfbench.logs.worlds.log_frames import place_of
from pfbench.logs.worlds.log_tables import (
    Array,
    LogFiles,
    LogTable,
    NavigationLog,
    check_range,
    convert_column,
    find_dataset,
    index_satellites,
    list_tables,
    parse_numbers,
    parse_satellites,
    read_table,
)
from pfbench.logs.worlds.signal_weights import SignalWeights
from pfbench.logs.worlds.time_grid import (
    FixReceiver,
    ResampledLog,
    assemble,
    encode_names,
    interpolate,
    resample_log,
)
from pfbench.model.strapdown import StrapdownTight, TightMemsInputs
from pfbench.model.strapdown_tuning import TightTuning
from pfbench.nav import earth
from pfbench.nav.orbits import LIGHT
from pfbench.noise.base import NoiseRegime, NominalNoise, check_unit_process, draw_added_errors
from pfbench.scenario.base import check_added_sd, check_duration

_SAME_EPOCH = 0.02  # s; the receiver clock is accurate to some milliseconds
_MILLISECOND = LIGHT * 1e-3  # m
_MEASURED = (
    "t",
    "svid",
    "pr",
    "prr",
    "sd_pr",
    "sd_prr",
    "sclk",
    "sclkd",
    "tropo",
    "iono",
    "az",
    "el",
)
SKY = "pseudorange"  # table of the raw measurements
_COLUMNS = (*_MEASURED, "sx", "sy", "sz", "svx", "svy", "svz")


class RawGnssLog(NamedTuple):
    """Raw measurements of S satellites at K times, relative to the origin of the log.

    Missing values are NaN. Vectors are in East, North, Up at the time of reception.

    Attributes:
        names: Names of the satellites, such as G10 or E07.
        range: Pseudorange, corrected for satellite clock, troposphere and ionosphere, m, [K, S].
        rate: Range rate, corrected for the drift of the satellite clock, m/s, [K, S].
        range_sd: Standard deviation of the range reported by the receiver, m, [K, S].
        rate_sd: Standard deviation of the range rate reported by the receiver, m/s, [K, S].
        satellite_position: Positions of the satellites, m, [K, S, 3].
        velocity: Velocities of the satellites, m/s, [K, S, 3].
        azimuth: Azimuth, rad, [K, S].
        elevation: Elevation, rad, [K, S].
        notes: Messages of the reader.
    """

    names: tuple[str, ...]
    range: Array
    rate: Array
    range_sd: Array
    rate_sd: Array
    satellite_position: Array
    velocity: Array
    azimuth: Array
    elevation: Array
    notes: tuple[str, ...] = ()


def collect_sky(
    table: LogTable,
    time: Array,
    receiver: RawGnssReceiver,
    origin: Sequence[float] | None = None,
    optional: Sequence[str] = (),
) -> RawGnssLog:
    """Collect the raw measurements of a table at given times.

    Each epoch is assigned to the nearest time within a tolerance. Optional columns can lack values.

    Shapes: time [K].
    """
    value = _read_columns(table, receiver.weights, optional)
    row, is_near = _find_steps(value["t"], time)
    selected_mask = is_near & (value["el"] >= receiver.mask_deg)
    require(
        selected_mask.any(),
        table.name,
        f"contain a row above {receiver.mask_deg} degrees within {_SAME_EPOCH} s of the end of a step",
        "none",
        "Use the same clock for t in all tables, or lower scenario.receiver.mask_deg.",
    )
    names = np.array(parse_satellites(table, value["svid"]))[selected_mask]
    satellites, index = index_satellites(table, row[selected_mask], names)

    def fill(column: Array) -> Array:
        out = np.full((len(time), len(satellites), *column.shape[1:]), np.nan)
        out[index] = column[selected_mask]
        return out

    centre, axes = _local(table, origin)
    position, velocity = (
        np.stack([value[prefix + axis] for axis in "xyz"], -1) for prefix in ("s", "sv")
    )
    corrected = (
        value["pr"] + value["sclk"] - value["tropo"] - value["iono"],
        value["prr"] + value["sclkd"],
    )
    reported = value["sd_pr"], value["sd_prr"], (position - centre) @ axes.T, velocity @ axes.T
    angles = np.radians(value["az"]), np.radians(value["el"])
    columns = [fill(column) for column in (*corrected, *reported, *angles)]
    notes = (*table.notes, *describe_missing_times(table.name, np.unique(value["t"]), time))
    return RawGnssLog._make([tuple(satellites), *columns, notes])


def _read_columns(
    table: LogTable, weights: SignalWeights | None, optional: Sequence[str]
) -> dict[str, Array]:
    """Read the columns of a table, with standard deviations by weights if there are some."""
    stated = () if weights is None else ("sd_pr", "sd_prr")
    names = [name for name in _COLUMNS if name not in (*optional, *stated)]
    names += [] if weights is None or "cn0" in optional else ["cn0"]
    value = dict(zip(names, parse_numbers(table, names).T, strict=True))
    for name in optional:
        value[name] = convert_column(table, name)
        check_range(table, name, value[name])
    if weights is not None:
        value["sd_pr"], value["sd_prr"] = weights.sd(np.radians(value["el"]), value["cn0"])
    return value


def _find_steps(epochs: Array, time: Array) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return the nearest time of each epoch, and whether it is within the tolerance."""
    interval = np.diff(np.unique(epochs))
    tolerance = min(_SAME_EPOCH, 0.4 * float(np.median(interval))) if len(interval) else _SAME_EPOCH
    after = np.searchsorted(time, epochs).clip(1, len(time) - 1)
    row = np.where(epochs - time[after - 1] < time[after] - epochs, after - 1, after)
    return row, np.abs(time[row] - epochs) <= tolerance


def _local(table: LogTable, origin: Sequence[float] | None) -> tuple[Array, Array]:
    """Return Earth-fixed origin, m, [3], and axes East, North, Up, [3, 3]."""
    keys = [f"origin_{name}" for name in ("lat_deg", "lon_deg", "h_m")]
    require(
        origin is not None or all(key in table.stated for key in keys),
        table.name,
        "contain the origin pn = pe = pd = 0",
        "none",
        "Set scenario.origin=[lat_deg, lon_deg, h_m].",
    )
    pos = place_of([float(table.stated[key]) for key in keys] if origin is None else origin)
    return earth.ecef(pos).numpy(), earth.local_axes(pos).numpy()


def subtract_nominal_ranges(
    gnss_log: RawGnssLog, time: Array, velocity: Array
) -> tuple[Array, tuple[str, ...]]:
    """Subtract nominal ranges and rates, and the nominal clock.

    Nominal ranges and rates are those of a receiver at rest at the start.

    Returns reduced ranges, m, and rates, m/s, [K, 2 S], and notes for the report. Shapes: time
    [K].
    """
    reach = np.linalg.norm(gnss_log.satellite_position, axis=-1)
    line = gnss_log.satellite_position / reach[..., None]
    ranges, rates = gnss_log.range - reach, gnss_log.rate - (line * gnss_log.velocity).sum(-1)
    is_other = list_other_system(gnss_log.names)
    require(
        np.isfinite(ranges[0, ~is_other]).any(),
        "scenario.start_s",
        f"have a {find_first_system(gnss_log.names)} satellite",
        f"none at t = {time[0]:.3f}",
        "Select another start.",
    )
    ranges, notes = remove_clock_jumps(ranges, time)
    approach = line[0] @ velocity
    drift = (
        _mean(rates[0] + approach, gnss_log.rate_sd[0])
        if np.isfinite(rates[0]).any()
        else _find_drift(ranges + approach * (time - time[0])[:, None], time)
    )
    level = _mean(ranges[0, ~is_other], gnss_log.range_sd[0, ~is_other])
    other_level = (
        _mean(ranges[0, is_other], gnss_log.range_sd[0, is_other])
        if np.isfinite(ranges[0, is_other]).any()
        else level
    )
    ranges = ranges - np.where(is_other, other_level, level) - drift * (time - time[0])[:, None]
    note = (
        f"clock: {level:.0f} m and {drift:.2f} m/s subtracted, "
        f"for other systems {other_level - level:+.1f} m more"
    )
    return np.concatenate([ranges, rates - drift], -1), (note, *notes)


def find_first_system(names: Sequence[str]) -> str:
    """Return the system to which the clock of the receiver belongs: GPS, or the first one without GPS."""
    return "GPS" if any(name.startswith("G") for name in names) else names[0][0]


def list_other_system(names: Sequence[str]) -> NDArray[np.bool_]:
    """Return the mask of satellites of another system than that of the clock."""
    first = find_first_system(names)[0]
    return np.array([not name.startswith(first) for name in names])


def remove_clock_jumps(ranges: Array, time: Array) -> tuple[Array, tuple[str, ...]]:
    """Remove jumps of the receiver clock by whole milliseconds, with which receivers steer it.

    Returns ranges and notes. Shapes: ranges [K, S], time [K].
    """
    epochs_with_data = np.flatnonzero(np.isfinite(ranges).any(1))
    step, duration = np.diff(ranges[epochs_with_data], axis=0), np.diff(time[epochs_with_data])
    has_change = np.isfinite(step).any(1)
    change = np.zeros(len(step))
    change[has_change] = np.nanmedian(step[has_change], axis=1)
    rate = float(np.median(change[has_change] / duration[has_change])) if has_change.any() else 0.0
    jumps = np.rint((change - rate * duration) / _MILLISECOND) * has_change
    count = int(np.count_nonzero(jumps))
    if not count:
        return ranges, ()
    shift = np.zeros(len(time))
    shift[epochs_with_data[1:]] = np.cumsum(jumps) * _MILLISECOND
    return ranges - shift[:, None], (f"clock: {count} jumps by whole milliseconds removed",)


def _find_drift(ranges: Array, time: Array) -> float:
    """Return the drift of the clock from the first ranges, for a receiver without range rates, m/s.

    Shapes: ranges of a receiver at rest [K, S], time [K].
    """
    later = np.flatnonzero(np.isfinite(ranges - ranges[0]).any(1) & (time > time[0]))
    if not later.size:
        return 0.0
    k = int(later[0])
    return float(np.nanmedian(ranges[k] - ranges[0]) / (time[k] - time[0]))


def _mean(values: Array, sd: Array) -> float:
    """Compute the mean of the finite values, weighted by reported variances."""
    finite_mask = np.isfinite(values)
    return float(np.average(values[finite_mask], weights=sd[finite_mask] ** -2))


def make_sky_inputs(gnss_log: RawGnssLog) -> tuple[Tensor, ...]:
    """Build the inputs of the steps that describe the satellites.

    Returns line, reach, velocity, other_system, range_sd and rate_sd of the models, [1, T, S, ...].
    """
    # finite values replace missing inputs, since a NaN would propagate to gradients
    observed_mask = np.isfinite(gnss_log.range)[1:]
    reach = np.linalg.norm(gnss_log.satellite_position, axis=-1)
    line = np.where(
        observed_mask[..., None],
        (gnss_log.satellite_position / reach[..., None])[1:],
        [0.0, 0.0, 1.0],
    )
    other_system = np.broadcast_to(
        list_other_system(gnss_log.names).astype(float), observed_mask.shape
    )
    filled = [
        np.where(observed_mask, a[1:], fill)
        for a, fill in ((gnss_log.range_sd, 1.0), (gnss_log.rate_sd, 1.0))
    ]
    velocity = np.where(observed_mask[..., None], gnss_log.velocity[1:], 0.0)
    leaves = (line, np.where(observed_mask, reach[1:], 2e7), velocity, other_system, *filled)
    return tuple(torch.from_numpy(np.ascontiguousarray(leaf))[None] for leaf in leaves)


# --------------------------------------------------------------------------------------------------
# Recorded walk with IMU, raw pseudoranges and Doppler, scored against a reference.
#
# The recorded measurements are corrected for satellite clocks, troposphere and ionosphere. Runs
# differ in initial errors and in the errors that a noise regime adds to each satellite.


@dataclass(frozen=True)
class RawGnssReceiver:
    """Conversion of recorded pseudoranges and range rates to measurements.

    Attributes:
        fix_interval_s: Time between used epochs, s.
        range_sd: Standard deviation of added range errors, m. With 0 a noise regime can only remove
            satellites.
        rate_sd: Standard deviation of added range-rate errors, m/s.
        mask_deg: Smallest elevation, degrees.
        weights: Standard deviations by elevation and signal strength, in place of those in the columns sd_pr and
            sd_prr. None for the columns.

    Raises:
        ValueError: If the interval is not positive, a standard deviation is negative, or the mask is
            outside [-90, 90].
    """

    fix_interval_s: float = 1.0
    range_sd: float = 0.0
    rate_sd: float = 0.0
    mask_deg: float = 10.0
    weights: SignalWeights | None = None

    def __post_init__(self) -> None:
        check_duration("scenario.receiver.fix_interval_s", self.fix_interval_s)
        check_added_sd("scenario.receiver.range_sd", self.range_sd)
        check_added_sd("scenario.receiver.rate_sd", self.rate_sd)
        require(
            -90.0 <= self.mask_deg <= 90.0,
            "scenario.receiver.mask_deg",
            "be between -90 and 90",
            self.mask_deg,
            "Set an elevation in degrees.",
        )

    def channels(self, satellites: int) -> MeasurementChannels:
        """Return the channels of all ranges, then of all range rates."""
        sd = torch.tensor(
            [self.range_sd] * satellites + [self.rate_sd] * satellites, dtype=torch.float64
        )
        kind = ("range",) * satellites + ("rate",) * satellites
        return MeasurementChannels(sd, kind, tuple(range(satellites)) * 2)


@dataclass(frozen=True)
class RecordedWalk(RecordedScenario):
    """One recorded log with raw measurements. Runs differ in initial and added errors.

    The nominal receiver clock has the bias and drift of the first recorded epoch at the reference.
    It is subtracted from the measurements. The initial clock errors are drawn about it.

    In addition to IMU and reference the log contains a table `pseudorange`, with one row per epoch and satellite. The
    columns are t, sys (G or E), svid, pr, prr, sd_pr, sd_prr, sx..sz, svx..svz, sclk, sclkd, tropo, iono in SI units,
    and az, el in degrees. Steps end at the times of the table `gnss`. The other attributes are those of `RecordedScenario`.

    Attributes:
        tuning: Parameters that the filter assumes.
        receiver: Selection of measurements, and standard deviations of added errors.
        files: Names of the tables.
        start_s: Start, s of the log. None for the start of the log.
        end_s: End, s of the log. None for the end of the log.

    Raises:
        ValueError: If the step is not positive. `draw` raises it for a missing root
            or folder, an invalid log, a start without GPS satellites, or a regime that changes the
            process noise.
    """

    tuning: TightTuning
    receiver: RawGnssReceiver = field(default_factory=RawGnssReceiver)
    files: LogFiles = field(default_factory=lambda: LogFiles(gnss="reference"))
    start_s: float | None = None
    end_s: float | None = None
    channel_names, input_type = StrapdownTight.channel_names, StrapdownTight.input_type

    @override
    def draw(self, noise: NoiseRegime, runs: Tensor, seed: int) -> Episode:
        leg, gnss_log = self._read()
        draws, fix_mask = PhiloxStream(seed, runs), torch.from_numpy(leg.fix_steps)
        motion = assemble(
            [leg],
            leg.time,
            torch.zeros_like(runs),
            self.tuning.motion,
            FixReceiver(),
            NominalNoise(),
            draws,
        )
        time = np.concatenate([[leg.start_s], leg.time])
        measurements, notes = subtract_nominal_ranges(gnss_log, time, leg.start[4:7])
        y = torch.where(fix_mask[:, None], torch.from_numpy(measurements[1:]), torch.nan).repeat(
            len(runs), 1, 1
        )
        check_unit_process(noise, motion.time)
        # errors are drawn per epoch, so that they do not depend on the filter step
        channels = self.receiver.channels(len(gnss_log.names))
        y[:, fix_mask] += draw_added_errors(
            noise, draws.at_step(0), channels, motion.time[fix_mask]
        )
        record = Record(
            y,
            TightMemsInputs(motion.record.u, *make_sky_inputs(gnss_log)),
            self._draw_start(motion.record.start, draws),
        )
        azimuth, elevation = (
            torch.from_numpy(a[1:]) for a in (gnss_log.azimuth, gnss_log.elevation)
        )
        datasheet = {
            "azimuth": azimuth,
            "elevation": elevation,
            "satellites": encode_names(gnss_log.names),
        }
        return Episode(
            record,
            motion.time,
            motion.truth,
            motion.track,
            (*motion.notes, *notes),
            motion.datasheet | datasheet,
        )

    @override
    def input_files(self) -> list[Path]:
        return [*super().input_files(), *list_tables(self.root, self.folder, (SKY,))]

    def _draw_start(self, motion: Tensor | None, draws: PhiloxStream) -> Tensor:
        """Draw starts [R, 19], about which the true state has the assumed distribution."""
        # the true clock is the nominal one
        clock = self.tuning.clock_sd * draws.at_step(0).normal("world.clock", 1, 3)[:, 0]
        return torch.cat([clock.new_zeros(len(clock), 0) if motion is None else motion, -clock], -1)

    def _read_sky(self, folder: Path, log: NavigationLog, time: Array) -> RawGnssLog:
        """Read the raw measurements at some times, s, [K]."""
        return collect_sky(read_table(folder, SKY, {}), time, self.receiver, self.origin)

    def _read(self) -> tuple[ResampledLog, RawGnssLog]:
        """Read the log on filter steps and the raw measurements relative to the start."""
        folder = find_dataset(self.root, self.folder)
        log = self.read_checked(folder)
        leg = resample_log(
            log,
            self.receiver.fix_interval_s,
            self.filter_step_s,
            start=self.start_s,
            end=self.end_s,
        )
        time = np.concatenate([[leg.start_s], leg.time])
        gnss_log = self._read_sky(folder, log, time)
        motion = interpolate(log.reference, time)
        notes = check_sky(gnss_log, time, motion, self.limits or PlausibleLimits())
        leg = leg._replace(notes=(*leg.notes, *notes))
        announce_notes(folder, leg.notes)
        start = motion[0, 7:]
        return leg, gnss_log._replace(satellite_position=gnss_log.satellite_position - start)


# --------------------------------------------------------------------------------------------------
# Checks of raw measurements of a log against its reference.


def check_sky(
    gnss_log: RawGnssLog, time: Array, motion: Array, limits: PlausibleLimits
) -> tuple[str, ...]:
    """Check satellites, ranges and range rates against the reference.

    Returns notes. Shapes: time [K], motion [K, 10].
    """
    name, names = "pseudorange", gnss_log.names
    # a sphere about the Earth's centre, which lies below the origin of the log
    position = gnss_log.satellite_position + np.array([0.0, 0.0, earth.A])
    check_orbits(name, names, time, position, gnss_log.velocity)
    sight = gnss_log.satellite_position - motion[:, None, 7:]
    reach = np.linalg.norm(sight, axis=-1)
    rate = (sight / reach[..., None] * (gnss_log.velocity - motion[:, None, 4:7])).sum(-1)
    azimuth = np.arctan2(sight[..., 0], sight[..., 1])
    elevation = np.arcsin(sight[..., 2] / reach)
    return (
        *gnss_log.notes,
        *compare_directions(
            name, names, time, gnss_log.azimuth - azimuth, gnss_log.elevation - elevation
        ),
        *compare_ranges(name, names, time, gnss_log.range - reach, limits),
        *compare_rates(name, names, time, gnss_log.rate - rate),
    )
