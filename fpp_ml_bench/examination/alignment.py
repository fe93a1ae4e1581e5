"""Whether camera and projector still stand and see as they were calibrated: the epipolar residual,
as a whole.

Where both directions are decoded, a pixel's projector point lies on the epipolar line of its ray.
Its distance from that line is noise where the calibration fits. A device that moved, zoomed, or
shows another window leaves a pattern over the image. Errors along the lines can't be seen, and they
are what makes the depth wrong; a pattern across the lines says that there are such errors, and
about how large they are.

A cause is a change of one device's normalised coordinates, ``x + sum(p_k * term_k(x))``, or of the
pose between the devices. Each is fitted by least squares with Tukey's weights. Those that explain
the pattern are named.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding.code import Coordinates
from fpp_ml_bench.constants import MAD_TO_SIGMA
from fpp_ml_bench.examination.signals import LEAST_PX, SIGMAS, Lines
from fpp_ml_bench.optics.pinhole import Maps
from fpp_ml_bench.optics.rig import Rig, rotation_matrix
from fpp_ml_bench.optics.sequence import AXES, Direction

CALIBRATION_PX = 0.5
"""Least RMS of the pattern, in projector px, that is worth a word. Our calibrations of six real
board poses leave 0.07 to 0.37 px, a public one 0.46 and 0.74, and the authors' own of the six poses
2 to 3."""
LARGEST_CHANGE = 0.3
"""Of a cause's parameter: 0.3 of the focal length, 17 degrees, 30%. More is another reading of the
images."""
UNEXPLAINED = 0.2
"""Largest share of the pattern that a named cause may leave beside the noise: the calibration had
one of its own."""
ALIKE = 1.2
"""A cause explains as well as another one where it leaves at most so many times as much."""
LEAST_REST_PX = 0.05
"""What rounding and interpolation leave; below it causes can't be compared."""
_ROUNDS = 10
"""Rounds of the robust fit of a cause, each with new weights and a step of Gauss and Newton."""
_TUKEY = 4.685
"""Residual, in robust standard deviations, from which on a point has no weight: the usual constant,
with 95% of the efficiency of least squares under normal noise."""
_STEP = 1e-6
"""Step of the difference quotients of a cause's parameters: far below any change of interest, far
above rounding."""
_RANK = 1e-3
"""Singular values below this share of the largest are left out of a fit: parameters that do the
same would get large opposite values."""
_NEIGHBOURS = 4
"""Pixels that count as one where the size of a chance pattern is judged: those beside each other
share their errors."""
Part = Literal["shift", "turn", "roll", "zoom", "keystone", "barrel"]
Device = Literal["camera", "projector", "pose"]
Residual = Callable[[NDArray[np.float64]], NDArray[np.float64]]


class Seen(NamedTuple):
    """Ideal normalised coordinates of the same points in both devices, and the pose between
    them."""

    camera: Maps
    projector: Maps
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    focal_px: tuple[float, float]

    def px(self) -> NDArray[np.float64]:
        """Signed distance of the projector's points from their epipolar lines, in undistorted
        projector px (n,)."""
        (x, y), (u, v) = self.camera, self.projector
        line = np.cross(
            self.translation, np.stack([x, y, np.ones_like(x)], axis=1) @ self.rotation.T
        )
        length = np.hypot(line[:, 0] / self.focal_px[0], line[:, 1] / self.focal_px[1])
        with np.errstate(divide="ignore", invalid="ignore"):
            distance: NDArray[np.float64] = (line[:, 0] * u + line[:, 1] * v + line[:, 2]) / length
        return distance


class Change(NamedTuple):
    """A kind of change: its number of ``parameters``, the ``terms`` that each adds to coordinates
    (x, y), and the ``words`` for parameters and a focal length in px."""

    parameters: int
    terms: Callable[[NDArray, NDArray], list[tuple[NDArray, NDArray]]]
    words: Callable[[NDArray, float], str]


CHANGES: dict[Part, Change] = {
    "shift": Change(
        2,
        lambda x, y: [(1 + 0 * x, 0 * y), (0 * x, 1 + 0 * y)],
        lambda p, f: (
            f"another window or principal point, ({-f * p[0]:+.1f}, {-f * p[1]:+.1f}) px off"
        ),
    ),
    "turn": Change(
        2,
        lambda x, y: [(1 + x * x, x * y), (x * y, 1 + y * y)],
        lambda p, f: f"a turn by {np.rad2deg(np.hypot(*p)):.2f} degrees",
    ),
    "roll": Change(
        1, lambda x, y: [(-y, x)], lambda p, f: f"a roll by {np.rad2deg(abs(p[0])):.2f} degrees"
    ),
    "zoom": Change(
        1,
        lambda x, y: [(x, y)],
        lambda p, f: f"a focal length {100 / (1 + p[0]) - 100:+.2f}% off (zoom, focus)",
    ),
    "keystone": Change(
        2, lambda x, y: [(x * x, x * y), (x * y, y * y)], lambda p, f: "a keystone correction"
    ),
    "barrel": Change(
        1,
        lambda x, y: [(x * (x * x + y * y), y * (x * x + y * y))],
        lambda p, f: "another distortion of the lens",
    ),
}


@dataclass(frozen=True)
class Cause:
    """A change of a device, in ``parts``, that may explain a pattern."""

    device: Device
    parts: tuple[Part, ...]

    @property
    def count(self) -> int:
        """How many parameters: of the pose, a rotation and two of the baseline's direction."""
        return 5 if self.device == "pose" else sum(CHANGES[part].parameters for part in self.parts)

    def left_px(self, seen: Seen, change: NDArray[np.float64]) -> NDArray[np.float64]:
        """The distances from the epipolar lines, with the ``change`` undone."""
        if self.device == "pose":
            across = np.linalg.svd(seen.translation[None])[2][1:]  # its length leaves no pattern
            moved = seen.translation + np.linalg.norm(seen.translation) * change[3:] @ across
            return seen._replace(
                rotation=seen.rotation @ rotation_matrix(tuple(change[:3])), translation=moved
            ).px()
        x, y = seen.camera if self.device == "camera" else seen.projector
        terms = np.array([term for part in self.parts for term in CHANGES[part].terms(x, y)])
        x, y = np.stack([x, y]) + np.tensordot(change, terms, axes=1)
        return (
            seen._replace(camera=(x, y))
            if self.device == "camera"
            else seen._replace(projector=(x, y))
        ).px()

    def words(self, change: NDArray[np.float64], rig: Rig) -> str:
        """What the change is, with its figures."""
        if self.device == "pose":
            turn = np.rad2deg(np.linalg.norm(change[:3]))
            return f"camera and projector moved against each other (turned by {turn:.2f} degrees)"
        ends = np.cumsum([CHANGES[part].parameters for part in self.parts])
        focal_px = (rig.camera if self.device == "camera" else rig.projector).fx
        said = [
            CHANGES[part].words(p, focal_px)
            for part, p in zip(self.parts, np.split(change, ends), strict=False)
        ]
        return f"of the {self.device}: {' and '.join(said)}"


_PARTS: tuple[tuple[Part, ...], ...] = (
    ("roll",),
    ("zoom",),
    ("barrel",),
    ("shift",),
    ("turn",),
    ("turn", "roll"),
    ("shift", "zoom"),
    ("shift", "roll"),
    ("shift", "zoom", "keystone"),
)
CAUSES = (
    *(Cause(device, parts) for parts in _PARTS for device in ("camera", "projector")),
    Cause("pose", ()),
)


@dataclass(frozen=True)
class Pattern:
    """Of the epipolar residual over the image, in projector px: RMS of the pattern and what noise
    leaves beside it; ``causes`` in words that explain it, the simplest ones."""

    rms_px: float
    rest_px: float
    causes: tuple[str, ...]


def epipolar_pattern(lines: Lines, measured: Mapping[Direction, Coordinates]) -> Pattern | None:
    """The pattern of pixels ``measured`` in both directions; None where there are too few, or noise
    explains it."""
    good = np.logical_and.reduce([coordinates.reason == 0 for coordinates in measured.values()])
    if len(measured) < 2 or good.sum() < LEAST_PX:
        return None
    rig = lines.rig
    rays = tuple(axis[lines.row[good], lines.column[good]] for axis in rig.camera.rays())
    projector = rig.projector.normalised(
        *(measured[direction].coordinate_px[good] for direction in AXES)
    )
    seen = Seen((rays[0], rays[1]), projector, rig.R, rig.t, rig.projector.focal)
    distance = seen.px()
    known = np.isfinite(distance)
    if known.sum() < LEAST_PX:
        return None
    distance, x, y = distance[known], rays[0][known], rays[1][known]
    seen = seen._replace(camera=(x, y), projector=(projector[0][known], projector[1][known]))
    x, y = x / np.abs(x).max(), y / np.abs(y).max()
    powers = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)])
    field, rest_px = _fitted(lambda change: distance - change @ powers, len(powers))
    smooth = field @ powers
    rms_px = math.sqrt(float(np.mean(np.minimum(smooth**2, np.quantile(smooth**2, 0.95)))))
    chance_px = SIGMAS * rest_px * math.sqrt(_NEIGHBOURS * len(powers) / len(distance))
    if rms_px < max(CALIBRATION_PX, chance_px):
        return None
    enough_px = math.hypot(ALIKE * max(rest_px, LEAST_REST_PX), UNEXPLAINED * rms_px)
    fitting = []
    for cause in CAUSES:
        change, left_px = _fitted(partial(cause.left_px, seen), cause.count)
        if left_px <= enough_px and np.abs(change).max() <= LARGEST_CHANGE:
            fitting.append((cause.count, left_px, cause.words(change, rig)))
    fewest, best_px, _ = min(fitting, default=(0, 0.0, ""))
    alike = [
        words for count, left_px, words in fitting if count == fewest and left_px <= ALIKE * best_px
    ]
    return Pattern(rms_px, rest_px, tuple(alike))


def _fitted(residual: Residual, count: int) -> tuple[NDArray[np.float64], float]:
    """The ``count`` parameters at which the residuals (n,) are least by Tukey's weights, and the
    robust standard deviation of what is left."""
    change = np.zeros(count)
    for _ in range(_ROUNDS):
        left = residual(change)
        slopes = np.stack(
            [(residual(change + step) - left) / _STEP for step in _STEP * np.eye(count)], axis=1
        )
        # Larger than noise while a pattern is left, so that no part of the pattern counts as an
        # outlier.
        size = np.abs(left) / max(_TUKEY * MAD_TO_SIGMA * float(np.median(np.abs(left))), 1e-9)
        weights = np.where(size < 1, 1 - size * size, 0.0)  # the root of Tukey's
        solution = np.linalg.lstsq(slopes * weights[:, None], -left * weights, rcond=_RANK)
        change = change + solution[0]
    left = residual(change)
    return change, MAD_TO_SIGMA * float(np.median(np.abs(left)))
