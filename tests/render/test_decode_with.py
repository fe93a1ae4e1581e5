"""Datasets whose ground truth is decoded with the rig that a calibration found, not with the one
that photographed."""

import json
from dataclasses import replace

import numpy as np
import pytest
from conftest import TINY_SIZE, fpp_bench, printed

from fpp_ml_bench.calibration.volume import volume_error_mm
from fpp_ml_bench.decoding.decode import decode_stack
from fpp_ml_bench.errors import BuildError, CalibrationError
from fpp_ml_bench.loaders.render.builder import assembly_of, build
from fpp_ml_bench.loaders.render.scene import BuildSettings
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.loaders.storage.verification import verify
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.rig_file import save_rig
from fpp_ml_bench.optics.sequence import Sequence

TRUE = paper_rig(TINY_SIZE)
FOUND = replace(
    TRUE,
    camera=replace(TRUE.camera, fx=TRUE.camera.fx * 1.001, cx=TRUE.camera.cx + 0.02),
    translation_m=(0.1252, -0.1001, 0.0003),
)


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """Folder of a dataset built by the command with --decode-with, and the dataset."""
    folder = tmp_path_factory.mktemp("lab")
    save_rig(FOUND, folder / "found.yaml")
    line = f"build --out {folder}/data --objects cork --size {TINY_SIZE} --workers 1"
    assert fpp_bench(line, "--decode-with", folder / "found.yaml") == 0
    return DatasetFolder(folder / "data")


def test_frames_and_exact_depth_are_the_true_rigs_and_depth_and_rig_the_found_ones(lab, opened):
    assert lab.rig == FOUND and verify(lab.path) == []
    assert lab.manifest.settings["photographed_by"] == TRUE.to_dict()
    for sample in lab.samples("train"):
        frames = [lab.frame(sample, index) for index in range(52)]
        np.testing.assert_array_equal(frames, [opened.frame(sample, index) for index in range(52)])
        exact_mm = lab.depth_mm(sample, "depth_exact")
        np.testing.assert_array_equal(exact_mm, opened.depth_mm(sample, "depth_exact"))
        decoded = decode_stack(frames, FOUND, mask=exact_mm > 0).depth_mm
        np.testing.assert_array_equal(lab.depth_mm(sample), decoded)
        assert lab.measured(sample)["gt_rmse_mm"] > 1.5 * opened.measured(sample)["gt_rmse_mm"]


def test_info_says_that_another_rig_photographed_and_how_far_both_are_apart(lab, opened, tiny):
    error = volume_error_mm(FOUND, TRUE)
    out = printed(fpp_bench, "info", lab.path)
    assert "photographed by another" in out and f"{error.rms_mm:.3f} mm RMS" in out
    assert "photographed_by" not in out
    of_lab, of_tiny = (
        json.loads(printed(fpp_bench, "info --json -", path)) for path in (lab.path, tiny)
    )
    assert of_lab["calibration_error"] == pytest.approx(error._asdict())
    assert of_lab["settings"]["photographed_by"]["translation_m"] == [0.125, -0.1, 0.0]
    assert of_tiny["calibration_error"] is None
    assert "photographed_by" not in opened.manifest.settings


def test_a_build_with_another_rig_to_decode_with_is_another_dataset(lab):
    with pytest.raises(BuildError, match="settings"):
        build(lab.path, BuildSettings(TRUE, ("cork",)), workers=1)


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (paper_rig(480), "camera of 480 x 480 px"),
        (
            replace(TRUE, projector=replace(TRUE.projector, width=1000)),
            "projector of 1000 x 1140 px",
        ),
        (replace(TRUE, pitch_vertical_px=20.0), "another sequence or pitch"),
        (replace(TRUE, sequence=Sequence(steps=12)), "another sequence or pitch"),
    ],
)
def test_rigs_that_can_not_decode_the_frames_are_refused(other, message):
    with pytest.raises(BuildError, match=message):
        BuildSettings(TRUE, ("cork",), decode_with=other)


def test_a_rig_that_has_nothing_in_common_is_refused_before_anything_is_built():
    mirrored = replace(TRUE, translation_m=(-0.125, 0.1, 0.0))
    with pytest.raises(CalibrationError, match="no depth by the other rig"):
        assembly_of(BuildSettings(TRUE, ("cork",), decode_with=mirrored))
