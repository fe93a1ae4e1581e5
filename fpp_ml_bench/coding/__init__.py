"""How frames tell a projector coordinate: the coding schemes, wrapped phase, and Gray code."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
