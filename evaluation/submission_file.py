"""``submission.yaml`` as plain keys and values; `submission` checks what they mean.

The file may come from anyone. Its size is bounded, aliases (and with them "billion laughs") and repeated keys are
refused, and only plain YAML values are built.
"""

import re
from pathlib import Path
from typing import Any

import yaml

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.text import printable

SUBMISSION_FILE = "submission.yaml"
REPORTS_FILE = "per_sample.json"
"""What a method may report of each sample beside its predictions; it is not scored."""
MAX_BYTES = 65536


class _StrictLoader(yaml.SafeLoader):
    """SafeLoader without aliases, without duplicate keys, and with 1e-3 read as the number it is."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.events.AliasEvent):
            mark = self.peek_event().start_mark
            raise yaml.YAMLError(f"line {mark.line + 1} uses an alias (*); write the value out")
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        seen = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise yaml.YAMLError(f"line {key.start_mark.line + 1}: a key must be plain text")
            if key.value in seen:
                raise yaml.YAMLError(f"line {key.start_mark.line + 1}: key {printable(key.value, 60)!r} is given twice")
            seen.add(key.value)
        return super().construct_mapping(node, deep=deep)


_StrictLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?\d+(\.\d*)?[eE][-+]?\d+$"), list("-+0123456789")
)


def read_plain(folder: Path) -> dict[Any, Any]:
    """Keys and values of a predictions folder's ``submission.yaml``, their meaning unchecked.

    SubmissionError names the file, what is wrong with it and what to do.
    """
    path = folder / SUBMISSION_FILE
    if path.is_symlink() or not path.is_file():
        raise SubmissionError(
            f"expected a file {printable(str(path), 500)} that describes the predictions, found "
            f"{'a symbolic link' if path.is_symlink() else 'none'}; "
            "fpp-bench predict writes one, PROTOCOL.md lists its keys"
        )
    return read_plain_file(path, "'name: My method'")


def read_plain_file(path: Path, example: str) -> dict[Any, Any]:
    """Keys and values of a YAML file, bounded and plain as this module says; ``example`` shows what a line looks like.

    SubmissionError names the file, what is wrong with it and what to do.
    """
    file = printable(str(path), 500)
    try:
        with path.open("rb") as stream:
            data = stream.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise SubmissionError(f"{file}: expected at most {MAX_BYTES} bytes; shorten names and settings")
        content = yaml.load(data.decode("utf-8"), Loader=_StrictLoader)
    except OSError as error:
        raise SubmissionError(f"{file} can't be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise SubmissionError(f"{file}: expected UTF-8 text") from None
    except (yaml.YAMLError, ValueError, RecursionError, OverflowError) as error:
        reason = " ".join(printable(line.strip()) for line in str(error).splitlines()) or "nested too deeply"
        raise SubmissionError(f"{file} is no plain YAML: {reason}") from None
    if not isinstance(content, dict):
        raise SubmissionError(f"{file}: expected keys and values like {example}, got {type(content).__name__}")
    return content
