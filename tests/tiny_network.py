"""Tiny networks and their configurations, for tests of what is done with a trained network."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from fpp_ml_bench.baselines.networks.model import build as build_network
from fpp_ml_bench.baselines.training.weights import ModelConfig

# Small networks and a size they take, 64 px; TransUNet is built for it: 4x4 map, 2x2 patches.
SMALL: dict[str, dict[str, int | float]] = {
    "unet": {"width": 4},
    "transunet": {"width": 2, "map_size": 4, "patch": 2},
    "resunet": {"width": 4},
    "hformer": {"width": 8},
    "pix2pix": {"width": 4},
    "pix2pix_unet": {"width": 4, "levels": 3},
}
RECIPE: dict[str, Any] = {
    "preset": "small",
    "seed": 42,
    "max_epochs": 3,
    "loss": {"name": "hybrid_l1", "alpha": 0.7},
    "batch": 4,
}


def tiny_network(
    name: str = "unet", width: int = 4, seed: int = 0, **options: Any
) -> torch.nn.Module:
    """A network with random weights, in eval mode; the same ``seed`` gives the same."""
    torch.manual_seed(seed)
    return build_network(name, width=width, **options).eval()


def config_of(network: torch.nn.Module, **changes: Any) -> ModelConfig:
    """A configuration that fits ``network``."""
    about: dict[str, Any] = {
        "name": "unet-individual-hybrid_l1_0.7",
        "title": "UNet, individual, hybrid l1 0.7",
        "network": network.name,
        "options": network.options,
        "normalisation": "individual",
        "image_size": (32, 48),
        "dataset_fingerprint": "0" * 64,
        "recipe": RECIPE,
        "epoch": 2,
        "validation": {"object_mae_mm": 12.5},
    }
    return ModelConfig(**{**about, **changes})


def rounding_error(network: nn.Module, output: Any) -> float:
    """How far two float32 runs of ``network`` may be apart by rounding alone, in the unit of its
    ``output``.

    Kernels for AVX-512, AVX2 and SSE, other thread counts and other batch sizes add the terms of a
    sum in another order. A sum of n terms is then off by about sqrt(n) eps of its size, and every
    layer adds an error of its own. Errors that were measured under these instruction sets are 3% to
    12% of this bound, which is itself 7e-5 to 3e-4 of the largest output for the networks in
    `SMALL`.
    """
    layers = [
        m for m in network.modules() if isinstance(m, nn.Conv2d | nn.ConvTranspose2d | nn.Linear)
    ]
    longest_sum = max(
        m.weight.numel() // (m.out_features if isinstance(m, nn.Linear) else m.out_channels)
        for m in layers
    )
    largest = float(np.abs(np.asarray(output)).max())
    return len(layers) * longest_sum**0.5 * float(np.finfo(np.float32).eps) * largest


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """For every test of a module that imports it: on small maps threads cost more than they
    bring."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
