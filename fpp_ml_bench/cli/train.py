"""``fpp-bench train``: one recipe, one weights file."""

from pathlib import Path

from fpp_ml_bench.baselines import networks, registry, training
from fpp_ml_bench.cli import CHECK_FAILED, OK
from fpp_ml_bench.cli.methods import MethodCommand, OfMethods
from fpp_ml_bench.cli.options import MINUTES, command
from fpp_ml_bench.errors import RecipeError
from fpp_ml_bench.options import REQUIRED, argument, did_you_mean, nearest, option


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
def train(
    *,
    recipe: str = argument(
        "a name like loss/l1 (fpp-bench reproduce --list), a .yaml, or one of the methods below", "RECIPE"
    ),
    dataset: Path | None = argument(
        "dataset folder, of the preset's image size (those methods: none)", "DATASET", None
    ),
    out: Path = option(REQUIRED, "new folder, or that of a training to resume", "DIR"),
    preset: str = option("cpu", "what a shipped recipe is scaled to (default: cpu)", choices=training.PRESETS),
    minutes: float | None = option(
        None, "stop before an epoch that would not finish in time, everything saved", "M", parse=MINUTES
    ),
    options: OfMethods,
) -> int:
    """Train one recipe, a shipped one or a YAML file of yours, into a weights file that predict takes.

    Adds range heads where the weights need them, and prints the result. Raises FppBenchError."""
    methods = registry.methods()
    if recipe in methods or registry.FILE_MARK in recipe:
        method = registry.find(recipe).method
        if method.Training is None:
            learned = ", ".join(name for name, other in methods.items() if other.Training)
            raise RecipeError(f"{recipe}: there is nothing to train; methods with a training: {learned}")
        if dataset is not None:
            raise RecipeError(f"{dataset}: {recipe} renders what it learns from, and takes none; leave it out")
        import cv2

        cv2.setNumThreads(1)
        finished = method.train(method.Training(**options.of(method, recipe, "Training")), out, minutes)
        return OK if finished else CHECK_FAILED
    options.of(registry.network_method(), recipe, "Training")
    if not Path(recipe).exists() and nearest(recipe, methods):
        raise RecipeError(f"no recipe {recipe!r}; {did_you_mean(recipe, methods)}")
    if dataset is None:
        raise RecipeError(f"{recipe}: expected a dataset folder to train on, got none")
    from accelerate import PartialState

    resolved = training.load_recipe(recipe, preset)
    trained = training.train(resolved, dataset, out, minutes=minutes)
    if not PartialState().is_main_process:
        return OK if trained.finished else CHECK_FAILED
    if not trained.finished:
        print(f"{out}: stopped after {trained.epochs} epochs, everything saved; run the same command to resume")
        return CHECK_FAILED
    weights = trained.weights
    if resolved.normalisation == "individual" and not resolved.background_removed:
        weights = out / "model.safetensors"
        networks.save_with_heads(trained.weights, dataset, weights)
    print(f"{weights}: {resolved.title}, epoch {trained.best_epoch} of {trained.epochs}, {trained.seconds:.0f} s")
    print(f"curve: {trained.curve}")
    print(f"next: fpp-bench predict {weights} {dataset} --out predictions")
    return OK
