"""Captured images: what is read, in which order and scale, and what is refused."""

import io

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from fpp_ml_bench.errors import CaptureError
from fpp_ml_bench.loaders.captures.images import frame_files, read_frames

RNG = np.random.default_rng(1)
GREY = RNG.integers(0, 256, (3, 30, 41), np.uint8)
DEEP = RNG.integers(0, 65536, (2, 30, 41), np.uint16)
COLOUR = RNG.integers(0, 256, (30, 41, 3), np.uint8)  # blue, green, red, as OpenCV writes them


def put(folder, *images, suffix=".png", name="frame_{}"):
    files = []
    for index, image in enumerate(images):
        files.append(folder / (name.format(index) + suffix))
        assert cv2.imwrite(str(files[-1]), image)
    return files


def put_at(file):
    file.parent.mkdir(parents=True, exist_ok=True)
    put(file.parent, GREY[0], name=file.stem)


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tif", ".TIFF", ".PNG"])
def test_grey_levels_come_out_as_written(tmp_path, suffix):
    files = put(tmp_path, *GREY, suffix=suffix)
    read = read_frames(tmp_path, count=3)
    assert read.frames.dtype == np.uint8 and np.array_equal(read.frames, GREY)
    assert (read.files, read.full_scale, read.note) == (tuple(files), 255, "")


def test_a_folder_a_pattern_a_file_and_a_list(tmp_path):
    files = put(tmp_path, *GREY)
    (tmp_path / "notes.txt").write_text("12 frames")
    (tmp_path / ".frame_9.png").write_text("hidden")
    put(tmp_path, GREY[0, :10], name="preview")
    with pytest.raises(
        CaptureError,
        match=r"preview\.png: expected 41 x 30 px of 8 bits as in frame_0.png, found 41 x 10",
    ):
        read_frames(tmp_path)
    assert np.array_equal(read_frames(tmp_path / "frame_*").frames, GREY)
    assert np.array_equal(read_frames(str(tmp_path / "frame_?.png")).frames, GREY)
    assert np.array_equal(read_frames(files[1]).frames, GREY[1:2])
    assert np.array_equal(read_frames([files[2], str(files[0])]).frames, GREY[[2, 0]])


def test_natural_order(tmp_path):
    names = ["frame_1.png", "frame_2.png", "Frame_10.png", "frame_10b.png", "frame_11.png"]
    for name in reversed(names):
        put(tmp_path, GREY[0], name=name.removesuffix(".png"))
    assert [file.name for file in frame_files(tmp_path)] == names


@pytest.mark.parametrize(
    ("stored", "bits", "full_scale", "note"),
    [
        (DEEP, None, 65535, "no level is above 65535: taken as 16 bits"),
        (DEEP >> 4, None, 4095, "no level is above 4095: taken as 12 bits"),
        (
            DEEP >> 4 << 4,
            None,
            65520,
            "all levels are multiples of 16: taken as 12 bits, shifted up by 4",
        ),
        (DEEP >> 4, 12, 4095, ""),
        (DEEP >> 4 << 4, 12, 65520, ""),
        (DEEP >> 8, 12, 4095, ""),
        (DEEP >> 8, 8, 255, ""),
        (DEEP * 0, None, 255, "no level is above 255: taken as 8 bits"),
    ],
)
def test_more_than_eight_bits(tmp_path, stored, bits, full_scale, note):
    put(tmp_path, *stored)
    read = read_frames(tmp_path, bits=bits)
    assert read.frames.dtype == np.float32 and (read.full_scale, read.note) == (full_scale, note)
    np.testing.assert_allclose(read.frames, stored * (255 / full_scale), rtol=1e-7)
    assert (read.frames[stored == full_scale] == 255).all()


@pytest.mark.parametrize("orientation", range(1, 9))
def test_images_are_upright_by_their_orientation(tmp_path, orientation):
    for number, image in enumerate((GREY[0], COLOUR, DEEP[0])):
        marked = Image.fromarray(image)
        marked.getexif()[274] = orientation
        upright = np.asarray(ImageOps.exif_transpose(marked))
        if orientation in (3, 6):  # by definition
            assert np.array_equal(upright, np.rot90(image, 2 if orientation == 3 else -1))
        for suffix in (".png", ".tif"):
            file = tmp_path / f"{number}{suffix}"
            marked.save(file, exif=marked.getexif())
            read = read_frames(file, colour="green").frames[0]
            expected = (
                upright[..., 1] if image is COLOUR else upright * (255 / np.iinfo(image.dtype).max)
            )
            np.testing.assert_allclose(read, expected, rtol=1e-7)


def test_equal_channels_and_opaque_alpha_are_grey(tmp_path):
    opaque = np.full_like(GREY[0], 255)
    put(tmp_path, np.dstack([GREY[0]] * 3), np.dstack([GREY[1]] * 3 + [opaque]), GREY[2])
    Image.fromarray(np.dstack([GREY[0], opaque]), "LA").save(tmp_path / "frame_3.png")
    read = read_frames(tmp_path)
    assert read.frames.dtype == np.uint8 and np.array_equal(read.frames, GREY[[0, 1, 2, 0]])
    put(tmp_path, *[np.dstack([deep] * 3) for deep in DEEP], name="deep_{}")
    np.testing.assert_allclose(
        read_frames(tmp_path / "deep_*").frames, DEEP * (255 / 65535), rtol=1e-7
    )


def test_colour_is_turned_to_grey_where_it_is_said_how(tmp_path):
    put(tmp_path, COLOUR)
    for channel, colour in enumerate(("blue", "green", "red")):
        read = read_frames(tmp_path, colour=colour).frames
        assert read.dtype == np.uint8 and np.array_equal(read[0], COLOUR[..., channel])
    np.testing.assert_allclose(
        read_frames(tmp_path, colour="mean").frames[0], COLOUR.mean(-1), rtol=1e-6
    )
    expected = cv2.cvtColor(COLOUR.astype(np.float32), cv2.COLOR_BGR2GRAY)
    np.testing.assert_allclose(
        read_frames(tmp_path, colour="luminance").frames[0], expected, rtol=1e-4
    )


def test_colour_of_sixteen_bits(tmp_path):
    deep = RNG.integers(0, 65536, (30, 41, 3), np.uint16)
    for suffix in (".png", ".tif"):
        put(tmp_path, deep, suffix=suffix)
        read = read_frames(tmp_path / f"*{suffix}", colour="green")
        np.testing.assert_allclose(read.frames[0], deep[..., 1] * (255 / 65535), rtol=1e-7)


def _bytes(image, suffix=".png"):
    return cv2.imencode(suffix, image)[1].tobytes()


def _saved(image, form, **options):
    buffer = io.BytesIO()
    image.save(buffer, form, **options)
    return buffer.getvalue()


def _flipped(content, place):
    return content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]


PNG, BMP, TIF = (_bytes(GREY[0], suffix) for suffix in (".png", ".bmp", ".tif"))
PIL = Image.fromarray(GREY[0])
CLEAR = np.dstack([GREY[0], GREY[0], GREY[0], np.full_like(GREY[0], 254)])
PALETTE = PIL.convert("P")
PALETTE.info["transparency"] = 3


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.png", b"", "found a file of 0 bytes"),
        ("a.png", b"no image at all", "expected a PNG, BMP or TIFF image.*of another form"),
        ("a.png", PNG[:-12], "the PNG is cut off"),
        ("a.png", PNG[:-1], "the PNG is cut off"),
        ("a.png", PNG[:20], "cut off, damaged"),
        ("a.png", _flipped(PNG, len(PNG) // 2), "the PNG is damaged, a checksum"),
        ("a.bmp", BMP[:-1], f"the BMP is cut off: expected {len(BMP)} bytes, found {len(BMP) - 1}"),
        ("a.tif", TIF[: len(TIF) // 2], "cut off, damaged"),
        ("a.tif", _saved(PIL, "TIFF")[:-40], "cut off, damaged"),
        ("a.tif", _saved(PIL, "TIFF", compression="jpeg"), "compressed with loss"),
        ("a.jpg", _bytes(GREY[0], ".jpg"), "compressed with loss"),
        ("a.png", _bytes(GREY[0], ".jpg"), "compressed with loss"),
        ("a.webp", b"RIFF", "found a .webp file; convert it without loss"),
        (
            "a.png",
            _bytes(COLOUR),
            "the colour channels differ; say which to take by colour .luminance, red",
        ),
        ("a.png", _bytes(CLEAR), "transparent pixels"),
        ("a.png", _bytes(CLEAR.astype(np.uint16) * 257), "transparent pixels"),
        ("a.png", _saved(PALETTE, "PNG"), "transparent pixels"),
        ("a.png", _saved(PIL.convert("1"), "PNG"), "8 to 16 bits, found mode 1 of 1 bits"),
        ("a.tif", _saved(PIL.convert("F"), "TIFF"), "found mode F of 32 bits"),
        ("a.tif", _saved(PIL.convert("CMYK"), "TIFF"), "found mode CMYK"),
        (
            "a.tif",
            _saved(PIL, "TIFF", save_all=True, append_images=[PIL]),
            "expected one image, found 2",
        ),
        (
            "a.png",
            _saved(PIL, "PNG", save_all=True, append_images=[PIL.rotate(9)]),
            "expected one image, found 2",
        ),
        ("a.tif", _saved(Image.fromarray(DEEP[0]), "TIFF", tiffinfo={262: 0}), "white as 0"),
    ],
)
def test_images_that_are_no_frames_are_refused(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(CaptureError, match=message) as caught:
        read_frames(tmp_path)
    assert str(caught.value).startswith(str(tmp_path / name)) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("images", "options", "message"),
    [
        ((*GREY,), {"count": 4}, "expected 4 frames, found 3 .frame_0.png to frame_2.png"),
        (
            (GREY[0], GREY[1, :, :20]),
            {},
            "frame_1.png: expected 41 x 30 px of 8 bits as in frame_0.png, found 20 x 30",
        ),
        (
            (GREY[0], DEEP[0]),
            {},
            "frame_1.png: expected 41 x 30 px of 8 bits.*found 41 x 30 px of 16 bits",
        ),
        ((*DEEP,), {"bits": 12}, "expected levels of 12 bits, 0 to 4095 or multiples of 16"),
        ((*GREY,), {"bits": 12}, "expected levels of 12 bits, found images of 8 bits"),
        ((*GREY,), {"bits": 17}, "bits: expected a whole number from 8 to 16, got 17"),
        ((*GREY,), {"bits": True}, "bits: expected a whole number"),
        (
            (*GREY,),
            {"colour": "grey"},
            "colour: expected luminance, red, green, blue, mean, got 'grey'",
        ),
    ],
)
def test_captures_that_do_not_fit_are_refused(tmp_path, images, options, message):
    put(tmp_path, *images)
    with pytest.raises(CaptureError, match=message) as caught:
        read_frames(tmp_path, **options)
    assert "\n" not in str(caught.value)


def test_sources_without_frames_are_refused(tmp_path):
    for source, message in (
        (tmp_path, "expected a folder with images .* found none"),
        (tmp_path / "absent", "expected a folder, an image or a pattern"),
        (tmp_path / "*.png", "no file matches"),
        ([], "got an empty one"),
        (
            [tmp_path / "absent.png"],
            "absent.png: expected a PNG, BMP or TIFF image, found nothing there",
        ),
        ([tmp_path], "found a folder"),
    ):
        with pytest.raises(CaptureError, match=message):
            read_frames(source)


def test_names_without_an_order_are_refused(tmp_path):
    for names in (("frame_1.png", "frame_01.png"), ("frame_1.png", "frame_1.bmp")):
        folder = tmp_path / names[1]
        folder.mkdir()
        for name in names:
            assert cv2.imwrite(str(folder / name), GREY[0])
        with pytest.raises(
            CaptureError, match="the same name or number, so the frames have no order"
        ):
            read_frames(folder)


def test_damaged_files_are_read_or_refused_and_nothing_else(tmp_path):
    """Random damage to images without checksums, which it may leave readable."""
    for content, suffix in (
        (BMP, ".bmp"),
        (TIF, ".tif"),
        (_saved(PIL, "TIFF"), ".tif"),
        (PNG, ".png"),
    ):
        for _ in range(60):
            damaged = bytearray(content)
            for place in RNG.integers(0, min(len(content), 300), 3):
                damaged[place] = RNG.integers(0, 256)
            file = tmp_path / f"a{suffix}"
            file.write_bytes(damaged)
            try:
                read = read_frames(file)
            except CaptureError:
                continue
            assert read.frames.ndim == 3


def test_a_pattern_goes_across_folders(tmp_path):
    for name in (
        "scan/2_gray/f_2.png",
        "scan/10_white/f_1.png",
        "scan/1_sine/f_10.png",
        "scan/1_sine/f_9.png",
    ):
        put_at(tmp_path / name)
    put_at(tmp_path / "scan/.thumbs/f_1.png")
    expected = ["1_sine/f_9.png", "1_sine/f_10.png", "2_gray/f_2.png", "10_white/f_1.png"]
    for pattern in ("scan/*/*.png", "scan/**/*.png", "sc*/*/f_*"):
        found = [
            str(file.relative_to(tmp_path / "scan")) for file in frame_files(tmp_path / pattern)
        ]
        assert found == expected, pattern
    with pytest.raises(
        CaptureError, match=r"no file matches .* has to match files, as 'scan/\*/\*.png'"
    ):
        frame_files(tmp_path / "scan/*")
    with pytest.raises(
        CaptureError, match=r"found none; .* such as .*1_sine, or a pattern .* '.*scan/\*/\*.png'"
    ):
        frame_files(tmp_path / "scan")
    put_at(tmp_path / "part [1]/f_1.png")
    assert len(frame_files(tmp_path / "part [1]/f_*.png")) == 1  # the brackets are a name
