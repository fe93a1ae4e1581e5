"""Error against run time and captured frames: measuring every setting, and the picture of error against a cost."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
