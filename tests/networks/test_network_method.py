"""Trained networks on the command line and on the board: tracks, units, masks, and what is
refused."""

from html import unescape

import numpy as np
import pytest
import torch
import yaml
from board_rows import write_result_file
from conftest import fpp_bench, fpp_eval, printed, refusal
from scored_dataset import make_dataset, noise_scene
from tiny_network import config_of, one_thread, rounding_error, tiny_network  # noqa: F401

from fpp_ml_bench.baselines.networks.model import fringe_batch, load
from fpp_ml_bench.baselines.networks.network_method import NetworkMethod
from fpp_ml_bench.baselines.run import captured_frames, predict_split
from fpp_ml_bench.baselines.training.weights import save_weights
from fpp_ml_bench.errors import DatasetError, PredictionError, PublishError
from fpp_ml_bench.evaluation.result.file import read_result
from fpp_ml_bench.evaluation.submission.description import read_submission
from fpp_ml_bench.leaderboard.publish import task_of
from fpp_ml_bench.leaderboard.ranking import rank, read_entries
from fpp_ml_bench.loaders.training import FringeDepthDataset

SIZE = (32, 48)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "small"
    return make_dataset(folder, SIZE, scene=noise_scene(SIZE))


@pytest.fixture(scope="module")
def weights(tmp_path_factory, dataset):
    """Folder of weights of each normalisation, and of two with the background removed."""
    folder = tmp_path_factory.mktemp("weights")
    network = tiny_network(width=2)
    network.head.weight.data.mul_(0.1)  # keeps what it says within what normalised depth can be
    network.head.bias.data.fill_(0.3)
    for name, normalisation, removed in (
        ("raw", "raw", False),
        ("global", "global", False),
        ("full", "individual", False),
        ("removed", "individual", True),
        ("global-removed", "global", True),
    ):
        config = config_of(
            network,
            name=f"unet-{name}",
            title=f"UNet {name}",
            normalisation=normalisation,
            background_removed=removed,
            image_size=SIZE,
            dataset_fingerprint=dataset.fingerprint,
        )
        save_weights(folder / f"{name}.safetensors", network, config)
    return folder


def method(weights, name, *args, **options):
    return NetworkMethod(load(weights / f"{name}.safetensors", "cpu"), *args, **options)


@pytest.mark.parametrize(
    "name, units, track, mode, title",
    [
        ("raw", "mm", "metric", "standard", "UNet raw"),
        ("global", "mm", "metric", "standard", "UNet global"),
        ("full", "normalised", "oracle range", "paper", "UNet full, oracle range"),
        ("removed", "normalised", "oracle range + mask", "paper", "UNet removed, oracle range"),
        ("global-removed", "mm", "oracle mask", "standard", "UNet global-removed"),
    ],
)
def test_what_a_submission_says(dataset, weights, tmp_path, name, units, track, mode, title):
    network_method = method(weights, name)
    predict_split(dataset, network_method, "test", tmp_path / "p")
    about = read_submission(tmp_path / "p")
    assert (about.units, about.track, network_method.mode, about.name) == (
        units,
        track,
        mode,
        title,
    )
    assert (
        about.method == f"unet-{name}"
        and about.frames_used == [0]
        and about.seeds == {"training": 42}
    )
    assert {"torch", "numpy", "fpp_ml_bench"} <= set(
        about.software
    ) and "numba" not in about.software
    settings = about.settings
    trained = {
        "network": "unet",
        "width": 2,
        "loss": "hybrid_l1_0.7",
        "preset": "small",
        "seed": 42,
        "epochs": 2,
    }
    trained["normalisation"] = network_method.model.config.normalisation
    assert trained.items() <= settings.items() and len(settings["weights_sha256"]) == 64
    assert settings.get("depth_range") == ("oracle" if units == "normalised" else None)
    written = yaml.safe_load((tmp_path / "p" / "submission.yaml").read_text())
    assert ("uses_ground_truth_mask" in written) == ("removed" in name)
    sample = dataset.samples("test")[0]
    fringe = captured_frames(dataset, network_method, sample)[0]
    np.testing.assert_array_equal(
        np.load(tmp_path / "p" / f"{sample}.npy"), network_method.model.predict(fringe)
    )


def test_frames_with_the_background_removed_are_those_of_training(dataset, weights):
    network_method = method(weights, "removed")
    trained = FringeDepthDataset(dataset.path, "test", background_removed=True)
    for row, sample in enumerate(trained.samples):
        frame = captured_frames(dataset, network_method, sample)[0]
        assert torch.equal(fringe_batch([frame], SIZE, "x")[0], trained[row].fringe)
        depth = dataset.depth_mm(sample)
        assert frame[depth > 0].all() and not frame[depth == 0].any()
        assert captured_frames(dataset, method(weights, "full"), sample)[0].all()


def test_frames_that_there_are_not(dataset, weights):
    for frame in (52, -1):
        with pytest.raises(PredictionError, match="expected 0 to 51"):
            method(weights, "raw", frame=frame)
    of_frame_7 = method(weights, "raw", frame=7)
    assert of_frame_7.frames_used == (7,) and of_frame_7.title == "UNet raw, frame 7"
    with pytest.raises(DatasetError, match="frame 7 is not stored here"):
        captured_frames(dataset, of_frame_7, dataset.samples("test")[0])
    with pytest.raises(PredictionError, match="needs frame 7"):
        of_frame_7.predict([None] * 52)


def test_the_frame_is_the_first_it_was_trained_on(tmp_path):
    network = tiny_network(width=2)
    config = config_of(network, normalisation="raw", data_config="vertical", image_size=SIZE)
    save_weights(tmp_path / "v.safetensors", network, config)
    assert (
        method(tmp_path, "v").frames_used == (18,) and method(tmp_path, "v").title == config.title
    )


# ---- commands


@pytest.mark.long
def test_predict_score_and_time_on_the_command_line(dataset, weights, tmp_path, capsys):
    out, data = str(tmp_path / "p"), str(dataset.path)
    for name, words in (("full", " --mode paper --json"), ("global", "p-global --json")):
        path = str(weights / f"{name}.safetensors")
        output = printed(fpp_bench, "predict", path, data, "--out", f"{out}-{name}").splitlines()[
            -1
        ]
        assert words in output and "depth_exact" not in output
        line = output.removeprefix("next: fpp-eval ").split()
        line[-1] = result = str(tmp_path / f"{name}.json")
        assert fpp_eval(*line) == 0
        capsys.readouterr()
        timed = ["time", path, data, "--repeats", "2", "--into", result]
        assert "parameters" in printed(fpp_bench, *timed)
        timing = read_result(tmp_path / f"{name}.json").timing
        assert (
            timing.batched
            and timing.parameters > 1000
            and timing.frames == 1
            and timing.device == "cpu"
        )
        assert "torch" in timing.software
    assert "settings.threads is" in refusal(fpp_bench, *timed, "--threads", "2")


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["{w}/raw.safetensors", "--steps", "4"], "--steps is an option of classical, not of"),
        (
            ["classical", "--device", "cpu"],
            "--device is an option of trained networks, not of classical",
        ),
        (["{w}/raw.safetensors", "--threads", "0"], "--threads 0: expected 1 or more"),
    ],
)
def test_refusals_on_the_command_line(dataset, weights, tmp_path, arguments, words):
    first, *rest = (part.format(w=weights) for part in arguments)
    command = ["predict", first, dataset.path, *rest, "--out", tmp_path / "p"]
    assert words in refusal(fpp_bench, *command)
    assert not (tmp_path / "p" / "submission.yaml").exists()


def test_a_dataset_of_another_size(weights, tmp_path):
    larger = make_dataset(tmp_path / "other", (48, 48))
    words = ["predict", weights / "raw.safetensors", larger.path, "--out", tmp_path / "p"]
    message = refusal(fpp_bench, *words)
    assert "trained at 32x48 px (H x W)" in message and "images of 48x48 px" in message


# ---- tracks


def test_a_given_mask_is_never_ranked_with_honest_rows(dataset, tmp_path):
    paths = []
    for name, given in (
        ("honest", []),
        ("mask", ["mask"]),
        ("both", ["range", "mask"]),
    ):
        about = {f"uses_ground_truth_{key}": True for key in given}
        path = write_result_file(tmp_path / f"{name}.json", dataset, 1.0, name=name, **about)
        assert fpp_eval("verify", path, tmp_path / f"{name}-predictions", dataset.path) == 0
        paths.append(path)
    groups = rank(read_entries(paths))
    assert [group.key.track for group in groups] == ["metric", "oracle mask", "oracle range + mask"]
    assert all(len(group.rows) == 1 for group in groups)
    assert fpp_bench("leaderboard", *paths, "--page", tmp_path / "page") == 0
    page = unescape((tmp_path / "page" / "index.html").read_text())
    assert (
        "oracle mask track" in page
        and "given the test sample's depth range and object mask" in page
    )
    with pytest.raises(PublishError, match="no task for the oracle mask track"):
        task_of(groups[1].rows[0].entry.row, "masked.json")
