"""Peak memory of each command against rows and image size: each command in a process, its largest resident set.

    python benchmarks/peak_memory.py [--rows 24,48,96] [--sizes 240,480,960] [--folder DIR]

Every command runs as a process of its own (``fpp-bench ... --workers 1``), and the figure is its ``ru_maxrss``
(getrusage(2)), imports and shared libraries included. First the rows grow at 240 px, then the size at 24 rows (one
shard). A command whose memory is constant in rows shows the same figure three times, to a few MiB of noise.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from fpp_ml_bench.constants import OBJECTS, VIEWS, split_of  # noqa: E402

ROWS_AT_PX = 240
_RUN = "import sys; sys.path.insert(0, sys.argv.pop(1)); from fpp_ml_bench.{module} import main; sys.exit(main())"


def command(name: str, *arguments: str) -> list[str]:
    module = "cli.evaluate" if name == "fpp-eval" else "cli"
    first = [] if name == "fpp-eval" else [name]
    return [sys.executable, "-c", _RUN.format(module=module), str(ROOT), *first, *arguments]


def peak_mib(arguments: list[str]) -> float:
    """Largest resident set of a process, MiB. Raises `SystemExit` where it fails."""
    process = subprocess.Popen(arguments, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    error = process.stderr.read() if process.stderr else b""
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{' '.join(arguments[3:])}: {error.decode()[-2000:]}")
    return usage.ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


def measure(folder: Path, rows: int, size: int) -> dict[str, float]:
    """MiB by command, on a dataset of its own that is removed again."""
    names = [name for name in OBJECTS if split_of(name) == "train"][: rows // len(VIEWS)]
    scratch = Path(tempfile.mkdtemp(prefix="fpp-memory-", dir=folder))
    data = str(scratch / "set")
    try:
        build = command("build", "--out", data, "--size", str(size), "--objects", ",".join(names), "--workers", "1")
        peaks = {"build": peak_mib(build)}
        for method, options in (("classical", ()), ("classical --fewest", ("--steps", "3")), ("phase", ())):
            out = str(scratch / f"predictions-{len(peaks)}")
            arguments = (*method.split(), data, "--split", "train", "--out", out, *options)
            peaks[f"predict {method}"] = peak_mib(command("predict", *arguments))
        peaks["fpp-eval"] = peak_mib(command("fpp-eval", out, data, "--split", "train"))
        peaks["verify"] = peak_mib(command("verify", data))
        peaks["info"] = peak_mib(command("info", data))
        return peaks
    finally:
        shutil.rmtree(scratch)


def table(title: str, columns: list[str], results: list[dict[str, float]]) -> None:
    print(f"\n{title}")
    print(f"{'command':<28}" + "".join(f"{column:>12}" for column in columns))
    for name in results[0]:
        print(f"{name:<28}" + "".join(f"{result[name]:>8.0f} MiB" for result in results), flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", default="24,48,96", help="rows at 240 px, each a multiple of 6 up to 240")
    parser.add_argument("--sizes", default="240,480,960", help="image sizes at the first number of rows")
    parser.add_argument("--folder", type=Path, help="where the datasets go (default: a temporary folder)")
    args = parser.parse_args()
    rows, sizes = ([int(number) for number in numbers.split(",")] for numbers in (args.rows, args.sizes))
    by_rows = [measure(args.folder, count, ROWS_AT_PX) for count in rows]
    table(f"rows at {ROWS_AT_PX} px", [f"{count} rows" for count in rows], by_rows)
    by_size = [by_rows[0] if size == ROWS_AT_PX else measure(args.folder, rows[0], size) for size in sizes]
    table(f"image size at {rows[0]} rows", [f"{size} px" for size in sizes], by_size)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
