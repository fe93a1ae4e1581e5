"""Short names of a table's rows. Rows of this package's methods get theirs from the method's settings; every other
submission keeps its own name, cut at a word."""

from collections.abc import Collection, Sequence
from operator import index

from fpp_ml_bench.baselines.training import NETWORK_TITLES
from fpp_ml_bench.constants import CONFIGS
from fpp_ml_bench.evaluation.submission import Submission
from fpp_ml_bench.files import printable
from fpp_ml_bench.leaderboard.row_file import name_key

LONGEST_NAME = 36
"""Characters of a short name."""

_DIRECTIONS = ("horizontal", "vertical", "both")
_LOSSES = {"rmse": "RMSE", "l1": "L1", "gan": "GAN"}
_RANGES = {"oracle": "", "mean": "mean range", "predicted": "pred. range", None: ""}
"""By the setting ``depth_range``. That the range was told is the group's track."""
_OPTIONS = {"input standardised": "standardised", "guided by phase": "guided"}
"""A recipe's title and the short name of each option of a network."""


def short_names(submissions: Sequence[Submission], own: Collection[str] = ()) -> list[str]:
    """A short name for each of the ``submissions`` of a group, whose own names differ. The order changes no name. Where
    two would look the same, the later by its own name has a number behind it. Those in ``own``, which only claim to be
    this package's methods, keep their own names, behind all others."""
    derived = {s.name: None if s.name in own else _from_settings(s) for s in submissions}
    chosen: dict[str, str] = {}
    taken: set[str] = set()
    for name in sorted(derived, key=lambda name: (name in own, derived[name] is None, name)):
        short, number = derived[name] or cut_at_word(printable(name)), 1
        candidate = short
        while name_key(candidate) in taken:
            number += 1
            suffix = f" ({number})"
            candidate = cut_at_word(short, LONGEST_NAME - len(suffix)) + suffix
        taken.add(name_key(candidate))
        chosen[name] = candidate
    return [chosen[submission.name] for submission in submissions]


def cut_at_word(text: str, longest: int = LONGEST_NAME) -> str:
    """``text``, or as many of its words as fit into ``longest`` characters with an ellipsis behind them."""
    if len(text) <= longest:
        return text
    words = text[:longest].rpartition(" ")[0].rstrip(" ,;:-+(")
    return (words or text[: longest - 1]) + "…"


def _from_settings(submission: Submission) -> str | None:
    """A name made of the method's settings; None for a submission that is not one of this package's methods."""
    try:
        title, make = _METHODS.get(submission.method, ("", _network))
        name = (make if submission.name.startswith(title) else _network)(submission)
    except (KeyError, TypeError, ValueError):  # settings that the package's methods do not write
        return None
    return name if len(name) <= LONGEST_NAME else None


def _direction(submission: Submission) -> str:
    return _DIRECTIONS[_DIRECTIONS.index(submission.settings["direction"])]  # type: ignore[arg-type]


def _classical(submission: Submission) -> str:
    steps, direction = index(submission.settings["steps"]), _direction(submission)  # type: ignore[arg-type]
    if not submission.settings.get("fewest"):
        return f"Classical {steps}+Gray, {direction}"
    gray = len(submission.frames_used) - steps * (2 if direction == "both" else 1)
    return f"Classical {steps}, {direction}, {f'{gray} Gray' if gray else 'no Gray'}"


def _classical_net(submission: Submission) -> str:
    return printable(submission.settings["weights"]) + _classical(submission).removeprefix("Classical")


def _phase(submission: Submission) -> str:
    settings, direction = submission.settings, _direction(submission)
    if "error_mm" in settings:
        name = f"Phase, fewest {direction}, {float(settings['error_mm'] or 0):g} mm"
    else:
        name = f"Phase, {index(settings['frames'])} {direction}"  # type: ignore[arg-type]
    standoff = settings.get("prior") == "standoff"
    if not settings["shading"]:
        return f"{name}, standoff alone" if standoff else f"{name}, no shading"
    return f"{name}, standoff" if standoff else name


def _phase_net(submission: Submission) -> str:
    settings = submission.settings
    weights, albedo = str(settings["weights"]), settings.get("albedo", "one")
    name = printable(weights.removesuffix(f"-{albedo}-albedo"))
    return f"{name}, 1 {_direction(submission)}" + ("" if settings["shading"] else f", {albedo} albedo")


def _crossed(submission: Submission) -> str:
    frames = {1: "1 frame", 2: "mean of 2"}.get(len(submission.frames_used), f"{len(submission.frames_used)} frames")
    return f"{printable(submission.settings.get('weights', 'Crossed'))}, {frames}"


def _network(submission: Submission) -> str:
    settings = submission.settings
    network = NETWORK_TITLES[str(settings["network"])]
    if not submission.name.startswith(f"{network}, "):
        raise ValueError("a name of its own")
    normalisation = {"individual": "", "raw": " raw", "global": " global"}[str(settings["normalisation"])]
    trained_frames = str(settings["trained_frames"])
    if trained_frames not in CONFIGS:
        raise ValueError("unknown frames")
    frames = {"single_shot": "", "all": " all frames"}.get(trained_frames, f" {trained_frames}")
    loss, _, weight = str(settings["loss"]).partition("_physics_")
    parts = [f"{network}{normalisation} {_loss(loss)}{f' + physics {float(weight):g}' if weight else ''}{frames}"]
    parts += [word for words, word in _OPTIONS.items() if f", {words}" in submission.name]
    parts += ["no background" if settings["background_removed"] else "", _RANGES[settings.get("depth_range")]]  # type: ignore[index]
    return ", ".join(filter(None, parts))


def _loss(label: str) -> str:
    """``hybrid_l1_0.7`` as ``hybrid L1 0.7``; the weight is checked to be a number."""
    kind, _, rest = label.partition("_")
    if kind == "gan" and rest:
        return f"{_LOSSES[kind]} {float(rest):g}"
    if kind == "hybrid":
        loss, _, weight = rest.partition("_")
        return f"hybrid {_LOSSES[loss]} {float(weight):g}"
    return f"masked {_LOSSES[rest]}" if kind == "masked" else _LOSSES[label]


_METHODS = {
    "classical": ("Classical ", _classical),
    "classical-net": ("Classical ", _classical_net),
    "phase": ("Phase route, ", _phase),
    "phase-net": ("Phase route, ", _phase_net),
    "crossed": ("Crossed fringes ", _crossed),
    "crossed-net": ("Crossed fringes, ", _crossed),
}
"""How the names of each method's submissions begin, and what makes the short name."""
