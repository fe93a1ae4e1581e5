"""Rig files in YAML or JSON: reading is strict, and writing and reading again gives an equal rig.

::

    camera:    {width: 960, height: 960, fx: 2285.8, fy: 2285.8, cx: 479.5, cy: 479.5, distortion: [k1, k2, p1, p2, k3]}
    projector: {width: 912, height: 1140, fx: 1824.0, fy: 1824.0, cx: 455.5, cy: 569.5, distortion: [0, 0, 0, 0, 0]}
    rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]     # 3 x 3, or a rotation vector of three numbers (rad)
    translation_m: [0.125, -0.1, 0.0]               # X_projector = rotation X_camera + translation_m
    pitch_px: {horizontal: 18, vertical: 18}        # projector px per period of each direction's fringes
    sequence: {steps: 18, bits_horizontal: 7, bits_vertical: 7}
    working_range_mm: [1500, 2100]
    standoff_m: 1.8
    background_m: 3.2
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.errors import RigError
from fpp_ml_bench.files import strict_yaml
from fpp_ml_bench.optics.pinhole import Pinhole, numbers
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import DIRECTIONS, Sequence

_PINHOLE_KEYS = ("width", "height", "fx", "fy", "cx", "cy", "distortion")
_SEQUENCE_KEYS = ("steps", "bits_horizontal", "bits_vertical")
_RIG_KEYS = (
    "camera", "projector", "rotation", "translation_m", "pitch_px", "sequence", "working_range_mm", "standoff_m",
    "background_m",
)  # fmt: skip


def _mapping(value: object, keys: tuple[str, ...], name: str) -> Mapping[str, Any]:
    prefix = f"{name}: " if name else ""
    if not isinstance(value, Mapping):
        raise RigError(f"{prefix}expected a mapping with the keys {', '.join(keys)}, got {value!r}")
    unknown = [str(key) for key in value if key not in keys]
    missing = [key for key in keys if key not in value]
    if unknown or missing:
        problems = [f"unknown key {key}" for key in unknown] + [f"missing key {key}" for key in missing]
        raise RigError(f"{prefix}{', '.join(problems)}; expected exactly {', '.join(keys)}")
    return value


def _pinhole(value: object, name: str) -> Pinhole:
    entries = _mapping(value, _PINHOLE_KEYS, name)
    try:
        return Pinhole(**entries)
    except RigError as error:
        raise RigError(f"{name}.{error}") from error


def _sequence(value: object) -> Sequence:
    entries = _mapping(value, _SEQUENCE_KEYS, "sequence")
    for key, entry in entries.items():
        if isinstance(entry, bool) or not isinstance(entry, int):
            raise RigError(f"sequence.{key}: expected a whole number, got {entry!r}")
    try:
        return Sequence(**entries)
    except ValueError as error:
        raise RigError(f"sequence: {error}") from error


def rotation_matrix(vector: tuple[float, ...]) -> NDArray[np.float64]:
    """Rotation matrix float64 (3, 3) of a rotation vector in rad (Rodrigues' formula)."""
    x, y, z = vector
    angle = math.sqrt(x * x + y * y + z * z)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # np.sinc is sin(pi x) / (pi x): both factors stay exact as the angle goes to zero.
    half = np.sinc(angle / (2 * math.pi))
    return np.eye(3) + np.sinc(angle / math.pi) * cross + 0.5 * half * half * (cross @ cross)


def _rotation(value: object) -> Any:
    if isinstance(value, list | tuple) and len(value) == 3 and not any(isinstance(v, list | tuple) for v in value):
        return rotation_matrix(numbers(value, 3, "rotation")).tolist()
    return value


def rig_from_dict(data: object) -> Rig:
    """The rig that a mapping in the form of this module's docstring describes.

    Raises `RigError` naming the key for anything unknown, missing, of the wrong type, or impossible as a rig.
    """
    entries = _mapping(data, _RIG_KEYS, "")
    pitch = _mapping(entries["pitch_px"], DIRECTIONS, "pitch_px")
    return Rig(
        camera=_pinhole(entries["camera"], "camera"),
        projector=_pinhole(entries["projector"], "projector"),
        rotation=_rotation(entries["rotation"]),
        translation_m=entries["translation_m"],
        pitch_horizontal_px=pitch["horizontal"],
        pitch_vertical_px=pitch["vertical"],
        sequence=_sequence(entries["sequence"]),
        working_range_mm=entries["working_range_mm"],
        standoff_m=entries["standoff_m"],
        background_m=entries["background_m"],
    )


def rig_to_dict(rig: Rig) -> dict[str, Any]:
    """The rig as plain numbers, lists and mappings; `rig_from_dict` gives an equal rig back."""

    def pinhole(device: Pinhole) -> dict[str, Any]:
        entries = {key: getattr(device, key) for key in _PINHOLE_KEYS}
        return {**entries, "distortion": list(device.distortion)}

    return {
        "camera": pinhole(rig.camera),
        "projector": pinhole(rig.projector),
        "rotation": [list(row) for row in rig.rotation],
        "translation_m": list(rig.translation_m),
        "pitch_px": {"horizontal": rig.pitch_horizontal_px, "vertical": rig.pitch_vertical_px},
        "sequence": {key: getattr(rig.sequence, key) for key in _SEQUENCE_KEYS},
        "working_range_mm": list(rig.working_range_mm),
        "standoff_m": rig.standoff_m,
        "background_m": rig.background_m,
    }


def _unique_keys(pairs: list[tuple[Any, Any]]) -> dict[Any, Any]:
    mapping: dict[Any, Any] = {}
    for key, value in pairs:
        if key in mapping:
            raise RigError(f"key {key} is given twice in the same mapping; keep one entry")
        mapping[key] = value
    return mapping


def _parse_yaml(text: str) -> object:
    import yaml

    try:
        return strict_yaml(text)
    except (yaml.YAMLError, RecursionError) as error:
        raise RigError(f"malformed YAML: {str(error) or 'nested too deeply'}") from error


def _parse_json(text: str) -> object:
    try:
        return json.loads(text, object_pairs_hook=_unique_keys)
    except (json.JSONDecodeError, RecursionError) as error:
        raise RigError(f"malformed JSON: {error}") from error


def _format_of(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in (".yaml", ".yml", ".json"):
        raise RigError(f"{path}: expected a rig file ending in .yaml, .yml or .json")
    return "json" if suffix == ".json" else "yaml"


def load_rig(path: str | Path) -> Rig:
    """Read a rig from a YAML or JSON file; raises `RigError` naming the file and the key that is wrong."""
    file = Path(path)
    parse = _parse_json if _format_of(file) == "json" else _parse_yaml
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RigError(f"{file}: can't be read as text: {error}") from error
    if not text.strip():
        raise RigError(f"{file}: the file is empty; expected the keys {', '.join(_RIG_KEYS)}")
    try:
        return rig_from_dict(parse(text))
    except RigError as error:
        raise RigError(f"{file}: {error}") from error


def save_rig(rig: Rig, path: str | Path) -> None:
    """Write a rig as YAML or JSON (by the suffix); `load_rig` gives an equal rig back, to the last bit."""
    import yaml

    file = Path(path)
    data = rig_to_dict(rig)
    as_json = _format_of(file) == "json"
    text = json.dumps(data, indent=2) + "\n" if as_json else yaml.safe_dump(data, sort_keys=False, width=120)
    try:
        file.write_text(text, encoding="utf-8")
    except OSError as error:
        raise RigError(f"{file}: can't be written: {error.strerror or error}") from error
