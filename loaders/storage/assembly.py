"""From planned shards to a finished folder, or the same files at a URL: skip finished shards, write
the rest, then card, rig and manifest. Generated and imported datasets are written alike; only the
source of their rows differs. Each finished shard leaves a receipt in the work folder. A resumed run
trusts a receipt only when every file it names has the hash it states, or at a URL its full
length."""

import json
import platform
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Generic, TypeVar

from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.files import cause_of, check_space, exclusive, read_json, write_atomically
from fpp_ml_bench.loaders.sample import Row, column_hash
from fpp_ml_bench.loaders.storage.card import write_card
from fpp_ml_bench.loaders.storage.manifest import (
    MANIFEST,
    WORK_FOLDER,
    Manifest,
    OtherFile,
    ShardFile,
    check_row,
    damage_of,
    describe_file,
    read_manifest,
    strictly,
)
from fpp_ml_bench.loaders.storage.shards import Receipt, ShardPlan, ShardWriter
from fpp_ml_bench.pool import mapping
from fpp_ml_bench.remote import TEMPORARY, RemoteFolder

SETTINGS = "settings.json"
RowSource = Callable[[ShardPlan, Path], Iterable[Row]]
"""Makes the rows of a shard, in order, and maybe meshes in the dataset folder. Picklable; a process
calls one for all its shards, and may hold what they share in it."""
Rows = TypeVar("Rows", bound=RowSource, covariant=True)
Progress = Callable[[int], None]
_RESERVE_BYTES = 1 << 26


@dataclass(frozen=True)
class Assembly(Generic[Rows]):
    """A dataset to be written: its shard plans, the source of their rows, and the manifest without
    rows."""

    plans: list[ShardPlan]
    rows: Rows
    manifest: Manifest
    mesh_folder: str | None = None
    """Folder below the dataset folder into which ``rows`` writes a PLY of each object."""

    def mesh_paths(self, rows: list[dict[str, Any]]) -> list[str]:
        """Mesh files of the objects that ``rows`` show, relative to the dataset folder."""
        if self.mesh_folder is None:
            return []
        return [
            f"{self.mesh_folder}/{name}.ply"
            for name in dict.fromkeys(row["object"] for row in rows)
        ]

    def filled(self, receipts: list[Receipt]) -> Manifest:
        """The manifest with rows and shards, from the receipts of all plans in order."""
        samples: dict[str, list[dict[str, Any]]] = {}
        hashes: dict[str, dict[str, str]] = {}
        for plan, receipt in zip(self.plans, receipts, strict=True):
            for row in receipt.rows:
                for column, digest in row["hashes"].items():
                    hashes.setdefault(f"{plan.split}/{column}", {})[row["sample"]] = digest
                labels = {key: value for key, value in row.items() if key != "hashes"}
                samples.setdefault(plan.split, []).append(labels)
        shards = [file for receipt in receipts for file in receipt.files]
        content = {name: column_hash(images) for name, images in sorted(hashes.items())}
        return replace(self.manifest, samples=samples, shards=shards, content=content)


@dataclass(frozen=True)
class ShardWork:
    """What a process needs to write shards into a folder or to a URL; it keeps one for all of
    them."""

    assembly: Assembly
    place: Path | RemoteFolder

    @cached_property
    def _writer(self) -> ShardWriter:
        return ShardWriter(self.assembly.manifest)

    def write(self, plan: ShardPlan, row_done: Callable[[], None] = lambda: None) -> Receipt:
        """Write a shard, and last its receipt. Where it goes to a URL, all is written in a scratch
        folder first."""
        place, started = self.place, f"{WORK_FOLDER}/{SETTINGS}"
        if not (
            place.has(started) if isinstance(place, RemoteFolder) else (place / started).is_file()
        ):
            raise BuildError(
                f"{place}: node {platform.node()} does not find the build there; give a folder "
                f"that all nodes share, "
                "or a URL"
            )
        with (
            TemporaryDirectory(prefix="fpp-bench-")
            if isinstance(place, RemoteFolder)
            else nullcontext(place) as at
        ):
            folder, name = Path(at), _receipt_name(plan)
            receipt = self._writer.write(folder, plan, self.assembly.rows(plan, folder), row_done)
            meshes = [
                describe_file(folder, folder / path)
                for path in self.assembly.mesh_paths(receipt.rows)
            ]
            receipt = replace(receipt, meshes=meshes)
            (folder / WORK_FOLDER).mkdir(exist_ok=True)
            write_atomically(folder / name, json.dumps(asdict(receipt)).encode())
            if isinstance(place, RemoteFolder):
                for path in (*(file.path for file in receipt.written), name):
                    place.put(folder / path, path)
        return receipt


def assemble(
    place: Path | RemoteFolder,
    assembly: Assembly,
    workers: int = 1,
    progress: Progress = lambda rows: None,
    cluster: str | None = None,
) -> Manifest:
    """Write or finish the dataset in a folder or at a URL, and return its manifest, by so many
    processes or by the Ray cluster at an address, whose nodes must share the folder. ``progress``
    is called with numbers of finished rows, first those of an interrupted run; not for a finished
    dataset. The manifest comes last. Nothing keeps a second run from the same URL; it would write
    the same files.

    Raises `BuildError` when the folder is in use, holds other files or settings, or can't be
    written, `RemoteError` when the URL can't be read or written, and `PoolError` as `mapping`."""
    try:
        with _writing(place) as (folder, size_of):
            if (folder / MANIFEST).exists():
                manifest = read_manifest(folder)
                if cut := next(
                    (file.path for file in manifest.files if size_of(file.path) < file.bytes), None
                ):
                    raise BuildError(
                        f"{place}: {cut} is missing or cut off; remove all there, and build again"
                    )
                _compare(place, _key(manifest), _key(assembly.manifest))
                return manifest
            _check_settings(place, folder / WORK_FOLDER, assembly.manifest)

            def whole(file: ShardFile | OtherFile) -> bool:
                if isinstance(place, RemoteFolder):
                    return size_of(file.path) == file.bytes
                return damage_of(folder, file) is None

            written = {
                plan.name: planned_receipt(folder / _receipt_name(plan), plan)
                for plan in assembly.plans
            }
            for name, receipt in written.items():
                if receipt is not None and not all(map(whole, receipt.written)):
                    written[name] = None
            missing = [plan for plan in assembly.plans if written[plan.name] is None]
            if isinstance(place, Path):
                needed = assembly.manifest.row_bytes * sum(len(plan.samples) for plan in missing)
                check_space(
                    {place: needed + _RESERVE_BYTES},
                    "the dataset needs",
                    ", a smaller --size or fewer --objects",
                )
            progress(
                sum(len(plan.samples) for plan in assembly.plans if written[plan.name] is not None)
            )
            _write_shards(ShardWork(assembly, place), missing, written, workers, cluster, progress)
            return _finish(
                place,
                folder,
                assembly,
                [receipt for receipt in written.values() if receipt is not None],
            )
    except OSError as error:
        raise BuildError(
            f"{error.filename or place}: writing failed ({cause_of(error)}); remove the cause, "
            f"then run the same "
            "command again: it resumes"
        ) from error


def _receipt_name(plan: ShardPlan) -> str:
    return f"{WORK_FOLDER}/{plan.name}.json"


@contextmanager
def _writing(place: Path | RemoteFolder) -> Iterator[tuple[Path, Callable[[str], int]]]:
    """The folder for manifest, card, settings and receipts, and the size of a file at ``place``, -1
    for none. A local folder is ``place`` itself, locked for its single writer; that of a URL holds
    a copy of what is there of them. What killed runs left is removed, and the work folder once the
    manifest is there. Raises `BuildError` for a folder that another process is writing, and for
    other files than those of a dataset."""
    if isinstance(place, RemoteFolder):
        with TemporaryDirectory(prefix="fpp-bench-") as temporary:
            folder, sizes = Path(temporary), place.sizes()
            known = [
                name for name in sizes if name == MANIFEST or name.startswith(f"{WORK_FOLDER}/")
            ]
            if sizes and not known:
                raise BuildError(f"{place}: holds other files and no dataset; give another URL")
            for name in sizes:
                if (
                    name.endswith(TEMPORARY) and MANIFEST not in sizes
                ):  # of a task that was killed while copying
                    place.remove(name)
                elif name in known:
                    place.get(name, folder / name)
            yield folder, lambda name: sizes.get(name, -1)
            if (folder / MANIFEST).exists() and place.has(WORK_FOLDER):
                place.remove(WORK_FOLDER)
        return
    work = place / WORK_FOLDER
    if (
        place.is_dir()
        and not (place / MANIFEST).exists()
        and not work.exists()
        and any(place.iterdir())
    ):
        raise BuildError(f"{place}: holds other files and no dataset; give a new or empty folder")
    with exclusive(work / "lock", place, "writing this folder"):
        if not (place / MANIFEST).exists():
            for leftover in place.rglob(".*.tmp"):  # of a run that was killed while writing
                leftover.unlink()
        try:
            yield (
                place,
                lambda name: (place / name).stat().st_size if (place / name).is_file() else -1,
            )
        finally:
            if (place / MANIFEST).exists():
                shutil.rmtree(work, ignore_errors=True)


def _write_shards(
    work: ShardWork,
    missing: list[ShardPlan],
    written: dict[str, Receipt | None],
    workers: int,
    cluster: str | None,
    progress: Progress,
) -> None:
    """Write the shards ``missing``, and put their receipts into ``written``."""
    workers, cluster = min(workers, max(1, len(missing))), cluster if missing else None
    if workers == 1 and cluster is None and isinstance(work.place, Path):
        for plan in missing:
            written[plan.name] = work.write(plan, lambda: progress(1))
        return
    missing = sorted(
        missing, key=lambda plan: -len(plan.samples)
    )  # no worker is left with a long shard at the end
    with mapping(work, workers, cluster) as mapped:
        for plan, receipt in zip(missing, mapped(ShardWork.write, missing), strict=True):
            written[plan.name] = receipt
            progress(len(plan.samples))


def _finish(
    place: Path | RemoteFolder, folder: Path, assembly: Assembly, receipts: list[Receipt]
) -> Manifest:
    """Write card and manifest."""
    manifest = assembly.filled(receipts)
    # Only files written here are listed: `fpp-bench verify` reports any other file in the folder as
    # foreign.
    names = write_card(folder, manifest)
    others = {mesh.path: mesh for receipt in receipts for mesh in receipt.meshes}
    others |= {name: describe_file(folder, folder / name) for name in names}
    manifest = replace(manifest, others=[others[path] for path in sorted(others)])
    manifest.write(folder)
    if isinstance(place, RemoteFolder):
        for name in (*names, MANIFEST):
            place.put(folder / name, name)
    return manifest


def forget_outdated(
    folder: Path, plans: list[ShardPlan], files: Callable[[str], Iterable[Path]]
) -> None:
    """Let shards of an interrupted import be written again where a source file, of ``files`` by
    sample, changed after they were. Raises `BuildError` for a finished import of which one
    changed."""
    if (manifest := folder / MANIFEST).is_file():
        for path in (
            path for plan in plans for sample, _, _ in plan.samples for path in files(sample)
        ):
            if _changed_after(path, manifest):
                raise BuildError(
                    f"{folder}: holds a finished import, and {path} changed after it; give another "
                    f"folder or delete it"
                )
    for plan in plans:
        receipt = folder / _receipt_name(plan)
        sources = (path for sample, _, _ in plan.samples for path in files(sample))
        if receipt.is_file() and any(_changed_after(path, receipt) for path in sources):
            receipt.unlink()


def _changed_after(path: Path, moment: Path) -> bool:
    """Whether a file changed after the file ``moment`` was written. Unlike the modification time
    alone, copying or setting times can't reset what is compared here."""
    status = path.stat()
    return max(status.st_ctime_ns, status.st_mtime_ns) > moment.stat().st_mtime_ns


def _key(manifest: Manifest) -> dict[str, Any]:
    """Settings that must be equal for a run to resume."""
    names = ("origin", "settings", "rig", "size", "stored", "exact", "schema_version")
    return {name: getattr(manifest, name) for name in names}


def _check_settings(place: Path | RemoteFolder, work: Path, manifest: Manifest) -> None:
    """Write the settings into the work folder, or raise `BuildError` where it holds others."""
    path = work / SETTINGS
    # Another version may make other bytes: its finished dataset is valid, but a dataset must not
    # mix two versions.
    settings = {**_key(manifest), "generator": manifest.generator}
    if path.exists():
        begun = read_json(path, BuildError, f"delete {place} and start again")
        _compare(place, begun if isinstance(begun, dict) else {}, settings)
    work.mkdir(exist_ok=True)
    write_atomically(path, json.dumps(settings, indent=1).encode())
    if isinstance(place, RemoteFolder):
        place.put(path, f"{WORK_FOLDER}/{SETTINGS}")


def _compare(
    folder: Path | RemoteFolder, stored: dict[str, Any], requested: dict[str, Any]
) -> None:
    """Raise `BuildError` naming the differences between the folder's settings and the requested
    settings."""
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
            f"{folder}: holds a dataset with other settings: {'; '.join(differing)}. Give another "
            f"folder, or delete it"
        )


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."


def planned_receipt(file: Path, plan: ShardPlan) -> Receipt | None:
    """What a receipt says; None for one that is absent, damaged or not of this plan."""
    try:
        receipt = strictly(Receipt, read_json(file, BuildError))
        for row in receipt.rows:
            check_row(row)
            strictly(dict[str, str], row["hashes"])
    except (BuildError, ValueError, KeyError):
        return None
    labels = tuple((row["sample"], row["object"], row["view"]) for row in receipt.rows)
    named = all(
        file.path == plan.path(file.group) and file.split == plan.split for file in receipt.files
    )
    return receipt if labels == plan.samples and named else None
