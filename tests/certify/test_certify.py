"""A simulated type test: gauges against closed forms, fits against trimesh, errors put in on purpose,
and the certificate."""

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from conftest import fpp_bench, refusal

from fpp_ml_bench.baselines.certify import gauges as module
from fpp_ml_bench.baselines.certify.certificate import certify, scenes_of, write_certificate
from fpp_ml_bench.baselines.certify.gauges import Gauge, TracedGauge, Volume, gauges
from fpp_ml_bench.baselines.certify.quantities import (
    QUANTITIES,
    corners_mm,
    fit_plane,
    fit_sphere,
    lengths_off_mm,
    measure,
)
from fpp_ml_bench.baselines.method import Method
from fpp_ml_bench.baselines.registry import load_method
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.errors import BuildError, PredictionError
from fpp_ml_bench.loaders.render.boards.captures import photograph_board
from fpp_ml_bench.loaders.render.boards.poses import board_poses, fitting_board
from fpp_ml_bench.loaders.render.raycast import PixelRays
from fpp_ml_bench.optics.named_rigs import paper_rig

RIG = paper_rig(480)
RAYS = RIG.camera.rays()


@pytest.fixture
def few(monkeypatch):
    """One gauge of each kind."""
    for name in ("SPHERES", "BARS", "PLANES", "OTHERS"):
        monkeypatch.setattr(module, name, 1)


def seen(gauge: Gauge) -> tuple[np.ndarray, np.ndarray]:
    """Which surface each pixel sees, and its depth in mm."""
    hits = TracedGauge(gauge).primary(PixelRays.of(RIG.camera))
    part, depth_mm = np.full(RAYS[0].shape, -1, np.int8), np.zeros(RAYS[0].shape)
    part.ravel()[hits.pixels] = gauge.part[hits.triangle]
    depth_mm.ravel()[hits.pixels] = hits.depth_m * MM_PER_M
    return part, depth_mm


def values_of(gauge: Gauge, depth_mm: np.ndarray | None = None) -> dict[str, float | None]:
    part, exact_mm = seen(gauge)
    depth_mm = exact_mm if depth_mm is None else depth_mm
    return dict(measure(gauge, part, exact_mm, depth_mm, RAYS).values)


def of_kind(kind: str) -> Gauge:
    return next(gauge for gauge in gauges(RIG) if gauge.kind == kind)


def test_all_gauges_are_in_the_volume_and_exact():
    volume = Volume.of(RIG)
    kinds: dict[str, int] = {}
    for gauge in gauges(RIG):
        assert volume.holds(gauge.mesh.vertices_m), gauge.name
        for symbol, value in values_of(gauge).items():
            limit = 1.5 if symbol == "E" else 1e-8
            assert value is not None and abs(value) < limit, (gauge.name, symbol)
        kinds[gauge.kind] = kinds.get(gauge.kind, 0) + 1
    assert kinds == {"sphere": 10, "ball bar": 7, "plane": 6, "step": 3, "wedge": 3}


@pytest.mark.parametrize("noise_mm", [0.0, 0.05])
def test_fits_are_those_of_trimesh(noise_mm):
    random = np.random.default_rng(3)
    away = random.normal(size=(300, 3)) * [1, 1, 0.6]
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    centre, radius = np.array([12.0, -7.0, 1800.0]), 60.0
    points = centre + radius * away + noise_mm * random.normal(size=(300, 3))
    fit = fit_sphere(points)
    if noise_mm == 0:
        theirs, their_radius, _ = trimesh.nsphere.fit_nsphere(points)
        np.testing.assert_allclose(fit.values, [*theirs, their_radius], rtol=0, atol=1e-6)
        np.testing.assert_allclose(fit.values, [*centre, radius], rtol=0, atol=1e-9)
    else:
        np.testing.assert_allclose(fit.values, [*centre, radius], rtol=0, atol=0.05)
    plane = np.column_stack([random.uniform(-90, 90, (300, 2)), np.zeros(300)])
    plane = plane @ trimesh.transformations.rotation_matrix(0.3, [1, 2, 0])[:3, :3].T + centre
    _, normal = trimesh.points.plane_fit(plane)
    ours = fit_plane(plane)
    assert abs(abs(ours.values[3:] @ normal) - 1) < 1e-12 and ours.range_mm < 1e-9


def test_three_in_a_thousand_points_are_rejected_and_no_more():
    points = np.column_stack([np.random.default_rng(0).uniform(-9, 9, (1000, 2)), np.zeros(1000)])
    points[:3, 2] = 40.0
    assert fit_plane(points).range_mm < 1e-9
    points[3, 2] = 40.0
    assert fit_plane(points).range_mm > 30


def test_errors_put_in_on_purpose_are_recovered():
    scale = 1.001
    bar, sphere, plane, step, wedge = map(of_kind, ("ball bar", "sphere", "plane", "step", "wedge"))
    spacing = MM_PER_M * np.linalg.norm(bar.surfaces[1].point_m - bar.surfaces[0].point_m)
    diameter = 2 * MM_PER_M * sphere.surfaces[0].radius_m
    assert values_of(bar, seen(bar)[1] * scale)["SD"] == pytest.approx(0.001 * spacing, abs=1e-6)
    assert values_of(sphere, seen(sphere)[1] * scale)["PS"] == pytest.approx(
        0.001 * diameter, abs=1e-6
    )
    # A sphere that is 50 um larger than its gauge says.
    (surface,) = sphere.surfaces
    larger = replace(surface, radius_m=surface.radius_m + 5e-5)
    part, depth_mm = seen(replace(sphere, surfaces=(larger,)))
    found = measure(sphere, part, depth_mm, depth_mm, RAYS).values
    assert found["PS"] == pytest.approx(0.1, abs=1e-6) and found["PF"] < 1e-6
    # A plane with a wave, a step that one order of the fringes lifts, a wedge that is stretched.
    exact_mm = seen(plane)[1]
    wave = np.where(exact_mm > 0, exact_mm + 0.2 * np.sin(RAYS[0] * 400), 0)
    assert values_of(plane, wave)["F"] == pytest.approx(0.4, rel=0.03)
    part, exact_mm = seen(step)
    assert values_of(step, np.where(part == 1, exact_mm - 90, exact_mm))["H"] > 80
    part, exact_mm = seen(wedge)
    flatter = np.where(exact_mm > 0, exact_mm.min(where=exact_mm > 0, initial=9e9), 0)
    assert values_of(wedge, np.where(part >= 0, (exact_mm + flatter) / 2, 0))["W"] > 10


def test_a_point_without_an_answer_is_refused_and_no_sphere_is_fitted_to_too_few_or_to_a_plane():
    sphere = of_kind("sphere")
    part, exact_mm = seen(sphere)
    half = np.where(RAYS[0] < sphere.surfaces[0].point_m[0] / 1.8, exact_mm, 0)
    result = measure(sphere, part, exact_mm, half, RAYS)
    assert result.refused == pytest.approx(0.5, abs=0.02) and abs(result.values["PS"]) < 1e-6
    none = measure(sphere, part, exact_mm, np.zeros_like(exact_mm), RAYS)
    assert none.refused == 1 and set(none.values.values()) == {None}
    flat = measure(sphere, part, exact_mm, np.full_like(exact_mm, exact_mm.max()), RAYS)
    assert flat.refused == 0 and set(flat.values.values()) == {None}


def test_corners_of_a_plane_and_their_distances_are_found():
    """A tilted plane: 1 / z is linear in the image, so that corners between pixels are exact."""
    x, y = RAYS
    z = 1.8e3 / (1 + 0.3 * x - 0.2 * y)
    points = np.stack([x * z, y * z, z], axis=-1)
    points[::7, ::5] = np.nan
    corners_px = np.array([[100.3, 120.7], [300.9, 130.2], [250.0, 400.4], [np.nan, 3.0]])
    found = corners_mm(corners_px, points, 8.0)
    u, v = RIG.camera.normalised(*corners_px[:3].T)
    true = 1.8e3 / (1 + 0.3 * u - 0.2 * v)
    np.testing.assert_allclose(found[:3], np.stack([u * true, v * true, true], axis=1), rtol=1e-9)
    assert np.isnan(found[3]).all()
    off = lengths_off_mm(found[:3] * 1.001, found[:3])
    assert off == pytest.approx(0.001 * np.linalg.norm(found[[1, 2, 2]] - found[[0, 0, 1]], axis=1))


@pytest.fixture(scope="module")
def boards(tmp_path_factory):
    folder = tmp_path_factory.mktemp("boards") / "poses"
    rig = paper_rig(360)
    board = fitting_board(rig)
    photograph_board(folder, rig, board, board_poses(rig, board)[:3])
    return folder, board


@pytest.mark.long
def test_a_real_board_is_a_gauge(boards, tmp_path):
    folder, board = boards
    words = ["certify", "classical", "--out", tmp_path, "--captures", folder]
    own = ["--rig", folder / "rig.yaml"]
    assert fpp_bench(*words, *own, "--board", board) == 0
    shown = json.loads((tmp_path / "certificate.json").read_text())
    lines = {line["symbol"]: line for line in shown["lines"]}
    assert set(lines) == {"F", "F95", "L"} and not shown["simulated"]
    assert abs(lines["L"]["largest"]) < 2 and lines["F95"]["largest"] < 6
    assert lines["F"]["positions"] == 3 and lines["F"]["expanded"] is None
    assert "Test on a board" in (tmp_path / "certificate.html").read_text()
    assert "--captures and --board: expected both or none" in refusal(fpp_bench, *words, *own)
    assert "needs --rig" in refusal(fpp_bench, *words, "--board", board)


class Far(Method):
    """Answers with a plane."""

    name, title, frames_used = "far", "far", (0,)

    def predict(self, frames):
        return np.full((RIG.camera.height, RIG.camera.width), 2000.0, np.float32)


@pytest.mark.long
def test_a_certificate_judges_by_its_limits_and_says_what_it_is(few, tmp_path):
    settings = scenes_of(RIG, "paper")
    limits = {"PS": 5.0, "PF": 1e-6, "SD": 5.0}
    test = certify(load_method("classical", RIG, steps=3), settings, "paper", 3, limits)
    lines = {line.symbol: line for line in test.lines}
    assert list(lines) == [symbol for symbol in QUANTITIES if symbol != "L"]
    assert [lines[symbol].verdict for symbol in ("PS", "PF", "SD", "F")] == [
        "within",
        "beyond",
        "within",
        "",
    ]
    assert abs(lines["PS"].largest) < 0.3 and 0 < lines["PF"].expanded < lines["PF"].largest
    page, data = write_certificate(test, tmp_path)
    text = page.read_text()
    assert "Nothing here is traceable" in text and "nothing conforms to a guideline" in text
    assert "conforms to VDI" not in text
    assert json.loads(data.read_text())["lines"][0]["symbol"] == "PF"


@pytest.mark.long
def test_a_method_that_does_not_look_is_found_out(few):
    test = certify(Far(RIG), scenes_of(RIG, "paper"), "paper", 2)
    lines = {line.symbol: line for line in test.lines}
    assert abs(lines["PS"].largest) > 30
    assert abs(lines["W"].largest) > 20 and lines["F"].largest == pytest.approx(0, abs=1e-3)


@pytest.mark.long
def test_what_cannot_be_tested_is_named(few, tmp_path):
    far = Far(RIG)
    far.units = "normalised"
    with pytest.raises(PredictionError, match="gauges are measured in mm"):
        certify(far, scenes_of(RIG, "paper"), "paper")
    far.units, far.uses_ground_truth_mask = "mm", True
    with pytest.raises(PredictionError, match="is given the object's mask"):
        certify(far, scenes_of(RIG, "paper"), "paper")
    constant = certify(
        load_method("constant", RIG, at="standoff"), scenes_of(RIG, "paper"), "paper", 1
    )
    assert constant.lines[0].largest > 10
    for option, value, said in (
        ("--limits", "PS:1", "--limits"),
        ("--limits", "PS=nan", "numbers above 0"),
        ("--limits", "PQ=1", "limit of PQ: expected one of PF, PF95"),
        ("--rig", tmp_path / "none.yaml", "none.yaml"),
    ):
        words = ["certify", "classical", "--out", tmp_path / "out", option, value]
        assert said in refusal(fpp_bench, *words)
    beside = replace(RIG, projector=replace(RIG.projector, cx=RIG.projector.cx + 3000))
    with pytest.raises(BuildError, match="fits nowhere in the measuring volume"):
        list(gauges(beside))
