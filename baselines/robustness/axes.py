"""The rules of FPP-C: the axes, each of which changes one stage of the image formation at five
severities (``axes.yaml``), the disturbed views, and the scores: the protocol's two-sided MAE, and
how honest the stated uncertainty is.

Of a view only the frames that a method uses are rendered, and kept in a cache: a folder for each
condition with a file for each frame, which depends on nothing but the condition and the view, so
methods share it. The folders that were used longest ago go where it would grow beyond its limit.

Scored are the object pixels of the undisturbed scene that are not void, against its exact depth,
and what is answered beside the object.

After Hendrycks and Dietterich 2019, Benchmarking Neural Network Robustness to Common Corruptions
and Perturbations; but every corruption is caused in the scene, not painted on the image.
"""

import json
import os
import shutil
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from hashlib import blake2b
from io import BytesIO
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fpp_ml_bench import __version__
from fpp_ml_bench.constants import GREY_LEVELS, TEST_OBJECTS, UNSEEN, sample_name
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.result.parts import SeverityScores
from fpp_ml_bench.evaluation.score.sample_scores import score_sigma, states_sigma
from fpp_ml_bench.evaluation.score.uncertainty import mean_of
from fpp_ml_bench.files import strict_yaml, write_atomically
from fpp_ml_bench.loaders.render.light import Light, named_light
from fpp_ml_bench.loaders.render.meshes import solid_mesh
from fpp_ml_bench.loaders.render.scene import BuildSettings
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.loaders.sample import void_pixels
from fpp_ml_bench.optics.named_rigs import NAMED_RIGS
from fpp_ml_bench.schema import StrictModel, Text, validate

FILE = Path(__file__).with_name("axes.yaml")
SetName = Literal["test", "unseen"]
SETS: dict[SetName, tuple[str, ...]] = {"test": TEST_OBJECTS, "unseen": UNSEEN}
"""Objects of each set that a method can be measured on."""
CLEAN = "clean"
CACHE = (
    Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser() / "fpp-ml-bench" / "robustness"
)
LIMIT_BYTES = 10_000_000_000
"""Most bytes that the cache of rendered frames takes on disk; the folders that were used longest
ago go first."""
Frames = list[NDArray[np.uint8] | None]
Share = Annotated[float, Field(gt=0, le=1)]
Above0 = Annotated[float, Field(gt=0)]


class Axis(StrictModel):
    """One corruption: ``key`` of the light's ``stage`` (the light itself with none) takes the
    values ``severities``, in ``unit``, and ``also`` holds what else the stage needs. ``electrons``:
    the values are grey levels, the key wants electrons. ``several_frames``: it does nothing to one
    frame. ``objects``: only these are disturbed by it. ``beside``: it does not count in the mean
    over axes. ``drawn``: trainings draw it, unless their recipe holds it out; ``held_out``: those
    of today do."""

    unit: Text
    stage: Literal["", "projector", "surface", "bounces", "camera"] = ""
    key: Text
    severities: Annotated[list[Above0], Field(min_length=5, max_length=5)]
    also: dict[str, Any] = Field(default_factory=dict)
    electrons: bool = False
    several_frames: bool = False
    objects: list[str] = Field(default_factory=list)
    beside: bool = False
    drawn: bool = False
    held_out: bool = False

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
    """``axes.yaml``. ``views`` of each object of a set are measured. An error above
    ``wrong_order_mm`` is a wrong order, and a confident one where the stated sigma is below
    ``confident_below`` of it."""

    version: Annotated[int, Field(ge=1)]
    light: Text
    views: dict[SetName, Annotated[list[Text], Field(min_length=1)]]
    wrong_order_mm: Above0
    confident_below: Share
    axes: dict[str, Axis]

    @property
    def clean(self) -> Light:
        return named_light(self.light)

    def chosen(self, names: Sequence[str]) -> dict[str, Axis]:
        """The axes ``names``, in the file's order, all with none given; PredictionError for an
        unknown name."""
        unknown = [name for name in names if name not in self.axes]
        if unknown:
            raise PredictionError(f"unknown axis {unknown[0]!r}; there are {', '.join(self.axes)}")
        return {name: axis for name, axis in self.axes.items() if not names or name in names}


@cache
def corruptions() -> Corruptions:
    """The axes that come with the package."""
    return validate(
        Corruptions, strict_yaml(FILE.read_text(encoding="utf-8")), FILE, "axes", PredictionError
    )


Scores = dict[str, float | None]
SCORES = tuple(SeverityScores.model_fields)
"""Of a view, as `SeverityScores` has them of several."""


class Truth(NamedTuple):
    """``depth_mm`` float32 (H, W) of an undisturbed view; bool (H, W): the object pixels
    ``scored``, and the background pixels ``empty``; void ones are neither."""

    depth_mm: NDArray[np.float32]
    scored: NDArray[np.bool_]
    empty: NDArray[np.bool_]


@dataclass(frozen=True)
class Condition:
    """An axis at a severity, 1 to 5, for the objects ``objects`` seen at ``size`` px; severity 0 is
    the clean scene. ``rig``: one of `optics.NAMED_RIGS`."""

    axis: str
    severity: int
    objects: tuple[str, ...]
    size: int
    rig: str = "paper"

    @property
    def settings(self) -> BuildSettings:
        rules = corruptions()
        light = (
            rules.clean
            if self.axis == CLEAN
            else rules.axes[self.axis].light(rules.clean, self.severity)
        )
        return BuildSettings(rig=NAMED_RIGS[self.rig](self.size), objects=self.objects, light=light)

    @cache  # noqa: B019  of a few conditions
    def key(self, frames: tuple[int, ...]) -> str:
        """Name of the condition's folder. Where the object moves, each frame's place depends on
        which are captured."""
        described = self.settings.describe()
        del described["objects"]
        moving = frames if described["light"]["motion_mm"] else ()
        rig = [] if self.rig == "paper" else [self.rig]
        text = json.dumps([__version__, self.size, described, moving, *rig], sort_keys=True)
        return f"{self.axis}-{self.severity}-{blake2b(text.encode(), digest_size=8).hexdigest()}"


class FrameCache:
    """Frames and truths below ``folder``, None for no cache."""

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder

    def frames(self, condition: Condition, name: str, view: str, wanted: Sequence[int]) -> Frames:
        """The sequence of a view with the frames ``wanted``, uint8 (H, W) each, and None for the
        others. A moving object rests halfway through the frames, which are captured one after
        another."""
        studio = _studio(condition)
        files = {
            index: self._file(condition, wanted, f"{sample_name(name, view)}-{index:02d}")
            for index in wanted
        }
        out: Frames = [None] * len(studio.rig.sequence)
        for index, file in files.items():
            out[index] = _load(file)
        missing = tuple(index for index in wanted if out[index] is None)
        if missing and studio.light.motion_mm:
            middle = (len(wanted) - 1) / 2
            studio.expose_moving(
                _mesh(name), view, {index: wanted.index(index) - middle for index in missing}
            )
        elif missing:
            studio.expose(studio.trace(_mesh(name), view), missing)
        for index in missing:
            out[index] = frame = studio.frame(index).copy()
            _save(files[index], frame)
        return out

    def truth(self, clean: Condition, name: str, view: str) -> Truth:
        """Exact depth and scored pixels of an undisturbed view."""
        studio = _studio(clean)
        file = self._file(clean, (), f"{sample_name(name, view)}-truth-2")
        kept = _load(file)
        if kept is None:
            scene = studio.trace(_mesh(name), view)
            depth_mm = studio.exact_mm(scene)
            inside, valid = object_mask(depth_mm), ~void_pixels(studio.flags(scene)[0])
            kept = np.stack([depth_mm, inside & valid, ~inside & valid])
            _save(file, kept)
        return Truth(kept[0], kept[1] > 0, kept[2] > 0)

    def make_room(self, needed_bytes: int, limit_bytes: int = LIMIT_BYTES) -> None:
        """Remove the folders that were used longest ago until ``needed_bytes`` more stay below the
        limit."""
        if self.folder is None or not self.folder.is_dir():
            return
        entries = [entry for entry in self.folder.iterdir() if entry.is_dir()]
        sizes = {entry: sum(file.stat().st_size for file in entry.iterdir()) for entry in entries}
        total = sum(sizes.values())
        for entry in sorted(sizes, key=lambda entry: entry.stat().st_mtime):
            if total + needed_bytes <= limit_bytes:
                return
            shutil.rmtree(entry, ignore_errors=True)
            total -= sizes[entry]

    def _file(self, condition: Condition, wanted: Sequence[int], name: str) -> Path | None:
        return (
            None
            if self.folder is None
            else self.folder / condition.key(tuple(wanted)) / f"{name}.npy"
        )


_mesh = lru_cache(maxsize=max(map(len, SETS.values())))(solid_mesh)
"""An object of a set; what its light takes from the mesh alone is kept with it."""


@lru_cache(maxsize=2)
def _studio(condition: Condition) -> Studio:
    """A process holds those of the clean scene and of the condition that it is at."""
    return Studio(condition.settings)


def _load(file: Path | None) -> NDArray | None:
    """The array of a file of the cache; None where there is none, or no whole one."""
    if file is None:
        return None
    try:
        array: NDArray = np.load(file, allow_pickle=False)
        os.utime(file.parent)
    except (OSError, ValueError, EOFError):
        return None
    return array


def _save(file: Path | None, array: NDArray) -> None:
    if file is None:
        return
    content = BytesIO()
    np.save(content, array, allow_pickle=False)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(file, content.getvalue(), sync=False)
    except OSError as error:
        raise PredictionError(
            f"{file}: can't be written ({error.strerror}); free some space, or --no-cache"
        ) from error


def score(
    depth_mm: NDArray[np.floating],
    sigma_mm: NDArray[np.floating] | None,
    truth: Truth,
    rules: Corruptions,
    charge_mm: float,
) -> Scores:
    """`SCORES` of a prediction (H, W) in mm, 0 or less without an answer (a network may go below
    0), whose standard uncertainty is ``sigma_mm`` (H, W), above 0 where it is stated; ``charge_mm``
    is what a missed or invented pixel costs. `method.checked` has passed the maps."""
    target = truth.depth_mm[truth.scored].astype(np.float64)
    if target.size == 0:
        return dict.fromkeys(SCORES)
    given = depth_mm[truth.scored].astype(np.float64)
    answered = given > 0
    error = np.abs(given - target)
    wrong = answered & (error > rules.wrong_order_mm)
    invented_share = np.count_nonzero(truth.empty & (depth_mm > 0)) / target.size
    scores: Scores = {
        "mae_mm": float(np.where(answered, error, charge_mm).mean()) + charge_mm * invented_share,
        "wrong_share": float(wrong.mean()),
        "unanswered_share": float((~answered).mean()),
        "invented_share": invented_share,
        "answered_mae_mm": float(error[answered].mean()) if answered.any() else None,
        **dict.fromkeys(("confident_share", "coverage", "sure_mae_mm", "sure_rmse_mm")),
    }
    if sigma_mm is not None:
        sigma = sigma_mm[truth.scored].astype(np.float64)
        stated = states_sigma(given, sigma)
        scores["confident_share"] = float(
            (wrong & stated & (sigma < rules.confident_below * error)).mean()
        )
        scores["coverage"] = float(stated.mean())
        stated_scores = score_sigma(
            depth_mm, truth.depth_mm, sigma_mm, ~(truth.scored | truth.empty), charge_mm
        )
        scores |= {f"sure_{name}": stated_scores.sure_mm(name) for name in ("mae_mm", "rmse_mm")}
    return scores


def severity_means(views: Sequence[Mapping[str, Any]]) -> dict[int, Scores]:
    """Mean of each score over the views of a severity that have it."""
    by_severity: dict[int, list[Mapping[str, Any]]] = defaultdict(list)
    for view in views:
        by_severity[view["severity"]].append(view)
    return {
        severity: {key: mean_of(view.get(key) for view in by_severity[severity]) for key in SCORES}
        for severity in sorted(by_severity)
    }
