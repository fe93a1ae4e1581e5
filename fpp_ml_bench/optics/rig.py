"""The rig: camera and projector as pinholes with lens distortion, and the pose between them.

OpenCV's conventions: the camera frame has x right, y down, z forward; a point goes from the camera's frame to the
projector's by ``X_p = R X_c + t`` in metres.

A rig file is YAML or JSON; reading is strict, and writing and reading again gives an equal rig::

    camera:    {width: 960, height: 960, fx: 2285.8, fy: 2285.8, cx: 479.5, cy: 479.5, distortion: [k1, k2, p1, p2, k3]}
    projector: {width: 912, height: 1140, fx: 1824.0, fy: 1824.0, cx: 455.5, cy: 569.5, distortion: [0, 0, 0, 0, 0]}
    rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]     # 3 x 3, or a rotation vector of three numbers (rad)
    translation_m: [0.125, -0.1, 0.0]               # X_projector = rotation X_camera + translation_m
    pitch_px: {horizontal: 18, vertical: 18}        # projector px per period of each direction's fringes
    sequence: {steps: 18, bits_horizontal: 7, bits_vertical: 7}
    working_range_mm: [1500, 2100]
    standoff_m: 1.8                                 # by default the middle of the range
    background_m: 3.2                               # a plane behind the range; by default none is known

The sequence above is the paper's. Any other is a code for one direction or both, which holds its own periods (no
``pitch_px`` then)::

    sequence:
      order: [white, vertical]                      # as captured; by default horizontal, vertical
      vertical: {scheme: phase-shift, pitches_px: [114, 1824], steps: 3, sign: -1}
      # or      {scheme: phase-shift, pitch_px: 36, shifts_deg: [0, 90, 180, 270], gray: {cell_px: 18, bits: 6}}
      # or      {scheme: gray, cell_px: 2, inverse: after each}

A distortion has 5, 8, 12 or 14 coefficients (`fpp_ml_bench.optics.pinhole`).
"""

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray

from fpp_ml_bench.coding import SMALLEST_PITCH_PX, Code, bits_needed, cell_count
from fpp_ml_bench.constants import BACKGROUND_M, FULL_SIZE, MM_PER_M, STANDOFF_M, WORKING_RANGE_MM
from fpp_ml_bench.errors import RigError
from fpp_ml_bench.files import strict_yaml
from fpp_ml_bench.optics.pinhole import Maps, Pinhole, number, numbers, require
from fpp_ml_bench.optics.sequence import (
    AXES,
    DIRECTIONS,
    PAPER_SEQUENCE,
    CodedSequence,
    Direction,
    Sequence,
    sequence_from_dict,
)

ROTATION_TOLERANCE = 1e-6
"""Largest accepted |R R^T - I|: what seven printed digits of a calibration leave."""
LEAST_IMAGE_PX_PER_PERIOD = 4.0

Matrix3 = tuple[tuple[float, float, float], ...]


@dataclass(frozen=True)
class Rig:
    """Camera, projector, the pose between them, and the sequence that is projected.

    ``rotation`` (three rows) and ``translation_m`` are kept as tuples, so that a rig is hashable and compares by value;
    `R` and `t` are the arrays. ``pitch_horizontal_px`` is the period of the horizontal fringes along the projector's
    rows, ``pitch_vertical_px`` that of the vertical ones along its columns; with a `CodedSequence` they are its finest
    periods, None for a direction without. ``background_m`` is the distance of a plane behind everything, None where
    none is known. Raises `RigError` for a pose that is no rotation, a zero baseline, an impossible range, a pitch or
    code that doesn't fit."""

    camera: Pinhole
    projector: Pinhole
    rotation: Matrix3
    translation_m: tuple[float, float, float]
    pitch_horizontal_px: float | None = 18.0
    pitch_vertical_px: float | None = 18.0
    sequence: Sequence | CodedSequence = PAPER_SEQUENCE
    working_range_mm: tuple[float, float] = WORKING_RANGE_MM
    standoff_m: float = STANDOFF_M
    background_m: float | None = BACKGROUND_M
    R: NDArray[np.float64] = field(init=False, repr=False, compare=False)
    t: NDArray[np.float64] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if isinstance(self.rotation, str | dict) or not isinstance(self.rotation, Iterable):
            raise RigError(f"rotation: expected three rows of three numbers, got {self.rotation!r}")
        rows = tuple(numbers(row, 3, f"rotation[{i}]") for i, row in enumerate(self.rotation))
        require(len(rows) == 3, f"rotation: expected three rows of three numbers, got {len(rows)} rows")
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
        settings["t"] = np.array(settings["translation_m"])
        for name, value in settings.items():
            object.__setattr__(self, name, value)
        self.R.setflags(write=False)
        self.t.setflags(write=False)
        self._check_pose_and_range()
        for direction in self.directions:
            self._check_code(direction)

    def _check_pose_and_range(self) -> None:
        error = float(np.abs(self.R @ self.R.T - np.eye(3)).max())
        require(
            error <= ROTATION_TOLERANCE,
            f"rotation: not orthonormal, |R R^T - I| is {error:.3g} and may be {ROTATION_TOLERANCE:g}; "
            "write more digits or give a rotation vector",
        )
        require(np.linalg.det(self.R) >= 0, "rotation: determinant is -1, a mirror image; check the sign of one axis")
        require(np.any(self.t), "translation_m: the baseline is zero, so no depth can be triangulated")
        near, far = self.working_range_mm
        require(0 < near < far, f"working_range_mm: expected 0 < near < far, got {near:g} to {far:g} mm")
        outside = f"standoff_m: {self.standoff_m:g} m is outside the working range {near:g} to {far:g} mm"
        require(near <= self.standoff_m * MM_PER_M <= far, outside)
        if self.background_m is not None:
            inside = f"background_m: {self.background_m:g} m must lie beyond the working range, ending at {far:g} mm"
            require(self.background_m * MM_PER_M > far, inside)

    def _check_code(self, direction: Direction) -> None:
        if isinstance(self.sequence, CodedSequence):
            try:
                self.sequence.code(direction).check(self.pattern_length(direction))
            except RigError as error:
                raise RigError(f"sequence.{direction}.{error}") from error
            return
        pitch, length = self.pitch(direction), self.pattern_length(direction)
        fits = f"pitch_px.{direction}: expected {SMALLEST_PITCH_PX:g} to {length} px (the pattern), got {pitch:g} px"
        require(SMALLEST_PITCH_PX <= pitch <= length, fits)
        bits, needed = self.sequence.bits(direction), bits_needed(length, pitch)
        require(
            bits >= needed,
            f"sequence.bits_{direction}: {length} px hold {cell_count(length, pitch)} Gray cells of half a period "
            f"({pitch / 2:g} px), which need {needed} bits, got {bits}",
        )

    @property
    def directions(self) -> tuple[Direction, ...]:
        """The directions whose fringes or codes are projected."""
        return self.sequence.directions

    @property
    def fringe_directions(self) -> tuple[Direction, ...]:
        """Those of `directions` that have sinusoids."""
        return tuple(direction for direction in self.directions if self._pitch(direction) is not None)

    def pitch(self, direction: Direction) -> float:
        """Period of the finest fringes in projector px. Raises `RigError` for a direction without fringes."""
        pitch = self._pitch(direction)
        if pitch is None:
            listed = " and ".join(self.fringe_directions)
            projected = f"{listed} fringes, and no {direction} ones" if listed else "Gray code alone, and no fringes"
            raise RigError(f"this rig projects {projected}")
        return pitch

    @property
    def background(self) -> float:
        """``background_m`` where one is known. Raises `RigError` where none is."""
        require(
            self.background_m is not None,
            "background_m: missing in this rig; give the distance of the plane behind the objects in m",
        )
        return float(self.background_m or 0.0)

    @property
    def paper_sequence(self) -> Sequence:
        """The sequence of a rig of the paper's kind. Raises `RigError` for any other."""
        if not isinstance(self.sequence, Sequence):
            raise RigError(
                "sequence: this needs the paper's kind (steps, bits_horizontal, bits_vertical), and the rig has a code "
                "of its own for each direction"
            )
        return self.sequence

    def _pitch(self, direction: Direction) -> float | None:
        return self.pitch_horizontal_px if direction == "horizontal" else self.pitch_vertical_px

    def code(self, direction: Direction) -> Code:
        """How the direction is coded. Raises `RigError` where it is not."""
        if isinstance(self.sequence, CodedSequence):
            return self.sequence.code(direction)
        return self.sequence.code(direction, self.pitch(direction))

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
        """Plain numbers, lists and mappings, as stored with a dataset; `rig_from_dict` gives an equal rig back."""
        content: dict[str, Any] = {
            "camera": self.camera.to_dict(), "projector": self.projector.to_dict(),
            "rotation": [list(row) for row in self.rotation], "translation_m": list(self.translation_m),
            "pitch_px": {direction: self._pitch(direction) for direction in DIRECTIONS},
            "sequence": self.sequence.to_dict(), "working_range_mm": list(self.working_range_mm),
            "standoff_m": self.standoff_m, "background_m": self.background_m,
        }  # fmt: skip
        if isinstance(self.sequence, CodedSequence):
            del content["pitch_px"]
        return content

    def _central_coordinate(self, direction: Direction, depth_m: ArrayLike, shift_px: float = 0.0) -> NDArray:
        """Projector coordinate seen ``shift_px`` beside the camera's central pixel, (K,) for depths (K,)."""
        centre = (self.camera.width - 1) / 2, (self.camera.height - 1) / 2
        axis = AXES.index(direction)
        pixel = [c + (shift_px if i == axis else 0.0) for i, c in enumerate(centre)]
        x, y = self.camera.normalised(*pixel)
        depth = np.atleast_1d(np.asarray(depth_m, dtype=np.float64))
        seen = self.project(np.stack([x * depth, y * depth, depth], axis=-1))[axis]
        unseen = "the projector does not look at what the camera's central pixel sees: check rotation and signs"
        require(np.all(np.isfinite(seen)), unseen)
        return seen

    def periods_in_range(self, direction: Direction) -> float:
        """Fringe periods that the central camera pixel's ray crosses within the working range (2.4 and 1.9 here)."""
        near, far = self._central_coordinate(direction, np.array(self.working_range_mm) / MM_PER_M)
        return abs(float(near - far)) / self.pitch(direction)

    def image_px_per_period(self, direction: Direction) -> float:
        """Image px a fringe period covers at the image centre, on a plane square to the axis at the standoff: central
        difference over one image px along the axis that the fringes vary; 22.56 for the paper's rig at 960 px."""
        return self._image_px(direction, self.pitch(direction))

    def projector_px_per_image_px(self, direction: Direction) -> float:
        """Projector px that an image px covers there, along the axis that the direction's frames vary."""
        pitch = self._pitch(direction) or 1.0
        return pitch / self._image_px(direction, pitch)

    def _image_px(self, direction: Direction, projector_px: float) -> float:
        left, right = (self._central_coordinate(direction, self.standoff_m, s)[0] for s in (-0.5, 0.5))
        return projector_px / change if (change := abs(float(right - left))) > 0 else math.inf

    def check_sampling(self) -> None:
        """Raise `RigError` where a fringe period covers fewer than 4 image px, naming the pitch that would do."""
        for direction in self.fringe_directions:
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


def rotation_matrix(vector: tuple[float, ...]) -> NDArray[np.float64]:
    """Rotation matrix float64 (3, 3) of a rotation vector in rad (Rodrigues' formula)."""
    x, y, z = vector
    angle = math.sqrt(x * x + y * y + z * z)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # np.sinc is sin(pi x) / (pi x): both factors stay exact as the angle goes to zero.
    half = np.sinc(angle / (2 * math.pi))
    return np.eye(3) + np.sinc(angle / math.pi) * cross + 0.5 * half * half * (cross @ cross)


_RIG_KEYS = ("camera", "projector", "rotation", "translation_m", "pitch_px", "sequence", "working_range_mm")
_OPTIONAL_RIG_KEYS = ("standoff_m", "background_m")


def _mapping(value: object, keys: Iterable[str], name: str, optional: Iterable[str] = ()) -> dict[str, Any]:
    prefix, expected = f"{name}: " if name else "", ", ".join(keys)
    if not isinstance(value, Mapping):
        raise RigError(f"{prefix}expected a mapping with the keys {expected}, got {value!r}")
    problems = [f"unknown key {key}" for key in value if key not in (*keys, *optional)]
    problems += [f"missing key {key}" for key in keys if key not in value]
    possible = f", and optionally {', '.join(optional)}" if optional else ""
    require(not problems, f"{prefix}{', '.join(problems)}; expected exactly {expected}{possible}")
    return dict(value)


def rig_from_dict(data: object) -> Rig:
    """The rig that a mapping in the form of this module's docstring describes. Raises `RigError` naming the key for
    anything unknown, missing, of the wrong type, or impossible as a rig."""
    sequence = data.get("sequence") if isinstance(data, Mapping) else None
    coded = isinstance(sequence, Mapping) and any(key in sequence for key in ("order", *DIRECTIONS))
    keys = tuple(key for key in _RIG_KEYS if not (coded and key == "pitch_px"))
    entries = _mapping(data, keys, "", _OPTIONAL_RIG_KEYS)
    if not coded:
        pitch = _mapping(entries.pop("pitch_px"), DIRECTIONS, "pitch_px")
        entries |= {f"pitch_{direction}_px": pitch[direction] for direction in DIRECTIONS}
    for device in ("camera", "projector"):
        values = _mapping(entries[device], [entry.name for entry in fields(Pinhole)], device)
        if isinstance(lens := values["distortion"], list | tuple) and len(lens) == 4:
            raise RigError(f"{device}.distortion: expected at least 5 numbers, got 4; write k3 too, as 0")
        try:
            entries[device] = Pinhole(**values)
        except RigError as error:
            raise RigError(f"{device}.{error}") from error
    turn = entries["rotation"]
    if isinstance(turn, list | tuple) and len(turn) == 3 and not any(isinstance(v, list | tuple) for v in turn):
        entries["rotation"] = rotation_matrix(numbers(turn, 3, "rotation")).tolist()
    lengths: dict[Direction, int] = {
        "horizontal": entries["projector"].height, "vertical": entries["projector"].width,
    }  # fmt: skip
    entries["sequence"] = sequence_from_dict(entries["sequence"], lengths)
    entries.setdefault("background_m", None)
    if "standoff_m" not in entries:
        near, far = numbers(entries["working_range_mm"], 2, "working_range_mm")
        entries["standoff_m"] = (near + far) / 2 / MM_PER_M
    return Rig(**entries)


def _unique_keys(pairs: list[tuple[Any, Any]]) -> dict[Any, Any]:
    mapping: dict[Any, Any] = {}
    for key, value in pairs:
        require(key not in mapping, f"key {key} is given twice in the same mapping; keep one entry")
        mapping[key] = value
    return mapping


def _is_json(path: Path) -> bool:
    suffix = path.suffix.lower()
    require(suffix in (".yaml", ".yml", ".json"), f"{path}: expected a rig file ending in .yaml, .yml or .json")
    return suffix == ".json"


def load_rig(path: str | Path) -> Rig:
    """Read a rig from a YAML or JSON file; raises `RigError` naming the file and the key that is wrong."""
    file = Path(path)
    as_json = _is_json(file)
    try:
        text = file.read_text(encoding="utf-8")
        require(text.strip(), f"the file is empty; expected the keys {', '.join(_RIG_KEYS)}")
        return rig_from_dict(json.loads(text, object_pairs_hook=_unique_keys) if as_json else strict_yaml(text))
    except RigError as error:
        raise RigError(f"{file}: {error}") from error
    except (OSError, UnicodeDecodeError) as error:
        raise RigError(f"{file}: can't be read as text: {error}") from error
    except (json.JSONDecodeError, yaml.YAMLError, RecursionError) as error:
        problem = str(error) or "nested too deeply"
        raise RigError(f"{file}: malformed {'JSON' if as_json else 'YAML'}: {problem}") from error


def save_rig(rig: Rig, path: str | Path) -> None:
    """Write a rig as YAML or JSON (by the suffix); `load_rig` gives an equal rig back, to the last bit."""
    file = Path(path)
    data = rig.to_dict()
    text = json.dumps(data, indent=2) + "\n" if _is_json(file) else yaml.safe_dump(data, sort_keys=False, width=120)
    try:
        file.write_text(text, encoding="utf-8")
    except OSError as error:
        raise RigError(f"{file}: can't be written: {error.strerror or error}") from error
