"""Probing measured: what can be read from every layer of a network, and from the controls beside it."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from fpp_ml_bench.baselines.diagnostics import convolution_probe as convolution
from fpp_ml_bench.baselines.diagnostics.activations import INPUT, at_pixels, at_size, batches, run, tapped
from fpp_ml_bench.baselines.diagnostics.ridge import NormalEquations, apply
from fpp_ml_bench.baselines.diagnostics.subject import Subject
from fpp_ml_bench.baselines.diagnostics.targets import Truth, edge_map, truth
from fpp_ml_bench.normalisation import normalise

if TYPE_CHECKING:
    from fpp_ml_bench.loaders.store import DatasetFolder

POSITION = "position"
"""The pixel's place as six features of its own (1, x, y, x^2, x y, y^2): what is known without any image."""
PIXELS = 1024
"""Pixels drawn of each sample, over the image and once more within the object, with replacement."""
TARGETS: dict[str, tuple[str, ...]] = {
    "edges": ("edges",), "depth": ("depth",), "distance": ("depth_mm",), "phase": ("sine", "cosine"),
    "order": ("order",),
}  # fmt: skip
"""What the linear probe is asked for, by the names in `Truth`; two of the phase, which is an angle."""
INSIDE = ("distance", "phase", "order")
"""Targets that are asked for on object pixels only."""
FRINGE = ("phase", "order")
"""Targets that there are only under fringes of one direction."""
SPATIAL = ("edges", "depth")
"""What the four-convolution probes are asked for, as in the paper."""

Errors = dict[tuple[str, str], list[float]]
"""Squared error of each sample, by layer and target."""
Tick = Callable[[int, str], None]


@dataclass
class _Drawn:
    """Pixels of one sample (P,) and what is true there (P, T), over the image (False) and within the object (True)."""

    pixels: dict[bool, Tensor]
    known: dict[bool, Tensor]


class Pixels:
    """Pixels drawn from each sample, the same whatever network is asked; small, so they are kept.

    ``columns``: of each target asked for, the set it belongs to and its columns in ``known`` of that set.
    """

    def __init__(self, subject: Subject, dataset: "DatasetFolder", targets: Sequence[str]) -> None:
        self.subject, self.dataset, self.targets = subject, dataset, tuple(targets)
        self.fields: dict[bool, list[str]] = {False: [], True: []}
        self.columns: dict[str, tuple[bool, slice]] = {}
        for target in targets:
            fields = self.fields[target in INSIDE]
            self.columns[target] = target in INSIDE, slice(len(fields), len(fields) + len(TARGETS[target]))
            fields += TARGETS[target]
        self._kept: dict[str, _Drawn] = {}

    def of(self, sample: str) -> _Drawn:
        if sample not in self._kept:
            self._kept[sample] = self._draw(sample)
        return self._kept[sample]

    def _draw(self, sample: str) -> _Drawn:
        split = self.dataset.split_of_sample(sample)
        rng = np.random.default_rng([list(self.dataset.splits).index(split), self.dataset.samples(split).index(sample)])
        direction = self.subject.direction
        there = truth(
            self.dataset.depth_mm(sample), self.dataset.rig, "horizontal" if direction == "both" else direction
        )
        inside = np.flatnonzero(there.inside)
        drawn = {
            False: rng.integers(there.inside.size, size=PIXELS),
            True: inside[rng.integers(inside.size, size=PIXELS)],
        }
        return _Drawn(
            {key: torch.from_numpy(pixels) for key, pixels in drawn.items()},
            {key: _values(there, fields, drawn[key]) for key, fields in self.fields.items()},
        )


def _values(there: Truth, fields: Sequence[str], pixels: NDArray[np.int64]) -> Tensor:
    found = [getattr(there, name).ravel()[pixels] for name in fields]
    return torch.from_numpy(np.stack(found, axis=1) if found else np.empty((len(pixels), 0), np.float32))


def linear_errors(
    subject: Subject, network: nn.Module, pixels: Pixels, train: Sequence[str], validation: Sequence[str],
    controls: bool, tick: Tick,
) -> tuple[Errors, dict[str, list[float]]]:  # fmt: skip
    """Errors of the 1 x 1 probes of ``network``'s layers on ``validation``, fitted on ``train``; and the errors of
    predicting the mean, by target. With ``controls`` the raw input and the position are layers besides."""
    layers, size = subject.layers_of(network), subject.image_size
    sets = [key for key, fields in pixels.fields.items() if fields]

    def stream(samples: Sequence[str], doing: str) -> Iterator[tuple[str, bool, Tensor, Tensor]]:
        """Layer, set, features (B, P, C) and what is known there (B, P, T)."""
        now: dict[bool, Tensor] = {}

        def take(features: Tensor) -> Tensor:
            return torch.stack([at_pixels(features, now[key], size) for key in sets])

        with tapped(layers, take) as caught:
            for names, fringe in batches(subject, pixels.dataset, samples):
                drawn = [pixels.of(name) for name in names]
                now.update({key: torch.stack([one.pixels[key] for one in drawn]) for key in sets})
                run(network, fringe, list(layers), caught, subject.name)
                if controls:
                    caught[INPUT] = take(fringe)
                    caught[POSITION] = torch.stack([_position(now[key], size) for key in sets])
                for layer, found in caught.items():
                    for place, key in enumerate(sets):
                        yield layer, key, found[place], torch.stack([one.known[key] for one in drawn])
                tick(len(names), doing)

    equations: dict[tuple[str, bool], NormalEquations] = {}
    for layer, key, features, known in stream(train, "linear probes learn"):
        place = layer, key
        if place not in equations:
            equations[place] = NormalEquations(features.shape[2], known.shape[2])
        equations[place].add(features.flatten(0, 1), known.flatten(0, 1))
    weights = {place: found.solve() for place, found in equations.items()}
    errors: Errors = {}
    for layer, key, features, known in stream(validation, "linear probes are judged"):
        for one, there in zip(features, known, strict=True):
            _note(errors, pixels, layer, key, apply(weights[layer, key], one) - there.double())
    means = {key: equations[next(place for place in equations if place[1] == key)].target_mean for key in sets}
    reference: Errors = {}
    for name in validation:
        for key in sets:
            _note(reference, pixels, "", key, pixels.of(name).known[key].double() - means[key])
    return errors, {target: found for (_, target), found in reference.items()}


def _note(errors: Errors, pixels: Pixels, layer: str, inside: bool, miss: Tensor) -> None:
    """Append the mean square of one sample's ``miss`` (P, T) for every target of its set."""
    for target, (there, columns) in pixels.columns.items():
        if there == inside:
            errors.setdefault((layer, target), []).append(float(miss[:, columns].square().mean()))


def _position(pixels: Tensor, size: tuple[int, int]) -> Tensor:
    rows, columns = pixels // size[1], pixels % size[1]
    y, x = (2 * rows + 1) / size[0] - 1, (2 * columns + 1) / size[1] - 1
    return torch.stack([x, y, x * x, x * y, y * y], dim=-1)


def spatial_errors(
    subject: Subject, networks: Mapping[str, nn.Module], dataset: "DatasetFolder", train: Sequence[str],
    validation: Sequence[str], seeds: Mapping[str, int], epochs: int, tick: Tick,
) -> tuple[dict[tuple[str, str, str, int], list[float]], dict[str, list[float]]]:  # fmt: skip
    """Errors of the four-convolution probes of each of ``networks``, by network, layer, target and seed, and of the
    mean; the raw input is network and layer `INPUT`. Trained on ``train`` side by side for ``epochs``, as often as
    ``seeds`` says of each network."""
    step = convolution.grid_step(subject.image_size)
    side = max(1, subject.image_size[0] // step), max(1, subject.image_size[1] // step)

    def stream(samples: Sequence[str], doing: str, use: Callable[[dict[str, Tensor], dict[str, Tensor]], None]) -> None:
        for names, fringe in batches(subject, dataset, samples, convolution.BATCH):
            seen = {f"{INPUT}/{INPUT}": at_size(fringe, side)}
            for who, network in networks.items():
                layers = subject.layers_of(network)
                with tapped(layers, lambda features: at_size(features, side)) as caught:
                    run(network, fringe, list(layers), caught, subject.name)
                    seen |= {f"{who}/{layer}": caught[layer] for layer in layers}
            use(seen, _spatial_targets(dataset, names, side))
            tick(len(names), doing)

    moments: dict[str, convolution.Moments] = {}
    sums = {target: [0.0, 0] for target in SPATIAL}

    def measure(seen: dict[str, Tensor], known: dict[str, Tensor]) -> None:
        for source, features in seen.items():
            moments.setdefault(source, convolution.Moments()).add(features)
        for target, values in known.items():
            sums[target][0] += float(values.double().sum())
            sums[target][1] += values.numel()

    stream(train, "spread of the activations", measure)
    means = {target: total / count for target, (total, count) in sums.items()}
    steps = epochs * -(-len(train) // convolution.BATCH)
    each = {source: seeds[source.partition("/")[0]] for source in moments}
    probes = convolution.ProbeSet(moments, means, each, steps)
    for epoch in range(epochs):
        order = np.random.default_rng([1, epoch]).permutation(len(train))
        stream([train[place] for place in order], "four-convolution probes learn", probes.step)
    errors: dict[tuple[str, str, str, int], list[float]] = {}
    reference: dict[str, list[float]] = {target: [] for target in SPATIAL}

    def judge(seen: dict[str, Tensor], known: dict[str, Tensor]) -> None:
        for (source, target, seed), found in probes.errors(seen, known).items():
            who, _, layer = source.partition("/")
            errors.setdefault((who, layer, target, seed), []).extend(found)
        for target, values in known.items():
            reference[target] += (values.double() - means[target]).square().mean((1, 2, 3)).tolist()

    stream(validation, "four-convolution probes are judged", judge)
    return errors, reference


def _spatial_targets(dataset: "DatasetFolder", names: Sequence[str], side: tuple[int, int]) -> dict[str, Tensor]:
    edges, depths = [], []
    for name in names:
        depth_mm = dataset.depth_mm(name)
        known = depth_mm[depth_mm > 0]
        edges.append(edge_map(depth_mm))
        depths.append(normalise(depth_mm, "individual", float(known.min()), float(known.max())))
    whole = {"edges": np.stack(edges), "depth": np.stack(depths)}
    return {name: at_size(torch.from_numpy(images)[:, None], side) for name, images in whole.items()}
