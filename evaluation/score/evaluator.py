"""Scoring a folder of predictions against one split of a dataset: everything is checked, every problem is named."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from operator import attrgetter
from pathlib import Path
from threading import Lock
from typing import Any, cast, get_args

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import split_sample_name
from fpp_ml_bench.depth import RangeRule, edge_jump_mm, extremes, object_box, object_mask, object_near_edges
from fpp_ml_bench.errors import DatasetError, PredictionError, SubmissionError
from fpp_ml_bench.evaluation import protocol, result, submission
from fpp_ml_bench.evaluation.protocol import Mode, Units
from fpp_ml_bench.evaluation.score.check import checked_description
from fpp_ml_bench.evaluation.score.sample_scores import score_sample
from fpp_ml_bench.evaluation.score.sigma_scores import score_sigma
from fpp_ml_bench.evaluation.score.units import scored_pair, value_problems
from fpp_ml_bench.files import printable
from fpp_ml_bench.loaders.sample import image_hash, stored_frames
from fpp_ml_bench.loaders.storage import DatasetFolder, benchmark_of
from fpp_ml_bench.machine import usable_cores
from fpp_ml_bench.optics import DIRECTIONS, AnySequence
from fpp_ml_bench.skipping import Explanation, LeftOut, explained, saved_by

WORKERS = 4
Outcome = tuple[list[str], list[dict[str, Any]]]
"""Problems and rows of a sample: a line for each problem and no row, or no problem and a row."""


def evaluate(
    folder: str | Path,
    dataset: DatasetFolder,
    split: str = "test",
    target: str = "depth",
    edge_band_px: int = protocol.EDGE_BAND_PX,
    mode: str = "standard",
    while_scoring: Callable[[], object] = lambda: None,
) -> result.Result:
    """Score ``folder`` (predictions in one of the accepted forms, and ``submission.yaml``) on a split of ``dataset``.

    ``target`` is ``depth`` (decoded, as in the paper) or ``depth_exact`` (from the ray cast); ``mode`` is ``standard``
    or ``paper`` (the paper's pixel sets, without void, and its rule for normalised depth). Memory does not grow with
    the number of samples, and the result does not depend on the number of cores. ``while_scoring`` is called once
    while threads score: a command uses it to import what it needs afterwards.

    Raises SubmissionError for the description, PredictionError (naming every file with a problem) for the predictions,
    and DatasetError for a target that is not a depth map."""
    folder = Path(folder)
    samples = _samples(folder, dataset, split, target, mode)
    content, description_error = None, None
    try:
        content = submission.read_plain(folder)
    except SubmissionError as error:
        description_error = error
    split_of = {sample: name for name, names in dataset.splits.items() for sample in names}
    listing = submission.list_folder(folder, samples, split, split_of)
    units, level_mm = (content or {}).get("units", "mm"), (content or {}).get("png_mm_per_level")
    rule: RangeRule = "valid" if (content or {}).get("range_rule") == "valid" else "object"
    # What is no number is refused with the description, which is checked while the first files are scored, for pydantic
    # takes long to import: `result` and `submission` are packages that load what is used of them.
    level_mm = float(level_mm) if isinstance(level_mm, int | float) and not isinstance(level_mm, bool) else None
    problems: list[str] = list(listing.problems)
    rows: list[dict[str, Any]] = []
    outcomes: Iterable[Outcome] = ()
    if units in get_args(Units):
        reader = submission.reader_for(listing.form, folder, listing.present, dataset.size, level_mm)
        sigmas = folder if listing.sigmas else None
        outcomes = _scored(
            reader, listing.present, dataset, target, units, rule, cast(Mode, mode), edge_band_px, sigmas
        )
    description = None
    if content is not None:
        try:
            description = checked_description(folder, content, listing.form, len(dataset.sequence))
        except SubmissionError as error:
            description_error = error
        result.environment  # noqa: B018  imported while the threads score
        while_scoring()
    for file_problems, file_rows in outcomes:
        problems += file_problems
        rows += file_rows
    hashes: dict[tuple[str, str], dict[str, str]] = {}
    for row in rows:
        for column, digest in row.pop("hashes").items():
            hashes.setdefault((split_of[row["sample"]], column), {})[row["sample"]] = digest
    if problems:
        summary = f"{len(problems)} problem{'' if len(problems) == 1 else 's'}"
        lines = [str(description_error), *problems] if description_error else problems
        raise PredictionError(f"{printable(str(folder), 500)} can't be scored, {summary}:", lines)
    if description_error or description is None:
        raise description_error or SubmissionError(f"{printable(str(folder), 500)}: has no description")
    content = dict(dataset.content_hash(*column, images) for column, images in hashes.items())
    benchmark = benchmark_of(content)
    stated = {row["sample"]: row.pop("stated") for row in rows}
    owners = {row["sample"]: row["object"] for row in rows}
    return result.result_from_rows(
        rows,
        uncertainty=result.uncertainty_of(stated, owners) if listing.sigmas else None,
        protocol_version=protocol.PROTOCOL_VERSION,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        submission=description.model_copy(update={"predicted": None}),
        dataset={
            "name": printable(Path(dataset.path).resolve().name, 100).strip() or "dataset",
            "content": content,
            "code": code_of(dataset.sequence),
            "benchmark": {"name": benchmark.name, "version": benchmark.version} if benchmark else None,
            "split": split,
            "size": list(dataset.size),
            "samples": len(rows),
        },
        target=target,
        mode=mode,
        frames_class=frames_class(dataset.sequence, description.frames_used),
        edge_band_px=edge_band_px,
        edge_jump_mm=edge_jump_mm(dataset.size[1]),
        environment=result.environment(),
    )


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


def _samples(folder: Path, dataset: DatasetFolder, split: str, target: str, mode: str) -> list[str]:
    """The split's samples; refuses arguments that name no folder, target, mode or sample."""
    if not folder.is_dir():
        raise PredictionError(f"expected a folder of predictions, found none at {printable(str(folder), 500)}")
    for name, given, known in (("target", target, protocol.TARGETS), ("mode", mode, protocol.MODES)):
        if given not in known:
            raise DatasetError(f"expected {name} {' or '.join(known)}, got {printable(given)!r}")
    if target == "depth_exact" and not dataset.has_exact:
        raise DatasetError(f"{dataset.path}: has no depth_exact (published data has decoded depth only); use depth")
    samples = dataset.samples(split)
    if not samples:
        raise DatasetError(f"{dataset.path}: split {split} holds no sample; there is nothing to score")
    objects = {split_sample_name(sample)[0] for sample in samples}
    if len(samples) > protocol.MOST_SAMPLES or len(objects) > protocol.MOST_OBJECTS:
        limits = f"at most {protocol.MOST_OBJECTS} objects and {protocol.MOST_SAMPLES} samples"
        raise DatasetError(
            f"{dataset.path}: split {split} has {len(objects)} and {len(samples)}, {limits} are scored at once"
        )
    return samples


def _scored(
    reader: submission.Reader,
    samples: list[str],
    dataset: DatasetFolder,
    target_name: str,
    units: Units,
    rule: RangeRule,
    mode: Mode,
    edge_band_px: int,
    sigmas: Path | None,
) -> Iterable[Outcome]:
    """Problems and row of each sample that has a prediction, in order; the files of its uncertainty in the folder
    ``sigmas`` are checked. Work begins with this call, in threads, before the first outcome is taken from the
    iterator."""
    dataset_lock = Lock()
    columns = protocol.scored_columns(target_name, mode, dataset.has_exact)

    def work(sample: str) -> Outcome:
        with dataset_lock:  # reading the dataset need not be thread-safe
            target = dataset.target_mm(sample, target_name)
            void = dataset.void(sample, target_name) if mode == "standard" else None
            left_out = dataset.left_out(sample, rule, target_name) if units == "normalised" else None
            unlit_mm = dataset.unlit_mm(sample) if void is not None and target_name == "depth_exact" else None
            scored_on = {target_name: target} | ({"flags": dataset.flags(sample)} if "flags" in columns else {})
        low, high = extremes(target)
        if not (low >= 0 and np.isfinite(high)):
            bad = "NaN, infinite or negative values"
            raise DatasetError(f"{sample}: the target depth holds {bad}; run: fpp-bench verify")
        try:
            values, digest = reader.read(sample)
            problems = value_problems(values, target, dataset.rig.working_range_mm[1] if high else 0.0, units)
            if not problems:
                pair = scored_pair(values, target, units, mode, sample, left_out)
                scores = score_sample(*pair, edge_band_px, void, unlit_mm)
        except PredictionError as error:
            problems = [str(error)]
        problems = [f"{reader.named(sample)}: {problem}" for problem in problems]
        hashes = {column: image_hash(image) for column, image in scored_on.items()}
        stated = None
        if sigmas is not None:
            try:
                sigma_mm = submission.read_sigma(sigmas, sample, dataset.size)
                stated = None if problems else score_sigma(*pair, sigma_mm, void)
            except PredictionError as error:
                problems.append(f"{sample}{submission.SIGMA}: {error}")
        with dataset_lock:
            dataset.release(sample)
        if problems:
            return problems, []
        row = {"hashes": hashes, "sample": sample, "prediction_sha256": digest, **scores.pixels(), **scores.metrics()}
        return [], [row | {"object": split_sample_name(sample)[0], "stated": stated}]

    return ThreadPoolExecutor(min(WORKERS, usable_cores())).map(work, samples)


_TIME_KEYS = ("seconds_per_sample", "seconds_source", "hardware", "timing")
"""`fpp-bench time` may write these into a result later; run times can't be recomputed from predictions."""


def differences(scored: result.Result, folder: Path, dataset: DatasetFolder) -> list[str]:
    """What of a result does not follow from the predictions in ``folder`` on ``dataset``, a line for each difference.
    Everything is scored again. Time and place of scoring and the method's run time are not compared. Raises what
    `evaluate` raises, and SubmissionError for a result of another protocol version, which this one can't recompute."""
    if scored.protocol_version != protocol.PROTOCOL_VERSION:
        raise SubmissionError(
            f"the result was scored by protocol {scored.protocol_version}, this is {protocol.PROTOCOL_VERSION}; verify "
            "it with the version of fpp-ml-bench that its environment names, or score the predictions again"
        )
    here = printable(str(dataset.path), 200)
    for key, digest in scored.dataset.content.items():
        if dataset.content.get(key) != digest:
            scored_on = f"{digest} of {_value_text(scored.dataset.identity)} in the result"
            return [f"dataset.content.{key}: {scored_on}, {dataset.content.get(key, 'none')} is what {here} has"]
    again = evaluate(folder, dataset, scored.dataset.split, scored.target, scored.edge_band_px, scored.mode)
    names = ("dataset.size", "dataset.samples", "dataset.content", "dataset.code", "frames_class", "edge_jump_mm")
    pairs = [(name, attrgetter(name)(scored), attrgetter(name)(again), "recomputed") for name in names]
    described, description = scored.submission.model_dump(), again.submission.model_dump()
    for key in dict.fromkeys((*described, *description)):
        pair = (None, None) if key in _TIME_KEYS else (described.get(key), description.get(key))
        pairs.append((f"submission.{key}", *pair, f"in {submission.SUBMISSION_FILE}"))
    problems = [
        f"{name}: {_value_text(stored)} in the result, {_value_text(value)} {origin}"
        for name, stored, value, origin in pairs
        if stored != value
    ]
    stored_rows = {row.sample: row for row in scored.per_sample}
    if set(stored_rows) != {row.sample for row in again.per_sample}:
        return [*problems, "per_sample: other samples than the split has"]
    for row in again.per_sample:
        problems += _sample_differences(stored_rows[row.sample], row)
    return problems + _uncertainty_differences(scored.uncertainty, again.uncertainty)


def _uncertainty_differences(stored: result.Uncertainty | None, recomputed: result.Uncertainty | None) -> list[str]:
    if stored is None or recomputed is None:
        blocks = [("there is none" if block is None else "there is one") for block in (stored, recomputed)]
        return [] if stored is recomputed else [f"uncertainty: {blocks[0]} in the result, {blocks[1]} recomputed"]
    lines = []
    for name in ("reliability", "sparsification"):
        first, second = (
            [] if part is None else list(part.model_dump().values())
            for part in (getattr(stored, name), getattr(recomputed, name))
        )
        pairs = [pair for curves in zip(first, second, strict=False) for pair in zip(*curves, strict=True)]
        if len(first) != len(second) or not all(result.same(*pair, 1e-12) for pair in pairs):
            lines.append(f"uncertainty.{name}: the curve in the result is not the one recomputed")
    for sample, scores in recomputed.per_sample.items():
        for key in protocol.UNCERTAINTY:
            first, second = getattr(stored.per_sample[sample], key), getattr(scores, key)
            # The area between two curves is a small difference of large numbers, and a likelihood may be near 0.
            if not result.same(first, second, 1e-9 * (scores.sure_rmse_mm or 0.0) if "ause" in key else 1e-12):
                texts = f"{_value_text(first)} in the result, {_value_text(second)} recomputed"
                lines.append(f"{sample}: uncertainty.{key}: {texts}")
    return lines


def _sample_differences(stored: result.SampleResult, recomputed: result.SampleResult) -> list[str]:
    exact = ("object", "prediction_sha256", *(f"{name}_pixels" for name in ("object", "background", "void", "unlit")))
    keys = [key for key in exact if getattr(stored, key) != getattr(recomputed, key)]
    for key in protocol.METRICS:
        # Signed means and the error without an offset are small differences of large numbers.
        rounding_mm = 1e-9 * (recomputed.object_mae_mm or 0.0) if "bias" in key or "shift_free" in key else 0.0
        if not result.same(getattr(stored, key), getattr(recomputed, key), rounding_mm):
            keys.append(key)
    texts = {key: [_value_text(getattr(row, key)) for row in (stored, recomputed)] for key in keys}
    return [f"{recomputed.sample}: {key}: {a} in the result, {b} recomputed" for key, (a, b) in texts.items()]


def _value_text(value: object) -> str:
    return printable(value if isinstance(value, str) else repr(value), 80)


def explain_eval(dataset: DatasetFolder, split: str, target: str, edge_band_px: int) -> Explanation:
    """What scoring one split skipped: columns that no score needs, and the search for depth edges far from the object.
    Reads the split's targets again."""
    samples, (height, width) = dataset.samples(split), dataset.size
    boxes = {}
    for sample in samples:
        boxes[sample] = _box_px(object_mask(dataset.target_mm(sample, target)))
        dataset.release(sample)
    frames, depths = len(stored_frames(dataset.sequence, dataset.manifest.stored)), 1 + dataset.has_exact
    read = 1 + (target != "depth")
    median = sorted(samples, key=lambda sample: boxes[sample])[len(samples) // 2]
    depth_mm = dataset.target_mm(median, target)
    skipped = len(samples) * depth_mm.size - sum(boxes.values())
    unread_bytes = len(samples) * (frames + (depths - read) * depth_mm.itemsize) * depth_mm.size
    bands = (edge_band_px, protocol.WIDE_BAND_PX)
    seconds = saved_by(lambda: object_near_edges(depth_mm, bands), depth_mm.size - boxes[median], skipped)
    lines = [
        LeftOut(
            "columns that no score needs",
            "images",
            len(samples) * read,
            len(samples) * (frames + depths - read),
            unread_bytes,
            None,
            "not read; seconds not measured, they depend on the disk",
        ),
        LeftOut(
            "depth edges far from the object",
            "pixels",
            sum(boxes.values()),
            skipped,
            None,
            seconds,
            f"processor seconds of one sample ({median}) without skipping minus with it, measured now, scaled to the "
            "pixels that all samples skipped",
        ),
    ]
    return explained("fpp-eval", f"{len(samples)} samples of {width}x{height} px", lines)


def _box_px(inside: NDArray[np.bool_]) -> int:
    """Pixels of the box in which `object_near_edges` searches."""
    box = object_box(inside)
    return 0 if box is None else int(inside[box].size)
