"""How well a phase network does on whole validation images, in mm, and the two numbers that are chosen by it."""

from dataclasses import replace

import numpy as np

from fpp_ml_bench.baselines.phase_network.inputs import Geometry
from fpp_ml_bench.baselines.phase_network.network import PhaseNet
from fpp_ml_bench.baselines.phase_network.route import Answers, decided_mask, decided_order, network_answers
from fpp_ml_bench.baselines.phase_network.samples import Sample
from fpp_ml_bench.baselines.phase_route import TAU
from fpp_ml_bench.optics import Direction

THRESHOLDS = tuple(float(value) for value in np.arange(-5, 3.01, 0.5))
"""Mask logits that are tried on the validation split."""
LEADS = tuple(float(value) for value in range(8))
"""Leads of the base order (see `route.network_answers`) that are tried on the validation split."""
_TYPICAL_MM, _TOLERANCE_MM = 1800.0, 0.1
"""Depth error that a missed or invented pixel counts with; errors this close to the least count as equal."""


def scores(network: PhaseNet, samples: list[Sample], geometries: dict[Direction, Geometry]) -> dict[str, float]:
    """Means of `score` over the samples."""
    rows = []
    for sample in samples:
        geometry, scene = geometries[sample.direction], sample.scene.single()
        rows.append(score(network_answers(network, scene, geometry), sample, geometry))
    return {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}


def score(answers: Answers, sample: Sample, geometry: Geometry, threshold: float = 0.0) -> dict[str, float]:
    """Scores of one whole image with ``threshold`` on the mask's logit.

    ``object_mae_mm`` counts a missed pixel with its whole depth; ``right_mae_mm`` is the MAE of the pixels with the
    right order; ``wrong_percent`` and ``missed_percent`` are shares of the object's pixels; ``invented_kpx``:
    background pixels with a depth, in thousands."""
    scene = sample.scene.single()
    layer = geometry.layer.at(scene.crop)
    order, inside = decided_order(answers, scene), decided_mask(answers, scene, threshold)
    base_residual = layer.residual_phase(scene.phase_rad, scene.order)
    true_mm = layer.depth_of_residual_mm(base_residual + sample.missing_rad)
    phase_change = TAU * (order - scene.order) + answers.correction_rad
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
