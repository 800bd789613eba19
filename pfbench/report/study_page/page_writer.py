"""Writer of the report page: index.html with all data, and report.md of one screen."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from pfbench.files.recorded_folder import RecordedFolder
from pfbench.report.journal.methods_text import write_methods
from pfbench.report.study_page.encoding import encode_pack
from pfbench.report.study_page.equal_time import offer_budgets
from pfbench.report.study_page.opening import describe_opening, describe_pairs, name_effects
from pfbench.report.writers import template_environment

PAGE_BYTES = 1_500_000
_HERE = Path(__file__).parent
_SCRIPTS = ("kit", "state", "board", "cost", "pairs", "worlds", "time", "runs", "main")
_OPTIONAL = ("paper_figures", "failures", "definitions", "filter_notes", "choices", "robustness")
_STATIC = (
    *_OPTIONAL,
    "facts",
    "methods",
    "bibtex",
    "provenance",
    "downloads",
)  # not read by the script
_COLOUR = re.compile(r"#[0-9a-fA-F]{6}")
_SECTIONS = (
    ("planned", "planned", "Planned comparisons"), ("cells", "worlds", "Scenarios"), ("curves", "time", "Over time"),
    ("calibration", "calibration", "Calibration"), ("runs", "runs", "Single runs"), ("sweeps", "sweeps", "Dose and response"),
    ("paper_figures", "figures", "Figures of the paper"), ("cells", "table", "Table"), ("methods", "methods", "Methods"), ("downloads", "downloads", "Downloads"),
)  # fmt: skip


def write_page(pack: Mapping[str, Any], folder: RecordedFolder) -> Path:
    """Write index.html and report.md of a study. Equal packs give equal bytes.

    Args:
        pack: Data of the page, as `pfbench.report.board` makes it.
        folder: Target folder.

    Returns:
        Path of index.html.

    Raises:
        ValueError: If a colour is not of the form #rrggbb.
    """
    pack = {**dict.fromkeys(_OPTIONAL, ()), **pack}
    pack["budgets"] = offer_budgets(pack)
    names = {look["key"]: look["name"] for look in pack["filters"]}
    context = {
        "pack": pack,
        "opening": describe_opening(pack),
        "planned": describe_pairs(pack),
        "effects": name_effects(pack),
        "level": _format_level(pack),
        "methods": write_methods(pack),
        "notes": [{**note, "name": names[note["filter"]]} for note in pack["filter_notes"]],
        "choices": pack["choices"],
        "files": _group_files(pack["downloads"]),
        "sections": [
            (anchor, title)
            for key, anchor, title in _SECTIONS
            if pack[key] and not (anchor == "worlds" and len(pack["cells"]) < 2)
        ],
        "css": Markup(
            "\n".join(
                path.read_text(encoding="utf-8")
                for path in (_HERE.parent / "style.css", _HERE / "page.css")
            )
        ),
        "colours": Markup(_format_colours(pack["filters"])),
        "script": Markup("\n".join(_read_script(name) for name in _SCRIPTS)),
        "data": "",
    }
    html = template_environment(_HERE, is_html=True).get_template("page.html.jinja")
    script_data = {key: value for key, value in pack.items() if key not in _STATIC}
    data = encode_pack(script_data, PAGE_BYTES - len(html.render(context).encode()))
    folder.write("index.html", html.render({**context, "data": Markup(data)}))
    write_markdown(pack, folder)
    return folder.path / "index.html"


def write_markdown(pack: Mapping[str, Any], folder: RecordedFolder) -> None:
    """Write report.md of a study, one screen.

    Args:
        pack: Data of the page. `headline` names the figure headline.svg of a published study, and
            `headline_note` the filters that it does not show.
        folder: Target folder.
    """
    context = {
        "pack": {"headline": "", "headline_note": "", "failures": (), **pack},
        "choices": pack.get("choices", ()),
        "opening": describe_opening(pack),
        "planned": describe_pairs(pack),
        "effects": name_effects(pack),
        "level": _format_level(pack),
    }
    template = template_environment(_HERE, is_html=False).get_template("report.md.jinja")
    folder.write("report.md", template.render(context))


def _format_level(pack: Mapping[str, Any]) -> str:
    """Return the level of intervals in percent."""
    return f"{100 * (1 - pack['alpha']):g}"


def _read_script(name: str) -> str:
    """Return one file of the script without indents and lines of comments."""
    lines = (_HERE / f"{name}.js").read_text(encoding="utf-8").splitlines()
    stripped = [line.strip() for line in lines]
    return "\n".join(line for line in stripped if line and not line.startswith("//"))


def _format_colours(filters: Sequence[Mapping[str, Any]]) -> str:
    """Return the style rules of the colours of filters: on light, and on dark by system or by choice."""
    for look in filters:
        for colour in (look["colour"], look["dark"]):
            if not _COLOUR.fullmatch(colour):
                raise ValueError(
                    f"paper.colour of {look['key']} must have the form #rrggbb, got {colour}."
                )
    light = "".join(f".c{i}{{--c:{f['colour']}}}" for i, f in enumerate(filters))
    dark = [f"{{prefix}} .c{i}{{{{--c:{f['dark']}}}}}" for i, f in enumerate(filters)]
    system = "".join(rule.format(prefix=":root:not([data-theme=light])") for rule in dark)
    choice = "".join(rule.format(prefix=":root[data-theme=dark]") for rule in dark)
    return f"{light}\n@media (prefers-color-scheme:dark){{{system}}}\n{choice}"


def _group_files(downloads: Sequence[Mapping[str, Any]]) -> list[tuple[str, list[dict[str, str]]]]:
    """Return the downloads by group, with sizes as text."""
    groups: dict[str, list[dict[str, str]]] = {}
    for file in downloads:
        size = f"{max(1, round(file['bytes'] / 1000))} kB" if file.get("bytes") else ""
        groups.setdefault(str(file["group"]), []).append({**file, "size": size})
    return list(groups.items())
