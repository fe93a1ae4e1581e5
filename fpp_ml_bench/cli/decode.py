"""``fpp-bench decode``: captured frames to depth."""

import sys
from pathlib import Path
from time import perf_counter

import numpy as np

from fpp_ml_bench.cli.console import progress_bar, say_findings, show
from fpp_ml_bench.cli.options import AT_LEAST_ONE, WORKING_RANGE, command, some_of
from fpp_ml_bench.coding.code import MIN_MODULATION
from fpp_ml_bench.decoding.decode import Directions
from fpp_ml_bench.errors import CaptureError
from fpp_ml_bench.examination.findings import RefusedCapture
from fpp_ml_bench.files import LOCK_FILE, exclusive, visible
from fpp_ml_bench.loaders.captures.decoding import DecodedCapture, decode_capture, read_mask
from fpp_ml_bench.loaders.captures.exports import (
    FORMS,
    check_outputs,
    clear_outputs,
    write_capture,
    write_report,
)
from fpp_ml_bench.loaders.captures.images import read_frames
from fpp_ml_bench.machine import usable_cores
from fpp_ml_bench.optics.rig_file import check_lengths, load_rig
from fpp_ml_bench.options import REQUIRED, argument, option
from fpp_ml_bench.tables import Table


@command(
    """\
fpp-bench decode rig.yaml scan --out scan-decoded               scan/: one image a frame, in the order of names
fpp-bench decode rig.yaml 'scan/left_*.bmp' --out decoded --working-range 350,450
fpp-bench decode rig.yaml scan --out decoded --bits 12 --colour green --forms npy,ply

RIG says what was projected in which order, how the devices see, and the range in which depth is looked for
(fpp_ml_bench.optics.rig_file, docs/own_rig.md). Images: PNG, BMP or TIFF of 8 to 16 bits.
"""
)
def decode(
    *,
    file: Path = argument("rig file (.yaml, .json)", "RIG"),
    frames: str = argument("folder of images, or a pattern in quotes, 'scan/*/*.png'", "FRAMES"),
    out: Path = option(REQUIRED, "folder for the results", "DIR"),
    direction: Directions = option(
        "both", "which of the coded directions to use (default: all there are)"
    ),
    working_range: tuple[float, float] | None = option(
        None, "working range in mm (default: the rig's)", "NEAR,FAR", parse=WORKING_RANGE
    ),
    mask: Path | None = option(None, "image or .npy: decode where it is not 0", "FILE"),
    min_modulation: float = option(
        MIN_MODULATION, "least modulation of a pixel in grey levels of 255 (default: 5)", "GREY"
    ),
    noise: float | None = option(
        None,
        "noise of a frame in grey levels of 255 (default: measured with four steps and more, else "
        "1)",
        "GREY",
    ),
    bits: int | None = option(
        None, "bits of the camera, 8 to 16, where files of 16 bits hold fewer", "N"
    ),
    colour: str | None = option(
        None, "of colour images: luminance, mean, red, green, blue", "NAME"
    ),
    forms: tuple[str, ...] = option(
        FORMS,
        "what to write of npy, mat, png, ply, mesh (default: all); points and meshes are in mm, "
        "camera axes: x right, "
        "y down, z forward",
        "A,B",
        parse=some_of(FORMS),
    ),
    anyway: bool = option(False, "decode a capture that its examination refuses"),
    threads: int = option(
        usable_cores(), "threads (default: one for each core)", "N", parse=AT_LEAST_ONE
    ),
) -> None:
    """Decode captured frames: depth, point cloud, uncertainty, and the reason for every pixel
    without depth.

    Raises FppBenchError for an unusable rig, capture or folder."""
    check_outputs(out)
    rig = load_rig(file)
    if working_range is not None:
        rig = rig.with_range(working_range)
        check_lengths(rig, file.name)
    started = perf_counter()
    lock = exclusive(out / LOCK_FILE, out, "decoding into this folder", CaptureError)
    with lock, progress_bar("decoding", 4, "steps") as advance:
        capture = read_frames(frames, count=len(rig.sequence), bits=bits, colour=colour, lossy=True)
        advance(1)
        object_mask = None if mask is None else read_mask(mask, capture.frames.shape[1:])
        try:
            result = decode_capture(
                capture,
                rig,
                direction,
                mask=object_mask,
                noise_grey=noise,
                min_modulation=min_modulation,
                threads=threads,
                anyway=anyway,
            )
        except RefusedCapture as refused:
            clear_outputs(out)
            write_report(out, capture, rig, refused.examination)
            raise
        advance(2)
        write_capture(out, capture, rig, result, forms)
        advance(1)
    say_findings(result.examination)
    for note in result.notes:
        print(f"note: {note}", file=sys.stderr)
    _print(result)
    listed = ", ".join(path.name for path in visible(out, CaptureError))
    print(f"{out}: {listed}; {perf_counter() - started:.1f} s")


def _print(result: "DecodedCapture") -> None:
    counts, decoded = result.decoded.counts, result.decoded
    lit = decoded.reason.size - counts["low_modulation"] - counts["not_asked"]
    table = Table("", numbers=("pixels", "of the lit"))
    for name, pixels in counts.items():
        if pixels:
            share = "" if name in ("low_modulation", "not_asked") else f"{100 * pixels / lit:.2f}%"
            table.add_row(name.replace("_", " "), f"{pixels:,}", share)
    show(table)
    valid = decoded.depth_mm > 0
    depths, sigmas = decoded.depth_mm[valid].astype(np.float64), result.sigma_mm[valid]
    source = "measured" if result.noise_measured else "given or assumed"
    print(
        f"depth           {depths.min():.1f} to {depths.max():.1f} mm, median "
        f"{np.median(depths):.1f} mm"
    )
    if result.examination.not_checked:
        print(f"not checked     {'; '.join(result.examination.not_checked)}")
    noise = f"noise of {result.noise_grey:.2f} grey levels a frame, {source}"
    print(f"uncertainty     {np.median(sigmas):.3f} mm (standard, median over pixels; {noise})")
    for name, sigma_mm in result.budget_mm.items():
        print(f"  by {name + ':':<31} {sigma_mm:.3f} mm")
    periods = ", ".join(f"{mm:.1f} mm {name}" for name, mm in result.period_mm.items())
    print(f"  an order that is wrong by one would add {periods}; doubtful ones are refused")
