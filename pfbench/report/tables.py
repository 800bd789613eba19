"""Tables of a cell as pandas frames of plain numbers, and how they are printed: HTML, Markdown, LaTeX, CSV."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
import pandas as pd

from pfbench import metrics, store
from pfbench.report.across import Across
from pfbench.report.frame import COVERAGES, Block, blocks, of_trace
from pfbench.report.headline import Planned
from pfbench.report.significance import LOST_RULES, NO_DIFFERENCE, Sensitivity, Verdict

Results = Mapping[str, store.Result]

def _greek(letter: str) -> str:
    return unicodedata.name(letter).split()[-1].lower().replace("lamda", "lambda")


# Signs that LaTeX has in formulas alone, and "<", ">" and "|", which its first fonts show as others.
_MATHS = {
    "<": "<", ">": ">", "|": "|", "∞": r"\infty", "−": "-", "±": r"\pm", "×": r"\times", "÷": r"\div", "·": r"\cdot",
    "°": r"^\circ", "′": "'", "″": "''", "≥": r"\ge", "≤": r"\le", "≈": r"\approx", "≠": r"\ne", "→": r"\to", "√": r"\surd",
    "∑": r"\sum", "∂": r"\partial", "∈": r"\in", "‖": r"\|", "µ": r"\mu",
    **{sign: f"^{said}" for sign, said in zip("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789", strict=True)},
    **{sign: f"_{said}" for sign, said in zip("₀₁₂₃₄₅₆₇₈₉", "0123456789", strict=True)},
    **{letter: f"\\{_greek(letter)}" for letter in "αβγδεζηθικλμνξπρστυφχψω"},
    **{letter: f"\\{_greek(letter).capitalize()}" for letter in "ΓΔΘΛΞΠΣΥΦΨΩ"},
}  # fmt: skip
_LATEX = str.maketrans({
    "\\": r"\textbackslash ", "_": r"\_", "%": r"\%", "$": r"\$", "#": r"\#", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde ", "^": r"\textasciicircum ", "&": r"\&", "–": "--", "—": "---", "…": r"\dots ", "“": "``", "”": "''",
    "‘": "`", "’": "'", "\u00a0": "~", "\u2009": r"\,", "\u202f": r"\,", "ß": r"\ss{}", "ø": r"\o{}", "Ø": r"\O{}",
    **{sign: f"${said}$" for sign, said in _MATHS.items()},
})  # fmt: skip
_ACCENTS = dict(zip("\u0300\u0301\u0302\u0303\u0308\u030a\u030c\u0327", "`'^~\"rvc", strict=True))
_TOLD = (  # of the columns of the first table, those that not every kind of filter tells, nor results of before
    "likelihoods per step", "memory in MiB", "ESS in %", "ancestors in %", "different in %", "accepted in %", "NIS", "NIS band"
)  # fmt: skip
_LAST = 20  # steps over which a location is said to have settled [Pu and Qin, section 4]


def overview(results: Results, alpha: float = 0.05) -> pd.DataFrame:
    """What ran: one row per filter. Figures that none of the filters has are left out.

    Ancestors are particles that are copied at a refresh, different ones those that differ after it and its moves, both of all;
    NIS is the normalised innovation squared per component seen, at the instants scored, with the band of a consistent filter,
    whose innovations are independent; memory is what the filter took beyond what was held before.

    Args:
        results: by label, without the instants that are left out.
        alpha: probability outside the band.
    """
    rows = pd.DataFrame([_ran(label, result, alpha) for label, result in results.items()])
    return rows.drop(columns=[name for name in _TOLD if (rows[name].isna() | (rows[name] == "")).all()])


def accuracy(
    results: Results,
    group: str,
    verdicts: Sequence[Verdict] = (),
    alpha: float = 0.05,
    bound: float | None = None,
    whole: Results | None = None,
) -> pd.DataFrame:
    """How far off one group was, in the unit shown: one row per filter that has the group.

    Args:
        results: as `overview`.
        group: name of a block.
        verdicts: of this group; adds how many filters each one beats and is beaten by.
        alpha: probability outside the NEES band.
        bound: adds the median time from which the error stays within it, seconds.
        whole: the same results with all instants, of which that time is found.
    """
    rows = []
    for label, result in results.items():
        for block in blocks(result.meta["state"]):
            if block.group == group:
                row = {"filter": label, **_accuracy(result, block, alpha)}
                if bound is not None:
                    row |= _settled((whole or results)[label], block, bound)
                rows.append({**row, **_standing(label, verdicts)} if verdicts else row)
    return pd.DataFrame(rows)


def in_brief(table: pd.DataFrame) -> pd.DataFrame:
    """The columns of `accuracy` that a large page shows of groups beside the main one."""
    kept = ("filter", "runs used", "RMSE norm", "NEES", "in 90 % region", "RMSE norm to", "beats", "beaten by")
    return table[[name for name in table if str(name).startswith(kept)]]


def decisions(verdicts: Sequence[Verdict]) -> pd.DataFrame:
    """All pairs of one group of one cell, one row per verdict."""
    return pd.DataFrame(
        [
            {
                "a": v.a,
                "b": v.b,
                "pairs": v.pairs,
                "lost a": v.lost_a,
                "lost b": v.lost_b,
                "RMSE a to b in %": 100 * (v.ratio - 1),
                "low": 100 * (v.low - 1),
                "high": 100 * (v.high - 1),
                "interval": v.interval,
                "effect": v.effect,
                "T": v.statistic,
                "p": v.p,
                f"p Holm ({v.family})": v.p_holm,
                "better": v.winner,
            }
            for v in verdicts
        ]
    )


def effects(verdicts: Sequence[Verdict]) -> pd.DataFrame:
    """How large the differences are, whether two filters count as equal, and what it takes to tell: one row per verdict."""
    return pd.DataFrame(
        [
            {
                "a": v.a,
                "b": v.b,
                "effect": v.effect,
                "effect low": v.effect_low,
                "effect high": v.effect_high,
                "P(a better)": v.better,
                "P low": v.better_low,
                "P high": v.better_high,
                f"p equal within {100 * v.margin:g} % ({v.family})": v.p_equivalent,
                "equal": v.equivalent,
                "scatter in %": 100 * v.scatter,
                f"runs needed for {100 * v.wanted:g} %": _whole(v.needed),
                "least found in %": 100 * v.detectable,
            }
            for v in verdicts
        ]
    )


def everything(verdicts: Sequence[Verdict]) -> pd.DataFrame:
    """All comparisons of a page, short, for the table that can be filtered."""
    return pd.DataFrame(
        [
            {
                "cell": f"{v.scenario} / {v.noise} / {v.model}",
                "group": v.group,
                "a": v.a,
                "b": v.b,
                "RMSE a to b in %": 100 * (v.ratio - 1),
                "P(a better)": v.better,
                "p Holm": v.p_holm,
                f"p Holm ({v.page})": v.p_page,
                "better": v.winner,
                "equal": v.equivalent,
            }
            for v in verdicts
        ]
    )


def ranked(found: Sequence[Across]) -> pd.DataFrame:
    """Mean rank over cells of each filter, one column per group."""
    made = [one for one in found if not one.refused]
    labels = list(dict.fromkeys(label for one in made for label in one.filters))
    by_group = {f"rank, {one.group}": dict(zip(one.filters, one.ranks, strict=True)) for one in made}
    return pd.DataFrame([{"filter": label, **{k: own.get(label, np.nan) for k, own in by_group.items()}} for label in labels])


def across_pairs(one: Across) -> pd.DataFrame:
    """All pairs of one group across cells."""
    return pd.DataFrame(
        [
            {
                "a": p.a,
                "b": p.b,
                "cells a, b": f"{p.wins}, {p.losses}",
                "RMSE a to b in %": 100 * (p.ratio - 1),
                "effect": p.effect,
                f"p Nemenyi ({p.family})": p.p_nemenyi,
                f"p Conover-Holm ({p.family})": p.p_conover,
                f"p Wilcoxon-Holm ({p.family})": p.p_wilcoxon,
                "Bayes: a": p.bayes_a,
                f"equal within {100 * one.margin:g} %": p.bayes_equal,
                "Bayes: b": p.bayes_b,
                "P(a better)": p.better,
                "P low": p.better_low,
                "P high": p.better_high,
                "better": p.winner,
            }
            for p in one.pairs
        ]
    )


def planned(pairs: Sequence[Planned]) -> pd.DataFrame:
    """Proposed methods beside their baselines: one row per pair."""
    return pd.DataFrame(
        [
            {
                "method": pair.method,
                "baseline": pair.baseline,
                "cells": len(pair.cells),
                "better": pair.better,
                "worse": pair.worse,
                "no difference shown": len(pair.cells) - pair.better - pair.worse,
                "RMSE to baseline in %": 100 * (pair.ratio - 1),
                "effect": pair.effect,
                "p": pair.p,
                f"p Holm ({pair.family})": pair.p_holm,
                "across cells": pair.decided,
            }
            for pair in pairs
        ]
    )


def sensitive(found: Sequence[Sensitivity]) -> pd.DataFrame:
    """The decisions that another rule for lost runs would change."""
    rules = [rule.name for rule in LOST_RULES]
    return pd.DataFrame(
        [
            {"cell": s.cell, "group": s.group, "a": s.a, "b": s.b, **dict(zip(rules, s.winners, strict=True))}
            for s in found
        ]
    )


def html(table: pd.DataFrame) -> str:
    """An HTML table; its heads say what is a number, and cells what is none, so that the style sheet can set them right.

    Ends of cells and rows, which a browser needs not be told, were most of a page of tables.
    """
    numeric = [_is_number(table[name]) for name in table]
    head = "".join(
        f'<th{" class=number" if right else ""}>{escape(str(name))}' for name, right in zip(table, numeric, strict=True)
    )
    kinds = ["<td>" if right else "<td class=t>" for right in numeric]
    body = "\n".join(
        "<tr>" + "".join(kind + escape(number(value), quote=False) for kind, value in zip(kinds, values, strict=True))
        for values in table.itertuples(index=False)
    )
    return f'<div class="wide"><table class="plain">\n<thead><tr>{head}</thead>\n<tbody>\n{body}\n</tbody>\n</table></div>'


def markdown(table: pd.DataFrame) -> str:
    """A pipe table, columns padded to equal width."""
    cells = [[str(name) for name in table], *([number(v) for v in row] for row in table.itertuples(index=False))]
    cells = [[text.replace("|", r"\|") for text in row] for row in cells]
    width = [max(3, *(len(row[j]) for row in cells)) for j in range(len(table.columns))]
    right = [_is_number(table[name]) for name in table]
    rows = [
        "| " + " | ".join(t.rjust(w) if r else t.ljust(w) for t, w, r in zip(row, width, right, strict=True)) + " |"
        for row in cells
    ]
    rule = "|" + "|".join("-" * (w + 1) + (":" if r else "-") for w, r in zip(width, right, strict=True)) + "|"
    return "\n".join([rows[0], rule, *rows[1:]])


def latex(table: pd.DataFrame, note: str = "") -> str:
    """A booktabs tabular; a note stands below its last rule."""
    layout = "".join("r" if _is_number(table[name]) else "l" for name in table)
    rows = [[str(name) for name in table], *([number(v) for v in row] for row in table.itertuples(index=False))]
    lines = [" & ".join(map(_tex, row)) + r" \\" for row in rows]
    body = ["\\toprule", lines[0], "\\midrule", *lines[1:], "\\bottomrule"]
    if note:
        body.append(rf"\multicolumn{{{len(table.columns)}}}{{l}}{{\footnotesize {_tex(note)}}} \\")
    return "\n".join([rf"\begin{{tabular}}{{{layout}}}", *body, r"\end{tabular}", ""])


def _tex(text: str) -> str:
    """A text in letters that LaTeX reads as they are meant: a single other one stops a whole paper."""
    return re.sub(r"[^\x00-\x7f]", _spelled, text.translate(_LATEX)).replace(r"$-$$\infty$", r"$-\infty$")


def _spelled(sign: re.Match[str]) -> str:
    """A letter with its accent as a command; what has no command as its number."""
    parts = unicodedata.normalize("NFD", sign[0])
    if len(parts) == 2 and parts[0].isascii() and parts[1] in _ACCENTS:
        return rf"\{_ACCENTS[parts[1]]}{{{parts[0]}}}"
    return f"(U+{ord(sign[0]):04X})"


def csv(table: pd.DataFrame) -> str:
    """All digits."""
    return table.to_csv(index=False, lineterminator="\n")


def number(value: Any) -> str:
    """Three significant digits, plain where that is readable; counts and texts as they are."""
    if value is None or value is pd.NA or (isinstance(value, float | np.floating) and np.isnan(value)):
        return "–"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if not isinstance(value, float | np.floating):
        return str(value)
    if np.isinf(value):
        return "∞" if value > 0 else "−∞"
    size = abs(float(value))
    if size == 0:
        return "0"  # and not -0
    if not 1e-3 <= size < 1e5:
        return f"{value:.2e}"
    digits = 2 - int(np.floor(np.log10(float(f"{size:.2e}"))))
    return f"{value:.{max(digits, 0)}f}"


def diverged(result: store.Result) -> np.ndarray:
    """Runs that went on but far outside their own covariance [R]; see `metrics.diverged`."""
    dofs = [len(parts) for parts in result.meta["state"]["groups"].values()]
    return metrics.diverged(result.arrays["nees"], dofs, result.arrays["lost"])


def _ran(label: str, result: store.Result, alpha: float) -> dict[str, Any]:
    meta, arrays = result.meta, result.arrays
    lost, particles = arrays["lost"], meta.get("particles")
    moved = arrays.get("accepted_0", np.full(arrays["nees"].shape[:2], np.nan))
    accepted = metrics.mean_per_run(np.where(arrays.get("resampled", True), moved, np.nan), lost)
    nis, band = _nis(result, alpha)
    evidence = arrays["log_evidence"][~lost]
    return {
        "filter": label,
        "exact": bool(meta.get("exact")),
        "told the noise": bool(meta.get("told")),
        "particles": str(particles or "–"),
        "runs": int(lost.size),
        "lost": int(lost.sum()),
        "lost in %": 100 * float(metrics.lost_share(lost).value),
        "diverged": int(diverged(result).sum()),
        "time per step in ms": 1e3 * meta["seconds"]["per_step"],
        "likelihoods per step": meta.get("likelihoods_per_step", np.nan),
        "memory in MiB": (meta.get("memory") or np.nan) / 2**20,
        "ESS in %": 100 * _mean(of_trace(result, "ess")),
        "ancestors in %": 100 * _mean(of_trace(result, "ancestors")),
        "different in %": 100 * _mean(of_trace(result, "unique")) if "unique" in arrays else np.nan,
        "accepted in %": 100 * _mean(accepted),
        "NIS": nis,
        "NIS band": band,
        "log evidence": _mean(evidence),
    }


def _nis(result: store.Result, alpha: float) -> tuple[float, str]:
    """Normalised innovation squared per component seen, over the runs that were not lost, and its band."""
    if "nis" not in result.arrays:
        return np.nan, ""
    kept = ~result.arrays["lost"]
    nis, dof = (np.asarray(result.arrays[name], dtype=np.float64)[kept] for name in ("nis", "nis_dof"))
    count = int(np.nansum(dof))
    if not count:
        return np.nan, ""
    low, high = metrics.nees_band(count, 1, alpha)
    return float(np.nansum(nis) / count), f"{float(low) / count:.3g} to {float(high) / count:.3g}"


def _settled(result: store.Result, block: Block, bound: float) -> dict[str, Any]:
    error = result.arrays["error"][..., block.places].astype(np.float64) * block.scale
    when = metrics.convergence_time(result.arrays["time"], error, result.arrays["lost"], bound)
    return {f"median time to {bound:g} {block.unit} in s": float(np.median(when[~np.isnan(when)]))}


def _accuracy(result: store.Result, block: Block, alpha: float) -> dict[str, Any]:
    arrays, lost, groups = result.arrays, result.arrays["lost"], result.meta["state"]["groups"]
    error = arrays["error"][..., block.places].astype(np.float64) * block.scale
    norm, each = metrics.rmse_norm(error, lost), metrics.rmse_component(error, lost).value
    largest = metrics.max_error(error, lost)[~lost]
    dof = len(groups[block.whole])
    found = metrics.consistency(arrays["nees"][..., list(groups).index(block.whole)], lost, dof, alpha)
    low, high = metrics.nees_band(dof, found.runs, alpha)
    unit = f" in {block.unit}" if block.unit else ""
    row: dict[str, Any] = {
        "runs used": norm.runs,
        f"RMSE norm{unit}": float(norm.value),
        f"RMSE run mean{unit}": float(metrics.rmse_run_mean(error, lost).value),
        **{
            f"RMSE {name.removeprefix(f'{block.group}_')}{unit}": float(value)
            for name, value in zip(block.components, each, strict=True)
        },
        f"largest error{unit}": float(np.max(largest[~np.isnan(largest)])) if norm.runs else np.nan,
        f"NEES (dof {dof})": found.mean,
        "band at an instant": f"{number(float(low))} to {number(float(high))}",
        "instants in band in %": 100 * found.inside,
    }
    row |= _scores(arrays, block, list(groups), unit)
    if "bound" in arrays:
        floor = arrays["bound"][:, block.places].astype(np.float64) * block.scale
        row["RMSE norm to Cramer-Rao bound"] = metrics.over_bound(error, lost, floor)
    if "range" in arrays and block.whole == "position":
        for name, last in (("mean", None), (f"last {_LAST} steps", _LAST)):
            share = metrics.relative_error(error[..., :2] / block.scale, lost, arrays["range"], last)
            row[f"error in % of range, {name}"] = 100 * float(share.value)
    return row


def _scores(arrays: Mapping[str, np.ndarray], block: Block, groups: list[str], unit: str) -> dict[str, Any]:
    """Of the whole law, over runs that were not lost; nothing of jobs that were not scored."""
    lost, row = arrays["lost"], {}
    if "crps" in arrays:
        row[f"CRPS{unit}"] = block.scale * _kept(metrics.score_per_run(arrays["crps"][..., block.places], lost), lost)
    if "energy" in arrays and block.group == block.whole:
        energy = arrays["energy"][..., groups.index(block.whole)]
        row[f"energy score{unit}"] = block.scale * _kept(metrics.score_per_run(energy, lost), lost)
    if "pit" in arrays:
        for level in COVERAGES:
            share = metrics.coverage_per_run(arrays["pit"][..., block.places], lost, level / 100)
            row[f"in {level} % region in %"] = 100 * _kept(share, lost)
    return row


def _standing(label: str, verdicts: Sequence[Verdict]) -> dict[str, Any]:
    met = [v for v in verdicts if label in (v.a, v.b)]
    beaten = sum(v.winner not in (label, NO_DIFFERENCE) for v in met)
    return {"beats": sum(v.winner == label for v in met), "beaten by": beaten}


def _whole(value: float) -> str:
    """A count that may be infinite or unknown."""
    return f"{value:.0f}" if np.isfinite(value) else number(float(value))


def _kept(values: np.ndarray, lost: np.ndarray) -> float:
    return _mean(values[~lost])


def _mean(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    return float(known.mean()) if known.size else np.nan


def _is_number(column: pd.Series) -> bool:
    return bool(pd.api.types.is_numeric_dtype(column) and not pd.api.types.is_bool_dtype(column))
