"""A dataset's rows and columns, and the files that the columns live in.

There is one row per object and view, and one column PER FRAME, so that reading a frame costs a
single frame (a stacked column would decode all 52). Columns are stored in *groups* of separate
files, so that no pixel is stored twice and a configuration opens only the files it needs::

    data        sample, object, view, split, frame_00, depth, depth_exact, flags, cover, depth_min, depth_max
                                                                                                  <split>/data-*.arrow
    crossed     the other crossed frames, of sets that have them                      frames/<split>/crossed-*.arrow
    horizontal  the other horizontal sinusoids                                     frames/<split>/horizontal-*.arrow
    vertical    the vertical sinusoids                                             frames/<split>/vertical-*.arrow
    codes       Gray code, black, white                                            frames/<split>/codes-*.arrow

With a sequence of another kind than the paper's, its crossed frame if that comes first, or else the
first of its finest fringes, takes the place of frame_00. The ``data`` group alone is the
`single_shot` configuration, which plain ``datasets`` can open without this package.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntFlag
from hashlib import sha256
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import CONFIGS
from fpp_ml_bench.optics.sequence import DIRECTIONS, AnySequence

DATA_GROUP = "data"
NAMES = ("sample", "object", "view")
LABELS = (*NAMES, "split")
DEPTH, DEPTH_EXACT, FLAGS, COVER = "depth", "depth_exact", "flags", "cover"
DEPTHS, PIXEL_MAPS = (DEPTH, DEPTH_EXACT), (FLAGS, COVER)
RANGE = ("depth_min", "depth_max")
TRUTH = (*DEPTHS, *PIXEL_MAPS, *RANGE)
"""What a method must not see of the samples that it is scored on."""
PREVIEW = "depth_preview"
MEANINGS = {
    "sample": ("", "object and view"),
    "object": ("", "the object; no object is in two splits"),
    "view": ("", "the view of the object, such as its angle on the turntable: `A60` is 60 degrees"),
    "split": ("", "the split that the sample is in"),
    "frame": ("grey level", "camera image under one projected pattern"),
    PREVIEW: (
        "",
        "picture of `depth`, scaled to the range of the object: for looking, not for training",
    ),
    DEPTH: (
        "mm",
        "depth along the camera's axis, decoded from the frames; 0 = background, or not decoded",
    ),
    DEPTH_EXACT: (
        "mm",
        "the same without error, from the ray cast that made the frames; 0 = background",
    ),
    FLAGS: (
        "bits",
        "1 unlit, 2 mixed surfaces (1 and 2: no score), 4 saturated, 8 interreflection, 16 weakly "
        "lit",
    ),
    COVER: ("1/255", "share of the pixel that the surface at its centre covers"),
    "depth_min": ("mm", "least depth on the object; methods that are given it are ranked apart"),
    "depth_max": ("mm", "largest depth on the object; as `depth_min`"),
}
"""Unit and meaning of each column; ``frame`` stands for all frames."""
SINGLE_SHOT_FRAME = 0
"""The single-shot input of the paper's sequence."""
HASH_DIGITS = 32


class Flag(IntFlag):
    """What is special about a pixel of a generated view, bit by bit.

    UNLIT: object that the camera sees and the projector does not light. MIXED: surfaces at
    different depths share the pixel. Both are `VOID`: even without noise there is no depth to
    trust. SATURATED: white light exceeds the largest grey level. INTERREFLECTION: further bounces
    bring a quarter or more of the projector's direct light. WEAK: the projector's direct light
    makes fringes of less than `WEAK_GREY`, or brings less than further bounces do. A full sequence
    of any code fails where SATURATED or WEAK: they are `UNMEASURABLE`. All follow from scene and
    light alone.
    """

    UNLIT = 1
    MIXED = 2
    SATURATED = 4
    INTERREFLECTION = 8
    WEAK = 16


VOID = Flag.UNLIT | Flag.MIXED
UNMEASURABLE = Flag.SATURATED | Flag.WEAK
WEAK_GREY = 6.0
"""Amplitude of a fringe in grey levels: the decoder's least modulation is 5, and noise moves what
it measures. On the training objects the full sequence decodes all but 0.003% of the object pixels
that are neither void nor unmeasurable (in the lights workshop and hard all but 0.02% and 0.8%;
``benchmarks/benchmark_facts.py``)."""


def void_pixels(
    flags: NDArray[np.uint8], depth_mm: NDArray | None = None, exact_mm: NDArray | None = None
) -> NDArray[np.bool_]:
    """Pixels that count in no score, bool of the shape of ``flags``: those flagged `VOID`; and,
    with both depths, the surface (``exact_mm`` above 0) that is lit too weakly for the full
    sequence to decode it (``depth_mm`` 0)."""
    void: NDArray[np.bool_] = (flags & np.uint8(VOID)) != 0
    return (
        void if depth_mm is None or exact_mm is None else void | ((exact_mm > 0) & (depth_mm == 0))
    )


def exact_void(flags: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Pixels that count in no score against the exact depth, bool of the shape of ``flags``: those
    flagged `VOID` or `UNMEASURABLE`, which follow from scene and light alone."""
    return (flags & np.uint8(VOID | UNMEASURABLE)) != 0  # type: ignore[no-any-return]


@dataclass
class Row:
    """A sample to be written: frames by index uint8 (H, W), depths float32 (H, W) in mm,
    measurements for the manifest, and for generated data the flags (`Flag`) of each pixel and the
    share of it, in 255ths, that the surface of its central ray covers, uint8 (H, W). The images'
    memory may be reused as soon as the writer takes the next row."""

    sample: str
    object: str
    view: str
    frames: dict[int, NDArray[np.uint8]]
    depth_mm: NDArray[np.float32]
    depth_exact_mm: NDArray[np.float32] | None
    measured: dict[str, Any] = field(default_factory=dict)
    flags: NDArray[np.uint8] | None = None
    cover: NDArray[np.uint8] | None = None


def stored_groups(sequence: AnySequence, stored: str) -> dict[str, tuple[int, ...]]:
    """Column groups of a dataset that stores configuration ``stored``: group name -> frame indices,
    in file order."""
    indices, first = set(sequence.config(stored)), sequence.config("single_shot")
    groups = {
        DATA_GROUP: first,
        "crossed": tuple(i for i in sequence.crossed_frames if i not in first),
    }
    for direction in DIRECTIONS:
        groups[direction] = tuple(i for i in sequence.sinusoids(direction) if i not in first)
    placed = {i for frames in groups.values() for i in frames}
    groups["codes"] = tuple(i for i in range(len(sequence)) if i not in placed)
    kept = {name: tuple(i for i in frames if i in indices) for name, frames in groups.items()}
    return {name: frames for name, frames in {**kept, DATA_GROUP: first}.items() if frames}


def stored_frames(sequence: AnySequence, stored: str) -> tuple[int, ...]:
    """Frame indices on disk, ascending: those of the configuration, and always the one of
    `single_shot`."""
    return tuple(sorted(i for frames in stored_groups(sequence, stored).values() for i in frames))


def available_configs(sequence: AnySequence, stored: str) -> tuple[str, ...]:
    """Configurations that can be read from a dataset storing ``stored``."""
    available = set(stored_frames(sequence, stored))
    frames = {config: sequence.config(config) for config in CONFIGS}
    return tuple(
        config for config, needed in frames.items() if needed and available.issuperset(needed)
    )


def row_columns(sequence: AnySequence, frames: tuple[int, ...], exact: bool) -> list[str]:
    """Columns of a table with ``frames``, in order: labels, frames, depths, range."""
    names = [sequence.frames[i].column for i in frames]
    return [*LABELS, *names, DEPTH, *([DEPTH_EXACT, *PIXEL_MAPS] if exact else []), *RANGE]


def labels_of(row: Mapping[str, Any], split: str) -> dict[str, Any]:
    """What the columns of labels and depth range hold of a row of `Manifest.samples`."""
    own = {key: row[key] for key in NAMES}
    return {**own, "split": split, **{key: row[f"{key}_mm"] for key in RANGE}}


def config_columns(sequence: AnySequence, config: str, exact: bool) -> list[str]:
    """Column names of a configuration, in order."""
    return row_columns(sequence, sequence.config(config), exact)


def features(columns: list[str], size: tuple[int, int]) -> dict[str, dict[str, Any]]:
    """The columns as ``datasets.Features`` writes them in JSON; ``size`` is (H, W)."""
    described: dict[str, dict[str, Any]] = {}
    for name in columns:
        if name in LABELS or name in RANGE:
            described[name] = {"dtype": "string" if name in LABELS else "float32", "_type": "Value"}
        else:
            kind = "float32" if name in DEPTHS else "uint8"
            described[name] = {"shape": list(size), "dtype": kind, "_type": "Array2D"}
    return described


def image_hash(image: NDArray) -> str:
    """SHA-256 of an image's size and decoded values (uint8 or float32, little-endian), its first 32
    hex digits."""
    digest = sha256(f"{image.shape} {image.dtype.newbyteorder('<').str} ".encode())
    digest.update(np.ascontiguousarray(image, image.dtype.newbyteorder("<")).data)
    return digest.hexdigest()[:HASH_DIGITS]


def column_hash(images: Mapping[str, str]) -> str:
    """Hash of a column of a split, 32 hex digits, from the `image_hash` of each sample. It does not
    depend on the order of the samples, nor on the files that hold them."""
    lines = "".join(f"{sample} {digest}\n" for sample, digest in sorted(images.items()))
    return sha256(lines.encode()).hexdigest()[:HASH_DIGITS]
