"""Calibrations of a camera and a projector in OpenCV's files (FileStorage: XML, YAML, JSON).

Tools name the same numbers differently; these names are read: OpenCV's stereo samples (M1, D1, M2,
D2 or cameraMatrix1, distCoeffs1, ..., R, T), procamcalib and scan3d-capture (cam_K, cam_kc, proj_K,
proj_kc, R, T) and SLStudio (Kc, kc, Kp, kp, Rp, Tp). In all of them a point goes from the camera's
frame to the projector's by ``X_p = R X_c + T``.

On damaged files OpenCV's reader writes outside its memory (OpenCV 5.0: a few thousand random
changes of a file end the process), so it runs in the process of `fpp_ml_bench.containers`.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding.code import require
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.containers import Answer, guarded, limit_memory
from fpp_ml_bench.errors import PredictionError, RigError
from fpp_ml_bench.files import file_content, printable, strict_json, strict_yaml, write_atomically
from fpp_ml_bench.optics.pinhole import Pinhole
from fpp_ml_bench.optics.rig import Matrix3

UNITS = {"mm": MM_PER_M, "m": 1.0}
"""Units of a file's translation, in a metre."""
SUFFIXES = (".xml", ".yaml", ".yml", ".json")
LARGEST_BYTES = 1 << 24
_LONGEST_YAML = 1 << 18
"""Characters that are looked at for the cause where OpenCV can't read a file: parsing YAML in
Python is slow."""
ROUNDED = 1e-5
"""Largest accepted |R R^T - I|: a rotation that was rounded to float32 or to six digits."""
EXACT = 1e-14
"""A rotation closer than this is taken as it is, so that writing and reading gives the same
numbers."""

_NAMES = {
    "camera matrix": ("M1", "cameraMatrix1", "cam_K", "Cam_K", "Kc"),
    "camera's distortion": ("D1", "distCoeffs1", "cam_kc", "Cam_kc", "kc"),
    "projector matrix": ("M2", "cameraMatrix2", "proj_K", "Proj_K", "Kp"),
    "projector's distortion": ("D2", "distCoeffs2", "proj_kc", "Proj_kc", "Proj_Kc", "kp"),
    "rotation": ("R", "Rp"),
    "translation": ("T", "Tp"),
}
_CURE = (
    "give the numbers in the rig file's own entries (camera, projector, rotation, translation_m), "
    "or write the file by "
    "cv2.FileStorage"
)
_SIZES = {"camera": ("imageSize1", "imageSize"), "projector": ("imageSize2",)}
_WIDTH_AND_HEIGHT = {
    "camera": ("frameWidth", "frameHeight"),
    "projector": ("screenResX", "screenResY"),
}
_ERRORS = ("cam_error", "proj_error", "stereo_error")


@dataclass(frozen=True)
class OpenCvCalibration:
    """Camera and projector, and the pose between them: ``X_p = rotation X_c + translation_m``.
    ``errors_px``: the reprojection errors of camera, projector and both that the calibrating tool
    reported, None where it did not."""

    camera: Pinhole
    projector: Pinhole
    rotation: Matrix3
    translation_m: tuple[float, float, float]
    errors_px: tuple[float | None, ...] = (None, None, None)


def read_opencv_calibration(
    path: str | Path,
    *,
    camera_size: tuple[int, int] | None = None,
    projector_size: tuple[int, int] | None = None,
    unit: str = "mm",
) -> OpenCvCalibration:
    """The calibration in a file. ``camera_size`` and ``projector_size``: (width, height) in px,
    needed where the file does not store them; ``unit``: mm or m, of its translation. A rotation
    rounded to float32 becomes the nearest exact one. Raises `RigError` naming the file for anything
    missing, of a wrong shape, not finite, or impossible."""
    require(unit in UNITS, f"unit: expected {' or '.join(UNITS)}, got {unit!r}")
    nodes = _nodes(Path(path))
    require(
        any(name in nodes for names in _NAMES.values() for name in names),
        f"{path}: {_other_layout(nodes)}",
    )
    try:
        translation = _matrix(nodes, "translation", (3, 1), (1, 3)).ravel()
        require(
            np.any(translation),
            "the translation is zero, so no depth can be triangulated; calibrate again",
        )
        return OpenCvCalibration(
            _device(nodes, "camera", camera_size),
            _device(nodes, "projector", projector_size),
            _rotation(_matrix(nodes, "rotation", (3, 3))),
            tuple((translation / UNITS[unit]).tolist()),
            tuple(_error(nodes, name) for name in _ERRORS),
        )
    except RigError as error:
        raise RigError(f"{path}: {error}") from error


def write_opencv_calibration(
    calibration: OpenCvCalibration, path: str | Path, unit: str = "mm"
) -> None:
    """Write a calibration as XML, YAML or JSON (by the suffix) with the names of OpenCV's stereo
    samples (M1, D1, M2, D2, R, T), sizes as imageSize1 and imageSize2 and errors as cam_error,
    proj_error and stereo_error. Reading it gives equal numbers; only a translation that is no
    number of mm by 1000 changes, by its last bit, where ``unit`` is mm. Raises `RigError` for
    another suffix or unit, or when the file can't be written."""
    import cv2

    file = Path(path)
    require(unit in UNITS, f"unit: expected {' or '.join(UNITS)}, got {unit!r}")
    require(
        file.suffix.lower() in SUFFIXES, f"{file}: expected a file ending in {', '.join(SUFFIXES)}"
    )
    storage = cv2.FileStorage()
    storage.open(
        f"calibration{file.suffix.lower()}", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY
    )
    for number, device in enumerate((calibration.camera, calibration.projector), 1):
        matrix = [[device.fx, 0.0, device.cx], [0.0, device.fy, device.cy], [0.0, 0.0, 1.0]]
        storage.write(f"M{number}", np.array(matrix))
        storage.write(f"D{number}", np.array([device.distortion]))
        storage.startWriteStruct(f"imageSize{number}", cv2.FileNode_SEQ | cv2.FileNode_FLOW)
        storage.write("", device.width)
        storage.write("", device.height)
        storage.endWriteStruct()
    storage.write("R", np.array(calibration.rotation))
    storage.write("T", np.array([[_in_unit(t, UNITS[unit])] for t in calibration.translation_m]))
    for name, error_px in zip(_ERRORS, calibration.errors_px, strict=True):
        if error_px is not None:
            storage.write(name, error_px)
    try:
        write_atomically(file, storage.releaseAndGetString().encode())
    except OSError as error:
        raise RigError(f"{file}: can't be written: {error.strerror or error}") from error


def _in_unit(length_m: float, per_metre: float) -> float:
    """The number that, read again, gives ``length_m`` to the last bit, where there is one."""
    near = length_m * per_metre
    return next(
        (
            n
            for n in (near, np.nextafter(near, -np.inf), np.nextafter(near, np.inf))
            if n / per_metre == length_m
        ),
        near,
    )


def _device(nodes: dict[str, Any], name: str, given: tuple[int, int] | None) -> Pinhole:
    matrix = _matrix(nodes, f"{name} matrix", (3, 3))
    (fx, skew, cx), (zero, fy, cy), last = matrix.tolist()
    upper = skew == zero == 0.0 and last == [0.0, 0.0, 1.0]
    require(
        upper, f"{name} matrix: expected fx 0 cx, 0 fy cy, 0 0 1 (no skew), found {matrix.tolist()}"
    )
    distortion = _matrix(nodes, f"{name}'s distortion", None).ravel()
    width, height = _size(nodes, name, given)
    try:
        return Pinhole(width, height, fx, fy, cx, cy, tuple(distortion.tolist()))
    except RigError as error:
        raise RigError(
            f"{name}: {error}; a calibration in px with OpenCV's lens model is needed"
        ) from error


def _size(nodes: dict[str, Any], name: str, given: tuple[int, int] | None) -> tuple[int, int]:
    """(width, height) in the files, or as given."""
    stored: Any = next((nodes[key] for key in _SIZES[name] if key in nodes), None)
    pair = _WIDTH_AND_HEIGHT[name]
    if stored is None and all(key in nodes for key in pair):
        stored = [nodes[key] for key in pair]
    stored = np.ravel(stored["data"]).tolist() if isinstance(stored, dict) else stored
    names = ", ".join((*_SIZES[name], " with ".join(pair)))
    if stored is None:
        missing = (
            f"the size of the {name} is not stored ({names}); give {name}_size=(width, height) in "
            f"px"
        )
        require(given is not None, missing)
        return given  # type: ignore[return-value]
    whole = (
        isinstance(stored, list)
        and len(stored) == 2
        and all(isinstance(n, int | float) for n in stored)
    )
    whole = whole and all(np.isfinite(n) and n == int(n) for n in stored)
    require(
        whole, f"size of the {name}: expected width and height in px ({names}), found {stored!r}"
    )
    width, height = (int(n) for n in stored)
    other = (
        f"{name}_size is given as {given}, but the file says {(width, height)}; give the size of "
        f"the calibration"
    )
    require(given is None or tuple(given) == (width, height), other)
    return width, height


def _rotation(matrix: NDArray[np.float64]) -> Matrix3:
    error = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    wrong = f"rotation: not orthonormal, |R R^T - I| is {error:.3g} and may be {ROUNDED:g}"
    require(error <= ROUNDED, f"{wrong}; write more digits, or calibrate again")
    require(
        np.linalg.det(matrix) > 0,
        "rotation: determinant is -1, a mirror image; check the sign of one axis",
    )
    if error > EXACT:
        left, _, right = np.linalg.svd(matrix)
        matrix = left @ right
    return tuple(tuple(row) for row in matrix.tolist())


def _error(nodes: dict[str, Any], name: str) -> float | None:
    value = nodes.get(name)
    number = value is None or (isinstance(value, int | float) and np.isfinite(value) and value >= 0)
    require(
        number,
        f"{name}: expected a reprojection error in px, found {value!r}; remove it if it is not "
        f"known",
    )
    return None if value is None else float(value)


def _matrix(
    nodes: dict[str, Any], what: str, *shapes: tuple[int, int] | None
) -> NDArray[np.float64]:
    """The finite matrix of one of ``shapes``, or any vector for None, that the nodes hold under one
    of its names."""
    names = [name for name in _NAMES[what] if name in nodes]
    expected = f"{what}: expected a node {' or '.join(_NAMES[what])}"
    require(
        names,
        f"{expected}, found {printable(', '.join(nodes)) or 'no nodes'}; if the file is of another "
        f"tool, {_CURE}",
    )
    require(len(names) == 1, f"{expected}, found {' and '.join(names)}; keep one of them")
    node = nodes[names[0]]
    no_matrix = f"{names[0]} ({what}): expected a matrix, found {printable(node)}; {_CURE}"
    require(isinstance(node, dict), no_matrix)
    values = np.array(node["data"], dtype=np.float64).reshape(node["shape"])
    if shapes == (None,):
        require(
            values.size == max(values.shape),
            f"{names[0]} ({what}): expected a vector, found shape {values.shape}",
        )
    else:
        sizes = " or ".join(f"{rows} x {columns}" for rows, columns in filter(None, shapes))
        require(
            values.shape in shapes,
            f"{names[0]} ({what}): expected {sizes} numbers, found shape {values.shape}",
        )
    require(
        np.isfinite(values).all(),
        f"{names[0]} ({what}): expected finite numbers, found {values.tolist()}",
    )
    return values


def _nodes(path: Path) -> dict[str, Any]:
    """The file's top nodes: matrices as shape and data, sequences as lists, numbers and text as
    they are."""
    cure = "give a calibration that OpenCV's FileStorage wrote (XML, YAML or JSON)"
    content = file_content(path, LARGEST_BYTES, RigError, cure)
    require(content, f"{path}: the file is empty; {cure}")
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        raise RigError(f"{path}: expected text, found other bytes; {cure}") from None
    try:
        return guarded(_read_nodes, content, LARGEST_BYTES)[0]["nodes"]
    except PredictionError as error:
        if keys := _keys(text, path.suffix.lower()):
            raise RigError(f"{path}: {_other_layout(keys)}") from None
        problem = "the file is damaged or of another format, OpenCV can't read it"
        raise RigError(f"{path}: {problem} ({error}); {cure}") from None


def _other_layout(keys: Iterable[str]) -> str:
    expected = "expected the nodes M1, D1, M2, D2, R, T (OpenCV's matrices)"
    key_names = printable(", ".join(keys)) or "none"
    return f"is well-formed, but of another layout: {expected}, found the keys {key_names}; {_CURE}"


def _keys(text: str, suffix: str) -> list[str]:
    """The keys of a JSON or YAML mapping in ``text``, none where it is anything else."""
    try:
        content = strict_json(text) if suffix == ".json" else strict_yaml(text[:_LONGEST_YAML])
    except ValueError:
        return []
    return list(content) if isinstance(content, dict) else []


def _read_nodes(content: bytes, largest: int) -> Answer:
    """The nodes of a file's text; `PredictionError` with the problem where OpenCV can't read it."""
    import cv2

    limit_memory(largest)

    def value(node: Any) -> Any:
        if node.isMap():
            keys = node.keys()
            if not {"rows", "cols", "data"} <= set(
                keys
            ):  # well-formed, and no matrix: of another tool
                return f"a mapping with the keys {', '.join(keys)}"
            if "dt" not in keys:  # written by other tools
                shape = [int(node.getNode(name).real()) for name in ("rows", "cols")]
                data = np.array(value(node.getNode("data")), dtype=np.float64)
                return {
                    "shape": shape if data.size == shape[0] * shape[1] else data.shape,
                    "data": data.tolist(),
                }
            matrix = node.mat()
            matrix = np.zeros((0, 0)) if matrix is None else np.asarray(matrix, dtype=np.float64)
            return {"shape": matrix.shape, "data": matrix.ravel().tolist()}
        if node.isSeq():
            return [value(node.at(i)) for i in range(node.size())]
        return int(node.real()) if node.isInt() else node.real() if node.isReal() else node.string()

    name = None
    try:
        storage = cv2.FileStorage(content.decode(), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        if storage.root().empty() or not storage.root().isMap():
            raise PredictionError("it has no named nodes")
        nodes, names = {}, storage.root().keys()
        for name in names:
            nodes[name] = value(storage.getNode(name))
        return {"nodes": nodes}, b""
    except (cv2.error, SystemError) as error:
        if name is not None:
            raise PredictionError(
                f"node {name} is incomplete, or its numbers do not fill its rows and columns"
            ) from None
        raise PredictionError(
            " ".join(str(error).partition("error: ")[2].split()) or "it can't be parsed"
        ) from None
