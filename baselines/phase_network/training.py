"""Training phase-net: views in drawn lights are rendered, measured, and cut into windows; no dataset is needed.

``out`` holds ``views/``, the files of the engine and, at the end, phase-net.safetensors instead of the checkpoint, and
reliability.png. A stopped training continues at every stage.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Literal, get_args

import numpy as np

from fpp_ml_bench.baselines import training
from fpp_ml_bench.baselines.phase_network.answers import Answers
from fpp_ml_bench.baselines.phase_network.inputs import STEPS, Geometry
from fpp_ml_bench.baselines.phase_network.net_file import load_net, save_net
from fpp_ml_bench.baselines.phase_network.network import PhaseNet
from fpp_ml_bench.baselines.phase_network.odds import Judged, chosen_odds, confident_shares, draw_reliability
from fpp_ml_bench.baselines.phase_network.route import decided_mask, decided_order, network_answers
from fpp_ml_bench.baselines.phase_network.samples import Sample, samples_of
from fpp_ml_bench.baselines.phase_network.validation import chosen_lead, chosen_threshold, mean_scores
from fpp_ml_bench.baselines.phase_network.window_training import WindowRecipe, WindowTraining
from fpp_ml_bench.baselines.phase_network.windows import Variation, draw
from fpp_ml_bench.baselines.phase_route import TAU, Settings
from fpp_ml_bench.errors import RecipeError
from fpp_ml_bench.optics import DIRECTIONS, Direction, Rig, paper_rig

Albedo = Literal["one", "any"]
VIEWS, RELIABILITY = "views", "reliability.png"
VALIDATED_SHARE = 5  # every so many-th validation sample is scored during training
JUDGED_PX = 3  # the stated chances are calibrated on every so many-th pixel
THRESHOLDS = tuple(float(value) for value in np.arange(-5, 3.01, 0.5))
"""Mask logits that are tried on the validation views; sums of errors this close to the least count as equal:"""
TOLERANCE_MM = 0.1
LEADS = tuple(float(value) for value in range(8))

Geometries = Mapping[Direction, Geometry]


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
    def shading(self) -> bool:
        """Whether brightness is a cue for the order."""
        return self.albedo == "one"

    @property
    def weights_name(self) -> str:
        """Of the file, and of the weights that come with the package."""
        return f"{self.name}-{self.albedo}-albedo"


def answers_of(network: PhaseNet, samples: list[Sample], geometries: Geometries, shading: bool) -> Iterator[Answers]:
    """The network's answers for each sample."""
    for sample in samples:
        yield network_answers(network, sample.scene.single(), geometries[sample.direction], shading)


def scores_of(
    answers: Iterable[Answers], samples: list[Sample], geometries: Geometries, threshold: float = 0.0
) -> dict[str, float]:
    """Means of each `score` over the samples that have it."""
    pairs = zip(answers, samples, strict=True)
    return mean_scores(score(answer, sample, geometries[sample.direction], threshold) for answer, sample in pairs)


def score(answers: Answers, sample: Sample, geometry: Geometry, threshold: float = 0.0) -> dict[str, float | None]:
    """Scores of one whole image with ``threshold`` on the mask's logit. ``object_mae_mm`` counts a missed pixel with
    its whole depth; ``right_mae_mm``: MAE of pixels with the right order; ``wrong_percent`` and ``missed_percent``:
    shares of the object's pixels; ``invented_kpx``: background pixels with a depth, in thousands; ``within_percent``:
    errors of the phase within the stated standard uncertainty, 68 of a normal distribution. Both are None where no
    order is right."""
    scene = sample.scene.single()
    layer = geometry.layer.at(scene.crop)
    steps, inside = np.array(STEPS, np.int32)[answers.logits.argmax(axis=0)], decided_mask(answers, scene, threshold)
    base_residual = layer.residual_phase(scene.phase_rad, scene.order)
    true_mm = layer.depth_of_residual_mm(base_residual + sample.missing_rad)
    phase_change = TAU * steps + answers.correction_rad
    predicted_mm = np.nan_to_num(layer.depth_of_residual_mm(base_residual + phase_change))
    target = sample.target
    phase_error = phase_change - sample.missing_rad
    error = np.where(inside, np.minimum(np.abs(predicted_mm - true_mm), true_mm), true_mm)[target]
    wrong = (np.abs(phase_error) > np.pi)[target]
    within = np.abs(phase_error) < answers.sigma_rad
    detected = inside[target]
    right = detected & ~wrong
    return {
        "object_mae_mm": float(error.mean()),
        "right_mae_mm": float(error[right].mean()) if right.any() else None,
        "wrong_percent": 100 * float(wrong.mean()),
        "missed_percent": 100 * float((~detected).mean()),
        "within_percent": 100 * float(within[target][right].mean()) if right.any() else None,
        "invented_kpx": float((inside & ~target & ~sample.void).sum()) / 1000,
    }


def judged(answers: Answers, sample: Sample, geometry: Geometry, threshold: float) -> Judged:
    """Every `JUDGED_PX`-th object pixel of a sample, with the order that the method would choose."""
    scene = sample.scene.single()
    inside = decided_mask(answers, scene, threshold)
    choice = decided_order(answers, scene, inside, geometry)
    change = TAU * np.array(STEPS, np.int32)[choice] + answers.correction_rad
    wrong = np.abs(change - sample.missing_rad) > np.pi
    places = np.nonzero((sample.target & inside)[::JUDGED_PX, ::JUDGED_PX])
    row, column = (JUDGED_PX * place for place in places)
    return Judged(sample.group, answers.logits[:, row, column], choice[row, column], wrong[row, column])


@dataclass(frozen=True)
class Trained:
    """The weights file (None for a training that stopped because its minutes were over), validation scores, and the
    mask threshold that was chosen there."""

    weights: Path | None
    steps: int
    threshold: float
    validation: dict[str, float]

    @classmethod
    def before(cls, weights: Path, config: training.NetConfig) -> "Trained":
        """Of a training that an earlier call finished."""
        scores = {key: float(value or 0) for key, value in config.validation.items()}
        return cls(weights, config.steps, config.threshold, scores)


def train_phase_net(
    recipe: Recipe,
    out: Path,
    *,
    rig: Rig | None = None,
    start: Path | None = None,
    minutes: float | None = None,
    workers: int = 1,
    show: bool = False,
    print_line: Callable[[str], None] = lambda line: None,
) -> Trained:
    """Train for ``rig`` (default: `optics.paper_rig`), starting from the weights in ``start`` or from random ones; the
    same call resumes a training that was stopped. ``show``: progress on stderr; ``print_line`` is given a line for
    every validation. Raises `TrainingError` for a folder of another recipe or rig."""
    started, rig = perf_counter(), rig or paper_rig()
    groups = training.groups_of(
        recipe.lights, recipe.views_a_light, recipe.seed, recipe.textured_every, recipe.validation_lights
    )
    start_weights = None if start is None else load_net(start, folded=False)
    described = recipe.to_dict() | {"rig": rig.to_dict()}
    described |= {} if start_weights is None else {"start_sha256": start_weights.sha256}
    fingerprint = training.fingerprint_of(described, groups)
    with training.alone_in(out):
        training.claim_folder(out, {"recipe": described, "dataset_fingerprint": fingerprint})
        weights = out / f"{recipe.weights_name}.safetensors"
        if weights.exists():
            return Trained.before(weights, load_net(weights).config)
        geometries = {
            direction: Geometry.of(rig, Settings(direction=direction, shading=recipe.shading))
            for direction in recipe.directions
        }
        frames = tuple(rig.sequence.sinusoids(direction)[0] for direction in recipe.directions)
        measure = partial(samples_of, geometries=geometries, shading=recipe.shading)
        samples, validation = training.measured_views(
            groups, rig, frames, out / VIEWS, measure, recipe.unions, recipe.seed, workers, show
        )

        def validated(network: PhaseNet) -> dict[str, float]:
            scored = validation[::VALIDATED_SHARE]
            return scores_of(answers_of(network, scored, geometries, recipe.shading), scored, geometries)

        with training.reproducible(cpu=True):
            one_window = partial(draw, samples, geometries, recipe.window, recipe.vary, recipe.shading)
            first = None if start_weights is None else start_weights.network
            ongoing = WindowTraining(recipe, one_window, validated, out, first, print_line)
            ongoing.run(started, minutes, show)
            if not ongoing.over:
                return Trained(None, ongoing.steps_done, 0.0, {})
            network = ongoing.network
            answers = list(answers_of(network, validation, geometries, recipe.shading))
            masks = [
                (sample, partial(decided_mask, one, sample.scene.single()))
                for one, sample in zip(answers, validation, strict=True)
            ]
            threshold = chosen_threshold(masks, THRESHOLDS, rig.camera.width * rig.camera.height, TOLERANCE_MM)

            def wrong_percent(lead: float) -> float:
                return scores_of((one.with_lead(lead) for one in answers), validation, geometries)["wrong_percent"]

            lead = chosen_lead(wrong_percent, LEADS)
            led = [one.with_lead(lead) for one in answers]
            means = scores_of(led, validation, geometries, threshold)
            pairs = zip(led, validation, strict=True)
            seen = [judged(one, sample, geometries[sample.direction], threshold) for one, sample in pairs]
        odds = chosen_odds(seen)
        draw_reliability(out / RELIABILITY, seen, odds)
        means["confident_percent"] = 100 * max(confident_shares(seen, odds).values())
        config = training.NetConfig(
            name=recipe.weights_name,
            title=f"Fringe order, mask and bounded phase correction, {recipe.albedo} albedo",
            options=network.options,
            threshold=threshold,
            lead=lead,
            temperature=odds.temperature,
            offset=odds.offset,
            doubted=odds.doubted,
            period_px={direction: g.route.period_px for direction, g in geometries.items()},
            dataset_fingerprint=fingerprint,
            benchmark=training.TrainingBenchmark("phase-net views", 1),
            steps=recipe.steps,
            recipe=described,
            validation=dict(means),
        )
        save_net(weights, network, config)
        (out / training.CHECKPOINT).unlink(missing_ok=True)
        return Trained(weights, recipe.steps, threshold, means)
