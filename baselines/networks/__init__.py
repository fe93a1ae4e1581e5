"""The paper's networks, by name: bare torch modules, one representation of depth out for one fringe image in.

>>> from fpp_ml_bench.baselines.networks import build
>>> network = build("unet", width=8)                    # doctest: +SKIP
>>> network(fringe).shape                               # float (B, 1, H, W)    # doctest: +SKIP

Importing this package does not import torch; `build` and `discriminator` do.
"""

import importlib
import inspect
from typing import TYPE_CHECKING

from fpp_ml_bench.errors import NetworkError

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.networks.base import FringeNetwork
    from fpp_ml_bench.baselines.networks.pix2pix import Discriminator

NETWORKS = ("unet", "transunet", "resunet", "hformer", "pix2pix")

# module below this package and class in it
_CLASSES = {
    "unet": ("unet", "UNet"),
    "transunet": ("transunet", "TransUNet"),
    "resunet": ("resunet", "ResUNet"),
    "hformer": ("hformer", "Hformer"),
    "pix2pix": ("pix2pix", "Pix2Pix"),
}


def _construct(label: str, cls: type, options: dict[str, object]) -> object:
    parameters = inspect.signature(cls).parameters
    unknown = sorted(set(options) - set(parameters))
    if unknown:
        available = ", ".join(f"{p.name} (default {p.default})" for p in parameters.values())
        raise NetworkError(f"{label} has no option {', '.join(map(repr, unknown))}; there are: {available}")
    return cls(**options)


def build(name: str, **options: int | float) -> "FringeNetwork":
    """One of `NETWORKS`, untrained, in float32 on the default device.

    ``options`` are the network's keyword options, with the paper's values as defaults; ``width`` scales every width of
    the network in proportion. The weights depend on torch's random state only: the same ``torch.manual_seed`` gives
    the same weights. ``build(network.name, **network.options)`` makes the same network again.

    Raises `NetworkError` for an unknown name, an unknown option, or a value that the network can't have.
    """
    if name not in _CLASSES:
        raise NetworkError(f"unknown network {name!r}; there are {', '.join(NETWORKS)}")
    module, cls = _CLASSES[name]
    network_class = getattr(importlib.import_module(f"{__name__}.{module}"), cls)
    return _construct(f"network {name!r}", network_class, dict(options))  # type: ignore[return-value]


def discriminator(**options: int | float) -> "Discriminator":
    """The two-scale discriminator that trains against pix2pix; see `pix2pix.Discriminator` for its options.

    Raises `NetworkError` for an unknown option or an impossible value.
    """
    from fpp_ml_bench.baselines.networks.pix2pix import Discriminator

    return _construct("the discriminator", Discriminator, dict(options))  # type: ignore[return-value]
