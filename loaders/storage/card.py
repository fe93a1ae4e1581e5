"""The files by which Hugging Face tools open a dataset folder (card, split list, per-split state), and the rig file.

``datasets.load_dataset(FOLDER, "single_shot")`` follows the card's ``configs:`` and copies into its cache;
``datasets.load_from_disk(FOLDER)`` follows ``dataset_dict.json`` and the split folders' ``state.json``, in place.
"""

import json
from pathlib import Path
from typing import Any

from fpp_ml_bench import __version__
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.loaders.sample import DATA_GROUP, available_configs, features, group_columns, stored_groups
from fpp_ml_bench.loaders.storage.manifest import Manifest

RIG_FILE = "rig.yaml"
CARD_HEAD = """\
---
license: mit
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
"""Front matter of every card, up to its configurations."""
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
train = load_dataset("THIS FOLDER", "{config}", split="train")

import datasets                                   # frame 0 and depth
train = datasets.load_dataset("THIS FOLDER", "single_shot", split="train")   # through its cache
train = datasets.load_from_disk("THIS FOLDER")["train"]                      # in place
```

`fpp-bench info` says what is in it, `fpp-bench verify` proves it intact. Made by fpp-ml-bench {package}.
"""


def data_version(fingerprint: str) -> str:
    """Version for a card; it changes with the data, because ``datasets`` looks up its cached copies by version."""
    return f"1.0.{int(fingerprint[:7], 16)}"


def write_card(folder: Path, manifest: Manifest) -> list[str]:
    """Write card, rig and Hugging Face state files of a dataset with finished shards; returns their relative paths."""
    from fpp_ml_bench.optics import rig_from_dict, save_rig

    rig = rig_from_dict(manifest.rig)
    sequence = rig.sequence
    frames = stored_groups(sequence, manifest.stored)[DATA_GROUP]
    columns = group_columns(sequence, DATA_GROUP, frames, manifest.exact)
    data = [shard for shard in manifest.shards if shard.group == DATA_GROUP]
    for split in manifest.samples:
        files = [shard.path for shard in data if shard.split == split]
        state: dict[str, Any] = {
            "_data_files": [{"filename": path.split("/")[-1]} for path in files],
            "_fingerprint": manifest.fingerprint[:16],
            "_format_columns": None,
            "_format_kwargs": {},
            "_format_type": None,
            "_output_all_columns": False,
            "_split": split,
        }
        info = {"citation": "", "description": "", "features": features(columns, manifest.size), "homepage": "",
                "license": "mit"}  # fmt: skip
        _write_json(folder / split / "state.json", state)
        _write_json(folder / split / "dataset_info.json", info)
    _write_json(folder / "dataset_dict.json", {"splits": list(manifest.samples)})
    save_rig(rig, folder / RIG_FILE)
    text = CARD_HEAD + _CARD.format(
        version=data_version(manifest.fingerprint),
        data_files="\n".join(
            f"  - split: {split}\n    path: {split}/{DATA_GROUP}-*.arrow" for split in manifest.samples
        ),
        origin=manifest.origin,
        rows=sum(len(rows) for rows in manifest.samples.values()),
        height=manifest.size[0],
        width=manifest.size[1],
        stored=manifest.stored,
        config=available_configs(sequence, manifest.stored)[-1],
        package=__version__,
    )
    write_atomically(folder / "README.md", text.encode())
    states = [f"{split}/{name}" for split in manifest.samples for name in ("state.json", "dataset_info.json")]
    return ["README.md", "dataset_dict.json", RIG_FILE, *states]


def _write_json(path: Path, content: dict[str, Any]) -> None:
    write_atomically(path, json.dumps(content, indent=1).encode() + b"\n")
