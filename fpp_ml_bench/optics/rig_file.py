"""Rig files: YAML or JSON. Reading is strict, and writing and reading again gives an equal rig::

    camera:    {width: 960, height: 960, fx: 2285.8, fy: 2285.8, cx: 479.5, cy: 479.5, distortion: [k1, k2, p1, p2, k3]}
    projector: {width: 912, height: 1140, fx: 1824.0, fy: 1824.0, cx: 455.5, cy: 569.5, distortion: [0, 0, 0, 0, 0]}
    rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]     # 3 x 3, or a rotation vector of three numbers (rad)
    translation_m: [0.125, -0.1, 0.0]               # X_projector = rotation X_camera + translation_m
    pitch_px: {horizontal: 18, vertical: 18}        # projector px per period of each direction's fringes
    sequence: {steps: 18, bits_horizontal: 7, bits_vertical: 7}
    working_range_mm: [1500, 2100]
    standoff_m: 1.8                                 # by default the middle of the range
    background_m: 3.2                               # a plane behind the range; by default none is known
    calibration_px: 0.05                            # RMS error of the calibration in projector px, if it is known

The sequence above is the paper's. Any other is a code for one direction or both, which holds its
own periods (no ``pitch_px`` then)::

    sequence:
      order: [white, vertical]                      # as captured; by default horizontal, vertical
      vertical: {scheme: phase-shift, pitches_px: [114, 1824], steps: 3, sign: -1}
      # or      {scheme: phase-shift, pitch_px: 36, shifts_deg: [0, 90, 180, 270], gray: {cell_px: 18, bits: 6}}
      # or      {scheme: gray, cell_px: 2, inverse: after each}; least_first: true, origin_px: -56 (where cell 0 begins)
      # or      {scheme: composite, pitches_px: [18, 22]}: one frame, the sum

Crossed fringes are two carriers in a frame (`fpp_ml_bench.coding.Crossed`), beside codes or alone::

    sequence:
      order: [crossed, horizontal, vertical, black, white]
      crossed: {pitches_px: [18, 14], angles_deg: [0, 90], weights: [0.5, 0.5], shifts_deg: [[0, 0], [120, 0]]}

Camera, projector and pose may be those of a calibration by OpenCV (`opencv_files`), in place of
these four entries::

    calibration: calibration.xml                    # or {file: ..., unit: mm, camera_size: [W, H], projector_size: ...}

A distortion has 5, 8, 12 or 14 coefficients (`fpp_ml_bench.optics.pinhole`).
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from fpp_ml_bench.coding.code import mapping, numbers, require
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.errors import RigError
from fpp_ml_bench.files import read_json, read_yaml, write_atomically
from fpp_ml_bench.optics.opencv_files import read_opencv_calibration
from fpp_ml_bench.optics.pinhole import Pinhole
from fpp_ml_bench.optics.rig import Rig, middle_m, rotation_matrix
from fpp_ml_bench.optics.sequence import AXES, CODED_KEYS, DIRECTIONS, Direction, sequence_from_dict

_RIG_KEYS = (
    "camera",
    "projector",
    "rotation",
    "translation_m",
    "pitch_px",
    "sequence",
    "working_range_mm",
)
_OPTIONAL_RIG_KEYS = ("standoff_m", "background_m", "calibration_px")
BASELINES_M, LEAST_FAR_MM, MOST_NEAR_MM = (0.005, 20.0), 10.0, 1e6
"""Lengths of rigs: what lies outside is another unit. A wide limit: microscopes have 10 mm, halls
10 m."""
CALIBRATED_PX, MOST_SHARE = 0.1, 0.05
"""Projector px by which a good calibration is wrong, more than the noise of a phase, and the share
of the depth that this may be, at the far end of the range, where the rig measures best: no more
than a twentieth."""


def rig_from_dict(data: object) -> Rig:
    """The rig that a mapping in the form of this module's docstring describes. Raises `RigError`
    naming the key for anything unknown, missing, of the wrong type, or impossible as a rig."""
    sequence = data.get("sequence") if isinstance(data, Mapping) else None
    coded = isinstance(sequence, Mapping) and any(key in sequence for key in CODED_KEYS)
    keys = tuple(key for key in _RIG_KEYS if not (coded and key == "pitch_px"))
    entries = mapping(data, keys, "", _OPTIONAL_RIG_KEYS)
    if not coded:
        pitch = mapping(entries.pop("pitch_px"), DIRECTIONS, "pitch_px")
        entries |= {f"pitch_{direction}_px": pitch[direction] for direction in DIRECTIONS}
    for device in ("camera", "projector"):
        values = mapping(entries[device], [entry.name for entry in fields(Pinhole)], device)
        if isinstance(lens := values["distortion"], list | tuple) and len(lens) == 4:
            raise RigError(
                f"{device}.distortion: expected at least 5 numbers, got 4; write k3 too, as 0"
            )
        try:
            entries[device] = Pinhole(**values)
        except RigError as error:
            raise RigError(f"{device}.{error}") from error
    turn = entries["rotation"]
    if (
        isinstance(turn, list | tuple)
        and len(turn) == 3
        and not any(isinstance(v, list | tuple) for v in turn)
    ):
        entries["rotation"] = rotation_matrix(numbers(turn, 3, "rotation")).tolist()
    lengths: dict[Direction, int] = {
        "horizontal": entries["projector"].height,
        "vertical": entries["projector"].width,
    }
    entries["sequence"] = sequence_from_dict(entries["sequence"], lengths)
    entries.setdefault("background_m", None)
    if "standoff_m" not in entries:
        entries["standoff_m"] = middle_m(
            numbers(entries["working_range_mm"], 2, "working_range_mm")
        )
    return Rig(**entries)


def is_json(path: Path) -> bool:
    """Whether a rig file is JSON, else YAML, by its suffix. Raises `RigError` for any other."""
    suffix = path.suffix.lower()
    require(
        suffix in (".yaml", ".yml", ".json"),
        f"{path}: expected a rig file ending in .yaml, .yml or .json",
    )
    return suffix == ".json"


def load_rig(path: str | Path) -> Rig:
    """Read a rig from a YAML or JSON file; raises `RigError` naming the file and the key that is
    wrong."""

    def build(data: object) -> Rig:
        if not isinstance(data, Mapping) or "calibration" not in data:
            rig = rig_from_dict(data)
            check_lengths(rig, "translation_m", "m")
            return rig
        entries = dict(data)
        named = entries.pop("calibration")
        twice = [
            key for key in ("camera", "projector", "rotation", "translation_m") if key in entries
        ]
        require(
            not twice,
            f"calibration: {', '.join(twice)} given besides; a rig has one "
            "calibration: remove one of them",
        )
        given = named if isinstance(named, Mapping) else {"file": named}
        given = mapping(given, ("file",), "calibration", ("unit", "camera_size", "projector_size"))
        file, unit = given["file"], str(given.get("unit", "mm"))
        require(
            isinstance(file, str), f"calibration.file: expected the name of a file, got {file!r}"
        )
        sizes: dict[str, Any] = {
            key: tuple(map(int, numbers(given[key], 2, f"calibration.{key}")))
            for key in ("camera_size", "projector_size")
            if key in given
        }
        calibration = read_opencv_calibration(Path(path).parent / file, unit=unit, **sizes)
        devices = {
            "camera": calibration.camera.to_dict(),
            "projector": calibration.projector.to_dict(),
        }
        pose = {"rotation": calibration.rotation, "translation_m": calibration.translation_m}
        rig = rig_from_dict({**entries, **devices, **pose})
        cure = f"write calibration: {{file: ..., unit: {'m' if unit == 'mm' else 'mm'}}}"
        check_lengths(rig, f"{file}: the translation", unit, cure)
        return rig

    return _loaded(Path(path), build)


def check_lengths(
    rig: Rig, entry: str = "the pose", unit: str | None = None, cure: str | None = None
) -> None:
    """Raise `RigError` for a baseline or a working range that no rig has, and name the unit that
    would fit, and for a baseline that is no use for the range. ``entry``: what gives the baseline;
    ``unit``: mm or m, in which it was read, by default the one that leads to such a baseline;
    ``cure``: what to do where the other unit fits, by default to multiply or divide by 1000."""
    (least, most), (near, far), baseline = BASELINES_M, rig.working_range_mm, rig.baseline_m
    if not least <= baseline <= most:
        in_mm = unit == "mm" if unit else baseline < least
        other, step, factor = (
            ("metres", "multiply", MM_PER_M) if in_mm else ("mm", "divide", 1 / MM_PER_M)
        )
        hint = "check its numbers and their unit"
        if least <= baseline * factor <= most:
            hint = (
                f"as {other} it would be {MM_PER_M * baseline * factor:.5g} mm: "
                f"{cure or f'{step} by 1000'}"
            )
        length = f"{MM_PER_M * baseline:.3g} mm" if baseline < least else f"{baseline:.5g} m"
        raise RigError(f"{entry} gives a baseline of {length}, which no rig has; {hint}")
    if far < LEAST_FAR_MM or near > MOST_NEAR_MM:
        as_metres = f"looks like metres: write [{MM_PER_M * near:g}, {MM_PER_M * far:g}]"
        hint = as_metres if far < LEAST_FAR_MM else "check its unit, mm"
        raise RigError(f"working_range_mm: {near:g} to {far:g} mm, where no rig looks; {hint}")
    if (error := CALIBRATED_PX * _depth_share_of_px(rig)) > MOST_SHARE:
        coded = " and ".join(rig.directions) or "crossed"
        raise RigError(
            f"{entry} gives a baseline that tells no depth: with the {coded} frames an error of "
            f"{CALIBRATED_PX:g} "
            f"projector px, which a good calibration has, moves the depth at the range's far end, "
            f"{far:g} mm, by "
            f"{100 * error:.3g}% of it or more; expected at most {100 * MOST_SHARE:g}%. Check the "
            f"length of the "
            "baseline, whether the coded direction runs along it, and the range"
        )


def _depth_share_of_px(rig: Rig) -> float:
    """Least change of depth, relative to the far end of the working range, that moves the coded
    projector coordinates by a px there; of rays all over the image, 0 where the projector looks at
    none of them."""
    ends = rig.working_range_mm[1] / MM_PER_M * np.array([0.99, 1.01])
    seen = np.array([rig.seen(rig.camera.grid(9), depth_m) for depth_m in ends])
    moved_px = (seen[1] - seen[0])[
        [AXES.index(direction) for direction in rig.directions or DIRECTIONS]
    ]
    most_px = float(np.fmax.reduce(np.linalg.norm(moved_px, axis=0), axis=None))
    return 0.0 if np.isnan(most_px) else 0.02 / max(most_px, 1e-12)


def load_projection(path: str | Path, camera_size: tuple[int, int] | None = None) -> Rig:
    """What a rig file says about the projector alone: its size and sequence, before anything is
    calibrated. The file is a rig file of which only ``projector`` (width and height), ``sequence``
    and, with the paper's kind, ``pitch_px`` are looked at. Returns a rig whose lenses, pose and
    range are placeholders, good for patterns and projector coordinates, with a camera of
    ``camera_size`` (width, height). Raises `RigError` as `load_rig`."""

    def stand_in(data: object) -> Rig:
        require(
            isinstance(data, Mapping),
            f"expected a mapping with the keys projector and sequence, got {data!r}",
        )
        entries = dict(data)  # type: ignore[call-overload]
        device = entries.get("projector")
        require(
            isinstance(device, Mapping),
            f"projector: expected a mapping with width and height, got {device!r}",
        )
        for key in ("width", "height"):
            require(key in device, f"projector.{key}: missing")
        sizes = {"camera": camera_size or (1, 1), "projector": (device["width"], device["height"])}
        lens = {"fx": 1e3, "fy": 1e3, "cx": 0.0, "cy": 0.0, "distortion": [0.0] * 5}
        devices = {
            name: {"width": width, "height": height, **lens}
            for name, (width, height) in sizes.items()
        }
        kept = {key: entries[key] for key in ("sequence", "pitch_px") if key in entries}
        pose = {
            "rotation": np.eye(3).tolist(),
            "translation_m": [0.1, 0.0, 0.0],
            "working_range_mm": [1.0, 1e9],
        }
        return rig_from_dict({**devices, **kept, **pose})

    return _loaded(Path(path), stand_in)


def _loaded(file: Path, build: Callable[[object], Rig]) -> Rig:
    content = (read_json if is_json(file) else read_yaml)(file, RigError)
    try:
        require(content is not None, f"the file is empty; expected the keys {', '.join(_RIG_KEYS)}")
        return build(content)
    except RigError as error:
        raise RigError(f"{file}: {error}") from error


def save_rig(rig: Rig, path: str | Path) -> None:
    """Write a rig as YAML or JSON (by the suffix); `load_rig` gives an equal rig back, to the last
    bit."""
    file = Path(path)
    data = rig.to_dict()
    text = (
        json.dumps(data, indent=2) + "\n"
        if is_json(file)
        else yaml.safe_dump(data, sort_keys=False, width=120)
    )
    try:
        write_atomically(file, text.encode("utf-8"))
    except OSError as error:
        raise RigError(f"{file}: can't be written: {error.strerror or error}") from error
