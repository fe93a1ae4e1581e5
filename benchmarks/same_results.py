"""Does the program still compute the same? Records what every command computes, and compares it bit
for bit.

    python benchmarks/same_results.py record FILE.json [--only SECTION] [--skip SECTION] [--keep DIR]
    python benchmarks/same_results.py compare FILE.json [--only SECTION] [--skip SECTION] [--keep DIR]

Knows only the installed commands and plain file formats, and nothing of the package: modules can
move between the two. Every item is a hash, with the numbers beside it where they are small. Left
out are times, dates, machine and versions. Items are named after the spelling that commands had at
first, so that an old record can be compared: `spelled` has that of today. ``compare`` prints one
line for each item that differs; exit status 1 if there is one. Sections: build, train, predict,
leaderboard, reports. About eight minutes on one core.
"""

import argparse
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import yaml
from safetensors import safe_open

SECTIONS = ("build", "train", "predict", "leaderboard", "reports")
LEFT_OUT = re.compile(
    r"created|.*seconds.*|hardware|software|environment|generator|working_memory_mib|load|.*_s|runs|peak_.*"
)
"""Keys of JSON and YAML files that hold times, dates, the machine or versions."""
THREE = "mug,mustard_bottle,power_drill"
SETS = {
    "mini": "--preset mini",
    "small": "--preset mini --size 224",
    "three": f"--objects {THREE} --size 224",
    "shadows": f"--objects {THREE} --size 224 --shadows",
    "varied": "--objects bowl,mug,power_drill --size 224 --placement varied --seed 7",
    "noisy": f"--objects {THREE} --size 224 --noise-sigma 3 --pitch 40 --rig three/rig.yaml",
    "deep": "--objects power_drill --size 480 --shadows --placement varied",
    "vertical": f"--objects {THREE} --size 224 --frames vertical --no-skip",
    "own-mesh": "--mesh own.ply --size 224 --frames sinusoidal",
    "every-object": "--preset full --size 176 --frames single_shot",
    "crossed": f"--objects {THREE} --size 480 --rig crossed",
}
RECIPES = {
    "normalization": "raw global individual",
    "background_removed": "raw global individual",
    "multi_frame": "horizontal all",
    "loss": "l1 masked_rmse masked_l1 hybrid_rmse_0.7 hybrid_l1_0.7",
    "architecture": "transunet resunet pix2pix hformer",
}
SHORT = {"width": 4, "max_epochs": 2, "pairs_per_epoch": 4, "validation_pairs": 2, "batch": 2}
SCORED = ("normalization", "background_removed", "architecture")
METHODS = (
    "classical mini",
    "classical mini --steps 3",
    "classical mini --steps 4 --direction vertical",
    "classical mini --steps 9 --direction horizontal",
    "classical mini --fewest",
    "classical mini --depth-noise 0.5",
    "classical mini --direction vertical --no-skip",
    "classical three --split all",
    "classical shadows",
    "classical varied --steps 6",
    "classical noisy --direction horizontal",
    "classical own-mesh --split all",
    "classical deep --fewest",
    "phase mini",
    "phase mini --fringe vertical",
    "phase mini --frames 2",
    "phase mini --frames 3",
    "phase mini --frames 3 --fringe vertical",
    "phase mini --frames 6",
    "phase mini --error-mm 3",
    "phase mini --prior standoff",
    "phase mini --no-shading",
    "phase mini --min-confidence 0.5",
    "phase three --split all",
    "phase shadows",
    "phase varied",
    "phase noisy",
    "phase own-mesh --split all",
    "phase vertical --fringe vertical",
    "unet-global-rmse small",
    "unet-global-rmse mini",
    "unet-individual-rmse small",
    "unet-individual-rmse three --split all --frame 20",
    "unet-individual-hybrid_l1_0.7 small",
    "unet-individual-hybrid_l1_0.7 varied",
    "crossed crossed",
    "crossed crossed --frames 3",
    "crossed crossed --min-confidence 0.5 --split all",
    "crossed mini",
    "fringe-net crossed",
    "fringe-net mini",
    "fringe-net noisy",
    "fringe-net deep --min-confidence 0.5",
    "no-such-method mini",
)


SPELLINGS = (
    (r"^fpp-bench build (\w\S*)", r"fpp-bench build --out \1"),
    (r"^(fpp-bench build .*)--frames (\S+)", r"\1--config \2"),
    (r"^(fpp-bench (?:import|export) \w\S*) (\w\S*)", r"\1 --out \2"),
    (r"^(fpp-bench info .*)--json$", r"\1--json -"),
    (r"--dataset ", ""),
    (r"--fringe ", "--direction "),
    (r" --no-skip", ""),
)
"""Patterns of the first spellings of commands, and what they are today."""


def spelled(command: str) -> tuple[str, dict[str, str]]:
    """A command in the spelling of today, and what it needs in the environment."""
    for pattern, now in SPELLINGS:
        command, before = re.sub(pattern, now, command), command
        if "--no-skip" in before and "--no-skip" not in command:
            return command, {"FPP_BENCH_SKIP": "0"}
    return command, {}


def digest(value: bytes) -> dict[str, Any]:
    return {"sha256": hashlib.sha256(value).hexdigest()}


def numbers(value: Any) -> dict[str, Any]:
    """Hash of plain values and the values themselves; NaN, -0.0 and every bit of a float have their
    own text."""
    return {**digest(json.dumps(value, sort_keys=True).encode()), "value": value}


def array(value: np.ndarray[Any, Any]) -> dict[str, Any]:
    return digest(f"{value.dtype.str} {value.shape} ".encode() + value.tobytes())


def text(words: str) -> list[str]:
    """Lines without the package's version and the folders of absolute paths."""
    words = re.sub(
        r"(?<!\S)/(?:[^\s/:]+/)+", "", re.sub(r"fpp-ml-bench \d+\.\d+\.\d+", "fpp-ml-bench", words)
    )
    return [line.rstrip() for line in words.splitlines()]


def steady(value: Any) -> Any:
    """``value`` without what differs between two runs; text that is itself JSON is read."""
    if isinstance(value, dict):
        return {
            key: steady(inner) for key, inner in value.items() if not LEFT_OUT.fullmatch(str(key))
        }
    if isinstance(value, list):
        return [steady(inner) for inner in value]
    if isinstance(value, str) and value.startswith("{"):
        return steady(json.loads(value))
    return value


def contents(path: Path, name: str, is_data: bool) -> Iterator[tuple[str, dict[str, Any]]]:
    """Items of one file, read as its suffix says; any other file by its bytes. ``is_data``: its
    times and dates too."""
    clean = (lambda value: value) if is_data else steady
    if path.suffix == ".json":
        value = clean(json.loads(path.read_text()))
        listed = [key for key in ("cases", "points") if isinstance(value, dict) and key in value]
        for key in listed:  # hundreds of entries: an item each
            for number, entry in enumerate(value.pop(key)):
                yield f"{name} {key} {number}", numbers(entry)
        yield name, numbers(value)
    elif path.suffix == ".jsonl":
        yield name, numbers([clean(json.loads(line)) for line in path.read_text().splitlines()])
    elif path.suffix in (".yaml", ".yml"):
        yield name, numbers(clean(yaml.safe_load(path.read_text())))
    elif path.suffix == ".md":
        yield name, numbers(text(path.read_text()))
    elif path.suffix == ".npy":
        yield name, array(np.load(path))
    elif path.suffix == ".safetensors":
        with safe_open(path, "np") as file:
            # A checkpoint's own hash covers its times.
            yield (
                name,
                numbers(
                    {key: v for key, v in steady(file.metadata() or {}).items() if key != "sha256"}
                ),
            )
            for key in sorted(file.keys()):
                yield f"{name} {key}", array(file.get_tensor(key))
    elif path.suffix == ".parquet":
        table = pq.read_table(path).combine_chunks()
        yield f"{name} schema", digest(table.schema.to_string(truncate_metadata=False).encode())
        for column in table.column_names:
            sink = pa.BufferOutputStream()
            part = table.select([column]).replace_schema_metadata(None)
            with pa.ipc.new_stream(sink, part.schema) as writer:
                writer.write_table(part)
            yield f"{name} {column}", digest(sink.getvalue().to_pybytes())
    elif path.suffix == ".html":
        words = re.sub(r"(?s)<(style|script|svg)\b.*?</\1>|<[^>]*>", " ", path.read_text())
        yield name, digest(" ".join(words.split()).encode())
    else:
        yield name, digest(path.read_bytes())


@dataclass
class Recorder:
    """Runs commands in ``work``, where all paths are relative, and keeps what they compute, by
    section and item."""

    work: Path
    wanted: tuple[str, ...]
    items: dict[str, dict[str, dict[str, Any]]] = field(default_factory=dict)

    def run(self, section: str, command: str, *written: str, output: bool = False) -> bool:
        """One command, and items of the files or folders that it wrote, and of its standard output
        if asked."""
        start = perf_counter()
        now, needed = spelled(command)
        arguments = now.split()
        program = Path(sys.executable).parent / arguments[0]
        variables = {"OMP_NUM_THREADS": "1", "COLUMNS": "160", "NO_COLOR": "1", **needed}
        done = subprocess.run(
            [program, *arguments[1:]],
            cwd=self.work,
            env={**os.environ, **variables},
            capture_output=True,
            text=True,
        )
        if done.returncode:
            message = done.stderr[
                max(done.stderr.find("error:"), 0) :
            ]  # a progress bar can stand before it
            self.add(
                section, command, numbers([done.returncode, *text(message), *text(done.stdout)])
            )
        elif output:
            self.add(section, f"{command}: output", numbers(text(done.stdout)))
        for name in written:
            root = self.work / name
            for path in sorted(root.rglob("*")) if root.is_dir() else [root] * root.exists():
                if path.is_file():
                    for item, value in contents(
                        path, path.relative_to(self.work).as_posix(), section == "leaderboard"
                    ):
                        self.add(section, f"{command}: {item}", value)
        print(f"{section:12} {perf_counter() - start:5.1f} s  {command}", flush=True)
        if done.returncode:
            print(
                f"{'':12} exit status {done.returncode}: {' '.join(done.stderr.split())[-300:]}",
                flush=True,
            )
        return done.returncode == 0

    def add(self, section: str, item: str, value: dict[str, Any]) -> None:
        if section in self.wanted:
            self.items.setdefault(section, {})[item] = value

    def predict(self, section: str, method: str, number: int) -> None:
        """Predictions of ``METHOD DATASET [OPTIONS]``, and their scores against exact depth."""
        out = f"predictions/{section}-{number}"
        if self.run(section, f"fpp-bench predict {method} --threads 1 --out {out}", out):
            name, split = method.split()[1], "all" if "--split all" in method else "test"
            result = f"--split {split} --target depth_exact --json {out}.json"
            self.run(section, f"fpp-eval {out} --dataset {name} {result}", f"{out}.json")


def build(recorder: Recorder) -> None:
    """The datasets, which the other sections need too."""
    for name, options in SETS.items():
        if name == "own-mesh":
            shutil.copy(recorder.work / "three/meshes/mug.ply", recorder.work / "own.ply")
        recorder.run("build", f"fpp-bench build {name} {options} --workers 1", name)
        if "build" in recorder.wanted:
            recorder.run("build", f"fpp-bench info {name} --json", output=True)
    if "build" in recorder.wanted:
        for command in (
            "info three",
            "info mini",
            "verify three",
            "verify mini",
            "verify every-object",
            "info none",
        ):
            recorder.run("build", f"fpp-bench {command}", output=True)
        recorder.run("build", "fpp-bench build bad --objects no_such_object")


def train(recorder: Recorder) -> None:
    """Two short epochs of every shipped recipe; the weights of a part of them predict and are
    scored."""
    for number, (table, row) in enumerate(
        (table, row) for table, rows in RECIPES.items() for row in rows.split()
    ):
        content: dict[str, Any] = {"extends": f"{table}/{row}", **SHORT}
        if row == "transunet":
            content["options"] = {"map_size": 14, "patch": 2}
        recorder.work.joinpath(f"{table}-{row}.yaml").write_text(yaml.safe_dump(content))
        out = f"runs/{table}-{row}"
        trained = recorder.run(
            "train", f"fpp-bench train {table}-{row}.yaml small --out {out}", out
        )
        if trained and table in SCORED:
            recorder.predict("train", f"{out}/weights.safetensors small", number)
    out = "runs/fringe-net"
    recorder.run(
        "train", f"fpp-bench train fringe-net --steps 2 --rigs 1 --unions 0 --out {out}", out
    )
    recorder.predict("train", f"fringe-net small --weights {out}/fringe-net-42.safetensors", 99)
    recorder.run("train", "fpp-bench train loss/l1 mini --out runs/refused")
    recorder.run("train", "fpp-bench train loss/none small --out runs/refused")
    recorder.run("train", "fpp-bench reproduce --list", output=True)


def predict(recorder: Recorder) -> None:
    """Every method, and the commands that read predictions."""
    for number, method in enumerate(METHODS):
        recorder.predict("predict", method, number)
    first, second = "predictions/predict-0", "predictions/predict-13"
    scored = f"fpp-eval {second} --dataset mini"
    recorder.run("predict", f"{scored} --json plain.json --edge-band 5", "plain.json")
    recorder.run("predict", f"{scored} --split validation --json none.json")
    recorder.run(
        "predict",
        f"fpp-eval compare {first}.json {second}.json --json pair.json",
        "pair.json",
        output=True,
    )
    recorder.run("predict", f"fpp-eval verify {second}.json {second} --dataset mini", output=True)
    recorder.run("predict", "fpp-eval schema", output=True)
    shutil.copytree(recorder.work / second, recorder.work / "npz")
    for path in sorted(recorder.work.glob("npz/*.npy")):
        np.savez(path.with_suffix(".npz"), depth=np.load(path))
        path.unlink()
    recorder.run("predict", "fpp-eval npz --dataset mini --json npz.json", "npz.json")
    path.with_suffix(".npz").unlink()
    recorder.run("predict", "fpp-eval npz --dataset mini --json npz-refused.json")


def leaderboard(recorder: Recorder) -> None:
    """Tables and page of the shipped rows. Their times are data here, and text of the page, so they
    stay."""
    recorder.run("leaderboard", "fpp-bench leaderboard --page page", "page")
    files = ("ranking.md", "ranking.json")
    options = "--paper all --markdown ranking.md --json ranking.json"
    recorder.run("leaderboard", f"fpp-bench leaderboard {options}", *files, output=True)
    recorder.run(
        "leaderboard", "fpp-bench leaderboard --sort overall_rmse_mm --paper none", output=True
    )


def reports(recorder: Recorder) -> None:
    for form in ("parquet", "mat", "meshes", "patterns"):
        recorder.run("reports", f"fpp-bench export three {form} --{form}", form)
    recorder.run("reports", "fpp-bench import mat refused --workers 1")
    recorder.run("reports", "fpp-bench export mini published --mat --split test")
    recorder.run("reports", "fpp-bench import published imported --workers 1", "imported")
    recorder.run("reports", "fpp-bench show three mug_A0 --out mug.png", "mug.png")
    methods = (
        "classical small --steps 4",
        "phase small",
        "phase small --fringe vertical --frames 3",
        "unet-individual-rmse small",
    )
    for number, method in enumerate(methods):
        command = f"fpp-bench reliance {method} --views 1 --threads 1 --json reliance-{number}.json"
        recorder.run("reports", command, f"reliance-{number}.json")
    recorder.run(
        "reports", "fpp-bench stability --quick --out stability", "stability/stability.json"
    )
    for number, method in enumerate(("unet-individual-rmse small", "phase small")):
        command = f"fpp-bench diagnose {method} --quick --threads 1 --out diagnosis-{number}"
        recorder.run("reports", command, f"diagnosis-{number}/diagnose.json")
    recorder.run("reports", "fpp-bench tradeoff small --list", output=True)
    command = "fpp-bench tradeoff small --quick --out tradeoff"
    recorder.run("reports", command, "tradeoff/tradeoff.json")
    commands = (
        "build import info verify show export train predict time tradeoff reproduce reliance "
        "diagnose leaderboard"
    )
    for command in ("", *commands.split(), "stability", "publish"):
        recorder.run("reports", f"fpp-bench {command} --help", output=True)
    for command in ("", "compare", "verify"):
        recorder.run("reports", f"fpp-eval {command} --help", output=True)


def record(wanted: tuple[str, ...], keep: Path | None) -> dict[str, dict[str, dict[str, Any]]]:
    """Runs everything; the items by section."""
    if keep is not None:
        keep.mkdir(parents=True)
    with tempfile.TemporaryDirectory() as folder:
        recorder = Recorder((keep or Path(folder)).resolve(), wanted)
        for section in (build, train, predict, leaderboard, reports):
            if section is build or section.__name__ in wanted:
                start = perf_counter()
                section(recorder)
                print(f"{section.__name__:12} {perf_counter() - start:5.0f} s in all", flush=True)
    return recorder.items


def leaves(value: Any, at: str = "") -> Iterator[tuple[str, str]]:
    """Path and text of every single value."""
    pairs = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else None
    )
    if not pairs:
        yield at, json.dumps(value)
    else:
        for key, inner in pairs:
            yield from leaves(inner, f"{at}/{key}")


def difference(old: dict[str, Any] | None, new: dict[str, Any] | None) -> str:
    """What differs between two items, in words."""
    if old is None or new is None:
        return "is new" if old is None else "is missing"
    if "value" not in old or "value" not in new:
        return f"{old['sha256'][:12]} is now {new['sha256'][:12]}"
    was, now = dict(leaves(old["value"])), dict(leaves(new["value"]))
    changed = [key for key in {**was, **now} if was.get(key) != now.get(key)]
    first = ", ".join(f"{key} {was.get(key)} is now {now.get(key)}" for key in changed[:2])
    return f"{len(changed)} values: {first}"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "action", choices=("record", "compare"), help="write FILE, or run again and compare with it"
    )
    parser.add_argument("file", type=Path, metavar="FILE.json", help="what was recorded")
    parser.add_argument(
        "--only", nargs="+", choices=SECTIONS, default=SECTIONS, help="only these sections"
    )
    parser.add_argument(
        "--skip", nargs="+", choices=SECTIONS, default=(), help="not these sections"
    )
    parser.add_argument(
        "--keep", type=Path, metavar="DIR", help="new folder to work in, which stays"
    )
    args = parser.parse_args()
    before = json.loads(args.file.read_text()) if args.action == "compare" else {}
    after = record(tuple(name for name in args.only if name not in args.skip), args.keep)
    count = sum(len(items) for items in after.values())
    if args.action == "record":
        args.file.write_text(json.dumps(after, indent=1))
        print(f"{args.file}: {count} items")
        return 0
    different = 0
    for section, items in after.items():
        for item in {**before.get(section, {}), **items}:
            old, new = before.get(section, {}).get(item), items.get(item)
            if old is None or new is None or old["sha256"] != new["sha256"]:
                different += 1
                print(f"{section}: {item}: {difference(old, new)}")
    print(f"{count} items, {different or 'none'} different")
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(main())
