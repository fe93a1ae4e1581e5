"""What ``fpp-bench predict`` left out: frames that the method does not need, pixels that can't be object."""

from typing import Any

from fpp_ml_bench.baselines.classical import ClassicalMethod
from fpp_ml_bench.baselines.methods import Method
from fpp_ml_bench.baselines.prediction import captured_frames
from fpp_ml_bench.explain import Explanation, LeftOut, explained, saved_by, seconds_of
from fpp_ml_bench.loaders.schema import stored_frames
from fpp_ml_bench.loaders.store import DatasetFolder
from fpp_ml_bench.skipping import skipping

COUNTED_SAMPLES = 6
"""Pixels are counted on this many samples, spread evenly over the split; frames follow from the method alone."""


def explain_predict(opened: DatasetFolder, method: Method, split: str) -> Explanation:
    """The account of a run of ``method`` over ``split``. Takes as long as predicting some samples again."""
    samples = opened.samples(split)
    stored = stored_frames(opened.sequence, opened.manifest.stored)
    lines = [_frames(opened, method, samples, [index for index in stored if index not in method.frames_used])]
    count = min(COUNTED_SAMPLES, len(samples))
    counted = [samples[i * len(samples) // count] for i in range(count)]
    if isinstance(method, ClassicalMethod):
        lines += _second_direction(opened, method, counted, len(samples))
    elif getattr(method, "route", None) is not None:
        lines.append(_outside_crop(opened, method, counted, len(samples)))
    height, width = opened.size
    about = f"{method.title}; {len(samples)} samples of {width}x{height} px"
    return explained("predict", about, lines)


def _frames(opened: DatasetFolder, method: Method, samples: list[str], unused: list[int]) -> LeftOut:
    height, width = opened.size
    sample = samples[len(samples) // 2]
    seconds = seconds_of(lambda: [frame.copy() for frame in opened.frames(sample, unused)]) if unused else None
    opened.release(sample)
    return LeftOut(
        "frames that the method does not use", "frames", len(method.frames_used) * len(samples),
        len(unused) * len(samples), len(unused) * len(samples) * height * width,
        None if seconds is None else seconds * len(samples),
        f"processor seconds of reading them for one sample ({sample}) now, times the samples",
    )  # fmt: skip


def _second_direction(
    opened: DatasetFolder, method: ClassicalMethod, counted: list[str], samples: int
) -> list[LeftOut]:
    if method.direction != "both":
        return []
    height, width = opened.size
    decoded_px, skipped_px, seconds = 0, 0, 0.0
    for sample in counted:
        frames = captured_frames(opened, method, sample)
        with skipping(True):
            second_px = method.decode(frames, reasons=False).second_px
        saved = saved_by(lambda frames=frames: method.predict(frames), 1, 1)  # type: ignore[misc]
        decoded_px, skipped_px = decoded_px + second_px, skipped_px + height * width - second_px
        seconds += saved or 0.0
    scale = samples / len(counted)
    frames_each = len(method.frames_used) // 2
    return [
        LeftOut(
            "second direction where the first shows no object", "pixels", round(decoded_px * scale),
            round(skipped_px * scale), round(skipped_px * scale) * frames_each, seconds * scale,
            f"{len(counted)} of {samples} samples predicted again now with skipping off and on, and scaled up",
        )
    ]  # fmt: skip


def _outside_crop(opened: DatasetFolder, method: Any, counted: list[str], samples: int) -> LeftOut:
    height, width = opened.size
    inside = 0
    for sample in counted:
        frames = captured_frames(opened, method, sample)
        images = [frames[index] for index in method.frames_used]
        crop = method.route.observe(images if len(images) > 1 else images[0]).crop
        inside += (crop[0].stop - crop[0].start) * (crop[1].stop - crop[1].start)
    scale = samples / len(counted)
    return LeftOut(
        "local fits and orders far from the object", "pixels", round(inside * scale),
        round((len(counted) * height * width - inside) * scale), None, None,
        f"pixels counted on {len(counted)} of {samples} samples; the crop is part of the method, so there is no run "
        "without it to measure against",
    )  # fmt: skip
