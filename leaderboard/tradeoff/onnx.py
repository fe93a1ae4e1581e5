"""Networks in onnxruntime: in float32, and in int8 by static quantisation calibrated on train samples.

Weights (8 bit, a scale for each channel) and activations (8 bit, a scale for each tensor, from the calibration images)
are quantised. The last convolution stays in float32: an 8-bit step of its metre-scale output would be 8 mm. On a
processor without VNNI weights are quantised to 7 bit, because sums of products would overflow 16 bits (onnxruntime's
own advice). Needs the optional packages of ``pip install "fpp-ml-bench[onnx]"``.
"""

import importlib.util
import logging
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.method import Method
from fpp_ml_bench.baselines.networks import FringeNetwork
from fpp_ml_bench.depth import denormalise
from fpp_ml_bench.errors import FppBenchError, PredictionError
from fpp_ml_bench.leaderboard.tradeoff.views import Frames
from fpp_ml_bench.loaders.training import unit_range

_VNNI_FLAGS = ("avx512_vnni", "avx_vnni", "asimddp")


class OnnxMethod(Method):
    """The network of the method ``like`` in onnxruntime, with the input and the description of ``like``. ``quantised``:
    in int8, calibrated on ``examples`` float32 (n, 1, H, W).

    Raises `FppBenchError` where onnx or onnxruntime is not installed.
    """

    def __init__(
        self, network: FringeNetwork, like: Method, examples: NDArray[np.float32], threads: int, quantised: bool
    ) -> None:
        for package in ("onnx", "onnxruntime"):
            if importlib.util.find_spec(package) is None:
                raise FppBenchError(f'{package} is not installed: pip install "fpp-ml-bench[onnx]"')
        self._like, self.parameters = like, sum(parameter.numel() for parameter in network.parameters())
        self.frames_used = like.frames_used
        self.uses_ground_truth_range = like.uses_ground_truth_range
        self.uses_ground_truth_mask = like.uses_ground_truth_mask
        self.units, self.mode, self.settings = like.units, like.mode, like.settings
        self.name = like.name
        self.title = f"{like.title}, onnxruntime {'int8' if quantised else 'fp32'}"
        self._session = _session(network, examples, threads, quantised)

    def predict(self, frames: Frames) -> NDArray[np.float32]:
        """Depth float32 (H, W) in `units`."""
        image = frames[self.frames_used[0]]
        if image is None:
            raise PredictionError(f"frame {self.frames_used[0]} was not captured")
        fringe = np.empty((1, 1, *image.shape), np.float32)
        unit_range(np.ascontiguousarray(image), fringe[0, 0])
        values: NDArray[np.float32] = self._session.run(None, {self._session.get_inputs()[0].name: fringe})[0][0, 0]
        if not np.isfinite(values).all():
            raise PredictionError(f"{self.title}: gave values that are not finite")
        if self.units != "mm":
            return values
        normalisation = str(self._like.settings["normalisation"])
        return denormalise(values, normalisation, 0.0, 0.0).astype(np.float32)  # type: ignore[arg-type]


def _session(network: FringeNetwork, examples: NDArray[np.float32], threads: int, quantised: bool) -> Any:
    import onnxruntime

    from fpp_ml_bench.baselines.networks import export_onnx

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.log_severity_level = 3
    with tempfile.TemporaryDirectory(prefix="fpp-bench-onnx-") as folder:
        path = export_onnx(network, Path(folder) / "network.onnx", examples.shape[2:])  # type: ignore[arg-type]
        if quantised:
            path = _quantised(path, examples)
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def _quantised(path: Path, examples: NDArray[np.float32]) -> Path:
    """A quantised copy beside the file ``path``."""
    import onnx
    from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
    from onnxruntime.quantization.shape_inference import quant_pre_process

    class Examples(CalibrationDataReader):
        def __init__(self) -> None:
            self._left: Iterator[NDArray[np.float32]] = iter(examples)

        def get_next(self) -> dict[str, NDArray[np.float32]] | None:
            example = next(self._left, None)
            return None if example is None else {name: example[None]}

    prepared, quantised_path = path.with_name("prepared.onnx"), path.with_name("int8.onnx")
    with _quiet():
        quant_pre_process(str(path), str(prepared))
        graph = onnx.load(str(prepared)).graph
        name = graph.input[0].name
        last = [node.name for node in graph.node if node.op_type == "Conv"][-1:]
        quantize_static(
            str(prepared), str(quantised_path), Examples(), quant_format=QuantFormat.QDQ, per_channel=True,
            activation_type=QuantType.QUInt8, weight_type=QuantType.QInt8, reduce_range=not _has_vnni(),
            nodes_to_exclude=last,
        )  # fmt: skip
    return quantised_path


def _has_vnni() -> bool:
    try:
        flags = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").split()
    except OSError:
        return False
    return bool(set(flags).intersection(_VNNI_FLAGS))


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the quantiser's messages on the root logger."""
    disabled_level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(disabled_level)
