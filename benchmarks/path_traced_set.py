"""One crossed frame of another renderer: a dataset whose frames Mitsuba 3 makes, to be scored on and
never learned from.

    python benchmarks/path_traced_set.py OUT [--samples 64] [--size 960]
    fpp-bench predict crossed OUT --out predictions
    fpp-eval predictions OUT --target depth_exact

Two views of six unseen objects before the paper's rig with crossed fringes. Light, object, wall and
place are those of the light ``paper`` with shadows and an even screen; the frame has all bounces of
a path tracer, our ambient light and our sensor's noise, the depth is that of our ray cast. Also
printed: how far a frame of ours is from Mitsuba's without noise, as a share of its mean grey level.
Needs ``pip install --group pathtrace``; a minute a view on one core at 960 px.
"""

import argparse
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from path_traced import BOUNCES, PathTraced, root_mean_square

from fpp_ml_bench.loaders.render.builder import assembly_of
from fpp_ml_bench.loaders.render.light import named_light
from fpp_ml_bench.loaders.render.meshes import solid_mesh, write_ply
from fpp_ml_bench.loaders.render.scene import BuildSettings
from fpp_ml_bench.loaders.render.sensor import Sensor, frame_keys, sense_kernel
from fpp_ml_bench.loaders.render.track import TRACK_OBJECTS, TRACK_VIEWS
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.loaders.sample import Row
from fpp_ml_bench.loaders.storage.assembly import assemble
from fpp_ml_bench.loaders.storage.manifest import MESH_FOLDER
from fpp_ml_bench.loaders.storage.shards import ShardPlan
from fpp_ml_bench.optics.named_rigs import crossed_rig
from fpp_ml_bench.optics.patterns import pattern_image

AMBIENT_GREY = 6.0
"""That of the light ``paper``, added evenly."""


@dataclass(frozen=True)
class TracedRows:
    """Rows of a build whose one frame is Mitsuba's."""

    settings: BuildSettings
    samples: int

    def __call__(self, plan: ShardPlan, folder: Path) -> Iterator[Row]:
        import mitsuba as mi

        mi.set_variant("scalar_rgb")
        settings, studio = self.settings, Studio(self.settings)
        rig, light = settings.rig, settings.light
        frame = rig.sequence.config("single_shot")[0]
        pattern = pattern_image(rig, frame).astype(np.float32) / 255
        screen = np.repeat(pattern[..., None], 3, axis=2)
        with tempfile.TemporaryDirectory() as scratch:
            for _, name, view in plan.samples:
                mesh = solid_mesh(name)
                write_ply(mesh, folder / MESH_FOLDER / f"{name}.ply")
                row = studio.photograph(mesh, view)
                scene = PathTraced(mi, mesh, rig, light, Path(scratch), screen, view, whole=True)
                grey = scene.radiance(BOUNCES, self.samples, seed=1)[..., 0] + AMBIENT_GREY
                own = row.frames[frame].astype(np.float64)
                inside = row.depth_exact_mm > 0  # type: ignore[operator]
                apart = root_mean_square((own - grey)[inside]) / grey[inside].mean()
                print(f"{row.sample}: {apart:.1%} from ours, noise included", flush=True)
                yield replace(row, frames={frame: self.sensed(grey, (name, view), frame)})

    def sensed(
        self, grey: NDArray[np.float64], view: tuple[str, str], frame: int
    ) -> NDArray[np.uint8]:
        """The 8-bit image of a light in grey levels (H, W)."""
        out = np.empty((1, grey.size), dtype=np.uint8)
        sense_kernel(
            out,
            grey.astype(np.float32).reshape(1, -1),
            np.arange(grey.size, dtype=np.uint32),
            frame_keys((self.settings.seed, *view, "path traced"), [frame]),
            Sensor.of(self.settings.light.camera),
        )
        return out.reshape(grey.shape)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path, metavar="OUT")
    parser.add_argument("--samples", type=int, default=64, help="paths a pixel (default: 64)")
    parser.add_argument("--size", type=int, default=960, help="of the image (default: 960)")
    given = parser.parse_args()
    light = named_light("paper").changed("projector", falloff=-3).changed("bounces", shadows=True)
    settings = BuildSettings(
        crossed_rig(given.size),
        TRACK_OBJECTS,
        stored="single_shot",
        light=light,
        views=TRACK_VIEWS,
    )
    assembly: Any = assembly_of(settings)
    by = {"renderer": f"mitsuba {version('mitsuba')}, {given.samples} paths a pixel"}
    manifest = replace(assembly.manifest, settings=assembly.manifest.settings | by)
    assemble(
        given.out,
        replace(assembly, rows=TracedRows(settings, given.samples), manifest=manifest),
        workers=1,
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
