"""The sensor: is its noise normal, independent and of the right size, and are its bytes those of a plain evaluation?

Seeds are fixed, so every p-value below is a constant of this code. With these thresholds a good generator passes for
nearly any seed and a poor generator fails. References: scipy.stats and NumPy's generator.
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
from fpp_ml_bench.loaders.render.scene import uniform
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
def test_moments_are_those_of_a_standard_normal(frames, name):
    z = frames[name]
    n = z.size
    # Bounds: five standard errors of the moments of n normal deviates.
    assert abs(z.mean()) < 5 / np.sqrt(n)
    assert abs(z.var() - 1) < 5 * np.sqrt(2 / n)
    assert abs(stats.skew(z)) < 5 * np.sqrt(6 / n)
    assert abs(stats.kurtosis(z)) < 5 * np.sqrt(24 / n)


@pytest.mark.parametrize("name", STREAMS)
def test_distribution_is_normal(frames, name):
    z = frames[name]
    assert stats.kstest(z, "norm").pvalue > 1e-3
    assert stats.cramervonmises(z[:200_000], "norm").pvalue > 1e-3
    # Anderson-Darling weighs the tails; with known mean and variance its 0.1% point is 6.0 (Stephens 1974).
    u = np.sort(stats.norm.cdf(z))
    i = np.arange(1, u.size + 1)
    a2 = -u.size - np.mean((2 * i - 1) * (np.log(u) + np.log1p(-u[::-1])))
    assert a2 < 6.0


def test_a_wrong_distribution_would_be_noticed():
    uniform_sum = np.random.default_rng(1).random((4, 200_000)).sum(axis=0)
    poor = (uniform_sum - 2) * np.sqrt(3)  # the sum of four uniforms, scaled: a popular cheap normal
    assert stats.kstest(poor, "norm").pvalue < 1e-6


@pytest.mark.parametrize("limit", [3.0, 3.5, 4.0, 4.5])
def test_tails_hold_as_many_pixels_as_they_should(frames, limit):
    z = np.concatenate([deviates(42, "bowl", "A60", frame) for frame in range(12)])
    for count, share in (((z > limit).sum(), stats.norm.sf(limit)), ((z < -limit).sum(), stats.norm.sf(limit))):
        expected = z.size * share
        assert abs(count - expected) < 5 * np.sqrt(expected) + 0.02 * expected


def test_largest_deviate_is_as_documented():
    assert float(2 * normal_table().max()) == pytest.approx(5.2, abs=0.1)
    table = normal_table().astype(np.float64)
    # Each entry is rounded once to float32, by 2**-24 of itself at most; a square has twice the relative error.
    assert table.mean() == pytest.approx(0, abs=2**-24 * np.abs(table).mean())
    assert (table**2).mean() == pytest.approx(0.5, rel=2**-22)
    with pytest.raises(ValueError, match="read-only"):
        normal_table()[0] = 0


@pytest.mark.parametrize("lag", [1, 2, 3, 7, 16, 64, 255, 256, SIZE - 1, SIZE, SIZE + 1, 4096, 65536])
def test_pixels_are_independent_of_their_neighbours(frames, lag):
    for z in frames.values():
        bound = 5 / np.sqrt(z.size - lag)
        assert abs(correlation(z[:-lag], z[lag:])) < bound
        # Signs and sizes separately: a generator may have a pattern in either.
        assert abs(correlation(np.sign(z[:-lag]), np.sign(z[lag:]))) < bound
        assert abs(correlation(z[:-lag] ** 2, z[lag:] ** 2)) < bound


def test_spectrum_of_a_frame_is_white(frames):
    for z in frames.values():
        power = np.abs(np.fft.rfft2(z.reshape(SIZE, SIZE))) ** 2 / z.size
        inner = power[1:480, 1:480].ravel()  # independent exponential values of mean 1
        assert stats.kstest(inner, "expon").pvalue > 1e-3
        assert inner.max() < np.log(inner.size) + 12


@pytest.mark.parametrize(
    ("name", "other_name"),
    [
        ((42, "mug", "A0", 0), (42, "mug", "A0", 1)),
        ((42, "mug", "A0", 0), (42, "mug", "A60", 0)),
        ((42, "mug", "A0", 0), (42, "bowl", "A0", 0)),
        ((42, "mug", "A0", 0), (43, "mug", "A0", 0)),
        ((42, "mug", "A0", 1), (42, "mug", "A0", 11)),
    ],
)
def test_frames_views_objects_and_seeds_are_independent(name, other_name):
    a, b = deviates(*name), deviates(*other_name)
    bound = 5 / np.sqrt(a.size)
    assert abs(correlation(a, b)) < bound
    assert abs(correlation(a**2, b**2)) < bound
    for shift in (1, SIZE):
        assert abs(correlation(a[:-shift], b[shift:])) < bound


def test_all_frames_of_a_view_are_independent_of_each_other():
    pixels = PIXELS[:100_000]
    stack = np.stack([deviates(42, "mug", "A0", frame, pixels=pixels) for frame in range(52)])
    matrix = np.corrcoef(stack)[np.triu_indices(52, 1)]
    assert np.abs(matrix).max() < 5.5 / np.sqrt(pixels.size)
    assert stats.kstest(matrix * np.sqrt(pixels.size), "norm").pvalue > 1e-3
    # The noise of a pixel through the frames, as phase shifting uses it.
    assert abs(stack.mean(axis=0).var() * 52 - 1) < 5 * np.sqrt(2 / pixels.size)


def test_names_are_told_apart_where_they_are_joined():
    assert not np.array_equal(stream_keys(1, "a", "bc"), stream_keys(1, "ab", "c"))
    assert not np.array_equal(stream_keys(1, 23), stream_keys(12, 3))
    keys = {stream_keys(42, "mug", f"A{a}", f).tobytes() for a in range(0, 360, 60) for f in range(52)}
    assert len(keys) == 312


def test_hash_is_a_bijection_of_the_pixel_number():
    keys = stream_keys(2**40, "anything")
    sample = np.concatenate([PIXELS, np.arange(2**32 - 500_000, 2**32, dtype=np.uint32)])
    hashes = hash_pixels(sample, keys)
    assert np.unique(hashes).size == sample.size
    # Each of the 32 bits is set for half of the pixels, and a changed input bit flips each output bit half of the time.
    shares = np.unpackbits(hashes[:, None].view(np.uint8), axis=1).mean(axis=0)
    np.testing.assert_allclose(shares, np.full(32, 0.5), atol=0.004)
    for bit in (0, 7, 19):
        flipped = hashes[: 1 << 17] ^ hash_pixels(PIXELS[: 1 << 17] ^ np.uint32(1 << bit), keys)
        shares = [float(((flipped >> np.uint32(k)) & 1).mean()) for k in range(24)]
        assert min(shares) > 0.4 and max(shares) < 0.6


def test_uniform_is_uniform():
    draws = np.array([uniform(42, "mug", i) for i in range(5000)])
    assert stats.kstest(draws, "uniform").pvalue > 1e-3
    assert draws.min() >= 0 and draws.max() < 1


# ---- the sensor as EMVA 1288 measures it, from the bytes of frames of a flat field


def flat(grey, n=PIXELS.size):
    """n pixels that all get ``grey`` grey levels in the white frame."""
    nothing = np.zeros(n, dtype=np.uint16), np.zeros(n, dtype=np.float32)
    place = PatternPlace(*nothing, *nothing, np.empty(0, np.uint8), np.empty(0, np.float32))
    return LitPixels(place, np.full(n, grey, dtype=np.float32), np.zeros(n, dtype=np.float32))


def exposure_of(rig=None, projector=None, **camera):
    light = PAPER.changed("camera", **camera).changed("projector", **(projector or {}))
    return Exposure.of(rig or RIG, light)


WHITE = RIG.sequence.white


@pytest.mark.parametrize(
    ("full_well_e", "read_noise_e", "black_grey"), [(4000.0, 40.0, 10.0), (10500.0, 60.0, 4.0), (1500.0, 6.0, 0.0)]
)
def test_photon_transfer_curve_gives_gain_and_read_noise_back(full_well_e, read_noise_e, black_grey):
    """EMVA 1288: temporal variance over mean is a line whose slope is the gain, and whose end is the read noise. Its
    quantisation adds 1/12."""
    exposure = exposure_of(full_well_e=full_well_e, read_noise_e=read_noise_e, black_grey=black_grey)
    means, variances = [], []
    for level in np.linspace(30, 190, 9) + 0.37:
        first, second = (
            exposure.expose([WHITE], flat(level), PIXELS, (seed, "flat", level))[0].astype(float) for seed in (1, 2)
        )
        means.append((first.mean() + second.mean()) / 2)
        variances.append(((first - second) ** 2).mean() / 2)  # without what the two have in common
    assert means[0] == pytest.approx(30.37 + black_grey, abs=0.01)
    gain, offset = np.polyfit(np.array(means) - black_grey, np.array(variances) - 1 / 12, 1)
    e_per_grey = full_well_e / 255
    assert 1 / gain == pytest.approx(e_per_grey, rel=0.02)
    if read_noise_e > 30:  # else it is a small part of the shot noise at the darkest level
        assert np.sqrt(offset) / gain == pytest.approx(read_noise_e, rel=0.02)
    if black_grey >= 8:  # and in the dark by itself, unclipped
        dark = exposure.expose([RIG.sequence.black], flat(200.0), PIXELS, (3, "dark"))[0].astype(float)
        assert dark.mean() == pytest.approx(black_grey, abs=0.01)
        assert np.sqrt(dark.var() - 1 / 12) * e_per_grey == pytest.approx(read_noise_e, rel=0.01)


@pytest.mark.parametrize("sigma", [0.5, 1.0, 3.0])
def test_variance_is_read_noise_plus_shot_noise_linear_in_the_signal(sigma):
    exposure = exposure_of(**camera_noise(sigma))
    for level in (20.0, 60.0, 127.5, 200.0):
        # Subtracted dither of one grey level makes quantisation an independent error of variance 1/12 (Schuchman 1964).
        dither = np.random.default_rng(int(level)).random(PIXELS.size).astype(np.float32) - np.float32(0.5)
        lit = flat(level)
        lit = replace(lit, ambient=dither)
        read = exposure.expose([WHITE], lit, PIXELS, (3, level))[0].astype(np.float64) - dither
        expected = sigma**2 / 2 + sigma**2 / 2 * level / 127.5
        assert read.mean() == pytest.approx(level, abs=5 * np.sqrt(expected + 0.1) / SIZE)
        assert read.var() == pytest.approx(expected + 1 / 12, rel=0.01)


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


@pytest.mark.parametrize("black_grey", [0.0, 4.25])
@pytest.mark.parametrize("bits", [8, 10, 12])
@pytest.mark.parametrize("response", [1.0, 0.55, 2.2, (0.0, 0.47, 0.8, 1.0)])
def test_converter_and_response_against_a_direct_evaluation(bits, response, black_grey):
    most = 2**bits - 1
    light = RAMP.astype(np.float64) + black_grey
    code = np.floor(light / 255 * most + 0.5).clip(0, most) / most
    curve = code**response if not isinstance(response, tuple) else np.interp(code, [0, 1 / 3, 2 / 3, 1], response)
    read = ramp_bytes(bits=bits, response=response, black_grey=black_grey)
    assert read.dtype == np.uint8
    off = read != np.floor(255 * curve + 0.5)
    # Light within float32's rounding of the middle between two codes may go to either: a step further at most.
    assert off.mean() < 1e-3
    steepest = np.ceil(255 * np.abs(np.diff(np.unique(curve))).max())
    assert np.abs(read.astype(float) - 255 * curve)[off].max(initial=0) <= steepest + 0.5


def test_quantisation_is_unbiased_and_clips_at_the_ends():
    read = ramp_bytes()
    np.testing.assert_array_equal(read, np.floor(RAMP.astype(np.float64) + 0.5).clip(0, 255))
    inside = RAMP < 255
    assert abs((read[inside] - RAMP[inside].astype(np.float64)).mean()) < 1e-3
    noisy = exposure_of(**camera_noise(2.0))
    for level, end in ((0.0, 0), (255.0, 255), (400.0, 255)):
        read = noisy.expose([WHITE], flat(level), PIXELS, (1, level))[0]
        assert abs(int(read.min() if end else read.max()) - end) <= 12
        assert (read == end).mean() > 0.5


def test_sigma_zero_gives_no_noise():
    for seed in range(3):
        assert (exposure_of().expose([WHITE], flat(99.0, 1000), PIXELS[:1000], (seed, "flat"))[0] == 99).all()


@pytest.mark.parametrize("bits", [8, 10])
def test_bounces_take_no_light_away(bits):
    """Those of a response that is no line come without its higher harmonics, and can be below 0: then the square root
    of the noise is none, and a code that is not a number would be looked up beside its table."""
    exposure = exposure_of(bits=bits, full_well_e=23000.0, read_noise_e=12.0, black_grey=9.0)
    dark, taken = flat(0.0), replace(flat(0.0), bounced=np.full((52, PIXELS.size), -13.0, np.float32))
    frames = [exposure.expose([WHITE], lit, PIXELS, (1, "flat"))[0] for lit in (dark, taken)]
    assert (frames[0] == frames[1]).all() and frames[0].mean() == pytest.approx(9, abs=0.1)
    lit = replace(flat(0.0, 3), ambient=np.full(3, 20, np.float32), bounced=np.full((52, 3), -13, np.float32))
    assert (exposure.radiance([WHITE], lit, (1, "flat"), np.empty((1, 3), np.float32)) == 7).all()


# ---- flicker


def test_flicker_is_one_factor_a_frame_and_normal():
    exposure = exposure_of(projector={"flicker": 0.02})
    assert exposure_of().flicker == 0
    lamps = []
    for view in range(40):
        lit = replace(
            flat(2e3, 3), ambient=np.full(3, 7.0, dtype=np.float32), bounced=np.full((52, 3), 1e3, np.float32)
        )
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
    """Random projector coordinates, gains, ambient and bounced light of n points (211 x 173: no round numbers)."""
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
        index, weight = (p.u_index, p.u_weight) if exposure.pattern.along[frame] == ALONG_U else (p.v_index, p.v_weight)
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
                f(exposure.flicker) * standard_normal(np.zeros(1, np.uint32), stream_keys(*stream, "lamp", frame))[0]
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
        np.testing.assert_array_equal(read, in_numpy(exposure, FRAMES, part, pixels, (42, "mug", "A0")))


@pytest.mark.parametrize("name", ["paper", "hard"])
def test_light_and_sensor_one_after_the_other_give_the_same_bytes(name):
    """`radiance` and then `sense`, as with a blurring lens between, is `expose`."""
    exposure = exposure_under(name)
    _, _, lit = randomly_lit(exposure, LIGHTS[name])
    for samples in (1, 4):
        pixels = np.arange(5000, dtype=np.uint32)
        part = subset(lit, np.arange(5000 * samples))
        whole = exposure.expose(FRAMES, part, pixels, (1, "mug", "A0"))
        light_grey = exposure.radiance(FRAMES, part, (1, "mug", "A0"), np.empty(whole.shape, np.float32))
        sensed = exposure.sense(FRAMES, light_grey, pixels, (1, "mug", "A0"), np.empty_like(whole))
        np.testing.assert_array_equal(sensed, whole)


@pytest.mark.parametrize("name", ["paper", "hard"])
def test_a_subset_of_pixels_reads_the_bytes_of_the_whole_frame(name):
    exposure = exposure_under(name)
    _, _, lit = randomly_lit(exposure, LIGHTS[name])
    pixels = np.arange(lit.gain.size, dtype=np.uint32)
    chosen = np.flatnonzero(np.random.default_rng(0).random(pixels.size) < 0.1)
    frames, stream = [0, 3, 10, 21], (1, "mug", "A0")
    out = np.empty((4, pixels.size), np.uint8)
    full = exposure.expose(frames, lit, pixels, stream, out)
    assert full is out
    for some in (chosen, chosen[::-1].copy(), chosen[:0]):
        exposed = exposure.expose(frames, subset(lit, some), some.astype(np.uint32), stream)
        np.testing.assert_array_equal(exposed, full[:, some])
    # The other frames of a call make no difference either.
    for row, frame in enumerate(frames):
        np.testing.assert_array_equal(exposure.expose([frame], lit, pixels, stream)[0], full[row])


@pytest.mark.parametrize("index", [0, 5, 18, 30, 42, 49, 50, 51])
def test_pattern_lookup_is_opencv_remap_of_the_pattern_image(index):
    """Bilinear lookup against cv2.remap on the projected image itself: OpenCV rounds weights to 1/32 px."""
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
    # Half a grey level of rounding, a weight wrong by up to 1/64 px on the steepest flank, and 0.01 grey levels for
    # OpenCV's float32 coordinates: 3e-5 px at 941 px, times 255 grey levels per px.
    tolerance = 0.5 + steepest / 64 * lit.gain.max() / 255 + 0.01
    assert np.abs(read - expected).max() <= tolerance
    assert np.abs(read - expected).mean() < 0.3
