"""A training from dataset to weights file, for ``fpp-bench train phase-net``.

``out`` holds recipe.json, checkpoint.safetensors while it runs, log.jsonl, curve.png and phase-net.safetensors.
"""

import json
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fpp_ml_bench.baselines.phase_network.inputs import Geometry
from fpp_ml_bench.baselines.phase_network.recipe import Recipe
from fpp_ml_bench.baselines.phase_network.route import Answers, decided_mask, network_answers
from fpp_ml_bench.baselines.phase_network.samples import Sample, samples_of, unions_of
from fpp_ml_bench.baselines.phase_network.training import CHECKPOINT_FILE, score, train
from fpp_ml_bench.baselines.phase_network.weights import NetConfig, load_net, save_net
from fpp_ml_bench.baselines.phase_route import Settings
from fpp_ml_bench.baselines.training import CURVE_FILE, LOG_FILE, training_benchmark, write_log
from fpp_ml_bench.errors import TrainingError
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.loaders.storage import DatasetFolder
from fpp_ml_bench.optics import Direction

WEIGHTS_FILE, RECIPE_FILE = "phase-net.safetensors", "recipe.json"
THRESHOLDS = tuple(float(value) for value in np.arange(-5, 3.01, 0.5))
"""Mask logits that are tried on the validation split."""
LEADS = tuple(float(value) for value in range(8))
"""Leads of the base order (see `route.network_answers`) that are tried on the validation split."""
_TYPICAL_MM, _TOLERANCE_MM = 1800.0, 0.1
"""Depth error that a missed or invented pixel counts with; errors this close to the least count as equal."""


Bar = Callable[[str, int, str], AbstractContextManager[Callable[[int], None]]]
"""A progress bar of a title, a total and a unit, which yields what advances it."""


def without_bar(title: str, total: int, unit: str) -> AbstractContextManager[Callable[[int], None]]:
    """No progress bar."""
    return nullcontext(lambda count: None)


@dataclass(frozen=True)
class Trained:
    """The weights file, scores on the whole validation split, and the mask threshold that was chosen there.
    ``weights`` is None for a training that stopped because its minutes were over."""

    weights: Path | None
    steps: int
    threshold: float
    validation: dict[str, float]


def train_phase_net(
    recipe: Recipe, dataset: Path, out: Path, minutes: float | None = None, bar: Bar = without_bar,
    print_line: Callable[[str], None] = lambda line: None, extra: Path | None = None, start: Path | None = None,
) -> Trained:  # fmt: skip
    """Train on the dataset's training split, and on that of ``extra`` where it is given, starting from the weights in
    ``start`` or from random ones; the same call resumes a training that was stopped.

    Raises `DatasetError` for a dataset without the frames in question, `TrainingError` for a folder of another recipe
    or dataset.
    """
    opened = DatasetFolder(dataset)
    cv2.setNumThreads(1)
    out.mkdir(parents=True, exist_ok=True)
    extra_data = None if extra is None else DatasetFolder(extra)
    if extra_data is not None and extra_data.rig != opened.rig:
        raise TrainingError(f"{extra}: was made by another rig than {dataset}; build both with the same one")
    start_weights = None if start is None else load_net(start, folded=False)
    described = recipe.to_dict() | ({} if extra_data is None else {"extra_fingerprint": extra_data.fingerprint})
    described |= {} if start_weights is None else {"start_sha256": start_weights.sha256}
    _claim(out / RECIPE_FILE, {"recipe": described, "dataset_fingerprint": opened.fingerprint})
    if (out / WEIGHTS_FILE).exists():
        finished = load_net(out / WEIGHTS_FILE).config
        scores = {key: float(value or 0) for key, value in finished.validation.items()}
        return Trained(out / WEIGHTS_FILE, finished.steps, finished.threshold, scores)
    geometries = {direction: Geometry.of(opened.rig, Settings(direction=direction)) for direction in recipe.directions}
    training_names, validation_names = opened.samples("train"), opened.samples("validation")
    samples: list[Sample] = []
    validation: list[Sample] = []
    extra_names = [] if extra_data is None else extra_data.samples("train")
    images = (1 + recipe.unions) * (len(training_names) + len(extra_names)) + len(validation_names)
    with bar("phase of the samples", images * len(geometries), "samples") as advance:
        for geometry in geometries.values():
            for folder, names in [
                (opened, training_names),
                *([] if extra_data is None else [(extra_data, extra_names)]),
            ]:
                samples += samples_of(folder, names, geometry, advance)
                samples += unions_of(folder, names, geometry, recipe.unions, recipe.seed, advance)
            validation += samples_of(opened, validation_names, geometry, advance)

    def report(history: list[dict[str, Any]]) -> None:
        write_log(out, history)
        print_line("  ".join(f"{key} {value:.4g}" for key, value in history[-1].items()))

    with bar(f"{recipe.name}, training", recipe.steps, "steps") as advance:
        trained = train(
            recipe,
            samples,
            validation[::5],
            geometries,
            out,
            report,
            advance,
            minutes,
            start_weights.network if start_weights is not None else None,
        )
    write_log(out, trained.history)
    draw(out / CURVE_FILE, trained.history, recipe.name)
    if trained.steps < recipe.steps:
        return Trained(None, trained.steps, 0.0, {})
    raw_answers = [
        network_answers(trained.network, sample.scene.single(), geometries[sample.direction]) for sample in validation
    ]
    threshold = chosen_threshold(raw_answers, validation, opened.size[0] * opened.size[1])
    lead = chosen_lead(raw_answers, validation, geometries)
    answers = [with_lead(answer, lead) for answer in raw_answers]
    rows = [score(a, s, geometries[s.direction], threshold) for a, s in zip(answers, validation, strict=True)]
    means = {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}
    name = recipe.name if extra_data is None else f"{recipe.name}-fresh"
    config = NetConfig(
        name=name, title="Fringe order, mask and bounded phase correction", options=trained.network.options,
        threshold=threshold, lead=lead, period_px={direction: g.route.period_px for direction, g in geometries.items()},
        dataset_fingerprint=opened.fingerprint, benchmark=training_benchmark(opened.fingerprint), steps=recipe.steps,
        recipe=described, validation=dict(means),
    )  # fmt: skip
    save_net(out / WEIGHTS_FILE, trained.network, config)
    (out / CHECKPOINT_FILE).unlink(missing_ok=True)
    return Trained(out / WEIGHTS_FILE, recipe.steps, threshold, means)


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
            costs[number] += _TYPICAL_MM * (missed / inside + invented / (pixels - inside))
    means = costs / len(samples)
    return THRESHOLDS[int(np.flatnonzero(means < means.min() + _TOLERANCE_MM)[0])]


def with_lead(answers: Answers, lead: float) -> Answers:
    """Answers with ``lead`` added to the logit of the base order."""
    return replace(answers, logits=answers.logits + np.array([0, lead, 0], np.float32)[:, None, None])


def chosen_lead(answers: list[Answers], samples: list[Sample], geometries: dict[Direction, Geometry]) -> float:
    """The lead out of `LEADS` with the fewest wrong orders, mean over the samples."""
    shares = [
        float(
            np.mean(
                [
                    score(with_lead(answer, lead), sample, geometries[sample.direction])["wrong_percent"]
                    for answer, sample in zip(answers, samples, strict=True)
                ]
            )
        )
        for lead in LEADS
    ]
    return LEADS[int(np.argmin(shares))]


def draw(path: Path, history: list[dict[str, Any]], title: str) -> None:
    """Losses and validation scores over the steps, as a picture."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if not history:
        return
    steps = [record["step"] for record in history]
    figure = Figure(figsize=(10, 3.2), layout="constrained", dpi=110)
    losses, score_axes, shares = figure.subplots(1, 3)
    for name in ("order", "mask", "phase"):
        losses.plot(steps, [record[f"loss_{name}"] for record in history], label=name)
    losses.set(title="training losses", xlabel="step", yscale="log")
    for name, label in (("object_mae_mm", "object"), ("right_mae_mm", "right order")):
        score_axes.plot(steps, [record[name] for record in history], label=label)
    score_axes.set(title="validation MAE, mm", xlabel="step", ylim=(0, None))
    for name, label in (("wrong_percent", "wrong order"), ("missed_percent", "missed")):
        shares.plot(steps, [record[name] for record in history], label=label)
    shares.set(title="validation, % of object pixels", xlabel="step", ylim=(0, None))
    for axes in (losses, score_axes, shares):
        axes.grid(alpha=0.3)
        axes.legend(frameon=False)
    figure.suptitle(title, fontsize=10)
    FigureCanvasAgg(figure).print_png(path)


def _claim(path: Path, content: dict[str, Any]) -> None:
    """Write the recipe into the training's folder, or check that the folder is of the same recipe and dataset."""
    if path.exists():
        try:
            existing = json.loads(path.read_text(encoding="utf-8"))
        except ValueError:
            existing = None
        if existing != content:
            raise TrainingError(f"{path}: is of another recipe or dataset; give --out a new folder")
        return
    foreign = next((file.name for file in path.parent.iterdir() if file.name in (LOG_FILE, CHECKPOINT_FILE)), None)
    if foreign is not None:
        raise TrainingError(f"{path.parent}: holds {foreign} of another training; give --out a new folder")
    write_atomically(path, (json.dumps(content, indent=2) + "\n").encode())
