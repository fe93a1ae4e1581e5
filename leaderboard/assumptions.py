"""What a method of this package assumes, and what its track was told: a score is read together with it."""

from fpp_ml_bench.evaluation.result import Result
from fpp_ml_bench.leaderboard.groups import TOLD

_BRIGHTNESS = (
    "one albedo, known exposure",
    "Assumes one albedo for all surfaces and a known exposure (the lamp's strength and the ambient light): the "
    "brightness of the fringe image decides the fringe order.",
)
_ASSUMED = {"phase": _BRIGHTNESS, "phase-net": _BRIGHTNESS}
"""By method: in a few words for a table, and as a sentence. It holds unless the setting ``shading`` is off."""


def assumption(result: Result) -> str:
    """In a few words; empty where a method assumes nothing of the scene, or is not of this package."""
    return _of(result)[0]


def assumption_sentences(result: Result) -> str:
    """For the row's own page: what the method assumes, and what it was told of the samples that it is scored on."""
    told = TOLD[result.track]
    return " ".join(sentence for sentence in (_of(result)[1], f"Told {told}." if told else "") if sentence)


def _of(result: Result) -> tuple[str, str]:
    submission = result.submission
    return _ASSUMED.get(submission.method, ("", "")) if submission.settings.get("shading") is True else ("", "")
