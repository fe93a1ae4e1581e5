"""crossed-net as a method of ``fpp-bench predict``: one crossed frame, metric depth, no ground truth given."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.learned.method import WEIGHTS, LearnedRoute
from fpp_ml_bench.baselines.method import Frames
from fpp_ml_bench.baselines.phase.method import crossed_image, crossed_name, frames_of, has_crossed_fringes
from fpp_ml_bench.baselines.phase.observe import MIN_CONFIDENCE, Settings
from fpp_ml_bench.baselines.phase.resampling import Periods
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.options import option

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.learned.network import NetFile
    from fpp_ml_bench.baselines.learned.window_training import StepRecipe
    from fpp_ml_bench.evaluation.submission.description import Submission

SHIPPED = Path(__file__).resolve().parent / "weights"  # folder of the weights that come with the package
DEFAULT = "crossed-net"
PERIOD_TOLERANCE = 2.2
"""Factor by which the fringe period in image px may differ from that of the training views; beyond, the image is
resampled to theirs."""


@dataclass(frozen=True)
class CrossedNetOptions:
    """Options of `CrossedNetMethod`; ``weights``: also a file that was read."""

    weights: "str | Path | NetFile" = option(DEFAULT, WEIGHTS, "FILE")
    min_confidence: float = option(0.0, MIN_CONFIDENCE, "C")
    threads: int = 1


class CrossedNetMethod(LearnedRoute):
    """Depth from one crossed frame by the weights ``weights`` (a shipped name or a file), or from the mean of the first
    fringe of both directions where the rig has no crossed frame. ``min_confidence``: pixels below it are masked. Raises
    `WeightsError` for weights that can't be used, and `PredictionError` for a rig whose fringes they did not learn."""

    name = "crossed-net"
    purpose = "one crossed frame, with order, mask and correction learned"
    Options = CrossedNetOptions
    scenes_rig = "crossed"

    @classmethod
    def recipe(cls, **given: Any) -> "StepRecipe":
        from fpp_ml_bench.baselines.learned.crossed_training import CrossedRecipe

        return CrossedRecipe(**given)

    @classmethod
    def variants(cls, rig: Rig) -> Sequence[Mapping[str, Any]]:
        return [{}] if has_crossed_fringes(rig) else []

    @classmethod
    def short_name(cls, submission: "Submission") -> str | None:
        return crossed_name(submission, "Crossed fringes, ")

    def __init__(self, rig: Rig, **options: Any) -> None:
        from fpp_ml_bench.baselines.learned.crossed_inputs import CHANNELS
        from fpp_ml_bench.baselines.learned.crossed_route import CrossedNetRoute
        from fpp_ml_bench.baselines.learned.network import NetFile, load_net

        given = self.checked_options(options)
        weights, min_confidence, threads = given.weights, given.min_confidence, given.threads
        self.file = weights if isinstance(weights, NetFile) else load_net(weights, shipped=SHIPPED)
        config = self.file.config
        if self.file.network.options["channels"] != len(CHANNELS) or "crossed" not in config.period_px:
            raise PredictionError(
                f"{self.file.path}: learned from {', '.join(config.period_px)} fringes, not from crossed ones; use "
                f"weights that fpp-bench train {self.name} wrote"
            )
        self.rig, self.threads, self.frames_used = rig, threads, frames_of(rig, self.name)
        learned_px = config.period_px["crossed"]
        periods = Periods(learned_px / PERIOD_TOLERANCE, learned_px, learned_px * PERIOD_TOLERANCE)
        self.route = CrossedNetRoute(
            rig, self.file.network, config.threshold, config.lead, Settings(min_confidence=min_confidence), periods
        )
        made = "" if len(self.frames_used) == 1 else ", the mean of two"
        more = "" if config.name == DEFAULT else f" ({config.name})"
        self.title = f"Crossed fringes, one frame{made}; order, mask and correction learned{more}"
        self.settings = {
            "min_confidence": min_confidence,
            **self.use(config, self.file.network, self.file.sha256),
            "order_lead": config.lead,
            "threads": threads,
        }

    def image(self, frames: Frames) -> NDArray[np.uint8]:
        return crossed_image(self.images(frames))

    def crop(self, frames: Frames) -> tuple[slice, slice]:
        route = self.route.route
        return route.resampling.captured_crop(route.observe(self.image(frames)).carriers.crop)
