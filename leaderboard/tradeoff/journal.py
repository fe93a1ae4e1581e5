"""What a run has measured so far, a JSON line for each setting, so that a stopped run continues.

The first line names rules and machine. A file of other rules or of another machine is refused, because times are only
compared within a run. An incomplete last line (after a crash) is dropped and measured again.
"""

import json
import os
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.leaderboard.tradeoff.points import Growth, Point

JOURNAL = "measured.jsonl"
_SITTING = {"sitting": True}


class Journal:
    """The file ``folder``/measured.jsonl of the run that ``about`` describes; ``points`` by key, ``growth`` by ladder.

    Points that failed are forgotten: a package may have been installed since. Raises SubmissionError for a file of
    another run (it names what differs) and for one that can't be read or written.
    """

    def __init__(self, folder: Path, about: dict[str, Any]) -> None:
        self.path = folder / JOURNAL
        self.points: dict[str, Point] = {}
        self.growth: dict[str, list[Growth]] = {}
        self.sittings = 1
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if self.path.exists():
                self._read(about)
            else:
                self._append(about)
            self._append(_SITTING)
        except OSError as error:
            raise SubmissionError(f"{self.path} can't be written: {error.strerror}; give another --out") from None

    def add_point(self, point: Point) -> None:
        """Store ``point``."""
        self.points[point.key] = point
        self._append({"point": point.model_dump(mode="json", exclude_none=True)})

    def add_growth(self, ladder: str, growths: list[Growth]) -> None:
        """Store the ``growths`` of a ``ladder``."""
        self.growth[ladder] = growths
        self._append(
            {"ladder": ladder, "growth": [growth.model_dump(mode="json", exclude_none=True) for growth in growths]}
        )

    def _append(self, content: dict[str, Any]) -> None:
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(content, allow_nan=False) + "\n")
            file.flush()
            os.fsync(file.fileno())

    def _read(self, about: dict[str, Any]) -> None:
        data = self.path.read_bytes()
        complete = data[: data.rfind(b"\n") + 1]
        try:
            first, *lines = [json.loads(line) for line in complete.decode("utf-8").splitlines()] or [None]
            if not isinstance(first, dict):
                raise ValueError("its first line is no description of a run")
        except ValueError as error:
            raise SubmissionError(
                f"{self.path}: expected what a run of fpp-bench tradeoff left ({error}); give another --out"
            ) from None
        differs = sorted(key for key in {**first, **about} if first.get(key) != about.get(key))
        if differs:
            key = differs[0]
            raise SubmissionError(
                f"{self.path}: holds a run with another {', '.join(differs)} ({key}: {first.get(key)!r} there, "
                f"{about.get(key)!r} now); times are only compared within one run: give another --out"
            )
        try:
            for line in lines:
                if "point" in line:
                    point = Point.model_validate(line["point"])
                    self.points[point.key] = point
                elif "ladder" in line:
                    self.growth[line["ladder"]] = [Growth.model_validate(content) for content in line["growth"]]
                else:
                    self.sittings += 1
        except (ValidationError, KeyError, TypeError) as error:
            raise SubmissionError(f"{self.path}: damaged ({str(error).splitlines()[0]}); give another --out") from None
        self.points = {key: point for key, point in self.points.items() if point.failed is None}
        if complete != data:
            with self.path.open("r+b") as file:
                file.truncate(len(complete))
