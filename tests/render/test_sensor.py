"""The sensor's noise: is it normal, independent, of the right size, and the same bytes on both code paths?

Seeds are fixed, so every p-value below is a constant of this code. With these thresholds a good generator passes for
nearly any seed and a poor generator fails. References: scipy.stats and NumPy's generator.
"""

import cv2
import numpy as np
import pytest
from scipy import stats

from fpp_ml_bench.loaders.render.illumination import LitPixels, PatternLookup
from fpp_ml_bench.loaders.render.scene import uniform
from fpp_ml_bench.loaders.render.sensor import (
    Exposure,
    Noise,
    hash_pixels,
    normal_table,
    quantise,
    standard_normal,
    stream_keys,
)
from fpp_ml_bench.machine import NUMBA_SWITCH as SWITCH
from fpp_ml_bench.optics import paper_rig, pattern_image

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
    uniform_sum = np.random.default_rng(1).random((4, PIXELS.size)).sum(axis=0)
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


@pytest.mark.parametrize("seed", [0, 1, 2**40])
def test_hash_is_a_bijection_of_the_pixel_number(seed):
    keys = stream_keys(seed, "anything")
    sample = np.concatenate([PIXELS, np.arange(2**32 - 500_000, 2**32, dtype=np.uint32)])
    hashes = hash_pixels(sample, keys)
    assert np.unique(hashes).size == sample.size
    # Each of the 32 bits is set for half of the pixels, and a changed input bit flips each output bit half of the time.
    for bit in range(32):
        share = float(((hashes >> np.uint32(bit)) & 1).mean())
        assert share == pytest.approx(0.5, abs=0.004)
    for bit in (0, 7, 19):
        flipped = hashes[: PIXELS.size] ^ hash_pixels(PIXELS ^ np.uint32(1 << bit), keys)
        shares = [float(((flipped >> np.uint32(k)) & 1).mean()) for k in range(24)]
        assert min(shares) > 0.4 and max(shares) < 0.6


def test_uniform_is_uniform():
    draws = np.array([uniform(42, "mug", i) for i in range(5000)])
    assert stats.kstest(draws, "uniform").pvalue > 1e-3
    assert draws.min() >= 0 and draws.max() < 1


@pytest.mark.parametrize("sigma", [0.5, 1.0, 3.0])
def test_variance_is_read_noise_plus_shot_noise_linear_in_the_signal(sigma):
    noise = Noise.of_sigma(sigma)
    for level in (20.0, 60.0, 127.5, 200.0):
        signal = np.full(PIXELS.size, level, dtype=np.float32)
        # Subtracted dither of one grey level makes quantisation an independent error of variance 1/12 (Schuchman 1964).
        dither = np.random.default_rng(int(level)).random(PIXELS.size).astype(np.float32) - np.float32(0.5)
        read = quantise(signal + dither, PIXELS, stream_keys(3, level), noise).astype(np.float64) - dither
        expected = sigma**2 / 2 + sigma**2 / 2 * level / 127.5
        assert read.mean() == pytest.approx(level, abs=5 * np.sqrt(expected + 0.1) / SIZE)
        assert read.var() == pytest.approx(expected + 1 / 12, rel=0.01)


def test_sigma_is_that_of_mid_grey():
    noise = Noise.of_sigma(2.0)
    assert noise.read_variance + noise.shot_per_grey * 127.5 == pytest.approx(4.0)
    assert noise.read_variance == pytest.approx(2.0)


def test_quantisation_is_unbiased_and_clips_at_the_ends():
    silent, keys = Noise.of_sigma(0), stream_keys(1)
    signal = np.linspace(0, 255, PIXELS.size, dtype=np.float32)
    read = quantise(signal, PIXELS, keys, silent)
    np.testing.assert_array_equal(read, np.floor(signal.astype(np.float64) + 0.5).clip(0, 255))
    assert abs((read - signal.astype(np.float64)).mean()) < 1e-3
    noise = Noise.of_sigma(2.0)
    for level, end in ((0.0, 0), (255.0, 255), (400.0, 255)):
        read = quantise(np.full(PIXELS.size, level, dtype=np.float32), PIXELS, keys, noise)
        assert abs(int(read.min() if end else read.max()) - end) <= 12
        assert (read == end).mean() > 0.5
        assert read.dtype == np.uint8


def test_sigma_zero_gives_no_noise():
    signal = np.full(1000, 99.0, dtype=np.float32)
    for frame in range(3):
        read = quantise(signal, PIXELS[:1000], stream_keys(1, frame), Noise.of_sigma(0))
        assert (read == 99).all()


# ---- exposing frames: the compiled kernel compared with NumPy, and both with OpenCV


@pytest.fixture(scope="module")
def scene():
    """Random projector coordinates, gains and ambient light for an image of 211 x 173 px (no round numbers)."""
    rng = np.random.default_rng(5)
    rig, n = paper_rig(176), 211 * 173
    u, v = rng.uniform(-30, 941, n), rng.uniform(-30, 1169, n)
    lookup = {"vertical": PatternLookup.of(u, 912), "horizontal": PatternLookup.of(v, 1140)}
    gain = np.where(rng.random(n) < 0.2, 0, rng.uniform(0, 260, n)).astype(np.float32)
    ambient = rng.uniform(0, 20, n).astype(np.float32)
    return rig, u, v, LitPixels(lookup, gain, ambient)


def subset(lit, indices):
    lookup = {d: PatternLookup(p.index[indices], p.weight[indices]) for d, p in lit.lookup.items()}
    return LitPixels(lookup, lit.gain[indices], lit.ambient[indices])


@pytest.mark.parametrize("sigma", [0.0, 1.0, 6.0])
@pytest.mark.parametrize("seed", [0, 42, 123456789])
def test_kernel_and_numpy_give_the_same_bytes(scene, monkeypatch, sigma, seed):
    rig, _, _, lit = scene
    exposure = Exposure.of(rig, Noise.of_sigma(sigma))
    n = lit.gain.size
    all_pixels = np.arange(n, dtype=np.uint32)
    shifted = all_pixels + np.uint32(100_000)  # contiguous, but not from pixel 0
    scattered = np.flatnonzero(np.random.default_rng(seed).random(n) < 0.3)
    cases = [(all_pixels, lit), (shifted, lit), (scattered.astype(np.uint32), subset(lit, scattered))]
    for pixels, lit_pixels in cases:
        read = {}
        for switch in ("0", "1"):
            monkeypatch.setenv(SWITCH, switch)
            read[switch] = exposure.expose((0, 17, 18, 36, 45, 50, 51), lit_pixels, pixels, (seed, "mug", "A0"))
        np.testing.assert_array_equal(read["0"], read["1"])


@pytest.mark.parametrize("switch", ["0", "1"])
def test_a_subset_of_pixels_reads_the_bytes_of_the_whole_frame(scene, monkeypatch, switch):
    monkeypatch.setenv(SWITCH, switch)
    rig, _, _, lit = scene
    exposure = Exposure.of(rig, Noise.of_sigma(2.0))
    pixels = np.arange(lit.gain.size, dtype=np.uint32)
    subset_pixels = np.flatnonzero(np.random.default_rng(0).random(pixels.size) < 0.1)
    frames = [0, 20, 40, 51]
    out = np.empty((4, pixels.size), np.uint8)
    full = exposure.expose(frames, lit, pixels, (1, "mug", "A0"), out)
    assert full is out
    exposed = exposure.expose(frames, subset(lit, subset_pixels), subset_pixels.astype(np.uint32), (1, "mug", "A0"))
    np.testing.assert_array_equal(exposed, full[:, subset_pixels])
    backwards = subset_pixels[::-1].copy()
    exposed = exposure.expose(frames, subset(lit, backwards), backwards.astype(np.uint32), (1, "mug", "A0"))
    np.testing.assert_array_equal(exposed, full[:, backwards])
    # The other frames of a call make no difference either.
    for row, frame in enumerate(frames):
        np.testing.assert_array_equal(exposure.expose([frame], lit, pixels, (1, "mug", "A0"))[0], full[row])
    empty = exposure.expose(
        frames, subset(lit, subset_pixels[:0]), subset_pixels[:0].astype(np.uint32), (1, "mug", "A0")
    )
    assert empty.shape == (4, 0)


@pytest.mark.parametrize("switch", ["0", "1"])
@pytest.mark.parametrize("index", [0, 5, 18, 30, 42, 49, 50, 51])
def test_pattern_lookup_is_opencv_remap_of_the_pattern_image(scene, monkeypatch, switch, index):
    """Bilinear lookup against cv2.remap on the projected image itself: OpenCV rounds weights to 1/32 px."""
    monkeypatch.setenv(SWITCH, switch)
    rig, u, v, lit = scene
    exposure = Exposure.of(rig, Noise.of_sigma(0))
    (read,) = exposure.expose([index], lit, np.arange(u.size, dtype=np.uint32), (1, "mug", "A0"))
    image = np.ascontiguousarray(pattern_image(rig, index)).astype(np.float32)
    size = (211, 173)
    light = cv2.remap(
        image, u.reshape(size).astype(np.float32), v.reshape(size).astype(np.float32), cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    ).ravel()  # fmt: skip
    expected = np.clip(lit.ambient + lit.gain * (light / 255), 0, 255)
    steepest = np.abs(np.diff(image, axis=0)).max() + np.abs(np.diff(image, axis=1)).max()
    # Half a grey level of rounding, a weight wrong by up to 1/64 px on the steepest flank, and 0.01 grey levels for
    # OpenCV's float32 coordinates: 3e-5 px at 941 px, times 255 grey levels per px.
    tolerance = 0.5 + steepest / 64 * lit.gain.max() / 255 + 0.01
    assert np.abs(read - expected).max() <= tolerance
    assert np.abs(read - expected).mean() < 0.3


def test_lookup_outside_the_pattern_reads_its_rim():
    lookup = PatternLookup.of(np.array([-5.0, 0.0, 0.25, 910.5, 911.0, 2000.0, np.nan]), 912)
    position = lookup.index + lookup.weight
    np.testing.assert_allclose(position, [0, 0, 0.25, 910.5, 911, 911, 0], atol=1e-6)
    assert (lookup.index <= 910).all() and lookup.index.dtype == np.uint16
