"""A fault is planted, the remedies of the messages are followed, and the numbers are those of the unharmed file."""

import re
from collections.abc import Callable
from pathlib import Path

import judge_cases as cases
import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from pfbench.logs.judge.judge_options import JudgeOptions, SourceOptions
from pfbench.logs.judge.judgement import judge_programs
from pfbench.logs.judge.page import describe_notes, tabulate_accuracy

Change = Callable[[pd.DataFrame], pd.DataFrame]
POSITION, VELOCITY = ["pn", "pe", "pd"], ["vn", "ve", "vd"]
DEGREE = 180 / np.pi
TRUTH = cases.drive(100.0)
ESTIMATE = pd.concat(
    [cases.estimate(TRUTH, 1.0, 1)[["t", *POSITION]], TRUTH.drop(columns=["t", *POSITION])], axis=1
)


def scale(factor: float, *columns: str) -> Change:
    return lambda d: d.assign(**{name: factor * d[name] for name in columns})


def unharmed(table: pd.DataFrame) -> pd.DataFrame:
    return table


def places(table: pd.DataFrame) -> pd.DataFrame:
    """Time and position alone."""
    return table[["t", *POSITION]]


def counter(period: float, unit: float = 1.0) -> Change:
    """A counter that starts again 50 s after the start."""
    return lambda d: d.assign(t=((d.t - 50) * unit) % period)


def noisy_degrees(table: pd.DataFrame) -> pd.DataFrame:
    noise = np.random.default_rng(0).normal(size=len(table))
    return table.assign(yaw=(DEGREE * table.yaw + 0.6 * noise) % 360)


FAULTS: dict[str, tuple[Change, Change, str]] = {  # of the program, of the reference, remedy
    "ms": (scale(1e3, "t"), unharmed, "mine.scale=t:0.001"),
    "us since boot": (lambda d: d.assign(t=1e6 * (d.t + 5)), unharmed, "mine.scale=t:1e-06"),
    "ns since 1970": (lambda d: d.assign(t=1e9 * (d.t + 1.4e9)), unharmed, "mine.scale=t:1e-09"),
    "ns since 1970 in both": (lambda d: d.assign(t=1e9 * (d.t + 1.4e9)),) * 2 + ("reference.scale=t:1e-09",),
    "minutes": (scale(1 / 60, "t"), unharmed, "mine.scale=t:60"),
    "ms in both": (scale(1e3, "t"), scale(1e3, "t"), "t in ms: set reference.scale=t:0.001"),
    "reference in ms": (places, lambda d: scale(1e3, "t")(places(d)), "reference.scale=t:0.001"),
    "offset": (lambda d: d.assign(t=d.t + 18), unharmed, "mine.shift=-18"),
    "feet": (scale(3.28084, *POSITION), unharmed, "mine.scale=pn:0.3048,pe:0.3048,pd:0.3048"),
    "km in both": (scale(1e-3, *POSITION), scale(1e-3, *POSITION), "pn, pe, pd in km"),
    "km/h": (scale(3.6, *VELOCITY), unharmed, "mine.scale=vn:0.277778,ve:0.277778,vd:0.277778"),
    "knots in both": (scale(1.943844, *VELOCITY), scale(1.943844, *VELOCITY), "vn, ve, vd in knots"),
    "noisy degrees": (noisy_degrees, unharmed, "mine.scale=yaw:0.0174533"),
    "degrees in both": (noisy_degrees, noisy_degrees, "direction of motion in degrees. Set reference.scale"),
    "turned degrees in both": (lambda d: d.assign(yaw=DEGREE * d.yaw + 30),) * 2 + ("in degrees. Set reference.scale",),
    "rad converted twice": (scale(1 / DEGREE, "yaw"), unharmed, "mine.scale=yaw:57.2958"),
    "tenths of degrees": (scale(10 * DEGREE, "yaw"), unharmed, "mine.scale=yaw:0.00174533"),
    "gon": (scale(200 / np.pi, "yaw"), unharmed, "mine.scale=yaw:0.015708"),
    "all angles": (scale(DEGREE, "roll", "pitch", "yaw"), unharmed, "If in degrees, set mine.scale=pitch:0.01745"),
    "cm/s": (scale(1e2, *VELOCITY), unharmed, "If in cm/s, set mine.scale=vn:0.01; if in mm/s"),
    "opposite yaw": (scale(-1, "yaw"), unharmed, "Multiply the column by -1"),
    "week": (counter(604800.0), unharmed, "add 604800 to t from line 102"),
    "midnight": (counter(86400.0), unharmed, "add 86400 to t from line 102"),
    "ms of the week": (counter(604800e3, 1e3), unharmed, "add 604800000 to t from line 102"),
    "32 bits of us": (counter(2.0**32, 1e6), unharmed, "add 4294967296 to t from line 102"),
    "repeated rows": (lambda d: pd.concat([d[:5], d[4:]]), unharmed, "Keep one row for each time"),
    "lost order": (lambda d: d.sample(frac=1.0, random_state=0), unharmed, "Sort the rows by t"),
    "two runs": (lambda d: pd.concat([d, d]), unharmed, "Keep one part: the longest is line 2 to line 202"),
    "missing values": (lambda d: d.assign(vn=d.vn.where(d.t > 3)), unharmed, "Remove these rows"),
    "no velocity": (lambda d: d.assign(vn=np.nan), unharmed, "Remove or rename the columns of its group"),
}  # fmt: skip


def position_rmse(files: dict[str, Path], options: dict[str, dict[str, object]]) -> float:
    sources = {name: SourceOptions(**values) for name, values in options.items()}
    judged = judge_programs(str(files["reference"]), {"mine": str(files["mine"])}, None, sources)
    return float(tabulate_accuracy(judged.sequences)["position RMSE [m]"].iloc[0])


def follow_option(message: str, options: dict[str, dict[str, object]]) -> bool:
    """Set the first option of a message, and multiply factors that are set already."""
    match = re.search(r"(mine|reference)\.(scale|shift|frame)=(\S+?)[.,;]?(\s|$)", message)
    if not match:
        return False
    name, key, value, _ = match.groups()
    of_source = options.setdefault(name, {})
    if key == "scale":
        factors = dict(of_source.get("scale", {}))
        for pair in value.split(","):
            column, factor = pair.split(":")
            factors[column] = factors.get(column, 1.0) * float(factor)
        of_source[key] = factors
    else:
        of_source[key] = float(value) if key == "shift" else value
    return True


def follow_edit(message: str, table: pd.DataFrame) -> pd.DataFrame:
    """Change the table as a message without an option says; line 2 is row 0."""
    table = table.reset_index(drop=True)
    if match := re.search(r"add (\d+) to t from line (\d+)", message):
        return table.assign(t=table.t + float(match[1]) * (table.index >= int(match[2]) - 2))
    if "Multiply the column by -1" in message:
        return table.assign(yaw=-table.yaw)
    if "Sort the rows" in message:
        return table.sort_values("t")
    if "Keep one part" in message:
        return table[: int(message.rstrip(".").split()[-1]) - 1]
    if "Remove these rows" in message:
        return table.dropna()
    if "Remove or rename the columns" in message:
        return table.drop(columns=VELOCITY)
    assert "Keep one row for each time" in message
    return table.drop_duplicates("t")


@pytest.mark.parametrize("case", FAULTS)
def test_the_remedies_give_the_numbers_of_the_unharmed_file(tmp_path: Path, case: str) -> None:
    mine, reference, remedy = FAULTS[case]
    table = mine(ESTIMATE).reset_index(drop=True)
    files = {
        "mine": cases.write(table, tmp_path / "mine.csv"),
        "reference": cases.write(reference(TRUTH), tmp_path / "truth.csv"),
    }
    options: dict[str, dict[str, object]] = {}
    messages = []
    for _ in range(6):
        try:
            rmse = position_rmse(files, options)
            break
        except ValueError as error:
            messages.append(str(error))
            if not follow_option(messages[-1], options):
                table = follow_edit(messages[-1], table)
                cases.write(table, files["mine"])
    else:
        pytest.fail("\n".join(messages))
    assert remedy in messages[0], messages
    errors = (ESTIMATE[POSITION] - TRUTH[POSITION]).to_numpy()
    if case == "missing values":
        errors = errors[(TRUTH.t > 3).to_numpy()]
    expected = np.sqrt((errors**2).sum(axis=1).mean())
    assert rmse == pytest.approx(expected, rel=0.02)


def test_an_angle_that_is_wrong_in_rad_is_not_called_degrees(tmp_path: Path) -> None:
    """Another heading, a turned one and a random one stay errors of the program; on a straight drive with a note."""
    rng = np.random.default_rng(0)
    straight = TRUTH.assign(pn=10 * TRUTH.t, pe=0.0, pd=0.0, vn=10.0, ve=0.0, vd=0.0, yaw=0.02)
    for truth, noted in ((TRUTH, False), (straight, True)):
        reference = cases.write(truth, tmp_path / "truth.csv")
        for yaw in (truth.yaw + np.pi, truth.yaw + 20 * np.pi, rng.uniform(-3, 3, len(truth))):
            mine = cases.write(truth.assign(yaw=yaw), tmp_path / "mine.csv")
            judged = judge_programs(str(reference), {"mine": str(mine)})
            notes = [n for n in describe_notes(judged, JudgeOptions()) if "in degrees" in n]
            turned = np.abs(np.exp(1j * (np.asarray(yaw) - truth.yaw)).mean() - 1) < 0.1
            assert len(notes) == (noted and not turned)


SLOW = {
    "us": (places(TRUTH.assign(t=1e6 * TRUTH.t)), "set reference.scale=t:1e-06"),
    "rad": (
        pd.DataFrame(cases.geodetic(TRUTH) * [1 / DEGREE, 1 / DEGREE, 1], columns=["lat_deg", "lon_deg", "h_m"]).assign(t=TRUTH.t),
        "reference.scale=lat_deg:57.2958,lon_deg:57.2958",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", SLOW)
def test_units_that_nothing_contradicts_are_noted(tmp_path: Path, case: str) -> None:
    table, note = SLOW[case]
    file = str(cases.write(table, tmp_path / "all.csv"))
    notes = list(describe_notes(judge_programs(file, {"mine": file}), JudgeOptions()))
    assert sum(note in text for text in notes) == 1, notes
    assert sum(note.replace("reference", "mine") in text for text in notes) == 1


def test_velocities_show_radians_in_all_files(tmp_path: Path) -> None:
    table = SLOW["rad"][0].assign(**TRUTH[VELOCITY])
    file = str(cases.write(table, tmp_path / "all.csv"))
    with pytest.raises(ValueError, match=r"reference.scale=lat_deg:57.2958,lon_deg:57.2958"):
        judge_programs(file, {"mine": file})


def test_a_consistent_file_has_no_note_on_units(tmp_path: Path) -> None:
    """Errors of 10 m, a walk, a standstill and an early Unix time are no faults."""
    rng = np.random.default_rng(0)
    noise = {name: TRUTH[name] + 10 * rng.normal(size=len(TRUTH)) for name in POSITION}
    slow = TRUTH.assign(**{name: 0.1 * TRUTH[name] for name in (*POSITION, *VELOCITY)})
    still = TRUTH.assign(**dict.fromkeys((*POSITION, *VELOCITY), 0.0), yaw=1.1)
    for table in (TRUTH.assign(**noise), slow, still, TRUTH.assign(t=TRUTH.t + 1.7e9)):
        file = str(cases.write(table, tmp_path / "all.csv"))
        assert list(describe_notes(judge_programs(file, {"mine": file}), JudgeOptions())) == []


def test_the_columns_of_a_pose_of_kitti_are_read_after_the_advice(tmp_path: Path) -> None:
    rotation = Rotation.from_euler("z", ESTIMATE[["yaw"]].to_numpy().copy()).as_matrix()
    poses = np.concatenate([rotation, ESTIMATE[POSITION].to_numpy()[:, :, None]], axis=2)
    np.savetxt(tmp_path / "poses.txt", poses.reshape(-1, 12))
    files = {
        "mine": tmp_path / "poses.txt",
        "reference": cases.write(TRUTH, tmp_path / "truth.csv"),
    }
    with pytest.raises(ValueError, match=r"poses of KITTI.*columns 4, 8 and 12") as error:
        position_rmse(files, {})
    columns = [int(k) - 1 for k in re.findall(r"\d+", str(error.value).split("columns")[1])]
    table = pd.DataFrame(np.loadtxt(tmp_path / "poses.txt")[:, columns], columns=POSITION)
    files["mine"] = cases.write(table.assign(t=TRUTH.t), tmp_path / "mine.csv")
    assert position_rmse(files, {}) == pytest.approx(1.7, abs=0.3)


@pytest.mark.parametrize("has_dates", [True, False])
def test_a_solution_of_rtklib_is_read_at_the_second_of_its_week(
    tmp_path: Path, has_dates: bool
) -> None:
    week, second = 2086, 604750.0 + TRUTH.t
    days = pd.Timestamp("1980-01-06") + pd.to_timedelta(week * 604800 + second, unit="s")
    stamps = [f"{week + s // 604800:.0f} {s % 604800:.3f}" for s in second]
    if has_dates:
        stamps = [f"{day:%Y/%m/%d %H:%M:%S.%f}" for day in days]
    head = "% program   : RTKPOST ver.2.4.3\n%  GPST  latitude(deg) longitude(deg)  height(m)   Q  ns\n"
    rows = [
        f"{s}   {lat:.9f} {lon:.9f} {h:.4f} 1 9\n"
        for s, (lat, lon, h) in zip(stamps, cases.geodetic(ESTIMATE), strict=True)
    ]
    file = tmp_path / "rover.pos"
    file.write_text(head + "".join(rows))
    truth = pd.DataFrame(cases.geodetic(TRUTH), columns=["lat_deg", "lon_deg", "h_m"])
    files = {
        "mine": file,
        "reference": cases.write(truth.assign(t=TRUTH.t), tmp_path / "truth.csv"),
    }
    with pytest.raises(ValueError, match=r"mine\.shift=-604750") as error:
        position_rmse(files, {})
    options: dict[str, dict[str, object]] = {}
    assert follow_option(str(error.value), options)
    assert position_rmse(files, options) == pytest.approx(1.7, abs=0.3)


def test_a_frame_is_named_after_a_try(tmp_path: Path) -> None:
    zero = 0.0 * TRUTH.t
    np.savetxt(
        tmp_path / "mine.txt",
        np.column_stack([TRUTH.t, ESTIMATE[POSITION], zero, zero, zero, zero + 1]),
    )
    truth = cases.write(places(TRUTH), tmp_path / "truth.csv")
    files = {"mine": tmp_path / "mine.txt", "reference": truth}
    with pytest.raises(ValueError, match=r"Set mine.frame=ned\.") as error:
        position_rmse(files, {"mine": {"frame": "enu"}})
    options: dict[str, dict[str, object]] = {}
    follow_option(str(error.value), options)
    assert position_rmse(files, options) == pytest.approx(1.7, abs=0.3)
