"""The learned methods of ``fpp-bench predict``: phase-net and crossed-net measure depth in one
captured frame, without a range given; classical-net averages and fills what the decoder finds."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from hashlib import sha256
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.classical import ClassicalMethod
from fpp_ml_bench.baselines.method import Answer, Assumption, Frames, Method, OwnViews
from fpp_ml_bench.baselines.phase.depth import FringeMeasurement, Measurement
from fpp_ml_bench.baselines.phase.geometry import Carriers, Periods
from fpp_ml_bench.baselines.phase.method import (
    LIT_BACKGROUND,
    ONE_ALBEDO,
    RANGE_AND_WALL,
    RouteMethod,
    crossed_image,
    crossed_name,
    direction_of,
    frames_of,
    fringe_assumption,
    fringe_options,
    has_crossed_fringes,
    pitch_setting,
    pitch_words,
)
from fpp_ml_bench.baselines.phase.observe import OneCarrier, TwoCarriers
from fpp_ml_bench.baselines.phase.route import Measured, one_carrier, two_carriers
from fpp_ml_bench.baselines.phase.settings import (
    AMBIENT_GREY,
    DIRECTION,
    MIN_CONFIDENCE,
    WHITE_GREY,
    Settings,
)
from fpp_ml_bench.coding.crossed import Crossed
from fpp_ml_bench.coding.phase_shift import PhaseShift
from fpp_ml_bench.decoding.decode import Directions
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.files import printable
from fpp_ml_bench.machine import usable_cores
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.rig_file import rig_from_dict
from fpp_ml_bench.optics.sequence import Direction
from fpp_ml_bench.options import option

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.training.weights import Family, NetConfig, WeightsFile
    from fpp_ml_bench.evaluation.submission.description import Submission

STEPS = 3
"""Phase steps of classical-net where a rig's code leaves the choice and no others are asked for:
noise is what it takes away."""
WEIGHTS = "weights file of fpp-bench train (default: the weights that come with the package)"
"""Help of an option that all learned methods have."""
SEEDS = (42, 1, 2)
MEMBERS = len(SEEDS)
"""Of the networks of fringe-net that come with the package."""
Albedo = Literal["one", "any"]
ALBEDOS: tuple[Albedo, ...] = get_args(Albedo)


class LearnedMethod(Method):
    """A method whose network learns from views that its training renders of the training
    objects."""

    Training = OwnViews
    recipe: ClassVar[str]
    """Module and class of the recipe of its training."""
    packages = ("numpy", "numba", "torch")
    file: "WeightsFile"
    weights_config: "NetConfig"

    @classmethod
    def train(cls, training: Any, out: Path, minutes: float | None = None) -> bool:
        from fpp_ml_bench.baselines.learned.training import train_net

        given = {key: value for key, value in vars(training).items() if value is not None}
        start = given.pop("start", None)
        module, name = cls.recipe.split(":")
        recipe = getattr(import_module(f"fpp_ml_bench.baselines.learned.{module}"), name)(**given)
        trained = train_net(
            recipe, out, start=start, minutes=minutes, workers=usable_cores(), show=True
        )
        if trained.weights is None:
            steps = f"{trained.steps} of {recipe.steps} steps"
            print(f"{out}: stopped after {steps}, all saved; run the same command to resume")
            return False
        scores = ", ".join(f"{key} {value:.3g}" for key, value in trained.validation.items())
        print(
            f"{trained.weights}: {trained.steps} steps, mask threshold {trained.threshold:g}; "
            f"validation: {scores}"
        )
        print(
            f"next: fpp-bench predict {cls.name} DATASET --weights {trained.weights} --out "
            f"predictions"
        )
        return True

    def use(self, weights: "str | Path | WeightsFile", family: "Family | None" = None) -> None:
        """Take its network from weights that come with the package, or a file; of `PHASE_NETWORKS`,
        ready to predict, or of another ``family``."""
        from fpp_ml_bench.baselines.learned.network import SHIPPED, load_net
        from fpp_ml_bench.baselines.training.weights import (
            PHASE_NETWORKS,
            WeightsFile,
            shipped_names,
        )

        if not isinstance(weights, WeightsFile):
            weights = load_net(weights, family is None, family or PHASE_NETWORKS)
        self.file = weights
        self.weights_config = config = self.file.config
        self.parameters = sum(parameter.numel() for parameter in self.file.network.parameters())
        self.more = "" if config.name in shipped_names(SHIPPED) else f" ({config.name})"
        self.weights_settings = {
            "weights": config.name,
            "weights_sha256": self.file.sha256,
            "mask_threshold": config.threshold,
        }

    @property
    def learned_from(self) -> dict[str, Any] | None:
        recipe = self.weights_config.recipe
        lights = (
            f"training objects in the light paper and {recipe.get('lights')} drawn ones, seed "
            f"{recipe.get('seed')}"
        )
        return {"data": "generated", "versions": [lights]}


class LearnedRoute(LearnedMethod, RouteMethod[Measured]):
    """A learned method that measures every map of a sample with `route`, and its network in
    ``threads``. Images whose fringe period in px differs by more than ``period_tolerance`` from
    that of the training images are resampled to theirs."""

    threads: int
    period_tolerance: float

    def learned_periods(self, fringes: str) -> Periods:
        """Raises `PredictionError` for ``fringes`` that the weights did not learn from."""
        learned_px = self.weights_config.period_px.get(fringes)
        if learned_px is None:
            raise PredictionError(
                f"{self.file.path}: learned from {', '.join(self.weights_config.period_px)} "
                f"fringes only, not from "
                f"{fringes} ones; use other weights, or a measured route (phase, crossed)"
            )
        return Periods(
            learned_px / self.period_tolerance, learned_px, learned_px * self.period_tolerance
        )

    def measure(self, frames: Frames) -> Measured:
        from fpp_ml_bench.baselines.networks.base import torch_threads

        with torch_threads(self.threads):
            return super().measure(frames)


@dataclass(frozen=True)
class PhaseNetOptions:
    """Options of `PhaseNetMethod`; ``weights``: also a file that was read."""

    direction: Direction = option("horizontal", DIRECTION)
    weights: "str | Path | WeightsFile | None" = option(None, WEIGHTS, "FILE")
    min_confidence: float = option(0.0, MIN_CONFIDENCE, "C")
    albedo: Albedo | None = option(
        None,
        "one: all surfaces have the background's albedo, and brightness tells the order; any: "
        "brightness is not used, "
        "and the order is ambiguous unless range and shape tell it (default: one)",
    )
    threads: int = 1
    white_grey: float | None = option(None, WHITE_GREY, "GREY")
    ambient_grey: float | None = option(None, AMBIENT_GREY, "GREY")


@dataclass(frozen=True)
class PhaseNetTraining(OwnViews):
    """Training of phase-net; ``start``: weights to start from."""

    albedo: Albedo | None = option(
        None, "one: brightness is a cue for the order; any: it is not (default: one)"
    )
    start: Path | None = option(None, "weights to start from (default: none)", "FILE")


class PhaseNetMethod(LearnedRoute[FringeMeasurement]):
    """Depth from the first sinusoid of one ``direction``. ``albedo``: "one", where all surfaces
    have the background's, so that brightness tells the order, or "any", where it is ambiguous
    unless range and shape tell it; or ``weights``, a shipped name or a file, which say what they
    learned. ``min_confidence``: pixels below it are masked; ``white_grey`` and ``ambient_grey``: as
    of `Settings`, for images without a lit background. Raises `WeightsError` for weights that can't
    be used, and `PredictionError` for an invalid option."""

    name = "phase-net"
    recipe = "recipes:PhaseRecipe"
    period_tolerance = 1.4
    purpose = "one fringe; order, mask and correction learned"
    Options = PhaseNetOptions
    Training = PhaseNetTraining

    @classmethod
    def for_rig(cls, rig: Rig, **options: Any) -> Method:
        return cls(rig, **fringe_options(cls.name, rig, options))

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
        return f"{name}, 1 {direction_of(submission)}" + (
            "" if settings["shading"] else f", {albedo} albedo"
        )

    @classmethod
    def assumption(cls, settings: Mapping[str, Any]) -> Assumption | None:
        shading = settings.get("shading")
        return ONE_ALBEDO if shading is True else LIT_BACKGROUND if shading is False else None

    def __init__(self, rig: Rig, **options: Any) -> None:
        from fpp_ml_bench.baselines.learned.inputs import Geometry
        from fpp_ml_bench.baselines.learned.odds import Odds
        from fpp_ml_bench.baselines.learned.routes import PhaseNetPart

        given = self.checked_options(options)
        if given.albedo not in (None, *ALBEDOS):
            raise PredictionError(f"albedo {given.albedo!r}: expected one or any")
        self.use(given.weights or f"phase-net-{given.albedo or 'one'}-albedo")
        config = self.weights_config
        learned = config.recipe.get("albedo")
        if learned not in ALBEDOS:
            raise PredictionError(
                f"{self.file.path}: expected weights that this version's fpp-bench train phase-net "
                f"wrote"
            )
        if given.albedo not in (None, learned):
            raise PredictionError(
                f"{self.file.path}: learned {learned} albedo, not {given.albedo}; leave --albedo "
                f"out"
            )
        own = {
            entry.name: getattr(given, entry.name)
            for entry in fields(Settings)
            if hasattr(given, entry.name)
        }
        self.options, self.rig, self.threads = (
            Settings(**own, shading=learned == "one"),
            rig,
            given.threads,
        )
        odds, periods = (
            Odds(config.temperature, config.offset, config.doubted),
            self.learned_periods(given.direction),
        )
        model = OneCarrier(rig, self.options, periods)
        part = PhaseNetPart(Geometry(model), self.file.network, config.threshold, config.lead, odds)
        self.route = one_carrier(model, learned=part)
        self.frames_used = (rig.sequence.sinusoids(given.direction)[0],)
        # With a range under a period, most pixels have one order in it, whatever the network says.
        self.by_range = rig.periods_in_range(given.direction) < 1
        learned_parts = "order by range; mask" if self.by_range else "order, mask"
        self.title = (
            f"Phase route, one {given.direction} fringe, {learned} albedo; {learned_parts} and "
            f"correction learned"
            f"{self.more}"
        )
        self.settings = {
            **vars(given),
            **self.weights_settings,
            "albedo": learned,
            "shading": self.options.shading,
            "order_by_range": self.by_range,
            "order_lead": config.lead,
            **vars(odds),
        }


@dataclass(frozen=True)
class CrossedNetOptions:
    """Options of `CrossedNetMethod`; ``weights``: also a file that was read."""

    weights: "str | Path | WeightsFile" = option("crossed-net", WEIGHTS, "FILE")
    min_confidence: float = option(0.0, MIN_CONFIDENCE, "C")
    threads: int = 1


class CrossedNetMethod(LearnedRoute[Measurement]):
    """Depth from one crossed frame by the weights ``weights`` (a shipped name or a file), or from
    the mean of the first fringe of both directions where the rig has no crossed frame.
    ``min_confidence``: pixels below it are masked. Raises `WeightsError` for weights that can't be
    used, and `PredictionError` for a rig whose fringes they did not learn."""

    name = "crossed-net"
    recipe = "recipes:CrossedRecipe"
    period_tolerance = 2.2
    purpose = "one crossed frame, with order, mask and correction learned"
    Options = CrossedNetOptions

    @classmethod
    def scenes_rig(cls, settings: Mapping[str, Any]) -> str:
        return "crossed"

    @classmethod
    def assumption(cls, settings: Mapping[str, Any]) -> Assumption | None:
        return RANGE_AND_WALL

    @classmethod
    def variants(cls, rig: Rig) -> Sequence[Mapping[str, Any]]:
        return [{}] if has_crossed_fringes(rig) else []

    @classmethod
    def short_name(cls, submission: "Submission") -> str | None:
        return crossed_name(submission, "Crossed fringes, ")

    def __init__(self, rig: Rig, **options: Any) -> None:
        from fpp_ml_bench.baselines.learned.routes import CrossedNetPart

        given = self.checked_options(options)
        self.use(given.weights)
        config, periods = self.weights_config, self.learned_periods("crossed")
        self.rig, self.threads, self.frames_used = rig, given.threads, frames_of(rig, self.name)
        model = TwoCarriers(rig, Settings(min_confidence=given.min_confidence), periods=periods)
        part = CrossedNetPart(model.carriers, self.file.network, config.threshold, config.lead)
        self.route = two_carriers(model, learned=part)
        made = "" if len(self.frames_used) == 1 else ", the mean of two"
        self.title = (
            f"Crossed fringes, one frame{made}; order, mask and correction learned{self.more}"
        )
        self.settings = {**vars(given), **self.weights_settings, "order_lead": config.lead}

    def images(self, frames: Frames) -> list[NDArray[np.uint8]]:
        return [crossed_image(super().images(frames))]


@dataclass(frozen=True)
class FringeNetOptions:
    """Options of `FringeNetMethod`; ``weights``: of one network, also a file that was read."""

    fringes: Literal["horizontal", "vertical", "crossed"] | None = option(
        None, "the frame to take (default: crossed where the rig has such frames, else horizontal)"
    )
    members: int = option(
        MEMBERS, f"networks whose answers are averaged, 1 to {MEMBERS} (default: {MEMBERS})", "N"
    )
    weights: "str | Path | WeightsFile | None" = option(None, WEIGHTS, "FILE")
    min_confidence: float = option(0.0, MIN_CONFIDENCE, "C")
    threads: int = 1


@dataclass(frozen=True)
class FringeNetTraining(OwnViews):
    """Training of one network of fringe-net."""

    fringes: Literal["lines", "crossed"] | None = option(
        None, "lines: fringes of one direction, either; crossed: both in one frame (default: lines)"
    )
    seed: int | None = option(
        None, "of weights, lights and windows: another network (default: 42)", "N"
    )


class FringeNetMethod(LearnedRoute[Measurement]):
    """Depth from one frame whose wrapped phase networks give as numerator and denominator
    (`fringe_net`); mask, order and depth as of `phase` or `crossed`. ``members`` of the shipped
    ensemble, or the network in ``weights`` alone. The first sinusoid of a direction, or a crossed
    frame: ``fringes``. Raises `WeightsError` for weights that can't be used, and `PredictionError`
    for an invalid option."""

    name = "fringe-net"
    recipe = "fringe_recipe:FringeRecipe"
    period_tolerance = 1.0  # an image of another period is warped for the networks alone
    purpose = "one frame, its wrapped phase learned"
    Options = FringeNetOptions
    Training = FringeNetTraining

    @classmethod
    def variants(cls, rig: Rig) -> Sequence[Mapping[str, Any]]:
        ways = ["crossed"] if rig.sequence.crossed_frames else rig.fringe_directions
        return [{"fringes": way} for way in ways]

    @classmethod
    def scenes_rig(cls, settings: Mapping[str, Any]) -> str:
        return "crossed" if settings.get("fringes") == "crossed" else super().scenes_rig(settings)

    @classmethod
    def short_name(cls, submission: "Submission") -> str | None:
        if not submission.name.startswith("Wrapped phase"):
            return None
        return (
            f"{cls.name}, 1 "
            f"{submission.settings['fringes']}{pitch_words(submission.settings, ', ')}"
        )

    @classmethod
    def assumption(cls, settings: Mapping[str, Any]) -> Assumption | None:
        return (
            RANGE_AND_WALL if settings.get("fringes") == "crossed" else fringe_assumption(settings)
        )

    def __init__(self, rig: Rig, **options: Any) -> None:
        from fpp_ml_bench.baselines.learned.fringe_net import CrossedPhases, FringePhase
        from fpp_ml_bench.baselines.learned.inputs import Geometry
        from fpp_ml_bench.baselines.training.weights import FRINGE_NETWORKS

        given = self.checked_options(options)
        crossed = (
            bool(rig.sequence.crossed_frames)
            if given.fringes is None
            else given.fringes == "crossed"
        )
        fringes = given.fringes or ("crossed" if crossed else "horizontal")
        if crossed and not rig.sequence.crossed_frames:
            raise PredictionError(
                f"{self.name} --fringes crossed: this rig projects no crossed frame"
            )
        if not 1 <= given.members <= MEMBERS:
            raise PredictionError(f"{self.name} --members {given.members}: expected 1 to {MEMBERS}")
        family, names = (
            "crossed" if crossed else "lines",
            [given.weights] if given.weights else None,
        )
        networks, hashes = [], []
        for weights in names or [f"fringe-net-{family}-{seed}" for seed in SEEDS[: given.members]]:
            self.use(weights, FRINGE_NETWORKS)
            networks.append(self.file.network.folded())
            hashes.append(self.file.sha256)
        self.parameters = len(networks) * self.parameters
        self.rig, self.threads = rig, given.threads
        learned_px, other_pitch = self.learned_periods(fringes).best, {}
        if crossed:
            learned_rig = rig_from_dict(self.weights_config.recipe["rig"])
            learned = Carriers.of(learned_rig, learned_rig.crossed or Crossed.of_pair(learned_rig))
            self.frames_used = rig.sequence.crossed_frames[:1]
            pair = TwoCarriers(rig, Settings(min_confidence=given.min_confidence))
            phases = CrossedPhases.of(pair.carriers, learned, networks)
            self.route = two_carriers(pair, phases=phases.before, learned=phases.after)
        else:
            way: Direction = "vertical" if fringes == "vertical" else "horizontal"
            fringe_options(self.name, rig, {"direction": way})
            own, other_pitch = (
                Settings(direction=way, min_confidence=given.min_confidence),
                pitch_setting(rig, way),
            )
            model = OneCarrier(rig, own)
            part = FringePhase.of(Geometry(model), networks, learned_px)
            self.route = one_carrier(model, learned=part)
            self.frames_used = (rig.sequence.sinusoids(way)[0],)
        count = "one network" if len(networks) == 1 else f"{len(networks)} networks"
        frame = f"one {fringes} frame{pitch_words(other_pitch)}"
        self.title = f"Wrapped phase of {frame} by {count}; mask and order measured{self.more}"
        self.settings = {
            **vars(given),
            **self.weights_settings,
            "fringes": fringes,
            "members": len(networks),
            "weights_sha256": hashes[0]
            if len(hashes) == 1
            else sha256("".join(hashes).encode()).hexdigest(),
            **other_pitch,
        }


@dataclass(frozen=True)
class ClassicalNetOptions:
    """Options of `ClassicalNetMethod`."""

    direction: Directions | None = option(
        None, "fringes to use (default: those that the weights learned)"
    )
    steps: int | None = option(
        None, "phase steps a direction, 3 to 18, with Gray code (default: 3)", "N"
    )
    weights: str | Path = option("classical-net", WEIGHTS, "FILE")
    threads: int = 1


class ClassicalNetMethod(LearnedMethod):
    """`ClassicalMethod` of one ``direction`` (default: the one it learned) and ``steps`` (default:
    3). The weights ``weights`` (a shipped name or a file) average its depth over neighbours, by at
    most three stated standard uncertainties, and fill it where it has none. Raises `WeightsError`
    for weights that can't be used, and `PredictionError` for a code whose uncertainty is not
    known."""

    name = "classical-net"
    recipe = "filter_recipe:FilterRecipe"
    purpose = "classical frames; noise and missed pixels learned"
    Options = ClassicalNetOptions

    @classmethod
    def variants(cls, rig: Rig) -> Sequence[Mapping[str, Any]]:
        return (
            [{}] if all(isinstance(rig.code(way), PhaseShift) for way in rig.directions[:1]) else []
        )

    @classmethod
    def short_name(cls, submission: "Submission") -> str | None:
        classical = ClassicalMethod.short_name(submission)
        if classical is None:
            return None
        return printable(submission.settings["weights"]) + classical.removeprefix("Classical")

    def __init__(self, rig: Rig, **options: Any) -> None:
        from fpp_ml_bench.baselines.training.weights import FILTER_NETWORKS

        given = self.checked_options(options)
        steps = given.steps
        self.use(given.weights, FILTER_NETWORKS)
        self.network = self.file.network.folded()
        learned = str(self.weights_config.recipe.get("direction", "vertical"))
        way: Any = given.direction or (learned if learned in rig.directions else rig.directions[0])
        codes = [rig.code(one) for one in (rig.directions if way == "both" else (way,))]
        fringes = [code for code in codes if isinstance(code, PhaseShift)]
        if len(fringes) < len(codes):
            raise PredictionError(
                f"{self.name}: needs the uncertainty of every pixel, which {codes[0].title} does "
                f"not give; use "
                f"{ClassicalMethod.name}"
            )
        if steps is None and all(code.is_plain for code in fringes):
            steps = STEPS
        self.classical = ClassicalMethod(rig, direction=way, steps=steps, threads=given.threads)
        self.rig, self.threads, self.frames_used = rig, given.threads, self.classical.frames_used
        self.title = f"{self.classical.title}; noise and missed pixels learned{self.more}"
        self.settings = {**self.classical.settings, **self.weights_settings}

    def answer(self, frames: Frames) -> Answer:
        """Depth, and the standard uncertainty that the network expects."""
        from fpp_ml_bench.baselines.learned.routes import DepthScene, decided, filtered, written
        from fpp_ml_bench.baselines.networks.base import torch_threads

        decoded, modulation = self.classical.measure(frames)
        scene = (
            None
            if decoded.sigma_mm is None
            else DepthScene.of(decoded.depth, decoded.sigma_mm, modulation)
        )
        if scene is None:
            return decoded
        with torch_threads(self.threads):
            answer = filtered(self.network, scene)
        inside = decided(answer, scene, self.weights_config.threshold)
        inside &= self.rig.in_range(answer.depth_mm + np.float32(scene.middle_mm))
        return Answer(*written(answer, scene, inside, decoded.depth.shape))
