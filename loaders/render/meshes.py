"""Meshes by name: procedural objects, and users' own files (OBJ, PLY, STL, GLB) with scale and pose."""

import math
from collections import Counter
from dataclasses import fields
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from fpp_ml_bench.constants import OBJECT_NAME, OBJECTS, SPLITS, UNSEEN
from fpp_ml_bench.errors import MeshError
from fpp_ml_bench.files import is_file, printable, read_yaml, write_atomically
from fpp_ml_bench.loaders.render.mesh_files import MESH_SUFFIXES, content_hash, ply_bytes, read_mesh
from fpp_ml_bench.loaders.render.objects import object_mesh
from fpp_ml_bench.loaders.render.scene import SolidMesh, UserMesh
from fpp_ml_bench.portable import cosine_of_turns, sine_of_turns

_NAME_CHARACTERS = set("abcdefghijklmnopqrstuvwxyz0123456789_")
_KEPT = 4
"""The benchmark's objects that a process keeps, and with them their surfels (`Lighting`, about 10 MB each): drawing and
tracing one takes about a second."""


def solid_mesh(name: str, user_meshes: tuple[UserMesh, ...] = ()) -> SolidMesh:
    """Mesh ``name`` ready for the scene: metres, z up, about its turning axis. The same for the same name, as long as
    it is kept."""
    user = {mesh.name: mesh for mesh in user_meshes}
    return load_user_mesh(user[name]) if name in user else _drawn(name)


@lru_cache(maxsize=_KEPT)
def _drawn(name: str) -> SolidMesh:
    mesh = object_mesh(name)
    return SolidMesh(name, np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int32))


def load_user_mesh(description: UserMesh) -> SolidMesh:
    """Read, scale and pose a user's mesh: x scale, then turns about x, y and z, then centred, then shifted. Its
    colours and textures come along. Raises `MeshError` as `read_mesh` does."""
    vertices, faces, paint = read_mesh(Path(description.path))
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


def read_mesh_list(path: Path) -> tuple[UserMesh, ...]:
    """Users' meshes from a YAML list; raises `MeshError` naming the entry and the key.

    ::

        - {name: my_part, path: part.stl, scale: 0.001, rotation_deg: [90, 0, 0], split: test}

    ``path`` is relative to the list's own folder; ``scale`` takes the file's unit to metres.
    """
    content = read_yaml(path, MeshError)
    if not isinstance(content, list) or not content:
        raise MeshError(f"{path}: expected a list of meshes, each with name and path, got {type(content).__name__}")
    meshes = tuple(_entry(entry, f"{path}, entry {i + 1}", path.parent) for i, entry in enumerate(content))
    name, count = Counter(mesh.name for mesh in meshes).most_common(1)[0]
    if count > 1:
        raise MeshError(f"{path}: the name {name!r} is given twice")
    return meshes


def single_mesh(path: Path) -> UserMesh:
    """A user's mesh given by its file alone: named after the file, in metres, in split test."""
    stem = "".join(c if c in _NAME_CHARACTERS else "_" for c in path.stem.lower())
    return _entry({"name": stem, "path": path.name}, str(path), path.parent)


def _entry(entry: object, where: str, folder: Path) -> UserMesh:
    keys = {item.name for item in fields(UserMesh)} - {"content"}
    if not isinstance(entry, dict) or not {"name", "path"} <= set(entry):
        raise MeshError(f"{where}: expected a mapping with name and path, got {entry!r}")
    unknown = set(map(str, entry)) - keys
    if unknown:
        raise MeshError(f"{where}: unknown key {sorted(unknown)[0]!r}; there are {', '.join(sorted(keys))}")
    name = entry["name"]
    if not isinstance(name, str) or not OBJECT_NAME.fullmatch(name) or not set(name) <= _NAME_CHARACTERS:
        raise MeshError(f"{where}: name must be of a-z, 0-9 and _, at most 100 of them, got {printable(name)!r}")
    if name in (*OBJECTS, *UNSEEN):
        raise MeshError(f"{where}: {name!r} is one of the benchmark's own objects; choose another name")
    file = folder / str(entry["path"])
    if file.suffix.lower() not in MESH_SUFFIXES or not is_file(file):
        raise MeshError(f"{where}: {printable(str(file), 500)} is no mesh file; expected {', '.join(MESH_SUFFIXES)}")
    split, scale = entry.get("split", "test"), _finite(entry.get("scale", 1.0), f"{where}: scale")
    if split not in SPLITS:
        raise MeshError(f"{where}: split {split!r}, expected {', '.join(SPLITS)}")
    if scale <= 0:
        raise MeshError(f"{where}: scale must be above 0, got {scale:g}")
    triples: dict[str, Any] = {}
    for key in ("rotation_deg", "offset_m"):
        values = entry.get(key, [0.0, 0.0, 0.0])
        if not isinstance(values, list) or len(values) != 3:
            raise MeshError(f"{where}: {key} must be three numbers, got {values!r}")
        triples[key] = tuple(_finite(value, f"{where}: {key}") for value in values)
    centre = entry.get("centre", True)
    if not isinstance(centre, bool):
        raise MeshError(f"{where}: centre must be true or false, got {centre!r}")
    return UserMesh(name, str(file), scale, centre=centre, split=split, content=content_hash(file), **triples)


def _finite(value: object, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise MeshError(f"{where} must be a number, got {value!r}")
    return float(value)
