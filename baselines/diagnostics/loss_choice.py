"""Two scenes, one image: which depth a training loss chooses.

The paper says (Section 4.2) that under l1 or l2 losses a network may learn an average of the depths that share an
image. A network gives one answer for it: first + c (second - first) on every pixel of the object, c from 0 to 1. Each
image of a batch is the second scene with a given chance, and the expected loss is evaluated by the training's own
functions. Where the answer is right beside the object, the other pixels only scale the loss.
"""

from collections.abc import Sequence
from math import comb

import numpy as np
import torch
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics.probe import Table
from fpp_ml_bench.baselines.training import LOSSES, loss_function
from fpp_ml_bench.constants import MM_PER_M

CHANCES = (0.25, 0.5, 0.75)  # of the second scene
BATCHES = (1, 4)  # images; 4 is the paper's
ALPHA = 0.7
STEPS, PIXELS = 100, 64
_SAME = 1e-6
"""Relative difference of two expected losses that count as equal: no training tells them apart."""
Choice = tuple[float, float]
"""Least and largest c of least expected loss: 0 is the first scene, 1 the second, between them a depth of neither."""


def choice_of(
    depths_mm: Sequence[NDArray[np.float64]], loss: str, chance: float, batch: int, alpha: float | None = None
) -> Choice:
    """What ``loss`` chooses between two depth maps (H, W), 0 outside the object, the second with ``chance``, in batches
    of so many images."""
    inside = np.flatnonzero((depths_mm[0] > 0) & (depths_mm[1] > 0))
    some = inside[np.linspace(0, inside.size - 1, min(PIXELS, inside.size)).astype(np.int64)]
    first, second = (torch.from_numpy(depth.ravel()[some] / MM_PER_M).view(1, 1, 1, -1) for depth in depths_mm)
    function = loss_function(loss, alpha)
    places = np.linspace(0, 1, STEPS + 1)
    expected = np.zeros(places.size)
    for count in range(batch + 1):
        weight = comb(batch, count) * chance**count * (1 - chance) ** (batch - count)
        target = torch.cat([second] * count + [first] * (batch - count))
        answers = ((first + c * (second - first)).expand_as(target) for c in places.tolist())
        expected += weight * np.array([float(function(answer, target)) for answer in answers])
    chosen = places[expected <= expected.min() * (1 + _SAME)]
    return float(chosen[0]), float(chosen[-1])


def choices(depths_mm: Sequence[NDArray[np.float64]]) -> list[dict[str, object]]:
    """For each loss of the paper's comparison and each of `BATCHES`, the `Choice` for each of `CHANCES`."""
    rows: list[dict[str, object]] = []
    for loss in LOSSES:
        alpha = ALPHA if loss.startswith("hybrid") else None
        for batch in BATCHES:
            chosen = {str(chance): choice_of(depths_mm, loss, chance, batch, alpha) for chance in CHANCES}
            rows.append({"loss": loss, "alpha": alpha, "batch": batch, "chosen": chosen})
    return rows


def choices_table(rows: Sequence[dict[str, object]]) -> Table:
    """A row for each loss and batch."""
    lines = []
    for row in rows:
        chosen: dict[str, Choice] = row["chosen"]  # type: ignore[assignment]
        cells = (f"{low:.2f}" if low == high else f"{low:.2f} to {high:.2f}" for low, high in chosen.values())
        alpha = "" if row["alpha"] is None else f", alpha {row['alpha']:g}"
        lines.append((f"{row['loss']}{alpha}", str(row["batch"]), *cells))
    title = "Which depth a loss chooses for one image of two scenes: 0 the first, 1 the second, between them neither"
    header = "Loss", "Images a batch", *(f"second scene in {chance:.0%}" for chance in CHANCES)
    return Table(title, header, lines)
