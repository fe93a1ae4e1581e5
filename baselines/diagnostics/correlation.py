"""Pearson's correlation of two maps, and its mean over samples with an interval."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.evaluation.score import Interval, object_interval

EDGES, FRINGES, OWN = "edges", "fringes", "own"
_LEAST_SPREAD = 1e-12


def correlation(first: NDArray, second: NDArray) -> float | None:
    """Pearson's r of two maps of the same shape over all pixels; None where either is constant."""
    a, b = first.astype(np.float64).ravel(), second.astype(np.float64).ravel()
    a, b = a - a.mean(), b - b.mean()
    sizes = float(np.sqrt((a @ a) * (b @ b)))
    scale = max(1.0, float(np.abs(first).max()) * float(np.abs(second).max())) * a.size
    return None if sizes <= _LEAST_SPREAD * min(1.0, scale) else float(np.clip(a @ b / sizes, -1, 1))


@dataclass(frozen=True)
class Mean:
    """Mean of ``count`` correlations and its 95% interval, resampled over objects; None without a correlation."""

    r: float | None
    interval: Interval | None
    count: int

    def to_dict(self) -> dict[str, Any]:
        return {"r": self.r, "interval": self.interval, "samples": self.count}


@dataclass
class Correlations:
    """Correlations by weights (``trained``, ``untrained 0``, ...), layer and reference map; one value per sample."""

    layers: tuple[str, ...]
    objects: list[str]
    values: dict[tuple[str, str, str], list[float | None]] = field(default_factory=dict)
    edges_with_fringes: list[float | None] = field(default_factory=list)

    def add(self, weights: str, layer: str, reference: str, r: float | None) -> None:
        """Append the next sample's ``r`` of a layer with a reference; `OWN` is the trained network's heatmap."""
        self.values.setdefault((weights, layer, reference), []).append(r)

    def add_references(self, r: float | None) -> None:
        """Append the next sample's correlation between edges and fringes."""
        self.edges_with_fringes.append(r)

    def mean(self, layer: str, reference: str, trained: bool = True) -> Mean:
        """Mean over samples; with random weights, of each sample's mean over seeds."""
        columns = [
            values for (weights, layer_name, target), values in self.values.items()
            if layer_name == layer and target == reference and (weights == "trained") == trained
        ]  # fmt: skip
        return self._mean([_mean_of(seed_values) for seed_values in zip(*columns, strict=True)])

    @property
    def references(self) -> Mean:
        return self._mean(self.edges_with_fringes)

    def average(self, reference: str, trained: bool = True) -> Mean:
        """Mean over layers, as in the paper's bottom row, with an interval over samples."""
        means = [self.mean(layer, reference, trained).r for layer in self.layers]
        defined = [r for r in means if r is not None]
        sample_means = [
            _mean_of(
                [
                    values[sample]
                    for (weights, _, target), values in self.values.items()
                    if target == reference and (weights == "trained") == trained
                ]
            )
            for sample in range(len(self.objects))
        ]
        return Mean(float(np.mean(defined)) if defined else None, self._mean(sample_means).interval, len(defined))

    def _mean(self, sample_values: list[float | None]) -> Mean:
        defined = [r for r in sample_values if r is not None]
        return Mean(
            float(np.mean(defined)) if defined else None, object_interval(sample_values, self.objects), len(defined)
        )

    def to_dict(self) -> dict[str, Any]:
        """For ``diagnose.json``."""

        def of(layer: str) -> dict[str, Any]:
            trained = {target: self.mean(layer, target).to_dict() for target in (EDGES, FRINGES)}
            random = {target: self.mean(layer, target, trained=False).to_dict() for target in (EDGES, FRINGES, OWN)}
            return {**trained, "ratio": ratio(self.mean(layer, EDGES).r, self.mean(layer, FRINGES).r), "random": random}

        edges, fringes = self.average(EDGES), self.average(FRINGES)
        return {
            "layers": {layer: of(layer) for layer in self.layers},
            "average": {EDGES: edges.to_dict(), FRINGES: fringes.to_dict(), "ratio": ratio(edges.r, fringes.r)},
            "random_average": {
                target: self.average(target, trained=False).to_dict() for target in (EDGES, FRINGES, OWN)
            },
            "edges_with_fringes": self.references.to_dict(),
        }


def ratio(edges: float | None, fringes: float | None) -> float | None:
    """The paper's ratio: correlation with edges over correlation with fringes; None where undefined."""
    return None if edges is None or not fringes else edges / fringes


def _mean_of(values: Sequence[float | None]) -> float | None:
    defined = [value for value in values if value is not None]
    return float(np.mean(defined)) if defined else None
