"""A lock for the single writer of a folder; the operating system releases it when the process ends in any way."""

import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fpp_ml_bench.errors import BuildError
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


@contextmanager
def exclusive(lock_file: Path, folder: Path, activity: str) -> Iterator[None]:
    """Hold ``lock_file``, created with its folder if absent; `BuildError` for ``folder`` if another process has it."""
    try:
        lock_file.parent.mkdir(parents=True, exist_ok=True)
        lock = os.open(lock_file, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise BuildError(f"{folder}: can't be written ({error.strerror or error})") from error
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise BuildError(
                f"{folder}: another process is {activity}; wait for it or choose another folder"
            ) from error
        yield
    finally:
        os.close(lock)
