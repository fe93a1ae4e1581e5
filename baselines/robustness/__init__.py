"""FPP-C: what breaks a method, axis by axis. Scenes are disturbed in the image formation, and the answers scored, with
a fixed charge for silence."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
