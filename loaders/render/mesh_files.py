"""Reading users' mesh files (OBJ, PLY, STL, GLB) with what they name beside them: materials and textures. Writing
meshes and point clouds as PLY."""

import base64
import io
import logging
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import xxhash
from numpy.typing import NDArray
from PIL import Image

from fpp_ml_bench.errors import MeshError
from fpp_ml_bench.files import file_hash, printable, strict_json
from fpp_ml_bench.loaders.render.paint import Paint, paint_of, texture_of

MESH_SUFFIXES = (".obj", ".ply", ".stl", ".glb")

# What trimesh's readers let through on damaged files (found by fuzzing them; ImportError: a text that is not UTF-8
# sends it looking for a package that guesses encodings).
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
    """Files that a mesh file names: what was ``read`` of them, and ``problems`` of the textures among them. trimesh
    goes on without a texture that it can't read."""

    def __init__(self, path: Path) -> None:
        super().__init__(str(path))
        self.read: list[bytes] = []
        self.problems: list[str] = []

    def get(self, name: str) -> bytes:
        """Bytes of the file ``name``."""
        suffix = Path(name).suffix.lower()
        try:
            content = super().get(name)
        except (OSError, ValueError):
            if suffix != ".mtl":  # without its materials a mesh has no colour; many are shared like that
                self.problems.append(f"names the file {printable(name)!r}, which is not beside it; put it there")
            raise
        self.read.append(content)
        if suffix == ".mtl":
            return content.decode("utf-8", errors="replace").encode()
        if suffix != ".bin":
            self.problems += _image_problems(content, printable(name))
        return content


def ply_bytes(
    points: NDArray[np.floating],
    faces: NDArray[np.integer] | None = None,
    normals: NDArray[np.floating] | None = None,
    grey: NDArray[np.floating | np.integer] | None = None,
    comment: str = "",
) -> bytes:
    """A binary PLY file: ``points`` (N, 3), triangles ``faces`` (M, 3) as indices of points, unit ``normals`` (N, 3),
    and ``grey`` (N,), grey levels of 0 to 255, as intensity and colour. ``comment``: unit and axes, for its header."""
    # A mesh without faces: trimesh can't write a PointCloud without points.
    triangles = np.zeros((0, 3), np.int64) if faces is None else faces
    solid = trimesh.Trimesh(points, triangles, vertex_normals=normals, process=False, validate=False)
    if grey is not None:
        solid.vertex_attributes["intensity"] = grey.astype(np.float32)
        shade = np.rint(grey).astype(np.uint8)
        colours = np.stack([shade, shade, shade, np.full_like(shade, 255)], axis=-1)
        solid.visual = trimesh.visual.ColorVisuals(solid, vertex_colors=colours)
    content: bytes = trimesh.exchange.ply.export_ply(solid, vertex_normal=normals is not None)
    return content.replace(b"\nelement", f"\ncomment {comment}\nelement".encode(), 1) if comment else content


def content_hash(path: Path) -> str:
    """Hash of a mesh file with all materials and textures that it names, 32 hex digits."""
    own = file_hash(path)
    if path.suffix.lower() == ".stl":  # which names none
        return own
    *_, beside = read_mesh(path)
    digest = xxhash.xxh3_128(own.encode())
    for content in beside:
        digest.update(xxhash.xxh3_128(content).digest())
    return digest.hexdigest() if beside else own


def read_mesh(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int32], Paint | None, list[bytes]]:
    """Vertices float64 (V, 3) in the file's unit, faces int32 (F, 3), the mesh's paint if it has colours, and the files
    that it names. Raises `MeshError` for a file that can't be read as a mesh, has no triangles, vertices that are not
    finite, triangles between vertices that are not there, or a texture that is damaged or missing."""
    # Its log would put a traceback of its own on the screen; what matters of it is in our message.
    logging.getLogger("trimesh").addHandler(logging.NullHandler())
    kind = path.suffix.lower().removeprefix(".")
    try:
        beside = _Beside(path)
        content = path.read_bytes()
        if kind == "obj":  # its comments may be in any encoding, and its numbers are ASCII
            content = content.decode("utf-8", errors="replace").encode()
        loaded = trimesh.load(io.BytesIO(content), file_type=kind, resolver=beside, process=False)
        geometry = loaded.dump() if isinstance(loaded, trimesh.Scene) else [loaded]
        parts = [part for part in geometry if isinstance(part, trimesh.Trimesh) and len(part.faces)]
        vertices = [np.asarray(part.vertices, dtype=np.float64) for part in parts]
        problems = beside.problems + (_glb_image_problems(content) if kind == "glb" else [])
    except _READER_ERRORS as error:
        reason = "damaged, or of another format" if isinstance(error, ImportError | NameError) else error
        raise MeshError(f"{path}: can't be read as a mesh ({reason}); expected {', '.join(MESH_SUFFIXES)}") from error
    if not parts or any(np.shape(part)[1:] != (3,) for part in vertices):
        raise MeshError(f"{path}: holds no triangles; export it as a triangle mesh")
    if not all(np.isfinite(part).all() for part in vertices):
        raise MeshError(f"{path}: has vertices that are not finite numbers; repair the mesh")
    if any(part.faces.min() < 0 or part.faces.max() >= len(part.vertices) for part in parts):
        raise MeshError(f"{path}: has triangles between vertices that are not there; it is damaged, export it again")
    if problems:
        raise MeshError(f"{path}: {problems[0]}, or take the texture out of the file")
    try:
        paint = paint_of(parts, linear_colours=kind == "glb")
    except _IMAGE_ERRORS as error:
        raise MeshError(
            f"{path}: {printable(str(error))}; its colours or texture are damaged, export it again"
        ) from error
    before = np.cumsum([0, *(len(part) for part in vertices[:-1])])
    faces = np.concatenate([part.faces + first for part, first in zip(parts, before, strict=True)])
    return np.concatenate(vertices), faces.astype(np.int32), paint, beside.read


def _image_problems(content: bytes, name: str) -> list[str]:
    """What is wrong with the bytes of an image: nothing or one sentence."""
    try:
        with Image.open(io.BytesIO(content)) as image:
            texture_of(image)
    except _IMAGE_ERRORS as error:
        return [f"its texture {name!r} can't be read ({printable(str(error))}); give another image, as PNG or JPEG"]
    return []


def _glb_image_problems(content: bytes) -> list[str]:
    """What is wrong with the images inside a GLB file."""
    length = struct.unpack_from("<I", content, 12)[0]
    header: dict[str, Any] = strict_json(content[20 : 20 + length].decode("utf-8"))
    problems = []
    for number, image in enumerate(header.get("images", [])):
        if "bufferView" in image:
            view = header["bufferViews"][image["bufferView"]]
            start = 20 + length + 8 + view.get("byteOffset", 0)
            data = content[start : start + view["byteLength"]]
        elif image.get("uri", "").startswith("data:"):
            data = base64.b64decode(image["uri"].partition(",")[2])
        else:
            continue  # a file beside it
        problems += _image_problems(data, image.get("name") or f"image {number}")
    return problems
