"""Ladders: a stage of the package on growing amounts of input (pixels, frames, rows, objects), where nested loops show.
Rendering, decoding, the phase route, networks and scoring run in memory; building and reading on files."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_route import PhaseMethod
from fpp_ml_bench.constants import VIEWS, sample_name
from fpp_ml_bench.decoding import Limits, decode_direction, decode_stack, depth_from_both, plan_direction
from fpp_ml_bench.evaluation.score import evaluate, score_sample
from fpp_ml_bench.loaders.render import BuildSettings, Studio, build, single_mesh, solid_mesh, write_ply
from fpp_ml_bench.loaders.sample import stored_frames
from fpp_ml_bench.loaders.storage import DatasetFolder, Manifest, Row, ShardWriter, plan_shards
from fpp_ml_bench.optics import PAPER_SEQUENCE, Rig, Sequence, paper_rig

OBJECT, VIEW = "power_drill", "A60"
SIZES, QUICK_SIZES = (240, 360, 480, 720, 960), (240, 320, 480)
NETWORK_SIZES = (240, 320, 480, 640, 960)
"""Multiples of 16, as a UNet takes them."""
STEPS, QUICK_STEPS = (4, 8, 16, 32), (4, 8, 16)
"""Sinusoids a direction, with 7 Gray bits each, black and white: 24 to 80 frames."""
FRAMES_SIZE = 360
BATCHES = (1, 2, 4, 8)
BUILT_OBJECTS, QUICK_OBJECTS = (1, 2, 4, 8), (1, 2, 3)
BUILT_SIZE = 240
ROW_OBJECTS, QUICK_ROW_OBJECTS = (8, 32, 128, 512), (4, 8, 16)
"""Objects of six rows each: 48 to 3,072 rows, ten times the benchmark's 300."""
SCORED_OBJECTS = (8, 32, 128)
READ_FRAMES, READ_SIZES, QUICK_READ_SIZES = (4, 13, 26, 52), (240, 360, 480, 720, 960), (64, 128, 256)
ROW_SIZE = 32

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
        """Name of the ladder, unique in a run."""
        return f"{self.stage} over {self.over}"


def pixel_ladders(rig: Rig, quick: bool = False) -> Iterator[Ladder]:
    """Stages over image pixels, each on a view rendered at each size; networks last, because torch stays loaded."""
    stages: dict[str, Callable[[Rig], Work]] = {
        "render a view": _render,
        "decode": _decode,
        "decode: phase and order of one direction": _phase,
        "decode: triangulate from both (NumPy)": _triangulate,
        "phase route": _phase_route,
        "score a view": _score,
    }
    for stage, make in stages.items():
        yield Ladder(stage, "pixels", QUICK_SIZES if quick else SIZES, partial(_pixel_rung, rig, make))
    unet, count = "UNet width 8, untrained", 3 if quick else None
    yield Ladder(unet, "pixels", NETWORK_SIZES[:count], lambda size, folder: Rung(size * size, _network(size, 1)))
    yield Ladder(unet, "rows", BATCHES[:count], lambda batch, folder: Rung(batch, _network(QUICK_SIZES[0], batch)))


def frame_ladders(rig: Rig, quick: bool = False) -> Iterator[Ladder]:
    """Stages over the frames of a capture."""
    for stage, make in (("render a view", _render), ("decode", _decode)):
        yield Ladder(stage, "frames", QUICK_STEPS if quick else STEPS, partial(_frame_rung, rig, make))


def row_ladders(rig: Rig, quick: bool = False) -> Iterator[Ladder]:
    """Stages over objects and rows, and reading also over pixels and frames."""
    yield Ladder("build a dataset", "objects", QUICK_OBJECTS if quick else BUILT_OBJECTS, partial(_build, rig))
    yield Ladder("open and read a frame of each row", "rows", QUICK_ROW_OBJECTS if quick else ROW_OBJECTS, _read_rows)
    yield Ladder("read a row", "frames", READ_FRAMES[: 3 if quick else None], _read_frames)
    yield Ladder("read a row", "pixels", QUICK_READ_SIZES if quick else READ_SIZES, _read_pixels)
    yield Ladder("score a folder of predictions", "rows", QUICK_OBJECTS if quick else SCORED_OBJECTS, _evaluate)


def _pixel_rung(rig: Rig, make: Callable[[Rig], Work], size: int, folder: Path) -> Rung:
    scaled = rig.scaled(size)
    return Rung(scaled.camera.width * scaled.camera.height, make(scaled))


def _frame_rung(rig: Rig, make: Callable[[Rig], Work], steps: int, folder: Path) -> Rung:
    bits = rig.sequence.bits_horizontal, rig.sequence.bits_vertical
    changed = replace(rig.scaled(FRAMES_SIZE), sequence=Sequence(steps, *bits))
    return Rung(len(changed.sequence), make(changed))


def _captured(rig: Rig) -> tuple[list[NDArray[np.uint8]], NDArray[np.float32]]:
    """Frames and depth of the ladder's view."""
    row = Studio(BuildSettings(rig, (OBJECT,))).photograph(solid_mesh(OBJECT), VIEW)
    return [row.frames[index] for index in range(len(rig.sequence))], row.depth_mm


def _render(rig: Rig) -> Work:
    return partial(Studio(BuildSettings(rig, (OBJECT,))).photograph, solid_mesh(OBJECT), VIEW)


def _decode(rig: Rig) -> Work:
    return partial(decode_stack, _captured(rig)[0], rig)


def _phase(rig: Rig) -> Work:
    """Phase and order of one direction, on the whole image at once."""
    frames, _ = _captured(rig)
    plan = plan_direction(rig, "vertical", rig.sequence.steps, Limits())
    return partial(decode_direction, np.stack([frames[index].reshape(-1) for index in plan.frames]), plan, Limits())


def _triangulate(rig: Rig) -> Work:
    rays = rig.camera.rays()
    depth_m = 1.8 + 0.1 * rays[0]
    u, v = rig.project(np.stack([rays[0] * depth_m, rays[1] * depth_m, depth_m], axis=-1))
    return partial(depth_from_both, rays, u, v, rig)


def _phase_route(rig: Rig) -> Work:
    frames, _ = _captured(rig)
    method = PhaseMethod(rig)
    return lambda: method.measure(frames).seconds


def _score(rig: Rig) -> Work:
    _, depth_mm = _captured(rig)
    return partial(score_sample, depth_mm + np.float32(1.5) * (depth_mm > 0), depth_mm)


def _network(size: int, batch: int) -> Work:
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
    mesh_of_all = single_mesh(first)
    meshes = tuple(replace(mesh_of_all, name=f"object_{number:02d}") for number in range(objects))
    settings = BuildSettings(
        rig.scaled(BUILT_SIZE), tuple(mesh.name for mesh in meshes), stored="single_shot", user_meshes=meshes
    )
    count = iter(range(1_000_000))
    return Rung(objects, lambda: build(folder / f"dataset-{next(count)}", settings, workers=1))


def written_dataset(
    folder: Path, objects: int, size: int, stored: str = "single_shot", views: int = 6
) -> DatasetFolder:
    """A dataset of grey noise below ``folder``: ``objects`` of test with ``views`` rows each, ``size`` px square."""
    target, scratch = folder / "dataset", folder / "scratch"
    scratch.mkdir(parents=True)
    rng = np.random.Generator(np.random.PCG64(3))
    frames = {index: rng.integers(0, 255, (size, size), np.uint8) for index in stored_frames(PAPER_SEQUENCE, stored)}
    depth_mm = 1800 + rng.random((size, size), np.float32)
    depth_mm[:, : size // 2] = 0
    shards, samples = [], []
    names = [f"object_{number:04d}" for number in range(objects)]
    samples_by_object = {name: [(sample_name(name, view), name, view) for view in VIEWS[:views]] for name in names}
    for plan in plan_shards("test", samples_by_object):
        writer = ShardWriter(target, scratch, plan, PAPER_SEQUENCE, stored, True, (size, size))
        files, rows = writer.write(Row(*where, frames, depth_mm, depth_mm) for where in plan.samples)
        shards += files
        samples += rows
    Manifest(
        origin="generated", generator={}, settings={}, rig=paper_rig(max(size, 240)).to_dict(), size=(size, size),
        stored=stored, exact=True, samples={"test": samples}, shards=shards,
    ).write(target)  # fmt: skip
    return DatasetFolder(target)


def _read_rows(objects: int, folder: Path) -> Rung:
    path = written_dataset(folder, objects, ROW_SIZE).path

    def run() -> None:
        opened = DatasetFolder(path)
        for sample in opened.samples("test"):
            opened.frame(sample, 0).max()  # brings every byte into the processor

    return Rung(objects * len(VIEWS), run)


def _read_frames(frames: int, folder: Path) -> Rung:
    return Rung(frames, _reading(written_dataset(folder, 1, 480, "all", views=1), frames))


def _read_pixels(size: int, folder: Path) -> Rung:
    return Rung(size * size, _reading(written_dataset(folder, 1, size, "all", views=1), len(PAPER_SEQUENCE)))


def _reading(opened: DatasetFolder, frames: int) -> Work:
    """The first ``frames`` frames of the dataset's only row."""
    (sample,) = opened.samples("test")
    return lambda: [frame.max() for frame in opened.frames(sample, range(frames))]


def _evaluate(objects: int, folder: Path) -> Rung:
    opened = written_dataset(folder, objects, ROW_SIZE)
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
