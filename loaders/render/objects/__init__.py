"""The benchmark's 50 ground-truth objects and the 20 of the set ``unseen``, as procedural watertight meshes.

Each of the 50 is drawn in millimetres at its real size, in a pose that shows it to the camera of the first view, and
enlarged. The paper's simulator enlarges by 1.5 as a rule, thin objects by 3 to 5, boards not at all; ours depart from
it where its image statistics need it: a view covers 3 to 40% of the image and a tenth on average, half the views span
less than about 80 mm in depth. Source: own shapes after the names of the YCB and warehouse objects that the paper
scanned. The unseen ones are drawn at the size that they have in the scene.
"""

import numpy as np
import trimesh

from fpp_ml_bench.constants import MM_PER_M, UNSEEN
from fpp_ml_bench.errors import MeshError
from fpp_ml_bench.loaders.render.objects import containers, household, tools, unseen
from fpp_ml_bench.loaders.render.objects.solids import Solid, on_grid
from fpp_ml_bench.options import did_you_mean

__all__ = ["ENLARGED", "object_mesh"]

SLIVER_MM = 1e-2  # edges shorter than this are collapsed: booleans leave slivers there, and no pixel sees one
FINAL_GRID_MM = 2.0**-8  # of the finished mesh: two hundred to a pixel, and coarse enough to leave no sliver

ENLARGED: dict[str, float] = {
    "master_chef_can": 1.32,
    "cracker_box": 1.75,
    "sugar_box": 2.1,
    "tomato_soup_can": 2.25,
    "mustard_bottle": 1.48,
    "tuna_fish_can": 3.0,
    "pudding_box": 2.7,
    "gelatin_box": 3.3,
    "potted_meat_can": 2.65,
    "banana": 3.0,
    "pitcher": 1.85,
    "bleach_cleanser": 1.35,
    "bowl": 2.6,
    "mug": 3.2,
    "power_drill": 1.72,
    "wood_block": 2.1,
    "scissors": 2.6,
    "marker": 4.0,
    "large_clamp": 2.15,
    "eyeglasses": 2.55,
    "open_book": 1.65,
    "spray_bottle": 1.6,
    "cleaning_bucket": 1.5,
    "container_bottle": 1.8,
    "container_tin": 1.32,
    "vial": 4.6,
    "lighting_candles": 1.75,
    "magazine_stack": 1.27,
    "wooden_boards": 1.0,
    "paint_container_bottle": 3.0,
    "paint_container_jar": 1.68,
    "paint_container_spraycan": 2.05,
    "paint_container_tube_small": 4.35,
    "paint_container_tube": 2.88,
    "paint_container_tube_large": 1.78,
    "paint_brush": 2.35,
    "paint_brush_large": 2.1,
    "pallet_knife": 2.15,
    "pallet_knife_large": 1.95,
    "spraygun": 1.45,
    "paint_thinner": 1.7,
    "battery": 4.9,
    "battery_case": 4.2,
    "chalk_stick": 4.9,
    "pen": 4.2,
    "cork": 4.5,
    "clamp": 2.0,
    "boxcutter": 2.5,
    "hammer": 1.8,
    "duct_tape": 2.4,
}
"""How much larger than life each object stands in the scene; a function of its name draws it."""
_SCALE = {**ENLARGED, **dict.fromkeys(UNSEEN, 1.0)}
_DRAWN = {**vars(containers), **vars(household), **vars(tools), **vars(unseen)}


def object_mesh(name: str) -> trimesh.Trimesh:
    """Mesh of a benchmark's or an unseen object, at the size it has in the scene: metres, z up, watertight, centred
    at the origin. The turning axis is z; the camera of the first view looks along +x. Raises `MeshError` for an
    unknown name."""
    if name not in _SCALE:
        raise MeshError(
            f"expected one of the benchmark's {len(_SCALE)} objects, got {name!r}; {did_you_mean(name, _SCALE)}"
        )
    drawn: Solid = _DRAWN[name]()
    solid = on_grid(drawn.scale((_SCALE[name],) * 3), FINAL_GRID_MM).as_original().simplify(SLIVER_MM)
    mesh = solid.to_mesh64()
    vertices_m = mesh.vert_properties[:, :3] / MM_PER_M
    low, high = vertices_m.min(axis=0), vertices_m.max(axis=0)
    faces = np.asarray(mesh.tri_verts, dtype=np.int64)
    return trimesh.Trimesh(vertices_m - (low + high) / 2, faces, process=False, validate=False)
