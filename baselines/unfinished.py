"""What a stopped run of `predict_split` left: whether this is the same run, and which samples are finished.

``unfinished.jsonl`` stands beside the predictions until all are there. Its first line says what run it is, each further
one is a finished sample, written when its files are. A last line that was cut off does not count.
"""

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.submission.prediction_files import UNFINISHED_FILE
from fpp_ml_bench.files import file_content, naming, printable, strict_json

_LARGEST_BYTES = 1 << 28


@dataclass(frozen=True)
class Finished:
    """A finished sample: the ``seconds`` that the method took, and its report."""

    seconds: float
    report: dict[str, Any]


class UnfinishedRun:
    """The run in ``folder`` that ``run`` describes in plain values; ``finished``: by sample, of all calls so far."""

    def __init__(self, folder: Path, run: Mapping[str, Any]) -> None:
        """Raises PredictionError for a file that belongs to another run."""
        self.path = folder / UNFINISHED_FILE
        self.run = json.loads(json.dumps(run))
        self.finished: dict[str, Finished] = {}
        if not self.path.exists():
            return
        cure = "remove the folder, or give another one"
        text = file_content(self.path, _LARGEST_BYTES, PredictionError, cure).decode("utf-8", "replace")
        lines = [entry for line in text.splitlines() if isinstance(entry := _parsed(line), dict)]
        if not text.startswith("{") or not lines:
            self.path.unlink()  # stopped before the first line was whole
            return
        self._check(lines[0])
        for entry in lines[1:]:
            with suppress(KeyError, TypeError, ValueError):  # a damaged line: its sample is predicted again
                self.finished[str(entry["sample"])] = Finished(float(entry["seconds"]), dict(entry["report"]))
        if not text.endswith("\n"):
            with self.path.open("a", encoding="utf-8") as file:
                file.write("\n")  # what follows is a line of its own

    def _check(self, earlier: dict[str, Any]) -> None:
        differing = [key for key in {**earlier, **self.run} if earlier.get(key) != self.run.get(key)]
        if differing:
            key = differing[0]
            values = [printable(json.dumps(run.get(key)), 150) for run in (earlier, self.run)]
            raise PredictionError(
                f"{self.path.parent}: holds an unfinished run that differs in {', '.join(differing)} ({key}: "
                f"{values[0]} there, {values[1]} now); finish it with its own options, remove the folder, or give "
                "another one"
            )

    def holds(self, sample: str, path: Path, size: tuple[int, int]) -> bool:
        """Whether ``sample`` is finished and its file ``path`` is a whole map of ``size``."""
        if sample not in self.finished:
            return False
        try:
            return np.load(path, mmap_mode="r", allow_pickle=False).shape == size
        except (OSError, ValueError, EOFError):
            return False

    def add(self, sample: str, finished: Finished) -> None:
        """Note that the files of ``sample`` are there."""
        self.finished[sample] = finished
        self._append({"sample": sample, "seconds": finished.seconds, "report": finished.report})

    def begin(self) -> None:
        """Note what run it is, before its first file: a folder with a prediction and no note is not taken over."""
        if not self.path.exists():
            self._append(self.run)

    def _append(self, entry: dict[str, Any]) -> None:
        with naming(self.path), self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry) + "\n")
            file.flush()
            os.fsync(file.fileno())

    def remove(self) -> None:
        """All is finished."""
        self.path.unlink(missing_ok=True)


def _parsed(line: str) -> Any:
    """The line's JSON; None for one that was cut off."""
    try:
        return strict_json(line)
    except ValueError:
        return None
