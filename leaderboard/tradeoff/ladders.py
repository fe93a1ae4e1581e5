"""The ladders over pixels and frames: rendering, decoding, the phase route, networks, scoring, all in memory."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.decoding import Limits, decode_direction, decode_stack, depth_from_both, plan_direction
from fpp_ml_bench.evaluation.score import score_sample
from fpp_ml_bench.leaderboard.tradeoff.ladder import Ladder, Rung
from fpp_ml_bench.loaders.render import BuildSettings, Studio, solid_mesh
from fpp_ml_bench.optics import Rig, Sequence

OBJECT, VIEW = "power_drill", "A60"
SIZES, QUICK_SIZES = (240, 360, 480, 720, 960), (240, 320, 480)
NETWORK_SIZES = (240, 320, 480, 640, 960)
"""Multiples of 16, as a UNet takes them."""
STEPS, QUICK_STEPS = (4, 8, 16, 32), (4, 8, 16)
"""Sinusoids a direction, with 7 Gray bits each, black and white: 24 to 80 frames."""
FRAMES_SIZE = 360
BATCHES = (1, 2, 4, 8)


def pixel_ladders(rig: Rig, quick: bool = False) -> Iterator[Ladder]:
    """Stages over image pixels, each on a view rendered at each size; networks last, because torch stays loaded."""
    sizes = QUICK_SIZES if quick else SIZES
    yield Ladder("render a view", "pixels", sizes, partial(_render, rig))
    yield Ladder("decode", "pixels", sizes, partial(_decode, rig))
    yield Ladder("decode: phase and order of one direction", "pixels", sizes, partial(_phase, rig))
    yield Ladder("decode: triangulate from both (NumPy)", "pixels", sizes, partial(_triangulate, rig))
    yield Ladder("phase route", "pixels", sizes, partial(_phase_route, rig))
    yield Ladder("score a view", "pixels", sizes, partial(_score, rig))
    yield Ladder("UNet width 8, untrained", "pixels", NETWORK_SIZES[: 3 if quick else None], partial(_network, rig))
    yield Ladder("UNet width 8, untrained", "rows", BATCHES[: 3 if quick else None], partial(_network_batch, rig))


def frame_ladders(rig: Rig, quick: bool = False) -> Iterator[Ladder]:
    """Stages over the frames of a capture."""
    steps = QUICK_STEPS if quick else STEPS
    yield Ladder("render a view", "frames", steps, partial(_render_frames, rig))
    yield Ladder("decode", "frames", steps, partial(_decode_frames, rig))


def _studio(rig: Rig) -> Studio:
    return Studio(BuildSettings(rig, (OBJECT,)))


def _pixels(rig: Rig) -> int:
    return rig.camera.width * rig.camera.height


def _with_steps(rig: Rig, steps: int) -> Rig:
    bits = rig.sequence.bits_horizontal, rig.sequence.bits_vertical
    return replace(rig.scaled(FRAMES_SIZE), sequence=Sequence(steps, *bits))


def _captured(rig: Rig) -> tuple[list[NDArray[np.uint8]], NDArray[np.float32]]:
    """Frames and depth of the ladder's view."""
    row = _studio(rig).photograph(solid_mesh(OBJECT), VIEW)
    return [row.frames[index] for index in range(len(rig.sequence))], row.depth_mm


def _render(rig: Rig, size: int, folder: Path) -> Rung:
    return _photograph(rig.scaled(size), _pixels)


def _render_frames(rig: Rig, steps: int, folder: Path) -> Rung:
    return _photograph(_with_steps(rig, steps), lambda scaled: len(scaled.sequence))


def _photograph(rig: Rig, amount: Callable[[Rig], int]) -> Rung:
    studio, mesh = _studio(rig), solid_mesh(OBJECT)
    return Rung(amount(rig), lambda: _ignore(studio.photograph(mesh, VIEW)))


def _ignore(result: object) -> None:
    """Drop a result: only the time matters."""


def _decode(rig: Rig, size: int, folder: Path) -> Rung:
    scaled = rig.scaled(size)
    return _decoding(scaled, _pixels(scaled))


def _decode_frames(rig: Rig, steps: int, folder: Path) -> Rung:
    changed = _with_steps(rig, steps)
    return _decoding(changed, len(changed.sequence))


def _decoding(rig: Rig, amount: int) -> Rung:
    frames, _ = _captured(rig)
    return Rung(amount, lambda: _ignore(decode_stack(frames, rig)))


def _phase(rig: Rig, size: int, folder: Path) -> Rung:
    """Phase and order of one direction, on the whole image at once."""
    scaled = rig.scaled(size)
    frames, _ = _captured(scaled)
    plan = plan_direction(scaled, "vertical", scaled.sequence.steps, Limits())
    grey = np.stack([frames[index].reshape(-1) for index in plan.frames])
    return Rung(_pixels(scaled), lambda: _ignore(decode_direction(grey, plan, Limits())))


def _triangulate(rig: Rig, size: int, folder: Path) -> Rung:
    scaled = rig.scaled(size)
    rays = scaled.camera.rays()
    depth_m = 1.8 + 0.1 * rays[0]
    u, v = scaled.project(np.stack([rays[0] * depth_m, rays[1] * depth_m, depth_m], axis=-1))
    return Rung(_pixels(scaled), lambda: _ignore(depth_from_both(rays, u, v, scaled)))


def _phase_route(rig: Rig, size: int, folder: Path) -> Rung:
    from fpp_ml_bench.baselines.phase_route import PhaseMethod

    scaled = rig.scaled(size)
    frames, _ = _captured(scaled)
    method = PhaseMethod(scaled)
    return Rung(_pixels(scaled), lambda: method.measure(frames).seconds)


def _score(rig: Rig, size: int, folder: Path) -> Rung:
    scaled = rig.scaled(size)
    _, depth_mm = _captured(scaled)
    predicted = depth_mm + np.float32(1.5) * (depth_mm > 0)
    return Rung(_pixels(scaled), lambda: _ignore(score_sample(predicted, depth_mm)))


def _network(rig: Rig, size: int, folder: Path) -> Rung:
    return _batch(size, 1, size * size)


def _network_batch(rig: Rig, batch: int, folder: Path) -> Rung:
    return _batch(QUICK_SIZES[0], batch, batch)


def _batch(size: int, batch: int, amount: int) -> Rung:
    import torch

    from fpp_ml_bench.baselines.networks import build

    torch.manual_seed(0)
    network = build("unet", width=8).eval().requires_grad_(False)
    network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    fringe = torch.rand(batch, 1, size, size)

    def run() -> None:
        with torch.inference_mode():
            network(fringe)

    return Rung(amount, run)
