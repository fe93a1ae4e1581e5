"""The commands patterns and decode, on captures that the renderer makes of a rig with vertical
codes alone."""

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from fpp_ml_bench.cli import main
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
from fpp_ml_bench.optics.rig_file import load_rig, rig_from_dict, save_rig

SIZE = 120


def vertical_rig(scheme: dict):
    data = paper_rig(SIZE).to_dict()
    del data["pitch_px"]
    return rig_from_dict(
        {**data, "sequence": {"vertical": scheme, "order": ["vertical", "white", "black"]}}
    )


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A mug seen by a rig with two periods of four steps: folder, rig file, exact depth."""
    folder = tmp_path_factory.mktemp("capture")
    rig = vertical_rig(
        {"scheme": "phase-shift", "pitches_px": [48, 912], "steps": [4, 8], "sign": -1}
    )
    save_rig(rig, folder / "rig.yaml")
    studio = Studio(BuildSettings(rig, ("mug",)))
    row = studio.photograph(solid_mesh("mug"), "A60")
    (folder / "scan").mkdir()
    for index, frame in row.frames.items():
        cv2.imwrite(str(folder / "scan" / f"frame_{index}.png"), frame)
    return folder, row


def decode(folder, scan, out, *words):
    return main(["decode", str(folder / "rig.yaml"), str(scan), "--out", str(out), *words])


def test_decoded_capture_is_the_scene(capture, tmp_path, capsys):
    folder, row = capture
    assert decode(folder, folder / "scan", tmp_path / "out") == 0
    depth_mm, exact_mm = np.load(tmp_path / "out" / "depth.npy"), row.depth_exact_mm
    np.testing.assert_array_equal(
        depth_mm, decode_stack(list(row.frames.values()), load_rig(folder / "rig.yaml")).depth_mm
    )
    both = (depth_mm > 0) & (exact_mm > 0)
    assert both.sum() > 0.9 * (exact_mm > 0).sum()
    assert np.median(np.abs(depth_mm - exact_mm)[both]) < 2
    report = json.loads((tmp_path / "out" / "decode.json").read_text())
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
    assert "uncertainty" in capsys.readouterr().out


def test_the_stated_uncertainty_is_that_of_noise():
    rig = vertical_rig({"scheme": "phase-shift", "pitches_px": [48, 912], "steps": [4, 8]})
    x, y = (axis.ravel() for axis in rig.camera.rays())
    u_px, _ = rig.project(np.stack([x, y, np.ones_like(x)], axis=-1) * 1.8)
    profiles = rig.code("vertical").profiles(912).astype(float)
    random, depths = np.random.default_rng(5), []
    for _ in range(30):
        frames = [
            np.interp(u_px, np.arange(912), row) * 0.7 + 20 + random.normal(0, 2, len(x))
            for row in profiles
        ]
        frames = [*frames, np.full(len(x), 200.0), np.full(len(x), 20.0)]
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


def written(folder, frames, tmp_path):
    scan = tmp_path / "scan"
    scan.mkdir()
    for index, frame in enumerate(frames):
        cv2.imwrite(str(scan / f"frame_{index}.png"), frame)
    return scan


def test_saturated_frames_are_named(capture, tmp_path, capsys):
    folder, row = capture
    bright = [
        np.clip(frame.astype(float) * 2.5, 0, 255).astype(np.uint8) for frame in row.frames.values()
    ]
    assert decode(folder, written(folder, bright, tmp_path), tmp_path / "out") == 0
    assert "saturated on lit pixels: frame_" in capsys.readouterr().err
    assert (np.load(tmp_path / "out" / "reason.npy") == Reason.SATURATED).any()


def test_findings_are_told_and_anyway_decodes(capture, tmp_path, capsys):
    folder, row = capture
    frames = list(row.frames.values())
    frames[3] = frames[2]
    scan = written(folder, frames, tmp_path)
    assert decode(folder, folder / "scan", tmp_path / "out") == 0
    said = capsys.readouterr()
    assert "not checked" in said.out and "warning" not in said.err
    by_source = json.loads((tmp_path / "out" / "decode.json").read_text())
    for source, sigma_mm in by_source["median_sigma_mm_by_source"].items():
        assert f"by {source}:" in said.out and f" {sigma_mm:.3f} mm" in said.out
    assert "an order that is wrong by one would add" in said.out
    assert decode(folder, scan, tmp_path / "out") == 2
    assert "frame_2.png and frame_3.png show the same image" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "out").iterdir()] == [
        "decode.json"
    ]  # of the refused capture
    refused = json.loads((tmp_path / "out" / "decode.json").read_text())
    assert refused["examination"]["findings"][0]["severity"] == "refuse" and "pixels" not in refused
    assert decode(folder, scan, tmp_path / "out", "--anyway", "--forms", "npy") == 0
    assert "warning: equal frames" in capsys.readouterr().err
    report = json.loads((tmp_path / "out" / "decode.json").read_text())
    assert report["examination"]["findings"][0]["name"] == "equal frames"
    assert report["pixels"] and not (tmp_path / "out" / "depth.mat").exists()


def test_jpeg_is_a_finding(capture, tmp_path, capsys):
    folder, row = capture
    (tmp_path / "scan").mkdir()
    for index, frame in row.frames.items():
        cv2.imwrite(
            str(tmp_path / "scan" / f"frame_{index}.jpg"), frame, [cv2.IMWRITE_JPEG_QUALITY, 80]
        )
    assert decode(folder, tmp_path / "scan", tmp_path / "out") == 2
    said = capsys.readouterr().err
    assert "compressed with loss: frame_0.jpg and 13 more are" in said and "--anyway" in said
    across, between = map(float, re.findall(r"change by ([\d.]+) across.* by ([\d.]+)", said)[0])
    assert across > 1.05 * between
    assert decode(folder, tmp_path / "scan", tmp_path / "out", "--anyway", "--forms", "npy") == 0
    depth_mm = np.load(tmp_path / "out" / "depth.npy")
    both = (depth_mm > 0) & (row.depth_exact_mm > 0)
    assert np.median(np.abs(depth_mm - row.depth_exact_mm)[both]) < 4


def test_a_decoding_killed_in_the_middle_leaves_nothing_that_the_next_refuses(
    capture, tmp_path, monkeypatch
):
    folder, _ = capture

    def killed(*_, **__):
        raise KeyboardInterrupt

    assert decode(folder, folder / "scan", tmp_path / "out", "--forms", "png") == 0
    monkeypatch.setattr("fpp_ml_bench.loaders.captures.exports.write_report", killed)
    assert decode(folder, folder / "scan", tmp_path / "out", "--forms", "npy") == 130
    assert not (tmp_path / "out" / "decode.json").exists()  # what is there is no result
    (tmp_path / "out" / ".0123456789abcdef.tmp").write_bytes(b"cut off")
    monkeypatch.undo()
    assert decode(folder, folder / "scan", tmp_path / "out", "--forms", "mat") == 0
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"decode.json", "depth.mat"} <= names and not {
        "depth.npy",
        ".0123456789abcdef.tmp",
    } & names


@pytest.mark.parametrize(("steps", "gamma"), [(3, 2.2), (4, 1.5), (6, 1.0)])
def test_the_stated_uncertainty_holds_the_error_of_gamma(steps, gamma):
    rig = vertical_rig({"scheme": "phase-shift", "pitch_px": 57, "steps": steps, "gray": {}})
    x, y = rig.camera.rays()
    depth_m = 1.8 / (1.0 - 0.4 * x + 0.25 * y)
    u_px, _ = rig.project(np.stack([x, y, np.ones_like(x)], axis=-1) * depth_m[..., None])
    profiles = [*rig.code("vertical").profiles(912), np.full(912, 255), np.zeros(912)]
    light = np.stack([np.interp(u_px, np.arange(912), row) / 255 for row in profiles]) ** gamma
    frames = 12 + 180 * light + np.random.default_rng(3).normal(0, 1, light.shape)
    files = tuple(Path(f"scan/{index}.png") for index in range(len(frames)))
    result = decode_capture(CapturedFrames(np.rint(frames).astype(np.uint8), files), rig)
    found = (
        (result.decoded.depth_mm > 0) & (u_px > 5) & (u_px < 906)
    )  # the interpolation ends with the pattern
    error_mm = np.abs(result.decoded.depth_mm - 1000 * depth_m)[found]
    assert (
        found.mean() > 0.9 and (error_mm > 100).mean() < 0.001
    )  # of wrong orders no uncertainty is stated
    assert 1 / 3 < 0.6745 * np.median(result.sigma_mm[found]) / np.median(error_mm) < 3


@pytest.mark.parametrize(
    "words, said",
    [
        (["--working-range", "1,2"], "1 to 2 mm, where no rig looks"),
        (["--direction", "horizontal"], "no horizontal"),
        (["--forms", "obj"], "expected some of npy, mat"),
        (["--mask", "none.npy"], "none.npy"),
        (["--bits", "12"], "expected levels of 12 bits"),
        (["--noise", "-1"], "noise_grey: expected grey levels above 0"),
    ],
)
def test_bad_words_are_a_sentence_and_nothing_is_written(capture, tmp_path, capsys, words, said):
    folder, _ = capture
    assert decode(folder, folder / "scan", tmp_path / "out", *words) == 2
    error = capsys.readouterr().err
    assert said in error and "Traceback" not in error and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda frames: frames[:-1], "expected 14 frames, found 13"),
        (lambda frames: [frame[:, :100] for frame in frames], "camera of 120 x 120"),
        (lambda frames: [np.zeros_like(frame) for frame in frames], "too faint"),
    ],
)
def test_a_bad_capture_is_a_sentence(capture, tmp_path, capsys, change, said):
    folder, row = capture
    scan = written(folder, change(list(row.frames.values())), tmp_path)
    assert decode(folder, scan, tmp_path / "out") == 2
    assert said in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_patterns_come_with_a_manifest(tmp_path, capsys):
    file = tmp_path / "projector.yaml"
    file.write_text(
        "projector: {width: 200, height: 100}\n"
        "sequence: {order: [white, vertical, black], vertical: {scheme: gray, cell_px: 2}}\n"
    )
    again = ["patterns", str(file), "--out", str(tmp_path / "images"), "--board", "checker:9x13:10"]
    assert main(again) == 0
    assert (tmp_path / "images" / "board.pdf").read_bytes().startswith(b"%PDF")
    manifest = json.loads((tmp_path / "images" / "patterns.json").read_text())
    assert manifest["projector_px"] == [200, 100] and len(manifest["frames"]) == 9
    assert manifest["frames"][1]["shows"] == "vertical Gray bit 0"
    white = cv2.imread(str(tmp_path / "images" / "A_0.png"), cv2.IMREAD_UNCHANGED)
    assert white.shape == (100, 200) and (white == 255).all()
    assert main(again) == 0  # the whole set is there
    (tmp_path / "images" / "A_1.png").write_bytes(b"other")
    assert main(again) == 2
    assert "is not empty; give a new folder, so that no old pattern" in capsys.readouterr().err


def test_of_two_that_write_patterns_one_is_told(tmp_path, capsys):
    with whole_folder(tmp_path / "images", "here", CaptureError):
        assert main(["patterns", "paper", "--out", str(tmp_path / "images")]) == 2
    assert "another process is writing patterns there" in capsys.readouterr().err


def test_of_two_that_decode_into_a_folder_one_is_told(capture, tmp_path, capsys):
    folder, _ = capture
    out = tmp_path / "out"
    with exclusive(out / LOCK_FILE, out, "here", CaptureError):
        assert decode(folder, folder / "scan", out) == 2
    assert (
        f"{out}: another process is decoding into this folder; wait for it"
        in capsys.readouterr().err
    )


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
def test_a_projector_that_is_not_described_is_a_sentence(tmp_path, capsys, text, said):
    (tmp_path / "projector.yaml").write_text(text)
    assert (
        main(["patterns", str(tmp_path / "projector.yaml"), "--out", str(tmp_path / "images")]) == 2
    )
    assert said in capsys.readouterr().err and not (tmp_path / "images").exists()
