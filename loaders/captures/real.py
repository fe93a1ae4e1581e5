"""Real captures that others published, as datasets: each set is described by a YAML file in ``sets/``
or of the user's own, and read from the user's copy of the repository that holds it::

    title: Plaster relief of an eye, one camera
    source: https://github.com/Practice3DVision/SLMaster
    commit: d1a0fe4
    licence: AGPL-3.0
    known: [what is known to be wrong with it, a sentence each]
    colour: red                     # as of read_frames; left out where the images are grey
    anyway: [object_view]           # captures that are read although their examination refuses them
    rig: {camera: ..., sequence: ...}                       # as a rig file
    captures:
      eye:                          # object
        mono:                       # view: files in the order of the rig's sequence, and their SHA-256
          data/monocularCamera/L/0.bmp: 3b1f...

Nothing of a set is part of the package, and nothing is downloaded. The frames are decoded into the
depth, as those of any capture; a pixel that they don't decode has no truth and counts in no score.
"""

from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path, PurePosixPath
from typing import Any

from pydantic import Field

from fpp_ml_bench.coding.code import Limits
from fpp_ml_bench.constants import OBJECT_NAME, VIEW_NAME
from fpp_ml_bench.containers import LARGEST_BYTES
from fpp_ml_bench.errors import CaptureError, RigError
from fpp_ml_bench.files import file_content, first_of, printable, read_yaml
from fpp_ml_bench.loaders.captures.decoding import CaptureReader, captures_plan
from fpp_ml_bench.loaders.captures.images import Capture, check_options
from fpp_ml_bench.loaders.storage.assembly import Assembly
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.rig_file import rig_from_dict
from fpp_ml_bench.schema import StrictModel, Text, validate

SETS = Path(__file__).resolve().parent / "sets"
"""Folder of the sets that come with the package."""


class RealSet(StrictModel):
    """What a set's file says, as in this module's docstring."""

    title: Text
    source: Text
    commit: Text
    licence: Text
    known: list[Text] = Field(default_factory=list)
    colour: Text | None = None
    anyway: list[Text] = Field(default_factory=list)
    rig: dict[str, Any]
    captures: dict[Text, dict[Text, dict[Text, Text]]]


@dataclass(frozen=True)
class ReadSet:
    """A set's ``content`` and its ``rig``, checked; ``name``: of its file without the suffix."""

    name: str
    content: RealSet
    rig: Rig


def set_names() -> list[str]:
    """The sets that come with the package."""
    return sorted(file.stem for file in SETS.glob("*.yaml"))


def read_set(name: str) -> ReadSet:
    """The set of a ``name`` (`set_names`), or of a YAML file. Raises `CaptureError` for another
    name, and for a file that describes no set."""
    shipped = name in set_names()
    file = SETS / f"{name}.yaml" if shipped else Path(name)
    if not shipped and not file.is_file():
        raise CaptureError(
            f"--real {name}: expected one of {', '.join(set_names())}, or the YAML file of a set"
        )
    content = validate(RealSet, read_yaml(file, CaptureError), file, "real set", CaptureError)
    try:
        rig = rig_from_dict(content.rig)
    except RigError as error:
        raise CaptureError(f"{file}: rig: {error}") from None
    if not content.captures:
        raise CaptureError(f"{file}: captures: expected an object and more, got none")
    for object_name, views in content.captures.items():
        for view, files in views.items():
            where = f"{file}: captures.{printable(object_name)}.{printable(view)}"
            if not (OBJECT_NAME.fullmatch(object_name) and VIEW_NAME.fullmatch(view)):
                raise CaptureError(
                    f"{where}: expected an object of letters, digits, - and _, and a view of "
                    f"letters, digits and -"
                )
            if len(files) != len(rig.sequence):
                raise CaptureError(
                    f"{where}: expected the {len(rig.sequence)} files of the rig's sequence, got "
                    f"{len(files)}"
                )
            for name in files:
                if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
                    raise CaptureError(
                        f"{where}: {printable(name)}: expected a path inside the repository"
                    )
    return ReadSet(file.stem, content, rig)


def plan_real(read: ReadSet, root: Path) -> Assembly[CaptureReader]:
    """The captures of a set below ``root``, the user's copy of its repository, as a dataset with
    all in ``test``. Files that differ from those that the set was written for are named in the
    dataset's settings. Raises `CaptureError` for files that are not there."""
    content = read.content
    check_options(None, content.colour)
    captures, missing, different = [], [], []
    for object_name, views in content.captures.items():
        for view, files in views.items():
            paths = tuple(root / name for name in files)
            captures.append(Capture(object_name, view, paths[0].parent, paths))
            for (name, digest), path in zip(files.items(), paths, strict=True):
                if not path.is_file():
                    missing.append(name)
                elif sha256(file_content(path, LARGEST_BYTES, CaptureError)).hexdigest() != digest:
                    different.append(name)
    if missing:
        raise CaptureError(
            f"{root}: expected a copy of {content.source} at commit {content.commit}, and found no "
            f"{first_of(missing, 3)}; get it by git clone {content.source}"
        )
    settings = {
        "layout": "real",
        "splits": "given",
        "undecoded": "void",
        "set": {
            "name": read.name,
            **content.model_dump(include={"title", "source", "commit", "licence", "known"}),
            "different": different,
        },
    }
    return captures_plan(
        captures,
        {"test": captures},
        read.rig,
        Limits(),
        None,
        content.colour,
        frozenset(content.anyway),
        settings,
    )


def real_notes(read: ReadSet, settings: dict[str, Any]) -> list[str]:
    """What a user should know of an imported set, a sentence each."""
    content, different = read.content, settings["set"]["different"]
    notes = [
        f"{content.title}, from {content.source} at commit {content.commit}; licence: "
        f"{content.licence}"
    ]
    notes += [f"known: {line}" for line in content.known]
    if different:
        notes.append(
            f"files that differ from those of that commit: {first_of(different, 3)}; scores on them compare with "
            f"nobody else's"
        )
    return notes
