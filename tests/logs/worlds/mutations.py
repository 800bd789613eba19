"""Random damage of files, and what each reader makes of it.

Each damaged file ends in an error, in numbers within a tolerance of the undamaged ones, or in a new note.
`run_mutations` counts these, and other exceptions and silently wrong numbers, of which there must be none.
Run: python tests/logs/worlds/mutations.py [count] [readers]
"""

import io
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch

sys.path += [str(Path(__file__).parents[2]), str(Path(__file__).parent)]

from ephemeris_cases import EPHEMERIDES, as_rinex, later_by_two_hours
from recorded_data import DATA
from synthetic_log import tables, write

from pfbench.logs.sky.broadcast_orbits import BroadcastConstellation
from pfbench.logs.worlds.log_reader import read_log
from pfbench.logs.worlds.raw_gnss import RawGnssReceiver, RecordedWalk
from pfbench.logs.worlds.trajectory_file import read_motion
from pfbench.logs.worlds.urban import read_drive

ERROR, CLOSE, NOTED = "error", "within tolerance", "noted"
SILENT, UNWRAPPED = "silently wrong", "other exception"
EVERY_ROW = "silently wrong in every row"  # one column, so that neighbours agree; docs/use_your_data.md says so
SCALES = (np.pi / 180, 180 / np.pi, 1e3, 1e-3, 3.6, 1 / 3.6, 0.3048, 9.80665, -1.0)


class Series(NamedTuple):
    """Values [n, k] at times [n], compared to `tolerance`; `integrated`: over one second."""

    time: np.ndarray
    values: np.ndarray
    tolerance: float
    integrated: bool = False


Reading = tuple[dict[str, Series], tuple[str, ...]]


class Reader(NamedTuple):
    write: Callable[[Path], None]
    read: Callable[[Path], Reading]


def write_log(folder: Path, suffix: str) -> None:
    write(folder, {name: table.round(9) for name, table in tables(6.0).items()}, suffix)


# tolerances: the limits of the notes in pfbench.logs.worlds plus the noise of the undamaged log
def read_navigation(folder: Path) -> Reading:
    log = read_log(folder)
    imu, fixes, motion = log.imu, log.fixes, log.reference
    return {
        "force": Series(imu.time, imu.force, 3.5, integrated=True),  # m/s
        "rate": Series(imu.time, imu.rate, 0.3, integrated=True),  # rad
        "fix": Series(fixes.time, fixes.position, 21.0),  # m
        "fix velocity": Series(fixes.time, fixes.velocity, 5.5),  # m/s
        "position": Series(motion.time, motion.position, 3.0),  # m
        "velocity": Series(motion.time, motion.velocity, 3.5),  # m/s
        "attitude": Series(motion.time, rotation_part(motion.attitude), 0.3),  # rad
    }, log.notes


def rotation_part(q: np.ndarray) -> np.ndarray:
    """Entries of the rotation matrix: without the sign of the quaternion."""
    w, x, y, z = q.T
    return np.stack(
        [
            1 - 2 * (y * y + z * z),
            2 * (x * y - w * z),
            2 * (x * z + w * y),
            1 - 2 * (x * x + z * z),
        ],
        -1,
    )


def three_ephemerides() -> pd.DataFrame:
    first = EPHEMERIDES.assign(health=0.0)
    second = later_by_two_hours(first)
    table = pd.concat([first, second, later_by_two_hours(second)], ignore_index=True)
    return table.assign(iode=np.arange(len(table)) + 11.0)  # a number of each upload


def read_orbits(folder: Path, name: str) -> Reading:
    orbits = BroadcastConstellation(str(folder), name, "2016-06-06T13:00:00")
    time = torch.linspace(-3600.0, 10800.0, 25, dtype=torch.float64)
    position, (offset, _) = orbits.at(time)[0].numpy(), orbits.clock(time)
    series = {}
    for s, satellite in enumerate(orbits.names):
        series[satellite] = Series(time.numpy(), position[:, s], 130.0)  # m, for gaps of four hours
        clock = offset[:, s : s + 1].numpy() + orbits.group_delay(time)[:, s : s + 1].numpy()
        series[f"clock {satellite}"] = Series(time.numpy(), clock, 5e-7)  # s
    return series, orbits.notes


def write_excerpt(folder: Path, dataset: str, end: float, names: tuple[str, ...]) -> None:
    from pyarrow import parquet

    for name in names:
        file = f"{name}.parquet"
        table = parquet.read_table(Path(str(DATA)) / dataset / file)
        rows = table.filter(table["t"].to_numpy() <= end)
        parquet.write_table(rows, folder / file)


def read_walk(folder: Path) -> Reading:
    walk = RecordedWalk(str(folder.parent), folder.name, None, RawGnssReceiver(0.25))  # type: ignore[arg-type]
    leg, sky = walk._read()
    time = np.concatenate([[leg.start_s], leg.time])
    series = {}
    for s, name in enumerate(sky.names):
        series[f"range {name}"] = Series(time, sky.range[:, s : s + 1], 410.0)  # m
        series[f"rate {name}"] = Series(time, sky.rate[:, s : s + 1], 45.0)  # m/s
        series[f"satellite {name}"] = Series(time, sky.satellite_position[:, s], 130.0)  # m
        series[f"velocity {name}"] = Series(time, sky.velocity[:, s], 45.0)  # m/s
    return series, leg.notes


def read_urban(folder: Path) -> Reading:
    drive = read_drive(folder)
    series = {
        "speed": Series(drive.time, drive.speed[:, None], 7.0),  # m/s
        "yaw rate": Series(drive.time, drive.yaw_rate[:, None], 4.0),  # rad/s
        "position": Series(drive.time, drive.position * [6.4e6, 3.9e6, 1.0], 4.0),  # m
    }
    for s, name in enumerate(drive.satellites):
        series[f"range {name}"] = Series(drive.time, drive.range[:, s : s + 1], 410.0)
        series[f"satellite {name}"] = Series(drive.time, drive.satellite_position[:, s], 130.0)
    return series, drive.notes


def read_trajectory(folder: Path) -> Reading:
    motion = read_motion(folder, "reference", [40.0, -105.0, 1500.0])
    metres = motion.pos.numpy() * [6.4e6, 4.9e6, 1.0]
    time = motion.time.numpy()
    return {
        "position": Series(time, metres, 3.0),
        "velocity": Series(time, motion.vel.numpy(), 15.0),
    }, ()


READERS = {
    "log_csv": Reader(lambda f: write_log(f, ".csv"), read_navigation),
    "log_parquet": Reader(lambda f: write_log(f, ".parquet"), read_navigation),
    "rinex2": Reader(
        lambda f: (f / "nav.16n").write_text(as_rinex(2, three_ephemerides())) and None,
        lambda f: read_orbits(f, "nav.16n"),
    ),
    "rinex3": Reader(
        lambda f: (f / "nav.rnx").write_text(as_rinex(3, three_ephemerides())) and None,
        lambda f: read_orbits(f, "nav.rnx"),
    ),
    "ephemeris": Reader(
        lambda f: three_ephemerides().to_parquet(f / "eph.parquet"),
        lambda f: read_orbits(f, "eph.parquet"),
    ),
    "trajectory": Reader(
        lambda f: write(f, {"reference": tables(6.0)["reference"].round(9)}) and None,
        read_trajectory,
    ),
}
if DATA is not None:
    READERS["pseudorange"] = Reader(
        lambda f: write_excerpt(f, "walk_tc_mems", 8.0, ("imu", "pseudorange", "reference")),
        read_walk,
    )
    READERS["urban"] = Reader(
        lambda f: write_excerpt(f, "berlin_urban_tc", 12.0, ("odometry", "pseudorange", "truth")),
        read_urban,
    )


def differs(clean: dict[str, Series], damaged: dict[str, Series]) -> str:
    """Name the first series that leaves its tolerance; '' if none does."""
    for name, series in damaged.items():
        if name not in clean:
            if np.isfinite(series.values).any():
                return name
            continue
        base = clean[name]
        if base.integrated:
            time = base.time[(base.time >= series.time[0]) & (base.time <= series.time[-1])]
            here, there = (interpolate_finite(a, time) for a in (series, base))
            total = np.cumsum((here - there) * np.gradient(time)[:, None], axis=0)
            width = int(np.searchsorted(time, time[0] + 1.0))
            off = np.abs(total[width:] - total[:-width]) if len(total) > width else np.abs(total)
        else:
            inside = (series.time >= base.time[0]) & (series.time <= base.time[-1])
            off = np.abs(series.values[inside] - interpolate_finite(base, series.time[inside]))
        if np.nanmax(off, initial=0.0) > base.tolerance:
            return name
    return ""


def interpolate_finite(series: Series, time: np.ndarray) -> np.ndarray:
    columns = []
    for column in series.values.T:
        finite = np.isfinite(column)
        columns.append(
            np.interp(time, series.time[finite], column[finite]) if finite.any() else time * np.nan
        )
    return np.stack(columns, -1)


# damage of text, as a list of lines
def pick(rng: np.random.Generator, items: int) -> int:
    return int(rng.integers(items))


def damage_bytes(content: bytes, rng: np.random.Generator) -> bytes:
    i, kind = pick(rng, len(content)), pick(rng, 5)
    if kind == 0:
        return content[:i] + bytes([content[i] ^ (1 << pick(rng, 8))]) + content[i + 1 :]
    if kind == 1:
        return content[:i] + content[i + 1 :]
    if kind == 2:
        return content[:i] + bytes([pick(rng, 256)]) + content[i:]
    if kind == 3:
        return content[:i]
    return content[:i] + bytes(min(16, len(content) - i)) + content[i + 16 :]


def damage_lines(lines: list[str], rng: np.random.Generator) -> list[str]:
    i, j, kind = pick(rng, len(lines)), pick(rng, len(lines)), pick(rng, 6)
    if kind == 0:
        del lines[i]
    elif kind == 1:
        lines.insert(j, lines[i])
    elif kind == 2:
        lines[i], lines[j] = lines[j], lines[i]
    else:
        digits = [k for k, letter in enumerate(lines[i]) if letter.isdigit()]
        if digits:
            k = digits[pick(rng, len(digits))]
            new = (str(pick(rng, 10)), " ", "-")[kind - 3]
            lines[i] = lines[i][:k] + new + lines[i][k + 1 :]
    return lines


def damage_table(table: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    numeric = [c for c in table if table[c].dtype.kind in "fiu"]
    column, row, kind = numeric[pick(rng, len(numeric))], pick(rng, len(table)), pick(rng, 10)
    table = table.copy()
    if kind == 0:
        return table.drop(columns=column)
    if kind == 1:
        other = numeric[pick(rng, len(numeric))]
        table[[column, other]] = table[[other, column]].to_numpy()
        return table
    if kind == 2:
        table[column] = table[column].astype(float) * SCALES[pick(rng, len(SCALES))]
    elif kind == 3:
        first = "t" if "t" in table else "toe"
        table[first] = table[first].astype(float)
        table.loc[row:, first] += float(rng.choice([0.05, 0.5, 5.0, 1e3, -0.05, -5.0]))
    elif kind == 4:
        end = row + 1 + pick(rng, 5)
        table = table.drop(index=range(row, min(end, len(table)))).reset_index(drop=True)
    elif kind == 5:
        other = pick(rng, len(table))
        order = np.arange(len(table))
        order[[row, other]] = order[[other, row]]
        table = table.iloc[order].reset_index(drop=True)
    else:
        table[column] = table[column].astype(float)
        old = float(table[column].iloc[row])
        factors = [10.0 ** float(rng.integers(-300, 300)), 10.0, 0.1, 1 + rng.normal(), -1.0]
        new = [*(old * factor for factor in factors), np.nan, np.inf, 0.0, old + rng.normal()]
        table.loc[row, column] = new[pick(rng, len(new))]
    return table


def damage_file(file: Path, rng: np.random.Generator) -> None:
    content = file.read_bytes()
    kind = pick(rng, 3)
    if kind == 0:
        file.write_bytes(damage_bytes(content, rng))
    elif file.suffix == ".parquet":
        from pyarrow import Table, parquet

        old = parquet.read_table(file)
        new = Table.from_pandas(damage_table(old.to_pandas(), rng), preserve_index=False)
        parquet.write_table(new.replace_schema_metadata(old.schema.metadata), file)
    elif kind == 1 and file.suffix == ".csv":
        damage_table(pd.read_csv(file), rng).to_csv(file, index=False)
    else:
        lines = damage_lines(content.decode().splitlines(), rng)
        file.write_text("\n".join(lines) + "\n")


@cache
def undamaged(reader: str) -> tuple[dict[str, bytes], Reading]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        READERS[reader].write(folder)
        files = {file.name: file.read_bytes() for file in sorted(folder.iterdir())}
        return files, READERS[reader].read(folder)


def run_mutations(reader: str, count: int, seed: int) -> Counter[str]:
    """Damage a file of a reader `count` times; returns the counts by outcome, with an example of each failure."""
    files, (clean, clean_notes) = undamaged(reader)
    outcomes: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for number in range(count):
            rng = np.random.default_rng([seed, number])
            for file, content in files.items():
                (folder / file).write_bytes(content)
            file = list(files)[pick(rng, len(files))]
            damage_file(folder / file, rng)
            outcome = outcome_of(reader, folder, clean, set(clean_notes), number)
            if outcome.startswith(SILENT) and (
                names := changed_columns(folder / file, files[file])
            ):
                outcome = f"{EVERY_ROW}: {names}"
            outcomes[outcome] += 1
    return outcomes


def changed_columns(file: Path, undamaged: bytes) -> str:
    """Names of the columns of a table whose values changed in more than half of the rows."""
    if file.suffix not in (".parquet", ".csv"):
        return ""
    read = pd.read_parquet if file.suffix == ".parquet" else pd.read_csv
    before, after = read(io.BytesIO(undamaged)), read(file)
    if len(before) != len(after) or list(before) != list(after):
        return ""
    numbers = [c for c in before if before[c].dtype.kind in "fiu"]
    changed = (before[numbers] != after[numbers]) & ~(
        before[numbers].isna() & after[numbers].isna()
    )
    return ", ".join(c for c in numbers if changed[c].mean() > 0.5)


def outcome_of(
    reader: str, folder: Path, clean: dict[str, Series], notes: set[str], number: int
) -> str:
    try:
        series, new_notes = READERS[reader].read(folder)
    except ValueError as error:
        text = str(error)
        # a message of this package ends with a remedy; those of libraries do not
        return ERROR if text.endswith(".") else f"{UNWRAPPED}: {number} {text[:80]}"
    except Exception as error:
        return f"{UNWRAPPED}: {number} {type(error).__name__} {str(error)[:80]}"
    if set(new_notes) - notes:
        return NOTED
    name = differs(clean, series)
    return f"{SILENT}: {number} {name}" if name else CLOSE


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 300
    for reader in sys.argv[2:] or READERS:
        print(reader, dict(run_mutations(reader, count, seed=1)), flush=True)


if __name__ == "__main__":
    main()
