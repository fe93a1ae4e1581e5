"""Valid files of every kind that comes from outside, and mutations of them: each must read, or end
in an FppBenchError that names the file."""

import json
import math
import random
import shutil
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from copy import deepcopy
from dataclasses import dataclass
from hashlib import sha256
from io import StringIO
from pathlib import Path
from typing import Any
from warnings import catch_warnings

import trimesh
import yaml
from scored_dataset import make_dataset, write_predictions
from synthetic import make

from fpp_ml_bench.baselines.training.recipe import load_recipe
from fpp_ml_bench.cli import main
from fpp_ml_bench.errors import FppBenchError
from fpp_ml_bench.evaluation.result.file import read_result, write_result
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.evaluation.submission.description import read_submission
from fpp_ml_bench.leaderboard.row_file import row_of, write_row
from fpp_ml_bench.leaderboard.rows import read_entry
from fpp_ml_bench.loaders.captures.images import read_splits
from fpp_ml_bench.loaders.published.importing import import_rows, plan_import
from fpp_ml_bench.loaders.render.light import load_light
from fpp_ml_bench.loaders.render.meshes import read_mesh_list
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.loaders.storage.verification import verify
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.rig_file import load_projection, load_rig

ODD: tuple[Any, ...] = (
    None,
    True,
    False,
    0,
    1,
    -1,
    0.5,
    -0.0,
    1e-320,
    1e308,
    -1e308,
    math.nan,
    math.inf,
    2**31,
    2**63,
    -(2**63),
    10**30,
    10**400,
    "",
    " ",
    "0",
    "x" * 100_000,
    "../../x",
    "/etc/passwd",
    "a/b",
    "a\\b",
    "\0",
    "\x1b[31m",
    "\u202e",
    "\ud800",
    "2001-99-99",
    "1e5",
    "~",
    "<b>",
    "é" * 300,
    [],
    {},
    [[]],
    [{}],
    {"": None},
    {"name": "x"},
    [0] * 1000,
    [1, "x", None],
    json.loads("[" * 60 + "]" * 60),
)
"""Values that take the place of others."""
ODD_BYTES = (
    b"*a",
    b"&a ",
    b"!!int ",
    b"!!timestamp ",
    b"\xff",
    b"\0",
    b"[" * 99,
    b"9" * 99,
    b"- ",
    b": ",
    b"\n",
    b"\t",
    b"<<: ",
    b"1e9999",
    b"\\ud800",
    b"%",
    b"---\n",
)
SEQUENCES: dict[str, dict[str, Any]] = {
    "phase shift": {
        "order": ["white", "vertical"],
        "vertical": {"scheme": "phase-shift", "pitches_px": [114, 1824], "steps": 3, "sign": -1},
    },
    "Gray code": {
        "vertical": {"scheme": "gray", "cell_px": 2, "inverse": "after each"},
        "horizontal": {
            "scheme": "phase-shift",
            "pitch_px": 36,
            "shifts_deg": [0, 90, 180, 270],
            "gray": {"cell_px": 18, "bits": 6},
        },
    },
    "crossed": {
        "order": ["crossed", "white"],
        "crossed": {
            "pitches_px": [18, 14],
            "angles_deg": [0, 90],
            "weights": [0.5, 0.5],
            "shifts_deg": [[0, 0], [120, 0]],
        },
    },
}
RECIPE = {
    "extends": "base",
    "network": "unet",
    "normalisation": "raw",
    "batch": 4,
    "loss": {"name": "rmse"},
}


@dataclass(frozen=True)
class Source:
    """A valid file, ``content`` its plain values, and what ``read`` does with it; ``sealed`` makes
    a mutation's hash right again, as who mutates it on purpose would."""

    file: Path
    content: Any
    read: Callable[[], object]
    sealed: Callable[[Any], Any] = lambda content: content

    def text(self, content: Any) -> bytes:
        if self.file.suffix == ".json":
            return json.dumps(content).encode()
        return yaml.safe_dump(content, sort_keys=False).encode()

    def mutations(self, count: int, seed: int) -> Iterator[bytes]:
        """As many mutations of the bytes as of the values."""
        valid = self.text(self.content)
        for number in range(count):
            chance = random.Random(f"{self.file.parent.name} {seed} {number}")
            changed = None if number % 2 else self.sealed(_changed(self.content, chance))
            yield _changed_bytes(valid, chance) if number % 2 else self.text(changed)

    def outcome(self, mutation: bytes) -> str:
        """``read``, ``refused``, or what else was raised."""
        self.file.write_bytes(mutation)
        return outcome(self.read, self.file)


def outcome(read: Callable[[], object], file: Path) -> str:
    """``read``, ``refused`` with an FppBenchError that names ``file`` or its folder, or what else
    was raised."""
    try:
        with (
            redirect_stdout(StringIO()),
            redirect_stderr(StringIO()),
            catch_warnings(action="error"),
        ):
            read()
    except FppBenchError as error:
        return (
            "refused"
            if file.name in str(error) or str(file.parent) in str(error)
            else f"unnamed: {error}"
        )
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return "read"


def _changed_bytes(valid: bytes, chance: random.Random) -> bytes:
    data, place = bytearray(valid), chance.randrange(len(valid))
    kind = chance.randrange(6)
    if kind == 0:
        return bytes(data[:place])
    if kind == 1:
        del data[place : place + chance.randrange(1, 20)]
    elif kind == 2:
        data[place:place] = data[place // 2 : place // 2 + chance.randrange(1, 200)]
    elif kind == 3:
        data[place:place] = chance.choice(ODD_BYTES)
    else:
        for _ in range(chance.randrange(1, 4)):
            data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    return bytes(data)


def _changed(content: Any, chance: random.Random) -> Any:
    """A copy in which up to three keys or values are others, gone, or given again elsewhere."""
    content = deepcopy(content)
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        places = list(_places(content))
        if not places:
            return content
        holder, key = chance.choice(places)
        kind = chance.randrange(8)
        if kind == 0:
            del holder[key]
        elif kind == 1 and isinstance(holder, dict):
            holder[str(chance.choice(("", "x", "__class__", "é", "../x", "\x1b", key * 2)))] = (
                holder.pop(key)
            )
        elif kind == 2:
            other, theirs = chance.choice(places)
            holder[key] = deepcopy(other[theirs])
        elif kind == 3 and isinstance(holder[key], int | float):
            holder[key] = chance.choice(
                (-holder[key], holder[key] * 1000, holder[key] // 7, str(holder[key]))
            )
        elif kind == 4 and isinstance(holder, list):
            holder.extend(deepcopy(holder[:50]))
        else:
            holder[key] = deepcopy(chance.choice(ODD))
    return content


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    for key in (
        value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    ):
        yield value, key
        yield from _places(value[key])


def sealed_manifest(content: Any) -> Any:
    """The manifest's content with the fingerprint that it then has."""
    if not isinstance(content, dict):
        return content
    counted = {
        key: value
        for key, value in content.items()
        if key not in ("others", "generator", "fingerprint")
    }
    return {
        **content,
        "fingerprint": sha256(json.dumps(counted, sort_keys=True).encode()).hexdigest(),
    }


def _verified(folder: Path) -> None:
    """What commands do with a dataset: open, describe and verify it. Findings are what `verify` is
    for."""
    verify(folder)
    opened = DatasetFolder(folder)
    main(["info", str(folder)])
    for sample in opened.samples("all"):
        opened.depth_mm(sample)


def sources(folder: Path) -> dict[str, Source]:
    """A source for each reader, with all that it needs, in new folders below ``folder``."""
    made: dict[str, Source] = {}

    def add(
        name: str, file: str, content: Any, read: Callable[[Path], object], **more: Any
    ) -> None:
        path = folder / name.replace(" ", "-") / file
        path.parent.mkdir(parents=True, exist_ok=True)
        made[name] = Source(path, content, lambda: read(path), **more)

    dataset = make(folder / "manifest")
    manifest = json.loads((dataset / "manifest.json").read_text())
    add(
        "manifest",
        "manifest.json",
        manifest,
        lambda path: _verified(path.parent),
        sealed=sealed_manifest,
    )
    rig = paper_rig().to_dict()
    add("rig", "rig.yaml", rig, load_rig)
    add("rig as JSON", "rig.json", rig, load_rig)
    coded = {key: value for key, value in rig.items() if key != "pitch_px"}
    for scheme, sequence in SEQUENCES.items():
        add(f"rig, {scheme}", "rig.yaml", {**coded, "sequence": sequence}, load_rig)
    add("projection", "rig.yaml", rig, load_projection)
    meshes = [
        {"name": "part", "path": "part.stl", "scale": 0.001, "rotation_deg": [90, 0, 0.5]},
        {
            "name": "other",
            "path": "part.stl",
            "offset_m": [0, 0, 0.1],
            "centre": False,
            "split": "train",
        },
    ]
    add("mesh list", "list.yaml", meshes, read_mesh_list)
    trimesh.creation.box((1.0, 1.0, 1.0)).export(folder / "mesh-list" / "part.stl")
    add("light", "light.yaml", load_light("workshop").model_dump(mode="json"), load_light)
    add("recipe", "recipe.yaml", RECIPE, load_recipe)
    splits = {"train": ["gear", "bolt"], "validation": ["nut"], "test": ["plate"]}
    add("splits", "splits.yaml", splits, read_splits)
    scored = make_dataset(folder / "scored")
    predictions = write_predictions(folder / "submission", scored, offset_mm=1.0, noise_mm=1.0)
    result = evaluate(predictions, scored)
    described = yaml.safe_load((predictions / "submission.yaml").read_text())
    add("submission", "submission.yaml", described, lambda path: read_submission(path.parent))
    write_result(result, folder / "result.json")
    add("result", "result.json", json.loads((folder / "result.json").read_text()), read_result)
    row = folder / "row.json"
    write_row(row_of(result, row), row)
    add("row", "row.json", json.loads(row.read_text()), read_entry)
    return made


ODD_STEMS = ("x" * 120, "a b", "é", "<b>", "..x", "-", "a\\b", "x\x1b[31m")


def tree_outcome(tree: Path, work: Path, seed: int) -> str:
    """`outcome` of importing a copy of the published ``tree`` of which a file was changed, renamed,
    moved or removed, all in the folder ``work``, which must be new."""
    chance = random.Random(f"tree {seed}")
    copy = shutil.copytree(tree, work / "tree")
    files = sorted(path for path in copy.rglob("*") if path.is_file())
    file, kind = chance.choice(files), chance.randrange(6)
    if kind < 2:
        file.write_bytes(_changed_bytes(file.read_bytes(), chance))
    elif kind == 2:
        for other in (other for other in files if other.stem == file.stem):
            other.rename(other.with_stem(f"{chance.choice(ODD_STEMS)}_A0"))
    elif kind == 3:
        file.rename(chance.choice(files))
    else:
        file.unlink()
    if kind == 5:
        file.symlink_to(chance.choice(("/dev/zero", "nowhere", str(file.parent))))
    return outcome(lambda: import_rows(work / "out", plan_import(copy), 1), copy)
