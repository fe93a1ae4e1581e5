"""The benchmark's 50 ground-truth objects and the 20 of the set ``unseen``, as procedural watertight meshes.

Each of the 50 is drawn in millimetres at its real size, in a pose that shows it to the camera of the first view, and
enlarged. The paper's simulator enlarges by 1.5 as a rule, thin objects by 3 to 5, boards not at all; ours depart from
it where its image statistics need it: a view covers 3 to 40% of the image and a tenth on average, half the views span
less than about 80 mm in depth. Source: own shapes after the names of the YCB and warehouse objects that the paper
scanned. The unseen ones are drawn at the size that they have in the scene.
"""

import numpy as np
import trimesh

from fpp_ml_bench.constants import MM_PER_M, OBJECTS, UNSEEN
from fpp_ml_bench.errors import MeshError
from fpp_ml_bench.loaders.render.objects import containers, household, tools, unseen  # noqa: F401  which draw them
from fpp_ml_bench.loaders.render.objects.solids import DRAWINGS, on_grid
from fpp_ml_bench.options import did_you_mean

SLIVER_MM = 1e-2  # edges shorter than this are collapsed: booleans leave slivers there, and no pixel sees one
FINAL_GRID_MM = 2.0**-8  # of the finished mesh: two hundred to a pixel, and coarse enough to leave no sliver


def object_mesh(name: str) -> trimesh.Trimesh:
    """Mesh of a benchmark's or an unseen object, at the size it has in the scene: metres, z up, watertight, centred
    at the origin. The turning axis is z; the camera of the first view looks along +x. Raises `MeshError` for an
    unknown name."""
    if name not in DRAWINGS:
        names = (*OBJECTS, *UNSEEN)
        raise MeshError(
            f"expected one of the benchmark's {len(names)} objects, got {name!r}; {did_you_mean(name, names)}"
        )
    solid = on_grid(DRAWINGS[name](), FINAL_GRID_MM).as_original().simplify(SLIVER_MM)
    mesh = solid.to_mesh64()
    vertices_m = mesh.vert_properties[:, :3] / MM_PER_M
    low, high = vertices_m.min(axis=0), vertices_m.max(axis=0)
    faces = np.asarray(mesh.tri_verts, dtype=np.int64)
    return trimesh.Trimesh(vertices_m - (low + high) / 2, faces, process=False, validate=False)
