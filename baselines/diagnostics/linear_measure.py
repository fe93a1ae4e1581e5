"""Fits linear and convolution probes to the layers of a network and to controls, and measures their errors."""

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
from fpp_ml_bench.baselines.diagnostics.subjects import Subject
from fpp_ml_bench.baselines.diagnostics.targets import Truth, edge_map, truth
from fpp_ml_bench.depth import normalise

if TYPE_CHECKING:
    from fpp_ml_bench.loaders.storage import DatasetFolder

POSITION = "position"
"""The pixel's position as six features (1, x, y, x^2, x y, y^2): a control that uses no image."""
PIXELS = 1024
"""Pixels drawn with replacement from each sample: so many over the image, and as many within the object."""
TARGETS: dict[str, tuple[str, ...]] = {
    "edges": ("edges",), "depth": ("depth",), "distance": ("depth_mm",), "phase": ("sine", "cosine"),
    "order": ("order",),
}  # fmt: skip
"""Targets of the linear probe, by the names in `Truth`; the phase is an angle and so has two."""
INSIDE = ("distance", "phase", "order")
"""Targets on object pixels only."""
FRINGE = ("phase", "order")
"""Targets that need fringes of a single direction."""
SPATIAL = ("edges", "depth")
"""Targets of the four-convolution probes, as in the paper."""

Errors = dict[tuple[str, str], list[float]]
"""Squared error of each sample, by layer and target."""
Tick = Callable[[int, str], None]
"""Called with the number of samples just processed and the activity."""


@dataclass
class _Drawn:
    """Pixels of a sample (P,) and their target values (P, T), over the image (False) and within the object (True)."""

    pixels: dict[bool, Tensor]
    targets: dict[bool, Tensor]


class Pixels:
    """Pixels drawn from each sample, the same for every network, and cached.

    ``columns``: for each target its set (over the image or within the object) and its columns in that set's
    ``targets``.
    """

    def __init__(self, subject: Subject, dataset: "DatasetFolder", targets: Sequence[str]) -> None:
        self.subject, self.dataset, self.targets = subject, dataset, tuple(targets)
        self.fields: dict[bool, list[str]] = {False: [], True: []}
        self.columns: dict[str, tuple[bool, slice]] = {}
        for target in targets:
            fields = self.fields[target in INSIDE]
            self.columns[target] = target in INSIDE, slice(len(fields), len(fields) + len(TARGETS[target]))
            fields += TARGETS[target]
        self._drawn: dict[str, _Drawn] = {}

    def of(self, sample: str) -> _Drawn:
        if sample not in self._drawn:
            self._drawn[sample] = self._draw(sample)
        return self._drawn[sample]

    def _draw(self, sample: str) -> _Drawn:
        split = self.dataset.split_of_sample(sample)
        rng = np.random.default_rng([list(self.dataset.splits).index(split), self.dataset.samples(split).index(sample)])
        direction = self.subject.direction
        ground_truth = truth(
            self.dataset.depth_mm(sample), self.dataset.rig, "horizontal" if direction == "both" else direction
        )
        inside = np.flatnonzero(ground_truth.inside)
        drawn = {
            False: rng.integers(ground_truth.inside.size, size=PIXELS),
            True: inside[rng.integers(inside.size, size=PIXELS)],
        }
        return _Drawn(
            {key: torch.from_numpy(pixels) for key, pixels in drawn.items()},
            {key: _values(ground_truth, fields, drawn[key]) for key, fields in self.fields.items()},
        )


def _values(ground_truth: Truth, fields: Sequence[str], pixels: NDArray[np.int64]) -> Tensor:
    columns = [getattr(ground_truth, name).ravel()[pixels] for name in fields]
    return torch.from_numpy(np.stack(columns, axis=1) if columns else np.empty((len(pixels), 0), np.float32))


def linear_errors(
    subject: Subject, network: nn.Module, pixels: Pixels, train: Sequence[str], validation: Sequence[str],
    controls: bool, tick: Tick,
) -> tuple[Errors, dict[str, list[float]]]:  # fmt: skip
    """Errors on ``validation`` of the 1 x 1 probes of ``network``'s layers, fitted on ``train``.

    The second value holds the errors of predicting the mean, by target. With ``controls`` the raw input and the
    position are probed like layers.
    """
    layers, size = subject.layers_of(network), subject.image_size
    sets = [key for key, fields in pixels.fields.items() if fields]

    def stream(samples: Sequence[str], activity: str) -> Iterator[tuple[str, bool, Tensor, Tensor]]:
        """Layer, set, features (B, P, C) and targets (B, P, T)."""
        drawn_pixels: dict[bool, Tensor] = {}

        def take(features: Tensor) -> Tensor:
            return torch.stack([at_pixels(features, drawn_pixels[key], size) for key in sets])

        with tapped(layers, take) as activations:
            for names, fringe in batches(subject, pixels.dataset, samples):
                batch_pixels = [pixels.of(name) for name in names]
                drawn_pixels.update(
                    {key: torch.stack([sample_pixels.pixels[key] for sample_pixels in batch_pixels]) for key in sets}
                )
                run(network, fringe, list(layers), activations, subject.name)
                if controls:
                    activations[INPUT] = take(fringe)
                    activations[POSITION] = torch.stack([_position(drawn_pixels[key], size) for key in sets])
                for layer, features in activations.items():
                    for set_number, key in enumerate(sets):
                        targets = torch.stack([sample_pixels.targets[key] for sample_pixels in batch_pixels])
                        yield layer, key, features[set_number], targets
                tick(len(names), activity)

    equations: dict[tuple[str, bool], NormalEquations] = {}
    for layer, key, features, targets in stream(train, "training linear probes"):
        probe = layer, key
        if probe not in equations:
            equations[probe] = NormalEquations(features.shape[2], targets.shape[2])
        equations[probe].add(features.flatten(0, 1), targets.flatten(0, 1))
    weights = {probe: normal_equations.solve() for probe, normal_equations in equations.items()}
    errors: Errors = {}
    for layer, key, features, targets in stream(validation, "validating linear probes"):
        for sample_features, sample_targets in zip(features, targets, strict=True):
            _append(errors, pixels, layer, key, apply(weights[layer, key], sample_features) - sample_targets.double())
    means = {key: equations[next(probe for probe in equations if probe[1] == key)].target_mean for key in sets}
    reference: Errors = {}
    for name in validation:
        for key in sets:
            _append(reference, pixels, "", key, pixels.of(name).targets[key].double() - means[key])
    return errors, {target: sample_errors for (_, target), sample_errors in reference.items()}


def _append(table: Errors, pixels: Pixels, layer: str, inside: bool, errors: Tensor) -> None:
    """Append the mean square of one sample's ``errors`` (P, T) for every target of its set."""
    for target, (within_object, columns) in pixels.columns.items():
        if within_object == inside:
            table.setdefault((layer, target), []).append(float(errors[:, columns].square().mean()))


def _position(pixels: Tensor, size: tuple[int, int]) -> Tensor:
    rows, columns = pixels // size[1], pixels % size[1]
    y, x = (2 * rows + 1) / size[0] - 1, (2 * columns + 1) / size[1] - 1
    return torch.stack([x, y, x * x, x * y, y * y], dim=-1)


def spatial_errors(
    subject: Subject, networks: Mapping[str, nn.Module], dataset: "DatasetFolder", train: Sequence[str],
    validation: Sequence[str], seeds: Mapping[str, int], epochs: int, tick: Tick,
) -> tuple[dict[tuple[str, str, str, int], list[float]], dict[str, list[float]]]:  # fmt: skip
    """Errors on ``validation`` of the four-convolution probes, by network, layer, target and seed.

    The raw input has `INPUT` as network and layer. The second value holds the errors of predicting the mean. Probes are
    trained on ``train`` for ``epochs``, with as many ``seeds`` as each network's entry says.
    """
    step = convolution.grid_step(subject.image_size)
    side = max(1, subject.image_size[0] // step), max(1, subject.image_size[1] // step)

    def stream(
        samples: Sequence[str], activity: str, use: Callable[[dict[str, Tensor], dict[str, Tensor]], None]
    ) -> None:
        for names, fringe in batches(subject, dataset, samples, convolution.BATCH):
            maps = {f"{INPUT}/{INPUT}": at_size(fringe, side)}
            for network_name, network in networks.items():
                layers = subject.layers_of(network)
                with tapped(layers, lambda features: at_size(features, side)) as activations:
                    run(network, fringe, list(layers), activations, subject.name)
                    maps |= {f"{network_name}/{layer}": activations[layer] for layer in layers}
            use(maps, _spatial_targets(dataset, names, side))
            tick(len(names), activity)

    moments: dict[str, convolution.Moments] = {}
    sums = {target: [0.0, 0] for target in SPATIAL}

    def measure(features: dict[str, Tensor], targets: dict[str, Tensor]) -> None:
        for source, maps in features.items():
            moments.setdefault(source, convolution.Moments()).add(maps)
        for target, values in targets.items():
            sums[target][0] += float(values.double().sum())
            sums[target][1] += values.numel()

    stream(train, "spread of the activations", measure)
    means = {target: total / count for target, (total, count) in sums.items()}
    steps = epochs * -(-len(train) // convolution.BATCH)
    seed_counts = {source: seeds[source.partition("/")[0]] for source in moments}
    probes = convolution.ProbeSet(moments, means, seed_counts, steps)
    for epoch in range(epochs):
        order = np.random.default_rng([1, epoch]).permutation(len(train))
        stream([train[index] for index in order], "training four-convolution probes", probes.step)
    errors: dict[tuple[str, str, str, int], list[float]] = {}
    reference: dict[str, list[float]] = {target: [] for target in SPATIAL}

    def validate(features: dict[str, Tensor], targets: dict[str, Tensor]) -> None:
        for (source, target, seed), sample_errors in probes.errors(features, targets).items():
            network_name, _, layer = source.partition("/")
            errors.setdefault((network_name, layer, target, seed), []).extend(sample_errors)
        for target, values in targets.items():
            reference[target] += (values.double() - means[target]).square().mean((1, 2, 3)).tolist()

    stream(validation, "validating four-convolution probes", validate)
    return errors, reference


def _spatial_targets(dataset: "DatasetFolder", names: Sequence[str], side: tuple[int, int]) -> dict[str, Tensor]:
    edges, depths = [], []
    for name in names:
        depth_mm = dataset.depth_mm(name)
        object_depths = depth_mm[depth_mm > 0]
        edges.append(edge_map(depth_mm))
        depths.append(normalise(depth_mm, "individual", float(object_depths.min()), float(object_depths.max())))
    whole = {"edges": np.stack(edges), "depth": np.stack(depths)}
    return {name: at_size(torch.from_numpy(images)[:, None], side) for name, images in whole.items()}
