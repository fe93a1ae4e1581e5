"""Training phase-net, from dataset to weights file: windows of images, three losses, validation in mm on whole images.

``out`` holds the files of the engine and, at the end, phase-net.safetensors instead of the checkpoint.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from time import perf_counter

import numpy as np

from fpp_ml_bench.baselines import training
from fpp_ml_bench.baselines.phase_network.inputs import STEPS, Geometry
from fpp_ml_bench.baselines.phase_network.method import load_net, save_net
from fpp_ml_bench.baselines.phase_network.network import PhaseNet
from fpp_ml_bench.baselines.phase_network.route import Answers, decided_mask, network_answers, with_lead
from fpp_ml_bench.baselines.phase_network.samples import Sample, samples_of, unions_of
from fpp_ml_bench.baselines.phase_network.window_training import WindowRecipe, WindowTraining
from fpp_ml_bench.baselines.phase_network.windows import Variation, draw
from fpp_ml_bench.baselines.phase_route import TAU, Settings
from fpp_ml_bench.errors import RecipeError, TrainingError
from fpp_ml_bench.loaders.storage import DatasetFolder
from fpp_ml_bench.optics import DIRECTIONS, Direction

WEIGHTS = "phase-net.safetensors"
VALIDATED_SHARE = 5  # every so many-th validation image is scored during training
THRESHOLDS = tuple(float(value) for value in np.arange(-5, 3.01, 0.5))
"""Mask logits that are tried on the validation split."""
LEADS = tuple(float(value) for value in range(8))
"""Leads of the base order (see `network_answers`) that are tried on the validation split."""
TYPICAL_MM, _TOLERANCE_MM = 1800.0, 0.1
"""Depth error that a missed or invented pixel counts with; errors this close to the least count as equal."""


@dataclass(frozen=True)
class Recipe(WindowRecipe):
    """``directions``: the fringes it learns from, one frame each; ``unions``: images that join several objects, made
    from each sample (see `unions_of`); ``vary``: how its windows are varied."""

    directions: tuple[Direction, ...] = DIRECTIONS
    unions: int = 1
    vary: Variation = field(default_factory=Variation)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.unions <= 100:
            raise RecipeError(f"unions {self.unions!r}: expected 0 to 100 for every sample")
        if not self.directions or any(direction not in DIRECTIONS for direction in self.directions):
            raise RecipeError(f"directions {self.directions}: expected some of {', '.join(DIRECTIONS)}")


class PhaseNetTraining(WindowTraining):
    """Training on windows drawn from ``samples``, validated on whole images; the others as of `WindowTraining`."""

    def __init__(
        self, recipe: Recipe, samples: list[Sample], validation: list[Sample], geometries: dict[Direction, Geometry],
        out: Path, start: PhaseNet | None = None, print_line: Callable[[str], None] = lambda line: None,
    ) -> None:  # fmt: skip
        def scores(network: PhaseNet) -> dict[str, float]:
            if not validation:
                return {}
            return mean_scores(answers_of(network, validation, geometries), validation, geometries)

        one_window = partial(draw, samples, geometries, recipe.window, recipe.vary)
        super().__init__(recipe, one_window, scores, out, start, print_line)


def answers_of(network: PhaseNet, samples: list[Sample], geometries: dict[Direction, Geometry]) -> Iterator[Answers]:
    """The network's answers for each sample."""
    for sample in samples:
        yield network_answers(network, sample.scene.single(), geometries[sample.direction])


def mean_scores(
    answers: Iterable[Answers], samples: list[Sample], geometries: dict[Direction, Geometry], threshold: float = 0.0
) -> dict[str, float]:
    """Means of `score` over the samples."""
    pairs = zip(answers, samples, strict=True)
    rows = [score(answer, sample, geometries[sample.direction], threshold) for answer, sample in pairs]
    return {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}


def score(answers: Answers, sample: Sample, geometry: Geometry, threshold: float = 0.0) -> dict[str, float]:
    """Scores of one whole image with ``threshold`` on the mask's logit. ``object_mae_mm`` counts a missed pixel with
    its whole depth; ``right_mae_mm``: MAE of pixels with the right order; ``wrong_percent`` and ``missed_percent``:
    shares of the object's pixels; ``invented_kpx``: background pixels with a depth, in thousands."""
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
    detected = inside[target]
    return {
        "object_mae_mm": float(error.mean()),
        "right_mae_mm": float(error[detected & ~wrong].mean()),
        "wrong_percent": 100 * float(wrong.mean()),
        "missed_percent": 100 * float((~detected).mean()),
        "invented_kpx": float((inside & ~target).sum()) / 1000,
    }


def chosen_threshold(answers: list[Answers], samples: list[Sample], pixels: int) -> float:
    """The threshold out of `THRESHOLDS` with the least sum of object and background error: a missed object pixel and an
    invented background pixel are off by the same distance, each divided by the number of pixels of its kind. Among the
    thresholds within 0.1 mm of the least, the lowest: it misses the fewest pixels."""
    costs = np.zeros(len(THRESHOLDS))
    for answer, sample in zip(answers, samples, strict=True):
        scene = sample.scene.single()
        inside = max(int(sample.target.sum()), 1)
        for number, threshold in enumerate(THRESHOLDS):
            is_object = decided_mask(answer, scene, threshold)
            missed, invented = (sample.target & ~is_object).sum(), (is_object & ~sample.target).sum()
            costs[number] += TYPICAL_MM * (missed / inside + invented / (pixels - inside))
    means = costs / len(samples)
    return THRESHOLDS[int(np.flatnonzero(means < means.min() + _TOLERANCE_MM)[0])]


def chosen_lead(answers: list[Answers], samples: list[Sample], geometries: dict[Direction, Geometry]) -> float:
    """The lead out of `LEADS` with the fewest wrong orders, mean over the samples."""
    means = (mean_scores((with_lead(one, lead) for one in answers), samples, geometries) for lead in LEADS)
    return LEADS[int(np.argmin([mean["wrong_percent"] for mean in means]))]


@dataclass(frozen=True)
class Trained:
    """The weights file, scores on the whole validation split, and the mask threshold that was chosen there.
    ``weights`` is None for a training that stopped because its minutes were over."""

    weights: Path | None
    steps: int
    threshold: float
    validation: dict[str, float]


def train_phase_net(
    recipe: Recipe, dataset: Path, out: Path, *, extra: Path | None = None, start: Path | None = None,
    minutes: float | None = None, show: bool = False, print_line: Callable[[str], None] = lambda line: None,
) -> Trained:  # fmt: skip
    """Train on the dataset's training split, and on that of ``extra``, starting from the weights in ``start`` or from
    random ones; the same call resumes a training that was stopped. ``show``: progress on stderr; ``print_line`` is
    given a line for every validation. Raises `DatasetError` for a dataset without the frames in question,
    `TrainingError` for a folder of another recipe or dataset."""
    started = perf_counter()
    opened = DatasetFolder(dataset)
    extra_data = None if extra is None else DatasetFolder(extra)
    if extra_data is not None and extra_data.rig != opened.rig:
        raise TrainingError(f"{extra}: was made by another rig than {dataset}; build both with the same one")
    start_weights = None if start is None else load_net(start, folded=False)
    described = recipe.to_dict() | ({} if extra_data is None else {"extra_fingerprint": extra_data.fingerprint})
    described |= {} if start_weights is None else {"start_sha256": start_weights.sha256}
    training.claim_folder(out, {"recipe": described, "dataset_fingerprint": opened.fingerprint})
    weights = out / WEIGHTS
    if weights.exists():
        finished = load_net(weights).config
        scores = {key: float(value or 0) for key, value in finished.validation.items()}
        return Trained(weights, finished.steps, finished.threshold, scores)
    geometries = {direction: Geometry.of(opened.rig, Settings(direction=direction)) for direction in recipe.directions}
    folders = [opened] if extra_data is None else [opened, extra_data]
    samples, validation = _samples(recipe, folders, geometries, show)
    with training.reproducible(cpu=True):
        scored = validation[::VALIDATED_SHARE]
        first = None if start_weights is None else start_weights.network
        ongoing = PhaseNetTraining(recipe, samples, scored, geometries, out, first, print_line)
        ongoing.run(started, minutes, show)
        if not ongoing.over:
            return Trained(None, ongoing.steps_done, 0.0, {})
        network = ongoing.network
        answers = list(answers_of(network, validation, geometries))
        threshold = chosen_threshold(answers, validation, opened.size[0] * opened.size[1])
        lead = chosen_lead(answers, validation, geometries)
        means = mean_scores((with_lead(one, lead) for one in answers), validation, geometries, threshold)
    config = training.NetConfig(
        name=recipe.name, title="Fringe order, mask and bounded phase correction", options=network.options,
        threshold=threshold, lead=lead, period_px={direction: g.route.period_px for direction, g in geometries.items()},
        dataset_fingerprint=opened.fingerprint, benchmark=training.training_benchmark(opened.fingerprint),
        steps=recipe.steps, recipe=described, validation=dict(means),
    )  # fmt: skip
    save_net(weights, network, config)
    (out / training.CHECKPOINT).unlink(missing_ok=True)
    return Trained(weights, recipe.steps, threshold, means)


def _samples(
    recipe: Recipe, folders: list[DatasetFolder], geometries: dict[Direction, Geometry], show: bool
) -> tuple[list[Sample], list[Sample]]:
    """Training samples and unions of all ``folders``, and validation samples of the first."""
    train = [(folder, folder.samples("train")) for folder in folders]
    names = folders[0].samples("validation")
    images = (1 + recipe.unions) * sum(len(of_folder) for _, of_folder in train) + len(names)
    samples: list[Sample] = []
    validation: list[Sample] = []
    with training.Display("phase of the samples", images * len(geometries), show) as display:
        for geometry in geometries.values():
            for folder, of_folder in train:
                samples += samples_of(folder, of_folder, geometry, display.advance)
                samples += unions_of(folder, of_folder, geometry, recipe.unions, recipe.seed, display.advance)
            validation += samples_of(folders[0], names, geometry, display.advance)
    return samples, validation
