"""Sets of real captures: those that the package describes, and one that a user describes."""

from hashlib import sha256

import cv2
import numpy as np
import pytest
import yaml
from conftest import fpp_bench, fpp_eval, printed, read_json, refusal
from test_capture_import import RIG, UNIT_CUE, coded_rig, frames_of, write

from fpp_ml_bench.loaders.captures.real import read_set, set_names
from fpp_ml_bench.loaders.storage.store import DatasetFolder


@pytest.mark.parametrize("name", set_names())
def test_the_sets_of_the_package_are_whole(name):
    read = read_set(name)
    assert read.content.licence and read.content.source.startswith("https://")
    digests = [
        digest
        for views in read.content.captures.values()
        for files in views.values()
        for digest in files.values()
    ]
    assert len(set(digests)) == len(digests) and all(len(digest) == 64 for digest in digests)
    assert all(ord(letter) < 128 for letter in read.content.title)


@pytest.fixture
def copied(tmp_path):
    """A copy of somebody's repository, and the YAML file of the set."""
    write(tmp_path / "repo" / "plane", frames_of(RIG, 0))
    files = sorted((tmp_path / "repo" / "plane").iterdir())
    hashes = {f"plane/{file.name}": sha256(file.read_bytes()).hexdigest() for file in files}
    described = {
        "title": "A plane",
        "source": "https://example.com/plane",
        "commit": "0123456",
        "licence": "CC0",
        "known": ["a third of it is dark {so}"],
        "rig": RIG.to_dict(),
        "captures": {"plane": {"front": hashes}},
    }
    (tmp_path / "plane.yaml").write_text(yaml.safe_dump(described, sort_keys=False))
    return tmp_path


def importing(folder, *more):
    line = f"import {folder}/repo --real {folder}/plane.yaml --out {folder}/set --workers 1"
    return fpp_bench(line, *more)


def test_a_real_set_is_a_dataset_whose_undecoded_pixels_count_nowhere(copied):
    said = printed(importing, copied)
    assert "A plane, from https://example.com/plane at commit 0123456; licence: CC0" in said
    assert "known: a third of it is dark {so}" in said and "differ" not in said
    opened = DatasetFolder(copied / "set")
    (sample,) = opened.splits["test"]
    void, depth_mm = opened.void(sample), opened.depth_mm(sample)
    assert (void == (depth_mm == 0)).all() and 0.2 < void.mean() < 0.5
    out, result = copied / "constant", copied / "result.json"
    assert fpp_bench(f"predict constant {copied}/set --at standoff --out {out}") == 0
    assert "without background" in printed(fpp_eval, f"{out} {copied}/set --json {result}")
    error_mm = np.abs(1000 * RIG.standoff_m - depth_mm[~void]).mean()
    metrics = read_json(result)["metrics"]
    assert metrics["two_sided_mae_mm"] == pytest.approx(error_mm, rel=1e-4)
    assert metrics["background_mae_mm"] is None and metrics["invented_share"] == 0
    assert "Real light, plane, " in printed(fpp_bench, "leaderboard", result)


def test_files_of_another_commit_are_named(copied):
    file = copied / "repo" / "plane" / "frame_2.png"
    assert cv2.imwrite(str(file), cv2.imread(str(file), 0), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    said = printed(importing, copied)
    assert "files that differ from those of that commit: plane/frame_2.png" in said


def test_what_is_not_there_is_named(copied):
    (copied / "repo" / "plane" / "frame_3.png").unlink()
    said = refusal(importing, copied)
    assert "found no plane/frame_3.png; get it by git clone https://example.com/plane" in said


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--real nobodys", "--real nobodys: expected one of maximm8-left"),
        ("--rig rig.yaml", "--real: --rig can't be changed"),
        ("--captures", "--real: --captures can't be changed"),
        ("--bits 12", "--real: --bits can't be changed"),
        ("--frame-order paper", "--real: --frame-order can't be changed"),
    ],
)
def test_options_that_a_set_does_not_take(copied, words, said):
    assert said in refusal(importing, copied, words)


def test_a_file_that_describes_no_set(copied):
    described = yaml.safe_load((copied / "plane.yaml").read_text())
    files = described["captures"]["plane"]["front"]
    outside = {f"../{name}": digest for name, digest in files.items()}
    one_frame = coded_rig(order=["vertical"], vertical=UNIT_CUE).to_dict()
    wrong = [
        ({"captures": {}}, "captures: expected an object"),
        ({"captures": {"a/b": {"front": files}}}, "expected an object of letters"),
        ({"captures": {"plane": {"front": outside}}}, "expected a path inside the repository"),
        ({"licence": None}, "licence"),
        ({"rig": {**described["rig"], "camera": {}}}, "rig: camera"),
        ({"rig": one_frame}, "captures.plane.front: expected the"),
    ]
    for change, said in wrong:
        (copied / "plane.yaml").write_text(yaml.safe_dump(described | change, sort_keys=False))
        assert said in refusal(importing, copied)
