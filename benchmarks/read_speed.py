"""Reading frame 0 and depth as float32 batches: PNG + .mat, plain ``datasets``, and our loader, in
the same run.

    python benchmarks/read_speed.py [--size 960] [--objects 4] [--batch 4] [--repeats 7]

All readers give the same numbers (checked): fringe and depth float32 (B, 1, H, W), grey levels
(ours: divided by 255 at no extra charge) and mm. The files are in the page cache; one process, one
thread. Plain ``datasets`` is ``load_dataset(FOLDER, "single_shot")`` in torch format with
``dtype=torch.float32``, reading the two columns only. Medians over repeats of reading every row
once. "The copies alone" is the lower bound for any loader: the two images of each row copied from
the memory map into a reused batch.
"""

import argparse
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
os.environ.setdefault("HF_HUB_OFFLINE", "1")

import numpy as np

from fpp_ml_bench.constants import OBJECTS
from fpp_ml_bench.loaders.render.builder import build
from fpp_ml_bench.loaders.render.scene import BuildSettings
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.machine import describe_hardware
from fpp_ml_bench.optics.named_rigs import paper_rig

EPOCHS = 10
Batch = tuple[np.ndarray, np.ndarray]


def write_png_mat(stored: DatasetFolder, samples: list[str], folder: Path) -> None:
    """The published form of the same samples: 8-bit PNG and zlib-compressed .mat."""
    import cv2
    import scipy.io

    for sample in samples:
        cv2.imwrite(str(folder / f"{sample}.png"), stored.frame(sample, 0))
        scipy.io.savemat(
            folder / f"{sample}.mat", {"depthMap": stored.depth_mm(sample)}, do_compression=True
        )


def read_png_mat(
    samples: list[str], folder: Path, batch: int, size: tuple[int, int]
) -> Iterator[Batch]:
    import cv2
    import scipy.io

    for start in range(0, len(samples), batch):
        batch_samples = samples[start : start + batch]
        fringe = np.empty((len(batch_samples), 1, *size), dtype=np.float32)
        depth = np.empty_like(fringe)
        for place, sample in enumerate(batch_samples):
            fringe[place, 0] = cv2.imread(str(folder / f"{sample}.png"), cv2.IMREAD_UNCHANGED)
            depth[place, 0] = scipy.io.loadmat(folder / f"{sample}.mat")["depthMap"]
        yield fringe, depth


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=int, default=960)
    parser.add_argument(
        "--objects", type=int, default=4, help="objects, six rows each (default: 4, one shard)"
    )
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--repeats", type=int, default=7)
    args = parser.parse_args()
    machine = describe_hardware()
    print(f"{machine.cpu}, {machine.cores} cores; {args.size} px, batches of {args.batch}")
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as scratch:
        os.environ["HF_DATASETS_CACHE"] = str(Path(scratch) / "cache")
        compare(Path(scratch), args)
    return 0


def compare(scratch: Path, args: argparse.Namespace) -> None:
    import datasets
    import torch

    from fpp_ml_bench.loaders.training import FringeDepthDataset

    torch.set_num_threads(1)
    datasets.disable_progress_bars()
    names = [name for name in OBJECTS if name not in ("mustard_bottle", "mug")][: args.objects]
    folder = scratch / "dataset"
    build(
        folder,
        BuildSettings(rig=paper_rig(args.size), objects=tuple(names), stored="single_shot"),
        1,
    )
    stored = DatasetFolder(folder)
    samples = stored.samples("train")
    files = scratch / "files"
    files.mkdir()
    write_png_mat(stored, samples, files)

    plain = datasets.load_dataset(str(folder), "single_shot", split="train")
    plain = plain.select_columns(["frame_00", "depth"]).with_format("torch", dtype=torch.float32)
    ours = FringeDepthDataset(folder, "train", "single_shot", "raw", range_rule="object")

    def through_datasets() -> Iterator[Batch]:
        for start in range(0, len(plain), args.batch):
            batch = plain[start : start + args.batch]
            yield batch["frame_00"].numpy()[:, None], batch["depth"].numpy()[:, None]

    order = list(range(len(samples)))

    def through_ours() -> Iterator[Batch]:
        for batch in ours.batches(args.batch, order * EPOCHS):
            yield batch.fringe.numpy(), batch.depth.numpy()

    def copies_only() -> Iterator[Batch]:
        fringe_out = np.empty((args.batch, 1, *stored.size), dtype=np.float32)
        depth_out = np.empty_like(fringe_out)
        for place, sample in enumerate(samples * EPOCHS):
            np.copyto(fringe_out[place % args.batch, 0], stored.frame(sample, 0))
            np.copyto(depth_out[place % args.batch, 0], stored.depth_mm(sample))
            if (place + 1) % args.batch == 0:
                yield fringe_out, depth_out

    readers: list[tuple[str, Callable[[], Iterator[Batch]], float, int]] = [
        (
            "PNG + .mat (cv2, scipy)",
            lambda: read_png_mat(samples, files, args.batch, stored.size),
            1,
            1,
        ),
        ("plain datasets, torch format", through_datasets, 1, 1),
        ("ours, FringeDepthDataset.batches", through_ours, 255, EPOCHS),
        ("the copies alone", copies_only, 1, EPOCHS),
    ]
    expected = list(read_png_mat(samples, files, args.batch, stored.size))
    milliseconds = []
    for name, batches, scale, epochs in readers:
        for (fringe, depth), (expected_fringe, expected_depth) in zip(
            batches(), expected, strict=False
        ):
            if not (
                np.allclose(fringe * scale, expected_fringe, rtol=1e-6)
                and np.array_equal(depth, expected_depth)
            ):
                raise SystemExit(f"{name} reads different numbers than {readers[0][0]}")
        seconds = []
        for _ in range(args.repeats):
            started = time.perf_counter()
            for _batch in batches():
                pass
            seconds.append((time.perf_counter() - started) / epochs)
        milliseconds.append(1000 * statistics.median(seconds) / len(samples))
    print(f"{'reader':36s} {'ms a row':>9s} {'times faster than PNG + .mat':>30s}")
    for (name, *_), ms in zip(readers, milliseconds, strict=True):
        print(f"{name:36s} {ms:9.3f} {milliseconds[0] / ms:30.1f}")


if __name__ == "__main__":
    raise SystemExit(main())
