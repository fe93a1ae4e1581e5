"""``fpp-bench conformal``: scale a stated uncertainty so that its intervals hold what they say."""

import argparse
from pathlib import Path

from fpp_ml_bench.cli import SPLITS
from fpp_ml_bench.evaluation import score
from fpp_ml_bench.evaluation.protocol import TARGETS
from fpp_ml_bench.loaders import storage

SUMMARY = (
    "Scale a method's stated sigma by split-conformal calibration over objects, from its predictions of another split."
)
EXAMPLES = (
    "fpp-bench predict phase data/full --split validation --out predictions-validation",
    "fpp-bench predict phase data/full --split test --out predictions",
    "fpp-bench conformal predictions --dataset data/full --from predictions-validation --out predictions-conformal",
    "fpp-eval predictions-conformal --dataset data/full --split test",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("folder", type=Path, metavar="PREDICTIONS", help="predictions with {sample}.sigma.npy, whose sigma is scaled")
    add("--dataset", type=Path, required=True, metavar="DATASET", help="folder of the dataset")
    add("--split", choices=SPLITS, default="test", help="split of PREDICTIONS (default: test)")
    add(
        "--from",
        type=Path,
        required=True,
        dest="calibration",
        metavar="DIR",
        help="the same method's predictions of the split that is calibrated on",
    )
    add(
        "--calibrate",
        choices=("train", "validation"),
        default="validation",
        metavar="SPLIT",
        help="split of --from (default: validation); not one that the method learned from",
    )
    add(
        "--coverage",
        type=float,
        default=0.68,
        metavar="SHARE",
        help="what the interval of +- sigma x its Gaussian quantile shall hold (default: 0.68); n calibration objects "
        "support at most n / (n + 1)",
    )
    add("--target", choices=TARGETS, default=TARGETS[0], help="depth that errors are taken against (default: depth)")
    add("--out", type=Path, required=True, metavar="OUT", help="new folder: a copy with the scaled sigma")


def run(args: argparse.Namespace) -> int:
    dataset = storage.DatasetFolder(args.dataset)
    found = score.calibrate(args.calibration, dataset, args.calibrate, args.coverage, args.target)
    samples = score.write_calibrated(found, args.folder, dataset, args.split, args.out)
    share, most = f"{100 * found.coverage:g}%", 100 * score.largest_coverage(found.objects)
    print(f"{args.calibration}: {found.samples} samples")
    print(f"  {score.counted(found.objects)} can support at most {most:.1f}%")
    print(f"  {100 * found.before:.1f}% of the pixels are in their {share} interval as it was stated")
    print(
        f"  factor {found.factor:.4g}: the {share} interval of a new object's pixel holds in {share} of cases or more,"
    )
    print("  over objects that are like these and pixels that state a sigma")
    print(f"{args.out}: {samples} predictions with the scaled sigma")
    return 0
