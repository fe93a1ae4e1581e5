"""The learned route as a method of ``fpp-bench predict``: one captured fringe, metric depth, no range given."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_network.route import Levers, NetworkRoute
from fpp_ml_bench.baselines.phase_network.weights import DEFAULT, NetConfig, NetFile, load_net
from fpp_ml_bench.baselines.phase_route import Measurement, Settings
from fpp_ml_bench.errors import DecodeError, PredictionError
from fpp_ml_bench.optics import Direction, Rig

PERIOD_TOLERANCE = 2.2
"""Factor by which an image's fringe period in px may differ from that of the training images."""


class PhaseNetMethod:
    """Depth from the first sinusoid of one ``direction`` by the weights ``weights`` (a shipped name or a file).

    ``min_confidence``: pixels below it are masked; ``shading`` False: orders without brightness, for painted objects.
    Raises `WeightsError` for weights that can't be used, and `PredictionError` for an invalid option and for a rig
    whose fringe period in the image is far from that of the training data.
    """

    name = "phase-net"
    uses_ground_truth_range = False
    units = "mm"
    target = "depth"
    packages = ("numpy", "numba", "torch")
    device = "cpu"

    def __init__(
        self, rig: Rig, direction: Direction = "horizontal", weights: str | Path | NetFile = DEFAULT,
        min_confidence: float = 0.0, shading: bool = True, levers: Levers | None = None, threads: int = 1,
    ) -> None:  # fmt: skip
        self.options = Settings(direction=direction, min_confidence=min_confidence, shading=shading)
        self.file = weights if isinstance(weights, NetFile) else load_net(weights)
        self.rig, self.threads = rig, threads
        trained_period_px = self.file.config.period_px.get(direction)
        image_period_px = rig.image_px_per_period(direction)
        if trained_period_px is None:
            raise PredictionError(
                f"{self.file.path}: learned from {', '.join(self.file.config.period_px)} fringes only, not from "
                f"{direction} ones; use other weights, or the measured route (phase)"
            )
        if not trained_period_px / PERIOD_TOLERANCE < image_period_px < trained_period_px * PERIOD_TOLERANCE:
            raise PredictionError(
                f"{self.file.path}: learned from {direction} fringes of {trained_period_px:.1f} px a period in the "
                f"image, this rig's have {image_period_px:.1f} px, beyond a factor of {PERIOD_TOLERANCE}; train "
                "weights for it (fpp-bench train phase-net), or use the measured route (phase)"
            )
        route_levers = levers or Levers(shading=shading)
        config = self.file.config
        self.route = NetworkRoute(rig, self.options, self.file.network, config.threshold, route_levers, config.lead)

    @property
    def frames_used(self) -> tuple[int, ...]:
        """The frame that must be captured."""
        return (self.rig.sequence.sinusoids(self.options.direction)[0],)

    @property
    def title(self) -> str:
        blind = "" if self.options.shading else ", without brightness"
        more = "" if self.file.config.name == DEFAULT else f" ({self.file.config.name})"
        return f"Phase route, one {self.options.direction} fringe; order, mask and correction learned{more}{blind}"

    @property
    def settings(self) -> dict[str, Any]:
        return {
            "direction": self.options.direction, "shading": self.options.shading,
            "min_confidence": self.options.min_confidence, "weights": self.file.config.name,
            "weights_sha256": self.file.sha256, "mask_threshold": self.file.config.threshold,
            "order_lead": self.file.config.lead, "threads": self.threads,
        }  # fmt: skip

    @property
    def weights_config(self) -> NetConfig:
        """What the weights file says of the network and its training data."""
        return self.file.config

    @property
    def parameters(self) -> int:
        """Numbers that were learned."""
        return sum(parameter.numel() for parameter in self.file.network.parameters())

    def measure(self, frames: Sequence[NDArray[np.uint8] | None]) -> Measurement:
        """All maps of a captured sequence; frames that are not in `frames_used` may be None."""
        import torch

        (index,) = self.frames_used
        image = frames[index] if index < len(frames) else None
        if image is None:
            raise DecodeError(f"frame {index} is missing: phase-net needs that one fringe")
        before = torch.get_num_threads()
        torch.set_num_threads(self.threads)
        try:
            return self.route.measure(image)
        finally:
            torch.set_num_threads(before)

    def predict(self, frames: Sequence[NDArray[np.uint8] | None]) -> NDArray[np.float32]:
        """Depth float32 (H, W) in mm, 0 = background, or masked where ``min_confidence`` is above 0."""
        return self.measure(frames).depth_mm
