"""Reading one sample of a published tree: fringe, depth in mm, raw frames, and every check on their contents."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.depth import Normalisation, denormalise, normalise, object_mask
from fpp_ml_bench.errors import LayoutError
from fpp_ml_bench.loaders.published.layout import INFO_VARIABLES, VARIABLES
from fpp_ml_bench.loaders.published.mat_files import read_matrix, read_scalar
from fpp_ml_bench.loaders.published.order import FrameOrder, check_order, find_order
from fpp_ml_bench.loaders.published.png import read_grey_png
from fpp_ml_bench.loaders.published.tree import PublishedSample
from fpp_ml_bench.loaders.sample import SINGLE_SHOT_FRAME
from fpp_ml_bench.loaders.storage import Row
from fpp_ml_bench.optics import Rig

AGREEMENT_MM = 0.01
"""Accepted difference between variants of a depth map: float32 in m is exact to 0.0001 mm, and a wrong unit or file
differs by mm."""
_UNIT_SLACK = 10.0
_ROUNDING = 1e-6
_SHOWN_MISFITS = 3


@dataclass(frozen=True)
class SampleReader:
    """Reads the samples of a tree. ``order`` None: raw frames are only checked, not read as frames of a sequence."""

    size: tuple[int, int]
    variants: tuple[Normalisation, ...]
    rig: Rig
    order: FrameOrder | None

    def read(self, sample: PublishedSample) -> Row:
        """The sample's row, depth float32 mm, 0 = background. Raises `LayoutError` with a line per wrong file."""
        problems: list[str] = []
        row = self._read(sample, problems)
        if row is None:
            raise LayoutError("\n".join(problems))
        return row

    def problems(self, sample: PublishedSample) -> list[str]:
        """Problems of the sample's files, a line each; empty when the sample can be read."""
        problems: list[str] = []
        self._read(sample, problems)
        return problems

    def _read(self, sample: PublishedSample, problems: list[str]) -> Row | None:
        fringe = self._fringe(sample, problems)
        depth_mm = self._depth_mm(sample, problems)
        files = [self._image(path, problems) for path in sample.frames]
        frames = {} if fringe is None else {SINGLE_SHOT_FRAME: fringe}
        present = [image for image in files if image is not None]
        if sample.frames and len(present) == len(files):
            if fringe is not None and not np.array_equal(present[0], fringe):
                problems.append(f"{sample.frames[0]}: differs from the single-shot input {sample.fringes[0]}")
            if self.order is not None:
                frames = self._ordered(sample, present, self.order, problems)
        if problems or depth_mm is None:
            return None
        return Row(sample.sample, sample.object, sample.view, frames, depth_mm, None)

    def _image(self, path: Path, problems: list[str]) -> NDArray[np.uint8] | None:
        try:
            return read_grey_png(path)
        except LayoutError as error:
            problems.append(str(error))
            return None

    def _fringe(self, sample: PublishedSample, problems: list[str]) -> NDArray[np.uint8] | None:
        images = [self._image(path, problems) for path in sample.fringes]
        if images[0] is not None:
            problems += [
                f"{path}: expected the same image as {sample.fringes[0]}, got another image"
                for path, image in zip(sample.fringes[1:], images[1:], strict=True)
                if image is not None and not np.array_equal(image, images[0])
            ]
        return images[0]

    def _ordered(
        self, sample: PublishedSample, files: list[NDArray[np.uint8]], order: FrameOrder, problems: list[str]
    ) -> dict[int, NDArray[np.uint8]]:
        misfits = check_order(files, order, self.rig)
        if misfits:
            fitting = find_order(files, self.rig)
            hint = "it fits no named order" if fitting is None else f"it has the order {fitting.name}"
            more = f" (and {len(misfits) - _SHOWN_MISFITS} more)" if len(misfits) > _SHOWN_MISFITS else ""
            shown = "; ".join(misfits[:_SHOWN_MISFITS])
            problems.append(f"{sample.frames[0].parent}: not in frame order {order.name}, {hint}: {shown}{more}")
        return {frame.index: image for frame, image in zip(order.frames(self.rig.sequence), files, strict=True)}

    def _depth_mm(self, sample: PublishedSample, problems: list[str]) -> NDArray[np.float32] | None:
        """Depth from the first variant; the other variants and the depth range must agree with it."""
        maps: list[tuple[Normalisation, Path, NDArray[np.float64]]] = []
        limits = self._range_mm(sample, problems)
        for variant, path in zip(self.variants, sample.depths, strict=True):
            if variant == "individual" and limits is None:
                continue
            try:
                values = read_matrix(path, VARIABLES[variant])
                maps.append((variant, path, self._to_mm(path, values, variant, limits or (0.0, 0.0))))
            except LayoutError as error:
                problems.append(str(error))
        if not maps or maps[0][1] != sample.depths[0]:
            return None
        depth_mm = maps[0][2].astype(np.float32)
        for variant, path, variant_mm in maps[1:]:
            difference_mm = _disagreement_mm(variant_mm, depth_mm, variant)
            if difference_mm > AGREEMENT_MM:
                problems.append(
                    f"{path}: differs from {sample.depths[0]} by up to {difference_mm:.3f} mm; expected at "
                    f"most {AGREEMENT_MM} mm"
                )
        if limits is not None and self.variants[0] != "individual":
            inside = depth_mm[object_mask(depth_mm)]
            actual = float(inside.min()), float(inside.max())
            if max(abs(a - b) for a, b in zip(actual, limits, strict=True)) > AGREEMENT_MM:
                problems.append(
                    f"{sample.info}: gives {limits[0]:.3f} to {limits[1]:.3f} mm, but {sample.depths[0]} has "
                    f"{actual[0]:.3f} to {actual[1]:.3f} mm"
                )
        return depth_mm

    def _range_mm(self, sample: PublishedSample, problems: list[str]) -> tuple[float, float] | None:
        if sample.info is None:
            return None
        try:
            low, high = (read_scalar(sample.info, name) for name in INFO_VARIABLES)
        except LayoutError as error:
            problems.append(str(error))
            return None
        if not 0 < low <= high:
            problems.append(f"{sample.info}: expected 0 < depth_min <= depth_max, got {low} and {high}")
            return None
        return low, high

    def _to_mm(
        self, path: Path, values: NDArray, variant: Normalisation, limits: tuple[float, float]
    ) -> NDArray[np.float64]:
        if values.shape != self.size:
            raise LayoutError(f"{path}: expected {self.size[0]} x {self.size[1]} like the images, got {values.shape}")
        if not np.isfinite(values).all():
            raise LayoutError(f"{path}: {np.count_nonzero(~np.isfinite(values))} pixels are NaN or infinite")
        if (values < 0).any():
            raise LayoutError(f"{path}: {np.count_nonzero(values < 0)} pixels are negative; background is 0")
        inside = object_mask(values)
        if not inside.any():
            raise LayoutError(f"{path}: no pixel is above 0, so there is no object")
        if variant == "individual" and values.max() > 1 + _ROUNDING:
            raise LayoutError(f"{path}: expected values in [0, 1], got up to {values.max():g}")
        depth_mm = np.where(inside, denormalise(values, variant, *limits), 0.0)
        near, far = self.rig.working_range_mm
        low, high = float(depth_mm[inside].min()), float(depth_mm[inside].max())
        if low < near / _UNIT_SLACK or high > far * _UNIT_SLACK:
            unit = "m" if variant == "global" else "mm"
            raise LayoutError(
                f"{path}: depths of {low:.4g} to {high:.4g} mm when {VARIABLES[variant]} is read in {unit}; the "
                f"working range is {near:g} to {far:g} mm, so the file has another unit"
            )
        return depth_mm


def _disagreement_mm(variant_mm: NDArray[np.float64], depth_mm: NDArray[np.float32], variant: Normalisation) -> float:
    expected = depth_mm.astype(np.float64)
    if variant == "individual":
        # By the paper's rule, pixels at the sample's least depth are 0 in this variant.
        inside = expected[object_mask(expected)]
        share = normalise(expected, "individual", float(inside.min()), float(inside.max()))
        expected = np.where(object_mask(share), expected, 0.0)
    return float(np.abs(variant_mm - expected).max())
