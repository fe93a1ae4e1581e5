"""A capture to depth: decoding with everything a user wants to know about it, and the files that hold it."""

import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding import MIN_MODULATION, Limits, Reason
from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.decoding import (
    ASSUMED_NOISE_GREY,
    Decoded,
    Directions,
    decode_stack,
    depth_sigma_mm,
    exchanged_frames,
    noise_of_frames,
)
from fpp_ml_bench.errors import CaptureError, DecodeError
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.loaders.captures.exports import FORMS, export_capture
from fpp_ml_bench.loaders.captures.images import CapturedFrames, read_frames
from fpp_ml_bench.loaders.captures.picture import capture_picture
from fpp_ml_bench.optics import Rig

REPORT = "decode.json"
CLIPPED_SHARE = 0.02
"""A frame in which more of the lit pixels than this are at full scale is named."""
_CURES = {
    "outside_range": "the depths lie outside the range: --range",
    "low_modulation": "the fringes are too faint: exposure, or --min-modulation",
    "inconsistent_order": "the code contradicts itself: check the rig's sequence (sign, order, periods)",
}


@dataclass(frozen=True)
class DecodedCapture:
    """A decoded capture: maps (H, W) of standard uncertainty by noise in mm (0 = no depth), modulation and mean of the
    frames in grey levels; the noise of a frame, and whether the frames told it; ``notes`` are sentences."""

    decoded: Decoded
    sigma_mm: NDArray[np.float32]
    modulation: NDArray[np.float32]
    grey: NDArray[np.float32]
    noise_grey: float
    noise_measured: bool
    notes: tuple[str, ...]


def decode_capture(
    capture: CapturedFrames, rig: Rig, direction: Directions = "both", *, mask: NDArray[np.bool_] | None = None,
    min_modulation: float = MIN_MODULATION, noise_grey: float | None = None, threads: int = 1,
) -> DecodedCapture:  # fmt: skip
    """Depth of a capture and what goes with it; arguments as in `decode_stack`. ``noise_grey``: of a frame, by default
    measured where there are four steps and more, else `ASSUMED_NOISE_GREY`. Raises `CaptureError` for images of another
    size than the rig's and frames that changed places, `DecodeError` where nothing can be decoded."""
    frames, names = capture.frames, [file.name for file in capture.files]
    if frames.shape[1:] != (rig.camera.height, rig.camera.width):
        height, width = frames.shape[1:]
        raise CaptureError(
            f"{capture.files[0].parent}: images of {width} x {height} px, and the rig has a camera of "
            f"{rig.camera.width} x {rig.camera.height} px; give the rig that these images were captured with"
        )
    pair = exchanged_frames(list(frames), rig)
    if pair is not None:
        shown = [rig.sequence.frames[index].title.partition(": ")[2] for index in pair]
        raise CaptureError(
            f"{names[pair[0]]} and {names[pair[1]]} seem to have changed places ({shown[0]}, {shown[1]}): as they are, "
            "most lit pixels contradict the code, and exchanged they fit; rename them, or correct the rig's sequence"
        )
    limits = Limits(min_modulation=min_modulation)
    decoded = decode_stack(frames, rig, direction, mask=mask, limits=limits, details=True, threads=threads)
    modulation = np.nanmax([measured.modulation for measured in decoded.details.values()], axis=0)
    measured_grey = noise_of_frames(list(frames), rig) if noise_grey is None else None
    noise = noise_grey if noise_grey is not None else measured_grey or ASSUMED_NOISE_GREY
    notes = [capture.note] if capture.note else []
    if noise_grey is None and measured_grey is None:
        notes.append(f"three steps can't tell their noise; {noise:g} grey level assumed, --noise sets it")
    notes += _clipped(frames, names, modulation >= min_modulation)
    if not decoded.depth_mm.any():
        causes = {name: pixels for name, pixels in decoded.counts.items() if name != "not_asked"}
        cause = max(causes, key=lambda name: causes[name])
        cure = _CURES.get(cause, "check the rig and its sequence")
        raise DecodeError(f"no pixel could be decoded; of most pixels: {cause.replace('_', ' ')}; {cure}")
    sigma_mm = depth_sigma_mm(decoded, rig, noise)
    grey = frames.mean(axis=0, dtype=np.float64).astype(np.float32)
    return DecodedCapture(decoded, sigma_mm, modulation, grey, noise, measured_grey is not None, tuple(notes))


def _clipped(frames: NDArray, names: Sequence[str], lit: NDArray[np.bool_]) -> list[str]:
    shares = [float((frame[lit] >= GREY_LEVELS).mean()) if lit.any() else 0.0 for frame in frames]
    high = [(name, share) for name, share in zip(names, shares, strict=True) if share > CLIPPED_SHARE]
    if not high:
        return []
    listed = ", ".join(f"{name} ({100 * share:.0f}%)" for name, share in high[:4])
    more = f" and {len(high) - 4} more" if len(high) > 4 else ""
    return [f"saturated on lit pixels: {listed}{more}; expose less"]


def read_mask(file: Path, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Where an image or .npy file is not 0, bool (H, W). Raises `CaptureError` for another file or ``shape``, and where
    all of it is 0."""
    if file.suffix.lower() == ".npy":
        try:
            values = np.load(file, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise CaptureError(f"{file}: expected a mask as .npy, can't be read: {error}") from error
    else:
        values = read_frames(file).frames[0]
    if values.shape != shape:
        raise CaptureError(f"{file}: expected a mask of (H, W) = {shape} like the frames, got {values.shape}")
    mask: NDArray[np.bool_] = np.nan_to_num(values) != 0
    if not mask.any():
        raise CaptureError(f"{file}: shows no object: all pixels are 0")
    return mask


def write_capture(
    folder: Path, capture: CapturedFrames, rig: Rig, result: DecodedCapture, forms: Sequence[str] = FORMS
) -> None:
    """Write a decoded capture: the ``forms`` of `export_capture`, maps as .npy, `REPORT`, and with matplotlib a
    picture."""
    decoded, found = result.decoded, result.decoded.depth_mm > 0
    export_capture(folder, decoded.depth_mm, rig.camera, result.grey, forms)
    for name, values in (("sigma_mm", result.sigma_mm), ("modulation", result.modulation), ("reason", decoded.reason)):
        buffer = io.BytesIO()
        np.save(buffer, values)
        write_atomically(folder / f"{name}.npy", buffer.getvalue())
    if find_spec("matplotlib"):  # of the extra page
        title = f"{capture.files[0].parent.name}: {100 * found.mean():.1f}% of the pixels with depth"
        maps = result.grey, decoded.depth_mm, result.sigma_mm, result.modulation, decoded.reason
        write_atomically(folder / "picture.png", capture_picture(title, *maps))
    content = {
        "rig": rig.to_dict(), "frames": [file.name for file in capture.files], "full_scale": capture.full_scale,
        "pixels": decoded.counts, "noise_grey": result.noise_grey, "noise_measured": result.noise_measured,
        "median_sigma_mm": float(np.median(result.sigma_mm[found])), "notes": list(result.notes),
        "reasons": {reason.name.lower(): int(reason) for reason in Reason},
    }  # fmt: skip
    write_atomically(folder / REPORT, (json.dumps(content, indent=1) + "\n").encode())
