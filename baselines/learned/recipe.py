"""Training fringe-net for any rig: one network that gives, from one frame of one carrier or two, the
numerator and denominator of each carrier's wrapped phase, their scale, and whether a pixel is
object.

Its windows are cut from images of drawn rigs (`images`) and warped to the carriers of
`warp.known`, with periods, angles and skews drawn around them. The truth is that of the exact depth;
its brightness is that of the phase steps of the same view in the same light.
"""

import hashlib
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from fpp_ml_bench.baselines.learned.fringe_net import FringeScene, channels
from fpp_ml_bench.baselines.learned.images import (
    NEITHER,
    OBJECT,
    FringeImage,
    read_images,
    render_settings,
    settings_of,
)
from fpp_ml_bench.baselines.learned.network import SCALE_TO_SIGMA, FringeNet
from fpp_ml_bench.baselines.learned.scenes import HELD_OUT
from fpp_ml_bench.baselines.learned.warp import (
    PERIOD_RATIO,
    PLACES,
    Warp,
    smoothed,
    to_known,
)
from fpp_ml_bench.baselines.phase.geometry import Image, wrapped
from fpp_ml_bench.constants import TAU
from fpp_ml_bench.errors import RecipeError
from fpp_ml_bench.evaluation.protocol import EDGE_BAND_PX

Window = dict[str, NDArray]
"""One training example, maps (..., n, n) by name: ``x``, the network's input float32 (C, n, n);
``truth`` float32 (6, n, n), M and D of three carriers, and where they count, ``fitted`` bool (3, n,
n); ``target``: object, and ``mask_valid``: where the mask's loss counts, bool (n, n)."""
Batch = dict[str, Tensor]
"""The fields of a window with a leading axis B."""
MOST = {"views_a_rig": 40, "unions": 100}
"""Largest values that a recipe may have."""
TURN_RAD, SKEW = 0.1, 0.08
"""Largest rotation of a training window, and standard deviation of its skew and stretch: over an
image of a rig whose axes meet at 20 degrees the carriers change as much."""
SMALL = 0.05
"""Error of M and D below which its loss is quadratic, in the amplitude of the surroundings."""
CLAMP = 4.0
"""Largest M and D that are learned, in that amplitude."""


@dataclass(frozen=True)
class FringeRecipe:
    """``steps`` of ``batch`` windows of ``window`` px; AdamW at ``rate``, after ``warm_up`` steps
    falling as a cosine; ``averaged``: decay of the moving average of the weights, which is what the
    weights file holds. ``rigs``: that are drawn, with ``views_a_rig`` views of training objects
    before each and as many times ``unions``; ``validation_rigs``; ``widths`` and ``fine``: of the
    network; ``near_edge``: share of windows beside depth edges; ``crossed``: of windows with two
    carriers; ``no_plane``: of windows that the empty scene tells nothing of; ``weight_*``: of the
    losses. Raises `RecipeError` for values that train nothing."""

    steps: int = 24000
    batch: int = 6
    window: int = 160
    rate: float = 2e-3
    warm_up: int = 100
    decay: float = 1e-4
    averaged: float = 0.999
    seed: int = 42
    validate_every: int = 1500
    rigs: int = 120
    views_a_rig: int = 6
    unions: int = 1
    validation_rigs: int = 6
    widths: tuple[int, ...] = (32, 48, 64, 96)
    fine: int = 16
    near_edge: float = 0.5
    crossed: float = 0.6
    no_plane: float = 0.15
    weight_phase: float = 10.0
    weight_scale: float = 0.1
    weight_mask: float = 2.0

    def __post_init__(self) -> None:
        ones = "steps", "batch", "window", "validate_every", "views_a_rig", "rigs"
        for name in (*ones, "unions", "validation_rigs"):
            least, most, value = int(name in ones), MOST.get(name, math.inf), getattr(self, name)
            if not least <= value <= most:
                raise RecipeError(f"{name} {value!r}: expected {least} to {most}")
        if not self.rate > 0 or not 0 <= self.averaged < 1:
            raise RecipeError(
                f"expected rate above 0 and averaged 0 to below 1, got {self.rate} and "
                f"{self.averaged}"
            )

    @property
    def name(self) -> str:
        """Of the weights."""
        return f"fringe-net-{self.seed}"

    @property
    def title(self) -> str:
        return f"Wrapped phases and mask of one carrier or two, on any rig, seed {self.seed}"

    @property
    def weights(self) -> dict[str, float]:
        """Of the losses, by name."""
        return {"phase": self.weight_phase, "scale": self.weight_scale, "mask": self.weight_mask}

    def rate_at(self, step: int) -> float:
        """Learning rate of step 0, 1, ..."""
        if step < self.warm_up:
            return self.rate * (step + 1) / self.warm_up
        progress = (step - self.warm_up) / max(1, self.steps - self.warm_up)
        return self.rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(progress, 1.0))))

    def to_dict(self) -> dict[str, Any]:
        """All settings, and what the drawn lights leave alone."""
        return json.loads(json.dumps(asdict(self) | {"held_out": HELD_OUT}))  # type: ignore[no-any-return]

    @property
    def digest(self) -> str:
        return hashlib.sha256(json.dumps(self.to_dict(), sort_keys=True).encode()).hexdigest()

    def network(self) -> FringeNet:
        """The network, untrained."""
        return FringeNet(self.widths, self.fine)

    def images(
        self, folder: Path, workers: int, show: bool
    ) -> tuple[list[FringeImage], list[FringeImage]]:
        """Training and validation images, photographed where ``folder`` does not hold them yet."""
        settings = settings_of(self.rigs, self.views_a_rig, self.validation_rigs, self.seed)
        render_settings(settings, folder, self.unions, workers, show)
        training, validation = (
            list(read_images(settings, folder, split)) for split in ("train", "validation")
        )
        return training, validation

    def batch_at(self, images: Sequence[FringeImage], step: int) -> Batch:
        """The batch of a step: a function of seed and step alone."""
        random = np.random.default_rng([self.seed, step])
        windows = [self.draw(images, random) for _ in range(self.batch)]
        batch = {
            name: torch.from_numpy(np.stack([window[name] for window in windows]))
            for name in windows[0]
        }
        batch["x"] = batch["x"].contiguous(memory_format=torch.channels_last)
        return batch

    def draw(self, images: Sequence[FringeImage], random: np.random.Generator) -> Window:
        """A random window of one of ``images``, varied."""
        crossed = random.random() < self.crossed
        while True:
            image = images[int(random.integers(len(images)))]
            if (image.fringes == "crossed") == crossed:
                break
        matrix, signs = to_known(image.step_rad, image.signs)
        least, most = np.log(PERIOD_RATIO)
        matrix = _jitter(random, float(np.exp(random.uniform(least, most)))) @ matrix
        if not crossed and random.random() < 0.5:  # along its fringes one carrier has no direction
            matrix = np.diag([-1.0, 1.0]) @ matrix
        size = self.window
        if len(image.edges) and random.random() < self.near_edge:
            row, column = image.edges[int(random.integers(len(image.edges)))]
        else:
            row, column = (int(random.integers(length)) for length in image.grey.shape)
        place = np.array([column, row], np.float64)
        place += np.linalg.inv(matrix) @ random.uniform(-size / 3, size / 3, 2)
        # What lies beyond the image teaches nothing.
        half = size / 2 * np.abs(np.linalg.inv(matrix)).sum(axis=1)
        ends = np.array(image.grey.shape[::-1], np.float64)
        place = np.clip(place, np.minimum(half, ends / 2), np.maximum(ends - half, ends / 2))
        move = size / 2 - matrix @ place
        window = _warped(image, matrix, signs, move, (size, size))
        if random.random() < self.no_plane:
            window["x"][2:] = 0
        return window


def losses(network: FringeNet, batch: Batch) -> dict[str, Tensor]:
    """``phase``: smooth L1 of M and D in the amplitude of the surroundings; ``scale``: negative
    log-likelihood of the phase error in rad under a Laplace distribution; ``mask``: binary
    cross-entropy of the object's logit."""
    answer, truth, fitted = network(batch["x"]), batch["truth"], batch["fitted"]
    count = truth.shape[1] // 2
    vectors, scale = answer[:, : 2 * count], answer[:, 2 * count : 3 * count]
    by_pixel = functional.smooth_l1_loss(vectors, truth, beta=SMALL, reduction="none")
    phase, true = (
        torch.atan2(maps[:, :count], maps[:, count:]) for maps in (vectors.detach(), truth)
    )
    error = torch.atan2(torch.sin(phase - true), torch.cos(phase - true)).abs()
    by_mask = functional.binary_cross_entropy_with_logits(
        answer[:, -1], batch["target"].float(), reduction="none"
    )
    return {
        "phase": _mean(by_pixel, torch.cat([fitted, fitted], dim=1)),
        "scale": _mean(error * torch.exp(-scale) + scale, fitted),
        "mask": _mean(by_mask, batch["mask_valid"]),
    }


def _mean(values: Tensor, where: Tensor) -> Tensor:
    """Mean of ``values`` over the pixels ``where``; 0 without one."""
    return (values * where).sum() / where.sum().clamp(min=1)


def score(network: FringeNet, image: FringeImage) -> dict[str, float | None]:
    """Mean phase error in rad of an image's object beyond `EDGE_BAND_PX` from its silhouette,
    and nearer; whether it is within the stated standard uncertainty; object pixels missed and
    background pixels invented, in percent of the object's."""
    warp = Warp.of(image.step_rad, image.signs)
    (across, down), move = warp.frame(image.grey.shape)
    window = _warped(image, warp.matrix, warp.signs, move, (down, across))
    answer = network.outputs(window["x"])
    places = list(PLACES[len(warp.signs)])
    phase = np.arctan2(answer[:3], answer[3:6])[places]
    truth = np.arctan2(window["truth"][:3], window["truth"][3:])[places]
    target = window["fitted"][places[0]]
    error = np.abs(wrapped(phase - truth)).mean(axis=0)
    sigma = (SCALE_TO_SIGMA * np.exp(answer[6:9]))[places].mean(axis=0)
    inner = cv2.erode(target.astype(np.uint8), np.ones((2 * EDGE_BAND_PX + 1,) * 2, np.uint8)) > 0
    object_px = int(target.sum())
    found, valid = answer[9] > 0, window["mask_valid"]

    def mean(where: NDArray) -> float | None:
        return float(error[where].mean(dtype=np.float64)) if where.any() else None

    kind = "crossed" if len(warp.signs) == 2 else "line"
    return {
        f"{kind}_interior_rad": mean(inner),
        f"{kind}_edge_rad": mean(target & ~inner),
        "within_percent": 100 * float((error < sigma)[target].mean()) if object_px else None,
        "missed_percent": 100 * float((~found)[target].mean()) if object_px else None,
        "invented_percent": 100
        * float((found & valid & ~window["target"]).sum())
        / max(object_px, found.size // 10),
    }


def scores(network: FringeNet, images: Iterable[FringeImage]) -> dict[str, float]:
    """Mean of each `score` over the images that have it; a score that none has is left out."""
    known: dict[str, list[float]] = {}
    for image in images:
        for key, value in score(network, image).items():
            if value is not None:
                known.setdefault(key, []).append(value)
    return {key: float(np.mean(values)) for key, values in known.items()}


def _jitter(random: np.random.Generator, scale: float) -> NDArray[np.float64]:
    """A rotation, a skew and a stretch, all small, and a change of size."""
    turn = random.uniform(-TURN_RAD, TURN_RAD)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    stretch = np.eye(2) + np.clip(random.normal(0, SKEW, (2, 2)), -2 * SKEW, 2 * SKEW)
    return np.asarray(scale * rotation @ stretch)


def _warped(
    image: FringeImage,
    matrix: NDArray[np.float64],
    signs: NDArray[np.float64],
    move: NDArray[np.float64],
    shape: tuple[int, int],
) -> Window:
    """The window of ``shape`` (h, w) at whose pixel ``matrix p + move`` the image's pixel p is;
    what lies outside the image counts nowhere."""
    # The part of the image that the window shows, and a rim for interpolation.
    height, width = shape
    back = np.linalg.inv(matrix)
    corners = back @ (
        np.array([[0, width - 1, 0, width - 1], [0, 0, height - 1, height - 1]]) - move[:, None]
    )
    rim = 4 + int(np.ceil(2 * np.abs(back).max()))
    (left, top), (right, bottom) = corners.min(axis=1), corners.max(axis=1)
    rows = slice(max(int(top) - rim, 0), max(int(bottom) + rim + 1, 1))
    columns = slice(max(int(left) - rim, 0), max(int(right) + rim + 1, 1))
    grey, misfit, label, phase, bright = (
        maps[..., rows, columns]
        for maps in (image.grey, image.misfit, image.label, image.phase_rad, image.bright)
    )
    if not grey.size:  # the window shows nothing of the image
        grey, label = np.zeros((1, 1), np.uint8), np.full((1, 1), NEITHER, np.uint8)
        misfit, bright = (np.zeros((1, 1), np.float16) for _ in range(2))
        phase = np.zeros((len(signs), 1, 1), np.float16)
    move = move + matrix @ np.array([columns.start, rows.start], np.float64)
    affine = np.column_stack([matrix, move])
    size = (width, height)

    def taken(maps: NDArray, border: int = cv2.BORDER_CONSTANT, value: float = 0) -> Image:
        return cv2.warpAffine(  # type: ignore[return-value]
            maps, affine, size, flags=cv2.INTER_LINEAR, borderMode=border, borderValue=value
        )

    light = smoothed(grey.astype(np.float32), matrix)
    light = cv2.warpAffine(  # type: ignore[assignment]
        light, affine, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )
    step_rad = signs[:, None] * image.step_rad
    period_px = float((TAU / np.linalg.norm(step_rad @ back, axis=1)).max())
    scene = FringeScene.of(light, period_px)
    x = channels(scene, taken(misfit.astype(np.float32), cv2.BORDER_REFLECT), image.shown)
    target = taken((label == OBJECT).astype(np.float32))
    neither = taken((label == NEITHER).astype(np.float32), value=1.0)
    inside, valid = (target > 0.5) & (neither < 0.25), neither < 0.25
    own_x, own_y = np.meshgrid(np.arange(grey.shape[1]), np.arange(grey.shape[0]))
    back_x, back_y = np.meshgrid(np.arange(width), np.arange(height))
    source = np.tensordot(back, np.stack([back_x - move[0], back_y - move[1]]), axes=1)
    truth, fitted = np.zeros((6, *shape), np.float32), np.zeros((3, *shape), bool)
    places = PLACES[len(signs)]
    share = np.float32(1 / len(signs))
    amplitude = bright.astype(np.float32) * share
    for place, sign, own, (along_x, along_y) in zip(places, signs, phase, step_rad, strict=True):
        beside = sign * own.astype(np.float32) - (along_x * own_x + along_y * own_y)
        real, imaginary = (
            taken((amplitude * wave(beside)).astype(np.float32)) for wave in (np.cos, np.sin)
        )
        angle = np.arctan2(imaginary, real) + along_x * source[0] + along_y * source[1]
        strength = np.hypot(real, imaginary) / np.maximum(target, 1e-3) / scene.unit_grey
        strength = np.clip(strength, 0, CLAMP)
        truth[place], truth[3 + place] = strength * np.sin(angle), strength * np.cos(angle)
        fitted[place] = inside
    return {
        "x": np.ascontiguousarray(x, np.float32),
        "truth": truth * inside,
        "fitted": fitted,
        "target": inside,
        "mask_valid": valid,
    }
