"""A trained network ready to use: fringe image in, depth in mm out.

>>> from fpp_ml_bench.baselines import load
>>> model = load("unet-individual-hybrid_l1_0.7")       # doctest: +SKIP
>>> depth_mm = model.predict(fringe)                    # uint8 (H, W) -> float32 (H, W)    # doctest: +SKIP
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from fpp_ml_bench.baselines.networks import build
from fpp_ml_bench.baselines.networks.inference import Fringe, fringe_batch, probed, represent
from fpp_ml_bench.baselines.networks.metric_twin import TWINS, RangeHeads, Twin, heads_from_tensors
from fpp_ml_bench.baselines.training import ModelConfig, open_weights, weights_path
from fpp_ml_bench.depth import denormalise
from fpp_ml_bench.errors import PredictionError, WeightsError

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.networks.base import FringeNetwork


@dataclass(frozen=True, eq=False)
class Model:
    """A network with its weights, in eval mode. ``heads`` turn an individually normalised output into mm, or None.

    ``sha256`` is that of the weights file.
    """

    network: "FringeNetwork"
    config: ModelConfig
    heads: RangeHeads | None
    device: torch.device
    sha256: str

    @property
    def parameters(self) -> int:
        """Numbers in the network, without those in the range heads."""
        return sum(parameter.numel() for parameter in self.network.parameters())

    @property
    def metric(self) -> bool:
        """Whether `predict` can: the output is metric itself, or there are range heads."""
        return self.config.normalisation != "individual" or self.heads is not None

    def predict(self, fringe: Fringe, depth_range: Twin = "predicted") -> NDArray[np.float32]:
        """Depth float32 (H, W) in mm of one fringe image (H, W), uint8 or float in [0, 1], of the size trained at.

        Of a network trained under raw or global normalisation this is the output as it is, negative values and all.
        Under individual normalisation the range heads make it: 0 where their mask says background, and the range
        ``predicted`` from the image or the training set's ``mean``. A network trained with the background removed
        expects ``fringe`` to be 0 outside the object.

        Raises `PredictionError` for another image than that, or an output that is not finite; `WeightsError` where the
        weights hold no range heads.
        """
        return self.predict_batch([fringe], depth_range)[0]

    def predict_batch(self, fringes: Sequence[Fringe], depth_range: Twin = "predicted") -> NDArray[np.float32]:
        """`predict` of several images at once: float32 (B, H, W) in mm."""
        if depth_range not in TWINS:
            raise PredictionError(f"unknown depth_range {depth_range!r}; there are {', '.join(TWINS)}")
        if self.config.normalisation != "individual":
            values = self.predict_representation(fringes)
            return denormalise(values, self.config.normalisation, 0.0, 0.0).astype(np.float32)
        if self.heads is None:
            raise WeightsError(
                f"{self.config.name}: its output is a share of the sample's depth range, and this file holds no range "
                "heads to make mm of it; use predict_representation, or fit them with "
                "fpp_ml_bench.baselines.networks.range_heads.fit_heads and save them with the weights"
            )
        batch = self._batch(fringes)
        with torch.inference_mode(), probed(self.network) as probe:
            output = represent(self.network, batch, self.config.name)
            depth = self.heads.depth_mm(output, probe, depth_range)
        return depth[:, 0].cpu().numpy()

    def predict_representation(self, fringes: Sequence[Fringe]) -> NDArray[np.float32]:
        """The network's own output float32 (B, H, W) for images (B, H, W), in the representation it was trained on
        (`fpp_ml_bench.depth`). Raises `PredictionError` as `predict`."""
        batch = self._batch(fringes)
        with torch.inference_mode():
            output = represent(self.network, batch, self.config.name)
        return output[:, 0].float().cpu().numpy()

    def _batch(self, fringes: Sequence[Fringe]) -> torch.Tensor:
        return fringe_batch(fringes, self.config.image_size, self.config.name).to(self.device)


def load(name_or_path: str | Path, device: str | None = None) -> Model:
    """The weights ``name_or_path``, shipped with the package or a ``.safetensors`` file, as a `Model`.

    ``device``: ``cpu``, ``cuda``, ...; None takes a CUDA device where there is one. Raises `WeightsError` for an
    unknown name (the message lists the shipped ones), a damaged or foreign file, or a device that does not exist.
    """
    weights = open_weights(weights_path(name_or_path))
    with torch.device("meta"):
        network = build(weights.config.network, **weights.config.options)
    network.load_state_dict(weights.tensors, assign=True)
    heads = heads_from_tensors(weights.heads, str(weights.path))
    torch_device = _device(device)
    # Channels last: never slower here, and up to 1.7 times faster on a CPU (UNet, width 8, 224 px).
    network = network.eval().requires_grad_(False).to(torch_device)
    network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return Model(network, weights.config, heads, torch_device, weights.sha256)


def _device(name: str | None) -> torch.device:
    if name is None:
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        return torch.empty(0, device=name).device
    except (RuntimeError, AssertionError, ValueError, TypeError) as error:
        raise WeightsError(f"device {name!r} can't be used here: {str(error).splitlines()[0]}; give cpu") from None
