"""Writing what was measured of a method, phase reliance or robustness, into the result file or row of that method."""

from typing import Any

from fpp_ml_bench.baselines.method import Method
from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.result import Reliance, Result, Robustness, read_json, write_result
from fpp_ml_bench.files import printable
from fpp_ml_bench.leaderboard.row_file import Row, robustness_in_brief, rounded, write_row
from fpp_ml_bench.leaderboard.rows import Entry
from fpp_ml_bench.schema import validate

_OF_THE_MACHINE = ("threads", "device")


def check_same_method(entry: Entry, method: Method) -> None:
    """Refuse (SubmissionError) a row of another method: name, frames, units, or a setting that both have."""
    about = entry.row.submission
    pairs: dict[str, tuple[object, object]] = {
        "method": (about.method, method.name),
        "frames_used": (sorted(about.frames_used), sorted(method.frames_used)),
        "units": (about.units, method.units),
    }
    for key, value in method.settings.items():
        if key in about.settings and key not in _OF_THE_MACHINE:
            pairs[f"settings.{key}"] = about.settings[key], value
    for key, (of_row, of_method) in pairs.items():
        if of_row != of_method:
            raise SubmissionError(
                f"{printable(str(entry.path), 500)}: {key} is {printable(str(of_row))}, but "
                f"{printable(str(of_method))} for the method to measure; what is measured belongs to the very method "
                "that was scored: give the same options"
            )


def write_reliance(entry: Entry, reliance: Reliance) -> None:
    """Put ``reliance`` into the file of ``entry``, replacing an earlier value; of a row, in four digits. Raises
    SubmissionError for a block that contradicts the result (other weights, other units)."""
    block = reliance.model_dump(mode="json")
    _write(entry, "reliance", rounded(block, 4) if entry.is_row_file else block)


def write_robustness(entry: Entry, robustness: Robustness) -> None:
    """`write_reliance` of ``robustness``, beside that on another set; of a row, in brief."""
    block = robustness_in_brief(robustness) if entry.is_row_file else robustness.model_dump(mode="json")
    sets = read_json(entry.path).get("robustness", {})
    _write(entry, "robustness", {**sets, robustness.set: block})


def _write(entry: Entry, key: str, block: dict[str, Any]) -> None:
    content = {**read_json(entry.path), key: block}
    if entry.is_row_file:
        write_row(validate(Row, content, entry.path, "leaderboard row"), entry.path)
    else:
        write_result(validate(Result, content, entry.path, "result of fpp-eval"), entry.path)
