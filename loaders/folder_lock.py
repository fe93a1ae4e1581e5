"""One writer a folder: a lock that the operating system drops when the process dies, however it dies."""

import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.loaders.manifest import MANIFEST, WORK_FOLDER


@contextmanager
def writing(folder: Path) -> Iterator[Path]:
    """Hold a dataset folder for writing; yields its work folder, which is gone once the manifest stands.

    Raises `BuildError` for a folder that another process is writing, or that holds something else than a dataset.
    """
    work = folder / WORK_FOLDER
    if folder.exists() and not folder.is_dir():
        raise BuildError(f"{folder}: is a file; give a folder")
    if folder.is_dir() and not (folder / MANIFEST).exists() and not work.exists() and any(folder.iterdir()):
        raise BuildError(f"{folder}: holds other files and no dataset; give a new or empty folder")
    try:
        work.mkdir(parents=True, exist_ok=True)
        lock = os.open(work / "lock", os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise BuildError(f"{folder}: can't be written ({error.strerror})") from error
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise BuildError(
                f"{folder}: another process is writing this folder; wait for it or choose another"
            ) from error
        try:
            yield work
        finally:
            if (folder / MANIFEST).exists():
                shutil.rmtree(work, ignore_errors=True)
    finally:
        os.close(lock)
