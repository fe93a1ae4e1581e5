"""From planned shards to a finished folder: skip finished shards, write the rest, then card, rig and manifest.
Generated and imported datasets are written alike; only the source of their rows differs. Each finished shard leaves a
receipt in the work folder. A resumed run trusts a receipt only when every file it names has the hash it states."""

import json
import platform
import shutil
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.files import cause_of, exclusive, file_hash, read_json, write_atomically
from fpp_ml_bench.loaders.sample import Row, column_hash
from fpp_ml_bench.loaders.storage.card import write_card
from fpp_ml_bench.loaders.storage.manifest import (
    MANIFEST,
    WORK_FOLDER,
    Manifest,
    ShardFile,
    check_row,
    describe_file,
    strictly,
)
from fpp_ml_bench.loaders.storage.shard_processes import write_in_processes
from fpp_ml_bench.loaders.storage.shards import Receipt, ShardPlan, ShardWriter
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.pool import mapping
from fpp_ml_bench.remote import RemoteFolder

SETTINGS = "settings.json"
RowSource = Callable[[ShardPlan, Path], Iterable[Row]]
"""Makes the rows of a shard, in order, and maybe meshes in the dataset folder. Picklable; a process calls one for all
its shards, and may hold what they share in it."""
Progress = Callable[[int], None]
_RESERVE_BYTES = 1 << 26


@dataclass(frozen=True)
class Assembly:
    """A dataset to be written: its shard plans, the source of their rows, and the manifest without rows."""

    plans: list[ShardPlan]
    rows: RowSource
    manifest: Manifest
    mesh_folder: str | None = None
    """Folder below the dataset folder into which ``rows`` writes a PLY of each object."""

    def mesh_paths(self, rows: list[dict[str, Any]]) -> list[str]:
        """Mesh files of the objects that ``rows`` show, relative to the dataset folder."""
        if self.mesh_folder is None:
            return []
        return [f"{self.mesh_folder}/{name}.ply" for name in dict.fromkeys(row["object"] for row in rows)]

    def key(self) -> dict[str, Any]:
        """Settings that must be equal for a run to resume in this folder."""
        names = ("origin", "settings", "rig", "size", "stored", "exact", "schema_version")
        return {name: getattr(self.manifest, name) for name in names}

    def writer(self, folder: Path, scratch: Path) -> ShardWriter:
        content = self.manifest
        return ShardWriter(folder, scratch, content.sequence, content.stored, content.exact, content.size)

    def filled(self, receipts: list[Receipt]) -> Manifest:
        """The manifest with rows and shards, from the receipts of all plans in order."""
        samples: dict[str, list[dict[str, Any]]] = {}
        hashes: dict[str, dict[str, str]] = {}
        for plan, (_, rows) in zip(self.plans, receipts, strict=True):
            for row in rows:
                for column, digest in row["hashes"].items():
                    hashes.setdefault(f"{plan.split}/{column}", {})[row["sample"]] = digest
            samples.setdefault(plan.split, []).extend({k: v for k, v in row.items() if k != "hashes"} for row in rows)
        shards = [file for files, _ in receipts for file in files]
        content = {name: column_hash(images) for name, images in sorted(hashes.items())}
        return replace(self.manifest, samples=samples, shards=shards, content=content)


@dataclass(frozen=True)
class ShardWork:
    """What a process needs to write shards into ``folder``; it keeps one for all of them."""

    assembly: Assembly
    folder: Path
    scratch: Path

    @cached_property
    def writer(self) -> ShardWriter:
        return self.assembly.writer(self.folder, self.scratch)

    def write(self, plan: ShardPlan, row_done: Callable[[], None] = lambda: None) -> Receipt:
        return self.writer.write(plan, self.assembly.rows(plan, self.folder), row_done)


def assemble(
    folder: Path, assembly: Assembly, workers: int, progress: Progress = lambda rows: None, cluster: str | None = None
) -> Manifest:
    """Write or finish the dataset, and return its manifest, by so many processes or by the Ray cluster at an address,
    whose nodes must share the folder. ``progress`` is called with numbers of finished rows, first those of an
    interrupted run; not for a finished dataset. Raises `BuildError` when the folder is in use, holds other files, or
    can't be written, and `PoolError` as `mapping`."""
    try:
        with writing(folder) as scratch:
            if (folder / MANIFEST).exists():
                manifest = DatasetFolder(folder).manifest  # every file is there, in full length
                compare(folder, replace(assembly, manifest=manifest).key(), assembly.key())
                return manifest
            return _assemble(folder, scratch, assembly, workers, progress, cluster)
    except OSError as error:
        raise BuildError(
            f"{error.filename or folder}: writing failed ({cause_of(error)}); remove the cause, then run the same "
            "command again: it resumes"
        ) from error


@contextmanager
def writing(folder: Path) -> Iterator[Path]:
    """Lock a dataset folder for its single writer; yields its work folder, which is removed once the manifest is there.
    Raises `BuildError` for a folder that another process is writing, or that holds other files than a dataset."""
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


def forget_outdated(folder: Path, plans: list[ShardPlan], files: Callable[[str], Iterable[Path]]) -> None:
    """Let shards of an interrupted import be written again where a source file, of ``files`` by sample, changed after
    they were. Raises `BuildError` for a finished import of which one changed."""
    if (manifest := folder / MANIFEST).is_file():
        for path in (path for plan in plans for sample, _, _ in plan.samples for path in files(sample)):
            if _changed_after(path, manifest):
                raise BuildError(
                    f"{folder}: holds a finished import, and {path} changed after it; give another folder or delete it"
                )
    for plan in plans:
        receipt = folder / WORK_FOLDER / f"{plan.name}.json"
        sources = (path for sample, _, _ in plan.samples for path in files(sample))
        if receipt.is_file() and any(_changed_after(path, receipt) for path in sources):
            receipt.unlink()


def _changed_after(path: Path, moment: Path) -> bool:
    """Whether a file changed after the file ``moment`` was written. Unlike the modification time alone, copying or
    setting times can't reset what is compared here."""
    status = path.stat()
    return max(status.st_ctime_ns, status.st_mtime_ns) > moment.stat().st_mtime_ns


def _assemble(
    folder: Path, scratch: Path, assembly: Assembly, workers: int, progress: Progress, cluster: str | None
) -> Manifest:
    check_settings(folder, scratch, assembly)
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
    work = ShardWork(assembly, folder, scratch)
    if cluster is not None and missing:
        written = _write_on_cluster(work, missing, cluster, progress)
    elif workers > 1 and len(missing) > 1:
        written = write_in_processes(work, missing, workers, progress)
    else:
        written = ((plan, work.write(plan, lambda: progress(1))) for plan in missing)
    with closing(written):
        for plan, (files, rows) in written:
            content = {"files": [asdict(file) for file in files], "rows": rows}
            write_atomically(scratch / f"{plan.name}.json", json.dumps(content).encode())
            receipts[plan.name] = files, rows
    return _finish(folder, assembly, [receipts[plan.name] for plan in assembly.plans])


def check_settings(folder: Path | RemoteFolder, scratch: Path, assembly: Assembly) -> None:
    """Write the settings into the work folder ``scratch``, or raise `BuildError` where it holds others."""
    path = scratch / SETTINGS
    # Another version may make other bytes: its finished dataset is valid, but a dataset must not mix two versions.
    settings = {**assembly.key(), "generator": assembly.manifest.generator}
    if path.exists():
        begun = read_json(path, BuildError, f"delete {folder} and start again")
        compare(folder, begun if isinstance(begun, dict) else {}, settings)
    write_atomically(path, json.dumps(settings, indent=1).encode())


def compare(folder: Path | RemoteFolder, stored: dict[str, Any], requested: dict[str, Any]) -> None:
    """Raise `BuildError` naming the differences between the folder's settings and the requested settings."""
    stored, requested = json.loads(json.dumps(stored)), json.loads(json.dumps(requested))
    differing = []
    for key in requested:
        there, now = stored.get(key), requested[key]
        if not (isinstance(there, dict) and isinstance(now, dict)):
            there, now = {key: there}, {key: now}
        differing += [
            f"{name} (there {_short(there.get(name))}, now {_short(now.get(name))})"
            for name in sorted({*there, *now})
            if there.get(name) != now.get(name)
        ]
    if differing:
        raise BuildError(
            f"{folder}: holds a dataset with other settings: {'; '.join(differing)}. Give another folder, or delete it"
        )


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _receipt(folder: Path, scratch: Path, plan: ShardPlan) -> Receipt | None:
    """Receipt of a shard that is finished and whose files are intact, else None."""
    receipt = planned_receipt(scratch / f"{plan.name}.json", plan)
    try:
        intact = receipt and all(file_hash(folder / file.path) == file.xxh3_128 for file in receipt[0])
    except OSError:
        intact = False
    return receipt if intact else None


def planned_receipt(file: Path, plan: ShardPlan) -> Receipt | None:
    """What a receipt says; None for one that is absent, damaged or not of this plan."""
    try:
        content = read_json(file, BuildError)
        files = strictly(list[ShardFile], content["files"])
        rows = strictly(list[dict[str, Any]], content["rows"])
        for row in rows:
            check_row(row)
            strictly(dict[str, str], row["hashes"])
    except (BuildError, ValueError, KeyError, TypeError):
        return None
    labels = tuple((row["sample"], row["object"], row["view"]) for row in rows)
    named = all(entry.path == plan.path(entry.group) and entry.split == plan.split for entry in files)
    return (files, rows) if labels == plan.samples and named else None


def _check_space(folder: Path, assembly: Assembly, missing: list[ShardPlan]) -> None:
    needed = sum(len(plan.samples) for plan in missing) * assembly.manifest.row_bytes
    free = shutil.disk_usage(folder).free
    if needed + _RESERVE_BYTES > free:
        raise BuildError(
            f"{folder}: needs {needed / 1e9:.2f} GB more and the disk has {free / 1e9:.2f} GB free; free some space, "
            "choose another disk, a smaller --size or fewer --objects"
        )


def _write_on_cluster(
    work: ShardWork, plans: list[ShardPlan], cluster: str, progress: Progress
) -> Generator[tuple[ShardPlan, Receipt], None, None]:
    """Write the shards as tasks of a Ray cluster whose nodes share the folder."""
    with mapping(work, cluster=cluster) as mapped:
        for plan, receipt in zip(plans, mapped(_write_shared, plans), strict=True):
            progress(len(plan.samples))
            yield plan, receipt


def _write_shared(work: ShardWork, plan: ShardPlan) -> Receipt:
    if not (work.scratch / SETTINGS).is_file():
        raise BuildError(without_files(work.folder))
    return work.write(plan)


def without_files(folder: Path | RemoteFolder) -> str:
    """What to say where a task does not find what the command wrote."""
    node = platform.node()
    return f"{folder}: node {node} does not find the build there; give a folder that all nodes share, or a URL"


def _finish(folder: Path, assembly: Assembly, receipts: list[Receipt]) -> Manifest:
    manifest = assembly.filled(receipts)
    rows = [row for part in manifest.samples.values() for row in part]
    # Only files written here are listed: `fpp-bench verify` reports any other file in the folder as foreign.
    names = [*write_card(folder, manifest), *assembly.mesh_paths(rows)]
    manifest = replace(manifest, others=[describe_file(folder, folder / name) for name in sorted(names)])
    manifest.write(folder)
    return manifest
