"""The views that settings are measured on: some test views of a dataset, or objects rendered at an image size."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.method import Method
from fpp_ml_bench.baselines.run import captured_frames
from fpp_ml_bench.constants import split_sample_name
from fpp_ml_bench.errors import DatasetError
from fpp_ml_bench.loaders.storage import DatasetFolder
from fpp_ml_bench.optics import Rig

Frames = Sequence[NDArray[np.uint8] | None]


class Views(Protocol):
    """Frames and true depth of some views of one rig; ``names`` and their ``objects`` in the same order."""

    @property
    def names(self) -> Sequence[str]: ...
    @property
    def rig(self) -> Rig: ...
    @property
    def objects(self) -> Sequence[str]: ...
    def frames(self, method: Method, name: str) -> Frames:
        """The sequence as ``method`` may see it, in memory."""

    def target_mm(self, name: str) -> NDArray[np.float32]:
        """Depth float32 (H, W) in mm to score against, 0 = background."""


@dataclass
class StoredViews:
    """Views ``names`` of a dataset, against the exact depth where it is known."""

    opened: DatasetFolder
    names: Sequence[str]

    @property
    def rig(self) -> Rig:
        return self.opened.rig

    @property
    def objects(self) -> list[str]:
        return [split_sample_name(name)[0] for name in self.names]

    @property
    def target(self) -> str:
        return "depth_exact" if self.opened.has_exact else "depth"

    def frames(self, method: Method, name: str) -> Frames:
        return captured_frames(self.opened, method, name)

    def target_mm(self, name: str) -> NDArray[np.float32]:
        return self.opened.target_mm(name, self.target)


def choose_views(opened: DatasetFolder, per_object: int, split: str = "test") -> StoredViews:
    """``per_object`` views of each object of ``split``, spread over its views, in row order.

    Raises `DatasetError` for a split without samples.
    """
    samples_by_object: dict[str, list[str]] = {}
    for sample in opened.samples(split):
        samples_by_object.setdefault(split_sample_name(sample)[0], []).append(sample)
    if not samples_by_object:
        raise DatasetError(f"{opened.path}: split {split} holds no sample; there is nothing to measure")
    chosen: list[str] = []
    for number, names in enumerate(samples_by_object.values()):
        count = min(per_object, len(names))
        # Each object begins one view later, so that the views differ between objects.
        chosen += sorted(
            {names[(number + position * len(names) // count) % len(names)] for position in range(count)},
            key=names.index,
        )
    return StoredViews(opened, chosen)


@dataclass
class PhotographedViews:
    """Objects of the benchmark in one view each, rendered into memory as ``build`` would, at ``rig``'s size."""

    rig: Rig
    objects: list[str]
    view: str = "A60"
    _captures: dict[str, tuple[list[NDArray[np.uint8]], NDArray[np.float32]]] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        return [f"{name}_{self.view}" for name in self.objects]

    def frames(self, method: Method, name: str) -> Frames:
        frames, _ = self._photograph(name)
        return [frame if index in method.frames_used else None for index, frame in enumerate(frames)]

    def target_mm(self, name: str) -> NDArray[np.float32]:
        return self._photograph(name)[1]

    def _photograph(self, name: str) -> tuple[list[NDArray[np.uint8]], NDArray[np.float32]]:
        if name not in self._captures:
            from fpp_ml_bench.depth import object_mask
            from fpp_ml_bench.loaders.render import BuildSettings, Studio, solid_mesh

            studio = Studio(BuildSettings(self.rig, tuple(self.objects)))
            row = studio.photograph(solid_mesh(split_sample_name(name)[0]), self.view)
            # The studio's own memory, which is freed with the studio.
            frames = [row.frames[index] for index in range(len(self.rig.sequence))]
            exact = np.zeros_like(row.depth_mm) if row.depth_exact_mm is None else row.depth_exact_mm
            self._captures[name] = frames, np.where(object_mask(row.depth_mm), exact, np.float32(0))
        return self._captures[name]
