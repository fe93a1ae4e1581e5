"""Scores in mm: error statistics, pixel sets, units, intervals, and scoring a folder of predictions."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
