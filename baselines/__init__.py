"""Methods that turn fringes into depth, and running them over a dataset.

A method takes the frames it names and gives ``depth_mm``; `fpp_ml_bench.baselines.method` lists what there is, and
`fpp_ml_bench.baselines.run` runs one over a split and writes predictions that ``fpp-eval`` scores.

>>> from fpp_ml_bench.baselines import build, load
>>> network = build("unet")                              # bare and untrained    # doctest: +SKIP
>>> model = load("unet-individual-hybrid_l1_0.7")        # trained    # doctest: +SKIP
>>> depth_mm = model.predict(fringe)                     # doctest: +SKIP

Importing this package does not import torch; using these two names does.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
