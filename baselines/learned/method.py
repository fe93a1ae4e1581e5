"""fringe-net, the learned method of ``fpp-bench predict``: depth from one captured frame of any rig,
without a range given."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.method import Assumption, Frames, Setting
from fpp_ml_bench.baselines.phase.depth import Measurement
from fpp_ml_bench.baselines.phase.method import (
    ANYWAY,
    AUDIT,
    AUDITED,
    RANGE_AND_WALL,
    RouteMethod,
    audited_words,
    crossed_image,
    frames_of,
    fringe_assumption,
    fringe_direction,
    pitch_setting,
    pitch_words,
)
from fpp_ml_bench.baselines.phase.observe import OneCarrier, TwoCarriers
from fpp_ml_bench.baselines.phase.route import one_carrier, two_carriers
from fpp_ml_bench.baselines.phase.settings import MIN_CONFIDENCE, Settings
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.machine import usable_cores
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.options import option

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.training.weights import NetConfig, WeightsFile
    from fpp_ml_bench.evaluation.submission.description import Submission

NETWORKS = ("fringe-net-42", "fringe-net-1", "fringe-net-2")
"""Weights of the networks that come with the package."""
MEMBERS = len(NETWORKS)
EVENLY = ", even odds"
"""End of the title and the short name of a method with ``--even-odds``."""


@dataclass(frozen=True)
class FringeNetOptions:
    """Options of `FringeNetMethod`; ``weights``: of one network, also a file that was read."""

    fringes: Literal["horizontal", "vertical", "crossed"] | None = option(
        None, "the frame to take (default: crossed where the rig has such frames, else horizontal)"
    )
    members: int = option(
        MEMBERS, f"networks whose answers are averaged, 1 to {MEMBERS} (default: {MEMBERS})", "N"
    )
    weights: "str | Path | WeightsFile | None" = option(
        None,
        "weights file of fpp-bench train (default: the weights that come with the package)",
        "FILE",
    )
    audit: bool = option(False, AUDIT)
    anyway: bool = option(False, ANYWAY)
    even_odds: bool = option(
        False,
        "leave out pixels that are as likely wall as object: invents a third to half as many, "
        "misses more (default: miss few)",
    )
    min_confidence: float = option(0.0, MIN_CONFIDENCE, "C")
    threads: int = 1


@dataclass(frozen=True)
class FringeNetTraining:
    """Training of one network, which renders what it learns from; None: as the shipped weights were
    trained."""

    steps: int | None = option(None, "training steps (default: as the shipped weights)", "N")
    rigs: int | None = option(
        None,
        "rigs that are drawn at random, each with a light (default: as the shipped weights)",
        "N",
    )
    unions: int | None = option(
        None,
        "images that join several objects, made from each sample (default: as the shipped weights)",
        "N",
    )
    rate: float | None = option(
        None, "largest learning rate (default: as the shipped weights)", "R"
    )
    seed: int | None = option(
        None, "of weights, rigs, lights and windows: another network (default: 42)", "N"
    )


class FringeNetMethod(RouteMethod[Measurement]):
    """Depth from one frame whose wrapped phases and object networks give (`fringe_net`); order and
    depth as of `phase` or `crossed`. ``members`` of the shipped ensemble, or the network in
    ``weights`` alone. The first sinusoid of a direction, or a crossed frame: ``fringes``. Raises
    `WeightsError` for weights that can't be used, and `PredictionError` for an invalid option."""

    name = "fringe-net"
    purpose = "one frame of any rig, its wrapped phase and mask learned"
    Options = FringeNetOptions
    Training = FringeNetTraining
    packages = ("numpy", "numba", "torch")
    weights_config: "NetConfig"
    threads: int

    @classmethod
    def train(cls, training: FringeNetTraining, out: Path, minutes: float | None = None) -> bool:
        from fpp_ml_bench.baselines.learned.recipe import FringeRecipe
        from fpp_ml_bench.baselines.learned.training import train_net

        given = {key: value for key, value in vars(training).items() if value is not None}
        recipe = FringeRecipe(**given)
        trained = train_net(recipe, out, minutes=minutes, workers=usable_cores(), show=True)
        if trained.weights is None:
            steps = f"{trained.steps} of {recipe.steps} steps"
            print(f"{out}: stopped after {steps}, all saved; run the same command to resume")
            return False
        scores = ", ".join(f"{key} {value:.3g}" for key, value in trained.validation.items())
        print(f"{trained.weights}: {trained.steps} steps; validation: {scores}")
        print(
            f"next: fpp-bench predict {cls.name} DATASET --weights {trained.weights} --out "
            f"predictions"
        )
        return True

    @classmethod
    def variants(cls, rig: Rig) -> Sequence[Mapping[str, Setting]]:
        ways = ["crossed"] if rig.sequence.crossed_frames else rig.fringe_directions
        return [{"fringes": way} for way in ways]

    @classmethod
    def scenes_rig(cls, settings: Mapping[str, Setting]) -> str:
        return "crossed" if settings.get("fringes") == "crossed" else super().scenes_rig(settings)

    @classmethod
    def short_name(cls, submission: "Submission") -> str | None:
        if not submission.name.startswith("Wrapped phase"):
            return None
        return (
            f"{cls.name}, 1 "
            f"{submission.settings['fringes']}{pitch_words(submission.settings, ', ')}"
            f"{EVENLY if submission.settings.get('even_odds') else ''}"
            f"{audited_words(submission.settings)}"
        )

    @classmethod
    def assumption(cls, settings: Mapping[str, Setting]) -> Assumption | None:
        return (
            RANGE_AND_WALL if settings.get("fringes") == "crossed" else fringe_assumption(settings)
        )

    def __init__(self, rig: Rig, **options: object) -> None:
        from fpp_ml_bench.baselines.learned.fringe_net import (
            EVEN,
            WIDE,
            Fringes,
            LinePart,
            PairPart,
        )
        from fpp_ml_bench.baselines.learned.network import SHIPPED, load_net
        from fpp_ml_bench.baselines.learned.warp import Warp, signs_of, steps_and_signs
        from fpp_ml_bench.baselines.training.weights import WeightsFile, shipped_names

        given = self.checked_options(FringeNetOptions, options)
        fringes = given.fringes or (
            "crossed" if rig.sequence.crossed_frames else fringe_direction(rig)
        )
        if not 1 <= given.members <= MEMBERS:
            raise PredictionError(f"{self.name} --members {given.members}: expected 1 to {MEMBERS}")
        names = [given.weights] if given.weights else list(NETWORKS)
        files = [
            name if isinstance(name, WeightsFile) else load_net(name)
            for name in names[: given.members]
        ]
        networks = [file.network for file in files]
        self.weights_config = config = files[0].config
        self.parameters = sum(p.numel() for network in networks for p in network.parameters())
        self.rig, self.threads = rig, given.threads
        limits = EVEN if given.even_odds else WIDE
        other_pitch: dict[str, float] = {}
        audited: dict[str, bool] = {}
        if fringes == "crossed":
            self.frames_used = frames_of(rig, f"{self.name} --fringes crossed")
            pair = TwoCarriers(rig, Settings(min_confidence=given.min_confidence))
            carriers = pair.carriers
            both = Fringes(networks, Warp.of(carriers.step_rad, signs_of(carriers.gain)), limits)
            self.route = route = two_carriers(pair, PairPart(both).before, PairPart.after)
            audited = self.use_audit(route, given.audit, given.anyway)
        else:
            if given.audit or given.anyway:
                raise PredictionError(f"{self.name} --audit needs a frame of two carriers")
            other_pitch = pitch_setting(rig, fringes)
            model = OneCarrier(rig, Settings(fringes, min_confidence=given.min_confidence))
            line = Fringes(networks, Warp.of(*steps_and_signs(model.rig, model.layer)), limits)
            self.route = one_carrier(model, LinePart(line, model).before, LinePart.after)
            self.frames_used = (rig.sequence.sinusoids(fringes)[0],)
            self.caution = model.caution
        more = "" if config.name in shipped_names(SHIPPED) else f" ({config.name})"
        count = "one network" if len(networks) == 1 else f"{len(networks)} networks"
        frame = f"one {fringes} frame{pitch_words(other_pitch)}"
        self.title = f"Wrapped phase and mask of {frame} by {count}; order measured{more}"
        self.title += (EVENLY if given.even_odds else "") + (AUDITED if audited else "")
        hashes = [file.sha256 for file in files]
        self.settings = {
            "fringes": fringes,
            "members": len(networks),
            "weights": config.name,
            "min_confidence": given.min_confidence,
            "threads": given.threads,
            **({"even_odds": True} if given.even_odds else {}),
            **audited,
            "weights_sha256": hashes[0]
            if len(hashes) == 1
            else sha256("".join(hashes).encode()).hexdigest(),
            **other_pitch,
        }

    @property
    def learned_from(self) -> dict[str, Any] | None:
        recipe = self.weights_config.recipe
        rigs = (
            f"training objects before {recipe.get('rigs')} drawn rigs in drawn lights, seed "
            f"{recipe.get('seed')}"
        )
        return {"data": "generated", "versions": [rigs]}

    def images(self, frames: Frames) -> list[NDArray[np.uint8]]:
        images = super().images(frames)
        return [crossed_image(images)] if len(images) > 1 else images

    def measure(self, frames: Frames) -> Measurement:
        from fpp_ml_bench.baselines.networks.base import torch_threads

        with torch_threads(self.threads):
            return super().measure(frames)
