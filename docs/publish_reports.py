"""Reduce the generated reports to the files that git stores: `python docs/publish_reports.py`.

Git stores report.md, verdicts.json and one figure of each study. The command copies this figure to
`headline.svg` (or .png) and removes the references to all other figures from report.md.
`make report` runs it after the reports. A second run changes nothing.
"""

from __future__ import annotations

import re
from pathlib import Path

from pfbench.files.recorded_folder import RecordedFolder

REPORTS = Path(__file__).parents[1] / "reports"

# Figure of each study, relative to its folder and without suffix.
HEADLINES = {
    "all_seven": "figures/all_proposed_main_group",
    "claims": "figures/claims_printed_ratios",
    "learn_canyon_noise": "scores",
    "learn_data_efficiency": "data_efficiency",
    "learn_noise_calibration": "calibration_location",
    "learn_quad_noise": "flights",
    "learned_azimuth": "figures/azimuth_nominal_sins_gps_azimuth_front",
    "learned_passive": "figures/passive_1_nominal_passive_location_front",
    "paper_000": "figures/paper_000-3_sar_flight_nominal_sins_sar_position",
    "paper_000_growth": "figures/growth_nominal_growth_rmse",
    "paper_000_linear": "figures/linear_walk_nominal_linear_walk_error_state__m",
    "paper_001": "figures/paper_001-2",
    "paper_002": "figures/paper_002-12_anshun_fit_paper_burst_sins_gnss_tight_position",
    "paper_002_bound": "figures/anshun_fit_q_and_r_sins_gnss_tight_rmse",
    "paper_002_entropy": "figures/anshun_fit_paper_burst_sins_gnss_tight_error_position",
    "paper_002_fading": "figures/anshun_fit_nominal_sins_gnss_tight_rmse",
    "paper_002_nonlinear": "figures/anshun_nl_nominal_sins_gnss_tight_nl_rmse",
    "paper_002_rules": "figures/paper_002-10_anshun_fit_nominal_sins_gnss_tight_position",
    "paper_003": "figures/paper_003-5_azimuth_fixed_nominal_sins_gps_azimuth_position",
    "paper_003_biases": "figures/azimuth_fixed_nominal_sins_gps_azimuth_rmse",
    "paper_003_fast": "figures/paper_003-3_azimuth_fixed_nominal_sins_gps_azimuth_attitude",
    "paper_003_particles": "figures/azimuth_fixed_nominal_sins_gps_azimuth_rmse",
    "paper_003_states": "figures/paper_003-3_azimuth_fixed_nominal_sins_gps_azimuth15_attitude",
    "paper_004": "figures/paper_004-4_gps_ins_nominal_ins_gnss_inflated_position",
    "paper_004_alone": "figures/paper_004-before_gps_ins_outage_ins_gnss_inflated_position",
    "paper_004_escape": "figures/gps_ins_nominal_ins_gnss_inflated_rmse",
    "paper_004_iterations": "figures/gps_ins_nominal_ins_gnss_inflated_iterations",
    "paper_004_start": "figures/gps_ins_nominal_ins_gnss_inflated_rmse",
    "recorded_car": "figures/car_drive_nominal_strapdown_total_rmse",
    "recorded_quad": "figures/quad_flights_nominal_strapdown_total_rmse",
}

_IMAGE = re.compile(r"^!\[([^\]]*)\]\(([^)]+)\)\n+(\*[^*\n].*\*\n+)?", re.MULTILINE)


def publish_report(folder: Path) -> None:
    """Copy the headline figure of one report and remove references to files outside git.

    Args:
        folder: Folder of the report. Its name is the study.
    """
    stem = HEADLINES[folder.name]
    suffixes = (".svg", ".png")
    suffix = next((s for s in suffixes if (folder / f"{stem}{s}").exists()), None)
    with RecordedFolder(folder, is_complete=False) as target:
        if suffix is not None:
            for other in suffixes:
                target.remove(f"headline{other}")
            target.write(f"headline{suffix}", (folder / f"{stem}{suffix}").read_bytes())
        page = (folder / "report.md").read_text(encoding="utf-8")
        target.write("report.md", reduce_markdown(page, folder, stem))


def reduce_markdown(text: str, folder: Path, stem: str) -> str:
    """Remove all figures but the headline from a report and link other reports as Markdown.

    Args:
        text: Content of report.md.
        folder: Folder of the report.
        stem: Figure that is kept, without suffix.

    Returns:
        The reduced content.
    """
    headline = next(folder.glob("headline.*"), None)

    def replace(match: re.Match[str]) -> str:
        alt, target, caption = match[1], match[2], match[3] or ""
        if headline is None or Path(target).with_suffix("").as_posix() not in (stem, "headline"):
            return ""
        return f"![{alt}]({headline.name})\n\n{caption}"

    text = _IMAGE.sub(replace, text)
    text = re.sub(
        r"\[(?:figure of )?([^\]]*)\]\((\.\./\w+)/(?:index|details)\.html[^)]*\)",
        r"[\1](\2/report.md)",
        text,
    )
    return _without_empty_sections(text)


def _without_empty_sections(text: str) -> str:
    """Remove headings directly followed by a heading of the same or a higher level."""
    heading = re.compile(r"^(#+) .*\n+(?=(#+) |\Z)", re.MULTILINE)

    def replace(match: re.Match[str]) -> str:
        following = match[2] or ""
        return match[0] if len(following) > len(match[1]) else ""

    while (shorter := heading.sub(replace, text)) != text:
        text = shorter
    return re.sub(r"\n{3,}", "\n\n", text).rstrip("\n") + "\n"


def main() -> None:
    """Publish all reports that exist."""
    for page in sorted(REPORTS.glob("*/report.md")):
        if page.parent.name in HEADLINES:
            publish_report(page.parent)


if __name__ == "__main__":
    main()
