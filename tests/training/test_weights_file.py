"""Weights on disk: what goes in comes out to the bit, and nothing else is read."""

import json
import os
import struct

import pytest
import torch
from safetensors.torch import load_file, save_file
from tiny_network import config_of, tiny_network

from fpp_ml_bench.baselines.training import weights as weights_file
from fpp_ml_bench.baselines.training.weights import (
    DEPTH_NETWORKS,
    SHIPPED,
    open_weights,
    read_file,
    save_weights,
    weights_path,
)
from fpp_ml_bench.errors import WeightsError


@pytest.fixture(scope="module")
def network():
    return tiny_network()


@pytest.fixture
def saved(tmp_path, network):
    path = tmp_path / "net.safetensors"
    save_weights(path, network, config_of(network))
    return path


def metadata_of(path):
    with path.open("rb") as file:
        header = json.loads(file.read(struct.unpack("<Q", file.read(8))[0]))
    return header["__metadata__"]


def rewrite(path, metadata=None, tensors=None):
    """The file again, by the safetensors library, with parts of it changed."""
    save_file({**load_file(path), **(tensors or {})}, path, metadata_of(path) | (metadata or {}))
    return path


def config_with(path, **changes):
    """The file's configuration as JSON with ``changes``; a key set to ``...`` is left out."""
    content = {**json.loads(metadata_of(path)["config"]), **changes}
    return json.dumps({key: value for key, value in content.items() if value is not ...})


def refuse(path, words):
    with pytest.raises(WeightsError, match=words):
        open_weights(path)


def test_what_goes_in_comes_out(saved, network):
    file = open_weights(saved)
    config, tensors = file.config, file.network.state_dict()
    assert (
        config == config_of(network)
        and config.image_size == (32, 48)
        and config.recipe["loss"]["alpha"] == 0.7
    )
    assert tensors.keys() == network.state_dict().keys()
    for name, tensor in network.state_dict().items():
        assert torch.equal(tensors[name], tensor) and tensors[name].dtype == tensor.dtype
    # Anyone's safetensors reads it, and finds the configuration as plain JSON.
    assert set(load_file(saved)) == set(network.state_dict())


def test_range_heads_of_older_files_are_ignored(saved, network):
    rewrite(saved, tensors={"range_head.mean_range_mm": torch.tensor([1700.0, float("nan")])})
    assert open_weights(saved).network.state_dict().keys() == network.state_dict().keys()


def test_same_content_same_bytes(saved, network, tmp_path):
    for number in range(4):
        again = tmp_path / f"again{number}.safetensors"
        save_weights(again, network, config_of(network))
        assert again.read_bytes() == saved.read_bytes()
    assert int.from_bytes(saved.read_bytes()[:8], "little") % 8 == 0


def test_training_layouts_are_saved_plainly(saved, tmp_path):
    network = tiny_network().to(memory_format=torch.channels_last).train()
    path = tmp_path / "channels-last.safetensors"
    save_weights(path, network, config_of(network))
    assert path.read_bytes() == saved.read_bytes()


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"colour": "blue"}, "colour: is not a key of this file"),
        ({"normalisation": ...}, "normalisation: is missing"),
        ({"normalisation": "log"}, "normalisation.*'individual'"),
        ({"image_size": [32]}, "image_size"),
        ({"epoch": -1}, "epoch"),
        ({"image_size": [32, 40]}, "makes no network.*multiples of 16.*given 32x40"),
        ({"data_config": "few"}, "unknown data_config 'few'; there are single_shot"),
        ({"dataset_fingerprint": "abc"}, "dataset_fingerprint"),
        ({"network": "vnet"}, "makes no network.*unet"),
        ({"options": {"width": 5}}, r"tensor \S+: expected float32 \(5, .*, got float32 \(4, "),
    ],
)
def test_configurations_that_do_not_fit(saved, changes, words):
    rewrite(saved, {"config": config_with(saved, **changes)})
    refuse(saved, f"(?s)net.safetensors: .*{words}")


def test_foreign_metadata(saved):
    for metadata, words in (
        ({"format": "pt"}, "expected weights of fpp-ml-bench, got format 'pt'"),
        ({"format": "fpp-ml-bench", "version": "2"}, "expected version 1, got '2'"),
        ({"version": "1", "config": "{"}, "its configuration is not valid"),
    ):
        refuse(rewrite(saved, metadata), words)


def test_tensors_that_do_not_fit(saved, network, tmp_path):
    name = next(iter(network.state_dict()))
    with pytest.raises(WeightsError, match="tensor extra is none of unet with"):
        open_weights(rewrite(saved, tensors={"extra": torch.zeros(1)}))
    tensors = load_file(saved)
    del tensors["extra"]
    for broken, words in (
        ({**tensors, name: tensors[name].half()}, "expected float32 .*got float16"),
        (
            {**tensors, name: tensors[name] * float("nan")},
            f"tensor {name} holds values that are not finite",
        ),
        (
            {key: value for key, value in tensors.items() if key != name},
            f"tensor {name} is missing",
        ),
    ):
        path = tmp_path / "broken.safetensors"
        save_file(
            broken, path, {"format": "fpp-ml-bench", "version": "1", "config": config_with(saved)}
        )
        refuse(path, words)


def test_damage_at_every_place(saved):
    data = saved.read_bytes()
    for cut in (0, 7, 9, len(data) // 2, len(data) - 1):
        saved.write_bytes(data[:cut])
        refuse(saved, r"net\.safetensors: damaged")
    for foreign in (
        b"version https://git-lfs.github.com/spec/v1\n",
        data + b"\0",
        b"\x02" + bytes(7) + b"{}",
    ):
        saved.write_bytes(foreign)
        refuse(saved, r"net\.safetensors: (damaged|expected weights of)")


@pytest.mark.parametrize("zipped", [True, False])
def test_a_pickle_is_never_opened(tmp_path, network, zipped):
    class Trap:
        def __reduce__(self):
            return (pytest.fail, ("the pickle was opened",))

    path = tmp_path / "net.pth"
    torch.save(
        {"model": network.state_dict(), "trap": Trap()}, path, _use_new_zipfile_serialization=zipped
    )
    refuse(path, r"got a PyTorch pickle.*never opened")


def test_nothing_is_written_that_could_not_be_read(tmp_path, network):
    diverged = tiny_network()
    with torch.no_grad():
        next(diverged.parameters()).fill_(float("inf"))
    good = config_of(network)
    for net, config, path, words in (
        (diverged, good, "a.safetensors", "not finite"),
        (network, config_of(network, options={"width": 8}), "a.safetensors", "expected float32"),
        (network, good, "a.pt", "expected a name that ends in .safetensors"),
        (network, good, "no/such/folder/a.safetensors", "can't be written"),
    ):
        with pytest.raises(WeightsError, match=words):
            save_weights(tmp_path / path, net, config)
    assert not any(tmp_path.iterdir())


def test_an_old_file_survives_a_failed_write(saved, network, monkeypatch):
    from fpp_ml_bench import files

    before = saved.read_bytes()

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(WeightsError, match="No space left"):
        save_weights(saved, network, config_of(network, epoch=3))
    assert saved.read_bytes() == before and [p.name for p in saved.parent.iterdir()] == [saved.name]


def test_names_and_paths(saved, monkeypatch, tmp_path):
    monkeypatch.setattr(weights_file, "SHIPPED", saved.parent)
    assert (
        weights_path("net") == saved
        and weights_path(saved) == saved
        and weights_path(str(saved)) == saved
    )
    assert weights_path("elsewhere.safetensors").name == "elsewhere.safetensors"
    with pytest.raises(WeightsError, match=r"no weights called 'nett'.*did you mean 'net'"):
        weights_path("nett")
    with pytest.raises(WeightsError, match="'quite-another' come with this package; there are net"):
        weights_path("quite-another")
    for path, words in (
        (tmp_path, "found a folder"),
        (tmp_path / "no.safetensors", "found nothing"),
    ):
        refuse(path, words)


@pytest.mark.parametrize(
    "options, said",
    [
        ({"levels": 1_000_000}, "levels must be a whole number, 2 to 4096; it was 1000000"),
        ({"levels": 3_000}, "more than twice as many parameters as the file has tensors"),
        ({"width": 10**30}, "width must be a whole number, 1 to 4096"),
        ({"width": int("9" * 2000)}, "a number of more than 1000 digits"),
    ],
    ids=["levels", "fewer levels", "width", "digits"],
)
def test_a_network_without_end_is_refused_before_it_is_built(tmp_path, options, said):
    file = SHIPPED / "pix2pix_unet-individual-gan_0.7.safetensors"
    path = tmp_path / "giant.safetensors"
    path.write_bytes(file.read_bytes())
    config = config_with(path, options=options)
    refuse(rewrite(path, {"config": config}), said)


def test_a_header_that_does_not_fit_the_file_is_refused_before_the_file_is_read(saved, tmp_path):
    data = saved.read_bytes()
    files = {
        "sparse": (data, "its header tells of .* bytes, it has 3000000000"),
        "endless": (
            (1 << 62).to_bytes(8, "little") + data[8:],
            "a header of 4611686018427387904 bytes, found",
        ),
        "deep": (
            (2 << 16).to_bytes(8, "little") + b'{"a":' + b"[" * (2 << 16),
            "nested too deeply",
        ),
    }
    for name, (content, said) in files.items():
        path = tmp_path / f"{name}.safetensors"
        path.write_bytes(content)
        if name == "sparse":
            os.truncate(path, 3_000_000_000)
        with pytest.raises(WeightsError, match=f"{path}: damaged or no .safetensors file .*{said}"):
            read_file(path, DEPTH_NETWORKS)
