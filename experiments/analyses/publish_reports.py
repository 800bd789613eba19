"""Reduce the generated reports to the files that git stores: `python experiments/analyses/publish_reports.py`.

Git stores report.md, its figures and the runs of each study (runs.parquet), from which the command makes all other
files of its report. For other reports it copies a figure and removes the references to all others from report.md. The results of a script in `experiments/` are stored with six
digits in `results.json.gz`, and its page is made of them. published.json lists
the digests of all of these files. `make report` runs it after the reports. A second run changes nothing.
"""

from __future__ import annotations

import gzip
import json
import re
import subprocess
from importlib import import_module
from pathlib import Path
from typing import Any

from pfbench.files import PUBLISHED_FILES, RecordedFolder, hash_content, write_manifest
from pfbench.report import RUNS_FILE, rebuild_page

REPORTS = Path(__file__).parents[2] / "reports"

# Figure of each report that is not of a study, relative to its folder and without suffix.
HEADLINES = {
    "learn_canyon_noise": "scores",
    "learn_data_efficiency": "data_efficiency",
    "learn_gain": "ratios",
    "learn_noise_calibration": "calibration_location",
    "learn_quad_noise": "flights",
    "learn_room": "rooms",
}
RESULTS = "results.json.gz"  # of a script in experiments/
SUFFIXES = (".svg", ".png")  # of a headline figure, not of the copies that a folder keeps

_IMAGE = re.compile(r"^!\[([^\]]*)\]\(([^)]+)\)\n+(\*[^*\n].*\*\n+)?", re.MULTILINE)


def publish_report(folder: Path) -> None:
    """Copy the headline figure of one report and remove references to files outside git.

    Args:
        folder: Folder of the report. Its name is the study.
    """
    stem = HEADLINES[folder.name]
    suffix = next((s for s in SUFFIXES if (folder / f"{stem}{s}").exists()), None)
    with RecordedFolder(folder, is_complete=False) as target:
        if suffix is not None:
            for other in SUFFIXES:
                target.remove(f"headline{other}")
            target.write(f"headline{suffix}", (folder / f"{stem}{suffix}").read_bytes())
        page = (folder / "report.md").read_text(encoding="utf-8")
        if (folder / f"{folder.name}.json").is_file():
            stored = json.loads((folder / f"{folder.name}.json").read_text(encoding="utf-8"))
            text = json.dumps(round_numbers({key: stored[key] for key in ("request", "done")}))
            target.write(RESULTS, gzip.compress(text.encode(), mtime=0))
        if (folder / RESULTS).is_file():
            page = write_script_page(folder)
        target.write("report.md", reduce_markdown(page, folder, stem))


def round_numbers(value: Any) -> Any:
    """Round all floating-point numbers of a JSON value to six digits.

    Args:
        value: JSON value.
    """
    if isinstance(value, dict):
        return {key: round_numbers(item) for key, item in value.items()}
    if isinstance(value, list):
        return [round_numbers(item) for item in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def write_script_page(folder: Path) -> str:
    """Write the page of a script in `experiments/` from its stored results.

    Args:
        folder: Folder of the report. Its name is that of the script.
    """
    stored = json.loads(gzip.decompress((folder / RESULTS).read_bytes()))
    script = import_module(f"pfbench.experiments.{folder.name}")
    return str(script.write_page(stored["request"], stored["done"]))


def reduce_markdown(text: str, folder: Path, stem: str) -> str:
    """Remove all figures but the headline from a report and link other reports as Markdown.

    Args:
        text: Content of report.md.
        folder: Folder of the report.
        stem: Figure that is kept, without suffix.

    Returns:
        The reduced content.
    """
    names = (f"headline{suffix}" for suffix in SUFFIXES)
    headline = next((folder / name for name in names if (folder / name).exists()), None)

    def replace(match: re.Match[str]) -> str:
        alt, target, caption = match[1], match[2], match[3] or ""
        if headline is None or Path(target).with_suffix("").as_posix() not in (stem, "headline"):
            return ""
        return f"![{alt}]({headline.name})\n\n{caption}"

    text = _IMAGE.sub(replace, text)
    text = re.sub(
        r"\[(?:figure of )?([^\]]*)\]\((\.\./\w+)/index\.html[^)]*\)",
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
    write_manifest(
        PUBLISHED_FILES, hash_published()
    )  # a page may show the published runs of another study
    for page in sorted(REPORTS.glob("*/report.md")):
        if page.parent.name in HEADLINES:
            publish_report(page.parent)
        elif (page.parent / RUNS_FILE).is_file():
            rebuild_page(page.parent)
    write_manifest(PUBLISHED_FILES, hash_published())


def hash_published() -> dict[str, str]:
    """Compute the digests of the files of reports that git stores, which a report may replace without a copy."""
    command = ["git", "ls-files", "-z", "reports/*/*"]
    listed = subprocess.run(command, cwd=REPORTS.parent, check=True, capture_output=True, text=True)
    files = [REPORTS.parent / name for name in filter(None, listed.stdout.split("\0"))]
    return {file.relative_to(REPORTS).as_posix(): hash_content(file.read_bytes()) for file in files}


if __name__ == "__main__":
    main()
