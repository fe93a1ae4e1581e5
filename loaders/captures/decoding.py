"""A capture to depth: decoding with everything a user wants to know about it, and the files that hold it."""

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding import MIN_MODULATION, Limits, Reason
from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.decoding import (
    ASSUMED_NOISE_GREY,
    Decoded,
    Directions,
    check_limits,
    decode_stack,
    depth_sigma_mm,
    noise_of_frames,
)
from fpp_ml_bench.errors import CaptureError, DecodeError
from fpp_ml_bench.examination import Examination, RefusedCapture, examine
from fpp_ml_bench.files import file_content, write_atomically
from fpp_ml_bench.loaders.captures.exports import FORMS, REPORT, clear_outputs, export_capture
from fpp_ml_bench.loaders.captures.images import CapturedFrames, read_frames
from fpp_ml_bench.loaders.captures.picture import capture_picture
from fpp_ml_bench.optics import Direction, Rig

CLIPPED_SHARE = 0.02
"""A frame in which more of the lit pixels than this are at full scale is named."""
CAUSES = {
    Reason.NO_RAY: "the rig's lens model or pose is not this scanner's",
    Reason.LOW_MODULATION: "the fringes are too faint (too dark, overexposed, --min-modulation), or the frames are not "
    "in the order of the rig's sequence",
    Reason.SATURATED: "the frames are overexposed",
    Reason.INCONSISTENT_ORDER: "the sequence (order, steps, sign, pitches, Gray code) is not what was projected",
    Reason.OUTSIDE_PATTERN: "the sequence (order, sign, pitches) or the projector's size is not what was projected",
    Reason.DIRECTIONS_DISAGREE: "the rig's pose is not this scanner's, or the directions are swapped",
    Reason.OUTSIDE_RANGE: "working_range_mm does not hold the object (--range), or the rig's pose or unit is not this "
    "scanner's",
}
"""Why nothing is decoded, by the reason of most pixels."""


@dataclass(frozen=True)
class DecodedCapture:
    """A decoded capture: maps (H, W) of standard uncertainty by noise in mm (0 = no depth), modulation and mean of the
    frames in grey levels; the noise of a frame, and whether the frames told it; ``notes`` are sentences;
    ``examination``: what the frames say about themselves."""

    decoded: Decoded
    sigma_mm: NDArray[np.float32]
    modulation: NDArray[np.float32]
    grey: NDArray[np.float32]
    noise_grey: float
    noise_measured: bool
    notes: tuple[str, ...]
    examination: Examination


def decode_capture(
    capture: CapturedFrames,
    rig: Rig,
    direction: Directions = "both",
    *,
    mask: NDArray[np.bool_] | None = None,
    min_modulation: float = MIN_MODULATION,
    noise_grey: float | None = None,
    threads: int = 1,
    anyway: bool = False,
) -> DecodedCapture:
    """Depth of a capture and what goes with it; arguments as in `decode_stack`. ``noise_grey``: of a frame, by default
    measured where there are four steps and more, else `ASSUMED_NOISE_GREY`. The frames are examined first: raises
    `RefusedCapture` where a finding makes the depth untrustworthy, unless ``anyway``; `CaptureError` for images of
    another size than the rig's, `DecodeError` where nothing can be decoded."""
    frames, names = capture.frames, [file.name for file in capture.files]
    examination = examine_capture(capture, rig, direction, mask=mask, min_modulation=min_modulation)
    if examination.refused and not anyway:
        raise RefusedCapture(str(capture.files[0].parent), examination)
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
        cause = main_reason(decoded)
        name = cause.name.lower().replace("_", " ")
        raise DecodeError(f"no pixel could be decoded; of most pixels: {name}; probably {CAUSES[cause]}")
    sigma_mm = depth_sigma_mm(decoded, rig, noise, systematic_rad=examination.systematic_rad)
    grey = frames.mean(axis=0, dtype=np.float64).astype(np.float32)
    return DecodedCapture(
        decoded, sigma_mm, modulation, grey, noise, measured_grey is not None, tuple(notes), examination
    )


def examine_capture(
    capture: CapturedFrames,
    rig: Rig,
    direction: Directions = "both",
    *,
    mask: NDArray[np.bool_] | None = None,
    min_modulation: float = MIN_MODULATION,
) -> Examination:
    """What the frames of a capture say about themselves (`fpp_ml_bench.examination`), before they are decoded. Raises
    `CaptureError` for images of another size than the rig's, `RigError` for a direction that it does not code."""
    height, width = capture.frames.shape[1:]
    if (height, width) != (rig.camera.height, rig.camera.width):
        raise CaptureError(
            f"{capture.files[0].parent}: frames of {width} x {height} px, and the rig has a camera of "
            f"{rig.camera.width} x {rig.camera.height} px; give the rig that took them"
        )
    directions: tuple[Direction, ...] = rig.directions if direction == "both" else (direction,)
    limits = Limits(min_modulation=min_modulation)
    check_limits(limits)
    names = [file.name for file in capture.files]
    return examine(capture.frames, rig, names, directions=directions, mask=mask, limits=limits)


def main_reason(decoded: Decoded) -> Reason:
    """The reason of most pixels without depth."""
    return max(CAUSES, key=lambda reason: decoded.counts[reason.name.lower()])


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
        content = file_content(
            file, 8 * shape[0] * shape[1] + (1 << 14), CaptureError, "give a mask of the frames' size"
        )
        try:
            values = np.load(io.BytesIO(content), allow_pickle=False)
        except (ValueError, EOFError) as error:
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
    """Write a decoded capture in place of what an earlier decoding left in ``folder``: the ``forms`` of
    `export_capture`, maps as .npy, a picture, and `REPORT` at last."""
    clear_outputs(folder)
    decoded, found = result.decoded, result.decoded.depth_mm > 0
    export_capture(folder, decoded.depth_mm, rig.camera, result.grey, forms)
    for name, values in (("sigma_mm", result.sigma_mm), ("modulation", result.modulation), ("reason", decoded.reason)):
        buffer = io.BytesIO()
        np.save(buffer, values)
        write_atomically(folder / f"{name}.npy", buffer.getvalue())
    title = f"{capture.files[0].parent.name}: {100 * found.mean():.1f}% of the pixels with depth"
    maps = result.grey, decoded.depth_mm, result.sigma_mm, result.modulation, decoded.reason
    findings = [str(finding) for finding in result.examination.findings]
    write_atomically(folder / "picture.png", capture_picture(title, *maps, findings))
    content = {
        "pixels": decoded.counts,
        "noise_grey": result.noise_grey,
        "noise_measured": result.noise_measured,
        "median_sigma_mm": float(np.median(result.sigma_mm[found])),
        "notes": list(result.notes),
        "reasons": {reason.name.lower(): int(reason) for reason in Reason},
    }
    _write_report(folder, capture, rig, result.examination, content)


def write_refusal(folder: Path, capture: CapturedFrames, rig: Rig, examination: Examination) -> None:
    """Write `REPORT` alone, in place of what an earlier decoding left in ``folder``."""
    clear_outputs(folder)
    folder.mkdir(parents=True, exist_ok=True)
    _write_report(folder, capture, rig, examination, {})


def _write_report(
    folder: Path, capture: CapturedFrames, rig: Rig, examination: Examination, content: Mapping[str, object]
) -> None:
    report = {
        "rig": rig.to_dict(),
        "frames": [file.name for file in capture.files],
        "full_scale": capture.full_scale,
        "examination": examination.to_dict(),
        **content,
    }
    write_atomically(folder / REPORT, (json.dumps(report, indent=1) + "\n").encode())
