"""Importing a dataset of the published layout from a Hub on the loopback interface, through the
real client."""

import hashlib
import shutil
import subprocess
import sys
from collections import namedtuple

import numpy as np
import pytest
from conftest import fpp_bench, printed, refusal
from hub_server import Repo
from huggingface_hub import constants
from huggingface_hub.utils import enable_progress_bars
from published_trees import (
    FOLDERS,
    TRAINING,
    depth_path,
    files_of,
    hub_of,
    imported,
    make_tree,
    write_mat,
)
from published_trees import PUBLISHED as NAME
from publishing import ROOT

import fpp_ml_bench
from fpp_ml_bench.errors import DatasetError
from fpp_ml_bench.loaders.published.exporting import export
from fpp_ml_bench.loaders.storage.store import DatasetFolder

pytestmark = pytest.mark.long

RAW = f"{TRAINING}/{FOLDERS['raw']}"
MAT = f"{RAW}/test/depth/power_drill_A60.mat"


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    """Two variants and the depth ranges."""
    return make_tree(tmp_path_factory.mktemp("published") / "tree", ("raw", "global"), info=True)


@pytest.fixture(scope="module")
def scanned(opened, tmp_path_factory):
    """A tree with raw scans, of a rendered object."""
    folder = tmp_path_factory.mktemp("scanned") / "tree"
    export(opened, folder, ["mat"], ["test"])
    return folder


class Run:
    """``fpp-bench import`` in an empty folder, with a cache of its own."""

    def __init__(self, server, capfd):
        self.server, self.capfd = server, capfd

    def __call__(self, *words):
        """Exit status, standard output and standard error."""
        self.server.requests.clear()
        status = fpp_bench("import", *words, "--workers 1")
        return (status, *self.capfd.readouterr())

    @property
    def downloaded(self):
        """Files that the last run asked for."""
        return {
            path.split("/", 6)[-1]
            for method, path in self.server.requests
            if method == "GET" and "/resolve/" in path
        }


@pytest.fixture
def run(tree, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    with hub_of(tree, tmp_path / "cache", monkeypatch) as server:
        yield Run(server, capfd)


def assert_same_data(dataset, expected):
    assert dataset.content == expected.content and dataset.splits == expected.splits


def test_the_whole_run(run, tree, tmp_path, monkeypatch):
    # The client's progress bars, also where there is no terminal, and after tests of publishing,
    # which turns them off for its process.
    monkeypatch.setenv("TQDM_POSITION", "-1")
    enable_progress_bars()
    commit = run.server.repos["datasets", NAME].commits[-1]
    status, printed_text, error = run(NAME, "--out data/published")
    assert status == 0, error
    first, needed, download, *_ = printed_text.splitlines()
    assert NAME in first and run.server.endpoint in first and commit in first
    assert "training_data_depth_raw" in needed and "72 files" in needed and "kB" in needed
    assert "72 files" in download and str(tmp_path / "cache") in download
    folders = f"{RAW}/", f"{TRAINING}/info_depth_params/"
    assert run.downloaded == {name for name in files_of(tree) if name.startswith(folders)}
    dataset = DatasetFolder("data/published")
    assert_same_data(dataset, imported(tree, tmp_path / "expected"))
    settings = dataset.manifest.settings
    assert settings["repository"] == NAME and settings["commit"] == commit
    assert f"{NAME} at commit {commit}" in printed_text and "Fetching 72 files: 100%" in error
    # Again: nothing is downloaded and nothing is written.
    status, again, _ = run(NAME, "--out data/published")
    assert status == 0 and "to download: 0 files, 0 B" in again and run.downloaded == set()
    # Info and card say where the data is from.
    said = printed(fpp_bench, "info data/published")
    assert f"repository {NAME}, commit {commit}" in said
    card = (dataset.path / "README.md").read_text()
    assert f"https://huggingface.co/datasets/{NAME}" in card and commit in card


def test_a_stopped_download_continues(run, tree, tmp_path):
    run.server.faults.add(MAT)
    status, _, error = run(NAME, "--out out")
    assert status == 2 and "fault (500)" in error and "it continues where it stopped" in error
    assert "Traceback" not in error and not (tmp_path / "out").exists()
    before = run.downloaded - {MAT}
    run.server.halves.add(MAT)  # the connection breaks in the middle of the file
    status, said, error = run(NAME, "--out out")
    assert status == 0, error
    assert MAT in run.downloaded and not before & run.downloaded
    assert f"to download: {72 - len(before)} files" in said
    assert_same_data(DatasetFolder("out"), imported(tree, tmp_path / "expected"))


def test_a_revision_is_a_tag_or_a_commit(run, tree, tmp_path):
    repo = run.server.repos["datasets", NAME]
    older, commit = make_tree(tmp_path / "older"), hashlib.sha1(b"older").hexdigest()
    write_mat(depth_path(older), depthMap=np.full((24, 24), 1800.0))
    repo.tags["v1.0"] = commit, files_of(older)
    expected = imported(older, tmp_path / "expected")
    for revision in ("v1.0", commit):
        status, said, error = run(NAME, f"--out out-{revision} --revision {revision}")
        assert status == 0 and f"at commit {commit} ({revision})" in said, error
        dataset = DatasetFolder(f"out-{revision}")
        assert_same_data(dataset, expected)
        assert dataset.manifest.settings["commit"] == commit
    status, _, error = run(NAME, "--out out-v1.0")  # the main branch, into the same folder
    assert status == 2 and "changed after it; give another folder or delete it" in error


def test_raw_scans_come_where_they_are_asked_for(run, scanned, tmp_path):
    run.server.repos["datasets", NAME] = Repo(files=files_of(scanned))
    frames = {
        name
        for name in files_of(scanned)
        if name.startswith("fpp_synthetic_dataset/") and "/A_" in name
    }
    assert len(frames) == 6 * 52
    status, said, error = run(NAME, "--out single")
    assert status == 0 and f"not needed: images of raw scans, {len(frames)} files" in said, error
    assert not frames & run.downloaded
    assert DatasetFolder("single").configs == ("single_shot",)
    # A part of them in the cache, of an import that was stopped, is no part of the tree for the
    # import without them.
    run.server.faults.add(max(frames))
    assert run(NAME, "--out all --raw-scans")[0] == 2
    assert run.downloaded & frames
    assert run(NAME, "--out single-again")[0] == 0
    for option in ("--raw-scans", "--frame-order paper"):
        status, said, error = run(NAME, "--out all", option)
        assert status == 0 and "frame order of the raw scans: paper" in said, error
    assert not any(name.endswith((".csv", "phase.mat")) for name in run.downloaded)
    assert "all" in DatasetFolder("all").configs


def test_a_folder_of_that_name_is_read_instead(run, tree, tmp_path):
    shutil.copytree(tree, tmp_path / NAME)
    status, said, error = run(NAME, "--out out")
    assert status == 0, error
    assert f"{NAME}: reading this folder, not a dataset of that name" in said
    assert run.server.requests == []
    assert "repository" not in DatasetFolder("out").manifest.settings


REFUSALS = {
    "unknown": ("somebody/nothing", "no such folder here, and no such dataset on http"),
    "private": ("somebody/private", "no such dataset on http"),
    "gated": ("gated/data", "accept the conditions"),
    "no layout": (
        "somebody/else",
        "does not have the published layout; expected training_datasets/ with one of",
    ),
    "parquet": (
        "somebody/parquet",
        'Parquet files, which datasets.load_dataset("somebody/parquet") opens',
    ),
    "no revision": (f"{NAME} --revision v9\x1b", r"has no branch, tag or commit 'v9\\x1b'"),
    "no raw scans": (f"{NAME} --raw-scans", "has no raw scans"),
    "revision of a folder": ("tree --revision v1", "--revision belongs to a dataset of the Hub"),
    "raw scans of a folder": ("tree --raw-scans", "--raw-scans belongs to a dataset of the Hub"),
    "not a name": ("a/b/c", "or OWNER/NAME of a dataset on the Hugging Face Hub"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_refusals(run, tree, tmp_path, case):
    words, message = REFUSALS[case]
    repos = run.server.repos
    repos["datasets", "gated/data"] = Repo(files=files_of(tree))
    repos["datasets", "somebody/private"] = Repo(private=True, files=files_of(tree))
    repos["datasets", "somebody/else"] = Repo(files={"train.csv": b"a,b\n"})
    repos["datasets", "somebody/parquet"] = Repo(
        files={"fpp-bench.json": b"{}", "data/test.parquet": b""}
    )
    (tmp_path / "tree").symlink_to(tree)
    refused(run, words, message)
    assert not (tmp_path / "out").exists()


def refused(run, words, message):
    status, _, error = run(words, "--out out")
    *_, sentence = error.strip().splitlines()
    assert status == 2 and sentence.startswith("fpp-bench import: error: ")
    assert "Traceback" not in error
    assert message.replace("\\", "") in sentence.replace("\\", ""), sentence


def test_offline(run, monkeypatch):
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    refused(run, NAME, "HF_HUB_OFFLINE is set, so nothing may be downloaded; unset it")


def test_a_disk_that_is_too_small(run, monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr("shutil.disk_usage", lambda folder: usage(10**9, 10**9, 10**6))
    refused(
        run, NAME, "the disk has 0.00 GB free, and download and import need about 0.11 GB there"
    )
    assert run.downloaded == set()


def test_opening_a_name_of_the_hub_says_how_to_fetch_it(run):
    name = "somebody/else"
    message = (
        f"{name}: is no dataset folder; to fetch the published dataset: fpp-bench import {name} "
        f"--out data/published"
    )
    for opening in (fpp_ml_bench.load_dataset, fpp_ml_bench.open_dataset):
        with pytest.raises(DatasetError, match=message):
            opening(name)
    for words in (f"info {name}", f"predict classical {name} --out predictions"):
        assert message in refusal(fpp_bench, words)
    assert run.server.requests == []


@pytest.mark.parametrize("name", ["data/mini", "sets/mini", "mini"])
def test_opening_a_folder_that_is_not_there_says_how_to_build_it(run, name, tmp_path):
    (tmp_path / "sets").mkdir()
    with pytest.raises(DatasetError, match="no such folder; build one with: fpp-bench build"):
        fpp_ml_bench.load_dataset(name)


@pytest.mark.processes
def test_help_does_not_wait_for_the_client():
    code = (
        "import sys\nfrom fpp_ml_bench.cli import main\nassert main(['import', '--help']) == 0\n"
        "print({'huggingface_hub', 'datasets'} & set(sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert done.stdout.splitlines()[-1] == "set()"
