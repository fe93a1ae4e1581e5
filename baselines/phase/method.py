"""The phase route as methods of ``fpp-bench predict``: with given frames, or with the fewest that a
scene needs.

The fewest are decided while capturing, without ground truth. Capture one fringe and measure: the
measurement gives its expected error, from its phase and from its order. While that error is too
large, capture the frames that reduce it (more fringes for the phase, the Gray code for the order)
and measure again. No captured frame is wasted.
"""

import operator
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.method import Answer, Assumption, Frames, Method, Setting
from fpp_ml_bench.baselines.phase.audit import measure_audited
from fpp_ml_bench.baselines.phase.depth import FringeMeasurement, Measurement, Reason
from fpp_ml_bench.baselines.phase.observe import (
    CROSSED_FRAMES,
    OneCarrier,
    TwoCarriers,
    tells_depth,
)
from fpp_ml_bench.baselines.phase.order import TERMS, terms_of
from fpp_ml_bench.baselines.phase.route import (
    AnyRoute,
    CrossedRoute,
    Measured,
    one_carrier,
    two_carriers,
)
from fpp_ml_bench.baselines.phase.settings import MIN_CONFIDENCE, PIXELWISE, Settings, steps_of
from fpp_ml_bench.coding.crossed import crossed_from_pair
from fpp_ml_bench.coding.phase_shift import PhaseShift
from fpp_ml_bench.decoding.decode import decode_stack, grey_levels
from fpp_ml_bench.errors import DecodeError, PredictionError
from fpp_ml_bench.loaders.captures.decoding import read_mask
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import DIRECTIONS, PAPER_PITCH_PX, PAPER_SEQUENCE, Direction
from fpp_ml_bench.options import option

if TYPE_CHECKING:
    from fpp_ml_bench.evaluation.submission.description import Submission

ORDER_SHARE = (0.16, 0.10, 0.05)
"""Actual error from wrong orders as a share of the expected one, with 1, 2, and 3 or more frames,
over training views (14 of each direction; measured again on version 1 of the benchmark: 0.06, 0.10
and 0.05, docs/results/frames.md). The margin of an order overestimates the probability that it is
wrong; these factors correct that."""


ONE_ALBEDO = Assumption("one albedo, a lit background", TERMS["shading"].assumes)
KNOWN_RANGE = Assumption(
    "known range",
    "Assumes that what is lit stands in the working range, in which the fringe has one period at "
    "most.",
)
RANGE_AND_WALL = Assumption(
    "known range and wall",
    "Assumes that what is lit stands in the working range, or is the wall behind it, whose "
    "distance the rig states.",
)
MASK = (
    "object mask: an image of the frames' size, above 0 on the object in every sample (default: "
    "found in each image)"
)


@dataclass(frozen=True)
class PhaseOptions(Settings):
    """Options of `PhaseMethod`: those of `Settings`, an object ``mask`` (a file of
    `captures.read_mask`), and ``error_mm``, which makes it `FewestFrames`."""

    error_mm: float | None = option(
        None,
        "instead of --frames: for each scene the fewest frames whose expected error is at most "
        "this, starting with a "
        "single fringe; may need the Gray code",
        "MM",
    )
    mask: str | Path | None = option(None, MASK, "FILE")


AUDIT = (
    "correct roll and zoom of the projector by what both phases tell across the epipolar lines, "
    "and report it"
)
"""Help of ``--audit``."""
ANYWAY = "with --audit: take frames that the calibration does not fit, too"
AUDITED = ", its calibration audited"
"""End of the title of a method with ``--audit``."""


def audited_words(settings: Mapping[str, Setting]) -> str:
    """What a short name says of the audit."""
    return ", audited" if settings.get("audit") else ""


@dataclass(frozen=True)
class CrossedOptions:
    """Options of `CrossedMethod`."""

    frames: int = option(1, "crossed frames, 1 or 3 (default: 1)", "N")
    audit: bool = option(False, AUDIT)
    anyway: bool = option(False, ANYWAY)
    min_confidence: float = option(0.0, MIN_CONFIDENCE, "C")
    mask: str | Path | None = option(None, MASK, "FILE")


class RouteMethod(Method, Generic[Measured]):
    """A method that measures every map of a sample at once by its `route`, which it puts together
    when it is made."""

    route: AnyRoute[Measured]
    mask: NDArray[np.bool_] | None = None
    audited: CrossedRoute | None = None
    """The route, where the calibration is to be audited."""
    anyway: bool = False
    """Whether a frame that the calibration does not fit is taken."""

    def use_mask(self, mask: str | Path | None) -> dict[str, str]:
        """Take the object mask of every sample from a file (`captures.read_mask`), if there is one;
        what it adds to the settings."""
        if mask is None:
            return {}
        self.mask = read_mask(Path(mask), (self.rig.camera.height, self.rig.camera.width))
        return {"mask": Path(mask).name}

    def images(self, frames: Frames) -> list[NDArray[np.uint8]]:
        """The captured frames of `frames_used`; raises `DecodeError` for one that is missing."""
        images = []
        for index in self.frames_used:
            image = frames[index] if index < len(frames) else None
            if image is None:
                used = f"frames {self.frames_used}" if len(self.frames_used) > 1 else "that frame"
                raise DecodeError(f"frame {index} is missing: {self.name} needs {used}")
            images.append(image)
        return images

    def measure(self, frames: Frames) -> Measured:
        """All maps of a captured sequence (`Measurement`); frames that are not in `frames_used` may
        be None."""
        return self.route.measure(self.images(frames), self.mask)

    def answer(self, frames: Frames) -> Answer:
        """Depth, 0 = background, or masked where ``min_confidence`` is above 0, and its standard
        uncertainty. Raises `DecodeError` for a frame that an audited calibration does not fit."""
        if self.audited is None:
            measurement: Measurement = self.measure(frames)
            return Answer(measurement.depth_mm, measurement.sigma_mm)
        measurement, audit = measure_audited(self.audited, self.images(frames), self.mask)
        if not (audit.fits or self.anyway):
            raise DecodeError(audit.finding)
        return Answer(measurement.depth_mm, measurement.sigma_mm, audit.report())

    def use_audit(self, route: CrossedRoute, wanted: bool, anyway: bool) -> dict[str, bool]:
        """Audit the calibration with every sample, if ``wanted``, and take what it does not fit
        ``anyway``; what that adds to the settings. Raises `PredictionError` for ``anyway`` alone."""
        if not wanted:
            if anyway:
                raise PredictionError(f"{self.name} --anyway: expected --audit, which it overrules")
            return {}
        self.audited, self.reports, self.anyway = route, True, anyway
        return {"audit": True} | ({"anyway": True} if anyway else {})

    def crop(self, frames: Frames) -> tuple[slice, slice]:
        seen = self.route.observe(self.images(frames), self.mask)
        return self.route.model.resampling.captured_crop(seen.crop)


class PhaseMethod(RouteMethod[FringeMeasurement]):
    """Depth from one or more sinusoids of one direction; options are those of `Settings`. ``mask``:
    a file (`captures.read_mask`) that says where the object is in every sample, instead of the
    route's own mask. Raises `PredictionError` for an unknown option or an invalid value,
    `CaptureError` for a mask that can't be used."""

    options: Settings
    name = "phase"
    purpose = "one fringe or a few, nothing learned"
    Options = PhaseOptions

    @classmethod
    def for_rig(cls, rig: Rig, **options: object) -> Method:
        """`FewestFrames` where ``error_mm`` is given."""
        options = {"direction": fringe_direction(rig), **options}
        given = cls.checked_options(PhaseOptions, options)
        if given.error_mm is None:
            return cls(rig, **options)
        if given.direction in rig.fringe_directions:
            code = rig.code(given.direction)
            if isinstance(code, PhaseShift) and not code.is_plain:
                raise PredictionError(
                    f"{cls.name}: error_mm needs fringes of one period with Gray code in half "
                    f"periods, and this rig has {code.title}; say how many frames instead"
                )
        del options["error_mm"]
        return FewestFrames(rig, given.error_mm, **options)

    def __init__(self, rig: Rig, **options: object) -> None:
        given = self.checked_options(PhaseOptions, options)
        settings = Settings(
            **{entry.name: getattr(given, entry.name) for entry in fields(Settings)}
        )
        model = OneCarrier(rig, settings)
        self.rig, self.options, self.route = rig, settings, one_carrier(model)
        sinusoids = rig.sequence.sinusoids(settings.direction)
        self.frames_used = tuple(sinusoids[step] for step in model.steps)
        frames = len(self.frames_used)
        count = (
            f"one {settings.direction} fringe"
            if frames == 1
            else f"{frames} {settings.direction} fringes"
        )
        cues, other_pitch = (
            " + ".join(["range", *terms_of(settings)]),
            pitch_setting(rig, settings.direction),
        )
        self.title = (
            f"Phase route, {count}{pitch_words(other_pitch)}, order by {cues}, nothing learned"
        )
        self.settings = asdict(settings) | self.use_mask(given.mask) | other_pitch
        self.caution = model.caution

    @classmethod
    def variants(cls, rig: Rig) -> Sequence[Mapping[str, Setting]]:
        if not rig.fringe_directions:
            return []
        few = [{"frames": 1}, {"frames": 3}] if rig.sequence.steps >= PIXELWISE else [{"frames": 1}]
        return [*few, {"error_mm": 3.0}] if rig.sequence == PAPER_SEQUENCE else few

    @classmethod
    def short_name(cls, submission: "Submission") -> str | None:
        if not submission.name.startswith("Phase route, "):
            return None
        settings = submission.settings
        direction = DIRECTIONS[DIRECTIONS.index(settings["direction"])]  # type: ignore[arg-type]
        if "error_mm" in settings:
            name = f"Phase, fewest {direction}, {float(settings['error_mm'] or 0):g} mm"
        else:
            name = f"Phase, {operator.index(settings['frames'])} {direction}"  # type: ignore[arg-type]
        name += pitch_words(settings, ", ")
        standoff = settings.get("prior") == "standoff"
        if not settings["shading"]:
            return f"{name}, standoff alone" if standoff else f"{name}, no shading"
        return f"{name}, standoff" if standoff else name

    @classmethod
    def assumption(cls, settings: Mapping[str, Setting]) -> Assumption | None:
        return fringe_assumption(settings) if settings.get("shading") is True else None


def pitch_setting(rig: Rig, direction: Direction) -> dict[str, float]:
    """What the settings of a row say of the fringes' period, in projector px and against the
    working range: nothing where it is the paper's."""
    pitch = rig.pitch(direction)
    if pitch == PAPER_PITCH_PX:
        return {}
    return {"pitch_px": pitch, "periods_in_range": round(rig.periods_in_range(direction), 2)}


def fringe_assumption(settings: Mapping[str, Setting]) -> Assumption:
    """What tells the order of one fringe with a `pitch_setting`: the range alone, if it has one
    period at most."""
    periods = settings.get("periods_in_range")
    return KNOWN_RANGE if isinstance(periods, int | float) and periods <= 1 else ONE_ALBEDO


def pitch_words(settings: Mapping[str, Setting], before: str = " of ") -> str:
    """``" of 36 px"`` for settings with a `pitch_setting`, else nothing."""
    pitch_px = settings.get("pitch_px")
    return f"{before}{pitch_px:g} px" if isinstance(pitch_px, int | float) else ""


def frames_of(rig: Rig, name: str) -> tuple[int, ...]:
    """The frames that make one crossed frame: the rig's first crossed one, or the first sinusoid of
    both directions, whose mean is one. Raises `PredictionError` for a rig without either, in the
    words of the method ``name``."""
    if crossed := rig.sequence.crossed_frames:
        return crossed[:1]
    if rig.fringe_directions == DIRECTIONS:
        return tuple(sorted(rig.sequence.sinusoids(direction)[0] for direction in DIRECTIONS))
    listed = " and ".join(rig.fringe_directions) or "no"
    raise PredictionError(
        f"{name}: needs a crossed frame, or one fringe of each direction to make it from; this rig "
        f"projects {listed} "
        "fringes. fpp-bench patterns --design proposes crossed fringes for a rig"
    )


def crossed_image(images: Sequence[NDArray]) -> NDArray[np.uint8]:
    """The crossed frame of the images of `frames_of`."""
    grey = [grey_levels(image) for image in images]
    return grey[0] if len(grey) == 1 else crossed_from_pair(grey[0], grey[1])


def shifted_carrier(rig: Rig, name: str) -> int:
    """The carrier that the rig's first three crossed frames shift. Raises `PredictionError`, in the
    words of the method ``name``, for a rig without such frames."""
    family = rig.crossed
    shifts = (
        np.zeros((0, 2))
        if family is None
        else np.asarray(family.shifts_deg[:CROSSED_FRAMES], np.float64)
    )
    if len(shifts) == CROSSED_FRAMES:
        different = [len(set(np.mod(column, 360))) for column in shifts.T]
        if sorted(different) == [1, CROSSED_FRAMES]:
            return different.index(CROSSED_FRAMES)
    found = (
        "none"
        if family is None
        else f"{len(family)} with shifts_deg {[list(pair) for pair in family.shifts_deg]}"
    )
    raise PredictionError(
        f"{name} --frames {CROSSED_FRAMES}: needs three crossed frames that shift one carrier and "
        f"keep the other "
        f"still; this rig has {found}. Build with --rig crossed, or give the rig such shifts_deg "
        f"(docs/own_rig.md)"
    )


class CrossedMethod(RouteMethod[Measurement]):
    """Depth from one crossed frame; where the rig has none, from the mean of the first fringe of
    both directions, which is one. With ``frames`` 3: from three that shift one carrier. ``mask``: a
    file (`captures.read_mask`) that says where the object is in every sample. Raises
    `PredictionError` for a rig without such frames and for an invalid option, `CaptureError` for a
    mask that can't be used."""

    name = "crossed"
    purpose = "one frame with two fringe directions, or three, nothing learned"
    Options = CrossedOptions

    @classmethod
    def scenes_rig(cls, settings: Mapping[str, Setting]) -> str:
        return "crossed"

    @classmethod
    def assumption(cls, settings: Mapping[str, Setting]) -> Assumption | None:
        return RANGE_AND_WALL

    def __init__(self, rig: Rig, **options: object) -> None:
        given = self.checked_options(CrossedOptions, options)
        self.rig, frames, moved = rig, given.frames, None
        if frames == CROSSED_FRAMES:
            self.frames_used, moved = (
                rig.sequence.crossed_frames[:CROSSED_FRAMES],
                shifted_carrier(rig, self.name),
            )
            count = "three frames"
        elif frames == 1:
            self.frames_used = frames_of(rig, self.name)
            count = "one frame" if len(self.frames_used) == 1 else "one frame, the mean of two"
        else:
            raise PredictionError(
                f"{self.name} --frames {frames}: expected 1 or {CROSSED_FRAMES} crossed frames"
            )
        model = TwoCarriers(rig, Settings(min_confidence=given.min_confidence), moved=moved)
        self.route = route = two_carriers(model)
        pitches = " and ".join(f"{pitch:g}" for pitch in model.family.pitches_px)
        audited = self.use_audit(route, given.audit, given.anyway)
        self.title = (
            f"Crossed fringes of {pitches} px, {count}, nothing learned{AUDITED if audited else ''}"
        )
        self.settings = {
            "min_confidence": given.min_confidence,
            **self.use_mask(given.mask),
            **({} if frames == 1 else {"frames": frames}),
            **audited,
        }

    @classmethod
    def variants(cls, rig: Rig) -> Sequence[Mapping[str, Setting]]:
        crossed = len(rig.sequence.crossed_frames)
        if not crossed and rig.fringe_directions != DIRECTIONS:
            return []
        return [{}, {"frames": CROSSED_FRAMES}] if crossed >= CROSSED_FRAMES else [{}]

    @classmethod
    def short_name(cls, submission: "Submission") -> str | None:
        if not submission.name.startswith("Crossed fringes "):
            return None
        count = len(submission.frames_used)
        frames = "mean of 2" if count == 2 else f"{count} frame{'s' * (count > 1)}"
        return f"Crossed, {frames}{audited_words(submission.settings)}"

    def images(self, frames: Frames) -> list[NDArray[np.uint8]]:
        images = super().images(frames)
        return images if self.settings.get("frames") == CROSSED_FRAMES else [crossed_image(images)]


def fringe_direction(rig: Rig) -> Direction:
    """The fringes to compute with where no direction is named: the only one that tells depth on the
    rig, or the horizontal one."""
    ways = rig.fringe_directions
    telling = ways if len(ways) < 2 else [way for way in ways if tells_depth(rig, way)]
    return telling[0] if len(telling) == 1 else "horizontal"


@dataclass(frozen=True)
class Look:
    """Expected error with ``frames`` frames captured, means over object pixels in mm: from the
    phase and from the order; ``gray_code``: whether the Gray code is among the frames."""

    frames: int
    gray_code: bool
    expected_error_mm: float
    by_phase_mm: float
    by_order_mm: float

    @classmethod
    def of(cls, measurement: FringeMeasurement, count: int) -> "Look":
        # A pixel without a depth because its order is ambiguous is what more frames are for.
        on_object = (measurement.depth_mm > 0) | (measurement.reason == Reason.AMBIGUOUS)
        if not on_object.any():
            return cls(count, False, 0.0, 0.0, 0.0)
        error_mm, order_mm = (
            float(values[on_object].mean(dtype=np.float64))
            for values in (measurement.expected_error_mm, measurement.order_doubt_mm)
        )
        by_phase_mm, by_order_mm = (
            error_mm - order_mm,
            order_mm * ORDER_SHARE[min(count, len(ORDER_SHARE)) - 1],
        )
        return cls(count, False, by_phase_mm + by_order_mm, by_phase_mm, by_order_mm)


def levels_of(steps: int) -> tuple[int, ...]:
    """Numbers of fringes to capture in turn, each containing the fringes before: 1, 2, 3 and more
    where ``steps`` is a multiple of three, else 1 and then all."""
    if steps % PIXELWISE:
        return (1, steps)
    levels = [1, 2, PIXELWISE]
    for fringes in (6, steps):
        if fringes > levels[-1] and set(steps_of(steps, levels[-1])) <= set(
            steps_of(steps, fringes)
        ):
            levels.append(fringes)
    return tuple(levels)


class FewestFrames(Method):
    """The phase route with as many frames of one direction as ``error_mm`` takes, scene by scene:
    1, 2 and 3 fringes a third of a period apart, then 6, then 18; the Gray code may be added from 3
    on. Frames that were not captured are never read. Further options are those of `PhaseMethod`,
    except ``frames``. Raises `PredictionError` for an error that is no positive number of mm, and
    as `PhaseMethod`."""

    options: Settings
    reports = True

    def __init__(self, rig: Rig, error_mm: float, **options: object) -> None:
        self.name = PhaseMethod.name
        if (
            isinstance(error_mm, bool)
            or not isinstance(error_mm, int | float)
            or not 0 < error_mm < np.inf
        ):
            raise PredictionError(
                f"error_mm {error_mm!r}: expected the largest error to accept, in mm, above 0"
            )
        if "frames" in options:
            raise PredictionError(
                "--frames and --error-mm: give one of them; --error-mm chooses the frames itself"
            )
        self.rig, self.error_mm = rig, float(error_mm)
        self.methods = {
            n: PhaseMethod(rig, **options, frames=n) for n in levels_of(rig.sequence.steps)
        }
        self.options = self.methods[1].options
        self.gray = tuple(rig.sequence.gray(self.options.direction))
        fringes = {index for method in self.methods.values() for index in method.frames_used}
        self.frames_used = tuple(
            sorted(fringes | set(self.gray))
        )  # all that a scene may need; most need few of them
        self.title = (
            f"Phase route, fewest {self.options.direction} fringes for {error_mm:g} mm, nothing "
            f"learned"
        )
        settings = self.methods[1].settings
        self.settings = {"error_mm": self.error_mm} | {
            key: settings[key] for key in settings if key != "frames"
        }

    def answer(self, frames: Frames) -> Answer:
        """Measure and capture more frames until the expected error is at most ``error_mm`` or no
        frame is left. The depth of the last look, and the sample's report: number of frames, their
        indices, and the expected error at each look."""
        looks: list[Look] = []
        gray = False
        for count, method in self.methods.items():
            measurement = method.measure(frames)
            depth_mm, used, look = (
                measurement.depth_mm,
                method.frames_used,
                Look.of(measurement, count),
            )
            if not gray:
                looks.append(look)
                # The Gray code helps the order only: it is captured once the phase is good enough,
                # or when no fringe is left.
                phase_done = look.by_phase_mm <= self.error_mm or count == max(self.methods)
                gray = look.expected_error_mm > self.error_mm and count >= PIXELWISE and phase_done
            if gray:
                depth_mm = decode_stack(
                    frames, self.rig, direction=self.options.direction, steps=count
                ).depth_mm
                used = tuple(sorted({*used, *self.gray}))
                looks.append(Look(len(used), True, look.by_phase_mm, look.by_phase_mm, 0.0))
            if looks[-1].expected_error_mm <= self.error_mm:
                break
        rows = [
            {
                key: round(value, 4) if key.endswith("_mm") else value
                for key, value in asdict(look).items()
            }
            for look in looks
        ]
        last = {name: rows[-1][name] for name in ("frames", "expected_error_mm")}
        return Answer(depth_mm, report=last | {"frames_used": list(used), "looks": rows})

    def summary(self, reports: Sequence[Mapping[str, Any]]) -> dict[str, float]:
        """Summary of a split's reports for the submission's settings: mean and largest number of
        frames a sample."""
        counts = [int(report["frames"]) for report in reports]
        return {"frames_mean": round(float(np.mean(counts)), 3), "frames_most": max(counts)}
