"""crossed-net: what one crossed frame leaves open, learned; the depth itself is computed (docs/crossed.md)."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
