"""Linear probing (paper Section 7.1), with a truly linear probe, the phase, and the controls besides."""

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
from fpp_ml_bench.baselines.diagnostics.subject import Subject
from fpp_ml_bench.constants import split_sample_name
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.pixel_sets import object_mask

if TYPE_CHECKING:
    from fpp_ml_bench.loaders.store import DatasetFolder

SAMPLES, QUICK_SAMPLES, QUICK_EPOCHS = 120, 24, 4
"""Training samples that the probes learn from, and how many for a quick look."""
SEEDS = 2
PAPER_RATIO = 2.82


class LinearProbing:
    """Probes on frozen activations, learnt from the training split and judged on the validation split."""

    name = "linear"
    title = "Linear probing"
    question = "What can be read from each layer: edges, depth, the fringe's phase, its order?"
    version = 1

    def applies_to(self, subject: Subject) -> str | None:
        if subject.network is None:
            return f"{subject.name} is a method without a network: it has no layers to read from."
        return None

    def run(
        self, subject: Subject, dataset: "DatasetFolder", settings: ProbeSettings, folder: Path, progress: Progress
    ) -> Finding:
        from fpp_ml_bench.baselines.diagnostics.linear_figures import draw
        from fpp_ml_bench.baselines.diagnostics.linear_tables import tables

        wanted = settings.samples or (QUICK_SAMPLES if settings.quick else SAMPLES)
        train, validation = _able(dataset, "train", wanted), _able(dataset, "validation", settings.samples)
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
                "four_convolutions": _plain(spatial),
                "ratio": mean_ratio(spatial[TRAINED]),
                "ratio_of_means": ratio_of_means(spatial[CONTROLS][INPUT]),
                "linear": _plain(linear),
            },
            tables(linear, spatial),
            draw(linear, spatial, folder),
        )  # fmt: skip


def measure(
    subject: Subject, dataset: "DatasetFolder", train: Sequence[str], validation: Sequence[str], seeds: int,
    epochs: int, progress: Progress,
) -> tuple[Scores, Scores]:  # fmt: skip
    """Scores of the linear and of the four-convolution probes; the network, ``seeds`` untrained ones, the controls."""
    from fpp_ml_bench.baselines.diagnostics import linear_measure as measuring

    network, untrained = subject.network, subject.untrained
    if network is None or untrained is None:
        raise DiagnosisError(f"{subject.name}: has no network to probe")
    objects = [split_sample_name(name)[0] for name in validation]
    # A pass of an untrained network beside the trained one costs a spatial step about as much again.
    total = (len(train) + len(validation)) * (2 + seeds) + epochs * len(train)
    done = 0

    def tick(samples: int, doing: str) -> None:
        nonlocal done
        done += samples
        progress(done, total, doing)

    targets = [name for name in measuring.TARGETS if subject.direction != "both" or name not in measuring.FRINGE]
    pixels = measuring.Pixels(subject, dataset, targets)
    linear: Scores = {TRAINED: {}, UNTRAINED: {}, CONTROLS: {}}
    errors, reference = measuring.linear_errors(subject, network, pixels, train, validation, True, tick)
    for (layer, target), found in errors.items():
        who = CONTROLS if layer in (INPUT, measuring.POSITION) else TRAINED
        linear[who].setdefault(layer, {})[target] = score([found], reference[target], objects)
    others = [
        measuring.linear_errors(subject, untrained(seed), pixels, train, validation, False, tick)[0]
        for seed in range(seeds)
    ]
    for layer, target in others[0]:
        each = [found[layer, target] for found in others]
        linear[UNTRAINED].setdefault(layer, {})[target] = score(each, reference[target], objects)
    networks = {TRAINED: network, UNTRAINED: untrained(0)}
    # A seed of the untrained network costs a pass more for every batch: one tells what the four convolutions do alone.
    often = {TRAINED: seeds, INPUT: seeds, UNTRAINED: 1}
    missed, reference = measuring.spatial_errors(subject, networks, dataset, train, validation, often, epochs, tick)
    spatial: Scores = {TRAINED: {}, UNTRAINED: {}, CONTROLS: {}}
    for who, layer, target in dict.fromkeys(key[:3] for key in missed):
        each = [missed[who, layer, target, seed] for seed in range(often[who])]
        place = spatial[CONTROLS if who == INPUT else who].setdefault(layer, {})
        place[target] = score(each, reference[target], objects)
    return linear, spatial


def summary(linear: Scores, spatial: Scores) -> str:
    """Two or three sentences that a reader can take away."""
    trained, raw = spatial[TRAINED], spatial[CONTROLS][INPUT]
    edges, depth = (float(np.mean([layer[target].r2 for layer in trained.values()])) for target in ("edges", "depth"))
    easier = "edges" if edges > depth else "depth"
    parts = [
        f"The paper's ratio, depth MSE over edge MSE, is {mean_ratio(trained):.2f} (paper: {PAPER_RATIO}); but the raw "
        f"input alone gives {ratio(raw):.2f}, and a probe that predicts each target's mean {ratio_of_means(raw):.2f}: "
        "the two errors have different units. As a share of what there is to explain, "
        f"{easier} {'are' if easier == 'edges' else 'is'} better readable on average over layers (R2 {edges:.2f} for "
        f"edges, {depth:.2f} for depth)."
    ]
    if "phase" in linear[CONTROLS][INPUT]:
        best, last = _best(linear[TRAINED], "phase"), list(linear[TRAINED])[-1]
        last_r2, random = linear[TRAINED][last]["phase"].r2, linear[UNTRAINED][last]["phase"].r2
        parts.append(
            f"Linearly, the wrapped phase is best read in {best[0]} (R2 {best[1]:.2f}) and in the last layer, {last}, "
            f"with R2 {last_r2:.2f}, where a network with random weights has {random:.2f}."
        )
    return " ".join(parts)


def _best(layers: Layers, target: str) -> tuple[str, float]:
    return max(((layer, scores[target].r2) for layer, scores in layers.items()), key=lambda pair: pair[1])


def _plain(scores: Scores) -> dict[str, Any]:
    return {
        who: {layer: {target: one.to_dict() for target, one in found.items()} for layer, found in layers.items()}
        for who, layers in scores.items()
    }


def _able(dataset: "DatasetFolder", split: str, limit: int | None) -> list[str]:
    """Samples of ``split`` with an object, at most ``limit``. Raises `DiagnosisError` where there is none."""
    found = [name for name in dataset.samples(split) if object_mask(dataset.depth_mm(name)).any()]
    if not found:
        raise DiagnosisError(f"{dataset.path}: split {split} holds no object; probes need training and validation data")
    return spread(found, limit)
