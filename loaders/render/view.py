"""One view of one object, from mesh to sample: frames, decoded ground truth, exact depth, and what
separates them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import GREY_LEVELS, MM_PER_M, VIEW_DEGREES, VIEWS, sample_name
from fpp_ml_bench.decoding.decode import decode_stack
from fpp_ml_bench.depth import object_mask, object_near_edges
from fpp_ml_bench.errors import BuildError, MeshError
from fpp_ml_bench.loaders.render.illumination import LitPixels
from fpp_ml_bench.loaders.render.lighting import Lighting, ObjectLight
from fpp_ml_bench.loaders.render.pixels import MixedPixels, blur_image, mixed_pixels, vignetting
from fpp_ml_bench.loaders.render.raycast import Hits, PixelRays, TracedObject
from fpp_ml_bench.loaders.render.scene import (
    BuildSettings,
    SolidMesh,
    along_rays,
    photographing_rig,
    place,
    uniform,
)
from fpp_ml_bench.loaders.render.sensor import Exposure
from fpp_ml_bench.loaders.sample import WEAK_GREY, Flag, Row, stored_frames, void_pixels
from fpp_ml_bench.portable import cosine_of_turns, gaussian_weights, power, sine_of_turns
from fpp_ml_bench.skipping import skipping_enabled

INTERIOR_PX = 3
"""Ground-truth error is told apart at this distance from a depth edge: nearer, a pixel is a matter
of definition."""
STRONG_SHARE = 0.25
"""Light of further bounces over direct light, under white, from which a pixel is flagged."""


@dataclass(frozen=True)
class TracedView:
    """An object before the camera: what the rays meet, the light of the object's pixels and of the
    pixels that mix surfaces (three arrays of `LitPixels` each as long as their rays), and the name
    of the view's noise stream."""

    traced: TracedObject
    distance_m: float
    hits: Hits
    lit: LitPixels
    mixed: MixedPixels | None
    mixed_lit: LitPixels | None
    brightness: NDArray[np.float32] | np.float32
    stream: tuple[object, ...]


class Studio:
    """A rig with its light and background, ready to photograph objects.

    One view's frames are held, and overwritten by the next.
    """

    def __init__(self, settings: BuildSettings) -> None:
        self.settings, self.light = settings, settings.light
        # Lengths are in the unit of `BuildSettings.unit_rig` until they leave the studio.
        unit_rig, error_px = settings.unit_rig, self.light.calibration_px
        self.rig = rig = photographing_rig(unit_rig, error_px, settings.seed)
        self._shrunk: tuple[SolidMesh, SolidMesh] | None = None
        self.exposure = Exposure.of(rig, self.light)
        self.lighting = Lighting(rig, self.light, self.exposure.pattern)
        camera = rig.camera
        self._pixels = np.arange(camera.width * camera.height, dtype=np.uint32)
        falloff, blur_px = self.light.camera.falloff, self.light.camera.blur_px
        self._vignetting = vignetting(camera, falloff) if falloff else None
        self._lens = gaussian_weights(blur_px**2, 3.0).astype(np.float32) if blur_px else None
        self.stored = stored_frames(rig.sequence, settings.stored)
        # Frames that the ground truth is decoded from and that are not stored: all others, mostly
        # but black and white.
        flat = any(rig.code(direction).needs_flat for direction in rig.directions)
        black_and_white = () if flat else (rig.sequence.black, rig.sequence.white)
        unneeded = {*self.stored, *rig.sequence.crossed_frames, *black_and_white}
        self.unstored = tuple(i for i in range(len(rig.sequence)) if i not in unneeded)
        self._frames = np.zeros((len(rig.sequence), camera.height, camera.width), dtype=np.uint8)

    def photograph(self, mesh: SolidMesh, view: str) -> Row:
        """Sample of ``mesh`` in ``view``. Its frames are views of memory that the next call
        overwrites.

        Raises `MeshError` for an object that is on no pixel, `BuildError` where none of its pixels
        can be decoded. Frames that are stored are exposed whole. Those that only the ground truth
        needs are exposed at the object's pixels alone, and decoded there alone: the bytes there,
        and so the decoded depth, are the same either way. With skipping off
        (`fpp_ml_bench.skipping`) every frame is exposed and decoded whole.
        """
        settings, scene = self.settings, self.trace(mesh, view)
        shadow_rays = self.expose_view(mesh, view, scene)
        exact_mm = self.exact_mm(scene)
        depth_mm = self.ground_truth_mm(object_mask(exact_mm))
        if not depth_mm.any():
            counts = decode_stack(
                self._frames, settings.stated_rig, mask=object_mask(exact_mm)
            ).counts
            counts["not_asked"] = 0
            reasons = ", ".join(
                f"{name.replace('_', ' ')} {count}" for name, count in counts.items() if count
            )
            raise BuildError(
                f"sample {sample_name(mesh.name, view)!r}: none of its {len(scene.hits.pixels)} "
                f"object pixels can be "
                f"decoded ({reasons}); check the rig's pose and code, and how bright --light is"
            )
        flags, cover = self.flags(scene)
        distance_mm = scene.distance_m * settings.object_scale * MM_PER_M
        measured = {"distance_mm": distance_mm, "shadow_rays": shadow_rays}
        measured["mixed_rays"] = 0 if scene.mixed is None else len(scene.mixed.points_m)
        measured |= ground_truth_error(depth_mm, exact_mm, flags)
        frames = {index: self._frames[index] for index in self.stored}
        return Row(
            sample_name(mesh.name, view),
            mesh.name,
            view,
            frames,
            depth_mm,
            exact_mm,
            measured,
            flags,
            cover,
        )

    def trace(
        self, mesh: SolidMesh, view: str, moved_m: NDArray[np.float64] | None = None
    ) -> TracedView:
        """The object in its place, or ``moved_m`` (3,) from there, seen and lit."""
        settings, rig = self.settings, self.rig
        vertices_m, distance_m = place(mesh, view, settings.rig, settings.placement, settings.seed)
        if settings.object_scale != 1:
            vertices_m = vertices_m / settings.object_scale
            distance_m, mesh = distance_m / settings.object_scale, self._in_unit(mesh)
        offset_m = np.array([0.0, 0.0, distance_m])
        if moved_m is not None:
            vertices_m, offset_m = vertices_m + moved_m, offset_m + moved_m
        traced = TracedObject(mesh, vertices_m)
        hits = traced.primary(PixelRays.of(rig.camera))
        if not hits.pixels.size:
            unit_mm = MM_PER_M * settings.object_scale
            size_mm = unit_mm * float(np.ptp(vertices_m, axis=0).max())
            pixel_mm = unit_mm * distance_m / rig.camera.fx
            raise MeshError(
                f"object {mesh.name!r} is on no pixel in view {view}: it is {size_mm:.3g} mm "
                f"large, and a pixel "
                f"{distance_m * settings.object_scale:g} m from the camera is {pixel_mm:.3g} mm; scale it up, or build "
                f"with more px (--size)"
            )
        turned_degrees = VIEW_DEGREES[VIEWS.index(view)]
        stream = (settings.seed, mesh.name, view)
        return self.lit(mesh, traced, hits, distance_m, turned_degrees, offset_m, stream)

    def lit(
        self,
        mesh: SolidMesh,
        traced: TracedObject,
        hits: Hits,
        distance_m: float,
        degrees: float,
        offset_m: NDArray[np.float64],
        stream: tuple[object, ...],
    ) -> TracedView:
        """What is seen of ``mesh``, turned by ``degrees`` and moved by ``offset_m`` (3,) to be
        ``traced``, with its light."""
        rig, light = self.rig, self.light
        object_light = ObjectLight(self.lighting, mesh, traced, degrees, offset_m)
        x, y = (axis.ravel()[hits.pixels] for axis in rig.camera.rays())
        points_m = along_rays(x, y, hits.depth_m)
        lit = object_light.at(points_m, hits.normals, hits.triangle)
        mixed = mixed_lit = None
        if light.camera.rays_across > 1:
            shaded = lit.gain > 0 if light.bounces.shadows else None
            mixed = mixed_pixels(traced, hits, rig, light.camera.rays_across, shaded)
            mixed_lit = object_light.at(mixed.points_m, mixed.normals, mixed.triangle)
        return TracedView(
            traced, distance_m, hits, lit, mixed, mixed_lit, self.brightness(stream), stream
        )

    def _in_unit(self, mesh: SolidMesh) -> SolidMesh:
        """``mesh``, the same one for all its views, in the studio's unit of length."""
        if self._shrunk is None or self._shrunk[0] is not mesh:
            vertices_m = mesh.vertices_m / self.settings.object_scale
            self._shrunk = mesh, replace(mesh, vertices_m=vertices_m)
        return self._shrunk[1]

    def exact_mm(self, scene: TracedView) -> NDArray[np.float32]:
        """Exact depth (H, W) of what the camera sees of the object, 0 beyond."""
        exact_mm = np.zeros(self._frames.shape[1:], dtype=np.float32)
        unit_mm = MM_PER_M * self.settings.object_scale
        exact_mm.ravel()[scene.hits.pixels] = scene.hits.depth_m * unit_mm
        return exact_mm

    def brightness(self, stream: tuple[object, ...]) -> NDArray[np.float32] | np.float32:
        """The view's exposure times the lens's vignetting, for every pixel or one for all."""
        exposure = self.light.camera.exposure
        if isinstance(exposure, tuple):
            low, high = exposure
            exposure = low / float(power(np.array([low / high]), uniform(*stream, "exposure"))[0])
        return (
            np.float32(exposure)
            if self._vignetting is None
            else self._vignetting * np.float32(exposure)
        )

    def expose_view(self, mesh: SolidMesh, view: str, scene: TracedView) -> int:
        """Expose a view into the studio's frames; returns how many shadow rays its light took."""
        frames = (
            tuple(range(len(self._frames)))
            if not skipping_enabled()
            else self.stored + self.unstored
        )
        if self.light.motion_mm == 0:
            return self.expose(scene, frames)
        return self.expose_moving(mesh, view, {frame: frame for frame in frames})

    def expose_moving(self, mesh: SolidMesh, view: str, steps: Mapping[int, float]) -> int:
        """Expose frames of an object that moves: each at so many steps of ``motion_mm`` from its
        place, all in one direction drawn for the view. Returns how many shadow rays their light
        took."""
        stream = (self.settings.seed, mesh.name, view)
        height, turn = 2 * uniform(*stream, "height") - 1, uniform(*stream, "turn")
        level = np.sqrt(1 - height * height)
        direction = np.array([level * cosine_of_turns(turn), height, level * sine_of_turns(turn)])
        step_m = direction * (self.light.motion_mm / MM_PER_M)
        return sum(
            self.expose(self.trace(mesh, view, step_m * step), (frame,))
            for frame, step in steps.items()
        )

    def expose(self, scene: TracedView, frames: tuple[int, ...]) -> int:
        """Expose ``frames`` of a view into the studio's; those not stored at the object's pixels
        alone, unless it moves or the lens blurs. Returns how many shadow rays their light took."""
        exposure, images = self.exposure, self._frames.reshape(len(self._frames), -1)
        behind = self.lighting.behind(scene.traced, scene.hits.pixels)
        parts = [(scene.hits.pixels, scene.lit)]
        if scene.mixed is not None and scene.mixed_lit is not None:
            parts.append((scene.mixed.pixels, scene.mixed_lit))
        shadow_rays = behind.shadow_rays + sum(lit.shadow_rays for _, lit in parts)
        plain = np.ndim(scene.brightness) == 0 and scene.brightness == 1
        if not plain:
            behind = behind.brighter(scene.brightness)
            parts = [
                (pixels, lit.brighter(self._of(scene.brightness, pixels, lit)))
                for pixels, lit in parts
            ]
        if self._lens is not None:
            image, between = np.empty((2, *self._frames.shape[1:]), dtype=np.float32)
            for frame in frames:
                exposure.radiance((frame,), behind, scene.stream, image.reshape(1, -1))
                for pixels, lit in parts:
                    light = np.empty((1, pixels.size), dtype=np.float32)
                    image.ravel()[pixels] = exposure.radiance((frame,), lit, scene.stream, light)[0]
                blur_image(image, self._lens, between)
                exposure.sense(
                    (frame,),
                    image.reshape(1, -1),
                    self._pixels,
                    scene.stream,
                    images[frame : frame + 1],
                )
            return shadow_rays
        # An object that moves leaves pixels of the first frame, where all are decoded.
        everything = not skipping_enabled() or self.light.motion_mm > 0
        whole = [frame for frame in frames if everything or frame not in self.unstored]
        for frame in whole:
            out = images[frame : frame + 1]
            exposure.expose((frame,), behind, self._pixels, scene.stream, out)
        for pixels, lit in parts:
            exposed = exposure.expose(frames, lit, pixels.astype(np.uint32), scene.stream)
            for index, values in zip(frames, exposed, strict=True):
                images[index, pixels] = values
        return shadow_rays

    def frame(self, index: int) -> NDArray[np.uint8]:
        """The frame ``index`` as it was exposed last, uint8 (H, W); overwritten by the next
        view."""
        return self._frames[index]

    @staticmethod
    def _of(
        brightness: NDArray[np.float32] | np.float32, pixels: NDArray[np.int64], lit: LitPixels
    ) -> NDArray[np.float32] | np.float32:
        """Brightness at the rays of ``lit``, which has one or several for each of ``pixels``."""
        if isinstance(brightness, np.ndarray) and brightness.ndim:
            return np.repeat(brightness[pixels], lit.gain.size // max(pixels.size, 1))
        return brightness

    def flags(self, scene: TracedView) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """What is special about each pixel (`Flag`), and the share of it that the surface of its
        central ray covers, in 255ths; uint8 (H, W) each."""
        shape, pixels, lit = self._frames.shape[1:], scene.hits.pixels, scene.lit
        flags, cover = (
            np.zeros(self._pixels.size, dtype=np.uint8),
            np.full(self._pixels.size, 255, dtype=np.uint8),
        )
        flags[pixels[lit.gain == 0]] |= np.uint8(Flag.UNLIT)
        bounced = np.zeros_like(lit.gain) if lit.bounced is None else self._of_white(lit.bounced)
        white = (lit.gain + lit.ambient + bounced) * self._of(scene.brightness, pixels, lit)
        flags[pixels[white + self.light.camera.black_grey >= GREY_LEVELS]] |= np.uint8(
            Flag.SATURATED
        )
        flags[pixels[(bounced > STRONG_SHARE * lit.gain) & (lit.gain > 0)]] |= np.uint8(
            Flag.INTERREFLECTION
        )
        fringes = lit.gain * self._of(scene.brightness, pixels, lit) / 2
        flags[pixels[(lit.gain > 0) & ((fringes < WEAK_GREY) | (bounced > lit.gain))]] |= np.uint8(
            Flag.WEAK
        )
        if scene.mixed is not None:
            flags[scene.mixed.pixels[scene.mixed.void]] |= np.uint8(Flag.MIXED)
            cover[scene.mixed.pixels] = np.rint(255 * scene.mixed.share).astype(np.uint8)
        return flags.reshape(shape), cover.reshape(shape)

    def _of_white(self, bounced: NDArray[np.float32]) -> NDArray[np.float32]:
        """What white light would bring, of what each frame's brings, float32 (F, n): without a
        white frame twice the mean of the fringes, whose steps add up to half of it, or of Gray
        frames and their inverses."""
        sequence = self.rig.sequence
        if sequence.white is not None:
            return bounced[sequence.white]  # type: ignore[no-any-return]
        way = (self.rig.fringe_directions or self.rig.directions)[0]
        fringes = list(sequence.sinusoids(way) or sequence.gray(way))
        return 2 * bounced[fringes].mean(axis=0)  # type: ignore[no-any-return]

    def ground_truth_mm(self, seen: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Decoded depth of the exposed frames at the object's pixels ``seen`` bool (H, W); float32
        (H, W), 0 beyond."""
        rig = self.settings.stated_rig
        if skipping_enabled():
            return decode_stack(self._frames, rig, direction="both", mask=seen).depth_mm
        return np.where(
            seen, decode_stack(self._frames, rig, direction="both").depth_mm, np.float32(0)
        )


def ground_truth_error(
    depth_mm: NDArray[np.float32], exact_mm: NDArray[np.float32], flags: NDArray[np.uint8]
) -> dict[str, Any]:
    """How far the decoded ground truth is from the exact one, per sample; mm and pixel counts, sums
    in float64.

    Over pixels that both have and that are not void: ``gt_mae_mm``, ``gt_rmse_mm``, ``gt_bias_mm``,
    ``gt_max_mm``, and the first two again for pixels at least 3 px from a depth edge
    (``gt_interior_*``). ``undecoded_px`` counts object pixels without a decoded depth, which are
    background in ``depth``; the others pixels by their `Flag`.
    """
    seen, decoded = object_mask(exact_mm), object_mask(depth_mm)
    void = void_pixels(flags)
    both = seen & decoded & ~void
    error = depth_mm[both].astype(np.float64) - exact_mm[both]
    inside = error[~object_near_edges(exact_mm, (INTERIOR_PX,))[0][both]]
    return {
        "exact_px": int(seen.sum()),
        "undecoded_px": int((seen & ~decoded).sum()),
        "void_px": int((seen & void).sum()),
        **{f"{str(flag.name).lower()}_px": int(((flags & flag) > 0).sum()) for flag in Flag},
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
