"""The largest angle of sigma points at which the UKF still works, for headings of large uncertainty.

The flight is that of [wrong headings](heading_errors.md), with the heading error of each run drawn from its normal
prior. The spread alpha of the UKF sets the reach: the angle of the outermost point from the mean at the start.
Results are kept in point_reach.json.

Run: python benchmarks/point_reach.py [--runs 96]; --page writes the page from the stored results alone.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

from heading_errors import measure, unscented_filter

HERE = Path(__file__).parent
STORE = HERE / "point_reach.json"
HEADING_SDS = (30, 45, 60, 90)  # deg
REACHES = (0.5, 1.0, 1.5, 2.0, 2.4, 2.8, 3.1)  # rad
STATES = 15


def measure_reach(heading_sd: float, reach: float, runs: int) -> dict[str, Any]:
    """Run the UKF whose points reach an angle.

    Args:
        heading_sd: Standard deviation of the initial heading, deg.
        reach: Angle of the outermost initial point from the mean, rad.
        runs: Number of runs.

    Returns:
        Row of the table.
    """
    alpha = reach / (math.sqrt(STATES) * math.radians(heading_sd))
    values = measure(unscented_filter(alpha), heading_sd, runs, is_random=True)
    names = ("settled", "settle_s", "nees_10_30", "position")
    return {
        "heading_sd": heading_sd,
        "reach": reach,
        "alpha": alpha,
        **{name: values[name] for name in names},
    }


def page(stored: dict[str, Any]) -> str:
    """Return the page of the stored results."""
    assert __doc__ is not None
    lines = [
        "# Reach of sigma points in angles",
        "",
        " ".join(__doc__.split("\n\n")[1].split()[:-5]),
        "Written by `benchmarks/point_reach.py`.",
        "",
        f"{stored['runs']} runs of 60 s. A run settles when its heading stays within 5 degrees. NEES is divided by its {STATES}",
        "components; 1 is consistent. The position error is the median RMSE of the runs. Sigma-point filters refuse a reach",
        "above 2 rad. A spread alpha of 1 is that of `ukf` and of the cubature filter `ckf`.",
        "",
        "| heading sd [deg] | reach [rad] | alpha | settled | time [s] | NEES, 10 to 30 s | position [m] |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in stored["rows"]:
        settle = "never" if row["settle_s"] is None else f"{row['settle_s']:.1f}"
        lines.append(
            f"| {row['heading_sd']} | {row['reach']} | {row['alpha']:.2f} | {row['settled']} | {settle} | "
            f"{row['nees_10_30']:.3g} | {row['position']:.2f} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure all spreads and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=96)
    parser.add_argument("--page", action="store_true")
    options = parser.parse_args()
    if not options.page:
        rows = []
        for heading_sd in HEADING_SDS:
            for reach in REACHES:
                rows.append(measure_reach(heading_sd, reach, options.runs))
                print(rows[-1], flush=True)
        STORE.write_text(json.dumps({"runs": options.runs, "rows": rows}, indent=1) + "\n")
    (HERE / "point_reach.md").write_text(page(json.loads(STORE.read_text())))


if __name__ == "__main__":
    main()
