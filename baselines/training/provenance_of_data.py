"""Which dataset a network was trained on, as its weights file says, and whether that matters where it is used."""

from typing import Protocol

from pydantic import ConfigDict
from pydantic.dataclasses import dataclass as checked_dataclass

from fpp_ml_bench.evaluation.schema import Count, Text
from fpp_ml_bench.loaders.storage import Manifest, benchmark_of, intended_benchmark


@checked_dataclass(frozen=True, config=ConfigDict(extra="forbid", strict=True))
class TrainingBenchmark:
    """``name`` and ``version`` of the benchmark (`loaders.storage.benchmark`) that a network was trained on."""

    name: Text
    version: Count

    @property
    def title(self) -> str:
        return f"{self.name} version {self.version}"


class TrainedConfig(Protocol):
    """What the configurations of both kinds of weights say of the training data; ``benchmark`` is None for a dataset
    that was no named benchmark, and in files older than this entry."""

    @property
    def dataset_fingerprint(self) -> str: ...

    @property
    def benchmark(self) -> TrainingBenchmark | None: ...


def training_benchmark(fingerprint: str) -> TrainingBenchmark | None:
    """The named benchmark with this fingerprint, for the weights file; None for any other dataset."""
    benchmark = benchmark_of(fingerprint)
    return None if benchmark is None else TrainingBenchmark(benchmark.name, benchmark.version)


def training_data_warning(config: TrainedConfig, manifest: Manifest) -> str | None:
    """A sentence where weights are used on another version of the benchmark that they were trained on, or where nothing
    is known about their training data; else None.

    Only a named benchmark, or a dataset built with its settings, has scores that others compare with theirs. On
    imported data or a dataset with settings of its own, and on another benchmark, nothing is said: the user chose it.
    """
    fingerprint = manifest.fingerprint
    used_on = benchmark_of(fingerprint) or intended_benchmark(manifest)
    if used_on is None or config.dataset_fingerprint == fingerprint:
        return None
    trained_on = training_benchmark(config.dataset_fingerprint) or config.benchmark
    if trained_on is not None and trained_on.name != used_on.name:
        return None
    training_data = (
        f"dataset {config.dataset_fingerprint[:8]}, which is no benchmark of this version"
        if trained_on is None
        else trained_on.title
    )
    dataset = (
        used_on.title
        if used_on.fingerprint == fingerprint
        else f"dataset {fingerprint[:8]}, which has the settings of {used_on.title} but other bytes"
    )
    return f"trained on {training_data}; predicting on {dataset}"
