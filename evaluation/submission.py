"""``submission.yaml``: what a submission says about itself, read strictly.

The file comes from a stranger: it is bounded in size, aliases (and with them "billion laughs") are refused, a key given
twice is refused, and only plain YAML values are built.
"""

import re
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import Field, model_validator

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.protocol import Track
from fpp_ml_bench.evaluation.schema import Count, Positive, Scalar, StrictModel, Text, validate
from fpp_ml_bench.evaluation.text import printable
from fpp_ml_bench.evaluation.timing import HardwareInfo, Timing

SUBMISSION_FILE = "submission.yaml"
MAX_BYTES = 65536


class Submission(StrictModel):
    """Content of ``submission.yaml``. ``frames_used`` are indices into the dataset's frame sequence (0 based).

    ``uses_ground_truth_range`` is true when the method was given depth_min and depth_max of the samples it is scored
    on. ``seconds_per_sample`` is null when unknown; a number needs ``hardware`` and ``seconds_source`` beside it.
    """

    name: Text
    method: Text
    units: Literal["mm"]
    frames_used: list[Count]
    uses_ground_truth_range: bool
    seconds_per_sample: Positive | None
    seconds_source: Literal["measured", "self-reported"] | None = None
    hardware: HardwareInfo | None = None
    software: dict[Text, Text] = Field(default_factory=dict, max_length=100)
    settings: dict[Text, Scalar] = Field(default_factory=dict, max_length=200)
    timing: Timing | None = None

    @model_validator(mode="after")
    def _consistent(self) -> "Submission":
        if len(set(self.frames_used)) != len(self.frames_used):
            raise ValueError("frames_used names a frame twice")
        if self.seconds_per_sample is not None and (self.seconds_source is None or self.hardware is None):
            raise ValueError("seconds_per_sample needs seconds_source and hardware beside it, or null when unknown")
        if self.timing is not None and self.timing.frames != len(self.frames_used):
            raise ValueError("timing.frames is not the number of frames_used; time this very method")
        return self

    @property
    def track(self) -> Track:
        """``metric``, or ``oracle range`` for a method that was given the test sample's depth range."""
        return "oracle range" if self.uses_ground_truth_range else "metric"


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
                raise yaml.YAMLError(f"line {key.start_mark.line + 1}: key {printable(key.value, 60)!r} stands twice")
            seen.add(key.value)
        return super().construct_mapping(node, deep=deep)


_StrictLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?\d+(\.\d*)?[eE][-+]?\d+$"), list("-+0123456789")
)


def read_submission(folder: Path) -> Submission:
    """The checked ``submission.yaml`` of a predictions folder; SubmissionError names the file, the key and the cure."""
    path = folder / SUBMISSION_FILE
    shown = printable(str(path), 500)
    if path.is_symlink() or not path.is_file():
        raise SubmissionError(
            f"expected a file {shown} that describes the predictions, found "
            f"{'a symbolic link' if path.is_symlink() else 'none'}; "
            "fpp-bench predict writes one, PROTOCOL.md lists its keys"
        )
    try:
        with path.open("rb") as stream:
            data = stream.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise SubmissionError(f"{shown}: expected at most {MAX_BYTES} bytes; shorten names and settings")
        content = yaml.load(data.decode("utf-8"), Loader=_StrictLoader)
    except OSError as error:
        raise SubmissionError(f"{shown} can't be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise SubmissionError(f"{shown}: expected UTF-8 text") from None
    except (yaml.YAMLError, ValueError, RecursionError, OverflowError) as error:
        reason = " ".join(printable(line.strip()) for line in str(error).splitlines()) or "nested too deeply"
        raise SubmissionError(f"{shown} is no plain YAML: {reason}") from None
    if not isinstance(content, dict):
        raise SubmissionError(f"{shown}: expected keys and values like 'name: My method', got {type(content).__name__}")
    units = content.get("units", "mm")
    if units != "mm":
        raise SubmissionError(
            f"{shown}: units: expected mm, got {printable(units, 60)!r}; this version scores depth in mm only: "
            "convert the predictions (m x 1000; normalised depth back through its own minimum and maximum)"
        )
    return validate(Submission, content, path, "submission description")
