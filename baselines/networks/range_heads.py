"""Fitting the range heads (`RangeHeads`) to a frozen network: closed forms, a few seconds."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from fpp_ml_bench.baselines.networks.base import FringeNetwork
from fpp_ml_bench.baselines.networks.model import TWINS, Probe, RangeHeads, load, probed, represent
from fpp_ml_bench.baselines.training.weights import ModelConfig, save_weights
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import WeightsError
from fpp_ml_bench.loaders.training import FringeDepthDataset

TRAIN_PAIRS, VALIDATION_PAIRS = 240, 120
"""Pairs at most, evenly over the split: all of a single-shot set, a part of one with many frames a sample."""
PIXELS = 128
"""Pixels a training pair of the object, and as many of the background, that the mask is fitted to."""
MARGIN = 0.25
"""Depth is clipped to the training set's range, widened by this share of its width on either side."""
RIDGE_STRENGTHS = tuple(10.0 ** (power / 2) for power in range(-8, 9))
"""Candidates, per training pair, on features of unit spread."""
MASK_DECAY = 1e-6
LOGIT_LIMIT, LOGIT_STEP = 20.0, 0.05
LOGIT_BINS = round(2 * LOGIT_LIMIT / LOGIT_STEP)
Values = NDArray[np.float64]
_SEED = 42
_PIXELS_AT_ONCE = 4 * 224 * 224


def fit_heads(
    network: FringeNetwork,
    config: ModelConfig,
    dataset_folder: str | Path,
) -> dict[str, Tensor]:
    """Tensors of the `RangeHeads` of ``network``, which is not changed; ``save_weights(..., heads=...)`` stores them.

    Mean range, ridge regression and mask come from the training split; the ridge's strength and the masks' thresholds
    (one for each twin, of least overall MAE in mm) from the validation split. Deterministic. Raises `WeightsError` for
    a network of another normalisation, a dataset of another size or fingerprint than ``config`` says, or without an
    object in either split; `PredictionError` where the network's output is not finite."""
    if config.normalisation != "individual":
        raise WeightsError(f"{config.name}: its output is metric ({config.normalisation}); it needs no range heads")
    was_training = network.training
    network.eval()
    try:
        with torch.no_grad(), probed(network) as probe:
            run = partial(_run, network, probe, config.name)
            train = _chosen_pairs(config, dataset_folder, "train", TRAIN_PAIRS)
            validation = _chosen_pairs(config, dataset_folder, "validation", VALIDATION_PAIRS)
            return vars(_fit(probe, config.image_size, partial(run, *train), partial(run, *validation)))
    finally:
        network.train(was_training)


def save_with_heads(weights: str | Path, dataset_folder: str | Path, target: str | Path) -> None:
    """Write the network of the file ``weights``, with heads fitted on its training data, as the file ``target``. Raises
    as `fit_heads`, and `WeightsError` for a file that is no weights or can't be written."""
    model = load(weights)
    save_weights(target, model.network, model.config, fit_heads(model.network, model.config, dataset_folder))


def _chosen_pairs(
    config: ModelConfig, folder: str | Path, split: str, cap: int
) -> tuple[FringeDepthDataset, list[int]]:
    """A split, and ``cap`` of its pairs at most, evenly over those with an object: others have no depth range."""
    data = FringeDepthDataset(
        folder, split, config.data_config, "individual", config.background_removed, config.range_rule
    )
    source = data.source
    if source.size != config.image_size or source.fingerprint != config.dataset_fingerprint:
        raise WeightsError(
            f"{config.name}: was trained on dataset {config.dataset_fingerprint[:12]} of {config.image_size} px, "
            f"{folder} is {source.fingerprint[:12]} of {source.size} px; fit them on its training data"
        )
    highest_mm = [source.measured(sample)["depth_max_mm"] for sample in data.samples]
    usable = [index for index in range(len(data)) if highest_mm[data.pair(index)[0]] > 0]
    if not usable:
        raise WeightsError(f"{folder}: split {split} holds no object, so there is no range to learn")
    places = np.linspace(0, len(usable) - 1, min(cap, len(usable))).round().astype(int)
    return data, [usable[place] for place in places]


def _run(
    network: FringeNetwork,
    probe: Probe,
    name: str,
    data: FringeDepthDataset,
    order: list[int],
) -> Iterator[tuple[Tensor, NDArray[np.float32], Values]]:
    """Network output (B, 1, H, W), depth in mm (B, H, W), and D_min and span (B, 2), batch by batch."""
    device, (height, width) = next(network.parameters()).device, data.source.size
    for batch in data.batches(max(1, min(4, _PIXELS_AT_ONCE // (height * width))), order):
        values = represent(network, batch.fringe.to(device), name)
        depth = [data.source.depth_mm(data.samples[int(row)]) for row in batch.row]
        edges = batch.depth_range_mm.double().numpy()
        yield values, np.stack(depth), np.stack([edges[:, 0], edges[:, 1] - edges[:, 0]], axis=1)


Run = Callable[[], Iterator[tuple[Tensor, NDArray[np.float32], Values]]]


def _fit(probe: Probe, size: tuple[int, int], train: Run, validation: Run) -> RangeHeads:
    pooled, ranges, features, costs, labels = [], [], [], [], []
    rng = np.random.default_rng(_SEED)
    for _, depth_mm, range_mm in train():
        pooled.append(probe.pooled().numpy())
        ranges.append(range_mm)
        layer = probe.pixels(size).flatten(2)
        for number, depth in enumerate(depth_mm):
            for label in (True, False):
                label_pixels = np.flatnonzero(object_mask(depth) == label)
                if not label_pixels.size:
                    continue
                sampled = np.sort(rng.choice(label_pixels, min(PIXELS, label_pixels.size), replace=False))
                features.append(layer[number][:, torch.from_numpy(sampled)].T.double().cpu())
                labels.append(np.full(sampled.size, label))
                # A wrong label costs about the whole depth: the true depth of a missed object pixel, or the depth that
                # a background pixel would get.
                cost = depth.ravel()[sampled] if label else np.full(sampled.size, range_mm[number].sum())
                costs.append(cost * (label_pixels.size / sampled.size))
    train_ranges = np.concatenate(ranges)
    lows, highs = train_ranges[:, 0], train_ranges.sum(axis=1)
    margin = MARGIN * (highs.max() - lows.min())
    mask_weight, mask_bias = _logistic(
        torch.cat(features), torch.from_numpy(np.concatenate(labels)), torch.from_numpy(np.concatenate(costs)).double()
    )
    validation_features = [(probe.pooled().numpy(), range_mm) for _, _, range_mm in validation()]
    validation_pooled, validation_ranges = (np.concatenate(part) for part in zip(*validation_features, strict=True))
    weight, bias = _ridge(np.concatenate(pooled), train_ranges, validation_pooled, validation_ranges)
    mean = np.array([lows.mean(), highs.mean()])
    heads = RangeHeads(
        mean_range_mm=torch.from_numpy(mean),
        range_weight=torch.from_numpy(weight),
        range_bias=torch.from_numpy(bias),
        mask_weight=mask_weight,
        mask_bias=mask_bias,
        mask_threshold=torch.zeros(2, dtype=torch.float64),
        limits_mm=torch.tensor([lows.min() - margin, highs.max() + margin], dtype=torch.float64),
    )
    gains = {twin: np.zeros(LOGIT_BINS) for twin in TWINS}
    for values, depth_mm, _ in validation():
        logits = heads.logits(probe, size).cpu().numpy()[:, 0]
        for twin, gain in gains.items():
            depth = heads.unmasked_mm(values, heads.depth_range_mm(probe, twin))
            gain += _gains(logits, depth.cpu().numpy()[:, 0], depth_mm)
    heads.mask_threshold.copy_(torch.tensor([_best_threshold(gains[twin]) for twin in TWINS], dtype=torch.float64))
    return heads


def _range_error_mm(predicted: NDArray[np.float64], ranges: NDArray[np.float64]) -> float:
    """Mean of (|error of D_min| + |error of D_max|) / 2, from D_min and span."""
    error = predicted - ranges
    return float(np.mean(np.abs(error[:, 0]) + np.abs(error.sum(axis=1))) / 2)


def _ridge(
    pooled: Values, ranges: Values, validation_pooled: Values, validation_ranges: Values
) -> tuple[Values, Values]:
    """Weight (F, 2) and bias (2,) of the strength of least `_range_error_mm` on validation's (N, F) and (N, 2)."""
    centre, spread = pooled.mean(axis=0), pooled.std(axis=0)
    scale = np.where(spread > 0, spread, 1.0)
    target = ranges.mean(axis=0)
    u, s, vt = np.linalg.svd((pooled - centre) / scale, full_matrices=False)
    aligned = u.T @ (ranges - target)
    candidates = []
    for strength in RIDGE_STRENGTHS:
        shrunk = s / (s * s + strength * len(pooled))
        weight = (vt.T @ (shrunk[:, None] * aligned)) / scale[:, None]
        bias = target - centre @ weight
        predicted = validation_pooled @ weight + bias
        predicted[:, 1] = np.maximum(predicted[:, 1], 0.0)
        candidates.append((_range_error_mm(predicted, validation_ranges), weight, bias))
    _, weight, bias = min(candidates, key=lambda candidate: candidate[0])
    return weight, bias


def _logistic(features: Tensor, labels: Tensor, costs: Tensor) -> tuple[Tensor, Tensor]:
    """Weight (C,) and bias () of the logistic regression of ``labels`` (N,) bool on ``features`` (N, C), float64, each
    pixel's loss times what it costs to get it wrong."""
    centre, spread = features.mean(0), features.std(0, correction=0)
    scale = torch.where(spread > 0, spread, torch.ones_like(spread))
    scaled = (features - centre) / scale
    share = costs / costs.sum()
    sign = labels.double() * 2 - 1
    parameters = torch.zeros(scaled.shape[1] + 1, dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.LBFGS(
        [parameters], max_iter=200, tolerance_grad=1e-9, tolerance_change=1e-12, line_search_fn="strong_wolfe"
    )

    def loss() -> Tensor:
        optimiser.zero_grad()
        with torch.enable_grad():
            logit = scaled @ parameters[:-1] + parameters[-1]
            value = (share * functional.softplus(-sign * logit)).sum() + MASK_DECAY * parameters[:-1].square().sum()
            value.backward()
        return value

    optimiser.step(loss)  # type: ignore[no-untyped-call]
    weight = parameters.detach()[:-1] / scale
    return weight, parameters.detach()[-1] - centre @ weight


def _gains(logits: NDArray, depth_mm: NDArray, target_mm: NDArray) -> Values:
    """Change of the absolute error by pixels (B, H, W) that count as object, summed in bins of `LOGIT_STEP` of their
    logit; ``depth_mm``: what they get as object, ``target_mm``: true depth."""
    bins = np.floor((logits.astype(np.float64) + LOGIT_LIMIT) / LOGIT_STEP).clip(0, LOGIT_BINS - 1).astype(int)
    true = target_mm.astype(np.float64)
    gain = np.abs(depth_mm.astype(np.float64) - true) - true
    return np.bincount(bins.ravel(), gain.ravel(), LOGIT_BINS).astype(np.float64)


def _best_threshold(gain: Values) -> float:
    """Least logit of an object pixel with the least error. Between thresholds that do equally well, the middle one."""
    above = np.append(np.cumsum(gain[::-1])[::-1], 0.0)
    equal = np.flatnonzero(above == above.min())
    run = equal[: np.flatnonzero(np.diff(equal, append=-1) != 1)[0] + 1]
    return int(run[len(run) // 2]) * LOGIT_STEP - LOGIT_LIMIT
