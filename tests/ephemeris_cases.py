"""Two made-up ephemerides, carried on in time and written as RINEX."""

import math
from datetime import datetime, timedelta

import numpy as np
import pandas as pd

from pfbench.logs.sky.ephemeris import GM_GPS
from pfbench.nav import earth

# one eccentric and one nearly circular satellite, every parameter at work. deltan, Omegadot, cu and cr are fitted to
# the gravity of an oblate Earth, as those of broadcast orbits are
EPHEMERIDES = pd.DataFrame(
    {
        "sys": ["G", "E"], "prn": [7, 14], "week": [1900, 1900], "toe": [129600.0, 129600.0], "toc": [129584.0, 129600.0],
        "sqrtA": [5153.7, 5289.3], "e": [0.0123, 0.163], "i0": [0.96, 0.86], "Omega0": [-2.4, 0.8], "omega": [0.47, 2.95],
        "M0": [2.37, 0.12], "deltan": [4.247e-9, 6.75e-9], "Omegadot": [-7.632e-9, -9.249e-9], "idot": [6.2e-10, -4.0e-10],
        "cuc": [8.4e-7, 2.031e-6], "cus": [5.467e-6, 5.832e-7], "crc": [285.74, 321.88], "crs": [25.69, 32.732],
        "cic": [-1.8e-7, 2.0e-6], "cis": [-8.0e-8, 2.1e-6], "af0": [2.3e-5, 4.8e-4], "af1": [1.3e-12, 2.0e-12],
        "af2": [1e-18, 0.0], "tgd": [5.1e-9, -3.0e-9], "ttx": [126000.0, 126000.0],
    }
)  # fmt: skip


def later_by_two_hours(table: pd.DataFrame) -> pd.DataFrame:
    """The ephemerides of the same orbits for a time two hours later: angles that turn evenly are carried on."""
    gm = table["sys"].map({"G": GM_GPS, "E": earth.GM})
    motion = np.sqrt(gm) / table["sqrtA"] ** 3 + table["deltan"]
    return table.assign(
        toe=table["toe"] + 7200.0,
        toc=table["toc"] + 7200.0,
        M0=(table["M0"] + motion * 7200.0) % (2 * math.pi),
        Omega0=table["Omega0"] + table["Omegadot"] * 7200.0,
        i0=table["i0"] + table["idot"] * 7200.0,
        af0=table["af0"] + (table["af1"] + 7200.0 * table["af2"]) * 7200.0,
        af1=table["af1"] + 2.0 * 7200.0 * table["af2"],
    )


FIRST = (
    "af0",
    "af1",
    "af2",
    "iode",
    "crs",
    "deltan",
    "M0",
    "cuc",
    "e",
    "cus",
    "sqrtA",
    "toe",
    "cic",
    "Omega0",
    "cis",
    "i0",
)
ORDER = (*FIRST, "crc", "omega", "Omegadot", "idot", "codes", "week", "l2p", "ura", "health")


def as_rinex(version: int, table: pd.DataFrame = EPHEMERIDES) -> str:
    """The same ephemerides as a RINEX file, those of Galileo as I/NAV and, with a wrong clock, as F/NAV."""
    indent = version + 1
    kind = "N: GNSS NAV DATA    M: MIXED" if version == 3 else "N: GPS NAV DATA"
    lines = [f"{version:6d}.00           {kind:<40}RINEX VERSION / TYPE", f"{'':60}END OF HEADER"]
    for row in table.assign(iode=1.0, codes=5.0, l2p=0.0, ura=2.0, health=0.0).to_dict("records"):
        if version == 2 and row["sys"] == "E":
            continue
        last = [row["tgd"], 3.0] if row["sys"] == "G" else [9e-9, row["tgd"]]
        for codes in (5.0, 258.0) if row["sys"] == "E" else (1.0,):
            row = {**row, "codes": codes, "af0": row["af0"] + (codes == 258.0)}
            clock = datetime(2016, 6, 5) + timedelta(seconds=row["toc"])
            head = (
                f"{row['sys']}{row['prn']:02d} {clock:%Y %m %d %H %M %S}"
                if version == 3
                else f"{row['prn']:2d} 16  6  6 {clock:%H %M %S}.0"
            )
            numbers = [*(row[name] for name in ORDER), *last, row["ttx"], 4.0]
            text = [f"{value:19.12E}".replace("E", "D") for value in numbers]
            lines.append(head + "".join(text[:3]))
            lines += [" " * indent + "".join(text[k : k + 4]) for k in range(3, len(text), 4)]
    return "\n".join(lines) + "\n"
