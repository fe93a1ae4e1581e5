"""Which method, and its settings: the same for ``predict`` and ``time``."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fpp_ml_bench import baselines
from fpp_ml_bench.baselines import training
from fpp_ml_bench.errors import PredictionError

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.method import Photographed

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


def chosen_method(args: argparse.Namespace, opened: "Photographed", warn: bool = True) -> "baselines.Method":
    """The method that ``args`` name, for the rig of ``opened``. Unless told not to, warns on standard error about
    weights that were trained on another version of the dataset's benchmark. Raises FppBenchError for an unknown method,
    and for an option that belongs to another one."""
    if args.threads < 1:
        raise PredictionError(f"--threads {args.threads}: expected 1 or more")
    from dataclasses import fields

    from fpp_ml_bench.baselines import registry
    from fpp_ml_bench.options import described

    found = registry.find(args.method)
    own = described(found.method.Options)
    given: dict[str, Any] = {}
    for owner, names in _OPTIONS.items():
        for option in names:
            value = getattr(args, option)
            name = {"fringe": "direction", "no_shading": "shading"}.get(option, option)
            if value is None:
                continue
            if name not in own:
                flag = "range" if option == "depth_range" else option.replace("_", "-")
                raise PredictionError(f"--{flag} is an option of {owner}, not of {args.method}; leave it out")
            given[name] = False if option == "no_shading" else value
    if "frames" in given and "error_mm" in given:
        raise PredictionError("--frames and --error-mm: give one of them; --error-mm chooses the frames itself")
    if "threads" in {entry.name for entry in fields(found.method.Options)}:
        given["threads"] = args.threads
    method = baselines.load_method(args.method, opened, **given)
    config = method.weights_config
    warning = None if config is None else training.training_data_warning(config, opened.manifest)
    if warn and config is not None and warning is not None:
        print(f"warning: {config.name} was {warning}", file=sys.stderr)
    return method
