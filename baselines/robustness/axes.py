"""FPP-C's axes: what disturbs a scene, each one stage of the image formation at five severities (``axes.yaml``).

After Hendrycks and Dietterich 2019, Benchmarking Neural Network Robustness to Common Corruptions and Perturbations; but
every corruption is caused in the scene, not painted on the image.
"""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from fpp_ml_bench.constants import GREY_LEVELS, TEST_OBJECTS, UNSEEN
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.files import strict_yaml
from fpp_ml_bench.loaders.render import Light, named_light
from fpp_ml_bench.schema import StrictModel, Text, validate

FILE = Path(__file__).with_name("axes.yaml")
SetName = Literal["test", "unseen"]
SETS: dict[SetName, tuple[str, ...]] = {"test": TEST_OBJECTS, "unseen": UNSEEN}
"""Objects of each set that a method can be measured on."""
CLEAN = "clean"
Share = Annotated[float, Field(gt=0, le=1)]
Above0 = Annotated[float, Field(gt=0)]


class Axis(StrictModel):
    """One corruption: ``key`` of the light's ``stage`` (the light itself with none) takes the values ``severities``,
    in ``unit``, and ``also`` holds what else the stage needs. ``electrons``: the values are grey levels, the key wants
    electrons. ``several_frames``: it does nothing to one frame. ``objects``: only these are disturbed by it."""

    unit: Text
    stage: Literal["", "projector", "surface", "bounces", "camera"] = ""
    key: Text
    severities: Annotated[list[Above0], Field(min_length=5, max_length=5)]
    also: dict[str, Any] = Field(default_factory=dict)
    electrons: bool = False
    several_frames: bool = False
    objects: list[str] = Field(default_factory=list)

    def light(self, clean: Light, severity: int) -> Light:
        """The light at a severity from 0, which is ``clean`` itself, to 5."""
        if severity == 0:
            return clean
        value = self.severities[severity - 1]
        if self.electrons:
            value *= (clean.camera.full_well_e or 0) / GREY_LEVELS
        return clean.changed(self.stage, **self.also, **{self.key: value})

    def seen_on(self, objects: Sequence[str]) -> tuple[str, ...]:
        """Those of ``objects`` that the axis disturbs."""
        return tuple(name for name in objects if not self.objects or name in self.objects)

    def applies(self, objects: Sequence[str], frames: int) -> bool:
        """Whether the axis does anything to a method of so many frames on a set of ``objects``."""
        return bool(self.seen_on(objects)) and not (self.several_frames and frames < 2)


class Corruptions(StrictModel):
    """``axes.yaml``. ``views`` of each object of a set are measured. A pixel without an answer is charged
    ``unanswered_mm``; an error above ``wrong_order_mm`` is a wrong order, and a confident one where the stated sigma is
    below ``confident_below`` of it."""

    version: Annotated[int, Field(ge=1)]
    light: Text
    views: dict[SetName, Annotated[list[Text], Field(min_length=1)]]
    unanswered_mm: Above0
    wrong_order_mm: Above0
    confident_below: Share
    axes: dict[str, Axis]

    @property
    def clean(self) -> Light:
        return named_light(self.light)

    def chosen(self, names: Sequence[str]) -> dict[str, Axis]:
        """The axes ``names``, in the file's order, all with none given; PredictionError for an unknown name."""
        unknown = [name for name in names if name not in self.axes]
        if unknown:
            raise PredictionError(f"unknown axis {unknown[0]!r}; there are {', '.join(self.axes)}")
        return {name: axis for name, axis in self.axes.items() if not names or name in names}


@cache
def corruptions() -> Corruptions:
    """The axes that come with the package."""
    return validate(Corruptions, strict_yaml(FILE.read_text(encoding="utf-8")), FILE, "axes", PredictionError)
