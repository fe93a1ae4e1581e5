"""The learned route as a method of ``fpp-bench predict``: one captured fringe, metric depth, no range given."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.method import Assumption, Frames, Method, OwnViews
from fpp_ml_bench.baselines.phase.method import LIT_BACKGROUND, ONE_ALBEDO, RouteMethod, direction_of, fringe_options
from fpp_ml_bench.baselines.phase.observe import AMBIENT_GREY, DIRECTION, MIN_CONFIDENCE, WHITE_GREY, Settings
from fpp_ml_bench.baselines.phase.resampling import Periods
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.files import printable
from fpp_ml_bench.machine import usable_cores
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import DIRECTIONS, Direction
from fpp_ml_bench.options import option

if TYPE_CHECKING:
    from torch import nn

    from fpp_ml_bench.baselines.learned.network import NetFile
    from fpp_ml_bench.baselines.learned.window_training import StepRecipe
    from fpp_ml_bench.baselines.training.weights import NetConfig
    from fpp_ml_bench.evaluation.submission.description import Submission

PERIOD_TOLERANCE = 1.4
"""Factor by which an image's fringe period in px may differ from that of the training images; beyond, the image is
resampled to theirs."""


WEIGHTS = "weights file of fpp-bench train (default: the weights that come with the package)"
"""Help of an option that all learned methods have."""
ALBEDOS = ("one", "any")


class LearnedMethod(Method):
    """A method whose network learns from views that its training renders of the training objects."""

    Training = OwnViews
    packages = ("numpy", "numba", "torch")
    weights_config: "NetConfig"

    @classmethod
    @abstractmethod
    def recipe(cls, **given: Any) -> "StepRecipe":
        """The recipe of its training, with the values that were given."""

    @classmethod
    def train(cls, training: Any, out: Path, minutes: float | None = None) -> bool:
        from fpp_ml_bench.baselines.learned.window_training import train_net

        given = {key: value for key, value in vars(training).items() if value is not None}
        start = given.pop("start", None)
        recipe = cls.recipe(**given)
        trained = train_net(
            recipe, out, start=start, minutes=minutes, workers=usable_cores(), show=True, print_line=print
        )
        if trained.weights is None:
            steps = f"{trained.steps} of {recipe.steps} steps"
            print(f"{out}: stopped after {steps}, all saved; run the same command to resume")
            return False
        scores = ", ".join(f"{key} {value:.3g}" for key, value in trained.validation.items())
        print(f"{trained.weights}: {trained.steps} steps, mask threshold {trained.threshold:g}; validation: {scores}")
        print(f"next: fpp-bench predict {cls.name} DATASET --weights {trained.weights} --out predictions")
        return True

    def use(self, config: "NetConfig", network: "nn.Module", sha256: str) -> dict[str, Any]:
        """Note whose weights these are; what they add to the submission's settings."""
        self.weights_config, self.parameters = config, sum(parameter.numel() for parameter in network.parameters())
        return {"weights": config.name, "weights_sha256": sha256, "mask_threshold": config.threshold}

    @property
    def learned_from(self) -> dict[str, Any]:
        recipe = self.weights_config.recipe
        lights = f"training objects in the light paper and {recipe.get('lights')} drawn ones, seed {recipe.get('seed')}"
        return {"data": "generated", "versions": [lights]}


class LearnedRoute(LearnedMethod, RouteMethod):
    """A learned method that measures every map of a sample with `route`, and its network in ``threads``."""

    route: Any
    threads: int

    @abstractmethod
    def image(self, frames: Frames) -> NDArray[np.uint8]:
        """The image (H, W) that is measured, of a captured sequence."""

    def measure(self, frames: Frames) -> Any:
        """All maps of a captured sequence; frames that are not in `frames_used` may be None."""
        from fpp_ml_bench.baselines.networks.base import torch_threads

        with torch_threads(self.threads):
            return self.route.measure(self.image(frames))


def _shipped(albedo: str) -> str:
    if albedo not in ALBEDOS:
        raise PredictionError(f"albedo {albedo!r}: expected one or any")
    return f"phase-net-{albedo}-albedo"


@dataclass(frozen=True)
class PhaseNetOptions:
    """Options of `PhaseNetMethod`; ``weights``: also a file that was read."""

    direction: Direction = option("horizontal", DIRECTION, choices=DIRECTIONS)
    weights: "str | Path | NetFile | None" = option(None, WEIGHTS, "FILE")
    min_confidence: float = option(0.0, MIN_CONFIDENCE, "C")
    albedo: str | None = option(
        None,
        "one: all surfaces have the background's albedo, and brightness tells the order; any: brightness is not used, "
        "and the order is ambiguous unless range and shape tell it (default: one)",
        choices=ALBEDOS,
    )
    threads: int = 1
    white_grey: float | None = option(None, WHITE_GREY, "GREY")
    ambient_grey: float | None = option(None, AMBIENT_GREY, "GREY")


@dataclass(frozen=True)
class PhaseNetTraining(OwnViews):
    """Training of phase-net; ``start``: weights to start from."""

    albedo: str | None = option(
        None, "one: brightness is a cue for the order; any: it is not (default: one)", choices=ALBEDOS
    )
    start: Path | None = option(None, "weights to start from (default: none)", "FILE")


class PhaseNetMethod(LearnedRoute):
    """Depth from the first sinusoid of one ``direction``. ``albedo``: "one", where all surfaces have the background's,
    so that brightness tells the order, or "any", where it is ambiguous unless range and shape tell it; or
    ``weights``, a shipped name or a file, which say what they learned. ``min_confidence``: pixels below it are masked;
    ``white_grey`` and ``ambient_grey``: as of `Settings`, for images without a lit background. Raises `WeightsError`
    for weights that can't be used, and `PredictionError` for an invalid option."""

    name = "phase-net"
    purpose = "one fringe; order, mask and correction learned"
    Options = PhaseNetOptions
    Training = PhaseNetTraining

    @classmethod
    def for_rig(cls, rig: Rig, **options: Any) -> Method:
        return cls(rig, **fringe_options(cls.name, rig, options))

    @classmethod
    def recipe(cls, **given: Any) -> "StepRecipe":
        from fpp_ml_bench.baselines.learned.training import Recipe

        return Recipe(**given)

    @classmethod
    def variants(cls, rig: Rig) -> Sequence[Mapping[str, Any]]:
        return [{"albedo": albedo} for albedo in ALBEDOS] if rig.fringe_directions else []

    @classmethod
    def short_name(cls, submission: "Submission") -> str | None:
        if not submission.name.startswith("Phase route, "):
            return None
        settings = submission.settings
        weights, albedo = str(settings["weights"]), settings.get("albedo", "one")
        name = printable(weights.removesuffix(f"-{albedo}-albedo"))
        return f"{name}, 1 {direction_of(submission)}" + ("" if settings["shading"] else f", {albedo} albedo")

    @classmethod
    def assumption(cls, settings: Mapping[str, Any]) -> Assumption | None:
        shading = settings.get("shading")
        return ONE_ALBEDO if shading is True else LIT_BACKGROUND if shading is False else None

    def __init__(self, rig: Rig, **options: Any) -> None:
        from fpp_ml_bench.baselines.learned.network import NetFile, load_net
        from fpp_ml_bench.baselines.learned.odds import Odds
        from fpp_ml_bench.baselines.learned.route import NetworkRoute

        given = self.checked_options(options)
        direction, weights, albedo, threads = given.direction, given.weights, given.albedo, given.threads
        min_confidence, white_grey, ambient_grey = given.min_confidence, given.white_grey, given.ambient_grey
        self.file = weights if isinstance(weights, NetFile) else load_net(weights or _shipped(albedo or "one"))
        learned = self.file.config.recipe.get("albedo")
        if learned not in ("one", "any") or not self.file.network.uncertain:
            raise PredictionError(
                f"{self.file.path}: expected weights that this version's fpp-bench train phase-net wrote"
            )
        if albedo not in (None, learned):
            raise PredictionError(f"{self.file.path}: learned {learned} albedo, not {albedo}; leave --albedo out")
        shading = learned == "one"
        self.options = Settings(
            direction=direction,
            min_confidence=min_confidence,
            shading=shading,
            white_grey=white_grey,
            ambient_grey=ambient_grey,
        )
        self.rig, self.threads = rig, threads
        trained_period_px = self.file.config.period_px.get(direction)
        if trained_period_px is None:
            raise PredictionError(
                f"{self.file.path}: learned from {', '.join(self.file.config.period_px)} fringes only, not from "
                f"{direction} ones; use other weights, or the measured route (phase)"
            )
        bounds = trained_period_px / PERIOD_TOLERANCE, trained_period_px * PERIOD_TOLERANCE
        periods = Periods(bounds[0], trained_period_px, bounds[1])
        config = self.file.config
        odds = Odds(config.temperature, config.offset, config.doubted)
        self.route = NetworkRoute(
            rig,
            self.options,
            self.file.network,
            config.threshold,
            config.lead,
            odds,
            periods,
        )
        self.frames_used = (rig.sequence.sinusoids(direction)[0],)
        more = "" if config.name == f"phase-net-{learned}-albedo" else f" ({config.name})"
        # With a range under a period, most pixels have one order in it, whatever the network says.
        self.by_range = rig.periods_in_range(direction) < 1
        learned_parts = "order by range; mask" if self.by_range else "order, mask"
        self.title = (
            f"Phase route, one {direction} fringe, {learned} albedo; {learned_parts} and correction learned{more}"
        )
        self.settings = {
            "direction": direction,
            "albedo": learned,
            "shading": shading,
            "order_by_range": self.by_range,
            "min_confidence": min_confidence,
            **self.use(config, self.file.network, self.file.sha256),
            "order_lead": config.lead,
            "temperature": config.temperature,
            "offset": config.offset,
            "doubted": config.doubted,
            "threads": threads,
            "white_grey": white_grey,
            "ambient_grey": ambient_grey,
        }

    def image(self, frames: Frames) -> NDArray[np.uint8]:
        return self.images(frames)[0]

    def crop(self, frames: Frames) -> tuple[slice, slice]:
        route = self.route.geometry.route
        return route.resampling.captured_crop(route.observe(self.image(frames)).crop)
