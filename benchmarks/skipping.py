"""What skipping unneeded work saves on a sparse scene and costs on a full one: the same work with skipping on and off.

    python benchmarks/skipping.py [--size 960] [--repeats 5] [--scenes pen,drum] [--no-builds]
        [--folder DIR] [--json FILE]

Two scenes go through everything: a pen (about 3% of the image) and the largest drum that still fits the image and the
working range (about 70% of the image). Each piece of work runs with skipping on and off in turns, in one process; the
figures are medians of processor seconds, which other work on the machine changes little, and the ratio is taken of
those. Results are compared bit by bit as they come. The first round compiles and is not counted.

- build: the real builder, six views, all 52 frames stored, and frame 0 alone.
- decode: 52 frames to depth from both directions without the reasons of invalid pixels (as ``predict classical`` does);
  and inside the object mask alone, against the whole image.
- the fewest frames: the same depth from 36 frames, and from 6 instead of 20, where a pixel sees one lit surface: of a
  mixed pixel each frame may show another one, and the frames that are left out would have refused it.
- phase: the single-shot phase route in its crop around the object, against the whole image. The crop is part of that
  method, so its maps are not compared.
- eval: every score of the six samples.
"""

import argparse
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np
import trimesh

from fpp_ml_bench.baselines.phase_route import PhaseRoute
from fpp_ml_bench.decoding import decode_stack
from fpp_ml_bench.evaluation.score import score_sample
from fpp_ml_bench.files import file_hash
from fpp_ml_bench.loaders.render import BuildSettings, build, single_mesh
from fpp_ml_bench.loaders.storage import DatasetFolder
from fpp_ml_bench.machine import describe_hardware
from fpp_ml_bench.optics import paper_rig
from fpp_ml_bench.skipping import skipping

Work = Callable[[], Any]


def scenes(folder: Path) -> dict[str, Path]:
    """Mesh files of the two objects, metres, standing on the turning axis."""
    pen = trimesh.creation.cylinder(0.014, 0.62)
    drum = trimesh.creation.cylinder(0.285, 0.6, sections=96)
    paths = {}
    for name, mesh in (("pen", pen), ("drum", drum)):
        paths[name] = folder / f"{name}_like.stl"
        mesh.export(paths[name])
    return paths


def seconds(on: Work, off: Work, repeats: int) -> tuple[float, float, bool]:
    """Median processor seconds of the two ways, run in turns after one round that is not counted; whether both gave
    the same."""
    taken: tuple[list[float], list[float]] = ([], [])
    same = True
    for number in range(repeats + 1):
        results = []
        for side, work in enumerate((on, off)):
            started = time.process_time()
            results.append(work())
            if number:
                taken[side].append(time.process_time() - started)
        same = same and results[0] == results[1]
    return statistics.median(taken[0]), statistics.median(taken[1]), same


def switched(work: Work) -> tuple[Work, Work]:
    """The work with skipping on, and off."""

    def run(enabled: bool) -> Any:
        with skipping(enabled):
            return work()

    return lambda: run(True), lambda: run(False)


def measure(
    name: str, mesh: Path, folder: Path, size: int, repeats: int, builds: bool
) -> tuple[str, list[dict[str, Any]]]:
    """All pieces of work on one scene; its title, and a row each."""
    user = single_mesh(mesh)
    rows: list[dict[str, Any]] = []

    def add(title: str, on: Work, off: Work, compared: bool = True, rounds: int = repeats) -> None:
        first, second, same = seconds(on, off, rounds)
        if compared and not same:
            raise SystemExit(f"{name}, {title}: the results differ")
        rows.append({"what": title, "on_s": first, "off_s": second, "ratio": second / first, "compared": compared})
        print(f"  {title:44s} {1000 * first:9.1f} {1000 * second:9.1f} ms {second / first:6.2f}", flush=True)

    for stored in ("all", "single_shot") if builds else ():
        settings = BuildSettings(paper_rig(size), (user.name,), stored=stored, user_meshes=(user,))

        def build_hashes(settings: BuildSettings = settings) -> list[str]:
            with tempfile.TemporaryDirectory(dir=folder) as target:
                build(Path(target) / "set", settings, workers=1)
                return [file_hash(path) for path in sorted((Path(target) / "set").rglob("*")) if path.is_file()]

        add(
            f"build, 6 views, {'52 frames' if stored == 'all' else 'frame 0'}",
            *switched(build_hashes),
            rounds=max(1, repeats // 2),
        )
    build(folder / name / "all", BuildSettings(paper_rig(size), (user.name,), user_meshes=(user,)), workers=1)
    dataset = DatasetFolder(folder / name / "all")
    rig, samples = dataset.rig, dataset.samples("test")
    stacks = {sample: [frame.copy() for frame in dataset.frames(sample, range(52))] for sample in samples[:2]}
    frames = stacks[samples[0]]
    mask = dataset.depth_mm(samples[0], "depth_exact") > 0

    def depth(**options: Any) -> bytes:
        return decode_stack(frames, rig, **options).depth_mm.tobytes()

    add("decode, depth alone", *switched(lambda: depth(reasons=False)))
    add(
        "decode in the mask, against whole and masked",
        lambda: depth(mask=mask, reasons=False),
        lambda: np.where(mask, decode_stack(frames, rig).depth_mm, np.float32(0)).tobytes(),
    )
    void = dataset.void(samples[0])

    def unmixed(**options: Any) -> bytes:
        depth_mm = decode_stack(frames, rig, reasons=False, **options).depth_mm
        return np.where(void, np.float32(0), depth_mm).tobytes()

    add("36 frames against 50", lambda: unmixed(fewest=True), unmixed)
    add("6 frames against 20", lambda: unmixed(steps=3, fewest=True), lambda: unmixed(steps=3))
    cropped, whole = PhaseRoute(rig), PhaseRoute(rig)
    whole._crop = lambda region: (slice(0, size), slice(0, size))  # type: ignore[method-assign]
    add(
        "phase route in its crop, against whole",
        lambda: cropped.measure(frames[0]).counts,
        lambda: whole.measure(frames[0]).counts,
        compared=False,
    )
    rng = np.random.default_rng(0)
    pairs = []
    for sample in samples:
        target = dataset.depth_mm(sample).copy()
        pairs.append(((target + rng.normal(0, 2, target.shape) * (target > 0)).astype(np.float32), target))

    def scores() -> list[Any]:
        return [score_sample(*pair).metrics() for pair in pairs]

    add("every score of 6 samples", *switched(scores))
    cover = sum(dataset.measured(sample)["object_px"] for sample in samples) / (len(samples) * size * size)
    return f"{name}, {100 * cover:.1f}% cover", rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=960)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--scenes", default="pen,drum")
    parser.add_argument("--no-builds", action="store_true", help="leave out the builds, which take the longest")
    parser.add_argument("--folder", type=Path, help="where the datasets go (default: a temporary folder)")
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    machine = describe_hardware()
    print(f"{machine.cpu}, {machine.cores} cores; {args.size} px; processor time, skipping on, off, off / on")
    content: dict[str, Any] = {"size": args.size, "machine": machine.to_dict(), "scenes": {}}
    with tempfile.TemporaryDirectory(prefix="fpp-skipping-", dir=args.folder) as scratch:
        for name, mesh in scenes(Path(scratch)).items():
            if name not in args.scenes.split(","):
                continue
            print(name)
            title, rows = measure(name, mesh, Path(scratch), args.size, args.repeats, not args.no_builds)
            print(f"  = {title}")
            content["scenes"][title] = rows
    if args.json is not None:
        args.json.write_text(json.dumps(content, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
