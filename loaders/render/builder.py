"""Building the benchmark: every object of the settings, six views each, through the studio into shards."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fpp_ml_bench import __version__
from fpp_ml_bench.constants import SPLITS, VIEWS, sample_name, split_of
from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.loaders.render.illumination import lit_object
from fpp_ml_bench.loaders.render.meshes import solid_mesh, write_ply
from fpp_ml_bench.loaders.render.raycast import PixelRays, TracedObject
from fpp_ml_bench.loaders.render.scene import place
from fpp_ml_bench.loaders.render.settings import BuildSettings
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.loaders.sample import stored_frames
from fpp_ml_bench.loaders.storage import (
    GENERATED,
    Assembly,
    Manifest,
    Progress,
    Receipt,
    Row,
    ShardPlan,
    ShardWriter,
    assemble,
    plan_shards,
)
from fpp_ml_bench.skipping import Explanation, LeftOut, explained, saved_by

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


RULE = "processor seconds of one view ({sample}) with skipping off less on, measured now, times what all views left out"


class SingleView:
    """A view of the build, ready to repeat each stage; that of median cover."""

    def __init__(self, manifest: Manifest, settings: BuildSettings) -> None:
        rows = [row for part in manifest.samples.values() for row in part]
        self.row = sorted(rows, key=lambda row: row["exact_px"])[len(rows) // 2]
        name, angle = self.row["object"], self.row["view"]
        self.studio, rig = Studio(settings), settings.rig
        mesh = solid_mesh(name, settings.user_meshes)
        self.traced = TracedObject(mesh, place(mesh, angle, rig, settings.placement, settings.seed)[0])
        self.hits = self.traced.primary(PixelRays.of(rig.camera))
        self.lit = lit_object(self.hits, rig, self.studio.lighting, self.traced)
        self.stream = (settings.seed, name, angle)
        self.seen = np.zeros((rig.camera.height, rig.camera.width), dtype=bool)
        self.seen.ravel()[self.hits.pixels] = True
        self.expose()

    def light_background(self) -> None:
        self.studio.backdrop.behind(self.traced, self.hits.pixels)

    def expose(self) -> None:
        whole = self.studio.backdrop.behind(self.traced, self.hits.pixels).patched(self.hits.pixels, self.lit)
        self.studio.expose(self.hits, self.lit, whole, self.stream)

    def decode(self) -> None:
        self.studio.ground_truth_mm(self.seen)


def explain_build(manifest: Manifest, settings: BuildSettings) -> Explanation:
    """The account of a built dataset. Takes a second or two: it makes one view several times.

    Raises `BuildError` for a dataset of an earlier version, which counted something else.
    """
    if manifest.origin != GENERATED:
        raise ValueError(f"only generated datasets are explained, this one is {manifest.origin}")
    rows = [row for part in manifest.samples.values() for row in part]
    if any("shadow_rays" not in row for row in rows):
        raise BuildError(
            f"--explain: expected a dataset of version {__version__}, this one was built by version "
            f"{manifest.generator.get('version')} and did not count shadow rays; delete it and build it again"
        )
    view = SingleView(manifest, settings)
    rule = RULE.format(sample=view.row["sample"])
    rig, views = settings.rig, len(rows)
    pixels = rig.camera.width * rig.camera.height
    seen, seen_here = sum(row["exact_px"] for row in rows), view.row["exact_px"]
    sequence, stored = rig.sequence, len(view.studio.stored)
    decoded = len(sequence) - 2
    unstored = len(view.studio.unstored)
    unneeded = len(sequence) - stored - unstored

    def exposed(px: int, count: int) -> int:
        return (px * unstored) + count * pixels * stored

    lines = []
    if settings.shadows:
        lines.append(_shadow_rays(view, rows, pixels, rule))
    else:
        again = pixels * (views - 1)
        saved, how = saved_by(view.light_background, pixels, again), rule + "; lit once a process, one process assumed"
        lines.append(LeftOut("empty background again", "pixels", pixels, again, None, saved, how))
    left = views * pixels * len(sequence) - exposed(seen, views)
    left_here = pixels * len(sequence) - exposed(seen_here, 1)
    lines += [
        LeftOut(
            f"exposures ({unstored} unstored frames off the object, {unneeded} everywhere)", "pixels",
             exposed(seen, views), left, None, saved_by(view.expose, left_here, left), rule,
        ),
        LeftOut(
            "ground truth off the object", "grey levels", seen * decoded, (views * pixels - seen) * decoded,
            None, saved_by(view.decode, (pixels - seen_here) * decoded, (views * pixels - seen) * decoded), rule,
        ),
        LeftOut(
            "frames not asked for", "frames", stored * views, (len(sequence) - stored) * views,
            (len(sequence) - stored) * views * pixels, None,
            "not written; seconds not measured, they depend on the disk",
        ),
    ]  # fmt: skip
    about = f"{views} views of {rig.camera.width}x{rig.camera.height} px, cover {100 * seen / (views * pixels):.1f}%"
    return explained("build", about, lines)


def _shadow_rays(view: SingleView, rows: list[dict], pixels: int, rule: str) -> LeftOut:
    """Shadow rays that pass the object; a ray for every pixel of the image would be all of them."""
    traced = sum(row["shadow_rays"] for row in rows)
    left, here = len(rows) * pixels - traced, pixels - view.row["shadow_rays"]
    return LeftOut(
        "shadow rays past the object's box", "rays", traced, left, None, saved_by(view.light_background, here, left),
        rule,
    )  # fmt: skip
