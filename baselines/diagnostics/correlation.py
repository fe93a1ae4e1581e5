"""Pearson's correlation of two maps, and its mean over samples with an interval."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.evaluation.uncertainty import Interval, object_interval

EDGES, FRINGES, OWN = "edges", "fringes", "own"
_LEAST_SPREAD = 1e-12


def correlation(first: NDArray, second: NDArray) -> float | None:
    """Pearson's r of two maps of one shape over all pixels; None where one of them is the same everywhere."""
    a, b = first.astype(np.float64).ravel(), second.astype(np.float64).ravel()
    a, b = a - a.mean(), b - b.mean()
    sizes = float(np.sqrt((a @ a) * (b @ b)))
    scale = max(1.0, float(np.abs(first).max()) * float(np.abs(second).max())) * a.size
    return None if sizes <= _LEAST_SPREAD * min(1.0, scale) else float(np.clip(a @ b / sizes, -1, 1))


@dataclass(frozen=True)
class Mean:
    """Mean of the ``known`` samples' correlations and its 95% interval over objects; None where no sample has one."""

    r: float | None
    interval: Interval | None
    known: int

    def to_dict(self) -> dict[str, Any]:
        return {"r": self.r, "interval": self.interval, "samples": self.known}


@dataclass
class Correlations:
    """Correlations by network (``trained``, ``untrained 0``, ...), layer and reference; one value a sample."""

    layers: tuple[str, ...]
    objects: list[str]
    values: dict[tuple[str, str, str], list[float | None]] = field(default_factory=dict)
    between: list[float | None] = field(default_factory=list)

    def add(self, who: str, layer: str, reference: str, r: float | None) -> None:
        """The next sample's ``r`` of a network's layer with a reference, `OWN` being the trained network's heatmap."""
        self.values.setdefault((who, layer, reference), []).append(r)

    def add_references(self, r: float | None) -> None:
        """The next sample's correlation of edges and fringes with each other."""
        self.between.append(r)

    def mean(self, layer: str, reference: str, trained: bool = True) -> Mean:
        """Over samples; of random weights each sample counts with its mean over seeds."""
        rows = [
            found for (who, at, what), found in self.values.items()
            if at == layer and what == reference and (who == "trained") == trained
        ]  # fmt: skip
        return self._mean([_mean_of(column) for column in zip(*rows, strict=True)])

    @property
    def references(self) -> Mean:
        return self._mean(self.between)

    def average(self, reference: str, trained: bool = True) -> Mean:
        """Over samples of the mean over layers, as the paper's bottom row."""
        means = [self.mean(layer, reference, trained).r for layer in self.layers]
        known = [r for r in means if r is not None]
        each = [
            _mean_of(
                [
                    found[place]
                    for (who, _, what), found in self.values.items()
                    if what == reference and (who == "trained") == trained
                ]
            )
            for place in range(len(self.objects))
        ]
        return Mean(float(np.mean(known)) if known else None, self._mean(each).interval, len(known))

    def _mean(self, each: list[float | None]) -> Mean:
        known = [r for r in each if r is not None]
        return Mean(float(np.mean(known)) if known else None, object_interval(each, self.objects), len(known))

    def to_dict(self) -> dict[str, Any]:
        """For ``diagnose.json``."""

        def of(layer: str) -> dict[str, Any]:
            trained = {what: self.mean(layer, what).to_dict() for what in (EDGES, FRINGES)}
            random = {what: self.mean(layer, what, trained=False).to_dict() for what in (EDGES, FRINGES, OWN)}
            return {**trained, "ratio": ratio(self.mean(layer, EDGES).r, self.mean(layer, FRINGES).r), "random": random}

        edges, fringes = self.average(EDGES), self.average(FRINGES)
        return {
            "layers": {layer: of(layer) for layer in self.layers},
            "average": {EDGES: edges.to_dict(), FRINGES: fringes.to_dict(), "ratio": ratio(edges.r, fringes.r)},
            "random_average": {what: self.average(what, trained=False).to_dict() for what in (EDGES, FRINGES, OWN)},
            "edges_with_fringes": self.references.to_dict(),
        }


def ratio(edges: float | None, fringes: float | None) -> float | None:
    """The paper's: correlation with edges over that with fringes; None where that is not a number."""
    return None if edges is None or not fringes else edges / fringes


def _mean_of(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
