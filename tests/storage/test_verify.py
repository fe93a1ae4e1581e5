"""`verify` reports every kind of damage and leak, with one finding each, and none on a clean
dataset."""

import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from conftest import flip, fpp_bench, printed, refusal
from synthetic import make

from fpp_ml_bench.constants import VIEWS
from fpp_ml_bench.errors import DatasetError
from fpp_ml_bench.files import file_hash
from fpp_ml_bench.loaders.storage import shards as writing
from fpp_ml_bench.loaders.storage.manifest import ShardFile, read_manifest
from fpp_ml_bench.loaders.storage.verification import verify


@pytest.fixture
def clean(tmp_path):
    return make(tmp_path / "set")


def shard_of(folder, split="train", group="data"):
    return next(s for s in read_manifest(folder).shards if (s.split, s.group) == (split, group))


def restate(folder, **changes):
    """Write the manifest again with a right fingerprint, as someone who wants to hide a change
    would do."""
    replace(read_manifest(folder), **changes).write(folder)


def reseal(folder, shard):
    """Make the manifest agree with the present bytes of a shard."""
    path = folder / shard.path
    sealed = replace(shard, bytes=path.stat().st_size, xxh3_128=file_hash(path))
    restate(
        folder, shards=[sealed if s.path == shard.path else s for s in read_manifest(folder).shards]
    )


@pytest.mark.long
def test_clean_datasets_have_no_findings(tiny, clean):
    reported = []
    assert verify(tiny, reported.append) == [] and verify(clean) == []
    manifest = read_manifest(tiny)
    assert reported == [1] * (len(manifest.shards) + len(manifest.others))
    out = printed(fpp_bench, "verify", tiny)
    assert "intact" in out and manifest.fingerprint in out


# ---- files


@pytest.mark.long
@pytest.mark.parametrize("share", [0.0, 0.999999])
def test_flipped_byte_in_a_shard(copied, share, capsys):
    path = copied / shard_of(copied, "validation", "codes").path
    flip(path, share)
    (finding,) = verify(copied)
    assert str(path) in finding and "content has changed" in finding
    assert fpp_bench("verify", copied) == 1
    assert "1 finding(s)" in capsys.readouterr().out


@pytest.mark.long
@pytest.mark.parametrize(
    "name",
    ["README.md", "test/dataset_info.json", "meshes/mug.ply"],
)
def test_changed_file_beside_the_shards(copied, name):
    flip(copied / name)
    (finding,) = verify(copied)
    assert name in finding and "content has changed" in finding
    (copied / name).unlink()
    (finding,) = verify(copied)
    assert name in finding and "is missing" in finding


def test_cut_missing_and_foreign_files(copied):
    cut, gone = copied / shard_of(copied).path, copied / shard_of(copied, "test", "codes").path
    size = cut.stat().st_size
    cut.write_bytes(cut.read_bytes()[:-8])
    gone.unlink()
    shutil.copy(
        copied / shard_of(copied, "test").path, copied / "test" / "data-00001-of-00002.arrow"
    )
    (copied / "frames" / "note.txt").write_text("x")
    findings = verify(copied)
    assert len(findings) == 4
    for name, message in (
        (cut.name, f"has {size - 8} bytes, expected {size}"),
        (gone.name, "is missing"),
        ("data-00001-of-00002.arrow", "not part of this dataset"),
        ("note.txt", "not part of this dataset"),
    ):
        assert any(name in finding and message in finding for finding in findings)


def test_link_in_place_of_nothing_is_foreign(clean):
    (clean / "link").symlink_to("/nowhere")
    (finding,) = verify(clean)
    assert "link" in finding and "not part" in finding


def test_swapped_shards(clean):
    paths = [clean / shard_of(clean, split).path for split in ("validation", "test")]
    contents = [path.read_bytes() for path in paths]
    for path, content in zip(paths, reversed(contents), strict=True):
        path.write_bytes(content)
    findings = verify(clean)
    assert len(findings) == 2 and all("expected" in f or "changed" in f for f in findings)
    # With a manifest that agrees with the swapped files, the labels in the rows show it.
    for split in ("validation", "test"):
        reseal(clean, shard_of(clean, split))
    assert sum("expected labels" in f for f in verify(clean)) == 12


def test_no_arrow_under_a_right_checksum(clean):
    shard = shard_of(clean)
    (clean / shard.path).write_bytes(b"no arrow at all")
    reseal(clean, shard)
    (finding,) = verify(clean)
    assert "can't be read as Arrow" in finding


def test_other_columns_under_a_right_checksum(clean):
    import pyarrow as pa

    shard = shard_of(clean)
    table = pa.ipc.open_stream((clean / shard.path).read_bytes()).read_all()
    for wrong in (
        table.drop_columns(["depth"]),
        table.slice(1),
        table.set_column(7, "depth_min", pa.array(["1"] * 12)),
    ):
        with (
            pa.OSFile(str(clean / shard.path), "wb") as sink,
            pa.ipc.new_stream(sink, wrong.schema) as writer,
        ):
            writer.write_table(wrong)
        reseal(clean, shard)
        (finding,) = verify(clean)
        assert "rows or columns are not those" in finding


# ---- contents


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.nan, "1 pixels are NaN or infinite"),
        (-1.0, "1 pixels are negative"),
        (0.0, "no pixel is above 0"),
        (9000.0, "depth_min and depth_max do not fit"),
    ],
)
def test_depths_that_no_sample_may_have(tmp_path, monkeypatch, value, message):
    """The writer refuses them, but a dataset written by another program may contain them."""
    monkeypatch.setattr(writing, "checked_range_mm", lambda depth, sample: (1500.0, 2100.0))
    folder = make(tmp_path / "set", spoil=("mug_A60", value))
    findings = [finding for finding in verify(folder) if "mug_A60" in finding]
    assert len(findings) == 1 and message in findings[0] and "column depth" in findings[0]


@pytest.mark.parametrize(
    ("split", "row", "change", "said"),
    [
        ("train", 7, {"sample": "cork_A120"}, "expected labels"),
        ("train", 7, {"object": "bowl"}, "expected labels"),
        ("train", 7, {"view": "A120"}, "expected labels"),
        ("train", 7, {"depth_min_mm": 1.0}, "expected labels"),
        ("test", 0, {"object": "drill"}, "'power_drill_A0'.*said to be"),
    ],
)
def test_labels_that_contradict_the_manifest(clean, split, row, change, said):
    samples = {
        name: [dict(row) for row in rows] for name, rows in read_manifest(clean).samples.items()
    }
    samples[split][row].update(change)
    restate(clean, samples=samples)
    assert any(re.search(said, finding) for finding in verify(clean))


# ---- splits


def test_object_in_two_splits(tmp_path):
    folder = make(
        tmp_path / "set", {"train": ("bowl", "mug"), "validation": ("mug",)}, origin="imported"
    )
    findings = verify(folder)
    assert sum("in two splits" in f and "'mug'" in f for f in findings) >= 1
    assert any("same image stands in two splits: train/mug_A0" in f for f in findings)
    assert fpp_bench("verify", folder) == 1


def test_image_in_two_splits_under_other_names(tmp_path):
    folder = make(tmp_path / "set", same=(("power_drill_A120", "bowl_A60"),))
    (finding,) = verify(folder)
    assert (
        finding
        == "the same image stands in two splits: train/bowl_A60 frame_00, test/power_drill_A120 frame_00"
    )


def test_image_twice_in_one_split_is_no_leak(tmp_path):
    assert verify(make(tmp_path / "set", same=(("cork_A0", "bowl_A60"),))) == []


def test_benchmark_object_in_the_wrong_split(tmp_path):
    wrong = {"train": ("power_drill", "bowl"), "test": ("wooden_boards",)}
    said = "'power_drill' is in train, the benchmark has it in test"
    assert any(said in finding for finding in verify(make(tmp_path / "a", wrong)))
    # A published tree has its own split.
    assert verify(make(tmp_path / "b", wrong, origin="imported")) == []


def test_object_without_all_its_views(tmp_path):
    findings = verify(make(tmp_path / "set", {"train": ("bowl",)}, views=VIEWS[:5]))
    assert len(findings) == 1 and "'bowl'" in findings[0] and "expected the views" in findings[0]


def test_rows_missing_from_all_files(clean):
    manifest = read_manifest(clean)
    shard = shard_of(clean, "validation")
    (clean / shard.path).unlink()
    restate(clean, shards=[s for s in manifest.shards if s != shard])
    (finding,) = verify(clean)
    assert "validation, data: the files hold 0 rows, expected each of 6 once" in finding


def test_rows_present_in_two_files(clean):
    manifest = read_manifest(clean)
    shard = shard_of(clean, "validation")
    twin = ShardFile(**{**vars(shard), "path": "validation/data-00009-of-00009.arrow"})
    shutil.copy(clean / shard.path, clean / twin.path)
    restate(clean, shards=[*manifest.shards, twin])
    assert any("hold 12 rows" in f for f in verify(clean))


# ---- the manifest


def test_every_kind_of_tampering_with_the_manifest_is_noticed(clean):
    path = clean / "manifest.json"
    text = path.read_text()
    for old, new in (
        ('"bowl_A0"', '"bowl_A1"'),
        ('"rows": 12', '"rows": 13'),
        ('"stored": "single_shot"', '"stored": "all"'),
        ('"exact": true', '"exact": false'),
        ('"schema_version": "3', '"schema_version": "4'),
        ('"origin": "generated"', '"origin": "imported"'),
        ('"xxh3_128": "', '"xxh3_128": "0'),  # the first is that of a shard
        ('"shards": [', '"shard": ['),
        ('"fingerprint"', '"fingerprints"'),
        ("{", "["),
    ):
        assert old in text
        path.write_text(text.replace(old, new, 1))
        with pytest.raises(DatasetError, match=r"manifest\.json"):
            verify(clean)
        assert "manifest.json" in refusal(fpp_bench, "verify", clean)


@pytest.mark.long
def test_any_flipped_bit_of_the_manifest_is_noticed_or_does_not_concern_the_data(clean):
    path = clean / "manifest.json"
    content, manifest = path.read_bytes(), read_manifest(clean)
    rng, harmless = np.random.default_rng(0), 0
    for position in rng.integers(0, len(content), 400):
        changed = bytearray(content)
        changed[position] ^= 1 << rng.integers(0, 8)
        path.write_bytes(changed)
        try:
            changed_manifest = read_manifest(clean)
        except DatasetError:
            continue
        if changed_manifest.others != manifest.others:
            assert verify(clean)
        harmless += 1
        same = replace(changed_manifest, generator=manifest.generator, others=manifest.others)
        assert same == manifest
    # White space, the generator's name, the entries of files that are looked at themselves.
    assert harmless < 150
