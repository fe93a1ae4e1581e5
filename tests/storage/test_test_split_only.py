"""A dataset that has a split ``test`` and no other, as the set ``unseen``: from the build to the score."""

import json

import pytest
from conftest import tiny_settings

from fpp_ml_bench import load_dataset
from fpp_ml_bench.cli import main
from fpp_ml_bench.cli import main_eval as evaluate
from fpp_ml_bench.constants import VIEWS
from fpp_ml_bench.errors import DatasetError
from fpp_ml_bench.loaders.render.builder import build
from fpp_ml_bench.loaders.render.light import named_light
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.loaders.storage.verification import verify

OBJECTS = ("gear", "v_groove")


@pytest.fixture(scope="module")
def unseen(tmp_path_factory):
    folder = tmp_path_factory.mktemp("unseen") / "dataset"
    matte = named_light("paper").changed("bounces", interreflection=False, ambient_occlusion=False)
    build(folder, tiny_settings(objects=OBJECTS, light=matte), workers=1)
    return folder


def test_it_is_intact_and_says_what_it_is(unseen, capsys):
    assert verify(unseen) == []
    assert main(["info", str(unseen), "--json", "-"]) == 0
    (split,) = json.loads(capsys.readouterr().out)["splits"]
    assert (split["split"], split["objects"], split["samples"]) == ("test", 2, 12)
    assert main(["info", str(unseen)]) == 0
    assert 'split="test"' in (unseen / "README.md").read_text() and "train" not in (unseen / "README.md").read_text()


def test_it_loads_as_one_split(unseen):
    whole = load_dataset(unseen)
    assert list(whole) == ["test"] and len(whole["test"]) == 12
    assert load_dataset(unseen, "all", split="test")["object"][:: len(VIEWS)] == list(OBJECTS)
    opened = DatasetFolder(unseen)
    assert opened.samples("all") == opened.samples("test")
    with pytest.raises(DatasetError, match=r"no split 'train'; there are test and all"):
        load_dataset(unseen, split="train")


def test_a_method_runs_on_it_and_is_scored(unseen, tmp_path, capsys):
    predictions, result = tmp_path / "predictions", tmp_path / "result.json"
    assert main(["predict", "classical", str(unseen), "--out", str(predictions)]) == 0
    command = [str(predictions), str(unseen), "--target", "depth_exact", "--json", str(result)]
    assert evaluate(command) == 0
    content = json.loads(result.read_text())
    assert len(content["per_sample"]) == 12
    assert main(["predict", "classical", str(unseen), "--split", "train", "--out", str(tmp_path / "none")]) != 0
    assert "no split 'train'" in capsys.readouterr().err
