"""The leaderboard's rows as files: a result of ``fpp-eval``, and who vouches for its numbers.

A file under ``leaderboard/rows/`` is either a result file as ``fpp-eval --json`` writes it, which counts as
self-reported, or a row file: a result and a ``provenance``, which the maintainers set. A PNG of the same name beside it
is shown on the submission's page.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.result import Result, parse_result, read_json, result_content, write_json
from fpp_ml_bench.files import printable
from fpp_ml_bench.schema import StrictModel, validate

SHIPPED_ROWS = Path(__file__).resolve().parent / "rows"
ROW_SCHEMA_VERSION: Literal["1.0.0"] = "1.0.0"

Provenance = Literal["measured here", "verified", "self-reported"]
PROVENANCES: tuple[str, ...] = get_args(Provenance)
MEASURED_HERE: Provenance = "measured here"
LOCAL = "local file"
"""Of a result on this machine that is in no leaderboard."""
BY_THE_PAPER = "reported by the paper"
BY_ITS_AUTHORS = "reported by its authors"

MEANING = {
    MEASURED_HERE: "The maintainers ran the method, timed it and scored it, with the commands in this repository.",
    "verified": "The author sent the predictions, and fpp-eval verify gave the same scores. Run time is the author's.",
    "self-reported": "The author ran fpp-eval and sent the result. Its numbers are consistent; nobody checked them.",
    LOCAL: "A result on this machine that is in no leaderboard.",
    BY_THE_PAPER: "Typed in from the paper's tables, measured by its authors on other data with other code.",
    BY_ITS_AUTHORS: "Typed in from another publication, measured by its authors on other data with other code.",
}

LARGEST_PICTURE_BYTES = 2_000_000
LARGEST_PICTURE_PX = 4096
_PNG = b"\x89PNG\r\n\x1a\n"


class _RowFile(StrictModel):
    row_schema_version: Literal["1.0.0"]
    provenance: Provenance
    result: Result


@dataclass(frozen=True)
class Entry:
    """A row: a result, and its ``provenance`` (a key of `MEANING`)."""

    path: Path
    result: Result
    provenance: str = LOCAL

    @property
    def name(self) -> str:
        return self.result.submission.name

    @property
    def frames(self) -> int:
        """Number of captured frames per depth map."""
        return len(self.result.submission.frames_used)

    @property
    def latency_ms(self) -> float | None:
        """Median time per image in ms; None when unknown."""
        timing, seconds = self.result.timing, self.result.submission.seconds_per_sample
        return timing.latency_median_ms if timing else None if seconds is None else 1000 * seconds

    @property
    def time_measured(self) -> bool:
        """Whether this package measured the time and the provenance allows that claim; else it is self-reported."""
        timing, submission = self.result.timing, self.result.submission
        source = timing.provenance if timing is not None else submission.seconds_source
        return source == "measured" and self.provenance in (MEASURED_HERE, LOCAL)

    def value(self, key: str) -> float | None:
        """Value of a sort key; None for an empty pixel set or an unknown time."""
        if key == "seconds_per_sample":
            return None if self.latency_ms is None else self.latency_ms / 1000
        if key == "frames_used":
            return float(self.frames)
        return getattr(self.result.metrics, key)  # type: ignore[no-any-return]

    def interval(self, key: str) -> tuple[float, float] | None:
        """The 95% interval of ``key``; None where it has none."""
        return self.result.intervals.of(key)


def read_entry(path: Path) -> Entry:
    """Read a row file or a result file strictly. SubmissionError names the file and what is wrong with it."""
    content = read_json(path)
    if isinstance(content, dict) and "row_schema_version" in content:
        if content["row_schema_version"] != ROW_SCHEMA_VERSION:
            raise SubmissionError(
                f"{printable(str(path), 500)}: expected row_schema_version {ROW_SCHEMA_VERSION}, got "
                f"{printable(content['row_schema_version'], 40)}; write the row again from its result"
            )
        parse_result(content.get("result"), path)
        row: _RowFile = validate(_RowFile, content, path, "leaderboard row")
        return Entry(path, row.result, row.provenance)
    shipped = path.resolve().parent == SHIPPED_ROWS.resolve()
    return Entry(path, parse_result(content, path), "self-reported" if shipped else LOCAL)


def write_row(entry: Entry, provenance: str, path: Path) -> None:
    """Write ``entry`` as a row file. SubmissionError for a provenance not in `PROVENANCES`, or an unwritable path."""
    if provenance not in PROVENANCES:
        raise SubmissionError(f"expected a provenance out of {', '.join(PROVENANCES)}, got {printable(provenance)!r}")
    head = {"row_schema_version": ROW_SCHEMA_VERSION, "provenance": provenance}
    write_json({**head, "result": result_content(entry.result)}, path)


def picture_of(entry: Entry) -> bytes | None:
    """The PNG beside a row file, None without it. SubmissionError for a file that is not a PNG of a sensible size. Its
    pixels are not decoded here; a browser shows it as a PNG or not at all."""
    path = entry.path.with_suffix(".png")
    if path.is_symlink() or not path.is_file():
        return None
    with path.open("rb") as stream:
        data = stream.read(LARGEST_PICTURE_BYTES + 1)
    shown = printable(str(path), 500)
    if len(data) > LARGEST_PICTURE_BYTES:
        raise SubmissionError(f"{shown}: expected a picture of at most {LARGEST_PICTURE_BYTES:,} bytes")
    sides = int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    if data[:8] != _PNG or data[12:16] != b"IHDR" or not all(0 < side <= LARGEST_PICTURE_PX for side in sides):
        raise SubmissionError(f"{shown}: expected a PNG of at most {LARGEST_PICTURE_PX} px a side")
    return data
