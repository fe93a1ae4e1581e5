"""Meshes by name: the benchmark's objects, and users' own files (OBJ, PLY, STL, GLB) with scale and
pose.

The 50 objects and the 20 of the set ``unseen`` are data, `MESHES_FILE`.
``benchmarks/objects/draw.py`` draws them.
"""

import re
from collections import Counter
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field

from fpp_ml_bench.constants import MM_PER_M, OBJECTS, UNSEEN
from fpp_ml_bench.errors import MeshError
from fpp_ml_bench.files import is_file, printable, read_yaml, write_atomically
from fpp_ml_bench.loaders.render.mesh_files import MESH_SUFFIXES, content_hash, ply_bytes, read_mesh
from fpp_ml_bench.loaders.render.scene import SolidMesh, UserMesh
from fpp_ml_bench.options import did_you_mean
from fpp_ml_bench.portable import cosine_of_turns, sine_of_turns
from fpp_ml_bench.schema import Positive, StrictModel, as_tuple, validate

Triple = Annotated[tuple[float, float, float], BeforeValidator(as_tuple)]
MESHES_FILE = Path(__file__).with_name("objects.npz")
"""For each object NAME.vertices and NAME.faces, int32 (V, 3) and (F, 3), each row less the row
before it: a fifth smaller than the rows themselves. Deflated, since xz is a fifth smaller again and
takes 16 ms a mesh, not 1."""
MESH_GRID_MM = 2.0**-8
"""Unit of their vertices: two hundred steps to a pixel at 1.8 m, and coarse enough to leave no
sliver."""
_KEPT = 4
"""The benchmark's objects that a process keeps, and with them their surfels (`Lighting`, about 10
MB each): tracing one takes half a second."""


def solid_mesh(name: str, user_meshes: tuple[UserMesh, ...] = ()) -> SolidMesh:
    """Mesh ``name`` ready for the scene: metres, z up, about its turning axis. The same for the
    same name, as long as it is kept. Raises `MeshError` for an unknown name."""
    user = {mesh.name: mesh for mesh in user_meshes}
    return load_user_mesh(user[name]) if name in user else _benchmark_mesh(name)


@lru_cache(maxsize=_KEPT)
def _benchmark_mesh(name: str) -> SolidMesh:
    """Centred at the origin. The camera of the first view looks along +x."""
    steps, faces = stored_mesh(name)
    vertices_m = steps * MESH_GRID_MM / MM_PER_M
    low, high = vertices_m.min(axis=0), vertices_m.max(axis=0)
    return SolidMesh(name, vertices_m - (low + high) / 2, faces)


def stored_mesh(name: str) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Vertices (V, 3) in steps of `MESH_GRID_MM`, and faces (F, 3), of one of the package's meshes.
    Raises `MeshError` for an unknown name."""
    names = (*OBJECTS, *UNSEEN)
    if name not in names:
        expected = f"expected one of the benchmark's {len(names)} objects, got {name!r}"
        raise MeshError(f"{expected}; {did_you_mean(name, names)}")
    with np.load(MESHES_FILE) as stored:
        steps = np.cumsum(stored[f"{name}.vertices"], axis=0, dtype=np.int64)
        return steps, np.cumsum(stored[f"{name}.faces"], axis=0, dtype=np.int32)


def load_user_mesh(description: UserMesh) -> SolidMesh:
    """Read, scale and pose a user's mesh: x scale, then turns about x, y and z, then centred, then
    shifted. Its colours and textures come along. Raises `MeshError` as `read_mesh` does."""
    vertices, faces, paint, _ = read_mesh(Path(description.path))
    vertices_m = vertices * description.scale
    for axis, degrees in enumerate(description.rotation_deg):
        cosine, sine = cosine_of_turns(degrees / 360), sine_of_turns(degrees / 360)
        first, second = (axis + 1) % 3, (axis + 2) % 3
        a, b = vertices_m[:, first].copy(), vertices_m[:, second].copy()
        vertices_m[:, first], vertices_m[:, second] = cosine * a - sine * b, sine * a + cosine * b
    if description.centre:
        vertices_m = vertices_m - (vertices_m.min(axis=0) + vertices_m.max(axis=0)) / 2
    vertices_m = vertices_m + np.asarray(description.offset_m)
    return SolidMesh(description.name, vertices_m, faces, paint)


def write_ply(mesh: SolidMesh, path: Path) -> None:
    """Write a mesh as binary PLY in metres, object coordinates."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, ply_bytes(mesh.vertices_m, mesh.faces))


class MeshEntry(StrictModel):
    """An entry of a list of meshes. ``path`` is relative to the list's own folder; ``scale`` takes
    the file's unit to metres; then come turns (degrees about x, y, z, in that order), centring and
    a shift."""

    name: Annotated[str, Field(pattern="^[a-z0-9_]{1,100}$")]
    path: str
    scale: Positive = 1.0
    rotation_deg: Triple = (0.0, 0.0, 0.0)
    offset_m: Triple = (0.0, 0.0, 0.0)
    centre: bool = True
    split: Literal["train", "validation", "test"] = "test"

    def mesh(self, list_file: Path) -> UserMesh:
        """The mesh that it names. Raises `MeshError` for a name of the benchmark and a file that is
        no mesh."""
        if self.name in (*OBJECTS, *UNSEEN):
            raise MeshError(
                f"{list_file}: {self.name!r} is one of the benchmark's own objects; choose another "
                f"name"
            )
        file = list_file.parent / self.path
        if file.suffix.lower() not in MESH_SUFFIXES or not is_file(file):
            shown = printable(str(file), 500)
            raise MeshError(
                f"{list_file}: {shown} is no mesh file; expected {', '.join(MESH_SUFFIXES)}"
            )
        return UserMesh(**{**self.model_dump(), "path": str(file)}, content=content_hash(file))


def read_mesh_list(path: Path) -> tuple[UserMesh, ...]:
    """Users' meshes from a YAML list of `MeshEntry`; raises `MeshError` naming the entry and the
    key.

    ::

        - {name: my_part, path: part.stl, scale: 0.001, rotation_deg: [90, 0, 0], split: test}
    """
    content = read_yaml(path, MeshError)
    if not isinstance(content, list) or not content:
        raise MeshError(
            f"{path}: expected a list of meshes, each with name and path, got "
            f"{type(content).__name__}"
        )
    entries = [
        validate(MeshEntry, value, path, f"list of meshes, entry {number}", MeshError)
        for number, value in enumerate(content, 1)
    ]
    name, count = Counter(entry.name for entry in entries).most_common(1)[0]
    if count > 1:
        raise MeshError(f"{path}: the name {name!r} is given twice")
    return tuple(entry.mesh(path) for entry in entries)


def single_mesh(path: Path) -> UserMesh:
    """A user's mesh given by its file alone: named after the file, in metres, in split test."""
    name = re.sub("[^a-z0-9_]", "_", path.stem.lower())
    return validate(MeshEntry, {"name": name, "path": path.name}, path, "mesh", MeshError).mesh(
        path
    )
