"""Result files on disk: written whole, read strictly; what they say of code and machine; JSON
Schemas."""

import hashlib
import json
import platform
import subprocess
from functools import cache
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pydantic

from fpp_ml_bench import __version__, depth
from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.protocol import (
    MOST_OBJECTS,
    MOST_SAMPLES,
    RESULT_SCHEMA_VERSION,
    SchemaVersion,
)
from fpp_ml_bench.evaluation.report.comparison import Comparison
from fpp_ml_bench.evaluation.result.model import Result
from fpp_ml_bench.evaluation.result.parts import Environment, HardwareInfo
from fpp_ml_bench.evaluation.submission.description import Submission
from fpp_ml_bench.files import printable, write_atomically
from fpp_ml_bench.files import read_json as read_strict_json
from fpp_ml_bench.machine import describe_hardware
from fpp_ml_bench.schema import validate

_OTHER_FILES = {
    "shards": "the manifest of a dataset",
    "row_schema_version": "a row file of the leaderboard",
    "groups": "a ranking, as fpp-bench leaderboard --json writes it",
    "differences": "a comparison, as fpp-eval compare --json writes it",
    "tradeoff_schema_version": "what fpp-bench tradeoff measured",
}
"""JSON files of this package that are no results, by a key that only they have."""


def _json_bytes(content: object) -> bytes:
    return (
        json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False).encode("utf-8") + b"\n"
    )


def result_json(result: Result) -> bytes:
    """The file's bytes: UTF-8 JSON, no NaN, keys in the model's order, each sample's name
    first."""
    content = result.model_dump(mode="json")
    content["per_sample"] = [{"sample": row.pop("sample"), **row} for row in content["per_sample"]]
    return _json_bytes(content)


def write_result(result: Result, path: Path) -> None:
    """Write the result as `write_file` does."""
    write_file(result_json(result), path)


def write_json(content: object, path: Path) -> None:
    """Write plain ``content`` as JSON, as `write_file` does."""
    write_file(_json_bytes(content), path)


def write_file(content: bytes, path: Path, new_folder: bool = False) -> None:
    """Write ``path`` in one step: a reader sees the old file or the new one. SubmissionError where
    it can't be."""
    try:
        if new_folder:
            path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, content)
    except OSError as error:
        raise SubmissionError(f"{printable(path)} can't be written: {error.strerror}") from None


def read_result(path: Path) -> Result:
    """The result in ``path``; SubmissionError names the file and what is wrong with it."""
    return parse_result(read_json(path), path)


def read_json(path: Path) -> Any:
    """The content of a JSON file that `fpp-eval` may have written; SubmissionError names file and
    problem."""
    return read_strict_json(path, SubmissionError, "write it again with fpp-eval --json")


def parse_result(content: object, path: Path) -> Result:
    """``content`` of the file ``path`` as a result that agrees with itself, or SubmissionError."""
    file = printable(path)
    keys = content if isinstance(content, dict) else {}
    for key, what in _OTHER_FILES.items():
        if key in keys:
            raise SubmissionError(
                f"{file} is not a result file but {what}; expected what fpp-eval --json writes"
            )
    version = keys.get("schema_version")
    if version not in get_args(SchemaVersion):
        given = (
            "no schema_version" if version is None else f"schema_version {printable(version, 40)}"
        )
        expected = (
            f"expected a result file with schema_version {' or '.join(get_args(SchemaVersion))}, "
            f"got {given}"
        )
        raise SubmissionError(
            f"{file}: {expected}; score the predictions again with this version's fpp-eval"
        )
    rows = keys.get("per_sample")
    owners = (
        [str(row.get("object")) for row in rows if isinstance(row, dict)]
        if isinstance(rows, list)
        else []
    )
    if len(set(owners)) > MOST_OBJECTS or len(owners) > MOST_SAMPLES:
        expected = f"expected at most {MOST_OBJECTS} objects and {MOST_SAMPLES} samples"
        raise SubmissionError(
            f"{file}: {expected}, got {len(set(owners))} and {len(owners)}; score parts of the data"
        )
    return validate(Result, content, path, "result of fpp-eval")


def json_schema(name: str) -> dict[str, object]:
    """JSON Schema (draft 2020-12) of ``result``, ``submission`` or ``comparison``. It lists the
    keys and what each may hold. Whether averages follow from the samples is checked on reading."""
    models: dict[str, type[pydantic.BaseModel]] = {
        "result": Result,
        "submission": Submission,
        "comparison": Comparison,
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"fpp-ml-bench {name}, schema version {RESULT_SCHEMA_VERSION}",
        **{key: value for key, value in models[name].model_json_schema().items() if key != "title"},
    }


_EVALUATION = Path(__file__).resolve().parent.parent


def environment() -> Environment:
    """This machine and this code, for a result."""
    import pyarrow  # loaded with any dataset, but not needed to read and compare results

    modules = {"numpy": np, "pyarrow": pyarrow, "pydantic": pydantic}
    return Environment(
        python=platform.python_version(),
        packages={
            "fpp_ml_bench": __version__,
            **{name: module.__version__ for name, module in modules.items()},
        },
        git=_commit(),
        code_sha256=_scoring_code(),
        hardware=HardwareInfo.model_validate(describe_hardware().to_dict()),
    )


def _commit() -> str | None:
    """The commit of the checkout this package runs from; None where there is none, or no git."""
    command = ["git", f"--git-dir={_EVALUATION.parent / '.git'}", "rev-parse", "--verify", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


@cache
def _scoring_code() -> str:
    """SHA-256 over the source files that compute scores, 64 hex digits."""
    files = (
        _EVALUATION / "metrics.py",
        _EVALUATION / "protocol.py",
        *sorted((_EVALUATION / "score").glob("*.py")),
        Path(depth.__file__),
    )
    content = (path.name.encode() + b"\0" + path.read_bytes() + b"\0" for path in files)
    return hashlib.sha256(b"".join(content)).hexdigest()
