"""Fitting the range heads (`RangeHeads`) to a frozen network: closed forms, a few seconds."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from fpp_ml_bench.baselines.networks.base import FringeNetwork
from fpp_ml_bench.baselines.networks.model import TWINS, HeadReport, Probe, RangeHeads, load, probed, represent
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
Values = NDArray[np.float64]
_SEED = 42
_PIXELS_AT_ONCE = 4 * 224 * 224


def fit_heads(
    network: FringeNetwork,
    config: ModelConfig,
    dataset_folder: str | Path,
    progress: Callable[[int], None] = lambda pairs: None,
) -> dict[str, Tensor]:
    """Tensors of the `RangeHeads` of ``network``, which is not changed; ``save_weights(..., heads=...)`` stores them.

    Mean range, ridge regression and mask come from the training split; the ridge's strength and the masks' thresholds
    (one for each twin, of least overall MAE in mm) from the validation split. Deterministic. ``progress`` is given the
    number of pairs done. Raises `WeightsError` for a network of another normalisation, a dataset of another size or
    fingerprint than ``config`` says, or without an object in either split; `PredictionError` where the network's output
    is not finite."""
    if config.normalisation != "individual":
        raise WeightsError(f"{config.name}: its output is metric ({config.normalisation}); it needs no range heads")
    was_training = network.training
    network.eval()
    try:
        with torch.no_grad(), probed(network) as probe:
            runs = {
                split: _Pairs(network, probe, config, dataset_folder, split, cap, progress)
                for split, cap in (("train", TRAIN_PAIRS), ("validation", VALIDATION_PAIRS))
            }
            return vars(_fit(runs["train"], runs["validation"]))
    finally:
        network.train(was_training)


def save_with_heads(weights: str | Path, dataset_folder: str | Path, target: str | Path) -> None:
    """Write the network of the file ``weights``, with heads fitted on its training data, as the file ``target``. Raises
    as `fit_heads`, and `WeightsError` for a file that is no weights or can't be written."""
    model = load(weights)
    save_weights(target, model.network, model.config, fit_heads(model.network, model.config, dataset_folder))


class _Pairs:
    """The chosen pairs of one split; each `run` sends them through the network batch by batch."""

    def __init__(
        self,
        network: FringeNetwork,
        probe: Probe,
        config: ModelConfig,
        folder: str | Path,
        split: str,
        cap: int,
        progress: Callable[[int], None],
    ) -> None:
        self.data = FringeDepthDataset(
            folder, split, config.data_config, "individual", config.background_removed, config.range_rule
        )
        source = self.data.source
        if source.size != config.image_size or source.fingerprint != config.dataset_fingerprint:
            raise WeightsError(
                f"{config.name}: was trained on dataset {config.dataset_fingerprint[:12]} of {config.image_size} px, "
                f"{folder} is {source.fingerprint[:12]} of {source.size} px; fit them on its training data"
            )
        # A sample without an object has no depth range.
        usable = [
            index
            for index in range(len(self.data))
            if source.measured(self.data.samples[self.data.pair(index)[0]])["depth_max_mm"] > 0
        ]
        if not usable:
            raise WeightsError(f"{folder}: split {split} holds no object, so there is no range to learn")
        places = np.linspace(0, len(usable) - 1, min(cap, len(usable))).round().astype(int)
        self.order = [usable[place] for place in places]
        self.network, self.probe, self.name, self.progress = network, probe, config.name, progress
        self.device, self.size = next(network.parameters()).device, source.size
        self.batch = max(1, min(4, _PIXELS_AT_ONCE // (self.size[0] * self.size[1])))

    def run(self) -> Iterator[tuple[Tensor, NDArray[np.float32], Values]]:
        """Network output (B, 1, H, W), depth in mm (B, H, W), and D_min and span (B, 2)."""
        for batch in self.data.batches(self.batch, self.order):
            values = represent(self.network, batch.fringe.to(self.device), self.name)
            depth = [self.data.source.depth_mm(self.data.samples[int(row)]) for row in batch.row]
            edges = batch.depth_range_mm.double().numpy()
            span = np.stack([edges[:, 0], edges[:, 1] - edges[:, 0]], axis=1)
            yield values, np.stack(depth), span
            self.progress(len(depth))


def _fit(train: _Pairs, validation: _Pairs) -> RangeHeads:
    pooled, ranges, features, costs, labels = [], [], [], [], []
    rng = np.random.default_rng(_SEED)
    for _, depth_mm, range_mm in train.run():
        pooled.append(train.probe.pooled().numpy())
        ranges.append(range_mm)
        layer = train.probe.pixels(train.size).flatten(2)
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
    validation_features = [(validation.probe.pooled().numpy(), range_mm) for _, _, range_mm in validation.run()]
    validation_pooled, validation_ranges = (np.concatenate(part) for part in zip(*validation_features, strict=True))
    fitted = _ridge(np.concatenate(pooled), train_ranges, validation_pooled, validation_ranges)
    strength, weight, bias, error_mm = fitted
    mean = np.array([lows.mean(), highs.mean()])
    heads = RangeHeads(
        mean_range_mm=torch.from_numpy(mean),
        range_weight=torch.from_numpy(weight),
        range_bias=torch.from_numpy(bias),
        mask_weight=mask_weight,
        mask_bias=mask_bias,
        mask_threshold=torch.zeros(2, dtype=torch.float64),
        limits_mm=torch.tensor([lows.min() - margin, highs.max() + margin], dtype=torch.float64),
        report=torch.zeros(6, dtype=torch.float64),
    )
    tallies = {twin: _Tally() for twin in TWINS}
    for values, depth_mm, _ in validation.run():
        logits = heads.logits(validation.probe, validation.size).cpu().numpy()[:, 0]
        for twin, tally in tallies.items():
            depth = heads.unmasked_mm(values, heads.depth_range_mm(validation.probe, twin))
            tally.add(logits, depth.cpu().numpy()[:, 0], depth_mm)
    best = {twin: tally.best() for twin, tally in tallies.items()}
    heads.mask_threshold.copy_(torch.tensor([best[twin][0] for twin in TWINS], dtype=torch.float64))
    mean_error_mm = _range_error_mm(np.array([[mean[0], mean[1] - mean[0]]]), validation_ranges)
    (_, mean_mae_mm, _), (_, mae_mm, iou) = best["mean"], best["predicted"]
    report = HeadReport(mean_error_mm, error_mm, iou, mean_mae_mm, mae_mm, strength)
    heads.report.copy_(torch.tensor(report, dtype=torch.float64))
    return heads


def _range_error_mm(predicted: NDArray[np.float64], ranges: NDArray[np.float64]) -> float:
    """Mean of (|error of D_min| + |error of D_max|) / 2, from D_min and span."""
    error = predicted - ranges
    return float(np.mean(np.abs(error[:, 0]) + np.abs(error.sum(axis=1))) / 2)


def _ridge(
    pooled: Values, ranges: Values, validation_pooled: Values, validation_ranges: Values
) -> tuple[float, Values, Values, float]:
    """Strength of least `_range_error_mm` on validation's (N, F) and (N, 2), weight (F, 2), bias (2,), the error."""
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
        candidates.append((_range_error_mm(predicted, validation_ranges), strength, weight, bias))
    error_mm, strength, weight, bias = min(candidates, key=lambda candidate: candidate[0])
    return strength, weight, bias, error_mm


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


class _Tally:
    """Change of the absolute error by every threshold on the logit, summed in bins of `LOGIT_STEP`."""

    def __init__(self) -> None:
        self.bins = round(2 * LOGIT_LIMIT / LOGIT_STEP)
        self.gain, self.inside, self.outside = (np.zeros(self.bins) for _ in range(3))
        self.without = 0.0

    def add(self, logits: NDArray, depth_mm: NDArray, target_mm: NDArray) -> None:
        """Pixels (B, H, W): logit, depth that they get as object, true depth."""
        bins = np.floor((logits.astype(np.float64) + LOGIT_LIMIT) / LOGIT_STEP).clip(0, self.bins - 1).astype(int)
        bins, true = bins.ravel(), target_mm.astype(np.float64).ravel()
        object_pixels = object_mask(target_mm).ravel()
        gain = np.abs(depth_mm.astype(np.float64).ravel() - true) - true
        self.gain += np.bincount(bins, gain, self.bins)
        self.inside += np.bincount(bins[object_pixels], minlength=self.bins)
        self.outside += np.bincount(bins[~object_pixels], minlength=self.bins)
        self.without += float(true.sum())

    def best(self) -> tuple[float, float, float]:
        """Least logit of an object pixel, the overall MAE in mm that this gives, and the mask's intersection over
        union. Between thresholds that do equally well, the middle one."""
        above = np.append(np.cumsum(self.gain[::-1])[::-1], 0.0)
        equal = np.flatnonzero(above == above.min())
        run = equal[: np.flatnonzero(np.diff(equal, append=-1) != 1)[0] + 1]
        best_bin = int(run[len(run) // 2])
        inside, hit, false = self.inside.sum(), self.inside[best_bin:].sum(), self.outside[best_bin:].sum()
        mae_mm = float((self.without + above[best_bin]) / (inside + self.outside.sum()))
        return best_bin * LOGIT_STEP - LOGIT_LIMIT, mae_mm, float(hit / (inside + false))
