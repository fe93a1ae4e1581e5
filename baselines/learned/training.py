"""Training phase-net: the measurement of the phase route for each view beside the true phase, the augmentation of
windows, and the choice of constants on validation views. ``out`` also holds reliability.png.

Whole objects are moved to another distance, with the brightness that the calibrated lamp would give there and unchanged
phase errors. Wrong base orders are simulated in patches and whole windows, because they are rare on training objects.
Columns are mirrored, as with a projector on the other side. Brightness is varied a little.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.learned import inputs
from fpp_ml_bench.baselines.learned.inputs import FIRST_MISFIT, FIRST_SIDE, SIDES, STEPS, Geometry, Scene
from fpp_ml_bench.baselines.learned.network import PhaseNet
from fpp_ml_bench.baselines.learned.odds import Answers, Judged, chosen_odds, confident_shares, draw_reliability
from fpp_ml_bench.baselines.learned.route import decided_mask, decided_order, network_answers
from fpp_ml_bench.baselines.learned.window_training import CandidateTask, WindowRecipe
from fpp_ml_bench.baselines.learned.windows import (
    IGNORED,
    Sample,
    Window,
    candidate_scores,
    edge_points,
    padded,
    place_of,
    wrong_place,
)
from fpp_ml_bench.baselines.phase.calibration_layer import TAU, Image, Mask
from fpp_ml_bench.baselines.phase.candidates import chosen_values
from fpp_ml_bench.baselines.phase.observe import Settings
from fpp_ml_bench.baselines.phase.resampling import repeated
from fpp_ml_bench.baselines.training.views import View
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.depth import depth_edges, object_mask
from fpp_ml_bench.errors import RecipeError
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import DIRECTIONS, Direction

Albedo = Literal["one", "any"]
RELIABILITY = "reliability.png"
JUDGED_PX = 3  # the stated chances are calibrated on every so many-th pixel
_MIRRORED = inputs.CHANNELS.index("slope across")
_PARTNERS = [SIDES.index((row, -column)) for row, column in SIDES]
_SWAPPED = [FIRST_SIDE + n for n in _PARTNERS] + [FIRST_MISFIT] + [FIRST_MISFIT + 1 + n for n in _PARTNERS]

Geometries = Mapping[Direction, Geometry]


@dataclass(frozen=True)
class Variation:
    """How often (0 to 1) and how much windows are varied; with 0 throughout they stay as captured. ``shift``: how often
    objects are moved to any distance of the working range; ``shift_blind``: the same for a network without brightness,
    so that it does not learn where they mostly stand."""

    near_edge: float = 0.7
    shift: float = 0.5
    shift_blind: float = 0.8
    brightness: float = 0.04
    wrong_window: float = 0.15
    wrong_patch: float = 0.3
    mirror: float = 0.5


@dataclass(frozen=True)
class Recipe(WindowRecipe):
    """``albedo``: "one", with brightness as a cue for the order, or "any", without; ``directions``: the fringes it
    learns from, one frame each; every ``textured_every``-th of the drawn lights has albedo maps and gloss;
    ``validation_lights``: drawn ones for validation objects; ``vary``: how its windows are varied."""

    steps: int = 9000
    validate_every: int = 250
    albedo: Albedo = "one"
    directions: tuple[Direction, ...] = DIRECTIONS
    textured_every: int = 3
    validation_lights: int = 6
    vary: Variation = field(default_factory=Variation)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.albedo not in get_args(Albedo):
            raise RecipeError(f"albedo {self.albedo!r}: expected {' or '.join(get_args(Albedo))}")
        if not self.directions or any(direction not in DIRECTIONS for direction in self.directions):
            raise RecipeError(f"directions {self.directions}: expected some of {', '.join(DIRECTIONS)}")
        if not (self.textured_every >= 1 and self.validation_lights >= 0):
            raise RecipeError(
                f"textured_every {self.textured_every!r}, validation_lights {self.validation_lights!r}: expected 1 and "
                "more, 0 and more"
            )

    @property
    def title(self) -> str:  # type: ignore[override]
        return f"Fringe order, mask and bounded phase correction, {self.albedo} albedo"

    @property
    def drawn(self) -> tuple[int, ...]:
        return *super().drawn, self.textured_every, self.validation_lights

    @property
    def weights_name(self) -> str:
        return f"{self.name}-{self.albedo}-albedo"

    def task(self, rig: Rig) -> "PhaseTask":
        return PhaseTask(self, rig)


@dataclass(frozen=True)
class PhaseSample(Sample):
    """Of an image of the light ``group``. ``missing_rad`` float16 (h, w): true absolute phase minus that of the base
    order, 0 outside the object."""

    group: str
    direction: Direction
    missing_rad: NDArray[np.float16]


def sample_of(view: View, image: NDArray[np.uint8], geometry: Geometry) -> PhaseSample | None:
    """Sample of an image uint8 (H, W) of a view, whose void pixels count nowhere, in half precision; None where nothing
    calibrates its brightness, or no object is seen."""
    observation = geometry.route.observe(image)
    if not observation.background.calibrated or not observation.inside.any():
        return None
    order, _ = geometry.route.choose(observation)
    scene = Scene.of(observation, order, geometry.shading)
    depth_mm, void = view.depth_mm[observation.crop], view.void[observation.crop]
    target = object_mask(depth_mm) & ~void
    if not target.any():
        return None
    true_phase = observation.layer.absolute_phase(np.where(target, depth_mm, 1000.0))
    missing = np.where(target, true_phase - observation.phase_rad - TAU * order, 0.0)
    direction, half = geometry.route.settings.direction, np.nan_to_num(missing).astype(np.float16)
    edges = edge_points(depth_edges(depth_mm))
    own = view.name, scene.single(np.float16), target, void, edges
    return PhaseSample(*own, view.group, direction, half)


def _moved(
    scene: Scene, missing: Image, target: Mask, geometry: Geometry, vary: Variation, random: np.random.Generator
) -> Scene:
    """The object at another distance within the working range."""
    near, far = geometry.rig.working_range_mm
    layer = geometry.layer.at(scene.crop)
    true_rad = (layer.residual_phase(scene.phase_rad, scene.order) + missing).astype(np.float32)
    middle = float(np.median(true_rad[target]))
    gain, forward = float(np.median(layer.gain)), float(np.median(layer.forward))
    depth_m = random.uniform(near, far) / MM_PER_M
    delta = np.float32(gain / (forward * depth_m + layer.back_m) - middle)
    with np.errstate(all="ignore"):
        before, after = np.maximum(inputs.coarse_irradiance(scene, geometry, (true_rad, true_rad + delta)), 1e-3)
        ratio = np.clip(np.nan_to_num(after / before, nan=1.0), 0.4, 2.5)
    ratio = repeated(ratio, inputs.STEP_PX, scene.light.shape).astype(np.float32)
    ratio = np.where(target, ratio * np.float32(np.exp(random.normal(0, vary.brightness))), np.float32(1))
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
    scene: Scene, missing: Image, geometry: Geometry, vary: Variation, random: np.random.Generator
) -> tuple[Scene, Image]:
    """Wrong base orders, where the working range allows them."""
    where, whole = wrong_place(scene.light.shape, vary.wrong_window, vary.wrong_patch, random)
    if where is None:
        return scene, missing
    step = int(random.choice((-1, 1)))
    if not where.any():
        return scene, missing
    with np.errstate(all="ignore"):
        depth_mm = geometry.layer.at(scene.crop).depth_mm(scene.phase_rad, scene.order + where * np.int32(step))
        off = np.where(geometry.in_range(depth_mm), where * step, 0).astype(np.int32)
    changed = replace(scene, order=scene.order + off, middle_rad=scene.middle_rad + TAU * step * whole)
    return changed, missing - np.float32(TAU) * off


def _mirrored(window: Window) -> Window:
    flipped = {name: getattr(window, name)[..., ::-1].copy() for name in Window.__dataclass_fields__}
    flipped["x"][_MIRRORED] *= -1
    flipped["x"][FIRST_SIDE:] = flipped["x"][_SWAPPED]
    return Window(**flipped)


class PhaseTask(CandidateTask):
    """What phase-net learns: one fringe of each direction of its recipe."""

    scored_share = 5
    thresholds = tuple(float(value) for value in np.arange(-5, 3.01, 0.5))
    leads = tuple(float(value) for value in range(8))
    tolerance_mm = 0.1

    def __init__(self, recipe: Recipe, rig: Rig) -> None:
        super().__init__(rig)
        self.recipe = recipe
        self.geometries: Geometries = {
            direction: Geometry.of(rig, Settings(direction=direction, shading=recipe.albedo == "one"))
            for direction in recipe.directions
        }
        self.frames = tuple(rig.sequence.sinusoids(direction)[0] for direction in recipe.directions)

    def samples(self, views: Iterable[View]) -> list[PhaseSample]:
        """Samples of ``views``, whose frames are the first fringes of the recipe's directions, in their order; of a
        union for one direction alone, in turn. A view whose light the background does not calibrate is left out, since
        the network is not used on it."""
        samples: list[PhaseSample] = []
        unions = 0
        for view in views:
            pairs = list(zip(self.geometries.values(), view.frames, strict=True))
            if view.united:
                pairs = [pairs[unions % len(pairs)]]
                unions += 1
            found = (sample_of(view, frame, geometry) for geometry, frame in pairs)
            samples += [sample for sample in found if sample is not None]
        return samples

    def draw(self, samples: list[PhaseSample], random: np.random.Generator) -> Window:
        """A random window of one of ``samples``, varied."""
        size, vary = self.recipe.window, self.recipe.vary
        sample = samples[random.integers(len(samples))]
        geometry = self.geometries[sample.direction]
        rows, columns = place_of(sample.edges, sample.target.shape, size, random.random() < vary.near_edge, random)
        scene, missing = (
            sample.scene.window(rows, columns).single(),
            sample.missing_rad[rows, columns].astype(np.float32),
        )
        target, void = sample.target[rows, columns], sample.void[rows, columns]
        moved = random.random() < (vary.shift if geometry.shading else vary.shift_blind) and target.any()
        if moved:
            scene = _moved(scene, missing, target, geometry, vary, random)
        scene, missing = _wrong(scene, missing, geometry, vary, random)
        x, exists = inputs.channels(scene, geometry)
        turn = geometry.rotation.turn
        missing, target = turn(missing) * np.float32(geometry.rotation.sign), turn(target)
        steps = np.rint(missing / TAU).astype(np.int64)
        place = np.clip(steps, -1, 1) + 1
        possible = target & (np.abs(steps) <= 1) & chosen_values(exists, place)
        order, correction = np.where(possible, place, IGNORED), (missing - TAU * steps).astype(np.float32)
        window = padded(size, x, exists, order, correction, possible, target, turn(~void & (not moved)))
        return _mirrored(window) if random.random() < vary.mirror else window

    def answers(self, network: PhaseNet, sample: PhaseSample) -> Answers:
        return network_answers(network, sample.scene.single(), self.geometries[sample.direction])

    def decided(self, answers: Answers, scene: Scene, threshold: float) -> Mask:
        return decided_mask(answers, scene, threshold)

    def score(self, answers: Answers, sample: PhaseSample, inside: Mask) -> dict[str, float | None]:
        scene, target = sample.scene.single(), sample.target
        layer = self.geometries[sample.direction].layer.at(scene.crop)
        change = TAU * np.array(STEPS, np.int32)[answers.logits.argmax(axis=0)] + answers.correction_rad
        base = layer.residual_phase(scene.phase_rad, scene.order)
        true_mm, found_mm = (layer.depth_of_residual_mm(base + rad)[target] for rad in (sample.missing_rad, change))
        error = (change - sample.missing_rad)[target]
        return candidate_scores(found_mm, true_mm, error, answers.sigma_rad[target], inside, sample, np.pi)

    def judged(self, answers: Answers, sample: PhaseSample, threshold: float) -> Judged:
        """Every `JUDGED_PX`-th object pixel of a sample, with the order that the method would choose."""
        scene = sample.scene.single()
        inside = decided_mask(answers, scene, threshold)
        choice = decided_order(answers, scene, inside, self.geometries[sample.direction])
        change = TAU * np.array(STEPS, np.int32)[choice] + answers.correction_rad
        wrong = np.abs(change - sample.missing_rad) > np.pi
        places = np.nonzero((sample.target & inside)[::JUDGED_PX, ::JUDGED_PX])
        row, column = (JUDGED_PX * place for place in places)
        return Judged(sample.group, answers.logits[:, row, column], choice[row, column], wrong[row, column])

    def answered(self, network: PhaseNet, samples: list[PhaseSample], validation: list[PhaseSample]) -> Any:
        answers, fields = super().answered(network, samples, validation)
        pairs = zip(answers, validation, strict=True)
        return [self.judged(one, sample, fields["threshold"]) for one, sample in pairs], fields

    def chosen(self, answered: Any, validation: list[PhaseSample], out: Path) -> dict[str, Any]:
        """Also the odds of a wrong order, of which a picture is drawn."""
        seen, fields = answered
        odds = chosen_odds(seen)
        draw_reliability(out / RELIABILITY, seen, odds)
        confident = 100 * max(confident_shares(seen, odds).values())
        return {
            **fields,
            **vars(odds),
            "validation": fields["validation"] | {"confident_percent": confident},
            "period_px": {direction: g.route.period_px for direction, g in self.geometries.items()},
        }
