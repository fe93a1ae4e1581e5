"""Whole views: what is lit, dark, flagged and decoded, how well, and what is left out without
changing a byte."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
import trimesh
from edges import edge_distance_px
from rendering import CENTRE, DIRECT, PAPER, RIG, X, Y, kept, sheet, solid, studio
from scipy import stats

from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.loaders.render import lighting
from fpp_ml_bench.loaders.render.light import named_light
from fpp_ml_bench.loaders.render.view import ground_truth_error
from fpp_ml_bench.loaders.sample import WEAK_GREY, Flag
from fpp_ml_bench.optics.named_rigs import CROSSED
from fpp_ml_bench.optics.sequence import Sequence
from fpp_ml_bench.skipping import skipping

BALL = solid(trimesh.creation.icosphere(3, 0.12))
RAYS = np.stack([X, Y, np.ones_like(X)], axis=-1)
SHADOWS = DIRECT.changed("bounces", shadows=True)
SMALL = replace(RIG, sequence=Sequence(steps=3))
"""Fewer frames, where their number doesn't matter."""


def flagged(row, flag):
    return (row.flags & flag) > 0


def levels(row):
    """Grey levels of the white frame and of the black one."""
    return (row.frames[index].astype(float) for index in (RIG.sequence.white, RIG.sequence.black))


def test_shadows_off_traces_no_shadow_ray_and_on_darkens_what_is_hidden():
    wall = trimesh.creation.box((0.02, 0.3, 0.3)).apply_translation([0.1, 0, 0])
    block = trimesh.creation.box((0.02, 0.06, 0.06)).apply_translation([-0.1, 0.0, 0])
    mesh = solid(trimesh.util.concatenate([wall, block]))
    without, shaded = studio(), studio(SHADOWS)
    plain = without.photograph(mesh, "A0")
    white, depth = plain.frames[51].copy(), plain.depth_exact_mm.copy()
    assert plain.measured["shadow_rays"] == 0
    row = shaded.photograph(mesh, "A0")
    # Shadow rays start on the object, and on the background where the object can cast a shadow;
    # nowhere else.
    scene = shaded.trace(mesh, "A0")
    behind = row.measured["shadow_rays"] - scene.lit.shadow_rays
    assert 500 < behind < X.size / 10
    np.testing.assert_array_equal(row.depth_exact_mm, depth)
    dark = white.astype(int) - row.frames[51] > 20
    # By hand: the wall's front is at 1.89 m, the block spans 1.69 to 1.71 m; lines from the light
    # through the block.
    points = RAYS * depth[..., None] / 1000
    wall = np.abs(depth - 1890) < 0.01
    hidden, surely_lit = np.zeros(X.shape, dtype=bool), np.ones(X.shape, dtype=bool)
    for z in np.linspace(1.69, 1.71, 21):
        at = CENTRE + (points - CENTRE) * (z / np.maximum(points[..., 2:], 1e-9))
        size = np.abs(at[..., :2]).max(axis=-1)
        hidden |= size < 0.03 - 1e-3
        surely_lit &= size > 0.03 + 1e-3
    assert (wall & hidden).sum() > 60
    assert dark[wall & hidden].all()
    assert not dark[wall & surely_lit].any()
    assert (row.frames[51][wall & hidden] == 6).all()
    # The block's and the wall's shadows fall on the background plane too, and nothing there is
    # brighter than before.
    background = depth == 0
    assert dark[background].sum() > 100
    assert (row.frames[51].astype(int) <= white).all()
    # Hidden surface is flagged, has no ground truth, and it is counted.
    assert flagged(row, Flag.UNLIT)[wall & hidden].all()
    assert (row.depth_mm[wall & hidden] == 0).all()
    assert row.measured["undecoded_px"] >= (wall & hidden).sum()


def test_without_noise_ground_truth_is_nearly_exact():
    row = studio().photograph(solid(trimesh.creation.icosphere(4, 0.12)), "A0")
    inside = (edge_distance_px(row.depth_exact_mm) >= 4) & object_mask(row.depth_exact_mm)
    error = np.abs(row.depth_mm - row.depth_exact_mm)[inside & (row.depth_mm > 0)]
    assert error.max() < 1.0 and error.mean() < 0.12  # 8 bit leaves 0.29 grey levels RMS


def test_ground_truth_error_by_hand():
    exact = np.zeros((20, 20), np.float32)
    exact[4:16, 4:16] = 1800
    decoded = exact.copy()
    decoded[4, 4:16] = 0  # twelve pixels of the rim
    decoded[10, 10] += 3
    decoded[5, 5] -= 1
    flags = np.zeros(exact.shape, np.uint8)
    errors = ground_truth_error(decoded, exact, flags)
    assert errors["exact_px"] == 144 and errors["undecoded_px"] == 12
    assert errors["gt_mae_mm"] == pytest.approx(4 / 132)
    assert errors["gt_rmse_mm"] == pytest.approx(np.sqrt(10 / 132))
    assert errors["gt_bias_mm"] == pytest.approx(2 / 132)
    assert errors["gt_max_mm"] == 3
    assert errors["gt_interior_px"] == 36  # 12 - 2 x 3 px on each side
    assert errors["gt_interior_mae_mm"] == pytest.approx(3 / 36)
    empty = ground_truth_error(np.zeros_like(exact), exact, flags)
    assert (
        empty["gt_mae_mm"] is None and empty["gt_max_mm"] is None and empty["undecoded_px"] == 144
    )


# ---- stages


GROOVE = sheet(
    ([0, 0, -0.1], [-0.1, 0.1, 0], [0, 0, 0.2]), ([0, 0, -0.1], [-0.1, -0.1, 0], [0, 0, 0.2])
)
"""Two squares at a right angle that opens to the camera in view A0."""


def test_what_faces_away_from_the_projector_is_unlit():
    """The side of a box that the camera sees, and the projector, further to the left, does not."""
    right = solid(trimesh.creation.box((0.1, 0.1, 0.2)).apply_translation([0.0, 0.12, 0.0]))
    row = studio().photograph(right, "A0")
    exact = row.depth_exact_mm
    # By hand: the front is at 1.75 m; the side at x = -0.07 m faces the camera's axis and turns its
    # back on the light.
    side = (exact > 1750.5) & (np.abs(X * exact / 1000 + 0.07) < 1e-6)
    assert side.sum() > 20
    np.testing.assert_array_equal(flagged(row, Flag.UNLIT), side)
    assert (row.frames[RIG.sequence.white][side] == 6).all()  # ambient light


def test_groove_is_flagged_where_light_comes_from_the_other_side():
    """Bounces over direct light, in the groove: more than a quarter at its bottom, less at its rim,
    by Lambert's formula a point x of the way up an endless right-angled side gets (1 - x / sqrt(1 +
    x^2)) / 2 of the other."""
    row = studio(PAPER).photograph(GROOVE, "A0")
    seen, strong = row.depth_exact_mm > 0, flagged(row, Flag.INTERREFLECTION)
    inside = seen & (np.abs(Y) < 0.02)
    bottom, rim = inside & (np.abs(X) < 0.01), inside & (np.abs(X) > 0.045)
    assert bottom.sum() > 50 and rim.sum() > 50
    assert strong[bottom].all() and not strong[rim].any()
    plain = studio(DIRECT).photograph(GROOVE, "A0")
    assert not flagged(plain, Flag.INTERREFLECTION).any()


def test_saturation_is_flagged_where_white_is_at_the_end_of_the_range():
    bright = DIRECT.changed("camera", exposure=2.2, black_grey=5.0)
    row = studio(bright).photograph(BALL, "A0")
    seen, white = row.depth_exact_mm > 0, row.frames[RIG.sequence.white]
    saturated = flagged(row, Flag.SATURATED)
    assert 100 < saturated.sum() < seen.sum() and (white[saturated] == 255).all()
    rounded = (white[seen & ~saturated] == 255).sum()  # 254.5 is rounded to 255
    assert rounded < 0.05 * saturated.sum()
    assert not flagged(studio().photograph(BALL, "A0"), Flag.SATURATED).any()


def test_weak_light_is_flagged_by_half_of_what_white_adds_to_black():
    """Without noise: the rim of the ball, which is turned away, and most of it under a tenth of the
    light."""
    dim = DIRECT.changed("camera", full_well_e=None, read_noise_e=0.0)
    for light, least, most in ((dim, 0.001, 0.1), (dim.changed("camera", exposure=0.1), 0.2, 0.99)):
        row = studio(light).photograph(BALL, "A0")
        weak, unlit = flagged(row, Flag.WEAK), flagged(row, Flag.UNLIT)
        seen = (row.depth_exact_mm > 0) & ~flagged(row, Flag.MIXED) & ~unlit
        white, black = levels(row)
        fringes = (white - black) / 2
        assert least <= weak[seen].mean() <= most and not weak[row.depth_exact_mm == 0].any()
        assert fringes[weak & seen].max() <= WEAK_GREY + 0.5
        assert fringes[seen & ~weak].min() >= WEAK_GREY - 0.5


def test_the_flags_are_the_same_whatever_is_projected():
    crossed = RIG.with_crossed(CROSSED["crossed-18"])
    rows = [studio(PAPER, rig=rig).photograph(GROOVE, "A60") for rig in (RIG, crossed)]
    np.testing.assert_array_equal(rows[0].flags, rows[1].flags)
    np.testing.assert_array_equal(rows[0].depth_exact_mm, rows[1].depth_exact_mm)


def test_bounces_add_light_and_nothing_else():
    """With all bounces off a view is direct light and the ambient: the closed form, pixel by
    pixel."""
    row = studio(DIRECT).photograph(BALL, "A0")
    white, black, exact = row.frames[51].astype(float), row.frames[50], row.depth_exact_mm / 1000
    points = RAYS * exact[..., None]
    inside = (edge_distance_px(row.depth_exact_mm) > 4) & (exact > 0)
    mesh_normals = (points - [0, 0, 1.8]) / 0.12
    to = CENTRE - points
    distance = np.linalg.norm(to, axis=-1)
    expected = 6 + 180 * (1.5 / distance) ** 2 * np.clip(
        (mesh_normals * to).sum(axis=-1) / distance, 0, None
    )
    assert np.abs(white - expected)[inside].max() < 15  # the ball has facets of 9 degrees
    assert np.abs((white - expected)[inside].mean()) < 0.5
    assert (black[inside] == 6).all()
    more = studio(DIRECT.changed("bounces", interreflection=True)).photograph(BALL, "A0")
    assert (more.frames[51].astype(float) - white >= 0).all()
    assert (more.frames[51] == white)[row.depth_exact_mm == 0].all()


def test_ambient_occlusion_is_the_open_share_of_the_groove():
    """In the dark: ambient light times what the other side leaves open of a place's hemisphere."""
    light = DIRECT.changed("bounces", ambient_occlusion=True).changed(ambient_grey=200.0)
    row = studio(light, rig=SMALL).photograph(GROOVE, "A0")
    dark = row.frames[SMALL.sequence.black].astype(float)
    inside = (
        (row.depth_exact_mm > 0) & (np.abs(Y) < 0.01) & (edge_distance_px(row.depth_exact_mm) > 3)
    )
    x = np.abs(X * row.depth_exact_mm / 1000)[inside] * np.sqrt(2)  # up the side, of 0.1414 m
    side = np.hypot(0.1, 0.1)
    # Endless groove, then its length of 0.2 m: the middle sees arctangents of it (Lambert's
    # contour, two terms of it).
    half = 0.1
    reach = np.hypot(x, side)
    share = (np.arctan(half / x) - x / reach * np.arctan(half / reach)) / np.pi
    expected = 200 * (1 - share)
    assert (
        np.abs(dark[inside] - expected).max() < 10
    )  # 5% at a single place: noise of 128 rays, and the width of a surfel
    assert np.abs((dark[inside] - expected).mean()) < 1.5
    assert dark[inside].min() < 120 and dark[inside].max() > 170


@pytest.mark.long
def test_an_object_is_cut_into_surfels_once_for_all_its_views_and_lights(monkeypatch):
    ball, cut = replace(BALL), Mock(wraps=lighting.Surfels.of)
    monkeypatch.setattr(lighting.Surfels, "of", cut)
    for light in (named_light("paper"), named_light("workshop")):
        for degrees in ("A0", "A60"):
            studio(light, rig=SMALL).photograph(ball, degrees)
    cut.assert_called_once_with(ball)


@pytest.mark.long
@pytest.mark.parametrize("stored", ["single_shot", "all"])
@pytest.mark.parametrize("name", ["paper", "workshop", "hard", "moving"])
def test_skipping_changes_no_byte(name, stored):
    """Frames that are stored, ground truth and flags; twice, so that nothing of another view is
    left in the memory."""
    mixing = DIRECT.changed("camera", rays_across=2)
    light = mixing.changed(motion_mm=3.0) if name == "moving" else named_light(name)
    light = light.changed("projector", defocus_px=0.5) if name == "hard" else light
    rows = {}
    for enabled in (True, False):
        with skipping(enabled):
            at = studio(light, rig=SMALL, stored=stored)
            at.photograph(GROOVE, "A60")
            row = at.photograph(BALL, "A0")
            rows[enabled] = row, kept(row)
    (one, frames), (other, other_frames) = rows[True], rows[False]
    assert frames.keys() == other_frames.keys()
    for index in frames:
        np.testing.assert_array_equal(frames[index], other_frames[index])
    for name in ("depth_mm", "flags", "cover"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert one.measured == other.measured


def test_exposure_is_drawn_for_each_view_evenly_by_its_logarithm():
    light = DIRECT.changed("camera", exposure=(0.3, 1.8))
    at = studio(light, rig=SMALL)
    draws = [float(at.brightness((seed, "mug", "A0"))) for seed in range(2000)]
    assert min(draws) >= 0.3 and max(draws) <= 1.8
    assert stats.kstest(np.log(draws), stats.uniform(np.log(0.3), np.log(6.0)).cdf).pvalue > 1e-3
    plain = studio(rig=SMALL).photograph(BALL, "A0").frames[21].astype(float)
    factor = float(at.brightness((42, "thing", "A0")))
    drawn = at.photograph(BALL, "A0").frames[21].astype(float)
    assert np.abs(drawn - np.minimum(plain * factor, 255)).max() <= 0.5 + 0.5 * factor + 0.01


def test_calibration_error_moves_the_pattern_and_not_the_depth():
    plain, off = studio(rig=SMALL), studio(DIRECT.changed(calibration_px=2.0), rig=SMALL)
    row, other = plain.photograph(BALL, "A0"), off.photograph(BALL, "A0")
    np.testing.assert_array_equal(row.depth_exact_mm, other.depth_exact_mm)
    both = object_mask(row.depth_mm) & object_mask(other.depth_mm)
    error = (other.depth_mm - row.depth_exact_mm)[both]
    # 1 px of disparity is Z^2 / (f b) = 14 mm; two directions, and some of the error is a shift
    # along epipolar lines.
    assert 1 < np.abs(error).mean() < 40
    assert plain.rig == SMALL and off.settings.rig == SMALL and off.rig != SMALL


def test_the_object_moves_from_frame_to_frame():
    """By the same step each frame, as long as asked for; the exact depth is that of the first."""
    step_mm = 4.0
    at = studio(DIRECT.changed(motion_mm=step_mm), rig=SMALL)
    row = at.photograph(BALL, "A0")
    still = studio(rig=SMALL).photograph(BALL, "A0")
    np.testing.assert_array_equal(row.depth_exact_mm, still.depth_exact_mm)
    np.testing.assert_array_equal(row.frames[0], still.frames[0])
    white = row.frames[21].astype(float)
    # Traced as the view traces it: the step between the frames' scenes.
    at.trace = Mock(wraps=at.trace)
    at.photograph(BALL, "A0")
    moves = [traced.args[2] for traced in at.trace.call_args_list[1:]]  # the first is the view's
    steps = np.linalg.norm(np.diff(moves, axis=0), axis=1)
    np.testing.assert_allclose(steps, step_mm / 1000, rtol=1e-6)
    assert len(moves) == len(SMALL.sequence)
    lit = np.zeros(X.size, bool)
    lit[at.trace(BALL, "A0", moves[21]).hits.pixels] = True
    assert ((white > 60).ravel() == lit).mean() > 0.98
