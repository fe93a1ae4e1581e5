"""The published layout (PNG + .mat): reading it into the dataset format, and writing it."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
