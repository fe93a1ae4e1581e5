"""Pixels with an area: which mix surfaces, in which shares, and what they see; the lens's blur and
vignetting."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from rendering import DIRECT, PAPER, RIG, X, Y, kept, sheet, solid, studio
from scipy.ndimage import convolve1d

from fpp_ml_bench.loaders.render.pixels import blur_image, mixed_pixels
from fpp_ml_bench.loaders.render.raycast import PixelRays, TracedObject
from fpp_ml_bench.loaders.sample import Flag
from fpp_ml_bench.portable import gaussian_weights

FOCAL_PX, MIDDLE_PX = RIG.camera.fx, RIG.camera.cx
WHITE = RIG.sequence.white


def plate(left_px, right_px, top_px=20.0, bottom_px=150.0, z_m=1.8):
    """A sheet square to the axis that covers pixel edges ``left_px`` to ``right_px`` of the
    image."""
    x0, x1, y0, y1 = (
        (edge - MIDDLE_PX) / FOCAL_PX * z_m for edge in (left_px, right_px, top_px, bottom_px)
    )
    return [x0, y0, z_m], [x1 - x0, 0, 0], [0, y1 - y0, 0]


def mixed(mesh, at_m=(0.0, 0.0, 0.0), across=4, rig=RIG):
    """What the central rays see of a mesh, and its mixed pixels."""
    traced = TracedObject(mesh, np.add(mesh.vertices_m, at_m))
    hits = traced.primary(PixelRays.of(rig.camera))
    return hits, mixed_pixels(traced, hits, rig, across)


def image_of(pixels, values, rest=0.0):
    image = np.full(X.size, rest)
    image[pixels] = values
    return image.reshape(X.shape)


@pytest.mark.parametrize(("across", "quarters"), [(2, 2), (4, 1), (4, 3)])
def test_a_pixel_that_is_partly_covered(across, quarters):
    """The left edge of a sheet runs ``quarters`` quarters from the right side of the pixels of
    column 60."""
    sides = plate(60.5 - quarters / 4 + 0.01, 120.49, 20.51, 150.49)
    hits, found = mixed(sheet(sides), across=across)
    cover = image_of(found.pixels, (found.triangle >= 0).reshape(-1, across**2).mean(axis=1))
    assert (cover[21:151, 60] == quarters / 4).all()
    assert np.count_nonzero(cover) == 130  # no other pixel mixes
    assert image_of(found.pixels, found.void).sum() == 130
    # The share is that of what the central ray sees: the sheet if it covers the middle.
    central = image_of(hits.pixels, 1.0)[21, 60]
    assert central == (quarters / 4 + 0.01 > 0.5 + 0.01)
    np.testing.assert_array_equal(found.share, quarters / 4 if central else 1 - quarters / 4)


def test_a_half_covered_pixel_has_the_mean_light():
    light = DIRECT.changed("camera", rays_across=2)
    at = studio(light)
    edge_m = (60.0 - 0.001 - MIDDLE_PX) / FOCAL_PX * 1.8
    thin = solid(trimesh.creation.box((1e-5, 0.2, 0.25)).apply_translation([0, -edge_m - 0.1, 0]))
    row = at.photograph(thin, "A0")
    frame, cover = kept(row)[WHITE].astype(float), row.cover
    rows = slice(65, 110)
    left, here, right = frame[rows, 59], frame[rows, 60], frame[rows, 61]
    assert (right - left).min() > 60
    # The neighbours are a pixel away, over which light changes by less than 0.2 grey levels; each
    # is rounded.
    assert np.abs(here - (left + right) / 2).max() <= 1.3
    assert abs((here - (left + right) / 2).mean()) < 0.3
    assert (cover[rows, 60] == 128).all() and (cover[rows, [59]] == 255).all()
    assert (row.flags[rows, 60] == Flag.MIXED).all() and (row.flags[rows, 58:60] == 0).all()
    assert (row.flags[rows, 61:64] == 0).all()


def test_a_tilted_plane_mixes_nothing():
    for slope in (0.0, 0.5, 2.0):
        rays = np.array([[-0.3, -0.3, 1], [0.3, -0.3, 1], [0.3, 0.3, 1], [-0.3, 0.3, 1]])
        vertices = rays * (
            1.8 / (1 - slope * rays[:, :1])
        )  # z = 1.8 + slope x, beyond the image all around
        mesh = replace(sheet(plate(0, 1)), vertices_m=vertices)
        hits, found = mixed(mesh, across=3)
        assert hits.pixels.size == X.size and found.pixels.size == 0


def test_a_step_mixes_from_two_millimetres_on():
    for step_mm, found_px in ((1.9, 0), (2.1, 100)):
        near = plate(40.49, 90.2, 30.51, 130.49, 1.8)
        far = plate(80.0, 140.49, 30.51, 130.49, 1.8 + step_mm / 1000)
        _, found = mixed(sheet(near, far))
        assert found.void.sum() == found_px
        assert (found.pixels % 176 == 90).all() and (found.triangle >= 0).all()


def test_an_edge_mixes_light_but_not_depth():
    """Two sides of a ridge meet at an angle: pixels across the edge see both, and it is no void."""
    turn = trimesh.transformations.rotation_matrix(np.pi / 4, [0, 1, 0])
    _, found = mixed(solid(trimesh.creation.box((0.2, 0.2, 0.2), turn)), (0.0011, 0.0, 1.8))
    middle = found.pixels[np.abs(X.ravel()[found.pixels]) < 0.01]
    ridge = ~found.void[np.isin(found.pixels, middle)]
    assert ridge.sum() > 40
    # Of these pixels' rays some see the left side, some the right, and all are on the object.
    of = np.isin(found.pixels, middle[ridge])
    normals = found.normals.reshape(-1, 16, 3)[of]
    across = normals[:, :, 0]
    assert (across.min(axis=1) < -0.7).all() and (across.max(axis=1) > 0.7).all()
    assert (found.share[of] == 1).all()


def test_all_of_nothing_and_nothing_of_all():
    hits, found = mixed(sheet(plate(300, 400)))  # beside the image
    assert hits.pixels.size == 0 and found.pixels.size == 0 and found.points_m.shape == (0, 3)
    hits, found = mixed(sheet(plate(-10, 200, -10, 200)))
    assert hits.pixels.size == X.size and found.pixels.size == 0


def test_a_lens_with_distortion_keeps_rays_in_their_pixel():
    bent = replace(RIG, camera=replace(RIG.camera, distortion=(-0.2, 0.05, 0.001, -0.001, 0.0)))
    ball = solid(trimesh.creation.icosphere(4, 0.15))
    _, found = mixed(ball, (0.1, 0.05, 1.8), 3, bent)
    u, v = bent.camera.project(found.points_m)
    row, column = np.divmod(np.repeat(found.pixels, 9), 176)
    assert found.void.all() and found.pixels.size > 100
    assert np.abs(u - column).max() < 0.334 and np.abs(v - row).max() < 0.334


# ---- lens


@pytest.mark.parametrize("sigma", [0.4, 3.0])
def test_blur_is_convolution_along_both_axes(sigma):
    image = np.random.default_rng(0).uniform(0, 255, (41, 53)).astype(np.float32)
    weights = gaussian_weights(sigma**2, 3.0).astype(np.float32)
    expected = image.astype(float)
    for axis in (0, 1):
        expected = convolve1d(expected, weights.astype(float), axis, mode="nearest")
    blur_image(image, weights, np.empty_like(image))
    np.testing.assert_allclose(image, expected, rtol=2e-6)
    x = np.arange(weights.size) - weights.size // 2
    assert (weights * x**2).sum() == pytest.approx(sigma**2, rel=0.03)  # cut off at three sigma
    assert weights.sum() == pytest.approx(1, abs=1e-6)


def test_lens_and_vignetting_reach_the_frames():
    ball = solid(trimesh.creation.icosphere(4, 0.12))
    sharp = kept(studio(PAPER).photograph(ball, "A0"))[WHITE].astype(float)
    soft = studio(PAPER.changed("camera", blur_px=1.5))
    blurred = kept(soft.photograph(ball, "A0"))[WHITE]
    expected = sharp
    for axis in (0, 1):
        expected = convolve1d(expected, gaussian_weights(2.25, 3.0), axis=axis, mode="nearest")
    assert np.abs(blurred - expected).max() <= 1.01  # both are rounded
    darker = kept(studio(PAPER.changed("camera", falloff=4)).photograph(ball, "A0"))[WHITE]
    cosine = 1 / np.sqrt(X**2 + Y**2 + 1)
    assert np.abs(darker - sharp * cosine**4).max() <= 1.01
