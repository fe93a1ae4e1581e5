"""A dataset that has a split ``test`` and no other, as the set ``unseen``."""

import json

import pytest
from conftest import fpp_bench, printed
from synthetic import make

from fpp_ml_bench import load_dataset
from fpp_ml_bench.constants import VIEWS
from fpp_ml_bench.errors import DatasetError
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.loaders.storage.verification import verify

OBJECTS = ("gear", "v_groove")


@pytest.fixture(scope="module")
def unseen(tmp_path_factory):
    return make(tmp_path_factory.mktemp("unseen") / "dataset", {"test": OBJECTS})


def test_it_is_intact_and_says_what_it_is(unseen):
    assert verify(unseen) == []
    (split,) = json.loads(printed(fpp_bench, "info", unseen, "--json -"))["splits"]
    assert (split["split"], split["objects"], split["samples"]) == ("test", 2, 12)
    assert fpp_bench("info", unseen) == 0
    card = (unseen / "README.md").read_text()
    assert 'split="test"' in card and "train" not in card


def test_it_loads_as_one_split(unseen):
    whole = load_dataset(unseen)
    assert list(whole) == ["test"] and len(whole["test"]) == 12
    assert load_dataset(unseen, split="test")["object"][:: len(VIEWS)] == list(OBJECTS)
    opened = DatasetFolder(unseen)
    assert opened.samples("all") == opened.samples("test")
    with pytest.raises(DatasetError, match=r"no split 'train'; there are test and all"):
        load_dataset(unseen, split="train")
