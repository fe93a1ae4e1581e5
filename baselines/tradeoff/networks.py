"""Networks over width and precision: trained ones with their error, untrained widths for their time alone.

bfloat16 is torch's autocast on the processor. int8 is onnxruntime's static quantisation, calibrated on train samples:
weights (a scale for each channel) and activations (a scale for each tensor) have 8 bits. The last convolution stays in
float32: an 8-bit step of its metre-scale output would be 8 mm. On a processor without VNNI weights are quantised to 7
bit, because sums of products would overflow 16 bits (onnxruntime's own advice). onnxruntime needs the optional packages
of ``pip install "fpp-ml-bench[onnx]"``.
"""

import importlib.util
import logging
import math
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from fpp_ml_bench.baselines import networks
from fpp_ml_bench.baselines.method import Frames, Method
from fpp_ml_bench.baselines.networks import DepthRange, FringeNetwork, NetworkMethod, fringe_batch
from fpp_ml_bench.baselines.registry import load_method
from fpp_ml_bench.baselines.tradeoff.settings import Setting, StoredViews, TradeoffSettings
from fpp_ml_bench.baselines.training import SHIPPED, SUFFIX, WeightsFile, open_weights
from fpp_ml_bench.errors import FppBenchError, NetworkError, PredictionError, WeightsError

PRECISIONS = ("fp32", "bf16", "onnx-fp32", "onnx-int8")
WIDTHS, QUICK_WIDTHS = (4, 8, 16, 32), (4, 8)
"""Of an untrained UNet; the quick widths also for large images. The paper's width 64 only with --widths: at 960 px an
image takes a minute on one thread."""
LARGE_PX = 500 * 500
EMULATED_WIDTH = 8
"""Widest network that is run in bfloat16 on a processor that emulates it, ten times slower than float32."""
UNTRAINED_EXAMPLES = 2
NOT_TRAINED = "time alone, no error: not trained"
_BF16_FLAGS = {"avx512_bf16", "amx_bf16", "asimdbf16", "bf16"}
_VNNI_FLAGS = {"avx512_vnni", "avx_vnni", "asimddp"}


def _cpu_flags() -> set[str]:
    """Words of /proc/cpuinfo, empty where there is none."""
    with suppress(OSError):
        return set(Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").split())
    return set()


def bf16_note() -> str | None:
    """Says that this processor emulates bfloat16; None where it has instructions for it or nothing is known."""
    flags = _cpu_flags()
    return "this CPU has no bf16 instructions: emulated" if flags and not flags & _BF16_FLAGS else None


def trained_weights(size: tuple[int, int], runs: Path | None) -> Iterable[WeightsFile]:
    """Weights for images of ``size`` (H, W): those that ship with the package, and every weights file of a training
    below ``runs``, each content once. Raises WeightsError for a ``runs`` that is no folder."""
    if runs is not None and not runs.is_dir():
        raise WeightsError(f"--runs {runs}: expected a folder of trainings, like the runs/ of fpp-bench reproduce")
    files = sorted(SHIPPED.glob(f"*{SUFFIX}"))
    files += sorted(runs.glob(f"**/weights/*{SUFFIX}")) if runs is not None else []
    by_sha256: dict[str, WeightsFile] = {}
    for weights in map(open_weights, files):
        if weights.config.image_size == size:
            by_sha256.setdefault(weights.sha256, weights)
    return by_sha256.values()


def network_settings(views: StoredViews, run: TradeoffSettings) -> Iterator[Setting]:
    """Every trained network of the views' image size in every precision, the phase route with a learned order, then
    untrained UNets of several widths."""
    torch.set_num_threads(run.threads)
    precisions, notes = PRECISIONS[:2] if run.quick else PRECISIONS, {"bf16": bf16_note()}
    seen: Counter[str] = Counter()
    for weights in trained_weights(views.opened.size, run.runs):
        name = weights.config.name
        seen[name] += 1
        repeat = f" #{seen[name]}" if seen[name] > 1 else ""
        individual = weights.config.normalisation == "individual"
        ranges: tuple[DepthRange | None, ...] = ("predicted", "oracle") if individual else (None,)
        for depth_range, precision in product(ranges, precisions):
            if precision.startswith("onnx") and depth_range == "predicted":
                continue  # the range heads read layers that an ONNX file does not expose
            title = f"{name}{repeat}{f' ({depth_range} range)' if depth_range else ''}, {precision}"
            make = partial(_trained, weights.path, depth_range, precision, views, run.threads)
            key = f"network-{name}-{weights.sha256[:8]}-{depth_range or 'mm'}-{precision}"
            yield Setting(key, "networks", title, make, views, note=notes.get(precision))
    yield Setting("phase-net", "networks", "phase-net", partial(load_method, "phase-net", views.rig), views)
    default_widths = QUICK_WIDTHS if run.quick or math.prod(views.opened.size) > LARGE_PX else WIDTHS
    for unet_width, precision in product(default_widths if run.widths is None else run.widths, precisions):
        emulated = notes.get(precision)
        if not emulated or unet_width <= EMULATED_WIDTH:
            make_untrained = partial(Untrained, unet_width, precision, views, run.threads)
            key, title = f"network-width-{unet_width:03d}-{precision}", f"UNet width {unet_width}, {precision}"
            note = f"{NOT_TRAINED}; {emulated}" if emulated else NOT_TRAINED
            yield Setting(key, "networks", title, make_untrained, views, False, note)


def _trained(path: Path, depth_range: DepthRange | None, precision: str, views: StoredViews, threads: int) -> Method:
    model = networks.load(path, "cpu")
    if depth_range == "predicted" and model.heads is None:
        raise PredictionError(f"{path.name} holds no range heads, so it can't predict a depth range")
    trained = NetworkMethod(model, depth_range, threads=threads, sequence=views.opened.sequence)
    set_precision(model.network, precision, partial(calibration, views, trained.frame), threads)
    return trained


class Untrained(Method):
    """A UNet with its initial weights, to measure time only: its output is never scored."""

    units = "normalised"
    frames_used = (0,)

    def __init__(self, width: int, precision: str, views: StoredViews, threads: int) -> None:
        torch.manual_seed(0)
        self.network = networks.build("unet", width=width)
        self.network.check_size(*views.opened.size)
        self.parameters = networks.parameter_count(self.network)
        if self.parameters > 5e8:
            raise NetworkError(f"a UNet of width {width} has {self.parameters:,} parameters; give a smaller one")
        self.network.eval().requires_grad_(False).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.name = self.title = f"untrained {self.network.name}"
        self.settings: dict[str, Any] = dict(self.network.options)
        set_precision(self.network, precision, partial(calibration, views, 0, UNTRAINED_EXAMPLES), threads)

    def predict(self, frames: Frames) -> NDArray[np.float32]:
        """The network's output float32 (H, W)."""
        if (image := frames[0]) is None:
            raise PredictionError("frame 0 was not captured")
        batch = fringe_batch([image], (image.shape[0], image.shape[1]), self.name)
        with torch.inference_mode():
            return networks.represent(self.network, batch, self.name)[0, 0].float().numpy()


def calibration(views: StoredViews, frame: int, count: int = 8) -> NDArray[np.float32]:
    """Fringes (n, 1, H, W) in [0, 1] of train samples, spread over the split, as int8 is calibrated on."""
    opened = views.opened
    if not (samples := opened.samples("train") if "train" in opened.splits else []):
        raise PredictionError(f"{opened.path}: int8 is calibrated on train samples, and it has none")
    chosen = [opened.frame(sample, frame) for sample in samples[:: max(1, len(samples) // count)][:count]]
    return fringe_batch(chosen, opened.size, "the calibration").numpy()


def set_precision(network: FringeNetwork, precision: str, examples_of: Callable[[], NDArray], threads: int) -> None:
    """Run ``network`` in ``precision`` (of `PRECISIONS`) from now on; what is around it stays as it is, in float32.
    Examples, float32 (n, 1, H, W), give the size for onnxruntime, and int8 is calibrated on them. Raises
    `FppBenchError` where onnx or onnxruntime is not installed."""
    if precision == "bf16":
        network.forward = torch.autocast("cpu", dtype=torch.bfloat16)(network.forward)  # type: ignore[method-assign]
    if not precision.startswith("onnx"):
        return
    examples = examples_of()
    for package in ("onnx", "onnxruntime"):
        if importlib.util.find_spec(package) is None:
            raise FppBenchError(f'{package} is not installed: pip install "fpp-ml-bench[onnx]"')
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.log_severity_level = 3
    with tempfile.TemporaryDirectory(prefix="fpp-bench-onnx-") as folder:
        path = networks.export_onnx(network, Path(folder) / "network.onnx", examples.shape[2:])
        if precision == "onnx-int8":
            path = _quantised(path, examples)
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    name = session.get_inputs()[0].name
    network.forward = lambda fringe: torch.from_numpy(session.run(None, {name: fringe.numpy()})[0])  # type: ignore[method-assign]


def _quantised(path: Path, examples: NDArray[np.float32]) -> Path:
    """A quantised copy beside the file ``path``."""
    import onnx
    from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
    from onnxruntime.quantization.shape_inference import quant_pre_process

    left = iter(examples)

    class Examples(CalibrationDataReader):
        def get_next(self) -> dict[str, NDArray[np.float32]] | None:
            example = next(left, None)
            return None if example is None else {graph.input[0].name: example[None]}

    prepared, quantised_path = path.with_name("prepared.onnx"), path.with_name("int8.onnx")
    disabled_level = logging.root.manager.disable
    logging.disable(logging.WARNING)  # the quantiser writes to the root logger
    try:
        quant_pre_process(str(path), str(prepared))
        graph = onnx.load(str(prepared)).graph
        quantize_static(
            str(prepared),
            str(quantised_path),
            Examples(),
            quant_format=QuantFormat.QDQ,
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            reduce_range=not _cpu_flags() & _VNNI_FLAGS,
            nodes_to_exclude=[node.name for node in graph.node if node.op_type == "Conv"][-1:],
        )
    finally:
        logging.disable(disabled_level)
    return quantised_path
