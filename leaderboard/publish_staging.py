"""The folder in which a publication is put together: a temporary one, or one that is kept and continued."""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path

from fpp_ml_bench import __version__
from fpp_ml_bench.errors import PublishError
from fpp_ml_bench.loaders.manifest import write_atomically

_IDENTITY, _FILES = "staged.sha256", "files"


@contextmanager
def staging_folder(kept: Path | None, identity: str) -> Iterator[Path]:
    """Yield the folder for staged files: a temporary one, or ``files/`` in ``kept``.

    ``identity`` says what is staged there. What an earlier run left in ``kept`` for the same identity is continued; for
    another one it is cleared away. Raises `PublishError` for a folder that holds anything else, ``OSError`` when the
    disk refuses.
    """
    if kept is None:
        with tempfile.TemporaryDirectory(prefix="fpp-bench-publish-") as folder:
            yield Path(folder)
        return
    mark = kept / _IDENTITY
    wanted = sha256(f"{identity}\n{_writers()}".encode()).hexdigest()
    if kept.exists() and not kept.is_dir():
        raise PublishError(f"--staging {kept}: is a file; give a folder")
    kept.mkdir(parents=True, exist_ok=True)
    if not mark.is_file() and any(kept.iterdir()):
        raise PublishError(f"--staging {kept}: holds files that this command did not put there; give a new folder")
    files = kept / _FILES
    if not mark.is_file() or mark.read_text(encoding="ascii", errors="replace").strip() != wanted:
        if files.is_dir():
            shutil.rmtree(files)
        write_atomically(mark, f"{wanted}\n".encode())
    files.mkdir(exist_ok=True)
    for unfinished in files.rglob(".*.tmp"):  # of a run that was killed
        unfinished.unlink()
    yield files


def _writers() -> str:
    """Versions that the bytes of a Parquet file or a PNG depend on."""
    import cv2
    import pyarrow

    return f"{__version__} {pyarrow.__version__} {cv2.__version__}"
