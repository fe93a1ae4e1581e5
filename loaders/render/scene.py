"""What a build is asked for, and where things stand: settings, and an object placed before the
camera.

Two builds with equal settings give equal bytes. An object stands on its turning axis, at a fixed or
a drawn distance. Object coordinates are metres with z up and the turning axis as z. Camera
coordinates are the rig's: x right, y down, z forward. At angle 0 the object's +x axis points away
from the camera (paper Section 3.1: R_z(60 degrees x i)).
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from hashlib import blake2b
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import (
    CONFIGS,
    MM_PER_M,
    OBJECTS,
    PRESETS,
    STANDOFF_M,
    UNSEEN,
    VIEW_DEGREES,
    VIEWS,
    WORKING_RANGE_MM,
)
from fpp_ml_bench.errors import BuildError, MeshError
from fpp_ml_bench.loaders.render.light import Light, named_light
from fpp_ml_bench.optics.named_rigs import NAMED_RIGS
from fpp_ml_bench.optics.pinhole import Pinhole
from fpp_ml_bench.optics.rig import Rig, middle_m
from fpp_ml_bench.options import did_you_mean
from fpp_ml_bench.portable import cosine_of_turns, matrix_product, sine_of_turns

if TYPE_CHECKING:  # the name of a benchmark needs settings alone
    from fpp_ml_bench.loaders.render.paint import Paint

PlacementRule = Literal["fixed", "varied"]
PLACEMENTS: tuple[PlacementRule, ...] = ("fixed", "varied")
PHOTOGRAPHED_BY = "photographed_by"
"""Key of the settings that holds the true rig of a dataset that was decoded with another."""

SAME_VOLUME = 0.02
"""Difference of a rig's volume from that of the paper's, which a calibration of it may have."""
_MARGIN_PX = 2.0
"""Distance in px that an object keeps from the sides of the image, so that its whole outline is
seen."""


@dataclass(frozen=True)
class UserMesh:
    """A mesh of the user's: file, scale, turn (degrees about x, y, z, in that order), shift, split,
    hash of its bytes and its textures'."""

    name: str
    path: str
    scale: float = 1.0
    rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    centre: bool = True
    split: str = "test"
    content: str = ""


@dataclass(frozen=True)
class BuildSettings:
    """Everything that decides the bytes of a dataset.

    ``rig`` photographs. ``decode_with`` is what a calibration found of it: the ground truth is
    decoded with that rig, and it is the dataset's, as in a lab. ``object_scale``: how many times
    their size the benchmark's objects have, with all that is on them and the lens's focus; users'
    meshes keep theirs. ``views``: those of `VIEWS` that are photographed.

    ``objects`` and ``user_meshes`` are kept in one order, the benchmark's, the unseen ones and then
    the users' by name, whatever order they were given in: it is the order of the rows.
    """

    rig: Rig
    objects: tuple[str, ...]
    placement: PlacementRule = "fixed"
    stored: str = "all"
    seed: int = 42
    light: Light = field(default_factory=lambda: named_light("paper"))
    user_meshes: tuple[UserMesh, ...] = field(default=())
    decode_with: Rig | None = None
    object_scale: float = 1.0
    views: tuple[str, ...] = VIEWS

    def __post_init__(self) -> None:
        if not 0 < self.object_scale < math.inf:
            raise BuildError(f"object scale {self.object_scale:g}: expected a number above 0")
        names = {*OBJECTS, *UNSEEN, *(mesh.name for mesh in self.user_meshes)}
        for name in self.objects:
            if name not in names:
                raise BuildError(f"unknown object {name!r}; {did_you_mean(name, sorted(names))}")
        if not self.objects:
            raise BuildError("no object to build: name at least one")
        if len(set(self.objects)) != len(self.objects):
            twice = next(name for name in self.objects if self.objects.count(name) > 1)
            raise BuildError(f"object {twice!r} is named twice")
        user_meshes = sorted(self.user_meshes, key=lambda mesh: mesh.name)
        order = (*OBJECTS, *UNSEEN, *(mesh.name for mesh in user_meshes))
        object.__setattr__(self, "user_meshes", tuple(user_meshes))
        object.__setattr__(self, "objects", tuple(sorted(self.objects, key=order.index)))
        if self.placement not in PLACEMENTS:
            raise BuildError(f"placement {self.placement!r}: expected {' or '.join(PLACEMENTS)}")
        if self.stored not in CONFIGS:
            raise BuildError(f"frames {self.stored!r}: expected one of {', '.join(CONFIGS)}")
        if not self.views or list(self.views) != [view for view in VIEWS if view in self.views]:
            raise BuildError(f"views {self.views!r}: expected some of {', '.join(VIEWS)}, in order")
        if not 0 <= self.seed < 2**63:
            raise BuildError(f"seed {self.seed}: expected a whole number from 0 to 2^63 - 1")
        self.rig.check_sampling()
        if not self.rig.directions:
            raise BuildError(
                "this rig projects crossed fringes alone, from which no ground truth can be "
                "decoded; add the "
                "horizontal or vertical code to its sequence (it need not be stored: --config "
                "crossed)"
            )
        if not self.rig.sequence.config(self.stored):
            raise BuildError(f"frames {self.stored!r}: this rig's sequence has none of them")
        if self.decode_with is not None:
            _check_same_devices(self.rig, self.decode_with)
        if self.light.projector.defocus_px > 0:
            from fpp_ml_bench.loaders.render.projector import check_focus  # loads numba

            check_focus(self.unit_rig, self.light.projector)

    @property
    def unit_rig(self) -> Rig:
        """The rig in the unit of length in which the benchmark's objects have their own size."""
        return self.rig if self.object_scale == 1 else self.rig.times(1 / self.object_scale)

    def sized(self, mesh: SolidMesh) -> SolidMesh:
        """``mesh`` in the size in which it is built."""
        own = any(mesh.name == user_mesh.name for user_mesh in self.user_meshes)
        if own or self.object_scale == 1:
            return mesh
        return replace(mesh, vertices_m=mesh.vertices_m * self.object_scale)

    @property
    def stated_rig(self) -> Rig:
        """The rig that the dataset states: it decodes the ground truth, and methods get it. As
        after a calibration of one's own, it says how large its error is."""
        rig = self.rig if self.decode_with is None else self.decode_with
        return replace(
            rig, calibration_px=math.hypot(rig.calibration_px, self.light.calibration_px)
        )

    def describe(self) -> dict[str, Any]:
        """The settings as plain data for the manifest and for comparing an interrupted build with
        this one."""
        described: dict[str, Any] = {
            "objects": list(self.objects),
            "placement": self.placement,
            "frames": self.stored,
            "seed": self.seed,
            "light": self.light.model_dump(mode="json"),
            "user_meshes": [
                {
                    key: list(value) if isinstance(value, tuple) else value
                    for key, value in asdict(mesh).items()
                    if key != "path"
                }
                for mesh in self.user_meshes
            ],
        }
        if self.object_scale != 1:
            described["object_scale"] = self.object_scale
        if self.views != VIEWS:
            described["views"] = list(self.views)
        return (
            described
            if self.decode_with is None
            else {**described, PHOTOGRAPHED_BY: self.rig.to_dict()}
        )


def _check_same_devices(rig: Rig, other: Rig) -> None:
    """Raise `BuildError` where frames that ``rig`` takes can't be decoded by ``other``."""
    for device in ("camera", "projector"):
        sizes = [
            (part.width, part.height) for part in (getattr(rig, device), getattr(other, device))
        ]
        if sizes[0] != sizes[1]:
            (w, h), (other_w, other_h) = sizes
            raise BuildError(
                f"the rig to decode with has a {device} of {other_w} x {other_h} px, and the one "
                f"that photographs "
                f"{w} x {h} px; calibrate at the size that is built"
            )
    codes = [
        [this_rig.code(direction) for direction in this_rig.directions] for this_rig in (rig, other)
    ]
    if list(rig.sequence) != list(other.sequence) or codes[0] != codes[1]:
        raise BuildError(
            "the rig to decode with has another sequence or pitch than the one that photographs; "
            "give both the same "
            "pitch_px and sequence"
        )


def preset_settings(
    preset: str, size: int | None = None, light: str = "paper", rig: str = "paper"
) -> BuildSettings:
    """The settings of ``fpp-bench build --preset PRESET [--size SIZE] [--light LIGHT] [--rig
    RIG]``, all else at its default."""
    objects, preset_size = PRESETS[preset]
    named = NAMED_RIGS[rig](size or preset_size)
    return BuildSettings(named, objects, stored=default_frames(rig), light=named_light(light))


def default_frames(rig: str) -> str:
    """The configuration that ``fpp-bench build --rig RIG`` stores unless ``--config`` says
    otherwise: of a crossed rig its crossed frames, of any other all frames."""
    return "crossed" if rig in NAMED_RIGS and rig != "paper" else "all"


def modulation_at(rig: Rig, depth_mm: float, light: Light | None = None) -> float:
    """Modulation in grey levels of a surface at ``depth_mm`` that faces the projector: half of what
    white adds there, by the inverse square of the distance, at the least exposure of a view."""
    camera = (light or named_light("paper")).camera
    exposure = camera.exposure[0] if isinstance(camera.exposure, tuple) else camera.exposure
    return exposure * camera.reference_grey / 2 * (rig.working_range_mm[0] / depth_mm) ** 2


@dataclass(frozen=True, eq=False)
class SolidMesh:
    """Triangles of one object: ``vertices_m`` float64 (V, 3) in object coordinates, ``faces`` int32
    (F, 3), and the albedo of its own that a user's mesh may have, by triangle. Equal to itself
    alone."""

    name: str
    vertices_m: NDArray[np.float64]
    faces: NDArray[np.int32]
    paint: Paint | None = None


def volume_scale(rig: Rig) -> float:
    """How many times their size the benchmark's objects may have for all to fit a rig's volume,
    rounded down to three digits: the smaller of what the working range and the field of view hold,
    by what those of the paper's rig do; 1 for what differs from it by less than `SAME_VOLUME`."""
    (near, far), standoff = rig.working_range_mm, rig.standoff_m * MM_PER_M
    paper_near, paper_far = WORKING_RANGE_MM
    paper_standoff = STANDOFF_M * MM_PER_M
    before = min(paper_standoff - paper_near, paper_far - paper_standoff)
    by_depth = min(standoff - near, far - standoff) / before
    width, paper_width = (_half_view(this_rig.camera) for this_rig in (rig, NAMED_RIGS["paper"]()))
    # The nearest point of an object lies ``before`` times the scale before the standoff.
    by_view = standoff * width / (paper_width * paper_near + before * width)
    scale = min(by_depth, by_view)
    if abs(scale - 1) < SAME_VOLUME:
        return 1.0
    digits = 2 - math.floor(math.log10(scale))
    return math.floor(scale * 10**digits) / 10**digits


def light_of_volume(light: Light, rig: Rig, scale: float) -> Light:
    """``light``, one of the named, in a world whose objects are ``scale`` times as large: focused in
    the middle of the rig's range, in the unit of `BuildSettings.unit_rig`."""
    if scale == 1:
        return light
    return light.changed("projector", focus_m=middle_m(rig.times(1 / scale).working_range_mm))


def _half_view(camera: Pinhole) -> float:
    """Tangent from the axis to the nearest border of the image."""
    across = min(camera.cx + 0.5, camera.width - 0.5 - camera.cx) / camera.fx
    return min(across, min(camera.cy + 0.5, camera.height - 0.5 - camera.cy) / camera.fy)


def photographing_rig(rig: Rig, calibration_px: float, seed: int) -> Rig:
    """The rig that photographs where ``rig`` is its calibration: the projector turned and its
    principal point shifted, so that points in the working range land ``calibration_px`` (RMS)
    beside where the calibration puts them."""
    if calibration_px == 0:
        return rig
    draws = [2 * uniform(seed, "calibration", part) - 1 for part in ("x", "y", "z", "u", "v")]
    near_m, far_m = rig.range_m
    across, down = (
        (np.arange(16) + 0.5) * (length / 16) - 0.5
        for length in (rig.camera.width, rig.camera.height)
    )
    x, y = (axis.ravel() for axis in rig.camera.normalised(*np.meshgrid(across, down)))
    points = np.concatenate([along_rays(x, y, depth) for depth in (near_m, far_m)])
    before = rig.project(points)
    scale = 1.0 / rig.projector.fx
    for _ in range(3):  # displacements are all but linear in the scale
        turn = np.array(draws[:3]) * (scale / 2)
        cross = np.array(
            [[0.0, -turn[2], turn[1]], [turn[2], 0.0, -turn[0]], [-turn[1], turn[0], 0.0]]
        )
        small = np.eye(3) + 2.0 / (1.0 + float((turn * turn).sum())) * (
            cross + matrix_product(cross, cross)
        )  # Cayley's formula
        shifted = {
            "cx": draws[3] * scale * rig.projector.fx,
            "cy": draws[4] * scale * rig.projector.fx,
        }
        projector = replace(
            rig.projector, cx=rig.projector.cx + shifted["cx"], cy=rig.projector.cy + shifted["cy"]
        )
        first, second, third = (tuple(row) for row in matrix_product(small, rig.R).tolist())
        tx, ty, tz = matrix_product(small, rig.t[:, None]).ravel().tolist()
        other = replace(
            rig, projector=projector, rotation=(first, second, third), translation_m=(tx, ty, tz)
        )
        u, v = other.project(points)
        squares = (u - before[0]) ** 2 + (v - before[1]) ** 2
        scale *= calibration_px / float(np.sqrt(np.nanmean(squares)))
    return other


def name_bytes(*name: object) -> bytes:
    """Eight bytes that depend only on ``name``, such as ``(seed, object, view, frame)``."""
    return blake2b("\x1f".join(map(str, name)).encode(), digest_size=8).digest()


def uniform(*name: object) -> float:
    """A number in [0, 1) that depends only on ``name``."""
    return int.from_bytes(name_bytes(*name), "little") / 2.0**64


def turned(vertices_m: NDArray[np.float64], degrees: float) -> NDArray[np.float64]:
    """Vertices after R_z(degrees), along the camera's axes but still about the turning axis; (V, 3)
    metres."""
    cosine, sine = cosine_of_turns(degrees / 360), sine_of_turns(degrees / 360)
    x = cosine * vertices_m[:, 0] - sine * vertices_m[:, 1]
    y = sine * vertices_m[:, 0] + cosine * vertices_m[:, 1]
    return np.column_stack([-y, -vertices_m[:, 2], x])


def unturned(points_m: NDArray[np.float64], degrees: float) -> NDArray[np.float64]:
    """The inverse of `turned`: object coordinates of points (n, 3) about the turning axis along the
    camera's axes."""
    cosine, sine = cosine_of_turns(degrees / 360), sine_of_turns(degrees / 360)
    x, y = points_m[:, 2], -points_m[:, 0]
    return np.column_stack([cosine * x + sine * y, cosine * y - sine * x, -points_m[:, 1]])


def along_rays(
    x: NDArray[np.float64], y: NDArray[np.float64], depth_m: NDArray[np.float64] | float
) -> NDArray:
    """Points at a depth, a number or (n,), on the rays (x, y, 1), (n,) each; float64 (n, 3) in
    metres."""
    return np.column_stack([x, y, np.ones_like(x)]) * np.reshape(depth_m, (-1, 1))


def distance_bounds_m(about_axis_m: NDArray[np.float64], rig: Rig) -> tuple[float, float]:
    """Nearest and farthest distance of the turning axis that keeps a turned object in range and
    inside the image.

    ``about_axis_m`` (V, 3) from `turned`. The bounds may be crossed (near > far): then the object
    fits nowhere.
    """
    near_m, far_m = rig.range_m
    camera = rig.camera
    left = (camera.cx - _MARGIN_PX) / camera.fx
    right = (camera.width - 1 - camera.cx - _MARGIN_PX) / camera.fx
    top = (camera.cy - _MARGIN_PX) / camera.fy
    bottom = (camera.height - 1 - camera.cy - _MARGIN_PX) / camera.fy
    x, y, z = about_axis_m.T
    needs = [near_m - z.min()]
    for offset, low, high in ((x, left, right), (y, top, bottom)):
        needs += [float(np.max(offset / high - z)), float(np.max(-offset / low - z))]
    return float(max(needs)), float(far_m - z.max())


def place(
    mesh: SolidMesh, view: str, rig: Rig, rule: PlacementRule, seed: int
) -> tuple[NDArray[np.float64], float]:
    """Vertices in camera coordinates (V, 3) in metres, and the distance of the turning axis in
    metres.

    ``fixed`` puts the axis at the rig's standoff; ``varied`` draws the distance, seeded by (seed,
    object, view), over all that keeps the object within the working range and the image. Raises
    `MeshError` for an object that does not fit, with the scale at which it would in every view.
    """
    about_axis_m = turned(mesh.vertices_m, VIEW_DEGREES[VIEWS.index(view)])
    nearest_m, farthest_m = distance_bounds_m(about_axis_m, rig)
    tolerance_m = 1e-9
    if rule == "fixed":
        distance_m = rig.standoff_m
        fits = nearest_m - tolerance_m <= distance_m <= farthest_m + tolerance_m
    else:
        distance_m = nearest_m + (farthest_m - nearest_m) * uniform(
            seed, mesh.name, view, "distance"
        )
        fits = nearest_m <= farthest_m
    if not fits:
        raise MeshError(_misfit(mesh, view, rig, rule))
    return about_axis_m + np.array([0.0, 0.0, distance_m]), distance_m


_OTHER_UNITS_M = (0.001, "mm"), (0.01, "cm"), (0.0254, "inches")
_SMALLEST_PART_M = 0.02
"""A mesh is proposed in a unit in which it is as large as this or larger: 25 pixels of the paper's
rig."""


def _misfit(mesh: SolidMesh, view: str, rig: Rig, rule: PlacementRule) -> str:
    size = " x ".join(f"{extent:.3f}" for extent in np.ptp(mesh.vertices_m, axis=0))
    near_mm, far_mm = rig.working_range_mm
    where = (
        f"with its turning axis {rig.standoff_m} m from the camera"
        if rule == "fixed"
        else "at any distance"
    )
    scale = _largest_scale(mesh, rig, rule)
    advice = (
        f"scale it, offset included, by {scale:g} or less"
        if scale > 0
        else "no scale makes it fit: move it"
    )
    largest_m = np.ptp(mesh.vertices_m, axis=0).max()
    units = [
        (size, unit)
        for size, unit in _OTHER_UNITS_M
        if size <= scale and size * largest_m >= _SMALLEST_PART_M
    ]
    if units:
        listed = " or ".join(f"{size:g} for {unit}" for size, unit in units)
        advice += (
            f" (if its numbers are no metres, list it in a file for --meshes with scale: {listed})"
        )
    return (
        f"object {mesh.name!r} ({size} m) does not fit the working range {near_mm:g}-{far_mm:g} mm "
        f"and the image in "
        f"view {view} {where}; {advice}, or give a rig with a wider range"
    )


def _largest_scale(mesh: SolidMesh, rig: Rig, rule: PlacementRule) -> float:
    """Factor up to 1 at which the mesh fits in every view, rounded down to three digits; 0 if none
    does."""
    views = [turned(mesh.vertices_m, degrees) for degrees in VIEW_DEGREES]

    def fits(scale: float) -> bool:
        bounds = (distance_bounds_m(about_axis_m * scale, rig) for about_axis_m in views)
        return all(
            near <= (rig.standoff_m if rule == "fixed" else far) <= far for near, far in bounds
        )

    low, high = 0.0, 1.0
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    if low < 1e-6:  # not even a point fits there
        return 0.0
    digit = 10.0 ** (np.floor(np.log10(low)) - 2)
    return float(np.floor(low / digit) * digit)
