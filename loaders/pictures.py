"""Pictures: a capture with what was decoded from it, a sample of a dataset with frames, depth, mask
and mesh, and a contact sheet of all objects and views."""

from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding.code import Reason
from fpp_ml_bench.constants import GREY_LEVELS, VIEWS
from fpp_ml_bench.containers import png_bytes
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import DatasetError
from fpp_ml_bench.files import write_files
from fpp_ml_bench.loaders.sample import DEPTH, DEPTH_EXACT
from fpp_ml_bench.loaders.storage.manifest import MESH_FOLDER
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import DIRECTIONS
from fpp_ml_bench.style import (
    DEPTH_COLOURS,
    ERROR_COLOURS,
    FRAME_COLOURS,
    SIGMA_COLOURS,
    figure,
    figure_png,
    styled,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_TILE_PX = 120
_BRIGHTER = 0.7
"""The power of a sheet's grey levels: dark surfaces show, and bright ones keep their texture."""
_LETTERS, _ACROSS = 250, 5
"""Letters in a line below a picture, and panels in a line."""
_COLOURS = (
    "#3ca951",
    "#9498a0",
    "#22252b",
    "#ff725c",
    "#efb118",
    "#a463f2",
    "#ff8ab7",
    "#4269d0",
    "#ffffff",
)

_TURN = np.array([[0.82, 0.11, -0.56], [0.0, 0.98, 0.2], [0.57, -0.16, 0.81]])
"""Rows: where x, y and z go when points are turned by 35 degrees about y, then by 11 about x;
camera coordinates."""

Panel = tuple[str, NDArray, str, float, float]
"""Title, image, colour map, and the values at its ends: lengths in mm, or grey levels. NaN is not
drawn, and inf a missing answer."""
_MISSING_COLOUR = "#00a651"
"""Green, which no colour map of errors holds."""


def _draw(axes: Any, title: str, image: NDArray, colours: str, low: float, high: float) -> None:
    """A panel; frames, of grey levels from 0 to 255, without a scale. An infinite value is a
    missing answer."""
    from matplotlib import colormaps
    from matplotlib.patches import Patch

    frame, shown = (colours, high) == (FRAME_COLOURS, GREY_LEVELS), colormaps[colours]
    if (missing := np.isposinf(image)).any():
        # Beyond the scale, and finite: matplotlib does not draw what is infinite.
        image = np.where(missing, 2 * high - low, np.minimum(image, high))
        shown = shown.with_extremes(over=_MISSING_COLOUR)
        axes.legend(
            handles=[Patch(color=_MISSING_COLOUR, label="missing: no answer")],
            loc="lower left",
            fontsize=7,
        )
    drawn = axes.imshow(
        image, cmap=shown, vmin=low, vmax=high, interpolation=None if frame else "nearest"
    )
    if not frame:
        axes.figure.colorbar(drawn, ax=axes, fraction=0.046, pad=0.03).ax.tick_params(labelsize=7)
    axes.set(title=title, xticks=[], yticks=[])


@styled
def panel_figure(panels: Sequence[Panel], further: str = "") -> "Figure":
    """A figure of panels, five in a line, and as the last of its axes empty ones of the projection
    ``further``, if any."""
    lines = -(-(len(panels) + bool(further)) // _ACROSS)
    drawn = figure(3.4 * _ACROSS, 3.7 * lines)
    for number, panel in enumerate(panels, 1):
        _draw(drawn.add_subplot(lines, _ACROSS, number), *panel)
    if further:
        drawn.add_subplot(lines, _ACROSS, len(panels) + 1, projection=further)
    return drawn


@styled
def capture_picture(
    title: str,
    grey: NDArray,
    depth_mm: NDArray[np.float32],
    sigma_mm: NDArray[np.float32],
    modulation: NDArray,
    reason: NDArray[np.uint8],
    findings: Sequence[object] = (),
) -> bytes:
    """PNG of maps (H, W): a frame in grey levels, depth and standard uncertainty in mm (0 = none),
    modulation in grey levels, and `Reason` codes; the ``findings`` stand below it."""
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    valid = depth_mm > 0
    low, high = np.quantile(depth_mm[valid], (0.005, 0.995)) if valid.any() else (0.0, 1.0)
    top = float(np.quantile(sigma_mm[valid], 0.95)) if valid.any() else 1.0
    panels: tuple[Panel, ...] = (
        (
            "mean of the frames, grey levels",
            grey,
            FRAME_COLOURS,
            0.0,
            max(float(np.quantile(grey, 0.999)), 1.0),
        ),
        ("depth, mm", np.where(valid, depth_mm, np.nan), DEPTH_COLOURS, low, high),
        (
            "standard uncertainty by noise, mm",
            np.where(valid, sigma_mm, np.nan),
            SIGMA_COLOURS,
            0.0,
            top,
        ),
        (
            "modulation, grey levels",
            modulation,
            FRAME_COLOURS,
            0.0,
            float(max(np.nanmax(modulation, initial=1.0), 1.0)),
        ),
    )
    drawn = panel_figure(panels, "rectilinear")
    lines = [line for finding in findings for line in wrap(str(finding), _LETTERS)]
    drawn.set_figheight(3.9 + 0.17 * len(lines))
    if lines:
        drawn.supxlabel("\n".join(lines), fontsize=8, x=0.01, ha="left", color="#b00020")
    drawn.suptitle(title)
    pixels = drawn.axes[-1]
    pixels.imshow(
        reason,
        cmap=ListedColormap(_COLOURS),
        vmin=0,
        vmax=len(_COLOURS) - 1,
        interpolation="nearest",
    )
    pixels.set(title="pixels", xticks=[], yticks=[])
    shares = np.bincount(reason.ravel(), minlength=len(_COLOURS)) / reason.size
    handles = [
        Patch(
            facecolor=_COLOURS[code],
            edgecolor="0.6",
            label=f"{code.name.lower().replace('_', ' ')} {100 * shares[code]:.1f}%",
        )
        for code in Reason
        if shares[code] > 0
    ]
    pixels.legend(
        handles=handles, fontsize=7, loc="upper left", bbox_to_anchor=(0.0, -0.02), ncols=2
    )
    return figure_png(drawn)


@styled
def sample_picture(dataset: DatasetFolder, sample: str, path: Path) -> None:
    """Write a sample as PNG: frames of each kind, depth, exact depth, their difference, mask, mesh.
    Raises `DatasetError` for a place that can't be written, `MeshError` for a damaged mesh."""
    from fpp_ml_bench.loaders.render.mesh_files import read_mesh

    panels = _panels(dataset, sample)
    mesh = dataset.path / MESH_FOLDER / f"{dataset.measured(sample)['object']}.ply"
    drawn = panel_figure(panels, "3d" if mesh.is_file() else "")
    drawn.suptitle(f"{sample} ({dataset.split_of_sample(sample)})")
    if mesh.is_file():
        vertices_m, faces, *_ = read_mesh(mesh)
        solid: Any = drawn.axes[-1]
        solid.plot_trisurf(
            *vertices_m.T, triangles=faces, color="0.9", linewidth=0, antialiased=False
        )
        solid.set(title="ground-truth mesh", aspect="equal")
        solid.set_axis_off()
    write_files(path.parent, {path.name: figure_png(drawn)}, DatasetError)


def _panels(dataset: DatasetFolder, sample: str) -> list[Panel]:
    sequence, stored = dataset.sequence, dataset.manifest.stored_frames
    # The third finest Gray bit: its stripes are still visible in a small picture.
    codes = [
        index for direction in DIRECTIONS for index in tuple(sequence.gray(direction))[-3:][:1]
    ]
    firsts = (*sequence.config("single_shot"), *sequence.sinusoids("vertical")[:1])
    frames = [i for i in dict.fromkeys((*firsts, *codes, sequence.white)) if i in stored]
    panels: list[Panel] = [
        (sequence.frames[i].title, dataset.frame(sample, i), FRAME_COLOURS, 0, GREY_LEVELS)
        for i in frames
    ]
    depth_mm = dataset.depth_mm(sample)
    inside = object_mask(depth_mm)
    low, high = float(depth_mm[inside].min()), float(depth_mm.max())
    title = f"depth, {low:.0f}-{high:.0f} mm"
    panels.append((title, np.where(inside, depth_mm, np.nan), DEPTH_COLOURS, low, high))
    if dataset.has_exact:
        exact_mm = dataset.depth_mm(sample, DEPTH_EXACT)
        error_mm = depth_mm - exact_mm
        limit = float(np.quantile(np.abs(error_mm[inside]), 0.99))
        title = f"decoded - exact, MAE {np.abs(error_mm[inside]).mean(dtype=np.float64):.3f} mm"
        panels.append(
            (
                "exact depth, mm",
                np.where(object_mask(exact_mm), exact_mm, np.nan),
                DEPTH_COLOURS,
                low,
                high,
            )
        )
        panels.append((title, np.where(inside, error_mm, np.nan), ERROR_COLOURS, -limit, limit))
    title = f"object mask, {100 * inside.mean():.1f}% of the image"
    panels.append((title, inside * GREY_LEVELS, FRAME_COLOURS, 0, GREY_LEVELS))
    return panels


def _grey_frame(dataset: DatasetFolder) -> int:
    """The white frame where it is stored, else the first one of a single shot."""
    white, (single, *_) = dataset.sequence.white, dataset.sequence.config("single_shot")
    return white if white in dataset.manifest.stored_frames and white is not None else single


@styled
def front_picture(
    frame: NDArray[np.uint8],
    depth_mm: NDArray[np.floating],
    exact_mm: NDArray[np.floating],
    rig: Rig,
    title: str,
) -> bytes:
    """PNG of what a method makes of one frame, all maps (H, W) of the camera's size: the frame, its
    depth in mm, 0 = none, the error against the exact depth in mm, and the points of the depth,
    turned and shaded. All are cut to the object. ``exact_mm`` is 0 off the object and where a score
    leaves a pixel out (`DatasetFolder.void`). The object MAE is then that of the score, in which
    the error of a pixel without an answer is its whole depth. Raises `CaptureError` for a depth map
    without any point, or with values that are negative or not finite."""
    from matplotlib import colormaps
    from matplotlib.colors import LightSource

    from fpp_ml_bench.loaders.captures.exports import camera_points

    points_mm, there = camera_points(depth_mm, rig.camera)
    inside = object_mask(exact_mm)
    left, top, width, height = cv2.boundingRect(
        (inside if inside.any() else there).astype(np.uint8)
    )
    margin = max(width, height) // 12
    cut = np.s_[
        max(top - margin, 0) : top + height + margin, max(left - margin, 0) : left + width + margin
    ]
    low, high = (float(end) for end in np.quantile(points_mm[:, 2], (0.01, 0.99)))
    error_mm = np.where(inside, depth_mm - exact_mm.astype(np.float64), np.nan)
    mae_mm, answered_mm = (
        np.abs(error_mm[inside]).mean() if inside.any() else np.nan,
        error_mm[inside & there],
    )
    clip_mm = float(np.quantile(np.abs(answered_mm), 0.95)) if answered_mm.any() else 1.0
    title_of_error = (
        f"its error, mm, object MAE {mae_mm:.2f} mm\n(colours end at {float(f'{clip_mm:.2g}'):g} "
        f"mm)"
    )
    white = max(float(np.quantile(frame[cut], 0.998)), 1.0)
    drawn = figure(12.5, 3.5)
    drawn.suptitle(title, parse_math=False)
    *maps, solid = drawn.subplots(1, 4)
    _draw(
        maps[0],
        "one frame, brightened",
        np.clip(frame / white, 0, 1)[cut] * GREY_LEVELS,
        FRAME_COLOURS,
        0,
        GREY_LEVELS,
    )
    _draw(
        maps[1], "its depth, mm", np.where(there, depth_mm, np.nan)[cut], DEPTH_COLOURS, low, high
    )
    _draw(
        maps[2],
        title_of_error,
        np.where(inside & ~there, np.inf, error_mm)[cut],
        ERROR_COLOURS,
        -clip_mm,
        clip_mm,
    )
    # Shaded by the slopes of a smoothed depth: those between single pixels show noise alone.
    smooth_mm = cv2.GaussianBlur(
        np.where(there, depth_mm, np.median(points_mm[:, 2])), (0, 0), depth_mm.shape[1] / 320
    )
    pixel_mm = high / rig.camera.fx
    shade = 0.4 + 0.6 * LightSource(315, 40).hillshade(-smooth_mm, dx=pixel_mm, dy=pixel_mm)[there]
    x, y, z = (points_mm - np.median(points_mm, axis=0)).dot(_TURN).T
    order = np.argsort(-z)
    order = order[
        np.abs(points_mm[order, 2] - low) <= 2 * (high - low)
    ]  # wrong points would shrink the others
    colours = (
        colormaps[DEPTH_COLOURS]((points_mm[:, 2] - low) / (high - low or 1.0))[:, :3]
        * shade[:, None]
    )
    solid.scatter(x[order], -y[order], s=2.5, c=colours[order], marker="s", linewidths=0)
    solid.set(title="its points, turned and shaded", aspect="equal")
    solid.set_axis_off()
    return figure_png(drawn)


def sample_cloud(dataset: DatasetFolder, sample: str, folder: Path, name: str) -> list[Path]:
    """Write a sample's exact depth, or the decoded one where no exact depth is stored, as
    ``name.ply`` and ``name.html``; returns their paths. Raises `CaptureError` as `write_cloud`."""
    from fpp_ml_bench.loaders.cloud import write_cloud

    kind, column = ("exact", DEPTH_EXACT) if dataset.has_exact else ("decoded", DEPTH)
    depth_mm, grey = dataset.depth_mm(sample, column), dataset.frame(sample, _grey_frame(dataset))
    return write_cloud(folder, name, f"{sample}: {kind} depth", dataset.rig, depth_mm, grey)


def contact_sheet(dataset: DatasetFolder, split: str, path: Path, most_views: int) -> None:
    """Write the objects of ``split`` as a PNG, each in its first ``most_views`` views, in white
    light if that frame is stored. Grey levels are raised to the power `_BRIGHTER`. Raises
    `DatasetError` for no view, or a place that can't be written."""
    if most_views < 1:
        raise DatasetError(f"--views {most_views}: expected 1 or more views of each object")
    views = dataset.samples_by_object(split)
    index, (height, width) = _grey_frame(dataset), dataset.size
    across = min(most_views, max(map(len, views.values())))
    tile_px = _TILE_PX * (2 if across == 1 else 1)  # the label is as long as two tiles
    tile_width, tile_height = (
        max(1, tile_px * side // max(width, height)) for side in (width, height)
    )
    label_px, gap_px = 18, 8
    block_size = label_px + tile_height, across * tile_width + gap_px
    brighter = np.rint(GREY_LEVELS * (np.arange(256) / GREY_LEVELS) ** _BRIGHTER).astype(np.uint8)
    blocks = []
    for name, samples in views.items():
        block = np.full(block_size, 255, dtype=np.uint8)
        for number, sample in enumerate(samples[:across]):
            tile = cv2.resize(
                dataset.frame(sample, index),
                (tile_width, tile_height),
                interpolation=cv2.INTER_AREA,
            )
            block[label_px:, number * tile_width :][:, :tile_width] = brighter[tile]
        title = f"{name} ({dataset.split_of_sample(samples[0])})"
        cv2.putText(block, title, (4, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.42, 0, 1, cv2.LINE_AA)
        blocks.append(block)
    columns = min(len(blocks), 2 * len(VIEWS) * _TILE_PX // (across * tile_px))
    blocks += [np.full(block_size, 255, dtype=np.uint8)] * (-len(blocks) % columns)
    sheet = np.vstack(
        [np.hstack(blocks[start : start + columns]) for start in range(0, len(blocks), columns)]
    )
    write_files(path.parent, {path.name: png_bytes(sheet[:, :-gap_px])}, DatasetError)
