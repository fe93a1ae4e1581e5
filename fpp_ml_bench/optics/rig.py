"""The rig: camera and projector as pinholes with lens distortion, and the pose between them.

OpenCV's conventions: the camera frame has x right, y down, z forward; a point goes from the
camera's frame to the projector's by ``X_p = R X_c + t`` in metres.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fpp_ml_bench.coding.code import SMALLEST_PITCH_PX, Code, number, numbers, require
from fpp_ml_bench.coding.crossed import Crossed
from fpp_ml_bench.coding.gray_code import bits_needed, cell_count
from fpp_ml_bench.coding.phase_shift import PhaseShift
from fpp_ml_bench.constants import BACKGROUND_M, MM_PER_M, STANDOFF_M, WORKING_RANGE_MM
from fpp_ml_bench.errors import RigError
from fpp_ml_bench.optics.pinhole import Maps, Pinhole
from fpp_ml_bench.optics.sequence import (
    AXES,
    DIRECTIONS,
    PAPER_PITCH_PX,
    PAPER_SEQUENCE,
    CodedSequence,
    Direction,
    Sequence,
)

ROTATION_TOLERANCE = 1e-6
"""Largest accepted |R R^T - I|: what seven printed digits of a calibration leave."""
LEAST_IMAGE_PX_PER_PERIOD = 4.0

Matrix3 = tuple[tuple[float, float, float], ...]


@dataclass(frozen=True)
class Rig:
    """Camera, projector, the pose between them, and the sequence that is projected.

    ``rotation`` (three rows) and ``translation_m`` are kept as tuples, so that a rig is hashable
    and compares by value; `R` and `t` are the arrays. ``pitch_horizontal_px`` is the period of the
    horizontal fringes along the projector's rows, ``pitch_vertical_px`` that of the vertical ones
    along its columns; with a `CodedSequence` they are its finest periods, None for a direction
    without. ``background_m`` is the distance of a plane behind everything, None where none is
    known. ``calibration_px`` is the RMS error in projector px that the calibration is known to
    have, 0 where it is not known; it goes into stated uncertainties, and two rigs may be equal
    without it. Raises `RigError` for a pose that is no rotation, a zero baseline, an impossible
    range, a pitch or code that doesn't fit."""

    camera: Pinhole
    projector: Pinhole
    rotation: Matrix3
    translation_m: tuple[float, float, float]
    pitch_horizontal_px: float | None = PAPER_PITCH_PX
    pitch_vertical_px: float | None = PAPER_PITCH_PX
    sequence: Sequence | CodedSequence = PAPER_SEQUENCE
    working_range_mm: tuple[float, float] = WORKING_RANGE_MM
    standoff_m: float = STANDOFF_M
    background_m: float | None = BACKGROUND_M
    calibration_px: float = field(default=0.0, compare=False)
    R: NDArray[np.float64] = field(init=False, repr=False, compare=False)
    t: NDArray[np.float64] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if isinstance(self.rotation, str | dict) or not isinstance(self.rotation, Iterable):
            raise RigError(f"rotation: expected three rows of three numbers, got {self.rotation!r}")
        rows = tuple(numbers(row, 3, f"rotation[{i}]") for i, row in enumerate(self.rotation))
        require(
            len(rows) == 3, f"rotation: expected three rows of three numbers, got {len(rows)} rows"
        )
        settings: dict[str, Any] = {"rotation": rows, "R": np.array(rows)}
        for name, count in (("translation_m", 3), ("working_range_mm", 2)):
            settings[name] = numbers(getattr(self, name), count, name)
        positive = ["standoff_m"] + ["background_m"] * (self.background_m is not None)
        for direction in DIRECTIONS:
            name = f"pitch_{direction}_px"
            if isinstance(self.sequence, CodedSequence):
                coded = direction in self.sequence.directions
                settings[name] = self.sequence.code(direction).pitch_px if coded else None
            else:
                positive.append(name)
        for name in positive:
            settings[name] = number(getattr(self, name), name, positive=True)
        settings["calibration_px"] = number(self.calibration_px, "calibration_px")
        require(
            settings["calibration_px"] >= 0,
            f"calibration_px: expected 0 or more, got {self.calibration_px:g}",
        )
        settings["t"] = np.array(settings["translation_m"])
        for name, value in settings.items():
            object.__setattr__(self, name, value)
        self.R.setflags(write=False)
        self.t.setflags(write=False)
        self._check_pose_and_range()
        for direction in self.directions:
            self._check_code(direction)
        if self.crossed is not None:
            try:
                self.crossed.check(self.projector.width, self.projector.height)
            except RigError as error:
                raise RigError(f"sequence.crossed.{error}") from error

    def _check_pose_and_range(self) -> None:
        error = float(np.abs(self.R @ self.R.T - np.eye(3)).max())
        require(
            error <= ROTATION_TOLERANCE,
            f"rotation: not orthonormal, |R R^T - I| is {error:.3g} and may be "
            f"{ROTATION_TOLERANCE:g}; "
            "write more digits or give a rotation vector",
        )
        require(
            np.linalg.det(self.R) >= 0,
            "rotation: determinant is -1, a mirror image; check the sign of one axis",
        )
        require(
            np.any(self.t), "translation_m: the baseline is zero, so no depth can be triangulated"
        )
        near, far = self.working_range_mm
        require(
            0 < near < far, f"working_range_mm: expected 0 < near < far, got {near:g} to {far:g} mm"
        )
        outside = (
            f"standoff_m: {self.standoff_m:g} m is outside the working range {near:g} to {far:g} mm"
        )
        require(near <= self.standoff_m * MM_PER_M <= far, outside)
        if self.background_m is not None:
            inside = (
                f"background_m: {self.background_m:g} m must lie beyond the working range, ending "
                f"at {far:g} mm"
            )
            require(self.background_m * MM_PER_M > far, inside)

    def _check_code(self, direction: Direction) -> None:
        if isinstance(self.sequence, CodedSequence):
            try:
                self.sequence.code(direction).check(self.pattern_length(direction))
            except RigError as error:
                raise RigError(f"sequence.{direction}.{error}") from error
            return
        pitch, length = self.pitch(direction), self.pattern_length(direction)
        fits = (
            f"pitch_px.{direction}: expected {SMALLEST_PITCH_PX:g} to {length} px (the pattern), "
            f"got {pitch:g} px"
        )
        require(SMALLEST_PITCH_PX <= pitch <= length, fits)
        bits, needed = self.sequence.bits(direction), bits_needed(length, pitch)
        require(
            bits >= needed,
            f"sequence.bits_{direction}: {length} px hold {cell_count(length, pitch)} Gray cells "
            f"of half a period "
            f"({pitch / 2:g} px), which need {needed} bits, got {bits}",
        )

    @property
    def directions(self) -> tuple[Direction, ...]:
        """The directions whose fringes or codes are projected."""
        return self.sequence.directions

    @property
    def crossed(self) -> Crossed | None:
        """The family of the sequence's crossed frames; None where it has none."""
        return self.sequence.crossed if isinstance(self.sequence, CodedSequence) else None

    @property
    def fringe_directions(self) -> tuple[Direction, ...]:
        """Those of `directions` that have sinusoids."""
        return tuple(
            direction for direction in self.directions if self._pitch(direction) is not None
        )

    def pitch(self, direction: Direction) -> float:
        """Period of the finest fringes in projector px. Raises `RigError` for a direction without
        fringes."""
        pitch = self._pitch(direction)
        if pitch is None:
            listed = " and ".join(self.fringe_directions)
            alone = (
                "crossed fringes alone"
                if not self.directions
                else "Gray code alone, and no fringes"
            )
            projected = f"{listed} fringes, and no {direction} ones" if listed else alone
            raise RigError(f"this rig projects {projected}")
        return pitch

    @property
    def background(self) -> float:
        """``background_m`` where one is known. Raises `RigError` where none is."""
        require(
            self.background_m is not None,
            "background_m: missing in this rig; give the distance of the plane behind the objects "
            "in m",
        )
        return float(self.background_m or 0.0)

    @property
    def paper_sequence(self) -> Sequence:
        """The sequence of a rig of the paper's kind. Raises `RigError` for any other."""
        if not isinstance(self.sequence, Sequence):
            raise RigError(
                "sequence: this needs the paper's kind (steps, bits_horizontal, bits_vertical), "
                "and the rig has a code "
                "of its own for each direction"
            )
        return self.sequence

    def _pitch(self, direction: Direction) -> float | None:
        return self.pitch_horizontal_px if direction == "horizontal" else self.pitch_vertical_px

    def code(self, direction: Direction) -> Code:
        """How the direction is coded. Raises `RigError` where it is not."""
        return self.sequence.code(direction, self._pitch(direction) or PAPER_PITCH_PX)

    def shifts_rad(self, direction: Direction) -> tuple[float, ...]:
        """Phase shifts of the finest fringes of a direction, frame by frame, so that frame n shows
        ``cos(2 pi w / P + shift_n)`` along the projector coordinate w. Raises `RigError` for a
        direction without fringes."""
        pitch = self.pitch(direction)
        if isinstance(self.sequence, Sequence):
            steps = self.sequence.steps
            return tuple(2 * np.pi * step / steps for step in range(steps))
        code = self.sequence.code(direction)
        if not isinstance(code, PhaseShift):
            return (0.0,)
        turns = code.fringes[code.finest].turns - code.origin_px / pitch
        return tuple((2 * np.pi * turns).tolist())

    def pattern_length(self, direction: Direction) -> int:
        """Projector px along which the fringes vary: the rows for horizontal, the columns for
        vertical ones."""
        return self.projector.height if direction == "horizontal" else self.projector.width

    @property
    def baseline_m(self) -> float:
        """Distance of the two centres of projection."""
        return math.sqrt(sum(t * t for t in self.translation_m))

    @property
    def range_m(self) -> tuple[float, float]:
        """The near and far end of the working range in m."""
        near_mm, far_mm = self.working_range_mm
        return near_mm / MM_PER_M, far_mm / MM_PER_M

    @property
    def half_range_mm(self) -> float:
        """Half the depth of the working range: no surface in it is farther from its middle."""
        near_mm, far_mm = self.working_range_mm
        return (far_mm - near_mm) / 2

    def with_range(self, range_mm: tuple[float, float]) -> "Rig":
        """The rig with another working range, its standoff in the range's middle, and no known
        background."""
        return replace(
            self, working_range_mm=range_mm, standoff_m=middle_m(range_mm), background_m=None
        )

    def scaled(self, size: int) -> "Rig":
        """The rig with a camera image ``size`` px wide; the projector, and with it the ambiguity,
        stays as it is."""
        return replace(self, camera=self.camera.scaled(size))

    def times(self, factor: float) -> "Rig":
        """The rig with all its lengths ``factor`` times as long: it sees an object ``factor`` times
        as large as this one sees the object."""
        x, y, z = (factor * length for length in self.translation_m)
        near, far = (factor * end for end in self.working_range_mm)
        behind = None if self.background_m is None else factor * self.background_m
        return replace(
            self,
            translation_m=(x, y, z),
            working_range_mm=(near, far),
            standoff_m=factor * self.standoff_m,
            background_m=behind,
        )

    def with_crossed(self, crossed: Crossed) -> "Rig":
        """The rig with the frames of ``crossed`` before its own; with others in place of its
        crossed frames."""
        own = self.sequence
        if isinstance(own, CodedSequence):
            order = ("crossed", *(name for name in own.order if name != "crossed"))
            return replace(self, sequence=replace(own, order=order, crossed=crossed))
        horizontal, vertical = (self.code(direction) for direction in DIRECTIONS)
        order = ("crossed", "horizontal", "vertical", "black", "white")
        return replace(self, sequence=CodedSequence(horizontal, vertical, order, crossed))

    def project(self, points_m: ArrayLike) -> Maps:
        """Projector pixels (u_p, v_p) of points (..., 3) in the CAMERA's frame, metres; NaN behind
        the projector."""
        points = np.asarray(points_m, dtype=np.float64)
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        # Added in this order on every processor, which a matrix product is not.
        turned = [
            row[0] * x + row[1] * y + row[2] * z + shift
            for row, shift in zip(self.R, self.t, strict=True)
        ]
        return self.projector.project(np.stack(turned, axis=-1))

    def seen(self, rays: Maps, depth_m: ArrayLike) -> Maps:
        """Projector pixels (u_p, v_p) of what the camera's ``rays``, normalised (x, y), see at
        ``depth_m``, which broadcasts with them; NaN behind the projector."""
        x, y = rays
        depth = np.asarray(depth_m, dtype=np.float64)
        return self.project(np.stack(np.broadcast_arrays(x * depth, y * depth, depth), axis=-1))

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, lists and mappings, as stored with a dataset; `rig_from_dict` gives an
        equal rig back."""
        content: dict[str, Any] = {
            "camera": self.camera.to_dict(),
            "projector": self.projector.to_dict(),
            "rotation": [list(row) for row in self.rotation],
            "translation_m": list(self.translation_m),
            "pitch_px": {direction: self._pitch(direction) for direction in DIRECTIONS},
            "sequence": self.sequence.to_dict(),
            "working_range_mm": list(self.working_range_mm),
            "standoff_m": self.standoff_m,
            "background_m": self.background_m,
        }
        if self.calibration_px:
            content["calibration_px"] = self.calibration_px
        if isinstance(self.sequence, CodedSequence):
            del content["pitch_px"]
        return content

    def _central_coordinate(
        self, direction: Direction, depth_m: ArrayLike, shift_px: float = 0.0
    ) -> NDArray:
        """Projector coordinate seen ``shift_px`` beside the camera's central pixel, (K,) for depths
        (K,)."""
        centre = (self.camera.width - 1) / 2, (self.camera.height - 1) / 2
        axis = AXES.index(direction)
        pixel = [c + (shift_px if i == axis else 0.0) for i, c in enumerate(centre)]
        seen = self.seen(self.camera.normalised(*pixel), np.atleast_1d(depth_m))[axis]
        unseen = (
            "the projector does not look at what the camera's central pixel sees: check rotation "
            "and signs"
        )
        require(np.all(np.isfinite(seen)), unseen)
        return seen

    def in_range(self, depth_mm: ArrayLike) -> NDArray[np.bool_]:
        """Whether a depth in mm lies in the working range, its ends included; of the shape of
        ``depth_mm``. What does not, NaN too, is no depth: every method that measures asks this of
        its final depth, without any tolerance."""
        near, far = self.working_range_mm
        depth = np.asarray(depth_mm)
        return (depth >= near) & (depth <= far)

    def periods_in_range(self, direction: Direction) -> float:
        """Fringe periods that the central camera pixel's ray crosses within the working range (2.4
        and 1.9 here)."""
        near, far = self._central_coordinate(direction, self.range_m)
        return abs(float(near - far)) / self.pitch(direction)

    @property
    def projector_px_per_mm(self) -> float:
        """Projector px by which the pattern's image of the central camera pixel moves for a mm of
        depth at the standoff: central difference over a thousandth of it."""
        ends = self.standoff_m * np.array([0.9995, 1.0005])
        u, v = self.seen(self.camera.normalised(*self.camera.centre), ends)
        moved_px = math.hypot(float(u[1] - u[0]), float(v[1] - v[0]))
        return moved_px / (0.001 * self.standoff_m * MM_PER_M)

    def image_px_per_period(self, direction: Direction) -> float:
        """Image px a fringe period covers at the image centre, on a plane square to the axis at the
        standoff: central difference over one image px along the axis that the fringes vary; 22.56
        for the paper's rig at 960 px."""
        return self._image_px(direction, self.pitch(direction))

    def projector_px_per_image_px(self, direction: Direction) -> float:
        """Projector px that an image px covers there, along the axis that the direction's frames
        vary."""
        pitch = self._pitch(direction) or 1.0
        return pitch / self._image_px(direction, pitch)

    def _image_px(self, direction: Direction, projector_px: float) -> float:
        left, right = (
            self._central_coordinate(direction, self.standoff_m, s)[0] for s in (-0.5, 0.5)
        )
        return projector_px / change if (change := abs(float(right - left))) > 0 else math.inf

    def image_frequency(self, cycles_per_px: tuple[float, float]) -> tuple[float, float]:
        """Cycles per image px along the image's columns and rows of a frequency (f_u, f_v) on the
        pattern, at the image centre on a plane square to the axis at the standoff: a linear map."""
        shifts = np.array([[-0.5, 0.0], [0.5, 0.0], [0.0, -0.5], [0.0, 0.5]])
        beside = np.array([self.camera.width - 1, self.camera.height - 1]) / 2 + shifts
        u, v = self.seen(self.camera.normalised(*beside.T), self.standoff_m)
        turns = cycles_per_px[0] * u + cycles_per_px[1] * v
        return float(turns[1] - turns[0]), float(turns[3] - turns[2])

    def image_px_of_carrier(self, cycles_per_px: tuple[float, float]) -> float:
        """Image px that a period of crossed fringes covers, across them, as `image_px_per_period`
        for the direction of their frequency, `Crossed.cycles_per_px`."""
        cycles = math.hypot(*self.image_frequency(cycles_per_px))
        return 1 / cycles if cycles > 0 else math.inf

    def check_sampling(self) -> None:
        """Raise `RigError` where a fringe period covers fewer than 4 image px, naming the pitch
        that would do."""
        for carrier, cycles_per_px in enumerate(self.crossed.cycles_per_px if self.crossed else ()):
            seen = self.image_px_of_carrier(cycles_per_px)
            if seen < LEAST_IMAGE_PX_PER_PERIOD:
                raise RigError(
                    f"crossed fringes: a period of carrier {carrier + 1} covers only {seen:.2f} px "
                    f"of a "
                    f"{self.camera.width} px image and {LEAST_IMAGE_PX_PER_PERIOD:g} are needed: "
                    f"use a larger size, or "
                    "a larger pitch"
                )
        for direction in self.fringe_directions:
            seen = self.image_px_per_period(direction)
            if seen < LEAST_IMAGE_PX_PER_PERIOD:
                needed = self.pitch(direction) * LEAST_IMAGE_PX_PER_PERIOD / seen
                raise RigError(
                    f"{direction} fringes: a period of {self.pitch(direction):g} projector px "
                    f"covers only {seen:.2f} "
                    f"px of a {self.camera.width} px image and {LEAST_IMAGE_PX_PER_PERIOD:g} are "
                    f"needed: use a larger "
                    f"size, or a pitch of at least {math.ceil(needed * 100) / 100:g} px"
                )


def middle_m(range_mm: tuple[float, ...]) -> float:
    """Middle of a range: the standoff of a rig that names none."""
    near, far = range_mm
    return (near + far) / 2 / MM_PER_M


def rotation_matrix(vector: tuple[float, ...]) -> NDArray[np.float64]:
    """Rotation matrix float64 (3, 3) of a rotation vector in rad (Rodrigues' formula)."""
    x, y, z = vector
    angle = math.sqrt(x * x + y * y + z * z)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # np.sinc is sin(pi x) / (pi x): both factors stay exact as the angle goes to zero.
    half = np.sinc(angle / (2 * math.pi))
    return np.eye(3) + np.sinc(angle / math.pi) * cross + 0.5 * half * half * (cross @ cross)
