"""``fpp-bench certify``: a simulated type test of a method on a rig."""

from collections.abc import Mapping
from math import inf
from pathlib import Path

from fpp_ml_bench.baselines.certify.certificate import (
    CAPTURES,
    Certificate,
    certify,
    certify_board,
    scenes_of,
    write_certificate,
)
from fpp_ml_bench.baselines.certify.gauges import gauges
from fpp_ml_bench.calibration.boards import parse_board
from fpp_ml_bench.cli.console import progress_bar, show
from fpp_ml_bench.cli.diagnose import Scenes
from fpp_ml_bench.cli.methods import MethodCommand, MethodSettings
from fpp_ml_bench.cli.options import AT_LEAST_ONE, command, value
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.loaders.captures.decoding import pose_folders
from fpp_ml_bench.loaders.captures.images import COLOURS
from fpp_ml_bench.optics.named_rigs import NAMED_RIGS
from fpp_ml_bench.optics.rig_file import load_rig
from fpp_ml_bench.options import REQUIRED, option
from fpp_ml_bench.style import percent
from fpp_ml_bench.tables import Table


def _limits(text: str) -> Mapping[str, float]:
    pairs = [part.split("=") for part in text.split(",") if part.strip()]
    return {symbol.strip(): float(number) for symbol, number in pairs}


@command(
    """\
fpp-bench certify classical --rig rig.yaml --out certificate
fpp-bench certify classical --steps 3 --out certificate-3                on the benchmark's rig
fpp-bench certify crossed --light workshop --limits PS=0.5,SD=1 --out certificate-crossed
fpp-bench certify mine.py:Mine --rig rig.yaml --out certificate-mine
fpp-bench certify classical --rig rig.yaml --captures poses --board checker:9x13:10 --out certificate-board
""",
    MethodCommand,
)
def certify_method(
    *,
    chosen: MethodSettings,
    out: Path = option(REQUIRED, "certificate.html and certificate.json go here", "DIR"),
    rig: str | None = option(
        None,
        f"rig file, or {' or '.join(NAMED_RIGS)} (default: the benchmark's that the method is for)",
        "RIG",
    ),
    light: str = option("paper", "light by name, or a file (default: paper)", "LIGHT"),
    repeats: int = option(
        CAPTURES,
        f"captures of one gauge of each kind, for the repeatability (default: {CAPTURES})",
        "N",
        parse=AT_LEAST_ONE,
    ),
    captures: Path | None = option(
        None, "instead of gauges a real board: folder with a folder of frames for each pose", "DIR"
    ),
    board: str | None = option(None, "the board, such as checker:9x13:10", "KIND:CxR:MM"),
    colour: str | None = option(
        None, f"where channels differ: {', '.join(COLOURS)}", "NAME", choices=COLOURS
    ),
    limits: Mapping[str, float] | None = option(
        None,
        "largest permitted errors, to be judged, such as PS=0.5,SD=1",
        "LIST",
        parse=value(
            "symbols and numbers above 0 such as PS=0.5,SD=1",
            _limits,
            lambda limits: bool(limits) and all(0 < limit < inf for limit in limits.values()),
        ),
    ),
) -> None:
    """Test a method on gauges: probing error, sphere spacing, flatness, steps, with uncertainty.

    A simulated type test: the generator photographs spheres, ball bars, planes, steps and wedges
    over the rig's measuring volume. With --captures a test on a real board: its flatness, and the
    distances of its corners. Raises FppBenchError for a rig that the gauges don't fit, and for
    captures that can't be used."""
    if (captures is None) != (board is None):
        raise PredictionError("--captures and --board: expected both or none")
    if captures is not None and board is not None:
        if rig is None:
            raise PredictionError("--captures: needs --rig, the file of the rig that took them")
        calibrated, folders = load_rig(Path(rig)), pose_folders(captures)
        with progress_bar(f"{chosen.name}, poses", len(folders), "poses") as advance:
            method = chosen.load(calibrated, warn=False)
            test = certify_board(
                method, calibrated, folders, parse_board(board), colour, limits, advance
            )
    else:
        name = rig or chosen.method.scenes_rig(chosen.options)
        settings = scenes_of(
            NAMED_RIGS[name]() if name in NAMED_RIGS else load_rig(Path(name)), light
        )
        method = chosen.load(Scenes.of(settings), warn=False)
        count = sum(1 for _ in gauges(settings.unit_rig))
        with progress_bar(f"{chosen.name}, gauges", count, "gauges") as advance:
            test = certify(method, settings, light, repeats, limits, advance)
    for_people, as_data = write_certificate(test, out)
    show(_table(test))
    print(f"Written: {for_people}\nWritten: {as_data}")


def _table(test: Certificate) -> Table:
    table = Table(
        "Quantity",
        numbers=("Largest", "U (k = 2)", "Mean", "Spread", "Positions", "Refused", "Verdict"),
        title=f"{test.method}: {'simulated type test' if test.simulated else 'test on a board'}, "
        f"light {test.light}, mm",
    )
    for line in test.lines:
        numbers = (line.largest, line.expanded, line.mean, line.spread)
        unit = "" if line.unit == "mm" else f", {line.unit}"
        table.add_row(
            f"{line.symbol}: {line.name}{unit}",
            *("-" if number is None else f"{number:.3g}" for number in numbers),
            f"{line.positions}/{line.positions + line.missing}",
            percent(line.refused, 2),
            line.verdict or "-",
        )
    return table
