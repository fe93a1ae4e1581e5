"""The commands ``fpp-bench`` and ``fpp-eval``.

Each command is a module of this package with ``SUMMARY``, ``EXAMPLES``, ``add_arguments(parser)`` and ``run(args)``.
Only the module of the command that runs is imported, and such a module imports numpy and the rest inside ``run``, so
``--help`` answers at once. This package may import every subpackage; none of them imports it.
"""

import argparse
import math
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from time import monotonic
from types import FrameType, ModuleType, SimpleNamespace
from typing import Any

from fpp_ml_bench import __version__
from fpp_ml_bench.errors import FppBenchError, PoolError
from fpp_ml_bench.files import DISK_FULL, cause_of
from fpp_ml_bench.machine import usable_cores

OK, CHECK_FAILED, BAD_INPUT, INTERRUPTED, CUT_OFF, TERMINATED = 0, 1, 2, 130, 141, 143
SPLITS = ("train", "validation", "test", "all")
Command = ModuleType | SimpleNamespace

EXTRAS = {
    "train": ("torch", "torchmetrics", "accelerate", "safetensors"),
    "diagnose": ("captum", "mpmath"),
    "published": ("h5py",),
    "onnx": ("onnx", "onnxruntime", "onnxscript"),
    "cluster": ("ray",),
}
"""The optional parts of the package (pyproject.toml) and the libraries that only they need."""

COMMANDS: dict[str, tuple[str, str]] = {
    "build": ("build", "generate the benchmark: virtual rig, 50 objects, 6 views, 52 frames"),
    "import": ("import_tree", "read a published tree, or a scanner's captures, into the same dataset format"),
    "calibrate": ("calibrate", "find the rig that took captures, from frames and their depth"),
    "patterns": ("patterns", "write the images to project, for any sequence"),
    "design": ("design", "find two carriers for crossed fringes whose phases leave one order"),
    "decode": ("decode", "decode captured frames: depth, point cloud, uncertainty, reasons"),
    "info": ("info", "describe a dataset: sizes, splits, rig, ground-truth uncertainty"),
    "verify": ("verify", "check a dataset: checksums, missing and foreign files, split leaks"),
    "show": ("show", "one sample as a picture: frames, depth, mask, mesh"),
    "export": ("export", "write Parquet, the published .mat tree, meshes or patterns"),
    "train": ("train", "train a recipe, shipped or yours, into a weights file"),
    "predict": ("predict", "run a method over a split and write predictions that fpp-eval scores"),
    "conformal": ("conformal", "scale a stated uncertainty so that its intervals hold what they say"),
    "fuse": ("fuse", "put an object's views into one point cloud, and find the pixels that other views contradict"),
    "time": ("time", "measure a method: latency, throughput, memory, parameters, frames"),
    "tradeoff": ("tradeoff", "error against run time and captures, and how each cost grows"),
    "reproduce": ("reproduce", "train and score the rows of the paper's tables, beside its numbers"),
    "reliance": ("reliance", "measure phase reliance: does a prediction follow the fringes or the outline"),
    "robustness": ("robustness", "disturb the scene, axis by axis: light, camera, surface, calibration, motion"),
    "diagnose": ("diagnose", "probe a model: does it read fringes or shapes; an HTML report"),
    "leaderboard": ("leaderboard", "rank result files: error and run time side by side"),
    "stability": ("stability", "stiff and extreme cases against higher precision and theory"),
    "publish": ("publish", "put a dataset, the leaderboard or results on the Hugging Face Hub"),
}

_EPILOG = """\
examples:
  fpp-bench build data/mini --preset mini
  fpp-bench predict classical data/mini --split test --out predictions
  fpp-eval predictions --dataset data/mini --split test --json result.json
  fpp-bench leaderboard result.json

fpp-bench COMMAND --help shows its options. Exit status: 0 done, 1 a check failed, 2 bad input or failed, 130 stopped
(143 by SIGTERM), 141 nobody reads the output.
"""


def count(most: int = 100_000) -> Callable[[str], int]:
    """Type of an option: a whole number from 1 to ``most``."""

    def parsed(text: str) -> int:
        if not text.isdecimal() or not 1 <= int(text) <= most:
            raise argparse.ArgumentTypeError(f"expected a whole number from 1 to {most}, got {text!r}")
        return int(text)

    return parsed


def add_pool_options(parser: argparse.ArgumentParser) -> None:
    """``--workers`` and ``--cluster``, for `workers_of`."""
    parser.add_argument("--workers", type=int, metavar="N", help="processes (default: as many as there are processors)")
    parser.add_argument(
        "--cluster",
        metavar="ADDRESS",
        help="all CPUs of a Ray cluster instead: ray://HOST:10001, or HOST:6379 on one of its nodes; "
        "they must share the output folder, or write to a URL (docs/scale.md)",
    )


def workers_of(args: argparse.Namespace) -> int:
    """Processes of this machine. Raises `PoolError` for less than one, or beside a cluster."""
    if args.workers is None:
        return usable_cores()
    if args.workers < 1:
        raise PoolError(f"--workers {args.workers}: expected 1 or more")
    if args.cluster is not None:
        raise PoolError("--workers counts processes of this machine, --cluster takes a cluster; give one of them")
    return int(args.workers)


_STREAMS = "stdout", "stderr"
_FORMATTER = partial(argparse.RawDescriptionHelpFormatter, max_help_position=30, width=110)
_STYLE: dict[str, Any] = {"formatter_class": _FORMATTER, "allow_abbrev": False}


def parser_for(command: Command, prog: str) -> argparse.ArgumentParser:
    """Argument parser of one command module."""
    epilog = "examples:\n" + "\n".join(f"  {line}" for line in command.EXAMPLES)
    parser = argparse.ArgumentParser(prog, None, command.SUMMARY, epilog, **_STYLE)
    command.add_arguments(parser)
    return parser


def run_command(command: Command, prog: str, argv: Sequence[str]) -> int:
    """Parse ``argv`` and run the command. An error of this package, an unreadable file, a full disk, Ctrl-C or SIGTERM
    becomes a message and a status; where nobody reads the output any more, there is a status alone."""
    return _guarded(prog, lambda: command.run(parser_for(command, prog).parse_args(argv)))


def _guarded(prog: str, action: Callable[[], int]) -> int:
    for name in _STREAMS:
        if getattr(sys, name) is None:  # closed by the caller: its number must not become that of a data file
            setattr(sys, name, Path(os.devnull).open("w"))  # noqa: SIM115
    status, leaving = OK, None
    try:
        status = _status_of(prog, action)
    except SystemExit as stop:  # of --help or a wrong option, and of rich where its output is closed
        if isinstance(stop.__context__, BrokenPipeError):
            status = CUT_OFF
        else:
            leaving = stop
    for name in _STREAMS:
        try:
            getattr(sys, name).flush()
        except OSError as error:
            setattr(sys, name, None)  # or the flush at exit fails, too
            if status == OK:
                closed = isinstance(error, BrokenPipeError)
                status = CUT_OFF if closed else _refused(prog, f"standard output: {cause_of(error)}")
    if leaving is not None and status == OK:
        raise leaving
    return status


def _status_of(prog: str, action: Callable[[], int]) -> int:
    try:
        with _terminable():
            return action()
    except BrokenPipeError:
        return CUT_OFF
    except FppBenchError as error:
        return _refused(prog, error)
    except OSError as error:
        name = error.filename
        if name is None and error.errno in DISK_FULL:  # that of a file has its name by `naming`
            name = "standard output or a temporary file"
        return _refused(prog, f"{'' if name is None else f'{name}: '}{cause_of(error)}")
    except ModuleNotFoundError as error:
        library = (error.name or "").partition(".")[0]
        extra = next((extra for extra, libraries in EXTRAS.items() if library in libraries), None)
        if extra is None:
            raise
        return _refused(prog, f"this needs {library}, which is not installed; pip install 'fpp-ml-bench[{extra}]'")
    except KeyboardInterrupt as stop:
        _say(f"{prog}: stopped")
        return TERMINATED if isinstance(stop, _Terminated) else INTERRUPTED


class _Terminated(KeyboardInterrupt):
    """SIGTERM, which ends a command as Ctrl-C does: temporary files and locks are removed, and workers end."""


@contextmanager
def _terminable() -> Iterator[None]:
    """Raise `_Terminated` within on SIGTERM, but once for the two that ``timeout`` sends. While a module is imported,
    where libraries swallow any exception, the process ends as without this."""
    last_s = -math.inf

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal last_s
        if monotonic() - last_s < 1:
            return
        last_s = monotonic()
        while frame is not None:
            if frame.f_code.co_filename.startswith("<frozen importlib"):
                signal.signal(number, signal.SIG_DFL)
                signal.raise_signal(number)
            frame = frame.f_back
        raise _Terminated

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _refused(prog: str, problem: object) -> int:
    _say(f"{prog}: error: {problem}")
    return BAD_INPUT


def _say(text: str) -> None:
    with suppress(OSError):
        print(text, file=sys.stderr)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point of ``fpp-bench``."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments and arguments[0] in COMMANDS:
        module = import_module(f"fpp_ml_bench.cli.{COMMANDS[arguments[0]][0]}")
        return run_command(module, f"fpp-bench {arguments[0]}", arguments[1:])
    return _guarded("fpp-bench", partial(_without_command, arguments))


def _without_command(arguments: list[str]) -> int:
    """Help, version, or what is wrong with the command's name."""
    width = max(map(len, COMMANDS))
    listing = "\n".join(f"  {name:<{width}}  {summary}" for name, (_, summary) in COMMANDS.items())
    usage = "fpp-bench [--help] [--version] COMMAND ..."
    description = "FPP-ML-Bench: build, load, predict, score and rank single-shot fringe projection profilometry."
    parser = argparse.ArgumentParser("fpp-bench", usage, description, f"commands:\n{listing}\n\n{_EPILOG}", **_STYLE)
    parser.add_argument("--version", action="version", version=f"fpp-ml-bench {__version__}")
    parser.add_argument("command", nargs="?", metavar="COMMAND", help=argparse.SUPPRESS)
    args, unknown = parser.parse_known_args(arguments)
    if unknown and unknown[0] == arguments[0]:
        return _refused("fpp-bench", f"unknown option {arguments[0]!r} before a command; see fpp-bench --help")
    if args.command is not None:
        from difflib import get_close_matches

        matches = get_close_matches(args.command, COMMANDS, n=1)
        hint = f"; did you mean {matches[0]!r}?" if matches else f"; there are {', '.join(COMMANDS)}"
        return _refused("fpp-bench", f"unknown command {args.command!r}{hint}")
    parser.print_help(sys.stderr if not arguments else sys.stdout)
    return BAD_INPUT
