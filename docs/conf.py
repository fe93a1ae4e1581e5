"""Sphinx: the documentation as a site, pages as they are, the API reference from the docstrings, and
the leaderboard's page.

    sphinx-build -W --keep-going -b html -c docs . build/site
"""

from pathlib import Path
from types import UnionType
from typing import get_origin

import fpp_ml_bench
from fpp_ml_bench.leaderboard.page.page import write_page
from fpp_ml_bench.leaderboard.ranking import rank, read_entries, shipped_rows
from fpp_ml_bench.leaderboard.tables import chosen_tables

project = "FPP-ML-Bench"
author = "The FPP-ML-Bench authors"
release = fpp_ml_bench.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "numpydoc"]
root_doc = "docs/index"
include_patterns = ["*.md", "docs/**", "evaluation/PROTOCOL.md"]
exclude_patterns = ["build", ".venv", "data", "demo", "docs/quickstart", "docs/templates"]
templates_path = ["templates"]
myst_heading_anchors = 4
suppress_warnings = ["ref.python"]  # two rooms may have a class of the same name
autodoc_default_options = {"member-order": "bysource"}
autodoc_typehints = "signature"
numpydoc_show_class_members = False
html_theme = "furo"
html_title = f"FPP-ML-Bench {release}"


def _without_substitutions(app, what, name, obj, options, lines) -> None:
    """Bars are absolute values here."""
    lines[:] = [line.replace("|", "\\|") for line in lines]


def _skipped(app, what, name, obj, skip, options) -> bool | None:
    """Names of types are said where they are used; autodoc can't format them."""
    foreign = (
        getattr(obj, "__module__", None) == "_thread"
    )  # a lock says of no module that it is imported
    return True if get_origin(obj) is not None or isinstance(obj, UnionType) or foreign else None


def setup(app) -> None:
    app.connect("autodoc-process-docstring", _without_substitutions)
    app.connect("autodoc-skip-member", _skipped)
    app.connect("build-finished", _leaderboard)


def _leaderboard(app, exception) -> None:
    """The page that ``fpp-bench leaderboard --page`` writes, in a folder of the site."""
    if exception is None and app.builder.format == "html":
        folder = Path(app.outdir, "leaderboard")
        write_page(rank(read_entries(shipped_rows())), chosen_tables(None), folder)
