"""From planned shards to a finished folder, or the same files at a URL: skip finished shards, write the rest, then
card, rig and manifest. Generated and imported datasets are written alike; only the source of their rows differs. Each
finished shard leaves a receipt in the work folder. A resumed run trusts a receipt only when every file it names has the
hash it states, or at a URL its full length."""

import json
import platform
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.files import cause_of, exclusive, file_hash, read_json, write_atomically
from fpp_ml_bench.loaders.sample import Row, column_hash
from fpp_ml_bench.loaders.storage.card import write_card
from fpp_ml_bench.loaders.storage.manifest import (
    MANIFEST,
    WORK_FOLDER,
    Manifest,
    OtherFile,
    ShardFile,
    check_row,
    describe_file,
    read_manifest,
    strictly,
)
from fpp_ml_bench.loaders.storage.shards import Receipt, ShardPlan, ShardWriter
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.pool import mapping
from fpp_ml_bench.remote import TEMPORARY, RemoteFolder

SETTINGS = "settings.json"
RowSource = Callable[[ShardPlan, Path], Iterable[Row]]
"""Makes the rows of a shard, in order, and maybe meshes in the dataset folder. Picklable; a process calls one for all
its shards, and may hold what they share in it."""
Progress = Callable[[int], None]
Written = tuple[Receipt, list[OtherFile]]
"""Receipt of a shard, and the meshes of its objects."""
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
    """What a process needs to write shards into a folder or to a URL; it keeps one for all of them."""

    assembly: Assembly
    place: Path | RemoteFolder

    @cached_property
    def _writer(self) -> ShardWriter:
        assert isinstance(self.place, Path)
        return self.assembly.writer(self.place, self.place / WORK_FOLDER)

    def write(self, plan: ShardPlan, row_done: Callable[[], None] = lambda: None) -> Written:
        """Write a shard, and last its receipt. Where it goes to a URL, all is written in a scratch folder first."""
        if isinstance(self.place, Path):
            if not (self.place / WORK_FOLDER / SETTINGS).is_file():
                raise BuildError(self._without_files())
            return self._write(self._writer, self.place, self.place / WORK_FOLDER, plan, row_done)
        if not self.place.has(f"{WORK_FOLDER}/{SETTINGS}"):
            raise BuildError(self._without_files())
        with TemporaryDirectory(prefix="fpp-bench-") as temporary:
            folder = Path(temporary)
            writer = self.assembly.writer(folder, folder)
            (files, rows), meshes = self._write(writer, folder, folder, plan, row_done)
            for name in [file.path for file in files] + [mesh.path for mesh in meshes]:
                self.place.put(folder / name, name)
            self.place.put(folder / f"{plan.name}.json", f"{WORK_FOLDER}/{plan.name}.json")
        return (files, rows), meshes

    def _write(
        self, writer: ShardWriter, folder: Path, scratch: Path, plan: ShardPlan, row_done: Callable[[], None]
    ) -> Written:
        files, rows = writer.write(plan, self.assembly.rows(plan, folder), row_done)
        meshes = [describe_file(folder, folder / name) for name in self.assembly.mesh_paths(rows)]
        content: dict[str, Any] = {"files": [asdict(file) for file in files], "rows": rows}
        content["meshes"] = [asdict(mesh) for mesh in meshes]
        write_atomically(scratch / f"{plan.name}.json", json.dumps(content).encode())
        return (files, rows), meshes

    def _without_files(self) -> str:
        node = platform.node()
        return f"{self.place}: node {node} does not find the build there; give a folder that all nodes share, or a URL"


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
                _compare(folder, replace(assembly, manifest=manifest).key(), assembly.key())
                return manifest
            _check_settings(folder, scratch, assembly)
            for leftover in (*scratch.glob("*.tmp"), *folder.rglob(".*.tmp")):  # of a run that was killed while writing
                leftover.unlink(missing_ok=True)  # the two patterns overlap

            def whole(file: ShardFile | OtherFile) -> bool:
                try:
                    return file_hash(folder / file.path) == file.xxh3_128
                except OSError:
                    return False

            written = {plan.name: _intact(scratch, plan, whole) for plan in assembly.plans}
            _check_space(folder, assembly, [plan for plan in assembly.plans if written[plan.name] is None])
            _write_missing(ShardWork(assembly, folder), written, workers, cluster, progress)
            return _finish(folder, assembly, written)[0]
    except OSError as error:
        raise BuildError(
            f"{error.filename or folder}: writing failed ({cause_of(error)}); remove the cause, then run the same "
            "command again: it resumes"
        ) from error


def assemble_remote(
    remote: RemoteFolder,
    assembly: Assembly,
    workers: int = 1,
    cluster: str | None = None,
    progress: Progress = lambda rows: None,
) -> Manifest:
    """Write or finish the dataset at a URL by the processes that `mapping` takes, and return its manifest. ``progress``
    is called as by `assemble`. Nothing keeps a second run from the same URL; it would write the same files. A resumed
    run trusts a receipt when every file it names is there in full length. The manifest comes last.

    Raises `BuildError` when the URL holds other files or settings, `RemoteError` when it can't be read or written, and
    `PoolError`."""
    with TemporaryDirectory(prefix="fpp-bench-") as temporary:
        folder, sizes = Path(temporary), remote.sizes()
        begun = {name for name in sizes if name.startswith(f"{WORK_FOLDER}/")}
        if MANIFEST in sizes:
            remote.get(MANIFEST, folder / MANIFEST)
            manifest = read_manifest(folder)
            damaged = [file.path for file in manifest.files if sizes.get(file.path) != file.bytes]
            if damaged:
                raise BuildError(f"{remote}: {damaged[0]} is missing or cut off; remove all there, and build again")
            _compare(remote, replace(assembly, manifest=manifest).key(), assembly.key())
            if begun:  # stopped between the manifest and the end
                remote.remove(WORK_FOLDER)
            return manifest
        if sizes and not begun:
            raise BuildError(f"{remote}: holds other files and no dataset; give another URL")
        for name in sizes:
            if name.endswith(TEMPORARY):  # of a task that was killed while copying
                remote.remove(name)
            elif name in begun:
                remote.get(name, folder / name)
        scratch = folder / WORK_FOLDER
        scratch.mkdir(exist_ok=True)
        _check_settings(remote, scratch, assembly)
        remote.put(scratch / SETTINGS, f"{WORK_FOLDER}/{SETTINGS}")
        written = {
            plan.name: _intact(scratch, plan, lambda file: sizes.get(file.path) == file.bytes)
            for plan in assembly.plans
        }
        _write_missing(ShardWork(assembly, remote), written, workers, cluster, progress)
        for split in {plan.split for plan in assembly.plans}:
            (folder / split).mkdir()
        manifest, names = _finish(folder, assembly, written)
        for name in (*names, MANIFEST):
            remote.put(folder / name, name)
        remote.remove(WORK_FOLDER)
        return manifest


def _intact(scratch: Path, plan: ShardPlan, whole: Callable[[ShardFile | OtherFile], bool]) -> Written | None:
    """What was written of a shard by its receipt, if every file is ``whole``, else None."""
    written = planned_receipt(scratch / f"{plan.name}.json", plan)
    if written is None:
        return None
    files: list[ShardFile | OtherFile] = [*written[0][0], *written[1]]
    return written if all(map(whole, files)) else None


def _write_missing(
    work: ShardWork, written: dict[str, Written | None], workers: int, cluster: str | None, progress: Progress
) -> None:
    """Write the shards whose entry in ``written`` is None, and fill it."""
    plans = work.assembly.plans
    missing = [plan for plan in plans if written[plan.name] is None]
    progress(sum(len(plan.samples) for plan in plans if written[plan.name] is not None))
    workers, cluster = min(workers, max(1, len(missing))), cluster if missing else None
    if workers == 1 and cluster is None and isinstance(work.place, Path):
        for plan in missing:
            written[plan.name] = work.write(plan, lambda: progress(1))
        return
    missing.sort(key=lambda plan: -len(plan.samples))  # so that no worker is left with a long shard at the end
    with mapping(work, workers, cluster) as mapped:
        for plan, done in zip(missing, mapped(ShardWork.write, missing), strict=True):
            written[plan.name] = done
            progress(len(plan.samples))


def _finish(folder: Path, assembly: Assembly, written: Mapping[str, Written | None]) -> tuple[Manifest, list[str]]:
    """Write card and manifest into ``folder``; the manifest, and the names of the files beside it."""
    whole = [done for done in written.values() if done is not None]
    manifest = assembly.filled([receipt for receipt, _ in whole])
    # Only files written here are listed: `fpp-bench verify` reports any other file in the folder as foreign.
    names = write_card(folder, manifest)
    others = {mesh.path: mesh for _, meshes in whole for mesh in meshes}
    others |= {name: describe_file(folder, folder / name) for name in names}
    manifest = replace(manifest, others=[others[path] for path in sorted(others)])
    manifest.write(folder)
    return manifest, names


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


def _check_settings(folder: Path | RemoteFolder, scratch: Path, assembly: Assembly) -> None:
    """Write the settings into the work folder ``scratch``, or raise `BuildError` where it holds others."""
    path = scratch / SETTINGS
    # Another version may make other bytes: its finished dataset is valid, but a dataset must not mix two versions.
    settings = {**assembly.key(), "generator": assembly.manifest.generator}
    if path.exists():
        begun = read_json(path, BuildError, f"delete {folder} and start again")
        _compare(folder, begun if isinstance(begun, dict) else {}, settings)
    write_atomically(path, json.dumps(settings, indent=1).encode())


def _compare(folder: Path | RemoteFolder, stored: dict[str, Any], requested: dict[str, Any]) -> None:
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


def planned_receipt(file: Path, plan: ShardPlan) -> Written | None:
    """What a receipt says; None for one that is absent, damaged or not of this plan."""
    try:
        content = read_json(file, BuildError)
        files = strictly(list[ShardFile], content["files"])
        meshes = strictly(list[OtherFile], content["meshes"])
        rows = strictly(list[dict[str, Any]], content["rows"])
        for row in rows:
            check_row(row)
            strictly(dict[str, str], row["hashes"])
    except (BuildError, ValueError, KeyError, TypeError):
        return None
    labels = tuple((row["sample"], row["object"], row["view"]) for row in rows)
    named = all(entry.path == plan.path(entry.group) and entry.split == plan.split for entry in files)
    return ((files, rows), meshes) if labels == plan.samples and named else None


def _check_space(folder: Path, assembly: Assembly, missing: list[ShardPlan]) -> None:
    needed = sum(len(plan.samples) for plan in missing) * assembly.manifest.row_bytes
    free = shutil.disk_usage(folder).free
    if needed + _RESERVE_BYTES > free:
        raise BuildError(
            f"{folder}: needs {needed / 1e9:.2f} GB more and the disk has {free / 1e9:.2f} GB free; free some space, "
            "choose another disk, a smaller --size or fewer --objects"
        )
