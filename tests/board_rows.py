"""Rows for the leaderboard's tests: results of real scoring with errors, times and names that the
test chooses."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from scored_dataset import HARDWARE, write_predictions

from fpp_ml_bench.evaluation.metrics import RANKED
from fpp_ml_bench.evaluation.protocol import FRAMES_CLASSES, WITHIN_MM
from fpp_ml_bench.evaluation.result.file import write_result
from fpp_ml_bench.evaluation.result.parts import (
    RELIANCE_VERSION,
    Intervals,
    Metrics,
    Reliance,
    RelianceParts,
)
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.evaluation.score.sample_scores import ErrorStats, combine
from fpp_ml_bench.leaderboard import ranking
from fpp_ml_bench.leaderboard.row_file import (
    ObjectMeans,
    Row,
    RowRobustness,
    interval_over,
    mean_over,
)
from fpp_ml_bench.leaderboard.rows import Entry
from fpp_ml_bench.loaders.storage import benchmark
from fpp_ml_bench.loaders.storage.benchmark import Benchmark


def timing(ms: float, frames: int = 1, **changes: Any) -> dict[str, Any]:
    """A ``timing`` block with a median of ``ms``, 10% either way to its percentiles."""
    return {
        "provenance": "measured",
        "latency_median_ms": ms,
        "latency_p5_ms": 0.9 * ms,
        "latency_p95_ms": 1.1 * ms,
        "repeats": 20,
        "batch": 4,
        "batched": True,
        "throughput_per_s": 2000 / ms,
        "peak_memory_mib": 300.0,
        "working_memory_mib": 6.0,
        "gpu_memory_mib": None,
        "parameters": 0,
        "frames": frames,
        "image_size": [32, 40],
        "device": "cpu",
        "hardware": HARDWARE,
        **changes,
    }


def write_result_file(
    path: Path, dataset: Any, offset_mm: float, noise_mm: float = 0.0, **changes: Any
) -> Path:
    """Write the result of predictions off by ``offset_mm`` and noise, of the test split against
    decoded depth; ``changes`` are another ``split`` or ``target``, or go into submission.yaml."""
    folder = path.parent / f"{path.stem}-predictions"
    split, target = changes.pop("split", "test"), changes.pop("target", "depth")
    write_predictions(folder, dataset, split, offset_mm, noise_mm, **changes)
    write_result(evaluate(folder, dataset, split, target), path)
    return path


def some_rows(folder: Path, dataset: Any) -> list[Path]:
    """Four results of one class in two tracks: fast and rough, slow and fine, beaten by both, and
    one that was told."""
    folder.mkdir(parents=True, exist_ok=True)
    return [
        write_result_file(
            folder / "fast.json",
            dataset,
            4.0,
            1.0,
            name="Fast and rough",
            frames_used=[0, 1],
            timing=timing(2.0, 2),
        ),
        write_result_file(
            folder / "fine.json",
            dataset,
            0.5,
            0.1,
            name="Slow and fine",
            frames_used=list(range(10)),
            timing=timing(50.0, 10),
        ),
        write_result_file(
            folder / "beaten.json",
            dataset,
            8.0,
            2.0,
            name="Beaten",
            frames_used=[0, 1, 2],
            seconds_per_sample=0.08,
            seconds_source="self-reported",
        ),
        write_result_file(
            folder / "oracle.json",
            dataset,
            0.1,
            0.1,
            name="Was told",
            frames_used=[0, 1],
            uses_ground_truth_range=True,
            timing=timing(10.0, 2),
        ),
    ]


def entry_with_errors(
    base: Entry,
    errors: Mapping[str, float],
    name: str,
    content: Mapping[str, str] | None = None,
    provenance: str | None = None,
    **about: Any,
) -> Entry:
    """A sound entry made of ``base``, scored on two views of each object of ``errors``, off by so
    many mm everywhere on the object and by nothing behind it. ``about`` goes into its
    description."""
    first = base.row.per_object[0]
    inside, outside = (
        getattr(first, f"{kind}_pixels") // first.samples for kind in ("object", "background")
    )
    per_object = []
    for name_of_object, error in errors.items():
        whole = combine(ErrorStats(inside, error, error), ErrorStats(outside, 0.0, 0.0))
        per_object.append(
            ObjectMeans(
                object=name_of_object,
                samples=2,
                object_pixels=2 * inside,
                background_pixels=2 * outside,
                void_pixels=0,
                object_mae_mm=error,
                object_rmse_mm=error,
                background_mae_mm=0.0,
                background_rmse_mm=0.0,
                overall_mae_mm=whole.mae_mm,
                overall_rmse_mm=whole.rmse_mm,
                two_sided_mae_mm=error,
            )
        )
    intervals = {key: list(interval_over(per_object, key) or (None, None)) for key in RANKED}
    data = {"samples": 2 * len(errors), "benchmark": None} | (
        {"content": dict(content)} if content else {}
    )
    frames = len(about.get("frames_used", base.row.submission.frames_used))
    changes = {
        "submission": base.row.submission.model_copy(update={"name": name, **about}),
        "dataset": base.row.dataset.model_copy(update=data),
        "frames_class": FRAMES_CLASSES[(frames > 1) + (frames > 36)],
        "metrics": base.row.metrics.model_copy(update=flat_scores(per_object)),
        "intervals": Intervals(**intervals),
        "per_object": per_object,
        "predictions_sha256": sha256(f"{name} {errors}".encode()).hexdigest(),
    }
    row = Row.model_validate(base.row.model_copy(update=changes).model_dump())
    return Entry(base.path.with_name(f"{name}.json"), row, provenance or base.provenance)


def changed(entry: Entry, **changes: Any) -> Entry:
    """``entry`` with other values in its row; a dict changes keys of a block."""
    values = {
        key: getattr(entry.row, key).model_copy(update=value) if isinstance(value, dict) else value
        for key, value in changes.items()
    }
    return replace(entry, row=entry.row.model_copy(update=values))


def flat_scores(per_object: Sequence[ObjectMeans], pixels: int = 0) -> dict[str, float | None]:
    """Scores of errors that are the same all over each object, of 100 mm depth; ``pixels`` of an
    image, 0 where no pixel is void."""
    keys = [
        key for key in Metrics.model_fields if key.startswith("object_") and key.endswith("_mm")
    ]
    means = {key: mean_over(per_object, key) for key in RANKED}
    mae, samples = means["object_mae_mm"] or 0.0, sum(part.samples for part in per_object)
    within = {
        f"object_within_{limit}mm_share": sum(
            p.samples for p in per_object if (p.object_mae_mm or 0.0) <= limit
        )
        / samples
        for limit in WITHIN_MM
    }
    void = sum(part.void_pixels for part in per_object) / (samples * pixels) if pixels else 0.0
    means |= {"two_sided_with_void_mae_mm": mae, "invented_share": 0.0}
    return (
        dict.fromkeys(keys, mae)
        | means
        | within
        | {"void_share": void, "object_mae_range_share": mae / 100}
    )


def reliance(**changes: Any) -> Reliance:
    """A phase reliance of 0.625."""
    parts = dict.fromkeys(RelianceParts.model_fields) | {
        "follows_phase": 0.75,
        "change_outline": 2.5,
    }
    content = {
        "version": RELIANCE_VERSION,
        "score": 0.625,
        "interval": [0.5, 0.75],
        "order_free_score": 0.875,
        "parts": parts,
        "units": "mm",
        "direction": "horizontal",
        "samples": 4,
        "objects": 2,
        "dataset_fingerprint": "b" * 64,
        "protocol_version": "1.1.0",
        "weights_sha256": None,
        **changes,
    }
    return Reliance(**content)


def robustness() -> RowRobustness:
    """A robustness in brief, of 31 mm."""
    return RowRobustness(
        version=4,
        mae_mm=31.0,
        interval=[20.0, 40.0],
        clean_mae_mm=5.0,
        axes={"motion": 30.0, "gloss": 32.0},
        beside={"dark-paint": 40.0},
        drawn=["gloss"],
        samples=4,
        objects=2,
        size_px=960,
    )


def named_benchmarks(
    monkeypatch: Any, counts: Mapping[str, Any] | None = None, **contents: Mapping[str, str]
) -> None:
    """Have ``full``, ``unseen`` and so on be the benchmarks of these contents, the first with
    ``counts`` of its objects in the test split against depth; of the others nothing else is
    known."""
    named = []
    for name, content in contents.items():
        named.append(Benchmark(f"fpp-bench-{name}", 2, name, 960))
        named[-1].__dict__.update(_facts={"content": content, "counts": {}}, image_size=[32, 40])
    if counts is not None:
        named[0].__dict__["_facts"]["counts"] = {"test": {"standard/depth": counts}}
    for module in (benchmark, ranking):
        monkeypatch.setattr(module, "BENCHMARKS", tuple(named))
