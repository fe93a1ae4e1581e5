"""``fpp-bench show``: look at a sample, or at all of them."""

import argparse
from pathlib import Path

from fpp_ml_bench.errors import DatasetError
from fpp_ml_bench.loaders import storage

SUMMARY = "One sample as a picture (frames, depth, error, mask, mesh), or a contact sheet of every object and view."
EXAMPLES = (
    "fpp-bench show data/mini power_drill_A60                 writes power_drill_A60.png",
    "fpp-bench show data/mini mug_A0 --out pictures/mug.png",
    "fpp-bench show data/full --sheet --out sheet.png         all 50 objects x 6 views",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("dataset", type=Path, metavar="DATASET", help="dataset folder")
    add("sample", nargs="?", metavar="SAMPLE", help="sample such as power_drill_A60")
    add("--sheet", action="store_true", help="all objects and views on one sheet instead")
    add("--split", default="all", metavar="SPLIT", help="split that --sheet shows (default: all)")
    add("--out", type=Path, metavar="FILE.png", help="picture to write (default: SAMPLE.png or sheet.png)")


def run(args: argparse.Namespace) -> int:
    if args.sheet == (args.sample is not None):
        raise DatasetError("expected either a SAMPLE or --sheet; `fpp-bench info DATASET --json` lists the samples")
    out = args.out or Path("sheet.png" if args.sheet else f"{args.sample}.png")
    if out.suffix.lower() != ".png":
        raise DatasetError(f"--out {out}: expected a file ending in .png")
    dataset = storage.DatasetFolder(args.dataset)
    from fpp_ml_bench.loaders.pictures import contact_sheet, sample_picture

    if args.sheet:
        contact_sheet(dataset, args.split, out)
    else:
        dataset.split_of_sample(args.sample)
        sample_picture(dataset, args.sample, out)
    print(out)
    return 0
