"""What the leaderboard puts on the Hub: the tasks in a dataset's repository, the page as a static
Space, results.

The Hub ranks by the greatest value and knows no unit. So an error becomes a score that falls
strictly with it, 100 / (1 + object MAE / 10 mm): 0 mm: 100; 1 mm: 90.9; 10 mm: 50; 100 mm: 9.1. The
millimetres are in the notes. Own definition; 10 mm is the widest tolerance that this benchmark
counts pixels within.
"""

import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from huggingface_hub import EvalResultEntry, eval_result_entries_to_yaml

from fpp_ml_bench import __version__
from fpp_ml_bench.baselines.from_hub import CONFIG, FILE_MARK, KEY, WEIGHTS
from fpp_ml_bench.baselines.registry import code_of, find
from fpp_ml_bench.baselines.training.weights import open_weights
from fpp_ml_bench.constants import CONFIGS
from fpp_ml_bench.errors import PredictionError, PublishError
from fpp_ml_bench.evaluation.protocol import Track
from fpp_ml_bench.files import printable
from fpp_ml_bench.leaderboard.columns import given_truth
from fpp_ml_bench.leaderboard.page.page import INDEX, SUBMISSIONS, write_page
from fpp_ml_bench.leaderboard.ranking import expand, rank, read_entries, shipped_rows
from fpp_ml_bench.leaderboard.row_file import Row
from fpp_ml_bench.leaderboard.rows import Entry, read_entry
from fpp_ml_bench.leaderboard.tables import chosen_tables
from fpp_ml_bench.loaders.hub import MARK, PICTURE, Publication, card_head, mark_bytes
from fpp_ml_bench.loaders.sample import SINGLE_SHOT_FRAME
from fpp_ml_bench.loaders.storage.card import NAME, card_end, title, yaml_text
from fpp_ml_bench.loaders.storage.parquet import published_features
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.style import millimetres, percent
from fpp_ml_bench.tables import markdown_text

FRAMEWORK = "fpp-ml-bench"
SPLIT, TARGET, MODE = "test", "depth", "standard"
SCORE_HALF_MM = 10.0
SCORE_TEXT = "score = 100 / (1 + object MAE / 10 mm), higher is better"
_SCORE_DIGITS = 6
CARD_FILE, EVAL_FILE, RESULT_FOLDER = "README.md", "eval.yaml", ".eval_results"
_BODY = """\
# {title}: single-shot fringe projection profilometry

![Above: the first frame of some objects. Below: their depth, near yellow, far blue, background black.]({picture})

{rows} samples of {height} x {width} px ({origin} data): what a structured-light camera sees of an object under
projected fringes, and the depth of every pixel. No object is in two splits.

| split | samples | objects |
| --- | ---: | --- |
{splits}

```python
import datasets

rows = datasets.load_dataset("{repo}", "{config}", split="{split}").with_format("numpy")
```

Configurations: {configs}.
Each reads only its own columns. `meshes/` holds the objects (PLY, metres) where they are known, `rig.yaml` the camera,
the projector and the sequence.

Scored by `fpp-eval` of fpp-ml-bench: MAE and RMSE in mm over the object, the background and the full grid. The Hub's
own table ranks by {score}.
Single-shot and multi-frame methods, and methods that are given the depth range of a test sample, are separate tasks in
`eval.yaml`.

Fingerprint of the dataset: `{fingerprint}`. Written by fpp-ml-bench {package}.

{end}"""


_METHOD = """\
# {repo}

A method of fringe projection profilometry for [fpp-ml-bench](https://pypi.org/project/fpp-ml-bench): {words}.

```bash
fpp-bench predict hf://{repo} DATASET --out predictions{run}
fpp-eval predictions DATASET
```
"""
TRACKS: tuple[Track, ...] = ("metric", "oracle range")
"""Those that have tasks on the Hub; each has one for a frame and one for more."""


def task_id(single_shot: bool, track: Track) -> str:
    """The name of a ranking on the Hub."""
    return f"{'single_shot' if single_shot else 'multi_frame'}_depth{'' if track == TRACKS[0] else '_oracle_range'}"


def hub_score(object_mae_mm: float) -> float:
    """Score in [0, 100] of an object MAE in mm (0 or more); 6 decimals."""
    return round(100.0 / (1.0 + object_mae_mm / SCORE_HALF_MM), _SCORE_DIGITS)


def task_of(row: Row, name: str) -> str:
    """The task that a result belongs to; `PublishError`, naming the file ``name``, where it belongs
    to none."""
    if (row.dataset.split, row.target, row.mode) != (SPLIT, TARGET, MODE):
        raise PublishError(
            f"{name}: the Hub's benchmark is scored on the {SPLIT} split against {TARGET} in "
            f"{MODE} mode, this result "
            f"on {row.dataset.split} against {row.target} in {row.mode} mode; score the "
            f"predictions so first"
        )
    if row.track not in TRACKS:
        raise PublishError(
            f"{name}: the Hub's benchmark has no task for the {row.track} track (the method was "
            f"given "
            f"{given_truth(row.track)}); publish a result of a method that finds the object and "
            f"the fringe order itself"
        )
    return task_id(set(row.submission.frames_used) <= {SINGLE_SHOT_FRAME}, row.track)


def dataset_texts(dataset: DatasetFolder, repo: str, licence: str) -> dict[str, str]:
    """What a dataset's repository ``repo`` says beside its data: the card, and the registration of
    the tasks."""
    widest = max(dataset.configs, key=CONFIGS.index)
    tasks = [
        {"id": task_id(single, track), "config": CONFIGS[0] if single else widest, "split": SPLIT}
        for single in ([True] if widest == CONFIGS[0] else [True, False])
        for track in TRACKS
    ]
    description = (
        f"Depth from fringe images in structured light. {SCORE_TEXT[0].upper()}{SCORE_TEXT[1:]}."
    )
    evaluation = {
        "name": NAME,
        "description": description,
        "evaluation_framework": FRAMEWORK,
        "tasks": tasks,
    }
    splits = []
    for split in dataset.splits:
        samples = dataset.manifest.samples[split]
        objects = dict.fromkeys(sample["object"] for sample in samples)
        splits.append(
            f"| {split} | {len(samples)} | {', '.join(markdown_text(name) for name in objects)} |"
        )
    body = _BODY.format(
        title=title(dataset.manifest),
        rows=sum(len(samples) for samples in dataset.splits.values()),
        height=dataset.size[0],
        width=dataset.size[1],
        origin=dataset.manifest.origin,
        repo=repo,
        splits="\n".join(splits),
        config=dataset.configs[-1],
        split=list(dataset.splits)[-1],
        picture=PICTURE,
        end=card_end(dataset.manifest, published_features(dataset)),
        configs=", ".join(f"`{config}`" for config in dataset.configs),
        score=SCORE_TEXT,
        fingerprint=dataset.fingerprint,
        package=__version__,
    )
    return {CARD_FILE: card_head(dataset, licence) + body, EVAL_FILE: yaml_text(evaluation)}


def stage_page(
    results: Sequence[Path], repo: str, folder: Path, dataset_repo: str | None = None
) -> Publication:
    """Write the page of result and row files, or of the rows shipped with the package where none
    are named, and the Space's README into ``folder``; ``dataset_repo`` is linked from it. Nothing
    is looked for in the current folder. Raises SubmissionError for a file that is no sound
    result."""
    rows = expand(results) if results else shipped_rows()
    write_page(rank(read_entries(rows)), chosen_tables(None), folder)
    head: dict[str, Any] = {
        "title": "FPP-ML-Bench leaderboard",
        "emoji": "📐",
        "colorFrom": "blue",
        "colorTo": "gray",
        "sdk": "static",
        "app_file": INDEX,
        "pinned": False,
        "license": "mit",
        "short_description": "Depth from one fringe image: error and run time",
        "tags": ["leaderboard", "depth-estimation", "structured-light", "fpp-ml-bench"],
        **({"datasets": [dataset_repo]} if dataset_repo is not None else {}),
    }
    body = (
        f"The page is `{INDEX}`, written by `fpp-bench leaderboard`, sent by `fpp-bench publish`.\n"
    )
    (folder / CARD_FILE).write_bytes(
        f"---\n{yaml_text(head, allow_unicode=True)}---\n{body}".encode()
    )
    (folder / MARK).write_bytes(mark_bytes("leaderboard"))
    return Publication("space", repo, folder, "FPP-ML-Bench leaderboard", (f"{SUBMISSIONS}/",))


def stage_results(
    paths: Sequence[Path],
    repo: str,
    folder: Path,
    scored_on: str,
    revision: str | None,
    content: object,
    source_url: str | None = None,
) -> Publication:
    """Write a file for each result into ``folder``; it replaces an earlier result of the same task.
    Only numbers and fixed words of a result are published, no text that its author wrote. A result
    scored on other data than ``content`` (`DatasetFolder.content`, by the repository's mark) is
    refused, as is a result of another split or target, or without an object score (`PublishError`).
    ``revision`` None: the data can't be compared (a dry run)."""
    if source_url is not None and (
        urlsplit(source_url).scheme != "https" or not urlsplit(source_url).netloc
    ):
        raise PublishError(
            f"--source-url: expected an https address, got {printable(source_url, 120)!r}"
        )
    named: dict[str, Path] = {}
    (folder / RESULT_FOLDER).mkdir()
    for path in paths:
        entry, file = read_entry(path), printable(str(path), 300)
        row = entry.row
        held = content if isinstance(content, dict) else {}
        other = [name for name, digest in row.dataset.content.items() if held.get(name) != digest]
        if other and revision is not None:
            raise PublishError(
                f"{file}: was scored on other data than {scored_on} holds ({other[0]} is "
                f"{row.dataset.content[other[0]]}, there {printable(held.get(other[0]), 40)}); "
                f"score the predictions "
                "on that dataset, or publish this one"
            )
        task = task_of(row, file)
        if task in named:
            raise PublishError(
                f"{printable(str(named[task]), 300)} and {file} are both results of {task}; a "
                f"model has one of "
                "each, publish the other with its own model repository"
            )
        named[task] = path
        error_mm = row.metrics.object_mae_mm
        if error_mm is None:
            raise PublishError(
                f"{file}: has no object score (no sample shows an object), so there is nothing to "
                f"rank by"
            )
        published = EvalResultEntry(
            dataset_id=scored_on,
            task_id=task,
            value=hub_score(error_mm),
            dataset_revision=revision,
            date=row.created[:10],
            source_url=source_url,
            source_name=f"{NAME} leaderboard" if source_url is not None else None,
            notes=_notes(entry),
        )
        name = f"{task}--{scored_on.replace('/', '--')}.yaml"
        (folder / RESULT_FOLDER / name).write_bytes(
            yaml_text(eval_result_entries_to_yaml([published])).encode()
        )
    return Publication("model", repo, folder, f"{NAME} results: {', '.join(named)}", whole=False)


def stage_method(name: str, repo: str, folder: Path) -> Publication:
    """Write what ``load_method("hf://REPO")`` needs into ``folder``: trained weights with their
    configuration, or the files of ``mine.py:Mine``. Raises `PredictionError` and `WeightsError` for
    what is neither, and for code that reads files from elsewhere."""
    found = find(name)
    entry: dict[str, Any] = {}
    config: dict[str, Any] = {}
    if FILE_MARK in name:
        file, _, attribute = name.rpartition(":")
        for part in code_of(found.method):
            if ".." in Path(part).parts:
                raise PredictionError(
                    f"{name}: uses {part}, which lies outside its folder; put it beside the file"
                )
            (folder / part).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(Path(file).parent / part, folder / part)
        entry["method"] = f"{Path(file).name}:{attribute}"
        words, run = f"`{entry['method']}`, code that `--trust` allows to run", " --trust"
    else:
        path = found.options.get("weights")
        if path is None:
            raise PredictionError(
                f"{name}: expected trained weights (a name, a recipe or a .safetensors file) or "
                f"file.py:Class; a method of this package needs no repository"
            )
        weights = open_weights(Path(path))
        shutil.copyfile(weights.path, folder / WEIGHTS)
        config = json.loads(json.dumps(asdict(weights.config)))
        words, run = f"{weights.config.title}, safetensors `{weights.sha256[:12]}`", ""
    (folder / CONFIG).write_text(json.dumps({KEY: entry, **config}, indent=1) + "\n", "utf-8")
    head = {
        "license": "mit",
        "library_name": FRAMEWORK,
        "pipeline_tag": "depth-estimation",
        "tags": ["fringe-projection-profilometry", "structured-light", FRAMEWORK],
    }
    body = _METHOD.format(repo=repo, words=words, run=run)
    (folder / CARD_FILE).write_bytes(f"---\n{yaml_text(head)}---\n{body}".encode())
    (folder / MARK).write_bytes(mark_bytes("method"))
    return Publication("model", repo, folder, f"{NAME} method: {printable(name, 80)}")


def _notes(entry: Entry) -> str:
    row, metrics, seconds = entry.row, entry.row.metrics, entry.value("seconds_per_sample")
    ends = row.intervals.of("object_mae_mm")
    interval = (
        f" (95% interval {millimetres(ends[0])} to {millimetres(ends[1])})"
        if ends is not None
        else ""
    )
    source = "measured" if entry.time_measured else "self-reported"
    time = "" if seconds is None else f"; {seconds:.4g} s per sample, {source}"
    missing = percent(metrics.object_missing_share)
    return (
        f"{SCORE_TEXT}. Object MAE {millimetres(metrics.object_mae_mm)} mm{interval}, RMSE "
        f"{millimetres(metrics.object_rmse_mm)} mm; overall MAE "
        f"{millimetres(metrics.overall_mae_mm)} mm; object "
        f"pixels missing {missing}; {row.dataset.samples} samples of {row.dataset.split}, "
        f"{row.track} track, "
        f"{entry.frames} {'frame' if entry.frames == 1 else 'frames'}{time}; protocol "
        f"{row.protocol_version}, content "
        f"{row.dataset.truth[:12]}"
    )
