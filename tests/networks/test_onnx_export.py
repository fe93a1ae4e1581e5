"""ONNX files against torch, by onnxruntime."""

import importlib.util
from types import SimpleNamespace

import numpy as np
import onnxruntime
import pytest
import torch
from tiny_network import SMALL, one_thread, rounding_error  # noqa: F401

from fpp_ml_bench.baselines.networks.model import INPUT, NETWORKS, OUTPUT, build, export_onnx
from fpp_ml_bench.errors import FppBenchError, NetworkError


def _run(path, fringe: torch.Tensor) -> np.ndarray:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    assert [node.name for node in session.get_inputs()] == [INPUT]
    assert [node.name for node in session.get_outputs()] == [OUTPUT]
    return session.run(None, {INPUT: fringe.numpy()})[0]


@pytest.mark.long
@pytest.mark.parametrize("name", NETWORKS)
def test_onnxruntime_gives_torch_numbers_at_any_batch(name, tmp_path):
    torch.manual_seed(1)
    network = build(name, **SMALL[name])
    network(torch.rand(4, 1, 64, 64))  # running statistics that are not their start values
    path = export_onnx(network, tmp_path / "network.onnx", 64)
    assert network.training  # put back
    network.eval()
    for batch in (1, 3):
        fringe = torch.rand(batch, 1, 64, 64)
        with torch.no_grad():
            expected = network(fringe).numpy()
        tolerance = rounding_error(network, expected)
        assert expected.std() > 10 * tolerance  # else the comparison says nothing
        np.testing.assert_allclose(_run(path, fringe), expected, rtol=0, atol=tolerance)
    assert [file.name for file in tmp_path.iterdir()] == ["network.onnx"]


def test_a_model_that_holds_a_network_and_a_size_that_is_no_square(tmp_path):
    model = SimpleNamespace(network=build("unet", width=2).to(torch.bfloat16).eval())
    path = export_onnx(model, tmp_path / "m.onnx", (32, 48))
    assert model.network.head.weight.dtype is torch.bfloat16 and not model.network.training
    assert _run(path, torch.rand(2, 1, 32, 48)).shape == (2, 1, 32, 48)


def test_refusals(tmp_path, monkeypatch):
    network = build("unet", width=2)
    with pytest.raises(NetworkError, match="multiples of 16"):
        export_onnx(network, tmp_path / "n.onnx", 60)
    with pytest.raises(NetworkError, match="given Linear"):
        export_onnx(torch.nn.Linear(1, 1), tmp_path / "n.onnx", 64)
    with pytest.raises(FppBenchError, match="no folder"):
        export_onnx(network, tmp_path / "absent" / "n.onnx", 64)
    (tmp_path / "folder.onnx").mkdir()
    with pytest.raises(FppBenchError, match="can't write"):
        export_onnx(network, tmp_path / "folder.onnx", 64)
    monkeypatch.setattr(importlib.util, "find_spec", lambda _name: None)
    with pytest.raises(FppBenchError, match=r'pip install "fpp-ml-bench\[onnx\]"'):
        export_onnx(network, tmp_path / "n.onnx", 64)
