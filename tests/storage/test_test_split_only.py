"""A dataset that has a split ``test`` and no other, as the set ``unseen``."""

import json

import pytest
from synthetic import make

from fpp_ml_bench import load_dataset
from fpp_ml_bench.cli import main
from fpp_ml_bench.constants import VIEWS
from fpp_ml_bench.errors import DatasetError
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.loaders.storage.verification import verify

OBJECTS = ("gear", "v_groove")


@pytest.fixture(scope="module")
def unseen(tmp_path_factory):
    return make(tmp_path_factory.mktemp("unseen") / "dataset", {"test": OBJECTS})


def test_it_is_intact_and_says_what_it_is(unseen, capsys):
    assert verify(unseen) == []
    assert main(["info", str(unseen), "--json", "-"]) == 0
    (split,) = json.loads(capsys.readouterr().out)["splits"]
    assert (split["split"], split["objects"], split["samples"]) == ("test", 2, 12)
    assert main(["info", str(unseen)]) == 0
    assert (
        'split="test"' in (unseen / "README.md").read_text()
        and "train" not in (unseen / "README.md").read_text()
    )


def test_it_loads_as_one_split(unseen):
    whole = load_dataset(unseen)
    assert list(whole) == ["test"] and len(whole["test"]) == 12
    assert load_dataset(unseen, split="test")["object"][:: len(VIEWS)] == list(OBJECTS)
    opened = DatasetFolder(unseen)
    assert opened.samples("all") == opened.samples("test")
    with pytest.raises(DatasetError, match=r"no split 'train'; there are test and all"):
        load_dataset(unseen, split="train")
