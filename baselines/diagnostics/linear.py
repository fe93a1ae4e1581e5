"""Linear probing (paper Section 7.1), extended by a linear probe, the phase and order as targets,
and controls.

Probes of two kinds are fitted to the layers of a network, of the same network with random weights,
and to two controls: the raw input and the object's mask. Background has depth 0, so the mask alone
explains much of an image's depth; therefore depth is measured on object pixels too. *Linear probes*
have a weight per channel, the same at every pixel (a 1 x 1 convolution), in closed form.
*Four-convolution probes* are the paper's, which gives only "four convolutional layers"; the other
choices are ours. Both learn from the network's batches as they come, so no activations are stored.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import product
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from fpp_ml_bench.baselines.diagnostics.probe import (
    Figure,
    Finding,
    Probe,
    ProbeSettings,
    Progress,
    table_of,
)
from fpp_ml_bench.baselines.diagnostics.scenes import truth
from fpp_ml_bench.baselines.diagnostics.subjects import Subject, activations_of
from fpp_ml_bench.constants import split_sample_name
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.evaluation.score.uncertainty import object_interval
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.style import INK, LINE, LINE_COLOURS, panels, styled, with_legend
from fpp_ml_bench.tables import Table

SAMPLES = 120
"""Training samples of the probes, spread over objects. More take more time."""
QUICK_SAMPLES = 24
"""The same in a quick run."""
EPOCHS = 6
"""Passes of the four-convolution probes over these samples."""
QUICK_EPOCHS = 4
"""The same in a quick run."""
SEEDS = 2
"""Seeds of the probes, and networks of random weights: two show whether a score depends on the
seed."""
BATCH = 4
"""Samples in a training step. A larger batch gives fewer steps in the same passes."""
PIXELS = 1024
"""Pixels drawn with replacement from each sample: so many over the image, and as many within the
object."""
SHARE = 4
"""Image px per grid step: a grid of a sixteenth of the pixels saves time."""
LONGEST = 120
"""Most grid points along a side; for larger images the step grows."""
RIDGE = 1e-6
"""Ridge strength per pixel for standardised channels; it only makes constant or duplicate channels
solvable."""
WIDTH = 16
"""Channels of a four-convolution probe. A wider probe learns more of the task by itself, and tells
less of the layer."""
LEARNING_RATE = 3e-3
"""Adam's learning rate for these probes, which falls to 0 along a cosine."""
TRAINED, UNTRAINED, CONTROLS = "trained", "untrained", "controls"
INPUT, SILHOUETTE = "input", "silhouette"
CONTROL_TITLES = {INPUT: "raw input", SILHOUETTE: "object's mask alone"}
"""Controls, which are probed like layers: the raw input, and the object's mask (0 or 1)."""
OBJECT_DEPTH = "object_depth"  # depth on object pixels


class Target(NamedTuple):
    """What is read from a layer: its ``maps``, by the names in `truth`, and the mask ``where`` they
    are compared."""

    title: str
    maps: tuple[str, ...]
    where: str = "object"


Targets = Mapping[str, Target]
LINEAR: Targets = {
    "edges": Target("edges", ("edges",), "image"),
    "depth": Target("depth, whole image", ("depth",), "image"),
    OBJECT_DEPTH: Target("depth, object", ("depth",)),
    "distance": Target("depth in mm, object", ("depth_mm",)),
    "phase": Target("wrapped phase", ("sine", "cosine")),
    "order": Target("fringe order", ("order",)),
}
"""Of the linear probes, each of which is fitted where it is compared; the phase is an angle and so
has two maps."""
FRINGE = ("phase", "order")
"""Targets that need fringes of a single direction."""
SPATIAL: Targets = {name: LINEAR[name] for name in ("edges", "depth", OBJECT_DEPTH)}
"""Of the four-convolution probes, which are trained on the maps of the whole image."""

Networks = Mapping[tuple[str, int], nn.Module]
"""By `TRAINED` or `UNTRAINED`, and the seed of the weights."""
Source = tuple[str, int, str]
"""What is probed: a network's name, the seed of its weights, and a layer."""
MEAN: Source = CONTROLS, 0, "mean"
"""Predicting each target's mean over the training samples, the reference."""
Maps = Mapping[Source, Tensor]
Errors = dict[tuple[Source, str, int], list[float]]
"""Squared error of each validation sample, by what was probed, target and seed of the probe."""
Score = dict[str, Any]
"""``mse``: mean over samples and seeds. ``mse_of_mean``: error of predicting the training samples'
mean everywhere. ``r2`` = 1 - mse / mse_of_mean: 1 is perfect, 0 is no better than the mean.
``r2_interval``: 95%, resampled over objects, to first order for it is a ratio of two means.
``seeds``: r2 of each seed."""
Scores = dict[str, dict[str, dict[str, Score]]]
"""By `TRAINED`, `UNTRAINED` or `CONTROLS`, then layer, then target."""


class LinearProbing(Probe):
    """Probes on frozen activations, trained on the training split and validated on the validation
    split."""

    name = "linear"
    title = "Linear probing"
    question = "What can be read from each layer: edges, depth, the fringe's phase, its order?"
    without_network = "it has no layers to probe"
    version = 3

    def run(
        self, subject: Subject, dataset: DatasetFolder, settings: ProbeSettings, progress: Progress
    ) -> Finding:
        train = settings.choose(_samples_with_object(dataset, "train"), SAMPLES, QUICK_SAMPLES)
        validation = settings.choose(_samples_with_object(dataset, "validation"))
        seeds = settings.seeds or (1 if settings.quick else SEEDS)
        epochs = QUICK_EPOCHS if settings.quick else EPOCHS
        total, done = (len(train) + len(validation)) * 2 + epochs * len(train), 0

        def tick(samples: int, activity: str) -> None:
            nonlocal done
            done += samples
            progress(done, total, activity)

        network, untrained = subject.networks()
        networks = {(TRAINED, 0): network} | {
            (UNTRAINED, seed): untrained(seed) for seed in range(seeds)
        }
        targets = {
            name: target
            for name, target in LINEAR.items()
            if subject.direction != "both" or name not in FRINGE
        }
        linear = scores(
            LinearProbes(subject, dataset, targets, tick).errors(networks, train, validation),
            validation,
        )
        # A linear probe of constant features is the mean itself.
        if not any(target["r2"] for layer in linear[TRAINED].values() for target in layer.values()):
            layers = ", ".join(subject.layer_names)
            return Finding(
                skipped=(
                    f"every probed layer of {subject.name} ({layers}) is constant, so it holds "
                    f"nothing."
                )
            )
        # Each seed of the untrained network costs another forward pass per batch, so there is one.
        first = {key: model for key, model in networks.items() if key[1] == 0}
        probes = ConvolutionProbes(subject, dataset, SPATIAL, tick, seeds, epochs)
        spatial = scores(probes.errors(first, train, validation), validation)
        sizes = {"training_samples": len(train), "validation_samples": len(validation)}
        protocol = {**sizes, "seeds": seeds, "epochs": epochs}
        values = {"protocol": protocol, "four_convolutions": spatial, "linear": linear}
        return Finding(summary(linear, spatial), values, table(spatial), draw(linear))


def _samples_with_object(dataset: DatasetFolder, split: str) -> list[str]:
    names = [name for name in dataset.samples(split) if object_mask(dataset.depth_mm(name)).any()]
    if not names:
        raise DiagnosisError(
            f"{dataset.path}: split {split} holds no object; probes need training and validation "
            f"data"
        )
    return names


def at_size(features: Tensor, side: tuple[int, int]) -> Tensor:
    """Activations (B, C, h, w) resized to a new tensor ``(B, C, *side)``: area means to shrink,
    bilinear to enlarge."""
    if features.shape[2] >= side[0] and features.shape[3] >= side[1]:
        return functional.adaptive_avg_pool2d(features, side)
    return functional.interpolate(features, size=side, mode="bilinear", align_corners=False)


def at_pixels(features: Tensor, pixels: Tensor, size: tuple[int, int]) -> Tensor:
    """Activations (B, C, h, w) at ``pixels`` (B, P), flat indices into an image of ``size``: (B, C,
    1, P); those of layers of another size are interpolated bilinearly between their pixel
    centres."""
    if tuple(features.shape[2:]) == size:
        return features.flatten(2).gather(2, pixels[:, None].expand(-1, features.shape[1], -1))[
            :, :, None
        ]
    rows, columns = pixels // size[1], pixels % size[1]
    position = torch.stack(
        [(2 * columns + 1) / size[1] - 1, (2 * rows + 1) / size[0] - 1], dim=-1
    ).to(features.dtype)
    return functional.grid_sample(
        features, position[:, None], "bilinear", "border", align_corners=False
    )


class NormalEquations:
    """Sums of products of N observations of C features and T targets, float64."""

    def __init__(self, features: int, targets: int) -> None:
        self.count = 0
        self.inner = torch.zeros(features + 1, features + 1, dtype=torch.float64)
        self.cross = torch.zeros(features + 1, targets, dtype=torch.float64)

    def add(self, features: Tensor, targets: Tensor) -> None:
        """Add observations (N, C) and their targets (N, T)."""
        augmented = functional.pad(features.double(), (0, 1), value=1.0)
        self.count += len(augmented)
        self.inner += augmented.T @ augmented
        self.cross += augmented.T @ targets.double()

    @property
    def target_mean(self) -> Tensor:
        """Mean of the targets, (T,)."""
        return self.cross[-1] / self.count

    def standard(self, least_spread: float = 1e-9) -> tuple[Tensor, Tensor]:
        """Mean and 1 / standard deviation of each feature, (C,); 0 for a constant one, which
        removes it. Constant: its spread is below ``least_spread``, relative to 1 plus its mean."""
        mean = self.inner[-1, :-1] / self.count
        spread = (self.inner.diagonal()[:-1] / self.count - mean * mean).clamp(min=0).sqrt()
        return mean, torch.where(
            spread > least_spread * (1 + mean.abs()), 1 / spread, torch.zeros_like(spread)
        )

    def solve(self, strength: float = RIDGE) -> Tensor:
        """Weights (C + 1, T) float64, the last row the bias, of least squared error plus
        ``strength`` times N times the squared weights of standardised features; the bias is
        free."""
        (mean, factor), target = self.standard(), self.target_mean
        inner = (self.inner[:-1, :-1] / self.count - torch.outer(mean, mean)) * torch.outer(
            factor, factor
        )
        cross = (self.cross[:-1] / self.count - torch.outer(mean, target)) * factor[:, None]
        inner.diagonal().add_(strength)
        weight = torch.linalg.solve(inner, cross) * factor[:, None]
        return torch.cat([weight, (target - mean @ weight)[None]])


def apply(weights: Tensor, features: Tensor) -> Tensor:
    """Predictions (..., T) float64 of a solved probe for features (..., C)."""
    return functional.pad(features.double(), (0, 1), value=1.0) @ weights


@dataclass(eq=False)
class LinearProbes:
    """Probes of all ``targets`` for all sources together: a weight per channel, the same at every
    pixel. They see pixels drawn from each sample over the image and then within its object, the
    same for every network, as maps (B, C, 1, 2 P). ``tick`` is called with the number of samples
    just looked at and the activity. ``seeds`` and ``epochs`` are those of `ConvolutionProbes`."""

    subject: Subject
    dataset: DatasetFolder
    targets: Targets
    tick: Callable[[int, str], None]
    seeds: int = 1
    epochs: int = 0
    batch: ClassVar[int | None] = None  # samples at once, None for as many as the subject's

    def __post_init__(self) -> None:
        self.maps = list(
            dict.fromkeys(name for target in self.targets.values() for name in target.maps)
        )
        self.equations: dict[tuple[Source, str], NormalEquations] = {}

    def errors(self, networks: Networks, train: Sequence[str], validation: Sequence[str]) -> Errors:
        """Errors on the samples ``validation`` of probes that are fitted to the samples ``train``,
        and `MEAN`'s."""
        for features, true in self.batches(networks, train, "statistics of the activations"):
            self.observe(features, true)
        self.start(len(train))
        for epoch in range(self.epochs):
            shuffled = [
                train[index] for index in np.random.default_rng([1, epoch]).permutation(len(train))
            ]
            for features, true in self.batches(networks, shuffled, "training probes"):
                self.step(features, true)
        errors: Errors = defaultdict(list)
        for features, true in self.batches(networks, validation, "validating probes"):
            for key, sample_errors in self.errors_of_batch(features, true).items():
                errors[key] += sample_errors
        return errors

    def batches(
        self, networks: Networks, samples: Sequence[str], activity: str
    ) -> Iterator[tuple[dict[Source, Tensor], dict[str, Tensor]]]:
        """The controls and the activations of every layer (B, C, h, w), and the true maps and masks
        (B, 1, h, w)."""
        for names, fringe in self.subject.batches(self.dataset, samples, self.batch):
            reduce = partial(self.reduce, names=names)
            masks = np.stack(
                [[object_mask(self.dataset.depth_mm(name))] for name in names], dtype=np.float32
            )
            images = {INPUT: fringe, SILHOUETTE: torch.from_numpy(masks)}
            features = {(CONTROLS, 0, name): reduce(image) for name, image in images.items()}
            for network_key, network in networks.items():
                layers = self.subject.layers_of(network)
                by_layer = activations_of(network, layers, fringe, reduce, self.subject.name)
                features |= {
                    (*network_key, layer): activations for layer, activations in by_layer.items()
                }
            true = [self.true_maps(name) for name in names]
            yield features, {key: torch.cat([maps[key] for maps in true]) for key in true[0]}
            self.tick(len(names), activity)

    @cache  # noqa: B019
    def true_maps(self, name: str) -> dict[str, Tensor]:
        """The true maps of a sample where probes look, with the masks ``image`` and ``object``, (1,
        1, h, w); kept."""
        direction = "horizontal" if self.subject.direction == "both" else self.subject.direction
        maps = truth(self.dataset.depth_mm(name), self.dataset.rig, direction)
        reduced = {
            key: self.reduce(torch.from_numpy(true_map)[None, None], [name])
            for key, true_map in maps.items()
        }
        reduced["image"], reduced["object"] = self.masks(reduced["object"])
        return reduced

    @cache  # noqa: B019
    def drawn(self, name: str) -> Tensor:
        """Flat indices of a sample's pixels, (2 P,)."""
        split = self.dataset.split_of_sample(name)
        rng = np.random.default_rng(
            [list(self.dataset.splits).index(split), self.dataset.samples(split).index(name)]
        )
        mask = object_mask(self.dataset.depth_mm(name))
        over_image, inside = rng.integers(mask.size, size=PIXELS), np.flatnonzero(mask)
        return torch.from_numpy(
            np.concatenate([over_image, inside[rng.integers(inside.size, size=PIXELS)]])
        )

    def reduce(self, maps: Tensor, names: Sequence[str]) -> Tensor:
        """Maps (B, C, H, W) of the samples ``names`` where probes look, in a new tensor."""
        return at_pixels(
            maps, torch.stack([self.drawn(name) for name in names]), self.subject.image_size
        )

    def masks(self, share: Tensor) -> tuple[Tensor, Tensor]:
        """The places over the image and those within the object, whose mask is ``share`` there, (1,
        1, h, w)."""
        within = (torch.arange(2 * PIXELS) >= PIXELS).float().expand_as(share)
        return 1 - within, within

    def observe(self, features: Maps, true: Mapping[str, Tensor]) -> None:
        """Take in a batch, as of `batches`."""
        wanted = torch.cat([true[name] for name in self.maps], dim=1)
        for (source, maps), where in product(features.items(), ("image", "object")):
            inside = true[where][:, 0] > 0
            if (source, where) not in self.equations:
                self.equations[source, where] = NormalEquations(maps.shape[1], len(self.maps))
            self.equations[source, where].add(*(of.movedim(1, -1)[inside] for of in (maps, wanted)))

    def columns(self, name: str) -> list[int]:
        """Places of a target's maps among all."""
        return [self.maps.index(map_name) for map_name in self.targets[name].maps]

    def mean(self, name: str) -> Tensor:
        """Mean (T, 1, 1) of the maps of a target."""
        place = self.targets[name].where
        means = next(
            equations for (_, where), equations in self.equations.items() if where == place
        ).target_mean
        return means[self.columns(name)][:, None, None]

    def start(self, samples: int) -> None:
        """When all training samples, so many, were observed."""
        self.weights = {key: equations.solve() for key, equations in self.equations.items()}

    def step(self, features: Maps, true: Mapping[str, Tensor]) -> None:
        """One training step on a batch, as of `batches`; none for a closed form."""

    def predictions(self, features: Maps, name: str) -> dict[tuple[Source, int], Tensor]:
        """The maps (B, T, h, w) of a target, by source and seed of the probe."""
        columns, where = self.columns(name), self.targets[name].where
        return {
            (source, 0): apply(
                self.weights[source, where][:, columns], maps.movedim(1, -1)
            ).movedim(-1, 1)
            for source, maps in features.items()
        }

    @torch.no_grad()
    def errors_of_batch(self, features: Maps, true: Mapping[str, Tensor]) -> Errors:
        """Mean squared error on each sample of a batch, by source, target, and seed; with
        `MEAN`'s."""
        errors = {}
        for name, target in self.targets.items():
            maps, mask = (
                torch.cat([true[map_name] for map_name in target.maps], dim=1).double(),
                true[target.where],
            )
            for (source, seed), predicted in {
                (MEAN, 0): self.mean(name),
                **self.predictions(features, name),
            }.items():
                square = (predicted - maps).square().mean(1, keepdim=True) * mask
                errors[source, name, seed] = (square.sum((1, 2, 3)) / mask.sum((1, 2, 3))).tolist()
        return errors


def grid_of(size: tuple[int, int]) -> tuple[int, int]:
    """Grid points (h, w) for images of ``size``: one for 4 x 4 px up to 480 px, for 8 x 8 px at
    960."""
    step = max(SHARE, -(-max(size) // LONGEST))
    return max(1, size[0] // step), max(1, size[1] // step)


class ConvolutionProbe(nn.Module):
    """Four convolutions from activations (B, C, h, w) to a target (B, 1, h, w); untrained they give
    ``target_mean``. The first is narrow so that layers of 8 and of 1024 channels get probes of
    similar capacity. The receptive field is 5 x 5 grid points."""

    def __init__(self, observed: NormalEquations, target_mean: float) -> None:
        super().__init__()
        self.mean, self.factor = (part.float()[:, None, None] for part in observed.standard(1e-6))
        self.body = nn.Sequential(
            nn.Conv2d(len(self.mean), WIDTH, 1),
            nn.ReLU(),
            nn.Conv2d(WIDTH, WIDTH, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(WIDTH, WIDTH, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(WIDTH, 1, 1),
        )
        last = self.body[-1]
        nn.init.zeros_(last.weight)  # type: ignore[arg-type]
        nn.init.constant_(last.bias, target_mean)  # type: ignore[arg-type]

    def forward(self, features: Tensor) -> Tensor:
        return self.body((features - self.mean) * self.factor)


class ConvolutionProbes(LinearProbes):
    """Four-convolution probes on a coarse grid (B, C, h, w), trained together with Adam and cosine
    decay over ``epochs``; ``seeds``: how many each layer gets, of random weights one."""

    batch = BATCH

    def reduce(self, maps: Tensor, names: Sequence[str]) -> Tensor:
        return at_size(maps, grid_of(self.subject.image_size))

    def masks(self, share: Tensor) -> tuple[Tensor, Tensor]:
        # Cells across the outline mix depth with background; of a tiny object those with the
        # largest share count.
        return torch.ones_like(share), (share == share.max()).float()

    def start(self, samples: int) -> None:
        self.probes: dict[tuple[Source, str, int], ConvolutionProbe] = {}
        for (source, where), target in product(self.equations, self.maps):
            seeds = 0 if where == "object" else 1 if source[0] == UNTRAINED else self.seeds
            for seed in range(seeds):
                with torch.random.fork_rng(devices=[]):
                    torch.manual_seed(seed)
                    probe = ConvolutionProbe(
                        self.equations[source, where], float(self.mean(target))
                    )
                self.probes[source, target, seed] = probe
        parameters = [
            parameter for probe in self.probes.values() for parameter in probe.parameters()
        ]
        self._optimiser = torch.optim.Adam(parameters, lr=LEARNING_RATE, foreach=True)
        steps = max(1, self.epochs * -(-samples // BATCH))
        self._schedule = torch.optim.lr_scheduler.CosineAnnealingLR(self._optimiser, steps)

    def step(self, features: Maps, true: Mapping[str, Tensor]) -> None:
        self._optimiser.zero_grad(set_to_none=True)
        for (source, target, _), probe in self.probes.items():
            # One backward pass per probe: a graph of all probes would hold every intermediate map
            # at once.
            functional.mse_loss(probe(features[source]), true[target]).backward()
        self._optimiser.step()
        self._schedule.step()

    def predictions(self, features: Maps, name: str) -> dict[tuple[Source, int], Tensor]:
        (target,) = self.targets[name].maps
        return {
            (source, seed): probe(features[source])
            for (source, of, seed), probe in self.probes.items()
            if of == target
        }


def scores(errors: Errors, validation: Sequence[str]) -> Scores:
    """Scores of probes from their errors on the samples ``validation``, of all seeds together."""
    of_seeds = defaultdict(list)
    for ((network, seed, layer), target, _), values in errors.items():
        if (network, seed, layer) != MEAN:
            of_seeds[network, layer, target].append(values)
    objects = [split_sample_name(name)[0] for name in validation]
    by_network: Scores = {TRAINED: {}, UNTRAINED: {}, CONTROLS: {}}
    for (network, layer, target), columns in of_seeds.items():
        by_network[network].setdefault(layer, {})[target] = score(
            columns, errors[MEAN, target, 0], objects
        )
    return by_network


def score(
    errors: Sequence[Sequence[float]], reference: Sequence[float], objects: Sequence[str]
) -> Score:
    """`Score` of ``errors`` (seeds, samples), squared, against those of the mean, ``reference``
    (samples,). Raises ``ValueError`` where the reference error is 0, so for a constant target."""
    table = np.asarray(errors, dtype=np.float64)
    mean_error = float(np.mean(reference))
    if not mean_error > 0:
        raise ValueError("the target is constant, so there is nothing to explain")
    sample_means = table.mean(axis=0)
    mse = float(sample_means.mean())
    r2 = 1 - mse / mean_error
    # To first order, r2 of a resample differs by -mean(sample_means - (1 - r2) reference) /
    # mean_error. Large objects have large errors in both terms, which cancels.
    deviation = object_interval(
        ((sample_means - (1 - r2) * np.asarray(reference)) / mean_error).tolist(), objects
    )
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
    mask = {
        target: f"{probe_score['r2']:.2f}"
        for target, probe_score in spatial[CONTROLS][SILHOUETTE].items()
    }
    text = (
        f"On average over layers R2 is {edges} for edges (from the object's mask alone: "
        f"{mask['edges']}), {depth} for "
        f"depth (mask: {mask['depth']}) and {on_object} for depth on object pixels (mask: "
        f"{mask[OBJECT_DEPTH]}, random "
        f"weights: {mean_over(spatial[UNTRAINED], OBJECT_DEPTH):.2f})."
    )
    if "phase" in linear[CONTROLS][INPUT]:
        phase = {layer: scores["phase"]["r2"] for layer, scores in linear[TRAINED].items()}
        best, last = max(phase, key=phase.__getitem__), list(phase)[-1]
        text += (
            f" Linear probes read the wrapped phase best from {best} (R2 {phase[best]:.2f}); from "
            f"the last layer, "
            f"{last}, they reach R2 {phase[last]:.2f} (random weights: "
            f"{linear[UNTRAINED][last]['phase']['r2']:.2f})."
        )
    return text


def table(spatial: Scores) -> Table:
    """The paper's table, with its ratio of depth's MSE to edges', and the same probes as shares of
    variance."""
    trained = spatial[TRAINED]

    def row(layers: Mapping[str, Mapping[str, Score]], layer: str | None = None) -> dict[str, Any]:
        """Means over ``layers``, with the interval of a ``layer``."""
        mse = {f"mse {key}": mean_over(layers, key, "mse") for key in SPATIAL}
        intervals = {key: layers[layer][key]["r2_interval"] if layer else None for key in SPATIAL}
        r2 = {
            f"r2 {key}": {"r": mean_over(layers, key), "interval": ends}
            for key, ends in intervals.items()
        }
        return {**mse, **r2}

    rows = {layer: row({layer: targets}, layer) for layer, targets in trained.items()}
    rows |= {"average": row(trained), "average, random weights": row(spatial[UNTRAINED])}
    rows |= {
        CONTROL_TITLES[name]: row({name: targets}) for name, targets in spatial[CONTROLS].items()
    }
    rows["predicting the mean"] = {
        f"mse {key}": mean_over(trained, key, "mse_of_mean") for key in SPATIAL
    }
    for numbers in rows.values():
        numbers["ratio"] = numbers["mse depth"] / numbers["mse edges"]
    columns = {f"mse {key}": f"MSE, {target.title}" for key, target in SPATIAL.items()}
    columns |= {"ratio": "Ratio depth / edges"}
    columns |= {f"r2 {key}": f"R2, {target.title}" for key, target in SPATIAL.items()}
    return table_of("Four-convolution probes on the validation samples", "Layer", rows, columns)


@styled
def draw(linear: Scores) -> Figure:
    """R2 of the linear probes by layer, a panel for each target: trained, with intervals, random
    weights with the range of seeds, and controls."""
    targets, layers = list(linear[CONTROLS][INPUT]), list(linear[TRAINED])
    drawn, panels_of = panels([LINEAR[target].title for target in targets], 3, 4.4, 3.0)
    for axes, target in zip(panels_of, targets, strict=True):
        for label, network, style, ends, colour in (
            ("trained", TRAINED, "o-", "r2_interval", LINE_COLOURS[0]),
            ("random weights", UNTRAINED, "s--", "seeds", LINE_COLOURS[6]),
        ):
            scores = [linear[network][layer][target] for layer in layers]
            axes.plot(
                layers,
                [probe_score["r2"] for probe_score in scores],
                style,
                color=colour,
                label=label,
                **LINE,
            )
            for layer, probe_score in zip(layers, scores, strict=True):
                axes.plot(
                    [layer] * len(probe_score[ends] or ()),
                    probe_score[ends] or (),
                    color=colour,
                    linewidth=0.8,
                )
        for (control, label), style in zip(CONTROL_TITLES.items(), (":", "-."), strict=True):
            level = [linear[CONTROLS][control][target]["r2"]] * len(layers)
            axes.plot(layers, level, style, color=INK, label=label, **LINE)
        axes.set(ylabel="R2", ylim=(-0.1, 1.02))
    alt = "R2 of linear probes by layer, a panel for each target, with random weights and controls"
    return Figure("Linear (1 x 1) probes by layer and target", alt, with_legend(drawn, 2))
