"""Grad-CAM for regression (paper Section 7.2): which pixels of a layer's activations change the
mean prediction.

The heatmap of a layer is the ReLU of its channels' sum, each weighted by the mean gradient of the
mean predicted value with respect to that channel (Selvaraju et al. 2017), resized to the image. It
is correlated (Pearson, over all pixels) with the true depth's edges, the fringe's local standard
deviation and the object. As a sanity check (Adebayo et al. 2018) the heatmaps of random weights are
measured too: if they are the same, they do not depend on what was learned. The same is measured on
flat planes, as in the paper's Section 7.3.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from captum.attr import LayerAttribution, LayerGradCam
from numpy.typing import NDArray
from torch import Tensor, nn

from fpp_ml_bench.baselines.diagnostics.flat_plane import FACING, plane_scene, rectangle
from fpp_ml_bench.baselines.diagnostics.probe import (
    Figure,
    Finding,
    Probe,
    ProbeSettings,
    Progress,
    table_of,
    with_interval,
)
from fpp_ml_bench.baselines.diagnostics.scenes import SceneRenderer, edge_map
from fpp_ml_bench.baselines.diagnostics.subjects import Subject
from fpp_ml_bench.constants import split_sample_name
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.evaluation.score.uncertainty import mean_of, object_interval
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.paper import AVERAGE, paper_layers
from fpp_ml_bench.style import HEAT_COLOURS, Picture, gallery
from fpp_ml_bench.tables import Table

Image = NDArray[np.float32]
Mean = dict[str, Any]
"""``r``: mean of the correlations of so many ``samples``, and its 95% ``interval``, resampled over
objects; None where there is none."""
Correlations = Mapping[tuple[str, str], Mapping[int, Sequence[float | None]]]
"""Pearson's r of each sample, by column and layer, then by network: 0 is trained, others have
random weights."""

PAPER = "grad_cam"
SAMPLES = 30
"""Test samples whose heatmaps are compared, spread over objects: all 30 of the full set."""
QUICK_SAMPLES = 6
"""The same in a quick run."""
SEEDS = 2
"""Networks of random weights that the trained one is compared with. More narrow the comparison;
each takes as long as the trained one."""
PLANES = {"plane_0.5": 0.5, "plane_0.8": 0.8}
"""Facing rectangles by their side, as a share of the image's. Our UNet takes the first for an
object and the second, like the paper's its rectangle, for background."""
EDGES, FRINGES, OBJECT, OWN = "edges", "fringes", "object", "own"
"""References; `OWN` is the trained network's heatmap."""
RANDOM = "random_"
COLUMNS = {
    EDGES: "r(CAM, edges)",
    FRINGES: "r(CAM, fringes)",
    RANDOM + EDGES: "random weights: r(CAM, edges)",
    RANDOM + FRINGES: "random weights: r(CAM, fringes)",
    RANDOM + OWN: "random weights: r(CAM, trained CAM)",
    OBJECT: "r(CAM, object)",
    RANDOM + OBJECT: "random weights: r(CAM, object)",
}
"""Titles of what is said of each layer."""
_LEAST_SPREAD = 1e-12
"""Product of standard deviations and pixels below which a map counts as constant, and has no
correlation: rounding alone."""
_EXAMPLES = 3
"""Samples that the figure shows, spread over all: a row each."""


class GradCam(Probe):
    """Heatmaps of the test split against edges and fringes, for the network and for random
    weights."""

    name = "grad-cam"
    title = "Grad-CAM"
    question = "Which pixels change the mean prediction: those at edges, or those with fringes?"
    without_network = "it has no gradient to follow"
    version = 4

    def run(
        self, subject: Subject, dataset: DatasetFolder, settings: ProbeSettings, progress: Progress
    ) -> Finding:
        samples = settings.choose(dataset.samples("test"), SAMPLES, QUICK_SAMPLES)
        if not samples:
            raise DiagnosisError(
                f"{dataset.path}: split test holds no sample, which Grad-CAM needs"
            )
        seeds = settings.seeds or (1 if settings.quick else SEEDS)
        subject = replace(subject, layer_names=cam_layers(subject))
        means = measure(subject, dataset, samples, seeds, progress)
        if means["average"][EDGES]["r"] is None:
            layers = ", ".join(subject.layer_names)
            return Finding(
                skipped=f"the heatmaps of every layer of {subject.name} ({layers}) are constant."
            )
        protocol = {"samples": len(samples), "seeds": seeds}
        means["planes"] = {
            plane: measure(subject, dataset, [plane], seeds, progress)["layers"] for plane in PLANES
        }
        drawn = _draw_heatmaps(subject, dataset, samples)
        return Finding(
            summary(means), {"protocol": protocol, **means}, table(means, len(samples)), drawn
        )


def cam_layers(subject: Subject) -> tuple[str, ...]:
    """The paper's six layers where the subject has them, else all its probed layers."""
    six = tuple(name for name in subject.layer_names if name in paper_layers(PAPER))
    return six if set(six) | {AVERAGE} == set(paper_layers(PAPER)) else subject.layer_names


def heatmaps(
    network: nn.Module, layers: Mapping[str, nn.Module], fringe: Tensor
) -> dict[str, Image]:
    """Grad-CAM of the mean prediction by layer: float32 (B, H, W) at the size of ``fringe`` (B, 1,
    H, W). Raises `DiagnosisError` for a layer whose output is not (B, C, h, w) or does not reach
    the prediction."""
    heatmaps_by_layer = {}
    for name, layer in layers.items():
        cam = LayerGradCam(lambda x: network(x).mean(dim=(1, 2, 3)), layer)
        try:
            # The image requires a gradient, so that frozen weights have a graph.
            heat = cam.attribute(fringe.detach().requires_grad_(True))
        except (RuntimeError, AssertionError, IndexError, AttributeError, TypeError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise DiagnosisError(
                f"layer {name!r}: Grad-CAM failed ({reason}); leave it out"
            ) from None
        if not isinstance(heat, Tensor) or heat.dim() != 4:
            raise DiagnosisError(f"layer {name!r}: expected activations (B, C, h, w); leave it out")
        scaled = LayerAttribution.interpolate(heat, tuple(fringe.shape[2:]), "bilinear")
        heatmaps_by_layer[name] = scaled[:, 0].detach().clamp(min=0).numpy()  # type: ignore[index]
    return heatmaps_by_layer


def shown(subject: Subject, dataset: DatasetFolder, name: str) -> tuple[Tensor, dict[str, Any]]:
    """The input (1, 1, H, W) of a sample or of one of `PLANES`, and its maps (H, W): edges, the
    fringe's local standard deviation, and the object's mask."""
    if name in PLANES:
        renderer = SceneRenderer.of(dataset)
        scene = plane_scene(renderer, rectangle(renderer.shape, PLANES[name]), *FACING)
        frames = renderer.frames(scene, subject.frames_used, subject.uses_ground_truth_mask)
        depth_mm: NDArray = scene.depth_mm
    else:
        frames, depth_mm = subject.captured(dataset, name), dataset.depth_mm(name)
    # Image px per fringe period at the standoff; of horizontal fringes where the frame has no
    # direction.
    period_px = dataset.rig.image_px_per_period(
        "vertical" if subject.direction == "vertical" else "horizontal"
    )
    variation = fringe_variation(np.asarray(frames[subject.frames_used[0]]), period_px)
    maps = {EDGES: edge_map(depth_mm), FRINGES: variation, OBJECT: object_mask(depth_mm)}
    return subject.input_batch([frames]), maps


def fringe_variation(grey: NDArray[np.uint8], period_px: float) -> Image:
    """Standard deviation of a fringe image (H, W) over a square window of one period, in grey
    levels, float32. The window side is the smallest odd number of px that covers ``period_px``, at
    least 3; the border is mirrored."""
    side = max(3, 2 * int(np.ceil((period_px - 1) / 2)) + 1)
    image = np.asarray(grey, dtype=np.float64)
    mean, square = (
        cv2.blur(of, (side, side), borderType=cv2.BORDER_REFLECT_101)
        for of in (image, image * image)
    )
    return np.sqrt(np.maximum(square - mean * mean, 0)).astype(np.float32)


def correlation(first: NDArray, second: NDArray) -> float | None:
    """Pearson's r of two maps of the same shape over all pixels; None where either is constant."""
    a, b = (image.astype(np.float64).ravel() for image in (first, second))
    return None if a.std() * b.std() * a.size <= _LEAST_SPREAD else float(np.corrcoef(a, b)[0, 1])


def measure(
    subject: Subject,
    dataset: DatasetFolder,
    samples: Sequence[str],
    seeds: int,
    progress: Progress,
) -> dict[str, Any]:
    """`means_of` the correlations of every heatmap with the references, and of random weights'
    heatmaps with the trained ones."""
    network, untrained = subject.networks()
    networks = [network, *map(untrained, range(seeds))]
    correlations: dict[tuple[str, str], dict[int, list[float | None]]] = defaultdict(
        lambda: defaultdict(list)
    )
    edges_with_fringes: list[float | None] = []
    for done, name in enumerate(samples):
        fringe, compared = shown(subject, dataset, name)
        edges_with_fringes.append(correlation(compared[EDGES], compared[FRINGES]))
        own: dict[str, Image] = {}
        for number, one_network in enumerate(networks):
            heat = heatmaps(one_network, subject.layers_of(one_network), fringe)
            own = own or heat
            for layer in subject.layer_names:
                for target, reference in {**compared, OWN: own[layer]}.items():
                    column = f"{RANDOM}{target}" if number else target
                    correlations[column, layer][number].append(correlation(heat[layer], reference))
        progress(done + 1, len(samples), f"Grad-CAM of {name}")
    objects = [split_sample_name(name)[0] for name in samples]
    return means_of(correlations, subject.layer_names, objects) | {
        "edges_with_fringes": _mean([edges_with_fringes], objects)
    }


def means_of(
    correlations: Correlations, layers: Sequence[str], objects: Sequence[str]
) -> dict[str, Any]:
    """For ``diagnose.json``: `Mean` by layer and column, and of all layers, with the paper's ratio,
    correlation with edges over correlation with fringes, None where undefined; those of random
    weights are means over seeds."""

    def means(names: Sequence[str]) -> dict[str, Any]:
        return {
            column: _mean(
                [values for layer in names for values in correlations[column, layer].values()],
                objects,
            )
            for column in COLUMNS
        }

    rows, average = {layer: means([layer]) for layer in layers}, means(layers)
    for (
        column,
        mean,
    ) in average.items():  # as in the paper's bottom row, with an interval over samples
        mean["r"] = mean_of(row[column]["r"] for row in rows.values())
    for row in (*rows.values(), average):
        edges, fringes = row[EDGES]["r"], row[FRINGES]["r"]
        row["ratio"] = None if edges is None or not fringes else edges / fringes
    return {"layers": rows, "average": average}


def _mean(columns: Sequence[Sequence[float | None]], objects: Sequence[str]) -> Mean:
    """`Mean` over samples of each sample's mean over ``columns``."""
    values = [mean_of(of_sample) for of_sample in zip(*columns, strict=True)]
    interval = object_interval(values, objects)
    return {
        "r": mean_of(values),
        "interval": interval,
        "samples": sum(r is not None for r in values),
    }


def summary(means: Mapping[str, Any]) -> str:
    """The result in two sentences."""
    edges, fringes, random_edges, random_fringes, both = (
        with_interval(mean["r"])
        for mean in (
            *(means["average"][column] for column in list(COLUMNS)[:4]),
            means["edges_with_fringes"],
        )
    )
    return (
        f"Over the layers, heatmaps correlate with edges by {edges} (random weights: "
        f"{random_edges}) and with fringe "
        f"variation by {fringes} (random weights: {random_fringes}). Edges and fringe variation "
        f"themselves correlate "
        f"by {both}, because both are strong where the object is."
    )


def table(means: Mapping[str, Any], samples: int) -> Table:
    """The paper's table with random weights beside it."""
    rows = means["layers"] | {
        "average": means["average"],
        "edges with fringes": {EDGES: means["edges_with_fringes"]},
    }
    rows |= {
        f"{layer}, {plane}": row
        for plane, layers in means["planes"].items()
        for layer, row in layers.items()
    }
    title = f"Correlation of Grad-CAM over {samples} test samples"
    return table_of(title, "Layer", rows, COLUMNS | {"ratio": "Ratio edges / fringes"})


def _draw_heatmaps(subject: Subject, dataset: DatasetFolder, samples: Sequence[str]) -> Figure:
    network, rows = subject.networks()[0], {}
    examples = [
        samples[round(share * (len(samples) - 1))] for share in np.linspace(0, 1, _EXAMPLES)
    ]
    for name in dict.fromkeys([*examples, *PLANES]):
        fringe, maps = shown(subject, dataset, name)
        heat = heatmaps(network, subject.layers_of(network), fringe)
        rows[name] = [
            Picture(image) for image in (fringe[0, 0].numpy(), maps[EDGES], maps[FRINGES])
        ]
        rows[name] += [Picture(values[0], HEAT_COLOURS) for values in heat.values()]
    title, alt = (
        "Heatmaps, each scaled to its own largest value",
        "Input, edges, fringes and Grad-CAM by layer",
    )
    return Figure(title, alt, gallery(rows, ("input", EDGES, FRINGES, *subject.layer_names)))
