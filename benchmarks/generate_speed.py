"""Generating, noise and all, written to disk: images a second, where the time goes, and a plain pipeline beside it.

    python benchmarks/generate_speed.py [--size 960] [--objects 16] [--workers 2] [--folder DIR]

Ours is the real builder (`fpp_ml_bench.loaders.render.builder`): ray casting, 52 exposures with shot and read noise,
ground-truth decoding, Arrow shards with checksums. It runs twice, once into ``--folder`` and once into memory
(``/dev/shm``): the difference is the disk's share. A first build that is not counted compiles the kernels.

The peer is what a careful script does with OpenCV and NumPy on one core, with the same scene and noise model: a
`cv2.remap` lookup of the projector image, NumPy's SFC64 normal noise, rounding, `cv2.imwrite` to PNG; no ground truth.
Its images a second are multiplied by the number of workers, as if it scaled perfectly.
"""

import argparse
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np

from fpp_ml_bench.constants import OBJECTS, split_of
from fpp_ml_bench.decoding import decode_stack
from fpp_ml_bench.loaders.render import (
    BuildSettings,
    PixelRays,
    Studio,
    TracedObject,
    build,
    place,
    solid_mesh,
)  # fmt: skip
from fpp_ml_bench.machine import describe_hardware
from fpp_ml_bench.optics import paper_rig, pattern_image

FULL_IMAGES = 15_600


def timed_build(folder: Path, settings: BuildSettings, workers: int) -> tuple[float, int, int]:
    """Seconds, images and bytes of one build into a new folder below ``folder``, which is removed again."""
    target = Path(tempfile.mkdtemp(prefix="fpp-generate-", dir=folder)) / "dataset"
    try:
        started = time.perf_counter()
        manifest = build(target, settings, workers)
        seconds = time.perf_counter() - started
        rows = sum(len(rows) for rows in manifest.samples.values())
        return seconds, rows * len(settings.rig.sequence), sum(shard.bytes for shard in manifest.shards)
    finally:
        shutil.rmtree(target.parent)


def median_ms(work: Callable[[], object], repeats: int = 5) -> float:
    work()
    seconds = []
    for _ in range(repeats):
        started = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - started)
    return 1000 * statistics.median(seconds)


def stages(settings: BuildSettings) -> list[tuple[str, float, float]]:
    """Milliseconds a view and an image of each stage, one process, one view of the first object."""
    rig, studio = settings.rig, Studio(settings)
    mesh = solid_mesh(settings.objects[0])
    vertices_m, _ = place(mesh, "A60", rig, "fixed", settings.seed)
    rays, scene = PixelRays.of(rig.camera), studio.trace(mesh, "A60")
    traced, hits, whole = scene.traced, scene.hits, studio.light(scene)
    row = studio.photograph(mesh, "A60")
    frames = [row.frames[i] for i in range(len(rig.sequence))]
    seen = np.zeros(row.depth_mm.shape, dtype=bool)
    seen.ravel()[hits.pixels] = True
    count = len(frames)
    times = [
        ("triangles of the mesh", median_ms(lambda: TracedObject(mesh, vertices_m))),
        ("visible triangle, exact depth", median_ms(lambda: traced.primary(rays))),
        ("illumination of the object", median_ms(lambda: lit_object(hits, rig, studio.lighting, traced))),
        (f"{count} exposures with noise", median_ms(lambda: studio.expose(scene, whole))),
        ("decoded ground truth (object only)", median_ms(lambda: decode_stack(frames, rig, mask=seen))),
    ]
    return [(name, ms, ms / count) for name, ms in times]


def peer_images_per_second(settings: BuildSettings, folder: Path, images: int = 26) -> float:
    """A plain OpenCV + NumPy pipeline on one core, frames written as PNG."""
    import cv2

    rig, studio = settings.rig, Studio(settings)
    scene = studio.trace(solid_mesh(settings.objects[0]), "A60")
    hits, lit = scene.hits, studio.light(scene)
    shape = (rig.camera.height, rig.camera.width)
    x, y = rig.camera.rays()
    points = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) * rig.background_m
    points[hits.pixels] = hit_points_m(hits, rig)
    u, v = (c.astype(np.float32).reshape(shape) for c in rig.project(points))
    gain, ambient = lit.gain.reshape(shape) / np.float32(255), lit.ambient.reshape(shape)
    noise = studio.exposure.noise
    generator = np.random.Generator(np.random.SFC64(0))
    patterns = [np.ascontiguousarray(pattern_image(rig, i)) for i in range(len(rig.sequence))]
    started = time.perf_counter()
    for index in range(images):
        light = cv2.remap(patterns[index].astype(np.float32), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        signal = ambient + gain * light
        sigma = np.sqrt(np.float32(noise.read_variance) + np.float32(noise.shot_per_grey) * signal)
        value = signal + sigma * generator.standard_normal(shape, dtype=np.float32)
        frame = np.clip(np.rint(value), 0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / f"A_{index}.png"), frame)
    return images / (time.perf_counter() - started)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=960)
    parser.add_argument("--objects", type=int, default=16, help="training objects, six views each (default: 16)")
    parser.add_argument("--workers", type=int, default=describe_hardware().cores)
    parser.add_argument("--folder", type=Path, default=Path.cwd(), help="a folder on the disk to measure")
    args = parser.parse_args()
    # Of one split, so that the shards are of equal size and no worker waits for another at the end.
    objects = tuple(name for name in OBJECTS if split_of(name) == "train")[: args.objects]
    settings = BuildSettings(rig=paper_rig(args.size), objects=objects)
    machine = describe_hardware()
    print(f"{machine.cpu}, {machine.cores} cores, {machine.memory_gib} GiB; {args.size} px, {args.workers} workers")

    timed_build(args.folder, BuildSettings(rig=paper_rig(176), objects=("cork",)), 1)
    seconds, images, size = timed_build(args.folder, settings, args.workers)
    print(f"to disk:   {images} images, {size / 1e9:.2f} GB in {seconds:.1f} s = {images / seconds:.0f} images/s")
    memory = Path("/dev/shm")
    if memory.is_dir() and shutil.disk_usage(memory).free > 1.2 * size:
        in_memory, _, _ = timed_build(memory, settings, args.workers)
        share = max(0.0, 1 - in_memory / seconds)
        print(
            f"to memory: {in_memory:.1f} s = {images / in_memory:.0f} images/s; the disk's share is {100 * share:.0f}%"
        )
    rate = images / seconds
    full_gb = size / images * FULL_IMAGES / 1e9
    print(f"projected full set: {FULL_IMAGES} images in {FULL_IMAGES / rate / 60:.1f} min, {full_gb:.1f} GB")
    print("one view, one process:")
    for name, per_view, per_image in stages(settings):
        print(f"  {name:36s} {per_view:8.1f} ms a view {per_image:7.2f} ms an image")
    with tempfile.TemporaryDirectory(dir=args.folder) as folder:
        peer = peer_images_per_second(settings, Path(folder))
    print(f"peer (OpenCV + NumPy + PNG): {peer:.1f} images/s a core, {peer * args.workers:.1f} on {args.workers}")
    print(f"ratio ours / peer: {rate / (peer * args.workers):.1f}")
    generator = np.random.Generator(np.random.SFC64(0))
    normal = np.empty((args.size, args.size), dtype=np.float32)
    noise_ms = median_ms(lambda: generator.standard_normal(dtype=np.float32, out=normal))
    print(f"NumPy's normal noise alone (SFC64, float32): {noise_ms:.1f} ms an image")
    print("the paper's pipeline (reported by the paper, on a GPU, not run here): 3 images/s")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
