"""A mesh's own albedo: the colours that its file gives to corners, faces and materials, and the
images on it.

Of a colour only the luminance counts, with the weights of ITU-R BT.709, after its 8-bit sRGB values
(IEC 61966-2-1) have been made linear. In a GLB all colours but those of images are linear already
(glTF 2.0, section 3.9.2).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
import xxhash
from numpy.typing import NDArray
from PIL import Image

from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.portable import dot, power

LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Of red, green and blue of BT.709, which are those of sRGB."""
MOST_TEXTURE_PX = 1 << 26
"""Of one image; all that a mesh names have at most twice as many."""
_ROWS_AT_ONCE = 256
"""Rows of an image whose luminance is computed at once: it takes eight bytes a channel and
pixel."""


@dataclass(frozen=True)
class Paint:
    """Luminance on the F triangles of a mesh, from 0 to 1: that of their corners times that of the
    image on them.

    ``corner`` float32 (F, 3), linear. ``uv`` float32 (F, 3, 2): the corners' places on an image, v
    up, which repeats beyond [0, 1]. ``image`` int32 (F,): row of ``images``, -1 for none; each is
    float32 (H, W), linear.
    """

    corner: NDArray[np.float32]
    uv: NDArray[np.float32]
    image: NDArray[np.int32]
    images: tuple[NDArray[np.float32], ...] = ()

    def at(
        self, triangle: NDArray[np.integer], weights: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Luminance at the places of ``triangle`` (n,) that have the barycentric ``weights`` (n,
        3); float64 (n,)."""
        luminance = dot(self.corner[triangle], weights)
        on = self.image[triangle]
        for number, image in enumerate(self.images):
            here = np.flatnonzero(on == number)
            u, v = (dot(self.uv[triangle[here], :, axis], weights[here]) for axis in (0, 1))
            luminance[here] *= bilinear(image, u, v)
        return luminance


def barycentric(corners: NDArray[np.float64], position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights float64 (n, 3), none below 0, of the corners (n, 3, 3) of n triangles at positions
    (n, 3) on them."""
    a = corners[:, 0]
    first, second, to = corners[:, 1] - a, corners[:, 2] - a, position - a
    normal = np.cross(first, second)
    squared = (normal * normal).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):  # of triangles without an area
        b = (np.cross(to, second) * normal).sum(axis=1) / squared
        c = (np.cross(first, to) * normal).sum(axis=1) / squared
    b = np.clip(np.nan_to_num(b), 0.0, 1.0)
    c = np.clip(np.nan_to_num(c), 0.0, 1.0 - b)
    return np.column_stack([1.0 - b - c, b, c])


def bilinear(
    image: NDArray[np.float32], u: NDArray[np.float64], v: NDArray[np.float64]
) -> NDArray[np.float64]:
    """A repeating image (H, W) at places (n,) in its widths and heights from the lower left corner;
    float64 (n,)."""
    height, width = image.shape
    x, y = (u - np.floor(u)) * width - 0.5, (np.ceil(v) - v) * height - 0.5
    left, top = np.floor(x), np.floor(y)
    across, down = x - left, y - top
    columns, rows = (
        [(first.astype(np.int64) + step) % size for step in (0, 1)]
        for first, size in ((left, width), (top, height))
    )
    upper = image[rows[0], columns[0]] * (1.0 - across) + image[rows[0], columns[1]] * across
    lower = image[rows[1], columns[0]] * (1.0 - across) + image[rows[1], columns[1]] * across
    return upper * (1.0 - down) + lower * down


def _linear_table() -> NDArray[np.float64]:
    level = np.arange(GREY_LEVELS + 1) / GREY_LEVELS
    return np.where(level <= 0.04045, level / 12.92, power((level + 0.055) / 1.055, 2.4))


_LINEAR = _linear_table()


def linear_luminance(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Linear luminance of 8-bit sRGB colours (..., 3); float32 (...)."""
    return _luminance(_LINEAR[rgb])


def _luminance(linear: NDArray[np.float64]) -> NDArray[np.float32]:
    red, green, blue = (weight * linear[..., channel] for channel, weight in enumerate(LUMINANCE))
    return np.asarray(red + green + blue, dtype=np.float32)


def texture_of(image: Image.Image) -> NDArray[np.float32]:
    """Linear luminance of an image, float32 (H, W); its transparency is of no consequence. Raises
    ``ValueError`` for one that is too large or of numbers that are no colours, and what Pillow
    raises for a damaged one."""
    if image.width * image.height > MOST_TEXTURE_PX:
        raise ValueError(
            f"{image.width} x {image.height} px, expected at most {MOST_TEXTURE_PX} px in all"
        )
    if image.mode == "F":
        raise ValueError("has floating-point pixels, expected 8 or 16 bits")
    deep = image.mode.startswith("I")  # 16 bits
    levels = np.asarray(image if deep else image.convert("RGB"))
    result = np.empty(levels.shape[:2], np.float32)
    for start in range(0, len(levels), _ROWS_AT_ONCE):
        rows = levels[start : start + _ROWS_AT_ONCE]
        grey = np.clip(np.rint(rows / 257), 0, GREY_LEVELS).astype(np.uint8) if deep else None
        result[start : start + _ROWS_AT_ONCE] = (
            linear_luminance(rows) if grey is None else _LINEAR[grey]
        )
    return result


def paint_of(parts: Sequence[trimesh.Trimesh], linear_colours: bool) -> Paint | None:
    """The paint of parts that are joined in this order, or None if none of them has colours.
    ``linear_colours``: those of corners and materials are linear. Raises ``ValueError`` for colours
    that can't be right."""
    images: dict[bytes, NDArray[np.float32]] = {}  # materials may share one
    corners, places, numbers = [], [], []
    painted = False
    for part in parts:
        corner, uv, image = _of_part(part, linear_colours)
        painted |= corner is not None or image is not None
        faces = len(part.faces)
        corners.append(np.ones((faces, 3), dtype=np.float32) if corner is None else corner)
        places.append(np.zeros((faces, 3, 2), dtype=np.float32) if uv is None else uv)
        number = -1
        if image is not None:
            images.setdefault(digest := xxhash.xxh3_128_digest(image), image)
            number = list(images).index(digest)
        numbers.append(np.full(faces, number, dtype=np.int32))
    if not painted:
        return None
    return Paint(
        np.concatenate(corners),
        np.concatenate(places),
        np.concatenate(numbers),
        tuple(images.values()),
    )


def _of_part(part: trimesh.Trimesh, linear_colours: bool) -> tuple[Any, Any, Any]:
    """Corners' luminance (F, 3), their uv (F, 3, 2) and the image (H, W) on them, each None if
    there is none."""
    visual: Any = part.visual
    if visual.kind == "face":
        return (
            np.repeat(
                _colours(visual.face_colors, len(part.faces), linear_colours)[:, None], 3, axis=1
            ),
            None,
            None,
        )
    if visual.kind == "vertex":
        return (
            _colours(visual.vertex_colors, len(part.vertices), linear_colours)[part.faces],
            None,
            None,
        )
    if visual.kind != "texture":
        return None, None, None
    material, corner, uv, texture = visual.material, None, None, None
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if image is not None and image == trimesh.visual.material.empty_material().image:
        image = None  # what trimesh gives to places on a texture that the file does not name
    if image is not None and visual.uv is not None:
        uv = np.asarray(visual.uv, dtype=np.float64)
        if uv.ndim != 2 or len(uv) != len(part.vertices) or uv.shape[1] < 2:
            raise ValueError("has not one place on its texture for each vertex")
        uv = uv[part.faces, :2].astype(np.float32)
        if not np.isfinite(uv).all() or np.abs(uv).max() > 1e6:
            raise ValueError("has places on its texture that are not finite, or far beyond it")
        texture = texture_of(image)
    colour = getattr(material, "baseColorFactor", None)
    if (
        colour is None and texture is None
    ):  # beside an image an MTL's diffuse colour is often black, and not meant
        colour = getattr(material, "kwargs", {}).get("kd")
    if colour is not None:
        colour = np.asarray(colour)
        share = colour / GREY_LEVELS if colour.dtype == np.uint8 else colour.astype(np.float64)
        if share.ndim != 1 or len(share) < 3 or not np.isfinite(share).all():
            raise ValueError("has a material whose colour is not three numbers")
        levels = np.rint(np.clip(share, 0, 1) * GREY_LEVELS).astype(np.uint8)[None]
        corner = np.full((len(part.faces), 3), _colours(levels, 1, linear_colours)[0])
    own = (visual.vertex_attributes or {}).get("color")
    if own is not None:
        own = _colours(trimesh.visual.color.to_rgba(own), len(part.vertices), linear_colours)[
            part.faces
        ]
        corner = own if corner is None else corner * own
    return corner, uv, texture


def _colours(colours: NDArray[np.uint8], count: int, linear: bool) -> NDArray[np.float32]:
    """Luminance of ``count`` 8-bit colours (count, 3 or 4)."""
    if colours.ndim != 2 or len(colours) != count or colours.shape[1] < 3:
        raise ValueError(f"has colours of shape {colours.shape}, expected {count} of them")
    rgb = colours[:, :3]
    return _luminance(rgb / GREY_LEVELS) if linear else linear_luminance(rgb)
