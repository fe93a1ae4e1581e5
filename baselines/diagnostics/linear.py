"""Linear probing (paper Section 7.1), extended by a linear probe, the phase and order as targets, and controls.

Probes of two kinds (`fpp_ml_bench.baselines.diagnostics.fits`) are fitted to the layers of a network, of the same
network with random weights, and to two controls: the raw input and the object's mask. Background has depth 0, so the
mask alone explains much of an image's depth; therefore depth is measured on object pixels too.
"""

from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from fpp_ml_bench.baselines.diagnostics import fits, probe
from fpp_ml_bench.baselines.diagnostics.fits import MEAN, OBJECT_DEPTH, SPATIAL, Source
from fpp_ml_bench.baselines.diagnostics.probe import (
    COLOURS,
    TRAINED,
    UNTRAINED,
    Figure,
    Line,
    Panel,
    Table,
    chart,
)
from fpp_ml_bench.baselines.diagnostics.subjects import Subject
from fpp_ml_bench.constants import split_sample_name
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.evaluation.score.uncertainty import object_interval
from fpp_ml_bench.loaders.storage.store import DatasetFolder

PAPER = "linear_probing"
SAMPLES, QUICK_SAMPLES, QUICK_EPOCHS = 120, 24, 4
"""Training samples of the probes, and training samples and epochs of a quick run."""
SEEDS = 2
PIXELS = 1024  # pixels drawn with replacement from each sample: so many over the image, and as many within the object
TITLES = {
    "edges": "edges",
    "depth": "depth, whole image",
    OBJECT_DEPTH: "depth, object",
    "distance": "depth in mm, object",
    "phase": "wrapped phase",
    "order": "fringe order",
}
CONTROLS, INPUT, SILHOUETTE = "controls", "input", "silhouette"
CONTROL_TITLES = {INPUT: "raw input", SILHOUETTE: "object's mask alone"}
"""Controls, which are probed like layers: the raw input, and the object's mask (0 or 1)."""
_STYLES = dict(zip(CONTROL_TITLES, (":", "-."), strict=True))

Networks = Mapping[tuple[str, int], nn.Module]
"""By `TRAINED` or `UNTRAINED`, and the seed of the weights."""
Errors = dict[tuple[Source, str, int], list[float]]
"""Squared error of each validation sample, by what was probed, target and seed of the probe."""
Score = dict[str, Any]
"""``mse``: mean over samples and seeds. ``mse_of_mean``: error of predicting the training samples' mean everywhere.
``r2`` = 1 - mse / mse_of_mean: 1 is perfect, 0 is no better than the mean. ``r2_interval``: 95%, resampled over
objects, to first order for it is a ratio of two means. ``seeds``: r2 of each seed."""
Scores = dict[str, dict[str, dict[str, Score]]]
"""By `TRAINED`, `UNTRAINED` or `CONTROLS`, then layer, then target."""


class LinearProbing(probe.Probe):
    """Probes on frozen activations, trained on the training split and validated on the validation split."""

    name = "linear"
    title = "Linear probing"
    question = "What can be read from each layer: edges, depth, the fringe's phase, its order?"
    without_network = "it has no layers to probe"
    version = 3

    def run(
        self, subject: Subject, dataset: DatasetFolder, settings: probe.ProbeSettings, progress: probe.Progress
    ) -> probe.Finding:
        train = settings.choose(_samples_with_object(dataset, "train"), SAMPLES, QUICK_SAMPLES)
        validation = settings.choose(_samples_with_object(dataset, "validation"))
        seeds = settings.seeds or (1 if settings.quick else SEEDS)
        epochs = QUICK_EPOCHS if settings.quick else fits.EPOCHS
        total, done = (len(train) + len(validation)) * 2 + epochs * len(train), 0

        def tick(samples: int, activity: str) -> None:
            nonlocal done
            done += samples
            progress(done, total, activity)

        network, untrained = subject.networks()
        networks = {(TRAINED, 0): network} | {(UNTRAINED, seed): untrained(seed) for seed in range(seeds)}
        fringe = subject.direction != "both"
        measured = {name: maps for name, maps in fits.LINEAR.items() if fringe or name not in fits.FRINGE}
        pixels = Pixels(subject, dataset, tick)
        linear = scores(errors_of(fits.LinearProbes(measured), pixels, networks, train, validation), validation)
        # A linear probe of constant features is the mean itself.
        if not any(target["r2"] for layer in linear[TRAINED].values() for target in layer.values()):
            layers = ", ".join(subject.layer_names)
            return self.skip(f"every probed layer of {subject.name} ({layers}) is constant, so it holds nothing.")
        # Each seed of the untrained network costs another forward pass per batch, so there is one.
        first = {key: one for key, one in networks.items() if key[1] == 0}
        counts = {TRAINED: seeds, CONTROLS: seeds, UNTRAINED: 1}
        probes = fits.ConvolutionProbes(SPATIAL, counts, epochs * -(-len(train) // fits.BATCH))
        grid = Grid(subject, dataset, tick)
        spatial = scores(errors_of(probes, grid, first, train, validation, epochs), validation)
        protocol = {
            "training_samples": len(train),
            "validation_samples": len(validation),
            "seeds": seeds,
            "epochs": epochs,
        }
        values = {"protocol": protocol, "four_convolutions": spatial, "linear": linear}
        return self.finding(summary(linear, spatial), values, table(spatial), figure(linear))


def _samples_with_object(dataset: DatasetFolder, split: str) -> list[str]:
    names = [name for name in dataset.samples(split) if object_mask(dataset.depth_mm(name)).any()]
    if not names:
        raise DiagnosisError(f"{dataset.path}: split {split} holds no object; probes need training and validation data")
    return names


class View(ABC):
    """Where activations and true maps are looked at; ``batch``: samples at once, None for as many as the subject's.
    ``tick`` is called with the number of samples just looked at and the activity."""

    batch: int | None = None

    def __init__(self, subject: Subject, dataset: DatasetFolder, tick: Callable[[int, str], None]) -> None:
        self.subject, self.dataset, self.tick = subject, dataset, tick
        self._targets: dict[str, dict[str, Tensor]] = {}

    @abstractmethod
    def reduce(self, maps: Tensor, names: Sequence[str]) -> Tensor:
        """Maps (B, C, H, W) of the samples ``names`` there, in a new tensor."""

    @abstractmethod
    def masks(self, share: Tensor) -> tuple[Tensor, Tensor]:
        """The places over the image and those within the object, whose mask is ``share`` there, (1, 1, h, w)."""

    def targets(self, name: str) -> dict[str, Tensor]:
        """The true maps of a sample there and both masks, (1, 1, h, w); kept."""
        if name not in self._targets:
            direction = "horizontal" if self.subject.direction == "both" else self.subject.direction
            truth = fits.truth(self.dataset.depth_mm(name), self.dataset.rig, direction)
            maps = {key: self.reduce(torch.from_numpy(one)[None, None], [name]) for key, one in truth.items()}
            maps["image"], maps["object"] = self.masks(maps["object"])
            self._targets[name] = maps
        return self._targets[name]

    def batches(
        self, networks: Networks, samples: Sequence[str], activity: str
    ) -> Iterator[tuple[dict[Source, Tensor], dict[str, Tensor]]]:
        """The controls and the activations of every layer, and the targets."""
        for names, fringe in self.subject.batches(self.dataset, samples, self.batch):
            reduce = partial(self.reduce, names=names)
            masks = np.stack([[object_mask(self.dataset.depth_mm(name))] for name in names], dtype=np.float32)
            images = {INPUT: fringe, SILHOUETTE: torch.from_numpy(masks)}
            features = {(CONTROLS, 0, name): reduce(image) for name, image in images.items()}
            for (name, seed), network in networks.items():
                layers = self.subject.layers_of(network)
                found = fits.activations_of(network, layers, fringe, reduce, self.subject.name)
                features |= {(name, seed, layer): found[layer] for layer in layers}
            targets = [self.targets(name) for name in names]
            yield features, {key: torch.cat([one[key] for one in targets]) for key in targets[0]}
            self.tick(len(names), activity)


class Pixels(View):
    """Pixels drawn from each sample over the image and then within its object, the same for every network, as maps
    (B, C, 1, 2 P)."""

    @cache  # noqa: B019
    def drawn(self, name: str) -> Tensor:
        """Flat indices of the pixels, (2 P,)."""
        split = self.dataset.split_of_sample(name)
        rng = np.random.default_rng([list(self.dataset.splits).index(split), self.dataset.samples(split).index(name)])
        mask = object_mask(self.dataset.depth_mm(name))
        over_image, inside = rng.integers(mask.size, size=PIXELS), np.flatnonzero(mask)
        return torch.from_numpy(np.concatenate([over_image, inside[rng.integers(inside.size, size=PIXELS)]]))

    def reduce(self, maps: Tensor, names: Sequence[str]) -> Tensor:
        pixels = torch.stack([self.drawn(name) for name in names])
        return fits.at_pixels(maps, pixels, self.subject.image_size).transpose(1, 2)[:, :, None]

    def masks(self, share: Tensor) -> tuple[Tensor, Tensor]:
        within = (torch.arange(2 * PIXELS) >= PIXELS).float().expand_as(share)
        return 1 - within, within


class Grid(View):
    """The coarse grid of the four-convolution probes, (B, C, h, w)."""

    batch = fits.BATCH

    def reduce(self, maps: Tensor, names: Sequence[str]) -> Tensor:
        (height, width), step = self.subject.image_size, fits.grid_step(self.subject.image_size)
        return fits.at_size(maps, (max(1, height // step), max(1, width // step)))

    def masks(self, share: Tensor) -> tuple[Tensor, Tensor]:
        # Cells across the outline mix depth with background; of a tiny object those with the largest share count.
        return torch.ones_like(share), (share == share.max()).float()


def errors_of(
    probes: fits.Probes,
    view: View,
    networks: Networks,
    train: Sequence[str],
    validation: Sequence[str],
    epochs: int = 0,
) -> Errors:
    """Errors on the samples ``validation`` of ``probes`` that observe the samples ``train``, then are trained on them
    for ``epochs``, and those of `MEAN`."""
    for features, targets in view.batches(networks, train, "statistics of the activations"):
        probes.observe(features, targets)
    probes.start()
    for epoch in range(epochs):
        shuffled = [train[index] for index in np.random.default_rng([1, epoch]).permutation(len(train))]
        for features, targets in view.batches(networks, shuffled, "training probes"):
            probes.step(features, targets)
    errors: Errors = defaultdict(list)
    for features, targets in view.batches(networks, validation, "validating probes"):
        for key, sample_errors in probes.errors(features, targets).items():
            errors[key] += sample_errors
    return errors


def scores(errors: Errors, validation: Sequence[str]) -> Scores:
    """Scores of probes from their errors on the samples ``validation``, of all seeds together."""
    of_seeds = defaultdict(list)
    for ((network, seed, layer), target, _), values in errors.items():
        if (network, seed, layer) != MEAN:
            of_seeds[network, layer, target].append(values)
    objects = [split_sample_name(name)[0] for name in validation]
    found: Scores = {TRAINED: {}, UNTRAINED: {}, CONTROLS: {}}
    for (network, layer, target), columns in of_seeds.items():
        found[network].setdefault(layer, {})[target] = score(columns, errors[MEAN, target, 0], objects)
    return found


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
        "r2": r2,
        "r2_interval": None if deviation is None else (r2 - deviation[1], r2 - deviation[0]),
        "seeds": (1 - table.mean(axis=1) / mean_error).tolist(),
        "mse_of_mean": mean_error,
    }


def mean_over(layers: Mapping[str, Mapping[str, Score]], target: str, key: str = "r2") -> float:
    """Mean over layers, as in the paper's bottom row."""
    return float(np.mean([targets[target][key] for targets in layers.values()]))


def summary(linear: Scores, spatial: Scores) -> str:
    """The result in two sentences."""
    edges, depth, on_object = (f"{mean_over(spatial[TRAINED], target):.2f}" for target in SPATIAL)
    mask = {target: f"{one['r2']:.2f}" for target, one in spatial[CONTROLS][SILHOUETTE].items()}
    text = (
        f"On average over layers R2 is {edges} for edges (from the object's mask alone: {mask['edges']}), {depth} for "
        f"depth (mask: {mask['depth']}) and {on_object} for depth on object pixels (mask: {mask[OBJECT_DEPTH]}, random "
        f"weights: {mean_over(spatial[UNTRAINED], OBJECT_DEPTH):.2f})."
    )
    if "phase" in linear[CONTROLS][INPUT]:
        phase = {layer: scores["phase"]["r2"] for layer, scores in linear[TRAINED].items()}
        best, last = max(phase, key=phase.__getitem__), list(phase)[-1]
        text += (
            f" Linear probes read the wrapped phase best from {best} (R2 {phase[best]:.2f}); from the last layer, "
            f"{last}, they reach R2 {phase[last]:.2f} (random weights: {linear[UNTRAINED][last]['phase']['r2']:.2f})."
        )
    return text


def table(spatial: Scores) -> Table:
    """The paper's table, with its ratio of depth's MSE to edges', and the same probes as shares of variance."""
    trained = spatial[TRAINED]
    groups = {layer: {layer: targets} for layer, targets in trained.items()}
    groups |= {"average": trained, "average, random weights": spatial[UNTRAINED]}
    groups |= {CONTROL_TITLES[name]: {name: targets} for name, targets in spatial[CONTROLS].items()}
    rows: dict[str, dict[str, Any]] = {}
    for name, layers in groups.items():
        rows[name] = {f"mse {key}": mean_over(layers, key, "mse") for key in SPATIAL}
        for key in SPATIAL:
            interval = layers[name][key]["r2_interval"] if name in layers else None
            rows[name][f"r2 {key}"] = {"r": mean_over(layers, key), "interval": interval}
    rows["predicting the mean"] = {f"mse {key}": mean_over(trained, key, "mse_of_mean") for key in SPATIAL}
    for row in rows.values():
        row["ratio"] = row["mse depth"] / row["mse edges"]
    columns = {f"mse {key}": f"MSE, {TITLES[key]}" for key in SPATIAL} | {"ratio": "Ratio depth / edges"}
    columns |= {f"r2 {key}": f"R2, {TITLES[key]}" for key in SPATIAL}
    return Table.of("Four-convolution probes on the validation samples", "Layer", rows, columns)


def figure(linear: Scores) -> Figure:
    """R2 of the linear probes by layer, a panel for each target: trained, with intervals, random weights with the range
    of seeds, and controls."""
    panels, layers = [], list(linear[TRAINED])
    for target in linear[CONTROLS][INPUT]:
        lines = []
        for label, source, colour, style, ends in (
            ("trained", TRAINED, COLOURS[target], "o-", "r2_interval"),
            ("random weights", UNTRAINED, COLOURS["random"], "s--", "seeds"),
        ):
            scores = [linear[source][layer][target] for layer in layers]
            values, intervals = ([one[key] for one in scores] for key in ("r2", ends))
            lines.append(Line(label, layers, values, colour, style, intervals))
        for control, title in CONTROL_TITLES.items():
            level = [linear[CONTROLS][control][target]["r2"]] * len(layers)
            lines.append(Line(title, layers, level, COLOURS["ink"], _STYLES[control]))
        panels.append(Panel(TITLES[target], lines, {"ylabel": "R2", "ylim": (-0.1, 1.02)}))
    alt = "R2 of linear probes by layer, a panel for each target, with random weights and controls"
    return Figure("Linear (1 x 1) probes by layer and target", alt, chart(panels, 3, (4.4, 3.0)))
