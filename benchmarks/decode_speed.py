"""Decoding one view: this package against `fringes` and OpenCV's structured_light, in the same run
on the same scene.

    python benchmarks/decode_speed.py [--size 960] [--repeats 7]

A tilted plane across the working range is seen by the paper's rig, with ambient light, noise of one
grey level and 8-bit rounding. Every method decodes what its own patterns look like in that scene,
with as equal a number of frames as it can:

- ours: 18 sinusoids + 7 Gray bits a direction, to depth in mm;
- fringes: 18 + 7 sinusoids a direction at two frequencies (it has no Gray code), to projector
  coordinates; and on the same 18 + 18 sinusoids as ours, where it unwraps in space, to a phase
  relative to an unknown number of periods;
- OpenCV GrayCodePattern: 42 binary frames (21 and their inverses), black and white, to whole
  projector pixels with one call a pixel from Python (timed on a sample of pixels and scaled up), or
  to a two-camera disparity map in one call (timed on the stack passed twice, and halved). It has no
  phase;
- OpenCV SinusoidalPattern (PSP): 3 of our 18 frames of one direction, to a phase unwrapped in
  space, relative to an unknown whole number of periods, which is taken from the truth here.

Peers stop at the coordinate, so their depth is triangulated by us, outside their time; ours
includes it. Errors are over each method's decoded pixels that lie 4 projector px or more inside the
pattern.
"""

import argparse
import logging
import os
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.decoding.decode import decode_stack
from fpp_ml_bench.decoding.triangulation import depth_from_both, depth_from_coordinate
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.patterns import pattern_image
from fpp_ml_bench.optics.rig import Rig

ALBEDO, AMBIENT, NOISE = 0.45, 4.0, 1.0


class Scene(NamedTuple):
    """What the camera sees: depth in mm and projector coordinates in px, (H, W) each, float64."""

    rig: Rig
    depth_mm: NDArray
    u: NDArray
    v: NDArray

    def capture(self, patterns: list[NDArray], seed: int) -> list[NDArray]:
        """Images uint8 (H, W) of the patterns (h_p, w_p)."""
        rng = np.random.default_rng(seed)
        maps = self.u.astype(np.float32), self.v.astype(np.float32)
        images = []
        for pattern in patterns:
            light = cv2.remap(pattern.astype(np.float32), *maps, cv2.INTER_LINEAR)
            noisy = (
                AMBIENT
                + ALBEDO * light
                + NOISE * rng.standard_normal(light.shape, dtype=np.float32)
            )
            images.append(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
        return images


class Row(NamedTuple):
    name: str
    output: str
    frames: int
    threads: int
    seconds: float
    u_error: NDArray | None = None
    depth_error: NDArray | None = None


def make_scene(size: int) -> Scene:
    rig = paper_rig(size)
    x, y = rig.camera.rays()
    depth = 1.8 / (1.0 - 0.35 * x + 0.25 * y)
    u, v = rig.project(np.stack([x * depth, y * depth, depth], axis=-1))
    return Scene(rig, depth * 1000, u, v)


def timed(call: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    """Median seconds of ``repeats`` calls after one that is not counted, and the result."""
    result = call()
    taken = []
    for _ in range(repeats):
        start = time.perf_counter()
        result = call()
        taken.append(time.perf_counter() - start)
    return statistics.median(taken), result


def run_ours(scene: Scene, repeats: int) -> list[Row]:
    rig = scene.rig
    frames = scene.capture([pattern_image(rig, i) for i in range(len(rig.sequence))], seed=1)
    rows = []
    for threads in dict.fromkeys((1, os.cpu_count() or 1)):
        for direction in ("both", "vertical"):

            def call(direction: Any = direction, threads: int = threads) -> Any:
                return decode_stack(frames, rig, direction, threads=threads)

            seconds, decoded = timed(call, repeats)
            exact = (
                decode_stack(frames, rig, direction, details=True).details["vertical"].coordinate_px
            )
            depth = np.where(decoded.depth_mm > 0, decoded.depth_mm, np.nan)
            name = f"ours, {direction}"
            error = depth - scene.depth_mm
            rows.append(
                Row(
                    name,
                    "depth",
                    len(decoded.frames_used),
                    threads,
                    seconds,
                    exact - scene.u,
                    error,
                )
            )
    return rows


def run_fringes(scene: Scene, repeats: int) -> list[Row]:
    try:
        from fringes import Fringes
    except ImportError:
        print("fringes is not installed (pip install --group peers): left out")
        return []
    logging.getLogger("fringes").setLevel(
        logging.ERROR
    )  # it warns on every call that one frequency is ambiguous
    projector, rows = scene.rig.projector, []
    periods = max(projector.width, projector.height) / scene.rig.pitch_vertical_px
    coder = Fringes(X=projector.width, Y=projector.height)
    coder.K = 2
    coder.v = [[periods, 1.0]] * 2
    coder.N = [[18, 7]] * 2
    stack = np.stack(scene.capture(list(coder.encode()[..., 0]), seed=2))
    for threads in sorted({1, os.cpu_count() or 1}):
        seconds, decoded = timed(
            lambda threads=threads: coder.decode(stack, threads=threads), repeats
        )
        u, v = (decoded.x[i, ..., 0].astype(np.float64) for i in (0, 1))
        depth = depth_from_both(scene.rig.camera.rays(), u, v, scene.rig).depth_mm
        error = depth - scene.depth_mm
        rows.append(
            Row("fringes, both", "coordinates", len(stack), threads, seconds, u - scene.u, error)
        )
    same = Fringes(X=projector.width, Y=projector.height)
    same.K = 1
    same.v, same.N = [[periods]] * 2, [[18]] * 2
    sequence = scene.rig.sequence
    ours = [
        pattern_image(scene.rig, i)
        for d in ("vertical", "horizontal")
        for i in sequence.sinusoids(d)
    ]
    stack = np.stack(scene.capture(ours, seed=1))
    seconds, _ = timed(lambda: same.decode(stack, unwrap=False, threads=1), repeats)
    rows.append(Row("fringes, our sinusoids, both", "relative phase", len(stack), 1, seconds))
    return rows


def run_opencv(scene: Scene, repeats: int) -> list[Row]:
    rig, projector = scene.rig, scene.rig.projector
    count_px = rig.camera.width * rig.camera.height
    code = cv2.structured_light.GrayCodePattern.create(projector.width, projector.height)
    _, patterns = code.generate()
    black, white = (np.full_like(patterns[0], level) for level in (0, 255))
    images = scene.capture([*patterns, black, white], seed=3)
    stack, count = images[:-2], len(images)
    pixels = np.random.default_rng(0).choice(count_px, 2000, replace=False)
    u, v = np.full(count_px, np.nan), np.full(count_px, np.nan)

    def sample() -> None:
        for index in pixels:
            failed, pixel = code.getProjPixel(
                stack, int(index % rig.camera.width), int(index // rig.camera.width)
            )
            u[index], v[index] = (np.nan, np.nan) if failed else pixel

    seconds, _ = timed(sample, 1)
    seconds *= count_px / len(pixels)
    u, v = u.reshape(rig.camera.height, -1), v.reshape(rig.camera.height, -1)
    error = depth_from_both(rig.camera.rays(), u, v, rig).depth_mm - scene.depth_mm
    threads = cv2.getNumThreads()
    rows = [
        Row(
            "OpenCV Gray code, pixel by pixel *",
            "whole px",
            count,
            threads,
            seconds,
            u - scene.u,
            error,
        )
    ]
    twice = [np.stack(stack)] * 2
    dark, light = [images[-2]] * 2, [images[-1]] * 2
    seconds, _ = timed(lambda: code.decode(twice, None, dark, light), min(repeats, 3))
    rows.append(Row("OpenCV Gray code, decode() / 2", "disparity", count, threads, seconds / 2))

    settings = cv2.structured_light_SinusoidalPattern_Params()
    settings.width, settings.height, settings.horizontal = projector.width, projector.height, False
    settings.nbrOfPeriods, settings.methodId = projector.width // 18, cv2.structured_light.PSP
    sinusoid = cv2.structured_light.SinusoidalPattern.create(settings)
    steps = rig.sequence.sinusoids("vertical")[::6]
    three = scene.capture([pattern_image(rig, i) for i in steps], seed=4)
    lit = np.full(three[0].shape, 255, dtype=np.uint8)

    def unwrap() -> Any:
        wrapped, mask = sinusoid.computePhaseMap(three, shadowMask=lit)
        return sinusoid.unwrapPhaseMap(
            wrapped, (rig.camera.width, rig.camera.height), shadowMask=mask
        )

    seconds, phase = timed(unwrap, min(repeats, 3))
    period = rig.pitch_vertical_px
    measured = np.asarray(phase, dtype=np.float64) * period / (2 * np.pi)
    # Its sign and its zero are its own: both, and the unknown whole periods, come from the truth.
    errors = [sign * measured - scene.u for sign in (1, -1)]
    spread = [error - np.nanmedian(error) for error in errors]
    u_error = min(spread, key=lambda error: float(np.nanmedian(np.abs(error))))
    depth = depth_from_coordinate(rig.camera.rays(), scene.u + u_error, rig, "vertical")
    name = "OpenCV PSP + spatial unwrapping, vertical"
    rows.append(Row(name, "relative phase", 3, threads, seconds, u_error, depth - scene.depth_mm))
    return rows


def report(scene: Scene, rows: list[Row]) -> None:
    margin, projector = 4.0, scene.rig.projector
    inside = (scene.u > margin) & (scene.u < projector.width - 1 - margin)
    inside &= (scene.v > margin) & (scene.v < projector.height - 1 - margin)
    reference = rows[0].seconds
    heads = f"{'frames':>7}{'threads':>8}{'seconds':>10}{'ratio':>8}{'u RMSE':>10}{'depth MAE':>11}"
    print(f"{'method':<42}{'gives':<16}{heads}")
    for row in rows:
        errors = ""
        if row.u_error is not None and row.depth_error is not None:
            u, depth = row.u_error[inside], row.depth_error[inside]
            rmse, mae = float(np.sqrt(np.nanmean(u**2))), float(np.nanmean(np.abs(depth)))
            errors = f"{rmse:7.4f} px{mae:8.3f} mm"
        line = f"{row.name:<42}{row.output:<16}{row.frames:>7}{row.threads:>8}{row.seconds:>10.4f}"
        print(f"{line}{row.seconds / reference:>8.1f}{errors}")
    print("ratio: to the first row. * timed on 2000 pixels and scaled up")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--size", type=int, default=960, help="camera image width and height in px (default 960)"
    )
    parser.add_argument(
        "--repeats", type=int, default=7, help="timed calls, of which the median counts (default 7)"
    )
    args = parser.parse_args()
    if args.size < 240 or args.repeats < 1:
        parser.error("--size must be at least 240 (the peers' own limits) and --repeats at least 1")
    scene = make_scene(args.size)
    load = os.getloadavg()[0]
    print(
        f"{args.size} x {args.size} px, median of {args.repeats}; {os.cpu_count()} cores, load at "
        f"the start {load:.1f}"
    )
    rows = (
        run_ours(scene, args.repeats)
        + run_fringes(scene, args.repeats)
        + run_opencv(scene, args.repeats)
    )
    report(scene, rows)


if __name__ == "__main__":
    main()
