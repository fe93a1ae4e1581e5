"""A trained network as the methods that are scored: its bare output, and its metric twins; under names of their own."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.model import Model
from fpp_ml_bench.baselines.network_method import NetworkMethod
from fpp_ml_bench.baselines.training.engine import TrainingRun
from fpp_ml_bench.leaderboard.reproduce_plan import Job, Variant


class NamedMethod:
    """``method`` under the name of its row, saying in its settings which training it comes from.

    What else a method offers (``device``, ``parameters``, ``predict_batch``, ``units``) is the method's own.
    """

    def __init__(self, method: Any, title: str, settings: Mapping[str, str | int | float | bool | None]) -> None:
        self._method = method
        self.title = title
        self.settings = {**method.settings, **settings}

    def __getattr__(self, name: str) -> Any:
        if name == "_method":  # asked for before __init__ has run, as copying does
            raise AttributeError(name)
        return getattr(self._method, name)

    def predict(self, frames: Sequence[NDArray[np.uint8] | None]) -> NDArray[np.float32]:
        """See `fpp_ml_bench.baselines.methods.Method.predict`."""
        depth: NDArray[np.float32] = self._method.predict(frames)
        return depth


def named_method(job: Job, variant: Variant, model: Model, run: TrainingRun) -> NamedMethod:
    """The method of one row of ``job``, whose training was ``run``."""
    recipe = job.recipe
    method = NetworkMethod(model, variant.depth_range)
    about: dict[str, str | int | float | bool | None] = {
        "recipe_digest": recipe.digest,
        "epochs_trained": run.epochs,
        "training_seconds": round(run.seconds, 1),
    }
    return NamedMethod(method, f"{method.title} ({recipe.preset} preset)", about)
