"""``fpp-bench verify``: is this dataset intact, and are its splits clean?"""

import argparse
from pathlib import Path

from fpp_ml_bench.cli import CHECK_FAILED, OK
from fpp_ml_bench.loaders import storage

SUMMARY = "Prove a dataset intact: checksums, files, labels, split leaks, duplicated images; and name its benchmark."
EXAMPLES = ("fpp-bench verify data/mini", "fpp-bench verify data/mini && echo safe to train on")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", type=Path, metavar="DATASET", help="dataset folder")


def run(args: argparse.Namespace) -> int:
    from fpp_ml_bench.cli.console import gigabytes, progress_bar, say_benchmark

    manifest = storage.read_manifest(args.dataset)
    files = manifest.files
    with progress_bar("verifying", len(files), "files") as advance:
        findings = storage.verify(args.dataset, advance)
    for finding in findings:
        print(finding)
    size = gigabytes(sum(file.bytes for file in files))
    samples = sum(len(rows) for rows in manifest.samples.values())
    if findings:
        print(f"{args.dataset}: {len(findings)} finding(s) in {len(files)} files, {size}")
        return CHECK_FAILED
    print(f"{args.dataset}: intact; {len(files)} files, {size}, {samples} samples, no object or image in two splits")
    print(f"fingerprint {manifest.fingerprint}")
    say_benchmark(manifest)
    return OK
