"""What a method assumes of the scene, what it was told of the scored samples, and what it learned from."""

from fpp_ml_bench.leaderboard.row_file import Row

_TOLD_OF = {"range": "depth range", "mask": "object mask", "order": "fringe order"}
ASSUMED, ASSUMED_BY_ANY = "one albedo, a lit background", "a lit background"
_ASSUMES = {
    ASSUMED: "Assumes one albedo for all surfaces and a lit background, which shows how strong the lamp is: the "
    "brightness of the fringe image decides the fringe order.",
    ASSUMED_BY_ANY: "Assumes a lit background; not one albedo, so that little tells the fringe order.",
}
"""What the phase route and the learned one assume, in few words and as a sentence; the second with ``shading`` off."""


def told(track: str) -> str:
    """What the methods of a track are told about the very samples that they are scored on; empty for ``metric``.

    >>> told("oracle range + order")
    "the test sample's depth range and fringe order"
    """
    things = [_TOLD_OF[word] for word in track.removeprefix("oracle ").split(" + ") if word in _TOLD_OF]
    if not things:
        return ""
    return "the test sample's " + " and ".join(filter(None, (", ".join(things[:-1]), things[-1])))


def assumption(row: Row) -> str:
    """In a few words; empty where a method assumes nothing of the scene, or is not of this package."""
    method, shading = row.submission.method, row.submission.settings.get("shading")
    if method in ("phase", "phase-net") and shading is True:
        return ASSUMED
    return ASSUMED_BY_ANY if method == "phase-net" and shading is False else ""


def assumption_sentences(row: Row) -> str:
    """For the row's own page: what the method assumes, and what it was told of the samples that it is scored on."""
    given = told(row.track)
    assumed = assumption(row)
    return " ".join([*([_ASSUMES[assumed]] if assumed else []), *([f"Told {given}."] if given else [])])


def learned_from(row: Row) -> str:
    """What data the method learned from, as its submission says; empty where it does not say."""
    said = row.submission.learned_from
    return "" if said is None else str(said.data)
