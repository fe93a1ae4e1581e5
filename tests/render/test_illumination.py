"""Brightness against closed forms, and whole views: what is lit, what is dark, what is decoded and how well."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from fpp_ml_bench.decoding import decode_stack
from fpp_ml_bench.depth import edge_distance_px, object_mask
from fpp_ml_bench.loaders.render.illumination import background_plane, in_pattern, light_surface, projector_centre_m
from fpp_ml_bench.loaders.render.raycast import TracedObject
from fpp_ml_bench.loaders.render.scene import BuildSettings, Lighting, SolidMesh
from fpp_ml_bench.loaders.render.sensor import Exposure, Noise
from fpp_ml_bench.loaders.render.view import Studio, ground_truth_error
from fpp_ml_bench.machine import NUMBA_SWITCH as SWITCH
from fpp_ml_bench.optics import paper_rig

RIG = paper_rig(176)
X, Y = RIG.camera.rays()
MATTE = Lighting(specular=0.0)
CENTRE = np.array([-0.125, 0.1, 0.0])  # of the projector in the camera's frame, from rig.md's coordinates
TOWARD_CAMERA = np.array([0.0, 0.0, -1.0])


def plane(z_m):
    points = np.column_stack([X.ravel(), Y.ravel(), np.ones(X.size)]) * z_m
    return points, np.broadcast_to(TOWARD_CAMERA, points.shape)


def solid(mesh):
    return SolidMesh("thing", np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces, dtype=np.int32))


def studio(**changes):
    return Studio(BuildSettings(**{"rig": RIG, "objects": ("mug",), "noise_sigma_grey": 0.0, **changes}))


def test_projector_centre_is_where_the_rig_says():
    np.testing.assert_allclose(projector_centre_m(RIG), CENTRE, atol=1e-15)


@pytest.mark.parametrize("z_m", [1.5, 1.8, 2.1, 3.2])
def test_matte_plane_follows_cosine_and_inverse_square(z_m):
    points, normals = plane(z_m)
    lit = light_surface(points, normals, RIG, MATTE)
    distance = np.sqrt((points[:, 0] + 0.125) ** 2 + (points[:, 1] - 0.1) ** 2 + z_m**2)
    expected = MATTE.white_grey * (1.5 / distance) ** 2 * (z_m / distance)
    u, v = RIG.project(points)
    outside = (u < -0.5) | (u > 911.5) | (v < -0.5) | (v > 1139.5)
    expected[outside] = 0
    np.testing.assert_allclose(lit.gain, expected, rtol=1e-6)
    assert (lit.ambient == np.float32(MATTE.ambient_grey)).all()
    assert not outside.all()


def test_inverse_square_along_one_line_of_light():
    direction = np.array([0.1, -0.02, 1.0])
    distances = np.array([1.5, 1.7, 2.1])
    points = CENTRE + direction / np.linalg.norm(direction) * distances[:, None]
    gain = light_surface(points, np.tile(TOWARD_CAMERA, (3, 1)), RIG, MATTE).gain
    np.testing.assert_allclose(gain * distances**2, gain[0] * 1.5**2, rtol=1e-6)


def test_cosine_law_of_a_turned_patch():
    point = np.array([[0.0, 0.0, 1.8]])
    toward = CENTRE - point[0]
    distance = np.linalg.norm(toward)
    toward /= distance
    side = np.cross(toward, [0, 1, 0])
    side /= np.linalg.norm(side)
    for degrees in (0, 30, 60, 85, 89.9, 90.1, 120):
        a = np.radians(degrees)
        gain = light_surface(point, (np.cos(a) * toward + np.sin(a) * side)[None], RIG, MATTE).gain[0]
        expected = MATTE.white_grey * (1.5 / distance) ** 2 * max(np.cos(a), 0)
        assert gain == pytest.approx(expected, rel=1e-5, abs=1e-6)


def test_specular_part_is_weak_and_adds_where_the_mirror_direction_is():
    points, normals = plane(1.8)
    shiny, matte = (light_surface(points, normals, RIG, Lighting(specular=s)).gain for s in (0.15, 0.0))
    seen = matte > 0
    ratio = shiny[seen] / matte[seen]
    assert ratio.max() <= 1 + 1e-6 and ratio.min() > 0.85
    # Brightest (relative to matte) where the half vector is the normal: halfway between the two centres.
    best = points[seen][ratio.argmax()]
    np.testing.assert_allclose(best[:2], CENTRE[:2] / 2, atol=1.8 / RIG.camera.fx)
    assert ratio.max() == pytest.approx(1.0, abs=1e-4)


def test_pixels_off_the_pattern_get_ambient_light_only():
    points, normals = plane(1.5)
    u, v = RIG.project(points)
    lit = light_surface(points, normals, RIG, Lighting())
    off = ~((u >= -0.5) & (u <= 911.5) & (v >= -0.5) & (v <= 1139.5))
    assert 100 < off.sum() < off.size / 2
    assert (lit.gain[off] == 0).all() and (lit.gain[~off] > 0).all()
    white = Exposure.of(RIG, Noise.of_sigma(0)).expose([51], lit, np.arange(off.size, dtype=np.uint32), (1, "a", "A0"))[
        0
    ]
    assert (white[off] == 6).all() and (white[~off] > 100).all()
    inside = in_pattern(np.array([-0.5, 911.5, -0.51, np.nan]), np.array([0.0, 1139.5, 0, 0]), RIG)
    assert inside.tolist() == [True, True, False, False]


def test_rays_that_see_nothing_stay_dark():
    points, normals = plane(2.0)
    points = points.copy()
    points[:10] = np.nan
    lit = light_surface(points, normals, RIG, Lighting())
    assert (lit.gain[:10] == 0).all() and (lit.ambient[:10] == 0).all()
    assert np.isfinite(lit.gain).all()
    read = Exposure.of(RIG, Noise.of_sigma(0)).expose([51], lit, np.arange(X.size, dtype=np.uint32), (1, "a", "A0"))[0]
    assert (read[:10] == 0).all()


def test_nothing_in_range_saturates_at_the_defaults():
    """Any surface from 1.5 m on, turned any way, white pattern, default noise: below 255 on every pixel."""
    rng = np.random.default_rng(1)
    depth = rng.uniform(1.5, 2.1, X.size)
    depth[: X.size // 4] = 1.5
    points = np.column_stack([X.ravel(), Y.ravel(), np.ones(X.size)]) * depth[:, None]
    toward = CENTRE - points  # the brightest a patch can be
    normals = toward / np.linalg.norm(toward, axis=1, keepdims=True)
    lit = light_surface(points, normals, RIG, Lighting())
    assert (lit.gain + lit.ambient).max() < 235
    exposure = Exposure.of(RIG, Noise.of_sigma(1.0))
    for seed in range(5):
        read = exposure.expose([0, 51], lit, np.arange(X.size, dtype=np.uint32), (seed, "a", "A0"))
        assert read.max() < 250


def test_background_plane_is_dimmer_than_the_object_but_lit():
    lit = background_plane(RIG, Lighting())
    gain = lit.gain.reshape(X.shape)
    assert 30 < gain[88, 88] < 60  # (1.5 / 3.2)^2 of 225


# ---- whole views


def test_shadows_off_traces_no_shadow_ray_and_on_darkens_what_is_hidden():
    mesh = solid(trimesh.util.concatenate(
        [trimesh.creation.box((0.02, 0.3, 0.3)).apply_translation([0.1, 0, 0]),
         trimesh.creation.box((0.02, 0.06, 0.06)).apply_translation([-0.1, 0.0, 0])]
    ))  # fmt: skip
    without, shaded = studio(), studio(shadows=True)
    plain = without.photograph(mesh, "A0")
    white, depth = plain.frames[51].copy(), plain.depth_exact_mm.copy()
    assert plain.measured["shadow_rays"] == 0
    row = shaded.photograph(mesh, "A0")
    # Shadow rays start on the object and, behind it, where it can cast a shadow; nowhere else.
    assert (depth > 0).sum() / 2 < row.measured["shadow_rays"] < X.size / 2
    np.testing.assert_array_equal(row.depth_exact_mm, depth)
    dark = white.astype(int) - row.frames[51] > 20
    # By hand: the wall's front is at 1.89 m, the block spans 1.69 to 1.71 m; lines from the light through the block.
    points = np.stack([X, Y, np.ones_like(X)], axis=-1) * depth[..., None] / 1000
    wall = np.abs(depth - 1890) < 0.01
    hidden = np.zeros(X.shape, dtype=bool)
    surely_lit = np.ones(X.shape, dtype=bool)
    for z in np.linspace(1.69, 1.71, 21):
        at = CENTRE + (points - CENTRE) * (z / np.maximum(points[..., 2:], 1e-9))
        size = np.abs(at[..., :2]).max(axis=-1)
        hidden |= size < 0.03 - 1e-3
        surely_lit &= size > 0.03 + 1e-3
    assert (wall & hidden).sum() > 60
    assert dark[wall & hidden].all()
    assert not dark[wall & surely_lit].any()
    assert (row.frames[51][wall & hidden] == 6).all()
    # The block's and the wall's shadows fall on the background plane too, and nothing there is brighter than before.
    background = depth == 0
    assert dark[background].sum() > 100
    assert (row.frames[51].astype(int) <= white).all()
    # Hidden surface has no ground truth, and it is counted.
    assert (row.depth_mm[wall & hidden] == 0).all()
    assert row.measured["undecoded_px"] >= (wall & hidden).sum()


def noise_sigma_mm(rig, gain, ambient, depth_m, sigma_grey, steps):
    """sigma_Z of one direction by rig.md's formulas; B and the noise at the mean grey level of each pixel."""
    modulation = gain / 2
    mean = ambient + gain / 2
    sigma = np.sqrt(sigma_grey**2 / 2 * (1 + mean / 127.5) + 1 / 12)
    sigma_phi = np.sqrt(2 / steps) * sigma / modulation
    out = {}
    for direction, baseline, focal in (("vertical", 0.125, 1824.0), ("horizontal", 0.1, 1824.0)):
        sigma_u = rig.pitch(direction) * sigma_phi / (2 * np.pi)
        out[direction] = 1000 * sigma_u * depth_m**2 / (focal * baseline)
    return out


@pytest.mark.parametrize("shape", ["plane", "sphere"])
@pytest.mark.parametrize("sigma_grey", [1.0, 4.0])
def test_decoded_depth_is_within_theory_of_the_exact_depth(shape, sigma_grey):
    if shape == "plane":
        mesh = trimesh.creation.box((0.05, 0.25, 0.25))
    else:
        mesh = trimesh.creation.icosphere(5, 0.12)
    at = studio(noise_sigma_grey=sigma_grey)
    frames_all = np.stack([at.photograph(solid(mesh), "A0").frames[i] for i in range(52)])
    row = at.photograph(solid(mesh), "A0")
    exact = row.depth_exact_mm
    inside = edge_distance_px(exact) >= 4
    inside &= object_mask(exact)
    white, black = frames_all[51].astype(float), frames_all[50].astype(float)
    bright = inside & (white - black > 60)
    assert bright.sum() > 300
    expected = noise_sigma_mm(RIG, (white - black)[bright], black[bright], exact[bright] / 1000, sigma_grey, 18)
    for direction in ("vertical", "horizontal"):
        decoded = decode_stack(frames_all, RIG, direction=direction, mask=object_mask(exact))
        error = decoded.depth_mm[bright].astype(float) - exact[bright]
        assert (decoded.depth_mm[bright] > 0).all()
        # The pattern's own rounding to 8 bit and its bilinear blend add a little to the noise of the sensor.
        ratio = np.sqrt((error**2).mean() / (expected[direction] ** 2).mean())
        assert 0.9 < ratio < 1.2
        assert abs(error.mean()) < 4 * expected[direction].mean() / np.sqrt(bright.sum()) + 0.05
    both = row.depth_mm[bright].astype(float) - exact[bright]
    # Least squares of both directions: inverse variances add.
    combined = 1 / np.sqrt(1 / expected["vertical"] ** 2 + 1 / expected["horizontal"] ** 2)
    assert 0.9 < np.sqrt((both**2).mean() / (combined**2).mean()) < 1.2


def test_without_noise_ground_truth_is_nearly_exact():
    row = studio().photograph(solid(trimesh.creation.icosphere(4, 0.12)), "A0")
    inside = (edge_distance_px(row.depth_exact_mm) >= 4) & object_mask(row.depth_exact_mm)
    error = np.abs(row.depth_mm - row.depth_exact_mm)[inside & (row.depth_mm > 0)]
    assert error.max() < 1.0 and error.mean() < 0.12  # 8 bit leaves 0.29 grey levels RMS


def test_depth_never_guesses():
    """What the camera can't see of the pattern has no decoded depth: such pixels are 0 and counted."""
    mesh = trimesh.util.concatenate(
        [trimesh.creation.box((0.02, 0.1, 0.1)),
         trimesh.creation.box((0.3, 0.002, 0.3)).apply_translation([0, 0.11, 0])]  # a fin turned away from the light
    )  # fmt: skip
    at = studio(noise_sigma_grey=1.0)
    row = at.photograph(solid(mesh), "A0")
    exact, depth = object_mask(row.depth_exact_mm), object_mask(row.depth_mm)
    assert not (depth & ~exact).any()
    assert row.measured["exact_px"] == exact.sum()
    assert row.measured["undecoded_px"] == (exact & ~depth).sum()
    unlit = exact & (row.frames[51].astype(int) - row.frames[50] < 4)
    assert unlit.sum() > 10
    assert not depth[unlit].any()
    assert np.isfinite(row.depth_mm).all() and (row.depth_mm >= 0).all()


def test_ground_truth_error_by_hand():
    exact = np.zeros((20, 20), np.float32)
    exact[4:16, 4:16] = 1800
    decoded = exact.copy()
    decoded[4, 4:16] = 0  # twelve pixels of the rim
    decoded[10, 10] += 3
    decoded[5, 5] -= 1
    errors = ground_truth_error(decoded, exact)
    assert errors["exact_px"] == 144 and errors["undecoded_px"] == 12
    assert errors["gt_mae_mm"] == pytest.approx(4 / 132)
    assert errors["gt_rmse_mm"] == pytest.approx(np.sqrt(10 / 132))
    assert errors["gt_bias_mm"] == pytest.approx(2 / 132)
    assert errors["gt_max_mm"] == 3
    assert errors["gt_interior_px"] == 36  # 12 - 2 x 3 px on each side
    assert errors["gt_interior_mae_mm"] == pytest.approx(3 / 36)
    empty = ground_truth_error(np.zeros_like(exact), exact)
    assert empty["gt_mae_mm"] is None and empty["gt_max_mm"] is None and empty["undecoded_px"] == 144


def test_a_view_is_the_same_with_and_without_numba(monkeypatch):
    mesh = solid(trimesh.creation.icosphere(3, 0.12))
    rows = {}
    for switch in ("1", "0"):
        monkeypatch.setenv(SWITCH, switch)
        rows[switch] = studio(noise_sigma_grey=1.0).photograph(mesh, "A60")
    for index, frame in rows["1"].frames.items():
        np.testing.assert_array_equal(frame, rows["0"].frames[index])
    np.testing.assert_array_equal(rows["1"].depth_exact_mm, rows["0"].depth_exact_mm)
    np.testing.assert_array_equal(rows["1"].depth_mm, rows["0"].depth_mm)


def test_storing_fewer_frames_changes_no_byte_of_the_rest():
    mesh = solid(trimesh.creation.icosphere(3, 0.12))
    whole = studio(noise_sigma_grey=1.0).photograph(mesh, "A120")
    for stored in ("single_shot", "vertical", "sinusoidal"):
        row = studio(noise_sigma_grey=1.0, stored=stored).photograph(mesh, "A120")
        np.testing.assert_array_equal(row.depth_mm, whole.depth_mm)
        np.testing.assert_array_equal(row.depth_exact_mm, whole.depth_exact_mm)
        for index, frame in row.frames.items():
            np.testing.assert_array_equal(frame, whole.frames[index])


def test_seed_changes_the_frames_but_not_the_exact_depth():
    mesh = solid(trimesh.creation.icosphere(3, 0.12))
    first, second = (studio(noise_sigma_grey=1.0, seed=s).photograph(mesh, "A0") for s in (1, 2))
    np.testing.assert_array_equal(first.depth_exact_mm, second.depth_exact_mm)
    for index in first.frames:
        share = (first.frames[index] != second.frames[index]).mean()
        assert share > 0.3


def test_lens_distortion_of_the_camera_moves_the_picture_and_is_taken_out_again():
    bent = replace(RIG, camera=replace(RIG.camera, distortion=(-0.2, 0.05, 0.001, -0.001, 0.0)))
    mesh = solid(trimesh.creation.box((0.05, 0.25, 0.25)))
    row = Studio(BuildSettings(rig=bent, objects=("mug",), noise_sigma_grey=0.5)).photograph(mesh, "A0")
    inside = (edge_distance_px(row.depth_exact_mm) >= 4) & object_mask(row.depth_mm)
    np.testing.assert_allclose(row.depth_exact_mm[inside], 1775, atol=1e-3)
    assert np.abs(row.depth_mm[inside] - 1775).mean() < 0.2


def test_traced_object_is_only_asked_for_shadows_when_wanted(monkeypatch):
    def never(*_):
        raise AssertionError("a shadow ray was traced")

    monkeypatch.setattr(TracedObject, "shadowed", never)
    studio().photograph(solid(trimesh.creation.icosphere(2, 0.1)), "A0")
    with pytest.raises(AssertionError, match="shadow ray"):
        studio(shadows=True).photograph(solid(trimesh.creation.icosphere(2, 0.1)), "A0")
