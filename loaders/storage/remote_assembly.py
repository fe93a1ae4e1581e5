"""From planned shards to a finished dataset at a URL: the counterpart of `assemble`, with the same files.

Each task writes its shard in a scratch folder of its machine, copies the files to the URL, and last a receipt that
names them. A resumed run trusts a receipt when every file it names is there in full length. The manifest comes last.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.files import read_json, write_atomically
from fpp_ml_bench.loaders.storage.assembly import (
    SETTINGS,
    Assembly,
    Progress,
    ShardWork,
    check_settings,
    compare,
    planned_receipt,
    without_files,
)
from fpp_ml_bench.loaders.storage.card import write_card
from fpp_ml_bench.loaders.storage.manifest import (
    MANIFEST,
    WORK_FOLDER,
    Manifest,
    OtherFile,
    ShardFile,
    describe_file,
    read_manifest,
    strictly,
)
from fpp_ml_bench.loaders.storage.shards import Receipt, ShardPlan
from fpp_ml_bench.pool import mapping
from fpp_ml_bench.remote import TEMPORARY, RemoteFolder

Written = tuple[Receipt, list[OtherFile]]
"""Receipt of a shard, and the meshes of its objects."""


def assemble_remote(
    remote: RemoteFolder,
    assembly: Assembly,
    workers: int = 1,
    cluster: str | None = None,
    progress: Progress = lambda rows: None,
) -> Manifest:
    """Write or finish the dataset at a URL by the processes that `mapping` takes, and return its manifest. ``progress``
    is called as by `assemble`. Nothing keeps a second run from the same URL; it would write the same files.

    Raises `BuildError` when the URL holds other files or settings, `RemoteError` when it can't be read or written, and
    `PoolError`."""
    with TemporaryDirectory(prefix="fpp-bench-") as temporary:
        folder, sizes = Path(temporary), remote.sizes()
        begun = {name for name in sizes if name.startswith(f"{WORK_FOLDER}/")}
        if MANIFEST in sizes:
            manifest = _finished(remote, assembly, folder, sizes)
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
        check_settings(remote, scratch, assembly)
        remote.put(scratch / SETTINGS, f"{WORK_FOLDER}/{SETTINGS}")
        written = {plan.name: _read(scratch / f"{plan.name}.json", plan, sizes) for plan in assembly.plans}
        missing = [plan for plan in assembly.plans if written[plan.name] is None]
        progress(sum(len(plan.samples) for plan in assembly.plans if written[plan.name] is not None))
        workers, cluster = min(workers, max(1, len(missing))), cluster if missing else None
        with mapping(RemoteWork(assembly, remote), workers, cluster) as mapped:
            for plan, receipt in zip(missing, mapped(_write_shard, missing), strict=True):
                written[plan.name] = receipt
                progress(len(plan.samples))
        return _finish(remote, assembly, folder, [receipt for receipt in written.values() if receipt is not None])


def _finished(remote: RemoteFolder, assembly: Assembly, folder: Path, sizes: Mapping[str, int]) -> Manifest:
    """The manifest of a finished dataset. Raises `BuildError` for one of other settings, or with a missing file."""
    remote.get(MANIFEST, folder / MANIFEST)
    manifest = read_manifest(folder)
    damaged = [file.path for file in manifest.files if sizes.get(file.path) != file.bytes]
    if damaged:
        raise BuildError(f"{remote}: {damaged[0]} is missing or cut off; remove all there, and build again")
    compare(remote, replace(assembly, manifest=manifest).key(), assembly.key())
    return manifest


def _read(file: Path, plan: ShardPlan, sizes: Mapping[str, int]) -> Written | None:
    """What a finished task wrote, all of it there in full length; None otherwise."""
    receipt = planned_receipt(file, plan)
    if receipt is None:
        return None
    try:
        meshes = strictly(list[OtherFile], read_json(file, BuildError)["meshes"])
    except (ValueError, KeyError):
        return None
    files: list[ShardFile | OtherFile] = [*receipt[0], *meshes]
    whole = all(sizes.get(file.path) == file.bytes for file in files)
    return (receipt, meshes) if whole else None


@dataclass(frozen=True)
class RemoteWork:
    """What a task needs to write a shard of a remote dataset; a process keeps one for all its shards."""

    assembly: Assembly
    remote: RemoteFolder


def _write_shard(work: RemoteWork, plan: ShardPlan) -> Written:
    """Write a shard in a scratch folder and copy it to the URL."""
    if not work.remote.has(f"{WORK_FOLDER}/{SETTINGS}"):
        raise BuildError(without_files(work.remote))
    with TemporaryDirectory(prefix="fpp-bench-") as temporary:
        folder = Path(temporary)
        files, rows = ShardWork(work.assembly, folder, folder).write(plan)
        meshes = [describe_file(folder, folder / name) for name in work.assembly.mesh_paths(rows)]
        for name in [file.path for file in files] + [mesh.path for mesh in meshes]:
            work.remote.put(folder / name, name)
        content: dict[str, Any] = {"files": files, "meshes": meshes}
        content = {name: [asdict(entry) for entry in entries] for name, entries in content.items()} | {"rows": rows}
        receipt = folder / f"{plan.name}.json"
        write_atomically(receipt, json.dumps(content).encode())
        work.remote.put(receipt, f"{WORK_FOLDER}/{receipt.name}")
    return (files, rows), meshes


def _finish(remote: RemoteFolder, assembly: Assembly, folder: Path, written: list[Written]) -> Manifest:
    manifest = assembly.filled([receipt for receipt, _ in written])
    for split in manifest.samples:
        (folder / split).mkdir()
    names = write_card(folder, manifest)
    others = {mesh.path: mesh for _, meshes in written for mesh in meshes}
    others |= {name: describe_file(folder, folder / name) for name in names}
    manifest = replace(manifest, others=[others[path] for path in sorted(others)])
    manifest.write(folder)
    for name in (*names, MANIFEST):
        remote.put(folder / name, name)
    remote.remove(WORK_FOLDER)
    return manifest
