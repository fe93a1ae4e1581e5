"""Depth through wrapped phase and fringe order, from one frame: what the rig knows is computed, never learned."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
