"""Training crossed-net: the measured route's scene of each view with the truth, windows of them, and what is chosen on
validation views."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.learned import crossed_inputs as inputs
from fpp_ml_bench.baselines.learned.crossed_inputs import CHANNELS, Scene
from fpp_ml_bench.baselines.learned.crossed_route import decided_mask, network_answers, offers_rad
from fpp_ml_bench.baselines.learned.network import PhaseNet
from fpp_ml_bench.baselines.learned.odds import Answers
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
from fpp_ml_bench.baselines.phase.calibration_layer import Mask
from fpp_ml_bench.baselines.phase.candidates import chosen_values
from fpp_ml_bench.baselines.phase.depth import CrossedRoute
from fpp_ml_bench.baselines.training.views import View
from fpp_ml_bench.depth import depth_edges
from fpp_ml_bench.optics.named_rigs import crossed_rig
from fpp_ml_bench.optics.rig import Rig

FURTHEST_RAD = 2.2
"""Distance in rad of the joint phase from a candidate beyond which it is not the right one: rivals are 2 pi away."""


@dataclass(frozen=True)
class CrossedSample(Sample):
    """``missing_rad`` float16 (h, w): joint phase of the true nearness less that of the scene's, 0 outside the
    object."""

    missing_rad: NDArray[np.float16]


def sample_of(view: View, route: CrossedRoute) -> CrossedSample:
    """The sample of a view; its void pixels are no target, and no background either."""
    seen = route.fitted(route.observe(view.frames[0]))
    crop = seen.carriers.crop
    depth_mm, void = view.depth_mm[crop], view.void[crop]
    target = (depth_mm > 0) & ~void
    truth = seen.carriers.nearness(np.where(target, depth_mm, 1000.0))
    missing = np.where(target, (truth - seen.fit.nearness) * seen.carriers.joint_gain, 0.0)
    half, edges = np.clip(missing, -100, 100).astype(np.float16), edge_points(depth_edges(depth_mm))
    return CrossedSample(view.name, Scene.of(seen).single(np.float16), target, void, edges, half)


@dataclass(frozen=True)
class Variation:
    """How often (0 to 1) windows lie near an edge, get a wrong base order in the whole or in patches, and lose what the
    plane tells."""

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
    vary: Variation = field(default_factory=Variation)

    title: ClassVar[str] = "Fringe order, mask and bounded phase correction of a crossed frame"

    @property
    def channels(self) -> int:
        return len(CHANNELS)

    def usual_rig(self) -> Rig:
        return crossed_rig()

    def task(self, rig: Rig) -> "CrossedTask":
        return CrossedTask(self, rig)


class CrossedTask(CandidateTask):
    """What crossed-net learns: one crossed frame. The validation objects have simple silhouettes, and two lights, so
    that thresholds are tried on training samples too."""

    thresholds = tuple(float(value) for value in np.arange(-6, 2.01, 0.5))
    leads = tuple(float(value) for value in range(6))
    chosen_share = 8

    def __init__(self, recipe: CrossedRecipe, rig: Rig) -> None:
        super().__init__(rig)
        self.recipe, self.route, self.frames = recipe, CrossedRoute(rig), (rig.sequence.crossed_frames[0],)

    def samples(self, views: Iterable[View]) -> list[CrossedSample]:
        return [sample_of(view, self.route) for view in views]

    def draw(self, samples: list[CrossedSample], random: np.random.Generator) -> Window:
        """A random window of one of ``samples``, varied, in one of 8 orientations."""
        size, vary, carriers = self.recipe.window, self.recipe.vary, self.route.carriers
        sample = samples[random.integers(len(samples))]
        rows, columns = place_of(sample.edges, sample.target.shape, size, random.random() < vary.near_edge, random)
        scene, missing = (
            sample.scene.window(rows, columns).single(),
            sample.missing_rad[rows, columns].astype(np.float32),
        )
        target, void = sample.target[rows, columns], sample.void[rows, columns]
        before = scene.nearness
        where, _ = wrong_place(scene.light.shape, vary.wrong_window, vary.wrong_patch, random)
        if where is not None:
            scene = scene.with_base(int(random.choice((0, 2))), where, carriers)
            missing = np.where(target, missing - (scene.nearness - before) * carriers.at(scene.crop).joint_gain, 0)
        if random.random() < vary.no_plane:
            scene = inputs.without_plane(scene)
        x, exists = inputs.channels(scene, carriers)
        distance = missing - offers_rad(scene)
        apart = np.where(exists, np.abs(distance), np.inf)
        place = apart.argmin(axis=0)
        possible = target & (apart.min(axis=0) < FURTHEST_RAD)
        correction = np.take_along_axis(distance, place[None], axis=0)[0] * possible
        order = np.where(possible, place, IGNORED)
        maps, x = inputs.symmetric([exists, order, correction, possible, target, ~void], x, int(random.integers(8)))
        exists, order, correction, *others = maps
        return padded(size, x, exists, order, correction.astype(np.float32), *others)

    def answers(self, network: PhaseNet, sample: CrossedSample) -> Answers:
        return network_answers(network, sample.scene.single(), self.route.carriers)

    def decided(self, answers: Answers, scene: Scene, threshold: float) -> Mask:
        return decided_mask(answers, scene, threshold)

    def score(self, answers: Answers, sample: CrossedSample, inside: Mask) -> dict[str, float | None]:
        scene, target = sample.scene.single(), sample.target
        part = self.route.carriers.at(scene.crop)
        joint = part.joint_gain
        change = chosen_values(offers_rad(scene), answers.logits.argmax(axis=0)) + answers.correction_rad
        found_mm, true_mm = (
            part.depth_mm(scene.nearness + rad / joint)[target] for rad in (change, sample.missing_rad)
        )
        error = (change - sample.missing_rad)[target]
        return candidate_scores(found_mm, true_mm, error, answers.sigma_rad[target], inside, sample, np.pi / 2)

    def chosen(self, answered: Any, validation: list[CrossedSample], out: Path) -> dict[str, Any]:
        return super().chosen(answered, validation, out) | {"period_px": {"crossed": self.route.carriers.period_px}}
