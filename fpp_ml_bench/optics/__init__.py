"""The rig and what it projects: pinholes with lens distortion, calibration files, patterns, frame order."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
