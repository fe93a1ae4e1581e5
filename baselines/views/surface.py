"""How near a point cloud is to an object's surface, and how much of the surface it covers."""

from functools import cached_property
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import KDTree

from fpp_ml_bench.baselines.views.placement import Points, Values
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.errors import DatasetError
from fpp_ml_bench.loaders.render import SolidMesh, UserMesh, load_user_mesh
from fpp_ml_bench.loaders.storage import MESH_FOLDER, DatasetFolder

SAMPLES = 200_000
"""Points on a surface, uniform over its area: 1 to 2 mm apart on the benchmark's objects."""
_CANDIDATES = 4


class Surface:
    """A mesh to measure clouds against, object coordinates in metres. Its samples are the same in every run."""

    def __init__(self, mesh: SolidMesh, samples: int) -> None:
        solid = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
        self._corners = np.asarray(solid.triangles, dtype=np.float64)
        points, faces = trimesh.sample.sample_surface(solid, samples, seed=0)[:2]
        self.samples_m, self._faces = np.asarray(points, dtype=np.float64), np.asarray(faces)

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(self.samples_m)

    def distances_mm(self, points_m: Points) -> Values:
        """Distance in mm of each of ``points_m`` (n, 3) to the surface, (n,): to the triangles of the four nearest
        samples. It is never too small, and too large only where a nearer triangle holds none of them."""
        nearest = self._faces[self._tree.query(points_m, k=_CANDIDATES)[1]]
        distances = [
            np.linalg.norm(trimesh.triangles.closest_point(self._corners[faces], points_m) - points_m, axis=1)
            for faces in nearest.T
        ]
        return np.min(distances, axis=0) * MM_PER_M

    def covered_share(self, points_m: Points, within_mm: float) -> float:
        """Share of the surface's area that has a point of ``points_m`` (n, 3) within ``within_mm``."""
        if not len(points_m):
            return 0.0
        reach_m = within_mm / MM_PER_M
        distances, _ = KDTree(points_m).query(self.samples_m, distance_upper_bound=reach_m)
        return float(np.isfinite(distances).mean())


def mesh_file(dataset: DatasetFolder, name: str) -> Path:
    """The mesh of a generated dataset's object. Raises `DatasetError` where it is missing."""
    path: Path = dataset.path / MESH_FOLDER / f"{name}.ply"
    if not path.is_file():
        raise DatasetError(f"{path}: is missing, and clouds are measured against it; run: fpp-bench verify")
    return path


def surface_of(dataset: DatasetFolder, name: str) -> Surface:
    """The surface of a generated dataset's object, from its `mesh_file`."""
    mesh = UserMesh(name, str(mesh_file(dataset, name)), centre=False)
    return Surface(load_user_mesh(mesh), SAMPLES)
