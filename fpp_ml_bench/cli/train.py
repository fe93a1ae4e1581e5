"""``fpp-bench train``: one recipe, one weights file."""

import argparse
from pathlib import Path
from typing import Any

from fpp_ml_bench.baselines import classical_network, crossed_network, networks, phase_network, training
from fpp_ml_bench.cli import CHECK_FAILED
from fpp_ml_bench.errors import RecipeError
from fpp_ml_bench.machine import usable_cores

SUMMARY = "Train one recipe, a shipped one or a YAML file of yours, into a weights file that predict takes."
EXAMPLES = (
    "fpp-bench train loss/hybrid_l1_0.7 data/cpu224 --out runs/mine",
    "fpp-bench train phase-net --out runs/phase-net      the network of the phase route; it renders its own views",
    "fpp-bench train phase-net --albedo any --out runs/phase-net-any      without brightness",
    "fpp-bench train crossed-net --out runs/crossed-net      the network of crossed fringes; the same",
    "fpp-bench train classical-net --out runs/classical-net      noise and missed pixels of three steps; the same",
    "fpp-bench train mine.yaml data/full --preset paper --out runs/big --minutes 10     in pieces",
    "accelerate launch -m fpp_ml_bench train mine.yaml data/full --preset paper --out runs/big      several GPUs",
    "fpp-bench predict runs/mine/model.safetensors data/cpu224 --out predictions",
)
_OPTIONS = "steps", "unions", "rate", "lights", "albedo", "start"  # of those that render their own views
_OWN_VIEWS = "classical-net", "phase-net", "crossed-net"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "recipe",
        metavar="RECIPE",
        help=f"a name like loss/l1 (fpp-bench reproduce --list), a .yaml, or {', '.join(_OWN_VIEWS)}",
    )
    add(
        "dataset",
        type=Path,
        metavar="DATASET",
        nargs="?",
        help="dataset folder, of the preset's image size (those three: none)",
    )
    add("--out", type=Path, required=True, metavar="DIR", help="new folder, or that of a training to resume")
    add("--preset", choices=training.PRESETS, default="cpu", help="what a shipped recipe is scaled to (default: cpu)")
    add(
        "--minutes",
        type=float,
        metavar="M",
        help="stop before an epoch that would not finish in time, everything saved",
    )
    add("--steps", type=int, metavar="N", help="those three: training steps (default: as the shipped weights)")
    add(
        "--unions",
        type=int,
        metavar="N",
        help="the same: images that join several objects, made from each sample (default: as the shipped weights)",
    )
    add("--lights", type=int, metavar="N", help="the same: lights that are drawn (default: as the shipped weights)")
    add("--rate", type=float, metavar="R", help="the same: largest learning rate (default: as the shipped weights)")
    add(
        "--albedo",
        choices=("one", "any"),
        help="phase-net: one, with brightness as a cue for the order, or any, without (default: one)",
    )
    add("--start", type=Path, metavar="FILE", help="phase-net: weights to start from (default: none)")


def run(args: argparse.Namespace) -> int:
    """Train, add range heads where the weights need them, and print the result. Raises FppBenchError."""
    if args.minutes is not None and not 0 < args.minutes < 1e6:
        raise RecipeError(f"--minutes {args.minutes}: expected a number above 0")
    if args.recipe in _OWN_VIEWS:
        import cv2

        if args.dataset is not None:
            raise RecipeError(
                f"{args.dataset}: {args.recipe} renders what it learns from, and takes none; leave it out"
            )
        cv2.setNumThreads(1)
        train = dict(zip(_OWN_VIEWS, (_classical_net, _phase_net, _crossed_net), strict=True))[args.recipe]
        return train(args)
    if args.dataset is None:
        raise RecipeError(f"{args.recipe}: expected a dataset folder to train on, got none")
    _given(args)
    from accelerate import PartialState

    recipe = training.load_recipe(args.recipe, args.preset)
    trained = training.train(recipe, args.dataset, args.out, minutes=args.minutes)
    if not PartialState().is_main_process:
        return 0 if trained.finished else CHECK_FAILED
    if not trained.finished:
        print(f"{args.out}: stopped after {trained.epochs} epochs, everything saved; run the same command to resume")
        return CHECK_FAILED
    weights = trained.weights
    if recipe.normalisation == "individual" and not recipe.background_removed:
        weights = args.out / "model.safetensors"
        networks.save_with_heads(trained.weights, args.dataset, weights)
    print(f"{weights}: {recipe.title}, epoch {trained.best_epoch} of {trained.epochs}, {trained.seconds:.0f} s")
    print(f"curve: {trained.curve}")
    print(f"next: fpp-bench predict {weights} {args.dataset} --out predictions")
    return 0


def _phase_net(args: argparse.Namespace) -> int:
    recipe = phase_network.Recipe(**_given(args, "steps", "unions", "rate", "lights", "albedo", "start"))
    trained = phase_network.train_phase_net(
        recipe,
        args.out,
        start=args.start,
        minutes=args.minutes,
        workers=usable_cores(),
        show=True,
        print_line=print,
    )
    return _window_training_said(args, recipe.steps, trained)


def _classical_net(args: argparse.Namespace) -> int:
    recipe = classical_network.FilterRecipe(**_given(args, "steps", "unions", "rate", "lights"))
    trained = classical_network.train_classical_net(
        recipe,
        args.out,
        minutes=args.minutes,
        workers=usable_cores(),
        show=True,
        print_line=print,
    )
    return _window_training_said(args, recipe.steps, trained)


def _crossed_net(args: argparse.Namespace) -> int:
    recipe = crossed_network.CrossedRecipe(**_given(args, "steps", "unions", "rate", "lights"))
    trained = crossed_network.train_crossed_net(
        recipe,
        args.out,
        minutes=args.minutes,
        workers=usable_cores(),
        show=True,
        print_line=print,
    )
    return _window_training_said(args, recipe.steps, trained)


def _given(args: argparse.Namespace, *names: str) -> dict[str, Any]:
    """The options that were given; the others are refused."""
    for option in _OPTIONS:
        if option not in names and getattr(args, option) is not None:
            raise RecipeError(f"--{option} is no option of {args.recipe}; leave it out")
    return {name: getattr(args, name) for name in names if name != "start" and getattr(args, name) is not None}


def _window_training_said(args: argparse.Namespace, steps: int, trained: "phase_network.Trained") -> int:
    """Print how a training of windows ended; the exit status."""
    if trained.weights is None:
        done = f"{trained.steps} of {steps} steps"
        print(f"{args.out}: stopped after {done}, all saved; run the same command to resume")
        return CHECK_FAILED
    scores = ", ".join(f"{key} {value:.3g}" for key, value in trained.validation.items())
    print(f"{trained.weights}: {trained.steps} steps, mask threshold {trained.threshold:g}; validation: {scores}")
    print(f"next: fpp-bench predict {args.recipe} DATASET --weights {trained.weights} --out predictions")
    return 0
