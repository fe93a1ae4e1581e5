"""The networks by name. Imports no torch before one is built."""

import inspect
from typing import TYPE_CHECKING, Any

from fpp_ml_bench.baselines import networks
from fpp_ml_bench.errors import NetworkError

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.networks.base import FringeNetwork
    from fpp_ml_bench.baselines.networks.pix2pix import Discriminator

_CLASSES = {
    "unet": "UNet", "transunet": "TransUNet", "resunet": "ResUNet", "hformer": "Hformer", "pix2pix": "Pix2Pix",
}  # fmt: skip
NETWORKS = tuple(_CLASSES)


def build(name: str, **options: int | float) -> "FringeNetwork":
    """One of `NETWORKS`, untrained, in float32 on the default device.

    ``options`` are the network's keyword options, with the paper's values as defaults; ``width`` scales every width of
    the network in proportion. The weights depend on torch's random state only: the same ``torch.manual_seed`` gives
    the same weights. ``build(network.name, **network.options)`` makes the same network again.

    Raises `NetworkError` for an unknown name, an unknown option, or a value that the network can't have.
    """
    if name not in _CLASSES:
        raise NetworkError(f"unknown network {name!r}; there are {', '.join(NETWORKS)}")
    network: FringeNetwork = _constructed(f"network {name!r}", getattr(networks, _CLASSES[name]), options)
    return network


def discriminator(**options: int | float) -> "Discriminator":
    """The two-scale discriminator that trains against pix2pix; see `pix2pix.Discriminator` for its options.

    Raises `NetworkError` for an unknown option or an impossible value.
    """
    judge: Discriminator = _constructed("the discriminator", networks.Discriminator, options)
    return judge


def _constructed(label: str, cls: type, options: dict[str, Any]) -> Any:
    parameters = inspect.signature(cls).parameters
    unknown = sorted(set(options) - set(parameters))
    if unknown:
        available = ", ".join(f"{p.name} (default {p.default})" for p in parameters.values())
        raise NetworkError(f"{label} has no option {', '.join(map(repr, unknown))}; there are: {available}")
    return cls(**options)
