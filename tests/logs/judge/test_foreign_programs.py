"""Real output of KF-GINS and pyins: the numbers of the report against a computation that shares no code."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from command_line import pfbench

HOME = Path(__file__).parent / "car_drive"
NAV, SD, PYINS, REFERENCE = (
    HOME / name
    for name in ("KF_GINS_Navresult.nav", "KF_GINS_STD.txt", "pyins.csv", "reference.csv")
)
ORIGIN = (40.0966268, -105.1474483, 1580.083)
WEEK_S = 243262.0  # s of the GPS week at t = 0
COLUMNS = (
    "t:time,lat_deg:lat,lon_deg:lon,h_m:alt,vn:VN,ve:VE,vd:VD,yaw:heading,"
    "sd_pn:north,sd_pe:east,sd_pd:down"
)


def judge(out: Path, *words: str, nav: Path = NAV):
    given = {word.partition("=")[0] for word in words}
    usual = {
        "reference": str(REFERENCE), "kf": str(nav), "kf.sd": str(SD), "kf.shift": f"{-WEEK_S}",
        "pyins": str(PYINS), "pyins.columns": COLUMNS, "holes": "skip",
        "origin": ",".join(map(str, ORIGIN)), "reports_dir": str(out),
    }  # fmt: skip
    return pfbench(
        "judge", *(f"{k}={v}" for k, v in usual.items() if k not in given), *words, home=out
    )


def local(lat: np.ndarray, lon: np.ndarray, h: np.ndarray) -> np.ndarray:
    """North, East, Down by the semi-axes, as a difference of Earth-centred positions."""
    a, b = 6378137.0, 6378137.0 * (1 - 1 / 298.257223563)

    def earth(lat, lon, h):
        p, m = np.radians(lat), np.radians(lon)
        n = a * a / np.hypot(a * np.cos(p), b * np.sin(p))
        return np.array(
            [
                (n + h) * np.cos(p) * np.cos(m),
                (n + h) * np.cos(p) * np.sin(m),
                (b * b / a / a * n + h) * np.sin(p),
            ]
        )

    x, y, z = earth(lat, lon, h) - earth(*ORIGIN)[:, None]
    p, m = np.radians(ORIGIN[:2])
    radial = np.cos(m) * x + np.sin(m) * y
    up = np.cos(p) * radial + np.sin(p) * z
    return np.stack([np.cos(p) * z - np.sin(p) * radial, np.cos(m) * y - np.sin(m) * x, -up], 1)


def reference(time: np.ndarray) -> np.ndarray:
    """Cubic between the two rows around each time."""
    table = pd.read_csv(REFERENCE)
    clock, p, v = table.t.to_numpy(), table[["pn", "pe", "pd"]], table[["vn", "ve", "vd"]]
    p, v = p.to_numpy(), v.to_numpy()
    k = np.searchsorted(clock, time) - 1
    h = (clock[k + 1] - clock[k])[:, None]
    s = (time - clock[k])[:, None] / h
    start, end = (1 + 2 * s) * (1 - s) ** 2, s**2 * (3 - 2 * s)
    return start * p[k] + end * p[k + 1] + h * (s * (1 - s) ** 2 * v[k] - s**2 * (1 - s) * v[k + 1])


def test_the_report_has_the_numbers_of_another_computation(tmp_path: Path) -> None:
    said = judge(tmp_path)
    assert said.code == 0, said.err
    rows = pd.read_csv(tmp_path / "judge/tables/accuracy.csv").set_index("program")
    nav, sd = np.loadtxt(NAV), np.loadtxt(SD)
    pyins = pd.read_csv(PYINS)
    tracks = {
        "kf": (nav[:, 1] - WEEK_S, nav[:, 2:5], sd[:, 1:4]),
        "pyins": (pyins.time, pyins[["lat", "lon", "alt"]], pyins[["north", "east", "down"]]),
    }
    for name, (time, place, deviation) in tracks.items():
        error = local(*np.asarray(place).T) - reference(np.asarray(time))
        z = error / np.asarray(deviation)
        row = rows.loc[name]
        expected = {
            "north RMSE [m]": np.sqrt(np.mean(error[:, 0] ** 2)),
            "position RMSE [m]": np.sqrt(np.mean((error**2).sum(1))),
            "position maximum [m]": np.linalg.norm(error, axis=1).max(),
            "position NEES (expected 3)": (z**2).sum(1).mean(),
            "coverage of the 90 % interval [%]": 100 * np.mean(np.abs(z) < 1.6448536),
        }
        for column, value in expected.items():
            assert row[column] == pytest.approx(value, rel=1e-4), (name, column)
        assert 1.0 < row["position RMSE [m]"] < 3.0
        assert 0.5 < row["yaw RMSE [deg]"] < 5.0


@pytest.mark.parametrize(
    ("applied", "found"), [(0.0, "must overlap"), (60.0, "must have the clock")]
)
def test_the_proposed_shift_is_the_whole_one(tmp_path: Path, applied: float, found: str) -> None:
    """The file starts 60 s after the reference, so equal starts are no remedy."""
    table = pd.read_csv(REFERENCE)
    early = pd.DataFrame({"t": np.arange(-60.0, table.t[0], 0.25)})
    fine = np.arange(table.t[0], table.t.iloc[-1], 0.25)
    whole = pd.DataFrame(
        {"t": fine, **{c: np.interp(fine, table.t, table[c]) for c in ("pn", "pe", "pd")}}
    )
    path = tmp_path / "long.csv"
    pd.concat([early.assign(pn=0.0, pe=0.0, pd=0.0), whole]).to_csv(path, index=False)
    said = judge(
        tmp_path, f"reference={path}", f"kf.shift={applied - WEEK_S}" if applied else "kf.shift=0"
    )
    assert said.code == 2
    assert found in said.err
    assert f"kf.shift={-WEEK_S:.10g}" in said.err
    assert not (tmp_path / "judge").exists()


def test_a_file_that_ends_early_is_lost_and_reported(tmp_path: Path) -> None:
    text = NAV.read_text()
    cut = tmp_path / "cut.nav"
    cut.write_text(text[: len(text) // 2])
    (tmp_path / "sd.txt").write_text("".join(SD.read_text().splitlines(True)[:18]))
    cut.write_text("".join(text.splitlines(True)[:18]) + text.splitlines()[18][:-20])
    said = judge(tmp_path, f"kf.sd={tmp_path / 'sd.txt'}", nav=cut)
    assert said.code == 0, said.err
    page = (tmp_path / "judge/report.md").read_text()
    assert "Lost: kf" in page
    assert "line 19 has no line end" in page
    decisions = json.loads((tmp_path / "judge/decisions.json").read_text())
    assert decisions["verdicts"][0]["n"] == 0
    assert "kf is lost in 1 of 1 run" in decisions["verdicts"][0]["reason"]


@pytest.mark.parametrize(
    ("column", "message"),
    [
        (slice(8, 11), "column roll must be in deg, got values 0.01745"),
        (slice(2, 4), "column lat_deg must be in deg, got values 0.01745"),
    ],
)
def test_radians_in_a_file_of_kf_gins(tmp_path: Path, column: slice, message: str) -> None:
    """The truth as a file of KF-GINS, with columns in rad."""
    table = pd.read_csv(REFERENCE)
    nav = np.loadtxt(NAV)
    rows = np.stack(
        [np.interp(nav[:, 1] - WEEK_S, table.t, table[c]) for c in ("roll", "pitch", "yaw")], 1
    )
    nav[:, 8:] = np.degrees(rows)
    nav[:, column] = np.radians(nav[:, column])
    np.savetxt(tmp_path / "x.nav", nav, fmt="%.9f")
    said = judge(tmp_path, nav=tmp_path / "x.nav")
    assert said.code == 2
    assert message in said.err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("kf.sd=none.txt",), "sd must be a file, got none.txt for KF_GINS_Navresult.nav"),
        ((f"kf={SD}",), "got 22 fields in the first row. Use the navigation result"),
    ],
)
def test_other_files_of_kf_gins_are_refused(
    tmp_path: Path, words: tuple[str, ...], message: str
) -> None:
    said = judge(tmp_path, *words)
    assert said.code == 2
    assert message in said.err
