"""A dataset from captures: a plane whose depth is known in closed form, photographed through
OpenCV's remap, in folders as a scanner leaves them; then every command on it."""

import re
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml
from captures import capture, rig_with
from conftest import file_bytes, fpp_bench, fpp_eval, printed, read_image, read_json, refusal

from fpp_ml_bench import load_dataset
from fpp_ml_bench.decoding.decode import decode_stack
from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.loaders.captures.decoding import CaptureReader, plan_captures
from fpp_ml_bench.loaders.captures.images import Splits
from fpp_ml_bench.loaders.published.importing import import_rows
from fpp_ml_bench.loaders.render.meshes import solid_mesh
from fpp_ml_bench.loaders.render.scene import BuildSettings
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.loaders.storage.shards import plan_rows
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.loaders.storage.verification import verify
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.rig_file import rig_from_dict, save_rig

UNIT_CUE = {"scheme": "phase-shift", "pitches_px": [57, 912], "steps": 3, "sign": -1}


def coded_rig(width=90, height=70, **sequence):
    camera = replace(
        paper_rig(90).camera,
        width=width,
        height=height,
        cx=(width - 1) / 2,
        cy=(height - 1) / 2,
    )
    sequence = sequence or {"order": ["white", "vertical"], "vertical": UNIT_CUE}
    rig = rig_with(sequence, 90, background_m=..., standoff_m=...)
    return replace(rig, camera=camera)


RIG = coded_rig()


def depth_m(rig, number):
    """A tilted plane, another for every number, that ends a third before the left edge: nothing is
    seen there."""
    x, y = rig.camera.rays()
    return (1.75 + 0.03 * number) / (1.0 - 0.4 * x + 0.25 * y)


def frames_of(rig, number):
    frames = capture(rig, depth_m(rig, number), seed=number)
    for frame in frames:
        frame[:, : frame.shape[1] // 3] = 3
    return frames


def write(folder, frames, dtype=np.uint8):
    folder.mkdir(parents=True)
    for index, frame in enumerate(frames):
        assert cv2.imwrite(str(folder / f"frame_{index}.png"), frame.astype(dtype))


@pytest.fixture
def scanned(tmp_path):
    """Two views of one object and the single view of another."""
    save_rig(RIG, tmp_path / "rig.yaml")
    for number, place in enumerate(("gear_wheel/front", "gear_wheel/back-2", "bolt")):
        write(tmp_path / "scans" / place, frames_of(RIG, number))
    (tmp_path / "scans" / "notes.txt").write_text("of the scanner")
    return tmp_path


def importing(folder, *more):
    line = f"import {folder}/scans --captures --out {folder}/set --rig {folder}/rig.yaml"
    return fpp_bench(line, *more)


def test_captures_become_a_dataset_like_any_other(scanned):
    (scanned / "splits.yaml").write_text("train: [gear_wheel]\ntest: [bolt]\n")
    splits = f"--splits {scanned}/splits.yaml"
    said = printed(importing, scanned, splits, "--workers 1")
    assert "train 2, test 1 samples, 21 images" in said
    assert "bolt_single" in said and "low modulation" in said

    folder = scanned / "set"
    opened = DatasetFolder(folder)
    assert opened.splits == {
        "train": ["gear_wheel_back-2", "gear_wheel_front"],
        "test": ["bolt_single"],
    }
    assert opened.size == (70, 90)
    assert opened.configs == ("single_shot", "vertical", "sinusoidal", "all")
    assert opened.rig == RIG and not opened.has_exact and opened.manifest.origin == "captured"
    for sample, number in (("gear_wheel_front", 0), ("gear_wheel_back-2", 1), ("bolt_single", 2)):
        depth_mm, true_mm = opened.depth_mm(sample), 1000 * depth_m(RIG, number)
        seen = depth_mm > 0
        assert seen[:, 31:].mean() > 0.9 and not seen[:, :29].any()
        # Noise of 1 grey level, three steps of 57 px.
        assert np.median(np.abs(depth_mm - true_mm)[seen]) < 2.0
        for index, frame in enumerate(frames_of(RIG, number)):
            np.testing.assert_array_equal(opened.frame(sample, index), frame)
        measured = opened.measured(sample)
        assert measured["decoded_share"] == pytest.approx(seen.mean())
        assert measured["median_modulation"] == pytest.approx(0.45 * 127.5, rel=0.1)
        shares = measured["refused_share"]
        assert sum(shares.values()) == pytest.approx(1 - seen.mean())
        assert shares["low_modulation"] > 0.3

    row = load_dataset(folder, "all", split="test").with_format("numpy")[0]
    assert [name for name in row if name.startswith("frame_")] == [
        f"frame_{i:02d}" for i in range(7)
    ]
    np.testing.assert_array_equal(row["depth"], opened.depth_mm("bolt_single"))
    assert list(load_dataset(folder, split="train")["view"]) == ["back-2", "front"]

    assert verify(folder) == []
    assert fpp_bench("verify", folder) == 0
    assert "vertical phase-shift 57 + 912 px" in printed(fpp_bench, "info", folder)
    assert fpp_bench(f"show {folder} bolt_single --out {scanned}/a.png") == 0
    assert fpp_bench(f"show {folder} --sheet --out {scanned}/b.png") == 0
    assert cv2.imread(str(scanned / "b.png")).shape[:2] == (93 + 18, 2 * 2 * 120 + 8)
    assert "license: unknown" in (folder / "README.md").read_text()
    assert fpp_bench(f"export {folder} --out {scanned}/tree --mat") == 2
    assert fpp_bench(f"export {folder} --out {scanned}/rows --parquet") == 0
    exported = (scanned / "rows" / "README.md").read_text()
    assert "# Fringe images with depth (captured), Parquet" in exported
    assert "FPP-ML-Bench authors" not in (scanned / "rows" / "croissant.json").read_text()

    predictions, result = scanned / "predictions", scanned / "result.json"
    assert fpp_bench(f"predict classical {folder} --out {predictions}") == 0
    submission = yaml.safe_load((predictions / "submission.yaml").read_text())
    assert submission["name"] == "Classical, vertical phase-shift 57 + 912 px"
    assert submission["frames_used"] == [1, 2, 3, 4, 5, 6]
    assert fpp_eval(f"{predictions} {folder} --json {result}") == 0
    # By the process that made the ground truth.
    assert read_json(result)["metrics"]["object_mae_mm"] == 0.0
    assert importing(scanned, splits) == 0  # finished: nothing is done again


def test_deeper_images_are_decoded_as_captured_and_stored_in_eight_bits(scanned):
    shutil.rmtree(scanned / "scans")
    deep = [np.rint(frame * 16 + 7.0) for frame in frames_of(RIG, 0)]
    write(scanned / "scans" / "part", deep, np.uint16)
    said = printed(importing, scanned, "--bits 12")
    assert "stored rounded to 8 bits" in said and "all objects are in split test" in said
    opened = DatasetFolder(scanned / "set")
    full = [(frame * (255 / 4095)).astype(np.float32) for frame in deep]
    np.testing.assert_array_equal(opened.depth_mm("part_single"), decode_stack(full, RIG).depth_mm)
    np.testing.assert_array_equal(opened.frame("part_single", 2), np.rint(full[2]).astype(np.uint8))
    assert opened.measured("part_single")["full_scale"] == 4095


@pytest.mark.parametrize(
    ("sequence", "used"),
    [
        (
            {"order": ["black", "white", "vertical"], "vertical": {"scheme": "gray", "cell_px": 2}},
            11,
        ),
        ({"horizontal": UNIT_CUE | {"pitches_px": [57, 1140]}, "vertical": UNIT_CUE}, 12),
    ],
)
def test_any_sequence_and_limits(tmp_path, sequence, used):
    rig = coded_rig(**sequence)
    write(tmp_path / "scans" / "part", frames_of(rig, 0))
    save_rig(rig, tmp_path / "rig.yaml")
    assert importing(tmp_path, "--min-modulation 8 --max-clipped-steps 0") == 0
    opened = DatasetFolder(tmp_path / "set")
    depth_mm = opened.depth_mm("part_single")
    seen = depth_mm > 0
    assert seen.mean() > 0.5 and opened.manifest.settings["min_modulation"] == 8
    # Cells of two pixels are the coarsest.
    assert np.median(np.abs(depth_mm - 1000 * depth_m(rig, 0))[seen]) < 10
    assert fpp_bench(f"predict classical {tmp_path}/set --out {tmp_path}/p") == 0
    submission = yaml.safe_load((tmp_path / "p" / "submission.yaml").read_text())
    assert len(submission["frames_used"]) == used


def test_an_interrupted_import_goes_on_and_gives_the_same_bytes(scanned, monkeypatch):
    monkeypatch.setattr("fpp_ml_bench.loaders.storage.shards.ROWS_PER_SHARD", 1)
    plan = plan_captures(scanned / "scans", RIG)
    import_rows(scanned / "whole", plan, 1)
    read, done = CaptureReader.read, []

    def stop_at_third(self, taken):
        done.append(taken.sample)
        if len(done) == 3:
            raise KeyboardInterrupt
        return read(self, taken)

    monkeypatch.setattr(CaptureReader, "read", stop_at_third)
    with pytest.raises(KeyboardInterrupt):
        import_rows(scanned / "set", plan, 1)
    # A frame of a finished shard changes: that shard is read again, the other is not.
    frame = scanned / "scans" / "bolt" / "frame_0.png"
    frame.write_bytes(frame.read_bytes())
    steps = []
    import_rows(scanned / "set", plan, 1, steps.append)
    assert done[3:] == ["bolt_single", "gear_wheel_front"] and steps == [1, 1, 1]
    assert file_bytes(scanned / "set") == file_bytes(scanned / "whole")
    assert not (scanned / "set" / ".build").exists()
    with pytest.raises(BuildError, match="other settings: objects"):
        given = Splits(train=["bolt"], test=["gear_wheel"])
        import_rows(scanned / "set", plan_captures(scanned / "scans", RIG, given), 1)
    frame.write_bytes(frame.read_bytes())
    with pytest.raises(BuildError, match=r"holds a finished import, and .*frame_0\.png changed"):
        import_rows(scanned / "set", plan, 1)


def test_shards_hold_few_large_images():
    samples = [(f"part_{i}", "part", str(i)) for i in range(60)]
    assert [len(plan.samples) for plan in plan_rows("test", samples, 90 * 70)] == [20, 20, 20]
    large = plan_rows("test", samples, 1 << 25)
    assert len(large) == 30 and large[7].first_row == 14 and large[7].of == 30
    assert [sample for plan in large for sample in plan.samples] == samples
    assert len(plan_rows("test", samples, 1 << 28)) == 60


@pytest.mark.long
def test_frames_in_another_order_are_refused_and_imported_anyway(scanned):
    """The frames in the opposite order: some pixels get a depth all the same."""
    files = sorted((scanned / "scans" / "bolt").iterdir())
    contents = [file.read_bytes() for file in files]
    for file, content in zip(files, reversed(contents), strict=True):
        file.write_bytes(content)
    said = refusal(importing, scanned)
    assert "bolt: another reading fits" in said and "in the opposite order" in said
    said = printed(importing, scanned, "--anyway")
    assert "bolt_single: another reading fits" in said
    (finding,) = DatasetFolder(scanned / "set").measured("bolt_single")["findings"][:1]
    assert "another reading fits" in finding


def of_many(folder):
    """Every capture is wrong in its own way: all are named."""
    (folder / "scans" / "bolt" / "frame_3.png").write_bytes(b"no image")
    frame = folder / "scans" / "gear_wheel" / "front" / "frame_2.png"
    frame.write_bytes(frame.read_bytes()[:300])


def splits(text):
    return lambda folder: (folder / "splits.yaml").write_text(text)


def of_frames(change):
    """Change every frame of the single view."""

    def prepared(folder):
        for file in sorted((folder / "scans" / "bolt").iterdir()):
            assert cv2.imwrite(str(file), change(read_image(file)))

    return prepared


def of_rig(**changes):
    rig = rig_from_dict({**RIG.to_dict(), **changes})
    return lambda folder: save_rig(rig, folder / "rig.yaml")


def copy_frame(to):
    return lambda folder: shutil.copy(folder / "scans/bolt/frame_0.png", folder / "scans" / to)


def rename(old, new):
    return lambda folder: (folder / "scans" / old).rename(folder / "scans" / new)


BAD = {
    "missing frame": (
        lambda folder: (folder / "scans/bolt/frame_6.png").unlink(),
        "expected the 7 frames.*found 6",
    ),
    "unreadable image": (of_many, r"(?s)bolt/frame_3\.png.*\n.*front/frame_2\.png"),
    "another size": (
        of_frames(lambda image: image[:60]),
        "bolt: frames of 90 x 60 px, .*camera of 90 x 70 px",
    ),
    "empty object": (
        lambda folder: (folder / "scans/empty").mkdir(),
        "empty: expected a folder with images",
    ),
    "nothing": (
        lambda folder: [shutil.rmtree(path) for path in folder.glob("scans/*/")],
        "holds no folder of an object",
    ),
    "no folder": (
        lambda folder: shutil.rmtree(folder / "scans"),
        "expected a folder with a folder of frames for each",
    ),
    "frames beside objects": (copy_frame("."), "holds frames itself"),
    "frames beside views": (copy_frame("gear_wheel"), "frames and folders"),
    "underscore in a view": (
        rename("gear_wheel/front", "gear_wheel/front_1"),
        r"no _\), such as front-1",
    ),
    "dot in an object": (rename("bolt", "bolt.v2"), "expected an object name of letters"),
    "object in two splits": (
        splits("{train: [bolt], test: [bolt, gear_wheel]}"),
        "under train and test",
    ),
    "object twice": (
        splits("{test: [bolt, bolt, gear_wheel]}"),
        "'bolt' is listed under test and test",
    ),
    "object in no split": (splits("{test: [bolt]}"), "'gear_wheel' is in no split"),
    "unknown object": (splits("{test: [bolt, gear_wheel, nut]}"), "'nut' has no captures"),
    "unknown split": (splits("{tests: [bolt, gear_wheel]}"), "tests: is not a key"),
    "splits that are no list": (splits("{test: bolt}"), "test: .*list"),
    "malformed splits": (splits("{test: ["), "is no plain YAML"),
    "dark": (
        of_frames(lambda image: image // 40),
        "refused as low modulation: probably the fringes are too faint",
    ),
    "overexposed": (
        of_frames(lambda image: np.minimum(image.astype(int) * 5 + 170, 255)),
        "refused as .*: probably",
    ),
    "another range": (
        of_rig(working_range_mm=[900, 1000], standoff_m=0.95),
        "nothing in the range: .*another working",
    ),
    "unknown colour": ("--colour cyan", "colour: expected luminance"),
    "impossible limit": ("--min-modulation -1", "min_modulation: expected a positive"),
    "frame order": ("--frame-order paper", "belongs to published trees"),
}
"""What is done to the folder, or words of the command, and what is said."""


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_capture_is_refused(scanned, name):
    wrong, said = BAD[name]
    words = wrong if isinstance(wrong, str) else ""
    if not words:
        wrong(scanned)
    if (file := scanned / "splits.yaml").exists():
        words = f"--splits {file}"
    error = refusal(importing, scanned, words, "--workers 1")
    assert re.search(said, error), error
    assert not (scanned / "set" / "manifest.json").exists()


def test_options_belong_to_one_kind_of_import(scanned):
    line = f"import {scanned}/scans --out {scanned}/set"
    assert "give its file with --rig" in refusal(fpp_bench, line, "--captures")
    assert "--bits belongs to captures" in refusal(fpp_bench, line, "--bits 12")


@pytest.mark.long
@pytest.mark.parametrize(
    ("method", "said"),
    [
        ("classical --steps 3", "leave steps out"),
        ("classical --fewest", "leave fewest out"),
        ("phase --direction horizontal", "vertical fringes, and no horizontal ones"),
        ("unet-individual-rmse", "was trained at 224x224 px"),
    ],
)
def test_methods_that_can_not_run_say_what_they_need(scanned, method, said):
    assert importing(scanned, "--workers 1") == 0
    name, *words = method.split()
    assert said in refusal(
        fpp_bench, "predict", name, scanned / "set", *words, "--out", scanned / "p"
    )


def test_ground_truth_by_gray_code_needs_black_and_white_stored_or_not():
    """The renderer exposes the frames that the decoder reads, whatever is stored."""
    gray = {"order": ["black", "white", "vertical"], "vertical": {"scheme": "gray", "cell_px": 4}}
    rig = rig_from_dict({**coded_rig(96, 96, **gray).to_dict(), "background_m": 3.2})
    whole, first = (
        Studio(BuildSettings(rig, ("mug",), stored=stored))
        .photograph(solid_mesh("mug"), "A0")
        .depth_mm
        for stored in ("all", "single_shot")
    )
    assert (whole > 0).sum() > 100
    np.testing.assert_array_equal(whole, first)
