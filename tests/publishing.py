"""What the tests of publishing share: a dataset of random frames, and ``fpp-bench publish`` towards
one server."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from hub_server import HubServer
from scored_dataset import disk_depth

from fpp_ml_bench.loaders.sample import Row
from fpp_ml_bench.loaders.storage.assembly import Assembly
from fpp_ml_bench.loaders.storage.manifest import Manifest, describe_file
from fpp_ml_bench.loaders.storage.shards import ShardWriter, plan_shards
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.sequence import PAPER_SEQUENCE

ROOT = Path(__file__).resolve().parent.parent
SIZE = (30, 26)
OBJECTS = {"train": ("bowl", "cork"), "validation": ("mug",), "test": ("power_drill",)}
ODD_OBJECT = "__odd__-name_"
DATA = [f"data/{split}-00000-of-00001.parquet" for split in OBJECTS]
"""Its Parquet files."""


def make_all_frames(folder: Path, odd: bool = False, seed: int = 0) -> DatasetFolder:
    """All 52 frames of random pixels: what no codec may change. One object may have a name that is
    markup."""
    (folder / "meshes").mkdir(parents=True)
    manifest = Manifest("generated", {}, {}, paper_rig(960).to_dict(), SIZE, "all", exact=True)
    plans, receipts = [], []
    rng = np.random.default_rng(seed)
    for split, names in OBJECTS.items():
        names = (*names, ODD_OBJECT) if odd and split == "train" else names
        views = {name: [(f"{name}_{view}", name, view) for view in ("A0", "A60")] for name in names}
        for plan in plan_shards(split, views):
            rows = []
            for sample, name, view in plan.samples:
                frames = dict(
                    enumerate(rng.integers(0, 256, (len(PAPER_SEQUENCE), *SIZE), dtype=np.uint8))
                )
                depth = np.nextafter(disk_depth(SIZE, len(rows)), np.float32(5000)).astype(
                    np.float32
                )
                maps = np.zeros(depth.shape, np.uint8), np.full(depth.shape, 255, np.uint8)
                rows.append(
                    Row(sample, name, view, frames, depth, depth * np.float32(1.0001), {}, *maps)
                )
            plans.append(plan)
            receipts.append(ShardWriter(manifest).write(folder, plan, rows))
    mesh = folder / "meshes" / "bowl.ply"
    mesh.write_bytes(b"ply\nformat ascii 1.0\nend_header\n")
    others = [describe_file(folder, mesh)]
    manifest = replace(manifest, others=others)
    Assembly(plans, lambda plan, folder: (), manifest).filled(receipts).write(folder)
    return DatasetFolder(folder)


_SERVE = """
import json, sys
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from fpp_ml_bench.cli import main
for line in sys.stdin:
    out, err = StringIO(), StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        status = main(["publish", *json.loads(line)])
    print(json.dumps([status, out.getvalue(), err.getvalue()]), flush=True)
"""
"""Runs one call a line: starting Python and importing the client takes longer than publishing these
few kilobytes."""


class Client:
    """``fpp-bench publish`` in a process of its own, which alone sees the environment of one
    server."""

    def __init__(self, server: HubServer, home: Path) -> None:
        self.server, self.home = server, home
        self._process = self._start()

    def environment(self, **changes: str | None) -> dict[str, str]:
        plain = {
            name: value
            for name, value in os.environ.items()
            if not name.startswith(("HF_", "HUGGING"))
        }
        own = {
            "HF_ENDPOINT": self.server.endpoint,
            "HF_HUB_DISABLE_XET": "1",
            "HF_TOKEN": "hf_good",
            "HF_HOME": str(self.home),
            "HF_HUB_DISABLE_TELEMETRY": "1",
            "PYTHONPATH": str(ROOT),
            **changes,
        }
        return {**plain, **{name: value for name, value in own.items() if value is not None}}

    def _start(self, **environment: str | None) -> "subprocess.Popen[str]":
        return subprocess.Popen(
            [sys.executable, "-c", _SERVE],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=self.home.parent,
            env=self.environment(**environment),
        )

    def run(self, *calls: str | list[str], **environment: str | None) -> list[tuple[int, str, str]]:
        """Exit status, standard output and standard error of each call, a line or its words."""
        process = self._start(**environment) if environment else self._process
        lines = [call.split() if isinstance(call, str) else call for call in calls]
        answers = [self._answer(process, words) for words in lines]
        if environment:
            stop(process)
        return answers

    def _answer(self, process: "subprocess.Popen[str]", call: list[str]) -> tuple[int, str, str]:
        assert process.stdin is not None and process.stdout is not None
        process.stdin.write(json.dumps(call) + "\n")
        process.stdin.flush()
        line = process.stdout.readline()
        assert line, f"fpp-bench publish {call} ended the process: a traceback, see above"
        status, out, err = json.loads(line)
        return status, out, err

    def good(self, call: str | list[str], **environment: str | None) -> str:
        ((status, out, err),) = self.run(call, **environment)
        assert status == 0, err
        return out

    def close(self) -> None:
        stop(self._process)
        self.server.shutdown()
        self.server.server_close()


def stop(process: "subprocess.Popen[str]") -> None:
    process.communicate(timeout=60)


@contextmanager
def running_hub(home: Path) -> Iterator[Client]:
    client = Client(HubServer(), home)
    try:
        yield client
    finally:
        client.close()


def listed(output: str) -> dict[str, str]:
    """Status by path, as printed."""
    return {
        path: status for status, path in re.findall(r"(?m)^  . (\w+) +[\d.]+ \w+  (.+)$", output)
    }
