"""The object mask: pixels whose grey level the empty scene does not explain; where none is known,
modulated pixels.

Twice a period the object's fringe is as bright as the plane's would be, so a single pixel of one
frame can't be assigned to either. Inside the object, morphological closing by a quarter of a period
fills these stripes. At the silhouette, a pixel is assigned to the better of two predictions of its
grey level: that of the empty scene, and that of the object's fringe, extrapolated from the local
fit beside it. Of several frames every pixel is tested by itself.
"""

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase.empty_scene import Background
from fpp_ml_bench.baselines.phase.geometry import Crop, Image, Mask, wrapped
from fpp_ml_bench.coding.code import MIN_MODULATION

CLOSING_PERIODS = 0.27
"""Radius of the closing, in periods, that fills the stripes where object and plane are equally
bright. A stripe returns every half a period, so a quarter fills it."""
ENCLOSED_PERIODS = 0.6
"""Radius, in periods, of the wider closing within which dark parts of an object in a noisy frame
are looked for."""
ENCLOSED_WINDOW_PERIODS = 0.2
"""Sigma, in periods, of the window in which the mean square of the plane's misfit is taken
there."""
ENCLOSED_EXCESS = 1.0
"""Excess of that mean square over the noise's own, as a multiple of it, from which on a pixel joins
the object: seven standard deviations of such a mean at 15 px a period."""
BORDER_PERIODS = 0.6
"""Width of the image's border in periods, where blur mixes in what no pixel shows; no object lies
there alone."""
GAP_PX = 0.8
"""Sigma, in px, of the average in which a gap in the object is told from the object."""
GAP_PLANE = 4.0
"""Largest mean square of the plane's misfit in a gap, over that of noise."""
GAP_OBJECT = 16.0
"""Least mean square of the object's misfit in a gap, over that of noise: the object's fringe must
clearly not explain the gap."""
RING_PERIODS = 0.14
"""Distance from the first mask's silhouette, in periods, within which a pixel may change between
object and background."""
LARGEST_MISFIT_POWER = 0.35
"""Largest mean square of the misfit of a fringe that is there, as a share of the mean square of its
light. A dark hollow into which only the fit's window reaches exceeds it."""
OBJECT_BONUS = 4.0
"""Added to the plane's squared misfit, in sigmas: a pixel that both predictions explain is
object."""
UNLIT_PERIODS = 0.8
"""Side, in periods, of the square whose dark stripes are filled before light is judged: most of a
period, since a dark stripe of a fringe is half a period wide."""
UNLIT_SIGMAS = 4.0
"""Brightest grey level of what counts as unlit, above ambient light, in standard deviations of
noise. More would drop dimly lit surfaces."""
DARKEST_GREY = MIN_MODULATION / 4
"""An object pixel with less modulation has no fringe: it lies in shadow or faces away, and gets no
depth."""
LEAST_AREA_PERIODS = 0.1
"""Smallest object, and largest hole that is closed, in squares of one period."""
PLANE_CHANCE_SIGMAS = 4.0
"""How far, in sigmas of its own spread, the squared misfit of N frames must exceed N not to be the
empty plane."""
PLANE_TOLERANCE_GREY = 0.3
"""Error of the fitted empty scene in grey levels, which is added to the noise."""
SEAM_PX = 2
"""Half the width, in px, of a seam along a shadow, and of a rim: the camera's blur mixes two
surfaces over a few px."""
UNLIT_PX = 3
"""Side, in px, of the square that is averaged to tell faint light from noise."""
SQUARE_PX = 5
"""Side, in px, of the square over which faint differences are averaged. A larger one finds fainter
objects, and loses parts that are narrower than it."""
PIXELWISE_CLOSING_PERIODS = 0.2
"""Radius of the closing in periods where every pixel was tested by itself. Several frames leave
narrower stripes than one, so it is smaller than `CLOSING_PERIODS`."""
ALIKE = 0.2
"""Largest relative difference from the brightness around of an object pixel that the empty scene
explains as well."""
SPECK_PX = 6
"""Smallest group of pixels that counts as object, and largest hole in it that is closed, in
pixels."""
DARK_SIGMAS = 4.0
"""Least modulation of an object pixel, in standard deviations of its noise, where the background is
shown; more than `MIN_MODULATION` is never asked."""
CONTINUED_PX = 3
"""Object pixels among the eight around a pixel that make it continue the object: a pixel beside a
straight rim has three."""
CONTINUED_RAD = 0.2
"""Difference of the residual phase, in rad, up to which such a pixel has the same phase."""


def crop_around(region: Mask, margin_px: int, step: int = 1) -> Crop:
    """Rows and columns of ``region`` with ``margin_px`` around it, from a multiple of ``step`` on;
    a single pixel where there is no object."""
    left, top, width, height = cv2.boundingRect(region.astype(np.uint8))
    if not width:
        return slice(0, 1), slice(0, 1)
    rows, columns = (
        slice(max(start - margin_px, 0) // step * step, min(start + length + margin_px, size))
        for start, length, size in zip((top, left), (height, width), region.shape, strict=True)
    )
    return rows, columns


def disk(radius_px: float) -> NDArray[np.uint8]:
    """Disk as a structuring element of odd size."""
    half = max(1, round(radius_px))
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    return (x * x + y * y <= (half + 0.5) ** 2).astype(np.uint8)


def closed(mask: Mask, radius_px: float, least_px: float) -> Mask:
    """``mask`` closed by a disk, then without objects and without holes of fewer than ``least_px``
    pixels."""
    region = without_small(
        cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, disk(radius_px)) > 0, least_px
    )
    return region | ~without_small(~region, least_px)


def without_small(mask: Mask, least_px: float) -> Mask:
    """``mask`` (H, W) without its 8-connected components of fewer than ``least_px`` pixels."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(
        mask.astype(np.uint8), connectivity=8
    )
    keep = stats[:, cv2.CC_STAT_AREA] >= least_px
    keep[0] = False
    return keep[labels] if count > 1 else mask


def object_region(background: Background, period_px: float) -> Mask:
    """First mask (H, W): pixels that differ, closed over the stripes where object and plane are
    equally bright."""
    return closed(
        background.different, CLOSING_PERIODS * period_px, LEAST_AREA_PERIODS * period_px**2
    )


def beyond_border(region: Mask, period_px: float) -> Mask:
    """``region`` (H, W) without its components that lie in the image's border alone."""
    width = max(1, round(BORDER_PERIODS * period_px))
    count, labels = cv2.connectedComponents(region.astype(np.uint8), connectivity=8)
    keep = np.zeros(count, bool)
    keep[labels[width:-width, width:-width]] = True
    keep[0] = False
    return keep[labels]


def enclosed(region: Mask, background: Background, period_px: float) -> Mask:
    """Pixels (H, W) within the closed ``region`` around which the empty scene does not explain the
    grey levels, though it explains each one alone: dark parts of an object in a noisy frame."""
    around = (
        cv2.morphologyEx(
            region.astype(np.uint8), cv2.MORPH_CLOSE, disk(ENCLOSED_PERIODS * period_px)
        )
        > 0
    )
    power = cv2.GaussianBlur(background.residual**2, (0, 0), ENCLOSED_WINDOW_PERIODS * period_px)
    return around & (power > (1 + ENCLOSED_EXCESS) * background.noise_grey**2)


def gaps(inside: Mask, background: Background, misfit_grey: Image) -> tuple[Mask, Mask]:
    """Pixels (h, w) of a closed mask ``inside`` that show the plane, through a hole or beside a
    rim: it explains them and their nearest neighbours, and the object's fringe, which leaves
    ``misfit_grey``, does not. And those at its rim that both explain. None on a plane of any
    albedo, which explains too much."""
    if background.textured or not background.shown:
        return np.zeros_like(inside), np.zeros_like(inside)
    as_plane, as_object = (
        cv2.GaussianBlur(misfit**2, (0, 0), GAP_PX) for misfit in (background.residual, misfit_grey)
    )
    noise = background.noise_grey**2
    plane = inside & ~background.different & (as_plane < GAP_PLANE * noise)
    gap = plane & (as_object > GAP_OBJECT * noise)
    rim = cv2.dilate((~inside | gap).astype(np.uint8), disk(SEAM_PX)) > 0
    return gap, plane & rim & ~gap


def modulated_region(
    grey: Image, modulation: Image, background: Background, period_px: float
) -> Mask:
    """First mask (H, W) of an image that shows no known background: pixels with a fringe, by
    ``modulation`` in grey levels (`local_fit.carrier_fit`), whose stripes are also as bright as
    such a fringe: the window of ``modulation`` reaches a third of a period beyond the silhouette,
    closing the stripes does not."""
    bright = stripes_filled(grey, period_px) > background.ambient_grey + 2 * MIN_MODULATION
    region = (modulation > MIN_MODULATION) & bright
    return closed(region, 1, LEAST_AREA_PERIODS * period_px**2)


def stripes_filled(grey: Image, period_px: float) -> Image:
    """The envelope of bright stripes: ``grey`` (H, W) closed over most of a period."""
    size = 2 * round(UNLIT_PERIODS * period_px / 2) + 1
    square = np.ones((size, size), np.uint8)
    return cv2.morphologyEx(grey, cv2.MORPH_CLOSE, square, borderType=cv2.BORDER_REPLICATE)  # type: ignore[return-value]


def unlit(grey: Image, background: Background, period_px: float, side_px: int = 1) -> Mask:
    """Pixels (H, W) in ambient light alone over most of a period: closing fills the dark stripes of
    a fringe first. Squares of ``side_px`` are averaged, so that a weaker light is told from
    noise."""
    limit_grey = UNLIT_SIGMAS * background.noise_grey / side_px
    if side_px == 1:
        return stripes_filled(grey, period_px) < background.ambient_grey + limit_grey
    means: Image = cv2.blur(grey, (side_px, side_px))  # type: ignore[assignment]
    return (
        stripes_filled(means, period_px)
        < background.ambient_grey + limit_grey + PLANE_TOLERANCE_GREY
    )


def lit_part(inside: Mask, dark: Mask) -> Mask:
    """Pixels (h, w) ``inside`` that are not ``dark``, and not a seam between these and the
    background either: along a shadow's border the camera's blur mixes shadow and plane, which the
    empty scene does not explain."""
    left = inside & ~dark
    core = cv2.morphologyEx(left.astype(np.uint8), cv2.MORPH_OPEN, disk(SEAM_PX)) > 0
    beside = cv2.dilate((inside & dark).astype(np.uint8), disk(2 * SEAM_PX)) > 0
    return left & (core | ~beside)


def explained(grey: Image, predicted: Image, ambient_grey: float, period_px: float) -> Mask:
    """Pixels (H, W) around which the ``predicted`` grey levels of the object's fringe are seen: not
    a dark hollow in it into which only the fit's window reaches."""
    sigma_px = RING_PERIODS * period_px
    light = predicted - np.float32(ambient_grey)
    misfit, power = (cv2.GaussianBlur(v * v, (0, 0), sigma_px) for v in (grey - predicted, light))
    return misfit < LARGEST_MISFIT_POWER * power  # type: ignore[no-any-return]


def refined(
    region: Mask,
    background: Background,
    predicted: Image,
    grey: Image,
    fringe_noise: NDArray,
    reach_px: float,
) -> Mask:
    """Mask (H, W) by the better of the two predictions within ``reach_px`` of the silhouette;
    ``predicted`` grey levels of the object's fringe, NaN where nothing near predicts it;
    ``fringe_noise``: its noise, beside the image's."""
    noise = background.noise_grey
    as_plane = (background.residual / noise) ** 2
    with np.errstate(invalid="ignore"):
        as_object = (grey - predicted) ** 2 / (noise**2 + fringe_noise**2)
        nearer = as_object < as_plane + OBJECT_BONUS
    ring = cv2.dilate(region.astype(np.uint8), disk(reach_px)) > 0
    # Pixels that differ stay. The others at the rim are object where the object's fringe explains
    # them better.
    clear = background.different & region
    inner = cv2.erode(region.astype(np.uint8), disk(reach_px)) > 0
    votes = without_small(clear | inner | (ring & nearer), 4)
    smooth = cv2.medianBlur(votes.astype(np.uint8), 3) > 0
    return (smooth | clear) & ring


def differs(plane_misfits: Iterable[Image], noise_grey: float) -> Mask:
    """Pixels (h, w) whose grey levels the empty scene does not explain, by ``plane_misfits`` (h, w)
    of each frame. Tested for every pixel, and for means over a small square, which separate the
    plane from an object that happens to be as bright; pixels that only the square's reach beyond
    the silhouette adds are removed."""
    misfits, noise = list(plane_misfits), noise_grey**2
    alone = sum((misfit * misfit for misfit in misfits), np.float32(0))
    around = np.asarray(
        sum((cv2.blur(misfit, (SQUARE_PX, SQUARE_PX)) ** 2 for misfit in misfits), np.float32(0))
    )
    square_differs = (around > _limit(noise / SQUARE_PX**2, len(misfits))).astype(np.uint8)
    without_rim = cv2.erode(square_differs, np.ones((SQUARE_PX, SQUARE_PX), np.uint8)) > 0
    return (alone > _limit(noise, len(misfits))) | without_rim


def _limit(variance: float, count: int) -> float:
    """Squared misfit of ``count`` frames that the empty scene, with noise of that variance, hardly
    ever exceeds."""
    chance = count + PLANE_CHANCE_SIGMAS * np.sqrt(2 * count) + PLANE_CHANCE_SIGMAS
    return float((variance + PLANE_TOLERANCE_GREY**2) * chance)


def first_mask(different: Mask, period_px: float) -> Mask:
    """Object pixels (h, w) before brightness is known: small stripes and holes closed, specks
    removed."""
    return closed(different, PIXELWISE_CLOSING_PERIODS * period_px, SPECK_PX)


def lit_object(
    different: Mask,
    region: Mask,
    modulation: Image,
    noise_grey: Image | float,
    shown: bool,
    period_px: float,
) -> Mask:
    """Object pixels (h, w): those of ``region`` (`first_mask`) that are ``different`` (`differs`)
    and modulated by more than the noise of their modulation; ``shown``: whether the background is.
    Pixels that only closing has added must be as bright as the object around them, otherwise they
    are the plane beside a corner."""
    least_grey: Image | np.float32 = np.float32(MIN_MODULATION)
    if shown:  # otherwise nothing else tells the object
        least_grey = np.minimum(
            np.maximum(np.float32(DARK_SIGMAS) * noise_grey, np.float32(DARKEST_GREY)), least_grey
        )
    certain = region & different & (modulation > least_grey)
    side = 2 * round(PIXELWISE_CLOSING_PERIODS * period_px) + 1
    weight = cv2.blur(certain.astype(np.float32), (side, side))
    around = cv2.blur(modulation * certain, (side, side)) / np.maximum(weight, 1e-6)
    alike = np.abs(modulation - around) < ALIKE * around
    return without_small(certain | (region & ~different & alike), SPECK_PX)


def continued(inside: Mask, region: Mask, different: Mask, residual_rad: Image) -> Mask:
    """Object pixels (h, w), and those of ``region`` with `CONTINUED_PX` object pixels beside them
    that either have the same ``residual_rad``, or are themselves ``different`` from the empty
    scene: where object and plane happen to have the same grey levels in all frames, and where light
    from other surfaces drowns the fringe."""
    beside, alike = np.zeros(inside.shape, np.uint8), np.zeros(inside.shape, np.uint8)
    padded, phases = np.pad(inside, 1), np.pad(residual_rad, 1)
    height, width = inside.shape
    for down, right in ((0, 0), (0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1), (2, 2)):
        there = slice(down, down + height), slice(right, right + width)
        beside += padded[there]
        alike += padded[there] & (np.abs(wrapped(phases[there] - residual_rad)) < CONTINUED_RAD)
    return inside | (region & ((alike >= CONTINUED_PX) | (different & (beside >= CONTINUED_PX))))
