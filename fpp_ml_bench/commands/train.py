"""``fpp-bench train``: one recipe, one weights file."""

import argparse
from pathlib import Path

from fpp_ml_bench.baselines.training.tables import PRESETS

SUMMARY = "Train one recipe, a shipped one or a YAML file of yours, into a weights file that predict takes."
EXAMPLES = (
    "fpp-bench train loss/hybrid_l1_0.7 data/cpu224 --out runs/mine",
    "fpp-bench train phase-net data/full --out runs/phase-net      the network of the phase route",
    "fpp-bench train mine.yaml data/full --preset paper --out runs/big --minutes 10     in pieces",
    "accelerate launch -m fpp_ml_bench train mine.yaml data/full --preset paper --out runs/big      several GPUs",
    "fpp-bench predict runs/mine/model.safetensors data/cpu224 --out predictions",
)
MODEL = "model.safetensors"
PHASE_NET = "phase-net"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recipe", metavar="RECIPE", help="a name like loss/l1 (fpp-bench reproduce --list), a .yaml, or phase-net"
    )
    parser.add_argument("dataset", type=Path, metavar="DATASET", help="dataset folder, of the preset's image size")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="new folder, or one to go on with")
    parser.add_argument(
        "--preset", choices=PRESETS, default="cpu", help="what a shipped recipe is scaled to (default: cpu)"
    )
    parser.add_argument(
        "--minutes", type=float, metavar="M", help="stop before an epoch that would outlast them, everything saved"
    )
    parser.add_argument(
        "--extra",
        type=Path,
        metavar="DATASET",
        help="phase-net: a dataset whose training split is learned from besides",
    )
    parser.add_argument("--steps", type=int, metavar="N", help="phase-net: how long (default: as the shipped weights)")
    parser.add_argument(
        "--unions",
        type=int,
        metavar="N",
        help="phase-net: unions of objects for every sample (default: as for --steps)",
    )
    parser.add_argument(
        "--rate", type=float, metavar="R", help="phase-net: largest learning rate (default: as the shipped weights)"
    )
    parser.add_argument("--start", type=Path, metavar="FILE", help="phase-net: weights to start from (default: none)")


def run(args: argparse.Namespace) -> int:
    """Train, make the weights usable on their own, say what came out. Raises FppBenchError for what can't be done."""
    from accelerate import PartialState

    from fpp_ml_bench.baselines.range_heads import save_with_heads
    from fpp_ml_bench.baselines.training.engine import train
    from fpp_ml_bench.baselines.training.recipe import load_recipe
    from fpp_ml_bench.commands import CHECK_FAILED
    from fpp_ml_bench.errors import RecipeError

    if args.minutes is not None and not 0 < args.minutes < 1e6:
        raise RecipeError(f"--minutes {args.minutes}: expected a number above 0")
    if args.recipe == PHASE_NET:
        return _phase_net(args)
    for option in ("extra", "start", "steps", "unions", "rate"):
        if getattr(args, option) is not None:
            raise RecipeError(f"--{option} is an option of phase-net; leave it out")
    recipe = load_recipe(args.recipe, args.preset)
    done = train(recipe, args.dataset, args.out, minutes=args.minutes)
    if not PartialState().is_main_process:
        return 0 if done.finished else CHECK_FAILED
    if not done.finished:
        print(f"{args.out}: stopped after {done.epochs} epochs, everything saved; the same command goes on")
        return CHECK_FAILED
    weights = done.weights
    if recipe.normalisation == "individual" and not recipe.background_removed:
        weights = args.out / MODEL
        save_with_heads(done.weights, args.dataset, weights)
    print(f"{weights}: {recipe.title}, epoch {done.best_epoch} of {done.epochs}, {done.seconds:.0f} s")
    print(f"curve: {done.curve}")
    print(f"next: fpp-bench predict {weights} {args.dataset} --out predictions")
    return 0


def _phase_net(args: argparse.Namespace) -> int:
    from fpp_ml_bench.baselines.phase_network.recipe import Recipe
    from fpp_ml_bench.baselines.phase_network.trainer import train_phase_net
    from fpp_ml_bench.commands import CHECK_FAILED
    from fpp_ml_bench.commands.console import progress_bar

    chosen = {name: getattr(args, name) for name in ("steps", "unions", "rate") if getattr(args, name) is not None}
    recipe = Recipe(**chosen)
    done = train_phase_net(recipe, args.dataset, args.out, args.minutes, progress_bar, print, args.extra, args.start)
    if done.weights is None:
        print(f"{args.out}: stopped after {done.steps} of {recipe.steps} steps, all saved; the same command goes on")
        return CHECK_FAILED
    scores = ", ".join(f"{key} {value:.3g}" for key, value in done.validation.items())
    print(f"{done.weights}: {done.steps} steps, mask threshold {done.threshold:g}; validation: {scores}")
    print(f"next: fpp-bench predict phase-net {args.dataset} --weights {done.weights} --out predictions")
    return 0
