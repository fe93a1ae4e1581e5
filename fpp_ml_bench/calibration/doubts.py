"""What is improbable for a lens, for a board, or for a pair of devices, although the fit's
uncertainties are small.

Every doubt is a sentence with its figure, what is expected, and what to do; a cause is a guess, and
said to be one. A misfit is looked at from the most special cause to the most general. First, a
parameter that the model does not have: skewed pixels, a stretched or a bent board; one step of the
least squares gives its size and how much of the squared residuals it explains. Then, whether each
device fits alone, but not the two together. Then, how large the error is.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.calibration.bundle import Bundle
from fpp_ml_bench.calibration.result import Calibration
from fpp_ml_bench.optics.rig_file import CALIBRATED_PX

LEAST_EXPLAINED = 0.2
"""Share of the weighted squared residuals. On six real poses with a board whose points are 0.5% of
a spacing off, no cause explains more than 0.03; a keystone of 3% and 5% of the picture explains
0.38."""
LEAST_CAUSE = 0.002
"""Smallest skew in px per px (0.1 degrees), stretch as a share, or bend in shares of half a board:
what a ruler and a flat plate allow."""
LARGEST_RATIO = 1.5
"""Of the errors of both devices together and alone: 1.1 on real poses, 4 where a camera moved by 1%
of the baseline."""
LARGEST_RMS_PX = 1.0
"""Of camera pixels, and of projector pixels where they are no finer: good calibrations stay below
0.5."""
SQUARE = 0.005
"""How far fx / fy may be off a usual ratio, relatively. Sensors and panels are made to 0.0001; an
irregular board, which the stated uncertainties do not contain, adds 0.0004 on real poses."""
ASPECTS = (1.0, 0.5, 2.0)
"""Usual ratios: square pixels, and those of 2 : 1 that some panels have, either way round."""
FOCALS = (0.25, 30.0)
"""Focal length in longer sides of the image: a field of view of 127 degrees, or of 2."""
LARGEST_OFFSETS = (0.2, 1.0)
"""Of the principal point from the middle of camera and projector, in sides. A sensor's is centred
within a few percent; a projector's lens often looks past its panel's edge, half a side from the
middle."""
LARGEST_DISTORTIONS = (0.4, 0.15)
"""Of camera and projector: shift by the lens, as a share of the distance from its axis, at the
board's outer points. A wide lens has 0.3, projectors have 0.02."""
SIGMAS = 4.0
"""Standard uncertainties by which a figure must also exceed its limit, so that noise makes no
doubt."""
BASELINES_MM = (30.0, 10_000.0)
"""Least and largest baseline, in mm: the housings of a camera and a projector are farther apart
than the least."""
BOARDS_MM = (15.0, 1500.0)
"""Least and largest longer side of a board, in mm: printers and plates are not larger."""


SPACING = (
    "if the board's spacing or --baseline were not in mm (1 cm is 10, 1 inch 25.4), give them in mm"
)
ASPECT = (
    "the pixels are not square. Probably (a guess) the projector stretches or corrects its "
    "picture, images were "
    "resized, or, if both devices have it, the board's columns and rows are not equally far apart"
)
CENTRE = (
    "right for a part of a larger sensor or panel; otherwise tilt the board more, or give the "
    "device's own size"
)
PICTURE = (
    "Probably (a guess) a keystone or another correction of its picture is on: switch it off, use "
    "the device's own "
    "resolution, and capture the poses again"
)
SHAPE = (
    "Measure the board both ways, print without fitting to the page, glue it on a plate, or give "
    "--estimate-board"
)
LENS = (
    "tilt the board more, at more distances, and over the whole image; this model is not for "
    "fisheyes and telecentrics"
)
CAUSES: tuple[tuple[str, str, *tuple[int, ...]], ...] = (
    ("projector's pixels seem skewed by {:+.4f} px per px", PICTURE, 1),
    ("camera's pixels seem skewed by {:+.4f} px per px", PICTURE, 0),
    ("board's columns seem farther apart than its rows by {:+.2%}", SHAPE, 2),
    ("board's ends seem bent by {:+.2%} of half its side", SHAPE, 3, 4, 5),
)
"""What they are, what to do, and which of the skews (2), the board's stretch (1) and its bend
(3)."""


def doubts(
    calibration: Calibration, bundle: Bundle, x: NDArray[np.float64], root: NDArray[np.float64]
) -> Iterator[str]:
    """What is improbable about ``calibration`` at the solution ``x`` of ``bundle``, a sentence
    each; ``root``: `Bundle.spread` there."""
    if text := _cause(bundle, x) or _error(calibration):
        yield f"warning: {text}"
    board_mm = float(np.ptp(calibration.board_mm, axis=0).max())
    figures = [("baseline in mm", calibration.baseline_mm, *BASELINES_MM, SPACING)]
    figures.append(("board's longer side in mm", board_mm, *BOARDS_MM, SPACING))
    for place, (name, part) in enumerate(
        (("camera", bundle.camera), ("projector", bundle.projector))
    ):
        device = (calibration.camera, calibration.projector)[place]
        lens = device.pinhole
        sides = np.array([lens.width, lens.height])
        aspect = lens.fx / lens.fy
        usual = min(ASPECTS, key=lambda ratio: abs(np.log(aspect / ratio)))
        off = SQUARE + SIGMAS * float(
            np.linalg.norm(root[part][0] / lens.fx - root[part][1] / lens.fy)
        )
        offset = np.abs(np.array(lens.centre) - (sides - 1) / 2) / sides
        farthest = LARGEST_OFFSETS[place] + SIGMAS * float(
            (np.array(device.sigma[2:4]) / sides).max()
        )
        measured = np.concatenate([pose.measured_px[place] for pose in calibration.poses])
        shown, ideal = (
            ((measured - lens.centre) / lens.focal).T,
            np.stack(lens.normalised(*measured.T)),
        )
        distortion = float(np.nanmax(np.hypot(*(shown - ideal))) / np.nanmax(np.hypot(*shown)))
        figures += [
            (f"{name}'s fx / fy", aspect, usual * (1 - off), usual * (1 + off), ASPECT),
            (f"{name}'s focal length in longer sides", lens.fx / sides.max(), *FOCALS, LENS),
            (
                f"{name}'s principal point from the middle, in sides,",
                float(offset.max()),
                0.0,
                farthest,
                CENTRE,
            ),
            (f"{name}'s distortion", distortion, 0.0, LARGEST_DISTORTIONS[place], LENS),
        ]
    for title, value, least, most, cure in figures:
        if not least <= value <= most:
            yield f"note: the {title} is {value:.4g}, expected {least:.4g} to {most:.4g}: {cure}"


def _cause(bundle: Bundle, x: NDArray[np.float64]) -> str | None:
    """A sentence on a parameter outside the model that explains a part of the residuals, or
    None."""
    points = bundle.points_mm - bundle.points_mm.mean(axis=0)
    half_mm = np.abs(points).max()
    u, v, _ = points.T / half_mm
    shapes = np.zeros((4, *points.shape))
    shapes[0, :, 0] = u
    shapes[1:, :, 2] = u * u, u * v, v * v
    unit, fitted = np.eye(bundle.size), bundle.free.shape[1]
    columns = [
        bundle.free,
        unit[:, bundle.skews],
        unit[:, bundle.board] @ (half_mm * shapes.reshape(4, -1).T),
    ]
    estimated, bundle.free_board = bundle.free_board, True  # for derivatives by the board's points
    residuals, jacobian = bundle.system(x, range(len(bundle.poses)), np.hstack(columns))
    bundle.free_board = estimated
    for sentence, cure, *places in CAUSES[: 2 if estimated else None]:
        model = jacobian[:, [*range(fitted), *(fitted + place for place in places)]]
        amounts = np.linalg.lstsq(model, -residuals, rcond=None)[0]
        explained = 1 - ((residuals + model @ amounts) ** 2).sum() / (residuals**2).sum()
        size = max(amounts[fitted:], key=abs)
        if explained > LEAST_EXPLAINED and abs(size) > LEAST_CAUSE:
            return (
                f"the {sentence.format(size)}, which explains {explained:.0%} of the squared "
                f"residuals. {cure}"
            )
    return None


def _error(calibration: Calibration) -> str | None:
    """A sentence on an error that is too large, of the two devices together or of one of them, or
    None."""
    rms, alone = calibration.rms_px, calibration.alone_rms_px
    finer = max(1.0, calibration.projector.pinhole.fx / calibration.camera.pinhole.fx)
    figures = f"RMS {rms.camera:.3f} px in the camera, {rms.projector:.3f} px in the projector"
    if any(px > LARGEST_RATIO * own + CALIBRATED_PX for px, own in zip(rms, alone, strict=False)):
        worst = max(calibration.poses, key=lambda pose: pose.rms_px.both)
        return (
            f"camera and projector fit alone ({alone[0]:.3f} and {alone[1]:.3f} px), but not "
            f"together ({figures}). "
            "Probably (a guess) one of them was moved or refocused between the poses, or a board "
            "between its frames, "
            f"worst in {worst.name}: fasten all, and capture again"
        )
    if rms.camera > LARGEST_RMS_PX or rms.projector > LARGEST_RMS_PX * finer:
        return (
            f"{figures}, expected below {LARGEST_RMS_PX:g} and {LARGEST_RMS_PX * finer:.2g}: look "
            f"at the residuals in "
            "the picture beside the rig file, at focus and exposure, and whether the board is flat"
        )
    return None
