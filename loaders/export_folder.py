"""Writes an export's folder completely or not at all: under a temporary name beside it, renamed at the end."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.loaders.folder_lock import exclusive

_LOCK = ".lock"


@contextmanager
def exporting(out: Path) -> Iterator[Path]:
    """Yield a folder to write into; it becomes ``out`` when the block succeeds, and is removed when it fails.

    Remains of an export that was killed are removed. Raises `BuildError` when ``out`` is not empty, is a file, is being
    written by another process, or the disk can't be written.
    """
    target = out.resolve()
    if target.exists() and not target.is_dir():
        raise BuildError(f"{out}: is a file; give a new folder")
    if target.is_dir() and any(target.iterdir()):
        raise BuildError(f"{out}: is not empty; give a new folder, an export never adds to a folder or overwrites it")
    staging = target.with_name(f".{target.name}.export")
    with exclusive(staging / _LOCK, out, "exporting there"):
        try:
            _clear(staging)
            yield staging
            (staging / _LOCK).unlink()
            staging.replace(target)
        except OSError as error:
            shutil.rmtree(staging, ignore_errors=True)
            raise BuildError(
                f"{out}: can't be written ({error.strerror or error}); nothing was left there. Free some "
                "space or choose another disk"
            ) from error
        except BaseException:
            shutil.rmtree(staging, ignore_errors=True)
            raise


def _clear(staging: Path) -> None:
    for entry in staging.iterdir():
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry)
        elif entry.name != _LOCK:
            entry.unlink()
