"""A small network that decides what physics can't: fringe order, object mask, and a bounded correction of the phase."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
