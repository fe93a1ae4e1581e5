"""What a build left out, counted from its manifest; seconds from one of its views, made again with skipping on and off.

The counts follow from rules, not from counters in the workers, so that a build that was resumed, or stands already, is
explained as well; `tests/test_skipping.py` counts what really happens and finds the same.
"""

import numpy as np

from fpp_ml_bench import __version__
from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.explain import Explanation, LeftOut, explained, saved_by
from fpp_ml_bench.loaders.illumination import lit_object
from fpp_ml_bench.loaders.manifest import GENERATED, Manifest
from fpp_ml_bench.loaders.meshes import solid_mesh
from fpp_ml_bench.loaders.raycast import PixelRays, TracedObject
from fpp_ml_bench.loaders.scene import place
from fpp_ml_bench.loaders.settings import BuildSettings
from fpp_ml_bench.loaders.view import Studio

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
