"""The paper's networks, by name: bare torch modules, one representation of depth out for one fringe image in.

>>> from fpp_ml_bench.baselines.networks import build
>>> network = build("unet", width=8)                    # doctest: +SKIP
>>> network(fringe).shape                               # float (B, 1, H, W)    # doctest: +SKIP

Importing this package does not import torch; `build` and `discriminator` do.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
