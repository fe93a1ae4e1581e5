"""The paper's networks, by name: bare torch modules, one representation of depth out for one fringe image in. Importing
this package does not import torch; `build` and `discriminator` do."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
