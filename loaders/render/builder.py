"""Building the benchmark: every object of the settings, six views each, through the studio into
shards."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from fpp_ml_bench import __version__
from fpp_ml_bench.calibration.volume import volume_error_mm
from fpp_ml_bench.constants import SPLITS, sample_name, split_of
from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.loaders.render.meshes import solid_mesh, write_ply
from fpp_ml_bench.loaders.render.scene import BuildSettings
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.loaders.sample import Row
from fpp_ml_bench.loaders.storage.assembly import Assembly, Progress, assemble
from fpp_ml_bench.loaders.storage.manifest import GENERATED, MESH_FOLDER, Manifest
from fpp_ml_bench.loaders.storage.shards import ShardPlan, plan_shards
from fpp_ml_bench.remote import RemoteFolder
from fpp_ml_bench.skipping import Explanation, LeftOut, explained


@dataclass(frozen=True)
class PhotographedRows:
    """Picklable source of a build's rows: photographs the objects of a shard and writes their
    meshes. The studio, with its background and buffers, serves every shard of a process."""

    settings: BuildSettings

    @cached_property
    def studio(self) -> Studio:
        return Studio(self.settings)

    def __call__(self, plan: ShardPlan, folder: Path) -> Iterator[Row]:
        mesh = None
        for _, name, view in plan.samples:
            if mesh is None or mesh.name != name:
                mesh = self.settings.sized(solid_mesh(name, self.settings.user_meshes))
                write_ply(mesh, folder / MESH_FOLDER / f"{name}.ply")
            yield self.studio.photograph(mesh, view)


def plan_build(settings: BuildSettings) -> list[ShardPlan]:
    """Shards of a build: splits in order, objects in the benchmark's order, then the user's."""
    user_splits = {mesh.name: mesh.split for mesh in settings.user_meshes}
    plans = []
    for split in SPLITS:
        names = [
            name for name in settings.objects if user_splits.get(name, split_of(name)) == split
        ]
        if names:
            objects = {
                name: [(sample_name(name, view), name, view) for view in settings.views]
                for name in names
            }
            plans += plan_shards(split, objects)
    return plans


def assembly_of(settings: BuildSettings) -> Assembly:
    """What there is to do for a build, and its manifest so far. Raises `CalibrationError` where the
    rig to decode with has no depth in a part of the range."""
    if settings.decode_with is not None:
        volume_error_mm(settings.decode_with, settings.rig)
    rig, generator = settings.stated_rig, {"name": "fpp-ml-bench", "version": __version__}
    size = rig.camera.height, rig.camera.width
    described, stored = settings.describe(), settings.stored
    manifest = Manifest(GENERATED, generator, described, rig.to_dict(), size, stored, exact=True)
    return Assembly(plan_build(settings), PhotographedRows(settings), manifest, MESH_FOLDER)


def build(
    folder: Path | RemoteFolder,
    settings: BuildSettings,
    workers: int,
    progress: Progress = lambda rows: None,
    cluster: str | None = None,
) -> Manifest:
    """Build a dataset into ``folder``, or go on with one that was interrupted, by so many processes
    or by the Ray cluster at an address. Same settings, same bytes. Raises `BuildError` (folder in
    use, other settings, disk full), `MeshError` (an object does not fit), and `PoolError` and
    `RemoteError` for a cluster or URL that fails."""
    return assemble(folder, assembly_of(settings), workers, progress, cluster)


def explain_build(manifest: Manifest, settings: BuildSettings) -> Explanation:
    """The account of a built dataset, from what its manifest counts. Raises `BuildError` for a
    dataset of an earlier version, which counted something else."""
    if manifest.origin != GENERATED:
        raise ValueError(f"only generated datasets are explained, this one is {manifest.origin}")
    rows = manifest.rows
    if any("mixed_rays" not in row for row in rows):
        raise BuildError(
            f"--explain: expected a dataset of version {__version__}, this one was built by "
            f"version "
            f"{manifest.generator.get('version')} and counted something else; delete it and build "
            f"it again"
        )
    studio, camera = Studio(settings), settings.rig.camera
    views, view_px = len(rows), camera.width * camera.height
    all_px, object_px = views * view_px, sum(row["exact_px"] for row in rows)
    frames, stored, unstored = len(settings.rig.sequence), len(studio.stored), len(studio.unstored)
    decoded, mixed_rays = frames - 2, sum(row["mixed_rays"] for row in rows)
    across = settings.light.camera.rays_across
    stages = settings.light.stages()
    # An object that moves is lit again in every frame that is made.
    lit_px = all_px * (stored + unstored if settings.light.motion_mm else 1)
    if settings.light.bounces.shadows:  # a ray for every pixel of the image would be all of them
        rays = sum(row["shadow_rays"] for row in rows)
        background = LeftOut("shadow rays past the object's box", "rays", rays, lit_px - rays)
    else:
        background = LeftOut(
            "empty background again, in one process", "pixels", view_px, lit_px - view_px
        )
    # `Studio.expose` exposes every frame whole where the object moves or the lens blurs.
    whole = settings.light.motion_mm > 0 or settings.light.camera.blur_px > 0
    exposed = (all_px if whole else object_px) * unstored + all_px * stored
    lines = [
        background,
        LeftOut("exposures that nothing reads", "pixels", exposed, all_px * frames - exposed),
        LeftOut(
            "ground truth off the object",
            "grey levels",
            object_px * decoded,
            (all_px - object_px) * decoded,
        ),
        LeftOut(
            "rays across pixels that see one surface",
            "rays",
            mixed_rays,
            all_px * (across**2 if across > 1 else 0)
            - mixed_rays,  # the central ray alone is always lit
        ),
        LeftOut(
            "stages of the light that are off",
            "stages",
            sum(stages.values()),
            len(stages) - sum(stages.values()),
        ),
        LeftOut(
            "frames not asked for",
            "frames",
            stored * views,
            (frames - stored) * views,
            (frames - stored) * all_px,
        ),
    ]
    about = (
        f"{views} views of {camera.width}x{camera.height} px, cover {100 * object_px / all_px:.1f}%"
    )
    return explained("build", about, lines)
