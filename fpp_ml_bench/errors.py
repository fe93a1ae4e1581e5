"""What can go wrong, as one small tree.

::

    FppBenchError                 anything this package refuses; commands print it and exit with status 2
    ├── RigError                  a rig file or rig value that is no usable camera-projector pair
    ├── DecodeError               frames that can't be decoded at all (shape, dtype, missing frames)
    ├── MeshError                 a mesh that can't be read, is empty, or does not fit the working range
    ├── DatasetError              a dataset folder that is absent, incomplete, damaged or of another version
    │   ├── LayoutError           a published tree that breaks a rule of its layout
    │   └── BuildError            a build that can't start or go on (locked, other settings, disk full)
    ├── PredictionError           predictions that can't be scored: missing, extra, mis-shaped, not finite
    ├── SubmissionError           a submission.yaml or result file that does not say what it must
    ├── NetworkError              a network, an option or an input size that there is not
    ├── RecipeError               a recipe with an unknown key or an impossible value
    ├── TrainingError             a training that diverged, or that can't start or go on
    ├── WeightsError              a weights file that is damaged, foreign or made for other data
    ├── DiagnosisError            a model that can't be looked into as asked, a probe or a layer that there is not
    ├── StabilityError            a group of stability cases that there is not
    └── PublishError              something that can't be published: no token, no network, refused by the Hub

A message says what was expected, what came, in which file or sample, and what to do.
"""


class FppBenchError(Exception):
    """Base of every error this package raises on purpose."""


class RigError(FppBenchError, ValueError):
    """A rig that is no usable camera-projector pair."""


class DecodeError(FppBenchError, ValueError):
    """Frames that can't be decoded at all."""


class MeshError(FppBenchError, ValueError):
    """A mesh that can't be read, is empty, or does not fit the working range."""


class DatasetError(FppBenchError):
    """A dataset folder that is absent, incomplete, damaged or of another version."""


class LayoutError(DatasetError):
    """A published tree that breaks a rule of its layout."""


class BuildError(DatasetError):
    """A build that can't start or can't go on."""


class PredictionError(FppBenchError, ValueError):
    """Predictions that can't be scored; ``problems`` holds one line for each offender."""

    def __init__(self, summary: str, problems: list[str] | None = None) -> None:
        self.problems = problems or []
        super().__init__("\n  ".join([summary, *self.problems]))


class SubmissionError(FppBenchError, ValueError):
    """A submission description or result file that does not say what it must."""


class NetworkError(FppBenchError, ValueError):
    """A network, an option or an input size that there is not."""


class RecipeError(FppBenchError, ValueError):
    """A recipe with an unknown key or an impossible value."""


class TrainingError(FppBenchError):
    """A training that diverged, or that can't start or go on."""


class WeightsError(FppBenchError):
    """A weights file that is damaged, foreign, or made for other data."""


class DiagnosisError(FppBenchError, ValueError):
    """A model that can't be looked into as asked, or a probe or a layer that there is not."""


class StabilityError(FppBenchError, ValueError):
    """A group of stability cases that there is not."""


class PublishError(FppBenchError):
    """Something that can't be published: no token, no network, refused by the Hub, not fit to be shown."""
