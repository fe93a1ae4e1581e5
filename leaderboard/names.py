"""Words about a table's rows: short names, what a method assumes of the scene, what it was given of the scored samples,
and what it learned from. Rows of this package's methods get their short names from the method's settings; every other
submission keeps its own name, cut at a word."""

from collections.abc import Collection, Sequence

from fpp_ml_bench.baselines.method import Assumption
from fpp_ml_bench.baselines.registry import methods, network_method
from fpp_ml_bench.evaluation.submission.description import Submission
from fpp_ml_bench.files import printable
from fpp_ml_bench.leaderboard.row_file import Row, name_key

LONGEST_NAME = 36
"""Characters of a short name."""


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
    method = methods().get(submission.method, network_method())
    for maker in (method, network_method()):
        try:
            name = maker.short_name(submission)
        except (KeyError, TypeError, ValueError):  # settings that the package's methods do not write
            return None
        if name is not None:
            return name if len(name) <= LONGEST_NAME else None
    return None


_TRUTH_NAMES = {"range": "depth range", "mask": "object mask", "order": "fringe order"}


def given_truth(track: str) -> str:
    """The ground truth of the scored samples that the methods of a track are given; empty for ``metric``.

    >>> given_truth("oracle range + order")
    "the test sample's depth range and fringe order"
    """
    things = [_TRUTH_NAMES[word] for word in track.removeprefix("oracle ").split(" + ") if word in _TRUTH_NAMES]
    if not things:
        return ""
    return "the test sample's " + " and ".join(filter(None, (", ".join(things[:-1]), things[-1])))


def _assumption(row: Row) -> Assumption | None:
    method = methods().get(row.submission.method)
    return None if method is None else method.assumption(row.submission.settings)


def assumption(row: Row) -> str:
    """In a few words; empty where a method assumes nothing of the scene, or is not of this package."""
    assumed = _assumption(row)
    return "" if assumed is None else assumed.words


def assumption_sentences(row: Row) -> str:
    """For the row's own page: what the method assumes, and what it was given of the samples that it is scored on."""
    given = given_truth(row.track)
    assumed = _assumption(row)
    return " ".join([*([assumed.sentence] if assumed else []), *([f"Given {given}."] if given else [])])


def learned_from(row: Row) -> str:
    """What data the method learned from, as its submission says; empty where it does not say."""
    said = row.submission.learned_from
    return "" if said is None else str(said.data)
