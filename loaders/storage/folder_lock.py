"""A lock for the single writer of a folder; the operating system releases it when the process ends in any way."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.files import exclusive
from fpp_ml_bench.loaders.storage.manifest import MANIFEST, WORK_FOLDER


@contextmanager
def writing(folder: Path) -> Iterator[Path]:
    """Lock a dataset folder for writing; yields its work folder, which is removed once the manifest is written.

    Raises `BuildError` for a folder that another process is writing, or that holds other files than a dataset.
    """
    work = folder / WORK_FOLDER
    if folder.exists() and not folder.is_dir():
        raise BuildError(f"{folder}: is a file; give a folder")
    if folder.is_dir() and not (folder / MANIFEST).exists() and not work.exists() and any(folder.iterdir()):
        raise BuildError(f"{folder}: holds other files and no dataset; give a new or empty folder")
    with exclusive(work / "lock", folder, "writing this folder"):
        try:
            yield work
        finally:
            if (folder / MANIFEST).exists():
                shutil.rmtree(work, ignore_errors=True)
