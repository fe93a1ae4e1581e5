"""From frames to depth: observe -> candidates -> order -> depth, four stops that no frame visits twice."""

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase.calibration_layer import Image, Mask
from fpp_ml_bench.baselines.phase.candidates import crossed_candidates, fringe_candidates
from fpp_ml_bench.baselines.phase.depth import (
    Fitted,
    FringeMeasurement,
    Measurement,
    crossed_depth,
    fitted,
    fringe_depth,
)
from fpp_ml_bench.baselines.phase.observe import CrossedObservation, Frames, Observation, OneCarrier, TwoCarriers
from fpp_ml_bench.baselines.phase.order import crossed_order, fringe_order, margin_by_range
from fpp_ml_bench.errors import DecodeError


class PhaseRoute(OneCarrier):
    """The route of fringes of one direction. Of resampled images `rig`, `layer`, `period_px` and observations are those
    of the resampled ones; images, masks and measurements have the captured size."""

    def measure(self, image: Frames, mask: Mask | None = None) -> FringeMeasurement:
        """Depth and the maps behind it; arguments and errors as of `observe`."""
        seen = self.observe(image, mask)
        return self.conclude(seen, *self.choose(seen))

    def choose(self, seen: Observation) -> tuple[NDArray[np.int32], Image]:
        """The order of every pixel of the observation's crop (h, w), and its margin, without learning."""
        offered = fringe_candidates(seen)
        seen.watch.done("candidates")
        return fringe_order(seen, offered, self.settings)

    def conclude(
        self,
        seen: Observation,
        order: NDArray[np.int32],
        margin: NDArray[np.floating],
        least_margin: float = -np.inf,
    ) -> FringeMeasurement:
        """The measurement that follows from an ``order`` int32 for each pixel of the observation's crop (h, w), however
        it was chosen; ``margin`` (h, w): how clearly that order won, 0 for a tie, 1 or more for a clear choice. A pixel
        of less than ``least_margin`` has no depth, as always a tie in light that nothing calibrates. Raises
        `DecodeError` for shapes that are not the crop's."""
        if np.shape(order) != seen.inside.shape or np.shape(margin) != seen.inside.shape:
            raise DecodeError(
                f"expected an order and a margin for each of the {seen.inside.shape} pixels (h, w) around the object, "
                f"got {np.shape(order)} and {np.shape(margin)}"
            )
        if not seen.background.calibrated:  # no evidence about the order, whatever the choice preferred
            margin = margin_by_range(seen, order)
        seen.watch.done("order")
        return fringe_depth(self, seen, order, margin, least_margin)


class CrossedRoute(TwoCarriers):
    """The route of fringes of two directions in one frame, or in three; sizes as of `PhaseRoute`."""

    def measure(self, image: Frames, mask: Mask | None = None) -> Measurement:
        """Depth and the maps behind it; arguments and errors as of `observe`."""
        return self.conclude(self.fitted(self.observe(image, mask)))

    def fitted(self, seen: CrossedObservation) -> Fitted:
        """The order of every pixel, and the nearness that follows."""
        offered = crossed_candidates(seen)
        seen.watch.done("candidates")
        order = crossed_order(seen, offered, self.settings)
        seen.watch.done("order")
        return fitted(seen, order)

    def conclude(self, seen: Fitted, wrong_chance: Image | None = None) -> Measurement:
        """The measurement that follows from a fit. ``wrong_chance`` (h, w): probability of a wrong order, by default
        from evidence and margin."""
        return crossed_depth(self, seen, wrong_chance)
