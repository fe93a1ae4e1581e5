"""What a method assumes of the scene, what it was told of the scored samples, and what it learned from."""

from fpp_ml_bench.baselines.method import Assumption
from fpp_ml_bench.baselines.registry import methods
from fpp_ml_bench.leaderboard.row_file import Row

_TOLD_OF = {"range": "depth range", "mask": "object mask", "order": "fringe order"}


def told(track: str) -> str:
    """What the methods of a track are told about the very samples that they are scored on; empty for ``metric``.

    >>> told("oracle range + order")
    "the test sample's depth range and fringe order"
    """
    things = [_TOLD_OF[word] for word in track.removeprefix("oracle ").split(" + ") if word in _TOLD_OF]
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
    """For the row's own page: what the method assumes, and what it was told of the samples that it is scored on."""
    given = told(row.track)
    assumed = _assumption(row)
    return " ".join([*([assumed.sentence] if assumed else []), *([f"Told {given}."] if given else [])])


def learned_from(row: Row) -> str:
    """What data the method learned from, as its submission says; empty where it does not say."""
    said = row.submission.learned_from
    return "" if said is None else str(said.data)
