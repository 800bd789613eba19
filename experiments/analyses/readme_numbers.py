"""Write the numbers of README.md, of the pages of methods and of train_a_proposal.md: `python experiments/analyses/readme_numbers.py`.

Each block between `<!-- numbers:NAME -->` and `<!-- numbers:end -->` is generated from the published
reports and the benchmark pages. A block without a function of its own is the table of the study of its
name. A test fails if a block differs from them.
"""

from __future__ import annotations

import gzip
import json
import re
from collections.abc import Callable, Iterable
from functools import cache
from importlib import import_module
from pathlib import Path
from runpy import run_path
from types import ModuleType
from typing import Any

import pfbench
from pfbench.files import markdown_bullets
from pfbench.job import list_groups
from pfbench.report import find_overviews, read_stored_study, tabulate_heat_map

TOP = Path(__file__).parents[2]
PAGES = (
    TOP / "README.md",
    TOP / "docs" / "results.md",
    TOP / "docs" / "train_a_proposal.md",
    *sorted((TOP / "docs" / "methods").glob("*.md")),
)

_BLOCK = re.compile(r"<!-- numbers:(\w+) -->\n.*?<!-- numbers:end -->", re.DOTALL)
_STUDIES = "benchmarks/campaigns.md"

Row = dict[str, str]


def read_table(page: str, *headings: str) -> list[Row]:
    """Read the first Markdown table after a sequence of headings.

    Args:
        page: File relative to the top folder.
        headings: Headings without number signs, from outer to inner.

    Returns:
        Rows by column name.

    Raises:
        ValueError: If a heading or the table is missing.
    """
    text = (TOP / page).read_text()
    for heading in headings:
        match = re.search(rf"^#+ {re.escape(heading)}$", text, re.MULTILINE)
        if match is None:
            raise ValueError(f"{page} must contain the heading {heading}")
        text = text[match.end() :]
    lines = re.search(r"^\|.*\n\|[-:| ]+\n(?:\|.*\n)+", text, re.MULTILINE)
    if lines is None:
        raise ValueError(f"{page} must contain a table after {headings}")
    return _parse_rows(lines[0])


def _parse_rows(text: str) -> list[Row]:
    """Rows of a Markdown table by column name."""
    head, _, *rows = [
        [cell.strip() for cell in line.strip().strip("|").split("|")]
        for line in text.split("\n")
        if line.startswith("|")
    ]
    return [dict(zip(head, row, strict=True)) for row in rows]


def format_table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Format a Markdown table.

    Args:
        head: Column names.
        rows: Cells.

    Returns:
        The table, without a final line break.
    """
    lines = [names := list(head), ["---"] * len(names), *(list(row) for row in rows)]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _digits(value: float) -> str:
    """Format a number with three significant digits and no exponent."""
    return f"{float(f'{value:.3g}'):.15g}".replace("inf", "∞")


def describe_knobs(study: str) -> str:
    """Line of a published page on tuned filters with the knobs of another world, empty without one."""
    page = TOP / "reports" / study / "report.md"
    lines = page.read_text(encoding="utf-8").splitlines() if page.is_file() else []
    return next((f"\n\n{line}" for line in lines if line.startswith("Not tuned here:")), "")


@cache
def opening_rows(study: str) -> tuple[str, list[dict[str, Any]]]:
    """Baseline and rows of the opening view of a published study.

    Args:
        study: Name of the study.
    """
    views = read_stored_study(TOP / "reports" / study).pack["views"]
    key, view = next(iter(views.items()))
    return key.baseline, view["rows"]


def board_table(study: str) -> str:
    """Table of the opening view of a published study. Rows with equal numbers are joined.

    Args:
        study: Name of the study.
    """
    baseline, first = opening_rows(study)
    filters_by_cells: dict[tuple[str, ...], list[str]] = {}
    for row in first:
        level, ratio = (
            f"{_digits(float(row[name]))} [{_digits(float(row[low]))}, {_digits(float(row[high]))}]"
            if None not in (row[name], row[low], row[high])
            else "–"
            for name, low, high in (
                ("value", "low", "high"),
                ("ratio", "ratio_low", "ratio_high"),
            )
        )
        shares = (
            f"{100 * float(row[name]):.0f} %" if row[name] is not None else "–"
            for name in ("track", "coverage")
        )
        cells = (level, ratio, *shares)
        filters_by_cells.setdefault(cells, []).append(f"`{row['filter']}`")
    unit = next((row["unit"] for row in first if row["unit"]), "")
    head = (
        "filter",
        f"error [{unit}]" if unit else "error",
        f"ratio to `{baseline}`",
        "track kept",
        "true values in 90 % intervals",
    )
    body = [(", ".join(labels), *cells) for cells, labels in filters_by_cells.items()]
    kept = [i for i in range(len(head)) if any(row[i] != "–" for row in body)]
    table = format_table((head[i] for i in kept), ([row[i] for i in kept] for row in body))
    return f"{table}{describe_knobs(study)}"


def claims_2() -> str:
    """Words on all claims, and what became of each paper: the first lines of their page."""
    _, total, papers, *_ = (TOP / "reports/claims_2/report.md").read_text().split("\n\n")
    return f"{total}\n\n{papers}"


@cache
def read_overviews(study: str = "all_seven") -> Any:
    """Tables of the first page of a study of all methods."""
    return find_overviews(*read_stored_study(TOP / "reports" / study, decides=False))


def all_seven(study: str = "all_seven") -> str:
    """First sentences of a study of all methods, and its heat map as a table."""
    folder = TOP / "reports" / study
    head, rows = tabulate_heat_map(read_overviews(study))
    legend = (
        "Ratio of errors to the best Kalman filter of the world. Bold: shown to be better. Plain: shown to be worse. In brackets: not decided. "
        "=: within 5 %. A percentage is the share of runs that keep track, where lost runs leave no ratio."
    )
    text = (folder / "report.md").read_text()
    _, first, second, *_ = text.split("\n\n")
    return f"{first}\n\n{second}\n\n{format_table(head, rows)}\n\n{legend}{describe_knobs(study)}".rstrip()


def seven_at_home() -> str:
    """First sentences of the study of the methods at home, its heat map, and the words on tuned forms."""
    lines = (TOP / "reports" / "seven_at_home" / "report.md").read_text().splitlines()
    tuned = next(line for line in lines if line.startswith("The seven tuned"))
    return f"{all_seven('seven_at_home')}\n\n{tuned}"


def speed() -> str:
    """Speed relative to other libraries, on one core."""
    page = "benchmarks/compare.md"
    models = dict(re.findall(r"^## (W.*)\n\n(.*)\.$", (TOP / page).read_text(), re.MULTILINE))
    entries = [
        (f"{row['workload']}: {models[row['workload']]}", row["fastest peer"], row)
        for row in read_table(page)
    ]
    entries += [
        (f"{row['study']}, whole process", row["against"], row) for row in read_table(_STUDIES)
    ]
    return format_table(
        ("workload", "pfbench", "compared with", "times as fast (quartiles)"),
        (
            (
                workload,
                row["pfbench"],
                other,
                row["times as fast (quartiles)"],
            )
            for workload, other, row in entries
        ),
    )


def gpu() -> str:
    """Time of a large job on a GPU."""
    text = (TOP / "benchmarks/gpu.md").read_text()
    row = next(
        row
        for row in _parse_rows(text[text.index("| R x N x T") :].split("\n\n")[0])
        if row["engine"] == "compiled" and row["R x N x T"].startswith("1000 x 10000")
    )
    device = text.rstrip().rsplit("\n", 1)[-1].split(";")[0]
    runs, particles, steps = row["R x N x T"].split(" x ")
    return (
        f"{device}: {row['s, median (range)'].split()[0]} s for {runs} runs of {particles} particles "
        f"and {steps} steps, single precision, `engine=compiled`."
    )


def read_script_results(script: str) -> tuple[ModuleType, dict[str, Any]]:
    """Read the stored results of a script in `experiments/`.

    Args:
        script: Name of the script.

    Returns:
        The script as a module, and its finished parts by name.
    """
    stored = gzip.decompress((TOP / "reports" / script / "results.json.gz").read_bytes())
    return import_module(f"pfbench.experiments.{script}"), json.loads(stored)["done"]


def _planned_equal_time(study: str) -> list[tuple[str, ...]]:
    """Cells of the planned pairs of a learned proposal and a filter that takes less time."""
    pack = read_stored_study(TOP / "reports" / study).pack
    times = {row["filter"]: float(row["ms"]) for row in opening_rows(study)[1] if row["ms"]}
    words = {"better": "smaller", "worse": "larger"}
    return [
        (
            pack["worlds"][0]["name"],
            f"`{pair['a']}`",
            f"`{pair['b']}`",
            f"{_digits(pair['estimate'])} ({_digits(pair['low'])} to {_digits(pair['high'])})",
            words.get(pair["word"], pair["word"]),
        )
        for pair in pack["planned"]
        if pair["a"].startswith("neural_") and times[pair["b"]] <= times[pair["a"]]
    ]


def equal_time() -> str:
    """Possible gain of learned proposals by world, and their errors at equal time."""
    room, rooms = read_script_results("learn_room")
    gain, done = read_script_results("learn_gain")
    ratios = room.list_rooms(rooms)
    left = [words.replace(",", ", ") for words, ratio in ratios.items() if ratio < room.OPEN]
    rows = [
        (
            row["world"],
            f"`{row['learned']}`",
            f"`{row['rival']}`",
            gain.format_ratio(row["mean"], row["half"]),
            row["word"],
        )
        for row in gain.list_equal_time(done)
    ]
    rows += [
        row
        for study in ("learned_azimuth", "learned_passive")
        for row in _planned_equal_time(study)
    ]
    head = (
        "world",
        "learned",
        "filter that takes at most its time",
        "RMSE, ratio",
        "RMSE of the learned one",
    )
    winners = sorted({row[0] for row in rows if row[-1] == "smaller"})
    answer = (
        f"A learned proposal has the smaller error at equal time in: {', '.join(winners)}."
        if winners
        else "**A world in which a learned proposal has a smaller error at equal time was not found.**"
    )
    untested = [words for words in left if "oracle_noise" in words]
    costs = {
        row["proposal"]: float(row["ms per step"])
        for row in read_table("reports/learn_data_efficiency/report.md")
    }
    slower = costs["lower bound, 300 runs"] / costs["guided by a CKF"]
    most = max(1.0 / ratios[words.replace(", ", ",")] - 1.0 for words in untested)
    return (
        f"In {len(ratios) - len(left)} of {len(ratios)} worlds the best proposal without a network has at least {room.OPEN:g} of the "
        f"possible ESS. A network then has nothing to gain at equal particle number. The others are: {'; '.join(left)}.\n\n"
        f"{format_table(head, rows)}\n\n{answer} The worlds outside the table were not compared at equal time. In those "
        f"with `oracle_noise` the largest possible gain in ESS is {100 * most:.0f} %. In the others a network would have to cost less "
        f"than the guided proposal. On `azimuth` a network costs {slower:.1f} times as much as a proposal guided by a CKF."
    )


def learned_gain() -> str:
    """Errors of KalmanNet and its rivals relative to the EKF, and its comparisons with them."""
    gain, done = read_script_results("learn_gain")
    rows = [
        (world, f"`{name}`", gain.format_ratio(mean, half), f"{p:.2g}")
        for (world, name), (mean, half, p, _) in gain.list_ratios(done).items()
    ]
    head = ("world", "filter", "RMSE relative to `ekf`", "p, Holm")
    pairs = "\n".join(markdown_bullets(*gain.describe_pairs(done))).rstrip()
    return f"{format_table(head, rows)}\n\nKalmanNet with most training runs:\n\n{pairs}"


def tuned_worlds() -> str:
    """Table of all tuned worlds."""
    table: str = run_path(str(Path(__file__).with_name("tuned_worlds.py")))["tuned_worlds"]()
    return table


_WINNERS = {  # worlds of all_seven in the table of the README
    "terrain": "Terrain-referenced navigation without a fix",
    "passive_1_printed": "An emitter located by bearings alone, at 20 m/s",
    "growth": "Growth model, two modes",
    "gps_ins_inflated": "Flight with GNSS fixes",
    "recorded_car_drive": "Recorded car drive with GNSS fixes",
}


def winners() -> str:
    """Table of the ratio of SIR and RPF to the best Kalman filter in five worlds, from the first page of `all_seven`."""
    overview = read_overviews()[1000]
    rows = []
    for world in (w for key in _WINNERS for w in overview.worlds if w.key == key):
        texts = [word_verdict(overview.find(world, name).verdict) for name in ("sir", "rpf")]
        rows.append((_WINNERS[world.key], overview.names[world.reference], str(world.runs), *texts))
    return format_table(("world", "best Kalman filter", "runs", "SIR", "RPF"), rows)


def format_with_interval(ratio: float, low: float, high: float) -> str:
    """Format a ratio with its interval; an end that is exactly 1 is written so."""
    ends = (f"{end:.2f}".replace("inf", "∞") if end != 1.0 else "1" for end in (low, high))
    return f"{ratio:.2f} [{', '.join(ends)}]"


def word_verdict(verdict: Any) -> str:
    """Word a verdict with its ratio and interval, or with the runs that are lost."""
    a, b, both, _ = verdict.lost
    lost = f"loses {a + both} of {verdict.n} runs, the Kalman filter {b + both}"
    size = format_with_interval(*verdict[3:6])
    return f"{size if verdict.ratio > 0 else lost}: {verdict.word}"


def tie() -> str:
    """Sentence on the world of the quickstart at ten times the speed: a row of a view of `robust_simulated`."""
    pack = read_stored_study(TOP / "reports" / "robust_simulated").pack
    views, name = (
        pack["views"],
        next(w["name"] for w in pack["worlds"] if w["key"] == "passive_1"),
    )
    rows = views["rmse", "passive_1", "nominal", "ekf_scaled_tuned"]["rows"]
    row = next(row for row in rows if row["filter"] == "rpf")
    size = format_with_interval(row["ratio"], row["ratio_low"], row["ratio_high"])
    return (
        f"At 200 m/s in place of 20 m/s, RPF has {size} times the error of the tuned EKF in 50 paired runs with nominal noise: {row['words']}. "
        f"`pfbench open study=robust_simulated` shows it: choose the world {name} and the regime Nominal."
    )


def contents() -> str:
    """List what the package has, with its numbers of parts."""

    def count(group: str) -> int:
        return len(list_groups()[group])

    sets = [name for name in pfbench.names("filter") if name not in list_groups()["filter"]]

    decided = re.findall(
        r"(\d+) (confirmed|refuted|depends|untestable|open|not run)", claims_2().split("\n")[0]
    )
    words = ", ".join(f"{number} {word}" for number, word in decided)
    return "\n".join(markdown_bullets(
        f"{count('filter')} filters and forms of filters, besides the set `{'`, `'.join(sets)}` in the list of `pfbench.names(\"filter\")`: Kalman, particle, guided, swarm, robust, adaptive, smoothing and learned ones.",
        f"Seven methods, literal and repaired; 88 claims: {words}.",
        f"{count('scenario')} scenarios, simulated and recorded, {count('model')} models and {count('noise')} noise regimes; own ones are one class.",
        "All Monte Carlo runs of a job are one tensor axis; each random number is a function of seed, run, step and use.",
        "Better, equal, worse or not decided: each word has a simulated error rate, and a lost run deletes no filter.",
        "A result depends on all its inputs: a changed file, class or setting is a new job, and sweeps resume.",
        "Baselines are tuned in the world in which they are compared, on another seed.",
        "Proposals that learn, NUTS, SVI, PMMH and SMC² on the same models, which are modules of torch.",
    )).rstrip()  # fmt: skip


BLOCKS: dict[str, Callable[[], str]] = {
    block.__name__: block
    for block in (
        winners,
        tie,
        contents,
        claims_2,
        all_seven,
        seven_at_home,
        equal_time,
        learned_gain,
        speed,
        gpu,
        tuned_worlds,
    )
}


def fill_blocks(text: str) -> str:
    """Replace the content of all number blocks.

    Args:
        text: Content of a page.

    Returns:
        The content with current numbers.
    """

    def replace(match: re.Match[str]) -> str:
        name = match[1]
        table = BLOCKS[name]() if name in BLOCKS else board_table(name)
        return f"<!-- numbers:{name} -->\n{table}\n<!-- numbers:end -->"

    return _BLOCK.sub(replace, text)


if __name__ == "__main__":
    for path in PAGES:
        path.write_text(fill_blocks(path.read_text()))
