"""``result.json``: its strict model, its checks, and what it was computed with."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
