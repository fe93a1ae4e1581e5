"""Grad-CAM on the flat plane (the paper's figure beside Section 7.3): does a layer attend to the plane's fringes?

A heatmap that is the same everywhere has the plane's share of the area within it. Random weights stand beside: a
heatmap may follow the brighter fringes of a near plane without having learnt anything.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics.grad_cam import cam_layers, heatmaps
from fpp_ml_bench.baselines.diagnostics.probe import Cell, Figure, Sheet, Table
from fpp_ml_bench.baselines.diagnostics.subjects import Subject
from fpp_ml_bench.paper import LAYERS

TRAINED, UNTRAINED = "trained", "untrained"
Heat = Mapping[str, Mapping[str, NDArray[np.float32]]]


def plane_heat(subject: Subject, frame: NDArray[np.uint8]) -> Heat:
    """Heatmaps float32 (H, W) of an image by `TRAINED` or `UNTRAINED` weights and by layer, after the ReLU. Raises
    `DiagnosisError` as `grad_cam.heatmaps`."""
    network, untrained = subject.networks()
    stack: list[NDArray[np.uint8] | None] = [None] * (subject.frames_used[0] + 1)
    stack[subject.frames_used[0]] = frame
    fringe, found = subject.input_batch([stack]), {}
    for weights, one in ((TRAINED, network), (UNTRAINED, untrained(0))):
        layers = {name: layer for name, layer in subject.layers_of(one).items() if name in cam_layers(subject)}
        found[weights] = {name: heat[0].clamp(min=0).numpy() for name, heat in heatmaps(one, layers, fringe).items()}
    return found


def shares_within(heat: Heat, mask: NDArray[np.bool_]) -> dict[str, Any]:
    """``area``: the share of ``mask`` (H, W) in the image; for each layer the share of its heat within the mask, None
    where it has no heat at all."""
    shares: dict[str, Any] = {"area": float(mask.mean())}
    for weights, layers in heat.items():
        totals = {name: float(values.sum(dtype=np.float64)) for name, values in layers.items()}
        shares[weights] = {
            name: float(values[mask].sum(dtype=np.float64)) / totals[name] if totals[name] > 0 else None
            for name, values in layers.items()
        }
    return shares


def attention_table(shares: Mapping[str, Any]) -> Table:
    """A row per layer."""
    rows: list[Sequence[Cell]] = [
        (
            f"{layer} (paper's {LAYERS[layer]})" if LAYERS.get(layer, layer) != layer else layer,
            share,
            shares[UNTRAINED][layer],
        )
        for layer, share in shares[TRAINED].items()
    ]
    title = f"Grad-CAM on the rectangle at 1.8 m, which covers {shares['area']:.0%} of the image: heat within it"
    return Table(title, ("Layer", "Share", "Random weights"), rows)


def draw_attention(frame: NDArray[np.uint8], heat: Heat, folder: Path) -> Figure:
    """The paper's figure, and the same with random weights."""
    layers = list(heat[TRAINED])
    sheet = Sheet(2, 1 + len(layers), 1.5 * (1 + len(layers)), 3.4)
    for axes, weights in zip(sheet.axes, (TRAINED, UNTRAINED), strict=True):
        sheet.picture(axes[0], frame, "input", "gray", 0, 255)
        axes[0].set_ylabel(weights, fontsize=7)
        for axis, layer in zip(axes[1:], layers, strict=True):
            values = heat[weights][layer]
            sheet.picture(axis, values, layer, "inferno", 0, float(values.max()) or 1.0)
    alt = "Grad-CAM by layer on a plane with an outline, with trained and with random weights"
    return sheet.save(folder, "flat_plane_attention.png", "Grad-CAM on the plane, each to its own largest value", alt)
