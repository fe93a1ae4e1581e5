"""Writing a measured timing into an existing ``submission.yaml`` or ``result.json``, and into no other method's."""

from pathlib import Path

from fpp_ml_bench.baselines.methods import Method
from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.result_io import read_result, write_result
from fpp_ml_bench.evaluation.submission import SUBMISSION_FILE, Submission, read_submission
from fpp_ml_bench.evaluation.text import printable
from fpp_ml_bench.evaluation.timing import Timing
from fpp_ml_bench.loaders.manifest import write_atomically


def check_target(path: Path, method: Method) -> None:
    """Refuse, before any work, a file that is no submission or result, or that describes another method.

    Raises SubmissionError, which says what differs.
    """
    submission = read_result(path).submission if _is_result(path) else _described(path)
    method_entries = {"method": method.name, "frames_used": list(method.frames_used), "settings": dict(method.settings)}
    file_entries = {
        "method": submission.method,
        "frames_used": sorted(submission.frames_used),
        "settings": dict(submission.settings),
    }
    for key, value in method_entries.items():
        if file_entries[key] != value:
            raise SubmissionError(
                f"{printable(str(path), 500)}: {key} is {printable(file_entries[key])}, but {printable(value)} would "
                "be timed; a time belongs to the method that was scored: give the same options"
            )


def write_timing(path: Path, timing: Timing) -> None:
    """Put ``timing`` into the file, with ``seconds_per_sample`` and ``hardware`` as measured. See `check_target`."""
    measured = {
        "seconds_per_sample": timing.latency_median_ms / 1000,
        "seconds_source": "measured",
        "hardware": timing.hardware.model_dump(mode="json"),
        "timing": timing.model_dump(mode="json"),
    }
    if _is_result(path):
        result = read_result(path)
        submission = Submission.model_validate({**result.submission.model_dump(mode="json"), **measured})
        write_result(result.model_copy(update={"submission": submission}), path)
        return
    import yaml

    content = {**_described(path).model_dump(mode="json"), **measured}
    Submission.model_validate(content)
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
    try:
        write_atomically(path, text.encode("utf-8"))
    except OSError as error:
        raise SubmissionError(f"{printable(str(path), 500)} can't be written: {error.strerror}") from None


def _is_result(path: Path) -> bool:
    return path.suffix == ".json"


def _described(path: Path) -> Submission:
    if path.name != SUBMISSION_FILE:
        raise SubmissionError(f"{printable(str(path), 500)}: expected a {SUBMISSION_FILE} or a result file (*.json)")
    return read_submission(path.parent)
