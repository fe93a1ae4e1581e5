"""The rig: camera and projector as pinholes with lens distortion, and the pose between them.

Conventions: OpenCV's. The camera frame has x right, y down, z forward; a point goes from the camera's frame to the
projector's by ``X_p = R X_c + t`` in metres; pixel centres lie at integer coordinates, so that an image W px wide spans
-0.5 to W - 0.5. The default rig is the paper's (Section 2.2 and Table 1).
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fpp_ml_bench.constants import BACKGROUND_M, FULL_SIZE, MM_PER_M, STANDOFF_M, WORKING_RANGE_MM
from fpp_ml_bench.errors import RigError
from fpp_ml_bench.optics.gray_code import bits_needed, cell_count
from fpp_ml_bench.optics.pinhole import Maps, number, numbers
from fpp_ml_bench.optics.pinhole import Pinhole as Pinhole
from fpp_ml_bench.optics.sequence import DIRECTIONS, PAPER_SEQUENCE, Direction, Sequence

ROTATION_TOLERANCE = 1e-6
"""Largest accepted |R R^T - I|: what seven printed digits of a calibration leave."""
SMALLEST_PITCH_PX = 4.0
"""A Gray cell is half a period; below two pixels a cell its edges and centres can't be told apart."""
LEAST_IMAGE_PX_PER_PERIOD = 4.0

Matrix3 = tuple[tuple[float, float, float], ...]


@dataclass(frozen=True)
class Rig:
    """Camera, projector, the pose between them, and the sequence that is projected.

    ``rotation`` (three rows) and ``translation_m`` take any sequence or array and are kept as tuples, so that a rig is
    hashable and compares by value; `R` and `t` are the arrays. ``pitch_horizontal_px`` is the period of the horizontal
    fringes along the projector's rows, ``pitch_vertical_px`` that of the vertical ones along its columns. Raises
    `RigError` for a pose that is no rotation, a zero baseline, an impossible range, a pitch or code that doesn't fit.
    """

    camera: Pinhole
    projector: Pinhole
    rotation: Matrix3
    translation_m: tuple[float, float, float]
    pitch_horizontal_px: float = 18.0
    pitch_vertical_px: float = 18.0
    sequence: Sequence = PAPER_SEQUENCE
    working_range_mm: tuple[float, float] = WORKING_RANGE_MM
    standoff_m: float = STANDOFF_M
    background_m: float = BACKGROUND_M
    R: NDArray[np.float64] = field(init=False, repr=False, compare=False)
    t: NDArray[np.float64] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if isinstance(self.rotation, str | dict) or not isinstance(self.rotation, Iterable):
            raise RigError(f"rotation: expected three rows of three numbers, got {self.rotation!r}")
        rows = tuple(numbers(row, 3, f"rotation[{i}]") for i, row in enumerate(self.rotation))
        if len(rows) != 3:
            raise RigError(f"rotation: expected three rows of three numbers, got {len(rows)} rows")
        translation = numbers(self.translation_m, 3, "translation_m")
        near_far = numbers(self.working_range_mm, 2, "working_range_mm")
        settings = {"rotation": rows, "translation_m": translation, "working_range_mm": near_far}
        for name in ("pitch_horizontal_px", "pitch_vertical_px", "standoff_m", "background_m"):
            settings[name] = number(getattr(self, name), name, positive=True)  # type: ignore[assignment]
        settings["R"], settings["t"] = np.array(rows), np.array(translation)  # type: ignore[assignment]
        for name, value in settings.items():
            object.__setattr__(self, name, value)
        self.R.setflags(write=False)
        self.t.setflags(write=False)
        self._check_pose()
        self._check_range()
        for direction in DIRECTIONS:
            self._check_code(direction)

    def _check_pose(self) -> None:
        error = float(np.abs(self.R @ self.R.T - np.eye(3)).max())
        if error > ROTATION_TOLERANCE:
            raise RigError(
                f"rotation: not orthonormal, |R R^T - I| is {error:.3g} and may be {ROTATION_TOLERANCE:g}; "
                "write more digits or give a rotation vector"
            )
        if np.linalg.det(self.R) < 0:
            raise RigError("rotation: determinant is -1, a mirror image; check the sign of one axis")
        if not np.any(self.t):
            raise RigError("translation_m: the baseline is zero, so no depth can be triangulated")

    def _check_range(self) -> None:
        near, far = self.working_range_mm
        if not 0 < near < far:
            raise RigError(f"working_range_mm: expected 0 < near < far, got {near:g} to {far:g} mm")
        if not near <= self.standoff_m * MM_PER_M <= far:
            raise RigError(f"standoff_m: {self.standoff_m:g} m is outside the working range {near:g} to {far:g} mm")
        if self.background_m * MM_PER_M <= far:
            raise RigError(
                f"background_m: {self.background_m:g} m must lie beyond the working range, which ends at {far:g} mm"
            )

    def _check_code(self, direction: Direction) -> None:
        pitch, length = self.pitch(direction), self.pattern_length(direction)
        if not SMALLEST_PITCH_PX <= pitch <= length:
            raise RigError(
                f"pitch_px.{direction}: expected {SMALLEST_PITCH_PX:g} to {length} px (the pattern), got {pitch:g} px"
            )
        bits, needed = self.sequence.bits(direction), bits_needed(length, pitch)
        if bits < needed:
            raise RigError(
                f"sequence.bits_{direction}: {length} px hold {cell_count(length, pitch)} Gray cells of half a period "
                f"({pitch / 2:g} px), which need {needed} bits, got {bits}"
            )

    def pitch(self, direction: Direction) -> float:
        """Fringe period in projector px."""
        return self.pitch_horizontal_px if direction == "horizontal" else self.pitch_vertical_px

    def pattern_length(self, direction: Direction) -> int:
        """Projector px along which the fringes vary: the rows for horizontal, the columns for vertical ones."""
        return self.projector.height if direction == "horizontal" else self.projector.width

    @property
    def baseline_m(self) -> float:
        """Distance of the two centres of projection."""
        return math.sqrt(sum(t * t for t in self.translation_m))

    def scaled(self, size: int) -> "Rig":
        """The rig with a camera image ``size`` px wide; the projector, and with it the ambiguity, stays as it is."""
        return replace(self, camera=self.camera.scaled(size))

    def project(self, points_m: ArrayLike) -> Maps:
        """Projector pixels (u_p, v_p) of points (..., 3) in the CAMERA's frame, metres; NaN behind the projector."""
        points = np.asarray(points_m, dtype=np.float64)
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        # Added in this order on every processor, which a matrix product is not.
        turned = [row[0] * x + row[1] * y + row[2] * z + shift for row, shift in zip(self.R, self.t, strict=True)]
        return self.projector.project(np.stack(turned, axis=-1))

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, lists and mappings, as stored with a dataset; see `fpp_ml_bench.optics.rig_file`."""
        from fpp_ml_bench.optics.rig_file import rig_to_dict

        return rig_to_dict(self)

    def _central_coordinate(self, direction: Direction, depth_m: ArrayLike, shift_px: float = 0.0) -> NDArray:
        """Projector coordinate seen ``shift_px`` beside the camera's central pixel, (K,) for depths (K,)."""
        centre = (self.camera.width - 1) / 2, (self.camera.height - 1) / 2
        axis = 0 if direction == "vertical" else 1
        pixel = [c + (shift_px if i == axis else 0.0) for i, c in enumerate(centre)]
        x, y = self.camera.normalised(*pixel)
        depth = np.atleast_1d(np.asarray(depth_m, dtype=np.float64))
        seen = self.project(np.stack([x * depth, y * depth, depth], axis=-1))[axis]
        if not np.all(np.isfinite(seen)):
            raise RigError(
                "the projector does not look at what the camera's central pixel sees: check rotation and signs"
            )
        return seen

    def periods_in_range(self, direction: Direction) -> float:
        """Fringe periods that the central camera pixel's ray crosses within the working range (2.4 and 1.9 here)."""
        near, far = self._central_coordinate(direction, np.array(self.working_range_mm) / MM_PER_M)
        return abs(float(near - far)) / self.pitch(direction)

    def image_px_per_period(self, direction: Direction) -> float:
        """Image px a fringe period covers at the image centre, on a plane square to the axis at the standoff.

        Central difference over one image px along the axis that the fringes vary; 22.56 for the paper's rig at 960 px.
        """
        left, right = (self._central_coordinate(direction, self.standoff_m, s)[0] for s in (-0.5, 0.5))
        change = abs(float(right - left))
        return self.pitch(direction) / change if change > 0 else math.inf

    def check_sampling(self) -> None:
        """Raise `RigError` where a fringe period covers fewer than 4 image px, naming the pitch that would do."""
        for direction in DIRECTIONS:
            seen = self.image_px_per_period(direction)
            if seen < LEAST_IMAGE_PX_PER_PERIOD:
                needed = self.pitch(direction) * LEAST_IMAGE_PX_PER_PERIOD / seen
                raise RigError(
                    f"{direction} fringes: a period of {self.pitch(direction):g} projector px covers only {seen:.2f} "
                    f"px of a {self.camera.width} px image and {LEAST_IMAGE_PX_PER_PERIOD:g} are needed: use a larger "
                    f"size, or a pitch of at least {math.ceil(needed * 100) / 100:g} px"
                )


def paper_rig(size: int = FULL_SIZE) -> Rig:
    """The paper's rig (Table 1 and the public simulator's coordinates), its camera image ``size`` px square."""
    focal = FULL_SIZE * 50 / 20.9995  # 50 cm focal length, 20.9995 cm horizontal aperture, square pixels
    centre = (FULL_SIZE - 1) / 2
    camera = Pinhole(FULL_SIZE, FULL_SIZE, focal, focal, centre, centre)
    projector = Pinhole(912, 1140, 1824.0, 1824.0, 911 / 2, 1139 / 2)
    rig = Rig(camera, projector, ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (0.125, -0.1, 0.0))
    return rig if size == FULL_SIZE else rig.scaled(size)
