"""Networks in several precisions: the same network, the same numbers up to the type, and what is missing says so."""

import importlib.util
import subprocess
import sys

import numpy as np
import pytest
from scored_dataset import make_dataset
from tiny_network import config_of, one_thread, tiny_network  # noqa: F401

from fpp_ml_bench.baselines import networks
from fpp_ml_bench.baselines.tradeoff import networks as tradeoff_networks
from fpp_ml_bench.baselines.tradeoff.ladders import package_ladders
from fpp_ml_bench.baselines.tradeoff.measure import Rules, measured
from fpp_ml_bench.baselines.tradeoff.networks import calibration, network_settings
from fpp_ml_bench.baselines.tradeoff.settings import TradeoffSettings, choose_views
from fpp_ml_bench.baselines.training import save_weights
from fpp_ml_bench.leaderboard.page import board_ladder
from fpp_ml_bench.optics import paper_rig

SIZE = (32, 48)
QUICK = Rules(runs=3, limit_s=0.05)


def grey_scene(seed):
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    inside = (rows - 16) ** 2 + (columns - 20) ** 2 < 80
    depth = np.where(inside, 1700 + 4 * columns + seed, 0).astype(np.float32)
    return rng.integers(1, 256, SIZE, dtype=np.uint8), depth


@pytest.fixture(scope="module")
def views(tmp_path_factory):
    return choose_views(make_dataset(tmp_path_factory.mktemp("data") / "grey", SIZE, scene=grey_scene), 1)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """What two trainings left: one puts out metres, one a share of the range."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "cpu" / "weights").mkdir(parents=True)
    for seed, normalisation in enumerate(("global", "individual")):
        network = tiny_network(seed=seed)
        config = config_of(network, normalisation=normalisation, name=f"unet-{normalisation}-rmse")
        save_weights(folder / "cpu" / "weights" / f"{normalisation}.safetensors", network, config)
    return folder


@pytest.fixture(scope="module")
def chosen(views, runs):
    settings = TradeoffSettings(views.opened.path, runs, runs=runs, widths=(4,))
    return {setting.key: setting for setting in network_settings(views, settings)}


def of(chosen, *parts):
    (setting,) = (setting for key, setting in chosen.items() if all(part in key for part in parts))
    return setting


def test_every_network_in_every_precision(chosen):
    names = sorted(key.rsplit("-", 1)[-1] for key in chosen if "global" in key)
    assert names == ["bf16", "fp32", "fp32", "int8"]  # torch and onnxruntime
    assert {s.scored for key, s in chosen.items() if "width" in key} == {False}
    assert all("not trained" in s.note for key, s in chosen.items() if "width" in key)
    assert not any(key for key in chosen if "predicted" in key and "onnx" in key)


def test_precisions_of_one_network_agree_up_to_their_type(chosen, views):
    name = views.names[0]
    depth = {}
    for precision in ("mm-fp32", "mm-bf16", "mm-onnx-fp32", "mm-onnx-int8"):
        method = of(chosen, "unet-global", precision).make()
        assert method.units == "mm" and method.frames_used == (0,) and method.parameters > 1000
        depth[precision] = method.predict(views.frames(method, name)).astype(np.float64)
    span = np.ptp(depth["mm-fp32"])
    away = {key: np.abs(values - depth["mm-fp32"]).max() / span for key, values in depth.items()}
    assert away["mm-onnx-fp32"] < 1e-4 < away["mm-bf16"] < 0.05
    assert 1e-4 < away["mm-onnx-int8"] < 0.3


def test_an_oracle_range_is_told_and_a_range_without_heads_is_refused(chosen, views):
    oracle = measured(of(chosen, "individual", "oracle-fp32"), QUICK)
    assert oracle.given == "depth range" and oracle.object_mae_mm > 0 and oracle.parameters > 1000
    refused = measured(of(chosen, "individual", "predicted-fp32"), QUICK)
    assert "holds no range heads" in refused.failed


def test_calibration_is_of_train_samples(views, chosen):
    method = of(chosen, "unet-global", "mm-fp32").make()
    images = calibration(views, method.frames_used[0])
    train = views.opened.samples("train")
    assert images.shape == (len(train), 1, *SIZE) and images.dtype == np.float32
    np.testing.assert_allclose(images[0, 0] * 255, views.opened.frame(train[0], 0), atol=1e-3)


def test_without_onnxruntime_that_setting_says_so(chosen, monkeypatch):
    real = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "onnxruntime" else real(name, *rest)
    )
    point = measured(of(chosen, "unet-global", "onnx-int8"), QUICK)
    assert "onnxruntime is not installed" in point.failed and "[onnx]" in point.failed
    assert measured(of(chosen, "unet-global", "mm-fp32"), QUICK).failed is None


def test_a_processor_without_bf16_is_named(monkeypatch, tmp_path):
    class Cpu:
        text = ""

        def __init__(self, path):
            assert path == "/proc/cpuinfo"

        def read_text(self, **how):
            return self.text

    monkeypatch.setattr(tradeoff_networks, "Path", Cpu)
    Cpu.text = "flags\t\t: fpu avx2 avx512_vnni"
    assert "no bf16 instructions" in tradeoff_networks.bf16_note()
    Cpu.text = "flags\t\t: fpu avx2 amx_bf16"
    assert tradeoff_networks.bf16_note() is None


def test_every_rung_of_every_ladder_can_be_prepared(tmp_path):
    """The smallest rung is run, and a network takes each of its sizes."""
    ladders = package_ladders(paper_rig(480), more=(board_ladder(),))
    for number, ladder in enumerate(ladders):
        (folder := tmp_path / str(number)).mkdir()
        rung = ladder.prepare(ladder.steps[0], folder)
        result = rung.run()
        if isinstance(result, dict):  # the seconds of its parts
            assert result and all(isinstance(seconds, float) and seconds >= 0 for seconds in result.values())
        assert rung.amount > 0 and list(ladder.steps) == sorted(set(ladder.steps)) and len(ladder.steps) >= 3
    (unet,) = (ladder for ladder in ladders if "UNet" in ladder.stage and ladder.over == "pixels")
    for size in unet.steps:
        networks.build("unet", width=1).check_size(size, size)


def test_torch_is_left_alone_unless_networks_are_measured(views):
    command = ["tradeoff", str(views.opened.path), "--list", "--only", "classical", "--only", "phase"]
    code = (
        f"import sys; from fpp_ml_bench.cli import main; assert main({command!r}) == 0; "
        "assert 'torch' not in sys.modules and 'onnxruntime' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
