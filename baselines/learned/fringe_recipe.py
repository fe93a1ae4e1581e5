"""Training fringe-net: one image of each view with the numerator and denominator of its wrapped
phase, and windows of them.

Fringes of one direction learn from the 18 steps of the same view in the same light. A crossed frame
has no such steps: its phases are those of the exact depth, and its brightness is that of the 18
horizontal steps.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from fpp_ml_bench.baselines.learned.fringe_net import (
    FringeScene,
    Phases,
    fringe_channels,
    phases_of,
)
from fpp_ml_bench.baselines.learned.inputs import Geometry
from fpp_ml_bench.baselines.learned.network import FringeNet, mean_over, scale_loss
from fpp_ml_bench.baselines.learned.scenes import View
from fpp_ml_bench.baselines.learned.training import Batch, StepRecipe, ViewTask
from fpp_ml_bench.baselines.learned.windows import Sample, Window, mean_scores, padded
from fpp_ml_bench.baselines.phase.geometry import Carriers, wrapped
from fpp_ml_bench.baselines.phase.object_mask import crop_around
from fpp_ml_bench.baselines.phase.observe import OneCarrier
from fpp_ml_bench.baselines.phase.settings import Settings
from fpp_ml_bench.baselines.training.weights import FRINGE_NETWORKS, Family
from fpp_ml_bench.errors import RecipeError
from fpp_ml_bench.evaluation.protocol import EDGE_BAND_PX
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import DIRECTIONS, Direction

Fringes = Literal["lines", "crossed"]
FRINGES: tuple[Fringes, ...] = get_args(Fringes)
SMALL = 0.05
"""Error of M and D below which its loss is quadratic, in the amplitude of the surroundings."""
MARGIN_PERIODS = 0.5  # of the crop around the object


@dataclass(frozen=True)
class FringeRecipe(StepRecipe):
    """``fringes``: of either direction, or crossed; ``widths`` and ``fine``: of the network;
    ``near_edge``: share of windows beside depth edges; ``weight_*``: of the losses."""

    name: str = "fringe-net"
    steps: int = 9000
    batch: int = 6
    window: int = 160
    rate: float = 2e-3
    lights: int = 40
    unions: int = 1
    validation_lights: int = 4
    fringes: Fringes = "lines"
    widths: tuple[int, ...] = (32, 48, 64, 96)
    fine: int = 16
    near_edge: float = 0.5
    weight_phase: float = 10.0
    weight_scale: float = 0.1

    family: ClassVar[Family] = FRINGE_NETWORKS
    main_loss: ClassVar[str] = "phase"
    scores: ClassVar[dict[str, dict[str, str]]] = {
        "validation, phase error in rad": {
            "interior_rad": "interior",
            "edge_rad": "edge",
            "drawn_rad": "drawn lights",
        },
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.fringes not in FRINGES:
            raise RecipeError(f"fringes {self.fringes!r}: expected {' or '.join(FRINGES)}")

    @property
    def title(self) -> str:  # type: ignore[override]
        return f"Numerator and denominator of the wrapped phase, {self.fringes}, seed {self.seed}"

    @property
    def weights_name(self) -> str:
        return f"{self.name}-{self.fringes}-{self.seed}"

    @property
    def rig(self) -> str:  # type: ignore[override]
        return "crossed" if self.fringes == "crossed" else "paper"

    def network(self) -> FringeNet:
        return FringeNet(2 if self.fringes == "crossed" else 1, self.widths, self.fine)

    def losses(self, network: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """``phase``: smooth L1 of M and D in the amplitude of the surroundings; ``scale``: negative
        log-likelihood of the phase error in rad under a Laplace distribution."""
        (answer,), truth, fitted = network(batch["x"]), batch["truth"], batch["fitted"][:, None]
        count = truth.shape[1] // 2
        vectors, scale = answer[:, : 2 * count], answer[:, 2 * count :]
        by_pixel = functional.smooth_l1_loss(vectors, truth, beta=SMALL, reduction="none")
        phase, true = (
            torch.atan2(maps[:, :count], maps[:, count:]) for maps in (vectors.detach(), truth)
        )
        error = torch.atan2(torch.sin(phase - true), torch.cos(phase - true)).abs()
        return {
            "phase": mean_over(by_pixel, fitted.expand_as(by_pixel)),
            "scale": scale_loss(error, scale, fitted.expand_as(scale)),
        }

    def task(self, rig: Rig) -> "FringeTask":
        return FringeTask(self, rig)


class FringeTask(ViewTask):
    """What fringe-net learns of a rig. ``decoded``: the directions whose steps tell the truth."""

    scored_share = 2

    def __init__(self, recipe: FringeRecipe, rig: Rig) -> None:
        self.recipe, self.carriers = recipe, None
        self.geometries: dict[Direction, Geometry] = {}
        if recipe.fringes == "crossed":
            if rig.crossed is None:
                raise RecipeError(
                    "fringe-net --fringes crossed: expected a rig with crossed frames, this one "
                    "has none"
                )
            self.carriers = Carriers.of(rig, rig.crossed)
            self.frames, self.decoded = (rig.sequence.crossed_frames[0],), DIRECTIONS[:1]
            self.period_px = {"crossed": self.carriers.period_px}
        else:
            self.geometries = {
                way: Geometry(OneCarrier(rig, Settings(direction=way))) for way in DIRECTIONS
            }
            self.frames, self.decoded = (
                tuple(rig.sequence.sinusoids(way)[0] for way in DIRECTIONS),
                DIRECTIONS,
            )
            self.period_px = {
                str(way): geometry.period_px for way, geometry in self.geometries.items()
            }

    def samples(self, views: Iterable[View]) -> list[Sample]:
        """Samples of ``views``, whose frames are followed by M and D of the directions that are
        ``decoded``."""
        samples = []
        for number, view in enumerate(views):
            if not view.target.any():
                continue
            ways: tuple[Direction, ...] = (
                DIRECTIONS[:1] if self.carriers is not None else DIRECTIONS
            )
            if self.carriers is None and view.united:
                ways = (DIRECTIONS[number % 2],)
            samples += [self._sample(view, direction) for direction in ways]
        return samples

    def _sample(self, view: View, direction: Direction) -> Sample:
        which = DIRECTIONS.index(direction)
        period_px = self.period_px["crossed" if self.carriers is not None else direction]
        crop = crop_around(view.target, int(np.ceil(MARGIN_PERIODS * period_px)))
        part = view.part(crop)
        frames = part.frames.astype(np.float32)
        scene = FringeScene.of(frames[which], period_px, crop)
        first = len(self.frames) + 2 * which
        truth = frames[first : first + 2]
        if self.carriers is not None:
            carriers, weights = self.carriers.at(crop), self.carriers.family.weights
            phases = carriers.phases(
                carriers.nearness(np.where(part.target, part.depth_mm, 1000.0))
            )
            bright = np.hypot(*truth) * np.array(weights, np.float32)[:, None, None]
            truth = np.concatenate([bright * np.sin(phases), bright * np.cos(phases)])
        missing = np.clip(truth / scene.unit_grey, -4, 4) * part.target
        return Sample.of(
            part, scene.single(np.float16), missing.astype(np.float16), direction=direction
        )

    def _turned(self, sample: Sample, maps: NDArray, truth: bool = False) -> NDArray:
        """Maps (..., h, w) of a sample rotated for the network; ``truth``: M and D."""
        if self.carriers is not None:
            return maps
        rotation = self.geometries[sample.direction].rotation
        turned = rotation.turn(maps)
        return turned * np.array([rotation.sign, 1], np.float32)[:, None, None] if truth else turned

    def draw(self, samples: list[Sample], random: np.random.Generator) -> Window:
        """A random window of one of ``samples``: the network's input, ``truth``, M and D, and where
        it counts. Columns of one carrier, along which its phase does not grow, are mirrored."""
        size, sample = self.recipe.window, samples[random.integers(len(samples))]
        rows, columns = sample.place(size, self.recipe.near_edge, random)
        maps = {
            "x": self._turned(sample, fringe_channels(sample.scene.window(rows, columns).single())),
            "truth": self._turned(
                sample, sample.missing[:, rows, columns].astype(np.float32), truth=True
            ),
            "fitted": self._turned(sample, sample.target[rows, columns]),
        }
        if self.carriers is None and random.random() < 0.5:
            maps = {name: np.flip(values, -1) for name, values in maps.items()}
        return padded(size, {name: np.ascontiguousarray(values) for name, values in maps.items()})

    def answer(self, network: FringeNet, sample: Sample) -> Phases:
        """Phases of a sample, rotated for the network."""
        x = self._turned(sample, fringe_channels(sample.scene.single()))
        return phases_of([network], np.ascontiguousarray(x))[0]

    def score(self, network: FringeNet, sample: Sample) -> dict[str, float | None]:
        """Mean phase error in rad of a sample's object beyond `EDGE_BAND_PX` from its silhouette,
        and nearer; whether it is within the stated standard uncertainty; the same error of all
        pixels in drawn lights."""
        found, truth = (
            self.answer(network, sample),
            self._turned(sample, sample.missing.astype(np.float32), truth=True),
        )
        count = len(truth) // 2
        error = np.abs(wrapped(found.phase_rad - np.arctan2(truth[:count], truth[count:]))).mean(
            axis=0
        )
        target = np.ascontiguousarray(self._turned(sample, sample.target))
        inner = (
            cv2.erode(target.astype(np.uint8), np.ones((2 * EDGE_BAND_PX + 1,) * 2, np.uint8)) > 0
        )
        within = (error < found.sigma_rad.mean(axis=0))[target]

        def mean(where: NDArray) -> float | None:
            return float(error[where].mean(dtype=np.float64)) if where.any() else None

        return {
            "interior_rad": mean(inner),
            "edge_rad": mean(target & ~inner),
            "drawn_rad": mean(target) if "drawn" in sample.group else None,
            "within_percent": 100 * float(within.mean()) if within.size else None,
        }

    def scores(self, network: FringeNet, samples: list[Sample]) -> dict[str, float]:
        return mean_scores(self.score(network, sample) for sample in samples)

    def chosen(
        self, network: FringeNet, samples: list[Sample], validation: list[Sample], out: Path
    ) -> dict[str, Any]:
        return {
            "threshold": 0.0,
            "period_px": self.period_px,
            "validation": self.scores(network, validation),
        }
