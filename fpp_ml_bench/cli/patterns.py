"""``fpp-bench patterns``: the images to project, and the design of crossed fringes among them."""

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from fpp_ml_bench.calibration.boards import board_pdf, parse_board
from fpp_ml_bench.cli.console import show
from fpp_ml_bench.cli.options import command, given, value
from fpp_ml_bench.coding.crossed import Crossed
from fpp_ml_bench.design.rivals import EpipolarLines
from fpp_ml_bench.design.search import (
    LEFT_WRONG,
    Assumptions,
    Candidate,
    Design,
    describe,
    draw_design,
    search,
)
from fpp_ml_bench.errors import CaptureError, RigError
from fpp_ml_bench.files import holds, whole_folder, write_atomically, write_files
from fpp_ml_bench.optics.named_rigs import FIRST_SHIFTED_DEG, NAMED_RIGS
from fpp_ml_bench.optics.patterns import pattern_files
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.rig_file import load_projection, load_rig, save_rig
from fpp_ml_bench.options import argument, option
from fpp_ml_bench.tables import Table

ROWS = 8
"""Pairs that are shown, evenly spread over their periods, beside the proposed one."""


def _numbers(text: str) -> tuple[float, ...]:
    """Numbers with commas, or two whole ones with a hyphen for all between them."""
    if "," not in text and "-" in text:
        low, high = (int(part) for part in text.split("-"))
        return tuple(float(number) for number in range(low, min(high, low + 10_000) + 1))
    return tuple(float(part) for part in text.split(","))


def _family(text: str) -> "Crossed":
    values = PERIODS(text)
    if len(values) not in (2, 4):
        raise ValueError("expected two periods, or two periods and two angles")
    try:
        return Crossed((values[0], values[1]), values[2:] or (0.0, 90.0))
    except RigError as error:
        raise ValueError(str(error)) from error


BOARD_FILE = "board.pdf"
PERIODS = value(
    "numbers such as 12,14,18 or 12-18",
    _numbers,
    lambda values: values != () and all(0 <= number < 1e5 for number in values),
)


@dataclass(frozen=True, kw_only=True)
class DesignSettings(Assumptions):
    """What crossed fringes are searched, and by what they are judged."""

    HEADING = "design of crossed fringes"
    pitches: tuple[float, ...] | None = option(
        None,
        "periods to search, projector px (default: all whole ones that fit the image)",
        "A,B|A-B",
        parse=PERIODS,
    )
    pair: "tuple[Crossed, ...]" = option(
        (),
        "also describe these periods and angles (0 and 90 degrees unless said); repeatable",
        "P,Q[,A,B]",
        parse=_family,
        many=True,
    )
    picture: Path | None = option(
        None, "draw the proposed pair beside the rig's own or 18/18", "FILE.png"
    )


@dataclass(frozen=True, kw_only=True)
class PatternSettings(DesignSettings):
    """Settings of `patterns`."""

    rig: str = argument("rig file (.yaml, .json), or paper or crossed", "RIG")
    out: Path | None = option(
        None,
        "folder for the images; with --design: write the rig with three frames of the proposed "
        "pair (.yaml, .json)",
        "DIR|FILE",
    )
    board: str | None = option(
        None, "also write board.pdf, a calibration board to print without scaling", "KIND:CxR:MM"
    )
    design: bool = option(
        False,
        "write no images: find two carriers of crossed fringes with the least expected error, and "
        "say what they cost",
    )


@command(
    """\
fpp-bench patterns rig.yaml --out patterns           patterns/A_00.png, A_01.png, ... and patterns.json
fpp-bench patterns paper --out patterns              the paper's 52 frames
fpp-bench patterns crossed --out patterns            the same after three crossed frames
fpp-bench patterns rig.yaml --out patterns --board charuco:7x10:20:15     and a board to print, for the calibration

RIG may be a whole rig file, or one with the entries projector: {width: ..., height: ...} and sequence alone,
since patterns come before the calibration. Project them without scaling; capture an image each, in this order.

fpp-bench patterns paper --design
fpp-bench patterns rig.yaml --design --out crossed.yaml --picture design.png     the rig with the proposed pair
fpp-bench patterns rig.yaml --design --pitches 12-30                             these periods only
fpp-bench patterns paper --design --pair 18,18 --pair 18,14 --pair 24,13,0,45    beside pairs of yours (px, deg)

Rival: another depth in the working range at which both phases are nearly those of the true depth. Phase errors of
more than half of this distance choose the rival. With finer fringes a phase error is less depth, and rivals are nearer.
"""
)
def patterns(settings: PatternSettings) -> None:
    """Write the images that a rig's projector shows, in order, and a manifest of what each of them
    is. Or find the two carriers for crossed fringes of the least expected error, and say what they
    cost.

    Raises FppBenchError for an unusable rig file or folder."""
    if settings.design:
        _design(settings)
        return
    if of_design := given(settings, DesignSettings):
        raise RigError(
            f"{of_design[0]} belongs to the design of crossed fringes; give --design too"
        )
    if (out := settings.out) is None:
        raise CaptureError("--out DIR is missing: folder for the images")
    named = settings.rig in NAMED_RIGS
    rig = NAMED_RIGS[settings.rig]() if named else load_projection(settings.rig)
    files = pattern_files(rig)
    first, *_, last = names = list(files)
    frames = [
        {"file": name, "shows": frame.title.partition(": ")[2], **asdict(frame)}
        for name, frame in zip(names, rig.sequence, strict=True)
    ]
    content = {
        "projector_px": [rig.projector.width, rig.projector.height],
        "sequence": rig.to_dict()["sequence"],
        "pitch_px": {direction: rig.pitch(direction) for direction in rig.fringe_directions},
        "frames": frames,
    }
    files["patterns.json"] = (json.dumps(content, indent=1) + "\n").encode()
    if settings.board is not None:
        files[BOARD_FILE] = board_pdf(parse_board(settings.board))
    if not holds(out, files):  # written by the same command, which was killed before it said so
        never = "give a new folder, so that no old pattern is projected by mistake"
        with whole_folder(out, "writing patterns there", CaptureError, never) as folder:
            write_files(folder, files, CaptureError)
    size = f"{rig.projector.width} x {rig.projector.height} px"
    print(f"{out}: {len(names)} images of {size}, {first} to {last}, and patterns.json")
    if settings.board is not None:
        print(
            f"{out / BOARD_FILE}: {settings.board}; print it without scaling, measure its spacing"
        )
    print(
        "next: project them in this order, one capture each; then fpp-bench decode RIG CAPTURE "
        "--out OUT"
    )


def _design(settings: PatternSettings) -> None:
    """Search, print, and write what is asked for. Raises `RigError` for a rig that can't be
    used."""
    named = settings.rig in NAMED_RIGS
    rig = NAMED_RIGS[settings.rig]() if named else load_rig(settings.rig)
    design = search(rig, settings, settings.pitches)
    families = dict.fromkeys(settings.pair, "asked for")
    if len(rig.fringe_directions) == 2:
        families.setdefault(replace(Crossed.of_pair(rig), shifts_deg=((0.0, 0.0),)), "its pair")
    if rig.crossed is not None:
        families.setdefault(rig.crossed, "its crossed")
    others = describe(rig, list(families), settings)
    _print_design(rig, settings, design, list(zip(others, families.values(), strict=True)))
    if settings.picture is not None:
        beside = others[0] if others else describe(rig, [Crossed((18.0, 18.0))], settings)[0]
        write_atomically(settings.picture, draw_design(rig, design, beside))
        print(f"wrote {settings.picture}")
    if settings.out is not None:
        family = replace(design.proposed.crossed, shifts_deg=FIRST_SHIFTED_DEG)
        save_rig(rig.with_crossed(family), settings.out)
        print(f"wrote {settings.out}; next: fpp-bench patterns {settings.out} --out DIR")


def _print_design(
    rig: Rig, assumed: Assumptions, design: Design, others: list[tuple[Candidate, str]]
) -> None:
    (near_mm, far_mm), flat_deg = rig.working_range_mm, EpipolarLines.of(rig).flat_angle_deg
    print(
        f"rig             range {near_mm:g} to {far_mm:g} mm; a carrier at {flat_deg:.0f} degrees "
        f"runs along the "
        "epipolar lines and tells no depth"
    )
    print(
        f"phases          a mean error of {assumed.phase_error:g} rad along the line of depths; "
        f"camera noise of "
        f"{assumed.noise_grey:g} grey levels, white {assumed.white_grey:g} at {near_mm:g} mm; "
        f"projector blur "
        f"{assumed.blur_px:g} px"
    )
    print(
        f"wrong orders    {100 * assumed.edge_share:g}% of the pixels are near edges and texture, "
        f"where the phases are "
        f"off by {assumed.edge_sigma:g} rad across that line; in mm, of the {100 * LEFT_WRONG:g}% "
        f"that neighbours leave"
    )
    for direction in rig.fringe_directions:
        whole_px = rig.periods_in_range(direction) * rig.pitch(direction)
        print(
            f"one fringe      {direction}: from {whole_px:.1f} px on, the range has one period at "
            f"most, and the order "
            "needs no brightness"
        )
    names = (
        "projector px",
        "degrees",
        "image px",
        "rival, rad",
        "background",
        "periods in range",
        "wrong orders",
        "phases, mm",
        "orders, mm",
        "expected, mm",
    )
    table = Table("", numbers=names, names=3)
    every = max(-(-len(design.searched) // ROWS), 1)
    shown = {id(candidate): candidate for candidate in (*design.searched[::every], design.proposed)}
    rows = [
        (candidate, "proposed" if candidate is design.proposed else "")
        for candidate in shown.values()
    ]
    for candidate, about in sorted(rows, key=lambda row: -row[0].crossed.pitches_px[0]) + others:
        crossed = candidate.crossed
        background = "-" if candidate.background_rad is None else f"{candidate.background_rad:.2f}"
        table.add_row(
            about,
            _two(crossed.pitches_px, "g"),
            _two(crossed.angles_deg, "g"),
            _two(candidate.image_px, ".1f"),
            f"{candidate.rival_rad:.2f}",
            background,
            _two(candidate.turns, ".2f"),
            f"{100 * candidate.wrong_share:.2f}%",
            f"{candidate.phase_mm:.2f}",
            f"{candidate.wrong_mm:.2f}",
            f"{candidate.expected_mm:.2f}",
        )
    show(table)
    for candidate, about in others:
        for carrier in candidate.flat:
            pitch, angle = (
                candidate.crossed.pitches_px[carrier],
                candidate.crossed.angles_deg[carrier],
            )
            print(f"note: {about}: the carrier of {pitch:g} px at {angle:g} degrees tells no depth")
    crossed = design.proposed.crossed
    print(
        f"proposed        {_two(crossed.pitches_px, 'g')} px at {_two(crossed.angles_deg, 'g')} "
        f"degrees: the least "
        f"expected error of {len(design.searched)} periods; a guess of the model, measure it on "
        f"frames of your scenes"
    )


def _two(pair: tuple[float, float], form: str) -> str:
    return " / ".join(format(value, form) for value in pair)
