"""Generating, noise and all, written to disk: images a second, where the time goes, and a plain pipeline beside it.

    python benchmarks/generate_speed.py [--size 960] [--objects 16] [--workers 2] [--light paper] [--folder DIR]

Ours is the real builder (`fpp_ml_bench.loaders.render.builder`): ray casting, further bounces, 52 exposures with shot
and read noise, ground-truth decoding, Arrow shards with checksums. It runs twice, once into ``--folder`` and once into
memory (``/dev/shm``): the difference is the disk's share. A first build that is not counted compiles the kernels.

The peer is what a careful script does with OpenCV and NumPy on one core, with the same scene and noise model and direct
light alone: a `cv2.remap` lookup of the projector image, NumPy's SFC64 normal noise, rounding, `cv2.imwrite` to PNG; no
ground truth. Its images a second are multiplied by the number of workers, as if it scaled perfectly.
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

from fpp_ml_bench.constants import OBJECTS, VIEW_DEGREES, VIEWS, split_of
from fpp_ml_bench.decoding import decode_stack
from fpp_ml_bench.loaders.render import (
    BuildSettings,
    Hits,
    PixelRays,
    Studio,
    TracedObject,
    build,
    load_light,
    place,
    solid_mesh,
)
from fpp_ml_bench.loaders.render.pixels import mixed_pixels
from fpp_ml_bench.loaders.render.surfels import Surfels
from fpp_ml_bench.machine import describe_hardware
from fpp_ml_bench.optics import Rig, paper_rig, pattern_image

FULL_IMAGES = 15_600
VIEW = "A60"


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
    """Milliseconds of each stage and their share an image, one process, one view of the first object; form factors are
    shared by the object's views."""
    rig, light, studio = settings.rig, settings.light, Studio(settings)
    mesh = solid_mesh(settings.objects[0])
    vertices_m, distance_m = place(mesh, VIEW, rig, settings.placement, settings.seed)
    degrees, offset_m = VIEW_DEGREES[VIEWS.index(VIEW)], np.array([0.0, 0.0, distance_m])
    rays, scene = PixelRays.of(rig.camera), studio.trace(mesh, VIEW)
    traced, hits, mixed = scene.traced, scene.hits, scene.mixed
    row = studio.photograph(mesh, VIEW)
    frames = [row.frames[i] for i in range(len(rig.sequence))]
    seen = np.zeros(row.depth_mm.shape, dtype=bool)
    seen.ravel()[hits.pixels] = True
    upon = studio.lighting.upon(mesh, traced, degrees, offset_m)
    shaded = scene.lit.gain > 0 if light.bounces.shadows else None
    points_m = _points_m(scene.hits, rig)
    count, across = len(frames), light.camera.rays_across
    surfels = light.bounces.interreflection or light.bounces.ambient_occlusion
    every: list[tuple[str, Callable[[], object] | None, int]] = [
        ("triangles of the mesh", lambda: TracedObject(mesh, vertices_m), 1),
        ("tracing: triangle and exact depth", lambda: traced.primary(rays), 1),
        ("mixed pixels", (lambda: mixed_pixels(traced, hits, rig, across, shaded)) if mixed else None, 1),
        ("form factors, once an object", (lambda: Surfels.of(mesh)) if surfels else None, len(VIEWS)),
        ("bounces", (lambda: studio.lighting.upon(mesh, traced, degrees, offset_m)) if surfels else None, 1),
        ("light of the central rays", lambda: upon.at(points_m, hits.normals, hits.triangle), 1),
        (
            "light of the mixed pixels' rays",
            (lambda: upon.at(mixed.points_m, mixed.normals, mixed.triangle)) if mixed else None,
            1,
        ),
        (f"{count} exposures", lambda: studio.expose(scene, tuple(range(count))), 1),
        ("ground truth (object only)", lambda: decode_stack(frames, rig, mask=seen), 1),
    ]
    times = [(name, median_ms(work), views) for name, work, views in every if work is not None]
    return [(name, ms, ms / count / views) for name, ms, views in times]


def _points_m(hits: Hits, rig: Rig) -> np.ndarray:
    """Camera coordinates (n, 3) of what the central rays meet, m."""
    x, y = (axis.ravel()[hits.pixels] for axis in rig.camera.rays())
    return np.column_stack([x, y, np.ones_like(x)]) * hits.depth_m[:, None]


def peer_images_per_second(settings: BuildSettings, folder: Path, images: int = 26) -> float:
    """A plain OpenCV + NumPy pipeline on one core, frames written as PNG: direct light alone, a ray a pixel."""
    import cv2

    rig, studio = settings.rig, Studio(settings)
    scene = studio.trace(solid_mesh(settings.objects[0]), VIEW)
    hits = scene.hits
    behind = studio.lighting.behind(scene.traced, hits.pixels)
    gain, ambient = behind.gain.copy(), behind.ambient.copy()
    gain[hits.pixels], ambient[hits.pixels] = scene.lit.gain, scene.lit.ambient
    shape = (rig.camera.height, rig.camera.width)
    x, y = rig.camera.rays()
    points = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) * rig.background_m
    points[hits.pixels] = _points_m(hits, rig)
    u, v = (c.astype(np.float32).reshape(shape) for c in rig.project(points))
    gain, ambient = gain.reshape(shape) / np.float32(255), ambient.reshape(shape)
    noise = studio.exposure.sensor.noise
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
    parser.add_argument("--light", default="paper", help="a named light, or a YAML file (default: paper)")
    args = parser.parse_args()
    # Of one split, so that the shards are of equal size and no worker waits for another at the end.
    objects = tuple(name for name in OBJECTS if split_of(name) == "train")[: args.objects]
    settings = BuildSettings(rig=paper_rig(args.size), objects=objects, light=load_light(args.light))
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
        print(f"  {name:36s} {per_view:8.1f} ms {per_image:7.2f} ms an image")
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
