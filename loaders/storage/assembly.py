"""From planned shards to a finished folder: skip finished shards, write the rest, then card, rig and manifest.

Generated and imported datasets are written alike; only the source of their rows differs. Each finished shard leaves a
receipt in the work folder. A resumed run trusts a receipt only when every file it names has the hash it states.
"""

import json
import os
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from multiprocessing import connection, get_context, parent_process
from pathlib import Path
from typing import Any

from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.files import file_hash, write_atomically
from fpp_ml_bench.loaders.storage.card import write_card
from fpp_ml_bench.loaders.storage.folder_lock import writing
from fpp_ml_bench.loaders.storage.manifest import MANIFEST, Manifest, ShardFile, describe_file
from fpp_ml_bench.loaders.storage.shards import ShardPlan
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.machine import THREAD_COUNTS

SETTINGS = "settings.json"
Receipt = tuple[list[ShardFile], list[dict[str, Any]]]
Work = Callable[[Path, Path, ShardPlan, Callable[[], None]], Receipt]
"""Writes a shard: (dataset folder, scratch folder, plan, function to call after each row) -> its files and rows.
Picklable."""
Progress = Callable[[int], None]
_RESERVE_BYTES = 1 << 26
_POLL_S = 0.2


@dataclass(frozen=True)
class Assembly:
    """A dataset to be written: its shard plans, the function that writes a shard, and the manifest without rows."""

    plans: list[ShardPlan]
    work: Work
    manifest: Manifest
    bytes_per_row: int
    mesh_folder: str | None = None
    """Folder below the dataset folder into which ``work`` writes a PLY of each object."""

    def mesh_paths(self, rows: list[dict[str, Any]]) -> list[str]:
        """Mesh files of the objects that ``rows`` show, relative to the dataset folder."""
        if self.mesh_folder is None:
            return []
        return [f"{self.mesh_folder}/{name}.ply" for name in dict.fromkeys(row["object"] for row in rows)]

    def key(self) -> dict[str, Any]:
        """Settings that must be equal for a run to resume in this folder."""
        content = asdict(self.manifest)
        return {
            name: content[name] for name in ("origin", "settings", "rig", "size", "stored", "exact", "schema_version")
        }


def assemble(folder: Path, assembly: Assembly, workers: int, progress: Progress = lambda rows: None) -> Manifest:
    """Write or finish the dataset. Returns the manifest at the end.

    ``progress`` is called with numbers of finished rows: first the rows of an interrupted run, then each new row. It is
    not called when the dataset is already finished.

    Raises `BuildError` when the folder is in use, holds other files, or can't be written.
    """
    try:
        return _assemble(folder, assembly, workers, progress)
    except OSError as error:
        raise BuildError(
            f"{folder}: writing failed ({error}); remove the cause (on a full disk: free some space), then run the "
            "same command again: it resumes"
        ) from error


def _assemble(folder: Path, assembly: Assembly, workers: int, progress: Progress) -> Manifest:
    with writing(folder) as scratch:
        if (folder / MANIFEST).exists():
            return _finished_manifest(folder, assembly)
        _check_settings(folder, scratch, assembly)
        for leftover in (*scratch.glob("*.tmp"), *folder.rglob(".*.tmp")):  # of a run that was killed while writing
            leftover.unlink(missing_ok=True)  # the two patterns overlap
        receipts = {}
        for plan in assembly.plans:
            receipt = _receipt(folder, scratch, plan)
            if receipt and all((folder / name).is_file() for name in assembly.mesh_paths(receipt[1])):
                receipts[plan.name] = receipt
        missing = [plan for plan in assembly.plans if plan.name not in receipts]
        progress(sum(len(plan.samples) for plan in assembly.plans if plan.name in receipts))
        _check_space(folder, assembly, missing)
        for plan, receipt in _run(folder, scratch, assembly.work, missing, workers, progress):
            _write_receipt(scratch, plan, receipt)
            receipts[plan.name] = receipt
        return _finish(folder, assembly, [receipts[plan.name] for plan in assembly.plans])


def _finished_manifest(folder: Path, assembly: Assembly) -> Manifest:
    manifest = DatasetFolder(folder).manifest  # every file is there, in full length
    _compare(folder, {key: asdict(manifest)[key] for key in assembly.key()}, assembly.key())
    return manifest


def _check_settings(folder: Path, scratch: Path, assembly: Assembly) -> None:
    path = scratch / SETTINGS
    # Another version may make other bytes: its finished dataset is valid, but a dataset must not mix two versions.
    settings = {**assembly.key(), "generator": assembly.manifest.generator}
    if path.exists():
        try:
            begun_settings = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise BuildError(f"{path}: damaged; delete {folder} and start again") from error
        _compare(folder, begun_settings, settings)
    write_atomically(path, json.dumps(settings, indent=1).encode())


def _compare(folder: Path, stored: dict[str, Any], requested: dict[str, Any]) -> None:
    """Raise `BuildError` naming the differences between the folder's settings and the requested settings."""
    requested = json.loads(json.dumps(requested))
    stored = json.loads(json.dumps(stored))
    differing = []
    for key in requested:
        if requested[key] == stored.get(key):
            continue
        if isinstance(requested[key], dict) and isinstance(stored.get(key), dict):
            names = sorted(set(requested[key]) | set(stored[key]))
            differing += [
                f"{name} (there {_short(stored[key].get(name))}, now {_short(requested[key].get(name))})"
                for name in names if requested[key].get(name) != stored[key].get(name)
            ]  # fmt: skip
        else:
            differing.append(f"{key} (there {_short(stored.get(key))}, now {_short(requested[key])})")
    if differing:
        raise BuildError(
            f"{folder}: holds a dataset with other settings: {'; '.join(differing)}. Give another folder, or delete it"
        )


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _receipt(folder: Path, scratch: Path, plan: ShardPlan) -> Receipt | None:
    """Receipt of a shard that is finished and whose files are intact, else None."""
    path = scratch / f"{plan.name}.json"
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        files = [ShardFile(**entry) for entry in content["files"]]
        rows = content["rows"]
        complete = all(file_hash(folder / file.path) == file.xxh3_128 for file in files)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return (
        (files, rows) if complete and [row["sample"] for row in rows] == [name for name, _, _ in plan.samples] else None
    )


def _write_receipt(scratch: Path, plan: ShardPlan, receipt: Receipt) -> None:
    files, rows = receipt
    content = {"files": [asdict(file) for file in files], "rows": rows}
    write_atomically(scratch / f"{plan.name}.json", json.dumps(content).encode())


def _check_space(folder: Path, assembly: Assembly, missing: list[ShardPlan]) -> None:
    needed = sum(len(plan.samples) for plan in missing) * assembly.bytes_per_row
    free = shutil.disk_usage(folder).free
    if needed + _RESERVE_BYTES > free:
        raise BuildError(
            f"{folder}: needs {needed / 1e9:.2f} GB more and the disk has {free / 1e9:.2f} GB free; free some space, "
            "choose another disk, a smaller --size or fewer --objects"
        )


def _run(
    folder: Path, scratch: Path, work: Work, plans: list[ShardPlan], workers: int, progress: Progress
) -> Iterator[tuple[ShardPlan, Receipt]]:
    """Write the shards; yields each when it is finished, in any order."""
    if workers <= 1 or len(plans) <= 1:
        for plan in plans:
            yield plan, work(folder, scratch, plan, lambda: progress(1))
        return
    context = get_context("spawn")
    rows_done = context.Value("q", 0)
    reported = 0
    with (
        _single_threaded_algebra(),
        ProcessPoolExecutor(
            max_workers=min(workers, len(plans)), mp_context=context, initializer=_start_worker, initargs=(rows_done,)
        ) as pool,
    ):
        # The longest shards first, so that no worker is left with a long shard at the end.
        ordered = sorted(plans, key=lambda plan: -len(plan.samples))
        futures = {pool.submit(_work_in_worker, work, folder, scratch, plan): plan for plan in ordered}
        waiting = set(futures)
        try:
            while waiting:
                finished, waiting = wait(waiting, timeout=_POLL_S, return_when=FIRST_COMPLETED)
                done = rows_done.value
                progress(done - reported)
                reported = done
                for future in finished:
                    yield futures[future], future.result()
        except BrokenProcessPool as error:
            raise BuildError(
                f"{folder}: a worker process died (out of memory?); run the same command again, it resumes; with "
                "--workers 1 it needs the least memory"
            ) from error
        finally:
            pool.shutdown(cancel_futures=True)


@contextmanager
def _single_threaded_algebra() -> Iterator[None]:
    """Worker processes started inside the block get a single-threaded BLAS, whose idle threads would spin otherwise."""
    previous = {name: os.environ.get(name) for name in THREAD_COUNTS}
    os.environ.update(dict.fromkeys(THREAD_COUNTS, "1"))
    try:
        yield
    finally:
        for name, value in previous.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


_rows_done: Any = None


def _start_worker(rows_done: Any) -> None:
    """Count rows in memory shared with the parent, and end with it: an orphan would write into an unlocked folder."""
    global _rows_done
    _rows_done = rows_done
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


def _work_in_worker(work: Work, folder: Path, scratch: Path, plan: ShardPlan) -> Receipt:
    return work(folder, scratch, plan, _count_row)


def _count_row() -> None:
    with _rows_done.get_lock():
        _rows_done.value += 1


def _finish(folder: Path, assembly: Assembly, receipts: list[Receipt]) -> Manifest:
    samples: dict[str, list[dict[str, Any]]] = {}
    for plan, (_, rows) in zip(assembly.plans, receipts, strict=True):
        samples.setdefault(plan.split, []).extend(rows)
    shards = [file for files, _ in receipts for file in files]
    manifest = replace(assembly.manifest, samples=samples, shards=shards)
    rows = [row for part in samples.values() for row in part]
    # Only files written here are listed: `fpp-bench verify` reports any other file in the folder as foreign.
    names = [*write_card(folder, manifest), *assembly.mesh_paths(rows)]
    manifest = replace(manifest, others=[describe_file(folder, folder / name) for name in sorted(names)])
    manifest.write(folder)
    return manifest
