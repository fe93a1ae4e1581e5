"""The learned route as a method of ``fpp-bench predict``: one captured fringe, metric depth, no range given."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from fpp_ml_bench.baselines.method import Answer, Frames, Method
from fpp_ml_bench.baselines.networks import torch_threads
from fpp_ml_bench.baselines.phase_network.network import PhaseNet
from fpp_ml_bench.baselines.phase_network.odds import Odds
from fpp_ml_bench.baselines.phase_network.route import Levers, NetworkRoute
from fpp_ml_bench.baselines.phase_route import Measurement, Periods, Settings
from fpp_ml_bench.baselines.training import PHASE_NETWORKS, Family, NetConfig, read_file, weights_path, write_file
from fpp_ml_bench.errors import DecodeError, NetworkError, PredictionError, WeightsError
from fpp_ml_bench.files import printable
from fpp_ml_bench.optics import Direction, Rig

SHIPPED = Path(__file__).resolve().parent / "weights"  # folder of the weights that come with the package
DEFAULT = "phase-net-one-albedo"
PERIOD_TOLERANCE = 1.4
"""Factor by which an image's fringe period in px may differ from that of the training images; beyond, the image is
resampled to theirs."""


@dataclass(frozen=True)
class NetFile:
    """A checked file and the network in it, ready to run."""

    path: Path
    config: NetConfig
    network: PhaseNet
    sha256: str


def rendered_data(config: NetConfig) -> dict[str, Any]:
    """`Method.learned_from` of weights whose training renders its own views."""
    recipe = config.recipe
    lights = f"training objects in the light paper and {recipe.get('lights')} drawn ones, seed {recipe.get('seed')}"
    return {"data": "generated", "versions": [lights]}


def save_net(path: Path, network: nn.Module, config: NetConfig, family: Family = PHASE_NETWORKS) -> str:
    """Write ``network`` to ``path`` in half precision, complete or not at all; the file's SHA-256. `WeightsError` for
    tensors that are not finite in half precision, and for a path that can't be written."""
    tensors = {}
    for name, tensor in network.state_dict().items():
        tensors[name] = tensor.detach().cpu().half() if tensor.is_floating_point() else tensor
        if not bool(tensors[name].isfinite().all()):
            raise WeightsError(f"{path}: {name} is not finite in half precision; the training diverged")
    return write_file(path, family, config, tensors)


Network = TypeVar("Network", bound=nn.Module)


def read_net(
    path: Path, build: Callable[..., Network], family: Family = PHASE_NETWORKS
) -> tuple[NetConfig, Network, str]:
    """Configuration, network, float32, and SHA-256 of a file of ``family`` whose options ``build`` takes.
    `WeightsError` for a file that is absent, damaged, of another kind or version, or whose tensors do not fit its
    configuration."""
    shown = printable(str(path), 500)
    config, tensors, digest = read_file(path, family)
    try:
        network = build(**config.options)
        network.load_state_dict({name: t.float() if t.is_floating_point() else t for name, t in tensors.items()})
    except (NetworkError, TypeError, ValueError, RuntimeError) as error:
        raise WeightsError(f"{shown}: its tensors are not those of its network: {printable(str(error), 300)}") from None
    if not all(bool(torch.isfinite(t).all()) for t in network.state_dict().values()):
        raise WeightsError(f"{shown}: holds values that are not finite; copy or train it again")
    return config, network, digest


def load_net(name_or_path: str | Path = DEFAULT, folded: bool = True, shipped: Path = SHIPPED) -> NetFile:
    """Weights in the folder ``shipped`` or of a file, float32; ``folded``: for inference alone (`PhaseNet.folded`),
    False to train on. Raises what `read_net` raises."""
    path = weights_path(name_or_path, shipped)
    config, network, digest = read_net(path, PhaseNet)
    return NetFile(path, config, network.folded() if folded else network, digest)


def _shipped(albedo: str) -> str:
    if albedo not in ("one", "any"):
        raise PredictionError(f"albedo {albedo!r}: expected one or any")
    return f"phase-net-{albedo}-albedo"


class PhaseNetMethod(Method):
    """Depth from the first sinusoid of one ``direction``. ``albedo``: "one", where all surfaces have the background's,
    so that brightness tells the order, or "any", where it is ambiguous unless range and shape tell it; or
    ``weights``, a shipped name or a file, which say what they learned. ``min_confidence``: pixels below it are masked;
    ``white_grey`` and ``ambient_grey``: as of `Settings`, for images without a lit background. Raises `WeightsError`
    for weights that can't be used, and `PredictionError` for an invalid option."""

    name = "phase-net"
    packages = ("numpy", "numba", "torch")

    def __init__(
        self,
        rig: Rig,
        direction: Direction = "horizontal",
        weights: str | Path | NetFile | None = None,
        min_confidence: float = 0.0,
        albedo: str | None = None,
        levers: Levers | None = None,
        threads: int = 1,
        white_grey: float | None = None,
        ambient_grey: float | None = None,
    ) -> None:
        self.file = weights if isinstance(weights, NetFile) else load_net(weights or _shipped(albedo or "one"))
        learned = self.file.config.recipe.get("albedo")
        if learned not in ("one", "any") or not self.file.network.uncertain:
            raise PredictionError(
                f"{self.file.path}: expected weights that this version's fpp-bench train phase-net wrote"
            )
        if albedo not in (None, learned):
            raise PredictionError(f"{self.file.path}: learned {learned} albedo, not {albedo}; leave --albedo out")
        shading = learned == "one"
        self.options = Settings(
            direction=direction,
            min_confidence=min_confidence,
            shading=shading,
            white_grey=white_grey,
            ambient_grey=ambient_grey,
        )
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
        odds = Odds(config.temperature, config.offset, config.doubted)
        self.route = NetworkRoute(
            rig,
            self.options,
            self.file.network,
            config.threshold,
            replace(levers or Levers(), shading=shading),
            config.lead,
            odds,
            periods,
        )
        self.weights_config = config
        self.parameters = sum(parameter.numel() for parameter in self.file.network.parameters())
        self.frames_used = (rig.sequence.sinusoids(direction)[0],)
        more = "" if config.name == f"phase-net-{learned}-albedo" else f" ({config.name})"
        # With a range under a period, most pixels have one order in it, whatever the network says.
        self.by_range = rig.periods_in_range(direction) < 1
        told = "order by range; mask" if self.by_range else "order, mask"
        self.title = f"Phase route, one {direction} fringe, {learned} albedo; {told} and correction learned{more}"
        self.settings = {
            "direction": direction,
            "albedo": learned,
            "shading": shading,
            "order_by_range": self.by_range,
            "min_confidence": min_confidence,
            "weights": config.name,
            "weights_sha256": self.file.sha256,
            "mask_threshold": config.threshold,
            "order_lead": config.lead,
            "temperature": config.temperature,
            "offset": config.offset,
            "doubted": config.doubted,
            "threads": threads,
            "white_grey": white_grey,
            "ambient_grey": ambient_grey,
        }

    @property
    def learned_from(self) -> dict[str, Any]:
        """Views that its training renders of the training objects."""
        return rendered_data(self.file.config)

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
