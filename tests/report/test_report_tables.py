"""Tables as LaTeX reads them."""

import re
import unicodedata
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pfbench import job
from pfbench.report import writers


def written() -> str:
    """Every sign beyond ASCII that the package and its configuration hold, and others that units and names have."""
    folders = (Path(writers.__file__).parents[1], job.conf_dir(), job.experiments_dir())
    files = [
        path
        for folder in folders
        for path in sorted(folder.rglob("*"))
        if path.suffix in {".py", ".yaml", ".jinja"}
    ]
    found = {sign for path in files for sign in path.read_text(encoding="utf-8") if ord(sign) > 127}
    return "".join(
        sorted(found | set("∞−–—±×°′″≥≤²³µαβγδεζηθικλμνξπρστυφχψωΓΔΘΛΞΠΣΥΦΨΩ·÷≈≠→√⁻⁵₀₉éüčßø“”…‰中"))
    )


def test_latex_is_of_letters_that_pdflatex_reads():
    signs = written()
    assert {"–", "∞", "−", "±", "°", "²"} <= set(signs)
    table = pd.DataFrame(
        {signs: [f"before{sign}after" for sign in signs], "value": np.full(len(signs), -np.inf)}
    )
    found = writers.format_latex(table, signs)
    assert found.isascii()
    body = re.sub(r"\\[\\$&%#_{}|~^]", "", found)  # commands of one sign
    assert body.count("$") % 2 == 0
    assert not re.search(
        r"[<>|~]", re.sub(r"\$[^$]*\$", "", body)
    )  # which the first fonts show as others
    for line in found.splitlines():
        assert line.count("{") - line.count(r"\{") == line.count("}") - line.count(r"\}")
    for formula in re.findall(
        r"\$([^$]*)\$", body
    ):  # of two superscripts in a row TeX says that one is too many
        assert formula.count("^") + formula.count("'") // 2 <= 1
    commands = set(re.findall(r"\\([A-Za-z]+)", found))
    for letter in "αωΓΩ":
        assert unicodedata.name(letter).split()[-1].lower() in {name.lower() for name in commands}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("–", "--"), ("a − b", "a $-$ b"), ("± 3", r"$\pm$ 3"), ("5 °", r"5 $^\circ$"), ("m/s²", "m/s$^2$"), ("µg", r"$\mu$g"),
        ("λ Λ", r"$\lambda$ $\Lambda$"), ("x < 3 | y > 2", "x $<$ 3 $|$ y $>$ 2"), ("Müller, Čech", r'M\"{u}ller, \v{C}ech'),
        ("中", "(U+4E2D)"), ("10⁻³", "10$^-$$^3$"), ("50 % of a_b", r"50 \% of a\_b"),
    ],
)  # fmt: skip
def test_what_a_sign_becomes(text, said):
    assert writers.format_latex(pd.DataFrame({"a": [text]})).splitlines()[4] == said + r" \\"


def test_numbers_that_are_none():
    table = pd.DataFrame({"a": [np.inf, -np.inf, np.nan]})
    assert writers.format_latex(table).splitlines()[4:7] == [
        r"$\infty$ \\",
        r"$-\infty$ \\",
        r"-- \\",
    ]
