"""Pictures of a dataset: a sample with frames, depth and mask, and a contact sheet of all objects and views."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import DatasetError
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.sequence import DIRECTIONS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_TILE_PX = 120
_DPI = 110
_GREY = "gray"
_COLUMNS = 5
Panel = tuple[str, NDArray, str, float, float]
"""Title, image, colour map, and the values at its ends: lengths in mm, or grey levels."""


def panel_figure(panels: list[Panel]) -> "Figure":
    """A figure of panels, five in a line; a colour bar in mm where they are not grey levels."""
    from matplotlib.figure import Figure

    rows = -(-len(panels) // _COLUMNS)
    figure = Figure(figsize=(3.4 * _COLUMNS, 3.7 * rows), dpi=_DPI, layout="constrained")
    for number, (title, image, colours, low, high) in enumerate(panels):
        axes = figure.add_subplot(rows, _COLUMNS, number + 1)
        nearest = None if colours == _GREY else "nearest"
        drawn = axes.imshow(image, cmap=colours, vmin=low, vmax=high, interpolation=nearest)
        if colours != _GREY:
            bar = figure.colorbar(drawn, ax=axes, fraction=0.046, pad=0.03)
            bar.set_label("mm", fontsize=8)
            bar.ax.tick_params(labelsize=7)
        axes.set_title(title, fontsize=9)
        axes.set_xticks([])
        axes.set_yticks([])
    return figure


def sample_picture(dataset: DatasetFolder, sample: str, path: Path) -> None:
    """Write a sample as PNG: frames of each kind, depth, exact depth, their difference, mask."""
    figure = panel_figure(_panels(dataset, sample))
    figure.suptitle(f"{sample} ({dataset.split_of_sample(sample)})")
    _save(figure.savefig, path)


def _panels(dataset: DatasetFolder, sample: str) -> list[Panel]:
    sequence, stored = dataset.sequence, dataset.manifest.stored_frames
    # The third finest Gray bit: its stripes are still visible in a small picture.
    codes = [index for direction in DIRECTIONS for index in tuple(sequence.gray(direction))[-3:][:1]]
    firsts = (*sequence.config("single_shot"), *sequence.sinusoids("vertical")[:1])
    frames = [i for i in dict.fromkeys((*firsts, *codes, sequence.white)) if i in stored]
    panels: list[Panel] = [(sequence.frames[i].title, dataset.frame(sample, i), _GREY, 0, 255) for i in frames]
    depth_mm = dataset.depth_mm(sample)
    inside = object_mask(depth_mm)
    low, high = float(depth_mm[inside].min()), float(depth_mm.max())
    title = f"depth, {low:.0f}-{high:.0f} mm"
    panels.append((title, np.where(inside, depth_mm, np.nan), "viridis", low, high))
    if dataset.has_exact:
        exact_mm = dataset.depth_mm(sample, "depth_exact")
        error_mm = depth_mm - exact_mm
        limit = float(np.quantile(np.abs(error_mm[inside]), 0.99))
        title = f"decoded - exact, MAE {np.abs(error_mm[inside]).mean(dtype=np.float64):.3f} mm"
        panels.append(("exact depth", np.where(object_mask(exact_mm), exact_mm, np.nan), "viridis", low, high))
        panels.append((title, np.where(inside, error_mm, np.nan), "coolwarm", -limit, limit))
    title = f"object mask, {100 * inside.mean():.1f}% of the image"
    panels.append((title, inside.astype(np.uint8) * 255, _GREY, 0, 255))
    return panels


def _save(save: Callable[..., None], path: Path) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        save(path)
    except OSError as error:
        raise DatasetError(f"{path}: can't be written ({error.strerror or error})") from error


def contact_sheet(dataset: DatasetFolder, split: str, path: Path) -> None:
    """Write all objects (two per line) in all their views as a PNG, in white light if that frame is stored."""
    views: dict[str, list[str]] = {}
    for sample in dataset.samples(split):
        views.setdefault(dataset.measured(sample)["object"], []).append(sample)
    white, (single,) = dataset.sequence.white, dataset.sequence.config("single_shot")
    index = white if white in dataset.manifest.stored_frames and white is not None else single
    height, width = dataset.size
    tile_px = tuple(max(1, _TILE_PX * side // max(width, height)) for side in (width, height))
    label_px, columns = 18, 2
    line_px = tile_px[1] + label_px
    lines = -(-len(views) // columns)
    column_px = max(map(len, views.values())) * tile_px[0]
    sheet = np.full((lines * line_px, columns * column_px + 8), 255, dtype=np.uint8)
    for number, (name, samples) in enumerate(views.items()):
        top, left = (number // columns) * line_px, (number % columns) * (column_px + 8)
        for view_number, sample in enumerate(samples):
            tile = cv2.resize(dataset.frame(sample, index), tile_px, interpolation=cv2.INTER_AREA)
            column = left + view_number * tile_px[0]
            sheet[top + label_px : top + line_px, column : column + tile_px[0]] = cv2.convertScaleAbs(tile, alpha=1.4)
        title = f"{name} ({dataset.split_of_sample(samples[0])})"
        cv2.putText(sheet, title, (left + 4, top + 13), cv2.FONT_HERSHEY_SIMPLEX, 0.42, 0, 1, cv2.LINE_AA)
    encoded, png = cv2.imencode(".png", sheet)
    if not encoded:
        raise DatasetError(f"{path}: the picture could not be encoded")
    _save(lambda target: target.write_bytes(png.tobytes()) and None, path)
