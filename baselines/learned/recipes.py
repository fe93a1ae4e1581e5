"""Training phase-net and crossed-net: the scene of the measured route for each view beside the
truth, the augmentation of windows, and the choice of constants on validation views. ``out`` of
phase-net also holds reliability.png.

Wrong base orders are made up in patches and whole windows, because they are rare on training
objects. One fringe: whole objects are moved to another distance, with the brightness that the
calibrated lamp would give there and unchanged phase errors; columns are mirrored, as with a
projector on the other side; brightness is varied a little. A crossed frame: windows are turned, and
some lose what the plane tells.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.learned import inputs
from fpp_ml_bench.baselines.learned.inputs import (
    CROSSED_CHANNELS,
    STEPS,
    CrossedScene,
    Geometry,
    PhaseScene,
)
from fpp_ml_bench.baselines.learned.method import ALBEDOS, Albedo
from fpp_ml_bench.baselines.learned.network import PhaseNet
from fpp_ml_bench.baselines.learned.odds import (
    Answers,
    Judged,
    chosen_odds,
    confident_shares,
    decided_mask,
    draw_reliability,
)
from fpp_ml_bench.baselines.learned.routes import crossed_answers, decided_order, phase_answers
from fpp_ml_bench.baselines.learned.scenes import View
from fpp_ml_bench.baselines.learned.training import CandidateTask, WindowRecipe
from fpp_ml_bench.baselines.learned.windows import (
    CANDIDATE_MAPS,
    IGNORED,
    Sample,
    Window,
    padded,
    symmetric,
    wrong_place,
)
from fpp_ml_bench.baselines.phase.candidates import chosen_values
from fpp_ml_bench.baselines.phase.geometry import TAU, Image, Mask, repeated
from fpp_ml_bench.baselines.phase.observe import OneCarrier, TwoCarriers
from fpp_ml_bench.baselines.phase.route import CrossedRoute, one_carrier, two_carriers
from fpp_ml_bench.baselines.phase.settings import Settings
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.errors import RecipeError
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import DIRECTIONS, Direction

RELIABILITY = "reliability.png"
JUDGED_PX = 3  # the stated chances are calibrated on every so many-th pixel
MIRRORED = 2  # as of `symmetric`: as with a projector on the other side

FURTHEST_RAD = 2.2
"""Distance in rad of the joint phase from a candidate beyond which it is not the right one: rivals
are 2 pi away."""

Geometries = Mapping[Direction, Geometry]


@dataclass(frozen=True)
class Variation:
    """How often (0 to 1) and how much windows are varied; with 0 throughout they stay as captured.
    ``shift``: how often objects are moved to any distance of the working range; ``shift_blind``:
    the same for a network without brightness, so that it does not learn where they mostly stand."""

    near_edge: float = 0.7
    shift: float = 0.5
    shift_blind: float = 0.8
    brightness: float = 0.04
    wrong_window: float = 0.15
    wrong_patch: float = 0.3
    mirror: float = 0.5


@dataclass(frozen=True)
class PhaseRecipe(WindowRecipe):
    """``albedo``: "one", with brightness as a cue for the order, or "any", without; ``directions``:
    the fringes it learns from, one frame each; every ``textured_every``-th of the drawn lights has
    albedo maps and gloss; ``validation_lights``: drawn ones for validation objects; ``vary``: how
    its windows are varied."""

    steps: int = 9000
    validate_every: int = 250
    albedo: Albedo = "one"
    directions: tuple[Direction, ...] = DIRECTIONS
    textured_every: int = 3
    validation_lights: int = 6
    vary: Variation = field(default_factory=Variation)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.albedo not in ALBEDOS:
            raise RecipeError(f"albedo {self.albedo!r}: expected {' or '.join(ALBEDOS)}")
        if not self.directions or any(direction not in DIRECTIONS for direction in self.directions):
            raise RecipeError(
                f"directions {self.directions}: expected some of {', '.join(DIRECTIONS)}"
            )

    @property
    def title(self) -> str:  # type: ignore[override]
        return f"Fringe order, mask and bounded phase correction, {self.albedo} albedo"

    @property
    def weights_name(self) -> str:
        return f"{self.name}-{self.albedo}-albedo"

    def task(self, rig: Rig) -> "PhaseTask":
        return PhaseTask(self, rig)


def phase_sample(view: View, image: NDArray[np.uint8], geometry: Geometry) -> Sample | None:
    """Sample of an image uint8 (H, W) of a view, whose void pixels count nowhere, in half
    precision; None where nothing calibrates its brightness, or no object is seen. What is missing:
    true absolute phase less that of the base order, in rad."""
    route = one_carrier(geometry.model)
    observation = route.observe(image, None)
    if not observation.background.calibrated or not observation.inside.any():
        return None
    order = route.choose(observation).order
    scene, part = PhaseScene.of(observation, order, geometry.shading), view.part(observation.crop)
    if not part.target.any():
        return None
    true_phase = observation.layer.absolute_phase(np.where(part.target, part.depth_mm, 1000.0))
    missing = np.where(part.target, true_phase - observation.phase_rad - TAU * order, 0.0)
    half = np.nan_to_num(missing).astype(np.float16)
    return Sample.of(
        part, scene.single(np.float16), half, direction=geometry.model.settings.direction
    )


def _moved(
    scene: PhaseScene,
    missing: Image,
    target: Mask,
    geometry: Geometry,
    vary: Variation,
    random: np.random.Generator,
) -> PhaseScene:
    """The object at another distance within the working range."""
    near, far = geometry.model.rig.working_range_mm
    layer = geometry.layer.at(scene.crop)
    true_rad = (layer.residual_phase(scene.phase_rad, scene.order) + missing).astype(np.float32)
    middle = float(np.median(true_rad[target]))
    gain, forward = float(np.median(layer.gain)), float(np.median(layer.forward))
    depth_m = random.uniform(near, far) / MM_PER_M
    delta = np.float32(gain / (forward * depth_m + layer.back_m) - middle)
    with np.errstate(all="ignore"):
        before, after = np.maximum(
            inputs.coarse_irradiance(scene, geometry, (true_rad, true_rad + delta)), 1e-3
        )
        ratio = np.clip(np.nan_to_num(after / before, nan=1.0), 0.4, 2.5)
    ratio = repeated(ratio, inputs.STEP_PX, scene.light.shape).astype(np.float32)
    ratio = np.where(
        target, ratio * np.float32(np.exp(random.normal(0, vary.brightness))), np.float32(1)
    )
    true_phase = scene.phase_rad + missing
    light = ratio * (scene.light + scene.bright * (np.cos(true_phase + delta) - np.cos(true_phase)))
    phase = scene.phase_rad + delta
    carry = np.rint(phase / TAU)
    return replace(
        scene,
        light=np.where(target, light, scene.light),
        bright=(scene.bright * ratio).astype(np.float32),
        phase_rad=(phase - TAU * carry).astype(np.float32),
        order=scene.order + carry.astype(np.int32),
        middle_rad=scene.middle_rad + float(delta),
    )


def _wrong(
    scene: PhaseScene,
    missing: Image,
    geometry: Geometry,
    vary: Variation,
    random: np.random.Generator,
) -> tuple[PhaseScene, Image]:
    """Wrong base orders, where the working range allows them."""
    where, whole = wrong_place(scene.light.shape, vary.wrong_window, vary.wrong_patch, random)
    if where is None:
        return scene, missing
    step = int(random.choice((-1, 1)))
    if not where.any():
        return scene, missing
    with np.errstate(all="ignore"):
        depth_mm = geometry.layer.at(scene.crop).depth_mm(
            scene.phase_rad, scene.order + where * np.int32(step)
        )
        off = np.where(geometry.in_range(depth_mm), where * step, 0).astype(np.int32)
    changed = replace(
        scene, order=scene.order + off, middle_rad=scene.middle_rad + TAU * step * whole
    )
    return changed, missing - np.float32(TAU) * off


class PhaseTask(CandidateTask):
    """What phase-net learns: one fringe of each direction of its recipe."""

    scored_share = 5
    thresholds = tuple(float(value) for value in np.arange(-5, 3.01, 0.5))
    leads = tuple(float(value) for value in range(8))
    tolerance_mm = 0.1

    wrong_rad = np.pi

    def __init__(self, recipe: PhaseRecipe, rig: Rig) -> None:
        super().__init__(recipe, rig)
        self.geometries: Geometries = {
            direction: Geometry(
                OneCarrier(rig, Settings(direction=direction, shading=recipe.albedo == "one"))
            )
            for direction in recipe.directions
        }
        self.frames = tuple(rig.sequence.sinusoids(direction)[0] for direction in recipe.directions)

    def samples(self, views: Iterable[View]) -> list[Sample]:
        """Samples of ``views``, whose frames are the first fringes of the recipe's directions, in
        their order; of a union for one direction alone, in turn. A view whose light the background
        does not calibrate is left out, since the network is not used on it."""
        samples: list[Sample] = []
        unions = 0
        for view in views:
            pairs = list(zip(self.geometries.values(), view.frames, strict=True))
            if view.united:
                pairs = [pairs[unions % len(pairs)]]
                unions += 1
            found = (phase_sample(view, frame, geometry) for geometry, frame in pairs)
            samples += [sample for sample in found if sample is not None]
        return samples

    def varied(
        self,
        sample: Sample,
        scene: PhaseScene,
        missing: Image,
        random: np.random.Generator,
        *truth: Mask,
    ) -> Window:
        vary, geometry, (target, void) = self.recipe.vary, self.geometries[sample.direction], truth
        moved = (
            random.random() < (vary.shift if geometry.shading else vary.shift_blind)
            and target.any()
        )
        if moved:
            scene = _moved(scene, missing, target, geometry, vary, random)
        scene, missing = _wrong(scene, missing, geometry, vary, random)
        x, exists = inputs.phase_channels(scene, geometry)
        turn = geometry.rotation.turn
        missing, target = turn(missing) * np.float32(geometry.rotation.sign), turn(target)
        steps = np.rint(missing / TAU).astype(np.int64)
        place = np.clip(steps, -1, 1) + 1
        possible = target & (np.abs(steps) <= 1) & chosen_values(exists, place)
        order, correction = (
            np.where(possible, place, IGNORED),
            (missing - TAU * steps).astype(np.float32),
        )
        maps = exists, order, correction, possible, target, turn(~void & (not moved))
        window = padded(self.recipe.window, {"x": x} | dict(zip(CANDIDATE_MAPS, maps, strict=True)))
        return (
            symmetric(window, inputs.PHASE_CHANNELS, MIRRORED)
            if random.random() < vary.mirror
            else window
        )

    def answers(self, network: PhaseNet, sample: Sample) -> Answers:
        return phase_answers(network, sample.scene.single(), self.geometries[sample.direction])

    def changes_rad(
        self, answers: Answers, sample: Sample, choice: NDArray[np.intp] | None = None
    ) -> Image:
        likeliest = answers.logits.argmax(axis=0) if choice is None else choice
        return TAU * np.array(STEPS, np.int32)[likeliest] + answers.correction_rad

    def depth_mm(self, sample: Sample, change_rad: Image) -> Image:
        scene = sample.scene.single()
        layer = self.geometries[sample.direction].layer.at(scene.crop)
        return layer.depth_of_residual_mm(
            layer.residual_phase(scene.phase_rad, scene.order) + change_rad
        )

    def judged(self, answers: Answers, sample: Sample, threshold: float) -> Judged:
        """Every `JUDGED_PX`-th object pixel of a sample, with the order that the method would
        choose."""
        scene = sample.scene.single()
        inside = decided_mask(answers, scene, threshold)
        choice = decided_order(answers, scene, inside, self.geometries[sample.direction])
        wrong = np.abs(self.changes_rad(answers, sample, choice) - sample.missing) > self.wrong_rad
        places = np.nonzero((sample.target & inside)[::JUDGED_PX, ::JUDGED_PX])
        row, column = (JUDGED_PX * place for place in places)
        return Judged(
            sample.group, answers.logits[:, row, column], choice[row, column], wrong[row, column]
        )

    def calibrated(
        self, fields: dict[str, Any], answers: list[Answers], validation: list[Sample], out: Path
    ) -> None:
        """The odds of a wrong order, of which a picture is drawn."""
        pairs = zip(answers, validation, strict=True)
        seen = [self.judged(one, sample, fields["threshold"]) for one, sample in pairs]
        odds = chosen_odds(seen)
        draw_reliability(out / RELIABILITY, seen, odds)
        fields["validation"]["confident_percent"] = 100 * max(confident_shares(seen, odds).values())
        fields |= vars(odds) | {
            "period_px": {way: geometry.period_px for way, geometry in self.geometries.items()}
        }


def crossed_sample(view: View, route: CrossedRoute) -> Sample:
    """The sample of a view; its void pixels are no target, and no background either. What is
    missing: joint phase of the true nearness less that of the scene's, in rad."""
    fitted = route.choose(route.observe(view.frames[0], None))
    carriers = fitted.seen.carriers
    part = view.part(carriers.crop)
    truth = carriers.nearness(np.where(part.target, part.depth_mm, 1000.0))
    missing = np.where(part.target, (truth - fitted.fit.nearness) * carriers.joint_gain, 0.0)
    return Sample.of(
        part,
        CrossedScene.of(fitted).single(np.float16),
        np.clip(missing, -100, 100).astype(np.float16),
    )


@dataclass(frozen=True)
class CrossedVariation:
    """How often (0 to 1) windows lie near an edge, get a wrong base order in the whole or in
    patches, and lose what the plane tells."""

    near_edge: float = 0.7
    wrong_window: float = 0.1
    wrong_patch: float = 0.25
    no_plane: float = 0.1


@dataclass(frozen=True)
class CrossedRecipe(WindowRecipe):
    """``vary``: how windows vary; the others as of `WindowRecipe`."""

    name: str = "crossed-net"
    steps: int = 6000
    lights: int = 48
    views_a_light: int = 10
    weight_mask: float = 1.0
    vary: CrossedVariation = field(default_factory=CrossedVariation)

    title: ClassVar[str] = "Fringe order, mask and bounded phase correction of a crossed frame"
    rig: ClassVar[str] = "crossed"
    inputs: ClassVar[tuple[str, ...]] = CROSSED_CHANNELS

    def task(self, rig: Rig) -> "CrossedTask":
        return CrossedTask(self, rig)


class CrossedTask(CandidateTask):
    """What crossed-net learns: one crossed frame. The validation objects have simple silhouettes,
    and two lights, so that thresholds are tried on training samples too."""

    thresholds = tuple(float(value) for value in np.arange(-6, 2.01, 0.5))
    leads = tuple(float(value) for value in range(6))
    growth = 1.25
    chosen_share = 8

    wrong_rad = np.pi / 2

    def __init__(self, recipe: CrossedRecipe, rig: Rig) -> None:
        super().__init__(recipe, rig)
        model = TwoCarriers(rig)
        self.route, self.carriers, self.frames = (
            two_carriers(model),
            model.carriers,
            rig.sequence.crossed_frames[:1],
        )

    def samples(self, views: Iterable[View]) -> list[Sample]:
        return [crossed_sample(view, self.route) for view in views]

    def varied(
        self,
        sample: Sample,
        scene: CrossedScene,
        missing: Image,
        random: np.random.Generator,
        *truth: Mask,
    ) -> Window:
        """In one of 8 orientations."""
        vary, carriers, (target, void), before = (
            self.recipe.vary,
            self.carriers,
            truth,
            scene.nearness,
        )
        where, _ = wrong_place(scene.light.shape, vary.wrong_window, vary.wrong_patch, random)
        if where is not None:
            scene = scene.with_base(int(random.choice((0, 2))), where, carriers)
            missing = np.where(
                target, missing - (scene.nearness - before) * carriers.at(scene.crop).joint_gain, 0
            )
        if random.random() < vary.no_plane:
            scene = replace(scene, plane_misfit=np.zeros_like(scene.plane_misfit), shown=False)
        x, exists = inputs.crossed_channels(scene, carriers)
        distance = missing - scene.offers_rad
        apart = np.where(exists, np.abs(distance), np.inf)
        place = apart.argmin(axis=0)
        possible = target & (apart.min(axis=0) < FURTHEST_RAD)
        correction = np.take_along_axis(distance, place[None], axis=0)[0] * possible
        maps = (
            exists,
            np.where(possible, place, IGNORED),
            correction.astype(np.float32),
            possible,
            target,
            ~void,
        )
        window = {"x": x} | dict(zip(CANDIDATE_MAPS, maps, strict=True))
        return padded(
            self.recipe.window, symmetric(window, CROSSED_CHANNELS, int(random.integers(8)))
        )

    def answers(self, network: PhaseNet, sample: Sample) -> Answers:
        return crossed_answers(network, sample.scene.single(), self.carriers)

    def changes_rad(self, answers: Answers, sample: Sample) -> Image:
        return (
            chosen_values(sample.scene.single().offers_rad, answers.logits.argmax(axis=0))
            + answers.correction_rad
        )

    def depth_mm(self, sample: Sample, change_rad: Image) -> NDArray:
        part = self.carriers.at(sample.scene.crop)
        return part.depth_mm(sample.scene.nearness + change_rad / part.joint_gain)

    def calibrated(
        self, fields: dict[str, Any], answers: list[Answers], validation: list[Sample], out: Path
    ) -> None:
        fields["period_px"] = {"crossed": self.carriers.period_px}
