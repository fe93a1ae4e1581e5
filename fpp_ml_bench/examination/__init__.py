"""One examination of a capture, for decode, import and calibrate: what its frames say about themselves, as findings."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
