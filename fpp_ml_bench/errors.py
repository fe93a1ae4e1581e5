"""The errors this package raises. A message says what was expected, what came, in which file or
sample, and what to do.

Commands print an `FppBenchError` and exit with status 2.
"""


class FppBenchError(Exception):
    """Base of all errors this package raises on purpose."""


class RigError(FppBenchError, ValueError):
    """A rig that is not a usable camera-projector pair."""


class DecodeError(FppBenchError, ValueError):
    """Frames that can't be decoded at all."""


class CaptureError(FppBenchError, ValueError):
    """Captured images that can't be read as frames, or results of a capture that can't be
    written."""


class CalibrationError(FppBenchError, ValueError):
    """A board that is not found, or captures that don't determine a rig, or contradict each
    other."""


class MeshError(FppBenchError, ValueError):
    """A mesh that can't be read, is empty, or does not fit the working range."""


class DatasetError(FppBenchError):
    """A dataset folder that is absent, incomplete, damaged or of another version."""


class LayoutError(DatasetError):
    """A published tree that breaks a rule of its layout."""


class BuildError(DatasetError):
    """A build that can't start or can't go on."""


class PredictionError(FppBenchError, ValueError):
    """Predictions that can't be scored; ``problems`` holds a line for each wrong or missing
    prediction."""

    def __init__(self, summary: str, problems: list[str] | None = None) -> None:
        self.problems = problems or []
        super().__init__("\n  ".join([summary, *self.problems]))


class SubmissionError(FppBenchError, ValueError):
    """A submission description or result file with missing or wrong entries."""


class NetworkError(FppBenchError, ValueError):
    """An unknown network or option, or an unsupported input size."""


class RecipeError(FppBenchError, ValueError):
    """A recipe with an unknown key or an impossible value."""


class TrainingError(FppBenchError):
    """A training that diverged, or that can't start or go on."""


class WeightsError(FppBenchError):
    """A weights file that is damaged, foreign, or made for other data."""


class DiagnosisError(FppBenchError, ValueError):
    """A model that can't be diagnosed this way, or an unknown probe or layer."""


class StabilityError(FppBenchError, ValueError):
    """An unknown group of stability cases."""


class PoolError(FppBenchError):
    """Worker processes or a cluster that died, or a cluster that can't be used."""


class RemoteError(FppBenchError):
    """A URL, or a dataset of the Hugging Face Hub, that can't be read or written."""


class PublishError(FppBenchError):
    """Data or results that can't be published: no token, no network, refused by the Hub, or
    incomplete."""
