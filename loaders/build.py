"""Building the benchmark: every object of the settings, six views each, through the studio into shards."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from fpp_ml_bench import __version__
from fpp_ml_bench.constants import SPLITS, VIEWS, sample_name, split_of
from fpp_ml_bench.loaders.assemble import Assembly, Progress, Receipt, assemble
from fpp_ml_bench.loaders.manifest import GENERATED, Manifest
from fpp_ml_bench.loaders.meshes import solid_mesh, write_ply
from fpp_ml_bench.loaders.schema import stored_frames
from fpp_ml_bench.loaders.settings import BuildSettings
from fpp_ml_bench.loaders.shards import Row, ShardPlan, ShardWriter, plan_shards
from fpp_ml_bench.loaders.view import Studio

MESH_FOLDER = "meshes"


@dataclass(frozen=True)
class BuildShard:
    """Picklable work of one shard: photograph its objects and write rows and meshes. One studio a process."""

    settings: BuildSettings

    def __call__(self, folder: Path, scratch: Path, plan: ShardPlan, row_done: Callable[[], None]) -> Receipt:
        studio = _studio_of(self.settings)
        camera = self.settings.rig.camera
        writer = ShardWriter(
            folder, scratch, plan, self.settings.rig.sequence, self.settings.stored, True, (camera.height, camera.width)
        )
        return writer.write(self._rows(studio, folder, plan), row_done)

    def _rows(self, studio: Studio, folder: Path, plan: ShardPlan) -> Iterator[Row]:
        mesh = None
        for _, name, view in plan.samples:
            if mesh is None or mesh.name != name:
                mesh = solid_mesh(name, self.settings.user_meshes)
                write_ply(mesh, folder / MESH_FOLDER / f"{name}.ply")
            yield studio.photograph(mesh, view)


_STUDIO: list[Studio] = []


def _studio_of(settings: BuildSettings) -> Studio:
    """This process's studio: its background and buffers serve every shard."""
    if not _STUDIO or _STUDIO[0].settings != settings:
        _STUDIO[:] = [Studio(settings)]
    return _STUDIO[0]


def plan_build(settings: BuildSettings) -> list[ShardPlan]:
    """Shards of a build: splits in order, objects in the benchmark's order, then the user's."""
    user_splits = {mesh.name: mesh.split for mesh in settings.user_meshes}
    plans = []
    for split in SPLITS:
        objects = {
            name: [(sample_name(name, view), name, view) for view in VIEWS]
            for name in settings.objects
            if user_splits.get(name, split_of(name)) == split
        }
        if objects:
            plans += plan_shards(split, objects)
    return plans


def assembly_of(settings: BuildSettings) -> Assembly:
    """What there is to do for a build, and its manifest so far."""
    camera = settings.rig.camera
    pixels = camera.width * camera.height
    frames = stored_frames(settings.rig.sequence, settings.stored)
    manifest = Manifest(
        origin=GENERATED,
        generator={"name": "fpp-ml-bench", "version": __version__},
        settings=settings.describe(),
        rig=settings.rig.to_dict(),
        size=(camera.height, camera.width),
        stored=settings.stored,
        exact=True,
        samples={},
        shards=[],
    )
    # Two float32 depth maps and one byte a frame.
    return Assembly(plan_build(settings), BuildShard(settings), manifest, pixels * (len(frames) + 8), MESH_FOLDER)


def build(folder: Path, settings: BuildSettings, workers: int, progress: Progress = lambda rows: None) -> Manifest:
    """Build a dataset into ``folder``, or go on with one that was interrupted. Same settings, same bytes.

    Raises `BuildError` (folder in use, other settings, disk full) and `MeshError` (an object does not fit).
    """
    return assemble(folder, assembly_of(settings), workers, progress)
