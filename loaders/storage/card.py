"""What describes a dataset: the files by which Hugging Face tools open its folder, the rig file,
and its statistics. ``datasets.load_dataset(FOLDER, "single_shot")`` follows the card's ``configs:``
and copies into its cache; ``datasets.load_from_disk(FOLDER)`` follows ``dataset_dict.json`` and the
split folders' ``state.json``, in place."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from fpp_ml_bench import __version__
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.loaders.sample import (
    DATA_GROUP,
    MEANINGS,
)
from fpp_ml_bench.loaders.storage.manifest import CAPTURED, GENERATED, Manifest
from fpp_ml_bench.optics.rig_file import rig_from_dict, save_rig

RIG_FILE = "rig.yaml"
NAME = "FPP-ML-Bench"
"""Of the data that the generator makes; of other data we are not the authors."""
DOI = "10.1117/12.3082257"
"""Of the paper whose benchmark it builds on."""
_FOLDER_TEXT = """\
Frames stored: `{stored}`.

```python
from fpp_ml_bench import load_dataset            # every configuration, memory-mapped, no copy
{split} = load_dataset("THIS FOLDER", "{config}", split="{split}")

import datasets                                   # frame {first} and depth
{split} = datasets.load_dataset("THIS FOLDER", "single_shot", split="{split}")   # through its cache
{split} = datasets.load_from_disk("THIS FOLDER")["{split}"]                      # in place
```

`fpp-bench info` says what is in it, `fpp-bench verify` proves it intact. Made by fpp-ml-bench {package}.
"""
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
_REAL_LIMITS = """\
- The frames are real captures from {source}. `depth` is decoded from all of them with the rig in `rig.yaml`, and has
  the errors of both. Pixels that are not decoded have no truth, and count in no score.
- All images are of one rig, whose working range is {near:g} to {far:g} mm.
"""
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
  doi       = {{{doi}}}
}}
@misc{{haroon_shortcuts,
  author = {{Adam Haroon and Anush Lakshman and Cody Fleming and Beiwen Li}},
  title  = {{Diagnosing Shape-Prior Shortcuts in Long-Range Single-Shot Fringe Projection Profilometry}}
}}
```
"""


def yaml_text(content: Any, allow_unicode: bool = False) -> str:
    """YAML as the Hub's files have it: in the order given, lines of at most 110 characters."""
    return str(yaml.safe_dump(content, sort_keys=False, width=110, allow_unicode=allow_unicode))


def default_licence(manifest: Manifest) -> str:
    """MIT, for captures unknown, as they are under none until their owner says so."""
    return "unknown" if manifest.origin == CAPTURED else "mit"


def title(manifest: Manifest) -> str:
    """What a dataset is called where it has no name of its own."""
    return NAME if manifest.origin == GENERATED else "Fringe images with depth"


def front_matter(
    manifest: Manifest,
    configs: list[Any],
    licence: str | None = None,
    tags: Sequence[str] = (),
) -> str:
    """Front matter of a card: from it Hugging Face tools know configurations and files. ``licence``
    is by default `default_licence`."""
    rows = sum(map(len, manifest.samples.values()))
    head = {
        "license": licence or default_licence(manifest),
        "pretty_name": title(manifest),
        "task_categories": ["depth-estimation"],
        "size_categories": [
            "n<1K" if rows < 1000 else "1K<n<10K" if rows < 10_000 else "10K<n<100K"
        ],
        "tags": ["fringe-projection-profilometry", "structured-light", "metrology", *tags],
        "configs": configs,
    }
    return f"---\n{yaml_text(head)}---\n"


def card_config(
    config: str, identity: str, files: Mapping[str, object], default: bool
) -> dict[str, Any]:
    """A configuration in the front matter; ``files`` are a pattern or names for each split,
    ``identity`` 64 hex digits that change with the data, because ``datasets`` looks up its cached
    copies by version."""
    return {
        "config_name": config,
        **({"default": True} if default else {}),
        "version": f"1.0.{int(identity[:7], 16)}",
        "data_files": [{"split": split, "path": paths} for split, paths in files.items()],
    }


def card(manifest: Manifest, configs: list[Any], form: str, rows: int, text: str) -> bytes:
    """The card of a folder with ``rows`` of the dataset in some ``form``; ``text`` says how to open
    it."""
    height, width = manifest.size
    counts = f"{rows} samples of {height} x {width} px; depth in mm, 0 = background."
    end = card_end(manifest, manifest.features())
    head = f"{front_matter(manifest, configs)}# {title(manifest)} ({manifest.origin}){form}"
    return f"{head}\n\n{counts} {text}\n{end}".encode()


def card_end(manifest: Manifest, described: Mapping[str, Mapping[str, Any]]) -> str:
    """End of every card: the columns by their `features`, all frames in one line; limitations and
    citation."""
    frames, rows = [name for name in described if name.startswith("frame_")], []
    for name in (name for name in described if name not in frames[1:]):
        feature, many = described[name], name in frames and len(frames) > 1
        unit, meaning = MEANINGS["frame" if name in frames else name]
        dtype = "image, 8-bit grey" if feature["_type"] == "Image" else feature["dtype"]
        shape = f" {tuple(feature['shape'])}" if "shape" in feature else ""
        rows.append(
            f"| `{name}`{f' ... `{frames[-1]}`' if many else ''} | {dtype}{shape} | {unit} | "
            f"{meaning} |"
        )
    return _END.format(columns="\n".join(rows), limits=limitations(manifest), doi=DOI)


def limitations(manifest: Manifest) -> str:
    """What the dataset can't tell, as a list in Markdown."""
    settings, (near, far) = manifest.settings, rig_from_dict(manifest.rig).working_range_mm
    source = ""
    if "repository" in settings:
        url = f"https://huggingface.co/datasets/{settings['repository']}"
        source = f", from {url} at commit `{settings['commit']}`"
    text = _LIMITS.get(manifest.origin, _IMPORTED_LIMITS)
    if real := settings.get("set"):
        text = _REAL_LIMITS
        source = f"{real['source']} at commit `{real['commit']}` (licence: {real['licence']})"
    limits = text.format(
        light=settings.get("light", {}).get("name", "paper"),
        near=near,
        far=far,
        source=source,
        rig="assumed to be that of the paper"
        if settings.get("rig_assumed")
        else "the one given at the import",
    )
    if real:
        limits += "".join(f"- {line}.\n" for line in real["known"])
    return limits


def write_card(folder: Path, manifest: Manifest) -> list[str]:
    """Write card, rig and Hugging Face state files of a dataset with finished shards; returns their
    relative paths."""
    contents: dict[str, Any] = {"dataset_dict.json": {"splits": list(manifest.samples)}}
    for split in manifest.samples:
        files = [
            shard.path
            for shard in manifest.shards
            if (shard.group, shard.split) == (DATA_GROUP, split)
        ]
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
            "features": manifest.features(DATA_GROUP),
            "homepage": "",
            "license": "" if manifest.origin == CAPTURED else "mit",
        }
    for name, content in contents.items():
        (folder / name).parent.mkdir(exist_ok=True)
        write_atomically(folder / name, json.dumps(content, indent=1).encode() + b"\n")
    save_rig(rig_from_dict(manifest.rig), folder / RIG_FILE)
    patterns = {split: f"{split}/{DATA_GROUP}-*.arrow" for split in manifest.samples}
    text = _FOLDER_TEXT.format(
        stored=manifest.stored,
        split=next(iter(manifest.samples)),
        config=manifest.configs[-1],
        package=__version__,
        first=manifest.groups[DATA_GROUP][0],
    )
    rows = sum(len(rows) for rows in manifest.samples.values())
    configs = [card_config("single_shot", manifest.fingerprint, patterns, default=True)]
    write_atomically(folder / "README.md", card(manifest, configs, "", rows, text))
    return ["README.md", RIG_FILE, *contents]


def split_statistics(manifest: Manifest) -> list[dict[str, Any]]:
    """Statistics of each split that has rows in the manifest, and last of all rows together, as a
    split called ``all``: lengths in mm, shares from 0 to 1, None where a dataset has no exact
    depth. ``gt_mae_mm`` and ``gt_rmse_mm`` are the uncertainty of the ground truth: decoded against
    exact depth over all object pixels, averaged over samples like every score; ``gt_interior_*``
    over those 3 px or more from depth edges."""
    whole = [row for rows in manifest.samples.values() for row in rows]
    return [
        _split(split, rows, manifest) for split, rows in (*manifest.samples.items(), ("all", whole))
    ]


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
        "undecoded_share": sum(row.get("undecoded_px") or 0 for row in rows) / exact_px
        if exact_px
        else None,
        "void_share": sum(row.get("void_px") or 0 for row in rows) / exact_px if exact_px else None,
    }


def ground_truth_summary(manifest: Manifest) -> list[str]:
    """A sentence per split on the error of the decoded ground truth against the exact depth; none
    for imported data."""
    return [
        f"{s['split']}: ground truth within {s['gt_mae_mm']:.3f} mm MAE, {s['gt_rmse_mm']:.3f} mm "
        f"RMSE of the exact "
        f"depth ({s['gt_interior_mae_mm']:.3f} mm 3 px or more from depth edges); "
        f"{100 * s['undecoded_share']:.2f}% of "
        f"object pixels not decodable, {100 * s['void_share']:.2f}% void (unlit, or surfaces mixed "
        f"in a pixel)"
        for s in split_statistics(manifest)[:-1]
        if None not in (s["gt_mae_mm"], s["gt_interior_mae_mm"], s["undecoded_share"])
    ]
