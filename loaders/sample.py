"""The dataset's columns, and the files they live in.

There is one row per object and view, and one column PER FRAME, so that reading a frame costs a single frame (a stacked
column would decode all 52). Columns are stored in *groups* of separate files, so that no pixel is stored twice and a
configuration opens only the files it needs:

    data        sample, object, view, split, frame_00, depth, depth_exact, depth_min, depth_max   <split>/data-*.arrow
    horizontal  the other horizontal sinusoids                                     frames/<split>/horizontal-*.arrow
    vertical    the vertical sinusoids                                             frames/<split>/vertical-*.arrow
    codes       Gray code, black, white                                            frames/<split>/codes-*.arrow

The ``data`` group alone is the `single_shot` configuration, which plain ``datasets`` can open without this package.
"""

import json
from typing import TYPE_CHECKING, Any

from fpp_ml_bench.errors import DatasetError
from fpp_ml_bench.optics import CONFIGS, Sequence

if TYPE_CHECKING:
    import pyarrow as pa

DATA_GROUP = "data"
LABELS = ("sample", "object", "view", "split")
DEPTH, DEPTH_EXACT = "depth", "depth_exact"
RANGE = ("depth_min", "depth_max")
SINGLE_SHOT_FRAME = 0


def stored_groups(sequence: Sequence, stored: str) -> dict[str, tuple[int, ...]]:
    """Column groups of a dataset that stores configuration ``stored``: group name -> frame indices, in file order."""
    indices = set(sequence.config(stored))
    groups = {
        DATA_GROUP: (SINGLE_SHOT_FRAME,),
        "horizontal": tuple(i for i in sequence.sinusoids("horizontal") if i != SINGLE_SHOT_FRAME),
        "vertical": tuple(sequence.sinusoids("vertical")),
        "codes": tuple(range(2 * sequence.steps, len(sequence))),
    }
    return {name: frames for name, frames in groups.items() if name == DATA_GROUP or indices.issuperset(frames)}


def stored_frames(sequence: Sequence, stored: str) -> tuple[int, ...]:
    """Frame indices on disk, ascending: the frames of the configuration, and always frame 0."""
    return tuple(sorted(i for frames in stored_groups(sequence, stored).values() for i in frames))


def available_configs(sequence: Sequence, stored: str) -> tuple[str, ...]:
    """Configurations that can be read from a dataset storing ``stored``."""
    available = set(stored_frames(sequence, stored))
    return tuple(config for config in CONFIGS if available.issuperset(sequence.config(config)))


def config_columns(sequence: Sequence, config: str, exact: bool) -> list[str]:
    """Column names of a configuration, in order."""
    frames = [sequence.frames[i].column for i in sequence.config(config)]
    return [*LABELS, *frames, DEPTH, *([DEPTH_EXACT] if exact else []), *RANGE]


def features(columns: list[str], size: tuple[int, int]) -> dict[str, dict[str, Any]]:
    """The columns as ``datasets.Features`` writes them in JSON; ``size`` is (H, W)."""
    return {name: _feature(name, size) for name in columns}


def _feature(name: str, size: tuple[int, int]) -> dict[str, Any]:
    if name in LABELS:
        return {"dtype": "string", "_type": "Value"}
    if name in RANGE:
        return {"dtype": "float32", "_type": "Value"}
    if name in (DEPTH, DEPTH_EXACT):
        return {"shape": list(size), "dtype": "float32", "_type": "Array2D"}
    if name.startswith("frame_"):
        return {"shape": list(size), "dtype": "uint8", "_type": "Array2D"}
    raise DatasetError(f"unknown column {name!r}")


def group_columns(sequence: Sequence, group: str, frames: tuple[int, ...], exact: bool) -> list[str]:
    """Column names of a group's files, in order."""
    names = [sequence.frames[i].column for i in frames]
    if group != DATA_GROUP:
        return names
    return [*LABELS, *names, DEPTH, *([DEPTH_EXACT] if exact else []), *RANGE]


def arrow_schema(columns: list[str], size: tuple[int, int]) -> "pa.Schema":
    """The Arrow schema that ``datasets.Features(...).arrow_schema`` has, written without importing ``datasets``.

    Arrays are the storage type of its Array2D extension, a list of rows, with the extension named in the field's
    metadata: a reader that has imported ``datasets`` sees Array2D, all others see plain lists.
    """
    import pyarrow as pa

    fields = []
    described = features(columns, size)
    for name, feature in described.items():
        if feature["_type"] == "Array2D":
            metadata = {
                b"ARROW:extension:name": b"datasets.features.features.Array2DExtensionType",
                b"ARROW:extension:metadata": json.dumps([feature["shape"], feature["dtype"]]).encode(),
            }
            value = pa.uint8() if feature["dtype"] == "uint8" else pa.float32()
            fields.append(pa.field(name, pa.list_(pa.list_(value)), metadata=metadata))
        else:
            fields.append(pa.field(name, pa.string() if feature["dtype"] == "string" else pa.float32()))
    return pa.schema(fields, metadata={b"huggingface": json.dumps({"info": {"features": described}}).encode()})
