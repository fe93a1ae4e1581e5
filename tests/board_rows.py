"""Rows for the leaderboard's tests: results of real scoring with errors, times and names that the test chooses."""

from pathlib import Path
from typing import Any

from scored_dataset import write_predictions

from fpp_ml_bench.evaluation.result import write_result
from fpp_ml_bench.evaluation.score import evaluate

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
    """Four results in two tracks: fast and rough, slow and fine, beaten by both, and one of the oracle track."""
    folder.mkdir(parents=True, exist_ok=True)
    return [
        write_result_file(folder / "fast.json", dataset, 4.0, 1.0, name="Fast and rough", timing=timing(2.0)),
        write_result_file(
            folder / "fine.json", dataset, 0.5, 0.1, name="Slow and fine", frames_used=list(range(10)),
            timing=timing(50.0, 10),
        ),
        write_result_file(
            folder / "beaten.json", dataset, 8.0, 2.0, name="Beaten", frames_used=[0, 1], seconds_per_sample=0.08,
            seconds_source="self-reported",
        ),
        write_result_file(
            folder / "oracle.json", dataset, 0.1, 0.1, name="Was told", uses_ground_truth_range=True,
            timing=timing(10.0),
        ),
    ]  # fmt: skip
