"""A method's way from frames to depth: four stops, put together of parts.

What a rig photographs is a *measurement model*, one carrier (`OneCarrier`) or two (`TwoCarriers`);
`one_carrier` and `two_carriers` put its measured parts together. A learned method gives parts of
its own: what measures the ``phases`` of an observation, or what a network makes of the chosen
order, its mask and its phase (``learned``).

>>> from fpp_ml_bench.baselines.phase.observe import OneCarrier
>>> route = one_carrier(OneCarrier(rig))
>>> route.measure(frame).depth_mm
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Generic, Protocol, TypeVar

from fpp_ml_bench.baselines.phase.candidates import (
    CrossedCandidates,
    FringeCandidates,
    crossed_candidates,
    fringe_candidates,
)
from fpp_ml_bench.baselines.phase.depth import (
    Fitted,
    FringeMeasurement,
    Measurement,
    crossed_depth,
    crossed_nearness,
    fringe_depth,
)
from fpp_ml_bench.baselines.phase.geometry import Mask
from fpp_ml_bench.baselines.phase.observe import (
    Capture,
    CrossedObservation,
    Frames,
    MeasurementModel,
    Observation,
    OneCarrier,
    TwoCarriers,
)
from fpp_ml_bench.baselines.phase.order import FringeOrder, fringe_order

ModelT = TypeVar("ModelT", bound=MeasurementModel)
Seen = TypeVar("Seen", bound=Capture)
Offered = TypeVar("Offered")
Chosen = TypeVar("Chosen")
Measured = TypeVar("Measured", bound=Measurement)
Measured_co = TypeVar("Measured_co", bound=Measurement, covariant=True)


@dataclass(frozen=True)
class Route(Generic[ModelT, Seen, Offered, Chosen, Measured]):
    """The parts of a route, each a function of what the part before it gave. ``phases`` and
    ``learned`` change it, or are None in a route in which nothing is learned."""

    model: ModelT
    observe: Callable[[Frames, Mask | None], Seen]
    candidates: Callable[[Seen], Offered]
    order: Callable[[Seen, Offered], Chosen]
    depth: Callable[[Chosen], Measured]
    phases: Callable[[Seen], Seen] | None = None
    learned: Callable[[Chosen], Chosen] | None = None

    def measure(self, frames: Frames, mask: Mask | None = None) -> Measured:
        """Depth and the maps behind it, of captured frames uint8 (H, W) or float32 grey levels of
        the same range: one, or as many as the model has. ``mask`` bool (H, W) replaces the object
        mask that is found. Raises `DecodeError` for another number, dtype or shape."""
        # What the frames show before any order is chosen: background, object mask, phase and
        # brightness.
        seen = self.observe(frames, mask)
        chosen = self.choose(seen)
        # A network answers for the mask, the order, and what the phase is off by; the depth is
        # computed all the same.
        if self.learned is not None:
            chosen = self.learned(chosen)
        # Closed form, with its uncertainty and the reasons not to trust a pixel.
        return self.depth(chosen)

    def choose(self, seen: Seen) -> Chosen:
        """The order of every pixel of an observation, before ``learned``."""
        if self.phases is not None and seen.inside.any():
            seen = self.phases(seen)
        # The depths that the phase allows within the working range, and what is known of each.
        offered = self.candidates(seen)
        # By what each of them costs, and by neighbours.
        return self.order(seen, offered)


class AnyRoute(Protocol[Measured_co]):
    """What a method uses of its route, of one carrier or two."""

    @property
    def model(self) -> MeasurementModel: ...
    def measure(self, frames: Frames, mask: Mask | None = None) -> Measured_co: ...
    @property
    def observe(self) -> Callable[[Frames, Mask | None], Capture]: ...


FringeRoute = Route[OneCarrier, Observation, FringeCandidates, FringeOrder, FringeMeasurement]
CrossedRoute = Route[TwoCarriers, CrossedObservation, CrossedCandidates, Fitted, Measurement]


def one_carrier(
    model: OneCarrier,
    phases: Callable[[Observation], Observation] | None = None,
    learned: Callable[[FringeOrder], FringeOrder] | None = None,
) -> FringeRoute:
    """The route of fringes of one direction."""
    order = partial(fringe_order, model.settings)
    depth = partial(fringe_depth, model)
    return Route(model, model.observe, fringe_candidates, order, depth, phases, learned)


def two_carriers(
    model: TwoCarriers,
    phases: Callable[[CrossedObservation], CrossedObservation] | None = None,
    learned: Callable[[Fitted], Fitted] | None = None,
) -> CrossedRoute:
    """The route of fringes of two directions in one frame, or in three."""
    order = partial(crossed_nearness, model.settings)
    depth = partial(crossed_depth, model)
    return Route(model, model.observe, crossed_candidates, order, depth, phases, learned)
