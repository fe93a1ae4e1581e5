"""Calibration of a camera-projector rig from captures of a flat board: boards, projector coordinates, fit, picture."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
