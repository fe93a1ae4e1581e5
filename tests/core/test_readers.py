"""Every file from outside has one reader: what is mutated, hostile or no file at all ends in an
error that names it."""

import json
import os
import re
import shutil
import socket
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from conftest import fpp_bench, refusal
from mutations import ODD, sealed_manifest, sources, tree_outcome
from published_trees import make_tree
from scored_dataset import change_json
from synthetic import assembly, make

from fpp_ml_bench.baselines.run import UNFINISHED_FILE, UnfinishedRun
from fpp_ml_bench.baselines.training import weights as weights_files
from fpp_ml_bench.baselines.training.weights import DEPTH_NETWORKS
from fpp_ml_bench.errors import (
    DatasetError,
    FppBenchError,
    LayoutError,
    RemoteError,
    RigError,
    SubmissionError,
)
from fpp_ml_bench.evaluation.result.file import read_result
from fpp_ml_bench.files import (
    DEEPEST,
    MOST_NODES,
    MOST_VALUES,
    path_problem,
    read_json,
    strict_json,
    strict_yaml,
)
from fpp_ml_bench.loaders.captures.decoding import read_mask
from fpp_ml_bench.loaders.published.importing import plan_import
from fpp_ml_bench.loaders.storage.assembly import assemble, planned_receipt
from fpp_ml_bench.loaders.storage.manifest import read_manifest
from fpp_ml_bench.loaders.storage.shards import ShardWriter
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.loaders.storage.verification import verify
from fpp_ml_bench.optics.opencv_files import read_opencv_calibration
from fpp_ml_bench.optics.rig_file import load_rig
from fpp_ml_bench.remote import RemoteFolder

YAML = ("rig", "projection", "mesh list", "light", "recipe", "splits", "submission")
JSON = ("rig as JSON", "manifest", "result", "row")
CODED = ("rig, phase shift", "rig, Gray code", "rig, crossed")
MUTATIONS, TREES = 60, 12


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    """The sources by name; a test that changes other files than theirs makes its own."""
    return sources(tmp_path_factory.mktemp("valid"))


def test_all_sources_are_tested_and_valid(valid):
    assert set(valid) == {*YAML, *JSON, *CODED}
    assert {
        name: source.outcome(source.text(source.content)) for name, source in valid.items()
    } == dict.fromkeys(valid, "read")


@pytest.mark.long
@pytest.mark.parametrize("name", YAML + JSON + CODED)
def test_mutations_are_read_or_refused(name, valid):
    """Some of each, or the mutations would test nothing."""
    count = (
        2 * MUTATIONS if name == "row" else MUTATIONS
    )  # nearly every change of a row contradicts its other numbers
    outcomes = [valid[name].outcome(mutation) for mutation in valid[name].mutations(count, seed=0)]
    assert set(outcomes) == {"read", "refused"}


def test_changed_published_trees_are_read_or_refused(tmp_path):
    tree = make_tree(tmp_path / "tree", splits={"train": ("bowl",)})
    for seed in range(TREES):
        (work := tmp_path / str(seed)).mkdir()
        assert tree_outcome(tree, work, seed) in ("read", "refused")


# ---- texts

BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join(9 * [f'*{before}'])}]\n"
    for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)
TEXTS = {
    "alias bomb": (BOMB, "uses an alias"),
    "timestamp": ("name: !!timestamp x", "name: has the tag"),
    "int": ("name: !!int x", "name: has the tag"),
    "Python": ("name: !!python/object/apply:os.getcwd []", "name: has the tag"),
    "plain tag": ("name: ! x", "has the tag"),
    "own tag": ("%TAG ! tag:x,2000:\n--- !foo bar", "has the tag"),
    "exponent": ("name: 1e999999", "name: Infinity is no number"),
    "NaN": ("name: [1, .nan]", r"name\[1\]: NaN is no number"),
    "digits": (
        f"name: {'9' * 10**5}",
        "name: a number of more than 1000 digits|at most 65536 bytes",
    ),
    "nested": ("[" * 10_000, "nested too deeply"),
    "nested by lines": ("- " * 10_000, "nested too deeply"),
    "large": ("#" * (1 << 20) + "\n", "expected at most"),
    "no UTF-8": (b"name: \xff", "expected UTF-8"),
    "key twice": ("name: a\nname: b", "'name' is given twice"),
    "number as key": ("1: 2", "expected text as key"),
    "half a character": (r'name: "\ud800"', "name: half of a surrogate pair"),
    "no character": (r'name: "\Uffffffff"', "is no plain YAML"),
    "two documents": ("a\n---\nb", "single document"),
    "other version": ("%YAML 9.9\n--- a", "incompatible YAML"),
}


def refused(source, content):
    source.file.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(FppBenchError) as error:
        source.read()
    assert str(source.file) in str(error.value) and len(str(error.value)) < 2000
    return str(error.value)


@pytest.mark.parametrize(
    ("name", "attack"),
    [*(("rig", attack) for attack in TEXTS), *((name, "key twice") for name in YAML[1:])],
)
def test_hostile_yaml(name, attack, valid):
    """All attacks on one file, and one on each of the others: they have the same reader."""
    text, message = TEXTS[attack]
    assert re.search(message, refused(valid[name], text))


@pytest.mark.long
def test_dates_stay_text_and_numbers_numbers():
    assert strict_yaml("{a: 2001-99-99, b: 2026-01-31 10:00:00, c: 1e-3, d: -0.5}") == {
        "a": "2001-99-99",
        "b": "2026-01-31 10:00:00",
        "c": 1e-3,
        "d": -0.5,
    }
    assert strict_yaml("[" * DEEPEST + "]" * DEEPEST)
    with pytest.raises(ValueError, match=f"line 1: expected at most {MOST_NODES} keys and values"):
        strict_yaml("[" + "1," * (MOST_NODES + 1))


JSON_TEXTS = {
    "key twice": ('{"a": 1, "a": 2}', "'a' is given twice"),
    "NaN": ('{"a": {"b": [0, NaN]}}', r"a\.b\[1\]: NaN is no number"),
    "Infinity": ('{"a": -Infinity}', "a: -Infinity is no number"),
    "exponent": ('{"a": 1e999999}', "a: Infinity is no number"),
    "digits": (f'{{"a": {"9" * 10**5}}}', "a number of more than 1000 digits"),
    "no float": (f'{{"a": 1{"0" * 400}}}', r"a: 10+\.\.\. is no number"),
    "nested": ("[" * 10_000, "nested too deeply"),
    "many": (f"[{'[],' * (MOST_VALUES // 2)}[]]", f"at most {MOST_VALUES} values"),
    "half a character": (r'{"a": ["\ud800"]}', r"a\[0\]: half of a surrogate pair"),
    "half a character as key": (r'{"\udfff": 1}', "half of a surrogate pair"),
    "no UTF-8": (b'{"a": "\xff"}', "expected UTF-8"),
    "cut off": ('{"a": [1', "is no valid JSON"),
    "more": ("{} {}", "is no valid JSON"),
    "empty": (" \n", "is no valid JSON: it is empty"),
}


@pytest.mark.parametrize(
    ("name", "attack"),
    [
        *(("rig as JSON", attack) for attack in JSON_TEXTS),
        *((name, "key twice") for name in JSON[1:]),
    ],
)
def test_hostile_json(name, attack, valid):
    """All attacks on one file, and one on each of the others: they have the same reader."""
    text, message = JSON_TEXTS[attack]
    assert re.search(message, refused(valid[name], text))


def test_json_is_read_as_it_is():
    content = {"a": [1, 2.5, -1e-320, None, True, "é\U0001f600 \n"], "": {}}
    for ascii_alone in (True, False):
        assert strict_json(json.dumps(content, ensure_ascii=ascii_alone)) == content
    assert strict_json("[" * DEEPEST + "]" * DEEPEST)
    text = "[{," * MOST_VALUES  # of a text nothing is counted
    assert strict_json(f'["{text}"]') == [text]


@pytest.mark.long
def test_a_result_of_too_many_objects_is_refused_before_anything_is_computed(valid, monkeypatch):
    """8,000 objects in 11 MB took 2 GB: the intervals are resampled over objects."""
    monkeypatch.setattr(
        "fpp_ml_bench.evaluation.result.model.intervals_over_objects", lambda *words: pytest.fail()
    )
    source = valid["result"]
    row = source.content["per_sample"][0]
    for samples, objects, message in (
        (1001, 1001, "got 1001 and 1001"),
        (10_001, 2, "got 2 and 10001"),
    ):
        rows = [{**row, "sample": f"s{i}", "object": f"o{i % objects}"} for i in range(samples)]
        content = {**source.content, "per_sample": rows}
        assert f"at most 1000 objects and 10000 samples, {message}" in refused(
            source, json.dumps(content)
        )


# ---- files


def endpoint(path):
    with socket.socket(socket.AF_UNIX) as server:
        os.chdir(path.parent)
        server.bind(path.name)


NO_FILES = {
    "pipe": os.mkfifo,
    "device": lambda path: path.symlink_to("/dev/zero"),
    "folder": Path.mkdir,
    "socket": endpoint,
}


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        *(("rig", kind) for kind in NO_FILES),
        *((name, "pipe") for name in (*YAML[1:], *JSON, "weights", "calibration", "mask")),
    ],
)
def test_what_is_no_regular_file_is_refused_at_once(name, kind, valid, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    others = {
        "weights": ("w.safetensors", lambda path: weights_files.read_file(path, DEPTH_NETWORKS)),
        "calibration": ("c.xml", read_opencv_calibration),
        "mask": ("m.npy", lambda path: read_mask(path, (2, 2))),
    }
    if name in others:
        file, read = tmp_path / others[name][0], others[name][1]
    else:
        file, read = valid[name].file, lambda path: valid[name].read()
        file.unlink(missing_ok=True)
    NO_FILES[kind](file)
    try:
        with pytest.raises(FppBenchError) as error:
            read(file)
    finally:
        file.rmdir() if kind == "folder" else file.unlink()
    assert file.name in str(error.value) or str(file.parent) in str(error.value)


def test_a_file_that_the_user_names_may_be_a_link_and_one_in_a_folder_of_predictions_not(
    valid, tmp_path
):
    source = valid["rig"]
    source.file.write_bytes(source.text(source.content))
    (tmp_path / "link.yaml").symlink_to(source.file)
    assert load_rig(tmp_path / "link.yaml") == load_rig(source.file)
    source = valid["submission"]
    source.file.write_bytes(source.text(source.content))
    source.file.rename(tmp_path / "submission.yaml")
    source.file.symlink_to(tmp_path / "submission.yaml")
    with pytest.raises(SubmissionError, match=r"submission\.yaml .* found a symbolic link"):
        source.read()
    source.file.unlink()


def test_files_are_bounded_before_they_are_read(tmp_path):
    """A sparse file: no disk is used, and reading it whole would take seconds."""
    for name, size, error, read in (
        ("rig.yaml", 1 << 40, RigError, load_rig),
        ("c.xml", 1 << 40, RigError, read_opencv_calibration),
        ("r.json", (1 << 26) + 1, SubmissionError, read_result),
    ):
        with (tmp_path / name).open("wb") as file:
            file.truncate(size)
        with pytest.raises(error, match=f"{name}: has {size} bytes, expected at most"):
            read(tmp_path / name)


# ---- the manifest


def changed_manifest(folder, key, value):
    """Change a value of the manifest, and make its fingerprint right again."""
    path = folder / "manifest.json"
    change_json(path, key, value)
    path.write_text(json.dumps(sealed_manifest(json.loads(path.read_text()))))


ROW, SHARD, HASH = "samples.train.0", "shards.0", "0" * 32
ONE_ROW = [{"sample": "mug_A0", "object": "mug", "view": "A0"}]
MANIFESTS = {
    "sample is a path": (
        f"{ROW}.sample",
        "../../x",
        "sample '../../x': expected a name of letters",
    ),
    "object is a path": (
        f"{ROW}.object",
        "/etc/passwd",
        "object '/etc/passwd': expected a name",
    ),
    "view is a path": (f"{ROW}.view", "../x", "view '../x': expected a name"),
    "sample too long": (f"{ROW}.sample", 300 * "a" + "_A0", "expected a name"),
    "no object": ("samples.test.0.object", ..., "object 'None': expected a name"),
    "pixels are text": (f"{ROW}.object_px", "many", "object_px: expected a number, got many"),
    "error is a list": (f"{ROW}.gt_mae_mm", [], "gt_mae_mm: expected a number"),
    "shard outside": (f"{SHARD}.path", "../../etc/passwd", "without . and .."),
    "shard with an escape": (f"{SHARD}.path", "train/\x1b[31m", r"U\+001B"),
    "rows below 0": (f"{SHARD}.rows", -1, "expected counts of 0 and more"),
    "no hash": (f"{SHARD}.xxh3_128", "x", "a hash of 32 hex digits"),
    "another key": (f"{SHARD}.x", 1, "shards: expected exactly the keys path, split"),
    "shard of no group": (f"{SHARD}.group", "x", "unknown group 'x', expected data"),
    "other file outside": ("others.0.path", "../x", "without . and .."),
    "no split": ("samples.holdout", ONE_ROW, "unknown split 'holdout'"),
    "empty split": ("samples.test", [], "expected some in every split"),
    "image of no size": ("size", [0, 16], r"expected 1 to 16384 px a side"),
    "image too large": ("size", [12, 16385], r"expected 1 to 16384 px a side"),
    "another rig": ("rig.camera.fx", "wide", "camera.fx: expected a number"),
    "stored nothing": ("stored", "crossed", "'crossed' is no configuration"),
    "exact is a number": ("exact", 1, "exact: expected bool, got 1"),
    "light is text": ("settings.light", "x", "settings light: expected a mapping"),
    "generator with an escape": ("generator.name", "\x1b[31m", r"U\+001B"),
    "another content": ("content", {"test/../x": HASH}, "expected split/column"),
    "content without hash": ("content", {"test/depth": "x"}, "a hash of 32 hex digits"),
    "more": ("more", 1, "expected exactly the keys origin"),
}
"""Key, value, and what is said of it."""


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    return make(tmp_path_factory.mktemp("small") / "set", {"train": ("bowl",), "test": ("mug",)})


@pytest.fixture
def copied(small, tmp_path):
    return shutil.copytree(small, tmp_path / "here" / "set")


def refused_manifest(folder, message):
    with pytest.raises(DatasetError, match=r"manifest\.json: damaged \(.*" + message):
        read_manifest(folder)


@pytest.mark.parametrize("attack", MANIFESTS)
def test_a_manifest_that_no_dataset_has(attack, copied):
    key, value, message = MANIFESTS[attack]
    changed_manifest(copied, key, value)
    refused_manifest(copied, message)


def test_a_manifest_that_lists_a_shard_twice(copied):
    shards = json.loads((copied / "manifest.json").read_text())["shards"]
    changed_manifest(copied, "shards", [*shards, shards[0]])
    refused_manifest(copied, "is listed twice")


def refused_by_commands(dataset, out):
    """What commands say that would write or read by a dataset's names."""
    for words in (f"predict phase {dataset} --split train", f"export {dataset} --parquet"):
        yield refusal(fpp_bench, words, "--out", out)
    assert not out.exists()


def test_no_command_writes_or_reads_outside_by_a_manifests_names(copied, tmp_path):
    changed_manifest(copied, f"{ROW}.sample", "../../x")
    for said in refused_by_commands(copied, tmp_path / "here" / "out"):
        assert "manifest.json: damaged (sample '../../x'" in said
    assert not list(tmp_path.rglob("*x*"))


def test_no_command_follows_a_link_out_of_the_dataset(copied, tmp_path):
    shard = copied / read_manifest(copied).shards[0].path
    shutil.move(shard, tmp_path / "elsewhere.arrow")
    shard.symlink_to(tmp_path / "elsewhere.arrow")
    for said in refused_by_commands(copied, tmp_path / "here" / "out"):
        assert f"{shard}: is a link out of the dataset" in said
    shard.unlink()
    shutil.move(tmp_path / "elsewhere.arrow", copied / "train" / "kept.arrow")
    shard.symlink_to("kept.arrow")
    assert DatasetFolder(copied).samples("train")
    shutil.move(copied, tmp_path / "moved")
    copied.symlink_to(tmp_path / "moved")  # the folder itself is what the user names
    assert DatasetFolder(copied).samples("train")


@pytest.mark.parametrize("name", ["train", "README.md", "manifest.json"])
def test_a_folder_and_any_other_file_may_not_lead_elsewhere_either(name, copied, tmp_path):
    shutil.move(copied / name, tmp_path / name)
    (copied / name).symlink_to(tmp_path / name)
    with pytest.raises(DatasetError, match="is a link out of the dataset"):
        verify(copied)


def test_a_mesh_that_the_manifest_does_not_list_is_not_exported(copied, tmp_path):
    (copied / "meshes").mkdir()
    for name in ("bowl", "mug"):
        (copied / "meshes" / f"{name}.ply").symlink_to("/etc/passwd")
    said = refusal(fpp_bench, f"export {copied} --out {tmp_path}/out --meshes")
    assert "bowl.ply: the mesh is missing" in said and not (tmp_path / "out").exists()


def test_rows_without_end_are_a_finding_at_once(copied):
    changed_manifest(copied, f"{SHARD}.rows", 10**15)
    said = f"the files hold {10**15} rows, expected each of 6 once"
    assert any(said in finding for finding in verify(copied))


# ---- receipts, names from elsewhere


@pytest.mark.parametrize("value", ODD, ids=str)
def test_a_receipt_that_no_shard_left_is_as_none(value, tmp_path):
    planned = assembly({"train": ("bowl",)})
    (plan,) = planned.plans
    written = ShardWriter(planned.manifest).write(tmp_path, plan, planned.rows(plan, tmp_path))
    good, rows = asdict(written), written.rows
    receipt = tmp_path / "receipt.json"

    def read(content):
        receipt.write_text(json.dumps(content))
        return planned_receipt(receipt, plan)

    assert read(good) == written
    assert planned_receipt(receipt, replace(plan, index=1)) is None  # a shard of another name
    assert read(value) is None
    assert read({**good, "files": [{**good["files"][0], "path": value}]}) is None
    for key in ("sample", "object", "view"):
        assert read({**good, "rows": [{**rows[0], key: value}, *rows[1:]]}) is None, key
    if value != []:
        for key in good:
            assert read({**good, key: value}) is None, key


@pytest.mark.parametrize("text", ["[]", "{"])
def test_damaged_settings_of_a_build_are_refused(text, tmp_path):
    planned = assembly({"train": ("bowl",)})
    (tmp_path / "set" / ".build").mkdir(parents=True)
    (tmp_path / "set" / ".build" / "settings.json").write_text(text)
    with pytest.raises(FppBenchError, match=r"settings\.json is no valid JSON|with other settings"):
        assemble(tmp_path / "set", planned, workers=1)


@pytest.mark.parametrize(
    "path", ["", ".", "..", "/", "/x", "a/..", "a/../b", "./a", "a/", "a//b", "a\\b", "a\0", "a\nb"]
)
def test_paths_that_name_nothing_below_a_folder(path, tmp_path):
    assert path_problem(path) and path_problem("a/b.arrow") is None
    with pytest.raises(RemoteError, match="remove it there"):
        RemoteFolder(f"file://{tmp_path}").get(path, tmp_path / "x")


@pytest.mark.parametrize("stem", ["x" * 120, "<b>"])
def test_published_files_have_names_that_a_dataset_may_have(stem, tmp_path):
    make_tree(tmp_path, splits={"train": ("bowl",), "val": (stem,)})
    with pytest.raises(LayoutError, match="expected a name like power_drill_A60"):
        plan_import(tmp_path)


def test_damaged_lines_of_a_stopped_run_do_not_count(tmp_path):
    run = {"method": "x"}
    good = {"sample": "a", "seconds": 0.5, "report": {}}
    bad = (
        '{"sample": "b"}',
        '{"sample": "b", "seconds": [], "report": {}}',
        "[" * 10_000,
        '{"sample": "b", "seconds": NaN,',
    )
    (tmp_path / UNFINISHED_FILE).write_text(
        "\n".join([json.dumps(run), *bad, json.dumps(good)]) + "\n"
    )
    assert UnfinishedRun(tmp_path, run).finished == {"a": (0.5, {})}


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(
        SubmissionError, match=r"none\.json: can't be read: No such file or directory$"
    ):
        read_json(tmp_path / "none.json", SubmissionError)
    with pytest.raises(SubmissionError, match=r"can't be read: embedded null byte"):
        read_json(tmp_path / "a\0b", SubmissionError)
