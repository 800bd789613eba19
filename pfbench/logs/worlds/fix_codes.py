"""Codes of the column `fix`: which fixes of a table are used.

Programs count differently: 4 is the best fix of NMEA and a differential one of RTKLIB. Only 0 and 1
are used without a statement of the program.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from pfbench.core.parameter_checks import require
from pfbench.logs.worlds.log_tables import LogTable, parse_numbers

# names of the codes of each program, those of fixes that are not used in the second place
PROGRAMS: dict[str, tuple[dict[int, str], dict[int, str]]] = {
    "nmea": (  # quality indicator of GGA
        {1: "GPS", 2: "differential", 3: "PPS", 4: "RTK fixed", 5: "RTK float"},
        {0: "invalid", 6: "dead reckoning", 7: "manual", 8: "simulator"},
    ),
    "rtklib": (  # column Q of a .pos file
        {1: "fixed", 2: "float", 3: "SBAS", 4: "differential", 5: "single", 6: "PPP"},
        {0: "none", 7: "dead reckoning"},
    ),
    "mavlink": (  # GPS_FIX_TYPE of ArduPilot and PX4
        {3: "3D", 4: "differential", 5: "RTK float", 6: "RTK fixed", 8: "PPP"},
        {0: "no receiver", 1: "none", 2: "2D", 7: "static"},
    ),
    "ublox": (  # fixType of UBX-NAV-PVT
        {3: "3D", 4: "3D with dead reckoning"},
        {0: "none", 1: "dead reckoning", 2: "2D", 5: "time only"},
    ),
}

FixCodes = str | Sequence[int] | None


def check_fix_codes(codes: FixCodes) -> None:
    """Check the configuration key `scenario.fix_codes`."""
    is_valid = codes in PROGRAMS if isinstance(codes, str | None) else len(codes) > 0 and all(type(code) is int and code >= 0 for code in codes)  # fmt: skip
    require(
        is_valid or codes is None,
        "scenario.fix_codes",
        f"be {', '.join(PROGRAMS)}, null or whole numbers of at least 0",
        codes if isinstance(codes, str | None) else list(codes),
        "Set the program that wrote the column fix, or the codes to use, such as [4,5].",
    )


def select_usable(table: LogTable, codes: FixCodes) -> tuple[NDArray[np.bool_], tuple[str, ...]]:
    """Select the fixes to use by the column `fix`.

    Returns mask of used fixes, [n], and a note with the number of fixes of each code.
    """
    check_fix_codes(codes)
    if "fix" not in table.rows:
        return np.ones(len(table.rows), bool), ()
    values = parse_numbers(table, ("fix",))[:, 0]
    numbers, rows = np.unique(values, return_counts=True)
    counts = {float(number): int(n) for number, n in zip(numbers, rows, strict=True)}
    used, unused = _meaning(codes)
    unknown = [code for code in counts if code not in used and code not in unused]
    if unknown and (codes is None or isinstance(codes, str)):
        raise ValueError(_describe_unknown(table, codes, counts, unknown[0]))
    mask = np.isin(values, list(used))
    texts = [
        f"{code:g}{f' ({name})' if (name := {**used, **unused}.get(int(code), '')) else ''} in {n} rows"
        for code, n in counts.items()
    ]
    require(
        mask.any(),
        table.name,
        "have a usable fix",
        f"none of {len(mask)}: column fix is {', '.join(texts)}",
        f"If these fixes are good, set scenario.fix_codes=[{max(counts, key=lambda code: counts[code]):g}] with their codes. "
        "Use another receiver log otherwise.",
    )
    program = f" as codes of {codes}" if isinstance(codes, str) else ""
    note = (
        f"{table.name}: {int(mask.sum())} of {len(mask)} fixes used; column fix{program} is "
        f"{', '.join(texts)}"
    )
    return mask, (note,)


def _meaning(codes: FixCodes) -> tuple[Mapping[int, str], Mapping[int, str]]:
    """Return the names of used codes, and of codes that are not used."""
    if codes is None:
        return {1: "used"}, {0: "not used"}
    if isinstance(codes, str):
        return PROGRAMS[codes]
    return dict.fromkeys(codes, "used"), {}


def _describe_unknown(
    table: LogTable, codes: FixCodes, counts: Mapping[float, int], code: float
) -> str:
    """Describe a code that the chosen program does not have, with the programs under which the table is read."""
    total = sum(counts.values())
    remedies = []
    for program, (used, unused) in PROGRAMS.items():
        usable = sum(n for number, n in counts.items() if number in used)
        if usable and all(number in used or number in unused for number in counts):
            remedies.append(f"{program} (uses {usable} of {total})")
    positive = [f"{number:g}" for number in counts if number == int(number) and number > 0]
    example = f"to the codes to use, such as [{','.join(positive or ['1'])}]"
    required = f"be a code of {codes}" if codes else "be 0 or 1 (1: use the fix)"
    return (
        f"{table.name}: column fix must {required}, got {code:g} in {counts[code]} of {total} rows. "
        "Programs count the quality of a fix differently. Set scenario.fix_codes="
        f"{', or '.join([*remedies, example])}."
    )
