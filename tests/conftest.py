"""Shared by all tests: separate Hugging Face caches, and a tiny real dataset that is built once."""

import json
import os
import shutil
import tempfile
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

import pytest
from fake_ray import fake_ray  # noqa: F401  a fixture

# Before `datasets` is imported: it gets caches for this run only, and must not use the network.
_CACHE = tempfile.TemporaryDirectory(prefix="fpp-bench-tests-")
os.environ["HF_HOME"] = _CACHE.name
os.environ["HF_DATASETS_CACHE"] = str(Path(_CACHE.name) / "datasets")
os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ["HF_HUB_DISABLE_TELEMETRY"] = "1"
# pytest-xdist's workers have their own terminal width, and share the cores: one torch thread each.
os.environ.pop("COLUMNS", None)
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")

TINY_SIZE = 176
"""The smallest size at pitch 18 is about 170 px."""
TINY_OBJECTS = ("bowl", "cork", "mug", "power_drill")
"""Two objects of the training split, so that a shard holds two, and one object of each other
split."""
TINY_CONFIGS = ("single_shot", "first_frames", "horizontal", "vertical", "sinusoidal", "all")
"""Configurations of the paper's sequence: all but crossed."""


def tiny_settings(**changes):
    """Settings of the tiny dataset, with ``changes``."""
    from fpp_ml_bench.loaders.render.scene import BuildSettings
    from fpp_ml_bench.optics.named_rigs import paper_rig

    return BuildSettings(**{"rig": paper_rig(TINY_SIZE), "objects": TINY_OBJECTS, **changes})


def file_bytes(folder):
    """Content of all files below a folder, by relative path."""
    folder = Path(folder)
    return {
        str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()
    }


@pytest.fixture(scope="session")
def tiny(tmp_path_factory):
    """Folder of the tiny dataset, all 52 frames. Shared by all tests: copy it before changing
    it."""
    from fpp_ml_bench.loaders.render.builder import build

    folder = tmp_path_factory.mktemp("tiny") / "dataset"
    build(folder, tiny_settings(), workers=1)
    return folder


@pytest.fixture
def copied(tiny, tmp_path):
    """A copy of the tiny dataset, to be changed."""
    return Path(shutil.copytree(tiny, tmp_path / "copy"))


@pytest.fixture(scope="session")
def opened(tiny):
    """The tiny dataset, opened for reading."""
    from fpp_ml_bench.loaders.storage.store import DatasetFolder

    return DatasetFolder(tiny)


@pytest.fixture(scope="session")
def dataset(tmp_path_factory):
    """Eight samples of disks, with exact depth: what is scored. Shared by all tests: copy it before
    changing it."""
    from scored_dataset import make_dataset

    return make_dataset(tmp_path_factory.mktemp("scored") / "tiny")


@pytest.fixture(scope="session")
def files(tmp_path_factory, dataset):
    """Result files of `some_rows`."""
    from board_rows import some_rows

    return some_rows(tmp_path_factory.mktemp("rows"), dataset)


@pytest.fixture(scope="session")
def base(tmp_path_factory, dataset):
    """An entry of the leaderboard, of which tests make rows with other errors."""
    from board_rows import write_result_file

    from fpp_ml_bench.leaderboard.rows import read_entry

    return read_entry(
        write_result_file(tmp_path_factory.mktemp("base") / "base.json", dataset, 1.0)
    )


@pytest.fixture
def predictions(tmp_path, dataset):
    """Predictions of the test split of `dataset`, without an error."""
    from scored_dataset import write_predictions

    return write_predictions(tmp_path / "predictions", dataset)


def split(words):
    """The words of a command: a text may hold several, or a whole line; a path is one, spaces and
    all."""
    parts = [word.split() if isinstance(word, str) else [str(word)] for word in words]
    return [word for part in parts for word in part]


def fpp_bench(*words):
    """Exit status of ``fpp-bench`` with these words, as `split`."""
    from fpp_ml_bench.cli import main

    return main(split(words))


def fpp_eval(*words):
    """Exit status of ``fpp-eval``, as `fpp_bench`."""
    from fpp_ml_bench.cli import main_eval

    return main_eval(split(words))


def printed(command, *words):
    """What a ``command`` prints that does its work."""
    with redirect_stdout(StringIO()) as out:
        assert command(*words) == 0
    return out.getvalue()


def refusal(command, *words):
    """What a ``command`` says that refuses its arguments, in words and not by a traceback."""
    with redirect_stderr(StringIO()) as err:
        assert command(*words) == 2
    assert "Traceback" not in err.getvalue()
    return err.getvalue()


def read_json(path):
    return json.loads(path.read_text())


def read_image(path):
    """Pixels of an image file as they are stored."""
    import cv2

    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def flip(path, share=0.5):
    """Change a bit of a file, at this share of its length."""
    content = bytearray(path.read_bytes())
    content[int(len(content) * share)] ^= 0x10
    path.write_bytes(content)
