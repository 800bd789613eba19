"""Page of the answer for a log without a reference: tracks, intervals, innovations, agreement and held-out fixes."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pfbench.files.recorded_folder import RecordedFolder
from pfbench.logs.judge.log_page import draw_labelled_curves
from pfbench.report import writers
from pfbench.report.page_kit import Block, with_heading, write_page
from pfbench.results.plotting import FigureSpec, format_slug

if TYPE_CHECKING:
    from pfbench.job import FilterAnswer, MotionEstimate, TrackEstimate
    from pfbench.logs.worlds.slow_fix_errors import LastingErrors

_NORMAL = 1.96  # standard deviations of a 95 % interval


class HeldOutDistance(NamedTuple):
    """Distances to held-out fixes.

    Attributes:
        rms: Root mean square of the horizontal distances, m.
        largest: Distance that 95 % do not exceed, m.
        ratio: Mean square of the differences over their standard deviations; 1 if both are right.
        fixes: Number of fixes.
    """

    rms: float
    largest: float
    ratio: float
    fixes: int


def measure_held_out(motion: MotionEstimate) -> HeldOutDistance:
    """Measure the distances of a track to held-out fixes; lost passes are left out."""
    valid = np.isfinite(motion.held_out).all(1)
    error, sd = motion.held_out[valid], motion.held_out_sd[valid]
    if not len(error):
        return HeldOutDistance(np.nan, np.nan, np.nan, 0)
    distance = np.linalg.norm(error[:, :2], axis=1)
    ratio = float(np.square(error / sd).mean())
    return HeldOutDistance(_rms(distance), float(np.quantile(distance, 0.95)), ratio, len(error))


def describe_track(estimate: TrackEstimate) -> list[str]:
    """Describe an answer in sentences: held-out fixes, innovations and agreement.

    Args:
        estimate: Answers of the filters.

    Returns:
        Lines for the console and the page.
    """
    lines = [
        f"{estimate.name}: {len(estimate.time)} steps from t = {estimate.time[0]:.1f} to {estimate.time[-1]:.1f} s; {estimate.rule}",
        _describe_fix_errors(estimate.fix_errors),
    ]  # fmt: skip
    for name, motion in estimate.tracks().items():
        distances, half = measure_held_out(motion), _NORMAL * np.median(motion.sd[:, 6:9], axis=0)
        lines.append(
            f"{name}: {distances.rms:.2f} m RMS, 95 % within {distances.largest:.2f} m, horizontally from {distances.fixes} held-out fixes; "
            f"mean square over the expected one {distances.ratio:.2f}; 95 % interval of the track in the median +-{half[0]:.2f}, "
            f"{half[1]:.2f}, {half[2]:.2f} m East, North, Up"
        )
    lines += [_describe_innovations(a, estimate.fix_errors.is_clear) for a in estimate.answers]
    first, *others = estimate.answers
    for answer in others:
        distance = _distances(first, answer)
        lines.append(f"{first.name} and {answer.name}: {_rms(distance):.2f} m RMS apart, at most {distance.max():.2f} m")  # fmt: skip
    return lines


def _describe_fix_errors(errors: LastingErrors) -> str:
    """Describe whether the errors of the fixes are white, by the odds of errors that last."""
    if not errors.is_clear:
        return f"fixes: white errors of the stated size explain the innovations; odds of errors that last {errors.odds:.2g}, which white ones take above 100 in one log of a hundred at most"  # fmt: skip
    return (
        f"fixes: their errors last (odds above 100). {errors.white:.0%} of the stated standard deviation is white, and the rest "
        f"has a correlation time of about {errors.time_s:.0f} s. All filters have it as a state, so that intervals include it. An error that lasts "
        "looks like a smaller one: if the receiver is better than tuning.position_sd says, set it"
    )


def _describe_innovations(answer: FilterAnswer, errors_last: bool) -> str:
    """Describe the innovations of a filter; they say that the tuning is too large only if fixes have white errors."""
    if not len(answer.nis):
        return f"{answer.name}: the filter states no innovations"
    mean, band = (
        float(answer.nis.sum() / answer.dof.sum()),
        _NORMAL * np.sqrt(2.0 / answer.dof.sum()),
    )
    where = "within" if abs(mean - 1.0) <= band else "above" if mean > 1.0 else "below"
    cause = {
        "within": "", "above": ": the noise that the tuning states is too small, or the log has a fault, see pfbench inspect",
        "below": "" if errors_last else ": the noise that the tuning states is too large",
    }[where]  # fmt: skip
    return (
        f"{answer.name}: mean NIS per component {mean:.2f}, {where} {1.0 - band:.2f} to {1.0 + band:.2f}, the 95 % band of "
        f"independent innovations{cause}"
    )


def _distances(a: FilterAnswer, b: FilterAnswer) -> Any:
    """Return the horizontal distances between the filtered tracks of two filters, m, [T]."""
    return np.linalg.norm(a.filtered.state[:, 7:9] - b.filtered.state[:, 7:9], axis=1)


def _rms(distance: Any) -> float:
    return float(np.sqrt(np.mean(np.square(distance)))) if len(distance) else float("nan")


def write_track_page(
    estimate: TrackEstimate, out: str | Path, formats: tuple[str, ...] = ("svg", "png")
) -> Path:
    """Write `<out>/estimate_<name>/`: the page, a table of each track, and GPX and KML if the log contains its place.

    Args:
        estimate: Answers of the filters.
        out: Folder of all reports.
        formats: Formats of the pictures.

    Returns:
        Path of index.html.
    """
    with RecordedFolder(Path(out) / format_slug(f"estimate_{estimate.name}")) as folder:
        for name, motion in estimate.tracks().items():
            table = estimate.table(motion)
            folder.write(f"{format_slug(name)}.csv", table.to_csv(index=False, float_format="%.9g"))
        if estimate.centre is not None:
            folder.write("track.gpx", estimate.to_gpx())
            folder.write("track.kml", estimate.to_kml())
        files = [f"{format_slug(name)}.csv" for name in estimate.tracks()]
        no_place = "No GPX and KML: the log has local positions. Set scenario.origin=[lat_deg,lon_deg,h_m]."
        head = "Errors are not known without a reference. Distances to held-out fixes contain the errors of these fixes."
        blocks = [
            Block("title", f"Track of {estimate.name}"),
            Block("text", head),
            Block("heading", "What the log says"),
            Block("list", describe_track(estimate)),
            Block("heading", "Pictures"),
            Block("figures", writers.write_figures(_list_figures(estimate), "track", folder, formats)),
            Block("heading", "Files"),
            Block("links", files if estimate.centre is None else [*files, "track.gpx", "track.kml"]),
            Block("text", no_place if estimate.centre is None else ""),
            *with_heading(Block("heading", "Notes"), Block("list", list(dict.fromkeys(estimate.notes)))),
        ]  # fmt: skip
        return write_page(folder, f"Track of {estimate.name}", blocks)


def _list_figures(estimate: TrackEstimate) -> list[FigureSpec]:
    """List the figures of the page."""
    first, *others = estimate.answers
    tracks, time = estimate.tracks().items(), estimate.time
    order = np.argsort(estimate.held_out_time)
    fixes = [("fixes", estimate.fixes[:, 1], estimate.fixes[:, 2], ".")]
    kinds = [("", first.filtered, "-"), *([(" smoothed", first.smoothed, "--")] if first.smoothed else [])]  # fmt: skip
    nis: list[tuple[Any, ...]] = [(a.name, np.arange(len(a.nis)), a.nis / a.dof, ".") for a in estimate.answers if len(a.nis)]  # fmt: skip
    nis += [("expected", [0, max(len(a.nis) for a in estimate.answers)], [1.0, 1.0], ":")] if nis else []  # fmt: skip
    panels: list[tuple[Any, ...]] = [
        ("map", "Tracks and fixes.", "East [m]", "North [m]",
         [*fixes, *((name, m.state[:, 7], m.state[:, 8]) for name, m in tracks)]),
        ("intervals", f"Half-width of the 95 % intervals of {first.name}. They hold if the stated size of the errors of fixes is right, whether these last or not.", "t [s]", "half-width [m]",
         [(axis + ending, time, _NORMAL * m.sd[:, 6 + k], line) for k, axis in enumerate(("East", "North", "Up")) for ending, m, line in kinds]),
        ("held_out", "Horizontal distance to held-out fixes, each by a pass that did not get the fix.", "t [s]", "distance [m]",
         [(name, estimate.held_out_time[order], np.linalg.norm(m.held_out[order, :2], axis=1), ".") for name, m in tracks]),
        ("innovations", "Normalised innovations squared per component. 1 is expected in the mean.", "measurement", "NIS per component", nis),
        ("agreement", f"Horizontal distance of each filter from {first.name}.", "t [s]", "distance [m]",
         [(answer.name, time, _distances(first, answer)) for answer in others]),
    ]  # fmt: skip
    return [
        FigureSpec(
            name,
            caption,
            partial(draw_labelled_curves, xlabel, ylabel, curves, is_map=name == "map"),
        )
        for name, caption, xlabel, ylabel, curves in panels
        if curves
    ]
