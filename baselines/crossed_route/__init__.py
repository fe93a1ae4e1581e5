"""Absolute depth from a frame with two crossed fringes, measured; nothing learned (docs/crossed.md)."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
