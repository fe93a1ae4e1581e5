"""MATLAB files: compared with SciPy and with files written by MATLAB; damaged files must be
refused."""

import io
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from published_trees import v73_bytes

from fpp_ml_bench.containers import matrix_bytes
from fpp_ml_bench.errors import LayoutError
from fpp_ml_bench.loaders.published.importing import read_matrix, read_scalar

WRITTEN_BY_MATLAB = Path(scipy.io.matlab.__file__).parent / "tests" / "data"
DEPTH = np.where(
    np.add.outer(np.arange(11), np.arange(7)) > 6, 1800 + np.arange(77.0).reshape(11, 7) / 3, 0
)


def v5_bytes(compressed=True, **values):
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, values, do_compression=compressed)
    return buffer.getvalue()


@pytest.mark.parametrize("dtype", ["f4", "f8", "u1", "i2", "u2", "i4", "u4", "i8", "u8"])
@pytest.mark.parametrize("compressed", [True, False])
def test_v5_as_scipy_writes_it(tmp_path, dtype, compressed):
    matrix = DEPTH.astype(dtype) if dtype not in ("u1",) else (DEPTH % 251).astype(dtype)
    file = tmp_path / "a.mat"
    file.write_bytes(v5_bytes(compressed, before=np.eye(3), depthMap=matrix, after="text"))
    read = read_matrix(file, "depthMap")
    assert read.dtype == matrix.dtype and np.array_equal(read, matrix) and read.flags.c_contiguous


@pytest.mark.parametrize("dtype", ["f4", "f8"])
def test_v73_comes_out_as_matlab_shows_it_not_transposed(tmp_path, dtype):
    file = tmp_path / "a.mat"
    file.write_bytes(v73_bytes(depthMap=DEPTH.astype(dtype)))
    read = read_matrix(file, "depthMap")
    assert read.shape == (11, 7) and np.array_equal(read, DEPTH.astype(dtype))
    assert read.flags.c_contiguous


@pytest.mark.skipif(
    not WRITTEN_BY_MATLAB.is_dir(), reason="this SciPy was installed without its test data"
)
@pytest.mark.parametrize(
    ("name", "variable"),
    [
        ("testdouble_6.1_SOL2.mat", "testdouble"),  # big-endian
        ("testdouble_6.5.1_GLNX86.mat", "testdouble"),
        ("testdouble_7.4_GLNX86.mat", "testdouble"),  # compressed
        ("testmatrix_6.1_SOL2.mat", "testmatrix"),  # doubles that MATLAB stored as uint8
        ("testmatrix_7.1_GLNX86.mat", "testmatrix"),
        ("testminus_7.4_GLNX86.mat", "testminus"),
        ("testmulti_7.1_GLNX86.mat", "a"),
        ("miutf8_array_name.mat", "array_name"),
    ],
)
def test_files_written_by_matlab_read_as_scipy_reads_them(name, variable):
    expected = scipy.io.loadmat(WRITTEN_BY_MATLAB / name)[variable]
    read = read_matrix(WRITTEN_BY_MATLAB / name, variable)
    assert np.array_equal(read, expected) and read.shape == expected.shape


@pytest.mark.skipif(
    not WRITTEN_BY_MATLAB.is_dir(), reason="this SciPy was installed without its test data"
)
def test_a_v73_file_written_by_matlab():
    v5 = scipy.io.loadmat(WRITTEN_BY_MATLAB / "testdouble_7.4_GLNX86.mat")["testdouble"]
    assert np.allclose(read_matrix(WRITTEN_BY_MATLAB / "testhdf5_7.4_GLNX86.mat", "testdouble"), v5)


def test_scipy_reads_what_is_written_and_equal_values_give_equal_bytes(tmp_path):
    values = {"depthMap": DEPTH.astype(np.float32), "depth_min": 1802.0}
    content = matrix_bytes(values)
    assert content == matrix_bytes(values)
    read = scipy.io.loadmat(io.BytesIO(content))
    assert read["depthMap"].dtype == np.float32
    assert np.array_equal(read["depthMap"], values["depthMap"])
    assert read["depth_min"].shape == (1, 1)
    (tmp_path / "a.mat").write_bytes(content)
    assert read_scalar(tmp_path / "a.mat", "depth_min") == 1802.0


REFUSED = {
    "another variable": (v5_bytes(other=DEPTH, third=DEPTH), "other, third"),
    "another variable, v7.3": (v73_bytes(other=DEPTH), "other"),
    "complex": (v5_bytes(depthMap=DEPTH * 1j), "complex"),
    "text": (v5_bytes(depthMap="deep"), "real numeric matrix"),
    "cell": (v5_bytes(depthMap=np.array([DEPTH, 1], dtype=object)), "real numeric matrix"),
    "three dimensions": (v5_bytes(depthMap=np.zeros((2, 3, 4))), "(2, 3, 4)"),
    "three dimensions, v7.3": (v73_bytes(depthMap=np.zeros((2, 3, 4))), "real numeric matrix"),
    "a PNG": (b"\x89PNG\r\n\x1a\n" + bytes(300), "neither"),
    "empty": (b"", "cut off"),
    "no variables": (v5_bytes(), "got none"),
    "cut off": (v5_bytes(depthMap=DEPTH)[:-9], "cut off"),
    "cut off, not compressed": (v5_bytes(False, depthMap=DEPTH)[:-9], "cut off"),
    "cut off in its checksum": (v5_bytes(depthMap=DEPTH)[:-2], "cut off"),
    "cut off after the matrix": (v5_bytes(depthMap=DEPTH, z="text")[:-9], "cut off"),
    "cut off, v7.3": (v73_bytes(depthMap=DEPTH)[:900], "v7.3"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_by_name(tmp_path, case):
    content, message = REFUSED[case]
    file = tmp_path / "power_drill_A60.mat"
    file.write_bytes(content)
    with pytest.raises(LayoutError, match="power_drill_A60") as caught:
        read_matrix(file, "depthMap")
    assert message in str(caught.value)


def test_a_missing_file_and_a_value_that_is_not_a_scalar(tmp_path):
    with pytest.raises(LayoutError, match=r"gone\.mat: can't be read"):
        read_matrix(tmp_path / "gone.mat", "depthMap")
    for value in (DEPTH, np.nan):
        (tmp_path / "a.mat").write_bytes(v5_bytes(depth_min=value))
        with pytest.raises(LayoutError, match="depth_min: expected a finite number"):
            read_scalar(tmp_path / "a.mat", "depth_min")


@pytest.mark.long
@pytest.mark.parametrize("kind", ["compressed", "plain", "v7.3", "written here"])
def test_damage_is_refused_or_harmless_never_a_crash(tmp_path, kind):
    """SciPy 1.17 ends its process (segmentation fault) on some of the uncompressed files."""
    content = {
        "compressed": v5_bytes(True, depthMap=DEPTH),
        "plain": v5_bytes(False, depthMap=DEPTH),
        "v7.3": v73_bytes(depthMap=DEPTH),
        "written here": matrix_bytes({"depthMap": DEPTH}),
    }[kind]
    rng = np.random.default_rng(7)
    file = tmp_path / "a.mat"
    refused = unchanged = 0
    for trial in range(600):
        damaged = bytearray(content)
        if trial % 3 == 0:
            damaged = damaged[: rng.integers(len(damaged))]
        else:
            for position in rng.integers(min(len(damaged), 2500), size=rng.integers(1, 4)):
                damaged[position] = rng.integers(256)
        file.write_bytes(damaged)
        try:
            unchanged += np.array_equal(read_matrix(file, "depthMap"), DEPTH)
        except LayoutError:
            refused += 1
    assert refused > 200
    if kind in ("compressed", "written here"):  # with a checksum, all damage is refused
        assert refused + unchanged == 600
