"""What a view with known depth says about the projector: camera rays, depth, and absolute phase in periods.

Absolute phase is counted in periods of the fringes, w / P for a projector coordinate w and a pitch P. The Gray code
counts half periods, so that frames give it without knowing the pitch.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.decoding import decode_stack
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import CalibrationError
from fpp_ml_bench.optics import AXES, Direction, Pinhole, Rig

MOST_PX = 50_000
"""Pixels that a fit uses, of all views together."""
_CODED_PX = 65536


@dataclass(frozen=True)
class DepthView:
    """n pixels of a view, float64: ``rays`` (2, n) normalised x and y, ``depth_mm`` (n,), and of the vertical and the
    horizontal fringes ``periods`` (2, n), absolute phase / 2 pi, and ``modulation`` (2, n), of which only ratios
    count."""

    name: str
    rays: NDArray[np.float64]
    depth_mm: NDArray[np.float64]
    periods: NDArray[np.float64]
    modulation: NDArray[np.float64]

    @property
    def points_m(self) -> NDArray[np.float64]:
        """The surface in the camera's frame, (n, 3)."""
        return np.stack([*self.rays, np.ones(len(self.depth_mm))], axis=1) * self.depth_mm[:, None] / MM_PER_M


def view_from_maps(
    name: str,
    camera: Pinhole,
    periods: Mapping[Direction, NDArray],
    depth_mm: NDArray,
    modulation: Mapping[Direction, NDArray] | None = None,
    most_px: int = MOST_PX,
) -> DepthView:
    """A view from maps (H, W) of the camera's size: absolute phase / 2 pi of both directions, NaN = not decoded, and
    depth in mm, 0 = none. ``modulation`` in grey levels (default: the same at all pixels). At most ``most_px`` pixels
    are kept, spread evenly. Raises `CalibrationError` for an absent direction, maps of another size, or depth that is
    negative or not finite."""
    size = (camera.height, camera.width)
    for direction in AXES:
        if direction not in periods:
            raise CalibrationError(
                f"{name}: has no phase of the {direction} fringes; the projector is found only from both directions"
            )
    strengths = modulation or {direction: np.ones(size) for direction in AXES}
    maps = (
        {"depth": depth_mm} | {f"{d} phase": periods[d] for d in AXES} | {f"{d} modulation": strengths[d] for d in AXES}
    )
    for title, values in maps.items():
        if np.shape(values) != size:
            raise CalibrationError(f"{name}: expected {title} of shape {size} like the camera, got {np.shape(values)}")
    if not np.isfinite(depth_mm).all() or np.min(depth_mm) < 0:
        raise CalibrationError(
            f"{name}: depth is negative, NaN or infinite at some pixels; write 0 where there is none"
        )
    rays = np.stack([axis.reshape(-1) for axis in camera.rays()])
    measured = np.stack([np.asarray(periods[d], dtype=np.float64).reshape(-1) for d in AXES])
    strength = np.stack([np.asarray(strengths[d], dtype=np.float64).reshape(-1) for d in AXES])
    usable = np.isfinite(rays).all(axis=0) & np.isfinite(measured).all(axis=0) & (strength > 0).all(axis=0)
    pixels = np.flatnonzero(object_mask(np.asarray(depth_mm)).reshape(-1) & usable)
    pixels = pixels[:: max(1, -(-len(pixels) // most_px))]
    depth = np.asarray(depth_mm, dtype=np.float64).reshape(-1)[pixels]
    return DepthView(name, rays[:, pixels], depth, measured[:, pixels], strength[:, pixels])


def view_from_frames(
    name: str,
    frames: Sequence[NDArray[np.uint8]] | NDArray[np.uint8],
    depth_mm: NDArray,
    rig: Rig,
    most_px: int = MOST_PX,
) -> DepthView:
    """A view from all frames of ``rig.sequence``, uint8 (H, W) each, and depth in mm (H, W), 0 = none. Of ``rig``, only
    the camera and the sequence are used. Raises `DecodeError` as `decode_stack`, `CalibrationError` as
    `view_from_maps`."""
    # The decoder wants a pitch, and any gives the same periods. A long one in a pattern of as many cells as the bits
    # can tell apart puts each cell's centre where it is without knowing the projector's pixels.
    middle = (_CODED_PX - 1) / 2
    pitch_px = {direction: 2.0 * (_CODED_PX >> rig.sequence.bits(direction)) for direction in AXES}
    coded = replace(
        rig,
        projector=Pinhole(_CODED_PX, _CODED_PX, _CODED_PX, _CODED_PX, middle, middle),
        pitch_horizontal_px=pitch_px["horizontal"],
        pitch_vertical_px=pitch_px["vertical"],
    )
    measured = decode_stack(frames, coded, details=True).details
    periods = {direction: measured[direction].coordinate_px / pitch_px[direction] for direction in AXES}
    modulation = {direction: measured[direction].modulation for direction in AXES}
    return view_from_maps(name, rig.camera, periods, depth_mm, modulation, most_px)
