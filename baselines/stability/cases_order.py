"""Fringe order: pixels on code edges, phases at +-pi exactly, flipped bits, more periods than codes."""

from fpp_ml_bench.baselines.stability import order_checks as check
from fpp_ml_bench.baselines.stability.case import Case, family

COORDINATE = "the coordinate that the frames were made from"
ROUNDED = "P / 2 pi asin(g / 2B): 8-bit frames alone; a slip would be a whole period"


def cases() -> list[Case]:
    """The cases of this group."""
    group = "order"
    pi = 3.141592653589793
    return [
        *family(
            group, "on a Gray edge", check.edge_blend,
            {"pitch_px": (4.0, 18.0, 37.3), "blend": (0.0, 0.25, 0.5, 0.75, 1.0)},
            computes="coordinate of pixels that see both cells, at every edge of the code", reference=COORDINATE,
            predicts=ROUNDED, unit="px",
        ),
        *family(
            group, "phase at +-pi", check.wrap_at_pi, {"pitch_px": (4.0, 18.0, 100.0), "bit_noise": (0.0, 0.7)},
            computes="coordinate of pixels in the middle of every period", reference=COORDINATE, predicts=ROUNDED,
            unit="px",
        ),
        *family(
            group, "order of a phase at the wrap", check.order_of_pi,
            {"phase_rad": (-pi, pi, 3.1415926535897927, -3.1415926535897927, 0.0, -0.0, 1.5707963267948966)},
            computes="absolute phase in each of 102 cells", reference="the same rule in 50 digits",
            predicts="4 u |Phi|: one product and two sums", unit="rad",
        ),
        *family(
            group, "arctangent", check.arctangent,
            {"code": ("compiled", "NumPy"), "scale": (1.0, 255.0, 1e-12, 1e-150, 1e150)},
            computes="-atan2 in all octants, on the axes, beside +-pi", reference="50 digits",
            predicts="4 u |phi|, the 2 ulp that the compiled arctangent promises", unit="rad",
        ),
        *family(
            group, "interval of the phase", check.order_range, {},
            computes="-atan2 of signed zeros and the smallest sines at a negative cosine",
            reference="the interval [-pi, pi)", predicts="exact: +pi is mapped to -pi", unit="rad",
        ),
        *family(
            group, "flipped bit, both directions", check.flipped_bit_both,
            {"direction": ("vertical", "horizontal"), "bit": tuple(range(7))},
            computes="depth of a plane with one Gray bit inverted in the whole image", reference="the plane, 1800 mm",
            predicts="8-bit frames, by rig.md's slope; slipped pixels flagged: 18 px are 11 px off the epipolar line",
            unit="mm", expects="either",
        ),
        *family(
            group, "flipped bit, one direction", check.flipped_bit_alone, {"bit": tuple(range(7))},
            computes="coordinate with one bit inverted, and the flagged pixels",
            reference="integer arithmetic on the misread cell: error in whole periods, or refused",
            predicts=ROUNDED, unit="px", expects="either",
        ),
        *family(
            group, "more periods than codes", check.too_few_codes, {"bits": (1, 4, 5, 6)},
            computes="a rig of 51 periods with this number of Gray bits", reference="102 cells need 7 bits",
            predicts="the code would repeat", unit="px", expects="refusal",
        ),
        *family(
            group, "cell off the pattern", check.cell_off_pattern, {"cell": (102, 103, 111, 127)},
            computes="a pixel whose code names a cell beyond the pattern", reference="there is no such cell",
            predicts="must be masked", unit="px", expects="refusal",
        ),
        *family(
            group, "code length", check.code_length, {"bits": (1, 2, 7, 10, 13, 15)},
            computes="coordinate in every cell of a full code, pitch 4 px, 3 steps", reference=COORDINATE,
            predicts=ROUNDED + " plus 8 u w", unit="px",
        ),
    ]  # fmt: skip
