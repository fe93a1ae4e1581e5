"""Whether depth maps fit others far better when they are read in another way: flipped, in another
unit, as distances along the ray, or as those of other samples. Some pixels of some samples are
compared, so that trying costs little."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.optics.pinhole import Pinhole

MOST_GLANCES = 48
"""Samples, at most, that are compared with each other to find exchanged ones."""
_FEW = 8
"""Samples, at most, that are read in every way: eight arrangements with each unit and sign take
time."""
_LINES = 20
"""Rows and columns of a glance, about; twice as many where they are not symmetric by themselves."""
_FEWER = 4.0
"""A reading is named where its error is so many times smaller than the one that was given. Chosen
by reason: a network's error is 0.3 to 1 times that of a constant, and no other reading of a right
map comes near the target."""
_RAY_GAIN = 0.75
"""Distances along rays are named where reading them so leaves at most this share of the error."""
_RAY_SLOPE = 0.25
"""And where the error grows as distances do, within this share of the slope: a constant offset has
slope 0."""
UNITS_MM = {
    "cm": 10.0,
    "dm": 100.0,
    "m": MM_PER_M,
    "inches": 25.4,
    "tenths of a mm": 0.1,
    "micrometres": 0.001,
}
"""Units for which mm are taken by mistake, in mm."""
_TURNED = ("", "turned to the left", "turned by 180 degrees", "turned to the right")
_FLIPPED = (
    "upside down",
    "transposed",
    "mirrored left to right",
    "transposed across the other diagonal",
)
"""What undoes it: quarter turns to the left, and then rows in the opposite order."""

Maps = NDArray[np.float64]


class Glance(NamedTuple):
    """Some rows and columns of a sample: depths that are examined and those they should be, (h, w)
    in mm, 0 where there are none; ``along`` (h, w): distance along the ray over depth."""

    sample: str
    given_mm: Maps
    true_mm: Maps
    along: Maps


def glance(
    sample: str, given_mm: NDArray, true_mm: NDArray, void: NDArray | None, camera: Pinhole
) -> Glance:
    """A glance at two maps (H, W) in mm, of which pixels in ``void`` do not count. Its rows and
    columns lie symmetrically in the image, so that a flip of the image is one of the glance."""
    rows, columns = (
        np.union1d(places, length - 1 - places)
        for length in true_mm.shape
        for places in [np.arange(0, length, -(-length // _LINES))]
    )
    part = np.ix_(rows, columns)
    true = true_mm[part] if void is None else true_mm[part] * ~void[part]
    # Without the lens's distortion, which changes a ray's length little.
    x, y = (columns - camera.cx) / camera.fx, (rows[:, None] - camera.cy) / camera.fy
    return Glance(
        sample,
        given_mm[part].astype(np.float64),
        true.astype(np.float64),
        np.sqrt(1 + x * x + y * y),
    )


def another_reading(what: str, glances: Sequence[Glance]) -> str | None:
    """A note on the reading by which ``what`` was glanced at fits far better, with both mean errors
    and what to write, or None. Only depths that are wronger than a constant are read in all ways;
    whether they are distances along the ray is looked at always. Glances of one size."""
    glances = [seen for seen in glances if seen.true_mm.any()]
    if not glances:
        return None
    _, given, true, along = map(np.array, zip(*glances, strict=True))
    error_mm, inside = _error_mm(given, true), object_mask(true)
    reading = _error_mm(given / along, true), "as distances along the ray"
    if reading[0] >= _RAY_GAIN * error_mm or not _grows_along(given, true, along):
        constant_mm = _error_mm(np.full_like(true, np.median(true[inside])), true)
        if error_mm <= constant_mm:
            return None
        reading = min(*_readings(given[:_FEW], true[:_FEW], constant_mm), _exchanged(glances))
        if reading[0] * _FEWER > error_mm:
            return None
    return (
        f"another reading fits {what} far better: {reading[1]}, with a mean error of "
        f"{reading[0]:.3g} mm, not "
        f"{error_mm:.4g} mm; write depth in mm along the camera's axis, rows from the top, by each "
        f"sample's name"
    )


def _error_mm(given: Maps, true: Maps) -> float:
    """Mean over samples of the mean absolute error over the object; all (n, h, w)."""
    inside = object_mask(true)
    return float(np.mean((np.abs(given - true) * inside).sum((-1, -2)) / inside.sum((-1, -2))))


def _grows_along(given: Maps, true: Maps, along: Maps) -> bool:
    """Whether the error grows with the distance along the ray as that of distances does."""
    error, longer = given - true, true * (along - 1)
    both = object_mask(true) & (given > 0)
    both &= np.abs(error) <= 3 * np.median(np.abs(error[both]))
    (spread, common), _ = np.cov(longer[both], error[both])
    return bool(abs(common - spread) < _RAY_SLOPE * spread)


def _readings(given: Maps, true: Maps, constant_mm: float) -> Iterator[tuple[float, str]]:
    """Mean error in mm and name of every arrangement with every unit and sign; and as disparity and
    as height, whose constant is fitted, where they are far from a constant's error."""
    for number, turned in enumerate(_TURNED + _FLIPPED):
        maps = np.rot90(given, number, (1, 2))[:, :: 1 if number < len(_TURNED) else -1]
        if maps.shape != true.shape:
            continue
        for unit, size in {"": 1.0, **UNITS_MM}.items():
            words = ", ".join(filter(None, (turned, unit and f"in {unit}")))
            yield _error_mm(size * maps, true), words
            yield _error_mm(-size * maps, true), f"{words}, negative".removeprefix(", ")
    both = object_mask(true) & (given > 0)
    if both.any():
        nearness = np.divide(1, given, out=np.zeros_like(given), where=given > 0)
        for maps, words in (
            (np.median((given + true)[both]) - given, "as heights above a plane"),
            (np.median((given * true)[both]) * nearness, "as disparity"),
        ):
            if 2 * (error_mm := _error_mm(maps, true)) < constant_mm:
                yield error_mm, words


def _exchanged(glances: Sequence[Glance]) -> tuple[float, str]:
    """Mean error in mm and the words where most depths fit another sample each; an infinite error
    where they don't."""
    errors = np.array(
        [[_error_mm(given.given_mm, seen.true_mm) for seen in glances] for given in glances]
    )
    best = errors.argmin(axis=1)
    moved = np.flatnonzero(best != np.arange(len(best)))
    if not moved.size or len(set(best)) < 0.75 * len(best):
        return np.inf, ""
    first, other = (glances[index].sample for index in (moved[0], best[moved[0]]))
    return float(
        errors.min(axis=1).mean()
    ), f"as those of other samples ({first} has that of {other})"
