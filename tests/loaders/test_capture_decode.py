"""The commands patterns and decode, on captures that the renderer makes of a rig with vertical
codes alone."""

import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from captures import projected, rig_with, tilted
from conftest import fpp_bench, printed, read_image, read_json, refusal

from fpp_ml_bench.coding.code import Reason
from fpp_ml_bench.decoding.decode import decode_stack
from fpp_ml_bench.decoding.triangulation import (
    coordinate_slope_px_per_mm,
    depth_budget_mm,
    depth_sigma_mm,
    noise_of_frames,
)
from fpp_ml_bench.errors import CaptureError
from fpp_ml_bench.files import LOCK_FILE, exclusive, whole_folder
from fpp_ml_bench.loaders.captures.decoding import decode_capture
from fpp_ml_bench.loaders.captures.images import CapturedFrames
from fpp_ml_bench.loaders.render.meshes import solid_mesh
from fpp_ml_bench.loaders.render.scene import BuildSettings
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.rig_file import load_rig, save_rig

SIZE = 120
TWO_PERIODS = {"scheme": "phase-shift", "pitches_px": [48, 912], "steps": [4, 8], "sign": -1}


def vertical_rig(scheme):
    return rig_with({"vertical": scheme, "order": ["vertical", "white", "black"]}, SIZE)


def write(scan, frames, suffix="png", *options):
    scan.mkdir()
    for index, frame in enumerate(frames):
        cv2.imwrite(str(scan / f"frame_{index}.{suffix}"), frame, *options)
    return scan


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A mug seen by a rig with two periods: folder, frames, exact depth."""
    folder = tmp_path_factory.mktemp("capture")
    rig = vertical_rig(TWO_PERIODS)
    save_rig(rig, folder / "rig.yaml")
    row = Studio(BuildSettings(rig, ("mug",))).photograph(solid_mesh("mug"), "A60")
    frames = list(row.frames.values())
    write(folder / "scan", frames)
    return folder, frames, row.depth_exact_mm


@pytest.fixture
def scan(capture):
    return capture[0] / "scan"


@pytest.fixture
def decode(capture, tmp_path):
    """``fpp-bench decode`` of a folder of frames into the folder ``out``."""
    return partial(fpp_bench, "decode --out", tmp_path / "out", capture[0] / "rig.yaml")


def test_decoded_capture_is_the_scene(capture, scan, decode, tmp_path):
    folder, frames, exact_mm = capture
    assert "uncertainty" in printed(decode, scan)
    depth_mm = np.load(tmp_path / "out" / "depth.npy")
    expected_mm = decode_stack(frames, load_rig(folder / "rig.yaml")).depth_mm
    np.testing.assert_array_equal(depth_mm, expected_mm)
    both = (depth_mm > 0) & (exact_mm > 0)
    assert both.sum() > 0.9 * (exact_mm > 0).sum()
    assert np.median(np.abs(depth_mm - exact_mm)[both]) < 2
    report = read_json(tmp_path / "out" / "decode.json")
    assert report["noise_measured"] and report["pixels"]["decoded"] == (depth_mm > 0).sum()
    assert len(report["frames"]) == 14
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert {
        "depth.mat",
        "points.ply",
        "mesh.ply",
        "picture.png",
        "sigma_mm.npy",
        "reason.npy",
    } <= names


def test_the_stated_uncertainty_is_that_of_noise():
    rig = vertical_rig(TWO_PERIODS)
    u_px = projected(rig, 1.8)[0].ravel()
    profiles = rig.code("vertical").profiles(912).astype(float)
    random, depths = np.random.default_rng(5), []
    for _ in range(30):
        frames = [
            np.interp(u_px, np.arange(912), row) * 0.7 + 20 + random.normal(0, 2, u_px.size)
            for row in profiles
        ]
        frames += [np.full(u_px.size, 200.0), np.full(u_px.size, 20.0)]
        images = np.clip(frames, 0, 255).astype(np.float32).reshape(14, SIZE, SIZE)
        decoded = decode_stack(images, rig, details=True)
        depths.append(np.where(decoded.depth_mm > 0, decoded.depth_mm, np.nan))
    noise = noise_of_frames(list(images), rig)
    assert noise == pytest.approx(2, rel=0.03)
    sigma_mm = depth_sigma_mm(decoded, rig, noise)
    good = np.isfinite(depths).all(axis=0) & (sigma_mm > 0)
    seen = np.where(good, np.std(np.nan_to_num(depths), axis=0, ddof=1), np.nan)
    assert np.sqrt(np.mean(seen[good] ** 2 / sigma_mm[good] ** 2)) == pytest.approx(1, rel=0.05)
    known = replace(rig, calibration_px=0.1)
    budget = depth_budget_mm(decoded, known, noise, {"vertical": 0.01})
    total_mm = np.sqrt(sum(part**2 for part in budget.values()))
    valid = decoded.depth_mm > 0
    again_mm = depth_sigma_mm(decoded, known, noise, systematic_rad={"vertical": 0.01})[valid]
    np.testing.assert_allclose(total_mm, again_mm, rtol=1e-6)
    np.testing.assert_allclose(
        budget["rounding to grey levels"], sigma_mm[valid] / noise / 12**0.5, rtol=1e-6
    )
    pitch = known.code("vertical").pitch_px
    ratio = budget["response and epipolar pattern"] / budget["calibration"]
    np.testing.assert_allclose(ratio, 0.01 * pitch / (2 * np.pi) / 0.1, rtol=1e-9)


def test_slope_is_the_difference_of_projections():
    rig = paper_rig(64)
    rays = tuple(axis[3:6, 7] for axis in rig.camera.rays())
    for direction, axis in (("vertical", 0), ("horizontal", 1)):
        ends = [
            rig.project(np.stack([*rays, np.ones(3)], axis=-1) * z)[axis] for z in (1.7999, 1.8001)
        ]
        slope = coordinate_slope_px_per_mm(rig, 1800.0, direction, rays)
        np.testing.assert_allclose(slope, (ends[1] - ends[0]) / 0.2, rtol=1e-6)


@pytest.mark.long
def test_saturated_frames_are_named(capture, decode, tmp_path, capsys):
    bright = np.clip(np.multiply(capture[1], 2.5), 0, 255).astype(np.uint8)
    assert decode(write(tmp_path / "bright", bright)) == 0
    assert "saturated on lit pixels: frame_" in capsys.readouterr().err
    assert (np.load(tmp_path / "out" / "reason.npy") == Reason.SATURATED).any()


@pytest.mark.long
def test_findings_are_told_and_anyway_decodes(capture, scan, decode, tmp_path, capsys):
    frames, out = list(capture[1]), tmp_path / "out"
    frames[3] = frames[2]
    equal = write(tmp_path / "equal", frames)
    assert decode(scan) == 0
    said = capsys.readouterr()
    assert "not checked" in said.out and "warning" not in said.err
    by_source = read_json(out / "decode.json")["median_sigma_mm_by_source"]
    for source, sigma_mm in by_source.items():
        assert f"by {source}:" in said.out and f" {sigma_mm:.3f} mm" in said.out
    assert "an order that is wrong by one would add" in said.out
    assert "frame_2.png and frame_3.png show the same image" in refusal(decode, equal)
    assert [path.name for path in out.iterdir()] == ["decode.json"]  # of the refused capture
    refused = read_json(out / "decode.json")
    assert refused["examination"]["findings"][0]["severity"] == "refuse" and "pixels" not in refused
    assert decode(equal, "--anyway --forms npy") == 0
    assert "warning: equal frames" in capsys.readouterr().err
    report = read_json(out / "decode.json")
    assert report["examination"]["findings"][0]["name"] == "equal frames"
    assert report["pixels"] and not (out / "depth.mat").exists()


@pytest.mark.long
def test_jpeg_is_a_finding(capture, decode, tmp_path):
    _, frames, exact_mm = capture
    jpeg = write(tmp_path / "jpeg", frames, "jpg", [cv2.IMWRITE_JPEG_QUALITY, 80])
    said = refusal(decode, jpeg)
    assert "compressed with loss: frame_0.jpg and 13 more are" in said and "--anyway" in said
    across, between = map(float, re.findall(r"change by ([\d.]+) across.* by ([\d.]+)", said)[0])
    assert across > 1.05 * between
    assert decode(jpeg, "--anyway --forms npy") == 0
    depth_mm = np.load(tmp_path / "out" / "depth.npy")
    both = (depth_mm > 0) & (exact_mm > 0)
    assert np.median(np.abs(depth_mm - exact_mm)[both]) < 4


@pytest.mark.long
def test_a_decoding_killed_in_the_middle_leaves_nothing_that_the_next_refuses(
    scan, decode, tmp_path, monkeypatch
):
    out = tmp_path / "out"
    assert decode(scan, "--forms png") == 0
    killed = Mock(side_effect=KeyboardInterrupt)
    monkeypatch.setattr("fpp_ml_bench.loaders.captures.exports.write_report", killed)
    assert decode(scan, "--forms npy") == 130
    assert not (out / "decode.json").exists()  # what is there is no result
    (out / ".0123456789abcdef.tmp").write_bytes(b"cut off")
    monkeypatch.undo()
    assert decode(scan, "--forms mat") == 0
    names = {path.name for path in out.iterdir()}
    assert {"decode.json", "depth.mat"} <= names
    assert names.isdisjoint({"depth.npy", ".0123456789abcdef.tmp"})


@pytest.mark.parametrize(("steps", "gamma"), [(3, 2.2), (4, 1.5), (6, 1.0)])
def test_the_stated_uncertainty_holds_the_error_of_gamma(steps, gamma):
    rig = vertical_rig({"scheme": "phase-shift", "pitch_px": 57, "steps": steps, "gray": {}})
    depth_m = tilted(rig)
    u_px, _ = projected(rig, depth_m)
    profiles = [*rig.code("vertical").profiles(912), np.full(912, 255), np.zeros(912)]
    light = np.stack([np.interp(u_px, np.arange(912), row) / 255 for row in profiles]) ** gamma
    frames = 12 + 180 * light + np.random.default_rng(3).normal(0, 1, light.shape)
    files = tuple(Path(f"scan/{index}.png") for index in range(len(frames)))
    result = decode_capture(CapturedFrames(np.rint(frames).astype(np.uint8), files), rig)
    inside = (u_px > 5) & (u_px < 906)  # the interpolation ends with the pattern
    found = (result.decoded.depth_mm > 0) & inside
    error_mm = np.abs(result.decoded.depth_mm - 1000 * depth_m)[found]
    # Of wrong orders no uncertainty is stated.
    assert found.mean() > 0.9 and (error_mm > 100).mean() < 0.001
    assert 1 / 3 < 0.6745 * np.median(result.sigma_mm[found]) / np.median(error_mm) < 3


@pytest.mark.parametrize(
    "words, said",
    [
        ("--working-range 1,2", "1 to 2 mm, where no rig looks"),
        ("--direction horizontal", "no horizontal"),
        ("--forms obj", "expected some of npy, mat"),
        ("--mask none.npy", "none.npy"),
        ("--bits 12", "expected levels of 12 bits"),
        ("--noise -1", "noise_grey: expected grey levels above 0"),
    ],
)
def test_bad_words_are_a_sentence_and_nothing_is_written(scan, decode, tmp_path, words, said):
    assert said in refusal(decode, scan, words) and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda frames: frames[:-1], "expected 14 frames, found 13"),
        (lambda frames: [frame[:, :100] for frame in frames], "camera of 120 x 120"),
        (lambda frames: [np.zeros_like(frame) for frame in frames], "too faint"),
    ],
)
def test_a_bad_capture_is_a_sentence(capture, decode, tmp_path, change, said):
    bad = write(tmp_path / "bad", change(capture[1]))
    assert said in refusal(decode, bad) and not (tmp_path / "out").exists()


def test_patterns_come_with_a_manifest(tmp_path):
    file, images = tmp_path / "projector.yaml", tmp_path / "images"
    file.write_text(
        "projector: {width: 200, height: 100}\n"
        "sequence: {order: [white, vertical, black], vertical: {scheme: gray, cell_px: 2}}\n"
    )
    line = f"patterns {file} --out {images} --board checker:9x13:10"
    assert fpp_bench(line) == 0
    assert (images / "board.pdf").read_bytes().startswith(b"%PDF")
    manifest = read_json(images / "patterns.json")
    assert manifest["projector_px"] == [200, 100] and len(manifest["frames"]) == 9
    assert manifest["frames"][1]["shows"] == "vertical Gray bit 0"
    white = read_image(images / "A_0.png")
    assert white.shape == (100, 200) and (white == 255).all()
    assert fpp_bench(line) == 0  # the whole set is there
    (images / "A_1.png").write_bytes(b"other")
    said = refusal(fpp_bench, line)
    assert "is not empty; give a new folder, so that no old pattern" in said


def test_of_two_that_write_patterns_one_is_told(tmp_path):
    with whole_folder(tmp_path / "images", "here", CaptureError):
        said = refusal(fpp_bench, "patterns paper --out", tmp_path / "images")
    assert "another process is writing patterns there" in said


def test_of_two_that_decode_into_a_folder_one_is_told(scan, decode, tmp_path):
    out = tmp_path / "out"
    with exclusive(out / LOCK_FILE, out, "here", CaptureError):
        said = refusal(decode, scan)
    assert f"{out}: another process is decoding into this folder; wait for it" in said


@pytest.mark.parametrize(
    "text, said",
    [
        ("sequence: {}", "projector: expected a mapping"),
        ("projector: {width: 20}", "projector.height: missing"),
        ("projector: {width: 20, height: 20}", "pitch_px: missing"),
        (
            "projector: {width: 20, height: 20}\nsequence: {vertical: {scheme: gray, bits: 1}, "
            "order: [vertical]}",
            "need",
        ),
    ],
)
def test_a_projector_that_is_not_described_is_a_sentence(tmp_path, text, said):
    (tmp_path / "projector.yaml").write_text(text)
    line = f"patterns {tmp_path}/projector.yaml --out {tmp_path}/images"
    assert said in refusal(fpp_bench, line) and not (tmp_path / "images").exists()
