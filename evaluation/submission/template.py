"""A ``submission.yaml`` to fill in."""

from pathlib import Path

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.submission.prediction_files import SUBMISSION_FILE
from fpp_ml_bench.files import printable

TEMPLATE = """\
# Describes the predictions beside this file: one {sample}.npy for each sample, float32 (H, W), 0 = not measured.
# Lines that begin with "# " and a key are optional: remove the "# " to use them. evaluation/PROTOCOL.md explains all.

name: My method              # what the leaderboard shows, up to 200 characters
method: my-method            # a short name for the kind of method
units: mm                    # of the files: mm, m or normalised (then uses_ground_truth_range must be true)
# png_mm_per_level: 0.05     # with 16-bit .png files only: the mm of one grey level

frames_used: [0]             # indices into the dataset's frame sequence, from 0
uses_ground_truth_range: false   # was the method given depth_min and depth_max of the scored samples?
# range_rule: object         # with units: normalised only: over which pixels that range is, object or valid (not void)
# uses_ground_truth_mask: true   # was it given which pixels of the scored samples are object?
# uses_ground_truth_order: true  # was it given their true fringe orders?
# learned_from:              # what data it learned from
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
    """Write `TEMPLATE` as ``submission.yaml`` into ``folder``, made if absent; its path. SubmissionError where there is
    one already, or where it can't be written."""
    path = folder / SUBMISSION_FILE
    name = printable(str(path), 500)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with path.open("x", encoding="utf-8") as file:
            file.write(TEMPLATE)
    except FileExistsError:
        where = name if folder.is_dir() else printable(str(folder), 500)
        raise SubmissionError(f"{where} is there already and is not overwritten; give another folder") from None
    except OSError as error:
        raise SubmissionError(f"{name} can't be written: {error.strerror}") from None
    return path
