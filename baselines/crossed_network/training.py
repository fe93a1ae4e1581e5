"""Training crossed-net: views in drawn lights are rendered, measured, and cut into windows; no dataset is needed.

``out`` holds ``views/``, the files of the engine and, at the end, crossed-net.safetensors instead of the checkpoint. A
stopped training continues at every stage.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from time import perf_counter

import numpy as np

from fpp_ml_bench.baselines import training
from fpp_ml_bench.baselines.crossed_network.inputs import CHANNELS
from fpp_ml_bench.baselines.crossed_network.route import decided_mask, network_answers
from fpp_ml_bench.baselines.crossed_network.samples import Sample, Variation, draw, sample_of
from fpp_ml_bench.baselines.crossed_route import Carriers, CrossedRoute
from fpp_ml_bench.baselines.phase_network import (
    Answers,
    PhaseNet,
    Trained,
    WindowRecipe,
    WindowTraining,
    chosen_lead,
    chosen_threshold,
    load_net,
    mean_scores,
    save_net,
)
from fpp_ml_bench.baselines.phase_route import of_choice
from fpp_ml_bench.optics import Rig, crossed_rig

WEIGHTS, VIEWS = "crossed-net.safetensors", "views"
THRESHOLDS = tuple(float(value) for value in np.arange(-6, 2.01, 0.5))
"""Mask logits that are tried on the validation views, and on every `CHOSEN_SHARE`-th training sample: the validation
objects have simple silhouettes, and two lights."""
CHOSEN_SHARE = 8
LEADS = tuple(float(value) for value in range(6))
VALIDATED_SHARE = 3  # every so many-th validation view is scored during training


@dataclass(frozen=True)
class CrossedRecipe(WindowRecipe):
    """``vary``: how windows vary; the others as of `WindowRecipe`."""

    name: str = "crossed-net"
    steps: int = 6000
    lights: int = 48
    views_a_light: int = 10
    weight_mask: float = 1.0
    vary: Variation = field(default_factory=Variation)

    @property
    def channels(self) -> int:
        return len(CHANNELS)


def train_crossed_net(
    recipe: CrossedRecipe,
    out: Path,
    *,
    rig: Rig | None = None,
    minutes: float | None = None,
    workers: int = 1,
    show: bool = False,
    print_line: Callable[[str], None] = lambda line: None,
) -> Trained:
    """Train for ``rig`` (default: `optics.crossed_rig`); the same call resumes a training that was stopped. ``show``:
    progress on stderr. Raises `TrainingError` for a folder of another recipe or rig."""
    started, rig = perf_counter(), rig or crossed_rig()
    groups = training.groups_of(recipe.lights, recipe.views_a_light, recipe.seed)
    described = recipe.to_dict() | {"rig": rig.to_dict()}
    fingerprint = training.fingerprint_of(described, groups)
    with training.alone_in(out):
        training.claim_folder(out, {"recipe": described, "dataset_fingerprint": fingerprint})
        weights = out / WEIGHTS
        if weights.exists():
            return Trained.before(weights, load_net(weights).config)
        route, frame = CrossedRoute(rig), rig.sequence.crossed_frames[0]
        samples, validation = training.measured_views(
            groups,
            rig,
            (frame,),
            out / VIEWS,
            lambda views: [sample_of(view, route) for view in views],
            recipe.unions,
            recipe.seed,
            workers,
            show,
        )
        carriers = route.carriers

        def answers_of(network: PhaseNet, some: list[Sample]) -> list[Answers]:
            return [network_answers(network, sample.scene.single(), carriers) for sample in some]

        def scores_of(answers: list[Answers], some: list[Sample], threshold: float = 0.0) -> dict[str, float]:
            return mean_scores(
                score(one, sample, carriers, threshold) for one, sample in zip(answers, some, strict=True)
            )

        def validated(network: PhaseNet) -> dict[str, float]:
            scored = validation[::VALIDATED_SHARE]
            return scores_of(answers_of(network, scored), scored)

        with training.reproducible(cpu=True):
            one_window = partial(draw, samples, carriers, recipe.window, recipe.vary)
            ongoing = WindowTraining(recipe, one_window, validated, out, print_line=print_line)
            ongoing.run(started, minutes, show)
            if not ongoing.over:
                return Trained(None, ongoing.steps_done, 0.0, {})
            network = ongoing.network
            answers, some = answers_of(network, validation), samples[::CHOSEN_SHARE]
            masks = [
                (sample, partial(decided_mask, one, sample.scene.single()))
                for one, sample in zip(answers + answers_of(network, some), validation + some, strict=True)
            ]
            threshold = chosen_threshold(masks, THRESHOLDS, rig.camera.width * rig.camera.height)

            def wrong_percent(lead: float) -> float:
                return scores_of([one.with_lead(lead) for one in answers], validation)["wrong_percent"]

            lead = chosen_lead(wrong_percent, LEADS)
            means = scores_of([one.with_lead(lead) for one in answers], validation, threshold)
        config = training.NetConfig(
            name=recipe.name,
            title="Fringe order, mask and bounded phase correction of a crossed frame",
            options=network.options,
            threshold=threshold,
            lead=lead,
            period_px={"crossed": carriers.period_px},
            dataset_fingerprint=fingerprint,
            benchmark=training.TrainingBenchmark("crossed-net views", 1),
            steps=recipe.steps,
            recipe=described,
            validation=dict(means),
        )
        save_net(weights, network, config)
        (out / training.CHECKPOINT).unlink(missing_ok=True)
        return Trained(weights, recipe.steps, threshold, means)


def score(answers: Answers, sample: Sample, carriers: Carriers, threshold: float = 0.0) -> dict[str, float | None]:
    """Scores of a view, each pixel's likeliest order taken. ``object_mae_mm`` counts a missed pixel with its whole
    depth; ``right_mae_mm``: MAE of pixels with the right order; ``wrong_percent`` and ``missed_percent``: shares of the
    object; ``invented_kpx``: background pixels with a depth, in thousands; ``within_percent``: errors of the joint
    phase within the stated standard uncertainty, 68 of a normal distribution. Where no order is right, it and
    ``right_mae_mm`` are None."""
    scene, target = sample.scene.single(), sample.target
    part = carriers.at(scene.crop)
    joint = part.joint_gain
    offers = np.stack([scene.step_rad[0], np.zeros_like(joint), scene.step_rad[1]])
    change = of_choice(offers, answers.logits.argmax(axis=0)) + answers.correction_rad
    inside = decided_mask(answers, scene, threshold)
    truth = scene.nearness + sample.missing_rad / joint
    true_mm, found_mm = part.depth_mm(truth)[target], part.depth_mm(scene.nearness + change / joint)[target]
    apart = np.abs(change - sample.missing_rad)[target]
    detected, wrong = inside[target], apart > np.pi / 2
    error = np.abs(np.nan_to_num(found_mm) - true_mm)
    error = np.where(detected, np.minimum(error, true_mm), true_mm)
    right = detected & ~wrong
    return {
        "object_mae_mm": float(error.mean()),
        "right_mae_mm": float(error[right].mean()) if right.any() else None,
        "wrong_percent": 100 * float(wrong.mean()),
        "missed_percent": 100 * float((~detected).mean()),
        "within_percent": 100 * float((apart < answers.sigma_rad[target])[right].mean()) if right.any() else None,
        "invented_kpx": float((inside & ~target & ~sample.void).sum()) / 1000,
    }
