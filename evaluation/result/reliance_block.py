"""Phase reliance as part of a result: how far a method's answers follow the phase of the fringes.

``fpp_ml_bench.baselines.diagnostics.phase_reliance`` defines it and measures it on counterfactual scenes; this module
is the form of its block in a result file.
"""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from fpp_ml_bench.evaluation.result.parts import Interval, Sha256
from fpp_ml_bench.evaluation.schema import NonNegative, Share, StrictModel, Text

RelianceVersion = Literal["1.0.0"]
RELIANCE_VERSION: RelianceVersion = "1.0.0"
"""Version of the score's definition and of the scenes; scores of different versions are not compared."""


class RelianceParts(StrictModel):
    """The parts of the score, and further measurements; means over samples, null where a part can't be measured.

    ``follows_*``: how far the answer follows, in [0, 1], when a surface moves within its outline. ``phase``: only the
    phase is that of the moved surface, every pixel keeps its brightness (part of the score). ``light``: only the
    brightness is. ``both``: both, as a camera would see it. ``constant``: the phase alone, moved by a constant.
    ``change_*``: how much the answer changes, relative to the change that the phase asks for: with another outline
    (part of the score), without fringes inside or outside the object, with fringes of the other direction or of
    another pitch. ``answered_*``: share of the object's pixels that have an answer in that case. ``order_free_*``:
    the same, allowing whole periods.
    """

    follows_phase: Share | None
    follows_light: Share | None
    follows_both: Share | None
    follows_constant: Share | None
    change_outline: NonNegative | None
    change_no_fringe_inside: NonNegative | None
    change_no_fringe_outside: NonNegative | None
    change_other_direction: NonNegative | None
    change_other_pitch: NonNegative | None
    answered_no_fringe_inside: Share | None
    answered_no_fringe_outside: Share | None
    order_free_follows_phase: Share | None
    order_free_change_outline: NonNegative | None


PART_TITLES = {
    "follows_phase": "follows the phase, within the object, brightness unchanged",
    "follows_light": "follows the brightness, phase unchanged",
    "follows_both": "follows a moved surface as it would be photographed",
    "follows_constant": "follows the phase when all of the object moves",
    "change_outline": "changes with another outline",
    "change_no_fringe_inside": "changes without fringes inside the object",
    "change_no_fringe_outside": "changes without fringes outside the object",
    "change_other_direction": "changes with fringes of the other direction",
    "change_other_pitch": "changes with fringes of another pitch",
    "answered_no_fringe_inside": "share answered without fringes inside",
    "answered_no_fringe_outside": "share answered without fringes outside",
    "order_free_follows_phase": "follows the phase, whole periods aside",
    "order_free_change_outline": "changes with another outline, whole periods aside",
}
"""Each part in words."""


class Reliance(StrictModel):
    """The phase-reliance score in [0, 1] with its 95% interval (bootstrap over objects; nulls below two objects).

    ``order_free_score`` allows whole periods and is null where the answer is not in mm. ``units`` are those of the
    answer that was held against the truth; ``weights_sha256`` of a network is that of its weights file.
    """

    version: RelianceVersion
    score: Share
    interval: Interval
    order_free_score: Share | None
    parts: RelianceParts
    units: Literal["mm", "normalised"]
    direction: Literal["horizontal", "vertical"]
    samples: Annotated[int, Field(gt=0)]
    objects: Annotated[int, Field(gt=0)]
    dataset_fingerprint: Sha256
    protocol_version: Text
    weights_sha256: Sha256 | None

    @model_validator(mode="after")
    def _consistent(self) -> "Reliance":
        low, high = self.interval
        if (low is None) != (high is None):
            raise ValueError("interval: expected two numbers or two nulls")
        if low is not None and high is not None and not 0 <= low <= high <= 1:
            raise ValueError("interval: expected 0 <= low <= high <= 1")
        if self.objects > self.samples:
            raise ValueError("objects is above samples")
        return self
