"""A capture to depth: decoding with everything a user wants to know about it, a dataset of a
scanner's captures, and captures of a calibration board, a folder of frames for each pose, to the
points that a calibration needs.

In a dataset each capture is decoded by the scanner's rig into the ground truth ``depth``, through
the same crash-safe assembly as a build. What the rig can't decode is background there.
"""

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.calibration.boards import Board
from fpp_ml_bench.calibration.projector_points import (
    Levels,
    Pose,
    Response,
    fit_response,
    levels_of,
    measure_pose,
)
from fpp_ml_bench.calibration.result import Calibration
from fpp_ml_bench.calibration.solve import FEWEST_POSES, raise_all
from fpp_ml_bench.calibration.volume import Places, depth_spread
from fpp_ml_bench.coding.code import MIN_MODULATION, Limits, Reason
from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.decoding.decode import Decoded, Directions, check_limits, decode_stack
from fpp_ml_bench.decoding.triangulation import (
    ASSUMED_NOISE_GREY,
    ROUNDING_GREY,
    coordinate_slope_px_per_mm,
    depth_budget_mm,
    depth_sigma_mm,
    noise_of_frames,
)
from fpp_ml_bench.errors import CalibrationError, CaptureError, DecodeError
from fpp_ml_bench.examination.examine import examine
from fpp_ml_bench.examination.findings import Examination, Finding, RefusedCapture
from fpp_ml_bench.files import file_content, first_of, visible
from fpp_ml_bench.loaders.captures.images import (
    LOSSLESS,
    LOSSY,
    Capture,
    CapturedFrames,
    Splits,
    check_options,
    find_captures,
    read_frames,
    split_captures,
)
from fpp_ml_bench.loaders.published.importing import RowReader, import_plan
from fpp_ml_bench.loaders.sample import Row
from fpp_ml_bench.loaders.storage.assembly import Assembly, Progress
from fpp_ml_bench.loaders.storage.manifest import CAPTURED, Manifest
from fpp_ml_bench.loaders.storage.shards import ShardPlan, plan_rows
from fpp_ml_bench.optics.rig import Rig, rotation_matrix
from fpp_ml_bench.optics.rig_file import load_projection
from fpp_ml_bench.optics.sequence import AXES, Direction

CLIPPED_SHARE = 0.02
"""A frame in which more of the lit pixels than this are at full scale is named."""
LEAST_DECODED_SHARE = 0.005
"""Of a capture's pixels. Below it nothing was measured but noise that passed by chance."""
CAUSES = {
    Reason.NO_RAY: "the rig's lens model or pose is not this scanner's",
    Reason.LOW_MODULATION: "the fringes are too faint (too dark, overexposed, --min-modulation), or the frames are not "
    "in the order of the rig's sequence",
    Reason.SATURATED: "the frames are overexposed",
    Reason.INCONSISTENT_ORDER: "the sequence (order, steps, sign, pitches, Gray code) is not what was projected",
    Reason.OUTSIDE_PATTERN: "the sequence (order, sign, pitches) or the projector's size is not what was projected",
    Reason.DIRECTIONS_DISAGREE: "the rig's pose is not this scanner's, or the directions are swapped",
    Reason.OUTSIDE_RANGE: "working_range_mm does not hold the object (--working-range), or the rig's pose or unit is "
    "not this scanner's",
}
"""Why nothing is decoded, by the reason of most pixels."""
JPEG_BLOCK_PX = 8
RANGE_MARGIN = 0.1
"""A calibrated rig's working range is that of the boards' points, widened by this share of their
distance."""


@dataclass(frozen=True)
class DecodedCapture:
    """A decoded capture: maps (H, W) of standard uncertainty by noise in mm (0 = no depth),
    modulation and mean of the frames in grey levels; the noise of a frame, and whether it was
    estimated from the frames; medians over the pixels of what each source adds to the uncertainty,
    ``budget_mm`` (`depth_budget_mm`), and of the depth that a period is of each direction,
    ``period_mm``; ``notes`` are sentences; ``examination``: what the frames say about
    themselves."""

    decoded: Decoded
    sigma_mm: NDArray[np.float32]
    modulation: NDArray[np.float32]
    grey: NDArray[np.float32]
    noise_grey: float
    noise_measured: bool
    budget_mm: Mapping[str, float]
    period_mm: Mapping[str, float]
    notes: tuple[str, ...]
    examination: Examination


def decode_capture(
    capture: CapturedFrames,
    rig: Rig,
    direction: Directions = "both",
    *,
    mask: NDArray[np.bool_] | None = None,
    min_modulation: float = MIN_MODULATION,
    noise_grey: float | None = None,
    threads: int = 1,
    anyway: bool = False,
) -> DecodedCapture:
    """Depth of a capture and what goes with it; arguments as in `decode_stack`. ``noise_grey``: of
    a frame, by default measured where there are four steps and more, else `ASSUMED_NOISE_GREY`. The
    frames are examined first: raises `RefusedCapture` where a finding makes the depth
    untrustworthy, unless ``anyway``; `CaptureError` for images of another size than the rig's,
    `DecodeError` where nothing can be decoded."""
    frames, limits = capture.frames, Limits(min_modulation=min_modulation)
    decoded, examination = _examined_and_decoded(
        capture, rig, limits, anyway, direction, mask, threads
    )
    modulation = np.nanmax([measured.modulation for measured in decoded.details.values()], axis=0)
    measured_grey = noise_of_frames(list(frames), rig) if noise_grey is None else None
    noise = noise_grey if noise_grey is not None else measured_grey or ASSUMED_NOISE_GREY
    notes = [capture.note] if capture.note else []
    if noise_grey is None and measured_grey is None:
        notes.append(
            f"three steps can't tell their noise; {noise:g} grey level assumed, --noise sets it"
        )
    notes += _clipped(capture, modulation >= min_modulation, examination.full_grey)
    if not decoded.depth_mm.any():
        reason = _main_reason(decoded)
        raise DecodeError(
            f"no pixel could be decoded; of most pixels: {reason.words}; probably {CAUSES[reason]}"
        )
    systematic_rad = examination.systematic_rad
    sigma_mm = depth_sigma_mm(decoded, rig, noise, systematic_rad=systematic_rad)
    rounding_grey = ROUNDING_GREY * GREY_LEVELS / capture.full_scale
    budget_mm = depth_budget_mm(decoded, rig, noise, systematic_rad, rounding_grey)
    grey = frames.mean(axis=0, dtype=np.float64).astype(np.float32)
    return DecodedCapture(
        decoded,
        sigma_mm,
        modulation,
        grey,
        noise,
        measured_grey is not None,
        {source: float(np.median(part)) for source, part in budget_mm.items()},
        _period_mm(decoded, rig),
        tuple(notes),
        examination,
    )


def _period_mm(decoded: Decoded, rig: Rig) -> dict[str, float]:
    """How far a wrong order moves the depth, by direction: the median over decoded pixels."""
    valid = decoded.depth_mm > 0
    x, y = (axis[valid] for axis in rig.camera.rays())
    return {
        direction: float(
            np.median(
                rig.code(direction).pitch_px
                / np.abs(
                    coordinate_slope_px_per_mm(rig, decoded.depth_mm[valid], direction, (x, y))
                )
            )
        )
        for direction in decoded.details
    }


def _examined_and_decoded(
    capture: CapturedFrames,
    rig: Rig,
    limits: Limits,
    anyway: bool,
    direction: Directions = "both",
    mask: NDArray[np.bool_] | None = None,
    threads: int = 1,
    calibrated: bool = True,
) -> tuple[Decoded, Examination]:
    """The capture decoded, after what its frames say about themselves (`fpp_ml_bench.examination`).
    Raises `CaptureError` for images of another size than the rig's, `RigError` for a direction that
    it does not code, and unless ``anyway`` `RefusedCapture` where a finding makes the depth
    untrustworthy."""
    height, width = capture.frames.shape[1:]
    folder = capture.files[0].parent
    if (height, width) != (rig.camera.height, rig.camera.width):
        raise CaptureError(
            f"{folder}: frames of {width} x {height} px, and the rig has a camera of "
            f"{rig.camera.width} x {rig.camera.height} px; give the rig that took them"
        )
    directions: tuple[Direction, ...] = rig.directions if direction == "both" else (direction,)
    check_limits(limits)
    examination = examine(
        capture.frames,
        rig,
        capture.names,
        directions=directions,
        mask=mask,
        limits=limits,
        calibrated=calibrated,
    )
    if capture.lossy:
        found = _compressed(capture), *examination.findings
        examination = replace(examination, findings=found)
    if examination.refused and not anyway:
        raise RefusedCapture(str(folder), examination)
    frames = capture.frames
    if examination.full_grey < GREY_LEVELS:
        frames = np.where(frames >= examination.full_grey, frames.dtype.type(GREY_LEVELS), frames)
    decoded = decode_stack(
        frames, rig, direction, mask=mask, limits=limits, details=True, threads=threads
    )
    return decoded, examination


def _compressed(capture: CapturedFrames) -> Finding:
    """What compression did to frames of which some are JPEG."""
    steps = np.abs(np.diff(capture.frames.astype(np.float64), axis=-1)).mean(axis=(0, 1))
    borders = np.arange(len(steps)) % JPEG_BLOCK_PX == JPEG_BLOCK_PX - 1
    across, between = (
        float(steps[where].sum() / max(where.sum(), 1)) for where in (borders, ~borders)
    )
    first, *others = capture.lossy
    named = f"{first.name} and {len(others)} more are" if others else f"{first.name} is"
    return Finding(
        "compressed with loss",
        "refuse",
        f"{named} {LOSSY}: grey levels change by {across:.2f} across a border of blocks and by "
        f"{between:.2f} elsewhere",
        "JPEG",
        LOSSLESS,
    )


def _main_reason(decoded: Decoded) -> Reason:
    """The reason of most pixels without depth."""
    return max(CAUSES, key=lambda reason: decoded.counts[reason.name.lower()])


def _clipped(capture: CapturedFrames, lit: NDArray[np.bool_], full_grey: float) -> list[str]:
    shares = {
        name: float((frame[lit] >= full_grey).mean()) if lit.any() else 0.0
        for name, frame in zip(capture.names, capture.frames, strict=True)
    }
    high = [
        f"{name} ({100 * share:.0f}%)" for name, share in shares.items() if share > CLIPPED_SHARE
    ]
    piled = (
        f", where levels pile up at {full_grey:.0f} of {GREY_LEVELS}"
        if full_grey < GREY_LEVELS
        else ""
    )
    return [f"saturated on lit pixels{piled}: {first_of(high, 4)}; expose less"] if high else []


def read_mask(file: Path, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Where an image or .npy file is not 0, bool (H, W). Raises `CaptureError` for another file or
    ``shape``, and where all of it is 0."""
    if file.suffix.lower() == ".npy":
        content = file_content(
            file,
            8 * shape[0] * shape[1] + (1 << 14),
            CaptureError,
            "give a mask of the frames' size",
        )
        try:
            values = np.load(io.BytesIO(content), allow_pickle=False)
        except (ValueError, EOFError) as error:
            raise CaptureError(
                f"{file}: expected a mask as .npy, can't be read: {error}"
            ) from error
    else:
        values = read_frames(file).frames[0]
    if values.shape != shape:
        raise CaptureError(
            f"{file}: expected a mask of (H, W) = {shape} like the frames, got {values.shape}"
        )
    mask: NDArray[np.bool_] = np.nan_to_num(values) != 0
    if not mask.any():
        raise CaptureError(f"{file}: shows no object: all pixels are 0")
    return mask


@dataclass(frozen=True)
class CaptureReader(RowReader):
    """Reads and decodes captures."""

    limits: Limits
    bits: int | None
    colour: str | None
    anyway: frozenset[str] = frozenset()

    def refusal(self, problems: list[str]) -> CaptureError:
        return CaptureError("\n  ".join(problems))

    def read(self, capture: Capture) -> Row:
        """The capture's row: frames of 8 bits, and depth from the frames as they were captured.
        Raises `CaptureError` for frames that can't be read, that are of another size than the rig's
        camera, that the examination refuses (unless ``anyway``), and that give almost no depth."""
        captured = read_frames(capture.files, bits=self.bits, colour=self.colour, lossy=True)
        try:
            decoded, examination = _examined_and_decoded(
                captured, self.rig, self.limits, capture.sample in self.anyway
            )
        except DecodeError as error:
            raise CaptureError(f"{capture.folder}: {error}") from error
        good, rounded = decoded.reason == Reason.DECODED, captured.frames.dtype != np.uint8
        decoded_share = float(good.mean())
        shares = {
            name: count / good.size
            for name, count in decoded.counts.items()
            if count and name != "decoded"
        }
        if decoded_share < LEAST_DECODED_SHARE:
            reason = _main_reason(decoded)
            share = shares.get(reason.name.lower(), 0.0)
            raise CaptureError(
                f"{capture.folder}: only {100 * decoded_share:.2f}% of the pixels can be decoded, "
                f"expected "
                f"at least {100 * LEAST_DECODED_SHARE:g}%; {100 * share:.0f}% are refused as "
                f"{reason.words}: probably {CAUSES[reason]}"
            )
        weakest = np.minimum.reduce([measured.modulation for measured in decoded.details.values()])
        measured = {
            "decoded_share": decoded_share,
            "median_modulation": float(np.median(weakest[good])),
            "refused_share": shares,
            "full_scale": captured.full_scale,
            "rounded": rounded,
            "note": captured.note,
            "findings": [str(finding) for finding in examination.findings],
        }
        frames = {
            i: np.rint(frame).astype(np.uint8) if rounded else frame
            for i, frame in enumerate(captured.frames)
        }
        return Row(
            capture.sample, capture.object, capture.view, frames, decoded.depth_mm, None, measured
        )


def plan_captures(
    root: Path,
    rig: Rig,
    splits: Splits | None = None,
    limits: Limits | None = None,
    bits: int | None = None,
    colour: str | None = None,
    anyway: bool = False,
) -> Assembly[CaptureReader]:
    """Find the captures ``root/{object}/{view}/`` or ``root/{object}/``, each a folder of all
    frames of ``rig.sequence``. ``splits``: which objects are in which; None puts all into ``test``.
    ``limits``: of the decoder; ``bits`` and ``colour``: see `read_frames`; ``anyway``: captures
    that the examination refuses too. Raises `CaptureError` with a line for each folder that is no
    capture, `BuildError` for splits that are not of these objects, `DecodeError` for an impossible
    limit."""
    check_options(bits, colour)
    check_limits(limits := limits or Limits())
    captures = find_captures(root, len(rig.sequence))
    by_split = split_captures(captures, splits)
    settings = {"layout": "captures", "splits": "all in test" if splits is None else "given"}
    refused = frozenset(capture.sample for capture in captures) if anyway else frozenset()
    return captures_plan(captures, by_split, rig, limits, bits, colour, refused, settings)


def captures_plan(
    captures: Sequence[Capture],
    by_split: Mapping[str, Sequence[Capture]],
    rig: Rig,
    limits: Limits,
    bits: int | None,
    colour: str | None,
    anyway: frozenset[str],
    settings: dict[str, Any],
) -> Assembly[CaptureReader]:
    """The dataset of ``captures`` in the splits ``by_split``; ``anyway``: samples that are read
    although the examination refuses them; ``settings``: of the manifest, beside the decoder's."""
    pixels = rig.camera.height * rig.camera.width
    plans: list[ShardPlan] = []
    for split, chosen in by_split.items():
        plans += plan_rows(split, [(c.sample, c.object, c.view) for c in chosen], pixels)
    settings = {
        **settings,
        **asdict(limits),
        "bits": bits,
        "colour": colour,
        "objects": {
            split: {
                name: [c.view for c in chosen if c.object == name]
                for name in dict.fromkeys(c.object for c in chosen)
            }
            for split, chosen in by_split.items()
        },
    }
    reader = CaptureReader(
        {capture.sample: capture for capture in captures}, rig, limits, bits, colour, anyway
    )
    return import_plan(reader, plans, CAPTURED, settings, "all")


def capture_notes(manifest: Manifest) -> list[str]:
    """Notes about a finished import for the user, a sentence each."""
    rows = manifest.rows
    notes = []
    if manifest.settings["splits"] != "given":
        notes.append("no --splits given: all objects are in split test")
    scales = sorted({row["full_scale"] for row in rows})
    if any(row["rounded"] for row in rows):
        notes.append(
            "depth was decoded from the frames as captured; they are stored rounded to 8 bits"
        )
    notes += sorted({row["note"] for row in rows} - {""})
    if len(scales) > 1:
        listed = ", ".join(map(str, scales))
        notes.append(
            f"white was taken as different levels ({listed}); give the camera's --bits to read all "
            f"alike"
        )
    notes += [f"{row['sample']}: {finding}" for row in rows for finding in row["findings"]]
    return notes


def pose_folders(captures: Path) -> list[Path]:
    """The folders of the poses below ``captures``, by name. Raises `CalibrationError` for fewer
    than three."""
    if not captures.is_dir():
        raise CalibrationError(
            f"{captures}: no such folder; expected one that holds a folder of frames for each pose"
        )
    folders = [path for path in visible(captures, CalibrationError) if path.is_dir()]
    if len(folders) < FEWEST_POSES:
        raise CalibrationError(
            f"{captures}: expected folders of at least {FEWEST_POSES} poses of the board, found "
            f"{len(folders)}"
        )
    return folders


def board_poses(
    captures: Path,
    board: Board,
    sequence: Path,
    bits: int | None = None,
    colour: str | None = None,
    progress: Progress = lambda poses: None,
    anyway: bool = False,
    examined: Callable[[str, Examination], None] = lambda name, examination: None,
) -> tuple[list[Pose], Rig, Response | None]:
    """The board's points in every pose folder of ``captures``, in camera and projector px, a rig
    with the sequence of the rig file ``sequence`` that stands in for the one sought
    (`optics.load_projection`), and the response of projector and camera where the captures tell it.
    ``bits`` and ``colour`` as in `read_frames`. The frames of every pose are examined; ``anyway``
    takes those that are refused, too, and ``examined`` is called with a pose's name and what was
    found. Raises FppBenchError naming the pose or file, and all poses that are refused or have no
    board."""
    rig = load_projection(sequence)
    if len(rig.directions) < 2:
        coded = " and ".join(rig.directions) or "crossed fringes"
        raise CalibrationError(
            f"{sequence}: codes {coded} only; a calibration needs the projector's columns and "
            f"rows, so "
            "project both directions on the board"
        )
    poses: list[Pose] = []
    levels: list[Levels] = []
    unfit: list[CaptureError | CalibrationError] = []
    seen: dict[int, tuple[Path, int]] = {}
    for folder in pose_folders(captures):
        capture = read_frames(folder, count=len(rig.sequence), bits=bits, colour=colour, lossy=True)
        frames = capture.frames
        height, width = frames.shape[1:]
        if not poses:
            rig = load_projection(sequence, (width, height))
        elif poses[0].size != (width, height):
            expected = f"{poses[0].size[0]} x {poses[0].size[1]} px as in {poses[0].name}"
            raise CalibrationError(
                f"{folder}: images of {width} x {height} px, expected {expected}"
            )
        for index, frame in enumerate(frames):
            other, of_other = seen.setdefault(hash(frame.tobytes()), (folder, index))
            if other != folder and np.ptp(frame):
                raise CalibrationError(
                    f"{folder}: image {index} is that of {other.name} (image {of_other}), byte for "
                    f"byte: two poses "
                    "can't share an image; put this pose's own frames there, or remove it"
                )
        try:
            decoded, examination = _examined_and_decoded(
                capture, rig, Limits(), anyway, calibrated=False
            )
            examined(folder.name, examination)
            white = rig.sequence.white
            lit = frames.mean(axis=0, dtype=np.float64) if white is None else frames[white]
            u_px, v_px = (decoded.details[direction].coordinate_px for direction in AXES)
            poses.append(
                measure_pose(
                    folder.name, np.clip(np.rint(lit), 0, 255).astype(np.uint8), u_px, v_px, board
                )
            )
        except (RefusedCapture, CalibrationError) as error:
            unfit.append(error)
        else:
            measured = levels_of(list(frames), (u_px, v_px), poses[-1], rig)
            levels += [] if measured is None else [measured]
        progress(1)
    raise_all(unfit)
    return poses, rig, fit_response(levels)


def calibrated_rig(
    calibration: Calibration, stand_in: Rig, range_mm: tuple[float, float] | None = None
) -> Rig:
    """The rig of a calibration, with the sequence of ``stand_in``; its working range is
    ``range_mm``, or that of the boards' points and a margin. Its error is what the calibration's
    covariance leaves at half of the points of its volume. Raises `CalibrationError` where that is
    nothing known."""
    depths = [
        calibration.board_mm @ rotation_matrix(pose.rotation_vector)[2] + pose.translation_mm[2]
        for pose in calibration.poses
    ]
    near, far = range_mm or (
        float(np.min(depths)) * (1 - RANGE_MARGIN),
        float(np.max(depths)) * (1 + RANGE_MARGIN),
    )
    rig = calibration.applied_to(stand_in).with_range((near, far))
    error_px = depth_spread(Places.over(rig), calibration.root).median_px
    if not np.isfinite(error_px):
        raise CalibrationError(
            "the poses leave the depth of half of the working range undetermined: show the board "
            "over the whole image and range, or give a lens with fewer terms (--lens radial-1)"
        )
    return replace(rig, calibration_px=error_px)
