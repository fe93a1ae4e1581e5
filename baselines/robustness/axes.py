"""The rules of FPP-C: the axes, each of which changes one stage of the image formation at five severities
(``axes.yaml``), and the scores: errors with a fixed charge for a pixel without an answer, and how honest the stated
uncertainty is.

Scored are the object pixels of the undisturbed scene that are not void, against its exact depth. A pixel without an
answer is charged half an order, so that "I don't know" is better than a wrong order and worse than a right one.

After Hendrycks and Dietterich 2019, Benchmarking Neural Network Robustness to Common Corruptions and Perturbations; but
every corruption is caused in the scene, not painted on the image.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fpp_ml_bench.constants import GREY_LEVELS, TEST_OBJECTS, UNSEEN
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.score.sample_scores import states_sigma
from fpp_ml_bench.files import strict_yaml
from fpp_ml_bench.loaders.render.light import Light, named_light
from fpp_ml_bench.loaders.sample import void_pixels
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


Scores = dict[str, float | None]
SCORES = ("mae_mm", "protocol_mae_mm", "wrong_share", "unanswered_share", "confident_share", "coverage")
"""Of a view: mean error with `Corruptions.unanswered_mm` for a pixel without an answer; the same with its whole depth,
as the protocol has it; shares of wrong orders and of pixels without an answer; of confident errors, and of pixels that
state a sigma, both None for a method that states none."""


@dataclass(frozen=True)
class Truth:
    """``depth_mm`` float32 (H, W) and ``scored`` bool (H, W) of an undisturbed view."""

    depth_mm: NDArray[np.float32]
    scored: NDArray[np.bool_]

    @classmethod
    def of(cls, depth_mm: NDArray[np.float32], flags: NDArray[np.uint8]) -> "Truth":
        return cls(depth_mm, object_mask(depth_mm) & ~void_pixels(flags))


def score(
    depth_mm: NDArray[np.floating], sigma_mm: NDArray[np.floating] | None, truth: Truth, rules: Corruptions
) -> Scores:
    """`SCORES` of a prediction (H, W) in mm, 0 or less without an answer (a network may go below 0), whose standard
    uncertainty is ``sigma_mm`` (H, W), above 0 where it is stated. Raises PredictionError for a depth that is not
    finite, a sigma that is not finite or below 0, and for another size."""
    for name, values in (("depth", depth_mm), ("sigma", sigma_mm)):
        if values is None:
            continue
        if values.shape != truth.depth_mm.shape:
            raise PredictionError(f"{name}: expected a map of {truth.depth_mm.shape}, got {values.shape}")
        if not np.isfinite(values).all() or (name == "sigma" and (values < 0).any()):
            raise PredictionError(f"{name}: expected finite mm, a sigma of 0 and more; the method is at fault")
    target = truth.depth_mm[truth.scored].astype(np.float64)
    if target.size == 0:
        return dict.fromkeys(SCORES)
    given = depth_mm[truth.scored].astype(np.float64)
    answered = given > 0
    error = np.abs(given - target)
    wrong = answered & (error > rules.wrong_order_mm)
    scores: Scores = {
        "mae_mm": float(np.where(answered, error, rules.unanswered_mm).mean()),
        "protocol_mae_mm": float(error.mean()),
        "wrong_share": float(wrong.mean()),
        "unanswered_share": float((~answered).mean()),
        "confident_share": None,
        "coverage": None,
    }
    if sigma_mm is not None:
        sigma = sigma_mm[truth.scored].astype(np.float64)
        stated = states_sigma(given, sigma)
        scores["confident_share"] = float((wrong & stated & (sigma < rules.confident_below * error)).mean())
        scores["coverage"] = float(stated.mean())
    return scores


def severity_means(views: Sequence[Mapping[str, Any]]) -> dict[int, Scores]:
    """Mean of each score over the views of a severity that have it."""
    means = {}
    for severity in sorted({view["severity"] for view in views}):
        of_severity = [view for view in views if view["severity"] == severity]
        columns = {key: [view[key] for view in of_severity if view.get(key) is not None] for key in SCORES}
        means[severity] = {key: float(np.mean(values)) if values else None for key, values in columns.items()}
    return means
