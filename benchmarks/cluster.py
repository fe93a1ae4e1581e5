"""Builds and FPP-C on a Ray cluster against the local pool: bytes, overhead, and a node that dies in the middle.

    python benchmarks/cluster.py [--objects A,B] [--size 176] [--frames all] [--repeats 3] [--client] [--work DIR]

Starts a cluster of two nodes with a CPU each on this machine, so it has the CPUs of ``--workers 2``. Builds preset
full (300 views) with `fpp-bench build` by the local pool, by the cluster into a folder that both nodes see, and by the
cluster to a URL, in turns, and prints the least seconds of each; the machine should have nothing else to do. Then
measures an axis of FPP-C both ways, and builds once more while a node is killed after a third of the shards. Exit
status 1 if a byte or a score differs. Needs the extra ``cluster``.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from ray.cluster_utils import Cluster

from fpp_ml_bench.files import file_hash
from fpp_ml_bench.loaders.storage import DatasetFolder

NODE = {"num_cpus": 1, "object_store_memory": 1 << 28, "include_dashboard": False, "include_log_monitor": False}
CLIENT_PORT = 25001
COMMAND = [sys.executable, "-m", "fpp_ml_bench"]


def start_cluster(client: bool) -> tuple[Cluster, Any]:
    """A cluster of two nodes, and the one without the head; ``client``: it answers to ``ray://``, too."""
    head = {**NODE, "no_monitor": True, **({"ray_client_server_port": CLIENT_PORT} if client else {})}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    node = cluster.add_node(**NODE)
    cluster.wait_for_nodes()
    return cluster, node


def start(*words: str | Path) -> subprocess.Popen:
    return subprocess.Popen([*COMMAND, *map(str, words)], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def finish(process: subprocess.Popen) -> None:
    _, errors = process.communicate()
    if process.returncode:
        sys.exit(f"{' '.join(map(str, process.args))}: exit status {process.returncode}\n{errors}")


def timed(*words: str | Path) -> float:
    """Seconds of a command."""
    started = time.perf_counter()
    finish(start(*words))
    return time.perf_counter() - started


def hashes(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): file_hash(path) for path in sorted(folder.rglob("*")) if path.is_file()}


def killed_build(words: list[str], folder: Path, cluster: Cluster, node: Any) -> tuple[float, int, int]:
    """Seconds of a build during which ``node`` is killed after a third of the shards, the shards that were finished
    then, and those that the node was writing."""
    work = folder / ".build"
    shards = len({(file.split, file.first_row) for file in DatasetFolder(folder.with_name("local")).manifest.shards})
    started = time.perf_counter()
    process = start(*words)
    while len(list(work.glob("*-of-*.json"))) < shards // 3:
        if process.poll() is not None:
            finish(process)
            sys.exit("the build ended before a node was killed")
        time.sleep(0.05)
    finished = len(list(work.glob("*-of-*.json")))
    cluster.remove_node(node, allow_graceful=False)
    lost: set[str] = set()
    while process.poll() is None:
        time.sleep(0.2)
        # A shard's unfinished file is SHARD.PID.GROUP.tmp; where its process is dead, nobody will finish it.
        names = [path.name.split(".") for path in work.glob("*-of-*.tmp")]
        lost |= {shard for shard, pid, *_ in names if not alive(pid)}
    finish(process)
    return time.perf_counter() - started, finished, len(lost)


def alive(pid: str) -> bool:
    try:
        return Path("/proc", pid, "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def rows(folder: Path) -> dict[str, Any]:
    """What FPP-C measured, without the seconds."""
    contents = {file.name: json.loads(file.read_text()) for file in folder.glob("*/*.json")}
    for content in contents.values():
        for view in content["views"]:
            del view["seconds"]
    return contents


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", metavar="A,B", help="objects (default: all 50)")
    parser.add_argument("--size", type=int, default=176, metavar="PX", help="image size (default: 176)")
    parser.add_argument("--frames", default="all", help="frames to store (default: all)")
    parser.add_argument("--repeats", type=int, default=3, metavar="N", help="builds of each kind (default: 3)")
    parser.add_argument("--client", action="store_true", help="connect by ray://, as from outside of the cluster")
    parser.add_argument("--work", type=Path, help="folder to work in (default: a temporary one, removed afterwards)")
    args = parser.parse_args()
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    settings = ["--preset", "full", "--size", str(args.size), "--frames", args.frames]
    settings += ["--objects", args.objects] if args.objects else []
    cluster, node = start_cluster(args.client)
    address = f"ray://127.0.0.1:{CLIENT_PORT}" if args.client else cluster.address
    same = True
    with tempfile.TemporaryDirectory(dir=args.work) as temporary:
        work = Path(temporary)
        ways = {
            "local": ["--workers", "2"],
            "cluster": ["--cluster", address],
            "url": ["--cluster", address],
        }
        seconds: dict[str, list[float]] = {way: [] for way in ways}
        prints: dict[str, dict[str, str]] = {}
        for repeat in range(args.repeats):
            for way, options in ways.items():
                folder = work / (way if repeat == args.repeats - 1 else f"{way}-{repeat}")
                out = folder.as_uri() if way == "url" else str(folder)
                seconds[way].append(timed("build", "--out", out, *settings, *options))
                print(f"{way}: {seconds[way][-1]:.1f} s", flush=True)
                prints[way] = hashes(folder)
                same &= prints[way] == prints["local"]
                if way != "local" or repeat < args.repeats - 1:
                    shutil.rmtree(folder)
        views = sum(len(part) for part in DatasetFolder(work / "local").splits.values())
        print(f"{views} views of {args.size} px, {len(prints['local'])} files")
        for way, values in seconds.items():
            more = 100 * (min(values) / min(seconds["local"]) - 1)
            equal = "the same bytes" if prints[way] == prints["local"] else "OTHER BYTES"
            print(f"least of {way}: {min(values):.1f} s, {more:+.1f}%, {equal}")

        size = str(args.size)
        words = ["robustness", "constant", "--quick", "--axes", "gloss", "--size", size, "--no-cache", "--out"]
        local_s = timed(*words, work / "fppc", "--workers", "2")
        cluster_s = timed(*words, (work / "fppc-url").as_uri(), "--cluster", address)
        equal = rows(work / "fppc") == rows(work / "fppc-url") != {}
        same &= equal
        print(
            f"FPP-C: local {local_s:.1f} s, cluster {cluster_s:.1f} s, {'same' if equal else 'OTHER'} rows", flush=True
        )

        killed = work / "killed"
        words = ["build", "--out", str(killed), *settings, "--cluster", address]
        killed_s, finished, lost = killed_build(words, killed, cluster, node)
        equal = hashes(killed) == prints["local"]
        same &= equal
        print(
            f"a node killed with {finished} shards finished: {lost} lost, {killed_s:.1f} s, "
            f"{'the same bytes' if equal else 'OTHER BYTES'}"
        )
    cluster.shutdown()
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())
