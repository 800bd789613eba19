"""Own filters next to a published study, whose filters do not run again.

Random numbers are functions of seed and run, so that an own filter is paired with the stored runs of a study. A
witness shows that the worlds are the same: a filter of the published study that runs again in each of them. Its errors
must agree in all common runs, which checks data, build and settings of a world at once.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from pfbench.core.parameter_checks import require
from pfbench.files.recorded_folder import describe_missing_runs, find_published_file, list_published
from pfbench.report.board.entries import StudyFacts, build_run_table
from pfbench.report.overview.figures import HEAT_FORMATS, draw_heat_map
from pfbench.report.overview.page import choose_level
from pfbench.report.overview.tables import (
    CENTRAL,
    METRIC,
    World,
    WorldCell,
    decide_cells,
    has_overview,
    read_world_facts,
)
from pfbench.report.stored_study import RUNS_FILE, StoredStudy, read_stored_study
from pfbench.report.study_report import find_overviews
from pfbench.results.conditions import Condition, parse_label
from pfbench.results.looks import study_looks
from pfbench.stats.comparison import Verdict
from pfbench.stats.court import Court, Pair
from pfbench.stats.sentences import format_with_interval
from pfbench.stats.study_runs import arrange_runs

_TOLERANCE = (
    1e-3  # relative difference of errors that agree up to rounding on another machine [ours]
)
_CONDITION = ["scenario", "regime", "model"]
_NO_WITNESS = "dead_reckoning"


class PublishedComparison(NamedTuple):
    """Own filters against each filter of a published study.

    Attributes:
        verdicts: Verdicts of one family of tests in each condition, by its name.
        witnesses: A filter of each condition that ran in both studies, with equal errors.
        left_out: Conditions of the own study that are not compared, with the reason.
        cells: Own filters against the reference of each world, for the heat map; of these verdicts.
        names: Names of the own filters for a reader.
        particles: Number of particles of the own filters, 0 without any.
        study: The published study.
    """

    verdicts: Mapping[str, list[Verdict]]
    witnesses: Mapping[str, str]
    left_out: Mapping[str, str]
    cells: Sequence[WorldCell] = ()
    names: Mapping[str, str] = {}
    particles: int = 0
    study: StoredStudy | None = None

    def plot(self) -> Figure:
        """Draw the heat map of the published study with the own filters before all others.

        Colours, words and lost tracks are as in the report: each filter against the reference of each world. A world in
        which the own filter did not run has a dash.

        Returns:
            The figure. `figure.savefig` writes it.

        Raises:
            ValueError: If the published study is without a heat map, or no world of it with a reference is shared.
        """
        overviews = find_overviews(*self.study) if self.study else None
        if overviews is None or not self.cells:
            raise ValueError(
                "a heat map must have a published study of several methods in several worlds, one of them shared with its "
                "reference, got none. Use table()."
            )
        level = self.particles if self.particles in overviews else choose_level(overviews)
        overview = overviews[level]
        labels = tuple(dict.fromkeys(cell.filter for cell in self.cells))
        joined = overview._replace(
            methods=(*labels, *overview.methods),
            names={**overview.names, **self.names},
            cells=[*overview.cells, *self.cells],
        )
        return draw_heat_map(joined, HEAT_FORMATS[0])

    def table(self) -> pd.DataFrame:
        """Return the verdicts as a table, a row per condition and pair."""
        rows = [
            {"condition": name, "witness": self.witnesses[name], **verdict.to_row()}
            for name, verdicts in self.verdicts.items()
            for verdict in verdicts
        ]
        return pd.DataFrame(rows)

    def __str__(self) -> str:
        lines = []
        for name, verdicts in self.verdicts.items():
            witness = self.witnesses[name]
            lines.append(f"{name}: {witness} has the errors of the published study in all runs")
            for label in dict.fromkeys(verdict.a for verdict in verdicts):
                lines += _word_filter(label, [v for v in verdicts if v.a == label])
        lines += [f"{name} is not compared: {reason}." for name, reason in self.left_out.items()]
        return "\n".join(lines)


def _word_filter(label: str, verdicts: Sequence[Verdict]) -> Iterator[str]:
    """Yield how an own filter compares with all published ones, and with the strongest of them."""
    words = Counter(verdict.word for verdict in verdicts)
    counts = ", ".join(f"{word} {count}" for word, count in words.items())
    yield f"  {label} against {len(verdicts)} filters: {counts}"
    if sized := [verdict for verdict in verdicts if verdict.ratio > 0]:
        strongest = max(sized, key=lambda verdict: verdict.ratio)
        yield (
            f"  {label} / {strongest.b}, the strongest in these runs: {format_with_interval(*strongest[3:6])} "
            f"in {strongest.n} paired runs, {strongest.word}"
        )


def find_published(name: str, reports: Path) -> Path:
    """Return the folder of a published study: of the reports, by its path, or of this version of pfbench.

    Raises:
        ValueError: If runs.parquet is missing in it.
    """
    candidates = (reports / name, Path(name), Path(name).parent)
    for folder in candidates:
        if (folder / RUNS_FILE).is_file():
            return folder
    if path := find_published_file(f"{name}/{RUNS_FILE}"):
        return path.parent
    stored = sorted(path.parent.name for path in reports.glob(f"*/{RUNS_FILE}"))
    raise ValueError(
        f"published must be a report with {RUNS_FILE}, got {name!r}. In {reports}: {', '.join(stored) or 'none'}. "
        f"Published: {', '.join(list_published(RUNS_FILE))}. "
        f"Set reports_dir, or the path of its folder.{describe_missing_runs().rstrip()}"
    )


def compare_with_published(conditions: Sequence[Condition], folder: Path) -> PublishedComparison:
    """Compare the own filters of a study with all filters of a published one in the same runs.

    Particle filters are compared at an equal number of particles, and with all others. Errors count from the time
    from which those of the published study do.

    Args:
        conditions: Conditions of the own study.
        folder: Folder of the published report, with its runs.parquet.

    Raises:
        ValueError: If no condition has a witness whose errors agree.
    """
    study = read_stored_study(folder, decides=False)
    start = StudyFacts.from_pack(study.pack).options.start_time_s
    compared = compare_tables(build_run_table(conditions, start), study)
    if not compared.verdicts:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in compared.left_out.items())
        worlds = "; ".join(
            f"{' / '.join(map(str, key[:-1]))} with seed={key[-1]}, up to {rows['run'].nunique()} runs"
            for key, rows in study.table.groupby([*_CONDITION, "seed"], observed=True, sort=False)
        )
        raise ValueError(
            f"{folder / RUNS_FILE} must share a world with the study, got none. {reasons}. Its worlds, for pfbench.run: {worlds}"
        )
    names = {label: look.name for label, look in study_looks(conditions).items()}
    return compared._replace(names=names)


def compare_tables(table: pd.DataFrame, study: StoredStudy) -> PublishedComparison:
    """Compare own runs, a row per filter, condition and run, with those of a published study."""
    facts = StudyFacts.from_pack(study.pack)
    witnesses, left_out, parts = {}, {}, {}
    joined, pairs, counts = [], {}, set[int]()
    for key, rows in table.groupby(_CONDITION, observed=True, sort=False):
        name = " / ".join(map(str, key))
        stored = study.table[(study.table[_CONDITION] == list(key)).all(axis=1)]
        try:
            witnesses[name] = find_witness(rows, stored)
        except ValueError as error:
            left_out[name] = str(error)
            continue
        stored = stored[stored["seed"] == rows["seed"].iloc[0]]
        both, pairs[name] = _make_pairs(rows, stored)
        joined.append(both.assign(family=name, scenario=name, regime=""))
        counts |= set(rows["particles"].dropna().astype(int))
        others = stored[~stored["filter"].isin([b for _, b in pairs[name]])]
        if numbers := sorted(set(others["particles"].dropna().astype(int))):
            parts[f"A part of {name}"] = (
                f"{others['filter'].nunique()} published filters have {', '.join(map(str, numbers))} particles, the own ones another "
                "number. Set particles=NUMBER to meet them"
            )
    left_out |= parts
    worlds = _open_worlds(joined, pairs)
    verdicts = {name: [worlds[name].find(*pair) for pair in some] for name, some in pairs.items()}
    return PublishedComparison(
        verdicts, witnesses, left_out,
        _list_cells(worlds, pairs) if has_overview(study.table, facts.looks) else (),
        particles=counts.pop() if len(counts) == 1 else 0, study=study,
    )  # fmt: skip


def _open_worlds(
    joined: Sequence[pd.DataFrame], pairs: Mapping[str, Sequence[Pair]]
) -> dict[str, World]:
    """Open the court of own and stored runs, whose pairs are fixed in advance; return its conditions by name."""
    if not joined:
        return {}
    table = pd.concat(joined)
    labels = {str(v): str(v) for v in table["filter"].unique()}
    court = Court(arrange_runs(table, tuple(labels)), (), fixed_in=pairs)
    names = court.runs.conditions["scenario"]
    return {name: World(name, court, (names == name).to_numpy(), labels) for name in pairs}


def _list_cells(
    worlds: Mapping[str, World], pairs: Mapping[str, Sequence[Pair]]
) -> list[WorldCell]:
    """List the own filters against the reference of each world in nominal noise, for the heat map.

    A world without a stated reference, or whose reference did not run in the published study, has none.
    """
    cells = []
    for name, world in worlds.items():
        scenario, regime, model = name.split(" / ")
        facts = read_world_facts(scenario, model)
        against = {a: b for a, b in pairs[name] if facts and parse_label(b)[0] == facts.reference}
        if regime == CENTRAL and against:
            reference = next(iter(against.values()))
            cells += decide_cells([world._replace(key=scenario, reference=reference)], list(against))  # fmt: skip
    return cells


def find_witness(rows: pd.DataFrame, stored: pd.DataFrame) -> str:
    """Find a filter that ran in a condition of both studies; the errors of all such filters must agree in all common runs.

    Dead reckoning is not a witness: it would agree with any measurements.

    Raises:
        ValueError: If the published study lacks such runs, the two have different filters, or errors differ.
    """
    require(
        not stored.empty,
        "its world",
        "be one of the published study",
        "another",
        "Choose one of its scenarios",
    )
    seeds, stored_seeds = set(rows["seed"]), sorted(stored["seed"].unique())
    require(
        len(seeds) == 1 and seeds <= set(stored_seeds),
        "its runs",
        f"have seed={stored_seeds[0]}",
        sorted(seeds),
        "Set it",
    )
    stored = stored[stored["filter"] != _NO_WITNESS]
    both = _pair(rows, stored)
    if both.empty:
        fastest = stored.groupby("filter", observed=True)["ms"].median().fillna(np.inf).idxmin()
        raise ValueError(
            f"a filter of the published study must run again as a witness. Add filter={parse_label(str(fastest))[0]} to your study"
        )
    agrees = np.isclose(both["rmse"], both["rmse_stored"], rtol=_TOLERANCE, atol=0, equal_nan=True)
    differing = both[~agrees]["filter"].value_counts()
    if len(differing):
        name = str(differing.index[0])
        raise ValueError(
            f"{name} must have the errors of the published study, got others in {differing.iloc[0]} of "
            f"{(both['filter'] == name).sum()} runs: the worlds or the filter differ. "
            "Use the settings and the build of its page"
        )
    return str(both["filter"].iloc[0])


def _pair(rows: pd.DataFrame, stored: pd.DataFrame) -> pd.DataFrame:
    """Pair the rows of filters that two studies share: a row per filter, number of particles and run."""
    keys = ["filter", "particles", "seed", "run"]
    plain = [
        frame.assign(
            filter=[parse_label(str(v))[0] for v in frame["filter"]],
            particles=frame["particles"].fillna(0),
        )
        for frame in (rows, stored)
    ]
    return plain[0].merge(plain[1], on=keys, suffixes=("", "_stored"))


def _make_pairs(rows: pd.DataFrame, stored: pd.DataFrame) -> tuple[pd.DataFrame, list[Pair]]:
    """Make the runs of a condition with the filters of both studies, and the pairs of own and published filters."""
    published = {str(v): parse_label(str(v))[0] for v in stored["filter"].unique()}
    labels = [
        str(v) for v in rows["filter"].unique() if parse_label(str(v))[0] not in published.values()
    ]
    both = pd.concat([rows[rows["filter"].isin(labels)], stored])
    counts = both.groupby("filter", observed=True)["particles"].first()
    pairs = [
        (a, b)
        for a in labels
        for b in published
        if counts[[a, b]].isna().any() or counts[a] == counts[b]
    ]
    columns = ["filter", "seed", "run", METRIC, "keeps_track"]
    return both[columns], pairs
