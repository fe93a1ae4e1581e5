"""What a decoding writes: depth in the forms that other programs read (.npy, .mat, 16-bit PNG,
point cloud and mesh as PLY), other maps, a picture and a report.

Points are in mm in the camera's frame (x right, y down, z forward), their normals point at the
camera.
"""

import io
import json
import re
from collections.abc import Sequence
from dataclasses import asdict
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fpp_ml_bench.coding.code import Reason
from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.containers import matrix_bytes, pfm_bytes
from fpp_ml_bench.errors import CaptureError
from fpp_ml_bench.examination.findings import Examination
from fpp_ml_bench.files import LOCK_FILE, UNFINISHED, first_of, write_files
from fpp_ml_bench.loaders.captures.decoding import DecodedCapture
from fpp_ml_bench.loaders.captures.images import CapturedFrames
from fpp_ml_bench.loaders.pictures import capture_picture
from fpp_ml_bench.optics.pinhole import Pinhole
from fpp_ml_bench.optics.rig import Rig

FORMS = ("npy", "mat", "png", "pfm", "ply", "mesh")
REPORT = "decode.json"
CAMERA_AXES = "unit mm (millimetres); camera axes: x right, y down, z forward"
_WRITTEN = re.compile(
    r"decode\.json|(depth|sigma_mm|modulation|reason)\.npy|depth\.(mat|pfm)|depth_[0-9.]+mm\.png|(points|mesh)\.ply"
    rf"|picture\.png|{UNFINISHED}"
)
"""Names that a decoding writes, and those of the files that a killed one did not finish."""
STEEPEST = 5.0
"""Neighbouring pixels are one surface where depth changes by at most this many times their distance
across the ray: a surface inclined by up to 79 degrees."""
MM_PER_LEVEL = (0.001, 0.01, 0.1, 1.0, 10.0)
"""Units of the PNG; the first one in which the largest depth fits is taken."""
LARGEST_LEVEL = 65534
"""65535 would not tell from a depth that was cut off, and `fpp-eval` refuses it."""

Part = tuple[slice, slice]
_ALL, _BEFORE, _AFTER = slice(None), slice(None, -1), slice(1, None)
_FIRST, _RIGHT, _BELOW, _ACROSS = (
    (_BEFORE, _BEFORE),
    (_BEFORE, _AFTER),
    (_AFTER, _BEFORE),
    (_AFTER, _AFTER),
)
"""The corners of every square of four pixels."""


def export_capture(
    folder: str | Path,
    depth_mm: ArrayLike,
    camera: Pinhole,
    grey: ArrayLike | None = None,
    forms: Sequence[str] = FORMS,
) -> list[Path]:
    """Write a depth map (H, W) in mm, 0 = none, into ``folder``; returns the files written, in the
    order of ``forms``::

        npy    depth.npy: float32 mm
        mat    depth.mat: float32 mm, variable depthMap
        png    depth_0.1mm.png: 16-bit levels of a unit from 0.001 to 10 mm, the finest that fits; the unit is in the
               name and in the text chunk mm_per_level
        pfm    depth.pfm: portable float map, float32 mm
        ply    points.ply: binary, a point per pixel with depth: position in mm, normal, and ``grey`` (H, W), grey
               levels of 0 to 255, as intensity and colour
        mesh   mesh.ply: the same points, neighbours joined by triangles

    Raises `CaptureError` for a map that is not finite, negative, empty or of another size than the
    camera's, for grey levels that do not fit, an unknown form, or a folder that can't be
    written."""
    if not forms or not set(forms) <= set(FORMS):
        raise CaptureError(
            f"forms: expected some of {', '.join(FORMS)}, got "
            f"{', '.join(map(str, forms)) or 'none'}"
        )
    depth = _checked(depth_mm, camera, "depth_mm").astype(np.float32)
    if not depth.any():
        raise CaptureError(
            "depth_mm: no pixel has a depth, so there is nothing to write; check the capture's "
            "light"
        )
    shade = None if grey is None else _checked(grey, camera, "grey", GREY_LEVELS)
    written = {
        "npy": lambda: ("depth.npy", _npy(depth)),
        "mat": lambda: ("depth.mat", matrix_bytes({"depthMap": depth})),
        "png": lambda: _named_png(depth),
        "pfm": lambda: ("depth.pfm", pfm_bytes(depth)),
        "ply": lambda: ("points.ply", depth_ply(depth, camera, shade)),
        "mesh": lambda: ("mesh.ply", depth_ply(depth, camera, shade, joined=True)),
    }
    return write_files(Path(folder), dict(written[form]() for form in forms), CaptureError)


def _npy(values: NDArray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, values)
    return buffer.getvalue()


def pixel_normals(
    depth_mm: ArrayLike, camera: Pinhole, steepest: float = STEEPEST
) -> NDArray[np.float64]:
    """Unit normals float64 (H, W, 3) of a depth map (H, W) in mm, towards the camera; 0 where there
    is no depth. From the differences to the neighbours that belong to the same surface
    (``steepest`` as `STEEPEST`), and along the ray where there are too few. Raises `CaptureError`
    as `export_capture`."""
    rays, depth = _rays_and_depth(depth_mm, camera)
    points = rays * depth[..., None]
    tangents = []
    for part, other in (((_BEFORE, _ALL), (_AFTER, _ALL)), ((_ALL, _BEFORE), (_ALL, _AFTER))):
        joined = _joined(rays, depth, part, other, steepest)
        difference = np.where(joined[..., None], points[other] - points[part], 0.0)
        tangent = np.zeros_like(points)
        tangent[part] += difference
        tangent[other] += difference
        tangents.append(tangent)
    normals = np.cross(tangents[0], tangents[1])
    towards = (normals * rays).sum(axis=-1) < 0
    normals = np.where(towards[..., None], normals, -rays)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.where(depth[..., None] > 0, normals / np.where(length > 0, length, 1.0), 0.0)


def triangles(depth_mm: ArrayLike, camera: Pinhole) -> NDArray[np.int64]:
    """Triangles (M, 3) between neighbouring pixels of one surface, as indices of pixels, row * W +
    column, in the order that makes their normals point at the camera. A square of four pixels is
    divided along the diagonal that gives more triangles, or has the smaller step. Raises
    `CaptureError` as `export_capture`."""
    rays, depth = _rays_and_depth(depth_mm, camera)
    index = np.arange(depth.size).reshape(depth.shape)

    def whole(*corners: Part) -> tuple[NDArray[np.bool_], tuple[Part, ...]]:
        """Where three corners belong to one surface, pair by pair."""
        pairs = [_joined(rays, depth, corner, other) for corner, other in combinations(corners, 2)]
        return np.logical_and.reduce(pairs), corners

    falling = whole(_FIRST, _BELOW, _ACROSS), whole(_FIRST, _ACROSS, _RIGHT)
    rising = whole(_FIRST, _BELOW, _RIGHT), whole(_RIGHT, _BELOW, _ACROSS)
    more = sum(there.astype(int) for there, _ in falling) - sum(
        there.astype(int) for there, _ in rising
    )
    flatter = np.abs(depth[_FIRST] - depth[_ACROSS]) <= np.abs(depth[_RIGHT] - depth[_BELOW])
    chosen = (more > 0) | ((more == 0) & flatter)
    parts = [(there & chosen, corners) for there, corners in falling]
    parts += [(there & ~chosen, corners) for there, corners in rising]
    return np.concatenate(
        [np.stack([index[corner][there] for corner in corners], -1) for there, corners in parts]
    )


def _checked(
    values: ArrayLike, camera: Pinhole, name: str, most: float = np.inf
) -> NDArray[np.float64]:
    """``values`` as float64 (H, W) of the camera's size, from 0 to ``most``."""
    array = np.asarray(values)
    expected = (camera.height, camera.width)
    if array.dtype.kind not in "iuf" or array.shape != expected:
        raise CaptureError(
            f"{name}: expected real numbers of shape (H, W) = {expected} of the camera, got "
            f"{array.dtype} of shape "
            f"{array.shape}; give the map and the calibration of the same images"
        )
    array = array.astype(np.float64)
    bad = int((~((array >= 0) & (array <= min(most, np.finfo(np.float32).max)))).sum())  # NaN too
    if bad:
        limits = f"from 0 to {most:g}" if np.isfinite(most) else "from 0, which means none, up"
        raise CaptureError(
            f"{name}: expected finite numbers {limits}, got {bad} others (of {array.size} pixels)"
        )
    return array


def _rays_and_depth(
    depth_mm: ArrayLike, camera: Pinhole
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rays (H, W, 3) with z = 1 and the checked depth in mm; both 0 where the lens has no ray."""
    x, y = camera.rays()
    seen = np.isfinite(x) & np.isfinite(y)
    rays = np.where(seen[..., None], np.stack([x, y, np.ones_like(x)], axis=-1), 0.0)
    return rays, np.where(seen, _checked(depth_mm, camera, "depth_mm"), 0.0)


def _joined(
    rays: NDArray[np.float64],
    depth: NDArray[np.float64],
    part: Part,
    other: Part,
    steepest: float = STEEPEST,
) -> NDArray[np.bool_]:
    """Whether the pixels at ``part`` and ``other`` have a depth and belong to the same surface."""
    near, far = depth[part], depth[other]
    apart = (near + far) / 2 * np.linalg.norm(rays[part] - rays[other], axis=-1)
    return (near > 0) & (far > 0) & (np.abs(near - far) <= steepest * apart)


def finest_unit_mm(largest_mm: float) -> float:
    """The first of `MM_PER_LEVEL` in which a depth fits into 16 bits; `CaptureError` where none
    is."""
    fitting = [unit for unit in MM_PER_LEVEL if largest_mm <= LARGEST_LEVEL * unit]
    if not fitting:
        limit = LARGEST_LEVEL * MM_PER_LEVEL[-1]
        raise CaptureError(
            f"depth_mm: {largest_mm:g} mm do not fit in a 16-bit PNG, whose limit is {limit:g} mm; "
            f"use npy"
        )
    return fitting[0]


def depth_png(depth: NDArray[np.float32], unit_mm: float) -> bytes:
    """A depth map in mm, 0 = none, as 16-bit PNG of levels of ``unit_mm``, which it also says."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    levels = np.rint(depth.astype(np.float64) / unit_mm)
    levels = np.where(depth > 0, np.clip(levels, 1, LARGEST_LEVEL), 0).astype(np.uint16)
    text, buffer = PngInfo(), io.BytesIO()
    text.add_text("mm_per_level", f"{unit_mm:g}")
    Image.fromarray(levels).save(buffer, format="PNG", pnginfo=text)
    return buffer.getvalue()


def _named_png(depth: NDArray[np.float32]) -> tuple[str, bytes]:
    unit_mm = finest_unit_mm(float(depth.max()))
    return f"depth_{unit_mm:g}mm.png", depth_png(depth, unit_mm)


def camera_points(
    depth_mm: ArrayLike, camera: Pinhole
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """The points (N, 3) of a depth map (H, W), 0 = none, in mm in the camera's frame, and their
    pixels, bool (H, W). Raises `CaptureError` for a map without any point, or as
    `export_capture`."""
    rays, depth = _rays_and_depth(depth_mm, camera)
    there = depth > 0
    if not np.any(depth_mm):
        raise CaptureError(
            "depth_mm: all pixels are background (0), so there is no point to write; give a map "
            "that has a depth"
        )
    if not there.any():
        raise CaptureError(
            "depth_mm: no pixel with depth has a ray through the camera's lens, so there is no "
            "point to write; check "
            "the depth and the calibration"
        )
    return (rays * depth[..., None])[there], there


def depth_ply(
    depth_mm: ArrayLike,
    camera: Pinhole,
    grey: ArrayLike | None = None,
    joined: bool = False,
) -> bytes:
    """PLY of `camera_points` with their normals and ``grey`` (H, W), grey levels of 0 to 255,
    ``joined`` by `triangles` or not. Raises `CaptureError` as they do."""
    from fpp_ml_bench.loaders.render.mesh_files import ply_bytes

    points, there = camera_points(depth_mm, camera)
    shade = None if grey is None else _checked(grey, camera, "grey", GREY_LEVELS)[there]
    place = np.cumsum(there.ravel()) - 1
    faces = place[triangles(depth_mm, camera)] if joined else None
    return ply_bytes(points, faces, pixel_normals(depth_mm, camera)[there], shade, CAMERA_AXES)


def check_outputs(folder: Path) -> list[Path]:
    """What an earlier decoding left in ``folder``. Raises `CaptureError` for a folder that holds
    files which no decoding writes, or a file in its place."""
    if folder.exists() and not folder.is_dir():
        raise CaptureError(
            f"{folder}: expected a folder for the results, found a file; give another name"
        )
    paths = (
        sorted(path for path in folder.iterdir() if path.name != LOCK_FILE)
        if folder.is_dir()
        else []
    )
    others = [path.name for path in paths if path.is_dir() or not _WRITTEN.fullmatch(path.name)]
    if others:
        raise CaptureError(
            f"{folder}: holds files that no decoding writes: {first_of(others, 4)}; give a new "
            f"folder"
        )
    return paths


def clear_outputs(folder: Path) -> None:
    """Remove what an earlier decoding left in ``folder``, also one that was killed; its report
    first, without which the rest is no result. Raises `CaptureError` as `check_outputs`, and where
    a file can't be removed."""
    try:
        for path in sorted(check_outputs(folder), key=lambda path: path.name != REPORT):
            path.unlink()
    except OSError as error:
        raise CaptureError(
            f"{error.filename}: can't be removed ({error.strerror}); give a new folder"
        ) from error


def write_capture(
    folder: Path,
    capture: CapturedFrames,
    rig: Rig,
    result: DecodedCapture,
    forms: Sequence[str] = FORMS,
) -> None:
    """Write a decoded capture in place of what an earlier decoding left in ``folder``: the
    ``forms`` of `export_capture`, maps as .npy, a picture, and `REPORT` at last."""
    clear_outputs(folder)
    decoded, valid = result.decoded, result.decoded.depth_mm > 0
    export_capture(folder, decoded.depth_mm, rig.camera, result.grey, forms)
    title = f"{capture.files[0].parent.name}: {100 * valid.mean():.1f}% of the pixels with depth"
    sigma_mm, modulation, reason = result.sigma_mm, result.modulation, decoded.reason
    contents = {
        "sigma_mm.npy": _npy(sigma_mm),
        "modulation.npy": _npy(modulation),
        "reason.npy": _npy(reason),
        "picture.png": capture_picture(
            title,
            result.grey,
            decoded.depth_mm,
            sigma_mm,
            modulation,
            reason,
            result.examination.findings,
        ),
    }
    write_files(folder, contents, CaptureError)
    write_report(
        folder,
        capture,
        rig,
        result.examination,
        pixels=decoded.counts,
        noise_grey=result.noise_grey,
        noise_measured=result.noise_measured,
        median_sigma_mm=float(np.median(sigma_mm[valid])),
        median_sigma_mm_by_source=dict(result.budget_mm),
        notes=list(result.notes),
        reasons={reason.name.lower(): int(reason) for reason in Reason},
    )


def write_report(
    folder: Path, capture: CapturedFrames, rig: Rig, examination: Examination, **content: object
) -> None:
    """Write `REPORT` with ``content``, which a refused capture has none of."""
    report = {
        "rig": rig.to_dict(),
        "frames": capture.names,
        "full_scale": capture.full_scale,
        "examination": asdict(examination),
        **content,
    }
    write_files(folder, {REPORT: (json.dumps(report, indent=1) + "\n").encode()}, CaptureError)
