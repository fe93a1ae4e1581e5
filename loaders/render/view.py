"""One view of one object, from mesh to sample: frames, decoded ground truth, exact depth, and what separates them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import MM_PER_M, sample_name
from fpp_ml_bench.decoding import decode_stack
from fpp_ml_bench.depth import object_mask, object_near_edge
from fpp_ml_bench.loaders.render.illumination import Backdrop, LitPixels, lit_object
from fpp_ml_bench.loaders.render.raycast import Hits, PixelRays, TracedObject
from fpp_ml_bench.loaders.render.scene import BuildSettings, Lighting, SolidMesh, place
from fpp_ml_bench.loaders.render.sensor import Exposure, Noise
from fpp_ml_bench.loaders.sample import Row, stored_frames
from fpp_ml_bench.skipping import skipping_enabled

INTERIOR_PX = 3
"""Ground-truth error is told apart at this distance from a depth edge: nearer, a pixel is a matter of definition."""


@dataclass(frozen=True)
class TracedView:
    """An object before the camera: what the rays meet, its light, and the name of the view's noise stream."""

    traced: TracedObject
    distance_m: float
    hits: Hits
    lit: LitPixels
    stream: tuple[object, ...]


class Studio:
    """A rig with its light and background, ready to photograph objects. One view's frames are held, and overwritten by
    the next."""

    def __init__(self, settings: BuildSettings) -> None:
        self.settings, rig = settings, settings.rig
        self.lighting = Lighting(shadows=settings.shadows)
        self.exposure = Exposure.of(rig, Noise.of_sigma(settings.noise_sigma_grey))
        self.backdrop = Backdrop(rig, self.lighting)
        self._pixels = np.arange(rig.camera.width * rig.camera.height, dtype=np.uint32)
        self.stored = stored_frames(rig.sequence, settings.stored)
        # Frames that the ground truth is decoded from and that are not stored: all others but black and white.
        unneeded = {*self.stored, rig.sequence.black, rig.sequence.white}
        self.unstored = tuple(i for i in range(len(rig.sequence)) if i not in unneeded)
        self._frames = np.zeros((len(rig.sequence), rig.camera.height, rig.camera.width), dtype=np.uint8)

    def photograph(self, mesh: SolidMesh, view: str) -> Row:
        """Sample of ``mesh`` in ``view``. Its frames are views of memory that the next call overwrites. Frames that are
        stored are exposed whole. Those that only the ground truth needs are exposed at the object's pixels alone, and
        decoded there alone: the bytes there, and so the decoded depth, are the same either way. With skipping off
        (`fpp_ml_bench.skipping`) every frame is exposed and decoded whole."""
        scene = self.trace(mesh, view)
        whole = self.light(scene)
        self.expose(scene, whole)
        exact_mm = np.zeros(self._frames.shape[1:], dtype=np.float32)
        exact_mm.ravel()[scene.hits.pixels] = scene.hits.depth_m * MM_PER_M
        depth_mm = self.ground_truth_mm(object_mask(exact_mm))
        measured = {"distance_mm": scene.distance_m * MM_PER_M, "shadow_rays": whole.shadow_rays}
        measured |= ground_truth_error(depth_mm, exact_mm)
        frames = {index: self._frames[index] for index in self.stored}
        return Row(sample_name(mesh.name, view), mesh.name, view, frames, depth_mm, exact_mm, measured)

    def trace(self, mesh: SolidMesh, view: str) -> TracedView:
        """The object in its place, seen and lit."""
        settings, rig = self.settings, self.settings.rig
        vertices_m, distance_m = place(mesh, view, rig, settings.placement, settings.seed)
        traced = TracedObject(mesh, vertices_m)
        hits = traced.primary(PixelRays.of(rig.camera))
        lit = lit_object(hits, rig, self.lighting, traced)
        return TracedView(traced, distance_m, hits, lit, (settings.seed, mesh.name, view))

    def light(self, scene: TracedView) -> LitPixels:
        """Illumination of every pixel of the image: the object's, and the plane's behind it."""
        return self.backdrop.behind(scene.traced, scene.hits.pixels).patched(scene.hits.pixels, scene.lit)

    def expose(self, scene: TracedView, whole: LitPixels) -> None:
        """Expose a view into the studio's frames; ``whole`` is the light of every pixel."""
        pixels = scene.hits.pixels
        images = self._frames.reshape(len(self._frames), -1)
        everything = not skipping_enabled()
        for run in _runs(tuple(range(len(images))) if everything else self.stored):
            self.exposure.expose(run, whole, self._pixels, scene.stream, images[run.start : run.stop])
        if self.unstored and not everything:
            exposed = self.exposure.expose(self.unstored, scene.lit, pixels.astype(np.uint32), scene.stream)
            for index, values in zip(self.unstored, exposed, strict=True):
                images[index, pixels] = values

    def ground_truth_mm(self, seen: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Decoded depth of the exposed frames at the object's pixels ``seen`` bool (H, W); float32 (H, W), 0 beyond."""
        rig = self.settings.rig
        if skipping_enabled():
            return decode_stack(self._frames, rig, direction="both", mask=seen).depth_mm
        return np.where(seen, decode_stack(self._frames, rig, direction="both").depth_mm, np.float32(0))


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
    """How far the decoded ground truth is from the exact one, per sample; mm and pixel counts, sums in float64. Over
    pixels that both have: ``gt_mae_mm``, ``gt_rmse_mm``, ``gt_bias_mm``, ``gt_max_mm``, and the first two again for
    pixels at least 3 px from a depth edge (``gt_interior_*``). ``undecoded_px`` counts object pixels without a decoded
    depth: they are background in ``depth``."""
    seen, decoded = object_mask(exact_mm), object_mask(depth_mm)
    both = seen & decoded
    error = depth_mm[both].astype(np.float64) - exact_mm[both]
    inside = error[~object_near_edge(exact_mm, INTERIOR_PX)[both]]
    return {
        "exact_px": int(seen.sum()),
        "undecoded_px": int((seen & ~decoded).sum()),
        "gt_mae_mm": _mean(np.abs(error)),
        "gt_rmse_mm": _root_mean_square(error),
        "gt_bias_mm": _mean(error),
        "gt_max_mm": float(np.abs(error).max()) if error.size else None,
        "gt_interior_px": int(inside.size),
        "gt_interior_mae_mm": _mean(np.abs(inside)),
        "gt_interior_rmse_mm": _root_mean_square(inside),
    }


def _mean(values: NDArray[np.float64]) -> float | None:
    return float(values.mean()) if values.size else None


def _root_mean_square(values: NDArray[np.float64]) -> float | None:
    return float(np.sqrt(float((values**2).mean()))) if values.size else None
