"""Networks over width and precision: trained ones with their error, untrained widths for their time alone.

bfloat16 is torch's autocast on the processor; int8 is onnxruntime's static quantisation
(`fpp_ml_bench.leaderboard.tradeoff.onnx`). Imported only where networks are measured: torch takes a second.
"""

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from fpp_ml_bench.baselines.method import METHODS, Method, load_method
from fpp_ml_bench.baselines.networks import (
    DepthRange,
    FringeNetwork,
    Model,
    NetworkMethod,
    build,
    fringe_batch,
    load,
    parameter_count,
    represent,
)
from fpp_ml_bench.baselines.training import SHIPPED, SUFFIX, ModelConfig, WeightsFile, open_weights
from fpp_ml_bench.errors import NetworkError, PredictionError, WeightsError
from fpp_ml_bench.leaderboard.tradeoff.measure import Setting
from fpp_ml_bench.leaderboard.tradeoff.onnx import OnnxMethod
from fpp_ml_bench.leaderboard.tradeoff.views import Frames, StoredViews

PRECISIONS = ("fp32", "bf16", "onnx-fp32", "onnx-int8")
WIDTHS, QUICK_WIDTHS = (4, 8, 16, 32), (4, 8)
"""Of an untrained UNet; the quick widths also for large images. The paper's width 64 only with --widths: at 960 px an
image takes a minute on one thread."""
LARGE_PX = 500 * 500
EMULATED_WIDTH = 8
"""Widest network that is run in bfloat16 on a processor that emulates it, ten times slower than float32."""
UNTRAINED_EXAMPLES = 2
NOT_TRAINED = "time alone, no error: not trained"
_BF16_FLAGS = ("avx512_bf16", "amx_bf16", "asimdbf16", "bf16")


def bf16_note() -> str | None:
    """A note about bfloat16 on this processor; None where it has instructions for it or nothing is known."""
    try:
        flags = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").split()
    except OSError:
        return None
    return None if set(flags).intersection(_BF16_FLAGS) else "this CPU has no bf16 instructions: emulated"


def trained_weights(size: tuple[int, int], runs: Path | None) -> list[WeightsFile]:
    """Weights for images of ``size`` (H, W): those that ship with the package, and every weights file of a training
    below ``runs``, each content once. Raises WeightsError for a ``runs`` that is no folder."""
    if runs is not None and not runs.is_dir():
        raise WeightsError(f"--runs {runs}: expected a folder of trainings, like the runs/ of fpp-bench reproduce")
    files = sorted(SHIPPED.glob(f"*{SUFFIX}"))
    files += sorted(runs.glob(f"**/weights/*{SUFFIX}")) if runs is not None else []
    by_sha256: dict[str, WeightsFile] = {}
    for path in files:
        weights = open_weights(path)
        if weights.config.image_size == size:
            by_sha256.setdefault(weights.sha256, weights)
    return list(by_sha256.values())


def network_settings(
    views: StoredViews, threads: int, runs: Path | None = None, widths: Sequence[int] | None = None, quick: bool = False
) -> Iterator[Setting]:
    """Every trained network of the views' image size in every precision, the phase route with a learned order, then
    untrained UNets of ``widths``."""
    torch.set_num_threads(threads)
    height, width = views.opened.size
    precisions = PRECISIONS[:2] if quick else PRECISIONS
    seen: dict[str, int] = {}
    for weights in trained_weights((height, width), runs):
        path, config = weights.path, weights.config
        seen[config.name] = seen.get(config.name, 0) + 1
        repeat = f" #{seen[config.name]}" if seen[config.name] > 1 else ""
        for depth_range in _ranges(config):
            for precision in precisions:
                if precision.startswith("onnx") and depth_range == "predicted":
                    continue  # the range heads read layers that an ONNX file does not expose
                title = f"{config.name}{repeat}{_range_words(depth_range)}, {precision}"
                make = partial(_trained, path, depth_range, precision, views, threads)
                key = f"network-{config.name}-{weights.sha256[:8]}-{depth_range or 'mm'}-{precision}"
                yield Setting(key, "networks", title, make, views, note=_note(precision))
    if "phase-net" in METHODS:
        yield Setting("phase-net", "networks", "phase-net", partial(load_method, "phase-net", views.rig), views)
    for unet_width in widths if widths is not None else QUICK_WIDTHS if quick or height * width > LARGE_PX else WIDTHS:
        for precision in precisions:
            if precision == "bf16" and unet_width > EMULATED_WIDTH and bf16_note():
                continue
            make = partial(_untrained, unet_width, precision, views, threads)
            note = "; ".join(filter(None, (NOT_TRAINED, _note(precision))))
            title = f"UNet width {unet_width}, {precision}"
            yield Setting(f"network-width-{unet_width:03d}-{precision}", "networks", title, make, views, False, note)


def _ranges(config: ModelConfig) -> tuple[DepthRange | None, ...]:
    return ("predicted", "oracle") if config.normalisation == "individual" else (None,)


def _range_words(depth_range: str | None) -> str:
    return "" if depth_range is None else f" ({depth_range} range)"


def _note(precision: str) -> str | None:
    return bf16_note() if precision == "bf16" else None


def in_bfloat16(network: FringeNetwork) -> FringeNetwork:
    """``network`` with its forward pass under autocast to bfloat16; range heads and conversion to mm stay float32."""
    network.forward = torch.autocast("cpu", dtype=torch.bfloat16)(network.forward)  # type: ignore[method-assign]
    return network


def _trained(path: Path, depth_range: DepthRange | None, precision: str, views: StoredViews, threads: int) -> Method:
    model: Model = load(path, "cpu")
    if depth_range == "predicted" and model.heads is None:
        raise PredictionError(f"{path.name} holds no range heads, so it can't predict a depth range")
    network_method = NetworkMethod(model, depth_range, threads=threads, sequence=views.opened.sequence)
    if precision == "bf16":
        in_bfloat16(model.network)
    if not precision.startswith("onnx"):
        return network_method
    return OnnxMethod(
        model.network, network_method, calibration(views, network_method), threads, precision == "onnx-int8"
    )


def calibration(views: StoredViews, like: Method, count: int = 8) -> NDArray[np.float32]:
    """Fringes (n, 1, H, W) in [0, 1] of train samples, spread over the split, as int8 is calibrated on."""
    opened = views.opened
    samples = opened.samples("train") if "train" in opened.splits else []
    if not samples:
        raise PredictionError(f"{opened.path}: int8 is calibrated on train samples, and it has none")
    (frame,) = like.frames_used
    chosen = [opened.frame(sample, frame) for sample in samples[:: max(1, len(samples) // count)][:count]]
    return fringe_batch(chosen, opened.size, "the calibration").numpy()


class UntrainedMethod(Method):
    """A network with its initial weights, to measure time only: its output is never scored."""

    units = "normalised"

    def __init__(self, network: FringeNetwork, frame: int = 0) -> None:
        self.network = network.eval().requires_grad_(False)
        self.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.frames_used = (frame,)
        self.name = self.title = f"untrained {network.name}"
        self.settings: dict[str, Any] = dict(network.options)
        self.parameters = sum(parameter.numel() for parameter in network.parameters())

    def predict(self, frames: Frames) -> NDArray[np.float32]:
        """The network's output float32 (H, W)."""
        image = frames[self.frames_used[0]]
        if image is None:
            raise PredictionError(f"frame {self.frames_used[0]} was not captured")
        batch = fringe_batch([image], (image.shape[0], image.shape[1]), self.name)
        with torch.inference_mode():
            return represent(self.network, batch, self.name)[0, 0].float().numpy()


def _untrained(width: int, precision: str, views: StoredViews, threads: int) -> Method:
    torch.manual_seed(0)
    network = build("unet", width=width)
    network.check_size(*views.opened.size)
    parameters = parameter_count(network)
    if parameters > 5e8:
        raise NetworkError(f"a UNet of width {width} has {parameters:,} parameters; give a smaller one")
    untrained, quantised = UntrainedMethod(network), precision == "onnx-int8"
    if precision == "bf16":
        in_bfloat16(network)
    if not precision.startswith("onnx"):
        return untrained
    return OnnxMethod(network, untrained, calibration(views, untrained, UNTRAINED_EXAMPLES), threads, quantised)
