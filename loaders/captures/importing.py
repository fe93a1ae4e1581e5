"""A dataset from a scanner's captures: each is decoded by the scanner's rig into the ground truth ``depth``, through
the same crash-safe assembly as a build. What the rig can't decode is background there."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench import __version__
from fpp_ml_bench.coding import Limits, Reason
from fpp_ml_bench.decoding import Decoded, check_limits, decode_stack
from fpp_ml_bench.errors import CaptureError, DecodeError
from fpp_ml_bench.examination import RefusedCapture
from fpp_ml_bench.loaders import storage
from fpp_ml_bench.loaders.captures.decoding import CAUSES, examine_capture, main_reason
from fpp_ml_bench.loaders.captures.folders import Capture, Splits, find_captures, split_captures
from fpp_ml_bench.loaders.captures.images import CapturedFrames, check_options, read_frames
from fpp_ml_bench.loaders.sample import Row
from fpp_ml_bench.loaders.storage import CAPTURED, Assembly, Manifest, Progress, ShardPlan
from fpp_ml_bench.optics import Rig

LEAST_DECODED_SHARE = 0.005
"""Of a capture's pixels. Below it nothing was measured but noise that passed by chance."""
_CHECK_THREADS = 2


@dataclass(frozen=True)
class CaptureReader:
    """Picklable source of a dataset's rows: reads and decodes one of ``captures``, by sample, after the other."""

    captures: dict[str, Capture]
    rig: Rig
    limits: Limits
    bits: int | None
    colour: str | None
    anyway: bool = False

    def __call__(self, plan: ShardPlan, folder: Path) -> Iterator[Row]:
        for sample, _, _ in plan.samples:
            yield self.read(self.captures[sample])

    def files(self, sample: str) -> tuple[Path, ...]:
        return self.captures[sample].files

    def problem(self, capture: Capture) -> str | None:
        """What is wrong with a capture; None where it can be read."""
        try:
            self.read(capture)
        except CaptureError as error:
            return str(error)
        return None

    def read(self, capture: Capture) -> Row:
        """The capture's row: frames of 8 bits, and depth from the frames as they were captured. Raises `CaptureError`
        for frames that can't be read, that are of another size than the rig's camera, that the examination refuses
        (unless ``anyway``), and that give almost no depth."""
        captured = read_frames(capture.files, bits=self.bits, colour=self.colour)
        examination = examine_capture(captured, self.rig, min_modulation=self.limits.min_modulation)
        if examination.refused and not self.anyway:
            raise RefusedCapture(str(capture.folder), examination)
        try:
            decoded = decode_stack(captured.frames, self.rig, limits=self.limits, details=True)
        except DecodeError as error:
            raise CaptureError(f"{capture.folder}: {error}") from error
        measured = _measured(decoded, captured) | {"findings": [str(finding) for finding in examination.findings]}
        if measured["decoded_share"] < LEAST_DECODED_SHARE:
            reason = main_reason(decoded)
            share = decoded.counts[reason.name.lower()] / decoded.reason.size
            raise CaptureError(
                f"{capture.folder}: only {100 * measured['decoded_share']:.2f}% of the pixels can be decoded, expected "
                f"at least {100 * LEAST_DECODED_SHARE:g}%; {100 * share:.0f}% are refused as "
                f"{reason.name.lower().replace('_', ' ')}: probably {CAUSES[reason]}"
            )
        frames = {index: _eight_bits(frame) for index, frame in enumerate(captured.frames)}
        names = capture.sample, capture.object, capture.view
        return Row(*names, frames, decoded.depth_mm, None, measured)


def _eight_bits(frame: NDArray[Any]) -> NDArray[np.uint8]:
    return frame if frame.dtype == np.uint8 else np.rint(frame).astype(np.uint8)


def _measured(decoded: Decoded, captured: CapturedFrames) -> dict[str, Any]:
    """Measurements for the manifest: share of the pixels with a depth, their median modulation in grey levels (of the
    weaker direction), the share refused for each reason, and how the frames' levels were read."""
    good = decoded.reason == Reason.DECODED
    weakest = np.minimum.reduce([measured.modulation for measured in decoded.details.values()])
    counts = {name: count for name, count in decoded.counts.items() if count and name != "decoded"}
    return {
        "decoded_share": float(good.mean()),
        "median_modulation": float(np.median(weakest[good])) if good.any() else 0.0,
        "refused_share": {name: count / good.size for name, count in counts.items()},
        "full_scale": captured.full_scale,
        "rounded": captured.frames.dtype != np.uint8,
        "note": captured.note,
    }


def _views(captures: list[Capture]) -> dict[str, list[str]]:
    """Views of each object."""
    views: dict[str, list[str]] = {}
    for capture in captures:
        views.setdefault(capture.object, []).append(capture.view)
    return views


class CapturePlan(NamedTuple):
    """An import that is ready to start: the reader of the captures found, and the dataset to assemble."""

    reader: CaptureReader
    assembly: Assembly


def plan_captures(
    root: Path,
    rig: Rig,
    splits: Splits | None = None,
    limits: Limits | None = None,
    bits: int | None = None,
    colour: str | None = None,
    anyway: bool = False,
) -> CapturePlan:
    """Find the captures ``root/{object}/{view}/`` or ``root/{object}/``, each a folder of all frames of
    ``rig.sequence``. ``splits``: which objects are in which; None puts all into ``test``. ``limits``: of the decoder;
    ``bits`` and ``colour``: see `read_frames`; ``anyway``: captures that the examination refuses too.
    Raises `CaptureError` with a line for each folder that is no capture, `BuildError` for splits that are not of these
    objects, `DecodeError` for an impossible limit."""
    check_options(bits, colour)
    check_limits(limits := limits or Limits())
    captures = find_captures(root, len(rig.sequence))
    by_split = split_captures(captures, splits)
    size = rig.camera.height, rig.camera.width
    plans: list[ShardPlan] = []
    for split, chosen in by_split.items():
        plans += storage.plan_rows(split, [(c.sample, c.object, c.view) for c in chosen], size[0] * size[1])
    settings = {
        "layout": "captures",
        "splits": "all in test" if splits is None else "given",
        **asdict(limits),
        "bits": bits,
        "colour": colour,
        "objects": {split: _views(chosen) for split, chosen in by_split.items()},
    }
    generator = {"name": "fpp-ml-bench", "version": __version__}
    manifest = Manifest(CAPTURED, generator, settings, rig.to_dict(), size, "all", exact=False)
    reader = CaptureReader({capture.sample: capture for capture in captures}, rig, limits, bits, colour, anyway)
    return CapturePlan(reader, Assembly(plans, reader, manifest))


def import_captures(folder: Path, plan: CapturePlan, workers: int, progress: Progress = lambda rows: None) -> Manifest:
    """Write the planned dataset into ``folder``, or go on with one that was interrupted. When a capture can't be used,
    all others are tried too, so that the `CaptureError` lists every one. Raises `BuildError` as a build does, and when
    a capture changed after ``folder`` was finished."""
    reader = plan.reader
    storage.forget_outdated(folder, plan.assembly.plans, reader.files)
    try:
        return storage.assemble(folder, plan.assembly, workers, progress)
    except CaptureError as error:
        with ThreadPoolExecutor(_CHECK_THREADS) as pool:
            problems = [line for line in pool.map(reader.problem, reader.captures.values()) if line]
        raise CaptureError("\n  ".join(problems) if problems else str(error)) from error


def capture_notes(manifest: Manifest) -> list[str]:
    """Notes about a finished import for the user, a sentence each."""
    rows = [row for part in manifest.samples.values() for row in part]
    notes = []
    if manifest.settings["splits"] != "given":
        notes.append("no --splits given: all objects are in split test")
    scales = sorted({row["full_scale"] for row in rows})
    if any(row["rounded"] for row in rows):
        notes.append("depth was decoded from the frames as captured; they are stored rounded to 8 bits")
    notes += sorted({row["note"] for row in rows} - {""})
    if len(scales) > 1:
        listed = ", ".join(map(str, scales))
        notes.append(f"white was taken as different levels ({listed}); give the camera's --bits to read all alike")
    notes += [f"{row['sample']}: {finding}" for row in rows for finding in row["findings"]]
    return notes
