"""Sphinx: the API reference, from the docstrings of the rooms' doors. ``sphinx-build -W -b html docs/api build/api``"""

import fpp_ml_bench

project = "FPP-ML-Bench"
author = "The FPP-ML-Bench authors"
release = fpp_ml_bench.__version__
extensions = ["sphinx.ext.autodoc", "numpydoc"]
autodoc_default_options = {"member-order": "bysource"}
autodoc_typehints = "signature"
numpydoc_show_class_members = False
html_theme = "alabaster"
html_theme_options = {"description": fpp_ml_bench.__doc__.split("\n")[0], "page_width": "1100px"}
