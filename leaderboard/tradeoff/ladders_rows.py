"""The ladders over rows and objects, which would show a nested loop: building, reading, scoring, the page."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import VIEWS, sample_name
from fpp_ml_bench.evaluation.score import evaluate
from fpp_ml_bench.leaderboard.page import page_files
from fpp_ml_bench.leaderboard.ranking import rank, shipped_rows
from fpp_ml_bench.leaderboard.rows import Entry, read_entry
from fpp_ml_bench.leaderboard.tradeoff.ladder import Ladder, Rung
from fpp_ml_bench.loaders.render import BuildSettings, build, single_mesh, solid_mesh, write_ply
from fpp_ml_bench.loaders.sample import Row, stored_frames
from fpp_ml_bench.loaders.storage import DatasetFolder, Manifest, ShardWriter, plan_shards
from fpp_ml_bench.optics import PAPER_SEQUENCE, Rig

BUILT_OBJECTS, QUICK_OBJECTS = (1, 2, 4, 8), (1, 2, 3)
BUILT_SIZE = 240
ROW_OBJECTS, QUICK_ROW_OBJECTS = (8, 32, 128, 512), (4, 8, 16)
"""Objects of six rows each: 48 to 3,072 rows, ten times the benchmark's 300."""
SCORED_OBJECTS = (8, 32, 128), QUICK_OBJECTS
BOARD_ROWS, QUICK_BOARD = (8, 16, 32, 64, 128), (4, 8, 16)
READ_FRAMES, READ_SIZES = (4, 13, 26, 52), (240, 360, 480, 720, 960)
ROW_SIZE = 32
BOARD_ROW = "classical-18-vertical.json"


def row_ladders(rig: Rig, quick: bool = False) -> Iterator[Ladder]:
    """Stages over objects and rows, and reading also over pixels and frames."""
    yield Ladder("build a dataset", "objects", QUICK_OBJECTS if quick else BUILT_OBJECTS, partial(_build, rig))
    yield Ladder("open and read a frame of each row", "rows", QUICK_ROW_OBJECTS if quick else ROW_OBJECTS, _read_rows)
    yield Ladder("read a row", "frames", READ_FRAMES[:3] if quick else READ_FRAMES, _read_frames)
    yield Ladder("read a row", "pixels", (64, 128, 256) if quick else READ_SIZES, _read_pixels)
    yield Ladder("score a folder of predictions", "rows", SCORED_OBJECTS[quick], _evaluate)
    yield Ladder("rank and render the leaderboard", "rows", QUICK_BOARD if quick else BOARD_ROWS, _board)


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
    return Rung(objects, lambda: _ignore(build(folder / f"dataset-{next(count)}", settings, workers=1)))


def _ignore(result: object) -> None:
    """Drop a result: only the time matters."""


def written_dataset(folder: Path, objects: int, size: int, stored: str = "single_shot", views: int = 6) -> Path:
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
    writer = ShardWriter(target, scratch, PAPER_SEQUENCE, stored, True, (size, size))
    for plan in plan_shards("test", samples_by_object):
        files, rows = writer.write(plan, (Row(*where, frames, depth_mm, depth_mm) for where in plan.samples))
        shards += files
        samples += rows
    from fpp_ml_bench.optics import paper_rig

    Manifest(
        origin="generated", generator={}, settings={}, rig=paper_rig(max(size, 240)).to_dict(), size=(size, size),
        stored=stored, exact=True, samples={"test": samples}, shards=shards,
    ).write(target)  # fmt: skip
    return target


def _read_rows(objects: int, folder: Path) -> Rung:
    path = written_dataset(folder, objects, ROW_SIZE)

    def run() -> None:
        opened = DatasetFolder(path)
        for sample in opened.samples("test"):
            _touch(opened.frame(sample, 0))

    return Rung(objects * len(VIEWS), run)


def _touch(image: NDArray[np.uint8]) -> None:
    """Bring every byte into the processor."""
    image.max()


def _read_frames(frames: int, folder: Path) -> Rung:
    return _reading(written_dataset(folder, 1, 480, "all", views=1), frames, frames)


def _read_pixels(size: int, folder: Path) -> Rung:
    return _reading(written_dataset(folder, 1, size, "all", views=1), len(PAPER_SEQUENCE), size * size)


def _reading(path: Path, frames: int, amount: int) -> Rung:
    """The first ``frames`` frames of the dataset's only row."""
    opened = DatasetFolder(path)
    (sample,) = opened.samples("test")

    def run() -> None:
        for frame in opened.frames(sample, range(frames)):
            _touch(frame)

    return Rung(amount, run)


def _evaluate(objects: int, folder: Path) -> Rung:
    opened = DatasetFolder(written_dataset(folder, objects, ROW_SIZE))
    predictions = folder / "predictions"
    predictions.mkdir()
    for sample in opened.samples("test"):
        np.save(predictions / f"{sample}.npy", opened.depth_mm(sample) + np.float32(1))
    (predictions / "submission.yaml").write_text(
        "name: A method\nmethod: test\nunits: mm\nframes_used: [0]\nuses_ground_truth_range: false\n"
        "seconds_per_sample: null\nseconds_source: self-reported\nhardware: null\nsoftware: {}\nsettings: {}\n",
        encoding="utf-8",
    )
    return Rung(objects * len(VIEWS), lambda: _ignore(evaluate(predictions, opened)))


def _board(rows: int, folder: Path) -> Rung:
    shipped = next(path for path in shipped_rows() if path.name == BOARD_ROW)
    first = read_entry(shipped)
    entries = [_renamed_entry(first, number) for number in range(rows)]
    return Rung(rows, lambda: _ignore(page_files(rank(entries), [])))


def _renamed_entry(entry: Entry, number: int) -> Entry:
    """The row under another name, with its own error and time, so that marks and names do not coincide."""
    result = entry.result
    about = result.submission.model_copy(update={"name": f"Method {number}"})
    factor = 1.03**number
    metrics = result.metrics.model_copy(update={"object_mae_mm": factor})
    timing = result.timing
    if timing is not None:
        keys = ("latency_median_ms", "latency_p5_ms", "latency_p95_ms")
        changed = {key: getattr(timing, key) * factor for key in keys}
        about = about.model_copy(update={"timing": timing.model_copy(update=changed)})
    return replace(entry, result=result.model_copy(update={"submission": about, "metrics": metrics}))
