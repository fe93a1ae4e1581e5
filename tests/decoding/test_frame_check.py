"""A failed sinusoid frame is refused by name; correct captures never are."""

import numpy as np
import pytest

from fpp_ml_bench.baselines.stability import coded_rig, plane_stack
from fpp_ml_bench.decoding.decode import decode_stack
from fpp_ml_bench.errors import DecodeError


@pytest.mark.parametrize("steps", [4, 5, 6, 9, 18])
@pytest.mark.parametrize("direction", ["horizontal", "vertical"])
def test_a_black_frame_is_refused_by_name(steps, direction):
    rig = coded_rig(steps=steps)
    frames, _ = plane_stack(rig)
    dead = rig.sequence.sinusoids(direction)[2]
    frames[dead] = np.zeros_like(frames[dead])
    with pytest.raises(DecodeError, match=rf"frame {dead}: {direction} sinusoid, step 2.*capture failed"):
        decode_stack(frames, rig, direction="both")


def test_a_dimmed_frame_is_refused_unless_it_is_not_used():
    rig = coded_rig()
    frames, _ = plane_stack(rig)
    frames[1] = frames[1] // 2
    with pytest.raises(DecodeError, match="frame 1: horizontal sinusoid, step 1"):
        decode_stack(frames, rig)
    assert (decode_stack(frames, rig, steps=9).depth_mm > 0).mean() > 0.9
    assert (decode_stack(frames, rig, direction="vertical").depth_mm > 0).mean() > 0.9


@pytest.mark.parametrize("steps", [4, 5, 6, 18])
@pytest.mark.parametrize("pitch", [18.0, 900.0])
@pytest.mark.parametrize("bend", ["gamma", "clipped", "dark", "flat", "black", "random"])
def test_no_correct_capture_is_refused(steps, pitch, bend):
    rig = coded_rig(pitch, steps)
    frames, _ = plane_stack(rig, mean=100.0, modulation=90.0)
    change = {
        "gamma": lambda grey: 255 * (grey / 255.0) ** 2.2,
        "clipped": lambda grey: np.minimum(2.5 * grey, 255.0),
        "dark": lambda grey: grey / 20.0,
        "flat": lambda grey: np.full(grey.shape, 90.0),
        "black": lambda grey: np.zeros(grey.shape),
        "random": lambda grey: np.random.default_rng(3).integers(0, 256, grey.shape),
    }[bend]
    stack = [None if grey is None else np.rint(change(grey)).astype(np.uint8) for grey in frames]
    decode_stack(stack, rig)
    few = np.zeros((32, 32), dtype=bool)
    few[3:12, 4:12] = True  # 72 pixels: a small patch of phase
    decode_stack(stack, rig, mask=few)
