"""The rig of a published tree, found from its raw scans and depth alone, against the hidden rig
that rendered it."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import scipy.io
from conftest import fpp_bench, printed, refusal
from published_trees import make_tree

from fpp_ml_bench.calibration.from_depth import fit_projector
from fpp_ml_bench.errors import LayoutError
from fpp_ml_bench.loaders.published.exporting import export
from fpp_ml_bench.loaders.published.importing import depth_difference_mm, plan_import, tree_views
from fpp_ml_bench.loaders.render.builder import build
from fpp_ml_bench.loaders.render.scene import BuildSettings
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.pinhole import Pinhole
from fpp_ml_bench.optics.rig import rotation_matrix
from fpp_ml_bench.optics.rig_file import load_rig, save_rig

SIZE = 128
HIDDEN = replace(
    paper_rig(SIZE),
    projector=Pinhole(912, 1140, 1650.0, 1650.0, 455.5, 569.5),
    translation_m=(0.19, -0.08, 0.03),
    rotation=tuple(map(tuple, rotation_matrix((0.04, -0.07, 0.015)).tolist())),
    pitch_vertical_px=30.0,
    pitch_horizontal_px=26.0,
)


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    """Six views of one object by the hidden rig; nothing in the tree names the rig."""
    folder = tmp_path_factory.mktemp("hidden")
    build(folder / "data", BuildSettings(HIDDEN, ("power_drill",)), workers=1)
    export(DatasetFolder(folder / "data"), folder / "tree", ["mat"], ["test"])
    return folder / "tree"


@pytest.mark.long
def test_the_hidden_pitch_is_found_exactly_and_the_depth_to_a_twentieth_of_a_mm(tree, tmp_path):
    said = printed(fpp_bench, f"calibrate --from-depth {tree} --out {tmp_path}/rig.yaml")
    assert "power_drill_A240" in said and "whole px" in said and "wrote" in said
    rig = load_rig(tmp_path / "rig.yaml")
    assert (rig.pitch_vertical_px, rig.pitch_horizontal_px) == (30, 26)
    np.testing.assert_allclose(rig.t, HIDDEN.t, atol=0.002)
    np.testing.assert_allclose(rig.R, HIDDEN.R, atol=0.001)
    assert rig.projector.fx == pytest.approx(1650, rel=0.003)

    reader = plan_import(tree).rows
    read: list[int] = []
    found, fit = fit_projector(tree_views(reader, 2, read.append), reader.rig)
    assert found == rig
    assert len(read) == len(fit.views) == 6
    assert fit.total.rms_mm < 0.05  # against the exported depth, which the hidden rig decoded
    assert depth_difference_mm(replace(reader, rig=rig)) < 0.05
    assert depth_difference_mm(reader) > 1  # the paper's rig


@pytest.mark.long
def test_import_warns_of_another_rig_and_finds_it_where_asked(tree, tmp_path, capsys):
    line = f"import {tree} --workers 1 --out {tmp_path}"
    assert fpp_bench(f"{line}/assumed") == 0
    message = capsys.readouterr().err
    assert "warning: the paper's rig did not take" in message
    assert "calibrate --from-depth" in message
    assert fpp_bench(f"{line}/fitted --fit-rig") == 0
    assert "warning" not in capsys.readouterr().err
    rig = DatasetFolder(tmp_path / "fitted").rig
    assert (rig.pitch_vertical_px, rig.pitch_horizontal_px) == (30, 26)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("nowhere", "no such folder"),
        ("flat", "no raw scans"),
        ("tree --out nowhere/rig.yaml", "does not exist"),
        ("tree --out rig.txt", "ending in"),
        ("tree --camera wide.yaml", "its camera has"),
    ],
)
def test_bad_input_is_a_message_status_2_and_no_file(tree, tmp_path, monkeypatch, words, message):
    make_tree(tmp_path / "flat")
    (tmp_path / "tree").symlink_to(tree)
    save_rig(paper_rig(240), tmp_path / "wide.yaml")
    monkeypatch.chdir(tmp_path)
    error = refusal(fpp_bench, "calibrate --out rig.yaml --from-depth", words)
    assert "error:" in error and message in error
    assert not (tmp_path / "rig.yaml").exists() and not (tmp_path / "rig.txt").exists()


def test_frames_of_another_depth_are_refused(tree, tmp_path):
    broken = shutil.copytree(tree, tmp_path / "broken")
    scans = broken / "fpp_synthetic_dataset" / "power_drill"
    for number in range(52):
        shutil.copyfile(scans / "A0" / f"A_{number}.png", scans / "A60" / f"A_{number}.png")
    with pytest.raises(LayoutError, match="differs from the single-shot input"):
        tree_views(plan_import(broken).rows)


def rewritten(tree, folder, change):
    """A copy of the tree whose depth maps, by sample, are what ``change`` makes of all of them."""
    shutil.copytree(tree, folder)
    files = sorted((folder / "training_datasets/training_data_depth_raw/test/depth").glob("*.mat"))
    for other in ("global", "individual"):
        shutil.rmtree(folder / f"training_datasets/training_data_depth_{other}_normalized")
    shutil.rmtree(folder / "training_datasets/info_depth_params")
    maps = change([scipy.io.loadmat(file)["depthMap"] for file in files])
    for file, depth in zip(files, maps, strict=True):
        scipy.io.savemat(file, {"depthMap": depth})
    return folder


def rays(maps):
    rows, columns = np.mgrid[:SIZE, :SIZE]
    camera = HIDDEN.camera
    along = np.hypot(1, np.hypot((columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy))
    return [depth * along for depth in maps]


@pytest.mark.long
@pytest.mark.parametrize(
    ("words", "change"),
    [
        ("upside down", lambda maps: [depth[::-1] for depth in maps]),
        ("as distances along the ray", rays),
        ("as those of other samples", lambda maps: maps[1:] + maps[:1]),
        ("", lambda maps: maps),
    ],
)
def test_import_names_another_reading_of_the_depth(words, change, tree, tmp_path, capsys):
    save_rig(HIDDEN, tmp_path / "rig.yaml")
    changed = rewritten(tree, tmp_path / "tree", change)
    line = f"import {changed} --workers 1 --out {tmp_path}/data --rig {tmp_path}/rig.yaml"
    assert fpp_bench(line) == 0
    error = capsys.readouterr().err
    said = f"warning: another reading fits the tree's depth far better: {words}"
    assert (said if words else "") in error and ("warning" in error) == bool(words), error
