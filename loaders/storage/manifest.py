"""``manifest.json``: what a finished dataset folder holds, with a checksum for every file. It is written last, so a
folder without one is a build that was interrupted. It holds nothing that differs between two builds of the same
settings: no date, no path, no machine."""

import json
from dataclasses import asdict, dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

from fpp_ml_bench.constants import SCHEMA_VERSION, SPLITS
from fpp_ml_bench.errors import DatasetError
from fpp_ml_bench.files import cause_of, file_hash, write_atomically
from fpp_ml_bench.loaders.sample import stored_frames
from fpp_ml_bench.optics import AnySequence, rig_from_dict

MANIFEST = "manifest.json"
WORK_FOLDER = ".build"
MESH_FOLDER = "meshes"
GENERATED = "generated"
"""`Manifest.origin` of a dataset that the builder made."""
CAPTURED = "captured"
"""That of a dataset decoded from a scanner's captures; objects have any views."""


@dataclass(frozen=True)
class ShardFile:
    """One Arrow file: rows of ``split`` from ``first_row``, columns of ``group``; hash of its bytes (XXH3, 128 bit)."""

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
    """Everything a reader must know before it opens a shard. ``samples`` holds, per split, one mapping per row in row
    order: sample, object, view and what the builder measured of it (cover, distance, ground-truth error). ``stored`` is
    the configuration whose frames are on disk."""

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
    schema_version: str = SCHEMA_VERSION

    @property
    def fingerprint(self) -> str:
        """SHA-256 over what defines the data: schema, rig, rows and the hash of every shard; 64 hex digits."""
        content = asdict(self)
        for key in ("others", "generator"):
            content.pop(key)
        return sha256(json.dumps(content, sort_keys=True, allow_nan=False).encode()).hexdigest()

    @property
    def sequence(self) -> AnySequence:
        return rig_from_dict(self.rig).sequence

    @property
    def stored_frames(self) -> tuple[int, ...]:
        """Indices of the frames on disk, ascending."""
        return stored_frames(self.sequence, self.stored)

    @property
    def row_bytes(self) -> int:
        """Bytes of a row's images: one a pixel and stored frame, four a depth map, one each of the other maps."""
        depths = 10 if self.exact else 4
        return self.size[0] * self.size[1] * (len(self.stored_frames) + depths)

    @property
    def files(self) -> tuple[ShardFile | OtherFile, ...]:
        """Every file but the manifest itself."""
        return (*self.others, *self.shards)

    @property
    def splits(self) -> dict[str, list[str]]:
        return {split: [row["sample"] for row in rows] for split, rows in self.samples.items()}

    def write(self, folder: Path) -> None:
        """Write ``manifest.json`` complete or not at all."""
        content = {**asdict(self), "fingerprint": self.fingerprint}
        write_atomically(folder / MANIFEST, json.dumps(content, indent=1, allow_nan=False).encode() + b"\n")


def read_manifest(folder: Path) -> Manifest:
    """Manifest of a dataset folder. Raises `DatasetError` for a folder that is none, is unfinished or is damaged."""
    path = folder / MANIFEST
    if not folder.is_dir():
        raise DatasetError(f"{folder}: no such folder; build one with: fpp-bench build {folder} --preset mini")
    if not path.is_file():
        if (folder / WORK_FOLDER).is_dir():
            raise DatasetError(f"{folder}: this build is not finished; run the same command again and it resumes")
        raise DatasetError(f"{folder}: no {MANIFEST} there, so this is no dataset of fpp-ml-bench")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        claimed = content.pop("fingerprint")
        version = str(content.get("schema_version"))
        if version.split(".")[0] != SCHEMA_VERSION.split(".")[0]:
            raise DatasetError(f"{path}: schema version {version}, this package reads {SCHEMA_VERSION}; build it again")
        content["shards"] = [ShardFile(**shard) for shard in content["shards"]]
        content["others"] = [OtherFile(**other) for other in content["others"]]
        content["size"] = tuple(content["size"])
        manifest = Manifest(**content)
        unknown = set(manifest.samples) - set(SPLITS)
        if unknown:
            raise DatasetError(f"{path}: unknown split {sorted(unknown)[0]!r}, expected {', '.join(SPLITS)}")
        actual = manifest.fingerprint
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise DatasetError(f"{path}: damaged ({cause_of(error)}); build or import the dataset again") from error
    if actual != claimed:
        raise DatasetError(f"{path}: damaged, its fingerprint does not match its content; build the dataset again")
    return manifest


def describe_file(folder: Path, path: Path) -> OtherFile:
    """Manifest entry of a file below the dataset folder."""
    return OtherFile(path.relative_to(folder).as_posix(), path.stat().st_size, file_hash(path))
