"""``fpp-bench patterns``: the images to project."""

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from fpp_ml_bench import optics
from fpp_ml_bench.errors import CaptureError
from fpp_ml_bench.files import write_atomically

SUMMARY = "Write the images that a rig's projector shows, in order, and a manifest of what each of them is."
EXAMPLES = (
    "fpp-bench patterns rig.yaml patterns                 patterns/A_0.png, A_1.png, ... and patterns.json",
    "fpp-bench patterns paper patterns                    the paper's 52 frames",
    "fpp-bench patterns crossed patterns                  the same after three crossed frames",
    "",
    "RIG may be a whole rig file, or one with the entries projector: {width: ..., height: ...} and sequence alone,",
    "since patterns come before the calibration. Project them without scaling; capture an image each, in this order.",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("rig", metavar="RIG", help="rig file (.yaml, .json), or paper or crossed")
    parser.add_argument("out", type=Path, metavar="OUT", help="folder for the images")


def run(args: argparse.Namespace) -> int:
    """Write images and manifest. Raises FppBenchError for an unusable rig file or folder."""
    rig = optics.NAMED_RIGS[args.rig]() if args.rig in optics.NAMED_RIGS else optics.load_projection(args.rig)
    if args.out.is_dir() and any(args.out.iterdir()):
        raise CaptureError(f"{args.out}: not empty; give a new folder, so that no old pattern is projected by mistake")
    paths = optics.export_patterns(rig, args.out)
    frames = [
        {"file": path.name, "shows": frame.title.partition(": ")[2], **asdict(frame)}
        for path, frame in zip(paths, rig.sequence, strict=True)
    ]
    content = {
        "projector_px": [rig.projector.width, rig.projector.height],
        "sequence": rig.to_dict()["sequence"],
        "pitch_px": {direction: rig.pitch(direction) for direction in rig.fringe_directions},
        "frames": frames,
    }
    write_atomically(args.out / "patterns.json", (json.dumps(content, indent=1) + "\n").encode())
    size = f"{rig.projector.width} x {rig.projector.height} px"
    print(f"{args.out}: {len(paths)} images of {size}, {paths[0].name} to {paths[-1].name}, and patterns.json")
    print("next: project them in this order, one capture each; then fpp-bench decode RIG CAPTURE --out OUT")
    return 0
