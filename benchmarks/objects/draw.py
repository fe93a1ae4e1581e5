"""Draw the meshes that come with the package: the benchmark's 50 objects and the 20 of the set
``unseen``.

    pip install -U pip && pip install --group objects
    python benchmarks/objects/draw.py                      all, into loaders/render/objects.npz
    python benchmarks/objects/draw.py --check banana gear  do these drawings give the meshes that are there?

Each of the 50 is drawn in millimetres at its real size, in a pose that shows it to the camera of
the first view, and enlarged. The paper's simulator enlarges by 1.5 as a rule, thin objects by 3 to
5, boards not at all; ours depart from it where its image statistics need it: a view covers 3 to 40%
of the image and a tenth on average, half the views span less than about 80 mm in depth. Source: own
shapes after the names of the YCB and warehouse objects that the paper scanned. The unseen ones are
drawn at the size that they have in the scene.

The bytes depend on the version of manifold3d, so the meshes are frozen data, and ``--check`` needs
the pinned one. Exit status 1 if a drawing is another than the mesh in the package, 2 for an unknown
name.
"""

import argparse
import io
import sys
from collections.abc import Mapping

import containers
import household
import numpy as np
import tools
import unseen
from numpy.typing import NDArray
from solids import DRAWINGS, on_grid

from fpp_ml_bench.constants import OBJECTS, UNSEEN
from fpp_ml_bench.errors import MeshError
from fpp_ml_bench.loaders.render.meshes import MESH_GRID_MM, MESHES_FILE, stored_mesh

DRAWN_BY = (containers, household, tools, unseen)
"""The modules whose functions are in `DRAWINGS`."""
SLIVER_MM = 1e-2
"""Edges shorter than this are collapsed: booleans leave slivers there, and no pixel sees one."""
OTHER, REFUSED = 1, 2


def drawing(name: str) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Vertices (V, 3) in steps of `MESH_GRID_MM`, and faces (F, 3), as they are stored."""
    solid = on_grid(DRAWINGS[name](), MESH_GRID_MM).as_original().simplify(SLIVER_MM).to_mesh64()
    steps = np.rint(solid.vert_properties[:, :3] / MESH_GRID_MM).astype(np.int64)
    return steps, np.asarray(solid.tri_verts, dtype=np.int32)


def pack_meshes(meshes: Mapping[str, tuple[NDArray[np.integer], NDArray[np.integer]]]) -> bytes:
    """Content of `MESHES_FILE` for vertices and faces as `stored_mesh` gives them."""
    rows = {}
    for name, parts in meshes.items():
        for part, values in zip(("vertices", "faces"), parts, strict=True):
            rows[f"{name}.{part}"] = np.diff(values, axis=0, prepend=0).astype(np.int32)
    content = io.BytesIO()
    np.savez_compressed(content, allow_pickle=False, **rows)
    return content.getvalue()


def main() -> int:
    """Draw and write, or draw and compare."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--check", action="store_true", help="compare with the meshes in the package, write nothing"
    )
    parser.add_argument(
        "names", nargs="*", help="objects (default: all); without --check all are drawn"
    )
    arguments = parser.parse_args()
    names = arguments.names if arguments.check and arguments.names else [*OBJECTS, *UNSEEN]
    if not arguments.check:
        content = pack_meshes({name: drawing(name) for name in names})
        MESHES_FILE.write_bytes(content)
        print(f"{MESHES_FILE}: {len(names)} meshes, {len(content):,} bytes")
        return 0
    try:
        kept = {name: stored_mesh(name) for name in names}
    except MeshError as error:
        print(error, file=sys.stderr)
        return REFUSED
    other = [name for name in names if not all(map(np.array_equal, drawing(name), kept[name]))]
    for name in other:
        print(f"{name}: drawn as another mesh than the package's")
    print(f"{len(names) - len(other)} of {len(names)} drawings are the package's meshes")
    return OTHER if other else 0


if __name__ == "__main__":
    sys.exit(main())
