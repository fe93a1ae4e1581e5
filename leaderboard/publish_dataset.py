"""Staging a dataset for the Hub: Parquet, card, meshes, rig and the registration of the benchmark."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fpp_ml_bench import __version__
from fpp_ml_bench.errors import DatasetError, PublishError
from fpp_ml_bench.files import file_hash, write_atomically
from fpp_ml_bench.leaderboard.publish_tasks import BENCHMARK, FRAMEWORK, SCORE_TEXT, tasks_of
from fpp_ml_bench.leaderboard.tables import markdown_text
from fpp_ml_bench.loaders.hub import MARK, Publication, mark_bytes
from fpp_ml_bench.loaders.storage import (
    MESH_FOLDER,
    PREVIEW,
    RIG_FILE,
    DatasetFolder,
    columns,
    data_shards,
    data_version,
    write_shard,
)

EVAL_FILE = "eval.yaml"
OWNED = ("data/", f"{MESH_FOLDER}/")
_LICENCE = re.compile(r"[a-z0-9][a-z0-9.-]{0,39}")
_BODY = """\
# FPP-ML-Bench: single-shot fringe projection profilometry

{rows} samples of {height} x {width} px ({origin} data): what a structured-light camera sees of an object under
projected fringes, and the depth of every pixel. No object is in two splits.

| split | samples | objects |
| --- | ---: | --- |
{splits}

```python
import datasets

rows = datasets.load_dataset("{repo}", "{config}", split="{split}").with_format("numpy")
```

| column | content |
| --- | --- |
| `frame_NN` | captured frame, 8-bit grey PNG; `frame_00` is the single-shot input |
| `depth` | float32 (H, W), mm, 0 = background: decoded from the captured frames |{exact}
| `{preview}` | small picture of `depth`, scaled to the object's own range: for looking, not for training |
| `depth_min`, `depth_max` | range of `depth` on the object, mm; using them is the *oracle range* track |

Configurations: {configs}.
Each reads only its own columns. `meshes/` holds the objects (PLY, metres) where they are known, `rig.yaml` the camera,
the projector and the sequence.

Scored by `fpp-eval` of fpp-ml-bench: MAE and RMSE in mm over the object, the background and the full grid. The Hub's
own table ranks by {score}.
Single-shot and multi-frame methods, and methods that are given the depth range of a test sample, are separate tasks in
`eval.yaml`.

Fingerprint of the dataset: `{fingerprint}`. Written by fpp-ml-bench {package}.
"""


def dataset_licence(dataset: DatasetFolder, license_id: str | None) -> str:
    """Licence identifier for the card: ``license_id``, or MIT for generated data. `PublishError` for other data without
    it."""
    if license_id is None and dataset.manifest.origin != "generated":
        raise PublishError(
            f"{dataset.path}: {dataset.manifest.origin} data; say under which --license it may be shared"
        )
    licence = license_id or "mit"
    if not _LICENCE.fullmatch(licence):
        raise PublishError(f"--license: expected an identifier like mit or cc-by-4.0, got {licence!r}")
    return licence


def stage_dataset(
    dataset: DatasetFolder, repo: str, folder: Path, licence: str, threads: int = 1,
    row_done: Callable[[int], None] = lambda rows: None,
) -> Publication:  # fmt: skip
    """Write everything that is published of ``dataset`` into ``folder``; the same dataset gives the same bytes.

    Parquet files that are already there are kept; see `publish_staging` for when they are. Raises
    `DatasetError` for a damaged dataset, ``OSError`` when a file can't be written.
    """
    for name, shard in data_shards(dataset).items():
        if (folder / name).is_file():
            row_done(shard.rows)
        else:
            write_shard(dataset, shard, folder / name, threads, row_done)
    for mesh in (file for file in dataset.manifest.others if file.path.startswith(f"{MESH_FOLDER}/")):
        source = dataset.path / mesh.path
        if not source.is_file() or file_hash(source) != mesh.xxh3_128:
            raise DatasetError(f"{source}: missing or damaged, it isn't published; build the dataset again")
        (folder / MESH_FOLDER).mkdir(exist_ok=True)
        shutil.copyfile(source, folder / mesh.path)
    from fpp_ml_bench.optics import save_rig

    save_rig(dataset.rig, folder / RIG_FILE)
    write_atomically(folder / "README.md", _card(dataset, repo, licence).encode())
    write_atomically(folder / EVAL_FILE, _evaluation(dataset).encode())
    about = {"fingerprint": dataset.fingerprint, "size": list(dataset.size), "configs": list(dataset.configs)}
    write_atomically(folder / MARK, mark_bytes("dataset", **about, splits=dataset.splits))
    return Publication("dataset", repo, folder, f"FPP-ML-Bench dataset {dataset.fingerprint[:12]}", OWNED)


def _yaml(content: Any) -> str:
    import yaml

    text: str = yaml.safe_dump(content, sort_keys=False, width=110, allow_unicode=False)
    return text


def _evaluation(dataset: DatasetFolder) -> str:
    return _yaml(
        {
            "name": BENCHMARK,
            "description": f"Depth from fringe images in structured light. {SCORE_TEXT[0].upper()}{SCORE_TEXT[1:]}.",
            "evaluation_framework": FRAMEWORK,
            "tasks": tasks_of(dataset.configs),
        }
    )


def _card(dataset: DatasetFolder, repo: str, licence: str) -> str:
    manifest = dataset.manifest
    rows = sum(len(samples) for samples in dataset.splits.values())
    files: dict[str, list[str]] = {split: [] for split in dataset.splits}
    for name, shard in data_shards(dataset).items():
        files[shard.split].append(name)
    head = {
        "license": licence,
        "pretty_name": BENCHMARK,
        "task_categories": ["depth-estimation"],
        "size_categories": ["n<1K" if rows < 1000 else "1K<n<10K" if rows < 10_000 else "10K<n<100K"],
        "tags": ["fringe-projection-profilometry", "structured-light", "metrology", "fpp-ml-bench"],
        "configs": [
            {
                "config_name": config,
                **({"default": True} if config == dataset.configs[0] else {}),
                "version": data_version(dataset.fingerprint),
                # Files by name, not by pattern: a stray file can never join the data.
                "data_files": [{"split": split, "path": list(paths)} for split, paths in files.items()],
                "columns": columns(dataset, config),
            }
            for config in dataset.configs
        ],
    }
    exact = "\n| `depth_exact` | the same, exact, from the ray cast that made the frames |" if dataset.has_exact else ""
    body = _BODY.format(
        rows=rows, height=dataset.size[0], width=dataset.size[1], origin=manifest.origin, repo=repo,
        splits="\n".join(_split_row(split, manifest.samples[split]) for split in dataset.splits),
        config=dataset.configs[-1], split=list(dataset.splits)[-1], exact=exact, preview=PREVIEW,
        configs=", ".join(f"`{config}`" for config in dataset.configs), score=SCORE_TEXT,
        fingerprint=dataset.fingerprint, package=__version__,
    )  # fmt: skip
    return f"---\n{_yaml(head)}---\n{body}"


def _split_row(split: str, rows: list[dict[str, Any]]) -> str:
    objects = dict.fromkeys(row["object"] for row in rows)
    return f"| {split} | {len(rows)} | {', '.join(markdown_text(name) for name in objects)} |"
