"""Trivial methods: a constant depth, and the depth of the nearest training image. Their errors are
the reference that tells what another method's error is worth."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.method import Frames, Method, Photographed, Setting, training_split_of
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.depth import depth_range_mm, object_mask
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.loaders.storage.benchmark import benchmark_of
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.options import option

STANDOFF, MIDDLE, TRAINING_MEAN = "standoff", "middle", "training-mean"
TRAINING_MEAN_MM, TRAINING_MEAN_DATA = 1743.75, "fpp-bench-full version 1"
"""Mean exact depth over the object pixels of the training split of that benchmark."""
RANGE_SHARES = {"range-middle": 0.5, "range-training": 0.294}
"""Constants as shares of a given depth range, that of the pixels that are not void: its middle, and
`best_range_share` of the training split of `RANGE_DATA`."""
RANGE_DATA = "fpp-bench-full-224 version 2"
BLOCKS = 60
"""Blocks along an image's shorter side, by whose means `NearestMethod` compares images."""


@dataclass(frozen=True)
class ConstantOptions:
    """Options of `ConstantMethod`."""

    at: str | float = option(
        STANDOFF,
        "standoff, middle (of the working range), training-mean, or a depth in mm; range-middle or "
        "range-training: the "
        "middle of the sample's depth range, or its best share on the training split; the range is "
        "then given",
        "DEPTH",
    )


class ConstantMethod(Method):
    """One depth at every pixel: ``at`` the rig's standoff, the middle of its working range, the
    mean of the benchmark's training split, or so many mm. Or one of `RANGE_SHARES` of the sample's
    depth range, which it is then given, as a network of the oracle range track is: normalised
    depth. Raises PredictionError for anything else."""

    name = "constant"
    purpose = "the same depth at every pixel"
    Options = ConstantOptions
    trivial = True
    packages = ("numpy",)

    def __init__(self, rig: Rig, **options: object) -> None:
        at = self.checked_options(ConstantOptions, options).at
        known = {
            STANDOFF: rig.standoff_m * MM_PER_M,
            MIDDLE: sum(rig.working_range_mm) / 2,
            TRAINING_MEAN: TRAINING_MEAN_MM,
            **RANGE_SHARES,
        }
        try:
            self.value = float(known.get(at, at) if isinstance(at, str) else at)
        except ValueError:
            self.value = -1.0
        if not 0 < self.value < 1e6:
            raise PredictionError(
                f"at {at!r}: expected {', '.join(known)}, or a depth in mm above 0"
            )
        self.shape = rig.camera.height, rig.camera.width
        self.frames_used = rig.sequence.config("single_shot")
        self.title = f"Constant depth, {at} mm" if at not in known else f"Constant depth: {at}"
        if at in RANGE_SHARES:
            self.uses_ground_truth_range, self.units, self.mode, self.target = (
                True,
                "normalised",
                "paper",
                "depth",
            )
            self.range_rule = "valid"
        self.settings = {"at": at, "share" if at in RANGE_SHARES else "depth_mm": self.value}

    @classmethod
    def variants(cls, rig: Rig) -> Sequence[Mapping[str, Setting]]:
        return [{}, {"at": TRAINING_MEAN}]

    @property
    def learned_from(self) -> dict[str, Any] | None:
        data = {TRAINING_MEAN: TRAINING_MEAN_DATA, "range-training": RANGE_DATA}.get(
            str(self.settings["at"])
        )
        return {"data": "train-split", "versions": [data]} if data else super().learned_from

    def predict(self, frames: Frames) -> NDArray[np.float32]:
        return np.full(self.shape, self.value, dtype=np.float32)


def best_range_share(dataset: DatasetFolder, samples: Sequence[str]) -> float:
    """The constant share of each sample's depth range with the least mean object MAE over
    ``samples``: the median over their object pixels, each weighted by range over pixels. Ranges are
    those of pixels that are not void."""
    shares, weights = [], []
    for sample in samples:
        depth_mm = dataset.depth_mm(sample).astype(np.float64)
        low, high = depth_range_mm(depth_mm, dataset.void(sample))
        inside = (depth_mm[object_mask(depth_mm)] - low) / (high - low)
        shares.append(inside)
        weights.append(np.full(inside.size, (high - low) / inside.size))
    order = np.argsort(values := np.concatenate(shares))
    weight = np.cumsum(np.concatenate(weights)[order])
    return float(values[order][np.searchsorted(weight, weight[-1] / 2)])


@dataclass(frozen=True)
class NearestOptions:
    """Options of `NearestMethod`; ``training``: also an opened dataset."""

    training: "DatasetFolder | str | Path | None" = option(
        None, "dataset with the training split (default: DATASET itself)", "FOLDER"
    )


class NearestMethod(Method):
    """The decoded depth of the training sample whose single-shot frame is nearest to the image:
    least sum of squared differences of block means, the first one of equals. ``training``: the
    dataset that holds the training split, opened or its folder. Sums are of whole numbers, so the
    choice is the same on every machine.

    Raises PredictionError for a dataset without a training split, or of another image size or
    sequence than ``rig``."""

    name = "nearest"
    purpose = "depth of the training sample with the nearest image"
    Options = NearestOptions
    trivial = True
    title = "Nearest training image"
    target = "depth"
    packages = ("numpy",)

    @classmethod
    def for_dataset(cls, dataset: Photographed, **options: object) -> Method:
        """With the dataset's own training split, unless another dataset's is given."""
        own = {"training": dataset} if isinstance(dataset, DatasetFolder) else {}
        return cls.for_rig(dataset.rig, **{**own, **options})

    def __init__(self, rig: Rig, **options: object) -> None:
        training = self.checked_options(NearestOptions, options).training
        if training is None:
            raise PredictionError(
                f"{self.name} needs the training split: give the dataset that holds it (--training "
                f"FOLDER)"
            )
        self.training = (
            training if isinstance(training, DatasetFolder) else DatasetFolder(Path(training))
        )
        size = rig.camera.height, rig.camera.width
        if "train" not in self.training.splits:
            raise PredictionError(
                f"{self.training.path}: has no training split to choose from; give a dataset that "
                f"has one "
                "(--training FOLDER)"
            )
        if (self.training.size, self.training.sequence.to_dict()) != (size, rig.sequence.to_dict()):
            (height, width), (other_height, other_width) = size, self.training.size
            raise PredictionError(
                f"{self.training.path}: expected training images of {height}x{width} px (H x W) of "
                f"the same sequence "
                f"as those to predict, this dataset has {other_height}x{other_width} px or another "
                f"sequence"
            )
        self.frames_used = rig.sequence.config("single_shot")
        self.samples = self.training.samples("train")
        self.block_px = max(1, min(size) // BLOCKS)
        sums = []
        for sample in self.samples:
            sums.append(self._block_sums(self.training.frame(sample, self.frames_used[0])))
            self.training.release(sample)
        self._sums = np.array(sums)
        self.settings = {
            "training_fingerprint": self.training.fingerprint,
            "block_px": self.block_px,
        }

    def predict(self, frames: Frames) -> NDArray[np.float32]:
        frame = frames[self.frames_used[0]]
        if frame is None:
            raise PredictionError(
                f"{self.name} needs frame {self.frames_used[0]}, and it is missing"
            )
        distances = ((self._sums - self._block_sums(frame)) ** 2).sum(axis=(1, 2))
        sample = self.samples[int(np.argmin(distances))]
        depth_mm = self.training.depth_mm(sample).astype(np.float32)
        self.training.release(sample)
        return depth_mm

    @property
    def learned_from(self) -> dict[str, Any] | None:
        return training_split_of(benchmark_of(self.training.content), self.training.fingerprint)

    def _block_sums(self, frame: NDArray[np.uint8]) -> NDArray[np.int64]:
        """Sums of grey levels over blocks, (H // block, W // block); what is left over at the ends
        is not looked at."""
        side = self.block_px
        height, width = (length // side for length in frame.shape)
        blocks = frame[: height * side, : width * side].reshape(height, side, width, side)
        return blocks.sum(axis=(1, 3), dtype=np.int64)
