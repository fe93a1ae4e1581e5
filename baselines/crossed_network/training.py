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
    TYPICAL_MM,
    Answers,
    PhaseNet,
    Trained,
    WindowRecipe,
    WindowTraining,
    load_net,
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
    recipe: CrossedRecipe, out: Path, *, rig: Rig | None = None, minutes: float | None = None, workers: int = 1,
    show: bool = False, print_line: Callable[[str], None] = lambda line: None,
) -> Trained:  # fmt: skip
    """Train for ``rig`` (default: `optics.crossed_rig`); the same call resumes a training that was stopped. ``show``:
    progress on stderr. Raises `TrainingError` for a folder of another recipe or rig."""
    started, rig = perf_counter(), rig or crossed_rig()
    groups = training.groups_of(recipe.lights, recipe.views_a_light, recipe.seed)
    described = recipe.to_dict() | {"rig": rig.to_dict()}
    fingerprint = training.fingerprint_of(described, groups)
    training.claim_folder(out, {"recipe": described, "dataset_fingerprint": fingerprint})
    weights = out / WEIGHTS
    if weights.exists():
        finished = load_net(weights).config
        known = {key: float(value or 0) for key, value in finished.validation.items()}
        return Trained(weights, finished.steps, finished.threshold, known)
    views = sum(len(group.views) for group in groups)
    with training.Display("rendering views", views, show) as display:
        (frame, *_) = rig.sequence.crossed_frames
        training.render_views(groups, rig, (frame,), out / VIEWS, workers, display.advance)
    route = CrossedRoute(rig)
    learnt = sum(len(group.views) for group in groups if group.split == "train")
    with training.Display("measuring views", views + learnt * recipe.unions, show) as display:
        learned = training.read_views(out / VIEWS, groups, "train")
        united = training.with_unions(learned, recipe.unions, recipe.seed, display.advance)
        samples = [sample_of(view, route) for view in united]
        kept = training.with_unions(training.read_views(out / VIEWS, groups, "validation"), 0, 0, display.advance)
        validation = [sample_of(view, route) for view in kept]
    carriers = route.carriers

    def scores(network: PhaseNet) -> dict[str, float]:
        scored = validation[::VALIDATED_SHARE]
        answers = (network_answers(network, sample.scene.single(), carriers) for sample in scored)
        return _mean([score(one, sample, carriers) for one, sample in zip(answers, scored, strict=True)])

    with training.reproducible(cpu=True):
        one_window = partial(draw, samples, carriers, recipe.window, recipe.vary)
        ongoing = WindowTraining(recipe, one_window, scores, out, print_line=print_line)
        ongoing.run(started, minutes, show)
        if not ongoing.over:
            return Trained(None, ongoing.steps_done, 0.0, {})
        network = ongoing.network
        answers = [network_answers(network, sample.scene.single(), carriers) for sample in validation]
        pixels = rig.camera.width * rig.camera.height
        some = samples[::CHOSEN_SHARE]
        of_some = [network_answers(network, sample.scene.single(), carriers) for sample in some]
        threshold = chosen_threshold(answers + of_some, validation + some, pixels)
        lead = chosen_lead(answers, validation, carriers)
        led = [one.with_lead(lead) for one in answers]
        means = _mean([score(one, s, carriers, threshold) for one, s in zip(led, validation, strict=True)])
    config = training.NetConfig(
        name=recipe.name, title="Fringe order, mask and bounded phase correction of a crossed frame",
        options=network.options, threshold=threshold, lead=lead, period_px={"crossed": carriers.period_px},
        dataset_fingerprint=fingerprint, benchmark=training.TrainingBenchmark("crossed-net views", 1),
        steps=recipe.steps, recipe=described, validation=dict(means),
    )  # fmt: skip
    save_net(weights, network, config)
    (out / training.CHECKPOINT).unlink(missing_ok=True)
    return Trained(weights, recipe.steps, threshold, means)


def score(answers: Answers, sample: Sample, carriers: Carriers, threshold: float = 0.0) -> dict[str, float]:
    """Scores of a view, each pixel's likeliest order taken. ``object_mae_mm`` counts a missed pixel with its whole
    depth; ``right_mae_mm``: MAE of pixels with the right order; ``wrong_percent`` and ``missed_percent``: shares of the
    object; ``invented_kpx``: background pixels with a depth, in thousands; ``within_percent``: errors of the joint
    phase within the stated standard uncertainty, 68 of a normal distribution."""
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
        "object_mae_mm": float(error.mean()), "right_mae_mm": float(error[right].mean()),
        "wrong_percent": 100 * float(wrong.mean()), "missed_percent": 100 * float((~detected).mean()),
        "invented_kpx": float((inside & ~target & ~sample.void).sum()) / 1000,
        "within_percent": 100 * float((apart < answers.sigma_rad[target])[right].mean()),
    }  # fmt: skip


def chosen_threshold(answers: list[Answers], samples: list[Sample], pixels: int) -> float:
    """The threshold out of `THRESHOLDS` with the least sum of object and background error: a missed object pixel and an
    invented background pixel are off by the same distance, each divided by the number of pixels of its kind."""
    costs = np.zeros(len(THRESHOLDS))
    for answer, sample in zip(answers, samples, strict=True):
        scene, object_px = sample.scene.single(), max(int(sample.target.sum()), 1)
        for number, threshold in enumerate(THRESHOLDS):
            inside = decided_mask(answer, scene, threshold)
            invented = (inside & ~sample.target & ~sample.void).sum()
            missed = (sample.target & ~inside).sum()
            costs[number] += TYPICAL_MM * (missed / object_px + invented / (pixels - object_px))
    return THRESHOLDS[int(costs.argmin())]


def chosen_lead(answers: list[Answers], samples: list[Sample], carriers: Carriers) -> float:
    """The lead out of `LEADS` with the fewest wrong orders, mean over the samples."""
    of_leads = [
        _mean([score(one.with_lead(lead), s, carriers) for one, s in zip(answers, samples, strict=True)])
        for lead in LEADS
    ]
    return LEADS[int(np.argmin([means["wrong_percent"] for means in of_leads]))]


def _mean(rows: list[dict[str, float]]) -> dict[str, float]:
    return {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}
