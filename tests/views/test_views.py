"""Views put together: placement, averaging, contradictions; and the command, on a sphere."""

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest
import trimesh
from scored_dataset import make_dataset, write_description, write_predictions

from fpp_ml_bench.baselines.views import (
    FUSION_FILE,
    PlacedView,
    cell_means,
    contradicted,
    point_weights,
)
from fpp_ml_bench.cli import main
from fpp_ml_bench.constants import VIEW_DEGREES, VIEWS
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.loaders.render.meshes import solid_mesh, write_ply
from fpp_ml_bench.loaders.render.raycast import PixelRays, TracedObject
from fpp_ml_bench.loaders.render.scene import SolidMesh, place
from fpp_ml_bench.loaders.sample import Row
from fpp_ml_bench.loaders.storage.assembly import Assembly, assemble
from fpp_ml_bench.loaders.storage.manifest import Manifest
from fpp_ml_bench.loaders.storage.shards import plan_shards
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.named_rigs import paper_rig

SIZE, RADIUS_M, ORDER_MM = 192, 0.15, 300.0
RIG = replace(paper_rig(960), camera=paper_rig(960).camera.scaled(SIZE))
SPHERE = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS_M)
CENTRE_M = np.array([0.04, -0.02, 0.03])
"""Off the turning axis, so that every view shows it elsewhere."""


def sphere_mm(degrees: float) -> np.ndarray:
    """Depth of the sphere, float32 (H, W) in mm."""
    x, y = RIG.camera.rays()
    turn = np.deg2rad(degrees)
    across, along = (
        np.sin(turn) * CENTRE_M[0] + np.cos(turn) * CENTRE_M[1],
        np.cos(turn) * CENTRE_M[0] - np.sin(turn) * CENTRE_M[1],
    )
    centre = np.array([-across, -CENTRE_M[2], along + RIG.standoff_m])
    a, b = x * x + y * y + 1, x * centre[0] + y * centre[1] + centre[2]
    root = b * b - a * (centre @ centre - RADIUS_M**2)
    return np.where(root > 0, 1000 * (b - np.sqrt(np.maximum(root, 0))) / a, 0).astype(np.float32)


def sphere_views() -> list[PlacedView]:
    return [PlacedView(sphere_mm(degrees), RIG.camera, degrees, RIG.standoff_m) for degrees in VIEW_DEGREES]


def planted(view: PlacedView, offset_mm: float) -> tuple[PlacedView, np.ndarray]:
    """A view with a square of wrong orders in the middle of the sphere, and which of its pixels they are."""
    rows, columns = np.nonzero(view.depth_mm > 0)
    square = np.zeros(view.depth_mm.shape, dtype=bool)
    row, column = int(rows.mean()), int(columns.mean())
    square[row - 5 : row + 6, column - 5 : column + 6] = True
    return replace(view, depth_mm=view.depth_mm + np.float32(offset_mm) * square), square.ravel()[view.pixels]


# ---- placement


def test_points_of_all_views_lie_on_one_sphere_and_project_back():
    for view in sphere_views():
        assert np.allclose(np.linalg.norm(view.points_m - CENTRE_M, axis=1), RADIUS_M, atol=1e-6)
        u, v, depth = view.seen(view.points_m)
        assert np.allclose(SIZE * v + u, view.pixels, atol=1e-3)
        assert np.allclose(depth, view.depth_mm.ravel()[view.pixels], atol=1e-3)


def test_the_renderer_places_objects_the_same_way():
    """Points lie on the mesh's triangles that the renderer hit, in the mesh's own coordinates."""
    mesh = solid_mesh("mug")
    for view, degrees in zip(VIEWS, VIEW_DEGREES, strict=True):
        vertices, distance_m = place(mesh, view, RIG, "varied", 42)
        hits = TracedObject(mesh, vertices).primary(PixelRays.of(RIG.camera))
        depth = np.zeros(SIZE * SIZE)
        depth[hits.pixels] = 1000 * hits.depth_m
        placed = PlacedView(depth.reshape(SIZE, SIZE), RIG.camera, degrees, distance_m)
        assert np.array_equal(placed.pixels, hits.pixels)
        corners = np.asarray(mesh.vertices_m, np.float64)[mesh.faces[hits.triangle]]
        nearest = trimesh.triangles.closest_point(corners, placed.points_m)
        distances_mm = 1000 * np.linalg.norm(nearest - placed.points_m, axis=1)
        assert len(distances_mm) > 300 and np.median(distances_mm) < 1e-6 and distances_mm.max() < 0.05


# ---- averaging


def test_a_cell_holds_the_weighted_mean_of_its_points():
    points = np.array([[0.0102, 0.0, 0.0], [0.0112, 0.0, 0.0], [0.5, 0.0, 0.0]])
    means = cell_means(points, np.array([4.0, 1.0, 1.0]), cell_mm=2.0)
    assert np.allclose(means, [[0.0104, 0.0, 0.0], [0.5, 0.0, 0.0]])


def test_unstated_uncertainty_weighs_like_the_largest():
    view = sphere_views()[0]
    sigma = np.full(view.depth_mm.shape, 2.0)
    sigma.ravel()[view.pixels[:2]] = 0.0, 0.5
    weights = point_weights([replace(view, sigma_mm=sigma)])[0]
    assert weights[:3].tolist() == [0.25, 4.0, 0.25]
    assert (point_weights([view])[0] == 1).all()


@pytest.mark.parametrize("far", [1e9, np.nan, np.inf])
def test_points_beyond_the_grid_are_refused(far):
    with pytest.raises(PredictionError, match="unit of the depth"):
        cell_means(np.array([[far, 0.0, 0.0]]), np.ones(1))


# ---- contradictions


def test_true_depth_is_not_contradicted():
    assert sum(flags.sum() for flags in contradicted(sphere_views())) == 0
    assert not contradicted(sphere_views()[:1])[0].any()


@pytest.mark.parametrize("offset_mm", [-ORDER_MM, -ORDER_MM / 2, 2 * ORDER_MM])
def test_wrong_orders_are_found_and_nothing_else(offset_mm):
    views = sphere_views()
    views[1], wrong = planted(views[1], offset_mm)
    flags = contradicted(views)
    assert wrong.sum() == 121 and (flags[1] == wrong).all()
    assert not any(flag.any() for number, flag in enumerate(flags) if number != 1)


def test_a_hole_contradicts_nothing():
    """Where a view has no answer inside its outline, it does not see through."""
    first, second = sphere_views()[:2]
    _, square = planted(second, ORDER_MM)
    holes = second.depth_mm.copy()
    holes.ravel()[second.pixels[square]] = 0
    for flags in contradicted([first, replace(second, depth_mm=holes)]):
        assert not flags.any()


# ---- the command


@dataclass(frozen=True)
class SphereRows:
    """Rows of the sphere, as the builder would make them."""

    def __call__(self, plan, folder):
        for sample, name, view in plan.samples:
            depth = sphere_mm(VIEW_DEGREES[VIEWS.index(view)])
            maps = (np.zeros(depth.shape, np.uint8), np.full(depth.shape, 255, np.uint8))
            measured = {"distance_mm": 1000 * RIG.standoff_m}
            yield Row(sample, name, view, {0: maps[0]}, depth, depth, measured, *maps)


def make_spheres(folder, views=VIEWS):
    plans = plan_shards("test", {"power_drill": [(f"power_drill_{view}", "power_drill", view) for view in views]})
    manifest = Manifest(
        origin="generated",
        generator={},
        settings={},
        rig=RIG.to_dict(),
        size=(SIZE, SIZE),
        stored="single_shot",
        exact=True,
        samples={},
        shards=[],
    )
    assemble(folder, Assembly(plans, SphereRows(), manifest), workers=1)
    write_ply(SolidMesh("power_drill", SPHERE.vertices + CENTRE_M, SPHERE.faces), folder / "meshes/power_drill.ply")
    return folder


@pytest.fixture(scope="module")
def spheres(tmp_path_factory):
    return make_spheres(tmp_path_factory.mktemp("spheres") / "dataset")


@pytest.fixture
def predictions(spheres, tmp_path):
    """True depth with an order too near in a square of one view."""
    folder = write_predictions(tmp_path / "predictions", DatasetFolder(spheres))
    wrong, _ = planted(sphere_views()[2], -ORDER_MM)
    np.save(folder / "power_drill_A120.npy", wrong.depth_mm)
    return folder


def fused(*arguments) -> int:
    return main(["fuse", *map(str, arguments)])


def test_fuse_writes_a_cloud_without_the_wrong_order(spheres, predictions, tmp_path, capsys):
    out = tmp_path / "out"
    assert fused(predictions, spheres, "--out", out) == 0
    counts = json.loads((out / FUSION_FILE).read_text())["objects"]["power_drill"]
    answered = sum(view.pixels.size for view in sphere_views())
    assert counts["contradicted_px"] == 121 and counts["answered_px"] == answered
    assert counts["contradicted_share"] == 121 / answered
    cloud = trimesh.load(out / "power_drill.ply")
    assert b"comment unit m (metres); object axes: z up" in (out / "power_drill.ply").read_bytes()
    assert counts["cloud_points"] == len(cloud.vertices) > 1000
    assert np.abs(np.linalg.norm(cloud.vertices - CENTRE_M, axis=1) - RADIUS_M).max() < 2e-3
    assert "other views contradict 121 of" in capsys.readouterr().out


def test_the_datasets_own_depth_is_not_contradicted(spheres, tmp_path, capsys):
    assert fused("depth_exact", spheres, "--object", "power_drill", "--out", tmp_path / "out") == 0
    assert "other views contradict 0 of" in capsys.readouterr().out


def test_a_method_without_answers_has_an_empty_cloud(spheres, predictions, tmp_path, capsys):
    for path in predictions.glob("*.npy"):
        np.save(path, np.zeros((SIZE, SIZE), np.float32))
    assert fused(predictions, spheres, "--out", tmp_path / "out") == 0
    counts = json.loads((tmp_path / "out" / FUSION_FILE).read_text())["objects"]["power_drill"]
    assert counts["cloud_points"] == counts["answered_px"] == 0 and counts["contradicted_share"] is None
    assert "element vertex 0" in (tmp_path / "out/power_drill.ply").read_text()
    assert "0 of 0 pixels with a depth (-)" in capsys.readouterr().out


def without_a_view(spheres, predictions, folder):
    (predictions / "power_drill_A60.npy").unlink()
    return predictions, spheres


def of_another_dataset(spheres, predictions, folder):
    return predictions, make_spheres(folder / "two", VIEWS[:2])


def of_another_size(spheres, predictions, folder):
    np.save(predictions / "power_drill_A0.npy", np.zeros((8, 8), np.float32))
    return predictions, spheres


def without_placement(spheres, predictions, folder):
    dataset = make_dataset(folder / "disks")
    return write_predictions(folder / "of-disks", dataset), dataset.path


def with_a_single_view(spheres, predictions, folder):
    return predictions, make_spheres(folder / "one", VIEWS[:1])


def without_description(spheres, predictions, folder):
    (predictions / "submission.yaml").unlink()
    return predictions, spheres


@pytest.mark.parametrize(
    "prepare, message",
    [
        (without_a_view, "power_drill_A60.npy: is missing"),
        (of_another_dataset, "is extra"),
        (of_another_size, "(8, 8)"),
        (without_placement, "no known placement"),
        (with_a_single_view, "one view only"),
        (without_description, "submission.yaml"),
    ],
)
def test_refusals(prepare, message, spheres, predictions, tmp_path, capsys):
    given, dataset = prepare(spheres, predictions, tmp_path)
    assert fused(given, dataset, "--out", tmp_path / "out") == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "options, message",
    [
        (("--object", "power_dril"), "power_drill"),
        (("--object", "mug"), "no object 'mug'"),
        (("--cell-mm", "0"), "--cell-mm"),
        (("--cell-mm", "nan"), "--cell-mm"),
        (("--split", "train"), "train"),
    ],
)
def test_refused_options(options, message, spheres, predictions, tmp_path, capsys):
    assert fused(predictions, spheres, "--out", tmp_path / "out", *options) == 2
    assert message in capsys.readouterr().err


def test_units_of_a_submission_are_read(spheres, predictions, tmp_path):
    for path in predictions.glob("*.npy"):
        np.save(path, np.load(path) / 1000)
    write_description(predictions, units="m")
    assert fused(predictions, spheres, "--out", tmp_path / "out") == 0
    counts = json.loads((tmp_path / "out" / FUSION_FILE).read_text())["objects"]["power_drill"]
    assert counts["contradicted_px"] == 121
    cloud = trimesh.load(tmp_path / "out/power_drill.ply")
    assert np.abs(np.linalg.norm(cloud.vertices - CENTRE_M, axis=1) - RADIUS_M).max() < 2e-3
