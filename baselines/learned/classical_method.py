"""classical-net as a method of ``fpp-bench predict``: classical frames, averaged and filled by a small network."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.classical import DIRECTIONS, ClassicalMethod
from fpp_ml_bench.baselines.learned.method import WEIGHTS, LearnedMethod
from fpp_ml_bench.baselines.method import Answer, Frames
from fpp_ml_bench.coding.phase_shift import PhaseShift
from fpp_ml_bench.decoding.decode import Directions
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.files import printable
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.options import option

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.learned.window_training import StepRecipe
    from fpp_ml_bench.evaluation.submission.description import Submission

SHIPPED = Path(__file__).resolve().parent / "weights"  # folder of the weights that come with the package
DEFAULT = "classical-net"
STEPS = 3
"""Phase steps where a rig's code leaves the choice and no others are asked for: noise is what it takes away."""


@dataclass(frozen=True)
class ClassicalNetOptions:
    """Options of `ClassicalNetMethod`."""

    direction: Directions | None = option(
        None, "fringes to use (default: those that the weights learned)", choices=DIRECTIONS
    )
    steps: int | None = option(None, "phase steps a direction, 3 to 18, with Gray code (default: 3)", "N")
    weights: str | Path = option(DEFAULT, WEIGHTS, "FILE")
    threads: int = 1


class ClassicalNetMethod(LearnedMethod):
    """`ClassicalMethod` of one ``direction`` (default: the one it learned) and ``steps`` (default: 3). The weights
    ``weights`` (a shipped name or a file) average its depth over neighbours, by at most three stated standard
    uncertainties, and fill it where it has none. Raises `WeightsError` for weights that can't be used, and
    `PredictionError` for a code whose uncertainty is not known."""

    name = "classical-net"
    purpose = "classical frames; noise and missed pixels learned"
    Options = ClassicalNetOptions

    @classmethod
    def recipe(cls, **given: Any) -> "StepRecipe":
        from fpp_ml_bench.baselines.learned.classical_training import FilterRecipe

        return FilterRecipe(**given)

    @classmethod
    def variants(cls, rig: Rig) -> Sequence[Mapping[str, Any]]:
        return [{}] if all(isinstance(rig.code(way), PhaseShift) for way in rig.directions[:1]) else []

    @classmethod
    def short_name(cls, submission: "Submission") -> str | None:
        classical = ClassicalMethod.short_name(submission)
        if classical is None:
            return None
        return printable(submission.settings["weights"]) + classical.removeprefix("Classical")

    def __init__(self, rig: Rig, **options: Any) -> None:
        from fpp_ml_bench.baselines.learned.classical_network import DepthFilter
        from fpp_ml_bench.baselines.learned.network import read_net
        from fpp_ml_bench.baselines.training.weights import FILTER_NETWORKS, weights_path

        given = self.checked_options(options)
        direction, steps, weights, threads = given.direction, given.steps, given.weights, given.threads
        path = weights_path(weights, SHIPPED)
        config, network, digest = read_net(path, DepthFilter, FILTER_NETWORKS)
        self.network = network.folded()
        learned = str(config.recipe.get("direction", "vertical"))
        way: Any = direction or (learned if learned in rig.directions else rig.directions[0])
        codes = [rig.code(one) for one in (rig.directions if way == "both" else (way,))]
        fringes = [code for code in codes if isinstance(code, PhaseShift)]
        if len(fringes) < len(codes):
            raise PredictionError(
                f"{self.name}: needs the uncertainty of every pixel, which {codes[0].title} does not give; use "
                f"{ClassicalMethod.name}"
            )
        if steps is None and all(code.is_plain for code in fringes):
            steps = STEPS
        self.classical = ClassicalMethod(rig, direction=way, steps=steps, threads=threads)
        self.rig, self.threads, self.frames_used = rig, threads, self.classical.frames_used
        self.config = config
        more = "" if config.name == DEFAULT else f" ({config.name})"
        self.title = f"{self.classical.title}; noise and missed pixels learned{more}"
        self.settings = {
            **self.classical.settings,
            **self.use(config, network, digest),
        }

    def predict(self, frames: Frames) -> NDArray[np.float32]:
        return self.answer(frames).depth

    def answer(self, frames: Frames) -> Answer:
        """Depth, and the standard uncertainty that the network expects."""
        from fpp_ml_bench.baselines.learned.classical_route import decided, filtered, written
        from fpp_ml_bench.baselines.learned.classical_scene import DepthScene
        from fpp_ml_bench.baselines.networks.base import torch_threads

        decoded, modulation = self.classical.measure(frames)
        scene = None if decoded.sigma_mm is None else DepthScene.of(decoded.depth, decoded.sigma_mm, modulation)
        if scene is None:
            return decoded
        with torch_threads(self.threads):
            answer = filtered(self.network, scene)
        inside = decided(answer, scene, self.config.threshold)
        inside &= self.rig.in_range(answer.depth_mm + np.float32(scene.middle_mm))
        return Answer(*written(answer, scene, inside, decoded.depth.shape))
