"""Methods that turn fringes into depth (`fpp_ml_bench.baselines.method`), and running them over a
split.

>>> from fpp_ml_bench.baselines import build, load
>>> network = build("unet")                              # bare and untrained    # doctest: +SKIP
>>> model = load("unet-individual-hybrid_l1_0.7")        # trained    # doctest: +SKIP
>>> depth_mm = model.predict(fringe)                     # doctest: +SKIP

Importing this package does not import torch; using these two names does.
"""


def __getattr__(name: str) -> object:
    if name not in ("build", "load"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from fpp_ml_bench.baselines.networks import model

    return getattr(model, name)
