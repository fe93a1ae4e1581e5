"""Linear probing (paper Section 7.1), extended by a linear probe, the phase and order as targets, and controls."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fpp_ml_bench.baselines.diagnostics.activations import INPUT
from fpp_ml_bench.baselines.diagnostics.convolution_probe import BATCH, EPOCHS, WIDTH, grid_step
from fpp_ml_bench.baselines.diagnostics.probe import Finding, ProbeSettings, Progress, spread
from fpp_ml_bench.baselines.diagnostics.scores import (
    CONTROLS,
    TRAINED,
    UNTRAINED,
    Layers,
    Scores,
    mean_ratio,
    ratio,
    ratio_of_means,
    score,
)
from fpp_ml_bench.baselines.diagnostics.subjects import Subject
from fpp_ml_bench.constants import split_sample_name
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import DiagnosisError

if TYPE_CHECKING:
    from fpp_ml_bench.loaders.storage import DatasetFolder

SAMPLES, QUICK_SAMPLES, QUICK_EPOCHS = 120, 24, 4
"""Training samples of the probes, and training samples and epochs of a quick run."""
SEEDS = 2
PAPER_RATIO = 2.82


class LinearProbing:
    """Probes on frozen activations, trained on the training split and validated on the validation split."""

    name = "linear"
    title = "Linear probing"
    question = "What can be read from each layer: edges, depth, the fringe's phase, its order?"
    version = 1

    def applies_to(self, subject: Subject) -> str | None:
        if subject.network is None:
            return f"{subject.name} is a method without a network: it has no layers to probe."
        return None

    def run(
        self, subject: Subject, dataset: "DatasetFolder", settings: ProbeSettings, folder: Path, progress: Progress
    ) -> Finding:
        from fpp_ml_bench.baselines.diagnostics.linear_figures import draw
        from fpp_ml_bench.baselines.diagnostics.linear_tables import tables

        most_samples = settings.samples or (QUICK_SAMPLES if settings.quick else SAMPLES)
        train, validation = (
            _samples_with_object(dataset, "train", most_samples),
            _samples_with_object(dataset, "validation", settings.samples),
        )
        seeds = settings.seeds or (1 if settings.quick else SEEDS)
        epochs = QUICK_EPOCHS if settings.quick else EPOCHS
        linear, spatial = measure(subject, dataset, train, validation, seeds, epochs, progress)
        return Finding(
            self.name,
            self.title,
            summary(linear, spatial),
            {
                "protocol": {
                    "training_samples": len(train), "validation_samples": len(validation), "seeds": seeds,
                    "epochs": epochs, "batch": BATCH, "probe_width": WIDTH,
                    "image_px_a_grid_step": grid_step(subject.image_size),
                },
                "four_convolutions": _to_dict(spatial),
                "ratio": mean_ratio(spatial[TRAINED]),
                "ratio_of_means": ratio_of_means(spatial[CONTROLS][INPUT]),
                "linear": _to_dict(linear),
            },
            tables(linear, spatial),
            draw(linear, spatial, folder),
        )  # fmt: skip


def measure(
    subject: Subject, dataset: "DatasetFolder", train: Sequence[str], validation: Sequence[str], seeds: int,
    epochs: int, progress: Progress,
) -> tuple[Scores, Scores]:  # fmt: skip
    """Scores of the linear and the four-convolution probes: network, ``seeds`` untrained copies, and controls."""
    from fpp_ml_bench.baselines.diagnostics import linear_measure as measuring

    network, untrained = subject.network, subject.untrained
    if network is None or untrained is None:
        raise DiagnosisError(f"{subject.name}: has no network to probe")
    objects = [split_sample_name(name)[0] for name in validation]
    total = (len(train) + len(validation)) * (2 + seeds) + epochs * len(train)
    done = 0

    def tick(samples: int, activity: str) -> None:
        nonlocal done
        done += samples
        progress(done, total, activity)

    targets = [name for name in measuring.TARGETS if subject.direction != "both" or name not in measuring.FRINGE]
    pixels = measuring.Pixels(subject, dataset, targets)
    linear: Scores = {TRAINED: {}, UNTRAINED: {}, CONTROLS: {}}
    errors, reference = measuring.linear_errors(subject, network, pixels, train, validation, True, tick)
    for (layer, target), sample_errors in errors.items():
        source = CONTROLS if layer in (INPUT, measuring.POSITION) else TRAINED
        linear[source].setdefault(layer, {})[target] = score([sample_errors], reference[target], objects)
    random_errors = [
        measuring.linear_errors(subject, untrained(seed), pixels, train, validation, False, tick)[0]
        for seed in range(seeds)
    ]
    for layer, target in random_errors[0]:
        seed_errors = [sample_errors[layer, target] for sample_errors in random_errors]
        linear[UNTRAINED].setdefault(layer, {})[target] = score(seed_errors, reference[target], objects)
    networks = {TRAINED: network, UNTRAINED: untrained(0)}
    # Each seed of the untrained network costs another forward pass per batch, so there is one.
    seed_counts = {TRAINED: seeds, INPUT: seeds, UNTRAINED: 1}
    spatial_errors, reference = measuring.spatial_errors(
        subject, networks, dataset, train, validation, seed_counts, epochs, tick
    )
    spatial: Scores = {TRAINED: {}, UNTRAINED: {}, CONTROLS: {}}
    for source, layer, target in dict.fromkeys(key[:3] for key in spatial_errors):
        seed_errors = [spatial_errors[source, layer, target, seed] for seed in range(seed_counts[source])]
        layer_scores = spatial[CONTROLS if source == INPUT else source].setdefault(layer, {})
        layer_scores[target] = score(seed_errors, reference[target], objects)
    return linear, spatial


def summary(linear: Scores, spatial: Scores) -> str:
    """The result in a few sentences."""
    trained, raw = spatial[TRAINED], spatial[CONTROLS][INPUT]
    edges, depth = (float(np.mean([layer[target].r2 for layer in trained.values()])) for target in ("edges", "depth"))
    easier = "edges" if edges > depth else "depth"
    parts = [
        f"The paper's ratio, depth MSE over edge MSE, is {mean_ratio(trained):.2f} (paper: {PAPER_RATIO}). The raw "
        f"input alone gives {ratio(raw):.2f}, and a probe that predicts each target's mean {ratio_of_means(raw):.2f}, "
        "because the two errors have different units. As a share of the explained variance, "
        f"{easier} {'are' if easier == 'edges' else 'is'} easier to read on average over layers (R2 {edges:.2f} for "
        f"edges, {depth:.2f} for depth)."
    ]
    if "phase" in linear[CONTROLS][INPUT]:
        best, last = _best(linear[TRAINED], "phase"), list(linear[TRAINED])[-1]
        last_r2, random = linear[TRAINED][last]["phase"].r2, linear[UNTRAINED][last]["phase"].r2
        parts.append(
            f"Linear probes read the wrapped phase best from {best[0]} (R2 {best[1]:.2f}). From the last layer, "
            f"{last}, they reach R2 {last_r2:.2f}; with random weights {random:.2f}."
        )
    return " ".join(parts)


def _best(layers: Layers, target: str) -> tuple[str, float]:
    return max(((layer, scores[target].r2) for layer, scores in layers.items()), key=lambda pair: pair[1])


def _to_dict(scores: Scores) -> dict[str, Any]:
    return {
        source: {
            layer: {target: target_score.to_dict() for target, target_score in targets.items()}
            for layer, targets in layers.items()
        }
        for source, layers in scores.items()
    }


def _samples_with_object(dataset: "DatasetFolder", split: str, limit: int | None) -> list[str]:
    """At most ``limit`` samples of ``split`` that show an object. Raises `DiagnosisError` where there is none."""
    names = [name for name in dataset.samples(split) if object_mask(dataset.depth_mm(name)).any()]
    if not names:
        raise DiagnosisError(f"{dataset.path}: split {split} holds no object; probes need training and validation data")
    return spread(names, limit)
