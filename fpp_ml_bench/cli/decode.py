"""``fpp-bench decode``: captured frames to depth."""

import argparse
import sys
from pathlib import Path
from time import perf_counter

from fpp_ml_bench import optics
from fpp_ml_bench.cli.console import progress_bar, say_findings, show, working_range
from fpp_ml_bench.errors import CaptureError, DecodeError
from fpp_ml_bench.examination import RefusedCapture
from fpp_ml_bench.loaders import captures
from fpp_ml_bench.machine import usable_cores
from fpp_ml_bench.tables import Table

SUMMARY = "Decode captured frames: depth, point cloud, uncertainty, and the reason for every pixel without depth."
EXAMPLES = (
    "fpp-bench decode rig.yaml scan --out scan-decoded               scan/: one image a frame, in the order of names",
    "fpp-bench decode rig.yaml 'scan/left_*.bmp' --out decoded --range 350,450",
    "fpp-bench decode rig.yaml scan --out decoded --bits 12 --colour green --forms npy,ply",
    "",
    "RIG says what was projected in which order, how the devices see, and the range in which depth is looked for",
    "(fpp_ml_bench.optics.rig_file, docs/own_rig.md). Images: PNG, BMP or TIFF of 8 to 16 bits.",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("rig", type=Path, metavar="RIG", help="rig file (.yaml, .json)")
    add("frames", metavar="FRAMES", help="folder of images, or a pattern in quotes")
    add("--out", type=Path, required=True, metavar="DIR", help="folder for the results")
    add(
        "--direction",
        choices=("horizontal", "vertical", "both"),
        default="both",
        help="which of the coded directions to use (default: all there are)",
    )
    add("--range", type=working_range, metavar="NEAR,FAR", help="working range in mm (default: the rig's)")
    add("--mask", type=Path, metavar="FILE", help="image or .npy: decode where it is not 0")
    add(
        "--min-modulation",
        type=float,
        metavar="GREY",
        help="least modulation of a pixel in grey levels of 255 (default: 5)",
    )
    add(
        "--noise",
        type=float,
        metavar="GREY",
        help="noise of a frame in grey levels of 255 (default: measured with four steps and more, else 1)",
    )
    add("--bits", type=int, metavar="N", help="bits of the camera, 8 to 16, where files of 16 bits hold fewer")
    add("--colour", metavar="NAME", help="of colour images: luminance, mean, red, green, blue")
    add("--forms", metavar="A,B", help="what to write of npy, mat, png, ply, mesh (default: all)")
    add("--anyway", action="store_true", help="decode a capture that its examination refuses")
    add("--threads", type=int, default=usable_cores(), metavar="N", help="threads (default: one for each core)")


def run(args: argparse.Namespace) -> int:
    """Decode and write. Raises FppBenchError for an unusable rig, capture or folder."""
    named = captures.FORMS if args.forms is None else args.forms.split(",")
    forms = tuple(part.strip() for part in named if part.strip())
    if not forms or not set(forms) <= set(captures.FORMS):
        raise CaptureError(f"--forms {args.forms}: expected some of {', '.join(captures.FORMS)}")
    if args.threads < 1:
        raise DecodeError(f"--threads {args.threads}: expected 1 or more")
    captures.check_outputs(args.out)
    rig = optics.load_rig(args.rig)
    if args.range is not None:
        rig = rig.with_range(args.range)
        optics.check_lengths(rig, args.rig.name)
    started = perf_counter()
    with progress_bar("decoding", 4, "steps") as advance:
        capture = captures.read_frames(args.frames, count=len(rig.sequence), bits=args.bits, colour=args.colour)
        advance(1)
        mask = None if args.mask is None else captures.read_mask(args.mask, capture.frames.shape[1:])
        least = {} if args.min_modulation is None else {"min_modulation": args.min_modulation}
        try:
            result = captures.decode_capture(
                capture,
                rig,
                args.direction,
                mask=mask,
                noise_grey=args.noise,
                threads=args.threads,
                anyway=args.anyway,
                **least,
            )
        except RefusedCapture as refused:
            captures.write_refusal(args.out, capture, rig, refused.examination)
            raise
        advance(2)
        captures.write_capture(args.out, capture, rig, result, forms)
        advance(1)
    say_findings(result.examination)
    for note in result.notes:
        print(f"note: {note}", file=sys.stderr)
    _print(result)
    listed = ", ".join(sorted(path.name for path in args.out.iterdir()))
    print(f"{args.out}: {listed}; {perf_counter() - started:.1f} s")
    return 0


def _print(result: "captures.DecodedCapture") -> None:
    import numpy as np

    counts, decoded = result.decoded.counts, result.decoded
    lit = decoded.reason.size - counts["low_modulation"] - counts["not_asked"]
    table = Table("", numbers=("pixels", "of the lit"))
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
    if result.examination.not_checked:
        print(f"not checked     {'; '.join(result.examination.not_checked)}")
    print(f"uncertainty     {np.median(sigmas):.3f} mm (standard, median over pixels; by {noise})")
