"""Generating, noise and all, written to disk: images a second, where the time goes, and a plain
pipeline beside it.

    python benchmarks/generate_speed.py [--size 960] [--objects 16] [--workers 2] [--light paper] [--folder DIR]

Ours is the real builder (`fpp_ml_bench.loaders.render.builder`): ray casting, further bounces, 52
exposures with shot and read noise, ground-truth decoding, Arrow shards with checksums. It runs
twice, once into ``--folder`` and once into memory (``/dev/shm``): the difference is the disk's
share. A first build that is not counted compiles the kernels.

The peer is what a careful script does with OpenCV and NumPy on one core, with the same scene and
noise model and direct light alone: a `cv2.remap` lookup of the projector image, NumPy's SFC64
normal noise, rounding, `cv2.imwrite` to PNG; no ground truth. Its images a second are multiplied by
the number of workers, as if it scaled perfectly.

    python benchmarks/generate_speed.py --memory [--rows 24,48,96] [--sizes 240,480,960] [--folder DIR]

The peak memory of each command against rows and image size instead. Every command runs as a process
of its own (``fpp-bench ... --workers 1``), and the figure is its ``ru_maxrss`` (getrusage(2)),
imports and shared libraries included. First the rows grow at 240 px, then the size at the first
number of rows. A command whose memory is constant in rows shows the same figure three times, to a
few MiB of noise.
"""

import argparse
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np

from fpp_ml_bench.constants import OBJECTS, VIEW_DEGREES, VIEWS, split_of
from fpp_ml_bench.decoding.decode import decode_stack
from fpp_ml_bench.loaders.render.builder import build
from fpp_ml_bench.loaders.render.light import load_light
from fpp_ml_bench.loaders.render.lighting import ObjectLight
from fpp_ml_bench.loaders.render.meshes import solid_mesh
from fpp_ml_bench.loaders.render.pixels import mixed_pixels
from fpp_ml_bench.loaders.render.raycast import Hits, PixelRays, TracedObject
from fpp_ml_bench.loaders.render.scene import BuildSettings, place
from fpp_ml_bench.loaders.render.surfels import Surfels
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.machine import describe_hardware
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.patterns import pattern_image
from fpp_ml_bench.optics.rig import Rig

FULL_IMAGES = 15_600
VIEW = "A60"
MEMORY_PX = 240
LAUNCHER = """\
import resource, subprocess, sys
status = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL).returncode
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
sys.exit(status)
"""
"""Runs a command from a small process: the largest resident set of a child begins at that of its
parent."""


def timed_build(folder: Path, settings: BuildSettings, workers: int) -> tuple[float, int, int]:
    """Seconds, images and bytes of one build into a new folder below ``folder``, which is removed
    again."""
    target = Path(tempfile.mkdtemp(prefix="fpp-generate-", dir=folder)) / "dataset"
    try:
        started = time.perf_counter()
        manifest = build(target, settings, workers)
        seconds = time.perf_counter() - started
        rows = sum(len(rows) for rows in manifest.samples.values())
        return (
            seconds,
            rows * len(settings.rig.sequence),
            sum(shard.bytes for shard in manifest.shards),
        )
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
    """Milliseconds of each stage and their share an image, one process, one view of the first
    object; form factors are shared by the object's views."""
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
    upon = ObjectLight(studio.lighting, mesh, traced, degrees, offset_m)
    shaded = scene.lit.gain > 0 if light.bounces.shadows else None
    points_m = _points_m(scene.hits, rig)
    count, across = len(frames), light.camera.rays_across
    surfels = light.bounces.interreflection or light.bounces.ambient_occlusion
    every: list[tuple[str, Callable[[], object] | None, int]] = [
        ("triangles of the mesh", lambda: TracedObject(mesh, vertices_m), 1),
        ("tracing: triangle and exact depth", lambda: traced.primary(rays), 1),
        (
            "mixed pixels",
            (lambda: mixed_pixels(traced, hits, rig, across, shaded)) if mixed else None,
            1,
        ),
        (
            "form factors, once an object",
            (lambda: Surfels.of(mesh)) if surfels else None,
            len(VIEWS),
        ),
        (
            "bounces",
            (lambda: ObjectLight(studio.lighting, mesh, traced, degrees, offset_m))
            if surfels
            else None,
            1,
        ),
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
    """A plain OpenCV + NumPy pipeline on one core, frames written as PNG: direct light alone, a ray
    a pixel."""
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
        light = cv2.remap(
            patterns[index].astype(np.float32),
            u,
            v,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        signal = ambient + gain * light
        sigma = np.sqrt(np.float32(noise.read_variance) + np.float32(noise.shot_per_grey) * signal)
        value = signal + sigma * generator.standard_normal(shape, dtype=np.float32)
        frame = np.clip(np.rint(value), 0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / f"A_{index}.png"), frame)
    return images / (time.perf_counter() - started)


def peak_mib(program: str, *arguments: str) -> float:
    """Largest resident set of a command, MiB. Raises `SystemExit` where it fails."""
    command = [
        sys.executable,
        "-c",
        LAUNCHER,
        str(Path(sys.executable).with_name(program)),
        *arguments,
    ]
    ended = subprocess.run(command, capture_output=True, text=True)
    if ended.returncode:
        raise SystemExit(f"{program} {' '.join(arguments)}: {ended.stderr[-2000:]}")
    return int(ended.stdout) / (2**20 if sys.platform == "darwin" else 2**10)


def peaks_mib(folder: Path, rows: int, size: int) -> dict[str, float]:
    """MiB by command, on a dataset of its own that is removed again."""
    names = [name for name in OBJECTS if split_of(name) == "train"][: rows // len(VIEWS)]
    with tempfile.TemporaryDirectory(prefix="fpp-memory-", dir=folder) as scratch:
        data, out, split = f"{scratch}/set", f"{scratch}/predictions", ("--split", "train")
        commands = {
            "build": (
                "build",
                "--out",
                data,
                "--size",
                str(size),
                "--objects",
                ",".join(names),
                "--workers",
                "1",
            ),
            "predict classical": (
                "predict",
                "classical",
                data,
                *split,
                "--out",
                f"{scratch}/classical",
            ),
            "predict classical --fewest": (
                *("predict", "classical", data, "--fewest", "--steps", "3"),
                *(*split, "--out", f"{scratch}/fewest"),
            ),
            "predict phase": ("predict", "phase", data, *split, "--out", out),
        }
        peaks = {name: peak_mib("fpp-bench", *words) for name, words in commands.items()}
        peaks["fpp-eval"] = peak_mib("fpp-eval", out, data, *split)
        return peaks | {name: peak_mib("fpp-bench", name, data) for name in ("verify", "info")}


def print_memory(rows: list[int], sizes: list[int], folder: Path) -> None:
    """Both tables: over rows at `MEMORY_PX`, and over the image size at the first number of
    rows."""
    by_rows = [peaks_mib(folder, count, MEMORY_PX) for count in rows]
    by_size = [
        by_rows[0] if size == MEMORY_PX else peaks_mib(folder, rows[0], size) for size in sizes
    ]
    for title, columns, results in (
        (f"rows at {MEMORY_PX} px", [f"{count} rows" for count in rows], by_rows),
        (f"image size at {rows[0]} rows", [f"{size} px" for size in sizes], by_size),
    ):
        print(f"\n{title}\n{'command':<28}" + "".join(f"{column:>12}" for column in columns))
        for name in results[0]:
            print(f"{name:<28}" + "".join(f"{result[name]:>8.0f} MiB" for result in results))


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=int, default=960)
    parser.add_argument(
        "--objects", type=int, default=16, help="training objects, six views each (default: 16)"
    )
    parser.add_argument("--workers", type=int, default=describe_hardware().cores)
    parser.add_argument(
        "--folder", type=Path, default=Path.cwd(), help="a folder on the disk to measure"
    )
    parser.add_argument(
        "--light", default="paper", help="a named light, or a YAML file (default: paper)"
    )
    parser.add_argument(
        "--memory", action="store_true", help="the peak memory of each command instead"
    )
    parser.add_argument(
        "--rows", default="24,48,96", help="rows at 240 px, each a multiple of 6 up to 240"
    )
    parser.add_argument(
        "--sizes", default="240,480,960", help="image sizes at the first number of rows"
    )
    args = parser.parse_args()
    if args.memory:
        rows, sizes = (
            [int(number) for number in numbers.split(",")] for numbers in (args.rows, args.sizes)
        )
        print_memory(rows, sizes, args.folder)
        return 0
    # Of one split, so that the shards are of equal size and no worker waits for another at the end.
    objects = tuple(name for name in OBJECTS if split_of(name) == "train")[: args.objects]
    settings = BuildSettings(
        rig=paper_rig(args.size), objects=objects, light=load_light(args.light)
    )
    machine = describe_hardware()
    print(
        f"{machine.cpu}, {machine.cores} cores, {machine.memory_gib} GiB; {args.size} px, "
        f"{args.workers} workers"
    )

    timed_build(args.folder, BuildSettings(rig=paper_rig(176), objects=("cork",)), 1)
    seconds, images, size = timed_build(args.folder, settings, args.workers)
    print(
        f"to disk:   {images} images, {size / 1e9:.2f} GB in {seconds:.1f} s = "
        f"{images / seconds:.0f} images/s"
    )
    memory = Path("/dev/shm")
    if memory.is_dir() and shutil.disk_usage(memory).free > 1.2 * size:
        in_memory, _, _ = timed_build(memory, settings, args.workers)
        share = max(0.0, 1 - in_memory / seconds)
        print(
            f"to memory: {in_memory:.1f} s = {images / in_memory:.0f} images/s; the disk's share "
            f"is {100 * share:.0f}%"
        )
    rate = images / seconds
    full_gb = size / images * FULL_IMAGES / 1e9
    print(
        f"projected full set: {FULL_IMAGES} images in {FULL_IMAGES / rate / 60:.1f} min, "
        f"{full_gb:.1f} GB"
    )
    print("one view, one process:")
    for name, per_view, per_image in stages(settings):
        print(f"  {name:36s} {per_view:8.1f} ms {per_image:7.2f} ms an image")
    with tempfile.TemporaryDirectory(dir=args.folder) as folder:
        peer = peer_images_per_second(settings, Path(folder))
    print(
        f"peer (OpenCV + NumPy + PNG): {peer:.1f} images/s a core, {peer * args.workers:.1f} on "
        f"{args.workers}"
    )
    print(f"ratio ours / peer: {rate / (peer * args.workers):.1f}")
    generator = np.random.Generator(np.random.SFC64(0))
    normal = np.empty((args.size, args.size), dtype=np.float32)
    noise_ms = median_ms(lambda: generator.standard_normal(dtype=np.float32, out=normal))
    print(f"NumPy's normal noise alone (SFC64, float32): {noise_ms:.1f} ms an image")
    print("the paper's pipeline (reported by the paper, on a GPU, not run here): 3 images/s")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
