"""Ill-conditioned and extreme cases, each compared with a reference of higher precision and a theoretical bound."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
