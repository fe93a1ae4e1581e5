"""Checks of what a submission declares: its units, from which depth becomes the mm that are scored,
and all that can be checked without ground truth: its description, its files, their size and
values."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import LARGEST_SIDE_PX, MM_PER_M
from fpp_ml_bench.depth import (
    NODATA_ADVICE,
    NODATA_FAR,
    RangeRule,
    depth_range_mm,
    extremes,
    nodata_problem,
    object_mask,
)
from fpp_ml_bench.errors import DatasetError, PredictionError, SubmissionError
from fpp_ml_bench.evaluation import protocol
from fpp_ml_bench.evaluation.protocol import Mode, Units
from fpp_ml_bench.evaluation.submission.prediction_files import (
    SIGMA,
    SUBMISSION_FILE,
    Listing,
    MapAndHash,
    declared_size,
    list_folder,
    predictions_folder,
    read_plain,
)
from fpp_ml_bench.files import printable
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.rig import Rig

if TYPE_CHECKING:
    from fpp_ml_bench.evaluation.submission.description import Submission

Depth = NDArray[np.floating]


def declared_units(target_max: float, units: str | None) -> Units:
    """The units of arrays, which know no rig: ``mm``, unless ``units`` says ``m``. Raises
    PredictionError for other units, and where they are not said and the largest depth of a target,
    ``target_max``, could as well be metres."""
    if units not in (None, "mm", "m"):
        raise PredictionError(f"units: expected mm or m, got {printable(str(units))}")
    if units is None and 0 < target_max < protocol.METRES_BELOW:
        raise PredictionError(
            f"targets: the largest depth is {target_max:.4g}, which could be metres; say "
            f"units='m', or units='mm' "
            f"where depths below {protocol.METRES_BELOW:g} mm are meant"
        )
    return "m" if units == "m" else "mm"


def in_mm(values: Any, units: Units) -> Any:
    """Depths in mm or m (an array) in mm; those in mm are not copied."""
    return values.astype(np.float64) * MM_PER_M if units == "m" else values


def value_problems(
    prediction: Depth,
    target_mm: Depth,
    reach_mm: float,
    units: Units,
    void: NDArray[np.bool_] | None = None,
) -> list[str]:
    """What is wrong with the values of a prediction (H, W) in ``units``; usually an empty list.
    ``reach_mm``: up to which depth there is something to measure, the far end of the rig's working
    range, or the largest target; 0 where that is not known. Pixels in ``void`` may hold any
    depth."""
    low, high = extremes(prediction)
    problems = []
    if not np.isfinite([low, high]).all():  # min and max carry NaN through
        nans, infinities = int(np.isnan(prediction).sum()), int(np.isinf(prediction).sum())
        counts = [f"{n} {word}" for n, word in ((nans, "NaN"), (infinities, "infinite")) if n]
        problems.append(
            f"holds {' and '.join(counts)} of {prediction.size} values; {NODATA_ADVICE}"
        )
        if nans + infinities == prediction.size:
            return problems
        prediction = np.where(np.isfinite(prediction), prediction, prediction.dtype.type(0))
        low, high = float(prediction.min()), float(prediction.max())
    largest = protocol.LARGEST_MM / (
        1 if units == "mm" else MM_PER_M
    )  # no working range is above 1 m
    if max(high, -low) > largest:
        values = f"values up to {max(high, -low):.3g} {units} in magnitude"
        problems.append(f"holds {values}; the limit is {largest:g}; {NODATA_ADVICE}")
    reach = {"mm": reach_mm, "m": reach_mm / MM_PER_M, "normalised": float(reach_mm > 0)}[units]
    if reach and (low < 0 or high > NODATA_FAR * reach):
        scored = (
            prediction if void is None else np.where(void, prediction.dtype.type(0), prediction)
        )
        mark = nodata_problem(scored, reach, NODATA_FAR)
        problems += [f"holds a mark for no surface: {mark}"] if mark else []
    wrong_unit = _unit_problem(prediction, target_mm, units, high, reach_mm)
    return [*problems, wrong_unit] if wrong_unit else problems


def _unit_problem(
    values: Depth, target_mm: Depth, units: Units, high: float, reach_mm: float
) -> str | None:
    """Why ``values`` (H, W), finite and at most ``high``, can't be in ``units``; None where they
    can. Where mm are declared, the largest value shows whether the values are metres or shares of
    the range. Where m or normalised depth is declared, a single stray pixel must not decide, so the
    median over the object is compared."""
    if not reach_mm:
        return None
    reach = (
        f"its largest value is {high:.4g}, and there are depths up to {reach_mm / MM_PER_M:.4g} m"
    )
    if units == "mm":
        if 0 < high < min(protocol.METRES_BELOW, reach_mm / protocol.UNITS_APART):
            return (
                f"looks like metres or normalised depth: {reach}; convert it to mm, or declare "
                f"units: m or normalised"
            )
        return None
    depths = values[object_mask(target_mm) & (values > 0)]
    if not depths.size:
        return None
    typical = float(np.median(depths))
    median = f"its median over the object is {typical:.4g}"
    if units == "m" and typical * MM_PER_M > reach_mm * protocol.UNITS_APART:
        return f"does not look like metres: {median}; if it is in mm, declare units: mm"
    if units == "m" and high < min(1.0, reach_mm / MM_PER_M / 2):
        return f"does not look like metres: {reach}; if it is normalised, declare units: normalised"
    if units == "normalised" and typical > protocol.NORMALISED_AT_MOST:
        advice = "if it is in m or mm, declare that in submission.yaml"
        return f"does not look like normalised depth: {median}, the target's is at most 1; {advice}"
    return None


def unit_note(largest: float, units: Units) -> str | None:
    """What looks wrong with ``units`` where no target is known and ``largest`` is the largest value
    of all samples."""
    suspicious = {
        "mm": (0 < largest < protocol.METRES_BELOW, "are these metres or normalised depth?"),
        "m": (largest > protocol.METRES_AT_MOST, "are these mm?"),
        "normalised": (largest > protocol.METRES_BELOW, "are these m or mm?"),
    }
    wrong, question = suspicious[units]
    return (
        f"units: {units}, but the largest value of all samples is {largest:.4g}; {question}"
        if wrong
        else None
    )


def scored_pair(
    values: Depth,
    target_mm: Depth,
    units: Units,
    mode: Mode,
    sample: str,
    left_out: NDArray[np.bool_] | None = None,
) -> tuple[Depth, Depth]:
    """Prediction and target (H, W) in mm, such that scoring them is scoring ``values`` by the rules
    of ``mode``. Pixels ``left_out`` (bool (H, W)) do not count in the range of normalised values
    (`fpp_ml_bench.depth.RangeRule`).

    ``standard``: depth in mm, 0 = background. Normalised values go back through the sample's own
    range, D = v (D_max - D_min) + D_min, except for an exact 0, which stays 0: background, or not
    measured.

    ``paper`` differs for normalised values (paper Section 5.3.2, individual normalisation): the
    target is normalised first, its mask is D_norm > 0, and prediction and target go through the
    same affine map everywhere. D_min cancels in every difference, so v (D_max - D_min) is scored
    against D - D_min: the same numbers, without the rounding of adding and subtracting 1.7 m.

    Raises DatasetError where the target has no range to normalise by."""
    if units != "normalised":
        return in_mm(values, units), target_mm
    inside = object_mask(target_mm)
    if not inside.any():
        if mode == "standard" and not values.any():
            return values, target_mm
        no_range = "the target holds no object, so normalised depth has no range to go back through"
        raise DatasetError(f"{sample}: {no_range}; submit mm")
    low, high = depth_range_mm(target_mm, left_out)
    if mode == "standard":
        depth = values.astype(np.float64) * (high - low) + low
        depth[values == 0] = 0.0
        return depth, target_mm
    if high == low:
        flat = "the target is one flat plane, and individual normalisation divides by its range, 0"
        raise DatasetError(f"{sample}: {flat}; score it with --mode standard")
    if left_out is not None:  # pixels that are left out may be nearer than D_min, and stay object
        return values.astype(np.float64) * (high - low) + np.where(inside, low, 0.0), target_mm
    return values.astype(np.float64) * (high - low), np.where(
        inside, target_mm.astype(np.float64) - low, 0.0
    )


@dataclass(frozen=True)
class Rules:
    """By what a sample's prediction is scored: against which depth, in which units it is, over
    which pixels the range of normalised depth is taken, and the mode."""

    target: str
    units: Units
    range_rule: RangeRule
    mode: Mode

    def pair(self, values: Depth, dataset: DatasetFolder, sample: str) -> tuple[Depth, Depth]:
        """`scored_pair` of ``values`` (H, W) and the sample's target."""
        normalised = self.units == "normalised"
        left_out = dataset.left_out(sample, self.range_rule, self.target) if normalised else None
        target_mm = dataset.depth_mm(sample, self.target)
        return scored_pair(values, target_mm, self.units, self.mode, sample, left_out)

    def void(self, dataset: DatasetFolder, sample: str) -> NDArray[np.bool_] | None:
        """The pixels that count in no set, bool (H, W); None by rules without void."""
        return dataset.void(sample, self.target) if self.mode == "standard" else None

    def charge_mm(self, rig: Rig) -> float | None:
        """What a missing or invented pixel costs in the two-sided scores; None by rules without
        it."""
        return rig.half_range_mm if self.mode == "standard" else None


@dataclass(frozen=True)
class Prediction:
    """A sample's prediction as its files hold it: a map (H, W), the SHA-256 of its file, and its
    sigma in mm, None where none is stated; ``problems`` with them, by file, usually none."""

    values: Depth
    digest: str
    sigma_mm: Depth | None
    problems: list[str]


_NOTHING = np.empty((0, 0))


def read_prediction(
    listing: Listing,
    read: Callable[[str], MapAndHash],
    sample: str,
    units: Units,
    target_mm: Depth,
    reach_mm: float = 0.0,
    void: NDArray[np.bool_] | None = None,
) -> Prediction:
    """A sample's prediction, by the ``read`` of its ``listing``, and its sigma, checked as
    `value_problems` does."""
    values, digest, sigma_mm = _NOTHING, "", None
    try:
        values, digest = read(sample)
        problems = value_problems(values, target_mm, reach_mm, units, void)
    except PredictionError as error:
        problems = [str(error)]
    problems = [f"{listing.named(sample)}: {problem}" for problem in problems]
    if listing.sigmas:
        try:
            height, width = target_mm.shape
            sigma_mm = listing.sigma_mm(sample, (height, width))
        except PredictionError as error:
            problems.append(f"{printable(sample)}{SIGMA}: {error}")
    return Prediction(values, digest, sigma_mm, problems)


@dataclass(frozen=True)
class Checked:
    """``problems``: a line for each reason to refuse the folder, usually none; ``notes``: what is
    worth a look. ``size`` (H, W) in px."""

    problems: list[str]
    notes: list[str]
    description: Submission | None
    listing: Listing
    size: tuple[int, int]

    def sound(self) -> Submission:
        """The description of a folder without problems; PredictionError names them where there are
        any."""
        if self.problems or self.description is None:
            folder = printable(self.listing.folder)
            raise PredictionError(
                f"{folder} can't be used, {len(self.problems)} problems:", self.problems
            )
        return self.description


def checked_description(
    folder: Path, content: dict[Any, Any], form: str, dataset: DatasetFolder | None = None
) -> Submission:
    """The folder's description, checked against the predictions' ``form`` and the ``dataset``,
    where known. Raises SubmissionError, and DatasetError where it says that other data were
    predicted."""
    from fpp_ml_bench.evaluation.submission.description import check_submission  # imports pydantic

    description = check_submission(folder, content)
    if dataset is not None and description.predicted is not None:
        dataset.check_content(description.predicted.content, str(folder))
    frames = None if dataset is None else len(dataset.sequence)
    outside = [index for index in description.frames_used if frames is not None and index >= frames]
    if frames is not None and outside:
        expected = f"expected indices from 0 to {frames - 1} of this dataset's sequence"
        problem = f"frames_used: {expected}, got {printable(str(outside), 100)}"
    elif form == ".png" and description.png_mm_per_level is None:
        problem = (
            "png_mm_per_level: expected what one level of the .png files is in mm, like 0.05, got "
            "nothing"
        )
    elif form != ".png" and description.png_mm_per_level is not None:
        problem = f"png_mm_per_level is given, but the predictions are {form}; remove the key"
    else:
        return description
    raise SubmissionError(f"{printable(folder / SUBMISSION_FILE)}: {problem}")


def check_folder(
    folder: str | Path, dataset: DatasetFolder | None = None, split: str = "test"
) -> Checked:
    """Check everything of a submission that needs no ground truth. With a ``dataset``, its split
    says which samples of which size are expected; without, the files' names and the size that most
    of them have do. Raises PredictionError for no folder, and for a form that can't be read without
    a dataset."""
    folder = predictions_folder(folder)
    listing = list_folder(folder, dataset, split)
    if dataset is None and not listing.present:
        expected = "expected one {sample}.npy for each sample, found none"
        raise PredictionError(f"{printable(folder)}: {expected}; tables need DATASET")
    problems, description = list(listing.problems), None
    try:
        description = checked_description(folder, read_plain(folder), listing.form, dataset)
    except (SubmissionError, DatasetError) as error:
        problems.insert(0, str(error))
    size = _declared_size(listing) if dataset is None else dataset.size
    level_mm, nodata = None, None
    units: Units = "mm"
    if description is not None:
        level_mm, nodata, units = (
            description.png_mm_per_level,
            description.nodata,
            description.units,
        )
    largest = 0.0
    if listing.form != ".png" or level_mm is not None:
        read, unknown = listing.reader(size, level_mm, nodata), np.zeros(size)
        for sample in listing.present:
            prediction = read_prediction(listing, read, sample, units, unknown)
            largest = max(largest, float(prediction.values.max(initial=0.0)))
            problems += prediction.problems
    note = unit_note(largest, units)
    return Checked(problems, [note] if note else [], description, listing, size)


def _declared_size(listing: Listing) -> tuple[int, int]:
    """The size (H, W) that most of the files declare. PredictionError where it is too large to be
    read."""
    if listing.form == ".mat":
        raise PredictionError(
            f"{printable(listing.folder)}: .mat files can only be checked with DATASET"
        )
    files = [listing.folder / f"{sample}{listing.form}" for sample in listing.present]
    declared = {file: size for file in files if (size := declared_size(file)) and min(size) > 0}
    if not declared:
        named = printable(listing.folder)
        raise PredictionError(f"{named}: no file holds a depth map (H, W); write them with np.save")
    size = Counter(declared.values()).most_common(1)[0][0]
    if max(size) > LARGEST_SIDE_PX:
        file = next(file for file in declared if declared[file] == size)
        most = (
            f"expected at most {LARGEST_SIDE_PX} without a dataset; write the depth map itself, or "
            f"give DATASET"
        )
        raise PredictionError(f"{printable(file)}: declares {size[1]} x {size[0]} px, {most}")
    return size


def predicted_mm(
    folder: Path, dataset: DatasetFolder, split: str, sample: str, target: str
) -> tuple[Submission, NDArray[np.floating]]:
    """The description of predictions of ``split``, which are checked as a whole first, and the
    depth (H, W) in mm of one ``sample``, 0 where there is no answer; a normalised one with the
    range of the column ``target``. Raises PredictionError for predictions that could not be
    scored."""
    checked = check_folder(folder, dataset, split)
    described = checked.sound()
    read = checked.listing.reader(dataset.size, described.png_mm_per_level, described.nodata)
    rules = Rules(target, described.units, described.range_rule, "standard")
    return described, np.maximum(
        rules.pair(read(sample)[0], dataset, sample)[0], 0
    )  # a network may go below 0
