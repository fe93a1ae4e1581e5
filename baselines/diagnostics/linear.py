"""Linear probing (paper Section 7.1), extended by a linear probe, the phase and order as targets, and controls.

Probes of two kinds (`fpp_ml_bench.baselines.diagnostics.fits`) are fitted to the layers of a network, of the same
network with random weights, and to controls: the raw input, the object's mask and the pixel's position. Background has
depth 0, so the mask alone explains much of an image's depth; therefore depth is measured on object pixels too.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from fpp_ml_bench.baselines.diagnostics import fits, probe
from fpp_ml_bench.baselines.diagnostics.fits import INPUT, MEASURED, OBJECT_DEPTH, POSITION, SILHOUETTE
from fpp_ml_bench.baselines.diagnostics.probe import (
    COLOURS,
    TRAINED,
    UNTRAINED,
    Figure,
    Line,
    Panel,
    Table,
    chart,
    layer_title,
    said_of_layers,
)
from fpp_ml_bench.baselines.diagnostics.subjects import Subject
from fpp_ml_bench.constants import split_sample_name
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.evaluation.score.uncertainty import object_interval
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.paper import AVERAGE, paper_layers

PAPER = "linear_probing"
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
CONTROLS = "controls"
TITLES = {
    "edges": "edges",
    "depth": "depth, whole image",
    OBJECT_DEPTH: "depth, object",
    "distance": "depth in mm, object",
    "phase": "wrapped phase",
    "order": "fringe order",
}
CONTROL_TITLES = {INPUT: "raw input", SILHOUETTE: "object's mask alone", POSITION: "pixel's position alone"}
_STYLES = dict(zip(CONTROL_TITLES, (":", "-.", "--"), strict=True))

Errors = dict[tuple[fits.Source, str, int], list[float]]  # squared error of each sample, by layer, target and seed
Drawn = dict[bool, tuple[Tensor, Tensor]]
"""Pixels of a sample (P,) and their target values (P, T), over the image (False) and within the object (True)."""
Score = dict[str, Any]
"""``mse``: mean over samples and seeds. ``mse_of_mean``: error of predicting the training samples' mean everywhere.
``r2`` = 1 - mse / mse_of_mean: 1 is perfect, 0 is no better than the mean. Intervals: 95%, resampled over objects; that
of r2, a ratio of two means, to first order. ``seeds``: r2 of each seed."""
Layers = dict[str, dict[str, Score]]
"""Scores by layer, then target."""
Scores = dict[str, Layers]
"""By `TRAINED`, `UNTRAINED` or `CONTROLS`."""


class LinearProbing(probe.Probe):
    """Probes on frozen activations, trained on the training split and validated on the validation split."""

    name = "linear"
    title = "Linear probing"
    question = "What can be read from each layer: edges, depth, the fringe's phase, its order?"
    without_network = "it has no layers to probe"
    version = 2

    def run(
        self, subject: Subject, dataset: DatasetFolder, settings: probe.ProbeSettings, progress: probe.Progress
    ) -> probe.Finding:
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
        network, untrained = subject.networks()
        errors, reference = experiment.linear_errors(TRAINED, network, controls=True)
        for seed in range(seeds):
            errors |= experiment.linear_errors(UNTRAINED, untrained(seed), seed)[0]
        linear = experiment.scores(errors, reference)
        # A linear probe of constant features is the mean itself.
        if not any(target["r2"] for layer in linear[TRAINED].values() for target in layer.values()):
            layers = ", ".join(subject.layer_names)
            return self.skip(f"every probed layer of {subject.name} ({layers}) is constant, so it holds nothing.")
        # Each seed of the untrained network costs another forward pass per batch, so there is one.
        networks, counts = {TRAINED: network, UNTRAINED: untrained(0)}, {TRAINED: seeds, CONTROLS: seeds, UNTRAINED: 1}
        spatial = experiment.scores(*experiment.spatial_errors(networks, counts, epochs))
        protocol = {
            "training_samples": len(train),
            "validation_samples": len(validation),
            "seeds": seeds,
            "epochs": epochs,
            "batch": fits.BATCH,
            "probe_width": fits.WIDTH,
            "image_px_a_grid_step": fits.grid_step(subject.image_size),
        }
        values = {
            "protocol": protocol,
            "four_convolutions": spatial,
            "ratio": mean_ratio(spatial[TRAINED]),
            "ratio_of_means": ratio_of_means(spatial[CONTROLS][INPUT]),
            "linear": linear,
        }
        return self.finding(summary(linear, spatial), values, tables(linear, spatial), *figures(linear, spatial))


def _samples_with_object(dataset: DatasetFolder, split: str) -> list[str]:
    names = [name for name in dataset.samples(split) if object_mask(dataset.depth_mm(name)).any()]
    if not names:
        raise DiagnosisError(f"{dataset.path}: split {split} holds no object; probes need training and validation data")
    return names


class Pixels:
    """Pixels drawn from each sample, the same for every network, and cached. ``targets``: those of each set, over the
    image or within the object, whose columns stand side by side."""

    def __init__(self, subject: Subject, dataset: DatasetFolder) -> None:
        self.dataset, self.direction = dataset, subject.direction
        usable = [target for target in TARGETS if self.direction != "both" or target not in FRINGE]
        self.targets = {
            inside: [target for target in usable if (target in INSIDE) == inside] for inside in (False, True)
        }
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
            for key, targets in self.targets.items():
                maps = [truth[name].ravel() for target in targets for name in TARGETS[target]]
                values = np.stack([one[pixels[key]] for one in maps], axis=1)
                self._drawn[sample][key] = torch.from_numpy(pixels[key]), torch.from_numpy(values)
        return self._drawn[sample]

    def errors_of(self, inside: bool, errors: Tensor) -> dict[str, float]:
        """Mean square of one sample's ``errors`` (P, T) for every target of a set."""
        widths = [len(TARGETS[target]) for target in self.targets[inside]]
        columns = zip(self.targets[inside], errors.split(widths, dim=1), strict=True)
        return {target: float(of_target.square().mean()) for target, of_target in columns}


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

    def scores(self, errors: Errors, reference: Mapping[str, Sequence[float]]) -> Scores:
        """Scores of probes from their errors and those of predicting the mean, by target."""
        scores: Scores = {TRAINED: {}, UNTRAINED: {}, CONTROLS: {}}
        for (source, layer), target in dict.fromkeys(key[:2] for key in errors):
            of_seeds = [values for key, values in errors.items() if key[:2] == ((source, layer), target)]
            scores[source].setdefault(layer, {})[target] = score(of_seeds, reference[target], self.objects)
        return scores

    def linear_errors(
        self, source: str, network: nn.Module, seed: int = 0, controls: bool = False
    ) -> tuple[Errors, dict[str, list[float]]]:
        """Errors of the 1 x 1 probes of the layers of a ``network`` called ``source``, and those of predicting the
        mean, by target. With ``controls`` these are probed like layers."""
        equations: dict[tuple[fits.Source, bool], fits.NormalEquations] = {}
        for layer, key, features, targets in self._pixel_batches(source, network, self.train, "training", controls):
            if (layer, key) not in equations:
                equations[layer, key] = fits.NormalEquations(features.shape[2], targets.shape[2])
            equations[layer, key].add(features.flatten(0, 1), targets.flatten(0, 1))
        weights = {layer: normal_equations.solve() for layer, normal_equations in equations.items()}
        errors: Errors = {}
        for layer, key, *batch in self._pixel_batches(source, network, self.validation, "validating", controls):
            for features, targets in zip(*batch, strict=True):
                difference = fits.apply(weights[layer, key], features) - targets.double()
                for target, error in self.pixels.errors_of(key, difference).items():
                    errors.setdefault((layer, target, seed), []).append(error)
        means = {key: normal_equations.target_mean for (_, key), normal_equations in reversed(equations.items())}
        reference: dict[str, list[float]] = {}
        for sample in self.validation:
            for key, (_, targets) in self.pixels.of(sample).items():
                for target, error in self.pixels.errors_of(key, targets.double() - means[key]).items():
                    reference.setdefault(target, []).append(error)
        return errors, reference

    def _pixel_batches(
        self, source: str, network: nn.Module, samples: Sequence[str], activity: str, controls: bool
    ) -> Iterator[tuple[fits.Source, bool, Tensor, Tensor]]:
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
            found = {(source, layer): of_sets for layer, of_sets in activations.items()}
            if controls:
                masks = np.stack([[object_mask(self.dataset.depth_mm(name))] for name in names], dtype=np.float32)
                found[CONTROLS, INPUT], found[CONTROLS, SILHOUETTE] = take(fringe), take(torch.from_numpy(masks))
                found[CONTROLS, POSITION] = torch.stack([_position(chosen, size) for chosen in pixels.values()])
            for layer, of_sets in found.items():
                for key, features in zip(pixels, of_sets, strict=True):
                    yield layer, key, features, targets[key]
            self.tick(len(names), f"{activity} linear probes")

    def spatial_errors(
        self, networks: Mapping[str, nn.Module], seeds: Mapping[str, int], epochs: int
    ) -> tuple[Errors, dict[str, list[float]]]:
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
        errors: Errors = {}
        reference: dict[str, list[float]] = {name: [] for name in MEASURED}
        for features, targets in self._map_batches(networks, self.validation, "validating four-convolution probes"):
            for key, sample_errors in probes.errors(features, targets).items():
                errors.setdefault(key, []).extend(sample_errors)
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


def score(errors: Sequence[Sequence[float]], reference: Sequence[float], objects: Sequence[str]) -> Score:
    """`Score` of ``errors`` (seeds, samples), squared, against those of the mean, ``reference`` (samples,). Raises
    ``ValueError`` where the reference error is 0, so for a constant target."""
    table = np.asarray(errors, dtype=np.float64)
    mean_error = float(np.mean(reference))
    if not mean_error > 0:
        raise ValueError("the target is constant, so there is nothing to explain")
    sample_means = table.mean(axis=0)
    mse = float(sample_means.mean())
    r2 = 1 - mse / mean_error
    # To first order, r2 of a resample differs by -mean(sample_means - (1 - r2) reference) / mean_error. Large objects
    # have large errors in both terms, which cancels.
    deviation = object_interval(((sample_means - (1 - r2) * np.asarray(reference)) / mean_error).tolist(), objects)
    return {
        "mse": mse,
        "mse_interval": object_interval(sample_means.tolist(), objects),
        "r2": r2,
        "r2_interval": None if deviation is None else (r2 - deviation[1], r2 - deviation[0]),
        "seeds": (1 - table.mean(axis=1) / mean_error).tolist(),
        "mse_of_mean": mean_error,
    }


def mean_over(layers: Layers, target: str, key: str = "mse") -> float:
    """Mean over layers, as in the paper's bottom row."""
    return float(np.mean([targets[target][key] for targets in layers.values()]))


def mean_ratio(layers: Layers) -> float:
    """The paper's ratio: mean over layers of the depth probes' MSE, over that of the edge probes."""
    return mean_over(layers, "depth") / mean_over(layers, "edges")


def ratio_of_means(layer: Mapping[str, Score]) -> float:
    """The paper's ratio for a probe that predicts the means, so the ratio of the targets' variances."""
    return float(layer["depth"]["mse_of_mean"] / layer["edges"]["mse_of_mean"])


def summary(linear: Scores, spatial: Scores) -> str:
    """The result in a few sentences."""
    trained, controls = spatial[TRAINED], spatial[CONTROLS]
    raw, mask = controls[INPUT], controls[SILHOUETTE]
    edges, depth, on_object = (mean_over(trained, target, "r2") for target in MEASURED)
    papers = paper_layers(PAPER)[AVERAGE]["ratio"]
    text = (
        f"The paper's ratio, depth MSE over edge MSE, is {mean_ratio(trained):.2f} (paper: {papers:.2f}). The raw "
        f"input alone gives {mean_ratio({INPUT: raw}):.2f}, and a probe that predicts each target's mean "
        f"{ratio_of_means(raw):.2f}, because the two errors have different units. On average over layers R2 is "
        f"{edges:.2f} for edges and {depth:.2f} for depth. The object's mask alone gives {mask['edges']['r2']:.2f} and "
        f"{mask['depth']['r2']:.2f}, so R2 over the whole image can come from the outline and does not show which of "
        f"the two is easier to read. For depth on object pixels R2 is {on_object:.2f} (random weights "
        f"{mean_over(spatial[UNTRAINED], OBJECT_DEPTH, 'r2'):.2f}, raw input {raw[OBJECT_DEPTH]['r2']:.2f}, mask "
        f"{mask[OBJECT_DEPTH]['r2']:.2f})."
    )
    if "phase" in linear[CONTROLS][INPUT]:
        r2 = {layer: scores["phase"]["r2"] for layer, scores in linear[TRAINED].items()}
        best, last = max(r2, key=r2.__getitem__), list(r2)[-1]
        text += (
            f" Linear probes read the wrapped phase best from {best} (R2 {r2[best]:.2f}). From the last layer, {last}, "
            f"they reach R2 {r2[last]:.2f}; with random weights {linear[UNTRAINED][last]['phase']['r2']:.2f}."
        )
    return text


def tables(linear: Scores, spatial: Scores) -> list[Table]:
    """The paper's table first, then the same probes as shares of variance, then the linear probes; with controls."""
    trained, raw = spatial[TRAINED], spatial[CONTROLS][INPUT]
    said = said_of_layers(PAPER, trained)
    groups = {layer: {layer: targets} for layer, targets in trained.items()}
    groups |= {"Average": trained, "Average, random weights": spatial[UNTRAINED]}
    groups |= {CONTROL_TITLES[name]: {name: targets} for name, targets in spatial[CONTROLS].items()}
    errors = {}
    for name, layers in groups.items():
        row = {key: mean_over(layers, key) for key in MEASURED} | {"ratio": mean_ratio(layers)}
        errors[layer_title(name) if said else name] = row | {"paper": said.get(name.lower())}
    means = {key: raw[key]["mse_of_mean"] for key in MEASURED}
    errors["Predicting the mean"] = {**means, "ratio": ratio_of_means(raw)}
    columns = {key: TITLES[key] for key in MEASURED}
    columns |= {"ratio": "Ratio depth / edges", "paper": "Paper: edges, depth, ratio"}
    title = "Four-convolution probes, validation MSE (the paper's table; lower is easier to read)"
    return [
        Table.of(title, "Layer", errors, columns),
        _shares("The same probes, share of variance explained (R2)", spatial, intervals=True),
        _shares("Linear (1 x 1) probes, R2 (intervals: figure and JSON)", linear, intervals=False),
    ]


def _shares(title: str, scores: Scores, intervals: bool) -> Table:
    """R2 of each layer beside that of random weights, and of the controls, by target."""

    def cells(targets: Mapping[str, Score], before: str = "") -> dict[str, Any]:
        return {
            before + key: {"r": one["r2"], "interval": one["r2_interval"] if intervals else None}
            for key, one in targets.items()
        }

    rows = {
        layer: cells(targets) | cells(scores[UNTRAINED][layer], "random ") for layer, targets in scores[TRAINED].items()
    }
    rows |= {CONTROL_TITLES[name]: cells(targets) for name, targets in scores[CONTROLS].items()}
    columns: dict[str, str] = {}
    for key in scores[CONTROLS][INPUT]:
        columns |= {key: TITLES[key], f"random {key}": "random weights"}
    return Table.of(title, "Layer", rows, columns)


def figures(linear: Scores, spatial: Scores) -> list[Figure]:
    """The paper's figure, and the same probes as shares of variance; the linear probes, for each target."""
    four = [
        _panel("Validation MSE: the paper's figure (different units!)", spatial, SPATIAL, "mse"),
        _panel("The same probes: share of variance explained", spatial, tuple(MEASURED), "r2"),
    ]
    targets = tuple(linear[CONTROLS][INPUT])
    one_by_one = [_panel(TITLES[target], linear, (target,), "r2") for target in targets]
    alts = (
        "Error and share of variance explained of edge and depth probes by layer, with random weights and controls",
        f"R2 of linear probes for {', '.join(TITLES[target] for target in targets)} by layer, with controls",
    )
    drawn = chart(four, 2), chart(one_by_one, 2, (5.0, 2.8))
    return [
        Figure("Four-convolution probes by layer", "linear_four_convolutions.png", alts[0], drawn[0]),
        Figure("Linear (1 x 1) probes by layer and target", "linear_one_by_one.png", alts[1], drawn[1]),
    ]


def _panel(title: str, scores: Scores, targets: Sequence[str], key: str) -> Panel:
    """The score ``key`` by layer: trained, with intervals, random weights with the range of seeds, and controls."""
    lines, layers = [], list(scores[TRAINED])
    for target in targets:
        trained, random = ({layer: scores[of][layer][target] for layer in layers} for of in (TRAINED, UNTRAINED))
        colour, name = COLOURS[target], f": {TITLES[target]}" if len(targets) > 1 else ""
        lines.append(Line.of(f"trained{name}", trained, key, colour, "o-", f"{key}_interval"))
        style = {"style": "s--", "ends": "seeds" if key == "r2" else ""}
        lines.append(Line.of(f"random weights{name}", random, key, colour if name else COLOURS["random"], **style))
        for control, of_target in scores[CONTROLS].items():
            level = [of_target[target][key]] * len(layers)
            label = CONTROL_TITLES[control] + name
            lines.append(Line(label, layers, level, colour if name else COLOURS["ink"], _STYLES[control]))
    limits = {} if name else {"ylim": (min(-0.1, max(-0.5, min(one[key] for one in trained.values()) - 0.05)), 1.02)}
    return Panel(title, lines, "", "MSE" if key == "mse" else "R2", limits)
