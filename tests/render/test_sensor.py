"""The sensor: is its noise normal, independent and of the right size, and are its bytes those of a
plain evaluation?

Seeds are fixed, so every p-value below is a constant of this code. With these thresholds a good
generator passes for nearly any seed and a poor generator fails. References: scipy.stats and NumPy's
generator.
"""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from rendering import PAPER, RIG
from scipy import stats

from fpp_ml_bench.loaders.render.illumination import LitPixels
from fpp_ml_bench.loaders.render.light import CameraLight, named_light
from fpp_ml_bench.loaders.render.projector import ALONG_U, PatternPlace
from fpp_ml_bench.loaders.render.sensor import (
    Exposure,
    Noise,
    camera_noise,
    hash_pixels,
    normal_table,
    standard_normal,
    stream_keys,
)
from fpp_ml_bench.optics.patterns import pattern_image
from fpp_ml_bench.optics.sequence import Sequence

SIZE = 960
PIXELS = np.arange(SIZE * SIZE, dtype=np.uint32)
STREAMS = [(42, "mug", "A0", 0), (42, "mug", "A0", 17), (7, "wooden_boards", "A300", 51)]


def deviates(*name, pixels=PIXELS):
    return standard_normal(pixels, stream_keys(*name)).astype(np.float64)


def correlation(a, b):
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


@pytest.fixture(scope="module")
def frames():
    return {name: deviates(*name) for name in STREAMS}


@pytest.mark.parametrize("name", STREAMS)
def test_distribution_is_normal(frames, name):
    z = frames[name]
    # Anderson-Darling, which weighs the tails too; with known mean and variance its 0.1% point is
    # 6.0 (Stephens 1974).
    u = np.sort(stats.norm.cdf(z))
    i = np.arange(1, u.size + 1)
    a2 = -u.size - np.mean((2 * i - 1) * (np.log(u) + np.log1p(-u[::-1])))
    assert a2 < 6.0


def test_tails_hold_as_many_pixels_as_they_should():
    z = np.concatenate([deviates(42, "bowl", "A60", frame) for frame in range(12)])
    expected = z.size * stats.norm.sf(4.0)
    for count in ((z > 4.0).sum(), (z < -4.0).sum()):
        assert abs(count - expected) < 5 * np.sqrt(expected) + 0.02 * expected


def test_largest_deviate_is_as_documented():
    assert float(2 * normal_table().max()) == pytest.approx(5.2, abs=0.1)
    table = normal_table().astype(np.float64)
    # Each entry is rounded once to float32, by 2**-24 of itself at most; a square has twice the
    # relative error.
    assert table.mean() == pytest.approx(0, abs=2**-24 * np.abs(table).mean())
    assert (table**2).mean() == pytest.approx(0.5, rel=2**-22)
    with pytest.raises(ValueError, match="read-only"):
        normal_table()[0] = 0


@pytest.mark.parametrize("lag", [1, 16, 255, SIZE, 65536])
def test_pixels_are_independent_of_their_neighbours(frames, lag):
    for z in frames.values():
        bound = 5 / np.sqrt(z.size - lag)
        assert abs(correlation(z[:-lag], z[lag:])) < bound
        # Signs and sizes separately: a generator may have a pattern in either.
        assert abs(correlation(np.sign(z[:-lag]), np.sign(z[lag:]))) < bound
        assert abs(correlation(z[:-lag] ** 2, z[lag:] ** 2)) < bound


@pytest.mark.parametrize(
    "other",
    [(42, "mug", "A0", 1), (42, "mug", "A60", 0), (42, "bowl", "A0", 0), (43, "mug", "A0", 0)],
)
def test_frames_views_objects_and_seeds_are_independent(frames, other):
    a, b = frames[STREAMS[0]], deviates(*other)
    bound = 5 / np.sqrt(a.size)
    assert abs(correlation(a, b)) < bound
    assert abs(correlation(a**2, b**2)) < bound


def test_names_are_told_apart_where_they_are_joined():
    assert not np.array_equal(stream_keys(1, "a", "bc"), stream_keys(1, "ab", "c"))
    assert not np.array_equal(stream_keys(1, 23), stream_keys(12, 3))
    keys = {
        stream_keys(42, "mug", f"A{a}", f).tobytes() for a in range(0, 360, 60) for f in range(52)
    }
    assert len(keys) == 312


@pytest.mark.long
def test_hash_is_a_bijection_of_the_pixel_number():
    sample = np.concatenate([PIXELS, np.arange(2**32 - 500_000, 2**32, dtype=np.uint32)])
    hashes = hash_pixels(sample, stream_keys(2**40, "anything"))
    assert np.unique(hashes).size == sample.size


# ---- the sensor as EMVA 1288 measures it, from the bytes of frames of a flat field


def flat(grey, n=PIXELS.size):
    """n pixels that all get ``grey`` grey levels in the white frame."""
    nothing = np.zeros(n, dtype=np.uint16), np.zeros(n, dtype=np.float32)
    place = PatternPlace(*nothing, *nothing, np.empty(0, np.uint8), np.empty(0, np.float32))
    return LitPixels(place, np.full(n, grey, dtype=np.float32), np.zeros(n, dtype=np.float32))


def lit_by(grey, ambient, bounced):
    """Three pixels with light of the pattern, of other lamps and of bounces."""
    bounces = np.full((52, 3), bounced, np.float32)
    return replace(flat(grey, 3), ambient=np.full(3, ambient, np.float32), bounced=bounces)


def exposure_of(rig=None, projector=None, **camera):
    light = PAPER.changed("camera", **camera).changed("projector", **(projector or {}))
    return Exposure.of(rig or RIG, light)


WHITE = RIG.sequence.white


@pytest.mark.parametrize(
    ("full_well_e", "read_noise_e", "black_grey"), [(4000.0, 40.0, 10.0), (10500.0, 60.0, 8.0)]
)
def test_photon_transfer_curve_gives_gain_and_read_noise_back(
    full_well_e, read_noise_e, black_grey
):
    """EMVA 1288: temporal variance over mean is a line whose slope is the gain, and whose end is
    the read noise. Its quantisation adds 1/12."""
    exposure = exposure_of(
        full_well_e=full_well_e, read_noise_e=read_noise_e, black_grey=black_grey
    )
    means, variances = [], []
    for level in np.linspace(30, 190, 9) + 0.37:
        first, second = (
            exposure.expose([WHITE], flat(level), PIXELS, (seed, "flat", level))[0].astype(float)
            for seed in (1, 2)
        )
        means.append((first.mean() + second.mean()) / 2)
        variances.append(((first - second) ** 2).mean() / 2)  # without what the two have in common
    assert means[0] == pytest.approx(30.37 + black_grey, abs=0.01)
    gain, offset = np.polyfit(np.array(means) - black_grey, np.array(variances) - 1 / 12, 1)
    e_per_grey = full_well_e / 255
    assert 1 / gain == pytest.approx(e_per_grey, rel=0.02)
    assert np.sqrt(offset) / gain == pytest.approx(read_noise_e, rel=0.02)
    dark = exposure.expose([RIG.sequence.black], flat(200.0), PIXELS, (3, "dark"))[0].astype(float)
    assert dark.mean() == pytest.approx(black_grey, abs=0.01)
    assert np.sqrt(dark.var() - 1 / 12) * e_per_grey == pytest.approx(read_noise_e, rel=0.01)


def test_sigma_is_that_of_mid_grey():
    noise = Noise.of_camera(CameraLight(**camera_noise(2.0)))
    assert noise.read_variance + noise.shot_per_grey * 127.5 == pytest.approx(4.0)
    assert noise.read_variance == pytest.approx(2.0)
    assert camera_noise(0) == {"full_well_e": None, "read_noise_e": 0.0}
    assert Noise.of_camera(CameraLight(full_well_e=None, read_noise_e=50.0)) == Noise(0.0, 0.0)
    # The paper's camera has 1 grey level at mid-grey.
    paper = Noise.of_camera(CameraLight(full_well_e=32500.0, read_noise_e=10.0))
    assert paper.read_variance + paper.shot_per_grey * 127.5 == pytest.approx(1.0, abs=0.01)


RAMP = np.linspace(0, 300, PIXELS.size).astype(np.float32)


def ramp_bytes(**camera):
    return exposure_of(**{"full_well_e": None, **camera}).expose(
        [WHITE], replace(flat(0.0), ambient=RAMP), PIXELS, (1, "ramp")
    )[0]


@pytest.mark.parametrize("bits", [8, 12])
@pytest.mark.parametrize("response", [1.0, 0.55, (0.0, 0.47, 0.8, 1.0)])
def test_converter_and_response_against_a_direct_evaluation(bits, response):
    black_grey, most = 4.25, 2**bits - 1
    light = RAMP.astype(np.float64) + black_grey
    code = np.floor(light / 255 * most + 0.5).clip(0, most) / most
    curve = np.interp(code, [0, 1 / 3, 2 / 3, 1], response) if np.ndim(response) else code**response
    read = ramp_bytes(bits=bits, response=response, black_grey=black_grey)
    assert read.dtype == np.uint8
    off = read != np.floor(255 * curve + 0.5)
    # Light within float32's rounding of the middle between two codes may go to either: a step
    # further at most.
    assert off.mean() < 1e-3
    steepest = np.ceil(255 * np.abs(np.diff(np.unique(curve))).max())
    assert np.abs(read.astype(float) - 255 * curve)[off].max(initial=0) <= steepest + 0.5


def test_quantisation_rounds_and_clips_at_the_ends():
    np.testing.assert_array_equal(
        ramp_bytes(), np.floor(RAMP.astype(np.float64) + 0.5).clip(0, 255)
    )


@pytest.mark.parametrize("bits", [8, 10])
def test_bounces_take_no_light_away(bits):
    """Those of a response that is no line come without its higher harmonics, and can be below 0:
    then the square root of the noise is none, and a code that is not a number would be looked up
    beside its table."""
    exposure = exposure_of(bits=bits, full_well_e=23000.0, read_noise_e=12.0, black_grey=9.0)
    dark = flat(0.0)
    taken = replace(dark, bounced=np.full((52, PIXELS.size), -13.0, np.float32))
    frames = [exposure.expose([WHITE], lit, PIXELS, (1, "flat"))[0] for lit in (dark, taken)]
    assert (frames[0] == frames[1]).all() and frames[0].mean() == pytest.approx(9, abs=0.1)
    lit = lit_by(0.0, 20, -13)
    assert (exposure.radiance([WHITE], lit, (1, "flat"), np.empty((1, 3), np.float32)) == 7).all()


# ---- flicker


def test_flicker_is_one_factor_a_frame_and_normal():
    exposure = exposure_of(projector={"flicker": 0.02})
    assert exposure_of().flicker == 0
    lamps, lit = [], lit_by(2e3, 7.0, 1e3)
    for view in range(40):
        light = exposure.radiance(range(52), lit, (1, "flat", view), np.empty((52, 3), np.float32))
        assert (light == light[:, :1]).all()  # the same for every pixel
        # Direct and bounced light flicker together, other lamps don't.
        lamps += [(light[RIG.sequence.black, 0] - 7) / 1e3 - 1, (light[WHITE, 0] - 7) / 3e3 - 1]
        # A frame's lamp does not depend on which others are exposed.
        alone = exposure.radiance([WHITE], lit, (1, "flat", view), np.empty((1, 3), np.float32))
        assert alone[0, 0] == light[WHITE, 0]
    lamps = np.array(lamps)
    assert lamps.std() == pytest.approx(0.02, rel=4 / np.sqrt(2 * lamps.size))
    assert abs(lamps.mean()) < 4 * 0.02 / np.sqrt(lamps.size)
    assert stats.kstest(lamps / 0.02, "norm").pvalue > 1e-3


# ---- exposing frames: the compiled kernel compared with NumPy, and both with OpenCV


SMALL = replace(RIG, sequence=Sequence(steps=3))
"""Fewer frames, of the same kinds."""
FRAMES = (0, 2, 3, 6, 14, 20, 21)
LIGHTS = {
    "paper": named_light("paper"),
    "workshop": named_light("workshop"),
    "hard": named_light("hard"),
    "noisy": PAPER.changed("camera", **camera_noise(6.0)).changed("projector", flicker=0.05),
}


@cache
def exposure_under(name):
    return Exposure.of(SMALL, LIGHTS[name])


def randomly_lit(exposure, light, n=211 * 173):
    """Random projector coordinates, gains, ambient and bounced light of n points (211 x 173: no
    round numbers)."""
    rng = np.random.default_rng(5)
    u, v = rng.uniform(-30, 941, n), rng.uniform(-30, 1169, n)
    place = exposure.pattern.place(u, v, rng.uniform(1.5, 3.2, n), SMALL, light.projector)
    gain = np.where(rng.random(n) < 0.2, 0, rng.uniform(0, 260, n)).astype(np.float32)
    bounced = rng.uniform(0, 30, (len(exposure.pattern.table), n)).astype(np.float32)
    return u, v, LitPixels(place, gain, rng.uniform(0, 20, n).astype(np.float32), bounced)


def subset(lit, indices):
    p = lit.place
    part = [
        array[indices] if array.size else array
        for array in (p.u_index, p.u_weight, p.v_index, p.v_weight, p.level, p.level_weight)
    ]
    bounced = None if lit.bounced is None else lit.bounced[:, indices]
    return LitPixels(PatternPlace(*part), lit.gain[indices], lit.ambient[indices], bounced)


def in_numpy(exposure, frames, lit, pixels, stream):
    """Bytes by the formulas of the module, one array operation after the other, in float32."""
    f, p, sensor, rows = np.float32, lit.place, exposure.sensor, []
    samples = lit.gain.size // pixels.size
    for frame in frames:
        profiles = exposure.pattern.table[frame]
        index, weight = (
            (p.u_index, p.u_weight)
            if exposure.pattern.along[frame] == ALONG_U
            else (p.v_index, p.v_weight)
        )
        low, high = profiles[0][index], profiles[0][index.astype(int) + 1]
        if len(profiles) > 1:
            share, level = p.level_weight, p.level.astype(int)
            low, high = (
                profiles[level, at] + share * (profiles[level + 1, at] - profiles[level, at])
                for at in (index, index.astype(int) + 1)
            )
        lamp = f(1)
        if exposure.flicker:
            lamp += (
                f(exposure.flicker)
                * standard_normal(np.zeros(1, np.uint32), stream_keys(*stream, "lamp", frame))[0]
            )
        signal = lit.ambient + lamp * lit.gain * (low + weight * (high - low))
        if lit.bounced is not None:
            signal = signal + lamp * lit.bounced[frame]
        if samples > 1:
            parts = signal.reshape(-1, samples)
            total = np.zeros(len(parts), f)
            for k in range(samples):
                total += parts[:, k]
            signal = total * f(1 / samples)
        noise = standard_normal(pixels, stream_keys(*stream, frame))
        sigma = np.sqrt(f(sensor.noise.read_variance) + f(sensor.noise.shot_per_grey) * signal)
        value = signal + f(sensor.black_grey) + sigma * noise
        most = sensor.grey_of_code.size - 1
        code = np.clip(value * f(most / 255) + f(0.5), 0, most).astype(np.int32)
        rows.append(sensor.grey_of_code[code])
    return np.stack(rows)


@pytest.mark.long
@pytest.mark.parametrize("name", LIGHTS)
def test_kernel_and_numpy_give_the_same_bytes(name):
    exposure = exposure_under(name)
    _, _, lit = randomly_lit(exposure, LIGHTS[name])
    n = lit.gain.size
    all_pixels = np.arange(n, dtype=np.uint32)
    shifted = all_pixels + np.uint32(100_000)  # contiguous, but not from pixel 0
    scattered = np.flatnonzero(np.random.default_rng(0).random(n) < 0.3)
    fourth = all_pixels[: n // 4]  # four rays a pixel
    cases = [
        (all_pixels, lit),
        (shifted, replace(lit, bounced=None)),
        (scattered.astype(np.uint32), subset(lit, scattered)),
        (fourth, subset(lit, np.arange(4 * fourth.size))),
    ]
    for pixels, part in cases:
        read = exposure.expose(FRAMES, part, pixels, (42, "mug", "A0"))
        np.testing.assert_array_equal(
            read, in_numpy(exposure, FRAMES, part, pixels, (42, "mug", "A0"))
        )


@pytest.mark.long
def test_light_and_sensor_one_after_the_other_give_the_same_bytes():
    """`radiance` and then `sense`, as with a blurring lens between, is `expose`."""
    exposure = exposure_under("hard")
    _, _, lit = randomly_lit(exposure, LIGHTS["hard"])
    pixels = np.arange(5000, dtype=np.uint32)
    part = subset(lit, np.arange(5000 * 4))
    whole = exposure.expose(FRAMES, part, pixels, (1, "mug", "A0"))
    light_grey = exposure.radiance(
        FRAMES, part, (1, "mug", "A0"), np.empty(whole.shape, np.float32)
    )
    sensed = exposure.sense(FRAMES, light_grey, pixels, (1, "mug", "A0"), np.empty_like(whole))
    np.testing.assert_array_equal(sensed, whole)


@pytest.mark.parametrize("index", [0, 30, 42, 51])
def test_pattern_lookup_is_opencv_remap_of_the_pattern_image(index):
    """Bilinear lookup against cv2.remap on the projected image itself: OpenCV rounds weights to
    1/32 px."""
    exposure = exposure_of(rays_across=1, full_well_e=None)
    u, v, lit = randomly_lit(exposure, PAPER)
    lit = replace(lit, bounced=None)
    (read,) = exposure.expose([index], lit, np.arange(u.size, dtype=np.uint32), (1, "mug", "A0"))
    image = np.ascontiguousarray(pattern_image(RIG, index)).astype(np.float32)
    size = (211, 173)
    light = cv2.remap(
        image,
        u.reshape(size).astype(np.float32),
        v.reshape(size).astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    ).ravel()
    expected = np.clip(lit.ambient + lit.gain * (light / 255), 0, 255)
    steepest = np.abs(np.diff(image, axis=0)).max() + np.abs(np.diff(image, axis=1)).max()
    # Half a grey level of rounding, a weight wrong by up to 1/64 px on the steepest flank, and 0.01
    # grey levels for OpenCV's float32 coordinates: 3e-5 px at 941 px, times 255 grey levels per px.
    tolerance = 0.5 + steepest / 64 * lit.gain.max() / 255 + 0.01
    assert np.abs(read - expected).max() <= tolerance
    assert np.abs(read - expected).mean() < 0.3
