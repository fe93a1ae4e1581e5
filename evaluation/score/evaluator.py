"""Scoring a folder of predictions against one split of a dataset, and arrays in memory by the same
rules: everything is checked, every problem is named."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from threading import Lock
from typing import Any, cast, get_args

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import split_sample_name
from fpp_ml_bench.depth import (
    NODATA_ADVICE,
    NODATA_DECADE,
    NODATA_FAR,
    RangeRule,
    edge_jump_mm,
    extremes,
    nodata_problem,
    object_box,
    object_mask,
    shape_problem,
    without_nodata,
)
from fpp_ml_bench.depth_readings import MOST_GLANCES, another_reading, glance
from fpp_ml_bench.errors import DatasetError, PredictionError, SubmissionError
from fpp_ml_bench.evaluation import protocol
from fpp_ml_bench.evaluation.protocol import Mode, Units
from fpp_ml_bench.evaluation.result.file import environment
from fpp_ml_bench.evaluation.result.model import ArrayScores, Result, scores_of
from fpp_ml_bench.evaluation.score.check import (
    Rules,
    checked_description,
    declared_units,
    in_mm,
    read_prediction,
    value_problems,
)
from fpp_ml_bench.evaluation.score.sample_scores import (
    SampleScores,
    Scored,
    SigmaSample,
    score_sample,
    score_sigma,
)
from fpp_ml_bench.evaluation.submission.prediction_files import (
    Listing,
    MapAndHash,
    list_folder,
    predictions_folder,
    read_plain,
)
from fpp_ml_bench.files import printable
from fpp_ml_bench.loaders.sample import Flag, image_hash, void_pixels
from fpp_ml_bench.loaders.storage.benchmark import benchmark_of
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.machine import usable_cores
from fpp_ml_bench.optics.sequence import DIRECTIONS, AnySequence
from fpp_ml_bench.skipping import Explanation, LeftOut, explained, skipping

Maps = NDArray | Sequence[NDArray]
WORKERS = 4


def evaluate(
    folder: str | Path,
    dataset: DatasetFolder,
    split: str = "test",
    target: str = "depth",
    edge_band_px: int = protocol.EDGE_BAND_PX,
    mode: str = "standard",
    say: Callable[[str], object] = lambda note: None,
) -> Result:
    """Score ``folder`` (predictions in one of the accepted forms, and ``submission.yaml``) on a
    split of ``dataset``.

    ``target`` is ``depth`` (decoded, as in the paper) or ``depth_exact`` (from the ray cast);
    ``mode`` is ``standard`` or ``paper`` (the paper's pixel sets, without void, and its rule for
    normalised depth). Memory does not grow with the number of samples, and the result does not
    depend on the number of cores. ``say`` is given a note where another reading of the predictions
    fits far better (`another_reading`).

    Raises SubmissionError for the description, PredictionError (naming every file with a problem)
    for the predictions, and DatasetError for a target that is not a depth map, and for other data
    than was predicted."""
    folder = predictions_folder(folder)
    _check_split(dataset, split, target, mode)
    content, description, refusal = {}, None, None
    try:
        content = read_plain(folder)
    except SubmissionError as error:
        refusal = error
    listing = list_folder(folder, dataset, split)
    # What is no number is refused with the description, which is checked while threads score.
    level, rule = (
        content.get("png_mm_per_level"),
        "valid" if content.get("range_rule") == "valid" else "object",
    )
    rules = Rules(target, content.get("units", "mm"), cast(RangeRule, rule), cast(Mode, mode))
    outcomes: Iterable[Scored | list[str]] = ()
    if rules.units in get_args(Units):
        read = listing.reader(
            dataset.size,
            level if isinstance(level, int | float) and 0 < level < protocol.LARGEST_MM else None,
            content.get("nodata"),
        )
        outcomes = _scored(listing, read, dataset, rules, edge_band_px)
    if refusal is None:
        try:
            description = checked_description(folder, content, listing.form, dataset)
        except SubmissionError as error:
            refusal = error
    problems, scored = list(listing.problems), []
    for outcome in outcomes:
        if isinstance(outcome, Scored):
            scored.append(outcome)
        else:
            problems += outcome
    if problems:
        summary = f"{len(problems)} problem{'' if len(problems) == 1 else 's'}"
        lines = [str(refusal), *problems] if refusal else problems
        raise PredictionError(f"{printable(folder)} can't be scored, {summary}:", lines)
    if refusal or description is None:
        raise refusal or SubmissionError(f"{printable(folder)}: has no description")
    if note := another_reading(
        "the predictions", [sample.seen for sample in scored if sample.seen is not None]
    ):
        say(note)
    hashes: dict[tuple[str, str], dict[str, str]] = {}
    for sample in scored:
        for column, digest in sample.hashes.items():
            hashes.setdefault((dataset.split_of_sample(sample.name), column), {})[sample.name] = (
                digest
            )
    content = dict(dataset.content_hash(*column, images) for column, images in hashes.items())
    benchmark = benchmark_of(content)
    about: dict[str, Any] = {
        "schema_version": protocol.RESULT_SCHEMA_VERSION,
        "protocol_version": protocol.PROTOCOL_VERSION,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "submission": description.model_copy(update={"predicted": None}),
        "dataset": {
            "name": printable(Path(dataset.path).resolve().name, 100).strip() or "dataset",
            "content": content,
            "code": code_of(dataset.sequence),
            "benchmark": {"name": benchmark.name, "version": benchmark.version}
            if benchmark
            else None,
            "real": dataset.real_set,
            "split": split,
            "size": list(dataset.size),
            "samples": len(scored),
        },
        "target": target,
        "mode": mode,
        "frames_class": frames_class(dataset.sequence, description.frames_used),
        "edge_band_px": edge_band_px,
        "charge_mm": rules.charge_mm(dataset.rig),
        "edge_jump_mm": edge_jump_mm(dataset.size[1]),
        "environment": environment(),
    }
    return Result(**about, **scores_of(scored))


def _row(scores: SampleScores, digest: str) -> dict[str, Any]:
    return {"prediction_sha256": digest, **scores.pixels(), **scores.metrics()}


def code_of(sequence: AnySequence) -> str:
    """What the projector shows, in the words of `DatasetInfo.code`."""
    if sequence.crossed_frames:
        return "crossed"
    fringes = any(sequence.sinusoids(direction) for direction in DIRECTIONS)
    return "phase shift" if fringes else "Gray code"


def frames_class(sequence: AnySequence, frames_used: Sequence[int]) -> protocol.FramesClass:
    """What a method captures of ``sequence``."""
    one_frame, few_frames, full_sequence = protocol.FRAMES_CLASSES
    if len(frames_used) <= 1:
        return one_frame
    gray = {index for direction in DIRECTIONS for index in sequence.gray(direction)}
    return full_sequence if gray & set(frames_used) else few_frames


def _check_split(dataset: DatasetFolder, split: str, target: str, mode: str) -> None:
    """Refuse (DatasetError) what names no target, mode or sample, and more samples than a result
    may have."""
    for name, given, known in (
        ("target", target, protocol.TARGETS),
        ("mode", mode, protocol.MODES),
    ):
        if given not in known:
            raise DatasetError(f"expected {name} {' or '.join(known)}, got {printable(given)!r}")
    if target == "depth_exact" and not dataset.has_exact:
        raise DatasetError(
            f"{dataset.path}: has no depth_exact (published data has decoded depth only); use depth"
        )
    samples = dataset.samples(split)
    if not samples:
        raise DatasetError(
            f"{dataset.path}: split {split} holds no sample; there is nothing to score"
        )
    objects = {split_sample_name(sample)[0] for sample in samples}
    if len(samples) > protocol.MOST_SAMPLES or len(objects) > protocol.MOST_OBJECTS:
        limits = f"at most {protocol.MOST_OBJECTS} objects and {protocol.MOST_SAMPLES} samples"
        raise DatasetError(
            f"{dataset.path}: split {split} has {len(objects)} and {len(samples)}, {limits} are "
            f"scored at once"
        )


def _scored(
    listing: Listing,
    read: Callable[[str], MapAndHash],
    dataset: DatasetFolder,
    rules: Rules,
    edge_band_px: int,
) -> Iterable[Scored | list[str]]:
    """Each sample that has a prediction, scored, or the problems with its files, in order. Work
    begins with this call, in threads, before the first outcome is taken from the iterator."""
    dataset_lock = Lock()
    columns = protocol.scored_columns(rules.target, rules.mode, dataset.has_exact)
    glanced_at = set(listing.present[:MOST_GLANCES])

    def work(sample: str) -> Scored | list[str]:
        with dataset_lock:  # reading the dataset need not be thread-safe
            target = dataset.depth_mm(sample, rules.target)
            void = rules.void(dataset, sample)
            unlit_mm = (
                dataset.unlit_mm(sample)
                if void is not None and rules.target == "depth_exact"
                else None
            )
            scored_on = {rules.target: target} | (
                {"flags": dataset.flags(sample)} if "flags" in columns else {}
            )
        low, high = extremes(target)
        if not (low >= 0 and np.isfinite(high)):
            bad = "NaN, infinite or negative values"
            raise DatasetError(f"{sample}: the target depth holds {bad}; run: fpp-bench verify")
        reach_mm = dataset.rig.working_range_mm[1] if high else 0.0
        prediction = read_prediction(listing, read, sample, rules.units, target, reach_mm, void)
        problems, outcome = prediction.problems, None
        if not problems:
            with dataset_lock:
                pair = rules.pair(prediction.values, dataset, sample)
            charge_mm = rules.charge_mm(dataset.rig)
            try:
                scores = score_sample(*pair, edge_band_px, void, unlit_mm, charge_mm)
            except PredictionError as error:
                problems = [f"{listing.named(sample)}: {error}"]
            else:
                stated = (
                    None
                    if prediction.sigma_mm is None
                    else score_sigma(*pair, prediction.sigma_mm, void, charge_mm)
                )
                hashes = {column: image_hash(image) for column, image in scored_on.items()}
                seen = (
                    glance(sample, *pair, void, dataset.rig.camera)
                    if sample in glanced_at
                    else None
                )
                row = _row(scores, prediction.digest)
                outcome = Scored(sample, split_sample_name(sample)[0], row, stated, hashes, seen)
        with dataset_lock:
            dataset.release(sample)
        return outcome or problems

    return ThreadPoolExecutor(min(WORKERS, usable_cores())).map(work, listing.present)


def evaluate_arrays(
    predictions: Maps,
    targets: Maps,
    flags: Maps | None = None,
    sigma: Maps | None = None,
    objects: Sequence[str] | None = None,
    edge_band_px: int = protocol.EDGE_BAND_PX,
    units: str | None = None,
    nodata: float | None = None,
    charge_mm: float | None = None,
) -> ArrayScores:
    """Score depth in mm along the camera's axis, 0 = background or not measured, against such
    depth, 0 = background: floats (N, H, W), or N maps (H, W) that may differ in size. Depths of
    exactly ``nodata`` are read as 0. Pixels that a masked array of targets masks count in no set.
    ``flags``: whole numbers, bits of `loaders.sample.Flag`, whose void pixels count in no set.
    ``sigma``: the standard uncertainty in mm, 0 where none is stated. ``objects``: what each sample
    shows; samples of the same object are not independent, and the intervals are over objects (by
    default, each sample is its own). ``units``: ``mm`` or ``m``, of all depths and sigma; must be
    said where a target reaches less than 10. ``charge_mm``: what a missing or invented pixel costs
    in the two-sided scores, half a rig's working range; without it there are none.

    Raises PredictionError, naming the sample by its number, for numbers or shapes that differ, for
    what is no real float or not finite, for a negative sigma or target, for masked predictions, for
    flags that are no such bits, and for depths that look like another unit or like a mark for no
    surface."""
    count = len(_sequence("targets", targets))
    columns = {
        "predictions": predictions,
        "targets": targets,
        "flags": flags,
        "sigma": sigma,
        "objects": objects,
    }
    for name, values in columns.items():
        if values is not None and len(_sequence(name, values)) != count:
            raise PredictionError(
                f"{name}: expected {count}, one for each target, got {len(values)}"
            )  # type: ignore[arg-type]
    if count == 0:
        raise PredictionError("targets: expected one depth map or more, got none")
    names = (
        [printable(str(name)) for name in objects]
        if objects is not None
        else [f"sample {n}" for n in range(count)]
    )
    scored = []
    for number in range(count):
        try:
            maps = {
                name: _array(name, values[number])  # type: ignore[index]
                for name, values in columns.items()
                if name != "objects" and values is not None
            }
            prediction, target = maps["predictions"], maps["targets"]
            void = _void(target, maps.get("flags"))
            scores, stated = score_arrays(
                prediction,
                np.ma.filled(target, 0),
                void,
                units,
                maps.get("sigma"),
                edge_band_px,
                nodata=nodata,
                charge_mm=charge_mm,
            )
        except PredictionError as error:
            raise PredictionError(f"sample {number}: {error}") from None
        row = _row(scores, hashlib.sha256(np.ascontiguousarray(prediction).data).hexdigest())
        scored.append(Scored(f"sample {number}", names[number], row, stated, {}))
    return ArrayScores(**scores_of(scored))


def _sequence(name: str, values: object) -> Any:
    """``values``, if they are a sequence of maps or names."""
    shape = getattr(values, "shape", None)
    if (
        isinstance(values, (str, bytes))
        or not hasattr(values, "__len__")
        or (shape is not None and len(shape) == 2)
    ):
        got = type(values).__name__ if shape is None else f"one map {tuple(shape)}"
        raise PredictionError(
            f"{name}: expected an array (N, H, W) or a list of maps (H, W), got {got}"
        )
    return values


def _array(name: str, values: object) -> NDArray:
    """A map as an array; a mask stays where its meaning is clear, with the targets."""
    try:
        array = np.asanyarray(values)
    except (
        TypeError,
        ValueError,
        RuntimeError,
    ) as error:  # ragged lists; tensors with a gradient, or of a GPU
        raise PredictionError(
            f"{name}: expected an array (H, W), got {type(values).__name__}: {error}"
        ) from None
    if not np.ma.is_masked(array):
        return np.asarray(array)
    if name != "targets":
        advice = (
            f"write 0 where nothing is known ({name}.filled(0)); to leave pixels out of every "
            f"score, mask the targets"
        )
        raise PredictionError(
            f"{name}: a masked array, and what a masked pixel means is not known; {advice}"
        )
    return array


def _void(targets: NDArray, flags: NDArray | None) -> NDArray[np.bool_]:
    """Pixels that count in no set: those masked in the targets, and those flagged."""
    void = np.ma.getmaskarray(targets)
    if flags is None:
        return void
    if flags.shape != targets.shape or flags.dtype.kind not in "iu":
        advice = (
            "; to leave pixels out of every score, mask the targets"
            if flags.dtype.kind == "b"
            else ""
        )
        raise PredictionError(
            f"flags: expected whole numbers {targets.shape}, got {flags.dtype} {flags.shape}; they "
            f"are the column "
            f"flags of a dataset, bits that mark void pixels, not a mask{advice}"
        )
    most = sum(Flag)
    if not 0 <= flags.min() <= flags.max() <= most:
        bits = ", ".join(f"{flag.value} {(flag.name or '').lower()}" for flag in Flag)
        value = flags.max() if flags.max() > most else flags.min()
        raise PredictionError(
            f"flags: expected sums of {bits}, got {value}; a mask of valid pixels is no flags"
        )
    return void | void_pixels(flags.astype(np.uint8))


def score_arrays(
    prediction: NDArray,
    target: NDArray,
    void: NDArray[np.bool_],
    units: str | None = None,
    sigma: NDArray | None = None,
    edge_band_px: int = protocol.EDGE_BAND_PX,
    check_prediction_units: bool = True,
    nodata: float | None = None,
    charge_mm: float | None = None,
) -> tuple[SampleScores, SigmaSample | None]:
    """Score floats (H, W) in ``units``, pixels in ``void`` in no set; `evaluate_arrays` says what
    is refused. ``check_prediction_units``: whether a prediction that looks like another unit is."""
    prediction, target = without_nodata(prediction, nodata), without_nodata(target, nodata)
    for name, values in (("predictions", prediction), ("targets", target), ("sigma", sigma)):
        if values is None:
            continue
        if values.dtype.kind != "f":
            raise PredictionError(f"{name}: expected real floats, got {values.dtype}")
        if target.ndim != 2 or target.size == 0:
            raise PredictionError(
                f"targets: expected a map (H, W), got {target.shape}; np.squeeze takes axes of 1 "
                f"out"
            )
        if problem := shape_problem(values.shape, target.shape):
            raise PredictionError(f"{name}: expected a map (H, W) of the target's size: {problem}")
        if name != "predictions" and not (values.min() >= 0 and np.isfinite(values.max())):
            raise PredictionError(f"{name}: expected finite mm of 0 and more; {NODATA_ADVICE}")
    # What both hold exactly is hardly measured: nearer to the other depths it is a mark already.
    shared = extremes(prediction)[1] == extremes(target)[1]
    if problem := nodata_problem(target * ~void, apart=NODATA_FAR if shared else NODATA_DECADE):
        raise PredictionError(f"targets: {problem}")
    declared = declared_units(float(target.max()), units)
    target_mm = in_mm(target, declared)
    reach_mm = float(target_mm.max()) if check_prediction_units else 0.0
    if problems := value_problems(prediction, target_mm, reach_mm, declared, void):
        raise PredictionError(f"the prediction {problems[0]}")
    pair = in_mm(prediction, declared), target_mm
    stated = None if sigma is None else score_sigma(*pair, in_mm(sigma, declared), void, charge_mm)
    return score_sample(*pair, edge_band_px, void, charge_mm=charge_mm), stated


def explain_eval(dataset: DatasetFolder, split: str, target: str) -> Explanation:
    """What scoring one split skipped: columns that no score needs, and the search for depth edges
    far from the object. Reads the split's targets again."""
    samples, (height, width) = dataset.samples(split), dataset.size
    boxes = {}
    for sample in samples:
        boxes[sample] = _box_px(object_mask(dataset.depth_mm(sample, target)))
        dataset.release(sample)
    frames, depths = len(dataset.manifest.stored_frames), 1 + dataset.has_exact
    read, searched = 1 + (target != "depth"), sum(boxes.values())
    pixels, depth_bytes = len(samples) * height * width, np.dtype(np.float32).itemsize
    lines = [
        LeftOut(
            "columns that no score needs",
            "images",
            len(samples) * read,
            len(samples) * (frames + depths - read),
            (frames + (depths - read) * depth_bytes) * pixels,
        ),
        LeftOut("depth edges far from the object", "pixels", searched, pixels - searched),
    ]
    return explained("fpp-eval", f"{len(samples)} samples of {width}x{height} px", lines)


def _box_px(inside: NDArray[np.bool_]) -> int:
    """Pixels of the box in which `object_near_edges` searches."""
    with skipping(True):
        box = object_box(inside)
    return 0 if box is None else int(inside[box].size)
