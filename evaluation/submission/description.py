"""``submission.yaml``: the description of a submission, read into a strict model and written from
it, and a template to fill in."""

from pathlib import Path
from typing import Any, Literal, cast

import yaml
from pydantic import Field, model_validator

from fpp_ml_bench.depth import RangeRule
from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.protocol import Track, Units
from fpp_ml_bench.evaluation.result.parts import HardwareInfo, Timing
from fpp_ml_bench.evaluation.submission.prediction_files import SUBMISSION_FILE, read_plain
from fpp_ml_bench.files import printable
from fpp_ml_bench.schema import Count, Positive, Scalar, SparseModel, StrictModel, Text, validate


class LearnedFrom(StrictModel):
    """What data a method learned from: the training split of benchmarks of this package
    (``train-split``), other data that its renderer made (``generated``), any other data, or none.
    ``versions`` name them, like ``fpp-bench-full version 1``."""

    data: Literal["train-split", "generated", "other", "none"]
    versions: list[Text] = Field(default_factory=list, max_length=50)

    @model_validator(mode="after")
    def _consistent(self) -> "LearnedFrom":
        if self.data == "none" and self.versions:
            raise ValueError(
                "a method that learned from no data has no versions of it; remove them"
            )
        if self.data == "train-split" and not self.versions:
            raise ValueError("data: train-split needs versions, like [fpp-bench-full version 1]")
        return self


class Predicted(StrictModel):
    """What ``fpp-bench predict`` read: the folder of the ``dataset``, the ``split``, and the hashes
    of that ``content`` of it (``split/column``, as in a manifest) that the method reads or is
    scored on."""

    dataset: str = Field(min_length=1, max_length=4096)
    split: Text
    content: dict[Text, Text] = Field(max_length=1000)


class Submission(SparseModel):
    """Content of ``submission.yaml``. ``frames_used`` are indices into the dataset's frame sequence
    (0 based).

    ``units`` of the prediction files; ``png_mm_per_level`` is what one level of a 16-bit PNG is in
    mm, ``nodata`` the value of pixels without a surface where that is not 0, in the unit of the
    files. ``uses_ground_truth_range`` is true when the method was given depth_min and depth_max of
    the samples it is scored on, by ``range_rule`` (`fpp_ml_bench.depth.RangeRule`);
    ``uses_ground_truth_mask`` when it was given which of their pixels are object (for example an
    input that is black outside the object), ``uses_ground_truth_order`` when it was given their
    true fringe orders; defaults of these three are never written, so that files without the keys
    stay as they are. ``learned_from`` is absent where it is unknown. ``predicted`` says what
    ``fpp-bench predict`` read, so that fpp-eval finds it; a result does not repeat it.
    ``seconds_per_sample`` is null when unknown; a number needs ``hardware`` and ``seconds_source``
    beside it."""

    SPARSE = (
        "nodata",
        "range_rule",
        "uses_ground_truth_mask",
        "uses_ground_truth_order",
        "learned_from",
        "predicted",
    )

    name: Text
    method: Text
    units: Units
    png_mm_per_level: Positive | None = None
    nodata: float | None = None
    frames_used: list[Count] = Field(min_length=1)
    uses_ground_truth_range: bool
    range_rule: RangeRule = "object"
    uses_ground_truth_mask: bool = False
    uses_ground_truth_order: bool = False
    learned_from: LearnedFrom | None = None
    predicted: Predicted | None = None
    seconds_per_sample: Positive | None
    seconds_source: Literal["measured", "self-reported"] | None = None
    hardware: HardwareInfo | None = None
    software: dict[Text, Text] = Field(default_factory=dict, max_length=100)
    settings: dict[Text, Scalar] = Field(default_factory=dict, max_length=200)
    seeds: dict[Text, Count] = Field(default_factory=dict, max_length=100)
    timing: Timing | None = None

    @model_validator(mode="after")
    def _consistent(self) -> "Submission":
        if len(set(self.frames_used)) != len(self.frames_used):
            raise ValueError("frames_used names a frame twice")
        if self.units == "normalised" and not self.uses_ground_truth_range:
            why = (
                "normalised depth only becomes mm through the range of the very samples it is "
                "scored on"
            )
            needs = "units: normalised needs uses_ground_truth_range: true"
            raise ValueError(f"{needs}, for {why}; submit mm for the metric track")
        if self.range_rule != "object" and self.units != "normalised":
            raise ValueError(
                "range_rule is that of normalised depth, so units must be normalised; remove it"
            )
        if self.png_mm_per_level is not None and self.units != "mm":
            raise ValueError("png_mm_per_level gives PNG levels in mm, so units must be mm")
        if self.seconds_per_sample is not None and (
            self.seconds_source is None or self.hardware is None
        ):
            raise ValueError(
                "seconds_per_sample needs seconds_source and hardware beside it, or null when "
                "unknown"
            )
        if self.timing is not None and self.timing.frames != len(self.frames_used):
            raise ValueError(
                "timing.frames is not the number of frames_used; time this very method"
            )
        return self

    @property
    def track(self) -> Track:
        """``metric``, or what of the scored samples' ground truth the method was given: range,
        mask, fringe order."""
        given = [
            name
            for name in ("range", "mask", "order")
            if getattr(self, f"uses_ground_truth_{name}")
        ]
        return cast(Track, f"oracle {' + '.join(given)}" if given else "metric")

    def to_yaml(self) -> str:
        """The file's text: the keys that were given, in the model's order."""
        content = self.model_dump(mode="json", exclude_unset=True)
        return yaml.safe_dump(content, sort_keys=False, allow_unicode=True)


def read_submission(folder: Path) -> Submission:
    """The checked ``submission.yaml`` of a predictions folder; SubmissionError names the file and
    the key."""
    return check_submission(folder, read_plain(folder))


def check_submission(folder: Path, content: dict[Any, Any]) -> Submission:
    """``content`` of the folder's ``submission.yaml`` as the model; SubmissionError as
    `read_submission`."""
    return validate(Submission, content, folder / SUBMISSION_FILE, "submission description")


TEMPLATE = """\
# Describes the predictions beside this file: one {sample}.npy for each sample, float32 (H, W), 0 = not measured.
# Depth is along the camera's axis (Z), not the distance along the pixel's ray, and rows run from top to bottom.
# Lines that begin with "# " and a key are optional: remove the "# " to use them. evaluation/PROTOCOL.md explains all.

name: My method              # what the leaderboard shows, up to 200 characters
method: my-method            # a short name for the kind of method
units: mm                    # of the files: mm, m or normalised (then uses_ground_truth_range must be true)
# png_mm_per_level: 0.05     # with 16-bit .png files only: the mm of one grey level
# nodata: 65535              # what the files hold where no surface is, if that is not 0

frames_used: [0]             # indices into the dataset's frame sequence, from 0
uses_ground_truth_range: false   # was the method given depth_min and depth_max of the scored samples?
# range_rule: object         # with units: normalised only: over which pixels that range is, object or valid (not void)
# uses_ground_truth_mask: true   # was it given which pixels of the scored samples are object?
# uses_ground_truth_order: true  # was it given their true fringe orders?
# learned_from:              # what data it learned from; unknown without this key
#   data: train-split        # train-split | generated (by this package's renderer) | other | none
#   versions: [fpp-bench-full version 1]
# predicted:                 # what was predicted, for fpp-eval without DATASET; fpp-bench predict writes it
#   dataset: data/mini
#   split: test
#   content: {}              # hashes of its columns, from its manifest.json: test/depth and others

seconds_per_sample: null     # median time for one sample; a number needs the next two keys
# seconds_source: self-reported
# hardware: {cpu: Some CPU, cores: 8, memory_gib: 32.0, gpu: null, platform: Linux}

# software: {numpy: 2.0.0}   # versions of packages
# settings: {steps: 18}      # whatever is needed to run the method again: text, numbers, true, false, null
# seeds: {training: 1}
# timing: null               # fpp-bench time METHOD DATASET --into submission.yaml writes it
"""


def write_template(folder: Path) -> Path:
    """Write `TEMPLATE` as ``submission.yaml`` into ``folder``, made if absent; its path.
    SubmissionError where there is one already, or where it can't be written."""
    path = folder / SUBMISSION_FILE
    name = printable(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with path.open("x", encoding="utf-8") as file:
            file.write(TEMPLATE)
    except FileExistsError:
        where = name if folder.is_dir() else printable(folder)
        raise SubmissionError(
            f"{where} is there already and is not overwritten; give another folder"
        ) from None
    except OSError as error:
        raise SubmissionError(f"{name} can't be written: {error.strerror}") from None
    return path
