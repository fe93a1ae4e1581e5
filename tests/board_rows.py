"""Rows for the leaderboard's tests: results of real scoring with errors, times and names that the test chooses."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from scored_dataset import write_predictions

from fpp_ml_bench.evaluation.result import result_from_rows, write_result
from fpp_ml_bench.evaluation.score import ErrorStats, combine, evaluate
from fpp_ml_bench.leaderboard.rows import Entry

HARDWARE = {"cpu": "Some CPU", "cores": 2, "memory_gib": 8.0, "gpu": None, "platform": "Linux"}


def timing(ms: float, frames: int = 1, **changes: Any) -> dict[str, Any]:
    """A ``timing`` block with a median of ``ms``, 10% either way to its percentiles."""
    return {
        "provenance": "measured", "latency_median_ms": ms, "latency_p5_ms": 0.9 * ms, "latency_p95_ms": 1.1 * ms,
        "repeats": 20, "batch": 4, "batched": True, "throughput_per_s": 2000 / ms, "peak_memory_mib": 300.0,
        "working_memory_mib": 6.0, "gpu_memory_mib": None, "parameters": 0, "frames": frames, "image_size": [32, 40],
        "device": "cpu", "hardware": HARDWARE, **changes,
    }  # fmt: skip


def write_result_file(path: Path, dataset: Any, offset_mm: float, noise_mm: float = 0.0, **changes: Any) -> Path:
    """Write the result of predictions off by ``offset_mm`` and noise; ``changes`` go into submission.yaml."""
    folder = path.parent / f"{path.stem}-predictions"
    target = changes.pop("target", "depth")
    write_predictions(folder, dataset, offset_mm=offset_mm, noise_mm=noise_mm, **changes)
    write_result(evaluate(folder, dataset, target=target), path)
    return path


def some_rows(folder: Path, dataset: Any) -> list[Path]:
    """Four results of one class in two tracks: fast and rough, slow and fine, beaten by both, and one that was told."""
    folder.mkdir(parents=True, exist_ok=True)
    return [
        write_result_file(
            folder / "fast.json", dataset, 4.0, 1.0, name="Fast and rough", frames_used=[0, 1], timing=timing(2.0, 2)
        ),
        write_result_file(
            folder / "fine.json", dataset, 0.5, 0.1, name="Slow and fine", frames_used=list(range(10)),
            timing=timing(50.0, 10),
        ),
        write_result_file(
            folder / "beaten.json", dataset, 8.0, 2.0, name="Beaten", frames_used=[0, 1, 2], seconds_per_sample=0.08,
            seconds_source="self-reported",
        ),
        write_result_file(
            folder / "oracle.json", dataset, 0.1, 0.1, name="Was told", frames_used=[0, 1],
            uses_ground_truth_range=True, timing=timing(10.0, 2),
        ),
    ]  # fmt: skip


def entry_with_errors(
    base: Entry, errors: Mapping[str, float], name: str, fingerprint: str = "", **about: Any
) -> Entry:
    """A sound entry made of ``base``, scored on two views of each object of ``errors``, off by so many mm everywhere on
    the object and by nothing behind it. ``about`` goes into its description."""
    first, rows = base.result.per_sample[0].model_dump(), []
    inside, outside = first["object_pixels"], first["background_pixels"]
    for name_of_object, error in errors.items():
        whole = combine(ErrorStats(inside, error, error), ErrorStats(outside, 0.0, 0.0))
        row = {key: error if key.startswith("object_") and key.endswith("_mm") else first[key] for key in first}
        row |= {"object_shift_free_mae_mm": 0.0, "background_mae_mm": 0.0, "background_rmse_mm": 0.0}
        row |= {"overall_mae_mm": whole.mae_mm, "overall_rmse_mm": whole.rmse_mm, "object": name_of_object}
        rows += [{**row, "sample": f"{name_of_object}_{view}"} for view in ("A0", "A60")]
    data = {"samples": len(rows), "fingerprint": fingerprint or base.result.dataset.fingerprint, "benchmark": None}
    kept = ("protocol_version", "created", "target", "mode", "edge_band_px", "edge_jump_mm", "environment")
    result = result_from_rows(
        rows, submission=base.result.submission.model_copy(update={"name": name, **about}),
        dataset=base.result.dataset.model_copy(update=data), **{key: getattr(base.result, key) for key in kept},
    )  # fmt: skip
    return Entry(base.path.with_name(f"{name}.json"), result, base.provenance)
