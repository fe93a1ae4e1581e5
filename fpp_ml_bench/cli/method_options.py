"""Which method, and its settings: the same for ``predict`` and ``time``."""

import argparse
import sys
from pathlib import Path
from typing import Any, Protocol

from fpp_ml_bench import baselines, decoding, optics
from fpp_ml_bench.baselines import networks, training
from fpp_ml_bench.errors import PredictionError, RecipeError, WeightsError
from fpp_ml_bench.loaders import render, storage

METHOD_HELP = (
    "classical (N-step phase, Gray-code order, triangulation), classical-net (the same; noise and missed pixels "
    "learned), phase (one fringe or a few, nothing learned), phase-net "
    "(single-shot phase; order, mask and correction learned), crossed (one frame with two fringe directions, or three, "
    "nothing learned), crossed-net (one frame, with order, mask and correction learned), constant (looks at nothing), "
    "nearest (depth of the training sample with the nearest image), the name of weights that come with the package, a "
    ".safetensors file, or a recipe that fpp-bench reproduce has trained (loss/l1)"
)
_OPTIONS: dict[str, tuple[str, ...]] = {
    "classical": ("steps", "direction", "fewest", "depth_noise"),
    "classical-net": ("steps", "direction", "weights"),
    "phase": (
        "fringe",
        "frames",
        "error_mm",
        "prior",
        "no_shading",
        "min_confidence",
        "white_grey",
        "ambient_grey",
        "mask",
    ),
    "phase-net": ("fringe", "albedo", "min_confidence", "weights", "white_grey", "ambient_grey"),
    "crossed": ("frames", "min_confidence", "mask"),
    "crossed-net": ("min_confidence", "weights"),
    "constant": ("at",),
    "nearest": ("training",),
    "trained networks": ("depth_range", "frame", "device"),
}
"""Options that belong to one kind of method only, by their name in the parsed arguments."""
_SHARED = "min_confidence", "white_grey", "ambient_grey"
"""Options that phase and phase-net have as they are."""


def add_method_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--threads`` and the options of each kind of method."""
    parser.add_argument("--threads", type=int, default=1, metavar="N", help="threads a sample (default: 1)")
    add = parser.add_argument_group("classical and classical-net").add_argument
    add(
        "--steps",
        type=int,
        metavar="N",
        help="phase steps a direction, 3 to 18, with Gray code (default: all; classical-net: 3)",
    )
    add(
        "--direction",
        choices=("horizontal", "vertical", "both"),
        help="fringes to use: one direction is enough for a depth (default: all that the rig codes)",
    )
    add(
        "--fewest",
        action="store_const",
        const=True,
        help="capture only the Gray frames that the rig's range needs: with both directions usually none",
    )
    add(
        "--depth-noise",
        type=float,
        metavar="MM",
        help="the fewest steps whose depth noise at the far end of the range is at most this (instead of --steps)",
    )
    add = parser.add_argument_group("phase, phase-net, crossed and crossed-net").add_argument
    add("--fringe", choices=("horizontal", "vertical"), help="direction of the fringes (default: horizontal)")
    add(
        "--frames",
        type=int,
        metavar="N",
        help="fringes of that direction, 1 to 18; no Gray code; of crossed 1 or 3 (default: 1)",
    )
    add(
        "--error-mm",
        type=float,
        metavar="MM",
        help="instead of --frames: for each scene the fewest frames whose expected error is at most this, starting "
        "with a single fringe; may need the Gray code",
    )
    add(
        "--prior",
        choices=("none", "standoff"),
        help="standoff: assume that objects are near the rig's standoff, true of fixed placement (default: none)",
    )
    add("--no-shading", action="store_const", const=True, help="phase: choose the fringe order without brightness")
    add(
        "--albedo",
        choices=("one", "any"),
        help="phase-net: one, where all surfaces have the background's albedo, so that brightness tells the order, or "
        "any, where the order is ambiguous unless range and shape tell it (default: one)",
    )
    add("--min-confidence", type=float, metavar="C", help="mask pixels of less confidence, 0 to 1 (default: 0, dense)")
    add(
        "--white-grey",
        type=float,
        metavar="GREY",
        help="for images without a lit background: grey level of a white pattern on a surface that faces the projector "
        "at the near end of the working range",
    )
    add(
        "--ambient-grey",
        type=float,
        metavar="GREY",
        help="for images without a lit background: grey level of a surface in ambient light alone (default: the "
        "image's darkest)",
    )
    add(
        "--mask",
        metavar="FILE",
        help="object mask of phase or crossed: an image of the frames' size, above 0 on the object in every sample "
        "(default: found in each image)",
    )
    add(
        "--weights",
        metavar="FILE",
        help="weights of classical-net, phase-net or crossed-net: a file, such as training writes (default: those that "
        "come with the package)",
    )
    add = parser.add_argument_group("constant").add_argument
    add(
        "--at",
        metavar="DEPTH",
        help="standoff, middle (of the working range), training-mean, or mm; range-middle or "
        "range-training: a share of the sample's depth range, which it is given (default: standoff)",
    )
    add = parser.add_argument_group("nearest").add_argument
    add("--training", type=Path, metavar="FOLDER", help="dataset with the training split (default: DATASET itself)")
    add = parser.add_argument_group("trained networks").add_argument
    add(
        "--range",
        dest="depth_range",
        choices=("oracle", "predicted", "mean"),
        help="depth range of an individually normalised network: the test sample's own (oracle track), predicted from "
        "the image, or the training set's mean (default: predicted where the weights can, else oracle)",
    )
    add("--frame", type=int, metavar="N", help="frame to take (default: the first it was trained on)")
    add("--device", metavar="NAME", help="cpu, cuda, cuda:1 (default: cuda where there is one)")


class Photographed(Protocol):
    """What a method is chosen for: a dataset, or images of a rig that are not stored."""

    @property
    def path(self) -> Path: ...
    @property
    def rig(self) -> "optics.Rig": ...
    @property
    def size(self) -> tuple[int, int]: ...
    @property
    def sequence(self) -> "optics.AnySequence": ...
    @property
    def manifest(self) -> "storage.Manifest": ...


def chosen_method(args: argparse.Namespace, opened: Photographed, warn: bool = True) -> "baselines.Method":
    """The method that ``args`` name, for the rig of ``opened``. Unless told not to, warns on standard error about
    weights that were trained on another version of the dataset's benchmark. Raises FppBenchError for an unknown method,
    and for an option that belongs to another one."""
    if args.threads < 1:
        raise PredictionError(f"--threads {args.threads}: expected 1 or more")
    maker = _MAKERS.get(args.method)
    weights = None if maker else _weights(args.method, opened.size[1])
    own = _OPTIONS[args.method if maker else "trained networks"]
    for owner, options in _OPTIONS.items():
        foreign = [option for option in options if getattr(args, option) is not None and option not in own]
        if foreign:
            flag = "range" if foreign[0] == "depth_range" else foreign[0].replace("_", "-")
            raise PredictionError(f"--{flag} is an option of {owner}, not of {args.method}; leave it out")
    if weights is not None:
        method = _network(weights, args, opened)
    else:
        method = baselines.load_method(args.method, opened.rig, **_MAKERS[args.method](args, opened))
    config = method.weights_config
    warning = None if config is None else training.training_data_warning(config, opened.manifest)
    if warn and config is not None and warning is not None:
        print(f"warning: {config.name} was {warning}", file=sys.stderr)
    return method


def weights_of_recipe(recipe: str, size: int) -> Path:
    """The weights that ``fpp-bench reproduce`` left of ``recipe`` below ``runs/``, by the preset of images ``size`` px
    wide. Raises FppBenchError where there are none."""
    from fpp_ml_bench.baselines.reproduce import RUNS, Folders, current_weights

    resolved = [training.load_recipe(recipe, preset) for preset in training.PRESETS]
    searched = []
    for candidate in resolved:
        below = RUNS / candidate.preset
        weights = current_weights(candidate, Folders(candidate.preset, below, below / "rows"))
        if weights is not None and candidate.size == size:
            return weights
        searched.append(f"{below / candidate.name} ({candidate.size} px)")
    raise RecipeError(
        f"{recipe}: no finished training of it for images of {size} px, looked for {' and '.join(searched)}; train it "
        "with fpp-bench reproduce (or fpp-bench train, and give the .safetensors file that it names)"
    )


def _weights(name: str, size: int) -> Path:
    """The weights file that METHOD means, where it is no method of its own."""
    row_of_a_table = name.split("/")[0] in training.TABLES and not name.endswith(training.SUFFIX)
    if name.endswith((".yaml", ".yml")) or row_of_a_table:
        return weights_of_recipe(name, size)
    return baselines.known_weights(name)


def _network(path: Path, args: argparse.Namespace, opened: Photographed) -> "baselines.Method":
    model = networks.load(path, args.device)
    if model.config.image_size != opened.size:
        trained_at, here = (f"{height}x{width}" for height, width in (model.config.image_size, opened.size))
        raise WeightsError(
            f"{path}: was trained at {trained_at} px (H x W), {opened.path} has images of {here} px: "
            "the fringe period in px depends on the size, so a network works at one size only; use weights trained "
            "at that size, or a dataset built at the weights' size"
        )
    return networks.NetworkMethod(model, args.depth_range, args.frame, args.threads, opened.sequence)


def _classical(args: argparse.Namespace, opened: Photographed) -> dict[str, Any]:
    steps = args.steps if args.depth_noise is None else _steps_for(args, opened)
    return _given(direction=args.direction or "both", steps=steps, threads=args.threads, fewest=args.fewest)


def _steps_for(args: argparse.Namespace, opened: Photographed) -> int:
    """Steps for ``--depth-noise``, by the light and the camera that the dataset was built with."""
    from fpp_ml_bench.schema import validate

    depth_noise_mm = args.depth_noise
    described = opened.manifest.settings.get("light")
    if args.steps is not None or not (depth_noise_mm > 0 and depth_noise_mm < float("inf")):
        raise PredictionError(f"--depth-noise {depth_noise_mm:g}: expected mm above 0, and not together with --steps")
    if not isinstance(described, dict):
        raise PredictionError("--depth-noise: this dataset does not say how noisy its frames are; give --steps")
    light = validate(render.Light, described, opened.path / "manifest.json", "light", PredictionError)
    far_mm = opened.rig.working_range_mm[1]
    modulation = render.modulation_at(opened.rig, far_mm, light)
    noise_grey = render.fringe_noise_at(opened.rig, far_mm, light)
    steps = decoding.fewest_steps(opened.rig, args.direction or "both", depth_noise_mm, modulation, noise_grey)
    if steps is None:
        raise PredictionError(
            f"--depth-noise {depth_noise_mm:g}: more noise remains even with all {opened.sequence.steps} steps that "
            "were captured; allow more noise, or use both directions"
        )
    return steps


def _classical_net(args: argparse.Namespace, opened: Photographed) -> dict[str, Any]:
    return _given(direction=args.direction, steps=args.steps, weights=args.weights, threads=args.threads)


def _phase(args: argparse.Namespace, opened: Photographed) -> dict[str, Any]:
    if args.frames is not None and args.error_mm is not None:
        raise PredictionError("--frames and --error-mm: give one of them; --error-mm chooses the frames itself")
    options = {name: getattr(args, name) for name in ("prior", "frames", "error_mm", "mask", *_SHARED)}
    return _given(direction=args.fringe, shading=None if args.no_shading is None else False, **options)


def _phase_net(args: argparse.Namespace, opened: Photographed) -> dict[str, Any]:
    options = {name: getattr(args, name) for name in ("threads", "weights", "albedo", *_SHARED)}
    return _given(direction=args.fringe, **options)


def _crossed(args: argparse.Namespace, opened: Photographed) -> dict[str, Any]:
    return _given(frames=args.frames, min_confidence=args.min_confidence, mask=args.mask)


def _crossed_net(args: argparse.Namespace, opened: Photographed) -> dict[str, Any]:
    return _given(min_confidence=args.min_confidence, weights=args.weights, threads=args.threads)


def _given(**options: Any) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None}


def _constant(args: argparse.Namespace, opened: Photographed) -> dict[str, Any]:
    return _given(at=args.at)


def _nearest(args: argparse.Namespace, opened: Photographed) -> dict[str, Any]:
    own = opened if isinstance(opened, storage.DatasetFolder) else None
    return {"training": args.training or own}


_MAKERS = {
    "classical": _classical,
    "classical-net": _classical_net,
    "phase": _phase,
    "phase-net": _phase_net,
    "crossed": _crossed,
    "crossed-net": _crossed_net,
    "constant": _constant,
    "nearest": _nearest,
}
