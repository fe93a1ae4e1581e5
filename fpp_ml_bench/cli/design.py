"""``fpp-bench design``: the periods and angles of crossed fringes that leave one order."""

import argparse
from dataclasses import replace
from pathlib import Path

from fpp_ml_bench import coding, design, optics
from fpp_ml_bench.cli.console import show, working_range
from fpp_ml_bench.errors import RigError
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.tables import Table

SUMMARY = "Find two carriers for crossed fringes whose phases agree at the true depth alone, and say what they cost."
EXAMPLES = (
    "fpp-bench design paper",
    "fpp-bench design rig.yaml --out crossed.yaml --picture design.png     the rig with the proposed pair",
    "fpp-bench design rig.yaml --pitches 12-30 --angles 0,45,90            these periods and angles only",
    "fpp-bench design paper --pair 18,18 --pair 18,14 --pair 24,13,0,45    beside pairs of yours (px, px, deg, deg)",
    "",
    "Rival: another depth in the working range at which both phases nearly are what they are at the true one; its",
    "distance is what errors of the phases must cross half of. Finer fringes have less depth noise and more rivals.",
)

ROWS = 8
"""Pairs of the front that are shown, evenly spread, beside the proposed one."""
MOST_WRONG = 0.05
"""Share of wrong orders beyond which a pair of the front is not shown."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add, default = parser.add_argument, design.Assumptions()
    least, most = default.image_px
    add("rig", metavar="RIG", help="rig file (.yaml, .json), or paper or crossed")
    add(
        "--pitches",
        type=_numbers,
        metavar="A,B|A-B",
        help="periods to search, projector px (default: all whole ones that fit the image)",
    )
    add(
        "--angles",
        type=_numbers,
        metavar="A,B|A-B",
        help="angles to search, 0: as horizontal fringes, 90: as vertical ones (default: 0, 15, ... 165)",
    )
    add(
        "--pair",
        type=_family,
        action="append",
        default=[],
        metavar="P,Q[,A,B]",
        help="also describe these periods and angles (0 and 90 degrees unless said); repeatable",
    )
    add(
        "--image-px",
        type=_interval,
        default=default.image_px,
        metavar="LEAST,MOST",
        help=f"limits of a period in the image, px; MOST of a beat too (default: {least:g},{most:g})",
    )
    add(
        "--surfaces",
        type=working_range,
        metavar="NEAR,FAR",
        help="where surfaces are expected, mm, for the share of wrong orders (default: the whole range)",
    )
    add(
        "--phase-sigma",
        type=_positive,
        default=default.phase_sigma,
        metavar="RAD",
        help=f"error of a phase at 20 image px a period, for orders (default: {default.phase_sigma:g})",
    )
    add(
        "--blur",
        type=_positive,
        default=default.blur_px,
        metavar="PX",
        help=f"sigma of the projector's blur, projector px (default: {default.blur_px:g})",
    )
    add(
        "--wrong",
        type=_positive,
        default=100 * default.wrong_share,
        metavar="PERCENT",
        help=f"wrong orders that may be left to the neighbours (default: {100 * default.wrong_share:g})",
    )
    add(
        "--noise",
        type=_positive,
        default=default.noise_grey,
        metavar="GREY",
        help=f"camera noise, grey levels of 255, for the depth noise (default: {default.noise_grey:g})",
    )
    add(
        "--white",
        type=_positive,
        default=default.white_grey,
        metavar="GREY",
        help=f"grey level of white at the near end (default: {default.white_grey:g})",
    )
    add(
        "--window",
        type=_positive,
        default=default.window_px,
        metavar="PX",
        help=f"Gaussian window, sigma in image px, for the depth noise (default: {default.window_px:g})",
    )
    add("--out", type=Path, metavar="FILE", help="write the rig with three frames of the proposed pair (.yaml, .json)")
    add("--picture", type=Path, metavar="FILE.png", help="draw the proposed pair beside the rig's own or 18/18")


def run(args: argparse.Namespace) -> int:
    """Search, print, and write what is asked for. Raises `RigError` for a rig that can't be used."""
    rig = optics.NAMED_RIGS[args.rig]() if args.rig in optics.NAMED_RIGS else optics.load_rig(args.rig)
    assumed = design.Assumptions(
        args.image_px, args.phase_sigma, args.blur, args.noise, args.white, args.window, args.surfaces, args.wrong / 100
    )
    found = design.search(rig, assumed, args.pitches, args.angles or design.ANGLES_DEG)
    families = dict.fromkeys(args.pair, "asked for")
    if len(rig.fringe_directions) == 2:
        families.setdefault(replace(coding.Crossed.of_pair(rig), shifts_deg=((0.0, 0.0),)), "its pair")
    if rig.crossed is not None:
        families.setdefault(rig.crossed, "its crossed")
    others = design.describe(rig, list(families), assumed)
    _print(rig, assumed, found, list(zip(others, families.values(), strict=True)))
    if args.picture is not None:
        beside = others[0] if others else design.describe(rig, [coding.Crossed((18.0, 18.0))], assumed)[0]
        write_atomically(args.picture, design.draw_design(rig, found.proposed, beside, assumed))
        print(f"wrote {args.picture}")
    if args.out is not None:
        family = replace(found.proposed.crossed, shifts_deg=optics.FIRST_SHIFTED_DEG)
        optics.save_rig(rig.with_crossed(family), args.out)
        print(f"wrote {args.out}; next: fpp-bench patterns {args.out} OUT")
    return 0


def _print(
    rig: "optics.Rig",
    assumed: "design.Assumptions",
    found: "design.Design",
    others: "list[tuple[design.Candidate, str]]",
) -> None:
    (near_mm, far_mm), flat_deg = rig.working_range_mm, design.EpipolarLines.of(rig).flat_angle_deg
    print(
        f"rig             range {near_mm:g} to {far_mm:g} mm; a carrier at {flat_deg:.0f} degrees runs along the "
        "epipolar lines and tells no depth"
    )
    print(
        f"orders          by a phase error of {assumed.phase_sigma:g} rad at 20 image px a period, before neighbours "
        "help"
    )
    print(
        f"depth noise     at {far_mm:g} mm, of {assumed.noise_grey:g} grey levels, white {assumed.white_grey:g} at "
        f"{near_mm:g} mm, window {assumed.window_px:g} px, projector blur {assumed.blur_px:g} px"
    )
    names = (
        "projector px",
        "degrees",
        "image px",
        "rival, rad",
        "background",
        "error",
        "noise, mm",
        "wrong orders",
        "periods in range",
    )
    table = Table("", numbers=names, names=3)
    front = [candidate for candidate in found.front if candidate.wrong_share <= MOST_WRONG]
    every = max(-(-len(front) // ROWS), 1)
    shown = {id(candidate): candidate for candidate in (*front[::every], found.proposed)}
    rows = [(candidate, "proposed" if candidate is found.proposed else "") for candidate in shown.values()]
    for candidate, about in sorted(rows, key=lambda row: -row[0].noise_mm) + others:
        crossed = candidate.crossed
        background = "-" if candidate.background_rad is None else f"{candidate.background_rad:.2f}"
        table.add_row(
            about,
            _two(crossed.pitches_px, "g"),
            _two(crossed.angles_deg, "g"),
            _two(candidate.image_px, ".1f"),
            f"{candidate.rival_rad:.2f}",
            background,
            f"{candidate.sigma_rad:.2f}",
            f"{candidate.noise_mm:.3f}",
            f"{100 * candidate.wrong_share:.3f}%",
            _two(candidate.turns, ".2f"),
        )
    show(table)
    for candidate, about in others:
        for carrier in candidate.flat:
            pitch, angle = candidate.crossed.pitches_px[carrier], candidate.crossed.angles_deg[carrier]
            print(f"note: {about}: the carrier of {pitch:g} px at {angle:g} degrees tells no depth")
    crossed = found.proposed.crossed
    print(
        f"proposed        {_two(crossed.pitches_px, 'g')} px at {_two(crossed.angles_deg, 'g')} degrees, out of "
        f"{found.searched:,} pairs: {found.reason}"
    )


def _two(pair: tuple[float, float], form: str) -> str:
    return " / ".join(format(value, form) for value in pair)


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 1e6:
        raise argparse.ArgumentTypeError(f"expected a number above 0, got {text!r}")
    return value


def _numbers(text: str) -> tuple[float, ...]:
    """Type of an option: numbers with commas, or two whole ones with a hyphen for all between them."""
    try:
        if "," not in text and "-" in text:
            low, high = (int(part) for part in text.split("-"))
            values = tuple(float(value) for value in range(low, min(high, low + 10_000) + 1))
        else:
            values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if not values or not all(0 <= value < 1e5 for value in values):
        raise argparse.ArgumentTypeError(f"expected numbers such as 12,14,18 or 12-18, got {text!r}")
    return values


def _interval(text: str) -> tuple[float, float]:
    values = _numbers(text) if "," in text else ()
    if len(values) != 2 or not 0 < values[0] < values[1]:
        raise argparse.ArgumentTypeError(f"expected LEAST,MOST such as 10,40, got {text!r}")
    return values[0], values[1]


def _family(text: str) -> "coding.Crossed":
    values = _numbers(text) if "," in text else ()
    if len(values) not in (2, 4):
        raise argparse.ArgumentTypeError(f"expected two periods, or two periods and two angles, got {text!r}")
    angles = values[2:] or (0.0, 90.0)
    try:
        return coding.Crossed((values[0], values[1]), (angles[0], angles[1]))
    except RigError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
