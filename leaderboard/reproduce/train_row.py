"""The training behind a row: whether it may start on this machine, its state, and the weights file it gives."""

import json
import shlex
import shutil
from collections.abc import Sequence
from pathlib import Path

from fpp_ml_bench.baselines.networks import save_with_heads
from fpp_ml_bench.baselines.training import DONE, RECIPE, WEIGHTS, Recipe, TrainingRun
from fpp_ml_bench.errors import TrainingError
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.leaderboard.reproduce.plan import PREDICTED, Folders, Job, variants
from fpp_ml_bench.leaderboard.reproduce.row import file_sha256
from fpp_ml_bench.loaders.storage import DatasetFolder

PAPER_PRESET = "paper"


def is_trained(out: Path) -> bool:
    """Whether a training folder holds a finished training."""
    return (out / DONE).is_file()


def state_of(out: Path) -> str:
    """``trained``, ``begun`` or ``missing``."""
    return "trained" if is_trained(out) else "begun" if out.is_dir() and any(out.iterdir()) else "missing"


def check_run_folders(jobs: Sequence[Job], folders: Folders) -> None:
    """Refuse, before hours of work, a training folder that was made by another recipe. Nothing is ever deleted.

    Raises TrainingError, which names the folder, the settings that differ and the cure.
    """
    for job in jobs:
        path = folders.training(job.recipe) / RECIPE
        if not path.is_file():
            continue
        try:
            stored = json.loads(path.read_text(encoding="utf-8"))["recipe"]
            differs = _differing(job.recipe, stored)
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise TrainingError(f"{path}: expected the recipe of a training, it can't be read ({error})") from None
        if differs:
            out = shlex.quote(str(path.parent))
            raise TrainingError(
                f"{path.parent}: holds a training of another recipe, {job.places[0].recipe_name} differs in "
                f"{differs}; to keep both, mv {out} {out}-before, or give another --runs"
            )


def _differing(recipe: Recipe, stored: dict[str, object]) -> str:
    current = recipe.to_dict()
    keys = [key for key in {**current, **stored} if current.get(key) != stored.get(key)]
    return ", ".join(f"{key} ({stored.get(key)} there, {current.get(key)} in the recipe)" for key in keys)


def check_machine(jobs: Sequence[Job], folders: Folders, anyway: bool, command: str) -> None:
    """Refuse the paper's preset without a GPU where something is left to train. TrainingError with the command."""
    untrained = [job for job in jobs if not is_trained(folders.training(job.recipe))]
    if folders.preset != PAPER_PRESET or anyway or not untrained or _gpu():
        return
    size = untrained[0].recipe.size
    raise TrainingError(
        f"preset {PAPER_PRESET} trains networks of full width on {size} x {size} px until the rate has reached its "
        f"minimum, and PyTorch sees no CUDA GPU here, where that would take weeks; nothing was started, and no row "
        f"will be estimated. On a machine with a GPU run, as often as its time allows:\n  {command}\n"
        "or add --anyway to train on this processor all the same"
    )


def _gpu() -> bool:
    import torch

    return bool(torch.cuda.is_available())


def finished_weights(job: Job, run: TrainingRun, opened: DatasetFolder, folders: Folders, keep: bool) -> Path:
    """The weights file to score and to ship: the best epoch's, with range heads where a row needs them.

    ``keep``: a file that was made from the same weights is used as it is.
    """
    target = folders.weights(job.recipe)
    record = target.with_suffix(".json")
    source = file_sha256(run.weights)
    if keep and _made_from(record, target, source):
        return target
    target.parent.mkdir(parents=True, exist_ok=True)
    if PREDICTED in variants(job.recipe):
        save_with_heads(run.weights, opened.path, target)
    else:
        partial = target.with_suffix(".partial")
        shutil.copyfile(run.weights, partial)
        partial.replace(target)
    content = {"made_from_sha256": source, "sha256": file_sha256(target)}
    write_atomically(record, (json.dumps(content) + "\n").encode("utf-8"))
    return target


def current_weights(recipe: Recipe, folders: Folders) -> Path | None:
    """The file that `finished_weights` made from the finished training; None while there is none."""
    out, target = folders.training(recipe), folders.weights(recipe)
    if not is_trained(out) or not (out / WEIGHTS).is_file() or not _is_of(recipe, out / RECIPE):
        return None
    return target if _made_from(target.with_suffix(".json"), target, file_sha256(out / WEIGHTS)) else None


def _is_of(recipe: Recipe, record: Path) -> bool:
    try:
        return bool(json.loads(record.read_text(encoding="utf-8"))["recipe"] == recipe.to_dict())
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _made_from(record: Path, target: Path, source: str) -> bool:
    try:
        recorded = json.loads(record.read_text(encoding="utf-8"))
        return bool(recorded == {"made_from_sha256": source, "sha256": file_sha256(target)})
    except (OSError, ValueError):
        return False
