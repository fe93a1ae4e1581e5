"""Calibration: the rig from captures of known shape, a board or a scene with known depth."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
