"""The leaderboard's rows as they are read: who vouches for each, what recomputing its scores tells,
and what is measured of a method later (phase reliance, robustness) written into its file.

A result file of ``fpp-eval`` becomes a `Row` when it is read, so that everything here is made of
rows. The maintainers keep ``vouched.txt``: a line for each row file that they measured themselves,
or verified from its author's predictions. Nothing in a row says so, and nothing is signed: who can
change the list can change the code.
"""

import math
import re
from dataclasses import dataclass
from functools import cached_property, lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.metrics import HEADLINE
from fpp_ml_bench.evaluation.protocol import PROTOCOL_VERSION
from fpp_ml_bench.evaluation.result.file import parse_result, read_json, write_result
from fpp_ml_bench.evaluation.result.model import Result, disagreements
from fpp_ml_bench.evaluation.result.parts import Reliance, Robustness, TrackScores
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.evaluation.score.verification import Verified, difference_lines, of_processors
from fpp_ml_bench.files import file_content, printable
from fpp_ml_bench.leaderboard.row_file import (
    DIGITS,
    ROUNDED_TWICE,
    ROW_SCHEMA_VERSION,
    Row,
    check_size,
    in_brief,
    processor,
    row_content,
    row_of,
    write_row,
)
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.schema import validate

SHIPPED_ROWS = Path(__file__).resolve().parent / "rows"
VOUCHED = Path(__file__).resolve().parent / "vouched.txt"
_LARGEST_FILE_BYTES = 1 << 26
TEST, UNSEEN = "fpp-bench-full", "fpp-bench-unseen"
"""The benchmark whose test split, and the set of unseen objects that, make one row."""

MEASURED_HERE, VERIFIED, SELF_REPORTED = "measured here", "verified", "self-reported"
LOCAL = "local file"
"""Of a result on this machine that is in no leaderboard."""
BY_THE_PAPER = "reported by the paper"
BY_ITS_AUTHORS = "reported by its authors"

MEANING = {
    MEASURED_HERE: "The maintainers ran the method, timed it and scored it, with the commands in this repository.",
    VERIFIED: "The author sent the predictions, and fpp-eval verify gave the same scores. Run time, phase reliance and "
    "robustness are the author's.",
    LOCAL: "A result on this machine that is in no leaderboard.",
    SELF_REPORTED: "The author ran fpp-eval and sent the row. Its numbers are consistent; nobody checked them.",
    BY_THE_PAPER: "Typed in from the paper's tables, measured by its authors on other data with other code.",
    BY_ITS_AUTHORS: "Typed in from another publication, measured by its authors on other data with other code.",
}
"""Every provenance, the strongest first."""

WORDS = {"measured": MEASURED_HERE, "verified": VERIFIED}
"""The words of ``vouched.txt``, and the provenance that each is."""
_FIELDS = "SHA-256 of a row file, measured or verified, commit, machine, command"
_LINE = re.compile(r"([0-9a-f]{64}) \| (measured|verified) \| [0-9a-f]{40} \| [^|\s][^|]* \| \S.*")
_NOT_COMPARED: Any = {
    **dict.fromkeys(
        (
            "created",
            "package",
            "git",
            "code_sha256",
            "result_sha256",
            "reliance",
            "robustness",
            "rigs",
        ),
        True,
    ),
    "submission": {"seconds_per_sample", "seconds_source", "hardware", "timing", "software"},
    "dataset": {"name"},
}


@dataclass(frozen=True)
class Entry:
    """A row as it was read from a row file or made of a result file, and its ``provenance`` (a key
    of `MEANING`)."""

    path: Path
    row: Row
    provenance: str = LOCAL
    is_row_file: bool = False

    @property
    def name(self) -> str:
        return self.row.submission.name

    @property
    def frames(self) -> int:
        """Number of captured frames per depth map."""
        return len(self.row.submission.frames_used)

    @cached_property
    def is_unseen(self) -> bool:
        """Whether it is scored on the set of unseen objects."""
        benchmark = self.row.dataset.known
        return (
            benchmark is not None and benchmark.name == UNSEEN and self.row.dataset.split == "test"
        )

    @property
    def vouched(self) -> bool:
        """Whether the maintainers vouch for its scores."""
        return self.provenance in (MEASURED_HERE, VERIFIED)

    @property
    def all_checked(self) -> bool:
        """Whether the maintainers, or this machine's user, also measured what can't be recomputed
        from predictions: time, phase reliance, robustness. Of others these are self-reported."""
        return self.provenance in (MEASURED_HERE, LOCAL)

    @property
    def latency_ms(self) -> float | None:
        """Median time per image in ms; None when unknown."""
        timing, seconds = self.row.timing, self.row.submission.seconds_per_sample
        return timing.latency_median_ms if timing else None if seconds is None else 1000 * seconds

    @property
    def time_measured(self) -> bool:
        """Whether this package measured the time and the provenance allows that claim; else it is
        self-reported."""
        timing, submission = self.row.timing, self.row.submission
        source = timing.provenance if timing is not None else submission.seconds_source
        return source == "measured" and self.all_checked

    def value(self, key: str) -> float | None:
        """Value of a sort key; None for an empty pixel set or an unknown time."""
        if key == "seconds_per_sample":
            return None if self.latency_ms is None else self.latency_ms / 1000
        if key == "frames_used":
            return float(self.frames)
        return getattr(self.row.metrics, key)  # type: ignore[no-any-return]


def read_entry(path: Path) -> Entry:
    """Read a row file or a result file strictly. SubmissionError names the file and what is wrong
    with it, also for one of another protocol: its errors follow other rules."""
    content, file = read_json(path), printable(path)
    data = file_content(path, _LARGEST_FILE_BYTES, SubmissionError)
    is_row_file = isinstance(content, dict) and "row_schema_version" in content
    if not is_row_file:
        row = row_of(parse_result(content, path), path)
    elif content["row_schema_version"] != ROW_SCHEMA_VERSION:
        given = printable(content["row_schema_version"], 40)
        expected = f"expected row_schema_version {ROW_SCHEMA_VERSION}, got {given}"
        raise SubmissionError(f"{file}: {expected}; make the row again from its result")
    else:
        row = validate(Row, content, path, "leaderboard row")
        check_size(data, path)
    if row.protocol_version != PROTOCOL_VERSION:
        raise SubmissionError(
            f"{file}: was scored by protocol {row.protocol_version}, this is {PROTOCOL_VERSION}; "
            f"score the predictions "
            "again"
        )
    benchmark = row.dataset.known
    if benchmark is not None and row.metrics.object_mae_mm == 0:
        raise SubmissionError(
            f"{file}: every error is exactly 0, so the predictions are the ground truth of "
            f"{benchmark.title} itself; "
            "score what a method answers (the classical method, from which depth is decoded, "
            "against depth_exact)"
        )
    shipped = SELF_REPORTED if path.resolve().parent == SHIPPED_ROWS.resolve() else LOCAL
    return Entry(path, row, vouched().get(sha256(data).hexdigest(), shipped), is_row_file)


def read_scored(path: Path) -> Result | Row:
    """The whole result in a result file, the row in a row file, read as strictly as `read_entry`
    does."""
    content = read_json(path)
    is_row_file = isinstance(content, dict) and "row_schema_version" in content
    return read_entry(path).row if is_row_file else parse_result(content, path)


def alike(first: Result | Row, second: Result | Row) -> tuple[Any, Any]:
    """Two results, or two rows, to be compared: a result beside a row becomes a row."""
    if isinstance(first, Row) != isinstance(second, Row):
        first, second = (
            s if isinstance(s, Row) else row_of(s, Path("result")) for s in (first, second)
        )
    return first, second


def vouched() -> dict[str, str]:
    """The provenance that ``vouched.txt`` gives, by SHA-256 of a row file. SubmissionError names a
    bad line."""
    return _vouched(file_content(VOUCHED, 1 << 20, SubmissionError))


@lru_cache(1)
def _vouched(content: bytes) -> dict[str, str]:
    listed: dict[str, str] = {}
    for number, line in enumerate(content.decode("utf-8", "replace").split("\n"), start=1):
        if not line or line.startswith("#"):
            continue
        match = _LINE.fullmatch(line) if line.isprintable() else None
        if match is None or match[1] in listed:
            expected = "a hash that is listed once" if match else f"{_FIELDS}, with | between them"
            raise SubmissionError(
                f"{VOUCHED}, line {number}: expected {expected}, got {printable(line)!r}"
            )
        listed[match[1]] = WORDS[match[2]]
    return listed


def vouching_line(row: Row, data: bytes, word: str, command: str) -> str:
    """What a maintainer adds to ``vouched.txt`` for a row file of these bytes: ``word`` is of
    `WORDS`."""
    machine = (
        "unknown machine" if row.hardware is None else processor(row.hardware).replace("|", "/")
    )
    return " | ".join((sha256(data).hexdigest(), word, row.git or 40 * "0", machine, command))


def differences(row: Row, folder: Path, dataset: DatasetFolder) -> Verified:
    """What of ``row`` does not follow from the predictions in ``folder`` on ``dataset``. Everything
    is scored again; means may differ by what their digits leave open, and by 1e-9. Raises what
    `evaluate` raises."""
    scored = evaluate(folder, dataset, row.dataset.split, row.target, row.edge_band_px, row.mode)
    rows = row, Row.model_validate(row_content(scored, digits=None))
    stored, computed = (each.model_dump(mode="json", exclude=_NOT_COMPARED) for each in rows)
    cancelling = 1e-9 * (row.metrics.object_mae_mm or 0.0)
    deviations = list(disagreements(stored, computed, cancelling=cancelling, digits=DIGITS))
    return Verified(
        difference_lines(deviations, "row"),
        of_processors(deviations, dataset.rig.working_range_mm[1]),
    )


def not_checked(about: Row | Result) -> list[str]:
    """What `fpp-eval verify` can't recompute of a row or result, in words."""
    submission = about.submission
    present = {
        "run time and its machine": (submission.timing or submission.seconds_per_sample)
        is not None,
        "phase reliance": about.reliance is not None,
        "robustness": bool(about.robustness),
        "the track of rigs": about.rigs is not None,
        "software, code and environment": True,
    }
    return [words for words, there in present.items() if there]


def write_block(entry: Entry, block: Reliance | Robustness | TrackScores) -> None:
    """Put a ``block`` into the file of ``entry``, replacing an earlier value, that of a robustness
    on the same set; of a row, in brief. Raises SubmissionError for a block that contradicts the
    result (other weights, other units), and for a track that is none of the named ones."""
    content = read_json(entry.path)
    plain = in_brief(block) if entry.is_row_file else block.model_dump(mode="json")
    if isinstance(block, Robustness):
        content["robustness"] = {**content.get("robustness", {}), block.set: plain}
    elif isinstance(block, TrackScores):
        content["rigs"] = plain
    else:
        content["reliance"] = plain
    if entry.is_row_file:
        write_row(validate(Row, content, entry.path, "leaderboard row"), entry.path)
    else:
        write_result(validate(Result, content, entry.path, "result of fpp-eval"), entry.path)


def copy_note(copy: Entry, original: Entry) -> str:
    """Why ``copy`` is left out, whose predictions are those of ``original``."""
    copied, of = (
        f"{printable(e.name, 80)} ({printable(e.path.name, 80)})" for e in (copy, original)
    )
    pairs = ([getattr(e.row.metrics, key) or 0.0 for e in (copy, original)] for key in HEADLINE)
    agree = all(math.isclose(*pair, rel_tol=ROUNDED_TWICE) for pair in pairs)
    contradicting = "" if agree else " but not the same errors, so one of the two files is wrong"
    return f"Not shown, the same predictions as {of}{contradicting}: {copied}."
