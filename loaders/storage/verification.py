"""Proving a dataset intact and its splits clean. Every finding is a sentence that names the file or
sample."""

from collections.abc import Callable
from itertools import accumulate
from pathlib import Path

import pyarrow as pa

from fpp_ml_bench.constants import OBJECTS, UNSEEN, VIEWS, sample_name, split_of
from fpp_ml_bench.depth import depth_problem, depth_range_mm
from fpp_ml_bench.errors import DatasetError
from fpp_ml_bench.loaders.sample import (
    DATA_GROUP,
    DEPTH,
    DEPTHS,
    FLAGS,
    LABELS,
    PIXEL_MAPS,
    RANGE,
    Flag,
    image_hash,
    labels_of,
)
from fpp_ml_bench.loaders.storage.manifest import (
    CAPTURED,
    GENERATED,
    MANIFEST,
    WORK_FOLDER,
    Manifest,
    ShardFile,
    damage_of,
)
from fpp_ml_bench.loaders.storage.shards import arrow_schema
from fpp_ml_bench.loaders.storage.store import DatasetFolder, stored_types

Hashes = dict[tuple[str, str], dict[str, str]]
"""Of every image, by split and column and then by sample."""


def verify(folder: Path, progress: Callable[[int], None] = lambda files: None) -> list[str]:
    """Findings of a complete check of a dataset folder; an empty list means intact.

    Checks: every file of the manifest is there with its checksum; no foreign file; every Arrow file
    holds the rows and columns it should; labels and depth ranges agree with the images; depths are
    finite and not negative; no object is in two splits, none lacks a view, the benchmark's own
    objects are in their split; no image appears in two splits. Raises ``DatasetError`` when there
    is no readable manifest. ``progress`` is called with 1 for each file."""
    opened = DatasetFolder(folder, check=False)
    manifest = opened.manifest
    findings = _foreign_files(folder, manifest)
    hashes, uniform = Hashes(), set[str]()
    for file in manifest.files:
        if damage := damage_of(folder, file):
            findings.append(damage)
        elif isinstance(file, ShardFile):
            # Straight after its checksum the file is still in the page cache, so looking inside
            # costs no second read.
            try:
                findings += _shard_findings(opened, file, hashes, uniform)
            except DatasetError as error:  # no Arrow file, or images of another size
                findings.append(str(error))
        progress(1)
    findings += (
        _coverage_findings(manifest)
        + _split_findings(manifest)
        + _duplicate_images(hashes, uniform)
    )
    return findings or _content_findings(opened, hashes)


def _foreign_files(folder: Path, manifest: Manifest) -> list[str]:
    """Files that the manifest does not know; the caches that ``datasets`` itself leaves there are
    not counted."""
    listed = {MANIFEST, *(file.path for file in manifest.files)}
    findings = []
    for path in sorted(folder.rglob("*")):
        relative = path.relative_to(folder)
        if WORK_FOLDER in relative.parts or not (path.is_file() or path.is_symlink()):
            continue
        if relative.as_posix() not in listed and not path.name.startswith("cache-"):
            findings.append(f"{path}: is not part of this dataset; remove it")
    return findings


def _shard_findings(
    opened: DatasetFolder, shard: ShardFile, hashes: Hashes, uniform: set[str]
) -> list[str]:
    """Look inside one intact file: rows, columns, labels, values. Notes every image's hash, and in
    ``uniform`` those of images of a single value, which (black without noise) say nothing about
    what they show."""
    path = opened.path / shard.path
    manifest = opened.manifest
    rows = manifest.samples.get(shard.split, [])[shard.first_row : shard.first_row + shard.rows]
    if len(rows) != shard.rows:
        return [f"{path}: the manifest has no such rows"]
    expected = manifest.columns(shard.group)
    file = opened.opened(shard)
    if (
        file.types != stored_types(arrow_schema(manifest.features(shard.group)))
        or file.rows != shard.rows
    ):
        return [f"{path}: its rows or columns are not those the manifest says"]
    findings = []
    if shard.group == DATA_GROUP:
        named = {name: file.column(name, 0, file.rows) for name in (*LABELS, *RANGE)}
        stored = pa.table(named).to_pylist()
        wanted = [labels_of(row, shard.split) for row in rows]
        pairs = zip(wanted, stored, strict=True)
        findings += [
            f"{path}: expected labels {row}, found {labels}"
            for row, labels in pairs
            if labels != row
        ]
    for column in expected:
        if column in (*LABELS, *RANGE):
            continue
        for number, row in enumerate(rows):
            image = file.image(column, number)
            problem = depth_problem(image) if column in DEPTHS else None
            if (
                column == DEPTH
                and not problem
                and depth_range_mm(image) != (row["depth_min_mm"], row["depth_max_mm"])
            ):
                problem = "depth_min and depth_max do not fit its depth"
            if column == FLAGS and image.max() > sum(Flag):
                problem = "unknown flags"
            if problem:
                findings.append(f"{path}: sample {row['sample']!r}, column {column}: {problem}")
            digest = hashes.setdefault((shard.split, column), {})[row["sample"]] = image_hash(image)
            if image.min() == image.max():
                uniform.add(digest)
    opened.forget(shard)
    return findings


def _coverage_findings(manifest: Manifest) -> list[str]:
    """Rows that no file holds, or more than one: every group's files must follow on from each
    other."""
    findings = []
    for split, rows in manifest.samples.items():
        for group in manifest.groups:
            files = [
                shard for shard in manifest.shards if (shard.split, shard.group) == (split, group)
            ]
            ends = list(accumulate((shard.rows for shard in files), initial=0))
            if ends[-1] != len(rows) or ends[:-1] != [shard.first_row for shard in files]:
                findings.append(
                    f"{split}, {group}: the files hold {ends[-1]} rows, expected each of "
                    f"{len(rows)} once"
                )
    return findings


def _split_findings(manifest: Manifest) -> list[str]:
    """Rules of the split by object, checked on the manifest's rows."""
    findings = []
    home: dict[str, str] = {}
    for split, rows in manifest.samples.items():
        views: dict[str, list[str]] = {}
        for row in rows:
            name, view = row["object"], row["view"]
            views.setdefault(name, []).append(view)
            if row["sample"] != sample_name(name, view):
                findings.append(
                    f"sample {row['sample']!r} in {split}: said to be view {view} of {name!r}"
                )
        for name, seen in views.items():
            if home.setdefault(name, split) != split:
                findings.append(
                    f"object {name!r} is in two splits, {home[name]} and {split}: scores would leak"
                )
            stated = manifest.settings.get("views", VIEWS)
            expected_views = set(seen) if manifest.origin == CAPTURED else stated
            if sorted(seen) != sorted(expected_views):
                expected, actual = ", ".join(expected_views), ", ".join(seen)
                findings.append(
                    f"object {name!r} in {split}: expected the views {expected}, found {actual}"
                )
            if (
                manifest.origin == GENERATED
                and name in (*OBJECTS, *UNSEEN)
                and split_of(name) != split
            ):
                findings.append(
                    f"object {name!r} is in {split}, the benchmark has it in {split_of(name)}"
                )
    return findings


def _content_findings(opened: DatasetFolder, hashes: Hashes) -> list[str]:
    """Columns whose images are not those that the manifest was written for, and so maybe no
    benchmark's."""
    findings = []
    for (split, column), images in hashes.items():
        try:
            opened.content_hash(split, column, images)
        except DatasetError as error:
            findings.append(str(error))
    named = {f"{split}/{column}" for split, column in hashes}
    return findings + [
        f"{opened.path}: {name} is in {MANIFEST} only"
        for name in opened.content
        if name not in named
    ]


def _duplicate_images(hashes: Hashes, uniform: set[str]) -> list[str]:
    """Images that stand in more than one split, by the hash of their pixels."""
    findings, places = [], dict[str, list[tuple[str, str, str]]]()
    for (split, column), images in hashes.items():
        for sample, digest in images.items():
            if column not in PIXEL_MAPS and digest not in uniform:
                places.setdefault(digest, []).append((split, sample, column))
    for copies in places.values():
        if len({split for split, _, _ in copies}) > 1:
            named = ", ".join(f"{split}/{sample} {column}" for split, sample, column in copies[:4])
            findings.append(f"the same image stands in two splits: {named}")
    return findings
