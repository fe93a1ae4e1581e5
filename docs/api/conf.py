"""Sphinx: the API reference, from the docstrings of the modules. ``sphinx-build -W -b html docs/api
build/api``"""

from types import UnionType
from typing import get_origin

import fpp_ml_bench

project = "FPP-ML-Bench"
author = "The FPP-ML-Bench authors"
release = fpp_ml_bench.__version__
extensions = ["sphinx.ext.autodoc", "sphinx.ext.autosummary", "numpydoc"]
templates_path = ["templates"]
suppress_warnings = ["ref.python"]  # two rooms may have a class of the same name
autodoc_default_options = {"member-order": "bysource"}
autodoc_typehints = "signature"
numpydoc_show_class_members = False
html_theme = "alabaster"
html_theme_options = {"description": fpp_ml_bench.__doc__.split("\n")[0], "page_width": "1100px"}


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
