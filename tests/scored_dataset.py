"""A tiny real dataset folder with known depth, and predictions for it: what the evaluator's tests
score."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from fpp_ml_bench.evaluation.protocol import MODES, TARGETS
from fpp_ml_bench.loaders.sample import Flag, Row
from fpp_ml_bench.loaders.storage import benchmark
from fpp_ml_bench.loaders.storage.assembly import Assembly
from fpp_ml_bench.loaders.storage.benchmark import Benchmark
from fpp_ml_bench.loaders.storage.manifest import Manifest
from fpp_ml_bench.loaders.storage.shards import ShardWriter, plan_shards
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.named_rigs import paper_rig

OBJECTS = {"train": ("bowl",), "validation": ("mug",), "test": ("power_drill", "wooden_boards")}
VIEWS = ("A0", "A60")
HARDWARE = {"cpu": "Some CPU", "cores": 2, "memory_gib": 8.0, "gpu": None, "platform": "Linux"}
DESCRIPTION: dict[str, Any] = {
    "name": "A method",
    "method": "test",
    "units": "mm",
    "frames_used": [0],
    "uses_ground_truth_range": False,
    "seconds_per_sample": 0.25,
    "seconds_source": "measured",
    "hardware": {**HARDWARE},  # YAML that names one object twice has an alias
    "software": {"numpy": "2.0.0"},
    "settings": {"steps": 18},
}


def disk_depth(size: tuple[int, int], seed: int) -> NDArray[np.float32]:
    """A tilted disk at 1.8 m with a step in it on an empty background, float32 (H, W) in mm; a
    place per seed."""
    height, width = size
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:height, :width]
    row, column = rng.uniform(0.4, 0.6, 2) * size
    inside = (rows - row) ** 2 + (columns - column) ** 2 < (rng.uniform(0.15, 0.3) * min(size)) ** 2
    depth = 1800.0 + 0.2 * (columns - column) + 200.0 * (rows > row)
    return np.where(inside, depth, 0.0).astype(np.float32)


def noise_scene(size: tuple[int, int]) -> "Scene":
    """Frames of noise, each of a disk of its own."""

    def scene(seed: int) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        return np.random.default_rng(seed).integers(1, 256, size, np.uint8), disk_depth(size, seed)

    return scene


Scene = Callable[[int], tuple[NDArray[np.uint8], NDArray[np.float32]]]


def make_dataset(
    folder: Path,
    size: tuple[int, int] = (32, 40),
    exact: bool = True,
    views: Sequence[str] = VIEWS,
    scene: Scene | None = None,
    flagged: Callable[[NDArray[np.float32]], NDArray[np.uint8]] | None = None,
) -> DatasetFolder:
    """Write a `single_shot` dataset, by default of eight samples; ``depth_exact`` is 0.5 mm more
    than ``depth``.

    ``scene`` gives frame and depth of a number that no other sample has; by default a flat frame
    and a `disk_depth`. ``flagged`` gives the flags of a depth, by default none. Unlit pixels lose
    their ``depth``, not their exact one.
    """
    manifest = Manifest("generated", {}, {}, paper_rig(960).to_dict(), size, "single_shot", exact)
    writer = ShardWriter(manifest)
    plans, receipts = [], []
    for number, (split, names) in enumerate(OBJECTS.items()):
        objects = {name: [(f"{name}_{view}", name, view) for view in views] for name in names}
        for plan in plan_shards(split, objects):
            rows = []
            for index, (sample, name, view) in enumerate(plan.samples):
                seed = 10 * len(views) * number + index
                if scene is None:
                    frame, depth = (
                        np.full(size, index, dtype=np.uint8),
                        disk_depth(size, 10 * number + index),
                    )
                else:
                    frame, depth = scene(seed)
                exact_mm = depth + np.float32(0.5) * (depth > 0)
                flags = np.zeros(depth.shape, np.uint8) if flagged is None else flagged(depth)
                depth = np.where(flags & np.uint8(Flag.UNLIT), np.float32(0), depth)
                rows.append(
                    Row(
                        sample,
                        name,
                        view,
                        {0: frame},
                        depth,
                        exact_mm if exact else None,
                        {},
                        flags,
                        np.full(depth.shape, 255, np.uint8),
                    )
                )
            plans.append(plan)
            receipts.append(writer.write(folder, plan, rows))
    Assembly(plans, lambda plan, folder: (), manifest).filled(receipts).write(folder)
    return DatasetFolder(folder)


def name_benchmarks(
    monkeypatch: Any, folder: Path, *named: tuple[Benchmark, DatasetFolder]
) -> None:
    """Let the package know these benchmarks, and no others, by the facts of datasets."""
    folder.mkdir(exist_ok=True)
    for known, dataset in named:
        counts = {
            split: {
                f"{mode}/{target}": pixel_counts(dataset, split, mode, target)
                for mode in MODES
                for target in TARGETS[: 1 + dataset.has_exact]
            }
            for split in dataset.splits
        }
        facts = {"content": dataset.content, "counts": counts}
        (folder / f"{known.name}.json").write_text(json.dumps(facts), encoding="utf-8")
    monkeypatch.setattr(benchmark, "FACTS", folder)
    monkeypatch.setattr(benchmark, "BENCHMARKS", tuple(known for known, _ in named))


def pixel_counts(
    dataset: DatasetFolder, split: str, mode: str, target: str
) -> dict[str, list[int]]:
    """Samples, object pixels and void pixels of each object of a split."""
    counts: dict[str, list[int]] = {}
    for sample in dataset.samples(split):
        inside = dataset.depth_mm(sample, target) > 0
        void = dataset.void(sample, target) & (mode == "standard")
        numbers = counts.setdefault(dataset.measured(sample)["object"], [0, 0, 0])
        for place, number in enumerate((1, int((inside & ~void).sum()), int(void.sum()))):
            numbers[place] += number
    return counts


def write_description(folder: Path, **changes: Any) -> None:
    """``submission.yaml`` with `DESCRIPTION` and ``changes``; a key set to ``...`` is left out."""
    content = {key: value for key, value in {**DESCRIPTION, **changes}.items() if value is not ...}
    (folder / "submission.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")


def write_predictions(
    folder: Path,
    dataset: DatasetFolder,
    split: str = "test",
    offset_mm: float = 0.0,
    noise_mm: float = 0.0,
    **changes: Any,
) -> Path:
    """Predictions for a split: the target, an offset everywhere, and noise that leaves no depth
    negative."""
    folder.mkdir(parents=True, exist_ok=True)
    for index, sample in enumerate(dataset.samples(split)):
        depth = dataset.depth_mm(sample)
        noise = (
            np.abs(np.random.default_rng(index).normal(0.0, noise_mm, depth.shape))
            if noise_mm
            else 0.0
        )
        np.save(folder / f"{sample}.npy", (depth + offset_mm + noise).astype(np.float32))
    write_description(folder, **changes)
    return folder


def change_json(path: Path, key: str, value: Any) -> None:
    """Set a value deep inside of a JSON file, at a key like ``per_sample.0.object``; ``...``
    removes it."""
    document = json.loads(path.read_text())
    *parents, last = (int(part) if part.isdecimal() else part for part in key.split("."))
    place = document
    for parent in parents:
        place = place[parent]
    if value is ...:
        del place[last]
    else:
        place[last] = value
    path.write_text(json.dumps(document))
