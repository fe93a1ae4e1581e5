"""What describes a dataset: the files by which Hugging Face tools open its folder, the rig file, and its statistics.
``datasets.load_dataset(FOLDER, "single_shot")`` follows the card's ``configs:`` and copies into its cache;
``datasets.load_from_disk(FOLDER)`` follows ``dataset_dict.json`` and the split folders' ``state.json``, in place."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fpp_ml_bench import __version__
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.loaders.sample import (
    DATA_GROUP,
    DEPTHS,
    LABELS,
    MEANINGS,
    PREVIEW,
    RANGE,
    available_configs,
    features,
    group_columns,
    row_columns,
    stored_groups,
)
from fpp_ml_bench.loaders.storage.manifest import CAPTURED, GENERATED, Manifest
from fpp_ml_bench.optics.rig_file import rig_from_dict, save_rig

RIG_FILE = "rig.yaml"
_HEAD = """\
---
license: {license}
pretty_name: FPP-ML-Bench
task_categories:
- depth-estimation
size_categories:
- n<1K
tags:
- fringe-projection-profilometry
- structured-light
- metrology
configs:
"""
_CARD = """\
- config_name: single_shot
  default: true
  version: {version}
  data_files:
{data_files}
---
# FPP-ML-Bench dataset ({origin})

{rows} samples of {height} x {width} px; depth in mm, 0 = background. Frames stored: `{stored}`.

```python
from fpp_ml_bench import load_dataset            # every configuration, memory-mapped, no copy
{split} = load_dataset("THIS FOLDER", "{config}", split="{split}")

import datasets                                   # frame {first} and depth
{split} = datasets.load_dataset("THIS FOLDER", "single_shot", split="{split}")   # through its cache
{split} = datasets.load_from_disk("THIS FOLDER")["{split}"]                      # in place
```

`fpp-bench info` says what is in it, `fpp-bench verify` proves it intact. Made by fpp-ml-bench {package}.

{end}"""
_LIMITS = {
    GENERATED: """\
- The images are rendered. Objects with names of the paper's objects are procedural models that stand in for them, not
  scans of them, so scores on this dataset can't be compared with scores on the published `aharoon/fpp-ml-bench`.
- Light `{light}`. In light `paper` all objects have one matte grey material and cast no shadows, as in the paper.
- There is no table and no ground plane: objects are in front of a distant wall, which counts as background.
- All images are of one rig, and depths are within {near:g} to {far:g} mm.
""",
    CAPTURED: """\
- `depth` is decoded from the captured frames with the rig in `rig.yaml`, and has the errors of both.
- All images are of one rig, whose working range is {near:g} to {far:g} mm.
""",
}
_IMPORTED_LIMITS = """\
- `depth` is that of the imported files{source}; there is no exact depth, and no flags of unlit or mixed pixels.
- The files do not name their rig: `rig.yaml` is {rig}.
- Scores on this dataset can't be compared with scores on datasets that `fpp-bench build` makes.
"""
_END = """\
## Columns

| column | dtype | unit | meaning |
| --- | --- | --- | --- |
{columns}

## Limitations

{limits}
## Citation

```bibtex
@inproceedings{{haroon2026fppml,
  author    = {{Anush Lakshman S. and Adam Haroon and Beiwen Li}},
  title     = {{Comprehensive machine learning benchmarking for fringe projection profilometry with photorealistic
               synthetic data}},
  booktitle = {{Photonic Instrumentation Engineering XIII}},
  volume    = {{13904}},
  pages     = {{1390402}},
  publisher = {{SPIE}},
  year      = {{2026}},
  doi       = {{10.1117/12.3082257}}
}}
@misc{{haroon_shortcuts,
  author = {{Adam Haroon and Anush Lakshman and Cody Fleming and Beiwen Li}},
  title  = {{Diagnosing Shape-Prior Shortcuts in Long-Range Single-Shot Fringe Projection Profilometry}}
}}
```
"""


def card_head(manifest: Manifest) -> str:
    """Front matter of every card, up to its configurations; captures are under no licence until their owner says so."""
    return _HEAD.format(license="unknown" if manifest.origin == CAPTURED else "mit")


def data_version(fingerprint: str) -> str:
    """Version for a card; it changes with the data, because ``datasets`` looks up its cached copies by version."""
    return f"1.0.{int(fingerprint[:7], 16)}"


def card_end(manifest: Manifest, described: Mapping[str, Mapping[str, Any]]) -> str:
    """End of every card: the columns by their `features`, all frames in one line; limitations and citation."""
    frames, rows = [name for name in described if name.startswith("frame_")], []
    for name in (name for name in described if name not in frames[1:]):
        feature, many = described[name], name in frames and len(frames) > 1
        unit, meaning = MEANINGS["frame" if name in frames else name]
        dtype = "image, 8-bit grey" if feature["_type"] == "Image" else feature["dtype"]
        shape = f" {tuple(feature['shape'])}" if "shape" in feature else ""
        rows.append(f"| `{name}`{f' ... `{frames[-1]}`' if many else ''} | {dtype}{shape} | {unit} | {meaning} |")
    settings, (near, far) = manifest.settings, rig_from_dict(manifest.rig).working_range_mm
    source = ""
    if "repository" in settings:
        url = f"https://huggingface.co/datasets/{settings['repository']}"
        source = f", from {url} at commit `{settings['commit']}`"
    limits = _LIMITS.get(manifest.origin, _IMPORTED_LIMITS).format(
        light=settings.get("light", {}).get("name", "paper"),
        near=near,
        far=far,
        source=source,
        rig="assumed to be that of the paper" if settings.get("rig_assumed") else "the one given at the import",
    )
    return _END.format(columns="\n".join(rows), limits=limits)


def dataset_info(
    config: str, described: Mapping[str, Mapping[str, Any]], size: tuple[int, int], rows: Mapping[str, int]
) -> dict[str, Any]:
    """What the front matter says of a configuration: columns by their `features`, and ``rows`` of each split with the
    size of their decoded images. ``size`` is (H, W)."""
    columns: list[dict[str, Any]] = []
    bytes_per_pixel = 0
    for name, feature in described.items():
        if feature["_type"] == "Array2D":
            dtype: Any = {"array2_d": {"shape": feature["shape"], "dtype": feature["dtype"]}}
        else:
            dtype = feature.get("dtype", "image")
        columns.append({"name": name, "dtype": dtype})
        if name not in (*LABELS, *RANGE, PREVIEW):
            bytes_per_pixel += 4 if name in DEPTHS else 1
    row_bytes = size[0] * size[1] * bytes_per_pixel
    splits = [{"name": name, "num_bytes": row_bytes * count, "num_examples": count} for name, count in rows.items()]
    total = row_bytes * sum(rows.values())
    return {"config_name": config, "features": columns, "splits": splits, "dataset_size": total}


def write_card(folder: Path, manifest: Manifest) -> list[str]:
    """Write card, rig and Hugging Face state files of a dataset with finished shards; returns their relative paths."""
    rig = rig_from_dict(manifest.rig)
    sequence = rig.sequence
    frames = stored_groups(sequence, manifest.stored)[DATA_GROUP]
    columns = group_columns(sequence, DATA_GROUP, frames, manifest.exact)
    contents: dict[str, Any] = {"dataset_dict.json": {"splits": list(manifest.samples)}}
    for split in manifest.samples:
        files = [shard.path for shard in manifest.shards if (shard.group, shard.split) == (DATA_GROUP, split)]
        contents[f"{split}/state.json"] = {
            "_data_files": [{"filename": path.split("/")[-1]} for path in files],
            "_fingerprint": manifest.fingerprint[:16],
            "_format_columns": None,
            "_format_kwargs": {},
            "_format_type": None,
            "_output_all_columns": False,
            "_split": split,
        }
        contents[f"{split}/dataset_info.json"] = {
            "citation": "",
            "description": "",
            "features": features(columns, manifest.size),
            "homepage": "",
            "license": "" if manifest.origin == CAPTURED else "mit",
        }
    for name, content in contents.items():
        write_atomically(folder / name, json.dumps(content, indent=1).encode() + b"\n")
    save_rig(rig, folder / RIG_FILE)
    paths = (f"  - split: {split}\n    path: {split}/{DATA_GROUP}-*.arrow" for split in manifest.samples)
    text = card_head(manifest) + _CARD.format(
        version=data_version(manifest.fingerprint),
        data_files="\n".join(paths),
        origin=manifest.origin,
        rows=sum(len(rows) for rows in manifest.samples.values()),
        height=manifest.size[0],
        width=manifest.size[1],
        stored=manifest.stored,
        split=next(iter(manifest.samples)),
        config=available_configs(sequence, manifest.stored)[-1],
        package=__version__,
        first=frames[0],
        end=card_end(manifest, features(row_columns(sequence, manifest.stored_frames, manifest.exact), manifest.size)),
    )
    write_atomically(folder / "README.md", text.encode())
    return ["README.md", RIG_FILE, *contents]


def split_statistics(manifest: Manifest) -> list[dict[str, Any]]:
    """Statistics of each split that has rows in the manifest: lengths in mm, shares from 0 to 1, None where a dataset
    has no exact depth. ``gt_mae_mm`` and ``gt_rmse_mm`` are the uncertainty of the ground truth: decoded against exact
    depth over all object pixels, averaged over samples like every score; ``gt_interior_*`` over those 3 px or more from
    depth edges."""
    return [_split(split, rows, manifest) for split, rows in manifest.samples.items()]


def whole_statistics(manifest: Manifest) -> dict[str, Any]:
    """Statistics of all rows together, as a split called ``all``."""
    return _split("all", [row for rows in manifest.samples.values() for row in rows], manifest)


def _split(split: str, rows: list[dict[str, Any]], manifest: Manifest) -> dict[str, Any]:
    pixels = manifest.size[0] * manifest.size[1]
    cover = np.array([row["object_px"] for row in rows]) / pixels
    ranges = np.array([row["depth_max_mm"] - row["depth_min_mm"] for row in rows])

    def average(key: str) -> float | None:
        values = [row[key] for row in rows if row.get(key) is not None]
        return float(np.mean(values)) if values else None

    largest = [row["gt_max_mm"] for row in rows if row.get("gt_max_mm") is not None]
    exact_px = sum(row.get("exact_px") or 0 for row in rows)
    means = ("gt_mae_mm", "gt_rmse_mm", "gt_interior_mae_mm", "gt_interior_rmse_mm")
    return {
        "split": split,
        "samples": len(rows),
        "objects": len({row["object"] for row in rows}),
        "cover_mean": float(cover.mean()),
        "cover_min": float(cover.min()),
        "cover_max": float(cover.max()),
        "depth_range_median_mm": float(np.median(ranges)),
        "depth_range_max_mm": float(ranges.max()),
        **{name: average(name) for name in means},
        "gt_max_mm": max(largest) if largest else None,
        "undecoded_share": sum(row.get("undecoded_px") or 0 for row in rows) / exact_px if exact_px else None,
        "void_share": sum(row.get("void_px") or 0 for row in rows) / exact_px if exact_px else None,
    }


def ground_truth_summary(manifest: Manifest) -> list[str]:
    """A sentence per split on the error of the decoded ground truth against the exact depth; none for imported data."""
    return [
        f"{s['split']}: ground truth within {s['gt_mae_mm']:.3f} mm MAE, {s['gt_rmse_mm']:.3f} mm RMSE of the exact "
        f"depth ({s['gt_interior_mae_mm']:.3f} mm 3 px or more from depth edges); {100 * s['undecoded_share']:.2f}% of "
        f"object pixels not decodable, {100 * s['void_share']:.2f}% void (unlit, or surfaces mixed in a pixel)"
        for s in split_statistics(manifest)
        if None not in (s["gt_mae_mm"], s["gt_interior_mae_mm"], s["undecoded_share"])
    ]
