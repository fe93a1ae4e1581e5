"""``fpp-bench train``: one recipe, one weights file."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fpp_ml_bench.baselines import networks, registry, training
from fpp_ml_bench.cli import CHECK_FAILED, OK
from fpp_ml_bench.cli.methods import MethodCommand, options_given
from fpp_ml_bench.cli.options import MINUTES, command
from fpp_ml_bench.errors import RecipeError
from fpp_ml_bench.options import REQUIRED, argument, did_you_mean, nearest, option


@dataclass(frozen=True, kw_only=True)
class TrainSettings:
    """Settings of `train`. ``of_method``: the text of the options of a method's training by their flags."""

    recipe: str = argument(
        "a name like loss/l1 (fpp-bench reproduce --list), a .yaml, or one of the methods below", "RECIPE"
    )
    dataset: Path | None = argument("dataset folder, of the preset's image size (those methods: none)", "DATASET", None)
    out: Path = option(REQUIRED, "new folder, or that of a training to resume", "DIR")
    preset: str = option("cpu", "what a shipped recipe is scaled to (default: cpu)", choices=training.PRESETS)
    minutes: float | None = option(
        None, "stop before an epoch that would not finish in time, everything saved", "M", parse=MINUTES
    )
    of_method: Mapping[str, Any] = field(default_factory=dict)


class TrainCommand(MethodCommand):
    """A command whose options are also those of the trainings that methods have."""

    part = "Training"


@command(
    """\
fpp-bench train loss/hybrid_l1_0.7 data/cpu224 --out runs/mine
fpp-bench train phase-net --out runs/phase-net      the network of the phase route; it renders its own views
fpp-bench train phase-net --albedo any --out runs/phase-net-any      without brightness
fpp-bench train crossed-net --out runs/crossed-net      the network of crossed fringes; the same
fpp-bench train classical-net --out runs/classical-net      noise and missed pixels of three steps; the same
fpp-bench train mine.yaml data/full --preset paper --out runs/big --minutes 10     in pieces
accelerate launch -m fpp_ml_bench train mine.yaml data/full --preset paper --out runs/big      several GPUs
fpp-bench predict runs/mine/model.safetensors data/cpu224 --out predictions
""",
    TrainCommand,
)
def train(settings: TrainSettings) -> int:
    """Train one recipe, a shipped one or a YAML file of yours, into a weights file that predict takes.

    Adds range heads where the weights need them, and prints the result. Raises FppBenchError."""
    name, methods = settings.recipe, registry.methods()
    if name in methods or registry.FILE_MARK in name:
        return OK if _train_method(settings) else CHECK_FAILED
    options_given(registry.network_method(), "Training", settings.of_method, name)
    if not Path(name).exists() and nearest(name, methods):
        raise RecipeError(f"no recipe {name!r}; {did_you_mean(name, methods)}")
    if settings.dataset is None:
        raise RecipeError(f"{name}: expected a dataset folder to train on, got none")
    from accelerate import PartialState

    recipe = training.load_recipe(settings.recipe, settings.preset)
    trained = training.train(recipe, settings.dataset, settings.out, minutes=settings.minutes)
    if not PartialState().is_main_process:
        return OK if trained.finished else CHECK_FAILED
    if not trained.finished:
        print(
            f"{settings.out}: stopped after {trained.epochs} epochs, everything saved; run the same command to resume"
        )
        return CHECK_FAILED
    weights = trained.weights
    if recipe.normalisation == "individual" and not recipe.background_removed:
        weights = settings.out / "model.safetensors"
        networks.save_with_heads(trained.weights, settings.dataset, weights)
    print(f"{weights}: {recipe.title}, epoch {trained.best_epoch} of {trained.epochs}, {trained.seconds:.0f} s")
    print(f"curve: {trained.curve}")
    print(f"next: fpp-bench predict {weights} {settings.dataset} --out predictions")
    return OK


def _train_method(settings: TrainSettings) -> bool:
    """Train a method that renders what it learns from; whether it has finished."""
    method = registry.find(settings.recipe).method
    if method.Training is None:
        learned = ", ".join(name for name, other in registry.methods().items() if other.Training)
        raise RecipeError(f"{settings.recipe}: there is nothing to train; methods with a training: {learned}")
    if settings.dataset is not None:
        raise RecipeError(
            f"{settings.dataset}: {settings.recipe} renders what it learns from, and takes none; leave it out"
        )
    import cv2

    cv2.setNumThreads(1)
    options = options_given(method, "Training", settings.of_method, settings.recipe)
    return method.train(method.Training(**options), settings.out, settings.minutes)
