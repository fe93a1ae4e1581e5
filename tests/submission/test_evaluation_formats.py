"""Every accepted form of prediction gives the same numbers, and every broken file is refused by
name, with advice."""

import io
import os
import re
import struct
import zipfile
import zlib
from contextlib import redirect_stdout
from functools import partial
from io import StringIO

import cv2
import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from conftest import fpp_eval, read_json, refusal
from scipy.io import savemat
from scored_dataset import write_description, write_predictions

from fpp_ml_bench import containers
from fpp_ml_bench.errors import PredictionError

SIZE = (32, 40)
SAMPLE = "power_drill_A60"
LEVEL_MM = 0.05
ORACLE = {"uses_ground_truth_range": True}
NESTED_DOUBLE = pa.list_(pa.list_(pa.float64()))
NESTED, FLAT = pa.list_(pa.list_(pa.float32())), pa.list_(pa.float32())


def maps(dataset, step_mm=LEVEL_MM):
    """Depth in whole steps of 1/20 mm, which the coarsest form, PNG, can store."""
    depths = {}
    for number, sample in enumerate(dataset.samples("test")):
        noise = np.random.default_rng(number).normal(0, 2, SIZE)
        depths[sample] = np.round(np.abs(dataset.depth_mm(sample) + noise) / step_mm) * step_mm
    return depths


def npz_bytes(**arrays):
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def zip_bytes(members, compression=zipfile.ZIP_DEFLATED):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def npy_bytes(array):
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=array.dtype.hasobject)
    return buffer.getvalue()


def mat5_bytes(compress=True, **arrays):
    buffer = io.BytesIO()
    savemat(buffer, arrays, do_compression=compress)
    return buffer.getvalue()


def mat73_bytes(fill):
    """A v7.3 file: HDF5 behind MATLAB's 512-byte block."""
    buffer = io.BytesIO()
    with h5py.File(buffer, "w", userblock_size=512) as file:
        fill(file)
    content = bytearray(buffer.getvalue())
    content[:128] = (
        b"MATLAB 7.3 MAT-file".ljust(116) + b"\0" * 8 + struct.pack("<H", 0x0200) + b"IM"
    )
    return bytes(content)


def png_bytes(image):
    return cv2.imencode(".png", image)[1].tobytes()


def png_of(depth):
    return png_bytes(np.round(depth / LEVEL_MM).astype(np.uint16))


def npz_of(depth):
    return npz_bytes(depth=depth)


def mat_of(depth):
    return mat5_bytes(depth=depth)


def table(depths, kind=NESTED):
    nested = kind in (NESTED,) or pa.types.is_list(getattr(kind, "value_type", pa.float32()))
    rows = [(d if nested else d.ravel()).tolist() for d in depths.values()]
    return pa.table({"sample": list(depths), "depth": pa.array(rows, kind)})


def parquet_bytes(content, **options):
    buffer = io.BytesIO()
    pq.write_table(content, buffer, **options)
    return buffer.getvalue()


def arrow_bytes(content, opener=pa.ipc.new_file, **options):
    buffer = io.BytesIO()
    with opener(buffer, content.schema, options=pa.ipc.IpcWriteOptions(**options)) as stream:
        stream.write_table(content, max_chunksize=3)
    return buffer.getvalue()


def write_each(folder, suffix, depths, encode, **changes):
    folder.mkdir(parents=True, exist_ok=True)
    for sample, depth in depths.items():
        (folder / f"{sample}{suffix}").write_bytes(encode(depth))
    write_description(folder, **changes)
    return folder


def write_table(folder, name, content, **changes):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_bytes(content)
    write_description(folder, **changes)
    return folder


FORMS = {
    "npz": lambda f, m: write_each(f, ".npz", m, npz_of),
    "npz stored": lambda f, m: write_each(
        f, ".npz", m, lambda d: zip_bytes({"d.npy": npy_bytes(d)}, zipfile.ZIP_STORED)
    ),
    "mat v5": lambda f, m: write_each(f, ".mat", m, mat_of),
    "mat v5 plain": lambda f, m: write_each(f, ".mat", m, lambda d: mat5_bytes(False, depth=d)),
    "mat v7.3 deflated": lambda f, m: write_each(
        f,
        ".mat",
        m,
        lambda d: mat73_bytes(lambda h: h.create_dataset("depth", data=d.T, compression="gzip")),
    ),
    "png": lambda f, m: write_each(f, ".png", m, png_of, png_mm_per_level=LEVEL_MM),
    "parquet": lambda f, m: write_table(
        f, "predictions.parquet", parquet_bytes(table(m, NESTED_DOUBLE))
    ),
    "parquet flat zstd": lambda f, m: write_table(
        f,
        "predictions.parquet",
        parquet_bytes(table(m, pa.list_(pa.float64())), compression="zstd", row_group_size=1),
    ),
    "arrow file": lambda f, m: write_table(
        f, "predictions.arrow", arrow_bytes(table(m, NESTED_DOUBLE), compression="zstd")
    ),
    "arrow stream": lambda f, m: write_table(
        f,
        "predictions.arrow",
        arrow_bytes(table(m, pa.list_(pa.float64(), 1280)), pa.ipc.new_stream),
    ),
}


@pytest.mark.parametrize("form", FORMS)
def test_every_form_gives_the_same_numbers(form, dataset, tmp_path):
    depths = maps(dataset)
    plain = write_each(tmp_path / "npy", ".npy", depths, npy_bytes)
    converted = FORMS[form](tmp_path / "converted", depths)
    results = []
    for number, folder in enumerate((plain, converted)):
        path = tmp_path / f"{number}.json"
        assert fpp_eval(folder, dataset.path, "--json", path) == 0
        results.append(read_json(path))
    plain_metrics, metrics = (result["metrics"] for result in results)
    for key, value in plain_metrics.items():
        exact = (
            value if value is None or form != "png" else pytest.approx(value, rel=1e-9, abs=1e-9)
        )
        assert metrics[key] == exact, key
    hashes = {row["prediction_sha256"] for row in results[1]["per_sample"]}
    assert len(hashes) == (1 if "arrow" in form or "parquet" in form else 4)


def refused(dataset, folder):
    with redirect_stdout(StringIO()) as out:
        error = refusal(fpp_eval, folder, dataset.path)
    assert out.getvalue() == "" and "Traceback" not in error
    return error


ZEROS = np.zeros((1000, 1000))
DEPTH = np.full(SIZE, 1800.0)


def zip_of_wrong_size():
    """A member that says it is small and unpacks to 8 MB."""
    content = bytearray(zip_bytes({"depth.npy": npy_bytes(ZEROS)}))
    true = struct.pack("<I", len(npy_bytes(ZEROS)))
    while (place := content.find(true)) >= 0:
        content[place : place + 4] = struct.pack("<I", 5000)
    return bytes(content)


def linked(h):
    h.create_dataset("other", data=DEPTH.T)
    h["depth"] = h5py.SoftLink("/other")


def external(h):
    h["depth"] = h5py.ExternalLink("/etc/passwd", "/depth")


def stored_elsewhere(h):
    h.create_dataset("depth", SIZE[::-1], "f8", external=[("/etc/passwd", 0, h5py.h5f.UNLIMITED)])


def virtual(h):
    layout = h5py.VirtualLayout(SIZE[::-1], "f8")
    layout[:] = h5py.VirtualSource("/etc/passwd", "depth", SIZE[::-1])
    h.create_virtual_dataset("depth", layout)


def huge_chunk(h):
    h.create_dataset(
        "depth", SIZE[::-1], "f8", maxshape=(None, None), chunks=(20000, 20000), compression="gzip"
    )


PNG = png_of(DEPTH)


def longer_png(content):
    """The same image with pixels that unpack to 50 MB: only the IDAT chunk is replaced, its
    checksum made anew."""
    data = zlib.compress(b"\0" * 50_000_000)
    chunk = b"IDAT" + data
    head = content[:33]
    return (
        head
        + struct.pack(">I", len(data))
        + chunk
        + struct.pack(">I", zlib.crc32(chunk))
        + content[-12:]
    )


NOISE = npz_bytes(a=np.random.default_rng(0).random(SIZE))
PER_SAMPLE = {
    "npz of two": (
        ".npz",
        npz_bytes(a=DEPTH, b=DEPTH),
        r"holds 2 arrays \(a.npy, b.npy\), expected one",
    ),
    "npz of none": (".npz", zip_bytes({}), "holds 0 arrays"),
    "npz bomb": (
        ".npz",
        zip_bytes({"depth.npy": npy_bytes(ZEROS)}),
        "would unpack to 8000128 bytes",
    ),
    "npz of a wrong size": (
        ".npz",
        zip_of_wrong_size(),
        "unpacks to more than|is no .npz|is truncated|foreign",
    ),
    "npz path": (".npz", zip_bytes({"../depth.npy": npy_bytes(DEPTH)}), "leads out of the archive"),
    "npz of text": (".npz", zip_bytes({"readme.txt": b"x"}), "expected one .npy array"),
    "npz of bz2": (
        ".npz",
        zip_bytes({"d.npy": npy_bytes(DEPTH)}, zipfile.ZIP_BZIP2),
        "unusual way",
    ),
    "npz cut off": (".npz", npz_bytes(a=DEPTH)[:-30], "is no .npz archive, or damaged"),
    "npz damaged": (".npz", NOISE[:300] + b"xxxx" + NOISE[304:], "damaged"),
    "npz of objects": (
        ".npz",
        zip_bytes({"d.npy": npy_bytes(np.array([[{}]], object))}),
        "pickled Python objects",
    ),
    "npz integers": (
        ".npz",
        npz_bytes(a=DEPTH.astype(np.uint8)),
        "got uint8: whole numbers .*wrap around",
    ),
    "npz shape": (".npz", npz_bytes(a=DEPTH.T), r"expected shape \(32, 40\) .*got \(40, 32\)"),
    "mat name": (".mat", mat5_bytes(z=DEPTH), "expected the variable depth, got z"),
    "mat integers": (".mat", mat5_bytes(depth=DEPTH.astype(np.int16)), "got int16"),
    "mat complex": (".mat", mat5_bytes(depth=DEPTH + 1j), "complex"),
    "mat cell": (
        ".mat",
        mat5_bytes(depth=np.array([["a", 1]], object)),
        "expected a real numeric matrix",
    ),
    "mat bomb": (".mat", mat5_bytes(depth=ZEROS), "too large"),
    "mat cut off": (".mat", mat5_bytes(depth=DEPTH)[:-20], "cut off|damaged"),
    "mat noise": (".mat", bytes(range(256)) * 4, "neither"),
    "mat v7.3 link": (".mat", mat73_bytes(linked), "depth is a link"),
    "mat v7.3 other file": (
        ".mat",
        mat73_bytes(external),
        "depth is a link|expected the variable depth",
    ),
    "mat v7.3 external": (".mat", mat73_bytes(stored_elsewhere), "stored in other files"),
    "mat v7.3 virtual": (".mat", mat73_bytes(virtual), "stored in other files"),
    "mat v7.3 chunk": (".mat", mat73_bytes(huge_chunk), "too large for a depth map"),
    "mat v7.3 cut off": (
        ".mat",
        mat73_bytes(lambda h: h.create_dataset("depth", data=DEPTH.T))[:900],
        "can't be read",
    ),
    "png 8 bit": (".png", png_bytes(np.zeros(SIZE, np.uint8)), "has 8 bits per channel"),
    "png colour": (".png", png_bytes(np.zeros((*SIZE, 3), np.uint16)), "colour type 2"),
    "png shape": (".png", png_bytes(np.zeros((40, 32), np.uint16)), r"got \(40, 32\)"),
    "png full": (
        ".png",
        png_bytes(np.full(SIZE, 65535, np.uint16)),
        "where depth above 3276.75 mm is cut off",
    ),
    "png bomb": (".png", longer_png(PNG), "unpacks to more than 2592 bytes"),
    "png checksum": (".png", PNG[:60] + b"\0\0\0\0" + PNG[64:], "a checksum does not match"),
    "png cut off": (".png", PNG[:-12], "cut off or damaged"),
    "png grown": (".png", PNG + b"more", "foreign bytes"),
    "png noise": (".png", b"no picture", "is no PNG file"),
    "too large": (".npz", b"PK" + b"\0" * 200_000, "has 200002 bytes, expected at most"),
}


@pytest.mark.parametrize("case", PER_SAMPLE)
def test_broken_file_is_refused_by_name_with_advice(case, dataset, tmp_path):
    suffix, content, message = PER_SAMPLE[case]
    depths = maps(dataset)
    encode = {".npz": npz_of, ".mat": mat_of, ".png": png_of}[suffix]
    changes = {"png_mm_per_level": LEVEL_MM} if suffix == ".png" else {}
    folder = write_each(tmp_path / "p", suffix, depths, encode, **changes)
    (folder / f"{SAMPLE}{suffix}").write_bytes(content)
    error = refused(dataset, folder)
    line = re.search(rf"^\s*{re.escape(SAMPLE + suffix)}: .*", error, flags=re.MULTILINE)
    assert line and re.search(message, line[0]), error
    advice = "write|save|use|predict at|give"
    assert re.search(advice, line[0]), f"no advice in {line[0]}"


def renamed(name, column):
    return lambda m: table(m).rename_columns([name, column])


def without_first(m):
    return table(dict(list(m.items())[1:]))


def twice(m):
    return pa.concat_tables([table(m), table(dict(list(m.items())[:1]))])


def with_null(m):
    rows = [d.tolist() for d in m.values()]
    rows[0][3][4] = None
    return pa.table({"sample": list(m), "depth": pa.array(rows, NESTED)})


def ragged(m):
    rows = [d.tolist() for d in m.values()]
    rows[1][3] = rows[1][3][:-1]
    return pa.table({"sample": list(m), "depth": pa.array(rows, NESTED)})


TABLES = {
    "columns": (
        renamed("name", "depth"),
        "holds the columns name, depth; expected sample and depth",
    ),
    "missing": (without_first, "lacks the sample power_drill_A0"),
    "twice": (twice, "holds the sample power_drill_A0 twice"),
    "unknown": (
        lambda m: table({**m, "mug_A0": DEPTH}),
        "holds mug_A0, which is no sample of this split",
    ),
    "integers": (
        lambda m: table({k: v.astype(int) for k, v in m.items()}, pa.list_(pa.list_(pa.int32()))),
        "expected lists of float16, float32 or float64, got list<.*int32",
    ),
    "text": (lambda m: pa.table({"sample": list(m), "depth": ["x"] * len(m)}), "got string"),
    "one number": (
        lambda m: pa.table({"sample": list(m), "depth": pa.array([1.0] * len(m))}),
        "got double",
    ),
    "sample numbers": (
        lambda m: pa.table({"sample": [1, 2, 3, 4], "depth": table(m)["depth"]}),
        "expected text",
    ),
    "null": (with_null, "power_drill_A0: holds missing values"),
    "ragged": (ragged, "power_drill_A60: expected rows of one length"),
    "shape": (lambda m: table({k: v[:, :-1] for k, v in m.items()}), r"got \(32, 39\)"),
    "NaN": (
        lambda m: table({**m, SAMPLE: np.full(SIZE, np.nan)}),
        "power_drill_A60: holds 1280 NaN",
    ),
}


@pytest.mark.parametrize(
    ("form", "case"), [("arrow", "ragged"), *(("parquet", case) for case in TABLES)]
)
def test_broken_table_is_refused(form, case, dataset, tmp_path):
    make, message = TABLES[case]
    encode = parquet_bytes if form == "parquet" else arrow_bytes
    folder = write_table(tmp_path / "p", f"predictions.{form}", encode(make(maps(dataset))))
    error = refused(dataset, folder)
    assert f"predictions.{form}" in error and re.search(message, error), error


def test_tables_that_would_unpack_to_more_than_a_split_can_need(dataset, tmp_path):
    large = pa.table(
        {"sample": ["a"] * 4, "depth": pa.array([np.zeros(400_000).tolist()] * 4, FLAT)}
    )
    folder = write_table(
        tmp_path / "p", "predictions.parquet", parquet_bytes(large, compression="zstd")
    )
    assert (folder / "predictions.parquet").stat().st_size < 10_000
    assert re.search(
        r"predictions.parquet would unpack to \d+ bytes and 16000\d\d values",
        refused(dataset, folder),
    )
    write_table(folder, "predictions.parquet", b"PAR1" + b"\0" * 60 + b"PAR1")
    assert "can't be read as Arrow or Parquet" in refused(dataset, folder)
    (folder / "predictions.parquet").unlink()
    for cut in (100, 700, 5000):
        write_table(folder, "predictions.arrow", arrow_bytes(table(maps(dataset)))[:cut])
        assert "predictions.arrow" in refused(dataset, folder)


@pytest.mark.parametrize("megabytes", [8, 400])
def test_compressed_arrow_that_unpacks_to_more_than_a_split_can_need(megabytes, dataset, tmp_path):
    """The larger one is stopped while it is unpacked, before it has taken as much memory as it asks
    for."""
    zeros = np.zeros(megabytes * 10**6 // 4, np.float32)
    large = pa.table({"sample": ["a"], "depth": pa.ListArray.from_arrays([0, zeros.size], zeros)})
    folder = write_table(
        tmp_path / "p", "predictions.arrow", arrow_bytes(large, compression="zstd")
    )
    assert (folder / "predictions.arrow").stat().st_size < 100_000
    error = refused(dataset, folder)
    expected = (
        "unpacks to more than" if megabytes < 100 else "takes more memory than|out of memory|malloc"
    )
    assert re.search(rf"predictions.arrow .*({expected})", error), error


def test_page_headers_that_contradict_the_footer(dataset, tmp_path):
    """A page that says it unpacks to 8 kB, in a file whose footer says 5 kB."""
    content = parquet_bytes(table({"a": DEPTH}, FLAT), compression="snappy", use_dictionary=False)
    place = pq.read_metadata(io.BytesIO(content)).row_group(0).column(1).data_page_offset
    assert (
        content[place : place + 3] == b"\x15\x00\x15"
    )  # field 1 is the page type, field 2 the unpacked size
    assert (
        content[place + 3] >= 0x80 > content[place + 4]
    )  # a number of two bytes; the largest such is 8191
    for wrong in (
        content[: place + 3] + b"\xfe\x7f" + content[place + 5 :],
        content[:place] + b"\x1b" * (len(content) - place),
    ):
        folder = write_table(tmp_path / "p", "predictions.parquet", wrong)
        assert "can't be read as Arrow or Parquet" in refused(dataset, folder)


@pytest.mark.processes
@pytest.mark.parametrize("answer", ["os.abort()", "time.sleep(60)", "bytearray(10**9)"])
def test_a_process_that_reads_is_bounded_and_its_end_is_a_refusal(answer, tmp_path, monkeypatch):
    (tmp_path / "reader_of_test.py").write_text(
        "import os, time\nfrom fpp_ml_bench.containers import limit_memory\ndef read(content, "
        "largest):\n"
        f"    limit_memory(largest)\n    return {{}}, content or bytes({answer})\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(containers, "_idle", {})
    read = partial(containers.guarded, "reader_of_test:read", largest=1000)
    assert read(b"good") == ({}, b"good")
    (first,) = containers._idle[os.getpid()]
    process = first.process
    del first
    with monkeypatch.context() as impatient:
        if "sleep" in answer:
            impatient.setattr(containers, "TIMEOUT_S", 0.1)
        with pytest.raises(
            PredictionError, match=r"it ended the process|within 0.1 s|more memory than 1000 bytes"
        ):
            read(b"")
    assert (process.returncode is None) == ("bytearray" in answer)
    assert read(b"good") == ({}, b"good")  # by the same process, or by a new one
    (last,) = containers._idle.pop(os.getpid())
    process = last.process
    del last
    assert process.returncode is not None


def test_forms_cannot_be_mixed_and_links_are_refused(dataset, tmp_path):
    depths = maps(dataset)
    folder = write_each(tmp_path / "p", ".npz", depths, npz_of)
    (folder / f"{SAMPLE}.npy").write_bytes(npy_bytes(depths[SAMPLE]))
    (folder / "predictions.parquet").write_bytes(b"")
    error = refused(dataset, folder)
    assert f"{SAMPLE}.npy: is extra (the other predictions are .npz files: keep one form)" in error
    assert (
        "predictions.parquet: is extra (the other predictions are .npz files: keep one form)"
        in error
    )
    table_folder = tmp_path / "t"
    write_table(table_folder, "predictions.parquet", parquet_bytes(table(depths)))
    (table_folder / "predictions.parquet").rename(tmp_path / "elsewhere")
    (table_folder / "predictions.parquet").symlink_to(tmp_path / "elsewhere")
    assert "predictions.parquet is a symbolic link" in refused(dataset, table_folder)


UNITS = {
    "metres as mm": ("mm", lambda d: d / 1000, {}, "looks like metres .*declare units: m"),
    "mm as metres": ("m", lambda d: d, {}, "does not look like metres: .*declare units: mm"),
    "normalised as metres": (
        "m",
        lambda d: d / 3000,
        {},
        "does not look like metres: .*declare units: normalised",
    ),
    "metres as normalised": (
        "normalised",
        lambda d: d / 1000,
        ORACLE,
        "does not look like normalised depth: .*m or mm",
    ),
    "scale in metres": ("m", lambda d: d / 1000, {"png_mm_per_level": 0.1}, "units must be mm"),
    "negative scale": (
        "mm",
        lambda d: d,
        {"png_mm_per_level": -0.1},
        "png_mm_per_level: .*greater than 0",
    ),
    "huge in metres": (
        "m",
        lambda d: np.where(d == d.max(), 1e29, d / 1000),
        {},
        "the limit is 1e\\+27",
    ),
}


@pytest.mark.parametrize("case", UNITS)
def test_declared_units_are_checked_against_the_values(case, dataset, tmp_path):
    units, change, changes, message = UNITS[case]
    folder = write_predictions(tmp_path / "p", dataset, noise_mm=1.0, units=units, **changes)
    for path in folder.glob("*.npy"):
        np.save(path, change(np.load(path).astype(np.float64)))
    error = refused(dataset, folder)
    assert re.search(message, error), error
    assert "submission.yaml" in error or re.search(r"power_drill_A0.npy: ", error)


def test_png_needs_its_scale(dataset, tmp_path):
    folder = write_each(tmp_path / "p", ".png", maps(dataset), png_of)
    assert "png_mm_per_level: expected what one level" in refused(dataset, folder)
