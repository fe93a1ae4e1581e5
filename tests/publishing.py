"""What the tests of publishing share: a dataset of random frames, and ``fpp-bench publish`` towards one server."""

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from hub_server import HubServer
from scored_dataset import disk_depth

from fpp_ml_bench.frames import PAPER_SEQUENCE
from fpp_ml_bench.loaders.manifest import Manifest, describe_file
from fpp_ml_bench.loaders.shards import Row, ShardWriter, plan_shards
from fpp_ml_bench.loaders.store import DatasetFolder
from fpp_ml_bench.rig import paper_rig

ROOT = Path(__file__).resolve().parent.parent
SIZE = (30, 26)
OBJECTS = {"train": ("bowl", "cork"), "validation": ("mug",), "test": ("power_drill",)}
ODD_OBJECT = "<b>_[x](y)|`z`"
DATA = [f"data/{split}-00000-of-00001.parquet" for split in OBJECTS]
"""Its Parquet files."""


def make_all_frames(folder: Path, odd: bool = False, seed: int = 0) -> DatasetFolder:
    """All 52 frames of random pixels: what no codec may change. One object may have a name full of markup."""
    scratch = folder / "scratch"
    scratch.mkdir(parents=True)
    (folder / "meshes").mkdir()
    shards, samples = [], {}
    rng = np.random.default_rng(seed)
    for split, names in OBJECTS.items():
        names = (*names, ODD_OBJECT) if odd and split == "train" else names
        views = {name: [(f"{name}_{view}", name, view) for view in ("A0", "A60")] for name in names}
        for plan in plan_shards(split, views):
            rows = []
            for sample, name, view in plan.samples:
                frames = dict(enumerate(rng.integers(0, 256, (len(PAPER_SEQUENCE), *SIZE), dtype=np.uint8)))
                depth = np.nextafter(disk_depth(SIZE, len(rows)), np.float32(5000)).astype(np.float32)
                rows.append(Row(sample, name, view, frames, depth, depth * np.float32(1.0001)))
            writer = ShardWriter(folder, scratch, plan, PAPER_SEQUENCE, "all", True, SIZE)
            files, described = writer.write(rows)
            shards += files
            samples.setdefault(split, []).extend(described)
    shutil.rmtree(scratch)
    mesh = folder / "meshes" / "bowl.ply"
    mesh.write_bytes(b"ply\nformat ascii 1.0\nend_header\n")
    Manifest(
        origin="generated", generator={}, settings={}, rig=paper_rig(960).to_dict(), size=SIZE, stored="all",
        exact=True, samples=samples, shards=shards, others=[describe_file(folder, mesh)],
    ).write(folder)  # fmt: skip
    return DatasetFolder(folder)


class Client:
    """``fpp-bench publish`` in a process of its own, as a user runs it, towards one server."""

    def __init__(self, server: HubServer, home: Path) -> None:
        self.server, self.home = server, home

    def environment(self, **changes: str | None) -> dict[str, str]:
        plain = {name: value for name, value in os.environ.items() if not name.startswith(("HF_", "HUGGING"))}
        ours = {
            "HF_ENDPOINT": self.server.endpoint, "HF_HUB_DISABLE_XET": "1", "HF_TOKEN": "hf_good",
            "HF_HOME": str(self.home), "HF_HUB_DISABLE_TELEMETRY": "1", "PYTHONPATH": str(ROOT), **changes,
        }  # fmt: skip
        return {**plain, **{name: value for name, value in ours.items() if value is not None}}

    def run(self, *calls: list[str], **environment: str | None) -> list[tuple[int, str, str]]:
        """Exit status, standard output and standard error of each call; the calls share one process."""
        code = (
            "import sys, json\nfrom contextlib import redirect_stdout, redirect_stderr\nfrom io import StringIO\n"
            "from fpp_ml_bench.commands import main\nsaid = []\n"
            "for call in json.loads(sys.argv[1]):\n"
            "    out, err = StringIO(), StringIO()\n"
            "    with redirect_stdout(out), redirect_stderr(err):\n"
            "        status = main(['publish', *call])\n"
            "    said.append((status, out.getvalue(), err.getvalue()))\n"
            "print(json.dumps(said))"
        )
        done = subprocess.run(
            [sys.executable, "-c", code, json.dumps(calls)], capture_output=True, text=True, cwd=self.home.parent,
            env=self.environment(**environment), timeout=120,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return [tuple(said) for said in json.loads(done.stdout)]

    def good(self, call: list[str], **environment: str | None) -> str:
        ((status, out, err),) = self.run(call, **environment)
        assert status == 0, err
        return out


@contextmanager
def running_hub(home: Path) -> Iterator[Client]:
    server = HubServer()
    try:
        yield Client(server, home)
    finally:
        server.shutdown()
        server.server_close()


def listed(said: str) -> dict[str, str]:
    """Status by path, as printed."""
    return {path: status for status, path in re.findall(r"(?m)^  . (\w+) +[\d.]+ \w+  (.+)$", said)}
