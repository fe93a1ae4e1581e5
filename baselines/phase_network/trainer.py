"""A training from dataset to weights file: what ``fpp-bench train phase-net`` does.

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

from fpp_ml_bench.baselines.phase_network.decide import Answers, ask, decided_mask
from fpp_ml_bench.baselines.phase_network.recipe import Recipe
from fpp_ml_bench.baselines.phase_network.samples import Geometry, Sample, samples_of
from fpp_ml_bench.baselines.phase_network.training import CHECKPOINT_FILE, score, train
from fpp_ml_bench.baselines.phase_network.unions import unions_of
from fpp_ml_bench.baselines.phase_network.weights import NetConfig, load_net, save_net
from fpp_ml_bench.baselines.phase_route.settings import Settings
from fpp_ml_bench.baselines.training.history import CURVE_FILE, LOG_FILE, write_log
from fpp_ml_bench.baselines.training_data import training_benchmark
from fpp_ml_bench.errors import TrainingError
from fpp_ml_bench.frames import Direction
from fpp_ml_bench.loaders.manifest import write_atomically
from fpp_ml_bench.loaders.store import DatasetFolder

WEIGHTS_FILE, RECIPE_FILE = "phase-net.safetensors", "recipe.json"
THRESHOLDS = tuple(float(value) for value in np.arange(-5, 3.01, 0.5))
"""Mask logits that are tried on the validation split."""
LEADS = tuple(float(value) for value in range(8))
_TYPICAL_MM, _AS_GOOD_MM = 1800.0, 0.1


Bar = Callable[[str, int, str], AbstractContextManager[Callable[[int], None]]]
"""A progress bar of a title, a total and a unit, which yields what advances it."""


def without_bar(title: str, total: int, unit: str) -> AbstractContextManager[Callable[[int], None]]:
    """No progress bar."""
    return nullcontext(lambda count: None)


@dataclass(frozen=True)
class Trained:
    """Where the weights are, scores on the whole validation split, and the mask threshold that was chosen there.
    ``weights`` is None for a training that its minutes stopped."""

    weights: Path | None
    steps: int
    threshold: float
    validation: dict[str, float]


def train_phase_net(
    recipe: Recipe, dataset: Path, out: Path, minutes: float | None = None, bar: Bar = without_bar,
    say: Callable[[str], None] = lambda line: None, extra: Path | None = None, start: Path | None = None,
) -> Trained:  # fmt: skip
    """Train on the dataset's training split, and on that of ``extra`` where it is given, from the weights in ``start``
    or from none; the same call goes on where a stopped one was.

    Raises `DatasetError` for a dataset without the frames in question, `TrainingError` for a folder of another recipe
    or dataset.
    """
    opened = DatasetFolder(dataset)
    cv2.setNumThreads(1)
    out.mkdir(parents=True, exist_ok=True)
    more = None if extra is None else DatasetFolder(extra)
    if more is not None and more.rig != opened.rig:
        raise TrainingError(f"{extra}: was made by another rig than {dataset}; build both with the same one")
    begun = None if start is None else load_net(start, folded=False)
    described = recipe.to_dict() | ({} if more is None else {"extra_fingerprint": more.fingerprint})
    described |= {} if begun is None else {"start_sha256": begun.sha256}
    _claim(out / RECIPE_FILE, {"recipe": described, "dataset_fingerprint": opened.fingerprint})
    if (out / WEIGHTS_FILE).exists():
        ready = load_net(out / WEIGHTS_FILE).config
        had = {key: float(value or 0) for key, value in ready.validation.items()}
        return Trained(out / WEIGHTS_FILE, ready.steps, ready.threshold, had)
    geometries = {one: Geometry.of(opened.rig, Settings(direction=one)) for one in recipe.directions}
    names, held = opened.samples("train"), opened.samples("validation")
    samples: list[Sample] = []
    validation: list[Sample] = []
    added = [] if more is None else more.samples("train")
    images = (1 + recipe.unions) * (len(names) + len(added)) + len(held)
    with bar("phase of the samples", images * len(geometries), "samples") as advance:
        for geometry in geometries.values():
            for folder, own in [(opened, names), *([] if more is None else [(more, added)])]:
                samples += samples_of(folder, own, geometry, advance)
                samples += unions_of(folder, own, geometry, recipe.unions, recipe.seed, advance)
            validation += samples_of(opened, held, geometry, advance)

    def report(history: list[dict[str, Any]]) -> None:
        write_log(out, history)
        say("  ".join(f"{key} {value:.4g}" for key, value in history[-1].items()))

    with bar(f"{recipe.name}, training", recipe.steps, "steps") as advance:
        done = train(
            recipe,
            samples,
            validation[::5],
            geometries,
            out,
            report,
            advance,
            minutes,
            begun.network if begun is not None else None,
        )
    write_log(out, done.history)
    draw(out / CURVE_FILE, done.history, recipe.name)
    if done.steps < recipe.steps:
        return Trained(None, done.steps, 0.0, {})
    found = [ask(done.network, one.scene.single(), geometries[one.direction]) for one in validation]
    threshold = chosen_threshold(found, validation, opened.size[0] * opened.size[1])
    lead = chosen_lead(found, validation, geometries)
    found = [led(answers, lead) for answers in found]
    rows = [score(a, s, geometries[s.direction], threshold) for a, s in zip(found, validation, strict=True)]
    means = {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}
    name = recipe.name if more is None else f"{recipe.name}-fresh"
    config = NetConfig(
        name=name, title="Fringe order, mask and bounded phase correction", options=done.network.options,
        threshold=threshold, lead=lead, period_px={one: g.route.period_px for one, g in geometries.items()},
        dataset_fingerprint=opened.fingerprint, benchmark=training_benchmark(opened.fingerprint), steps=recipe.steps,
        recipe=described, validation=dict(means),
    )  # fmt: skip
    save_net(out / WEIGHTS_FILE, done.network, config)
    (out / CHECKPOINT_FILE).unlink(missing_ok=True)
    return Trained(out / WEIGHTS_FILE, recipe.steps, threshold, means)


def chosen_threshold(answers: list[Answers], samples: list[Sample], pixels: int) -> float:
    """Of `THRESHOLDS` one with the least sum of object and background error: an object pixel that is missed and a
    background pixel that is invented are off by the same distance, and weigh by the size of their set. Of those within
    0.1 mm of the least, the one that misses least."""
    totals = np.zeros(len(THRESHOLDS))
    for answer, sample in zip(answers, samples, strict=True):
        scene = sample.scene.single()
        inside = max(int(sample.target.sum()), 1)
        for number, threshold in enumerate(THRESHOLDS):
            found = decided_mask(answer, scene, threshold)
            missed, invented = (sample.target & ~found).sum(), (found & ~sample.target).sum()
            totals[number] += _TYPICAL_MM * (missed / inside + invented / (pixels - inside))
    means = totals / len(samples)
    return THRESHOLDS[int(np.flatnonzero(means < means.min() + _AS_GOOD_MM)[0])]


def led(answers: Answers, lead: float) -> Answers:
    """With ``lead`` added to the logit of the first order."""
    return replace(answers, logits=answers.logits + np.array([0, lead, 0], np.float32)[:, None, None])


def chosen_lead(answers: list[Answers], samples: list[Sample], geometries: dict[Direction, Geometry]) -> float:
    """Of `LEADS` the one with the fewest wrong orders, mean over the samples."""
    shares = [
        float(
            np.mean(
                [
                    score(led(answer, lead), sample, geometries[sample.direction])["wrong_percent"]
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


def _claim(path: Path, wanted: dict[str, Any]) -> None:
    """Make ``out`` this training's folder, or find that it is."""
    if path.exists():
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
        except ValueError:
            found = None
        if found != wanted:
            raise TrainingError(f"{path}: is of another recipe or dataset; give --out a new folder")
        return
    foreign = next((one.name for one in path.parent.iterdir() if one.name in (LOG_FILE, CHECKPOINT_FILE)), None)
    if foreign is not None:
        raise TrainingError(f"{path.parent}: holds {foreign} of another training; give --out a new folder")
    write_atomically(path, (json.dumps(wanted, indent=2) + "\n").encode())
