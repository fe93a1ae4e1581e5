"""What a build is asked for. Two builds with equal settings give equal bytes."""

from dataclasses import asdict, dataclass, field
from typing import Any

from fpp_ml_bench.constants import FULL_SIZE, MINI_OBJECTS, MINI_SIZE, OBJECTS
from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.loaders.render.scene import PLACEMENTS, PlacementRule
from fpp_ml_bench.optics import CONFIGS, Rig, paper_rig

PRESETS: dict[str, tuple[tuple[str, ...], int]] = {"mini": (MINI_OBJECTS, MINI_SIZE), "full": (OBJECTS, FULL_SIZE)}


@dataclass(frozen=True)
class UserMesh:
    """A mesh of the user's: file, scale, turn (degrees about x, y, z, in that order), shift, split, content hash."""

    name: str
    path: str
    scale: float = 1.0
    rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    centre: bool = True
    split: str = "test"
    content: str = ""


@dataclass(frozen=True)
class BuildSettings:
    """Everything that decides the bytes of a dataset.

    ``objects`` and ``user_meshes`` are kept in one order, the benchmark's and then the users' by name, whatever order
    they were given in: it is the order of the rows.
    """

    rig: Rig
    objects: tuple[str, ...]
    placement: PlacementRule = "fixed"
    stored: str = "all"
    seed: int = 42
    noise_sigma_grey: float = 1.0
    shadows: bool = False
    user_meshes: tuple[UserMesh, ...] = field(default=())

    def __post_init__(self) -> None:
        names = {*OBJECTS, *(mesh.name for mesh in self.user_meshes)}
        for name in self.objects:
            if name not in names:
                from difflib import get_close_matches

                near = ", ".join(get_close_matches(name, sorted(names), n=3)) or "see fpp_ml_bench.constants.OBJECTS"
                raise BuildError(f"unknown object {name!r}; did you mean {near}?")
        if not self.objects:
            raise BuildError("no object to build: name at least one")
        if len(set(self.objects)) != len(self.objects):
            twice = next(name for name in self.objects if self.objects.count(name) > 1)
            raise BuildError(f"object {twice!r} is named twice")
        user_meshes = sorted(self.user_meshes, key=lambda mesh: mesh.name)
        order = (*OBJECTS, *(mesh.name for mesh in user_meshes))
        object.__setattr__(self, "user_meshes", tuple(user_meshes))
        object.__setattr__(self, "objects", tuple(sorted(self.objects, key=order.index)))
        if self.placement not in PLACEMENTS:
            raise BuildError(f"placement {self.placement!r}: expected {' or '.join(PLACEMENTS)}")
        if self.stored not in CONFIGS:
            raise BuildError(f"frames {self.stored!r}: expected one of {', '.join(CONFIGS)}")
        if not 0 <= self.noise_sigma_grey <= 50:
            raise BuildError(f"noise of {self.noise_sigma_grey} grey levels: expected 0 to 50")
        if not 0 <= self.seed < 2**63:
            raise BuildError(f"seed {self.seed}: expected a whole number from 0 to 2^63 - 1")
        self.rig.check_sampling()

    def describe(self) -> dict[str, Any]:
        """The settings as plain data for the manifest and for comparing an interrupted build with this one."""
        return {
            "objects": list(self.objects),
            "placement": self.placement,
            "frames": self.stored,
            "seed": self.seed,
            "noise_sigma_grey": self.noise_sigma_grey,
            "shadows": self.shadows,
            "user_meshes": [
                {key: list(value) if isinstance(value, tuple) else value for key, value in asdict(mesh).items()
                 if key != "path"}
                for mesh in self.user_meshes
            ],
        }  # fmt: skip


def preset_settings(preset: str, size: int | None = None) -> BuildSettings:
    """The settings of ``fpp-bench build --preset PRESET [--size SIZE]`` with everything else left at its default."""
    objects, preset_size = PRESETS[preset]
    return BuildSettings(rig=paper_rig(size or preset_size), objects=objects)
