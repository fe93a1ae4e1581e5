"""Methods in model repositories of a Hub on the loopback interface: published by the command, used
by ``load_method`` and ``predict`` in processes of their own."""

import json
import subprocess
import sys

import numpy as np
import pytest
import yaml
from hub_server import Repo
from publishing import listed, running_hub
from scored_dataset import make_dataset

from fpp_ml_bench.api import load_method
from fpp_ml_bench.baselines.from_hub import MethodEntry
from fpp_ml_bench.optics.named_rigs import paper_rig

pytestmark = pytest.mark.long

SIZE = 224
FRAMES = [np.random.default_rng(0).integers(0, 256, (SIZE, SIZE), np.uint8)] * 52
CODE = """
import numpy as np
from fpp_ml_bench import Method
import helper


class Flat(Method):
    name, title, frames_used = "flat", "Flat", (0,)

    def predict(self, frames):
        return np.full(frames[0].shape, helper.DEPTH_MM, np.float32)
"""
LOAD = """
import sys, json
import numpy as np
from fpp_ml_bench.baselines.registry import load_method
from fpp_ml_bench.errors import FppBenchError
from fpp_ml_bench.optics.named_rigs import paper_rig
address, trust, out = sys.argv[1:4]
SIZE = 224
try:
    method = load_method(address, paper_rig(SIZE), trust=trust == "trust", **json.loads(sys.argv[4]))
except FppBenchError as error:
    sys.exit(f"{type(error).__name__}: {error}")
frames = [np.random.default_rng(0).integers(0, 256, (SIZE, SIZE), np.uint8) for _ in range(52)]
np.savez(out, depth=method.predict(frames), repository=method.settings["repository"])
"""

MAIN = "import sys; from fpp_ml_bench.cli import main; sys.exit(main(sys.argv[1:]))"


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    with running_hub(tmp_path_factory.mktemp("hub") / "home") as client:
        yield client


def run(client, code, *words):
    command = [sys.executable, "-c", code, *map(str, words)]
    return subprocess.run(
        command, env=client.environment(), capture_output=True, text=True, timeout=120
    )


def loaded(client, address, out, trust="", options=None):
    return run(client, LOAD, address, trust, out, json.dumps(options or {}))


def depth_of(client, address, tmp_path, trust="", options=None):
    ended = loaded(client, address, tmp_path / "out.npz", trust, options)
    assert ended.returncode == 0, ended.stderr
    with np.load(tmp_path / "out.npz") as read:
        assert str(read["repository"]).startswith(address.partition("@")[0] + "@")
        return read["depth"]


def test_weights_are_published_and_used_from_there(client, tmp_path):
    said = client.good(["method", "unet-raw-rmse", "--repo", "alice/unet"])
    assert list(listed(said)) == ["README.md", "config.json", "fpp-bench.json", "model.safetensors"]
    config = json.loads(client.server.repos["models", "alice/unet"].files["config.json"])
    assert config["network"] == "unet" and config["fpp_ml_bench"] == {}
    here = load_method("unet-raw-rmse", paper_rig(SIZE)).predict(FRAMES)
    assert np.array_equal(depth_of(client, "hf://alice/unet", tmp_path), here)
    commit = client.server.repos["models", "alice/unet"].commits[-1]
    commit = commit if isinstance(commit, str) else commit[0]
    assert np.array_equal(depth_of(client, f"hf://alice/unet@{commit}", tmp_path), here)
    assert "Nothing to send" in client.good(["method", "unet-raw-rmse", "--repo", "alice/unet"])


def test_code_runs_only_where_it_is_trusted(client, tmp_path):
    (tmp_path / "mine.py").write_text(CODE)
    (tmp_path / "helper.py").write_text("DEPTH_MM = 1234.0\n")
    client.good(["method", f"{tmp_path / 'mine.py'}:Flat", "--repo", "alice/flat"])
    refused = loaded(client, "hf://alice/flat", tmp_path / "out.npz")
    assert refused.returncode == 1 and "PredictionError" in refused.stderr
    assert "mine.py:Flat, which would run" in refused.stderr and "--trust" in refused.stderr
    assert (depth_of(client, "hf://alice/flat", tmp_path, "trust") == 1234).all()


def test_a_method_of_this_package_with_its_options(client, tmp_path):
    client.server.repos["models", "alice/three"] = Repo(
        files={"config.json": b'{"fpp_ml_bench": {"method": "classical", "options": {"steps": 3}}}'}
    )
    here = load_method("classical", paper_rig(SIZE), steps=3).predict(FRAMES)
    assert np.array_equal(depth_of(client, "hf://alice/three", tmp_path), here)
    other = load_method("classical", paper_rig(SIZE), steps=4).predict(FRAMES)
    assert np.array_equal(
        depth_of(client, "hf://alice/three", tmp_path, options={"steps": 4}), other
    )


@pytest.mark.parametrize(
    ("address", "files", "said"),
    [
        ("hf://alice", {}, "expected hf://OWNER/NAME"),
        ("hf://alice/none", {}, "no such model"),
        ("hf://alice/empty", {"README.md": b"x"}, "holds no method"),
        ("hf://alice/bad", {"config.json": b"{"}, "config.json"),
        ("hf://alice/key", {"config.json": b'{"fpp_ml_bench": {"x": 1}}'}, "x"),
        (
            "hf://alice/path",
            {
                "config.json": b'{"fpp_ml_bench": {"method": "fringe-net", '
                b'"options": {"weights": "/etc/passwd"}}}'
            },
            "names its file of weights beside",
        ),
        ("hf://alice/torn", {"model.safetensors": b"no weights"}, "model.safetensors"),
    ],
)
def test_what_is_no_method_is_a_message(client, tmp_path, address, files, said):
    if files:
        client.server.repos["models", address.removeprefix("hf://")] = Repo(files=files)
    ended = loaded(client, address, tmp_path / "out.npz")
    assert ended.returncode == 1 and said in ended.stderr and "Traceback" not in ended.stderr


def test_predict_takes_an_address_and_its_options(client, tmp_path):
    dataset = make_dataset(tmp_path / "dataset", size=(SIZE, SIZE))
    words = ["predict", "hf://alice/flat", dataset.path, "--out", tmp_path / "out"]
    refused, done = (run(client, MAIN, *words, *more) for more in ((), ("--trust",)))
    assert refused.returncode == 2 and "--trust" in refused.stderr
    assert done.returncode == 0, done.stderr
    described = yaml.safe_load((tmp_path / "out" / "submission.yaml").read_text())
    assert described["settings"]["repository"].startswith("hf://alice/flat@")


def test_an_entry_names_a_file_of_weights_and_no_path():
    with pytest.raises(ValueError, match="pattern"):
        MethodEntry(weights="../weights.safetensors")
