"""The folder in which a publication is put together: temporary, or kept and continued by the next run."""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path

from fpp_ml_bench import __version__
from fpp_ml_bench.errors import PublishError
from fpp_ml_bench.files import write_atomically

_IDENTITY, _FILES = "staged.sha256", "files"


@contextmanager
def staging_folder(chosen: Path | None, identity: str) -> Iterator[Path]:
    """Yield the folder for staged files: a temporary folder, or ``files/`` in ``chosen``.

    ``identity`` says what is staged. Files that an earlier run left in ``chosen`` are kept for the same identity and
    removed for another. Raises `PublishError` for a folder that holds anything else, ``OSError`` for a failed write.
    """
    if chosen is None:
        with tempfile.TemporaryDirectory(prefix="fpp-bench-publish-") as folder:
            yield Path(folder)
        return
    mark = chosen / _IDENTITY
    expected = sha256(f"{identity}\n{_writers()}".encode()).hexdigest()
    if chosen.exists() and not chosen.is_dir():
        raise PublishError(f"--staging {chosen}: is a file; give a folder")
    chosen.mkdir(parents=True, exist_ok=True)
    if not mark.is_file() and any(chosen.iterdir()):
        raise PublishError(f"--staging {chosen}: holds files that this command did not put there; give a new folder")
    files = chosen / _FILES
    if not mark.is_file() or mark.read_text(encoding="ascii", errors="replace").strip() != expected:
        if files.is_dir():
            shutil.rmtree(files)
        write_atomically(mark, f"{expected}\n".encode())
    files.mkdir(exist_ok=True)
    for unfinished in files.rglob(".*.tmp"):  # of a run that was killed
        unfinished.unlink()
    yield files


def _writers() -> str:
    """Versions that the bytes of a Parquet file or a PNG depend on."""
    import cv2
    import pyarrow

    return f"{__version__} {pyarrow.__version__} {cv2.__version__}"
