"""One view of one object, from mesh to sample: frames, decoded ground truth, exact depth, and what separates them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import MM_PER_M, sample_name
from fpp_ml_bench.decoding import decode_stack
from fpp_ml_bench.depth import object_mask, object_near_edge
from fpp_ml_bench.loaders.render.camera import Exposure
from fpp_ml_bench.loaders.render.illumination import Backdrop, Lighting, LitPixels, lit_object
from fpp_ml_bench.loaders.render.raycast import Hits, PixelRays, TracedObject
from fpp_ml_bench.loaders.render.scene import SolidMesh, place
from fpp_ml_bench.loaders.render.sensor import Noise
from fpp_ml_bench.loaders.render.settings import BuildSettings
from fpp_ml_bench.loaders.sample import stored_frames
from fpp_ml_bench.loaders.storage import Row
from fpp_ml_bench.optics import Sequence
from fpp_ml_bench.skipping import skipping_enabled

INTERIOR_PX = 3
"""Ground-truth error is told apart at this distance from a depth edge: nearer, a pixel is a matter of definition."""


@dataclass
class Studio:
    """A rig with its light and background, ready to photograph objects.

    One view's frames are held, and overwritten by the next.
    """

    settings: BuildSettings

    def __post_init__(self) -> None:
        rig, settings = self.settings.rig, self.settings
        self.lighting = Lighting(shadows=settings.shadows)
        self.exposure = Exposure.of(rig, Noise.of_sigma(settings.noise_sigma_grey))
        self.backdrop = Backdrop(rig, self.lighting)
        self._pixels = np.arange(rig.camera.width * rig.camera.height, dtype=np.uint32)
        self.stored = stored_frames(rig.sequence, settings.stored)
        self.unstored = unstored_frames(rig.sequence, self.stored)
        self._frames = np.zeros((len(rig.sequence), rig.camera.height, rig.camera.width), dtype=np.uint8)

    def photograph(self, mesh: SolidMesh, view: str) -> Row:
        """Sample of ``mesh`` in ``view``. Its frames are views of memory that the next call overwrites.

        Frames that are stored are exposed whole. Those that only the ground truth needs are exposed at the object's
        pixels alone, and decoded there alone: the bytes there, and so the decoded depth, are the same either way. With
        skipping off (`fpp_ml_bench.skipping`) every frame is exposed and decoded whole.
        """
        settings, rig = self.settings, self.settings.rig
        vertices_m, distance_m = place(mesh, view, rig, settings.placement, settings.seed)
        traced = TracedObject(mesh, vertices_m)
        hits = traced.primary(PixelRays.of(rig.camera))
        lit = lit_object(hits, rig, self.lighting, traced)
        stream = (settings.seed, mesh.name, view)
        whole = self.backdrop.behind(traced, hits.pixels).patched(hits.pixels, lit)
        self.expose(hits, lit, whole, stream)
        exact_mm = np.zeros(self._frames.shape[1:], dtype=np.float32)
        exact_mm.ravel()[hits.pixels] = hits.depth_m * MM_PER_M
        seen = object_mask(exact_mm)
        depth_mm = self.ground_truth_mm(seen)
        measured = {
            "distance_mm": distance_m * MM_PER_M,
            "shadow_rays": whole.shadow_rays,
            **ground_truth_error(depth_mm, exact_mm),
        }
        frames = {index: self._frames[index] for index in self.stored}
        return Row(sample_name(mesh.name, view), mesh.name, view, frames, depth_mm, exact_mm, measured)

    def expose(self, hits: Hits, lit: LitPixels, whole: LitPixels, stream: tuple[object, ...]) -> None:
        """Expose a view into the studio's frames: what ``whole`` says of every pixel, ``lit`` of the object's."""
        images = self._frames.reshape(len(self._frames), -1)
        everything = not skipping_enabled()
        for run in _runs(tuple(range(len(images))) if everything else self.stored):
            self.exposure.expose(run, whole, self._pixels, stream, images[run.start : run.stop])
        if self.unstored and not everything:
            pixels = hits.pixels.astype(np.uint32)
            exposed = self.exposure.expose(self.unstored, lit, pixels, stream)
            for index, values in zip(self.unstored, exposed, strict=True):
                images[index, hits.pixels] = values

    def ground_truth_mm(self, seen: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Decoded depth of the exposed frames at the object's pixels ``seen`` bool (H, W); float32 (H, W), 0 beyond."""
        rig = self.settings.rig
        if skipping_enabled():
            return decode_stack(self._frames, rig, direction="both", mask=seen).depth_mm
        return np.where(seen, decode_stack(self._frames, rig, direction="both").depth_mm, np.float32(0))


def unstored_frames(sequence: Sequence, stored: tuple[int, ...]) -> tuple[int, ...]:
    """Frames that the ground truth is decoded from and that are not ``stored``: all others but black and white."""
    return tuple(i for i in range(len(sequence)) if i not in stored and i not in (sequence.black, sequence.white))


def _runs(indices: tuple[int, ...]) -> list[range]:
    """Ascending indices as runs of neighbours."""
    runs: list[range] = []
    for index in indices:
        if runs and runs[-1].stop == index:
            runs[-1] = range(runs[-1].start, index + 1)
        else:
            runs.append(range(index, index + 1))
    return runs


def ground_truth_error(depth_mm: NDArray[np.float32], exact_mm: NDArray[np.float32]) -> dict[str, Any]:
    """How far the decoded ground truth is from the exact one, per sample; mm and pixel counts, sums in float64.

    Over pixels that both have: ``gt_mae_mm``, ``gt_rmse_mm``, ``gt_bias_mm``, ``gt_max_mm``, and the first two again
    for pixels at least 3 px from a depth edge (``gt_interior_*``). ``undecoded_px`` counts object pixels without a
    decoded depth: they are background in ``depth``.
    """
    seen, decoded = object_mask(exact_mm), object_mask(depth_mm)
    both = seen & decoded
    error = depth_mm[both].astype(np.float64) - exact_mm[both]
    inside = error[~object_near_edge(exact_mm, INTERIOR_PX)[both]]
    return {
        "exact_px": int(seen.sum()),
        "undecoded_px": int((seen & ~decoded).sum()),
        "gt_mae_mm": _mean(np.abs(error)),
        "gt_rmse_mm": _root(_mean(error**2)),
        "gt_bias_mm": _mean(error),
        "gt_max_mm": float(np.abs(error).max()) if error.size else None,
        "gt_interior_px": int(inside.size),
        "gt_interior_mae_mm": _mean(np.abs(inside)),
        "gt_interior_rmse_mm": _root(_mean(inside**2)),
    }


def _mean(values: NDArray[np.float64]) -> float | None:
    return float(values.mean()) if values.size else None


def _root(value: float | None) -> float | None:
    return None if value is None else float(np.sqrt(value))
