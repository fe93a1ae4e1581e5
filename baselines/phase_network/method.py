"""The learned route as a method of ``fpp-bench predict``: one captured fringe, metric depth, no range given."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from fpp_ml_bench.baselines.method import Answer, Frames, Method
from fpp_ml_bench.baselines.networks import torch_threads
from fpp_ml_bench.baselines.phase_network.network import PhaseNet
from fpp_ml_bench.baselines.phase_network.route import Levers, NetworkRoute
from fpp_ml_bench.baselines.phase_route import Measurement, Periods, Settings
from fpp_ml_bench.baselines.training import PHASE_NETWORKS, NetConfig, read_file, weights_path, write_file
from fpp_ml_bench.errors import DecodeError, NetworkError, PredictionError, WeightsError
from fpp_ml_bench.files import printable
from fpp_ml_bench.optics import Direction, Rig

SHIPPED = Path(__file__).resolve().parent / "weights"  # folder of the weights that come with the package
DEFAULT = "phase-net"
PERIOD_TOLERANCE = 2.2
"""Factor by which an image's fringe period in px may differ from that of the training images; beyond, the image is
resampled to theirs."""


@dataclass(frozen=True)
class NetFile:
    """A checked file and the network in it, ready to run."""

    path: Path
    config: NetConfig
    network: PhaseNet
    sha256: str


def save_net(path: Path, network: PhaseNet, config: NetConfig) -> str:
    """Write ``network`` to ``path`` in half precision, complete or not at all; the file's SHA-256. `WeightsError` for
    tensors that are not finite in half precision, and for a path that can't be written."""
    tensors = {}
    for name, tensor in network.state_dict().items():
        tensors[name] = tensor.detach().cpu().half() if tensor.is_floating_point() else tensor
        if not bool(tensors[name].isfinite().all()):
            raise WeightsError(f"{path}: {name} is not finite in half precision; the training diverged")
    return write_file(path, PHASE_NETWORKS, config, tensors)


def load_net(name_or_path: str | Path = DEFAULT, folded: bool = True, shipped: Path = SHIPPED) -> NetFile:
    """Configuration and network of weights in the folder ``shipped`` or of a file, float32; ``folded``: for inference
    alone (`PhaseNet.folded`), False to train on. `WeightsError` for a file that is absent, damaged, of another kind or
    version, or whose tensors do not fit its configuration."""
    path = weights_path(name_or_path, shipped)
    shown = printable(str(path), 500)
    config, tensors, digest = read_file(path, PHASE_NETWORKS)
    try:
        network = PhaseNet(**config.options)
        network.load_state_dict({name: t.float() if t.is_floating_point() else t for name, t in tensors.items()})
    except (NetworkError, TypeError, ValueError, RuntimeError) as error:
        raise WeightsError(f"{shown}: its tensors are not those of its network: {printable(str(error), 300)}") from None
    if not all(bool(torch.isfinite(t).all()) for t in network.state_dict().values()):
        raise WeightsError(f"{shown}: holds values that are not finite; copy or train it again")
    return NetFile(path, config, network.folded() if folded else network, digest)


class PhaseNetMethod(Method):
    """Depth from the first sinusoid of one ``direction`` by the weights ``weights`` (a shipped name or a file).
    ``min_confidence``: pixels below it are masked; ``shading`` False: orders without brightness, for painted objects;
    ``white_grey`` and ``ambient_grey``: as of `Settings`, for images without a lit background. Raises `WeightsError`
    for weights that can't be used, and `PredictionError` for an invalid option."""

    name = "phase-net"
    target = "depth"
    packages = ("numpy", "numba", "torch")

    def __init__(
        self, rig: Rig, direction: Direction = "horizontal", weights: str | Path | NetFile = DEFAULT,
        min_confidence: float = 0.0, shading: bool = True, levers: Levers | None = None, threads: int = 1,
        white_grey: float | None = None, ambient_grey: float | None = None,
    ) -> None:  # fmt: skip
        self.options = Settings(
            direction=direction, min_confidence=min_confidence, shading=shading, white_grey=white_grey,
            ambient_grey=ambient_grey,
        )  # fmt: skip
        self.file = weights if isinstance(weights, NetFile) else load_net(weights)
        self.rig, self.threads = rig, threads
        trained_period_px = self.file.config.period_px.get(direction)
        if trained_period_px is None:
            raise PredictionError(
                f"{self.file.path}: learned from {', '.join(self.file.config.period_px)} fringes only, not from "
                f"{direction} ones; use other weights, or the measured route (phase)"
            )
        bounds = trained_period_px / PERIOD_TOLERANCE, trained_period_px * PERIOD_TOLERANCE
        periods = Periods(bounds[0], trained_period_px, bounds[1])
        config = self.file.config
        route_levers = levers or Levers(shading=shading)
        self.route = NetworkRoute(
            rig, self.options, self.file.network, config.threshold, route_levers, config.lead, periods
        )
        self.weights_config = config
        self.parameters = sum(parameter.numel() for parameter in self.file.network.parameters())
        self.frames_used = (rig.sequence.sinusoids(direction)[0],)
        more = "" if config.name == DEFAULT else f" ({config.name})"
        blind = "" if shading else ", without brightness"
        self.title = f"Phase route, one {direction} fringe; order, mask and correction learned{more}{blind}"
        self.settings = {
            "direction": direction, "shading": shading, "min_confidence": min_confidence, "weights": config.name,
            "weights_sha256": self.file.sha256, "mask_threshold": config.threshold, "order_lead": config.lead,
            "threads": threads, "white_grey": white_grey, "ambient_grey": ambient_grey,
        }  # fmt: skip

    def measure(self, frames: Frames) -> Measurement:
        """All maps of a captured sequence; frames that are not in `frames_used` may be None."""
        with torch_threads(self.threads):
            return self.route.measure(self._image(frames))

    def crop(self, frames: Frames) -> tuple[slice, slice]:
        route = self.route.geometry.route
        return route.resampling.captured_crop(route.observe(self._image(frames)).crop)

    def _image(self, frames: Frames) -> NDArray[np.uint8]:
        (index,) = self.frames_used
        image = frames[index] if index < len(frames) else None
        if image is None:
            raise DecodeError(f"frame {index} is missing: phase-net needs that one fringe")
        return image

    def predict(self, frames: Frames) -> NDArray[np.float32]:
        """Depth float32 (H, W) in mm, 0 = background, or masked where ``min_confidence`` is above 0."""
        return self.measure(frames).depth_mm

    def answer(self, frames: Frames) -> Answer:
        measurement = self.measure(frames)
        return Answer(measurement.depth_mm, measurement.sigma_mm)
