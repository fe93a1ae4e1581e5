"""What a light is: every number of the image formation, stage by stage, as ``--light`` takes it
from YAML.

The stages in the order in which light passes them: projector (`projector`), surface (`surface`,
`textures`), further bounces (`surfels`, `bounces`), camera optics (`pixels`) and sensor (`sensor`).
A stage that is off costs nothing. Grey levels are those of the 8-bit image, before the camera's
response.
"""

from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    model_validator,
)

from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.files import read_yaml
from fpp_ml_bench.schema import (
    NonNegative,
    Positive,
    Share,
    SparseModel,
    StrictModel,
    Text,
    as_tuple,
    validate,
)

LIGHTS = Path(__file__).resolve().parent / "lights"
NAMED = ("paper", "workshop", "hard")
"""The lights that a benchmark has; each is a YAML file beside this module."""


def _ascending(curve: tuple[float, ...]) -> tuple[float, ...]:
    if curve[0] != 0 or curve[-1] != 1 or any(b <= a for a, b in pairwise(curve)):
        raise ValueError("expected a measured response that ascends from 0 to 1")
    return curve


Power = Annotated[float, Field(ge=0.2, le=5)]
Curve = Annotated[
    tuple[Share, ...], Field(min_length=2, max_length=256), AfterValidator(_ascending)
]
Response = Annotated[Power | Curve, BeforeValidator(as_tuple)]
"""The power of the input, or outputs at evenly spaced inputs from 0 to 1."""
Blur = Annotated[float, Field(ge=0, le=20)]
Falloff = Annotated[int, Field(ge=-3, le=8)]
"""Brightness goes as the cosine of the angle to the axis to this power: 0 even in every direction,
4 a simple lens; for a projector -3 gives an even screen, as an ideal one does."""


class ProjectorLight(StrictModel):
    """``response``: linear light of pattern levels. ``pixel_blur_px``: sigma in focus. ``focus_m``
    and ``defocus_px``: distance of best focus, and sigma at the far end of the working range.
    ``flicker``: relative sigma per frame."""

    response: Response = 1.0
    pixel_blur_px: Blur = 0.0
    focus_m: Positive = 1.8
    defocus_px: Blur = 0.0
    falloff: Falloff = 0
    flicker: Annotated[float, Field(ge=0, le=0.2)] = 0.0


class SurfaceLight(SparseModel):
    """``albedo`` of the diffuse part; ``gloss``: weight of a GGX microfacet lobe of ``roughness``
    (its alpha is the square). ``textures``: none, or albedo maps by the object's kind, whose dark
    parts have (1 - ``contrast``) of the albedo; with them ``gloss`` is the most, and each object
    has its share of it. ``object_share`` and ``wall_share`` of the albedo are what the object and
    the background plane have: dark paint, a dark wall, none."""

    SPARSE = ("object_share", "wall_share")
    """So that lights from before there were shares keep their fingerprints."""
    albedo: Annotated[float, Field(gt=0, le=0.95)] = 0.8
    gloss: Annotated[float, Field(ge=0, le=0.95)] = 0.0
    roughness: Annotated[float, Field(ge=0.05, le=1)] = 0.95
    textures: Literal["none", "by_kind", "checks"] = "none"
    contrast: Annotated[float, Field(ge=0, le=0.95)] = 0.0
    object_share: Annotated[float, Field(ge=0.02, le=1)] = 1.0
    wall_share: Share = 1.0

    @property
    def wall_albedo(self) -> float:
        """Of the background plane, which is matte."""
        return (1.0 - self.gloss) * self.albedo * self.wall_share


class BounceLight(StrictModel):
    """``interreflection`` between the object's parts and from the background plane to it;
    ``ambient_occlusion`` of the ambient light; ``shadows`` of the projector's light."""

    interreflection: bool = True
    ambient_occlusion: bool = True
    shadows: bool = False


class CameraLight(StrictModel):
    """``rays_across``: rays across a pixel that mixes surfaces; 1 is the central ray alone.
    ``blur_px``: sigma of the lens. ``reference_grey``: direct white light on the matte part of the
    material, facing the projector at the near end of the range, at exposure 1. ``exposure``:
    factor, or the ends of a range from which each view draws one, evenly by its logarithm.
    ``full_well_e``: electrons at grey level 255, null for no noise. ``bits`` of the converter,
    whose codes ``response`` (a power, or a measured curve) turns into 8-bit grey levels."""

    rays_across: Annotated[int, Field(ge=1, le=8)] = 2
    blur_px: Blur = 0.0
    falloff: Annotated[int, Field(ge=0, le=8)] = 0
    reference_grey: Annotated[float, Field(gt=0, le=1e4)] = 180.0
    exposure: Annotated[Positive | tuple[Positive, Positive], BeforeValidator(as_tuple)] = 1.0
    black_grey: Annotated[float, Field(ge=0, le=64)] = 0.0
    full_well_e: Annotated[float, Field(ge=100, le=1e9)] | None = 32500.0
    read_noise_e: NonNegative = 10.0
    bits: Literal[8, 10, 12] = 8
    response: Response = 1.0

    @model_validator(mode="after")
    def _range(self) -> "CameraLight":
        if isinstance(self.exposure, tuple) and self.exposure[0] >= self.exposure[1]:
            raise ValueError("exposure: expected a number, or a range from less to more")
        return self


class Light(StrictModel):
    """All stages. ``ambient_grey``: ambient light on the material in the open. ``motion_mm``:
    movement of the object from frame to frame, in a direction drawn for each view.
    ``calibration_px``: RMS distance in projector px between the rig that photographs and the one
    that decodes."""

    name: Text
    projector: ProjectorLight = ProjectorLight()
    surface: SurfaceLight = SurfaceLight()
    bounces: BounceLight = BounceLight()
    camera: CameraLight = CameraLight()
    ambient_grey: Annotated[float, Field(ge=0, le=255)] = 6.0
    motion_mm: Annotated[float, Field(ge=0, le=100)] = 0.0
    calibration_px: Annotated[float, Field(ge=0, le=20)] = 0.0

    def stages(self) -> dict[str, bool]:
        """Which of the stages that can be off are on."""
        projector, bounces, camera = self.projector, self.bounces, self.camera
        return {
            "projector response": projector.response != 1.0,
            "projector blur": projector.pixel_blur_px > 0,
            "defocus": projector.defocus_px > 0,
            "projector falloff": projector.falloff != 0,
            "flicker": projector.flicker > 0,
            "textures": self.surface.textures != "none",
            "gloss": self.surface.gloss > 0,
            "interreflection": bounces.interreflection,
            "ambient occlusion": bounces.ambient_occlusion,
            "shadows": bounces.shadows,
            "pixel area": camera.rays_across > 1,
            "lens blur": camera.blur_px > 0,
            "vignetting": camera.falloff > 0,
            "noise": camera.full_well_e is not None,
            "camera response": camera.response != 1.0,
            "motion": self.motion_mm > 0,
            "calibration error": self.calibration_px > 0,
        }

    def changed(self, stage: str = "", **values: Any) -> "Light":
        """A copy with other values, of ``stage`` or, with none, of the light itself; checked like a
        file."""
        content = self.model_dump()
        (content[stage] if stage else content).update(values)
        return Light.model_validate(content)


@cache
def named_light(name: str) -> Light:
    """The light ``name`` of `NAMED`."""
    return _read(LIGHTS / f"{name}.yaml")


def load_light(name_or_file: str | Path) -> Light:
    """A named light, or one from a YAML file; raises `BuildError` naming the file and every key
    that is wrong."""
    if str(name_or_file) in NAMED:
        return named_light(str(name_or_file))
    file = Path(name_or_file)
    if file.suffix not in (".yaml", ".yml"):
        raise BuildError(f"light {str(name_or_file)!r}: expected {', '.join(NAMED)} or a YAML file")
    return _read(file)


def _read(file: Path) -> Light:
    return validate(Light, read_yaml(file, BuildError), file, "light", BuildError)
