"""Staging a dataset for the Hub: Parquet that its viewer shows, meshes, rig, and the head of the card."""

import re
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path

import cv2
import pyarrow

from fpp_ml_bench import __version__
from fpp_ml_bench.errors import DatasetError, PublishError
from fpp_ml_bench.files import file_hash, write_atomically
from fpp_ml_bench.loaders.hub import MARK, Publication, mark_bytes, yaml_text
from fpp_ml_bench.loaders.storage.card import RIG_FILE
from fpp_ml_bench.loaders.storage.manifest import GENERATED, MESH_FOLDER
from fpp_ml_bench.loaders.storage.parquet import card_configs, data_shards, write_shard
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.rig_file import save_rig

NAME = "FPP-ML-Bench"
OWNED = ("data/", f"{MESH_FOLDER}/")
_LICENCE = re.compile(r"[a-z0-9][a-z0-9.-]{0,39}")
_IDENTITY, _FILES = "staged.sha256", "files"


@contextmanager
def staging_folder(chosen: Path | None, identity: str) -> Iterator[Path]:
    """Yield the folder for staged files: a temporary folder, or ``files/`` in ``chosen``, kept for the next run.
    ``identity`` says what is staged. Files that an earlier run left in ``chosen`` are kept for the same identity and
    removed for another. Raises `PublishError` for a folder that holds anything else, ``OSError`` for a failed write."""
    if chosen is None:
        with tempfile.TemporaryDirectory(prefix="fpp-bench-publish-") as folder:
            yield Path(folder)
        return
    mark, files = chosen / _IDENTITY, chosen / _FILES
    # With the versions that the bytes of a Parquet file or a PNG depend on.
    writers = f"{__version__} {pyarrow.__version__} {cv2.__version__}"
    expected = sha256(f"{identity}\n{writers}".encode()).hexdigest()
    if chosen.exists() and not chosen.is_dir():
        raise PublishError(f"--staging {chosen}: is a file; give a folder")
    chosen.mkdir(parents=True, exist_ok=True)
    if not mark.is_file() and any(chosen.iterdir()):
        raise PublishError(f"--staging {chosen}: holds files that this command did not put there; give a new folder")
    if not mark.is_file() or mark.read_text(encoding="ascii", errors="replace").strip() != expected:
        if files.is_dir():
            shutil.rmtree(files)
        write_atomically(mark, f"{expected}\n".encode())
    files.mkdir(exist_ok=True)
    for unfinished in files.rglob(".*.tmp"):  # of a run that was killed
        unfinished.unlink()
    yield files


def dataset_licence(dataset: DatasetFolder, license_id: str | None) -> str:
    """Licence identifier for the card: ``license_id``, or MIT for generated data. `PublishError` for other data."""
    origin = dataset.manifest.origin
    if license_id is None and origin != GENERATED:
        raise PublishError(f"{dataset.path}: {origin} data; say under which --license it may be shared")
    licence = license_id or "mit"
    if not _LICENCE.fullmatch(licence):
        raise PublishError(f"--license: expected an identifier like mit or cc-by-4.0, got {licence!r}")
    return licence


def card_head(dataset: DatasetFolder, licence: str) -> str:
    """Front matter of the card, from which the Hub's viewer and ``load_dataset`` know configurations and files."""
    rows = sum(len(samples) for samples in dataset.splits.values())
    files: dict[str, list[str]] = {split: [] for split in dataset.splits}
    for name, shard in data_shards(dataset).items():
        files[shard.split].append(name)
    head = {
        "license": licence,
        "pretty_name": NAME,
        "task_categories": ["depth-estimation"],
        "size_categories": ["n<1K" if rows < 1000 else "1K<n<10K" if rows < 10_000 else "10K<n<100K"],
        "tags": ["fringe-projection-profilometry", "structured-light", "metrology", "fpp-ml-bench"],
        # Files by name, not by pattern: a stray file can never join the data.
        "configs": card_configs(dataset, dataset.fingerprint, files, preview=True),
    }
    return f"---\n{yaml_text(head)}---\n"


def stage_dataset(
    dataset: DatasetFolder,
    repo: str,
    folder: Path,
    texts: Mapping[str, str],
    threads: int = 1,
    row_done: Callable[[int], None] = lambda rows: None,
) -> Publication:
    """Write all that is published of ``dataset``, and ``texts`` by file name, into ``folder``: same data, same bytes.
    Parquet files that are already there are kept (see `staging_folder`). Raises `DatasetError` for a damaged dataset,
    ``OSError`` when a file can't be written."""
    for name, shard in data_shards(dataset).items():
        if (folder / name).is_file():
            row_done(shard.rows)
        else:
            write_shard(dataset, shard, folder / name, threads, row_done)
    for mesh in (file for file in dataset.manifest.others if file.path.startswith(f"{MESH_FOLDER}/")):
        source = dataset.path / mesh.path
        if not source.is_file() or file_hash(source) != mesh.xxh3_128:
            raise DatasetError(f"{source}: missing or damaged, it isn't published; build the dataset again")
        (folder / MESH_FOLDER).mkdir(exist_ok=True)
        shutil.copyfile(source, folder / mesh.path)
    save_rig(dataset.rig, folder / RIG_FILE)
    for name, text in texts.items():
        write_atomically(folder / name, text.encode())
    about = {"fingerprint": dataset.fingerprint, "size": list(dataset.size), "configs": list(dataset.configs)}
    marked = mark_bytes("dataset", **about, splits=dataset.splits, content=dataset.content)
    write_atomically(folder / MARK, marked)
    return Publication("dataset", repo, folder, f"{NAME} dataset {dataset.fingerprint[:12]}", OWNED)
