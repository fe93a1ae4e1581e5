"""Ladders: a stage of the package on growing amounts of input (pixels, frames, rows, objects), where nested loops show.
Rendering, decoding, the phase route, networks and scoring run in memory; building and reading on files."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_route import PhaseMethod
from fpp_ml_bench.coding import Limits
from fpp_ml_bench.constants import VIEWS, sample_name
from fpp_ml_bench.decoding import decode_direction, decode_stack, depth_from_both, plain_plan
from fpp_ml_bench.evaluation.score import evaluate, score_sample
from fpp_ml_bench.loaders.render import BuildSettings, Studio, build, single_mesh, solid_mesh, write_ply
from fpp_ml_bench.loaders.sample import Row, stored_frames
from fpp_ml_bench.loaders.storage import Assembly, DatasetFolder, Manifest, ShardWriter, plan_shards
from fpp_ml_bench.optics import PAPER_SEQUENCE, Rig, paper_rig

OBJECT, VIEW = "power_drill", "A60"
FRAMES_SIZE, BUILT_SIZE, READ_SIZE, ROW_SIZE, BATCH_SIZE = 360, 240, 480, 32, 240
_SIZES, _QUICK_SIZES = (240, 360, 480, 720, 960), (240, 320, 480)
_FEW, _ROW_OBJECTS, _QUICK_ROW_OBJECTS = (1, 2, 3), (8, 32, 128, 512), (4, 8, 16)
"""Objects have six rows each: 48 to 3,072 rows, ten times the benchmark's 300."""
_STEPS, _QUICK_STEPS = (4, 8, 16, 32), (4, 8, 16)
"""Sinusoids a direction, with 7 Gray bits each, black and white: 24 to 80 frames."""
_NETWORK_SIZES, _BATCHES = (240, 320, 480, 640, 960), (1, 2, 4, 8)
"""Multiples of 16, as a UNet takes them."""

Work = Callable[[], object]


@dataclass(frozen=True)
class Rung:
    """``run`` does the work for an ``amount`` of input; where it returns a dict, that is the seconds of its stages."""

    amount: float
    run: Work


@dataclass(frozen=True)
class Ladder:
    """``stage`` over ``over`` (pixels, frames, objects or rows) at ``steps``; ``prepare(step, folder)`` makes a
    rung, which is not timed, with an empty ``folder`` of its own."""

    stage: str
    over: str
    steps: tuple[int, ...]
    prepare: Callable[[int, Path], Rung]

    @property
    def key(self) -> str:
        return f"{self.stage} over {self.over}"


def package_ladders(rig: Rig, quick: bool = False, more: Iterable[Ladder] = ()) -> list[Ladder]:
    """The stages of this package, with those of ``more`` behind the stages over rows; networks last, because torch
    stays loaded. Each stage over pixels is run on a view rendered at each size."""
    over_pixels: dict[str, Callable[[Rig], Work]] = {
        "render a view": _render,
        "decode": _decode,
        "decode: phase and order of one direction": _phase,
        "decode: triangulate from both (NumPy)": _triangulate,
        "phase route": _phase_route,
        "score a view": _score,
    }
    sizes, steps, three = _QUICK_SIZES if quick else _SIZES, _QUICK_STEPS if quick else _STEPS, 3 if quick else None
    row_objects, pixel_sizes = (_QUICK_ROW_OBJECTS, (64, 128, 256)) if quick else (_ROW_OBJECTS, _SIZES)
    return [
        Ladder("build a dataset", "objects", _FEW if quick else (1, 2, 4, 8), partial(_build, rig)),
        Ladder("open and read a frame of each row", "rows", row_objects, _read_rows),
        Ladder("read a row", "frames", (4, 13, 26, 52)[:three], lambda n, own: Rung(n, _reading(own, READ_SIZE, n))),
        Ladder("read a row", "pixels", pixel_sizes, lambda n, own: Rung(n * n, _reading(own, n))),
        Ladder("score a folder of predictions", "rows", _FEW if quick else _ROW_OBJECTS[:3], _evaluate),
        *more,
        Ladder("render a view", "frames", steps, partial(_frame_rung, rig, _render)),
        Ladder("decode", "frames", steps, partial(_frame_rung, rig, _decode)),
        *(Ladder(stage, "pixels", sizes, partial(_pixel_rung, rig, make)) for stage, make in over_pixels.items()),
        Ladder("UNet width 8, untrained", "pixels", _NETWORK_SIZES[:three], lambda n, _: Rung(n * n, _network(n))),
        Ladder("UNet width 8, untrained", "rows", _BATCHES[:three], lambda n, _: Rung(n, _network(BATCH_SIZE, n))),
    ]


def _pixel_rung(rig: Rig, make: Callable[[Rig], Work], size: int, folder: Path) -> Rung:
    scaled = rig.scaled(size)
    return Rung(scaled.camera.width * scaled.camera.height, make(scaled))


def _frame_rung(rig: Rig, make: Callable[[Rig], Work], steps: int, folder: Path) -> Rung:
    sequence = replace(rig.paper_sequence, steps=steps)
    return Rung(len(sequence), make(replace(rig.scaled(FRAMES_SIZE), sequence=sequence)))


def _render(rig: Rig) -> Callable[[], Row]:
    return partial(Studio(BuildSettings(rig, (OBJECT,))).photograph, solid_mesh(OBJECT), VIEW)


def _captured(rig: Rig) -> list[NDArray[np.uint8]]:
    row = _render(rig)()
    return [row.frames[index] for index in range(len(rig.sequence))]


def _decode(rig: Rig) -> Work:
    return partial(decode_stack, _captured(rig), rig)


def _phase(rig: Rig) -> Work:
    """On the whole image at once."""
    frames, plan = _captured(rig), plain_plan(rig, "vertical", rig.sequence.steps, Limits())
    return partial(decode_direction, np.stack([frames[index].reshape(-1) for index in plan.frames]), plan, Limits())


def _triangulate(rig: Rig) -> Work:
    x, y = rays = rig.camera.rays()
    depth_m = 1.8 + 0.1 * x
    return partial(depth_from_both, rays, *rig.project(np.stack([x * depth_m, y * depth_m, depth_m], axis=-1)), rig)


def _phase_route(rig: Rig) -> Work:
    frames, method = _captured(rig), PhaseMethod(rig)
    return lambda: method.measure(frames).seconds


def _score(rig: Rig) -> Work:
    depth_mm = _render(rig)().depth_mm
    return partial(score_sample, depth_mm + np.float32(1.5) * (depth_mm > 0), depth_mm)


def _network(size: int, batch: int = 1) -> Work:
    import torch

    from fpp_ml_bench.baselines.networks import build as build_network

    torch.manual_seed(0)
    network = build_network("unet", width=8).eval().requires_grad_(False)
    network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return torch.inference_mode()(partial(network, torch.rand(batch, 1, size, size)))


def _build(rig: Rig, objects: int, folder: Path) -> Rung:
    """The same mesh under many names: only the number of objects grows."""
    first = folder / "object_00.ply"
    write_ply(solid_mesh("cork"), first)
    mesh = single_mesh(first)
    meshes = tuple(replace(mesh, name=f"object_{number:02d}") for number in range(objects))
    names, numbers = tuple(named.name for named in meshes), count()
    settings = BuildSettings(rig.scaled(BUILT_SIZE), names, stored="single_shot", user_meshes=meshes)
    return Rung(objects, lambda: build(folder / f"dataset-{next(numbers)}", settings, workers=1))


def _dataset(folder: Path, objects: int, size: int, stored: str = "single_shot", views: int = 6) -> DatasetFolder:
    """A dataset of grey noise below ``folder``: ``objects`` of test with ``views`` rows each, ``size`` px square."""
    target, scratch = folder / "dataset", folder / "scratch"
    scratch.mkdir(parents=True)
    rng = np.random.Generator(np.random.PCG64(3))
    frames = {index: rng.integers(0, 255, (size, size), np.uint8) for index in stored_frames(PAPER_SEQUENCE, stored)}
    depth_mm = 1800 + rng.random((size, size), np.float32)
    depth_mm[:, : size // 2] = 0
    nothing = np.zeros((size, size), np.uint8)  # no flags, no cover
    names = [f"object_{number:04d}" for number in range(objects)]
    samples_by_object = {name: [(sample_name(name, view), name, view) for view in VIEWS[:views]] for name in names}
    writer = ShardWriter(target, scratch, PAPER_SEQUENCE, stored, True, (size, size))
    plans = plan_shards("test", samples_by_object)
    receipts = [
        writer.write(plan, (Row(*where, frames, depth_mm, depth_mm, {}, nothing, nothing) for where in plan.samples))
        for plan in plans
    ]
    manifest = Manifest("generated", {}, {}, paper_rig(max(size, 240)).to_dict(), (size, size), stored, exact=True)
    Assembly(plans, lambda plan, folder: (), manifest).filled(receipts).write(target)
    return DatasetFolder(target)


def _read_rows(objects: int, folder: Path) -> Rung:
    path = _dataset(folder, objects, ROW_SIZE).path

    def run() -> None:
        opened = DatasetFolder(path)
        for sample in opened.samples("test"):
            opened.frame(sample, 0).max()  # brings every byte into the processor

    return Rung(objects * len(VIEWS), run)


def _reading(folder: Path, size: int, frames: int = len(PAPER_SEQUENCE)) -> Work:
    """The first ``frames`` frames of a dataset's only row."""
    opened = _dataset(folder, 1, size, "all", views=1)
    (sample,) = opened.samples("test")
    return lambda: [frame.max() for frame in opened.frames(sample, range(frames))]


def _evaluate(objects: int, folder: Path) -> Rung:
    opened = _dataset(folder, objects, ROW_SIZE)
    predictions = folder / "predictions"
    predictions.mkdir()
    for sample in opened.samples("test"):
        np.save(predictions / f"{sample}.npy", opened.depth_mm(sample) + np.float32(1))
    (predictions / "submission.yaml").write_text(
        "name: A method\nmethod: test\nunits: mm\nframes_used: [0]\nuses_ground_truth_range: false\n"
        "seconds_per_sample: null\nseconds_source: self-reported\nhardware: null\nsoftware: {}\nsettings: {}\n",
        encoding="utf-8",
    )
    return Rung(objects * len(VIEWS), partial(evaluate, predictions, opened))
