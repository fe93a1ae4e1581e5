"""``fpp-bench decode``: captured frames to depth."""

import argparse
import io
import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from rich.table import Column, Table

from fpp_ml_bench import coding, decoding, optics
from fpp_ml_bench.cli.console import progress_bar, show, working_range
from fpp_ml_bench.errors import CaptureError, DecodeError
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.loaders import captures
from fpp_ml_bench.machine import usable_cores

SUMMARY = "Decode captured frames: depth, point cloud, uncertainty, and the reason for every pixel without depth."
EXAMPLES = (
    "fpp-bench decode rig.yaml scan --out scan-decoded               scan/: one image a frame, in the order of names",
    "fpp-bench decode rig.yaml 'scan/left_*.bmp' --out decoded --range 350,450",
    "fpp-bench decode rig.yaml scan --out decoded --bits 12 --colour green --forms npy,ply",
    "",
    "RIG says what was projected in which order, how the devices see, and the range in which depth is looked for",
    "(fpp_ml_bench.optics.rig_file, docs/own_rig.md). Images: PNG, BMP or TIFF of 8 to 16 bits.",
)
CLIPPED_SHARE = 0.02
"""A frame in which more of the lit pixels than this are at full scale is named."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("rig", type=Path, metavar="RIG", help="rig file (.yaml, .json)")
    add("frames", metavar="FRAMES", help="folder of images, or a pattern in quotes")
    add("--out", type=Path, required=True, metavar="DIR", help="folder for the results")
    add("--direction", choices=("horizontal", "vertical", "both"), default="both",
        help="which of the coded directions to use (default: all there are)")  # fmt: skip
    add("--range", type=working_range, metavar="NEAR,FAR", help="working range in mm (default: the rig's)")
    add("--mask", type=Path, metavar="FILE", help="image or .npy: decode where it is not 0")
    add("--min-modulation", type=float, default=coding.MIN_MODULATION, metavar="GREY",
        help=f"least modulation of a pixel in grey levels of 255 (default: {coding.MIN_MODULATION:g})")  # fmt: skip
    add("--noise", type=float, metavar="GREY",
        help="noise of a frame in grey levels of 255 (default: measured where there are four steps and more, else "
             f"{decoding.ASSUMED_NOISE_GREY:g})")  # fmt: skip
    add("--bits", type=int, metavar="N", help="bits of the camera, 8 to 16, where files of 16 bits hold fewer")
    add("--colour", choices=tuple(captures.COLOURS), help="channel to take of colour images")
    add("--forms", default=",".join(captures.FORMS), metavar="A,B",
        help=f"what to write of {', '.join(captures.FORMS)} (default: all)")  # fmt: skip
    add("--threads", type=int, default=usable_cores(), metavar="N", help="threads (default: one for each core)")


def run(args: argparse.Namespace) -> int:
    """Decode and write. Raises FppBenchError for an unusable rig, capture or folder."""
    forms = tuple(part.strip() for part in args.forms.split(",") if part.strip())
    if not forms or not set(forms) <= set(captures.FORMS):
        raise CaptureError(f"--forms {args.forms}: expected some of {', '.join(captures.FORMS)}")
    if args.threads < 1:
        raise DecodeError(f"--threads {args.threads}: expected 1 or more")
    if args.out.is_dir() and any(args.out.iterdir()) and not (args.out / "decode.json").is_file():
        raise CaptureError(f"{args.out}: not empty, and no earlier decoding; give a new folder")
    rig = optics.load_rig(args.rig)
    if args.range is not None:
        near, far = args.range
        rig = replace(rig, working_range_mm=args.range, standoff_m=(near + far) / 2000, background_m=None)
    started = perf_counter()
    with progress_bar("decoding", 4, "steps") as advance:
        capture = captures.read_frames(args.frames, count=len(rig.sequence), bits=args.bits, colour=args.colour)
        advance(1)
        result = decode_capture(capture, rig, args)
        advance(2)
        _write(args.out, capture, rig, result, forms, args)
        advance(1)
    for note in result.notes:
        print(f"note: {note}", file=sys.stderr)
    _print(result)
    listed = ", ".join(sorted(path.name for path in args.out.iterdir()))
    print(f"{args.out}: {listed}; {perf_counter() - started:.1f} s")
    return 0


@dataclass(frozen=True)
class Result:
    """A decoded capture, (H, W) maps: standard uncertainty in mm, modulation and mean in grey levels."""

    decoded: "decoding.Decoded"
    sigma_mm: "np.typing.NDArray[np.float32]"
    modulation: "np.typing.NDArray[np.float32]"
    grey: "np.typing.NDArray[np.float32]"
    noise_grey: float
    noise_measured: bool
    notes: tuple[str, ...]


def decode_capture(capture: "captures.CapturedFrames", rig: "optics.Rig", args: argparse.Namespace) -> Result:
    """Depth and what goes with it. Raises FppBenchError where frames changed places, or nothing can be decoded."""
    frames, names = capture.frames, [file.name for file in capture.files]
    if frames.shape[1:] != (rig.camera.height, rig.camera.width):
        height, width = frames.shape[1:]
        raise CaptureError(
            f"{capture.files[0].parent}: images of {width} x {height} px, and {args.rig} has a camera of "
            f"{rig.camera.width} x {rig.camera.height} px; give the rig that these images were captured with"
        )
    limits = coding.Limits(min_modulation=args.min_modulation)
    mask = None if args.mask is None else _mask(args.mask, frames.shape[1:])
    pair = decoding.exchanged_frames(list(frames), rig)
    if pair is not None:
        shown = [rig.sequence.frames[index].title.partition(": ")[2] for index in pair]
        raise CaptureError(
            f"{names[pair[0]]} and {names[pair[1]]} seem to have changed places ({shown[0]}, {shown[1]}): as they are, "
            "most lit pixels contradict the code, and exchanged they fit; rename them, or correct the rig's sequence"
        )
    decoded = decoding.decode_stack(
        frames, rig, args.direction, mask=mask, limits=limits, details=True, threads=args.threads
    )
    modulation = np.nanmax([measured.modulation for measured in decoded.details.values()], axis=0)
    measured = decoding.noise_of_frames(list(frames), rig) if args.noise is None else None
    noise = args.noise or measured or decoding.ASSUMED_NOISE_GREY
    notes = [capture.note] if capture.note else []
    if args.noise is None and measured is None:
        notes.append(f"three steps can't tell their noise; {noise:g} grey level assumed, --noise sets it")
    lit = modulation >= args.min_modulation
    notes += _clipped(frames, names, lit)
    if not decoded.depth_mm.any():
        largest = max((name for name in decoded.counts if name != "not_asked"), key=lambda name: decoded.counts[name])
        hint = {
            "outside_range": "the depths lie outside the range: --range",
            "low_modulation": "the fringes are too faint: exposure, or --min-modulation",
            "inconsistent_order": "the code contradicts itself: check the rig's sequence (sign, order, periods)",
        }.get(largest, "check the rig and its sequence")
        raise DecodeError(f"no pixel could be decoded; of most pixels: {largest.replace('_', ' ')}; {hint}")
    sigma_mm = decoding.depth_sigma_mm(decoded, rig, noise)
    grey = frames.mean(axis=0, dtype=np.float64).astype(np.float32)
    return Result(decoded, sigma_mm, modulation, grey, noise, measured is not None, tuple(notes))


def _clipped(frames: Any, names: list[str], lit: Any) -> list[str]:
    shares = [float((frame[lit] >= 255).mean()) if lit.any() else 0.0 for frame in frames]
    listed = [
        f"{name} ({100 * share:.0f}%)" for name, share in zip(names, shares, strict=True) if share > CLIPPED_SHARE
    ]
    if not listed:
        return []
    more = f" and {len(listed) - 4} more" if len(listed) > 4 else ""
    return [f"saturated on lit pixels: {', '.join(listed[:4])}{more}; expose less"]


def _mask(file: Path, shape: tuple[int, int]) -> "np.typing.NDArray[np.bool_]":
    if file.suffix.lower() == ".npy":
        try:
            values = np.load(file, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise CaptureError(f"{file}: expected a mask as .npy, can't be read: {error}") from error
    else:
        values = captures.read_frames(file).frames[0]
    if values.shape != shape:
        raise CaptureError(f"{file}: expected a mask of (H, W) = {shape} like the frames, got {values.shape}")
    mask: np.typing.NDArray[np.bool_] = np.nan_to_num(values) != 0
    return mask


def _write(
    out: Path, capture: "captures.CapturedFrames", rig: "optics.Rig", result: Result, forms: tuple[str, ...],
    args: argparse.Namespace,
) -> None:  # fmt: skip
    decoded, found = result.decoded, result.decoded.depth_mm > 0
    captures.export_capture(out, decoded.depth_mm, rig.camera, result.grey, forms)
    for name, values in (("sigma_mm", result.sigma_mm), ("modulation", result.modulation), ("reason", decoded.reason)):
        buffer = io.BytesIO()
        np.save(buffer, values)
        write_atomically(out / f"{name}.npy", buffer.getvalue())
    title = f"{capture.files[0].parent.name}: {100 * found.mean():.1f}% of the pixels with depth"
    picture = captures.capture_picture(
        title, result.grey, decoded.depth_mm, result.sigma_mm, result.modulation, decoded.reason
    )
    write_atomically(out / "picture.png", picture)
    content = {
        "rig": str(args.rig), "frames": [file.name for file in capture.files], "full_scale": capture.full_scale,
        "direction": args.direction, "working_range_mm": list(rig.working_range_mm), "pixels": decoded.counts,
        "noise_grey": result.noise_grey, "noise_measured": result.noise_measured,
        "median_sigma_mm": float(np.median(result.sigma_mm[found])), "notes": list(result.notes),
        "reasons": {reason.name.lower(): int(reason) for reason in coding.Reason},
    }  # fmt: skip
    write_atomically(out / "decode.json", (json.dumps(content, indent=1) + "\n").encode())


def _print(result: Result) -> None:
    counts, decoded = result.decoded.counts, result.decoded
    lit = decoded.reason.size - counts["low_modulation"] - counts["not_asked"]
    table = Table("", Column("pixels", justify="right"), Column("of the lit", justify="right"))
    for name, pixels in counts.items():
        if pixels:
            share = "" if name in ("low_modulation", "not_asked") else f"{100 * pixels / lit:.2f}%"
            table.add_row(name.replace("_", " "), f"{pixels:,}", share)
    show(table)
    found = decoded.depth_mm > 0
    depths, sigmas = decoded.depth_mm[found].astype(np.float64), result.sigma_mm[found]
    source = "measured" if result.noise_measured else "given or assumed"
    print(f"depth           {depths.min():.1f} to {depths.max():.1f} mm, median {np.median(depths):.1f} mm")
    noise = f"noise of {result.noise_grey:.2f} grey levels, {source}"
    print(f"uncertainty     {np.median(sigmas):.3f} mm (standard, median over pixels; by {noise})")
