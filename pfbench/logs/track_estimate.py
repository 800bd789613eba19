"""Answer for a log without a reference: the track by several filters, smoothed, with what the log itself says of them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from pfbench.core.parameter_checks import require
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record
from pfbench.files.track_files import format_gpx, format_kml
from pfbench.filter.belief import StepInfo
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter
from pfbench.filter.loop import run_filter
from pfbench.filter.smoothing.gaussian_smoother import smooth
from pfbench.job.config import compose
from pfbench.job.plan import JobPlan, build_plan
from pfbench.logs.worlds.log_frames import place_of
from pfbench.logs.worlds.log_tables import Array, find_dataset, swap_frd_rfu
from pfbench.logs.worlds.slow_fix_errors import LastingErrors, SlowFixErrors, fit_lasting_errors
from pfbench.logs.worlds.user_log import AlignedLog
from pfbench.model.strapdown import StrapdownModel
from pfbench.nav import earth
from pfbench.nav.attitude import dcm_from_quaternion, euler_from_dcm

_SWAP = [1, 0, 2]  # deviations from East, North, Up to North, East, Down


class MotionEstimate(NamedTuple):
    """Estimated motion in East, North, Up from the origin of the log.

    Attributes:
        state: Attitude quaternion, velocity, m/s, and position, m, [T, 10].
        sd: Standard deviations about right, forward, up, rad, of velocity and of position, [T, 9].
        held_out: Estimate of the fix minus fix at each held-out fix, by a pass that did not get it, m, [m, 3].
        held_out_sd: Standard deviations of these differences: filter, slow error and white error of the fix together, m, [m, 3].
    """

    state: Array
    sd: Array
    held_out: Array
    held_out_sd: Array


class FilterAnswer(NamedTuple):
    """Answer of a filter.

    Attributes:
        name: Name of the filter.
        filtered: Estimates from the fixes so far.
        smoothed: Estimates from all fixes. None for a filter without a smoother.
        nis: Normalised innovation squared of each step with a measurement, [n]; empty if the filter states none.
        dof: Number of its components, [n].
    """

    name: str
    filtered: MotionEstimate
    smoothed: MotionEstimate | None
    nis: Array
    dof: Array

    @property
    def best(self) -> MotionEstimate:
        """Smoothed estimates where there are any."""
        return self.filtered if self.smoothed is None else self.smoothed


@dataclass(frozen=True)
class TrackEstimate:
    """Answers of all filters for one log.

    Attributes:
        name: Name of the log.
        time: Times of the steps, s, [T].
        answers: Answer of each filter.
        fixes: Time, s, and position, m, East, North, Up, of the usable fixes, [m, 4].
        held_out_time: Times of the held-out fixes, s, [m].
        rule: Sentence on how fixes are held out.
        centre: lat_deg, lon_deg, h_m of the origin, None if the log does not contain it.
        fix_errors: Errors of the fixes that last, which all filters have as states.
        notes: Notes of the reader and of the start.
    """

    name: str
    time: Array
    answers: tuple[FilterAnswer, ...]
    fixes: Array
    held_out_time: Array
    rule: str
    centre: tuple[float, ...] | None
    fix_errors: LastingErrors
    notes: tuple[str, ...]

    def tracks(self) -> dict[str, MotionEstimate]:
        """Return the filtered and the smoothed estimates by name."""
        filtered = {answer.name: answer.filtered for answer in self.answers}
        smoothed = {f"{a.name} smoothed": a.smoothed for a in self.answers if a.smoothed}
        return filtered | smoothed

    def geodetic(self, motion: MotionEstimate) -> Array:
        """Return latitude, longitude, deg, and height, m, [T, 3].

        Args:
            motion: One of the tracks.

        Returns:
            Positions on the ellipsoid.

        Raises:
            ValueError: If the log does not contain its place.
        """
        require(
            self.centre is not None,
            "the log",
            "contain its place for GPX and KML",
            "local positions",
            "Set scenario.origin=[lat_deg,lon_deg,h_m] of pn = pe = pd = 0.",
        )
        enu = torch.from_numpy(np.ascontiguousarray(motion.state[:, 7:]))
        at = earth.from_local_enu(enu, place_of(self.centre or ()))
        return np.asarray((at / place_of((1.0, 1.0, 1.0))).numpy())

    def table(self, motion: MotionEstimate) -> pd.DataFrame:
        """Return a track with the columns of a reference of an own log, and standard deviations.

        Args:
            motion: One of the tracks.

        Returns:
            A row per step.
        """
        places = {} if self.centre is None else dict(zip(("lat_deg", "lon_deg", "h_m"), self.geodetic(motion).T, strict=True))  # fmt: skip
        velocity, position = (swap_frd_rfu(motion.state[:, i]) for i in (slice(4, 7), slice(7, 10)))  # fmt: skip
        euler = euler_from_dcm(dcm_from_quaternion(torch.from_numpy(motion.state[:, :4]))).numpy()
        pitch, roll, yaw = euler.T
        sd = np.hstack([motion.sd[:, 6:][:, _SWAP], motion.sd[:, 3:6][:, _SWAP], motion.sd[:, [1, 0, 2]]])  # fmt: skip
        names = ("pn", "pe", "pd", "vn", "ve", "vd", "roll", "pitch", "yaw")
        values = np.hstack([position, velocity, np.stack([roll, pitch, -yaw], -1)])
        return pd.DataFrame({
            "t": self.time, **places, **dict(zip(names, values.T, strict=True)),
            **{f"sd_{name}": column for name, column in zip(names, sd.T, strict=True)},
        })  # fmt: skip

    def to_gpx(self) -> str:
        """Return all tracks as GPX.

        Returns:
            The text of a file.

        Raises:
            ValueError: If the log does not contain its place.
        """
        return format_gpx({name: self.geodetic(m) for name, m in self.tracks().items()})

    def to_kml(self) -> str:
        """Return all tracks as KML.

        Returns:
            The text of a file.

        Raises:
            ValueError: If the log does not contain its place.
        """
        return format_kml({name: self.geodetic(m) for name, m in self.tracks().items()}, self.name)


def estimate_track(
    folder: str | Path, filters: Sequence[str] = ("ekf", "ukf"), settings: Sequence[str] = ()
) -> TrackEstimate:
    """Estimate the track of an own log without a reference.

    Each filter passes over the log once with all fixes, which gives the track, and once for each part of the fixes that
    `scenario.holdout` withholds.

    Args:
        folder: Folder with the tables imu and gnss.
        filters: Names of filters.
        settings: Other words of the configuration, such as "scenario.alignment.heading_deg=30".

    Returns:
        Tracks with intervals, innovations and the distances to held-out fixes.

    Raises:
        ValueError: If a setting or the log is not valid, or does not show level and heading.
    """
    path = Path(folder).resolve()
    require(path.is_dir(), "the log", "be a folder with imu and gnss", folder, "Check the path.")
    location = [f"data.root={json.dumps(str(path.parent))}", f"scenario.folder={json.dumps(path.name)}"]  # fmt: skip
    default = (
        [] if any(w.startswith("scenario=") for w in settings) else ["scenario=user_log_aligned"]
    )
    words = [*default, *location, *settings]
    plans = {name: build_plan(compose([*words, f"filter={name}"])) for name in filters}
    require(plans, "filters", "name a filter", "none", "Use filter=ekf.")
    return _estimate(path.name, plans)


class _Passes(NamedTuple):
    """Passes over a log: parts of the fixes withheld, and last none.

    Attributes:
        model: Model of the motion and of the errors of fixes that last.
        record: Measurements of all passes, [R, T, Dy].
        truth: Withheld fixes relative to the start, m, [R - 1, T, 3]. NaN elsewhere.
        start: Position of the start in the frame of the log, m, [3].
    """

    model: SlowFixErrors
    record: Record
    truth: Tensor
    start: Array


def _estimate(name: str, plans: dict[str, JobPlan]) -> TrackEstimate:
    """Run all filters over the passes of their log."""
    plan = next(iter(plans.values()))
    scenario = plan.scenario
    holdout = getattr(scenario, "holdout", None)
    require(
        isinstance(scenario, AlignedLog) and holdout is not None,
        "scenario",
        "be an own log with held-out fixes",
        scenario,
        "Keep scenario=user_log_aligned and its scenario.holdout.",
    )
    assert isinstance(scenario, AlignedLog)
    assert holdout is not None
    period = holdout.used_fixes + holdout.withheld_fixes
    withheld = plan.draw_episode(torch.arange(period if holdout.shift_between_runs else 1))
    complete = replace(plan, scenario=replace(scenario, holdout=None)).draw_episode(torch.arange(1))
    log = scenario.read_checked(find_dataset(scenario.root, scenario.folder))
    start = scenario.alignment.find(log, scenario.tuning, scenario.start_s).state[7:]
    motion = plan.model
    assert isinstance(motion, StrapdownModel)
    errors = fit_lasting_errors(motion, complete.record)
    model = SlowFixErrors(motion, *torch.tensor(errors[:2], dtype=torch.float64)[:, None])
    record = model.start(_join(withheld.record, complete.record))
    passes = _Passes(model, record, withheld.truth["position"], start)
    usable = np.isfinite(log.fixes.position).all(1)
    truth = passes.truth.numpy()
    _, steps = np.nonzero(np.isfinite(truth[..., 0]))
    time = withheld.time.numpy()
    rule = (
        f"fixes are held out in turn, {holdout.withheld_fixes} of every {period}"
        f"{f', in {period} passes, so that each is held out once' if holdout.shift_between_runs else ''}"
    )
    return TrackEstimate(
        name, time, tuple(_answer(label, item, passes) for label, item in plans.items()),
        np.column_stack([log.fixes.time, log.fixes.position])[usable], time[steps],
        rule, log.centre, errors, withheld.notes,
    )  # fmt: skip


def _join(withheld: Record, complete: Record) -> Record:
    """Join the runs of two records of one log."""
    parts = zip((withheld.y, withheld.start, withheld.spread), (complete.y, complete.start, complete.spread), strict=True)  # fmt: skip
    y, start, spread = (torch.cat([a, b]) for a, b in parts if a is not None and b is not None)
    return withheld._replace(y=y, start=start, spread=spread)


def _answer(name: str, plan: JobPlan, passes: _Passes) -> FilterAnswer:
    """Run a filter over all passes."""
    runs, model = len(passes.record.y), passes.model
    first = len(model.names) - 3
    fixed = torch.tensor(
        [[6 + k, first + k] for k in range(3)]
    )  # position and slow error of each axis
    has_nis: list[bool] = []

    def watch(t: int, info: StepInfo) -> dict[str, Tensor]:
        has_nis.append(info.nis is not None)
        fix = {"fix": info.covariance_of(fixed).sum((-1, -2))}
        if info.nis is None:
            return fix
        nis, dof = info.nis()
        return {"nis": nis, "nis_dof": dof.to(nis), **fix}

    with torch.no_grad():
        smoothed = None
        if isinstance(plan.method, GaussianFilter) and plan.method.plain:
            states = smooth(plan.method, model, passes.record, watch)
            result = states.filtered
            variance = states.covariance.diagonal(dim1=-2, dim2=-1)
            of_fix = states.covariance[..., fixed[:, :, None], fixed[:, None]].sum((-1, -2))
            smoothed = _describe(states.mean, variance, of_fix, passes)
        else:
            draws = PhiloxStream(plan.values["seed"], torch.arange(runs))
            result = run_filter(plan.method, model, passes.record, draws, watch)
        require(
            not bool(result.lost[-1]),
            f"filter {name}",
            "follow the log",
            "a lost run",
            "See its fixes with pfbench inspect, or choose another filter.",
        )
    nis, dof = (result.trace[key][-1].numpy() for key in ("nis", "nis_dof")) if all(has_nis) else (np.zeros(0),) * 2  # fmt: skip
    filtered = _describe(result.mean, result.variance, result.trace["fix"], passes)
    return FilterAnswer(name, filtered, smoothed, nis[dof > 0], dof[dof > 0])


def _describe(mean: Tensor, variance: Tensor, of_fix: Tensor, passes: _Passes) -> MotionEstimate:
    """Return the motion of the pass with all fixes, and the distances of the others to their held-out fixes.

    Shapes: mean [R, T, D], variance [R, T, d], that of position and slow error together of_fix [R, T, 3].
    """
    state, sd = mean[-1, :, :10].numpy().copy(), variance[-1, :, :9].clamp(min=0.0).sqrt().numpy()
    state[:, 7:] += passes.start
    is_held = ~torch.isnan(passes.truth[..., 0])
    error = (mean[:-1, :, 7:10] + mean[:-1, :, -3:] - passes.truth)[is_held]
    total = (of_fix[:-1] + passes.model.r[..., :3] ** 2)[is_held].sqrt()
    return MotionEstimate(state, sd, error.numpy(), total.numpy())
