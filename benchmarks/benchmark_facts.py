"""Write what the package knows of a named benchmark, ``loaders/storage/benchmarks/NAME.json``, from
its build.

    fpp-bench build data/full --preset full
    python benchmarks/benchmark_facts.py fpp-bench-full data/full

Content hashes of every column of every split, and by object how many samples it has and how many of
its pixels are object and void, by both modes and against both depths. The images are read
(`fpp-bench verify`) before they are named. Prints how many pixels that count against the exact
depth the full sequence does not decode, which is what the limit `loaders.sample.WEAK_GREY` was
chosen by, on the training split.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.evaluation.protocol import MODES, TARGETS
from fpp_ml_bench.loaders.render.track import track
from fpp_ml_bench.loaders.storage.benchmark import BENCHMARKS, FACTS, TRACK, intended_benchmark
from fpp_ml_bench.loaders.storage.manifest import datasets_below
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.loaders.storage.verification import verify


def counts(dataset: DatasetFolder, split: str, mode: str, target: str) -> dict[str, list[int]]:
    """Samples, object pixels and void pixels of each object of a split."""
    found: dict[str, list[int]] = {}
    for sample in dataset.samples(split):
        inside, void = object_mask(dataset.depth_mm(sample, target)), dataset.void(sample, target)
        void &= mode == "standard"
        numbers = found.setdefault(dataset.measured(sample)["object"], [0, 0, 0])
        for place, number in enumerate(
            (1, np.count_nonzero(inside & ~void), np.count_nonzero(void))
        ):
            numbers[place] += int(number)
        dataset.release(sample)
    return found


def undecoded_share(dataset: DatasetFolder, split: str) -> float:
    """Share of the pixels that count as object against the exact depth which have no decoded
    depth."""
    counted = undecoded = 0
    for sample in dataset.samples(split):
        inside = object_mask(dataset.depth_mm(sample, "depth_exact")) & ~dataset.void(
            sample, "depth_exact"
        )
        counted += np.count_nonzero(inside)
        undecoded += np.count_nonzero(inside & ~object_mask(dataset.depth_mm(sample)))
        dataset.release(sample)
    return undecoded / counted


def write(facts: dict[str, Any], out: Path, name: str) -> None:
    out.mkdir(exist_ok=True)
    file = out / f"{name}.json"
    file.write_text(
        json.dumps(facts, separators=(",", ":"), sort_keys=True).replace('},"', '},\n"') + "\n"
    )
    print(f"{file}: {file.stat().st_size} bytes")


def write_track(folder: Path, out: Path) -> int:
    """The content of each dataset of the track, which was built with the track's settings."""
    content, datasets = {}, datasets_below(folder)
    for name, settings in track().items():
        manifest = DatasetFolder(datasets[name]).manifest
        described = manifest.settings, manifest.rig
        findings = verify(datasets[name])
        if described != (settings.describe(), settings.stated_rig.to_dict()):
            findings.append(f"{datasets[name]} was not built with the settings of the track")
        if findings:
            print("\n".join(map(str, findings)), file=sys.stderr)
            return 1
        content[name] = manifest.content
    write({"content": content, "counts": {}}, out, TRACK.name)
    return 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument(
        "name", choices=[benchmark.name for benchmark in (*BENCHMARKS, TRACK)], metavar="NAME"
    )
    parser.add_argument("dataset", type=Path, help="its build")
    parser.add_argument("--out", type=Path, default=FACTS, help="folder to write into")
    args = parser.parse_args()
    if args.name == TRACK.name:
        return write_track(args.dataset, args.out)
    dataset = DatasetFolder(args.dataset)
    intended = intended_benchmark(dataset.manifest)
    if intended is None or intended.name != args.name:
        parser.error(f"{args.dataset} was not built with the settings of {args.name}")
    if findings := verify(args.dataset):
        print("\n".join(findings), file=sys.stderr)
        return 1
    rules = [(mode, target) for mode in MODES for target in TARGETS]
    facts = {
        "content": dataset.content,
        "counts": {
            split: {
                f"{mode}/{target}": counts(dataset, split, mode, target) for mode, target in rules
            }
            for split in dataset.splits
        },
    }
    write(facts, args.out, args.name)
    for split in dataset.splits:
        print(
            f"{split}: {100 * undecoded_share(dataset, split):.4f}% of the pixels that count are "
            f"not decoded"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
