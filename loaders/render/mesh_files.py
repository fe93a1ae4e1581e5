"""Reading users' mesh files (OBJ, PLY, STL, GLB) with what they name beside them: materials and
textures. Writing meshes and point clouds as PLY."""

import base64
import io
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import xxhash
from numpy.typing import NDArray
from PIL import Image

from fpp_ml_bench.containers import (
    LARGEST_BYTES,
    Answer,
    arrays_of,
    from_file,
    guarded,
    limit_memory,
    with_arrays,
)
from fpp_ml_bench.errors import MeshError, PredictionError
from fpp_ml_bench.files import file_hash, printable, read_bounded, strict_json
from fpp_ml_bench.loaders.render.paint import MOST_TEXTURE_PX, Paint, paint_of, texture_of

MESH_SUFFIXES = (".obj", ".ply", ".stl", ".glb")
MOST_PARTS = 20_000
"""Of a GLB, each placed where it stands: trimesh takes 10 s for so many."""
_UNPACKED_BYTES = 3 << 27
"""What a mesh may unpack to beside its own size: its textures, whose luminance takes 4 bytes a
pixel."""

# What trimesh's readers let through on damaged files (found by fuzzing them; ImportError: a text
# that is not UTF-8 sends it looking for a package that guesses encodings).
_READER_ERRORS = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    EOFError,
    ImportError,
    LookupError,
    NameError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
    struct.error,
)
_IMAGE_ERRORS = (*_READER_ERRORS, SyntaxError, Image.DecompressionBombError, zlib.error)


class _Beside(trimesh.resolvers.FilePathResolver):
    """Files that a mesh file names: hashes of those that were ``read``, and ``problems`` of them.
    trimesh goes on without a texture that it can't read. Only regular files below the mesh's own
    folder are opened."""

    def __init__(self, path: Path) -> None:
        super().__init__(str(path))
        self.read: list[str] = []
        self.problems: list[str] = []
        self.textures: dict[str, int] = {}
        """Pixels of the images among them, by hash."""

    def get(self, name: str) -> bytes:
        """Bytes of the file ``name``."""
        suffix, folder = Path(name).suffix.lower(), Path(self.parent).resolve()
        tries = (
            folder / part for part in (name.strip(), name.strip().lstrip("/"), Path(name).name)
        )
        place = next(
            (path for path in tries if path.resolve().is_relative_to(folder) and path.exists()),
            None,
        )
        if place is None:
            if (
                suffix != ".mtl"
            ):  # without its materials a mesh has no colour; many are shared like that
                self.problems.append(
                    f"names the file {printable(name)!r}, which is not beside it; put it there"
                )
            raise FileNotFoundError(name)
        try:
            content = read_bounded(place, LARGEST_BYTES, "make it smaller", links=True)
        except PredictionError as error:
            self.problems.append(f"names the file {printable(name)!r}, which {error}")
            raise
        self.read.append(xxhash.xxh3_128(content).hexdigest())
        if suffix == ".mtl":
            return content.decode("utf-8", errors="replace").encode()
        if suffix != ".bin":
            self.note(content, printable(name))
        return content

    def note(self, content: bytes, name: str) -> None:
        """Look at an image, at its header first."""
        try:
            with Image.open(io.BytesIO(content)) as image:
                self.textures[xxhash.xxh3_128(content).hexdigest()] = image.width * image.height
                if (total_px := sum(self.textures.values())) > 2 * MOST_TEXTURE_PX:
                    self.problems.append(
                        f"has textures of {total_px} px, expected {2 * MOST_TEXTURE_PX}; shrink "
                        f"them"
                    )
                    return
                texture_of(image)
        except _IMAGE_ERRORS as error:
            reason = printable(str(error))
            self.problems.append(
                f"its texture {name!r} can't be read ({reason}); give another image, as PNG or JPEG"
            )

    def namespaced(self, namespace: str) -> "_Beside":
        raise ValueError("a mesh names files beside it only")


def ply_bytes(
    points: NDArray[np.floating],
    faces: NDArray[np.integer] | None = None,
    normals: NDArray[np.floating] | None = None,
    grey: NDArray[np.floating | np.integer] | None = None,
    comment: str = "",
) -> bytes:
    """A binary PLY file: ``points`` (N, 3), triangles ``faces`` (M, 3) as indices of points, unit
    ``normals`` (N, 3), and ``grey`` (N,), grey levels of 0 to 255, as intensity and colour.
    ``comment``: unit and axes, for its header."""
    # A mesh without faces: trimesh can't write a PointCloud without points.
    triangles = np.zeros((0, 3), np.int64) if faces is None else faces
    solid = trimesh.Trimesh(
        points, triangles, vertex_normals=normals, process=False, validate=False
    )
    if grey is not None:
        solid.vertex_attributes["intensity"] = grey.astype(np.float32)
        shade = np.rint(grey).astype(np.uint8)
        colours = np.stack([shade, shade, shade, np.full_like(shade, 255)], axis=-1)
        solid.visual = trimesh.visual.ColorVisuals(solid, vertex_colors=colours)
    content: bytes = trimesh.exchange.ply.export_ply(solid, vertex_normal=normals is not None)
    return (
        content.replace(b"\nelement", f"\ncomment {comment}\nelement".encode(), 1)
        if comment
        else content
    )


def content_hash(path: Path) -> str:
    """Hash of a mesh file with all materials and textures that it names, 32 hex digits."""
    own = file_hash(path)
    if path.suffix.lower() == ".stl":  # which names none
        return own
    *_, beside = read_mesh(path)
    digest = xxhash.xxh3_128(own.encode())
    for content in beside:
        digest.update(bytes.fromhex(content))
    return digest.hexdigest() if beside else own


def read_mesh(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int32], Paint | None, list[str]]:
    """Vertices float64 (V, 3) in the file's unit, faces int32 (F, 3), the mesh's paint if it has
    colours, and hashes of the files that it names. It is read in another process, as `containers`
    says. Raises `MeshError` for a file that can't be read as a mesh, has no triangles, vertices
    that are not finite, triangles between vertices that are not there, or a texture that is damaged
    or missing, and for one that takes too much memory or time."""

    def parse(content: bytes) -> Answer:
        return guarded(
            _read_mesh, content, len(content) + _UNPACKED_BYTES, path=str(path.absolute())
        )

    facts, values = from_file(parse, path, MeshError, cure="make the mesh smaller")
    vertices, faces, *paint = arrays_of(facts, values)
    painted = Paint(paint[0], paint[1], paint[2], tuple(paint[3:])) if paint else None
    return vertices, faces, painted, facts["beside"]


def _read_mesh(content: bytes, largest: int, path: str) -> Answer:
    kind, beside = Path(path).suffix.lower().removeprefix("."), _Beside(Path(path))
    limit_memory(largest)
    try:
        if kind == "obj":  # its comments may be in any encoding, and its numbers are ASCII
            content = content.decode("utf-8", errors="replace").encode()
        if kind == "glb":
            _look_into_glb(content, beside)
        loaded = trimesh.load(io.BytesIO(content), file_type=kind, resolver=beside, process=False)
        geometry = loaded.dump() if isinstance(loaded, trimesh.Scene) else [loaded]
        parts = [part for part in geometry if isinstance(part, trimesh.Trimesh) and len(part.faces)]
        vertices = [np.asarray(part.vertices, dtype=np.float64) for part in parts]
    except PredictionError as error:
        raise PredictionError(beside.problems[0] if beside.problems else str(error)) from None
    except _READER_ERRORS as error:
        reason = (
            "damaged, or of another format" if isinstance(error, ImportError | NameError) else error
        )
        raise PredictionError(
            f"can't be read as a mesh ({reason}); expected {', '.join(MESH_SUFFIXES)}"
        ) from None
    if not parts or any(np.shape(part)[1:] != (3,) for part in vertices):
        raise PredictionError("holds no triangles; export it as a triangle mesh")
    if not all(np.isfinite(part).all() for part in vertices):
        raise PredictionError("has vertices that are not finite numbers; repair the mesh")
    if any(part.faces.min() < 0 or part.faces.max() >= len(part.vertices) for part in parts):
        raise PredictionError(
            "has triangles between vertices that are not there; it is damaged, export it again"
        )
    if beside.problems:
        raise PredictionError(f"{beside.problems[0]}, or take the texture out of the file")
    try:
        paint = paint_of(parts, linear_colours=kind == "glb")
    except _IMAGE_ERRORS as error:
        reason = printable(str(error))
        raise PredictionError(
            f"{reason}; its colours or texture are damaged, export it again"
        ) from None
    before = np.cumsum([0, *(len(part) for part in vertices[:-1])])
    faces = np.concatenate(
        [part.faces + first for part, first in zip(parts, before, strict=True)]
    ).astype(np.int32)
    painted = () if paint is None else (paint.corner, paint.uv, paint.image, *paint.images)
    return with_arrays({"beside": beside.read}, np.concatenate(vertices), faces, *painted)


def _look_into_glb(content: bytes, beside: _Beside) -> None:
    """Refuse a GLB of too many parts, and note what is wrong with the images inside it."""
    length = struct.unpack_from("<I", content, 12)[0]
    header: dict[str, Any] = strict_json(content[20 : 20 + length].decode("utf-8"))
    if (parts := len(header.get("nodes", []))) > MOST_PARTS:
        raise PredictionError(
            f"has {parts} parts, expected at most {MOST_PARTS}; join them into fewer"
        )
    for number, image in enumerate(header.get("images", [])):
        if "bufferView" in image:
            view = header["bufferViews"][image["bufferView"]]
            start = 20 + length + 8 + view.get("byteOffset", 0)
            data = content[start : start + view["byteLength"]]
        elif image.get("uri", "").startswith("data:"):
            data = base64.b64decode(image["uri"].partition(",")[2])
        else:
            continue  # a file beside it
        beside.note(data, image.get("name") or f"image {number}")
