"""Exporting a dataset in one or several forms."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from fpp_ml_bench import optics
from fpp_ml_bench.errors import BuildError, DatasetError
from fpp_ml_bench.files import exclusive
from fpp_ml_bench.loaders import published
from fpp_ml_bench.loaders.storage.parquet import write_parquet
from fpp_ml_bench.loaders.storage.store import ALL_SPLITS, DatasetFolder

MESH_FOLDER = "meshes"
FORMS = ("parquet", "mat", "meshes", "patterns")
SAMPLE_FORMS = ("parquet", "mat")
"""Forms whose progress is counted in samples."""
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
            for remains in staging.iterdir():
                if remains.is_dir() and not remains.is_symlink():
                    shutil.rmtree(remains)
                elif remains.name != _LOCK:
                    remains.unlink()
            yield staging
            (staging / _LOCK).unlink()
            staging.replace(target)
        except BaseException as error:
            shutil.rmtree(staging, ignore_errors=True)
            if not isinstance(error, OSError):
                raise
            raise BuildError(
                f"{out}: can't be written ({error.strerror or error}); nothing was left there. Free some "
                "space or choose another disk"
            ) from error


def chosen_splits(dataset: DatasetFolder, split: str) -> list[str]:
    """Splits that ``split`` names, in row order; raises `DatasetError` when the dataset has no such samples."""
    dataset.samples(split)
    return list(dataset.splits) if split == ALL_SPLITS else [split]


def export(
    dataset: DatasetFolder, out: Path, forms: list[str], splits: list[str], threads: int = 1,
    progress: Callable[[int], None] = lambda rows: None,
) -> None:  # fmt: skip
    """Write a dataset in ``forms`` (of `FORMS`): a single form into ``out``, several forms into folders of their names.

    ``out`` must be new or empty and is written completely or not at all; ``progress`` is called with numbers of samples
    written. Raises `BuildError` for an unusable ``out`` or disk, `DatasetError` for data that the dataset lacks.
    """
    if not forms or not set(forms) <= set(FORMS):
        raise BuildError(f"export: expected some of {', '.join(FORMS)}, got {', '.join(forms) or 'none'}")
    if out.resolve() == dataset.path.resolve() or dataset.path.resolve() in out.resolve().parents:
        raise BuildError(f"{out}: lies in the dataset itself; give another folder")
    meshes = _meshes(dataset, splits) if "meshes" in forms else []
    with exporting(out) as staging:
        for form in forms:
            folder = staging / form if len(forms) > 1 else staging
            folder.mkdir(exist_ok=True)
            if form == "parquet":
                write_parquet(dataset, folder, splits, threads, progress)
            elif form == "mat":
                published.write_tree(dataset, folder, splits, threads, lambda: progress(1))
            elif form == "meshes":
                for path in meshes:
                    shutil.copyfile(path, folder / path.name)
            else:
                optics.export_patterns(dataset.rig, folder)


def _meshes(dataset: DatasetFolder, splits: list[str]) -> list[Path]:
    rows = (row for split in splits for row in dataset.manifest.samples[split])
    paths = [dataset.path / MESH_FOLDER / f"{name}.ply" for name in dict.fromkeys(row["object"] for row in rows)]
    for path in paths:
        if not path.is_file():
            hint = (
                "imported datasets have no meshes" if dataset.manifest.origin == "imported" else "run: fpp-bench verify"
            )
            raise DatasetError(f"{path}: the mesh is missing; {hint}")
    return paths
