"""Captured images: reading the frames of a scan, and writing what was decoded from them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
