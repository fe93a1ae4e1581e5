"""Is the light right? Our images against a path tracer's, Mitsuba 3, of the same scenes; our camera
against `fringes`.

    python benchmarks/path_traced.py [--scenes plane,bowl] [--size 240] [--pictures DIR]

Each scene stands before the background plane in the paper's rig, lit by the projector with shadows,
no other lamp and no noise. Both renderers give the light of white and of the 18 horizontal fringes,
direct (path length 2) and with every further bounce. Grey levels are absolute: Mitsuba's projector
has the power that ours has, and no factor is fitted. One image of Mitsuba carries white and the
fringes' first harmonic as its three channels, from which all 18 frames' phase follows, because
light is linear in the pattern. Pixels inside the object count: none whose rays see different
surfaces, and none beside those. Mitsuba renders each image twice, with two seeds; the mean of both
is compared, and "seeds" is how far they differ. A mean grey level is that of the image in question.

- direct: RMS difference within 1% of the mean grey level; matte, and glossy (on ``GLOSSY``)
- with all bounces: within 3%, and the seeds within 1%
- phase error: phase with all bounces minus phase of direct light, each renderer's own, where
  bounced light is at least 5% of the direct light and direct light at least 5% of its mean. Two
  figures, relative to Mitsuba's RMS: how far the two RMS are apart, and the RMS of the difference
  pixel by pixel. Each within 20%, or within a milliradian.

Seconds are of one core. Exit status 1 if an agreement is missed. Needs ``pip install
--group pathtrace``.
"""

import argparse
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, gaussian_filter

from fpp_ml_bench.loaders.render.illumination import grey_of_white, projector_centre_m
from fpp_ml_bench.loaders.render.light import Light, named_light
from fpp_ml_bench.loaders.render.meshes import solid_mesh as benchmark_mesh
from fpp_ml_bench.loaders.render.pixels import blur_image
from fpp_ml_bench.loaders.render.scene import BuildSettings, SolidMesh, place
from fpp_ml_bench.loaders.render.sensor import Sensor, sense_kernel, stream_keys
from fpp_ml_bench.loaders.render.surfels import Surfels
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.loaders.sample import Flag
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.patterns import pattern_profiles
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.portable import gaussian_weights
from fpp_ml_bench.style import ERROR_COLOURS, FRAME_COLOURS, figure, figure_png, styled

SCENES = ("plane", "sphere", "open_book", "bowl", "cleaning_bucket", "magazine_stack")
GLOSSY = ("plane", "sphere")
GLOSS, ROUGHNESS = 0.3, 0.4
DIRECT, ALL, PHASE, PHASE_RAD, SEEDS = 0.01, 0.03, 0.2, 1e-3, 0.01
BOUNCES = 12
"""Path length of "all bounces": 0.8 of the light is left by each, times the share that meets the
object again."""
DIRECT_SAMPLES = 256
SAMPLES = {"bowl": 1296}
"""Paths a pixel with all bounces where 1024 are too few for the seeds to agree."""


@dataclass(frozen=True)
class Images:
    """Light in grey levels: ``white`` float64 (H, W), and ``harmonic`` complex (H, W), the first of
    the 18 frames."""

    white: NDArray[np.float64]
    harmonic: NDArray[np.complex128]
    seconds: float

    @classmethod
    def mean(cls, a: "Images", b: "Images") -> "Images":
        return cls(
            (a.white + b.white) / 2, (a.harmonic + b.harmonic) / 2, (a.seconds + b.seconds) / 2
        )


def first_harmonic(frames: NDArray[np.float64]) -> NDArray[np.complex128]:
    """2/N sum I_k exp(-2 pi i k / N) of N frames along the first axis; its angle is the N-step
    phase."""
    steps = len(frames)
    weights = 2 / steps * np.exp(-2j * np.pi * np.arange(steps) / steps)
    return np.tensordot(weights, frames, axes=1)


class PathTraced:
    """A scene in the path tracer: the same mesh in the same place, before the same plane, lit by
    the same projector, which shows ``screen`` float32 (H, W, 3)."""

    def __init__(
        self,
        mi: Any,
        mesh: SolidMesh,
        rig: Rig,
        light: Light,
        folder: Path,
        screen: NDArray[np.float32],
        view: str = "A0",
        whole: bool = False,
    ) -> None:
        """``whole``: all of the image is rendered, else the object's box."""
        self.mi, self.rig, self.light, self.screen = mi, rig, light, screen
        vertices_m, _ = place(mesh, view, rig, "fixed", 42)
        self.file = folder / f"{mesh.name}.ply"
        trimesh.Trimesh(vertices_m, mesh.faces, process=False).export(self.file)
        u = rig.camera.fx * vertices_m[:, 0] / vertices_m[:, 2] + rig.camera.cx
        v = rig.camera.fy * vertices_m[:, 1] / vertices_m[:, 2] + rig.camera.cy
        self.left, self.top = int(u.min()) - 2, int(v.min()) - 2
        self.width, self.height = int(u.max()) + 3 - self.left, int(v.max()) + 3 - self.top
        if whole:
            self.left, self.top, self.width, self.height = 0, 0, rig.camera.width, rig.camera.height

    def radiance(self, length: int, samples: int, seed: int) -> NDArray[np.float64]:
        """Light (H, W, 3) by paths of up to ``length`` pieces from the camera, ``samples`` a pixel;
        0 beside what is rendered."""
        pixels = np.array(
            self.mi.render(self.mi.load_dict(self._scene(length, samples)), seed=seed),
            dtype=np.float64,
        )
        whole = np.zeros((self.rig.camera.height, self.rig.camera.width, 3))
        whole[self.top : self.top + self.height, self.left : self.left + self.width] = pixels
        return whole

    def render(self, length: int, samples: int, seed: int) -> Images:
        """White and first harmonic of the light that `harmonic_screen` gives."""
        start = time.process_time()
        whole = self.radiance(length, samples, seed)
        seconds = time.process_time() - start
        white = whole[..., 0]
        return Images(white, 2 * whole[..., 1] - white + 1j * (2 * whole[..., 2] - white), seconds)

    def _scene(self, length: int, samples: int) -> dict[str, Any]:
        rig, surface, camera = self.rig, self.light.surface, self.rig.camera
        projector = rig.projector
        centre = projector_centre_m(rig)
        # Mitsuba multiplies by pi, so a white surface that faces the lamp at 1 m has radiance
        # `scale`.
        power = grey_of_white(self.light) * (rig.working_range_mm[0] / 1000) ** 2
        matte: dict[str, Any] = {
            "type": "diffuse",
            "reflectance": {"type": "rgb", "value": surface.albedo},
        }
        mirror = {
            "type": "roughconductor",
            "material": "none",
            "distribution": "ggx",
            "alpha": surface.roughness**2,
        }
        blend = {"type": "blendbsdf", "weight": surface.gloss, "matte": matte, "mirror": mirror}
        wall = {
            "type": "diffuse",
            "reflectance": {"type": "rgb", "value": (1 - surface.gloss) * surface.albedo},
        }
        film = {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "pixel_format": "rgb",
            "component_format": "float32",
            "rfilter": {"type": "box"},
            "crop_offset_x": self.left,
            "crop_offset_y": self.top,
            "crop_width": self.width,
            "crop_height": self.height,
        }
        return {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": length, "rr_depth": 1000},
            "camera": {
                "type": "perspective",
                "fov_axis": "x",
                "fov": _field_degrees(camera),
                "near_clip": 0.1,
                "far_clip": 100.0,
                "to_world": self._looking(np.zeros(3)),
                "film": film,
                "sampler": {"type": "multijitter", "sample_count": samples},
            },
            "projector": {
                "type": "projector",
                "fov": _field_degrees(projector),
                "scale": power,
                "to_world": self._looking(centre),
                "irradiance": {
                    "type": "bitmap",
                    "bitmap": self.mi.Bitmap(self.screen),
                    "raw": True,
                    "wrap_mode": "clamp",
                },
            },
            "object": {
                "type": "ply",
                "filename": str(self.file),
                "face_normals": True,
                "bsdf": {"type": "twosided", "surface": blend if surface.gloss else matte},
            },
            "wall": {
                "type": "rectangle",
                "bsdf": {"type": "twosided", "surface": wall},
                "to_world": self.mi.ScalarTransform4f()
                .translate([0, 0, rig.background_m])
                .scale([20, 20, 1]),
            },
        }

    def _looking(self, origin: NDArray[np.float64]) -> Any:
        target = origin + np.array([0.0, 0.0, 1.0])
        return self.mi.ScalarTransform4f().look_at(
            origin=origin.tolist(), target=target.tolist(), up=[0, -1, 0]
        )


def harmonic_screen(rig: Rig) -> NDArray[np.float32]:
    """White and the two parts of the horizontal fringes' first harmonic, in three channels."""
    row = first_harmonic(
        np.array(pattern_profiles(rig))[list(rig.sequence.sinusoids("horizontal"))] / 255.0
    )
    row = row[: rig.projector.height]
    channels = np.stack([np.ones_like(row.real), (1 + row.real) / 2, (1 + row.imag) / 2], axis=1)
    return np.repeat(channels[:, None], rig.projector.width, axis=1).astype(np.float32)


def _field_degrees(pinhole: Any) -> float:
    return float(np.degrees(2 * np.arctan(pinhole.width / 2 / pinhole.fx)))


@dataclass(frozen=True)
class Row:
    """One agreement: relative or in radians, as ``asked`` is. ``seeds``: how far Mitsuba's two
    images differ."""

    scene: str
    what: str
    difference: float
    seeds: float
    asked: float
    ours_s: float
    mitsuba_s: float

    @property
    def kept(self) -> bool:
        return self.difference <= self.asked


def mesh_of(name: str) -> SolidMesh:
    """A scene's object in object coordinates, metres: a tilted plate, a ball, or one of the
    benchmark's."""
    if name == "plane":
        y, z, tilt = 0.15, 0.15, np.radians(25)
        corners = np.array(
            [
                [s * y * np.sin(tilt), s * y * np.cos(tilt), t * z]
                for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1))
            ]
        )
        return SolidMesh(name, corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))
    if name == "sphere":
        ball = trimesh.creation.icosphere(subdivisions=8, radius=0.13)
        return SolidMesh(
            name,
            np.asarray(ball.vertices, dtype=np.float64),
            np.asarray(ball.faces, dtype=np.int32),
        )
    return benchmark_mesh(name)


def light_of(bounces: bool, gloss: float = 0.0) -> Light:
    """The paper's light with shadows and an even screen, as Mitsuba's projector has it, and no
    other lamp."""
    light = named_light("paper").changed(ambient_grey=0.0).changed("projector", falloff=-3)
    light = light.changed("surface", gloss=gloss, roughness=ROUGHNESS).changed(
        "camera", rays_across=8
    )
    return light.changed("bounces", shadows=True, interreflection=bounces, ambient_occlusion=False)


def ours(mesh: SolidMesh, rig: Rig, light: Light) -> tuple[Images, NDArray[np.bool_]]:
    """Our images, and which pixels lie inside the object; the time is that of a second view of the
    same object."""
    studio = Studio(BuildSettings(rig=rig, objects=("bowl",), light=light))
    studio.trace(mesh, "A0")
    frames = (rig.sequence.white, *rig.sequence.sinusoids("horizontal"))
    start = time.process_time()
    scene = studio.trace(mesh, "A0")
    image = np.empty((len(frames), rig.camera.height * rig.camera.width), dtype=np.float32)
    studio.exposure.radiance(
        frames, studio.lighting.behind(scene.traced, scene.hits.pixels), scene.stream, image
    )
    parts = [(scene.hits.pixels, scene.lit)]
    if scene.mixed is not None and scene.mixed_lit is not None:
        parts.append((scene.mixed.pixels, scene.mixed_lit))
    for pixels, lit in parts:
        part = np.empty((len(frames), pixels.size), dtype=np.float32)
        image[:, pixels] = studio.exposure.radiance(frames, lit, scene.stream, part)
    seconds = time.process_time() - start
    shape = (rig.camera.height, rig.camera.width)
    waves = first_harmonic(image[1:].astype(np.float64)).reshape(shape)
    seen = np.zeros(shape, dtype=bool)
    seen.ravel()[scene.hits.pixels] = True
    flags, _ = studio.flags(scene)
    return Images(image[0].reshape(shape).astype(np.float64), waves, seconds), binary_erosion(
        seen & (flags & Flag.MIXED == 0)
    )


def root_mean_square(values: NDArray[Any]) -> float:
    return float(np.sqrt(np.mean(np.abs(values) ** 2)))


def image_rows(
    scene: str, what: str, own: Images, a: Images, b: Images, inside: NDArray, asked: float
) -> list[Row]:
    """Agreement of white, and of a fringe image (frame 0 or a quarter of a period later, the worse
    of the two)."""
    rows = []
    level = own.white[inside].mean()
    fields = {
        "white": [lambda i: i.white],
        "fringes": [
            lambda i: (i.white + i.harmonic.real) / 2,
            lambda i: (i.white + i.harmonic.imag) / 2,
        ],
    }
    for name, parts in fields.items():
        worst = seeds = 0.0
        for part in parts:
            mean = level if name == "white" else part(own)[inside].mean()
            worst = max(
                worst, root_mean_square((part(own) - part(Images.mean(a, b)))[inside]) / mean
            )
            seeds = max(seeds, root_mean_square((part(a) - part(b))[inside]) / mean)
        rows.append(
            Row(
                scene,
                f"{what}, {name}",
                worst,
                seeds,
                asked,
                own.seconds,
                (a.seconds + b.seconds) / 2,
            )
        )
    return rows


def phase_rows(
    scene: str, own: tuple[Images, Images], a: Images, b: Images, direct: Images, inside: NDArray
) -> list[Row]:
    """The size of the phase error, and the difference pixel by pixel, which Mitsuba's noise and
    ours are part of."""
    mine, lit = own
    other = Images.mean(a, b)
    least = 0.05 * direct.white[inside].mean()
    chosen = (
        inside & (direct.white > least) & (lit.white > least) & (other.white > 1.05 * direct.white)
    )
    if not chosen.any():
        return []
    error = _phase(mine, lit)[chosen], _phase(other, direct)[chosen]
    size = root_mean_square(error[1])
    seeds = root_mean_square((_phase(a, direct) - _phase(b, direct))[chosen])
    seconds = mine.seconds, (a.seconds + b.seconds) / 2
    what = f"phase error, {chosen.sum()} px, {1000 * size:.1f} mrad"
    apart, asked = abs(root_mean_square(error[0]) - size), max(PHASE, PHASE_RAD / size)
    return [
        Row(scene, f"{what}: its RMS", apart / size, seeds / size, asked, *seconds),
        Row(
            scene,
            f"{what}: by pixel",
            root_mean_square(error[0] - error[1]) / size,
            seeds / size,
            asked,
            *seconds,
        ),
    ]


def _phase(image: Images, direct: Images) -> NDArray[np.float64]:
    return np.angle(image.harmonic * np.conj(direct.harmonic))


def camera_rows() -> list[str]:
    """Mean and standard deviation of our camera's grey levels beside those of `fringes.util.fade`,
    and its blur."""
    try:
        from fringes.util import fade
    except ImportError:
        return ["fringes is not installed (pip install --group peers): its camera is left out"]
    camera = named_light("paper").camera
    electrons = camera.full_well_e or np.inf
    sensor, gain = Sensor.of(camera), 255 / electrons
    pixels = np.arange(400_000, dtype=np.uint32)
    lines = []
    for grey in (20.0, 60.0, 120.0, 180.0, 235.0):
        own = np.empty((1, pixels.size), dtype=np.uint8)
        sense_kernel(
            own,
            np.full((1, pixels.size), grey, dtype=np.float32),
            pixels,
            stream_keys("fade", grey)[None],
            sensor,
        )
        # `fade` cuts off decimals where ours rounds: half a grey level of dark current makes the
        # two one.
        image = np.full((1, 1, pixels.size, 1), grey / 255)
        other = fade(image, K=gain, dark_noise=camera.read_noise_e, dark_current=0.5 / gain, rng=1)
        lines.append(
            f"camera at grey {grey:g}: ours {own.mean():.3f} +- {own.std():.4f}, "
            f"fringes {other.mean():.3f} +- {other.std():.4f}"
        )
    edge = np.where(np.arange(64) < 32, np.float32(40), np.float32(200)) + np.zeros(
        (64, 1), dtype=np.float32
    )
    own_edge = edge.copy()
    blur_image(own_edge, gaussian_weights(1.2**2, 3.0).astype(np.float32), np.empty_like(edge))
    apart = np.abs(
        own_edge - gaussian_filter(edge.astype(float), 1.2, mode="nearest")
    ).max()  # what `fade` calls
    return [
        *lines,
        f"lens blur of an edge of 160 grey levels, sigma 1.2 px: at most {apart:.3f} grey levels "
        f"apart",
    ]


def compare(mi: Any, name: str, args: argparse.Namespace, folder: Path) -> list[Row]:
    """All agreements of one scene."""
    rig, mesh = paper_rig(args.size), mesh_of(name)

    def path_traced(light: Light, length: int, samples: int) -> tuple[Images, Images]:
        scene = PathTraced(mi, mesh, rig, light, folder, harmonic_screen(rig))
        return scene.render(length, samples, seed=1), scene.render(length, samples, seed=2)

    start = time.process_time()
    surfels = Surfels.of(mesh)
    print(
        f"{name}: {len(surfels.grid.area_m2)} surfels, {time.process_time() - start:.2f} s once an "
        f"object",
        flush=True,
    )
    rows = []
    own_direct, inside = ours(mesh, rig, light_of(False))
    direct = path_traced(light_of(False), 2, DIRECT_SAMPLES)
    rows += image_rows(name, "direct", own_direct, *direct, inside, DIRECT)
    own, _ = ours(mesh, rig, light_of(True))
    full = path_traced(light_of(True), BOUNCES, args.samples or SAMPLES.get(name, 1024))
    rows += image_rows(name, "all bounces", own, *full, inside, ALL)
    rows += phase_rows(name, (own, own_direct), *full, Images.mean(*direct), inside)
    if name in GLOSSY:
        light = light_of(False, GLOSS)
        rows += image_rows(
            name,
            "glossy",
            ours(mesh, rig, light)[0],
            *path_traced(light, 2, DIRECT_SAMPLES),
            inside,
            DIRECT,
        )
    if args.pictures:
        picture(name, own, Images.mean(*full), inside, args.pictures / f"path_traced_{name}.png")
    return rows


@styled
def picture(name: str, own: Images, other: Images, inside: NDArray, file: Path) -> None:
    """Our image of white light, Mitsuba's, and ten times their difference inside the object."""
    rows, columns = np.nonzero(other.white)
    box = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    most = other.white[inside].max()
    drawn = figure(9, 3.2, dpi=60)
    axes = drawn.subplots(1, 3)
    for axis, image, title in (
        (axes[0], own.white, f"{name}: ours"),
        (axes[1], other.white, "Mitsuba 3"),
        (axes[2], 10 * np.where(inside, own.white - other.white, 0.0), "difference x 10"),
    ):
        low, colours = (-most, ERROR_COLOURS) if axis is axes[2] else (0, FRAME_COLOURS)
        axis.imshow(image[box], vmin=low, vmax=most, cmap=colours)
        axis.set_title(title)
        axis.axis("off")
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(figure_png(drawn))


def table(rows: list[Row]) -> str:
    lines = [
        "| scene | what | difference | seeds | asked | ours s | Mitsuba s |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        asked = f"{row.asked:.1%}{'' if row.kept else ' **missed**'}"
        lines.append(
            f"| {row.scene} | {row.what} | {row.difference:.2%} | {row.seeds:.2%} | {asked} | "
            f"{row.ours_s:.2f} | {row.mitsuba_s:.1f} |"
        )
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--scenes", default=",".join(SCENES), help=f"of {', '.join(SCENES)}, or other objects"
    )
    parser.add_argument(
        "--size", type=int, default=240, metavar="PX", help="image size (default: 240)"
    )
    parser.add_argument(
        "--samples", type=int, help="Mitsuba's paths a pixel with all bounces (default: by scene)"
    )
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="write side-by-side pictures")
    args = parser.parse_args()
    try:
        import mitsuba as mi
    except ImportError:
        sys.exit("Mitsuba is not installed: pip install --group pathtrace")
    mi.set_variant("scalar_rgb")
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        for name in args.scenes.split(","):
            rows += compare(mi, name, args, Path(folder))
    print(table(rows))
    noisy = [row.scene for row in rows if row.what.startswith("all bounces") and row.seeds > SEEDS]
    if noisy:
        print(
            f"seeds differ by more than {SEEDS:.0%}, take more samples: "
            f"{', '.join(sorted(set(noisy)))}"
        )
    bounced = [row for row in rows if row.what == "all bounces, white"]
    # Ours is all of white and 18 fringes, Mitsuba's one image of three channels.
    ratio = np.median([19 / 3 * row.mitsuba_s / row.ours_s for row in bounced])
    print(
        f"a frame with all bounces: ours is {np.log10(ratio):.1f} orders of magnitude faster "
        f"(median of scenes)"
    )
    print("\n".join(camera_rows()))
    return 0 if all(row.kept for row in rows) and not noisy else 1


if __name__ == "__main__":
    sys.exit(main())
