"""Settings of the site: `make site` copies this file next to all pages and runs Sphinx there."""

import os
import re
from importlib import metadata
from typing import Any

project = "pfbench"
author = "The pfbench authors"
copyright = "The pfbench authors"  # noqa: A001
release = metadata.version("pfbench")

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "sphinx_design",
]
source_suffix = {".md": "myst-nb", ".rst": "restructuredtext"}
default_role = "code"  # docstrings are Markdown: `x` is code
nitpicky = False

myst_enable_extensions = ["colon_fence", "dollarmath", "amsmath"]
myst_heading_anchors = 5

nb_execution_mode = "cache"  # a notebook runs again when its cells change
nb_execution_timeout = 300
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_merge_streams = True
os.environ["PYTHONWARNINGS"] = (
    "ignore:IProgress not found"  # of pyro in a notebook without widgets; kernels inherit it
)

autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True  # as in the source: no path of a machine
autodoc_typehints = "none"  # the docstrings name shapes and units
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True

html_theme = "sphinx_book_theme"
html_title = "pfbench"
html_theme_options = {
    "show_toc_level": 2,
    "home_page_in_toc": True,
    "collapse_navigation": True,  # else each page repeats the list of all
    "max_navbar_depth": 2,
    "navbar_persistent": [],  # the list of pages has the search
    "use_download_button": False,
    "use_fullscreen_button": False,
}
html_copy_source = False


def escape_bars(app: Any, what: str, name: str, item: Any, options: Any, lines: list[str]) -> None:
    """Escape the bars of |x| in a docstring, which would be a substitution. Text in backticks has none."""
    for k, line in enumerate(lines):
        parts = re.split(r"(`[^`]*`)", line)
        lines[k] = "".join(p if p.startswith("`") else p.replace("|", r"\|") for p in parts)


def setup(app: Any) -> None:
    """Connect the change of docstrings."""
    app.connect("autodoc-process-docstring", escape_bars)
