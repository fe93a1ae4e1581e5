"""Calibration boards, photographed by the renderer's light: print, poses, and captures on disk."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
