"""The disturbed views of a set: only the frames that a method uses, rendered on demand and cached.

The cache is a folder for each condition with a file for each frame; a file depends on nothing but the condition and the
view, so methods share it. The folders that were used longest ago go where it would grow beyond its limit.
"""

import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from hashlib import blake2b
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench import __version__
from fpp_ml_bench.baselines.robustness.axes import CLEAN, SETS, Truth, corruptions
from fpp_ml_bench.constants import MM_PER_M, sample_name
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.loaders.render.meshes import solid_mesh
from fpp_ml_bench.loaders.render.scene import BuildSettings, SolidMesh
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.optics.named_rigs import NAMED_RIGS

CACHE = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser() / "fpp-ml-bench" / "robustness"
LIMIT_BYTES = 10_000_000_000
Frames = list[NDArray[np.uint8] | None]


@dataclass(frozen=True)
class Condition:
    """An axis at a severity, 1 to 5, for the objects ``objects`` seen at ``size`` px; severity 0 is the clean scene.
    ``rig``: one of `optics.NAMED_RIGS`."""

    axis: str
    severity: int
    objects: tuple[str, ...]
    size: int
    rig: str = "paper"

    @property
    def settings(self) -> BuildSettings:
        rules = corruptions()
        light = rules.clean if self.axis == CLEAN else rules.axes[self.axis].light(rules.clean, self.severity)
        return BuildSettings(rig=NAMED_RIGS[self.rig](self.size), objects=self.objects, light=light)

    def key(self, frames: Sequence[int]) -> str:
        """Name of the condition's folder. Where the object moves, each frame's place depends on which are captured."""
        return f"{self.axis}-{self.severity}-{_digest(self, tuple(frames))}"


class FrameCache:
    """Frames and truths below ``folder``, None for no cache."""

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder

    def frames(self, condition: Condition, name: str, view: str, wanted: Sequence[int]) -> Frames:
        """The sequence of a view with the frames ``wanted``, uint8 (H, W) each, and None for the others. A moving
        object rests halfway through the frames, which are captured one after another."""
        studio = _studio(condition)
        shape = studio.rig.camera.height, studio.rig.camera.width
        files = {index: self._file(condition, wanted, f"{sample_name(name, view)}-{index:02d}") for index in wanted}
        out: Frames = [None] * len(studio.rig.sequence)
        for index, file in files.items():
            out[index] = _load(file, shape, np.dtype(np.uint8))
        missing = tuple(index for index in wanted if out[index] is None)
        if missing and studio.light.motion_mm:
            middle = (len(wanted) - 1) / 2
            studio.expose_moving(_mesh(name), view, {index: wanted.index(index) - middle for index in missing})
        elif missing:
            studio.expose(studio.trace(_mesh(name), view), missing)
        for index in missing:
            out[index] = frame = studio.frame(index).copy()
            _save(files[index], frame)
        return out

    def truth(self, clean: Condition, name: str, view: str) -> Truth:
        """Exact depth and scored pixels of an undisturbed view."""
        studio = _studio(clean)
        shape = studio.rig.camera.height, studio.rig.camera.width
        file = self._file(clean, (), f"{sample_name(name, view)}-truth")
        kept = _load(file, (2, *shape), np.dtype(np.float32))
        if kept is None:
            scene = studio.trace(_mesh(name), view)
            depth_mm = np.zeros(shape, dtype=np.float32)
            depth_mm.ravel()[scene.hits.pixels] = scene.hits.depth_m * MM_PER_M
            truth = Truth.of(depth_mm, studio.flags(scene)[0])
            _save(file, np.stack([depth_mm, truth.scored.astype(np.float32)]))
            return truth
        return Truth(kept[0], kept[1] > 0)

    def make_room(self, needed_bytes: int, limit_bytes: int = LIMIT_BYTES) -> None:
        """Remove the folders that were used longest ago until ``needed_bytes`` more stay below the limit."""
        if self.folder is None or not self.folder.is_dir():
            return
        entries = [entry for entry in self.folder.iterdir() if entry.is_dir()]
        sizes = {entry: sum(file.stat().st_size for file in entry.iterdir()) for entry in entries}
        total = sum(sizes.values())
        for entry in sorted(sizes, key=lambda entry: entry.stat().st_mtime):
            if total + needed_bytes <= limit_bytes:
                return
            shutil.rmtree(entry, ignore_errors=True)
            total -= sizes[entry]

    def _file(self, condition: Condition, wanted: Sequence[int], name: str) -> Path | None:
        return None if self.folder is None else self.folder / condition.key(wanted) / f"{name}.npy"


@lru_cache
def _digest(condition: Condition, frames: tuple[int, ...]) -> str:
    described = condition.settings.describe()
    del described["objects"]
    moving = frames if described["light"]["motion_mm"] else ()
    rig = [] if condition.rig == "paper" else [condition.rig]
    text = json.dumps([__version__, condition.size, described, moving, *rig], sort_keys=True)
    return blake2b(text.encode(), digest_size=8).hexdigest()


@lru_cache(maxsize=max(map(len, SETS.values())))
def _mesh(name: str) -> SolidMesh:
    """An object of a set; what its light takes from the mesh alone is kept with it."""
    return solid_mesh(name)


@lru_cache(maxsize=2)
def _studio(condition: Condition) -> Studio:
    """A process holds those of the clean scene and of the condition that it is at."""
    return Studio(condition.settings)


def _load(file: Path | None, shape: tuple[int, ...], dtype: np.dtype) -> NDArray | None:
    """The array of a file of the cache; None where there is none, or no whole one."""
    if file is None:
        return None
    try:
        array = np.load(file, allow_pickle=False)
    except (OSError, ValueError, EOFError):
        return None
    if array.shape != shape or array.dtype != dtype:
        return None
    os.utime(file.parent)
    return array  # type: ignore[no-any-return]


def _save(file: Path | None, array: NDArray) -> None:
    if file is None:
        return
    content = BytesIO()
    np.save(content, array, allow_pickle=False)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(file, content.getvalue(), sync=False)
    except OSError as error:
        raise PredictionError(f"{file}: can't be written ({error.strerror}); free some space, or --no-cache") from error
