"""Small published trees on disk: PNG by OpenCV, .mat by SciPy and h5py, none by this package's
writers."""

import io
import zlib
from contextlib import contextmanager
from pathlib import Path

import cv2
import h5py
import numpy as np
import scipy.io
from hub_server import HubServer, Repo
from huggingface_hub import constants

from fpp_ml_bench.loaders.published.importing import import_rows, plan_import
from fpp_ml_bench.loaders.storage.store import DatasetFolder

SIZE = (24, 24)
SPLITS = {"train": ("bowl",), "val": ("mug",), "test": ("power_drill", "my_own_part")}
"""Published folder names, and an object that is not among the benchmark's 50."""
VIEWS = ("A0", "A60", "A120", "A180", "A240", "A300")
FOLDERS = {
    "raw": "training_data_depth_raw",
    "global": "training_data_depth_global_normalized",
    "individual": "training_data_depth_individual_normalized",
}
TRAINING = Path("training_datasets")
PUBLISHED = "aharoon/fpp-ml-bench"
"""Name of the published dataset on the Hub."""


def depth_of(stem, size=SIZE):
    """A tilted square at about 1.8 m, float32 mm, different for every sample."""
    height, width = size
    number = zlib.crc32(stem.encode())
    shift = number % 7
    depth = np.zeros(size, np.float32)
    rows, columns = np.mgrid[6:18, 4 + shift : 14 + shift]
    depth[rows, columns] = 1750 + number % 997 / 13 + 3.3 * rows + 1.7 * columns
    return depth[:height, :width]


def fringe_of(stem, size=SIZE):
    rng = np.random.default_rng(zlib.crc32(stem.encode()))
    return rng.integers(20, 200, size, dtype=np.uint8)


def write_png(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    done, content = cv2.imencode(".png", image)
    assert done
    path.write_bytes(content.tobytes())


def write_mat(path, compressed=True, **values):
    path.parent.mkdir(parents=True, exist_ok=True)
    scipy.io.savemat(
        path,
        {name: np.atleast_2d(value) for name, value in values.items()},
        do_compression=compressed,
    )


def v73_bytes(**values):
    """A MATLAB v7.3 file: HDF5 behind a 512-byte MATLAB header, matrices transposed."""
    buffer = io.BytesIO()
    with h5py.File(buffer, "w", userblock_size=512) as file:
        for name, value in values.items():
            file.create_dataset(name, data=np.atleast_2d(value).T).attrs["MATLAB_class"] = (
                np.bytes_("single")
            )
    header = (
        b"MATLAB 7.3 MAT-file, Platform: GLNXA64, Created on: Mon Nov  2 2026 HDF5 schema 1.00 ."
    )
    content = bytearray(buffer.getvalue())
    content[:128] = header.ljust(124) + b"\x00\x02IM"
    return bytes(content)


def make_tree(root, variants=("raw",), info=None, splits=SPLITS, size=SIZE):
    """A valid training tree; ``info`` (depth ranges) is written by default if a variant needs
    it."""
    for split, objects in splits.items():
        for stem in (f"{name}_{view}" for name in objects for view in VIEWS):
            depth = depth_of(stem, size)
            inside = depth > 0
            low, high = float(depth[inside].min()), float(depth[inside].max())
            values = {
                "raw": {"depthMap": depth},
                "global": {"depthMapMeters": depth / np.float32(1000)},
                "individual": {
                    "depthMapNormalized": np.where(
                        inside, (depth.astype(float) - low) / (high - low), 0
                    )
                },
            }
            for variant in variants:
                folder = root / TRAINING / FOLDERS[variant] / split
                write_png(folder / "fringe" / f"{stem}.png", fringe_of(stem, size))
                write_mat(folder / "depth" / f"{stem}.mat", **values[variant])
            if info or (info is None and "individual" in variants):
                write_mat(
                    root / TRAINING / f"info_depth_params/{split}/depth/{stem}.mat",
                    depth_min=low,
                    depth_max=high,
                )
    return root


def files_of(tree):
    """What a Hub repository with the tree holds: content by path."""
    files = {
        path.relative_to(tree).as_posix(): path.read_bytes()
        for path in tree.rglob("*")
        if path.is_file()
    }
    return {**files, "README.md": b"# A dataset\n", ".gitattributes": b""}


@contextmanager
def hub_of(tree, cache, monkeypatch):
    """A Hub on the loopback interface whose one dataset is the tree, as `PUBLISHED`; this process's
    client talks to it. The Hugging Face cache is the folder ``cache``."""
    server = HubServer()
    server.repos["datasets", PUBLISHED] = Repo(files=files_of(tree))
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    monkeypatch.setattr(constants, "ENDPOINT", server.endpoint)
    template = server.endpoint + "/{repo_id}/resolve/{revision}/{filename}"
    monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(cache))
    monkeypatch.delenv("HF_TOKEN", raising=False)
    yield server
    server.shutdown()
    server.server_close()


def imported(tree, out, workers=1, **settings):
    import_rows(out, plan_import(tree, **settings), workers)
    return DatasetFolder(out)


def fringe_path(root, split="test", stem="power_drill_A60", variant="raw"):
    return root / TRAINING / FOLDERS[variant] / split / "fringe" / f"{stem}.png"


def depth_path(root, split="test", stem="power_drill_A60", variant="raw"):
    return root / TRAINING / FOLDERS[variant] / split / "depth" / f"{stem}.mat"


def info_path(root, split="test", stem="power_drill_A60"):
    return root / TRAINING / f"info_depth_params/{split}/depth/{stem}.mat"
