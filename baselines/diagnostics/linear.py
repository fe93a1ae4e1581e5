"""Linear probing (paper Section 7.1), extended by a linear probe, the phase and order as targets, and controls.

Probes of two kinds (`fpp_ml_bench.baselines.diagnostics.fits`) are fitted to the layers of a network, of the same
network with random weights, and to controls: the raw input, the object's mask and the pixel's position. Background has
depth 0, so the mask alone explains much of an image's depth; therefore depth is measured on object pixels too.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from fpp_ml_bench.baselines.diagnostics import fits, linear_report
from fpp_ml_bench.baselines.diagnostics.fits import INPUT, MEASURED, OBJECT_DEPTH, POSITION, SILHOUETTE
from fpp_ml_bench.baselines.diagnostics.linear_report import CONTROLS, TRAINED, UNTRAINED, Scores, score
from fpp_ml_bench.baselines.diagnostics.probe import Finding, Probe, ProbeSettings, Progress
from fpp_ml_bench.baselines.diagnostics.subjects import Subject
from fpp_ml_bench.constants import split_sample_name
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.loaders.storage import DatasetFolder

SAMPLES, QUICK_SAMPLES, QUICK_EPOCHS = 120, 24, 4
"""Training samples of the probes, and training samples and epochs of a quick run."""
SEEDS = 2
PIXELS = 1024  # pixels drawn with replacement from each sample: so many over the image, and as many within the object
TARGETS: dict[str, tuple[str, ...]] = {
    "edges": ("edges",),
    "depth": ("depth",),
    OBJECT_DEPTH: ("depth",),
    "distance": ("depth_mm",),
    "phase": ("sine", "cosine"),
    "order": ("order",),
}
"""Targets of the linear probe, by the names in `fits.truth`; the phase is an angle and so has two."""
INSIDE = (OBJECT_DEPTH, "distance", "phase", "order")  # targets on object pixels only
FRINGE = ("phase", "order")  # targets that need fringes of a single direction
SPATIAL = ("edges", "depth")  # targets of the four-convolution probes, as in the paper

Errors = dict[tuple[str, str], list[float]]  # squared error of each sample, by layer and target
Drawn = dict[bool, tuple[Tensor, Tensor]]
"""Pixels of a sample (P,) and their target values (P, T), over the image (False) and within the object (True)."""


class LinearProbing(Probe):
    """Probes on frozen activations, trained on the training split and validated on the validation split."""

    name = "linear"
    title = "Linear probing"
    question = "What can be read from each layer: edges, depth, the fringe's phase, its order?"
    without_network = "it has no layers to probe"
    version = 2

    def run(
        self, subject: Subject, dataset: DatasetFolder, settings: ProbeSettings, folder: Path, progress: Progress
    ) -> Finding:
        train = settings.choose(_samples_with_object(dataset, "train"), SAMPLES, QUICK_SAMPLES)
        validation = settings.choose(_samples_with_object(dataset, "validation"))
        seeds = settings.seeds or (1 if settings.quick else SEEDS)
        epochs = QUICK_EPOCHS if settings.quick else fits.EPOCHS
        total, done = (len(train) + len(validation)) * (2 + seeds) + epochs * len(train), 0

        def tick(samples: int, activity: str) -> None:
            nonlocal done
            done += samples
            progress(done, total, activity)

        experiment = Experiment(subject, dataset, train, validation, tick)
        linear = experiment.linear_scores(seeds)
        # A linear probe of constant features is the mean itself.
        if not any(target["r2"] for layer in linear[TRAINED].values() for target in layer.values()):
            layers = ", ".join(subject.layer_names)
            return self.skip(f"every probed layer of {subject.name} ({layers}) is constant, so it holds nothing.")
        spatial = experiment.spatial_scores(seeds, epochs)
        protocol = {
            "training_samples": len(train),
            "validation_samples": len(validation),
            "seeds": seeds,
            "epochs": epochs,
            "batch": fits.BATCH,
            "probe_width": fits.WIDTH,
            "image_px_a_grid_step": fits.grid_step(subject.image_size),
        }
        summary, tables = linear_report.summary(linear, spatial), linear_report.tables(linear, spatial)
        values = {"protocol": protocol, **linear_report.values(linear, spatial)}
        drawn = linear_report.draw_four_convolutions(spatial, folder), linear_report.draw_one_by_one(linear, folder)
        return self.finding(summary, values, tables, *drawn)


def _samples_with_object(dataset: DatasetFolder, split: str) -> list[str]:
    names = [name for name in dataset.samples(split) if object_mask(dataset.depth_mm(name)).any()]
    if not names:
        raise DiagnosisError(f"{dataset.path}: split {split} holds no object; probes need training and validation data")
    return names


class Pixels:
    """Pixels drawn from each sample, the same for every network, and cached. ``columns``: for each target its set (over
    the image or within the object) and its columns in that set's targets."""

    def __init__(self, subject: Subject, dataset: DatasetFolder) -> None:
        self.dataset, self.direction = dataset, subject.direction
        self.fields: dict[bool, list[str]] = {False: [], True: []}
        self.columns: dict[str, tuple[bool, slice]] = {}
        for target, names in TARGETS.items():
            if self.direction != "both" or target not in FRINGE:
                fields = self.fields[target in INSIDE]
                self.columns[target] = target in INSIDE, slice(len(fields), len(fields) + len(names))
                fields += names
        self._drawn: dict[str, Drawn] = {}

    def of(self, sample: str) -> Drawn:
        if sample not in self._drawn:
            dataset, split = self.dataset, self.dataset.split_of_sample(sample)
            rng = np.random.default_rng([list(dataset.splits).index(split), dataset.samples(split).index(sample)])
            direction = "horizontal" if self.direction == "both" else self.direction
            truth = fits.truth(dataset.depth_mm(sample), dataset.rig, direction)
            inside, size = np.flatnonzero(truth["inside"]), truth["inside"].size
            pixels = {False: rng.integers(size, size=PIXELS), True: inside[rng.integers(inside.size, size=PIXELS)]}
            self._drawn[sample] = {}
            for key, fields in self.fields.items():
                values = np.stack([truth[name].ravel()[pixels[key]] for name in fields], axis=1)
                self._drawn[sample][key] = torch.from_numpy(pixels[key]), torch.from_numpy(values)
        return self._drawn[sample]

    def errors_of(self, layer: str, inside: bool, errors: Tensor) -> Iterator[tuple[tuple[str, str], float]]:
        """Layer, target, and mean square of one sample's ``errors`` (P, T), for every target of its set."""
        for target, (within_object, columns) in self.columns.items():
            if within_object == inside:
                yield (layer, target), float(errors[:, columns].square().mean())


class Experiment:
    """Fits probes to frozen layers on the samples ``train`` and measures their errors on ``validation``. ``tick`` is
    called with the number of samples just processed and the activity."""

    def __init__(
        self,
        subject: Subject,
        dataset: DatasetFolder,
        train: Sequence[str],
        validation: Sequence[str],
        tick: Callable[[int, str], None],
    ) -> None:
        self.subject, self.dataset, self.train, self.validation, self.tick = subject, dataset, train, validation, tick
        self.pixels = Pixels(subject, dataset)
        self.objects = [split_sample_name(name)[0] for name in validation]

    def linear_scores(self, seeds: int) -> Scores:
        """Scores of the linear probes: of the network, of ``seeds`` untrained copies, and of the controls."""
        network, untrained = self.subject.networks()
        errors, reference = self.linear_errors(network, controls=True)
        scores: Scores = {TRAINED: {}, UNTRAINED: {}, CONTROLS: {}}
        for (layer, target), sample_errors in errors.items():
            source = CONTROLS if layer in linear_report.CONTROL_TITLES else TRAINED
            scores[source].setdefault(layer, {})[target] = score([sample_errors], reference[target], self.objects)
        random_errors = [self.linear_errors(untrained(seed))[0] for seed in range(seeds)]
        for layer, target in random_errors[0]:
            seed_errors = [sample_errors[layer, target] for sample_errors in random_errors]
            scores[UNTRAINED].setdefault(layer, {})[target] = score(seed_errors, reference[target], self.objects)
        return scores

    def linear_errors(self, network: nn.Module, controls: bool = False) -> tuple[Errors, dict[str, list[float]]]:
        """Errors of the 1 x 1 probes of ``network``'s layers, and those of predicting the mean, by target. With
        ``controls`` these are probed like layers."""
        equations: dict[tuple[str, bool], fits.NormalEquations] = {}
        for layer, key, features, targets in self._pixel_batches(network, self.train, "training", controls):
            if (layer, key) not in equations:
                equations[layer, key] = fits.NormalEquations(features.shape[2], targets.shape[2])
            equations[layer, key].add(features.flatten(0, 1), targets.flatten(0, 1))
        weights = {probe: normal_equations.solve() for probe, normal_equations in equations.items()}
        errors: Errors = {}
        for layer, key, features, targets in self._pixel_batches(network, self.validation, "validating", controls):
            for sample_features, sample_targets in zip(features, targets, strict=True):
                difference = fits.apply(weights[layer, key], sample_features) - sample_targets.double()
                for name, error in self.pixels.errors_of(layer, key, difference):
                    errors.setdefault(name, []).append(error)
        means = {key: normal_equations.target_mean for (_, key), normal_equations in reversed(equations.items())}
        reference: dict[str, list[float]] = {}
        for sample in self.validation:
            for key, (_, targets) in self.pixels.of(sample).items():
                for (_, target), error in self.pixels.errors_of("", key, targets.double() - means[key]):
                    reference.setdefault(target, []).append(error)
        return errors, reference

    def _pixel_batches(
        self, network: nn.Module, samples: Sequence[str], activity: str, controls: bool
    ) -> Iterator[tuple[str, bool, Tensor, Tensor]]:
        """Layer, set, features (B, P, C) and targets (B, P, T)."""
        layers, size = self.subject.layers_of(network), self.subject.image_size
        for names, fringe in self.subject.batches(self.dataset, samples):
            batch = [self.pixels.of(name) for name in names]
            pixels, targets = (
                {key: torch.stack([drawn[key][part] for drawn in batch]) for key in (False, True)} for part in (0, 1)
            )

            def take(features: Tensor, pixels: dict[bool, Tensor] = pixels) -> Tensor:
                return torch.stack([fits.at_pixels(features, chosen, size) for chosen in pixels.values()])

            activations = fits.activations_of(network, layers, fringe, take, self.subject.name)
            if controls:
                masks = np.stack([[object_mask(self.dataset.depth_mm(name))] for name in names], dtype=np.float32)
                activations[INPUT], activations[SILHOUETTE] = take(fringe), take(torch.from_numpy(masks))
                activations[POSITION] = torch.stack([_position(chosen, size) for chosen in pixels.values()])
            for layer, of_sets in activations.items():
                for key, features in zip(pixels, of_sets, strict=True):
                    yield layer, key, features, targets[key]
            self.tick(len(names), f"{activity} linear probes")

    def spatial_scores(self, seeds: int, epochs: int) -> Scores:
        """Scores of the four-convolution probes: of the network, of an untrained copy, and of the controls."""
        network, untrained = self.subject.networks()
        # Each seed of the untrained network costs another forward pass per batch, so there is one.
        seed_counts = {TRAINED: seeds, CONTROLS: seeds, UNTRAINED: 1}
        errors, reference = self.spatial_errors({TRAINED: network, UNTRAINED: untrained(0)}, seed_counts, epochs)
        scores: Scores = {TRAINED: {}, UNTRAINED: {}, CONTROLS: {}}
        for (source, layer), target in dict.fromkeys(key[:2] for key in errors):
            seed_errors = [errors[(source, layer), target, seed] for seed in range(seed_counts[source])]
            scores[source].setdefault(layer, {})[target] = score(seed_errors, reference[target], self.objects)
        return scores

    def spatial_errors(
        self, networks: Mapping[str, nn.Module], seeds: Mapping[str, int], epochs: int
    ) -> tuple[dict[tuple[fits.Source, str, int], list[float]], dict[str, list[float]]]:
        """Errors of the four-convolution probes, trained for ``epochs``, by network and layer, name in `MEASURED` and
        seed; and those of predicting the mean, by that name. Controls are layers of the network `CONTROLS`; ``seeds``:
        number of seeds of each network."""
        moments: dict[fits.Source, fits.Moments] = {}
        sums, sizes = dict.fromkeys(MEASURED, 0.0), dict.fromkeys(MEASURED, 0.0)
        for features, targets in self._map_batches(networks, self.train, "spread of the activations"):
            for source, maps in features.items():
                moments.setdefault(source, fits.Moments()).add(maps)
            for name, (target, where) in MEASURED.items():
                sums[name] += float((targets[target] * targets[where]).double().sum())
                sizes[name] += float(targets[where].double().sum())
        means = {name: sums[name] / sizes[name] for name in MEASURED}
        steps = epochs * -(-len(self.train) // fits.BATCH)
        starts = {target: means[target] for target in SPATIAL}
        probes = fits.ProbeSet(moments, starts, {source: seeds[source[0]] for source in moments}, steps)
        for epoch in range(epochs):
            shuffled = [self.train[index] for index in np.random.default_rng([1, epoch]).permutation(len(self.train))]
            for features, targets in self._map_batches(networks, shuffled, "training four-convolution probes"):
                probes.step(features, targets)
        errors: dict[tuple[fits.Source, str, int], list[float]] = {}
        reference: dict[str, list[float]] = {name: [] for name in MEASURED}
        for features, targets in self._map_batches(networks, self.validation, "validating four-convolution probes"):
            for probe, sample_errors in probes.errors(features, targets).items():
                errors.setdefault(probe, []).extend(sample_errors)
            for name, (target, where) in MEASURED.items():
                reference[name] += fits.mean_square(targets[target].double() - means[name], targets[where])
        return errors, reference

    def _map_batches(
        self, networks: Mapping[str, nn.Module], samples: Sequence[str], activity: str
    ) -> Iterator[tuple[dict[fits.Source, Tensor], dict[str, Tensor]]]:
        """Activations (B, C, h, w) of every layer, and targets and masks (B, 1, h, w) of `MEASURED`, on one grid."""
        (height, width), step = self.subject.image_size, fits.grid_step(self.subject.image_size)
        side = max(1, height // step), max(1, width // step)
        for names, fringe in self.subject.batches(self.dataset, samples, fits.BATCH):
            depths = [self.dataset.depth_mm(name) for name in names]
            map_of = {"edges": fits.edge_map, "depth": fits.normalised_depth, "object": object_mask}
            stacks = {key: np.stack(list(map(make, depths)), dtype=np.float32) for key, make in map_of.items()}
            targets = {key: fits.at_size(torch.from_numpy(maps)[:, None], side) for key, maps in stacks.items()}
            share = targets["object"]  # of the object in each grid cell
            features = {(CONTROLS, INPUT): fits.at_size(fringe, side), (CONTROLS, SILHOUETTE): share}
            for source, network in networks.items():
                layers = self.subject.layers_of(network)
                activations = fits.activations_of(
                    network, layers, fringe, lambda maps: fits.at_size(maps, side), self.subject.name
                )
                features |= {(source, layer): activations[layer] for layer in layers}
            # Cells across the outline mix depth with background; of a tiny object those with the largest share count.
            targets["object"] = (share == share.amax((2, 3), keepdim=True)).float()
            yield features, {**targets, "image": torch.ones_like(share)}
            self.tick(len(names), activity)


def _position(pixels: Tensor, size: tuple[int, int]) -> Tensor:
    rows, columns = pixels // size[1], pixels % size[1]
    y, x = (2 * rows + 1) / size[0] - 1, (2 * columns + 1) / size[1] - 1
    return torch.stack([x, y, x * x, x * y, y * y], dim=-1)
