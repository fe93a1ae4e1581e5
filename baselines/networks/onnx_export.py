"""Networks as ONNX files, for runtimes without torch."""

import contextlib
import importlib.util
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import nn

from fpp_ml_bench.baselines.networks.base import FringeNetwork
from fpp_ml_bench.errors import FppBenchError, NetworkError

INPUT = "fringe"
OUTPUT = "depth_representation"
OPSET = 17


def export_onnx(model: Any, path: str | Path, size: int | tuple[int, int]) -> Path:
    """Write a network as an ONNX file in float32, and return its path.

    The file takes ``fringe`` float32 (B, 1, H, W) in [0, 1] and gives ``depth_representation`` of the same shape; B is
    free, H and W are ``size`` (one number for a square). ``model``: a `FringeNetwork`, or what holds one as
    ``.network``. Torch's older exporter takes 0.4 to 2 s where the newer takes 6 to 30 s, to the same numbers. Raises
    `FppBenchError` where the onnx package is missing or the file can't be written, and `NetworkError` for something
    that is no network or a size that it does not take."""
    if importlib.util.find_spec("onnx") is None:
        raise FppBenchError('ONNX export needs the onnx package; install it with: pip install "fpp-ml-bench[onnx]"')
    network = model if isinstance(model, FringeNetwork) else getattr(model, "network", None)
    if not isinstance(network, FringeNetwork):
        raise NetworkError(f"expected a network or a model that holds one; it was given {type(model).__name__}")
    height, width = (size, size) if isinstance(size, int) else size
    network.check_size(height, width)
    target = Path(path)
    if not target.parent.is_dir():
        raise FppBenchError(f"can't write {target}: there is no folder {target.parent}; make it first")
    example = torch.zeros(1, 1, height, width, dtype=torch.float32, device=next(network.parameters()).device)
    try:
        # A file that appears under its name only when whole.
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=".onnx-") as folder:
            unfinished = Path(folder) / target.name
            with _exportable(network), warnings.catch_warnings():
                # The size rule is checked once, here, and is meant to be a constant of the file.
                warnings.simplefilter("ignore")
                torch.onnx.export(
                    network,
                    (example,),
                    str(unfinished),
                    dynamo=False,
                    input_names=[INPUT],
                    output_names=[OUTPUT],
                    dynamic_axes={INPUT: {0: "batch"}, OUTPUT: {0: "batch"}},
                    opset_version=OPSET,
                )
            unfinished.replace(target)
    except OSError as error:
        raise FppBenchError(f"can't write {target}: {error.strerror or error}") from error
    return target


@contextlib.contextmanager
def _exportable(network: nn.Module) -> Iterator[None]:
    """Evaluation mode in float32 for a while; the mode and type found are put back."""
    dtype = next(network.parameters()).dtype
    modes = {module: module.training for module in network.modules()}
    network.eval().float()
    try:
        yield
    finally:
        network.to(dtype)
        for module, training in modes.items():
            module.training = training
