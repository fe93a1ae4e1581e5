"""``manifest.json``: what a finished dataset folder holds, with a checksum for every file. It is
written last, so a folder without one is a build that was interrupted. It holds nothing that differs
between two builds of the same settings: no date, no path, no machine."""

import json
import re
from collections import Counter
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

from fpp_ml_bench.constants import (
    OBJECT_NAME,
    REPOSITORY_NAME,
    SAMPLE_NAME,
    SCHEMA_VERSION,
    SPLITS,
    VIEW_NAME,
)
from fpp_ml_bench.errors import DatasetError
from fpp_ml_bench.files import (
    file_hash,
    is_file,
    path_problem,
    printable,
    read_json,
    text_problem,
    write_atomically,
)
from fpp_ml_bench.loaders.sample import (
    DATA_GROUP,
    available_configs,
    features,
    row_columns,
    stored_frames,
    stored_groups,
)
from fpp_ml_bench.optics.rig_file import rig_from_dict
from fpp_ml_bench.optics.sequence import AnySequence

MANIFEST = "manifest.json"
WORK_FOLDER = ".build"
MESH_FOLDER = "meshes"
GENERATED = "generated"
"""`Manifest.origin` of a dataset that the builder made."""
CAPTURED = "captured"
"""That of a dataset decoded from a scanner's captures; objects have any views."""
_LOCAL = "data"
"""Folder of the datasets in all examples: data/mini that is not there is no repository of an owner
called data."""
LARGEST_PX = 16384
"""Largest side of an image."""
Kind = TypeVar("Kind")


@dataclass(frozen=True)
class ShardFile:
    """One Arrow file: rows of ``split`` from ``first_row``, columns of ``group``; hash of its bytes
    (XXH3, 128 bit)."""

    path: str
    split: str
    group: str
    first_row: int
    rows: int
    bytes: int
    xxh3_128: str


@dataclass(frozen=True)
class OtherFile:
    """A file beside the shards (card, rig, meshes) with the hash of its bytes."""

    path: str
    bytes: int
    xxh3_128: str


@dataclass(frozen=True)
class Manifest:
    """Everything a reader must know before it opens a shard. ``samples`` holds, per split, one
    mapping per row in row order: sample, object, view and what the builder measured of it (cover,
    distance, ground-truth error). ``stored`` is the configuration whose frames are on disk."""

    origin: str
    generator: dict[str, str]
    settings: dict[str, Any]
    rig: dict[str, Any]
    size: tuple[int, int]
    stored: str
    exact: bool
    samples: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    shards: list[ShardFile] = field(default_factory=list)
    others: list[OtherFile] = field(default_factory=list)
    content: dict[str, str] = field(default_factory=dict)
    schema_version: str = SCHEMA_VERSION

    @property
    def fingerprint(self) -> str:
        """SHA-256 over what defines the data: schema, rig, rows and the hash of every shard; 64 hex
        digits."""
        defining = {
            entry.name: getattr(self, entry.name)
            for entry in fields(self)
            if entry.name not in ("others", "generator")
        }
        text = json.dumps(defining, sort_keys=True, allow_nan=False, default=asdict)
        return sha256(text.encode()).hexdigest()

    @cached_property
    def sequence(self) -> AnySequence:
        return rig_from_dict(self.rig).sequence

    @cached_property
    def groups(self) -> dict[str, tuple[int, ...]]:
        """Indices of the frames in each column group's files, as `stored_groups`."""
        return stored_groups(self.sequence, self.stored)

    @property
    def configs(self) -> tuple[str, ...]:
        """Configurations whose frames are stored."""
        return available_configs(self.sequence, self.stored)

    def columns(self, group: str | None = None) -> list[str]:
        """Column names of a group's files, or of a table with all that is stored (None), in
        order."""
        if group in (None, DATA_GROUP):
            return row_columns(
                self.sequence, self.groups[group] if group else self.stored_frames, self.exact
            )
        return [self.sequence.frames[i].column for i in self.groups[group]]

    @property
    def stored_frames(self) -> tuple[int, ...]:
        """Indices of the frames on disk, ascending."""
        return stored_frames(self.sequence, self.stored)

    @property
    def row_bytes(self) -> int:
        """Bytes of a row's images: one a pixel and stored frame, four a depth map, one each of the
        other maps."""
        depths = 10 if self.exact else 4
        return self.size[0] * self.size[1] * (len(self.stored_frames) + depths)

    @property
    def files(self) -> tuple[ShardFile | OtherFile, ...]:
        """Every file but the manifest itself."""
        return (*self.others, *self.shards)

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The rows of all splits."""
        return [row for rows in self.samples.values() for row in rows]

    @property
    def splits(self) -> dict[str, list[str]]:
        return {split: [row["sample"] for row in rows] for split, rows in self.samples.items()}

    def features(self, group: str | None = None) -> dict[str, dict[str, Any]]:
        """The `columns` as `sample.features`."""
        return features(self.columns(group), self.size)

    def write(self, folder: Path) -> None:
        """Write ``manifest.json`` complete or not at all."""
        content = {**asdict(self), "fingerprint": self.fingerprint}
        write_atomically(
            folder / MANIFEST, json.dumps(content, indent=1, allow_nan=False).encode() + b"\n"
        )


def read_manifest(folder: Path) -> Manifest:
    """Manifest of a dataset folder. Raises `DatasetError` for a folder that is none, is unfinished
    or is damaged."""
    path = folder / MANIFEST
    if not folder.is_dir():
        if (
            REPOSITORY_NAME.fullmatch(str(folder))
            and folder.parts[0] != _LOCAL
            and not folder.parent.is_dir()
        ):
            raise DatasetError(
                f"{folder}: is no dataset folder; to fetch the published dataset: fpp-bench import "
                f"{folder} "
                "--out data/published"
            )
        raise DatasetError(
            f"{folder}: no such folder; build one with: fpp-bench build --out {folder} --preset "
            f"mini"
        )
    if not path.is_file():
        if (folder / WORK_FOLDER).is_dir():
            raise DatasetError(
                f"{folder}: this build is not finished; run the same command again and it resumes"
            )
        if datasets := datasets_below(folder):
            raise DatasetError(
                f"{folder}: holds {len(datasets)} datasets and is none itself; name one of them, "
                f"such as {next(iter(datasets.values()))}"
            )
        raise DatasetError(f"{folder}: no {MANIFEST} there, so this is no dataset of fpp-ml-bench")
    content = read_json(path, DatasetError, "it is damaged: build or import the dataset again")
    try:
        if not isinstance(content, dict):
            raise ValueError("expected a mapping")
        claimed = content.pop("fingerprint", None)
        version = printable(content.get("schema_version", SCHEMA_VERSION), 40)
        if version.split(".")[0] != SCHEMA_VERSION.split(".")[0]:
            raise DatasetError(
                f"{path}: schema version {version}, this package reads {SCHEMA_VERSION}; build it "
                f"again"
            )
        manifest = strictly(Manifest, content)
        _check(manifest)
    except ValueError as error:
        raise DatasetError(
            f"{path}: damaged ({error}); build or import the dataset again"
        ) from error
    if manifest.fingerprint != claimed:
        raise DatasetError(
            f"{path}: damaged, its fingerprint does not match its content; build the dataset again"
        )
    root = folder.resolve()
    for name in (MANIFEST, *(file.path for file in manifest.files)):
        if not (root / name).resolve().is_relative_to(root):
            raise DatasetError(
                f"{folder / name}: is a link out of the dataset; put the file itself there"
            )
    return manifest


def datasets_below(folder: Path) -> dict[str, Path]:
    """The dataset folders directly below ``folder`` by name; none of a folder that is a dataset, or
    is none."""
    if is_file(folder / MANIFEST) or not folder.is_dir():
        return {}
    return {path.name: path for path in sorted(folder.iterdir()) if is_file(path / MANIFEST)}


def strictly(kind: type[Kind], value: Any, where: str = "") -> Kind:
    """A JSON ``value`` as a dataclass or any other type of its fields: the same keys, and nothing
    converted. Raises ValueError that says ``where`` it is not."""
    if is_dataclass(kind):
        types = {entry.name: entry.type for entry in fields(kind)}
        if not isinstance(value, dict) or value.keys() != types.keys():
            raise ValueError(
                f"{printable(where).strip() or 'the file'}: expected exactly the keys "
                f"{', '.join(types)}"
            )
        parts = {
            name: strictly(types[name], value[name], f"{where} {name}")  # type: ignore[arg-type]
            for name in types
        }
        built = kind(**parts)
        if isinstance(built, ShardFile | OtherFile):
            _check_file(built)
        return built  # type: ignore[return-value]
    of, inner = get_origin(kind), get_args(kind)
    if of is dict and isinstance(value, dict):
        plain = inner[1] is Any  # and so are the keys of what was JSON
        if plain:
            return value  # type: ignore[return-value]
        entries = {key: strictly(inner[1], value[key], f"{where} {key}") for key in value}
        return entries  # type: ignore[return-value]
    if of in (list, tuple) and isinstance(value, list) and (of is list or len(value) == len(inner)):
        return of(strictly(inner[0], entry, where) for entry in value)  # type: ignore[no-any-return]
    if kind is Any or type(value) is kind:
        return value  # type: ignore[no-any-return]
    expected = getattr(kind, "__name__", kind)
    raise ValueError(f"{printable(where).strip()}: expected {expected}, got {printable(value, 60)}")


def _check_file(file: ShardFile | OtherFile) -> None:
    if problem := path_problem(file.path):
        raise ValueError(f"path {printable(file.path)!r}: {problem}")
    counts = [value for value in vars(file).values() if isinstance(value, int)]
    if min(counts) < 0 or not re.fullmatch("[0-9a-f]{32}", file.xxh3_128):
        raise ValueError(f"{file.path}: expected counts of 0 and more, and a hash of 32 hex digits")


def check_row(row: dict[str, Any]) -> None:
    """Raise ValueError for a row of `Manifest.samples` without names, or with names that are no
    names of files, without the counts and lengths that every sample has, or with others that are no
    numbers."""
    for key, pattern in (("sample", SAMPLE_NAME), ("object", OBJECT_NAME), ("view", VIEW_NAME)):
        if not isinstance(name := row.get(key), str) or not pattern.fullmatch(name):
            raise ValueError(
                f"{key} {printable(name, 60)!r}: expected a name of letters, digits, - and _"
            )
    needed = {"object_px", "depth_min_mm", "depth_max_mm"}
    for key in needed | {key for key in row if key.endswith(("_px", "_mm"))}:
        value = row.get(key)
        if isinstance(value, bool) or not (
            isinstance(value, int | float) or (value is None and key not in needed)
        ):
            raise ValueError(
                f"{row['sample']}: {key}: expected a number, got {printable(value, 60)}"
            )


def _check(manifest: Manifest) -> None:
    """Raise ValueError for what no dataset can have."""
    if not all(0 < side <= LARGEST_PX for side in manifest.size):
        raise ValueError(f"size {manifest.size}: expected 1 to {LARGEST_PX} px a side")
    if manifest.stored not in manifest.configs:
        raise ValueError(
            f"stored: {printable(manifest.stored)!r} is no configuration of the rig's sequence"
        )
    if problem := next(
        filter(None, map(text_problem, (manifest.origin, *manifest.generator.values()))), None
    ):
        raise ValueError(f"origin and generator: {problem}")
    if not isinstance(manifest.settings.get("light", {}), dict):
        raise ValueError("settings light: expected a mapping")
    if unknown := {*manifest.samples, *(shard.split for shard in manifest.shards)} - set(SPLITS):
        raise ValueError(
            f"unknown split {printable(sorted(unknown)[0])!r}, expected {', '.join(SPLITS)}"
        )
    if not manifest.samples or not all(manifest.samples.values()):
        raise ValueError("samples: expected some in every split")
    for row in manifest.rows:
        check_row(row)
    if unknown := {shard.group for shard in manifest.shards} - manifest.groups.keys():
        raise ValueError(
            f"unknown group {printable(sorted(unknown)[0])!r}, expected "
            f"{', '.join(manifest.groups)}"
        )
    for path, count in Counter(file.path for file in manifest.files).items():
        if count > 1:
            raise ValueError(f"{path}: is listed twice")
    for name, digest in manifest.content.items():
        if not re.fullmatch(
            rf"({'|'.join(SPLITS)})/[a-z0-9_]{{1,60}} [0-9a-f]{{32}}", f"{name} {digest}"
        ):
            raise ValueError(
                f"content {printable(name)!r}: expected split/column and a hash of 32 hex digits"
            )


def damage_of(folder: Path, file: ShardFile | OtherFile, whole: bool = True) -> str | None:
    """What is wrong with a file of the dataset, a sentence that names it, or None: it is missing,
    of another size, or ``whole``, which reads it, of another content."""
    path = folder / file.path
    if not path.is_file():
        problem = "is missing"
    elif (size := path.stat().st_size) != file.bytes:
        problem = f"has {size} bytes, expected {file.bytes}"
    elif whole and file_hash(path) != file.xxh3_128:
        problem = "its content has changed (checksum differs)"
    else:
        return None
    return f"{path}: {problem}; copy or build the dataset again"


def describe_file(folder: Path, path: Path) -> OtherFile:
    """Manifest entry of a file below the dataset folder."""
    return OtherFile(path.relative_to(folder).as_posix(), path.stat().st_size, file_hash(path))
