"""The networks by name. Imports no torch before one is built."""

import inspect
from typing import Any

from fpp_ml_bench.baselines import networks
from fpp_ml_bench.errors import NetworkError

_CLASSES = {
    "unet": "UNet",
    "transunet": "TransUNet",
    "resunet": "ResUNet",
    "hformer": "Hformer",
    "pix2pix": "Pix2Pix",
    "pix2pix_unet": "Pix2PixUNet",
}
NETWORKS = tuple(_CLASSES)


def build(name: str, **options: int | float) -> "networks.FringeNetwork":
    """One of `NETWORKS`, untrained, in float32 on the default device. ``options`` are the network's keyword options,
    the paper's values by default; ``width`` scales every width. The weights depend on torch's random state only.
    ``build(network.name, **network.options)`` makes the network again. Raises `NetworkError` for an unknown name, an
    unknown option, or a value that the network can't have."""
    if name not in _CLASSES:
        raise NetworkError(f"unknown network {name!r}; there are {', '.join(NETWORKS)}")
    return _constructed(f"network {name!r}", getattr(networks, _CLASSES[name]), options)


def discriminator(**options: int | float) -> "networks.Discriminator":
    """The two-scale discriminator of a GAN (`pix2pix.Discriminator`); `NetworkError` as `build`."""
    return _constructed("the discriminator", networks.Discriminator, options)


def _constructed(label: str, cls: type, options: dict[str, Any]) -> Any:
    parameters = inspect.signature(cls).parameters
    if unknown := sorted(set(options) - set(parameters)):
        available = ", ".join(f"{p.name} (default {p.default})" for p in parameters.values())
        raise NetworkError(f"{label} has no option {', '.join(map(repr, unknown))}; there are: {available}")
    return cls(**options)
