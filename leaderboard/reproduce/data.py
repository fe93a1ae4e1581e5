"""The dataset that the tables are reproduced on: built where it is missing, and the same for every row of a run."""

import json
from collections.abc import Callable
from pathlib import Path

from fpp_ml_bench.constants import FULL_SIZE, OBJECTS
from fpp_ml_bench.errors import DatasetError
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.leaderboard.reproduce.plan import Folders, Job, common_size
from fpp_ml_bench.loaders.storage import MANIFEST, DatasetFolder
from fpp_ml_bench.machine import usable_cores

Report = Callable[[str], object]


def default_folder(preset: str, size: int) -> Path:
    """``data/full`` for the benchmark's own size, else named after preset and size, like ``data/cpu224``."""
    return Path("data") / ("full" if size == FULL_SIZE else f"{preset}{size}")


def open_dataset(folder: Path | None, jobs: list[Job], folders: Folders, report: Report) -> DatasetFolder:
    """The dataset in ``folder`` (default: see `default_folder`), built there first where there is none.

    Every table uses all 50 objects and 52 frames, so that all share a dataset and its fingerprint.

    Raises DatasetError for a dataset of another image size than the preset's, without a frame that a row needs, or
    another dataset than the trainings in the runs folder; BuildError where it can't be built.
    """
    size = common_size(jobs)
    folder = default_folder(folders.preset, size) if folder is None else folder
    if not (folder / MANIFEST).is_file():
        _build(folder, size, report)
    opened = DatasetFolder(folder)
    build = f"fpp-bench build DIR --preset full{'' if size == FULL_SIZE else f' --size {size}'}"
    if opened.size != (size, size):
        height, width = opened.size
        raise DatasetError(
            f"{folder}: expected images of {size} x {size} px, which preset {folders.preset} trains on, got {width} x "
            f"{height}; give another --data, or none to have it built, or build it: {build}"
        )
    for job in jobs:
        if job.recipe.data_config not in opened.configs:
            raise DatasetError(
                f"{folder}: {job.places[0].recipe_name} needs the frames of {job.recipe.data_config}, stored are "
                f"those of {', '.join(opened.configs)}; build it with all frames: {build}"
            )
    _check_same_dataset(opened, folders)
    return opened


def _build(folder: Path, size: int, report: Report) -> None:
    from fpp_ml_bench.loaders.render import BuildSettings, build
    from fpp_ml_bench.optics import paper_rig

    report(f"{folder}: building {len(OBJECTS)} objects at {size} px, all frames")
    build(folder, BuildSettings(rig=paper_rig(size), objects=OBJECTS), usable_cores())


def _check_same_dataset(opened: DatasetFolder, folders: Folders) -> None:
    """Record the dataset in the runs folder; refuse a dataset other than the recorded one."""
    record = folders.dataset_record
    content = {"fingerprint": opened.fingerprint, "size": list(opened.size), "folder": str(opened.path)}
    try:
        if not record.is_file():
            folders.runs.mkdir(parents=True, exist_ok=True)
            write_atomically(record, (json.dumps(content, indent=1) + "\n").encode("utf-8"))
            return
        recorded = json.loads(record.read_text(encoding="utf-8"))
        fingerprint, recorded_folder = recorded["fingerprint"], recorded["folder"]
    except OSError as error:
        raise DatasetError(f"{record}: {error.strerror or error}") from None
    except (ValueError, KeyError, TypeError):
        raise DatasetError(
            f"{record}: damaged; give another --runs, or remove it if --data is the dataset that was used"
        ) from None
    if fingerprint != opened.fingerprint:
        raise DatasetError(
            f"{opened.path}: has fingerprint {opened.fingerprint[:8]}, but the trainings in {folders.runs} are of "
            f"{str(fingerprint)[:8]} ({recorded_folder}); give that dataset as --data, or another --runs"
        )
