"""``fpp-bench export``: a dataset as Parquet, as the published tree, or its meshes and patterns."""

import argparse
from pathlib import Path

from fpp_ml_bench.cli.console import gigabytes, progress_bar
from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.loaders import published, storage
from fpp_ml_bench.machine import usable_cores

SUMMARY = "Write a dataset as Parquet, as the published .mat tree, or its meshes and patterns."
EXAMPLES = (
    "fpp-bench export data/mini hub --parquet              plain load_dataset opens every configuration",
    "fpp-bench export data/mini tree --mat                 the published layout; fpp-bench import reads it back",
    "fpp-bench export data/mini out --meshes --patterns    several forms: out/meshes and out/patterns",
    "fpp-bench export data/mini test --parquet --split test",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", type=Path, metavar="DATASET", help="folder of the dataset")
    parser.add_argument("out", type=Path, metavar="OUT", help="new or empty folder; written completely or not at all")
    parser.add_argument("--parquet", action="store_true", help="Parquet and a card, ready for the Hugging Face Hub")
    parser.add_argument("--mat", action="store_true", help="the published tree: PNG fringes, .mat depth, raw scans")
    parser.add_argument("--meshes", action="store_true", help="the objects' meshes as PLY (metres)")
    parser.add_argument("--patterns", action="store_true", help="the projected patterns as PNG")
    parser.add_argument(
        "--split",
        choices=("train", "validation", "test", "all"),
        default="all",
        help="samples to export (default: all)",
    )


def run(args: argparse.Namespace) -> int:
    """Export. Raises FppBenchError for an unusable dataset, form or folder."""
    forms = [form for form in published.FORMS if getattr(args, form)]
    if not forms:
        raise BuildError("nothing to export: give at least one of --parquet, --mat, --meshes, --patterns")
    dataset = storage.DatasetFolder(args.dataset)
    splits = published.chosen_splits(dataset, args.split)
    samples = sum(len(dataset.samples(split)) for split in splits)
    steps = samples * sum(form in published.SAMPLE_FORMS for form in forms)
    with progress_bar("exporting", steps, "samples") as advance:
        published.export(dataset, args.out, forms, splits, usable_cores(), advance)
    files = [path for path in args.out.rglob("*") if path.is_file()]
    size = gigabytes(sum(path.stat().st_size for path in files))
    print(f"{args.out}: {', '.join(forms)} of {samples} samples, {len(files):,} files, {size}")
    if "mat" in forms:
        scans = "with raw scans" if "all" in dataset.configs else "without raw scans: not all frames are stored"
        exact = "; depth_exact has no place in the published layout" if dataset.has_exact else ""
        print(f"  published layout {scans}{exact}")
    return 0
