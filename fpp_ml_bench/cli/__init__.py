"""The commands ``fpp-bench`` and ``fpp-eval``.

Each command is a function of a module of this package, made a command by `options.command`. Only
the module of the command that runs is imported. This package may import every subpackage; none of
them imports it.
"""

import math
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from time import monotonic
from types import FrameType
from typing import Any, NamedTuple

import click

from fpp_ml_bench import __version__
from fpp_ml_bench.cli.options import help_text, problem_of
from fpp_ml_bench.errors import FppBenchError
from fpp_ml_bench.files import DISK_FULL, cause_of, printable
from fpp_ml_bench.machine import limit_threads, usable_cores
from fpp_ml_bench.options import did_you_mean, nearest

OK, CHECK_FAILED, BAD_INPUT, INTERRUPTED, CUT_OFF, TERMINATED = 0, 1, 2, 130, 141, 143

EXTRAS = {
    "train": ("torch", "torchmetrics", "accelerate", "safetensors"),
    "diagnose": ("captum", "mpmath"),
    "published": ("h5py",),
    "cluster": ("ray",),
}
"""The optional parts of the package (pyproject.toml) and the libraries that only they need."""


class Program(NamedTuple):
    """A program of several commands: ``groups`` has, by heading and name, the place of each as
    ``module:function`` below this package and its line in the help. ``default``: the command that
    runs where the first word names none."""

    name: str
    purpose: str
    groups: dict[str, dict[str, tuple[str, str]]]
    examples: str
    default: str = ""

    @property
    def commands(self) -> dict[str, str]:
        """The place of each command by its name."""
        return {name: place for group in self.groups.values() for name, (place, _) in group.items()}

    def command(self, name: str) -> Any:
        """The `Command` of that name, or a `Program` of several, whose module is imported."""
        module, _, function = self.commands[name].partition(":")
        return getattr(import_module(f"fpp_ml_bench.cli.{module}"), function)


BENCH = Program(
    "fpp-bench",
    "FPP-ML-Bench: build, load, predict, score and rank single-shot fringe projection "
    "profilometry.",
    {
        "start": {
            "demo": (
                "demo:demo",
                "the whole benchmark in small: two objects, three methods, one table; a minute",
            ),
            "build": (
                "build:build",
                "generate the benchmark: virtual rig, 50 objects, 6 views, 52 frames",
            ),
            "import": (
                "import_tree:import_tree",
                "read a published tree, or a scanner's captures, into the same dataset format",
            ),
            "info": (
                "dataset:info",
                "describe a dataset: sizes, splits, rig, ground-truth uncertainty",
            ),
            "show": (
                "dataset:show_sample",
                "one sample as a picture: frames, depth, error, mask, mesh",
            ),
        },
        "score": {
            "predict": (
                "predict:predict",
                "run a method over a split and write predictions that fpp-eval scores",
            ),
            "time": (
                "predict:time",
                "measure a method: latency, throughput, memory, parameters, frames",
            ),
            "leaderboard": (
                "leaderboard:rank",
                "rank result files: error and run time side by side",
            ),
        },
        "understand": {
            "diagnose": (
                "diagnose:diagnose",
                "probe a model: does it read fringes or shapes? An HTML report",
            ),
            "reliance": (
                "diagnose:reliance",
                "measure phase reliance: does the depth follow the fringes or the outline?",
            ),
            "robustness": (
                "diagnose:robust",
                "error where light, camera, surface, calibration or motion disturb the scene",
            ),
            "tradeoff": (
                "tradeoff:measure",
                "error against run time, frames and memory, and how the time grows",
            ),
            "certify": (
                "certify:certify_method",
                "a simulated type test on gauges: probing error, sphere spacing, flatness",
            ),
            "stability": (
                "tradeoff:check",
                "check extreme cases against higher precision and theory",
            ),
        },
        "learn": {
            "train": ("train:train", "train a recipe, shipped or yours, into a weights file"),
            "reproduce": (
                "train:reproduce_tables",
                "train and score the rows of the paper's tables, beside its numbers",
            ),
        },
        "your rig": {
            "patterns": (
                "patterns:patterns",
                "write the images to project, for any sequence; find two carriers for crossed "
                "fringes",
            ),
            "calibrate": (
                "calibrate:calibrate",
                "find the rig that took captures, from poses of a board or from frames with depth",
            ),
            "decode": (
                "decode:decode",
                "decode captured frames: depth, point cloud, uncertainty, reasons",
            ),
        },
        "share": {
            "export": (
                "dataset:export",
                "write Parquet, the published .mat tree, meshes or patterns",
            ),
            "publish": (
                "publish:publish",
                "put a dataset, the leaderboard or results on the Hugging Face Hub",
            ),
            "verify": (
                "dataset:verify",
                "check a dataset: checksums, missing and foreign files, split leaks",
            ),
        },
    },
    """\
fpp-bench build --out data/mini --preset mini
fpp-bench predict classical data/mini --split test --out predictions
fpp-eval predictions --json result.json
fpp-bench leaderboard result.json
""",
)

EVAL = Program(
    "fpp-eval",
    "Score a folder of predictions (fpp-eval PREDICTIONS), and work on results.",
    {
        "commands": {
            "score": (
                "evaluate:score_folder",
                "score a folder of predictions: what fpp-eval does without a command",
            ),
            "init": ("evaluate:init", "write a submission.yaml to fill in"),
            "check": (
                "evaluate:check",
                "check a submission before it is scored, without ground truth",
            ),
            "compare": ("evaluate:compare", "compare two results of the same samples"),
            "verify": (
                "evaluate:verify",
                "score the predictions again, and compare with a result or row",
            ),
            "schema": (
                "evaluate:schema",
                "print the JSON Schema of result.json or submission.yaml",
            ),
        }
    },
    """\
fpp-eval predictions --json result.json
fpp-eval predictions data/mini --split test --target depth_exact --report report
fpp-eval init predictions
fpp-eval check predictions
fpp-eval compare result.json leaderboard/rows/fringe-net-crossed.json
fpp-eval verify result.json predictions data/mini
fpp-eval schema
""",
    default="score",
)
COMMANDS = BENCH.commands
ONE_THREAD = "demo", "predict", "time", "reliance", "robustness", "tradeoff"
"""Commands that compute with one thread unless ``--threads`` says otherwise; `diagnose` with one
for each core."""

CONTINUED = "build", "import", "predict", "diagnose", "robustness", "tradeoff", "train", "reproduce"
"""Commands that keep what a stopped run has finished."""

_STREAMS = "stdout", "stderr"
_LONGEST_LINE = 10_000  # of an error message, in characters
_MEANINGS = """\
{name} COMMAND --help shows its options.
Exit status: 0 done, 1 a check failed, 2 bad input or failed, 130 stopped (143 by SIGTERM), 141 nobody reads the output.
"""


def run_command(load: Callable[[], Any], prog: str, argv: Sequence[str]) -> int:
    """Import a command, parse ``argv`` and run it. An error of this package, an unreadable file, a
    full disk, Ctrl-C or SIGTERM becomes a message and a status; where nobody reads the output any
    more, there is a status alone."""
    for name in _STREAMS:
        if (
            getattr(sys, name) is None
        ):  # closed by the caller: its number must not become that of a data file
            setattr(sys, name, Path(os.devnull).open("w"))  # noqa: SIM115
    try:
        status = _status_of(prog, load, argv)
    except SystemExit as stop:  # of rich where its output is closed
        if not isinstance(stop.__context__, BrokenPipeError):
            raise
        status = CUT_OFF
    for name in _STREAMS:
        try:
            getattr(sys, name).flush()
        except OSError as error:
            setattr(sys, name, None)  # or the flush at exit fails, too
            if status == OK:
                closed = isinstance(error, BrokenPipeError)
                status = (
                    CUT_OFF if closed else _refused(prog, f"standard output: {cause_of(error)}")
                )
    return status


def _status_of(prog: str, load: Callable[[], Any], argv: Sequence[str]) -> int:
    try:
        with _terminable():
            command = load()
            if isinstance(command, Program):
                return run_program(command, argv)
            with command.make_context(prog, list(argv)) as ctx:
                status: int = command.invoke(ctx)
                return status
    except click.exceptions.Exit as leaving:  # of --help and --version
        return leaving.exit_code
    except click.UsageError as error:
        return _refused(error.ctx.command_path if error.ctx else prog, problem_of(error))
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
        return _refused(
            prog,
            f"this needs {library}, which is not installed; pip install 'fpp-ml-bench[{extra}]'",
        )
    except ImportError as error:
        if "shared object" not in str(error):
            raise
        return _refused(
            prog,
            f"a library can't be loaded ({error}); allow more memory (ulimit -v), or install it "
            f"again",
        )
    except MemoryError as error:
        reason = f" ({error})" if str(error) else ""
        return _refused(
            prog,
            f"there is not enough memory{reason}; allow more (ulimit -v), or give less at once",
        )
    except KeyboardInterrupt as stop:
        _say(f"{prog}: stopped{'; the same command continues' * (prog.split()[-1] in CONTINUED)}")
        return TERMINATED if isinstance(stop, _Terminated) else INTERRUPTED


class _Terminated(KeyboardInterrupt):
    """SIGTERM, which ends a command as Ctrl-C does: temporary files and locks are removed, and
    workers end."""


@contextmanager
def _terminable() -> Iterator[None]:
    """Raise `_Terminated` within on SIGTERM, but once for the two that ``timeout`` sends. While a
    module is imported, where libraries swallow any exception, the process ends as without this."""
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
    """Print on standard error, with what in a name or a file would steer the terminal escaped."""
    with suppress(OSError):
        print(
            *(printable(line, _LONGEST_LINE) for line in text.split("\n")),
            sep="\n",
            file=sys.stderr,
        )


def run_program(program: Program, argv: Sequence[str] | None = None) -> int:
    """Run the command that the first word of ``argv`` (default: the process's) names, or the
    default one."""
    words = list(sys.argv[1:] if argv is None else argv)
    if words[:1] == ["help"] and not Path("help").exists():
        words = [*words[1:2], "--help"]
    name, first = program.name, words[0] if words else ""
    # No command depends on a user's settings of matplotlib, which may ask for what is not there or
    # be unreadable.
    os.environ |= {"MATPLOTLIBRC": os.devnull, "MPLBACKEND": "agg"}
    # A folder of predictions has any name; one that is not there and almost that of a command is a
    # slip.
    slip = nearest(first, program.commands) and not Path(first).exists()
    if first in program.commands:
        if first in (*ONE_THREAD, "diagnose"):  # before the command's module loads NumPy
            threads = re.search(r"--threads[ =](\d+)", " ".join(words))
            limit_threads(
                int(threads[1]) if threads else 1 if first in ONE_THREAD else usable_cores()
            )
        name, command, words = f"{name} {first}", first, words[1:]
    elif program.default and first not in ("", "--help", "-h", "--version") and not slip:
        command = program.default
    else:
        return run_command(partial(_without_command, program, first), name, words)
    return run_command(partial(program.command, command), name, words)


def _without_command(program: Program, first: str) -> None:
    """Help, version, or what is wrong with the command's name, raised as click's exception."""
    if first == "--version":
        print(f"fpp-ml-bench {__version__}")
    elif first in ("", "--help", "-h"):
        print(help_of(program), end="", file=sys.stdout if first else sys.stderr)
    elif first.startswith("-"):
        raise click.UsageError(
            f"unknown option {first!r} before a command; see {program.name} --help"
        )
    else:
        raise click.UsageError(
            f"unknown command {first!r}; {did_you_mean(first, program.commands)}"
        )
    raise click.exceptions.Exit(OK if first else BAD_INPUT)


def help_of(program: Program) -> str:
    """The help of a program: its commands by group, and the options of its default command."""
    usages = [(program.name, "[--help] [--version] COMMAND ...")]
    sections = {
        group: [(name, line) for name, (_, line) in commands.items()]
        for group, commands in program.groups.items()
    }
    if program.default:
        command = program.command(program.default)
        ctx = click.Context(command, info_name=program.name)
        usages.append((program.name, command.usage(ctx)))
        sections |= command.sections(ctx)
    text = help_text(usages, program.purpose, sections, program.examples)
    return f"{text}\n{_MEANINGS.format(name=program.name)}"


main = partial(run_program, BENCH)
"""Entry point of ``fpp-bench``."""
main_eval = partial(run_program, EVAL)
"""Entry point of ``fpp-eval``."""
